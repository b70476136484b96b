"""Calls of the response at points, one by one or as a batch, here or on a worker."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prbayes._validate import Floats
from prbayes.response.executors import time_limit
from prbayes.response.failures import ResponseError
from prbayes.response.outputs import SINGLE_OUTPUT, Outputs, outputs_of_result

Rows = NDArray[np.intp]


class scalar:  # noqa: N801 (reads as a function in a model)
    """Turn a function of one specimen's inputs into a response; also for external programs.

    Parameters
    ----------
    function : callable
        ``function(*inputs)``; a scalar input is a float, a multivariate one an array. It returns a
        number, or for several outputs an array, shape (m,), or a mapping of such.

    Raises
    ------
    TypeError
        If ``function`` is not callable.

    Notes
    -----
    Called directly, not by a simulator, all inputs are taken as scalar. ``response.function`` is
    the function of one specimen, whose inputs may be arrays.

    Examples
    --------
    >>> import numpy as np
    >>> response = scalar(lambda x: x**2 if x > 0 else 0.0)
    >>> response(np.array([[1.0, 2.0], [-3.0, 4.0]]))
    array([[ 1.,  4.],
           [ 0., 16.]])
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        if not callable(function):
            got = type(function).__name__
            raise TypeError(f"scalar: got {got}, expected a function of one specimen's inputs")
        self.function = function

    def __call__(self, *inputs: Any) -> Floats | dict[str, Floats]:
        """Call the function for each element of arrays that broadcast against each other.

        A function that returns a mapping gives a mapping of arrays.
        """
        arrays = np.broadcast_arrays(*(np.asarray(x, dtype=np.float64) for x in inputs))
        outputs: Outputs | None = None
        values = []
        for specimen in zip(*(array.ravel() for array in arrays), strict=True):
            try:
                result = self.function(*specimen)
            except (IndexError, TypeError) as error:
                error.add_note(
                    "prb.scalar: called by hand, every input is a number; where one is "
                    "multivariate, call response.function(...) with the inputs of one specimen"
                )
                raise
            outputs = _outputs_from(result, 0, outputs)
            values.append(_specimen_response(result, outputs))
        event = np.shape(values[0]) if values else ()
        batch = np.array(values).reshape(arrays[0].shape + event)
        return batch if outputs is None else outputs.by_key(batch)


@dataclass(frozen=True)
class Points:
    """Points at which the response is evaluated."""

    # Arguments of the response: arrays (n, *event) where they vary, constants elsewhere.
    arguments: Sequence[Any]
    varying: Sequence[bool]

    def __len__(self) -> int:
        return len(self.arguments[list(self.varying).index(True)])

    def at(self, rows: Rows | int) -> Points:
        """Return the points at some rows; a number selects one, without the leading axis."""
        pairs = zip(self.arguments, self.varying, strict=True)
        return Points([a[rows] if varies else a for a, varies in pairs], self.varying)

    def copied_arguments(self) -> list[Any]:
        """Return the arguments for a response, which may change them in place."""
        return [a.copy() if isinstance(a, np.ndarray) else a for a in self.arguments]

    def keys(self) -> Floats:
        """Return all numbers that a response depends on, constants included, shape (n, columns)."""
        n = len(self)
        columns = []
        for a, varies in zip(self.arguments, self.varying, strict=True):
            values = a if varies else np.broadcast_to(a, (n, *np.shape(a)))
            columns.append(values.reshape(n, int(np.prod(values.shape[1:], dtype=int))))
        return np.concatenate(columns, axis=1).astype(np.float64)

    def from_keys(self, keys: Floats) -> Points:
        """Return the points of keys with the same constants."""
        arguments = []
        for a, event, columns in self._columns():
            is_constant = event is None
            arguments.append(a if is_constant else keys[:, columns].reshape(len(keys), *event))
        return Points(arguments, self.varying)

    def have_same_constants(self, keys: Floats) -> NDArray[np.bool_]:
        """Return which keys have the same constants as these points, shape (n,)."""
        same = np.ones(len(keys), dtype=bool)
        for a, event, columns in self._columns():
            if event is None:
                same &= (keys[:, columns] == np.ravel(a)).all(axis=1)
        return same

    def _columns(self) -> Iterator[tuple[Any, Any, slice]]:
        """Yield each argument, its event shape (None of a constant), and its columns in keys."""
        stop = 0
        for a, varies in zip(self.arguments, self.varying, strict=True):
            event = np.shape(a)[1:] if varies else np.shape(a)
            start, stop = stop, stop + int(np.prod(event, dtype=int))
            yield a, event if varies else None, slice(start, stop)


