"""Locks of models: one thread at a time works on a model, the next one waits.

Designs grow, epsilons are set for a run, and compiled functions have one memory.
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


def lock(owner: object) -> Any:
    """Return the lock of a model, or of a simulator, which lives as long as its owner."""
    with _guard:
        return _locks.setdefault(owner, RLock())


def locked[**P, T](function: Callable[P, T]) -> Callable[P, T]:
    """Make a function lock the models of its arguments, or else the model on the context."""

    @wraps(function)
    def with_locks(*arguments: P.args, **keywords: P.kwargs) -> T:
        models = {id(m): m for value in (*arguments, *keywords.values()) for m in _models(value)}
        context = pm.Model.get_context(error_if_none=False)
        if not models and context is not None:
            models = {id(context.root): context.root}
        with ExitStack() as stack:
            # Models are locked in a fixed order, so that threads cannot deadlock.
            for _, model in sorted(models.items()):
                stack.enter_context(lock(model))
            return function(*arguments, **keywords)

    return with_locks


def _models(value: Any) -> Iterator[pm.Model]:
    """Yield the models of an argument: a model, a result, an optimum, or a dict of these."""
    if isinstance(value, dict):
        for element in value.values():
            yield from _models(element)
        return
    result = getattr(value, "optimum", value)
    model = value if isinstance(value, pm.Model) else getattr(result, "model", None)
    if isinstance(model, pm.Model):
        yield model.root
