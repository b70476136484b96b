"""Changes of a response: what is noticed without a run, and what is no change."""

from __future__ import annotations

import functools
import importlib
import inspect
import json
import logging
import os
import re
import sqlite3
import subprocess
import sys
import threading
import types
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pandas as pd
import pymc as pm
import pytensor
import pytensor.tensor as pt
import pytest
from scipy.special import zetac

import prbayes as prb
from prbayes.model.evaluator import Evaluator, with_data, with_unchanged_runs
from prbayes.response.call import scalar
from prbayes.response.compile import PLAIN
from prbayes.response.failures import ResponseError
from prbayes.response.inputs import read_inputs
from prbayes.response.response import Responses
from prbayes.response.store import StoreError
from prbayes.response.variables import changed_names, digests_of, watched

with pm.Model() as MODEL:
    MU = pm.Normal("mu")
    X = pm.Normal.dist(MU, 1.0)

POINTS = np.linspace(-2.0, 2.5, 64)


def responses_of(function: Any, **settings: Any) -> Responses:
    return Responses("y", function, read_inputs("y", [X], MODEL), **settings)


def computed(function: Any, **settings: Any) -> tuple[Responses, Any]:
    """Return a response and its runs, as a design keeps them."""
    responses = responses_of(function, **settings)
    with responses.kept_runs():
        return responses, responses([POINTS], [])


# -- changes that are noticed ----------------------------------------------------------------------


class Machine:
    """A response with attributes."""

    factor = 1.0

    def __init__(self) -> None:
        self.load = 1.0
        self.inner = types.SimpleNamespace(names={"a": {"load": 1.0}})

    def __call__(self, x: Any) -> Any:
        return self.load * self.factor * self.inner.names["a"]["load"] * x

    def method(self, x: Any) -> Any:
        return self(x)

    @property
    def twice(self) -> float:
        return 2 * self.load


class Slotted:
    __slots__ = ("load",)

    def __init__(self) -> None:
        self.load = 1.0

    def solve(self, x: Any) -> Any:
        return self.load * x


class Wrapping:
    """A decorator as a class, whose function and attributes are its own."""

    def __init__(self, function: Any) -> None:
        functools.update_wrapper(self, function)

    def __call__(self, x: Any) -> Any:
        return self.__wrapped__(x)  # type: ignore[attr-defined]


def decorated(function: Any) -> Any:
    @functools.wraps(function)
    def wrapper(x: Any) -> Any:
        return function(x)

    return wrapper


NOTEBOOK = """
load = 1.0
settings = {"loads": [1.0, 2.0]}
class Part:
    load = 1.0
def helper(x):
    return load * x
def inner(x):
    return (lambda y: helper(y))(x)
def f(x):
    return settings["loads"][0] * Part.load * inner(x)
"""


def notebook(cell: str) -> tuple[Any, Callable[[], Any]]:
    """Return a function of a notebook, and the next cell."""
    names: dict[str, Any] = {"__name__": "__main__"}
    exec(NOTEBOOK, names)
    return names["f"], lambda: exec(cell, names)


def of_closure() -> tuple[Any, Callable[[], Any]]:
    loads, array = [1.0], np.ones(3)

    def response(x: Any) -> Any:
        return loads[0] * array[0] * x

    return response, lambda: loads.__setitem__(0, 2.0)


