"""First-order sampling distributions against closed forms."""

from typing import Any

import numpy as np
import pymc as pm
import pytest

import prbayes as prb
from prbayes._validate import Floats
from prbayes.inference.asymptotics import (
    Information,
    Local,
    first_order_shifts,
    local_sampling,
    number_parts,
    one_dimensional,
)
from prbayes.inference.resampling import DataSets
from prbayes.model.evaluator import Evaluator

OBSERVED = np.random.default_rng(1).normal(1.0, 0.5, 60)
N = OBSERVED.size
SPREAD = 0.5
KL, AREA = prb.KullbackLeibler(), prb.AreaMetric()


def normal_means(metric: prb.Metric, n: int = 1, **keywords: Any) -> list[Information]:
    """Return the information of n simulators of one normal population about its mean."""
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), SPREAD)
        for k in range(n):
            prb.Simulator(
                f"y{k}",
                np.positive,
                x,
                metric=metric,
                observed=OBSERVED,
                propagation=prb.Reweighted(256),
                **keywords,
            )
    evaluator = Evaluator.of(model)
    return [Information(evaluator, k, np.array([1.0])) for k in range(n)]


def variance(information: list[Information], scales: Floats) -> float:
    return float(local_sampling(information, scales).in_theta[0, 0])


def test_the_standard_error_of_the_mean_of_n_normals() -> None:
    assert variance(normal_means(KL), np.ones(1)) == pytest.approx(SPREAD**2 / N, rel=0.01)


def test_a_scale_of_one_simulator_changes_nothing() -> None:
    information = normal_means(KL)
    one, other = (variance(information, np.array([scale])) for scale in (1.0, 7.0))
    assert one == pytest.approx(other, rel=1e-10)


def test_two_simulators_of_independent_specimens_halve_the_variance() -> None:
    information = normal_means(KL, 2)
    half = SPREAD**2 / N / 2
    assert variance(information, np.ones(2)) == pytest.approx(half, rel=0.01)
    # Weighed 4 to 1 it is that of a weighted mean; a simulator of no weight counts for nothing.
    weighed = variance(information, np.array([1.0, 4.0]))
    assert weighed == pytest.approx(2 * half * (0.8**2 + 0.2**2), rel=0.01)
    alone = variance(information, np.array([1.0, 1e9]))
    assert alone == pytest.approx(2 * half, rel=0.01)


def test_two_simulators_of_the_same_specimens_know_no_more_than_one() -> None:
    information = normal_means(KL, 2, specimens=np.arange(N))
    # From 200 data sets: a variance with a relative standard error of 10%.
    assert variance(information, np.ones(2)) == pytest.approx(SPREAD**2 / N, rel=0.4)


def shifted_data() -> tuple[DataSets, Floats]:
    """Return data sets of the observed responses, one shifted up and one down, and their means."""
    values = np.concatenate([OBSERVED + 0.05, OBSERVED - 0.05])
    half = np.full(N, 1 / N)
    nothing = np.zeros(N)
    weights = np.array([np.concatenate([half, nothing]), np.concatenate([nothing, half])])
    return DataSets([values], [weights]), weights @ values


def test_the_minimiser_of_a_likelihood_follows_the_mean_of_the_data() -> None:
    information = normal_means(KL)
    sets, means = shifted_data()
    shifts = first_order_shifts(information, np.ones(1), np.eye(1), sets)
    found = 1.0 + shifts[:, 0] * information[0].prior_sd[0]
    # A wide density follows all of the way: gradient and Hessian have the same width.
    np.testing.assert_allclose(found, means, atol=0.005)


def test_the_minimiser_of_an_area_follows_the_data() -> None:
    information = normal_means(AREA)
    sets, _ = shifted_data()
    shifts = first_order_shifts(information, np.ones(1), np.eye(1), sets)
    up, down = shifts[:, 0] * information[0].prior_sd[0]
    np.testing.assert_allclose(up - down, 0.1, rtol=0.3)


def test_the_area_is_a_little_less_precise_than_the_mean() -> None:
    found = variance(normal_means(AREA), np.ones(1))
    assert 0.85 < found / (SPREAD**2 / N) < 1.6


