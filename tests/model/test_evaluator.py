"""Populations, discrepancies and gradients of an evaluator, against SciPy, the metrics and PyMC."""

from __future__ import annotations

import pickle
import re
from typing import Any

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest
from line_problem import EPSILON, OBSERVED, POINTS, N, build, line
from pytensor.gradient import NullTypeGradError
from scipy import stats

import prbayes as prb
from prbayes._validate import Floats
from prbayes.metrics.base import Metric
from prbayes.model.evaluator import (
    ENOUGH,
    TOLERABLE,
    VISIBLE,
    Evaluator,
    Requirement,
    Shortcoming,
    coarser_evaluator,
    compiled_objective,
    is_current,
    shortcoming,
    supports_each,
)
from prbayes.model.parameters import unconstrained
from prbayes.propagation.base import Propagation
from prbayes.response.compile import PLAIN

AREA = {"metric": prb.AreaMetric(), "observed": OBSERVED}


def kind(value: object) -> str:
    return type(value).__name__


def total(x: Any) -> Any:
    return x[..., 0] + x[..., 1]


def correlated(rho: Any = 0.5, sd: Any = 1.0) -> Any:
    covariance = pt.stacklists([[sd**2, 0.6 * rho * sd], [0.6 * rho * sd, 0.36]])
    return pm.MvNormal.dist(np.array([1.0, 2.0]), covariance)


def exponential_of_normal(mu: Any, sigma: Any) -> Any:
    return pm.CustomDist.dist(
        mu, sigma, dist=lambda m, s, size: pt.exp(pm.Normal.dist(m, s, size=size))
    )


def truncated(mu: Any, sigma: Any) -> Any:
    return pm.TruncatedNormal.dist(mu, sigma, lower=0.5, upper=2.5)


# Hyperparameters, the input, and the distribution of its response.
CASES: dict[str, tuple[dict[str, float], Any, Any, Any]] = {
    "Weibull": (
        {"alpha": 2, "beta": 1.5}, pm.Weibull.dist, line, stats.weibull_min(2, scale=0.75 * 1.5)
    ),
    "TruncatedNormal": (
        {"mu": 1, "sigma": 0.8}, truncated, line, stats.truncnorm(-0.625, 1.875, 0.75, 0.6)
    ),
    "CustomDist": (
        {"mu": 0.4, "sigma": 0.5},
        exponential_of_normal,
        line,
        stats.lognorm(0.5, scale=0.75 * np.exp(0.4)),
    ),
    "correlation": ({"rho": 0.5}, correlated, total, stats.norm(3, np.sqrt(1.96))),
    "sd": (
        {"sd": 1.2}, lambda sd: correlated(sd=sd), total, stats.norm(3, np.sqrt(1.8 + 0.72))
    ),
}  # fmt: skip
# Distributions with only draws or densities.
ROUGH: dict[str, tuple[dict[str, float], Any, Any, Any]] = {
    "Poisson": ({"mu": 4}, pm.Poisson.dist, lambda x: 1.0 * x, stats.poisson(4)),
    "VonMises": (
        {"mu": 0.3, "kappa": 3}, pm.VonMises.dist, lambda x: 1.0 * x, stats.vonmises(3, 0.3)
    ),
    "MvStudentT": (
        {"mu": 1},
        lambda mu: pm.MvStudentT.dist(9, mu=pt.stack([mu, 2.0]), scale=np.eye(2)),
        lambda x: x[..., 0],
        stats.t(9, 1),
    ),
}  # fmt: skip
long = (pytest.mark.long, pytest.mark.exact)
SMALL, LARGE = prb.Reweighted(256), prb.Reweighted(1024)
POPULATIONS = [
    *(pytest.param(name, SMALL, 0.03, id=name) for name in CASES if CASES[name][2] is line),
    pytest.param("correlation", LARGE, 0.1, id="correlation"),
    *(
        pytest.param(name, prb.Resimulated(2048), 0.02, id=f"{name}, resimulated")
        for name in ("CustomDist", "sd")
    ),
    *(pytest.param(name, SMALL, 0.1, id=name, marks=long) for name in ROUGH),
]


