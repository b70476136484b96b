"""Stored responses as populations of a result."""

from typing import Any

import numpy as np
import pymc as pm
import pytest
from decisions import normal, optimum, posterior, same

import prbayes as prb
from prbayes.decision.populations import InverseTransform, Populations, output_column
from prbayes.response.inputs import read_inputs
from prbayes.response.outputs import Outputs
from prbayes.response.response import Responses

CALLER = "prb.sensitivity"


def test_a_normal_population_has_its_mean_spread_and_tail() -> None:
    model, x = normal()
    populations = Populations.of(posterior(), model, 500, CALLER)

    def doubled(x: Any) -> Any:
        return 2 * x

    sample = populations.sample(doubled, (x,), None)
    mu, log_sigma = populations.thetas.T
    for quantity, expected in (
        (prb.decision.Mean(doubled, x), 2 * mu),
        (prb.decision.StandardDeviation(doubled, x), 2 * np.exp(log_sigma)),
        (
            prb.decision.Quantile(doubled, x, probability=0.8),
            2 * (mu + 0.8416 * np.exp(log_sigma)),
        ),
    ):
        np.testing.assert_allclose(
            sample.evaluate(quantity, populations.thetas), expected, atol=0.02
        )
    assert sample.responses.count == sample.design.n_runs
    again = populations.sample(doubled, (x,), None)
    assert again.responses.count == 0


def test_an_optimum_is_its_sampling_distribution() -> None:
    model, _ = normal()
    found = Populations.of(optimum(), None, 4000, CALLER)
    np.testing.assert_allclose(found.center, optimum().theta)
    np.testing.assert_allclose(np.cov(found.thetas.T), optimum().covariance, rtol=0.03, atol=1e-5)
    assert found.evaluator.model is model


def test_inputs_of_no_design_are_refused() -> None:
    model, _ = normal()
    populations = Populations.of(optimum(), None, 10, CALLER)
    with pytest.raises(TypeError, match="no simulator of the model has stored responses"):
        populations.sample(same, (pm.Normal.dist(model["mu"], 1.0),), None)


def test_what_has_no_response_counts_nowhere_and_too_much_of_it_is_refused() -> None:
    model, x = normal()
    populations = Populations.of(posterior(), model, 100, CALLER)
    sample = populations.sample(lambda x: np.where(x > 3.5, np.nan, x), (x,), None)
    np.testing.assert_allclose(sample.weights(populations.thetas).sum(axis=1), 1.0)
    with pytest.raises(prb.propagation.DesignError, match="lost mass"):
        populations.sample(lambda x: np.where(x > 1.0, np.nan, x), (x,), None)
    broken = populations.sample(lambda x: np.where(x > 1.0, np.inf, x), (x,), None)
    with pytest.raises(ValueError, match=r"got specimens that failed \(\+inf\)"):
        broken.refuse_failed(prb.decision.Mean(same, x))
    broken.refuse_failed(prb.decision.Exceedance(same, x, limit=1.0))


def test_an_output_is_found_by_label_or_name() -> None:
    _, x = normal()
    populations = Populations.of(optimum(), None, 10, CALLER)
    responses = populations.responses(same, (x,))
    values = np.zeros((3, 2))
    responses.outputs = Outputs((60.0, 120.0))
    assert output_column(responses, values, 120) == output_column(responses, values, "120") == 1
    with pytest.raises(KeyError, match="expected one of"):
        output_column(responses, values, "length")
    with pytest.raises(ValueError, match="expected output= to say which"):
        output_column(responses, values, None)
    with pytest.raises(ValueError, match="one number"):
        output_column(responses, values[:, 0], 0)


def test_normal_numbers_become_inputs_by_their_distribution_functions() -> None:
    with pm.Model() as model:
        mu = pm.Normal("mu")
        x = pm.Normal.dist(mu, 2.0)
        v = pm.MvNormal.dist(mu * np.ones(2), chol=np.array([[1.0, 0.0], [0.6, 0.8]]))
        u = pm.Uniform.dist(0.0, 1.0)
    inputs = read_inputs("f", [x, v, u], model)
    transform = InverseTransform("f", inputs, [np.array([3.0])])
    assert transform.size == 4
    z = np.random.default_rng(0).normal(size=(50, 4))
    a, b, c = transform(z)
    np.testing.assert_allclose(a, 3 + 2 * z[:, 0], rtol=1e-9)
    np.testing.assert_allclose(b[:, 1], 3 + 0.6 * z[:, 1] + 0.8 * z[:, 2], rtol=1e-9)
    assert ((c > 0) == (c < 1)).all()
    assert (np.argsort(c) == np.argsort(z[:, 3])).all()
    # A response takes its own inputs, in its own order.
    responses = Responses("g", lambda u, x: x - u, read_inputs("g", [u, x], model))
    np.testing.assert_allclose(transform.responses(responses, z), a - c)


def test_a_distribution_without_inverse_is_refused() -> None:
    with pm.Model() as model:
        count = pm.Poisson.dist(pm.HalfNormal("b"))
    with pytest.raises(TypeError, match="discrete"):
        InverseTransform("f", read_inputs("f", [count], model), [np.ones(1)])
