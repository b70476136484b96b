"""Results of the samplers: groups, dimensions and attributes of a DataTree."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr

from prbayes._finding import Findings
from prbayes._validate import (
    AT_ONCE,
    IN_CACHE,
    Floats,
    Indices,
    NamedArrays,
    NamedValues,
    flag,
    wrong_value,
)
from prbayes.inference.checks.population import failing_share
from prbayes.model.description import (
    arviz_attributes,
    as_attribute,
    failures_dataset,
    labelled,
    labelled_responses,
    observed_dataset,
    versions,
    without_addresses,
)
from prbayes.model.evaluator import (
    Evaluator,
    likelihood_of,
    specimen_log_likelihoods,
)
from prbayes.model.fingerprint import as_attributes, identity_of
from prbayes.model.measurement import specimen_labels
from prbayes.model.parameters import log_prior_terms, value_shapes, variables_at
from prbayes.model.specimen_likelihood import draw_readings
from prbayes.model.specimen_preparation import prepared
from prbayes.optimize.optimum import by_simulator, simulator_records
from prbayes.propagation.base import MAX_LOST
from prbayes.response.outputs import is_missing

AT_BEST = ("discrepancy_error", "lost_mass_at_best", "failed_mass_at_best")


@dataclass(frozen=True, eq=False)
class Chains:
    """Chains of draws with the diagnostics of their sampler."""

    thetas: Floats  # (chains, draws, d): draws in unconstrained space
    sampler: NamedValues  # attributes of the result: name of the sampler, and diagnostics
    sample_stats: xr.Dataset
    # (chains, draws): log-likelihood up to a constant; None for log-likelihoods by specimen
    log_likelihood: Floats | None = None
    # (chains, draws, k): discrepancies; NaN if they would cost responses
    discrepancies: Floats | None = None
    lost: Floats | None = None  # (chains, draws, k): share without response; NaN if stored
    # Error of the discrepancy, and lost and failed shares of the population, at the best draw: the
    # numbers `AT_BEST` by simulator.
    at_best: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    stopped: str = ""  # the budget that ended the run early
    findings: Findings = ()  # findings about modes, which are logged already


def posterior_tree(
    evaluator: Evaluator,
    chains: Chains,
    attrs: NamedValues,
    groups: Mapping[str, xr.Dataset],
) -> xr.DataTree:
    """Return the DataTree of a sampler's chains with groups of `arviz_groups`."""
    attrs = {**attrs, **chains.sampler, "stopped": chains.stopped, **versions()}
    tree = {
        "posterior": posterior_group(evaluator, chains.thetas, attrs),
        **groups,
        "sample_stats": chains.sample_stats,
        "calibration": _calibration(evaluator, chains, groups.get("log_likelihood")).assign_attrs(
            attrs
        ),
        "observed_data": observed_dataset(evaluator),
    }
    failures = failures_dataset(evaluator)
    if failures.sizes["failure"]:
        tree["failures"] = failures
    return xr.DataTree.from_dict(tree)


def posterior_group(evaluator: Evaluator, thetas: Floats, attrs: NamedValues) -> xr.Dataset:
    """Return the draws, (chains, draws, d), with attributes of the run and of the model."""
    return _variables(evaluator, thetas).assign_attrs(
        {
            **arviz_attributes(),
            "sampling_time": attrs["seconds"],
            **attrs,
            **as_attribute(evaluator.model),
            **as_attributes(identity_of(evaluator)),
        }
    )


def _variables(evaluator: Evaluator, thetas: Floats) -> xr.Dataset:
    """Return variables and deterministics at thetas, shape (chains, draws, d)."""
    chains, draws, d = thetas.shape
    values = evaluator.hyperparameters.constrained(thetas.reshape(-1, d))
    by_chain = {
        name: value.reshape(chains, draws, *value.shape[1:]) for name, value in values.items()
    }
    return labelled(evaluator, by_chain, {"chain": chains, "draw": draws})


# -- calibration -----------------------------------------------------------------------------------


