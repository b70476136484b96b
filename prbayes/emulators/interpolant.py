"""Quintic radial basis interpolation with a polynomial, its Jacobian and left-out errors.

The interpolant of values y_i at points z_i is [1]_

    f(z) = -sum_i w_i |z - z_i|^5 + sum_j c_j p_j(z),    sum_i w_i p_j(z_i) = 0,

with all polynomials p_j up to a degree. A nugget on the diagonal of the interpolation matrix keeps
it well conditioned where runs are close to each other. The error at a point that is left out needs
no other fit: it is w_i divided by the i-th diagonal element of the inverse of the matrix [2]_. It
selects degree and nugget.

References
----------
.. [1] Wendland, H. (2005), Scattered Data Approximation, Cambridge University Press, ch. 8.
.. [2] Rippa, S. (1999), An algorithm for selecting a good value for the parameter c in radial basis
   function interpolation, Adv. Comput. Math. 11, 193-210, doi:10.1023/A:1018975909870.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from math import comb
from typing import Any

import numpy as np
from numpy.polynomial.legendre import legder, legval
from numpy.typing import NDArray
from scipy.linalg.lapack import dsytrf, dsytri, dsytrs

from prbayes._validate import IN_CACHE, Floats
from prbayes.numerics.threads import one_thread


@dataclass(frozen=True, eq=False)
class Interpolant:
    """A smooth surface through the outputs of runs."""

    z: Floats  # (n, d): points of the runs
    weights: Floats  # (n, m): of the radial functions
    coefficients: Floats  # (terms, m): of the polynomial
    center: Floats  # (d,): of the box in which variables are scaled to [-1, 1]
    half_width: Floats  # (d,)
    powers: NDArray[np.intp]  # (terms, d): degrees of the Legendre polynomials of each term
    left_out: Floats  # (n, m): error at each run of the interpolant of all others

    def __call__(self, z: Floats) -> tuple[Floats, Floats]:
        """Return values and Jacobian at points, (k, d) -> (k, m), (k, m, d)."""
        m, d = self.weights.shape[1], self.z.shape[1]
        if d == 1:
            return self.values(z), self._slopes_on_line(z)[..., None]
        values = np.empty((len(z), m))
        jacobian = np.empty((len(z), m, d))
        moments = [self.weights, *(column[:, None] * self.weights for column in self.z.T)]
        # d|r|^5 / dz_a = 5 |r|^3 r_a
        of_cubes = 5 * np.concatenate(moments, axis=1).T
        derivative = legder(np.eye(int(self.powers.max()) + 1))  # columns of Legendre series
        for rows, square, cube in self._distances(z):
            np.sqrt(square, out=cube)
            cube *= square
            single = _legendre(self._scaled(z[rows]), self.powers)
            polynomial = self.coefficients.T @ _terms(single, self.powers)
            steepness, *by_axis = (of_cubes @ cube).reshape(d + 1, m, -1)
            square *= cube
            values[rows] = (polynomial - self.weights.T @ square).T
            for a in range(d):
                factors = single.copy()
                factors[:, a] = derivative.T @ single[:-1, a]
                slope = self.coefficients.T @ _terms(factors, self.powers) / self.half_width[a]
                jacobian[rows, :, a] = (by_axis[a] - z[rows, a] * steepness + slope).T
        return values, jacobian

    def values(self, z: Floats) -> Floats:
        """Return values at points, (k, d) -> (k, m), without the Jacobian."""
        if self.z.shape[1] == 1:
            radial, polynomial = self._on_line
            return np.asarray(radial(z[:, 0]) + legval(self._scaled(z)[0], polynomial).T)
        values = np.empty((len(z), self.weights.shape[1]))
        for rows, square, length in self._distances(z):
            np.sqrt(square, out=length)
            square *= square
            square *= length
            terms = _terms(_legendre(self._scaled(z[rows]), self.powers), self.powers)
            values[rows] = (self.coefficients.T @ terms - self.weights.T @ square).T
        return values

    @cached_property
    def _on_line(self) -> tuple[Any, Floats]:
        """The radial functions of one input, and the Legendre series of the polynomial.

        Between two runs the radial functions are a polynomial of degree five.
        """
        from scipy.interpolate import PPoly  # takes long to import

        order = np.argsort(self.z[:, 0])
        runs, weights = self.z[order, 0], self.weights[order]
        ends = np.concatenate([runs[:1] - 1, runs, runs[-1:] + 1])
        distances = ends[:-1, None] - runs
        side = np.where(distances < 0, -1.0, 1.0)
        pieces = [-comb(5, p) * (side * distances**p) @ weights for p in range(6)]
        series = np.zeros_like(self.coefficients)
        series[self.powers[:, 0]] = self.coefficients
        return PPoly(np.stack(pieces), ends), series

    def _slopes_on_line(self, z: Floats) -> Floats:
        """Return derivatives at points of one input, (k, 1) -> (k, m)."""
        radial, polynomial = self._on_line
        slopes = legval(self._scaled(z)[0], legder(polynomial)).T / self.half_width
        return np.asarray(radial(z[:, 0], 1) + slopes)

    def _scaled(self, z: Floats) -> Floats:
        """Return the polynomial's variables, (k, d) -> (d, k)."""
        return np.ascontiguousarray(((z - self.center) / self.half_width).T)

    def _distances(self, z: Floats) -> Iterator[tuple[slice, Floats, Floats]]:
        """Yield the rows of a block of points, squared distances to the runs (n, k), and a spare.

        The two arrays are reused and stay in the cache of the processor.
        """
        n = len(self.z)
        step = max(1, min(IN_CACHE // 2 // n, len(z)))
        arrays = np.empty((2, n * step))
        runs = self.z - self.center
        # |a - b|^2 = |a|^2 + |b|^2 - 2 a'b; the digits that small ones lose do not matter in |r|^5.
        ones = np.ones((n, 1))
        run_factors = np.concatenate(
            [-2 * runs, (runs**2).sum(axis=1, keepdims=True), ones], axis=1
        )
        for first in range(0, len(z), step):
            rows = slice(first, first + step)
            points = (z[rows] - self.center).T
            point_factors = np.stack([*points, np.ones(points.shape[1]), (points**2).sum(axis=0)])
            square, spare = arrays[:, : n * points.shape[1]].reshape(2, n, -1)
            np.matmul(run_factors, point_factors, out=square)
            yield rows, np.maximum(square, 0.0, out=square), spare


@one_thread()
def fit_interpolant(z: Floats, y: Floats, near: NDArray[np.bool_] | None = None) -> Interpolant:
    """Fit the interpolant of outputs (n, m) at points (n, d) with the smallest left-out errors.

    The points differ; their units are such that the response varies about equally with each
    coordinate. ``near``, (n,), are the runs whose left-out errors count; all by default. Raises
    numpy.linalg.LinAlgError if the points do not determine a polynomial of degree two.

    >>> import numpy as np
    >>> z = np.linspace(-1, 1, 24)[:, None]
    >>> values, jacobian = fit_interpolant(z, np.exp(z))(np.array([[0.5]]))
    >>> bool(np.isclose(values, np.exp(0.5))), bool(np.isclose(jacobian, np.exp(0.5)))
    (True, True)
    """
    n, d = z.shape
    low, high = z.min(axis=0), z.max(axis=0)
    center, half_width = (low + high) / 2, np.maximum((high - low) / 2, 1e-300)
    scaled = np.ascontiguousarray(((z - center) / half_width).T)
    # By differences, since products lose digits of small distances.
    square = np.zeros((n, n))
    for column in z.T:
        square += (column[:, None] - column) ** 2
    radial = -(square**2) * np.sqrt(square)
    largest = -radial.min()
    spread = np.where(y.std(axis=0) > 0, y.std(axis=0), 1.0)
    rows = slice(None) if near is None else near
    best, least = None, np.inf
    for degree in _degrees(n, d):
        powers = _powers(d, degree)
        terms = _terms(_legendre(scaled, powers), powers).T
        target = np.concatenate([y, np.zeros((len(powers), y.shape[1]))])
        matrix = np.block([[radial, terms], [terms.T, np.zeros((len(powers),) * 2)]])
        for nugget in (1e-16, 1e-14, 1e-12, 1e-10, 1e-8):
            np.fill_diagonal(matrix[:n, :n], nugget * largest)
            # Symmetric and indefinite: half the time of a general inverse.
            factors, pivots, singular = dsytrf(matrix, lower=True)
            if singular:
                continue
            inverse, _ = dsytri(factors, pivots, lower=True)
            # One step of iterative refinement: close runs make the matrix badly conditioned.
            solution, _ = dsytrs(factors, pivots, target, lower=True)
            solution += dsytrs(factors, pivots, target - matrix @ solution, lower=True)[0]
            unsolved = np.abs((target - matrix @ solution)[:n] / spread).max()
            left_out = solution[:n] / np.diag(inverse)[:n, None]
            # Left-out errors are too small where the matrix is singular to rounding; the error at
            # the runs is added.
            error = float(np.sqrt(((left_out[rows] / spread) ** 2).mean()) + unsolved)
            if error < least:
                least = error
                best = Interpolant(
                    z=z,
                    weights=solution[:n],
                    coefficients=solution[n:],
                    center=center,
                    half_width=half_width,
                    powers=powers,
                    left_out=left_out,
                )
    if best is None:
        raise np.linalg.LinAlgError(
            f"interpolation: got {n} points that determine no surface of {d} inputs"
        )
    return best


def _degrees(n: int, d: int) -> list[int]:
    """Return degrees of polynomials with at most a third as many terms as points."""
    return [2, *(p for p in range(3, 17) if 3 * comb(d + p, d) <= n)]


def _powers(d: int, degree: int) -> NDArray[np.intp]:
    """Return the degrees by coordinate of all terms up to a total degree, (terms, d)."""

    def rows(d: int, degree: int) -> list[tuple[int, ...]]:
        if d == 1:
            return [(p,) for p in range(degree + 1)]
        return [(p, *rest) for p in range(degree + 1) for rest in rows(d - 1, degree - p)]

    return np.array(rows(d, degree), dtype=np.intp)


def _legendre(u: Floats, powers: NDArray[np.intp]) -> Floats:
    """Return the Legendre polynomials of each variable, (degree + 1, d, k)."""
    single = np.ones((int(powers.max()) + 1, *u.shape))
    single[1] = u
    # p P_p = (2 p - 1) u P_{p-1} - (p - 1) P_{p-2}
    for p in range(2, len(single)):
        np.multiply(single[p - 1], u, out=single[p])
        single[p] *= 2 * p - 1
        single[p] -= (p - 1) * single[p - 2]
        single[p] /= p
    return single


def _terms(single: Floats, powers: NDArray[np.intp]) -> Floats:
    """Return products of Legendre polynomials, (terms, k)."""
    terms: Floats = single[powers[:, 0], 0]
    for a in range(1, powers.shape[1]):
        terms *= single[powers[:, a], a]
    return terms
