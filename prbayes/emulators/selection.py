"""Cross-validation of emulators: their error, and their weight beside the runs of a design."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from scipy.special import ndtr

from prbayes._display import without_constructor
from prbayes._stats import positive_scale
from prbayes._validate import Bools, Floats, Indices, complete_rows
from prbayes.emulators.emulator import Emulator, fit_emulator, with_failures
from prbayes.emulators.surfaces import FOLDS, Surface, as_surface


@without_constructor
@dataclass(frozen=True, eq=False)
class CrossValidation:
    """The error of a surrogate by cross-validation.

    Attributes
    ----------
    residuals : ndarray, shape (n,) or (n, m)
        Response less surrogate at each design point, fitted without it (Gaussian processes and
        radial basis functions), or without the tenth of the points that includes it; in units of
        the response, NaN where the response failed.
    population_sd : float or ndarray, shape (m,)
        Standard deviation of the response, of each output where there are several: over the prior
        predictive distribution where an input is a ``.dist()``, and else over the ranges.

    Examples
    --------
    >>> import numpy as np, prbayes as prb
    >>> prb.surrogate.CrossValidation(np.array([0.1, -0.1, 0.1]), 2.0).relative
    0.05
    """

    residuals: Floats = field(repr=False)
    population_sd: Any

    @property
    def rms(self) -> Any:
        """Root mean square, in units of the response; (m,) of several outputs."""
        return _scalar_or_array(np.sqrt(np.nanmean(self.residuals**2, axis=0)))

    @property
    def largest(self) -> Any:
        """Largest magnitude, in units of the response; (m,) of several outputs."""
        return _scalar_or_array(np.nanmax(np.abs(self.residuals), axis=0))

    @property
    def relative(self) -> Any:
        """Root mean square in units of the population's standard deviation.

        Shape (m,) of several outputs; of a constant output, zero or infinite.
        """
        sd = np.asarray(self.population_sd)
        is_constant = sd == 0
        of_constant = np.where(np.asarray(self.rms) > 0, np.inf, 0.0)
        ratio = self.rms / np.where(is_constant, 1.0, sd)
        return _scalar_or_array(np.where(is_constant, of_constant, ratio))

    def __str__(self) -> str:
        numbers = zip(*map(np.atleast_1d, (self.rms, self.relative, self.largest)), strict=True)
        return "; ".join(
            f"rms {rms:.3g} ({relative:.2%} of the population's sd), largest {largest:.3g}"
            for rms, relative, largest in numbers
        )


def _scalar_or_array(values: Any) -> Any:
    """Return an array for several outputs, or a number for one output."""
    return float(values) if np.ndim(values) == 0 else values


def points_needed(model: Any, dimensions: int) -> int:
    """Return the least number of design points such that nine tenths determine a surface."""
    terms = as_surface(model).terms(dimensions)
    n = terms + 2
    # The runs without the largest fold have to determine the surface.
    while n - -(-n // min(FOLDS, n)) < terms + 1:
        n += 1
    return n


@dataclass(frozen=True, eq=False)
class TrainingRuns:
    """Runs that an emulator is fitted on."""

    x: Floats  # (n, d): inputs
    y: Floats  # (n, m): outputs; a run with an output that is not finite is left out
    importance: Floats  # (n,): mean importance weights in the populations of interest, of sum one
    blocks: Indices  # (n,): block of each run; each block is spread over all runs

    @cached_property
    def good(self) -> Bools:
        """Which have outputs, shape (n,)."""
        return complete_rows(self.y)

    @cached_property
    def rows(self) -> Indices:
        """The different runs with outputs, on which an emulator is fitted."""
        rows = np.flatnonzero(self.good)
        return np.sort(rows[np.unique(self.x[rows], axis=0, return_index=True)[1]])

    @cached_property
    def spread(self) -> Floats:
        """The standard deviation of the inputs in the relevant populations, (d,)."""
        sd = np.sqrt(self.importance @ (self.x - self.importance @ self.x) ** 2)
        return positive_scale(sd)

    def scaled(self, x: Floats) -> Floats:
        """Return inputs in units of their spread."""
        return x / self.spread

    @cached_property
    def block_masks(self) -> Bools:
        """The runs of each block, (B, n)."""
        return np.asarray(self.blocks == np.unique(self.blocks)[:, None])

    def fit(self, tried: Sequence[Surface]) -> Emulator:
        """Return the emulator with the smallest left-out errors, weighted by importance.

        Raises numpy.linalg.LinAlgError if no surface can be fitted.
        """
        rows, d = self.rows, self.x.shape[1]
        usable = [model for model in tried if 2 * len(rows) >= 3 * model.terms(d)]
        # A part of the importance is uniform, because the errors of few important runs alone would
        # be too noisy.
        near = self.importance[rows] + 0.1 / len(self.y)
        return fit_emulator(self.scaled(self.x[rows]), self.y[rows], near, tried=usable)

    def predict(self, emulator: Emulator, at: Floats, without: Bools | None = None) -> Floats:
        """Return outputs at points, (k, d) -> (k, m), by an emulator without some runs, (n,).

        Where the nearest run failed, the outputs are those of that run. Predictions are at most one
        range of the runs' outputs beyond them.
        """
        mask = np.ones(len(self.x), dtype=bool) if without is None else ~without
        y, points = self.y[mask & self.good], self.scaled(at)
        lowest, highest = y.min(axis=0), y.max(axis=0)
        reach = highest - lowest
        values = np.clip(emulator.values(points), lowest - reach, highest + reach)
        return with_failures(values, points, self.scaled(self.x[mask]), self.y[mask])

    def predict_without_blocks(self, emulator: Emulator, at: Floats) -> Iterator[Floats]:
        """Yield the predictions, (k, m), of emulators without each block of the runs."""
        emulators = emulator.without_each(self.block_masks[:, self.rows])
        for block, without in zip(self.block_masks, emulators, strict=True):
            yield self.predict(without, at, block)

    def left_out_predictions(self, emulator: Emulator) -> Floats:
        """Return the predictions at the runs, (n, m), of emulators without the block of each."""
        values = np.empty_like(self.y)
        predictions = self.predict_without_blocks(emulator, self.x)
        for block, at_runs in zip(self.block_masks, predictions, strict=True):
            values[block] = at_runs[block]
        return values


def weight_of_runs(weights: Floats, y: Floats, predictions: Floats, blocks: Indices) -> float:
    """Return the share of a population that the runs have, from 0 (the emulator alone) to 1.

    The emulator's distribution functions have a bias, estimated from runs that were left out; those
    of weighted runs have a variance. A mixture has the least squared error where the runs' share is
    bias^2 / (bias^2 + variance). The bias is estimated without its variance.

    Weights of the runs in T populations, (T, n), have rows of sum one; outputs y, (n, m), are not
    finite where they failed; predictions, (n, m), are without the block of each run.
    """
    bias, variance = 0.0, 0.0
    member = (blocks == np.unique(blocks)[:, None]).astype(float)
    for output, prediction in zip(y.T, predictions.T, strict=True):
        steps = SmoothedSteps.of(output, weights.mean(axis=0))
        below = steps(output)
        # Errors of the emulator's distribution functions, by block, (T, B, L).
        error = steps(prediction) - below
        errors = np.einsum("tn,bn,nl->tbl", weights, member, error)
        # The variance of a sum over independent blocks is subtracted, since it adds to the squared
        # sum.
        squared_bias = errors.sum(axis=1) ** 2 - len(member) * errors.var(axis=1, ddof=1)
        bias += float(np.maximum(squared_bias, 0.0).sum(axis=-1).mean())
        # Deviations of the runs from their weighted distribution function, by block.
        function = np.einsum("tn,nl->tl", weights, below)
        deviations = below - function[:, None, :]
        by_block = np.einsum("tn,bn,tnl->tbl", weights, member, deviations)
        of_sum = len(member) * by_block.var(axis=1, ddof=1)
        variance += float(of_sum.sum(axis=-1).mean())
    return bias / (bias + variance) if bias > 0 else 0.0


@dataclass(frozen=True, eq=False)
class SmoothedSteps:
    """Smoothed indicators of values below levels: quantiles of the outputs of runs.

    The width, .2 standard deviations, is a bandwidth of a thousand data. Without it a response with
    one value for many specimens would be wrong at all of them where an emulator errs by a rounding.
    """

    levels: Floats  # (L,): levels, quantiles of the output
    width: float

    @classmethod
    def of(cls, values: Floats, importance: Floats) -> SmoothedSteps:
        """Return the steps at 32 quantiles of finite weighted values."""
        is_finite = np.isfinite(values)
        values, weights = values[is_finite], importance[is_finite]
        order = np.argsort(values)
        values, weights = values[order], weights[order]
        total = weights.sum()
        cumulated = np.cumsum(weights) - 0.5 * weights
        levels = np.interp((np.arange(32) + 0.5) / 32 * total, cumulated, values)
        low, high = np.interp(ndtr([-1.0, 1.0]) * total, cumulated, values)
        return cls(levels, 0.2 * (high - low) / 2)

    def __call__(self, values: Floats) -> Floats:
        """Return smoothed indicators of values below levels (n, L); NaN and +inf are below none."""
        if not self.width > 0:
            return (values[:, None] <= self.levels).astype(float)
        ramp = (self.levels - values[:, None]) / self.width + 0.5
        return np.clip(np.nan_to_num(ramp, nan=0.0), 0.0, 1.0)
