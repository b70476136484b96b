"""Responses between the runs: a surface through them, chosen by what it says of runs left out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prbayes._checks import Floats
from prbayes.emulators.surfaces import RadialBasis, Surface, fitted

# Runs that a surface goes through at most: its cost grows with their cube. More are left to the
# weights, which are then good enough.
MOST_RUNS = 2000
# Surfaces that are tried. Splines that bend little beside those that bend much: what is best
# depends on the response (benchmarks/emulators.py).
CANDIDATES: tuple[Surface, ...] = (
    RadialBasis("linear"),
    RadialBasis("cubic"),
    RadialBasis("cubic", degree=2),
    RadialBasis("quintic"),
)


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
    """

    x: Floats
    y: Floats
    importance: Floats
    blocks: NDArray[np.intp]

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

        Those that matter least are left out first.
        """
        rows = np.flatnonzero(kept & self.good)
        _, first = np.unique(self.x[rows], axis=0, return_index=True)
        rows = rows[np.sort(first)]
        if rows.size > MOST_RUNS:
            order = np.argsort(-self.importance[rows], kind="stable")
            rows = np.sort(rows[order[:MOST_RUNS]])
        return rows


def enough(model: Any, n: int, dimensions: int) -> bool:
    """Return whether so many runs determine a surface, and leave some to tell its error."""
    terms = model.terms(dimensions) if isinstance(model, Surface) else 1
    # Twice the terms: else its polynomial takes up what tells the error.
    return n >= 2 * terms


def emulated(model: Any, runs: Runs, at: Floats, kept: NDArray[np.bool_] | None = None) -> Floats:
    """Return what the outputs are about at points.

    Where the nearest run failed, the outputs are those of that run. Nothing is said to be further
    from the runs' outputs than these are from each other.

    Parameters
    ----------
    model : Surface or regressor
    runs : Runs
    at : ndarray, shape (k, d)
    kept : ndarray of bool, shape (n,), optional
        The runs that it is fitted on; all by default.

    Returns
    -------
    ndarray, shape (k, m)
    """
    kept = np.ones(len(runs.x), dtype=bool) if kept is None else kept
    rows = runs.among(kept)
    y = runs.y[rows]
    values = fitted(model, runs.scaled(runs.x[rows]), y)(runs.scaled(at))
    lowest, highest = y.min(axis=0), y.max(axis=0)
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


def left_out(model: Any, runs: Runs) -> Floats:
    """Return what surfaces say at the runs that were fitted without the block of each, (n, m)."""
    found = np.empty_like(runs.y)
    for block, _ in each_block(runs):
        found[block] = emulated(model, runs, runs.x[block], ~block)
    return found


def each_block(runs: Runs) -> Iterator[tuple[NDArray[np.bool_], int]]:
    """Yield which runs are in each block, and its number."""
    for number in np.unique(runs.blocks).tolist():
        yield runs.blocks == number, number


def chosen(candidates: Sequence[Any], runs: Runs) -> tuple[Any, Floats]:
    """Return the candidate whose left-out errors are smallest, and what it says of runs left out.

    Errors are squared, in units of each output's spread, where the populations that matter live.

    Raises
    ------
    numpy.linalg.LinAlgError
        If none can be fitted.
    """
    rows = runs.among(np.ones(len(runs.x), dtype=bool))
    spread = runs.y[rows].std(axis=0)
    spread = np.where(spread > 0, spread, 1.0)
    least, best = np.inf, None
    # Half of the importance is the same for all: that of a few would be luck.
    importance = 0.5 * runs.importance + 0.5 / len(runs.x)
    for model in candidates:
        smallest = rows.size - rows.size // np.unique(runs.blocks).size - 1
        if not enough(model, smallest, runs.x.shape[1]):
            continue
        try:
            said = left_out(model, runs)
        except np.linalg.LinAlgError:
            continue
        off = (said[rows] - runs.y[rows]) / spread
        error = float(importance[rows] @ np.nan_to_num(off**2, nan=1.0, posinf=1.0).sum(axis=1))
        if error < least:
            least, best = error, (model, said)
    if best is None:
        raise np.linalg.LinAlgError("no surface goes through the runs")
    return best
