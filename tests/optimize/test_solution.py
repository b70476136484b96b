"""Standard errors carried to the user's units."""

from typing import Any

import numpy as np
import pymc as pm
import pytest

import prbayes as prb
from prbayes.inference.asymptotics import Local
from prbayes.model.evaluator import Evaluator
from prbayes.optimize.convergence import apart_from_data
from prbayes.optimize.solution import _stderr, point_and_stderr

COVARIANCE = np.array([[4.0, 1.0], [1.0, 9.0]])


def test_standard_errors_of_sums_and_differences_know_the_correlation() -> None:
    gradients = np.array([[1.0, 0.0], [1.0, 1.0], [1.0, -1.0], [0.0, 0.0]])
    np.testing.assert_allclose(_stderr(gradients, COVARIANCE), np.sqrt([4.0, 15.0, 11.0, 0.0]))


def test_what_depends_on_an_element_that_is_not_identified_is_infinite() -> None:
    covariance = np.array([[4.0, np.inf], [np.inf, np.inf]])
    found = _stderr(np.array([[2.0, 0.0], [0.0, 1.0], [0.0, 0.0]]), covariance)
    np.testing.assert_array_equal(found[1:], [np.inf, np.nan])  # at a bound nothing is known
    assert found[0] == 4.0  # of the other element alone


def test_nothing_known_is_nan() -> None:
    assert np.isnan(_stderr(np.ones((1, 2)), np.full((2, 2), np.nan))).all()


def _factor() -> Evaluator:
    """Return a model of a Cholesky factor with elements a and b, and what is read off it."""
    with pm.Model() as model:
        a, b = pm.Normal("a"), pm.Normal("b")
        pm.Deterministic("length", pm.math.sqrt(a**2 + b**2))
        pm.Deterministic("angle", pm.math.stack([1.0 + 0 * a, a / b]))
        x = pm.Normal.dist(a, pm.math.exp(b))
        prb.Simulator("y", np.positive, x, metric=prb.AreaMetric(), observed=[0.0, 1.0])
    return Evaluator.of(model)


def test_a_function_of_what_is_not_identified_may_be_identified() -> None:
    evaluator = _factor()
    unit = evaluator.hyperparameters.prior_sd
    theta = np.array([3.0, 4.0])
    # The length is known, to a tenth, and the place on the circle is not.
    outwards = theta / unit / np.linalg.norm(theta / unit)
    on_circle = np.array([-4.0, 3.0]) / unit
    on_circle /= np.linalg.norm(on_circle)
    outwards -= (outwards @ on_circle) * on_circle
    outwards /= np.linalg.norm(outwards)
    local = Local(unit, outwards[:, None], on_circle[:, None], np.array([[0.01]]))
    _, stderr = point_and_stderr(evaluator, theta, local.in_theta, local)
    assert np.isinf([stderr["a"], stderr["b"]]).all()
    along = (theta / 5 * unit) @ outwards
    assert stderr["length"] == pytest.approx(0.1 * abs(along), rel=1e-3)
    np.testing.assert_array_equal(stderr["angle"], [0.0, np.inf])  # one is the same everywhere


def _normal(metric: prb.Metric, propagation: Any) -> pm.Model:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 3), pm.HalfNormal("sigma", 1))
        prb.Simulator(
            "y", np.positive, x, metric=metric, observed=[0.0, 0.4, 1.0], propagation=propagation
        )
    return model


@pytest.mark.parametrize(
    ("metric", "propagation", "far"),
    [
        (prb.ProbabilityResidual(), prb.Reweighted(256), True),
        (prb.KullbackLeibler(), prb.Reweighted(256), True),
        (prb.AreaMetric(), prb.Reweighted(256), False),  # compares no densities
        (prb.ProbabilityResidual(), prb.Resimulated(256), False),  # would cost responses
    ],
)
def test_a_population_far_from_all_data_is_known_by_its_overlap(
    metric: prb.Metric, propagation: Any, far: bool
) -> None:
    evaluator = Evaluator.of(_normal(metric, propagation))
    there = evaluator.hyperparameters.unconstrained({"mu": 6.0, "sigma": 0.3})
    here = evaluator.hyperparameters.unconstrained({"mu": 0.5, "sigma": 0.4})
    assert apart_from_data(evaluator, there) is far
    assert apart_from_data(evaluator, here) is False


@pytest.mark.parametrize("prior", [False, True])
def test_a_minimum_apart_from_the_data_is_no_convergence_unless_the_prior_holds_it_there(
    prior: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("prbayes.optimize.solution.apart_from_data", lambda *_: True)
    model = _normal(prb.ProbabilityResidual(), prb.Reweighted(256))
    prb.set_epsilon(model, {"y": 0.1})
    optimum = prb.minimize(model, prior=prior, progressbar=False)
    assert optimum.converged is prior
    assert ("hardly overlaps" in optimum.message) is not prior