def check_population(values: Floats, weights: Floats, expected: Any, tolerance: float) -> None:
    mean = weights @ values
    sd = np.sqrt(weights @ (values - mean) ** 2)
    np.testing.assert_allclose(mean, expected.mean(), atol=tolerance * expected.std())
    np.testing.assert_allclose(sd, expected.std(), rtol=tolerance)
    for z in expected.ppf([0.25, 0.5, 0.75]):
        np.testing.assert_allclose(weights @ (values <= z), expected.cdf(z), atol=tolerance)


@pytest.mark.parametrize(("name", "propagation", "tolerance"), POPULATIONS)
def test_populations_of_inputs(name: str, propagation: Propagation, tolerance: float) -> None:
    at, dist, response, expected = (CASES | ROUGH)[name]
    with pm.Model() as model:
        x = dist(**{k: pm.Normal(k, v, 0.2) for k, v in at.items()})
        prb.Simulator("y", response, x, propagation=propagation, **AREA)
    evaluator, theta = Evaluator.of(model), np.array([list(at.values())], dtype=np.float64)
    (values,), (weights,) = evaluator.populations(theta, 0)
    check_population(values, weights, expected, tolerance)
    if propagation.is_random:
        return
    found = evaluator(theta).discrepancies[0, 0]
    np.testing.assert_allclose(found, evaluator.nodes[0].target(values, weights), rtol=1e-9)


@pytest.mark.parametrize(
    ("propagation", "tolerance"), [(prb.Resimulated(2048), 0.01), (prb.Fresh(20_000), 0.03)]
)
@pytest.mark.parametrize("is_black_box", [False, True])
def test_epistemic_variables_data_and_constants(
    propagation: Propagation, tolerance: float, is_black_box: bool
) -> None:
    def response(x: Any, slope: Any, c: Any, level: Any, power: Any) -> Any:
        if is_black_box:
            x, slope, level = (np.asarray(v, dtype=np.float64) for v in (x, slope, level))
            assert x.shape == slope.shape == level.shape
        return slope * x + c[1] + level * power

    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 2, 1), pm.HalfNormal("sigma", 1))
        slope, level = 2 * pm.Normal("slope", 1, 1), pm.Data("level", 3.0)
        inputs = (x, slope, np.array([5.0, 7.0]), level, 2)
        prb.Simulator("y", response, *inputs, propagation=propagation, **AREA)
    evaluator = Evaluator.of(model)
    slopes = (1.0, -0.5)
    points = [{"mu": 2.0, "sigma": 0.5, "slope": s} for s in slopes]
    thetas = np.array([unconstrained(evaluator.hyperparameters, point) for point in points])
    for level_value in (3.0, 4.0):
        model.set_data("level", level_value)
        populations = evaluator.populations(thetas, 0)
        found = evaluator(thetas).discrepancies[:, 0]
        for v, w, s, d in zip(*populations, slopes, found, strict=True):
            expected = stats.norm(2 * s * 2.0 + 7 + 2 * level_value, abs(2 * s) * 0.5)
            check_population(v, w, expected, tolerance)
            np.testing.assert_allclose(d, expected.mean() - OBSERVED.mean(), rtol=0.01)


def test_nested_inputs_are_drawn_fresh() -> None:
    with pm.Model() as model:
        batch = pm.Normal.dist(pm.Normal("mu", 2, 1), 0.6)
        inputs = pm.Normal.dist(batch, 0.8), batch
        prb.Simulator("y", lambda x, b: x - 0.5 * b, *inputs, propagation=prb.Fresh(20_000), **AREA)
    evaluator = Evaluator.of(model)
    values, weights = evaluator.populations(np.array([[1.0], [3.0]]), 0)
    for v, w, m in zip(values, weights, (1.0, 3.0), strict=True):
        check_population(v, w, stats.norm(0.5 * m, np.hypot(0.3, 0.8)), 0.03)
    found = evaluator(np.array([[-8.0], [0.0], [8.0]])).discrepancies[:, 0]
    np.testing.assert_allclose(found, np.abs(np.array([-4, 0, 4]) - OBSERVED.mean()), rtol=0.05)


METRICS: dict[str, Metric] = {
    "PR": prb.ProbabilityResidual(),
    "PR, bins": prb.ProbabilityResidual(prb.Histogram(6)),
    "KLD": prb.KullbackLeibler(),
    "LL": prb.LogLikelihood(density=prb.GaussianKDE()),
    "area": prb.AreaMetric(),
    "own": prb.FunctionMetric(
        lambda simulated, observed, w: ((simulated * w).sum(-1) - observed.mean()) ** 2,
        weighted=True,
    ),
}
THETAS = np.array([[2.0, np.log(0.8)], [1.6, np.log(0.7)], [2.3, np.log(1.1)]])


