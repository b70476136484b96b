"""Calling an expensive response at many points: in chunks, stored, with a failure policy.

`respond` is the whole of it. Points are looked up in the store; `chunks` sends out those that are
missing, a few chunks at a time, and gives back each as it is done; `compute` is what a worker does
with one.
"""

from __future__ import annotations

import faulthandler
import logging
import os
import signal as signals
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    Executor,
    Future,
    ThreadPoolExecutor,
    wait,
)
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from inspect import signature
from typing import Any, cast
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from prbayes._checks import Floats, called, positive_number
from prbayes._progress import progress
from prbayes.response.budget import BudgetError, budget
from prbayes.response.failures import Abort, Failure, OnFailure
from prbayes.response.store import Store, StoreError

_log = logging.getLogger("prbayes")

Rows = NDArray[np.intp]

# Relative difference of a response that another machine, or another version of a library, may make;
# any value from 1e-9 to 1e-3 tells another response from rounding, but for chaotic ones.
_ROUNDING = 1e-6


class ResponseError(RuntimeError):
    """The user's response raised, or returned something that is no response."""


class scalar:  # noqa: N801 (reads as a function in a model)
    """Turn a function of one specimen's inputs into a response; also for external programs.

    Parameters
    ----------
    function : callable
        ``function(*inputs) -> float``; a scalar input is a float, a multivariate one an array.

    Raises
    ------
    TypeError
        If ``function`` is not callable.

    Notes
    -----
    Called directly, not by a simulator, all inputs are taken as scalar.

    Examples
    --------
    >>> import numpy as np
    >>> response = scalar(lambda x: x**2 if x > 0 else 0.0)
    >>> response(np.array([[1.0, 2.0], [-3.0, 4.0]]))
    array([[ 1.,  4.],
           [ 0., 16.]])
    """

    def __init__(self, function: Callable[..., float]) -> None:
        if not callable(function):
            got = type(function).__name__
            raise TypeError(f"scalar: got {got}, expected a function of one specimen's inputs")
        self.function = function

    def __call__(self, *inputs: Any) -> Floats:
        """Call the function for each element of arrays that broadcast against each other."""
        arrays = np.broadcast_arrays(*(np.asarray(x, dtype=np.float64) for x in inputs))
        specimens = zip(*(a.ravel() for a in arrays), strict=True)
        values = [float(self.function(*specimen)) for specimen in specimens]
        return np.array(values).reshape(arrays[0].shape)


@dataclass(frozen=True)
class Points:
    """Points at which a response is wanted."""

    # Of the response: arrays (n, *event) where ``varying``, and else constants.
    arguments: Sequence[Any]
    varying: Sequence[bool]

    def __len__(self) -> int:
        return len(self.arguments[list(self.varying).index(True)])

    def at(self, rows: Rows | int) -> Points:
        """Return some of the points; with a number that one, without the leading axis."""
        pairs = zip(self.arguments, self.varying, strict=True)
        return Points([a[rows] if varies else a for a, varies in pairs], self.varying)

    def read(self, keys: Floats) -> Points:
        """Return the points of keys that were made with the same constants."""
        arguments, first = [], 0
        for a, varies in zip(self.arguments, self.varying, strict=True):
            event = np.shape(a)[1:] if varies else np.shape(a)
            last = first + int(np.prod(event, dtype=int))
            arguments.append(keys[:, first:last].reshape(len(keys), *event) if varies else a)
            first = last
        return Points(arguments, self.varying)

    def with_same_constants(self, keys: Floats) -> NDArray[np.bool_]:
        """Return which keys were made with the same constants, shape (n,)."""
        same = np.ones(len(keys), dtype=bool)
        first = 0
        for a, varies in zip(self.arguments, self.varying, strict=True):
            event = np.shape(a)[1:] if varies else np.shape(a)
            last = first + int(np.prod(event, dtype=int))
            if not varies:
                same &= (keys[:, first:last] == np.ravel(a)).all(axis=1)
            first = last
        return same

    def keys(self) -> Floats:
        """Return all numbers that a response depends on, constants included, shape (n, columns)."""
        n = len(self)
        columns = []
        for a, varies in zip(self.arguments, self.varying, strict=True):
            each = a if varies else np.broadcast_to(a, (n, *np.shape(a)))
            columns.append(each.reshape(n, int(np.prod(each.shape[1:], dtype=int))))
        return np.concatenate(columns, axis=1).astype(np.float64)


