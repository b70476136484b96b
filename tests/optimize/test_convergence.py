"""Budgets and tolerances, starting points, and a million responses."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm
import pytest
from normal_problem import OBSERVED, best, model, normal_model, pair
from scipy import stats

import prbayes as prb
from prbayes.metrics.density import overlap as density_overlap
from prbayes.model.evaluator import Evaluator
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
from prbayes.optimize.objective import Method, Objective

# -- budgets, tolerances, trace
# --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("keywords", "words"),
    [({"tolerance": 0.0}, "tolerance"), ({"max_evaluations": 0}, "max_evaluations")],
)
def test_tolerance_and_budget_are_checked(keywords: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        prb.minimize(model(), **keywords)


@pytest.mark.parametrize("method", ["BFGS", "L-BFGS-B", "Nelder-Mead", "Powell"])
@pytest.mark.parametrize("box", [False, True], ids=["symbolic", "black box"])
def test_the_budget_means_the_same_for_all_methods(method: str, box: bool) -> None:
    response = (lambda x: np.array(x, dtype=float)) if box else (lambda x: x)
    other = normal_model(prb.Resimulated(64), response)
    found = prb.minimize(other, method=method, max_evaluations=7, start={"mu": -1.0, "sigma": 1.5})
    assert not found.converged
    assert "max_evaluations = 7" in found.message
    # A gradient by differences is five evaluations, and is not cut short.
    assert 7 <= found.search.n_evaluations < 7 + 5
    assert found.search.trace["evaluations"][-1] == found.search.n_evaluations
    steps = np.diff(found.search.trace["evaluations"], prepend=0)
    assert set(steps) == ({5} if box and method in {"BFGS", "L-BFGS-B"} else {1})


@pytest.mark.parametrize("unit", [1e-6, 1e6])
def test_units_do_not_matter(unit: float) -> None:
    found = prb.minimize(
        normal_model(prb.Resimulated(256), unit=unit), start={"mu": 0.5 * unit, "sigma": 0.8 * unit}
    )
    assert found.converged
    assert found.search.n_evaluations == best().search.n_evaluations <= 15
    np.testing.assert_allclose(pair(found) / unit, pair(best()), rtol=1e-6)


def test_the_tolerance_is_that_of_the_standardised_gradient() -> None:
    evaluator = Evaluator.of(model())
    size = evaluator.nodes[0].target.scale
    last = 0
    for tolerance in (1e-1, 1e-3, 1e-6):
        found = prb.minimize(model(), start={"mu": -1.0, "sigma": 1.5}, tolerance=tolerance)
        gradient = evaluator.objective(prior=False, gradient=True)(found.theta, np.ones(1))[1]
        scale = (
            np.subtract(
                *np.quantile(evaluator.hyperparameters.prior_thetas(256, 0), [0.84, 0.16], axis=0)
            )
            / 2
        )
        assert np.abs(gradient * scale).max() / size <= tolerance
        assert found.search.n_evaluations >= last
        last = found.search.n_evaluations


def test_exact_and_differenced_gradients_agree() -> None:
    evaluator, scales = Evaluator.of(model()), np.array([0.7])
    theta = np.array([0.4, -0.3])
    exact = evaluator.objective(prior=False, gradient=True)(theta, scales)
    value, gradient, cost = differences(
        lambda t: evaluator.total(t, scales), np.array([2e-4, 1e-4])
    )(theta)
    assert cost == 5
    np.testing.assert_allclose(value, exact[0], rtol=1e-12)
    np.testing.assert_allclose(gradient, exact[1], rtol=1e-5)


# -- starting points
# -------------------------------------------------------------------------------------


@pytest.mark.parametrize("response", [lambda x: x, lambda x: x**2 - 2 * x + 1], ids=["x", "x^2"])
def test_the_area_metric_takes_few_evaluations(response: Any) -> None:
    observed = response(np.random.default_rng(1).normal(2, 0.5, 50))
    with pm.Model() as other:
        x = pm.Normal.dist(pm.TruncatedNormal("mu", 2, 1, lower=1), pm.HalfNormal("sigma", 1))
        prb.Simulator("y", response, x, metric=prb.AreaMetric(), observed=observed)
    found = prb.minimize(other, starts=0)
    assert found.converged
    assert "gained nothing in 4 evaluations. Gradients around it promise a gain" in found.message
    # Its line search ends at the kinks of a thousand points: 18 and 23 here, 87 by a simplex.
    assert found.search.n_evaluations <= 40
    simplex = prb.minimize(other, starts=0, method="Nelder-Mead")
    assert found.discrepancy < simplex.discrepancy * (1 + 1e-4)


def valley(t: Any) -> Any:
    """Return a valley with a kink along its bottom, lowest at (1, -1), and its gradient."""
    across, along = t[0] + t[1], t[0] - t[1] - 2
    value = 1 + abs(across) + 2 * along**2
    slope = np.sign(across) * np.ones(2) + 4 * along * np.array([1.0, -1.0])
    return value, slope, 1


def objective(function: Any, size: int = 2) -> Objective:
    return Objective(
        function, np.zeros(size), np.ones(size), 1.0, gradient=True, max_evaluations=100
    )


def test_gradients_a_step_apart_see_along_a_kink() -> None:
    # At a kink, where each step across goes up, and a line search ends.
    at = np.array([0.2, -0.2])
    step, promised, _ = _newton_step(objective(valley), at, 0.01)
    np.testing.assert_allclose(step[0], -step[1], atol=1e-9)
    assert np.hypot(*step) == pytest.approx(0.1)  # as far as it may go beyond what it saw
    assert promised == np.inf
    at = np.array([0.99, -0.99])
    step, promised, _ = _newton_step(objective(valley), at, 0.01)
    np.testing.assert_allclose(step, [0.01, -0.01], atol=1e-9)
    assert promised == pytest.approx(valley(at)[0] - valley(at + step)[0], rel=1e-6)
    _, promised, _ = _newton_step(objective(valley), np.array([1.0, -1.0]), 0.01)
    assert abs(promised) < 1e-12
    # Where it is smooth the step is Newton's, and where it bends down it goes down.
    bends = np.array([[3.0, 1.0, 0.5], [1.0, 2.0, 0.0], [0.5, 0.0, 1.0]])
    smooth = objective(lambda t: (t @ bends @ t / 2, bends @ t, 1), size=3)
    step, promised, _ = _newton_step(smooth, np.array([0.03, -0.05, 0.01]), 0.01)
    np.testing.assert_allclose(step, [-0.03, 0.05, -0.01])
    step, _, ways = _newton_step(
        objective(lambda t: (-t @ t / 2, -t, 1)), np.array([0.5, -0.5]), 0.01
    )
    np.testing.assert_allclose(step, [0.1, -0.1])
    assert (ways @ np.array([-0.5, 0.5]) <= 0).all()  # against the slope
    saddle = objective(lambda t: (t[0] ** 2 - t[1] ** 2, np.array([2.0, -2.0]) * t, 1))
    step, promised, _ = _newton_step(saddle, np.zeros(2), 0.01)
    np.testing.assert_allclose(np.abs(step), [0.0, 0.1], atol=1e-12)
    assert promised == np.inf
    nowhere = objective(lambda t: (np.nan, np.zeros(2), 1))
    assert _newton_step(nowhere, at, 0.01)[1] == np.inf


def settled(function: Any, at: list[float], most: int = 1000, count: int = 10) -> Fit:
    """Settle a line search that gave up at a place of some function."""

    class Known(Search):
        def objective(
            self, center: Any, scales: Any, size: float, spent: int, *, gradient: bool
        ) -> Any:
            return Objective(
                function if gradient else lambda theta: (function(theta)[0], None, 1),
                *(center, self.prior_sd, size),
                gradient=gradient,
                max_evaluations=self.max_evaluations - spent,
            )

    search = Known(Evaluator.of(model()), np.ones(2), Method(), False, 1e-5, most)
    end = np.array(at)
    value = float(function(end)[0])
    trace = Trace((end,), (value,), (count,), count)
    return settle(search, Fit(end, Result.STALLED, "", trace, np.zeros(2), np.ones(1), value, 1.0))


def test_a_line_search_at_a_kink_goes_on_along_it() -> None:
    run = settled(valley, [0.99, -0.99])
    assert run.result.converged
    np.testing.assert_allclose(run.theta, [1.0, -1.0], atol=1e-6)
    assert run.lowest == pytest.approx(1)
    assert run.trace.count == 10 + 2 * 5 + 2
    assert run.details.startswith("Gradients around it promise a gain of ")


def test_what_is_lower_than_gradients_promise_is_followed() -> None:
    def stairs(t: Any) -> Any:
        return 1.0 - 0.1 * np.sum(t > 0.002), np.zeros(2), 1

    run = settled(stairs, [0.0, 0.0])
    assert run.result.converged
    assert run.lowest == pytest.approx(0.8)
    assert run.trace.count == 10 + 3 * 5 + 2


def test_a_small_minimum_on_a_slope_is_left() -> None:
    def slope(t: Any) -> Any:
        near = np.array([min(max(x, -0.01), 0.01) for x in t])  # a dent around zero
        return 2 + 0.5 * np.sum(t) + 60 * near @ near, 0.5 + 120 * near, 1

    run = settled(lambda t: (*slope(t)[:2], 1), [0.0, 0.0], most=60)
    assert run.lowest < 1.95  # 1.998 in the dent
    assert not run.result.converged  # it goes on down, and the slope has no end


def test_gradients_whose_promise_is_not_kept_leave_the_word_to_a_simplex() -> None:
    def promising(t: Any) -> Any:
        return 1 + t @ t, np.array([1.0, 1.0]) + 0 * t, 1

    run = settled(promising, [0.0, 0.0])
    assert run.result.converged
    assert "A simplex from there gained 0.0e+00" in run.details
    # Differences that take many evaluations are not asked for all rounds.
    run = settled(lambda t: (*promising(t)[:2], 60), [0.0, 0.0])
    assert "A simplex from there" in run.details
    assert run.trace.count < 10 + 5 * 60 + 120


def test_a_budget_that_is_spent_is_not_convergence() -> None:
    run = settled(valley, [0.2, -0.2], most=13)
    assert not run.result.converged
    assert run.result is Result.MAX_EVALUATIONS
    assert run.details == "max_evaluations = 13."
    assert run.trace.count == 13
    # Nor where it is spent on the last look around.
    run = settled(valley, [1.0, -1.0], most=16)
    assert not run.result.converged


def test_points_of_the_prior_are_spread_evenly_and_follow_hierarchies() -> None:
    with pm.Model() as hierarchical:
        center = pm.Normal("center", 3.0, 2.0)
        means = pm.Normal("means", center, 0.1, shape=2)
        x = pm.Normal.dist(means[0] + means[1], pm.Gamma("sigma", 2, 1))
        prb.Simulator(
            "y",
            lambda x: x,
            x,
            metric=prb.AreaMetric(),
            observed=OBSERVED,
            propagation=prb.Resimulated(8),
        )
    evaluator = Evaluator.of(hierarchical)
    thetas = evaluator.hyperparameters.prior_points(256, 0)
    assert thetas.shape == (256, 4)
    named = dict(zip(evaluator.hyperparameters.names, thetas.T, strict=True))
    for name, frozen in (("center", stats.norm(3, 2)), ("sigma_log__", stats.gamma(2))):
        values = named[name] if name == "center" else np.exp(named[name])
        # A net: one point in each of 256 intervals of equal probability; independent draws leave a
        # third of them empty.
        assert np.unique((frozen.cdf(values) * 256).astype(int)).size > 250
    for i in range(2):
        np.testing.assert_allclose(np.std(named[f"means[{i}]"] - named["center"]), 0.1, rtol=0.05)
    np.testing.assert_array_equal(thetas, evaluator.hyperparameters.prior_points(256, 0))


def test_priors_without_inverse_distribution_function_are_drawn() -> None:
    with pm.Model() as other:
        mu = pm.VonMises("mu", 0.0, 1.0)
        prb.Simulator(
            "y", lambda x: x, pm.Normal.dist(mu, 1.0), metric=prb.AreaMetric(), observed=OBSERVED
        )
    evaluator = Evaluator.of(other)
    np.testing.assert_array_equal(
        evaluator.hyperparameters.prior_points(16, 3), evaluator.hyperparameters.prior_thetas(16, 3)
    )


def test_overlap_is_one_for_equal_and_zero_for_disjoint_densities() -> None:
    target = prb.ProbabilityResidual().against(OBSERVED)
    values = np.array([OBSERVED, OBSERVED + 50, OBSERVED + 1.0])
    one, zero, between = density_overlap(target, values, np.full(values.shape, 0.02))
    np.testing.assert_allclose([one, zero], [1.0, 0.0], atol=1e-12)
    assert 0.05 < between < 0.95


@pytest.mark.parametrize(
    "propagation", [prb.Reweighted(256), prb.Resimulated(256)], ids=["stored", "anew"]
)
def test_where_there_is_overlap_the_start_is_left_alone(propagation: Any) -> None:
    evaluator = Evaluator.of(normal_model(propagation))
    search = Search(
        evaluator, np.ones(2), Method(), prior=False, tolerance=1e-6, max_evaluations=100
    )
    theta = np.array([0.3, 0.0])
    near, trace = approach(search, theta, np.ones(1), 0, Trace())
    assert near is theta
    assert trace.count == 0
    far, trace = approach(search, np.array([9.0, -1.0]), np.ones(1), 0, Trace())
    assert overlapping_populations(evaluator, far[None])[1].min() > 0.5
    assert trace.count > 0


# -- a million responses
# ---------------------------------------------------------------------------------


def test_monte_carlo_points_agree_with_sobol_points() -> None:
    random = prb.minimize(
        normal_model(prb.Resimulated(20_000, points="monte_carlo")), start=best().point
    )
    # The error of independent points is sqrt(N / n) standard errors.
    limit = 4 * np.sqrt(50 / 20_000)
    assert (
        np.abs(pair(random) - pair(best()))
        < limit * np.array([best().stderr["mu"], best().stderr["sigma"]])
    ).all()
    assert (pair(random) != pair(best())).all()


@pytest.mark.parametrize(("points", "error"), [("halton", ValueError), (3, TypeError)])
def test_points_are_a_name_or_a_function(points: Any, error: type[Exception]) -> None:
    with pytest.raises(
        error, match=r'points: got .*, expected "sobol", "monte_carlo" or a function'
    ):
        prb.Resimulated(64, points=points)


MILLION = """
import sys
from pathlib import Path
import numpy as np, pymc as pm, prbayes as prb

