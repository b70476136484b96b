"""No answer depends on the unit of the response: everything is the same in millimetres and metres."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import pytest
from one_input import one_input

import prbayes as prb

INPUTS = np.random.default_rng(4).normal(1.2, 0.2, 40)


def kolmogorov(simulated: Any, observed: Any, weights: Any) -> Any:
    """The largest difference of two distribution functions at the observed values."""
    differences = []
    for z in observed:
        below = np.where(simulated <= z, weights, 0.0).sum(axis=-1)
        differences.append(np.abs(below - np.mean(observed <= z)))
    return np.max(differences, axis=0)


METRICS = {
    "PR": prb.ProbabilityResidual(),
    "KLD": prb.KullbackLeibler(),
    "area": prb.AreaMetric(),
    "log-likelihood": prb.LogLikelihood(density=prb.GaussianKDE()),
    "one's own": prb.FunctionMetric(kolmogorov, weighted=True),
}
# How the discrepancy itself depends on the unit: these two have one.
POWER = {"PR": 1, "area": 1}


@dataclass(frozen=True)
class Unit:
    """The response, folded at two, in a unit of which one is ``factor`` of another."""

    factor: float

    def __call__(self, x: Any) -> Any:
        return self.factor * (x - 2.0) ** 2


@cache
def answers(kind: str, factor: float) -> dict[str, Any]:
    response = Unit(factor)
    model = one_input(
        response(INPUTS),
        METRICS[kind],
        response=response,
        propagation=prb.Reweighted(256),
        mu=(1.2, 1.0),
        sigma=0.5,
    )
    optimum = prb.minimize(model, progressbar=False)
    posterior = prb.sample(
        500, chains=2, model=model, optimum=optimum, random_seed=1, progressbar=False
    )
    (epsilon,) = prb.calibrate_epsilon(optimum).values()
    draws = posterior.posterior["mu"].values
    return {
        "optimum": optimum.theta,
        "standard errors": optimum.covariance,
        "epsilon": epsilon / factor ** POWER.get(kind, 0),
        "responses": optimum.n_responses,
        "local optima": len(optimum.local_optima),
        "posterior": [draws.mean(), draws.std()],
        "findings": len(optimum.findings),
        "converged": optimum.converged,
    }


@pytest.mark.long
@pytest.mark.parametrize("factor", [1e-6])
@pytest.mark.parametrize("kind", ["PR", "area"])  # with derivatives, and without
def test_answers_do_not_depend_on_the_unit_of_the_response(kind: str, factor: float) -> None:
    expected, found = answers(kind, 1.0), answers(kind, factor)
    for name, value in expected.items():
        np.testing.assert_allclose(found[name], value, rtol=0.02, err_msg=name)


@pytest.mark.slow
@pytest.mark.parametrize("factor", [1e-150, 1e-30, 1e-6, 1e-3, 1e3, 1e6, 1e30, 1e150])
@pytest.mark.parametrize("kind", METRICS)
def test_nor_on_units_far_from_any_size(kind: str, factor: float) -> None:
    test_answers_do_not_depend_on_the_unit_of_the_response(kind, factor)
