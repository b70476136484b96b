"""Optima at an edge, where the discrepancy no longer changes, or at a jump."""

from __future__ import annotations

import numpy as np

from prbayes._finding import Finding
from prbayes._stats import distribution_function
from prbayes._validate import Floats
from prbayes.inference.asymptotics import one_dimensional
from prbayes.model.evaluator import Evaluator
from prbayes.model.parameters import THETAS
from prbayes.numerics.derivatives import cross


def breakdown_findings(at_edge: tuple[str, ...], at_jump: tuple[str, ...]) -> list[Finding]:
    """Report elements at an edge and simulators at a jump, without a sampling distribution."""
    findings = []
    if at_edge:
        findings.append(
            Finding(
                "flat-edge",
                f"{', '.join(at_edge)} ran to the edge of the support, where the discrepancy no "
                "longer changes; perhaps the population has collapsed within the bandwidth of the "
                "metric: use a smaller bandwidth, or prb.AreaMetric(), which has none.",
                "choosing_metric.md#advice",
            )
        )
    if at_jump:
        findings.append(
            Finding(
                "jump-at-optimum",
                f"{', '.join(at_jump)}: points lose their response at the optimum, and the "
                "discrepancy jumps there by more than it changes otherwise: use prb.AreaMetric(), "
                "prb.Reweighted(), or more responses.",
                "choose.md#the-propagation",
            )
        )
    return findings


def no_information(evaluator: Evaluator, theta: Floats) -> bool:
    """Return whether no discrepancy changes around theta, as where populations miss the data."""
    # In spreads of the prior: small enough to stay on a plateau, and large against rounding.
    step = 0.01 * evaluator.hyperparameters.prior_sd
    values = evaluator(cross(theta, step)).discrepancies
    with np.errstate(invalid="ignore"):
        # 1e4 times the rounding of a sum in double precision.
        is_small = np.abs(values - values[0]) <= 1e-12 * np.abs(values[0])
    # Infinite values are equal, although their difference is not zero.
    return bool(((values == values[0]) | is_small).all())


def elements_at_edge(
    evaluator: Evaluator, theta: Floats, scales: Floats, *, size: float, tolerance: float, seed: int
) -> tuple[str, ...]:
    """Return the elements that ran to an edge: the population changes, but not its discrepancy.

    So far out that the population is one number, to the last digit, it no longer changes either:
    then the last point on the way back with the same discrepancy counts. Standard errors are no
    sign: curvature and noise are both rounding errors at an edge. The way back to the middle of the
    prior changes the discrepancy, unlike that of a hyperparameter without effect. At the bound of a
    prior the population itself is constant: that is a minimum under a constraint. ``size`` is the
    typical size of the objective. The minimiser stops at a relative change below ``tolerance``.
    """
    hyperparameters = evaluator.hyperparameters
    shift = theta - np.median(hyperparameters.prior_thetas(THETAS, seed), axis=0)
    # Collapsed populations end 2.9 to 24 spreads of the prior out.
    far = np.flatnonzero(np.abs(shift) > 2.0 * hyperparameters.prior_sd)
    if not far.size or no_information(evaluator, theta):
        return ()
    further = theta + np.diag(np.sign(shift) * hyperparameters.prior_sd)[far]
    back = theta - np.diag(shift)[far]
    center, *values = evaluator.total(np.vstack([theta, further, back]), scales)
    with np.errstate(invalid="ignore"):
        changes_further, changes_back = np.abs(np.array(values) - center).reshape(2, -1)
    # Of collapsed populations a spread further changes 2e-7 of the size at most, and the way back
    # 7e-4 at least: any value in [1e-6, 1e-4] gives the same verdicts.
    unchanged = max(1e-5, tolerance) * size
    at_edge = []
    for i in np.flatnonzero((changes_further < unchanged) & (changes_back > unchanged)):
        differs = _populations_differ(evaluator, theta, further[i])
        if not differs:
            last = _last_unchanged(evaluator, theta, back[i], scales, unchanged)
            differs = _populations_differ(evaluator, last, last + further[i] - theta)
        if differs:
            at_edge.append(hyperparameters.readable_names[far[i]])
    return tuple(at_edge)


def _last_unchanged(
    evaluator: Evaluator, theta: Floats, back: Floats, scales: Floats, unchanged: float
) -> Floats:
    """Return the last point on a straight way where the objective is that at its beginning."""
    (start,) = evaluator.total(theta[None], scales)
    low, high = 0.0, 1.0
    for _ in range(10):  # to a tenth of a spread of an optimum that is a hundred spreads out
        half = (low + high) / 2
        (value,) = evaluator.total((theta + half * (back - theta))[None], scales)
        if abs(value - start) < unchanged:
            low = half
        else:
            high = half
    return theta + low * (back - theta)


def _populations_differ(evaluator: Evaluator, a: Floats, b: Floats) -> bool:
    """Return whether distribution functions at two thetas differ by more than .02.

    Half of the mass whose spread shrinks by a factor of 1.3 makes .035; a constant population has a
    difference of one point's mass.
    """
    largest = 0.0
    for k, node in enumerate(evaluator.nodes):
        values, weights = evaluator.populations(np.array([a, b]), k)
        for projection in one_dimensional(node.target, values):
            occurring = np.unique(projection[np.isfinite(projection)])
            below = distribution_function(projection, weights, occurring)
            largest = max(largest, float(np.abs(below[0] - below[1]).max(initial=0.0)))
    return largest > 0.02
