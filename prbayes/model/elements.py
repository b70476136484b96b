"""Elements of variables, such as 'mu[1]' or 'mu[Adler]': names and values by name."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np
import xarray as xr

from prbayes._validate import Floats

# Names.


def element_name(name: str, index: Sequence[object]) -> str:
    """Return the name of an element: 'mu[1]', 'cov[0,1]', 'mu[Adler]', or 'mu' of a scalar."""
    return f"{name}[{','.join(map(str, index))}]" if index else name


def element_names(name: str, shape: Sequence[int], labels: Sequence[Any] = ()) -> list[str]:
    """Return the names of all elements of a variable, in the order of its raveled values.

    Labels are the coordinate of each axis, or None. An axis whose labels are not as many distinct
    texts has numbers.
    """
    if len(labels) != len(shape):
        labels = [None] * len(shape)
    axes: list[Sequence[object]] = []
    for size, coordinate in zip(shape, labels, strict=True):
        texts = [] if coordinate is None else list(map(str, np.asarray(coordinate).tolist()))
        axes.append(texts if len(set(texts)) == len(texts) == size else range(size))
    return [element_name(name, index) for index in product(*axes)]


def variable_of(element: str) -> str:
    """Return the name of the variable that an element belongs to."""
    return element.partition("[")[0]


def coordinates(model: Any, name: str) -> tuple[Any, ...]:
    """Return the coordinate of each axis of a variable of a model, None where it has none."""
    dims = model.named_vars_to_dims.get(name) or ()
    return tuple(model.coords.get(dim) for dim in dims)


def _names_of(name: Any, value: Any, leading: int = 0) -> list[str]:
    """Return the names of the elements of an array, after some leading axes."""
    labels = []
    if isinstance(value, xr.DataArray):
        labels = [value.coords[d].values if d in value.coords else None for d in value.dims]
    return element_names(str(name), np.shape(value)[leading:], labels[leading:])


# Values by name.


def split_elements(values: Mapping[Any, Any]) -> dict[str, Floats]:
    """Return arrays (n,) by the names of elements, of arrays (n, *shape) by variable.

    Names have the coordinates of the arrays.
    """
    result: dict[str, Floats] = {}
    for name, value in values.items():
        array = np.asarray(value)
        names = _names_of(name, value, leading=1)
        columns = array.reshape(len(array), len(names))
        result |= dict(zip(names, columns.T, strict=True))
    return result


def single_elements(values: Mapping[Any, Any]) -> dict[str, float]:
    """Return numbers by the names of elements, of one value of each variable."""
    result: dict[str, float] = {}
    for name, value in values.items():
        numbers = np.ravel(value).astype(float).tolist()
        result |= dict(zip(_names_of(name, value), numbers, strict=True))
    return result


# Elements and variables in tables.


def table_elements(values: Mapping[Any, Any]) -> list[str]:
    """Return the elements that a table shows, of arrays (n, *shape) by variable.

    Of a symmetric matrix, such as a correlation, each pair once; and no constant element of a
    square matrix, such as the diagonal, or the zeros of a Cholesky factor.
    """
    elements = []
    for name, value in values.items():
        is_shown = _is_informative(np.asarray(value)).ravel()
        names = _names_of(name, value, leading=1)
        elements += [element for element, shown in zip(names, is_shown, strict=True) if shown]
    return elements


def optimum_elements(point: Mapping[Any, Any], stderr: Mapping[Any, Any]) -> list[str]:
    """Return the elements that a table shows of an optimum, with standard errors by variable."""
    elements = []
    for name, value in point.items():
        estimate, error = np.asarray(value), np.asarray(stderr[name])
        # An unknown error is not zero: any number does.
        error = np.where(np.isfinite(error), error, 1.0)
        is_shown = _is_informative(np.stack([estimate - error, estimate + error])).ravel()
        names = _names_of(name, value)
        elements += [element for element, shown in zip(names, is_shown, strict=True) if shown]
    return elements


def _is_informative(array: Floats) -> Any:
    """Return which elements of arrays (n, *shape) are neither constant nor a copy, (*shape)."""
    shape = array.shape[1:]
    if len(shape) != 2 or shape[0] != shape[1] or not len(array):
        return np.ones(shape, dtype=bool)
    # A few operations change a few units in the last place.
    rounding = 1e-12 * np.abs(array).max(axis=0)
    fixed = np.ptp(array, axis=0) <= rounding
    if fixed.all():  # nothing moved: show that
        return np.ones(shape, dtype=bool)
    symmetric = np.abs(array - array.swapaxes(1, 2)) <= rounding
    return np.triu(~fixed) if symmetric.all() else ~fixed


def readable_variables(names: Iterable[str], among: Collection[str]) -> list[str]:
    """Return the variables that a table shows in place of these, each once.

    For a `pymc.LKJCholeskyCov`, a packed factor, its standard deviations and correlations.
    """
    variables = []
    for name in names:
        unpacked = [f"{name}_stds", f"{name}_corr"]
        variables += unpacked if set(unpacked) <= set(among) else [name]
    return list(dict.fromkeys(variables))


def readable_elements(elements: Iterable[str]) -> list[str]:
    """Return elements without those of packed factors whose unpacked variables are present."""
    variables = {element: variable_of(element) for element in elements}
    names = set(variables.values())
    readable = set(readable_variables(names, names))
    return [element for element, variable in variables.items() if variable in readable]


# Draws.


def stacked_draws(posterior: Any, names: Iterable[str] | None = None) -> dict[str, xr.DataArray]:
    """Return the draws of variables, (chains x draws, *shape), with their other coordinates."""
    stacked = {}
    for name in posterior.data_vars if names is None else names:
        variable = posterior[name].transpose("chain", "draw", ...)
        values = variable.values
        dims = variable.dims[2:]
        coords = {dim: variable.coords[dim].values for dim in dims if dim in variable.coords}
        flat = values.reshape(-1, *values.shape[2:])
        stacked[str(name)] = xr.DataArray(flat, coords, ["draws", *dims])
    return stacked


def finite_draws(posterior: Any, names: Sequence[str]) -> dict[str, Floats]:
    """Return the draws of free variables, which define populations.

    Raises
    ------
    ValueError
        If one is no finite number: no population belongs to it.
    """
    by_name = {name: draws.values for name, draws in stacked_draws(posterior, names).items()}
    for name, draws in by_name.items():
        is_finite = np.isfinite(draws).reshape(len(draws), -1).all(axis=1)
        if not is_finite.all():
            raise ValueError(
                f"posterior: {name}: got NaN or infinite values in {int((~is_finite).sum())} of "
                f"{is_finite.size} draws, expected finite ones; leave these draws out, or sample "
                "again"
            )
    return by_name


def with_coordinates(draws: Mapping[str, xr.DataArray], model: Any) -> dict[str, xr.DataArray]:
    """Return draws, (n, *shape) by variable, with a model's coordinates where they have none."""
    result = {}
    for name, values in draws.items():
        labels = coordinates(model, name)
        dims = values.dims[1:]
        for dim, coordinate in zip(dims, labels, strict=True) if len(labels) == len(dims) else ():
            is_missing = coordinate is not None and dim not in values.coords
            if is_missing and len(coordinate) == values.sizes[dim]:
                values = values.assign_coords({dim: np.asarray(coordinate)})
        result[name] = values
    return result
