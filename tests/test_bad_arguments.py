"""Every argument of every public name refuses bad values: a sentence, soon, before the response is called.

Good and bad values follow from the annotation and the name of an argument. `TABLE` has those that
a public name has of its own.
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


class Later:
    """An object that several cases share, made at its first use."""

    def __init__(self, make: Callable[[], Any]) -> None:
        self.make = cache(make)

    def __call__(self) -> Any:
        return self.make()


def made(value: Any) -> Any:
    return value() if isinstance(value, Later) else value


def without_simulator() -> pm.Model:
    with pm.Model() as found:
        pm.Normal("mu")
    return found


def of_two_outputs() -> prb.Optimum:
    settings: dict[str, Any] = {"method": "Nelder-Mead", "refine": False, "starts": 0}
    return prb.minimize(two_outputs(), **settings, **QUIET)


def drawn() -> xr.DataTree:
    settings = {"model": model(), "optimum": optimum(), "refine": False, "random_seed": 1}
    return prb.sample_smc(20, chains=2, **settings, **QUIET)


def validity_test() -> prb.validation.ValidityTest:
    null = prb.validation.PosteriorNull(19)
    return prb.area_test(FRESH_DATA, predicted(), null=null, **QUIET)


NAMED = {"first": OBSERVED, "second": np.square(OBSERVED)}
JOINT = {"metric": prb.Joint(prb.AreaMetric()), "propagation": prb.Resimulated(64)}
bare = Later(without_simulator)
model = Later(lambda: simulated(propagation=prb.Reweighted(256)))
with_epsilon = Later(lambda: simulated(epsilon=0.1, propagation=prb.Reweighted(64)))
two_outputs = Later(
    lambda: simulated(lambda x: {"first": x, "second": np.square(x)}, observed=NAMED, **JOINT)
)
specimen = Later(lambda: next(iter(nodes(model()).values())).bound.inputs.aleatory[0])
optimum = Later(lambda: prb.minimize(model(), refine=False, starts=0, **QUIET))
posterior = Later(drawn)
mean = Later(lambda: prb.decision.Mean(line, specimen()))
influences = Later(lambda: prb.sensitivity(posterior(), mean(), model=model()))
predicted = Later(
    lambda: prb.predict(posterior(), line, specimen(), model=model(), n_samples=50, **QUIET)
)
results = Later(lambda: {"optimum": optimum(), "posterior": posterior()})
comparison = Later(lambda: prb.compare(results(), model=model()))
validity = Later(validity_test)
by_specimen = Later(lambda: simulated(metric=prb.LogLikelihood(), propagation=prb.Reweighted(64)))
at_optimum = Later(lambda: prb.minimize(by_specimen(), starts=0, **QUIET))
specimens = Later(lambda: prb.individuals(at_optimum(), n_draws=20))
residuals = Later(lambda: prb.residuals(at_optimum(), n_draws=20))


def populations_of_products() -> xr.Dataset:
    """Return a table with the dimensions of that of a fleet."""
    dims = ("product", "name", "quantity")
    arrays = {key: (dims, np.ones((2, 1, 1))) for key in ("estimate", "lower", "upper")}
    labels = {"product": ["A", "B"], "name": ["x"], "quantity": ["mean"], "unit": ("name", [""])}
    return xr.Dataset(arrays, labels, {"prob": 0.89})


def at_times() -> xr.DataTree:
    """Return inputs and readings of three specimens at four times."""
    draws, times = ("chain", "draw", "specimen"), {"time": np.arange(4.0)}
    y = np.arange(24.0).reshape(1, 2, 3, 4)
    return xr.DataTree.from_dict(
        {
            "posterior": xr.Dataset({"x": (draws, y[..., 0])}),
            "posterior_predictive": xr.Dataset({"y": ((*draws, "time"), y)}, times),
            "observed_data": xr.Dataset({"y": (("specimen", "time"), y[0, 0])}, times),
        }
    )


surrogate = Later(lambda: prb.Surrogate.fit(np.square, {"x": (0, 1)}, 20, **QUIET))


# -- bad values by the annotation and the name of an argument ----------------------------------------

FLAG = ("no", 1)
COUNT = (0, 1.5)
FLOAT = ("a", True)
SHARE = (0, 1, np.nan)
POSITIVE = (0, -1.0, np.nan)
SEED = (-1, 1.5, "a")
NO_DATA = ([1.0, np.nan, 2.0], np.ones((3, 2)), {"a": OBSERVED})
NO_WEIGHTS = (np.ones(3), -np.ones(30), "abc")
NO_INPUT = (None, "a", np.nan, 3.0, pm.Normal)
NO_LIMIT = (np.nan, np.inf, [1.0])
BY_NAME: dict[str, tuple[Any, ...]] = {
    "alpha": SHARE,
    "checkpoint": (b"a", "/dev/null/run.nc", "/"),
    "coords": (3, {"no such dim": 1}),
    "density": (prb.GaussianKDE,),
    "executor": (map, object()),
    "figsize": (3, "wide", (3,)),
    "filter_vars": (3, "glob"),
    "folds": (1, 29),
    "idata_kwargs": ({"model": 1}, {"dims": 1}, {"log_prior": 1}),
    "labels": ({"mu": 3}, {"no such name": "mean"}),
    "limit": NO_LIMIT,
    "max_lost": (1.0, -0.1, np.nan),
    "max_seconds": POSITIVE,
    "metric": (prb.AreaMetric, np.mean),
    "model": (bare,),
    "observed": ([], [np.nan], "a"),
    "on_failure": (prb.response.Abort,),
    "optimum": (posterior, {"mu": 1.0}),
    "output": (0, "a"),
    "path": ("",),
    "predicted": ([], np.array(["a"]), xr.DataArray([1.0, 2.0])),
    "prob": SHARE,
    "probability": SHARE,
    "response": (dict,),
    "result": (xr.DataTree(), comparison, []),
    "seen": (None, "x", 1.0),
    "shape": (lambda c: np.nan * c, lambda c: 1.0),
    "store": ("", b"folder"),
    "threshold": SHARE,
    "timeout": POSITIVE,
    "tolerance": POSITIVE,
    "var_names": ([], [1], ["nu"]),
    "version": ("",),
}


def bad_values(name: str, annotation: str) -> tuple[Any, ...]:
    """Return what an argument refuses by its annotation and name; None only where it is not good."""
    kinds = re.sub(r"\[.*\]", "", annotation).split(" | ")
    if name == "random_seed":
        # Configuration takes an integer, and not the other seeds of PyMC.
        bad = (*SEED, [1, 2], np.random.default_rng(1), None) if annotation == "int" else SEED
    elif {"Any", "ArrayLike", "Floats", "inspect._empty"} & set(kinds):
        bad = ()
    elif kinds == ["bool"]:
        bad = FLAG
    elif "int" in kinds or "float" in kinds:
        bad = COUNT if "int" in kinds else FLOAT
    else:
        bad = (3, None) if {"str", "StrPath"} & set(kinds) else (3, "a", None)
    bad = (*bad, *BY_NAME.get(name, ()))
    return tuple(v for v in bad if v is not None or "None" not in annotation)


# -- the table -------------------------------------------------------------------------------------


# Good values of arguments without a default, and of those that are the same everywhere.
GOOD: dict[str, Any] = {
    "comparison": comparison,
    "function": np.mean,
    "limit": 1.0,
    "metric": prb.AreaMetric(),
    "model": model,
    "observed": FRESH_DATA,
    "optimum": optimum,
    "posterior": posterior,
    "predicted": predicted,
    "probability": 0.9,
    "progressbar": False,
    "quantity": mean,
    "response": line,
    "result": posterior,
    "results": results,
    "seen": [0.0, 1.0],
    "table": influences,
    "tests": validity,
}


class Row:
    """A public name: good arguments of its own, how it is called, and more bad values.

    The rules do not hold for arguments that are named in ``own``.
    """

    def __init__(
        self,
        good: dict[str, Any] | None = None,
        /,
        *,
        call: Any = None,
        own: str = "",
        **bad: tuple[Any, ...],
    ) -> None:
        self.good = good or {}
        self.call = call
        self.own = own.split()
        self.bad = bad


def public(name: str) -> Any:
    """Return a public object, None for a name that is a description."""
    value: Any = prb
    for part in name.split("."):
        value = getattr(value, part, None)
    return value


# Results, errors, and classes to derive from.
SPARED = {"Diagnosis", "Metric", "Optimum", "Surrogate", "datasets", "metrics", "propagation"}
SPARED |= {"BudgetError", "Cost", "CrossValidation", "Quantity", "ResponseError", "StoreError"}
SPARED |= {"Surface", "ValidityTest"}


def public_names() -> Iterator[str]:
    for name in sorted(set(prb.__all__) - SPARED):
        inner = getattr(public(name), "__all__", None)
        yield from (
            [name] if inner is None else [f"{name}.{key}" for key in inner if key not in SPARED]
        )


def good_values(name: str) -> dict[str, Any]:
    """Return good values of the arguments without a default, of the model and of the bar."""
    row, good = TABLE[name], {}
    if public(name) is not None:
        for key, parameter in inspect.signature(public(name)).parameters.items():
            kind = str(parameter.annotation)
            is_general = kind.startswith("pm.Model") or key == "progressbar"
            if key in GOOD and (parameter.default is parameter.empty or is_general):
                good[key] = GOOD[key]
    return good | row.good


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


sound_report = Later(report)
SMALL = {"optimum": optimum, "draws": 20, "chains": 1}
BEFORE = ({"zz": 1.0},)
ZERO_OR_MORE = (-1, 1.5, "a", True)
JOINED = (prb.Joint(prb.AreaMetric()),)
WITHOUT_PROCESSES = (5.0,)
TABLE: dict[str, Row] = {name: Row() for name in public_names()} | {
    "Simulator": Row(
        {"observed": OBSERVED, "name": "y"},
        call=simulator,
        name=("", "  ", "mu"),
        constant=(None, "a", np.nan),
        observed=(*NO_DATA, [1.0]),
        epsilon=(*POSITIVE, {"y": 1.0}, 1j),
        weights=(np.ones(29), np.ones((2, 30)), np.r_[-1, np.ones(29)]),
        specimens=(range(29), [None] * 30, [*range(29), None]),
        dims=("nope", "few", ""),
        propagation=(prb.Reweighted, prb.AreaMetric()),
        units=({"nothing": "mm"}, {"x": 3}, {3: "mm"}),
        own="observed",
    ),
    "response.Smooth": Row(
        {"zero_at": 0.0}, zero_at=(np.nan, np.inf, "a"), length=POSITIVE, reach=POSITIVE
    ),
    "Summary": Row(
        {"n": 20, "mean": 2.0, "sd": 1.0, "minimum": 0.0, "maximum": 4.0, "quantiles": {0.5: 2.1}},
        n=(1, 2.5, None),
        mean=(-1.0, 4.5, np.nan),
        sd=(0.0, -1.0, 3.0),
        minimum=(2.5, np.inf, "a"),
        maximum=(1.5, -np.inf, "a"),
        quantiles=({}, {0.5: 5.0}, {0.25: 2.0, 0.5: 1.0}),
    ),
    "Reweighted": Row(max_points=(3,), emulator=(3, "a"), timeout=WITHOUT_PROCESSES),
    "Resimulated": Row(n=(1,), points=("halton",), timeout=WITHOUT_PROCESSES),
    "Fresh": Row(timeout=WITHOUT_PROCESSES),
    "response.by_specimen": Row(
        {"functions": line, "records": [1.0, 2.0]},
        functions=([line], [line, 1.0], [pm.Normal, line]),
        records=(None, "ab", {"a": 1, "b": 2}),
    ),
    "response.condition": Row(
        {"name": "load", "values": [1.0, 2.0]},
        name=("",),
        values=(1.0, [1.0], [1.0, np.nan]),
    ),
    "response.group": Row(
        call=group,
        dim=("", "batch", ["supplier"]),
        coords=({"supplier": ["a"]}, {"supplier": ["a", "a"]}, {"supplier": ["a/b", "c"]}),
        observed=(OBSERVED, OBSERVED.tolist(), in_groups(["a"] * 30)),
    ),
    "response.Replace": Row(value=(-np.inf, [1.0], 1j)),
    "response.Retry": Row(then=(prb.response.Retry(), prb.response.Abort)),
    "response.Store": Row(
        {"folder": "/dev/null/folder", "name": "y", "columns": 1}, folder=("",), name=("",)
    ),
    "command": Row(
        {"arguments": [sys.executable, "{x}"], "inputs": ["x"], "read": float},
        arguments=([], [3], [sys.executable, None]),
        inputs=(["y"], ["x", "x"], ["a b"]),
        write=({"../in.txt": "{x}"}, {"/in.txt": "{x}"}, {3: "{x}"}),
        folder=("", b"folder"),
    ),
    "umbridge": Row(
        {"url": "http://127.0.0.1:9"},
        url=("", "localhost:4242", "ftp://localhost"),
        model=(3, "", None),
        config=({"level": np.arange(2)}, [1]),
        patience=POSITIVE,
        own="model",
    ),
    "fmu": Row(
        {"path": __file__, "inputs": ["x"], "outputs": ["y"]},
        path=(b"unit.fmu",),
        inputs=([], ["x", "x"], [3]),
        outputs=([], ["y", "y"], {"a": 3}),
        parameters=({3: 1.0}, ["m"]),
        own="start_time stop_time step times",
    ),
    "ProbabilityResidual": Row(scale_base=POSITIVE),
    "LogLikelihood": Row(
        error=("a", 0, -1.0),
        gross_errors=(-1.0, 2.0),
        censored=((1.0,), ("a", "b"), [None, None]),
        rounded=("a", -1.0),
        bias=("a", np.nan, True),
    ),
    "readings.Poisson": Row(exposure=(*POSITIVE, "a", True)),
    "readings.NegativeBinomial": Row(
        {"alpha": 2.0}, alpha=(*POSITIVE, "a", True), exposure=(*POSITIVE, "a"), own="alpha"
    ),
    "readings.Binomial": Row(n=(*POSITIVE, "a", True)),
    "readings.Combined": Row(
        {"additive": 1.0, "proportional": 0.1}, additive=(*POSITIVE, "a"), proportional=(-1.0, "a")
    ),
    "Joint": Row(metric=JOINED),
    "GaussianKDE": Row(bandwidth=POSITIVE),
    "Histogram": Row(bins=([3.0, 2.0, 1.0],)),
    "a metric": Row(
        {"simulated": OBSERVED, "observed": OBSERVED},
        call=prb.AreaMetric(),
        simulated=([1.0, np.nan], [], "a"),
        observed=NO_DATA,
        weights=NO_WEIGHTS,
    ),
    "a metric of several outputs": Row(
        {"simulated": OUTPUTS, "observed": OUTPUTS},
        call=prb.Joint(prb.AreaMetric()),
        simulated=(np.full((9, 2), np.nan), np.ones((9, 3)), OUTPUTS[:, 0]),
        observed=(OUTPUTS[None], OUTPUTS[:3], OUTPUTS * [1, 0]),
        weights=NO_WEIGHTS,
    ),
    "minimize": Row(
        {"refine": False},
        start=({"nu": 1.0}, {"mu": "a"}, {"mu": np.nan}),
        method=("BFSG", prb.AreaMetric, ""),
        options=(["maxiter"], {"nonsense": 1}, {3: 1}),
        starts=ZERO_OR_MORE,
        own="starts",
    ),
    "refine": Row(
        {"thetas": [[1.0]]},
        thetas=({"mu": 1.0}, "a", 3.0),
    ),
    "cost": Row(model=(print, optimum)),
    "set_epsilon": Row(
        {"epsilon": {}},
        epsilon=(["y"], {"z": 1.0}, {"y": True}),
    ),
    "sample_smc": Row(
        {**SMALL, "adjustment": None, "refine": False},
        adjustment=("affine", True, 1),
        draws=(5,),
        epsilon=POSITIVE,
        start=({"nu": [1.0]}, [{}, {}], {"mu": [1.0]}),
        own="adjustment",
    ),
    "sample": Row(SMALL, draws=(5,)),
    "posterior.BatchedKernel": Row(
        {"model": with_epsilon, "draws": 20},
        own="compile_kwargs evaluator log_likelihood start",
    ),
    "bootstrap": Row({"draws": 10}, draws=(1,)),
    "simulation_based_calibration": Row(
        n_data_sets=(1,), draws=(5,), adjustment=(3, "affine"), own="adjustment"
    ),
    "compare": Row(
        results=({}, {"a": "b"}, {"a": None}),
        metrics=(["area"], [prb.AreaMetric], [None]),
    ),
    "predict": Row(
        call=with_inputs(prb.predict, "result", "response"),
        input=NO_INPUT,
        n_samples=(1,),
        name=("",),
    ),
    "decision.Mean": Row(own="output"),
    "decision.StandardDeviation": Row(own="output"),
    "decision.Quantile": Row(own="output"),
    "decision.Exceedance": Row(own="output"),
    "decision.Interval": Row({"low": 0.0, "high": 1.0}, low=NO_LIMIT, high=(*NO_LIMIT, 0.0)),
    "sensitivity": Row(
        quantity=(prb.decision.Mean, np.mean),
        n_samples=(31,),
    ),
    "plan": Row(
        {"candidates": Later(lambda: {"same": prb.decision.Condition(line, specimen())})},
        candidates=({}, {"a": 3}, {3: prb.decision.Condition(line)}),
        k=([], [0], "ab"),
        quantity=(prb.decision.Mean,),
        max_sd=({}, {"tau": 1.0}, {"mu": 0.0}),
    ),
    "population": Row(
        inputs=("nothing", [], ["x", "nothing"]),
        quantiles=("ab", 3, [0.5, 1.0]),
        at=({"nothing": 1.0}, {"x": 1.0}),
        n_draws=(1,),
    ),
    "exceedance": Row(
        call=with_inputs(prb.exceedance, "result", "response", "limit"),
        input=NO_INPUT,
        n_draws=(1,),
        n_points=(*ZERO_OR_MORE, 5),
        requirement=(0, 2.0),
        steps=(1,),
        own="n_points",
    ),
    "decision.p_box": Row(
        call=with_inputs(prb.decision.p_box, "result", "response"),
        input=NO_INPUT,
        n_draws=(1,),
        steps=(1,),
    ),
    "area_test": Row(
        {"null": prb.validation.PosteriorNull(19)},
        null=(prb.validation.ExactModel,),
        specimens=([1, 2], "abc", [None] * 9),
        own="specimens",
    ),
    "validation.PosteriorNull": Row(replicates=(5,), random_seed=SEED, own="random_seed"),
    "validation.JointNull": Row(
        responses=([line], {"y": 3}, (3,)),
        replicates=(5,),
        random_seed=SEED,
        own="random_seed",
    ),
    "validation.ExactModel.critical_value": Row(
        {"n": 9}, call=prb.validation.ExactModel().critical_value
    ),
    "validation.ExactModel.p_value": Row(
        {"n": 9, "statistic": 0.1},
        call=prb.validation.ExactModel().p_value,
        statistic=(-1.0, np.nan),
    ),
    "rank": Row(
        {"candidates": Later(lambda: {"a": optimum(), "b": optimum()})},
        candidates=(optimum, Later(lambda: {"a": optimum()}), {}),
    ),
    "Runs": Row(
        {"inputs": np.arange(9.0), "responses": np.arange(9.0) ** 2},
        inputs=("a", None, np.arange(5.0)),
        responses=("a", None, np.arange(8.0)),
    ),
    "Surrogate.fit": Row(
        {"inputs": {"x": (0.0, 1.0)}, "n": 20},
        inputs=({}, [], {"x": (1, 0)}),
        n=(1,),
        model=("rbf", 3, prb.surrogate.RadialBasis),
        points=("halton",),
        outside=("nan", prb.response.Retry(), prb.response.Abort),
        name=(b"text", [], True),
        own="model",
    ),
    "a surrogate": Row(call=lambda x: surrogate()(x), x=("a", None, [True])),
    "Surrogate.local_error": Row(call=lambda x: surrogate().local_error(x), x=("a", None, [True])),
    "Surrogate.with_error": Row(call=lambda **given: surrogate().with_error(**given)),
    "Surrogate.save": Row(
        call=lambda path: surrogate().save(path), path=(True, "/dev/null/a.nc", "/")
    ),
    "Surrogate.load": Row(path=("/dev/null/a.nc", "/", __file__), own="model coarse"),
    "surrogate.Polynomial": Row(degree=(*ZERO_OR_MORE, None), own="degree"),
    "surrogate.RadialBasis": Row(
        kernel=("x",), degree=(-2, *ZERO_OR_MORE[1:]), smoothing=(-1.0, np.nan), own="degree"
    ),
    "Report": Row(
        call=report,
        title=("", "  "),
        sections=([1], [None]),
        author=(["a"],),
        date=(2024.5,),
        optimum=({"a": 3}, xr.DataTree(), comparison),
        posterior=({"a": 3}, xr.DataTree(), optimum),
        validity=({"a": 3}, comparison),
        comparison=(optimum, xr.Dataset()),
        decision=(xr.Dataset(), {"a": 3}, comparison),
        validation=([1], {"a": 3}, {3: ([1.0], predicted)}),
        own="optimum",
    ),
    "Report.to_html": Row(call=lambda path: sound_report().to_html(path), path=(True, "/")),
    "Report.to_markdown": Row(
        call=lambda folder: sound_report().to_markdown(folder), folder=(True, __file__, "")
    ),
    "Report.with_section": Row(
        {"section": prb.reports.Section("A")},
        call=lambda **given: sound_report().with_section(**given),
        after=("no such title",),
    ),
    "reports.Section": Row(
        {"title": "A", "picture": b"<svg/>", "alt": "a"},
        title=("", " "),
        text=([3], b"a"),
        table=(3, "a", [1, 2]),
        picture=("x.png", 3, b"xx"),
        alt=("",),
        level=(1, 9, 2.5),
    ),
    "plots.plot_individuals": Row({"individuals": specimens}, individuals=(posterior, comparison)),
    "plots.plot_predictive_check": Row(
        {"individuals": Later(at_times)},
        individuals=(posterior, comparison, specimens),  # readings without a horizontal axis
        own="individuals",
    ),
    "plots.plot_residuals": Row({"residuals": residuals}, residuals=(posterior, specimens)),
    "plots.plot_prediction": Row(
        observed=("a", None, []),
        predicted=(3, None, np.ones((2, 3))),
        own="observed predicted",
    ),
    "plots.plot_sensitivity": Row(
        table=(xr.Dataset(), xr.Dataset({"first": 1.0, "total": 1.0}), comparison),
    ),
    "calibrate_each": Row(
        {"data_sets": {"a": OBSERVED, "b": OBSERVED + 1}},
        data_sets=([1.0, 2.0], {}, {"a": [1.0]}),
        validation=([1.0], {"zz": [1.0]}, {"a": []}),
    ),
    "individuals": Row(
        {"result": at_optimum, "model": by_specimen},
        result=(None, 3, "result"),
        own="result",
    ),
    "residuals": Row(
        {"result": at_optimum, "model": by_specimen},
        result=(None, 3, "result"),
        own="result",
    ),
    "update": Row(
        {"result": posterior, "observed": OBSERVED, "model": by_specimen},
        result=(None, 3, "result"),
        observed=([], "a", [1j]),
        own="result observed",
    ),
    "plots.plot_landscape": Row(
        max_responses=(*ZERO_OR_MORE, None),
        own="max_responses",
    ),
    "plots.plot_outputs": Row(
        {"result": Later(of_two_outputs), "model": two_outputs},
        result=(None, 3, "result"),
        before=BEFORE,
        own="result",
    ),
    "plots.plot_posterior": Row(
        posterior=BY_NAME["result"],
        optimum=(3, "a", posterior),
        own="optimum",
    ),
    "plots.plot_responses": Row(before=(*BEFORE, {"mu": "a"})),
    "plots.plot_stages": Row(posterior=BY_NAME["result"]),
    "plots.plot_comparison": Row(comparison=(xr.Dataset(), optimum, posterior)),
    "plots.plot_products": Row(
        {"table": Later(populations_of_products)}, table=(xr.Dataset(), optimum, comparison)
    ),
    "plots.plot_validity": Row(tests=({}, {"a": 3}, comparison)),
}


def refused(name: str) -> dict[str, tuple[Any, ...]]:
    """Return the bad values of each argument of a public name."""
    row, bad = TABLE[name], {}
    if public(name) is not None:
        for parameter in inspect.signature(public(name)).parameters.values():
            if parameter.name not in ("self", "inputs", "pc_kwargs"):
                bad[parameter.name] = bad_values(parameter.name, str(parameter.annotation))
            elif parameter.name == "pc_kwargs" and name != "plots.plot_validity":
                bad["figsize"] = BY_NAME["figsize"]
        if "figsize" in bad or name in ("compare", "Report"):  # a model without simulators is good
            bad = {key: v[:2] if key == "model" else v for key, v in bad.items()}
    bad |= dict.fromkeys(row.own, ())
    return {key: row.bad.get(key, ()) + bad.get(key, ()) for key in bad | row.bad}


CASES = [
    pytest.param(name, argument, values, id=f"{name} {argument}")
    for name in TABLE
    for argument, values in refused(name).items()
    if values
]


# What an argument is called in a message, where that is not its name.
WORDS = {
    "constant": "input",
    "result": "expected an optimum",
    "tests": "expected a validitytest",
    "update result": "expected a datatree",
}


@pytest.fixture(scope="module", autouse=True)
def _shared() -> None:
    """Make what is shared before the response's calls are counted."""
    first_use(with_epsilon())
    for shared in (posterior, predicted, validity, surrogate, comparison):
        shared()


