"""Results of models with the log-likelihood by specimen, in everything after the posterior."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import arviz as az
import matplotlib.pyplot as plt
import numpy as np
import pymc as pm
import pytest
import xarray as xr
from one_input import one_input
from scipy.stats import norm, t

import prbayes as prb
from prbayes.inference.checks.population import PopulationTest
from prbayes.model.evaluator import specimen_log_likelihoods
from prbayes.model.specimen_likelihood import arrays
from prbayes.optimize.convergence import Result
from prbayes.optimize.maximum_likelihood import specimen_pool, specimen_refits
from prbayes.response.distributions import compiled_log_density, normal_scores
from prbayes.results.diagnose import _check_sampler
from prbayes.results.likelihood_checks import (
    CheckOptions,
    check_conflict,
    check_population,
    influence,
    scored_specimens,
    separate_modes,
)

N = 20


class Growth:
    """A response that counts its runs."""

    def __init__(self, rate: float) -> None:
        self.rate = rate
        self.runs = 0

    def __call__(self, x: Any) -> Any:
        self.runs += np.size(x)
        return np.exp(self.rate * x)


@dataclass
class Problem:
    """A model, its response and input, and data of another condition."""

    model: pm.Model
    growth: Growth
    x: Any
    observed: np.ndarray
    later: np.ndarray


def build(observed: np.ndarray) -> Problem:
    growth = Growth(0.5)
    with pm.Model() as model:
        mu = pm.Normal("mu", 1.0, 1.0)
        sigma = pm.HalfNormal("sigma", 1.0)
        x = pm.Normal.dist(mu, sigma)
        prb.Simulator("y", growth, x, observed=observed)
    later = np.exp(0.7 * np.random.default_rng(8).normal(1.0, 0.4, 15))
    return Problem(model, growth, x, observed, later)


@pytest.fixture(scope="module")
def problem() -> Problem:
    return build(np.exp(0.5 * np.random.default_rng(7).normal(1.0, 0.4, N)))


@pytest.fixture(scope="module")
def optimum(problem: Problem) -> prb.Optimum:
    return prb.minimize(problem.model)


@pytest.fixture(scope="module")
def posterior(problem: Problem, optimum: prb.Optimum) -> xr.DataTree:
    return prb.sample_smc(
        model=problem.model, optimum=optimum, draws=200, chains=2, random_seed=1, progressbar=False
    )


@pytest.fixture(scope="module")
def chains(problem: Problem, posterior: xr.DataTree) -> xr.DataTree:
    """Draws without anything that prbayes adds, as of pm.sample, from a file perhaps."""
    return xr.DataTree.from_dict(
        {name: posterior[name].to_dataset() for name in ("posterior", "observed_data")}
    ).map_over_datasets(lambda group: group.drop_attrs(deep=False))


@pytest.fixture
def results(
    optimum: prb.Optimum, posterior: xr.DataTree, chains: xr.DataTree
) -> dict[str, prb.Optimum | xr.DataTree]:
    return {"optimum": optimum, "posterior": posterior, "chains": chains}


@pytest.fixture
def no_run(problem: Problem, optimum: prb.Optimum) -> Any:
    """The test makes no run of the model's response, but repeats three for each function."""
    before = problem.growth.runs
    yield
    assert problem.growth.runs - before in (0, 3, 6)


@pytest.mark.usefixtures("no_run")
def test_compare_scores_by_likelihood_and_metrics(problem: Problem, results: Any) -> None:
    table = prb.compare(results, model=problem.model)
    assert table.result.values.tolist() == ["optimum", "posterior", "chains"]
    own = table["LogLikelihood by specimen"]
    assert own.values.argmin() == 0  # of the maximum of the likelihood
    assert float(own[0]) == pytest.approx(results["optimum"].discrepancy / N)
    assert {"AreaMetric", "KullbackLeibler", "ProbabilityResidual"} <= set(table.data_vars)
    areas = prb.compare(results, model=problem.model, metrics=[prb.AreaMetric()])["AreaMetric"]
    np.testing.assert_allclose(areas, table["AreaMetric"])


