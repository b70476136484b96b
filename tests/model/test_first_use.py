"""Runs start at the first use of a model: what is a use, and what an error leaves."""

from __future__ import annotations

import copy
import logging
import re
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cloudpickle
import numpy as np
import pymc as pm
import pytest
from first_use import first_use
from pymc.model.fgraph import clone_model

import prbayes as prb
from prbayes._progress import _hidden
from prbayes.model.evaluator import Evaluator
from prbayes.model.random_variable import computed
from prbayes.response.compile import PLAIN

OBSERVED = np.random.default_rng(1).normal(1.5, 0.6, 20)
AREA = prb.AreaMetric()
QUIET: dict[str, Any] = {"progressbar": False}
DESIGN = prb.Reweighted(32)
# Runs that are computed again, by themselves, to find a state or scatter.
AGAIN = 3
# Propagations with the number of their first runs, and of calls.
each_propagation = pytest.mark.parametrize(
    ("propagation", "runs", "calls"),
    [(DESIGN, 32, 32 + AGAIN), (prb.Resimulated(8), 16, 16 + AGAIN), (prb.Fresh(8), 16, 16)],
    ids=["Reweighted", "Resimulated", "Fresh"],
)


class Counted:
    """A response of one specimen that counts its runs, and fails without a file."""

    def __init__(self, file: Path | None = None) -> None:
        self.runs = 0
        self.file = file

    def __call__(self, x: float) -> float:
        self.runs += 1
        if self.file is not None and not self.file.exists():
            raise FileNotFoundError(self.file)
        return 2 * x


def build(response: Any, propagation: Any = DESIGN, **changes: Any) -> pm.Model:
    """Return a model; its observed values are data called "data"."""
    function = prb.scalar(response) if isinstance(response, Counted) else response
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1, 1), pm.HalfNormal("sigma", 1))
        given = {"metric": AREA, "observed": pm.Data("data", 2 * OBSERVED), "epsilon": 0.1}
        prb.Simulator("y", function, x, propagation=propagation, **given | changes)
    return model


NO_USE: dict[str, Callable[[pm.Model], object]] = {
    "print": lambda model: (str(model), model.str_repr(), model._repr_latex_()),
    "pictures": lambda model: (pm.model_to_graphviz(model), pm.model_to_mermaid(model)),
    "initial point": lambda model: model.initial_point(),
    "shapes": lambda model: model["y"].shape.eval(mode=PLAIN),
    "other variables": lambda model: pm.sample_prior_predictive(
        3, model=model, var_names=["mu"], compile_kwargs={"mode": PLAIN}
    ),
    "copies": lambda model: (clone_model(model), copy.copy(model), copy.deepcopy(model)),
    "pickle": lambda model: cloudpickle.loads(cloudpickle.dumps(model)),
    "do": lambda model: pm.do(model, {"mu": 1.0}),
    "observe": lambda model: pm.observe(model, {"mu": 1.0}),
    "other data": lambda model: pm.set_data({"data": OBSERVED[:9]}, model=model),
    "epsilon": lambda model: prb.set_epsilon(model, {"y": 0.2}),
    "epsilon of a clone": lambda model: prb.set_epsilon(clone_model(model), {"y": 0.2}),
    "cost": prb.cost,
}


@pytest.mark.parametrize("name", NO_USE)
def test_these_are_no_uses(name: str) -> None:
    response = Counted()
    model = build(response)
    NO_USE[name](model)
    assert response.runs == 0


def test_arguments_are_checked_when_the_model_is_written() -> None:
    with pytest.raises(TypeError, match="progressbar"):
        build(Counted(), progressbar="no")


def sampled_by(sampler: str) -> Callable[[pm.Model], object]:
    def sample(model: pm.Model) -> object:
        pytest.importorskip(sampler)
        few = {"draws": 5, "tune": 5, "chains": 1, "cores": 1, "random_seed": 1}
        settings = {"nuts_sampler": sampler, "compute_convergence_checks": False, **few, **QUIET}
        return pm.sample(model=model, **settings)

    return sample


USES: dict[str, Callable[[pm.Model], object]] = {
    "log-density": lambda model: model.logp(),
    "compiled": lambda model: model.compile_logp(mode=PLAIN),
    "predictive": lambda model: pm.sample_prior_predictive(
        3, model=model, random_seed=1, compile_kwargs={"mode": PLAIN}
    ),
    "draw": lambda model: pm.draw(model["y"], random_seed=1, mode=PLAIN),
    "optimum": lambda model: prb.minimize(model, refine=False, starts=0, **QUIET),
    "other data": lambda model: first_use(pm.observe(model, {"y": OBSERVED})),
    "pickled": lambda model: first_use(cloudpickle.loads(cloudpickle.dumps(model))),
    "NUTS": sampled_by("pymc"),
    "nutpie": sampled_by("nutpie"),
}


