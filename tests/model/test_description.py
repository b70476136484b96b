"""A model in words, and back from a file."""

from __future__ import annotations

import json
from functools import partial
from typing import Any

import numpy as np
import pymc as pm
import pytest

import prbayes as prb
from prbayes.model.description import (
    as_attribute,
    describe,
    fits_attribute,
    from_attributes,
    without_addresses,
)


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


def test_what_is_too_long_for_an_attribute_is_left_out(
    model: pm.Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert as_attribute(model)
    assert fits_attribute("x" * 60_000)
    assert not fits_attribute("x" * (1 << 16))
    monkeypatch.setattr("prbayes.model.description.fits_attribute", lambda text: False)
    assert as_attribute(model) == {}


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
