"""Identification: directions without information, confounding, optima at an edge or at a jump."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from prbayes._finding import Finding
from prbayes._stats import distribution_function
from prbayes._validate import Floats, Indices, NamedValues, Names
from prbayes.inference.asymptotics import (
    Local,
    named_direction,
    single_output_parts,
    unidentified_directions,
)
from prbayes.model.evaluator import Evaluator, only_through_prior
from prbayes.model.parameters import THETAS, value_shapes
from prbayes.model.random_variable import Node
from prbayes.numerics.derivatives import cross
from prbayes.response.discrepancy import has_discrepancy


def unidentified_names(evaluator: Evaluator, local: Local) -> list[str]:
    """Name directions about which the data are less informative than the prior."""
    hidden = local.unidentified
    indirect = only_through_prior(evaluator)
    if indirect.any():
        # Singular values are one, or zero up to rounding of directions that only the prior informs.
        axes, strength, _ = np.linalg.svd(hidden * ~indirect[:, None], full_matrices=False)
        hidden = axes[:, strength > 0.5]
    return unidentified_directions(hidden, evaluator.hyperparameters.readable_names)


def unidentified_findings(
    evaluator: Evaluator,
    local: Local,
    excluded: Collection[str] = (),
    *,
    has_bounds: bool = True,
) -> list[Finding]:
    """Report directions about which the data are less informative than the prior.

    ``excluded`` names are left out. ``has_bounds`` is whether one-sided bounds were searched.
    """
    directions = [name for name in unidentified_names(evaluator, local) if name not in excluded]
    if not directions:
        return []
    text = (
        f"The data are less informative than the prior about {', '.join(directions)} (in units of "
        "the priors' standard deviations): the posterior rests mostly on the prior there; measure "
        "more outputs or conditions, or state prior knowledge."
    )
    if not has_bounds:
        text += (
            " Bounds from one side were not searched, which takes many responses or refits; look "
            "at the interval of prb.sample."
        )
    return [Finding("not-identified", text, "optimum_or_abc.md#no-answer")]


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
            text = (
                f"{node.name}: the data do not separate the model discrepancy from the inputs: "
                f"{reason}; measure under more conditions, state narrower priors, or leave one of "
                "them out."
            )
            page = "inadequacy.md#can-it-be-separated-from-the-scatter-of-the-inputs"
            findings.append(Finding("discrepancy-confounded", text, page))
    return findings


def mixed_directions(local: Local, coefficients: Indices, inputs: Indices, names: list[str]) -> str:
    """Name unidentified directions of both blocks of elements; empty if there are none."""
    _, _, axes = np.linalg.svd(local.unidentified[coefficients])
    directions = [
        named_direction(direction, names)
        for direction in (local.unidentified @ axes.T).T
        # A squared share of .001 is a thirtieth of a prior standard deviation.
        if min(float((direction[block] ** 2).sum()) for block in (coefficients, inputs)) > 0.001
    ]
    verb = "is" if len(directions) == 1 else "are"
    return f"{' and '.join(directions)} {verb} not identified" if directions else ""


def correlated_estimates(
    local: Local, coefficients: Indices, inputs: Indices, names: list[str]
) -> str:
    """Name the combinations with the largest correlation; empty if that is below .95.

    The variance of either is then ten times its variance with the other known.
    """
    by_data = local.identified @ np.linalg.pinv(local.covariance) @ local.identified.T
    precision = by_data + np.eye(local.prior_sd.size)
    correlation, *loadings = canonical_correlation(np.linalg.inv(precision), coefficients, inputs)
    if correlation < 0.95:
        return ""
    first, second = (
        named_direction(direction, [names[i] for i in block])
        for direction, block in zip(loadings, (coefficients, inputs), strict=True)
    )
    return f"estimates of {first} and {second} have a correlation of {correlation:.3f} in size"


def canonical_correlation(
    covariance: Floats, rows: Indices, columns: Indices
) -> tuple[float, Floats, Floats]:
    """Return the largest canonical correlation of two blocks, and the loadings in each."""
    first, second = (
        np.linalg.inv(np.linalg.cholesky(covariance[np.ix_(block, block)]))
        for block in (rows, columns)
    )
    between = first @ covariance[np.ix_(rows, columns)] @ second.T
    u, correlations, vt = np.linalg.svd(between)
    # The loadings are covariances of theta with the most correlated combinations.
    return (
        float(correlations[0]),
        np.linalg.solve(first, u[:, 0]),
        np.linalg.solve(second, vt[0]),
    )


def _separate_elements(evaluator: Evaluator, node: Node) -> tuple[Indices, Indices]:
    """Return the elements that enter the discrepancy's coefficients only, and other inputs only."""
    if not has_discrepancy(node.bound.responses.function):
        return np.arange(0), np.arange(0)
    inputs, model = node.bound.inputs, evaluator.model
    *arguments, coefficients = range(len(inputs.arguments))
    shapes = value_shapes(evaluator.hyperparameters).values()
    sizes = [int(np.prod(shape, dtype=int)) for shape in shapes]
    above = []
    for numbers in ([coefficients], arguments):
        names = {rv.name for rv in inputs.parents_above(numbers)}
        is_above = [model.values_to_rvs[value].name in names for value in model.value_vars]
        above.append(np.flatnonzero(np.repeat(is_above, sizes)))
    return np.setdiff1d(above[0], above[1]), np.setdiff1d(above[1], above[0])


