"""The user's response: shapes, checks, counting."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from typing import Any

import numpy as np
from pytensor.graph.basic import Variable

from prbayes._checks import Floats
from prbayes.response.calling import Caller, ResponseError, checked, scalar
from prbayes.response.failures import Abort, OnFailure
from prbayes.response.inputs import Inputs
from prbayes.response.store import Store


def refuse_uncallable(name: str, function: object) -> None:
    """Raise if a response is no function: often the inputs were given first."""
    if not callable(function):
        raise TypeError(
            f"{name}: response: got {type(function).__name__}, expected a function of the inputs, such as "
            "lambda x: x**2; the order is Simulator(name, response, *inputs, metric=..., observed=...)"
        )


class Responses:
    """The user's response function.

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
    on_failure : OnFailure, optional

    Attributes
    ----------
    count : int
        Scalar responses that were needed so far, whether computed here or found in the store.
    """

    def __init__(
        self,
        name: str,
        function: Callable[..., Any],
        inputs: Inputs,
        *,
        executor: Executor | None = None,
        store: Any = None,
        on_failure: OnFailure | None = None,
    ) -> None:
        refuse_uncallable(name, function)
        self.name = name
        self.function = function
        self.inputs = inputs
        # A function that takes whole batches, and nothing else asked for, is called once for each.
        self.plain = executor is store is None and not isinstance(function, scalar) and on_failure in (None, Abort())
        self._event_ndims = [*inputs.event_ndims, *(e.type.ndim for e in inputs.epistemic)]
        self._caller: Caller | None = None
        if not self.plain:
            kept = None if store is None else Store(store, name, self._columns())
            self._caller = Caller(name, function, executor, on_failure or Abort(), kept)
        self.count = 0

    def copied(self) -> Responses:
        """Return the same function with counts of its own; executor and store are the same."""
        other = copy.copy(self)
        other._caller = copy.copy(self._caller)
        return other

    def _columns(self) -> int:
        """Return of how many numbers the inputs of one point are made."""
        sizes = [int(np.prod(s, dtype=int)) for s in self.inputs.event_shapes]
        sizes += [int(np.prod(e.shape.eval() if e.type.ndim else (), dtype=int)) for e in self.inputs.epistemic]
        return sum(sizes) + sum(np.size(a) for a in self.inputs.arguments if not isinstance(a, int | Variable))

    @property
    def computed(self) -> int:
        """Scalar responses computed here: without those found in a store, with those computed again."""
        return self.count if self._caller is None else self._caller.count

    @property
    def failures(self) -> int:
        """Points whose response failed and was replaced."""
        return 0 if self._caller is None else self._caller.failures

    def same_as(self, other: Responses) -> bool:
        """Return whether another has the same function, aleatory inputs and constants."""
        a, b = self.inputs, other.inputs
        if self.function is not other.function or len(a.arguments) != len(b.arguments):
            return False
        pairs = list(zip(a.arguments, b.arguments, strict=True))
        return all(isinstance(x, int) is isinstance(y, int) and not isinstance(x, Variable) for x, y in pairs) and all(
            a.aleatory[x] is b.aleatory[y] if isinstance(x, int) else np.array_equal(x, y) for x, y in pairs
        )

    def __call__(self, aleatory: Sequence[Floats], epistemic: Sequence[Floats]) -> Floats:
        """Return responses, shape (...), for aleatory values (..., *event) and epistemic ones (..., *event).

        Raises
        ------
        ResponseError
            If the response raises, or if its result is not real numbers in the batch shape.
        """
        values = [np.asarray(v, dtype=np.float64) for v in (*aleatory, *epistemic)]
        leading = [v.shape[: v.ndim - e] for v, e in zip(values, self._event_ndims, strict=True)]
        batch = np.broadcast_shapes(*leading)
        full = [
            np.broadcast_to(v, batch + v.shape[v.ndim - e :]) for v, e in zip(values, self._event_ndims, strict=True)
        ]
        k = len(aleatory)
        if self._caller is not None:
            return self._call_each(full, k, batch)
        arguments = self.inputs.fill(full[:k], full[k:])
        try:
            with np.errstate(all="ignore"):
                result = self.function(*arguments)
        except Exception as error:
            shapes = ", ".join(str(np.shape(a)) for a in arguments)
            raise ResponseError(
                f"{self.name}: the response raised {type(error).__name__}: {error}; it was called with inputs of "
                f"shapes {shapes} and is expected to take arrays of any leading shape, or to be wrapped in prb.scalar"
            ) from error
        self.count += int(np.prod(batch, dtype=int))
        try:
            return checked(result, batch, arguments)
        except ResponseError as error:
            raise ResponseError(f"{self.name}: {error}") from None

    def _call_each(self, full: Sequence[Floats], k: int, batch: tuple[int, ...]) -> Floats:
        """Call through the executor, the store and the failure policy, with one leading axis."""
        n = int(np.prod(batch, dtype=int))
        flat = [v.reshape(n, *v.shape[len(batch) :]) for v in full]
        arguments = self.inputs.fill(flat[:k], flat[k:])
        varying = [isinstance(a, int | Variable) for a in self.inputs.arguments]
        keys = [
            (a if v else np.broadcast_to(a, (n, *np.shape(a)))).reshape(n, -1)
            for a, v in zip(arguments, varying, strict=True)
        ]
        assert self._caller is not None
        self.count += n
        return self._caller(arguments, varying, np.concatenate(keys, axis=1).astype(np.float64)).reshape(batch)
