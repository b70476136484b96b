"""The null of a posterior: one population per replicate, one sample per specimen."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from scipy.special import ndtri

import prbayes as prb
from prbayes._validate import Floats
from prbayes.validation.conditions import Case, Condition, read_case
from prbayes.validation.nulls import SimulatedNull
from prbayes.validation.statistic import area

Posterior = Callable[..., Any]
EXACT = prb.validation.ExactModel()
QUICK = prb.validation.PosteriorNull(999)
GRID = ndtri((np.arange(1000) + 0.5) / 1000)  # a standard normal population


def test_with_one_population_the_null_is_the_exact_one() -> None:
    test = prb.area_test(GRID[::50], GRID, null=prb.validation.PosteriorNull(19_999))
    # The density of the area at its 95% point makes the standard error of a quantile about .001.
    assert test.critical_value == pytest.approx(EXACT.critical_value(20), abs=0.004)
    assert "the predicted population" in test.null


def test_an_uncertain_population_is_rejected_less_easily(posterior: Posterior) -> None:
    rng = np.random.default_rng(1)
    predicted = posterior()
    critical = prb.area_test(rng.normal(size=20), predicted, null=QUICK).critical_value
    assert critical > 1.25 * EXACT.critical_value(20)


def test_p_values_of_replicates_count_the_observed_data_in() -> None:
    AREAS = np.linspace(0.01, 0.49, 19)

    class Fixed(SimulatedNull):
        def replicates_of(self, case: Case) -> Iterator[Floats]:
            yield AREAS[:, None]

        def describe(self, case: Case) -> str:
            return ""

    case = Case(
        (Condition("a", np.zeros(1), np.zeros((1, 1)), np.zeros(1), None, np.zeros(1, dtype=int)),),
        1,
        False,
    )

    def judged(statistic: float, alpha: float) -> tuple[float, float]:
        found = Fixed().judge(case, statistic, alpha)
        return found.p_value, found.critical_value

    areas = area(AREAS[:, None])  # falling
    assert judged(0.5, 0.05) == (1 / 20, areas[0])
    assert judged(areas[0], 0.05)[0] == 2 / 20
    assert judged(0.0, 0.10) == (1.0, areas[1])
    with pytest.raises(ValueError, match=r"alpha: got 0\.01 with 19 replicates"):
        Fixed().judge(case, 0.5, 0.01)


def test_nan_is_left_out_of_populations(posterior: Posterior) -> None:
    predicted = posterior()
    holes = np.where(np.random.default_rng(8).random(predicted.shape) < 0.2, np.nan, predicted)
    holes[3] = np.nan
    y = np.random.default_rng(9).normal(size=20)
    with_holes, whole = (
        prb.area_test(y, p, null=prb.validation.PosteriorNull(9999)) for p in (holes, predicted)
    )
    assert with_holes.statistic == pytest.approx(whole.statistic, abs=0.01)
    assert with_holes.critical_value == pytest.approx(whole.critical_value, rel=0.08)


def test_ties_in_populations_are_randomised_alike() -> None:
    """Discrete responses: with a seed the size stays nominal, as if they were continuous."""
    test = prb.area_test(
        np.zeros(5), np.round(GRID), null=prb.validation.PosteriorNull(9999), randomize=True
    )
    assert test.critical_value == pytest.approx(EXACT.critical_value(5), abs=0.01)


def test_repeated_measurements_are_not_counted_as_independent() -> None:
    rng = np.random.default_rng(10)
    y = rng.normal(size=20)
    labels = np.arange(20)
    null = prb.validation.PosteriorNull(9999)

    def test(specimens: Any) -> prb.validation.ValidityTest:
        return prb.area_test(
            {"a": y, "b": 2 * y}, {"a": GRID, "b": 2 * GRID}, null=null, specimens=specimens
        )

    together, apart = test({"a": labels, "b": labels}), test(None)
    # The second response tells nothing new: 40 values, but the critical value of 20.
    assert together.statistic == apart.statistic
    assert together.critical_value == pytest.approx(EXACT.critical_value(20), abs=0.004)
    assert apart.critical_value == pytest.approx(EXACT.critical_value(40), abs=0.004)


def test_all_conditions_take_the_same_draw(posterior: Posterior) -> None:
    """Two conditions of fresh specimens share the doubt about the population."""
    y = np.random.default_rng(11).normal(size=20)
    both = prb.area_test(
        [y[:10], 5 * y[10:]],
        [posterior(), 5 * posterior()],
        null=prb.validation.PosteriorNull(9999),
    )
    one = prb.area_test(y, posterior(), null=prb.validation.PosteriorNull(9999))
    assert both.critical_value == pytest.approx(one.critical_value, rel=0.05)


def test_a_specimen_measured_twice_under_one_condition() -> None:
    y = np.repeat(np.random.default_rng(12).normal(size=10), 2)
    test = prb.area_test(
        y, GRID, null=prb.validation.PosteriorNull(9999), specimens=np.repeat(list("abcdefghij"), 2)
    )
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


def test_refusals() -> None:
    with pytest.raises(ValueError, match="PosteriorNull: replicates: got 5"):
        prb.validation.PosteriorNull(5)
    with pytest.raises(ValueError, match="PosteriorNull: random_seed: got -1"):
        prb.validation.PosteriorNull(random_seed=-1)
