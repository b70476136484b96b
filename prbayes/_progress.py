"""Progress bars on stderr, for work that turns out to be long."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from importlib.util import find_spec

from rich.console import Console
from rich.errors import LiveError
from rich.progress import (
    BarColumn,
    Progress,
    ProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

_log = logging.getLogger("prbayes")
_SHOWN_FROM = 2.0  # expected seconds from which there is a bar


def _console() -> Console:
    """Return a console on stderr, that of a notebook only where rich finds its widgets: it warns without them."""
    return Console(stderr=True, force_jupyter=None if find_spec("ipywidgets") else False)


CONSOLE = _console()  # one for all, so that a bar inside another is drawn below it

_hidden: ContextVar[bool] = ContextVar("hidden", default=False)


@contextmanager
def shown(visible: bool) -> Iterator[bool]:
    """Show no bars inside unless ``visible``, nor where an outer call shows none; gives which of the two it is."""
    token = _hidden.set(_hidden.get() or not visible)
    try:
        yield not _hidden.get()
    finally:
        _hidden.reset(token)


@contextmanager
def progress(what: str, total: int | None = None) -> Iterator[Callable[[int, str], None]]:
    """Give a function (done, note) to be called as work gets done; the bar appears when two seconds are expected.

    Without a total nothing is known of what is left, and the bar appears when two seconds have
    passed.
    """
    columns: list[ProgressColumn] = [TextColumn(what), BarColumn()]
    columns += [
        TextColumn("{task.completed}" if total is None else "{task.completed}/{task.total}")
    ]
    columns += [
        TextColumn("{task.fields[note]}"),
        TimeElapsedColumn() if total is None else TimeRemainingColumn(),
    ]
    bar = Progress(*columns, console=CONSOLE)
    task = bar.add_task("", total=total, note="")
    clock, completed, started = time.perf_counter(), 0, _hidden.get()

    def advance(done: int, note: str) -> None:
        nonlocal completed, started
        completed += done
        bar.update(task, advance=done, note=note)
        elapsed = time.perf_counter() - clock
        if (
            not started
            and (elapsed if total is None else elapsed * (total / max(completed, 1) - 1))
            > _SHOWN_FROM
        ):
            started = True
            try:
                bar.start()
            except LiveError:  # there is one already, and this version of rich draws one at a time
                _log.debug("%s: no second progress bar", what)

    try:
        yield advance
    finally:
        if bar.live.is_started:  # else a line would be printed where there is no terminal
            bar.stop()
