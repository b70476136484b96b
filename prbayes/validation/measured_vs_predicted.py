"""What was measured and what was predicted of it, one output and condition at a time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from prbayes._validate import Floats, called, real_array

# Outputs of a condition that are shown: three rows of panels, by judgement.
_MOST_SHOWN = 8


@dataclass(frozen=True, eq=False)
class Comparable:
    """Measured and predicted values of one output under one condition."""

    name: str  # of the condition, with the output's like the index of an element
    measured: Floats  # (n,): +inf is a specimen that failed
    predicted: Floats  # (P, S): a row for each population; NaN has no weight

    @property
    def weights(self) -> Floats:
        """Equal weights of what is known of each population, shape (P, S)."""
        known = ~np.isnan(self.predicted)
        count = np.maximum(known.sum(axis=1, keepdims=True), 1)
        return known / count


def comparables(observed: Any, predicted: Any, caller: str) -> list[Comparable]:
    """Return what a caller was given as pairs of one output each.

    Raises
    ------
    TypeError, ValueError
        If they are not data and predictions of the same conditions and outputs.
    """
    if not isinstance(predicted, Mapping):
        name = getattr(predicted, "name", None) or "response"
        observed = {str(name): observed}
        predicted = {str(name): predicted}
    for name, prediction in predicted.items():
        if not isinstance(prediction, xr.DataArray) or "sample" not in prediction.dims:
            raise TypeError(
                f"{caller}: {name}: predicted: got {called(prediction)}, expected the DataArray of "
                "prb.predict"
            )
    if not isinstance(observed, Mapping) or list(map(str, observed)) != list(map(str, predicted)):
        got = list(observed) if isinstance(observed, Mapping) else called(observed)
        raise ValueError(
            f"{caller}: observed: got {got}, expected values under the names of the predictions, "
            f"{list(predicted)}"
        )
    found: list[Comparable] = []
    for (name, values), prediction in zip(observed.items(), predicted.values(), strict=True):
        found += _of_condition(str(name), values, prediction, caller)
    return found


def _of_condition(
    name: str, observed: Any, predicted: xr.DataArray, caller: str
) -> list[Comparable]:
    """Return the outputs of one condition."""
    values = real_array(observed, f"{caller}: {name}: observed")
    others = [dim for dim in predicted.dims if dim not in ("chain", "draw", "sample")]
    event = tuple(predicted.sizes[dim] for dim in others)
    if values.ndim != 1 + len(event) or values.shape[1:] != event or not values.size:
        expected = ", ".join(["n", *map(str, event)])
        raise ValueError(
            f"{caller}: {name}: observed: got shape {values.shape}, expected ({expected}): a value "
            "for each specimen and output"
        )
    samples = predicted.values.reshape(-1, predicted.sizes["sample"], *event)
    if not event:
        return [_known(name, values, samples)]
    (dim,) = others
    labels = predicted[dim].values.tolist()
    places = np.linspace(0, event[0] - 1, min(event[0], _MOST_SHOWN))
    found = []
    for j in map(round, places.tolist()):
        # Names of panels are places in a tree, whose levels a slash parts
        own = str(labels[j]).replace("/", "\u2215")
        found.append(_known(f"{name}[{own}]", values[:, j], samples[..., j]))
    return found


def _known(name: str, measured: Floats, predicted: Floats) -> Comparable:
    """Return the values of one output without those that were not measured."""
    return Comparable(name.replace("/", "\u2215"), measured[~np.isnan(measured)], predicted)
