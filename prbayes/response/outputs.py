"""Outputs of a run: one number, or several numbers of the same specimen, with names and units."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import xarray as xr

from prbayes._validate import (
    Bools,
    Floats,
    Indices,
    NamedValues,
    Names,
    Shape,
    first_text,
    real_array,
    unmasked,
)


@dataclass(frozen=True)
class Outputs:
    """The outputs of one specimen, in the order of the columns of ``observed``."""

    # Labels of the outputs: texts, or numbers if the outputs are a curve. No labels: one number.
    labels: tuple[Any, ...] = ()
    dim: str = "output"  # name of their dimension in results
    # Keys of a response that returns a mapping, with the number of outputs of each key; None is one
    # number without an axis. Outputs without names have no keys.
    keys: tuple[tuple[str, int | None], ...] = ()
    units: Names = ()  # unit of each output, or of the one number; empty if unknown

    @property
    def event(self) -> Shape:
        """The shape of one specimen's outputs: () or (m,)."""
        return (len(self.labels),) if self.labels else ()

    @property
    def names(self) -> tuple[str, ...]:
        """The labels as text."""
        return tuple(f"{x:g}" if isinstance(x, float) else str(x) for x in self.labels)

    @property
    def attrs(self) -> dict[str, Any]:
        """The units as an attribute of an array: a text if all outputs have the same."""
        if not self.units:
            return {}
        return {"units": self.units[0] if len(set(self.units)) == 1 else list(self.units)}

    def by_key(self, values: Floats) -> Any:
        """Return outputs in the last axis, (..., m), as a mapping with the response's keys.

        Outputs whose labels are numbers are a DataArray.
        """
        if not self.keys:
            dims = [*(f"dim_{i}" for i in range(values.ndim - 1)), self.dim]
            return xr.DataArray(values, dims=dims, coords={self.dim: list(self.labels)})
        arrays = {}
        start = 0
        for key, size in self.keys:
            stop = start + (1 if size is None else size)
            arrays[key] = values[..., start] if size is None else values[..., start:stop]
            start = stop
        return arrays

    def assembled(self, result: NamedValues) -> Any:
        """Concatenate a mapping's arrays along the last axis; raise KeyError for other keys."""
        if not self.keys:
            raise KeyError(
                f"the response returned a mapping with the keys {list(result)}, expected an array; "
                "outputs have no names: pass observed= as a mapping, or as a DataFrame, with "
                "these names"
            )
        expected = [key for key, _ in self.keys]
        if set(result) != set(expected):
            raise KeyError(
                f"the response returned a mapping with the keys {list(result)}, expected "
                f"{expected}, those of observed"
            )
        columns = []
        for key, size in self.keys:
            column = np.asarray(unmasked(result[key]))
            columns.append(column[..., None] if size is None else column)
        values = np.concatenate(columns, axis=-1)
        return values if self.labels else values[..., 0]

    def ordered(self, result: Any, batch_ndim: int) -> Any:
        """Return a response with its outputs in this order, or raise KeyError for other labels.

        Labels are the coordinate of a DataArray, the columns of a DataFrame, and the index of a
        Series of one specimen. Values without labels keep their order.
        """
        if hasattr(result, "columns") and not self.labels and result.shape[-1] == 1:
            column = result.columns[0]
            values = result.iloc[:, 0]
            return self.assembled({column: values}) if self.keys and column != 0 else values
        axis = output_axis(result, batch_ndim, self)
        if axis is None or not self.labels:
            return result
        values = np.moveaxis(np.asarray(result), axis, -1)
        order = output_order(labels_along(result, axis), self.labels, "the response returned")
        return values if order is None else values[..., order]


SINGLE_OUTPUT = Outputs()


def with_unit(name: str, unit: str) -> str:
    """Return a name with its unit in brackets, if there is one."""
    return f"{name} ({unit})" if unit else name


def relabelled(values: Any, like: Any) -> Any:
    """Return values with the labels of ``like``: Series, DataFrame, DataArray, named tuple."""
    if hasattr(like, "_fields"):
        return type(like)(*values)
    if np.shape(values) != getattr(like, "shape", None) or not np.ndim(values):
        return values
    if hasattr(like, "dims") and hasattr(like, "coords"):
        return like.copy(data=values)
    if not hasattr(like, "iloc"):
        return values
    columns = {"columns": like.columns} if hasattr(like, "columns") else {}
    return type(like)(values, index=like.index, **columns)


