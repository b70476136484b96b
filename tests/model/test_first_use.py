"""Runs start at the first use of a model: what is no use, what is one, and what an error leaves."""

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
QUIET: dict[str, Any] = {"progressbar": False}
PROPAGATIONS = {
    "Reweighted": (prb.Reweighted(32), 32),
    "Resimulated": (prb.Resimulated(8), 16),
    "Fresh": (prb.Fresh(8), 16),
}
of_each_propagation = pytest.mark.parametrize(
    ("propagation", "runs"), PROPAGATIONS.values(), ids=PROPAGATIONS
)


class Counted:
    """A response of one specimen that counts its runs, and fails while it is told to."""

    def __init__(self) -> None:
        self.runs = 0
        self.file: Path | None = None

    def __call__(self, x: float) -> float:
        self.runs += 1
        if self.file is not None and not self.file.exists():
            raise FileNotFoundError(self.file)
        return 2 * x


def build(
    response: Any, propagation: Any = PROPAGATIONS["Reweighted"][0], **changes: Any
) -> pm.Model:
    keywords = {"metric": prb.AreaMetric(), "observed": 2 * OBSERVED, "epsilon": 0.1} | changes
    function = prb.scalar(response) if isinstance(response, Counted) else response
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1, 1), pm.HalfNormal("sigma", 1))
        prb.Simulator("y", function, x, propagation=propagation, **keywords)
    return model


def with_data() -> tuple[pm.Model, Counted]:
    response = Counted()
    with pm.Model() as model:
        data = pm.Data("data", 2 * OBSERVED)
        x = pm.Normal.dist(pm.Normal("mu", 1, 1), 1.0)
        given = {"metric": prb.AreaMetric(), "epsilon": 0.1, "propagation": prb.Reweighted(32)}
        prb.Simulator("y", prb.scalar(response), x, observed=data, **given)
    return model, response


# -- what is no use --------------------------------------------------------------------------------

NO_USE: dict[str, Callable[[pm.Model], object]] = {
    "print": str,
    "names": lambda model: (model.str_repr(), model._repr_latex_()),
    "graphviz": pm.model_to_graphviz,
    "mermaid": pm.model_to_mermaid,
    "initial point": lambda model: model.initial_point(),
    "shapes": lambda model: model["y"].shape.eval(),
    "other variables": lambda model: pm.sample_prior_predictive(3, model=model, var_names=["mu"]),
    "clone": clone_model,
    "copy": copy.copy,
    "deepcopy": copy.deepcopy,
    "pickle": lambda model: cloudpickle.loads(cloudpickle.dumps(model)),
    "do": lambda model: pm.do(model, {"mu": 1.0}),
    "observe": lambda model: pm.observe(model, {"mu": 1.0}),
    "other data": lambda model: pm.observe(model, {"y": OBSERVED}),
    "epsilon": lambda model: prb.set_epsilon(model, {"y": 0.2}),
    "epsilon of a clone": lambda model: prb.set_epsilon(clone_model(model), {"y": 0.2}),
    "cost": prb.cost,
}


@pytest.mark.parametrize("what", NO_USE)
@of_each_propagation
def test_what_is_no_use_computes_nothing(propagation: Any, runs: int, what: str) -> None:
    response = Counted()
    model = build(response, propagation)
    NO_USE[what](model)
    assert response.runs == 0
    first_use(model)
    first_use(model)
    assert response.runs == runs


def test_a_later_simulator_of_the_model_computes_nothing() -> None:
    response = prb.scalar(Counted())
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1, 1), 1.0)
        given = {"observed": 2 * OBSERVED, "propagation": prb.Reweighted(16)}
        for name, metric in (("y", prb.AreaMetric()), ("z", prb.KullbackLeibler())):
            prb.Simulator(name, response, x, metric=metric, specimens=range(20), **given)
    assert response.function.runs == 0
    first, second = first_use(model).values()
    assert response.function.runs == 16, "they share their runs"
    assert second.same_inputs == ("y",)
    np.testing.assert_array_equal(first.bound.design.runs.values, second.bound.design.runs.values)


