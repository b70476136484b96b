"""Exact gradients of many data sets, against differences of the objective itself."""

from typing import Any

import numpy as np
import pymc as pm
import pytest

import prbayes as prb
from prbayes._checks import Floats
from prbayes.estimate.batch_gradient import BatchGradient
from prbayes.estimate.batch_objective import BatchObjective
from prbayes.estimate.data_sets import DataSets, reweighted_sets
from prbayes.model.evaluator import Evaluator

RNG = np.random.default_rng(2)
PAIRS = RNG.multivariate_normal([1.0, 2.0], [[0.3, 0.1], [0.1, 0.2]], 30)
STEP = 1e-5


def priors() -> tuple[Any, ...]:
    return pm.Normal("mu", 1, 1, shape=2), pm.HalfNormal("sd", 1, shape=2), pm.Uniform("rho", -1, 1)


def correlated(metric: prb.Metric, observed: Any = PAIRS, **keywords: Any) -> pm.Model:
    """A joint input with five hyperparameters, of which a second simulator sees one."""
    with pm.Model() as model:
        mu, sd, rho = priors()
        off = rho * sd[0] * sd[1]
        cov = pm.math.stack([[sd[0] ** 2, off], [off, sd[1] ** 2]])
        own = {"propagation": prb.Reweighted(256), **keywords}
        x = pm.MvNormal.dist(mu, cov=cov)
        prb.Simulator("y", lambda x: x, x, metric=metric, observed=observed, **own)
        other = pm.LogNormal.dist(mu[0], 0.5)
        alone = prb.KullbackLeibler()
        prb.Simulator("z", np.sqrt, other, metric=alone, observed=np.exp(PAIRS[:, 0]), **own)
    return model


def of_sets(model: pm.Model, number: int = 4) -> tuple[BatchObjective, DataSets]:
    evaluator = Evaluator(model)
    sets = reweighted_sets(evaluator, number)
    return BatchObjective.of(evaluator, np.array([0.7, 2.0]), sets), sets


def differences(objective: BatchObjective, thetas: Floats, rows: Any, step: Any = STEP) -> Floats:
    """Return central differences of the objective."""
    unit = step * np.eye(thetas.shape[1])
    up = objective(thetas[:, None] + unit, rows)
    return (up - objective(thetas[:, None] - unit, rows)) / (2 * step)


def near(objective: BatchObjective, number: int) -> Floats:
    """Return thetas around what the data say."""
    rng = np.random.default_rng(4)
    return np.array([1.0, 2.0, -0.6, -0.8, 0.5]) + 0.2 * rng.normal(size=(number, 5))


METRICS = {
    "kl": prb.Joint(prb.KullbackLeibler()),
    "reverse": prb.Joint(prb.KullbackLeibler(reverse=True)),
    "pr": prb.Joint(prb.ProbabilityResidual()),
    "ll": prb.Joint(prb.LogLikelihood(density=prb.GaussianKDE())),
}


@pytest.mark.parametrize("name", list(METRICS))
def test_it_is_what_differences_tell(name: str) -> None:
    objective, _ = of_sets(correlated(METRICS[name]))
    gradient = BatchGradient.of(objective)
    assert gradient is not None
    rows = np.array([2, 0, 3, 3])
    thetas = near(objective, len(rows))
    values, slopes = gradient(thetas, rows)
    np.testing.assert_allclose(values, objective(thetas[:, None], rows)[:, 0], rtol=1e-12)
    expected = differences(objective, thetas, rows)
    np.testing.assert_allclose(slopes, expected, rtol=1e-5, atol=1e-6 * np.abs(expected).max())
    assert (np.abs(slopes) > 0).all()


def test_with_missing_outputs_and_so_many_points_that_none_has_a_matrix() -> None:
    some = PAIRS.copy()
    some[:5, 0] = np.nan
    model = correlated(METRICS["kl"], some, propagation=prb.Reweighted(1 << 14))
    objective, _ = of_sets(model, 2)
    (seen,) = objective.bases[0]
    assert seen.shape[1] == len(objective.targets[0].parts)  # what each sees, not its densities
    gradient = BatchGradient.of(objective)
    assert gradient is not None
    thetas = near(objective, 2)
    _, slopes = gradient(thetas, slice(None))
    expected = differences(objective, thetas, np.arange(2))
    np.testing.assert_allclose(slopes, expected, rtol=1e-5, atol=1e-6 * np.abs(expected).max())


