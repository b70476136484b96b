"""Conditions of specimens: their values, and inputs of specimens under them."""

from __future__ import annotations

import numpy as np

from prbayes._validate import Arrays, ArraysByName, Floats
from prbayes.response.inputs import Inputs


def stacked_values(values: ArraysByName) -> Floats | None:
    """Return the values of conditions, (N,) by name, as an array (N, C); None without one."""
    return np.stack(list(values.values()), axis=1) if values else None


def at_conditions(inputs: Inputs, specimens: Arrays, conditions: Floats | None) -> list[Floats]:
    """Return inputs (..., n, *event) with the conditions, (N, C), of specimens in turn."""
    result = list(specimens)
    if conditions is not None:
        for place, column in zip(inputs.conditions, conditions.T, strict=True):
            n = result[place].shape[-1]
            result[place] = np.broadcast_to(np.resize(column, n), result[place].shape)
    return result
