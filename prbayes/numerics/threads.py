"""Linear algebra in one thread, where several would wait for each other."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from threading import Lock
from typing import Any

# The number of threads is one for the whole process: whoever comes second leaves it alone.
_setting = Lock()


@cache
def _algebra() -> Any:
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController().select(user_api="blas")


@contextmanager
def one_thread() -> Iterator[None]:
    """Do linear algebra in one thread, inside or in the function that this decorates.

    Several gain little on matrices of a few hundred rows, and take ten times as long where
    something else computes as well.
    """
    if not _setting.acquire(blocking=False):
        yield
        return
    try:
        with _algebra().limit(limits=1):
            yield
    finally:
        _setting.release()