def of_array(size: int) -> tuple[Any, Callable[[], Any]]:
    array = np.ones(size)

    def response(x: Any) -> Any:
        return array.sum() / size * x

    return response, lambda: array.__setitem__(size // 3, 7 * size)


def of_defaults() -> tuple[Any, Callable[[], Any]]:
    def response(x: Any, loads: Any = [1.0], *, more: Any = {"a": 1.0}) -> Any:  # noqa: B006
        return loads[0] * more["a"] * x

    return response, lambda: response.__kwdefaults__["more"].update(a=2.0)  # type: ignore[index]


def of_function_attribute() -> tuple[Any, Callable[[], Any]]:
    def response(x: Any) -> Any:
        return response.load * x  # type: ignore[attr-defined]

    response.load = 1.0  # type: ignore[attr-defined]
    return response, lambda: setattr(response, "load", 2.0)


def of_machine(change: Callable[[Any], Any], way: Any = lambda m: m) -> Any:
    def made() -> tuple[Any, Callable[[], Any]]:
        class Own(Machine):
            pass

        machine = Own()
        return way(machine), lambda: change(machine)

    return made


def of_slots() -> tuple[Any, Callable[[], Any]]:
    machine = Slotted()
    return machine.solve, lambda: setattr(machine, "load", 2.0)


def of_partial() -> tuple[Any, Callable[[], Any]]:
    settings = {"load": 1.0}
    inner = functools.partial(lambda a, x, b: a["load"] * b * x, settings, b=1.0)
    return functools.partial(inner), lambda: settings.update(load=2.0)


def of_table() -> tuple[Any, Callable[[], Any]]:
    table = pd.DataFrame({"load": [1.0, 2.0]})
    return lambda x: table["load"].to_numpy()[0] * x, lambda: table.iloc.__setitem__((0, 0), 2.0)


def of_graph() -> tuple[Any, Callable[[], Any]]:
    load, x = pytensor.shared(1.0), pt.dvector()
    compiled = pytensor.function([x], load * x, mode=PLAIN)
    return lambda x: compiled(np.atleast_1d(x)), lambda: load.set_value(2.0)


def of_dates() -> tuple[Any, Callable[[], Any]]:
    days = np.array(["2020-01-02", "2020-01-03"], "datetime64[D]")
    first = np.datetime64("2020-01-01")
    return lambda x: (days[0] - first).astype(float) * x, lambda: days.__setitem__(0, days[1])


def of_library() -> tuple[Any, Callable[[], Any]]:
    module = types.ModuleType("installed")
    vars(module).update(load=1.0, __file__=np.__file__)
    return lambda x: module.load * x, lambda: vars(module).update(load=2.0)


def of_environment() -> tuple[Any, Callable[[], Any]]:
    os.environ["LOAD"] = "1.0"
    return lambda x: float(os.environ["LOAD"]) * x, lambda: os.environ.update(LOAD="2.0")


def of_code() -> tuple[Any, Callable[[], Any]]:
    def response(x: Any) -> Any:
        return x * 1.0

    return response, lambda: setattr(response, "__code__", (lambda x: x * 2.0).__code__)


KINDS: dict[str, Callable[[], tuple[Any, Callable[[], Any]]]] = {
    "attribute": of_machine(lambda m: setattr(m, "load", 2.0)),
    "class attribute": of_machine(lambda m: setattr(type(m), "factor", 2.0)),
    "nested dictionary": of_machine(lambda m: m.inner.names["a"].update(load=2.0)),
    "method": of_machine(lambda m: setattr(m, "load", 2.0), lambda m: m.method),
    "redefined method": of_machine(lambda m: setattr(type(m), "__call__", lambda _, x: 2 * x)),
    "scalar": of_machine(lambda m: setattr(m, "load", 2.0), scalar),
    "decorated": of_machine(lambda m: setattr(m, "load", 2.0), decorated),
    "wrapper": of_machine(lambda m: setattr(m, "load", 2.0), Wrapping),
    "np.vectorize": of_machine(lambda m: setattr(m, "load", 2.0), np.vectorize),
    "lru_cache": of_machine(
        lambda m: setattr(m, "load", 2.0),
        lambda m: lambda x: m(x) * functools.lru_cache(m)(1.0) / m(1.0),
    ),
    "slots": of_slots,
    "list of a closure": of_closure,
    "array": lambda: of_array(1000),
    "large array": lambda: of_array(3 * 10**6),
    "dates": of_dates,
    "default": of_defaults,
    "attribute of a function": of_function_attribute,
    "partial": of_partial,
    "table": of_table,
    "shared variable": of_graph,
    "code": of_code,
    "global": lambda: notebook("load = 2.0"),
    "nested global": lambda: notebook("settings['loads'][0] = 2.0"),
    "global function": lambda: notebook("def helper(x): return 2 * x"),
    "variable of a module": of_library,
    "environment": of_environment,
    "global class": lambda: notebook("Part.load = 2.0"),
}


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
def test_a_change_is_noticed_at_every_use(kind: str) -> None:
    function, change = KINDS[kind]()
    stored, values = computed(function)
    for _ in range(2):
        stored.used_by("prb.predict").refuse_change([POINTS], values, stored)
    assert not stored.may_differ
    change()
    for caller in ("prb.predict", "prb.predict", "prb.exceedance"):
        assert stored.may_differ
        with pytest.raises(ResponseError, match=rf"^{caller}: got .* has changed since; build"):
            stored.used_by(caller).refuse_change([POINTS], values, stored)


def test_a_message_names_the_variable_in_few_lines() -> None:
    function, change = KINDS["nested dictionary"]()
    stored, values = computed(function)
    change()
    with pytest.raises(ResponseError, match=r"in its runs: inner\.names\.a\.load has") as caught:
        stored.used_by("prb.predict").refuse_change([POINTS], values, stored)
    assert len(str(caught.value)) < 400


def test_a_change_within_an_interval_is_noticed_and_its_undoing_is_accepted() -> None:
    window = {"height": 0.0}

    def response(x: Any) -> Any:
        return x + window["height"] * (np.abs(x - 0.8) < 0.1)

    stored, values = computed(response)
    window["height"] = 1.0
    with pytest.raises(ResponseError, match=r"window\.height has changed"):
        stored.refuse_change([POINTS], values, stored)
    window["height"] = 0.0
    stored.refuse_change([POINTS], values, stored)
    assert not stored.may_differ


def test_a_module_of_the_user_that_is_loaded_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    (tmp_path / "ownpackage").mkdir()
    (tmp_path / "ownpackage" / "__init__.py").touch()
    file = tmp_path / "ownpackage" / "solver.py"
    file.write_text("def solve(x):\n    return x * 1.0\n")
    solver = importlib.import_module("ownpackage.solver")
    package = sys.modules["ownpackage"]

    def late(x: Any) -> Any:
        import ownpackage.solver

        return ownpackage.solver.solve(x)

    functions = [lambda x: solver.solve(x), lambda x: package.solver.solve(x), late]
    runs = [computed(function) for function in functions]
    file.write_text("def solve(x):\n    return x * 2.0  # repaired\n")
    importlib.reload(solver)
    names: dict[str, Any] = {"solver": solver, "ownpackage": package, "__name__": "__main__"}
    exec("def f(x):\n    return ownpackage.solver.solve(x)", names)
    for stored, values in runs:
        with pytest.raises(ResponseError, match="has changed since"):
            stored.refuse_change([POINTS], values, stored)
    sys.modules.pop("ownpackage.solver")
    sys.modules.pop("ownpackage")


@pytest.mark.parametrize("as_path", [True, False])
def test_a_file_that_a_text_names(as_path: bool, tmp_path: Path) -> None:
    path = tmp_path / "load.txt"
    path.write_text("1.0")
    name = path if as_path else str(path)
    stored, values = computed(lambda x: float(np.loadtxt(name)) * x)
    stored.refuse_change([POINTS], values, stored)
    path.write_text("2.00")
    for _ in range(2):
        with pytest.raises(ResponseError, match="name has changed since"):
            stored.refuse_change([POINTS], values, stored)


def test_a_program_that_a_command_names(tmp_path: Path) -> None:
    program = tmp_path / "solver.py"
    program.write_text("print(1.0 * float(open('in.txt').read()))")
    response = prb.command(
        [sys.executable, "-S", program],
        inputs=["x"],
        write={"in.txt": "{x}"},
        read=lambda folder: float((folder / "stdout.txt").read_text()),
    )
    responses = responses_of(response)
    points = POINTS[:4]
    with responses.kept_runs():
        values = responses([points], [])
    responses.refuse_change([points], values, responses)
    assert not responses.may_differ
    program.write_text("print(2.00 * float(open('in.txt').read()))")
    with pytest.raises(ResponseError, match="has changed since"):
        responses.refuse_change([points], values, responses)


@pytest.mark.parametrize("metric", [None, prb.KullbackLeibler()])
def test_uses_of_a_model_after_a_change_are_refused(metric: Any) -> None:
    class Own(Machine):
        pass

    machine = Own()
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1))
        observed = np.random.default_rng(3).normal(1, 0.5, 20)
        prb.Simulator("y", machine, x, metric=metric, observed=observed, progressbar=False)
        optimum = prb.minimize(starts=0, progressbar=False)
    prb.predict(optimum, machine, x, model=model)
    machine.load = 2.0
    uses: dict[str, Callable[[], Any]] = {
        "prb.predict": lambda: prb.predict(optimum, machine, x, model=model),
        "y": lambda: prb.minimize(model, progressbar=False),
        "y ": lambda: prb.sample(model=model, progressbar=False),
        "y  ": lambda: prb.sample(model=model, optimum=optimum, progressbar=False),
        "prb.exceedance": lambda: prb.exceedance(optimum, machine, 2.0, x, model=model),
    }
    for caller, use in [*uses.items(), *uses.items()]:
        with pytest.raises(ResponseError, match=rf"{caller.strip()}: got .*load has changed"):
            use()
    if metric is None:
        with pytest.raises(ResponseError, match=r"load has changed"):
            model.compile_logp()
    # What is computed anew is right.
    machine.load = 1.0
    prb.predict(optimum, machine, x, model=model)


