"""Features of stored responses as an interpolated function of the hyperparameters.

Thousands of data sets are compared with populations of the same stored responses: what these
populations' features are is one function of the hyperparameters, and smooth. Interpolated from some
hundred populations it tells nearly where each minimum is, at a fraction of the cost; the exact
objective then takes the last step.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prbayes._checks import Floats
from prbayes._threads import one_thread
from prbayes.estimate.batch_bfgs import Descent
from prbayes.estimate.batch_objective import BatchObjective
from prbayes.metrics.base import Discrepancy

# Populations that are interpolated between. With two hyperparameters minima are then a hundredth
# of a standard error off, with five two to four hundredths; with nine more than one, and nothing is
# gained.
_BETWEEN = 600
# Numbers of a population, its points for each part of a discrepancy, from which on it pays.
WORTH = 8192
# How much further apart minima are than points at most.
_AROUND = 4.0
# Standard errors between where descents begin by the map and end, up to which it helps.
_AT_HAND = 0.3
# Intervals of a distribution function on which it is interpolated.
_INTERVALS = 1024
# Features of populations and data sets that are held at a time.
_FEATURES_AT_ONCE = 1 << 17
# Share of the features' variance that the principal components they are interpolated by leave out.
_SMALL_SHARE = 1e-10


class _UnlikeError(Exception):
    """Features that are not one array by population."""


@dataclass(frozen=True, eq=False)
class _Piece:
    """What one part of a simulator's discrepancy compares."""

    simulator: int  # of those that count in the objective
    part: int
    columns: slice  # of all features, one after the other
    constants: tuple[Any, ...]  # features that are those of any population
    nothing: Floats  # (n,): weights of a population without mass
    basis: tuple[Any, ...]  # where features depend on data; else nothing

    def of_data(self, target: Discrepancy) -> Floats:
        """Return what data sets add to the features of populations, (B, 1, c), if anything."""
        if not self.basis:
            return np.empty(0)
        return np.asarray(target.from_basis(self.nothing, self.basis, np)[0])


