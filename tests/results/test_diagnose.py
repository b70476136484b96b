"""Diagnostics of results: findings of samplers and optimisers, of designs, and of failed responses."""

import re
from contextlib import nullcontext
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm
import pytest
import xarray as xr
from arviz_stats import rhat
from one_input import one_input, posterior_of

import prbayes as prb
from prbayes._finding import Finding
from prbayes.model.evaluator import Evaluator
from prbayes.optimize.convergence import Result
from prbayes.posterior.results import Chains
from prbayes.posterior.smc import _lost_findings
from prbayes.propagation.base import DesignError
from prbayes.results.diagnose import _NOISE, _each_once, _failure_findings

OBSERVED = np.random.default_rng(1).normal(1.0, 0.5, 40)
AREA, KL = prb.AreaMetric(), prb.KullbackLeibler()
QUIET: dict[str, Any] = {"progressbar": False}


def build(metric: Any = AREA) -> pm.Model:
    return one_input(OBSERVED, metric, prb.Reweighted(256), mu=(1, 1))


@cache
def optimum() -> prb.Optimum:
    return prb.minimize(build(), starts=0, **QUIET)


@cache
def sampled() -> tuple[pm.Model, xr.DataTree]:
    model = optimum().model
    settings = {"model": model, "optimum": optimum(), "random_seed": 1, **QUIET}
    return model, prb.sample_smc(200, chains=2, **settings)


def normal_tree(means: Any, draws: int = 500) -> xr.DataTree:
    """Return draws of chains with given means."""
    rng = np.random.default_rng(3)
    mu = 1 + 0.05 * (rng.normal(size=(len(means), draws)) + np.array(means)[:, None])
    return posterior_of(mu=mu, sigma=rng.uniform(0.45, 0.55, (len(means), draws)))


def codes(result: Any, model: pm.Model | None = None) -> list[str]:
    return [finding.code for finding in prb.diagnose(result, model=model).findings]


# -- samplers


@pytest.mark.long
def test_results_without_a_problem(tmp_path: Path) -> None:
    model, idata = sampled()
    for diagnosis in (prb.diagnose(idata), prb.diagnose(idata, model=model)):
        assert diagnosis.ok
        assert str(diagnosis).startswith("No problem was found by the tests that were run.")
    idata.to_netcdf(tmp_path / "tree.nc")
    with xr.open_datatree(tmp_path / "tree.nc") as loaded:
        assert prb.diagnose(loaded).ok
    # The bootstrap of 40 specimens has narrow intervals, and no other problem.
    assert codes(prb.bootstrap(optimum(), draws=100), model) == ["few-for-bootstrap"]


def test_chains_that_disagree() -> None:
    model = optimum().model
    tree = normal_tree([0, 0, 0, 3])
    tree["posterior"]["twice"] = 2 * tree["posterior"]["mu"]
    message = prb.diagnose(tree, model=model).messages[0]
    assert message.startswith("R-hat is 1.")
    assert "for mu, expected at most 1.01" in message
    assert "sigma" not in message
    assert "twice" not in message  # deterministics do not count twice
    # A shift of half a standard deviation is found with enough draws.
    assert "chains-disagree" in codes(normal_tree([0, 0, 0, 0.5], 2000), model)
    # Few chains or draws have no findings.
    for means, draws in (([0, 0, 0, 0.1], 100), ([0.0], 500), ([0.0, 0.0], 3), ([0.0] * 4, 50)):
        assert codes(normal_tree(means, draws), model) == ["width-of-epsilon"]
    del tree["posterior"]["sigma"]
    with pytest.raises(KeyError, match=r"got a result without \['sigma'\]"):
        prb.diagnose(tree, model=model)


def test_r_hat_of_independent_draws_is_below_the_limit() -> None:
    """It exceeds the limit once in a thousand cases, and half of the excess often."""
    rng = np.random.default_rng(0)
    x = xr.Dataset({"x": (["chain", "draw", "set"], rng.normal(size=(4, 50, 1000)))})
    excess = 200 * (rhat(x)["x"].values - 1)
    # One of the 1000 sets is expected; four standard errors more are five.
    assert (excess > _NOISE).sum() <= 5
    assert (excess > _NOISE / 2).sum() >= 15


