"""The user's response: a function, its inputs, and how it is called; shapes and counts."""

from __future__ import annotations

import copy
import inspect
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from pytensor.graph.basic import Variable

from prbayes._finding import report
from prbayes._validate import Floats, called, executes, folder_path
from prbayes.response.batch_consistency import refuse_mixing
from prbayes.response.broadcasting import batch_shape, broadcast_batch
from prbayes.response.budget import budget
from prbayes.response.call import (
    Calling,
    Points,
    Tally,
    checked,
    respond,
    scalar,
    shapes,
)
from prbayes.response.discrepancy import findings_of
from prbayes.response.executors import capacity
from prbayes.response.failures import Abort, Failure, OnFailure, ResponseError
from prbayes.response.inputs import Inputs
from prbayes.response.outputs import ONE, Outputs, outputs_of_result
from prbayes.response.store import Store


def refuse_uncallable(name: str, function: object) -> None:
    """Raise if a response is no function: often the inputs were given first."""
    if not callable(function) or isinstance(function, type):
        got = called(function) if isinstance(function, type) else type(function).__name__
        raise TypeError(
            f"{name}: response: got {got}, expected a function of the inputs, such as "
            "lambda x: x**2; the order is Simulator(name, response, *inputs, metric=..., "
            "observed=...)"
        )


def refuse_coarse(label: str, function: object) -> None:
    """Raise if a coarse response is no function."""
    if not callable(function) or isinstance(function, type):
        raise TypeError(
            f"{label}: got {called(function)}, expected a function of the same inputs as the "
            "response"
        )


def refuse_misfit(
    name: str, function: object, sizes: Callable[[], list[int]], outputs: Outputs | None
) -> None:
    """Raise if a function of one specimen says that it takes other inputs, or gives other outputs.

    Those that know it have a method of this name; nothing is computed yet.
    """
    refuse = getattr(getattr(function, "function", None), "refuse_misfit", None)
    if refuse is not None:
        refuse(name, sizes(), outputs)


def refuse_other_number(name: str, function: object, inputs: Inputs) -> None:
    """Raise if a function says that it takes more or fewer arguments than there are inputs."""
    own: Any = function.function if isinstance(function, scalar) else function
    try:
        # Of a decorated function: what it takes itself.
        signature = inspect.signature(own, follow_wrapped=False)
    except (TypeError, ValueError):
        return
    try:
        signature.bind(*inputs.arguments)
    except TypeError as error:
        raise TypeError(
            f"{name}: response: got inputs of {_sizes(inputs)} numbers for "
            f"a function of {signature} ({error}), expected an input for each argument; a "
            "multivariate input is one argument, an array with an axis for its elements"
        ) from None


def refuse_calling(executor: object, store: object, version: object, on_failure: object) -> None:
    """Raise if one of the arguments that say how a response is called is not of its kind."""
    executes(executor, "executor")
    if store is not None:
        folder_path(store, "store")
    refuse_version(version)
    if not isinstance(on_failure, OnFailure):
        raise TypeError(
            f"on_failure: got {called(on_failure)}, expected prb.response.Abort(), "
            "prb.response.Replace() or prb.response.Retry()"
        )


def refuse_version(version: object) -> None:
    """Raise if a version is no text, or an empty one."""
    if version is not None and (not isinstance(version, str) or not version):
        raise TypeError(
            f"version: got {type(version).__name__} {version!r:.60}, expected a text that names "
            "the response as it is, such as '2' or 'mesh 3, solver 1.4'"
        )


@dataclass
class Runs:
    """Runs of a response that several simulators share, which have the same inputs and settings."""

    # Batches of stored points, each (n, *event) for each aleatory input, and their responses,
    # (n,) or (n, m).
    stored: list[tuple[list[Floats], Floats]] = field(default_factory=list)
    # What the response was called with last, and what it gave.
    last: tuple[list[Floats], Floats] | None = None
    several: bool = False  # whether there is more than one simulator

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "last": None}

    def at(self, points: Sequence[Floats]) -> Floats | None:
        """Return the responses of a batch that is stored, (n,) or (n, m), None if it is not."""
        return next((values for known, values in self.stored if _alike(known, points)), None)

    def repeated(self, given: list[Floats]) -> Floats | None:
        """Return what the last call gave if another simulator's was the same, else None."""
        if not self.several or self.last is None or not _alike(self.last[0], given):
            return None
        return self.last[1].copy()

    def note(self, given: list[Floats], found: Floats) -> None:
        """Keep a call for the simulator that comes next; of one simulator only a small one."""
        if self.several or found.size <= _TRIAL:
            self.last = [x.copy() for x in given], found.copy()
        else:
            self.last = None


# Responses of a call that is kept before another simulator is there: the trial at some points of
# the prior, which both of them make.
_TRIAL = 64


