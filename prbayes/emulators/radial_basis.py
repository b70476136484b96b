"""Radial basis functions with a polynomial."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from math import comb
from typing import Any

import numpy as np

from prbayes._validate import Floats, positive_integer
from prbayes.emulators.kriging import (
    Kriging,
    fit_kriging,
    kernel_matrix,
    spread_of,
)
from prbayes.emulators.surfaces import KernelSurface

# The lowest degree for which a kernel is conditionally positive definite, so that the interpolant
# is unique: Wendland (2005), Scattered Data Approximation, ch. 8.
_LOWEST_DEGREE = {"linear": 0, "thin_plate_spline": 1, "cubic": 1, "quintic": 2}


@dataclass(frozen=True)
class RadialBasis(KernelSurface):
    """Radial basis functions with a polynomial, which pass through all points.

    Parameters
    ----------
    kernel : str
        linear, thin_plate_spline, cubic or quintic, which need no scale.
    degree : int or "best", optional
        Of the polynomial; by default the lowest that the kernel needs. "best" is that of the least
        left-out errors, with distances in units of the spread of each input.
    smoothing : float
        0 passes through the points; more smooths a response that is noisy.

    Raises
    ------
    TypeError, ValueError
        If an argument is not as described.

    Examples
    --------
    >>> RadialBasis(kernel="thin_plate_spline")
    RadialBasis(kernel='thin_plate_spline', degree=None, smoothing=0.0)
    """

    kernel: str = "cubic"
    _: KW_ONLY
    degree: int | str | None = None
    smoothing: float = 0.0

    def __post_init__(self) -> None:
        if self.kernel not in _LOWEST_DEGREE:
            kernels = list(_LOWEST_DEGREE)
            raise ValueError(f"RadialBasis: kernel: got {self.kernel!r}, expected one of {kernels}")
        if self.degree not in (None, "best"):
            lowest = _LOWEST_DEGREE[self.kernel]
            positive_integer(self.degree, "RadialBasis: degree", minimum=lowest)
        is_number = isinstance(self.smoothing, int | float) and self.smoothing is not True
        if not is_number or not 0 <= self.smoothing < np.inf:
            raise ValueError(
                f"RadialBasis: smoothing: got {self.smoothing!r}, expected a number >= 0"
            )

    def terms(self, dimensions: int) -> int:
        """Return the number of terms of the polynomial, or of the least one."""
        degree = self._degree
        return comb(dimensions + degree, degree)

    @property
    def _degree(self) -> int:
        """The degree, or the lowest degree if several are tried."""
        return self.degree if isinstance(self.degree, int) else _LOWEST_DEGREE[self.kernel]

    def fit(
        self, z: Floats, y: Floats, weights: Floats, start: Any = None, random_seed: int = 0
    ) -> Kriging | None:
        """Return the surface; None if the runs determine none."""
        n, d = z.shape
        nuggets = [1e-16, 1e-14, 1e-12, 1e-10, 1e-8] if n <= 512 else [1e-14, 1e-10]
        if self.degree != "best":
            if self.smoothing:
                nuggets = [self.smoothing / float(np.abs(kernel_matrix(self.kernel, z)).max())]
            fits = (
                fit_kriging(z, y, weights, self.kernel, np.ones(d), [self._degree], [nugget])
                for nugget in nuggets
            )
            return next((surface for surface in fits if surface is not None), None)
        # Polynomials are tried up to a third as many terms as runs. With many runs high degrees
        # improve the surface little, and take most of the time.
        highest = 17 if n <= 256 else self._degree + 2
        more = range(self._degree + 1, highest)
        degrees = [self._degree, *(p for p in more if 3 * comb(d + p, d) <= n)]
        return fit_kriging(z, y, weights, self.kernel, spread_of(z), degrees, nuggets)