@pytest.mark.parametrize("metric", [None, prb.KullbackLeibler()])
def test_runs_are_repeated_on_request(
    metric: Any, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("LOAD", "1.0")  # as on a server: the comparison cannot see it
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1))
        observed = np.random.default_rng(3).normal(1, 0.5, 20)
        response = scalar(lambda x: float(os.getenv("LOAD", "")) * x)
        prb.Simulator("y", response, x, metric=metric, observed=observed, progressbar=False)
        prb.Simulator("z", response, x, metric=prb.AreaMetric(), observed=observed,
                      propagation=prb.Resimulated(8), progressbar=False)  # fmt: skip
        assert prb.repeat_runs() == {"y": 0, "z": 0} if metric is None else {"y": 3, "z": 0}
        if metric is None:
            model.compile_logp()
        before = sum(s.responses.computed for s in with_data(Evaluator.of(model)))
        with caplog.at_level(logging.INFO, "prbayes"):
            assert prb.repeat_runs() == {"y": 3, "z": 0}
        assert "3 runs of y repeated" in caplog.text
        assert sum(s.responses.computed for s in with_data(Evaluator.of(model))) == before + 3
        monkeypatch.setenv("LOAD", "2.0")
        with_unchanged_runs(Evaluator.of(model))  # silent, as docs/limits.md says
        with pytest.raises(ResponseError, match="a file or variable that it reads has changed"):
            prb.repeat_runs()
    with pytest.raises(TypeError, match=r"prb\.repeat_runs"):
        prb.repeat_runs()


