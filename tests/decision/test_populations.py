"""Stored responses as populations of a result."""

from typing import Any

import numpy as np
import pymc as pm
import pytest
from decisions import doubled, normal, optimum, posterior, same

import prbayes as prb
from prbayes.decision.populations import InverseTransform, Populations, output_column
from prbayes.response.inputs import read_inputs
from prbayes.response.outputs import Outputs
from prbayes.response.response import Responses


def populations(result: Any, n: int = 100) -> Populations:
    return Populations.of(result, normal()[0], n, "prb.sensitivity")


def test_a_normal_population_has_its_mean_spread_and_tail() -> None:
    _, x = normal()
    found = populations(posterior(), 500)
    sample = found.sample(lambda x: 2 * x, (x,), None)
    mu, sigma = found.thetas[:, 0], np.exp(found.thetas[:, 1])
    for quantity, expected in (
        (prb.decision.Mean(doubled, x), 2 * mu),
        (prb.decision.StandardDeviation(doubled, x), 2 * sigma),
        (prb.decision.Quantile(doubled, x, probability=0.8), 2 * (mu + 0.8416 * sigma)),
    ):
        np.testing.assert_allclose(sample.evaluate(quantity, found.thetas), expected, atol=0.02)
    # Known responses are reused.
    assert sample.responses.count == sample.design.n_runs
    again = found.sample(sample.responses.function, (x,), None)
    assert again.responses.count == 0


def test_a_tail_of_few_points_is_reported_and_one_of_none_refused() -> None:
    _, x = normal()
    found = populations(posterior(), 500)

    def findings(response: Any, quantity: Any, **options: Any) -> Any:
        sample = found.sample(response, (x,), None)
        return sample.checked_quantity(quantity(response, x, **options))[0]

    def scattered(x: Any) -> Any:
        return np.sin(1e4 * x)

    # One response in 200 is above: some points of 300, wherever they are.
    (finding,) = findings(scattered, prb.decision.Exceedance, limit=np.cos(np.pi / 200))
    assert finding.code == "rough-probability"
    assert findings(scattered, prb.decision.Exceedance, limit=0.5) == ()
    assert findings(doubled, prb.decision.Quantile, probability=0.99) == ()
    assert findings(doubled, prb.decision.Mean) == ()
    # A largest response that is a limit is known, and one that is the last point is not.
    assert findings(np.tanh, prb.decision.Quantile, probability=0.99) == ()
    assert findings(lambda x: np.minimum(x, 1), prb.decision.Quantile, probability=0.99) == ()
    assert len(findings(scattered, prb.decision.Quantile, probability=1 - 1e-9)) == 1
    # The rarer side counts: a low quantile, and a probability near one.
    assert len(findings(scattered, prb.decision.Quantile, probability=1e-9)) == 1
    assert findings(doubled, prb.decision.Quantile, probability=0.01) == ()
    (finding,) = findings(scattered, prb.decision.Exceedance, limit=-np.cos(np.pi / 200))
    assert "on its other side, 0.00" in finding.text
    with pytest.raises(ValueError, match=r"got no response beyond it, of \d+ effective points"):
        findings(doubled, prb.decision.Exceedance, limit=99.0)
    with pytest.raises(ValueError, match="got no response on its other side, of"):
        findings(doubled, prb.decision.Exceedance, limit=-99.0)


def test_quantities_have_the_error_of_their_computation() -> None:
    _, x = normal()
    found = populations(posterior(), 500)
    sample = found.sample(doubled, (x,), None)
    mu, sigma = found.center[0], np.exp(found.center[1])
    for quantity, expected in (
        (prb.decision.Mean(doubled, x), 2 * mu),
        (prb.decision.StandardDeviation(doubled, x), 2 * sigma),
        (prb.decision.Exceedance(doubled, x, limit=2 * mu), 0.5),
        *(
            (prb.decision.Quantile(doubled, x, probability=p), 2 * (mu + sigma * z))
            for p, z in ((1e-6, -4.7534), (0.01, -2.3263), (0.99, 2.3263), (1 - 1e-6, 4.7534))
        ),
    ):
        (value,) = sample.evaluate(quantity, found.center[None])
        _, error = sample.checked_quantity(quantity)
        assert abs(value - expected) < 3 * error < 1.5


def test_an_optimum_is_its_sampling_distribution() -> None:
    found = Populations.of(optimum(), None, 4000, "prb.sensitivity")
    np.testing.assert_allclose(found.center, optimum().theta)
    np.testing.assert_allclose(np.cov(found.thetas.T), optimum().covariance, rtol=0.03, atol=1e-5)
    assert found.evaluator.model is normal()[0]


def test_inputs_without_design_and_lost_responses_are_refused() -> None:
    model, x = normal()
    found = populations(posterior())
    with pytest.raises(TypeError, match="without stored responses in any simulator"):
        found.sample(same, (pm.Normal.dist(model["mu"], 1.0),), None)
    sample = found.sample(lambda x: np.where(x > 3.5, np.nan, x), (x,), None)
    np.testing.assert_allclose(sample.weights(found.thetas).sum(axis=1), 1.0)
    with pytest.raises(prb.propagation.DesignError, match="lost mass"):
        found.sample(lambda x: np.where(x > 1.0, np.nan, x), (x,), None)
    broken = found.sample(lambda x: np.where(x > 1.0, np.inf, x), (x,), None)
    with pytest.raises(ValueError, match=r"got specimens that failed \(\+inf\)"):
        broken.checked_quantity(prb.decision.Mean(same, x))
    broken.checked_quantity(prb.decision.Exceedance(same, x, limit=1.0))


def test_an_output_is_found_by_label_or_name() -> None:
    responses = populations(optimum()).responses(same, (normal()[1],))
    values = np.zeros((3, 2))
    responses.outputs = Outputs((60.0, 120.0))
    assert output_column(responses, values, 120) == output_column(responses, values, "120") == 1
    for columns, output, message in (
        (values, "length", "expected one of"),
        (values, None, "expected output= to say which"),
        (values[:, 0], 0, "one number"),
    ):
        with pytest.raises((KeyError, ValueError), match=message):
            output_column(responses, columns, output)


def test_normal_numbers_become_inputs_by_their_distribution_functions() -> None:
    with pm.Model() as model:
        mu = pm.Normal("mu")
        x = pm.Normal.dist(mu, 2.0)
        v = pm.MvNormal.dist(mu * np.ones(2), chol=np.array([[1.0, 0.0], [0.6, 0.8]]))
        u, count = pm.Uniform.dist(0.0, 1.0), pm.Poisson.dist(pm.HalfNormal("b"))
    transform = InverseTransform("f", read_inputs("f", [x, v, u], model), [np.array([3.0])])
    assert transform.size == 4
    z = np.random.default_rng(0).normal(size=(50, 4))
    a, b, c = transform(z)
    np.testing.assert_allclose(a, 3 + 2 * z[:, 0], rtol=1e-9)
    np.testing.assert_allclose(b[:, 1], 3 + 0.6 * z[:, 1] + 0.8 * z[:, 2], rtol=1e-9)
    assert ((c > 0) == (c < 1)).all()
    assert (np.argsort(c) == np.argsort(z[:, 3])).all()
    # A response takes its inputs in its order.
    responses = Responses("g", lambda u, x: x - u, read_inputs("g", [u, x], model))
    np.testing.assert_allclose(transform.responses(responses, z), a - c)
    with pytest.raises(TypeError, match="discrete"):
        InverseTransform("f", read_inputs("f", [count], model), [np.ones(1)])
