"""Comparison of optima and posteriors: estimates, intervals, costs and scores."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pymc as pm
import xarray as xr
from scipy.special import ndtri

from prbayes._display import view
from prbayes._stats import INTERVAL
from prbayes._validate import Floats, called
from prbayes.metrics.area import AreaMetric
from prbayes.metrics.base import Discrepancy, Metric
from prbayes.metrics.density import GaussianKDE
from prbayes.metrics.divergence import KullbackLeibler, ProbabilityResidual
from prbayes.metrics.likelihood import LogLikelihood
from prbayes.metrics.multivariate import Joint
from prbayes.model.description import labelled
from prbayes.model.emulated import PopulationSimulator
from prbayes.model.evaluator import Evaluator, shortcomings, specimen_log_likelihoods
from prbayes.model.fingerprint import as_attributes, require_together
from prbayes.model.locking import locked
from prbayes.model.parameters import (
    coordinates,
    element_names,
    optimum_elements,
    readable_elements,
    single_elements,
    split_elements,
    stacked_draws,
    table_elements,
    variable_of,
)
from prbayes.model.random_variable import simulators
from prbayes.model.specimen_likelihood import specimen_likelihoods
from prbayes.optimize.design_refinement import temporary_first_samples
from prbayes.optimize.optimum import Optimum, identity_in
from prbayes.response.inputs import event_shape

# Variables by result that are no scores.
COSTS = ("n_responses", "seconds")
_KERNEL = LogLikelihood(density=GaussianKDE())
_METRICS = (ProbabilityResidual(), KullbackLeibler(), AreaMetric(), _KERNEL)


@locked
def compare(
    results: Mapping[str, Optimum | xr.DataTree],
    *,
    model: pm.Model | None = None,
    metrics: Sequence[Metric] | None = None,
) -> xr.Dataset:
    """Compare optima and posteriors, one row per result and hyperparameter.

    Parameters
    ----------
    results : mapping
        `Optimum` objects, their DataTrees, and DataTrees with a ``posterior`` group, by the label
        they get.
    model : pymc.Model, optional
        Restricts the table to the model's variables, its deterministics among them; by default all
        that the results share. Of a ``pymc.LKJCholeskyCov`` standard deviations and correlations
        are shown. Its data, and its populations, score the results.
    metrics : sequence of Metric, optional
        Under which each estimate is scored, whatever it was made with. By default all four where
        that costs no response (`Reweighted`); under the other propagations each result costs n
        responses per simulator.

    Returns
    -------
    xarray.Dataset
        With dimensions ``result`` and ``hyperparameter``: ``estimate`` (the optimum, or the
        posterior mean), ``sd`` (the standard error, or the posterior standard deviation),
        ``lower`` and ``upper`` (an 89% interval: normal, or equal-tailed), ``shift`` (of the
        estimate from that of the first result, in this
        result's sd); and by result: ``n_responses`` and ``seconds``, NaN if a result does not have
        them, and the discrepancy of the estimate's population under each metric, by the metric's
        class, with the simulator's name before it if there are several; NaN where stored responses
        do not support it. Of a simulator with the log-likelihood by specimen, populations are
        emulated, and ``LogLikelihood by specimen`` is minus its mean over the specimens. A notebook
        shows it as a table.

    Raises
    ------
    TypeError, ValueError
        If there is no result, one is of another type, they share no hyperparameter, or they are of
        other populations or data than the model or the first of them.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
    ...     y = prb.Simulator("y", lambda x: 2 * x, x, metric=prb.AreaMetric(), observed=[0, 2, 4])
    >>> table = prb.compare({"optimum": prb.minimize(model)}, model=model)
    >>> table.hyperparameter.values.tolist()
    ['mu']
    """
    if not isinstance(results, Mapping):
        raise TypeError(
            f"compare: results: got {called(results)}, expected a mapping such as "
            "{'optimum': optimum, 'ABC': idata}"
        )
    if metrics is not None and not (
        isinstance(metrics, Sequence) and all(isinstance(m, Metric) for m in metrics)
    ):
        raise TypeError(
            f"compare: metrics: got {called(metrics)}, expected metric objects, such as "
            "[prb.AreaMetric()]"
        )
    if not results:
        raise ValueError(
            "compare: got no results, expected a dict such as {'optimum': optimum, 'ABC': idata}"
        )
    identities = {label: identity_in(result) for label, result in results.items()}
    try:
        identity = require_together(identities, "compare", model=model)
    except ValueError as error:
        raise ValueError(f"{error}; models of the same data are compared by prb.rank") from None
    optima = [result for result in results.values() if isinstance(result, Optimum)]
    # Draws without coordinates have those of the model.
    naming = model or next((optimum.model for optimum in optima), None)
    columns = {label: _column(label, result, naming) for label, result in results.items()}
    shared = _shared_elements(list(columns.values()), model)
    in_table = set.intersection(*(column.in_table for column in columns.values()))
    names = readable_elements(name for name in shared if name in in_table)
    if not names:
        raise ValueError(
            f"compare: got results {list(results)} that share no hyperparameter, "
            "expected the same model"
        )
    table = _table(columns, names)
    estimates, sds = table[..., 0], table[..., 1]
    with np.errstate(divide="ignore", invalid="ignore"):  # a result without spread
        shift = (estimates - estimates[0]) / sds
    shift[0] = 0.0
    dims = ["result", "hyperparameter"]
    data: dict[str, Any] = {key: (dims, table[..., i]) for i, key in enumerate(_Estimate._fields)}
    data["shift"] = (dims, shift)
    for key in COSTS:
        data[key] = ("result", [getattr(column, key) for column in columns.values()])
    if model is not None and (simulators(model) or specimen_likelihoods(model)):
        # The designs of a model cover its own optimum.
        is_covered = any(optimum.model is model for optimum in optima)
        values = _table(columns, shared)[..., 0]
        for key, scores in _scores(model, shared, values, metrics, is_covered=is_covered).items():
            data[key] = ("result", scores)
    coords = {"result": list(columns), "hyperparameter": names}
    attrs = {"interval": INTERVAL, **as_attributes(identity)}
    return Comparison(data, coords=coords, attrs=attrs)


class Comparison(xr.Dataset):  # type: ignore[no-untyped-call]
    """A dataset that notebooks show as a table."""

    __slots__ = ()

    def _repr_html_(self) -> str:
        """Show estimates as a table, and scores as sentences; a selection as xarray does."""
        is_whole = set(self.dims) == {"result", "hyperparameter"}
        if not (is_whole and set(_Estimate._fields) <= set(self.data_vars)):
            return super()._repr_html_()
        rows = []
        for name in self["hyperparameter"].values:
            for label in self["result"].values:
                row = self.sel(hyperparameter=name, result=label)
                estimate, sd, lower, upper = (f"{float(row[key]):.4g}" for key in _Estimate._fields)
                rows.append([str(name), str(label), estimate, sd, f"{lower} to {upper}"])
        sentences = []
        for key, scores in self.data_vars.items():
            if scores.dims == ("result",) and key not in COSTS:
                items = scores.to_series().items()
                listed = ", ".join(f"{label} {score:.4g}" for label, score in items)
                sentences.append(f"Discrepancy by {key}: {listed}.")
        header = ["", "result", "estimate", "sd", f"{INTERVAL:.0%} interval"]
        return view("Comparison", header=header, rows=rows, sentences=sentences)


# -- estimates -------------------------------------------------------------------------------------


class _Estimate(NamedTuple):
    """The estimate of one element by one result."""

    estimate: float
    sd: float
    lower: float
    upper: float


@dataclass(frozen=True)
class _Column:
    """Estimates of a result by element, and its cost."""

    elements: dict[str, _Estimate]
    in_table: set[str]  # elements that a table shows
    n_responses: float
    seconds: float


def _table(columns: Mapping[str, _Column], names: Sequence[str]) -> Floats:
    """Return estimate, sd, lower and upper, shape (results, elements, 4)."""
    return np.array([[column.elements[name] for name in names] for column in columns.values()])


def _column(label: str, result: Any, naming: pm.Model | None) -> _Column:
    """Read a result of any kind; draws without coordinates have those of a model."""
    if isinstance(result, Optimum):
        point, stderr = (
            labelled(result.evaluator, values, {}).data_vars
            for values in (result.point, result.stderr)
        )
        return _optimum_column(point, stderr, (float(result.n_responses), result.search.seconds))
    groups = result.children if isinstance(result, xr.DataTree) else {}
    if "posterior" in groups:
        draws = stacked_draws(result["posterior"], model=naming)
        tails = [(1 - INTERVAL) / 2, (1 + INTERVAL) / 2]
        estimates = {}
        for element, x in split_elements(draws).items():
            lower, upper = np.quantile(x, tails)
            estimates[element] = _Estimate(float(x.mean()), float(x.std(ddof=1)), lower, upper)
        cost = _cost(result["posterior"].attrs)
        return _Column(estimates, set(table_elements(draws)), *cost)
    if "optimum" in groups:
        optimum, stderr = result["optimum"], result["stderr"].data_vars
        return _optimum_column(optimum.data_vars, stderr, _cost(optimum.attrs))
    raise TypeError(
        f"compare: results: {label}: got {type(result).__name__}, "
        "expected an Optimum or a DataTree with a posterior group"
    )


def _optimum_column(
    point: Mapping[Any, Any], stderr: Mapping[Any, Any], cost: tuple[float, float]
) -> _Column:
    """Return estimates, standard errors and normal intervals of an optimum."""
    z = ndtri((1 + INTERVAL) / 2)
    errors = single_elements(stderr)
    estimates = {}
    for element, value in single_elements(point).items():
        sd = errors[element]
        estimates[element] = _Estimate(value, sd, value - z * sd, value + z * sd)
    return _Column(estimates, set(optimum_elements(point, stderr)), *cost)


def _cost(attrs: Mapping[Any, Any]) -> tuple[float, float]:
    return float(attrs.get("n_responses", np.nan)), float(attrs.get("seconds", np.nan))


def _shared_elements(columns: list[_Column], model: pm.Model | None) -> list[str]:
    """Return the elements that all results have, of the model's variables if it is passed."""
    names = [name for name in columns[0].elements if all(name in c.elements for c in columns)]
    if model is None:
        return names
    variables = {variable.name for variable in model.unobserved_RVs}
    return [name for name in names if variable_of(name) in variables]


# -- scores ----------------------------------------------------------------------------------------


def _scores(
    model: pm.Model,
    names: list[str],
    estimates: Floats,
    metrics: Sequence[Metric] | None,
    *,
    is_covered: bool,
) -> dict[str, Floats]:
    """Return discrepancies of estimates, shape (results, elements), by simulator and metric.

    Designs that do not cover the estimates grow temporarily, unless ``is_covered``.
    """
    evaluator = Evaluator.of(model)
    if metrics is None and evaluator.responses_per_theta:
        return {}  # scores that were not requested compute no response
    thetas = _thetas(evaluator, names, estimates)
    if thetas is None:
        return {}
    with nullcontext() if is_covered else temporary_first_samples(evaluator, thetas):
        lacking = [shortcomings(evaluator, theta[None]) for theta in thetas]
        several = len(evaluator.simulators) > 1
        scores = {}
        for k, simulator in enumerate(evaluator.simulators):
            is_supported = np.array([simulator.name not in short for short in lacking])
            prefix = f"{simulator.name} " if several else ""
            for metric in _default_metrics(simulator) if metrics is None else metrics:
                target = metric.against(simulator.observed, simulator.weights)
                values = _discrepancies(evaluator, thetas, k, target)
                scores[f"{prefix}{_class_name(metric)}"] = np.where(is_supported, values, np.nan)
        for name, values in specimen_log_likelihoods(evaluator, thetas).items():
            prefix = f"{name} " if several else ""
            if values.size:
                scores[f"{prefix}LogLikelihood by specimen"] = -values.mean(axis=1)
        return scores


def _discrepancies(evaluator: Evaluator, thetas: Floats, k: int, target: Discrepancy) -> Floats:
    """Return the discrepancies of the k-th simulator's populations from a target, (results,)."""
    simulator = evaluator.simulators[k]
    if not simulator.is_emulated:
        return simulator.bound.discrepancies(evaluator.roots(thetas, k), target)
    values, weights = evaluator.populations(thetas, k)
    return np.array([target.of(values[[i]], weights[[i]])[0] for i in range(len(thetas))])


def _default_metrics(simulator: PopulationSimulator) -> Sequence[Metric]:
    """Return the metrics of all, or of several outputs the same in all directions.

    A log-likelihood by specimen replaces the kernel form.
    """
    metrics = [m for m in _METRICS if not (simulator.is_emulated and m is _KERNEL)]
    return [Joint(m) for m in metrics] if simulator.observed.ndim > 1 else metrics


def _class_name(metric: Metric) -> str:
    """Return the class of a metric, with that of its inner metric."""
    inner = getattr(metric, "metric", None)
    name = type(metric).__name__
    return f"{name}({type(inner).__name__})" if isinstance(inner, Metric) else name


def _thetas(evaluator: Evaluator, names: list[str], estimates: Floats) -> Floats | None:
    """Return the estimates as thetas, shape (results, d); None if an element is missing."""
    values = []
    for rv in evaluator.model.free_RVs:
        shape = event_shape(rv)
        elements = element_names(str(rv.name), shape, coordinates(evaluator.model, str(rv.name)))
        if not set(elements) <= set(names):
            return None
        columns = [names.index(element) for element in elements]
        values.append(estimates[:, columns].reshape(-1, *shape))
    return evaluator.hyperparameters.thetas_of(values)
