"""What would be computed of a response, and one specimen that is."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm
import pytest

import prbayes as prb
from prbayes.response.call import Tally, respond
from prbayes.response.dry_run import Rehearsal
from prbayes.response.inputs import read_inputs
from prbayes.response.response import Responses

X = np.array([5.0, 1.0, 3.0, 2.0, 40.0])
called: list[float] = []


def twice(x: float, c: float) -> float:
    called.append(x)
    if x == 3:
        raise ArithmeticError("too steep")
    return np.nan if x == 2 else 2 * x


@pytest.fixture
def made(tmp_path: Path) -> Any:
    def make(function: Any = twice, **keywords: Any) -> Rehearsal:
        with pm.Model() as model:
            x = pm.Normal.dist(pm.Normal("mu", 0, 1), 1.0)
            inputs = read_inputs("y", [x, 7.0], model)
        response = prb.scalar(function)
        return Rehearsal(Responses("y", response, inputs, version="1", **keywords))

    called.clear()
    return make


def asked(rehearsal: Rehearsal, x: Any = X) -> Any:
    return rehearsal.asked(lambda responses: responses([np.asarray(x)], []))


def test_what_is_asked_for_is_told_and_not_computed(made: Any) -> None:
    rehearsal = made()
    points = asked(rehearsal)
    np.testing.assert_array_equal(points.keys(), np.stack([X, np.full(5, 7.0)], axis=1))
    # A batch of several axes is as many points.
    assert len(asked(rehearsal, X[:4].reshape(2, 2))) == 4
    assert rehearsal.asked(lambda responses: None) is None
    assert not called


def test_the_specimen_in_the_middle_of_those_that_are_missing_is_run_and_kept(
    made: Any, tmp_path: Path
) -> None:
    def double(x: float, c: float) -> float:
        called.append(x)
        return 2 * x

    rehearsal = made(double, store=tmp_path)
    points = asked(rehearsal)
    tried = rehearsal.tried(points)
    # By rank: 40 counts as the largest, whatever it is.
    assert (tried.inputs, tried.outputs) == ((3.0, 7.0), {"y": 6.0})
    assert tried.seconds > 0
    assert rehearsal.stored(points).tolist() == [False, False, True, False, False]
    assert rehearsal.tried(points).inputs == (5.0, 7.0)
    for _ in range(3):
        rehearsal.tried(points)
    assert rehearsal.stored(points).all()
    # Where all are stored one is run all the same, since it is the response that is tried.
    assert rehearsal.tried(points).inputs == (3.0, 7.0)
    assert called == [3.0, 5.0, 2.0, 1.0, 40.0, 3.0]


def test_a_specimen_that_fails_is_an_error_whatever_the_policy(made: Any, tmp_path: Path) -> None:
    for policy in (prb.response.Replace(), prb.response.Retry(2), prb.response.Abort()):
        rehearsal = made(on_failure=policy, store=tmp_path)
        with pytest.raises(prb.response.ResponseError, match=r"y: .*too steep"):
            rehearsal.tried(asked(rehearsal, [1.0, 3.0, 9.0]))
        with pytest.raises(prb.response.ResponseError, match=r"y: .*it is NaN"):
            rehearsal.tried(asked(rehearsal, [2.0]))
        # NaN is a result, which is stored.
        assert rehearsal.stored(asked(rehearsal, [2.0, 3.0])).tolist() == [True, False]


def test_a_stored_failure_is_known_only_where_it_stays_one(made: Any, tmp_path: Path) -> None:
    replacing = made(on_failure=prb.response.Replace(), store=tmp_path)
    respond(replacing._calling, asked(replacing, [1.0, 3.0]), Tally())
    assert replacing.stored(asked(replacing, [1.0, 3.0, 4.0])).tolist() == [True, True, False]
    for other in ({}, {"on_failure": prb.response.Replace(), "retry_failed": True}):
        again = made(store=tmp_path, **other)
        assert again.stored(asked(again, [1.0, 3.0, 4.0])).tolist() == [True, False, False]
