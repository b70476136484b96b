"""Expected standard deviations beside those of normal populations."""

from typing import Any

import numpy as np
import pymc as pm
import pytest
from decisions import N, doubled, normal, optimum, posterior, same
from one_input import posterior_of

import prbayes as prb
from prbayes.decision.plan import Draws, fisher_information, specimen_information
from prbayes.decision.populations import Populations

KERNEL = prb.LogLikelihood(density=prb.GaussianKDE())


def around_middle(x: Any) -> Any:
    return np.abs(x - 1.0)


@pytest.fixture(scope="module")
def populations() -> Populations:
    return Populations.of(optimum(), None, 10, "prb.plan")


def test_specimens_narrow_the_posterior_by_their_number_and_kind() -> None:
    _, x = normal()
    quantity = prb.decision.Quantile(same, x, probability=0.95)
    candidates = {
        "same": prb.decision.Condition(same, x),
        "size": prb.decision.Condition(around_middle, x, metric=KERNEL),
    }
    table = prb.plan(optimum(), candidates, k=[N, 3 * N], quantity=quantity)
    ratio = table.sd / table.now
    np.testing.assert_allclose(ratio.sel(candidate="same", k=N), np.sqrt(1 / 2), rtol=0.05)
    np.testing.assert_allclose(ratio.sel(candidate="same", k=3 * N), np.sqrt(1 / 4), rtol=0.06)
    assert table.now.sel(name="mu") == pytest.approx(optimum().stderr["mu"], rel=0.03)
    other = ratio.sel(candidate="size", k=3 * N)
    assert float(other.sel(name="mu")) > 0.9
    assert float(other.sel(name="sigma")) < 0.6


def test_the_number_that_reaches_a_target() -> None:
    _, x = normal()
    condition = {"same": prb.decision.Condition(same, x)}
    with pytest.raises(KeyError, match=r"got 'quantity', expected one of \['mu', 'sigma'\]"):
        prb.plan(optimum(), condition, k=5, max_sd={"quantity": 1.0})
    table = prb.plan(optimum(), condition, k=5, max_sd={"mu": 0.03, "sigma": 9.0})
    needed = table.specimens.sel(candidate="same")
    now = float(table.now.sel(name="mu"))
    assert float(needed.sel(name="mu")) == pytest.approx(N * ((now / 0.03) ** 2 - 1), rel=0.1)
    assert float(needed.sel(name="sigma")) == 0
    # It is the least.
    k = int(needed.sel(name="mu"))
    around = prb.plan(optimum(), condition, k=[k - 1, k]).sd.sel(candidate="same", name="mu")
    assert float(around[1]) <= 0.03 < float(around[0])


def fisher(populations: Populations, response: Any = same) -> Any:
    """Return the Fisher information of mean and log standard deviation."""
    unit = populations.evaluator.hyperparameters.prior_sd
    sample = populations.sample_of_all_outputs(response, (normal()[1],))
    return fisher_information(sample) / np.outer(unit, unit)


# Least efficiency of a metric for the mean and the standard deviation of a normal population.
@pytest.mark.parametrize(
    ("metric", "least"),
    [(KERNEL, 0.95), (prb.AreaMetric(), 0.85), (prb.ProbabilityResidual(), 0.8)],
)
def test_information_of_a_specimen_of_a_normal_population(
    populations: Populations, metric: prb.Metric, least: float
) -> None:
    sample = populations.sample_of_all_outputs(same, (normal()[1],))
    unit = populations.evaluator.hyperparameters.prior_sd
    information = specimen_information(sample, metric)
    found = information / np.outer(unit, unit)
    # Fisher's information of the mean and of log sigma.
    expected = np.array([1 / np.exp(populations.center[1]) ** 2, 2.0])
    ratio = np.diag(found) / expected
    assert ((least - 0.1 < ratio) & (ratio < 1.05)).all(), ratio
    assert abs(found[0, 1]) < 0.05 * np.sqrt(expected.prod())
    # The unit of the response does not matter.
    scaled = populations.sample_of_all_outputs(doubled, (normal()[1],))
    tolerance = 1e-3 * np.abs(information).max()
    np.testing.assert_allclose(
        specimen_information(scaled, metric), information, rtol=1e-3, atol=tolerance
    )


