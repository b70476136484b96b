"""Null distributions: replicates of a posterior, an exact population, the calibration's own data."""

import re
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm
import pytest
from one_input import one_input
from scipy.special import ndtr, ndtri

import prbayes as prb
from benchmarks import area_null
from prbayes._validate import Floats
from prbayes.validation.nulls import judge_by_replicates, table
from prbayes.validation.pit import Case, area, read_case

Posterior = Callable[..., Any]
EXACT = prb.validation.ExactModel()
PUBLISHED = {5: 0.2567, 10: 0.1828, 15: 0.1500, 20: 0.1297, 30: 0.1057, 50: 0.0824, 100: 0.0580}
GRID = ndtri((np.arange(1000) + 0.5) / 1000)  # a standard normal population


def critical(observed: Any, predicted: Any, null: Any = None, **keywords: Any) -> float:
    """Return the critical value of a posterior's null with 9999 replicates."""
    null = null or prb.validation.PosteriorNull()
    return prb.area_test(observed, predicted, null=null, **keywords).critical_value


def test_critical_values_of_an_exact_and_an_uncertain_population(posterior: Posterior) -> None:
    # The density of the area at its 95% point makes the standard error of a quantile about .001.
    null = prb.validation.PosteriorNull(19_999)
    assert critical(GRID[::50], GRID, null) == pytest.approx(EXACT.critical_value(20), abs=0.004)
    y = np.random.default_rng(1).normal(size=20)
    assert critical(y, posterior()) > 1.25 * EXACT.critical_value(20)
    # Discrete responses: with random u-values of ties the size stays nominal.
    ties = critical(np.zeros(5), np.round(GRID), randomize=True)
    assert ties == pytest.approx(EXACT.critical_value(5), abs=0.01)


@pytest.mark.parametrize("folded", [False, True])
def test_a_known_population_with_ties_has_their_critical_value(folded: bool) -> None:
    # Half of the specimens are at the limit of the instrument: their u is 3/4, and not uniform.
    rng = np.random.default_rng(3)
    z = rng.normal(size=(20_000, 40))
    u = np.where(z < 0, ndtr(z), 0.75)
    areas = area(np.abs(2 * u - 1) if folded else u)
    got = critical(np.minimum(z[0], 0), np.minimum(GRID, 0), EXACT, folded=folded)
    assert got == pytest.approx(np.quantile(areas, 0.95), abs=0.004)
    assert got > EXACT.critical_value(40) + 0.02
    # A value that a population happens to have once is no tie.
    assert critical(GRID[::50], GRID, EXACT) == EXACT.critical_value(20)


def test_p_values_of_replicates_count_the_observed_data_in() -> None:
    u = np.linspace(0.01, 0.49, 19)[:, None]
    case = read_case([0.0], np.zeros((1, 1)))

    def judged(statistic: float, alpha: float) -> tuple[float, float]:
        judgement = judge_by_replicates([u], case, statistic, alpha)
        return judgement.p_value, judgement.critical_value

    areas = area(u)  # falling
    assert judged(0.5, 0.05) == (1 / 20, areas[0])
    assert judged(areas[0], 0.05)[0] == 2 / 20
    assert judged(0.0, 0.10) == (1.0, areas[1])
    with pytest.raises(ValueError, match=r"alpha: got 0\.01 with 19 replicates"):
        judge_by_replicates([u], case, 0.5, 0.01)


def test_a_likelihood_by_specimen_has_no_joint_null() -> None:
    optimum = prb.minimize(one_input(GRID[::50], response=double, sd=1.0), starts=0)
    with pytest.raises(ValueError, match=r"log-likelihood by specimen; .* prb\.cross_validate"):
        prb.validation.JointNull(optimum)


def test_repeated_measurements_are_not_counted_as_independent(posterior: Posterior) -> None:
    y = np.random.default_rng(10).normal(size=20)
    data, populations = {"a": y, "b": 2 * y}, {"a": GRID, "b": 2 * GRID}
    labels = np.arange(20)
    together = critical(data, populations, specimens={"a": labels, "b": labels})
    # The second response adds no information: 40 values, but the critical value of 20.
    assert together == pytest.approx(EXACT.critical_value(20), abs=0.004)
    assert critical(data, populations) == pytest.approx(EXACT.critical_value(40), abs=0.004)
    # Two conditions of fresh specimens share the uncertain population.
    both = critical([y[:10], 5 * y[10:]], [posterior(), 5 * posterior()])
    assert both == pytest.approx(critical(y, posterior()), rel=0.05)
    # A specimen that is measured twice under one condition.
    twice = np.repeat(y[:10], 2)
    test = prb.area_test(twice, GRID, specimens=np.repeat(list("abcdefghij"), 2))
    assert test.critical_value == pytest.approx(EXACT.critical_value(10), abs=0.005)
    assert test.specimens.tolist()[:3] == ["a", "a", "b"]


