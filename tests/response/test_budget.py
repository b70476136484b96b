"""Budgets of time, responses and stages: nothing new is begun, and the same call goes on later."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm
import pytest
import xarray as xr
from line_problem import build, line

import prbayes as prb
from prbayes.response import BudgetError
from prbayes.response.budget import budget, limited, unlimited

QUIET: dict[str, Any] = {"progressbar": False}


class Counted:
    """A response that counts for how many specimens it was called, and may take its time."""

    def __init__(self, seconds: float = 0.0) -> None:
        self.calls = 0
        self.seconds = seconds

    def __call__(self, x: float) -> float:
        self.calls += 1
        time.sleep(self.seconds)
        return float(line(x))


# -- what a budget is ------------------------------------------------------------------------------


def test_responses_are_granted_as_long_as_there_are_some() -> None:
    assert budget().grant(10**9, least=10**9) == 10**9
    with limited(None, 10):
        assert budget().grant(6, least=1) == 6
        assert budget().grant(6, least=1) == 4
        with pytest.raises(BudgetError, match="max_runs = 10 was reached"):
            budget().grant(1, least=1)
        # What was spent stays spent.
        with pytest.raises(BudgetError):
            budget().check()
        with unlimited():
            budget().check()
    assert budget().grant(1, least=1) == 1
    with limited(None, 10), pytest.raises(BudgetError):
        budget().grant(11, least=11)
    with limited(0.001, None):
        time.sleep(0.002)
        with pytest.raises(BudgetError, match=r"max_seconds = 0\.001 was reached"):
            budget().check()
    # A budget holds in its own thread.
    with limited(None, 1), ThreadPoolExecutor(1) as other:
        assert other.submit(lambda: budget().grant(5, least=5)).result() == 5


# -- minimize --------------------------------------------------------------------------------------


def found(store: Path, response: Any = None, **limits: Any) -> prb.Optimum:
    propagation = prb.Resimulated(16, store=store, version="1")
    model, _ = build(propagation, response or prb.scalar(Counted()))
    return prb.minimize(model, tolerance=1e-2, max_evaluations=25, **limits, **QUIET)


def test_minimize_goes_on_to_the_same_bits(tmp_path: Path) -> None:
    at_once = found(tmp_path / "at_once")
    response = Counted()
    total = 0
    for most in (100, 150):
        optimum = found(tmp_path / "parts", prb.scalar(response), max_runs=most)
        assert optimum.search.stopped == f"max_runs = {most} was reached"
        assert not optimum.converged
        assert np.isfinite(optimum.discrepancy)
        assert np.isnan(optimum.covariance).all()
        # Those at which the response is tried, at the first use in `build`, are 16 and 3 again.
        total += most + (16 + 3 if total == 0 else 0)
        assert response.calls == total
        (message,) = prb.diagnose(optimum).messages
        assert "is not an optimum" in message
        assert str(tmp_path) in message
        assert optimum.to_datatree()["optimum"].attrs["stopped"] == optimum.search.stopped
    # A budget that is large enough changes nothing.
    optimum = found(tmp_path / "parts", max_seconds=1e6, max_runs=at_once.n_responses)
    assert not optimum.search.stopped
    assert np.array_equal(optimum.theta, at_once.theta)
    assert np.array_equal(optimum.covariance, at_once.covariance)
    assert optimum.message == at_once.message


def test_minimize_stops_in_time(tmp_path: Path) -> None:
    # A theta takes 0.16 s, a chunk a hundredth.
    response = Counted(0.01)
    with pytest.raises(BudgetError, match=r"max_seconds = 0\.1 was reached"):
        found(tmp_path, prb.scalar(response), max_seconds=0.1)
    # Those of the first use come before.
    assert response.calls <= 16 + 3 + 11


def test_with_stored_responses_the_best_so_far_is_complete() -> None:
    model, node = build(prb.Reweighted(16), prb.scalar(Counted()))
    optimum = prb.minimize(model, max_runs=10, **QUIET)
    assert optimum.search.stopped == "max_runs = 10 was reached"
    assert not optimum.converged
    assert optimum.discrepancy == pytest.approx(optimum.discrepancies["y"])
    assert optimum.search.support["y"]["weight_ess"] > 1
    assert node.bound.n_points == 16


# -- refine ----------------------------------------------------------------------------------------

FAR = np.array([[4.0, 0.0]])


def test_refine_goes_on_with_the_design_that_has_grown() -> None:
    whole, node = build(prb.Reweighted(16))
    prb.refine(whole, thetas=FAR, **QUIET)
    parts, other = build(prb.Reweighted(16))
    expected = r"prb\.refine: max_runs = 20 was reached .*the model's designs"
    with pytest.raises(BudgetError, match=expected):
        prb.refine(parts, thetas=FAR, max_runs=20, **QUIET)
    assert other.bound.n_points == 32 < node.bound.n_points
    with pytest.raises(BudgetError, match="max_runs = 1 was reached"):
        prb.refine(parts, max_runs=1, **QUIET)  # around an optimum
    prb.refine(parts, thetas=FAR, **QUIET)
    assert np.array_equal(other.bound.design.runs.values, node.bound.design.runs.values)


# -- sample_smc ------------------------------------------------------------------------------------


def sampled(model: pm.Model, checkpoint: Path | None = None, **limits: Any) -> xr.DataTree:
    settings = {"checkpoint": checkpoint, "random_seed": 1, **limits, **QUIET}
    return prb.sample_smc(30, chains=2, model=model, adjustment=None, **settings)


def black_box(x: Any) -> Any:
    return 0.75 * np.asarray(x, dtype=np.float64)


def require_same_draws(a: xr.DataTree, b: xr.DataTree) -> None:
    for group in ("posterior", "sample_stats", "calibration"):
        left, right = a[group].to_dataset(), b[group].to_dataset()
        for variable in left.data_vars:
            xr.testing.assert_equal(left[variable], right[variable])


@pytest.mark.long
def test_stages_are_limited_and_go_on(tmp_path: Path) -> None:
    path = tmp_path / "run.nc"
    model, _ = build(prb.Reweighted(64), black_box)
    for most in (1, 2):
        with pytest.raises(BudgetError, match=rf"max_stages = {most} was .*beta 0.*run\.nc"):
            sampled(model, path, max_stages=most)
    # On the same model: a design that had grown is what it was.
    whole = sampled(build(prb.Reweighted(64), black_box)[0])
    require_same_draws(sampled(model, path), whole)


@pytest.mark.long
def test_finished_chains_are_returned_and_the_rest_goes_on(tmp_path: Path) -> None:
    path = tmp_path / "run.nc"
    models = [build(prb.Fresh(16), black_box)[0] for _ in range(3)]
    whole = sampled(models[0])
    most = 3 * whole["posterior"].attrs["n_responses"] // 4
    part = sampled(models[1], path, max_runs=most)
    attrs = part["posterior"].attrs
    assert attrs["n_responses"] <= most
    assert attrs["stopped"] == f"max_runs = {most} was reached in chain 2 of 2"
    assert dict(part["posterior"].sizes) == {"chain": 1, "draw": 30}
    assert any("1 of 2 chains are finished" in line for line in prb.diagnose(part).messages)
    assert np.array_equal(part["posterior"]["mu"].values, whole["posterior"]["mu"].values[:1])
    assert np.isnan(part["calibration"]["discrepancy_error"]).all()
    require_same_draws(sampled(models[2], path), whole)


def test_a_design_that_grew_for_nothing_is_what_it_was_and_nothing_is_computed_twice() -> None:
    response = Counted()
    model, node = build(prb.Reweighted(16), prb.scalar(response))
    keywords: dict[str, Any] = {"model": model, "chains": 1, "adjustment": None} | QUIET
    before = response.calls
    with pytest.raises(BudgetError, match=r"prb\.sample_smc: max_runs = 20 was reached"):
        prb.sample_smc(30, max_runs=20, **keywords)
    assert node.bound.n_points == 16
    assert response.calls == before + 20
    posterior = prb.sample_smc(30, **keywords)["posterior"]
    # A batch that was broken off is lost without a store.
    assert response.calls == before + node.bound.n_points - 16 + 4
    other, _ = build(prb.Reweighted(16), prb.scalar(Counted()))
    at_once = prb.sample_smc(30, **keywords | {"model": other})["posterior"]
    xr.testing.assert_equal(posterior.to_dataset(), at_once.to_dataset())
    assert posterior.attrs["n_responses"] == at_once.attrs["n_responses"]


@pytest.mark.long
def test_chains_that_finish_on_a_design_that_grew_are_returned_and_the_rest_goes_on(
    tmp_path: Path,
) -> None:
    def drawn(model: pm.Model, **limits: Any) -> xr.DataTree:
        return prb.sample_smc(30, chains=2, model=model, random_seed=10, **limits, **QUIET)

    def made() -> Any:
        return build(prb.Reweighted(16), black_box, metric=prb.KullbackLeibler())

    model, node = made()
    path = tmp_path / "run.nc"
    part = drawn(model, checkpoint=path, max_stages=3)
    assert part["posterior"].attrs["stopped"].endswith("in chain 2 of 2")
    assert (part["posterior"].sizes["chain"], node.bound.n_points) == (1, 16)
    rest = drawn(model, checkpoint=path)
    assert node.bound.n_points > 16
    xr.testing.assert_equal(rest["posterior"]["mu"], drawn(made()[0])["posterior"]["mu"])
    np.testing.assert_array_equal(part["posterior"]["mu"], rest["posterior"]["mu"][:1])


def test_no_answer_of_the_sampler_is_an_error() -> None:
    model, _ = build(prb.Resimulated(16), black_box, epsilon=None)
    for limits, spent in (({"max_runs": 50}, "max_runs = 50"), ({"max_seconds": 1e-6}, "max_sec")):
        # The optimum within is not taken for an answer.
        with pytest.raises(BudgetError, match=rf"prb\.sample_smc: {spent}.* was reached"):
            prb.sample_smc(30, model=model, adjustment=None, **limits, **QUIET)
