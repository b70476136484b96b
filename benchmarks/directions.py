"""How many directions `prb.Joint` needs: errors of the minimiser, over those with many directions.

A population of m outputs is fitted to N of its specimens: all means and the Cholesky factor of the
covariance, by the probability residual with the package's default bandwidth, by the forward
Kullback-Leibler divergence at that bandwidth, and by the area metric. The populations are normal, or
a mixture of a normal and another of the same shape that is three times as wide and has a tenth of
the weight; slices of both are known in closed form, and so are derivatives. The whitening and the
directions are the package's. Errors of means, logarithms of standard deviations and inverse
hyperbolic tangents of correlations are divided by those with many directions (``MANY``), and by
those of maximum likelihood. Fits follow any linear map of the outputs; so errors are told for three
maps, which give the outputs the correlations of ``CORRELATIONS``.

    uv run python -m benchmarks.directions
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize
from scipy.special import ndtr, ndtri

from benchmarks import record
from prbayes.metrics.density import twice_silverman
from prbayes.metrics.multivariate import directions
from prbayes.metrics.whitening import whitening

# Outputs, and numbers of directions.
NUMBERS = {
    2: (3, 4, 6),
    3: (6, 8, 10, 14),
    4: (10, 14, 18, 24),
    6: (21, 30, 40, 50),
    8: (36, 54, 70, 90),
}
MANY = {2: 40, 3: 90, 4: 160, 6: 300, 8: 400}
CORRELATIONS = (0.0, 0.8, -0.995)  # the last of the first two outputs alone
CONTAMINATED = ((0.9, 1.0), (0.1, 3.0))
SHAPES = {"normal": ((1.0, 1.0),), "mixture": CONTAMINATED}
ROOT_2_PI = np.sqrt(2 * np.pi)


def pdf(x: Any, variance: Any) -> Any:
    """Return the density of a normal distribution with mean zero."""
    return np.exp(-0.5 * x**2 / variance) / (ROOT_2_PI * np.sqrt(variance))


class Slices:
    """A metric on slices of a sample, as a function of the means and variances of the slices."""

    def __init__(self, z: Any, shape: Any) -> None:
        self.z, self.shape = z, shape  # (n, K): the slices
        equal = np.full(len(z), 1 / len(z))
        self.h2 = np.array([twice_silverman(one, equal) for one in z.T]) ** 2

    def residual(self, mean: Any, variance: Any) -> tuple[Any, Any, Any]:
        """Return the integral of (p - q)^2, its derivatives for mean and variance; each (K,)."""
        value, by_mean, by_variance = np.zeros((3, mean.size))
        x = self.z - mean
        for share, c in self.shape:
            c = c**2
            for other, e in self.shape:
                total = (c + e**2) * variance + 2 * self.h2
                p = share * other * pdf(0.0, total)
                value += p
                by_variance -= 0.5 * p / total * (c + e**2)
            total = c * variance + 2 * self.h2
            p = share * pdf(x, total)
            value -= 2 * p.mean(0)
            by_mean -= 2 * (p * x / total).mean(0)
            by_variance -= (p * (x**2 / total - 1) / total).mean(0) * c
        scale = np.sqrt(self.h2)
        return value * scale, by_mean * scale, by_variance * scale

    def divergence(self, mean: Any, variance: Any) -> tuple[Any, Any, Any]:
        """Return minus the integral of q log p, on a grid, and its derivatives."""
        if not hasattr(self, "grid"):
            h = np.sqrt(self.h2)
            low, high = self.z.min(0) - 6 * h, self.z.max(0) + 6 * h
            self.grid = low + np.linspace(0, 1, 81)[:, None] * (high - low)
            q = pdf(self.grid[:, None] - self.z, self.h2).mean(1)
            self.q = q / q.sum(0)
        x = self.grid - mean
        p = by_mean = by_variance = 0.0
        for share, c in self.shape:
            total = c**2 * variance + self.h2
            one = share * pdf(x, total)
            p = p + one
            by_mean = by_mean + one * x / total
            by_variance = by_variance + 0.5 * one * (x**2 / total - 1) / total * c**2
        ratio = self.q / p
        return (
            -(self.q * np.log(p)).sum(0),
            -(ratio * by_mean).sum(0),
            -(ratio * by_variance).sum(0),
        )

    def area(self, mean: Any, variance: Any) -> tuple[Any, Any, Any]:
        """Return the area between the distribution functions, and its derivatives."""
        if not hasattr(self, "standard"):
            self.sorted = np.sort(self.z, axis=0)
            self.standard = Standard(self.shape)
        n = len(self.z)
        sd = np.sqrt(variance)
        ends = np.arange(n + 1) / n
        edge = self.standard.partial(self.standard.quantile(ends))[:, None]
        x = (self.sorted - mean) / sd
        u = np.clip(self.standard.cdf(x), ends[:-1, None], ends[1:, None])
        inner = self.standard.partial(self.standard.quantile(u))
        # Above the crossing the simulated quantile is the larger one, below it the smaller.
        by_mean = ends[1:, None] + ends[:-1, None] - 2 * u
        by_sd = edge[1:] + edge[:-1] - 2 * inner
        value = by_mean * (mean - self.sorted) + by_sd * sd
        return value.sum(0), by_mean.sum(0), by_sd.sum(0) / (2 * sd)


class Standard:
    """The standardised slice of a population: distribution function and its inverse."""

    def __init__(self, shape: Any) -> None:
        self.shape = shape
        self.x = np.linspace(-30, 30, 60001)
        self.u = self.cdf(self.x)

    def cdf(self, x: Any) -> Any:
        """Return the distribution function."""
        return sum(share * ndtr(x / c) for share, c in self.shape)

    def quantile(self, u: Any) -> Any:
        """Return its inverse, infinite at both ends."""
        if len(self.shape) == 1:
            return ndtri(u)
        found = np.interp(u, self.u, self.x)
        return np.where(u <= 0, -np.inf, np.where(u >= 1, np.inf, found))

    def partial(self, x: Any) -> Any:
        """Return the integral of x p(x) up to x."""
        return -sum(share * c**2 * pdf(x, c**2) for share, c in self.shape)


def fitted(y: Any, u: Any, metric: str, shape: Any, start: Any) -> tuple[Any, Any]:
    """Return mean and Cholesky factor of the population whose slices along u fit best."""
    m = y.shape[1]
    slices = Slices(y @ u.T, shape)
    metric_of = getattr(slices, metric)
    rows, columns = np.tril_indices(m)
    diagonal = rows == columns

    def unpacked(t: Any) -> tuple[Any, Any]:
        factor = np.zeros((m, m))
        factor[rows, columns] = np.where(diagonal, np.exp(t[m:]), t[m:])
        return t[:m], factor

    def objective(t: Any) -> tuple[float, Any]:
        mean, factor = unpacked(t)
        half = u @ factor
        value, by_mean, by_variance = metric_of(u @ mean, (half**2).sum(1))
        by_factor = 2 * (u * by_variance[:, None]).T @ half
        own = by_factor[rows, columns] * np.where(diagonal, factor[rows, columns], 1.0)
        return 100 * value.mean(), 100 * np.concatenate([u.T @ by_mean, own]) / len(u)

    mean, covariance = start
    factor = np.linalg.cholesky(covariance)[rows, columns]
    factor = np.where(diagonal, np.log(np.where(diagonal, factor, 1.0)), factor)
    begin = np.concatenate([mean, factor])
    found = minimize(objective, begin, jac=True, method="BFGS", options={"gtol": 1e-5})
    return unpacked(found.x)


def likeliest(y: Any, shape: Any) -> tuple[Any, Any]:
    """Return mean and covariance of maximum likelihood, by EM."""
    m = y.shape[1]
    mean, covariance = y.mean(0), np.cov(y.T, bias=True)
    if len(shape) == 1:
        return mean, covariance
    for _ in range(200):
        x = y - mean
        squares = (x * np.linalg.solve(covariance, x.T).T).sum(1)
        density = np.array([share * c**-m * np.exp(-0.5 * squares / c**2) for share, c in shape])
        density /= density.sum(0)
        w = sum(d / c**2 for d, (_, c) in zip(density, shape, strict=True))
        mean = w @ y / w.sum()
        x = y - mean
        covariance = (x * w[:, None]).T @ x / len(y)
    return mean, covariance


def truths(m: int) -> list[Any]:
    """Return Cholesky factors of correlation matrices."""
    found = []
    for rho in CORRELATIONS:
        matrix = np.eye(m)
        if rho < 0:
            matrix[0, 1] = matrix[1, 0] = rho
        else:
            matrix += rho * (1 - np.eye(m))
        found.append(np.linalg.cholesky(matrix))
    return found


def parameters(mean: Any, covariance: Any, factor: Any) -> Any:
    """Return means, log standard deviations and correlations after the map of the outputs."""
    mean, covariance = factor @ mean, factor @ covariance @ factor.T
    sd = np.sqrt(np.diag(covariance))
    i, j = np.tril_indices(len(sd), -1)
    return np.concatenate([mean, np.log(sd), np.arctanh((covariance / sd / sd[:, None])[i, j])])


def cell(m: int, n: int, metric: str, name: str, replicates: int) -> dict[str, dict[str, float]]:
    """Return the errors by number of directions, over those of many and of maximum likelihood.

    They are the root of the mean, over all parameters and correlations, of ratios of mean squares.
    """
    shape = SHAPES[name]
    numbers = (*NUMBERS[m], MANY[m])
    errors: dict[int, list[Any]] = {k: [] for k in (0, *numbers)}
    factors = truths(m)

    def error(mean: Any, covariance: Any) -> Any:
        return [
            parameters(mean, covariance, a) - parameters(np.zeros(m), np.eye(m), a) for a in factors
        ]

    for replicate in range(replicates):
        rng = np.random.default_rng([m, n, replicate])
        y = rng.standard_normal((n, m))
        y *= rng.choice([c for _, c in shape], (n, 1), p=[share for share, _ in shape])
        center, axes = whitening(y, np.full(n, 1 / n), np.arange(m))
        z = (y - center) @ axes
        back = np.linalg.inv(axes)
        best = likeliest(z, shape)
        for number in errors:
            mean, covariance = best
            if number:
                u = directions(m, number, 0)
                mean, factor = fitted(z, u, metric, shape, best)
                covariance = factor @ factor.T
            errors[number].append(error(center + mean @ back, back.T @ covariance @ back))
    squares = {k: (np.array(e) ** 2).mean(0) for k, e in errors.items()}
    found = {}
    for number in numbers:
        to_many = squares[number] / squares[MANY[m]]
        to_best = squares[number] / squares[0]
        found[str(number)] = {
            "over many": float(np.sqrt(to_many.mean())),
            "worst over many": float(np.sqrt(to_many.max())),
            "over likelihood": float(np.sqrt(to_best.mean())),
        }
    return found


def main() -> None:
    """Fit all cells, print a table, write JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=record.RESULTS / "directions.json")
    parser.add_argument("--replicates", type=int, default=100)
    arguments = parser.parse_args()
    out: dict[str, Any] = {}
    cases = [(m, n, metric, name) for m in NUMBERS for n in (50,) for name in SHAPES
             for metric in ("residual", "divergence", "area")]  # fmt: skip
    for m, n, metric, name in cases:
        found = cell(m, n, metric, name, arguments.replicates)
        out[f"{m}/{n}/{name}/{metric}"] = found
        row = "  ".join(
            f"{k}: {v['over many']:.3f} ({v['worst over many']:.2f}) {v['over likelihood']:.2f}"
            for k, v in found.items()
        )
        print(f"m {m} N {n} {name:8s} {metric:10s} {row}", flush=True)
    record.save(arguments.out, out)


if __name__ == "__main__":
    main()
