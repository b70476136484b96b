"""What a metric prepared for each data set tells of minimisers by what was prepared for the data."""

import numpy as np
import pytest

from prbayes._checks import Floats
from prbayes.estimate.prepared_anew import PREPARED, as_prepared_anew, of_few_pairs, told_enough

LUCK = np.random.default_rng(3).random(2000)


def of_some(anew: Floats, number: int = PREPARED) -> Floats:
    """Return minimisers of which only the first are known."""
    return np.where(np.arange(len(anew))[:, None] < number, anew, np.nan)


def test_what_is_known_of_none_or_few_changes_nothing() -> None:
    rng = np.random.default_rng(1)
    away = rng.normal(size=(2000, 2))
    for number in (0, 15):
        assert as_prepared_anew(away, of_some(away + 1, number), LUCK) is away


def test_too_few_pairs_are_told() -> None:
    rng = np.random.default_rng(2)
    anew = rng.normal(size=(100, 2))
    assert of_few_pairs(of_some(anew, 16)) == []
    anew[3, 1] = np.nan
    (said,) = of_few_pairs(of_some(anew, 16))
    assert "prepared for 15 of the data sets" in said


def test_what_is_the_same_stays_the_same() -> None:
    rng = np.random.default_rng(3)
    away = rng.normal(scale=1.5, size=(2000, 2))
    away[500:520] *= 10  # some ran away
    np.testing.assert_allclose(as_prepared_anew(away, of_some(away), LUCK), away, atol=1e-9)


def test_center_width_and_scatter_are_those_of_the_metric_prepared_anew() -> None:
    rng = np.random.default_rng(4)
    # In the mean .4 more, of another width, and not told by the other one alone.
    away = rng.normal(scale=1.4, size=(2000, 2))
    noise = 0.5 * rng.normal(size=(2000, 1)) * [1.0, -1.0]
    anew = [0.4, -0.2] + 0.6 * away + noise
    found = as_prepared_anew(away, of_some(anew), LUCK)
    np.testing.assert_array_equal(found[:PREPARED], anew[:PREPARED])
    # Four standard errors, by the pairs: .5 / 8 of the mean, .5 / 8 / 1.4 of the slope.
    np.testing.assert_allclose(found.mean(axis=0), anew.mean(axis=0), atol=0.25)
    np.testing.assert_allclose(found.std(axis=0), anew.std(axis=0), rtol=0.25)
    # Differences of the elements hang together.
    left = (found - away * 0.6)[PREPARED:]
    assert np.corrcoef(left.T)[0, 1] < -0.8


@pytest.mark.parametrize("far", [8.0, -40.0])
def test_those_that_run_away_only_as_it_was_prepared_come_back(far: float) -> None:
    rng = np.random.default_rng(6)
    anew = rng.normal(size=(2000, 1))
    away = anew.copy()
    away[::8] += far
    found = as_prepared_anew(away, of_some(anew), LUCK)
    # They follow no more, but are within what is likely.
    lost = found[PREPARED:][::8]
    assert np.abs(np.median(lost)) < 1.0
    assert np.quantile(np.abs(lost), 0.9) < 3.5


def test_those_that_run_away_both_ways_stay_away() -> None:
    rng = np.random.default_rng(7)
    away = rng.normal(size=(2000, 1))
    away[::8] = -30.0
    found = as_prepared_anew(away, of_some(away + 0.3), LUCK)
    assert found[::8].max() < -6.0


def test_pairs_are_enough_by_how_differences_scatter() -> None:
    rng = np.random.default_rng(1)
    alike = 0.5 + 0.1 * rng.normal(size=(40, 2))
    assert told_enough(alike)
    assert not told_enough(alike[:15])
    assert not told_enough(of_some(alike, 15))
    assert not told_enough(alike * [1.0, 5.0])
