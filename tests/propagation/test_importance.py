"""Emulated samples of designs with several inputs: thousands of points between the runs."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pymc as pm
import pytest

import prbayes as prb
from prbayes._validate import Floats
from prbayes.inference.design_error import DesignErrors, _error_of_points, design_error
from prbayes.inference.refits import SamplingDistribution
from prbayes.inference.resampling import aligned
from prbayes.model.evaluator import Evaluator
from prbayes.model.fingerprint import identity_of
from prbayes.optimize.design_refinement import (
    draw_samples,
    grow,
    refine_at,
)
from prbayes.propagation.design import PoorEmulatorError
from prbayes.propagation.importance import SIZES, MixtureSampler, mixture_of, spread_over
from prbayes.propagation.population_density import PopulationDensity
from prbayes.propagation.reweighted import ReweightedBound, designs_restored
from prbayes.response.compile import PLAIN


def smooth(a: Any, b: Any) -> Any:
    return a * np.exp(0.3 * b) + 0.2 * b**2


# Of specimens whose inputs have means 1.2 and 1, and standard deviations .8 and .6.
Z = np.random.default_rng(1).normal(size=(2, 40))
SPECIMENS = 1.2 + 0.8 * Z[0], 1.0 + 0.6 * Z[1]
OBSERVED = smooth(*SPECIMENS)
THETA = np.array([[1.1, -0.2, 0.9, -0.5]])  # ma, log sa, mb, log sb


def jumping(a: Any, b: Any) -> Any:
    return smooth(a, b) + np.where(np.sin(40 * a) > 0, 3.0, 0.0)


def failing(a: Any, b: Any) -> Any:
    return np.where(a + b > 4, np.nan, smooth(a, b))


def build(response: Any = smooth, n: int = 64, *, known: bool = False, **keywords: Any) -> pm.Model:
    with pm.Model() as model:
        a = pm.Normal.dist(pm.Normal("ma", 1, 0.5), pm.LogNormal("sa", 0, 0.5))
        if known:
            b = pm.Normal.dist(1.0, 0.6)
        else:
            b = pm.Normal.dist(pm.Normal("mb", 1, 0.5), pm.LogNormal("sb", -0.5, 0.5))
        stored = prb.Reweighted(n, **{"emulator": "auto", **keywords})
        # Specimens without a response were not measured.
        observed = OBSERVED[np.isfinite(response(*SPECIMENS))]
        prb.Simulator(
            "y", response, a, b, metric=prb.KullbackLeibler(), observed=observed, propagation=stored
        )
    return model


def design_of(model: pm.Model) -> tuple[Evaluator, ReweightedBound]:
    evaluator = Evaluator.of(model)
    return evaluator, evaluator.reweighted["y"]


@cache
def emulated() -> tuple[Evaluator, ReweightedBound]:
    """Return a design of 64 runs; tests that change it restore it."""
    return design_of(build())


def around(theta: Floats, spread: float = 0.1) -> Floats:
    return theta + spread * np.random.default_rng(0).standard_normal((64, 4))


@pytest.mark.parametrize("response", [smooth, failing])
def test_emulated_points_are_far_better_than_weighted_runs(response: Any) -> None:
    ma, la, mb, lb = THETA[0]
    z = np.random.default_rng(7).standard_normal((2, 200_000))
    truth = np.nanmean(response(ma + np.exp(la) * z[0], mb + np.exp(lb) * z[1]))
    errors = []
    for keywords in ({}, {"emulator": None}):
        evaluator, _ = design_of(build(response, **keywords))
        values, weights = evaluator.populations(THETA, 0)
        errors.append(abs(float((np.nan_to_num(values) * weights).sum()) - truth))
    assert errors[0] < 0.2 * errors[1]


def test_runs_are_counted_and_emulated_points_are_not() -> None:
    evaluator, bound = emulated()
    assert evaluator.n_responses == bound.n_runs == len(bound.first_responses) == 64
    assert bound.n_points == SIZES.first


def test_a_response_that_no_surface_follows_keeps_its_runs() -> None:
    evaluator, bound = design_of(build(jumping, 256))
    emulator = bound.design.emulator
    if emulator is None:
        assert bound.n_points == 256
    else:
        assert emulator.run_share > 0.1
    support = evaluator.support(THETA)["y"]
    assert support["mean_weight"] == pytest.approx(1.0, abs=0.2)


def test_a_sample_reaches_other_populations_and_the_prior_without_a_run() -> None:
    evaluator, bound = emulated()
    far = THETA + np.array([1.0, 1.0, -1.0, -1.0])
    prior = evaluator.hyperparameters.prior_thetas(200, 1)
    before = evaluator.support(far)["y"]["weight_ess"]
    with designs_restored([bound]):
        for _ in range(3):
            bound.reach(evaluator.parents(around(far), 0))
        assert evaluator.support(far)["y"]["weight_ess"] > 2 * before
        mass = np.median(evaluator.support(prior)["y"]["mean_weight"])
        assert mass == pytest.approx(1, abs=0.05)
        assert evaluator.n_responses == 64


@pytest.mark.long
def test_samples_grow_for_errors_of_points_and_runs_for_errors_of_emulators() -> None:
    evaluator, bound = design_of(build())
    thetas = around(THETA)
    assert not grow(evaluator, thetas, DesignErrors(points=0.05, emulators=0.05))
    assert grow(evaluator, thetas, DesignErrors(points=0.2, emulators=0.0))
    assert (bound.n_runs, bound.n_points) == (64, 2 * SIZES.first)
    assert grow(evaluator, thetas, DesignErrors(points=0.0, emulators=0.2))
    assert (bound.n_runs, bound.n_points) == (128, 2 * SIZES.first)
    # Another emulator has another sample, whose size is judged next.
    assert grow(evaluator, thetas, DesignErrors(points=0.2, emulators=0.2))
    assert bound.n_runs > 128
    assert bound.n_points == 2 * SIZES.first


def test_runs_are_added_where_emulators_predict_little(monkeypatch: pytest.MonkeyPatch) -> None:
    evaluator, bound = emulated()
    far = around(np.array([[2.5, 0.0, 2.5, 0.0]]), 0.01)
    for little, runs in ((0.25, 64), (0.0, 80)):
        monkeypatch.setattr("prbayes.optimize.design_refinement._POOR_EMULATOR", little)
        with designs_restored([bound]):
            assert refine_at(evaluator, far)
            assert bound.n_runs == runs


@pytest.mark.long
def test_the_error_of_emulators_is_measured_by_runs_that_are_left_out() -> None:
    errors = {}
    for kind, response in {"smooth": smooth, "kink": lambda a, b: np.abs(a - 1) + b}.items():
        model = build(response, known=True)
        optimum = prb.minimize(model, starts=0, refine=False, progressbar=False)
        sampling = SamplingDistribution.of(optimum.evaluator, optimum.theta, np.ones(1))
        errors[kind] = design_error(sampling)
    assert 0.01 < errors["kink"].emulators < np.inf
    assert errors["smooth"].emulators < 0.1 * errors["kink"].emulators
    assert 0.02 < errors["smooth"].points < 0.1


@pytest.mark.long
def test_parts_of_a_sample_without_a_minimum_leave_its_error_to_the_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    optimum = prb.minimize(build(known=True), starts=0, refine=False, progressbar=False)
    sampling = SamplingDistribution.of(optimum.evaluator, optimum.theta, np.ones(1))
    for lost, is_finite in ((3, True), (5, False)):
        minima = iter([(np.array([[k, -k]]), np.array([k >= lost])) for k in range(8)])
        monkeypatch.setattr(
            "prbayes.inference.design_error.minimise_sets",
            lambda *_, minima=minima, **__: next(minima),
        )
        assert np.isfinite(_error_of_points(sampling)).all() == is_finite


def test_another_response_is_computed_at_the_runs_and_emulated() -> None:
    _, bound = emulated()
    calls: list[int] = []

    def double(a: Any, b: Any) -> Any:
        calls.append(np.size(a))
        return 2 * smooth(a, b)

    second = bound.responses.copied()
    second.function = double
    expected = 2 * bound.design.sample.values
    np.testing.assert_allclose(bound.values_of(second), expected, rtol=1e-2, atol=1e-2)
    assert sum(calls) == 64
    # One that no surface follows is refused.
    rough_response = bound.responses.copied()
    rough_response.function = rough
    with pytest.raises(PoorEmulatorError, match="got a response of the same specimens"):
        bound.values_of(rough_response)


def rough(a: Any, b: Any) -> Any:
    return np.sin(1e3 * a) + np.sin(1e3 * b)


@pytest.mark.long
def test_another_response_that_no_emulator_follows_is_predicted_from_the_runs() -> None:
    model = build(n=700, known=True, emulator=prb.surrogate.RadialBasis())
    optimum = prb.minimize(model, starts=0, refine=False, progressbar=False)
    (bound,) = optimum.evaluator.reweighted.values()
    _, weights = optimum.evaluator.populations(optimum.theta[None], 0)
    inputs = optimum.evaluator.nodes[0].bound.inputs.aleatory
    predicted = prb.predict(optimum, rough, *inputs, n_samples=2000, random_seed=1)
    runs = rough(*bound.design.runs.points)
    assert np.isin(predicted, runs).all()
    # Sines of uniform phases.
    assert float(predicted.std()) == pytest.approx(1.0, abs=0.15)
    # The sample is restored.
    np.testing.assert_array_equal(optimum.evaluator.populations(optimum.theta[None], 0)[1], weights)


def test_a_compiled_discrepancy_has_the_sample_that_was_drawn_last() -> None:
    evaluator, bound = design_of(build())
    before = evaluator(THETA).discrepancies
    batches = identity_of(evaluator).simulators[0].batches
    compiled = evaluator.model.compile_logp(vars=[evaluator.model["y"]], mode=PLAIN)
    bound.reach(evaluator.parents(THETA, 0))
    after = evaluator(THETA).discrepancies
    assert 0 < abs(after - before)[0, 0] < 0.05 * before[0, 0]
    prb.set_epsilon(evaluator.model, {"y": 1.0})
    at = dict(zip([v.name for v in evaluator.model.value_vars], THETA[0], strict=True))
    assert -compiled(at) == pytest.approx(after[0, 0], rel=1e-9)
    # Another sample is another design.
    identity = identity_of(evaluator).simulators[0]
    assert identity.n_points == 64
    assert identity.batches != batches


def test_the_same_surfaces_are_judged_again_for_other_populations() -> None:
    # Smooth where the prior is, and with a corner at the populations that come next.
    evaluator, bound = design_of(build(lambda a, b: smooth(a, b) + np.abs(b - 0.5)))
    roots = evaluator.parents(THETA, 0)
    before = bound.design.emulator
    bound.reach(roots, same_surfaces=True)
    same = bound.design.emulator
    bound.reach(roots)
    fitted = bound.design.emulator
    assert before is not None
    assert same is not None
    assert fitted is not None
    assert same.emulator is before.emulator
    assert same.error != before.error
    assert fitted.runs is not before.runs
    np.testing.assert_array_equal(fitted.weights, same.weights)


@pytest.mark.long
def test_an_optimum_from_few_runs_is_that_of_many() -> None:
    few = prb.minimize(build(known=True), starts=0, progressbar=False)
    many = build(known=True, n=4096, emulator=None)
    fine = prb.minimize(many, starts=0, progressbar=False)
    assert few.n_responses <= 128
    off = (few.theta - fine.theta) / np.sqrt(np.diag(fine.covariance))
    assert np.abs(off).max() < 0.15


@pytest.mark.parametrize("discrete", [False, True])
def test_one_input_and_discrete_ones_are_not_emulated(discrete: bool) -> None:
    calls: list[int] = []

    def simulator(emulator: Any) -> pm.Model:
        with pm.Model() as model:
            inputs = [pm.Normal.dist(pm.Normal("ma", 1, 0.5), 1.0)]
            if discrete:
                inputs.append(pm.Poisson.dist(pm.LogNormal("lam", 1, 0.3)))
            prb.Simulator(
                "y", lambda *x: calls.append(1) or sum(x), *inputs, metric=prb.AreaMetric(),
                observed=OBSERVED, propagation=prb.Reweighted(64, emulator=emulator),
            )  # fmt: skip
        return model

    with pytest.raises(TypeError, match=r"y: emulator: got RadialBasis .* several continuous"):
        simulator(prb.surrogate.RadialBasis())
    assert len(calls) <= 1  # the trial of the response
    assert design_of(simulator("auto"))[1].design.emulated is None


@pytest.mark.long
def test_simulators_of_the_same_specimens_keep_the_same_points() -> None:
    with pm.Model() as model:
        a = pm.Normal.dist(pm.Normal("ma", 1, 0.5), pm.LogNormal("sa", 0, 0.5))
        b = pm.Normal.dist(pm.Normal("mb", 1, 0.5), pm.LogNormal("sb", -0.5, 0.5))
        for name, response in {"one": smooth, "two": lambda a, b: b + 0.1 * a * b}.items():
            prb.Simulator(
                name, response, a, b, metric=prb.KullbackLeibler(), observed=OBSERVED,
                propagation=prb.Reweighted(64), specimens=np.arange(OBSERVED.size),
            )  # fmt: skip
    evaluator = Evaluator.of(model)
    assert aligned(evaluator.nodes)
    far = THETA + np.array([0.5, -1.5, 0.5, -1.5])
    draw_samples(evaluator, far, {"one"})
    assert aligned(evaluator.nodes)
    draw_samples(evaluator, far, {"two"}, larger=True)
    assert aligned(evaluator.nodes)
    assert {d.n_points for d in evaluator.reweighted.values()} == {2 * SIZES.first}


def test_samples_are_of_populations_that_matter_and_of_the_prior() -> None:
    groups = [[np.zeros(500)], [np.ones(500)], [np.full(3, 2.0)]]
    for size in (SIZES.first, 2 * SIZES.first):
        (found,), shares = mixture_of(groups, size)
        of_each = [shares[found == k].sum() for k in range(3)]
        np.testing.assert_allclose(of_each, [1 / 16, 15 / 32, 15 / 32])
        assert (found > 0).sum() == 60 * size / SIZES.first
    (only,), shares = mixture_of(groups[:1], SIZES.first)
    np.testing.assert_allclose(shares, 1 / only.size)


def test_points_are_as_many_as_the_shares_of_their_populations() -> None:
    evaluator, bound = emulated()
    roots = evaluator.parents(evaluator.hyperparameters.prior_thetas(2, 0), 0)
    sampler = MixtureSampler("y", bound.inputs, PopulationDensity(bound.inputs))
    _, mixture = sampler.draw(roots, 1024, 3, np.array([0.125, 0.875]))
    np.testing.assert_array_equal(mixture.counts, [128, 896])


@pytest.mark.parametrize("size", [1, 2, 3, 40, 200])
def test_populations_of_a_group_count_alike(size: int) -> None:
    (found,) = spread_over([np.arange(size)], 40)
    assert len(found) == 40
    assert found[0] == 0
    counts = np.bincount(found, minlength=size)
    if size <= 40:
        assert np.ptp(counts) <= 1
    else:
        assert counts.max() == 1
        assert found[-1] == size - 1
