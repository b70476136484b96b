"""Coverage of intervals where the population depends on a covariate of each specimen.

The input of a specimen with covariate c is normal with mean a + b c. Hyperparameters and the inputs
of 30 specimens are drawn from their priors. The posterior by `prb.response.condition` is compared with
the exact one, by the roots of the response in closed form, at the same points. All data sets of a
response share the first runs.

    uv run python -m benchmarks.covariates [--data-sets 200]
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pymc as pm
import pytensor.tensor as pt
from scipy.special import logsumexp

import prbayes as prb
from benchmarks.likelihood_coverage import Functions, Problem, thetas_of
from benchmarks.readings_coverage import FOLDED, MONOTONE, Response, figures_of_both, table
from benchmarks.scoreboard import in_pymc
from benchmarks.scoreboard.problem import half_normal, normal, truncated
from benchmarks.study import Study
from prbayes.model.measurement import SpecimenLikelihood
from prbayes.model.specimen_likelihood import (
    log_likelihood_graph,
    log_likelihoods,
    specimen_likelihoods,
)
from prbayes.model.specimen_preparation import prepared

COVARIATE = np.linspace(-1.0, 1.0, 30)
RESPONSES = {"monotone": MONOTONE, "folded": FOLDED}


def problem_of(name: str) -> Problem:
    """Return the hyperparameters and their priors."""
    mean = normal(0.0, 1.0) if name == "monotone" else truncated(2.0, 1.0, low=1.0)
    priors = {"a": mean, "b": normal(0.0, 1.0), "sigma": half_normal(0.5)}
    return Problem(name, len(COVARIATE), priors, (), RESPONSES[name].formula)


@cache
def likelihood_of(name: str) -> tuple[pm.Model, SpecimenLikelihood]:
    """Return a model, and its likelihood, whose first runs serve all data sets; its data are any."""
    problem = problem_of(name)
    with pm.Model() as model:
        values = in_pymc.hyperparameters(problem.population)
        covariate = prb.response.condition("covariate", COVARIATE)
        x = pm.Normal.dist(values["a"] + values["b"] * covariate, values["sigma"])
        observed = RESPONSES[name].formula(1.5 + COVARIATE)
        prb.Simulator("y", RESPONSES[name].formula, x, observed=observed)
    (likelihood,) = specimen_likelihoods(model).values()
    return model, likelihood


def exact_log_likelihood(response: Response, y: Any) -> Functions:
    """Return the exact log-likelihood (S,) of populations (S, 3), up to a constant in each root."""
    roots = response.branches(y)
    step = 1e-6 * np.maximum(np.abs(roots), 1.0)
    slope = (response.formula(roots + step) - response.formula(roots - step)) / (2 * step)

    def function(theta: Any) -> Any:
        a, b, sigma = theta.T[:, :, None, None]
        z = (roots - a - b * COVARIATE[:, None]) / sigma
        constant = np.log(np.abs(slope)) + 0.5 * np.log(2 * np.pi)
        return logsumexp(-0.5 * z**2 - np.log(sigma) - constant, axis=2).sum(axis=1)

    return function


def data_set(name: str, number: int) -> dict[str, Any]:
    """Return both posteriors of a data set: moments, and the distribution function at the truth."""
    problem, (_, likelihood) = problem_of(name), likelihood_of(name)
    rng = np.random.default_rng([11, list(RESPONSES).index(name), number])
    start = rng.standard_normal(len(problem.priors))
    truth = thetas_of(problem, start[None])[0]
    a, b, sigma = truth
    x = a + b * COVARIATE + sigma * rng.standard_normal(len(COVARIATE))
    y = RESPONSES[name].formula(x)
    row: dict[str, Any] = {"number": number, "truth": truth.tolist()}
    other = likelihood.observing({"y": y})
    # Coordinates are those of the prior, whatever the data.
    other.__dict__["coordinates"] = likelihood.coordinates
    try:
        row["runs"] = len(prepared(other).emulation.z)
    except prb.propagation.DesignError as error:
        return row | {"error": str(error)}

    def by_package(theta: Any) -> Any:
        values = dict(zip(problem.priors, theta.T, strict=True))
        return log_likelihoods(other, values).sum(axis=1)

    if number == 0:
        params = dict(zip(problem.priors, map(pt.as_tensor, truth), strict=True))
        graph = log_likelihood_graph(other, {v: params.get(str(v.name)) for v in other.variables()})
        np.testing.assert_allclose(by_package(truth[None]), graph.sum().eval(), rtol=1e-8)
    exact = exact_log_likelihood(RESPONSES[name], y)
    return row | figures_of_both(problem, exact, by_package, start)


STUDY = Study("covariates", __doc__, RESPONSES, data_set, 200, table, has_rows=False)

if __name__ == "__main__":
    STUDY.main()
