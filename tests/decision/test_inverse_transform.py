"""Specimens of a population as functions of normal numbers."""

import numpy as np
import pymc as pm
import pytest

from prbayes.decision.inverse_transform import Specimens
from prbayes.response.inputs import read_inputs
from prbayes.response.response import Responses


def test_normal_numbers_become_inputs_by_their_distribution_functions() -> None:
    with pm.Model() as model:
        mu = pm.Normal("mu")
        x = pm.Normal.dist(mu, 2.0)
        v = pm.MvNormal.dist(mu * np.ones(2), chol=np.array([[1.0, 0.0], [0.6, 0.8]]))
        u = pm.Uniform.dist(0.0, 1.0)
    inputs = read_inputs("f", [x, v, u], model)
    specimens = Specimens("f", inputs, [np.array([3.0])])
    assert specimens.size == 4
    z = np.random.default_rng(0).normal(size=(50, 4))
    a, b, c = specimens.at(z)
    np.testing.assert_allclose(a, 3 + 2 * z[:, 0], rtol=1e-9)
    np.testing.assert_allclose(b[:, 1], 3 + 0.6 * z[:, 1] + 0.8 * z[:, 2], rtol=1e-9)
    assert ((c > 0) == (c < 1)).all()
    assert (np.argsort(c) == np.argsort(z[:, 3])).all()
    # A response takes its own inputs, in its own order.
    responses = Responses("g", lambda u, x: x - u, read_inputs("g", [u, x], model))
    np.testing.assert_allclose(specimens.computed(responses, z), a - c)


def test_a_distribution_without_inverse_is_refused() -> None:
    with pm.Model() as model:
        count = pm.Poisson.dist(pm.HalfNormal("b"))
    with pytest.raises(TypeError, match="discrete"):
        Specimens("f", read_inputs("f", [count], model), [np.ones(1)])
