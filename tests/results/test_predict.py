"""Responses of the calibrated population: what is drawn and computed, and for which specimens."""

from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm
import pytest
import xarray as xr
from first_use import first_use
from one_input import one_input, posterior_of
from scipy.special import ndtri

import prbayes as prb
from prbayes._finding import from_json
from prbayes.model.random_variable import nodes
from prbayes.propagation.base import DesignError
from prbayes.response import variables
from prbayes.response.failures import ResponseError
from prbayes.results.predict import width_of_epsilon

OBSERVED = np.random.default_rng(1).normal(1.0, 0.5, 40)
MEANS = np.array([[0.8, 1.0, 1.1], [0.9, 1.0, 1.2]])  # of two chains with three draws
LEVELS = np.array([0.05, 0.25, 0.5, 0.75, 0.95])
AREA = prb.AreaMetric()


def identity(x: Any) -> Any:
    return x


class Counted:
    """A response that counts its values."""

    def __init__(self) -> None:
        self.count = 0

    def __call__(self, x: Any) -> Any:
        self.count += x.size
        return np.exp(x)


POSTERIOR = posterior_of(mu=MEANS, sigma=np.full((2, 3), 0.5))


def build(response: Any = identity, **keywords: Any) -> tuple[pm.Model, Any]:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1, 1), pm.HalfNormal("sigma", 1))
        settings = {"propagation": prb.Reweighted(512), "observed": OBSERVED, **keywords}
        prb.Simulator("y", response, x, metric=prb.KullbackLeibler(), **settings)
    return model, x


@cache
def plain() -> tuple[pm.Model, Any]:
    return build()


def predict(response: Any, posterior: Any = POSTERIOR, **keywords: Any) -> xr.DataArray:
    """Predict with the plain model."""
    model, x = plain()
    return prb.predict(posterior, response, x, model=model, **{"random_seed": 1, **keywords})


# -- one population per draw


@pytest.mark.parametrize("stored", [True, False])
def test_each_draw_is_a_population(stored: bool) -> None:
    y = predict(identity, n_samples=400, stored=stored)
    assert y.dims == ("chain", "draw", "sample")
    assert y.shape == (2, 3, 400)
    assert y.name == "identity"
    exact = MEANS[..., None] + 0.5 * ndtri(LEVELS)
    # Points that cut the population into nearly equal parts: far better than 400 random ones (.05).
    quantiles = np.moveaxis(np.quantile(y, LEVELS, axis=-1), 0, -1)
    np.testing.assert_allclose(quantiles, exact, atol=0.02)
    np.testing.assert_allclose(y.std("sample"), 0.5, atol=0.02)
    # They are in random order: the standard error of each correlation is 1 / sqrt(400) = .05.
    residuals = y.values - y.values.mean(axis=-1, keepdims=True)
    correlation = (residuals[..., :-1] * residuals[..., 1:]).mean(axis=-1) / 0.25
    assert np.abs(correlation).max() < 0.2


def test_draws_are_thinned_evenly_and_keep_their_coordinates() -> None:
    many = posterior_of(
        mu=np.tile(np.linspace(0.5, 1.5, 101), (2, 1)), sigma=np.full((2, 101), 0.5)
    )
    many["posterior"] = many["posterior"].to_dataset().assign_coords(draw=np.arange(101) * 10)
    y = predict(identity, many, n_draws=10, n_samples=200)
    assert y.draw.values.tolist() == [0, 250, 500, 750, 1000]
    np.testing.assert_allclose(y.mean("sample")[0], [0.5, 0.75, 1.0, 1.25, 1.5], atol=0.05)
    assert predict(identity, many, n_draws=1, n_samples=9).shape == (2, 1, 9)
    # An optimum is one population.
    best = prb.minimize(plain()[0], starts=0)
    y = prb.predict(best, identity, plain()[1], random_seed=1)
    assert y.shape == (1, 1, 500)
    assert y.mean() == pytest.approx(best.point["mu"], abs=0.02)