@pytest.mark.usefixtures("no_run")
@pytest.mark.parametrize("name", ["optimum", "posterior", "chains"])
def test_own_response_is_predicted_by_the_emulator(
    problem: Problem, results: Any, name: str
) -> None:
    predicted = prb.predict(results[name], problem.growth, problem.x, model=problem.model)
    assert predicted.attrs["responses"] == 0
    assert "by the emulator of y" in predicted.attrs["source"]
    if name == "optimum":
        point = results[name].point
        sample = np.sort(predicted.values.ravel())
        exact = np.exp(0.5 * norm.ppf((np.arange(500) + 0.5) / 500, point["mu"], point["sigma"]))
        # Quasi-random specimens: quantiles differ by less than one of 500 specimens apart.
        np.testing.assert_allclose(sample[25:-25], exact[25:-25], rtol=0.02)


def test_another_response_costs_a_hundred_odd_runs(problem: Problem, results: Any) -> None:
    later = Growth(0.7)
    predicted = prb.predict(results["posterior"], later, problem.x, model=problem.model)
    # Three, and an eighth in another order, show whether specimens are independent of each other.
    assert 3 <= later.runs - predicted.attrs["responses"] <= 28
    assert predicted.attrs["responses"] <= 200
    assert "interpolant" in predicted.attrs["source"]
    computed = prb.predict(
        results["posterior"], later, problem.x, model=problem.model, stored=False
    )
    assert computed.attrs["specimens_id"] == predicted.attrs["specimens_id"]
    np.testing.assert_allclose(predicted, computed, rtol=1e-4)


def test_rough_response_is_reported(
    problem: Problem, optimum: prb.Optimum, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING, "prbayes"):
        prb.predict(optimum, lambda x: np.sin(400 * x), problem.x, name="rough")
    assert "stored=False" in caplog.text


def test_failed_specimens_are_predicted(problem: Problem, optimum: prb.Optimum) -> None:
    limit = optimum.point["mu"] + optimum.point["sigma"]
    failing = prb.predict(
        optimum, lambda x: np.where(x > limit, np.inf, x), problem.x, name="failing"
    )
    # A run decides where the response fails: by how much is the distance between runs.
    assert np.isinf(failing).mean() == pytest.approx(norm.sf(1), abs=0.05)


@pytest.mark.usefixtures("no_run")
def test_exceedance(problem: Problem, optimum: prb.Optimum) -> None:
    limit = float(np.exp(0.5 * (optimum.point["mu"] + optimum.point["sigma"])))
    risk = prb.exceedance(optimum, problem.growth, limit, problem.x, n_draws=200)
    assert risk.attrs["responses"] == 0
    thetas = optimum.theta + norm.ppf(0.5 + np.zeros((1, 2)))  # the centre
    mu, sigma = thetas[0, 0], np.exp(thetas[0, 1])
    at_center = norm.sf((2 * np.log(limit) - mu) / sigma)
    # The mean over uncertain hyperparameters is larger than the probability at the centre.
    assert at_center < float(risk.probability) < at_center + 0.05
    assert float(risk.lower) < at_center < float(risk.upper)


@pytest.mark.usefixtures("no_run")
def test_sensitivity_and_plan(problem: Problem, posterior: xr.DataTree) -> None:
    mean = prb.decision.Mean(problem.growth, problem.x)
    shares = prb.sensitivity(posterior, mean, model=problem.model, n_points=128)
    assert float(shares["first"].sel(factor="mu")) > 0.5
    plan = prb.plan(
        posterior,
        {"same": prb.decision.Condition(problem.growth, problem.x)},
        k=3 * N,
        model=problem.model,
    )
    # Three times as many specimens again: half the standard deviation, but for what a prior adds.
    ratio = plan.sd.sel(candidate="same", k=3 * N, name="mu") / plan.now.sel(name="mu")
    assert float(ratio) == pytest.approx(0.5, abs=0.08)


