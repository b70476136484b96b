"""The standardised objective of one minimisation, and why it may end early."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from prbayes._checks import Floats

_PROGRESS = 1e-10  # of the objective, in its typical size: a smaller gain is none


class SpentError(Exception):
    """The budget of evaluations is spent."""


class StalledError(Exception):
    """A line search has made no progress for some time."""


class Objective:
    """The standardised objective of one minimisation; records every point, at most ``most`` evaluations."""

    def __init__(self, function: Any, center: Floats, scale: Floats, size: float, *, gradient: bool, most: int) -> None:
        self.function, self.center, self.scale, self.size = function, center, scale, size
        self.gradient, self.most, self.count = gradient, most, 0
        self.patience, self._lowest, self._since = 10**9, np.inf, 0
        self.thetas: list[Floats] = []
        self.values: list[float] = []
        self.counts: list[int] = []
        self.report: Callable[[int, str], None] = lambda done, note: None

    def __call__(self, t: Floats) -> Any:
        """Return the value, and the gradient where there is one, at standardised parameters."""
        if self.count >= self.most:
            raise SpentError
        theta = self.center + np.asarray(t) * self.scale
        value, gradient, cost = self.function(theta)
        self.count += cost
        self.thetas.append(theta)
        self.values.append(float(value))
        self.counts.append(self.count)
        value = float(value) / self.size
        self._since = 0 if value < self._lowest - _PROGRESS else self._since + 1
        self._lowest = min(self._lowest, value)
        self.report(cost, f"discrepancy {self._lowest * self.size:.4g}")
        if self._since > self.patience:
            raise StalledError
        if not self.gradient:
            return value if np.isfinite(value) else 1e300
        g = np.asarray(gradient) * self.scale / self.size
        if not np.isfinite(value) or not np.isfinite(g).all():
            return 1e10 + float(t @ t), 2 * t  # back towards the start, without breaking a line search
        return value, g

    @property
    def best(self) -> Floats:
        """The point with the smallest value so far, or the center."""
        if not self.values:
            return self.center
        return self.thetas[int(np.argmin(np.nan_to_num(self.values, nan=np.inf, posinf=np.inf)))]

    @property
    def lowest(self) -> float:
        """The smallest value so far."""
        return min((v for v in self.values if np.isfinite(v)), default=np.inf)
