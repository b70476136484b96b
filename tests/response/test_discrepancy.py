"""Model discrepancies under each condition, and their warning of extrapolation."""

from __future__ import annotations

import logging
import pickle
from typing import Any

import numpy as np
import pymc as pm
import pytest
import xarray as xr

import prbayes as prb
from prbayes._finding import from_json
from prbayes.response.discrepancy import findings_of, has_discrepancy

TIMES = np.array([1.0, 2.0, 4.0])


def line(x: Any) -> Any:
    return 2.0 * x


def curve(x: Any) -> Any:
    return np.asarray(x)[..., None] * TIMES


def powers(c: Any) -> Any:
    return np.stack([c, c**2], axis=-1)


def test_the_line_is_zero_at_the_lower_end_and_one_at_the_upper() -> None:
    rise = prb.response.Additive([1000.0, 20.0, 500.0])
    np.testing.assert_allclose(rise.value(3.0, [20.0, 510.0, 1000.0]), [0.0, 1.5, 3.0])
    assert repr(rise) == "Additive over 20 to 1000"


def test_an_additive_one_shifts_and_a_multiplicative_one_scales() -> None:
    x, b = np.random.default_rng(1).normal(size=(2, 3, 5))
    shifted = prb.response.Additive([0.0, 2.0]).of(line, 1.0)(x, b)
    np.testing.assert_allclose(shifted, 2 * x + 0.5 * b)
    scaled = prb.response.Multiplicative([0.0, 2.0]).of(line, 1.0)(x, b)
    np.testing.assert_allclose(scaled, 2 * x * np.exp(0.5 * b))
    assert (np.sign(scaled) == np.sign(x)).all()


@pytest.mark.parametrize("batch", [(), (6,), (4, 6)])
def test_each_output_has_its_condition(batch: tuple[int, ...]) -> None:
    x, b = np.random.default_rng(2).normal(size=(2, *batch))
    found = prb.response.Additive(TIMES).of(curve, TIMES)(x, b)
    assert found.shape == (*batch, 3)
    for i, time in enumerate(TIMES):
        np.testing.assert_allclose(found[..., i], x * time + b * (time - 1) / 3)


def test_labels_and_masks_of_the_response_are_kept() -> None:
    def labelled(x: Any) -> xr.DataArray:
        return xr.DataArray(curve(x), dims=["n", "time"], coords={"time": TIMES})

    x, b = np.random.default_rng(2).normal(size=(2, 6))
    expected = prb.response.Additive(TIMES).of(curve, TIMES)(x, b)
    found = prb.response.Additive(TIMES).of(labelled, TIMES)(x, b)
    assert found.coords["time"].values.tolist() == list(TIMES)
    np.testing.assert_array_equal(found, expected)
    one = prb.response.Additive([0.0, 2.0]).of(lambda x: np.ma.masked_greater(x, 0), 1.0)(x, b)
    np.testing.assert_array_equal(np.isnan(one), x > 0)


@pytest.mark.parametrize("batch", [(), (6,), (4, 6)])
def test_several_coefficients_are_the_last_axis(batch: tuple[int, ...]) -> None:
    rng = np.random.default_rng(3)
    x, b = rng.normal(size=batch), rng.normal(size=(*batch, 2))
    bent = prb.response.Additive(TIMES, powers)
    whole = bent.of(curve, TIMES)(x, b)
    for i, time in enumerate(TIMES):
        expected = b[..., 0] * time + b[..., 1] * time**2
        np.testing.assert_allclose(whole[..., i], x * time + expected)
        np.testing.assert_allclose(bent.of(line, time)(x, b), 2 * x + expected)


def test_a_function_of_one_specimen_stays_one() -> None:
    one = prb.scalar(lambda x: x**2 if x > 0 else 0.0)
    both = prb.response.Additive([0.0, 1.0]).of(one, 1.0)
    assert isinstance(both, prb.scalar)
    assert has_discrepancy(both)
    assert not has_discrepancy(one)
    np.testing.assert_allclose(both([3.0, -1.0], [0.5, 0.5]), [9.5, 0.5])


