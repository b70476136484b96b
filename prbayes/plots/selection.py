"""Variables and elements of a picture, selected by the arguments of ArviZ."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from itertools import chain
from typing import Any, Literal

import numpy as np
import xarray as xr

from prbayes._validate import wrong_value
from prbayes.model.parameters import split_elements, variable_of

VarNames = str | Sequence[str]
FilterVars = Literal["like", "regex"]
Coords = Mapping[str, Any]
# variable of each element, and its coordinate by dimension, by the name of the element
Elements = Mapping[str, tuple[str, Mapping[str, Any]]]


def elements_of(arrays: Mapping[Any, xr.DataArray]) -> Elements:
    """Return the elements of arrays (n, *shape), named as by `split_elements`."""
    elements = {}
    for variable, array in arrays.items():
        dims = array.dims[1:]
        indices = np.ndindex(array.shape[1:])
        for name, index in zip(split_elements({variable: array[:1]}), indices, strict=True):
            labels = [array[dim].values[i] for dim, i in zip(dims, index, strict=True)]
            elements[name] = str(variable), dict(zip(map(str, dims), labels, strict=True))
    return elements


def select(
    elements: Elements,
    var_names: VarNames | None,
    filter_vars: FilterVars | None,
    coords: Coords | None,
) -> list[str]:
    """Return the elements of variables that have one of some coordinates, as ArviZ selects them.

    Without a filter ``var_names`` are variables or elements, in this order; a name after ~ is left
    out. Variables without a dimension of ``coords`` are not restricted.
    """
    names = _select_names(elements, var_names, filter_vars)
    for dim, value in _items(coords, set(chain.from_iterable(x for _, x in elements.values()))):
        labels = dict.fromkeys(x[dim] for _, x in elements.values() if dim in x)
        selected = _selected_labels(list(labels), dim, value)
        names = [name for name in names if elements[name][1].get(dim, selected[0]) in selected]
    if not names:
        raise KeyError(f"coords: got {coords!r:.200}, expected some of {list(elements)}")
    return names


def select_variables(
    names: Iterable[str], var_names: VarNames | None, filter_vars: FilterVars | None
) -> list[str]:
    """Return the names that ArviZ's arguments select; each name is an element of a variable."""
    elements: Elements = {name: (variable_of(name), {}) for name in names}
    return _select_names(elements, var_names, filter_vars)


def subset(data: xr.Dataset, coords: Coords | None, available: Iterable[Any] = ()) -> xr.Dataset:
    """Return data at the selected labels; ``available`` are dimensions that other data have."""
    for dim, value in _items(coords, {*map(str, data.dims), *map(str, available)}):
        if dim in data.dims:
            data = data.sel({dim: _selected_labels(data[dim].values.tolist(), dim, value)})
    return data


def _select_names(
    elements: Elements, var_names: VarNames | None, filter_vars: FilterVars | None
) -> list[str]:
    if filter_vars not in (None, "like", "regex"):
        raise ValueError(f"filter_vars: got {filter_vars!r:.60}, expected None, 'like' or 'regex'")
    if var_names is None:
        return list(elements)
    requested = [var_names] if isinstance(var_names, str) else var_names
    if not isinstance(requested, Sequence) or not all(isinstance(x, str) for x in requested):
        raise wrong_value(var_names, "var_names", f"names, some of {list(elements)}")

    def matches(text: str) -> list[str]:
        """Return the elements that a text selects, or leaves out."""
        text = text.removeprefix("~")
        return [
            name
            for name, (variable, _) in elements.items()
            if (filter_vars is None and text in (name, variable))
            or (filter_vars == "like" and text in variable)
            or (filter_vars == "regex" and re.search(text, variable))
        ]

    matching = {text: matches(text) for text in requested}
    unknown = [text for text, names in matching.items() if not names]
    if unknown or not matching:
        raise KeyError(f"var_names: got {unknown or 'none'}, expected some of {list(elements)}")
    excluded = [names for text, names in matching.items() if text.startswith("~")]
    if excluded:
        return [name for name in elements if name not in chain.from_iterable(excluded)]
    return list(dict.fromkeys(chain.from_iterable(matching.values())))


def _items(coords: Coords | None, dims: set[str]) -> list[tuple[str, Any]]:
    """Return dimensions with the values to select; raise for unknown ones."""
    if coords is None:
        return []
    if not isinstance(coords, Mapping):
        raise wrong_value(coords, "coords", "values by dimension")
    unknown = [dim for dim in coords if dim not in dims]
    if unknown:
        raise KeyError(f"coords: got {unknown}, expected some of the dimensions {sorted(dims)}")
    return list(coords.items())


def _selected_labels(labels: list[Any], dim: str, value: Any) -> list[Any]:
    """Return the labels that a value, a list or a slice selects along a dimension."""
    along = xr.DataArray(labels, {dim: labels}, [dim])
    try:
        selected: list[Any] = np.atleast_1d(along.sel({dim: value}).values).tolist()
    except (KeyError, TypeError, ValueError, IndexError):
        selected = []
    if not selected:
        raise KeyError(f"coords: {dim}: got {value!r:.60}, expected some of {labels!s:.200}")
    return selected
