"""Results of the samplers: groups, dimensions and attributes of a DataTree."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr

from prbayes._finding import Finding, as_json
from prbayes._validate import AT_ONCE, IN_CACHE, Floats, called, flag
from prbayes.metrics.multivariate import components_summary
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
    specimen_params,
)
from prbayes.model.fingerprint import as_attributes, identity_of
from prbayes.model.measurement import specimen_labels
from prbayes.model.specimen_likelihood import draw_readings
from prbayes.model.specimen_preparation import prepared
from prbayes.propagation.base import MAX_LOST
from prbayes.response.outputs import is_missing

Stages = dict[str, list[float]]  # statistics of a chain by name, a value for each stage

_BY_DRAW = ["chain", "draw", "simulator"]


@dataclass(frozen=True, eq=False)
class Draws:
    """Draws of a sampler with its diagnostics."""

    thetas: Floats  # (chains, draws, d)
    sampler: Mapping[str, Any]  # attributes: the name of the sampler, and diagnostics
    log_likelihood: Floats | None = None  # (chains, draws), up to a constant; None by specimen
    discrepancies: Floats | None = None  # (chains, draws, k); NaN if they would cost responses
    lost: Floats | None = None  # (chains, draws, k): share without response; NaN if stored
    stages: Sequence[Stages] = ()  # of sequential Monte Carlo, by chain
    sample_stats: xr.Dataset | None = None  # of another sampler
    errors: Floats | None = None  # (k,): of the discrepancies at the best draw
    # By simulator: shares of the best draw's population that were lost or failed.
    missing: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    stopped: str = ""  # the budget that ended the run early


def posterior_tree(
    evaluator: Evaluator,
    draws: Draws,
    *,
    adjustment: str,
    findings: Sequence[Finding],
    seed: int | None,
    n_responses: int,
    seconds: float,
    groups: Mapping[str, xr.Dataset],
) -> xr.DataTree:
    """Return the DataTree of a sampler's draws with groups of `arviz_groups`."""
    attrs = {
        "n_responses": n_responses,
        "seconds": seconds,
        "random_seed": "None" if seed is None else str(seed),
        "adjustment": adjustment,
        **draws.sampler,
        "stopped": draws.stopped,
        "findings": as_json(findings),
        **versions(),
    }
    stats = _stage_stats(draws.stages) if draws.sample_stats is None else draws.sample_stats
    calibration = _calibration(evaluator, draws)
    tree = {
        "posterior": _posterior(evaluator, draws.thetas, attrs | _evidence(draws.stages)),
        **groups,
        "sample_stats": stats,
        "calibration": calibration.assign_attrs(attrs),
        "observed_data": observed_dataset(evaluator),
    }
    failures = failures_dataset(evaluator)
    if failures.sizes["failure"]:
        tree["failures"] = failures
    return xr.DataTree.from_dict(tree)


def bootstrap_tree(
    evaluator: Evaluator,
    thetas: Floats,
    *,
    sampler: str,
    converged: float,
    seed: int,
    n_responses: int,
    seconds: float,
) -> xr.DataTree:
    """Return the DataTree of minimisers, shape (1, draws, d)."""
    attrs = {
        "sampler": sampler,
        "converged": converged,
        "n_responses": n_responses,
        "seconds": seconds,
        "random_seed": str(seed),
        **versions(),
    }
    posterior = _posterior(evaluator, thetas, attrs)
    return xr.DataTree.from_dict(
        {"posterior": posterior, "observed_data": observed_dataset(evaluator)}
    )


def _posterior(evaluator: Evaluator, thetas: Floats, attrs: dict[str, Any]) -> xr.Dataset:
    """Return the draws, with attributes of the run and of the model."""
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


def _stage_stats(chains: Sequence[Stages]) -> xr.Dataset:
    """Return statistics by chain and stage, NaN after the last one of a chain."""
    n_stages = max(len(stages["beta"]) for stages in chains)
    variables = {}
    for name in chains[0]:
        table = np.full((len(chains), n_stages), np.nan)
        for row, stages in zip(table, chains, strict=True):
            row[: len(stages[name])] = stages[name]
        variables[name] = (["chain", "stage"], table)
    coords = {"chain": np.arange(len(chains)), "stage": np.arange(n_stages)}
    return xr.Dataset(variables, coords=coords)


