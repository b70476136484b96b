"""Optimum and posterior side by side."""

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
from prbayes.metrics.divergence import KullbackLeibler
from prbayes.metrics.joint import Joint
from prbayes.metrics.likelihood import LogLikelihood
from prbayes.metrics.residual import ProbabilityResidual
from prbayes.model.coverage import shortcomings
from prbayes.model.elements import (
    coordinates,
    element_names,
    read_elements,
    single_elements,
    split_elements,
    stacked_draws,
    told_elements,
    told_of,
    variable_of,
    with_coordinates,
)
from prbayes.model.emulated import PopulationSimulator
from prbayes.model.evaluator import Evaluator, specimen_log_likelihoods
from prbayes.model.fingerprint import as_attributes, require_together
from prbayes.model.labels import labelled
from prbayes.model.locking import locked
from prbayes.model.random_variable import simulators
from prbayes.model.specimen_variable import specimen_likelihoods
from prbayes.optimize.design_refinement import temporary_first_samples
from prbayes.optimize.optimum import Optimum, identity_in
from prbayes.response.inputs import event_shape

# What a comparison has by result besides scores.
COSTS = ("n_responses", "seconds")
_KERNEL = LogLikelihood(density=GaussianKDE())
_METRICS = (ProbabilityResidual(), KullbackLeibler(), AreaMetric(), _KERNEL)
# Minus the mean log-likelihood of a specimen, where a simulator has that.
_BY_SPECIMEN = "LogLikelihood by specimen"


