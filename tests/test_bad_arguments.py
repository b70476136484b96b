"""Every argument of every public name refuses bad values: a sentence, soon, before the response is called.

Bad values follow from the name or the annotation of an argument. `TABLE` has good arguments for
each public name, and bad ones that are its own.
"""

from __future__ import annotations

import inspect
import re
import sys
import time
from collections.abc import Callable, Iterator
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
AREA = {"metric": prb.AreaMetric(), "observed": OBSERVED}
calls = 0


def line(x: Any, *constants: Any) -> Any:
    global calls
    calls += np.size(x)
    return 2.0 * x


# -- shared models and results, made at their first use ------------------------------------------


def simulated(response: Any = line, *constants: Any, **settings: Any) -> pm.Model:
    with pm.Model(coords={"specimen": range(30), "few": range(3)}) as made:
        x = pm.Normal.dist(pm.Normal("mu", 1, 1), 1.0, name="x")
        try:
            prb.Simulator(
                settings.pop("name", "y"), response, x, *constants, **QUIET | AREA | settings
            )
        finally:
            assert [rv.name for rv in made.basic_RVs][1:] in ([], ["y"])
    return made


@cache
def model() -> pm.Model:
    return simulated(propagation=prb.Reweighted(256))


@cache
def with_epsilon() -> pm.Model:
    return simulated(epsilon=0.1, propagation=prb.Reweighted(64))


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
    settings = {"model": model(), "optimum": optimum(), "refine": False, "random_seed": 1}
    return prb.sample_smc(20, chains=2, **settings, **QUIET)


@cache
def two_outputs() -> pm.Model:
    data = {"first": OBSERVED, "second": np.square(OBSERVED)}
    settings = {"metric": prb.Joint(prb.AreaMetric()), "propagation": prb.Resimulated(64)}
    return simulated(lambda x: {"first": x, "second": np.square(x)}, observed=data, **settings)


@cache
def of_two_outputs() -> prb.Optimum:
    settings = {"method": "Nelder-Mead", "refine": False, "starts": 0}
    return prb.minimize(two_outputs(), **settings, **QUIET)


@cache
def mean() -> Any:
    return prb.decision.Mean(line, specimen())


@cache
def influences() -> xr.Dataset:
    return prb.sensitivity(posterior(), mean(), model=model())


@cache
def predicted() -> xr.DataArray:
    return prb.predict(posterior(), line, specimen(), model=model(), n_samples=50, **QUIET)


@cache
def comparison() -> xr.Dataset:
    return prb.compare(results(), model=model())


@cache
def validity() -> prb.validation.ValidityTest:
    null = prb.validation.PosteriorNull(19)
    return prb.area_test(FRESH_DATA, predicted(), null=null, **QUIET)


@cache
def surrogate() -> prb.Surrogate:
    return prb.Surrogate.fit(np.square, {"x": (0, 1)}, 20, **QUIET)


@cache
def results() -> dict[str, Any]:
    return {"optimum": optimum(), "posterior": posterior()}


@cache
def two_optima() -> dict[str, Any]:
    return {"a": optimum(), "b": optimum()}


@cache
def one_candidate() -> dict[str, Any]:
    return {"a": optimum()}


@cache
def candidates_of_other_types() -> dict[str, Any]:
    return {"a": optimum(), "b": comparison()}


@cache
def candidates_without_names() -> dict[int, Any]:
    return {1: optimum(), 2: optimum()}


@cache
def same_condition() -> dict[str, Any]:
    return {"same": prb.decision.Condition(line, specimen())}


def made(value: Any) -> Any:
    return value() if hasattr(value, "cache_info") else value


# -- bad values by the name or the annotation of an argument -----------------------------------------