def _evidence(chains: Sequence[Stages]) -> dict[str, float]:
    """Return the log of the chains' mean marginal likelihood, and the spread of their logs."""
    key = "log_marginal_likelihood"
    logs = np.array([stages[key][-1] for stages in chains if key in stages])
    if not logs.size:
        return {}
    top = logs.max()
    return {
        "log_marginal_likelihood": float(top + np.log(np.exp(logs - top).mean())),
        "log_marginal_likelihood_sd": float(logs.std(ddof=1)) if logs.size > 1 else np.nan,
    }


# -- calibration -----------------------------------------------------------------------------------


def _calibration(evaluator: Evaluator, draws: Draws) -> xr.Dataset:
    """Return figures and settings of the simulators, by draw and over all draws."""
    nodes = evaluator.nodes
    chains, n_draws, _ = draws.thetas.shape
    at_best = {
        f"{key}_at_best": (
            "simulator",
            [draws.missing.get(node.name, {}).get(key, np.nan) for node in nodes],
        )
        for key in ("lost_mass", "failed_mass")
    }
    bounds = [node.reweighted for node in nodes]
    errors = np.full(len(nodes), np.nan) if draws.errors is None else draws.errors
    required = [np.nan if bound is None else bound.required_ess for bound in bounds]
    by_metric = xr.Dataset(
        {
            "discrepancy": (_BY_DRAW, draws.discrepancies),
            **_support(evaluator, draws),
            "theta": (["chain", "draw", "element"], draws.thetas),
            "discrepancy_error": ("simulator", errors),
            **at_best,
            "epsilon": ("simulator", evaluator.epsilon),
            "required_ess": ("simulator", required),
            "max_lost": ("simulator", [node.bound.max_lost for node in nodes]),
            "metric": ("simulator", [without_addresses(node.metric) for node in nodes]),
            "compared": ("simulator", [components_summary(node.target) for node in nodes]),
            "propagation": ("simulator", [without_addresses(node.propagation) for node in nodes]),
            "n_points": ("simulator", [node.bound.n_points for node in nodes]),
            "n_runs": ("simulator", [node.bound.n_runs for node in nodes]),
            "is_likelihood": ("simulator", np.zeros(len(nodes), dtype=int)),
        },
        coords={
            "simulator": [node.name for node in nodes],
            "element": evaluator.hyperparameters.names,
            "chain": np.arange(chains),
            "draw": np.arange(n_draws),
        },
    )
    if not evaluator.likelihoods:
        return by_metric
    return xr.concat(
        [by_metric, _by_specimen(evaluator, draws.thetas, by_metric)],
        "simulator",
        data_vars="minimal",
        coords="minimal",
        compat="override",
        join="outer",
    )


def _by_specimen(evaluator: Evaluator, thetas: Floats, by_metric: xr.Dataset) -> xr.Dataset:
    """Return the same variables of the simulators with a log-likelihood by specimen.

    Minus the log-likelihood is the discrepancy, with an epsilon of one.
    """
    chains, draws, d = thetas.shape
    measurements = evaluator.measurements
    likelihoods = [likelihood_of(evaluator, m) for m in measurements]
    values = specimen_log_likelihoods(evaluator, thetas.reshape(-1, d))
    names = [m.name for m in measurements]
    discrepancies = np.stack([-values[name].sum(axis=1) for name in names], axis=-1)
    n_runs = [len(prepared(likelihood).emulation.z) for likelihood in likelihoods]
    variables: dict[str, Any] = {
        "discrepancy": (_BY_DRAW, discrepancies.reshape(chains, draws, -1)),
        "epsilon": ("simulator", np.ones(len(names))),
        "max_lost": ("simulator", np.full(len(names), MAX_LOST)),
        "metric": ("simulator", [without_addresses(m.metric) for m in measurements]),
        "compared": ("simulator", [""] * len(names)),
        "propagation": ("simulator", [f"emulator of {n} runs" for n in n_runs]),
        "n_points": (
            "simulator",
            [prepared(likelihood).points.log_a.size for likelihood in likelihoods],
        ),
        "n_runs": ("simulator", n_runs),
        "is_likelihood": ("simulator", np.ones(len(names), dtype=int)),
    }
    for name, variable in by_metric.data_vars.items():
        if name not in variables and "simulator" in variable.dims:
            shape = [len(names) if dim == "simulator" else n for dim, n in variable.sizes.items()]
            variables[str(name)] = (variable.dims, np.full(shape, np.nan))
    return xr.Dataset(variables, coords={**by_metric.coords, "simulator": names})


