"""The likelihood of a data sheet's statistics: closed forms, coverage, refusals, and a calibration."""

from __future__ import annotations

from typing import Any

import numpy as np
import pymc as pm
import pytensor
import pytensor.tensor as pt
import pytest
from one_input import one_input
from scipy.special import ndtri
from scipy.stats import chi2, norm

import prbayes as prb
from benchmarks import data_sheets
from prbayes._validate import Floats
from prbayes.metrics.summary_likelihood import SummaryLikelihood

MU = np.array([0.0, 0.2, -0.3, 0.1])
SIGMA = np.array([1.0, 1.2, 0.8, 1.5])
SCORES = ndtri((np.arange(20001) + 0.5) / 20001)


def log_likelihoods(sheet: prb.Summary, unit: float = 1.0) -> Floats:
    """Return log-likelihoods of normal populations, less that of the first."""
    target = SummaryLikelihood(sheet).against(sheet.values)
    values = unit * (MU[:, None] + SIGMA[:, None] * SCORES)
    result = -sheet.n * np.asarray(target(values))
    return np.asarray(result - result[0])


@pytest.mark.parametrize("n", [5, 20])
def test_mean_and_sd_of_a_normal_population_have_their_exact_law(n: int) -> None:
    exact = norm.logpdf(0.1, MU, SIGMA / np.sqrt(n)) + chi2.logpdf((n - 1) * 1.21 / SIGMA**2, n - 1)
    exact -= 2 * np.log(SIGMA)
    found = log_likelihoods(prb.Summary(n=n, mean=0.1, sd=1.1))
    np.testing.assert_allclose(found, exact - exact[0], atol=0.025)
    found = log_likelihoods(prb.Summary(n=n, mean=0.1))
    mean = norm.logpdf(0.1, MU, SIGMA / np.sqrt(n))
    np.testing.assert_allclose(found, mean - mean[0], atol=1e-3)


def test_extremes_and_quantiles_have_the_density_of_order_statistics() -> None:
    """Up to the kernel, of a tenth of the standard deviation."""
    a, q, b = -1.9, 0.1, 2.0
    below = [norm.cdf(x, MU, SIGMA) for x in (a, q, b)]
    exact = sum(norm.logpdf(x, MU, SIGMA) for x in (a, q, b))
    exact = exact + 9 * np.log(below[1] - below[0]) + 9 * np.log(below[2] - below[1])
    sheet = prb.Summary(n=21, minimum=a, maximum=b, quantiles={0.5: q})
    np.testing.assert_allclose(log_likelihoods(sheet), exact - exact[0], atol=0.15)
    one = prb.Summary(n=20, minimum=a, sd=1.0)
    target = SummaryLikelihood(one).against(one.values)
    assert target.counts.tolist() == [0, 19]
    assert np.isfinite(log_likelihoods(one)).all()


ALL: dict[str, Any] = {
    "n": 20, "mean": 0.1, "sd": 1.1, "minimum": -1.9, "maximum": 2.0, "quantiles": {0.5: 0.0},
}  # fmt: skip


def test_the_likelihood_does_not_depend_on_units() -> None:
    scaled = {
        k: v if k == "n" else {0.5: 0.0} if k == "quantiles" else 50 * v for k, v in ALL.items()
    }
    found = log_likelihoods(prb.Summary(**scaled), unit=50.0)
    np.testing.assert_allclose(found, log_likelihoods(prb.Summary(**ALL)), rtol=1e-9)


@pytest.mark.parametrize("without", [(), ("mean", "sd")])
def test_basis_graph_and_direct_call_agree(without: tuple[str, ...]) -> None:
    sheet = prb.Summary(**{k: v for k, v in ALL.items() if k not in without})
    target = SummaryLikelihood(sheet).against(sheet.values)
    y = np.append(np.random.default_rng(1).normal(0, 1.2, 200), np.nan)
    weights = np.random.default_rng(2).random((3, 201)) * np.isfinite(y)
    weights /= weights.sum(axis=1, keepdims=True)
    basis = target.basis(y)
    by_basis = target.outer(*basis.features(weights), xp=np)
    np.testing.assert_allclose(by_basis, target.of(np.broadcast_to(y, weights.shape), weights))
    assert np.isfinite(by_basis).all()
    w = pt.dvector()
    graphs = [
        target.outer(*basis.features(w, pt), xp=pt),
        target.outer(*target.features(pt.as_tensor(y), w, pt), xp=pt),
    ]
    mode = pytensor.compile.mode.Mode(linker="py", optimizer="fast_compile")
    function = pytensor.function([w], graphs, mode=mode)
    np.testing.assert_allclose(function(weights[1]), by_basis[[1, 1]], rtol=1e-9)


def test_a_population_far_away_has_a_finite_likelihood() -> None:
    target = SummaryLikelihood(prb.Summary(**ALL)).against(prb.Summary(**ALL).values)
    y = np.array([1e3, 1e3 + 1, np.inf])
    assert target(y) > target(SCORES)
    assert np.isfinite(target(y))


