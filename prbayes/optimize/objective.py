"""The standardised objective of one minimisation, and why it may end early."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from prbayes._validate import Floats

# A smaller gain, in typical sizes of the objective, is rounding of a sum over thousands of points.
_NO_GAIN = 1e-10


class SpentError(Exception):
    """The budget of evaluations is spent."""


class StalledError(Exception):
    """A line search has made no progress for some time."""


@dataclass(frozen=True, eq=False)
class Hold:
    """Keeps a search near a place along directions about which the data say next to nothing."""

    place: Floats  # (d,)
    directions: Floats  # (d, q): orthonormal in units of the prior's spread
    weight: float  # of half the squared distance, in units of the objective

    def __call__(self, thetas: Floats, prior_sd: Floats) -> Floats:
        """Return what is added to the objective at thetas, (..., d) -> (...)."""
        along = (thetas - self.place) / prior_sd @ self.directions
        return np.asarray(0.5 * self.weight * (along**2).sum(axis=-1))

    def slope(self, thetas: Floats, prior_sd: Floats) -> Floats:
        """Return the gradient of that at thetas, (..., d)."""
        along = (thetas - self.place) / prior_sd @ self.directions
        return np.asarray(self.weight * (along @ self.directions.T) / prior_sd)


class Objective:
    """The standardised objective of one minimisation, which records every point.

    Parameters
    ----------
    function : callable
        Theta -> value, gradient or None, number of evaluations.
    center : ndarray, shape (d,)
        Theta where the standardised parameters are zero.
    prior_sd : ndarray, shape (d,)
    size : float
        Typical size of the values.
    gradient : bool
        Whether the gradient is returned as well.
    most : int
        Largest number of evaluations, after which `SpentError` is raised.
    """

    def __init__(
        self,
        function: Callable[[Floats], Any],
        center: Floats,
        prior_sd: Floats,
        size: float,
        *,
        gradient: bool,
        most: int,
    ) -> None:
        self.function = function
        self.center = center
        self.prior_sd = prior_sd
        self.size = size
        self.gradient = gradient
        self.most = most
        self.count = 0
        self.patience: float = np.inf
        self.least_gain = 0.0  # relative, that counts as progress
        self._progress_at = np.inf
        self._lowest = np.inf
        self._since = 0
        self.thetas: list[Floats] = []
        self.values: list[float] = []
        self.counts: list[int] = []
        self.report: Callable[[int, str], None] = lambda done, note: None

    def __call__(self, t: Floats) -> Any:
        """Return the value, and the gradient where there is one, at standardised parameters."""
        if self.count >= self.most:
            raise SpentError
        theta = self.center + np.asarray(t) * self.prior_sd
        value, gradient, cost = self.function(theta)
        self._record(theta, float(value), cost)
        value = float(value) / self.size
        self._look_for_progress(value, cost)
        if not self.gradient:
            return value if np.isfinite(value) else 1e300
        slope = np.asarray(gradient) * self.prior_sd / self.size
        if not np.isfinite(value) or not np.isfinite(slope).all():
            # Back towards the start, without breaking a line search.
            return 1e10 + float(t @ t), 2 * t
        return value, slope

    def _record(self, theta: Floats, value: float, cost: int) -> None:
        self.count += cost
        self.thetas.append(theta)
        self.values.append(value)
        self.counts.append(self.count)

    def _look_for_progress(self, value: float, cost: int) -> None:
        least = max(_NO_GAIN, self.least_gain * abs(self._progress_at))
        gained = value < self._progress_at - least or not np.isfinite(self._progress_at)
        self._since = 0 if gained else self._since + 1
        if gained:
            self._progress_at = value
        self._lowest = min(self._lowest, value)
        self.report(cost, f"discrepancy {self._lowest * self.size:.4g}")
        if self._since > self.patience:
            raise StalledError

    @property
    def best(self) -> Floats:
        """The point with the smallest value so far, or the center."""
        if not self.values:
            return self.center
        values = np.nan_to_num(self.values, nan=np.inf, posinf=np.inf)
        return self.thetas[int(np.argmin(values))]

    @property
    def lowest(self) -> float:
        """The smallest value so far."""
        return min((v for v in self.values if np.isfinite(v)), default=np.inf)
