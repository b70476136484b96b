"""The Hessian and the covariance of the gradient against closed forms."""

from functools import cache
from typing import Any

import numpy as np
import pymc as pm
import pytest
from scipy.integrate import quad
from scipy.stats import norm

import prbayes as prb
from prbayes.inference.asymptotics import Information, local_sampling
from prbayes.model.evaluator import Evaluator

OBSERVED = np.random.default_rng(1).normal(1.0, 0.5, 50)
N = OBSERVED.size
KL, PR, AREA = prb.KullbackLeibler(), prb.ProbabilityResidual(), prb.AreaMetric()
R256 = prb.Reweighted(256)
# Where the models of the tests are looked at: their mean, and the logarithm of their spread.
MEAN, SPREAD = 1.0, 0.5


@cache
def known_sd(metric: prb.Metric, propagation: Any = R256, **keywords: Any) -> Information:
    """Return the information about a normal mean of known spread."""
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), SPREAD)
        prb.Simulator(
            "y", np.positive, x, metric=metric, observed=OBSERVED, propagation=propagation
        )
    return Information(Evaluator.of(model), 0, np.array([MEAN]), **keywords)


@cache
def mean_and_sd(metric: prb.Metric) -> Information:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1))
        prb.Simulator("y", np.positive, x, metric=metric, observed=OBSERVED, propagation=R256)
    return Information(Evaluator.of(model), 0, np.array([MEAN, np.log(SPREAD)]))


def drawn(information: Information) -> tuple[Any, Any]:
    """Return the values and weights of the simulated data sets."""
    return information.data_sets.values[0], information.data_sets.weights[0]


def closed_form(h: float, s: float, factor: float) -> tuple[float, float]:
    """H and J of the residual of a normal mean with known sd s, from Gaussian integrals.

    d(mu) = S int (p - q)^2 with p = N(mu, v), v = s^2 + h^2, and q a mean of kernels of variance
    h^2. Against the population itself, H = 2 S int (dp/dmu)^2. For one observation z the gradient
    is -2 S d/dmu N(z; mu, w) plus a constant, w = v + h^2; J is its variance over N(mu, s^2),
    divided by N.
    """
    v, w = s**2 + h**2, s**2 + 2 * h**2
    curvature = factor / (2 * np.sqrt(np.pi) * v**1.5)
    u = 1 / (2 / w + 1 / s**2)  # variance of the product of N(z; mu, w)^2 and N(z; mu, s^2)
    mean_square = 1 / (2 * np.sqrt(np.pi * w)) / np.sqrt(2 * np.pi * (w / 2 + s**2)) * u / w**2
    return float(curvature), float(4 * factor**2 * mean_square / N)


def test_the_closed_form_is_right() -> None:
    # By quadrature, without any of the algebra.
    h, s, factor = 0.3, 0.5, 100.0
    v, w = s**2 + h**2, s**2 + 2 * h**2
    slope = lambda z, variance: z / variance * norm.pdf(z, scale=variance**0.5)  # noqa: E731
    curvature = 2 * factor * quad(lambda z: slope(z, v) ** 2, -10, 10)[0]
    noise = 4 * factor**2 * quad(lambda z: slope(z, w) ** 2 * norm.pdf(z, scale=s), -10, 10)[0] / N
    np.testing.assert_allclose(closed_form(h, s, factor), (curvature, noise), rtol=1e-7)


@pytest.mark.parametrize("propagation", [R256, prb.Resimulated(1024)])
def test_sandwich_of_a_normal_mean(propagation: Any) -> None:
    information = known_sd(PR, propagation)
    target = information.node.target
    hessian, noise = closed_form(target.cells.bandwidth, SPREAD, target.scale_factor)
    np.testing.assert_allclose(information.hessian, [[hessian]], rtol=2e-3)
    np.testing.assert_allclose(information.sampling_covariance, [[noise]], rtol=5e-3)
    # Simulated data sets say the same: 200 of them give a variance with a relative standard error
    # of 10%, and a mean gradient of zero.
    gradients = information.gradients(*drawn(information))
    np.testing.assert_allclose(np.var(gradients, ddof=1), noise, rtol=0.4)
    assert abs(gradients.mean()) < 4 * (noise / 200) ** 0.5


