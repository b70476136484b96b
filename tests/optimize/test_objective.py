"""The standardised objective: units, gradient, record, budget, progress; and methods of SciPy."""

from typing import Any

import numpy as np
import pytest
from normal_problem import best, model, normal_model, pair
from scipy import optimize

import prbayes as prb
from prbayes._validate import Floats
from prbayes.optimize.objective import Method, Objective, Ridge, SpentError, StalledError


def parabola(theta: Floats) -> Any:
    return float((theta**2).sum()), 2 * theta, 3


def objective(function: Any = parabola, **keywords: Any) -> Objective:
    center, units = np.array([1.0, 2.0]), np.array([0.5, 4.0])
    return Objective(
        function, center, units, 10.0, **({"gradient": True, "max_evaluations": 100} | keywords)
    )


def test_value_and_gradient_are_in_units_of_size_and_parameters() -> None:
    value, gradient = objective()(np.array([2.0, -0.25]))  # theta = (2, 1)
    assert value == pytest.approx(0.5)
    np.testing.assert_allclose(gradient, [2 * 2 * 0.5 / 10, 2 * 1 * 4.0 / 10])


def test_points_are_recorded_with_their_cost_and_the_best_is_the_lowest() -> None:
    found = objective(max_evaluations=9)
    np.testing.assert_array_equal(found.best, [1.0, 2.0])  # the center, before any evaluation
    for t in ([0.0, 0.0], [-2.0, -0.5], [1.0, 1.0]):
        found(np.array(t))
    assert found.counts == [3, 6, 9]
    np.testing.assert_array_equal(found.best, [0.0, 0.0])
    assert found.lowest == 0.0
    with pytest.raises(SpentError):
        found(np.zeros(2))


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_line_search_is_led_back_from_points_without_value(bad: float) -> None:
    def broken(theta: Floats) -> Any:
        return bad, np.full(2, np.nan), 1

    t = np.array([1.0, -2.0])
    failed = objective(broken)
    value, gradient = failed(t)
    assert value > 1e9
    np.testing.assert_array_equal(np.sign(gradient), np.sign(t))
    assert failed.lowest == np.inf
    assert np.isfinite(objective(broken, gradient=False)(t))


def test_a_line_search_without_progress_is_stopped() -> None:
    flat = objective(lambda t: (1.0, np.zeros(2), 1), patience=4)
    for _ in range(5):
        flat(np.zeros(2))
    with pytest.raises(StalledError):
        flat(np.zeros(2))
    # Small gains count as progress once they add up.
    values = iter([1.0, *(1 - 1e-3 * k for k in range(1, 40))])
    slow = objective(lambda t: (10 * next(values), np.zeros(2), 1), patience=4)
    slow.least_gain = 3.5e-3  # four steps together, within the patience
    for _ in range(20):
        slow(np.zeros(2))
    slow.least_gain = 9e-3  # nine steps, beyond it

    def go_on() -> None:
        for _ in range(12):
            slow(np.zeros(2))

    with pytest.raises(StalledError):
        go_on()


def test_a_ridge_acts_along_its_directions_alone() -> None:
    units = np.array([0.5, 4.0])
    direction = np.array([[0.6], [0.8]])
    ridge = Ridge(np.array([1.0, 2.0]), direction, 10.0)
    across = np.array([0.8, -0.6]) * units
    along = direction[:, 0] * units
    thetas = ridge.center + np.array([across, along, 2 * along])
    np.testing.assert_allclose(ridge(thetas, units), [0.0, 5.0, 20.0], atol=1e-12)
    # The gradient by differences.
    at = ridge.center + 0.3 * across + 0.7 * along
    steps = 1e-6 * np.eye(2)
    slope = (ridge(at + steps, units) - ridge(at - steps, units)) / 2e-6
    np.testing.assert_allclose(ridge.gradient(at, units), slope, rtol=1e-6)


def steepest_descent(
    fun: Any, x0: Floats, args: Any, jac: Any = None, steps: int = 2000, **_: Any
) -> optimize.OptimizeResult:
    x = np.array(x0)
    for _i in range(steps):
        g = jac(x)
        if np.abs(g).max() < 1e-7:
            break
        x = x - 0.05 * g
    return optimize.OptimizeResult(x=x, fun=fun(x), success=True, message="down")


@pytest.mark.parametrize(
    ("method", "options"),
    [
        ("L-BFGS-B", {"maxcor": 3}),
        ("Nelder-Mead", None),
        ("trust-constr", None),
        ("COBYQA", None),
        (steepest_descent, {"steps": 1500}),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_any_method_finds_the_optimum(method: Any, options: Any) -> None:
    # The callable descends in small steps and takes hundreds.
    found = prb.minimize(model(), start={"mu": 0.5, "sigma": 0.8}, method=method, options=options)
    assert found.converged
    np.testing.assert_allclose(pair(found), pair(best()), atol=3e-4)


def test_options_replace_defaults_and_are_not_changed() -> None:
    options = {"xatol": 0.3, "fatol": 10.0}
    loose = prb.minimize(
        model(), start={"mu": 0.5, "sigma": 0.8}, method="Nelder-Mead", options=options
    )
    tight = prb.minimize(model(), start={"mu": 0.5, "sigma": 0.8}, method="Nelder-Mead")
    assert loose.search.n_evaluations < tight.search.n_evaluations / 3
    assert options == {"xatol": 0.3, "fatol": 10.0}


@pytest.mark.parametrize(
    ("method", "error", "words"),
    [
        ("bfsg", ValueError, r"got 'bfsg', expected one of BFGS, CG, .*, or a function"),
        ("dogleg", ValueError, "got 'dogleg'"),  # needs a Hessian
        (3, TypeError, "method: got 3, expected the name of a scipy method"),
        (dict, TypeError, "expected the name of a scipy method"),
    ],
)
def test_an_unknown_method_is_refused_before_any_work(
    method: Any, error: type[Exception], words: str
) -> None:
    calls = []
    other = normal_model(prb.Resimulated(64), lambda x: calls.append(1) or np.array(x))
    calls.clear()
    with pytest.raises(error, match=words):
        prb.minimize(other, method=method)
    assert not calls


def test_methods_and_their_options() -> None:
    with pytest.raises(TypeError, match="options: got list, expected a mapping"):
        prb.minimize(model(), options=[1])  # type: ignore[arg-type]
    names: list[Any] = ["bfgs", "nelder-mead", "COBYLA", steepest_descent]
    assert [Method(name).gradient for name in names] == [True, False, False, True]
    # A function gets its own options only.
    assert Method(steepest_descent, {"steps": 3}).settings(1e-6, 2) == {"steps": 3}
    assert Method("BFGS", {"gtol": 0.1}).settings(1e-6, 2)["gtol"] == 0.1
