"""Held-out discrepancies and log scores, and the ranking of candidates by them."""

from functools import cache
from typing import Any

import numpy as np
import pymc as pm
import pytest
import xarray as xr
from arviz_stats import compare as arviz_compare
from arviz_stats.utils import ELPDData
from scipy.stats import norm

import prbayes as prb
from prbayes.validation.cross_validation import log_scores, most_folds, scoring_target

DATA = np.exp(np.random.default_rng(0).normal(0.0, 0.7, 60))
METRIC = prb.AreaMetric()


QUIET: dict[str, Any] = {"progressbar": False}


def normal(mean: Any, sd: Any) -> Any:
    return pm.Normal.dist(mean, sd)


def lognormal(mean: Any, sd: Any) -> Any:
    variance = pm.math.log1p((sd / mean) ** 2)
    return pm.LogNormal.dist(pm.math.log(mean) - variance / 2, pm.math.sqrt(variance))


def minimized(
    family: Any = lognormal,
    data: Any = DATA,
    response: Any = np.positive,
    metric: Any = None,
    propagation: Any = None,
    **options: Any,
) -> prb.Optimum:
    with pm.Model() as model:
        x = family(pm.TruncatedNormal("mean", 1.2, 0.5, lower=0.1), pm.HalfNormal("sd", 1.0))
        prb.Simulator(
            "y", response, x, metric=metric or prb.KullbackLeibler(), observed=data,
            propagation=propagation or prb.Reweighted(512), **QUIET,
        )  # fmt: skip
    return prb.minimize(model, refine=False, starts=0, **options, **QUIET)


@cache
def optimum(family: Any = lognormal) -> prb.Optimum:
    return minimized(family, metric=METRIC)


@cache
def fitted(label: str) -> prb.Optimum:
    return minimized({"normal": normal, "lognormal": lognormal}[label])


def skewed() -> dict[str, prb.Optimum]:
    return {label: fitted(label) for label in ("normal", "lognormal")}


@cache
def validated(label: str, folds: int = 5) -> xr.Dataset:
    return prb.cross_validate(fitted(label), folds=folds, random_seed=0, **QUIET)


@pytest.mark.long
def test_each_fold_is_a_calibration_on_the_other_specimens() -> None:
    before = optimum().evaluator.n_responses
    found = prb.cross_validate(optimum(), folds=4, random_seed=3)
    assert optimum().evaluator.n_responses == before
    assert found.sizes == {"fold": 4, "simulator": 1, "specimen": 60}
    assert found.n_held_out.values.ravel().tolist() == [15] * 4
    assert found.converged.all()
    fold = np.random.default_rng([3, 3]).permutation(np.arange(60) % 4)
    refit = minimized(data=DATA[fold != 3], metric=METRIC)
    assert float(found.calibrated[3, 0]) == pytest.approx(refit.discrepancy, rel=0.01)
    (x,) = refit.evaluator.nodes[0].inputs.aleatory
    population = prb.predict(refit, np.positive, x, n_samples=40_000, **QUIET).values.ravel()
    expected = METRIC(population, DATA[fold == 3])
    assert float(found.discrepancy[3, 0]) == pytest.approx(expected, rel=0.03)
    wrong = prb.cross_validate(optimum(normal), folds=4, random_seed=3)
    assert float(wrong.discrepancy.mean()) > 1.1 * float(found.discrepancy.mean())
    assert float(found.discrepancy.mean()) > float(found.calibrated.mean())


@pytest.mark.long
def test_few_specimens_have_fewer_folds() -> None:
    few = minimized(data=DATA[:9], propagation=prb.Reweighted(128))
    assert most_folds(few, 5) == most_folds(few, 10) == 4
    assert most_folds(skewed()["normal"], 10) == 10
    # Cross-validations among the candidates have a number of folds.
    table = prb.rank({"a": prb.cross_validate(few, folds=3), "b": few})
    assert table.attrs["folds"] == 3
    with pytest.raises(ValueError, match="folds: got 8 for 9 specimens, expected at most 4"):
        prb.cross_validate(few, folds=8)
    simplex = {"method": "Nelder-Mead", "max_evaluations": 10}
    fresh = minimized(metric=METRIC, propagation=prb.Fresh(60), **simplex)
    for function, argument in ((prb.cross_validate, fresh), (prb.rank, {"a": fresh, "b": fresh})):
        with pytest.raises(ValueError, match=r"cross_validate: .*cannot be recalibrated"):
            function(argument)  # type: ignore[operator]


