"""Optimum and posterior side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr

from prbayes._checks import Floats
from prbayes.estimate.optimum import Optimum, identity_in
from prbayes.metrics.area import AreaMetric
from prbayes.metrics.base import Metric
from prbayes.metrics.divergence import KullbackLeibler
from prbayes.metrics.likelihood import LogLikelihood
from prbayes.metrics.residual import ProbabilityResidual
from prbayes.model.evaluator import Evaluator
from prbayes.model.identity import Level, identity_of_model, require_same
from prbayes.model.node import nodes
from prbayes.model.support import shortcomings

_INTERVAL = 0.89
_METRICS = (ProbabilityResidual(), KullbackLeibler(), AreaMetric(), LogLikelihood())


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
        `Optimum` objects, their DataTrees, and DataTrees with a ``posterior`` group, by the label they get.
    model : pymc.Model, optional
        Restricts the table to the model's free variables; by default all that the results share. Its data, and
        its populations, score the results.
    metrics : sequence of Metric, optional
        Under which each estimate is scored, whatever it was made with. By default all four where that costs no
        response (`Reweighted`); under the other propagations each result costs n responses per simulator.

    Returns
    -------
    xarray.Dataset
        With dimensions ``result`` and ``hyperparameter``: ``estimate`` (the optimum, or the posterior mean),
        ``sd`` (the standard error, or the posterior standard deviation), ``lower`` and ``upper`` (an 89%
        interval: normal, or equal-tailed), ``shift`` (of the estimate from that of the first result, in this
        result's sd); and by result: ``n_responses`` and ``seconds``, NaN where a result does not tell, and the
        discrepancy of the estimate's population under each metric, by the metric's class, with the simulator's name
        before it if there are several; NaN where stored responses do not support it.

    Raises
    ------
    TypeError, ValueError
        If there is no result, one is of another type, or they share no hyperparameter.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
    ...     y = prb.Simulator("y", lambda x: 2 * x, x, metric=prb.AreaMetric(), observed=[0.0, 2.0, 4.0])
    >>> table = prb.compare({"optimum": prb.minimize(model)}, model=model)
    >>> table.hyperparameter.values.tolist()
    ['mu']
    """
    if not results:
        raise ValueError("compare: got no results, expected a dict such as {'optimum': optimum, 'ABC': idata}")
    _require_one_problem(results, model)
    columns = {label: _column(label, result) for label, result in results.items()}
    names = [n for n in next(iter(columns.values()))[0] if all(n in c[0] for c in columns.values())]
    if model is not None:
        free = [rv.name for rv in model.free_RVs]
        names = [n for n in names if n.split("[")[0] in free]
    if not names:
        raise ValueError(f"compare: got results {list(results)} that share no hyperparameter, expected the same model")
    table = np.array([[columns[label][0][n] for n in names] for label in columns])
    first = table[0]
    with np.errstate(divide="ignore", invalid="ignore"):
        shift = (table[..., 0] - first[:, 0]) / table[..., 1]
    shift[0] = 0.0
    keys = ("estimate", "sd", "lower", "upper")
    where = ["result", "hyperparameter"]
    data: dict[str, Any] = {key: (where, table[..., i]) for i, key in enumerate(keys)}
    data["shift"] = (where, shift)
    data["n_responses"] = ("result", [c[1] for c in columns.values()])
    data["seconds"] = ("result", [c[2] for c in columns.values()])
    if model is not None and nodes(model):
        data |= {key: ("result", found) for key, found in _scores(model, names, table[..., 0], metrics).items()}
    return xr.Dataset(data, coords={"result": list(columns), "hyperparameter": names}, attrs={"interval": _INTERVAL})


def _require_one_problem(results: Mapping[str, Any], model: pm.Model | None) -> None:
    """Refuse results of other populations than the model's, or the first result's, as far as they tell."""
    known = [identity_in(result) for result in results.values()]
    first = next((identity for identity in known if identity is not None), None)
    expected = identity_of_model(model) if model is not None and nodes(model) else first
    for label, identity in zip(results, known, strict=True):
        require_same(identity, expected, f"compare: {label}", Level.POPULATIONS)


