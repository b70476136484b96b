"""Shares of hyperparameters beside closed forms."""

import numpy as np
import pytest
import xarray as xr
from decisions import doubled, normal, optimum, posterior, same

import prbayes as prb
from prbayes.decision import sensitivity as influence


def test_a_quantile_of_a_normal_population() -> None:
    model, x = normal()
    quantity = prb.decision.Quantile(doubled, x, probability=0.95)
    table = prb.sensitivity(posterior(), quantity, model=model)
    # 2 (mu + 1.645 sigma), of two that are nearly independent.
    mu, sigma = (posterior().posterior[name].values.std() for name in ("mu", "sigma"))
    variances = np.array([mu**2, (1.6449 * sigma) ** 2])
    expected = variances / variances.sum()
    own = table.sel(factor=["mu", "sigma"])
    np.testing.assert_allclose(own["first"], expected, atol=0.03)
    np.testing.assert_allclose(own["total"], expected, atol=0.03)
    assert (own.derivative > own.total - 0.02).all()
    np.testing.assert_allclose(own.derivative, expected, atol=0.06)
    x_only = table.sel(factor="x")
    assert [float(x_only[key]) for key in ("first", "total")] == pytest.approx([1, 1], abs=0.02)
    assert table.attrs["sd"] == pytest.approx(2 * np.hypot(mu, 1.6449 * sigma), rel=0.04)
    assert table.kind.values.tolist() == ["hyperparameter", "hyperparameter", "input"]


def correlated(rho: float, draws: int = 4000) -> xr.DataTree:
    z = np.random.default_rng(0).multivariate_normal([0, 0], [[1, rho], [rho, 1]], (1, draws))
    columns = {"mu": 1 + 0.05 * z[..., 0], "sigma": 0.5 * np.exp(0.05 * z[..., 1])}
    group = xr.Dataset({name: (("chain", "draw"), value) for name, value in columns.items()})
    return xr.DataTree.from_dict({"posterior": group.assign_coords(chain=[0], draw=range(draws))})


def test_hyperparameters_that_depend_on_each_other() -> None:
    model, x = normal()
    quantity = prb.decision.Quantile(same, x, probability=0.9)
    rho = 0.7
    table = prb.sensitivity(correlated(rho), quantity, model=model).sel(factor=["mu", "sigma"])
    # To first order Q = a_1 z_1 + a_2 z_2, of which the closed form is known.
    a = np.array([0.05, 1.2816 * 0.5 * 0.05])
    variance = (a**2).sum() + 2 * rho * a.prod()
    np.testing.assert_allclose(table["first"], (a + rho * a[::-1]) ** 2 / variance, atol=0.03)
    np.testing.assert_allclose(table["total"], a**2 * (1 - rho**2) / variance, atol=0.03)
    np.testing.assert_allclose(table.derivative, table["total"], atol=0.02)


def test_an_optimum_and_its_unit() -> None:
    _, x = normal()
    tables = [
        prb.sensitivity(optimum(), prb.decision.Mean(response, x)) for response in (same, doubled)
    ]
    assert tables[1].attrs["value"] == pytest.approx(2 * tables[0].attrs["value"])
    np.testing.assert_allclose(tables[0]["first"], tables[1]["first"], atol=1e-6)
    assert float(tables[0]["first"].sel(factor="mu")) == pytest.approx(1, abs=0.01)
    assert tables[0].attrs["responses"] == 0
    # A new specimen's variance is s^2 (1 + 1 / N).
    assert tables[0].attrs["scatter"] == pytest.approx(50 / 51, abs=0.005)


def test_errors_fall_with_the_samples_and_seeds_matter() -> None:
    model, x = normal()
    quantity = prb.decision.Exceedance(same, x, limit=2.0)
    few, again, many = [
        prb.sensitivity(posterior(), quantity, model=model, n_samples=n, random_seed=seed)
        for n, seed in ((64, 1), (64, 1), (1024, 2))
    ]
    xr.testing.assert_identical(few, again)
    assert float(many.first_error.sel(factor="mu")) < float(few.first_error.sel(factor="mu"))
    off = np.abs(few - many)[["first", "total"]].sel(factor=["mu", "sigma"])
    for key in ("first", "total"):
        assert (off[key] < 5 * few[f"{key}_error"] + 0.01).all()
    # Whether a specimen is beyond has no derivative.
    assert np.isnan(float(many.derivative.sel(factor="x")))


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_the_step_does_not_matter(factor: float, monkeypatch: pytest.MonkeyPatch) -> None:
    model, x = normal()
    quantity = prb.decision.Quantile(same, x, probability=0.9)
    before = prb.sensitivity(posterior(), quantity, model=model, n_samples=256)
    monkeypatch.setattr(influence, "_WEIGHT_STEP", factor * influence._WEIGHT_STEP)
    after = prb.sensitivity(posterior(), quantity, model=model, n_samples=256)
    own = ["mu", "sigma"]
    np.testing.assert_allclose(
        after.derivative.sel(factor=own), before.derivative.sel(factor=own), atol=0.01
    )
