"""Decisions on one group, a new group, or a value of a covariate: `.dist()` objects of their own."""

from typing import Any

import numpy as np
import pymc as pm
import pytest
import xarray as xr
from scipy.stats import norm

import prbayes as prb
from prbayes.decision import Condition, Mean, Quantile
from prbayes.model.evaluator import Evaluator

SUPPLIERS = ["Adler", "Busch"]


def life(x: Any, load: float) -> Any:
    return load * np.exp(x)


def stress(load: float, x: Any) -> Any:
    return x**2 / load


@pytest.fixture(scope="module")
def model() -> pm.Model:
    """Two suppliers with a mean each, and a covariate."""
    rng = np.random.default_rng(3)
    names = np.repeat(SUPPLIERS, [20, 15])
    hardness = rng.uniform(1, 2, 35)
    x = np.repeat([2.0, 2.6], [20, 15]) + 0.5 * hardness + rng.normal(0, 0.4, 35)
    coords = {"supplier": ("test", names)}
    observed = xr.DataArray(life(x, 2.0), coords=coords, dims="test")
    with pm.Model(coords={"supplier": SUPPLIERS}) as model:
        mu = pm.Normal("mu", 2, 1, dims="supplier")
        slope, sigma = pm.Normal("slope", 0.5, 0.2), pm.HalfNormal("sigma", 1)
        mean = mu[prb.response.group("supplier")] + slope * prb.response.condition(
            "hardness", hardness
        )
        x = pm.Normal.dist(mean, sigma, name="x")
        prb.Simulator("y", life, x, 2.0, observed=observed)
    return model


@pytest.fixture(scope="module")
def result(model: pm.Model) -> Any:
    return prb.sample(500, model=model, random_seed=1, progressbar=False)


def of_supplier(model: pm.Model, place: int, **name: str) -> Any:
    """Return the population of a supplier at the hardness 1.5."""
    return pm.Normal.dist(model["mu"][place] + 1.5 * model["slope"], model["sigma"], **name)


def draws(result: Any, place: int) -> tuple[Any, Any]:
    """Return mean and standard deviation of the same population for each draw."""
    posterior = result["posterior"].to_dataset().stack(of=["chain", "draw"])
    mean = posterior["mu"].values[place] + 1.5 * posterior["slope"].values
    return mean, posterior["sigma"].values


@pytest.mark.parametrize("place", [0, 1])
def test_an_exceedance_is_that_of_the_group(model: pm.Model, result: Any, place: int) -> None:
    mean, sd = draws(result, place)
    x = of_supplier(model, place)
    table = prb.exceedance(result, life, 50.0, x, 2.0, model=model)
    exact = norm.sf((np.log(25) - mean) / sd)
    assert table.attrs["responses"] == 0
    assert abs(float(table.probability) - exact.mean()) < 4 * float(table.error)
    ends = np.quantile(exact, [0.055, 0.945])
    np.testing.assert_allclose([table.lower, table.upper], ends, atol=0.03)


def test_another_response_has_inputs_of_the_same_names(model: pm.Model, result: Any) -> None:
    mean, sd = draws(result, 1)
    x = of_supplier(model, 1, name="x")
    table = prb.exceedance(result, stress, 3.0, 4.0, x, model=model)
    exact = norm.sf((12**0.5 - mean) / sd).mean()
    assert abs(float(table.probability) - exact) < 4 * float(table.error)
    with pytest.raises(TypeError, match="others of the same names"):
        prb.exceedance(result, stress, 3.0, 4.0, of_supplier(model, 1, name="z"), model=model)


def test_a_new_group_has_the_scatter_of_both_levels(model: pm.Model, result: Any) -> None:
    center, spread = model["mu"].mean(), pm.math.sqrt(model["sigma"] ** 2 + 0.09)
    quantity = Quantile(life, pm.Normal.dist(center, spread), 2.0, probability=0.1)
    value = prb.decision.evaluate(result, quantity, model=model)
    posterior = result.posterior
    tenth = posterior["mu"].mean("supplier") - 1.28155 * np.sqrt(posterior["sigma"] ** 2 + 0.09)
    exact = float((2 * np.exp(tenth)).mean())
    assert abs(float(value.estimate) / exact - 1) < 0.03


def test_specimens_of_a_group_inform_about_this_group(model: pm.Model, result: Any) -> None:
    candidates = {
        name: Condition(life, of_supplier(model, place), 2.0)
        for place, name in enumerate(SUPPLIERS)
    }
    quantity = Mean(life, of_supplier(model, 0), 2.0)
    table = prb.plan(result, candidates, k=[50], model=model, quantity=quantity)
    sd = table.sd.sel(k=50)
    for own, other in (SUPPLIERS, SUPPLIERS[::-1]):
        name = f"mu[{own}]"
        assert float(sd.sel(candidate=own, name=name)) < float(sd.sel(candidate=other, name=name))
    quantities = sd.sel(name="quantity")
    assert float(quantities.sel(candidate="Adler")) < 0.9 * float(quantities.sel(candidate="Busch"))