# -- what is no change -----------------------------------------------------------------------------


def harmless(kind: str) -> Any:
    """Return a response whose calls change something."""
    memory: dict[float, float] = {}
    by_text: dict[str, float] = {}
    log: list[str] = []
    rng = np.random.default_rng(0)
    lock = threading.Lock()
    logger = logging.getLogger("harmless")
    state = types.SimpleNamespace(calls=0, last=None, table=None)

    def counter(x: Any) -> Any:
        state.calls += 1
        log.append("a call")
        return x * 1.0

    def memo(x: Any) -> Any:
        for value in np.ravel(x):
            memory.setdefault(float(value), float(value))
            by_text.setdefault(str(value), float(value))
        return x * 1.0

    def generator(x: Any) -> Any:
        rng.random()
        return x * 1.0

    def logging_(x: Any) -> Any:
        logger.debug("a call")
        return x * 1.0

    def last(x: Any) -> Any:
        state.last = np.array(x)
        return x * 1.0

    def lazy(x: Any) -> Any:
        if state.table is None:
            state.table = np.ones(3)
        return x * state.table[0]

    def locking(x: Any) -> Any:
        with lock:
            return x * 1.0

    @functools.lru_cache
    def cached(x: float) -> float:
        return x

    functions = {
        "counter": counter,
        "memory": memo,
        "generator": generator,
        "logger": logging_,
        "last": last,
        "lazy": lazy,
        "lru_cache": np.vectorize(cached),
        "numba": numba.njit(lambda x: x * 1.0),
        "lock": locking,
    }
    return functions[kind]


@pytest.mark.parametrize(
    "kind",
    ["counter", "memory", "generator", "logger", "last", "lazy", "lru_cache", "numba", "lock"],
)
def test_what_calls_change_is_no_change(kind: str) -> None:
    stored, values = computed(harmless(kind))
    other, _ = computed(stored.function)
    for _ in range(3):
        for responses in (stored, other):
            responses.refuse_change([POINTS], values, responses)
            assert not responses.may_differ
    # Three runs are repeated once.
    assert (stored.n_repeated, other.n_repeated) == (3, 3)


