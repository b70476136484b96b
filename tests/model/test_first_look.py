"""What is told of measured responses at once."""

import logging

import numpy as np
import pytest

from prbayes._validate import Floats
from prbayes.model.first_look import tell_copies, tell_far_data

RNG = np.random.default_rng(0)
SIMULATED = RNG.normal(size=(64, 2)) * [1, 2]
MEASURED = RNG.normal(size=(20, 2))


@pytest.fixture(autouse=True)
def logged(caplog: pytest.LogCaptureFixture) -> pytest.LogCaptureFixture:
    caplog.set_level(logging.WARNING, logger="prbayes")
    return caplog


@pytest.mark.parametrize("factor", [1.0, 1000.0])
def test_on_both_sides_of_the_responses_no_unit_is_seen(
    factor: float, logged: pytest.LogCaptureFixture
) -> None:
    tell_far_data("y", factor * MEASURED, SIMULATED, ["a", "b"])
    assert not logged.records


def test_data_beyond_all_responses_are_told_of(logged: pytest.LogCaptureFixture) -> None:
    tell_far_data("y", np.add(np.abs(MEASURED), [0.0, 1e4]), SIMULATED, ["a", "b"])
    (record,) = logged.records
    assert "y[b]: got observed values from 1e+04 to 1e+04, all above the first 64" in record.message
    logged.clear()
    tell_far_data("y", -9.0 - np.abs(MEASURED[:, 0]), SIMULATED[:, 0], [])
    assert "y: got observed values from -" in logged.text
    assert "all below the first 64 responses" in logged.text


@pytest.mark.parametrize(
    ("observed", "simulated"),
    [
        (np.ones(5), np.empty(0)),
        (np.ones((5, 2)), np.empty((0, 2))),
        (np.full(5, 99.0), np.zeros(15)),  # of which a range says little
        (np.full(5, np.inf), np.zeros(64)),  # all of which failed
    ],
)
def test_without_enough_to_tell_nothing_is_told(
    observed: Floats, simulated: Floats, logged: pytest.LogCaptureFixture
) -> None:
    tell_far_data("y", observed, simulated, [])
    assert not logged.records


@pytest.mark.parametrize(
    "values", [MEASURED[:, 0], MEASURED, MEASURED[:, 0].round(3), 0.001 * np.arange(20) ** 2]
)
def test_specimens_that_are_all_there_twice_are_told_of(
    values: Floats, logged: pytest.LogCaptureFixture
) -> None:
    tell_copies("y", np.concatenate([values, values[::-1]]))
    (record,) = logged.records
    assert "y: got 40 observed values of which only 20 are different" in record.message


@pytest.mark.parametrize(
    "values",
    [
        MEASURED[:, 0],
        np.append(MEASURED[:, 0], MEASURED[:3, 0]),  # some of them
        RNG.binomial(4, 0.5, 60),  # counts
        np.repeat([3, 5, 8], 4),
        np.repeat([300, 500, 800], 4),  # of hundreds
        RNG.normal(size=400).round(1).clip(-1, 1),  # rounded readings
        np.full(9, 2.5),  # all equal
        [1.0, 1.0, 2.0, 2.0],  # few
    ],
    ids=["once", "some", "counts", "other counts", "hundreds", "rounded", "equal", "few"],
)
def test_ties_by_chance_are_not(values: Floats, logged: pytest.LogCaptureFixture) -> None:
    tell_copies("y", np.asarray(values, dtype=float))
    assert not logged.records