@pytest.mark.parametrize("kind", [prb.response.Additive, prb.response.Multiplicative])
def test_a_failure_and_an_output_without_discrepancy_are_as_they_were(kind: Any) -> None:
    found = kind(TIMES, np.sqrt).of(curve, [1.0, np.nan, 4.0])(np.ones(2), np.full(2, 7.0))
    np.testing.assert_array_equal(found[:, 1], curve(np.ones(2))[:, 1])
    assert (found[:, [0, 2]] > 7).all()
    failed = kind([0.0, 1.0]).of(lambda x: x, 1.0)(np.array([np.inf, np.nan]), np.full(2, -1.0))
    np.testing.assert_array_equal(failed, [np.inf, np.nan])


def test_a_mapping_is_refused() -> None:
    named = prb.response.Additive([0.0, 1.0]).of(lambda x: {"a": x}, 1.0)
    with pytest.raises(TypeError, match="got a mapping, expected an array with an output"):
        named(1.0, 2.0)


@pytest.mark.parametrize(
    ("condition", "outside"),
    [(1.0, False), (4.0, False), ([1.0, np.nan, 4.0], False), (0.9, True), ([1.0, 2.0, 5.0], True)],
)
def test_it_says_where_it_extrapolates(condition: Any, outside: bool) -> None:
    found = findings_of(prb.response.Additive(TIMES).of(curve, condition))
    assert bool(found) is outside
    assert all("extrapolates its model discrepancy, seen from 1 to 4" in str(f) for f in found)


def test_predictions_say_that_they_extrapolate(caplog: pytest.LogCaptureFixture) -> None:
    drift = prb.response.Additive([0.0, 2.0])
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1, 1), 0.3)
        b = pm.Normal.dist(0.0, 0.1)
    result = xr.DataTree.from_dict({"posterior": xr.Dataset({"mu": (("chain", "draw"), [[1.0]])})})
    settings: dict[str, Any] = {"model": model, "n_samples": 50, "progressbar": False}
    inside = prb.predict(result, drift.of(line, 2.0), x, b, **settings)
    assert from_json(inside.attrs["findings"]) == ()
    assert not caplog.records
    with caplog.at_level(logging.WARNING, "prbayes"):
        beyond = prb.predict(result, drift.of(line, 3.0), x, b, **settings)
    said = "line at 3: extrapolates its model discrepancy, seen from 0 to 2."
    (finding,) = from_json(beyond.attrs["findings"])
    assert (finding.code, str(finding)) == ("extrapolated-discrepancy", said)
    assert [record.message for record in caplog.records] == [said]


@pytest.mark.parametrize(
    ("condition", "response", "coefficients"),
    [
        # As many specimens as conditions, or as outputs: nothing may be broadcast by chance.
        ([0.0, 1.0, 2.0], np.ones(3), np.ones(3)),
        (1.0, np.ones((3, 3)), np.ones(3)),
        ([0.0, 1.0, 2.0], np.ones((3, 2)), np.ones(3)),
        (1.0, np.ones((4, 3)), np.float64(1.0)),
    ],
)
def test_outputs_that_are_not_those_of_the_conditions_are_refused(
    condition: Any, response: Any, coefficients: Any
) -> None:
    corrected = prb.response.Additive([0.0, 2.0]).of(lambda x: response, condition)
    with pytest.raises(ValueError, match="one output, or one for each condition"):
        corrected(0.0, coefficients)


def test_a_response_that_is_the_same_for_all_specimens_has_its_discrepancy_too() -> None:
    corrected = prb.response.Additive([0.0, 2.0]).of(lambda: 5.0, 2.0)
    np.testing.assert_array_equal(corrected(np.array([1.0, 2.0])), [6.0, 7.0])


LOADS = np.array([0.5, 1.0, 1.5, 2.0])


def process(shape: prb.response.Smooth, first: Any, second: Any, farthest: float) -> Any:
    """Covariance of a smooth discrepancy with coefficients of unit variance."""
    a, b = np.asarray(first)[:, None] - shape.zero_at, np.asarray(second) - shape.zero_at
    length = farthest / 2 if shape.length is None else shape.length
    return a * b / farthest**2 / (1 + 0.5 * ((a - b) / length) ** 2)


def terms_of(discrepancy: Any, conditions: Any) -> Any:
    """Terms of the expansion at conditions, (n, m)."""
    return np.asarray(discrepancy.shape(np.asarray(conditions)))


