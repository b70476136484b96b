"""Whether the calibrated model holds on data that it has not seen."""

from prbayes.validation.area_test import ValidityTest
from prbayes.validation.exact_null import ExactModel
from prbayes.validation.joint_null import JointNull
from prbayes.validation.nulls import PosteriorNull
from prbayes.validation.probability_transform import u_values

__all__ = [
    "ExactModel",
    "JointNull",
    "PosteriorNull",
    "ValidityTest",
    "u_values",
]