def test_intervals_contain_the_truth() -> None:
    """89 % of 60 data sheets, within four standard errors; levels have the mean one half."""
    cell = "gamma, 20, mean sd extremes"
    figures = data_sheets.summary([data_sheets.row(cell, seed) for seed in range(60)])
    for name in ("mu", "sigma"):
        assert abs(figures[name] - 0.89) < 4 * np.sqrt(0.89 * 0.11 / 60)
        assert abs(figures[f"{name}, mean level"] - 0.5) < 4 / np.sqrt(12 * 60)


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ({"n": 20}, "at least one statistic beside n"),
        ({"n": 20, "sd": 1.0}, "locates the population"),
        ({"n": 1, "mean": 1.0, "sd": 1.0}, "n: got 1"),
        ({"n": 9, "mean": 5.0, "minimum": 1.0, "maximum": 4.0}, "a number from 1.33333 to 3.66667"),
        ({"n": 2, "mean": 1.0, "minimum": 0.9, "maximum": 5.0}, "from 2.95 to 2.95"),
        ({"n": 2, "mean": 1.0, "sd": 0.1, "minimum": 0.5}, "sd: got 0.1, expected from 0.7071"),
        # The median of three is at most sqrt(2 / 3) standard deviations from their mean.
        ({"n": 3, "mean": 1.0, "sd": 0.5, "quantiles": {0.5: 1.45}}, "expected from 0.7794 to inf"),
        ({"n": 10, "mean": 5.0, "sd": 0.1, "quantiles": {0.1: 0.0, 0.9: 2.0}}, "a standard error"),
        ({"n": 30, "mean": 1.0, "sd": 0.5, "quantiles": {0.25: 3.0, 0.75: 4.0}}, "standard error"),
        ({"n": 100, "mean": 1.0, "quantiles": {0.25: 310.0, 0.75: 350.0}}, "in the same units"),
        ({"n": 9, "mean": 2.0, "sd": 0.1, "minimum": 1.0, "maximum": 4.0}, "a standard error"),
        ({"n": 9, "mean": 2.0, "sd": 1.7, "minimum": 1.0, "maximum": 4.0}, "sd: got 1.7"),
        ({"n": 9, "quantiles": {0.2: 2.0, 0.5: 1.0}}, "numbers that increase"),
        ({"n": 9, "minimum": 2.0}, "expected a spread"),
        ({"n": 9, "mean": 2.0, "quantiles": {0.5: 2.1}}, "expected a spread"),
    ],
)
def test_impossible_sheets_are_refused(given: dict[str, Any], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        prb.Summary(**given)


@pytest.mark.parametrize("method", ["linear", "weibull", "hazen", "median_unbiased"])
def test_rounded_statistics_of_samples_are_accepted(method: Any) -> None:
    rng = np.random.default_rng(0)
    for number in range(100):
        n, is_skew = int(rng.integers(2, 40)), bool(number % 2)
        x = rng.lognormal(0.0, rng.uniform(0.1, 2.0), n) if is_skew else rng.normal(5.0, 1.0, n)
        of_sample = {"mean": x.mean(), "sd": x.std(ddof=1), "minimum": x.min(), "maximum": x.max()}
        quantiles = {p: np.quantile(x, p, method=method) for p in (0.25, 0.5, 0.9)}
        given: dict[str, Any] = {k: float(f"{v:.3g}") for k, v in of_sample.items()}
        if n > 12:
            given["quantiles"] = {p: float(f"{q:.3g}") for p, q in quantiles.items()}
        prb.Summary(n=n, **given)


def with_sheet(**settings: Any) -> pm.Model:
    sheet = prb.Summary(n=40, mean=330.0, sd=11.3, minimum=300.0, maximum=355.0)
    return one_input(sheet, response=lambda x: 1.0 * x, mu=(320, 30), sigma=30, **settings)


@pytest.mark.parametrize(
    "settings",
    [
        {"metric": prb.AreaMetric()},
        {"weights": [1.0, 2.0]},
        {"specimens": [1, 2]},
        {"epsilon": 0.1},
        {"propagation": prb.Fresh(64)},
    ],
)
def test_a_sheet_has_no_specimens_to_weight_or_label(settings: dict[str, Any]) -> None:
    with pytest.raises(TypeError, match=r"y: (observed|propagation): got .* prb.Summary"):
        with_sheet(**settings)


@pytest.mark.long
def test_a_calibration_from_a_sheet() -> None:
    """Of a normal population: standard errors and posterior are those of its specimens."""
    model = with_sheet()
    optimum = prb.minimize(model, starts=0, progressbar=False)
    assert abs(optimum.point["mu"] - 330) < 0.5
    assert abs(optimum.stderr["mu"] / (11.3 / np.sqrt(40)) - 1) < 0.1
    assert abs(optimum.stderr["sigma"] / (11.3 / np.sqrt(80)) - 1) < 0.1
    idata = prb.sample(200, model=model, optimum=optimum, random_seed=1, progressbar=False)
    assert abs(float(idata.posterior["mu"].std()) / optimum.stderr["mu"] - 1) < 0.15
    # Replicates are the statistics of 40 specimens.
    replicates = idata.posterior_predictive["y"].mean(("chain", "draw")).values
    np.testing.assert_allclose(replicates, idata.observed_data["y"].values, atol=8)
    assert (np.diff(replicates[[1, 0, 2]]) > 15).all()
    with pytest.raises(ValueError, match="no specimens to resample"):
        prb.bootstrap(optimum, 10, progressbar=False)
    with pytest.raises(ValueError, match="no specimens to resample"):
        prb.simulation_based_calibration(4, model=model, progressbar=False)
    with model:
        x = pm.Normal.dist(model["mu"], 1.0)
        metric = prb.AreaMetric()
        prb.Simulator("z", lambda x: 1.0 * x, x, metric=metric, observed=[329.0, 331.0])
    with pytest.raises(ValueError, match=r"y: observed: got a prb.Summary in a model with"):
        prb.sample(20, model=model, progressbar=False)