@dataclass(frozen=True)
class Chunk:
    """Responses at the points of a chunk, as a worker returns them."""

    # (m, *event): NaN where the response raised, or was not called after an earlier failure.
    values: Floats
    raised: dict[int, str]  # reasons of failures by row
    seconds: float
    named: Outputs | None = None  # outputs of a mapping, where they were not known


def compute(
    function: Callable[..., Any],
    points: Points,
    tolerant: bool,
    timeout: float | None = None,
    outputs: Outputs | None = SINGLE_OUTPUT,
) -> Chunk:
    """Return the responses at points; unless failures are tolerated, up to the first one."""
    clock = time.perf_counter()
    evaluate = _one_by_one if isinstance(function, scalar) else _as_batch
    values, raised, known = evaluate(function, points, tolerant, timeout, outputs)
    named = known if outputs is None else None
    return Chunk(values, raised, time.perf_counter() - clock, named)


type _Computed = tuple[Floats, dict[int, str], Outputs | None]


def _one_by_one(
    function: Callable[..., Any],
    points: Points,
    tolerant: bool,
    timeout: float | None,
    outputs: Outputs | None,
) -> _Computed:
    event = () if outputs is None else outputs.event
    values = np.full((len(points), *event), np.nan)
    raised = {}
    specimen_function = function.function  # type: ignore[attr-defined]
    for i in range(len(points)):
        try:
            with np.errstate(all="ignore"), time_limit(timeout):
                result = specimen_function(*points.at(i).copied_arguments())
            outputs = _outputs_from(result, 0, outputs)
            values = assign_rows(values, np.array([i]), _specimen_response(result, outputs)[None])
        except (Exception, SystemExit) as error:
            raised[i] = _reason(error)
            if not tolerant:
                break
    return values, raised, outputs