@pytest.mark.filterwarnings(
    "ignore::DeprecationWarning", "ignore::FutureWarning", "ignore::UserWarning"
)
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.long] if name in ("NUTS", "nutpie") else [])
        for name in USES
    ],
)
def test_the_first_use_computes_the_runs_once(name: str, caplog: pytest.LogCaptureFixture) -> None:
    response = Counted()
    model = build(response, observed=2 * OBSERVED)
    with caplog.at_level(logging.INFO, "prbayes"):
        USES[name](model)
    (message,) = [r.getMessage() for r in caplog.records if "runs at first" in r.getMessage()]
    assert message.startswith("y: runs at first: 32, ")
    assert "for each value of the hyperparameters: 0" in message
    assert "pass another number in propagation=Reweighted(n=32)" in caplog.text
    if name != "pickled":  # with a response of its own
        assert response.runs == 32 + AGAIN
        first_use(model)
        assert response.runs == 32 + AGAIN


def test_shared_runs_are_computed_again_a_few_times_for_each_simulator() -> None:
    class Machine(Counted):
        load = 1.0

        def __call__(self, x: float) -> float:
            return self.load * super().__call__(x)

    machine = Machine()
    response = prb.scalar(machine)
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1, 1), pm.HalfNormal("sigma", 1))
        given: dict[str, Any] = {"metric": AREA, "observed": 2 * OBSERVED, "propagation": DESIGN}
        prb.Simulator("a", response, x, **given)
        first_use(model)
        prb.Simulator("b", response, x, **given)
        first_use(model)
        assert machine.runs == 32 + 2 * AGAIN
        machine.load = 2.0
        prb.Simulator("c", response, x, **given)
        with pytest.raises(prb.response.ResponseError, match=r"^c: got .* has changed since; bui"):
            first_use(model)


def test_two_threads_compute_the_runs_once() -> None:
    response = Counted()
    model = build(response)
    barrier = threading.Barrier(2)

    def use(_: int) -> object:
        barrier.wait()
        return computed(model["y"].owner.op.simulator)

    with ThreadPoolExecutor(2) as threads:
        first, second = threads.map(use, range(2))
    assert first is second
    assert response.runs == 32 + AGAIN


@pytest.mark.parametrize(
    ("propagation", "line"),
    [
        (prb.Reweighted(16), "y: runs at first: 16; for each value of the hyperparameters: 0;"),
        (prb.Fresh(40), "y: runs at first: 16, .* s; for each .*: 40, .* s; .*="),
    ],
)
def test_the_line_of_a_design_comes_before_its_only_call(
    propagation: Any, line: str, caplog: pytest.LogCaptureFixture
) -> None:
    logs: list[str] = []

    def response(x: Any) -> Any:
        logs.append(caplog.text)
        return 2 * np.asarray(x)

    with caplog.at_level(logging.INFO, "prbayes"):
        first_use(build(response, propagation))
    assert ("runs at first" in logs[0]) == isinstance(propagation, prb.Reweighted)
    (message,) = [r.getMessage() for r in caplog.records if "runs at first" in r.getMessage()]
    assert re.search(line, message)


# Errors and budgets.


@each_propagation
def test_after_an_error_the_next_use_tries_again(
    propagation: Any, runs: int, calls: int, tmp_path: Path
) -> None:
    file = tmp_path / "mesh"
    response = Counted(file)
    model = build(response, propagation)
    for _ in range(2):
        with pytest.raises(prb.response.ResponseError, match=r"^y: .*FileNotFoundError"):
            Evaluator.of(model)
    file.touch()
    (node,) = first_use(model).values()
    counts = node.responses
    assert (counts.count, counts.computed, counts.failed) == (runs, runs, ())
    assert response.runs == calls + 2  # one in each use that failed


@pytest.mark.parametrize("budgeted", [prb.minimize, prb.refine, prb.sample_smc])
def test_budgets_include_the_first_runs(budgeted: Any, tmp_path: Path) -> None:
    response = Counted()
    with_store = build(response, prb.Reweighted(32, store=tmp_path, version="1"))
    name = rf"^prb\.{budgeted.__name__}: max_runs = 20 was reached before there was a result; "
    with pytest.raises(prb.response.BudgetError, match=rf"{name}kept: all responses"):
        budgeted(model=with_store, max_runs=20, **QUIET)
    assert response.runs == 20
    first_use(with_store)
    assert response.runs == 32
    without = build(Counted())
    with pytest.raises(prb.response.BudgetError, match=rf"{name}nothing is kept: give the"):
        budgeted(model=without, max_runs=20, **QUIET)
    with pytest.raises(prb.response.BudgetError, match="max_seconds = 1e-09 was reached"):
        budgeted(model=without, max_seconds=1e-9, **QUIET)


def test_invalid_calls_are_refused_before_any_run() -> None:
    response = Counted()
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Poisson("count", 3), 1.0)
        prb.Simulator(
            "y", prb.scalar(response), x, metric=AREA, observed=OBSERVED, propagation=DESIGN
        )
    with pytest.raises(TypeError, match="got discrete hyperparameters"):
        prb.minimize(model, **QUIET)
    with pytest.raises(TypeError, match="tolerance: got"):
        prb.minimize(build(response), tolerance="small", **QUIET)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"thetas: got shape \(1, 1\)"):
        prb.refine(build(response), thetas=np.zeros((1, 1)), **QUIET)
    assert response.runs == 0


@pytest.mark.parametrize("shows", [True, False])
def test_the_simulator_has_its_own_bar(shows: bool) -> None:
    hidden: list[bool] = []

    def response(x: Any) -> Any:
        hidden.append(_hidden.get())
        return 2 * np.asarray(x)

    first_use(build(response, progressbar=shows))
    assert set(hidden) == {not shows}
