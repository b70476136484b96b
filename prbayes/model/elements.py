"""Names of the elements of variables, such as 'mu[1]': the one place where they are made."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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