def test_few_different_or_independent_draws() -> None:
    model, tree = optimum().model, normal_tree([0.0])
    rng = np.random.default_rng(2)
    draws = [tree["posterior"][name].values for name in ("mu", "sigma")]
    for values in draws:  # one particle survived, and its copies were moved by roundings
        values[:] = 5.2 * (1 + 5e-15 * rng.normal(size=(1, 500)))
    text = str(prb.diagnose(tree, model=model))
    assert "Of 500 draws only 1 differ in chain 0, expected at least 50" in text
    for values in draws:
        values[:] = np.repeat(rng.normal(5.2, 1e-6, (1, 100)), 5, axis=1)
    assert "repeated-draws" not in codes(tree, model)
    # A quarter of few draws needs to be independent.
    for every, is_enough in ((3, True), (6, False)):
        tree = normal_tree([0, 0, 0, 0], 240)
        for values in (tree["posterior"][name].values for name in ("mu", "sigma")):
            values[:] = np.repeat(values[:, ::every], every, axis=1)
        assert ("few-independent-draws" in codes(tree, model)) != is_enough


@pytest.mark.parametrize(("noise", "is_reason"), [(1.5, True), (0.5, False)])
def test_particles_that_stick(noise: float, is_reason: bool) -> None:
    tree = sampled()[1].copy(deep=True)
    assert "Particles" not in str(prb.diagnose(tree))
    tree["sample_stats"]["accept_rate"].values[:] *= 1e-3
    tree["posterior"].attrs["sampler"] = "SMC-ABC"
    calibration = tree["calibration"]
    calibration["epsilon"] = xr.DataArray([0.2], dims="simulator")
    calibration["discrepancy_error"] = noise * calibration["epsilon"]
    text = str(prb.diagnose(tree))
    assert "Particles hardly moved in the last stage of chains 0, 1 (0.0" in text
    reason = f"The discrepancy is too noisy (its Monte Carlo error is {noise} epsilon)"
    assert (reason in text) == is_reason


# -- optima


def test_a_stored_optimum_has_the_findings_of_the_optimum() -> None:
    assert prb.diagnose(optimum()).ok
    assert prb.diagnose(optimum().to_datatree()).ok
    findings = (Finding("not-identified", "It is flat."), Finding("design-error", "So so."))
    search = replace(optimum().search, result=Result.FAILED, details="It stopped.")
    failed = replace(optimum(), search=search, findings=findings)
    diagnosis = prb.diagnose(failed)
    assert diagnosis.messages == prb.diagnose(failed.to_datatree()).messages
    assert diagnosis.messages[:2] == ("It is flat.", "So so.")
    assert "did not converge (The minimiser failed. It stopped)" in diagnosis.messages[2]
    assert diagnosis.support.sizes == {"simulator": 1, "sample": 1}
    # An edge is reported once.
    edge_finding = Finding("flat-edge", "mu reached the edge.")
    search = replace(optimum().search, result=Result.AT_EDGE, at_edge=("mu",))
    edge = replace(optimum(), search=search, findings=(edge_finding,))
    for result in (edge, edge.to_datatree()):
        assert prb.diagnose(result).findings == (edge_finding,)


# -- designs


def test_support_is_that_of_the_sampler() -> None:
    model, idata = sampled()
    support, computed = prb.diagnose(idata).support, prb.diagnose(idata, model=model).support
    assert support.sizes == computed.sizes == {"simulator": 1, "sample": 400}
    again = Evaluator.of(model).support(idata["calibration"]["theta"].values.reshape(-1, 2))["y"]
    for key in ("weight_ess", "mean_weight", "lost_mass"):
        np.testing.assert_allclose(support[key][0], again[key], rtol=1e-9)


def test_support_is_judged_by_simulator() -> None:
    idata = sampled()[1].copy(deep=True)
    calibration = idata["calibration"].to_dataset()
    other = calibration.assign_coords(simulator=["other"])
    both = xr.concat([calibration, other], "simulator", data_vars="minimal")
    both["weight_ess"].loc[{"simulator": "other"}] = 3.0
    idata["calibration"] = both
    (message,) = prb.diagnose(idata).messages
    assert message.startswith("other: the design does not support the answer: weight effective")
    idata["calibration"] = both.assign(required_ess=("simulator", [np.nan, np.nan]))
    diagnosis = prb.diagnose(idata)
    assert diagnosis.ok
    assert diagnosis.support.sizes["simulator"] == 0
    # No refinement is advised where responses are missing.
    idata["calibration"] = calibration
    idata["calibration"]["lost_mass"].values[:] = 0.2
    (message,) = [m for m in prb.diagnose(idata).messages if "lost mass" in m]
    assert "lost mass: 20.0% of a population's weight" in message
    assert "Repair the response" in message
    assert "prb.refine" not in message


# -- failures


def one_mean(propagation: Any, response: Any, **keywords: Any) -> pm.Model:
    settings = {"observed": OBSERVED, "metric": AREA} | keywords
    return one_input(propagation=propagation, response=response, mu=(1, 1), sd=0.5, **settings)


def breaks_above(limit: float) -> Any:
    def response(x: float) -> float:
        if x > limit:
            raise OSError("license server")
        return x

    return prb.scalar(response)