@pytest.mark.usefixtures("no_run")
def test_refit_of_the_observed_data_is_the_optimum(optimum: prb.Optimum) -> None:
    refits = specimen_refits(optimum, "test")
    (theta,), (converged,) = refits.fit([np.ones((1, N))])
    assert converged
    np.testing.assert_allclose(theta, optimum.theta, atol=1e-3)
    errors = np.sqrt(np.diag(optimum.covariance))
    correlated = replace(refits, covariance=np.outer(errors, errors) * [[1.0, 0.7], [0.7, 1.0]])
    thetas, _ = correlated.reweighted([np.full((1, N), 1 / N)])
    np.testing.assert_allclose(thetas[0], theta, atol=1e-3)
    (theta, other), _ = correlated.fit([np.stack([np.ones(N), np.arange(N) * 2 / (N - 1)])])
    np.testing.assert_allclose(theta, optimum.theta, atol=1e-3)
    (alone,), _ = refits.fit([np.arange(N)[None] * 2 / (N - 1)])
    np.testing.assert_allclose(other, alone, atol=1e-3)


@pytest.mark.usefixtures("no_run")
def test_bootstrap_has_the_width_of_the_standard_errors(optimum: prb.Optimum) -> None:
    draws = prb.bootstrap(optimum, draws=200)
    assert draws.posterior.attrs["converged"] == 1
    # Twenty specimens, and 200 draws: a standard deviation has a standard error of 5 %, and the
    # ratio to the curvature's depends on the data's fourth moment.
    assert float(draws.posterior["mu"].std()) == pytest.approx(optimum.stderr["mu"], rel=0.2)


@pytest.mark.usefixtures("no_run")
def test_refits_of_simulated_data_are_maximum_likelihood_estimates(optimum: prb.Optimum) -> None:
    """Of a normal population in x they are mean and standard deviation of the inputs."""
    evaluator = optimum.evaluator
    (likelihood,) = evaluator.likelihoods
    params = evaluator.hyperparameters.constrained(optimum.theta[None])
    pool = specimen_pool(likelihood, params, np.random.default_rng(3), size=1)
    (points,), log_a = pool(np.random.default_rng(4))
    before = specimen_log_likelihoods(evaluator, optimum.theta[None])["y"]
    refits = specimen_refits(optimum, "test")
    (theta,), _ = refits.fit([np.ones((1, N))], [points[None], log_a[None]])
    weights = np.exp(log_a - log_a.max(axis=1, keepdims=True))
    inputs = (weights * points).sum(axis=1) / weights.sum(axis=1)
    assert theta[0] == pytest.approx(inputs.mean(), abs=1e-3)
    assert np.exp(theta[1]) == pytest.approx(inputs.std(), rel=1e-2)
    after = specimen_log_likelihoods(evaluator, optimum.theta[None])["y"]
    np.testing.assert_array_equal(after, before)


@pytest.mark.usefixtures("no_run")
def test_data_sets_are_fitted_together_as_one_by_one(
    optimum: prb.Optimum, monkeypatch: pytest.MonkeyPatch
) -> None:
    refits = specimen_refits(optimum, "test")
    together = [theta for theta, _, _ in refits.simulated(5, seed=3)]
    monkeypatch.setattr("prbayes.optimize.maximum_likelihood.IN_CACHE", 1)
    one_by_one = [theta for theta, _, _ in refits.simulated(5, seed=3)]
    np.testing.assert_allclose(together, one_by_one, atol=1e-6)
    assert np.ptp(together, axis=0).min() > 0


