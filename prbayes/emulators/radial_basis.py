"""Radial basis functions with a polynomial."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from functools import partial
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
    degree : int, optional
        Of the polynomial; by default that of the least left-out errors.
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
    degree: int | None = None
    smoothing: float = 0.0

    def __post_init__(self) -> None:
        if self.kernel not in _LOWEST_DEGREE:
            kernels = list(_LOWEST_DEGREE)
            raise ValueError(f"RadialBasis: kernel: got {self.kernel!r}, expected one of {kernels}")
        if self.degree is not None:
            lowest = _LOWEST_DEGREE[self.kernel]
            positive_integer(self.degree, "RadialBasis: degree", minimum=lowest)
        is_number = isinstance(self.smoothing, int | float) and self.smoothing is not True
        if not is_number or not 0 <= self.smoothing < np.inf:
            raise ValueError(
                f"RadialBasis: smoothing: got {self.smoothing!r}, expected a number >= 0"
            )

    def terms(self, dimensions: int) -> int:
        """Return the number of terms of the polynomial, or of the least one."""
        degree = _LOWEST_DEGREE[self.kernel] if self.degree is None else self.degree
        return comb(dimensions + degree, degree)

    def through(self, x: Floats, y: Floats) -> Predict:
        """Return the surface."""
        return values_of_one(self.fit(x, y[:, None], np.full(len(x), 1 / len(x))))

    def fit(
        self, z: Floats, y: Floats, weights: Floats, start: Sequence[Any] = (), seed: int = 0
    ) -> list[Kriging]:
        """Return the surface of each output."""
        n, d = z.shape
        spread = spread_of(z)
        # Units of distances matter only beside the smoothing, which is in units of the points.
        lengths = spread / np.exp(np.log(spread).mean())
        nuggets = [1e-16, 1e-14, 1e-12, 1e-10, 1e-8]
        if self.smoothing:
            matrix = kernel_matrix(self.kernel, z / lengths)
            nuggets = [self.smoothing / float(np.abs(matrix).max())]
        lowest = _LOWEST_DEGREE[self.kernel]
        fit = partial(fit_kriging, kernel=self.kernel, lengths=lengths)
        # Polynomials with at most a third as many terms as runs.
        degrees = [lowest, *(p for p in range(lowest + 1, 17) if 3 * comb(d + p, d) <= n)]
        if self.degree is not None:
            degrees = [self.degree]
        rows = spread_rows(weights, MOST_TUNED)
        if len(rows) < n:
            # Fewer runs select among the degrees that they determine.
            quick = [p for p in degrees if 3 * comb(d + p, d) <= len(rows)]
            of_rows = weights[rows] / weights[rows].sum()
            surfaces = fit(z[rows], y[rows], of_rows, degrees=quick, nuggets=nuggets)
            degrees = sorted({*(s.degree for s in surfaces), *(set(degrees) - set(quick))})
        return fit(z, y, weights, degrees=degrees or [lowest], nuggets=nuggets)
