"""Diagnostics of a sampler's result: sentences, silence, and what ArviZ draws of our trees."""

import re
from contextlib import nullcontext
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import arviz as az
import matplotlib.pyplot as plt
import numpy as np
import pymc as pm
import pytest
import xarray as xr
from arviz_stats import rhat
from scipy import stats

import prbayes as prb
from prbayes._finding import Finding
from prbayes.model.evaluator import Evaluator
from prbayes.optimize.convergence import Result
from prbayes.posterior.smc import _lost_findings
from prbayes.propagation.base import DesignError, discrepancy_error
from prbayes.results.diagnose import _NOISE

OBSERVED = np.random.default_rng(1).normal(1.0, 0.5, 40)


def same(x: Any) -> Any:
    return x


def build(propagation: Any = None, metric: Any = None) -> pm.Model:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1, 1), pm.HalfNormal("sigma", 1))
        prb.Simulator(
            "y", same, x, metric=metric or prb.AreaMetric(), observed=OBSERVED,
            propagation=propagation or prb.Reweighted(256),
        )  # fmt: skip
    return model


@cache
def sampled() -> tuple[pm.Model, xr.DataTree]:
    model = build()
    return model, prb.sample_smc(500, chains=4, model=model, random_seed=1, progressbar=False)


@cache
def sampled_by_epsilon() -> tuple[pm.Model, xr.DataTree]:
    model = build()
    settings = {"chains": 4, "model": model, "random_seed": 1, "progressbar": False}
    return model, prb.sample_smc(500, adjustment=None, **settings)


@cache
def stuck() -> xr.DataTree:
    """Classic ABC with an epsilon that hardly any simulated sample meets."""
    return prb.sample_smc(
        300,
        chains=2,
        model=build(prb.Fresh(40)),
        epsilon=0.002,
        adjustment=None,
        random_seed=1,
        progressbar=False,
    )


def normal_tree(means: Any, draws: int = 500) -> xr.DataTree:
    """Draws of chains with given means."""
    rng = np.random.default_rng(3)
    values = {
        "mu": 1 + 0.05 * (rng.normal(size=(len(means), draws)) + np.array(means)[:, None]),
        "sigma": rng.uniform(0.45, 0.55, (len(means), draws)),
    }
    return xr.DataTree.from_dict(
        {"posterior": xr.Dataset({k: (("chain", "draw"), v) for k, v in values.items()})}
    )


# -- sentences -------------------------------------------------------------------------------


@pytest.mark.long
def test_silent_when_nothing_is_wrong(tmp_path: Path) -> None:
    model, idata = sampled()
    for found in (prb.diagnose(idata), prb.diagnose(idata, model=model)):
        assert found.ok
        assert str(found).startswith("No problem was found.")
    idata.to_netcdf(tmp_path / "tree.nc")
    with xr.open_datatree(tmp_path / "tree.nc") as loaded:
        assert prb.diagnose(loaded).ok
    for seed in range(5):
        rng = np.random.default_rng(seed)
        few = normal_tree(np.zeros(4), 50)
        few["posterior"]["mu"].values[:] = 1 + 0.05 * rng.normal(size=(4, 50))
        assert prb.diagnose(few, model=model).ok


@pytest.mark.long
def test_without_a_model_the_sampler_s_own_numbers_serve() -> None:
    model, idata = sampled()
    stored, computed = prb.diagnose(idata).support, prb.diagnose(idata, model=model).support
    assert stored.sizes == computed.sizes == {"simulator": 1, "sample": 2000}
    for key in ("weight_ess", "mean_weight", "lost_mass"):
        np.testing.assert_allclose(stored[key], computed[key], rtol=1e-9)
    thin = idata.copy(deep=True)
    thin["calibration"]["weight_ess"][:] = 3.0
    (message,) = prb.diagnose(thin).messages
    assert message.startswith(
        "y: the design does not support the answer: weight effective sample size 3 (5% quantile)"
    )


