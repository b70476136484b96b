"""Elements of variables, such as 'mu[1]': their names, and values by name."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from prbayes._checks import Floats


def element_name(name: str, index: tuple[int, ...]) -> str:
    """Return the name of an element, such as 'mu[1]' or 'cov[0,1]'.

    Of a scalar, the variable's own.
    """
    if not index:
        return name
    places = ",".join(map(str, index))
    return f"{name}[{places}]"


def element_names(name: str, shape: Sequence[int]) -> list[str]:
    """Return the names of all elements of a variable, in the order of its raveled values."""
    return [element_name(name, index) for index in np.ndindex(*shape)]


def split_elements(values: Mapping[Any, Any]) -> dict[str, Floats]:
    """Return arrays (n,) by the names of elements, of arrays (n, *shape) by variable."""
    found: dict[str, Floats] = {}
    for name, value in values.items():
        array = np.asarray(value)
        names = element_names(str(name), array.shape[1:])
        columns = array.reshape(len(array), len(names))
        found |= dict(zip(names, columns.T, strict=True))
    return found


def single_elements(values: Mapping[Any, Any]) -> dict[str, float]:
    """Return numbers by the names of elements, of one value of each variable."""
    rows = {name: np.asarray(value)[None] for name, value in values.items()}
    return {name: float(row[0]) for name, row in split_elements(rows).items()}


def finite_draws(posterior: Any, names: Sequence[str]) -> dict[str, Floats]:
    """Return the draws of free variables, by which populations are known.

    Raises
    ------
    ValueError
        If one is no finite number: no population belongs to it.
    """
    found = stacked_draws(posterior, names)
    for name, draws in found.items():
        known = np.isfinite(draws).reshape(len(draws), -1).all(axis=1)
        if not known.all():
            raise ValueError(
                f"posterior: {name}: got NaN or infinite values in {int((~known).sum())} of "
                f"{known.size} draws, expected finite ones; leave these draws out, or sample again"
            )
    return found


def stacked_draws(posterior: Any, names: Iterable[str] | None = None) -> dict[str, Floats]:
    """Return the draws of variables, (chains x draws, *shape), of a group with these dimensions."""
    found = {}
    for name in posterior.data_vars if names is None else names:
        values = posterior[name].transpose("chain", "draw", ...).values
        found[str(name)] = values.reshape(-1, *values.shape[2:])
    return found
