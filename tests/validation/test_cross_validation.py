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
from prbayes.validation.cross_validation import log_scores, scoring_target

DATA = np.exp(np.random.default_rng(0).normal(0.0, 0.7, 60))
METRIC = prb.AreaMetric()


def lognormal_model(data: Any = DATA, family: Any = pm.LogNormal, **keywords: Any) -> pm.Model:
    with pm.Model() as model:
        x = family.dist(pm.Normal("mu", 0.5, 1), pm.HalfNormal("sigma", 1))
        prb.Simulator("y", np.positive, x, metric=METRIC, observed=data, **keywords)
    return model


@cache
def optimum(family: Any = pm.LogNormal) -> prb.Optimum:
    return prb.minimize(lognormal_model(family=family))


@pytest.mark.long
def test_each_fold_is_a_calibration_on_the_other_specimens() -> None:
    before = optimum().evaluator.n_responses
    found = prb.cross_validate(optimum(), folds=4, random_seed=3)
    assert optimum().evaluator.n_responses == before
    assert found.sizes == {"fold": 4, "simulator": 1, "specimen": 60}
    assert found.n_held_out.values.ravel().tolist() == [15] * 4
    assert found.converged.all()
    fold = np.random.default_rng([3, 3]).permutation(np.arange(60) % 4)
    for i in (0, 3):
        other = prb.minimize(lognormal_model(DATA[fold != i]))
        assert float(found.calibrated[i, 0]) == pytest.approx(other.discrepancy, rel=0.01)
        z = np.random.default_rng(1).normal(size=400_000)
        population = np.exp(other.point["mu"] + other.point["sigma"] * z)
        assert float(found.discrepancy[i, 0]) == pytest.approx(
            METRIC(population, DATA[fold == i]), rel=0.03
        )


@pytest.mark.long
def test_the_wrong_family_predicts_worse() -> None:
    right, wrong = (prb.cross_validate(optimum(f)) for f in (pm.LogNormal, pm.Normal))
    assert float(wrong.discrepancy.mean()) > 1.1 * float(right.discrepancy.mean())
    assert float(right.discrepancy.mean()) > float(right.calibrated.mean())


@pytest.mark.long
def test_specimens_are_dealt_out_whole() -> None:
    with pm.Model() as model:
        x = pm.LogNormal.dist(pm.Normal("mu", 0.5, 1), pm.HalfNormal("sigma", 1))
        for name, f, size in (("first", np.positive, 60), ("second", np.sqrt, 50)):
            prb.Simulator(
                name, f, x, metric=METRIC, observed=f(DATA[:size]), specimens=np.arange(size)
            )
    found = prb.cross_validate(prb.minimize(model), folds=5)
    assert found.n_held_out.sum("fold").values.tolist() == [60, 50]
    fold = np.random.default_rng([0, 3]).permutation(np.arange(60) % 5)
    np.testing.assert_array_equal(
        found.n_held_out.sel(simulator="second"), np.bincount(fold[:50], minlength=5)
    )


def test_few_specimens_have_fewer_folds() -> None:
    with pm.Model() as model:
        x = pm.LogNormal.dist(pm.Normal("mu", 0.5, 1), pm.HalfNormal("sigma", 1))
        prb.Simulator("y", np.positive, x, metric=METRIC, observed=DATA[:9])
    few = prb.minimize(model)
    assert prb.cross_validate(few).sizes["fold"] == 4
    assert prb.cross_validate(optimum()).sizes["fold"] == 5
    table = prb.rank({"one": few, "other": few})
    assert table.attrs["folds"] == 4
    # Those that are there already say how many.
    three = prb.cross_validate(few, folds=3)
    table = prb.rank({"one": three, "other": few})
    assert table.attrs["folds"] == 3


def test_refusals_of_cross_validation() -> None:
    with pytest.raises(TypeError, match="got dict, expected an Optimum"):
        prb.cross_validate({})  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="folds: got 1"):
        prb.cross_validate(optimum(), folds=1)
    with pytest.raises(ValueError, match="folds: got 40 for 60 specimens, expected at most 30"):
        prb.cross_validate(optimum(), folds=40)
    few = {"method": "Nelder-Mead", "starts": 0, "max_evaluations": 50}
    fresh = prb.minimize(lognormal_model(propagation=prb.Fresh(60)), **few)
    with pytest.raises(ValueError, match="cannot be calibrated anew"):
        prb.cross_validate(fresh)


compare = prb.rank
NARROW = np.random.default_rng(2).normal(1.0, 0.1, 30)
QUIET = {"progressbar": False}


def normal(mean: Any, sd: Any) -> Any:
    return pm.Normal.dist(mean, sd)


