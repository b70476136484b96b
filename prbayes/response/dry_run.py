"""What would be computed of a response, without computing it; and one specimen that is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from prbayes._validate import Floats
from prbayes.response.call import Points, Tally, respond
from prbayes.response.costs import DryRun
from prbayes.response.failures import Abort
from prbayes.response.response import Responses, Runs


class _AskedError(Exception):
    """A response was asked for."""

    def __init__(self, points: Points) -> None:
        super().__init__()
        self.points = points


class Rehearsal(Responses):
    """Responses of which none is computed, unless one is tried.

    Parameters
    ----------
    responses : Responses
        Whose function, inputs and settings they have.
    """

    def __init__(self, responses: Responses) -> None:
        vars(self).update(vars(responses.copied()))
        self.runs = Runs()

    def _computed(self, given: list[Floats]) -> Floats:
        _, points = self._rows(given)
        raise _AskedError(points)

    def asked(self, begin: Callable[[Responses], object]) -> Points | None:
        """Return the points that are asked for first, None if there are none."""
        try:
            begin(self)
        except _AskedError as error:
            return error.points
        return None

    def stored(self, points: Points) -> NDArray[np.bool_]:
        """Return at which of the points nothing has to be computed, as the store has it."""
        store = self._calling.store
        known = np.zeros(len(points), dtype=bool)
        if store is None:
            return known
        keys = points.keys()
        _, known = store.find(keys)
        if not self._calling.takes_failures:
            known[list(store.failed(keys))] = False
        return known

    def tried(self, points: Points) -> DryRun:
        """Run one of the points, whatever becomes of failures in the study.

        It is one in the middle of those that are missing, so that it is found in the store later.

        Raises
        ------
        ResponseError
            If it fails, or is NaN.
        """
        store = self._calling.store
        some = np.flatnonzero(~self.stored(points))
        if not some.size:
            store = None
            some = np.arange(len(points))
        keys = points.keys()[some]
        middle = _middle(keys)
        point = points.at(some[[middle]])
        calling = replace(self._calling, on_failure=Abort(on_nan=True), store=store)
        tally = Tally()
        values = respond(calling, point, tally).ravel()
        outputs = dict(zip(self._names(values.size), values.tolist(), strict=True))
        numbers = tuple(keys[middle].tolist())
        return DryRun(numbers, outputs, tally.seconds)

    def _names(self, number: int) -> tuple[str, ...]:
        """Return what each output is called."""
        named = () if self.outputs is None else self.outputs.names
        if named:
            return named
        if number == 1:
            return (self.name,)
        return tuple(f"{self.name}[{i}]" for i in range(number))


def _middle(keys: Floats) -> int:
    """Return which point is in the middle of all, by the ranks of each of its numbers."""
    from scipy.stats import rankdata

    ranks = rankdata(keys, axis=0)
    off = ranks - (len(keys) + 1) / 2
    return int((off**2).sum(axis=1).argmin())
