"""The user's response: a function with its inputs, settings and counts of runs."""

from __future__ import annotations

import copy
import inspect
import math
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from pytensor.graph.basic import Variable

from prbayes._finding import report
from prbayes._validate import Floats, called, executes, folder_path
from prbayes.response.budget import budget
from prbayes.response.call import (
    PER_SPECIMEN,
    CallSettings,
    Points,
    Tally,
    array_advice,
    checked,
    column_names,
    respond,
    scalar,
    shapes,
)
from prbayes.response.discrepancy import findings_of
from prbayes.response.executors import capacity
from prbayes.response.failures import Abort, Failure, OnFailure, Replace, ResponseError
from prbayes.response.inputs import Inputs, argument_names, broadcast_batch
from prbayes.response.outputs import SINGLE_OUTPUT, Outputs
from prbayes.response.store import Store


def refuse_uncallable(name: str, function: object, argument: str = "response") -> None:
    """Raise if a response is no function: often the inputs were passed first."""
    if not callable(function) or isinstance(function, type):
        raise TypeError(
            f"{name}: {argument}: got {called(function)}, expected a function of the inputs, such "
            "as lambda x: x**2; the order is Simulator(name, response, *inputs, metric=..., "
            "observed=...)"
        )


def refuse_misfit(
    name: str, function: Any, sizes: Sequence[int], outputs: Outputs | None = None
) -> None:
    """Raise if a function takes other arguments than inputs of these sizes, or other outputs."""
    inner: Any = function.function if isinstance(function, scalar) else function
    try:
        # Of a decorated function its own signature, not that of the function inside.
        signature = inspect.signature(inner, follow_wrapped=False)
    except (TypeError, ValueError):
        signature = None
    try:
        if signature is not None:
            signature.bind(*sizes)
    except TypeError as error:
        raise TypeError(
            f"{name}: response: got inputs of {list(sizes)} numbers for a function of {signature} "
            f"({error}), expected an input for each argument; a multivariate input is one "
            "argument, an array with an axis for its elements"
        ) from None
    if hasattr(inner, "refuse_misfit"):  # of a program, unit or server
        inner.refuse_misfit(name, sizes, outputs)


def check_call_settings(
    executor: object, store: object, version: object, on_failure: object
) -> None:
    """Raise if a setting of the calls of a response has the wrong type."""
    executes(executor, "executor")
    if store is not None:
        folder_path(store, "store")
    if version is not None and (not isinstance(version, str) or not version):
        raise TypeError(
            f"version: got {called(version)}, expected a text that names the response as it is, "
            "such as '2' or 'mesh 3, solver 1.4'"
        )
    if not isinstance(on_failure, OnFailure):
        raise TypeError(
            f"on_failure: got {called(on_failure)}, expected prb.response.Abort(), "
            "prb.response.Replace() or prb.response.Retry()"
        )


@dataclass
class Runs:
    """Runs of a response that simulators with the same inputs and settings share."""

    # Batches of stored points, (n, *event) for each aleatory input, and their responses, (n,) or
    # (n, m).
    stored: list[tuple[list[Floats], Floats]] = field(default_factory=list)
    last: tuple[list[Floats], Floats] | None = None  # inputs and responses of the last call
    is_shared: bool = False

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "last": None}

    def at(self, points: Sequence[Floats]) -> Floats | None:
        """Return the responses of a stored batch, (n,) or (n, m), None if it is not stored."""
        for stored_points, values in self.stored:
            if _equal(stored_points, points):
                return values
        return None