def lognormal(mean: Any, sd: Any) -> Any:
    variance = pm.math.log1p((sd / mean) ** 2)
    return pm.LogNormal.dist(pm.math.log(mean) - variance / 2, pm.math.sqrt(variance))


def build(family: Any, data: Any, response: Any = np.positive, **keywords: Any) -> pm.Model:
    with pm.Model() as model:
        mean = pm.TruncatedNormal("mean", 1.2, 0.5, lower=0.1)
        x = family(mean, pm.HalfNormal("sd", 1.0))
        given: dict[str, Any] = {"metric": prb.KullbackLeibler(), "observed": data} | keywords
        prb.Simulator("y", response, x, propagation=prb.Reweighted(512), **given, **QUIET)
    return model


def minimized(family: Any, data: Any, response: Any = np.positive, **keywords: Any) -> prb.Optimum:
    return prb.minimize(build(family, data, response, **keywords), refine=False, **QUIET)


@cache
def skewed() -> dict[str, prb.Optimum]:
    return {f.__name__: minimized(f, DATA) for f in (normal, lognormal)}


@cache
def narrow() -> dict[str, prb.Optimum]:
    return {f.__name__: minimized(f, NARROW) for f in (normal, lognormal)}


@cache
def validated(label: str, folds: int = 5, random_seed: int = 0) -> xr.Dataset:
    return prb.cross_validate(skewed()[label], folds=folds, random_seed=random_seed, **QUIET)


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
def test_the_right_family_is_told_and_families_alike_are_not() -> None:
    table = compare(skewed(), **QUIET)
    assert table.candidate.values.tolist() == ["lognormal", "normal"]
    assert table.told_apart.values.tolist() == [False, True]
    by = f"{float(table.difference[1]):.1f} nats (standard error {float(table.stderr[1]):.1f})"
    assert table.attrs["verdict"] == f"lognormal predicts better than normal by {by}"
    assert table.to_dataframe().shape == (2, 6)
    alike = compare(narrow(), **QUIET)
    assert not alike.told_apart.any()
    best, other = alike.candidate.values
    assert alike.attrs["verdict"].startswith(
        f"the data cannot tell {best} and {other} apart: {best} is ahead by "
    )


@pytest.mark.long
def test_optima_are_cross_validated_alike() -> None:
    by_optima = compare(skewed(), folds=5, random_seed=0, **QUIET)
    by_folds = compare({label: validated(label) for label in skewed()})
    xr.testing.assert_identical(by_optima, by_folds)
    other = compare(skewed(), folds=5, random_seed=1, **QUIET)
    assert float(other.difference[1]) != float(by_folds.difference[1])


@pytest.mark.long
def test_the_numbers_are_those_of_arviz() -> None:
    found = {label: validated(label) for label in skewed()}
    table = compare(found)
    elpds = {}
    for label, one in found.items():
        score = one.score
        elpds[label] = ELPDData(
            elpd=float(score.sum()),
            se=1.0,
            p=2.0,
            n_samples=1,
            n_data_points=score.size,
            scale="log",
            warning=False,
            good_k=0.7,
            elpd_i=score,
        )
    theirs = arviz_compare(elpds, method="pseudo-BMA", round_to="none")
    assert theirs.index.tolist() == table.candidate.values.tolist()
    # ArviZ divides by n, this by n - 1.
    n = DATA.size
    dse = theirs["dse"].to_numpy() * np.sqrt(n / (n - 1))
    np.testing.assert_allclose(table["difference"], abs(theirs["elpd_diff"]), rtol=1e-6)
    np.testing.assert_allclose(table["stderr"], dse, rtol=1e-6)


def test_a_score_is_that_of_a_population_that_has_not_seen_the_specimen() -> None:
    found = validated("lognormal")
    fold = np.random.default_rng([0, 3]).permutation(np.arange(60) % 5)
    out = np.flatnonzero(fold == 2)
    other = minimized(lognormal, DATA[fold != 2])
    population = prb.predict(other, np.positive, _input(other), n_samples=20_000, **QUIET)
    target = scoring_target(DATA, np.full(60, 1 / 60))
    values = population.values.ravel()
    expected = log_scores(target, values, np.full(values.size, 1 / values.size), out)
    np.testing.assert_allclose(found.score.values[out], expected, atol=0.1)


def _input(optimum: prb.Optimum) -> Any:
    return optimum.evaluator.nodes[0].bound.inputs.aleatory[0]


def test_the_error_of_equal_weights_is_the_usual_one_and_ties_are_no_preference() -> None:
    a, b = np.random.default_rng(3).normal(size=(2, 25))
    table = compare({"a": scored(a), "b": scored(b)})
    expected = np.std(a - b, ddof=1) * 5
    assert table["stderr"].values.max() == pytest.approx(expected)
    same = compare({"a": scored(a), "b": scored(a)})
    assert same.difference.values.tolist() == [0, 0]
    assert not same.told_apart.any()


