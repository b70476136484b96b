"""Population tables are the closed forms of populations, and their tolerance bounds the classical ones."""

import re
from typing import Any

import numpy as np
import pandas as pd
import pymc as pm
import pytest
import xarray as xr
from one_input import one_input, posterior_of
from scipy import stats

import prbayes as prb
from prbayes.decision.population_quantities import _by_name
from prbayes.model.description import describe
from prbayes.model.evaluator import Evaluator
from prbayes.model.margins import margins
from prbayes.model.random_variable import simulators
from prbayes.response.call import ResponseError

DATA = np.random.default_rng(1).normal(3.0, 0.5, 20)
FRESH: dict[str, Any] = {"metric": prb.AreaMetric(), "propagation": prb.Fresh(50)}


def draws(**values: Any) -> xr.DataTree:
    """Return a posterior of one chain."""
    return posterior_of(**{name: np.asarray(value)[None] for name, value in values.items()})


def normal_model(observed: Any = DATA, **settings: Any) -> pm.Model:
    with pm.Model() as model:
        k = pm.Normal.dist(pm.Normal("mu", 3, 2), pm.HalfNormal("sigma", 1), name="k")
        prb.Simulator("y", np.positive, k, observed=observed, **FRESH | settings)
    return model


def reference_posterior(n: int, seed: int) -> xr.DataTree:
    """Return draws of the reference posterior of a normal population."""
    rng = np.random.default_rng(seed)
    sigma = DATA.std(ddof=1) * np.sqrt((DATA.size - 1) / rng.chisquare(DATA.size - 1, n))
    return draws(mu=rng.normal(DATA.mean(), sigma / np.sqrt(DATA.size)), sigma=sigma)


def test_tolerance_bounds_are_the_classical_ones() -> None:
    size, sd, posterior = DATA.size, DATA.std(ddof=1), reference_posterior(20_000, 2)
    model = normal_model()
    for upper, sign in ((False, -1), (True, 1)):
        table = prb.population(posterior, "k", model=model, upper=upper, n_draws=20_000)
        for basis, share in (("B-basis", 0.9), ("A-basis", 0.99)):
            noncentral = np.sqrt(size) * stats.norm.ppf(share)
            factor = stats.nct.ppf(0.95, size - 1, noncentral) / np.sqrt(size)
            bound = float(table.estimate.sel(name="k", quantity=basis))
            # The standard error of the factor by so many draws is .006 and .010.
            assert bound == pytest.approx(DATA.mean() + sign * factor * sd, abs=0.04 * sd)