@dataclass(frozen=True)
class Chunk:
    """What a worker gives back for the points of a chunk."""

    # (m,): NaN where the response raised, or was not called since an earlier point raised.
    values: Floats
    raised: dict[int, str]  # what was raised, in words, by position
    seconds: float  # how long it took


@dataclass(frozen=True)
class Calling:
    """How a response is called."""

    name: str  # of the simulator, for messages
    function: Callable[..., Any]  # ``function(*arguments)``
    executor: Executor | None = None  # where; None is here
    store: Store | None = None  # where responses are kept
    on_failure: OnFailure = field(default_factory=Abort)
    retry_failed: bool = False  # whether points that are stored as failed are computed again
    timeout: float | None = None  # seconds that a response may take, where workers keep it

    @property
    def takes_failures(self) -> bool:
        """Whether points that are stored as failed stay what they are."""
        return self.on_failure.final.goes_on and not self.retry_failed


# Failures of which inputs and reasons are kept: more than anyone reads, and some 10 MB at most. All
# are counted.
_TOLD = 10_000


@dataclass
class Tally:
    """What calling a response has come to so far."""

    # Responses computed, those that were tried again included; not those found in a store.
    computed: int = 0
    failures: int = 0  # points whose response failed in the end and was replaced
    seconds: float = 0.0  # that one response takes, measured; 0 as long as nothing is known
    failed: dict[bytes, Failure] = field(default_factory=dict)  # by inputs, the first of them

    def take(self, size: int, seconds: float) -> None:
        """Take note of a chunk of so many responses."""
        self.computed += size
        each = seconds / size
        known = self.seconds != 0
        # A running mean, which only sizes the next chunks.
        self.seconds = 0.7 * self.seconds + 0.3 * each if known else each

    def note(self, points: Points, reasons: dict[int, str]) -> None:
        """Take note of points that failed, by their rows."""
        for row, reason in reasons.items():
            if len(self.failed) == _TOLD:
                break
            (inputs,) = points.at(np.array([row])).keys()
            self.failed.setdefault(inputs.tobytes(), Failure(inputs, reason))

    def copied(self) -> Tally:
        """Return a tally that counts on by itself."""
        return replace(self, failed=dict(self.failed))


def respond(calling: Calling, points: Points, tally: Tally) -> Floats:
    """Return the responses at points, shape (n,), from the store or computed and then stored.

    Raises
    ------
    ResponseError
        If a response fails and the policy says so, or if it is no response.
    StoreError
        If the store holds other values than the response gives.
    """
    policy = calling.on_failure
    _verify(calling, points, tally)
    keys = points.keys() if calling.store is not None else np.empty((len(points), 0))
    values, missing, failed = _stored(calling, keys)
    raised: dict[int, str] = {}
    for attempt in range(policy.tries):
        last = attempt == policy.tries - 1
        tolerant = policy.final.goes_on or not last
        raised = {}
        for rows, chunk in chunks(calling, points, missing, tolerant, tally):
            values[rows] = chunk.values
            raised.update({int(rows[i]): text for i, text in chunk.raised.items()})
            if calling.store is not None:
                # NaN is a result, too, after the last try, but not where a chunk broke off.
                whole = tolerant or not chunk.raised
                keep = ~np.isnan(chunk.values) | (last and whole)
                _keep(calling.store, keys[rows], chunk, keep)
        if raised and not tolerant:
            tally.note(points, raised)
            raise _failed(calling, raised)
        missing = missing[np.isnan(values[missing])]
        if not missing.size:
            break
    return _settled(calling, points, values, failed | raised, tally)


def _verify(calling: Calling, points: Points, tally: Tally) -> None:
    """Compute one stored response again, once for a store that says nothing of its version.

    What is stored may be of a function that has changed since, or whose variables have.
    """
    store = calling.store
    if store is None or store.verified:
        return
    keys, values = store.known()
    usable = np.flatnonzero(np.isfinite(values) & points.with_same_constants(keys))
    if usable.size:
        first = usable[:1]
        expected = float(values[first[0]])
        size = max(abs(expected), float(np.median(np.abs(values[usable]))))
        got, told = _again(calling, points.read(keys[first]), tally)
        if not abs(got - expected) <= _ROUNDING * size:
            at = ", ".join(f"{x:.6g}" for x in keys[first[0]])
            raise StoreError(
                f"{calling.name}: store: got a response that gives {told} at ({at}), expected "
                f"{expected:.10g}, which is stored in {store.path}: it is of another function, or "
                "its variables have changed; nothing was changed: pass another folder, or version= "
                "with a name for the response as it is now, whose runs are then kept apart"
            )
    store.verified = True


