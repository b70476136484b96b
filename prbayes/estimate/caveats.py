"""What is to be said of an optimum: at an edge, at a jump, far from the data."""

from __future__ import annotations

import numpy as np

from prbayes._checks import Floats
from prbayes.model.evaluator import Evaluator

# Where an element left its prior, by spreads of the prior from its middle; nearer to it nothing is
# evaluated. Collapsed populations end 2.9 to 24 of them out, with priors of sigma from narrow to
# fifty times as wide as its truth (test: a collapsed population is known by the objective).
_FAR = 2.0
# A change that is none, of the objective's typical size. Of collapsed populations a spread further
# changes 2e-7 at most, and the way back to the prior's middle 7e-4 at least: any value in
# [1e-6, 1e-4] gives the same verdicts on them, on four processors and with noise of 1e-12.
_UNCHANGED = 1e-5
# Distance between distribution functions from which two populations differ. A half of the mass whose
# spread shrinks by a factor of 1.3 makes 0.035; where a population stands still it is a point's 1/n.
_DIFFERENT = 0.02


def trouble(at_edge: tuple[str, ...], at_jump: tuple[str, ...]) -> list[str]:
    """Say that elements are at the edge of their support, and that simulators jump."""
    lines = []
    if at_edge:
        lines.append(
            f"{', '.join(at_edge)} ran to the edge of the support, where the discrepancy no longer changes; perhaps "
            "the population has collapsed within the bandwidth of the metric: use a smaller bandwidth, or "
            "prb.AreaMetric(), which has none"
        )
    if at_jump:
        lines.append(
            f"{', '.join(at_jump)}: points lose their response at the optimum, and the discrepancy jumps there by more "
            "than it changes otherwise: use prb.AreaMetric(), prb.Reweighted(), or more responses"
        )
    return lines


def flat(evaluator: Evaluator, theta: Floats, scale: Floats) -> bool:
    """Whether no discrepancy changes around theta, as where populations and observed values do not overlap."""
    around = np.vstack([theta, *(theta + s * e for e in np.diag(0.01 * scale) for s in (1, -1))])
    found = evaluator(around).discrepancies
    with np.errstate(invalid="ignore"):
        return bool(
            ((found == found[0]) | (np.abs(found - found[0]) <= 1e-12 * np.abs(found[0]))).all()
        )


def elements_at_edge(
    evaluator: Evaluator, theta: Floats, scales: Floats, *, size: float, tolerance: float, seed: int
) -> tuple[str, ...]:
    """Return the elements that ran to an edge: the population goes on changing there, and its discrepancy does not.

    Standard errors cannot tell: curvature and noise are both rounding errors at an edge, and their ratio is anything.
    The way back to the middle of the prior does change the discrepancy, unlike that of a hyperparameter without effect.
    At the bound of a prior the population itself stands still: that is a minimum under a constraint.

    Parameters
    ----------
    evaluator : Evaluator
    theta : ndarray, shape (d,)
    scales : ndarray, shape (k,)
    size : float
        Typical size of the objective.
    tolerance : float
        Of the minimiser: it stops where the objective changes by less than that in one spread of the prior.
    seed : int
    """
    middle = np.median(evaluator.prior_thetas(256, seed), axis=0)
    away = theta - middle
    far = np.flatnonzero(np.abs(away) > _FAR * evaluator.prior_sd)
    if not far.size or flat(evaluator, theta, evaluator.prior_sd):
        return ()
    further = theta + np.diag(np.sign(away) * evaluator.prior_sd)[far]
    back = theta - np.diag(away)[far]
    # What changes further out, and on the way back
    here, *there = evaluator.total(np.vstack([theta, further, back]), scales)
    with np.errstate(invalid="ignore"):
        changes = np.abs(np.array(there) - here).reshape(2, -1)
    unchanged = max(_UNCHANGED, tolerance) * size
    stands_still, comes_back = changes[0] < unchanged, changes[1] > unchanged
    suspects = np.flatnonzero(stands_still & comes_back)
    names = evaluator.readable_names
    return tuple(
        names[far[i]] for i in suspects if _apart(evaluator, theta, further[i]) > _DIFFERENT
    )


def _apart(evaluator: Evaluator, a: Floats, b: Floats) -> float:
    """Return the largest distance between distribution functions of the populations at two thetas."""
    largest = 0.0
    for k in range(len(evaluator.nodes)):
        values, weights = evaluator.populations(np.array([a, b]), k)
        at = np.unique(values[np.isfinite(values)])
        below = [_shares_below(v, w, at) for v, w in zip(values, weights, strict=True)]
        largest = max(largest, float(np.abs(below[0] - below[1]).max(initial=0.0)))
    return largest


def _shares_below(values: Floats, weights: Floats, at: Floats) -> Floats:
    """Return the shares of weight of the values up to each number; those without response are above all."""
    order = np.argsort(values)
    total = np.concatenate([[0.0], np.cumsum(weights[order])])
    return np.asarray(total[np.searchsorted(values[order], at, side="right")] / total[-1])
