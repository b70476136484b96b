"""Ranges of a surrogate: given, or from the prior predictive distribution."""

from typing import Any

import numpy as np
import pymc as pm
import pytest

import prbayes as prb
from prbayes.emulators.ranges import (
    POPULATIONS,
    SPECIMENS,
    Range,
    Ranges,
    predictive_inputs,
    read_ranges,
)

BOX = {"x": (0.0, 3.0), "y": (1.0, 2.0)}


def bent(x: Any, y: Any) -> Any:
    return np.sin(x) * y


@pytest.fixture(scope="module")
def surrogate() -> prb.Surrogate:
    return prb.Surrogate.fit(bent, BOX, 64)


def test_any_leading_shape_and_broadcasting(surrogate: prb.Surrogate) -> None:
    assert surrogate(1.0, 1.5).shape == ()
    grid = surrogate(np.linspace(0, 3, 4)[:, None], np.linspace(1, 2, 5))
    assert grid.shape == (4, 5)
    assert grid[2, 3] == pytest.approx(float(surrogate(2.0, 1.75)), rel=1e-12)


def test_a_multivariate_input_has_its_event_axis_last() -> None:
    with pm.Model():
        mean = pm.Normal("mean", 0, 1, shape=2)
        pair = pm.MvNormal.dist(mean, np.eye(2))
        found = prb.Surrogate.fit(
            lambda v, a: v[..., 0] - a * v[..., 1],
            [pair, 3.0],
            40,
            model=prb.surrogate.Polynomial(1),
        )
    v = np.random.default_rng(0).normal(size=(3, 4, 2))
    np.testing.assert_allclose(found(v, 3.0), v[..., 0] - 3 * v[..., 1], atol=1e-9)
    with pytest.raises(ValueError, match=r"got shape \(4, 3\)"):
        found(np.zeros((4, 3)), 3.0)


def test_ranges_cover_the_prior_predictive_and_the_sd_is_its() -> None:
    """x given mu is N(mu, 1), mu is N(5, 2): together N(5, sd sqrt(5))."""
    with pm.Model():
        x = pm.Normal.dist(pm.Normal("mu", 5, 2), 1.0)
        found = prb.Surrogate.fit(
            lambda x: 2 * x, [x], 20, model=prb.surrogate.Polynomial(1), prob=0.9
        )
    low, high = found.ranges[found.names[0]]
    # 512 populations: se of the mean 0.09, of the sd 3%
    assert (low + high) / 2 == pytest.approx(5, abs=0.4)
    assert (high - low) / 2 == pytest.approx(1.645 * np.sqrt(5), rel=0.12)
    trimmed = 2 * np.sqrt(5) * 0.79  # sd of a normal between its 5% and 95% quantiles
    assert found.error.population_sd == pytest.approx(trimmed, rel=0.12)


def test_a_model_variable_and_a_range_beside_a_distribution() -> None:
    with pm.Model():
        common = pm.Uniform("common", 1, 2)
        x = pm.Normal.dist(common, 1.0)
        found = prb.Surrogate.fit(lambda x, c, r: x + c * r, {"x": x, "c": common, "r": (0, 1)}, 40)
    assert found.names == ("x", "c", "r")
    low, high = found.ranges["c"]
    assert (low, high) == pytest.approx((1, 2), abs=0.02)
    assert found.ranges["r"] == (0, 1)


def test_a_constant_stays_constant() -> None:
    found = prb.Surrogate.fit(lambda x, m: x**m, {"x": (1, 2), "m": 3}, 32)
    assert found(1.5, 3) == pytest.approx(1.5**3, rel=1e-3)
    assert np.isnan(found(1.5, 2.5))


MIXED = Ranges(
    (
        Range("x", np.array(1.0), np.array(3.0)),
        Range("c", np.array(5.0), np.array(5.0), constant=True),
        Range("v", np.array([0.0, -1.0]), np.array([1.0, 1.0])),
    )
)


