"""The studies of the log-likelihood by specimen run: one data set of each."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks import likelihood_coverage, likelihood_guards, readings_coverage
from prbayes.model.evaluator import Evaluator

pytestmark = pytest.mark.long


def test_coverage() -> None:
    problem = likelihood_coverage.PROBLEMS["folded"]
    _model, likelihood = likelihood_coverage.likelihood_of(problem)
    row = likelihood_coverage.data_set(problem, likelihood, 0)
    assert row["prbayes"]["mean"] == pytest.approx(row["exact"]["mean"], abs=0.05)


@pytest.mark.parametrize("name", ["error estimated", "gross errors, folded", "right-censored"])
def test_readings(name: str) -> None:
    case = readings_coverage.CASES[name]
    _model, likelihood = readings_coverage.likelihood_of(case.problem, case.measurement)
    row = readings_coverage.data_set(case, likelihood, 0)  # checks its own density first
    assert row["prbayes"]["mean"] == pytest.approx(row["exact"]["mean"], abs=0.1)


def test_guards() -> None:
    problem = likelihood_guards.LINEAR
    _model, base = likelihood_coverage.likelihood_of(problem)
    model, _ = likelihood_coverage.likelihood_of(problem)
    evaluator = Evaluator(model)
    (likelihood,) = evaluator.likelihoods
    y = likelihood_guards.readings(problem, 0)
    assert likelihood_guards.before_the_fit(likelihood, base, y) == {"before the fit": []}
    found = likelihood_guards.of_draws(evaluator, likelihood.populations)
    assert found == {"codes": [], "untested": []}
