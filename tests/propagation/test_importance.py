"""A design of several inputs tells far more than its runs: a cloud of points is emulated."""

from __future__ import annotations

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
from prbayes.propagation.base import DesignError
from prbayes.propagation.importance import SIZES, MixtureSampler, columns, mixture_of, spread_over
from prbayes.propagation.population_density import PopulationDensity
from prbayes.propagation.reweighted import PoorEmulatorError, ReweightedBound, designs_restored
from prbayes.response.budget import BudgetError
from prbayes.response.compile import PLAIN

AT = np.array([[1.1, 0.9, -0.2, -0.5]])


def smooth(a: Any, b: Any) -> Any:
    return a * np.exp(0.3 * b) + 0.2 * b**2


# Of specimens whose inputs have means 1.2 and 1, and standard deviations .8 and .6.
OBSERVED = smooth(
    *(np.array([[1.2], [1.0]]) + [[0.8], [0.6]] * np.random.default_rng(1).normal(size=(2, 40)))
)


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
        prb.Simulator(
            "y", response, a, b, metric=prb.KullbackLeibler(), observed=OBSERVED, propagation=stored
        )
    return model


def design_of(model: pm.Model) -> tuple[Evaluator, ReweightedBound]:
    evaluator = Evaluator.of(model)
    return evaluator, evaluator.reweighted["y"]


def theta_of(evaluator: Evaluator) -> Floats:
    # The elements in the order of the model: ma, sa (log), mb, sb (log).
    return AT[:, [0, 2, 1, 3]]


@pytest.mark.parametrize("response", [smooth, failing])
def test_emulated_points_are_far_better_than_weighted_runs(response: Any) -> None:
    emulated, alone = build(response), build(response, emulator=None)
    errors = []
    for model in (emulated, alone):
        evaluator, _ = design_of(model)
        values, weights = evaluator.populations(theta_of(evaluator), 0)
        found = float((np.nan_to_num(values) * weights).sum())
        errors.append(abs(found - _truth_at(response)))
    assert errors[0] < 0.2 * errors[1]


def _truth_at(response: Any) -> float:
    z = np.random.default_rng(7).standard_normal((2, 1_000_000))
    ma, la, mb, lb = AT[0][[0, 2, 1, 3]]
    found = response(ma + np.exp(la) * z[0], mb + np.exp(lb) * z[1])
    return float(np.nan_to_num(found).mean())


def test_runs_are_counted_and_cloud_points_are_not() -> None:
    model = build()
    evaluator, bound = design_of(model)
    assert evaluator.n_responses == bound.n_runs == 64
    assert bound.n_points == SIZES.first
    assert len(bound.first_responses) == 64


def test_weights_are_one_on_average_with_runs_among_the_points() -> None:
    evaluator, bound = design_of(build(jumping, 256))
    emulation = bound.design.emulator
    if emulation is None:
        assert bound.n_points == 256
    support = evaluator.support(theta_of(evaluator))["y"]
    assert support["mean_weight"] == pytest.approx(1.0, abs=0.2)


def test_a_response_that_no_surface_follows_keeps_its_runs() -> None:
    _, bound = design_of(build(jumping, 256))
    emulation = bound.design.emulator
    assert emulation is None or emulation.run_share > 0.1


def test_a_cloud_reaches_other_populations_without_a_run() -> None:
    evaluator, bound = design_of(build())
    far = theta_of(evaluator) + np.array([1.0, 1.0, -1.0, -1.0])
    before = evaluator.support(far)["y"]["weight_ess"]
    bound.reach(evaluator.roots(far + 0.1 * np.random.default_rng(0).standard_normal((64, 4)), 0))
    assert evaluator.support(far)["y"]["weight_ess"] > 2 * before
    assert evaluator.n_responses == 64