@pytest.mark.parametrize(
    ("metric", "propagation"),
    [
        *((name, prb.Reweighted(POINTS)) for name in METRICS),
        *((name, prb.Resimulated(POINTS)) for name in ("PR, bins", "area")),
    ],
    ids=kind,
)
def test_graph_and_arrays_have_the_metric_and_its_gradient(
    metric: str, propagation: Propagation
) -> None:
    weights = None if metric == "own" else np.random.default_rng(5).dirichlet(np.full(N, 9.0))
    model, _ = build(propagation, metric=METRICS[metric], weights=weights, epsilon=0.37)
    evaluator = Evaluator.of(model)
    values, w = evaluator.populations(THETAS, 0)
    direct = METRICS[metric](values, OBSERVED, weights=w, observed_weights=weights)
    assert direct.shape == (3,)
    np.testing.assert_allclose(evaluator(THETAS).discrepancies[:, 0], direct, rtol=1e-9)
    compiled = model.compile_logp(mode=PLAIN)
    names = evaluator.hyperparameters.names

    def logp(theta: Floats) -> float:
        return float(compiled(dict(zip(names, theta, strict=True))))

    prior = stats.norm(2, 1).logpdf(THETAS[:, 0]) + THETAS[:, 1]
    prior += stats.halfnorm.logpdf(np.exp(THETAS[:, 1]))
    found = 0.37 * (prior - [logp(theta) for theta in THETAS])
    np.testing.assert_allclose(found, direct, rtol=1e-9)
    if metric == "own" or (metric.endswith("bins") and isinstance(propagation, prb.Resimulated)):
        remedy = r"no gradient.*use .*(prb.sample_smc|prb.Reweighted)"
        # PyMC takes either for a model without gradient.
        with pytest.raises((NotImplementedError, NullTypeGradError), match=remedy):
            model.compile_dlogp(mode=PLAIN)
        return
    gradient = model.compile_dlogp(mode=PLAIN)
    h = 1e-6
    for theta in THETAS:
        expected = [(logp(theta + h * e) - logp(theta - h * e)) / (2 * h) for e in np.eye(2)]
        slopes = gradient(dict(zip(names, theta, strict=True)))
        np.testing.assert_allclose(slopes, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("propagation", "is_black_box"),
    [
        (prb.Reweighted(POINTS), False),
        (prb.Resimulated(POINTS), False),
        (prb.Resimulated(POINTS), True),
        (prb.Fresh(POINTS), True),
    ],
)
def test_an_invalid_theta_does_not_affect_its_batch(
    propagation: Propagation, is_black_box: bool
) -> None:
    def response(x: Any, z: Any) -> Any:
        if is_black_box:
            x = np.asarray(x, dtype=np.float64)
            assert np.isfinite(x).all()
        return 0.75 * x + z

    with pm.Model() as model:
        mu, sigma = pm.Normal("mu", 2, 1), pm.Normal("sigma", 0.8, 0.8)  # a sixth is invalid
        inputs = pm.Normal.dist(mu, sigma), pm.Normal.dist(0, sigma)
        prb.Simulator("y", response, *inputs, epsilon=EPSILON, propagation=propagation, **AREA)
    evaluator = Evaluator.of(model)
    thetas = np.column_stack([np.linspace(1, 3, 7), np.full(7, 0.6)])
    thetas[2, 1], thetas[4, 1] = -0.6, np.nan
    batch = evaluator(thetas).discrepancies
    is_invalid = np.isin(np.arange(7), [2, 4])
    np.testing.assert_array_equal(np.isinf(batch[:, 0]), is_invalid)
    singles = np.array([evaluator(t[None]).discrepancies[0] for t in thetas])
    if propagation.is_random:
        np.testing.assert_allclose(batch[~is_invalid], singles[~is_invalid], atol=0.3)
    else:
        np.testing.assert_allclose(batch, singles, rtol=1e-12)
        valid = evaluator(thetas[~is_invalid]).discrepancies
        np.testing.assert_allclose(batch[~is_invalid], valid, rtol=1e-12)
    logp = model.compile_logp(mode=PLAIN)
    assert float(logp({"mu": 2.0, "sigma": -0.6})) == -np.inf
    assert np.isfinite(logp({"mu": 2.0, "sigma": 0.6}))
    bound = evaluator.nodes[0].bound
    for sigma_value, is_valid in ((0.6, True), (-0.6, False)):
        roots = [np.array(2.0), np.array(sigma_value)]
        data = bound.draw(np.random.default_rng(1), N, roots)
        assert data.shape == (N,)
        assert np.isfinite(data).all() if is_valid else np.isnan(data).all()


