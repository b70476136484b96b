"""Elements at an edge, where the population changes and its discrepancy does not."""

from typing import Any

import numpy as np
import pymc as pm
import pytest

import prbayes as prb
from prbayes.inference.checks.flat_edge import breakdown_findings, elements_at_edge
from prbayes.model.evaluator import Evaluator


def test_what_breaks_down_is_said_by_name_and_only_then() -> None:
    assert breakdown_findings((), ()) == []
    (finding,) = breakdown_findings(("sigma", "tau"), ())
    assert finding.text.startswith("sigma, tau ran to the edge of the support")
    (finding,) = breakdown_findings((), ("y",))
    assert finding.text.startswith("y: points lose their response at the optimum")
    assert len(breakdown_findings(("sigma",), ("y",))) == 2


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
