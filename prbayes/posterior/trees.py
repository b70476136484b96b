"""The schema of posterior results: groups, dimensions, attributes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from prbayes._finding import Finding, as_json
from prbayes._validate import Floats
from prbayes.metrics.multivariate import components_summary
from prbayes.model.description import as_attribute, without_addresses
from prbayes.model.elements import split_elements
from prbayes.model.evaluator import Evaluator, likelihood_of, specimen_log_likelihoods
from prbayes.model.fingerprint import as_attributes, identity_of
from prbayes.model.labels import (
    arviz_attributes,
    failures_dataset,
    labelled,
    observed_dataset,
    versions,
)
from prbayes.model.specimen_preparation import prepared
from prbayes.propagation.base import MAX_LOST


def posterior_tree(
    evaluator: Evaluator,
    thetas: Floats,
    discrepancies: Floats,
    lost: Floats,
    stats: Sequence[dict[str, list[float]]],
    *,
    sampler: Mapping[str, Any],
    sample_stats: xr.Dataset | None = None,
    adjustment: str = "none",
    findings: tuple[Finding, ...] = (),
    errors: Floats | None = None,
    missing: Mapping[str, Mapping[str, float]] | None = None,
    stopped: str = "",
    seed: int | None,
    n_responses: int,
    seconds: float,
    groups: Mapping[str, xr.Dataset] | None = None,
) -> xr.DataTree:
    """Return the DataTree of a sampler's draws.

    Parameters
    ----------
    evaluator : Evaluator
    thetas : ndarray, shape (chains, draws, d)
    discrepancies : ndarray, shape (chains, draws, k)
        NaN where they would cost responses.
    lost : ndarray, shape (chains, draws, k)
        Shares of populations without response; NaN of stored responses, or if not known.
    stats : list of dict
        By chain: statistics by name, one value per stage.
    sampler : mapping
        Attributes with the name of the sampler and its diagnostics.
    sample_stats : Dataset, optional
        Statistics of another sampler than SMC, in place of those by stage.
    adjustment : str
        "estimate" of draws given the estimate, else "none".
    findings : tuple of Finding
    errors : ndarray, shape (k,), or None
        Monte Carlo errors of the discrepancies.
    missing : mapping, optional
        By simulator: shares of the best draw's population that were lost, and that failed.
    stopped : str
        Which budget ended the run before everything was done.
    seed : int or None
    n_responses : int
        Scalar responses computed, the designs' included.
    seconds : float
    groups : mapping, optional
        What ArviZ looks for besides.
    """
    attrs = {
        "n_responses": n_responses,
        "seconds": seconds,
        "random_seed": "None" if seed is None else str(seed),
        "adjustment": adjustment,
        **sampler,
        "stopped": stopped,
        "findings": as_json(findings),
        **versions(),
    }
    if errors is None:
        errors = np.full(len(evaluator.nodes), np.nan)
    tree = {
        "posterior": _posterior(evaluator, thetas, attrs | _evidence(stats)),
        **(groups or {}),
        "sample_stats": _sample_stats(stats) if sample_stats is None else sample_stats,
        "calibration": _calibration(
            evaluator,
            thetas,
            discrepancies,
            errors,
            missing or {},
            _support(evaluator, thetas, lost),
        ).assign_attrs(attrs),
        "observed_data": observed_dataset(evaluator),
    }
    failures = failures_dataset(evaluator)
    if failures.sizes["failure"]:
        tree["failures"] = failures
    return xr.DataTree.from_dict(tree)


def _posterior(evaluator: Evaluator, thetas: Floats, attrs: dict[str, Any]) -> xr.Dataset:
    """Return the draws, with what is told of them and of the model."""
    return _draws(evaluator, thetas).assign_attrs(
        {
            **arviz_attributes(),
            **({"sampling_time": attrs["seconds"]} if "seconds" in attrs else {}),
            **attrs,
            **as_attribute(evaluator.model),
            **as_attributes(identity_of(evaluator)),
        }
    )


def _calibration(
    evaluator: Evaluator,
    thetas: Floats,
    discrepancies: Floats,
    errors: Floats,
    missing: Mapping[str, Mapping[str, float]],
    support: dict[str, Any],
) -> xr.Dataset:
    """Return what is known of the simulators, by draw and over all."""
    chains, draws, _ = thetas.shape
    at_the_best = {}
    for key in ("lost_mass", "failed_mass"):
        shares = [missing.get(node.name, {}).get(key, np.nan) for node in evaluator.nodes]
        at_the_best[f"{key}_at_best"] = ("simulator", shares)
    by_metric = xr.Dataset(
        {
            "discrepancy": (_EACH_DRAW, discrepancies),
            **support,
            "theta": (["chain", "draw", "element"], thetas),
            "discrepancy_error": ("simulator", errors),
            **at_the_best,
            **_by_simulator(evaluator),
        },
        coords={
            "simulator": [node.name for node in evaluator.nodes],
            "element": evaluator.hyperparameters.names,
            "chain": np.arange(chains),
            "draw": np.arange(draws),
        },
    )
    if not evaluator.likelihoods:
        return by_metric
    by_specimen = _by_specimen(evaluator, thetas, by_metric)
    return xr.concat(
        [by_metric, by_specimen],
        "simulator",
        data_vars="minimal",
        coords="minimal",
        compat="override",
        join="outer",
    )


def _by_specimen(evaluator: Evaluator, thetas: Floats, beside: xr.Dataset) -> xr.Dataset:
    """Return the same variables of the simulators with a log-likelihood by specimen.

    Minus the log-likelihood is the discrepancy, with an epsilon of one.
    """
    chains, draws, d = thetas.shape
    measurements = evaluator.measurements
    likelihoods = [likelihood_of(evaluator, m) for m in measurements]
    values = specimen_log_likelihoods(evaluator, thetas.reshape(-1, d))
    names = [m.name for m in measurements]
    discrepancies = np.stack([-values[name].sum(axis=1) for name in names], axis=-1)
    runs = [len(prepared(likelihood).emulation.z) for likelihood in likelihoods]
    known: dict[str, Any] = {
        "discrepancy": (_EACH_DRAW, discrepancies.reshape(chains, draws, -1)),
        "epsilon": ("simulator", np.ones(len(names))),
        "max_lost": ("simulator", np.full(len(names), MAX_LOST)),
        "metric": ("simulator", [without_addresses(m.metric) for m in measurements]),
        "compared": ("simulator", [""] * len(names)),
        "propagation": ("simulator", [f"emulator of {count} runs" for count in runs]),
        "n_points": ("simulator", [prepared(each).points.log_a.size for each in likelihoods]),
        "n_runs": ("simulator", runs),
        "is_likelihood": ("simulator", np.ones(len(names), dtype=int)),
    }
    for name, variable in beside.data_vars.items():
        if name not in known and "simulator" in variable.dims:
            shape = [len(names) if dim == "simulator" else n for dim, n in variable.sizes.items()]
            known[str(name)] = (variable.dims, np.full(shape, np.nan))
    return xr.Dataset(known, coords={**beside.coords, "simulator": names})


_EACH_DRAW = ["chain", "draw", "simulator"]


def _sample_stats(stats: Sequence[dict[str, list[float]]]) -> xr.Dataset:
    """Return statistics by chain and stage, NaN after the last one of a chain."""
    n_chains = len(stats)
    n_stages = max(len(chain["beta"]) for chain in stats)
    variables = {}
    for name in stats[0]:
        table = np.full((n_chains, n_stages), np.nan)
        for row, chain in zip(table, stats, strict=True):
            known = chain[name]
            row[: len(known)] = known
        variables[name] = (["chain", "stage"], table)
    coords = {"chain": np.arange(n_chains), "stage": np.arange(n_stages)}
    return xr.Dataset(variables, coords=coords)


def _support(evaluator: Evaluator, thetas: Floats, lost: Floats) -> dict[str, Any]:
    """Return how well designs support each draw, by simulator; NaN where there is no design.

    ``lost``, as in `posterior_tree`, is what is known without one.
    """
    chains, draws, d = thetas.shape
    found = evaluator.support(thetas.reshape(-1, d))
    variables: dict[str, Any] = {}
    for key in ("weight_ess", "mean_weight", "lost_mass", "failed_mass"):
        columns = np.full((chains * draws, len(evaluator.nodes)), np.nan)
        for k, node in enumerate(evaluator.nodes):
            if node.name in found:
                columns[:, k] = found[node.name][key]
            elif key == "lost_mass":
                columns[:, k] = lost[:, :, k].ravel()
        variables[key] = (_EACH_DRAW, columns.reshape(chains, draws, -1))
    too_much = []
    for k, node in enumerate(evaluator.nodes):
        own = lost[:, :, k]
        if node.name in found:
            own = found[node.name]["lost_mass"]
        too_much.append(share_of_lossy(own, node.bound.max_lost))
    variables["lossy_draws"] = ("simulator", too_much)
    return variables


def share_of_lossy(lost: Floats, max_lost: float) -> float:
    """Return the share of draws of whose populations too much has no response."""
    known = lost[~np.isnan(lost)]
    return float((known > max_lost).mean()) if known.size else 0.0


def _by_simulator(evaluator: Evaluator) -> dict[str, Any]:
    """Return the settings of each simulator."""
    nodes = evaluator.nodes
    bounds = [node.reweighted for node in nodes]
    required = [np.nan if bound is None else bound.required_ess for bound in bounds]
    return {
        "epsilon": ("simulator", evaluator.epsilon),
        "required_ess": ("simulator", required),
        "max_lost": ("simulator", [node.bound.max_lost for node in nodes]),
        "metric": ("simulator", [without_addresses(node.metric) for node in nodes]),
        "compared": ("simulator", [components_summary(node.target) for node in nodes]),
        "propagation": ("simulator", [without_addresses(node.propagation) for node in nodes]),
        "n_points": ("simulator", [node.bound.n_points for node in nodes]),
        "n_runs": ("simulator", [node.bound.n_runs for node in nodes]),
        "is_likelihood": ("simulator", np.zeros(len(nodes), dtype=int)),
    }


def _evidence(stats: Sequence[dict[str, list[float]]]) -> dict[str, float]:
    """Return the log of the chains' mean marginal likelihood, and the spread of their logs."""
    key = "log_marginal_likelihood"
    logs = np.array([stages[key][-1] for stages in stats if key in stages])
    if not logs.size:
        return {}
    spread = float(logs.std(ddof=1)) if logs.size > 1 else np.nan
    top = logs.max()
    mean = np.exp(logs - top).mean()
    return {
        "log_marginal_likelihood": float(top + np.log(mean)),
        "log_marginal_likelihood_sd": spread,
    }


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