@dataclass(frozen=True, eq=False)
class FeatureMap:
    """Features of all simulators as a function of coordinates."""

    pieces: list[_Piece]
    interpolator: Any  # coordinates (n, r) -> scores (n, K)
    center: Floats  # (c,)
    axes: Floats  # (K, c)
    lowest: Floats  # (c,): of the populations interpolated between
    highest: Floats  # (c,)

    @classmethod
    @one_thread()
    def around(
        cls, objective: BatchObjective, points: Floats, thetas_of: Callable[[Floats], Floats]
    ) -> FeatureMap | None:
        """Return the map between populations at points, (n, r); None where too few have features.

        Whatever data sets the objective is of, the map serves all with the same values.
        """
        from scipy.interpolate import RBFInterpolator  # takes long to import

        try:
            pieces, features = _features(objective, thetas_of(points))
        except _UnlikeError:
            return None
        known = np.isfinite(features).all(axis=1)
        points, features = points[known], features[known]
        # Cubics on top of a parabola: as many as it has coefficients at least, several times over.
        r = points.shape[1]
        if len(points) < 3 * (r + 1) * (r + 2):
            return None
        center = features.mean(axis=0)
        scores, axes = _principal(features - center)
        try:
            interpolator = RBFInterpolator(points, scores, kernel="cubic", degree=2)
        except np.linalg.LinAlgError:
            return None
        lowest, highest = features.min(axis=0), features.max(axis=0)
        return cls(
            pieces=pieces,
            interpolator=interpolator,
            center=center,
            axes=axes,
            lowest=lowest,
            highest=highest,
        )

    def against(self, objective: BatchObjective) -> Callable[[Floats, Any], Floats]:
        """Return about the objective as a function of coordinates, ``(x, rows)``."""
        parts = []
        for piece in self.pieces:
            part = objective.targets[piece.simulator].parts[piece.part]
            simulator = objective.simulators[piece.simulator]
            factor = part.share / objective.scales[simulator]
            parts.append((piece, part.target, piece.of_data(part.target), factor))

        @one_thread()
        def value(x: Floats, rows: Any) -> Floats:
            values = np.empty(x.shape[:-1])
            numbers = np.arange(objective.n_sets)[rows]
            at_once = max(1, _FEATURES_AT_ONCE // (x.shape[1] * self.center.size))
            # Some data sets at a time, whose features stay near at hand.
            for first in range(0, len(x), at_once):
                some = slice(first, first + at_once)
                values[some] = of_some(x[some], numbers[some])
            return values

        def of_some(x: Floats, rows: Any) -> Floats:
            scores = self.interpolator(x.reshape(-1, x.shape[-1]))
            features = np.clip(scores @ self.axes + self.center, self.lowest, self.highest)
            total: Any = 0.0
            for piece, target, of_data, factor in parts:
                own = features[:, piece.columns].reshape(*x.shape[:-1], -1)
                if piece.basis:
                    own = own + of_data[rows]
                total = total + factor * target.rows(rows).outer(own, *piece.constants, xp=np)
            return np.asarray(np.nan_to_num(total, nan=np.inf, posinf=np.inf))

        return value


def _features(objective: BatchObjective, thetas: Floats) -> tuple[list[_Piece], Floats]:
    """Return what is interpolated, and its numbers at thetas, (P, d) -> (P, c).

    Raises
    ------
    _UnlikeError
        If a metric has several features that vary with the population.
    """
    pieces = []
    columns = []
    begin = 0
    for i, target in enumerate(objective.targets):
        weights = objective.weights(thetas[None], slice(None), i)[0]
        for k, part in enumerate(target.parts):
            one = part.target
            seen = part.of(objective.values[i])
            basis = one.thinned(one.stored(seen), _INTERVALS)
            # Against no data at all: what is left is the population's.
            alone = replace(one, weights=np.zeros(len(one.observed)))
            found, *constants = alone.from_basis(weights, basis, np)
            if found.ndim != 2 or any(np.ndim(other) > 1 for other in constants):
                raise _UnlikeError
            columns.append(found)
            own = slice(begin, begin + found.shape[1])
            begin = own.stop
            nothing = np.zeros(len(seen))
            with_data = one.from_basis(nothing, basis, np)[0].ndim > 1
            kept = basis if with_data else ()
            pieces.append(
                _Piece(
                    simulator=i,
                    part=k,
                    columns=own,
                    constants=tuple(constants),
                    nothing=nothing,
                    basis=kept,
                )
            )
    return pieces, np.concatenate(columns, axis=1)


def _principal(features: Floats) -> tuple[Floats, Floats]:
    """Return scores (P, K) on principal axes (K, c) of centered features, (P, c)."""
    variances, vectors = np.linalg.eigh(features @ features.T)
    left_out = np.cumsum(variances)
    kept = left_out > _SMALL_SHARE * left_out[-1]
    axes = vectors[:, kept].T @ features
    lengths = np.linalg.norm(axes, axis=1, keepdims=True)
    axes = axes / lengths
    return features @ axes.T, axes


class Shortcut:
    """Where descents begin: near their ends, as long as these are found there."""

    def __init__(self, points: Floats, thetas_of: Callable[[Floats], Floats]) -> None:
        """Prepare for data sets drawn at points, (n, r), whose minima scatter by one around."""
        chosen = np.linspace(0, len(points) - 1, _BETWEEN).astype(np.intp)
        points = np.unique(points[chosen], axis=0)
        middle = np.median(points, axis=0)
        # That is where minima are, further apart than the points.
        with np.errstate(divide="ignore"):
            wider = np.sqrt(1 + 1 / points.var(axis=0))
        self._points = middle + np.minimum(wider, _AROUND) * (points - middle)
        self._thetas_of = thetas_of
        self._map: FeatureMap | None = None
        self._helps = True
        self._begun = points

    def begin(
        self, objective: BatchObjective, x: Floats, descent: Descent
    ) -> tuple[Floats, Floats]:
        """Return where the descents of data sets begin, and with which inverse Hessians.

        At x, (B, r), or near their ends: (B, r), (B, r, r).
        """
        inverse = np.broadcast_to(descent.inverse, (len(x), *descent.inverse.shape[-2:]))
        if self._helps and self._map is None:
            self._map = FeatureMap.around(objective, self._points, self._thetas_of)
            self._helps = self._map is not None
        if self._helps and self._map is not None:
            found = descent(self._map.against(objective), x)
            low, high = self._points.min(axis=0), self._points.max(axis=0)
            inside = found.converged & ((found.x > low) & (found.x < high)).all(axis=1)
            x = np.where(inside[:, None], found.x, x)
            inverse = np.where(inside[:, None, None], found.inverse, inverse)
        self._begun = x
        return x, inverse

    def learn(self, x: Floats, converged: NDArray[np.bool_]) -> None:
        """Take note of where the descents ended, (B, r): far away the map does not help."""
        off = np.abs(x - self._begun).max(axis=1)[converged]
        self._helps = self._helps and (not off.size or float(np.median(off)) < _AT_HAND)