def _support(evaluator: Evaluator, draws: Draws) -> dict[str, Any]:
    """Return how well designs support each draw, by simulator; NaN without a design.

    The lost mass without a design is that of the draws.
    """
    chains, n_draws, d = draws.thetas.shape
    support = evaluator.support(draws.thetas.reshape(-1, d))
    assert draws.lost is not None
    lost = draws.lost.reshape(chains * n_draws, -1)
    variables: dict[str, Any] = {}
    for key in ("weight_ess", "mean_weight", "lost_mass", "failed_mass"):
        columns = np.full((chains * n_draws, len(evaluator.nodes)), np.nan)
        for k, node in enumerate(evaluator.nodes):
            if node.name in support:
                columns[:, k] = support[node.name][key]
            elif key == "lost_mass":
                columns[:, k] = lost[:, k]
        variables[key] = (_BY_DRAW, columns.reshape(chains, n_draws, -1))
    lossy = []
    for k, node in enumerate(evaluator.nodes):
        mass = support[node.name]["lost_mass"] if node.name in support else lost[:, k]
        lossy.append(share_of_lossy(mass, node.bound.max_lost))
    variables["lossy_draws"] = ("simulator", lossy)
    return variables


def share_of_lossy(lost: Floats, max_lost: float) -> float:
    """Return the share of draws that have lost too much of a population; NaN are left out."""
    lost = lost[~np.isnan(lost)]
    return float((lost > max_lost).mean()) if lost.size else 0.0


# -- groups for ArviZ ------------------------------------------------------------------------------


def arviz_groups(evaluator: Evaluator, draws: Draws, seed: int | None) -> dict[str, xr.Dataset]:
    """Return groups for ArviZ, which cost no response.

    ``prior``, ``log_prior`` and ``log_likelihood``, by specimen or for all together, and
    ``posterior_predictive`` and ``prior_predictive`` of simulators whose responses are stored or
    emulated.
    """
    thetas = draws.thetas
    rng = np.random.default_rng(seed)
    prior_seed = int(rng.integers(2**31))
    prior = evaluator.hyperparameters.prior_thetas(thetas.shape[1], prior_seed)[None]
    groups = {
        "prior": _variables(evaluator, prior),
        "log_prior": _log_prior(evaluator, thetas),
    }
    if evaluator.nodes:
        assert draws.log_likelihood is not None
        groups["log_likelihood"] = _log_likelihood(evaluator, thetas, draws.log_likelihood)
        predictive = _stored_responses
    else:
        groups["log_likelihood"] = _log_likelihood_by_specimen(evaluator, thetas)
        predictive = _emulated_responses
    posterior_predictive = predictive(evaluator, thetas, rng)
    prior_predictive = predictive(evaluator, prior, rng)
    if prior_predictive:
        groups["posterior_predictive"] = posterior_predictive
        groups["prior_predictive"] = prior_predictive
    return {name: group.assign_attrs(arviz_attributes()) for name, group in groups.items()}


def _log_prior(evaluator: Evaluator, thetas: Floats) -> xr.Dataset:
    """Return the log prior density of each variable in the user's own units, by draw."""
    chains, draws, d = thetas.shape
    terms = evaluator.hyperparameters.log_prior_terms(thetas.reshape(-1, d))
    variables = {
        name: (["chain", "draw"], value.reshape(chains, draws)) for name, value in terms.items()
    }
    return xr.Dataset(variables, coords={"chain": np.arange(chains), "draw": np.arange(draws)})