def _again(calling: Calling, point: Points, tally: Tally) -> tuple[float, str]:
    """Return the response at one point, and what came of it in words."""
    chunk = Chunk(np.array([np.nan]), {}, 0.0)
    for _ in range(calling.on_failure.tries):
        for _, chunk in chunks(calling, point, np.arange(1), True, tally):
            if not chunk.raised:
                value = float(chunk.values[0])
                return value, f"{value:.10g}"
    return np.nan, f"nothing ({next(iter(chunk.raised.values()), 'it was lost')})"


def _stored(calling: Calling, keys: Floats) -> tuple[Floats, Rows, dict[int, str]]:
    """Return responses that are stored, (n,), rows that are to be computed, and what failed.

    A point that is stored as failed is no result: it stays one that failed, where the policy goes
    on after failures, and else is computed again.
    """
    if calling.store is None:
        return np.full(len(keys), np.nan), np.arange(len(keys)), {}
    values, known = calling.store.find(keys)
    failed = calling.store.failed(keys)
    if not calling.takes_failures:
        known[list(failed)] = False
        failed = {}
    return values, np.flatnonzero(~known), failed


def _keep(store: Store, keys: Floats, chunk: Chunk, keep: NDArray[np.bool_]) -> None:
    """Store the responses of a chunk that are to be kept, with what was raised in place of some."""
    kept = np.flatnonzero(keep)
    if kept.size:
        reasons = {}
        for i, row in enumerate(kept):
            if int(row) in chunk.raised:
                reasons[i] = chunk.raised[int(row)]
        store.add(keys[kept], chunk.values[kept], reasons)


def _settled(
    calling: Calling, points: Points, values: Floats, raised: dict[int, str], tally: Tally
) -> Floats:
    """Return responses with what the policy puts in the place of those that are NaN."""
    tally.note(points, raised)
    bad = np.isnan(values)
    policy = calling.on_failure.final
    n_bad = int(bad.sum())
    if not n_bad:
        return values
    first = next(iter(raised.values()), "it is NaN")
    if policy.refuses_nan:
        raise _failed(calling, raised or {0: first})
    if policy.replacement is not None:
        tally.failures += n_bad
        text = f"{n_bad} of {bad.size} responses failed, replaced by {policy.replacement}"
        _log.warning("%s: %s; the first: %s", calling.name, text, first)
        tally.note(points, dict.fromkeys(map(int, np.flatnonzero(bad)), "it is NaN"))
        values[bad] = policy.replacement
    return values


def _failed(calling: Calling, raised: dict[int, str]) -> ResponseError:
    first = next(iter(raised.values()))
    kept = ""
    if calling.store is not None:
        kept = f"; {len(calling.store)} responses are kept in {calling.store.folder}"
    return ResponseError(
        f"{calling.name}: the response failed at {len(raised)} point(s): {first}{kept}; "
        "repair it, or pass on_failure=prb.response.Replace() or prb.response.Retry() "
        "to the propagation or surrogate"
    )


# -- sending out -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Capacity:
    """How many workers an executor has, and how many chunks it is sent at a time."""

    workers: int
    chunks: int


def capacity(executor: Executor | None) -> Capacity:
    """Return how much an executor takes.

    The interface does not tell: processes, threads and loky keep ``_max_workers``, MPI
    ``num_workers``, and Dask's client knows. Of others many chunks are sent out, lest workers wait.
    """
    if executor is None:
        return Capacity(1, 1)
    workers = getattr(executor, "_max_workers", 0) or getattr(executor, "num_workers", 0)
    workers = workers or _threads(executor) or 0
    if not workers:
        # As many as workers that are known of in practice; what one costs in memory is measured by
        # `python -m benchmarks.scale`.
        return Capacity(os.cpu_count() or 1, 1024)
    # While a worker computes a chunk, the next one is there already.
    return Capacity(int(workers), 2 * int(workers))


def _threads(executor: Executor | None) -> int | None:
    """Return how many threads the workers of Dask have; None for others."""
    threads = getattr(getattr(executor, "_client", None), "nthreads", None)
    return sum(threads().values()) if callable(threads) else None


