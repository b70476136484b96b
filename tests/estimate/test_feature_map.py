"""Features of populations interpolated over the hyperparameters, and what the descents gain by it."""

from functools import cache
from typing import Any

import numpy as np
import pymc as pm
import pytest

import prbayes as prb
from prbayes._checks import Floats
from prbayes.estimate import feature_map, refit
from prbayes.estimate.batch_objective import BatchObjective
from prbayes.estimate.data_sets import DataSets, sets_along
from prbayes.estimate.feature_map import FeatureMap
from prbayes.estimate.refit import SamplingDistribution

METRICS: dict[str, prb.Metric] = {
    "residual": prb.ProbabilityResidual(),
    "divergence": prb.KullbackLeibler(),
    "area": prb.AreaMetric(),
    "joint": prb.Joint(prb.KullbackLeibler()),
    "joint area": prb.Joint(prb.AreaMetric()),
    "correlation": prb.MarginalCorrelation(prb.ProbabilityResidual()),
}
KEYS = pytest.mark.parametrize("name", METRICS)
SOME = pytest.mark.parametrize(
    "name", [pytest.param(k, marks=pytest.mark.long if k == "joint area" else ()) for k in METRICS]
)


def two(x: Any, y: Any) -> Any:
    return np.stack([x + 0.2 * y, y - 0.1 * x**2], axis=-1)


def first(x: Any, y: Any) -> Any:
    return x + 0.5 * y


@cache
def fitted(name: str) -> SamplingDistribution:
    """Two inputs, of which mean and spread of one and the mean of the other are looked for."""
    rng = np.random.default_rng(3)
    x, y = rng.normal(1.0, 0.5, 40), rng.normal(0.0, 0.3, 40)
    metric = METRICS[name]
    response = two if metric.takes_outputs else first
    with pm.Model() as model:
        inputs = [
            pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1)),
            pm.Normal.dist(pm.Normal("nu", 0, 0.5) if metric.takes_outputs else 0.0, 0.3),
        ]
        propagation = prb.Reweighted(1024, emulator=None)
        prb.Simulator(
            "y", response, *inputs, metric=metric, observed=response(x, y), propagation=propagation
        )
    optimum = prb.minimize(model, starts=0, refine=False)
    scales = np.array(list(optimum.scales.values()))
    return SamplingDistribution.of(optimum.evaluator, optimum.theta, scales)


@cache
def along(name: str) -> tuple[DataSets, Floats]:
    """Return data sets of other populations, and the coordinates of these."""
    sampling = fitted(name)
    rng = np.random.default_rng(4)
    points = 1.5 * rng.normal(size=(200, sampling.stderr.size))
    return sets_along(sampling.evaluator, sampling.thetas(points), rng), points


def refitted(name: str, monkeypatch: pytest.MonkeyPatch, worth: int) -> tuple[Floats, int]:
    """Return the minimisers, and how many populations were compared with data sets for them."""
    monkeypatch.setattr(refit, "WORTH", worth)
    count = 0
    values = BatchObjective.__call__

    def counted(self: BatchObjective, thetas: Floats, rows: Any) -> Floats:
        nonlocal count
        count += thetas.shape[0] * thetas.shape[1]
        return values(self, thetas, rows)

    monkeypatch.setattr(BatchObjective, "__call__", counted)
    sets, points = along(name)
    x, converged = fitted(name).refit(sets, points, roughly=True)
    monkeypatch.undo()
    assert converged.all()
    return x, count