# -- what is computed


def test_another_response_is_computed_once_for_each_design_point() -> None:
    own = Counted()
    model, x = build(own)
    first_use(model)
    count = own.count + 3  # three again, as variables that it reads might have changed
    for _ in range(2):
        y = prb.predict(POSTERIOR, own, x, model=model, random_seed=1)
        assert (own.count, y.attrs["responses"], y.name) == (count, 0, "Counted")
    assert y.attrs["source"] == "stored responses of y"
    response = Counted()
    first = prb.predict(POSTERIOR, response, x, model=model, n_samples=2000, random_seed=1)
    assert first.attrs["responses"] == 512
    # Three by themselves, and 33 in another order, as they might depend on others.
    assert response.count == 512 + 3 + 33
    assert first.attrs["source"] == "design points of y"
    np.testing.assert_allclose(np.median(np.log(first), axis=-1), MEANS, atol=0.01)
    best = prb.minimize(model, refine=False, starts=0)
    second = prb.predict(best, response, x, n_samples=100, random_seed=2)
    assert response.count == 512 + 3 + 33 + 3  # as files might have changed
    assert second.attrs["responses"] == 0
    assert second.attrs["source"] == "stored responses of y"
    bound = nodes(model)[model["y"]].bound
    bound.add([np.array([0.9, 1.1]), np.array([0.5, 0.5])], 100)
    third = prb.predict(POSTERIOR, response, x, model=model, random_seed=1)
    assert response.count == 612 + 3 + 33 + 3
    np.testing.assert_allclose(np.median(np.log(third), axis=-1), MEANS, atol=0.01)


def test_another_constant_is_another_response() -> None:
    def shifted(x: Any, c: Any) -> Any:
        return x + c

    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1, 1), pm.HalfNormal("sigma", 1))
        prb.Simulator("y", shifted, x, 2.0, metric=AREA, observed=OBSERVED)
    two, three = (
        prb.predict(POSTERIOR, shifted, x, c, model=model, random_seed=1) for c in (2.0, 3.0)
    )
    assert (two.attrs["responses"], three.attrs["responses"]) == (0, 1024)
    np.testing.assert_allclose(three, two + 1)


def test_a_store_keeps_the_responses(tmp_path: Path) -> None:
    response = Counted()
    for _ in range(2):
        model, x = build()
        prb.predict(POSTERIOR, response, x, model=model, store=tmp_path, name="later")
        variables._records.clear()  # as in another process
    # Some at random at first, and three again to see that it is the same response.
    assert response.count == 512 + 13 + 3
    # Without stored points every specimen is computed.
    response = Counted()
    with ThreadPoolExecutor(2) as pool:
        y = predict(response, n_samples=100, stored=False, executor=pool)
    assert y.attrs["responses"] == 600
    assert response.count == 600 + 14
    assert y.attrs["source"] == "new specimens"
    with pytest.raises(ValueError, match="a function called <lambda>, expected a name"):
        prb.predict(POSTERIOR, lambda x: x, x, model=model, store=tmp_path)


# -- inputs


def test_other_distributions_over_the_models_variables() -> None:
    model, _ = plain()
    mu, sigma = model["mu"], model["sigma"]
    with model:  # the last two have no inverse distribution function
        cases = {
            pm.Normal.dist(2 * mu, sigma / 5): (2 * MEANS, 0.1),
            pm.Poisson.dist(10 * mu): (10 * MEANS, np.sqrt(10 * MEANS)),
            pm.Normal.dist(pm.Normal.dist(mu, 0.3), 0.4): (MEANS, 0.5),
        }
    for x, (mean, sd) in cases.items():
        y = prb.predict(POSTERIOR, identity, x, model=model, n_samples=4000, random_seed=1)
        assert y.attrs["source"] == "new specimens"
        # 4000 random draws: 5 standard errors.
        assert (np.abs(y.mean("sample") - mean) < 5 * sd / np.sqrt(4000)).all()
        sds = np.broadcast_to(sd, (2, 3))
        np.testing.assert_allclose(y.std("sample"), sds, rtol=5 / np.sqrt(8000))