@pytest.mark.parametrize(("name", "argument", "values"), CASES)
def test_a_bad_argument_is_refused_before_the_response_is_called(
    name: str, argument: str, values: tuple[Any, ...]
) -> None:
    call = TABLE[name].call or public(name)
    good = {key: made(value) for key, value in good_values(name).items()}
    for value in values:
        before, clock = calls, time.process_time()
        with pytest.raises((TypeError, ValueError, KeyError, prb.response.StoreError)) as caught:
            call(**good | {argument: made(value)})
        text = str(caught.value).lower()
        named = WORDS.get(f"{name} {argument}", WORDS.get(argument, argument))
        for word in ("got", "expected", named.lower()):
            assert word in text, (value, text)
        # The outputs of a response are known once its runs are compared with a few new ones.
        assert calls - before <= (3 if argument == "output" else 0), value
        assert time.process_time() - clock < 1.0, value


def test_every_argument_of_every_public_name_has_bad_values() -> None:
    without = {
        f"{name}.{argument}" for name in TABLE for argument, bad in refused(name).items() if not bad
    }
    # Those need a unit, a run of PyMC, a result or a file, and are named as their own.
    assert without == {f"{name}.{key}" for name, row in TABLE.items() for key in row.own} - {
        f"{name}.{key}" for name, row in TABLE.items() for key in row.bad
    }
