"""Audit of emulators at likely inputs of posterior draws: poles, periods, and smooth responses."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm
import pytest

import prbayes as prb
from prbayes._finding import Finding, from_json
from prbayes.model.evaluator import Evaluator
from prbayes.model.specimen_audit import audited_evaluator
from prbayes.model.specimen_preparation import prepared
from prbayes.propagation.base import DesignError

# Beside a pole, or a period away, the emulator without runs has inputs that do not exist. One
# specimen is where the response oscillates, so that runs at the others do not show its inputs.
ONE_AT_TWICE_THE_OTHERS = np.array([60.0, *np.random.default_rng(3).normal(28, 3, 14)[1:]])
PROBLEMS: dict[str, Any] = {
    "pole": (lambda x: 100 / x, (20.0, 8.0), 4.0, ONE_AT_TWICE_THE_OTHERS),
    "close pole": (lambda x: 100 / (x - 10), (20.0, 8.0), 4.0, ONE_AT_TWICE_THE_OTHERS),
    "waves": (
        lambda x: x + np.where(x > 45, 3 * np.sin(3 * x), 0),
        (20.0, 8.0),
        4.0,
        ONE_AT_TWICE_THE_OTHERS,
    ),
    "period": (
        lambda x: np.tan(x / 4),
        (3.0, 2.0),
        1.0,
        np.random.default_rng(0).normal(3.5, 0.5, 14),
    ),
}


def build(
    response: Callable[[Any], Any], of_mu: tuple[float, float], of_sigma: float, x: Any
) -> pm.Model:
    with pm.Model() as model:
        mu, sigma = pm.Normal("mu", *of_mu), pm.HalfNormal("sigma", of_sigma)
        prb.Simulator("y", response, pm.Normal.dist(mu, sigma), observed=response(x))
    return model


def exact(of_mu: tuple[float, float], of_sigma: float, x: Any) -> tuple[Any, Any]:
    """Return posterior means and standard deviations of mu and sigma, from the inputs, (2,)."""
    mu = np.linspace(of_mu[0] - 6 * of_mu[1], of_mu[0] + 6 * of_mu[1], 1601)
    sigma = np.linspace(0.01, 8 * of_sigma, 1200)[:, None]
    squares = ((x - x.mean()) ** 2).sum() + len(x) * (x.mean() - mu) ** 2
    logs = -len(x) * np.log(sigma) - squares / (2 * sigma**2)
    logs -= ((mu - of_mu[0]) / of_mu[1]) ** 2 / 2 + (sigma / of_sigma) ** 2 / 2
    weights = np.exp(logs - logs.max())
    weights /= weights.sum()
    mean = np.array([(weights * mu).sum(), (weights * sigma).sum()])
    square = np.array([(weights * mu**2).sum(), (weights * sigma**2).sum()])
    return mean, np.sqrt(square - mean**2)


@pytest.mark.long
def test_a_prior_far_from_the_data_is_no_rough_response() -> None:
    """Fifteen prior standard deviations off, populations are wide, and reach beyond the runs."""
    logs = 1.0 + 0.1 * np.random.default_rng(0).standard_normal(20)
    with pm.Model() as model:
        k = pm.LogNormal.dist(pm.Normal("mu", 0.2, 0.05), pm.HalfNormal("sigma", 0.3))
        prb.Simulator("y", lambda k: 3 / k, k, observed=3 / np.exp(logs))
    result = prb.sample(500, model=model, random_seed=1, progressbar=False)
    mean, sd = exact((0.2, 0.05), 0.3, logs)
    draws = np.stack([result.posterior[name].values.ravel() for name in ("mu", "sigma")])
    np.testing.assert_allclose((draws.mean(axis=1) - mean) / sd, 0, atol=0.15)
    conflict = [f for f in prb.diagnose(result, model=model).findings if "conflict" in f.code]
    assert len(conflict) >= 1


def findings_of(result: Any) -> tuple[Finding, ...]:
    return from_json(result["posterior"].attrs["findings"])


@pytest.mark.long
@pytest.mark.parametrize("name", ["pole", "close pole", "period"])
def test_inputs_that_do_not_exist_have_no_mass(name: str) -> None:
    response, *priors, x = PROBLEMS[name]
    posterior = prb.sample(model=build(response, *priors, x), random_seed=1).posterior
    mean, sd = exact(*priors, x)
    draws = np.stack([posterior[name].values.ravel() for name in ("mu", "sigma")])
    np.testing.assert_allclose((draws.mean(axis=1) - mean) / sd, 0, atol=0.1)
    np.testing.assert_allclose(draws.std(axis=1) / sd, 1, atol=0.1)


@pytest.mark.long
def test_a_budget_that_ends_in_the_audit_keeps_the_draws() -> None:
    first = Evaluator.of(build(*PROBLEMS["waves"]))
    first.log_other(np.zeros((1, 2)))
    most = first.n_responses + 1
    model = build(*PROBLEMS["waves"])
    result = prb.sample(model=model, max_runs=most, random_seed=1)
    assert result.posterior.sizes["draw"] == 1000
    (text,) = [f.text for f in findings_of(result) if f.code == "budget-spent"]
    assert text.startswith(f"max_runs = {most} was reached before the runs were checked at the dra")
    # A larger budget gives the same as a new model.
    again = prb.sample(model=model, max_runs=300, random_seed=1)
    expected, sd = exact(*PROBLEMS["waves"][1:])
    assert "budget-spent" not in {f.code for f in findings_of(again)}
    np.testing.assert_allclose(again.posterior["mu"].mean(), expected[0], atol=0.1 * sd[0])


@pytest.mark.long
def test_a_budget_that_ends_in_the_audit_keeps_the_optimum() -> None:
    first = Evaluator.of(build(*PROBLEMS["waves"]))
    first.log_other(np.zeros((1, 2)))
    most = first.n_responses + 1
    model = build(*PROBLEMS["waves"])
    optimum = prb.minimize(model, max_runs=most)
    (text,) = [f.text for f in optimum.findings if f.code == "budget-spent"]
    assert text.startswith(
        f"max_runs = {most} was reached before the runs were checked at the optima"
    )
    again = prb.minimize(model)
    assert "budget-spent" not in {f.code for f in again.findings}
    new = prb.minimize(build(*PROBLEMS["waves"]))
    assert again.point["mu"] == pytest.approx(new.point["mu"], rel=1e-3)


@pytest.mark.long
def test_sequential_monte_carlo_is_audited(tmp_path: Path) -> None:
    settings: dict[str, Any] = {"draws": 400, "random_seed": 1, "progressbar": False}
    result = prb.sample_smc(model=build(*PROBLEMS["waves"]), chains=1, **settings)
    expected, sd = exact(*PROBLEMS["waves"][1:])
    # Four standard errors of 400 draws, which are correlated.
    np.testing.assert_allclose(result.posterior["mu"].mean(), expected[0], atol=0.3 * sd[0])
    model = build(*PROBLEMS["waves"])
    with pytest.raises(DesignError, match="not smooth enough"):
        prb.sample_smc(model=model, chains=1, checkpoint=tmp_path / "stages.npz", **settings)


def test_a_smooth_response_needs_no_further_run() -> None:
    x = np.random.default_rng(1).normal(1, 0.5, 20)
    model = build(lambda x: 2 * x + 1, (1.0, 1.0), 1.0, x)
    evaluator = Evaluator.of(model)
    thetas = evaluator.hyperparameters.prior_thetas(100, 0)
    evaluator.log_other(thetas)
    n_runs = evaluator.n_responses
    assert audited_evaluator(evaluator, thetas, "here", is_last=True) == (evaluator, ())
    assert evaluator.n_responses == n_runs


def test_a_wrong_emulator_is_refused_in_the_last_round(monkeypatch: pytest.MonkeyPatch) -> None:
    evaluator = Evaluator.of(build(*PROBLEMS["period"]))
    thetas = np.stack([np.full(32, 3.5), np.full(32, np.log(0.5))], axis=1)
    evaluator.log_other(thetas)
    (likelihood,) = evaluator.likelihoods
    preparation = prepared(likelihood)
    # Its outputs are wrong by a fifth, and it does not claim to know them.
    surface = preparation.emulation.surface
    monkeypatch.setattr(type(surface), "variance", lambda _, z: np.ones((len(z), 1)))
    wrong = replace(surface, center=surface.center + 0.2)
    emulation = replace(preparation.emulation, surface=wrong)
    likelihood.cache["preparation"] = replace(preparation, emulation=emulation)
    with pytest.raises(DesignError, match=r"not smooth enough.*an emulator of \d+ runs that would"):
        audited_evaluator(evaluator, thetas, "here", is_last=True)


def test_synthetic_data_of_the_emulator_are_not_audited() -> None:
    calls: list[int] = []
    response, *priors, x = PROBLEMS["period"]

    def counted(x: Any) -> Any:
        calls.append(np.size(x))
        return response(x)

    model = build(counted, *priors, x)
    prepared(Evaluator.of(model).likelihoods[0])
    n_runs = sum(calls)
    prb.simulation_based_calibration(4, model=model, draws=50, progressbar=False)
    assert sum(calls) <= n_runs + 4  # a few repeated runs show that the response is the same


def test_gross_errors_need_no_runs() -> None:
    x = np.random.default_rng(0).normal(1, 0.5, 20)
    y = np.exp(x)
    y[0] += 60
    metric = prb.LogLikelihood(error=0.1, gross_errors=True)
    with pm.Model() as model:
        of_specimens = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1))
        prb.Simulator("y", np.exp, of_specimens, observed=y, metric=metric)
    evaluator = Evaluator.of(model)
    prepared(evaluator.likelihoods[0])
    n_runs = evaluator.n_responses
    posterior = prb.sample(model=model, random_seed=1).posterior
    assert evaluator.n_responses <= n_runs + 8  # the runs of one audit
    assert abs(float(posterior["mu"].mean()) - x[1:].mean()) < 0.15


@pytest.mark.long
def test_an_audit_makes_no_other_problem() -> None:
    model = build(*PROBLEMS["waves"])
    (first,) = Evaluator.of(model).likelihoods
    posterior = prb.sample(200, model=model, random_seed=1)
    assert Evaluator.of(model).likelihoods != (first,)  # the posterior needed more runs
    optimum = prb.minimize(build(*PROBLEMS["waves"]))
    assert prb.compare({"optimum": optimum, "posterior": posterior}) is not None
    again = prb.sample(200, model=model, optimum=optimum, random_seed=1)
    assert prb.compare({"posterior": again}, model=build(*PROBLEMS["waves"])) is not None


def test_inaccurate_readings_have_no_population_where_the_emulator_is_wrong() -> None:
    """Five readings whose error is as large as their spread leave the inputs open."""
    y = [0.6077, 0.6272, 0.5734, 0.6471, 0.5784]
    with pm.Model():
        x = pm.Normal.dist(pm.Normal("mu", 0.12, 2.38), pm.HalfNormal("sigma", 1.18))
        metric = prb.LogLikelihood(error=0.042)
        prb.Simulator("y", lambda x: 1 / (1 + np.exp(-2 * x)), x, observed=y, metric=metric)
        mu = prb.sample(2000, random_seed=11, progressbar=False).posterior["mu"]
    # The readings are those of inputs between .15 and .3; a false mode was near -1.4.
    assert float(mu.mean()) == pytest.approx(0.219, abs=0.02)
    assert float((mu < -0.5).mean()) < 0.002