def _as_batch(
    function: Callable[..., Any],
    points: Points,
    tolerant: bool,
    timeout: float | None,
    outputs: Outputs | None,
) -> _Computed:
    size = len(points)
    try:
        with np.errstate(all="ignore"), time_limit(timeout and timeout * size):
            result = function(*points.copied_arguments())
    except (Exception, SystemExit) as error:
        if not tolerant or size == 1:
            event = () if outputs is None else outputs.event
            return np.full((size, *event), np.nan), {0: _reason(error)}, outputs
    else:
        outputs = _outputs_from(result, 1, outputs)
        return checked(result, (size,), points.arguments, outputs), {}, outputs
    # Bisect until the points that fail are alone.
    values = np.full(size, np.nan)
    raised = {}
    for rows in (np.arange(size // 2), np.arange(size // 2, size)):
        half, reasons, outputs = _as_batch(function, points.at(rows), tolerant, timeout, outputs)
        values = assign_rows(values, rows, half)
        raised.update({int(rows[i]): reason for i, reason in reasons.items()})
    return values, raised, outputs


def assign_rows(values: Floats, rows: Rows, responses: Floats) -> Floats:
    """Return values with the responses at some rows, with an axis of outputs if these have one."""
    if values.ndim == 1 and responses.ndim > 1:
        values = np.repeat(values[:, None], responses.shape[1], axis=1)
    values[rows] = responses
    return values


# -- results ---------------------------------------------------------------------------------------


class _NoResponseError(ResponseError):
    """A function of one specimen returned something that is no response."""


def is_wrong_result(reason: str) -> bool:
    """Return whether a failure is a result of the wrong kind, not an exception."""
    return reason.startswith("it returned ")


def _reason(error: BaseException) -> str:
    """Return the reason of a failure as a text of some lines that can be printed and stored."""
    if isinstance(error, _NoResponseError):
        return str(error)
    try:
        text = str(error)
    except Exception as second:
        text = f"(its text raises {type(second).__name__})"
    text = text.encode("utf-8", "backslashreplace").decode().replace("\0", "\\0")
    return f"it raised {type(error).__name__}: {text:.1000}"


def _outputs_from(result: Any, batch_ndim: int, outputs: Outputs | None) -> Outputs | None:
    """Return the outputs, those of the result's mapping if they are not known."""
    if outputs is None and isinstance(result, Mapping):
        return outputs_of_result(result, batch_ndim)
    return outputs


def _specimen_response(result: Any, outputs: Outputs | None) -> Floats:
    """Return the response of one specimen, shape (*event)."""
    is_number = np.ndim(result) == 0 if outputs is None else not outputs.event
    if is_number and not isinstance(result, Mapping):
        return np.asarray(float(result))
    try:
        return checked(result, (), (), outputs)
    except ResponseError as error:
        raise _NoResponseError(f"it {str(error).removeprefix('the response ')}") from None


def checked(
    result: Any,
    batch: tuple[int, ...],
    arguments: Sequence[Any],
    outputs: Outputs | None = SINGLE_OUTPUT,
) -> Floats:
    """Return a response's result as floats, shape (*batch, *event), or raise `ResponseError`.

    If one output of a point is NaN, all of its outputs are.
    """
    try:
        if isinstance(result, Mapping):
            result = (outputs or outputs_of_result(result, len(batch))).assembled(result)
        array = np.asarray(result)
    except KeyError as error:
        raise ResponseError(str(error.args[0])) from None
    except Exception as error:
        raise ResponseError(
            f"the response returned {type(result).__name__} of which no array can be made "
            f"({_reason(error)}), expected an array of real numbers"
        ) from None
    if array.dtype.kind not in "fiub":
        got = f"{type(result).__name__} of dtype {array.dtype}"
        if array.dtype.kind == "c":
            got = "complex numbers"
        raise ResponseError(f"the response returned {got}, expected an array of real numbers")
    event = array.shape[len(batch) :]
    expected = event[:1] if outputs is None else outputs.event
    if array.shape != batch + expected:
        remedy = "return as many numbers as were observed of a specimen"
        if batch:
            remedy = (
                "reduce over the event axis only (the last one), or wrap a function of one "
                "specimen in prb.scalar"
            )
        if event and event in {np.shape(a)[len(batch) :] for a in arguments}:
            remedy = (
                "it is as long as an input, which has several elements; reduce over them, or where "
                "they are of groups, such as suppliers, index their hyperparameters by "
                "prb.response.group"
            )
        inputs = f" for inputs of shapes {shapes(arguments)}" if arguments else ""
        count = f"{expected[0]} outputs" if expected else "one response"
        raise ResponseError(
            f"the response returned shape {array.shape}{inputs}, expected {batch + expected}: "
            f"{count} per specimen; {remedy}"
        )
    values = array.astype(np.float64)
    if expected:
        values[np.isnan(values).any(axis=-1)] = np.nan
    return values


def shapes(arguments: Sequence[Any]) -> str:
    """Return the shapes of a response's arguments, for messages."""
    return ", ".join(str(np.shape(a)) for a in arguments)


def packed(function: Callable[..., Any]) -> bytes:
    """Return a function as bytes for another process."""
    import cloudpickle

    return bytes(cloudpickle.dumps(function))


@lru_cache(maxsize=8)  # for the responses of several simulators
def _unpacked(payload: bytes) -> Callable[..., Any]:
    import cloudpickle

    return cloudpickle.loads(payload)  # type: ignore[no-any-return]


def compute_packed(
    payload: bytes,
    points: Points,
    tolerant: bool,
    timeout: float | None = None,
    outputs: Outputs | None = SINGLE_OUTPUT,
) -> Chunk:
    """Unpack the function, once for all chunks of a worker, and compute."""
    return compute(_unpacked(payload), points, tolerant, timeout, outputs)