def test_specimens_that_count_more_are_as_many() -> None:
    d = np.random.default_rng(5).normal(0.3, 1.0, 40)
    weights = np.repeat([1.0, 3.0], 20)
    # A constant advantage for each observation has no error, however they are weighted.
    constant = compare({"a": scored(0.2 * weights, weights), "b": scored(0 * d, weights)})
    assert constant["stderr"].values.max() == pytest.approx(0, abs=1e-12)
    assert constant.told_apart.values.tolist() == [False, True]


def test_more_candidates_ask_for_more() -> None:
    rng = np.random.default_rng(8)
    noise = rng.normal(size=400)
    noise = (noise - noise.mean()) / noise.std(ddof=1)
    # Ahead by 2.2 standard errors.
    ahead = noise + 2.2 / np.sqrt(400)
    two = compare({"a": scored(ahead), "b": scored(0 * noise)})
    assert two.told_apart.any()
    three = compare({"a": scored(ahead), "b": scored(0 * noise), "c": scored(0 * noise)})
    assert not three.told_apart.any()
    assert three.attrs["verdict"].count("cannot tell") == 2


@pytest.mark.long
def test_two_responses_of_several_simulators_with_labels_and_weights() -> None:
    def bent(x: Any) -> Any:
        return 1.5 * x**2

    def model_of(response: Any) -> prb.Optimum:
        weights = np.random.default_rng(1).uniform(0.5, 1.5, 60)
        with pm.Model() as model:
            x = lognormal(pm.TruncatedNormal("mean", 1.2, 0.5, lower=0.1), pm.HalfNormal("sd", 1))
            for name, f, size in (("first", np.positive, 60), ("second", response, 50)):
                prb.Simulator(
                    name,
                    f,
                    x,
                    metric=prb.KullbackLeibler(),
                    observed=(DATA if name == "first" else 1.5 * DATA**2)[:size],
                    specimens=np.arange(size),
                    weights=weights[:size],
                    propagation=prb.Reweighted(512),
                    **QUIET,
                )
        return prb.minimize(model, refine=False, **QUIET)

    table = compare({"bent": model_of(bent), "straight": model_of(lambda x: 2.0 * x)}, **QUIET)
    assert table.candidate.values[0] == "bent"
    assert table.told_apart.values.tolist() == [False, True]
    assert table.attrs["n_specimens"] == 60


@pytest.mark.long
def test_several_outputs_with_some_not_measured_and_some_failed() -> None:
    def outputs(x: Any) -> Any:
        return np.stack([x, np.where(x > 2.5, np.inf, x**2)], axis=-1)

    data = outputs(DATA)
    data[:12, 1] = np.nan
    assert np.isposinf(data).any()
    metric = prb.Joint(prb.KullbackLeibler())
    optima = {f.__name__: minimized(f, data, outputs, metric=metric) for f in (normal, lognormal)}
    table = compare(optima, **QUIET)
    assert table.candidate.values[0] == "lognormal"
    assert np.isfinite(table["stderr"].values).all()
    assert table.attrs["n_specimens"] == 60


@pytest.mark.long
def test_any_metric_and_propagation_that_can_be_refitted() -> None:
    resimulated = prb.Resimulated(2000)
    with pm.Model() as model:
        x = lognormal(pm.TruncatedNormal("mean", 1.2, 0.5, lower=0.1), pm.HalfNormal("sd", 1.0))
        prb.Simulator(
            "y", np.positive, x, metric=prb.KullbackLeibler(), observed=DATA,
            propagation=resimulated, **QUIET,
        )  # fmt: skip
    candidates = {
        "stored": skewed()["lognormal"],
        "computed": prb.minimize(model, **QUIET),
        "normal, PR": minimized(normal, DATA, metric=prb.ProbabilityResidual()),
    }
    table = compare(candidates, **QUIET)
    assert table.candidate.values[-1] == "normal, PR"
    assert not table.told_apart.values[1]
    assert float(table.difference[1]) < 1


