"""Every argument of every public name, given what it does not take: a sentence, soon, and before the response is called.

`TABLE` has a row for each public name: how it is called with good arguments, and what is bad for
each of them.
"""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
import pymc as pm
import pytest
import xarray as xr
from first_use import first_use

import prbayes as prb
from prbayes.model.random_variable import nodes

OBSERVED = np.random.default_rng(1).normal(2.0, 1.0, 30)
OUTPUTS = np.stack([OBSERVED, OBSERVED**2 - OBSERVED], axis=-1)
FRESH_DATA = OBSERVED[:9] + 0.3
QUIET = {"progressbar": False}
called = 0


def line(x: Any, *constants: Any) -> Any:
    global called
    called += np.size(x)
    return 2.0 * x


# -- what is shared --------------------------------------------------------------------------------


@cache
def model() -> pm.Model:
    with pm.Model(coords={"specimen": range(30), "few": range(3)}) as made:
        x = pm.Normal.dist(pm.Normal("mu", 1, 1), 1.0, name="x")
        prb.Simulator(
            "y",
            line,
            x,
            metric=prb.AreaMetric(),
            observed=OBSERVED,
            propagation=prb.Reweighted(256),
            **QUIET,
        )
    return made


@cache
def with_epsilon() -> pm.Model:
    with pm.Model() as made:
        x = pm.Normal.dist(pm.Normal("mu", 1, 1), 1.0)
        given = {"metric": prb.AreaMetric(), "observed": OBSERVED, "epsilon": 0.1}
        prb.Simulator("y", line, x, propagation=prb.Reweighted(64), **given, **QUIET)
    return made


@cache
def bare() -> pm.Model:
    with pm.Model() as made:
        pm.Normal("mu")
    return made


@cache
def specimen() -> Any:
    return next(iter(nodes(model()).values())).bound.inputs.aleatory[0]


@cache
def optimum() -> prb.Optimum:
    return prb.minimize(model(), refine=False, starts=0, **QUIET)


@cache
def posterior() -> xr.DataTree:
    return prb.sample_smc(
        20, chains=2, model=model(), optimum=optimum(), refine=False, random_seed=1, **QUIET
    )


@cache
def two_outputs() -> pm.Model:
    with pm.Model() as made:
        x = pm.Normal.dist(pm.Normal("mu", 1, 1), 1.0)
        data = {"first": OBSERVED, "second": np.square(OBSERVED)}
        given = {"metric": prb.Joint(prb.AreaMetric()), "observed": data}
        cheap = prb.Resimulated(64)
        prb.Simulator("y", _two_outputs, x, **given, propagation=cheap, **QUIET)
    return made


@cache
def of_two_outputs() -> prb.Optimum:
    given = {"method": "Nelder-Mead", "refine": False, "starts": 0}
    return prb.minimize(two_outputs(), **given, **QUIET)


def _two_outputs(x: Any) -> dict[str, Any]:
    return {"first": x, "second": np.square(x)}


@cache
def influences() -> xr.Dataset:
    return prb.sensitivity(posterior(), prb.decision.Mean(line, specimen()), model=model())


@cache
def predicted() -> xr.DataArray:
    return prb.predict(posterior(), line, specimen(), model=model(), n_samples=50, **QUIET)


@cache
def comparison() -> xr.Dataset:
    return prb.compare({"optimum": optimum(), "posterior": posterior()}, model=model())


@cache
def validity() -> prb.validation.ValidityTest:
    null = prb.validation.PosteriorNull(19)
    return prb.area_test(FRESH_DATA, predicted(), null=null, **QUIET)


@cache
def surrogate() -> prb.Surrogate:
    return prb.Surrogate.fit(np.square, {"x": (0, 1)}, 20, **QUIET)


def one_candidate() -> Any:
    return {"a": optimum()}


def candidates_of_other_types() -> Any:
    return {"a": optimum(), "b": comparison()}


def candidates_without_names() -> Any:
    return {1: optimum(), 2: optimum()}


class Name(str):
    """What is made when it is needed: the name of a function of this module."""

    __slots__ = ()

    def __repr__(self) -> str:
        return str(self)


def made(value: Any) -> Any:
    return globals()[value]() if isinstance(value, Name) else value


# -- what is bad for many --------------------------------------------------------------------------

SEED: Sequence[Any] = (-1, 1.5, 2.0, True, "a", np.nan, [1.5], [])
# Configuration takes an integer, and not the other seeds of PyMC.
INTEGER_SEED = (*SEED, [1, 2], np.random.default_rng(1), None)
ADJUSTMENT: Sequence[Any] = ("affine", "none", True, False, 1, np.nan, ["estimate"])
FLAG: Sequence[Any] = ("no", 1, 0.0, None, [])
COUNT: Sequence[Any] = (0, -5, 1.5, 64.0, "64", None, True, np.nan, [64])
SHARE: Sequence[Any] = (0, 1, -0.5, 5, "a", np.nan, None, True)
POSITIVE: Sequence[Any] = (0, -1.0, np.nan, np.inf, "a", True, None, [0.1])


def but_none(bad: Sequence[Any]) -> list[Any]:
    """Return what is bad where None is good."""
    return [value for value in bad if value is not None]


