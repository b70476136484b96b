"""Specimens under conditions of their own: loads, doses and times."""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm
import pytest
from scipy.stats import norm

import prbayes as prb
from prbayes.model.evaluator import Evaluator
from prbayes.model.fingerprint import identity_of
from prbayes.model.measurement import SpecimenLikelihood
from prbayes.model.specimen_likelihood import (
    draw_readings,
    log_likelihood_graph,
    log_likelihoods,
    specimen_likelihoods,
)
from prbayes.optimize.maximum_likelihood import simulation_obstacle
from prbayes.propagation.resimulated import Resimulated
from prbayes.response.compile import PLAIN
from prbayes.response.condition import ConditionRV, condition

RNG = np.random.default_rng(1)
X = RNG.normal(1.0, 0.2, 12)
LOADS = {"linear": np.linspace(0.5, 2.0, 12), "log": np.geomspace(0.2, 300.0, 12)}
TIMES = np.array([[1.0, 2.0], [0.5, np.nan], [2.0, 4.0], [4.0, 1.0]])


def grown(x: Any, load: Any) -> Any:
    """Return a response that is proportional to the load."""
    return np.exp(x) * load


def log_grown(x: Any, load: Any) -> Any:
    """Return the logarithm of such a response."""
    return x + np.log(load)


def line(x: Any, time: Any) -> Any:
    """Return readings at times."""
    return np.asarray(x)[..., None] * np.sqrt(time)


def likelihood_of(load: Any, response: Any = grown, **arguments: Any) -> SpecimenLikelihood:
    """Return the likelihood of specimens under loads."""
    with pm.Model() as model:
        mu, sigma = pm.Normal("mu", 1.0, 0.5), pm.HalfNormal("sigma", 0.5)
        x = pm.Normal.dist(mu, sigma)
        known = condition("load", load)
        arguments.setdefault("observed", response(X, np.asarray(load)))
        prb.Simulator("y", response, x, known, **arguments)
    (likelihood,) = specimen_likelihoods(model).values()
    likelihood.cache["keep"] = model
    return likelihood


@pytest.mark.parametrize("propagation", [None, Resimulated()])
@pytest.mark.parametrize("kind", ["linear", "log"])
def test_the_log_likelihood_is_that_of_known_inputs(kind: str, propagation: Any) -> None:
    response = {"linear": grown, "log": log_grown}[kind]
    likelihood = likelihood_of(LOADS[kind], response, propagation=propagation)
    values = {"mu": np.array([1.0, 0.9, 1.2]), "sigma": np.array([0.2, 0.3, 0.25])}
    got = log_likelihoods(likelihood, values)
    expected = norm.logpdf(X, values["mu"][:, None], values["sigma"][:, None])
    if kind == "linear":  # y = exp(x) load: dx/dy = 1/y
        expected -= np.log(grown(X, LOADS[kind]))
    # The error of the points of a specimen does not depend on the population.
    np.testing.assert_allclose(got, expected, atol=0.04)
    np.testing.assert_allclose(got - got[0], expected - expected[0], atol=0.01)


def test_several_conditions_keep_their_order_and_their_specimens() -> None:
    first, second = np.linspace(1.0, 2.0, 12), np.linspace(5.0, 3.0, 12)
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1.0, 0.5), 0.2)
        a, b = condition("a", first), condition("b", second)
        prb.Simulator("y", lambda b, x, a: x * a + b, b, x, a, observed=X * first + second)
    (likelihood,) = specimen_likelihoods(model).values()
    got = log_likelihoods(likelihood, {"mu": np.array([1.0])})
    np.testing.assert_allclose(got[0], norm.logpdf(X, 1.0, 0.2) - np.log(first), atol=0.04)
    (measurement,) = likelihood.measurements
    values = {"mu": np.full(400, 1.0)}
    drawn = draw_readings(likelihood, np.random.default_rng(0), values, 12, measurement)
    error = 0.2 * first / np.sqrt(400)
    assert (np.abs(drawn.mean(axis=0) - first - second) < 4.5 * error).all()


def test_the_range_of_a_condition_keeps_its_sign() -> None:
    for values in ([0.0, 10.0], [0.1, 10.0], [-3.0, -0.1], [-1.0, 1.0], [1.0, 2.0]):
        op = condition("c", values).owner.op
        assert isinstance(op, ConditionRV)
        low, high = op.range
        assert low <= min(values)
        assert high >= max(values)
        assert np.sign(low) in (np.sign(min(values)), 0)
        assert np.sign(high) in (1, np.sign(high))
        np.testing.assert_allclose(op.coordinates(np.array([low, high])), [-1, 1], atol=1e-12)
    assert condition("c", [0.1, 10.0]).owner.op.scale[0]