def test_the_prior_stays_in_reach() -> None:
    evaluator, bound = design_of(build())
    far = theta_of(evaluator) + np.array([1.0, 1.0, -2.0, -2.0])
    for _ in range(3):
        bound.reach(evaluator.roots(np.repeat(far, 16, axis=0), 0))
    prior = evaluator.hyperparameters.prior_thetas(200, 1)
    assert np.median(evaluator.support(prior)["y"]["mean_weight"]) == pytest.approx(1, abs=0.05)


@pytest.mark.long
def test_clouds_grow_for_their_points_and_runs_for_what_emulators_say() -> None:
    evaluator, bound = design_of(build())
    thetas = theta_of(evaluator) + 0.1 * np.random.default_rng(0).standard_normal((64, 4))
    assert not grow(evaluator, thetas, DesignErrors(points=0.05, emulators=0.05))
    assert grow(evaluator, thetas, DesignErrors(points=0.2, emulators=0.0))
    assert (bound.n_runs, bound.n_points) == (64, 2 * SIZES.first)
    assert grow(evaluator, thetas, DesignErrors(points=0.0, emulators=0.2))
    assert (bound.n_runs, bound.n_points) == (128, 2 * SIZES.first)
    # Another emulator has another cloud: whether that is large enough is seen next.
    assert grow(evaluator, thetas, DesignErrors(points=0.2, emulators=0.2))
    assert bound.n_runs > 128
    assert bound.n_points == 2 * SIZES.first