def test_chains_that_disagree() -> None:
    model, _ = sampled()
    messages = prb.diagnose(normal_tree([0, 0, 0, 3]), model=model).messages
    assert messages[0].startswith("R-hat is 1.")
    assert "for mu, expected at most 1.01" in messages[0]
    assert "sigma" not in messages[0]
    assert "az.plot_rank(idata)" in messages[0]
    # A shift of a tenth of a standard deviation is seen with enough draws.
    assert prb.diagnose(normal_tree([0, 0, 0, 0.1], 100), model=model).ok
    assert not prb.diagnose(normal_tree([0, 0, 0, 0.5], 2000), model=model).ok


def test_few_independent_draws() -> None:
    model, _ = sampled()
    tree = normal_tree([0, 0])
    walk = np.random.default_rng(5).normal(size=(2, 500))
    for i in range(1, 500):
        walk[:, i] = 0.97 * walk[:, i - 1] + np.sqrt(1 - 0.97**2) * walk[:, i]
    tree["posterior"]["mu"].values[:] = 1 + 0.05 * walk
    assert "for mu of 1000 draws: too few for means and intervals" in str(
        prb.diagnose(tree, model=model)
    )


@pytest.mark.parametrize(("every", "enough"), [(3, True), (6, False)])
def test_of_few_draws_a_quarter_need_be_independent(every: int, enough: bool) -> None:
    """Draws that come three times in a row are a third as many, and six times, a sixth."""
    model, _ = sampled()
    tree = normal_tree([0, 0, 0, 0], 240)
    for name in ("mu", "sigma"):
        values = tree["posterior"][name].values
        values[:] = np.repeat(values[:, ::every], every, axis=1)
    said = "too few for means and intervals" in str(prb.diagnose(tree, model=model))
    assert said != enough


def test_particles_that_stick() -> None:
    tree = stuck().copy(deep=True)
    calibration = tree["calibration"]
    calibration["discrepancy_error"].values[:] = 1.5 * calibration["epsilon"].values
    text = str(prb.diagnose(tree))
    assert "Particles hardly moved in the last stage of chains 0, 1 (0.0" in text
    assert "The discrepancy is too noisy (its Monte Carlo error is 1.5 epsilon)" in text
    assert "R-hat is" in text
    calibration["discrepancy_error"].values[:] = 0.5 * calibration["epsilon"].values
    assert "Monte Carlo error" not in str(prb.diagnose(tree))


def test_deterministics_do_not_count_twice() -> None:
    model, _ = sampled()
    tree = normal_tree([0, 0, 0, 3])
    tree["posterior"]["twice"] = 2 * tree["posterior"]["mu"]
    assert "twice" not in str(prb.diagnose(tree, model=model))


def test_one_chain_and_hardly_any_draws_raise_nothing() -> None:
    model, _ = sampled()
    assert prb.diagnose(normal_tree([0.0]), model=model).ok
    assert prb.diagnose(normal_tree([0.0, 0.0], 3), model=model).ok
    assert prb.diagnose(prb.bootstrap(prb.minimize(model), draws=100), model=model).ok


def test_independent_draws_are_almost_never_called_dependent() -> None:
    """What `_NOISE` rests on: R-hat of independent draws exceeds the limit once in a thousand."""
    rng = np.random.default_rng(0)
    x = xr.Dataset({"x": (["chain", "draw", "set"], rng.normal(size=(4, 50, 2000)))})
    excess = 200 * (rhat(x)["x"].values - 1)
    # Two of the 2000 sets are expected; four standard errors more are eight.
    assert (excess > _NOISE).sum() <= 8
    assert (excess > _NOISE / 2).sum() >= 30, "a limit of half of it would cry wolf"


