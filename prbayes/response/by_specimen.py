"""Responses with a function, or a record such as a dose history, of each specimen's own.

A run at a point of the inputs calls the functions of all specimens. Their outputs are side by side,
so that one emulator has all of them, and the likelihood of a specimen takes those of its function.
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from prbayes._validate import Function, Indices, called, wrong_value
from prbayes.response.call import scalar, unwrapped


@dataclass(frozen=True, eq=False)
class BySpecimen:
    """A response that returns the outputs of functions, one after the other."""

    functions: tuple[Function, ...]  # different functions
    places: tuple[int, ...]  # (N,): index of the function of each specimen
    # For each function, the columns of the readings that are its outputs; None before these are
    # known.
    columns: tuple[Indices, ...] | None = None
    readings: int | None = None  # number of columns of the readings; None for one number

    def __call__(self, *inputs: Any) -> Any:
        """Return the outputs of all functions, (..., M), at inputs of shape (...)."""
        parts = []
        for k, function in enumerate(self.functions):
            try:
                result = function(*inputs)
            except Exception as error:
                raise RuntimeError(f"{self.label(k)}: {type(error).__name__}: {error}") from error
            parts.append(self._outputs(k, np.asarray(result), inputs))
        batches = [part.shape[:-1] for part in parts]
        if len(set(batches)) > 1:
            k = next(k for k, batch in enumerate(batches) if batch != batches[0])
            raise ValueError(
                f"{self.label(k)} returned shape {parts[k].shape[:-1]} for inputs of shapes "
                f"{[np.shape(x) for x in inputs]}, and {self.label(0)} {batches[0]}, expected the "
                "same of all; wrap functions of one specimen in prb.scalar"
            )
        return np.concatenate(parts, axis=-1)

    def _outputs(self, k: int, result: Any, inputs: Sequence[Any]) -> Any:
        """Return the outputs of a function that have readings, (..., m)."""
        has_axis = result.ndim > max((np.ndim(x) for x in inputs), default=0)
        if self.columns is None:
            return result if has_axis else result[..., None]
        if self.readings is None and has_axis:
            raise ValueError(
                f"{self.label(k)} returned shape {result.shape} for inputs of shapes "
                f"{[np.shape(x) for x in inputs]}, expected one number for each point, as observed "
                "has one reading of a specimen"
            )
        if self.readings is None:
            return result[..., None]
        used = self.columns[k]
        sizes = sorted({int(used[-1]) + 1, self.readings})
        size = result.shape[-1] if result.ndim else 0
        if size not in sizes:
            raise ValueError(
                f"{self.label(k)} returned shape {result.shape}, expected "
                f"{' or '.join(map(str, sizes))} outputs along the last axis, as many as its "
                "readings"
            )
        return result[..., used]

    def label(self, k: int) -> str:
        """Return which specimens have a function, as a text."""
        rows = [str(row) for row, place in enumerate(self.places) if place == k]
        more = ", ..." if len(rows) > 3 else ""
        return f"function of specimen {', '.join(rows[:3])}{more}"

    @property
    def __signature__(self) -> inspect.Signature:
        """The signature of the first function, without its record."""
        function = unwrapped(self.functions[0])
        if not isinstance(function, _Recorded):
            return inspect.signature(function)
        signature = inspect.signature(function.function)
        return signature.replace(parameters=list(signature.parameters.values())[:-1])

    @property
    def __name__(self) -> str:
        """The name of the first function."""
        inner = unwrapped(self.functions[0])
        inner = getattr(inner, "function", inner)
        return str(getattr(inner, "__name__", type(inner).__name__))


def by_specimen(
    functions: Function | Sequence[Function], records: Sequence[Any] | None = None
) -> BySpecimen:
    """Return a response with a function, or a record, of each specimen's own.

    Specimens have functions of their own where each was measured on another structure or mesh.
    A record is what one function needs to know of a specimen: a dose history, a load sequence.

    Parameters
    ----------
    functions : sequence of callable, or callable
        The function of each of the N specimens, in the order of the observed values; or one
        function of all, which takes the record of a specimen as its last argument. A function
        takes the inputs, arrays of shape (...), and returns an output for each reading of its
        specimen: (...) if ``observed`` has the shape (N,), and (..., T) if it is (N, T), where T
        may be less for rows that NaN fills up. Wrap a function of numbers in `prb.scalar`.
    records : sequence, optional
        The N records: any objects, which are handed over as they are.

    Returns
    -------
    BySpecimen
        A response for `prb.Simulator` with the log-likelihood by specimen.

    Raises
    ------
    TypeError, ValueError
        If a function cannot be called, or there are less than two specimens.

    Notes
    -----
    A run calls the functions of all specimens, once for each different one; records or functions
    that are the same object count as one.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> loads = [{"N": [1.0, 2.0]}, {"N": [3.0]}, {"N": [1.0, 4.0]}]
    >>> def work(stiffness, record):
    ...     return sum(np.square(record["N"])) / stiffness
    >>> response = prb.response.by_specimen(work, loads)
    >>> response(2.0)
    array([2.5, 4.5, 8.5])
    """
    caller = "prb.response.by_specimen"
    if isinstance(functions, Sequence):
        if records is not None:
            raise TypeError(
                f"{caller}: got {len(functions)} functions and records, expected one function of "
                "inputs and record, or functions alone"
            )
        objects = separate = list(functions)
    else:
        is_table = isinstance(records, Mapping | str | bytes) or hasattr(records, "columns")
        if is_table or not hasattr(records, "__len__"):
            raise wrong_value(
                records,
                f"{caller}: records",
                "a list with the record of each specimen, beside one function",
            )
        objects = list(cast(Sequence[Any], records))
        separate = [_with_record(functions, record) for record in objects]
    for row, function in enumerate([functions] if records is not None else separate):
        if not callable(function) or isinstance(function, type):
            raise TypeError(
                f"{caller}: functions: got {called(function)} at {row}, expected a function of the "
                "inputs for each specimen"
            )
    if len(separate) < 2:
        raise ValueError(f"{caller}: got {len(separate)} specimens, expected at least 2 of them")
    first: dict[int, int] = {}
    places = tuple(first.setdefault(id(x), len(first)) for x in objects)
    different = [separate[places.index(k)] for k in range(len(first))]
    return BySpecimen(tuple(different), places)


def _with_record(function: Any, record: Any) -> Any:
    """Return a function of the inputs alone; a `scalar` stays one."""
    if isinstance(function, scalar):
        return scalar(_with_record(function.function, record))
    return _Recorded(function, record)


@dataclass(frozen=True, eq=False)
class _Recorded:
    """A function with the record of a specimen as its last argument."""

    function: Function
    record: Any

    def __call__(self, *inputs: Any) -> Any:
        return self.function(*inputs, self.record)


def of_specimens(function: Any) -> BySpecimen | None:
    """Return the functions by specimen of a response, which may be in `scalar`; None without."""
    inner = unwrapped(function)
    return inner if isinstance(inner, BySpecimen) else None


def with_columns(function: Any, columns: Sequence[Indices], readings: int | None) -> Any:
    """Return a response by specimen whose outputs are those of the readings."""
    inner = of_specimens(function)
    assert inner is not None
    changed = replace(inner, columns=tuple(columns), readings=readings)
    return changed if inner is function else scalar(changed)
