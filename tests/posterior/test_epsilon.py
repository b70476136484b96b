"""`calibrate_epsilon` and `set_epsilon` against closed forms and units."""

from functools import cache
from typing import Any

import numpy as np
import pymc as pm
import pytest
from scipy.stats import norm

import prbayes as prb
from prbayes._validate import Floats
from prbayes.inference.asymptotics import Information
from prbayes.metrics.density import Histogram
from prbayes.model.evaluator import Evaluator
from prbayes.model.random_variable import has_default_epsilon, nodes

OBSERVED = np.random.default_rng(1).normal(1.0, 0.5, 50)
N = OBSERVED.size
PR, AREA, KL, LL = (
    prb.ProbabilityResidual(),
    prb.AreaMetric(),
    prb.KullbackLeibler(),
    prb.LogLikelihood(density=prb.GaussianKDE()),
)


class Line:
    """y = unit x; counts its calls."""

    def __init__(self, unit: float = 1.0) -> None:
        self.unit, self.calls = unit, 0

    def __call__(self, x: Any) -> Any:
        self.calls += 1
        return self.unit * x


def build(
    metric: prb.Metric,
    response: Any = None,
    observed: Floats = OBSERVED,
    sd: float | None = None,
    n: int = 256,
    propagation: Any = None,
    **keywords: Any,
) -> pm.Model:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1) if sd is None else sd)
        propagation = propagation or prb.Reweighted(n)
        response = response or Line()
        prb.Simulator(
            "y", response, x, metric=metric, observed=observed, propagation=propagation, **keywords
        )
    return model


def node(model: pm.Model) -> Any:
    return next(iter(nodes(model).values()))


@cache
def area_fit(unit: float = 1.0) -> prb.Optimum:
    return prb.minimize(build(AREA, Line(unit), unit * OBSERVED), method="Nelder-Mead")


@cache
def known_sd(n: int | None = 256) -> tuple[prb.Optimum, Information]:
    propagation = prb.Resimulated(1024) if n is None else prb.Reweighted(n)
    optimum = prb.minimize(build(PR, sd=0.5, propagation=propagation))
    evaluator = Evaluator.of(optimum.model)
    return optimum, Information(evaluator, 0, optimum.theta)


# -- likelihoods
# -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "metric", [KL, LL, prb.KullbackLeibler(reverse=True), prb.KullbackLeibler(Histogram())]
)
def test_likelihoods_start_at_one_over_n(metric: prb.Metric) -> None:
    assert node(build(metric, n=16)).epsilon_value == pytest.approx(1 / N)


@pytest.mark.parametrize("metric", [PR, AREA])
def test_the_others_start_unset(metric: prb.Metric) -> None:
    assert np.isnan(node(build(metric, n=16)).epsilon_value)
    assert node(build(metric, n=16, epsilon=0.3)).epsilon_value == 0.3


def test_calibration_of_a_likelihood_is_one_over_n_effective() -> None:
    weights = np.random.default_rng(2).dirichlet(np.ones(N))
    for w, n in ((None, N), (weights, 1 / (weights**2).sum())):
        model = build(KL, weights=w, epsilon=7.0, n=64)
        optimum = prb.minimize(model, method="Nelder-Mead", max_evaluations=5, refine=False)
        assert prb.calibrate_epsilon(optimum) == {
            "y": pytest.approx(1 / n)
        }  # it does not matter where
        assert node(build(KL, weights=w, n=16)).epsilon_value == pytest.approx(1 / n)
        assert node(model).epsilon_value == 7.0  # calibrating sets nothing


# -- the sandwich of the residual
# ------------------------------------------------------------------------


@pytest.mark.parametrize("n", [256, None])
def test_epsilon_of_one_hyperparameter_is_noise_over_curvature(n: int | None) -> None:
    optimum, information = known_sd(n)
    expected = information.sampling_covariance[0, 0] / information.hessian[0, 0]
    np.testing.assert_allclose(prb.calibrate_epsilon(optimum)["y"], expected, rtol=1e-10)