def _calibration(
    evaluator: Evaluator, chains: Chains, log_likelihoods: xr.Dataset | None
) -> xr.Dataset:
    """Return figures and settings of the simulators, by draw and over all draws.

    ``log_likelihoods`` are those of specimens, if they have been computed. Their simulators come
    last, and have minus log-likelihoods as discrepancies.
    """
    records = simulator_records(evaluator)
    n_chains, n_draws, d = chains.thetas.shape
    rows = chains.thetas.reshape(-1, d)
    keys = ("discrepancy", "weight_ess", "mean_weight", "lost_mass", "failed_mass")
    by_draw = {key: np.full((n_chains, n_draws, len(records)), np.nan) for key in keys}
    discrepancies, lost = by_draw["discrepancy"], by_draw["lost_mass"]
    n_nodes = len(evaluator.nodes)
    discrepancies[:, :, :n_nodes] = chains.discrepancies
    lost[:, :, :n_nodes] = chains.lost  # shares of populations without a design
    supports = evaluator.support(rows)
    unknown = dict.fromkeys(("lossy_draws", "required_ess", *AT_BEST), np.nan)
    for k, node in enumerate(evaluator.nodes):
        bound = node.bound
        for key, values in supports.get(node.name, {}).items():
            by_draw[key][:, :, k] = values.reshape(n_chains, n_draws)
        records[k] |= unknown | {
            "lossy_draws": share_of_lossy(lost[:, :, k], bound.max_lost),
            "epsilon": node.epsilon_value,
            "max_lost": bound.max_lost,
            "propagation": without_addresses(node.propagation),
            "n_points": bound.n_points,
            **chains.at_best.get(node.name, {}),
        }
        if node.reweighted is not None:
            records[k]["required_ess"] = node.reweighted.required_ess
    if evaluator.measurements:
        failing = failing_share(evaluator, rows.mean(axis=0))
        totals = _log_likelihood_totals(evaluator, rows, log_likelihoods)
    for k, measurement in enumerate(evaluator.measurements, start=n_nodes):
        name = measurement.name
        discrepancies[:, :, k] = -totals[name].reshape(n_chains, n_draws)
        records[k] |= unknown | {
            "epsilon": 1.0,
            "failing_share": failing.get(name, np.nan),
            "max_lost": MAX_LOST,
            "propagation": f"emulator of {records[k]['n_runs']} runs",
            "n_points": prepared(likelihood_of(evaluator, measurement)).points.log_a.size,
        }
    coords = {
        "element": evaluator.hyperparameters.names,
        "chain": np.arange(n_chains),
        "draw": np.arange(n_draws),
    }
    variables = {
        "theta": (["chain", "draw", "element"], chains.thetas),
        **{key: (["chain", "draw", "simulator"], values) for key, values in by_draw.items()},
    }
    return by_simulator(records).assign_coords(coords).assign(variables)


def share_of_lossy(lost: Floats, max_lost: float) -> float:
    """Return the share of draws that have lost too much of a population; NaN are left out."""
    lost = lost[~np.isnan(lost)]
    return float((lost > max_lost).mean()) if lost.size else 0.0


# -- groups for ArviZ ------------------------------------------------------------------------------


def arviz_groups(evaluator: Evaluator, chains: Chains, seed: int | None) -> dict[str, xr.Dataset]:
    """Return priors, log-likelihoods and predictive draws for ArviZ, which cost no response."""
    thetas = chains.thetas
    n_chains, n_draws, d = thetas.shape
    rng = np.random.default_rng(seed)
    prior_seed = int(rng.integers(2**31))
    prior = evaluator.hyperparameters.prior_thetas(n_draws, prior_seed)[None]
    log_priors = log_prior_terms(evaluator.hyperparameters, thetas.reshape(-1, d))
    coords = {"chain": np.arange(n_chains), "draw": np.arange(n_draws)}
    variables = {
        name: (["chain", "draw"], values.reshape(n_chains, n_draws))
        for name, values in log_priors.items()
    }
    log_likelihood, predictive = (
        (_log_likelihood, _stored_responses)
        if evaluator.nodes
        else (_log_likelihood_by_specimen, _emulated_responses)
    )
    groups = {
        "prior": _variables(evaluator, prior),
        "log_prior": xr.Dataset(variables, coords=coords),
        "log_likelihood": log_likelihood(evaluator, chains),
    }
    posterior_predictive = predictive(evaluator, thetas, rng)
    prior_predictive = predictive(evaluator, prior, rng)
    if prior_predictive:
        groups["posterior_predictive"] = posterior_predictive
        groups["prior_predictive"] = prior_predictive
    return {name: group.assign_attrs(arviz_attributes()) for name, group in groups.items()}


def _log_likelihood(evaluator: Evaluator, chains: Chains) -> xr.Dataset:
    """Return the log-likelihood of all specimens together, and that of the model's other terms.

    Each dimension of specimens has one place: ArviZ would take a number without such a dimension
    for that of each specimen, as in `loo_expectations`.
    """
    assert chains.log_likelihood is not None
    n_chains, n_draws, d = chains.thetas.shape
    rows = chains.thetas.reshape(-1, d)
    other_terms = evaluator.log_other(rows).reshape(n_chains, n_draws)
    observed = observed_dataset(evaluator)
    names = [str(observed[node.name].dims[0]) for node in evaluator.nodes]
    specimens = list(dict.fromkeys(names))
    shape = (n_chains, n_draws, *[1] * len(specimens))
    dims = ["chain", "draw", *specimens]
    note = (
        "The log-density of all specimens together, and that of the model's other terms: one "
        "number for each draw, for power-scaling (psense), of one place for specimens. loo, "
        "compare and khat want one for each observation and have no meaning here; use "
        "prb.cross_validate."
    )
    return xr.Dataset(
        {
            # The names explain themselves, because ArviZ functions that need a number for each
            # observation show them.
            "one_number_for_all_specimens": (
                dims,
                (chains.log_likelihood - other_terms).reshape(shape),
            ),
            "other_terms": (dims, other_terms.reshape(shape)),
        },
        coords={"chain": np.arange(n_chains), "draw": np.arange(n_draws)},
        attrs={"note": note},
    )


