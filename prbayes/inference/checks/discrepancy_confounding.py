"""Whether a model inadequacy can be told from the scatter of the inputs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prbayes._finding import Finding
from prbayes._validate import Floats
from prbayes.inference.asymptotics import Local
from prbayes.inference.identifiability import named_direction
from prbayes.model.evaluator import Evaluator
from prbayes.model.random_variable import Node
from prbayes.response.discrepancy import has_discrepancy

Places = NDArray[np.intp]

# Share of a direction above which hyperparameters take part in it, a thirtieth of a spread of the
# prior: below, a prior has told them from the others. By judgement.
_TAKES_PART = 0.001
# Correlation of estimates from which two are said not to be told apart: the variance of either is
# then ten times what it would be if the other were known. By judgement.
_TOLD_APART = 0.95


def confounded(evaluator: Evaluator, local: Local) -> list[Finding]:
    """Say where data do not tell an inadequacy's hyperparameters from those of other inputs.

    Either a direction of both is not identified, or their estimates, by data and prior together,
    have too large a canonical correlation.
    """
    findings = []
    for node in evaluator.nodes:
        own, others = _elements(evaluator, node)
        if not own.size or not others.size:
            continue
        names = evaluator.hyperparameters.readable_names
        found = _mixed(local, own, others, names) or _alike(local, own, others, names)
        if found:
            findings.append(
                Finding(
                    "discrepancy-confounded",
                    f"{node.name}: the data do not tell the model inadequacy from the inputs: "
                    f"{found}; measure under more conditions, state narrower priors, or leave one "
                    "of them out.",
                    "inadequacy.md#can-it-be-told-from-the-scatter-of-the-inputs",
                )
            )
    return findings


def _mixed(local: Local, own: Places, others: Places, names: list[str]) -> str:
    """Name the directions of both that are not identified."""
    _, _, axes = np.linalg.svd(local.unidentified[own])
    found = []
    for direction in (local.unidentified @ axes.T).T:
        shares = [float((direction[block] ** 2).sum()) for block in (own, others)]
        if min(shares) > _TAKES_PART:
            found.append(named_direction(direction, names))
    verb = "is" if len(found) == 1 else "are"
    return f"{' and '.join(found)} {verb} not identified" if found else ""


def _alike(local: Local, own: Places, others: Places, names: list[str]) -> str:
    """Name what is estimated alike, if anything is."""
    covariance = np.linalg.inv(_precision(local))
    correlation, of_own, of_others = _canonical(covariance, own, others)
    if correlation < _TOLD_APART:
        return ""
    first = named_direction(of_own, [names[i] for i in own])
    second = named_direction(of_others, [names[i] for i in others])
    return f"estimates of {first} and {second} have a correlation of {correlation:.3f} in size"


def _precision(local: Local) -> Floats:
    """Return the precision of theta by data and prior, (d, d), in units of the prior's spread."""
    by_data = local.identified @ np.linalg.pinv(local.covariance) @ local.identified.T
    return np.asarray(by_data + np.eye(local.prior_sd.size))


def _elements(evaluator: Evaluator, node: Node) -> tuple[Places, Places]:
    """Return which elements of theta are above the coefficients only, and above other inputs."""
    if not has_discrepancy(node.bound.responses.function):
        return np.arange(0), np.arange(0)
    inputs = node.bound.inputs
    *others, coefficients = range(len(inputs.arguments))
    own = _places(evaluator, inputs.roots_above([coefficients]))
    rest = _places(evaluator, inputs.roots_above(others))
    return np.setdiff1d(own, rest), np.setdiff1d(rest, own)


def _places(evaluator: Evaluator, roots: Sequence[Any]) -> Places:
    """Return which elements of theta some roots are."""
    names = {rv.name for rv in roots}
    model = evaluator.model
    belongs: list[bool] = []
    for value, shape in zip(
        model.value_vars, evaluator.hyperparameters.shapes.values(), strict=True
    ):
        size = int(np.prod(shape, dtype=int))
        belongs += [model.values_to_rvs[value].name in names] * size
    return np.flatnonzero(belongs)


def _canonical(covariance: Floats, own: Places, others: Places) -> tuple[float, Floats, Floats]:
    """Return the largest canonical correlation of two blocks, and the direction in each."""
    roots = []
    for block in (own, others):
        root = np.linalg.cholesky(covariance[np.ix_(block, block)])
        roots.append(np.linalg.inv(root))
    between = roots[0] @ covariance[np.ix_(own, others)] @ roots[1].T
    left, correlations, right = np.linalg.svd(between)
    # What is estimated alike moves in theta along the covariances with these combinations.
    first = np.linalg.solve(roots[0], left[:, 0])
    second = np.linalg.solve(roots[1], right[0])
    return float(correlations[0]), first, second