class Responses:
    """The user's response: a function of inputs, called once for each batch or by `respond`."""

    def __init__(
        self,
        name: str,
        function: Callable[..., Any],
        inputs: Inputs,
        *,
        executor: Executor | None = None,
        store: Any = None,
        version: str | None = None,
        on_failure: OnFailure | None = None,
        retry_failed: bool = False,
        timeout: float | None = None,
        outputs: Outputs | None = SINGLE_OUTPUT,  # None takes those of the first run
    ) -> None:
        refuse_uncallable(name, function)
        refuse_misfit(name, function, inputs.sizes, outputs)
        report(*findings_of(function))
        policy = Abort() if on_failure is None else on_failure
        database, self.folder = None, None
        if store is not None:
            n_outputs = None
            if outputs is not None:
                n_outputs = max(1, len(outputs.labels))
                if version is not None and outputs.keys and outputs.labels:
                    # In another order they are other numbers.
                    version = f"{version} ({', '.join(outputs.names)})"
            database = Store(
                store, name, columns=sum(inputs.sizes), version=version, outputs=n_outputs
            )
            self.folder = database.folder
        self.name = name
        self.outputs = outputs
        self.function = function
        self.inputs = inputs
        # Without other settings a function of batches is called once for each of them.
        self.is_batched = (
            executor is None
            and store is None
            and policy == Abort()
            and not isinstance(function, scalar)
        )
        self.count = 0  # runs that were needed, whether computed here or found in the store
        # Whether the response has different values at the same point; None while it is not known.
        self.is_random: bool | None = None
        # Called with the number of runs of a call, and the seconds of one: NaN before a batch.
        self.on_start: Callable[[int, float], None] | None = None
        self.runs = Runs()
        self._checks_batches = self.is_batched
        self._n_reused = 0
        columns = column_names(argument_names(inputs, function), inputs.sizes)
        self._settings = CallSettings(
            name, function, executor, database, policy, retry_failed, timeout, outputs, columns
        )
        self._tally = Tally()

    def copied(self) -> Responses:
        """Return the same function with its own counts, and the same executor and store."""
        other = copy.copy(self)
        other._tally = self._tally.copied()
        other.runs = Runs(list(self.runs.stored))
        return other

    def share(self, other: Responses) -> None:
        """Use the runs of another one with the same response, inputs and settings."""
        self.runs = other.runs
        self.runs.is_shared = True

    @property
    def computed(self) -> int:
        """Responses computed here: without those found in a store, with those tried again."""
        return self.count - self._n_reused if self.is_batched else self._tally.computed

    @property
    def failures(self) -> int:
        """Points whose response failed and was replaced."""
        return self._tally.failures

    @property
    def failed(self) -> tuple[Failure, ...]:
        """The points that failed, each once, with their reasons; the first ten thousand."""
        return tuple(self._tally.failed.values())

    @property
    def replacement(self) -> float:
        """Value in place of a response that failed; NaN if nothing is."""
        final = self._settings.on_failure.final
        return float(final.value) if isinstance(final, Replace) else np.nan

    @property
    def workers(self) -> int:
        """Number of workers."""
        return capacity(self._settings.executor)[0]

    def same_as(self, other: Responses) -> bool:
        """Return whether another has the same function, inputs and constants, and output order."""
        # A mapping's arrays are concatenated in the order of what was observed.
        keys = {r.outputs.keys for r in (self, other) if r.outputs is not None}
        arguments, other_arguments = self.inputs.arguments, other.inputs.arguments
        if self.function is not other.function or len(keys) > 1:
            return False
        if len(arguments) != len(other_arguments):
            return False
        for x, y in zip(arguments, other_arguments, strict=True):
            if isinstance(x, int) and isinstance(y, int):
                x, y = self.inputs.aleatory[x], other.inputs.aleatory[y]
            if isinstance(x, int | Variable) or isinstance(y, int | Variable):
                if x is not y:
                    return False
            elif not np.array_equal(x, y):
                return False
        return True

    def __call__(self, aleatory: Sequence[Floats], epistemic: Sequence[Floats]) -> Floats:
        """Return responses, (...) or (..., m), for values of the inputs, shapes (..., *event)."""
        values = [np.asarray(v, dtype=np.float64) for v in (*aleatory, *epistemic)]
        batch, full = broadcast_batch(values, self.inputs.event_ndims)
        size = int(np.prod(batch, dtype=int))
        runs = self.runs
        if runs.is_shared and runs.last is not None and _equal(runs.last[0], values):
            self.count_reused(size)
            return runs.last[1].copy()
        if self.is_batched:
            if self.on_start is not None:
                self.on_start(size, np.nan)
            clock = time.perf_counter()
            responses = self._called(full, batch)
            if self.on_start is not None:
                self.on_start(size, (time.perf_counter() - clock) / max(1, size))
            if self._checks_batches and size > 1:
                self._checks_batches = False
                self._refuse_mixing(full, batch, responses)
        else:
            self.count += size
            responses = respond(
                self._settings, self._points(full, batch), self._tally, self.on_start
            )
            if self.outputs is None:
                self.outputs = self._tally.named
            responses = responses.reshape(batch + responses.shape[1:])
        # For the next simulator. Before there is one, only the trial at some points of the prior,
        # which all simulators make.
        is_kept = runs.is_shared or responses.size <= 64
        runs.last = ([x.copy() for x in values], responses.copy()) if is_kept else None
        return responses

    def alone(self, aleatory: Sequence[Floats]) -> Floats:
        """Compute one specimen by itself, (1, *event) by input; no run, and not in the store."""
        values = [np.asarray(v, dtype=np.float64) for v in aleatory]
        if self.is_batched:
            return self._called(values, (1,), is_run=False)
        settings = replace(self._settings, store=None)
        return respond(settings, self._points(values, (1,)), self._tally.copied())

    def count_symbolic(self, size: int) -> None:
        """Count responses that are computed in a graph."""
        budget().grant(size, least=size)
        self.count += size

    def count_reused(self, size: int) -> None:
        """Count responses that are known and needed again."""
        self.count += size
        self._n_reused += size

    def _points(self, full: Sequence[Floats], batch: tuple[int, ...]) -> Points:
        """Return the points of a batch, each a row, from values of all inputs."""
        n = int(np.prod(batch, dtype=int))
        k = len(self.inputs.aleatory)
        rows = [v.reshape(n, *v.shape[len(batch) :]) for v in full]
        varying = [isinstance(a, int | Variable) for a in self.inputs.arguments]
        return Points(self.inputs.fill(rows[:k], rows[k:]), varying)

    def _called(
        self, values: Sequence[Floats], batch: tuple[int, ...], *, is_run: bool = True
    ) -> Floats:
        """Call the function once for a batch of any shape."""
        k = len(self.inputs.aleatory)
        arguments = self.inputs.fill(values[:k], values[k:])
        size = int(np.prod(batch, dtype=int)) if is_run else 0
        budget().grant(size, least=size)
        try:
            with np.errstate(all="ignore"):
                result = self.function(*arguments)
        except (Exception, SystemExit) as error:
            raise ResponseError(
                f"{self.name}: the response raised {type(error).__name__}: {error}; it was called "
                f"with inputs of shapes {shapes(arguments)} and is expected to take arrays of any "
                f"leading shape, or to be wrapped in prb.scalar{array_advice(str(error))}"
            ) from error
        self.count += size
        try:
            responses, self.outputs = checked(result, batch, arguments, self.outputs)
        except ResponseError as error:
            raise ResponseError(f"{self.name}: {error}") from None
        return responses

    def _refuse_mixing(
        self, values: Sequence[Floats], batch: tuple[int, ...], responses: Floats
    ) -> None:
        """Raise if a specimen has another response alone than in its batch; one run, rarely two."""
        event = responses.shape[len(batch) :]
        rows = responses.reshape(-1, int(np.prod(event, dtype=int)))
        finite = np.isfinite(rows).all(axis=1)
        if finite.sum() < 2:
            return
        first = int(np.flatnonzero(finite)[0])
        place = np.unravel_index(first, batch)
        specimen = [v[place][None] for v in values]
        try:
            # Copies, which the function may change in place.
            single = self._called([x.copy() for x in specimen], (1,), is_run=False).ravel()
            # A solver that steps a batch as one system differs by up to .01 spreads; a mean, a sum
            # or another order over specimens by about one.
            if not (np.abs(rows[first] - single) > 0.01 * rows[finite].std(axis=0)).any():
                return
            # A random response does not mix its specimens.
            again = self._called([x.copy() for x in specimen], (1,), is_run=False).ravel()
            if (np.abs(again - single) > 1e-6 * np.abs(single)).any():
                return
        except ResponseError as error:  # it takes no batch of one
            self._refuse_one_size(values, batch, error)
            return
        worst = int(np.nanargmax(np.abs(rows[first] - single)))
        raise ResponseError(
            f"{self.name}: the response of a specimen depends on those that it is computed with: "
            f"got {single[worst]:.6g} by itself, and {rows[first, worst]:.6g} among {len(rows)}, "
            "expected the same; look for a mean, a sum, a sort or another order over the axis of "
            "specimens, or write it for one specimen, in prb.scalar"
        )

    def _refuse_one_size(
        self, values: Sequence[Floats], batch: tuple[int, ...], error: ResponseError
    ) -> None:
        """Raise if the response takes no other number of specimens than that of its batch.

        An array of as many values inside it would be paired with points of the population.
        """
        size = int(np.prod(batch, dtype=int))
        few = (*[1] * (len(batch) - 1), 3 if size == 2 else 2)
        rows = np.arange(few[-1]) % size
        specimens = [v.reshape(size, *v.shape[len(batch) :])[rows] for v in values]
        try:
            self._called([x.reshape(few + x.shape[1:]) for x in specimens], few, is_run=False)
        except ResponseError:
            raise ResponseError(
                f"{self.name}: the response takes {size} specimens, and neither one nor "
                f"{few[-1]}, expected any number; {PER_SPECIMEN} ({str(error).split(';')[0]})"
            ) from None