def replaced(propagation: Any, n: int, value: float = np.nan, **keywords: Any) -> Any:
    return propagation(n, on_failure=prb.response.Replace(value), **keywords)


FEW = {"method": "Nelder-Mead", "max_evaluations": 30, **QUIET}


@pytest.mark.parametrize("propagation", [prb.Resimulated, prb.Fresh])
def test_an_answer_of_few_specimens_is_refused(propagation: Any) -> None:
    model = one_mean(propagation(64), lambda x: np.where(x > 1.1, np.nan, x), epsilon=0.1)
    lost = r"y: lost mass: got \d+\.\d% .*expected at most max_lost = 5.0%.*repair the response"
    with pytest.raises(DesignError, match=lost):
        prb.minimize(model, **FEW)
    with pytest.raises(DesignError, match=lost):
        prb.sample_smc(20, chains=1, model=model, adjustment=None, **QUIET)


@pytest.mark.parametrize("propagation", [prb.Reweighted(128), prb.Resimulated(128)])
def test_specimens_without_response_are_reported(propagation: Any) -> None:
    model = one_mean(propagation, lambda x: np.where(x > 2.1, np.nan, x))
    best = prb.minimize(model, starts=0, **QUIET)
    share = best.search.support["y"]["lost_mass"]
    assert 0.001 < share < 0.05
    text = f"y: {share:.1%} of specimens have no response (NaN) and are left out"
    assert text in repr(best)
    settings = {"adjustment": None, "optimum": best, "random_seed": 1, **QUIET}
    tree = prb.sample_smc(20, chains=1, model=model, **settings)
    for result in (best, best.to_datatree()):
        assert [note for note in prb.diagnose(result).notes if note.startswith(text)]
    for given in (None, model):
        (note,) = [n for n in prb.diagnose(tree, model=given).notes if "no response" in n]
        assert re.match(r"y: \d\.\d% of specimens have no response \(NaN\)", note)
    report = prb.Report("A", optimum=best, posterior=tree, pictures=False)
    texts = " ".join(text for section in report.sections for text in section.text)
    assert texts.count("have no response (NaN) and are left out") == 2


@pytest.mark.parametrize(("of_draws", "is_refused"), [(0.4, False), (0.6, True)])
def test_an_answer_is_refused_if_most_draws_lose_too_much(
    of_draws: float, is_refused: bool
) -> None:
    model = one_mean(prb.Resimulated(16), np.positive, epsilon=0.1)
    lost = np.where(np.arange(50) < 50 * of_draws, 0.3, 0.0).reshape(1, 50, 1)
    with pytest.raises(DesignError, match=r"got 30\.0% of the") if is_refused else nullcontext():
        chains = Chains(np.zeros((1, 50, 1)), {}, xr.Dataset(), lost=lost)
        (finding,) = _lost_findings(Evaluator.of(model), chains)
        assert "y: lost mass: in 40% of the draws more than max_lost = 5.0%" in finding.text


@pytest.mark.parametrize(("sampler", "limit"), [(prb.sample, -0.3), (prb.sample_smc, 0.05)])
def test_draws_given_the_estimate_lose_responses(sampler: Any, limit: float) -> None:
    center = OBSERVED.mean()

    def response(x: Any, u: Any, mu: Any) -> Any:
        near = np.abs(mu - center) < 0.02
        return np.where(u < np.where((mu > center + limit) & ~near, 0.3, 0.03), np.nan, x)

    with pm.Model() as model:
        mu = pm.Normal("mu", 1, 1)
        inputs = pm.Normal.dist(mu, 0.5), pm.Uniform.dist(0, 1), mu
        propagation = prb.Resimulated(256)
        prb.Simulator("y", response, *inputs, metric=KL, observed=OBSERVED, propagation=propagation)
    settings = {"model": model, "optimum": prb.minimize(model, starts=0, **QUIET), **QUIET}
    if limit < 0:
        with pytest.raises(DesignError, match=r"got 29\.7% of the"):
            sampler(100, chains=1, **settings)
        return
    tree = sampler(100, chains=1, **settings)
    calibration = tree["calibration"].to_dataset()
    lost = calibration["lost_mass"].values.ravel()
    assert (~np.isnan(lost)).sum() == 64
    share = np.mean(lost[~np.isnan(lost)] > 0.05)
    assert 0.1 < share < 0.5
    assert calibration["lossy_draws"].item() == share
    assert f"y: lost mass: in {share:.0%} of the draws more than" in str(prb.diagnose(tree))


