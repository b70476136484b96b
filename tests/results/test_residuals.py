"""Residuals of linear models with normal populations have closed forms."""

from typing import Any

import numpy as np
import pymc as pm
import pytest
import xarray as xr
from one_input import one_input, posterior_of

import prbayes as prb

ERROR, MU, SIGMA = 0.4, 1.2, 0.5
DRAWS = 4000


def line(x: Any) -> Any:
    return np.stack([2 * x, -x], -1)


def double(x: Any) -> Any:
    return 2 * x


def at_truth(model: pm.Model, draws: int = 2) -> xr.DataTree:
    """Return residuals of a posterior of the true hyperparameters alone."""
    truth = posterior_of(mu=np.full((1, draws), MU), sigma=np.full((1, draws), SIGMA))
    return prb.residuals(truth, model=model, n_draws=DRAWS)


def build(observed: Any, response: Any = line, **options: Any) -> pm.Model:
    metric = prb.LogLikelihood(**{"error": ERROR} | options)
    return one_input(observed, metric, response=response, mu=(1, 0.5), sigma=0.5)


def data(n: int = 9) -> Any:
    rng = np.random.default_rng(1)
    return line(rng.normal(MU, SIGMA, n)) + rng.normal(0, ERROR, (n, 2))


def inverse_root(matrix: Any) -> Any:
    values, vectors = np.linalg.eigh(matrix)
    return vectors @ np.diag(values**-0.5) @ vectors.T


def test_residuals_of_two_outputs_are_whitened_together() -> None:
    y = data()
    y[3, 1] = np.nan
    tree = at_truth(build(y), DRAWS)
    slope = np.array([2.0, -1.0])
    both = np.isfinite(y).all(axis=1)
    covariance = SIGMA**2 * np.outer(slope, slope) + ERROR**2 * np.eye(2)
    expected = (y[both] - slope * MU) @ inverse_root(covariance)
    np.testing.assert_allclose(tree["y"]["CWRES"].values[both], expected, atol=0.15)
    alone = (y[3, 0] - 2 * MU) / np.hypot(2 * SIGMA, ERROR)
    assert tree["y"]["CWRES"].values[3, 0] == pytest.approx(alone, abs=0.1)
    assert np.isnan(tree["y"]["CWRES"].values[3, 1])
    # The mean input of a specimen given its readings, by conjugacy.
    precision = 1 / SIGMA**2 + slope @ slope / ERROR**2
    eta = (y[both] - slope * MU) @ slope / ERROR**2 / precision
    np.testing.assert_allclose(tree["y"]["eta"].values[both, 0], eta, atol=0.03)
    own = slope * (MU + eta[:, None])
    np.testing.assert_allclose(tree["y"]["IPRED"].values[both], own, atol=0.08)
    np.testing.assert_allclose(tree["y"]["IWRES"].values[both], (y[both] - own) / ERROR, atol=0.25)
    shown = np.broadcast_to(slope * MU, own.shape)
    np.testing.assert_allclose(tree["y"]["PRED"].values[both], shown, atol=0.04)


@pytest.mark.long
def test_simulators_with_common_specimens_are_whitened_together() -> None:
    y = data()
    labels = [f"s{i}" for i in range(len(y))]
    given: dict[str, Any] = {"metric": prb.LogLikelihood(error=ERROR), "specimens": labels}
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1, 0.5), pm.HalfNormal("sigma", 0.5))
        prb.Simulator("a", double, x, observed=y[:, 0], **given)
        prb.Simulator("b", np.negative, x, observed=y[:, 1], **given)
    tree = at_truth(model, DRAWS)
    together = at_truth(build(y), DRAWS)["y"]["CWRES"].values
    for k, name in enumerate("ab"):
        np.testing.assert_allclose(tree[name]["CWRES"].values, together[:, k], atol=0.15)
    frame = tree.to_dataframe()
    assert frame["simulator"].tolist() == ["a"] * 9 + ["b"] * 9
    assert frame["specimen"].tolist() == labels * 2
    assert set(frame.columns) >= {"DV", "PRED", "IPRED", "IWRES", "CWRES"}


@pytest.mark.long
def test_exact_and_biased_readings() -> None:
    y = data()[:, 0]
    exact = at_truth(build(y, double, error=None), DRAWS)["y"]
    np.testing.assert_allclose(exact["IPRED"], y, atol=0.01)
    assert np.isnan(exact["IWRES"]).all()
    np.testing.assert_allclose(exact["CWRES"], (y - 2 * MU) / (2 * SIGMA), atol=0.1)
    biased = at_truth(build(y + 0.7, double, bias=0.7), DRAWS)["y"]
    expected = (y - 2 * MU) / np.hypot(2 * SIGMA, ERROR)
    np.testing.assert_allclose(biased["CWRES"], expected, atol=0.1)


@pytest.mark.long
def test_logarithms_and_censored_readings() -> None:
    rng = np.random.default_rng(3)
    y = np.exp(rng.normal(0.2, 0.3, 12)) + rng.normal(0, 0.05, 12)
    limit = np.quantile(y, 0.2)
    y = np.maximum(y, limit)
    metric = prb.LogLikelihood(error=0.05, censored=(limit, None))
    with pm.Model() as model:
        x = pm.LogNormal.dist(pm.Normal("mu", 0, 0.5), pm.HalfNormal("sigma", 0.5))
        prb.Simulator("y", lambda x: x, x, metric=metric, observed=y)
    tree = prb.residuals(prb.minimize(model, starts=0, progressbar=False))
    is_read = y > limit
    np.testing.assert_array_equal(np.isnan(tree["y"]["CWRES"]), ~is_read)
    eta = tree["y"]["eta"].values[:, 0]
    ratio = np.log(tree["y"]["IPRED"] / tree["y"]["PRED"]).values
    np.testing.assert_allclose(eta[is_read], ratio[is_read], atol=0.02)
    assert len(tree.to_dataframe()) == is_read.sum()
    assert "CWRES of y" in repr(tree)
    assert "DataTree" in repr(tree["y"])


def test_metrics_of_distributions_have_no_residuals() -> None:
    model = one_input(data()[:, 0], prb.AreaMetric(), response=double, mu=(1, 0.5), sd=0.5)
    with pytest.raises(TypeError, match=r"prb\.residuals: got a model whose metrics"):
        prb.residuals(posterior_of(mu=np.ones((1, 4))), model=model)
