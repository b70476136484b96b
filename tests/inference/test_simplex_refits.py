"""Sampling distributions by refits, of metrics that declare nothing of their minimum."""

from dataclasses import dataclass
from functools import cache
from typing import Any, ClassVar

import numpy as np
import pymc as pm
import pytest

import prbayes as prb
from prbayes._validate import Floats
from prbayes.inference.refits import drawn_in, principal_axes, simplex_refits
from prbayes.metrics.base import Minimum
from prbayes.model.evaluator import Evaluator
from prbayes.propagation.reweighted import designs_restored

OBSERVED = np.random.default_rng(1).normal(1.0, 0.5, 60)
N = OBSERVED.size


@dataclass(frozen=True)
class Undeclared(prb.ProbabilityResidual):
    """The probability residual as a user might write it: it declares nothing."""

    minimum: ClassVar[Minimum] = Minimum.UNKNOWN


def kolmogorov(simulated: Floats, observed: Floats, weights: Floats) -> Any:
    """Return the largest difference of two distribution functions: kinks everywhere."""
    batch = simulated.shape[:-1]
    own = np.broadcast_to(observed, (*batch, observed.size))
    values = np.concatenate([simulated, own], axis=-1)
    signed = np.concatenate([weights, np.full(own.shape, -1 / observed.size)], axis=-1)
    order = np.argsort(values, axis=-1, kind="stable")
    values = np.take_along_axis(values, order, axis=-1)
    gaps = np.cumsum(np.take_along_axis(signed, order, axis=-1), axis=-1)
    last = np.diff(values, axis=-1, append=np.inf) > 0  # of equal values
    return np.abs(np.where(last, gaps, 0.0)).max(axis=-1)


KS = prb.FunctionMetric(kolmogorov, weighted=True)


@cache
def fitted(metric: prb.Metric, unit: float = 1.0, n: int = 256) -> prb.Optimum:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1))
        prb.Simulator(
            "y",
            lambda x: unit * x,
            x,
            metric=metric,
            observed=unit * OBSERVED,
            propagation=prb.Reweighted(n),
        )
    return prb.minimize(model, starts=0)


def mean_square(simulated: Floats, observed: Floats, weights: Floats) -> Any:
    """Return the squared difference of means, whose minimiser is the mean of the data."""
    return ((simulated * weights).sum(axis=-1) - observed.mean()) ** 2


def sum_of(names: list[str]) -> Evaluator:
    """Return a model of the mean of the data: its sd is 0.5, the response the sum of the means."""
    with pm.Model() as model:
        total = sum(pm.Normal(name, 0, 1) for name in names)
        prb.Simulator(
            "y",
            np.positive,
            pm.Normal.dist(total, 0.5),
            metric=prb.FunctionMetric(mean_square, weighted=True),
            observed=OBSERVED,
            propagation=prb.Reweighted(256),
        )
    return Evaluator.of(model)


def test_the_mean_of_a_sample_scatters_by_its_standard_error() -> None:
    evaluator = sum_of(["mu"])
    refits = simplex_refits(evaluator, np.array([2.0]), np.ones(1))
    minimisers = 2.0 + refits.shifts[:, 0] * evaluator.hyperparameters.prior_sd[0]
    assert abs(minimisers.mean() - 2.0) < 4 * 0.5 / (N * 200) ** 0.5
    # The mean gain is that of one squared standard error.
    np.testing.assert_allclose(refits.gain, 0.25 / N, rtol=4 * (2 / 200) ** 0.5)
    # 200 data sets give a standard deviation from their middle 89% to 6%.
    stderr = refits.local().in_theta[0, 0] ** 0.5
    np.testing.assert_allclose(stderr, 0.5 / N**0.5, rtol=3 * 0.06)


def test_of_a_sum_of_two_means_only_the_sum_is_identified() -> None:
    evaluator = sum_of(["a", "b"])
    local = simplex_refits(evaluator, np.array([0.5, 0.5]), np.ones(1)).local()
    assert local.identified.shape == (2, 1)
    unit = np.sqrt(np.full(2, 0.5))
    # In units of the priors' spreads, which are known from 256 draws to some per cent.
    assert abs(local.identified[:, 0] @ unit) > 0.99
    assert abs(local.unidentified[:, 0] @ unit) < 0.15
    assert np.isinf(local.in_theta).all()