@locked
def compare(
    results: Mapping[str, Optimum | xr.DataTree],
    *,
    model: pm.Model | None = None,
    metrics: Sequence[Metric] | None = None,
) -> xr.Dataset:
    """Set optima and posteriors side by side, one row per result and hyperparameter.

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
        result's sd); and by result: ``n_responses`` and ``seconds``, NaN where a result does not
        tell, and the discrepancy of the estimate's population under each metric, by the metric's
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
    _refuse_metrics(metrics)
    if not results:
        raise ValueError(
            "compare: got no results, expected a dict such as {'optimum': optimum, 'ABC': idata}"
        )
    identities = {label: identity_in(result) for label, result in results.items()}
    try:
        identity = require_together(identities, "compare", model=model)
    except ValueError as error:
        raise ValueError(f"{error}; models of the same data are compared by prb.rank") from None
    naming = model or _model_among(results)
    columns = {label: _column(label, result, naming) for label, result in results.items()}
    every = _shared(list(columns.values()), model)
    told = set.intersection(*(column.told for column in columns.values()))
    names = read_elements(name for name in every if name in told)
    if not names:
        raise ValueError(
            f"compare: got results {list(results)} that share no hyperparameter, "
            "expected the same model"
        )
    table = _table(columns, names)
    estimates = table[..., 0]
    sds = table[..., 1]
    with np.errstate(divide="ignore", invalid="ignore"):  # a result without spread
        shift = (estimates - estimates[0]) / sds
    shift[0] = 0.0

    dims = ["result", "hyperparameter"]
    data: dict[str, Any] = {}
    for i, key in enumerate(_Estimate._fields):
        data[key] = (dims, table[..., i])
    data["shift"] = (dims, shift)
    for key in COSTS:
        data[key] = ("result", [getattr(column, key) for column in columns.values()])
    if model is not None and (simulators(model) or specimen_likelihoods(model)):
        scored = _table(columns, every)[..., 0]
        # An optimum of this model was found on the designs as they are.
        here = any(isinstance(each, Optimum) and each.model is model for each in results.values())
        for key, scores in _scores(model, every, scored, metrics, reach=not here).items():
            data[key] = ("result", scores)
    coords = {"result": list(columns), "hyperparameter": names}
    attrs = {"interval": INTERVAL, **as_attributes(identity)}
    return Comparison(data, coords=coords, attrs=attrs)


class Comparison(xr.Dataset):  # type: ignore[no-untyped-call]
    """A dataset like any other, which notebooks show as a table."""

    __slots__ = ()

    def _repr_html_(self) -> str:
        """Show estimates as a table, and scores as sentences; a part of it as xarray does."""
        whole = set(self.dims) == {"result", "hyperparameter"}
        if not (whole and set(_Estimate._fields) <= set(self.data_vars)):
            return super()._repr_html_()
        rows = [
            self._row(name, label)
            for name in self["hyperparameter"].values
            for label in self["result"].values
        ]
        header = ["", "result", "estimate", "sd", f"{INTERVAL:.0%} interval"]
        return view("Comparison", header=header, rows=rows, sentences=self._scores())

    def _row(self, name: str, label: str) -> list[str]:
        """Return the cells of one hyperparameter and result."""
        own = self.sel(hyperparameter=name, result=label)
        estimate, sd, lower, upper = (f"{float(own[key]):.4g}" for key in _Estimate._fields)
        return [str(name), str(label), estimate, sd, f"{lower} to {upper}"]

    def _scores(self) -> list[str]:
        """Return a sentence for each metric."""
        lines = []
        for key, scores in self.data_vars.items():
            if scores.dims != ("result",) or key in COSTS:
                continue
            each = scores.to_series().items()
            told = ", ".join(f"{label} {score:.4g}" for label, score in each)
            lines.append(f"Discrepancy by {key}: {told}.")
        return lines


def _refuse_metrics(metrics: object) -> None:
    """Raise if they are no metrics."""
    if metrics is None:
        return
    if not isinstance(metrics, Sequence) or not all(isinstance(m, Metric) for m in metrics):
        raise TypeError(
            f"compare: metrics: got {called(metrics)}, expected metric objects, such as "
            "[prb.AreaMetric()]"
        )


class _Estimate(NamedTuple):
    """Of one element, by one result."""

    estimate: float
    sd: float
    lower: float
    upper: float


@dataclass(frozen=True)
class _Column:
    """What a result tells: estimates by element, and its cost."""

    elements: dict[str, _Estimate]
    told: set[str]  # those of them that a table has
    n_responses: float
    seconds: float


def _table(columns: Mapping[str, _Column], names: Sequence[str]) -> Floats:
    """Return estimate, sd, lower and upper, shape (results, elements, 4)."""
    return np.array([[column.elements[name] for name in names] for column in columns.values()])


def _model_among(results: Mapping[str, Any]) -> pm.Model | None:
    """Return the model of the first result that has it."""
    return next((each.model for each in results.values() if isinstance(each, Optimum)), None)


def _column(label: str, result: Any, naming: pm.Model | None) -> _Column:
    """Read a result of any kind; draws without coordinates have those of a model."""
    if isinstance(result, Optimum):
        cost = float(result.n_responses), result.search.seconds
        evaluator = result.evaluator
        point = labelled(evaluator, result.point, {})
        stderr = labelled(evaluator, result.stderr, {})
        return _of_optimum(point.data_vars, stderr.data_vars, cost)
    if isinstance(result, xr.DataTree) and "posterior" in result.children:
        posterior = result["posterior"]
        draws = stacked_draws(posterior)
        if naming is not None:
            draws = with_coordinates(draws, naming)
        told = told_elements(draws)
        return _Column(_of_draws(draws), set(told), *_cost(posterior.attrs))
    if isinstance(result, xr.DataTree) and "optimum" in result.children:
        optimum = result["optimum"]
        return _of_optimum(optimum.data_vars, result["stderr"].data_vars, _cost(optimum.attrs))
    raise TypeError(
        f"compare: results: {label}: got {type(result).__name__}, "
        "expected an Optimum or a DataTree with a posterior group"
    )


def _of_draws(draws: Mapping[str, xr.DataArray]) -> dict[str, _Estimate]:
    """Return mean, standard deviation and equal-tailed interval by element."""
    tails = [(1 - INTERVAL) / 2, (1 + INTERVAL) / 2]
    found = {}
    for element, x in split_elements(draws).items():
        lower, upper = np.quantile(x, tails)
        found[element] = _Estimate(float(x.mean()), float(x.std(ddof=1)), lower, upper)
    return found


def _of_optimum(
    point: Mapping[Any, Any], stderr: Mapping[Any, Any], cost: tuple[float, float]
) -> _Column:
    return _Column(_normal(point, stderr), set(told_of(point, stderr)), *cost)


def _normal(point: Mapping[Any, Any], stderr: Mapping[Any, Any]) -> dict[str, _Estimate]:
    """Return estimate, standard error and normal interval by element of an optimum."""
    z = ndtri((1 + INTERVAL) / 2)
    errors = single_elements(stderr)
    found = {}
    for element, estimate in single_elements(point).items():
        sd = errors[element]
        found[element] = _Estimate(estimate, sd, estimate - z * sd, estimate + z * sd)
    return found


def _cost(attrs: Mapping[Any, Any]) -> tuple[float, float]:
    n_responses = attrs.get("n_responses", np.nan)
    seconds = attrs.get("seconds", np.nan)
    return float(n_responses), float(seconds)


def _shared(columns: list[_Column], model: pm.Model | None) -> list[str]:
    """Return the elements that all results have, of the model's variables if it is given."""
    first = columns[0].elements
    names = [name for name in first if all(name in column.elements for column in columns)]
    if model is None:
        return names
    own = {variable.name for variable in model.unobserved_RVs}
    return [name for name in names if variable_of(name) in own]