FLAG = ("no", 1, 0.0, None, [])
COUNT = (0, -5, 1.5, 64.0, "64", None, True, np.nan, [64])
SHARE = (0, 1, -0.5, 5, "a", np.nan, None, True)
POSITIVE = (0, -1.0, np.nan, np.inf, "a", True, None, [0.1])
SEED = (-1, 1.5, 2.0, True, "a", np.nan, [1.5], [])
NO_METRIC = ("area", 3, prb.AreaMetric, np.mean, None)
NO_DATA = (
    *(OBSERVED > 2, ["a", "b", "c"], [1.0, np.nan, 2.0], [], 1.0, np.ones((3, 2)), None),
    *({"a": OBSERVED}, [1j, 2.0], [[1.0], [1.0, 2.0]], ["1.0", 2.0, None], [10**400, 1.0]),
    np.array(["2020-01-01", "2021-01-01"], dtype="M8[D]"),
    np.array([1, 2], dtype="m8[s]"),
    np.ma.masked_array([1.0, 2.0, 3.0], [0, 1, 0]),
)
NEW_DATA = ([], [np.nan], "a", None, OBSERVED > 2, np.ones((3, 3)), {"a": OBSERVED})
NO_WEIGHTS = (np.ones(3), -np.ones(30), np.zeros(30), "abc", OBSERVED > 2)
NO_PREDICTION = (*(None, 1.0, [], "a", np.array(["a"]), xr.DataArray([1.0, 2.0]), OBSERVED > 2),)
NO_INPUT = (None, "a", np.nan, 3.0, pm.Normal)
SOME = (0, 1.5, "a", True)
NO_FILE = (3, None, True, "/dev/null/a.nc", "/", "")
BY_NAME: dict[str, tuple[Any, ...]] = {
    "adjustment": ("affine", "none", True, False, 1, np.nan, ["estimate"]),
    "alpha": SHARE,
    "coarse": (3, "line"),
    "checkpoint": (3, True, "", b"a", "/dev/null/run.nc", "/"),
    "density": (0.3, prb.GaussianKDE, "kde", None),
    "executor": (4, map, "processes", object()),
    "figsize": (3, "wide", (3,), (0, 4), (np.inf, 4), ("a", 4)),
    "folds": (*COUNT, 1, 29),
    "idata_kwargs": (3, "dims", {"model": 1}, {"dims": 1}, {"log_prior": 1}),
    "labels": ("mu", 3, ["mu"], {"mu": 3}, {3: "mu"}, {"no such name": "mean"}),
    "limit": ("a", None, np.nan, np.inf, True, [1.0]),
    "max_lost": (1.0, -0.1, np.nan, "a", None, True, False),
    "max_seconds": POSITIVE,
    "metric": NO_METRIC,
    "model": (3, "model", bare),
    "observed": NEW_DATA,
    "on_failure": ("abort", prb.response.Abort, None, 3),
    "optimum": (3, "optimum", posterior, model, {"mu": 1.0}, None),
    "output": (0, "a"),
    "predicted": NO_PREDICTION,
    "prob": SHARE,
    "probability": SHARE,
    "response": (3, "line", None, dict),
    "result": (None, 3, "result", xr.DataTree(), comparison, []),
    "seen": (None, "x", 1.0, [1.0], [1.0, 1.0], [0.0, np.inf], [[0.0, 1.0]]),
    "shape": (3, "line", lambda c: np.nan * c, lambda c: 1.0),
    "store": (4, True, b"folder", ""),
    "threshold": SHARE,
    "timeout": POSITIVE,
    "tolerance": POSITIVE,
    "var_names": (3, "nu", [], [1], ["nu"]),
    "version": (2, 1.5, True, ""),
}
BY_ANNOTATION: dict[str, tuple[Any, ...]] = {
    "bool": FLAG,
    "int": COUNT,
    "int | None": COUNT,
    "Seed": SEED,
}


def bad_values(name: str, annotation: str) -> tuple[Any, ...]:
    """Return what an argument refuses, none if there is no rule; None is good where it says so."""
    if name == "random_seed":
        # Configuration takes an integer, and not the other seeds of PyMC.
        bad = (*SEED, [1, 2], np.random.default_rng(1), None) if annotation == "int" else SEED
    else:
        bad = BY_NAME.get(name, BY_ANNOTATION.get(annotation, ()))
    return tuple(v for v in bad if v is not None or "None" not in annotation)


# -- the table -------------------------------------------------------------------------------------


class Row:
    """A public name: good arguments, how it is called, and bad values that are its own."""

    def __init__(
        self, good: dict[str, Any] | None = None, /, *, call: Any = None, **bad: tuple[Any, ...]
    ) -> None:
        self.good = good or {}
        self.call = call
        self.bad = bad


def simulator(response: Any = line, constant: Any = 1.0, **settings: Any) -> Any:
    return simulated(response, constant, **settings)


def in_groups(labels: Any) -> xr.DataArray:
    return xr.DataArray(OBSERVED, {"supplier": ("specimen", labels)}, "specimen")