def test_fishers_information_of_a_response(populations: Populations) -> None:
    sigma = np.exp(populations.center[1])
    expected = np.diag([1 / sigma**2, 2.0])
    np.testing.assert_allclose(fisher(populations, np.exp), expected, rtol=0.03, atol=0.03)
    both = fisher(populations, lambda x: np.stack([x, -x], axis=-1))
    np.testing.assert_allclose(both, expected, rtol=0.01, atol=0.01)
    # Whether a specimen is above the mean: p (1 - p) in place of the density's.
    above = fisher(populations, lambda x: 1.0 * (x > 1.0))
    assert above[0, 0] == pytest.approx(2 / np.pi / sigma**2, rel=0.05)
    # Distances from about the middle contain little information about its place.
    sample = populations.sample_of_all_outputs(around_middle, (normal()[1],))
    unit = populations.evaluator.hyperparameters.prior_sd
    found = specimen_information(sample, KERNEL) / np.outer(unit, unit)
    assert found[0, 0] < 0.05 / sigma**2
    assert 1.8 < found[1, 1] < 2.1


def test_precisions_add_up() -> None:
    rng = np.random.default_rng(0)
    covariance = np.array([[1.0, 0.5], [0.5, 0.5]])
    unit = np.array([10.0, 0.1])
    thetas = 3 + rng.multivariate_normal([0, 0], covariance, 20_000) * unit
    draws = Draws.of(thetas, unit)
    np.testing.assert_allclose(draws.covariance, covariance, rtol=0.05)
    more = np.array([[2.0, -1.0], [-1.0, 3.0]])
    after = draws.with_information(more)
    expected = np.linalg.inv(np.linalg.inv(covariance) + more)
    np.testing.assert_allclose(np.cov((after / unit).T), expected, rtol=0.05, atol=0.01)
    np.testing.assert_allclose(np.median(after, axis=0), np.median(thetas, axis=0), rtol=0.01)
    np.testing.assert_allclose(draws.with_information(0 * more), thetas, rtol=1e-9)
    # Draws of a posterior are read.
    populations = Populations.of(posterior(), normal()[0], 1000, "prb.plan")
    draws = Draws.of(populations.thetas, populations.evaluator.hyperparameters.prior_sd)
    sd = np.sqrt(np.diag(draws.covariance)) * draws.unit
    np.testing.assert_allclose(sd, populations.thetas.std(axis=0), rtol=0.03)


