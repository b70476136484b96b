"""How much the scatter of each input contributes to that of a response, in one population."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from prbayes._validate import Floats
from prbayes.decision.indices import (
    REPLICATES,
    Indices,
    derivative_bound,
    first_order,
    total_order,
)
from prbayes.decision.inverse_transform import Specimens
from prbayes.decision.populations import Told
from prbayes.decision.quantities import Quantity
from prbayes.numerics.points import sobol

# Step of differences in standard normal numbers, over which emulators are smooth. Half or twice
# changes an index of Ishigami's function by less than a hundredth (tests/decision/test_scatter.py).
_SCORE_STEP = 0.02


# Specimens for each point of the hyperparameters: they cost an emulator where those cost weights of
# a whole design. By judgement.
_MORE = 4


@dataclass(frozen=True, eq=False)
class _Matched:
    """Points as normal numbers, all in one array, and where each set of them is."""

    z: Floats  # (sets, r, n, D)
    inputs: int
    columns: int

    @classmethod
    def of(cls, specimens: Specimens, samples: int, seed: int) -> _Matched:
        """Return points, points that share or lack one input, and neighbours of all of them."""
        n = samples // REPLICATES
        d = specimens.size
        nets = [ndtri(sobol(n, 2 * d, seed + 7919 * r)) for r in range(REPLICATES)]
        here, elsewhere = np.split(np.array(nets), 2, axis=-1)
        same = []
        other = []
        around = []
        for own in specimens.columns:
            taken = np.isin(np.arange(d), np.arange(d)[own])
            other.append(np.where(taken, elsewhere, here))
            same.append(np.where(taken, here, elsewhere))
        for step in np.eye(d) * _SCORE_STEP / 2:
            around += [here + step, here - step]
        return cls(np.array([here, *same, *other, *around]), len(same), d)

    def indices(
        self, values: Floats, columns: list[slice], *, smooth: bool
    ) -> tuple[Floats, Floats, Floats]:
        """Return first, total and derivative-based indices by replicate, (r, inputs) each."""
        ends = 1 + self.inputs * np.arange(3)
        (here,), same, other, around = np.split(values, ends, axis=0)
        slopes = (around[::2] - around[1::2]) / _SCORE_STEP
        first = []
        total = []
        derivative = []
        for i, own in enumerate(columns):
            first.append(first_order(here, same[i]))
            total.append(total_order(here, other[i]))
            squares = (slopes[own] ** 2).sum(axis=0)
            derivative.append(derivative_bound(squares, here))
        if not smooth:
            derivative = [np.full_like(one, np.nan) for one in derivative]
        rows = (first, total, derivative)
        return tuple(np.transpose(row) for row in rows)  # type: ignore[return-value]


@dataclass(frozen=True, eq=False)
class Scatter:
    """The indices of inputs, or why there are none."""

    indices: Indices
    reason: str = ""


def scatter(told: Told, quantity: Quantity, samples: int, seed: int, *, computed: bool) -> Scatter:
    """Return the share of each input of a design in the variance of a response.

    In the population at the centre of the result, whose inputs are independent of each other. The
    errors have that of an emulator in them, as those say that lack a block of the runs each.

    Parameters
    ----------
    told : Told
    quantity : Quantity
        Says what of a response counts.
    samples : int
        Points from which all others are made.
    seed : int
    computed : bool
        Whether the response is called, or emulated.
    """
    populations = told.populations
    center = populations.center[None]
    try:
        specimens = Specimens(
            told.responses.name, told.design.inputs, populations.evaluator.roots(center, told.k)
        )
    except TypeError as error:
        return _unknown(told, str(error))
    matched = _Matched.of(specimens, _MORE * samples, seed)
    rows = matched.z.reshape(-1, specimens.size)
    responses = _responses(told, specimens, rows, computed=computed)
    if not responses:
        return _unknown(
            told,
            "between the runs nothing tells the response; computed=True calls it at new specimens",
        )
    (at,) = told.at(quantity, center)
    found = []
    for each in responses:
        values = quantity.of_specimen(each, at).reshape(matched.z.shape[:-1])
        found.append(matched.indices(values, specimens.columns, smooth=quantity.differentiable))
    whole = Indices.of(*found[0])
    return Scatter(_with_error(whole, found))


def _responses(told: Told, specimens: Specimens, z: Floats, *, computed: bool) -> list[Floats]:
    """Return the response at normal numbers, (N,), and as emulators without a block of runs say."""
    if computed:
        return [told.column(specimens.computed(told.responses, z))]
    if told.design.has_runs and told.design.is_line:
        return [_on_a_line(told, specimens.at(z)[0])]
    return told.emulated(specimens.at(z))


def _on_a_line(told: Told, x: Floats) -> Floats:
    """Return the response of one input, straight between the runs, (N,)."""
    (at,) = told.points
    values = told.column(told.every)
    order = np.argsort(at)
    at = at[order]
    values = values[order]
    known = np.isfinite(values)
    found = np.interp(x, at[known], values[known])
    # Where the nearest run failed, or has no response, there is none.
    middles = (at[1:] + at[:-1]) / 2
    nearest = values[np.searchsorted(middles, x)]
    return np.where(np.isfinite(nearest), found, nearest)


def _with_error(whole: Indices, found: list[tuple[Floats, Floats, Floats]]) -> Indices:
    """Return indices with the error of the emulator in theirs."""
    errors = []
    names = ("first", "total", "derivative")
    for i, name in enumerate(names):
        center = getattr(whole, name)
        apart = [(each[i].mean(axis=0) - center) ** 2 for each in found[1:]]
        own = getattr(whole, f"{name}_error")
        errors.append(np.sqrt(own**2 + np.sum(apart, axis=0)))
    return Indices(whole.first, whole.total, whole.derivative, *errors)


def _unknown(told: Told, reason: str) -> Scatter:
    nothing = np.full(len(told.design.inputs.aleatory), np.nan)
    return Scatter(Indices(*[nothing] * 6), reason)
