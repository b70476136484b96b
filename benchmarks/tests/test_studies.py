"""Short versions of the statistical studies in benchmarks/, to see that they run and that their figures hold."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from benchmarks import (
    covariates,
    families,
    likelihood_coverage,
    likelihood_guards,
    posterior,
    readings_coverage,
)
from benchmarks.study import Study

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("prior", posterior.PRIORS)
@pytest.mark.parametrize("metric", posterior.METRICS)
def test_coverage(metric: str, prior: str) -> None:
    cell = f"linear/{prior}/20/{metric}"
    rows = [posterior.STUDY.attempt(cell, number) for number in range(40)]
    found = posterior.summary(rows)
    assert found["failed"] <= 2
    # The standard error of a coverage of .89 of 80 intervals is .035.
    assert abs(np.mean(found["coverage"]) - 0.89) < 4 * 0.035


@pytest.mark.parametrize("truth", families.FAMILIES)
def test_families(truth: str) -> None:
    # At 40 data sets the standard error of a share is at most .08, of one of 5% .035, and that of a
    # standard deviation .11.
    figures = []
    for variation in (0.6, 0.1):
        cell = families.name_of(families.LINEAR, "KLD", truth, variation, 50)
        figures.append(families.summary([families.row(cell, number) for number in range(40)]))
    wide, narrow = figures
    # More than half was wanted of both; a normal truth is identified in .40 of the study's data sets.
    if truth == "lognormal":
        assert wide["right"] > 0.5
    assert wide["right"] > wide["wrong"]
    assert wide["wrong"] <= 0.025 + 4 * 0.025
    assert narrow["right"] + narrow["wrong"] <= 0.25
    for found in figures:
        assert 0.8 - 4 * 0.09 < found["z_sd"] < 1.25 + 4 * 0.14


def rounded(result: Any) -> Any:
    """Return a result with nine digits: the last ones depend on the processor."""
    return json.loads(json.dumps(result), parse_float=lambda text: float(f"{float(text):.9g}"))


@pytest.mark.parametrize("name", list(likelihood_coverage.PROBLEMS))
def test_the_posterior_of_the_likelihood_by_specimen_is_the_exact_one(name: str) -> None:
    problem = likelihood_coverage.PROBLEMS[name]
    _model, likelihood = likelihood_coverage.likelihood_of(problem)
    rows = [likelihood_coverage.data_set(problem, likelihood, number) for number in range(12)]
    found = likelihood_coverage.summary(rows)
    assert found["refused"] == 0
    # Distances from the exact posterior of the same data, which have no sampling error.
    assert np.max(found["largest distance"]) < 0.3
    assert np.max(found["median distance"]) < 0.05
    assert np.abs(np.array(found["width"]) - 1).max() < 0.05


def test_the_likelihood_by_specimen_covers_over_a_whole_prior() -> None:
    for found in likelihood_coverage.STUDY.stored()["summary"].values():
        assert min(found["prbayes"]["p of uniformity"].values()) > 0.01
        # As if the hyperparameters of a data set were one: the error is at most this one.
        error = (0.89 * 0.11 / found["data sets"]) ** 0.5
        assert abs(found["prbayes"]["pooled coverage"] - 0.89) < 4 * error


def test_guards_rarely_flag_right_models() -> None:
    results = likelihood_guards.STUDY.stored()
    largest = dict(zip(likelihood_guards.CHECKS, (0.07, 0.06, 0.06), strict=True))
    for name, rows in results["rows"].items():
        found = likelihood_guards.summary(rows)
        assert rounded(found) == rounded(results["summary"][name])
        for check, cell in found.items():
            assert cell["share"] <= largest[check] + 4 * cell["standard error"], (name, check)


@pytest.mark.parametrize("study", [readings_coverage.STUDY, covariates.STUDY])
def test_measurement_arguments_and_covariates_have_the_exact_posterior(study: Study) -> None:
    for found in study.stored()["summary"].values():
        assert np.abs(found["bias"]).max() < 0.1
        error = (0.89 * 0.11 / (found["data sets"] - found["refused"])) ** 0.5
        for within in found["prbayes"]["coverage"].values():
            assert abs(within - 0.89) < 3 * error
