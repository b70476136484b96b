"""Linear algebra in one thread."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from threading import Lock
from typing import Any

# lock of the number of threads, which is global: a second caller does not change it
_setting = Lock()
# controller of the libraries of linear algebra, once they are loaded
_libraries: list[Any] = []


@contextmanager
def one_thread() -> Iterator[None]:
    """Do linear algebra in one thread, as several are ten times slower on a busy machine."""
    if not _setting.acquire(blocking=False):
        yield
        return
    try:
        if not _libraries:
            from threadpoolctl import ThreadpoolController

            _libraries.append(ThreadpoolController().select(user_api="blas"))
        with _libraries[0].limit(limits=1):
            yield
    finally:
        _setting.release()
