"""Reading of tables of runs: inputs and responses of arrays, labelled arrays and CSV files."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from prbayes._finding import counted
from prbayes._validate import (
    Floats,
    NamedArrays,
    Names,
    StrPath,
    complete_rows,
    file_path,
    plain_text,
    real_array,
)
from prbayes.emulators.ranges import Range, Ranges
from prbayes.response.outputs import Outputs, in_order_of, is_missing


@dataclass(frozen=True, eq=False, repr=False)
class RunRecord:
    """Runs of a response, and the ranges of its inputs."""

    domain: Ranges = field(repr=False)
    points: Floats = field(repr=False)  # (n, columns): inputs of the runs
    responses: Floats = field(repr=False)  # (n,) or (n, m): responses of the runs

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the inputs."""
        return self.domain.names

    @property
    def ranges(self) -> dict[str, tuple[Any, Any]]:
        """Lowest and highest value of each input."""
        return {r.name: (r.low.tolist(), r.high.tolist()) for r in self.domain.inputs}


@dataclass(frozen=True, eq=False)
class RunTable(RunRecord):
    """Runs, and the names of their outputs."""

    # Names of the outputs: "response" for a single unnamed output, "response[0]" for the first of
    # several.
    outputs: Names

    @property
    def labels(self) -> Outputs | None:
        """Labels of several outputs that have names."""
        is_named = self.responses.ndim > 1 and not self.outputs[0].startswith("response[")
        return Outputs(self.outputs) if is_named else None


def read_table(caller: str, inputs: Any, responses: Any) -> RunTable:
    """Read runs; raise TypeError or ValueError at the first cell that is not as expected."""
    named = _named_columns(f"{caller}: inputs", inputs, inputs)
    names = [name or f"x{i}" for i, (name, _) in enumerate(named, 1)]
    if len(set(names)) < len(names):
        raise ValueError(f"{caller}: inputs: got the names {names}, expected different ones")
    n = len(named[0][1])
    ranges = []
    for name, (_, column) in zip(names, named, strict=True):
        label = f"{caller}: inputs: {name}"
        _refuse_length(label, column, n)
        is_bad = ~np.isfinite(column)
        if is_bad.any():
            row = int(np.argwhere(is_bad)[0][0])
            raise ValueError(
                f"{label}: got {column[is_bad][0]} in row {row} (counted from 0), expected the "
                "value of the input of each run; leave the row out. A run that failed has NaN as "
                "its response"
            )
        low, high = column.min(axis=0), column.max(axis=0)
        if (low == high).any():
            raise ValueError(
                f"{label}: got {np.ravel(low[low == high])[0]:.6g} in all {n} runs, expected an "
                "input that varies between them; leave the column out"
            )
        ranges.append(Range(name, low, high))
    outputs = _named_columns(f"{caller}: responses", responses, inputs)
    parts, labels = [], []
    for name, column in outputs:
        _refuse_length(f"{caller}: responses{name and f': {name}'}", column, n)
        parts.append(column.reshape(n, -1))
        size = parts[-1].shape[1]
        labels += [name] if column.ndim == 1 else [f"{name}[{i}]" for i in range(size)]
    values = np.concatenate(parts, axis=1)
    points = np.concatenate([column.reshape(n, -1) for _, column in named], axis=1)
    domain = Ranges(tuple(ranges))
    _refuse_runs(caller, points, values)
    m = values.shape[1]
    if not all(labels) or len(set(labels)) < m:
        labels = ["response"] if m == 1 else [f"response[{i}]" for i in range(m)]
    return RunTable(domain, points, values[:, 0] if m == 1 else values, tuple(labels))