def peak():
    # ru_maxrss would begin with the size of the process that began this one.
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) / 2**20

data = np.random.default_rng(0).normal(1.0, 0.5, 100)

def calibrated(n):
    with pm.Model():
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1))
        metric = getattr(prb, sys.argv[1])()
        prb.Simulator("y", lambda x: x**2 + x, x, metric=metric, observed=data**2 + data,
                      propagation=prb.Resimulated(n))
        return prb.minimize(start={"mu": 0.8, "sigma": 0.7})

calibrated(1000)  # what is imported and compiled on the way
begun = peak()
optimum = calibrated(int(sys.argv[2]))
assert optimum.converged, optimum.message
assert abs(optimum.point["mu"] - 1) < 4 * optimum.stderr["mu"], optimum
print(begun, peak())
"""


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="peak memory is read from /proc")
@pytest.mark.parametrize(
    ("metric", "n"),
    [
        # A tenth of a million says as much of what each response takes, in less time.
        ("ProbabilityResidual", 100_000),
        ("ProbabilityResidual", 1_000_000),
        ("AreaMetric", 1_000_000),
    ],
)
@pytest.mark.slow
def test_a_million_responses_with_gradients_and_standard_errors_take_less_than_a_gibibyte(
    metric: str, n: int
) -> None:
    command = [sys.executable, "-c", MILLION, metric, str(n)]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    begun, peak = map(float, run.stdout.split())
    assert begun + (peak - begun) * (1_000_000 / n) < 1.0


def test_an_inverse_distribution_function_without_gradient_is_differenced() -> None:
    """PyTensor has no gradient of the gamma distribution's in its shape, and says so by an error of its own."""
    observed = np.random.default_rng(5).gamma(16, 1 / 16, 60)
    with pm.Model() as model:
        x = pm.Gamma.dist(mu=pm.HalfNormal("mu", 2), sigma=pm.HalfNormal("sigma", 1))
        keywords = {
            "metric": prb.KullbackLeibler(),
            "observed": observed,
            "propagation": prb.Resimulated(512),
        }
        prb.Simulator("y", lambda x: 2 * x - x, x, **keywords)
    optimum = prb.minimize(model)
    assert optimum.converged
    assert optimum.point["mu"] == pytest.approx(observed.mean(), abs=0.05)
    assert optimum.point["sigma"] == pytest.approx(observed.std(), rel=0.15)