def output_order(labels: Sequence[Any], expected: Sequence[Any], prefix: str) -> Indices | None:
    """Return the positions of the expected labels among the labels.

    None if both are equal, or if one of them has no labels but 0, 1, ... Numbers are equal up to
    rounding. Raises KeyError if other labels than the expected ones are there.
    """
    default = tuple(range(len(expected)))
    labels = tuple(labels)
    expected = tuple(expected)
    if labels == expected or default == expected or tuple(range(len(labels))) == labels:
        return None
    numbers = [np.asarray(side) for side in (labels, expected)]
    if len(labels) == len(expected) and all(side.dtype.kind in "iuf" for side in numbers):
        order = np.argsort(numbers[0])
        rank = np.argsort(np.argsort(numbers[1]))
        if np.allclose(numbers[0][order], np.sort(numbers[1]), rtol=1e-9, atol=0):
            return order[rank]
    elif set(labels) == set(expected) and len(set(labels)) == len(labels):
        return np.array([labels.index(label) for label in expected], dtype=np.intp)
    raise KeyError(
        f"{prefix} the outputs {list(labels[:9])}, expected {list(expected[:9])}, each once, in "
        "any order"
    )


def labels_along(result: Any, axis: int) -> tuple[Any, ...]:
    """Return the labels of a labelled array along an axis, or else numbers from 0."""
    if hasattr(result, "dims"):
        dim = result.dims[axis]
        values = result.coords[dim].values if dim in result.coords else range(result.shape[axis])
    else:
        values = result.columns if hasattr(result, "columns") else result.index
    return tuple(np.asarray(values).tolist())


def output_axis(result: Any, batch_ndim: int, outputs: Outputs | None) -> int | None:
    """Return the axis of the outputs of a labelled array; None for other results.

    Raises KeyError if the specimens are in another order.
    """
    axis = batch_ndim
    if hasattr(result, "dims") and hasattr(result, "coords"):
        dims = list(result.dims)
        axis = dims.index(outputs.dim) if outputs and outputs.dim in dims else len(dims) - 1
        places = [i for i in range(result.ndim) if i != axis or result.ndim <= batch_ndim]
        indices = [np.asarray(labels_along(result, i)) for i in places]
    elif hasattr(result, "iloc"):
        indices = [np.asarray(result.index)] if batch_ndim else []
    else:
        return None
    for index in indices:
        in_order = np.arange(index.size)
        is_permuted = not np.array_equal(index, in_order)
        if index.dtype.kind in "iu" and is_permuted and np.array_equal(np.sort(index), in_order):
            raise KeyError(
                "the response returned labels of specimens in another order than the inputs, "
                "expected theirs; sort the response by its index"
            )
    return axis if result.ndim > batch_ndim else None


def outputs_of_result(result: Any, batch_ndim: int) -> Outputs | None:
    """Return the outputs that a mapping or labelled array declares; None without labels."""
    if not isinstance(result, Mapping):
        axis = output_axis(result, batch_ndim, None)
        if axis is None:
            return None
        labels = labels_along(result, axis)
        if labels == tuple(range(len(labels))):
            return None
        dim = str(result.dims[axis]) if hasattr(result, "dims") else "output"
        return Outputs(labels, dim, _keys_of(labels))
    keys = []
    for key, column in result.items():
        array = np.asarray(column)
        keys.append((str(key), array.shape[-1] if array.ndim > batch_ndim else None))
    return outputs_of_keys(keys)


def outputs_of_keys(keys: Sequence[tuple[str, int | None]]) -> Outputs:
    """Return the outputs of a mapping, from its keys and the number of outputs of each key."""
    labels = []
    for key, size in keys:
        labels += [key] if size is None else [f"{key}[{i}]" for i in range(size)]
    return Outputs(tuple(labels), keys=tuple(keys))


