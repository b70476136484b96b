"""Inputs of which an interval is known and nothing else: bounds, and no distribution."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from prbayes._validate import finite_number


@dataclass(frozen=True)
class Interval:
    """A constant of a response, the same for all specimens, that lies anywhere between two ends.

    Parameters
    ----------
    low, high : float
        In units of the input.

    Raises
    ------
    TypeError, ValueError
        If one is no finite number, or the first is not below the second.

    Examples
    --------
    >>> import prbayes as prb
    >>> prb.decision.Interval(2.4, 2.8)
    Interval(low=2.4, high=2.8)
    """

    low: float
    high: float

    def __post_init__(self) -> None:
        low = finite_number(self.low, "Interval: low")
        if finite_number(self.high, "Interval: high") <= low:
            raise ValueError(
                f"Interval: high: got {self.high} with low = {self.low}, expected more than that"
            )


def variants(inputs: Sequence[Any], steps: int) -> list[tuple[Any, ...]]:
    """Return the inputs with each combination of places in their intervals, the ends among them.

    Without intervals there is one.
    """
    choices = []
    for x in inputs:
        if isinstance(x, Interval):
            choices.append(np.linspace(x.low, x.high, steps).tolist())
        else:
            choices.append([x])
    return list(product(*choices))


def intervals(inputs: Sequence[Any]) -> int:
    """Return how many inputs are intervals."""
    return sum(isinstance(x, Interval) for x in inputs)


def told_places(inputs: Sequence[Any], variant: Sequence[Any]) -> str:
    """Return where in the intervals a variant is, as text."""
    pairs = zip(inputs, variant, strict=True)
    return ", ".join(f"{value:g}" for x, value in pairs if isinstance(x, Interval))
