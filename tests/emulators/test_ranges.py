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

MIXED = Ranges(
    (
        Range("x", np.array(1.0), np.array(3.0)),
        Range("c", np.array(5.0), np.array(5.0), constant=True),
        Range("v", np.array([0.0, -1.0]), np.array([1.0, 1.0])),
    )
)


def test_inputs_broadcast_and_have_event_axes_last() -> None:
    with pm.Model():
        pair = pm.MvNormal.dist(pm.Normal("mean", 0, 1, shape=2), np.eye(2))
        found = prb.Surrogate.fit(
            lambda v, a, x: v[..., 0] - a * v[..., 1] + x,
            [pair, 3.0, (0, 1)],
            40,
            model=prb.surrogate.Polynomial(1),
        )
    v = np.random.default_rng(0).normal(size=(3, 4, 2))
    x = np.linspace(0, 1, 4)
    np.testing.assert_allclose(found(v, 3.0, x), v[..., 0] - 3 * v[..., 1] + x, atol=1e-9)
    assert found(v[0, 0], 3.0, 0.5).shape == ()
    assert np.isnan(found(v[0, 0], 2.5, 0.5)), "a constant stays constant"
    with pytest.raises(ValueError, match=r"got shape \(4, 3\)"):
        found(np.zeros((4, 3)), 3.0, 0.5)


def test_ranges_cover_the_prior_predictive_and_the_sd_is_its() -> None:
    """x given mu is N(mu, 1), mu is N(5, 2): together N(5, sd sqrt(5))."""
    with pm.Model():
        mu = pm.Normal("mu", 5, 2)
        inputs = {"x": pm.Normal.dist(mu, 1.0), "mu": mu, "r": (0, 1)}
        model = prb.surrogate.Polynomial(1)
        found = prb.Surrogate.fit(lambda x, m, r: 2 * x + 0 * m, inputs, 20, model=model, prob=0.9)
    assert found.names == ("x", "mu", "r")
    assert found.ranges["r"] == (0, 1)
    # 512 populations: standard errors .09 of the mean, 3% of the sd.
    for name, sd in (("x", np.sqrt(5)), ("mu", 2.0)):
        low, high = found.ranges[name]
        assert (low + high) / 2 == pytest.approx(5, abs=0.4)
        assert (high - low) / 2 == pytest.approx(1.645 * sd, rel=0.12)
    # Of x between its 5% and 95% quantiles, times two; mu inside its own range narrows it.
    assert 0.8 < found.error.population_sd / (2 * np.sqrt(5) * 0.79) < 1.12


def test_the_unit_cube_is_mapped_to_the_ranges_and_back() -> None:
    unit = np.random.default_rng(0).random((50, 3))
    rows = MIXED.at(unit)
    assert (rows[:, 1] == 5).all()
    np.testing.assert_allclose(MIXED.scaled(rows), unit, atol=1e-15)
    ends = MIXED.at(np.array([[0.0] * 3, [1.0] * 3]))
    np.testing.assert_array_equal(ends, [[1, 5, 0, -1], [3, 5, 1, 1]])
    x, c, v = MIXED.arguments(rows)
    assert (x.shape, c, v.shape) == ((50,), 5.0, (50, 2))
    again, batch = MIXED.columns([x, c, v])
    np.testing.assert_array_equal(again, rows)
    assert batch == (50,)


def test_points_outside_are_reported_by_input() -> None:
    rows = np.array([[2.0, 5.0, 0.5, 0.0], [3.5, 5.0, np.nan, 0.0], [2.0, 5.0, 0.5, -2.0]])
    out = MIXED.outside(rows)
    assert out.sum(axis=1).tolist() == [0, 2, 1]
    text = MIXED.complaint(rows, out)
    assert "2 of 3 points" in text
    assert "x from 3.5 to 3.5, expected 1 to 3; v from nan to nan, expected -1 to 1" in text
    # Rounding is not outside.
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
    def drawn(random_seed: int) -> Any:
        with pm.Model():
            mu = pm.Normal("mu", 3, 2)
            return predictive_inputs("s", [pm.Normal.dist(mu, 0.5), mu], random_seed)

    x, mu = drawn(1)
    assert x.shape == mu.shape == (POPULATIONS, SPECIMENS)
    # A variable of the model is one value for all specimens.
    assert (np.ptp(mu, axis=1) == 0).all()
    # Standard errors: .063 of a population's mean, 2 / sqrt(512) = .09 of all.
    assert np.abs(x.mean(axis=1) - mu[:, 0]).max() < 5 * 0.063
    assert x.mean() == pytest.approx(3, abs=4 * 0.09)
    assert x.std(axis=1).mean() == pytest.approx(0.5, rel=0.02)
    np.testing.assert_array_equal(drawn(1)[0], x)
    assert (drawn(2)[0] != x).all()


def test_valid_parameters_replace_invalid_ones() -> None:
    with pm.Model():
        (x,) = predictive_inputs("s", [pm.Normal.dist(0, pm.Normal("sd", 0, 1))], 1)
    assert np.isfinite(x).all()
    with pm.Model(), pytest.raises(ValueError, match="invalid parameters of the inputs at all"):
        predictive_inputs("s", [pm.Normal.dist(0, -pm.HalfNormal("sd"))], 1)
