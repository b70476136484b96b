"""Responses of the calibrated population: what is drawn and computed, and whose specimens."""

from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm
import pytest
import xarray as xr
from first_use import first_use
from scipy.special import ndtri

import prbayes as prb
from prbayes.model.random_variable import nodes
from prbayes.propagation.base import DesignError
from prbayes.response.failures import ResponseError

OBSERVED = np.random.default_rng(1).normal(1.0, 0.5, 40)
MEANS = np.array([[0.8, 1.0, 1.1], [0.9, 1.0, 1.2]])  # of two chains with three draws
SDS = np.full((2, 3), 0.5)
LEVELS = np.array([0.05, 0.25, 0.5, 0.75, 0.95])


def same(x: Any) -> Any:
    return x


class Counted:
    """A response that counts its values."""

    def __init__(self) -> None:
        self.count = 0

    def __call__(self, x: Any) -> Any:
        self.count += x.size
        return np.exp(x)


def tree(**values: Any) -> xr.DataTree:
    """A posterior as any sampler gives it."""
    arrays = {
        n: (["chain", "draw", *(f"{n}_{i}" for i in range(np.ndim(v) - 2))], v)
        for n, v in values.items()
    }
    return xr.DataTree.from_dict({"posterior": xr.Dataset(arrays)})


POSTERIOR = tree(mu=MEANS, sigma=SDS)


def build(propagation: Any = None, **keywords: Any) -> tuple[pm.Model, Any]:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1, 1), pm.HalfNormal("sigma", 1))
        prb.Simulator(
            "y", keywords.pop("response", same), x, metric=prb.KullbackLeibler(), observed=OBSERVED,
            propagation=propagation or prb.Reweighted(512), **keywords,
        )  # fmt: skip
    return model, x


@cache
def plain() -> tuple[pm.Model, Any]:
    return build()


@cache
def optimum() -> prb.Optimum:
    return prb.minimize(plain()[0])


# One population per draw


@pytest.mark.parametrize("stored", [True, False])
def test_each_draw_is_a_population_of_its_own(stored: bool) -> None:
    model, x = plain()
    found = prb.predict(
        POSTERIOR, same, x, model=model, n_samples=400, stored=stored, random_seed=1
    )
    assert found.dims == ("chain", "draw", "sample")
    assert found.shape == (2, 3, 400)
    assert found.name == "same"
    exact = MEANS[..., None] + 0.5 * ndtri(LEVELS)
    # Points that cut the population into nearly equal parts: far better than 400 random ones
    # (0.05).
    np.testing.assert_allclose(
        np.moveaxis(np.quantile(found, LEVELS, axis=-1), 0, -1), exact, atol=0.02
    )
    np.testing.assert_allclose(found.std("sample"), 0.5, atol=0.02)


def test_an_optimum_is_one_population() -> None:
    _, x = plain()
    found = prb.predict(optimum(), same, x, random_seed=1)
    assert found.shape == (1, 1, 500)
    assert found.mean() == pytest.approx(optimum().point["mu"], abs=0.02)


def test_samples_are_in_random_order() -> None:
    model, x = plain()
    for stored in (True, False):
        found = prb.predict(
            POSTERIOR, same, x, model=model, n_samples=400, stored=stored, random_seed=1
        ).values
        first, second = (
            found[..., :-1] - found.mean(-1, keepdims=True),
            found[..., 1:] - found.mean(-1, keepdims=True),
        )
        correlation = (first * second).mean(axis=-1) / 0.25
        # The standard error of each is 1 / sqrt(400) = .05.
        assert np.abs(correlation).max() < 0.2


def test_draws_are_thinned_evenly_and_keep_their_coordinates() -> None:
    model, x = plain()
    many = tree(mu=np.tile(np.linspace(0.5, 1.5, 101), (2, 1)), sigma=np.full((2, 101), 0.5))
    many = xr.DataTree.from_dict(
        {"posterior": many["posterior"].to_dataset().assign_coords(draw=np.arange(101) * 10)}
    )
    found = prb.predict(many, same, x, model=model, n_draws=10, n_samples=200, random_seed=1)
    assert found.draw.values.tolist() == [0, 250, 500, 750, 1000]
    np.testing.assert_allclose(found.mean("sample")[0], [0.5, 0.75, 1.0, 1.25, 1.5], atol=0.05)
    assert prb.predict(many, same, x, model=model, n_draws=1, n_samples=9).shape == (2, 1, 9)