def _keys_of(labels: Sequence[Any]) -> tuple[tuple[str, int | None], ...]:
    """Return a key for each label if all are texts, else no keys."""
    are_names = all(isinstance(label, str) for label in labels)
    return tuple((label, None) for label in labels) if are_names else ()


def read_observed(name: str, observed: Any) -> tuple[Floats, Outputs]:
    """Return observed responses, (N,) or (N, m), and their outputs, with names if there are any."""
    label = f"{name}: observed"
    if isinstance(observed, Mapping):
        return _from_mapping(label, observed)
    if hasattr(observed, "columns") and hasattr(observed, "dtypes"):
        # Refuse columns that are not numeric, such as names of groups.
        texts = []
        first = ""
        for place, (column, kind) in enumerate(zip(observed, observed.dtypes, strict=True)):
            numbers = np.asarray(observed.iloc[:, place])
            if kind.kind not in "biufO" or any(isinstance(v, str) for v in numbers):
                texts.append(column)
                first = first or first_text(numbers)
        if texts:
            advice = (
                "leave others out, as in df['life'], and where one names groups, such as "
                f"suppliers, index hyperparameters by prb.response.group({str(texts[0])!r})"
            )
            text = first.partition("text '")[2]
            if text.lstrip("<>=~ +-.,")[:1].isdigit():
                advice = (
                    "convert texts, such as decimal commas, by pd.to_numeric, and state limits, "
                    "such as '<3.4', by prb.LogLikelihood(censored=...)"
                )
            raise TypeError(
                f"{label}: got a DataFrame whose columns {texts} are no numbers "
                f"({first or 'but other objects'}), expected a "
                f"column of measured responses for each output; {advice}"
            )
    values = real_array(observed, label)
    if np.ndim(values) == 2:
        if not values.shape[1]:
            raise ValueError(f"{label}: got shape {values.shape}, expected one output at least")
        outputs = _labelled_columns(observed, values.shape[1])
        if hasattr(observed, "columns") and values.shape[1] == 1:
            return values[:, 0], Outputs(keys=outputs.keys, units=outputs.units)
        return values, outputs
    unit = _units_in(observed, (getattr(observed, "name", None),))
    return values, Outputs(units=unit) if unit else SINGLE_OUTPUT


def _units_in(observed: Any, labels: Sequence[Any]) -> Names:
    """Return the unit of each output, from the attributes of a labelled array.

    A text is the unit of all outputs. A mapping has units by label, a list in the order of outputs.
    """
    unit = getattr(observed, "attrs", {}).get("units")
    if isinstance(unit, Mapping):
        unit = [unit.get(label, "") for label in labels]
    if unit is None or (not isinstance(unit, str) and len(unit) not in (1, len(labels))):
        return ()
    units = tuple(map(str, np.broadcast_to(np.asarray(unit), len(labels)).tolist()))
    return units if any(units) else ()


def _labelled_columns(observed: Any, m: int) -> Outputs:
    """Return the outputs of an array, DataFrame or DataArray of m columns."""
    labels: tuple[Any, ...] = tuple(range(m))
    units: Names = ()
    dim = "output"
    if hasattr(observed, "dims") and hasattr(observed, "coords"):
        dim = str(observed.dims[1])
        if dim in observed.coords:
            labels = tuple(observed.coords[dim].values.tolist())
        if "units" in observed.coords:
            unit = np.asarray(observed.coords["units"])
            units = tuple(map(str, np.broadcast_to(unit, m).tolist()))
    elif hasattr(observed, "columns"):
        labels = tuple(np.asarray(observed.columns).tolist())
        dim = str(getattr(observed.columns, "name", None) or dim)
    else:
        return Outputs(labels)
    return Outputs(labels, dim, _keys_of(labels), units or _units_in(observed, labels))


