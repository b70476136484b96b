"""The area test: what it sees, what it does not care for, what it refuses."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm
import pytest
import xarray as xr
from scipy import stats
from scipy.special import ndtr, ndtri

import prbayes as prb
from benchmarks import validity
from prbayes._stats import envelope
from prbayes.validation.nulls import uniform_envelope
from prbayes.validation.pit import area

Posterior = Callable[..., Any]
EXACT = prb.validation.ExactModel()
QUICK = prb.validation.PosteriorNull(999)
GRID = ndtri((np.arange(1000) + 0.5) / 1000)  # a standard normal population


def as_array(values: Any, **attrs: Any) -> xr.DataArray:
    return xr.DataArray(
        np.asarray(values)[None], dims=("chain", "draw", "sample"), name="crack", attrs=attrs
    )


def test_default_nulls(posterior: Posterior) -> None:
    y = np.random.default_rng(1).normal(size=20)
    for predicted, specimens, words in (
        (posterior(), None, "one of 400 populations"),
        (GRID, None, "is exact"),
        (GRID, np.arange(20) // 2, "10 specimens with 20 values in all"),
    ):
        assert words in prb.area_test(y, predicted, specimens=specimens).null


def test_a_statistic_beyond_the_critical_value_has_a_small_p_value(posterior: Posterior) -> None:
    for shift in (0.0, 0.6, 1.2):
        y = np.random.default_rng(7).normal(shift, 1, 20)
        for predicted in (posterior(), GRID):
            test = prb.area_test(y, predicted, alpha=0.1, null=QUICK)
            assert test.rejected == (test.p_value <= 0.1) == (test.statistic > test.critical_value)
            assert test.statistic == area(test.u_values)
            ranked, (low, high) = np.sort(test.u_values), test.envelope
            if shift != 0.6:  # the area and the envelope are two tests
                assert ((ranked >= low) & (ranked <= high)).all() != test.rejected
    wide, narrow = (prb.area_test(y, p, null=QUICK).envelope for p in (posterior(15), GRID))
    assert np.ptp(wide, axis=0).mean() > 1.2 * np.ptp(narrow, axis=0).mean()


def test_the_test_does_not_depend_on_order_or_increasing_transformations(
    posterior: Posterior,
) -> None:
    y, predicted = np.random.default_rng(7).normal(size=15), posterior()
    tests = [
        prb.area_test(data, population, null=QUICK)
        for data, population in (
            (y, predicted),
            (y[::-1], predicted),
            (2 * y + 1, 2 * predicted + 1),
            (np.exp(y), np.exp(predicted)),
        )
    ]
    assert len({(t.p_value, t.critical_value) for t in tests}) == 1
    np.testing.assert_allclose([t.statistic for t in tests], tests[0].statistic)


def test_folded_u_values_see_the_spread_and_not_the_mean(posterior: Posterior) -> None:
    z = GRID[10::20]  # 50 values, as regular as can be
    cases = (
        (z, False, False),
        (0.65 * z, False, True),
        (1.5 * z, False, True),
        (z + 0.6, True, False),
    )
    for y, plain, folded in cases:
        for population in (GRID, posterior(200)):
            tests = [prb.area_test(y, population, folded=f, null=QUICK) for f in (False, True)]
            assert [t.rejected for t in tests] == [plain, folded]
    assert tests[1].statistic == area(np.abs(2 * tests[1].u_values - 1))
    assert "area of |2u - 1|" in repr(tests[1])
    assert bool(tests[1].to_dataset().folded)


def test_shared_specimens_that_were_not_predicted_together_are_refused() -> None:
    y = np.random.default_rng(13).normal(size=5)
    labels = [range(5), range(5)]
    other = [as_array([GRID], specimens_id="x"), as_array([GRID], specimens_id="y")]
    same, different = [other[0], other[0]], other
    with pytest.raises(ValueError, match=r"with different specimens, .*, n_draws and"):
        prb.area_test([y, y], different, specimens=labels)
    with pytest.raises(ValueError, match="predicted with shapes"):
        prb.area_test([y, y], [GRID, GRID[::2]], specimens=labels)
    assert prb.area_test([y, y], different, null=QUICK).p_value > 0
    assert prb.area_test([y, y], same, null=QUICK, specimens=labels).p_value > 0


def test_the_calibrations_own_specimens_are_refused(posterior: Posterior) -> None:
    predicted = as_array(posterior(), calibration_specimens=["1", "2"])
    y = np.array([0.1, 0.2])
    for labels in ([2, 3], ["2", "x"], [2.0, 3.0]):
        with pytest.raises(ValueError, match=r"1 specimens of the calibration, such as '2'.*Joint"):
            prb.area_test(y, predicted, specimens=labels)
    assert not prb.area_test(y, predicted, specimens=[3, 4]).rejected


def test_the_result_is_readable_and_saved(tmp_path: Path, posterior: Posterior) -> None:
    rng = np.random.default_rng(1)
    y = rng.normal(3, 1, 12)
    test = prb.area_test({"a": y[:5], "b": y[5:]}, {"a": posterior(), "b": posterior()}, null=QUICK)
    assert "ValidityTest: rejected at level 0.05" in repr(test)
    assert "12 values of 12 specimens, 2 conditions" in repr(test)
    dataset = test.to_dataset()
    dataset.to_netcdf(tmp_path / "test.nc")
    xr.testing.assert_equal(xr.load_dataset(tmp_path / "test.nc"), dataset)
    assert dataset.condition.values.tolist() == ["a"] * 5 + ["b"] * 7
    assert float(dataset.p_value) == test.p_value == 1 / 1000
    # Directions of several outputs are no conditions.
    outputs = rng.normal(0, 1, (50, 40, 2))
    test = prb.area_test(rng.normal(0, 1, (9, 2)), outputs, null=QUICK)
    assert len(test.of_conditions) == 1
    assert "of 9 specimens, 1 condition, seen in 4 directions" in repr(test)
    assert "9 specimens with 36 values in all" in test.null


@pytest.mark.parametrize(
    ("observed", "predicted", "keywords", "match"),
    [
        ([1.0] * 10, GRID[::20], {}, "predicted: got 50 values for 10 observed ones"),
        ([1.0, 2.0], GRID, {"specimens": [1, 1], "null": EXACT}, "2 values of 1 specimen"),
        ([1.0], GRID, {"null": "exact"}, r"null: got str 'exact', expected prb\.validation\.Pos"),
    ],
)
def test_refusals(observed: Any, predicted: Any, keywords: dict[str, Any], match: str) -> None:
    with pytest.raises((TypeError, ValueError), match=match):
        prb.area_test(observed, predicted, **keywords)


@pytest.mark.slow
@pytest.mark.parametrize(("n0", "n", "plug_in"), [(15, 20, 0.21), (30, 20, 0.15), (15, 50, 0.40)])
def test_a_right_model_is_rejected_as_often_as_stated(n0: int, n: int, plug_in: float) -> None:
    """The default has its nominal size; what it replaces has not, nor values drawn one by one."""
    names = ("default", "plug-in", "uniform", "value by value")
    found: dict[str, list[bool]] = {name: [] for name in names}
    for i in range(1000):
        rng = np.random.default_rng([11, n0, n, i])
        data, fresh = rng.normal(size=n0), rng.normal(size=n)
        predicted = validity.posterior_populations(data, rng)
        null = prb.validation.PosteriorNull(999, random_seed=i)
        test = prb.area_test(fresh, predicted, null=null)
        best = area(ndtr((fresh - data.mean()) / data.std(ddof=1)))
        drawn = rng.choice(predicted.ravel(), 500 * n)
        pooled = prb.validation.u_values(drawn, predicted).reshape(500, n)
        found["default"].append(test.rejected)
        found["plug-in"].append(EXACT.p_value(float(best), n) <= 0.05)
        found["uniform"].append(EXACT.p_value(test.statistic, n) <= 0.05)
        found["value by value"].append(test.statistic > float(np.quantile(area(pooled), 0.95)))
    shares = {name: np.mean(rejected) for name, rejected in found.items()}
    # Standard errors with 1000 data sets: .007 at .05, .013 at .21.
    assert abs(shares["default"] - 0.05) < 0.03
    assert abs(shares["plug-in"] - plug_in) < 0.06
    assert shares["uniform"] > plug_in - 0.08
    assert shares["value by value"] > plug_in - 0.08


def test_the_envelope_contains_its_share_of_uniform_numbers() -> None:
    rng = np.random.default_rng(14)
    lower, upper = envelope(rng.random((999, 20)), 0.1)
    u = np.sort(rng.random((4000, 20)), axis=1)
    inside = ((u >= lower) & (u <= upper)).all(axis=1).mean()
    # Standard errors: .009 of the envelope, .005 of the share.
    assert abs(inside - 0.9) < 0.045
    np.testing.assert_allclose(lower + upper[::-1], 1, atol=0.04)


def test_the_envelope_of_many_uniform_numbers_follows_their_order_statistics() -> None:
    n = 50_000
    lower, upper = uniform_envelope(n, 0.05)
    assert lower.shape == upper.shape == (n,)
    assert (np.diff(lower) > 0).all()
    assert (np.diff(upper) > 0).all()
    rank = np.arange(1, n + 1)
    # Probabilities of order statistics beyond the bounds: alike from the first rank to the last.
    at = np.r_[0:3, 10:n:500, n - 3 : n]
    order = stats.beta(rank[at], n + 1 - rank[at])
    for tail in (order.cdf(lower[at]), order.sf(upper[at])):
        assert tail.max() < 0.02
        assert 1e-4 < np.median(tail) < 0.01


def test_as_many_replicates_are_inside_the_envelope_as_asked_for() -> None:
    replicates = np.random.default_rng(1).random((999, 12))
    rows = np.sort(replicates, axis=1)
    for level in (0.5, 0.1, 0.02):
        lower, upper = envelope(replicates, level)
        inside = ((rows >= lower) & (rows <= upper)).all(axis=1).mean()
        # Depths are integers: many replicates share one.
        assert 1 - level <= inside < 1 - level + 0.05
    # Of one value it is an interval between two replicates.
    assert envelope((np.arange(99) + 1.0)[:, None] / 100, 0.1) == (0.05, 0.95)


def test_failures_that_no_population_has_are_reported(caplog: pytest.LogCaptureFixture) -> None:
    predicted = np.linspace(0, 1, 401)
    prb.area_test([0.2, 0.4, 0.8, np.inf], predicted, progressbar=False)
    assert "1 of 4 measured values are +inf, and no predicted one" in caplog.text
    caplog.clear()
    prb.area_test([0.2, 0.4, 0.8, np.inf], np.append(predicted, np.inf), progressbar=False)
    assert not caplog.text


def test_a_reading_error_that_is_left_out_is_reported(caplog: pytest.LogCaptureFixture) -> None:
    x = np.random.default_rng(3).normal(1.0, 0.3, 24)
    error = 0.5 * np.random.default_rng(4).standard_normal(24)

    def response(x: Any) -> Any:
        return 2.0 * x

    def reading(x: Any, e: Any) -> Any:
        return response(x) + e

    with pm.Model() as model:
        population = pm.Normal.dist(pm.Normal("mu", 0.0, 2.0), pm.HalfNormal("sigma", 1.0))
        metric = prb.LogLikelihood(error=0.5)
        observed = response(x) + error
        prb.Simulator("y", response, population, observed=observed, metric=metric)
        optimum = prb.minimize()
    fresh = 2.0 + np.random.default_rng(5).normal(0.0, 0.8, 20)
    without = prb.predict(optimum, response, population, model=model)
    as_input = prb.predict(optimum, reading, population, pm.Normal.dist(0.0, 0.5), model=model)
    added = without + 0.5 * np.random.default_rng(6).standard_normal(without.shape)
    for predicted, is_reported in ((without, True), (as_input, False), (added, False)):
        caplog.clear()
        for given in (predicted, {"new": predicted}):
            measured: Any = {"new": fresh} if isinstance(given, dict) else fresh
            prb.area_test(measured, given)
        assert caplog.text.count("without the error of readings") == 2 * is_reported