@pytest.mark.parametrize(
    ("shape", "conditions"),
    [
        (prb.response.Smooth(0.0), LOADS),
        (prb.response.Smooth(1.1, length=3.0), LOADS),
        (prb.response.Smooth(-1.0, length=0.4, reach=0.3), np.linspace(0, 2, 40)),
        (prb.response.Smooth(0.5), LOADS[[0, 0, 1, 3]]),
        (prb.response.Smooth(0.0), np.linspace(0, 5, 4000)),
        (prb.response.Smooth(1e6), LOADS),
    ],
)
def test_a_smooth_shape_expands_its_process(shape: Any, conditions: Any) -> None:
    discrepancy = prb.response.Additive(conditions, shape)
    farthest = np.abs(conditions - shape.zero_at).max()
    ends = discrepancy.shape.low, discrepancy.shape.high
    places = np.linspace(*ends, 57)
    whole = terms_of(discrepancy, places)
    expected = process(shape, places, places, farthest)
    # At most 5 % of the variance is left out at any condition, and none where there are data.
    lost = expected.diagonal() - (whole**2).sum(axis=1)
    far = np.abs(places - shape.zero_at) / farthest
    assert (lost > -1e-9).all()
    assert (lost <= 0.051 * far**2 + 1e-9).all()
    at_data = terms_of(discrepancy, conditions)
    cross = process(shape, places, conditions, farthest)
    np.testing.assert_allclose(whole @ at_data.T, cross, atol=2e-3)
    np.testing.assert_allclose(
        at_data @ at_data.T, process(shape, conditions, conditions, farthest), atol=1e-5
    )


def test_a_smooth_shape_is_zero_at_its_zero_and_grows_in_proportion_to_the_distance() -> None:
    discrepancy = prb.response.Additive(LOADS, prb.response.Smooth(zero_at=0.0))
    m = discrepancy.event[0]
    b = np.random.default_rng(0).normal(size=(400, m))
    assert (discrepancy.value(b, np.zeros(400)) == 0).all()
    variance = (terms_of(discrepancy, [0.5, 1.0, 2.0, 3.0]) ** 2).sum(axis=1)
    np.testing.assert_allclose(variance, [1 / 16, 1 / 4, 1, 9 / 4], rtol=0.05)


def test_the_last_coefficients_of_a_smooth_shape_leave_the_data_as_they_are() -> None:
    discrepancy = prb.response.Additive(LOADS, prb.response.Smooth(zero_at=0.0))
    whole = terms_of(discrepancy, LOADS)
    assert np.abs(whole[:, 4:]).max() < 1e-8
    assert (np.abs(whole[:, :4]).max(axis=0) > 0.01).all()
    assert np.abs(terms_of(discrepancy, [3.0])[0, 4:]).max() > 0.1


def test_a_smooth_shape_interpolates_like_the_process_given_its_data() -> None:
    discrepancy = prb.response.Additive(LOADS, prb.response.Smooth(zero_at=0.0))
    d = 0.25 * LOADS**2
    at_data = terms_of(discrepancy, LOADS)
    b = np.linalg.lstsq(at_data, d, rcond=None)[0]
    shape = prb.response.Smooth(0.0)
    gain = np.linalg.solve(process(shape, LOADS, LOADS, 2.0), process(shape, LOADS, [1.25], 2.0))
    np.testing.assert_allclose(discrepancy.value(b, 1.25), (d @ gain)[0], rtol=1e-4)


def test_a_smooth_shape_serves_curves_and_multiplicative_discrepancies() -> None:
    x = np.random.default_rng(1).normal(size=6)
    for kind in (prb.response.Additive, prb.response.Multiplicative):
        discrepancy = kind(TIMES, prb.response.Smooth(zero_at=0.0))
        b = np.random.default_rng(2).normal(size=discrepancy.event)
        found = discrepancy.of(curve, TIMES)(x, b)  # common to all specimens
        d = terms_of(discrepancy, TIMES) @ b
        sums = x[:, None] * TIMES + d
        products = x[:, None] * TIMES * np.exp(d)
        expected = sums if kind is prb.response.Additive else products
        np.testing.assert_allclose(found, expected)
        again = pickle.loads(pickle.dumps(discrepancy))
        np.testing.assert_array_equal(again.of(curve, TIMES)(x, b), found)


def test_a_smooth_shape_is_the_same_whatever_the_order_of_the_conditions() -> None:
    first = prb.response.Additive(LOADS, prb.response.Smooth(0.0))
    second = prb.response.Additive(LOADS[[2, 0, 3, 1, 1]], prb.response.Smooth(0.0))
    np.testing.assert_array_equal(terms_of(first, [0.7, 2.5]), terms_of(second, [0.7, 2.5]))


