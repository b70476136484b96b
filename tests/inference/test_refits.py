"""The sampling distribution around an optimum, the minimisers of many data sets, and what they require."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pymc as pm
import pytest
from four_metrics import METRICS, R256, same
from one_input import one_input
from scipy import optimize
from scipy.stats import norm

import prbayes as prb
from prbayes._validate import Floats
from prbayes.inference import design_error as design_errors
from prbayes.inference import refits
from prbayes.inference.design_error import design_error
from prbayes.inference.refits import (
    BatchObjective,
    SamplingDistribution,
    drawn_in,
    is_prepared_by_data,
    principal_axes,
    refit,
    refit_obstacle,
    refit_prepared,
    sampling_obstacle,
    simplex_refits,
)
from prbayes.inference.resampling import (
    DataSets,
    observed_set,
    one_set,
    reweighted_sets,
    simulated_sets,
)
from prbayes.model.evaluator import Evaluator
from prbayes.propagation.reweighted import designs_restored

OBSERVED = np.random.default_rng(1).normal(1.0, 0.5, 40)
N = OBSERVED.size
KL, AREA = METRICS["kl"], METRICS["area"]


def build(metric: prb.Metric, propagation: Any = R256, sd: float | None = None) -> pm.Model:
    return one_input(OBSERVED, metric, propagation, same, sd=sd)


def sampling_at(model: pm.Model, *theta: float, scales: Any = 1.0) -> SamplingDistribution:
    evaluator = Evaluator.of(model)
    return SamplingDistribution.of(evaluator, np.array(theta), np.atleast_1d(scales))


@cache
def around(name: str, *, design: bool = True) -> SamplingDistribution:
    model = build(METRICS[name], R256 if design else prb.Resimulated(512))
    return prb.minimize(model, method="Nelder-Mead", starts=0).sampling()


def test_coordinates_are_standard_errors_along_axes() -> None:
    sampling = around("kl")
    thetas = sampling.theta + np.random.default_rng(6).normal(size=(7, 2))
    x = sampling.coordinates(thetas)
    np.testing.assert_allclose(sampling.thetas(x), thetas)  # two hyperparameters, both identified
    np.testing.assert_allclose(sampling.axes.T @ sampling.axes, np.eye(2), atol=1e-12)
    # One unit along each direction, together, make up the sampling covariance of theta.
    steps = sampling.thetas(np.eye(2)) - sampling.theta
    np.testing.assert_allclose(steps.T @ steps, sampling.local.in_theta)


def test_unidentified_elements_have_no_coordinates() -> None:
    with build(KL, sd=0.5) as model:
        pm.Normal("idle", 0, 3)
    sampling = sampling_at(model, 1.0, 0.0)
    x = sampling.coordinates(np.array([[1.5, 2.0]]))
    assert x.shape == (1, 1)
    np.testing.assert_allclose(sampling.thetas(x), [[1.5, 0.0]], atol=1e-9)


# -- refits ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["kl", "area"])
def test_refits_are_minimisers(name: str) -> None:
    # Against a simplex on each data set by itself.
    sampling = around(name)
    sets = reweighted_sets(sampling.evaluator, 6)
    x, converged = refit(sampling, sets)
    assert converged.all()
    for minimiser, weights in zip(x, sets.weights[0], strict=True):
        target = sampling.evaluator.nodes[0].target.with_observed(sets.values[0], weights)

        def value(point: Floats, target: Any = target) -> float:
            populations = sampling.evaluator.populations(sampling.thetas(point)[None], 0)
            return float(target.of(*populations)[0])

        options = {"xatol": 1e-4, "fatol": 1e-12}
        best = optimize.minimize(value, np.zeros(2), method="Nelder-Mead", options=options)
        # Gains of 1e-4 of a standard error's are not taken: 0.02 standard errors, the area's kinks
        # more.
        np.testing.assert_allclose(minimiser, best.x, atol=0.15 if name == "area" else 0.04)


def test_starts_and_batches_of_refits_make_no_difference(monkeypatch: pytest.MonkeyPatch) -> None:
    sampling = around("kl")
    sets = simulated_sets(sampling.evaluator, sampling.theta, 23)
    whole, converged = refit(sampling, sets)
    assert converged.all()
    elsewhere, _ = refit(sampling, sets, np.random.default_rng(1).normal(size=whole.shape))
    np.testing.assert_allclose(elsewhere, whole, atol=0.05)
    monkeypatch.setattr(refits, "AT_ONCE", 5 * 5 * (256 + sets.values[0].size))
    # Each batch guesses its curvature from its own data sets: paths differ, their ends do not.
    np.testing.assert_allclose(refit(sampling, sets)[0], whole, atol=0.04)
    # The observed responses are fitted by the optimum, also with a variance of zero by rounding.
    observed = observed_set(sampling.evaluator)
    local = replace(sampling.local, covariance=0 * sampling.local.covariance)
    for other in (sampling, replace(sampling, local=local)):
        (x,), (is_converged,) = refit(other, observed)
        assert is_converged
        np.testing.assert_allclose(x, 0, atol=0.02)


def test_first_order_without_a_design() -> None:
    # The optima differ little between 512 fixed points and a design.
    sampling, first = around("area"), around("area", design=False)
    sets = reweighted_sets(sampling.evaluator, 100)
    a, b = (s.thetas(refit(s, sets)[0]) - s.theta for s in (sampling, first))
    # A linear model of distribution functions has the spread of other data to 30%.
    np.testing.assert_allclose(b.std(axis=0), a.std(axis=0), rtol=0.35)
    for i in range(2):
        assert np.corrcoef(a[:, i], b[:, i])[0, 1] > 0.9
    assert np.isnan(design_error(first).whole)


def test_minimisers_are_means_weighed_by_scales() -> None:
    shared = {"metric": KL, "specimens": np.arange(N), "propagation": R256}
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), 0.5)
        prb.Simulator("a", same, x, observed=OBSERVED, **shared)
        prb.Simulator("b", lambda x: 2 * x, x, observed=2 * OBSERVED, **shared)
    sampling = sampling_at(model, 1.0, scales=[1 / N, 1e9])
    sets = reweighted_sets(sampling.evaluator, 20)
    by_itself = sampling_at(build(KL, sd=0.5), 1.0)
    expected, _ = refit(by_itself, DataSets(sets.values[:1], sets.weights[:1]))
    only_a = sampling.thetas(refit(sampling, sets)[0])
    np.testing.assert_allclose(only_a, by_itself.thetas(expected), atol=0.003)
    # Data sets on one side each: the sign of the shift.
    above = (np.median(OBSERVED) < OBSERVED).astype(float)
    weights = np.array([above, 1 - above]) / (N / 2)
    x, _ = refit(by_itself, DataSets([OBSERVED], [weights]))
    np.testing.assert_allclose(by_itself.thetas(x)[:, 0], weights @ OBSERVED, atol=0.05)


@pytest.mark.long
def test_data_without_information_leave_nothing_to_refit() -> None:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1, 0.001), 1.0)  # far better known before than after
        z = pm.Normal.dist(0, 1)
        prb.Simulator("y", lambda x, z: x + z, x, z, metric=AREA, observed=OBSERVED)
    distribution = prb.minimize(model, starts=0).sampling()
    assert distribution.stderr.size == 0
    minimisers, converged = refit(distribution, reweighted_sets(distribution.evaluator, 5))
    assert minimisers.shape == (5, 0)
    assert converged.all()
    assert design_error(distribution).whole == 0


def test_rough_refits_of_correlated_hyperparameters_are_around_the_exact_ones() -> None:
    # Means and log standard deviations by their sum and difference, whose estimates correlate by
    # -.96: a one-sided difference along each moved them by a quarter of a standard error.
    with pm.Model() as model:
        u, v = pm.Normal("u", -0.6, 0.3), pm.Normal("v", 1.6, 0.3)
        x = pm.Normal.dist(u + v, pm.math.exp(u - v))
        observed = 1 + 0.1 * norm.ppf((np.arange(50) + 0.5) / 50)
        prb.Simulator("y", same, x, metric=KL, observed=observed, propagation=prb.Reweighted(512))
    sampling = sampling_at(model, -0.65, 1.65)
    local = sampling.local
    covariance = local.identified @ local.covariance @ local.identified.T
    along = replace(sampling, axes=np.eye(2), stderr=np.sqrt(np.diag(covariance)))
    sets = simulated_sets(along.evaluator, sampling.theta, 100, seed=1)
    exact, _ = refit(along, sets)
    assert np.corrcoef(exact.T)[0, 1] < -0.9
    rough, converged = refit(along, sets, is_rough=True)
    assert converged.all()
    off = (rough - exact) / exact.std(axis=0)
    assert np.abs(off.mean(axis=0)).max() < 0.01
    assert off.std(axis=0).max() < 0.03


def test_errors_of_designs_of_two_inputs(monkeypatch: pytest.MonkeyPatch) -> None:
    def wavy(a: Any, b: Any) -> Any:
        return a + np.sin(3 * a * b)

    rng = np.random.default_rng(2)
    with pm.Model() as model:
        x, z = pm.Normal.dist(pm.Normal("mu", 0, 2), 0.5), pm.Normal.dist(0, 0.3)
        observed = wavy(rng.normal(1.0, 0.5, 30), rng.normal(0.0, 0.3, 30))
        prb.Simulator("y", wavy, x, z, metric=KL, observed=observed, propagation=R256)
    sampling = sampling_at(model, 1.0)
    # Descents may end beside the optimum for other reasons: the end of the whole does not count.
    ends = iter([0.3, *[0.4] * 3, *[0.3] * 5])  # of the whole, and of eight that lack a block
    monkeypatch.setattr(design_errors, "_minimum", lambda *_: np.array([next(ends)]))
    assert design_errors._error_of_emulators(sampling) == pytest.approx(np.sqrt(3) * 0.1)
    # Eight parts, two inputs: 1/2 + 1/4 as the power of the size.
    spread = 8.0 * np.array([-1, 1, -1, 1, -1, 1, -1, 1]) * np.sqrt(7 / 8)
    ends = iter(spread)
    np.testing.assert_allclose(design_errors._error_of_points(sampling), 8 / 8**0.75)
    # Runs alone count as independent; half of the blocks have to have a minimum.
    for lost, expected in ((0, 8 / 8**0.5), (5, np.inf)):
        ends = iter(np.where(np.arange(8) < lost, np.inf, spread))
        error = design_errors._error_of_points(of_two_outputs())
        np.testing.assert_allclose(error, expected)


# -- a metric prepared for each data set -----------------------------------------------------------


@cache
def of_two_outputs() -> SamplingDistribution:
    rng = np.random.default_rng(2)
    a, b = rng.normal(1, 0.5, 15), rng.normal(0, 0.3, 15)
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1))
        z = pm.Normal.dist(0, pm.HalfNormal("tau", 1))
        data = {"observed": np.column_stack([a, a + b]), "metric": prb.Joint(KL)}
        data["propagation"] = prb.Reweighted(1024, emulator=None)
        prb.Simulator("y", lambda x, z: np.stack([x, x + z], axis=-1), x, z, **data)
    return sampling_at(model, 1.0, np.log(0.5), np.log(0.3))


def test_a_prepared_metric_is_that_of_the_other_data() -> None:
    sampling = of_two_outputs()
    sets = simulated_sets(sampling.evaluator, sampling.theta, 8, seed=4)
    shared, _ = refit(sampling, sets)
    minimisers, converged = refit_prepared(sampling, sets, shared)
    assert converged.all()
    for i in (0, 7):
        data, weights = one_set(sampling.evaluator, sets, i)
        prepared = sampling.evaluator.observing(data, weights=weights)
        (expected,), _ = refit(replace(sampling, evaluator=prepared), observed_set(prepared))
        # To a few hundredths of a standard error.
        np.testing.assert_allclose(minimisers[i], expected, atol=0.1)
    assert np.std(minimisers - shared) > 0.02
    # A minimiser that ran away is no start.
    few = DataSets(sets.values, [w[:4].copy() for w in sets.weights])
    away, _ = refit_prepared(sampling, few, shared[:4] + np.array([0.0, 0.0, 25.0]))
    np.testing.assert_allclose(away, minimisers[:4], atol=0.05)
    # A set that the metric cannot be prepared for keeps its minimiser: all specimens alike.
    few.weights[0][1] = np.eye(few.weights[0].shape[1])[5]
    again, converged = refit_prepared(sampling, few, shared[:4])
    assert converged.tolist() == [True, False, True, True]
    np.testing.assert_array_equal(again[1], shared[1])


def between(x: Floats, y: Floats, weights: Floats) -> Any:
    return np.abs(np.average(x, axis=-1, weights=weights) - y.mean())


OWN = prb.FunctionMetric(between, weighted=True)


@pytest.mark.parametrize("is_stored", [True, False])
def test_which_metrics_are_prepared_for_the_data_alone(is_stored: bool) -> None:
    assert not is_prepared_by_data(around("kl", design=is_stored).evaluator)
    assert is_prepared_by_data(of_two_outputs().evaluator)


# -- the objective of many data sets ---------------------------------------------------------------

THETAS = np.array([[0.8], [1.1], [1.5]])
SCALES = np.array([2.0, 0.5])


@cache
def two(name: str) -> tuple[Evaluator, DataSets]:
    """Return a model of two simulators, and three data sets."""
    with pm.Model() as model:
        mu = pm.Normal("mu", 0, 2)
        for k, factor in enumerate((1.0, 3.0)):
            data = {"observed": factor * OBSERVED[:30], "propagation": prb.Reweighted(128)}
            x = pm.Normal.dist(mu, 0.5)
            response = lambda x, factor=factor: factor * x  # noqa: E731
            prb.Simulator(f"y{k}", response, x, metric=METRICS[name], **data)
    evaluator = Evaluator.of(model)
    return evaluator, reweighted_sets(evaluator, 3)


def test_standard_errors_of_few_specimens_each_are_those_of_refits() -> None:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1))
        given = {"metric": AREA, "observed": np.arange(4.0), "propagation": prb.Reweighted(128)}
        for k in range(4):
            prb.Simulator(f"y{k}", same, x, **given)
    sampling = sampling_at(model, 0.0, -0.7, scales=np.ones(4))
    sets = simulated_sets(sampling.evaluator, sampling.theta, 200)
    x, converged = refit(sampling, sets, is_rough=True)
    assert converged.mean() > 0.95
    # In standard errors.
    low, middle, high = np.quantile(x, [0.055, 0.5, 0.945], axis=0)
    np.testing.assert_allclose((high - low) / 3.2, 1, atol=0.2)
    np.testing.assert_allclose(middle, 0, atol=0.3)
    np.testing.assert_allclose(sampling.linear_estimates(sets).std(axis=0), 1, rtol=0.02)


def by_itself(evaluator: Evaluator, sets: DataSets, b: int, k: int) -> Floats:
    """Return the scaled discrepancies of a simulator from a data set."""
    target = evaluator.nodes[k].target.with_observed(sets.values[k], sets.weights[k][b])
    return np.asarray(target.of(*evaluator.populations(THETAS, k)) / SCALES[k])


@pytest.mark.parametrize("name", ["kl", "pr", "area"])
def test_the_objective_is_the_sum_of_the_simulators_over_their_scales(name: str) -> None:
    evaluator, sets = two(name)
    n_responses = evaluator.n_responses
    objective = BatchObjective.of(evaluator, SCALES, sets)
    whole = objective(THETAS[None], slice(None))  # a single row of thetas is for all data sets
    expected = [sum(by_itself(evaluator, sets, b, k) for k in range(2)) for b in range(3)]
    np.testing.assert_allclose(whole, expected, rtol=1e-10)
    rows = objective(np.array([THETAS, THETAS]), np.array([2, 0]))
    np.testing.assert_allclose(rows, whole[[2, 0]], rtol=1e-12)
    diagonal = objective(THETAS[:, None], np.arange(3))
    np.testing.assert_allclose(diagonal[:, 0], np.diag(whole), rtol=1e-12)
    second = BatchObjective.of(evaluator, SCALES, sets, simulators=[1])(THETAS[None], slice(None))
    np.testing.assert_allclose(second[0], by_itself(evaluator, sets, 0, 1), rtol=1e-10)
    assert objective.n_sets == 3
    assert evaluator.n_responses == n_responses


# -- metrics that declare nothing of their minimum -------------------------------------------------

SIXTY = np.random.default_rng(1).normal(1.0, 0.5, 60)


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
def fitted(metric: prb.Metric, unit: float = 1.0) -> prb.Optimum:
    return prb.minimize(one_input(unit * SIXTY, metric, R256, lambda x: unit * x), starts=0)


def mean_square(simulated: Floats, observed: Floats, weights: Floats) -> Any:
    """Return the squared difference of means, whose minimiser is the mean of the data."""
    return ((simulated * weights).sum(axis=-1) - observed.mean()) ** 2


def sum_of(names: list[str]) -> Evaluator:
    """Return a model of the mean of the data: its sd is 0.5, the response the sum of the means."""
    with pm.Model() as model:
        x = pm.Normal.dist(sum(pm.Normal(name, 0, 1) for name in names), 0.5)
        metric = prb.FunctionMetric(mean_square, weighted=True)
        prb.Simulator("y", same, x, metric=metric, observed=SIXTY, propagation=R256)
    return Evaluator.of(model)


def test_the_mean_of_a_sample_scatters_by_its_standard_error() -> None:
    evaluator = sum_of(["mu"])
    refits = simplex_refits(evaluator, np.array([2.0]), np.ones(1))
    minimisers = 2.0 + refits.shifts[:, 0] * evaluator.hyperparameters.prior_sd[0]
    assert abs(minimisers.mean() - 2.0) < 4 * 0.5 / (60 * 200) ** 0.5
    # The mean gain is that of one squared standard error.
    np.testing.assert_allclose(refits.gain, 0.25 / 60, rtol=4 * (2 / 200) ** 0.5)
    # 200 data sets give a standard deviation from their middle 89% to 6%.
    stderr = refits.local().in_theta[0, 0] ** 0.5
    np.testing.assert_allclose(stderr, 0.5 / 60**0.5, rtol=3 * 0.06)


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
def test_a_kolmogorov_distance_is_the_same_in_every_unit() -> None:
    one = fitted(KS)
    epsilon = prb.calibrate_epsilon(one)["y"]
    assert np.isfinite(list(one.stderr.values())).all()
    assert 0 < epsilon < one.discrepancy
    # The distance has about 90% of the mean's efficiency, 60% of the standard deviation's.
    sigma = one.point["sigma"]
    assert 0.85 < one.stderr["mu"] / (sigma / 60**0.5) < 1.5
    assert 0.9 < one.stderr["sigma"] / (sigma / (2 * 60) ** 0.5) < 2.2
    other = fitted(KS, 1e-3)
    for name in ("mu", "sigma"):
        np.testing.assert_allclose(other.point[name], one.point[name], rtol=1e-6)
        np.testing.assert_allclose(other.stderr[name], one.stderr[name], rtol=0.01)
    np.testing.assert_allclose(prb.calibrate_epsilon(other)["y"], epsilon, rtol=0.01)


def test_refits_are_remembered_and_forgotten_with_the_design() -> None:
    evaluator = sum_of(["mu"])
    at = np.array([1.0]), np.ones(1)
    first = simplex_refits(evaluator, *at)
    # A scale of one simulator changes nothing.
    assert simplex_refits(evaluator, at[0], 7 * at[1]) is first
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
    drawn = drawn_in(points)
    np.testing.assert_allclose(drawn[0], [1 + 3 * 0.5, -2 - 3 * 3], rtol=0.05)
    near = np.abs((points - [1.0, -2.0]) / [0.5, 3.0]).max(axis=1) < 2.8
    np.testing.assert_array_equal(drawn[near], points[near])


# -- obstacles -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("metric", "propagation", "reason"),
    [
        (KL, prb.Reweighted(64), None),
        (KL, prb.Resimulated(64), None),
        (OWN, prb.Reweighted(64), None),
        (OWN, prb.Resimulated(64), "these need stored responses"),
        (KL, prb.Fresh(64), "whose discrepancy is random"),
    ],
)
def test_reasons_name_the_simulator(
    metric: prb.Metric, propagation: Any, reason: str | None
) -> None:
    evaluator = Evaluator.of(build(metric, propagation, 0.5))
    for obstacle in (sampling_obstacle(evaluator), refit_obstacle(evaluator)):
        assert (obstacle is None) == (reason is None)
        if reason is not None:
            assert str(obstacle).startswith("y has ")
            assert reason in str(obstacle)


def test_other_terms_and_simulators_may_forbid_refits() -> None:
    model = build(KL, prb.Reweighted(64), 0.5)
    with model:
        pm.Potential("z", -(model["mu"] ** 2))
    assert sampling_obstacle(Evaluator.of(model)) is None
    assert "likelihood terms or potentials" in str(refit_obstacle(Evaluator.of(model)))
    model = build(OWN, prb.Reweighted(64), 0.5)
    with model:
        x, computed = pm.Normal.dist(model["mu"], 0.5), prb.Resimulated(64)
        prb.Simulator("z", same, x, metric=KL, observed=OBSERVED, propagation=computed)
    assert "responses of z are not stored" in str(sampling_obstacle(Evaluator.of(model)))