def test_sensitivity_has_the_names_of_the_simulator(model: pm.Model, result: Any) -> None:
    quantity = Mean(life, of_supplier(model, 0), 2.0)
    table = prb.sensitivity(result, quantity, model=model, n_points=256)
    assert table.factor.values.tolist() == ["mu[Adler]", "mu[Busch]", "slope", "sigma", "x"]
    shares = table.total.sel(factor=["mu[Adler]", "mu[Busch]"])
    assert float(shares[0]) > 0.1
    assert abs(float(shares[1])) < 0.02


def test_a_distribution_of_a_group(model: pm.Model, result: Any) -> None:
    mean, _ = draws(result, 0)
    box = prb.decision.p_box(result, life, of_supplier(model, 0), 2.0, model=model)
    median = np.interp(0.5, box["mean"].values, box["y"].values)
    assert abs(median / (2 * np.exp(mean.mean())) - 1) < 0.05


def test_constants_of_the_simulator_stay(model: pm.Model, result: Any) -> None:
    """Another load is another response, which has to name its inputs."""
    with pytest.raises(TypeError, match="without stored responses"):
        prb.exceedance(result, life, 50.0, of_supplier(model, 0), 3.0, model=model)


def test_inputs_that_depend_on_a_group_are_refused(model: pm.Model, result: Any) -> None:
    (x,) = Evaluator.of(model).simulators[0].inputs.aleatory
    with pytest.raises(TypeError, match=r"the .dist\(\) of one of \['Adler', 'Busch'\]"):
        prb.exceedance(result, life, 50.0, x, 2.0, model=model)


METRICS = {"PR": prb.ProbabilityResidual(), "KLD": prb.KullbackLeibler(), "area": prb.AreaMetric()}


@pytest.mark.long
@pytest.mark.parametrize("name", METRICS)
def test_a_group_under_a_metric_has_its_exceedance_and_other_decisions_are_refused(
    name: str,
) -> None:
    rng = np.random.default_rng(3)
    x = np.repeat([2.0, 2.6], [40, 30]) + rng.normal(0, 0.4, 70)
    coords = {"supplier": ("test", np.repeat(SUPPLIERS, [40, 30]))}
    observed = xr.DataArray(life(x, 2.0), coords=coords, dims="test")
    with pm.Model(coords={"supplier": SUPPLIERS}) as model:
        mu, sigma = pm.Normal("mu", 2, 1, dims="supplier"), pm.HalfNormal("sigma", 1)
        x = pm.Normal.dist(mu[prb.response.group("supplier")], sigma, name="x")
        prb.Simulator("y", life, x, 2.0, observed=observed, metric=METRICS[name])
    rng = np.random.default_rng(4)
    values = {"mu": rng.normal([2.0, 2.6], 0.06, (1, 200, 2)), "sigma": rng.normal(0.4, 0.04, 200)}
    values["sigma"] = values["sigma"][None]
    dims = {"mu": ["chain", "draw", "supplier"], "sigma": ["chain", "draw"]}
    posterior = xr.Dataset(
        {key: (dims[key], v) for key, v in values.items()}, {"supplier": SUPPLIERS}
    )
    result = xr.DataTree.from_dict({"posterior": posterior})
    of_group = pm.Normal.dist(mu[1], sigma)
    table = prb.exceedance(result, life, 30.0, of_group, 2.0, model=model, n_points=1000)
    exact = norm.sf((np.log(15) - values["mu"][..., 1]) / values["sigma"]).mean()
    assert abs(float(table.probability) - exact) < 4 * float(table.error)
    population = prb.population(result, of_group, model=model).estimate.sel(quantity="mean")
    assert population.item() == pytest.approx(values["mu"][..., 1].mean(), abs=0.02)
    quantity = Mean(life, of_group, 2.0)
    refused: dict[str, Any] = {
        "evaluate": lambda: prb.decision.evaluate(result, quantity, model=model),
        "sensitivity": lambda: prb.sensitivity(result, quantity, model=model),
        "plan": lambda: prb.plan(
            result, {"more": Condition(life, of_group, 2.0)}, k=[50], model=model
        ),
        "p_box": lambda: prb.decision.p_box(result, life, of_group, 2.0, model=model),
    }
    for call in refused.values():
        with pytest.raises(TypeError, match=r"n_points=1000.*leave metric= out of the simulator"):
            call()


def test_a_covariate_under_a_metric_is_refused_with_what_works() -> None:
    with pm.Model():
        load = prb.response.condition("load", np.linspace(0, 1, 20))
        x = pm.Normal.dist(pm.Normal("a", 0, 1) + load, pm.HalfNormal("s", 1))
        for metric in METRICS.values():
            with pytest.raises(TypeError, match=r"prb.response.group.*leave metric= out"):
                prb.Simulator("y", np.exp, x, observed=np.linspace(1, 2, 20), metric=metric)
