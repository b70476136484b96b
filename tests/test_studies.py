"""Short versions of the statistical studies in benchmarks/, to see that they run and that their figures hold."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks import (
    contamination,
    coverage,
    families,
    likelihood_coverage,
    likelihood_guards,
    readings_coverage,
    record,
)

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("size", [20, 50])
@pytest.mark.parametrize(
    ("problem", "count"), [("linear", 60), ("quadratic", 60), ("correlated", 15)]
)
def test_coverage(problem: str, count: int, size: int) -> None:
    # Two hyperparameters that are nearly independent: at 60 data sets the standard error of the
    # mean coverage is .03, and that of a standard deviation 9%.
    rows = coverage.block(problem, size, 0, count, coverage.METRICS)
    error = (60 / count) ** 0.5
    for metric in coverage.METRICS:
        found = coverage.summarise(rows, metric, "affine")
        # A few of the smallest data sets say that sigma is nearly zero, where no design of 4096
        # points lies.
        assert found["failed"] <= (0.2 * count if (problem, size) == ("correlated", 20) else 0)
        assert abs(np.mean(found["coverage_89%"]) - 0.89) < 0.10 * error
        assert np.min(found["sd_over_own_sampling_sd"]) > 1 - 0.3 * error
        # At N = 20 the full study has up to 1.44, its first 60 data sets alone 2.30: some estimates
        # lie near an edge.
        assert np.max(found["sd_over_own_sampling_sd"]) < (2.2 if size == 20 else 1.2) + 0.3 * error


@pytest.mark.parametrize("sigma", [0.02, 0.13, 0.4999, 0.5, 2.0])
def test_the_exact_density_of_correlated_inputs_is_its_integral(sigma: float) -> None:
    mu, given = 3.0, 0.2 * np.sqrt(0.75)
    for y in (2.0, 3.0, 4.5):
        expected, _ = quad(
            lambda z, y=y: norm.pdf(z) * norm.pdf(np.log(y / (mu + sigma * z)), 0.1 * z, given) / y,
            max(-8.0, -mu / sigma),
            8.0,
            epsabs=1e-12,
            limit=500,
        )
        found = coverage.PROBLEMS["correlated"].density(y, mu, sigma)
        np.testing.assert_allclose(found, expected, rtol=1e-4)


def test_estimates_at_an_edge_are_no_spread() -> None:
    estimates = norm.ppf((np.arange(13) + 0.5) / 13)
    found = coverage.spread(np.r_[estimates, -8.0, -12.0][:, None])
    np.testing.assert_allclose(found, estimates.std(ddof=1), rtol=1e-12)


def test_a_study_goes_on_where_it_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    called = []

    def block(
        problem: str, size: int, first: int, count: int, metrics: tuple[str, ...]
    ) -> list[dict[str, object]]:
        called.append((problem, size, first))
        return coverage_block(problem, size, first, 2, metrics)

    coverage_block = coverage.block
    monkeypatch.setattr(coverage, "block", block)
    monkeypatch.setattr(coverage, "ProcessPoolExecutor", _Here)
    arguments = ["coverage", "--problems", "linear", "--sizes", "20", "--store", str(tmp_path)]
    arguments += ["--out", str(tmp_path / "coverage.json")]
    for replicates in ("20", "40", "40"):
        monkeypatch.setattr(sys, "argv", [*arguments, "--replicates", replicates])
        coverage.main()
    assert called == [("linear", 20, 0), ("linear", 20, 20)]


class _Here:
    def __init__(self, workers: int, mp_context: object) -> None:
        pass

    def __enter__(self) -> _Here:
        return self

    def __exit__(self, *error: object) -> None:
        pass

    def submit(self, function: object, *arguments: object) -> object:
        from concurrent.futures import Future

        future: Future[object] = Future()
        future.set_result(function(*arguments))  # type: ignore[operator]
        return future


def test_contamination_of_the_probability_residual() -> None:
    evaluator = contamination.evaluator_of("ProbabilityResidual")
    shifts = []
    for i in range(6):
        data = np.random.default_rng([5, i]).normal(10, 1, contamination.SIZE)
        dirty = np.r_[data[:-3], np.full(3, 10 + contamination.DISTANCE)]
        clean, after = (contamination.posterior(evaluator, d, True) for d in (data, dirty))
        shifts.append((after[:, 0] - clean[:, 0]) / clean[:, 1])
    mu, sigma = np.mean(shifts, axis=0)
    assert abs(mu) < 0.3
    assert abs(sigma) < 1.3


@pytest.mark.parametrize("truth", ["lognormal", "normal"])
def test_families(truth: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(families, "SIZES", (50,))
    # At 40 data sets the standard error of a share is at most .08, of one of 5% .035, and that of a
    # standard deviation .11.
    chosen = (families.LINEAR, "KullbackLeibler", truth)
    (wide,) = families.case((*chosen, 0.6), 40)
    # More than half was wanted of both; a normal truth is told in .40 of the study's data sets.
    if truth == "lognormal":
        assert wide["right"] > 0.5
    assert wide["right"] > wide["wrong"]
    assert wide["wrong"] <= 0.025 + 4 * 0.025
    (narrow,) = families.case((*chosen, 0.1), 40)
    assert narrow["right"] + narrow["wrong"] <= 0.25
    for found in (wide, narrow):
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
    results = record.load(likelihood_coverage.OUT, None)
    for name, rows in results["rows"].items():
        found = likelihood_coverage.summary(rows)
        assert rounded(found) == rounded(results["summary"][name])
        assert min(found["prbayes"]["p of uniformity"].values()) > 0.01
        # As if the hyperparameters of a data set were one: the error is at most this one.
        error = (0.89 * 0.11 / found["data sets"]) ** 0.5
        assert abs(found["prbayes"]["pooled coverage"] - 0.89) < 4 * error


def test_guards_rarely_flag_right_models() -> None:
    results = record.load(likelihood_guards.OUT, None)
    largest = dict(zip(likelihood_guards.CHECKS, (0.07, 0.06, 0.06), strict=True))
    for name, rows in results["rows"].items():
        found = likelihood_guards.summary(rows)
        assert rounded(found) == rounded(results["summary"][name])
        for check, cell in found.items():
            assert cell["share"] <= largest[check] + 4 * cell["standard error"], (name, check)


def test_measurement_arguments_have_the_exact_posterior() -> None:
    results = record.load(readings_coverage.OUT, None)
    for name, rows in results["rows"].items():
        found = readings_coverage.table(rows)
        assert rounded(found) == rounded(results["summary"][name])
        assert np.abs(found["bias"]).max() < 0.1
        error = (0.89 * 0.11 / (found["data sets"] - found["refused"])) ** 0.5
        for within in found["prbayes"]["coverage"].values():
            assert abs(within - 0.89) < 3 * error
