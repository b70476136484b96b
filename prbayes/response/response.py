"""The user's response: a function with its inputs, settings and counts of runs."""

from __future__ import annotations

import copy
import inspect
import logging
import math
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from pytensor.graph.basic import Variable

from prbayes._finding import report
from prbayes._validate import (
    Arrays,
    Floats,
    Function,
    Indices,
    Shape,
    executes,
    folder_path,
    wrong_value,
)
from prbayes.response.budget import budget, unlimited
from prbayes.response.call import (
    PER_SPECIMEN,
    CallSettings,
    Points,
    Tally,
    array_advice,
    changed_run,
    checked,
    column_names,
    computed_again,
    finite_runs,
    first_change,
    inputs_text,
    named_numbers,
    numbers_text,
    respond,
    scalar,
    shapes,
    takes_single_points,
    tolerance_of,
    unpacked,
    unwrapped,
    written_form,
)
from prbayes.response.discrepancy import findings_of
from prbayes.response.executors import capacity
from prbayes.response.failures import Abort, Failure, OnFailure, Replace, ResponseError
from prbayes.response.inputs import Inputs, aleatory_names, argument_names, broadcast_batch
from prbayes.response.outputs import SINGLE_OUTPUT, Outputs
from prbayes.response.store import Store
from prbayes.response.variables import listed, watched

_log = logging.getLogger(__name__)


_ORDER = "Simulator(name, response, *inputs, metric=..., observed=...)"


def refuse_uncallable(
    name: str, function: object, argument: str = "response", order: str = _ORDER
) -> None:
    """Raise if a response is no function: often the inputs were passed first.

    ``order`` is that of the arguments of the function that was called.
    """
    if not callable(function) or isinstance(function, type):
        raise wrong_value(
            function,
            f"{name}: {argument}",
            f"a function of the inputs, such as lambda x: x**2; the order is {order}",
        )


def refuse_misfit(
    name: str, function: Any, sizes: Sequence[int], outputs: Outputs | None = None
) -> None:
    """Raise if a function takes other arguments than inputs of these sizes, or other outputs."""
    inner = unwrapped(function)
    try:
        # The signature of a decorated function is that of its wrapper, which is what is called.
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
    if hasattr(inner, "refuse_misfit"):  # programs, units and servers check more
        inner.refuse_misfit(name, sizes, outputs)


def repeats_of(function: Function) -> int:
    """Return how many runs with the same inputs a random response needs; 1 for another one."""
    return int(getattr(unwrapped(function), "_random_repeats", 1))


def check_call_settings(
    executor: object, store: object, version: object, on_failure: object
) -> None:
    """Raise if a setting of the calls of a response has the wrong type."""
    executes(executor)
    if store is not None:
        folder_path(store, "store")
    if version is not None and (not isinstance(version, str) or not version):
        raise wrong_value(
            version,
            "version",
            "a text that names the response as it is, such as '2' or 'mesh 3, solver 1.4'",
        )
    if not isinstance(on_failure, OnFailure):
        raise wrong_value(
            on_failure,
            "on_failure",
            "prb.response.Abort(), prb.response.Replace() or prb.response.Retry()",
        )


