"""Linear algebra in one thread."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from threading import Lock
from typing import Any

# The number of threads is global: a second caller does not change it.
_setting = Lock()


@cache
def _algebra() -> Any:
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController().select(user_api="blas")


@contextmanager
def one_thread() -> Iterator[None]:
    """Do linear algebra in one thread, inside or in the function that this decorates.

    Several gain little on matrices of a few hundred rows, and take ten times as long on a busy
    machine.
    """
    if not _setting.acquire(blocking=False):
        yield
        return
    try:
        with _algebra().limit(limits=1):
            yield
    finally:
        _setting.release()
