"""u-values, the area test and its null distributions."""

import sys
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm
import pytest
import xarray as xr
from scipy.special import ndtr, ndtri

import prbayes as prb
from prbayes._checks import Floats
from prbayes.validation.nulls import Case, Condition, Predictive, SimulatedNull, _table, area, envelope

sys.path.insert(0, str(Path(__file__).parents[2]))

from benchmarks import area_null, validity

# Critical values at 5%, by simulation: the fourth digit is uncertain by one or two.
PUBLISHED = {5: 0.2567, 10: 0.1828, 15: 0.1500, 20: 0.1297, 30: 0.1057, 50: 0.0824, 100: 0.0580}
EXACT = prb.ExactModel()
QUICK = prb.PosteriorNull(999)
GRID = ndtri((np.arange(1000) + 0.5) / 1000)  # a standard normal population


def posterior(n0: int = 15, seed: int = 0) -> Floats:
    rng = np.random.default_rng(seed)
    return np.asarray(validity.posterior_populations(rng.normal(size=n0), rng))


def as_array(values: Any, **attrs: Any) -> xr.DataArray:
    return xr.DataArray(np.asarray(values)[None], dims=("chain", "draw", "sample"), name="crack", attrs=attrs)


# -- the statistic ---------------------------------------------------------------------------------------


def test_area_of_known_samples() -> None:
    assert area(np.array([0.5])) == 0.25
    assert area(np.array([0.2])) == pytest.approx((0.2**2 + 0.8**2) / 2)
    for n in (1, 4, 9):
        assert area((np.arange(n) + 0.5) / n) == pytest.approx(1 / (4 * n))
        assert area(np.zeros(n)) == area(np.ones(n)) == 0.5


def test_area_is_the_integral() -> None:
    u = np.random.default_rng(1).random((3, 7))
    v = (np.arange(200_000) + 0.5) / 200_000
    integral = [np.abs(np.searchsorted(np.sort(row), v, side="right") / 7 - v).mean() for row in u]
    np.testing.assert_allclose(area(u), integral, atol=1e-5)


def test_area_does_not_care_for_order_or_reflection() -> None:
    rng = np.random.default_rng(2)
    u = rng.random((5, 11))
    np.testing.assert_allclose(area(rng.permuted(u, axis=1)), area(u))
    np.testing.assert_allclose(area(1 - u), area(u))


# -- u-values --------------------------------------------------------------------------------------------


def test_u_values_are_the_middle_of_the_steps() -> None:
    predicted = np.array([[1.0, 2.0], [2.0, 3.0]])
    np.testing.assert_allclose(prb.u_values([0, 1, 1.5, 2, 3, 4], predicted), [0, 0.125, 0.25, 0.5, 0.875, 1])


@pytest.mark.parametrize("change", [lambda y: 3 * y - 2, np.exp])
def test_u_values_do_not_care_for_increasing_transformations(change: Callable[[Floats], Floats]) -> None:
    y = np.array([-1.0, 0.3, 2.2])
    np.testing.assert_array_equal(prb.u_values(change(y), change(posterior())), prb.u_values(y, posterior()))


def test_u_values_of_a_decreasing_transformation_are_reflected() -> None:
    y = np.array([-1.0, 0.3, 2.2])
    np.testing.assert_allclose(prb.u_values(-y, -posterior()), 1 - prb.u_values(y, posterior()))


def test_randomised_u_values_of_ties_are_uniform() -> None:
    rng = np.random.default_rng(3)
    counts, predicted = rng.poisson(2, 4000), np.random.default_rng(4).poisson(2, 200_000)
    u = prb.u_values(counts, predicted, random_seed=1)
    np.testing.assert_array_equal(u, prb.u_values(counts, predicted, random_seed=1))
    assert EXACT.p_value(float(area(u)), u.size) > 0.01
    middle = prb.u_values(counts, predicted)
    assert np.unique(middle).size == np.unique(counts).size
    assert EXACT.p_value(float(area(middle)), u.size) < 1e-6