def test_numbers_are_those_of_the_distribution_in_each_draw() -> None:
    rng = np.random.default_rng(3)
    mu, sigma = rng.normal(1, 0.1, 300), rng.gamma(40, 0.01, 300)
    with pm.Model() as model:
        k = pm.LogNormal.dist(pm.Normal("mu", 1, 1), pm.HalfNormal("sigma", 1))
        count = pm.Poisson.dist(pm.math.exp(model["mu"]))
        known = pm.StudentT.dist(3.0, mu=0.0, sigma=2.0)
        heavy = pm.Cauchy.dist(0.0, 1.0)
        prb.Simulator(
            "y", lambda k, count, known, heavy: np.log(k) + 0 * (count + known + heavy),
            k, count, known, heavy, observed=DATA, units={"k": "kN/mm", "y": "mm"}, **FRESH,
        )  # fmt: skip
    table = prb.population(draws(mu=mu, sigma=sigma), model=model, prob=0.8, quantiles=[0.25])
    assert table.name.values.tolist() == ["k", "count", "known", "heavy"]
    assert table.unit.values.tolist() == ["kN/mm", "", "", ""]
    exact = {
        "mean": np.exp(mu + sigma**2 / 2),
        "cv": np.sqrt(np.expm1(sigma**2)),
        "25% quantile": np.exp(mu + sigma * stats.norm.ppf(0.25)),
    }
    for quantity, values in exact.items():
        cell = table.sel(name="k", quantity=quantity)
        assert float(cell.estimate) == pytest.approx(values.mean(), rel=1e-9)
        interval = [float(cell.lower), float(cell.upper)]
        np.testing.assert_allclose(interval, np.quantile(values, [0.1, 0.9]), rtol=1e-9)
    # 2000 specimens of each of 300 populations
    counted = table.sel(name="count", quantity=["mean", "sd"]).estimate
    np.testing.assert_allclose(counted, [np.exp(mu).mean(), np.exp(mu / 2).mean()], rtol=0.02)
    of_quantile = float(table.estimate.sel(name="count", quantity="25% quantile"))
    assert of_quantile == pytest.approx(stats.poisson.ppf(0.25, np.exp(mu)).mean(), abs=0.05)
    of_known = table.sel(name="known", quantity=["mean", "sd"])
    np.testing.assert_allclose(of_known.estimate, [0, 2 * np.sqrt(3)], atol=2e-3)
    np.testing.assert_array_equal(of_known.lower, of_known.upper)
    assert np.isnan(table.estimate.sel(name="heavy", quantity=["mean", "sd", "cv"])).all()
    pattern = r"k: mean \d\.\d+ \(\d\.\d+, \d\.\d+\) kN/mm, sd 1\.\d+ \(.*\), cv 4\d(\.\d)?%"
    assert re.search(pattern, repr(table))
    assert ">k (kN/mm)</th>" in table._repr_html_()
    assert table.to_dataframe().loc[("k", "mean"), "unit"] == "kN/mm"
    assert "xarray" in repr(table.sel(name="k"))


def test_a_vector_has_the_correlations_of_its_elements() -> None:
    rho = np.random.default_rng(4).uniform(0.2, 0.8, 200)
    for nu, spread in ((None, 1.0), (9.0, 9 / 7)):
        with pm.Model() as model:
            r = pm.Uniform("rho", -1, 1)
            covariance = pm.math.stack([[1.0, 2 * r], [2 * r, 4.0]])
            mean = np.array([1.0, 2.0])
            load = pm.MvNormal.dist(mean, covariance)
            if nu is not None:
                load = pm.MvStudentT.dist(nu, mu=mean, scale=covariance)
            prb.Simulator("y", lambda load: load.sum(axis=-1), load, observed=DATA, **FRESH)
        table = prb.population(draws(rho=rho), "load", model=model)
        assert table.name.values.tolist() == ["load[0]", "load[1]"]
        cell = table.sel(name="load[1]", quantity="correlation with load[0]")
        found = [float(cell[key]) for key in ("estimate", "lower", "upper")]
        expected = [rho.mean(), *np.quantile(rho, [0.055, 0.945])]
        np.testing.assert_allclose(found, expected, atol=0.02)
        np.testing.assert_allclose(
            table.estimate.sel(quantity=["mean", "sd"]),
            [[1, np.sqrt(spread)], [2, 2 * np.sqrt(spread)]], atol=0.04,
        )  # fmt: skip


@pytest.mark.parametrize(("dim", "of_table"), [("supplier", "supplier"), ("unit", "unit_group")])
def test_groups_are_a_dimension(dim: str, of_table: str) -> None:
    data = xr.DataArray(DATA, {dim: ("specimen", ["Adler", "Busch"] * 10)}, "specimen")
    with pm.Model(coords={dim: ["Adler", "Busch"]}) as model:
        mu = pm.Normal("mu", 2, 2, dims=dim)
        x = pm.Normal.dist(mu[prb.response.group(dim)], 0.3)
        prb.Simulator("y", np.positive, x, observed=data, **FRESH)
    means = np.random.default_rng(5).normal([1.0, 3.0], 0.1, (100, 2))
    table = prb.population(draws(mu=means), model=model)
    assert table.estimate.dims == ("name", of_table, "quantity")
    assert table[of_table].values.tolist() == ["Adler", "Busch"]
    assert table.unit.dims == ("name",)
    of_mean = table.estimate.sel(quantity="mean")[0]
    np.testing.assert_allclose(of_mean, means.mean(axis=0))
    assert "[Busch]: mean 2.99 (2." in repr(table)