def test_a_look_at_a_table_and_other_variables_are_no_change() -> None:
    table = pd.DataFrame({"load": [1.0, 2.0]}, index=["a", "b"])
    names: dict[str, Any] = {"table": table, "np": np, "__name__": "__main__"}
    exec("def f(x):\n    return table['load'].mean() / 1.5 * np.sin(x)", names)
    stored, values = computed(names["f"])
    stored.refuse_change([POINTS], values, stored)
    names.update(mean=3.0, load=4.0, sin=np.cos)  # names of attributes, not of variables
    assert table["load"].to_numpy()[0] == 1.0
    assert table.loc["b", "load"] == 2.0
    assert str(table.describe())
    stored.function(0.0)
    assert not stored.may_differ
    names["np"] = types.SimpleNamespace(sin=np.cos)
    assert stored.may_differ


@pytest.mark.parametrize("function", [np.float_power, np.heaviside, zetac, np.vectorize(abs)])
def test_a_look_at_a_signature_is_no_change(function: Any) -> None:
    def response(x: Any) -> Any:
        return function(x)

    digests = digests_of(response)
    # Functions of arrays keep their signature as an attribute, and their dictionary begins.
    inspect.signature(function)
    repr(function)
    assert not changed_names(digests, digests_of(response))


def test_calls_by_hand_are_no_change() -> None:
    stored, _ = computed(harmless("counter"))
    for _ in range(2):
        stored.function(0.5)
        assert not stored.may_differ


def test_a_variable_that_is_loaded_at_the_first_call_may_not_change_later() -> None:
    class Lazy:
        table: Any = None

        def __call__(self, x: Any) -> Any:
            if self.table is None:
                self.table = np.ones(3)
            return self.table[0] * x

    response = Lazy()
    stored, values = computed(response)
    response.table = np.full(3, 2.0)
    with pytest.raises(ResponseError, match="table has changed"):
        stored.refuse_change([POINTS], values, stored)


def test_runs_that_agree_after_a_change_are_accepted_and_counted() -> None:
    settings = {"load": 1.0, "title": "first"}
    stored, values = computed(lambda x: settings["load"] * x)
    before = stored.computed
    settings["title"] = "second"
    assert stored.may_differ
    stored.refuse_change([POINTS], values, stored)
    assert not stored.may_differ
    assert stored.computed == before + 64  # all of them, as they take less than ten seconds
    stored.refuse_change([POINTS], values, stored)
    assert stored.computed == before + 64


# -- any object ------------------------------------------------------------------------------------


class Evil:
    """An object all of whose methods raise."""

    __hash__ = None  # type: ignore[assignment]

    def __getattr__(self, name: str) -> Any:
        raise RuntimeError(name)

    def __eq__(self, other: object) -> bool:
        raise RuntimeError

    def __repr__(self) -> str:
        raise RuntimeError

    def __reduce_ex__(self, protocol: Any) -> Any:
        raise RuntimeError

    def __len__(self) -> int:
        raise RuntimeError

    @property
    def __class__(self) -> Any:
        raise RuntimeError


def with_odd_attribute() -> Any:
    machine = Machine()
    vars(machine)[Odd()] = 1  # type: ignore[index]
    return machine


class Odd:
    def __format__(self, text: str) -> str:
        raise RuntimeError

    def __repr__(self) -> str:
        raise RuntimeError


def recursive() -> Any:
    a: list[Any] = [1]
    a.append({"a": a})
    return a


def deep() -> Any:
    a: list[Any] = []
    for _ in range(20_000):
        a = [a]
    return a


OBJECTS: dict[str, Callable[[], Any]] = {
    "evil": Evil,
    "odd attribute": with_odd_attribute,
    "recursive": recursive,
    "deep": deep,
    "many": lambda: {i: (i, str(i)) for i in range(100_000)},
    "generator": lambda: (i for i in range(3)),
    "thread": threading.current_thread,
    "file": lambda: sys.stdout,
    "main": lambda: sys.modules["__main__"],
    "ufunc": lambda: np.sin,
    "python ufunc": lambda: np.frompyfunc(abs, 1, 1),
    "class": lambda: dict,
    "weakref": lambda: __import__("weakref").ref(Machine),
    "memoryview": lambda: memoryview(b"abc"),
    "records": lambda: np.zeros(2, [("a", float), ("b", object)]),
    "empty": lambda: np.empty((0, 3)),
    "masked": lambda: np.ma.masked_array([1.0, 2.0], [True, False]),
    "surrogate": lambda: "\udc80",
    "null": lambda: "a\0b",
    "set": lambda: {1, "a", (2, object())},
    "model": lambda: MODEL,
    "frame": sys._getframe,
    "pool": lambda: __import__("concurrent.futures").futures.ThreadPoolExecutor(1),
}


