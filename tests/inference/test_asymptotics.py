"""First-order sampling distributions against closed forms, and identified directions."""

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
    identified_by_area,
    identified_by_curvature,
    local_sampling,
    number_parts,
    unidentified_directions,
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


def test_a_residual_of_correlations_sees_no_single_number() -> None:
    target = prb.MarginalCorrelation(prb.AreaMetric()).against(RNG.normal(size=(20, 3)))
    assert len(number_parts(target)) == 3


OF_FIFTY = np.random.default_rng(1).normal(1.0, 0.5, 50)
METRICS: dict[str, prb.Metric] = {
    "ll": prb.LogLikelihood(density=prb.GaussianKDE()),
    "kl": prb.KullbackLeibler(),
    "pr": prb.ProbabilityResidual(),
}
R256 = prb.Reweighted(256)


def slow(name: str) -> Any:
    return pytest.param(name, marks=pytest.mark.slow)


@pytest.mark.parametrize(
    ("unidentified", "lines"),
    [
        ([[0, 1, 0]], ["b"]),
        ([[1, -1, 0]], ["a - b"]),
        ([[1, 1, 0]], ["a + b"]),
        ([[1, -0.5, 0.05]], ["a - 0.5 b"]),  # the smallest is not mentioned
        ([[0.2, 0, -1]], ["c - 0.2 a"]),  # the largest comes first, with a plus
        ([[1, 1, 1], [1, 1, -1]], ["c", "a + b"]),  # rotated so that c stands alone
        ([[1, 0, 0], [0, 1, 0], [0, 0, 1]], ["a", "b", "c"]),
    ],
)
def test_directions_have_names(unidentified: Any, lines: list[str]) -> None:
    assert [
        sorted_signs(d)
        for d in unidentified_directions(
            np.linalg.qr(np.array(unidentified, dtype=float).T)[0], ["a", "b", "c"]
        )
    ] == lines


def sorted_signs(line: str) -> str:
    # Where two are equally large, rounding decides which comes first.
    return {"b - a": "a - b", "b + a": "a + b"}.get(line, line)


def test_rounding_errors_are_not_information() -> None:
    noise = np.diag([0.5, 1e-13])
    # Curvature and noise of the second direction are rounding errors; their ratio looks like a
    # standard error of 0.1.
    assert list(identified_by_curvature(np.diag([5.0, 3e-6]), noise)[2]) == [
        False,
        True,
    ]  # sorted by curvature
    # A direction that says a little more than the prior is seen beside one that says much more.
    assert identified_by_curvature(np.diag([500.0, 0.15]), np.diag([50.0, 0.015]))[2].all()
    # Where nothing changes, nothing is seen.
    assert not identified_by_curvature(np.zeros((2, 2)), np.zeros((2, 2)))[2].any()


@pytest.mark.parametrize("name", [slow("ll"), slow("kl"), "pr"])
def test_a_sum_hides_a_difference(name: str) -> None:
    # Both priors have the same spread, hence coefficients of one in its units; the response weighs
    # b twice.
    with pm.Model() as model:
        a, b = pm.Normal("a", 0, 1), pm.Normal("b", 0, 1, shape=1)
        x, z = pm.Normal.dist(a, 0.5), pm.Normal.dist(b[0], 0.5)
        prb.Simulator(
            "y", lambda x, z: x + 2 * z, x, z, metric=METRICS[name], observed=3 * OF_FIFTY,
            propagation=prb.Resimulated(256),
        )  # fmt: skip
    optimum = prb.minimize(model)
    (finding,) = optimum.findings
    assert finding.text.startswith(
        "The data tell less than the prior about a - 0.5 b[0] (in units of the priors'"
    )
    assert np.isinf(optimum.stderr["a"])
    assert np.isinf(optimum.stderr["b"]).all()


@pytest.mark.parametrize("n", [256, 1024])
def test_a_ridge_under_the_area_metric_is_seen_through_few_points(n: int) -> None:
    """Two sources of scatter, of which only the sum is measured: what tells them apart is the points' own error."""
    with pm.Model() as model:
        u = pm.Normal.dist(1, pm.HalfNormal("sigma", 1))
        v = pm.Normal.dist(0, pm.HalfNormal("noise", 1))
        keywords = {
            "metric": prb.AreaMetric(),
            "observed": OF_FIFTY,
            "propagation": prb.Resimulated(n),
        }
        prb.Simulator("y", lambda u, v: u + v, u, v, **keywords)
    optimum = prb.minimize(model)
    assert all(np.isinf(optimum.stderr[name]) for name in ("sigma", "noise"))
    (finding,) = optimum.findings
    assert "sigma" in finding.text
    assert "noise" in finding.text


def test_what_is_seen_under_the_area_metric_is_seen_through_few_points_as_well() -> None:
    with pm.Model() as model:
        u = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1))
        v = pm.Normal.dist(0, 0.2)
        keywords = {
            "metric": prb.AreaMetric(),
            "observed": OF_FIFTY,
            "propagation": prb.Resimulated(256),
        }
        prb.Simulator("y", lambda u, v: u + v, u, v, **keywords)
    optimum = prb.minimize(model)
    assert all(np.isfinite(optimum.stderr[name]) for name in ("mu", "sigma"))
    assert optimum.findings == ()


def test_a_standard_error_of_the_priors_spread_is_the_limit() -> None:
    # H = 1: the standard error is the root of J.
    hessian = np.eye(2)
    noise = np.diag([0.9, 1.1])
    assert sorted(identified_by_curvature(hessian, noise)[2]) == [False, True]
    assert identified_by_curvature(hessian, noise, weakest=1.1)[2].all()
    assert not identified_by_curvature(hessian, noise, weakest=0.9)[2].any()


def test_turned_matrices_have_turned_directions() -> None:
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    hessian = turn @ np.diag([1.0, 9.0]) @ turn.T
    noise = turn @ np.diag([4.0, 4.0]) @ turn.T
    values, vectors, seen = identified_by_curvature(hessian, noise)
    np.testing.assert_allclose(values, [1.0, 9.0])
    np.testing.assert_allclose(np.abs(vectors.T @ turn), np.eye(2), atol=1e-12)
    assert list(seen) == [False, True]


def test_what_is_looked_at_stays_when_the_design_grows() -> None:
    """Populations around an optimum are those of the design as it was."""
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1))
        y = pm.Normal.dist(pm.Normal("nu", 0, 2), 0.5)
        prb.Simulator(
            "y", lambda x, y: x + y, x, y, metric=prb.AreaMetric(), observed=OF_FIFTY,
            propagation=prb.Reweighted(1024, emulator=None),
        )  # fmt: skip
    evaluator = Evaluator.of(model)
    theta = evaluator.hyperparameters.initial
    information = Information(evaluator, 0, theta, n_sets=20)
    before = identified_by_area(information)
    (bound,) = evaluator.reweighted.values()
    bound.add([np.atleast_1d(values) for values in evaluator.roots(theta[None], 0)], 512)
    assert bound.n_points == 1536
    np.testing.assert_array_equal(identified_by_area(information), before)
