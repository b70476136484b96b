"""Progress bars on stderr for long work."""

from __future__ import annotations

import logging
import sys
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
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from prbayes._validate import flag

_log = logging.getLogger("prbayes")

# Expected seconds from which a bar appears, because shorter work needs none.
_SHOWN_FROM = 2.0
# Seconds between lines of text if no bar can move, as in a log file.
_LINE_EVERY = 60.0

_hidden: ContextVar[bool] = ContextVar("hidden", default=False)


def _in_kernel() -> bool:
    """Return whether this is a process behind a notebook."""
    ipython = sys.modules.get("IPython")
    shell = None if ipython is None else ipython.get_ipython()
    return type(shell).__name__ == "ZMQInteractiveShell"


def _console() -> Console:
    """Return a console on stderr; in a notebook only with widgets, without which rich warns.

    A kernel without widgets is not treated as a terminal either, although its environment asks for
    colours, because each move of a bar would print a line.
    """
    if find_spec("ipywidgets") is not None:
        return Console(stderr=True)
    forced = False if _in_kernel() else None
    return Console(stderr=True, force_jupyter=False, force_terminal=forced)


CONSOLE = _console()  # a single console, so that an inner bar is drawn below an outer one


def live() -> bool:
    """Return whether a bar can move: in a terminal, or in a notebook with widgets."""
    return CONSOLE.is_terminal or CONSOLE.is_jupyter


def lines() -> Callable[[str], None]:
    """Return a function that prints a text at most once a minute, if no bar can move."""
    # A kernel without widgets, such as that of an executed page, prints nothing.
    silent = live() or _hidden.get() or _in_kernel()
    last = time.perf_counter()

    def write(text: str) -> None:
        nonlocal last
        now = time.perf_counter()
        if not silent and now - last >= _LINE_EVERY:
            last = now
            CONSOLE.print(text, markup=False, highlight=False, soft_wrap=True)

    return write


def announce(text: str, *, visible: bool) -> None:
    """Print a text above the bars of long work; log it where they are hidden or cannot move."""
    if visible and live() and not _hidden.get():
        CONSOLE.print(text, markup=False, highlight=False, soft_wrap=True)
    else:
        _log.info(text)


@contextmanager
def shown(visible: bool) -> Iterator[bool]:
    """Show inner bars only if ``visible`` here and in all outer calls; yield whether they show."""
    flag(visible, "progressbar")
    token = _hidden.set(_hidden.get() or not visible)
    try:
        yield not _hidden.get()
    finally:
        _hidden.reset(token)


@contextmanager
def progress(name: str, total: int | None = None) -> Iterator[Callable[[int, str], None]]:
    """Yield a function of (newly done, note) that shows a bar, called ``name``, for long work.

    The bar appears if more than two seconds are expected; without a ``total``, after two seconds.
    If no bar can move, a line is printed each minute.
    """
    of_total = "" if total is None else "/{task.total}"
    bar = Progress(
        TextColumn(name),
        BarColumn(),
        TextColumn(f"{{task.completed}}{of_total}"),
        TextColumn("{task.fields[note]}"),
        TimeElapsedColumn() if total is None else TimeRemainingColumn(),
        console=CONSOLE,
    )
    task = bar.add_task("", total=total, note="")
    clock = time.perf_counter()
    completed = 0
    write = lines()
    is_settled = _hidden.get() or not live()  # whether the bar is shown, or never will be

    def update(n: int, note: str) -> None:
        nonlocal completed, is_settled
        completed += n
        bar.update(task, advance=n, note=note)
        whole = "" if total is None else f"/{total}"
        write(f"{name} {completed}{whole} {note}".rstrip())
        elapsed = time.perf_counter() - clock
        if not is_settled and _expected(elapsed, completed, total) > _SHOWN_FROM:
            is_settled = True
            try:
                bar.start()
            except LiveError:  # older versions of rich draw one bar at a time
                _log.debug("%s: no second progress bar", name)

    try:
        yield update
    finally:
        if bar.live.is_started:  # stopping a hidden bar would print a line
            bar.stop()


def _expected(elapsed: float, completed: int, total: int | None) -> float:
    """Return the remaining seconds at the pace so far; without a total the elapsed ones."""
    return elapsed if total is None else elapsed * (total / max(completed, 1) - 1)
