"""Whether the calibrated model holds on data that it has not seen."""

from prbayes.validation.area_test import ValidityTest
from prbayes.validation.nulls import ExactModel, JointNull, PosteriorNull
from prbayes.validation.pit import u_values

__all__ = [
    "ExactModel",
    "JointNull",
    "PosteriorNull",
    "ValidityTest",
    "u_values",
]
