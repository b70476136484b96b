"""Draws of inputs from their prior predictive distribution."""

from typing import Any

import numpy as np
import pymc as pm
import pytest

from prbayes.emulators.prior_predictive import POPULATIONS, SPECIMENS, predictive_inputs


def test_each_population_has_its_own_parameters() -> None:
    with pm.Model():
        mu = pm.Normal("mu", 3, 2)
        x, again = predictive_inputs("s", [pm.Normal.dist(mu, 0.5), mu], 1)
    assert x.shape == again.shape == (POPULATIONS, SPECIMENS)
    # A variable of the model is one value for all specimens.
    assert (np.ptp(again, axis=1) == 0).all()
    # Standard errors: .063 of a population's mean, 2 / sqrt(512) = .09 of all.
    assert np.abs(x.mean(axis=1) - again[:, 0]).max() < 5 * 0.063
    assert x.mean() == pytest.approx(3, abs=4 * 0.09)
    assert x.std(axis=1).mean() == pytest.approx(0.5, rel=0.02)


def test_invalid_parameters_give_way_to_valid_ones() -> None:
    with pm.Model():
        sd = pm.Normal("sd", 0, 1)
        (x,) = predictive_inputs("s", [pm.Normal.dist(0, sd)], 1)
    assert np.isfinite(x).all()
    with pm.Model(), pytest.raises(ValueError, match="invalid parameters of the inputs at all"):
        predictive_inputs("s", [pm.Normal.dist(0, -pm.HalfNormal("sd"))], 1)


def test_a_seed_gives_the_same_draws() -> None:
    def drawn(random_seed: int) -> Any:
        with pm.Model():
            return predictive_inputs("s", [pm.Normal.dist(pm.Normal("mu"), 1)], random_seed)[0]

    np.testing.assert_array_equal(drawn(3), drawn(3))
    assert (drawn(3) != drawn(4)).all()


def test_there_must_be_a_model() -> None:
    with pytest.raises(TypeError, match="s: inputs that are distributions"):
        predictive_inputs("s", [pm.Normal.dist(0, 1)], 0)
