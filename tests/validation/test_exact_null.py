"""The exact null: a table against formulas, simulation and published values."""

import sys
from pathlib import Path

import numpy as np
import pytest

import prbayes as prb
from prbayes.validation.exact_null import table
from prbayes.validation.statistic import area

sys.path.insert(0, str(Path(__file__).parents[2]))

from benchmarks import area_null

PUBLISHED = {5: 0.2567, 10: 0.1828, 15: 0.1500, 20: 0.1297, 30: 0.1057, 50: 0.0824, 100: 0.0580}
EXACT = prb.validation.ExactModel()


@pytest.mark.parametrize(("n", "published"), PUBLISHED.items())
def test_published_critical_values(n: int, published: float) -> None:
    assert EXACT.critical_value(n) == pytest.approx(published, abs=4e-4)


def test_the_limit_for_many_values() -> None:
    scaled = [np.sqrt(n) * EXACT.critical_value(n) for n in (500, 1000, 10_000)]
    np.testing.assert_allclose(scaled, 0.5821, atol=2e-4)


def test_one_value_has_a_closed_form() -> None:
    # A = 1/4 + (u - 1/2)^2
    for level in (0.5, 0.1, 0.05, 0.01):
        assert EXACT.critical_value(1, level) == pytest.approx(
            0.25 + ((1 - level) / 2) ** 2, abs=1e-4
        )
    assert EXACT.p_value(0.25 + 0.3**2, 1) == pytest.approx(0.4, abs=2e-3)


@pytest.mark.parametrize("n", [2, 3, 4, 7, 23, 60, pytest.param(170, marks=pytest.mark.slow)])
def test_the_table_against_simulation(n: int) -> None:
    size = 100_000
    found = area(np.random.default_rng(n).random((size, n)))
    for level in (0.9, 0.5, 0.1, 0.05, 0.01, 0.001):
        share = float((found > EXACT.critical_value(n, level)).mean())
        assert abs(share - level) < 4.5 * np.sqrt(level * (1 - level) / size)


@pytest.mark.long
def test_the_table_is_what_its_script_makes() -> None:
    sizes, rows = table().sizes, table().quantiles
    for n in (1, 9):
        np.testing.assert_allclose(area_null.quantiles(n), rows[sizes == n][0], atol=2e-6)
    np.testing.assert_allclose(area_null.areas(np.array([0.2, 0.5])), area(np.array([0.2, 0.5])))


def test_the_table_is_monotone() -> None:
    sizes, logs, rows = table().sizes, table().logs, table().quantiles
    assert (np.diff(sizes) > 0).all()
    assert (np.diff(logs) > 0).all()
    assert (np.diff(rows, axis=1) >= 0).all()
    assert (sizes[0], sizes[-1]) == (1, 1000)


@pytest.mark.parametrize("n", [1, 2, 8, 20, 77, 1000, 5000])
def test_p_values_and_critical_values_belong_together(n: int) -> None:
    for level in (0.2, 0.05, 0.01, 1e-4):
        assert EXACT.p_value(EXACT.critical_value(n, level), n) == pytest.approx(level, rel=1e-6)
    p = [EXACT.p_value(a, n) for a in np.linspace(0, 0.5, 200)]
    assert (np.diff(p) <= 0).all()
    assert p[0] > 0.999
    assert 0 <= p[-1] < 1e-4


def test_the_far_tail_falls_like_that_of_a_brownian_bridge() -> None:
    x = np.array([1.6, 1.8])
    logs = np.log([EXACT.p_value(v / np.sqrt(1000), 1000) for v in x])
    assert (logs[1] - logs[0]) / (x[1] ** 2 - x[0] ** 2) == pytest.approx(-6, abs=0.6)


def test_sizes_between_those_of_the_table_lie_between_them() -> None:
    for level in (0.5, 0.05, 1e-3):
        scaled = [np.sqrt(n) * EXACT.critical_value(n, level) for n in (22, 23, 24, 25)]
        falls = np.diff(scaled)
        assert (falls > 0).all() or (falls < 0).all()


def test_the_slope_of_the_far_tail_does_not_hang_on_where_it_is_taken() -> None:
    found = table()
    logs = found.logs
    for n in (20, 100, 1000):
        squares = found.at(n) ** 2
        slopes = [(logs[-1] - logs[-1 - k]) / (squares[-1] - squares[-1 - k]) for k in range(1, 13)]
        np.testing.assert_allclose(slopes, slopes[6], rtol=0.055)