def _scores(
    model: pm.Model,
    names: list[str],
    estimates: Floats,
    metrics: Sequence[Metric] | None,
    *,
    reach: bool,
) -> dict[str, Floats]:
    """Return discrepancies of estimates, shape (results, elements), by simulator and metric.

    Where asked, designs that were never led anywhere reach them first.
    """
    evaluator = Evaluator.of(model)
    if metrics is None and evaluator.responses_per_theta:
        return {}  # a comparison that was not asked for scores computes no response
    thetas = _thetas(evaluator, names, estimates)
    if thetas is None:
        return {}
    with temporary_first_samples(evaluator, thetas) if reach else nullcontext():
        return _scored(evaluator, thetas, metrics)


def _scored(
    evaluator: Evaluator, thetas: Floats, metrics: Sequence[Metric] | None
) -> dict[str, Floats]:
    """Return the same of thetas, shape (results, d)."""
    thin = [shortcomings(evaluator, theta[None]) for theta in thetas]
    found = {}
    several = len(evaluator.simulators) > 1
    for k, simulator in enumerate(evaluator.simulators):
        supported = np.array([simulator.name not in lacking for lacking in thin])
        before = f"{simulator.name} " if several else ""
        for metric in _usual(simulator) if metrics is None else metrics:
            target = metric.against(simulator.observed, simulator.weights)
            scores = _discrepancies(evaluator, thetas, k, target)
            key = f"{before}{_class_of(metric)}"
            found[key] = np.where(supported, scores, np.nan)
    for name, values in specimen_log_likelihoods(evaluator, thetas).items():
        before = f"{name} " if several else ""
        if values.size:
            found[f"{before}{_BY_SPECIMEN}"] = -values.mean(axis=1)
    return found


def _discrepancies(evaluator: Evaluator, thetas: Floats, k: int, target: Discrepancy) -> Floats:
    """Return the discrepancies of the k-th simulator's populations from a target, (results,)."""
    simulator = evaluator.simulators[k]
    if not simulator.is_emulated:
        return simulator.bound.discrepancies(evaluator.roots(thetas, k), target)
    values, weights = evaluator.populations(thetas, k)
    rows = [target.of(values[[i]], weights[[i]])[0] for i in range(len(thetas))]
    return np.array(rows)


def _usual(simulator: PopulationSimulator) -> Sequence[Metric]:
    """Return the metrics of all, or of several outputs the same in all directions.

    Where there is the log-likelihood by specimen, it takes the place of the kernel form.
    """
    metrics = [own for own in _METRICS if not (simulator.is_emulated and own is _KERNEL)]
    return [Joint(own) for own in metrics] if simulator.observed.ndim > 1 else metrics


def _class_of(metric: Metric) -> str:
    """Return the class of a metric, with that of the one that it is made of."""
    inner = getattr(metric, "metric", None)
    own = type(metric).__name__
    return f"{own}({type(inner).__name__})" if isinstance(inner, Metric) else own


def _thetas(evaluator: Evaluator, names: list[str], estimates: Floats) -> Floats | None:
    """Return the estimates as thetas, shape (results, d); None where one lacks an element."""
    values = []
    for rv in evaluator.model.free_RVs:
        shape = event_shape(rv)
        elements = element_names(str(rv.name), shape, coordinates(evaluator.model, str(rv.name)))
        if not set(elements) <= set(names):
            return None
        places = [names.index(element) for element in elements]
        values.append(estimates[:, places].reshape(-1, *shape))
    return evaluator.hyperparameters.thetas_of(values)