@pytest.mark.long
def test_a_metric_that_declares_nothing_has_the_standard_errors_of_its_twin() -> None:
    declared, undeclared = fitted(prb.ProbabilityResidual()), fitted(Undeclared())
    for name in ("mu", "sigma"):
        np.testing.assert_allclose(undeclared.stderr[name], declared.stderr[name], rtol=0.15)
    one, other = (prb.calibrate_epsilon(o)["y"] for o in (declared, undeclared))
    np.testing.assert_allclose(other, one, rtol=0.2)


@pytest.mark.long
@pytest.mark.parametrize("unit", [pytest.param(1e3, marks=pytest.mark.slow), 1e-3])
def test_a_kolmogorov_distance_is_the_same_in_every_unit(unit: float) -> None:
    one = fitted(KS)
    epsilon = prb.calibrate_epsilon(one)["y"]
    assert np.isfinite(list(one.stderr.values())).all()
    assert 0 < epsilon < one.discrepancy
    # The distance has about 90% of the mean's efficiency, 60% of the standard deviation's.
    sigma = one.point["sigma"]
    assert 0.85 < one.stderr["mu"] / (sigma / N**0.5) < 1.5
    assert 0.9 < one.stderr["sigma"] / (sigma / (2 * N) ** 0.5) < 2.2
    other = fitted(KS, unit)
    for name in ("mu", "sigma"):
        np.testing.assert_allclose(other.point[name], one.point[name], rtol=1e-6)
        np.testing.assert_allclose(other.stderr[name], one.stderr[name], rtol=0.01)
    np.testing.assert_allclose(prb.calibrate_epsilon(other)["y"], epsilon, rtol=0.01)


def test_refits_are_remembered_and_forgotten_with_the_design() -> None:
    evaluator = sum_of(["mu"])
    at = np.array([1.0]), np.ones(1)
    first = simplex_refits(evaluator, *at)
    assert (
        simplex_refits(evaluator, at[0], 7 * at[1]) is first
    )  # a scale of one simulator changes nothing
    (bound,) = evaluator.reweighted.values()
    with designs_restored([bound]):
        bound.add(evaluator.parents(np.array([[1.0]]), 0))
        assert simplex_refits(evaluator, *at) is not first
    assert simplex_refits(evaluator, *at) is first


def test_principal_axes_of_normal_points_with_outliers() -> None:
    rng = np.random.default_rng(2)
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    points = (rng.standard_normal((4000, 2)) * [0.5, 3.0]) @ turn.T
    points[:20] = 1e6
    axes, sd = principal_axes(points)
    np.testing.assert_allclose(sd, [0.5, 3.0], rtol=0.06)
    np.testing.assert_allclose(np.abs(axes.T @ turn), np.eye(2), atol=0.03)
    points = rng.normal([1.0, -2.0], [0.5, 3.0], (4000, 2))
    points[0] = [1e6, -1e6]
    drawn = drawn_in(points, 3.0)
    np.testing.assert_allclose(drawn[0], [1 + 3 * 0.5, -2 - 3 * 3], rtol=0.05)
    near = np.abs((points - [1.0, -2.0]) / [0.5, 3.0]).max(axis=1) < 2.8
    np.testing.assert_array_equal(drawn[near], points[near])


def test_no_refits_without_stored_responses() -> None:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), 0.5)
        metric = Undeclared()
        keywords = {"observed": OBSERVED, "propagation": prb.Resimulated(64)}
        prb.Simulator("y", np.positive, x, metric=metric, **keywords)
    optimum = prb.minimize(model)
    assert np.isnan(optimum.stderr["mu"])
    with pytest.raises(TypeError, match=r"y has a Undeclared.*use propagation=prb.Reweighted"):
        prb.calibrate_epsilon(optimum)