def test_failed_specimens_are_the_largest_and_nan_is_left_out() -> None:
    predicted = np.array([1.0, np.nan, 2.0, np.inf, np.inf])
    np.testing.assert_allclose(prb.u_values([0.5, 1.5, 9.0, np.inf], predicted), [0, 0.25, 0.5, 0.75])


def test_rounded_measurements_have_ties_with_predictions_rounded_alike() -> None:
    rng = np.random.default_rng(5)
    predicted = as_array(rng.normal(0, 1, (1, 50_000)), nan=0)
    u = prb.u_values(rng.normal(0, 1, 2000).round(0), predicted.round(0), random_seed=1)
    assert EXACT.p_value(float(area(u)), 2000) > 0.01


def test_weights_of_a_predictive_distribution() -> None:
    y = np.array([0.0, 1.0, 2.0, 3.0])
    twice = Predictive(np.array([1.0, 2.0, 2.0])).transform(y, None)
    np.testing.assert_allclose(Predictive(np.array([2.0, 1.0]), np.array([4.0, 2.0])).transform(y, None), twice)


def test_u_values_of_conditions_follow_one_another() -> None:
    a, b = np.array([0.1, 0.2]), np.array([0.3])
    one = np.concatenate([prb.u_values(a, posterior()), prb.u_values(b, 2 * posterior())])
    both = {"late": 2 * posterior(), "early": posterior()}
    np.testing.assert_array_equal(prb.u_values([a, b], [posterior(), 2 * posterior()]), one)
    np.testing.assert_array_equal(prb.u_values({"early": a, "late": b}, both), one[[2, 0, 1]])


# -- the exact null --------------------------------------------------------------------------------------


@pytest.mark.parametrize(("n", "published"), PUBLISHED.items())
def test_published_critical_values(n: int, published: float) -> None:
    assert EXACT.critical_value(n) == pytest.approx(published, abs=4e-4)


def test_the_limit_for_many_values() -> None:
    scaled = [np.sqrt(n) * EXACT.critical_value(n) for n in (500, 1000, 10_000)]
    np.testing.assert_allclose(scaled, 0.5821, atol=2e-4)


def test_one_value_has_a_closed_form() -> None:
    # A = 1/4 + (u - 1/2)^2
    for level in (0.5, 0.1, 0.05, 0.01):
        assert EXACT.critical_value(1, level) == pytest.approx(0.25 + ((1 - level) / 2) ** 2, abs=1e-4)
    assert EXACT.p_value(0.25 + 0.3**2, 1) == pytest.approx(0.4, abs=2e-3)


@pytest.mark.parametrize("n", [2, 3, 4, 7, 23, 60, 170])
def test_the_table_against_simulation(n: int) -> None:
    size = 100_000
    found = area(np.random.default_rng(n).random((size, n)))
    for level in (0.9, 0.5, 0.1, 0.05, 0.01, 0.001):
        share = float((found > EXACT.critical_value(n, level)).mean())
        assert abs(share - level) < 4.5 * np.sqrt(level * (1 - level) / size)


def test_the_table_is_what_its_script_makes() -> None:
    sizes, _, rows = _table()
    for n in (1, 9):
        np.testing.assert_allclose(area_null.quantiles(n), rows[sizes == n][0], atol=2e-6)
    np.testing.assert_allclose(area_null.areas(np.array([0.2, 0.5])), area(np.array([0.2, 0.5])))


def test_the_table_is_monotone() -> None:
    sizes, logs, rows = _table()
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


# -- the null of a posterior -----------------------------------------------------------------------------


def test_with_one_population_the_null_is_the_exact_one() -> None:
    test = prb.area_test(GRID[::50], GRID, null=prb.PosteriorNull(19_999))
    # The density of the area at its 95% point makes the standard error of a quantile about .001.
    assert test.critical_value == pytest.approx(EXACT.critical_value(20), abs=0.004)
    assert "the predicted population" in test.null