def test_a_stored_optimum_tells_what_the_optimum_does() -> None:
    model, _ = sampled()
    optimum = prb.minimize(model)
    assert prb.diagnose(optimum).ok
    assert prb.diagnose(optimum.to_datatree()).ok
    findings = (Finding("not-identified", "It is flat."), Finding("design-error", "So so."))
    search = replace(optimum.search, result=Result.FAILED, details="It stopped.")
    lost = replace(optimum, search=search, findings=findings)
    memory, stored = prb.diagnose(lost), prb.diagnose(lost.to_datatree())
    assert memory.messages == stored.messages
    assert memory.messages[:2] == ("It is flat.", "So so.")
    said = "did not converge (The minimiser failed. It stopped); try another start or method; see docs/choose.md"
    assert said in memory.messages[2]
    assert memory.support.sizes == {"simulator": 1, "sample": 1}


def test_an_edge_is_said_once() -> None:
    model, _ = sampled()
    finding = Finding("flat-edge", "mu ran to the edge.")
    optimum = prb.minimize(model)
    search = replace(optimum.search, result=Result.AT_EDGE, at_edge=("mu",))
    edge = replace(optimum, search=search, findings=(finding,))
    assert prb.diagnose(edge).findings == (finding,)


def test_the_support_is_judged_by_simulator() -> None:
    idata = sampled()[1].copy(deep=True)
    calibration = idata["calibration"].to_dataset()
    other = calibration.assign_coords(simulator=["other"])
    both = xr.concat([calibration, other], "simulator", data_vars="minimal")
    both["weight_ess"].loc[{"simulator": "other"}] = 3.0
    idata["calibration"] = both
    (message,) = prb.diagnose(idata).messages
    assert message.startswith("other: the design does not support the answer")
    none = both.assign(required_ess=("simulator", [np.nan, np.nan]))
    idata["calibration"] = none
    found = prb.diagnose(idata)
    assert found.ok
    assert found.support.sizes["simulator"] == 0


def test_a_posterior_without_a_free_variable_is_refused() -> None:
    model, _ = sampled()
    tree = normal_tree([0, 0])
    del tree["posterior"]["sigma"]
    with pytest.raises(KeyError, match=r"got no \['sigma'\]"):
        prb.diagnose(tree, model=model)


# -- numbers that reach the user -------------------------------------------------------------


def test_acceptance_and_beta_of_each_stage() -> None:
    stats = sampled()[1]["sample_stats"]
    for name in ("accept_rate", "beta", "n_steps"):
        assert stats[name].dims == ("chain", "stage")
    beta = stats["beta"].values
    last = [row[~np.isnan(row)] for row in beta]
    assert all(row[-1] == 1 and (np.diff(row) > 0).all() for row in last)


@pytest.mark.long
def test_the_evidence_is_a_plain_number_with_its_spread() -> None:
    """It is that of exp(-d / epsilon), averaged over draws from the prior."""
    model, idata = sampled_by_epsilon()
    attrs = idata["posterior"].attrs
    by_chain = idata["sample_stats"]["log_marginal_likelihood"].max("stage").values
    assert attrs["log_marginal_likelihood"] == pytest.approx(np.log(np.exp(by_chain).mean()))
    assert attrs["log_marginal_likelihood_sd"] == pytest.approx(by_chain.std(ddof=1))
    evaluator = Evaluator.of(model)
    thetas = evaluator.hyperparameters.prior_thetas(20_000, seed=9)
    logs = -evaluator(thetas).discrepancies[:, 0] / float(idata["calibration"]["epsilon"][0])
    likelihood = np.exp(logs)
    exact, error = (
        np.log(likelihood.mean()),
        likelihood.std() / likelihood.mean() / np.sqrt(likelihood.size),
    )
    spread = attrs["log_marginal_likelihood_sd"] / np.sqrt(4)
    assert attrs["log_marginal_likelihood"] == pytest.approx(exact, abs=4 * (error + spread) + 0.02)
    assert 0 < attrs["log_marginal_likelihood_sd"] < 0.3
    single = prb.sample_smc(
        50, chains=1, model=model, adjustment=None, random_seed=1, progressbar=False
    )
    assert np.isnan(single["posterior"].attrs["log_marginal_likelihood_sd"])


