"""What an evaluator says of populations and discrepancies, against scipy, the metrics, and the node's log-density."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest
from line_problem import EPSILON, OBSERVED, POINTS, N, build, line
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
    is_current,
    shortcoming,
    supports_each,
)
from prbayes.propagation.base import Propagation
from prbayes.response.compile import PLAIN

PROPAGATIONS: dict[str, Propagation] = {
    "Reweighted": prb.Reweighted(POINTS),
    "Resimulated": prb.Resimulated(POINTS),
    "Fresh": prb.Fresh(POINTS),
}


# Inputs.


@dataclass(frozen=True)
class Case:
    """Hyperparameters near ``at``, the input made of them, and the distribution of its response by scipy."""

    at: dict[str, float]
    dist: Callable[..., Any]
    expected: Any
    response: Callable[..., Any] = line
    positive: tuple[str, ...] = ()


def total(x: Any) -> Any:
    return x[..., 0] + x[..., 1]


def correlated(rho: Any = 0.5, sd: Any = 1.0) -> Any:
    covariance = pt.stacklists([[sd**2, 0.6 * rho * sd], [0.6 * rho * sd, 0.36]])
    return pm.MvNormal.dist(np.array([1.0, 2.0]), covariance)


def exponential_of_normal(mu: Any, sigma: Any) -> Any:
    return pm.CustomDist.dist(
        mu, sigma, dist=lambda m, s, size: pt.exp(pm.Normal.dist(m, s, size=size))
    )


CASES = {
    "Normal": Case({"mu": 2, "sigma": 0.8}, pm.Normal.dist, stats.norm(1.5, 0.6)),
    "LogNormal": Case(
        {"mu": 0.4, "sigma": 0.5}, pm.LogNormal.dist, stats.lognorm(0.5, scale=0.75 * np.exp(0.4))
    ),
    "Weibull": Case(
        {"alpha": 2, "beta": 1.5}, pm.Weibull.dist, stats.weibull_min(2, scale=0.75 * 1.5)
    ),
    "Gamma": Case({"alpha": 3, "beta": 2}, pm.Gamma.dist, stats.gamma(3, scale=0.75 / 2)),
    "Beta": Case({"alpha": 2, "beta": 3}, pm.Beta.dist, stats.beta(2, 3, scale=0.75)),
    "Uniform": Case({"lower": 1, "upper": 3}, pm.Uniform.dist, stats.uniform(0.75, 1.5)),
    "TruncatedNormal": Case(
        {"mu": 1, "sigma": 0.8},
        lambda mu, sigma: pm.TruncatedNormal.dist(mu, sigma, lower=0.5, upper=2.5),
        stats.truncnorm(-0.625, 1.875, 0.75, 0.6),
    ),
    "Gumbel": Case({"mu": 2, "beta": 0.5}, pm.Gumbel.dist, stats.gumbel_r(1.5, 0.375)),
    "CustomDist": Case(
        {"mu": 0.4, "sigma": 0.5},
        exponential_of_normal,
        stats.lognorm(0.5, scale=0.75 * np.exp(0.4)),
    ),
    "MvNormal, correlation": Case({"rho": 0.5}, correlated, stats.norm(3, np.sqrt(1.96)), total),
    "MvNormal, sd": Case(
        {"sd": 1.2}, lambda sd: correlated(sd=sd), stats.norm(3, np.sqrt(1.8 + 0.72)), total
    ),
    "iid vector": Case(
        {"mu": 1, "sigma": 0.8},
        lambda mu, sigma: pm.Normal.dist(mu, sigma, shape=2),
        stats.norm(2, 0.8 * np.sqrt(2)),
        total,
    ),
}
# Distributions that only draws or densities are known of.
ROUGH = {
    "Poisson": Case({"mu": 4}, pm.Poisson.dist, stats.poisson(4), lambda x: 1.0 * x),
    "VonMises": Case(
        {"mu": 0.3, "kappa": 3}, pm.VonMises.dist, stats.vonmises(3, 0.3), lambda x: 1.0 * x
    ),
    "MvStudentT": Case(
        {"mu": 1},
        lambda mu: pm.MvStudentT.dist(9, mu=pt.stack([mu, 2.0]), scale=np.eye(2)),
        stats.t(9, 1),
        lambda x: x[..., 0],
    ),
}


def with_input(case: Case, propagation: Propagation) -> tuple[Evaluator, Floats]:
    with pm.Model() as model:
        parameters = {k: pm.Normal(k, v, 0.2) for k, v in case.at.items()}
        prb.Simulator(
            "y",
            case.response,
            case.dist(**parameters),
            metric=prb.AreaMetric(),
            observed=OBSERVED,
            propagation=propagation,
        )
    return Evaluator.of(model), np.array([list(case.at.values())], dtype=np.float64)


def check_population(values: Floats, weights: Floats, expected: Any, tolerance: float) -> None:
    mean = weights @ values
    np.testing.assert_allclose(mean, expected.mean(), atol=tolerance * expected.std())
    np.testing.assert_allclose(
        np.sqrt(weights @ (values - mean) ** 2), expected.std(), rtol=tolerance
    )
    for z in expected.ppf([0.25, 0.5, 0.75]):
        np.testing.assert_allclose(weights @ (values <= z), expected.cdf(z), atol=tolerance)


@pytest.mark.parametrize(
    "propagation", [prb.Reweighted(256), prb.Resimulated(2048)], ids=lambda p: type(p).__name__
)
@pytest.mark.parametrize("name", CASES)
def test_populations_of_inputs(name: str, propagation: Propagation) -> None:
    several = CASES[name].response is total
    if isinstance(propagation, prb.Reweighted) and several:
        propagation = prb.Reweighted(1024)
    evaluator, theta = with_input(CASES[name], propagation)
    (values,), (weights,) = evaluator.populations(theta, 0)
    tolerance = (0.1 if several else 0.03) if isinstance(propagation, prb.Reweighted) else 0.02
    check_population(values, weights, CASES[name].expected, tolerance)
    node = evaluator.nodes[0]
    np.testing.assert_allclose(
        evaluator(theta).discrepancies[0, 0], node.target(values, weights), rtol=1e-9
    )


@pytest.mark.long
@pytest.mark.exact
@pytest.mark.parametrize(
    "propagation",
    [prb.Reweighted(256), pytest.param(prb.Fresh(20_000), marks=pytest.mark.slow)],
    ids=lambda p: type(p).__name__,
)
@pytest.mark.parametrize("name", ROUGH)
def test_populations_of_inputs_without_quantiles(name: str, propagation: Propagation) -> None:
    evaluator, theta = with_input(ROUGH[name], propagation)
    (values,), (weights,) = evaluator.populations(theta, 0)
    check_population(
        values,
        weights,
        ROUGH[name].expected,
        0.1 if isinstance(propagation, prb.Reweighted) else 0.03,
    )


@pytest.mark.parametrize(
    "propagation", [prb.Resimulated(2048), prb.Fresh(20_000)], ids=lambda p: type(p).__name__
)
@pytest.mark.parametrize("black", [False, True])
def test_epistemic_variables_data_and_constants(propagation: Propagation, black: bool) -> None:
    def response(x: Any, slope: Any, c: Any, level: Any, power: Any) -> Any:
        if black:
            x, slope, level = (np.asarray(v, dtype=np.float64) for v in (x, slope, level))
            assert x.shape == slope.shape == level.shape
        return slope * x + c[1] + level * power

    with pm.Model() as model:
        mu, sigma, slope = (
            pm.Normal("mu", 2, 1),
            pm.HalfNormal("sigma", 1),
            pm.Normal("slope", 1, 1),
        )
        prb.Simulator(
            "y",
            response,
            pm.Normal.dist(mu, sigma),
            2 * slope,
            np.array([5.0, 7.0]),
            pm.Data("level", 3.0),
            2,
            metric=prb.AreaMetric(),
            observed=OBSERVED,
            propagation=propagation,
        )
    evaluator = Evaluator.of(model)
    thetas = np.array(
        [
            evaluator.hyperparameters.unconstrained({"mu": 2.0, "sigma": 0.5, "slope": s})
            for s in (1.0, -0.5)
        ]
    )
    for level in (3.0, 4.0):
        model.set_data("level", level)
        values, weights = evaluator.populations(thetas, 0)
        found = evaluator(thetas).discrepancies[:, 0]
        for v, w, s, d in zip(values, weights, (1.0, -0.5), found, strict=True):
            expected = stats.norm(2 * s * 2.0 + 7 + 2 * level, abs(2 * s) * 0.5)
            check_population(
                v, w, expected, 0.01 if isinstance(propagation, prb.Resimulated) else 0.03
            )
            np.testing.assert_allclose(d, expected.mean() - OBSERVED.mean(), rtol=0.01)


def test_inputs_that_depend_on_each_other_are_drawn_fresh() -> None:
    with pm.Model() as model:
        mu = pm.Normal("mu", 2, 1)
        batch = pm.Normal.dist(mu, 0.6)
        prb.Simulator(
            "y",
            lambda x, b: x - 0.5 * b,
            pm.Normal.dist(batch, 0.8),
            batch,
            metric=prb.AreaMetric(),
            observed=OBSERVED,
            propagation=prb.Fresh(20_000),
        )
    evaluator = Evaluator.of(model)
    values, weights = evaluator.populations(np.array([[1.0], [3.0]]), 0)
    for v, w, m in zip(values, weights, (1.0, 3.0), strict=True):
        check_population(v, w, stats.norm(0.5 * m, np.hypot(0.3, 0.8)), 0.03)
    found = evaluator(np.array([[-8.0], [0.0], [8.0]])).discrepancies[:, 0]
    np.testing.assert_allclose(found, np.abs(np.array([-4, 0, 4]) - OBSERVED.mean()), rtol=0.05)


# One implementation.

METRICS: dict[str, Metric] = {
    "PR": prb.ProbabilityResidual(),
    "PR, bins": prb.ProbabilityResidual(prb.Histogram(6)),
    "KLD": prb.KullbackLeibler(),
    "KLD, reverse": prb.KullbackLeibler(reverse=True),
    "KLD, bins": prb.KullbackLeibler(prb.Histogram(6)),
    "LL": prb.LogLikelihood(density=prb.GaussianKDE()),
    "LL, bins": prb.LogLikelihood(density=prb.Histogram(6)),
    "area": prb.AreaMetric(),
    "own": prb.FunctionMetric(
        lambda simulated, observed, w: ((simulated * w).sum(-1) - observed.mean()) ** 2,
        weighted=True,
    ),
}
THETAS = np.array([[2.0, np.log(0.8)], [1.6, np.log(0.7)], [2.3, np.log(1.1)]])
both = pytest.mark.parametrize(
    "propagation", [prb.Reweighted(POINTS), prb.Resimulated(POINTS)], ids=lambda p: type(p).__name__
)


@both
@pytest.mark.parametrize("metric", METRICS)
def test_one_implementation(metric: str, propagation: Propagation) -> None:
    weights = None if metric == "own" else np.random.default_rng(5).dirichlet(np.full(N, 9.0))
    model, _ = build(propagation, metric=METRICS[metric], weights=weights, epsilon=0.37)
    evaluator = Evaluator.of(model)
    values, w = evaluator.populations(THETAS, 0)
    direct = METRICS[metric](values, OBSERVED, weights=w, observed_weights=weights)
    assert direct.shape == (3,)
    np.testing.assert_allclose(evaluator(THETAS).discrepancies[:, 0], direct, rtol=1e-9)
    logp = model.compile_logp(mode=PLAIN)
    for theta, d in zip(THETAS, direct, strict=True):
        point = dict(zip(evaluator.hyperparameters.names, theta, strict=True))
        prior = (
            stats.norm(2, 1).logpdf(theta[0]) + stats.halfnorm.logpdf(np.exp(theta[1])) + theta[1]
        )
        np.testing.assert_allclose(0.37 * (prior - logp(point)), d, rtol=1e-9)


@both
@pytest.mark.parametrize("metric", METRICS)
def test_gradients(metric: str, propagation: Propagation) -> None:
    model, _ = build(propagation, metric=METRICS[metric], epsilon=0.37)
    names = [v.name for v in model.value_vars]
    if metric == "own" or (metric.endswith("bins") and isinstance(propagation, prb.Resimulated)):
        with pytest.raises(
            NotImplementedError, match=r"no gradient.*use .*(prb.sample_smc|prb.Reweighted)"
        ):
            model.compile_dlogp(mode=PLAIN)
        return
    logp, gradient = model.compile_logp(mode=PLAIN), model.compile_dlogp(mode=PLAIN)
    h = 1e-6
    for theta in THETAS:
        ends = [
            [float(logp(dict(zip(names, theta + s * e, strict=True)))) for s in (h, -h)]
            for e in np.eye(2)
        ]
        expected = [(a - b) / (2 * h) for a, b in ends]
        found = gradient(dict(zip(names, theta, strict=True)))
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)


# Invalid particles.


@pytest.mark.parametrize("black", [False, True])
@pytest.mark.parametrize("name", ["Reweighted", "Resimulated", "Fresh"])
def test_an_invalid_particle_leaves_the_others_alone(name: str, black: bool) -> None:
    def response(x: Any, z: Any) -> Any:
        if black:
            x = np.asarray(x, dtype=np.float64)
            assert np.isfinite(x).all()
        return 0.75 * x + z

    with pm.Model() as model:
        mu, sigma = (
            pm.Normal("mu", 2, 1),
            pm.Normal("sigma", 0.8, 0.8),
        )  # a sixth of the prior is invalid
        prb.Simulator(
            "y",
            response,
            pm.Normal.dist(mu, sigma),
            pm.Normal.dist(0, sigma),
            metric=prb.AreaMetric(),
            observed=OBSERVED,
            epsilon=EPSILON,
            propagation=PROPAGATIONS[name],
        )
    evaluator = Evaluator.of(model)
    thetas = np.column_stack([np.linspace(1, 3, 7), np.full(7, 0.6)])
    thetas[2, 1], thetas[4, 1] = -0.6, np.nan
    batch = evaluator(thetas)
    expected = np.isin(np.arange(7), [2, 4])
    np.testing.assert_array_equal(np.isinf(batch.discrepancies[:, 0]), expected)
    singles = np.array([evaluator(t[None]).discrepancies[0, 0] for t in thetas])
    if name == "Fresh":
        np.testing.assert_allclose(batch.discrepancies[~expected, 0], singles[~expected], atol=0.3)
    else:
        np.testing.assert_allclose(batch.discrepancies[:, 0], singles, rtol=1e-12)
        valid = evaluator(thetas[~expected])
        np.testing.assert_allclose(batch.discrepancies[~expected], valid.discrepancies, rtol=1e-12)
    logp = model.compile_logp(mode=PLAIN)
    assert float(logp({"mu": 2.0, "sigma": -0.6})) == -np.inf
    assert np.isfinite(logp({"mu": 2.0, "sigma": 0.6}))
    bound = evaluator.nodes[0].bound
    for sigma, fine in ((0.6, True), (-0.6, False)):
        data = bound.draw(np.random.default_rng(1), N, [np.array(2.0), np.array(sigma)])
        assert data.shape == (N,)
        assert np.isfinite(data).all() if fine else np.isnan(data).all()


def test_an_invalid_correlation_leaves_the_others_alone() -> None:
    for propagation in (prb.Reweighted(256), prb.Resimulated(256), prb.Fresh(256)):
        with pm.Model() as model:
            rho = pm.Normal("rho", 0, 0.8)
            prb.Simulator(
                "y",
                total,
                correlated(rho),
                metric=prb.AreaMetric(),
                observed=OBSERVED,
                propagation=propagation,
            )
        found = Evaluator.of(model)(np.array([[0.0], [1.3], [-0.9], [0.9]])).discrepancies[:, 0]
        np.testing.assert_array_equal(np.isinf(found), [False, True, False, False])
        # The mean is 1.5 too large whatever the correlation.
        assert (found[[0, 2, 3]] > 1.2).all()


# Data of the model.


@both
def test_data_above_the_inputs_is_followed(propagation: Propagation) -> None:
    with pm.Model() as model:
        mu, sigma = pm.Normal("mu", pm.Data("centre", 2.0), 1), pm.HalfNormal("sigma", 1)
        x = pm.Normal.dist(mu + pm.Data("shift", 0.0), sigma)
        prb.Simulator(
            "y",
            line,
            x,
            metric=prb.AreaMetric(),
            observed=OBSERVED,
            epsilon=1.0,
            propagation=propagation,
        )
    evaluator, logp, point = (
        Evaluator.of(model),
        model.compile_logp(mode=PLAIN),
        {"mu": 2.0, "sigma_log__": 0.0},
    )
    theta = np.array([[2.0, 0.0], [2.3, 0.0]])
    first, before = evaluator(theta), logp(point)
    model.set_data("centre", 3.0)
    np.testing.assert_allclose(evaluator(theta).discrepancies, first.discrepancies, rtol=1e-12)
    np.testing.assert_allclose(
        evaluator(theta).log_prior - first.log_prior, [-0.5, -0.2], rtol=1e-9
    )
    np.testing.assert_allclose(logp(point) - before, -0.5, rtol=1e-9)
    model.set_data("centre", 2.0)
    model.set_data("shift", 0.3)
    np.testing.assert_allclose(evaluator(theta).discrepancies[0], first.discrepancies[1], rtol=1e-9)
    np.testing.assert_allclose(
        logp(point) - before, first.discrepancies[0] - first.discrepancies[1], rtol=1e-9
    )


# Travelling.


def test_large_designs_have_coarser_ones() -> None:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
        y = pm.Normal.dist(0.0, 1.0)
        for name, n in {"small": 128, "large": 8192}.items():
            prb.Simulator(
                name,
                lambda x, y: x + y**2,
                x,
                y,
                metric=prb.KullbackLeibler(),
                observed=np.linspace(-1, 3, 9),
                propagation=prb.Reweighted(n, emulator=None),
            )
    evaluator = Evaluator.of(model)
    coarser = coarser_evaluator(evaluator)
    assert coarser is not None
    assert [node.bound.n_points for node in coarser.nodes] == [128, 1024]
    assert [node.bound.n_points for node in evaluator.nodes] == [128, 8192]
    assert coarser.nodes[0].bound is evaluator.nodes[0].bound
    bound = evaluator.reweighted["large"]
    np.testing.assert_array_equal(
        coarser.reweighted["large"].design.sample.values, bound.design.sample.values[:1024]
    )
    thetas = np.linspace(-1, 1, 5)[:, None]
    found, expected = coarser(thetas), evaluator(thetas)
    np.testing.assert_array_equal(found.discrepancies[:, 0], expected.discrepancies[:, 0])
    assert np.all(found.discrepancies[:, 1] != expected.discrepancies[:, 1])
    np.testing.assert_allclose(found.discrepancies[:, 1], expected.discrepancies[:, 1], rtol=0.1)
    assert coarser_evaluator(coarser) is None


def test_an_evaluator_of_other_data_travels_with_them() -> None:
    evaluator = Evaluator.of(build(prb.Reweighted(POINTS))[0])
    other = evaluator.observing({"y": OBSERVED + 1})
    thetas = evaluator.hyperparameters.prior_thetas(5, 1)
    for one in (evaluator, other):
        back = pickle.loads(pickle.dumps(one))
        np.testing.assert_array_equal(back(thetas).discrepancies, one(thetas).discrepancies)
        scales = np.ones(1)
        expected = one.objective(prior=False, gradient=False)(thetas[0], scales)
        assert back.objective(prior=False, gradient=False)(thetas[0], scales) == expected
    assert other.model is evaluator.model
    assert other.nodes[0].bound is evaluator.nodes[0].bound


def test_an_evaluator_of_a_model_that_got_another_simulator_is_not_current() -> None:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 1), 1.0)
        given = {"metric": prb.AreaMetric(), "observed": [0.0, 1.0, 2.0]}
        prb.Simulator("y", lambda x: x, x, **given)
    evaluator = Evaluator.of(model)
    assert is_current(evaluator)
    with model:
        prb.Simulator("z", lambda x: 2 * x, x, **given)
    assert not is_current(evaluator)


def support(ess: Any = 100.0, mass: Any = 1.0, lost: Any = 0.0) -> dict[str, Any]:
    values = np.broadcast_arrays(np.atleast_1d(ess), mass, lost, np.zeros(20))[:3]
    return dict(zip(("weight_ess", "mean_weight", "lost_mass"), values, strict=True))


def found(level: Requirement = ENOUGH, **keywords: Any) -> Shortcoming | None:
    return shortcoming(support(**keywords), 80.0, 0.05, 256, level)


def test_a_design_that_supports_all_falls_short_in_nothing() -> None:
    assert not found()


@pytest.mark.parametrize(
    ("keywords", "level", "which"),
    [
        ({"ess": 79.0}, ENOUGH, "sample size"),
        ({"ess": 79.0}, TOLERABLE, None),
        ({"ess": 39.0}, TOLERABLE, "sample size"),
        ({"mass": 0.79}, ENOUGH, "mean raw weight"),
        ({"mass": 1.26}, ENOUGH, "mean raw weight"),
        ({"mass": 1.26}, TOLERABLE, None),
        ({"mass": 0.69}, TOLERABLE, "mean raw weight"),
        ({"mass": 1.41}, TOLERABLE, "mean raw weight"),
        ({"lost": 0.06}, ENOUGH, "lost"),
        ({"lost": 0.04}, ENOUGH, None),
    ],
)
def test_levels(keywords: dict[str, float], level: Requirement, which: str | None) -> None:
    short = found(level, **keywords)
    assert (which or "") in str(short)
    assert (short is None) == (which is None)


def test_single_populations_far_out_may_fall_short_and_a_tenth_may_not() -> None:
    ess = np.full(20, 100.0)
    ess[:1] = 90.0
    assert not found(ess=ess)
    ess[:3] = 7.0
    assert "7 (5% quantile) and 100 (median)" in str(found(ess=ess))
    mass = np.ones(20)
    mass[:3] = 0.5
    assert found(mass=mass)
    assert not found(TOLERABLE, mass=mass)


def test_lost_mass_is_said_first_and_alone() -> None:
    short = found(ess=1.0, lost=0.5)
    assert str(short).startswith("lost mass: 50.0% of a population's weight")
    assert "effective" not in str(short)
    assert "expected 8 and 80, and mean raw weight from 3.00" in str(found(ess=1.0, mass=3.0))


def test_each_population_by_itself_is_supported_or_not() -> None:
    found = {
        "weight_ess": np.array([50.0, 9.0, 50.0, 50.0, 50.0, np.nan]),
        "mean_weight": np.array([1.0, 1.0, 0.4, 2.1, 1.0, 1.0]),
        "lost_mass": np.array([0.0, 0.0, 0.0, 0.0, 0.1, 0.0]),
    }
    drawn = supports_each(found, 50.0, 0.05, VISIBLE)
    np.testing.assert_array_equal(drawn, [True, False, False, False, False, False])
    # A sum of weights that is zero, but for rounding, is none.
    found["lost_mass"] = np.full(6, 1e-16)
    assert supports_each(found, 50.0, 0.0, VISIBLE)[0]