def replicates(case: Case, **keywords: Any) -> Floats:
    """All replicates of a posterior's null, shape (r, n)."""
    return np.concatenate(list(prb.validation.PosteriorNull(**keywords).replicates_of(case)))


def test_a_replicate_is_of_one_population() -> None:
    # Populations that do not overlap: 0 to 1, 1 to 2, 2 to 3, 3 to 4.
    populations = np.arange(4)[:, None] + (np.arange(50) + 0.5) / 50
    u = replicates(read_case(np.full(6, 0.5), populations), replicates=400)
    which = np.floor(4 * u)
    assert (which == which[:, :1]).all()
    # Every population as often as any other.
    np.testing.assert_array_equal(np.bincount(which[:, 0].astype(int)), 100)


def test_a_specimen_is_the_same_sample_under_all_conditions() -> None:
    populations = np.random.default_rng(0).normal(size=(3, 200))
    labels = [range(5), [4, 0, 9, 2, 7]]
    case = read_case([np.zeros(5), np.zeros(5)], [populations, -populations], labels)
    u = replicates(case, replicates=60)
    first, second = u[:, :5], u[:, 5:]
    for i, j in ((4, 0), (0, 1), (2, 3)):
        np.testing.assert_allclose(second[:, j], 1 - first[:, i])
    assert (np.abs(second[:, 2] - (1 - first[:, 3])) > 1e-6).any()


def test_samples_without_a_response_under_one_condition_are_no_specimens() -> None:
    values = np.arange(40.0)[None]
    holes = np.where(values % 2 == 0, np.nan, values)
    shared = read_case([[1.0], [1.0]], [values, holes], [["a"], ["a"]])
    u = replicates(shared, replicates=99)[:, 0]
    assert set(np.round(u * 40 - 0.5).astype(int) % 2) == {1}
    other = np.where(values % 2 == 1, np.nan, values)
    never = read_case([[1.0], [1.0]], [other, holes], [["a"], ["a"]])
    with pytest.raises(ValueError, match="NaN in every draw"):
        replicates(never, replicates=99)


