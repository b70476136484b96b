"""A model in words, to a file and back; values as labelled datasets."""

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
        mu, sigma = pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1)
        cv = pm.Deterministic("cv", sigma / mu)
        pm.Deterministic("twice", 2 * cv)
        pm.Normal("z", mu, 1, observed=[1.0, 2.0])
        inputs = pm.Normal.dist(mu, sigma), 2.5, np.ones(3)
        given = {"metric": prb.AreaMetric(), "propagation": prb.Resimulated(32)}
        prb.Simulator(
            "y", stiffness, *inputs, observed=np.arange(50.0), specimens=specimens, **given
        )
    return model


@pytest.fixture(scope="module")
def model() -> pm.Model:
    return simulated(np.arange(100, 150))


def test_variables_and_simulators_are_described(model: pm.Model) -> None:
    found = describe(model)
    assert [tuple(variable.values()) for variable in found["variables"]] == [
        ("mu", "hyperparameter", "Normal(0, 2)"),
        ("sigma", "hyperparameter", "HalfNormal(0, 1)"),
        ("cv", "deterministic", "computed from sigma, mu"),
        ("twice", "deterministic", "computed from cv"),
        ("z", "observed", "Normal(mu, 1)"),
    ]
    (simulator,) = found["simulators"]
    assert simulator["name"] == "y"
    assert simulator["response"] == "stiffness"
    assert simulator["inputs"] == [
        ["x", "", "~ Normal(mu, sigma)"],
        ["a", "", "= 2.5"],
        ["b", "", "= an array of shape (3,)"],
    ]
    assert simulator["metric"].startswith("AreaMetric(")
    assert simulator["propagation"].startswith("Resimulated(")
    assert simulator["n_points"] == "32"
    assert simulator["runs"] == "32 runs for each population"
    assert simulator["n_specimens"] == "50 specimens"
    assert simulator["specimens"].startswith("50 specimens: 100, 101, ")
    assert simulator["specimens"].endswith("138, 139, and 10 more")
    (few,) = describe(simulated(np.repeat(["a", "b"], 25)))["simulators"]
    assert few["specimens"] == "2 specimens: a, b"
    (without,) = describe(simulated())["simulators"]
    assert without["specimens"] == without["n_specimens"] == ""


def test_arrays_of_constants_are_shown() -> None:
    with pm.Model() as model:
        location = pm.Normal("location", [1, 2.5], 0.5, shape=2)
        pm.HalfNormal("scale", np.full(2, 0.2))
        pm.Normal("many", np.arange(9.0), [[1.0], [2.0]])
        pm.LKJCholeskyCov("chol", n=2, eta=2, sd_dist=pm.HalfNormal.dist(0.4, shape=2))
        pm.LKJCholeskyCov("other", n=2, eta=2, sd_dist=pm.HalfNormal.dist([0.4, 2.0]))
        x = pm.MvNormal.dist(location, np.diag([1.0, 2.0]))
        prb.Simulator("y", lambda x: x[..., 0], x, metric=prb.AreaMetric(), observed=[1.0, 2.0])
    texts = {v["name"]: v["distribution"] for v in describe(model)["variables"]}
    assert texts["location"] == "Normal([1, 2.5], 0.5)"
    assert texts["scale"] == "HalfNormal(0, [0.2, 0.2])"
    assert texts["many"] == "Normal(9 numbers, [1, 2])"
    assert texts["chol"] == "LKJCholeskyCov(2, 2, HalfNormal(0, 0.4))"
    assert texts["other"] == "LKJCholeskyCov(2, 2, HalfNormal(0, [0.4, 2]))"
    (simulator,) = describe(model)["simulators"]
    assert simulator["response"] == "lambda(x)"
    assert simulator["inputs"] == [["x", "", "~ MultivariateNormal(f(location), [1, 0, 0, 2])"]]