LOST: Sequence[Any] = (1.0, -0.1, np.nan, "a", None, True, False)
BUDGETS: Mapping[str, Sequence[Any]] = {
    "max_seconds": but_none(POSITIVE),
    "max_runs": but_none(COUNT),
}
EXECUTOR: Sequence[Any] = (4, map, "processes", object())
STORE: Sequence[Any] = (4, True, b"folder", "")
VERSION: Sequence[Any] = (2, 1.5, True, "")
TEXT: Sequence[Any] = (3, b"text", [], True)
NO_METRIC: Sequence[Any] = (None, "area", 3, np.mean, prb.AreaMetric)
NO_MODEL: Sequence[Any] = (3, "model", Name("bare"), pm.Model, Name("optimum"))
NO_OPTIMUM: Sequence[Any] = (None, 3, "optimum", Name("posterior"), Name("model"), {"mu": 1.0})
NO_RESULT: Sequence[Any] = (None, 3, "result", xr.DataTree(), Name("comparison"), [])
NO_DATA: Sequence[Any] = (
    OBSERVED > 2,
    ["a", "b", "c"],
    [1.0, np.nan, 2.0],
    [],
    1.0,
    np.ones((3, 2)),
    {"a": OBSERVED},
    np.array(["2020-01-01", "2021-01-01"], dtype="M8[D]"),
    np.array([1, 2], dtype="m8[s]"),
    [1j, 2.0],
    [[1.0], [1.0, 2.0]],
    ["1.0", 2.0, None],
    None,
    [10**400, 1.0],
    np.ma.masked_array([1.0, 2.0, 3.0], [0, 1, 0]),
)
NO_RESPONSE: Mapping[str, Sequence[Any]] = {"response": (3, "line", None, dict)}
NO_LIMIT: Sequence[Any] = ("a", None, np.nan, np.inf, True, [1.0])
CALLING: dict[str, Sequence[Any]] = {
    "executor": EXECUTOR,
    "store": STORE,
    "version": VERSION,
}
PROPAGATION: dict[str, Sequence[Any]] = {
    **CALLING,
    "random_seed": INTEGER_SEED,
    "on_failure": ("abort", prb.response.Abort, None, 3),
    "max_lost": LOST,
    "retry_failed": FLAG,
    "timeout": (0, -1.0, np.nan, "a", True, 5.0),
}
PICTURE: dict[str, Sequence[Any]] = {
    "labels": ("mu", 3, ["mu"], {"mu": 3}, {3: "mu"}, {"no such name": "mean"}),
    "figsize": (3, "wide", (3,), (0, 4), (np.inf, 4), ("a", 4)),
    "model": (3, "model"),
}


# -- the table -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Row:
    """A public name: how it is called, and what is bad for each of its arguments."""

    call: Callable[..., Any]
    bad: Mapping[str, Sequence[Any]]
    good: Mapping[str, Any] = field(default_factory=dict)


def simulator(**given: Any) -> Any:
    names = {"name": "y", "response": line, "input": 1.0}
    name, response, constant = (given.pop(key, default) for key, default in names.items())
    with pm.Model(coords={"few": range(3)}) as made:
        x = pm.Normal.dist(pm.Normal("mu", 1, 1), 1.0)
        keywords = {"metric": prb.AreaMetric(), "observed": OBSERVED} | given
        try:
            return prb.Simulator(name, response, x, constant, **QUIET | keywords)
        finally:
            assert [rv.name for rv in made.basic_RVs][1:] in ([], ["y"])


def in_groups(labels: Sequence[Any]) -> xr.DataArray:
    return xr.DataArray(OBSERVED, {"supplier": ("specimen", labels)}, "specimen")


def group(**given: Any) -> Any:
    labels = ["a", "b"] * 15
    with pm.Model(coords=given.get("coords", {"supplier": ["a", "b"]})):
        mu = pm.Normal("mu", 1, 1, shape=2)
        x = pm.Normal.dist(mu[prb.response.group(given.get("dim", "supplier"))], 1.0)
        observed = given.get("observed", in_groups(labels))
        return prb.Simulator("y", line, x, metric=prb.AreaMetric(), observed=observed, **QUIET)


def metric_called(**given: Any) -> Any:
    simulated, observed = given.pop("simulated", OBSERVED), given.pop("observed", OBSERVED)
    return prb.AreaMetric()(simulated, observed, **given)


def joint_called(**given: Any) -> Any:
    simulated, observed = given.pop("simulated", OUTPUTS), given.pop("observed", OUTPUTS)
    return prb.Joint(prb.AreaMetric())(simulated, observed, **given)


def predict(**given: Any) -> Any:
    result, response = given.pop("result", posterior()), given.pop("response", line)
    inputs = given.pop("input", specimen())
    return prb.predict(result, response, inputs, **{"model": model()} | QUIET | given)


def predict_without_model(**given: Any) -> Any:
    return prb.predict(given["result"], line, specimen(), model=model(), **QUIET)


def fit(**given: Any) -> Any:
    inputs = {"x": (0.0, 1.0)}
    return prb.Surrogate.fit(**{"response": line, "inputs": inputs, "n": 20} | QUIET | given)


