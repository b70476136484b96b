r"""Emulator of a random response: its mean, its spread, and the density of its residuals.

    y_j = m_j(x) + s_j(x) r_j,

with polynomials m and log s, and residuals r that have the same density at all inputs. It is a mean
of normal densities at the residuals of the runs, so that their skewness, tails and correlation
remain.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import combinations_with_replacement
from math import comb

import numpy as np
from scipy.special import ndtr, ndtri

from prbayes._stats import log_sum_exp, positive_scale
from prbayes._validate import IN_CACHE, ArrayPair, Floats, Indices
from prbayes.numerics.points import inside


@dataclass(frozen=True, eq=False)
class Region:
    """An ellipsoidal box of inputs, the domain of the polynomials."""

    center: Floats  # (d,)
    root: Floats  # (d, d): maps the cube [-1, 1]^d to the box, less its center

    def unit(self, x: Floats) -> Floats:
        """Return the place of inputs, (..., d), in the cube [-1, 1]^d."""
        inverse = np.linalg.inv(self.root)
        centred = x - self.center
        return np.asarray(centred @ inverse.T)

    def at(self, unit: Floats) -> Floats:
        """Return the inputs at places of the cube, (..., d)."""
        return np.asarray(self.center + unit @ self.root.T)

    def contains(self, other: Region, slack: float = 0.25) -> bool:
        """Return whether the axes of another region end in this one, or a little beyond."""
        axes = np.eye(len(self.center))
        ends = other.at(np.concatenate([axes, -axes]))
        distance = np.abs(self.unit(ends))
        return bool(distance.max() <= 1 + slack)


@dataclass(frozen=True, eq=False)
class Scatter:
    """Distribution of m outputs of a random response at d inputs, as an emulator."""

    region: Region
    mean_terms: Floats  # (P, m): coefficients of the mean
    spread_terms: Floats  # (Q, m): coefficients of the logarithm of the standard deviation
    degrees: tuple[int, int]  # degrees of both polynomials
    log_spread: Floats  # (2, m): ends of the logarithm of the standard deviation
    residuals: Floats  # (J, m): uncorrelated residuals, with mean zero and variance one
    weights: Floats  # (J,): their weights, of sum one
    factor: Floats  # (m, m): lower triangular factor of the residuals' correlation
    bandwidth: float  # standard deviation of the normal density at each residual

    def moments(self, x: Floats) -> ArrayPair:
        """Return mean and standard deviation at inputs (..., d), both (..., m).

        Beyond the region they are those at its end.
        """
        unit = np.clip(self.region.unit(x), -1.0, 1.0)
        flat = unit.reshape(-1, unit.shape[-1])
        of_mean, of_spread = self.degrees
        mean = legendre_products(flat, of_mean) @ self.mean_terms
        log_sd = legendre_products(flat, of_spread) @ self.spread_terms
        limited = np.clip(log_sd, *self.log_spread)
        sd = np.exp(limited)
        shape = (*unit.shape[:-1], mean.shape[1])
        return mean.reshape(shape), sd.reshape(shape)

    def log_density(self, x: Floats, values: Floats, error: Floats) -> Floats:
        """Return the log-density of readings (N, m) at inputs (1, K, d) or (N, K, d), as (N, K).

        ``error``, (N, m), is the standard deviation of their normal errors. Outputs that were not
        measured are NaN.
        """
        mean, sd = self.moments(x)
        is_common = len(mean) == 1
        result = np.empty((len(values), mean.shape[1]))
        kinds = np.concatenate([np.isnan(values), error], axis=1)
        _, kind = np.unique(kinds, axis=0, return_inverse=True)
        kind = kind.ravel()
        for k in range(kind.max() + 1):
            rows = np.flatnonzero(kind == k)
            first = rows[0]
            columns = np.flatnonzero(~np.isnan(values[first]))
            measured = values[np.ix_(rows, columns)]
            at = slice(None) if is_common else rows
            result[rows] = self._of_kind(
                mean[at][..., columns],
                sd[at][..., columns],
                measured,
                error[first, columns],
                columns,
            )
        return result

    def _of_kind(
        self, mean: Floats, sd: Floats, values: Floats, error: Floats, columns: Indices
    ) -> Floats:
        """Return `log_density` of specimens with the same error in the same measured outputs."""
        factor = sd[..., None] * self.factor[columns]
        transposed = factor.swapaxes(-1, -2)
        of_kernel = self.bandwidth**2 * factor @ transposed
        covariance = of_kernel + np.diag(error**2)
        root = np.linalg.cholesky(covariance)
        shrunk = np.sqrt(1 - self.bandwidth**2) * self.residuals
        centers = np.linalg.solve(root, factor @ shrunk.T)  # (n or 1, K, m, J)
        difference = values[:, None] - mean
        away = np.linalg.solve(root, difference[..., None])
        away = away[..., 0]
        diagonal = np.diagonal(root, axis1=-2, axis2=-1)
        log_root = np.log(diagonal).sum(axis=-1)
        constant = log_root + 0.5 * len(columns) * np.log(2 * np.pi)
        squares = (centers**2).sum(axis=-2)
        with np.errstate(divide="ignore"):
            offset = np.log(self.weights) - 0.5 * squares
        distance = (away**2).sum(axis=-1)
        logs = np.empty(away.shape[:2])
        n_terms = away.shape[1] * len(self.weights)
        step = max(1, IN_CACHE // n_terms)
        for first in range(0, len(values), step):
            block = slice(first, first + step)
            at = slice(None) if len(centers) == 1 else block
            products = away[block][:, :, None] @ centers[at]
            terms = products[:, :, 0] + offset[at]
            logs[block] = log_sum_exp(terms) - 0.5 * distance[block]
        return np.asarray(logs - constant)

    @cached_property
    def _quantiles(self) -> ArrayPair:
        """A grid of residuals, (G,), and their distribution functions there, (m, G)."""
        grid = np.linspace(-12.0, 12.0, 2401)
        shrinkage = np.sqrt(1 - self.bandwidth**2)
        middles = shrinkage * self.residuals.T
        steps = (grid - middles[..., None]) / self.bandwidth
        cumulative = self.weights @ ndtr(steps)
        return grid, cumulative

    def outputs(self, x: Floats, noise: Floats) -> Floats:
        """Return outputs (n, m) at inputs (n, d), for standard normal noise (n, m).

        Residuals have the marginal densities and the correlation of those of the runs.
        """
        mean, sd = self.moments(x)
        grid, cumulative = self._quantiles
        probabilities = ndtr(noise)
        pairs = zip(probabilities.T, cumulative, strict=True)
        columns = [np.interp(p, of_output, grid) for p, of_output in pairs]
        drawn = np.stack(columns, axis=-1)
        correlated = drawn @ self.factor.T
        return mean + sd * correlated

    def noise(self, x: Floats, values: Floats, most: float = 4.0) -> Floats:
        """Return the noise (N, K, m) that gives readings (N, m) at inputs (1 or N, K, d).

        It is clipped to +- ``most``, and zero where an output was not measured.
        """
        mean, sd = self.moments(x)
        grid, cumulative = self._quantiles
        difference = values[:, None] - mean
        away = np.nan_to_num(difference / sd)
        residuals = np.linalg.solve(self.factor, away[..., None])
        by_output = np.moveaxis(residuals[..., 0], -1, 0)
        pairs = zip(by_output, cumulative, strict=True)
        columns = [np.interp(r, grid, of_output) for r, of_output in pairs]
        levels = inside(np.stack(columns, axis=-1))
        return np.asarray(np.clip(ndtri(levels), -most, most))


def legendre_products(unit: Floats, degree: int) -> Floats:
    """Return products of Legendre polynomials up to a total degree, (n, d) -> (n, P)."""
    n, d = unit.shape
    vandermonde = np.polynomial.legendre.legvander
    powers = np.stack([vandermonde(x, degree) for x in unit.T])
    inputs_in_order = np.arange(d)
    columns = [np.ones(n)]
    for total in range(1, degree + 1):
        for inputs in combinations_with_replacement(range(d), total):
            counts = np.bincount(inputs, minlength=d)
            factors = powers[inputs_in_order, :, counts]
            columns.append(factors.prod(axis=0))
    return np.stack(columns, axis=1)


def largest_degree(dimensions: int, terms: float, most: int) -> int:
    """Return the largest total degree, up to ``most``, with no more than so many terms."""
    degree = 0
    while degree < most and comb(dimensions + degree + 1, dimensions) <= terms:
        degree += 1
    return degree


def fit_scatter(
    region: Region,
    x: Floats,
    y: Floats,
    places: Indices,
    degrees: tuple[int, int],
    place_weights: Floats | None = None,
) -> Scatter:
    """Fit mean, spread and residuals to runs at inputs (n, d) with outputs (n, m).

    ``places``, (n,), are numbers of the distinct inputs, of which each has a weight, (n_places,).
    The mean is a weighted least-squares fit given the spread, and the logarithm of the variance
    a gamma regression of squared residuals, divided by one less their leverage, given the mean.
    """
    n, m = y.shape
    weights = np.ones(n) if place_weights is None else place_weights[places]
    unit = np.clip(region.unit(x), -1.0, 1.0)
    basis, of_spread = (legendre_products(unit, degree) for degree in degrees)
    fits = [_fit_output(basis, of_spread, of_output, weights) for of_output in y.T]
    mean_terms, spread_terms, residuals = (
        np.stack(part, axis=-1) for part in zip(*fits, strict=True)
    )
    log_sd = of_spread @ spread_terms
    share = weights / weights.sum()
    residuals = residuals - share @ residuals
    variance = share @ residuals**2
    scale = positive_scale(np.sqrt(variance))
    residuals = residuals / scale
    correlation = (residuals.T * share) @ residuals
    factor = np.linalg.cholesky(correlation + 1e-9 * np.eye(m))
    residuals = np.linalg.solve(factor, residuals.T).T
    count = 1 / (share**2).sum()
    bandwidth = min(0.85 * count ** (-1 / (m + 4)), 0.95)
    # The spread has the scale of the residuals, whose variance is one.
    spread_terms[0] += np.log(scale)
    lowest = log_sd.min(axis=0)
    highest = log_sd.max(axis=0)
    log_ends = np.stack([lowest, highest]) + np.log(scale)
    return Scatter(
        region, mean_terms, spread_terms, degrees, log_ends, residuals, share, factor, bandwidth
    )


def _fit_output(
    basis: Floats, of_spread: Floats, y: Floats, weights: Floats
) -> tuple[Floats, Floats, Floats]:
    """Return coefficients of the mean and of the log-spread of an output, and its residuals."""
    scale = positive_scale(np.array([y.std()]))[0]
    log_variance = np.full(len(y), 2 * np.log(scale))
    gamma = np.zeros(of_spread.shape[1])
    gamma[0] = 2 * np.log(scale)
    information = (of_spread.T * weights) @ of_spread
    information += 1e-6 * np.trace(information) * np.eye(len(gamma))
    for _ in range(8):
        precision = np.sqrt(weights * np.exp(-log_variance))
        weighted = basis * precision[:, None]
        orthogonal, values, rotation = np.linalg.svd(weighted, full_matrices=False)
        is_regular = values > 1e-9 * values[0]
        inverse = np.where(is_regular, 1 / values, 0.0)
        projected = orthogonal.T @ (precision * y)
        beta = rotation.T @ (inverse * projected)
        leverage = np.minimum((orthogonal**2).sum(axis=1), 0.9)
        difference = y - basis @ beta
        square = difference**2 / (1 - leverage)
        for _ in range(3):
            ratio = np.minimum(square * np.exp(-log_variance), 1e6)
            score = of_spread.T @ (weights * (ratio - 1))
            step = np.linalg.solve(information, score)
            change = np.abs(of_spread @ step)
            largest = max(change.max(), 1e-300)
            gamma = gamma + step * min(1.0, 2.0 / largest)
            floor = 2 * np.log(1e-8 * scale)
            log_variance = np.maximum(of_spread @ gamma, floor)
    inverse_sd = np.exp(-0.5 * log_variance)
    residuals = (y - basis @ beta) * inverse_sd / np.sqrt(1 - leverage)
    return beta, 0.5 * gamma, residuals


def emulator_draws(
    region: Region,
    x: Floats,
    y: Floats,
    places: Indices,
    degrees: tuple[int, int],
    count: int,
    seed: int,
) -> list[Scatter]:
    """Return emulators under Bayesian bootstrap weights of the distinct inputs (Rubin, 1981).

    Their scatter is the error of the emulator by finitely many runs.
    """
    rng = np.random.default_rng([seed, 7])
    n = int(places.max()) + 1
    shares = rng.dirichlet(np.ones(n), count)
    weights = shares * n
    return [fit_scatter(region, x, y, places, degrees, row) for row in weights]


def chosen_degrees(region: Region, x: Floats, y: Floats, places: Indices) -> tuple[int, int]:
    """Return degrees of mean and log-spread: those of the mean with the least left-out error.

    A fit without an input leaves out all of its repeats. At most a sixth of the distinct inputs are
    coefficients of the mean, a sixteenth those of the spread.
    """
    d, n = x.shape[1], int(places.max()) + 1
    most = largest_degree(d, n / 6, 6)
    spread = largest_degree(d, n / 16, 3)
    unit = np.clip(region.unit(x), -1.0, 1.0)
    sums = np.zeros((n, y.shape[1]))
    np.add.at(sums, places, y)
    counts = np.bincount(places)
    of_counts = counts[:, None]
    means = sums / of_counts
    _, first = np.unique(places, return_index=True)
    errors = []
    for degree in range(1, most + 1):
        fit = fit_scatter(region, x, y, places, (degree, spread))
        _, sd = fit.moments(x[first])
        basis = legendre_products(unit[first], degree)
        total = 0.0
        for of_output, of_spread in zip(means.T, sd.T, strict=True):
            precision = np.sqrt(counts) / of_spread
            orthogonal = np.linalg.svd(basis * precision[:, None], full_matrices=False)[0]
            scaled = precision * of_output
            fitted = orthogonal @ (orthogonal.T @ scaled)
            leverage = (orthogonal**2).sum(axis=1)
            left_out = (scaled - fitted) / np.maximum(1 - leverage, 0.1)
            # The sd of this degree would hide its misfit, so that left-out errors are in the units
            # of the output.
            squares = (left_out * of_spread) ** 2
            total += float(np.log(squares.mean()))
        errors.append(total)
    return int(np.argmin(errors)) + 1 if errors else 0, spread