def test_the_sandwich_of_the_sample_mean() -> None:
    # Of a likelihood whose normal density is wider than the population by the bandwidth: H = 1 / v
    # and J = s^2 / v^2 / N. What is wrong with the width cancels, s^2 / N is left.
    information = known_sd(KL)
    v = SPREAD**2 + information.node.target.cells.bandwidth**2
    hessian, noise = information.hessian[0, 0], information.sampling_covariance[0, 0]
    np.testing.assert_allclose(hessian, 1 / v, rtol=0.01)
    np.testing.assert_allclose(noise, SPREAD**2 / v**2 / N, rtol=0.01)
    np.testing.assert_allclose(noise / hessian**2, SPREAD**2 / N, rtol=0.01)


def test_the_gradient_points_away_from_the_data() -> None:
    # Towards smaller discrepancies theta follows the observations: up for one far above it.
    information = known_sd(KL)
    gradients = information.gradients(np.array([0.0, 2.0]), np.eye(2))
    np.testing.assert_array_equal(np.sign(gradients), [[1.0], [-1.0]])


def test_data_sets_are_drawn_at_theta() -> None:
    # Neither from the prior, whose spread is 2, nor from the observed responses.
    for information in (known_sd(KL), known_sd(AREA, prb.Resimulated(1024))):
        values, weights = drawn(information)
        means = weights @ values
        assert abs(means.mean() - MEAN) < 4 * SPREAD / (N * 200) ** 0.5
        np.testing.assert_allclose(means.std(), SPREAD / N**0.5, rtol=0.2)


def test_mean_and_spread_of_a_normal_population_are_orthogonal() -> None:
    information = mean_and_sd(KL)
    for matrix in (information.hessian, information.sampling_covariance):
        np.testing.assert_allclose(matrix, matrix.T, rtol=1e-12)
        unit = np.sqrt(np.diag(matrix))
        assert abs(matrix / np.outer(unit, unit))[0, 1] < 0.05
    # Of log sigma the estimator's variance is 1 / (2 N), somewhat more through a wide density.
    inverse = np.linalg.inv(information.hessian)
    covariance = inverse @ information.sampling_covariance @ inverse
    assert 0.9 / (2 * N) < covariance[1, 1] < 1.5 / (2 * N)


def test_the_area_is_linear_in_a_shift_of_the_population() -> None:
    # dF / dmu = -f: the slopes add up to minus the shift of the mean.
    (area,) = mean_and_sd(AREA).areas(mean_and_sd(AREA).data_sets)
    np.testing.assert_allclose(area.slopes[0] @ area.lengths, -1, rtol=0.02)
    # And of one interval's gap, the distance between data set and population is the sum.
    floor = mean_and_sd(AREA).noise_floor
    distances = np.abs(area.gaps) @ area.lengths
    np.testing.assert_allclose(distances.mean(), floor, rtol=0.02)


def test_noise_floor_of_the_area_metric_is_the_expected_distance_at_the_truth() -> None:
    floor = mean_and_sd(AREA).noise_floor
    rng, u = np.random.default_rng(3), (np.arange(2000) + 0.5) / 2000
    quantiles = norm.ppf(u, MEAN, SPREAD)
    data = np.sort(rng.normal(MEAN, SPREAD, (1000, N)), axis=1)
    distances = np.abs(data[:, (u * N).astype(int)] - quantiles).mean(axis=1)
    error = distances.std() * (1 / 200 + 1 / 1000) ** 0.5
    assert abs(floor - distances.mean()) < 4 * error


@pytest.mark.long
@pytest.mark.parametrize("metric", [prb.ProbabilityResidual(), prb.AreaMetric()])
def test_a_prior_however_wide_leaves_standard_errors_as_they_are(metric: prb.Metric) -> None:
    """A difference over a share of the prior would step over the population."""

    def error(spread: float) -> float:
        observed = np.random.default_rng(0).normal(1.0, 0.5, 30)
        with pm.Model() as model:
            x = pm.Normal.dist(pm.Normal("mu", 0, spread), 0.5)
            prb.Simulator(
                "y", lambda x: x, x, metric=metric, observed=observed,
                propagation=prb.Resimulated(256),
            )  # fmt: skip
        return float(prb.minimize(model).stderr["mu"])

    ordinary = error(2.0)
    for spread in (200.0, 2e4):
        assert error(spread) == pytest.approx(ordinary, rel=0.1)


