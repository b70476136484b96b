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
from functools import cached_property, partial
from math import comb
from typing import Any

import numpy as np
from numpy.polynomial.legendre import legder, legval
from numpy.typing import NDArray
from scipy.linalg.lapack import dpotrf, dpotri

from prbayes._validate import IN_CACHE, Floats

# Runs of a surface, whose cost grows with their cube.
MOST_RUNS = 2000
# Runs for the choice of lengths and degrees.
MOST_TUNED = 256

# From squared distances, which are overwritten, to the kernel and minus twice its slope.
Kernel = Callable[[Floats], tuple[Floats, Floats]]


def squared_exponential(square: Floats) -> tuple[Floats, Floats]:
    """Return the kernel exp(-r^2 / 2) of squared distances, and minus twice its slope."""
    square *= -0.5
    kernel = np.exp(square, out=square)
    return kernel, kernel


def matern(square: Floats) -> tuple[Floats, Floats]:
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


def quintic(square: Floats) -> tuple[Floats, Floats]:
    """Return the kernel -r^5 of squared distances, and minus twice its slope."""
    slope = np.sqrt(square)
    slope *= square
    square *= slope
    slope *= 5
    return np.negative(square, out=square), slope


def cubic(square: Floats) -> tuple[Floats, Floats]:
    """Return the kernel r^3 of squared distances, and minus twice its slope."""
    slope = np.sqrt(square)
    square *= slope
    slope *= -3
    return square, slope


def thin_plate_spline(square: Floats) -> tuple[Floats, Floats]:
    """Return the kernel r^2 log r of squared distances, and minus twice its slope."""
    logs = np.log(np.maximum(square, 1e-300))
    square *= 0.5 * logs
    return square, -1 - logs


def linear(square: Floats) -> tuple[Floats, Floats]:
    """Return the kernel -r of squared distances, and minus twice its slope; none at zero."""
    r = np.sqrt(square)
    return -r, np.divide(1.0, r, out=np.zeros_like(r), where=r > 1e-12)


KERNELS: dict[str, Kernel] = {
    f.__name__: f for f in (squared_exponential, matern, linear, thin_plate_spline, cubic, quintic)
}