def test_monte_carlo_error_of_the_discrepancy_of_fresh_responses() -> None:
    evaluator = Evaluator.of(build(prb.Fresh(128), prb.KullbackLeibler()))
    theta = evaluator.hyperparameters.unconstrained({"mu": 1.1, "sigma": 0.5})[None]
    values = [float(evaluator(theta).discrepancies[0, 0]) for _ in range(100)]
    roots = evaluator.roots(theta, 0)
    errors = [discrepancy_error(evaluator.nodes[0].bound, roots) for _ in range(50)]
    # Standard errors: 7% of the spread, about 5% of the mean of the errors; the jackknife's own
    # bias is of order 1/8.
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(np.std(values, ddof=1), rel=0.45)


@pytest.mark.parametrize("propagation", [prb.Resimulated, prb.Reweighted])
def test_monte_carlo_error_of_common_points_is_a_bound(propagation: Any) -> None:
    found = []
    for n in (4096, 128):
        evaluator = Evaluator.of(build(propagation(n), prb.KullbackLeibler()))
        theta = evaluator.hyperparameters.unconstrained({"mu": 1.1, "sigma": 0.5})[None]
        error = discrepancy_error(evaluator.nodes[0].bound, evaluator.roots(theta, 0))
        found.append((float(evaluator(theta).discrepancies[0, 0]), error))
    (exact, small), (value, error) = found
    assert small < 0.2 * error
    assert abs(value - exact) < error < 0.5 * value


def test_monte_carlo_error_of_a_function_that_takes_no_weights_and_of_few_points() -> None:
    metric = prb.FunctionMetric(
        lambda simulated, observed: np.abs(simulated.mean(axis=-1) - observed.mean())
    )
    for n in (60, 8):
        evaluator = Evaluator.of(build(prb.Fresh(n), metric))
        theta = evaluator.hyperparameters.unconstrained({"mu": 3.0, "sigma": 0.5})[None]
        error = discrepancy_error(evaluator.nodes[0].bound, evaluator.roots(theta, 0))
        # The standard error of a mean; the jackknife's own is a quarter of it.
        assert np.isnan(error) if n == 8 else error == pytest.approx(0.5 / np.sqrt(60), rel=0.9)


def test_the_monte_carlo_error_is_kept_with_the_draws() -> None:
    _, idata = sampled_by_epsilon()
    assert (
        0
        < float(idata["calibration"]["discrepancy_error"][0])
        < 0.2 * float(idata["calibration"]["epsilon"][0])
    )
    noisy = stuck()["calibration"]
    assert float(noisy["discrepancy_error"][0]) > 3 * float(noisy["epsilon"][0])


# -- ArviZ -----------------------------------------------------------------------------------


@pytest.mark.parametrize("plot", ["plot_rank", "plot_trace", "plot_ess", "plot_forest"])
def test_arviz_plots_take_our_trees(plot: str, tmp_path: Path) -> None:
    _, idata = sampled()
    pc = getattr(az, plot)(idata, backend="matplotlib")
    pc.savefig(tmp_path / "figure.png")
    plt.close("all")
    assert (tmp_path / "figure.png").stat().st_size > 5000


def test_arviz_summary_has_r_hat_and_ess() -> None:
    summary = az.summary(sampled()[1])
    assert {"r_hat", "ess_bulk"} <= set(summary.columns)
    assert list(summary.index) == ["mu", "sigma"]


@pytest.mark.long
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_loo_speaks_of_one_observation() -> None:
    """A discrepancy is one value per draw, as the docs warn, and `az.loo` does not refuse it."""
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1, 1), 0.5)
        prb.Simulator(
            "y",
            same,
            x,
            metric=prb.KullbackLeibler(),
            observed=OBSERVED,
            propagation=prb.Reweighted(256),
        )
    idata = prb.sample_smc(100, chains=2, model=model, random_seed=1, progressbar=False)
    pm.compute_log_likelihood(idata, model=model, progressbar=False)
    assert idata["log_likelihood"]["y"].shape == (2, 100)
    assert az.loo(idata).n_data_points == 1


