"""Responses at many points: in chunks on an executor, stored, with a failure policy.

`respond` looks points up in the store, computes missing ones by `chunks`, and stores each chunk
before it waits for the next.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from prbayes._finding import Finding, report
from prbayes._progress import progress
from prbayes._validate import Floats
from prbayes.response.budget import BudgetError, budget
from prbayes.response.call import (
    Chunk,
    Points,
    Rows,
    assign_rows,
    compute,
    compute_packed,
    is_wrong_result,
    packed,
    scalar,
)
from prbayes.response.executors import (
    Pool,
    capacity,
    failure_of,
    failure_text,
    has_slipped,
    is_loss,
)
from prbayes.response.failures import Abort, Failure, OnFailure, ResponseError
from prbayes.response.outputs import SINGLE_OUTPUT, Outputs, is_missing
from prbayes.response.store import Store, StoreError

# A finished chunk, with the rows of its points.
type Finished = tuple[Rows, Chunk]


@dataclass(frozen=True)
class CallSettings:
    """How a response is called."""

    name: str  # of the simulator, for messages
    function: Callable[..., Any]
    executor: Executor | None = None  # None computes in this process
    store: Store | None = None
    on_failure: OnFailure = field(default_factory=Abort)
    retry_failed: bool = False  # whether points that are stored as failed are computed again
    timeout: float | None = None  # seconds for one response
    outputs: Outputs | None = SINGLE_OUTPUT  # None takes them from the first run


@dataclass
class Tally:
    """Counts, time and failures of the calls of a response."""

    computed: int = 0  # responses, with those tried again and without those found in a store
    failures: int = 0  # points whose response failed in the end and was replaced
    seconds: float = 0.0  # running mean for one response, which sizes chunks; 0 before the first
    has_succeeded: bool = False  # whether any run gave a response
    named: Outputs | None = None  # outputs of mappings, where they were not known
    failed: dict[bytes, Failure] = field(default_factory=dict)  # by inputs

    def aligned(self, chunk: Chunk) -> Floats:
        """Return the responses of a chunk, with columns in the order of the first chunk."""
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

    def count(self, size: int, seconds: float) -> None:
        """Count the responses of a chunk, and update the time of one."""
        self.computed += size
        mean = seconds / size
        self.seconds = 0.7 * self.seconds + 0.3 * mean if self.seconds != 0 else mean

    def record_failures(self, points: Points, reasons: dict[int, str]) -> None:
        """Keep inputs and reasons of failures, by row; of ten thousand, about 10 MB."""
        for row, reason in reasons.items():
            if len(self.failed) == 10_000:
                break
            (inputs,) = points.at(np.array([row])).keys()
            self.failed.setdefault(inputs.tobytes(), Failure(inputs, reason))

    def copied(self) -> Tally:
        """Return a tally that counts on independently."""
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
    policy = settings.on_failure
    _verify_store(settings, points, tally)
    keys = points.keys() if settings.store is not None else np.empty((len(points), 0))
    values, missing, failed = _stored(settings, keys)
    raised: dict[int, str] = {}
    for attempt in range(policy.tries):
        is_last = attempt == policy.tries - 1
        tolerant = policy.final.goes_on or not is_last
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
                # No run has given a response: the function is another one, whatever the policy.
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


def _verify_store(settings: CallSettings, points: Points, tally: Tally) -> None:
    """Compute one stored response again, once for a store without a version.

    The function, or its variables, may have changed since the response was stored.
    """
    store = settings.store
    if store is None or store.verified:
        return
    keys, values = store.known()
    columns = values if values.ndim > 1 else values[:, None]
    finite = np.isfinite(columns).all(axis=1)
    usable = np.flatnonzero(finite & points.have_same_constants(keys))
    if usable.size:
        first = usable[:1]
        expected = columns[first[0]]
        scale = np.maximum(np.abs(expected), np.median(np.abs(columns[usable]), axis=0))
        response, text = _recomputed(settings, points.from_keys(keys[first]), tally)
        # More than the rounding of another machine or version of a library.
        tolerance = 1e-6 * scale
        same_number = response.size == expected.size
        if not same_number or not (np.abs(response - expected) <= tolerance).all():
            at = ", ".join(f"{x:.6g}" for x in keys[first[0]])
            raise StoreError(
                f"{settings.name}: store: got a response that gives {text} at ({at}), expected "
                f"{_numbers_text(expected)}, which is stored in {store.path}: it is of another "
                "function, or its variables have changed; nothing was changed: pass another "
                "folder, or version= with a name for the response as it is now, whose runs are "
                "then kept apart"
            )
    store.verified = True


def _recomputed(settings: CallSettings, point: Points, tally: Tally) -> tuple[Floats, str]:
    """Return the response at one point, NaN if it fails, and the result in words."""
    chunk = Chunk(np.array([np.nan]), {}, 0.0)
    for _ in range(settings.on_failure.tries):
        for ((_, chunk),) in chunks(settings, point, np.arange(1), True, tally):
            if not chunk.raised:
                response = tally.aligned(chunk).ravel()
                return response, _numbers_text(response)
    return np.array([np.nan]), f"nothing ({next(iter(chunk.raised.values()), 'it was lost')})"


def _numbers_text(values: Floats, digits: int = 10) -> str:
    """Return the numbers of a run, shape (m,), as a text of at most six."""
    text = ", ".join(f"{value:.{digits}g}" for value in values[:6])
    if values.size == 1:
        return text
    return f"({text}, ...)" if values.size > 6 else f"({text})"


def _stored(settings: CallSettings, keys: Floats) -> tuple[Floats, Rows, dict[int, str]]:
    """Return the stored responses, the rows to compute, and the reasons of stored failures."""
    if settings.store is None:
        event = () if settings.outputs is None else settings.outputs.event
        return np.full((len(keys), *event), np.nan), np.arange(len(keys)), {}
    values, is_stored = settings.store.find(keys)
    if settings.outputs is not None:
        values = values.reshape(len(keys), *settings.outputs.event)
    failed = settings.store.failed(keys)
    if settings.retry_failed or not settings.on_failure.final.goes_on:
        is_stored[list(failed)] = False
        failed = {}
    return values, np.flatnonzero(~is_stored), failed


def _add_to_store(
    store: Store, keys: Floats, finished: Sequence[Finished], *, is_last: bool, tolerant: bool
) -> None:
    """Store finished chunks in one transaction, since each waits for the disk.

    After the last try NaN is a result, too, except in a chunk that a failure ended.
    """
    parts = []
    for rows, chunk in finished:
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
    if policy.refuses_nan:
        raise _failure_error(settings, points, raised or {int(np.flatnonzero(is_nan)[0]): first})
    if policy.replacement is not None:
        n_nan = int(is_nan.sum())
        tally.failures += n_nan
        text = f"{n_nan} of {is_nan.size} responses failed, replaced by {policy.replacement}"
        report(Finding("responses-replaced", f"{settings.name}: {text}; the first: {first}"))
        tally.record_failures(points, dict.fromkeys(map(int, np.flatnonzero(is_nan)), "it is NaN"))
        values[is_nan] = policy.replacement
    return values


def _failure_error(settings: CallSettings, points: Points, raised: dict[int, str]) -> ResponseError:
    row, reason = next(iter(raised.items()))
    place = ""
    if isinstance(settings.function, scalar):  # the point of a batch is not known
        (inputs,) = points.at(np.array([row])).keys()
        place = f", the first with inputs {_numbers_text(inputs, 6)}"
    store_text = ""
    if settings.store is not None:
        store_text = f"; {len(settings.store)} responses are kept in {settings.store.folder}"
    policies = "on_failure=prb.response.Replace() or prb.response.Retry()"
    advice = (
        "repair it, keep priors and inputs where it has a response, or pass "
        f"{policies} to the propagation or surrogate"
    )
    if is_wrong_result(reason):
        advice = f"repair it; if this is what a run that failed returns, pass {policies}"
    return ResponseError(
        f"{settings.name}: the response failed at {len(raised)} point(s){place}: {reason}"
        f"{store_text}; {advice}"
    )


# -- sending chunks --------------------------------------------------------------------------------


def chunk_size(settings: CallSettings, tally: Tally, n_left: int, workers: int) -> int:
    """Return the number of points for the next chunk."""
    is_scalar = isinstance(settings.function, scalar)
    if tally.seconds == 0:
        # The cost is not known yet, and may be minutes for each point.
        return 1 if is_scalar else min(n_left, 16)
    # From twice the cost of sending a chunk on, no response waits for others to be stored.
    if is_scalar and tally.seconds >= 0.01:
        return 1
    # Smaller chunks towards the end keep all workers busy. Otherwise 0.2 s: long against the 4.5 ms
    # that sending one costs (`python -m benchmarks.scale`), short against the loss of a worker.
    share = n_left if settings.executor is None else max(1, n_left // (2 * workers))
    return int(max(1, min(share, 0.2 / tally.seconds)))


def chunks(
    settings: CallSettings, points: Points, rows: Rows, tolerant: bool, tally: Tally
) -> Iterator[list[Finished]]:
    """Compute the responses at some rows of the points, and yield chunks as they are finished.

    After a failure that is not tolerated, a lost worker, or a spent budget, no chunk begins; those
    that have begun are yielded before the error is raised.
    """
    work = _work(settings)
    limits = capacity(settings.executor)
    pool = Pool(settings.name, settings.executor)
    suspects: list[Rows] = []  # chunks at work when a worker was lost
    loss: BaseException | None = None
    begun: dict[Future[Chunk], Rows] = {}
    waiting = rows
    error: BaseException | None = None
    with progress(f"responses of {settings.name}", rows.size) as report:
        while waiting.size or begun or suspects:
            if suspects and not begun:
                for chunk_rows, chunk in _one_at_a_time(pool, work, points, suspects, loss):
                    tally.count(chunk_rows.size, chunk.seconds)
                    report(chunk_rows.size, "")
                    yield [(chunk_rows, chunk)]
                suspects = []
            while waiting.size and not suspects and len(begun) < limits.chunks:
                size = chunk_size(settings, tally, waiting.size, limits.workers)
                try:
                    size = budget().grant(size, least=1)
                except BudgetError as spent:
                    error = error or spent
                    waiting = waiting[:0]
                    break
                chunk_rows, waiting = waiting[:size], waiting[size:]
                begun[pool.submitted(work, points.at(chunk_rows), tolerant)] = chunk_rows
            finished = []
            for future in pool.done(begun):
                chunk_rows = begun.pop(future)
                failure = failure_of(future)
                if has_slipped(failure):
                    waiting = np.concatenate([chunk_rows, waiting])
                elif tolerant and is_loss(failure):
                    suspects.append(chunk_rows)
                    loss = failure
                elif failure is not None:
                    error = error or failure
                    waiting = waiting[:0]
                else:
                    chunk = future.result()
                    if chunk.raised and not tolerant:
                        waiting = waiting[:0]
                    tally.count(chunk_rows.size, chunk.seconds)
                    report(chunk_rows.size, f"{limits.workers / max(tally.seconds, 1e-9):.3g}/s")
                    finished.append((chunk_rows, chunk))
            if finished:
                yield finished
    if error is not None:
        pool.renew(error)  # for the next response that is sent to this executor
        _raise_lost(settings.name, error)


def _one_at_a_time(
    pool: Pool,
    work: Callable[[Points, bool], Chunk],
    points: Points,
    suspects: list[Rows],
    loss: BaseException | None,
) -> Iterator[Finished]:
    """Compute chunks one by one, and bisect those that end their worker, down to a failed point."""
    pool.renew(loss)
    pool.refuse_dead()
    waiting = list(reversed(suspects))
    while waiting:
        rows = waiting.pop()
        future = pool.submitted(work, points.at(rows), True)
        pool.done([future])
        failure = failure_of(future)
        pool.renew(failure)
        if failure is None:
            yield rows, future.result()
        elif has_slipped(failure):
            waiting.append(rows)
        elif not is_loss(failure):
            _raise_lost(pool.name, failure)
        elif rows.size == 1:
            reason = f"it ended its worker ({type(failure).__name__}), or took far too long"
            yield rows, Chunk(np.array([np.nan]), {0: reason}, 0.0)
        else:
            waiting += [rows[rows.size // 2 :], rows[: rows.size // 2]]


def _raise_lost(name: str, error: BaseException) -> None:
    if isinstance(error, BudgetError):
        raise error
    if isinstance(error, ResponseError):
        raise ResponseError(f"{name}: {error}") from None
    cause = ""
    if is_loss(error):
        cause = "if a response ends its worker, on_failure= may let that cost its point only; "
    raise ResponseError(
        f"{name}: {failure_text(error)}; {cause}run again: with store= nothing that was computed "
        "is computed again"
    ) from error


def _work(settings: CallSettings) -> Callable[[Points, bool], Chunk]:
    """Return the work on points; other processes get the function as bytes."""
    outputs = settings.outputs
    if settings.executor is None or isinstance(settings.executor, ThreadPoolExecutor):
        return partial(compute, settings.function, outputs=outputs)
    payload = packed(settings.function)
    return partial(compute_packed, payload, timeout=settings.timeout, outputs=outputs)