def scored(scores: Any, weights: Any = None) -> xr.Dataset:
    """Return a cross-validation with these scores."""
    scores = np.asarray(scores, dtype=float)
    weights = np.ones(scores.size) if weights is None else weights
    return xr.Dataset(
        {
            "score": ("specimen", scores),
            "weight": ("specimen", weights),
            "data": ("simulator", ["a"]),
            "converged": ("fold", [True, True]),
        },
        coords={"simulator": ["y"]},
        attrs={"random_seed": "0"},
    )


@pytest.mark.long
def test_the_right_family_is_identified_and_families_alike_are_not() -> None:
    table = prb.rank(skewed(), folds=5, random_seed=0, **QUIET)
    xr.testing.assert_identical(table, prb.rank({label: validated(label) for label in skewed()}))
    other = prb.rank(skewed(), folds=5, random_seed=1, **QUIET)
    assert float(other.difference[1]) != float(table.difference[1])
    assert table.candidate.values.tolist() == ["lognormal", "normal"]
    assert table.significant.values.tolist() == [False, True]
    by = f"{float(table.difference[1]):.1f} nats (standard error {float(table.stderr[1]):.1f})"
    assert table.attrs["verdict"] == f"lognormal predicts better than normal by {by}"
    assert table.to_dataframe().shape == (2, 5)
    narrow = np.random.default_rng(2).normal(1.0, 0.1, 30)
    alike = prb.rank({f.__name__: minimized(f, narrow) for f in (normal, lognormal)}, **QUIET)
    assert not alike.significant.any()
    best, second = alike.candidate.values
    assert alike.attrs["verdict"].startswith(f"the data do not separate {best} from {second}: ")


@pytest.mark.long
def test_the_numbers_are_those_of_arviz() -> None:
    found = {label: validated(label) for label in skewed()}
    table = prb.rank(found)
    options = {"se": 1.0, "p": 2.0, "n_samples": 1, "scale": "log", "warning": False, "good_k": 0.7}
    elpds = {
        label: ELPDData(elpd=float(x.score.sum()), n_data_points=60, elpd_i=x.score, **options)
        for label, x in found.items()
    }
    theirs = arviz_compare(elpds, method="pseudo-BMA", round_to="none")
    assert theirs.index.tolist() == table.candidate.values.tolist()
    # ArviZ divides by n, this by n - 1.
    n = DATA.size
    dse = theirs["dse"].to_numpy() * np.sqrt(n / (n - 1))
    np.testing.assert_allclose(table["difference"], abs(theirs["elpd_diff"]), rtol=1e-6)
    np.testing.assert_allclose(table["stderr"], dse, rtol=1e-6)


def test_a_score_is_that_of_a_population_that_was_calibrated_without_the_specimen() -> None:
    fold = np.random.default_rng([0, 3]).permutation(np.arange(60) % 5)
    out = np.flatnonzero(fold == 2)
    refit = minimized(data=DATA[fold != 2])
    values, weights = refit.evaluator.populations(refit.theta[None], 0)
    target = scoring_target(DATA, np.full(60, 1 / 60))
    expected = log_scores(target, values[0], weights[0], out)
    np.testing.assert_allclose(validated("lognormal").score.values[out], expected, atol=0.1)


def test_errors_of_differences() -> None:
    a, b = np.random.default_rng(3).normal(size=(2, 25))
    table = prb.rank({"a": scored(a), "b": scored(b)})
    # The error of equal weights is the usual one, and ties are no preference.
    expected = np.std(a - b, ddof=1) * 5
    assert table["stderr"].values.max() == pytest.approx(expected)
    same = prb.rank({"a": scored(a), "b": scored(a)})
    assert same.difference.values.tolist() == [0, 0]
    assert not same.significant.any()
    # A constant advantage for each observation has no error, however they are weighted.
    weights = np.repeat([1.0, 3.0], 20)
    table = prb.rank({"a": scored(0.2 * weights, weights), "b": scored(np.zeros(40), weights)})
    assert table["stderr"].values.max() == pytest.approx(0, abs=1e-12)
    assert table.significant.values.tolist() == [False, True]
    # Two candidates 2.2 standard errors apart; more of them need more.
    noise = np.random.default_rng(8).normal(size=400)
    noise = (noise - noise.mean()) / noise.std(ddof=1)
    ahead = noise + 2.2 / np.sqrt(400)
    candidates = {"a": scored(ahead), "b": scored(0 * noise)}
    assert prb.rank(candidates).significant.any()
    three = prb.rank(candidates | {"c": scored(0 * noise)})
    assert not three.significant.any()
    assert three.attrs["verdict"].count("do not separate") == 2


