"""Outputs of a run: one number, or several numbers of the same specimen, with names and units."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prbayes._validate import Floats, real_array


@dataclass(frozen=True)
class Outputs:
    """The outputs of one specimen, in the order of the columns of ``observed``."""

    # Texts, or numbers where the outputs are a curve; none if a run gives one number.
    labels: tuple[Any, ...] = ()
    dim: str = "output"  # name of their dimension in results
    # Keys of a response that returns a mapping, and the number of outputs of each, None for one
    # number without an axis. Empty where outputs have no names.
    keys: tuple[tuple[str, int | None], ...] = ()
    units: tuple[str, ...] = ()

    @property
    def event(self) -> tuple[int, ...]:
        """The shape of one specimen's outputs: () or (m,)."""
        return (len(self.labels),) if self.labels else ()

    @property
    def names(self) -> tuple[str, ...]:
        """The labels as text."""
        return tuple(f"{x:g}" if isinstance(x, float) else str(x) for x in self.labels)

    def by_key(self, values: Floats) -> dict[str, Floats]:
        """Return outputs in the last axis, (..., m), as a mapping with the response's keys."""
        arrays = {}
        start = 0
        for key, size in self.keys:
            stop = start + (1 if size is None else size)
            arrays[key] = values[..., start] if size is None else values[..., start:stop]
            start = stop
        return arrays

    def assembled(self, result: Mapping[str, Any]) -> Any:
        """Return a mapping's arrays as one, outputs in the last axis; other keys are a KeyError."""
        if not self.keys:
            raise KeyError(
                f"the response returned a mapping with the keys {list(result)}, expected an array; "
                "outputs have no names: pass observed= as a mapping, or as a DataFrame, with these"
            )
        expected = [key for key, _ in self.keys]
        if set(result) != set(expected):
            raise KeyError(
                f"the response returned a mapping with the keys {list(result)}, expected "
                f"{expected}, those of observed"
            )
        columns = []
        for key, size in self.keys:
            column = np.asarray(result[key])
            columns.append(column[..., None] if size is None else column)
        return np.concatenate(columns, axis=-1)


SINGLE_OUTPUT = Outputs()


def outputs_of_result(result: Mapping[str, Any], batch_ndim: int) -> Outputs:
    """Return the outputs that a response's mapping has."""
    keys: list[tuple[str, int | None]] = []
    for key, column in result.items():
        array = np.asarray(column)
        keys.append((str(key), array.shape[-1] if array.ndim > batch_ndim else None))
    return outputs_of_keys(keys)


def outputs_of_keys(keys: Sequence[tuple[str, int | None]]) -> Outputs:
    """Return the outputs of a mapping with these keys, and a number of outputs for each."""
    labels = []
    for key, size in keys:
        labels += [key] if size is None else [f"{key}[{i}]" for i in range(size)]
    return Outputs(tuple(labels), keys=tuple(keys))


def read_observed(name: str, observed: Any) -> tuple[Floats, Outputs]:
    """Return observed responses, (N,) or (N, m), and their outputs, with names where they have."""
    label = f"{name}: observed"
    if isinstance(observed, Mapping):
        return _from_mapping(label, observed)
    if hasattr(observed, "columns") and hasattr(observed, "dtypes"):
        # Columns that are no numbers, such as names of groups.
        texts = []
        for place, (column, kind) in enumerate(zip(observed, observed.dtypes, strict=True)):
            if kind.kind not in "biufO" or any(isinstance(v, str) for v in observed.iloc[:, place]):
                texts.append(column)
        if texts:
            raise TypeError(
                f"{label}: got a DataFrame whose columns {texts} are no numbers, expected a "
                "column of measured responses for each output; leave others out, as in "
                "df['life'], and where one names groups, such as suppliers, index hyperparameters "
                f"by prb.response.group({str(texts[0])!r})"
            )
    if np.ma.is_masked(observed) and np.ndim(observed) == 2:
        observed = np.ma.filled(np.ma.asarray(observed, dtype=np.float64), np.nan)
    values = observed if np.ma.is_masked(observed) else real_array(observed, label)
    if np.ndim(values) == 2:
        if not values.shape[1]:
            raise ValueError(f"{label}: got shape {values.shape}, expected one output at least")
        return values, _labelled_columns(observed, values.shape[1])
    unit = getattr(observed, "attrs", {}).get("units") if hasattr(observed, "dims") else None
    return values, Outputs(units=(str(unit),)) if unit else SINGLE_OUTPUT


def _labelled_columns(observed: Any, m: int) -> Outputs:
    """Return the outputs of an array, DataFrame or DataArray of m columns."""
    labels: tuple[Any, ...] = tuple(range(m))
    units: tuple[str, ...] = ()
    dim = "output"
    if hasattr(observed, "dims") and hasattr(observed, "coords"):
        dim = str(observed.dims[1])
        if dim in observed.coords:
            labels = tuple(observed.coords[dim].values.tolist())
        # A coordinate of units, or one unit for all.
        unit: Any = observed.coords.get("units", observed.attrs.get("units"))
        if unit is not None:
            units = tuple(map(str, np.broadcast_to(np.asarray(unit), m).tolist()))
    elif hasattr(observed, "columns"):
        labels = tuple(np.asarray(observed.columns).tolist())
        dim = str(getattr(observed.columns, "name", None) or dim)
    else:
        return Outputs(labels)
    are_names = all(isinstance(label, str) for label in labels)
    return Outputs(labels, dim, tuple((x, None) for x in labels) if are_names else (), units)


def _from_mapping(label: str, observed: Mapping[Any, Any]) -> tuple[Floats, Outputs]:
    columns, keys = [], []
    for key, column in observed.items():
        if not isinstance(key, str):
            raise TypeError(f"{label}: got the key {key!r:.60}, expected names of outputs")
        values = real_array(column, f"{label}[{key!r}]")
        if values.ndim not in (1, 2):
            raise ValueError(
                f"{label}[{key!r}]: got shape {values.shape}, expected (N,), or (N, k) for k "
                "outputs of one name"
            )
        keys.append((key, None if values.ndim == 1 else values.shape[1]))
        columns.append(values[:, None] if values.ndim == 1 else values)
    lengths = [len(column) for column in columns]
    if len(set(lengths)) != 1:
        raise ValueError(
            f"{label}: got arrays of {lengths} values, expected one value for each specimen in "
            "every output; NaN where it was not measured"
        )
    return np.concatenate(columns, axis=1), outputs_of_keys(keys)


def is_missing(values: Floats) -> NDArray[np.bool_]:
    """Return which points, (n,) or (n, m) -> (n,), have an output that is NaN: no response."""
    nan = np.isnan(values)
    return nan.any(axis=-1) if nan.ndim > 1 else nan