@pytest.mark.parametrize(
    "propagation", [prb.Reweighted(256), prb.Resimulated(256), prb.Fresh(256)], ids=kind
)
def test_an_invalid_correlation_does_not_affect_its_batch(propagation: Propagation) -> None:
    with pm.Model() as model:
        x = correlated(pm.Normal("rho", 0, 0.8))
        prb.Simulator("y", total, x, propagation=propagation, **AREA)
    found = Evaluator.of(model)(np.array([[0.0], [1.3], [-0.9], [0.9]])).discrepancies[:, 0]
    np.testing.assert_array_equal(np.isinf(found), [False, True, False, False])
    # The mean is 1.5 too large whatever the correlation.
    assert (found[[0, 2, 3]] > 1.2).all()


@pytest.mark.parametrize("propagation", [prb.Reweighted(POINTS), prb.Resimulated(POINTS)], ids=kind)
def test_data_above_the_inputs_may_change(propagation: Propagation) -> None:
    with pm.Model() as model:
        mu, sigma = pm.Normal("mu", pm.Data("centre", 2.0), 1), pm.HalfNormal("sigma", 1)
        x = pm.Normal.dist(mu + pm.Data("shift", 0.0), sigma)
        prb.Simulator("y", line, x, epsilon=1.0, propagation=propagation, **AREA)
    evaluator, logp = Evaluator.of(model), model.compile_logp(mode=PLAIN)
    point, theta = {"mu": 2.0, "sigma_log__": 0.0}, np.array([[2.0, 0.0], [2.3, 0.0]])
    first, before = evaluator(theta), logp(point)
    model.set_data("centre", 3.0)
    moved = evaluator(theta)
    np.testing.assert_allclose(moved.discrepancies, first.discrepancies, rtol=1e-12)
    np.testing.assert_allclose(moved.log_prior - first.log_prior, [-0.5, -0.2], rtol=1e-9)
    np.testing.assert_allclose(logp(point) - before, -0.5, rtol=1e-9)
    model.set_data("centre", 2.0)
    model.set_data("shift", 0.3)
    np.testing.assert_allclose(evaluator(theta).discrepancies[0], first.discrepancies[1], rtol=1e-9)
    difference = first.discrepancies[0] - first.discrepancies[1]
    np.testing.assert_allclose(logp(point) - before, difference, rtol=1e-9)


def test_large_designs_have_coarser_ones() -> None:
    with pm.Model() as model:
        inputs = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0), pm.Normal.dist(0.0, 1.0)
        given = {"metric": prb.KullbackLeibler(), "observed": np.linspace(-1, 3, 9)}
        for name, n in {"small": 512, "large": 8192}.items():
            design = prb.Reweighted(n, emulator=None)
            prb.Simulator(name, lambda x, y: x + y**2, *inputs, propagation=design, **given)
    evaluator = Evaluator.of(model)
    coarse = coarser_evaluator(evaluator, np.array([1.0]))
    assert [node.bound.n_points for node in coarse.nodes] == [512, 1024]
    assert [node.bound.n_points for node in evaluator.nodes] == [512, 8192]
    assert coarse.nodes[0].bound is evaluator.nodes[0].bound
    values = evaluator.reweighted["large"].design.sample.values
    np.testing.assert_array_equal(coarse.reweighted["large"].design.sample.values, values[:1024])
    thetas = np.linspace(-1, 1, 5)[:, None]
    found, expected = coarse(thetas).discrepancies, evaluator(thetas).discrepancies
    np.testing.assert_array_equal(found[:, 0], expected[:, 0])
    assert np.all(found[:, 1] != expected[:, 1])
    np.testing.assert_allclose(found[:, 1], expected[:, 1], rtol=0.1)
    assert coarser_evaluator(coarse, np.array([1.0])) is coarse
    assert coarser_evaluator(evaluator, np.array([50.0])) is evaluator, "no design supports it"