def calibration_tree(
    evaluator: Evaluator,
    rows: list[dict[str, Floats]],
    *,
    failed: int,
    draws: int,
    adjustment: object,
    seed: int,
) -> xr.DataTree:
    """Return the DataTree of a simulation-based calibration.

    ``rows`` has rank, truth and sd by variable, one of them for each data set.
    """
    stacked = {}
    for name in rows[0]:
        column = np.stack([row[name] for row in rows])
        stacked[name] = column[None]
    leading = {"chain": 1, "draw": len(rows)}
    groups = {}
    for i, group in enumerate(("prior_sbc", "truth", "posterior_sd")):
        own = {name: values[:, :, i] for name, values in stacked.items()}
        groups[group] = labelled(evaluator, own, leading)
    groups["envelope"], outside = _envelopes(groups["prior_sbc"])
    groups["prior_sbc"].attrs.update(
        {
            "outside": ", ".join(outside),
            "failed": failed,
            "draws": draws,
            "adjustment": str(adjustment),
            "random_seed": str(seed),
            **versions(),
        }
    )
    return xr.DataTree.from_dict(groups)


def _envelopes(ranks: xr.Dataset) -> tuple[xr.Dataset, list[str]]:
    """Return ECDFs of ranks with ArviZ's envelope for uniform ones, and who leaves it."""
    from arviz_stats.ecdf_utils import ecdf_pit

    probability = 0.95  # that of ArviZ's own pictures of ranks
    rows, names = {}, []
    values = {name: variable[0] for name, variable in ranks.data_vars.items()}
    for name, column in split_elements(values).items():
        x, ecdf, lower, upper = ecdf_pit(  # type: ignore[no-untyped-call]
            column, probability, n_simulations=1000, rng=np.random.default_rng(0)
        )
        rows[name] = ecdf
        if ((ecdf < lower) | (ecdf > upper)).any():
            names.append(name)
    found = xr.Dataset(
        {
            "ecdf": (["variable", "x"], np.array(list(rows.values()))),
            "lower": ("x", lower),
            "upper": ("x", upper),
        },
        coords={"variable": list(rows), "x": x},
        attrs={"probability": probability},
    )
    return found, names


def _draws(evaluator: Evaluator, thetas: Floats) -> xr.Dataset:
    """Return draws, shape (chains, draws, d), as labelled variables."""
    chains, draws, d = thetas.shape
    values = evaluator.hyperparameters.constrained(thetas.reshape(-1, d)).items()
    by_chain = {}
    for name, value in values:
        shape = value.shape[1:]
        by_chain[name] = value.reshape(chains, draws, *shape)
    return labelled(evaluator, by_chain, {"chain": chains, "draw": draws})