def test_the_posterior_width_that_it_gives() -> None:
    # With one hyperparameter epsilon H^-1 is H^-1 J H^-1 exactly: the pseudo-posterior is as wide
    # as the estimator is uncertain.
    optimum, information = known_sd()
    epsilon = prb.calibrate_epsilon(optimum)["y"]
    thetas = np.linspace(-0.4, 0.4, 161)[:, None] + optimum.theta
    logs = -Evaluator.of(optimum.model)(thetas).discrepancies[:, 0] / epsilon
    weights = np.exp(logs - logs.max())
    weights /= weights.sum()
    mean = weights @ thetas[:, 0]
    sd = (weights @ (thetas[:, 0] - mean) ** 2) ** 0.5
    # 10%: the residual is not quite a parabola, and these data are not quite the population.
    np.testing.assert_allclose(sd, optimum.stderr["mu"], rtol=0.15)
    assert information.noise_floor > 0


# -- coverage for the area metric
# ------------------------------------------------------------------------


def test_area_epsilon_is_about_0_28_of_the_noise_floor() -> None:
    optimum = area_fit()
    evaluator = Evaluator.of(optimum.model)
    floor = Information(evaluator, 0, optimum.theta).noise_floor
    # The floor is a mean over 200 data sets whose distances vary by 40%; the bisected coverage has
    # a standard error of 1.6%, hence epsilon one of about 4%: 5% together. Bounds from the studies:
    # 0.28 at N = 50, linear response.
    assert 0.22 < prb.calibrate_epsilon(optimum)["y"] / floor < 0.34


def test_area_posteriors_cover() -> None:
    """What it is solved for, checked without linearising: intervals of posteriors of data sets from the optimum."""
    optimum = area_fit()
    epsilon = prb.calibrate_epsilon(optimum)["y"]
    mu0, sigma0 = optimum.point["mu"], optimum.point["sigma"]
    mu, sigma = np.meshgrid(
        mu0 + np.linspace(-0.35, 0.35, 31),
        sigma0 * np.exp(np.linspace(-0.6, 0.7, 31)),
        indexing="ij",
    )
    u = (np.arange(300) + 0.5) / 300
    quantiles = mu[..., None] + sigma[..., None] * norm.ppf(u)
    rng, inside = np.random.default_rng(4), []
    for _ in range(200):
        data = np.sort(rng.normal(mu0, sigma0, N))[(u * N).astype(int)]
        distance = np.abs(quantiles - data).mean(axis=-1)
        weights = np.exp(-(distance - distance.min()) / epsilon)
        weights /= weights.sum()
        for values, truth in ((mu, mu0), (sigma, sigma0)):
            below = (
                weights[values < truth - 1e-9].sum() + weights[np.isclose(values, truth)].sum() / 2
            )
            inside.append(abs(below - 0.5) < 0.445)
    # 400 intervals of 200 data sets: standard error at most sqrt(.89 x .11 / 200) = 2.2%, and 1.6%
    # of its own; 5% is left for the linearisation at N = 50.
    assert abs(np.mean(inside) - 0.89) < 4 * 0.0275


# -- units
# -----------------------------------------------------------------------------------------------


def test_area_epsilon_has_the_units_of_the_response() -> None:
    one, ten = (prb.calibrate_epsilon(area_fit(unit))["y"] for unit in (1.0, 10.0))
    # Where the optimiser stops differs in the ninth digit, and a bisected step function magnifies
    # that.
    np.testing.assert_allclose(ten, 10 * one, rtol=0.01)


def test_residual_epsilon_scales_with_the_metric() -> None:
    optimum, _ = known_sd()
    other = prb.minimize(build(PR, Line(10.0), 10 * OBSERVED, sd=0.5))
    factor = (
        node(other.model).target.scale_factor / node(optimum.model).target.scale_factor / 10
    )  # of int (p - q)^2
    np.testing.assert_allclose(other.discrepancy, factor * optimum.discrepancy, rtol=1e-6)
    one, ten = (prb.calibrate_epsilon(o)["y"] for o in (optimum, other))
    np.testing.assert_allclose(ten, factor * one, rtol=1e-6)


