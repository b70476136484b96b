"""Response surfaces that stand for a response within the ranges of their runs."""

from prbayes.surrogate.error import CrossValidation
from prbayes.emulators.surfaces import Polynomial, RadialBasis, Surface

__all__ = ["CrossValidation", "Polynomial", "RadialBasis", "Surface"]
