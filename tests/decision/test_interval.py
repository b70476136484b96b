"""Inputs that are intervals."""

import pytest

import prbayes as prb
from prbayes.decision.interval import intervals, told_places, variants

TWO = [prb.decision.Interval(1, 2), "x", prb.decision.Interval(-1, 1)]


def test_every_combination_with_the_ends() -> None:
    found = variants(TWO, 3)
    assert len(found) == 9
    assert {(1.0, "x", -1.0), (1.5, "x", 0.0), (2.0, "x", 1.0)} <= set(found)
    assert variants(["x", 2.6], 3) == [("x", 2.6)]
    assert intervals(TWO) == 2
    assert told_places(TWO, found[-1]) == "2, 1"


def test_no_interval_is_refused() -> None:
    with pytest.raises(ValueError, match=r"high: got 1 with low = 1, expected more"):
        prb.decision.Interval(1, 1)
