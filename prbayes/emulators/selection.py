"""Cross-validation of surfaces: their error, their selection, and their weight beside the runs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from prbayes._display import without_constructor
from prbayes._validate import Floats
from prbayes.emulators.gaussian_process import MOST_TUNED, GaussianProcess
from prbayes.emulators.surfaces import (
    MultifidelityModel,
    Surface,
    predict,
    tuned_for_remainder,
)

# Tenfold: Kohavi (1995), A study of cross-validation and bootstrap, IJCAI.
FOLDS = 10


@without_constructor
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

    Points (n, d) in the unit cube have responses (n,), or (n, m) with a surface for each output. A
    coarse response, (n,), is for a `MultifidelityModel`.
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
    """Return the least number of design points such that nine tenths determine a surface."""
    # The least model of an unknown regressor is a constant.
    terms = model.terms(dimensions) if isinstance(model, Surface) else 1
    n = terms + 2
    while n - -(-n // min(FOLDS, n)) < terms + 1:  # without the largest fold
        n += 1
    return n


# Most runs of a surface, whose cost grows with their cube; with more runs their weights suffice.
MOST_RUNS = 2000


@dataclass(frozen=True, eq=False)
class Runs:
    """Runs that an emulator is fitted on."""

    x: Floats  # (n, d): inputs
    y: Floats  # (n, m): outputs; a run that is not finite in one of them has none
    importance: Floats  # (n,): mean weights in the relevant populations; they sum to one
    blocks: NDArray[np.intp]  # (n,): block of each run; each block is spread over all runs
    coarse: Floats | None = None  # (n, m): outputs of a coarse response; as y, if not finite

    @cached_property
    def good(self) -> NDArray[np.bool_]:
        """Which have outputs, shape (n,)."""
        return np.isfinite(self.y).all(axis=1)

    @cached_property
    def center(self) -> Floats:
        """The mean of the inputs in the relevant populations, (d,)."""
        return self.importance @ self.x

    @cached_property
    def spread(self) -> Floats:
        """Their standard deviation, (d,)."""
        sd = np.sqrt(self.importance @ (self.x - self.center) ** 2)
        return np.where(sd > 0, sd, 1.0)

    def scaled(self, x: Floats) -> Floats:
        """Return inputs in units of their spread."""
        return np.asarray((x - self.center) / self.spread)

    def among(self, mask: NDArray[np.bool_]) -> NDArray[np.intp]:
        """Return the runs in a mask that a surface is fitted on: different, good, and not too many.

        Of too many, half are the most important ones, and half are spread over the others.
        """
        rows = np.flatnonzero(mask & self.good)
        _, first = np.unique(self.x[rows], axis=0, return_index=True)
        rows = rows[np.sort(first)]
        if rows.size > MOST_RUNS:
            order = np.argsort(-self.importance[rows], kind="stable")
            first = order[: MOST_RUNS // 2]
            rest = np.linspace(first.size, rows.size - 1, MOST_RUNS - first.size).astype(int)
            rows = np.sort(rows[np.concatenate([first, order[rest]])])
        return rows

    def most_important(self, rows: NDArray[np.intp]) -> NDArray[np.intp]:
        """Return the most important runs of some rows, on which models are tuned."""
        order = np.argsort(-self.importance[rows], kind="stable")
        return np.sort(rows[order[:MOST_TUNED]])

    @cached_property
    def block_masks(self) -> NDArray[np.bool_]:
        """The runs of each block, (B, n)."""
        return np.asarray(self.blocks == np.unique(self.blocks)[:, None])


# Processes with a length for each input. Either is the better one for some responses. Splines
# around a polynomial are better only where processes err by less than 1e-4 standard deviations.
CANDIDATES = (GaussianProcess("squared_exponential"), GaussianProcess("matern"))


def has_enough_runs(model: Any, n: int, dimensions: int) -> bool:
    """Return whether n runs determine a surface, and leave some to estimate its error."""
    terms = model.terms(dimensions) if isinstance(model, Surface) else 1
    return 2 * n >= 3 * terms


def predict_outputs(
    models: Sequence[Any],
    runs: Runs,
    at: Floats,
    mask: NDArray[np.bool_] | None = None,
    coarse: Floats | None = None,
    given: Mapping[int, Floats] = {},
) -> Floats:
    """Return outputs at points, (k, d) -> (k, m), predicted by a model of each output.

    Where the nearest run failed, the outputs are those of that run. Predictions are at most one
    range of the runs' outputs beyond them. ``mask``, (n,), selects the runs of the fit; ``coarse``,
    (k, m), is a coarse response at the points; ``given`` has predictions of some outputs, (k,).
    """
    mask = np.ones(len(runs.x), dtype=bool) if mask is None else mask
    rows = runs.among(mask)
    x, y = runs.scaled(runs.x[rows]), runs.y[rows]
    points = runs.scaled(at)
    outputs = []
    for k, model in enumerate(models):
        if k in given:
            outputs.append(given[k])
            continue
        coarse_runs = None if runs.coarse is None else runs.coarse[rows, k]
        coarse_points = None if coarse is None else coarse[:, k]
        outputs.append(predict(model, x, y[:, k], points, coarse_runs, coarse_points))
    lowest, highest = y.min(axis=0), y.max(axis=0)
    reach = highest - lowest
    values = np.clip(np.stack(outputs, axis=1), lowest - reach, highest + reach)
    if not runs.good[mask].all():
        from scipy.spatial import cKDTree

        places = np.flatnonzero(mask)
        _, index = cKDTree(runs.scaled(runs.x[places])).query(points)
        nearest = places[index]
        failed = ~runs.good[nearest]
        values[failed] = runs.y[nearest[failed]]
    return values


def predict_without_blocks(
    models: Sequence[Any], runs: Runs, at: Floats, coarse: Floats | None = None
) -> Iterator[Floats]:
    """Yield the predictions, (k, m), of surfaces without each block of the runs."""
    rows = runs.among(np.ones(len(runs.x), dtype=bool))
    x = runs.scaled(runs.x[rows])
    points = runs.scaled(at)
    by_output = {}  # (k, B), where a surface has a short way
    for k, model in enumerate(models):
        if isinstance(model, Surface):
            surfaces = model.without_each(x, runs.y[rows, k], runs.block_masks[:, rows])
            if surfaces is not None:
                by_output[k] = surfaces(points)
    for b, block in enumerate(runs.block_masks):
        given = {k: values[:, b] for k, values in by_output.items()}
        yield predict_outputs(models, runs, at, ~block, coarse, given)


def left_out_predictions(models: Sequence[Any], runs: Runs) -> Floats:
    """Return the predictions at the runs, (n, m), of surfaces without the block of each run."""
    values = np.empty_like(runs.y)
    predictions = predict_without_blocks(models, runs, runs.x, runs.coarse)
    for block, at_runs in zip(runs.block_masks, predictions, strict=True):
        values[block] = at_runs[block]
    return values


@dataclass(frozen=True, eq=False)
class _Selection:
    """The best models so far, for each output."""

    models: tuple[Any, ...]
    predictions: Floats  # (n, m): at runs that were left out
    errors: Floats  # (m,)

    def improved(self, models: Sequence[Any], runs: Runs, rows: NDArray[np.intp]) -> _Selection:
        """Return the selection with other models of the outputs that they predict better."""
        predictions = left_out_predictions(models, runs)
        # Part of the importance is uniform: the errors of a few runs alone would be noise.
        importance = runs.importance[rows] + 0.1 / len(runs.y)
        # A failure predicted by a neighbour has an error of the spread.
        y, y_left_out = runs.y[rows], predictions[rows]
        residuals = np.where(np.isfinite(y_left_out), y_left_out - y, y.std(axis=0))
        errors = importance @ residuals**2
        is_better = errors < self.errors
        pairs = zip(is_better, models, self.models, strict=True)
        return _Selection(
            models=tuple(model if better else best for better, model, best in pairs),
            predictions=np.where(is_better, predictions, self.predictions),
            errors=np.where(is_better, errors, self.errors),
        )


def select_surfaces(tried: Sequence[Any], runs: Runs) -> tuple[tuple[Any, ...], Floats]:
    """Return the model of each output with the smallest left-out errors, and its predictions.

    The predictions, (n, m), are at runs that were left out; errors are squared, and weighted by
    importance. A coarse response adds models that follow it. Raises numpy.linalg.LinAlgError if no
    surface can be fitted.
    """
    rows = runs.among(np.ones(len(runs.y), dtype=bool))
    m = runs.y.shape[1]
    best = _Selection((None,) * m, np.empty_like(runs.y), np.full(m, np.inf))
    smallest = rows.size - rows.size // len(runs.block_masks) - 1
    most_important = runs.most_important(rows)
    x, y = runs.scaled(runs.x[most_important]), runs.y[most_important]
    tuned = []
    for model in tried:
        if not has_enough_runs(model, smallest, runs.x.shape[1]):
            continue
        models = [model] * m
        with suppress(np.linalg.LinAlgError):
            if isinstance(model, Surface):
                models = [model.tuned(x, (v - v.mean()) / (v.std() or 1.0)) for v in y.T]
            best = best.improved(models, runs, rows)
            tuned.append(models)
    if None in best.models:
        raise np.linalg.LinAlgError("no surface goes through the runs")
    if runs.coarse is not None:
        otherwise = best.models
        best = _with_following(best, otherwise, otherwise, runs, rows, joined=False)
        for models in tuned:
            best = _with_following(best, models, otherwise, runs, rows, joined=True)
    return best.models, best.predictions


def _with_following(
    best: _Selection,
    models: Sequence[Any],
    otherwise: Sequence[Any],
    runs: Runs,
    rows: NDArray[np.intp],
    *,
    joined: bool,
) -> _Selection:
    """Return the selection with models that follow the coarse response where they are better.

    ``models`` are of each output, tuned without the coarse response; ``otherwise`` where there is
    none; ``joined`` makes the coarse response an input.
    """
    assert runs.coarse is not None
    rows_with_coarse = rows[np.isfinite(runs.coarse[rows]).all(axis=1)]
    largest_block = runs.block_masks[:, rows_with_coarse].sum(axis=1).max()
    smallest = rows_with_coarse.size - int(largest_block)
    dimensions = runs.x.shape[1] + joined
    if not all(has_enough_runs(model, smallest, dimensions) for model in models):
        return best
    tuning = runs.most_important(rows_with_coarse)
    x, y, coarse = runs.scaled(runs.x[tuning]), runs.y[tuning], runs.coarse[tuning]
    following = []
    for k, model in enumerate(models):
        tuned = tuned_for_remainder(model, x, y[:, k], coarse[:, k], joined=joined)
        following.append(MultifidelityModel(tuned, otherwise[k], joined))
    with suppress(np.linalg.LinAlgError):
        return best.improved(following, runs, rows)
    return best


def weight_of_runs(
    weights: Floats, y: Floats, predictions: Floats, blocks: NDArray[np.intp]
) -> float:
    """Return the share of a population that the runs have, from 0 (the emulator alone) to 1.

    The emulator's distribution functions have a bias, estimated from runs that were left out; those
    of weighted runs have a variance. A mixture has the least squared error where the runs' share is
    bias^2 / (bias^2 + variance). The bias is estimated without its variance.

    Weights of the runs in T populations, (T, n), have rows of sum one; outputs y, (n, m), are not
    finite where they failed; predictions, (n, m), are without the block of each run.
    """

    def variance_of_sum(parts: Floats) -> Floats:  # over independent blocks, (T, B, L) -> (T, L)
        return np.asarray(parts.shape[1] * parts.var(axis=1, ddof=1))

    bias, variance = 0.0, 0.0
    member = (blocks == np.unique(blocks)[:, None]).astype(float)
    for output, prediction in zip(y.T, predictions.T, strict=True):
        levels, width = _levels(output, weights.mean(axis=0))
        below = _below(output, levels, width)
        # Error of the emulator's distribution functions: by block, (T, B, L).
        error = _below(prediction, levels, width) - below
        errors = np.einsum("tn,bn,nl->tbl", weights, member, error)
        squared_bias = errors.sum(axis=1) ** 2 - variance_of_sum(errors)
        bias += float(np.maximum(squared_bias, 0.0).sum(axis=-1).mean())
        # Weighted runs around their distribution function.
        function = np.einsum("tn,nl->tl", weights, below)
        deviations = below - function[:, None, :]
        by_block = np.einsum("tn,bn,tnl->tbl", weights, member, deviations)
        variance += float(variance_of_sum(by_block).sum(axis=-1).mean())
    return bias / (bias + variance) if bias > 0 else 0.0


def _levels(values: Floats, importance: Floats) -> tuple[Floats, float]:
    """Return 32 quantiles of finite weighted values, and the width of smoothed steps there.

    The width, .2 standard deviations, is a bandwidth of a thousand data. Without it a response with
    one value for many specimens would be wrong at all of them where an emulator errs by a rounding.
    """
    is_finite = np.isfinite(values)
    values, weights = values[is_finite], importance[is_finite]
    order = np.argsort(values)
    values, weights = values[order], weights[order]
    total = weights.sum()
    cumulated = np.cumsum(weights) - 0.5 * weights
    levels = np.interp((np.arange(32) + 0.5) / 32 * total, cumulated, values)
    low, high = np.interp(ndtr([-1.0, 1.0]) * total, cumulated, values)
    return levels, 0.2 * (high - low) / 2


def _below(values: Floats, levels: Floats, width: float) -> Floats:
    """Return a smoothed indicator of values below levels, (n, L); NaN and +inf never are."""
    if not width > 0:
        return (values[:, None] <= levels).astype(float)
    ramp = (levels - values[:, None]) / width + 0.5
    return np.asarray(np.clip(np.nan_to_num(ramp, nan=0.0), 0.0, 1.0))
