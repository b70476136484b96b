"""Budgets of time and of responses: what is under way stops when one is spent.

A budget holds for all that happens inside `limited`, in this thread. It is asked before every chunk
of responses and every evaluation; what was begun is finished, and stored.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field

from prbayes._validate import positive_integer, positive_number


class BudgetError(RuntimeError):
    """A budget of time, responses or stages was spent before there was a result."""


@dataclass(eq=False)
class Budget:
    """What may be spent, and what was."""

    max_seconds: float | None = None
    max_runs: int | None = None
    begun: float = field(default_factory=time.perf_counter)
    computed: int = 0  # responses; those found in a store cost nothing
    spent: str = ""  # what was spent, in words; nothing goes on from then on

    def go_on(self) -> None:
        """Raise if it is spent."""
        seconds = time.perf_counter() - self.begun
        if not self.spent and self.max_seconds is not None and seconds > self.max_seconds:
            self.spent = f"max_seconds = {self.max_seconds:g} was reached"
        if self.spent:
            raise BudgetError(self.spent)

    def grant(self, wanted: int, least: int) -> int:
        """Return how many of so many responses may be computed, or raise if fewer than the least.

        They count as computed.
        """
        self.go_on()
        if self.max_runs is None:
            return wanted
        granted = min(wanted, self.max_runs - self.computed)
        if granted < least:
            self.spent = f"max_runs = {self.max_runs} was reached"
            raise BudgetError(self.spent)
        self.computed += granted
        return granted


_at_work: ContextVar[Budget] = ContextVar("budget")
_NONE = Budget()


def budget() -> Budget:
    """Return the budget that holds here; one without limits by default."""
    return _at_work.get(_NONE)


@contextmanager
def limited(max_seconds: float | None, max_runs: int | None) -> Iterator[None]:
    """Stop what happens inside, by `BudgetError`, when a budget is spent.

    Raises
    ------
    TypeError, ValueError
        If one is no positive number.
    """
    if max_seconds is not None:
        positive_number(max_seconds, "max_seconds")
    if max_runs is not None:
        positive_integer(max_runs, "max_runs")
    token = _at_work.set(Budget(max_seconds, max_runs))
    try:
        yield
    finally:
        _at_work.reset(token)


@contextmanager
def unlimited() -> Iterator[None]:
    """Let what costs no response be finished after a budget was spent."""
    with limited(None, None):
        yield
