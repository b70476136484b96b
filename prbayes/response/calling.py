"""Calling an expensive response at many points: on an executor, in chunks, with a store and a failure policy."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ThreadPoolExecutor, wait
from functools import lru_cache, partial
from typing import Any

import numpy as np

from prbayes._checks import Floats
from prbayes._progress import progress
from prbayes.response.failures import Abort, OnFailure, Replace, Retry
from prbayes.response.store import Store

_log = logging.getLogger("prbayes")
_CHUNK_SECONDS = 0.2  # that a task should take: long against sending it, short against losing it
_ALONE_SECONDS = 0.01  # from which a response of one specimen at a time is a task of its own
_MANY = 1024  # tasks sent out to an executor that does not tell how many workers it has


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
            raise TypeError(f"scalar: got {type(function).__name__}, expected a function of one specimen's inputs")
        self.function = function

    def __call__(self, *inputs: Any) -> Floats:
        """Call the function for each element of arrays that broadcast against each other."""
        arrays = np.broadcast_arrays(*(np.asarray(x, dtype=np.float64) for x in inputs))
        values = [float(self.function(*row)) for row in zip(*(a.ravel() for a in arrays), strict=True)]
        return np.array(values).reshape(arrays[0].shape)


class Caller:
    """Computes a function at points, each point once.

    Parameters
    ----------
    name : str
        Of the simulator, for messages.
    function : callable or scalar
        ``function(*arguments)``; arrays (m, *event) or constants.
    executor : concurrent.futures.Executor or None
    on_failure : OnFailure
    store : Store or None

    Attributes
    ----------
    count : int
        Responses computed, retried ones included.
    failures : int
        Points whose response raised or was NaN in the end.
    """

    def __init__(
        self,
        name: str,
        function: Callable[..., Any],
        executor: Executor | None,
        on_failure: OnFailure,
        store: Store | None,
    ) -> None:
        self.name = name
        self.function = function
        self.executor = executor
        self.on_failure = on_failure
        self.store = store
        self.count = 0
        self.failures = 0
        self._cost = 0.0  # seconds for one response, measured
        self._workers, self._window = 1, 1  # tasks at work, and those sent out, at any time

    def __call__(self, arguments: Sequence[Any], varying: Sequence[bool], keys: Floats) -> Floats:
        """Return responses, shape (n,).

        Parameters
        ----------
        arguments : sequence
            Arrays (n, *event) where ``varying``, and else constants.
        varying : sequence of bool
        keys : ndarray, shape (n, columns)
            All that a response depends on.
        """
        values = np.full(len(keys), np.nan)
        missing = np.arange(len(keys))
        if self.store is not None:
            values, known = self.store.find(keys)
            missing = np.flatnonzero(~known)
        times = 1 + (self.on_failure.times if isinstance(self.on_failure, Retry) else 0)
        for attempt in range(times):
            last = attempt == times - 1
            policy = self._policy(last=last)
            tolerant = not isinstance(policy, Abort)
            messages: dict[int, str] = {}
            for rows, found, said in self._computed(arguments, varying, missing, tolerant):
                values[rows] = found
                messages.update({int(rows[i]): text for i, text in said.items()})
                settled = rows if last and (tolerant or not said) else rows[~np.isnan(found)]
                if self.store is not None and settled.size:
                    self.store.add(keys[settled], values[settled])
            if messages and not tolerant:
                self._raise(messages)
            missing = missing[np.isnan(values[missing])]
            if not missing.size:
                break
        if self.store is not None:
            self.store.merge()
        return self._settled(values, messages)

    def _policy(self, *, last: bool) -> OnFailure | None:
        """Return what holds for a failure now; None while it will be tried again."""
        if isinstance(self.on_failure, Retry):
            return self.on_failure.then if last else None
        return self.on_failure

    def _settled(self, values: Floats, messages: dict[int, str]) -> Floats:
        bad = np.isnan(values)
        if not bad.any():
            return values
        policy = self._policy(last=True)
        first = next(iter(messages.values()), "it is NaN")
        if isinstance(policy, Abort) and policy.on_nan:
            self._raise(messages or {0: first})
        if isinstance(policy, Replace):
            self.failures += int(bad.sum())
            _log.warning("%s: %d of %d responses failed, replaced by %s; the first: %s", self.name, bad.sum(), bad.size,
                         policy.value, first)  # fmt: skip
            values[bad] = policy.value
        return values

    def _raise(self, messages: dict[int, str]) -> None:
        kept = f"; {len(self.store)} responses are kept in {self.store.folder}" if self.store is not None else ""
        raise ResponseError(
            f"{self.name}: the response failed at {len(messages)} point(s): {next(iter(messages.values()))}{kept}; "
            "repair it, or pass on_failure=prb.Replace() or prb.Retry() to the propagation or surrogate"
        )

    def _computed(
        self, arguments: Sequence[Any], varying: Sequence[bool], missing: Any, tolerant: bool
    ) -> Iterator[tuple[Any, Floats, dict[int, str]]]:
        """Yield rows, their responses (NaN if they raised) and messages by position, as they are computed.

        After a failure that is not tolerated nothing more is begun, and what was begun is waited for and kept.
        """
        here = self.executor is None or isinstance(self.executor, ThreadPoolExecutor)
        work = partial(_compute, self.function) if here else partial(_remote, _packed(self.function))
        self._workers, self._window = _capacity(self.executor)
        begun: dict[Future[Any], Any] = {}
        at = 0
        error: BaseException | None = None
        with progress(f"responses of {self.name}", missing.size) as report:
            while at < missing.size or begun:
                while at < missing.size and len(begun) < self._window:
                    rows = missing[at : at + self._chunk(missing.size - at)]
                    at += rows.size
                    part = [a[rows] if v else a for a, v in zip(arguments, varying, strict=True)]
                    future = _submitted(self.executor, work, part, list(varying), tolerant)
                    begun[future] = rows
                for future in wait(begun, return_when=FIRST_COMPLETED).done:
                    rows = begun.pop(future)
                    if future.exception() is not None:
                        error = error or future.exception()
                        at = missing.size
                        continue
                    if future.result()[1] and not tolerant:
                        at = missing.size
                    yield self._take(rows, future.result(), report)
        if isinstance(error, ResponseError):
            raise ResponseError(f"{self.name}: {error}") from None
        if error is not None:
            raise ResponseError(
                f"{self.name}: a worker was lost ({type(error).__name__}: {error}); run again: with store= "
                "nothing that was computed is computed again"
            ) from error

    def _take(self, rows: Any, result: tuple[Floats, dict[int, str], float], report: Any) -> tuple[Any, Floats, Any]:
        values, messages, seconds = result
        self.count += rows.size
        cost = seconds / rows.size
        self._cost = cost if self._cost == 0 else 0.7 * self._cost + 0.3 * cost
        report(rows.size, f"{self._workers / max(self._cost, 1e-9):.3g}/s")
        return rows, values, messages

    def _chunk(self, left: int) -> int:
        """Return how many points the next task gets."""
        if self._cost == 0:
            return 1 if isinstance(self.function, scalar) else min(left, 16)
        if isinstance(self.function, scalar) and self._cost >= _ALONE_SECONDS:
            return 1
        share = max(1, left // (2 * self._workers)) if self.executor is not None else left
        return int(max(1, min(share, _CHUNK_SECONDS / self._cost)))


def _capacity(executor: Executor | None) -> tuple[int, int]:
    """Return how many workers an executor has, and how many tasks to send out at a time.

    The interface does not tell: processes, threads and loky keep ``_max_workers``, MPI ``num_workers``, and Dask's
    client knows. Of others many tasks are sent out, lest workers wait.
    """
    if executor is None:
        return 1, 1
    nthreads = getattr(getattr(executor, "_client", None), "nthreads", None)
    known = getattr(executor, "_max_workers", 0) or getattr(executor, "num_workers", 0)
    workers = int(known or (sum(nthreads().values()) if callable(nthreads) else 0))
    return (workers, 2 * workers) if workers else (os.cpu_count() or 1, _MANY)


def _submitted(executor: Executor | None, work: Callable[..., Any], *job: Any) -> Future[Any]:
    """Return the work as a future: done already if there is no executor, failed if the executor is broken."""
    future: Future[Any] = Future()
    try:
        if executor is not None:
            return executor.submit(work, *job)
        future.set_result(work(*job))
    except Exception as error:
        future.set_exception(error)
    return future


def _compute(
    function: Callable[..., Any], arguments: Sequence[Any], varying: Sequence[bool], tolerant: bool
) -> tuple[Floats, dict[int, str], float]:
    """Return responses, what was raised by position, and the seconds it took."""
    clock = time.perf_counter()
    size = len(arguments[list(varying).index(True)])
    values, messages = np.full(size, np.nan), {}
    if isinstance(function, scalar):
        for i in range(size):
            try:
                with np.errstate(all="ignore"):
                    values[i] = float(function.function(*_row(arguments, varying, i)))
            except Exception as error:
                messages[i] = f"it raised {type(error).__name__}: {error}"
                if not tolerant:
                    break
        return values, messages, time.perf_counter() - clock
    try:
        with np.errstate(all="ignore"):
            result = function(*arguments)
    except Exception as error:
        if not tolerant or size == 1:
            messages = {0: f"it raised {type(error).__name__}: {error}"}
        else:  # halve until the points that fail are alone
            for part in (np.arange(size // 2), np.arange(size // 2, size)):
                some = [a[part] if v else a for a, v in zip(arguments, varying, strict=True)]
                values[part], said, _ = _compute(function, some, varying, tolerant)
                messages.update({int(part[i]): text for i, text in said.items()})
    else:
        values = checked(result, (size,), arguments)
    return values, messages, time.perf_counter() - clock


def _row(arguments: Sequence[Any], varying: Sequence[bool], i: int) -> list[Any]:
    """Return the arguments of one point."""
    return [a[i] if v else a for a, v in zip(arguments, varying, strict=True)]


def checked(result: Any, batch: tuple[int, ...], arguments: Sequence[Any]) -> Floats:
    """Return a response's result as floats, or raise if it is not real numbers in the batch shape."""
    array = np.asarray(result)
    if array.dtype.kind not in "fiub":
        got = "complex numbers" if array.dtype.kind == "c" else f"{type(result).__name__} of dtype {array.dtype}"
        raise ResponseError(f"the response returned {got}, expected an array of real numbers")
    if array.shape != batch:
        shapes = ", ".join(str(np.shape(a)) for a in arguments)
        raise ResponseError(
            f"the response returned shape {array.shape} for inputs of shapes {shapes}, expected {batch}: one response "
            "per specimen; reduce over the event axis only (the last one), or wrap a function of one specimen in "
            "prb.scalar"
        )
    return array.astype(np.float64)


def _packed(function: Callable[..., Any]) -> bytes:
    import cloudpickle

    return bytes(cloudpickle.dumps(function))


@lru_cache(maxsize=8)
def _unpacked(payload: bytes) -> Callable[..., Any]:
    import cloudpickle

    return cloudpickle.loads(payload)  # type: ignore[no-any-return]


def _remote(payload: bytes, *job: Any) -> tuple[Floats, dict[int, str], float]:
    return _compute(_unpacked(payload), *job)
