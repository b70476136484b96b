"""Calling an expensive response at many points: in chunks, stored, with a failure policy.

`respond` is the whole of it. Points are looked up in the store; `chunks` sends out those that are
missing, a few chunks at a time, and gives back each as it is done; `compute` is what a worker does
with one.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prbayes._finding import Finding, report
from prbayes._progress import progress
from prbayes._validate import Floats
from prbayes.response.budget import BudgetError, budget
from prbayes.response.executors import Pool, capacity, failure_of, has_slipped, is_loss, told
from prbayes.response.failures import Abort, Failure, OnFailure, ResponseError
from prbayes.response.outputs import ONE, Outputs, lacking, outputs_of_result
from prbayes.response.store import Store, StoreError
from prbayes.response.time_limit import limited

Rows = NDArray[np.intp]

# Relative difference of a response that another machine, or another version of a library, may make;
# any value from 1e-9 to 1e-3 tells another response from rounding, but for chaotic ones.
_ROUNDING = 1e-6


_BY_HAND = (
    "prb.scalar: called by hand, every input is a number; where one is multivariate, call "
    "response.function(...) with the inputs of one specimen"
)


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

        Outputs by name where the function returns a mapping.
        """
        arrays = np.broadcast_arrays(*(np.asarray(x, dtype=np.float64) for x in inputs))
        columns = [array.ravel() for array in arrays]
        specimens = zip(*columns, strict=True)
        outputs: Outputs | None = None
        values = []
        for specimen in specimens:
            try:
                result = self.function(*specimen)
            except (IndexError, TypeError) as error:
                error.add_note(_BY_HAND)
                raise
            outputs = _told_by(result, 0, outputs)
            values.append(_of_one(result, outputs if isinstance(result, Mapping) else None))
        event = np.shape(values[0]) if values else ()
        found = np.array(values).reshape(arrays[0].shape + event)
        # What has names keeps them: in a function around this one places would be other outputs'.
        return found if outputs is None else outputs.by_key(found)


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

    def handed_out(self) -> list[Any]:
        """Return the arguments for a response, which may change its own in place."""
        return [a.copy() if isinstance(a, np.ndarray) else a for a in self.arguments]

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

    # (m, *event): NaN where the response raised, or was not called since an earlier point raised.
    values: Floats
    raised: dict[int, str]  # what was raised, in words, by position
    seconds: float  # how long it took
    named: Outputs | None = None  # what a mapping calls the columns, where nobody knew


# A chunk that is done, with the rows of its points.
type Done = tuple[Rows, Chunk]


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
    outputs: Outputs | None = ONE  # what a run gives; None where the first one tells

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
    good: bool = False  # whether any run gave a response
    named: Outputs | None = None  # what mappings call the columns, where nobody knew
    failed: dict[bytes, Failure] = field(default_factory=dict)  # by inputs, the first of them

    def aligned(self, chunk: Chunk) -> Floats:
        """Return the responses of a chunk, with columns in the order of the first one's names.

        Raises
        ------
        ResponseError
            If mappings have other keys than the first one had.
        """
        if chunk.named is None:
            return chunk.values
        if self.named is None:
            self.named = chunk.named
        if set(self.named.labels) != set(chunk.named.labels):
            raise ResponseError(
                f"the response returned a mapping with {list(chunk.named.names)}, expected "
                f"{list(self.named.names)}, as for the first specimen"
            )
        order = [chunk.named.labels.index(label) for label in self.named.labels]
        return chunk.values[..., order]

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