@pytest.mark.parametrize("condition", [3.1, -0.1, [1.0, np.nan, 7.0]])
def test_conditions_beyond_the_range_of_a_smooth_shape_are_refused(condition: Any) -> None:
    discrepancy = prb.response.Additive(LOADS, prb.response.Smooth(zero_at=0.0))
    with pytest.raises(ValueError, match="from 0 to 3, where the shape is defined; pass a larger"):
        discrepancy.of(curve, condition)
    with pytest.raises(ValueError, match="where the shape is defined"):
        discrepancy.value(np.ones(discrepancy.event), condition)
    far = prb.response.Additive(LOADS, prb.response.Smooth(zero_at=0.0, reach=4.0))
    assert findings_of(far.of(line, 7.0))


def test_the_free_shape_without_conditions_is_refused_as_a_function() -> None:
    with pytest.raises(TypeError, match="expected a function of the condition"):
        prb.response.Additive(LOADS, 3.0)  # type: ignore[arg-type]


def draws_of(**values: Any) -> xr.DataTree:
    """A posterior with the given draws, (draw, ...)."""
    variables = {
        name: (("chain", "draw", f"{name}_dim")[: x.ndim + 1], x[None])
        for name, x in values.items()
    }
    return xr.DataTree.from_dict({"posterior": xr.Dataset(variables)})


def test_decisions_say_that_they_extrapolate() -> None:
    drift = prb.response.Additive([0.0, 2.0])
    rng = np.random.default_rng(0)
    with pm.Model() as model:
        b = pm.Normal.dist(pm.Normal("mu", 1, 1), 0.3)
        prb.Simulator(
            "y", drift.of(lambda: 2.0, 2.0), b, observed=rng.normal(3, 0.3, 20),
            metric=prb.AreaMetric(), propagation=prb.Reweighted(256),
        )  # fmt: skip
    result = draws_of(mu=rng.normal(1, 0.05, 50))
    for condition in (2.0, 3.0):
        response = drift.of(lambda: 2.0, condition)
        quantity = prb.decision.Mean(response, b)
        later = {"later": prb.decision.Condition(response, b)}
        tables: list[Any] = [
            prb.exceedance(result, response, 3.0, b, model=model),
            prb.sensitivity(result, quantity, model=model, n_points=64),
            prb.plan(result, later, model=model, quantity=quantity),
            prb.plan(result, later, model=model),
            prb.decision.p_box(result, response, b, model=model),
        ]
        for table in tables:
            codes = [f.code for f in from_json(table.attrs["findings"])]
            assert codes.count("extrapolated-discrepancy") == int(condition == 3.0)
            assert ("extrapolates its model discrepancy" in str(table)) is (condition == 3.0)


def test_a_discrepancy_that_all_specimens_share_is_that_of_each_population() -> None:
    discrepancy = prb.response.Additive(LOADS, prb.response.Smooth(zero_at=0.0))
    (m,) = discrepancy.event
    rng = np.random.default_rng(0)
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1, 1), 0.3)
        b = pm.Normal("b", 0, 1, shape=m)
        with pytest.raises(TypeError, match="goes into the response as a model variable"):
            prb.Simulator("y", discrepancy.of(line, 1.0), x, b, observed=[1.0, 2.0, 3.0])
        prb.Simulator("y", line, x, observed=[1.0, 2.0, 3.0], metric=prb.AreaMetric())
    mu, coefficients = rng.normal(size=8), rng.normal(size=(8, m))
    result = draws_of(mu=mu, b=coefficients)
    for condition in (1.25, 3.0):
        response = discrepancy.of(line, condition)
        predicted = prb.predict(result, response, x, b, model=model, n_samples=512, random_seed=1)
        expected = 2 * mu + coefficients @ terms_of(discrepancy, condition)
        np.testing.assert_allclose(predicted.mean("sample")[0], expected, atol=0.01)
        np.testing.assert_allclose(predicted.std("sample")[0], 0.6, rtol=0.02)
        codes = {f.code for f in from_json(predicted.attrs["findings"])}
        assert ("extrapolated-discrepancy" in codes) is (condition == 3.0)
        with pytest.raises(TypeError, match=r"expected the \.dist\(\) objects .* prb.predict"):
            prb.exceedance(result, response, 3.0, x, b, model=model)
        with pytest.raises(TypeError, match="compute shares from"):
            prb.exceedance(result, response, 3.0, x, b, model=model, n_points=100)
