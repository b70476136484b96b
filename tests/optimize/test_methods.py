"""Methods of scipy by name with options, or functions: what they are given and where they arrive."""

from typing import Any

import numpy as np
import pytest
from normal_problem import best, model, normal_model, pair
from scipy import optimize

import prbayes as prb
from prbayes._validate import Floats
from prbayes.optimize.methods import Method


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
        ("slsqp", None),
        ("TNC", None),
        ("trust-constr", None),
        ("Newton-CG", None),
        ("COBYQA", None),
        ("COBYLA", None),
        (steepest_descent, None),
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


def test_options_must_be_a_mapping() -> None:
    with pytest.raises(TypeError, match="options: got list, expected a mapping"):
        prb.minimize(model(), options=[1])  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("name", "gradient"),
    [("bfgs", True), ("nelder-mead", False), ("COBYLA", False), (steepest_descent, True)],
)
def test_methods_say_whether_they_follow_gradients(name: Any, gradient: bool) -> None:
    assert Method(name).gradient is gradient


def test_a_function_gets_its_own_options_only() -> None:
    assert Method(steepest_descent, {"steps": 3}).settings(1e-6, 2) == {"steps": 3}
    assert Method("BFGS", {"gtol": 0.1}).settings(1e-6, 2)["gtol"] == 0.1
