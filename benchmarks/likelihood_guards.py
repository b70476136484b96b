"""Sizes of the guards of the log-likelihood by specimen: how often right models are flagged.

Hyperparameters are drawn from the prior, inputs of specimens from their population, and readings are
their responses without error: every finding is a false one. All data sets of a problem share the first
runs and the compiled log-likelihood. Each data set goes through what a user calls: roots, points and
the checks before the fit, and 256 draws of the posterior, by importance sampling, of which `prb.diagnose`
tests the family of the population and the conflict of prior and data.

    uv run python -m benchmarks.likelihood_guards [--data-sets 200]
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr

import prbayes as prb
from benchmarks.likelihood_coverage import PROBLEMS, Problem, likelihood_of, thetas_of
from benchmarks.scoreboard.problem import Input, normal, truncated
from benchmarks.study import Study
from prbayes.model.evaluator import Evaluator
from prbayes.model.measurement import SpecimenLikelihood
from prbayes.model.specimen_likelihood import arrays
from prbayes.model.specimen_preparation import SpecimenPopulations, prepared
from prbayes.optimize.maximum_likelihood import simulation_obstacle
from prbayes.results.likelihood_checks import check_conflict, check_draws, check_population

# With priors that matter beside the data: conflicts are reported where the prior pulls.
LINEAR = Problem(
    name="linear",
    size=20,
    priors={"mu": normal(1.0, 0.2), "sigma": truncated(0.5, 0.15, low=0.1)},
    inputs=(Input("normal", "mu", "sigma"),),
    formula=lambda xp, x: 2 * x + 1,
)
CASES = {"linear": LINEAR} | {name: PROBLEMS[name] for name in ("folded", "mirror root", "circle")}
TESTS = {
    "family of the population": "population-misfit",
    "conflict of prior and data": "prior-conflict",
}
CHECKS = ("loops and checks before the fit", *TESTS)
TESTED = 60  # data sets whose draws are tested


def observe(likelihood: SpecimenLikelihood, base: SpecimenLikelihood, y: Any) -> list[str]:
    """Give a likelihood other data, with the runs of a base, and return its findings.

    Its compiled graphs stay.
    """
    points, log_a = arrays(likelihood)
    other = base.observing({base.name: y})
    vars(other)["coordinates"] = base.coordinates  # those of the prior, whatever the data
    preparation = prepared(other)
    new_points, new_log_a = arrays(other)
    for old, new in zip((*points, log_a), (*new_points, new_log_a), strict=True):
        old.set_value(new.get_value())
    # The observed values stay, as the model has them: others would be other points.
    vars(likelihood).update(stacked=other.stacked)
    likelihood.cache["preparation"] = preparation
    return [finding.code for finding in prepared(other).findings]


def readings(problem: Problem, number: int) -> Any:
    """Return the responses of one data set, with hyperparameters from the prior."""
    rng = np.random.default_rng([17, problem.size, number])
    truth = thetas_of(problem, rng.standard_normal((1, len(problem.priors))))[0]
    z = rng.standard_normal((problem.size, len(problem.inputs)))
    values = dict(zip(problem.priors, truth, strict=True))
    return problem.response(*[np.ravel(x) for x in problem.population.population(values, z)])


def before_the_fit(
    likelihood: SpecimenLikelihood, base: SpecimenLikelihood, y: Any
) -> dict[str, Any]:
    """Return the codes of the findings of loops and checks before the fit."""
    try:
        return {"before the fit": observe(likelihood, base, y)}
    except prb.propagation.DesignError as error:
        return {"before the fit": ["refused"], "error": str(error)}


def of_draws(evaluator: Evaluator, populations: SpecimenPopulations) -> dict[str, Any]:
    """Return the codes of the findings of posterior draws, and the tests that were not run."""
    (likelihood,) = evaluator.likelihoods
    points = prepared(likelihood).points
    draws = populations.posterior(points.z, points.log_a).thetas
    result = xr.DataTree.from_dict({"posterior": xr.Dataset()})
    checked = check_draws(evaluator, result, draws)
    if not simulation_obstacle(evaluator):
        optimum = prb.minimize(evaluator.model)
        checked += check_population(optimum) + check_conflict(optimum, draws)
    # A weak misfit of the population is a remark.
    weak = [remark for remark in checked.remarks if remark.code in TESTS.values()]
    return {
        "codes": [finding.code for finding in (*checked.findings, *weak)],
        "untested": [name for name in TESTS if any(name in text for text in checked.untested)],
    }


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the share of data sets that each check flags, with its standard error."""
    flagged = {CHECKS[0]: [bool(row["before the fit"]) for row in rows]}
    for name, code in TESTS.items():
        tested = [row for row in rows if "codes" in row and name not in row["untested"]]
        flagged[name] = [code in row["codes"] for row in tested]
    result: dict[str, Any] = {}
    for name, values in flagged.items():
        if not values:
            continue
        n, share = len(values), float(np.mean(values))
        # Of no flag, as if there were one.
        error = float(np.sqrt(max(share, 1 / n) * (1 - share) / n))
        result[name] = {"data sets": n, "share": round(share, 4), "standard error": round(error, 4)}
    return result


@cache
def prepared_case(name: str) -> tuple[Evaluator, SpecimenLikelihood, SpecimenPopulations, pm.Model]:
    """Return an evaluator to be given data, a likelihood with the first runs, and populations.

    The last item is the model of the second one, which has to stay in memory.
    """
    base_model, base = likelihood_of(CASES[name])
    model, _ = likelihood_of(CASES[name])
    evaluator = Evaluator.of(model)
    (likelihood,) = evaluator.likelihoods
    return evaluator, base, SpecimenPopulations(likelihood), base_model


def row(name: str, number: int) -> dict[str, Any]:
    """Return the findings of a data set; those of draws of the first data sets alone."""
    evaluator, base, populations, _ = prepared_case(name)
    (likelihood,) = evaluator.likelihoods
    figures = before_the_fit(likelihood, base, readings(CASES[name], number))
    if number < TESTED and "error" not in figures:
        figures |= of_draws(evaluator, populations)
    return figures


STUDY = Study("likelihood_guards", __doc__, CASES, row, 200, summary)

if __name__ == "__main__":
    STUDY.main()