class Responses:
    """The user's response: a function of inputs, and how it is called.

    A function that takes whole batches, with nothing else asked for, is called once for each batch
    (``plain``). Every other goes through `respond`: on an executor, in chunks, with a store and a
    failure policy.

    Parameters
    ----------
    name : str
        Name of the simulator, for messages.
    function : callable or scalar
        ``function(*inputs)``, one array per input, any leading batch shape.
    inputs : Inputs
    executor : concurrent.futures.Executor, optional
    store : path-like, optional
        A folder.
    version : str, optional
        Of the function, for the store.
    on_failure : OnFailure, optional
    retry_failed : bool
    timeout : float, optional
        Seconds.
    outputs : Outputs, optional
        What a run gives; one number by default, and with None whatever it does.

    Attributes
    ----------
    count : int
        Runs that were needed so far, whether computed here or found in the store.
    scatters : bool or None
        Whether the response has different values at the same point; None while it is not known.
    on_start : callable or None
        ``on_start(runs, seconds)``, called with the number of runs that a call takes, and the time
        of one of them as soon as it is known: NaN before a function is called for a whole batch.
    """

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
        outputs: Outputs | None = ONE,
    ) -> None:
        refuse_uncallable(name, function)
        refuse_other_number(name, function, inputs)
        refuse_misfit(name, function, partial(_sizes, inputs), outputs)
        report(*findings_of(function))
        policy = Abort() if on_failure is None else on_failure
        kept = None
        if store is not None:
            size = None if outputs is None else max(1, len(outputs.labels))
            named = _with_names(version, outputs)
            kept = Store(store, name, columns=_columns(inputs), version=named, outputs=size)
        self.name = name
        self.outputs = outputs
        self.function = function
        self.inputs = inputs
        self.plain = (
            executor is None
            and store is None
            and policy == Abort()
            and not isinstance(function, scalar)
        )
        self.count = 0
        self.scatters: bool | None = None
        self.on_start: Callable[[int, float], None] | None = None
        self._looked = False  # whether specimens are computed by themselves
        self._found = 0
        self.runs = Runs()
        self._calling = Calling(
            name, function, executor, kept, policy, retry_failed, timeout, outputs
        )
        self._tally = Tally()
        self._event_ndims = [*inputs.event_ndims, *(e.type.ndim for e in inputs.epistemic)]

    def copied(self) -> Responses:
        """Return the same function with counts of its own; executor and store are the same."""
        other = copy.copy(self)
        other._tally = self._tally.copied()
        # What is known stays known; what is computed from here on is each one's own.
        other.runs = Runs(list(self.runs.stored))
        return other

    def share(self, other: Responses) -> None:
        """Compute nothing that another one of the same response, inputs and settings has."""
        self.runs = other.runs
        self.runs.several = True

    @property
    def computed(self) -> int:
        """Responses computed here: without those found in a store, with those tried again."""
        return self.count - self._found if self.plain else self._tally.computed

    @property
    def failures(self) -> int:
        """Points whose response failed and was replaced."""
        return self._tally.failures

    @property
    def replacement(self) -> float:
        """What takes the place of a response that failed; NaN if nothing does."""
        value = self._calling.on_failure.final.replacement
        return np.nan if value is None else float(value)

    @property
    def failed(self) -> tuple[Failure, ...]:
        """The points that failed, each once, with their reasons; the first ten thousand."""
        return tuple(self._tally.failed.values())

    @property
    def workers(self) -> int:
        """How many compute at a time."""
        return capacity(self._calling.executor).workers

    @property
    def folder(self) -> Path | None:
        """Where responses are stored."""
        return None if self._calling.store is None else self._calling.store.folder

    def same_as(self, other: Responses) -> bool:
        """Return whether another has the same function, inputs and constants, and output order."""
        mine = self.inputs.arguments
        others = other.inputs.arguments
        if self.function is not other.function or len(mine) != len(others):
            return False
        # A mapping's arrays are put together in the order of what was observed.
        known = [each.outputs.keys for each in (self, other) if each.outputs is not None]
        if len(set(known)) > 1:
            return False
        pairs = zip(mine, others, strict=True)
        return all(_same(self.inputs, x, other.inputs, y) for x, y in pairs)

    def __call__(self, aleatory: Sequence[Floats], epistemic: Sequence[Floats]) -> Floats:
        """Return responses, (...) or (..., m), for values of the inputs, shapes (..., *event).

        Raises
        ------
        ResponseError
            If the response raises, or if its result is not real numbers in the batch shape.
        """
        given = [np.asarray(v, dtype=np.float64) for v in (*aleatory, *epistemic)]
        known = self.runs.repeated(given)
        if known is not None:
            self.find(known.size)
            return known
        found = self._computed(given)
        self.runs.note(given, found)
        return found

    def alone(self, aleatory: Sequence[Floats]) -> Floats:
        """Compute one specimen by itself, (1, *event) by input; no run, and not in the store."""
        given = [np.asarray(v, dtype=np.float64) for v in aleatory]
        if self.plain:
            return self._at_once(self._filled(given), (1,), counted=False)
        _, points = self._rows(given)
        return respond(replace(self._calling, store=None), points, self._tally.copied())

    def _computed(self, given: list[Floats]) -> Floats:
        """Call the function for values of the inputs."""
        if self.plain:
            batch = batch_shape(given, self._event_ndims)
            values = broadcast_batch(given, self._event_ndims, batch)
            size = int(np.prod(batch, dtype=int))
            self._started(size, np.nan)
            clock = time.perf_counter()
            found = self._at_once(self._filled(values), batch)
            self._started(size, (time.perf_counter() - clock) / max(1, size))
            self._refuse_mixing(values, batch, found)
            return found
        batch, points = self._rows(given)
        self.count += len(points)
        found = respond(self._calling, points, self._tally, self._started)
        if self.outputs is None:
            self.outputs = self._tally.named
        return found.reshape(batch + found.shape[1:])

    def _started(self, runs: int, seconds: float) -> None:
        if self.on_start is not None:
            self.on_start(runs, seconds)

    def _refuse_mixing(self, values: list[Floats], batch: tuple[int, ...], found: Floats) -> None:
        """Raise if what is computed for a batch is another thing by itself; looked at once."""
        if self._looked or int(np.prod(batch, dtype=int)) < 2 or not batch:
            return
        self._looked = True

        def alone(place: tuple[int, ...]) -> Floats:
            one = [np.array(v[place])[None] for v in values]
            return self._at_once(self._filled(one), (1,), counted=False)

        refuse_mixing(self.name, batch, found, alone)

    def _rows(self, given: list[Floats]) -> tuple[tuple[int, ...], Points]:
        """Return the batch shape of values of the inputs, and their points, each a row."""
        batch = batch_shape(given, self._event_ndims)
        values = broadcast_batch(given, self._event_ndims, batch)
        n = int(np.prod(batch, dtype=int))
        flat = [v.reshape(n, *v.shape[len(batch) :]) for v in values]
        varying = [isinstance(a, int | Variable) for a in self.inputs.arguments]
        return batch, Points(self._filled(flat), varying)

    def count_symbolic(self, size: int) -> None:
        """Count responses that are computed in a graph."""
        budget().grant(size, least=size)
        self.count += size

    def find(self, size: int) -> None:
        """Count responses that were known and are needed again."""
        self.count += size
        self._found += size

    def _filled(self, values: Sequence[Floats]) -> list[Any]:
        """Return the function's arguments from values of aleatory, then epistemic inputs."""
        k = len(self.inputs.aleatory)
        return self.inputs.fill(values[:k], values[k:])

    def _at_once(
        self, arguments: Sequence[Any], batch: tuple[int, ...], *, counted: bool = True
    ) -> Floats:
        """Call the function once for a batch of any shape."""
        size = int(np.prod(batch, dtype=int)) if counted else 0
        budget().grant(size, least=size)
        try:
            with np.errstate(all="ignore"):
                result = self.function(*arguments)
        except (Exception, SystemExit) as error:
            raise ResponseError(
                f"{self.name}: the response raised {type(error).__name__}: {error}; it was called "
                f"with inputs of shapes {shapes(arguments)} and is expected to take arrays of any "
                "leading shape, or to be wrapped in prb.scalar"
            ) from error
        self.count += size
        if self.outputs is None and isinstance(result, Mapping):
            self.outputs = outputs_of_result(result, len(batch))
        try:
            return checked(result, batch, arguments, self.outputs)
        except ResponseError as error:
            raise ResponseError(f"{self.name}: {error}") from None


