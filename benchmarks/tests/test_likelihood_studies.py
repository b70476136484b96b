"""The studies of the log-likelihood by specimen run: one data set of each."""

from __future__ import annotations

import pytest

from benchmarks import likelihood_coverage, likelihood_guards, many_inputs, readings_coverage
from prbayes.model.evaluator import Evaluator
from prbayes.model.specimen_preparation import SpecimenPopulations

pytestmark = pytest.mark.long


def test_coverage() -> None:
    problem = likelihood_coverage.PROBLEMS["folded"]
    _model, likelihood = likelihood_coverage.likelihood_of(problem)
    row = likelihood_coverage.data_set(problem, likelihood, 0)
    assert row["prbayes"]["mean"] == pytest.approx(row["exact"]["mean"], abs=0.05)


@pytest.mark.parametrize("name", ["error estimated", "gross errors, folded", "right-censored"])
def test_readings(name: str) -> None:
    case = readings_coverage.CASES[name]
    _model, likelihood = likelihood_coverage.likelihood_of(case.problem, case.measurement)
    row = readings_coverage.data_set(case, likelihood, 0)  # checks its own density first
    assert row["prbayes"]["mean"] == pytest.approx(row["exact"]["mean"], abs=0.1)


def test_guards() -> None:
    problem = likelihood_guards.LINEAR
    _model, base = likelihood_coverage.likelihood_of(problem)
    model, _ = likelihood_coverage.likelihood_of(problem)
    evaluator = Evaluator.of(model)
    (likelihood,) = evaluator.likelihoods
    y = likelihood_guards.readings(problem, 0)
    assert likelihood_guards.before_the_fit(likelihood, base, y) == {"before the fit": []}
    found = likelihood_guards.of_draws(evaluator, SpecimenPopulations(likelihood))
    assert found == {"codes": [], "untested": []}


@pytest.mark.slow
def test_many_inputs() -> None:
    """Eight inputs from four outputs, beside points of the response itself.

    The reference of two sets is known to about .05 standard deviations in each of 16 means, and the
    largest bias of three data sets was .14 to .31.
    """
    row = many_inputs.measured(1, sets=2)
    figures = many_inputs.figures(row)
    assert row["sampler"] == "importance sampling"
    assert figures["runs"] <= 1000
    assert figures["largest"] < 0.4
    assert figures["rms"] < 0.2
    assert 0.8 < figures["narrowest"] < figures["widest"] < 1.25
