"""Kernels and polynomials through outputs of runs: Gaussian processes and radial basis functions.

A surface through outputs y_i at runs z_i is [1]_

    f(z) = sum_i w_i k(|z - z_i|^2) + sum_j c_j p_j(z),    sum_i w_i p_j(z_i) = 0,     (1)

with all Legendre polynomials p_j up to a degree, and distances in units of a length for each input.
A nugget on the diagonal of the kernel matrix K keeps it well conditioned where runs are close to
each other. With an orthonormal basis B of the polynomials at the runs, P = I - B B', and
Q = P (P K P)^+ P, the weights are w = Q y; the error at run i of the surface through all others is
w_i / Q_ii [2]_. The likelihood of lengths and nugget is that of the outputs' contrasts P y [3]_.

References
----------
.. [1] Wendland, H. (2005), Scattered Data Approximation, Cambridge University Press, ch. 8.
.. [2] Rippa, S. (1999), An algorithm for selecting a good value for the parameter c in radial basis
   function interpolation, Adv. Comput. Math. 11, 193-210, doi:10.1023/A:1018975909870.
.. [3] Rasmussen, C. E. and C. K. I. Williams (2006), Gaussian Processes for Machine Learning, MIT
   Press, ch. 2 and 5.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import comb
from typing import Any

import numpy as np
from numpy.polynomial.legendre import legder, legval
from scipy.linalg.lapack import dpotrf, dpotri, dpotrs

from prbayes._stats import positive_scale
from prbayes._validate import IN_CACHE, ArrayPair, Bools, Floats, Indices

# Largest number of runs of a surface, whose cost grows with the cube of this number.
MOST_RUNS = 2000
# Number of runs that are used to choose lengths and degrees.
MOST_TUNED = 256

# Function of squared distances, which it overwrites; returns the kernel and -2 dk / d(r^2).
Kernel = Callable[[Floats], tuple[Floats, Floats]]


def squared_exponential(square: Floats) -> ArrayPair:
    """Return the kernel exp(-r^2 / 2) of squared distances, and minus twice its slope."""
    square *= -0.5
    kernel = np.exp(square, out=square)
    return kernel, kernel


def matern(square: Floats) -> ArrayPair:
    """Return the Matern kernel of smoothness 5/2, and minus twice its slope."""
    square *= 5
    r = np.sqrt(square)
    slope = np.exp(-r)
    slope *= 5 / 3
    square /= 3
    square += r
    square += 1
    square *= slope
    square *= 3 / 5
    r += 1
    slope *= r
    return square, slope


def quintic(square: Floats) -> ArrayPair:
    """Return the kernel -r^5 of squared distances, and minus twice its slope."""
    slope = np.sqrt(square)
    slope *= square
    square *= slope
    slope *= 5
    return np.negative(square, out=square), slope


def cubic(square: Floats) -> ArrayPair:
    """Return the kernel r^3 of squared distances, and minus twice its slope."""
    slope = np.sqrt(square)
    square *= slope
    slope *= -3
    return square, slope


def thin_plate_spline(square: Floats) -> ArrayPair:
    """Return the kernel r^2 log r of squared distances, and minus twice its slope."""
    logs = np.log(np.maximum(square, 1e-300))
    square *= 0.5 * logs
    return square, -1 - logs


def linear(square: Floats) -> ArrayPair:
    """Return the kernel -r of squared distances, and minus twice its slope."""
    r = np.sqrt(square)
    return -r, 1 / np.maximum(r, 1e-12)


KERNELS: dict[str, Kernel] = {
    f.__name__: f for f in (squared_exponential, matern, linear, thin_plate_spline, cubic, quintic)
}


@dataclass(frozen=True, eq=False)
class Kriging:
    """A surface of one kernel through an output of runs, equation (1)."""

    z: Floats  # (n, d): inputs of the runs
    y: Floats  # (n,): output of the runs
    rows: Indices  # (n,): indices of these runs among all runs
    kernel: str
    lengths: Floats  # (d,): length scales, the units of distances
    degree: int  # degree of the polynomial
    nugget: float  # nugget in units of the largest kernel
    weights: Floats  # (n,): weights of the kernels
    coefficients: Floats  # (terms,): coefficients of the polynomials
    left_out: Floats  # cross-validation error at each of all runs
    error: float  # weighted root mean square of the cross-validation errors
    scale: float  # variance of the output in units of the kernel

    def __call__(self, z: Floats) -> ArrayPair:
        """Return values and Jacobian at points, (k, d) -> (k,), (k, d)."""
        if self._on_line is not None:
            series = self._on_line[1]
            polynomials = self.polynomials
            slopes = legval(polynomials.scaled(z)[0], legder(series)) / polynomials.half_width
            return self.values(z), (self._on_line[0](z[:, 0], 1) + slopes)[:, None]
        kernel, factors = KERNELS[self.kernel], self._factors[1]
        values, jacobian = np.empty(len(z)), np.empty(z.shape)
        for rows, points, square in self._distances(z):
            value, slope = kernel(square)
            steepness, *by_axis = factors @ slope
            values[rows] = steepness if value is slope else self.weights @ value
            jacobian[rows] = ((by_axis - points * steepness) / self.lengths[:, None]).T
            trend, slopes = polynomial_trend(self, z[rows])
            values[rows] += trend
            jacobian[rows] += slopes
        return values, jacobian

    def values(self, z: Floats) -> Floats:
        """Return values at points, (k, d) -> (k,)."""
        if self._on_line is not None:
            radial, series = self._on_line
            return np.asarray(radial(z[:, 0]) + legval(self.polynomials.scaled(z)[0], series))
        kernel, values = KERNELS[self.kernel], np.empty(len(z))
        for rows, _, square in self._distances(z):
            values[rows] = self.weights @ kernel(square)[0]
            values[rows] += polynomial_trend(self, z[rows])[0]
        return values

    def variance(self, z: Floats) -> Floats:
        """Return predictive variances at points, (k, d) -> (k,)."""
        from scipy.linalg import solve_triangular

        system, kernel = System.of_surface(self), KERNELS[self.kernel]
        factor = system.factor(self.nugget)
        assert factor is not None  # the factor exists, since the fit has solved the same system
        errors, at_zero = np.empty(len(z)), kernel(np.zeros(1))[0]
        for rows, _, square in self._distances(z):
            kernels = kernel(square)[0]  # (n, k)
            # The prediction is u' y with weights u of the runs. Its error has variance k(0) - 2 u'
            # k + u' K u. Exact polynomials require a part B t of u; the best other part is Q (k - K
            # B t).
            trend = system.basis @ np.linalg.solve(system.root.T, self.polynomials(z[rows]))
            rest = kernels - system.kernels @ trend
            errors[rows] = at_zero - (trend * (kernels + rest)).sum(axis=0)
            # The Cholesky factor is used, because the inverse has too few digits for this
            # difference.
            solved = solve_triangular(factor, system.contrasts(rest), lower=True)
            errors[rows] -= (solved**2).sum(axis=0)
        return np.maximum(errors, 0) * self.scale

    def without_each(self, masks: Bools) -> list[Kriging]:
        """Return the surfaces, of the same lengths, that lack some of all runs each, (B, ...)."""
        surfaces = []
        for mask in masks[:, self.rows]:
            part = replace(self, z=self.z[~mask], y=self.y[~mask], rows=self.rows[~mask])
            system = System.of_surface(part)
            factor = system.factor(self.nugget)
            if factor is None:
                raise np.linalg.LinAlgError("interpolation: the remaining runs are singular")
            weights, _ = system.weights(factor, part.y, self.nugget)
            coefficients = system.trend(part.y, weights)
            surfaces.append(replace(part, weights=weights, coefficients=coefficients))
        return surfaces

    @cached_property
    def polynomials(self) -> Polynomials:
        """The polynomials."""
        return Polynomials.of(self.z, self.degree)

    @cached_property
    def _factors(self) -> ArrayPair:
        """Factors of the runs in squared distances, (n, d + 2), and in slopes, (1 + d, n).

        The former are those of |a|^2 + |b|^2 - 2 a'b, the latter the weights of the runs, and their
        products with the scaled runs.
        """
        runs = (self.z - self.polynomials.center) / self.lengths
        of_runs = (runs**2).sum(axis=1, keepdims=True)
        squares = np.concatenate([-2 * runs, of_runs, np.ones((len(runs), 1))], axis=1)
        return squares, np.concatenate([self.weights[None], self.weights * runs.T])

    @cached_property
    def _quadratic_form(self) -> tuple[float, Floats, Floats]:
        """Constant, slopes, (d,), and second derivatives, (d, d), of polynomials of degree two."""
        return self.polynomials.quadratic_form(self.coefficients)

    @cached_property
    def _on_line(self) -> tuple[Any, Floats] | None:
        """Piecewise quintic of one input, and the Legendre series; None for other surfaces.

        Between two neighbouring runs the sum of all radial functions is a polynomial of degree
        five.
        """
        if self.kernel != "quintic" or self.z.shape[1] > 1:
            return None
        from scipy.interpolate import PPoly  # the import takes long

        order = np.argsort(self.z[:, 0])
        runs, weights = self.z[order, 0], self.weights[order] / self.lengths[0] ** 5
        ends = np.concatenate([runs[:1] - 1, runs, runs[-1:] + 1])
        distances = ends[:-1, None] - runs
        side = np.where(distances < 0, -1.0, 1.0)
        pieces = [-comb(5, p) * (side * distances**p) @ weights for p in range(6)]
        return PPoly(np.stack(pieces), ends), self.coefficients

    def _distances(self, z: Floats) -> Iterator[tuple[slice, Floats, Floats]]:
        """Yield the rows of blocks of points, the points (d, k), squared distances to runs (n, k).

        All blocks use the same array of distances, which stays in the processor's cache.
        """
        n = len(self.z)
        step = max(1, min(IN_CACHE // 2 // n, len(z)))
        array = np.empty(n * step)
        # Small distances lose digits by cancellation, which does not matter for predictions.
        for first in range(0, len(z), step):
            rows = slice(first, first + step)
            points = ((z[rows] - self.polynomials.center) / self.lengths).T
            point_factors = np.stack([*points, np.ones(points.shape[1]), (points**2).sum(axis=0)])
            square = array[: n * points.shape[1]].reshape(n, -1)
            np.matmul(self._factors[0], point_factors, out=square)
            yield rows, points, np.maximum(square, 0.0, out=square)


def polynomial_trend(surface: Kriging, z: Floats) -> ArrayPair:
    """Return values, (k,), and slopes, (k, d), of the polynomial at points, (k, d)."""
    polynomials = surface.polynomials
    if surface.degree <= 2:
        # A quadratic form takes less time than products of polynomials.
        constant, linear, hessian = surface._quadratic_form
        u = polynomials.scaled(z).T
        slopes = u @ hessian + linear
        values = constant + 0.5 * (u * (slopes + linear)).sum(axis=1)
        return values, slopes / polynomials.half_width
    single = polynomials.by_input(z)
    # Column p: Legendre series of the derivative of P_p.
    derivative = legder(np.eye(len(single)))
    slopes = np.empty(z.shape)
    for a, half_width in enumerate(polynomials.half_width):
        factors = single.copy()
        factors[:, a] = derivative.T @ single[:-1, a]
        slopes[:, a] = surface.coefficients @ polynomials.terms(factors) / half_width
    return surface.coefficients @ polynomials.terms(single), slopes


@dataclass(frozen=True, eq=False)
class Polynomials:
    """Products of Legendre polynomials up to a total degree, in a box scaled to [-1, 1]."""

    center: Floats  # (d,): center of the box
    half_width: Floats  # (d,): half of the box's width
    powers: Indices  # (terms, d): degrees of the factors of each term, in order of degree

    @classmethod
    def of(cls, z: Floats, degree: int) -> Polynomials:
        """Return all terms up to a degree, in the box of points (n, d)."""

        def rows(d: int, degree: int) -> list[tuple[int, ...]]:
            if d == 1:
                return [(p,) for p in range(degree + 1)]
            return [(p, *rest) for p in range(degree + 1) for rest in rows(d - 1, degree - p)]

        low, high = z.min(axis=0), z.max(axis=0)
        powers = np.array(sorted(rows(z.shape[1], degree), key=sum), dtype=np.intp)
        return cls((low + high) / 2, np.maximum((high - low) / 2, 1e-300), powers)

    def __call__(self, z: Floats) -> Floats:
        """Return all terms at points, (k, d) -> (terms, k)."""
        return self.terms(self.by_input(z))

    def scaled(self, z: Floats) -> Floats:
        """Return the variables of the polynomials, (k, d) -> (d, k)."""
        return np.ascontiguousarray(((z - self.center) / self.half_width).T)

    def quadratic_form(self, coefficients: Floats) -> tuple[float, Floats, Floats]:
        """Return constant, slopes, (d,), and second derivatives, (d, d), for a degree of two."""
        powers, degrees = self.powers, self.powers.sum(axis=1)
        # Squares are in the terms P_2(u) = (3 u^2 - 1) / 2.
        is_square, is_product = powers.max(axis=1) == 2, powers.max(axis=1) < degrees
        products = powers[is_product]
        hessian = (products * coefficients[is_product, None]).T @ products.astype(np.float64)
        of_squares = powers[is_square].T @ coefficients[is_square]
        np.fill_diagonal(hessian, 1.5 * of_squares)
        constant = coefficients[degrees == 0].sum() - 0.25 * of_squares.sum()
        return float(constant), powers[degrees == 1].T @ coefficients[degrees == 1], hessian

    def by_input(self, z: Floats) -> Floats:
        """Return the Legendre polynomials of each input, (degree + 1, d, k)."""
        u = self.scaled(z)
        single = np.ones((int(self.powers.max()) + 1, *u.shape))
        if len(single) > 1:
            single[1] = u
        # Recurrence of Legendre polynomials: p P_p = (2 p - 1) u P_{p-1} - (p - 1) P_{p-2}.
        for p in range(2, len(single)):
            np.multiply(single[p - 1], u, out=single[p])
            single[p] *= 2 * p - 1
            single[p] -= (p - 1) * single[p - 2]
            single[p] /= p
        return single

    def terms(self, single: Floats) -> Floats:
        """Return products of the polynomials of each input, (terms, k)."""
        terms: Floats = single[self.powers[:, 0], 0]
        for a in range(1, self.powers.shape[1]):
            terms *= single[self.powers[:, a], a]
        return terms


@dataclass(frozen=True, eq=False)
class System:
    """The linear system of outputs at runs."""

    kernels: Floats  # (n, n): kernel matrix K
    basis: Floats  # (n, p): orthonormal basis B of the polynomials at the runs
    root: Floats  # (p, p): B root is the matrix of the polynomials at the runs
    # (n, n): P K P + sigma B B' with P = I - B B', positive definite except for rounding.
    projected: Floats
    sigma: float  # upper bound of the largest eigenvalue of P K P
    unit: float  # largest kernel, the unit of nuggets

    @classmethod
    def of(cls, kernels: Floats, basis: Floats, root: Floats) -> System:
        """Project a kernel matrix."""
        products = basis.T @ kernels
        both = products @ basis
        sigma = max(float(np.trace(kernels) - np.trace(both)), 1e-300)
        half = basis @ (products - 0.5 * (both + sigma * np.eye(len(both))) @ basis.T)
        projected = kernels - half
        projected -= half.T
        return cls(kernels, basis, root, projected, sigma, float(np.abs(kernels).max()))

    @classmethod
    def of_surface(cls, surface: Kriging) -> System:
        """Return the system for the weights of the runs of a surface."""
        matrix = kernel_matrix(surface.kernel, surface.z / surface.lengths)
        return cls.of(matrix, *np.linalg.qr(surface.polynomials(surface.z).T))

    def factor(self, nugget: float) -> Floats | None:
        """Return the lower factor of the matrix with a nugget; None if it is singular."""
        matrix = self.projected.copy()
        np.einsum("ii->i", matrix)[...] += nugget * self.unit
        factor, singular = dpotrf(matrix, lower=True, clean=False)
        return None if singular else factor

    def inverse(self, factor: Floats, nugget: float) -> Floats:
        """Return Q from the lower factor."""
        inverse, _ = dpotri(factor, lower=True)
        full = np.tril(inverse) + np.tril(inverse, -1).T
        full -= (self.basis / (self.sigma + nugget * self.unit)) @ self.basis.T
        return np.asarray(full)

    def contrasts(self, y: Floats) -> Floats:
        """Return P y, (n,)."""
        return y - self.basis @ (self.basis.T @ y)

    def weights(self, factor: Floats, y: Floats, nugget: float) -> tuple[Floats, Floats]:
        """Return the weights of outputs, (n,), and the last step of their refinement, (n,)."""
        step = weights = np.zeros(len(y))
        contrasts = self.contrasts(y)
        # The first solution is followed by two steps of iterative refinement, because close runs
        # make the matrix badly conditioned.
        for _ in range(3):
            rest = contrasts - self.kernels @ weights - nugget * self.unit * weights
            step = self.contrasts(dpotrs(factor, self.contrasts(rest), lower=True)[0])
            weights = weights + step
        return weights, step

    def trend(self, y: Floats, weights: Floats) -> Floats:
        """Return the coefficients of the polynomials, (p,)."""
        rest = self.basis.T @ (y - self.kernels @ weights)
        return np.linalg.solve(self.root, rest)


def kernel_matrix(kernel: str, scaled: Floats) -> Floats:
    """Return the kernels of all pairs of points in units of lengths, (n, d) -> (n, n)."""
    square = np.zeros((len(scaled), len(scaled)))
    # Differences are squared directly, because the expanded product loses digits of small
    # distances.
    for column in scaled.T:
        square += (column[:, None] - column) ** 2
    return KERNELS[kernel](square)[0]


def determine(terms: Floats) -> bool:
    """Return whether runs determine polynomials, (p, n), and leave some to estimate an error."""
    if terms.shape[0] >= terms.shape[1]:
        return False
    sizes = np.abs(np.diag(np.linalg.qr(terms.T, mode="r")))
    return bool(sizes.min() > 1e-10 * sizes.max())


def spread_of(z: Floats) -> Floats:
    """Return the standard deviation of each input, (n, d) -> (d,), or one if it is constant."""
    spread = z.std(axis=0)
    return positive_scale(spread)


def spread_rows(weights: Floats, most: int) -> Indices:
    """Return at most so many runs: half are those of the largest weights, others are spread."""
    n = len(weights)
    if n <= most:
        return np.arange(n)
    order = np.argsort(-weights, kind="stable")
    n_important = min(most // 2, int((weights > weights.mean()).sum()))
    spread = np.linspace(n_important, n - 1, most - n_important).astype(int)
    # The other runs are taken in their order, so that runs of equal weights are spread evenly over
    # the sequence.
    rest = np.sort(order[n_important:])[spread - n_important]
    return np.sort(np.concatenate([order[:n_important], rest]))


def fit_kriging(
    z: Floats,
    y: Floats,
    weights: Floats,
    kernel: str,
    lengths: Floats,
    degrees: Sequence[int],
    nuggets: Sequence[float],
) -> Kriging | None:
    """Return the surface of the degree and nugget with the least left-out errors.

    Points (n, d) have outputs (n,) of spread about one; ``weights``, (n,), of sum one, are those
    of squared left-out errors. Nuggets are in units of the largest kernel. Of too many runs a
    part has the surface, and the others only test it. None if no system can be solved.
    """
    rows = spread_rows(weights, MOST_RUNS)
    runs, outputs, weights = z[rows], y[rows], weights[rows] / weights[rows].sum()
    matrix = kernel_matrix(kernel, runs / lengths)
    best, least = None, np.inf
    for degree in degrees:
        terms = Polynomials.of(runs, degree)(runs)
        if not determine(terms):
            continue
        system = System.of(matrix, *np.linalg.qr(terms.T))
        for nugget in nuggets:
            factor = system.factor(nugget)
            if factor is None:
                continue
            w, step = system.weights(factor, outputs, nugget)
            precisions = np.diag(system.inverse(factor, nugget))
            left_out = w / precisions
            # Cross-validation errors are too small if the matrix is singular to rounding. Large
            # weights make the surface rough by rounding, which disturbs the search of roots. Both
            # add to the error.
            unsolved = np.abs(step / precisions).max()
            rounding = np.finfo(float).eps * system.unit * np.linalg.norm(w)
            error = float(np.sqrt(weights @ left_out**2) + unsolved + 100 * rounding)
            if error < 0.9 * least:
                least = error
                best = Kriging(
                    *(runs, outputs, rows, kernel, lengths, degree, nugget, w),
                    *(system.trend(outputs, w), left_out, error),
                    scale=float(weights @ (left_out**2 * precisions)),
                )
    if best is None or len(rows) == len(z):
        return best
    errors = y - best.values(z)
    errors[rows] = best.left_out
    return replace(best, left_out=errors)


def likeliest(
    kernel: str, x: Floats, y: Floats, terms: Floats, start: Floats | None = None
) -> Floats:
    """Return log lengths and log nugget, (d + 1,), that maximise the likelihood of contrasts.

    Points (n, d) have spread one, outputs (n,), and polynomials (p, n). The search starts from the
    likelier one of ``start``, (d + 1,), and of equal lengths; without it, from the likeliest equal
    lengths with little and much noise, since long lengths alone miss a resonance, and short ones
    alone a near-polynomial.
    """
    from scipy.optimize import minimize as scipy_minimize

    d = x.shape[1]
    bounds = [(np.log(0.05), np.log(200))] * d + [(np.log(1e-9), np.log(0.1))]
    low, high = np.array(bounds).T
    basis, root = np.linalg.qr(terms.T)
    problem = KERNELS[kernel], x, y - basis @ (basis.T @ y), basis, root

    def value(parameters: Floats) -> float:
        return negative_log_likelihood(parameters, *problem)[0]

    equal = [
        [np.log([*[length * np.sqrt(d)] * d, noise]) for length in (0.35, 0.7, 1.4, 2.8)]
        for noise in (1e-7, 1e-3)
    ]
    starts = [min(group, key=value) for group in equal]
    if start is not None:
        starts = [min([*starts, np.clip(start, low, high)], key=value)]
    fits = [
        scipy_minimize(
            negative_log_likelihood,
            start,
            args=problem,
            jac=True,
            bounds=bounds,
            method="L-BFGS-B",
            options={"ftol": 1e-6, "maxiter": 60},
        )
        for start in starts
    ]
    return np.asarray(min(fits, key=lambda fit: float(fit.fun)).x)


def negative_log_likelihood(
    parameters: Floats, kernel: Kernel, x: Floats, y: Floats, basis: Floats, root: Floats
) -> tuple[float, Floats]:
    """Return minus the log posterior density of log lengths and log nugget, and its gradient.

    The density of contrasts y, (n,), is profiled over their variance. Log lengths have a weak
    normal prior around that of a nearly quadratic response.
    """
    n, p = basis.shape
    d = x.shape[1]
    nugget = float(np.exp(parameters[-1]))
    scaled = x / np.exp(parameters[:-1])
    of_points = (scaled**2).sum(axis=1)
    square = np.maximum(of_points[:, None] + of_points - 2 * scaled @ scaled.T, 0)
    np.einsum("ii->i", square)[...] = 0
    kernels, slope = kernel(square)
    system = System.of(kernels, basis, root)
    factor = system.factor(nugget)
    if factor is None:
        return 1e10, np.zeros(d + 1)
    log_determinant = np.log(np.diag(factor)).sum() - 0.5 * p * np.log(system.sigma + nugget)
    inverse = system.inverse(factor, nugget)
    weights = inverse @ y
    variance = max(float(y @ weights) / (n - p), 1e-300)
    outer = np.outer(weights, weights / variance) - inverse
    of_nugget = 0.5 * nugget * np.trace(outer)
    outer *= slope
    of_lengths = outer.sum(axis=1) @ scaled**2 - ((outer @ scaled) * scaled).sum(axis=0)
    away = (parameters[:-1] - np.log(2 * np.sqrt(d))) / 1.5
    value = 0.5 * (n - p) * np.log(variance) + log_determinant + 0.5 * float(away @ away)
    gradient = -np.append(of_lengths, of_nugget)
    gradient[:-1] += away / 1.5
    return float(value), gradient
