"""Responses at points some of which are the same: each different one is computed once.

Discrete inputs have few values, and a censored one has its bounds again and again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from prbayes._validate import Floats
from prbayes.response.response import Responses

# How many points that come again are computed again, at first, to see that a response has no
# scatter of its own: one that is zero or one by chance then passes once in 16 times.
_AGAIN = 4
# Relative difference of a response that is computed again, beside others: rounding.
_SAME = 1e-6


@dataclass(frozen=True)
class Known:
    """Points whose responses are known."""

    points: Sequence[Floats]  # (m, *event): one for each aleatory input
    values: Floats  # (m,), or (m, outputs)


def once_each(responses: Responses, points: Sequence[Floats], known: Known | None) -> Floats:
    """Return the responses at points, (n,) or (n, m), of which none is computed twice; all count.

    A response that gives different values at the same point has scatter of its own, and is computed
    at all of them.

    Parameters
    ----------
    responses : Responses
        Without epistemic inputs.
    points : sequence of ndarray, shapes (n, *event)
        One for each aleatory input.
    known : Known, optional
    """
    n = len(points[0])
    before = np.empty(0) if known is None else known.values
    m = len(before)
    keys = _keys(points)
    if known is not None:
        earlier = [x[:m] for x in known.points]
        keys = np.concatenate([_keys(earlier), keys])
    _, first, which = np.unique(keys, return_index=True, return_inverse=True)
    earliest = first[which]  # where each point came first
    own = earliest[m:] == np.arange(m, m + n)
    if own.all() or responses.scatters:
        return responses(points, [])

    fresh = np.flatnonzero(own)
    repeated = np.flatnonzero(~own)
    again = repeated[:0]
    if responses.scatters is not False:
        again = _first_of_each(earliest[m:], repeated)
    asked = np.concatenate([fresh, again])
    rest = np.setdiff1d(repeated, again)
    found = before[:0]
    if asked.size:
        found = responses([x[asked] for x in points], [])
    event = found.shape[1:]
    values = np.full((m + n, *event), np.nan)
    values[:m] = before.reshape(m, *event)
    if asked.size:
        values[m + fresh] = found[: fresh.size]
        second = found[fresh.size :]
        if again.size:
            first_time = values[earliest[m + again]]
            responses.scatters = not _same(first_time, second)
    if responses.scatters:
        values[m + again] = second
        if rest.size:
            values[m + rest] = responses([x[rest] for x in points], [])
        return values[m:]
    responses.find(rest.size)
    return values[earliest[m:]]


def _keys(points: Sequence[Floats]) -> NDArray[np.void]:
    """Return the bits of each point, one item for all of its numbers, shape (n,)."""
    columns = []
    for x in points:
        size = int(np.prod(x.shape[1:], dtype=int))
        columns.append(np.asarray(x, dtype=np.float64).reshape(len(x), size))
    rows = np.concatenate(columns, axis=1)
    # Adding 0.0 makes -0.0 the number that it equals.
    bits = np.ascontiguousarray(rows + 0.0)
    return bits.view(np.dtype((np.void, bits.dtype.itemsize * bits.shape[1]))).ravel()


def _first_of_each(earliest: NDArray[np.intp], repeated: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return a few of the points that come again, different ones."""
    _, place = np.unique(earliest[repeated], return_index=True)
    return repeated[np.sort(place)[:_AGAIN]]


def _same(values: Floats, again: Floats) -> bool:
    """Return whether values are the same but for rounding."""
    # Of each output by itself: they may be of different units.
    finite = np.where(np.isfinite(values), np.abs(values), 0.0)
    size = finite.max(axis=0, initial=0.0)
    return np.allclose(values, again, rtol=_SAME, atol=_SAME * size, equal_nan=True)