def test_arguments_are_checked_when_the_model_is_written() -> None:
    with pytest.raises(TypeError, match="progressbar"):
        build(Counted(), progressbar="no")
    with pytest.raises(TypeError, match="a metric that takes no weights"):
        build(Counted(), metric=prb.FunctionMetric(lambda a, b: abs(a.mean(-1) - b.mean())))
    with pytest.raises(TypeError, match="emulator: got RadialBasis for aleatory inputs"):
        build(Counted(), prb.Reweighted(32, emulator=prb.surrogate.RadialBasis()))


# -- what is one -----------------------------------------------------------------------------------


def sampled_by(sampler: str) -> Callable[[pm.Model], object]:
    def sample(model: pm.Model) -> object:
        pytest.importorskip(sampler)
        few = {"draws": 5, "tune": 5, "chains": 1, "cores": 1, "random_seed": 1}
        return pm.sample(
            model=model, nuts_sampler=sampler, compute_convergence_checks=False, **few, **QUIET
        )

    return sample


USES: dict[str, Callable[[pm.Model], object]] = {
    "log-density": lambda model: model.logp(),
    "compiled": lambda model: model.compile_logp(mode=PLAIN),
    "predictive": lambda model: pm.sample_prior_predictive(3, model=model, random_seed=1),
    "draw": lambda model: pm.draw(model["y"], random_seed=1),
    "optimum": lambda model: prb.minimize(model, refine=False, starts=0, **QUIET),
    "other data": lambda model: first_use(pm.observe(model, {"y": OBSERVED})),
    "pickled": lambda model: first_use(cloudpickle.loads(cloudpickle.dumps(model))),
    "NUTS": sampled_by("pymc"),
    "nutpie": sampled_by("nutpie"),
}


@pytest.mark.filterwarnings(
    "ignore::DeprecationWarning", "ignore::FutureWarning", "ignore::UserWarning"
)
@pytest.mark.parametrize("what", USES)
def test_the_first_use_computes_the_runs_once(what: str, caplog: pytest.LogCaptureFixture) -> None:
    response = Counted()
    model = build(response)
    with caplog.at_level(logging.INFO, "prbayes"):
        USES[what](model)
    assert caplog.text.count("y: runs at first: 32, less than 1 s; for each value of") == 1
    assert "pass another number in propagation=Reweighted(n=32)" in caplog.text
    if what != "pickled":  # which has a response of its own
        assert response.runs == 32
        first_use(model)
        assert response.runs == 32


def test_a_clone_takes_the_runs_of_its_original_and_the_original_those_of_its_clone() -> None:
    response = Counted()
    model = build(response)
    clone, conditioned = clone_model(model), pm.do(model, {"sigma": 0.7})
    prb.set_epsilon(clone, {"y": 0.2})
    (node,) = first_use(clone).values()
    (original,) = first_use(model).values()
    (other,) = first_use(conditioned).values()
    assert response.runs == 32
    assert (node.epsilon_value, original.epsilon_value, other.epsilon_value) == (0.2, 0.1, 0.1)
    assert len({id(each.bound) for each in (node, original, other)}) == 3


def test_data_that_are_set_before_the_first_use_are_those_that_count() -> None:
    model, response = with_data()
    pm.set_data({"data": OBSERVED[:9]}, model=model)
    pm.model_to_graphviz(model)
    assert response.runs == 0
    (node,) = first_use(model).values()
    assert node.target.observed.tolist() == OBSERVED[:9].tolist()
    pm.set_data({"data": OBSERVED}, model=model)
    first_use(model)
    assert response.runs == 32


