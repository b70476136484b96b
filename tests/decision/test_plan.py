"""Expected standard deviations beside those of normal populations."""

import numpy as np
import pytest
import xarray as xr
from decisions import N, doubled, normal, optimum, posterior, same

import prbayes as prb
from prbayes.decision.plan import Draws, fisher_information, specimen_information
from prbayes.decision.populations import Populations


@pytest.fixture(scope="module")
def table() -> xr.Dataset:
    _, x = normal()
    quantity = prb.decision.Quantile(same, x, probability=0.95)
    candidates = {
        "same": prb.decision.Condition(same, x),
        "size": prb.decision.Condition(
            lambda x: np.abs(x - 1.0), x, metric=prb.LogLikelihood(density=prb.GaussianKDE())
        ),
    }
    return prb.plan(optimum(), candidates, k=[N, 3 * N], quantity=quantity)


def test_specimens_of_the_same_kind_narrow_by_their_number(table: xr.Dataset) -> None:
    ratio = table.sd.sel(candidate="same") / table.now
    np.testing.assert_allclose(ratio.sel(k=N), np.sqrt(1 / 2), rtol=0.05)
    np.testing.assert_allclose(ratio.sel(k=3 * N), np.sqrt(1 / 4), rtol=0.06)
    assert table.now.sel(name="mu") == pytest.approx(optimum().stderr["mu"], rel=0.03)


def test_another_condition_tells_of_what_it_sees(table: xr.Dataset) -> None:
    ratio = (table.sd / table.now).sel(candidate="size", k=3 * N)
    assert float(ratio.sel(name="mu")) > 0.9
    assert float(ratio.sel(name="sigma")) < 0.6


@pytest.mark.slow
def test_the_number_that_reaches_a_target() -> None:
    _, x = normal()
    condition = {"same": prb.decision.Condition(same, x)}
    target = {"mu": 0.03, "quantity": 1e-9, "sigma": 9.0}
    quantity = prb.decision.Quantile(same, x, probability=0.95)
    table = prb.plan(optimum(), condition, k=5, quantity=quantity, target=target)
    needed = table.specimens.sel(candidate="same")
    now = float(table.now.sel(name="mu"))
    assert float(needed.sel(name="mu")) == pytest.approx(N * ((now / 0.03) ** 2 - 1), rel=0.1)
    assert float(needed.sel(name="sigma")) == 0
    assert float(needed.sel(name="quantity")) == np.inf
    # It is the least.
    k = int(needed.sel(name="mu"))
    around = prb.plan(optimum(), condition, k=[k - 1, k]).sd.sel(candidate="same", name="mu")
    assert float(around[1]) <= 0.03 < float(around[0])


def test_a_target_that_is_in_no_table_is_refused() -> None:
    condition = {"same": prb.decision.Condition(same, normal()[1])}
    with pytest.raises(KeyError, match=r"got 'quantity', expected one of \['mu', 'sigma'\]"):
        prb.plan(optimum(), condition, k=5, target={"quantity": 1.0})


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
    sample = populations.sample_of_all_outputs(same, (normal()[1],))
    unit = populations.evaluator.hyperparameters.prior_sd
    found = specimen_information(sample, metric) / np.outer(unit, unit)
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
        specimen_information(populations.sample_of_all_outputs(response, (x,)), None)
        for response in (same, doubled)
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
    found = fisher_information(populations.sample_of_all_outputs(np.exp, (x,))) / unit
    expected = np.diag([1 / sigma**2, 2.0])
    np.testing.assert_allclose(found, expected, rtol=0.03, atol=0.03)
    # Whether a specimen is above the mean: p (1 - p) in place of the density's.
    above = (
        fisher_information(populations.sample_of_all_outputs(lambda x: 1.0 * (x > 1.0), (x,)))
        / unit
    )
    assert above[0, 0] == pytest.approx(2 / np.pi / sigma**2, rel=0.05)
    both = fisher_information(
        populations.sample_of_all_outputs(lambda x: np.stack([x, -x], axis=-1), (x,))
    )
    np.testing.assert_allclose(both / unit, expected, rtol=0.01, atol=0.01)


def test_what_tells_of_one_direction_only() -> None:
    populations = Populations.of(optimum(), None, 10, "prb.plan")
    sample = populations.sample_of_all_outputs(lambda x: np.abs(x - 1.0), (normal()[1],))
    found = specimen_information(sample, prb.LogLikelihood(density=prb.GaussianKDE()))
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
    draws = Draws.of(thetas, unit)
    np.testing.assert_allclose(draws.covariance, covariance, rtol=0.05)
    more = np.array([[2.0, -1.0], [-1.0, 3.0]])
    after = draws.with_information(more)
    expected = np.linalg.inv(np.linalg.inv(covariance) + more)
    np.testing.assert_allclose(np.cov((after / unit).T), expected, rtol=0.05, atol=0.01)
    np.testing.assert_allclose(np.median(after, axis=0), np.median(thetas, axis=0), rtol=0.01)
    np.testing.assert_allclose(draws.with_information(0 * more), thetas, rtol=1e-9)


def test_draws_of_a_posterior_are_read() -> None:
    populations = Populations.of(posterior(), normal()[0], 1000, "prb.plan")
    draws = Draws.of(populations.thetas, populations.evaluator.hyperparameters.prior_sd)
    sd = np.sqrt(np.diag(draws.covariance)) * draws.unit
    np.testing.assert_allclose(sd, populations.thetas.std(axis=0), rtol=0.03)