def test_few_different_draws() -> None:
    """One particle survived, and its copies were moved by roundings."""
    model, _ = sampled()
    tree = normal_tree([0.0])
    rng = np.random.default_rng(2)
    for name in ("mu", "sigma"):
        tree["posterior"][name].values[:] = 5.2 * (1 + 5e-15 * rng.normal(size=(1, 500)))
    text = str(prb.diagnose(tree, model=model))
    assert "Of 500 draws only 1 differ in chain 0, expected at least 50" in text
    # As many as that are told by the effective sample size, if it is too small.
    for name in ("mu", "sigma"):
        tree["posterior"][name].values[:] = np.repeat(rng.normal(5.2, 1e-6, (1, 100)), 5, axis=1)
    assert "differ in" not in str(prb.diagnose(tree, model=model))


def test_where_responses_are_missing_no_refinement_is_advised() -> None:
    _, idata = sampled()
    lossy = idata.copy(deep=True)
    lossy["calibration"]["lost_mass"].values[:] = 0.2
    (message,) = [m for m in prb.diagnose(lossy).messages if "lost mass" in m]
    assert "lost mass: 20.0% of a population's weight" in message
    assert "Repair the response" in message
    assert "prb.refine" not in message


# -- failures ------------------------------------------------------------------------------------


def breaks_above(limit: float) -> Any:
    def response(x: float) -> float:
        if x > limit:
            raise OSError("license server")
        return x

    return prb.scalar(response)


def failing(propagation: Any, limit: float = 1.1) -> pm.Model:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1, 1), 0.5)
        given = {"metric": prb.AreaMetric(), "observed": OBSERVED, "epsilon": 0.1}
        prb.Simulator("y", breaks_above(limit), x, propagation=propagation, **given)
    return model


REPLACED = prb.response.Replace()


@pytest.mark.parametrize(
    "propagation",
    [prb.Resimulated(64, on_failure=REPLACED), prb.Fresh(64, on_failure=REPLACED)],
    ids=lambda p: type(p).__name__,
)
def test_an_answer_that_rests_on_the_specimens_that_are_left_is_refused(propagation: Any) -> None:
    model = failing(propagation)
    lost = r"y: lost mass: got \d+\.\d% .*expected at most max_lost = 5.0%.*repair the response"
    with pytest.raises(prb.propagation.DesignError, match=lost):
        prb.minimize(model, method="Nelder-Mead", max_evaluations=30, progressbar=False)
    with pytest.raises(prb.propagation.DesignError, match=lost):
        prb.sample_smc(20, chains=1, model=model, adjustment=None, progressbar=False)


def test_more_may_be_lost_where_that_is_asked_for_and_is_reported() -> None:
    model = failing(prb.Resimulated(64, on_failure=REPLACED, max_lost=0.9))
    optimum = prb.minimize(model, method="Nelder-Mead", max_evaluations=30, progressbar=False)
    assert 0.1 < optimum.support["y"]["lost_mass"] < 0.9
    tree = prb.sample_smc(20, chains=1, model=model, adjustment=None, progressbar=False)
    assert 0.1 < tree["calibration"]["lost_mass_at_best"].item() < 0.9


