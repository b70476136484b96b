"""Progress bars on stderr, for work that turns out to be long."""

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
    ProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from prbayes._validate import flag

_log = logging.getLogger("prbayes")

# Expected seconds from which there is a bar. By judgement: as long as one waits without wondering.
_SHOWN_FROM = 2.0
# Seconds between lines where no bar can move. By judgement: a log of a night is not all bars.
_LINE_EVERY = 60.0


def _in_kernel() -> bool:
    """Return whether this is a process behind a notebook."""
    ipython = sys.modules.get("IPython")
    shell = None if ipython is None else ipython.get_ipython()
    return type(shell).__name__ == "ZMQInteractiveShell"


def _console() -> Console:
    """Return a console on stderr; one of a notebook only with widgets, without which rich warns.

    A kernel without widgets is no terminal either, although its environment asks for colours: each
    move of a bar would be a line.
    """
    if find_spec("ipywidgets") is not None:
        return Console(stderr=True)
    forced = False if _in_kernel() else None
    return Console(stderr=True, force_jupyter=False, force_terminal=forced)


CONSOLE = _console()  # one for all, so that a bar inside another is drawn below it


def live() -> bool:
    """Return whether a bar can move: in a terminal, or in a notebook with widgets.

    Elsewhere, as in a log or an executed page, it would be a line of its last state.
    """
    return CONSOLE.is_terminal or CONSOLE.is_jupyter


def lines() -> Callable[[str], None]:
    """Return a function that writes a text where no bar can move, as in a log, once in a minute.

    In a notebook without widgets, such as an executed page, it writes nothing.
    """
    silent = live() or _hidden.get() or _in_kernel()
    last = time.perf_counter()

    def write(text: str) -> None:
        nonlocal last
        now = time.perf_counter()
        if not silent and now - last >= _LINE_EVERY:
            last = now
            CONSOLE.print(text, markup=False, highlight=False, soft_wrap=True)

    return write


_hidden: ContextVar[bool] = ContextVar("hidden", default=False)


@contextmanager
def shown(visible: bool) -> Iterator[bool]:
    """Show bars inside only if ``visible`` here and in all outer calls; gives whether they show."""
    flag(visible, "progressbar")
    token = _hidden.set(_hidden.get() or not visible)
    try:
        yield not _hidden.get()
    finally:
        _hidden.reset(token)


@contextmanager
def progress(what: str, total: int | None = None) -> Iterator[Callable[[int, str], None]]:
    """Give a function (done, note) to be called as work gets done; only long work shows a bar.

    The bar appears when two seconds are expected. Without a total nothing is known of what is left,
    and it appears when two seconds have passed. Where no bar can move there is a line each minute.

    Parameters
    ----------
    what : str
        Stands before the bar.
    total : int, optional
        How much work there is, in the units of ``done``.
    """
    bar = Progress(*_columns(what, total), console=CONSOLE)
    task = bar.add_task("", total=total, note="")
    clock = time.perf_counter()
    completed = 0
    of_total = "" if total is None else f"/{total}"
    write = lines()
    settled = _hidden.get() or not live()  # whether there is a bar, or never will be

    def advance(done: int, note: str) -> None:
        nonlocal completed, settled
        completed += done
        bar.update(task, advance=done, note=note)
        write(f"{what} {completed}{of_total} {note}".rstrip())
        elapsed = time.perf_counter() - clock
        if not settled and _expected(elapsed, completed, total) > _SHOWN_FROM:
            settled = True
            _start(bar, what)

    try:
        yield advance
    finally:
        if bar.live.is_started:  # else a line would be printed where there is no terminal
            bar.stop()


def _columns(what: str, total: int | None) -> list[ProgressColumn]:
    """Return what stands beside each other in a bar's line."""
    name = TextColumn(what)
    note = TextColumn("{task.fields[note]}")
    if total is None:
        done = TextColumn("{task.completed}")
        return [name, BarColumn(), done, note, TimeElapsedColumn()]
    done = TextColumn("{task.completed}/{task.total}")
    return [name, BarColumn(), done, note, TimeRemainingColumn()]


def _expected(elapsed: float, completed: int, total: int | None) -> float:
    """Return the seconds that are left at the pace so far; those passed without a total."""
    if total is None:
        return elapsed
    left = total / max(completed, 1) - 1
    return elapsed * left


def _start(bar: Progress, what: str) -> None:
    """Show a bar, unless there is one already and this version of rich draws one at a time."""
    try:
        bar.start()
    except LiveError:
        _log.debug("%s: no second progress bar", what)
