"""Elements of variables, such as 'mu[1]' or 'mu[Adler]': their names, and values by name."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np
import xarray as xr

from prbayes._validate import Floats


def element_name(name: str, index: Sequence[object]) -> str:
    """Return the name of an element, such as 'mu[1]', 'cov[0,1]' or 'mu[Adler]'.

    Of a scalar, the variable's own.
    """
    if not index:
        return name
    places = ",".join(map(str, index))
    return f"{name}[{places}]"


def element_names(name: str, shape: Sequence[int], labels: Sequence[Any] = ()) -> list[str]:
    """Return the names of all elements of a variable, in the order of its raveled values.

    Parameters
    ----------
    name : str
    shape : sequence of int
    labels : sequence
        Of each axis: its coordinate, or None. Where that does not name each place of the axis by a
        text of its own, the number does.
    """
    unknown = [None] * len(shape)
    given = labels if len(labels) == len(shape) else unknown
    axes = []
    for size, own in zip(shape, given, strict=True):
        axes.append(_places(size, own))
    indices = product(*axes)
    return [element_name(name, index) for index in indices]


def _places(size: int, labels: Any) -> Sequence[object]:
    """Return what the places along an axis are called."""
    if labels is None:
        return range(size)
    values = np.asarray(labels).tolist()
    texts = list(map(str, values))
    distinct = len(set(texts))
    return texts if distinct == len(texts) == size else range(size)


def coordinates(model: Any, name: str) -> tuple[Any, ...]:
    """Return the coordinate of each axis of a variable of a model, None where it has none."""
    dims = model.named_vars_to_dims.get(name) or ()
    known = model.coords
    return tuple(known.get(dim) for dim in dims)


def with_coordinates(draws: Mapping[str, xr.DataArray], model: Any) -> dict[str, xr.DataArray]:
    """Return draws, (n, *shape) by variable, where they carry none with a model's coordinates."""
    found = {}
    for name, values in draws.items():
        own = coordinates(model, name)
        dims = values.dims[1:]
        fits = len(own) == len(dims)
        known = zip(dims, own, strict=True) if fits else ()
        for dim, labels in known:
            values = _with_coordinate(values, dim, labels)
        found[name] = values
    return found


def _with_coordinate(values: xr.DataArray, dim: Any, labels: Any) -> xr.DataArray:
    """Return an array with labels along a dimension, where it has none and they fit."""
    if labels is None or dim in values.coords:
        return values
    if len(labels) != values.sizes[dim]:
        return values
    coordinate = np.asarray(labels)
    return values.assign_coords({dim: coordinate})


def _carried(value: Any) -> tuple[Any, ...]:
    """Return the coordinate of each axis that an array carries; none of a plain one."""
    if not isinstance(value, xr.DataArray):
        return ()
    found = []
    for dim in value.dims:
        known = dim in value.coords
        labels = value.coords[dim].values if known else None
        found.append(labels)
    return tuple(found)


def split_elements(values: Mapping[Any, Any]) -> dict[str, Floats]:
    """Return arrays (n,) by the names of elements, of arrays (n, *shape) by variable.

    Coordinates that they carry are in the names.
    """
    found: dict[str, Floats] = {}
    for name, value in values.items():
        array = np.asarray(value)
        names = _names(name, value)
        columns = array.reshape(len(array), len(names))
        found |= dict(zip(names, columns.T, strict=True))
    return found


def single_elements(values: Mapping[Any, Any]) -> dict[str, float]:
    """Return numbers by the names of elements, of one value of each variable."""
    found: dict[str, float] = {}
    for name, value in values.items():
        shape = np.shape(value)
        names = element_names(str(name), shape, _carried(value))
        numbers = np.ravel(value).astype(float)
        found |= dict(zip(names, numbers.tolist(), strict=True))
    return found


def _names(name: Any, value: Any) -> list[str]:
    """Return the names of the elements of arrays, (n, *shape)."""
    _, *shape = np.shape(value)
    labels = _carried(value)
    return element_names(str(name), shape, labels[1:])


def told_elements(values: Mapping[Any, Any]) -> list[str]:
    """Return the elements that a table has, of arrays (n, *shape) by variable.

    Of a symmetric matrix, such as a correlation, each pair once; and no element of a square matrix
    that is the same everywhere, such as its diagonal, or the zeros of a Cholesky factor.
    """
    found = []
    for name, value in values.items():
        told = _told(np.asarray(value)).ravel()
        own = _names(name, value)
        found += [element for element, kept in zip(own, told, strict=True) if kept]
    return found


def told_of(point: Mapping[Any, Any], stderr: Mapping[Any, Any]) -> list[str]:
    """Return the same of an optimum, with the standard error of each element."""
    found = []
    for name, value in point.items():
        at = np.asarray(value)
        error = np.asarray(stderr[name])
        # Any number stands for an error that is not known: it is not zero.
        known = np.where(np.isfinite(error), error, 1.0)
        told = _told(np.stack([at - known, at + known])).ravel()
        own = element_names(str(name), at.shape, _carried(value))
        found += [element for element, kept in zip(own, told, strict=True) if kept]
    return found


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


def variable_of(element: str) -> str:
    """Return the name of the variable that an element belongs to."""
    return element.partition("[")[0]


def read_variables(names: Iterable[str], among: Collection[str]) -> list[str]:
    """Return the variables that are read for some, each once.

    For a `pymc.LKJCholeskyCov`, a packed factor, its standard deviations and correlations.
    """
    read = []
    for name in names:
        instead = [f"{name}_stds", f"{name}_corr"]
        read += instead if set(instead) <= set(among) else [name]
    return list(dict.fromkeys(read))


def read_elements(elements: Iterable[str]) -> list[str]:
    """Return elements without those of packed factors beside what is read for them."""
    variables = {element: variable_of(element) for element in elements}
    every = set(variables.values())
    read = set(read_variables(every, every))
    return [element for element, variable in variables.items() if variable in read]


def finite_draws(posterior: Any, names: Sequence[str]) -> dict[str, Floats]:
    """Return the draws of free variables, by which populations are known.

    Raises
    ------
    ValueError
        If one is no finite number: no population belongs to it.
    """
    stacked = stacked_draws(posterior, names)
    found = {name: draws.values for name, draws in stacked.items()}
    for name, draws in found.items():
        known = np.isfinite(draws).reshape(len(draws), -1).all(axis=1)
        if not known.all():
            raise ValueError(
                f"posterior: {name}: got NaN or infinite values in {int((~known).sum())} of "
                f"{known.size} draws, expected finite ones; leave these draws out, or sample again"
            )
    return found


def stacked_draws(posterior: Any, names: Iterable[str] | None = None) -> dict[str, xr.DataArray]:
    """Return the draws of variables, (chains x draws, *shape), of a group with these dimensions.

    They carry the coordinates of their other dimensions.
    """
    found = {}
    for name in posterior.data_vars if names is None else names:
        variable = posterior[name].transpose("chain", "draw", ...)
        values = variable.values
        flat = values.reshape(-1, *values.shape[2:])
        own = variable.dims[2:]
        coords = {dim: variable.coords[dim].values for dim in own if dim in variable.coords}
        found[str(name)] = xr.DataArray(flat, coords, ["draws", *own])
    return found