@pytest.mark.usefixtures("no_run")
def test_cross_validation_is_the_log_density_of_specimens_left_out(optimum: prb.Optimum) -> None:
    table = prb.cross_validate(optimum)
    assert table.sizes == {"fold": 5, "simulator": 1, "specimen": N}
    assert bool(table.converged.all())
    assert float(table.discrepancy.mean()) > float(table.calibrated.mean())


@pytest.mark.usefixtures("no_run")
def test_scores_of_the_population_test_are_those_of_the_inputs(
    problem: Problem, optimum: prb.Optimum
) -> None:
    evaluator = optimum.evaluator
    (likelihood,) = evaluator.likelihoods
    (points,), log_a = arrays(likelihood)
    data = [([points.get_value()], log_a.get_value())]
    inputs = likelihood.inputs
    scores = [(normal_scores(inputs), compiled_log_density(inputs))]
    ((z, weights),) = scored_specimens(evaluator, scores, optimum.theta, data)
    np.testing.assert_allclose(weights.sum(axis=1), 1.0)
    exact = (2 * np.log(problem.observed) - optimum.point["mu"]) / optimum.point["sigma"]
    np.testing.assert_allclose((weights * z[..., 0]).sum(axis=1), exact, atol=1e-3)


@pytest.mark.usefixtures("no_run")
@pytest.mark.parametrize("name", ["posterior", pytest.param("optimum", marks=pytest.mark.long)])
def test_a_diagnosis_states_the_power(problem: Problem, results: Any, name: str) -> None:
    with problem.model:  # The model on the context counts, as model= does.
        found = prb.diagnose(results[name])
    assert found.ok
    assert not found.untested
    assert str(found).startswith("No problem was found.")
    assert any("a power of 0.23 for skewness 1" in note for note in found.notes)
    assert "epsilon" not in str(found)


def test_diagnosis_without_the_model_says_what_was_not_tested(
    optimum: prb.Optimum, posterior: xr.DataTree
) -> None:
    for result in (posterior, optimum.to_datatree()):
        found = prb.diagnose(result)
        assert found.untested
        assert str(found).startswith("No problem was found by the tests that were run.")


def test_chains_in_different_modes() -> None:
    draws = np.random.default_rng(0).normal(0, 1, (4, 200, 2))
    assert not separate_modes(draws, ["mu", "sigma"])
    assert not separate_modes(draws[:1], ["mu", "sigma"])
    draws[2, :, 0] += 5
    (finding,) = separate_modes(draws, ["mu", "sigma"])
    assert finding.code == "chains-in-different-modes"
    assert "for mu within-chain" in finding.text
    assert "prb.sample_smc" in finding.text


def test_chains_in_different_modes_take_the_place_of_r_hat(chains: xr.DataTree) -> None:
    apart = chains.copy(deep=True)
    apart["posterior"]["mu"][{"chain": 1}] += 2.0
    codes = [finding.code for finding in _check_sampler(apart, None, by_specimen=True).findings]
    assert codes == ["chains-in-different-modes"]
    assert not _check_sampler(chains, None, by_specimen=True).remarks
    all_diverge = xr.Dataset({"diverging": apart["posterior"]["mu"] > -np.inf})
    apart["sample_stats"] = xr.DataTree(all_diverge)
    (remark,) = _check_sampler(apart, None, by_specimen=True).remarks
    total = chains["posterior"]["mu"].size
    assert remark.text.startswith(f"{total} of {total} transitions of NUTS diverged")


def test_a_prior_that_agrees_with_the_data_is_no_conflict(optimum: prb.Optimum) -> None:
    errors = np.sqrt(np.diag(optimum.covariance))
    for pull, text in ((0.1, "too little to matter"), (1.0, "no hyperparameter is in conflict")):
        checked = check_conflict(optimum, (optimum.theta + pull * errors)[None])
        assert text in str(checked.remarks[0])
        assert "_log__" not in str(checked.remarks[0])
        assert not checked.findings


