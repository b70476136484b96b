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


def told_elements(values: Mapping[Any, Any]) -> list[str]:
    """Return the elements that a table has, of arrays (n, *shape) by variable.

    Of a symmetric matrix, such as a correlation, each pair once; and no element of a square matrix
    that is the same everywhere, such as its diagonal, or the zeros of a Cholesky factor.
    """
    found = []
    for name, value in values.items():
        array = np.asarray(value)
        told = _told(array)
        own = split_elements({name: array})
        found += [element for element, kept in zip(own, told.ravel(), strict=True) if kept]
    return found


def told_of(point: Mapping[Any, Any], stderr: Mapping[Any, Any]) -> list[str]:
    """Return the same of an optimum, with the standard error of each element."""
    values = {}
    for name, value in point.items():
        at = np.asarray(value)
        error = np.asarray(stderr[name])
        # Any number stands for an error that is not known: it is not zero.
        known = np.where(np.isfinite(error), error, 1.0)
        values[name] = np.stack([at - known, at + known])
    return told_elements(values)


def _told(array: Floats) -> Any:
    """Return which elements of arrays (n, *shape) say something of their own, (*shape)."""
    shape = array.shape[1:]
    told = np.ones(shape, dtype=bool)
    if len(shape) != 2 or shape[0] != shape[1] or not len(array):
        return told
    size = np.abs(array).max(axis=0)
    # Up to rounding, of which a few operations make a few units in the last place.
    rounding = 1e-12 * size
    fixed = np.ptp(array, axis=0) <= rounding
    if fixed.all():  # nothing moved: that is to be seen
        return told
    symmetric = np.abs(array - array.swapaxes(1, 2)) <= rounding
    return np.triu(~fixed) if symmetric.all() else ~fixed


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