@pytest.mark.slow
def test_a_posterior_of_stock_pymc_serves() -> None:
    model, x = plain()
    prb.refine(model)
    idata = pm.sample(
        200, tune=200, chains=2, cores=1, model=model, random_seed=1, progressbar=False, quiet=True,
        compute_convergence_checks=False,
    )  # fmt: skip
    found = prb.predict(idata, same, x, model=model, random_seed=1)
    assert found.shape == (2, 200, 500)
    assert found.mean() == pytest.approx(float(idata.posterior["mu"].mean()), abs=0.01)
    with pytest.raises(ValueError, match="the very data of the calibration"):
        prb.area_test(OBSERVED, found)


# What is computed


def test_the_simulators_own_response_is_not_computed_again() -> None:
    response = Counted()
    model, x = build(response=response)
    first_use(model)
    before = response.count
    found = prb.predict(POSTERIOR, response, x, model=model, random_seed=1)
    assert response.count == before
    assert found.attrs["responses"] == 0
    assert found.attrs["source"] == "stored responses of y"
    assert found.name == "Counted"


def test_another_response_is_computed_once_for_each_design_point() -> None:
    model, x = plain()
    response = Counted()
    found = prb.predict(POSTERIOR, response, x, model=model, n_samples=2000, random_seed=1)
    assert found.attrs["responses"] == 512
    assert response.count == 512 + 1  # one by itself, to see that none depends on others
    assert found.attrs["source"] == "design points of y"
    np.testing.assert_allclose(np.median(np.log(found), axis=-1), MEANS, atol=0.01)


def test_what_was_computed_for_one_prediction_serves_the_next() -> None:
    model, x = build()
    response = Counted()
    one = prb.predict(POSTERIOR, response, x, model=model, random_seed=1)
    two = prb.predict(prb.minimize(model, refine=False), response, x, n_samples=100, random_seed=2)
    assert response.count == 512 + 1
    assert (one.attrs["responses"], two.attrs["responses"]) == (512, 0)
    assert two.attrs["source"] == "stored responses of y"
    bound = nodes(model)[model["y"]].bound
    bound.add([np.array([0.9, 1.1]), np.array([0.5, 0.5])], 100)
    after = prb.predict(POSTERIOR, response, x, model=model, random_seed=1)
    assert response.count == 612 + 2
    np.testing.assert_allclose(np.median(np.log(after), axis=-1), MEANS, atol=0.01)


def test_another_constant_is_another_response() -> None:
    def shifted(x: Any, c: Any) -> Any:
        return x + c

    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1, 1), pm.HalfNormal("sigma", 1))
        prb.Simulator("y", shifted, x, 2.0, metric=prb.AreaMetric(), observed=OBSERVED)
    own, other = (
        prb.predict(POSTERIOR, shifted, x, c, model=model, random_seed=1) for c in (2.0, 3.0)
    )
    assert (own.attrs["responses"], other.attrs["responses"]) == (0, 1024)
    np.testing.assert_allclose(other, own + 1)


def test_without_stored_points_every_specimen_is_computed() -> None:
    model, x = plain()
    response = Counted()
    with ThreadPoolExecutor(2) as pool:
        found = prb.predict(
            POSTERIOR, response, x, model=model, n_samples=100, stored=False, executor=pool
        )
    assert response.count == found.attrs["responses"] == 600
    assert found.attrs["source"] == "new specimens"


def test_a_store_keeps_the_responses(tmp_path: Path) -> None:
    response = Counted()
    for _ in range(2):
        model, x = build()
        prb.predict(
            POSTERIOR, response, x, model=model, store=tmp_path, name="later", random_seed=1
        )
    assert response.count == 512 + 1  # one again, to see that it is the same response
    with pytest.raises(ValueError, match="a function called <lambda>, expected a name"):
        prb.predict(POSTERIOR, lambda x: x, x, model=model, store=tmp_path)


# Inputs


def test_new_distributions_over_the_models_variables() -> None:
    model, _ = plain()
    mu, sigma = model["mu"], model["sigma"]
    found = prb.predict(
        POSTERIOR, same, pm.Normal.dist(2 * mu, sigma / 5), model=model, random_seed=1
    )
    assert found.attrs["source"] == "new specimens"
    np.testing.assert_allclose(found.mean("sample"), 2 * MEANS, atol=0.01)
    np.testing.assert_allclose(found.std("sample"), 0.1, atol=0.005)


def test_distributions_without_inverse_or_that_depend_on_each_other_are_drawn() -> None:
    model, _ = plain()
    with model:
        count = pm.Poisson.dist(10 * model["mu"])
        nested = pm.Normal.dist(pm.Normal.dist(model["mu"], 0.3), 0.4)
    for x, mean, sd in ((count, 10 * MEANS, np.sqrt(10 * MEANS)), (nested, MEANS, 0.5)):
        found = prb.predict(POSTERIOR, same, x, model=model, n_samples=4000, random_seed=1)
        # 4000 random draws: 5 standard errors.
        assert (np.abs(found.mean("sample") - mean) < 5 * sd / np.sqrt(4000)).all()
        np.testing.assert_allclose(
            found.std("sample"), np.broadcast_to(sd, (2, 3)), rtol=5 / np.sqrt(8000)
        )