def test_conflict_of_prior_and_data(problem: Problem) -> None:
    model = one_input(problem.observed, response=lambda x: np.exp(0.5 * x), mu=(-1.0, 0.1))
    optimum = prb.minimize(model, starts=0, progressbar=False)
    checked = check_conflict(optimum, (optimum.theta - [1.5, 0.0])[None])
    assert [finding.code for finding in checked.findings] == ["prior-conflict"]
    assert str(checked.findings[0]).startswith("mu: got prior")


@pytest.mark.long
def test_conflict_is_reported_with_censored_readings_too() -> None:
    readings = np.minimum(np.random.default_rng(1).normal(4, 1, 20), 4.5)
    metric = prb.LogLikelihood(censored=(None, 4.5))
    model = one_input(readings, metric, response=lambda x: 1.0 * x, mu=(0.0, 0.5))
    posterior = prb.sample(model=model, progressbar=False)
    diagnosis = prb.diagnose(posterior, model=model)
    assert "prior-conflict" in [finding.code for finding in diagnosis.findings]
    (untested,) = diagnosis.untested
    assert untested.startswith("The family of the population was not tested: readings of y are c")


def test_influential_specimen_is_reported(posterior: xr.DataTree) -> None:
    assert not influence(posterior)
    heavy = posterior.copy(deep=True)
    # Importance weights with a Pareto tail of shape 1.5.
    heavy["log_likelihood"]["y"][..., 3] = -np.random.default_rng(1).exponential(1.5, (2, 200))
    (finding,) = influence(heavy)
    assert finding.code == "influential-specimens"
    diagnosis = prb.diagnose(heavy)
    assert finding.code in {remark.code for remark in diagnosis.remarks}
    assert finding.code not in {x.code for x in diagnosis.findings}
    assert "indices 3" in finding.text


@pytest.mark.usefixtures("no_run")
def test_loo_pit_is_the_predictive_distribution_function_without_the_specimen() -> None:
    y = np.random.default_rng(0).normal(6, 2, 40)
    with pm.Model():
        x = pm.Normal.dist(pm.Normal("mu", 0, 10), pm.HalfNormal("sigma", 5))
        prb.Simulator("y", lambda x: 2 * x, x, observed=y)
        idata = prb.sample(progressbar=False)
    pit = az.loo_pit(idata)["y"].values
    exact = []
    for i in range(len(y)):
        rest = np.delete(y, i)
        scale = rest.std(ddof=1) * np.sqrt(1 + 1 / len(rest))
        exact.append(t.cdf((y[i] - rest.mean()) / scale, len(rest) - 1))
    # Five standard errors of 4000 draws, and the difference between the priors.
    assert np.abs(pit - exact).max() < 0.05
    az.plot_loo_pit(idata)
    plt.close("all")


def test_what_has_no_meaning_is_refused(optimum: prb.Optimum) -> None:
    fresh = build(np.exp(0.5 * np.random.default_rng(7).normal(1.0, 0.4, N)))
    calls: list[tuple[Callable[[], Any], str]] = [
        (lambda: prb.refine(fresh.model), "leave the call out"),
        (lambda: prb.set_epsilon(fresh.model, {"y": 0.1}), "has no epsilon"),
        (lambda: prb.set_epsilon(fresh.model, 0.1), "has no epsilon"),
        (lambda: prb.calibrate_epsilon(optimum), "has no epsilon"),
    ]
    for call, message in calls:
        with pytest.raises(ValueError, match=message):
            call()
    assert fresh.growth.runs == 0


def test_cost_before_and_after(problem: Problem, optimum: prb.Optimum) -> None:
    data = problem.observed
    fresh = build(data)
    before = prb.cost(fresh.model)
    assert fresh.growth.runs == 0
    assert before.runs == 30  # first runs and two batches of ten
    assert "30 runs, 0 of them computed" in str(before)
    assert prb.cost(problem.model).runs == 0


