"""Which outputs, and which correlations, disagree with a fit."""

from typing import Any

import numpy as np
import pymc as pm
import pytest

import prbayes as prb
from prbayes.inference.goodness_of_fit import FittedSets, output_misfits
from prbayes.inference.refits import SamplingDistribution
from prbayes.model.evaluator import Evaluator


def three(a: Any, b: Any, c: Any) -> Any:
    return np.stack([a, 0.8 * a + 0.6 * b, c], axis=-1)


def drawn(n: int = 60) -> Any:
    return three(*np.random.default_rng(1).standard_normal((3, n)))


def model_of(data: Any) -> pm.Model:
    with pm.Model() as model:
        mu = pm.Normal("mu", 0.0, 0.3)
        inputs = [pm.Normal.dist(mu, 1.0), pm.Normal.dist(0.0, 1.0), pm.Normal.dist(0.0, 1.0)]
        metric = prb.Joint(prb.ProbabilityResidual(), directions=6)
        prb.Simulator(
            "y",
            three,
            *inputs,
            metric=metric,
            observed=data,
            propagation=prb.Reweighted(128, max_points=768),
        )
    return model


def told(data: Any) -> str:
    """Return what is said of data against the population at zero."""
    evaluator = Evaluator.of(model_of(data))
    sampling = SamplingDistribution.of(evaluator, np.zeros(1), np.ones(1))
    (finding,) = output_misfits(FittedSets.at_theta(sampling, 200, 0))
    return finding.text


def wrong_output() -> Any:
    data = drawn()
    data[:, 2] *= 2
    return data


def wrong_correlation() -> Any:
    data = drawn()
    data[:, 1] = data[::-1, 1]
    return data


def with_gaps(data: Any) -> Any:
    """Return data without the last output of some specimens."""
    data = data.copy()
    data[:10, 2] = np.nan
    return data


@pytest.mark.long
@pytest.mark.parametrize("gaps", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_the_output_with_another_spread_is_named(gaps: bool) -> None:
    data = wrong_output()
    sentence = told(with_gaps(data) if gaps else data)
    assert sentence.startswith("y: what disagrees with the best population are outputs 2 (p = 0.0")
    assert "correlations" not in sentence


@pytest.mark.long
@pytest.mark.parametrize("gaps", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_the_pair_with_another_correlation_is_named(gaps: bool) -> None:
    data = wrong_correlation()
    sentence = told(with_gaps(data) if gaps else data)
    assert "outputs" not in sentence
    assert "correlations 0 with 1 (measured " in sentence
    assert ", calibrated 0.8" in sentence
    assert " with 2" not in sentence


def test_failures_that_the_model_does_not_predict_are_named() -> None:
    data = drawn()
    data[:6, 0] = np.inf
    assert "outputs 0 (p" in told(data)


@pytest.mark.long
def test_of_right_data_nothing_is_named() -> None:
    assert told(drawn()).startswith("y: no output by itself, and no correlation of two, disagrees")


@pytest.mark.long
@pytest.mark.parametrize(
    "wrong", [True, pytest.param(False, marks=pytest.mark.slow)], ids=["wrong", "right"]
)
def test_a_diagnosis_names_what_disagrees_and_is_quiet_otherwise(wrong: bool) -> None:
    optimum = prb.minimize(model_of(wrong_correlation() if wrong else drawn()))
    before = optimum.evaluator.n_responses
    found = prb.diagnose(optimum)
    assert optimum.evaluator.n_responses == before
    assert wrong == any("farther from the best population" in text for text in found.messages)
    assert wrong == ("y: what disagrees with the best population are" in str(found))
