"""Calls of the response at points: one by one, as a batch, or in chunks on an executor.

`respond` looks points up in the store, computes missing ones by `chunks`, and stores each chunk
before it waits for the next.
"""

from __future__ import annotations

import io
import logging
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prbayes._finding import Finding, counted, report
from prbayes._progress import progress
from prbayes._stats import positive_scale
from prbayes._validate import (
    NO_POPULATION,
    Bools,
    Floats,
    Function,
    Indices,
    Names,
    Shape,
    complete_rows,
    unmasked,
)
from prbayes.response.budget import BudgetError, budget
from prbayes.response.executors import (
    Pool,
    capacity,
    failure_of,
    failure_text,
    has_slipped,
    is_loss,
    time_limit,
)
from prbayes.response.failures import Abort, Failure, OnFailure, Replace, ResponseError
from prbayes.response.outputs import SINGLE_OUTPUT, Outputs, is_missing, outputs_of_result
from prbayes.response.store import Store, StoreError, add_digests, stored_digests
from prbayes.response.variables import changed_names, listed, watched

_log = logging.getLogger(__name__)


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

    def __init__(self, function: Function) -> None:
        if not callable(function):
            got = type(function).__name__
            raise TypeError(f"scalar: got {got}, expected a function of one specimen's inputs")
        self.function = function

    def __call__(self, *inputs: Any) -> Any:
        """Call the function for each element of arrays that broadcast against each other.

        A function that returns a mapping or labels gives a mapping of arrays.
        """
        arrays = np.broadcast_arrays(*(np.asarray(x, dtype=np.float64) for x in inputs))
        outputs = None
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
            response, outputs = _specimen_response(result, outputs)
            values.append(response)
        event = np.shape(values[0]) if values else ()
        batch = np.array(values).reshape(arrays[0].shape + event)
        return batch if outputs is None else outputs.by_key(batch)


def unwrapped(function: Function) -> Function:
    """Return the function of one specimen inside a `scalar`; other functions unchanged."""
    return function.function if isinstance(function, scalar) else function


def takes_single_points(function: Function) -> bool:
    """Return whether a function is called for each point alone.

    With a generator for each point its numbers would otherwise depend on the chunk of the point.
    """
    return isinstance(function, scalar) or getattr(function, "_has_generators", False)


@dataclass(frozen=True)
class Points:
    """Points at which the response is evaluated."""

    # Arguments of the response: an array (n, *event) if it varies, else a constant.
    arguments: Sequence[Any]
    varying: Sequence[bool]

    def __len__(self) -> int:
        return len(self.arguments[list(self.varying).index(True)])

    def at(self, rows: Indices | int) -> Points:
        """Return the points at some rows; a number selects one, without the leading axis."""
        pairs = zip(self.arguments, self.varying, strict=True)
        return Points([a[rows] if varies else a for a, varies in pairs], self.varying)

    def keys(self) -> Floats:
        """Return all numbers that a response depends on, constants included, shape (n, columns)."""
        n = len(self)
        columns = []
        for a, varies in zip(self.arguments, self.varying, strict=True):
            values = a if varies else np.broadcast_to(a, (n, *np.shape(a)))
            columns.append(values.reshape(n, math.prod(values.shape[1:])))
        return np.concatenate(columns, axis=1).astype(np.float64)

    def read_keys(self, keys: Floats) -> tuple[Points, Bools]:
        """Return the points that keys, (n, columns), stand for, and whether constants agree, (n,).

        The constants of a key are compared with those of these points.
        """
        have_same_constants = np.ones(len(keys), dtype=bool)
        arguments = []
        stop = 0
        for a, varies in zip(self.arguments, self.varying, strict=True):
            event = np.shape(a)[1:] if varies else np.shape(a)
            start = stop
            stop = stop + math.prod(event)
            values = keys[:, start:stop]
            if not varies:
                have_same_constants &= (values == np.ravel(a)).all(axis=1)
            arguments.append(values.reshape(len(keys), *event) if varies else a)
        return Points(arguments, self.varying), have_same_constants