def test_a_seed_gives_the_same_replicates() -> None:
    case = read_case(np.zeros(3), np.random.default_rng(0).normal(size=(5, 40)))
    one, same, other = (replicates(case, replicates=50, random_seed=seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert (one != other).mean() > 0.5
    with pytest.raises(ValueError, match="PosteriorNull: replicates: got 5"):
        prb.validation.PosteriorNull(5)
    with pytest.raises(ValueError, match="PosteriorNull: random_seed: got -1"):
        prb.validation.PosteriorNull(random_seed=-1)


def test_published_critical_values_and_closed_forms() -> None:
    for n, published in PUBLISHED.items():
        assert EXACT.critical_value(n) == pytest.approx(published, abs=4e-4)
    page = (Path(__file__).parents[2] / "docs" / "validity.md").read_text(encoding="utf-8")
    on_page = re.findall(r"(\d+) (\.\d{4})(?=[,.] )", page)
    assert len(on_page) == 6
    for size, value in on_page:
        assert f"{EXACT.critical_value(int(size)):.4f}" == f"0{value}"
    scaled = [np.sqrt(n) * EXACT.critical_value(n) for n in (500, 1000, 10_000)]
    np.testing.assert_allclose(scaled, 0.5821, atol=2e-4)
    # Sizes between those of the table have quantiles between theirs.
    for alpha in (0.5, 0.05, 1e-3):
        falls = np.diff([np.sqrt(n) * EXACT.critical_value(n, alpha) for n in (22, 23, 24, 25)])
        assert (falls > 0).all() or (falls < 0).all()
    for alpha in (0.5, 0.1, 0.05, 0.01):  # A = 1/4 + (u - 1/2)^2
        expected = 0.25 + ((1 - alpha) / 2) ** 2
        assert EXACT.critical_value(1, alpha) == pytest.approx(expected, abs=1e-4)
    assert EXACT.p_value(0.25 + 0.3**2, 1) == pytest.approx(0.4, abs=2e-3)


@pytest.mark.parametrize("n", [2, 23])
def test_the_table_against_simulation(n: int) -> None:
    size = 100_000
    found = area(np.random.default_rng(n).random((size, n)))
    for alpha in (0.9, 0.5, 0.1, 0.05, 0.01, 0.001):
        share = float((found > EXACT.critical_value(n, alpha)).mean())
        assert abs(share - alpha) < 4.5 * np.sqrt(alpha * (1 - alpha) / size)


@pytest.mark.long
def test_the_table_is_what_its_script_makes() -> None:
    sizes, _, rows = table()
    for n in (1, 9):
        np.testing.assert_allclose(area_null.quantiles(n), rows[sizes == n][0], atol=2e-6)
    np.testing.assert_allclose(area_null.areas(np.array([0.2, 0.5])), area(np.array([0.2, 0.5])))


@pytest.mark.parametrize("n", [1, 8, 77, 5000])
def test_p_values_and_critical_values_belong_together(n: int) -> None:
    beyond_the_table = [1e-8] if n > 8 else []
    for alpha in (0.2, 0.05, 0.01, 1e-4, *beyond_the_table):
        assert EXACT.p_value(EXACT.critical_value(n, alpha), n) == pytest.approx(alpha, rel=1e-6)
    p = [EXACT.p_value(a, n) for a in np.linspace(0, 0.5, 200)]
    assert (np.diff(p) <= 0).all()
    assert p[0] > 0.999
    assert 0 <= p[-1] < 1e-4


def test_the_far_tail_falls_like_that_of_a_brownian_bridge() -> None:
    x = np.array([1.6, 1.8])
    logs = np.log([EXACT.p_value(v / np.sqrt(1000), 1000) for v in x])
    assert (logs[1] - logs[0]) / (x[1] ** 2 - x[0] ** 2) == pytest.approx(-6, abs=0.6)
    # Its slope does not depend on the quantiles that it is taken from.
    sizes, logs, rows = table()
    for n in (20, 100, 1000):
        squares = rows[sizes == n][0] ** 2
        slopes = [(logs[-1] - logs[-1 - k]) / (squares[-1] - squares[-1 - k]) for k in range(1, 13)]
        np.testing.assert_allclose(slopes, slopes[6], rtol=0.055)


def same(x: Any) -> Any:
    return x


def double(x: Any) -> Any:
    return 2 * x


DATA = np.random.default_rng(20).normal(10, 1, 20)


def model_of(
    data: Any = DATA, propagation: Any = None, labels: Any = None, metric: Any = None
) -> Any:
    """Return a model of a normal population, and its input."""
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 10, 3), pm.HalfNormal("sigma", 3))
        prb.Simulator(
            "y", same, x, metric=metric or prb.AreaMetric(), observed=data, specimens=labels,
            propagation=propagation or prb.Reweighted(512),
        )  # fmt: skip
    return model, x


@cache
def calibrated() -> tuple[prb.Optimum, Any]:
    model, x = model_of(labels=np.arange(20))
    return prb.minimize(model, starts=0), x


def joint(optimum: prb.Optimum, replicates: int = 199, **keywords: Any) -> Any:
    return prb.validation.JointNull(optimum, replicates=replicates, **keywords)


@pytest.mark.long
def test_own_data_take_the_joint_null() -> None:
    optimum, x = calibrated()
    predicted = prb.predict(optimum, same, x, random_seed=1)
    with pytest.raises(ValueError, match="the data of the calibration"):
        prb.area_test(DATA[::-1], predicted)
    test = prb.area_test(DATA[::-1], predicted, null=joint(optimum, 999))
    # A fitted normal distribution follows its own data. 1500 normal samples of 20, fitted by
    # Nelder-Mead to the smallest area and tested by formulas of their own, have the 95% point
    # .0571; standard error of both .001.
    assert test.critical_value == pytest.approx(0.0571, abs=0.004)
    assert not test.rejected
    assert test.p_value > 0.05