def test_a_new_group_has_the_scatter_of_both_levels() -> None:
    data = xr.DataArray(DATA, {"batch": ("specimen", ["a", "b"] * 10)}, "specimen")
    with pm.Model(coords={"batch": ["a", "b"]}) as model:
        mean, between, within = (pm.HalfNormal(name, 1) for name in ("mean", "between", "within"))
        mu = pm.Normal("mu", mean, between, dims="batch")
        x = pm.Normal.dist(mu[prb.response.group("batch")], within)
        prb.Simulator("y", np.positive, x, observed=data)
    rng = np.random.default_rng(6)
    levels = {"mean": (2, 0.1), "between": (0.4, 0.03), "within": (0.3, 0.03)}
    drawn = {name: rng.normal(*moments, 100) for name, moments in levels.items()}
    means = rng.normal([1.8, 2.2], 0.05, (100, 2))
    posterior = draws(mu=means, **drawn)
    of_both = pm.Normal.dist(mean, pm.math.sqrt(between**2 + within**2), name="new")
    of_second = pm.Normal.dist(mu[1], within, name="second")
    sd = np.hypot(drawn["between"], drawn["within"])
    exact = {"new": (drawn["mean"], sd), "second": (means[:, 1], drawn["within"])}
    for dist in (of_both, of_second):
        center, spread = exact[str(dist.name)]
        table = prb.population(posterior, dist, model=model)
        (basis,) = table.estimate.sel(quantity="B-basis")
        np.testing.assert_allclose(basis, np.quantile(center - 1.28155 * spread, 0.05), atol=1e-3)
        found = prb.exceedance(posterior, np.positive, 3.0, dist, model=model, n_points=1000)
        expected = stats.norm.sf(3.0, center, spread).mean()
        assert abs(float(found.probability) - expected) < 4 * float(found.error)
        assert float(found.error) < 0.2 * expected
    with pytest.raises(TypeError, match=r"expected the .dist\(\) of one of"):
        prb.exceedance(posterior, np.positive, 3.0, x, model=model)


def test_a_covariate_needs_its_value() -> None:
    hardness = np.linspace(1.0, 2.0, 20)
    with pm.Model() as model:
        slope = pm.Normal("slope", 1, 1)
        covariate = prb.response.condition("hardness", hardness)
        x = pm.Normal.dist(slope * covariate, 0.3)
        prb.Simulator("y", np.positive, x, observed=DATA)
        at_2 = pm.Normal.dist(slope * 2.0, 0.3)
    posterior = draws(slope=np.linspace(1.0, 2.0, 50))
    with pytest.raises(ValueError, match=r"expected a value of each covariate.*hardness"):
        prb.population(posterior, model=model)
    table = prb.population(posterior, model=model, at={"hardness": 2.0})
    expected = prb.population(posterior, at_2, model=model)
    assert float(table.estimate[0, 0]) == pytest.approx(3.0)
    np.testing.assert_allclose(table.estimate, expected.estimate)


def test_responses_are_weighted_or_predicted_populations() -> None:
    model = normal_model(propagation=prb.Reweighted(2048), units={"y": "mm"})
    (node,) = prb.minimize(model, starts=0, refine=False).evaluator.nodes
    (k,) = node.inputs.aleatory
    response = node.responses.function
    posterior = reference_posterior(400, 6)
    later = prb.predict(
        posterior, response, k, model=model, n_samples=2000, stored=False, name="later"
    )
    table = prb.population(
        posterior, ["k", prb.decision.Condition(response, k), later], model=model
    )
    assert later.attrs["units"] == "mm"
    assert table.name.values.tolist() == ["k", "positive", "later"]
    assert table.unit.values.tolist() == ["", "mm", "mm"]
    of_k = table.estimate[0]
    for place in (1, 2):
        np.testing.assert_allclose(table.estimate[place], of_k, atol=0.05)
        np.testing.assert_allclose(table.upper[place, :6], table.upper[0, :6], atol=0.06)


