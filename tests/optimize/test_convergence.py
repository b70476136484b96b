"""Budgets and tolerances, starting points, and a million responses."""

from typing import Any

import numpy as np
import pymc as pm
import pytest
from normal_problem import OBSERVED, best, model, normal_model, pair
from scipy import stats

import prbayes as prb
from prbayes.model.evaluator import Evaluator, compiled_objective
from prbayes.numerics.derivatives import differences
from prbayes.optimize.convergence import (
    Fit,
    Result,
    Search,
    Trace,
    _newton_step,
    approach,
    overlapping_populations,
    settle,
)
from prbayes.optimize.objective import Minimisation, Objective

# -- budgets, tolerances, trace --------------------------------------------------------------------


@pytest.mark.parametrize(
    ("method", "box"),
    [("BFGS", False), ("L-BFGS-B", True), ("Nelder-Mead", False)],
)
def test_the_budget_means_the_same_for_all_methods(method: str, box: bool) -> None:
    response = (lambda x: np.array(x, dtype=float)) if box else (lambda x: x)
    problem = normal_model(prb.Resimulated(64), response)
    optimum = prb.minimize(
        problem, method=method, max_evaluations=7, start={"mu": -1.0, "sigma": 1.5}
    )
    assert not optimum.converged
    assert "max_evaluations = 7" in optimum.message
    assert optimum.to_datatree()["optimum"].attrs["converged"] == 0
    trace = optimum.search.trace
    np.testing.assert_allclose(optimum.discrepancy, trace["discrepancy"].min(), rtol=1e-9)
    # A gradient by differences is five evaluations, and is not cut short.
    assert 7 <= optimum.search.n_evaluations < 7 + 5
    assert trace["evaluations"][-1] == optimum.search.n_evaluations
    steps = np.diff(trace["evaluations"], prepend=0)
    assert set(steps) == ({5} if box else {1})


def test_units_do_not_matter() -> None:
    unit = 1e6
    problem = normal_model(prb.Resimulated(256), unit=unit)
    optimum = prb.minimize(problem, start={"mu": 0.5 * unit, "sigma": 0.8 * unit})
    assert optimum.converged
    assert optimum.search.n_evaluations == best().search.n_evaluations <= 15
    np.testing.assert_allclose(pair(optimum) / unit, pair(best()), rtol=1e-6)


def test_the_tolerance_is_that_of_the_standardised_gradient() -> None:
    evaluator = Evaluator.of(model())
    size, prior_sd = evaluator.nodes[0].target.scale, evaluator.hyperparameters.prior_sd
    counts = []
    for tolerance in (1e-1, 1e-6):
        optimum = prb.minimize(model(), start={"mu": -1.0, "sigma": 1.5}, tolerance=tolerance)
        gradient = compiled_objective(evaluator, prior=False, gradient=True)(
            optimum.theta, np.ones(1)
        )[1]
        assert np.abs(gradient * prior_sd).max() / size <= tolerance
        counts.append(optimum.search.n_evaluations)
    assert counts == sorted(counts)


def test_exact_and_differenced_gradients_agree() -> None:
    evaluator, scales = Evaluator.of(model()), np.array([0.7])
    theta = np.array([0.4, -0.3])
    exact = compiled_objective(evaluator, prior=False, gradient=True)(theta, scales)
    by_differences = differences(lambda t: evaluator.total(t, scales), np.array([2e-4, 1e-4]))
    value, gradient, cost = by_differences(theta)
    assert cost == 5
    np.testing.assert_allclose(value, exact[0], rtol=1e-12)
    np.testing.assert_allclose(gradient, exact[1], rtol=1e-5)


def test_batches_and_the_compiled_objective_agree_with_other_terms() -> None:
    with normal_model(prb.Resimulated(256)) as observed:
        pm.Normal("z", observed["mu"], 0.2, observed=[0.5, 0.9])
        pm.Potential("limit", -((observed["sigma"] - 1.0) ** 2))
    evaluator, scales = Evaluator.of(observed), np.array([0.7])
    theta = np.array([0.4, -0.3])
    compiled = compiled_objective(evaluator, prior=False, gradient=False)(theta, scales)[0]
    np.testing.assert_allclose(evaluator.total(theta[None], scales), [compiled], rtol=1e-12)
    point = evaluator.hyperparameters.constrained(theta[None])
    mu, sigma = point["mu"][0], point["sigma"][0]
    other = stats.norm.logpdf([0.5, 0.9], mu, 0.2).sum() - (sigma - 1.0) ** 2
    distance = evaluator.discrepancies(theta[None], 0)[0] / 0.7
    np.testing.assert_allclose(compiled, distance - other, rtol=1e-10)


