"""Whether the calibrated model holds on data that it has not seen."""

from prbayes.validation.candidates import compare_candidates
from prbayes.validation.exact_model import ExactModel
from prbayes.validation.joint_null import JointNull
from prbayes.validation.nulls import PosteriorNull
from prbayes.validation.probability_transform import u_values
from prbayes.validation.validity import ValidityTest

__all__ = [
    "ExactModel",
    "JointNull",
    "PosteriorNull",
    "ValidityTest",
    "compare_candidates",
    "u_values",
]