def test_failed_responses_are_part_of_results_diagnosis_and_report() -> None:
    model = one_mean(replaced(prb.Resimulated, 32, np.inf), breaks_above(2.0), epsilon=0.1)
    best = prb.minimize(model, **FEW)
    failures = best.failures
    assert failures.sizes["failure"] > 0
    assert (failures["inputs"].values > 2.0).all()
    assert set(failures["reason"].values) == {"it raised OSError: license server"}
    share = best.search.support["y"]["failed_mass"]
    assert 0 < share < 0.2
    assert f"y: {share:.1%} of specimens fail" in repr(best)
    tree = prb.sample_smc(20, chains=1, model=model, adjustment=None, **QUIET)
    assert 0 <= tree["calibration"]["failed_mass_at_best"].item() < 0.3
    text = r"y: the response failed at \d+ points?, the first at \(\d.*license server"
    for result in (best, best.to_datatree(), tree):
        (message,) = [m for m in prb.diagnose(result).messages if "failed" in m]
        assert re.search(text, message)
    report = prb.Report("A", optimum=best.to_datatree(), posterior=tree, pictures=False)
    (section,) = [s for s in report.sections if s.title == "Failed responses"]
    assert section.table["reason"].tolist()[0] == "it raised OSError: license server"
    assert len(section.table) <= 20


@pytest.mark.parametrize("value", [np.nan, np.inf, 0.0])
@pytest.mark.parametrize("share", [1e-6, 0.2])
def test_failures_far_from_the_answer_are_harmless(value: float, share: float) -> None:
    failures = xr.Dataset(
        {
            "simulator": ("failure", ["y", "y"]),
            "inputs": (["failure", "input"], [[3.5, np.nan], [4.0, 1.0]]),
            "reason": ("failure", ["it broke", "it broke"]),
            "instead": ("failure", [value, value]),
        }
    )
    tree = xr.DataTree.from_dict({"failures": failures})
    lost = {"y": share if np.isnan(value) else 0.0}
    failed = ("simulator", [share if value == np.inf else 0.0])
    calibration = xr.Dataset({"failed_mass": failed}, coords={"simulator": ["y"]})
    findings, harmless = _failure_findings(tree, calibration, lost)
    # A finite number in place of a failed response looks like any other.
    expected = ([], ["harmless-failures"]) if share < 0.1 and value else (["failed-responses"], [])
    assert ([f.code for f in findings], [f.code for f in harmless]) == expected
    text = "y: the response failed at 2 points, the first at (3.5): it broke; "
    assert str([*findings, *harmless][0]).startswith(text)


@pytest.mark.long
@pytest.mark.parametrize(
    ("metric", "limit", "is_harmless"), [(AREA, 3.5, True), (None, 3.5, True), (None, 2.25, False)]
)
def test_a_harmless_failure_is_a_remark(metric: Any, limit: float, is_harmless: bool) -> None:
    propagation = replaced(prb.Reweighted, 64)
    model = one_mean(propagation, breaks_above(limit), metric=metric)
    best = prb.minimize(model, starts=0, **QUIET)
    assert best.failures.sizes["failure"] > 0
    draws = prb.sample(100, chains=2, model=model, optimum=best, random_seed=1, **QUIET)
    for result in (best, best.to_datatree(), draws):
        diagnosis = prb.diagnose(result)
        remarks = [remark.code for remark in diagnosis.remarks]
        assert ("harmless-failures" in remarks) == is_harmless
        assert ("failed-responses" in codes(result)) == (not is_harmless)


def test_components_of_curves_are_reported() -> None:
    at = np.linspace(0.1, 1.0, 12)

    def grown(a: Any, b: Any) -> Any:
        return np.asarray(a)[..., None] * at + np.asarray(b)[..., None] * at**3

    observed = grown(*np.random.default_rng(2).normal([[2], [1]], 0.5, (2, 30)))
    with pm.Model() as model:
        inputs = [pm.Normal.dist(pm.Normal(name, m, 0.5), 0.5) for name, m in (("a", 2), ("b", 1))]
        given: dict[str, Any] = {"observed": observed, "propagation": prb.Resimulated(64)}
        given["metric"] = prb.Joint(prb.ProbabilityResidual(), components=1)
        prb.Simulator("crack", grown, *inputs, **given)
    best = prb.minimize(model, starts=0)
    note = "crack: 12 outputs are compared by 1 principal component"
    for result in (best, best.to_datatree()):
        diagnosis = prb.diagnose(result)
        assert any(line.startswith(note) for line in diagnosis.notes)
        assert any("not noise" in line for line in diagnosis.messages)
    report = prb.Report("Cracks", optimum=best, pictures=False)
    assert any(note in text for section in report.sections for text in section.text)


def test_each_finding_is_shown_once() -> None:
    first, again = (Finding("failed-responses", f"y: {text}.") for text in ("5%", "at 3 points"))
    others = [Finding("failed-responses", "z: at 2 points."), Finding("output-misfit", "y: a.")]
    assert _each_once([first, first], [again, *others, others[0]]) == (first, *others)
    assert _each_once([], [again]) == (again,)