def test_epistemic_variables_and_vectors() -> None:
    with pm.Model() as model:
        mu, factor = pm.Normal("mu", 0, 1, shape=2), pm.HalfNormal("factor")
        x = pm.MvNormal.dist(mu, np.array([[1.0, 0.5], [0.5, 1.0]]))
        prb.Simulator("y", lambda x: x.sum(axis=-1), x, metric=prb.AreaMetric(), observed=OBSERVED)
    means = np.array([[[0.0, 1.0], [1.0, 2.0]]])
    posterior = tree(mu=means, factor=np.array([[1.0, 3.0]]))

    def scaled(x: Any, factor: Any, shift: Any) -> Any:
        return factor * x[..., 0] + shift

    found = prb.predict(posterior, scaled, x, factor, 5.0, model=model, random_seed=1)
    assert found.attrs["source"] == "new specimens"
    np.testing.assert_allclose(found.mean("sample"), [[5.0, 8.0]], atol=0.03)
    np.testing.assert_allclose(found.std("sample"), [[1.0, 3.0]], rtol=0.03)
    sums = prb.predict(posterior, lambda x: x.sum(axis=-1), x, model=model, random_seed=1)
    np.testing.assert_allclose(sums.std("sample"), np.sqrt(3), rtol=0.1)


# Specimens


@pytest.mark.parametrize("stored", [True, False])
def test_the_same_seed_gives_the_same_specimens_under_every_condition(stored: bool) -> None:
    model, x = plain()

    def conditions(seed: int, **keywords: Any) -> list[xr.DataArray]:
        responses = (same, np.exp, lambda x: x**3)
        return [
            prb.predict(POSTERIOR, f, x, model=model, stored=stored, random_seed=seed, **keywords)
            for f in responses
        ]

    one, exponential, cube = conditions(1)
    np.testing.assert_allclose(exponential, np.exp(one))
    np.testing.assert_allclose(cube, one**3)
    assert len({p.attrs["specimens_id"] for p in (one, exponential, cube)}) == 1
    others = [conditions(2)[0], conditions(1, n_samples=499)[0]]
    assert one.attrs["specimens_id"] not in {p.attrs["specimens_id"] for p in others}


def test_specimens_are_the_same_beside_an_epistemic_variable() -> None:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1, 1), 0.5)
        factor = pm.HalfNormal("factor")
        prb.Simulator(
            "y",
            same,
            x,
            metric=prb.AreaMetric(),
            observed=OBSERVED,
            propagation=prb.Resimulated(64),
        )
    posterior = tree(mu=MEANS, factor=np.full((2, 3), 2.0))
    one = prb.predict(posterior, same, x, model=model, random_seed=1)
    two = prb.predict(posterior, lambda x, f: f * x, x, factor, model=model, random_seed=1)
    np.testing.assert_allclose(two, 2 * one)
    assert one.attrs["specimens_id"] == two.attrs["specimens_id"]


def test_a_seed_gives_the_same_numbers_and_none_gives_others() -> None:
    model, x = plain()
    a, b = (prb.predict(POSTERIOR, same, x, model=model, random_seed=5) for _ in range(2))
    xr.testing.assert_identical(a, b)
    c, d = (prb.predict(POSTERIOR, same, x, model=model, random_seed=None) for _ in range(2))
    assert not np.array_equal(c, d)


def test_designs_of_their_own_are_told_apart() -> None:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1, 1), pm.HalfNormal("sigma", 1))
        for k, response in enumerate((same, np.exp)):
            prb.Simulator(
                f"y{k}",
                response,
                x,
                metric=prb.AreaMetric(),
                observed=OBSERVED,
                propagation=prb.Reweighted(256, random_seed=k),
            )
    first, second = (
        prb.predict(POSTERIOR, f, x, model=model, random_seed=1) for f in (same, np.exp)
    )
    assert (first.attrs["source"], second.attrs["source"]) == (
        "stored responses of y0",
        "stored responses of y1",
    )
    assert first.attrs["specimens_id"] != second.attrs["specimens_id"]