def _log_likelihood_by_specimen(evaluator: Evaluator, chains: Chains) -> xr.Dataset:
    """Return the log-likelihood of each specimen, for all draws, or for evenly spaced ones."""
    n_chains, n_draws, d = chains.thetas.shape
    specimens = sum(len(likelihood.readings) for likelihood in evaluator.likelihoods)
    # Diagnostics of a specimen need more draws than a predictive distribution.
    thinned = _thinned(n_draws, n_chains * specimens / 2)
    thetas = chains.thetas[:, thinned]
    values = specimen_log_likelihoods(evaluator, thetas.reshape(-1, d))
    observed = observed_dataset(evaluator)
    coords = {"chain": np.arange(n_chains), "draw": thinned}
    variables = {}
    for likelihood in evaluator.likelihoods:
        name = likelihood.measurements[-1].name
        dim = str(observed[name].dims[0])
        labels = specimen_labels(likelihood)
        if labels is not None:  # the numbers are those of specimens, not of readings
            dim = f"{name}_specimen"
            coords[dim] = labels
        variables[name] = (["chain", "draw", dim], values[name].reshape(*thetas.shape[:2], -1))
    return xr.Dataset(variables, coords=coords)


def _log_likelihood_totals(
    evaluator: Evaluator, rows: Floats, by_specimen: xr.Dataset | None
) -> NamedArrays:
    """Return the log-likelihood of all specimens by simulator at thetas, (S, d) -> (S,).

    The log-likelihoods ``by_specimen`` are summed if they have all draws. Of simulators that share
    specimens the last one has their log-likelihood, and the others have zeros.
    """
    totals = {m.name: np.zeros(len(rows)) for m in evaluator.measurements}
    sizes = {} if by_specimen is None else by_specimen.sizes
    if by_specimen is not None and sizes["chain"] * sizes["draw"] == len(rows):
        for variable, values in by_specimen.data_vars.items():
            over_specimens = values.sum(str(values.dims[-1]))
            totals[str(variable)] = over_specimens.values.ravel()
        return totals
    n_specimens = sum(len(likelihood.readings) for likelihood in evaluator.likelihoods)
    step = max(1, AT_ONCE // n_specimens)
    for first in range(0, len(rows), step):
        block = slice(first, first + step)
        for name, logs in specimen_log_likelihoods(evaluator, rows[block]).items():
            totals[name][block] = logs.sum(axis=1)
    return totals


def _emulated_responses(
    evaluator: Evaluator, thetas: Floats, rng: np.random.Generator
) -> xr.Dataset:
    """Return emulated responses of new specimens at thetas, (chains, draws, d)."""
    chains, draws, d = thetas.shape
    thinned = _thinned(draws, chains * sum(m.observed.size for m in evaluator.measurements))
    leading = (chains, len(thinned))
    responses = {}
    values = variables_at(evaluator.hyperparameters, thetas[:, thinned].reshape(-1, d))
    for likelihood in evaluator.likelihoods:
        for measurement in likelihood.measurements:
            n = len(measurement.observed)
            readings = draw_readings(likelihood, rng, values, n, measurement)
            responses[measurement.name] = readings.reshape(*leading, *readings.shape[1:])
    return labelled_responses(evaluator, responses, leading).assign_coords(draw=thinned)


def _thinned(draws: int, size: float) -> Indices:
    """Return the draws for which ``size`` numbers each fit into memory."""
    return np.arange(draws)[:: max(1, math.ceil(draws * size / AT_ONCE))]


def _stored_responses(evaluator: Evaluator, thetas: Floats, rng: np.random.Generator) -> xr.Dataset:
    """Draw stored responses by weight, as many as were observed, at thetas (chains, draws, d)."""
    chains, draws, d = thetas.shape
    stored = [k for k, node in enumerate(evaluator.nodes) if node.bound.n_per_theta == 0]
    sizes = [evaluator.nodes[k].target.observed.size for k in stored]
    thinned = _thinned(draws, chains * sum(sizes))
    leading = (chains, len(thinned))
    rows = thetas[:, thinned].reshape(-1, d)
    responses = {}
    for k in stored:
        node = evaluator.nodes[k]
        n, event = node.target.n_drawn, node.target.event
        drawn = np.full((len(rows), n, *event), np.nan)
        step = max(1, IN_CACHE // node.bound.n_points)
        for first in range(0, len(rows), step):
            parents = evaluator.parents(rows[first : first + step], k)
            valid = np.flatnonzero(node.bound.valid(parents))
            if not valid.size:
                continue
            values, weights = node.bound.populations([parent[valid] for parent in parents])
            points = values[0]  # responses that all populations share
            cumulative = np.cumsum(np.where(is_missing(points), 0.0, weights), axis=1)
            for place, row in zip(first + valid, cumulative, strict=True):
                if row[-1] > 0:
                    uniform = rng.random(n) * row[-1]
                    drawn[place] = points[np.searchsorted(row, uniform, side="right")]
        responses[node.name] = node.target.replicate(drawn.reshape(*leading, n, *event))
    return labelled_responses(evaluator, responses, leading).assign_coords(draw=thinned)


# -- selections ------------------------------------------------------------------------------------


def require_selection(
    var_names: object, idata_kwargs: object, model: pm.Model
) -> tuple[list[str] | None, dict[str, Any]]:
    """Return names of variables, None for all, and keywords for the groups; raise if invalid."""
    names: list[str] | None = None
    if var_names is not None:
        names = [var_names] if isinstance(var_names, str) else var_names  # type: ignore[assignment]
        if not isinstance(names, Sequence) or not all(isinstance(name, str) for name in names):
            raise wrong_value(var_names, "var_names", "names of variables")
        variables = [str(variable.name) for variable in model.unobserved_RVs]
        unknown = [name for name in names if name not in variables]
        if unknown or not names:
            raise KeyError(f"var_names: got {unknown or 'none'}, expected some of {variables}")
    if idata_kwargs is None:
        return names, {}
    if not isinstance(idata_kwargs, Mapping):
        raise wrong_value(idata_kwargs, "idata_kwargs", "a dict")
    expected = ["coords", "dims", "log_likelihood", "log_prior"]
    unknown = sorted(map(str, set(idata_kwargs) - set(expected)))
    if unknown:
        raise TypeError(
            f"idata_kwargs: got {unknown}, expected some of {expected}; priors and predictive "
            "draws are in the result, transformed values in calibration.theta"
        )
    for name, value in idata_kwargs.items():
        if name.startswith("log"):
            flag(value, f"idata_kwargs: {name}")
        elif not isinstance(value, Mapping):
            raise wrong_value(value, f"idata_kwargs: {name}", "a dict")
    return names, dict(idata_kwargs)


def selected(
    tree: xr.DataTree, var_names: Sequence[str] | None, idata_kwargs: Mapping[str, Any]
) -> xr.DataTree:
    """Return a result with some variables only, and other names of dimensions and coordinates."""
    coords = idata_kwargs.get("coords", {})
    groups = {}
    for name, node in tree.children.items():
        if not idata_kwargs.get(name, True):
            continue
        group = node.to_dataset()
        if var_names is not None and name in ("posterior", "prior", "log_prior"):
            group = group[[variable for variable in group.data_vars if variable in var_names]]
        for variable, dims in idata_kwargs.get("dims", {}).items():
            if variable not in group:
                continue
            new = [dims] if isinstance(dims, str) else list(dims)
            old = [dim for dim in group[variable].dims if dim not in ("chain", "draw")]
            if len(old) != len(new):
                raise ValueError(
                    f"idata_kwargs: dims: {variable}: got {new}, expected {len(old)} names, one "
                    "for each dimension"
                )
            renamed = group[variable].rename(dict(zip(old, new, strict=True)))
            group = group.drop_vars(variable).assign({variable: renamed})
        groups[name] = group.assign_coords(
            {dim: values for dim, values in coords.items() if dim in group.dims}
        )
    return xr.DataTree.from_dict(groups)


def as_multitrace(tree: xr.DataTree, evaluator: Evaluator) -> Any:
    """Return the draws alone as a `pymc.backends.base.MultiTrace`."""
    from pymc.backends.base import MultiTrace
    from pymc.backends.ndarray import NDArray

    shapes = value_shapes(evaluator.hyperparameters)
    ends = np.cumsum([int(np.prod(shape, dtype=int)) for shape in shapes.values()])[:-1]
    traces = []
    for chain, thetas in enumerate(np.asarray(tree["calibration"]["theta"])):
        trace = NDArray(model=evaluator.model)
        trace.setup(len(thetas), chain)
        for theta in thetas:
            values = zip(shapes.items(), np.split(theta, ends), strict=True)
            point = {name: value.reshape(shape) for (name, shape), value in values}
            trace.record(point, in_warmup=False)
        traces.append(trace)
    return MultiTrace(traces)