@pytest.mark.long
def test_two_responses_of_several_simulators_with_labels_and_weights() -> None:
    weights = np.random.default_rng(1).uniform(0.5, 1.5, 60)
    data = {"first": DATA, "second": 1.5 * DATA[:50] ** 2}

    def model_of(response: Any) -> prb.Optimum:
        with pm.Model() as model:
            x = lognormal(pm.TruncatedNormal("mean", 1.2, 0.5, lower=0.1), pm.HalfNormal("sd", 1))
            for name, function in {"first": np.positive, "second": response}.items():
                n = len(data[name])
                prb.Simulator(
                    name, function, x, metric=prb.KullbackLeibler(), observed=data[name],
                    specimens=np.arange(n), weights=weights[:n],
                    propagation=prb.Reweighted(512), **QUIET,
                )  # fmt: skip
        return prb.minimize(model, refine=False, starts=0, **QUIET)

    optima = {"bent": model_of(lambda x: 1.5 * x**2), "straight": model_of(lambda x: 2.0 * x)}
    # Specimens are assigned to folds whole.
    folds = prb.cross_validate(optima["bent"], folds=5).n_held_out
    fold = np.random.default_rng([0, 3]).permutation(np.arange(60) % 5)
    expected = [np.bincount(fold[:n], minlength=5) for n in (60, 50)]
    np.testing.assert_array_equal(folds.values.T, expected)
    table = prb.rank(optima, **QUIET)
    assert table.candidate.values[0] == "bent"
    assert table.significant.values.tolist() == [False, True]
    assert table.attrs["n_specimens"] == 60


@pytest.mark.long
def test_several_outputs_with_some_not_measured_and_some_failed() -> None:
    def outputs(x: Any) -> Any:
        return np.stack([x, np.where(x > 2.5, np.inf, x**2)], axis=-1)

    data = outputs(DATA)
    data[:12, 1] = np.nan
    assert np.isposinf(data).any()
    metric, few = prb.Joint(prb.KullbackLeibler()), prb.Reweighted(256)
    optima = {
        f.__name__: minimized(f, data, outputs, metric=metric, propagation=few)
        for f in (normal, lognormal)
    }
    table = prb.rank(optima, **QUIET)
    assert table.candidate.values[0] == "lognormal"
    assert np.isfinite(table["stderr"].values).all()
    assert table.attrs["n_specimens"] == 60


def test_refusals_of_a_ranking() -> None:
    first = validated("lognormal")
    seeded = first.assign_attrs(random_seed="1")
    reordered = first.assign(data=("simulator", ["another digest"]))
    for candidates, error, words in (
        ({"a": first, "b": first[["discrepancy"]]}, TypeError, "(?s)candidates: b: got .*Optimum"),
        ({"a": first, "b": first.isel(fold=slice(4))}, ValueError, "b with folds 4 and a with 5"),
        ({"a": first, "b": seeded}, ValueError, "b with random_seed 1 and a with 0"),
        ({"a": first, "b": reordered}, ValueError, "different observed values, weights or labels"),
        (
            {"a": first, "b": first.assign_coords(simulator=["z"])},
            ValueError,
            r"b with simulators \['z'\] and a with \['y'\]",
        ),
    ):
        with pytest.raises(error, match=words):
            prb.rank(candidates)  # type: ignore[arg-type]


def test_equal_observations_have_no_score() -> None:
    equal = minimized(normal, np.ones(12), metric=METRIC, propagation=prb.Reweighted(64))
    found = prb.cross_validate(equal, folds=2, **QUIET)
    assert found.score.isnull().all()
    assert found.discrepancy.notnull().all()
    with pytest.raises(ValueError, match="a without a score of 12 of 12 specimens"):
        prb.rank({"a": found, "b": found})
    with pytest.raises(ValueError, match="bandwidth: got 0"):
        scoring_target(np.ones(9), np.full(9, 1 / 9))