def test_an_uncertain_population_is_rejected_less_easily() -> None:
    rng = np.random.default_rng(1)
    predicted = posterior()
    critical = prb.area_test(rng.normal(size=20), predicted, null=QUICK).critical_value
    assert critical > 1.25 * EXACT.critical_value(20)


def test_default_nulls() -> None:
    y = np.random.default_rng(1).normal(size=20)
    assert "one of 400 populations" in prb.area_test(y, posterior()).null
    assert "is exact" in prb.area_test(y, GRID).null
    assert "10 specimens measured 20 times" in prb.area_test(y, GRID, specimens=np.arange(20) // 2).null


@pytest.mark.parametrize("shift", [0.0, 0.3, 0.6, 0.9, 1.2])
def test_a_statistic_beyond_the_critical_value_is_one_with_a_small_p_value(shift: float) -> None:
    y = np.random.default_rng(6).normal(shift, 1, 20)
    for predicted in (posterior(), GRID):
        test = prb.area_test(y, predicted, level=0.1, null=QUICK)
        assert test.rejected == (test.p_value <= 0.1) == (test.statistic > test.critical_value)
        assert test.statistic == area(test.u_values)


def test_p_values_of_replicates_count_the_observed_data_in() -> None:
    AREAS = np.linspace(0.01, 0.49, 19)

    class Fixed(SimulatedNull):
        def replicates_of(self, case: Case) -> Iterator[Floats]:
            yield AREAS[:, None]

        def describe(self, case: Case) -> str:
            return ""

    case = Case((Condition("a", np.zeros(1), np.zeros((1, 1)), None, np.zeros(1, dtype=int)),), 1, False, None)

    def judged(statistic: float, level: float) -> tuple[float, float]:
        found = Fixed().judge(case, statistic, level)
        return found.p_value, found.critical_value

    areas = area(AREAS[:, None])  # falling
    assert judged(0.5, 0.05) == (1 / 20, areas[0])
    assert judged(areas[0], 0.05)[0] == 2 / 20
    assert judged(0.0, 0.10) == (1.0, areas[1])
    with pytest.raises(ValueError, match=r"level: got 0\.01 with 19 replicates"):
        Fixed().judge(case, 0.5, 0.01)


def test_the_test_does_not_care_for_order_or_increasing_transformations() -> None:
    y = np.random.default_rng(7).normal(size=15)
    tests = [
        prb.area_test(y, posterior(), null=QUICK),
        prb.area_test(y[::-1], posterior(), null=QUICK),
        prb.area_test(2 * y + 1, 2 * posterior() + 1, null=QUICK),
        prb.area_test(np.exp(y), np.exp(posterior()), null=QUICK),
    ]
    assert len({(t.p_value, t.critical_value) for t in tests}) == 1
    np.testing.assert_allclose([t.statistic for t in tests], tests[0].statistic)


def test_nan_is_left_out_of_populations() -> None:
    predicted = posterior()
    holes = np.where(np.random.default_rng(8).random(predicted.shape) < 0.2, np.nan, predicted)
    holes[3] = np.nan
    y = np.random.default_rng(9).normal(size=20)
    with_holes, whole = (prb.area_test(y, p, null=prb.PosteriorNull(9999)) for p in (holes, predicted))
    assert with_holes.statistic == pytest.approx(whole.statistic, abs=0.01)
    assert with_holes.critical_value == pytest.approx(whole.critical_value, rel=0.08)


def test_ties_in_populations_are_randomised_alike() -> None:
    """Discrete responses: with a seed the size stays nominal, as if they were continuous."""
    test = prb.area_test(np.zeros(5), np.round(GRID), null=prb.PosteriorNull(9999), random_seed=1)
    assert test.critical_value == pytest.approx(EXACT.critical_value(5), abs=0.01)


def test_the_envelope_holds_right_models_and_no_wrong_ones() -> None:
    rng = np.random.default_rng(14)
    lower, upper = envelope(rng.random((999, 20)), 0.1)
    u = np.sort(rng.random((4000, 20)), axis=1)
    inside = ((u >= lower) & (u <= upper)).all(axis=1).mean()
    # Standard errors: .009 of the envelope, .005 of the share.
    assert abs(inside - 0.9) < 0.045
    np.testing.assert_allclose(lower + upper[::-1], 1, atol=0.04)
    y = rng.normal(size=20)
    for population in (GRID, posterior(200)):
        for shift, expected in ((0.0, True), (1.5, False)):
            test = prb.area_test(y + shift, population, null=QUICK)
            low, high = test.envelope
            ranked = np.sort(test.u_values)
            assert ((ranked >= low) & (ranked <= high)).all() == expected
    wider, narrow = (np.ptp(prb.area_test(y, p, null=QUICK).envelope, axis=0).mean() for p in (posterior(15), GRID))
    assert wider > 1.2 * narrow


# -- folded u-values -------------------------------------------------------------------------------------


def test_folded_u_values_see_the_spread_and_not_the_mean() -> None:
    z = GRID[10::20]  # 50 values, as regular as can be
    cases = ((z, False, False), (0.65 * z, False, True), (1.5 * z, False, True), (z + 0.6, True, False))
    for y, plain, folded in cases:
        for population in (GRID, posterior(200)):
            tests = [prb.area_test(y, population, folded=f, null=QUICK) for f in (False, True)]
            assert [t.rejected for t in tests] == [plain, folded]
    assert tests[1].statistic == area(np.abs(2 * tests[1].u_values - 1))
    assert "area of |2u - 1|" in repr(tests[1])
    assert bool(tests[1].to_dataset().folded)


def test_folded_u_values_have_the_same_exact_null_and_their_own_for_a_posterior() -> None:
    y = GRID[::50]
    exact = [prb.area_test(y, GRID, folded=f, null=prb.PosteriorNull(19_999)).critical_value for f in (False, True)]
    np.testing.assert_allclose(exact, EXACT.critical_value(20), atol=0.004)
    plain, folded = (prb.area_test(y, posterior(), folded=f).critical_value for f in (False, True))
    # Doubt about the spread moves the folded values, doubt about the mean hardly; by simulation .1725 and .182 +- .001.
    assert 1.2 * EXACT.critical_value(20) < folded < plain


# -- specimens and conditions ----------------------------------------------------------------------------


def test_repeated_measurements_are_not_counted_as_independent() -> None:
    rng = np.random.default_rng(10)
    y = rng.normal(size=20)
    labels = np.arange(20)
    null = prb.PosteriorNull(9999)

    def test(specimens: Any) -> prb.ValidityTest:
        return prb.area_test({"a": y, "b": 2 * y}, {"a": GRID, "b": 2 * GRID}, null=null, specimens=specimens)

    together, apart = test({"a": labels, "b": labels}), test(None)
    # The second response tells nothing new: 40 values, but the critical value of 20.
    assert together.statistic == apart.statistic
    assert together.critical_value == pytest.approx(EXACT.critical_value(20), abs=0.004)
    assert apart.critical_value == pytest.approx(EXACT.critical_value(40), abs=0.004)


def test_all_conditions_take_the_same_draw() -> None:
    """Two conditions of fresh specimens share the doubt about the population."""
    y = np.random.default_rng(11).normal(size=20)
    both = prb.area_test([y[:10], 5 * y[10:]], [posterior(), 5 * posterior()], null=prb.PosteriorNull(9999))
    one = prb.area_test(y, posterior(), null=prb.PosteriorNull(9999))
    assert both.critical_value == pytest.approx(one.critical_value, rel=0.05)


def test_a_specimen_measured_twice_under_one_condition() -> None:
    y = np.repeat(np.random.default_rng(12).normal(size=10), 2)
    test = prb.area_test(y, GRID, null=prb.PosteriorNull(9999), specimens=np.repeat(list("abcdefghij"), 2))
    assert test.critical_value == pytest.approx(EXACT.critical_value(10), abs=0.005)
    assert test.specimens.tolist()[:3] == ["a", "a", "b"]


def test_shared_specimens_that_were_not_predicted_together_are_refused() -> None:
    y = np.random.default_rng(13).normal(size=5)
    labels = [range(5), range(5)]
    other = [as_array([GRID], specimens_id="x"), as_array([GRID], specimens_id="y")]
    with pytest.raises(ValueError, match="predicted with different specimens, expected the same"):
        prb.area_test([y, y], other, specimens=labels)
    with pytest.raises(ValueError, match="predicted with shapes"):
        prb.area_test([y, y], [GRID, GRID[::2]], specimens=labels)
    assert prb.area_test([y, y], other, null=QUICK).p_value > 0
    assert prb.area_test([y, y], [other[0], other[0]], null=QUICK, specimens=labels).p_value > 0


def test_the_calibrations_own_specimens_are_refused() -> None:
    predicted = as_array(posterior(), calibration_specimens=["1", "2"])
    y = np.array([0.1, 0.2])
    for labels in ([2, 3], ["2", "x"], [2.0, 3.0]):
        with pytest.raises(ValueError, match=r"1 specimens of the calibration, such as '2'.*JointNull"):
            prb.area_test(y, predicted, specimens=labels)
    assert not prb.area_test(y, predicted, specimens=[3, 4]).rejected


# -- joint calibration and test --------------------------------------------------------------------------


def same(x: Any) -> Any:
    return x


def double(x: Any) -> Any:
    return 2 * x


DATA = np.random.default_rng(20).normal(10, 1, 20)


@cache
def calibrated(labelled: bool = False) -> tuple[prb.Optimum, Any]:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 10, 3), pm.HalfNormal("sigma", 3))
        prb.Simulator(
            "y", same, x, metric=prb.AreaMetric(), observed=DATA, propagation=prb.Reweighted(512),
            specimens=np.arange(20) if labelled else None,
        )  # fmt: skip
    return prb.minimize(model), x