def test_a_covariance_has_the_axes_of_its_directions() -> None:
    # 4 along (0.6, 0.8), in priors' spreads of 1 and 10.
    direction = np.array([[0.6], [0.8]])
    across = np.array([[-0.8], [0.6]])
    both = np.hstack([direction, across])
    local = Local(np.array([1.0, 10.0]), both, np.zeros((2, 0)), np.diag([4.0, 1.0]))
    expected = both @ np.diag([4.0, 1.0]) @ both.T * [[1, 10], [10, 100]]
    assert expected[0, 1] == pytest.approx(10 * (4 - 1) * 0.48)
    np.testing.assert_allclose(local.in_theta, expected)


def test_what_is_not_identified_has_no_finite_error() -> None:
    local = Local(np.ones(2), np.eye(2)[:, :1], np.eye(2)[:, 1:], np.eye(1))
    np.testing.assert_array_equal(local.in_theta, [[1.0, np.inf], [np.inf, np.inf]])


@pytest.mark.parametrize("metric", [KL, AREA], ids=["kl", "area"])
def test_of_a_sum_of_two_means_only_the_sum_is_identified(metric: prb.Metric) -> None:
    with pm.Model() as model:
        total = pm.Normal("a", 0, 1) + pm.Normal("b", 0, 1)
        x = pm.Normal.dist(total, SPREAD)
        prb.Simulator(
            "y",
            np.positive,
            x,
            metric=metric,
            observed=OBSERVED,
            propagation=prb.Reweighted(256),
        )
    information = [Information(Evaluator.of(model), 0, np.array([0.5, 0.5]))]
    local = local_sampling(information, np.ones(1))
    sd = information[0].prior_sd
    # The gradient of a + b in units of the priors' spreads; what is orthogonal to it is not seen.
    along = sd / np.linalg.norm(sd)
    np.testing.assert_allclose(abs(local.identified.T @ along), [1.0], atol=1e-3)
    assert np.isinf(local.in_theta).all()
    # The sum has the standard error of a mean.
    variance_of_sum = local.covariance[0, 0] * (sd @ sd)
    assert variance_of_sum == pytest.approx(SPREAD**2 / N, rel=0.02 if metric is KL else 0.6)


def test_the_variance_of_functions_agrees_with_that_of_elements() -> None:
    prior_sd = np.array([2.0, 0.5])
    covariance = np.array([[0.04, 0.01], [0.01, 0.09]])
    local = Local(prior_sd, np.eye(2), np.empty((2, 0)), covariance)
    gradients = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, -2.0], [0.0, 0.0]])
    expected = np.einsum("ki,ij,kj->k", gradients, local.in_theta, gradients)
    np.testing.assert_allclose(local.variance(gradients), expected)


def test_the_variance_of_a_function_across_what_is_identified_is_infinite() -> None:
    direction = np.array([[0.6], [0.8]])
    local = Local(np.ones(2), direction, np.array([[-0.8], [0.6]]), np.array([[0.25]]))
    found = local.variance(np.array([[0.6, 0.8], [1.0, 0.0], [-0.8, 0.6]]))
    np.testing.assert_allclose(found, [0.25, np.inf, np.inf])


# -- parts that see one number of a specimen --

RNG = np.random.default_rng(1)


def test_a_metric_of_one_output_sees_the_responses_themselves() -> None:
    target = prb.AreaMetric().against(RNG.normal(size=20))
    values = RNG.normal(size=(3, 50))
    (seen,) = one_dimensional(target, values)
    assert seen is values


def test_a_joint_metric_sees_a_number_in_each_direction() -> None:
    target = prb.Joint(prb.AreaMetric(), directions=5).against(RNG.normal(size=(20, 2)))
    values = RNG.normal(size=(3, 50, 2))
    seen = one_dimensional(target, values)
    assert [numbers.shape for numbers in seen] == [(3, 50)] * 5


def test_a_residual_of_correlations_sees_no_single_number() -> None:
    target = prb.MarginalCorrelation(prb.AreaMetric()).against(RNG.normal(size=(20, 3)))
    assert len(number_parts(target)) == 3
