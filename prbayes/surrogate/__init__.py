"""Response surfaces that stand for a response within the ranges of their runs."""

from prbayes.emulators.surfaces import Polynomial, RadialBasis, Surface
from prbayes.surrogate.error import CrossValidation

__all__ = ["CrossValidation", "Polynomial", "RadialBasis", "Surface"]
