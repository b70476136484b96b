"""Runs get a share of a population where the emulator is biased, and none where it is right."""

from __future__ import annotations

import numpy as np
import pytest

from prbayes.emulators.mixing_weight import share_of_runs

N = 256
Y = np.random.default_rng(5).standard_normal((N, 1))
EVEN = np.full((3, N), 1 / N)
BLOCKS = np.arange(N) % 8


def test_an_emulator_that_is_right_is_trusted() -> None:
    assert share_of_runs(EVEN, Y, Y + 1e-9, BLOCKS) < 0.01


def test_scatter_around_the_response_is_no_bias() -> None:
    near = Y + 0.02 * np.random.default_rng(6).standard_normal((N, 1))
    assert share_of_runs(EVEN, Y, near, BLOCKS) < 0.1


def test_a_rounding_is_no_bias_where_many_specimens_have_one_value() -> None:
    capped = np.minimum(Y, 0.5)
    assert (capped == 0.5).mean() > 0.2
    off = 1e-3 * np.random.default_rng(7).standard_normal((N, 1))
    assert share_of_runs(EVEN, capped, capped + off, BLOCKS) < 0.01
    assert share_of_runs(EVEN, capped, capped + 0.5, BLOCKS) > 0.5


def test_levels_are_where_the_populations_are() -> None:
    # A tenth of the runs are where the populations are, a thousandth as wide as the others.
    here = np.arange(440)[:, None] >= 400
    z = np.random.default_rng(5).standard_normal((440, 1))
    y = np.where(here, 1e-3 * z, z)
    weights = np.repeat(here.T / 40, 3, axis=0)
    blocks = np.arange(440) % 8
    wider = np.where(here, 3 * y, y)
    wrong_elsewhere = np.where(here, y, y + 2.0)
    assert share_of_runs(weights, y, wider, blocks) > 0.5
    assert share_of_runs(weights, y, wrong_elsewhere, blocks) < 0.01


def test_an_emulator_that_is_wrong_is_not_trusted() -> None:
    assert share_of_runs(EVEN, Y, 0 * Y, BLOCKS) > 0.9
    assert share_of_runs(EVEN, Y, Y + 1.0, BLOCKS) > 0.9


def test_few_runs_leave_more_to_the_emulator() -> None:
    uneven = np.zeros((1, N))
    uneven[:, :16] = 1 / 16
    biased = Y + 0.3
    assert share_of_runs(uneven, Y, biased, BLOCKS) < share_of_runs(EVEN, Y, biased, BLOCKS)


@pytest.mark.parametrize("lost", [np.nan, np.inf])
def test_a_failure_that_the_emulator_does_not_know_of_is_a_bias(lost: float) -> None:
    failed = np.where(Y > 0.5, lost, Y)
    assert share_of_runs(EVEN, failed, Y, BLOCKS) >= 0.0
    assert share_of_runs(EVEN, Y, failed, BLOCKS) > 0.5
