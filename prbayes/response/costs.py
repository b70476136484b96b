"""What a study asks of its responses before it begins, as records that read as sentences."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil

import numpy as np


@dataclass(frozen=True)
class Demand:
    """Runs that a propagation asks for after the first ones."""

    each: int  # for each value of the hyperparameters
    most: int | None  # in all; None where it sets no limit
    decides: str  # what decides whether more are made, in words


@dataclass(frozen=True)
class DryRun:
    """One specimen that was run."""

    inputs: tuple[float, ...]  # all numbers that went in, constants included
    outputs: dict[str, float]  # by name
    seconds: float


@dataclass(frozen=True)
class SimulatorCost:
    """Runs of one simulator."""

    name: str
    propagation: str
    first: int  # runs that are needed at first
    known: int  # of those, computed before: in the store, or in this session
    demand: Demand  # what is needed later
    workers: int  # that compute at a time
    dry_run: DryRun | None = None

    @property
    def missing(self) -> int:
        """Runs that are computed at first."""
        return self.first - self.known

    def seconds_of(self, runs: int) -> float:
        """Return the seconds that runs take on all workers, NaN as long as none was made."""
        if self.dry_run is None:
            return np.nan
        return ceil(runs / self.workers) * self.dry_run.seconds

    def __str__(self) -> str:
        """Return what is needed, as lines."""
        workers = "one at a time" if self.workers == 1 else f"{self.workers} at a time"
        first = f"{self.first} runs, {self.known} of them known: {self.missing} to compute"
        each = f"{self.demand.each} runs" if self.demand.each else "no run"
        lines = [
            f"{self.name}: {self.propagation}",
            f"  at first: {first}, {workers}",
            f"  for each value of the hyperparameters: {each}",
            f"  more: {self.demand.decides}",
        ]
        tried = self.dry_run
        if tried is not None:
            given = ", ".join(f"{x:.6g}" for x in tried.inputs)
            found = ", ".join(f"{name} = {value:.6g}" for name, value in tried.outputs.items())
            lines.append(f"  dry run: at ({given}) {found}, in {in_words(tried.seconds)}")
            later = ""
            if self.demand.each:
                spent = in_words(self.seconds_of(self.demand.each))
                later = f", {spent} for each value of the hyperparameters"
            at_first = in_words(self.seconds_of(self.missing))
            lines.append(f"  estimated: {at_first} at first{later}")
        return "\n".join(lines)


@dataclass(frozen=True)
class Cost:
    """What the simulators of a model need; see `cost`.

    Attributes
    ----------
    simulators : tuple
        Of each: ``name``, ``propagation``, ``first`` and ``known`` runs, those that are
        ``missing``, ``demand`` (``each``, ``most`` and ``decides``), ``workers`` and ``dry_run``
        (``inputs``, ``outputs`` and ``seconds``; None without one).
    """

    simulators: tuple[SimulatorCost, ...]

    @property
    def runs(self) -> int:
        """Runs that are computed at first, of all simulators."""
        return sum(each.missing for each in self.simulators)

    @property
    def runs_each(self) -> int:
        """Runs for each value of the hyperparameters, of all simulators."""
        return sum(each.demand.each for each in self.simulators)

    @property
    def seconds(self) -> float:
        """Estimated seconds of the first runs, NaN without a dry run."""
        return sum(each.seconds_of(each.missing) for each in self.simulators)

    def __repr__(self) -> str:
        """Return what is needed, simulator by simulator."""
        return "\n".join(map(str, self.simulators))


def in_words(seconds: float) -> str:
    """Return a time as one tells it."""
    for size, unit in ((86400.0, "days"), (3600.0, "h"), (60.0, "min")):
        if seconds >= 2 * size:  # below, two digits of the smaller unit say more
            return f"{seconds / size:.1f} {unit}"
    return f"{seconds:.2g} s" if seconds < 10 else f"{seconds:.0f} s"
