"""The information in a specimen, and draws that have more of it, beside closed forms."""

import numpy as np
import pytest
from decisions import doubled, normal, optimum, posterior, same

import prbayes as prb
from prbayes.decision.information import Belief, fisher_information, of_a_specimen
from prbayes.decision.populations import Populations

METRICS = [
    prb.LogLikelihood(density=prb.GaussianKDE()),
    prb.AreaMetric(),
    prb.ProbabilityResidual(),
]
# Efficiency of each metric for the mean and the standard deviation of a normal population: that of
# Cramer and von Mises' kind of distances is known to be within these.
LEAST = [0.95, 0.85, 0.8]


@pytest.mark.parametrize(("metric", "least"), list(zip(METRICS, LEAST, strict=True)))
def test_a_specimen_of_a_normal_population(metric: prb.Metric, least: float) -> None:
    populations = Populations.of(optimum(), None, 10, "prb.plan")
    told = populations.all_outputs(same, (normal()[1],))
    unit = populations.evaluator.hyperparameters.prior_sd
    found = of_a_specimen(told, metric) / np.outer(unit, unit)
    # Fisher's information of the mean and of log sigma.
    sigma = np.exp(populations.center[1])
    expected = np.array([1 / sigma**2, 2.0])
    ratio = np.diag(found) / expected
    assert (ratio > least - 0.1).all(), ratio
    assert (ratio < 1.05).all(), ratio
    assert abs(found[0, 1]) < 0.05 * np.sqrt(expected.prod())


def test_the_unit_of_a_response_does_not_matter() -> None:
    populations = Populations.of(optimum(), None, 10, "prb.plan")
    x = normal()[1]
    one, two = (
        of_a_specimen(populations.all_outputs(response, (x,)), None) for response in (same, doubled)
    )
    np.testing.assert_allclose(one, two, rtol=1e-3, atol=1e-3 * np.abs(one).max())


def test_fishers_information_of_a_response() -> None:
    populations = Populations.of(optimum(), None, 10, "prb.plan")
    unit = np.outer(
        populations.evaluator.hyperparameters.prior_sd,
        populations.evaluator.hyperparameters.prior_sd,
    )
    sigma = np.exp(populations.center[1])
    x = normal()[1]
    found = fisher_information(populations.all_outputs(np.exp, (x,))) / unit
    expected = np.diag([1 / sigma**2, 2.0])
    np.testing.assert_allclose(found, expected, rtol=0.03, atol=0.03)
    # Whether a specimen is above the mean: p (1 - p) in place of the density's.
    above = fisher_information(populations.all_outputs(lambda x: 1.0 * (x > 1.0), (x,))) / unit
    assert above[0, 0] == pytest.approx(2 / np.pi / sigma**2, rel=0.05)
    both = fisher_information(populations.all_outputs(lambda x: np.stack([x, -x], axis=-1), (x,)))
    np.testing.assert_allclose(both / unit, expected, rtol=0.01, atol=0.01)


def test_what_tells_of_one_direction_only() -> None:
    populations = Populations.of(optimum(), None, 10, "prb.plan")
    told = populations.all_outputs(lambda x: np.abs(x - 1.0), (normal()[1],))
    found = of_a_specimen(told, prb.LogLikelihood(density=prb.GaussianKDE()))
    # How far specimens are from about the middle says little of where that is.
    sigma = np.exp(populations.center[1])
    unit = populations.evaluator.hyperparameters.prior_sd
    assert found[0, 0] / unit[0] ** 2 < 0.05 / sigma**2
    assert 1.8 < found[1, 1] / unit[1] ** 2 < 2.1


def test_precisions_add_up() -> None:
    rng = np.random.default_rng(0)
    covariance = np.array([[1.0, 0.5], [0.5, 0.5]])
    unit = np.array([10.0, 0.1])
    thetas = 3 + rng.multivariate_normal([0, 0], covariance, 20_000) * unit
    belief = Belief.of(thetas, unit)
    np.testing.assert_allclose(belief.covariance, covariance, rtol=0.05)
    more = np.array([[2.0, -1.0], [-1.0, 3.0]])
    after = belief.after(more)
    expected = np.linalg.inv(np.linalg.inv(covariance) + more)
    np.testing.assert_allclose(np.cov((after / unit).T), expected, rtol=0.05, atol=0.01)
    np.testing.assert_allclose(np.median(after, axis=0), np.median(thetas, axis=0), rtol=0.01)
    np.testing.assert_allclose(belief.after(0 * more), thetas, rtol=1e-9)


def test_draws_of_a_posterior_are_read() -> None:
    populations = Populations.of(posterior(), normal()[0], 1000, "prb.plan")
    belief = Belief.of(populations.thetas, populations.evaluator.hyperparameters.prior_sd)
    sd = np.sqrt(np.diag(belief.covariance)) * belief.unit
    np.testing.assert_allclose(sd, populations.thetas.std(axis=0), rtol=0.03)