@pytest.mark.long
def test_epistemic_variables_and_vectors() -> None:
    with pm.Model() as model:
        mu, factor = pm.Normal("mu", 0, 1, shape=2), pm.HalfNormal("factor")
        x = pm.MvNormal.dist(mu, np.array([[1.0, 0.5], [0.5, 1.0]]))
        prb.Simulator("y", lambda x: x.sum(axis=-1), x, metric=AREA, observed=OBSERVED)
    means = np.array([[[0.0, 1.0], [1.0, 2.0]]])
    posterior = posterior_of(mu=means, factor=np.array([[1.0, 3.0]]))
    settings = {"model": model, "random_seed": 1}

    def scaled(x: Any, factor: Any, shift: Any) -> Any:
        return factor * x[..., 0] + shift

    y = prb.predict(posterior, scaled, x, factor, 5.0, **settings)
    assert y.attrs["source"] == "new specimens"
    np.testing.assert_allclose(y.mean("sample"), [[5.0, 8.0]], atol=0.03)
    np.testing.assert_allclose(y.std("sample"), [[1.0, 3.0]], rtol=0.03)
    sums = prb.predict(posterior, lambda x: x.sum(axis=-1), x, **settings)
    np.testing.assert_allclose(sums.std("sample"), np.sqrt(3), rtol=0.1)
    # Specimens are the same beside an epistemic variable.
    plain = prb.predict(posterior, lambda x: x[..., 0], x, stored=False, **settings)
    np.testing.assert_allclose(y, plain * [[[1.0], [3.0]]] + 5)
    assert y.attrs["specimens_id"] == plain.attrs["specimens_id"]


# -- specimens


@pytest.mark.parametrize("stored", [True, False])
def test_the_seed_determines_the_specimens(stored: bool) -> None:
    y, again, cube = (predict(f, stored=stored) for f in (identity, identity, lambda x: x**3))
    xr.testing.assert_identical(y, again)
    np.testing.assert_allclose(cube, y**3)
    assert y.attrs["specimens_id"] == cube.attrs["specimens_id"]
    changes: list[dict[str, Any]] = [{"random_seed": 2}, {"n_samples": 499}, {"random_seed": None}]
    for change in changes:
        other = predict(identity, stored=stored, **change)
        assert other.attrs["specimens_id"] != y.attrs["specimens_id"]


def test_specimens_and_data_of_the_calibration_are_saved(tmp_path: Path) -> None:
    model, x = build(specimens=np.arange(40.0))
    y = prb.predict(POSTERIOR, identity, x, model=model, random_seed=1)
    assert y.attrs["calibration_specimens"][:3] == ["0", "1", "2"]
    y.to_netcdf(tmp_path / "predicted.nc")
    loaded = xr.load_dataarray(tmp_path / "predicted.nc")
    assert loaded.equals(y)
    with pytest.raises(ValueError, match="2 specimens of the calibration, such as '3'"):
        prb.area_test([0.1, 0.2, 0.3], loaded, specimens=[3, 7, 90])


# -- failures and refusals


def test_failed_specimens_stay_and_nan_is_counted(caplog: pytest.LogCaptureFixture) -> None:
    def fragile(x: Any) -> Any:
        return np.where(x > 1.5, np.inf, np.where(x < 0.2, np.nan, x))

    y = predict(fragile, max_lost=0.5)
    assert np.isinf(y).any()
    missing = int(np.isnan(y).sum())
    assert y.attrs["nan"] == missing > 0.05 * y.size
    assert f"{missing} of {y.size} predicted responses are NaN" in caplog.text
    for stored in (True, False):
        with pytest.raises(DesignError, match=r"fragile: lost mass: got \d+\.\d% NaN .* = 5\.0%"):
            predict(fragile, stored=stored)
    with pytest.raises(ResponseError, match="got NaN at all 3000 specimens"):
        predict(lambda x: x * np.nan)