def test_own_data_take_the_joint_null() -> None:
    optimum, x = calibrated()
    predicted = prb.predict(optimum, same, x, random_seed=1)
    with pytest.raises(ValueError, match="the very data of the calibration"):
        prb.area_test(DATA[::-1], predicted)
    test = prb.area_test(DATA[::-1], predicted, null=prb.JointNull(optimum, replicates=999))
    # A fitted normal distribution follows its own data. 1500 normal samples of 20, fitted by Nelder-Mead to the
    # smallest area and tested by formulas of their own, have the 95% point .0571; standard error of both .001.
    assert test.critical_value == pytest.approx(0.0571, abs=0.004)
    assert not test.rejected
    assert test.p_value > 0.05


def test_own_specimens_under_another_condition_are_as_close_as_under_their_own() -> None:
    optimum, x = calibrated(labelled=True)
    null = prb.JointNull(optimum, (double, x), replicates=199)
    own = prb.area_test(DATA, prb.predict(optimum, same, x), null=prb.JointNull(optimum, replicates=199))
    predicted = prb.predict(optimum, double, x)
    later = prb.area_test(2 * DATA, predicted, null=null, specimens=np.arange(20))
    # 2 y tells the same as y; refits and replicates are the same.
    assert later.critical_value == pytest.approx(own.critical_value, rel=1e-6)
    fresh = prb.area_test(2 * DATA, predicted, null=null, specimens=np.arange(100, 120))
    assert fresh.critical_value > 1.15 * EXACT.critical_value(20)
    with pytest.raises(ValueError, match="specimens of the calibration"):
        prb.area_test(2 * DATA, predicted, specimens=np.arange(20))