def group(dim: Any = "supplier", coords: Any = None, observed: Any = None) -> Any:
    with pm.Model(coords=coords or {"supplier": ["a", "b"]}):
        x = pm.Normal.dist(pm.Normal("mu", 1, 1, shape=2)[prb.response.group(dim)], 1.0)
        data = in_groups(["a", "b"] * 15) if observed is None else observed
        return prb.Simulator("y", line, x, metric=prb.AreaMetric(), observed=data, **QUIET)


def with_inputs(function: Callable[..., Any], *first: str) -> Callable[..., Any]:
    """Return a call of a function with an input of the response after its first arguments."""

    def call(**settings: Any) -> Any:
        known = {"result": posterior, "response": line, "limit": 1.0, "input": specimen}
        positional = [made(settings.pop(name, known[name])) for name in (*first, "input")]
        return function(*positional, **settings)

    return call


def report(**settings: Any) -> prb.Report:
    return prb.Report(**{"title": "A", "optimum": optimum(), "pictures": False} | settings)


ON_MODEL = {"model": model}
SMALL = {"model": model, "optimum": optimum, "draws": 20, "chains": 1, **QUIET}
TIMEOUT = (*POSITIVE[:-2], 5.0)  # without processes
TABLE: dict[str, Row] = {
    "Simulator": Row(
        call=simulator,
        name=(None, 3, "", "  ", "mu", b"y", ["y"]),
        constant=(None, "a", np.nan, np.inf, pm.Normal, ["a"], 1j, True, {"a": 1}),
        observed=(*NO_DATA, [1.0]),
        epsilon=(*POSITIVE[:-2], {"y": 1.0}, 1j),
        weights=(
            *(np.ones(29), np.ones((2, 30)), np.r_[-1, np.ones(29)], np.r_[np.nan, np.ones(29)]),
            *(np.zeros(30), OBSERVED > 2, "abc", 1.0),
        ),
        specimens=(
            *(range(29), [None] * 30, [*range(29), None], [np.nan] * 30, [*"a" * 29, np.nan]),
            *(np.ones((30, 1)), "abc", 3, {"a": 1}, [True] * 30, [[1]] * 30),
        ),
        dims=("nope", 3, "few", "", ("few", "few"), True),
        propagation=(64, "reweighted", prb.Reweighted, prb.AreaMetric()),
    ),
    "Reweighted": Row(max_points=(3, 0, 1.5, "a", True), emulator=(3, "a"), timeout=TIMEOUT),
    "Resimulated": Row(n=(*COUNT, 1), points=("halton", 3, None, True), timeout=TIMEOUT),
    "Fresh": Row(timeout=TIMEOUT),
    "response.Abort": Row(),
    "response.Additive": Row({"seen": [0.0, 1.0]}),
    "response.Multiplicative": Row({"seen": [0.0, 1.0]}),
    "response.group": Row(
        call=group,
        dim=(None, 3, "", "batch", ["supplier"]),
        coords=(
            *({"supplier": ["a"]}, {"supplier": ["a", "a"]}, {"supplier": ["a/b", "c"]}),
            {"other": ["a", "b"]},
        ),
        observed=(
            *(OBSERVED, OBSERVED.tolist(), in_groups(["a"] * 30), in_groups(["a"] * 29 + ["b"])),
            *(in_groups(["a", "b", "c"] * 10), in_groups([None] * 30)),
        ),
    ),
    "response.Replace": Row(value=("x", None, -np.inf, True, [1.0], 1j)),
    "response.Retry": Row(then=(None, "abort", prb.response.Retry(), prb.response.Abort)),
    "response.Store": Row(
        {"folder": "/dev/null/folder", "name": "y", "columns": 1},
        folder=(3, None, True, ""),
        name=(3, None, ""),
        columns=(0, -1, 1.5, "a", True),
    ),
    "scalar": Row(function=(3, "f", None)),
    "command": Row(
        {"arguments": [sys.executable, "{x}"], "inputs": ["x"], "read": float},
        arguments=([], "ls", 3, None, [3], [sys.executable, None]),
        inputs=("x", 3, None, ["y"], ["x", "x"], ["a b"], [3]),
        read=(3, "float", None),
        write=(3, "in.txt", {"../in.txt": "{x}"}, {"/in.txt": "{x}"}, {3: "{x}"}, {"a": 3}),
        folder=(3, "", b"folder"),
    ),
    "umbridge": Row(
        {"url": "http://127.0.0.1:9"},
        url=(3, "", "localhost:4242", None, "ftp://localhost", "http://"),
        model=(3, "", None, ["forward"]),
        config=(3, "level", {"level": np.arange(2)}, [1]),
        patience=POSITIVE,
    ),
    "fmu": Row(
        {"path": __file__, "inputs": ["x"], "outputs": ["y"]},
        path=(3, "", None, b"unit.fmu"),
        inputs=("x", [], None, ["x", "x"], [3]),
        outputs=("y", [], None, ["y", "y"], {"a": 3}),
        parameters=(3, "m", {3: 1.0}, ["m"]),
    ),
    "ProbabilityResidual": Row(scale_base=POSITIVE),
    "KullbackLeibler": Row(),
    "LogLikelihood": Row(
        error=("a", 0, -1.0, True),
        gross_errors=(-1.0, 2.0),
        censored=(3, (1.0,), ("a", "b")),
        rounded=("a", -1.0),
    ),
    "FunctionMetric": Row({"function": np.mean}, function=(3, "f", None)),
    "Joint": Row({"metric": prb.AreaMetric()}, metric=(*NO_METRIC, prb.Joint(prb.AreaMetric()))),
    "MarginalCorrelation": Row(
        {"metric": prb.AreaMetric()},
        metric=(*NO_METRIC, prb.Joint(prb.AreaMetric())),
        weights=(*(1.0, "ab", None, [1.0, 1.0], (1.0,), (1.0, 0.0), (1.0, -2.0), (np.nan, 1.0)),),
    ),
    "GaussianKDE": Row(bandwidth=POSITIVE[:-2]),
    "Histogram": Row(bins=(0, -3, 1.5, "a", True, [3.0, 2.0, 1.0], np.nan)),
    "abc_distance": Row(),
    "a metric": Row(
        {"simulated": OBSERVED, "observed": OBSERVED},
        call=prb.AreaMetric(),
        simulated=([1.0, np.nan], [], "a", OBSERVED > 2, None, 1.0),
        observed=NO_DATA,
        weights=NO_WEIGHTS,
    ),
    "a metric of several outputs": Row(
        {"simulated": OUTPUTS, "observed": OUTPUTS},
        call=prb.Joint(prb.AreaMetric()),
        simulated=(np.full((9, 2), np.nan), np.ones((9, 3)), OUTPUTS[:, 0], "a", None, []),
        observed=(
            *(OUTPUTS[None], OUTPUTS[:3], OUTPUTS * [1, 0], OUTPUTS * [1, np.nan]),
            *(OUTPUTS * [1, -np.inf], OUTPUTS * np.nan, OUTPUTS[:, [0, 0]], OUTPUTS > 2),
        ),
        weights=NO_WEIGHTS,
    ),
    "minimize": Row(
        {**ON_MODEL, "refine": False, **QUIET},
        start=(
            *({"nu": 1.0}, {"mu": "a"}, {"mu": np.nan}, {"mu": [1.0, 2.0]}, {"mu": True}, {}),
            *([1.0], 1.0),
        ),
        method=("BFSG", 3, prb.AreaMetric, ""),
        options=("maxiter", 3, ["maxiter"], {"nonsense": 1}, {3: 1}),
        starts=(-1, 1.5, "many", True),
    ),
    "refine": Row(
        {**ON_MODEL, "thetas": [[1.0]], **QUIET},
        thetas=(
            *({"mu": 1.0}, "a", 3.0, [[1.0, 2.0]], [1.0], [[np.nan]], [["a"]], [[True]]),
            np.empty((0, 1)),
        ),
    ),
    "cost": Row(ON_MODEL, model=(3, "model", bare, print, optimum)),
    "set_epsilon": Row(
        {**ON_MODEL, "epsilon": {}},
        model=(None, 3, "model", bare),
        epsilon=(
            *(0.1, None, "a", ["y"], {"z": 1.0}, {"y": True}, {"y": 0}, {"y": np.nan}),
            *({"y": None}, {3: 1.0}),
        ),
    ),
    "calibrate_epsilon": Row(),
    "sample_smc": Row(
        {**SMALL, "adjustment": None, "refine": False},
        draws=(*COUNT, 5),
        epsilon=(*POSITIVE[:-2], {"z": 1.0}, {"y": "a"}, {"y": None}, 1j),
        start=(3, "mu", {"nu": [1.0]}, [{}, {}], {"mu": [1.0]}),
    ),
    "sample": Row(SMALL, draws=(*COUNT, 5)),
    "posterior.BatchedKernel": Row({"model": with_epsilon, "draws": 20}),
    "bootstrap": Row({"optimum": optimum, "draws": 10, **QUIET}, draws=(*COUNT, 1)),
    "simulation_based_calibration": Row({**ON_MODEL, **QUIET}, n=(*COUNT, 1), draws=(*COUNT, 5)),
    "compare": Row(
        {"results": results, **ON_MODEL},
        results=(None, {}, 3, "a", {"a": "b"}, {"a": None}, {"a": xr.DataTree()}, {"": 3}),
        metrics=("area", ["area"], [prb.AreaMetric], 3, [None]),
    ),
    "diagnose": Row({"result": optimum}),
    "predict": Row(
        {**ON_MODEL, **QUIET},
        call=with_inputs(prb.predict, "result", "response"),
        input=NO_INPUT,
        n_samples=(*COUNT, 1),
        name=(3, "", True),
    ),
    "decision.Mean": Row(output=()),
    "decision.StandardDeviation": Row(output=()),
    "decision.Quantile": Row({"response": line, "probability": 0.9}, output=()),
    "decision.Exceedance": Row({"response": line, "limit": 1.0}, output=()),
    "decision.Condition": Row({"response": line}),
    "decision.Interval": Row(
        {"low": 0.0, "high": 1.0}, low=BY_NAME["limit"], high=(*BY_NAME["limit"], 0.0)
    ),
    "sensitivity": Row(
        {"result": posterior, "quantity": mean, **ON_MODEL},
        quantity=(None, "mean", 3, prb.decision.Mean, np.mean),
        n_samples=(*COUNT, 31),
    ),
    "plan": Row(
        {"result": posterior, "candidates": same_condition, **ON_MODEL},
        candidates=(None, {}, 3, {"a": 3}, {3: prb.decision.Condition(line)}, [1]),
        k=(*COUNT[:-1], [], [0], "ab"),
        quantity=("mean", 3, prb.decision.Mean),
        target=({}, 3, {"tau": 1.0}, {"mu": 0.0}, {"mu": "a"}, {"quantity": 1.0}),
    ),
    "exceedance": Row(
        ON_MODEL,
        call=with_inputs(prb.exceedance, "result", "response", "limit"),
        input=NO_INPUT,
        n_draws=(*COUNT, 1),
        points=(-1, 5, 1.5, "a", None, True),
        requirement=("a", 0, 2.0),
        steps=(*COUNT, 1),
    ),
    "decision.p_box": Row(
        ON_MODEL,
        call=with_inputs(prb.decision.p_box, "result", "response"),
        input=NO_INPUT,
        n_draws=(*COUNT, 1),
        steps=(*COUNT, 1),
    ),
    "validation.u_values": Row({"observed": FRESH_DATA, "predicted": predicted}),
    "area_test": Row(
        {
            **{"observed": FRESH_DATA, "predicted": predicted},
            **{"null": prb.validation.PosteriorNull(19), **QUIET},
        },
        null=("exact", 3, prb.validation.ExactModel),
        specimens=([1, 2], "abc", [None] * 9, [np.nan] * 9, 3, [[1]] * 9),
    ),
    "validation.PosteriorNull": Row(replicates=(*COUNT, 5), random_seed=SEED),
    "validation.JointNull": Row(
        {"optimum": optimum},
        responses=(3, "line", [line], {"y": 3}, (3,)),
        replicates=(*COUNT, 5),
        random_seed=SEED,
    ),
    "validation.ExactModel.critical_value": Row(
        {"n": 9}, call=prb.validation.ExactModel().critical_value
    ),
    "validation.ExactModel.p_value": Row(
        {"n": 9, "statistic": 0.1},
        call=prb.validation.ExactModel().p_value,
        statistic=(-1.0, np.nan, "a", None, True),
    ),
    "cross_validate": Row({"optimum": optimum, **QUIET}),
    "rank": Row(
        {"candidates": two_optima, **QUIET},
        candidates=(
            *(optimum, one_candidate, candidates_of_other_types, candidates_without_names),
            *({}, [], None),
        ),
    ),
    "Surrogate.fit": Row(
        {"response": line, "inputs": {"x": (0.0, 1.0)}, "n": 20, **QUIET},
        inputs=(
            *({}, [], 3, "ab", None, {"x": (1, 0)}, {"x": (1, 1)}, {"x": (0, np.inf)}),
            *({"x": (0, np.nan)}, {"x": "ab"}, {"x": 3.0}, {"x": None}, {"x": (0, True)}),
            *({"x": (0, 1, 2)}, {3: (0, 1)}),
        ),
        n=(*COUNT, 1),
        model=("rbf", 3, prb.surrogate.RadialBasis),
        points=("halton", 3),
        outside=(3, "nan", prb.response.Retry(), prb.response.Abort),
        name=(3, b"text", [], True, "", None),
    ),
    "a surrogate": Row(
        call=lambda x: surrogate()(x), x=("a", None, [True], 1j, [[1.0], [1.0, 2.0]])
    ),
    "Surrogate.local_error": Row(call=lambda x: surrogate().local_error(x), x=("a", None, [True])),
    "Surrogate.with_error": Row(call=lambda **given: surrogate().with_error(**given)),
    "Surrogate.save": Row(call=lambda path: surrogate().save(path), path=NO_FILE),
    "Surrogate.load": Row(path=(*NO_FILE, __file__), model=(), coarse=()),
    "surrogate.Polynomial": Row(degree=(-1, 1.5, "a", True, None)),
    "surrogate.RadialBasis": Row(
        kernel=("x", 3, None),
        degree=(-2, 1.5, "a", True),
        smoothing=(-1.0, np.nan, "a", True, None),
    ),
    "Report": Row(
        call=report,
        title=(3, "", "  ", None),
        sections=(3, [1], "text", [None]),
        author=(3, None, ["a"]),
        date=(3, None, 2024.5),
        optimum=(3, "optimum", {"a": 3}, xr.DataTree(), comparison),
        posterior=(3, "posterior", {"a": 3}, xr.DataTree(), optimum),
        validity=(3, "test", {"a": 3}, comparison),
        comparison=(3, "table", optimum, xr.Dataset()),
        decision=(3, "risk", xr.Dataset(), {"a": 3}, comparison),
        validation=(3, [1], {"a": 3}, {3: ([1.0], predicted)}, {"a": ([1.0], 3)}),
        labels=("mu", {"mu": 3}, {"no such name": "mean"}),
    ),
    "Report.to_html": Row(call=lambda path: report().to_html(path), path=(3, None, True, "/", "")),
    "Report.to_markdown": Row(
        call=lambda folder: report().to_markdown(folder), folder=(3, None, True, __file__, "")
    ),
    "Report.with_section": Row(
        {"section": prb.reports.Section("A")},
        call=lambda **given: report().with_section(**given),
        section=("x", None, 3),
        after=("no such title", 3),
    ),
    "reports.Section": Row(
        {"title": "A", "picture": b"<svg/>", "alt": "a"},
        title=(3, "", " ", None),
        text=(3, None, [3], b"a"),
        table=(3, "a", [1, 2], {"a": 1}),
        picture=("x.png", 3, b"xx", b""),
        alt=(3, None, ""),
        caption=(3, None),
        level=(1, 9, "2", None, 2.5, True),
    ),
    "plots.plot_prediction": Row(
        {"observed": FRESH_DATA, "predicted": predicted},
        observed=("a", None, [], np.ones((3, 2)), {"a": [1.0]}),
        predicted=(3, None, np.ones((2, 3)), {"a": 3}),
    ),
    "plots.plot_sensitivity": Row(
        {"table": influences},
        table=(
            *(None, 3, xr.Dataset(), xr.Dataset({"first": 1.0, "total": 1.0})),
            *(comparison, posterior),
        ),
    ),
    "plot_landscape": Row(
        {"optimum": optimum},
        pair=(("mu", "zz"), ("mu", "mu"), (), 3, {3}),
        points=(0, -1, 1.5, "a", True),
        responses=(-1, 1.5, "a", True, None),
    ),
    "plot_optimizer": Row({"optimum": optimum}),
    "plot_outputs": Row(
        {"result": of_two_outputs, "model": two_outputs},
        result=(None, 3, "result", xr.DataTree(), []),
        simulator=(3, "zz", ["y"]),
        outputs=(3, "zz", [], [3], ["zz", "y"]),
        before=("prior", 3, {"zz": 1.0}),
        n_draws=SOME,
    ),
    "plot_population": Row(
        {"result": posterior, **ON_MODEL},
        inputs=(3, "zz", [], [3], ["zz"]),
        n_draws=SOME,
    ),
    "plot_posterior": Row(
        {"posterior": posterior, **ON_MODEL},
        posterior=BY_NAME["result"],
        optimum=(3, "a", posterior),
    ),
    "plot_responses": Row(
        {"result": posterior, **ON_MODEL},
        before=("prior", 3, {"zz": 1.0}, {"mu": "a"}),
        n_draws=SOME,
    ),
    "plot_stages": Row({"posterior": posterior}, posterior=BY_NAME["result"]),
    "plot_comparison": Row(
        {"comparison": comparison},
        comparison=(None, 3, "a", xr.Dataset(), optimum, posterior),
    ),
    "plot_validity": Row({"tests": validity}, tests=(None, 3, {}, {"a": 3}, comparison)),
}


