"""From scatter to decision: what moves a decision, what more data would change, what is risked."""

from prbayes.decision.information import Condition
from prbayes.decision.interval import Interval
from prbayes.decision.p_box import p_box
from prbayes.decision.quantities import (
    Exceedance,
    Mean,
    Quantile,
    Quantity,
    StandardDeviation,
)

__all__ = [
    "Condition",
    "Exceedance",
    "Interval",
    "Mean",
    "Quantile",
    "Quantity",
    "StandardDeviation",
    "p_box",
]