def test_the_joint_null_rejects_what_the_family_cannot_follow() -> None:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 3), pm.HalfNormal("sigma", 3))
        data = np.concatenate([np.full(15, -1.0), np.full(15, 1.0)]) + np.random.default_rng(2).normal(0, 0.05, 30)
        prb.Simulator("y", same, x, metric=prb.AreaMetric(), observed=data, propagation=prb.Reweighted(512))
    optimum = prb.minimize(model)
    test = prb.area_test(
        data, prb.predict(optimum, same, x, random_seed=1), null=prb.JointNull(optimum, replicates=199)
    )
    assert test.rejected


def test_a_resimulated_model_has_a_joint_null_too() -> None:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 10, 3), pm.HalfNormal("sigma", 3))
        prb.Simulator("y", same, x, metric=prb.AreaMetric(), observed=DATA, propagation=prb.Resimulated(256))
    optimum = prb.minimize(model)
    predicted = prb.predict(optimum, same, x, random_seed=1)
    test = prb.area_test(DATA, predicted, null=prb.JointNull(optimum, replicates=199))
    assert test.critical_value == pytest.approx(0.0571, abs=0.012)  # to first order
    with pytest.raises(ValueError, match=r"no simulator with prb\.Reweighted has"):
        prb.area_test(2 * DATA, 2 * predicted, null=prb.JointNull(optimum, (double, x), replicates=19), level=0.1)


