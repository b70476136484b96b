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
    """Do linear algebra in one thread, as several are ten times slower on a busy machine."""
    if not _setting.acquire(blocking=False):
        yield
        return
    try:
        with _algebra().limit(limits=1):
            yield
    finally:
        _setting.release()