@pytest.mark.long
def test_a_hyperparameter_that_the_data_do_not_touch_changes_nothing() -> None:
    for metric in (PR, AREA):
        with pm.Model() as model:
            x = pm.Normal.dist(pm.Normal("mu", 0, 2), 0.5)
            pm.Normal("idle", 0, 1)
            prb.Simulator(
                "y", Line(), x, metric=metric, observed=OBSERVED, propagation=prb.Reweighted(256)
            )
        with_idle = prb.calibrate_epsilon(prb.minimize(model, method="Nelder-Mead"))["y"]
        alone = prb.calibrate_epsilon(prb.minimize(build(metric, sd=0.5), method="Nelder-Mead"))[
            "y"
        ]
        np.testing.assert_allclose(with_idle, alone, rtol=1e-3 if metric is PR else 0.05)


# -- cost, and what it cannot do
# -------------------------------------------------------------------------


@pytest.mark.parametrize("metric", [PR, AREA])
def test_no_response_is_called_under_reweighted(metric: prb.Metric) -> None:
    response = Line()
    optimum = prb.minimize(build(metric, response), method="Nelder-Mead")
    calls, responses = response.calls, optimum.n_responses
    assert prb.calibrate_epsilon(optimum)["y"] > 0
    assert response.calls == calls
    assert node(optimum.model).bound.responses.count == responses


def test_deterministic() -> None:
    assert prb.calibrate_epsilon(area_fit()) == prb.calibrate_epsilon(area_fit())


def test_what_cannot_be_refitted_is_refused_by_name() -> None:
    own = prb.FunctionMetric(lambda z, y: np.abs(z.mean(axis=-1) - y.mean()))
    for metric, propagation, words in (
        (own, prb.Resimulated(64), "epsilon cannot be calibrated: y has a FunctionMetric"),
        (AREA, prb.Fresh(64), r"epsilon cannot be calibrated: y has prb\.Fresh"),
    ):
        model = build(metric, propagation=propagation)
        optimum = prb.minimize(model, method="Nelder-Mead", max_evaluations=5, refine=False)
        with pytest.raises(TypeError, match=words):
            prb.calibrate_epsilon(optimum)


@pytest.mark.parametrize("factor", [1.0, 1e3, 1e-3])
def test_epsilon_of_a_square_by_refits_is_twice_its_mean_gain(factor: float) -> None:
    # The squared error of the mean: H = 2 and variance sd^2 / N, whatever factor it is multiplied
    # by.
    own = prb.FunctionMetric(
        lambda z, y, w: factor * ((z * w).sum(axis=-1) - y.mean()) ** 2, weighted=True
    )
    optimum = prb.minimize(build(own, sd=0.5), starts=0)
    # A variance of 200 data sets, from their middle 89%: 12%.
    np.testing.assert_allclose(
        prb.calibrate_epsilon(optimum)["y"], factor * 2 * 0.25 / N, rtol=0.36
    )


def test_epsilon_of_an_absolute_value_by_refits() -> None:
    # |mean - observed mean|: E |delta| over the sampling distribution.
    own = prb.FunctionMetric(lambda z, y, w: np.abs((z * w).sum(-1) - y.mean()), weighted=True)
    optimum = prb.minimize(build(own, sd=0.5), starts=0)
    expected = (2 / np.pi) ** 0.5 * 0.5 / N**0.5
    np.testing.assert_allclose(prb.calibrate_epsilon(optimum)["y"], expected, rtol=0.2)


def test_something_else_than_an_optimum_is_refused() -> None:
    with pytest.raises(TypeError, match="Optimum"):
        prb.calibrate_epsilon({"mu": 1.0})  # type: ignore[arg-type]


# -- set_epsilon
# -----------------------------------------------------------------------------------------


