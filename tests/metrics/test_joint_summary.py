"""The likelihood of data sheets of several outputs: closed forms, coverage, refusals, a calibration."""

from __future__ import annotations

from typing import Any

import numpy as np
import pymc as pm
import pytensor
import pytensor.tensor as pt
import pytest
from scipy.special import gammaln, ive, ndtri
from scipy.stats import multivariate_normal

import prbayes as prb
from benchmarks import joint_data_sheets
from prbayes._validate import Floats
from prbayes.metrics.joint_summary import (
    JointSummaryDiscrepancy,
    JointSummaryLikelihood,
    values_of_sheets,
)
from prbayes.numerics.points import sobol

# Means, standard deviations and correlation of two outputs; the first population is the reference.
POPULATIONS: Any = [
    (0.0, 0.0, 1.0, 1.0, 1.0),
    (0.2, 0.0, 1.0, 1.0, 1.0),
    (0.2, 0.2, 1.0, 1.0, 1.0),
    (0.0, 0.0, 1.2, 1.1, 1.0),
    (0.0, 0.0, 1.1, 0.95, 1.0),
    (0.0, 0.0, 1.0, 1.0, 0.8),
    (-0.2, 0.1, 1.1, 1.2, 0.9),
]
POINTS = ndtri(sobol(2**13, 2, 0))


def target_of(*sheets: prb.Summary, rounding: float = 1e-3) -> JointSummaryDiscrepancy:
    names = tuple(f"output {k}" for k in range(len(sheets)))
    metric = JointSummaryLikelihood(names, sheets, rounding)
    target = metric.against(values_of_sheets(sheets))
    assert isinstance(target, JointSummaryDiscrepancy)
    return target


def log_likelihoods(target: JointSummaryDiscrepancy, correlation: float) -> Floats:
    """Return log-likelihoods of normal populations, less that of the first, with exact moments."""
    logs = []
    points, weights = joint_data_sheets.nodes("mean sd")
    for mu, nu, sigma, tau, factor in POPULATIONS:
        rho = factor * correlation
        second = rho * points[:, 0] + np.sqrt(1 - rho**2) * points[:, 1]
        y = np.stack([mu + sigma * points[:, 0], nu + tau * second], axis=-1)
        logs.append(-target.n_effective * target(y, weights))
    return np.array(logs) - logs[0]


def log_density_of_means(means: Any, n: int, correlation: float) -> Floats:
    logs = []
    for mu, nu, sigma, tau, factor in POPULATIONS:
        between = factor * correlation * sigma * tau
        covariance = np.array([[sigma**2, between], [between, tau**2]])
        logs.append(multivariate_normal.logpdf(means, [mu, nu], covariance / n))
    return np.array(logs) - logs[0]


def log_density_of_sds(sds: Any, n: int, correlation: float) -> Floats:
    """Return Kibble's (1941) density of the diagonal of a Wishart matrix of two outputs."""
    logs = []
    a = (n - 1) / 2
    for _, _, sigma, tau, factor in POPULATIONS:
        square = (factor * correlation) ** 2
        u, v = a * (sds[0] / sigma) ** 2, a * (sds[1] / tau) ** 2
        argument = 2 * np.sqrt(square * u * v) / (1 - square)
        bessel = np.log(ive(a - 1, argument)) + argument
        log_p = bessel - (u + v) / (1 - square) - np.log(1 - square) - gammaln(a)
        log_p += (a - 1) / 2 * np.log(u * v / square)
        logs.append(log_p - 2 * np.log(sigma * tau))
    return np.array(logs) - logs[0]


@pytest.mark.parametrize("correlation", [0.3, 0.9, -0.9])
@pytest.mark.parametrize("n", [5, 20])
def test_a_normal_population_has_the_exact_law(n: int, correlation: float) -> None:
    """Standard deviations have it up to the copula of Wishart margins.

    Means have it up to the 1e-6 on the diagonal of correlations, which is 1e-6 / (1 - .9^2)^2 = 3e-5
    times the squared score.
    """
    means, sds = (0.1, 0.1 * correlation + 0.1), (1.1, 1.05)
    sheets = [prb.Summary(n=n, mean=mean) for mean in means]
    exact = log_density_of_means(means, n, correlation)
    found = log_likelihoods(target_of(*sheets, rounding=1e-9), correlation)
    np.testing.assert_allclose(found, exact, atol=1e-4)
    sheets = [prb.Summary(n=n, mean=m, sd=s) for m, s in zip(means, sds, strict=True)]
    exact = exact + log_density_of_sds(sds, n, correlation)
    found = log_likelihoods(target_of(*sheets, rounding=1e-9), correlation)
    np.testing.assert_allclose(found, exact, atol=0.08)


