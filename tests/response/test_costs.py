"""Costs as numbers and as sentences."""

from __future__ import annotations

import math

import pytest

import prbayes as prb
from prbayes.propagation.base import Propagation
from prbayes.response.costs import Cost, Demand, DryRun, SimulatorCost, in_words

TRIED = DryRun((2.0, 0.5), {"a": 1.25}, 30.0)
FIRST = SimulatorCost("y", "Reweighted(64)", 64, 10, Demand(0, 2048, "up to 2048"), 8, TRIED)
SECOND = SimulatorCost("z", "Fresh(50)", 16, 0, Demand(50, None, "as asked"), 1)


def test_runs_go_on_all_workers_and_the_last_round_counts() -> None:
    assert FIRST.missing == 54
    assert FIRST.seconds_of(54) == 7 * 30.0
    assert FIRST.seconds_of(56) == 7 * 30.0
    assert FIRST.seconds_of(57) == 8 * 30.0
    assert FIRST.seconds_of(0) == 0
    assert math.isnan(SECOND.seconds_of(3))


def test_simulators_add_up() -> None:
    both = Cost((FIRST, SECOND))
    assert (both.runs, both.runs_each) == (70, 50)
    assert math.isnan(both.seconds)
    assert Cost((FIRST, FIRST)).seconds == 2 * 210.0


def test_it_reads_as_sentences() -> None:
    assert repr(Cost((FIRST, SECOND))) == (
        "y: Reweighted(64)\n"
        "  at first: 64 runs, 10 of them known: 54 to compute, 8 at a time\n"
        "  for each value of the hyperparameters: no run\n"
        "  more: up to 2048\n"
        "  dry run: at (2, 0.5) a = 1.25, in 30 s\n"
        "  estimated: 3.5 min at first\n"
        "z: Fresh(50)\n"
        "  at first: 16 runs, 0 of them known: 16 to compute, one at a time\n"
        "  for each value of the hyperparameters: 50 runs\n"
        "  more: as asked"
    )
    each = SimulatorCost("z", "Fresh(50)", 16, 0, SECOND.demand, 4, TRIED)
    assert "  estimated: 2.0 min at first, 6.5 min for each value of the hy" in str(each)


@pytest.mark.parametrize(
    ("seconds", "told"),
    [
        (0.0123, "0.012 s"),
        (9.4, "9.4 s"),
        (119.0, "119 s"),
        (120.0, "2.0 min"),
        (7199.0, "120.0 min"),
        (7200.0, "2.0 h"),
        (2e6, "23.1 days"),
    ],
)
def test_times_are_told_in_their_unit(seconds: float, told: str) -> None:
    assert in_words(seconds) == told


def test_propagations_say_what_they_ask_for() -> None:
    class Own(Propagation):
        bind = None  # type: ignore[assignment]

    assert (prb.Reweighted(64).demand.each, prb.Reweighted(64).demand.most) == (0, 2048)
    limited = prb.Reweighted(64, max_points=96).demand
    assert limited.most == 96
    assert limited.decides.startswith("up to 96 in all, ")
    assert (prb.Resimulated(50).demand.each, prb.Fresh(7).demand.each) == (50, 7)
    assert Own().demand == Demand(0, None, "as Own asks for them")