def read_csv(
    caller: str,
    path: StrPath,
    inputs: Sequence[str],
    outputs: Sequence[str],
    delimiter: str,
    decimal: str,
) -> tuple[NamedArrays, NamedArrays]:
    """Return columns of a CSV file with a line of names: those of inputs, and of outputs."""
    path = file_path(path, f"{caller}: path")
    for argument, names in (("inputs", inputs), ("outputs", outputs)):
        if isinstance(names, str) or not len(names):
            raise TypeError(
                f"{caller}: {argument}: got {names!r:.60}, expected names of columns, such as "
                "['E', 't']"
            )
    plain_text(delimiter, f"{caller}: delimiter")
    plain_text(decimal, f"{caller}: decimal")
    wanted = [*inputs, *outputs]
    with path.open(newline="", encoding="utf-8-sig") as file:
        reader = csv.reader(file, delimiter=delimiter)
        header = [cell.strip() for cell in next(reader, [])]
        absent = [name for name in wanted if header.count(name) != 1]
        if absent:
            raise ValueError(
                f"{caller}: got a first line with the columns {header}, expected {absent[0]!r} "
                "once among them; where columns are separated by another character, pass "
                "delimiter=';'"
            )
        places = [header.index(name) for name in wanted]
        rows = []
        for cells in reader:
            if not any(map(str.strip, cells)):
                continue
            cells += [""] * (len(header) - len(cells))
            label = f"{caller}: line {reader.line_num}"
            rows.append(
                [
                    _number_in_cell(cells[place], decimal, f"{label}: {name}")
                    for place, name in zip(places, wanted, strict=True)
                ]
            )
    table = dict(zip(wanted, np.array(rows).reshape(-1, len(wanted)).T, strict=True))
    return {name: table[name] for name in inputs}, {name: table[name] for name in outputs}


def _number_in_cell(cell: str, decimal: str, label: str) -> float:
    """Return the number in a cell; NaN for an empty cell."""
    text = cell.strip()
    try:
        return float(text.replace(decimal, ".")) if text else np.nan
    except ValueError:
        raise ValueError(
            f"{label}: got the text {text!r:.40}, expected a number, or an empty cell for a run "
            "that failed; leave lines of units out, pass decimal=',' for decimal commas, or read "
            "the file with pandas.read_csv, and pass prb.Runs(table[inputs], table[outputs])"
        ) from None


def _named_columns(label: str, values: Any, inputs: Any) -> list[tuple[str, Floats]]:
    """Return names and columns (n, *event), with rows in the order of the inputs' index.

    Columns without a name have an empty one.
    """

    def column(part: Any, name: str) -> Floats:
        return real_array(in_order_of(part, inputs, name, reference="the inputs"), name)

    if isinstance(values, Mapping):  # datasets of xarray are mappings
        columns = [(str(key), column(x, f"{label}: {key}")) for key, x in values.items()]
    elif hasattr(values, "columns"):
        columns = [
            (str(key), column(values.iloc[:, i], f"{label}: {key}"))
            for i, key in enumerate(values.columns)
        ]
    else:
        array = column(values, label)
        names = [str(getattr(values, "name", None) or "")]
        if array.ndim == 2:
            names = [""] * array.shape[1]
            if hasattr(values, "dims") and values.dims[1] in values.coords:
                names = [str(x) for x in values.coords[values.dims[1]].values]
            columns = list(zip(names, array.T, strict=True))
        else:
            columns = [(names[0], array)]
    if not columns or not columns[0][1].ndim or not columns[0][1].size:
        raise ValueError(f"{label}: got no runs, expected a row for each run")
    return columns


def _refuse_length(label: str, column: Floats, n: int) -> None:
    if len(column) != n:
        raise ValueError(
            f"{label}: got {len(column)} values, expected {n}, one for each run of the inputs"
        )


def _refuse_runs(caller: str, points: Floats, values: Floats) -> None:
    """Raise for too few, too many or repeated runs, and for responses of -inf."""
    n, d = points.shape
    usable = int((~is_missing(values) & complete_rows(values)).sum())
    least = max(8, 4 * d)
    if usable < least:
        raise ValueError(
            f"{caller}: got {usable} runs with responses for {counted(d, 'input')}, expected at "
            f"least {least}; add runs, or leave inputs out that do not matter"
        )
    if n > 4000:  # the time of a fit grows with the cube of their number
        raise ValueError(
            f"{caller}: got {n} runs, expected at most 4000; pass a sample of the rows"
        )
    if np.isneginf(values).any():
        raise ValueError(
            f"{caller}: responses: got -inf, expected numbers; NaN is a run without response"
        )
    _, first, inverse = np.unique(points, axis=0, return_index=True, return_inverse=True)
    copies = np.flatnonzero(first[inverse.ravel()] != np.arange(n))
    if copies.size:
        row = int(copies[0])
        raise ValueError(
            f"{caller}: got rows {first[inverse.ravel()[row]]} and {row} (counted from 0) with "
            "equal inputs, expected different runs of a deterministic response; leave one out, or "
            "pass the input in which they differ"
        )
