"""Runs of the response: what they cost, and budgets that end a calculation.

A budget applies to everything inside `limited` in this thread. It is checked before every chunk of
responses and every evaluation. Runs that have begun are finished and stored.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from prbayes._display import Shown, View, without_constructor
from prbayes._validate import positive_integer, positive_number


class BudgetError(RuntimeError):
    """A budget of time, responses or stages was spent before there was a result."""


@dataclass(eq=False)
class Budget:
    """Limits on time and runs, and what was spent of them."""

    max_seconds: float | None = None
    max_runs: int | None = None
    start: float = field(default_factory=time.perf_counter)
    computed: int = 0  # number of computed responses; those found in a store cost nothing
    spent: str = ""  # reason why the budget is spent, as a clause; it never changes again

    @property
    def is_limited(self) -> bool:
        """Whether there is a limit."""
        return self.max_seconds is not None or self.max_runs is not None

    def check(self) -> None:
        """Raise if the budget is spent."""
        seconds = time.perf_counter() - self.start
        if not self.spent and self.max_seconds is not None and seconds > self.max_seconds:
            self.spent = f"max_seconds = {self.max_seconds:g} was reached"
        if self.spent:
            raise BudgetError(self.spent)

    def grant(self, runs: int, least: int) -> int:
        """Return how many of the runs may be computed, and count them; raise below ``least``."""
        self.check()
        if self.max_runs is None:
            return runs
        granted = min(runs, self.max_runs - self.computed)
        if granted < least:
            self.spent = f"max_runs = {self.max_runs} was reached"
            raise BudgetError(self.spent)
        self.computed += granted
        return granted


_current: ContextVar[Budget] = ContextVar("budget", default=Budget())  # noqa: B039 (no limits)
budget = _current.get  # returns the current budget


@contextmanager
def limited(max_seconds: float | None, max_runs: int | None) -> Iterator[None]:
    """Limit the time and runs of the block; a spent budget raises `BudgetError`."""
    if max_seconds is not None:
        positive_number(max_seconds, "max_seconds")
    if max_runs is not None:
        positive_integer(max_runs, "max_runs")
    token = _current.set(Budget(max_seconds, max_runs))
    try:
        yield
    finally:
        _current.reset(token)


# Suspends the budget in a block, for work that costs no response.
unlimited = partial(limited, None, None)


def lift() -> None:
    """Suspend the budget in the rest of a `limited` block, for work that costs no response."""
    _current.set(Budget())


@dataclass(frozen=True)
class RunCost:
    """Runs of the response that a propagation needs."""

    first: int  # number of runs at the first use of the model
    per_theta: int  # number of runs for each value of the hyperparameters
    most: int | None  # largest number of runs in all; None without a limit
    growth: str  # condition for more runs, as a clause


@dataclass(frozen=True)
class SimulatorCost:
    """Numbers of runs of one simulator: those that it needs, and those already computed."""

    name: str
    propagation: str
    needed: RunCost
    computed: int
    workers: int

    def __str__(self) -> str:
        """Return the cost as lines."""
        needed = self.needed
        workers = "one at a time" if self.workers == 1 else f"{self.workers} at a time"
        per_theta = f"{needed.per_theta} runs" if needed.per_theta else "no run"
        return (
            f"{self.name}: {self.propagation}\n"
            f"  at first: {needed.first} runs, {self.computed} of them computed, {workers}\n"
            f"  for each value of the hyperparameters: {per_theta}\n"
            f"  more: {needed.growth}"
        )


@without_constructor
@dataclass(frozen=True, repr=False)
class Cost(Shown):
    """Runs that the simulators of a model need; see `cost`.

    Attributes
    ----------
    simulators : tuple
        For each simulator: ``name``, ``propagation``, the ``needed`` runs (``first``,
        ``per_theta``, ``most`` and ``growth``), the number of ``computed`` runs, and ``workers``.

    Examples
    --------
    >>> import pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
    ...     y = prb.Simulator(
    ...         "y", lambda x: 2 * x, x, metric=prb.AreaMetric(), observed=[0.0, 2.0, 4.0]
    ...     )
    >>> prb.cost(model).runs
    1024
    """

    simulators: tuple[SimulatorCost, ...]

    @property
    def runs(self) -> int:
        """Runs that are computed at the first use, of all simulators."""
        return sum(cost.needed.first - cost.computed for cost in self.simulators)

    @property
    def runs_each(self) -> int:
        """Runs for each value of the hyperparameters, of all simulators."""
        return sum(cost.needed.per_theta for cost in self.simulators)

    def __repr__(self) -> str:
        """Return the costs of the simulators, one after the other."""
        return "\n".join(map(str, self.simulators))

    def to_dataframe(self) -> Any:
        """Return a row for each simulator."""
        import pandas as pd

        columns = ["simulator", "first", "computed", "per theta", "most", "workers"]
        rows = [
            (c.name, c.needed.first, c.computed, c.needed.per_theta, c.needed.most, c.workers)
            for c in self.simulators
        ]
        return pd.DataFrame(rows, columns=columns).set_index("simulator")

    def to_view(self) -> View:
        """Return a table of the costs, with a sentence for each simulator."""
        rows = [
            [str(name), *("no limit" if x is None else str(x) for x in numbers)]
            for name, *numbers in self.to_dataframe().astype(object).itertuples(name=None)
        ]
        header = ["", "runs at first", "computed", "for each theta", "at most", "workers"]
        sentences = [f"{c.name}: {c.propagation}; more: {c.needed.growth}" for c in self.simulators]
        return View(f"Cost: {self.runs} runs to compute at first", header, rows, sentences)


def duration(seconds: float) -> str:
    """Return a time as a text, in seconds, minutes, hours or days."""
    for size, unit in ((86400.0, "days"), (3600.0, "h"), (60.0, "min")):
        if seconds >= 2 * size:  # shorter times are more precise in the smaller unit
            return f"{seconds / size:.1f} {unit}"
    return f"{seconds:.2g} s" if seconds < 10 else f"{seconds:.0f} s"
