"""Where designs are refined: thetas around an optimum."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from one_input import one_input

import prbayes as prb
from prbayes.inference.asymptotics import Local
from prbayes.model.evaluator import Evaluator, shortcomings
from prbayes.optimize.design_refinement import (
    neighbourhood,
    pilot,
    refuse,
    rough_emulators,
)
from prbayes.propagation.base import DesignError
from prbayes.propagation.importance import DesignEmulator

PRIOR_SD = np.array([2.0, 0.5])


def nearby(local: Local | None, covariance: Any, ridge: Any = None) -> Any:
    """Return thetas around a fit at (1, -1) with a sampling distribution."""
    hyperparameters = SimpleNamespace(prior_sd=PRIOR_SD, log_prior=lambda t: np.zeros(len(t)))
    evaluator: Any = SimpleNamespace(hyperparameters=hyperparameters, reweighted={})
    sampling = None if local is None else SimpleNamespace(local=local)
    fit: Any = SimpleNamespace(
        theta=np.array([1.0, -1.0]),
        sampling=sampling,
        covariance=covariance,
        ridge=ridge,
        pilot=None,
    )
    return neighbourhood(evaluator, fit, 0)


def test_thetas_have_the_covariance_of_the_optimum() -> None:
    covariance = np.array([[0.04, 0.006], [0.006, 0.0025]])
    thetas = nearby(None, covariance)
    assert thetas.shape == (256, 2)
    # 256 normal draws: variances to 9%, means to a sixteenth of a standard deviation; 4.5 of them.
    np.testing.assert_allclose(np.diag(np.cov(thetas.T)), np.diag(covariance), rtol=0.4)
    assert np.cov(thetas.T)[0, 1] == pytest.approx(0.006, rel=0.5)
    assert (np.abs(thetas.mean(axis=0) - [1.0, -1.0]) < 0.28 * np.sqrt(np.diag(covariance))).all()


@pytest.mark.parametrize("unknown", [np.nan, np.inf, 1e6])
def test_thetas_are_no_wider_than_the_prior(unknown: float) -> None:
    sd = nearby(None, np.diag([unknown, 0.0025])).std(axis=0)
    np.testing.assert_allclose(sd, [2.0, 0.05], rtol=0.2)


def test_thetas_lie_along_what_the_data_identify() -> None:
    across, along = np.array([[0.6], [0.8]]), np.array([[0.8], [-0.6]])
    local = Local(PRIOR_SD, along, across, np.array([[0.01]]))
    shifts = (nearby(local, local.in_theta, ridge=True) - [1.0, -1.0]) / PRIOR_SD
    np.testing.assert_allclose(shifts @ across, 0.0, atol=1e-12)
    # 256 normal draws: a standard deviation to 4.4%, four of them.
    assert (shifts @ along).std() == pytest.approx(0.1, rel=0.18)


def test_a_refusal_tells_what_the_data_do_not() -> None:
    evaluator = Evaluator.of(one_input([0.0, 1.0], prb.AreaMetric(), mu=(0, 1), sd=0.5))
    short = shortcomings(evaluator, np.array([[30.0]]))
    with pytest.raises(DesignError, match=r"^y: the design does not .* about mu - tau: n") as error:
        refuse(short, evaluator, ["mu - tau"])
    assert len(str(error.value)) <= 450
    text = str(error.value)
    assert text.index("narrow these priors") < text.index("got weight effective")
    with pytest.raises(DesignError, match=r"^y \(and 1 more\): the design does not support"):
        refuse(short | {"z": short["y"]}, evaluator)
    refuse({}, evaluator, ["mu"])


def test_a_rough_emulator_is_a_remark_that_names_its_output() -> None:
    weights, runs = np.full((1, 16), 1 / 16), np.linspace(0, 1, 16)
    y = np.stack([runs, np.sin(40 * runs)], axis=1)
    left_out = np.stack([runs, -np.sin(40 * runs)], axis=1)
    stored: Any = SimpleNamespace(y=y, good=np.ones(16, bool), blocks=np.arange(16) // 2)
    emulator = DesignEmulator(stored, (), left_out, (2,), weights).for_populations(weights)
    assert emulator is not None
    assert emulator.error == pytest.approx(2 * y[:, 1].std() / y[:, 1].std(), rel=0.02)
    bound = SimpleNamespace(design=SimpleNamespace(emulator=emulator))
    evaluator: Any = SimpleNamespace(reweighted={"y": bound})
    (finding,) = rough_emulators(evaluator)
    assert "standard deviations of output 1 of 2 (counted from 0), expected" in finding.text
    bound.design.emulator = replace(emulator, error=0.2)
    assert rough_emulators(evaluator) == []


def test_a_pilot_goes_towards_data_that_are_far() -> None:
    # Where no response is near the data the discrepancy is the same, up to rounding.
    metric, runs = prb.ProbabilityResidual(), prb.Reweighted(128)
    model = one_input(np.linspace(14, 15, 20), metric, runs, mu=(0, 1), sd=0.5)
    # Of 1024 draws of the prior the best quarter lies above .67.
    assert (pilot(Evaluator.of(model), np.ones(1)) > 0.67).all()