def test_refusals_of_the_joint_null() -> None:
    optimum, x = calibrated()
    null = prb.JointNull(optimum, replicates=19)
    with pytest.raises(ValueError, match="got 400 draws, expected the one population"):
        prb.area_test(DATA, posterior(), null=null, level=0.1)
    with pytest.raises(ValueError, match="distribution function differs by"):
        prb.area_test(DATA, prb.predict(optimum, double, x), null=null, level=0.1)
    two = prb.predict(optimum, same, x, random_seed=1)
    with pytest.raises(ValueError, match=r"condition 'late', expected the name of a simulator, \['y'\]"):
        prb.area_test({"late": DATA, "y": DATA}, {"late": two, "y": two}, null=null, level=0.1)
    with pytest.raises(TypeError, match="got str, expected an Optimum"):
        prb.JointNull("optimum")  # type: ignore[arg-type]
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 10, 3), 1.0)
        prb.Simulator("y", same, x, metric=prb.FunctionMetric(lambda s, o: np.abs(s.mean(-1) - o.mean())),
                      observed=DATA, propagation=prb.Resimulated(64))  # fmt: skip
    with pytest.raises(ValueError, match="a FunctionMetric, of which nothing is known without refits"):
        prb.JointNull(prb.minimize(model, method="Nelder-Mead"))


# -- the result, and refusals ----------------------------------------------------------------------------


def test_the_result_is_readable_and_saved(tmp_path: Path) -> None:
    y = np.random.default_rng(1).normal(3, 1, 12)
    test = prb.area_test({"a": y[:5], "b": y[5:]}, {"a": posterior(), "b": posterior()}, null=QUICK)
    assert "ValidityTest: rejected at level 0.05" in repr(test)
    assert "12 values of 12 specimens, 2 condition(s)" in repr(test)
    dataset = test.to_dataset()
    dataset.to_netcdf(tmp_path / "test.nc")
    xr.testing.assert_equal(xr.load_dataset(tmp_path / "test.nc"), dataset)
    assert dataset.condition.values.tolist() == ["a"] * 5 + ["b"] * 7
    assert float(dataset.p_value) == test.p_value == 1 / 1000
    with pytest.raises(AttributeError):
        test.level = 0.1  # type: ignore[misc]


