"""What is to be said of an optimum: at an edge, at a jump, far from the data."""

from __future__ import annotations

import numpy as np

from prbayes._checks import Floats
from prbayes.model.evaluator import Evaluator


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
        return bool(((found == found[0]) | (np.abs(found - found[0]) <= 1e-12 * np.abs(found[0]))).all())
