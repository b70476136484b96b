"""The cross-validated error of a surrogate."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from prbayes._checks import Floats
from prbayes.surrogate.surfaces import FOLDS, fitted


@dataclass(frozen=True, eq=False)
class SurrogateError:
    """The cross-validated error of a surrogate.

    Attributes
    ----------
    residuals : ndarray, shape (n,)
        Response less surrogate at each design point, fitted without a tenth of the points that this one belongs to;
        in units of the response, NaN where the response failed.
    population_sd : float
        Standard deviation of the response: over the prior predictive distribution where an input is a ``.dist()``, and
        else over the ranges.
    """

    residuals: Floats = field(repr=False)
    population_sd: float

    @property
    def rms(self) -> float:
        """Root mean square, in units of the response."""
        return float(np.sqrt(np.nanmean(self.residuals**2)))

    @property
    def largest(self) -> float:
        """Largest magnitude, in units of the response."""
        return float(np.nanmax(np.abs(self.residuals)))

    @property
    def relative(self) -> float:
        """Root mean square in units of the population's standard deviation."""
        return self.rms / self.population_sd

    def __str__(self) -> str:
        return f"rms {self.rms:.3g} ({self.relative:.2%} of the population's sd), largest {self.largest:.3g}"


def cross_validated(model: Any, x: Floats, y: Floats, seed: int) -> Floats:
    """Return responses less what the surface says that was fitted without their tenth of the points, shape (n,)."""
    order = np.random.default_rng(seed).permutation(len(y))
    residuals = np.empty(len(y))
    for fold in np.array_split(order, min(FOLDS, len(y))):
        rest = np.setdiff1d(order, fold)
        residuals[fold] = y[fold] - fitted(model, x[rest], y[rest])(x[fold])
    return residuals