@pytest.mark.long
def test_own_specimens_under_another_condition_are_as_close_as_under_their_own() -> None:
    optimum, x = calibrated()
    null = joint(optimum, responses=(double, x))
    own = prb.area_test(DATA, prb.predict(optimum, same, x), null=joint(optimum))
    predicted = prb.predict(optimum, double, x)
    later = prb.area_test(2 * DATA, predicted, null=null, specimens=np.arange(20))
    # 2 y has the information of y; refits and replicates are the same.
    assert later.critical_value == pytest.approx(own.critical_value, rel=1e-6)
    fresh = prb.area_test(2 * DATA, predicted, null=null, specimens=np.arange(100, 120))
    assert fresh.critical_value > 1.15 * EXACT.critical_value(20)
    with pytest.raises(ValueError, match="specimens of the calibration"):
        prb.area_test(2 * DATA, predicted, specimens=np.arange(20))


def test_a_resimulated_model_has_a_joint_null_too() -> None:
    model, x = model_of(propagation=prb.Resimulated(256))
    optimum = prb.minimize(model, starts=0)
    predicted = prb.predict(optimum, same, x, random_seed=1)
    test = prb.area_test(DATA, predicted, null=joint(optimum))
    assert test.critical_value == pytest.approx(0.0571, abs=0.012)  # to first order
    null = joint(optimum, 19, responses=(double, x))
    with pytest.raises(ValueError, match=r"no simulator with prb\.Reweighted has"):
        prb.area_test(2 * DATA, 2 * predicted, null=null, alpha=0.1)


def test_refusals_of_the_joint_null(posterior: Posterior) -> None:
    optimum, x = calibrated()
    two = prb.predict(optimum, same, x, random_seed=1)
    named = {"late": two, "y": two}
    for observed, predicted, words in (
        (DATA, posterior(), "got 400 draws, expected the one population"),
        (DATA, prb.predict(optimum, double, x), "distribution function differs by"),
        (dict.fromkeys(named, DATA), named, r"condition 'late', expected the name .*, \['y'\]"),
    ):
        with pytest.raises(ValueError, match=words):
            prb.area_test(observed, predicted, null=joint(optimum, 19), alpha=0.1)
    with pytest.raises(TypeError, match="got str, expected an Optimum"):
        joint("optimum")  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=r"responses: got .*, expected a tuple \(response"):
        joint(optimum, responses=same)
    metric = prb.FunctionMetric(lambda s, o: np.abs(s.mean(-1) - o.mean()))
    model, _ = model_of(propagation=prb.Resimulated(16), metric=metric)
    with pytest.raises(ValueError, match=r"a FunctionMetric, .*the model cannot be recalibrated"):
        joint(prb.minimize(model, method="Nelder-Mead", starts=0, max_evaluations=5))


def test_the_calibrations_data_in_any_order_and_some_of_its_specimens() -> None:
    optimum, x = calibrated()
    predicted = prb.predict(optimum, same, x, random_seed=1)
    null = joint(optimum, 99)
    tests = [prb.area_test(data, predicted, null=null) for data in (DATA, DATA[::-1])]
    assert len({(t.p_value, t.critical_value) for t in tests}) == 1
    # Fewer of the calibration's specimens are followed less closely.
    part = prb.area_test(DATA[:8], predicted, null=null, specimens=np.arange(8))
    fresh = prb.area_test(DATA[:8] + 0.01, predicted, null=null, specimens=np.arange(50, 58))
    assert part.critical_value < fresh.critical_value


def test_the_joint_null_rejects_data_that_the_family_cannot_follow() -> None:
    noise = np.random.default_rng(2).normal(0, 0.05, 30)
    data = 10 + np.repeat([-1.0, 1.0], 15) + noise
    model, x = model_of(data, prb.Reweighted(256))
    optimum = prb.minimize(model, starts=0)
    predicted = prb.predict(optimum, same, x, random_seed=1)
    assert prb.area_test(data, predicted, null=joint(optimum, 99)).rejected


def test_many_values_have_fewer_replicates_by_default() -> None:
    rng = np.random.default_rng(0)
    predicted = rng.standard_normal((20, 50))
    observed = rng.standard_normal(1001)
    test = prb.area_test(observed, predicted, progressbar=False)
    null = prb.validation.PosteriorNull(999)
    assert test.p_value == prb.area_test(observed, predicted, null=null, progressbar=False).p_value
    # Up to a thousand values p-values are counts of 10 000.
    few = prb.area_test(observed[:50], predicted, progressbar=False)
    assert round(few.p_value * 10_000) == pytest.approx(few.p_value * 10_000)
    assert few.p_value * 1000 % 1 > 1e-6