def test_two_threads_that_use_a_model_first_compute_its_runs_once() -> None:
    response = Counted()
    model = build(response)
    barrier = threading.Barrier(2)

    def use(_: int) -> object:
        barrier.wait()
        return computed(model["y"].owner.op.simulator)

    with ThreadPoolExecutor(2) as threads:
        first, second = threads.map(use, range(2))
    assert first is second
    assert response.runs == 32


@pytest.mark.parametrize(
    ("propagation", "line"),
    [
        (prb.Reweighted(16), "y: runs at first: 16; for each value of the hyperparameters: 0;"),
        (prb.Fresh(40), "y: runs at first: 16, less than 1 s; for each .*: 40, less than 1 s; .*="),
    ],
)
def test_of_a_function_of_batches_the_line_comes_before_the_only_call(
    propagation: Any, line: str, caplog: pytest.LogCaptureFixture
) -> None:
    lines: list[str] = []

    def response(x: Any) -> Any:
        lines.append(caplog.text)
        return 2 * np.asarray(x)

    with caplog.at_level(logging.INFO, "prbayes"):
        first_use(build(response, propagation))
    assert ("runs at first" in lines[0]) == isinstance(propagation, prb.Reweighted)
    (told,) = [r.getMessage() for r in caplog.records if "runs at first" in r.getMessage()]
    assert re.search(line, told)


# -- errors and budgets ----------------------------------------------------------------------------


@of_each_propagation
def test_after_an_error_the_next_use_tries_again(
    propagation: Any, runs: int, tmp_path: Path
) -> None:
    response = Counted()
    response.file = tmp_path / "mesh"
    model = build(response, propagation)
    for _ in range(2):
        with pytest.raises(prb.response.ResponseError, match=r"^y: .*FileNotFoundError"):
            Evaluator.of(model)
    response.file.touch()
    (node,) = first_use(model).values()
    counts = node.bound.responses
    assert (counts.count, counts.computed, counts.failed) == (runs, runs, ())


def test_what_mixes_its_specimens_is_refused_at_each_use() -> None:
    model = build(lambda x: x - np.mean(x))
    for _ in range(2):
        with pytest.raises(prb.response.ResponseError, match="depends on those that it is comp"):
            first_use(model)


def test_an_interruption_keeps_what_is_stored(tmp_path: Path) -> None:
    class Interrupted(Counted):
        def __call__(self, x: float) -> float:
            if self.runs == 5:
                self.runs += 1
                raise KeyboardInterrupt
            return super().__call__(x)

    response = Interrupted()
    model = build(response, prb.Reweighted(32, store=tmp_path, version="1"))
    with pytest.raises(KeyboardInterrupt):
        first_use(model)
    kept = len(prb.response.Store(tmp_path, "y", version="1"))
    first_use(model)
    assert kept > 0
    assert response.runs == 6 + 32 - kept


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


def test_what_would_waste_the_runs_is_refused_before() -> None:
    response = Counted()
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Poisson("count", 3), 1.0)
        given = {"metric": prb.AreaMetric(), "observed": OBSERVED}
        prb.Simulator("y", prb.scalar(response), x, propagation=prb.Reweighted(32), **given)
    with pytest.raises(TypeError, match="got discrete hyperparameters"):
        prb.minimize(model, **QUIET)
    with pytest.raises(TypeError, match="tolerance: got"):
        prb.minimize(build(response), tolerance="small", **QUIET)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"thetas: got shape \(1, 1\)"):
        prb.refine(build(response), thetas=np.zeros((1, 1)), **QUIET)
    assert response.runs == 0


@pytest.mark.parametrize("shows", [True, False])
def test_the_simulator_s_own_bar_counts_at_the_first_use(shows: bool) -> None:
    hidden: list[bool] = []

    def response(x: Any) -> Any:
        hidden.append(_hidden.get())
        return 2 * np.asarray(x)

    first_use(build(response, progressbar=shows))
    assert set(hidden) == {not shows}
