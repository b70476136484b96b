"""Particles that a user gives: by names, in own units or transformed, one for each particle."""

from typing import Any

import numpy as np
import pymc as pm
import pytest

import prbayes as prb
from prbayes.model.evaluator import Evaluator
from prbayes.model.parameters import Hyperparameters
from prbayes.posterior.initial_particles import fingerprint, starting_thetas

RNG = np.random.default_rng(1)
MU = RNG.normal(1, 1, (7, 2))
SIGMA = np.abs(RNG.normal(size=7))


def names() -> Hyperparameters:
    with pm.Model() as model:
        mu, sigma = pm.Normal("mu", 1, 1, shape=2), pm.HalfNormal("sigma", 1)
        prb.Simulator(
            "y", np.positive, pm.Normal.dist(mu[0] + mu[1], sigma), metric=prb.AreaMetric(),
            observed=[0.0, 1.0, 2.0], propagation=prb.Reweighted(64),
        )  # fmt: skip
    return Evaluator.of(model).hyperparameters


def test_own_units_and_transformed_values_are_the_same_thetas() -> None:
    found = starting_thetas(names(), {"mu": MU, "sigma": SIGMA}, 7)
    np.testing.assert_allclose(found, np.column_stack([MU, np.log(SIGMA)]), rtol=1e-12)
    other = starting_thetas(names(), {"sigma_log__": np.log(SIGMA), "mu": MU}, 7)
    np.testing.assert_allclose(found, other, rtol=1e-12)
    assert fingerprint([found]) == fingerprint([found.copy()]) != fingerprint([found + 1])


@pytest.mark.parametrize(
    ("start", "error", "message"),
    [
        (3, TypeError, "got int 3, expected a dict of arrays"),
        ({"mu": MU}, KeyError, r"got \['mu'\], expected values for each of \['mu', 'sigma'\]"),
        ({"mu": MU, "sigma": SIGMA, "sigma_log__": SIGMA}, KeyError, "expected values for each"),
        ({"mu": MU, "sigma": SIGMA, "nu": SIGMA}, KeyError, "expected values for each"),
        ({"mu": MU[:3], "sigma": SIGMA}, ValueError, r"mu: got shape \(3, 2\), expected \(7, 2\)"),
        ({"mu": MU, "sigma_log__": [0.0]}, ValueError, r"got shape \(1,\), expected \(7,\)"),
        ({"mu": MU, "sigma": -SIGMA}, ValueError, "got 7 of 7 points outside the support"),
        ({"mu": MU * np.nan, "sigma": SIGMA}, ValueError, "got 7 of 7 points outside"),
    ],
)
def test_other_starts_are_refused(start: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        starting_thetas(names(), start, 7)