def test_an_optimum_has_the_intervals_of_its_standard_errors() -> None:
    model = normal_model(metric=prb.KullbackLeibler(), propagation=prb.Reweighted(512))
    optimum = prb.minimize(model, starts=0)
    table = prb.population(optimum, "k")
    cell = table.sel(name="k", quantity="mean")
    z = stats.norm.ppf(0.945)
    assert float(cell.estimate) == pytest.approx(float(optimum.point["mu"]))
    half = float(cell.upper - cell.lower) / 2
    assert half == pytest.approx(z * float(optimum.stderr["mu"]), rel=0.02)
    (k,) = optimum.evaluator.nodes[0].inputs.aleatory
    later = prb.predict(optimum, np.positive, k)
    with pytest.raises(TypeError, match=r"expected prb.predict of a posterior.*Condition"):
        prb.population(optimum, later)


SERIES = pd.Series(DATA, name="y")
SERIES.attrs["units"] = "mm"
FRAME = pd.DataFrame({"a": DATA, "b": DATA**2})
FRAME.attrs["units"] = {"a": "mm"}
JOINT: dict[str, Any] = {"metric": prb.Joint(prb.AreaMetric())}


@pytest.mark.parametrize(
    ("observed", "settings", "units"),
    [
        (DATA, {"units": {"y": "mm"}}, ("mm",)),
        (xr.DataArray(DATA, dims="specimen", attrs={"units": "mm"}), {}, ("mm",)),
        (SERIES, {}, ("mm",)),
        (SERIES, {"units": {"y": "m"}}, ("m",)),
        (FRAME, JOINT, ("mm", "")),
        ({"a": SERIES, "b": DATA**2}, JOINT | {"units": {"b": "kg"}}, ("mm", "kg")),
        (DATA, {}, ()),
    ],
)
def test_units_of_responses_come_from_the_data(
    observed: Any, settings: dict[str, Any], units: tuple[str, ...]
) -> None:
    response = outputs if "metric" in settings else np.positive
    given = FRESH | settings | {"response": response, "mu": (3, 2), "sd": 0.5}
    (simulator,) = simulators(one_input(observed, **given)).values()
    assert simulator.outputs.units == units


def outputs(x: Any) -> dict[str, Any]:
    return {"a": x, "b": x**2}


def test_pictures_have_the_units() -> None:
    model = normal_model(propagation=prb.Reweighted(64), units={"k": "kN/mm", "y": "mm"})
    posterior = reference_posterior(40, 7)
    (k,) = margins(Evaluator.of(model))
    (axis,) = prb.plots.plot_population(posterior, model=model).axes
    assert axis.get_xlabel() == "k (kN/mm)"
    later = prb.predict(posterior, np.positive, k.dist, model=model, n_samples=50, stored=False)
    (axis,) = prb.plots.plot_prediction(DATA, later).axes
    assert axis.get_xlabel() == "positive (mm)"


def test_one_time_series_is_no_population() -> None:
    advice = "for one time series.* use pm.Simulator or a pm.Normal likelihood"
    series = np.ones((100, 2))
    with pytest.raises(ValueError, match=advice):
        prb.AreaMetric().against(series)  # as prb.abc_distance does
    with pytest.raises(ValueError, match=advice):
        prb.Joint(prb.AreaMetric())(np.ones((50, 3)), series[None])
    with pm.Model(), pytest.raises(ValueError, match=f"none of them aleatory.*{advice}"):
        prb.Simulator("y", np.positive, pm.HalfNormal("a"), observed=series)
    times = np.linspace(0, 1, 20)
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1, 1), 0.1)
        for metric in (prb.LogLikelihood(), prb.AreaMetric()):
            with pytest.raises(ValueError, match=f"(1, 20)|1 specimen.*{advice}"):
                prb.Simulator("y", np.positive, x, metric=metric, observed=times[None])
        prb.Simulator("decay", lambda x: np.exp(-np.multiply.outer(x, times)), x, observed=times)
    with pytest.raises(ResponseError, match=rf"returned shape \(10, 20\).*{advice}"):
        prb.minimize(model, progressbar=False)


