"""Radial basis functions with a polynomial."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from math import comb
from typing import Any

import numpy as np

from prbayes._validate import Floats, positive_integer
from prbayes.emulators.kriging import (
    MOST_TUNED,
    Kriging,
    fit_kriging,
    kernel_matrix,
    spread_of,
    spread_rows,
    values_of_one,
)
from prbayes.emulators.surfaces import Predict, Surface

# The lowest degree with which a kernel is conditionally positive definite, and the interpolant
# unique: Wendland (2005), Scattered Data Approximation, ch. 8.
_LOWEST_DEGREE = {"linear": 0, "thin_plate_spline": 1, "cubic": 1, "quintic": 2}


@dataclass(frozen=True)
class RadialBasis(Surface):
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
        """The degree, or the lowest of several."""
        return self.degree if isinstance(self.degree, int) else _LOWEST_DEGREE[self.kernel]

    def through(self, x: Floats, y: Floats) -> Predict:
        """Return the surface."""
        return values_of_one(self.fit(x, y[:, None], np.full(len(x), 1 / len(x))))

    def fit(
        self, z: Floats, y: Floats, weights: Floats, start: Sequence[Any] = (), seed: int = 0
    ) -> list[Kriging]:
        """Return the surface of each output."""
        n, d = z.shape
        nuggets = [1e-16, 1e-14, 1e-12, 1e-10, 1e-8]
        if self.degree != "best":
            lengths = np.ones(d)
            if self.smoothing:
                largest = np.abs(kernel_matrix(self.kernel, z)).max()
                nuggets = [self.smoothing / float(largest)]
            fits = (
                fit_kriging(z, y, weights, self.kernel, lengths, [self._degree], [nugget])
                for nugget in nuggets
            )
            return next(filter(None, fits), [])
        # Polynomials with at most a third as many terms as runs. Fewer runs select among those that
        # they determine.
        degrees = [
            p for p in range(self._degree, 17) if p == self._degree or 3 * comb(d + p, d) <= n
        ]
        rows, lengths = spread_rows(weights, MOST_TUNED), spread_of(z)
        if len(rows) < n:
            quick = [p for p in degrees if 3 * comb(d + p, d) <= len(rows)]
            of_rows = weights[rows] / weights[rows].sum()
            surfaces = fit_kriging(z[rows], y[rows], of_rows, self.kernel, lengths, quick, nuggets)
            degrees = sorted({*(s.degree for s in surfaces), *(set(degrees) - set(quick))})
        return fit_kriging(z, y, weights, self.kernel, lengths, degrees or [self._degree], nuggets)
