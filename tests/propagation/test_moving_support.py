"""Densities whose support moves with the hyperparameters, under stored responses."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest
from first_use import first_use

import prbayes as prb
from prbayes.model.evaluator import Evaluator, compiled_objective
from prbayes.model.parameters import unconstrained
from prbayes.propagation.importance import MixtureSampler
from prbayes.propagation.moving_support import (
    averaged_log_density,
    cells_around,
    moving_inputs,
    refuse_moving_atoms,
)
from prbayes.propagation.population_density import PopulationDensity
from prbayes.response.compile import PLAIN
from prbayes.response.distributions import PriorSampler
from prbayes.response.inputs import read_inputs

METRICS = [
    prb.ProbabilityResidual(),
    prb.KullbackLeibler(),
    prb.AreaMetric(),
    prb.LogLikelihood(density=prb.GaussianKDE()),
]


def of_kind(metric: prb.Metric) -> str:
    return type(metric).__name__


def uniform(metric: prb.Metric, propagation: Any = None, n: int = 50, seed: int = 0) -> pm.Model:
    observed = 2 + 3 * np.random.default_rng(seed).random(n)
    with pm.Model() as model:
        start = pm.Normal("start", 1, 2)
        width = pm.HalfNormal("width", 4)
        x = pm.Uniform.dist(start, start + width)
        propagation = propagation or prb.Reweighted(256)
        prb.Simulator(
            "y", np.positive, x, metric=metric, observed=observed, propagation=propagation
        )
    return model


def stored(dist: Callable[[], Any], **keywords: Any) -> Any:
    with pm.Model() as model:
        observed = np.linspace(0.5, 1.5, 20)
        common = {"metric": prb.AreaMetric(), "observed": observed}
        prb.Simulator("y", np.positive, dist(), propagation=prb.Reweighted(64), **common)
    (node,) = first_use(model).values()
    return node.bound


def test_cells_meet_half_way_and_have_the_outermost_points_in_their_middle() -> None:
    lower, upper = cells_around(np.array([3.0, 0.0, 1.0, 7.0]), 1)
    np.testing.assert_allclose(lower, [2.0, -0.5, 0.5, 5.0])
    np.testing.assert_allclose(upper, [5.0, 0.5, 2.0, 9.0])
    columns = np.random.default_rng(0).normal(size=(40, 2))
    lower, upper = cells_around(columns, 3)
    np.testing.assert_array_equal(lower[:, 1], cells_around(columns[:, 1], 3)[0])
    assert ((lower < columns) & (columns < upper)).all()


def test_the_mean_density_of_a_cell_is_that_of_its_part_inside_the_support() -> None:
    ends = pt.dvector("lower"), pt.dvector("upper")
    x = pt.dvector("x")
    graph = averaged_log_density(pm.Uniform.dist(0.0, 2.0), x, *ends)
    at = {x: [1.0, 0.25, 2.5], ends[0]: [0.9, -0.5, 1.0], ends[1]: [1.1, 1.0, 4.0]}
    found = graph.eval(at, mode=PLAIN)
    np.testing.assert_allclose(np.exp(found), [0.5, 0.5 / 1.5, 0.5 / 3.0])
    # Far in the tail it is the density at the point.
    dist = pm.TruncatedNormal.dist(0.0, 1.0, lower=-1.0)
    points = np.array([9.0, 12.0])
    graph = averaged_log_density(dist, points, points - 0.1, points + 0.1)
    expected = pm.logp(dist, points).eval(mode=PLAIN)
    np.testing.assert_allclose(graph.eval(mode=PLAIN), expected)


SUPPORTS = {  # and whether they move
    "Uniform": (lambda: pm.Uniform.dist(pm.Normal("a", 0, 0.3), 2.0), True),
    "lower end": (lambda: pm.TruncatedNormal.dist(1.0, lower=pm.Normal("a", 0, 0.3)), True),
    "Pareto": (lambda: pm.Pareto.dist(3.0, pm.HalfNormal("a", 1.0)), True),
    "Normal": (lambda: pm.Normal.dist(pm.Normal("a", 0, 0.3), 1.0), False),
    "Gamma": (lambda: pm.Gamma.dist(mu=1.0, sigma=pm.HalfNormal("a", 1.0)), False),
    "fixed end": (lambda: pm.TruncatedNormal.dist(pm.Normal("a", 0, 1), lower=-1.0), False),
    "without hyperparameters": (lambda: pm.Uniform.dist(0.0 * pm.Normal("a"), 1.0), False),
}


def moves(distribution: Callable[[], Any]) -> bool:
    """Return whether the support of an input moves, at points of 64 populations of the prior."""
    with pm.Model() as model:
        inputs = read_inputs("y", [distribution()], model)
    components = PriorSampler(inputs.parents)(64, 0)
    sampler = MixtureSampler("y", inputs, PopulationDensity(inputs))
    points, _ = sampler.draw(components, 64, 0)
    return moving_inputs("y", inputs, components, points) == (0,)


@pytest.mark.parametrize("kind", SUPPORTS)
def test_supports_that_move_and_stay(kind: str) -> None:
    distribution, is_moving = SUPPORTS[kind]
    assert moves(distribution) == is_moving


def test_a_discrete_support_that_moves_is_refused() -> None:
    with pytest.raises(TypeError, match=r"support that moves .*use propagation=prb\.Fresh\(\)"):
        moves(lambda: pm.DiscreteUniform.dist(pm.Poisson("a", 3.0), 20))


@pytest.mark.long
@pytest.mark.parametrize("metric", METRICS[::2], ids=of_kind)
def test_the_gradient_is_that_of_the_discrepancy_where_an_edge_is(metric: prb.Metric) -> None:
    evaluator = Evaluator.of(uniform(metric))
    theta = unconstrained(evaluator.hyperparameters, {"start": 2.013, "width": 3.05})
    _, gradient = compiled_objective(evaluator, prior=False, gradient=True)(theta, np.ones(1))
    assert np.abs(gradient).min() > 1e-3
    step = 1e-6
    for i, unit in enumerate(np.eye(2)):
        up, down = (evaluator.discrepancies((theta + s * unit)[None], 0) for s in (step, -step))
        assert gradient[i] == pytest.approx(float(up[0] - down[0]) / (2 * step), rel=1e-4, abs=1e-6)


@pytest.mark.long
@pytest.mark.parametrize("metric", METRICS[1:3], ids=of_kind)
def test_the_optimum_and_its_standard_errors_are_those_of_a_fine_resimulation(
    metric: prb.Metric,
) -> None:
    found = prb.minimize(uniform(metric), progressbar=False)
    fine = prb.minimize(uniform(metric, prb.Resimulated(8192)), progressbar=False)
    assert found.converged
    for name in ("start", "width"):
        error = float(found.stderr[name])
        assert 0.03 < error < 0.4
        assert abs(float(found.point[name]) - float(fine.point[name])) < 0.3 * error


def mixture_of_a_point(point: Any) -> Any:
    return pm.Mixture.dist([0.3, 0.7], [pm.DiracDelta.dist(point), pm.Normal.dist(0.0, 1.0)])


def censored(bound: Any) -> Any:
    return pm.Censored.dist(pm.Normal.dist(0.0, 1.0), lower=bound, upper=5.0)


@pytest.mark.parametrize("dist", [mixture_of_a_point, censored])
def test_a_value_that_has_probability_and_moves_is_refused(dist: Callable[[Any], Any]) -> None:
    with pytest.raises(TypeError, match=r"values that move .* have probability .*prb.Fresh\(\)"):
        stored(lambda: dist(pm.Normal("a", 0, 1)))


def test_a_value_that_has_probability_and_stays_has_its_share() -> None:
    bound = stored(lambda: mixture_of_a_point(0.0 * pm.Normal("a", 0, 1) + 0.25))
    values, weights = bound.populations([np.array([0.3])])
    assert weights[values == 0.25].sum() == pytest.approx(0.3, abs=0.03)


def test_values_that_meet_by_accident_are_no_atoms() -> None:
    with pm.Model() as model:
        inputs = read_inputs("y", [pm.Normal.dist(pm.Normal("a", 0, 1), 1.0)], model)
    which = np.repeat(np.arange(512), 32)
    x = np.random.default_rng(0).normal(size=which.size)
    x[: 7 * 32] = np.repeat(np.arange(7.0), 32)
    refuse_moving_atoms("y", inputs, [x], which)
    x[: 8 * 32] = np.repeat(np.arange(8.0), 32)
    with pytest.raises(TypeError, match="values that move"):
        refuse_moving_atoms("y", inputs, [x], which)


def test_the_weights_follow_the_design_when_it_grows() -> None:
    model = uniform(prb.AreaMetric(), prb.Reweighted(64))
    evaluator = Evaluator.of(model)
    theta = unconstrained(evaluator.hyperparameters, {"start": 2.0, "width": 3.0})[None]
    prb.refine(model, thetas=np.array([[2.0, np.log(3.0)]]))
    values, weights = evaluator.populations(theta, 0)
    assert float(weights[0] @ values[0]) == pytest.approx(3.5, abs=0.02)
    (mass,) = evaluator.support(theta)["y"]["mean_weight"]
    assert mass == pytest.approx(1.0, abs=0.05)


def test_a_support_that_moves_is_found_in_any_chunk_of_points(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with pm.Model() as model:
        lower = pm.Normal("lower", 0, 1)
        inputs = read_inputs("y", [pm.Uniform.dist(lower, lower + 3.0)], model)
    monkeypatch.setattr("prbayes.propagation.moving_support.AT_ONCE", 4)  # two points at a time
    components = [np.array([0.0, 1.0])]
    points = np.full(7, 2.0)
    assert moving_inputs("y", inputs, components, [points]) == ()
    for place in (0, 6):
        points[place] = -1.0  # outside of both populations
        assert moving_inputs("y", inputs, components, [points]) == ()
        points[place] = 0.5
        assert moving_inputs("y", inputs, components, [points]) == (0,)
        points[place] = 2.0