def in_order_of(values: Any, observed: Any, name: str, *, reference: str = "observed") -> Any:
    """Return values of specimens in the order of the observed ones, where both have an index.

    An index 0, 1, ... counts as none, unless the other index is a permutation of it. Raises a
    ValueError if the labels of both differ.
    """
    index = specimen_index(values)
    expected = specimen_index(observed)
    if index is None or expected is None or len(index) != len(expected) or index.equals(expected):
        return values
    if index.is_unique and expected.is_unique and set(index) == set(expected):
        return np.asarray(values)[index.get_indexer(expected)]
    in_order = np.arange(len(index))
    if np.array_equal(index, in_order) or np.array_equal(expected, in_order):
        return values
    raise ValueError(
        f"{name}: got values with the index {list(index[:3])}, ..., expected that of {reference}, "
        f"{list(expected[:3])}, ...; where the order is the same, pass values.to_numpy()"
    )


def refuse_other_order(values: Any, observed: Any, name: str) -> None:
    """Raise a ValueError if a labelled array has specimens or outputs in another order."""
    is_table = np.ndim(values) > 1
    labels = labels_along(values, 1 if is_table else 0)
    outputs = ()
    if isinstance(observed, Mapping) or hasattr(observed, "columns"):
        outputs = tuple(observed)
    elif np.ndim(observed) > 1 and hasattr(observed, "coords"):
        outputs = labels_along(observed, 1)
    are_outputs = set(labels) == set(outputs)
    if are_outputs and labels != outputs:
        raise ValueError(
            f"{name}: got the outputs {list(labels)}, expected {list(outputs)}, the order of "
            "observed"
        )
    if (is_table or not are_outputs) and in_order_of(values, observed, name) is not values:
        raise ValueError(
            f"{name}: got values in another order than observed, by their index, expected the "
            "same order; pass values.loc[observed.index]"
        )


def specimen_index(values: Any) -> Any:
    """Return the index of the specimens of a labelled array or a mapping of them, or None."""
    if isinstance(values, Mapping):  # all outputs are in the order of the first
        return specimen_index(next(iter(values.values()), None))
    if hasattr(values, "dims") and hasattr(values, "indexes"):
        return values.indexes.get(values.dims[0]) if values.dims else None
    return values.index if hasattr(values, "iloc") else None


def label_texts(index: Any, groups: str = "") -> list[str] | None:
    """Return the labels of specimens in an index of pandas as texts; None where it only counts.

    A level with the names of groups is left out.
    """
    if index is not None and groups in index.names:
        index = index.droplevel(groups) if index.nlevels > 1 else None
    if index is None or set(index) == set(range(len(index))):
        return None
    return [
        ", ".join(map(label_text, label)) if isinstance(label, tuple) else label_text(label)
        for label in index
    ]


def label_text(label: object) -> str:
    """Return a label as readers see it."""
    if isinstance(label, bytes):
        return label.decode(errors="replace").strip()
    if isinstance(label, float) and label.is_integer():
        return str(int(label))
    return str(label).strip()


def _from_mapping(label: str, observed: Mapping[Any, Any]) -> tuple[Floats, Outputs]:
    columns, keys, units = [], [], []
    first = next(iter(observed.values()), None)
    for key, column in observed.items():
        unit = getattr(column, "attrs", {}).get("units", "")
        if not isinstance(key, str):
            raise TypeError(f"{label}: got the key {key!r:.60}, expected names of outputs")
        column = in_order_of(column, first, f"{label}[{key!r}]")
        values = real_array(column, f"{label}[{key!r}]")
        if values.ndim not in (1, 2):
            raise ValueError(
                f"{label}[{key!r}]: got shape {values.shape}, expected (N,), or (N, k) for k "
                "outputs of one name"
            )
        keys.append((key, None if values.ndim == 1 else values.shape[1]))
        columns.append(values[:, None] if values.ndim == 1 else values)
        units += [str(unit)] * columns[-1].shape[1]
    lengths = [len(column) for column in columns]
    if len(set(lengths)) != 1:
        raise ValueError(
            f"{label}: got arrays of {lengths} values, expected one value for each specimen in "
            "every output; NaN where it was not measured"
        )
    outputs = outputs_of_keys(keys)
    return np.concatenate(columns, axis=1), replace(
        outputs, units=tuple(units) if any(units) else ()
    )


def is_missing(values: Floats) -> Bools:
    """Return whether points, (n,) or (n, m) -> (n,), have no response: an output that is NaN."""
    nan = np.isnan(values)
    return nan.any(axis=-1) if nan.ndim > 1 else nan