@dataclass
class StoredRuns:
    """Runs of a response that simulators with the same inputs and settings share."""

    # Pairs of points, (n, *event) for each aleatory input, and their responses, (n,) or (n, m).
    stored: list[tuple[list[Floats], Floats]] = field(default_factory=list)
    last: tuple[list[Floats], Floats] | None = None  # inputs and responses of the last call
    is_shared: bool = False  # whether another simulator uses the runs
    # Version of the function (`Watched`) that gave the runs, or with which a part of them agrees;
    # None before the first run.
    version: int | None = None
    # Whether a few runs were repeated in this process, for another use; None to repeat them again
    # at any use.
    is_repeated: bool | None = False

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "last": None, "is_repeated": False}

    def at(self, points: Arrays) -> Floats | None:
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
        function: Function,
        inputs: Inputs,
        *,
        executor: Executor | None = None,
        store: Any = None,
        version: str | None = None,
        on_failure: OnFailure | None = None,
        retry_failed: bool = False,
        timeout: float | None = None,
        outputs: Outputs | None = SINGLE_OUTPUT,  # stated outputs; None takes those of a run
        caller: str = "",  # name of the function that uses the responses; by default ``name``
        # Largest change that a response may have when it is computed again, in standard deviations
        # of the responses; None for a random response.
        scatter: float | None = 0.01,
        times: int | None = None,  # position of the argument that is a condition of each reading
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
                    # Stored numbers have no names: outputs in another order are another version.
                    version = f"{version} ({', '.join(outputs.names)})"
            database = Store(
                store, name, columns=sum(inputs.sizes), version=version, outputs=n_outputs
            )
            self.folder = database.folder
        self.name = name
        self.outputs = outputs
        self.function = function
        # Number of runs with the same inputs that a random response needs; 1 for another one.
        self.repeats = repeats_of(function)
        self.inputs = inputs
        # A function of batches without other settings is called once for a whole batch.
        self.is_batched = (
            executor is None
            and store is None
            and policy == Abort()
            and not takes_single_points(function)
        )
        # Tolerance, in standard deviations, for solvers that integrate a batch as one system.
        self._one_system = 0.01 if self.is_batched else 0.0
        self.count = 0  # number of runs that were needed, computed here or found in the store
        self.caller = caller or name
        self.scatter = scatter
        self.times = times
        # Function of the number of runs of a call and the seconds of one run, for progress; the
        # seconds are NaN before a batch.
        self.on_start: Callable[[int, float], None] | None = None
        self.runs = StoredRuns()
        self.watched = watched(function)
        self.n_repeated = 0  # number of runs that were repeated, because the response may change
        self._is_checked = False
        self._written_form = written_form(function)
        self._n_reused = 0
        columns = column_names(argument_names(inputs, function), inputs.sizes)
        self._settings = CallSettings(
            *(name, function, executor, database, policy, retry_failed, timeout, outputs, columns),
            takes_policy=on_failure is not None,
        )
        self._tally = Tally()

    def copied(self) -> Responses:
        """Return a copy with its own counts and the same executor and store."""
        duplicate = copy.copy(self)
        duplicate._tally = self._tally.copied()
        duplicate.runs = replace(
            self.runs, stored=list(self.runs.stored), last=None, is_shared=False
        )
        return duplicate

    def share(self, other: Responses) -> None:
        """Use the runs of another record with the same response, inputs and settings."""
        self.runs = other.runs
        self.runs.is_shared = True

    @property
    def computed(self) -> int:
        """Responses computed here: without those found in a store, with those tried again."""
        n = self.count - self._n_reused if self.is_batched else self._tally.computed
        return n + self.n_repeated

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
        """Value that replaces a failed response; NaN if failures are not replaced."""
        final = self._settings.on_failure.final
        return float(final.value) if isinstance(final, Replace) else np.nan

    @property
    def workers(self) -> int:
        """Number of workers."""
        return capacity(self._settings.executor)[0]

    @property
    def remedy(self) -> str:
        """What to do where the response is NaN, as a clause."""
        return str(getattr(self.function, "remedy", "repair the response"))

    def same_as(self, other: Responses) -> bool:
        """Return whether function, inputs, constants and order of outputs are the same."""
        # Arrays of a mapping are concatenated in the order of the observed outputs.
        keys = {r.outputs.keys for r in (self, other) if r.outputs is not None}
        sources = self.inputs.sources
        other_sources = other.inputs.sources
        if self.function is not other.function or len(keys) > 1:
            return False
        return len(sources) == len(other_sources) and all(
            x is y if isinstance(x, Variable) or isinstance(y, Variable) else np.array_equal(x, y)
            for x, y in zip(sources, other_sources, strict=True)
        )

    def __call__(self, aleatory: Arrays, epistemic: Arrays) -> Floats:
        """Return responses, (...) or (..., m), for values of the inputs, shapes (..., *event)."""
        values = [np.asarray(v, dtype=np.float64) for v in (*aleatory, *epistemic)]
        batch, full = broadcast_batch(values, self.inputs.event_ndims)
        size = math.prod(batch)
        runs = self.runs
        if runs.is_shared and runs.last is not None and _equal(runs.last[0], values):
            self.count_reused(size)
            return runs.last[1].copy()
        n_computed = self.computed
        if self.is_batched:
            if self.on_start is not None:
                self.on_start(size, np.nan)
            clock = time.perf_counter()
            responses = self._called(full, batch)
            if self.on_start is not None:
                self.on_start(size, (time.perf_counter() - clock) / max(1, size))
        else:
            self.count += size
            responses = respond(
                self._settings, self._points(full, batch), self._tally, self.on_start
            )
            if self.outputs is None:
                self.outputs = self._tally.named
            responses = responses.reshape(batch + responses.shape[1:])
        if not self._is_checked and size > 1:
            # If a store has some of the runs, they were checked when they were computed.
            if self.computed >= n_computed + size:
                specimens = [v.reshape(size, *v.shape[len(batch) :]) for v in full]
                rows = responses.reshape(size, *responses.shape[len(batch) :])
                self._refuse_state(specimens, rows)
                self._refuse_late_change(specimens, rows)
                _refuse_other_times(self, specimens, rows)
            self._is_checked = True
        # Keep the call for the next simulator with the same response. Before there is one, keep
        # only the trial at some points of the prior, because every simulator makes it.
        is_kept = runs.is_shared or responses.size <= 64
        runs.last = ([x.copy() for x in values], responses.copy()) if is_kept else None
        return responses

    def used_by(self, caller: str) -> Responses:
        """Return the same response for another use of its runs."""
        duplicate = copy.copy(self)
        duplicate.caller = caller
        return duplicate

    @property
    def may_differ(self) -> bool:
        """Whether runs may be others now: a variable has changed, or the user asks for repeats."""
        runs = self.runs
        return runs.version is not None and (
            runs.is_repeated is None or runs.version != self.watched.compared()
        )

    @contextmanager
    def kept_runs(self) -> Iterator[None]:
        """Compute runs that are used again: what they change in the function is no change."""
        with self.watched.calls():
            if self.runs.version is None:
                self.runs.version = self.watched.version
            yield

    def refuse_change(self, points: Arrays, values: Floats, stored: Responses) -> None:
        """Raise if stored runs differ when a part of them is computed again.

        ``points`` are those of this response's aleatory inputs, ``values`` their runs, (n,) or
        (n, m). Where a variable of the function has changed, a tenth of the runs is repeated, and
        more as time allows. Otherwise three are, once: files and servers are not compared. Nothing
        is computed if the store has a version, by which the user vouches for the runs.
        """
        store, runs = stored._settings.store, stored.runs
        self._is_checked |= stored._is_checked
        if (store is not None and store.version is not None) or self.repeats > 1:
            return
        has_changed = runs.version not in (None, stored.watched.compared())
        if runs.is_repeated and not has_changed:
            return
        names = listed(stored.watched.names) if has_changed else "a file or variable that it reads"
        n_repeated = 0

        def compute(rows: Indices) -> Floats:
            nonlocal n_repeated
            n_repeated += rows.size
            return self._again(points, rows)

        with stored.watched.calls():
            most = None if has_changed else 3
            change = changed_run(values, compute, self._one_system, most=most)
        stored.n_repeated += n_repeated
        reason = f"{names} has changed" if has_changed else f"{names} may have changed"
        _log.info("%s: %d runs of %s repeated: %s", self.caller, n_repeated, stored.name, reason)
        if change is not None:
            row, again = change
            raise ResponseError(
                f"{self.caller}: got {numbers_text(again)} from the response of {stored.name} "
                f"{_place_of_specimen(self, points, row)}, expected "
                f"{numbers_text(values[row])}, as in its runs: {names} "
                "has changed since; build the model again for the response as it is now, or write "
                "a function of its own for each condition, such as lambda x: response(x, load=2.0)"
            )
        runs.version, runs.is_repeated = stored.watched.version, True

    def count_symbolic(self, size: int) -> None:
        """Count responses that are computed in a graph."""
        budget().grant(size, least=size)
        self.count += size

    def count_reused(self, size: int) -> None:
        """Count responses that are known and needed again."""
        self.count += size
        self._n_reused += size

    def _points(self, full: Arrays, batch: Shape) -> Points:
        """Return the points of a batch, each a row, from values of all inputs."""
        n = math.prod(batch)
        k = len(self.inputs.aleatory)
        rows = [v.reshape(n, *v.shape[len(batch) :]) for v in full]
        varying = [isinstance(a, int | Variable) for a in self.inputs.arguments]
        return Points(self.inputs.fill(rows[:k], rows[k:]), varying)

    def _called(self, values: Arrays, batch: Shape, *, is_run: bool = True) -> Floats:
        """Call the function once for a batch of any shape."""
        k = len(self.inputs.aleatory)
        arguments = self.inputs.fill(values[:k], values[k:])
        size = math.prod(batch) if is_run else 0
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

    def _again(self, values: Arrays, rows: Indices) -> Floats:
        """Compute some specimens, (n, *event) by input, again; NaN where the response raises.

        The calls are not counted as runs, and are not stored.
        """
        # Indexing copies, so that the function may change its arguments in place.
        selected = [x[rows] for x in values]
        batch = (len(rows),)
        with unlimited():
            if self.is_batched:
                return self._called(selected, batch, is_run=False)
            settings = replace(self._settings, outputs=self.outputs)
            return computed_again(settings, self._points(selected, batch), self._tally.copied())[0]

    def _refuse_state(self, specimens: Arrays, values: Floats) -> None:
        """Raise if one of a few specimens differs when it is computed again, by itself.

        They are the last one, on which a state that passes from specimen to specimen has the most
        influence, then one in fifty at random, and finally the first one. A function of batches is
        also called for one in eight of many in random order, as a state may belong to places.
        """
        finite = finite_runs(values)
        if finite.size < 2 or (self.scatter is None and not self.is_batched) or self.repeats > 1:
            return
        self.watched.called()
        inner = np.random.default_rng(len(finite)).permutation(finite[1:-1])
        n_random = 1 if self.is_batched else 1 + len(inner) // 50
        rows = np.concatenate([finite[-1:], inner[:n_random], finite[:1]])
        parts = [*rows[:, None]] if self.is_batched else [rows]
        if self.is_batched and len(inner) > 32:
            parts.append(inner[1 : min(34, 3 + len(inner) // 8)])
        copies = 3 if len(values) == 2 else 2

        def by_itself(rows: Indices) -> Floats:
            try:
                return self._again(specimens, rows)
            except ResponseError:  # because the function rejects a batch of one specimen
                return self._again(specimens, np.tile(rows, copies))[: len(rows)]

        for part in parts:
            try:
                again = by_itself(part)
                again = np.where(np.isnan(again), values[part], again)  # it may fail by chance
                tolerance = tolerance_of(values, 0.01 if self.scatter is None else self.scatter)
                changed = first_change(values[part], again, tolerance)
                if changed is None:
                    continue
                second = by_itself(part)
            except ResponseError as error:  # the response rejects small batches
                if self.is_batched:
                    _refuse_one_size(self, specimens, error)
                return
            is_random = first_change(again, second, tolerance_of(values)) is not None
            if is_random and self.scatter is None:
                return
            tolerance = tolerance_of(values, self._one_system)
            if not is_random and first_change(values[part], again, tolerance) is None:
                continue
            row = part[changed]
            got = again[changed]
            expected = values[row]
            if is_random:
                raise ResponseError(
                    f"{self.name}: got {numbers_text(expected)} and {numbers_text(got)} from the "
                    f"response {_place_of_specimen(self, specimens, row)}, expected the same: it "
                    "is random, or keeps a state from one specimen to the next; fix its random "
                    "seed or state, model its scatter as an input, such as pm.Normal.dist(0, 1), "
                    "or use prb.AreaMetric() with prb.Fresh() for random responses"
                )
            raise ResponseError(
                f"{self.name}: the response of a specimen depends on the other specimens of a "
                f"call: got {numbers_text(got, 6)} "
                f"{'alone' if part.size == 1 or not self.is_batched else f'among {part.size}'}, "
                f"and {numbers_text(expected, 6)} among {len(values)}, expected the same; look "
                "for a mean, a sum, a sort or another order over the axis of specimens, and for a "
                "state from one specimen to the next, or write it for one specimen, in prb.scalar"
            )

    def _refuse_late_change(self, specimens: Arrays, values: Floats) -> None:
        """Raise if a few runs differ from those of the function when the simulator was written."""
        is_unchanged = written_form(self.function) == self._written_form
        is_random = self.scatter is None or self.repeats > 1
        if is_unchanged or self._written_form is None or is_random:
            return
        written = copy.copy(self)
        try:
            written.function = unpacked(self._written_form)
            written._settings = replace(self._settings, function=written.function)
            compute = partial(written._again, specimens)
            change = changed_run(values, compute, self._one_system, may_fail=True)
        except Exception:  # for example, a function that it calls was not defined yet
            return
        if change is not None:
            row, then = change
            raise ResponseError(
                f"{self.name}: got {numbers_text(values[row])} from the response "
                f"{_place_of_specimen(self, specimens, row)}, expected {numbers_text(then)}, its "
                "value when the simulator was created: a variable that it reads has changed since "
                "then (runs begin at the first use); write a function without a state, and one "
                "for each condition, such as functools.partial(response, load=2.0)"
            )


def _place_of_specimen(responses: Responses, points: Arrays, row: int) -> str:
    """Return the aleatory inputs of a specimen as a text, with their names."""
    inputs = responses.inputs
    sizes = [math.prod(shape) for shape in inputs.event_shapes]
    names = column_names(aleatory_names(inputs, responses.function), sizes)
    return f"at {named_numbers(names, np.concatenate([np.ravel(x[row]) for x in points]))}"


def _refuse_one_size(responses: Responses, specimens: Arrays, error: ResponseError) -> None:
    """Raise if the response takes no other number of specimens than that of its batch.

    Such a response contains an array with a value for each specimen, whose values would be
    paired with points of the population.
    """
    size = len(specimens[0])
    few = 3 if size == 2 else 2
    try:
        responses._called([x[np.arange(few) % size] for x in specimens], (few,), is_run=False)
    except ResponseError:
        raise ResponseError(
            f"{responses.name}: the response takes {size} specimens, but not one or {few}, "
            f"expected any number; {PER_SPECIMEN} ({str(error).split(';')[0]})"
        ) from None


def _refuse_other_times(responses: Responses, specimens: Arrays, values: Floats) -> None:
    """Raise if outputs of the last specimen change where the times of other outputs do.

    Every second time, the last one among them, moves halfway to the time before it.
    """
    finite = finite_runs(values)
    if responses.times is None or not finite.size or responses.repeats > 1:
        return
    row, arguments = finite[-1:], list(responses.inputs.arguments)
    times = arguments[responses.times]
    is_kept = np.arange(times.size)[::-1] % 2 == 1
    is_kept[0] = True
    arguments[responses.times] = np.where(is_kept, times, (times + np.roll(times, 1)) / 2)
    changed = copy.copy(responses)
    changed.inputs = copy.copy(responses.inputs)
    changed.inputs.arguments = tuple(arguments)
    try:
        again = changed._again(specimens, row)[0]
    except ResponseError:  # because the response takes listed values alone
        return
    first = values[row[0]]
    allowed = np.maximum(tolerance_of(values, 0.01), 1e-6 * np.abs(first))
    is_changed = is_kept & (np.abs(again - first) > allowed)
    if is_changed.any():
        k = int(is_changed.argmax())
        raise ResponseError(
            f"{responses.name}: got {first[k]:.6g} and {again[k]:.6g} at {times[k]:g}, "
            f"{_place_of_specimen(responses, specimens, row[0])} where other times change, "
            "expected outputs that depend on their own time alone, because specimens have "
            "different times; integrate on a grid of its own within the response, and return "
            "values at the times"
        )


def refuse_other_runs(settings: CallSettings, points: Points, values: Floats, tally: Tally) -> None:
    """Raise if a few of the runs, (n,) or (n, m), differ when they are computed again.

    They do if the response is random, or if it depends on the other specimens of a call.
    """

    def compute(rows: Indices) -> Floats:
        with unlimited():
            return computed_again(settings, points.at(rows), tally.copied())[0]

    share = 0.0 if isinstance(settings.function, scalar) else 0.01
    change = changed_run(values, compute, share, may_fail=True, n_random=len(values) // 32)
    if change is not None:
        row, again = change
        raise ResponseError(
            f"{settings.name}: got {numbers_text(values[row])} and {numbers_text(again)} from the "
            f"response with inputs {inputs_text(settings, points, row)}, expected the "
            "same: it is random, or depends on the other specimens of a call; fix its random seed "
            "or state, or write it for one specimen, in prb.scalar"
        )


def _equal(first: Arrays, second: Arrays) -> bool:
    pairs = zip(first, second, strict=True)
    return all(np.array_equal(a, b, equal_nan=True) for a, b in pairs)


def deduplicated_responses(
    responses: Responses, points: Arrays, stored: tuple[Arrays, Floats] | None
) -> Floats:
    """Return the responses at points (n, *event), (n,) or (n, m); equal points are computed once.

    ``stored`` is a pair of points and their responses, which are not computed again.
    """
    n = len(points[0])
    stored_points, stored_values = (
        ([x[:0] for x in points], np.empty(0)) if stored is None else stored
    )
    m = len(stored_values)
    # Compare points by the bits of all their numbers; adding zero turns -0.0 into 0.0.
    columns = [np.concatenate([x[:m], y]) for x, y in zip(stored_points, points, strict=True)]
    columns = [x.reshape(m + n, math.prod(x.shape[1:])) for x in columns]
    bits = np.concatenate(columns, axis=1, dtype=np.float64) + 0.0
    keys = bits.view(np.dtype((np.void, bits.dtype.itemsize * bits.shape[1]))).ravel()
    _, first, which = np.unique(keys, return_index=True, return_inverse=True)
    earliest = first[which]
    is_new = earliest[m:] == np.arange(m, m + n)
    if is_new.all():
        with responses.kept_runs():
            return responses(points, [])
    new = np.flatnonzero(is_new)
    with responses.kept_runs():
        computed = responses([x[new] for x in points], []) if new.size else stored_values[:0]
    values = np.full((m + n, *computed.shape[1:]), np.nan)
    values[:m] = stored_values.reshape(m, *computed.shape[1:])
    values[m + new] = computed
    responses.count_reused(n - new.size)
    return values[earliest[m:]]
