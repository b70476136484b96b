"""`Runs`: a table of existing runs, in place of a function."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from prbayes._display import Shown, View
from prbayes._finding import counted
from prbayes._stats import positive_scale
from prbayes._validate import Floats, StrPath, complete_rows, finite_or_nan
from prbayes.emulators.selection import CrossValidation
from prbayes.emulators.surrogate import Surrogate, values_inside, with_output_labels
from prbayes.emulators.table import RunTable, read_csv, read_table
from prbayes.response.inputs import Inputs
from prbayes.response.outputs import Outputs, is_missing


class Runs(Shown):
    """A table of runs that were computed before, in place of a function of the inputs.

    It is a `Surrogate` through the runs, whose error is cross-validated: the best one of two
    Gaussian processes and quintic radial basis functions. Outside the ranges of the runs, and
    beside a run that failed, it is NaN. `Simulator`, `predict` and `exceedance` take it as a
    response. With the log-likelihood by specimen the error of the surface is part of the
    comparison.

    Parameters
    ----------
    inputs : DataFrame, mapping, Dataset, DataArray or array_like, shape (n, d)
        A row for each run, in the input's own units; an entry of a mapping has shape (n,), or (n,
        k) for an input of k numbers. The order is that of the inputs of the simulator. Inputs of
        the model that have a name are compared with the names of the columns.
    responses : Series, DataFrame, mapping, Dataset, DataArray or array_like, (n,) or (n, m)
        NaN is a run without response, +inf a specimen that failed. An index is matched to that of
        the inputs. Outputs with names are matched to those of ``observed``.

    Attributes
    ----------
    inputs : tuple of str
        Names of the inputs; x1, x2, ... without names.
    outputs : tuple of str
    points : ndarray, shape (n, d)
    responses : ndarray, shape (n,) or (n, m)
    surrogate : Surrogate

    Raises
    ------
    TypeError, ValueError
        If a cell is no number, inputs are missing, constant or equal in two runs, or fewer than
        eight runs, or four for each input, have a response.

    See Also
    --------
    prbayes.propose_runs : points where more runs are needed.

    Examples
    --------
    >>> import numpy as np, prbayes as prb
    >>> x, y = np.random.default_rng(0).random((2, 60))
    >>> runs = prb.Runs({"x": x, "y": y}, np.sin(3 * x) * np.exp(y))
    >>> runs.error.relative < 0.01
    True
    >>> runs(np.array([0.5, 2.0]), 0.5).round(2)
    array([1.64,  nan])
    """

    # Advice in messages about points where the response is NaN.
    remedy = "add the runs that prb.propose_runs(model) returns"

    def __init__(self, inputs: Any, responses: Any) -> None:
        # The surrogate does not warn of points outside the ranges, since a large share of them is
        # refused.
        table = read_table("Runs", inputs, responses)
        self.surrogate = replace(Surrogate.of_table("Runs", table), _warned=[True])
        self.outputs = table.outputs
        if is_missing(table.responses).any():
            self.remedy = f"leave out runs that failed by chance, {self.remedy}"

    @classmethod
    def read_csv(
        cls,
        path: StrPath,
        inputs: Sequence[str],
        outputs: Sequence[str],
        *,
        delimiter: str = ",",
        decimal: str = ".",
    ) -> Runs:
        r"""Read a text file whose first line has the names of the columns.

        Parameters
        ----------
        path : path-like
        inputs : sequence of str
            Columns of the inputs, in the order of the inputs of the simulator.
        outputs : sequence of str
            Columns of the responses. A cell that is empty or "nan" is a run without response.
        delimiter, decimal : str
            Characters between columns, and before decimals.

        Returns
        -------
        Runs

        Raises
        ------
        ValueError
            At the first cell that is no number, with its line.

        Examples
        --------
        >>> import pathlib, tempfile, prbayes as prb
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "runs.csv"
        >>> _ = path.write_text("load,sag\n" + "".join(f"{k},{k * k}\n" for k in range(1, 12)))
        >>> prb.Runs.read_csv(path, ["load"], ["sag"]).ranges
        {'load': (1.0, 11.0)}
        """
        return cls(*read_csv("Runs.read_csv", path, inputs, outputs, delimiter, decimal))

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the inputs."""
        return self.surrogate.names

    @property
    def points(self) -> Floats:
        """Inputs of the runs, (n, d)."""
        return self.surrogate.points

    @property
    def responses(self) -> Floats:
        """Responses of the runs, (n,) or (n, m)."""
        return self.surrogate.responses

    @property
    def ranges(self) -> dict[str, tuple[Any, Any]]:
        """Lowest and highest value of each input."""
        return self.surrogate.ranges

    @property
    def error(self) -> CrossValidation:
        """The cross-validated error of the surface through the runs."""
        return self.surrogate.error

    def __len__(self) -> int:
        return len(self.points)

    def __call__(self, *inputs: ArrayLike) -> Any:
        """Return the response, (...), or (..., m) with labels; NaN outside the ranges."""
        return self.surrogate(*inputs)

    def to_dataframe(self) -> Any:
        """Return the runs as a DataFrame: a column for each number of the inputs and outputs."""
        return self.surrogate.to_dataframe().set_axis([*self.columns, *self.outputs], axis=1)

    @property
    def columns(self) -> list[str]:
        """Name of each number of the inputs."""
        return list(self.surrogate.domain.column_names)

    def error_beside(self, observed: Floats) -> float:
        """Return the largest left-out error of an output beside data (N,) or (N, m).

        In standard deviations of the data: the 90 % quantile at the runs within their range or half
        of it away. At a few runs at the ends of the ranges left-out errors are far larger.
        """
        data = finite_or_nan(observed).reshape(len(observed), -1)
        low = np.nanmin(data, axis=0)
        high = np.nanmax(data, axis=0)
        sd = np.nanstd(data, axis=0)
        margin = (high - low) / 2
        values = self.responses.reshape(len(self), -1)
        is_inside = (values >= low - margin) & (values <= high + margin)
        is_near = is_inside.all(axis=1)
        is_finite = complete_rows(values)
        rows = is_near if is_near.sum() >= 8 else is_finite
        residuals = self.error.residuals.reshape(values.shape)[rows]
        errors = np.quantile(np.abs(residuals), 0.9, axis=0)
        return float((errors / positive_scale(sd, np.inf)).max())

    def refuse_misfit(self, name: str, sizes: Sequence[int], outputs: Outputs | None) -> None:
        """Raise if inputs of these sizes, or the observed outputs, are not those of the table."""
        expected = self.surrogate.domain.sizes
        if list(sizes) != expected:
            raise TypeError(
                f"{name}: response: got inputs of {list(sizes)} numbers for a table of runs of "
                f"{', '.join(self.columns)}, expected {expected}, in the order of its columns"
            )
        m, table = 1 if outputs is None else max(1, len(outputs.labels)), len(self.outputs)
        if outputs is not None and m != table:
            raise ValueError(
                f"{name}: observed: got {counted(m, 'output')} for a table of runs with "
                f"{', '.join(self.outputs)}, expected {table}; make prb.Runs of those measured"
            )

    def refuse_inputs(self, name: str, inputs: Inputs) -> None:
        """Raise if an input with the name of a column is at another place, or a constant outside.

        Raises TypeError or ValueError.
        """
        for place, argument in enumerate(inputs.arguments):
            r = self.surrogate.domain.inputs[place]
            x = inputs.aleatory[argument] if isinstance(argument, int) else argument
            label = getattr(x, "name", None)
            if label in self.inputs and label != r.name:
                raise TypeError(
                    f"{name}: got {label} as input {place + 1}, expected {r.name}, in the order "
                    f"of the columns of the table: {', '.join(self.inputs)}"
                )
            is_constant = not isinstance(argument, int) and not hasattr(argument, "owner")
            if is_constant and not (r.low <= argument).all() & (argument <= r.high).all():
                raise ValueError(
                    f"{name}: {r.name}: got the constant {argument}, expected {np.min(r.low):.6g} "
                    f"to {np.max(r.high):.6g}, the range of the runs"
                )

    def to_view(self) -> View:
        """Return what a reader sees."""
        shown = self.surrogate.to_view()
        names = [*self.columns, *self.outputs]
        rows = [[name, *row[1:]] for name, row in zip(names, shown.rows, strict=False)]
        return replace(shown, heading=f"Runs: {shown.heading.partition(' through ')[2]}", rows=rows)