@pytest.mark.parametrize(
    ("observed", "predicted", "keywords", "match"),
    [
        ([1.0, np.nan], GRID, {}, "observed: got 1 NaN or -inf among 2 values.*leave missing"),
        ([[1.0]], GRID, {}, r"observed: got shape \(1, 1\), expected \(n,\)"),
        ([], GRID, {}, "observed: got shape"),
        ([1.0], np.full(20, np.nan), {}, "nothing but NaN"),
        ([1.0], np.array(1.0), {}, r"predicted: got shape \(\)"),
        ([1.0], xr.DataArray(GRID, dims="x"), {}, r"got a DataArray with dims \('x',\)"),
        ([1.0] * 10, GRID[::20], {}, "predicted: got 50 values for 10 observed ones"),
        ([1.0], GRID, {"level": 1.0}, "level: got 1.0, expected a probability"),
        ([1.0], GRID, {"specimens": [1, 2]}, r"specimens: got shape \(2,\), expected \(1,\)"),
        ([1.0, 2.0], GRID, {"specimens": [1, 1], "null": EXACT}, "2 values of 1 specimens"),
        ({"a": [1.0]}, {"b": GRID}, {}, r"observed: got \['a'\], expected a mapping with the conditions .* \['b'\]"),
        ({"a": [1.0]}, GRID, {}, "predicted: got ndarray, expected a mapping"),
        ([1.0], {"a": GRID}, {}, "observed: got list, expected a mapping"),
        ([[1.0]], [GRID, GRID], {}, "observed: got 1 conditions, expected a list with the 2"),
        ([[1.0], [1.0]], [GRID, posterior()], {}, r"got \[1, 400\] draws"),
        ([1.0], GRID, {"random_seed": -1}, "random_seed: got -1"),
    ],
)
def test_refusals(observed: Any, predicted: Any, keywords: dict[str, Any], match: str) -> None:
    with pytest.raises(ValueError, match=match):
        prb.area_test(observed, predicted, **keywords)


def test_refused_types() -> None:
    with pytest.raises(TypeError, match=r"null: got str 'exact', expected prb\.PosteriorNull"):
        prb.area_test([1.0], GRID, null="exact")  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="null: got ABCMeta"):
        prb.area_test([1.0], GRID, null=prb.ExactModel)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="expected real numbers"):
        prb.area_test(["a"], GRID)  # type: ignore[list-item]
    with pytest.raises(ValueError, match="PosteriorNull: replicates: got 5"):
        prb.PosteriorNull(5)


# -- sizes: studies --------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(("n0", "n", "plug_in"), [(15, 20, 0.21), (30, 20, 0.15), (15, 50, 0.40)])
def test_a_right_model_is_rejected_as_often_as_stated(n0: int, n: int, plug_in: float) -> None:
    """The default has its nominal size; what it replaces has not, nor replicates drawn value by value."""
    size = 1000
    found: dict[str, list[bool]] = {"default": [], "plug-in": [], "uniform": [], "value by value": []}
    for i in range(size):
        rng = np.random.default_rng([11, n0, n, i])
        data, fresh = rng.normal(size=n0), rng.normal(size=n)
        predicted = validity.posterior_populations(data, rng)
        test = prb.area_test(fresh, predicted, null=prb.PosteriorNull(999, seed=i))
        best = area(ndtr((fresh - data.mean()) / data.std(ddof=1)))
        pooled = prb.u_values(rng.choice(predicted.ravel(), 500 * n), predicted).reshape(500, n)
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


@pytest.mark.slow
def test_sizes_through_the_whole_of_prbayes() -> None:
    found = validity.pipeline(20, 20, 150)
    shares = {name: float(np.mean(np.array(p) <= 0.1)) for name, p in found.items()}
    # 150 data sets: standard error .025 at .1.
    assert abs(shares["default"] - 0.1) < 0.09
    assert abs(shares["own data, JointNull"] - 0.1) < 0.1
    assert shares["own data, ExactModel"] == 0
    assert shares["optimum, ExactModel"] > 0.15


@pytest.mark.slow
def test_power_beside_other_tests() -> None:
    table = validity.power(500)
    for shares in table.values():
        assert abs(shares["none"] - 0.05) < 0.05  # 500 data sets: standard error .01
    for label in ("mean + 0.5 sd", "mean + 0.75 sd", "mean + 1 sd"):
        assert table["area"][label] > table["Kolmogorov-Smirnov"][label] - 0.05