def _log_likelihood(evaluator: Evaluator, thetas: Floats, log_likelihood: Floats) -> xr.Dataset:
    """Return the log-likelihood of all specimens together, and that of the model's other terms.

    Each dimension of specimens has one place: ArviZ would take a number without such a dimension
    for that of each specimen, as in `loo_expectations`.
    """
    chains, draws, d = thetas.shape
    other_terms = evaluator.log_other(thetas.reshape(-1, d)).reshape(chains, draws)
    observed = observed_dataset(evaluator)
    specimens = list(dict.fromkeys(str(observed[node.name].dims[0]) for node in evaluator.nodes))
    shape = (chains, draws, *[1] * len(specimens))
    dims = ["chain", "draw", *specimens]
    note = (
        "The log-density of all specimens together, and that of the model's other terms: one "
        "number for each draw, for power-scaling (psense), of one place for specimens. loo, "
        "compare and khat want one for each observation and have no meaning here; use "
        "prb.cross_validate."
    )
    return xr.Dataset(
        {
            # ArviZ functions that need a number for each observation show these names.
            "one_number_for_all_specimens": (dims, (log_likelihood - other_terms).reshape(shape)),
            "other_terms": (dims, other_terms.reshape(shape)),
        },
        coords={"chain": np.arange(chains), "draw": np.arange(draws)},
        attrs={"note": note},
    )


def _log_likelihood_by_specimen(evaluator: Evaluator, thetas: Floats) -> xr.Dataset:
    """Return the log-likelihood of each specimen, by draw."""
    chains, draws, d = thetas.shape
    values = specimen_log_likelihoods(evaluator, thetas.reshape(-1, d))
    observed = observed_dataset(evaluator)
    coords: dict[str, Any] = {"chain": np.arange(chains), "draw": np.arange(draws)}
    variables = {}
    for likelihood in evaluator.likelihoods:
        name = likelihood.measurements[-1].name
        dim = str(observed[name].dims[0])
        labels = specimen_labels(likelihood)
        if labels is not None:  # by specimen, not by reading
            dim = f"{name}_specimen"
            coords[dim] = labels
        variables[name] = (["chain", "draw", dim], values[name].reshape(chains, draws, -1))
    return xr.Dataset(variables, coords=coords)


def _emulated_responses(
    evaluator: Evaluator, thetas: Floats, rng: np.random.Generator
) -> xr.Dataset:
    """Return emulated responses of new specimens at thetas, (chains, draws, d)."""
    chains, draws, d = thetas.shape
    responses = {}
    for k, likelihood in enumerate(evaluator.likelihoods):
        params = specimen_params(evaluator, thetas.reshape(-1, d), k)
        for measurement in likelihood.measurements:
            values = draw_readings(likelihood, rng, params, len(measurement.observed), measurement)
            responses[measurement.name] = values.reshape(chains, draws, *values.shape[1:])
    return labelled_responses(evaluator, responses, (chains, draws))


def _stored_responses(evaluator: Evaluator, thetas: Floats, rng: np.random.Generator) -> xr.Dataset:
    """Return stored responses of new specimens at thetas, (chains, draws, d).

    If all draws would take too much memory, they are thinned.
    """
    chains, draws, d = thetas.shape
    stored = [k for k, node in enumerate(evaluator.nodes) if node.bound.n_per_theta == 0]
    size = chains * draws * sum(evaluator.nodes[k].target.observed.size for k in stored)
    thinned = np.arange(draws)[:: max(1, math.ceil(size / AT_ONCE))]
    leading = (chains, len(thinned))
    rows = thetas[:, thinned].reshape(-1, d)
    responses = {}
    for k in stored:
        values = _stored_specimens(evaluator, k, rows, rng)
        responses[evaluator.nodes[k].name] = values.reshape(*leading, *values.shape[1:])
    return labelled_responses(evaluator, responses, leading).assign_coords(draw=thinned)