def _with_names(version: str | None, outputs: Outputs | None) -> str | None:
    """Return a version with the names of the outputs: in another order they are other numbers.

    Without a version a stored response is computed again, and tells.
    """
    if version is None or outputs is None or not outputs.keys:
        return version
    return f"{version} ({', '.join(outputs.names)})"


def _columns(inputs: Inputs) -> int:
    """Return of how many numbers the inputs of one point are made, constants included."""
    # One that stands for several arguments counts once for each.
    return sum(_sizes(inputs))


def _sizes(inputs: Inputs) -> list[int]:
    """Return of how many numbers each argument of one point is made."""
    sizes = []
    for argument in inputs.arguments:
        if isinstance(argument, int):
            shape = inputs.event_shapes[argument]
        elif isinstance(argument, Variable):
            shape = argument.shape.eval() if argument.type.ndim else ()
        else:
            shape = np.shape(argument)
        sizes.append(int(np.prod(shape, dtype=int)))
    return sizes


def _same(inputs: Inputs, x: Any, others: Inputs, y: Any) -> bool:
    """Return whether arguments of two responses are the same input, or equal constants."""
    if isinstance(x, int) or isinstance(y, int):
        both = isinstance(x, int) and isinstance(y, int)
        return both and inputs.aleatory[x] is others.aleatory[y]
    if isinstance(x, Variable) or isinstance(y, Variable):
        return x is y
    return np.array_equal(x, y)


def _alike(some: Sequence[Floats], others: Sequence[Floats]) -> bool:
    """Return whether arrays are the same, one by one."""
    pairs = zip(some, others, strict=True)
    return all(np.array_equal(a, b, equal_nan=True) for a, b in pairs)