@pytest.mark.parametrize("kind", OBJECTS)
def test_any_object_has_a_digest(kind: str) -> None:
    value = OBJECTS[kind]()

    def response(x: Any) -> Any:
        return x if value else -x

    digests = digests_of(response)
    assert digests_of(response) == digests
    assert digests_of(value)
    assert len(json.dumps(digests)) < 200_000


@pytest.mark.long
def test_digests_are_the_same_in_other_processes() -> None:
    script = (
        "import functools, json, sys, types, numpy as np\n"
        "from prbayes.response.variables import digests_of\n"
        "names = {'a', 'b', 'c', 'load', 1, 2.5}\n"
        "class M:\n    k = {'x', 'y', 'z'}\n    def __call__(self, x): return x in {'p', 'q', 'r'}\n"
        "m = M(); m.load = np.ones(3); m.rng = np.random.default_rng(1); m.f = len; m.g = np.sin\n"
        "m.o = types.SimpleNamespace(a=object(), b=lambda x: names)\n"
        "f = functools.partial(lambda a, x: names and m(x), 3)\n"
        "print(json.dumps(digests_of(f)))\n"
    )
    outputs = set()
    for seed in "12":
        environment = {**os.environ, "PYTHONHASHSEED": seed}
        command = [sys.executable, "-c", script]
        run = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        outputs.add(run.stdout)
    assert len(outputs) == 1
    assert len(json.loads(outputs.pop())) > 10


def test_a_function_has_one_record_which_ends_with_it() -> None:
    function = Machine()
    record = watched(function)
    assert watched(function) is record
    assert record.compared() == record.compared() == 0
    function.load = 2.0
    assert record.compared() == 1
    assert record.names == ["load"]


def test_names_of_changes() -> None:
    before = {"a": "1", "b": "2", "c": None, "d": "4"}
    now = {"a": "1", "b": "3", "c": "5", "e": "6"}
    assert changed_names(before, now) == ["b", "e", "d"]


# -- stores ----------------------------------------------------------------------------------------


def test_a_store_compares_many_runs_of_other_code_and_few_of_the_same(tmp_path: Path) -> None:
    def made(width: float) -> Any:
        return lambda x: np.where(np.abs(x - 0.8) < width, x + 1, x)

    def count(width: float) -> int:
        responses = responses_of(made(width), store=tmp_path)
        responses([POINTS], [])
        return responses.computed

    assert count(0.0) == 64
    assert count(0.0) == 3
    with pytest.raises(StoreError, match="another function, or its variables have changed"):
        count(0.1)
    # An interval without a run is no change; the store remembers it.
    assert count(1e-9) == 64
    assert (count(1e-9), count(0.0)) == (3, 3)


def test_a_store_of_an_earlier_version_is_read_and_checked(tmp_path: Path) -> None:
    responses_of(lambda x: x * 1.0, store=tmp_path)([POINTS], [])
    with closing(sqlite3.connect(tmp_path / "responses.sqlite")) as connection:
        connection.execute("DROP TABLE code")
    responses = responses_of(lambda x: x * 1.0, store=tmp_path)
    responses([POINTS], [])
    assert responses.computed == 64


def test_digests_of_a_store_are_protected_by_a_checksum(tmp_path: Path) -> None:
    responses_of(lambda x: x * 1.0, store=tmp_path)([POINTS], [])
    with closing(sqlite3.connect(tmp_path / "responses.sqlite")) as connection:
        connection.execute("UPDATE code SET digests = '{}'")
        connection.commit()
    text = f"got {re.escape(str(tmp_path))}.*digests of .* checksum"
    with pytest.raises(StoreError, match=text):
        responses_of(lambda x: x * 1.0, store=tmp_path)([POINTS], [])


# -- states ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("period", "n"), [(2, 128), (7, 256)])
def test_a_state_of_some_places_of_a_batch_is_found(period: int, n: int) -> None:
    def response(x: Any) -> Any:
        values = np.array(x, float)
        values[period - 1 :: period] += 1.0
        return values

    points = np.random.default_rng(0).normal(size=n)
    with pytest.raises(ResponseError, match="depends on the other specimens"):
        responses_of(response)([points], [])