def test_the_calibrations_specimens_and_data_are_noted_and_saved(tmp_path: Path) -> None:
    model, x = build(specimens=np.arange(40.0))
    found = prb.predict(POSTERIOR, same, x, model=model, random_seed=1)
    assert found.attrs["calibration_specimens"][:3] == ["0", "1", "2"]
    found.to_netcdf(tmp_path / "predicted.nc")
    xr.testing.assert_equal(xr.load_dataarray(tmp_path / "predicted.nc"), found)
    with pytest.raises(ValueError, match="2 specimens of the calibration, such as '3'"):
        prb.area_test(
            [0.1, 0.2, 0.3], xr.load_dataarray(tmp_path / "predicted.nc"), specimens=[3, 7, 90]
        )


# Failures and refusals


def test_failed_specimens_stay_and_nan_is_counted(caplog: pytest.LogCaptureFixture) -> None:
    model, x = plain()

    def fragile(x: Any) -> Any:
        return np.where(x > 1.5, np.inf, np.where(x < 0.2, np.nan, x))

    given: dict[str, Any] = {"model": model, "random_seed": 1}
    found = prb.predict(POSTERIOR, fragile, x, max_lost=0.5, **given)
    assert np.isinf(found).any()
    assert found.attrs["nan"] == int(np.isnan(found).sum()) > 0
    share = found.attrs["nan"] / found.size
    assert share > 0.05
    for stored in (True, False):
        with pytest.raises(DesignError, match=r"fragile: lost mass: got \d+\.\d% NaN .* = 5\.0%"):
            prb.predict(POSTERIOR, fragile, x, stored=stored, **given)
    assert f"{found.attrs['nan']} of {found.size} predicted responses are NaN" in caplog.text
    with pytest.raises(ResponseError, match="got NaN at all 3000 specimens"):
        prb.predict(POSTERIOR, lambda x: x * np.nan, x, model=model)


def test_a_design_that_does_not_reach_the_populations_is_refused() -> None:
    model, x = plain()
    far = tree(mu=np.full((1, 3), 9.0), sigma=np.full((1, 3), 0.01))
    with pytest.raises(
        DesignError, match=r"y: got a weight effective sample size of .*stored=False"
    ):
        prb.predict(far, same, x, model=model)
    assert prb.predict(far, same, x, model=model, stored=False).mean() == pytest.approx(
        9.0, abs=0.01
    )


def test_refusals() -> None:
    model, x = plain()
    with pytest.raises(TypeError, match="got dict, expected an Optimum"):
        prb.predict({"mu": 1.0}, same, x, model=model)  # type: ignore[arg-type]
    with pytest.raises(KeyError, match=r"a result without \['sigma'\]"):
        prb.predict(tree(mu=MEANS), same, x, model=model)
    with pytest.raises(TypeError, match="no model on the context"):
        prb.predict(POSTERIOR, same, x)
    with pytest.raises(TypeError, match="response: got TensorVariable"):
        prb.predict(POSTERIOR, x, same, model=model)
    with pytest.raises(ValueError, match="none of them aleatory"):
        prb.predict(POSTERIOR, same, 1.0, model=model)
    with pytest.raises(ResponseError, match="the response raised ZeroDivisionError"):
        prb.predict(POSTERIOR, lambda x: 1 // 0, x, model=model)
    for keywords, match in (
        ({"n_samples": 1}, "n_samples: got 1"),
        ({"n_draws": 0}, "n_draws: got 0"),
    ):
        with pytest.raises(ValueError, match=match):
            prb.predict(POSTERIOR, same, x, model=model, **keywords)


@pytest.mark.parametrize("workers", [0, 2])
def test_names_of_a_function_of_one_specimen_are_kept(workers: int) -> None:
    """In another order of columns a test would reject a true model, and nobody would know why."""

    def one(x: float) -> dict[str, float]:
        found = {"high": x + 5, "low": x}
        # A mapping has no order.
        return found if x > 0 else dict(reversed(found.items()))

    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
        prb.Simulator("y", lambda x: x, x, metric=prb.AreaMetric(), observed=np.arange(-2.0, 3.0))
    optimum = prb.minimize(model, progressbar=False)
    with ThreadPoolExecutor(2) as pool:
        executor = pool if workers else None
        response = prb.scalar(one)
        later = prb.predict(optimum, response, x, model=model, executor=executor, random_seed=1)
    assert sorted(later["output"].values) == ["high", "low"]
    np.testing.assert_allclose(later.sel(output="high") - later.sel(output="low"), 5)


def test_other_keys_for_other_specimens_are_refused() -> None:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
        prb.Simulator("y", lambda x: x, x, metric=prb.AreaMetric(), observed=np.arange(-2.0, 3.0))
    optimum = prb.minimize(model, progressbar=False)
    response = prb.scalar(lambda x: {"a": x, "b": x} if x > 0 else {"a": x, "c": x})
    with pytest.raises(prb.response.ResponseError, match=r"keys \['a', '[bc]'\]"):
        prb.predict(optimum, response, x, model=model, random_seed=1)
