"""Responses between the runs: a surface through them, chosen by what it says of runs left out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from math import comb
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prbayes._validate import Floats
from prbayes.emulators.gaussian_process import MOST_TUNED, GaussianProcess
from prbayes.emulators.multifidelity import Following, predicted, tuned_beside
from prbayes.emulators.surfaces import RadialBasis, Surface

# Runs that a surface goes through at most: its cost grows with their cube. More are left to the
# weights, which are then good enough.
MOST_RUNS = 2000


@dataclass(frozen=True, eq=False)
class Runs:
    """Runs that an emulator is fitted on.

    Attributes
    ----------
    x : ndarray, shape (n, d)
        Inputs.
    y : ndarray, shape (n, m)
        Outputs; a run that is not finite in one of them has none.
    importance : ndarray, shape (n,)
        How much weight each run has in the populations that matter; they sum to one.
    blocks : ndarray, shape (n,)
        Which of a few parts, each spread over all of them, a run belongs to.
    coarse : ndarray, shape (n, m), optional
        The same outputs by a coarse response; a run without one of them has none.
    """

    x: Floats
    y: Floats
    importance: Floats
    blocks: NDArray[np.intp]
    coarse: Floats | None = None

    @cached_property
    def good(self) -> NDArray[np.bool_]:
        """Which have outputs, shape (n,)."""
        return np.isfinite(self.y).all(axis=1)

    @cached_property
    def center(self) -> Floats:
        """The mean of the inputs in the populations that matter, (d,)."""
        return self.importance @ self.x

    @cached_property
    def spread(self) -> Floats:
        """Their standard deviation, (d,)."""
        away = self.x - self.center
        found = np.sqrt(self.importance @ away**2)
        return np.where(found > 0, found, 1.0)

    def scaled(self, x: Floats) -> Floats:
        """Return inputs in units of their spread."""
        return np.asarray((x - self.center) / self.spread)

    def among(self, kept: NDArray[np.bool_]) -> NDArray[np.intp]:
        """Return which of the runs kept a surface goes through: different, good, and not too many.

        Of too many, half are those that matter most, and half some of the others.
        """
        rows = np.flatnonzero(kept & self.good)
        _, first = np.unique(self.x[rows], axis=0, return_index=True)
        rows = rows[np.sort(first)]
        if rows.size > MOST_RUNS:
            order = np.argsort(-self.importance[rows], kind="stable")
            first = order[: MOST_RUNS // 2]
            rest = np.linspace(first.size, rows.size - 1, MOST_RUNS - first.size).astype(int)
            rows = np.sort(rows[np.concatenate([first, order[rest]])])
        return rows


# Runs up to which a spline is tried. With more it is better than processes for one of twelve
# responses, by a hundredth of the sampling noise of 50 data (benchmarks/emulators.py), and takes
# most of the time.
_SPLINED = 256


def candidates(n: int, dimensions: int) -> list[Surface]:
    """Return the surfaces that are tried on so many runs.

    Processes with a length for each input are best on nearly all responses, and with few runs a
    spline around a polynomial on what is almost a polynomial (`python -m benchmarks.emulators`).
    """
    processes: list[Surface] = [GaussianProcess("squared_exponential"), GaussianProcess("matern")]
    if n > _SPLINED:
        return processes
    degree = 2
    # A third as many terms as there are runs.
    while degree < 8 and 3 * comb(dimensions + degree + 1, dimensions) <= n:
        degree += 1
    return [*processes, RadialBasis("quintic", degree=degree)]


def enough(model: Any, n: int, dimensions: int) -> bool:
    """Return whether so many runs determine a surface, and leave some to tell its error."""
    terms = model.terms(dimensions) if isinstance(model, Surface) else 1
    # Else its polynomial takes up what tells the error.
    return 2 * n >= 3 * terms


def emulated(
    models: Sequence[Any],
    runs: Runs,
    at: Floats,
    kept: NDArray[np.bool_] | None = None,
    coarse: Floats | None = None,
) -> Floats:
    """Return what the outputs are about at points.

    Where the nearest run failed, the outputs are those of that run. Nothing is said to be further
    from the runs' outputs than these are from each other.

    Parameters
    ----------
    models : sequence of Following, Surface or regressor
        Of each output.
    runs : Runs
    at : ndarray, shape (k, d)
    kept : ndarray of bool, shape (n,), optional
        The runs that it is fitted on; all by default.
    coarse : ndarray, shape (k, m), optional
        The coarse response at the points, where there is one.

    Returns
    -------
    ndarray, shape (k, m)
    """
    kept = np.ones(len(runs.x), dtype=bool) if kept is None else kept
    rows = runs.among(kept)
    points = runs.scaled(at)
    each = [_said(model, runs, rows, k, points, coarse) for k, model in enumerate(models)]
    return _bounded(np.stack(each, axis=1), runs, rows, kept, at)


def emulated_without_each(
    models: Sequence[Any], runs: Runs, at: Floats, coarse: Floats | None = None
) -> Iterator[Floats]:
    """Yield the same, (k, m), from surfaces that lack a block of the runs each."""
    every = runs.among(np.ones(len(runs.x), dtype=bool))
    x = runs.scaled(runs.x[every])
    points = runs.scaled(at)
    blocks = np.array(list(each_block(runs)))
    known = {}  # by output, (k, B)
    for k, model in enumerate(models):
        if isinstance(model, Surface):
            predict = model.without_each(x, runs.y[every, k], blocks[:, every])
            if predict is not None:
                known[k] = predict(points)
    for b, block in enumerate(blocks):
        rows = runs.among(~block)
        each = [
            known[k][:, b] if k in known else _said(model, runs, rows, k, points, coarse)
            for k, model in enumerate(models)
        ]
        yield _bounded(np.stack(each, axis=1), runs, rows, ~block, at)


def _said(
    model: Any, runs: Runs, rows: NDArray[np.intp], k: int, points: Floats, coarse: Floats | None
) -> Floats:
    """Return what a surface through some of the runs says of output k at scaled points, (k,)."""
    here = None if runs.coarse is None else runs.coarse[rows, k]
    there = None if coarse is None else coarse[:, k]
    return predicted(model, runs.scaled(runs.x[rows]), runs.y[rows, k], points, here, there)


def _bounded(
    values: Floats, runs: Runs, rows: NDArray[np.intp], kept: NDArray[np.bool_], at: Floats
) -> Floats:
    """Return values, (k, m), not far beyond those of the runs; failed where the nearest did."""
    y = runs.y[rows]
    lowest = y.min(axis=0)
    highest = y.max(axis=0)
    reach = highest - lowest
    values = np.clip(values, lowest - reach, highest + reach)
    if not runs.good[kept].all():
        nearest = _nearest(runs, kept, at)
        failed = ~runs.good[nearest]
        values[failed] = runs.y[nearest[failed]]
    return values


def _nearest(runs: Runs, kept: NDArray[np.bool_], at: Floats) -> NDArray[np.intp]:
    """Return the run that is nearest to each point."""
    from scipy.spatial import cKDTree

    rows = np.flatnonzero(kept)
    tree = cKDTree(runs.scaled(runs.x[rows]))
    _, which = tree.query(runs.scaled(at))
    return np.asarray(rows[which])


def left_out(models: Sequence[Any], runs: Runs) -> Floats:
    """Return what surfaces say at the runs that were fitted without the block of each, (n, m)."""
    found = np.empty_like(runs.y)
    said = emulated_without_each(models, runs, runs.x, runs.coarse)
    for block, values in zip(each_block(runs), said, strict=True):
        found[block] = values[block]
    return found


def each_block(runs: Runs) -> Iterator[NDArray[np.bool_]]:
    """Yield which runs are in each block."""
    for number in np.unique(runs.blocks).tolist():
        yield runs.blocks == number


def chosen(tried: Sequence[Any], runs: Runs) -> tuple[tuple[Any, ...], Floats]:
    """Return for each output the surface whose left-out errors are smallest, and what it says.

    Errors are squared, and count where the populations that matter live. Where there is a coarse
    response, following it is another choice.

    Returns
    -------
    models : tuple of Following, Surface or regressor
        Of each output.
    said : ndarray, shape (n, m)
        What they say of runs that were left out.

    Raises
    ------
    numpy.linalg.LinAlgError
        If none can be fitted.
    """
    rows = runs.among(np.ones(len(runs.y), dtype=bool))
    best = _Best.of_none(runs, rows)
    smallest = rows.size - rows.size // np.unique(runs.blocks).size - 1
    tuned = []
    for model in tried:
        if not enough(model, smallest, runs.x.shape[1]):
            continue
        try:
            own = _tuned(model, runs, rows)
            best.take(own)
        except np.linalg.LinAlgError:
            continue
        tuned.append(own)
    if None in best.models:
        raise np.linalg.LinAlgError("no surface goes through the runs")
    if runs.coarse is not None:
        otherwise = tuple(best.models)
        _try_following(best, otherwise, otherwise, joined=False)
        for own in tuned:
            _try_following(best, own, otherwise, joined=True)
    return tuple(best.models), best.said


@dataclass(eq=False)
class _Best:
    """The best of what was tried so far, for each output."""

    runs: Runs
    rows: NDArray[np.intp]  # that surfaces go through
    least: Floats  # (m,): their errors
    models: list[Any]
    said: Floats  # (n, m): what they say of runs that were left out

    @classmethod
    def of_none(cls, runs: Runs, rows: NDArray[np.intp]) -> _Best:
        """Return what there is before anything was tried."""
        m = runs.y.shape[1]
        return cls(
            runs=runs,
            rows=rows,
            least=np.full(m, np.inf),
            models=[None] * m,
            said=np.empty_like(runs.y),
        )

    def take(self, models: Sequence[Any]) -> None:
        """Take models of the outputs for which they are better."""
        runs = self.runs
        rows = self.rows
        said = left_out(models, runs)
        # Some of the importance is the same for all: that of a few would be luck.
        importance = runs.importance[rows] + 0.1 / len(runs.y)
        # A run that failed by its neighbour is off by the spread.
        own = runs.y[rows]
        spread = own.std(axis=0)
        found = said[rows]
        off = np.where(np.isfinite(found), found - own, spread)
        error = importance @ off**2
        better = np.flatnonzero(error < self.least)
        for k in better.tolist():
            self.least[k] = error[k]
            self.models[k] = models[k]
            self.said[:, k] = said[:, k]


def _try_following(
    best: _Best, models: Sequence[Any], otherwise: Sequence[Any], *, joined: bool
) -> None:
    """Take choices that follow the coarse response where they are better.

    Parameters
    ----------
    best : _Best
    models : sequence
        Of each output, which were tuned without the coarse response.
    otherwise : sequence
        Of each output, where there is no coarse response.
    joined : bool
        Whether the coarse response is among the inputs.
    """
    runs = best.runs
    assert runs.coarse is not None
    known = best.rows[np.isfinite(runs.coarse[best.rows]).all(axis=1)]
    in_a_block = max(int(block[known].sum()) for block in each_block(runs))
    fewest = known.size - in_a_block
    dimensions = runs.x.shape[1] + joined
    if not all(enough(model, fewest, dimensions) for model in models):
        return
    some = _most_important(runs, known)
    x = runs.scaled(runs.x[some])
    found = []
    for k, model in enumerate(models):
        y = runs.y[some, k]
        coarse = runs.coarse[some, k]
        tuned = tuned_beside(model, x, y, coarse, joined=joined)
        found.append(Following(tuned, otherwise[k], joined))
    with suppress(np.linalg.LinAlgError):
        best.take(found)


def _most_important(runs: Runs, rows: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return those of the runs on which models are tuned."""
    # Those that matter most, should it take only some.
    order = np.argsort(-runs.importance[rows], kind="stable")
    return np.sort(rows[order[:MOST_TUNED]])


def _tuned(model: Any, runs: Runs, rows: NDArray[np.intp]) -> list[Any]:
    """Return a model with settings of its own for each output."""
    if not isinstance(model, Surface):
        return [model] * runs.y.shape[1]
    some = _most_important(runs, rows)
    x = runs.scaled(runs.x[some])
    found = []
    for own in runs.y[some].T:
        spread = own.std() or 1.0
        found.append(model.tuned(x, (own - own.mean()) / spread))
    return found
