"""Whether the calibrated model holds on data that it has not seen."""

from prbayes.validation.area_test import ValidityTest, u_values
from prbayes.validation.nulls import ExactModel, JointNull, PosteriorNull

__all__ = [
    "ExactModel",
    "JointNull",
    "PosteriorNull",
    "ValidityTest",
    "u_values",
]
