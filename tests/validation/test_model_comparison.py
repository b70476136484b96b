"""Candidates side by side: right family told, by ArviZ's arithmetic, the same data, or a refusal."""

from functools import cache
from typing import Any

import numpy as np
import pymc as pm
import pytest
import xarray as xr
from arviz_stats import compare as arviz_compare
from arviz_stats.utils import ELPDData

import prbayes as prb
from prbayes.validation.scores import log_scores, scoring_target

compare = prb.rank
SKEWED = np.exp(np.random.default_rng(0).normal(0.0, 0.7, 60))
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
    return {f.__name__: minimized(f, SKEWED) for f in (normal, lognormal)}


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
    n = SKEWED.size
    dse = theirs["dse"].to_numpy() * np.sqrt(n / (n - 1))
    np.testing.assert_allclose(table["difference"], abs(theirs["elpd_diff"]), rtol=1e-6)
    np.testing.assert_allclose(table["stderr"], dse, rtol=1e-6)


def test_a_score_is_that_of_a_population_that_has_not_seen_the_specimen() -> None:
    found = validated("lognormal")
    fold = np.random.default_rng([0, 3]).permutation(np.arange(60) % 5)
    out = np.flatnonzero(fold == 2)
    other = minimized(lognormal, SKEWED[fold != 2])
    population = prb.predict(other, np.positive, _input(other), n_samples=20_000, **QUIET)
    target = scoring_target(SKEWED, np.full(60, 1 / 60))
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
                    observed=(SKEWED if name == "first" else 1.5 * SKEWED**2)[:size],
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

    data = outputs(SKEWED)
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
            "y", np.positive, x, metric=prb.KullbackLeibler(), observed=SKEWED,
            propagation=resimulated, **QUIET,
        )  # fmt: skip
    candidates = {
        "stored": skewed()["lognormal"],
        "computed": prb.minimize(model, **QUIET),
        "normal, PR": minimized(normal, SKEWED, metric=prb.ProbabilityResidual()),
    }
    table = compare(candidates, **QUIET)
    assert table.candidate.values[-1] == "normal, PR"
    assert not table.told_apart.values[1]
    assert float(table.difference[1]) < 1


def test_refusals() -> None:
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
    other = prb.cross_validate(minimized(normal, SKEWED[::-1]), **QUIET)
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
            "y", np.positive, x, metric=prb.AreaMetric(), observed=SKEWED,
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