def public(name: str) -> Any:
    """Return a public object, None for a name that is a description."""
    value: Any = prb
    for part in name.split("."):
        value = getattr(value, part, None)
    return value


def refused(name: str) -> dict[str, tuple[Any, ...]]:
    """Return the bad values of each argument of a public name."""
    row, bad = TABLE[name], {}
    if public(name) is not None:
        for parameter in inspect.signature(public(name)).parameters.values():
            if parameter.name not in ("self", "inputs", "pc_kwargs"):
                bad[parameter.name] = bad_values(parameter.name, str(parameter.annotation))
            elif parameter.name == "pc_kwargs" and name != "plot_validity":
                bad["figsize"] = BY_NAME["figsize"]
        if "figsize" in bad or name in ("compare", "Report"):
            bad = {key: v[:2] if key == "model" else v for key, v in bad.items()}
    return bad | row.bad


def cases() -> Iterator[Any]:
    for name in TABLE:
        for argument, values in refused(name).items():
            for place, value in enumerate(values):
                # Without addresses, which differ between processes.
                text = re.sub(r" at 0x\w+", "", repr(getattr(value, "__name__", value)))
                label = f"{name} {argument}={' '.join(text[:40].split())}"
                marks = [pytest.mark.slow] if place >= 3 else []
                yield pytest.param(name, argument, value, id=label, marks=marks)