def test_one_prior_however_wide_leaves_the_other_s_error_as_it_is() -> None:
    def errors(spread: float) -> list[float]:
        with pm.Model() as model:
            x = pm.Normal.dist(pm.Normal("mu", 0, spread), pm.HalfNormal("sigma", 1))
            prb.Simulator(
                "y", lambda x: x, x, metric=AREA, observed=OBSERVED,
                propagation=prb.Resimulated(512),
            )  # fmt: skip
        information = Information(Evaluator.of(model), 0, np.array([MEAN, np.log(SPREAD)]))
        covariance = local_sampling([information], np.ones(1)).in_theta
        return list(np.sqrt(np.diag(covariance)))

    # The steps of the differences are other ones, so these are not the same to the last digit.
    assert errors(1e6) == pytest.approx(errors(2.0), rel=0.1)


def test_points_that_no_population_reaches_tell_nothing_of_it() -> None:
    information = known_sd(AREA)
    nowhere = np.zeros(256, dtype=bool)
    (found,) = information.areas(information.data_sets, nowhere)
    assert (found.slopes == 0).all()
    assert (found.gaps <= 0).all()


NARROW = prb.GaussianKDE(0.15)


@pytest.mark.parametrize(
    "metric",
    [
        prb.LogLikelihood(density=NARROW),
        prb.KullbackLeibler(NARROW),
        prb.ProbabilityResidual(NARROW),
    ],
    ids=["ll", "kl", "pr"],
)
def test_responses_beyond_the_grid_leave_the_curvature_as_it_is(metric: prb.Metric) -> None:
    """Two of a hundred are there; within a step of the differences some pass its end."""
    spread = 0.8

    def information(propagation: Any) -> Information:
        observed = 1 + 0.5 * norm.ppf((np.arange(15) + 0.5) / 15)
        with pm.Model() as model:
            x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1))
            prb.Simulator(
                "y", np.positive, x, metric=metric, observed=observed, propagation=propagation
            )
        return Information(Evaluator.of(model), 0, np.array([1.0, np.log(spread)]))

    moved = information(prb.Resimulated(2048))
    weighed = information(prb.Reweighted(1024))
    size = 0.05 * np.abs(weighed.hessian).max()
    np.testing.assert_allclose(moved.hessian, weighed.hessian, atol=size)
    size = 0.05 * np.abs(weighed.sampling_covariance).max()
    np.testing.assert_allclose(moved.sampling_covariance, weighed.sampling_covariance, atol=size)
    if metric.likelihood:
        # Of a normal population, which the kernel widens by a few per cent.
        of_a_normal = np.diag([1 / spread**2, 2.0])
        np.testing.assert_allclose(moved.hessian, of_a_normal, atol=0.3)


def test_noise_of_gradients_with_tails_is_that_of_the_whole_population() -> None:
    # Of two outputs one of which is a square, where a few specimens have most of the mean square:
    # a thousand of them taken evenly scatter by a tenth and more.
    with pm.Model() as model:
        mu, sigma = pm.Normal("mu", 0.0, 1.0), pm.HalfNormal("sigma", 1.0)
        x, z = pm.Normal.dist(mu, sigma), pm.Normal.dist(0.0, 1.0)
        observed = np.random.default_rng(0).normal(size=(N, 2))
        prb.Simulator(
            *("y", lambda x, z: np.stack([x + x**2, z * x], axis=-1), x, z),
            metric=prb.Joint(KL),
            observed=observed,
            propagation=prb.Reweighted(4096, emulator=None),
            progressbar=False,
        )
    evaluator = Evaluator.of(model)
    information = Information(evaluator, 0, np.array([0.3, -0.5]))
    values, weights = information._sides[1:]
    batches = [slice(i, i + 64) for i in range(0, len(values), 64)]
    each = [information.gradients(values[b], np.eye(len(values[b]))) for b in batches]
    noise = np.cov(np.concatenate(each), rowvar=False, aweights=weights)
    size = np.sqrt(np.diag(noise))
    found = information.sampling_covariance * information.node.target.n_effective
    np.testing.assert_allclose(
        found / np.outer(size, size), noise / np.outer(size, size), atol=0.02
    )