@pytest.mark.parametrize("propagation", [prb.Reweighted(256), prb.Resimulated(256)])
def test_specimens_without_response_are_told_of(propagation: Any) -> None:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1, 1), 0.5)
        prb.Simulator(
            "y", lambda x: np.where(x > 2.1, np.nan, x), x,
            metric=prb.AreaMetric(), observed=OBSERVED, propagation=propagation,
        )  # fmt: skip
    optimum = prb.minimize(model, progressbar=False)
    share = optimum.support["y"]["lost_mass"]
    assert 0.001 < share < 0.05
    said = f"y: {share:.1%} of specimens have no response (NaN) and are left out"
    assert said in repr(optimum)
    assert said in optimum._repr_html_()
    tree = prb.sample_smc(
        50, chains=1, model=model, adjustment=None, random_seed=1, progressbar=False
    )
    for result in (optimum, optimum.to_datatree()):
        assert [n for n in prb.diagnose(result).notes if n.startswith(said)]
    for result, own in ((tree, None), (tree, model)):
        (note,) = [n for n in prb.diagnose(result, model=own).notes if "no response" in n]
        assert re.match(r"y: \d\.\d% of specimens have no response \(NaN\)", note)
    report = prb.Report("A", optimum=optimum, posterior=tree, pictures=False)
    texts = " ".join(text for s in report.sections for text in s.text)
    assert texts.count("have no response (NaN) and are left out") == 2


def test_draws_that_lose_too_much_are_counted_and_told() -> None:
    # The best draws lose next to nothing; those above 1, of which there are some, do.
    model = failing(prb.Resimulated(64, on_failure=REPLACED, max_lost=0.2), limit=1.6)
    tree = prb.sample_smc(
        50, chains=1, model=model, epsilon=0.5, adjustment=None, progressbar=False
    )
    calibration = tree["calibration"].to_dataset()
    lost = calibration["lost_mass"].values.ravel()
    exact = stats.norm.sf((1.6 - tree["posterior"]["mu"].values.ravel()) / 0.5)
    np.testing.assert_allclose(lost, exact, atol=0.02)
    share = np.mean(lost > 0.2)
    assert 0.05 < share < 0.5
    assert calibration["lossy_draws"].item() == share
    told = [m for m in prb.diagnose(tree).messages if "lost mass" in m]
    (message,) = told
    assert message.startswith(f"y: lost mass: of {share:.0%} of the draws more than")


@pytest.mark.parametrize(("of_draws", "refused"), [(0.4, False), (0.6, True)])
def test_an_answer_is_refused_where_most_draws_lose_too_much(
    of_draws: float, refused: bool
) -> None:
    evaluator = Evaluator.of(failing(prb.Resimulated(16, on_failure=REPLACED)))
    lost = np.where(np.arange(50) < 50 * of_draws, 0.3, 0.0).reshape(1, 50, 1)
    with nullcontext() if not refused else pytest.raises(DesignError, match=r"got 30\.0% of the"):
        _lost_findings(evaluator, lost, {})


@pytest.mark.parametrize("sampler", [prb.sample, prb.sample_smc])
@pytest.mark.parametrize(("limit", "refused"), [(0.05, False), (-0.3, True)])
def test_draws_given_the_estimate_that_lose_too_much_are_reported_or_refused(
    sampler: Any, limit: float, refused: bool
) -> None:
    center = OBSERVED.mean()

    def response(x: Any, u: Any, mu: Any) -> Any:
        near = np.abs(mu - center) < 0.02
        return np.where(u < np.where((mu > center + limit) & ~near, 0.3, 0.03), np.nan, x)

    with pm.Model() as model:
        mu = pm.Normal("mu", 1, 1)
        x, u = pm.Normal.dist(mu, 0.5), pm.Uniform.dist(0, 1)
        prb.Simulator(
            "y", response, x, u, mu,
            metric=prb.KullbackLeibler(), observed=OBSERVED, propagation=prb.Resimulated(256),
        )  # fmt: skip
    keywords = {"optimum": prb.minimize(model, progressbar=False), "progressbar": False}
    with nullcontext() if not refused else pytest.raises(DesignError, match=r"got 29\.7% of the"):
        tree = sampler(200, chains=1, model=model, **keywords)
    if refused:
        return
    calibration = tree["calibration"].to_dataset()
    lost = calibration["lost_mass"].values.ravel()
    lost = lost[~np.isnan(lost)]
    assert lost.size == 64
    share = np.mean(lost > 0.05)
    assert 0.1 < share < 0.5
    assert calibration["lossy_draws"].item() == share
    (message,) = [m for m in prb.diagnose(tree).messages if "lost mass" in m]
    assert message.startswith(f"y: lost mass: of {share:.0%} of the draws more than")