@pytest.mark.long
def test_errors_of_readings_are_part_of_the_information() -> None:
    """A normal population with standard deviation .3, and normal errors."""
    rng = np.random.default_rng(0)
    observed = rng.normal(1.0, 0.3, 30)
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1))
        error = pm.HalfNormal("error", 0.5)
        metric = prb.LogLikelihood(error=error)
        prb.Simulator("y", same, x, observed=observed + rng.normal(0, 0.5, 30), metric=metric)
    result = posterior_of(
        mu=rng.normal(1.0, 0.05, (1, 500)),
        sigma=0.3 * np.exp(rng.normal(0, 0.1, (1, 500))),
        error=0.5 * np.exp(rng.normal(0, 0.1, (1, 500))),
    )
    populations = Populations.of(result, model, 500, "prb.plan")
    sigma, e = np.exp(populations.center[1:])
    unit = populations.evaluator.hyperparameters.prior_sd

    def information(response: Any, metric: Any = None) -> Any:
        sample = populations.sample_of_all_outputs(response, (x,))
        return specimen_information(sample, metric) / np.outer(unit, unit)

    def normal(covariance: Any, errors: Any) -> Any:
        """Return the information of normal readings about the mean, log sigma and log error."""
        inverse = np.linalg.inv(covariance)
        slopes = [2 * (covariance - errors) @ inverse, 2 * errors @ inverse]
        spreads = [[0.5 * np.trace(a @ b) for a in slopes] for b in slopes]
        return np.pad(spreads, (1, 0)) + np.diag([inverse.sum(), 0, 0])

    variance = np.full((2, 2), sigma**2)
    expected = normal(variance[:1, :1] + e**2, np.array([[e**2]]))
    np.testing.assert_allclose(information(same), expected, rtol=0.06, atol=0.06)
    # Of two outputs with an error that the candidate's metric states, and the model does not have.
    errors = np.diag([0.3, 1.0]) ** 2
    expected = normal(variance + errors, errors)
    expected[2] = expected[:, 2] = 0
    stated = prb.LogLikelihood(error=[0.3, 1.0])
    found = information(lambda x: np.stack([x, x], axis=-1), stated)
    np.testing.assert_allclose(found, expected, rtol=0.06, atol=0.06)
    with pytest.raises(ValueError, match=r"got 2 outputs, expected 1, .*LogLikelihood\(error="):
        information(lambda x: np.stack([x, x], axis=-1))
    # Censored at the mean: half of the readings are equal.
    censored = information(same, prb.LogLikelihood(censored=(None, populations.center[0])))
    assert censored[0, 0] == pytest.approx((0.5 + 1 / np.pi) / sigma**2, rel=0.05)
    # A limit that no reading of the second output reaches, and none of the first, change nothing.
    limited = prb.LogLikelihood(error=[0.3, 1.0], censored=(None, [None, 1e3]))
    unchanged = information(lambda x: np.stack([x, x], axis=-1), limited)
    np.testing.assert_array_equal(unchanged, found)


def test_ends_that_extreme_specimens_determine_are_refused() -> None:
    with pm.Model() as model:
        x = pm.Uniform.dist(0.0, pm.Normal("end", 3, 0.3))
        prb.Simulator("y", same, x, observed=np.linspace(0.1, 2.9, 30))
    result = posterior_of(end=np.random.default_rng(0).uniform(2.95, 3.1, (1, 200)))
    with pytest.raises(ValueError, match="support moves with their hyperparameters, as of a unif"):
        prb.plan(result, {"same": prb.decision.Condition(same, x)}, k=30, model=model)


@pytest.mark.parametrize("share", [0.5, 0.2])
def test_modes_keep_their_masses(share: float) -> None:
    """Squares do not identify the sign of the mean, however many are measured."""
    rng = np.random.default_rng(0)
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1))
        prb.Simulator("y", np.square, x, observed=rng.normal(2.0, 0.3, 20) ** 2)
    sign = np.where(np.arange(2000) < 2000 * share, -1.0, 1.0)
    mu = sign * rng.normal(2.0, 0.1, (1, 2000))
    result = posterior_of(mu=mu, sigma=0.3 * np.exp(rng.normal(0, 0.1, (1, 2000))))
    same = {"same": prb.decision.Condition(np.square, x)}
    table = prb.plan(result, same, k=[30, 3000], model=model, max_sd={"mu": 0.5})
    sd = table.sd.sel(candidate="same")
    np.testing.assert_allclose(sd.sel(name="mu"), 4 * np.sqrt(share * (1 - share)), rtol=0.01)
    # Within a mode the squares have all information about the inputs.
    expected = 0.3 / np.sqrt(1 / 0.1**2 + 2 * 30)
    assert float(sd.sel(name="sigma", k=30)) == pytest.approx(expected, rel=0.1)
    assert float(table.specimens.sel(candidate="same", name="mu")) == np.inf
    assert "second-mode" in table.attrs["findings"]
