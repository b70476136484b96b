"""Functions of whole batches in which a specimen's response depends on the other specimens."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from prbayes._validate import Floats
from prbayes.response.failures import ResponseError

# Difference between a specimen's response by itself and among others, in spreads of all of them,
# up to which it is how a solver steps that takes a batch as one system. A mean, a sum or another
# order over specimens makes it of the order of one.
_ONE_SYSTEM = 0.01


def refuse_mixing(
    name: str, batch: tuple[int, ...], found: Floats, alone: Callable[[tuple[int, ...]], Floats]
) -> None:
    """Raise if a specimen has another response by itself than among others; one run, rarely two.

    A response that differs from itself has scatter of its own, of which nothing is said here.

    Parameters
    ----------
    name : str
        Of the simulator.
    batch : tuple of int
    found : ndarray, shape (*batch, ...)
        The responses of all specimens.
    alone : callable
        Place of a specimen -> its response, computed by itself.

    Raises
    ------
    ResponseError
    """
    event = found.shape[len(batch) :]
    rows = found.reshape(-1, int(np.prod(event, dtype=int)))
    known = np.isfinite(rows).all(axis=1)
    if known.sum() < 2:
        return
    first = int(np.flatnonzero(known)[0])
    spread = rows[known].std(axis=0)
    place = tuple(int(i) for i in np.unravel_index(first, batch))
    try:
        once = alone(place).ravel()
        if not _differ(rows[first], once, spread):
            return
        again = alone(place).ravel()
        if (np.abs(again - once) > 1e-6 * np.abs(once)).any():
            return
    except ResponseError:  # it takes no batch of one, which nobody asks of it
        return
    worst = int(np.nanargmax(np.abs(rows[first] - once)))
    raise ResponseError(
        f"{name}: the response of a specimen depends on those that it is computed with: got "
        f"{once[worst]:.6g} by itself, and {rows[first, worst]:.6g} among {len(rows)}, expected "
        "the same; look for a mean, a sum, a sort or another order over the axis of specimens, or "
        "write it for one specimen, in prb.scalar"
    )


def _differ(one: Floats, other: Floats, spread: Floats) -> bool:
    """Return whether two responses, (m,), are not the same; NaN is no other response."""
    return bool((np.abs(one - other) > _ONE_SYSTEM * spread).any())