def test_elements_of_a_vector_have_units_of_their_own() -> None:
    def vector(x: Any) -> Any:
        return x[..., 0] + x[..., 1]

    def model_with(**units: str) -> tuple[pm.Model, Any]:
        with pm.Model() as model:
            mean = pm.Normal("mean", [3, 4], 1, shape=2)
            x = pm.MvNormal.dist(mean, np.eye(2))
            prb.Simulator("y", vector, x, observed=DATA, units=units, **FRESH)
        return model, x

    posterior = draws(mean=np.random.default_rng(1).normal([3.0, 4.0], 0.1, (50, 2)))
    for units, expected in (
        ({"x[1]": "mm", "x[0]": "N"}, ["N", "mm"]),
        ({"x[1]": "mm"}, ["", "mm"]),
        ({"x": "N", "x[1]": "mm"}, ["N", "mm"]),
        ({"x": "N"}, ["N", "N"]),
    ):
        model, x = model_with(**units)
        table = prb.population(posterior, model=model, quantiles=[0.05])
        assert table.unit.values.tolist() == expected
        assert [margin.unit for margin in margins(Evaluator.of(model))] == expected
    (inputs,) = [s["inputs"] for s in describe(model_with(**{"x[1]": "mm"})[0])["simulators"]]
    assert inputs[0][:2] == ["x", " (mm)"]
    with pytest.raises(KeyError, match=r"got 'x\[2\]', expected some of \['x', 'x\[0\]', 'x\[1\]'"):
        model_with(**{"x[2]": "mm"})
    with pytest.raises(
        TypeError, match=r"element among \['x\[0\]', 'x\[1\]'\]; an expression is a"
    ):
        prb.population(posterior, x[0], model=model)


def test_a_coefficient_of_variation_and_correlations_have_no_unit() -> None:
    with pm.Model() as model:
        mu = pm.Normal("mu", [2.0, 3.0], 1.0, shape=2)
        x = pm.MvNormal.dist(mu, np.array([[0.04, 0.01], [0.01, 0.09]]), name="x")
        total = lambda x: x.sum(axis=-1)  # noqa: E731
        prb.Simulator("y", total, x, observed=DATA, units={"x": "ksi"}, **FRESH)
    posterior = draws(mu=np.random.default_rng(0).normal([2.0, 3.0], 0.1, (50, 2)))
    table = prb.population(posterior, "x", model=model)
    frame = table.to_dataframe().reset_index()
    units = frame.groupby("quantity")["unit"].agg(set).to_dict()
    pure = {quantity for quantity, unit in units.items() if unit == {""}}
    assert pure == {q for q in units if q == "cv" or q.startswith("correlation with")}
    assert len(pure) == 2
    assert all(unit == {"ksi"} for quantity, unit in units.items() if quantity not in pure)
    assert set(table.sel(quantity="cv").to_dataframe()["unit"]) == {""}


def test_a_mean_within_rounding_errors_of_zero_is_zero() -> None:
    numbers = _by_name(["mean", "sd"], np.array([[[-2e-17, 0.15], [2.0, 1.0], [np.nan, np.nan]]]))
    np.testing.assert_array_equal(numbers["mean"], [[0.0, 2.0, np.nan]])
    np.testing.assert_array_equal(numbers["cv"], [[np.nan, 0.5, np.nan]])