def test_a_description_comes_back_from_a_file(model: pm.Model) -> None:
    assert from_attributes(as_attribute(model)) == describe(model)
    text = json.loads(as_attribute(model)["model"])
    text["variables"][0]["code"] = "x"
    text["more"] = "x"
    assert from_attributes({"model": json.dumps(text)}) == describe(model)
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


def test_texts_are_the_same_in_every_session() -> None:
    assert without_addresses(stiffness) == "stiffness"
    assert "0x" not in without_addresses(partial(stiffness, object()))
    text = without_addresses(prb.FunctionMetric(lambda simulated, observed: 0.0))
    assert "0x" not in text
    assert "<lambda>" in text
    assert versions()["prbayes_version"] == prb.__version__
    assert versions()["numpy_version"] == np.__version__


def test_dimensions_and_coordinates_are_those_of_the_model() -> None:
    with pm.Model(coords={"layer": ["top", "bottom"], "specimen": [7, 8, 9]}) as model:
        mu = pm.Normal("mu", 0, 1, dims="layer")
        x = pm.Normal.dist(mu[0], 1.0)
        given = {"metric": prb.AreaMetric(), "propagation": prb.Reweighted(64)}
        prb.Simulator("y", np.positive, x, observed=[0.0, 1.0, 2.0], dims="specimen", **given)
    evaluator = Evaluator.of(model)
    data = labelled(evaluator, {"mu": np.zeros((4, 2)), "free": np.ones((4, 3))}, {"draw": 4})
    assert data["mu"].dims == ("draw", "layer")
    assert data["free"].dims == ("draw", "free_dim_0")
    assert list(data["layer"].values) == ["top", "bottom"]
    assert list(data["draw"].values) == [0, 1, 2, 3]
    observed = observed_dataset(evaluator)
    assert observed["y"].dims == ("specimen",)
    assert float(observed["y"].sel(specimen=9)) == 2.0


TWO = np.array([[0.0, 1.0], [1.0, np.nan], [2.0, 0.5], [4.0, 3.0]])


def observed_outputs(**observed: Any) -> xr.Dataset:
    """Return the observed responses of a model with simulators of several outputs."""
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu"), 1.0)
        metric = prb.Joint(prb.ProbabilityResidual())
        for name, values in observed.items():
            powers = np.arange(1, np.shape(values)[1] + 1)

            def response(x: Any, powers: Any = powers) -> Any:
                return x[..., None] * powers + x[..., None] ** 2

            given = {"metric": metric, "propagation": prb.Reweighted(64)}
            prb.Simulator(name, response, x, observed=values, **given)
    return observed_dataset(Evaluator.of(model))


@pytest.mark.parametrize("units", ["Hz", ["Hz", "mm"]])
def test_outputs_keep_dimension_names_and_units_in_a_file(tmp_path: Path, units: Any) -> None:
    coords = {"mode": ["first", "second"]}
    measured = xr.DataArray(TWO, coords, ("specimen", "mode"))
    if isinstance(units, str):
        measured.attrs["units"] = units
    else:
        measured = measured.assign_coords(units=("mode", units))
    data = observed_outputs(frame=measured)
    assert data["frame"].dims == ("frame_dim_0", "mode")
    data.to_netcdf(tmp_path / "data.nc", engine="h5netcdf")
    with xr.open_dataset(tmp_path / "data.nc", engine="h5netcdf") as again:
        np.testing.assert_array_equal(again["frame"], TWO)
        assert again["mode"].values.tolist() == coords["mode"]
        np.testing.assert_array_equal(again["frame"].attrs["units"], units)


def test_simulators_with_different_outputs_have_their_own_dimensions() -> None:
    three = np.random.default_rng(0).normal(size=(6, 3))
    data = observed_outputs(one=TWO, other=three, same=TWO[::-1])
    assert [data[name].dims[1] for name in data] == ["output", "other_output", "output"]
    assert data["output"].values.tolist() == [0, 1]