RNG = np.random.default_rng(4)
READINGS = RNG.normal(3.0, 2.0, 40)
EQUAL = np.full(40, 1 / 40)
POPULATION = 3.0 + 2.0 * norm.ppf((np.arange(20_000) + 0.5) / 20_000)
ALIKE = np.full(20_000, 1 / 20_000)
EVERY = np.arange(40)


def test_a_score_is_the_log_density_of_a_normal_population() -> None:
    found = log_scores(scoring_target(READINGS, EQUAL), POPULATION, ALIKE, EVERY)
    # A kernel of 0.14 standard deviations, and a tenth of the population, are elsewhere.
    np.testing.assert_allclose(found, norm.logpdf(READINGS, 3.0, 2.0), atol=0.15)
    assert found.mean() == pytest.approx(norm.logpdf(READINGS, 3.0, 2.0).mean(), abs=0.02)
    # Differences of scores do not depend on the unit.
    differences = []
    for unit in (1, 1000):
        target = scoring_target(unit * READINGS, EQUAL)
        a, b = (log_scores(target, unit * f * POPULATION, ALIKE, EVERY) for f in (1.0, 1.3))
        differences.append(a - b)
    np.testing.assert_allclose(*differences, atol=1e-9)
    # One specimen far out costs a tenth of a Student's t density with three degrees of freedom.
    far = np.append(READINGS, 60.0)
    found = log_scores(scoring_target(far, np.full(41, 1 / 41)), POPULATION, ALIKE, np.arange(41))
    assert -22 < found[-1] < -10


@pytest.mark.parametrize("outputs", [1, 3])
def test_their_sum_is_what_the_log_likelihood_has_of_all(
    outputs: int,
) -> None:
    mixing = RNG.normal(size=(3, 3)) + 2 * np.eye(3)
    weights = RNG.uniform(0.5, 1.5, 40)
    weights = weights / weights.sum()
    metric: prb.Metric = prb.LogLikelihood(density=prb.GaussianKDE())
    observed, simulated = READINGS, POPULATION
    if outputs > 1:
        metric = prb.Joint(metric)
        observed = RNG.normal(size=(40, 3)) @ mixing
        observed[:9, 2] = np.nan  # not measured
        simulated = RNG.normal(size=(20_000, 3)) @ mixing
    found = log_scores(scoring_target(observed, weights), simulated, ALIKE, EVERY, gross=0.0)
    expected = -metric.against(observed, weights)(simulated)
    assert found.mean() == pytest.approx(expected, abs=0.01)


def test_a_specimen_keeps_its_score_in_any_order_and_by_itself() -> None:
    observed = RNG.normal(size=(40, 2))
    observed[[1, 5, 6, 20, 33], 0] = np.nan
    simulated = RNG.normal(size=(20_000, 2))
    target = scoring_target(observed, EQUAL)
    found = log_scores(target, simulated, ALIKE, EVERY)
    order = RNG.permutation(40)
    again = log_scores(scoring_target(observed[order], EQUAL), simulated, ALIKE, EVERY)
    np.testing.assert_allclose(again, found[order], atol=1e-6)
    assert np.ptp(found) > 1
    # Products of matrices of other shapes round differently.
    rows = np.array([7, 2, 30])
    np.testing.assert_allclose(log_scores(target, simulated, ALIKE, rows), found[rows], rtol=1e-12)


def test_points_without_response_are_left_out_and_failures_are_not() -> None:
    scoring = scoring_target(READINGS, EQUAL)
    half = np.concatenate([POPULATION, np.full(20_000, np.nan)])
    weights = np.full(40_000, 1 / 40_000)
    complete = log_scores(scoring, POPULATION, ALIKE, EVERY)
    np.testing.assert_allclose(log_scores(scoring, half, weights, EVERY), complete, atol=1e-9)
    failed = np.where(np.isnan(half), np.inf, half)
    lower = log_scores(scoring, failed, weights, EVERY) - complete
    # Half of the specimens fail, and half of the density is left, but for what is spread widely.
    np.testing.assert_allclose(lower, np.log(0.5), atol=0.15)