def test_set_epsilon_changes_what_is_named_and_nothing_on_error() -> None:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu"), 1.0)
        for name in "ab":
            prb.Simulator(
                name, Line(), x, metric=AREA, observed=OBSERVED, propagation=prb.Reweighted(16)
            )

    def values() -> list[float]:
        return [n.epsilon_value for n in nodes(model).values()]

    prb.set_epsilon(model, {"b": 0.5})
    np.testing.assert_array_equal(values(), [np.nan, 0.5])
    prb.set_epsilon(model, {"a": np.float64(0.1), "b": 2})
    assert values() == [0.1, 2.0]
    for wrong, error in (
        ({"a": 0.7, "c": 1.0}, KeyError),
        ({"a": 0.7, "b": 0.0}, ValueError),
        ({"a": 0.7, "b": -1.0}, ValueError),
        ({"a": 0.7, "b": np.inf}, ValueError),
        ({"a": 0.7, "b": "wide"}, TypeError),
    ):
        with pytest.raises(error):
            prb.set_epsilon(model, wrong)  # type: ignore[arg-type]
        assert values() == [0.1, 2.0]


def test_set_epsilon_scales_the_log_density() -> None:
    model = build(AREA, sd=0.5, n=64)
    evaluator = Evaluator.of(model)
    thetas = np.array([[0.5], [1.0]])
    found = evaluator(thetas)
    for epsilon in (0.1, 0.4):
        prb.set_epsilon(model, {"y": epsilon})
        # Down where the distance is large: the sign.
        expected = -found.discrepancies[:, 0] / epsilon
        np.testing.assert_allclose(found.log_likelihood(evaluator.epsilon), expected, rtol=1e-12)
    assert found.discrepancies[0, 0] > found.discrepancies[1, 0] > 0


# -- specimens that were measured several times


def _shared(metric: prb.Metric, labels: Any, others: Any = None, observed: Any = None) -> pm.Model:
    values = np.random.default_rng(0).normal(1.0, 0.5, 30) if observed is None else observed
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1))
        for name, own in (("y", labels), ("z", others)):
            if own is not None:
                prb.Simulator(
                    name, lambda x: x, x, metric=metric, observed=values, specimens=own,
                    propagation=prb.Reweighted(256),
                )  # fmt: skip
    return model


@pytest.mark.parametrize(
    "metric", [prb.KullbackLeibler(), prb.LogLikelihood(density=prb.GaussianKDE())]
)
def test_a_likelihood_counts_specimens_and_not_observations(metric: prb.Metric) -> None:
    thrice = np.repeat(np.random.default_rng(0).normal(1.0, 0.5, 10), 3)
    model = _shared(metric, np.arange(30) // 3, observed=thrice)
    (node,) = nodes(model).values()
    assert node.epsilon_value == pytest.approx(0.1)
    assert has_default_epsilon(node)
    assert prb.calibrate_epsilon(prb.minimize(model))["y"] == pytest.approx(0.1)


@pytest.mark.long
@pytest.mark.parametrize(
    "metric",
    [
        prb.KullbackLeibler(),
        pytest.param(prb.ProbabilityResidual(), marks=pytest.mark.slow),
        pytest.param(prb.AreaMetric(), marks=pytest.mark.slow),
    ],
)
def test_two_simulators_that_say_the_same_count_once(metric: prb.Metric) -> None:
    numbers = np.arange(30)
    alone = prb.calibrate_epsilon(prb.minimize(_shared(metric, numbers)))["y"]
    twice = prb.calibrate_epsilon(prb.minimize(_shared(metric, numbers, numbers)))
    apart = prb.calibrate_epsilon(prb.minimize(_shared(metric, numbers, numbers + 30)))
    # A ratio of variances of 200 data sets.
    np.testing.assert_allclose(list(twice.values()), 2 * alone, rtol=0.15)
    np.testing.assert_allclose(list(apart.values()), alone, rtol=0.1)


def test_specimens_that_count_twice_are_warned_of(caplog: pytest.LogCaptureFixture) -> None:
    numbers = np.arange(30)
    said = "y and z share specimens, and each epsilon counts them"
    _shared(prb.KullbackLeibler(), numbers, numbers + 30)
    assert said not in caplog.text
    _shared(prb.KullbackLeibler(), numbers, numbers)
    assert said in caplog.text