CASES = list(cases())
# What an argument is called in a message, where that is not its name.
WORDS = {"constant": "input", "result": "expected an optimum", "tests": "expected a validitytest"}


@pytest.fixture(scope="module", autouse=True)
def _shared() -> None:
    """Make what is shared before the response's calls are counted."""
    first_use(with_epsilon())
    for shared in (posterior, predicted, validity, surrogate, comparison):
        shared()


@pytest.mark.parametrize(("name", "argument", "value"), CASES)
def test_a_bad_argument_is_refused_before_the_response_is_called(
    name: str, argument: str, value: Any
) -> None:
    row = TABLE[name]
    given = {key: made(good) for key, good in (row.good | {argument: value}).items()}
    before, clock = calls, time.process_time()
    with pytest.raises((TypeError, ValueError, KeyError, prb.response.StoreError)) as caught:
        (row.call or public(name))(**given)
    text = str(caught.value).lower()
    for word in ("got", "expected", WORDS.get(argument, argument).lower()):
        assert word in text, text
    assert calls == before
    assert time.process_time() - clock < 1.0


def test_every_argument_of_every_public_name_has_bad_values() -> None:
    packages = {"datasets", "metrics", "posterior", "propagation", "reports", "response"}
    packages |= {"decision", "plots", "surrogate", "validation"}
    # Results, a class to derive from, and a metric without arguments.
    spared = packages | {"Surrogate", "Diagnosis", "Optimum", "Metric", "AreaMetric"}
    assert set(prb.__all__) - spared <= set(TABLE)
    without = {
        f"{name}.{argument}" for name in TABLE for argument, bad in refused(name).items() if not bad
    }
    # Those need a unit, a run of PyMC, a result or a file.
    expected = {f"fmu.{name}" for name in ("start_time", "stop_time", "step", "times")}
    kernel = ("compile_kwargs", "evaluator", "log_likelihood", "start")
    expected |= {f"posterior.BatchedKernel.{name}" for name in kernel}
    quantities = ("Mean", "StandardDeviation", "Quantile", "Exceedance")
    expected |= {f"decision.{name}.output" for name in quantities}
    assert without == expected | {"Surrogate.load.model", "Surrogate.load.coarse"}
