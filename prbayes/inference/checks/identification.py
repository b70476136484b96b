"""Identification: directions that the data do not identify, and confounded model discrepancies."""

from __future__ import annotations

from collections.abc import Collection, Iterable

import numpy as np
from numpy.typing import NDArray

from prbayes._finding import Finding
from prbayes._validate import Floats
from prbayes.inference.asymptotics import Local
from prbayes.inference.identifiability import (
    named_direction,
    unidentified_directions,
    without,
)
from prbayes.model.evaluator import Evaluator, only_through_prior
from prbayes.model.random_variable import Node
from prbayes.response.discrepancy import has_discrepancy

IntArray = NDArray[np.intp]


def unidentified_findings(
    evaluator: Evaluator, local: Local, excluded: Collection[str] = ()
) -> list[Finding]:
    """Report directions that the data identify less than the prior, without excluded names."""
    hidden = without(local.unidentified, only_through_prior(evaluator))
    directions = unidentified_directions(hidden, evaluator.hyperparameters.readable_names)
    return [
        Finding(
            "not-identified",
            f"The data tell less than the prior about {direction} (in units of the priors' "
            "standard deviations): it is not identified by them, and its posterior rests on the "
            "prior; measure more outputs or conditions, or state what is known.",
            "optimum_or_abc.md#no-answer",
        )
        for direction in directions
        if direction not in excluded
    ]


def confounding_findings(evaluator: Evaluator, local: Local) -> list[Finding]:
    """Report a model discrepancy whose hyperparameters are confounded with those of other inputs.

    Either a direction of both is not identified, or their estimates, by data and prior together,
    have too large a canonical correlation.
    """
    findings = []
    names = evaluator.hyperparameters.readable_names
    for node in evaluator.nodes:
        coefficients, inputs = _separate_elements(evaluator, node)
        if not coefficients.size or not inputs.size:
            continue
        reason = mixed_directions(local, coefficients, inputs, names)
        reason = reason or correlated_estimates(local, coefficients, inputs, names)
        if reason:
            findings.append(
                Finding(
                    "discrepancy-confounded",
                    f"{node.name}: the data do not tell the model inadequacy from the inputs: "
                    f"{reason}; measure under more conditions, state narrower priors, or leave one "
                    "of them out.",
                    "inadequacy.md#can-it-be-told-from-the-scatter-of-the-inputs",
                )
            )
    return findings


def mixed_directions(
    local: Local, coefficients: IntArray, inputs: IntArray, names: list[str]
) -> str:
    """Name unidentified directions of both blocks of elements; empty if there are none."""
    _, _, axes = np.linalg.svd(local.unidentified[coefficients])
    directions = [
        named_direction(direction, names)
        for direction in (local.unidentified @ axes.T).T
        # A thousandth of the square is a thirtieth of a spread of the prior.
        if min(float((direction[block] ** 2).sum()) for block in (coefficients, inputs)) > 0.001
    ]
    verb = "is" if len(directions) == 1 else "are"
    return f"{' and '.join(directions)} {verb} not identified" if directions else ""


def correlated_estimates(
    local: Local, coefficients: IntArray, inputs: IntArray, names: list[str]
) -> str:
    """Name the combinations with the largest correlation; empty if that is below .95.

    The variance of either is then ten times its variance with the other known.
    """
    by_data = local.identified @ np.linalg.pinv(local.covariance) @ local.identified.T
    precision = np.asarray(by_data + np.eye(local.prior_sd.size))
    correlation, *loadings = canonical_correlation(np.linalg.inv(precision), coefficients, inputs)
    if correlation < 0.95:
        return ""
    first, second = (
        named_direction(direction, [names[i] for i in block])
        for direction, block in zip(loadings, (coefficients, inputs), strict=True)
    )
    return f"estimates of {first} and {second} have a correlation of {correlation:.3f} in size"


def canonical_correlation(
    covariance: Floats, rows: IntArray, columns: IntArray
) -> tuple[float, Floats, Floats]:
    """Return the largest canonical correlation of two blocks, and the loadings in each."""
    first, second = (
        np.linalg.inv(np.linalg.cholesky(covariance[np.ix_(block, block)]))
        for block in (rows, columns)
    )
    between = first @ covariance[np.ix_(rows, columns)] @ second.T
    u, correlations, vt = np.linalg.svd(between)
    # Loadings are the covariances of theta with the best combinations.
    return (
        float(correlations[0]),
        np.linalg.solve(first, u[:, 0]),
        np.linalg.solve(second, vt[0]),
    )


def _separate_elements(evaluator: Evaluator, node: Node) -> tuple[IntArray, IntArray]:
    """Return the elements of theta above the coefficients only, and above other inputs only."""
    if not has_discrepancy(node.bound.responses.function):
        return np.arange(0), np.arange(0)
    inputs = node.bound.inputs
    *arguments, coefficients = range(len(inputs.arguments))
    above_coefficients = _elements_above(evaluator, node, [coefficients])
    above_inputs = _elements_above(evaluator, node, arguments)
    return (
        np.setdiff1d(above_coefficients, above_inputs),
        np.setdiff1d(above_inputs, above_coefficients),
    )


def _elements_above(evaluator: Evaluator, node: Node, arguments: Iterable[int]) -> IntArray:
    """Return the elements of theta in the roots above some arguments of a response."""
    names = {rv.name for rv in node.bound.inputs.roots_above(list(arguments))}
    model = evaluator.model
    is_above: list[bool] = []
    shapes = evaluator.hyperparameters.shapes.values()
    for value, shape in zip(model.value_vars, shapes, strict=True):
        size = int(np.prod(shape, dtype=int))
        is_above += [model.values_to_rvs[value].name in names] * size
    return np.flatnonzero(is_above)
