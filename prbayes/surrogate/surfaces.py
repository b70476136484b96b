"""What a surrogate is made of: response surfaces, their cross-validation, residuals that repeat for the same input."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from math import comb
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prbayes._checks import Floats, positive_integer

FOLDS = 10
_KERNELS = {"linear": 0, "thin_plate_spline": 1, "cubic": 1, "quintic": 2}  # and the degree that each needs

Predict = Callable[[Floats], Floats]


class Surface:
    """A response surface that ships: `RadialBasis`, `Polynomial`."""

    def terms(self, dimensions: int) -> int:
        """Return how many points it needs at least."""
        raise NotImplementedError

    def through(self, x: Floats, y: Floats) -> Predict:
        """Return the surface through (for least squares: along) points x, shape (n, d), in the unit cube."""
        raise NotImplementedError


@dataclass(frozen=True)
class RadialBasis(Surface):
    """Radial basis functions with a polynomial, which pass through all points.

    Parameters
    ----------
    kernel : str
        Of `scipy.interpolate.RBFInterpolator`: linear, thin_plate_spline, cubic or quintic, which need no scale.
    degree : int, optional
        Of the polynomial; by default the lowest that the kernel needs.
    smoothing : float
        0 passes through the points; more smooths a response that is noisy.
    neighbors : int, optional
        How many of the nearest points are used; all by default. Some 50, where there are thousands of points.

    Raises
    ------
    TypeError, ValueError
        If an argument is not as described.

    Examples
    --------
    >>> RadialBasis(kernel="thin_plate_spline")
    RadialBasis(kernel='thin_plate_spline', degree=None, smoothing=0.0, neighbors=None)
    """

    kernel: str = "cubic"
    degree: int | None = None
    smoothing: float = 0.0
    neighbors: int | None = None

    def __post_init__(self) -> None:
        if self.kernel not in _KERNELS:
            raise ValueError(f"RadialBasis: kernel: got {self.kernel!r}, expected one of {list(_KERNELS)}")
        if self.degree is not None:
            positive_integer(self.degree, "RadialBasis: degree", minimum=_KERNELS[self.kernel])
        if not isinstance(self.smoothing, int | float) or not 0 <= self.smoothing < np.inf:
            raise ValueError(f"RadialBasis: smoothing: got {self.smoothing!r}, expected a number >= 0")
        if self.neighbors is not None:
            positive_integer(self.neighbors, "RadialBasis: neighbors", minimum=2)

    def terms(self, dimensions: int) -> int:
        """Return the number of terms of the polynomial."""
        degree = _KERNELS[self.kernel] if self.degree is None else self.degree
        return comb(dimensions + degree, degree)

    def through(self, x: Floats, y: Floats) -> Predict:
        """Return the interpolant."""
        from scipy.interpolate import RBFInterpolator  # takes as long to import as the whole package

        degree = _KERNELS[self.kernel] if self.degree is None else self.degree
        found: Predict = RBFInterpolator(
            x, y, neighbors=self.neighbors, smoothing=self.smoothing, kernel=self.kernel, degree=degree
        )
        return found


@dataclass(frozen=True)
class Polynomial(Surface):
    """A polynomial in all inputs, by least squares.

    Parameters
    ----------
    degree : int
        Total degree: 2 has squares and products of two inputs.

    Raises
    ------
    TypeError, ValueError
        If the degree is not a positive integer.

    Examples
    --------
    >>> Polynomial(degree=3).terms(2)
    10
    """

    degree: int = 2

    def __post_init__(self) -> None:
        positive_integer(self.degree, "Polynomial: degree")

    def terms(self, dimensions: int) -> int:
        """Return the number of coefficients."""
        return comb(dimensions + self.degree, self.degree)

    def _basis(self, x: Floats) -> Floats:
        single = np.polynomial.legendre.legvander(2 * x - 1, self.degree)  # (n, d, degree + 1)
        powers = [p for p in product(range(self.degree + 1), repeat=x.shape[1]) if sum(p) <= self.degree]
        return np.stack([np.prod([single[:, i, k] for i, k in enumerate(p)], axis=0) for p in powers], axis=1)

    def through(self, x: Floats, y: Floats) -> Predict:
        """Return the polynomial of least squares."""
        coefficients = np.linalg.lstsq(self._basis(x), y, rcond=None)[0]
        return lambda at: np.asarray(self._basis(at) @ coefficients)


def fitted(model: Any, x: Floats, y: Floats) -> Predict:
    """Return a surface, or a copy of a regressor with ``fit`` and ``predict``, fitted to responses of unit spread."""
    center, spread = y.mean(), y.std() or 1.0
    z = (y - center) / spread
    if isinstance(model, Surface):
        predict = model.through(x, z)
    else:
        regressor = copy.deepcopy(model)
        regressor.fit(x, z)
        predict = regressor.predict
    return lambda at: center + spread * np.asarray(predict(at), dtype=np.float64).reshape(len(at))


def required(model: Any, dimensions: int) -> int:
    """Return how many design points a surface needs, so that nine tenths of them determine it."""
    terms = model.terms(dimensions) if isinstance(model, Surface) else 1
    n = terms + 2
    while n - -(-n // min(FOLDS, n)) < terms + 1:
        n += 1
    return n


def scattered(x: Floats, seed: int) -> NDArray[np.uint64]:
    """Return a number for each row of x, shape (n, d), that is the same for the same row, and else as if random.

    The rows' bits go through the finalizer of splitmix64 (Steele, Lea and Flood 2014, doi:10.1145/2660193.2660195).
    """
    h = np.full(len(x), seed, dtype=np.uint64)
    for column in np.ascontiguousarray(x.T + 0.0):  # -0.0 is 0.0
        h = (h ^ column.view(np.uint64)) + np.uint64(0x9E3779B97F4A7C15)
        h = (h ^ (h >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        h = (h ^ (h >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        h = h ^ (h >> np.uint64(31))
    return h
