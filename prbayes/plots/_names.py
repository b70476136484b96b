"""What a reader calls the elements of variables."""

from __future__ import annotations

from collections.abc import Mapping


def variable_of(element: str) -> str:
    """Return the name of the variable that an element belongs to."""
    return element.partition("[")[0]


def named(name: str, labels: Mapping[str, str] | None) -> str:
    """Return an element's label, or its variable's with the index, or else its name."""
    given = labels or {}
    if name in given:
        return given[name]
    variable = variable_of(name)
    index = name.removeprefix(variable)
    return given.get(variable, variable) + index
