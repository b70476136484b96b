"""Points that a design takes weights of: its runs, or a cloud whose responses are emulated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prbayes._validate import Floats
from prbayes.emulators.multifidelity import Following
from prbayes.emulators.selection import (
    Runs,
    candidates,
    chosen,
    emulated,
    emulated_without_each,
    share_of_runs,
)
from prbayes.numerics.threads import one_thread
from prbayes.propagation.base import N_BLOCKS

# Points of a cloud at first, and at most: they cost no run.
CLOUD = 8192
LARGEST_CLOUD = 65536
# Populations of a group at most: more would cost time and add nothing.
_POPULATIONS = 384
# The share of a cloud that the prior keeps beside populations that are known to matter: it is only
# to stay in reach, and its points among theirs are noise. Of those the mixture is of few, so that
# each has enough points to fill its space evenly, and of more in a larger cloud.
_OF_PRIOR = 1 / 16
_FROM_PRIOR = 96
_NEAR = 30
# Share of the runs in a population from which on it is theirs alone, and to which it is the
# emulator's: what is in between has the least error.
_ALONE, _LITTLE = 0.95, 0.05


@dataclass(frozen=True, eq=False)
class Table:
    """Points with their responses and density, of which weights are taken.

    Attributes
    ----------
    points : tuple of ndarray, shapes (n, *event)
        Of each aleatory input.
    values : ndarray, shape (n,) or (n, m)
        Their responses.
    log_g : ndarray, shape (n,)
        Log density of the mixture that they were drawn from.
    blocks : ndarray, shape (n,)
        Which of eight coarser tables each point belongs to.
    """

    points: tuple[Floats, ...]
    values: Floats
    log_g: Floats
    blocks: NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points without runs, and how their responses are emulated."""

    points: tuple[Floats, ...]  # (M, *event): of each aleatory input
    log_g: Floats  # (M,)
    coarse: Floats | None = None  # (M, m): of a coarse response, if emulators follow one

    def __len__(self) -> int:
        return len(self.log_g)


@dataclass(frozen=True, eq=False)
class Emulation:
    """An emulator of one response on the runs of a design, with a cloud to say it of.

    Attributes
    ----------
    runs : Runs
    models : tuple
        The surface that was chosen for each output.
    said : ndarray, shape (n, m)
        What they say of runs that were left out.
    weights : ndarray, shape (T, n)
        Of the runs in the populations that matter.
    share : float
        The share of a population that the runs are.
    error : float
        Root mean square error of the worst output at runs that were left out, where the populations
        that matter live, in units of its spread there.
    event : tuple of int
        Shape of one response: () or (m,).
    """

    runs: Runs
    models: tuple[Any, ...]
    said: Floats
    weights: Floats
    share: float
    error: float
    event: tuple[int, ...]

    @classmethod
    @one_thread()
    def of(
        cls,
        emulator: Any,
        points: Sequence[Floats],
        values: Floats,
        weights: Floats,
        blocks: NDArray[np.intp],
        coarse: Floats | None = None,
    ) -> Emulation | None:
        """Choose an emulator; None where runs alone are as good.

        Parameters
        ----------
        emulator : str, Surface or regressor
            Several are tried by default.
        points : sequence of ndarray, shapes (n, *event)
        values : ndarray, shape (n,) or (n, m)
        weights : ndarray, shape (T, n)
            Of the runs in the populations that matter.
        blocks : ndarray, shape (n,)
        coarse : ndarray, shape (n, m), optional
            A coarse response at the runs.
        """
        x = columns(points)
        y = values.reshape(len(values), -1)
        runs = Runs(x, y, weights.mean(axis=0), blocks, coarse)
        try:
            tried = candidates(*x.shape) if isinstance(emulator, str) else [emulator]
            models, said = chosen(tried, runs)
        except np.linalg.LinAlgError:
            return None
        return cls._judged(runs, models, said, weights, values.shape[1:])

    @classmethod
    def _judged(
        cls,
        runs: Runs,
        models: tuple[Any, ...],
        said: Floats,
        weights: Floats,
        event: tuple[int, ...],
    ) -> Emulation | None:
        """Return it with the share that the runs have, for the populations that matter."""
        share = share_of_runs(weights, runs.y, said, runs.blocks)
        if share > _ALONE:
            return None
        share = 0.0 if share < _LITTLE else share
        error = _error(runs, said, weights.mean(axis=0))
        return cls(
            runs=runs,
            models=models,
            said=said,
            weights=weights,
            share=share,
            error=error,
            event=event,
        )

    def elsewhere(self, weights: Floats) -> Emulation | None:
        """Return the same surfaces for other populations; None where runs alone are as good."""
        return self._judged(self.runs, self.models, self.said, weights, self.event)

    @property
    def following(self) -> int:
        """How many outputs follow a coarse response, of which a cloud then needs values."""
        return sum(isinstance(model, Following) for model in self.models)

    @one_thread()
    def at(self, cloud: Cloud) -> Floats:
        """Return the responses at the cloud's points, (M,) or (M, m)."""
        found = emulated(self.models, self.runs, columns(cloud.points), coarse=cloud.coarse)
        return found.reshape(-1, *self.event)

    @one_thread()
    def without_each_block(self, cloud: Cloud) -> list[Floats]:
        """Return the same from emulators that were fitted without a block of the runs each."""
        at = columns(cloud.points)
        found = emulated_without_each(self.models, self.runs, at, cloud.coarse)
        return [values.reshape(-1, *self.event) for values in found]

    def joined(self, cloud: Cloud, said: Floats, runs: Table) -> Table:
        """Return cloud and runs as one table, in which the runs have their share."""
        m = len(cloud)
        n = len(runs.log_g)
        blocks = np.arange(m) * N_BLOCKS // m
        if not self.share:
            return Table(cloud.points, said, cloud.log_g, blocks)
        # Weights are p / g: that of all points together is on average one.
        of_cloud = cloud.log_g - np.log((1 - self.share) * (m + n) / m)
        of_runs = runs.log_g - np.log(self.share * (m + n) / n)
        pairs = zip(cloud.points, runs.points, strict=True)
        return Table(
            points=tuple(np.concatenate([a, b]) for a, b in pairs),
            values=np.concatenate([said, runs.values]),
            log_g=np.concatenate([of_cloud, of_runs]),
            blocks=np.concatenate([blocks, runs.blocks]),
        )


