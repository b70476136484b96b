"""A model in words, and back from a file; values as labelled datasets."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm
import pytest
import xarray as xr

import prbayes as prb
from prbayes.model.description import (
    as_attribute,
    describe,
    from_attributes,
    json_attribute,
    labelled,
    observed_dataset,
    versions,
    without_addresses,
)
from prbayes.model.evaluator import Evaluator


def stiffness(x: Any, a: Any, b: Any) -> Any:
    return x + a + np.sum(b)


def simulated(specimens: Any = None) -> pm.Model:
    with pm.Model() as model:
        mu = pm.Normal("mu", 0, 2)
        sigma = pm.HalfNormal("sigma", 1)
        pm.Deterministic("cv", sigma / mu)
        pm.Normal("z", mu, 1, observed=[1.0, 2.0])
        x = pm.Normal.dist(mu, sigma)
        prb.Simulator(
            "y",
            stiffness,
            x,
            2.5,
            np.ones(3),
            metric=prb.AreaMetric(),
            observed=np.arange(50.0),
            specimens=specimens,
            propagation=prb.Resimulated(32),
        )
    return model


@pytest.fixture(scope="module")
def model() -> pm.Model:
    return simulated(np.arange(100, 150))


def test_variables_with_their_roles(model: pm.Model) -> None:
    found = [(v["name"], v["role"], v["distribution"]) for v in describe(model)["variables"]]
    assert found == [
        ("mu", "hyperparameter", "Normal(0, 2)"),
        ("sigma", "hyperparameter", "HalfNormal(0, 1)"),
        ("cv", "deterministic", "computed from sigma, mu"),
        ("z", "observed", "Normal(mu, 1)"),
    ]


def test_simulators_with_their_inputs(model: pm.Model) -> None:
    (found,) = describe(model)["simulators"]
    assert found["name"] == "y"
    assert found["response"] == "stiffness"
    assert found["inputs"] == "Normal(mu, sigma), 2.5, an array of shape (3,)"
    assert found["metric"].startswith("AreaMetric(")
    assert found["propagation"].startswith("Resimulated(")
    assert found["n_points"] == "32"


def test_many_specimens_are_counted(model: pm.Model) -> None:
    (found,) = describe(model)["simulators"]
    assert found["specimens"].startswith("50 specimens: 100, 101, ")
    assert found["specimens"].endswith("138, 139, and 10 more")
    (few,) = describe(simulated(np.repeat(["a", "b"], 25)))["simulators"]
    assert few["specimens"] == "2 specimens: a, b"
    (none,) = describe(simulated())["simulators"]
    assert none["specimens"] == ""


def test_a_file_tells_what_the_model_does(model: pm.Model) -> None:
    assert from_attributes(as_attribute(model)) == describe(model)


def test_what_is_too_long_for_an_attribute_is_left_out(model: pm.Model) -> None:
    assert as_attribute(model)
    assert json_attribute("text", {"x": "x" * 60_000}) == {}


@pytest.mark.parametrize(
    "text",
    [
        "{",
        "[]",
        "3",
        "null",
        '{"variables": 4, "simulators": []}',
        '{"variables": [{"name": 1}], "simulators": []}',
        '{"variables": []}',
    ],
)
def test_damaged_descriptions_are_none(text: str) -> None:
    assert from_attributes({"model": text}) is None
    assert from_attributes({}) is None


def test_unknown_keys_of_a_file_are_left_out(model: pm.Model) -> None:
    text = json.loads(as_attribute(model)["model"])
    text["variables"][0]["code"] = "x"
    text["more"] = "x"
    assert from_attributes({"model": json.dumps(text)}) == describe(model)


def test_configurations_read_the_same_in_every_session() -> None:
    assert without_addresses(stiffness) == "stiffness"
    assert "0x" not in without_addresses(partial(stiffness, object()))
    metric = prb.FunctionMetric(lambda simulated, observed: 0.0)
    assert "0x" not in without_addresses(metric)
    assert "<lambda>" in without_addresses(metric)


def test_a_variable_is_computed_from_those_next_above_it() -> None:
    with pm.Model() as model:
        first = pm.Deterministic("first", 2 * pm.Normal("mu", 0, 1))
        pm.Deterministic("second", 3 * first)
    texts = {v["name"]: v["distribution"] for v in describe(model)["variables"]}
    assert texts["first"] == "computed from mu"
    assert texts["second"] == "computed from first"


def test_arrays_of_constants_are_told() -> None:
    with pm.Model() as model:
        location = pm.Normal("location", [1, 2.5], 0.5, shape=2)
        pm.HalfNormal("scale", np.full(2, 0.2))
        pm.Normal("many", np.arange(9.0), [[1.0], [2.0]])
        pm.LKJCholeskyCov("chol", n=2, eta=2, sd_dist=pm.HalfNormal.dist(0.4, shape=2))
        pm.LKJCholeskyCov("other", n=2, eta=2, sd_dist=pm.HalfNormal.dist([0.4, 2.0]))
        x = pm.MvNormal.dist(location, np.diag([1.0, 2.0]))
        prb.Simulator("y", lambda x: x[..., 0], x, metric=prb.AreaMetric(), observed=[1.0, 2.0])
    told = {v["name"]: v["distribution"] for v in describe(model)["variables"]}
    assert told["location"] == "Normal([1, 2.5], 0.5)"
    assert told["scale"] == "HalfNormal(0, [0.2, 0.2])"
    assert told["many"] == "Normal(9 numbers, [1, 2])"
    assert told["chol"] == "LKJCholeskyCov(2, 2, HalfNormal(0, 0.4))"
    assert told["other"] == "LKJCholeskyCov(2, 2, HalfNormal(0, [0.4, 2]))"
    (simulator,) = describe(model)["simulators"]
    assert simulator["response"] == "lambda(x)"
    assert simulator["inputs"] == "MultivariateNormal(f(location), [1, 0, 0, 2])"


def evaluator() -> Evaluator:
    with pm.Model(coords={"layer": ["top", "bottom"], "specimen": [7, 8, 9]}) as model:
        mu = pm.Normal("mu", 0, 1, dims="layer")
        prb.Simulator(
            "y",
            np.positive,
            pm.Normal.dist(mu[0], 1.0),
            metric=prb.AreaMetric(),
            observed=[0.0, 1.0, 2.0],
            dims="specimen",
            propagation=prb.Reweighted(64),
        )
    return Evaluator.of(model)


def test_dimensions_and_coordinates_are_the_models() -> None:
    data = labelled(evaluator(), {"mu": np.zeros((4, 2)), "free": np.ones((4, 3))}, {"draw": 4})
    assert data["mu"].dims == ("draw", "layer")
    assert data["free"].dims == ("draw", "free_dim_0")
    assert list(data["layer"].values) == ["top", "bottom"]
    assert list(data["draw"].values) == [0, 1, 2, 3]


def test_observed_values_are_labelled() -> None:
    data = observed_dataset(evaluator())
    assert data["y"].dims == ("specimen",)
    assert float(data["y"].sel(specimen=9)) == 2.0


def test_versions_are_those_of_this_installation() -> None:
    assert versions()["prbayes_version"] == prb.__version__
    assert versions()["numpy_version"] == np.__version__


TWO = np.array([[0.0, 1.0], [1.0, np.nan], [2.0, 0.5], [4.0, 3.0]])


def with_outputs(**observed: object) -> Evaluator:
    """Return a model with a simulator of several outputs for each of some observed responses."""
    with pm.Model():
        x = pm.Normal.dist(pm.Normal("mu"), 1.0)
        for name, values in observed.items():
            m = np.shape(values)[1]
            prb.Simulator(
                name,
                lambda x, m=m: x[..., None] * np.arange(1, m + 1) + x[..., None] ** 2,
                x,
                metric=prb.MarginalCorrelation(prb.ProbabilityResidual()),
                observed=values,
                propagation=prb.Reweighted(64),
            )
        return Evaluator.of(pm.modelcontext(None))


def frequencies(units: object) -> xr.DataArray:
    """Return two measured outputs with names and units."""
    keep = {"attrs": {"units": units}} if isinstance(units, str) else {}
    data = xr.DataArray(
        TWO, dims=("specimen", "mode"), coords={"mode": ["first", "second"]}, **keep
    )
    return data if keep else data.assign_coords(units=("mode", units))


@pytest.mark.parametrize("units", ["Hz", ["Hz", "mm"]])
def test_outputs_keep_their_dimension_names_and_units_in_a_file(tmp_path: Path, units: Any) -> None:
    data = observed_dataset(with_outputs(frame=frequencies(units)))
    assert data["frame"].dims == ("frame_dim_0", "mode")
    assert data["mode"].values.tolist() == ["first", "second"]
    data.to_netcdf(tmp_path / "data.nc", engine="h5netcdf")
    with xr.open_dataset(tmp_path / "data.nc", engine="h5netcdf") as again:
        np.testing.assert_array_equal(again["frame"], TWO)
        assert again["mode"].values.tolist() == ["first", "second"]
        np.testing.assert_array_equal(again["frame"].attrs["units"], units)


def test_simulators_with_other_outputs_have_dimensions_of_their_own() -> None:
    three = np.column_stack([TWO[:, 0], [1.0, 0.0, 4.0, 5.0], [0.0, 2.0, 1.0, 3.0]])
    data = observed_dataset(with_outputs(one=TWO, other=three, same=TWO[::-1]))
    assert [data[name].dims[1] for name in data] == ["output", "other_output", "output"]
    assert data["output"].values.tolist() == [0, 1]