def respond(
    calling: Calling,
    points: Points,
    tally: Tally,
    on_start: Callable[[int, float], None] | None = None,
) -> Floats:
    """Return responses at points, shape (n, *event), from the store or computed and then stored.

    With ``on_start`` that is called, after the first chunk, with the number of missing runs, and
    the seconds that one of them takes.

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
        for done in chunks(calling, points, missing, tolerant, tally):
            if on_start is not None:
                on_start(missing.size, tally.seconds)
                on_start = None
            for rows, chunk in done:
                values = _filled_in(values, rows, tally.aligned(chunk))
                raised.update({int(rows[i]): text for i, text in chunk.raised.items()})
                tally.good = tally.good or len(chunk.raised) < len(rows)
            if not tally.good and raised and all(map(_is_misfit, raised.values())):
                # Not one run has given a response so far: no failure, but another function.
                raise _failed(calling, points, raised)
            if calling.store is not None:
                # NaN is a result, too, after the last try, but not where a chunk broke off.
                _keep(calling.store, keys, done, last=last, tolerant=tolerant)
        if raised and not tolerant:
            tally.note(points, raised)
            raise _failed(calling, points, raised)
        missing = missing[lacking(values[missing])]
        if not missing.size:
            break
    return _settled(calling, points, values, failed | raised, tally)


def _filled_in(values: Floats, rows: Rows, some: Floats) -> Floats:
    """Return responses with those of some rows; the first tell how many outputs a run has."""
    if values.ndim == 1 and some.ndim > 1:
        values = np.repeat(values[:, None], some.shape[1], axis=1)
    values[rows] = some
    return values


def _verify(calling: Calling, points: Points, tally: Tally) -> None:
    """Compute one stored response again, once for a store that says nothing of its version.

    What is stored may be of a function that has changed since, or whose variables have.
    """
    store = calling.store
    if store is None or store.verified:
        return
    keys, values = store.known()
    columns = values if values.ndim > 1 else values[:, None]
    finite = np.isfinite(columns).all(axis=1)
    usable = np.flatnonzero(finite & points.with_same_constants(keys))
    if usable.size:
        first = usable[:1]
        expected = columns[first[0]]
        size = np.maximum(np.abs(expected), np.median(np.abs(columns[usable]), axis=0))
        got, told = _again(calling, points.read(keys[first]), tally)
        same_number = got.size == expected.size
        if not same_number or not (np.abs(got - expected) <= _ROUNDING * size).all():
            at = ", ".join(f"{x:.6g}" for x in keys[first[0]])
            raise StoreError(
                f"{calling.name}: store: got a response that gives {told} at ({at}), expected "
                f"{_numbers_told(expected)}, which is stored in {store.path}: it is of another "
                "function, or its variables have changed; nothing was changed: pass another "
                "folder, or version= with a name for the response as it is now, whose runs are "
                "then kept apart"
            )
    store.verified = True


def _again(calling: Calling, point: Points, tally: Tally) -> tuple[Floats, str]:
    """Return the response at one point, and what came of it in words."""
    chunk = Chunk(np.array([np.nan]), {}, 0.0)
    for _ in range(calling.on_failure.tries):
        for ((_, chunk),) in chunks(calling, point, np.arange(1), True, tally):
            if not chunk.raised:
                found = tally.aligned(chunk).ravel()
                return found, _numbers_told(found)
    return np.array([np.nan]), f"nothing ({next(iter(chunk.raised.values()), 'it was lost')})"


def _numbers_told(values: Floats, digits: int = 10) -> str:
    """Return outputs of a run, or its inputs, in words, shape (m,)."""
    text = ", ".join(f"{value:.{digits}g}" for value in values[:6])  # what fits a line
    if values.size == 1:
        return text
    return f"({text}, ...)" if values.size > 6 else f"({text})"


def _stored(calling: Calling, keys: Floats) -> tuple[Floats, Rows, dict[int, str]]:
    """Return responses that are stored, rows that are to be computed, and what failed.

    A point that is stored as failed is no result: it stays one that failed, where the policy goes
    on after failures, and else is computed again.
    """
    if calling.store is None:
        event = () if calling.outputs is None else calling.outputs.event
        return np.full((len(keys), *event), np.nan), np.arange(len(keys)), {}
    values, known = calling.store.find(keys)
    if calling.outputs is not None:
        values = values.reshape(len(keys), *calling.outputs.event)
    failed = calling.store.failed(keys)
    if not calling.takes_failures:
        known[list(failed)] = False
        failed = {}
    return values, np.flatnonzero(~known), failed


def _keep(store: Store, keys: Floats, done: Sequence[Done], *, last: bool, tolerant: bool) -> None:
    """Store the responses of chunks that are to be kept, with what was raised in place of some.

    In one transaction, since each waits for the disk.
    """
    parts = []
    for rows, chunk in done:
        whole = tolerant or not chunk.raised
        kept = np.flatnonzero(~lacking(chunk.values) | (last and whole))
        if kept.size:
            reasons = {}
            for i, row in enumerate(kept):
                if int(row) in chunk.raised:
                    reasons[i] = chunk.raised[int(row)]
            parts.append((keys[rows[kept]], chunk.values[kept], reasons))
    if parts:
        store.add_all(parts)


def _settled(
    calling: Calling, points: Points, values: Floats, raised: dict[int, str], tally: Tally
) -> Floats:
    """Return responses with what the policy puts in the place of those that are NaN."""
    tally.note(points, raised)
    bad = lacking(values)
    policy = calling.on_failure.final
    n_bad = int(bad.sum())
    if not n_bad:
        return values
    first = next(iter(raised.values()), "it is NaN")
    if policy.refuses_nan:
        raise _failed(calling, points, raised or {int(np.flatnonzero(bad)[0]): first})
    if policy.replacement is not None:
        tally.failures += n_bad
        text = f"{n_bad} of {bad.size} responses failed, replaced by {policy.replacement}"
        report(Finding("responses-replaced", f"{calling.name}: {text}; the first: {first}"))
        tally.note(points, dict.fromkeys(map(int, np.flatnonzero(bad)), "it is NaN"))
        values[bad] = policy.replacement
    return values


def _failed(calling: Calling, points: Points, raised: dict[int, str]) -> ResponseError:
    row, first = next(iter(raised.items()))
    place = ""
    if isinstance(calling.function, scalar):  # of a batch nobody knows which it was
        (inputs,) = points.at(np.array([row])).keys()
        place = f", the first with inputs {_numbers_told(inputs, 6)}"
    kept = ""
    if calling.store is not None:
        kept = f"; {len(calling.store)} responses are kept in {calling.store.folder}"
    policies = "on_failure=prb.response.Replace() or prb.response.Retry()"
    advice = (
        "repair it, keep priors and inputs where it has a response, or pass "
        f"{policies} to the propagation or surrogate"
    )
    if _is_misfit(first):
        advice = f"repair it; if this is what a run that failed returns, pass {policies}"
    return ResponseError(
        f"{calling.name}: the response failed at {len(raised)} point(s){place}: {first}{kept}; "
        f"{advice}"
    )


# How the reason begins where a function of one specimen returned what is no response.
_IT = "it "
_RETURNED = f"{_IT}returned "


def _is_misfit(reason: str) -> bool:
    """Return whether a function of one specimen returned what is no response."""
    return reason.startswith(_RETURNED)


# -- sending out -----------------------------------------------------------------------------------


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
) -> Iterator[list[Done]]:
    """Compute the responses at some rows of the points, and yield chunks of them as they are done.

    Those that are done at the same time come together.

    After a failure that is not tolerated, and where a budget is spent, nothing more is begun, and
    what was begun is waited for and yielded.

    Raises
    ------
    ResponseError
        After everything else, if a worker was lost, or a result is no response.
    BudgetError
        After everything else, if a budget was spent.
    """
    work = _work(calling)
    room = capacity(calling.executor)
    pool = Pool(calling.name, calling.executor)
    suspects: list[Rows] = []  # what was at work when a worker was lost
    loss: BaseException | None = None
    begun: dict[Future[Chunk], Rows] = {}
    left = rows
    error: BaseException | None = None
    with progress(f"responses of {calling.name}", rows.size) as report:
        while left.size or begun or suspects:
            if suspects and not begun:
                # Which of them ended its worker shows when each is alone.
                for some, chunk in _alone(pool, work, points, suspects, loss):
                    tally.take(some.size, chunk.seconds)
                    report(some.size, "")
                    yield [(some, chunk)]
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
                some = left[:size]
                left = left[size:]
                begun[pool.submitted(work, points.at(some), tolerant)] = some
            # Take what is done.
            done = []
            for future in pool.done(begun):
                some = begun.pop(future)
                failure = failure_of(future)
                if has_slipped(failure):
                    left = np.concatenate([some, left])
                    continue
                if tolerant and is_loss(failure):
                    suspects.append(some)
                    loss = failure
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
                done.append((some, chunk))
            if done:
                yield done
    if error is not None:
        # One that is broken is of no use to what runs next, either.
        pool.renew(error)
        _raise_lost(calling.name, error)


def _alone(
    pool: Pool,
    work: Callable[[Points, bool], Chunk],
    points: Points,
    suspects: list[Rows],
    loss: BaseException | None,
) -> Iterator[Done]:
    """Compute chunks one at a time, halved where the worker is lost, and yield them.

    A point that is alone with its worker when that is lost has failed.
    """
    pool.renew(loss)
    pool.refuse_dead()
    left = list(reversed(suspects))
    while left:
        some = left.pop()
        future = pool.submitted(work, points.at(some), True)
        pool.done([future])
        failure = failure_of(future)
        pool.renew(failure)
        if failure is None:
            yield some, future.result()
        elif has_slipped(failure):
            left.append(some)
        elif not is_loss(failure):
            _raise_lost(pool.name, failure)
        elif some.size == 1:
            text = f"it ended its worker ({type(failure).__name__}), or took far too long"
            yield some, Chunk(np.array([np.nan]), {0: text}, 0.0)
        else:
            left += [some[some.size // 2 :], some[: some.size // 2]]


def _raise_lost(name: str, error: BaseException) -> None:
    if isinstance(error, BudgetError):
        raise error
    if isinstance(error, ResponseError):
        raise ResponseError(f"{name}: {error}") from None
    blame = ""
    if is_loss(error):
        blame = "if a response ends its worker, on_failure= may let that cost its point only; "
    raise ResponseError(
        f"{name}: {told(error)}; {blame}run again: with store= nothing that was computed is "
        "computed again"
    ) from error


def _work(calling: Calling) -> Callable[[Points, bool], Chunk]:
    """Return what is done with points; to other processes the function travels packed."""
    outputs = calling.outputs
    if calling.executor is None or isinstance(calling.executor, ThreadPoolExecutor):
        return partial(compute, calling.function, outputs=outputs)
    payload = packed(calling.function)
    return partial(compute_packed, payload, timeout=calling.timeout, outputs=outputs)


# -- at work ---------------------------------------------------------------------------------------


def compute(
    function: Callable[..., Any],
    points: Points,
    tolerant: bool,
    timeout: float | None = None,
    outputs: Outputs | None = ONE,
) -> Chunk:
    """Return the responses at points; unless failures are tolerated, those up to the first one."""
    clock = time.perf_counter()
    if isinstance(function, scalar):
        values, raised, known = _one_by_one(function, points, tolerant, timeout, outputs)
    else:
        values, raised, known = _at_once(function, points, tolerant, timeout, outputs)
    named = known if outputs is None else None
    return Chunk(values, raised, time.perf_counter() - clock, named)


type _Computed = tuple[Floats, dict[int, str], Outputs | None]


def _one_by_one(
    function: scalar,
    points: Points,
    tolerant: bool,
    timeout: float | None,
    outputs: Outputs | None,
) -> _Computed:
    event = () if outputs is None else outputs.event
    values = np.full((len(points), *event), np.nan)
    raised = {}
    for i in range(len(points)):
        try:
            with np.errstate(all="ignore"), limited(timeout):
                result = function.function(*points.at(i).handed_out())
            outputs = _told_by(result, 0, outputs)
            values = _filled_in(values, np.array([i]), _of_one(result, outputs)[None])
        except (Exception, SystemExit) as error:
            raised[i] = _said(error)
            if not tolerant:
                break
    return values, raised, outputs


class _NoResponseError(ResponseError):
    """A function of one specimen returned something that is no response."""


def _told_by(result: Any, batch_ndim: int, outputs: Outputs | None) -> Outputs | None:
    """Return the outputs, which a mapping tells where nobody knew them."""
    if outputs is None and isinstance(result, Mapping):
        return outputs_of_result(result, batch_ndim)
    return outputs


def _of_one(result: Any, outputs: Outputs | None) -> Floats:
    """Return what a function of one specimen returned, shape (*event)."""
    one = np.ndim(result) == 0 if outputs is None else not outputs.event
    if one and not isinstance(result, Mapping):
        return np.asarray(float(result))
    try:
        return checked(result, (), (), outputs)
    except ResponseError as error:
        text = str(error).removeprefix("the response ")
        raise _NoResponseError(f"{_IT}{text}") from None


def _at_once(
    function: Callable[..., Any],
    points: Points,
    tolerant: bool,
    timeout: float | None,
    outputs: Outputs | None,
) -> _Computed:
    size = len(points)
    try:
        with np.errstate(all="ignore"), limited(timeout and timeout * size):
            result = function(*points.handed_out())
    except (Exception, SystemExit) as error:
        if not tolerant or size == 1:
            event = () if outputs is None else outputs.event
            failed = np.full((size, *event), np.nan)
            return failed, {0: _said(error)}, outputs
    else:
        outputs = _told_by(result, 1, outputs)
        values = checked(result, (size,), points.arguments, outputs)
        return values, {}, outputs
    # Halve until the points that fail are alone.
    values = np.full(size, np.nan)
    raised = {}
    for half in (np.arange(size // 2), np.arange(size // 2, size)):
        some, said, outputs = _at_once(function, points.at(half), tolerant, timeout, outputs)
        values = _filled_in(values, half, some)
        raised.update({int(half[i]): text for i, text in said.items()})
    return values, raised, outputs


def _said(error: BaseException) -> str:
    """Return what was raised in words that may be printed and stored, whatever it says of itself.

    A few lines are enough: what a program printed may be long.
    """
    if isinstance(error, _NoResponseError):
        return str(error)
    try:
        text = str(error)
    except Exception as other:
        text = f"(its text raises {type(other).__name__})"
    text = text.encode("utf-8", "backslashreplace").decode().replace("\0", "\\0")
    return f"it raised {type(error).__name__}: {text:.1000}"


def checked(
    result: Any,
    batch: tuple[int, ...],
    arguments: Sequence[Any],
    outputs: Outputs | None = ONE,
) -> Floats:
    """Return a response's result as floats, shape (*batch, *event); it has to be real numbers.

    A point at which one output is NaN has no response: all of them are.
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
            f"({_said(error)}), expected an array of real numbers"
        ) from None
    if array.dtype.kind not in "fiub":
        got = f"{type(result).__name__} of dtype {array.dtype}"
        if array.dtype.kind == "c":
            got = "complex numbers"
        raise ResponseError(f"the response returned {got}, expected an array of real numbers")
    event = array.shape[len(batch) :]
    wanted = event[:1] if outputs is None else outputs.event
    if array.shape != batch + wanted:
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
        raise ResponseError(
            f"the response returned shape {array.shape}{_for_inputs(arguments)}, "
            f"expected {batch + wanted}: {_each(wanted)}; {remedy}"
        )
    values = array.astype(np.float64)
    if wanted:
        values[np.isnan(values).any(axis=-1)] = np.nan
    return values


def _each(event: tuple[int, ...]) -> str:
    return f"{event[0]} outputs per specimen" if event else "one response per specimen"


def _for_inputs(arguments: Sequence[Any]) -> str:
    """Return for which inputs, as a clause; of one specimen there is nothing to say."""
    return f" for inputs of shapes {shapes(arguments)}" if arguments else ""


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
    payload: bytes,
    points: Points,
    tolerant: bool,
    timeout: float | None = None,
    outputs: Outputs | None = ONE,
) -> Chunk:
    """Unpack the function, once for all chunks of a worker, and compute."""
    return compute(_unpacked(payload), points, tolerant, timeout, outputs)