def sheet_with_all(y: Floats) -> prb.Summary:
    return prb.Summary(
        n=len(y),
        mean=float(y.mean()),
        sd=float(y.std(ddof=1)),
        minimum=float(y.min()),
        maximum=float(y.max()),
        quantiles={0.5: float(np.median(y))},
    )


SAMPLE = np.random.default_rng(5).normal(size=(20, 2)) @ np.array([[1.0, 0.8], [0.0, 0.6]])
ALL = tuple(sheet_with_all(y) for y in SAMPLE.T)


LOWEST = prb.Summary(n=20, minimum=-2.0, sd=1.0)


def test_outputs_that_are_independent_have_the_sum_of_their_likelihoods() -> None:
    for sheets in (ALL, (ALL[0], prb.Summary(n=20, mean=0.1))):
        target = target_of(*sheets)
        x = ndtri((np.arange(101) + 0.5) / 101)
        y = np.stack(np.meshgrid(x, 0.2 + 1.1 * x), axis=-1).reshape(-1, 2)
        members = [float(member(y[:, k])) for k, member in enumerate(target.members)]
        assert target(y) == pytest.approx(sum(members), abs=1e-5)


def test_scores_of_order_statistics_are_standard_normal() -> None:
    """For 200 data sets of the population, within five standard errors and the kernel's effect."""
    rng = np.random.default_rng(2)
    scores, products = [], []
    population = ndtri((np.arange(1001) + 0.5) / 1001)
    for _ in range(200):
        z = rng.standard_normal(10)
        other = prb.Summary(n=10, minimum=float(z.min()), maximum=float(z.max()))
        member = target_of(other).members[0]
        sums = np.array([np.mean(column) for column in member.columns(population, np)])
        scores.append(np.array(member.log_density(sums, np)[1]))
        products.append(scores[-1][0] * scores[-1][1])
    z = np.array(scores)
    np.testing.assert_allclose(z.mean(axis=0), 0, atol=5 / np.sqrt(200) + 0.03)
    np.testing.assert_allclose(z.std(axis=0), 1, atol=5 / np.sqrt(400) + 0.03)
    assert abs(np.mean(products)) < 5 / np.sqrt(200)


def test_the_likelihood_does_not_depend_on_units_or_order() -> None:
    scaled = tuple(sheet_with_all(3.0 + 50 * y) for y in SAMPLE.T)
    differences = [
        target_of(*scaled)(3.0 + 50 * y) - target_of(*ALL)(y) for y in (POINTS, 1.2 * POINTS + 0.1)
    ]
    assert differences[0] == pytest.approx(differences[1], abs=1e-9)
    y = POINTS @ np.array([[1.0, 0.5], [0.0, 1.0]])
    swapped = target_of(*ALL[::-1])
    assert swapped(y[:, ::-1]) == pytest.approx(target_of(*ALL)(y), abs=1e-5)


def test_basis_graph_and_direct_call_agree() -> None:
    target = target_of(LOWEST, prb.Summary(n=20, mean=0.1, sd=1.1))
    y = np.concatenate([np.random.default_rng(1).normal(0, 1.2, (200, 2)), [[0.0, np.nan]]])
    weights = np.random.default_rng(2).random((3, 201)) * np.isfinite(y).all(axis=1)
    weights /= weights.sum(axis=1, keepdims=True)
    basis = target.basis(y)
    by_basis = target.outer(*basis.features(weights), xp=np)
    direct = target.of(np.broadcast_to(y, (*weights.shape, 2)), weights)
    np.testing.assert_allclose(by_basis, direct)
    assert np.isfinite(by_basis).all()
    w = pt.dvector()
    graphs = [
        target.outer(*basis.features(w, pt), xp=pt),
        target.outer(*target.features(pt.as_tensor(y), w, pt), xp=pt),
    ]
    mode = pytensor.compile.mode.Mode(linker="py", optimizer="fast_compile")
    function = pytensor.function([w], graphs, mode=mode)
    np.testing.assert_allclose(function(weights[1]), by_basis[[1, 1]], rtol=1e-9)


def test_extreme_populations_have_finite_likelihoods() -> None:
    """Far away, without spread, and with outputs that are functions of each other."""
    target = target_of(*ALL)
    far = np.array([[1e3, 1e3], [1e3 + 1, 1e3], [np.inf, 1e3]])
    narrow = np.full((9, 2), 0.1)
    related = np.repeat(POINTS[:99, :1], 2, axis=1)
    values = [target(y) for y in (far, narrow, related, POINTS)]
    assert np.isfinite(values).all()
    assert values[-1] < values[0]