def _scores(
    model: pm.Model, names: list[str], estimates: Floats, metrics: Sequence[Metric] | None
) -> dict[str, Floats]:
    """Return the discrepancies of estimates, (results, elements), by simulator and metric."""
    evaluator = Evaluator(model)
    if metrics is None and evaluator.responses_per_theta:
        return {}
    place = {name: i for i, name in enumerate(names)}
    shapes = {str(rv.name): tuple(map(int, rv.shape.eval())) for rv in model.free_RVs}
    elements = {rv: [_element(rv, i) for i in np.ndindex(shape)] for rv, shape in shapes.items()}
    if not all(e in place for row in elements.values() for e in row):
        return {}
    found = {}
    thetas = evaluator.thetas_of(
        [estimates[:, [place[e] for e in elements[rv]]].reshape(-1, *shape) for rv, shape in shapes.items()]
    )
    thin = {i: shortcomings(evaluator, theta[None]) for i, theta in enumerate(thetas)}
    for k, node in enumerate(evaluator.nodes):
        known = np.array([node.name not in thin[i] for i in range(len(thetas))])
        for metric in _METRICS if metrics is None else metrics:
            target = metric.against(node.target.observed, node.target.weights)
            scores = node.bound.discrepancies(evaluator.roots(thetas, k), target)
            name = type(metric).__name__
            found[name if len(evaluator.nodes) == 1 else f"{node.name} {name}"] = np.where(known, scores, np.nan)
    return found


def _column(label: str, result: Any) -> tuple[dict[str, tuple[float, ...]], float, float]:
    """Return (estimate, sd, lower, upper) by element, responses, seconds."""
    if isinstance(result, Optimum):
        return _normal(result.point, result.stderr), float(result.n_responses), result.seconds
    if not isinstance(result, xr.DataTree) or not {"posterior", "optimum"} & set(result.children):
        raise TypeError(
            f"{label}: got {type(result).__name__}, expected an Optimum or a DataTree with a posterior group"
        )
    if "posterior" not in result:
        return _normal(result["optimum"].data_vars, result["stderr"].data_vars), *_cost(result["optimum"].attrs)
    posterior = result["posterior"]
    rows: dict[str, tuple[float, ...]] = {}
    for key, variable in posterior.data_vars.items():
        name = str(key)
        draws = variable.stack(sample=("chain", "draw")).transpose("sample", ...).values
        for i in np.ndindex(draws.shape[1:]):
            x = draws[(slice(None), *i)]
            lower, upper = np.quantile(x, [(1 - _INTERVAL) / 2, (1 + _INTERVAL) / 2])
            rows[_element(name, i)] = (float(x.mean()), float(x.std(ddof=1)), float(lower), float(upper))
    return rows, *_cost(posterior.attrs)


def _normal(point: Mapping[Any, Any], stderr: Mapping[Any, Any]) -> dict[str, tuple[float, ...]]:
    """Return (estimate, sd, lower, upper) by element of an optimum."""
    z = 1.5982  # the normal's quantile at (1 + 0.89) / 2
    rows: dict[str, tuple[float, ...]] = {}
    for name, value in point.items():
        for i in np.ndindex(np.shape(value)):
            estimate, sd = float(np.asarray(value)[i]), float(np.asarray(stderr[name])[i])
            rows[_element(str(name), i)] = (estimate, sd, estimate - z * sd, estimate + z * sd)
    return rows


def _cost(attrs: Mapping[Any, Any]) -> tuple[float, float]:
    return float(attrs.get("n_responses", np.nan)), float(attrs.get("seconds", np.nan))


def _element(name: str, index: tuple[int, ...]) -> str:
    return f"{name}[{','.join(map(str, index))}]" if index else name