def chunk_size(calling: Calling, tally: Tally, left: int, workers: int) -> int:
    """Return how many of the points that are left go into the next chunk."""
    alone = isinstance(calling.function, scalar)
    if tally.seconds == 0:
        # The cost is not known yet: that of a call is spread over a few, and a response of minutes
        # is not called for long.
        return 1 if alone else min(left, 16)
    # Twice what sending a chunk costs: none waits for others to be stored.
    if alone and tally.seconds >= 0.01:
        return 1
    # Towards the end chunks get smaller, so that all workers have some. Others take 0.2 s: long
    # against the 4.5 ms that sending one costs (`python -m benchmarks.scale`), short against what
    # is lost with a worker.
    share = left if calling.executor is None else max(1, left // (2 * workers))
    return int(max(1, min(share, 0.2 / tally.seconds)))


def chunks(
    calling: Calling, points: Points, rows: Rows, tolerant: bool, tally: Tally
) -> Iterator[tuple[Rows, Chunk]]:
    """Compute the responses at some rows of the points, and yield chunks of them as they are done.

    After a failure that is not tolerated, and where a budget is spent, nothing more is begun, and
    what was begun is waited for and yielded.

    Raises
    ------
    ResponseError
        After everything else, if a worker was lost, or a result is no response.
    BudgetError
        After everything else, if a budget was spent.
    """
    work, room = _work(calling), capacity(calling.executor)
    pool = _Pool(calling.name, calling.executor)
    suspects: list[Rows] = []  # what was at work when a worker was lost
    begun: dict[Future[Chunk], Rows] = {}
    left = rows
    error: BaseException | None = None
    with progress(f"responses of {calling.name}", rows.size) as report:
        while left.size or begun or suspects:
            if suspects and not begun:
                # Which of them ended its worker shows when each is alone.
                for some, chunk in _alone(pool, work, points, suspects):
                    tally.take(some.size, chunk.seconds)
                    report(some.size, "")
                    yield some, chunk
                suspects = []
            # Send out as many chunks as the executor takes.
            while left.size and not suspects and len(begun) < room.chunks:
                size = chunk_size(calling, tally, left.size, room.workers)
                try:
                    size = budget().grant(size, least=1)
                except BudgetError as spent:
                    error = error or spent
                    left = left[:0]
                    break
                some, left = left[:size], left[size:]
                begun[pool.submitted(work, points.at(some), tolerant)] = some
            # Take what is done.
            for future in pool.done(begun):
                some = begun.pop(future)
                failure = future.exception()
                if tolerant and _is_loss(failure):
                    suspects.append(some)
                    continue
                if failure is not None:
                    error = error or failure
                    left = left[:0]
                    continue
                chunk = future.result()
                if chunk.raised and not tolerant:
                    left = left[:0]
                tally.take(some.size, chunk.seconds)
                report(some.size, f"{room.workers / max(tally.seconds, 1e-9):.3g}/s")
                yield some, chunk
    if error is not None:
        _raise_lost(calling.name, error)


# Seconds without a result after which the log says so. By judgement: longer than most responses
# take, and shorter than one waits for nothing.
_SILENCE = 60.0

# Executors in the place of those whose workers were lost, as long as those are there.
_renewed: WeakKeyDictionary[Executor, Executor] = WeakKeyDictionary()


@dataclass
class _Pool:
    """An executor, or a new one like it where its workers were lost."""

    name: str  # of the simulator, for messages
    given: Executor | None

    @property
    def executor(self) -> Executor | None:
        """The executor at work."""
        return None if self.given is None else _renewed.get(self.given, self.given)

    def renew(self, failure: BaseException | None) -> None:
        """Take a new executor if this one is broken; those of others start workers themselves."""
        if self.given is None or not isinstance(failure, BrokenExecutor):
            return
        _renewed[self.given] = _alike(self.given)

    def submitted(
        self, work: Callable[[Points, bool], Chunk], points: Points, tolerant: bool
    ) -> Future[Chunk]:
        """Return the work as a future: done already without an executor, failed if broken."""
        return _submitted(self.executor, work, points, tolerant)

    def done(self, begun: Iterable[Future[Chunk]]) -> set[Future[Chunk]]:
        """Return futures that are done; waits for one, and says so after a minute.

        Raises
        ------
        ResponseError
            If no worker is left, so that none will ever be done.
        """
        waiting = list(begun)
        silent = 0.0
        while True:
            found = wait(waiting, timeout=_SILENCE, return_when=FIRST_COMPLETED).done
            if found or not waiting:
                return found
            silent += _SILENCE
            _log.warning(
                "%s: no response for %.0f s; %d chunks are at work", self.name, silent, len(waiting)
            )
            if _threads(self.executor) == 0:
                for future in waiting:
                    future.cancel()
                raise ResponseError(
                    f"{self.name}: got no response for {silent:.0f} s, and no worker is left, "
                    "expected workers; start some and run again: with store= nothing that was "
                    "computed is computed again"
                )


def _alike(executor: Executor) -> Executor:
    """Return a new executor of processes like one whose workers were lost.

    The interface does not tell how one was made: those of the standard library and of loky keep it
    under the same names.
    """
    kind = next((c for c in type(executor).__mro__ if c.__name__ == "ProcessPoolExecutor"), None)
    if kind is None:
        return executor
    known = signature(kind).parameters
    made: dict[str, Any] = {"max_workers": getattr(executor, "_max_workers", None)}
    for name, kept in (
        ("mp_context", "_mp_context"),
        ("context", "_context"),
        ("initializer", "_initializer"),
        ("initargs", "_initargs"),
    ):
        if name in known and getattr(executor, kept, None) is not None:
            made[name] = getattr(executor, kept)
    return cast(Executor, kind(**made))


def _is_loss(failure: BaseException | None) -> bool:
    """Return whether a chunk failed since its worker was lost; Dask names that by a class."""
    names = {kind.__name__ for kind in type(failure).__mro__}
    return isinstance(failure, BrokenExecutor) or "KilledWorker" in names


def _alone(
    pool: _Pool, work: Callable[[Points, bool], Chunk], points: Points, suspects: list[Rows]
) -> Iterator[tuple[Rows, Chunk]]:
    """Compute chunks one at a time, halved where the worker is lost, and yield them.

    A point that is alone with its worker when that is lost has failed.
    """
    left = list(reversed(suspects))
    failure: BaseException | None = BrokenExecutor()
    while left:
        pool.renew(failure)
        some = left.pop()
        future = pool.submitted(work, points.at(some), True)
        pool.done([future])
        failure = future.exception()
        if failure is None:
            yield some, future.result()
        elif not _is_loss(failure):
            _raise_lost(pool.name, failure)
        elif some.size == 1:
            text = f"it ended its worker ({type(failure).__name__}), or took far too long"
            yield some, Chunk(np.array([np.nan]), {0: text}, 0.0)
        else:
            left += [some[some.size // 2 :], some[: some.size // 2]]
    pool.renew(failure)


def _raise_lost(name: str, error: BaseException) -> None:
    if isinstance(error, BudgetError):
        raise error
    if isinstance(error, ResponseError):
        raise ResponseError(f"{name}: {error}") from None
    raise ResponseError(
        f"{name}: a worker was lost ({type(error).__name__}: {error}); run again: with store= "
        "nothing that was computed is computed again"
    ) from error


def _work(calling: Calling) -> Callable[[Points, bool], Chunk]:
    """Return what is done with points; to other processes the function travels packed."""
    if calling.executor is None or isinstance(calling.executor, ThreadPoolExecutor):
        return partial(compute, calling.function)
    return partial(compute_packed, packed(calling.function), timeout=calling.timeout)


def _submitted(
    executor: Executor | None, work: Callable[[Points, bool], Chunk], points: Points, tolerant: bool
) -> Future[Chunk]:
    """Return the work as a future: done already without an executor, failed if that is broken."""
    future: Future[Chunk] = Future()
    try:
        if executor is not None:
            return executor.submit(work, points, tolerant)
        future.set_result(work(points, tolerant))
    except Exception as error:
        future.set_exception(error)
    return future


def refuse_timeout(timeout: object, executor: Executor | None) -> None:
    """Raise if it is no time, or one that the executor's workers cannot keep."""
    if timeout is None:
        return
    positive_number(timeout, "timeout")
    processes = any(kind.__name__ == "ProcessPoolExecutor" for kind in type(executor).__mro__)
    if not processes or not hasattr(signals, "setitimer"):
        raise ValueError(
            f"timeout: got {timeout} with executor {called(executor)}, expected an executor of "
            "processes, such as concurrent.futures.ProcessPoolExecutor(4), on a system with "
            "signals: nothing else ends a response that hangs"
        )


# -- at work ---------------------------------------------------------------------------------------


def compute(
    function: Callable[..., Any], points: Points, tolerant: bool, timeout: float | None = None
) -> Chunk:
    """Return the responses at points; unless failures are tolerated, those up to the first one."""
    clock = time.perf_counter()
    if isinstance(function, scalar):
        values, raised = _one_by_one(function, points, tolerant, timeout)
    else:
        values, raised = _at_once(function, points, tolerant, timeout)
    return Chunk(values, raised, time.perf_counter() - clock)


@contextmanager
def _limited(seconds: float | None) -> Iterator[None]:
    """Raise `TimeoutError` inside after some seconds; end this worker if that does not help.

    A signal reaches Python code. What hangs in other code, never to come back, ends with its
    worker.
    """
    if seconds is None:
        yield
        return

    def late(*_: object) -> None:
        raise TimeoutError(f"no result within timeout = {seconds:g} s")

    before = signals.signal(signals.SIGALRM, late)
    with open(os.devnull, "w") as nowhere:
        # Half as long again, and a second, so that the signal comes first.
        faulthandler.dump_traceback_later(1.5 * seconds + 1, exit=True, file=nowhere)
        signals.setitimer(signals.ITIMER_REAL, seconds)
        try:
            yield
        finally:
            signals.setitimer(signals.ITIMER_REAL, 0)
            faulthandler.cancel_dump_traceback_later()
            signals.signal(signals.SIGALRM, before)


def _one_by_one(
    function: scalar, points: Points, tolerant: bool, timeout: float | None
) -> tuple[Floats, dict[int, str]]:
    values, raised = np.full(len(points), np.nan), {}
    for i in range(len(points)):
        try:
            with np.errstate(all="ignore"), _limited(timeout):
                values[i] = float(function.function(*points.at(i).arguments))
        except (Exception, SystemExit) as error:
            raised[i] = _said(error)
            if not tolerant:
                break
    return values, raised


def _at_once(
    function: Callable[..., Any], points: Points, tolerant: bool, timeout: float | None
) -> tuple[Floats, dict[int, str]]:
    size = len(points)
    try:
        with np.errstate(all="ignore"), _limited(timeout and timeout * size):
            result = function(*points.arguments)
    except (Exception, SystemExit) as error:
        if not tolerant or size == 1:
            return np.full(size, np.nan), {0: _said(error)}
    else:
        return checked(result, (size,), points.arguments), {}
    # Halve until the points that fail are alone.
    values, raised = np.full(size, np.nan), {}
    for half in (np.arange(size // 2), np.arange(size // 2, size)):
        values[half], said = _at_once(function, points.at(half), tolerant, timeout)
        raised.update({int(half[i]): text for i, text in said.items()})
    return values, raised


def _said(error: BaseException) -> str:
    return f"it raised {type(error).__name__}: {error}"


def checked(result: Any, batch: tuple[int, ...], arguments: Sequence[Any]) -> Floats:
    """Return a response's result as floats; it has to be real numbers in the batch shape."""
    array = np.asarray(result)
    if array.dtype.kind not in "fiub":
        got = f"{type(result).__name__} of dtype {array.dtype}"
        if array.dtype.kind == "c":
            got = "complex numbers"
        raise ResponseError(f"the response returned {got}, expected an array of real numbers")
    if array.shape != batch:
        raise ResponseError(
            f"the response returned shape {array.shape} for inputs of shapes {shapes(arguments)}, "
            f"expected {batch}: one response per specimen; reduce over the event axis only (the "
            "last one), or wrap a function of one specimen in prb.scalar"
        )
    return array.astype(np.float64)


def shapes(arguments: Sequence[Any]) -> str:
    """Return the shapes of a response's arguments, for messages."""
    return ", ".join(str(np.shape(a)) for a in arguments)


def packed(function: Callable[..., Any]) -> bytes:
    """Return a function as it travels to another process."""
    import cloudpickle

    return bytes(cloudpickle.dumps(function))


@lru_cache(maxsize=8)  # responses at work at the same time, such as those of several simulators
def _unpacked(payload: bytes) -> Callable[..., Any]:
    import cloudpickle

    return cloudpickle.loads(payload)  # type: ignore[no-any-return]


def compute_packed(
    payload: bytes, points: Points, tolerant: bool, timeout: float | None = None
) -> Chunk:
    """Unpack the function, once for all chunks of a worker, and compute."""
    return compute(_unpacked(payload), points, tolerant, timeout)
