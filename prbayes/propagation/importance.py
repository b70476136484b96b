"""Weighted samples of populations: stored runs, and points between them with emulated responses."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prbayes._validate import Floats
from prbayes.emulators.selection import (
    Runs,
    candidate_surfaces,
    mixing_weight,
    predict_outputs,
    predict_without_blocks,
    select_surfaces,
)
from prbayes.emulators.surfaces import MultifidelityModel
from prbayes.numerics.threads import one_thread
from prbayes.propagation.base import N_BLOCKS
from prbayes.response.budget import unlimited
from prbayes.response.failures import Replace, ResponseError
from prbayes.response.response import Responses


@dataclass(frozen=True)
class EmulatedSizes:
    """Sizes of emulated samples, whose points cost no run.

    The mixture that a sample is drawn from has few populations beside the prior: each fills its
    space evenly.
    """

    first: int = 8192  # points
    largest: int = 65536  # points
    prior_share: float = 1 / 16  # of the points, beside populations that matter
    from_prior: int = 96  # populations, beside others that matter
    near: int = 30  # populations of another group, in a sample of the first size
    # Shares of the runs in a population above which the runs stay alone, and below which they are
    # left out: a mixture has the least error in between.
    runs_alone: float = 0.95
    runs_negligible: float = 0.05


SIZES = EmulatedSizes()


@dataclass(frozen=True, eq=False)
class Sample:
    """Points with their responses and proposal density, for importance weights."""

    points: tuple[Floats, ...]  # (n, *event), by aleatory input
    values: Floats  # (n,) or (n, m); NaN without a response
    log_density: Floats  # (n,): of the mixture that the points were drawn from
    blocks: NDArray[np.intp]  # (n,): which of eight coarser samples a point belongs to

    def __len__(self) -> int:
        return len(self.values)

    def rows(self, mask: NDArray[np.bool_]) -> Sample:
        """Return some of the points."""
        points = tuple(x[mask] for x in self.points)
        return Sample(points, self.values[mask], self.log_density[mask], self.blocks[mask])


@dataclass(frozen=True, eq=False)
class EmulatedPoints:
    """Points between the runs, with a coarse response if emulators follow one."""

    inputs: tuple[Floats, ...]  # (M, *event), by aleatory input
    coarse: Floats | None = None  # (M, m)

    def __len__(self) -> int:
        return len(self.inputs[0])


@dataclass(frozen=True, eq=False)
class DesignEmulator:
    """An emulator of one response, fitted to the runs of a design."""

    runs: Runs
    surfaces: tuple[Any, ...]  # by output
    left_out: Floats  # (n, m): predictions of runs that were left out
    weights: Floats  # (T, n): of the runs in the populations that matter
    run_share: float  # mixing weight of the runs among the points of a population
    # Root mean square error of the worst output at runs that were left out, in units of its spread
    # in the populations that matter.
    error: float
    event: tuple[int, ...]  # shape of one response: () or (m,)

    def for_populations(self, weights: Floats) -> DesignEmulator | None:
        """Return the same surfaces for other populations; None where runs alone are as good."""
        return _weighed(self.runs, self.surfaces, self.left_out, weights, self.event)

    @property
    def n_following(self) -> int:
        """Number of outputs that follow a coarse response."""
        return sum(isinstance(surface, MultifidelityModel) for surface in self.surfaces)

    @one_thread()
    def at(self, points: EmulatedPoints) -> Floats:
        """Return the responses at points, (M,) or (M, m)."""
        x = columns(points.inputs)
        values = predict_outputs(self.surfaces, self.runs, x, coarse=points.coarse)
        return values.reshape(-1, *self.event)

    @one_thread()
    def without_each_block(self, points: EmulatedPoints) -> list[Floats]:
        """Return the responses by emulators that were fitted without one block of the runs."""
        x = columns(points.inputs)
        by_block = predict_without_blocks(self.surfaces, self.runs, x, points.coarse)
        return [values.reshape(-1, *self.event) for values in by_block]

    def joined(self, points: EmulatedPoints, log_density: Floats, runs: Sample) -> Sample:
        """Return emulated points and runs as one sample, in which runs have their share."""
        m, n = len(points), len(runs)
        values = self.at(points)
        blocks = np.arange(m) * N_BLOCKS // m
        if not self.run_share:
            return Sample(points.inputs, values, log_density, blocks)
        # Weights are p / g: the mean over all points together is one.
        of_points = log_density - np.log((1 - self.run_share) * (m + n) / m)
        of_runs = runs.log_density - np.log(self.run_share * (m + n) / n)
        pairs = zip(points.inputs, runs.points, strict=True)
        return Sample(
            points=tuple(np.concatenate([a, b]) for a, b in pairs),
            values=np.concatenate([values, runs.values]),
            log_density=np.concatenate([of_points, of_runs]),
            blocks=np.concatenate([blocks, runs.blocks]),
        )


@one_thread()
def fit_emulator(
    emulator: Any, runs: Sample, weights: Floats, coarse: Floats | None = None
) -> DesignEmulator | None:
    """Fit an emulator to runs; None where the runs alone are as good.

    ``emulator`` is a surface or a regressor, or a text for the best of several. ``weights``,
    (T, n), are those of the runs in the populations that matter. ``coarse``, (n, m), is a coarse
    response at the runs.
    """
    x = columns(runs.points)
    y = runs.values.reshape(len(runs), -1)
    fitted = Runs(x, y, weights.mean(axis=0), runs.blocks, coarse)
    try:
        surfaces = candidate_surfaces(*x.shape) if isinstance(emulator, str) else [emulator]
        best, left_out = select_surfaces(surfaces, fitted)
    except np.linalg.LinAlgError:
        return None
    return _weighed(fitted, best, left_out, weights, runs.values.shape[1:])


def _weighed(
    runs: Runs,
    surfaces: tuple[Any, ...],
    left_out: Floats,
    weights: Floats,
    event: tuple[int, ...],
) -> DesignEmulator | None:
    """Return an emulator with the share of the runs; None where they stay alone."""
    share = mixing_weight(weights, runs.y, left_out, runs.blocks)
    if share > SIZES.runs_alone:
        return None
    share = 0.0 if share < SIZES.runs_negligible else share
    error = _relative_error(runs, left_out, weights.mean(axis=0))
    return DesignEmulator(runs, surfaces, left_out, weights, share, error, event)


def _relative_error(runs: Runs, left_out: Floats, importance: Floats) -> float:
    """Return the error of the worst output at runs that were left out, in its spreads."""
    is_known = runs.good & np.isfinite(left_out).all(axis=1)
    y = runs.y[is_known]
    importance = importance[is_known]
    total = importance.sum()
    if not total > 0:
        return np.nan
    importance = importance / total
    spread = np.sqrt(importance @ (y - importance @ y) ** 2)
    error = np.sqrt(importance @ (left_out[is_known] - y) ** 2)
    return float((error / np.where(spread > 0, spread, 1.0)).max())


class CoarseResponse:
    """A coarse response of a simulator, which costs no run.

    Its values are NaN where it raises, which is logged.
    """

    def __init__(self, function: Callable[..., Any], expensive: Responses, executor: Any) -> None:
        self._responses = Responses(
            f"{expensive.name}: coarse",
            function,
            expensive.inputs,
            executor=executor,
            on_failure=Replace(),
            outputs=expensive.outputs,
        )
        self._has_values = False

    def __call__(self, points: Sequence[Floats]) -> Floats:
        """Return the outputs at points, (n, m).

        Raises
        ------
        ResponseError
            If they are no real numbers, have another shape than those of the expensive response, or
            are not finite at any of the points of the first call.
        """
        with unlimited():  # the user limits the expensive response
            values = self._responses(points, [])
        self._has_values = self._has_values or bool(np.isfinite(values).any())
        if not self._has_values:
            reason = next((failure.reason for failure in self._responses.failed), "it is infinite")
            raise ResponseError(
                f"{self._responses.name}: got no number at any of {len(values)} runs ({reason}), "
                "expected a response of the same inputs; repair it, or leave coarse= out"
            )
        return values.reshape(len(values), -1)


def columns(points: Sequence[Floats]) -> Floats:
    """Return inputs as columns, (n, d)."""
    flat = [x.reshape(len(x), -1).astype(float) for x in points]
    return np.concatenate(flat, axis=1)


def spread_over(group: Sequence[Floats], count: int) -> list[Floats]:
    """Return ``count`` populations, spread evenly over a group; those of a small one repeat."""
    size = len(group[0])
    rows = np.linspace(0, size - 1, count).astype(int)
    if size < count:
        rows = np.arange(count) * size // count
    return [values[rows] for values in group]


def mixture_of(groups: Sequence[Sequence[Floats]], size: int) -> tuple[list[Floats], Floats]:
    """Return the populations that an emulated sample is drawn from, and the share of each.

    The first group is the prior; groups have one array of roots, (k, *shape), by root.
    """
    prior, *posteriors = groups
    if not posteriors:
        count = 384  # more cost time and change nothing
        return spread_over(prior, count), np.full(count, 1 / count)
    near = SIZES.near * size // SIZES.first
    parts = [spread_over(prior, SIZES.from_prior), *(spread_over(g, near) for g in posteriors)]
    share = (1 - SIZES.prior_share) / (near * len(posteriors))
    shares = np.full(SIZES.from_prior + near * len(posteriors), share)
    shares[: SIZES.from_prior] = SIZES.prior_share / SIZES.from_prior
    return [np.concatenate(same) for same in zip(*parts, strict=True)], shares