def test_the_unit_cube_is_mapped_to_the_ranges_and_back() -> None:
    unit = np.random.default_rng(0).random((50, 3))
    rows = MIXED.at(unit)
    assert rows.shape == (50, 4)
    assert (rows[:, 1] == 5).all()
    np.testing.assert_allclose(MIXED.scaled(rows), unit, atol=1e-15)
    np.testing.assert_array_equal(MIXED.at(np.zeros((1, 3))), [[1, 5, 0, -1]])
    np.testing.assert_array_equal(MIXED.at(np.ones((1, 3))), [[3, 5, 1, 1]])


def test_arguments_of_rows_make_the_same_rows() -> None:
    rows = MIXED.at(np.random.default_rng(0).random((6, 3)))
    x, c, v = MIXED.arguments(rows)
    assert (x.shape, c, v.shape) == ((6,), 5.0, (6, 2))
    again, batch = MIXED.columns([x, c, v])
    np.testing.assert_array_equal(again, rows)
    assert batch == (6,)


def test_what_is_outside_is_said_by_input() -> None:
    rows = np.array([[2.0, 5.0, 0.5, 0.0], [3.5, 5.0, np.nan, 0.0], [2.0, 5.0, 0.5, -2.0]])
    out = MIXED.outside(rows)
    assert out.sum(axis=1).tolist() == [0, 2, 1]
    text = MIXED.complaint(rows, out)
    assert text == (
        "got 2 of 3 points outside its design: x from 3.5 to 3.5, expected 1 to 3; "
        "v from nan to nan, expected -1 to 1"
    )


def test_rounding_is_not_outside() -> None:
    third = np.array([[3 * (1 + 1e-15), 5.0, 0.5, 0.0], [3 * (1 + 1e-6), 5.0, 0.5, 0.0]])
    assert MIXED.outside(third).any(axis=1).tolist() == [False, True]


def test_prior_predictive_rows_are_inside_and_ranges_uniform() -> None:
    with pm.Model():
        x = pm.Normal.dist(pm.Normal("mu", 5, 2), 1.0)
        ranges, rows = read_ranges("s", {"x": x, "r": (0, 4)}, 0.9, 0)
    assert rows is not None
    assert not ranges.outside(rows).any()
    assert len(rows) == pytest.approx(0.9 * 2**15, rel=1e-3)
    np.testing.assert_allclose(np.quantile(rows[:, 1], [0.25, 0.5, 0.75]), [1, 2, 3], atol=0.1)
    assert read_ranges("s", {"x": (0, 1)}, 0.9, 0)[1] is None


def test_each_population_has_its_own_parameters() -> None:
    with pm.Model():
        mu = pm.Normal("mu", 3, 2)
        x, again = predictive_inputs("s", [pm.Normal.dist(mu, 0.5), mu], 1)
    assert x.shape == again.shape == (POPULATIONS, SPECIMENS)
    # A variable of the model is one value for all specimens.
    assert (np.ptp(again, axis=1) == 0).all()
    # Standard errors: .063 of a population's mean, 2 / sqrt(512) = .09 of all.
    assert np.abs(x.mean(axis=1) - again[:, 0]).max() < 5 * 0.063
    assert x.mean() == pytest.approx(3, abs=4 * 0.09)
    assert x.std(axis=1).mean() == pytest.approx(0.5, rel=0.02)


def test_invalid_parameters_give_way_to_valid_ones() -> None:
    with pm.Model():
        sd = pm.Normal("sd", 0, 1)
        (x,) = predictive_inputs("s", [pm.Normal.dist(0, sd)], 1)
    assert np.isfinite(x).all()
    with pm.Model(), pytest.raises(ValueError, match="invalid parameters of the inputs at all"):
        predictive_inputs("s", [pm.Normal.dist(0, -pm.HalfNormal("sd"))], 1)


def test_a_seed_gives_the_same_draws() -> None:
    def drawn(random_seed: int) -> Any:
        with pm.Model():
            return predictive_inputs("s", [pm.Normal.dist(pm.Normal("mu"), 1)], random_seed)[0]

    np.testing.assert_array_equal(drawn(3), drawn(3))
    assert (drawn(3) != drawn(4)).all()


def test_there_must_be_a_model() -> None:
    with pytest.raises(TypeError, match="s: inputs that are distributions"):
        predictive_inputs("s", [pm.Normal.dist(0, 1)], 0)