def test_an_inverse_distribution_function_without_gradient_is_differenced() -> None:
    """PyTensor has no gradient of the gamma distribution's in its shape."""
    observed = np.random.default_rng(5).gamma(16, 1 / 16, 60)
    with pm.Model() as gamma:
        x = pm.Gamma.dist(mu=pm.HalfNormal("mu", 2), sigma=pm.HalfNormal("sigma", 1))
        given = {"metric": prb.KullbackLeibler(), "propagation": prb.Resimulated(512)}
        prb.Simulator("y", lambda x: 2 * x - x, x, observed=observed, **given)
    optimum = prb.minimize(gamma)
    assert optimum.converged
    assert optimum.point["mu"] == pytest.approx(observed.mean(), abs=0.05)
    assert optimum.point["sigma"] == pytest.approx(observed.std(), rel=0.15)


# -- stalled line searches -------------------------------------------------------------------------


def test_the_area_metric_takes_few_evaluations() -> None:
    response = lambda x: x**2 - 2 * x + 1  # noqa: E731
    observed = response(np.random.default_rng(1).normal(2, 0.5, 50))
    with pm.Model() as problem:
        x = pm.Normal.dist(pm.TruncatedNormal("mu", 2, 1, lower=1), pm.HalfNormal("sigma", 1))
        prb.Simulator("y", response, x, metric=prb.AreaMetric(), observed=observed)
    optimum = prb.minimize(problem, starts=0)
    assert optimum.converged
    # Numbers of the line search are not for users.
    assert optimum.message == Result.SETTLED_BY_GRADIENTS.value
    # Its line search ends at the kinks of a thousand points: 23 here, 87 by a simplex.
    assert optimum.search.n_evaluations <= 40
    simplex = prb.minimize(problem, starts=0, method="Nelder-Mead")
    assert optimum.discrepancy < simplex.discrepancy * (1 + 1e-4)


def valley(t: Any) -> Any:
    """Return a valley with a kink along its bottom, lowest at (1, -1), and its gradient."""
    across, along = t[0] + t[1], t[0] - t[1] - 2
    slope = np.sign(across) * np.ones(2) + 4 * along * np.array([1.0, -1.0])
    return 1 + abs(across) + 2 * along**2, slope, 1


def step_from(function: Any, at: Any) -> Any:
    at, size = np.array(at), len(at)
    options: Any = {"gradient": True, "max_evaluations": 100}
    objective = Objective(function, np.zeros(size), np.ones(size), 1.0, **options)
    return _newton_step(objective, at, 0.01)


def test_newton_steps_from_gradients_a_distance_apart() -> None:
    # At a kink, where each step across goes up: along it, up to ten times the distance.
    step, gain, _ = step_from(valley, [0.2, -0.2])
    np.testing.assert_allclose(step[0], -step[1], atol=1e-9)
    assert np.hypot(*step) == pytest.approx(0.1)
    assert gain == np.inf
    step, gain, _ = step_from(valley, [0.99, -0.99])
    np.testing.assert_allclose(step, [0.01, -0.01], atol=1e-9)
    assert gain == pytest.approx(valley([0.99, -0.99])[0] - 1, rel=1e-6)
    assert abs(step_from(valley, [1.0, -1.0])[1]) < 1e-12
    # Newton's step of a smooth function, downhill where it bends down, and none from a saddle.
    bends = np.array([[3.0, 1.0, 0.5], [1.0, 2.0, 0.0], [0.5, 0.0, 1.0]])
    step, _, _ = step_from(lambda t: (t @ bends @ t / 2, bends @ t, 1), [0.03, -0.05, 0.01])
    np.testing.assert_allclose(step, [-0.03, 0.05, -0.01])
    step, _, downhill = step_from(lambda t: (-t @ t / 2, -t, 1), [0.5, -0.5])
    np.testing.assert_allclose(step, [0.1, -0.1])
    assert (downhill @ np.array([-0.5, 0.5]) <= 0).all()
    saddle = np.array([2.0, -2.0])
    step, gain, _ = step_from(lambda t: (t @ (saddle * t) / 2, saddle * t, 1), [0.0, 0.0])
    np.testing.assert_allclose(np.abs(step), [0.0, 0.1], atol=1e-12)
    assert gain == np.inf
    assert step_from(lambda t: (np.nan, np.zeros(2), 1), [0.99, -0.99])[1] == np.inf


def settled(function: Any, at: list[float], most: int = 1000, count: int = 10) -> Fit:
    """Settle a line search that gave up at a place of a function."""

    class OfFunction(Search):
        def objective(
            self, center: Any, scales: Any, size: float, spent: int, *, gradient: bool
        ) -> Objective:
            alone = function if gradient else lambda theta: (function(theta)[0], None, 1)
            options: Any = {"gradient": gradient, "max_evaluations": most - spent}
            return Objective(alone, center, self.prior_sd, size, **options)

    search = OfFunction(
        Evaluator.of(model()), np.ones(2), Minimisation(tolerance=1e-5, max_evaluations=most)
    )
    end = np.array(at)
    value = float(function(end)[0])
    trace = Trace((end,), (value,), (count,), count)
    return settle(search, Fit(end, Result.STALLED, "", trace, np.zeros(2), np.ones(1), value, 1.0))