def report(**given: Any) -> Any:
    return prb.Report(**{"title": "A", "optimum": optimum(), "pictures": False} | given)


def with_model(function: Callable[..., Any]) -> Callable[..., Any]:
    return lambda **given: function(**{"model": model()} | QUIET | given)


def with_decision(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a question about a posterior, with what it asks of the shared model."""

    def asked(**given: Any) -> Any:
        common = {"result": posterior(), "model": model()}
        if function is prb.sensitivity:
            common["quantity"] = prb.decision.Mean(line, specimen())
        elif function is prb.plan:
            common["candidates"] = {"same": prb.decision.Condition(line, specimen())}
        else:
            asked_of = {**common, "response": line, "limit": 1.0, "input": specimen()} | given
            if function is prb.decision.p_box:
                asked_of.pop("limit")
            first = ("result", "response", "limit", "input")
            ordered = [asked_of.pop(name) for name in first if name in asked_of]
            return function(*ordered, **asked_of)
        return function(**common | given)

    return asked


def of_optimum(function: Callable[..., Any]) -> Callable[..., Any]:
    return lambda **given: function(**{"optimum": optimum()} | QUIET | given)


def on_dims(dims: Any) -> Any:
    return simulator(dims=dims)


TABLE: dict[str, Row] = {
    "Simulator": Row(
        simulator,
        {
            "name": (None, 3, "", "  ", "mu", b"y", ["y"]),
            "response": (3, "line", None, dict),
            "input": (None, "a", np.nan, np.inf, pm.Normal, ["a"], 1j, True, {"a": 1}),
            "metric": ("area", 3, prb.AreaMetric, np.mean),
            "observed": (*NO_DATA, [1.0]),
            "epsilon": (*[v for v in POSITIVE if v is not None], {"y": 1.0}, 1j),
            "weights": (
                np.ones(29),
                np.ones((2, 30)),
                np.r_[-1, np.ones(29)],
                np.r_[np.nan, np.ones(29)],
                np.zeros(30),
                OBSERVED > 2,
                "abc",
                1.0,
            ),
            "specimens": (
                range(29),
                [None] * 30,
                [*range(29), None],
                [np.nan] * 30,
                [*"a" * 29, np.nan],
                np.ones((30, 1)),
                "abc",
                3,
                {"a": 1},
                [True] * 30,
                [[1]] * 30,
            ),
            "dims": ("nope", 3, "few", "", ("few", "few"), True),
            "propagation": (64, "reweighted", prb.Reweighted, prb.AreaMetric()),
            "progressbar": FLAG,
        },
    ),
    "Reweighted": Row(
        prb.Reweighted,
        {
            **PROPAGATION,
            "n": COUNT,
            "max_points": (3, 0, 1.5, "a", True),
        },
    ),
    "Resimulated": Row(
        prb.Resimulated,
        {**PROPAGATION, "n": (*COUNT, 1), "points": ("halton", 3, None, True)},
    ),
    "Fresh": Row(prb.Fresh, {**PROPAGATION, "n": COUNT}),
    "response.Abort": Row(prb.response.Abort, {"on_nan": FLAG}),
    "response.Additive": Row(
        prb.response.Additive,
        {
            "seen": (None, "x", 1.0, [1.0], [1.0, 1.0], [0.0, np.inf], [[0.0, 1.0]]),
            "shape": (3, "line", lambda c: np.nan * c, lambda c: 1.0),
        },
        {"seen": [0.0, 1.0]},
    ),
    "response.group": Row(
        group,
        {
            "dim": (None, 3, "", "batch", ["supplier"]),
            "coords": (
                {"supplier": ["a"]},
                {"supplier": ["a", "a"]},
                {"supplier": ["a/b", "c"]},
                {"other": ["a", "b"]},
            ),
            "observed": (
                OBSERVED,
                OBSERVED.tolist(),
                in_groups(["a"] * 30),
                in_groups(["a"] * 29 + ["b"]),
                in_groups(["a", "b", "c"] * 10),
                in_groups([None] * 30),
            ),
        },
    ),
    "response.Multiplicative": Row(
        prb.response.Multiplicative,
        {
            "seen": (None, "x", 1.0, [1.0], [1.0, 1.0], [0.0, np.inf], [[0.0, 1.0]]),
            "shape": (3, "line", lambda c: np.nan * c, lambda c: 1.0),
        },
        {"seen": [0.0, 1.0]},
    ),
    "response.Replace": Row(prb.response.Replace, {"value": ("x", None, -np.inf, True, [1.0], 1j)}),
    "response.Retry": Row(
        prb.response.Retry,
        {"times": COUNT, "then": (None, "abort", prb.response.Retry(), prb.response.Abort)},
    ),
    "scalar": Row(prb.scalar, {"function": (3, "f", None)}),
    "command": Row(
        prb.command,
        {
            "arguments": ([], "ls", 3, None, [3], [sys.executable, None]),
            "inputs": ("x", 3, None, ["y"], ["x", "x"], ["a b"], [3]),
            "read": (3, "float", None),
            "write": (3, "in.txt", {"../in.txt": "{x}"}, {"/in.txt": "{x}"}, {3: "{x}"}, {"a": 3}),
            "timeout": but_none(POSITIVE),
            "folder": (3, "", b"folder"),
            "keep": FLAG,
        },
        {"arguments": [sys.executable, "{x}"], "inputs": ["x"], "read": float},
    ),
    "umbridge": Row(
        prb.umbridge,
        {
            "url": (3, "", "localhost:4242", None, "ftp://localhost", "http://"),
            "model": (3, "", None, ["forward"]),
            "config": (3, "level", {"level": np.arange(2)}, [1]),
            "timeout": but_none(POSITIVE),
            "patience": POSITIVE,
        },
        {"url": "http://127.0.0.1:9"},
    ),
    "fmu": Row(
        prb.fmu,
        {
            "path": (3, "", None, b"unit.fmu"),
            "inputs": ("x", [], None, ["x", "x"], [3]),
            "outputs": ("y", [], None, ["y", "y"], {"a": 3}),
            "parameters": (3, "m", {3: 1.0}, ["m"]),
            "timeout": but_none(POSITIVE),
            "reset": FLAG,
        },
        {"path": __file__, "inputs": ["x"], "outputs": ["y"]},
    ),
    "ProbabilityResidual": Row(
        prb.ProbabilityResidual,
        {"density": (None, 0.3, prb.GaussianKDE, "kde"), "scale_base": POSITIVE},
    ),
    "KullbackLeibler": Row(
        prb.KullbackLeibler, {"density": (None, 0.3, prb.Histogram, "kde"), "reverse": FLAG}
    ),
    "LogLikelihood": Row(prb.LogLikelihood, {"density": (0.3, prb.GaussianKDE, "kde")}),
    "FunctionMetric": Row(
        prb.FunctionMetric, {"function": (3, "f", None), "weighted": FLAG}, {"function": np.mean}
    ),
    "Joint": Row(
        prb.Joint,
        {
            "metric": (*NO_METRIC, prb.Joint(prb.AreaMetric())),
            "directions": but_none(COUNT),
            "random_seed": (-1, 1.5, "a", None, True),
        },
        {"metric": prb.AreaMetric()},
    ),
    "MarginalCorrelation": Row(
        prb.MarginalCorrelation,
        {
            "metric": (*NO_METRIC, prb.Joint(prb.AreaMetric())),
            "weights": (
                1.0,
                "ab",
                None,
                [1.0, 1.0],
                (1.0,),
                (1.0, 0.0),
                (1.0, -2.0),
                (np.nan, 1.0),
            ),
        },
        {"metric": prb.AreaMetric()},
    ),
    "a metric of several outputs": Row(
        joint_called,
        {
            "simulated": (np.full((9, 2), np.nan), np.ones((9, 3)), OUTPUTS[:, 0], "a", None, []),
            "observed": (
                OUTPUTS[None],
                OUTPUTS[:3],
                OUTPUTS * [1, 0],
                OUTPUTS * [1, np.nan],
                OUTPUTS * [1, -np.inf],
                OUTPUTS * np.nan,
                OUTPUTS[:, [0, 0]],
                OUTPUTS > 2,
            ),
            "weights": (np.ones(3), -np.ones(30), np.zeros(30), "abc", OBSERVED > 2),
        },
    ),
    "GaussianKDE": Row(prb.GaussianKDE, {"bandwidth": but_none(POSITIVE)}),
    "Histogram": Row(prb.Histogram, {"bins": (0, -3, 1.5, "a", True, [3.0, 2.0, 1.0], np.nan)}),
    "a metric": Row(
        metric_called,
        {
            "simulated": ([1.0, np.nan], [], "a", OBSERVED > 2, None, 1.0),
            "observed": NO_DATA,
            "weights": (np.ones(3), -np.ones(30), np.zeros(30), "abc", OBSERVED > 2),
        },
    ),
    "abc_distance": Row(prb.abc_distance, {"metric": NO_METRIC}),
    "minimize": Row(
        with_model(prb.minimize),
        {
            "model": NO_MODEL,
            "start": (
                {"nu": 1.0},
                {"mu": "a"},
                {"mu": np.nan},
                {"mu": [1.0, 2.0]},
                {"mu": True},
                {},
                [1.0],
                1.0,
            ),
            "method": ("BFSG", 3, prb.AreaMetric, ""),
            "options": ("maxiter", 3, ["maxiter"], {"nonsense": 1}, {3: 1}),
            "prior": FLAG,
            "tolerance": POSITIVE,
            "max_evaluations": COUNT,
            "refine": FLAG,
            "starts": (-1, 1.5, "many", True),
            **BUDGETS,
            "random_seed": SEED,
            "progressbar": FLAG,
        },
        {"refine": False},
    ),
    "refine": Row(
        with_model(prb.refine),
        {
            "model": NO_MODEL,
            "thetas": (
                {"mu": 1.0},
                "a",
                3.0,
                [[1.0, 2.0]],
                [1.0],
                [[np.nan]],
                [["a"]],
                np.empty((0, 1)),
                [[True]],
            ),
            **BUDGETS,
            "progressbar": FLAG,
        },
        {"thetas": [[1.0]]},
    ),
    "cost": Row(
        prb.cost,
        {
            "model": (3, "model", Name("bare"), print, Name("optimum")),
        },
        {"model": Name("model")},
    ),
    "set_epsilon": Row(
        prb.set_epsilon,
        {
            "model": (None, 3, "model", Name("bare")),
            "epsilon": (
                0.1,
                None,
                "a",
                ["y"],
                {"z": 1.0},
                {"y": True},
                {"y": 0},
                {"y": np.nan},
                {"y": None},
                {3: 1.0},
            ),
        },
        {"model": Name("model"), "epsilon": {}},
    ),
    "calibrate_epsilon": Row(prb.calibrate_epsilon, {"optimum": NO_OPTIMUM}),
    "sample_smc": Row(
        lambda **given: prb.sample_smc(
            **{"model": model(), "optimum": optimum(), "draws": 20, "chains": 1}
            | {"adjustment": None}
            | QUIET
            | given
        ),
        {
            "draws": (*COUNT, 5),
            "chains": COUNT,
            "model": NO_MODEL,
            "epsilon": (
                *[v for v in POSITIVE if v is not None],
                {"z": 1.0},
                {"y": "a"},
                {"y": None},
                1j,
            ),
            "optimum": [value for value in NO_OPTIMUM if value is not None],
            "adjustment": ADJUSTMENT,
            "threshold": SHARE,
            "refine": FLAG,
            "start": (3, "mu", {"nu": [1.0]}, [{}, {}], {"mu": [1.0]}),
            "cores": but_none(COUNT),
            "return_inferencedata": FLAG,
            "idata_kwargs": (3, "dims", {"model": 1}, {"dims": 1}, {"log_prior": 1}),
            "var_names": (3, "nu", [], [1], ["nu"]),
            "max_stages": but_none(COUNT),
            **BUDGETS,
            "checkpoint": (3, True, "", b"a", "/dev/null/run.nc", "/"),
            "random_seed": SEED,
            "progressbar": FLAG,
        },
        {"refine": False},
    ),
    "sample": Row(
        lambda **given: prb.sample(
            **{"model": model(), "optimum": optimum(), "draws": 20, "chains": 1} | QUIET | given
        ),
        {
            "draws": (*COUNT, 5),
            "chains": COUNT,
            "model": NO_MODEL,
            "optimum": [value for value in NO_OPTIMUM if value is not None],
            "idata_kwargs": (3, "dims", {"model": 1}, {"dims": 1}, {"log_prior": 1}),
            "var_names": (3, "nu", [], [1], ["nu"]),
            **BUDGETS,
            "random_seed": SEED,
            "progressbar": FLAG,
        },
    ),
    "posterior.BatchedKernel": Row(
        lambda **given: prb.posterior.BatchedKernel(
            **{"model": with_epsilon(), "draws": 20} | given
        ),
        {"draws": COUNT, "model": NO_MODEL, "threshold": SHARE, "random_seed": SEED},
    ),
    "bootstrap": Row(
        of_optimum(prb.bootstrap),
        {
            "optimum": NO_OPTIMUM,
            "draws": (*COUNT, 1),
            "parametric": FLAG,
            "random_seed": SEED,
            "progressbar": FLAG,
        },
        {"draws": 10},
    ),
    "simulation_based_calibration": Row(
        with_model(prb.simulation_based_calibration),
        {
            "n": (*COUNT, 1),
            "model": NO_MODEL,
            "draws": (*COUNT, 5),
            "adjustment": ADJUSTMENT,
            "executor": EXECUTOR,
            "random_seed": SEED,
            "progressbar": FLAG,
        },
    ),
    "compare": Row(
        prb.compare,
        {
            "results": (None, {}, 3, "a", {"a": "b"}, {"a": None}, {"a": xr.DataTree()}, {"": 3}),
            "model": (3, "model"),
            "metrics": ("area", ["area"], [prb.AreaMetric], 3, [None]),
        },
        {"results": Name("results"), "model": Name("model")},
    ),
    "diagnose": Row(
        prb.diagnose,
        {"result": NO_RESULT, "model": (3, "model", Name("bare"))},
        {"result": Name("optimum")},
    ),
    "predict": Row(
        predict,
        {
            "result": NO_RESULT,
            "response": (3, "line", None),
            "input": (None, "a", np.nan, 3.0, pm.Normal),
            "model": (3, "model", Name("bare")),
            "n_samples": (*COUNT, 1),
            "n_draws": COUNT,
            "stored": FLAG,
            "max_lost": but_none(LOST),
            "name": (3, "", True),
            **CALLING,
            "random_seed": SEED,
            "progressbar": FLAG,
        },
    ),
    "decision.Mean": Row(prb.decision.Mean, NO_RESPONSE),
    "decision.StandardDeviation": Row(prb.decision.StandardDeviation, NO_RESPONSE),
    "decision.Quantile": Row(
        prb.decision.Quantile,
        {**NO_RESPONSE, "probability": SHARE},
        {"response": line, "probability": 0.9},
    ),
    "decision.Exceedance": Row(
        prb.decision.Exceedance,
        {**NO_RESPONSE, "limit": NO_LIMIT, "below": FLAG},
        {"response": line, "limit": 1.0},
    ),
    "sensitivity": Row(
        with_decision(prb.sensitivity),
        {
            "result": NO_RESULT,
            "quantity": (None, "mean", 3, prb.decision.Mean, np.mean),
            "model": (3, "model", Name("bare")),
            "n_samples": (*COUNT, 31),
            "computed": FLAG,
            "random_seed": SEED,
        },
    ),
    "decision.Condition": Row(
        prb.decision.Condition,
        {**NO_RESPONSE, "metric": but_none(NO_METRIC)},
        {"response": line},
    ),
    "decision.Interval": Row(
        prb.decision.Interval,
        {"low": NO_LIMIT, "high": (*NO_LIMIT, 0.0)},
        {"low": 0.0, "high": 1.0},
    ),
    "plan": Row(
        with_decision(prb.plan),
        {
            "result": NO_RESULT,
            "candidates": (None, {}, 3, {"a": 3}, {3: prb.decision.Condition(line)}, [1]),
            "k": (*[v for v in COUNT if v != [64]], [], [0], "ab"),
            "model": (3, "model", Name("bare")),
            "quantity": ("mean", 3, prb.decision.Mean),
            "target": ({}, 3, {"tau": 1.0}, {"mu": 0.0}, {"mu": "a"}, {"quantity": 1.0}),
        },
    ),
    "exceedance": Row(
        with_decision(prb.exceedance),
        {
            "result": NO_RESULT,
            "response": (3, "line", None),
            "limit": NO_LIMIT,
            "input": (None, "a", np.nan, 3.0, pm.Normal),
            "model": (3, "model", Name("bare")),
            "output": (0, "a"),
            "below": FLAG,
            "prob": SHARE,
            "n_draws": (*COUNT, 1),
            "points": (-1, 5, 1.5, "a", None, True),
            "steps": (*COUNT, 1),
            "executor": EXECUTOR,
            "random_seed": SEED,
        },
    ),
    "decision.p_box": Row(
        with_decision(prb.decision.p_box),
        {
            "result": NO_RESULT,
            "response": (3, "line", None),
            "input": (None, "a", np.nan, 3.0, pm.Normal),
            "model": (3, "model", Name("bare")),
            "output": (0, "a"),
            "prob": SHARE,
            "n_draws": (*COUNT, 1),
            "steps": (*COUNT, 1),
        },
    ),
    "plots.plot_prediction": Row(
        prb.plots.plot_prediction,
        {
            **{k: PICTURE[k] for k in ("labels", "figsize")},
            "observed": ("a", None, [], np.ones((3, 2)), {"a": [1.0]}),
            "predicted": (3, None, np.ones((2, 3)), {"a": 3}),
            "prob": SHARE,
        },
        {"observed": FRESH_DATA, "predicted": Name("predicted")},
    ),
    "plots.plot_sensitivity": Row(
        prb.plots.plot_sensitivity,
        {
            **{k: PICTURE[k] for k in ("labels", "figsize")},
            "table": (
                *(None, 3, xr.Dataset(), xr.Dataset({"first": 1.0, "total": 1.0})),
                *(Name("comparison"), Name("posterior")),
            ),
        },
        {"table": Name("influences")},
    ),
    "validation.u_values": Row(
        prb.validation.u_values,
        {
            "observed": ([], [np.nan], "a", None, OBSERVED > 2, np.ones((3, 3)), {"a": OBSERVED}),
            "predicted": (
                None,
                1.0,
                [],
                "a",
                np.array(["a"]),
                xr.DataArray([1.0, 2.0]),
                OBSERVED > 2,
            ),
            "randomize": FLAG,
            "random_seed": SEED,
        },
        {"observed": FRESH_DATA, "predicted": Name("predicted")},
    ),
    "area_test": Row(
        lambda **given: prb.area_test(**{"null": prb.validation.PosteriorNull(19)} | QUIET | given),
        {
            "observed": ([], [np.nan], "a", None, OBSERVED > 2, np.ones((3, 3)), {"a": OBSERVED}),
            "predicted": (
                None,
                1.0,
                [],
                "a",
                np.array(["a"]),
                xr.DataArray([1.0, 2.0]),
                OBSERVED > 2,
            ),
            "alpha": SHARE,
            "null": ("exact", 3, prb.validation.ExactModel),
            "specimens": ([1, 2], "abc", [None] * 9, [np.nan] * 9, 3, [[1]] * 9),
            "folded": FLAG,
            "randomize": FLAG,
            "random_seed": SEED,
            "progressbar": FLAG,
        },
        {"observed": FRESH_DATA, "predicted": Name("predicted")},
    ),
    "validation.PosteriorNull": Row(
        prb.validation.PosteriorNull, {"replicates": (*COUNT, 5), "random_seed": SEED}
    ),
    "validation.JointNull": Row(
        lambda **given: prb.validation.JointNull(**{"optimum": optimum()} | given),
        {
            "optimum": NO_OPTIMUM,
            "responses": (3, "line", [line], {"y": 3}, (3,)),
            "replicates": (*COUNT, 5),
            "random_seed": SEED,
        },
    ),
    "validation.ExactModel.critical_value": Row(
        prb.validation.ExactModel().critical_value, {"n": COUNT, "alpha": SHARE}, {"n": 9}
    ),
    "validation.ExactModel.p_value": Row(
        prb.validation.ExactModel().p_value,
        {"n": COUNT, "statistic": (-1.0, np.nan, "a", None, True)},
        {"n": 9, "statistic": 0.1},
    ),
    "cross_validate": Row(
        of_optimum(prb.cross_validate),
        {
            "optimum": NO_OPTIMUM,
            "folds": (*but_none(COUNT), 1, 29),
            "random_seed": SEED,
            "progressbar": FLAG,
        },
    ),
    "rank": Row(
        lambda **given: prb.rank(
            **{"candidates": {"a": optimum(), "b": optimum()}} | QUIET | given
        ),
        {
            "candidates": (
                Name("optimum"),
                Name("one_candidate"),
                Name("candidates_of_other_types"),
                Name("candidates_without_names"),
                {},
                [],
                None,
            ),
            "folds": (*but_none(COUNT), 1, 29),
            "random_seed": SEED,
            "progressbar": FLAG,
        },
    ),
    "Surrogate.fit": Row(
        fit,
        {
            "response": (3, "line", None),
            "inputs": (
                {},
                [],
                3,
                "ab",
                None,
                {"x": (1, 0)},
                {"x": (1, 1)},
                {"x": (0, np.inf)},
                {"x": (0, np.nan)},
                {"x": "ab"},
                {"x": 3.0},
                {"x": None},
                {"x": (0, True)},
                {"x": (0, 1, 2)},
                {3: (0, 1)},
            ),
            "n": (*COUNT, 1),
            "model": ("rbf", 3, prb.surrogate.RadialBasis),
            "outside": (3, "nan", prb.response.Retry(), prb.response.Abort),
            "prob": SHARE,
            "name": (*TEXT, "", None),
            **CALLING,
            "on_failure": ("abort", prb.response.Abort, 3),
            "retry_failed": FLAG,
            "random_seed": SEED,
            "progressbar": FLAG,
        },
    ),
    "Surrogate": Row(lambda x: surrogate()(x), {"x": ("a", None, [True], 1j, [[1.0], [1.0, 2.0]])}),
    "Surrogate.local_error": Row(lambda x: surrogate().local_error(x), {"x": ("a", None, [True])}),
    "Surrogate.with_error": Row(
        lambda random_seed: surrogate().with_error(random_seed), {"random_seed": SEED}
    ),
    "Surrogate.save": Row(
        lambda path: surrogate().save(path), {"path": (3, None, True, "/dev/null/a.nc", "/", "")}
    ),
    "Surrogate.load": Row(
        prb.Surrogate.load, {"path": (3, None, True, "/dev/null/a.nc", "/", "", __file__)}
    ),
    "surrogate.Polynomial": Row(prb.surrogate.Polynomial, {"degree": (-1, 1.5, "a", True, None)}),
    "surrogate.RadialBasis": Row(
        prb.surrogate.RadialBasis,
        {
            "kernel": ("x", 3, None),
            "degree": (-2, 1.5, "a", True),
            "smoothing": (-1.0, np.nan, "a", True, None),
        },
    ),
    "Report": Row(
        report,
        {
            "title": (3, "", "  ", None),
            "sections": (3, [1], "text", [None]),
            "author": (3, None, ["a"]),
            "date": (3, None, 2024.5),
            "model": (3, "model"),
            "optimum": (3, "optimum", {"a": 3}, xr.DataTree(), Name("comparison")),
            "posterior": (3, "posterior", {"a": 3}, xr.DataTree(), Name("optimum")),
            "validity": (3, "test", {"a": 3}, Name("comparison")),
            "comparison": (3, "table", Name("optimum"), xr.Dataset()),
            "decision": (3, "risk", xr.Dataset(), {"a": 3}, Name("comparison")),
            "pictures": FLAG,
            "validation": (3, [1], {"a": 3}, {3: ([1.0], Name("predicted"))}, {"a": ([1.0], 3)}),
            "labels": ("mu", {"mu": 3}, {"no such name": "mean"}),
        },
    ),
    "Report.to_html": Row(lambda path: report().to_html(path), {"path": (3, None, True, "/", "")}),
    "Report.to_markdown": Row(
        lambda folder: report().to_markdown(folder), {"folder": (3, None, True, __file__, "")}
    ),
    "Report.with_section": Row(
        lambda **given: report().with_section(**given),
        {"section": ("x", None, 3), "after": ("no such title", 3)},
        {"section": prb.reports.Section("A")},
    ),
    "reports.Section": Row(
        prb.reports.Section,
        {
            "title": (3, "", " ", None),
            "text": (3, None, [3], b"a"),
            "table": (3, "a", [1, 2], {"a": 1}),
            "picture": ("x.png", 3, b"xx", b""),
            "alt": (3, None, ""),
            "caption": (3, None),
            "level": (1, 9, "2", None, 2.5, True),
        },
        {"title": "A", "picture": b"<svg/>", "alt": "a"},
    ),
    "response.Store": Row(
        prb.response.Store,
        {
            "folder": (3, None, True, ""),
            "name": (3, None, ""),
            "columns": (0, -1, 1.5, "a", True),
            "version": VERSION,
        },
        {"folder": "/dev/null/folder", "name": "y", "columns": 1},
    ),
    **{
        f"{f.__name__}": Row(
            f,
            {
                argument: NO_OPTIMUM,
                **{k: v for k, v in PICTURE.items() if k in names},
                **more,
            },
            {argument: Name(good)},
        )
        for f, argument, good, names, more in (
            (
                prb.plot_landscape,
                "optimum",
                "optimum",
                ("labels", "model"),
                {
                    "pair": (("mu", "zz"), ("mu", "mu"), (), 3, {3}),
                    "points": (0, -1, 1.5, "a", True),
                    "responses": (-1, 1.5, "a", True, None),
                },
            ),
            (prb.plot_optimizer, "optimum", "optimum", ("labels",), {}),
        )
    },
    "plot_outputs": Row(
        prb.plot_outputs,
        {
            **PICTURE,
            "result": [bad for bad in NO_RESULT if bad != Name("comparison")],
            "simulator": (3, "zz", ["y"]),
            "outputs": (3, "zz", [], [3], ["zz", "y"]),
            "before": ("prior", 3, {"zz": 1.0}),
            "n_draws": (0, 1.5, "a", True),
        },
        {"result": Name("of_two_outputs"), "model": Name("two_outputs")},
    ),
    "plot_population": Row(
        prb.plot_population,
        {
            **PICTURE,
            "result": NO_RESULT,
            "inputs": (3, "zz", [], [3], ["zz"]),
            "prob": SHARE,
            "n_draws": (0, 1.5, "a", True),
        },
        {"result": Name("posterior"), "model": Name("model")},
    ),
    "plot_posterior": Row(
        prb.plot_posterior,
        {
            **PICTURE,
            "posterior": NO_RESULT,
            "optimum": (3, "a", Name("posterior")),
            "prob": SHARE,
        },
        {"posterior": Name("posterior"), "model": Name("model")},
    ),
    "plot_responses": Row(
        prb.plot_responses,
        {
            **PICTURE,
            "result": NO_RESULT,
            "before": ("prior", 3, {"zz": 1.0}, {"mu": "a"}),
            "ecdf": FLAG,
            "prob": SHARE,
            "n_draws": (0, 1.5, "a", True),
        },
        {"result": Name("posterior"), "model": Name("model")},
    ),
    "plot_stages": Row(
        prb.plot_stages,
        {"labels": PICTURE["labels"], "posterior": NO_RESULT},
        {"posterior": Name("posterior")},
    ),
    "plot_comparison": Row(
        prb.plot_comparison,
        {
            "labels": PICTURE["labels"],
            "comparison": (None, 3, "a", xr.Dataset(), Name("optimum"), Name("posterior")),
            "scores": FLAG,
        },
        {"comparison": Name("comparison")},
    ),
    "plot_validity": Row(
        prb.plot_validity,
        {"tests": (None, 3, {}, {"a": 3}, Name("comparison"))},
        {"tests": Name("validity")},
    ),
}


def results() -> dict[str, Any]:
    return {"optimum": optimum(), "posterior": posterior()}


def cases() -> Iterator[Any]:
    for name, row in TABLE.items():
        for argument, values in row.bad.items():
            for place, value in enumerate(values):
                # Without addresses, which differ between processes.
                label = " ".join(re.sub(r" at 0x\w+", "", repr(value))[:40].split())
                # By default the first ones of each argument.
                marks = [pytest.mark.slow] if place >= 3 else []
                yield pytest.param(
                    name, argument, value, id=f"{name} {argument}={label}", marks=marks
                )


@pytest.fixture(scope="module", autouse=True)
def _shared() -> None:
    """Make what is shared before the response's calls are counted."""
    first_use(with_epsilon())
    for one in (posterior, predicted, validity, surrogate, comparison):
        one()


CASES = list(cases())
# What an argument is called in a message, where that is not its name.
WORDS = {
    "result": "expected an optimum",
    "tests": "expected a validitytest",
    "x": "x: ",
}


@pytest.mark.parametrize(("name", "argument", "value"), CASES)
def test_a_bad_argument_is_told_before_the_response_is_called(
    name: str, argument: str, value: Any
) -> None:
    row = TABLE[name]
    given = {key: made(one) for key, one in row.good.items()} | {argument: made(value)}
    before, clock = called, time.process_time()
    with pytest.raises((TypeError, ValueError, KeyError, prb.response.StoreError)) as caught:
        row.call(**given)
    text = str(caught.value).lower()
    assert "got" in text, text
    assert "expected" in text, text
    assert WORDS.get(argument, argument).lower() in text, text
    assert called == before
    assert time.process_time() - clock < 1.0


def test_every_public_name_has_a_row() -> None:
    assert len(CASES) >= 1300
    # Names of packages and of what calls give back; the constructor of data has no arguments, nor
    # has the area metric; whoever writes a metric of his own derives from the class.
    spared = {
        "datasets",
        "metrics",
        "posterior",
        "propagation",
        "reports",
        "response",
        "decision",
        "plots",
    }
    spared |= {"surrogate", "validation", "Diagnosis", "Optimum", "AreaMetric", "Metric"}
    assert set(prb.__all__) - spared <= set(TABLE)