@dataclass(frozen=True, eq=False)
class Kriging:
    """A surface of one kernel through outputs of runs, equation (1)."""

    z: Floats  # (n, d): runs
    y: Floats  # (n, m): their outputs
    rows: NDArray[np.intp]  # (n,): indices among all runs
    kernel: str
    lengths: Floats  # (d,): units of distances
    degree: int  # degree of the polynomial
    nugget: float  # in units of the largest kernel
    weights: Floats  # (n, m)
    coefficients: Floats  # (terms, m)
    left_out: Floats  # error at each of all runs of the surface without the run, by output
    errors: Floats  # (m,): weighted root mean square of the left-out errors
    scales: Floats  # (m,): variance of each output in units of the kernel

    def __call__(self, z: Floats) -> tuple[Floats, Floats]:
        """Return values and Jacobian at points, (k, d) -> (k, m), (k, m, d)."""
        m, d = self.weights.shape[1], self.z.shape[1]
        if self._on_line is not None:
            return self.values(z), self._slopes_on_line(z)[..., None]
        kernel, runs = KERNELS[self.kernel], self._scaled_runs
        values, jacobian = np.empty((len(z), m)), np.empty((len(z), m, d))
        moments = [self.weights, *(column[:, None] * self.weights for column in runs.T)]
        factors = np.concatenate(moments, axis=1).T
        for rows, points, square in self._distances(z):
            value, slope = kernel(square)
            steepness, *by_axis = (factors @ slope).reshape(d + 1, m, -1)
            values[rows] = (steepness if value is slope else self.weights.T @ value).T
            for a, length in enumerate(self.lengths):
                jacobian[rows, :, a] = ((by_axis[a] - points[a] * steepness) / length).T
            self._add_polynomial(z[rows], values[rows], jacobian[rows])
        return values, jacobian

    def values(self, z: Floats) -> Floats:
        """Return values at points, (k, d) -> (k, m)."""
        if self._on_line is not None:
            radial, series = self._on_line
            return np.asarray(radial(z[:, 0]) + legval(self.polynomials.scaled(z)[0], series).T)
        kernel = KERNELS[self.kernel]
        values = np.empty((len(z), self.weights.shape[1]))
        for rows, _, square in self._distances(z):
            values[rows] = (self.weights.T @ kernel(square)[0]).T
            self._add_polynomial(z[rows], values[rows], None)
        return values

    def variance(self, z: Floats) -> Floats:
        """Return predictive variances at points, (k, d) -> (k, m)."""
        system, kernel = self._system(), KERNELS[self.kernel]
        errors, at_zero = np.empty(len(z)), kernel(np.zeros(1))[0]
        for rows, _, square in self._distances(z):
            kernels = kernel(square)[0]  # (n, k)
            # The prediction is u' y, and its error has variance k(0) - 2 u' k + u' K u. The
            # polynomials determine a part B t of u; the best other part is Q (k - K B t).
            trend = system.basis @ np.linalg.solve(system.root.T, self.polynomials(z[rows]))
            rest = kernels - system.matrix @ trend
            errors[rows] = at_zero - (trend * (kernels + rest)).sum(axis=0)
            errors[rows] -= (rest * (system.inverse @ rest)).sum(axis=0)
        return np.maximum(errors, 0)[:, None] * self.scales

    def without_each(self, masks: NDArray[np.bool_]) -> list[Kriging]:
        """Return the surfaces, of the same lengths, that lack some of all runs each, (B, ...).

        A surface without runs is the one through their left-out predictions in their place.
        """
        system, surfaces = self._system(), []
        for mask in masks[:, self.rows]:
            y = self.y.copy()
            among = system.inverse[np.ix_(mask, mask)]
            y[mask] -= np.linalg.solve(among, (system.inverse @ y)[mask])
            weights = system.inverse @ off_basis(system.basis, y)
            weights[mask] = 0
            coefficients = system.trend(y, weights)
            surfaces.append(replace(self, weights=weights, coefficients=coefficients))
        return surfaces

    def in_units(self, unit: float) -> Kriging:
        """Return the surface of outputs that are larger by a factor."""
        linear: dict[str, Any] = {
            name: getattr(self, name) * unit
            for name in ("y", "weights", "coefficients", "left_out", "errors")
        }
        return replace(self, scales=self.scales * unit**2, **linear)

    def joined(self, more: Kriging) -> Kriging | None:
        """Return the surface of the outputs of both; None if their kernels or systems differ."""
        same = ("kernel", "degree", "nugget")
        if any(getattr(self, name) != getattr(more, name) for name in same):
            return None
        if not np.array_equal(self.lengths, more.lengths):
            return None
        by_output = ("y", "weights", "coefficients", "left_out", "errors", "scales")
        parts: dict[str, Any] = {
            name: np.concatenate([getattr(self, name), getattr(more, name)], axis=-1)
            for name in by_output
        }
        return replace(self, **parts)

    def _system(self) -> System:
        """Return the linear system of the outputs."""
        matrix = kernel_matrix(self.kernel, self.z / self.lengths)
        polynomials = self.polynomials(self.z)
        system = System.of(matrix, polynomials, self.nugget)
        if system is None:
            raise np.linalg.LinAlgError(f"interpolation: {len(self.z)} runs are singular")
        return system

    @cached_property
    def polynomials(self) -> Polynomials:
        """The polynomials."""
        return Polynomials.of(self.z, self.degree)

    @cached_property
    def _scaled_runs(self) -> Floats:
        """The runs in units of lengths around the center, (n, d)."""
        return np.asarray((self.z - self.polynomials.center) / self.lengths)

    @cached_property
    def _on_line(self) -> tuple[Any, Floats] | None:
        """The quintic functions of one input, and the Legendre series; None for other surfaces.

        Between two runs these radial functions are a polynomial of degree five.
        """
        if self.kernel != "quintic" or self.z.shape[1] > 1:
            return None
        from scipy.interpolate import PPoly  # takes long to import

        order = np.argsort(self.z[:, 0])
        runs, weights = self.z[order, 0], self.weights[order] / self.lengths**5
        ends = np.concatenate([runs[:1] - 1, runs, runs[-1:] + 1])
        distances = ends[:-1, None] - runs
        side = np.where(distances < 0, -1.0, 1.0)
        pieces = [-comb(5, p) * (side * distances**p) @ weights for p in range(6)]
        return PPoly(np.stack(pieces), ends), self.coefficients

    def _slopes_on_line(self, z: Floats) -> Floats:
        """Return derivatives at points of one input, (k, 1) -> (k, m)."""
        assert self._on_line is not None
        radial, series = self._on_line
        polynomials = self.polynomials
        slopes = legval(polynomials.scaled(z)[0], legder(series)).T / polynomials.half_width
        return np.asarray(radial(z[:, 0], 1) + slopes)

    def _add_polynomial(self, z: Floats, values: Floats, jacobian: Floats | None) -> None:
        """Add the polynomial to values (k, m) and Jacobian (k, m, d) at points (k, d)."""
        polynomials = self.polynomials
        single = polynomials.by_input(z)
        values += (self.coefficients.T @ polynomials.terms(single)).T
        if jacobian is None:
            return
        if len(single) == 2:  # constant slopes
            linear = self.coefficients[polynomials.powers.argmax(axis=0)]
            jacobian += (linear / polynomials.half_width[:, None]).T
            return
        derivative = legder(np.eye(len(single)))  # columns of Legendre series
        for a, half_width in enumerate(polynomials.half_width):
            factors = single.copy()
            factors[:, a] = derivative.T @ single[:-1, a]
            jacobian[:, :, a] += (self.coefficients.T @ polynomials.terms(factors)).T / half_width

    def _distances(self, z: Floats) -> Iterator[tuple[slice, Floats, Floats]]:
        """Yield rows of a block of points, the points (d, k) and squared distances to runs (n, k).

        The array of distances is reused, and stays in the cache of the processor.
        """
        runs, n = self._scaled_runs, len(self.z)
        step = max(1, min(IN_CACHE // 2 // n, len(z)))
        array = np.empty(n * step)
        # |a - b|^2 = |a|^2 + |b|^2 - 2 a'b; the digits that small ones lose do not matter.
        ones, of_runs = np.ones((n, 1)), (runs**2).sum(axis=1, keepdims=True)
        run_factors = np.concatenate([-2 * runs, of_runs, ones], axis=1)
        for first in range(0, len(z), step):
            rows = slice(first, first + step)
            points = ((z[rows] - self.polynomials.center) / self.lengths).T
            point_factors = np.stack([*points, np.ones(points.shape[1]), (points**2).sum(axis=0)])
            square = array[: n * points.shape[1]].reshape(n, -1)
            np.matmul(run_factors, point_factors, out=square)
            yield rows, points, np.maximum(square, 0.0, out=square)


@dataclass(frozen=True, eq=False)
class Polynomials:
    """Products of Legendre polynomials up to a total degree, in a box scaled to [-1, 1]."""

    center: Floats  # (d,)
    half_width: Floats  # (d,)
    powers: NDArray[np.intp]  # (terms, d): degrees of the factors of each term, in order of degree

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

    def by_input(self, z: Floats) -> Floats:
        """Return the Legendre polynomials of each input, (degree + 1, d, k)."""
        u = self.scaled(z)
        single = np.ones((int(self.powers.max()) + 1, *u.shape))
        if len(single) > 1:
            single[1] = u
        # p P_p = (2 p - 1) u P_{p-1} - (p - 1) P_{p-2}
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

    matrix: Floats  # (n, n): K
    nugget: float  # in units of K
    basis: Floats  # (n, p): B
    root: Floats  # (p, p): B root are the polynomials at the runs
    inverse: Floats  # (n, n): Q

    @classmethod
    def of(
        cls, matrix: Floats, terms: Floats, nugget: float, projected: Projected | None = None
    ) -> System | None:
        """Solve the system of polynomials (p, n) at runs; None if it is singular to rounding.

        The nugget is in units of the largest kernel.
        """
        basis, root = np.linalg.qr(terms.T)
        nugget *= float(np.abs(matrix).max())
        projected = Projected.of(matrix, basis) if projected is None else projected
        inverse = projected.solved(nugget)
        return None if inverse is None else cls(matrix, nugget, basis, root, inverse)

    def trend(self, y: Floats, weights: Floats) -> Floats:
        """Return the coefficients of the polynomials, (p, m)."""
        rest = y - self.matrix @ weights - self.nugget * weights
        return np.asarray(np.linalg.solve(self.root, self.basis.T @ rest))


@dataclass(frozen=True, eq=False)
class Projected:
    """A kernel matrix on the complement of polynomials, P K P + sigma B B'."""

    matrix: Floats  # (n, n), positive definite but for rounding
    basis: Floats  # (n, p): B
    sigma: float  # at least the largest eigenvalue of P K P

    @classmethod
    def of(cls, kernels: Floats, basis: Floats) -> Projected:
        """Project a kernel matrix, (n, n)."""
        products = basis.T @ kernels
        both = products @ basis
        sigma = float(np.trace(kernels) - np.trace(both))
        sigma = max(sigma, 1e-300)
        half = basis @ (products - 0.5 * (both + sigma * np.eye(len(both))) @ basis.T)
        matrix = kernels - half
        matrix -= half.T
        return cls(matrix, basis, sigma)

    def solved(self, nugget: float) -> Floats | None:
        """Return Q, (n, n); None if the matrix is singular to rounding."""
        root = self.root(nugget)
        return None if root is None else self.inverse(root, nugget)

    def root(self, nugget: float) -> Floats | None:
        """Return the lower root of the matrix with a nugget; None if it is singular."""
        matrix = self.matrix.copy()
        np.einsum("ii->i", matrix)[...] += nugget
        root, singular = dpotrf(matrix, lower=True, clean=False)
        return None if singular else root

    def inverse(self, root: Floats, nugget: float) -> Floats:
        """Return Q from the lower root."""
        inverse, _ = dpotri(root, lower=True)
        lower = np.tril(inverse, -1)
        full = lower + lower.T
        np.einsum("ii->i", full)[...] = np.einsum("ii->i", inverse)
        full -= (self.basis / (self.sigma + nugget)) @ self.basis.T
        return np.asarray(full)


def kernel_matrix(kernel: str, scaled: Floats) -> Floats:
    """Return the kernels of all pairs of points in units of lengths, (n, d) -> (n, n)."""
    square = np.zeros((len(scaled), len(scaled)))
    # By differences, since products lose digits of small distances.
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
    return np.where(spread > 0, spread, 1.0)


def values_of_one(surfaces: Sequence[Kriging]) -> Callable[[Floats], Floats]:
    """Return the values of the surface of one output, (k, d) -> (k,)."""
    if not surfaces:
        raise np.linalg.LinAlgError("interpolation: the points determine no surface")
    return partial(_column, surfaces[0])


def _column(surface: Kriging, at: Floats) -> Floats:
    return surface.values(at)[:, 0]


def off_basis(basis: Floats, y: Floats) -> Floats:
    """Return outputs (n, ...) less their part in an orthonormal basis (n, p)."""
    return np.asarray(y - basis @ (basis.T @ y))


def spread_rows(weights: Floats, most: int) -> NDArray[np.intp]:
    """Return at most so many runs: half are those of the largest weights, others are spread."""
    n = len(weights)
    if n <= most:
        return np.arange(n)
    order = np.argsort(-weights, kind="stable")
    n_important = min(most // 2, int((weights > weights.mean()).sum()))
    spread = np.linspace(n_important, n - 1, most - n_important).astype(int)
    # In the order of the runs, so that those of equal weights are spread over a sequence.
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
) -> list[Kriging]:
    """Return a surface of each output, of the degree and nugget of the least left-out errors.

    Points (n, d) have outputs (n, m) of spread about one; ``weights``, (n,), of sum one, are those
    of squared left-out errors. Nuggets are in units of the largest kernel. Of too many runs a
    part has the surface, and the others only test it. Empty if no system can be solved.
    """
    rows = spread_rows(weights, MOST_RUNS)
    all_z, all_y, z, y = z, y, z[rows], y[rows]
    weights = weights[rows] / weights[rows].sum()
    matrix = kernel_matrix(kernel, z / lengths)
    best: list[Kriging | None] = [None] * y.shape[1]
    least = np.full(y.shape[1], np.inf)
    for degree in degrees:
        terms = Polynomials.of(z, degree)(z)
        if not determine(terms):
            continue
        projected = Projected.of(matrix, np.linalg.qr(terms.T)[0])
        for nugget in nuggets:
            system = System.of(matrix, terms, nugget, projected)
            if system is None:
                continue
            inverse, basis, contrasts = system.inverse, system.basis, off_basis(system.basis, y)
            w = inverse @ contrasts
            # Two steps of iterative refinement: close runs make the matrix badly conditioned.
            for _ in range(2):
                rest = off_basis(basis, contrasts - matrix @ w - system.nugget * w)
                w += off_basis(basis, inverse @ rest)
            precisions = np.diag(inverse)[:, None]
            left_out = w / precisions
            # Left-out errors are too small where the matrix is singular to rounding, and large
            # weights have values that are rough by rounding, which roots need to be found.
            unsolved = np.abs(inverse @ rest / precisions).max(axis=0)
            size = np.finfo(float).eps * np.abs(matrix).max()
            error = np.sqrt(weights @ left_out**2) + unsolved
            error += 100 * size * np.linalg.norm(w, axis=0)
            for k in np.flatnonzero(error < 0.9 * least):
                least[k], column = error[k], [int(k)]
                best[k] = Kriging(
                    *(z, y[:, column], rows, kernel, lengths, degree, nugget, w[:, column]),
                    coefficients=system.trend(y[:, column], w[:, column]),
                    left_out=left_out[:, column],
                    errors=error[column],
                    scales=weights @ (left_out[:, column] ** 2 * precisions),
                )
    surfaces = [surface for surface in best if surface is not None]
    if len(rows) < len(all_z):
        for place, surface in enumerate(surfaces):
            errors = all_y[:, [place]] - surface.values(all_z)
            errors[rows] = surface.left_out
            surfaces[place] = replace(surface, left_out=errors)
    return surfaces if len(surfaces) == y.shape[1] else []


def likeliest(
    kernel: str, x: Floats, y: Floats, basis: Floats, start: Floats | None = None
) -> Floats:
    """Return log lengths and log nugget, (d + 1,), that maximise the likelihood of contrasts.

    Points (n, d) have spread one. The search starts from the likelier one of ``start``, (d + 1,),
    and of equal lengths; without it, from the likeliest equal lengths with little and much noise,
    since long lengths alone miss a resonance, and short ones alone a near-polynomial.
    """
    from scipy.optimize import minimize as scipy_minimize

    d = x.shape[1]
    bounds = [(np.log(0.05), np.log(200))] * d + [(np.log(1e-9), np.log(0.1))]
    low, high = np.array(bounds).T
    contrasts = off_basis(basis, y)
    problem = KERNELS[kernel], x, contrasts / np.sqrt((contrasts**2).mean()), basis

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
    parameters: Floats, kernel: Kernel, x: Floats, y: Floats, basis: Floats
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
    projected = Projected.of(kernels, basis)
    root = projected.root(nugget)
    if root is None:
        return 1e10, np.zeros(d + 1)
    log_determinant = float(np.log(np.diag(root)).sum()) - 0.5 * p * np.log(
        projected.sigma + nugget
    )
    inverse = projected.inverse(root, nugget)
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
