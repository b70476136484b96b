"""The error of a surrogate by cross-validation."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from prbayes._validate import Floats
from prbayes.emulators.multifidelity import predicted
from prbayes.emulators.surfaces import Surface

# Tenfold: Kohavi (1995), A study of cross-validation and bootstrap for accuracy estimation and
# model selection, IJCAI. More folds are nearer to the surface through all points, and cost as many
# more fits.
FOLDS = 10


@dataclass(frozen=True, eq=False)
class CrossValidation:
    """The error of a surrogate by cross-validation.

    Attributes
    ----------
    residuals : ndarray, shape (n,) or (n, m)
        Response less surrogate at each design point, fitted without a tenth of the points that this
        one belongs to; in units of the response, NaN where the response failed.
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
        """Root mean square in units of the population's standard deviation; of a constant too.

        Shape (m,) of several outputs.
        """
        sd = np.asarray(self.population_sd)
        constant = sd == 0
        of_constant = np.where(np.asarray(self.rms) > 0, np.inf, 0.0)
        return _number(np.where(constant, of_constant, self.rms / np.where(constant, 1.0, sd)))

    def __str__(self) -> str:
        each = zip(*map(np.atleast_1d, (self.rms, self.relative, self.largest)), strict=True)
        told = [
            f"rms {rms:.3g} ({relative:.2%} of the population's sd), largest {largest:.3g}"
            for rms, relative, largest in each
        ]
        return "; ".join(told)


def _number(values: Any) -> Any:
    """Return an array of several outputs, or the number of one."""
    return float(values) if np.ndim(values) == 0 else values


def cross_validated(
    model: Any, x: Floats, y: Floats, random_seed: int, coarse: Floats | None = None
) -> Floats:
    """Return responses less what a surface says that was fitted without their tenth of the points.

    Parameters
    ----------
    model : Following, Surface or regressor
    x : ndarray, shape (n, d)
        In the unit cube.
    y : ndarray, shape (n,) or (n, m)
        Each output has a surface of its own.
    random_seed : int
        Of the order in which points are dealt out to folds.
    coarse : ndarray, shape (n,), optional
        A coarse response, for a model that follows one.

    Returns
    -------
    ndarray
        Of the shape of y.
    """
    if y.ndim > 1:
        each = [cross_validated(model, x, own, random_seed) for own in y.T]
        return np.stack(each, axis=1)
    order = np.random.default_rng(random_seed).permutation(len(y))
    residuals = np.empty(len(y))
    for fold in np.array_split(order, min(FOLDS, len(y))):
        kept = np.setdiff1d(order, fold)
        pair = (None, None) if coarse is None else (coarse[kept], coarse[fold])
        residuals[fold] = y[fold] - predicted(model, x[kept], y[kept], x[fold], *pair)
    return residuals


def points_needed(model: Any, dimensions: int) -> int:
    """Return how many design points a surface needs, so that nine tenths of them determine it."""
    # Nothing is known of a regressor: a constant is the least that it fits.
    terms = model.terms(dimensions) if isinstance(model, Surface) else 1
    n = terms + 2
    while n - _largest_fold(n) < terms + 1:
        n += 1
    return n


def _largest_fold(n: int) -> int:
    """Return the size of the largest fold of n points."""
    folds = min(FOLDS, n)
    return -(-n // folds)