def test_times_are_outputs() -> None:
    observed = np.sqrt(TIMES) * np.array([[1.0], [1.2], [0.9], [1.1]])
    time = condition("time", TIMES)
    np.testing.assert_array_equal(time.eval(mode=PLAIN), [0.5, 1.0, 2.0, 4.0])
    with pm.Model() as model:
        mu, error = pm.Normal("mu", 1.0, 0.3), pm.HalfNormal("error", 0.3)
        x = pm.Normal.dist(mu, 0.2)
        metric = prb.LogLikelihood(error=error)
        prb.Simulator("y", line, x, time, observed=observed, metric=metric)
    (likelihood,) = specimen_likelihoods(model).values()
    values = {"mu": np.array([1.0, 1.1]), "error": np.array([0.05, 0.2])}
    got = log_likelihoods(likelihood, values)
    for row, mean, sd in zip(got, *values.values(), strict=True):
        for value, t, y in zip(row, TIMES, observed, strict=True):
            root = np.sqrt(t[~np.isnan(t)])
            covariance = 0.2**2 * np.outer(root, root) + sd**2 * np.eye(root.size)
            residual = y[~np.isnan(t)] - mean * root
            quadratic = residual @ np.linalg.solve(covariance, residual)
            log_det = np.linalg.slogdet(2 * np.pi * covariance)[1]
            assert abs(value + 0.5 * (quadratic + log_det)) < 0.04
    graph = log_likelihood_graph(likelihood, {mu: 1.1, error: 0.2})
    np.testing.assert_allclose(graph.eval(mode=PLAIN), got[1], atol=1e-9)
    assert likelihood.measurements[0].outputs.dim == "time"


def integrated(x: Any, t: Any) -> Any:
    """Integrate by steps from one of the times to the next."""
    return np.cumsum(x[..., None] * np.diff(t, prepend=0.0) / np.sqrt(t), axis=-1)


@pytest.mark.parametrize(
    ("response", "is_right"),
    [
        (integrated, False),
        (lambda x, t: line(x, t / t[-1]), False),
        (prb.scalar(lambda x, t: [{0.5: 1, 1: 2, 2: 3, 4: 4}[k] * x for k in t]), True),
        (prb.scalar(lambda x, t: x * np.sqrt(t)), True),
    ],
)
def test_outputs_that_depend_on_other_times_are_refused(response: Any, is_right: bool) -> None:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1.0, 0.3), 0.2)
        metric = prb.LogLikelihood(error=0.1)
        time = condition("time", TIMES)
        prb.Simulator("y", response, x, time, observed=np.sqrt(TIMES), metric=metric)
    (likelihood,) = specimen_likelihoods(model).values()
    run = likelihood.measurements[0].responses
    points = [np.linspace(0.5, 1.5, 5)]
    if is_right:
        assert run(points, []).shape == (5, 4)
        assert run.computed == 5
        return
    with pytest.raises(
        prb.response.ResponseError, match=r"at (2|0\.5), at \(x = 1\.5\) where other"
    ):
        run(points, [])


def test_predictions_are_at_the_conditions_of_new_specimens() -> None:
    with pm.Model():
        mu, sigma = pm.Normal("mu", 1.0, 0.5), pm.HalfNormal("sigma", 0.5)
        x = pm.Normal.dist(mu, sigma)
        load = condition("load", LOADS["linear"])
        prb.Simulator("y", grown, x, load, observed=np.exp(X) * LOADS["linear"])
        optimum = prb.minimize(starts=0, progressbar=False)
        assert abs(optimum.point["mu"] - X.mean()) < 0.01 * X.std()
        assert abs(optimum.point["sigma"] - X.std()) < 0.02 * X.std()
        new = np.array([0.6, 1.9, 1.0, 1.4, 0.7, 1.5, 0.8, 2.0])
        predicted = prb.predict(optimum, grown, x, condition("load", new), random_seed=1)
        assert predicted.dims == ("chain", "draw", "specimen")
        assert predicted.attrs["responses"] == 0
        logs = np.log(predicted.values[0] / new)
        assert (np.abs(logs.mean(axis=0) - X.mean()) < 4.5 * X.std() / np.sqrt(500)).all()
        right = np.exp(norm.ppf((np.arange(8) + 0.5) / 8, 1.0, 0.2)) * new
        assert not prb.area_test(right, predicted).rejected
        # In another order the specimens have conditions that are not theirs.
        assert prb.area_test(right[::-1], predicted, folded=True).rejected
        with pytest.raises(ValueError, match=r"observed: got 2 values, expected 8"):
            prb.area_test(right[:2], predicted)
        own = prb.predict(optimum, grown, x, load)
        with pytest.raises(ValueError, match="data of the calibration"):
            prb.area_test(np.exp(X) * LOADS["linear"], own)
        with pytest.raises(ValueError, match=r"got load = 4, expected values from 0.35 to 2.15"):
            prb.predict(optimum, grown, x, condition("load", [1.0, 4.0]))
        far = prb.predict(optimum, grown, x, condition("load", [1.0, 4.0]), stored=False)
        assert far.sizes["specimen"] == 2
        assert prb.predict(optimum, grown, x, 4.0).dims == ("chain", "draw", "sample")