def test_a_design_that_does_not_cover_the_populations_is_refused() -> None:
    far = posterior_of(mu=np.full((1, 3), 9.0), sigma=np.full((1, 3), 0.01))
    with pytest.raises(DesignError, match=r"y: got a weight effective sample .*stored=False"):
        predict(identity, far)
    assert predict(identity, far, stored=False).mean() == pytest.approx(9.0, abs=0.01)


@pytest.mark.parametrize(
    ("arguments", "keywords", "error", "message"),
    [
        (({"mu": 1.0}, identity), {}, TypeError, "got dict, expected an Optimum"),
        ((posterior_of(mu=MEANS), identity), {}, KeyError, r"a result without \['sigma'\]"),
        ((POSTERIOR, identity), {"model": None}, TypeError, "no model on the context"),
        ((POSTERIOR, lambda x: 1 // 0), {}, ResponseError, "raised ZeroDivisionError"),
        ((POSTERIOR, prb.scalar(lambda x: 1 // 0)), {}, ResponseError, r"or return NaN \(.*there$"),
    ],
)
def test_invalid_arguments(
    arguments: Any, keywords: dict[str, Any], error: type[Exception], message: str
) -> None:
    model, x = plain()
    with pytest.raises(error, match=message):
        prb.predict(*arguments, x, **{"model": model, **keywords})
    with pytest.raises(ValueError, match="none of them aleatory"):
        prb.predict(POSTERIOR, identity, 1.0, model=model)


@pytest.mark.parametrize("workers", [0, 2])
def test_names_of_a_function_of_one_specimen_are_kept(workers: int) -> None:
    """A mapping has no order: with other columns a test would reject a true model."""

    def named(x: float) -> dict[str, float]:
        outputs = {"high": x + 5, "low": x}
        return outputs if x > 0 else dict(reversed(outputs.items()))

    with ThreadPoolExecutor(2) as pool:
        executor = pool if workers else None
        y = predict(prb.scalar(named), stored=False, n_samples=50, executor=executor)
    assert sorted(y["output"].values) == ["high", "low"]
    np.testing.assert_allclose(y.sel(output="high") - y.sel(output="low"), 5)
    other_keys = prb.scalar(lambda x: {"a": x, "b": x} if x > 1 else {"a": x, "c": x})
    with pytest.raises(ResponseError, match=r"keys \['a', '[bc]'\]"):
        predict(other_keys)


def test_draws_as_wide_as_epsilon_are_named_by_any_sampler() -> None:
    by_distance, by_likelihood, by_specimen = (
        one_input(np.arange(9.0), metric, sd=1.0)
        for metric in (
            prb.KullbackLeibler(),
            prb.LogLikelihood(density=prb.GaussianKDE()),
            prb.LogLikelihood(),
        )
    )

    def codes(model: pm.Model | None, **attrs: Any) -> list[str]:
        tree = posterior_of(mu=np.zeros((2, 9)))
        tree["posterior"].attrs.update(attrs)
        return [finding.code for finding in width_of_epsilon(tree, model)]

    assert codes(by_distance) == codes(by_distance, adjustment="none") == ["width-of-epsilon"]
    assert codes(by_distance, adjustment="estimate") == codes(by_distance, converged=1.0) == []
    assert codes(by_likelihood) == codes(by_specimen) == codes(None) == []


def test_labels_of_the_response_are_those_of_the_prediction() -> None:
    def labelled(x: Any) -> xr.DataArray:
        dims = [*(f"dim_{i}" for i in range(np.ndim(x))), "out"]
        values = np.stack([np.exp(x) + 20, x], axis=-1)
        return xr.DataArray(values, dims=dims, coords={"out": ["q", "p"]})

    y = predict(labelled, n_samples=100)
    assert y.dims == ("chain", "draw", "sample", "out")
    assert y.sel(out="p").mean() == pytest.approx(1.0, abs=0.2)
    data = np.random.default_rng(0).normal(1, 0.5, 10)
    data = np.stack([data, np.exp(data) + 20], axis=1)
    fresh = xr.DataArray(data, dims=["specimen", "out"], coords={"out": ["p", "q"]})
    swapped = fresh.assign_coords(out=["q", "p"])
    assert prb.area_test(fresh, y, random_seed=1).p_value > 0.01
    assert prb.area_test(swapped, y, random_seed=1).p_value < 0.01
    with pytest.raises(ValueError, match=r"got the outputs \['p', 'r'\], expected \['q', 'p'\]"):
        prb.area_test(fresh.assign_coords(out=["p", "r"]), y)
    # The simulator has the order of the observed outputs.
    model, x = build()
    with model:
        y = prb.Simulator("z", labelled, x, observed=fresh, metric=prb.Joint(AREA))
    first_use(model)
    node = next(node for node in nodes(model).values() if node.name == "z")
    stored = node.bound.first_responses
    np.testing.assert_allclose(stored[:, 1], np.exp(stored[:, 0]) + 20)


def test_a_prediction_with_failures_shows_moments_of_the_others() -> None:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 1), 1.0)
        prb.Simulator("y", lambda x: x + 1, x, metric=prb.AreaMetric(), observed=[0.0, 1.0, 2.5])

    def breaks(x):  # type: ignore[no-untyped-def]
        return np.where(x < 2, x, np.inf)

    shown = str(prb.predict(prb.minimize(model, starts=0), breaks, x, model=model))
    assert "each of 1 population," in shown
    assert "of the specimens fail (+inf)" in shown
    assert "inf  nan" not in shown


def test_wide_populations_have_the_response_of_runs_far_from_the_data() -> None:
    observed = np.square(np.random.default_rng(0).normal(10, 1, 3))
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 10, 3), pm.HalfNormal("sigma", 30))
        prb.Simulator("y", np.square, x, observed=observed)
    for sigma, codes in ((15.0, []), (60.0, ["beyond-runs"])):
        result = posterior_of(mu=np.full((1, 4), 10.0), sigma=np.full((1, 4), sigma))
        predicted, computed = (
            prb.predict(result, np.square, x, model=model, random_seed=1, stored=stored)
            for stored in (True, False)
        )
        assert [f.code for f in from_json(predicted.attrs["findings"])] == codes
        inside = computed.values < 50**2
        # Between the data and runs far from them there are few runs, at places that depend on the
        # last digits. The surface through runs near the data is off by more than 1e6 there.
        np.testing.assert_allclose(
            predicted.values[inside], computed.values[inside], rtol=0.25, atol=3.0
        )


def test_a_response_with_a_pole_at_the_end_of_its_inputs(caplog: pytest.LogCaptureFixture) -> None:
    x = np.random.default_rng(37).beta(2.0, 5.0, 20)

    def odds(x: Any) -> Any:
        return x / (1.0 - x)

    with pm.Model() as model:
        mean, nu = pm.Beta("mean", 1.0, 1.0), pm.LogNormal("nu", 2.0, 1.0)
        population = pm.Beta.dist(mean * nu, (1 - mean) * nu)
        prb.Simulator("y", odds, population, observed=odds(x))
    optimum = prb.minimize(model, progressbar=False)
    # The runs nearest to the end are at an input that is not one itself.
    same = prb.predict(optimum, odds, population, model=model)
    assert float(same.median()) == pytest.approx(np.median(odds(x)), rel=0.3)
    # The interpolant of another response is rough beside the pole, which few specimens show.
    prb.predict(optimum, lambda x: 1.0 / (1.0 - x), population, model=model)
    assert "rough-prediction" in caplog.text