@pytest.mark.parametrize(
    "metric", [prb.Joint(prb.AreaMetric()), prb.MarginalCorrelation(prb.KullbackLeibler())]
)
def test_what_is_no_sum_over_cells_has_none(metric: prb.Metric) -> None:
    objective, _ = of_sets(correlated(metric))
    assert BatchGradient.of(objective) is None


def test_nor_has_what_sees_blocks() -> None:
    model = correlated(METRICS["kl"])
    evaluator = Evaluator(model)
    sets = reweighted_sets(evaluator, 2)
    blocks = [np.arange(node.bound.n_points) % 2 for node in evaluator.nodes]
    assert BatchGradient.of(BatchObjective.of(evaluator, np.ones(2), sets, blocks=blocks)) is None


def test_where_no_population_is_supported_it_is_infinite() -> None:
    objective, _ = of_sets(correlated(METRICS["kl"]))
    gradient = BatchGradient.of(objective)
    assert gradient is not None
    thetas = near(objective, 2)
    thetas[1, 2] = -800.0  # a standard deviation that is zero: no density
    values, slopes = gradient(thetas, np.arange(2))
    assert np.isfinite(values[0])
    assert np.isfinite(slopes[0]).all()
    assert np.isposinf(values[1])


def test_where_a_gradient_is_no_number_differences_tell() -> None:
    with pm.Model() as model:
        mu, sd, _ = priors()  # no response depends on the last
        x = pm.TruncatedNormal.dist(mu[0], sd[0], lower=mu[0] - 1)
        y = pm.Normal.dist(mu[1], sd[1])
        prb.Simulator(
            "y",
            lambda x, y: np.stack([x, y], axis=-1),
            x,
            y,
            metric=METRICS["kl"],
            observed=PAIRS,
            propagation=prb.Reweighted(256),
        )
    objective, _ = of_sets(model)
    gradient = BatchGradient.of(objective)
    assert gradient is not None
    thetas = near(objective, 4)
    rows = np.arange(4)
    assert np.isnan(gradient._of_some(thetas, rows)[1]).any()
    _, slopes = gradient(thetas, rows)
    # Points are cut off one by one: the step matters.
    expected = differences(objective, thetas, rows, 1e-4 * objective.evaluator.prior_sd)
    np.testing.assert_allclose(slopes, expected, rtol=1e-6, atol=1e-9)


def test_one_data_set_serves_any_number_of_rows() -> None:
    objective, _ = of_sets(correlated(METRICS["kl"]), 1)
    gradient = BatchGradient.of(objective)
    assert gradient is not None
    thetas = near(objective, 3)
    _, slopes = gradient(thetas, np.zeros(3, dtype=np.intp))
    alone = [gradient(theta[None], slice(None))[1][0] for theta in thetas]
    np.testing.assert_allclose(slopes, alone, rtol=1e-10)


def test_a_design_that_grew_by_itself_has_its_own() -> None:
    # What is compiled reads shared variables: those of a copy are others.
    evaluator = Evaluator(correlated(METRICS["kl"]))
    design = evaluator.designs["z"]
    roots = evaluator.roots(np.array([[0.9, 2.0, -0.6, -0.8, 0.5]]), 1)
    towards = np.random.default_rng(1).normal(size=1024)

    def check(one: Any) -> None:
        def along(shift: float) -> Any:
            moved = [roots[0] + shift * np.array([1.0, 0.0]), *roots[1:]]
            _, weights = one.populations(moved)
            return weights @ towards[: one.n_points], weights

        _, weights = along(0.0)
        by_mu, *_ = one.pulled_back(roots, weights, towards[None, : one.n_points])
        expected = (along(STEP)[0] - along(-STEP)[0]) / (2 * STEP)
        np.testing.assert_allclose(by_mu[:, 0], expected, rtol=1e-6)

    check(design)
    other = design.copied()
    other.add(roots, 128)
    assert other.n_points > design.n_points
    check(other)
    check(design)