def test_problems_with_other_conditions_differ() -> None:
    y = np.exp(X) * LOADS["linear"]
    first, second = (likelihood_of(load, observed=y) for load in (LOADS["linear"], LOADS["log"]))
    identities = [identity_of(each.cache["keep"]) for each in (first, second)]
    assert identities[0].simulators[0].data != identities[1].simulators[0].data


def test_frequencies_repeat_conditions() -> None:
    counts = np.array([2, 1] * 6)
    likelihood = likelihood_of(LOADS["linear"], weights=counts)
    conditions = likelihood.stacked.conditions
    assert conditions is not None
    np.testing.assert_array_equal(conditions[:, 0], np.repeat(LOADS["linear"], counts))


def test_a_specimen_has_one_value_of_a_condition() -> None:
    labels = np.repeat(np.arange(6), 2)
    metric = prb.LogLikelihood(error=0.1)
    with pytest.raises(ValueError, match=r"y: specimens: got the label 0 with two values"):
        likelihood_of(LOADS["linear"], specimens=labels, metric=metric)
    loads = np.repeat(LOADS["linear"][:6], 2)
    likelihood = likelihood_of(loads, specimens=labels, metric=metric)
    conditions = likelihood.stacked.conditions
    assert conditions is not None
    assert len(conditions) == 6


def test_conditions_are_no_inputs_of_the_population() -> None:
    """Readings need not determine them, and data sets are drawn given them."""

    def four_times(x: Any, load: Any) -> Any:
        return np.asarray(load)[..., None] * np.exp(np.asarray(x)[..., None] - np.arange(4))

    error = prb.LogLikelihood(error=0.05)
    likelihood = likelihood_of(LOADS["linear"], four_times, metric=error)
    logs = log_likelihoods(likelihood, {"mu": np.ones(1), "sigma": np.full(1, 0.2)})
    assert np.isfinite(logs).all()
    for response in (grown, four_times):
        model = likelihood_of(LOADS["linear"], response, metric=error).cache["keep"]
        assert simulation_obstacle(Evaluator.of(model)) is None


def test_what_does_not_apply_is_refused() -> None:
    y = np.exp(X)
    with pytest.raises(TypeError, match=r"got KullbackLeibler .* condition load of each specimen"):
        likelihood_of(LOADS["linear"], metric=prb.KullbackLeibler())
    with pytest.raises(ValueError, match=r"got 12 values of load, expected 11"):
        likelihood_of(LOADS["linear"], observed=y[:11])
    likelihood = likelihood_of(LOADS["linear"])
    with pytest.raises(
        ValueError, match=r"got 11 specimens, expected 12, as many as .* conditions"
    ):
        likelihood.observing({"y": y[:11]})
    with pytest.raises(ValueError, match=r"got a value twice in row 0"):
        condition("c", [[1.0, 1.0], [1.0, 2.0]])
    with pytest.raises(ValueError, match=r"got 300 different values, expected at most 200"):
        condition("c", np.arange(300.0).reshape(3, 100))
    with pytest.raises(ValueError, match=r"a row without a number"):
        condition("c", [[1.0, 2.0], [np.nan, np.nan]])
    observed = np.where(np.isnan(TIMES), 1.0, TIMES)
    for got, match in ((observed, "row 1, column 1, where"), (observed[:, 0], r"shape \(4,\)")):
        with pm.Model():
            x = pm.Normal.dist(pm.Normal("mu", 1, 1), 0.2)
            with pytest.raises(ValueError, match=match):
                prb.Simulator("y", line, x, condition("time", TIMES), observed=got)


@pytest.mark.long
def test_doses_and_times_of_theophylline_have_the_published_likelihood() -> None:
    path = Path(__file__).parents[2] / "examples" / "theophylline.py"
    model = runpy.run_path(str(path))["population"](prb.datasets.theophylline())
    (likelihood,) = specimen_likelihoods(model).values()
    values = {
        "ka": np.array([0.4602, 0.442, 0.4602]),
        "cl": np.full(3, 1.0115),
        "v": np.full(3, 3.4537),
        "sigma_ka": np.array([0.6367, 0.6, 0.69]),
        "sigma_cl": np.full(3, 0.2652),
        "sigma_v": np.full(3, 0.136),
        "error": np.full(3, 0.6959),
    }
    got = log_likelihoods(likelihood, values).sum(axis=1)
    # By importance sampling in NumPy, 4096 points around the mode of each subject. The first is the
    # maximum: .458, 1.012, 3.45 and an error of .696 are the published estimates.
    expected = np.array([-180.3542, -180.3912, -180.4097])
    np.testing.assert_allclose(got, expected, atol=0.15)
    np.testing.assert_allclose(got - got[0], expected - expected[0], atol=0.01)
