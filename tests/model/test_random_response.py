"""Random responses in a model: likelihood, posterior, predictions, stores and refusals."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest
from scipy import stats

import prbayes as prb
from prbayes.model.evaluator import Evaluator
from prbayes.model.specimen_likelihood import mean_over_emulators, specimen_likelihoods
from prbayes.model.specimen_preparation import prepared
from prbayes.response.call import Points, compute
from prbayes.response.compile import PLAIN

N = 24


def noisy(x: Any, rng: np.random.Generator) -> Any:
    return 2 * x + 0.5 * rng.standard_normal(np.shape(x))


DATA = noisy(np.random.default_rng(1).normal(1.0, 0.5, N), np.random.default_rng(2))


def model_of(response: Any, observed: Any = DATA, **settings: Any) -> tuple[pm.Model, Any]:
    with pm.Model() as model:
        mu, s = pm.Normal("mu", 1, 1), pm.HalfNormal("s", 1)
        x = pm.Normal.dist(mu, s)
        prb.Simulator("y", response, x, observed=observed, **settings)
    return model, x


@pytest.fixture(scope="module")
def calibrated() -> Any:
    response = prb.response.Stochastic(noisy, random_seed=1)
    model, x = model_of(response)
    result = prb.sample(500, model=model, random_seed=1, progressbar=False)
    return model, x, response, result


def test_posterior_is_near_the_exact_one(calibrated: Any) -> None:
    model, _, _, result = calibrated
    mu, s = np.meshgrid(np.linspace(0, 2, 121), np.linspace(0.005, 1.5, 120), indexing="ij")
    sd = np.sqrt(4 * s**2 + 0.25)[..., None]
    logs = stats.norm.logpdf(DATA, 2 * mu[..., None], sd).sum(axis=-1)
    logs += stats.norm.logpdf(mu, 1, 1) + stats.halfnorm.logpdf(s)
    weights = np.exp(logs - logs.max()) / np.exp(logs - logs.max()).sum()
    for name, grid in (("mu", mu), ("s", s)):
        draws = result["posterior"][name].to_numpy()
        mean = (weights * grid).sum()
        exact = np.sqrt((weights * (grid - mean) ** 2).sum())
        # The emulator of 128 runs has an error of about .4 exact standard deviations.
        assert abs(draws.mean() - mean) < 1.5 * exact
        assert 0.8 < draws.std() / exact < 1.5
    assert prb.cost(model).simulators[0].computed == 128
    assert result["log_likelihood"]["y"].shape[-1] == N


def test_graph_and_numbers_agree(calibrated: Any) -> None:
    model, *_ = calibrated
    theta = np.array([[1.0, np.log(0.5)], [0.5, np.log(0.8)], [1.0, np.log(1e-3)]])
    numbers = Evaluator.of(model)(theta).log_other
    logp = model.compile_logp(vars=model.observed_RVs, mode=PLAIN)
    graph = [float(logp({"mu": t[0], "s_log__": t[1]})) for t in theta]
    np.testing.assert_allclose(graph, numbers, rtol=1e-9)


@pytest.mark.long
def test_predictions_have_the_scatter(calibrated: Any) -> None:
    model, x, response, result = calibrated
    arguments: Any = {"model": model, "random_seed": 1, "progressbar": False}
    for stored in (True, False):
        predicted = prb.predict(result, response, x, stored=stored, n_draws=100, **arguments)
        sd = np.hypot(2 * float(result["posterior"]["s"].mean()), 0.5)
        assert float(predicted.std()) == pytest.approx(sd, rel=0.15)
    assert set(prb.population(result, model=model).name.values) == {"x"}
    individuals = prb.individuals(result, model=model)
    assert "noise" in str(individuals)
    with pytest.raises(TypeError, match="random response of a simulator of the model"):
        prb.predict(result, prb.response.Stochastic(noisy, random_seed=1), x, **arguments)


def test_population_at_a_point_has_the_density_there(calibrated: Any) -> None:
    model, *_ = calibrated
    (likelihood,) = set(specimen_likelihoods(model).values())
    points = prepared(likelihood).points
    assert points.tilts is not None
    x = likelihood.coordinates.inputs(points.z)[0][0]
    place = int(np.abs(x - 1.0).argmin())
    # Without the mass of the population its likelihood would grow like the density at the point.
    logs = Evaluator.of(model)(np.array([[x[place], np.log(s)] for s in (1e-4, 1e-6)])).log_other
    densities = points.log_a[:, place] + points.log_proposal[:, place]
    by_draw = (densities[:, None] + points.tilts[:, place]).sum(axis=0)
    expected = np.logaddexp.reduce(by_draw) - np.log(len(by_draw))
    np.testing.assert_allclose(logs, expected, atol=1e-3)


def test_likelihoods_of_specimens_have_the_sum_of_their_mean_over_emulators() -> None:
    rng = np.random.default_rng(0)
    logs, factors = rng.normal(size=(3, 5)), np.exp(rng.normal(size=(3, 5, 4)))
    logs[2, 1] = -np.inf
    for weights in (None, np.linspace(0.5, 1.5, 5)):
        unit = np.ones(5) if weights is None else weights
        result = mean_over_emulators(logs, factors, weights, np)
        by_draw = ((logs[:2, :, None] + np.log(factors[:2])) * unit[:, None]).sum(axis=1)
        expected = np.logaddexp.reduce(by_draw, axis=1) - np.log(4)
        np.testing.assert_allclose(result[:2].sum(axis=1), expected, rtol=1e-12)
        assert result[2, 1] == -np.inf
        assert np.isfinite(np.delete(result[2], 1)).all()
        graph = mean_over_emulators(pt.as_tensor(logs), pt.as_tensor(factors), weights, pt)
        np.testing.assert_allclose(graph.eval(mode=PLAIN), result, rtol=1e-12)


def test_runs_do_not_depend_on_their_chunk() -> None:
    response = prb.response.Stochastic(noisy, random_seed=1)
    x, noise = np.linspace(0, 1, 6), np.linspace(-1, 1, 6)

    def runs(rows: Any) -> Any:
        return compute(response, Points([x[rows], noise[rows]], [True, True]), False).values

    parts = np.concatenate([runs(slice(0, 1)), runs(slice(1, 4)), runs(slice(4, 6))])
    np.testing.assert_array_equal(runs(slice(None)), parts)
    assert np.unique((parts - 2 * x).round(6)).size == 6  # each run has noise of its own


def test_another_function_with_an_attribute_repeats_is_not_random() -> None:
    def double(x: Any) -> Any:
        return 2 * x

    double.repeats = 3  # type: ignore[attr-defined]
    model, _ = model_of(double)
    (likelihood,) = dict.fromkeys(specimen_likelihoods(model).values())
    assert len(likelihood.inputs.aleatory) == 1


def test_store_keeps_each_of_the_repeated_runs(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    calls = []

    def own(x: float) -> float:
        calls.append(x)
        return 2 * x + 0.5 * rng.standard_normal()

    logs = []
    for _ in range(2):
        response = prb.scalar(prb.response.Stochastic(own))
        settings = prb.Reweighted(64, store=tmp_path, version="1")
        model, _ = model_of(response, DATA[:8], propagation=settings)
        logs.append(Evaluator.of(model)(np.array([[1.0, -0.7]])).log_other[0])
        assert len(calls) == 64
    assert logs[0] == logs[1]


def noise_free(x: Any) -> Any:
    return 2 * x


METRICS = {"PR": prb.ProbabilityResidual(), "KLD": prb.KullbackLeibler(), "area": prb.AreaMetric()}


@pytest.mark.long
@pytest.mark.parametrize("name", METRICS)
def test_metrics_do_not_count_the_scatter_of_the_response_twice(name: str) -> None:
    rng = np.random.default_rng(4)
    observed = noisy(rng.normal(1.0, 0.5, 100), rng)
    points = {}
    for response in (prb.response.Stochastic(noisy, random_seed=1), noise_free):
        model, _ = model_of(response, observed, metric=METRICS[name])
        points[response] = prb.minimize(model, starts=0).point
    random, total = points.values()
    # Without noise s is that of all scatter: 4 s^2 + .25 in place of 4 s^2. Runs that are drawn
    # have an error of about a fifth of the standard errors .052 and .045.
    assert random["mu"] == pytest.approx(total["mu"], abs=0.04)
    assert random["s"] == pytest.approx(np.sqrt(total["s"] ** 2 - 0.0625), abs=0.04)


@pytest.mark.long
def test_errors_of_readings_are_not_counted_twice() -> None:
    rng = np.random.default_rng(5)
    observed = noisy(rng.normal(1.0, 0.5, 100), rng) + 0.6 * rng.standard_normal(100)
    response = prb.response.Stochastic(noisy, random_seed=1)
    model, _ = model_of(response, observed, metric=prb.LogLikelihood(error=0.6))
    optimum = prb.minimize(model)
    exact = np.sqrt((observed.var() - 0.25 - 0.36) / 4)
    assert optimum.point["mu"] == pytest.approx(observed.mean() / 2, abs=0.06)
    assert optimum.point["s"] == pytest.approx(exact, abs=0.06)


REFUSED: dict[str, tuple[str, dict[str, Any]]] = {
    "censored": ("censored=", {"metric": prb.LogLikelihood(censored=(None, 3.0))}),
    "selected": ("selected=", {"metric": prb.LogLikelihood(selected=(None, 30.0))}),
    "rounded": ("rounded=", {"metric": prb.LogLikelihood(rounded=0.1)}),
    "gross errors": ("gross_errors=", {"metric": prb.LogLikelihood(gross_errors=True)}),
    "relative": ("relative=True", {"metric": prb.LogLikelihood(error=0.1, relative=True)}),
    "metric, resimulated": (
        "expected prb.Reweighted",
        {"metric": prb.AreaMetric(), "propagation": prb.Resimulated(64)},
    ),
    "metric, emulator": (
        "expected prb.Reweighted",
        {
            "metric": prb.AreaMetric(),
            "propagation": prb.Reweighted(64, emulator=prb.surrogate.RadialBasis()),
        },
    ),
    "resimulated": ("expected prb.Reweighted", {"propagation": prb.Resimulated(64)}),
    "repeated": ("several readings of a specimen", {"specimens": ["a", "b"] * (N // 2)}),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_not_supported_is_refused_before_any_run(case: str) -> None:
    text, settings = REFUSED[case]

    def never(x: Any) -> Any:
        raise AssertionError("a run was computed")

    with pytest.raises(TypeError, match=text) as caught:
        model_of(prb.response.Stochastic(never), **settings)
    assert "random" in str(caught.value)


def test_unknown_error_is_refused() -> None:
    with pm.Model():
        x = pm.Normal.dist(pm.Normal("mu", 1, 1), 1.0)
        metric = prb.LogLikelihood(error=pm.HalfNormal("e", 0.1))
        response = prb.response.Stochastic(noisy)
        with pytest.raises(TypeError, match="an unknown error or bias"):
            prb.Simulator("y", response, x, observed=DATA, metric=metric)


def test_what_needs_other_points_is_refused(calibrated: Any) -> None:
    model, _, _, result = calibrated
    with pytest.raises(TypeError, match="got a random response"):
        prb.update(result, observed=DATA[:3], model=model)
    with pytest.raises((TypeError, ValueError), match="random"):
        prb.calibrate_each({"A": DATA, "B": DATA}, model=model)
    with pytest.raises((TypeError, ValueError), match="random"):
        prb.simulation_based_calibration(10, model=model)


def test_arguments() -> None:
    with pytest.raises(TypeError, match="the function of one specimen in it"):
        prb.response.Stochastic(prb.scalar(noisy))
    with pytest.raises(TypeError, match="plain function"):
        prb.response.Stochastic(prb.response.Stochastic(noisy, random_seed=1))
    with pytest.raises(ValueError, match="repeats"):
        prb.response.Stochastic(noisy, repeats=1, random_seed=1)
    with pytest.raises(TypeError, match="function of the inputs"):
        prb.response.Stochastic(3)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="missing a required argument"):
        model_of(prb.response.Stochastic(lambda a, b: a))
    with pytest.raises(ValueError, match="random_seed"):
        prb.response.Stochastic(noisy, random_seed=-1)
    seeded = prb.response.Stochastic(noisy, random_seed=1)
    x = np.ones(3)
    np.testing.assert_array_equal(seeded(x, x), seeded(x, x))
    assert (seeded(x, x) != seeded(x, 2 * x)).all()
