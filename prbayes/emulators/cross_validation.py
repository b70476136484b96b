"""The error of a surrogate by cross-validation."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from prbayes._validate import Floats
from prbayes.emulators.multifidelity import predict
from prbayes.emulators.surfaces import Surface

# Tenfold: Kohavi (1995), A study of cross-validation and bootstrap, IJCAI.
FOLDS = 10


@dataclass(frozen=True, eq=False)
class CrossValidation:
    """The error of a surrogate by cross-validation.

    Attributes
    ----------
    residuals : ndarray, shape (n,) or (n, m)
        Response less surrogate at each design point, fitted without the tenth of the points that
        includes it; in units of the response, NaN where the response failed.
    population_sd : float or ndarray, shape (m,)
        Standard deviation of the response, of each output where there are several: over the prior
        predictive distribution where an input is a ``.dist()``, and else over the ranges.
    """

    residuals: Floats = field(repr=False)
    population_sd: Any

    @property
    def rms(self) -> Any:
        """Root mean square, in units of the response; (m,) of several outputs."""
        return _number(np.sqrt(np.nanmean(self.residuals**2, axis=0)))

    @property
    def largest(self) -> Any:
        """Largest magnitude, in units of the response; (m,) of several outputs."""
        return _number(np.nanmax(np.abs(self.residuals), axis=0))

    @property
    def relative(self) -> Any:
        """Root mean square in units of the population's standard deviation.

        Shape (m,) of several outputs; of a constant output, zero or infinite.
        """
        sd = np.asarray(self.population_sd)
        is_constant = sd == 0
        of_constant = np.where(np.asarray(self.rms) > 0, np.inf, 0.0)
        ratio = self.rms / np.where(is_constant, 1.0, sd)
        return _number(np.where(is_constant, of_constant, ratio))

    def __str__(self) -> str:
        numbers = zip(*map(np.atleast_1d, (self.rms, self.relative, self.largest)), strict=True)
        return "; ".join(
            f"rms {rms:.3g} ({relative:.2%} of the population's sd), largest {largest:.3g}"
            for rms, relative, largest in numbers
        )


def _number(values: Any) -> Any:
    """Return an array of several outputs, or the number of one."""
    return float(values) if np.ndim(values) == 0 else values


def cross_validated(
    model: Any, x: Floats, y: Floats, random_seed: int, coarse: Floats | None = None
) -> Floats:
    """Return responses less predictions of surfaces without their tenth of the points, as y.

    Parameters
    ----------
    model : MultifidelityModel, Surface or regressor
    x : ndarray, shape (n, d)
        In the unit cube.
    y : ndarray, shape (n,) or (n, m)
        Each output has a surface.
    random_seed : int
        Of the assignment of points to folds.
    coarse : ndarray, shape (n,), optional
        A coarse response, for a model that follows one.
    """
    if y.ndim > 1:
        return np.stack([cross_validated(model, x, output, random_seed) for output in y.T], axis=1)
    order = np.random.default_rng(random_seed).permutation(len(y))
    residuals = np.empty(len(y))
    for fold in np.array_split(order, min(FOLDS, len(y))):
        fitted = np.setdiff1d(order, fold)
        pair = (None, None) if coarse is None else (coarse[fitted], coarse[fold])
        residuals[fold] = y[fold] - predict(model, x[fitted], y[fitted], x[fold], *pair)
    return residuals


def points_needed(model: Any, dimensions: int) -> int:
    """Return the number of design points of which nine tenths determine a surface."""
    # The least model of an unknown regressor is a constant.
    terms = model.terms(dimensions) if isinstance(model, Surface) else 1
    n = terms + 2
    while n - -(-n // min(FOLDS, n)) < terms + 1:  # without the largest fold
        n += 1
    return n