def test_refusals_of_a_ranking() -> None:
    first = validated("normal")
    with pytest.raises(TypeError, match=r"(?s)candidates: got list .*expected a mapping such as"):
        compare([first, first])  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"got \['a'\], expected at least two"):
        compare({"a": first})
    with pytest.raises(TypeError, match=r"(?s)candidates: b: got .*expected an Optimum or what"):
        compare({"a": first, "b": first[["discrepancy"]]})
    with pytest.raises(ValueError, match="got b with folds 4 and a with 5, expected the same"):
        compare({"a": first, "b": first.isel(fold=slice(4))})
    with pytest.raises(
        ValueError, match="got b with random_seed 1 and a with 0, expected the same"
    ):
        compare({"a": first, "b": first.assign_attrs(random_seed="1")})
    other = prb.cross_validate(minimized(normal, DATA[::-1]), **QUIET)
    with pytest.raises(
        ValueError, match="b and a with different observed values, weights or labels of y, or in"
    ):
        compare({"a": first, "b": other})
    renamed = first.assign_coords(simulator=["z"])
    with pytest.raises(ValueError, match=r"b with simulators \['z'\] and a with \['y'\]"):
        compare({"a": first, "b": renamed})
    model = _with_propagation(prb.Fresh(60))
    fresh = prb.minimize(model, method="Nelder-Mead", max_evaluations=50, **QUIET)
    with pytest.raises(ValueError, match=r"cross_validate: .*cannot be calibrated anew"):
        compare({"a": fresh, "b": fresh})


def _with_propagation(propagation: Any) -> pm.Model:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1, 1), 1.0)
        prb.Simulator(
            "y", np.positive, x, metric=prb.AreaMetric(), observed=DATA,
            propagation=propagation, **QUIET,
        )  # fmt: skip
    return model


def test_equal_observations_have_no_score() -> None:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1, 1), 1.0)
        prb.Simulator("y", np.positive, x, metric=prb.AreaMetric(), observed=np.ones(12), **QUIET)
    found = prb.cross_validate(prb.minimize(model, refine=False, **QUIET), **QUIET)
    assert found.score.isnull().all()
    assert found.discrepancy.notnull().all()
    with pytest.raises(ValueError, match="a without a score of 12 of 12 specimens"):
        compare({"a": found, "b": found})


RNG = np.random.default_rng(4)
READINGS = RNG.normal(3.0, 2.0, 40)
EQUAL = np.full(40, 1 / 40)
POPULATION = 3.0 + 2.0 * norm.ppf((np.arange(20_000) + 0.5) / 20_000)
ALIKE = np.full(20_000, 1 / 20_000)
EVERY = np.arange(40)


def test_a_score_is_the_log_density_of_a_normal_population() -> None:
    found = log_scores(scoring_target(READINGS, EQUAL), POPULATION, ALIKE, EVERY)
    # A kernel of 0.14 standard deviations, and a hundredth of the population, are elsewhere.
    np.testing.assert_allclose(found, norm.logpdf(READINGS, 3.0, 2.0), atol=0.15)
    assert found.mean() == pytest.approx(norm.logpdf(READINGS, 3.0, 2.0).mean(), abs=0.02)


def test_differences_do_not_depend_on_the_unit() -> None:
    other = 1.3 * POPULATION
    mine, theirs = (
        log_scores(scoring_target(READINGS, EQUAL), p, ALIKE, EVERY) for p in (POPULATION, other)
    )
    scaled = scoring_target(1000 * READINGS, EQUAL)
    a, b = (log_scores(scaled, 1000 * p, ALIKE, EVERY) for p in (POPULATION, other))
    np.testing.assert_allclose(a - b, mine - theirs, atol=1e-9)


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


def test_rows_are_scored_by_themselves() -> None:
    scoring = scoring_target(READINGS, EQUAL)
    every = log_scores(scoring, POPULATION, ALIKE, EVERY)
    rows = np.array([7, 2, 30])
    # Products of matrices of other shapes round differently.
    found = log_scores(scoring, POPULATION, ALIKE, rows)
    np.testing.assert_allclose(found, every[rows], rtol=1e-12)


def test_a_specimen_keeps_its_score_in_any_order() -> None:
    observed = RNG.normal(size=(40, 2))
    observed[[1, 5, 6, 20, 33], 0] = np.nan
    simulated = RNG.normal(size=(20_000, 2))
    found = log_scores(scoring_target(observed, EQUAL), simulated, ALIKE, EVERY)
    order = RNG.permutation(40)
    again = log_scores(scoring_target(observed[order], EQUAL), simulated, ALIKE, EVERY)
    np.testing.assert_allclose(again, found[order], atol=1e-6)
    assert np.ptp(found) > 1


def test_one_specimen_far_out_costs_a_bounded_amount() -> None:
    far = np.append(READINGS, 60.0)
    found = log_scores(scoring_target(far, np.full(41, 1 / 41)), POPULATION, ALIKE, np.arange(41))
    # A hundredth of a Student's t density with three degrees of freedom, 29 units out.
    assert -22 < found[-1] < -10


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


def test_data_without_a_density_are_refused() -> None:
    with pytest.raises(ValueError, match="bandwidth: got 0"):
        scoring_target(np.ones(9), np.full(9, 1 / 9))