@pytest.mark.parametrize(("little", "runs"), [(0.25, 64), (0.0, 80)])
def test_runs_are_added_where_emulators_tell_little(
    little: float, runs: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("prbayes.optimize.design_refinement._POOR_EMULATOR", little)
    far = np.array([[2.5, 0.0, 2.5, 0.0]]) + 0.01 * np.random.default_rng(0).normal(size=(64, 4))
    evaluator, bound = design_of(build())
    assert refine_at(evaluator, far)
    assert bound.n_runs == runs


def test_a_part_of_a_cloud_is_a_cloud_of_its_own_for_a_while() -> None:
    evaluator, bound = design_of(build())
    theta = theta_of(evaluator)
    values, weights = evaluator.populations(theta, 0)
    (whole,) = evaluator(theta).discrepancies
    rows = bound.blocks == 3
    with designs_restored([bound]):
        bound.design = bound.design.rows(rows)
        some, of_some = evaluator.populations(theta, 0)
        expected = weights[:, rows] / weights[:, rows].sum()
        np.testing.assert_allclose(of_some, expected, rtol=1e-9)
        np.testing.assert_array_equal(some, values[:, rows])
        (part,) = evaluator(theta).discrepancies
    assert 0 < abs(part[0] - whole[0]) < 0.2 * whole[0]
    np.testing.assert_array_equal(evaluator(theta).discrepancies[0], whole)
    np.testing.assert_array_equal(evaluator.populations(theta, 0)[1], weights)


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
@pytest.mark.parametrize(("lost", "known"), [(3, True), (5, False)])
def test_parts_of_a_cloud_without_a_minimum_leave_its_error_to_the_others(
    lost: int, known: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = build(known=True)
    optimum = prb.minimize(model, starts=0, refine=False, progressbar=False)
    sampling = SamplingDistribution.of(optimum.evaluator, optimum.theta, np.ones(1))
    minima = iter(
        [
            (np.array([[k, -k]]), np.array([converged]))
            for k, converged in enumerate([False] * lost + [True] * (8 - lost))
        ]
    )
    monkeypatch.setattr(
        "prbayes.inference.design_error.minimise_sets", lambda *_, **__: next(minima)
    )
    assert np.isfinite(_error_of_points(sampling)).all() == known


def test_another_response_is_computed_at_the_runs_and_emulated() -> None:
    evaluator, bound = design_of(build())
    calls: list[int] = []

    def double(a: Any, b: Any) -> Any:
        calls.append(np.size(a))
        return 2 * smooth(a, b)

    other = evaluator.nodes[0].bound.responses.copied()
    other.function = double
    np.testing.assert_allclose(
        bound.values_of(other), 2 * bound.design.sample.values, rtol=1e-2, atol=1e-2
    )
    assert sum(calls) == 64


def rough(a: Any, b: Any) -> Any:
    return np.sin(1e3 * a) + np.sin(1e3 * b)


@pytest.mark.long
def test_another_response_that_no_emulator_tells_is_predicted_from_the_runs() -> None:
    model = build(n=700, known=True, emulator=prb.surrogate.RadialBasis())
    optimum = prb.minimize(model, starts=0, refine=False, progressbar=False)
    (bound,) = optimum.evaluator.reweighted.values()
    values, weights = optimum.evaluator.populations(optimum.theta[None], 0)
    other = optimum.evaluator.nodes[0].bound.responses.copied()
    other.function = rough
    with pytest.raises(
        PoorEmulatorError, match="another response of the same specimens is not predicted"
    ):
        bound.values_of(other)
    inputs = optimum.evaluator.nodes[0].bound.inputs.aleatory
    predicted = prb.predict(optimum, rough, *inputs, n_samples=2000, random_seed=1)
    runs = rough(*bound.design.runs.points)
    assert np.isin(predicted, runs).all()
    # Sines of uniform phases.
    assert float(predicted.std()) == pytest.approx(1.0, abs=0.15)
    # The cloud is there again.
    np.testing.assert_array_equal(optimum.evaluator.populations(optimum.theta[None], 0)[1], weights)
    null = prb.validation.JointNull(optimum, responses=(rough, *inputs), replicates=99)
    test = prb.area_test(rough(*np.full((2, 20), 1.0) + np.arange(20)), predicted, null=null)
    assert 0 < test.p_value <= 1
    np.testing.assert_array_equal(optimum.evaluator.populations(optimum.theta[None], 0)[0], values)


@pytest.mark.long
def test_runs_that_are_too_few_for_another_response_are_refused() -> None:
    optimum = prb.minimize(build(), starts=0, refine=False, progressbar=False)
    inputs = optimum.evaluator.nodes[0].bound.inputs.aleatory
    with pytest.raises(DesignError, match=r"weight effective sample size of .* stored=False"):
        prb.predict(optimum, rough, *inputs, n_samples=100, random_seed=1)
    fresh = prb.predict(optimum, rough, *inputs, n_samples=500, random_seed=1, stored=False)
    null = prb.validation.JointNull(optimum, responses=(rough, *inputs), replicates=99)
    before = optimum.evaluator(optimum.theta[None]).discrepancies
    with pytest.raises(
        DesignError, match=r"JointNull: y: .* not predicted .* runs alone do not support"
    ):
        prb.area_test(np.linspace(-1, 1, 20), fresh, null=null)
    np.testing.assert_array_equal(optimum.evaluator(optimum.theta[None]).discrepancies, before)


def test_a_design_goes_back_to_what_it_was() -> None:
    evaluator, bound = design_of(build())
    before = evaluator(theta_of(evaluator)).discrepancies
    with designs_restored([bound]):
        bound.add(evaluator.roots(theta_of(evaluator), 0), 32)
        assert bound.n_runs == 96
    assert bound.n_runs == 64
    np.testing.assert_array_equal(evaluator(theta_of(evaluator)).discrepancies, before)


def test_a_discrepancy_follows_the_cloud_that_was_drawn_last() -> None:
    evaluator, bound = design_of(build())
    thetas = theta_of(evaluator)
    before = evaluator(thetas).discrepancies
    compiled = evaluator.model.compile_logp(vars=[evaluator.model["y"]], mode=PLAIN)
    bound.reach(evaluator.roots(thetas, 0))
    after = evaluator(thetas).discrepancies
    assert 0 < abs(after - before)[0, 0] < 0.05 * before[0, 0]
    prb.set_epsilon(evaluator.model, {"y": 1.0})
    at = dict(zip([v.name for v in evaluator.model.value_vars], thetas[0], strict=True))
    assert -compiled(at) == pytest.approx(after[0, 0], rel=1e-9)


def test_on_the_way_surfaces_stay_and_what_they_are_worth_is_judged_anew() -> None:
    # Smooth where the prior is, and with a corner where the populations are that come next.
    def corner(a: Any, b: Any) -> Any:
        return smooth(a, b) + np.abs(b - 0.5)

    evaluator, bound = design_of(build(corner))
    before = bound.design.emulator
    roots = evaluator.roots(theta_of(evaluator), 0)
    bound.reach(roots, same_surfaces=True)
    after = bound.design.emulator
    assert before is not None
    assert after is not None
    assert after.surfaces is before.surfaces
    assert after.runs is before.runs
    assert after.error != before.error
    # The same as if they were chosen anew, but for the surfaces.
    bound.reach(roots)
    anew = bound.design.emulator
    assert anew is not None
    assert anew.runs is not before.runs
    np.testing.assert_array_equal(anew.weights, after.weights)


def test_left_out_emulators_differ_where_the_emulator_is_wrong() -> None:
    _, bound = design_of(build(lambda a, b: np.abs(a - 1) + b))
    spread = [
        np.abs(values - bound.design.sample.values).max()
        for values in bound.design.without_each_block()
    ]
    assert len(spread) == 8
    assert min(spread) > 1e-3
    assert design_of(build(emulator=None))[1].design.without_each_block() == []


def test_an_optimum_from_few_runs_is_that_of_many() -> None:
    few = prb.minimize(build(known=True), starts=0, progressbar=False)
    many = build(known=True, n=4096, emulator=None)
    fine = prb.minimize(many, starts=0, progressbar=False)
    assert few.n_responses <= 128
    off = (few.theta - fine.theta) / np.sqrt(np.diag(fine.covariance))
    assert np.abs(off).max() < 0.15


@pytest.mark.parametrize("emulator", [3, "cubic", object()])
def test_what_is_no_emulator_is_refused(emulator: Any) -> None:
    with pytest.raises((TypeError, ValueError), match="Reweighted: emulator: got"):
        prb.Reweighted(64, emulator=emulator)


def test_one_input_and_discrete_ones_are_not_emulated() -> None:
    with pm.Model() as model:
        a = pm.Normal.dist(pm.Normal("ma", 1, 0.5), 1.0)
        stored = prb.Reweighted(64, emulator="auto")
        prb.Simulator(
            "y", lambda a: a, a, metric=prb.AreaMetric(), observed=OBSERVED, propagation=stored
        )
    assert design_of(model)[1].design.emulated is None
    with pm.Model() as model:
        a = pm.Normal.dist(pm.Normal("ma", 1, 0.5), 1.0)
        k = pm.Poisson.dist(pm.LogNormal("lam", 1, 0.3))
        stored = prb.Reweighted(64, emulator="auto")
        prb.Simulator(
            "y", lambda a, k: a + k, a, k,
            metric=prb.AreaMetric(), observed=OBSERVED, propagation=stored,
        )  # fmt: skip
    assert design_of(model)[1].design.emulated is None


def test_a_users_emulator_with_nothing_to_do_is_refused() -> None:
    calls: list[int] = []
    with pm.Model():
        a = pm.Normal.dist(pm.Normal("ma", 1, 0.5), 1.0)
        stored = prb.Reweighted(64, emulator=prb.surrogate.RadialBasis())
        keywords: dict[str, Any] = {"metric": prb.AreaMetric(), "observed": OBSERVED}
        with pytest.raises(TypeError, match=r"y: emulator: got RadialBasis .* several continuous"):
            prb.Simulator("y", lambda a: calls.append(1) or a, a, propagation=stored, **keywords)
    assert len(calls) <= 1  # the trial of the response


def test_another_response_that_no_surface_follows_is_refused() -> None:
    evaluator, bound = design_of(build(n=256))
    other = evaluator.nodes[0].bound.responses.copied()
    other.function = jumping
    with pytest.raises(
        DesignError, match="another response of the same specimens is not predicted"
    ):
        bound.values_of(other)


@pytest.mark.long
def test_simulators_of_the_same_specimens_keep_the_same_points() -> None:
    with pm.Model() as model:
        a = pm.Normal.dist(pm.Normal("ma", 1, 0.5), pm.LogNormal("sa", 0, 0.5))
        b = pm.Normal.dist(pm.Normal("mb", 1, 0.5), pm.LogNormal("sb", -0.5, 0.5))
        stored = prb.Reweighted(64, emulator="auto")
        specimens = np.arange(OBSERVED.size)
        for name, response in {"one": smooth, "two": lambda a, b: b + 0.1 * a * b}.items():
            prb.Simulator(
                name,
                response,
                a,
                b,
                metric=prb.KullbackLeibler(),
                observed=OBSERVED,
                propagation=stored,
                specimens=specimens,
            )
    evaluator = Evaluator.of(model)
    assert aligned(evaluator.nodes)
    far = theta_of(evaluator) + np.array([0.5, -1.5, 0.5, -1.5])
    draw_samples(evaluator, far, {"one"})
    assert aligned(evaluator.nodes)
    draw_samples(evaluator, far, {"two"}, larger=True)
    assert aligned(evaluator.nodes)
    assert {d.n_points for d in evaluator.reweighted.values()} == {2 * SIZES.first}


def test_another_cloud_is_another_design() -> None:
    evaluator, bound = design_of(build())
    before = identity_of(evaluator).simulators[0]
    bound.reach(evaluator.roots(theta_of(evaluator), 0))
    after = identity_of(evaluator).simulators[0]
    assert (before.n_points, after.n_points) == (64, 64)
    assert before.batches != after.batches


@pytest.mark.slow
def test_a_sampler_that_was_stopped_goes_on_with_its_clouds(tmp_path: Any) -> None:
    keywords: dict[str, Any] = {"chains": 1, "random_seed": 1, "progressbar": False}
    file = tmp_path / "run.nc"
    whole = prb.sample_smc(20, model=build(known=True), **keywords)
    with pytest.raises(BudgetError):
        prb.sample_smc(20, model=build(known=True), checkpoint=file, max_stages=1, **keywords)
    again = prb.sample_smc(20, model=build(known=True), checkpoint=file, **keywords)
    np.testing.assert_array_equal(again["posterior"]["ma"], whole["posterior"]["ma"])


def test_inputs_are_columns() -> None:
    assert columns([np.zeros(3), np.zeros((3, 2))]).shape == (3, 3)


def test_clouds_are_of_populations_that_matter_and_the_prior_stays() -> None:
    groups = [[np.zeros(500)], [np.ones(500)], [np.full(3, 2.0)]]
    for size in (SIZES.first, 2 * SIZES.first):
        (found,), shares = mixture_of(groups, size)
        of_each = [shares[found == k].sum() for k in range(3)]
        np.testing.assert_allclose(of_each, [1 / 16, 15 / 32, 15 / 32])
        assert (found > 0).sum() == 60 * size / SIZES.first
    (only,), shares = mixture_of(groups[:1], SIZES.first)
    np.testing.assert_allclose(shares, 1 / only.size)


def test_points_are_as_many_as_the_shares_of_their_populations() -> None:
    evaluator, bound = design_of(build())
    thetas = evaluator.hyperparameters.prior_thetas(2, 0)
    shares = np.array([0.125, 0.875])
    sampler = MixtureSampler("y", bound.inputs, PopulationDensity(bound.inputs))
    _, mixture = sampler.draw(evaluator.roots(thetas, 0), 1024, 3, shares)
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