def test_failed_responses_are_part_of_results_diagnosis_and_report() -> None:
    model = failing(prb.Resimulated(32, on_failure=prb.response.Replace(np.inf)), limit=2.0)
    optimum = prb.minimize(model, method="Nelder-Mead", max_evaluations=30, progressbar=False)
    failures = optimum.failures
    assert failures.sizes["failure"] > 0
    assert (failures["inputs"].values > 2.0).all()
    assert set(failures["reason"].values) == {"it raised OSError: license server"}
    told = r"The response of y failed at \d+ point\(s\), the first at \(\d.*license server"
    share = optimum.support["y"]["failed_mass"]
    assert 0 < share < 0.2
    assert f"y: {share:.1%} of specimens fail" in repr(optimum)
    tree = prb.sample_smc(20, chains=1, model=model, adjustment=None, progressbar=False)
    assert 0 <= tree["calibration"]["failed_mass_at_best"].item() < 0.3
    for result in (optimum, optimum.to_datatree(), tree):
        (message,) = [m for m in prb.diagnose(result).messages if "failed" in m]
        assert re.search(told, message)
    report = prb.Report("A", optimum=optimum.to_datatree(), posterior=tree, pictures=False)
    (section,) = [s for s in report.sections if s.title == "Failed responses"]
    assert section.table["reason"].tolist()[0] == "it raised OSError: license server"
    assert len(section.table) <= 20


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_run_that_failed_far_from_the_answer_is_no_problem(value: float) -> None:
    policy = prb.response.Replace(value)
    for limit, ok in ((3.5, True), (1.2, False)):
        model = failing(prb.Reweighted(64, on_failure=policy, max_lost=0.5), limit=limit)
        optimum = prb.minimize(model, progressbar=False)
        assert optimum.failures.sizes["failure"] > 0
        for result in (optimum, optimum.to_datatree()):
            found = prb.diagnose(result)
            told = [line for line in found.notes if "next to no specimens there" in line]
            problems = [line for line in found.messages if "is no result" in line]
            assert (bool(told), bool(problems)) == (ok, not ok)


def test_results_without_failures_have_no_table_of_them() -> None:
    _, tree = sampled()
    assert "failures" not in tree.children


@pytest.mark.parametrize("components", [None, 1])
def test_curves_are_told_of_by_optimum_tree_and_report(
    components: int | None, tmp_path: Path
) -> None:
    at = np.linspace(0.1, 1.0, 12)

    def grown(a: Any, b: Any) -> Any:
        return np.asarray(a)[..., None] * at + np.asarray(b)[..., None] * at**3

    rng = np.random.default_rng(2)
    with pm.Model() as model:
        a = pm.Normal.dist(pm.Normal("a", 2, 0.5), 0.5)
        b = pm.Normal.dist(pm.Normal("b", 1, 0.5), 0.5)
        prb.Simulator(
            "crack", grown, a, b,
            metric=prb.Joint(prb.ProbabilityResidual(), components=components),
            observed=grown(rng.normal(2, 0.5, 30), rng.normal(1, 0.5, 30)),
            propagation=prb.Resimulated(256),
        )  # fmt: skip
    optimum = prb.minimize(model, starts=0)
    tree = optimum.to_datatree()
    note = f"crack: 12 outputs are compared by {components or 2} principal component(s)"
    for result in (optimum, tree):
        found = prb.diagnose(result)
        assert any(line.startswith(note) for line in found.notes)
        assert any("no noise" in line for line in found.messages) == (components == 1)
    assert (
        note
        in prb.Report("Cracks", optimum=optimum, pictures=False)
        .to_markdown(tmp_path / "r.md")
        .read_text()
    )
