"""Every public object has a plain `pickle`: the table has to name all of them."""

from __future__ import annotations

import inspect
import pickle
from collections.abc import Callable
from functools import cache
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import xarray as xr
from line_problem import build, line

import prbayes as prb
from prbayes.model.random_variable import nodes

QUIET: dict[str, Any] = {"progressbar": False}


@cache
def optimum() -> prb.Optimum:
    return prb.minimize(build(prb.Reweighted(64), epsilon=None)[0], starts=0, **QUIET)


@cache
def posterior() -> xr.DataTree:
    return prb.sample_smc(20, chains=2, model=optimum().model, optimum=optimum(), **QUIET)


@cache
def predicted() -> xr.DataArray:
    (x,) = next(iter(nodes(optimum().model).values())).bound.inputs.aleatory
    return prb.predict(optimum(), line, x, n_samples=50, **QUIET)


@cache
def surrogate() -> prb.Surrogate:
    return prb.Surrogate.fit(np.square, {"x": (0, 1)}, 20, **QUIET).with_error()


# An object of each public class, or of a class that derives from it.
MAKE: dict[str, Callable[[], Any]] = {
    "AreaMetric": prb.AreaMetric,
    "Diagnosis": lambda: prb.diagnose(optimum()),
    "Fresh": lambda: prb.Fresh(8),
    "FunctionMetric": lambda: prb.FunctionMetric(np.mean),
    "GaussianKDE": lambda: prb.GaussianKDE(0.3),
    "Histogram": lambda: prb.Histogram(9),
    "Joint": lambda: prb.Joint(prb.KullbackLeibler(), directions=5),
    "KullbackLeibler": prb.KullbackLeibler,
    "LogLikelihood": lambda: prb.LogLikelihood(density=prb.GaussianKDE()),
    "Metric": lambda: prb.ProbabilityResidual(density=prb.Histogram(4)),
    "Optimum": optimum,
    "ProbabilityResidual": prb.ProbabilityResidual,
    "Report": lambda: prb.Report("A beam", optimum=optimum().to_datatree()),
    "Resimulated": lambda: prb.Resimulated(8),
    "families.LogSinhArcsinh": prb.families.LogSinhArcsinh,
    "families.SinhArcsinh": prb.families.SinhArcsinh,
    "readings.Binomial": lambda: prb.readings.Binomial(9),
    "readings.Combined": lambda: prb.readings.Combined(0.1, 0.2),
    "readings.NegativeBinomial": lambda: prb.readings.NegativeBinomial(2.0),
    "readings.Poisson": prb.readings.Poisson,
    "readings.ReadingDistribution": prb.readings.ReadingDistribution,
    "Reweighted": lambda: prb.Reweighted(64, on_failure=prb.response.Replace()),
    "Runs": lambda: prb.Runs(np.linspace(0, 1, 12), np.linspace(0, 1, 12) ** 2),
    "Summary": lambda: prb.Summary(n=12, mean=1.0, sd=0.2),
    "Surrogate": surrogate,
    "abc_distance": lambda: prb.abc_distance(prb.AreaMetric()),
    "decision.Interval": lambda: prb.decision.Interval(0.9, 1.1),
    "metrics.DensityDiscrepancy": lambda: prb.KullbackLeibler().against(np.arange(9.0)),
    "metrics.DensityEstimator": lambda: prb.Histogram(4),
    "metrics.Discrepancy": lambda: prb.AreaMetric().against(np.arange(9.0)),
    "metrics.Minimum": lambda: prb.metrics.Minimum.QUADRATIC,
    "propagation.DesignError": lambda: prb.propagation.DesignError("y: too thin"),
    "propagation.Propagation": lambda: prb.Fresh(16),
    "reports.Section": lambda: prb.reports.Section("A title"),
    "response.Abort": prb.response.Abort,
    "response.Stochastic": lambda: prb.response.Stochastic(np.square),
    "response.Additive": lambda: prb.response.Additive([20.0, 1000.0]),
    "response.BudgetError": lambda: prb.response.BudgetError("max_seconds = 1 was reached"),
    "response.Cost": lambda: prb.cost(optimum().model),
    "response.Multiplicative": lambda: prb.response.Multiplicative([20.0, 1000.0]),
    "response.Replace": lambda: prb.response.Replace(1.0),
    "response.ResponseError": lambda: prb.response.ResponseError("y: it raised"),
    "response.Retry": lambda: prb.response.Retry(2),
    "response.Smooth": lambda: prb.response.Smooth(0.0),
    "response.StoreError": lambda: prb.response.StoreError("y: store"),
    "scalar": lambda: prb.scalar(abs),
    "surrogate.CrossValidation": lambda: surrogate().error,
    "surrogate.GaussianProcess": prb.surrogate.GaussianProcess,
    "surrogate.Polynomial": lambda: prb.surrogate.Polynomial(3),
    "surrogate.RadialBasis": prb.surrogate.RadialBasis,
    "surrogate.Surface": prb.surrogate.RadialBasis,
    "validation.ExactModel": prb.validation.ExactModel,
    "validation.JointNull": lambda: prb.validation.JointNull(optimum(), replicates=19),
    "validation.PosteriorNull": lambda: prb.validation.PosteriorNull(19),
    "validation.ValidityTest": lambda: prb.area_test([1.0, 1.5, 2.0], predicted(), **QUIET),
}
# Objects inside a model, which are pickled with it.
INSIDE = {
    "decision.Condition",
    "decision.Exceedance",
    "decision.Mean",
    "decision.Quantile",
    "decision.Quantity",
    "decision.StandardDeviation",
    "posterior.BatchedKernel",
    "propagation.Bound",
}
RESULTS: dict[str, Callable[[], Any]] = {
    "sample_smc": posterior,
    "predict": predicted,
    "sampling": lambda: optimum().sampling(),
    "to_datatree": lambda: optimum().to_datatree(),
}


def test_the_table_has_all_public_classes() -> None:
    objects: dict[str, object] = {}
    for name in prb.__all__:
        value = getattr(prb, name)
        inner = value.__all__ if isinstance(value, ModuleType) else ()
        objects |= {f"{name}.{key}": getattr(value, key) for key in inner} or {name: value}
    classes = {name for name, value in objects.items() if isinstance(value, type)}
    assert set(MAKE) | INSIDE | {"response.Store"} == classes


@pytest.mark.parametrize("name", MAKE | RESULTS)
def test_objects_come_back_from_a_plain_pickle(name: str) -> None:
    made = (MAKE | RESULTS)[name]()
    back = pickle.loads(pickle.dumps(made))
    assert type(back) is type(made)
    if isinstance(made, xr.DataTree | xr.Dataset | xr.DataArray):
        assert back.identical(made)
    elif "at 0x" not in repr(made):
        assert repr(back) == repr(made)


def test_functions_and_stores_have_a_plain_pickle(tmp_path: Any) -> None:
    functions = [getattr(prb, name) for name in prb.__all__]
    for function in filter(inspect.isfunction, functions):
        assert pickle.loads(pickle.dumps(function)) is function
    store = prb.response.Store(tmp_path, "y", columns=1)
    store.add(np.array([[1.0]]), np.array([2.0]))
    assert len(pickle.loads(pickle.dumps(store))) == 1
