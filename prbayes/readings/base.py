"""What distributions of readings have in common: parameters, and the density of a count."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, Self

import numpy as np

from prbayes._validate import Floats, real_array


@dataclass(frozen=True)
class ReadingDistribution:
    """Distribution of a reading about the response; pass it as ``LogLikelihood(error=...)``."""

    # Parameters with an index, which is compared with that of the observed values.
    labelled: ClassVar[tuple[Any, ...]] = ()

    def __post_init__(self) -> None:
        label = f"prb.readings.{type(self).__name__}"
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        labelled = tuple(x for x in values.values() if hasattr(x, "iloc") or hasattr(x, "indexes"))
        for name, value in values.items():
            object.__setattr__(self, name, fixed(value, f"{label}: {name}"))
        object.__setattr__(self, "labelled", labelled)

    @property
    def roles(self) -> dict[str, Any]:
        """Parameters by role in the density of a reading: ``error`` and ``relative``."""
        return {}

    def mapped(self, function: Callable[[Any], Any]) -> Self:
        """Return the distribution with a function applied to each parameter."""
        return replace(self, **{f.name: function(getattr(self, f.name)) for f in fields(self)})


class Count(ReadingDistribution):
    """Distribution of a count whose mean is an exposure times the response."""

    widens: ClassVar[bool] = True  # whether the scatter grows with the parameter

    @property
    @abstractmethod
    def size(self) -> Any:
        """Exposure, the mean of the count for a response of one: a number or array."""

    @staticmethod
    @abstractmethod
    def sd(count: Floats, size: Floats, parameter: Floats) -> Floats:
        """Return the standard deviation of a normal likelihood of the mean given a count."""

    @staticmethod
    @abstractmethod
    def log_density(count: Floats, mean: Any, size: Floats, parameter: Any, xp: Any) -> Any:
        """Return the log-probability of counts, as an array or a graph."""

    @staticmethod
    @abstractmethod
    def draw(rng: np.random.Generator, mean: Floats, size: Floats, parameter: Floats) -> Floats:
        """Draw counts with the given means."""

    @staticmethod
    def highest(size: Floats) -> Floats:
        """Return the largest possible counts."""
        return np.full_like(size, np.inf)


def fixed(value: Any, label: str, *, positive: bool = True) -> Any:
    """Return a number, nested tuples of an array, a distribution or a variable of a model."""
    if value is None or hasattr(value, "owner") or isinstance(value, ReadingDistribution):
        return value
    array = real_array(value, label)
    if positive and not (array > 0).all():
        raise ValueError(f"{label}: got {value!r:.60}, expected positive numbers")
    if not np.isfinite(array).all() and not positive:
        raise ValueError(f"{label}: got {value!r:.60}, expected finite numbers")
    return as_tuples(array)


def as_tuples(array: Floats) -> Any:
    """Return an array as a number or nested tuples, which compare as values."""
    return float(array) if array.ndim == 0 else tuple(as_tuples(row) for row in array)