def continued(runs: Runs, *inputs: ArrayLike) -> Any:
    """Return the response, (...) or (..., m); linear beyond the ranges, NaN beside failed runs."""
    surrogate, domain = runs.surrogate, runs.surrogate.domain
    columns, batch = domain.columns(inputs)
    unit = domain.scaled(columns)
    inner = np.clip(unit, 0, 1)
    values = values_inside(surrogate, domain.at(inner))
    rows = np.flatnonzero(domain.outside(columns).any(axis=1))
    _, jacobian = surrogate._surface.emulator(inner[rows])
    change = np.einsum("kmd,kd->km", jacobian, unit[rows] - inner[rows])
    values[rows] += change.reshape(values[rows].shape)
    return with_output_labels(surrogate, values, batch)


def left_out_nearby(runs: Runs, *inputs: ArrayLike) -> Any:
    """Return the left-out error of the nearest run, (...) or (..., m)."""
    surrogate = runs.surrogate
    columns, batch = surrogate.domain.columns(inputs)
    residuals = surrogate._surface.nearby(surrogate.error.residuals, columns)[:, 0]
    return with_output_labels(surrogate, residuals, batch)


def outlier_advice(runs: Runs) -> str:
    """Return advice on the run that causes most of the error; empty if no single run does.

    Without it the root mean square of the left-out errors of the others is less than a fifth.
    """
    values = runs.responses.reshape(len(runs), -1)
    scale = positive_scale(np.nanstd(finite_or_nan(values), axis=0))
    errors = np.abs(runs.error.residuals.reshape(values.shape)) / scale
    row = int(np.nanargmax(errors.max(axis=1)))
    is_kept = np.arange(len(runs)) != row
    domain, points = runs.surrogate.domain, runs.points[is_kept]
    reduced = RunTable(domain, points, runs.responses[is_kept], runs.outputs)
    refitted = Surrogate.of_table("Runs", reduced).error.residuals
    refitted = refitted.reshape(values[is_kept].shape) / scale
    share = float(np.sqrt(np.nanmean(refitted**2) / np.nanmean(errors[is_kept] ** 2)))
    if not share < 0.2:
        return ""
    names = [*runs.columns, *runs.outputs]
    pairs = zip(names, [*runs.points[row], *values[row]], strict=True)
    numbers = ", ".join(f"{name} = {value:.4g}" for name, value in list(pairs)[:4])
    return (
        f"correct or leave out row {row} of the table (counted from 0; {numbers}), without "
        f"which this error is {max(share, 0.01):.0%} of that at the other runs"
    )