def _equal(arrays: Sequence[Floats], others: Sequence[Floats]) -> bool:
    pairs = zip(arrays, others, strict=True)
    return all(np.array_equal(a, b, equal_nan=True) for a, b in pairs)


def deduplicated_responses(
    responses: Responses,
    points: Sequence[Floats],
    known: tuple[Sequence[Floats], Floats] | None = None,
) -> Floats:
    """Return the responses at points (n, *event), (n,) or (n, m), each different point once.

    ``known`` has points and responses. A response that differs at four points that are computed
    again is random, and is computed at all points.
    """
    n = len(points[0])
    known_points, known_values = ([x[:0] for x in points], np.empty(0)) if known is None else known
    m = len(known_values)
    # The bits of all numbers of each point as one item; -0.0 becomes 0.0.
    columns = [np.concatenate([x[:m], y]) for x, y in zip(known_points, points, strict=True)]
    columns = [x.reshape(m + n, math.prod(x.shape[1:])) for x in columns]
    bits = np.concatenate(columns, axis=1, dtype=np.float64) + 0.0
    keys = bits.view(np.dtype((np.void, bits.dtype.itemsize * bits.shape[1]))).ravel()
    _, first, which = np.unique(keys, return_index=True, return_inverse=True)
    earliest = first[which]
    is_new = earliest[m:] == np.arange(m, m + n)
    if is_new.all() or responses.is_random:
        return responses(points, [])

    # Compute the new points, and up to four different ones again.
    new, repeated = np.flatnonzero(is_new), np.flatnonzero(~is_new)
    again = repeated[:0]
    if responses.is_random is not False:
        # A response that is zero or one by chance passes four once in 16 times.
        _, place = np.unique(earliest[m:][repeated], return_index=True)
        again = repeated[np.sort(place)[:4]]
    rest = np.setdiff1d(repeated, again)
    selected = np.concatenate([new, again])
    computed = responses([x[selected] for x in points], []) if selected.size else known_values[:0]
    event = computed.shape[1:]
    values = np.full((m + n, *event), np.nan)
    values[:m] = known_values.reshape(m, *event)
    values[m + new] = computed[: new.size]
    second = computed[new.size :]
    if again.size:
        # Equal up to rounding, by output, as units may differ.
        earlier = values[earliest[m + again]]
        finite = np.where(np.isfinite(earlier), np.abs(earlier), 0.0)
        scale = finite.max(axis=0, initial=0.0)
        responses.is_random = not np.allclose(
            earlier, second, rtol=1e-6, atol=1e-6 * scale, equal_nan=True
        )
    if responses.is_random:
        values[m + again] = second
        if rest.size:
            values[m + rest] = responses([x[rest] for x in points], [])
        return values[m:]
    responses.count_reused(rest.size)
    return values[earliest[m:]]