def breakdown_findings(at_edge: Names, at_jump: Names) -> list[Finding]:
    """Report elements at an edge and simulators at a jump, without a sampling distribution."""
    findings = []
    if at_edge:
        text = (
            f"{', '.join(at_edge)} reached the edge of the support, where the discrepancy no "
            "longer changes; perhaps the population has collapsed within the bandwidth of the "
            "metric: use a smaller bandwidth, or prb.AreaMetric(), which has none."
        )
        findings.append(Finding("flat-edge", text, "choosing_metric.md#advice"))
    if at_jump:
        text = (
            f"{', '.join(at_jump)}: points lose their response at the optimum, and the discrepancy "
            "jumps there by more than it changes otherwise: use prb.AreaMetric(), "
            "prb.Reweighted(), or more responses."
        )
        findings.append(Finding("jump-at-optimum", text, "choose.md#the-propagation"))
    return findings


def unknown_error_findings(stderr: NamedValues, obstacle: str | None) -> list[Finding]:
    """Report standard errors that are NaN. The default reason is the end of a support."""
    names = [name for name, errors in stderr.items() if np.isnan(errors).any()]
    if not names:
        return []
    reason = obstacle or "the optimum is at the end of a support, where derivatives do not exist"
    text = (
        f"The standard errors of {', '.join(names)} are not known (NaN): {reason}; or take the "
        "uncertainty from prb.sample_smc."
    )
    return [Finding("no-standard-error", text, "choose.md#the-propagation")]


def no_information(evaluator: Evaluator, theta: Floats) -> bool:
    """Return whether no discrepancy changes around theta, as where populations miss the data."""
    # A hundredth of the prior's spread is small enough to stay on a plateau, and large against
    # rounding.
    step = 0.01 * evaluator.hyperparameters.prior_sd
    values = evaluator(cross(theta, step)).discrepancies
    with np.errstate(invalid="ignore"):
        # The limit is 1e4 times the rounding error of a sum in double precision.
        is_small = np.abs(values - values[0]) <= 1e-12 * np.abs(values[0])
    # Compare for equality as well, because the difference of infinite values is NaN.
    return bool(((values == values[0]) | is_small).all())


def elements_at_edge(
    evaluator: Evaluator, theta: Floats, scales: Floats, *, size: float, tolerance: float, seed: int
) -> Names:
    """Return the elements that ran to an edge: the population changes, but not its discrepancy.

    The way back to the middle of the prior changes the discrepancy, unlike that of a hyperparameter
    without effect. At the bound of a prior the population itself is constant: that is a minimum
    under a constraint. ``size`` is the typical size of the objective. The minimiser stops at a
    relative change below ``tolerance``.
    """
    hyperparameters = evaluator.hyperparameters
    shift = theta - np.median(hyperparameters.prior_thetas(THETAS, seed), axis=0)
    # In the studies collapsed populations were 2.9 to 24 prior standard deviations out.
    far = np.flatnonzero(np.abs(shift) > 2.0 * hyperparameters.prior_sd)
    if not far.size or no_information(evaluator, theta):
        return ()
    further = theta + np.diag(np.sign(shift) * hyperparameters.prior_sd)[far]
    back = theta - np.diag(shift)[far]
    center, *values = evaluator.total(np.vstack([theta, further, back]), scales)
    with np.errstate(invalid="ignore"):
        changes_further, changes_back = np.abs(np.array(values) - center).reshape(2, -1)
    # For collapsed populations a prior standard deviation further changes the objective by at most
    # 2e-7 of its size, and the way back by at least 7e-4: any limit in [1e-6, 1e-4] gives the same
    # verdicts.
    unchanged = max(1e-5, tolerance) * size
    at_edge = []
    for i in np.flatnonzero((changes_further < unchanged) & (changes_back > unchanged)):
        # Far beyond the data the population collapses numerically. Compare at the last point on the
        # way back at which the discrepancy has not changed.
        way = theta + np.linspace(0, 1, 101)[:, None] * (back[i] - theta)
        is_same = np.abs(evaluator.total(way, scales) - center) < unchanged
        last = way[np.logical_and.accumulate(is_same)][-1]
        if _populations_differ(evaluator, last, last + further[i] - theta):
            at_edge.append(hyperparameters.readable_names[far[i]])
    return tuple(at_edge)


def _populations_differ(evaluator: Evaluator, a: Floats, b: Floats) -> bool:
    """Return whether distribution functions at two thetas differ by more than .02.

    If the spread of half of the mass shrinks by a factor of 1.3, they differ by .035. Constant
    populations differ by the mass of one point.
    """
    largest = 0.0
    for k, node in enumerate(evaluator.nodes):
        values, weights = evaluator.populations(np.array([a, b]), k)
        for part in single_output_parts(node.target):
            projection = part.of(values)
            occurring = np.unique(projection[np.isfinite(projection)])
            below = distribution_function(projection, weights, occurring)
            largest = max(largest, float(np.abs(below[0] - below[1]).max(initial=0.0)))
    return largest > 0.02