@pytest.mark.usefixtures("no_run")
def test_files_answer_without_a_run(
    problem: Problem, optimum: prb.Optimum, posterior: xr.DataTree, tmp_path: Path
) -> None:
    posterior.to_netcdf(tmp_path / "posterior.nc")
    optimum.to_datatree().to_netcdf(tmp_path / "optimum.nc")
    stored = xr.load_datatree(tmp_path / "posterior.nc")
    loo = az.loo(stored, var_name="y")
    assert np.isfinite(loo.elpd)
    predicted = prb.predict(stored, problem.growth, problem.x, model=problem.model)
    direct = prb.predict(posterior, problem.growth, problem.x, model=problem.model)
    np.testing.assert_allclose(predicted, direct)
    table = prb.compare({"a": xr.load_datatree(tmp_path / "optimum.nc"), "b": stored})
    assert table.sizes["result"] == 2


def test_tests_without_standard_errors_name_what_to_fix(optimum: prb.Optimum) -> None:
    """As in models of groups, whose mean and spread have no standard error."""
    covariance = optimum.covariance.copy()
    covariance[1] = covariance[:, 1] = np.inf
    name = optimum.evaluator.hyperparameters.readable_names[1]
    unknown = replace(optimum, covariance=covariance)
    expected = f"no standard error of {name}, and data sets cannot be refitted; fix {name} with pm"
    assert expected in check_population(unknown).untested[0]
    assert expected in check_conflict(unknown, optimum.theta[None]).untested[0]
    search = replace(optimum.search, result=Result.FAILED)
    (reason,) = check_population(replace(optimum, search=search)).untested
    assert "did not converge; pass another start=" in reason


@pytest.mark.parametrize(("p", "kind"), [(0.02, "findings"), (0.04, "remarks"), (0.06, "")])
def test_a_misfit_is_a_finding_up_to_half_the_level(
    optimum: prb.Optimum, p: float, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    module = "prbayes.results.likelihood_checks"
    result = PopulationTest(p, np.array([p]), np.array([0.5]), N)
    monkeypatch.setattr(f"{module}.population_test", lambda *_: result)
    monkeypatch.setattr(f"{module}._OPTIONS", CheckOptions(replicates=4))
    optimum.evaluator.likelihoods[0].cache.pop("population", None)
    checked = check_population(optimum)
    monkeypatch.setattr(f"{module}.specimen_refits", None)  # the last test is kept
    assert check_population(replace(optimum, theta=optimum.theta + 1e-5)) is checked
    optimum.evaluator.likelihoods[0].cache.pop("population")
    codes = {key: [f.code for f in getattr(checked, key)] for key in ("findings", "remarks")}
    expected = {"findings": [], "remarks": []} | ({kind: ["population-misfit"]} if kind else {})
    assert codes == (expected if kind else expected | {"remarks": ["population-tested"]})


@pytest.mark.long
def test_mixed_model() -> None:
    rng = np.random.default_rng(4)
    growth, later = Growth(0.5), Growth(0.7)
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1, 1), pm.HalfNormal("sigma", 1))
        prb.Simulator("y", growth, x, observed=np.exp(0.5 * rng.normal(1, 0.4, N)))
        prb.Simulator(
            "w",
            later,
            x,
            metric=prb.ProbabilityResidual(),
            observed=np.exp(0.7 * rng.normal(1, 0.4, 30)),
            epsilon=0.01,
        )
    optimum = prb.minimize(model)
    tree = optimum.to_datatree()
    assert tree["calibration"]["simulator"].values.tolist() == ["w", "y"]
    assert tree["calibration"]["is_likelihood"].values.tolist() == [0, 1]
    posterior = prb.sample_smc(model=model, draws=100, chains=2, random_seed=1, progressbar=False)
    assert posterior["calibration"].sizes["simulator"] == 2
    own = prb.predict(posterior, growth, x, model=model)
    assert "emulator of y" in own.attrs["source"]
    with pytest.raises(ValueError, match=r"prb\.sample_smc"):
        prb.bootstrap(optimum)
