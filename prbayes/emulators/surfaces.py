"""Response surfaces: radial basis functions, polynomials, and what users bring along."""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass
from itertools import product
from math import comb
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prbayes._validate import Floats, positive_integer

# The lowest degree with which each kernel is conditionally positive definite, so that the
# interpolant is unique: Wendland (2005), Scattered Data Approximation, ch. 8;
# scipy.interpolate.RBFInterpolator warns below it.
_LOWEST_DEGREE = {"linear": 0, "thin_plate_spline": 1, "cubic": 1, "quintic": 2}

Predict = Callable[[Floats], Floats]


class Surface(ABC):
    """A kind of response surface: `RadialBasis`, `Polynomial`, or one of your own.

    A surface of your own derives from it and says how many points it needs, and what passes through
    them.

    Examples
    --------
    >>> import numpy as np, prbayes as prb
    >>> from prbayes.surrogate import Surface
    >>> class Constant(Surface):
    ...     def terms(self, dimensions):
    ...         return 1
    ...
    ...     def through(self, x, y):
    ...         return lambda at: np.full(len(at), y.mean())
    >>> prb.Surrogate.fit(lambda x: 0 * x + 3, {"x": (0, 1)}, 8, model=Constant())(0.5)
    array(3.)
    """

    @abstractmethod
    def terms(self, dimensions: int) -> int:
        """Return how many points it needs at least, for inputs of so many dimensions."""

    @abstractmethod
    def through(self, x: Floats, y: Floats) -> Predict:
        """Return the surface through points, or, by least squares, along them.

        Parameters
        ----------
        x : ndarray, shape (n, d)
            In the unit cube.
        y : ndarray, shape (n,)
            Responses, of mean 0 and standard deviation 1.

        Returns
        -------
        callable
            From points, shape (k, d), to values, shape (k,).
        """

    def tuned(self, x: Floats, y: Floats) -> Surface:
        """Return the surface with settings that fit the points, which keeps them with fewer."""
        return self

    def slope(self, x: Floats, y: Floats, along: Floats) -> float:
        """Return how steeply responses follow another one, of spread 1, beside such a surface."""
        return least_squares(x, y, along)

    def without_each(self, x: Floats, y: Floats, lacking: NDArray[np.bool_]) -> Predict | None:
        """Return surfaces that each lack some of the points, if there is a short way to them.

        Parameters
        ----------
        x : ndarray, shape (n, d)
        y : ndarray, shape (n,)
            In any unit.
        lacking : ndarray of bool, shape (B, n)

        Returns
        -------
        callable or None
            From points, shape (k, d), to values, shape (k, B).
        """
        return None


@dataclass(frozen=True)
class RadialBasis(Surface):
    """Radial basis functions with a polynomial, which pass through all points.

    Parameters
    ----------
    kernel : str
        Of `scipy.interpolate.RBFInterpolator`: linear, thin_plate_spline, cubic or quintic, which
        need no scale.
    degree : int, optional
        Of the polynomial; by default the lowest that the kernel needs.
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
        """Return the number of terms of the polynomial."""
        degree = self._degree()
        return comb(dimensions + degree, degree)

    def through(self, x: Floats, y: Floats) -> Predict:
        """Return the interpolant."""
        from scipy.interpolate import RBFInterpolator as Interpolator  # takes long to import

        surface: Predict = Interpolator(
            x, y, smoothing=self.smoothing, kernel=self.kernel, degree=self._degree()
        )
        return surface

    def _degree(self) -> int:
        if self.degree is None:
            return _LOWEST_DEGREE[self.kernel]
        return self.degree


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

    def through(self, x: Floats, y: Floats) -> Predict:
        """Return the polynomial of least squares."""
        coefficients = np.linalg.lstsq(self.basis(x), y, rcond=None)[0]
        return _LeastSquares(self, coefficients)

    def basis(self, x: Floats) -> Floats:
        """Return products of Legendre polynomials at points of the unit cube, shape (n, terms)."""
        dimensions = x.shape[1]
        # One input at a time, and points last, so that what is multiplied lies in a row:
        # (d, degree + 1, n).
        single = np.polynomial.legendre.legvander(2 * x - 1, self.degree)
        rows = np.ascontiguousarray(np.moveaxis(single, 0, -1))
        degrees = [
            each
            for each in product(range(self.degree + 1), repeat=dimensions)
            if sum(each) <= self.degree
        ]
        terms = np.ones((len(degrees), len(x)))
        for term, each in zip(terms, degrees, strict=True):
            for own, k in zip(rows, each, strict=True):
                if k:  # the first one is one
                    term *= own[k]
        return terms.T


# Points whose terms are made at a time: they stay in the cache.
_POINTS_OF_A_BASIS = 4096


@dataclass(frozen=True, eq=False)
class _LeastSquares:
    """A polynomial with its coefficients; a class, so that it can be pickled."""

    polynomial: Polynomial
    coefficients: Floats

    def __call__(self, at: Floats) -> Floats:
        values = np.empty(len(at))
        for first in range(0, len(at), _POINTS_OF_A_BASIS):
            some = slice(first, first + _POINTS_OF_A_BASIS)
            values[some] = self.polynomial.basis(at[some]) @ self.coefficients
        return values


def least_squares(x: Floats, y: Floats, along: Floats) -> float:
    """Return how steeply responses follow another one beside a plane, which any surface tells."""
    columns = np.column_stack([np.ones(len(x)), x, along])
    return float(np.linalg.lstsq(columns, y, rcond=None)[0][-1])


def fitted(model: Any, x: Floats, y: Floats) -> Predict:
    """Return a surface, or a copy of a regressor, fitted to responses of unit spread.

    Parameters
    ----------
    model : Surface or regressor
        A regressor has ``fit(X, y)`` and ``predict(X)``.
    x : ndarray, shape (n, d)
        In the unit cube, or in units of their spread.
    y : ndarray, shape (n,)
        In units of the response.

    Returns
    -------
    callable
        From points, shape (k, d), to responses, shape (k,).
    """
    center = y.mean()
    # A response that is constant has no spread to divide by.
    spread = y.std() or 1.0
    z = (y - center) / spread
    predict = _through(model, x, z)
    return _InUnits(predict, center, spread)


def _through(model: Any, x: Floats, z: Floats) -> Predict:
    """Return a surface, or what a regressor that was fitted predicts."""
    if isinstance(model, Surface):
        return model.through(x, z)
    regressor = copy.deepcopy(model)
    regressor.fit(x, z)
    predict: Predict = regressor.predict
    return predict


@dataclass(frozen=True, eq=False)
class _InUnits:
    """A surface through responses of unit spread, in the response's own units."""

    predict: Predict
    center: float
    spread: float

    def __call__(self, at: Floats) -> Floats:
        values = np.asarray(self.predict(at), dtype=np.float64)
        # Some regressors give a column.
        return np.asarray(self.center + self.spread * values.reshape(len(at)))
