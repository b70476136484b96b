"""Response surfaces within the ranges of their runs."""

from prbayes.emulators.gaussian_process import GaussianProcess
from prbayes.emulators.radial_basis import RadialBasis
from prbayes.emulators.selection import CrossValidation
from prbayes.emulators.surfaces import Polynomial, Surface

__all__ = ["CrossValidation", "GaussianProcess", "Polynomial", "RadialBasis", "Surface"]