def test_an_evaluator_of_other_data_has_a_pickle() -> None:
    evaluator = Evaluator.of(build(prb.Reweighted(POINTS))[0])
    changed = evaluator.observing({"y": OBSERVED + 1})
    thetas = evaluator.hyperparameters.prior_thetas(5, 1)
    for original in (evaluator, changed):
        back = pickle.loads(pickle.dumps(original))
        np.testing.assert_array_equal(back(thetas).discrepancies, original(thetas).discrepancies)
        values = [
            compiled_objective(e, prior=False, gradient=False)(thetas[0], np.ones(1))
            for e in (back, original)
        ]
        assert values[0] == values[1]
    assert changed.model is evaluator.model
    assert changed.nodes[0].bound is evaluator.nodes[0].bound


def test_an_evaluator_is_not_current_after_another_simulator() -> None:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 1), 1.0)
        prb.Simulator("y", line, x, **AREA)
    evaluator = Evaluator.of(model)
    assert is_current(evaluator)
    with model:
        prb.Simulator("z", lambda x: 2 * x, x, **AREA)
    assert not is_current(evaluator)


def short(
    level: Requirement = ENOUGH, ess: Any = 100.0, mass: Any = 1.0, lost: float = 0.0
) -> Shortcoming | None:
    """Return the shortcoming of a design of 256 points for 20 populations."""
    values = np.broadcast_arrays(np.atleast_1d(ess), mass, lost, np.zeros(20))[:3]
    support = dict(zip(("weight_ess", "mean_weight", "lost_mass"), values, strict=True))
    return shortcoming(support, 80.0, 0.05, 256, level)


@pytest.mark.parametrize(
    ("level", "support", "complaint"),
    [
        (ENOUGH, {}, None),
        (ENOUGH, {"ess": 79.0}, "sample size"),
        (TOLERABLE, {"ess": 79.0}, None),
        (TOLERABLE, {"ess": 39.0}, "sample size"),
        (ENOUGH, {"mass": 0.79}, "mean raw weight"),
        (ENOUGH, {"mass": 1.26}, "mean raw weight"),
        (TOLERABLE, {"mass": 1.26}, None),
        (TOLERABLE, {"mass": 0.69}, "mean raw weight"),
        (TOLERABLE, {"mass": 1.41}, "mean raw weight"),
        (ENOUGH, {"lost": 0.04}, None),
        # Lost mass alone is reported.
        (ENOUGH, {"lost": 0.5, "ess": 1.0}, "^lost mass: 50.0% of a population's weight"),
        (ENOUGH, {"ess": 1.0, "mass": 3.0}, "expected 8 and 80, and mean raw weight from 3.00"),
        # A single population far out may fall short, three of twenty may not.
        (ENOUGH, {"ess": np.r_[7.0, np.full(19, 100.0)]}, None),
        (ENOUGH, {"ess": np.r_[[7.0] * 3, [100.0] * 17]}, r"7 \(5% quantile\) and 100 \(median"),
        (ENOUGH, {"mass": np.r_[[0.5] * 3, [1.0] * 17]}, "mean raw weight"),
        (TOLERABLE, {"mass": np.r_[[0.5] * 3, [1.0] * 17]}, None),
    ],
)
def test_shortcomings_of_designs(
    level: Requirement, support: dict[str, Any], complaint: str | None
) -> None:
    found = short(level, **support)
    assert (found is None) == (complaint is None)
    if found is not None and complaint is not None:
        assert re.search(complaint, str(found))
        assert found.is_lost == ("lost" in support)
        assert ("sample size" in str(found)) == ("ess" in support and not found.is_lost)


def test_support_of_each_population() -> None:
    support = {
        "weight_ess": np.array([50.0, 9.0, 50.0, 50.0, 50.0, np.nan]),
        "mean_weight": np.array([1.0, 1.0, 0.4, 2.1, 1.0, 1.0]),
        "lost_mass": np.array([0.0, 0.0, 0.0, 0.0, 0.1, 0.0]),
    }
    is_supported = supports_each(support, 50.0, 0.05, VISIBLE)
    np.testing.assert_array_equal(is_supported, [True, False, False, False, False, False])
    # A sum of zero weights may be rounded.
    support["lost_mass"] = np.full(6, 1e-16)
    assert supports_each(support, 50.0, 0.0, VISIBLE)[0]