@dataclass(frozen=True)
class Chunk:
    """Responses at the points of a chunk, as a worker returns them."""

    # Responses, (m, *event): NaN where the response raised, or was not called after a failure.
    values: Floats
    raised: dict[int, str]  # reasons of failures by row
    seconds: float  # duration of all calls
    named: Outputs | None = None  # outputs that the first mapping declared, if nobody stated them


def compute(
    function: Function | bytes,
    points: Points,
    tolerant: bool,
    timeout: float | None = None,
    outputs: Outputs | None = SINGLE_OUTPUT,
) -> Chunk:
    """Return the responses at points. Unless failures are tolerated, the first one ends the work.

    A function that takes single points is called for each of them, another one for all at once; if
    it raises, the points are bisected. Bytes are a function that was `packed` in another process.
    """
    if isinstance(function, bytes):
        function = unpacked(function)
    clock = time.perf_counter()
    stated, n = outputs, len(points)
    values = np.full((n, *(() if outputs is None else outputs.event)), np.nan)
    raised = {}
    is_scalar = isinstance(function, scalar)
    call = unwrapped(function)
    is_single = takes_single_points(function)
    waiting = [np.array([i]) for i in reversed(range(n))] if is_single else [np.arange(n)]
    while waiting:
        rows = waiting.pop()
        arguments = points.at(int(rows[0]) if is_scalar else rows).arguments
        # Pass copies, because the function may change its arguments in place.
        copies = [a.copy() if isinstance(a, np.ndarray) else a for a in arguments]
        try:
            with np.errstate(all="ignore"), time_limit(timeout and timeout * rows.size):
                result = call(*copies)
            if is_scalar:
                response, outputs = _specimen_response(result, outputs)
                responses = response[None]
        except (Exception, SystemExit) as error:
            if rows.size == 1 or not tolerant:
                raised[int(rows[0])] = _reason(error)
            else:
                waiting += [rows[rows.size // 2 :], rows[: rows.size // 2]]
            if not tolerant:
                break
            continue
        if not is_scalar:
            responses, outputs = checked(result, (rows.size,), arguments, outputs)
        values = assign_rows(values, rows, responses)
    named = outputs if stated is None else None
    return Chunk(values, raised, time.perf_counter() - clock, named)


def assign_rows(values: Floats, rows: Indices, responses: Floats) -> Floats:
    """Replace some rows of values by responses; add an axis of outputs if these have one."""
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


def _specimen_response(result: Any, outputs: Outputs | None) -> tuple[Floats, Outputs | None]:
    """Return the response of one specimen, shape (*event), and its outputs."""
    plain = unmasked(result)
    is_number = np.ndim(plain) == 0 and not isinstance(result, Mapping)
    try:
        if is_number and (outputs is None or not outputs.event):
            value = np.asarray(float(plain))
            refuse_negative_infinity(value)
            return value, outputs
        return checked(result, (), (), outputs)
    except ResponseError as error:
        raise _NoResponseError(f"it {str(error).removeprefix('the response ')}") from None


def checked(
    result: Any,
    batch: Shape,
    arguments: Sequence[Any],
    outputs: Outputs | None = SINGLE_OUTPUT,
) -> tuple[Floats, Outputs | None]:
    """Return a result as floats, (*batch, *event), and its outputs, or raise `ResponseError`."""
    try:
        if hasattr(result, "_fields") and (outputs is None or outputs.keys):
            result = result._asdict()  # a named tuple is read as a mapping
        if outputs is None:
            outputs = outputs_of_result(result, len(batch))
        if isinstance(result, Mapping):
            result = (outputs or SINGLE_OUTPUT).assembled(result)
        elif outputs is not None:
            result = outputs.ordered(result, len(batch))
        array = np.asarray(unmasked(result))
    except KeyError as error:
        raise ResponseError(str(error.args[0])) from None
    except Exception as error:
        raise ResponseError(
            f"the response returned {type(result).__name__} that is no array ({_reason(error)}), "
            "expected an array of real numbers"
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
        if math.prod(batch) == 1 and not expected:  # a batch of one specimen
            remedy = f"return one number; {PER_SPECIMEN}"
        elif batch:
            remedy = (
                "reduce over the event axis only (the last one), or wrap a function of one "
                "specimen in prb.scalar"
            )
            if (
                len(event) == 1 and not expected
            ):  # a curve of one specimen was observed as specimens
                remedy += f"; {NO_POPULATION}"
            if event and expected:
                remedy = (
                    "return as many outputs as observed= has columns; its rows are specimens, so "
                    f"transpose it if it has {event[0]} rows"
                )
            if not event and expected:
                remedy = "return outputs along a last axis, or as a mapping"
                if expected == (1,):
                    remedy += "; or pass observed= of shape (N,), as observed[:, 0]"
        if event and event in {np.shape(a)[len(batch) :] for a in arguments}:
            remedy = (
                "it is as long as an input, which has several elements; reduce over them, or where "
                "they are of groups, such as suppliers, index their hyperparameters by "
                "prb.response.group"
            )
        inputs = f" for inputs of shapes {shapes(arguments)}" if arguments else ""
        count = counted(expected[0], "output") if expected else "one response"
        raise ResponseError(
            f"the response returned shape {array.shape}{inputs}, expected {batch + expected}: "
            f"{count} per specimen; {remedy}"
        )
    values = array.astype(np.float64)
    if expected:  # a point has no response if one of its outputs is NaN
        values[np.isnan(values).any(axis=-1)] = np.nan
    refuse_negative_infinity(values)
    return values, outputs


def refuse_negative_infinity(values: Floats) -> None:
    """Raise if a response is -inf, such as the logarithm of 0."""
    if np.isneginf(values).any():
        count = f" {np.isneginf(values).sum()} times in {values.size} values" if values.ndim else ""
        raise ResponseError(
            f"the response returned -inf{count}, expected numbers, NaN (no response) or +inf (the "
            "specimen failed); a logarithm of 0 is -inf: return the lowest value that can be "
            "measured, or NaN"
        )


# Advice for a response that contains an array with a value for each measured specimen.
PER_SPECIMEN = (
    "a value that is known for each specimen, such as its load, is no constant: pass it as "
    "prb.response.condition('load', values), with the default metric"
)


def array_advice(reason: str) -> str:
    """Return advice if a response raised because array shapes do not match, else an empty text."""
    is_size = "broadcast" in reason or "ength of values" in reason
    return f"; {PER_SPECIMEN}; {NO_POPULATION}" if is_size else ""


def shapes(arguments: Sequence[Any]) -> str:
    """Return the shapes of a response's arguments, for messages."""
    return ", ".join(str(np.shape(a)) for a in arguments)


def column_names(names: Sequence[str], sizes: Sequence[int]) -> Names:
    """Return a name for each number of a point, from the names and sizes of the inputs."""
    pairs = zip(names, sizes, strict=True)
    return tuple(f"{x}[{i}]" if k > 1 else x for x, k in pairs for i in range(k))


def packed(function: Function) -> bytes:
    """Return a function as bytes for another process."""
    import cloudpickle

    return bytes(cloudpickle.dumps(function))


class _Limited(io.BytesIO):
    """A file of at most 4 MiB."""

    def write(self, data: Any) -> int:
        if self.tell() + memoryview(data).nbytes > 4 * 2**20:
            raise OverflowError("the function refers to large data")
        return super().write(data)


def written_form(function: Function) -> bytes | None:
    """Return a function with the variables that it reads, as bytes; None if it has no such form.

    Variables of an imported module are not in it.
    """
    import cloudpickle

    file = _Limited()
    try:
        cloudpickle.dump(function, file)
    except Exception:  # an object that cannot be pickled may raise anything
        return None
    return file.getvalue()


@lru_cache(maxsize=8)  # a few functions, because a model may have several simulators
def unpacked(payload: bytes) -> Function:
    """Return a function from its bytes."""
    import cloudpickle

    return cloudpickle.loads(payload)  # type: ignore[no-any-return]


# A finished chunk, with the rows of its points.
type Finished = tuple[Indices, Chunk]


@dataclass(frozen=True)
class CallSettings:
    """How a response is called."""

    name: str  # name of the simulator, for messages
    function: Function
    executor: Executor | None = None  # executor of the calls; None computes in this process
    store: Store | None = None
    on_failure: OnFailure = field(default_factory=Abort)
    retry_failed: bool = False  # whether points stored as failed, or NaN, are computed again
    timeout: float | None = None  # seconds for one response
    outputs: Outputs | None = SINGLE_OUTPUT  # stated outputs; None takes those of the first run
    columns: Names = ()  # names of the numbers of a point
    takes_policy: bool = True  # whether the caller of the public function can pass on_failure


@dataclass
class Tally:
    """Counts, time and failures of the calls of a response."""

    computed: int = 0  # number of computed responses: repeated ones count, stored ones do not
    failures: int = 0  # number of points whose response failed at the last try and was replaced
    seconds: float = 0.0  # running mean for one response, from which chunks are sized; 0 if unknown
    has_succeeded: bool = False  # whether any run gave a response
    named: Outputs | None = None  # outputs that the first mapping declared, if nobody stated them
    failed: dict[bytes, Failure] = field(default_factory=dict)  # failures by their inputs

    def aligned(self, chunk: Chunk) -> Floats:
        """Return the responses of a chunk, with columns in the order of the first chunk."""
        if chunk.named is None:
            return chunk.values
        if self.named is None:
            self.named = chunk.named
        if set(self.named.labels) != set(chunk.named.labels):
            raise ResponseError(
                f"the response returned a mapping with the keys {list(chunk.named.names)}, "
                f"expected {list(self.named.names)}, as for the first specimen"
            )
        order = [chunk.named.labels.index(label) for label in self.named.labels]
        return chunk.values[..., order]

    def count(self, size: int, seconds: float) -> None:
        """Count the responses of a chunk, and update the time of one."""
        self.computed += size
        mean = seconds / size
        self.seconds = 0.7 * self.seconds + 0.3 * mean if self.seconds != 0 else mean

    def record_failures(self, points: Points, reasons: dict[int, str]) -> None:
        """Store inputs and reasons of failures, given by row; at most ten thousand, about 10 MB."""
        for row, reason in reasons.items():
            if len(self.failed) == 10_000:
                break
            (inputs,) = points.at(np.array([row])).keys()
            self.failed.setdefault(inputs.tobytes(), Failure(inputs, reason))

    def copied(self) -> Tally:
        """Return an independent copy of the tally."""
        return replace(self, failed=dict(self.failed))


def respond(
    settings: CallSettings,
    points: Points,
    tally: Tally,
    on_start: Callable[[int, float], None] | None = None,
) -> Floats:
    """Return responses at points, shape (n, *event), from the store or computed and then stored.

    After the first chunk ``on_start`` is called with the number of missing runs and the seconds
    that one of them takes. `ResponseError` and `StoreError` end the calculation.
    """
    store = settings.store
    if store is None or store.verified:
        return _respond(settings, points, tally, on_start)
    _verify_store(settings, store, points, tally)
    record = watched(settings.function)
    with record.calls():
        values = _respond(settings, points, tally, on_start)
        record.called()
    # Note the variables that calls change, because a later use may find them as calls left them.
    digests = record.digests()
    if None in digests.values() and digests not in stored_digests(store):
        add_digests(store, digests)
    return values


def _respond(
    settings: CallSettings,
    points: Points,
    tally: Tally,
    on_start: Callable[[int, float], None] | None = None,
) -> Floats:
    """Return responses at points as `respond` does, for a store that is verified, or none."""
    policy = settings.on_failure
    event = () if settings.outputs is None else settings.outputs.event
    values = np.full((len(points), *event), np.nan)
    missing = np.arange(len(points))
    failed = {}
    raised: dict[int, str] = {}
    if settings.store is not None:
        keys = points.keys()
        values, is_stored = settings.store.find(keys)
        if settings.outputs is not None:
            values = values.reshape(len(keys), *event)
        failed = settings.store.failed(keys)
        if settings.retry_failed or not isinstance(policy.final, Replace):
            is_stored[list(failed)] = False
            failed = {}
        if settings.retry_failed:
            is_stored &= ~is_missing(values)
        missing = np.flatnonzero(~is_stored)
    for attempt in range(policy.tries):
        is_last = attempt == policy.tries - 1
        tolerant = isinstance(policy.final, Replace) or not is_last
        raised = {}
        for finished in chunks(settings, points, missing, tolerant, tally):
            if on_start is not None:
                on_start(missing.size, tally.seconds)
                on_start = None
            for rows, chunk in finished:
                values = assign_rows(values, rows, tally.aligned(chunk))
                raised.update({int(rows[i]): reason for i, reason in chunk.raised.items()})
                tally.has_succeeded |= len(chunk.raised) < len(rows)
            if not tally.has_succeeded and raised and all(map(is_wrong_result, raised.values())):
                # If no run has given a response, the function is wrong, whatever the policy.
                raise _failure_error(settings, points, raised)
            if settings.store is not None:
                _add_to_store(settings.store, keys, finished, is_last=is_last, tolerant=tolerant)
        if raised and not tolerant:
            tally.record_failures(points, raised)
            raise _failure_error(settings, points, raised)
        missing = missing[is_missing(values[missing])]
        if not missing.size:
            break
    return _apply_policy(settings, points, values, failed | raised, tally)


def _verify_store(settings: CallSettings, store: Store, points: Points, tally: Tally) -> None:
    """Compute a few stored runs again, once: the function or its variables may have changed.

    More are computed if the store has no run of the function as it is now.
    """
    keys, values = store.known()
    stored_points, is_comparable = points.read_keys(keys)
    is_comparable[list(store.failed(keys))] = False
    if settings.retry_failed:  # a stored NaN is computed again in any case
        is_comparable &= ~is_missing(values)
    usable = np.flatnonzero(is_comparable)
    reasons = {}

    def compute(selected: Indices) -> Floats:
        again, raised = computed_again(settings, stored_points.at(usable[selected]), tally)
        reasons.update({int(selected[i]): reason for i, reason in raised.items()})
        return again

    # Runs of other code may differ anywhere, not only at their ends.
    digests = watched(settings.function).digests()
    changes = [changed_names(stored, digests) for stored in stored_digests(store)]
    is_known = [] in changes
    if usable.size and not is_known:
        names = listed(min(changes, key=len)) if changes else "its code or variables"
        _log.info("%s: store: a tenth of the runs repeated: other %s", settings.name, names)
    change = changed_run(values[usable], compute, most=5 if is_known else None)
    if change is not None:
        selected, again = change
        row = usable[selected]
        text = numbers_text(again)
        remedy = "pass"
        if selected in reasons:
            text = f"nothing ({reasons[selected]})"
        elif np.isnan(values[row]).any():
            remedy = "after a repair pass retry_failed=True, which computes NaN again, or pass"
        raise StoreError(
            f"{settings.name}: store: got a response that gives {text} at "
            f"({', '.join(f'{x:.6g}' for x in keys[row])}), expected "
            f"{numbers_text(values[row])}, which is stored in {store.path}: it is another "
            f"function, or its variables have changed; nothing was changed: {remedy} another "
            "folder, or version= with a new name, whose runs are stored apart"
        )
    if not is_known:
        add_digests(store, digests)
    store.verified = True


def computed_again(
    settings: CallSettings, points: Points, tally: Tally
) -> tuple[Floats, dict[int, str]]:
    """Return responses at points, (n, *event), NaN where they raised, and the reasons by row."""
    event = () if settings.outputs is None else settings.outputs.event
    values = np.full((len(points), *event), np.nan)
    waiting = np.arange(len(points))
    raised: dict[int, str] = {}
    for _ in range(settings.on_failure.tries):
        raised = {}
        for finished in chunks(settings, points, waiting, True, tally):
            for rows, chunk in finished:
                values = assign_rows(values, rows, tally.aligned(chunk))
                raised.update({int(rows[i]): reason for i, reason in chunk.raised.items()})
        waiting = np.array(sorted(raised), dtype=np.intp)
        if not waiting.size:
            break
    return values, raised


def by_output(values: NDArray[Any]) -> NDArray[Any]:
    """Return responses, (n,) or (n, m), with a column for each output."""
    return values.reshape(len(values), math.prod(values.shape[1:]))


def revealing_rows(values: Floats) -> Indices:
    """Return rows of responses, (n,) or (n, m), at which a change of the function can show.

    The largest, the middle and the smallest response, one that is NaN and one that is infinite.
    The largest comes first, as the first run of a design may be the smallest.
    """
    columns = by_output(values)
    finite = finite_runs(values)
    is_nan = np.isnan(columns).any(axis=1)
    is_infinite = np.isinf(columns).any(axis=1) & ~is_nan
    size = np.abs(columns[finite]).max(axis=0, initial=0.0)
    sums = (columns[finite] / positive_scale(size)).sum(axis=1)
    order = finite[np.argsort(sums, kind="stable")]
    selected = [order[-1:], order[len(order) // 2 :][:1], order[:1]]
    selected += [np.flatnonzero(kind)[:1] for kind in (is_nan, is_infinite)]
    return np.array(list(dict.fromkeys(np.concatenate(selected).tolist())), dtype=np.intp)


def finite_runs(values: Floats) -> Indices:
    """Return the rows of responses, (n,) or (n, m), all outputs of which are finite."""
    return np.flatnonzero(complete_rows(by_output(values)))


def tolerance_of(values: Floats, share: float = 0.0) -> Any:
    """Return how much one of the responses, (n,) or (n, m), may change, for each output.

    It is the share of their standard deviation, but at least 1e-6 of their median size: more than
    the rounding of another machine, or of another version of a library.
    """
    finite = values[finite_runs(values)]
    if not len(finite):
        return 0.0
    rounding = 1e-6 * np.median(np.abs(finite), axis=0)
    return np.maximum(rounding, share * finite.std(axis=0)) if share else rounding


def first_change(values: Floats, again: Floats, tolerance: Any) -> int | None:
    """Return the first row in which responses differ from those computed again; None if none does.

    Large responses may differ by 1e-6 of their size if that is more than the tolerance.
    """
    if again.shape != values.shape:
        return 0
    is_same = (again == values) | (np.isnan(again) & np.isnan(values))
    with np.errstate(invalid="ignore"):
        is_same |= np.abs(again - values) <= np.maximum(tolerance, 1e-6 * np.abs(values))
    rows = np.flatnonzero(~by_output(is_same).all(axis=1))
    return int(rows[0]) if rows.size else None


def changed_run(
    values: Floats,
    compute: Callable[[Indices], Floats],
    share: float = 0.0,
    *,
    may_fail: bool = False,
    most: int | None = 5,
    n_random: int = 0,
) -> tuple[int, Floats] | None:
    """Return the row of a run that differs when it is computed again, and its response then.

    A few runs, (n,) or (n, m), are computed: ``most`` of `revealing_rows`, and random ones. If
    ``most`` is None, a tenth of all runs follows, and as many more as take ten seconds. The
    ``share`` is that of `tolerance_of`. With ``may_fail`` a run that fails now is no change: it
    may fail by chance.
    """
    rows = revealing_rows(values)[:most]
    inner = np.random.default_rng(0).permutation(np.setdiff1d(np.arange(len(values)), rows))
    blocks = [np.concatenate([rows, inner[:n_random]])]
    if most is None:
        blocks += np.array_split(inner, 10)
    clock = time.perf_counter()
    for k, block in enumerate(blocks):
        if not block.size or (k > 1 and time.perf_counter() - clock > 10):
            break
        again = compute(block)
        if may_fail:
            again = np.where(np.isnan(again), values[block], again)
        changed = first_change(values[block], again, tolerance_of(values, share))
        if changed is not None:
            return int(block[changed]), again[changed]
    return None


def numbers_text(values: Floats, digits: int = 10) -> str:
    """Return at most six numbers of a run, () or (m,), as a text."""
    values = np.ravel(values)
    text = ", ".join(f"{value:.{digits}g}" for value in values[:6])
    if values.size == 1:
        return text
    return f"({text}, ...)" if values.size > 6 else f"({text})"


def _add_to_store(
    store: Store, keys: Floats, finished: Sequence[Finished], *, is_last: bool, tolerant: bool
) -> None:
    """Store finished chunks in one transaction, since each transaction waits for the disk."""
    parts = []
    for rows, chunk in finished:
        # After the last try a NaN is stored as a result, except in a chunk that a failure ended.
        is_complete = tolerant or not chunk.raised
        stored = np.flatnonzero(~is_missing(chunk.values) | (is_last and is_complete))
        if stored.size:
            stored_rows = enumerate(map(int, stored))
            reasons = {i: chunk.raised[row] for i, row in stored_rows if row in chunk.raised}
            parts.append((keys[rows[stored]], chunk.values[stored], reasons))
    if parts:
        store.add_all(parts)


def _apply_policy(
    settings: CallSettings, points: Points, values: Floats, raised: dict[int, str], tally: Tally
) -> Floats:
    """Return responses with the policy's replacement of NaN, or raise if it refuses NaN."""
    tally.record_failures(points, raised)
    is_nan = is_missing(values)
    policy = settings.on_failure.final
    if not is_nan.any():
        return values
    first = next(iter(raised.values()), "it is NaN")
    if policy == Abort(on_nan=True):
        raise _failure_error(settings, points, raised or {int(np.flatnonzero(is_nan)[0]): first})
    if isinstance(policy, Replace):
        n_nan = int(is_nan.sum())
        tally.failures += n_nan
        text = f"{n_nan} of {is_nan.size} responses failed, replaced by {policy.value}"
        row = next(iter(raised), int(np.flatnonzero(is_nan)[0]))
        where = inputs_text(settings, points, row)
        text = f"{text}; the first, with inputs {where}: {first}"
        report(Finding("responses-replaced", f"{settings.name}: {text}"))
        tally.record_failures(points, dict.fromkeys(map(int, np.flatnonzero(is_nan)), "it is NaN"))
        values[is_nan] = policy.value
    return values


def inputs_text(settings: CallSettings, points: Points, row: int) -> str:
    """Return the inputs of a point as a text, with their names where these are known."""
    (inputs,) = points.at(np.array([row])).keys()
    return named_numbers(settings.columns, inputs)


def named_numbers(names: Sequence[str], numbers: Floats) -> str:
    """Return few numbers with their names as a text, and many without."""
    if len(names) != numbers.size or numbers.size > 12:
        return numbers_text(numbers, 6)
    pairs = zip(names, numbers, strict=True)
    return f"({', '.join(f'{name} = {value:.6g}' for name, value in pairs)})"


def _failure_error(settings: CallSettings, points: Points, raised: dict[int, str]) -> ResponseError:
    row, reason = next(iter(raised.items()))
    place = ""
    if isinstance(settings.function, scalar):  # in a batch it is not known which point failed
        place = f", the first with inputs {inputs_text(settings, points, row)}"
    store_text = ""
    if settings.store is not None:
        store_text = f"; {len(settings.store)} responses are kept in {settings.store.folder}"
    remedy = "pass on_failure=prb.response.Replace() or prb.response.Retry()"
    receiver = " to the propagation or surrogate"
    is_wrong = is_wrong_result(reason)
    if not settings.takes_policy or (is_wrong and isinstance(settings.on_failure.final, Replace)):
        remedy, receiver = "return NaN (no response) or inf (the specimen failed) there", ""
    advice = f"repair it, keep priors and inputs where it has a response, or {remedy}{receiver}"
    advice += array_advice(reason)
    if is_wrong:
        advice = f"repair it; if this is what a run that failed returns, {remedy}"
    return ResponseError(
        f"{settings.name}: the response failed at {counted(len(raised), 'point')}{place}: {reason}"
        f"{store_text}; {advice}"
    )


# -- sending chunks --------------------------------------------------------------------------------


def chunk_size(settings: CallSettings, tally: Tally, n_left: int, workers: int) -> int:
    """Return the number of points for the next chunk."""
    is_scalar = isinstance(settings.function, scalar)
    if tally.seconds == 0:
        # The cost is not known yet, and may be minutes for each point. A batch never has all
        # points, so that a function that takes only one number of specimens is found out.
        return 1 if is_scalar else min(16, max(1, n_left // 3))
    # If a response takes more than twice the time of sending a chunk, send one per chunk, so that
    # each is stored at once.
    if is_scalar and tally.seconds >= 0.01:
        return 1
    # Smaller chunks towards the end keep all workers busy. Before that a chunk takes 0.2 s. This is
    # long compared with the 4.5 ms that sending one takes (`python -m benchmarks.scale`), and short
    # enough that a lost worker costs little.
    share = n_left if settings.executor is None else max(1, n_left // (2 * workers))
    return int(max(1, min(share, 0.2 / tally.seconds)))


def chunks(
    settings: CallSettings, points: Points, rows: Indices, tolerant: bool, tally: Tally
) -> Iterator[list[Finished]]:
    """Compute the responses at some rows of the points, and yield chunks as they are finished.

    After a failure that is not tolerated, a lost worker, or a spent budget, no chunk begins; those
    that have begun are yielded before the error is raised.
    """
    # Other processes get the function as bytes, because pickle does not take lambdas.
    work = partial(compute, settings.function, outputs=settings.outputs)
    if settings.executor is not None and not isinstance(settings.executor, ThreadPoolExecutor):
        function = packed(settings.function)
        work = partial(compute, function, timeout=settings.timeout, outputs=settings.outputs)
    workers, most_chunks = capacity(settings.executor)
    pool = Pool(settings.name, settings.executor)
    # Chunks in progress when a worker was lost: they are repeated one at a time, so that the point
    # that ends its worker is found.
    suspects: list[Indices] = []
    suspect: Indices | None = None  # the suspected chunk in progress
    loss: BaseException | None = None
    begun: dict[Future[Chunk], Indices] = {}
    waiting = rows
    error: BaseException | None = None

    def begin(rows: Indices) -> None:
        begun[pool.submitted(work, points.at(rows), tolerant)] = rows

    with progress(f"responses of {settings.name}", rows.size) as report:
        while waiting.size or begun or suspects:
            if loss is not None and not begun:
                pool.renew(loss)
                loss = None
                if suspects:
                    pool.refuse_dead()
            if not begun:
                suspect = suspects.pop() if suspects else None
                if suspect is not None:
                    begin(suspect)
            while waiting.size and suspect is None and loss is None and len(begun) < most_chunks:
                size = chunk_size(settings, tally, waiting.size, workers)
                try:
                    size = budget().grant(size, least=1)
                except BudgetError as spent:
                    error = error or spent
                    waiting = waiting[:0]
                    break
                begin(waiting[:size])
                waiting = waiting[size:]
            finished = []
            for future in pool.done(begun):
                chunk_rows = begun.pop(future)
                failure = failure_of(future)
                if has_slipped(failure):
                    waiting = np.concatenate([chunk_rows, waiting])
                    continue
                if tolerant and is_loss(failure):
                    loss = failure
                    if chunk_rows is not suspect or chunk_rows.size > 1:
                        n_parts = 2 if chunk_rows is suspect else 1
                        suspects += reversed(np.array_split(chunk_rows, n_parts))
                        continue
                    reason = f"it ended its worker ({type(loss).__name__}), or took far too long"
                    chunk = Chunk(np.array([np.nan]), {0: reason}, 0.0)
                elif failure is not None:
                    error = error or failure
                    waiting = waiting[:0]
                    suspects = []
                    continue
                else:
                    chunk = future.result()
                if chunk.raised and not tolerant:
                    waiting = waiting[:0]
                tally.count(chunk_rows.size, chunk.seconds)
                report(chunk_rows.size, f"{workers / max(tally.seconds, 1e-9):.3g}/s")
                finished.append((chunk_rows, chunk))
            if finished:
                yield finished
    pool.renew(error or loss)  # so that the executor can compute the next response
    if error is not None:
        _raise_lost(settings.name, error)


def _raise_lost(name: str, error: BaseException) -> None:
    if isinstance(error, BudgetError):
        raise error
    if isinstance(error, ResponseError):
        raise ResponseError(f"{name}: {error}") from None
    cause = ""
    if is_loss(error):
        cause = "if a response ends its worker, on_failure= can treat it as a failed point; "
    raise ResponseError(
        f"{name}: {failure_text(error)}; {cause}run again: with store= finished responses are not "
        "computed again"
    ) from error