def _error(runs: Runs, said: Floats, importance: Floats) -> float:
    """Return the relative error of the worst output at runs that were left out."""
    known = runs.good & np.isfinite(said).all(axis=1)
    y = runs.y[known]
    importance = importance[known]
    total = importance.sum()
    if not total > 0:
        return np.nan
    importance = importance / total
    spread = np.sqrt(importance @ (y - importance @ y) ** 2)
    off = np.sqrt(importance @ (said[known] - y) ** 2)
    return float((off / np.where(spread > 0, spread, 1.0)).max())


def columns(points: Sequence[Floats]) -> Floats:
    """Return inputs as columns, (n, d)."""
    flat = [x.reshape(len(x), -1).astype(float) for x in points]
    return np.concatenate(flat, axis=1)


def some_of(group: Sequence[Floats], most: int = _POPULATIONS) -> list[Floats]:
    """Return populations of a group, spread over it; a few come again and again, equally often."""
    size = len(group[0])
    places = np.linspace(0, size - 1, most).astype(int)
    if size < most:
        places = np.arange(most) * size // most
    return [values[places] for values in group]


def mixture_of(groups: Sequence[Sequence[Floats]], size: int) -> tuple[list[Floats], Floats]:
    """Return the populations that a cloud is drawn from, and the share that each has of it.

    Parameters
    ----------
    groups : sequence
        The prior's, and others that are known to matter; arrays (k, *shape) of the roots each.
    size : int
        Of the cloud.
    """
    prior, *others = groups
    if not others:
        found = some_of(prior)
        return found, np.full(_POPULATIONS, 1 / _POPULATIONS)
    near = _NEAR * size // CLOUD
    chosen = [some_of(prior, _FROM_PRIOR), *(some_of(group, near) for group in others)]
    each = (1 - _OF_PRIOR) / (near * len(others))
    shares = np.full(_FROM_PRIOR + near * len(others), each)
    shares[:_FROM_PRIOR] = _OF_PRIOR / _FROM_PRIOR
    return [np.concatenate(same) for same in zip(*chosen, strict=True)], shares