def _stored_specimens(
    evaluator: Evaluator, k: int, thetas: Floats, rng: np.random.Generator
) -> Floats:
    """Draw as many stored responses as were observed at each theta, shape (P, N) or (P, N, m).

    They are drawn by weight and with replacement; NaN at thetas without a population.
    """
    node = evaluator.nodes[k]
    size = len(node.target.observed)
    drawn = np.full((len(thetas), size, *node.target.event), np.nan)
    step = max(1, IN_CACHE // node.bound.n_points)
    for first in range(0, len(thetas), step):
        roots = evaluator.roots(thetas[first : first + step], k)
        valid = np.flatnonzero(node.bound.valid(roots))
        if not valid.size:
            continue
        values, weights = node.bound.populations([root[valid] for root in roots])
        responses = values[0]  # of all populations
        cumulative = np.cumsum(np.where(is_missing(responses), 0.0, weights), axis=1)
        for place, row in zip(first + valid, cumulative, strict=True):
            if row[-1] > 0:
                uniform = rng.random(size) * row[-1]
                drawn[place] = responses[np.searchsorted(row, uniform, side="right")]
    return drawn


# -- selections ------------------------------------------------------------------------------------


def require_names(var_names: object, model: pm.Model) -> list[str] | None:
    """Return names of variables and deterministics of a model, or raise; None for all."""
    if var_names is None:
        return None
    names = [var_names] if isinstance(var_names, str) else var_names
    if not isinstance(names, Sequence) or not all(isinstance(name, str) for name in names):
        raise TypeError(f"var_names: got {called(var_names)}, expected names of variables")
    expected = [str(variable.name) for variable in model.unobserved_RVs]
    unknown = [name for name in names if name not in expected]
    if unknown or not names:
        raise KeyError(f"var_names: got {unknown or 'none'}, expected some of {expected}")
    return list(names)


def require_idata_kwargs(idata_kwargs: object) -> dict[str, Any]:
    """Return keywords of `pymc.to_inference_data`, or raise TypeError."""
    if idata_kwargs is None:
        return {}
    if not isinstance(idata_kwargs, Mapping):
        raise TypeError(f"idata_kwargs: got {called(idata_kwargs)}, expected a dict")
    expected = ["coords", "dims", "log_likelihood", "log_prior"]
    unknown = sorted(map(str, set(idata_kwargs) - set(expected)))
    if unknown:
        raise TypeError(
            f"idata_kwargs: got {unknown}, expected some of {expected}; priors and predictive "
            "draws are in the result, transformed values in calibration.theta"
        )
    for name in ("log_likelihood", "log_prior"):
        flag(idata_kwargs.get(name, True), f"idata_kwargs: {name}")
    for name in ("coords", "dims"):
        if not isinstance(idata_kwargs.get(name, {}), Mapping):
            raise TypeError(
                f"idata_kwargs: {name}: got {called(idata_kwargs[name])}, expected a dict"
            )
    return dict(idata_kwargs)


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
        group = _with_dims(group, idata_kwargs.get("dims", {}))
        groups[name] = group.assign_coords(
            {dim: values for dim, values in coords.items() if dim in group.dims}
        )
    return xr.DataTree.from_dict(groups)


def _with_dims(group: xr.Dataset, dims: Mapping[str, Any]) -> xr.Dataset:
    """Return a group whose variables have other dimensions after chain and draw."""
    for variable, new in dims.items():
        if variable not in group:
            continue
        names = [new] if isinstance(new, str) else list(new)
        old = [dim for dim in group[variable].dims if dim not in ("chain", "draw")]
        if len(old) != len(names):
            raise ValueError(
                f"idata_kwargs: dims: {variable}: got {names}, expected {len(old)} names, one for "
                "each dimension"
            )
        renamed = group[variable].rename(dict(zip(old, names, strict=True)))
        group = group.drop_vars(variable).assign({variable: renamed})
    return group


def as_multitrace(tree: xr.DataTree, evaluator: Evaluator) -> Any:
    """Return the draws alone as a `pymc.backends.base.MultiTrace`."""
    from pymc.backends.base import MultiTrace
    from pymc.backends.ndarray import NDArray

    shapes = evaluator.hyperparameters.shapes
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
