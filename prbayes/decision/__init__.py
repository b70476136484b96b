"""Decision analysis: exceedance probabilities, sensitivities, and the value of more specimens."""

from prbayes.decision.p_box import p_box
from prbayes.decision.plan import Condition
from prbayes.decision.populations import evaluate
from prbayes.decision.quantities import (
    Exceedance,
    Interval,
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
    "evaluate",
    "p_box",
]
