"""What is said of an optimum, and when two populations differ."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pymc as pm
import pytest
from scipy.stats import norm

import prbayes as prb
from prbayes.model.evaluator import Evaluator
from prbayes.optimize.caveats import between_runs, breakdown, caveats, elements_at_edge
from prbayes.propagation.importance import SIZES


def test_what_breaks_down_is_said_by_name_and_only_then() -> None:
    assert breakdown((), ()) == []
    (finding,) = breakdown(("sigma", "tau"), ())
    assert finding.text.startswith("sigma, tau ran to the edge of the support")
    (finding,) = breakdown((), ("y",))
    assert finding.text.startswith("y: points lose their response at the optimum")
    assert len(breakdown(("sigma",), ("y",))) == 2


@pytest.mark.parametrize(("clouds", "told"), [
    ([None], "pass a larger n or max_points to prb.Reweighted (now 300 runs)"),
    ([16384], "pass a larger n"),
    ([SIZES.largest, None], "pass a larger n"),
    ([SIZES.largest, SIZES.largest], "between its 300 runs are 65536 emulated points, the most"),
])  # fmt: skip
def test_no_larger_design_is_asked_for_where_points_cost_nothing(
    clouds: list[int | None], told: str
) -> None:
    of = [None if size is None else range(size) for size in clouds]
    designs = {
        f"y{k}": SimpleNamespace(design=SimpleNamespace(n_runs=300, emulated=cloud))
        for k, cloud in enumerate(of)
    }
    evaluator: Any = SimpleNamespace(nodes=(), reweighted=designs)
    (finding,) = caveats(evaluator, None, (), 0.4)
    assert "by about 0.40 standard errors, expected at most 0.1" in finding.text
    assert told in finding.text
    assert caveats(evaluator, None, (), 0.14) == ()


def test_a_mirror_is_told_by_standard_deviations_and_correlations() -> None:
    """Not by the elements of a packed factor, of which nobody knows what they mean."""
    response = np.random.default_rng(0).normal(size=(20, 2))
    with pm.Model(coords={"part": ["rod", "pin"]}) as model:
        mean = pm.Normal("mean", 0, 1, dims="part")
        sds = pm.HalfNormal.dist(1, shape=2)
        chol, _, _ = pm.LKJCholeskyCov("cov", n=2, eta=2, sd_dist=sds)
        x = pm.MvNormal.dist(mean, chol=chol, shape=2)
        prb.Simulator("y", np.positive, x, metric=prb.Joint(prb.AreaMetric()), observed=response)
    evaluator = Evaluator.of(model)
    point = {"mean": [1.0, 2.0], "cov": [0.5, -0.3, 0.4]}
    rival = evaluator.hyperparameters.unconstrained(point)
    (finding,) = caveats(evaluator, None, [rival], 0.0)
    assert (
        "come from mean[rod] = 1, mean[pin] = 2, cov_stds[0] = 0.5, cov_stds[1] = 0.5, "
        "cov_corr[0,1] = -0.6: another optimum"
    ) in finding.text


def edges(model: pm.Model, *theta: float) -> tuple[str, ...]:
    found = elements_at_edge(
        Evaluator.of(model), np.array(theta), np.ones(1), size=1.0, tolerance=1e-6, seed=0
    )
    return found


@pytest.mark.parametrize("out", [-12.0, -20.0, -42.0, -70.0, -300.0])
def test_a_population_that_collapsed_is_known_however_far_out(out: float) -> None:
    """From a spread of 1e-16 of the values on they are one number, and change no more."""
    observed = np.random.default_rng(1).normal(1.5, 0.1, 20)
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1.5, 0.5), pm.HalfNormal("sigma", 0.3))
        density = prb.GaussianKDE(0.5)
        metric = prb.LogLikelihood(density=density)
        prb.Simulator(
            "y", np.positive, x, metric=metric, observed=observed, propagation=prb.Resimulated(64)
        )
    assert edges(model, 1.5, out) == ("sigma",)


@pytest.mark.parametrize("out", [-8.0, -12.0, -20.0, -42.0])
def test_a_mean_at_the_bound_of_its_prior_is_at_no_edge(out: float) -> None:
    """There the population stands still as soon as the discrepancy does."""

    def mean(x: Any) -> Any:
        return x - 0.5

    observed = np.random.default_rng(1).normal(-1.0, 0.3, 20)
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Uniform("mu", 0, 3), pm.HalfNormal("sigma", 0.3))
        metric = prb.ProbabilityResidual()
        prb.Simulator(
            "y", mean, x, metric=metric, observed=observed, propagation=prb.Resimulated(64)
        )
    assert edges(model, out, -1.0) == ()


@pytest.mark.long
def test_an_area_of_a_population_without_a_mean_is_warned_of() -> None:
    def minimum(metric: prb.Metric, make: Any, observed: Any) -> prb.Optimum:
        with pm.Model() as model:
            x = make(pm.HalfNormal("scale", 2))
            prb.Simulator(
                "y", lambda x: x, x, metric=metric, observed=observed,
                propagation=prb.Reweighted(256),
            )  # fmt: skip
        return prb.minimize(model)

    observed = np.abs(np.random.default_rng(1).standard_cauchy(30))
    said = "one or less has no mean"
    area = minimum(prb.AreaMetric(), pm.HalfCauchy.dist, observed)
    assert said in "".join(map(str, area.findings))
    assert said in str(prb.diagnose(area))
    other = minimum(prb.KullbackLeibler(), pm.HalfCauchy.dist, observed)
    assert said not in "".join(map(str, other.findings))
    observed = np.random.default_rng(1).exponential(1.0, 30)
    short = minimum(prb.AreaMetric(), lambda s: pm.Exponential.dist(scale=s), observed)
    assert said not in "".join(map(str, short.findings))


@pytest.mark.parametrize(("largest", "said"), [(2.2, False), (9.0, True)])
def test_a_value_between_responses_far_apart_is_told_of(largest: float, said: bool) -> None:
    """A kernel as narrow as the data want sees none of the few responses in a long tail."""
    observed = np.append(np.exp(norm.ppf((np.arange(59) + 0.5) / 59, 0, 0.2)), largest)
    with pm.Model() as model:
        x = pm.LogNormal.dist(pm.Normal("mu", 0, 0.5), pm.HalfNormal("sigma", 0.5))
        prb.Simulator(
            "y",
            np.positive,
            x,
            metric=prb.LogLikelihood(density=prb.GaussianKDE()),
            observed=observed,
        )
    evaluator = Evaluator.of(model)
    found = between_runs(evaluator, np.array([0.0, np.log(0.3)]))
    assert len(found) == said
    if said:
        assert "1 of 60 observed values (9) lie between responses" in found[0].text
    # A metric that smooths both sides takes no value by itself.
    with pm.Model() as model:
        x = pm.LogNormal.dist(pm.Normal("mu", 0, 0.5), pm.HalfNormal("sigma", 0.5))
        prb.Simulator("y", np.positive, x, metric=prb.KullbackLeibler(), observed=observed)
    assert between_runs(Evaluator.of(model), np.array([0.0, np.log(0.3)])) == []
