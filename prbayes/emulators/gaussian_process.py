"""A Gaussian process with a length for each input, and a nugget."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prbayes._validate import Floats, positive_number
from prbayes.emulators.surfaces import Predict, Surface
from prbayes.numerics.threads import one_thread

# Points for the lengths and the nugget: the time grows with the cube of their number.
MOST_TUNED = 256

# From squared distances to the correlation, and minus twice its slope.
Kernel = Callable[[Floats], tuple[Floats, Floats]]


def squared_exponential(square: Floats) -> tuple[Floats, Floats]:
    """Return the correlation and minus twice its slope, of squared distances."""
    correlation = np.exp(-0.5 * square)
    return correlation, correlation


def matern(square: Floats) -> tuple[Floats, Floats]:
    """Return the same of a Matern correlation of smoothness 5/2."""
    r = np.sqrt(5 * square)
    decay = np.exp(-r)
    return (1 + r + r**2 / 3) * decay, 5 / 3 * (1 + r) * decay


KERNELS: dict[str, Kernel] = {"squared_exponential": squared_exponential, "matern": matern}


@dataclass(frozen=True)
class GaussianProcess(Surface):
    """A Gaussian process around a constant, with a length for each input and a nugget.

    Lengths and nugget maximise the likelihood, profiled over the variance.

    Parameters
    ----------
    kernel : str
        "squared_exponential", for responses without corners, or "matern", of smoothness 5/2.
    lengths : tuple of float, optional
        In the units of the points; estimated by default.
    nugget : float, optional
        Variance of the part that does not depend on the inputs, in that of the response.

    Raises
    ------
    TypeError, ValueError
        If an argument is not as described, or only one of lengths and nugget is given.

    References
    ----------
    .. [1] Rasmussen, C. E. and C. K. I. Williams (2006), Gaussian Processes for Machine Learning,
       MIT Press, ch. 5.

    Examples
    --------
    >>> GaussianProcess("matern").terms(3)
    2
    """

    kernel: str = "squared_exponential"
    _: KW_ONLY
    lengths: tuple[float, ...] | None = None
    nugget: float | None = None

    def __post_init__(self) -> None:
        if self.kernel not in KERNELS:
            raise ValueError(
                f"GaussianProcess: kernel: got {self.kernel!r}, expected one of {list(KERNELS)}"
            )
        if (self.lengths is None) != (self.nugget is None):
            raise ValueError(
                f"GaussianProcess: got lengths {self.lengths} and nugget {self.nugget}, expected "
                "both or neither; leave both out to estimate them"
            )
        if self.lengths is None:
            return
        for length in self.lengths:
            positive_number(length, "GaussianProcess: lengths")
        if self.nugget != 0:
            positive_number(self.nugget, "GaussianProcess: nugget")

    def terms(self, dimensions: int) -> int:
        """Return the least number of points."""
        return 2

    @one_thread()
    def tuned(self, x: Floats, y: Floats) -> GaussianProcess:
        """Return the same with the likeliest lengths and nugget."""
        from scipy.optimize import minimize as scipy_minimize

        rows = np.linspace(0, len(x) - 1, min(MOST_TUNED, len(x))).astype(int)
        runs = KERNELS[self.kernel], x[rows], y[rows] - y[rows].mean()
        d = x.shape[1]
        # Far shorter, a process is noise; far longer, a plane.
        bounds = [(np.log(0.05), np.log(1e3))] * d + [(np.log(1e-10), 0.0)]
        # Lengths in roots of the number of inputs, and nuggets: long ones alone miss a resonance,
        # short ones alone a near-polynomial. With many points both give the same.
        starts = [(0.7, 1e-2), (2.0, 1e-6)] if len(rows) <= 128 else [(0.7, 1e-2)]
        fits = [
            scipy_minimize(
                negative_log_likelihood,
                np.log([*[length * np.sqrt(d)] * d, nugget]),
                args=runs,
                jac=True,
                bounds=bounds,
                method="L-BFGS-B",
                options={"ftol": 1e-5},  # some hundredths of a unit of the log-likelihood
            )
            for length, nugget in starts
        ]
        best = min(fits, key=lambda fit: fit.fun)
        *lengths, nugget = np.exp(best.x).tolist()
        return GaussianProcess(self.kernel, lengths=tuple(lengths), nugget=nugget)

    def through(self, x: Floats, y: Floats) -> Predict:
        """Return the mean of the process given the points."""
        if self.lengths is None or self.nugget is None:
            return self.tuned(x, y).through(x, y)
        if len(self.lengths) != x.shape[1]:
            raise ValueError(
                f"GaussianProcess: lengths: got {len(self.lengths)}, expected one for each of "
                f"{x.shape[1]} inputs"
            )
        from scipy.linalg import cho_solve

        kernel, lengths = KERNELS[self.kernel], np.array(self.lengths)
        scaled = x / lengths
        root = _root(kernel(_squares(scaled, scaled))[0], self.nugget)
        center = float(y.mean())
        coefficients = cho_solve((root, True), y - center)
        return partial(_mean, kernel, scaled, lengths, center, coefficients)

    def without_each(self, x: Floats, y: Floats, lacking: NDArray[np.bool_]) -> Predict:
        """Return the means of processes that lack some of the points each, from one inverse."""
        if self.lengths is None or self.nugget is None:
            return self.tuned(x, y).without_each(x, y, lacking)
        kernel, lengths = KERNELS[self.kernel], np.array(self.lengths)
        scaled = x / lengths
        inverse = _inverse(_root(kernel(_squares(scaled, scaled))[0], self.nugget))
        mean = y.mean()
        of_ones = inverse.sum(axis=1)
        of_y = inverse @ (y - mean)
        centers = np.array([float(y[~row].mean()) for row in lacking])
        coefficients = np.zeros((len(x), len(lacking)))
        for b, row in enumerate(lacking):
            all_points = of_y - (centers[b] - mean) * of_ones
            # The coefficients given the remaining points, by a block inverse.
            columns = inverse[:, row]
            reduced = all_points - columns @ np.linalg.solve(columns[row], all_points[row])
            coefficients[~row, b] = reduced[~row]
        return partial(_mean, kernel, scaled, lengths, centers, coefficients)

    def slope(self, x: Floats, y: Floats, along: Floats) -> float:
        """Return the likeliest slope with these lengths, that of generalised least squares."""
        from scipy.linalg import cho_solve

        if self.lengths is None or self.nugget is None:
            return self.tuned(x, y).slope(x, y, along)
        scaled = x / np.array(self.lengths)
        correlation, _ = KERNELS[self.kernel](_squares(scaled, scaled))
        terms = np.column_stack([np.ones(len(x)), along])
        weighted = cho_solve((_root(correlation, self.nugget), True), terms)
        _, slope = np.linalg.lstsq(weighted.T @ terms, weighted.T @ y, rcond=None)[0]
        return float(slope)


def _mean(
    kernel: Kernel,
    scaled: Floats,
    lengths: Floats,
    center: float | Floats,
    coefficients: Floats,
    at: Floats,
) -> Floats:
    """Return the mean of a process at points, (k,), or of B with coefficients (n, B), (k, B)."""
    deviations = np.empty((len(at), *coefficients.shape[1:]))
    step = 1024  # so many points stay in the cache
    for start in range(0, len(at), step):
        rows = slice(start, start + step)
        correlation, _ = kernel(_squares(at[rows] / lengths, scaled))
        deviations[rows] = correlation @ coefficients
    return np.asarray(center + deviations)


def negative_log_likelihood(
    parameters: Floats, kernel: Kernel, x: Floats, y: Floats
) -> tuple[float, Floats]:
    """Return minus the log-likelihood of log lengths and log nugget, and its gradient."""
    from scipy.linalg import cholesky

    n = len(x)
    nugget = np.exp(parameters[-1])
    scaled = x / np.exp(parameters[:-1])
    square = _squares(scaled, scaled)
    np.fill_diagonal(square, 0)
    correlation, slope = kernel(square)
    try:
        root = cholesky(correlation + nugget * np.eye(n), lower=True)
    except np.linalg.LinAlgError:
        return 1e10, np.zeros(parameters.size)
    inverse = _inverse(root)
    weights = inverse @ y
    variance = max(float(y @ weights) / n, 1e-300)
    outer = np.outer(weights, weights) / variance - inverse
    inner = outer * slope
    of_lengths = inner.sum(axis=1) @ scaled**2 - ((inner @ scaled) * scaled).sum(axis=0)
    of_nugget = 0.5 * nugget * np.trace(outer)
    log_determinant = np.log(np.diag(root)).sum()
    value = 0.5 * n * np.log(variance) + log_determinant
    return float(value), -np.append(of_lengths, of_nugget)


def _root(correlation: Floats, nugget: float) -> Any:
    """Return the lower root of a correlation with a nugget, enlarged if rounding needs it."""
    from scipy.linalg import cholesky

    unit = np.eye(len(correlation))
    while True:
        try:
            return cholesky(correlation + nugget * unit, lower=True)
        except np.linalg.LinAlgError:
            nugget = max(10 * nugget, 1e-14)


def _inverse(root: Floats) -> Floats:
    """Return the inverse of a matrix, of its lower root."""
    from scipy.linalg.lapack import dpotri

    lower, _ = dpotri(root, lower=True)  # a third of what solving for each column takes
    lower = np.tril(lower)
    return np.asarray(lower + np.tril(lower, -1).T)


def _squares(a: Floats, b: Floats) -> Any:
    """Return squared distances of points, (n, k)."""
    crossed = (a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1) - 2 * a @ b.T
    return np.maximum(crossed, 0)
