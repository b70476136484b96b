"""The information in a specimen, and draws that have more of it, beside closed forms."""

import numpy as np
import pytest
from decisions import doubled, normal, optimum, posterior, same

import prbayes as prb
from prbayes.decision.information import Belief, of_a_specimen
from prbayes.decision.populations import Populations

METRICS = [prb.LogLikelihood(), prb.AreaMetric(), prb.ProbabilityResidual()]
# Efficiency of each metric for the mean and the standard deviation of a normal population: that of
# Cramer and von Mises' kind of distances is known to be within these.
LEAST = [0.95, 0.85, 0.8]


@pytest.mark.parametrize(("metric", "least"), zip(METRICS, LEAST, strict=True), ids=repr)
def test_a_specimen_of_a_normal_population(metric: prb.Metric, least: float) -> None:
    populations = Populations.of(optimum(), None, 10, "prb.plan")
    told = populations.all_outputs(same, (normal()[1],))
    unit = populations.evaluator.prior_sd
    found = of_a_specimen(told, metric, 50) / np.outer(unit, unit)
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
        of_a_specimen(populations.all_outputs(response, (x,)), None, 50)
        for response in (same, doubled)
    )
    np.testing.assert_allclose(one, two, rtol=1e-3, atol=1e-3 * np.abs(one).max())


def test_what_tells_of_one_direction_only() -> None:
    populations = Populations.of(optimum(), None, 10, "prb.plan")
    told = populations.all_outputs(lambda x: np.abs(x - 1.0), (normal()[1],))
    found = of_a_specimen(told, prb.LogLikelihood(), 50)
    values = np.linalg.eigvalsh(found)
    # How far specimens are from the middle says nothing of which side they are on.
    assert values[0] < 0.05 * values[1]


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
    np.testing.assert_allclose(np.median(after, axis=0), np.median(thetas, axis=0), rtol=1e-9)
    np.testing.assert_allclose(belief.after(0 * more), thetas, rtol=1e-9)


def test_draws_of_a_posterior_are_read() -> None:
    populations = Populations.of(posterior(), normal()[0], 1000, "prb.plan")
    belief = Belief.of(populations.thetas, populations.evaluator.prior_sd)
    sd = np.sqrt(np.diag(belief.covariance)) * belief.unit
    np.testing.assert_allclose(sd, populations.thetas.std(axis=0), rtol=0.03)
