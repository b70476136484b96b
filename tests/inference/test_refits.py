"""The sampling distribution around an optimum, the minimisers of many data sets, and what they require."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pymc as pm
import pytest
from four_metrics import METRICS, R256, same, slow
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
    is_prepared_by_data,
    refit,
    refit_obstacle,
    refit_prepared,
    sampling_obstacle,
)
from prbayes.inference.resampling import (
    DataSets,
    observed_set,
    one_set,
    reweighted_sets,
    simulated_sets,
)
from prbayes.model.evaluator import Evaluator
from prbayes.propagation.design import Design

OBSERVED = np.random.default_rng(1).normal(1.0, 0.5, 40)
N = OBSERVED.size
TRUTH = np.array([1.0])


def double(x: Any) -> Any:
    return 2 * x


def build(metric: prb.Metric, propagation: Any = R256, *, sd: float | None = None) -> pm.Model:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1) if sd is None else sd)
        prb.Simulator("y", same, x, metric=metric, observed=OBSERVED, propagation=propagation)
    return model


def pair() -> Evaluator:
    """Two responses to one input, y and 2 y, of the same specimens."""
    shared: dict[str, Any] = {
        "metric": METRICS["kl"],
        "specimens": np.arange(N),
        "propagation": R256,
    }
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), 0.5)
        prb.Simulator("a", same, x, observed=OBSERVED, **shared)
        prb.Simulator("b", double, x, observed=2 * OBSERVED, **shared)
    return Evaluator.of(model)


@cache
def neighbourhood(name: str, *, design: bool = True) -> SamplingDistribution:
    model = build(METRICS[name], R256 if design else prb.Resimulated(512))
    optimum = prb.minimize(model, method="Nelder-Mead", starts=0)
    evaluator = optimum.evaluator
    return SamplingDistribution.of(
        evaluator, optimum.theta, np.array(list(optimum.scales.values()))
    )


def test_coordinates_are_standard_errors_along_a_frame() -> None:
    sampling = neighbourhood("kl")
    thetas = sampling.theta + np.random.default_rng(6).normal(size=(7, 2))
    x = sampling.coordinates(thetas)
    np.testing.assert_allclose(sampling.thetas(x), thetas)  # two hyperparameters, both identified
    np.testing.assert_allclose(sampling.axes.T @ sampling.axes, np.eye(2), atol=1e-12)
    # One unit along each direction, together, make up the sampling covariance of theta.
    steps = sampling.thetas(np.eye(2)) - sampling.theta
    np.testing.assert_allclose(steps.T @ steps, sampling.local.in_theta)


def test_what_is_not_seen_is_left_over() -> None:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), 0.5)
        pm.Normal("idle", 0, 3)
        prb.Simulator("y", same, x, metric=METRICS["kl"], observed=OBSERVED, propagation=R256)
    evaluator = Evaluator.of(model)
    sampling = SamplingDistribution.of(evaluator, np.array([1.0, 0.0]), np.ones(1))
    x = sampling.coordinates(np.array([[1.5, 2.0]]))
    assert x.shape == (1, 1)
    np.testing.assert_allclose(sampling.thetas(x), [[1.5, 0.0]], atol=1e-9)


@pytest.mark.parametrize("name", ["kl", slow("ll"), slow("pr"), "area"])
def test_refits_are_minimisers(name: str) -> None:
    # Against a simplex on each data set by itself.
    sampling = neighbourhood(name)
    sets = reweighted_sets(sampling.evaluator, 6)
    x, converged = refit(sampling, sets)
    assert converged.all()
    target = sampling.evaluator.nodes[0].target
    for found, weights in zip(x, sets.weights[0], strict=True):
        own = target.with_observed(sets.values[0], weights)

        def value(point: Floats, own: Any = own) -> float:
            return float(
                own.of(*sampling.evaluator.populations(sampling.thetas(point)[None], 0))[0]
            )

        best = optimize.minimize(
            value, np.zeros(2), method="Nelder-Mead", options={"xatol": 1e-4, "fatol": 1e-12}
        )
        # Gains of 1e-4 of a standard error's are left on the table: 0.02 standard errors, the
        # area's kinks more.
        np.testing.assert_allclose(found, best.x, atol=0.15 if name == "area" else 0.04)


def test_where_refits_begin_makes_no_difference() -> None:
    sampling = neighbourhood("pr")
    sets = simulated_sets(sampling.evaluator, sampling.theta, 20)
    x, converged = refit(sampling, sets)
    start = np.random.default_rng(1).normal(size=x.shape)
    again, _ = refit(sampling, sets, start)
    assert converged.all()
    np.testing.assert_allclose(again, x, atol=0.05)


def test_clouds_come_closer_at_the_rate_of_their_dimension(monkeypatch: pytest.MonkeyPatch) -> None:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), 0.5)
        z = pm.Normal.dist(0, 1)
        prb.Simulator("y", lambda a, b: a + b, x, z, metric=METRICS["kl"], observed=[0.0, 1.0, 3.0])
    evaluator = Evaluator.of(model)
    evaluator(np.zeros((1, 1)))
    sampling = SamplingDistribution.of(evaluator, np.zeros(1), np.ones(1))
    monkeypatch.setattr(Design, "is_emulated", True)
    ends = iter(8.0 * np.array([-1, 1, -1, 1, -1, 1, -1, 1]) * np.sqrt(7 / 8))
    monkeypatch.setattr(design_errors, "_minimum", lambda *_: np.array([next(ends)]))
    # Eight parts, two inputs: 1/2 + 1/4 as the power of the size.
    np.testing.assert_allclose(design_errors._error_of_points(sampling), 8 / 8**0.75)


def test_the_observed_responses_are_fitted_by_the_optimum() -> None:
    for name in ("kl", "pr"):
        (x,), (converged,) = refit(neighbourhood(name), observed_set(neighbourhood(name).evaluator))
        assert converged
        np.testing.assert_allclose(x, 0, atol=0.02)


@pytest.mark.parametrize("name", [slow("kl"), "pr", "area"])
def test_first_order_without_a_design(name: str) -> None:
    # The optima differ little between 512 fixed points and a design; data sets of the observed
    # specimens are the same.
    sampling, first = neighbourhood(name), neighbourhood(name, design=False)
    sets = reweighted_sets(sampling.evaluator, 100)
    a = sampling.thetas(refit(sampling, sets)[0]) - sampling.theta
    b = first.thetas(refit(first, sets)[0]) - first.theta
    for i in range(2):
        assert np.corrcoef(a[:, i], b[:, i])[0, 1] > 0.9
        # A linear model of distribution functions knows the spread of other data to 30%, one of
        # densities to 10%.
        np.testing.assert_allclose(
            b[:, i].std(), a[:, i].std(), rtol=0.35 if name == "area" else 0.15
        )


def test_blocks_of_data_sets_make_no_difference(monkeypatch: pytest.MonkeyPatch) -> None:
    sampling = neighbourhood("kl")
    sets = simulated_sets(sampling.evaluator, sampling.theta, 23)
    whole, _ = refit(sampling, sets)
    monkeypatch.setattr(refits, "AT_ONCE", 5 * 5 * (256 + sets.values[0].size))
    parts, converged = refit(sampling, sets)
    assert converged.size == 23
    # Each block guesses its curvature from its own data sets, so that paths differ, but not where
    # they lead.
    np.testing.assert_allclose(parts, whole, atol=0.04)


def test_two_simulators_are_weighed_by_their_scales() -> None:
    # A normal mean with known sd: both minimisers are about the means of the data, weighed by N_k.
    evaluator = pair()
    sampling = SamplingDistribution.of(evaluator, TRUTH, np.array([1 / N, 1e9]))
    sets = reweighted_sets(evaluator, 20)
    only_a, _ = refit(sampling, sets)
    alone = Evaluator.of(build(METRICS["kl"], sd=0.5))
    by_itself = SamplingDistribution.of(alone, TRUTH, np.array([1 / N]))
    expected, _ = refit(by_itself, DataSets(sets.values[:1], sets.weights[:1]))
    np.testing.assert_allclose(sampling.thetas(only_a), by_itself.thetas(expected), atol=0.003)


def test_the_standard_error_of_a_mean() -> None:
    # Of N normal values of known spread, in the coordinates' own unit and in theta.
    sampling = SamplingDistribution.of(
        Evaluator.of(build(METRICS["kl"], sd=0.5)), TRUTH, np.ones(1)
    )
    expected = 0.5 / N**0.5
    np.testing.assert_allclose(sampling.local.in_theta[0, 0] ** 0.5, expected, rtol=0.01)
    step = sampling.thetas(np.ones(1)) - TRUTH
    np.testing.assert_allclose(abs(step), sampling.local.in_theta[0] ** 0.5)


def test_a_minimiser_goes_where_its_data_go() -> None:
    # One data set is all on one side: the sign of the shift.
    sampling = SamplingDistribution.of(
        Evaluator.of(build(METRICS["kl"], sd=0.5)), TRUTH, np.ones(1)
    )
    above = (np.median(OBSERVED) < OBSERVED).astype(float)
    weights = np.array([above, 1 - above])
    weights /= weights.sum(axis=1, keepdims=True)
    x, _ = refit(sampling, DataSets([OBSERVED], [weights]))
    up, down = sampling.thetas(x)[:, 0]
    np.testing.assert_allclose([up, down], weights @ OBSERVED, atol=0.05)


def test_a_simulator_without_a_design_has_no_design_error() -> None:
    sampling = neighbourhood("pr", design=False)
    assert np.isnan(design_error(sampling).whole)


@pytest.mark.long
def test_data_that_tell_nothing_leave_nothing_to_refit() -> None:
    with pm.Model() as model:
        mu = pm.Normal("mu", 1, 0.001)  # far better known before than after
        x = pm.Normal.dist(mu, 1.0)
        prb.Simulator(
            "y",
            lambda x, z: x + z,
            x,
            pm.Normal.dist(0, 1),
            metric=prb.AreaMetric(),
            observed=OBSERVED,
        )
    optimum = prb.minimize(model)
    distribution = SamplingDistribution.of(optimum.evaluator, optimum.theta, np.ones(1))
    assert distribution.stderr.size == 0
    sets = reweighted_sets(optimum.evaluator, 5, seed=0)
    minimisers, converged = refit(distribution, sets)
    assert minimisers.shape == (5, 0)
    assert converged.all()
    assert design_error(distribution).whole == 0


def test_rough_refits_are_around_the_exact_ones_where_hyperparameters_hang_together() -> None:
    # Means and log standard deviations by their sum and difference, whose estimates correlate by
    # -.96: a one-sided difference along each moved them by a quarter of a standard error.
    with pm.Model() as model:
        u, v = pm.Normal("u", 0, 3), pm.Normal("v", 0, 3)
        x = pm.Normal.dist(u + v, pm.math.exp(u - v))
        observed = 1 + 0.1 * norm.ppf((np.arange(50) + 0.5) / 50)
        metric = prb.KullbackLeibler()
        prb.Simulator(
            "y", same, x, metric=metric, observed=observed, propagation=prb.Reweighted(1024)
        )
    sampling = prb.minimize(model, progressbar=False).sampling()
    local = sampling.local
    covariance = local.identified @ local.covariance @ local.identified.T
    stderr = np.sqrt(np.diag(covariance))
    along = replace(sampling, axes=np.eye(2), stderr=stderr)
    sets = simulated_sets(along.evaluator, sampling.theta, 300, seed=1)
    exact, _ = refit(along, sets)
    assert np.corrcoef(exact.T)[0, 1] < -0.9
    rough, converged = refit(along, sets, is_rough=True)
    assert converged.all()
    off = (rough - exact) / exact.std(axis=0)
    assert np.abs(off.mean(axis=0)).max() < 0.01
    assert off.std(axis=0).max() < 0.03


def test_a_variance_that_rounding_made_nothing_leaves_refits_their_axes() -> None:
    sampling = neighbourhood("kl")
    flat = replace(
        sampling, local=replace(sampling.local, covariance=0 * sampling.local.covariance)
    )
    x, converged = refit(flat, observed_set(flat.evaluator))
    assert converged.all()
    np.testing.assert_allclose(x, refit(sampling, observed_set(flat.evaluator))[0], atol=1e-6)


def test_where_all_descents_end_is_no_error_of_emulators(monkeypatch: pytest.MonkeyPatch) -> None:
    """A descent ends beside the optimum for other reasons, and runs would not mend it."""

    def wavy(a: Any, b: Any) -> Any:
        return a + np.sin(3 * a * b)

    rng = np.random.default_rng(2)
    a, b = rng.normal(1.0, 0.5, 30), rng.normal(0.0, 0.3, 30)
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), 0.5)
        z = pm.Normal.dist(0, 0.3)
        prb.Simulator("y", wavy, x, z, metric=METRICS["kl"], observed=wavy(a, b))
    optimum = prb.minimize(model, starts=0)
    sampling = SamplingDistribution.of(optimum.evaluator, optimum.theta, np.ones(1))
    ends = iter([0.3, *[0.4] * 3, *[0.3] * 5])  # of the whole, and of eight that lack a block
    monkeypatch.setattr(design_errors, "_minimum", lambda *_: np.array([next(ends)]))
    assert design_errors._error_of_emulators(sampling) == pytest.approx(np.sqrt(3) * 0.1)


# -- a metric prepared for each data set
# ---------------------------------------------------------------------------------------------


@cache
def of_two_outputs(metric: prb.Metric = METRICS["kl"]) -> SamplingDistribution:
    rng = np.random.default_rng(2)
    a, b = rng.normal(1, 0.5, 15), rng.normal(0, 0.3, 15)
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1))
        z = pm.Normal.dist(0, pm.HalfNormal("tau", 1))
        prb.Simulator(
            "y",
            lambda x, z: np.stack([x, x + z], axis=-1),
            x,
            z,
            metric=prb.Joint(metric),
            observed=np.column_stack([a, a + b]),
            propagation=prb.Reweighted(1024, emulator=None),
        )
    evaluator = Evaluator.of(model)
    theta = evaluator.hyperparameters.unconstrained({"mu": 1.0, "sigma": 0.5, "tau": 0.3})
    return SamplingDistribution.of(evaluator, theta, np.ones(1))


@pytest.mark.parametrize("name", ["kl", "area"])
def test_a_metric_prepared_anew_is_that_of_the_other_data(name: str) -> None:
    sampling = of_two_outputs(METRICS[name])
    sets = simulated_sets(sampling.evaluator, sampling.theta, 20, seed=4)
    shared, _ = refit(sampling, sets)
    found, converged = refit_prepared(sampling, sets, shared)
    for i in (0, 7):
        data, weights = one_set(sampling.evaluator, sets, i)
        other = sampling.evaluator.observing(data, weights=weights)
        (expected,), _ = refit(replace(sampling, evaluator=other), observed_set(other))
        # To a few hundredths of a standard error, and a kink of areas that is flat.
        np.testing.assert_allclose(found[i], expected, atol=0.1 if name == "kl" else 0.25)
    assert converged.all()
    # It is another one than that of what was prepared for the data.
    assert np.std(found - shared) > 0.02


def test_a_minimiser_that_ran_away_is_no_start() -> None:
    sampling = of_two_outputs()
    sets = simulated_sets(sampling.evaluator, sampling.theta, 4, seed=4)
    shared, _ = refit(sampling, sets)
    near, _ = refit_prepared(sampling, sets, shared)
    away = shared + np.array([0.0, 0.0, 25.0])
    np.testing.assert_allclose(refit_prepared(sampling, sets, away)[0], near, atol=0.05)


def test_a_data_set_that_a_metric_cannot_be_prepared_for_keeps_its_minimiser() -> None:
    sampling = of_two_outputs()
    sets = simulated_sets(sampling.evaluator, sampling.theta, 3, seed=4)
    weights = sets.weights[0].copy()
    weights[1] = 0.0
    weights[1, 5] = 1.0  # all specimens are alike
    alike = DataSets(sets.values, [weights])
    found, converged = refit_prepared(sampling, alike, np.zeros((3, 3)))
    assert converged.tolist() == [True, False, True]
    np.testing.assert_array_equal(found[1], 0)


@pytest.mark.parametrize(
    "case",
    ["one output", "computed anew", pytest.param("declares nothing", marks=pytest.mark.long)],
)
def test_where_a_metric_is_prepared_for_the_data_alone(case: str) -> None:
    if case == "declares nothing":

        def between(x: Floats, y: Floats, weights: Floats) -> Any:
            return np.abs(np.average(x, axis=-1, weights=weights) - y.mean())

        sampling = of_two_outputs(prb.FunctionMetric(between, weighted=True))
    else:
        sampling = neighbourhood("kl", design=case == "one output")
    assert not is_prepared_by_data(sampling.evaluator)
    assert is_prepared_by_data(of_two_outputs().evaluator)


OF_THIRTY = np.random.default_rng(1).normal(1.0, 0.5, 30)
THETAS = np.array([[0.8], [1.1], [1.5]])
SCALES = np.array([2.0, 0.5])
DECLARED = {"kl": prb.KullbackLeibler(), "pr": prb.ProbabilityResidual(), "area": prb.AreaMetric()}


@cache
def two(name: str) -> tuple[Evaluator, DataSets]:
    """Return a model of two simulators, and three data sets."""
    with pm.Model() as model:
        mu = pm.Normal("mu", 0, 2)
        for k, factor in enumerate((1.0, 3.0)):
            prb.Simulator(
                f"y{k}",
                lambda x, factor=factor: factor * x,
                pm.Normal.dist(mu, 0.5),
                metric=DECLARED[name],
                observed=factor * OF_THIRTY,
                propagation=prb.Reweighted(128),
            )
    evaluator = Evaluator.of(model)
    return evaluator, reweighted_sets(evaluator, 3)


def by_itself(evaluator: Evaluator, sets: DataSets, b: int, k: int) -> Floats:
    """Return the discrepancies of the k-th simulator from the b-th data set at all thetas."""
    target = evaluator.nodes[k].target.with_observed(sets.values[k], sets.weights[k][b])
    return np.asarray(target.of(*evaluator.populations(THETAS, k)))


@pytest.mark.parametrize("name", list(DECLARED))
def test_it_is_the_sum_of_the_simulators_over_their_scales(name: str) -> None:
    evaluator, sets = two(name)
    objective = BatchObjective.of(evaluator, SCALES, sets)
    assert objective.n_sets == 3
    found = objective(np.broadcast_to(THETAS, (3, 3, 1)), np.arange(3))
    for b in range(3):
        expected = sum(by_itself(evaluator, sets, b, k) / SCALES[k] for k in range(2))
        np.testing.assert_allclose(found[b], expected, rtol=1e-10)


@pytest.mark.parametrize("name", list(DECLARED))
def test_rows_are_data_sets_and_a_single_row_of_thetas_is_for_all(name: str) -> None:
    objective = BatchObjective.of(two(name)[0], SCALES, two(name)[1])
    whole = objective(THETAS[None], slice(None))
    assert whole.shape == (3, 3)
    some = objective(np.array([THETAS, THETAS]), np.array([2, 0]))
    np.testing.assert_allclose(some, whole[[2, 0]], rtol=1e-12)
    # At a theta of its own each.
    own = objective(THETAS[:, None], np.arange(3))
    np.testing.assert_allclose(own[:, 0], np.diag(whole), rtol=1e-12)


def test_of_some_simulators_only_those_count() -> None:
    evaluator, sets = two("area")
    objective = BatchObjective.of(evaluator, SCALES, sets, simulators=[1])
    found = objective(THETAS[None], slice(None))[0]
    np.testing.assert_allclose(found, by_itself(evaluator, sets, 0, 1) / 0.5, rtol=1e-10)


def test_a_data_set_sees_its_own_block_alone() -> None:
    evaluator, sets = two("area")
    alike = DataSets(sets.values, [w[[0, 0]] for w in sets.weights])
    blocks = [np.arange(128) % 2] * 2
    objective = BatchObjective.of(evaluator, SCALES, alike, blocks=blocks)
    found = objective(THETAS[None], slice(None))
    for b in (0, 1):
        expected = 0.0
        for k in (0, 1):
            values, weights = evaluator.populations(THETAS, k)
            half = weights * (blocks[k] == b)
            half = half / half.sum(axis=1, keepdims=True)
            target = evaluator.nodes[k].target.with_observed(sets.values[k], sets.weights[k][0])
            expected = expected + target.of(values, half) / SCALES[k]
        np.testing.assert_allclose(found[b], expected, rtol=1e-10)
    assert (found[0] != found[1]).all()


def test_where_no_point_of_the_design_is_left_it_is_infinite() -> None:
    evaluator, sets = two("area")
    # All points in the first block: the second data set has none.
    blocks = [np.where(np.arange(128) == 0, 2, 0)] * 2
    objective = BatchObjective.of(evaluator, SCALES, sets, blocks=blocks)
    found = objective(THETAS[None], slice(None))
    assert np.isfinite(found[0]).all()
    assert np.isposinf(found[1]).all()


def test_no_response_is_computed() -> None:
    evaluator, sets = two("pr")
    before = evaluator.n_responses
    BatchObjective.of(evaluator, SCALES, sets)(THETAS[None], slice(None))
    assert evaluator.n_responses == before


OF_TWENTY = np.random.default_rng(1).normal(1.0, 0.5, 20)
KL = prb.KullbackLeibler()
OWN = prb.FunctionMetric(lambda z, y, w: np.abs((z * w).sum(-1) - y.mean()), weighted=True)


def model_of(metric: prb.Metric, propagation: Any) -> pm.Model:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), 0.5)
        prb.Simulator(
            "y", np.positive, x, metric=metric, observed=OF_TWENTY, propagation=propagation
        )
    return model


CASES: list[tuple[prb.Metric, Any, str | None]] = [
    (KL, prb.Reweighted(64), None),
    (KL, prb.Resimulated(64), None),
    (OWN, prb.Reweighted(64), None),
    (OWN, prb.Resimulated(64), "these need stored responses"),
    (KL, prb.Fresh(64), "whose discrepancy is random"),
    (OWN, prb.Fresh(64), "whose discrepancy is random"),
]


@pytest.mark.parametrize(("metric", "propagation", "reason"), CASES)
def test_reasons_name_the_simulator(
    metric: prb.Metric, propagation: Any, reason: str | None
) -> None:
    evaluator = Evaluator.of(model_of(metric, propagation))
    for obstacle in (sampling_obstacle(evaluator), refit_obstacle(evaluator)):
        if reason is None:
            assert obstacle is None
        else:
            assert obstacle is not None
            assert obstacle.startswith("y has ")
            assert reason in obstacle


def test_other_terms_forbid_refits_only() -> None:
    model = model_of(KL, prb.Reweighted(64))
    with model:
        pm.Potential("z", -(model["mu"] ** 2))
    evaluator = Evaluator.of(model)
    assert sampling_obstacle(evaluator) is None
    assert "likelihood terms or potentials" in str(refit_obstacle(evaluator))


def test_one_metric_of_ones_own_makes_all_responses_count() -> None:
    model = model_of(OWN, prb.Reweighted(64))
    with model:
        x = pm.Normal.dist(model["mu"], 0.5)
        prb.Simulator(
            "z", np.positive, x, metric=KL, observed=OF_TWENTY, propagation=prb.Resimulated(64)
        )
    assert "responses of z are not stored" in str(sampling_obstacle(Evaluator.of(model)))
