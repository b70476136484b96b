"""Response surfaces: their protocol, polynomials, regressors of users, and a coarse response.

References
----------
.. [1] Kennedy, M. C. and A. O'Hagan (2000), Predicting the output from a complex computer code when
   fast approximations are available, Biometrika 87, doi:10.1093/biomet/87.1.1.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from math import comb
from typing import Any, Protocol

import numpy as np

from prbayes._validate import ArrayFunction, ArrayPair, Bools, Floats, positive_integer
from prbayes.emulators.kriging import Kriging, Polynomials, spread_of

Predict = ArrayFunction

# Ten folds, as recommended by Kohavi (1995), A study of cross-validation and bootstrap, IJCAI.
FOLDS = 10


class FittedSurface(Protocol):
    """A surface through one output of runs."""

    @property
    def left_out(self) -> Floats:
        """Error at each run of the surface without the run, (n,)."""

    @property
    def error(self) -> float:
        """Weighted root mean square of the left-out errors."""

    def __call__(self, z: Floats) -> ArrayPair:
        """Return values and Jacobian at points, (k, d) -> (k,), (k, d)."""

    def values(self, z: Floats) -> Floats:
        """Return values at points, (k, d) -> (k,)."""

    def variance(self, z: Floats) -> Floats:
        """Return predictive variances at points, (k, d) -> (k,)."""

    def without_each(self, masks: Bools) -> Sequence[FittedSurface]:
        """Return surfaces with the same settings that lack some runs each, (B, n)."""


class Surface(ABC):
    """A kind of response surface: `RadialBasis`, `Polynomial`, or one of your own.

    A surface of your own derives from it and defines ``terms`` and ``through``. Its Jacobian is a
    central difference, and its left-out errors are those of fits without each tenth of the runs;
    a surface with shorter ways to them defines ``fit``.

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
        """Return the least number of points for inputs of so many dimensions."""

    @abstractmethod
    def through(self, x: Floats, y: Floats) -> Predict:
        """Return the surface through points, or the least-squares surface.

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

    def fit(
        self, z: Floats, y: Floats, weights: Floats, start: Any = None, random_seed: int = 0
    ) -> FittedSurface | None:
        """Return the surface with its derivatives and errors; None if the runs determine none.

        Parameters
        ----------
        z : ndarray, shape (n, d)
        y : ndarray, shape (n,)
            Outputs of mean 0 and standard deviation 1.
        weights : ndarray, shape (n,)
            Weights of squared left-out errors, of sum one.
        start : FittedSurface, optional
            A surface through earlier runs, whose settings are near those of this one.
        random_seed : int
            Of the tenths of the runs that are left out.
        """
        if len(z) <= self.terms(z.shape[1]):
            return None
        order = np.random.default_rng(random_seed).permutation(len(z))
        folds = np.zeros((min(FOLDS, len(z)), len(z)), dtype=bool)
        for fold, rows in zip(folds, np.array_split(order, len(folds)), strict=True):
            fold[rows] = True
        return Refitted(self, z, y, folds, weights)

    def following(self) -> Sequence[Surface]:
        """Return the surfaces to try if the last input is a coarse response."""
        return self, Following(self)


class KernelSurface(Surface):
    """A surface of kernels, whose derivatives and left-out errors have formulas."""

    def through(self, x: Floats, y: Floats) -> Predict:
        """Return the surface."""
        surface = self.fit(x, y, np.full(len(x), 1 / len(x)))
        if surface is None:
            raise np.linalg.LinAlgError("interpolation: the points determine no surface")
        return surface.values

    @abstractmethod
    def fit(
        self, z: Floats, y: Floats, weights: Floats, start: Any = None, random_seed: int = 0
    ) -> Kriging | None:
        """Return the surface with its derivatives and errors; None if the runs determine none."""


@dataclass(frozen=True, eq=False)
class Refitted:
    """A surface of one output without a formula for its derivatives and left-out errors."""

    model: Surface
    z: Floats  # (n, d): inputs of the runs
    y: Floats  # (n,): output of the runs
    folds: Bools  # (B, n): which runs each fold leaves out
    weights: Floats  # (n,): weights of the runs' errors
    used: Bools | slice = slice(None)  # runs that the surface is fitted to

    @cached_property
    def predict(self) -> Predict:
        """The fitted surface."""
        return self.model.through(self.z[self.used], self.y[self.used])

    def values(self, z: Floats) -> Floats:
        """Return values at points, (k, d) -> (k,)."""
        # Some regressors return a column, (k, 1).
        return np.asarray(self.predict(z), dtype=np.float64).reshape(len(z))

    def __call__(self, z: Floats) -> ArrayPair:
        """Return values and central differences at points, (k, d) -> (k,), (k, d)."""
        steps = 1e-4 * np.diag(spread_of(self.z))
        ends = [(self.values(z + step), self.values(z - step)) for step in steps]
        slopes = [(a - b) / (2 * step.sum()) for (a, b), step in zip(ends, steps, strict=True)]
        return self.values(z), np.stack(slopes, axis=1)

    @cached_property
    def left_out(self) -> Floats:
        """Errors of surfaces without each fold of the runs, (n,)."""
        errors = self.y.copy()
        for fold, surface in zip(self.folds, self.without_each(self.folds), strict=True):
            errors[fold] -= surface.values(self.z[fold])
        return errors

    @property
    def error(self) -> float:
        """Weighted root mean square of the left-out errors."""
        return float(np.sqrt(self.weights @ self.left_out**2))

    def variance(self, z: Floats) -> Floats:
        """Return the squared left-out error, (k, d) -> (k,), zero at the runs.

        It grows with the squared distance to the nearest run, in units of that to its neighbour.
        """
        from scipy.spatial import cKDTree

        spread = spread_of(self.z)
        tree = cKDTree(self.z / spread)
        gaps = tree.query(tree.data, 2)[0][:, 1]
        distances, nearest = tree.query(z / spread)
        return np.asarray((self.error * distances / gaps[nearest]) ** 2)

    def without_each(self, masks: Bools) -> list[Refitted]:
        """Return surfaces that lack some runs each, (B, n)."""
        return [replace(self, used=~mask) for mask in masks]


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
        polynomials = Polynomials.of(x, self.degree)
        coefficients = np.linalg.lstsq(polynomials(x).T, y, rcond=None)[0]
        return partial(_polynomial, polynomials, coefficients)


def _polynomial(polynomials: Polynomials, coefficients: Floats, at: Floats) -> Floats:
    """Return the values of a polynomial at points, (k, d) -> (k,)."""
    step = 4096  # the terms of 4096 points fit into the processor's cache
    starts = range(0, len(at), step)
    blocks = [coefficients @ polynomials(at[start : start + step]) for start in starts]
    return np.concatenate([np.empty(0), *blocks])


@dataclass(frozen=True)
class Regressor(Surface):
    """A regressor of a user, with ``fit(X, y)`` and ``predict(X)``; a copy is fitted."""

    regressor: Any

    def terms(self, dimensions: int) -> int:
        """Return one: the least model of an unknown regressor is a constant."""
        return 1

    def through(self, x: Floats, y: Floats) -> Predict:
        """Return the predictions of a fitted copy."""
        regressor = copy.deepcopy(self.regressor)
        regressor.fit(x, y)
        predict: Predict = regressor.predict
        return predict


def as_surface(model: Any) -> Surface:
    """Return a surface as it is, and the surface of a regressor."""
    return model if isinstance(model, Surface) else Regressor(model)


@dataclass(frozen=True)
class Following(Surface):
    """A multiple of the last input, a coarse response, and a surface through the remainder."""

    rest: Surface

    def terms(self, dimensions: int) -> int:
        """Return the least number of points."""
        return max(self.rest.terms(dimensions - 1), dimensions)

    def through(self, x: Floats, y: Floats) -> Predict:
        """Return the surface, with the slope beside a plane."""
        columns = np.column_stack([np.ones(len(x)), x])
        rho = float(np.linalg.lstsq(columns, y, rcond=None)[0][-1])
        rest = self.rest.through(x[:, :-1], y - rho * x[:, -1])
        return partial(_followed, rho, rest)


def _followed(rho: float, rest: Predict, at: Floats) -> Floats:
    """Return rho times the last input plus a surface of the other inputs, (k, d) -> (k,)."""
    return rho * at[:, -1] + np.asarray(rest(at[:, :-1])).reshape(len(at))
