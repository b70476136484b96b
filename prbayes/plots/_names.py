"""Names of elements, such as 'mu[1]', and what a reader calls them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from prbayes._checks import Floats


def element_name(name: str, index: tuple[int, ...]) -> str:
    """Return the name of an element, such as 'mu[1]'; of a scalar, the variable's own."""
    if not index:
        return name
    places = ",".join(map(str, index))
    return f"{name}[{places}]"


def variable_of(element: str) -> str:
    """Return the name of the variable that an element belongs to."""
    return element.partition("[")[0]


def split_elements(values: Mapping[str, Any]) -> dict[str, Floats]:
    """Return one-dimensional arrays by element name, of arrays of shape (n, *shape) by variable."""
    found: dict[str, Floats] = {}
    for name, value in values.items():
        array = np.asarray(value)
        for index in np.ndindex(array.shape[1:]):
            element = element_name(name, index)
            found[element] = array[(slice(None), *index)]
    return found


def point_elements(point: Mapping[str, Any]) -> dict[str, float]:
    """Return numbers by element name, of one value of each variable."""
    rows = {name: np.asarray(value)[None] for name, value in point.items()}
    elements = split_elements(rows)
    return {name: float(row[0]) for name, row in elements.items()}


def named(name: str, labels: Mapping[str, str] | None) -> str:
    """Return an element's label, or its variable's with the index, or else its name."""
    given = labels or {}
    if name in given:
        return given[name]
    variable = variable_of(name)
    index = name.removeprefix(variable)
    return given.get(variable, variable) + index
