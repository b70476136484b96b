"""Comparison of optima and posteriors: estimates, intervals, costs and scores."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr
from scipy.special import ndtri

from prbayes._display import Table, View
from prbayes._finding import Finding, as_json, report, sentences_of
from prbayes._stats import INTERVAL
from prbayes._validate import (
    ArraysByName,
    Floats,
    NamedArrays,
    NamedValues,
    wrong_type,
    wrong_value,
)
from prbayes.metrics.area import AreaMetric
from prbayes.metrics.base import Metric
from prbayes.metrics.density import GaussianKDE
from prbayes.metrics.divergence import KullbackLeibler, ProbabilityResidual
from prbayes.metrics.likelihood import LogLikelihood
from prbayes.metrics.multivariate import Joint
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
from prbayes.optimize.optimum import Optimum, identity_in, refuse_model
from prbayes.results.predict import width_of_epsilon
from prbayes.results.products import model_of_product, one_posterior, product_names

# variables by result that are no scores
COSTS = ("n_responses", "seconds")
_ESTIMATE = ("estimate", "sd", "lower", "upper")  # variables by result and element
_METRICS = (
    ProbabilityResidual(),
    KullbackLeibler(),
    AreaMetric(),
    LogLikelihood(density=GaussianKDE()),
)


@locked
def compare(
    results: Mapping[str, Optimum | xr.DataTree],
    *,
    model: pm.Model | None = None,
    metrics: Sequence[Metric] | None = None,
) -> Comparison:
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
        responses per simulator. Outputs that few specimens share, such as readings at times of
        their own, have the log-likelihood by specimen alone.

    Returns
    -------
    xarray.Dataset
        By ``result`` and ``hyperparameter``: ``estimate`` (the optimum, or the posterior mean),
        ``sd`` (the standard error, or the posterior standard deviation), ``lower`` and ``upper``
        (an 89% interval: normal, or equal-tailed), and ``shift`` (of the estimate from that of the
        first result, in sd). By ``result``: ``n_responses`` and ``seconds``, and the discrepancy of
        the estimate's population by the metric's class, after the simulator's name if there are
        several. Scores are NaN where stored responses do not support the population. With the
        log-likelihood by specimen populations are emulated, and ``LogLikelihood by specimen`` is
        minus its mean over the specimens. The attribute ``findings`` names draws that are as wide
        as epsilon makes them. It prints as sentences; a notebook shows a table.

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
    _refuse_wrong_arguments(results, metrics)
    results = {label: one_posterior(r, f"compare: {label}") for label, r in results.items()}
    identities = {label: identity_in(result) for label, result in results.items()}
    try:
        identity = require_together(identities, "compare", model=model)
    except ValueError as error:
        raise ValueError(f"{error}; use prb.rank to compare models of the same data") from None
    products = {tuple(product_names(result)) for result in results.values()}
    if model is not None and len(products) > 1:
        raise ValueError(
            "compare: got results of several products, which have other data, with model=, "
            "expected one product; leave model= out: then no data score the results"
        )
    if model is not None:
        model = model_of_product(next(iter(results.values())), model)
    optima = [result for result in results.values() if isinstance(result, Optimum)]
    # Draws without coordinates take those of the model, so that elements have the same names.
    naming = optima[0].model if model is None and optima else model
    trees = [_tree_of(label, result) for label, result in results.items()]
    read = [estimates_of(tree, model=naming) for tree in trees]
    columns, shown = zip(*read, strict=True)
    shared = _in_all(columns)
    if shared and None in identities.values():
        _report_left_out(columns, shared)
    if model is not None:
        variables = [str(variable.name) for variable in model.unobserved_RVs]
        shared = [name for name in shared if variable_of(name, variables) in variables]
    in_table = _in_all(shown)
    names = readable_elements([name for name in shared if name in in_table])
    if not names:
        pairs = zip(results, columns, strict=True)
        texts = "; ".join(f"{label}: {', '.join(elements)}" for label, elements in pairs)
        raise ValueError(
            f"compare: got results that share no hyperparameter ({texts:.500}) with each other and "
            "the model, expected the same names"
        )
    data = _estimate_variables(np.array([[column[name] for name in names] for column in columns]))
    for key in COSTS:
        costs = [float(estimates_in(tree).attrs.get(key, np.nan)) for tree in trees]
        data[key] = ("result", costs)
    if model is not None and (simulators(model) or specimen_likelihoods(model)):
        # The designs of a model cover its own optimum; other estimates may need first samples.
        is_covered = any(optimum.model is model for optimum in optima)
        values = np.array([[column[name][0] for name in shared] for column in columns])
        for key, scores in _scores(model, shared, values, metrics, is_covered=is_covered).items():
            data[key] = ("result", scores)
    coords = {"result": list(results), "hyperparameter": names}
    attrs = {
        "interval": INTERVAL,
        "findings": as_json(report(*_epsilon_findings(results, naming))),
        **as_attributes(identity),
    }
    return Comparison(data, coords=coords, attrs=attrs)


def _epsilon_findings(results: NamedValues, model: pm.Model | None) -> list[Finding]:
    """Return findings of draws whose width is that of epsilon, with the labels of the results."""
    return [
        replace(finding, text=f"{label}: {finding.text}")
        for label, result in results.items()
        for finding in width_of_epsilon(result, model)
    ]


def _refuse_wrong_arguments(results: Any, metrics: Any) -> None:
    """Raise if there are no results, or an argument has a wrong type."""
    for result in (results, *results.values()) if isinstance(results, Mapping) else [results]:
        refuse_model(result, "compare: results")
    if not isinstance(results, Mapping):
        raise wrong_value(
            results, "compare: results", "a mapping such as {'optimum': optimum, 'ABC': idata}"
        )
    if metrics is not None and not (
        isinstance(metrics, Sequence) and all(isinstance(m, Metric) for m in metrics)
    ):
        raise wrong_value(metrics, "compare: metrics", "metric objects, such as [prb.AreaMetric()]")
    if not results:
        raise ValueError(
            "compare: got no results, expected a dict such as {'optimum': optimum, 'ABC': idata}"
        )


def _in_all(columns: Sequence[Iterable[str]]) -> list[str]:
    """Return the elements that all results have, in the order of the first one."""
    in_all = set.intersection(*map(set, columns))
    return [name for name in columns[0] if name in in_all]


def _estimate_variables(table: Floats) -> dict[str, Any]:
    """Return variables with estimates, (results, elements, 4), and shifts from the first result."""
    estimates, sds = table[..., 0], table[..., 1]
    with np.errstate(divide="ignore", invalid="ignore"):  # A result may have no spread.
        shift = (estimates - estimates[0]) / sds
    shift[0] = 0.0
    variables = {key: table[..., i] for i, key in enumerate(_ESTIMATE)} | {"shift": shift}
    return {key: (["result", "hyperparameter"], values) for key, values in variables.items()}


def _report_left_out(columns: Sequence[Iterable[str]], shared: Sequence[str]) -> None:
    """Report elements that not all results have, as other tools may have renamed variables."""
    left_out = [name for column in columns for name in column if name not in shared]
    if left_out:
        listed = ", ".join(dict.fromkeys(left_out))
        text = f"compare: left out {listed:.300}, as not all results have these names."
        report(Finding("names-differ", text))


class Comparison(Table):
    """Estimates by result and hyperparameter, and scores by result."""

    __slots__ = ()
    _parts = (*_ESTIMATE, "result", "hyperparameter")
    _columns = (*_ESTIMATE, "shift")

    def to_view(self) -> View:
        """Return what a reader sees."""
        rows = []
        for name in self["hyperparameter"].values:
            for label in self["result"].values:
                row = self.sel(hyperparameter=name, result=label)
                estimate, sd, lower, upper = (f"{float(row[key]):.4g}" for key in _ESTIMATE)
                shift = f"{float(row['shift']) + 0.0:.2f}"  # The sum turns -0.0 into 0.0.
                rows.append([str(name), str(label), estimate, sd, f"{lower} to {upper}", shift])
        sentences = sentences_of(self.attrs)
        for key, scores in scores_in(self).items():
            items = scores.to_series().items()
            listed = ", ".join(f"{label} {score:.4g}" for label, score in items)
            sentences.append(f"Discrepancy by {key}: {listed}.")
        header = ["", "result", "estimate", "sd", f"{INTERVAL:.0%} interval", "shift in sd"]
        return View("Comparison", header, rows, sentences)


def scores_in(comparison: xr.Dataset) -> dict[Any, xr.DataArray]:
    """Return the scores of a comparison, each by result."""
    variables = comparison.data_vars.items()
    return {key: x for key, x in variables if x.dims == ("result",) and key not in COSTS}


def _tree_of(label: str, result: Any) -> xr.DataTree:
    """Return a result as the tree that a file has, or raise if it has no estimates."""
    tree = result.to_datatree() if isinstance(result, Optimum) else result
    if not isinstance(tree, xr.DataTree) or not {"posterior", "optimum"} & set(tree.children):
        expected = "an Optimum or a DataTree with a posterior group"
        raise wrong_type(result, f"compare: results: {label}", expected)
    return tree


def estimates_in(result: xr.DataTree) -> xr.DataTree:
    """Return the group of a result with its estimates."""
    return result.children["posterior" if "posterior" in result else "optimum"]


def estimates_of(
    result: xr.DataTree, prob: float = INTERVAL, model: pm.Model | None = None
) -> tuple[dict[str, tuple[float, ...]], list[str]]:
    """Return estimate, sd and interval of each element, and the elements that a table shows.

    The interval of an optimum is normal, that of draws has equal tails. Draws without coordinates
    take those of the model.
    """
    levels = (1 - prob) / 2, (1 + prob) / 2
    if "posterior" in result:
        draws = stacked_draws(result["posterior"], model=model)
        estimates = {
            name: (x.mean(), x.std(ddof=1), *np.quantile(x, levels))
            for name, x in split_elements(draws).items()
        }
        return estimates, table_elements(draws)
    point, stderr = result["optimum"].data_vars, result["stderr"].data_vars
    errors = single_elements(stderr)
    z = ndtri(levels[1])
    estimates = {}
    for name, value in single_elements(point).items():
        sd = errors[name]
        estimates[name] = value, sd, value - z * sd, value + z * sd
    return estimates, optimum_elements(point, stderr)


def thetas_at(evaluator: Evaluator, elements: ArraysByName) -> Floats:
    """Return thetas, (n, d), from elements of the free variables by name, (n,) or (1,) each.

    Raises a KeyError if an element is missing.
    """
    hyperparameters = evaluator.hyperparameters
    n = max(map(np.size, elements.values()))
    initial = hyperparameters.constrained(hyperparameters.initial[None])
    values = []
    for name in (str(rv.name) for rv in evaluator.model.free_RVs):
        shape = initial[name].shape[1:]
        labels = coordinates(evaluator.model, name)
        names = element_names(name, shape, labels)
        columns = [np.broadcast_to(elements[element], n) for element in names]
        values.append(np.stack(columns, axis=-1).reshape(n, *shape))
    return hyperparameters.thetas_of(values)


def _scores(
    model: pm.Model,
    names: list[str],
    estimates: Floats,
    metrics: Sequence[Metric] | None,
    *,
    is_covered: bool,
) -> NamedArrays:
    """Return discrepancies of estimates, shape (results, elements), by simulator and metric."""
    evaluator = Evaluator.of(model)
    if metrics is None and evaluator.responses_per_theta:
        return {}  # Scores that were not requested compute no response.
    try:
        thetas = thetas_at(evaluator, dict(zip(names, estimates.T, strict=True)))
    except KeyError:
        return {}  # The results have no estimate of a free variable.
    with nullcontext() if is_covered else temporary_first_samples(evaluator, thetas):
        lacking = [shortcomings(evaluator, theta[None]) for theta in thetas]
        several = len(evaluator.simulators) > 1
        scores = {}
        defaults: list[Sequence[Metric]] = [_METRICS] * len(evaluator.nodes)
        # The log-likelihood by specimen, below, replaces that by kernels.
        defaults += [_METRICS[:-1]] * len(evaluator.emulated)
        for k, simulator in enumerate(evaluator.simulators):
            is_supported = np.array([simulator.name not in short for short in lacking])
            prefix = f"{simulator.name} " if several else ""
            selection = defaults[k] if metrics is None else metrics
            if metrics is None and simulator.observed.ndim > 1:
                selection = [Joint(metric) for metric in selection]  # It treats all outputs alike.
            if simulator.metric.exact_likelihood:  # A data sheet has statistics, no specimens.
                selection = [simulator.metric]
            for metric in selection:
                try:
                    target = metric.against(simulator.observed, simulator.weights)
                except ValueError:
                    if metrics is not None:
                        raise
                    # A default metric takes no single specimen, and no outputs that few specimens
                    # have, such as readings at one time, or that follow from others.
                    continue
                totals = simulator.discrepancies(evaluator.parents(thetas, k), target)
                inner = getattr(metric, "metric", None)
                name = type(metric).__name__
                if isinstance(inner, Metric):
                    name = f"{name}({type(inner).__name__})"
                scores[f"{prefix}{name}"] = np.where(is_supported, totals, np.nan)
        for name, logs in specimen_log_likelihoods(evaluator, thetas).items():
            prefix = f"{name} " if several else ""
            if logs.size:
                scores[f"{prefix}LogLikelihood by specimen"] = -logs.mean(axis=1)
        return scores
