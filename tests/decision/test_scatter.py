"""Shares of inputs: emulated, called, and on a line."""

from functools import cache
from typing import Any

import numpy as np
import pymc as pm
import pytest

import prbayes as prb
from prbayes.decision import scatter as module
from prbayes.decision.populations import Populations
from prbayes.decision.scatter import scatter


def ishigami(a: Any, b: Any, c: Any, d: Any) -> Any:
    return np.sin(a) + 7 * np.sin(b) ** 2 + 0.1 * c**4 * np.sin(a) + d


def bounds(a: Any, b: Any, c: Any, d: Any) -> Any:
    return a + 2 * d


VARIANCE = 49 / 8 + 0.1 * np.pi**4 / 5 + 0.01 * np.pi**8 / 18 + 0.5 + 1
FIRST = np.array([0.5 * (1 + 0.1 * np.pi**4 / 5) ** 2, 49 / 8, 0.0, 1.0]) / VARIANCE
TOTAL = FIRST + 0.01 * np.pi**8 * (1 / 18 - 1 / 50) / VARIANCE * np.array([1, 0, 1, 0])


@cache
def problem(emulator: str | None = "auto", n: int = 256) -> tuple[prb.Optimum, list[Any]]:
    rng = np.random.default_rng(1)
    with pm.Model() as model:
        inputs = [pm.Uniform.dist(-np.pi, np.pi) for _ in range(3)]
        inputs.append(pm.Normal.dist(pm.Normal("mu", 0, 1), 1.0))
        data = ishigami(*rng.uniform(-np.pi, np.pi, (3, 200)), rng.normal(0, 1, 200))
        prb.Simulator(
            *("y", ishigami, *inputs),
            metric=prb.ProbabilityResidual(),
            observed=data,
            propagation=prb.Reweighted(n, emulator=emulator),
        )
    return prb.minimize(model, refine=False, starts=0, progressbar=False), inputs


@pytest.mark.slow
def test_two_inputs_that_act_together_emulated_and_called() -> None:
    def together(a: Any, b: Any) -> Any:
        return a + b + a * b

    with pm.Model() as model:
        a = pm.Normal.dist(pm.Normal("mu", 0, 1), 1.0)
        b = pm.Normal.dist(0.0, 1.0)
        z = np.random.default_rng(1).normal(size=(2, 100))
        prb.Simulator(
            *("y", together, a, b),
            metric=prb.ProbabilityResidual(),
            observed=together(*z),
            propagation=prb.Reweighted(64),
        )
    optimum = prb.minimize(model, starts=0, progressbar=False)
    # mu + a + (1 + mu) b + a b, with a and b standard normal.
    slope = 1 + float(optimum.point["mu"])
    alone = np.array([1.0, slope**2])
    for computed in (False, True):
        quantity = prb.decision.Mean(together, a, b)
        table = prb.sensitivity(optimum, quantity, n_samples=512, computed=computed)
        own = table.sel(factor=["a", "b"])
        for key, part in (("first", alone), ("total", alone + 1)):
            off = np.abs(own[key] - part / (alone.sum() + 1))
            assert (off < 5 * own[f"{key}_error"]).all()
            assert (own[f"{key}_error"] < 0.05).all()
        assert (table.attrs["responses"] > 0) == computed


@pytest.mark.slow
def test_ishigami_emulated_from_few_runs_and_called() -> None:
    optimum, inputs = problem()
    quantity = prb.decision.Mean(ishigami, *inputs)
    for computed in (False, True):
        table = prb.sensitivity(optimum, quantity, computed=computed)
        own = table.sel(factor=list("abcd"))
        for key, expected in (("first", FIRST), ("total", TOTAL)):
            off = np.abs(own[key] - expected)
            assert (off < 5 * own[f"{key}_error"]).all()
            assert (own[f"{key}_error"] < 0.03).all()
        assert (own.derivative > own.total - 0.02).all()
        assert (table.attrs["responses"] > 0) == computed


@pytest.mark.slow
def test_derivatives_bound_a_linear_response_as_tightly_as_they_can() -> None:
    optimum, inputs = problem()
    quantity = prb.decision.Mean(bounds, *inputs)
    own = prb.sensitivity(optimum, quantity, computed=True).sel(factor=list("abcd"))
    # a is uniform: 2 pi times the distribution function of z, whose squared derivative has the
    # mean 1 / (2 pi sqrt(3)).
    shares = np.array([np.pi**2 / 3, 0, 0, 4.0])
    np.testing.assert_allclose(own["total"], shares / shares.sum(), atol=0.01)
    np.testing.assert_allclose(own.derivative[3], own["total"][3], atol=0.01)
    np.testing.assert_allclose(own.derivative[0], 2 * np.pi / np.sqrt(3) / shares.sum(), atol=0.01)
    np.testing.assert_allclose(own.derivative[1:3], 0, atol=1e-12)


@pytest.mark.slow
def test_without_an_emulator_nothing_tells_what_is_between_the_runs() -> None:
    optimum, inputs = problem(None, 4096)
    quantity = prb.decision.Mean(ishigami, *inputs)
    table = prb.sensitivity(optimum, quantity, n_samples=64)
    assert np.isnan(table["first"].sel(factor="a"))
    assert "computed=True" in table.attrs["inputs"]


def test_where_the_nearest_run_failed_a_line_ends() -> None:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 1), 1.0)
        observed = np.random.default_rng(1).normal(0, 1, 40)
        prb.Simulator("y", np.sinh, x, metric=prb.AreaMetric(), observed=observed)
    optimum = prb.minimize(model, progressbar=False)
    broken = prb.decision.Exceedance(lambda x: np.where(x > 1, np.inf, x), x, limit=1.0)
    populations = Populations.of(optimum, None, 50, "prb.sensitivity")
    told = populations.told(broken.response, broken.inputs, None)
    found = scatter(told, broken, 64, 0, computed=False)
    assert found.indices.total == pytest.approx(1.0, abs=0.15)


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_the_step_does_not_matter(factor: float, monkeypatch: pytest.MonkeyPatch) -> None:
    optimum, inputs = problem()
    quantity = prb.decision.Mean(ishigami, *inputs)
    before = prb.sensitivity(optimum, quantity, n_samples=64, computed=True)
    monkeypatch.setattr(module, "_SCORE_STEP", factor * module._SCORE_STEP)
    after = prb.sensitivity(optimum, quantity, n_samples=64, computed=True)
    np.testing.assert_allclose(after.derivative[1:], before.derivative[1:], rtol=0.01)