def test_a_line_search_at_a_kink_goes_on_along_it() -> None:
    fit = settled(valley, [0.99, -0.99])
    assert fit.result.converged
    np.testing.assert_allclose(fit.theta, [1.0, -1.0], atol=1e-6)
    assert fit.lowest == pytest.approx(1)
    assert fit.trace.count == 10 + 2 * 5 + 2
    assert fit.details.startswith("By gradients, a better value would be lower by ")
    # Nor is a spent budget convergence, even on the last evaluations around.
    fit = settled(valley, [0.2, -0.2], most=13)
    assert (fit.result, fit.trace.count) == (Result.MAX_EVALUATIONS, 13)
    assert fit.details == "max_evaluations = 13."
    assert not settled(valley, [1.0, -1.0], most=16).result.converged


def test_values_lower_than_gradients_promise_are_followed() -> None:
    fit = settled(lambda t: (1.0 - 0.1 * np.sum(t > 0.002), np.zeros(2), 1), [0.0, 0.0])
    assert fit.result.converged
    assert fit.lowest == pytest.approx(0.8)
    assert fit.trace.count == 10 + 3 * 5 + 2


def test_a_small_minimum_on_a_slope_is_left() -> None:
    def slope(t: Any) -> Any:
        near = np.clip(t, -0.01, 0.01)  # a dent around zero
        return 2 + 0.5 * np.sum(t) + 60 * near @ near, 0.5 + 120 * near, 1

    fit = settled(slope, [0.0, 0.0], most=60)
    assert fit.lowest < 1.95  # 1.998 in the dent
    assert not fit.result.converged  # the slope has no end


@pytest.mark.parametrize("cost", [1, 60])
def test_a_simplex_decides_where_gradients_promise_too_much(cost: int) -> None:
    fit = settled(lambda t: (1 + t @ t, np.array([1.0, 1.0]) + 0 * t, cost), [0.0, 0.0])
    assert "A search around it gained 0.0e+00" in fit.details
    assert fit.result.converged
    # Differences that take many evaluations are not asked for all rounds.
    assert fit.trace.count < 10 + 5 * 60 + 120


# -- starting points -------------------------------------------------------------------------------


def test_points_of_the_prior_are_spread_evenly_and_follow_hierarchies() -> None:
    with pm.Model() as hierarchical:
        center = pm.Normal("center", 3.0, 2.0)
        means = pm.Normal("means", center, 0.1, shape=2)
        x = pm.Normal.dist(means[0] + means[1], pm.Gamma("sigma", 2, 1))
        given = {"metric": prb.AreaMetric(), "propagation": prb.Resimulated(8)}
        prb.Simulator("y", lambda x: x, x, observed=OBSERVED, **given)
    hyperparameters = Evaluator.of(hierarchical).hyperparameters
    thetas = hyperparameters.prior_points(256, 0)
    np.testing.assert_array_equal(thetas, hyperparameters.prior_points(256, 0))
    named = dict(zip(hyperparameters.names, thetas.T, strict=True))
    centers, sigmas = named["center"], np.exp(named["sigma_log__"])
    for levels in (stats.norm(3, 2).cdf(centers), stats.gamma(2).cdf(sigmas)):
        # A net: one point in each of 256 intervals of equal probability; independent draws leave a
        # third of them empty.
        assert np.unique((levels * 256).astype(int)).size > 250
    for i in range(2):
        np.testing.assert_allclose(np.std(named[f"means[{i}]"] - centers), 0.1, rtol=0.05)
    # Priors without an inverse distribution function are drawn.
    with pm.Model() as circular:
        x = pm.Normal.dist(pm.VonMises("mu", 0.0, 1.0), 1.0)
        prb.Simulator("y", lambda x: x, x, metric=prb.AreaMetric(), observed=OBSERVED)
    drawn = Evaluator.of(circular).hyperparameters
    np.testing.assert_array_equal(drawn.prior_points(16, 3), drawn.prior_thetas(16, 3))


@pytest.mark.parametrize("propagation", [prb.Reweighted(256), prb.Resimulated(256)], ids=["stored", "computed"])  # fmt: skip
def test_a_start_with_overlap_is_kept(propagation: Any) -> None:
    evaluator = Evaluator.of(normal_model(propagation))
    search = Search(evaluator, np.ones(2), Minimisation(max_evaluations=100))
    theta = np.array([0.3, 0.0])
    near, trace = approach(search, theta, np.ones(1), Trace())
    assert near is theta
    assert trace.count == 0
    far, trace = approach(search, np.array([9.0, -1.0]), np.ones(1), Trace())
    assert overlapping_populations(evaluator, far[None])[1].min() > 0.5
    assert trace.count > 0


# -- a million responses ---------------------------------------------------------------------------


def test_monte_carlo_points_agree_with_sobol_points() -> None:
    model = normal_model(prb.Resimulated(20_000, points="monte_carlo"))
    random = prb.minimize(model, start=best().point)
    # The error of independent points is sqrt(N / n) standard errors.
    limit = 4 * np.sqrt(50 / 20_000)
    errors = np.array([best().stderr["mu"], best().stderr["sigma"]])
    assert (np.abs(pair(random) - pair(best())) < limit * errors).all()
    assert (pair(random) != pair(best())).all()
