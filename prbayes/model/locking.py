"""Threads that work on one model take turns.

Designs grow, epsilons are set for a run, random draws are counted, and compiled functions have one
memory: what two threads did to a model at once would be wrong. The second waits for the first.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import wraps
from threading import Lock, RLock
from typing import Any
from weakref import WeakKeyDictionary

import pymc as pm

_locks: WeakKeyDictionary[Any, Any] = WeakKeyDictionary()
_guard = Lock()


def in_turn[**P, T](function: Callable[P, T]) -> Callable[P, T]:
    """Make a function wait until no other thread is inside another such one on the same model.

    The model is among its arguments, or that of one of them, or the one on the context.
    """

    @wraps(function)
    def after_others(*arguments: P.args, **keywords: P.kwargs) -> T:
        found = {id(m): m for value in (*arguments, *keywords.values()) for m in _models(value)}
        if not found:
            context = pm.Model.get_context(error_if_none=False)
            found = {} if context is None else {id(context.root): context.root}
        with ExitStack() as turns:
            # In one order, so that no two threads wait for each other.
            for _, model in sorted(found.items()):
                turns.enter_context(lock(model))
            return function(*arguments, **keywords)

    return after_others


def _models(value: Any) -> Iterator[pm.Model]:
    """Yield the model that an argument is, or that it was made from."""
    if isinstance(value, pm.Model):
        yield value.root
    elif isinstance(value, dict):
        for each in value.values():
            yield from _models(each)
    else:
        optimum = getattr(value, "optimum", value)
        model = getattr(optimum, "model", None)
        if isinstance(model, pm.Model):
            yield model.root


def lock(owner: object) -> Any:
    """Return the lock of a model, or of a simulator, which lives as long as that."""
    with _guard:
        return _locks.setdefault(owner, RLock())