def test_sheets_together_have_the_precision_of_paired_means() -> None:
    """As sheets of separate specimens, means are less (or more) precise than specimens allow."""
    rows = {cell: [joint_data_sheets.row(cell, seed) for seed in range(3)] for cell in CELLS}
    figures = {cell: joint_data_sheets.summary(cells) for cell, cells in rows.items()}
    for cell, (low, high) in CELLS.items():
        assert abs(figures[cell]["together, mu 1, sd ratio"] - 1) < 0.1
        assert low < figures[cell]["separate, mu 1, sd ratio"] < high


CELLS = {"correlated, 20, mean sd": (1.8, 4.0), "weakly correlated, 20, mean sd": (0.75, 0.95)}


def outputs(e: Any, t: Any) -> dict[str, Any]:
    return {"force": e + 2.0 * t, "travel": e - t}


def with_sheets(observed: Any, **settings: Any) -> pm.Model:
    with pm.Model() as model:
        e = pm.Normal.dist(pm.Normal("mu", 0, 3), pm.HalfNormal("sigma", 3))
        t = pm.Normal.dist(pm.Normal("nu", 0, 3), pm.HalfNormal("tau", 3))
        prb.Simulator("y", outputs, e, t, observed=observed, **settings)
    return model


MEAN = prb.Summary(n=20, mean=0.0, sd=2.0)


@pytest.mark.parametrize(
    ("observed", "settings", "text"),
    [
        ({"force": MEAN, "travel": [1.0, 2.0]}, {}, r"observed\['travel'\]: got list .* a Summary"),
        ({"force": MEAN, "travel": prb.Summary(n=9, mean=0.0)}, {}, "'travel': 9}, expected one"),
        ({"force": MEAN, "travel": MEAN}, {"metric": prb.AreaMetric()}, "Summary and metric="),
        ({"force": MEAN, "travel": MEAN}, {"specimens": [1]}, "Summary and specimens="),
        ({"force": MEAN, "travel": MEAN}, {"propagation": prb.Fresh(64)}, "would be random"),
        ({1: MEAN, "travel": MEAN}, {}, "got the key 1"),
    ],
)
def test_what_is_no_sheet_of_each_output_is_refused(
    observed: Any, settings: dict[str, Any], text: str
) -> None:
    with pytest.raises((TypeError, ValueError), match=text):
        with_sheets(observed, **settings)


def test_separate_sheets_of_the_same_inputs_are_reported(caplog: pytest.LogCaptureFixture) -> None:
    codes = []
    for n in (20, 21):
        with pm.Model():
            x = pm.Normal.dist(pm.Normal("mu", 0, 3), 1.0)
            prb.Simulator("a", lambda x: x, x, observed=MEAN)
            prb.Simulator("b", lambda x: 2 * x, x, observed=prb.Summary(n=n, mean=0.1))
        codes.append([getattr(record, "code", "") for record in caplog.records])
        caplog.clear()
    assert codes == [["separate-sheets"], []]


@pytest.mark.long
def test_a_calibration_from_the_means_of_two_outputs() -> None:
    """Means of the inputs are known as well as from the specimens, whose mean is linear in them."""
    with pm.Model() as model:
        e = pm.Normal.dist(pm.Normal("mu", 0, 9), 2.0)
        t = pm.Normal.dist(pm.Normal("nu", 0, 9), 1.0)
        sheets = {"force": prb.Summary(n=40, mean=3.0), "travel": prb.Summary(n=40, mean=0.0)}
        prb.Simulator("y", outputs, e, t, observed=sheets, units={"force": "N", "travel": "mm"})
    optimum = prb.minimize(model, starts=0, progressbar=False)
    assert optimum.point == pytest.approx({"mu": 1.0, "nu": 1.0}, abs=0.03)
    expected = {"mu": 2 / np.sqrt(40), "nu": 1 / np.sqrt(40)}
    assert optimum.stderr == pytest.approx(expected, rel=0.05)
    idata = prb.sample(200, model=model, optimum=optimum, random_seed=1, progressbar=False)
    for name, error in expected.items():
        assert float(idata.posterior[name].std()) == pytest.approx(error, rel=0.15)
    observed = idata.observed_data["y"]
    assert observed.attrs["data_sheet"] == "force: n = 40, mean = 3.0; travel: n = 40, mean = 0.0"
    assert dict(observed.sizes) == {"y_dim_0": 1, "output": 2}
    # Replicates are means of the same 40 specimens.
    replicates = idata.posterior_predictive["y"]
    np.testing.assert_allclose(replicates.mean(("chain", "draw")), observed, atol=0.25)
    pairs = replicates.values.reshape(-1, 2)
    assert np.corrcoef(pairs.T)[0, 1] == pytest.approx(2 / np.sqrt(40), abs=0.15)
    with pytest.raises(ValueError, match="no specimens to resample"):
        prb.bootstrap(optimum, 10, progressbar=False)
