"""Whether the calibrated model holds on data that it has not seen."""

from prbayes.validation.area_test import ValidityTest, u_values
from prbayes.validation.joint_null import JointNull
from prbayes.validation.nulls import ExactModel, PosteriorNull

__all__ = [
    "ExactModel",
    "JointNull",
    "PosteriorNull",
    "ValidityTest",
    "u_values",
]
