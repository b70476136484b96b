"""Sampling distributions to first order: closed forms, areas, and identified directions."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pymc as pm
import pytest
from four_metrics import METRICS, R256, same
from one_input import one_input
from scipy.integrate import quad
from scipy.stats import norm

import prbayes as prb
from prbayes._validate import Floats
from prbayes.inference.asymptotics import (
    Information,
    Local,
    identified_by_area,
    identified_by_curvature,
    local_sampling,
    oriented,
    unidentified_directions,
)
from prbayes.inference.checks.identification import unidentified_findings
from prbayes.metrics.area import with_unbiased_areas
from prbayes.model.evaluator import Evaluator

OBSERVED = np.random.default_rng(1).normal(1.0, 0.5, 50)
N, MEAN, SPREAD = OBSERVED.size, 1.0, 0.5
KL, PR, AREA = METRICS["kl"], METRICS["pr"], METRICS["area"]


def information(model: pm.Model, *theta: float) -> list[Information]:
    evaluator = Evaluator.of(model)
    return [Information(evaluator, k, np.array(theta)) for k in range(len(evaluator.nodes))]


@cache
def of_a_mean(metric: prb.Metric, propagation: Any = R256) -> Information:
    """Return the information about a normal mean of known spread."""
    return information(one_input(OBSERVED, metric, propagation, same, sd=SPREAD), MEAN)[0]


def of_both(
    metric: prb.Metric,
    propagation: Any = R256,
    prior: float = 2.0,
    observed: Floats = OBSERVED,
    spread: float = SPREAD,
) -> Information:
    """Return the information about a normal mean and the logarithm of the spread."""
    model = one_input(observed, metric, propagation, same, mu=(0, prior))
    return information(model, MEAN, np.log(spread))[0]


def drawn(item: Information) -> tuple[Any, Any]:
    """Return the values and weights of the simulated data sets."""
    return item.data_sets.values[0], item.data_sets.weights[0]


def variance(items: list[Information], *scales: float) -> float:
    return float(local_sampling(items, np.array(scales)).in_theta[0, 0])


# -- Hessian and noise of the gradient -------------------------------------------------------------


def exact(h: float, s: float, factor: float) -> tuple[float, float]:
    """H and J of the residual of a normal mean with known sd s, by integrals.

    d(mu) = S int (p - q)^2 with p = N(mu, v), v = s^2 + h^2, and q a mean of kernels of variance
    h^2. Against the population itself, H = 2 S int (dp/dmu)^2. For one observation z the gradient
    is -2 S d/dmu N(z; mu, w) plus a constant, w = v + h^2; J is its variance over N(mu, s^2),
    divided by N.
    """
    v, w = s**2 + h**2, s**2 + 2 * h**2
    slope = lambda z, variance: z / variance * norm.pdf(z, scale=variance**0.5)  # noqa: E731
    curvature = 2 * factor * quad(lambda z: slope(z, v) ** 2, -10, 10)[0]
    noise = 4 * factor**2 * quad(lambda z: slope(z, w) ** 2 * norm.pdf(z, scale=s), -10, 10)[0] / N
    return curvature, noise


@pytest.mark.parametrize("propagation", [R256, prb.Resimulated(1024)])
def test_sandwich_of_a_normal_mean(propagation: Any) -> None:
    item = of_a_mean(PR, propagation)
    target = item.node.target
    hessian, noise = exact(target.cells.bandwidth, SPREAD, target.scale_factor)
    np.testing.assert_allclose(item.hessian, [[hessian]], rtol=2e-3)
    np.testing.assert_allclose(item.sampling_covariance, [[noise]], rtol=5e-3)
    # A variance of 200 simulated data sets has a relative standard error of 10%.
    gradients = item.gradients(*drawn(item))
    np.testing.assert_allclose(np.var(gradients, ddof=1), noise, rtol=0.4)
    assert abs(gradients.mean()) < 4 * (noise / 200) ** 0.5


def test_the_sandwich_of_the_sample_mean() -> None:
    # Of a likelihood whose normal density is wider than the population by the bandwidth: H = 1 / v
    # and J = s^2 / v^2 / N. The error of the width cancels: s^2 / N is left.
    item = of_a_mean(KL)
    v = SPREAD**2 + item.node.target.cells.bandwidth**2
    np.testing.assert_allclose(item.hessian, 1 / v, rtol=0.01)
    np.testing.assert_allclose(item.sampling_covariance, SPREAD**2 / v**2 / N, rtol=0.01)
    for scale in (1.0, 7.0):
        assert variance([item], scale) == pytest.approx(SPREAD**2 / N, rel=0.01)
    # Towards smaller discrepancies theta follows the observations.
    gradients = item.gradients(np.array([0.0, 2.0]), np.eye(2))
    np.testing.assert_array_equal(np.sign(gradients), [[1.0], [-1.0]])


def test_the_area_is_linear_in_a_shift_of_the_population() -> None:
    # dF / dmu = -f: the slopes add up to minus the shift of the mean.
    item = of_both(AREA)
    (area,) = item.areas(item.data_sets)
    np.testing.assert_allclose(area.slopes[0] @ area.lengths, -1, rtol=0.02)
    np.testing.assert_allclose(area.of_sets().mean(), item.noise_floor, rtol=0.02)
    # The noise floor is the expected distance at the truth.
    rng, u = np.random.default_rng(3), (np.arange(2000) + 0.5) / 2000
    data = np.sort(rng.normal(MEAN, SPREAD, (1000, N)), axis=1)
    distances = np.abs(data[:, (u * N).astype(int)] - norm.ppf(u, MEAN, SPREAD)).mean(axis=1)
    error = distances.std() * (1 / 200 + 1 / 1000) ** 0.5
    assert abs(item.noise_floor - distances.mean()) < 4 * error
    # Points that no population reaches have no slope.
    (area,) = item.areas(item.data_sets, np.zeros(256, dtype=bool))
    assert (area.slopes == 0).all()
    assert (area.gaps <= 0).all()


def test_the_areas_of_data_sets_have_the_correction_for_few_specimens() -> None:
    item = of_both(AREA, observed=OBSERVED[:6])
    target = with_unbiased_areas(item.node.target)
    nodes = (replace(item.node, target=target),)
    corrected = replace(item, evaluator=replace(item.evaluator, nodes=nodes))
    (area,) = corrected.areas_of_sets
    assert area.of_sets().mean() < 0.9 * item.areas_of_sets[0].of_sets().mean()
    assert area.of_sets().mean() == pytest.approx(corrected.noise_floor, rel=0.05)


@pytest.mark.parametrize("metric", [PR, AREA], ids=["pr", "area"])
def test_a_prior_however_wide_leaves_standard_errors_as_they_are(metric: prb.Metric) -> None:
    """A difference over a share of the prior would step over the population."""
    few = prb.Resimulated(512)
    ordinary, wide, wider = (
        np.diag(local_sampling([of_both(metric, few, spread)], np.ones(1)).in_theta)
        for spread in (2.0, 200.0, 1e6)
    )
    np.testing.assert_allclose(np.sqrt([wide, wider]), np.sqrt([ordinary] * 2), rtol=0.1)


NARROW = prb.GaussianKDE(0.15)


@pytest.mark.parametrize(
    "metric",
    [prb.LogLikelihood(density=NARROW), prb.ProbabilityResidual(NARROW)],
    ids=["ll", "pr"],
)
def test_responses_beyond_the_grid_leave_the_curvature_as_it_is(metric: prb.Metric) -> None:
    """Two of a hundred are there; within a step of the differences some pass its end."""
    observed = 1 + 0.5 * norm.ppf((np.arange(15) + 0.5) / 15)
    moved, weighed = (
        of_both(metric, propagation, observed=observed, spread=0.8)
        for propagation in (prb.Resimulated(2048), prb.Reweighted(1024))
    )
    for name in ("hessian", "sampling_covariance"):
        expected = getattr(weighed, name)
        size = 0.05 * np.abs(expected).max()
        np.testing.assert_allclose(getattr(moved, name), expected, atol=size)
    if metric.likelihood:
        # Of a normal population, which the kernel widens by a few per cent.
        np.testing.assert_allclose(moved.hessian, np.diag([1 / 0.8**2, 2.0]), atol=0.3)


def test_noise_of_gradients_with_tails_is_that_of_the_whole_population() -> None:
    # Of two outputs one of which is a square, where a few specimens have most of the mean square:
    # a thousand of them taken evenly scatter by a tenth and more.
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0.0, 1.0), pm.HalfNormal("sigma", 1.0))
        prb.Simulator(
            *("y", lambda x, z: np.stack([x + x**2, z * x], axis=-1), x, pm.Normal.dist(0.0, 1.0)),
            metric=prb.Joint(KL),
            observed=np.random.default_rng(0).normal(size=(N, 2)),
            propagation=prb.Reweighted(4096, emulator=None),
        )
    (item,) = information(model, 0.3, -0.5)
    _, values, weights = item._sides
    batches = [slice(i, i + 64) for i in range(0, len(values), 64)]
    gradients = [item.gradients(values[b], np.eye(len(values[b]))) for b in batches]
    noise = np.cov(np.concatenate(gradients), rowvar=False, aweights=weights)
    unit = np.outer(*2 * [np.sqrt(np.diag(noise))])
    sampled = item.sampling_covariance * item.node.target.n_effective
    np.testing.assert_allclose(sampled / unit, noise / unit, atol=0.02)


# -- sampling distributions ------------------------------------------------------------------------


def test_a_covariance_has_the_axes_of_its_directions() -> None:
    # 4 along (0.6, 0.8), in priors' spreads of 1 and 10.
    both = np.array([[0.6, -0.8], [0.8, 0.6]])
    local = Local(np.array([1.0, 10.0]), both, np.zeros((2, 0)), np.diag([4.0, 1.0]))
    expected = both @ np.diag([4.0, 1.0]) @ both.T * [[1, 10], [10, 100]]
    assert expected[0, 1] == pytest.approx(10 * (4 - 1) * 0.48)
    np.testing.assert_allclose(local.in_theta, expected)
    gradients = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, -2.0], [0.0, 0.0]])
    variances = np.einsum("ki,ij,kj->k", gradients, expected, gradients)
    np.testing.assert_allclose(local.variance(gradients), variances, atol=1e-12)


def test_unidentified_elements_and_functions_have_no_finite_error() -> None:
    local = Local(np.ones(2), np.eye(2)[:, :1], np.eye(2)[:, 1:], np.eye(1))
    np.testing.assert_array_equal(local.in_theta, [[1.0, np.inf], [np.inf, np.inf]])
    local = Local(np.ones(2), np.array([[0.6], [0.8]]), np.array([[-0.8], [0.6]]), np.eye(1) / 4)
    variances = local.variance(np.array([[0.6, 0.8], [1.0, 0.0], [-0.8, 0.6]]))
    np.testing.assert_allclose(variances, [0.25, np.inf, np.inf])


# -- identified directions -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("unidentified", "names"),
    [
        ([[0, 1, 0]], ["b"]),
        ([[1, -1, 0]], ["a - b"]),
        ([[1, 1, 0]], ["a + b"]),
        ([[1, -0.5, 0.05]], ["a - 0.5 b"]),  # the smallest is not mentioned
        ([[0.2, 0, -1]], ["c - 0.2 a"]),  # the largest comes first, with a plus
        ([[1, 1, 1], [1, 1, -1]], ["c", "a + b"]),  # rotated so that c is alone
        ([[1, 0, 0], [0, 1, 0], [0, 0, 1]], ["a", "b", "c"]),
        (np.zeros((0, 3)), []),
    ],
)
def test_directions_have_names(unidentified: Any, names: list[str]) -> None:
    axes = np.linalg.qr(np.array(unidentified, dtype=float).T)[0]
    # Where two are equally large, rounding decides which comes first.
    either = {"b - a": "a - b", "b + a": "a + b"}
    assert [either.get(d, d) for d in unidentified_directions(axes, ["a", "b", "c"])] == names


@pytest.mark.parametrize(
    ("hessian", "noise", "weakest", "identified"),
    [
        # Curvature and noise of the second direction are rounding errors.
        ([5.0, 3e-6], [0.5, 1e-13], 1.0, [False, True]),
        # A direction that says a little more than the prior, beside one that says much more.
        ([500.0, 0.15], [50.0, 0.015], 1.0, [True, True]),
        ([0.0, 0.0], [0.0, 0.0], 1.0, [False, False]),
        ([-1.0, -1.0], [0.01, 0.01], 1.0, [False, False]),  # a maximum
        # H = 1: the standard error is the root of J, and the prior's spread is the limit.
        ([1.0, 1.0 + 1e-9], [1.1, 0.9], 1.0, [False, True]),
        ([1.0, 1.0], [0.9, 1.1], 1.1, [True, True]),
        ([1.0, 1.0], [0.9, 1.1], 0.9, [False, False]),
    ],
)
def test_directions_are_identified_by_curvature_and_noise(
    hessian: Any, noise: Any, weakest: float, identified: list[bool]
) -> None:
    assert list(identified_by_curvature(np.diag(hessian), np.diag(noise), weakest)[2]) == identified


def test_turned_matrices_have_turned_directions() -> None:
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    hessian = turn @ np.diag([1.0, 9.0]) @ turn.T
    values, vectors, is_identified = identified_by_curvature(hessian, 4 * turn @ turn.T)
    np.testing.assert_allclose(values, [1.0, 9.0])
    np.testing.assert_allclose(np.abs(vectors.T @ turn), np.eye(2), atol=1e-12)
    assert list(is_identified) == [False, True]
    # Signs of axes do not matter.
    axes, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(5, 3)))
    turned = oriented(axes * np.array([1.0, -1.0, -1.0]))
    np.testing.assert_array_equal(turned, oriented(axes))
    np.testing.assert_array_equal(np.abs(turned), np.abs(axes))


@pytest.mark.parametrize("name", ["kl", "pr"])
def test_a_sum_hides_a_difference(name: str) -> None:
    # Both priors have the same spread, hence coefficients of one in its units; the response weighs
    # b twice.
    with pm.Model() as model:
        a, b = pm.Normal("a", 0, 1), pm.Normal("b", 0, 1, shape=1)
        inputs = pm.Normal.dist(a, 0.5), pm.Normal.dist(b[0], 0.5)
        data = {"observed": 3 * OBSERVED, "propagation": prb.Resimulated(256)}
        prb.Simulator("y", lambda x, z: x + 2 * z, *inputs, metric=METRICS[name], **data)
    local = local_sampling(information(model, 1.0, 1.0), np.ones(1))
    assert np.isinf(local.in_theta).all()
    (finding,) = unidentified_findings(Evaluator.of(model), local)
    text = "less informative than the prior about a - 0.5 b[0] (in units of the priors'"
    assert text in finding.text
    assert unidentified_findings(Evaluator.of(model), local, {"a - 0.5 b[0]"}) == []


@pytest.mark.parametrize("n", [256, None])
def test_few_points_identify_under_the_area_metric_what_many_do(n: int | None) -> None:
    """Of two sources of scatter only the sum is measured, unless one is known (n is None)."""
    with pm.Model() as model:
        mu = pm.Normal("mu", 0, 2) if n is None else 1.0
        u = pm.Normal.dist(mu, pm.HalfNormal("sigma", 1))
        v = pm.Normal.dist(0, 0.2 if n is None else pm.HalfNormal("noise", 1))
        data = {"observed": OBSERVED, "propagation": prb.Resimulated(n or 256)}
        prb.Simulator("y", lambda u, v: u + v, u, v, metric=AREA, **data)
    theta = [MEAN, np.log(0.45)] if n is None else np.log([0.4, 0.3])
    errors = np.diag(local_sampling(information(model, *theta), np.ones(1)).in_theta)
    assert (np.isfinite(errors) if n is None else np.isinf(errors)).all()


def test_populations_around_an_optimum_are_those_of_the_design_as_it_was() -> None:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1))
        y = pm.Normal.dist(pm.Normal("nu", 0, 2), 0.5)
        prb.Simulator(
            *("y", lambda x, y: x + y, x, y),
            metric=AREA, observed=OBSERVED, propagation=prb.Reweighted(1024, emulator=None),
        )  # fmt: skip
    evaluator = Evaluator.of(model)
    theta = evaluator.hyperparameters.initial
    item = Information(evaluator, 0, theta, n_sets=20)
    before = identified_by_area(item)
    (bound,) = evaluator.reweighted.values()
    bound.add([np.atleast_1d(values) for values in evaluator.parents(theta[None], 0)], 512)
    assert bound.n_points == 1536
    np.testing.assert_array_equal(identified_by_area(item), before)