@SOME
def test_minima_are_the_same_for_half_of_the_populations(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    exact, needed = refitted(name, monkeypatch, worth=10**9)
    x, count = refitted(name, monkeypatch, worth=0)
    apart = np.abs(x - exact).max(axis=1)
    assert np.median(apart) < 0.03  # of a standard error, which is what descents leave open
    assert np.quantile(apart, 0.95) < 0.15
    assert count < 0.6 * needed


def mapped(name: str) -> tuple[FeatureMap, BatchObjective, Floats]:
    """Return the map of these data sets, what it stands for, and the coordinates."""
    sampling = fitted(name)
    sets, points = along(name)
    objective = BatchObjective.of(sampling.evaluator, sampling.scales, sets)
    found = FeatureMap.around(objective, points, sampling.thetas)
    assert found is not None
    return found, objective, points


@KEYS
def test_values_are_nearly_those_of_the_objective(name: str) -> None:
    found, objective, points = mapped(name)
    sampling = fitted(name)
    about = found.against(objective)
    x = 0.5 * points[:50, None]
    values = about(x, slice(50))
    exact = objective(sampling.thetas(x), slice(50))
    assert values.shape == (50, 1)
    # As they rise by one standard error from the minimum on.
    rise = objective(sampling.thetas(x + 1.0), slice(50)) - exact
    assert np.abs(values - exact).max() < 0.05 * np.abs(rise).mean()


@SOME
def test_some_data_sets_at_a_time_have_the_values_of_all(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    found, objective, points = mapped(name)
    about = found.against(objective)
    x = 0.5 * np.stack([points, points + 0.1], axis=1)
    rows = np.arange(len(points))[::-1]
    monkeypatch.setattr(feature_map, "_FEATURES_AT_ONCE", 10**9)
    expected = about(x, rows)
    monkeypatch.setattr(feature_map, "_FEATURES_AT_ONCE", 14 * found.center.size)
    np.testing.assert_allclose(about(x, rows), expected, rtol=1e-9)
    np.testing.assert_allclose(about(x, slice(None)), about(x, np.arange(len(x))), rtol=1e-12)


def test_a_map_that_misleads_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    exact, _ = refitted("residual", monkeypatch, worth=10**9)
    used = 0
    against = FeatureMap.against

    def shifted(self: FeatureMap, objective: BatchObjective) -> Any:
        nonlocal used
        used += 1
        value = against(self, objective)
        return lambda x, rows: value(x + 1.0, rows)

    monkeypatch.setattr(FeatureMap, "against", shifted)
    monkeypatch.setattr(SamplingDistribution, "_at_once", lambda self, sets: 50)
    x, _ = refitted("residual", monkeypatch, worth=0)
    assert np.abs(x - exact).max() < 0.1
    assert used == 1  # of the four times fifty


def test_there_is_no_map_of_few_populations() -> None:
    sampling = fitted("residual")
    sets, points = along("residual")
    objective = BatchObjective.of(sampling.evaluator, sampling.scales, sets)
    assert FeatureMap.around(objective, points[:20], sampling.thetas) is None
    same = np.repeat(points[:2], 50, axis=0)
    assert FeatureMap.around(objective, same, sampling.thetas) is None


def test_features_without_numbers_are_left_out() -> None:
    sampling = fitted("residual")
    sets, points = along("residual")
    objective = BatchObjective.of(sampling.evaluator, sampling.scales, sets)

    def thetas_of(x: Floats) -> Floats:
        thetas = sampling.thetas(x)
        thetas[:3] = np.nan
        return thetas

    found = FeatureMap.around(objective, points, thetas_of)
    assert found is not None
    assert np.isfinite(found.against(objective)(points[:5, None], slice(5))).all()


def test_a_thinned_basis_tells_about_the_same_area() -> None:
    rng = np.random.default_rng(0)
    observed, simulated = rng.normal(size=30), rng.normal(0.3, 1.2, 3000)
    target = prb.AreaMetric().against(observed)
    basis = target.basis(simulated)
    thin = target.thinned(basis, 300)
    assert [len(array) for array in thin[1::2]] == [300, 300]
    assert target.thinned(basis, 10**6) is basis
    weights = rng.random(3000)
    weights /= weights.sum()
    area, about = (
        target.outer(*target.from_basis(weights, each, np), xp=np) for each in (basis, thin)
    )
    assert about == pytest.approx(area, rel=0.02)
    assert feature_map.WORTH > 300
