"""What ArviZ looks for beside the posterior: prior, predictive draws, and densities of draws."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import xarray as xr

from prbayes._validate import AT_ONCE, IN_CACHE, Floats
from prbayes.model.evaluator import Evaluator, specimen_log_likelihoods, specimen_params
from prbayes.model.labels import (
    arviz_attributes,
    labelled,
    labelled_responses,
    observed_dataset,
)
from prbayes.model.measurement import specimen_labels
from prbayes.model.specimen_likelihood import draw_readings
from prbayes.response.outputs import is_missing

# The names that ArviZ's functions which want a number for each observation show when they refuse.
_LIKELIHOOD = ("one_number_for_all_specimens", "other_terms")
_NOTE = (
    "The log-density of all specimens together, and that of the model's other terms: one number "
    "for each draw, for power-scaling (psense), of one place for specimens. loo, compare and khat "
    "want one for each observation and have no meaning here; use prb.cross_validate."
)


def arviz_groups(
    evaluator: Evaluator, thetas: Floats, log_likelihood: Floats, seed: int | None
) -> dict[str, xr.Dataset]:
    """Return groups that cost no response.

    Parameters
    ----------
    evaluator : Evaluator
    thetas : ndarray, shape (chains, draws, d)
    log_likelihood : ndarray, shape (chains, draws)
        Of the draws, up to a constant.
    seed : int or None

    Returns
    -------
    dict
        ``prior``, ``log_prior`` and ``log_likelihood``; ``posterior_predictive`` and
        ``prior_predictive`` of the simulators whose responses are stored.
    """
    draws = thetas.shape[1]
    rng = np.random.default_rng(seed)
    prior_seed = int(rng.integers(2**31))
    prior = evaluator.hyperparameters.prior_thetas(draws, prior_seed)
    groups = {
        "prior": _variables(evaluator, prior[None]),
        "log_prior": _log_prior(evaluator, thetas),
        "log_likelihood": _log_likelihood(evaluator, thetas, log_likelihood),
    }
    groups["posterior_predictive"] = _predictive(evaluator, thetas, rng)
    groups["prior_predictive"] = _predictive(evaluator, prior[None], rng)
    if not groups["prior_predictive"]:
        del groups["posterior_predictive"], groups["prior_predictive"]
    return {name: group.assign_attrs(arviz_attributes()) for name, group in groups.items()}


def specimen_groups(
    evaluator: Evaluator, thetas: Floats, seed: int | None
) -> dict[str, xr.Dataset]:
    """Return the groups of a model with likelihoods by specimen; no run is made.

    Parameters
    ----------
    evaluator : Evaluator
    thetas : ndarray, shape (chains, draws, d)
    seed : int or None

    Returns
    -------
    dict
        ``prior``, ``log_prior``, ``log_likelihood`` with a value for each specimen, and
        ``posterior_predictive`` and ``prior_predictive`` draws by the emulator.
    """
    chains, draws, d = thetas.shape
    rng = np.random.default_rng(seed)
    prior = evaluator.hyperparameters.prior_thetas(draws, int(rng.integers(2**31)))
    values = specimen_log_likelihoods(evaluator, thetas.reshape(-1, d))
    observed = observed_dataset(evaluator)
    coords: dict[str, Any] = {"chain": np.arange(chains), "draw": np.arange(draws)}
    log_likelihood = {}
    for likelihood in evaluator.likelihoods:
        name = likelihood.measurements[-1].name
        dim = str(observed[name].dims[0])
        if specimen_labels(likelihood) is not None:  # by specimen, not by reading
            dim = f"{name}_specimen"
            coords[dim] = specimen_labels(likelihood)
        value = values[name].reshape(chains, draws, -1)
        log_likelihood[name] = (["chain", "draw", dim], value)
    groups = {
        "prior": _variables(evaluator, prior[None]),
        "log_prior": _log_prior(evaluator, thetas),
        "log_likelihood": xr.Dataset(log_likelihood, coords=coords),
        "posterior_predictive": _emulated(evaluator, thetas, rng),
        "prior_predictive": _emulated(evaluator, prior[None], rng),
    }
    return {name: group.assign_attrs(arviz_attributes()) for name, group in groups.items()}


def _emulated(evaluator: Evaluator, thetas: Floats, rng: np.random.Generator) -> xr.Dataset:
    """Return emulated responses of new specimens at thetas, (chains, draws, d)."""
    chains, draws, d = thetas.shape
    drawn = {}
    for k, likelihood in enumerate(evaluator.likelihoods):
        params = specimen_params(evaluator, thetas.reshape(-1, d), k)
        for measurement in likelihood.measurements:
            values = draw_readings(likelihood, rng, params, len(measurement.observed), measurement)
            drawn[measurement.name] = values.reshape(chains, draws, *values.shape[1:])
    return labelled_responses(evaluator, drawn, (chains, draws))


def _variables(evaluator: Evaluator, thetas: Floats) -> xr.Dataset:
    """Return variables and deterministics at thetas, shape (chains, draws, d)."""
    chains, draws, d = thetas.shape
    found = {}
    for name, value in evaluator.hyperparameters.constrained(thetas.reshape(-1, d)).items():
        found[name] = value.reshape(chains, draws, *value.shape[1:])
    return labelled(evaluator, found, {"chain": chains, "draw": draws})


def _predictive(evaluator: Evaluator, thetas: Floats, rng: np.random.Generator) -> xr.Dataset:
    """Return responses of the simulators that store theirs, at thetas (chains, draws, d).

    At every draw, or, where these are more numbers than are held at once, at some of them.
    """
    chains, draws, d = thetas.shape
    nodes = evaluator.nodes
    stored = [k for k, node in enumerate(nodes) if node.bound.n_per_theta == 0]
    of_one = sum(nodes[k].target.observed.size for k in stored)
    numbers = chains * draws * of_one
    every = max(1, math.ceil(numbers / AT_ONCE))
    kept = np.arange(draws)[::every]
    some = thetas[:, kept]
    leading = some.shape[:2]
    rows = some.reshape(-1, d)
    drawn = {}
    for k in stored:
        values = _specimens(evaluator, k, rows, rng)
        by_chain = values.reshape(*leading, *values.shape[1:])
        drawn[nodes[k].name] = by_chain
    found = labelled_responses(evaluator, drawn, leading)
    return found.assign_coords(draw=kept)


def _log_prior(evaluator: Evaluator, thetas: Floats) -> xr.Dataset:
    """Return the log prior density of each variable in the user's own units, by draw."""
    chains, draws, d = thetas.shape
    terms = evaluator.hyperparameters.log_prior_terms(thetas.reshape(-1, d))
    variables = {
        name: (["chain", "draw"], value.reshape(chains, draws)) for name, value in terms.items()
    }
    return xr.Dataset(variables, coords={"chain": np.arange(chains), "draw": np.arange(draws)})


def _log_likelihood(evaluator: Evaluator, thetas: Floats, log_likelihood: Floats) -> xr.Dataset:
    """Return the log-likelihood of draws in two parts, with that of ordinary terms apart.

    Along each dimension of specimens there is one place: ArviZ would take a number without such a
    dimension for that of each specimen, as in `loo_expectations`.
    """
    chains, draws, d = thetas.shape
    other = evaluator.log_other(thetas.reshape(-1, d)).reshape(chains, draws)
    together = _dims_of_specimens(evaluator)
    dims = ["chain", "draw", *together]
    shape = (chains, draws, *[1] * len(together))
    values = (log_likelihood - other, other)
    parts = {
        name: (dims, part.reshape(shape)) for name, part in zip(_LIKELIHOOD, values, strict=True)
    }
    coords = {"chain": np.arange(chains), "draw": np.arange(draws)}
    return xr.Dataset(parts, coords=coords, attrs={"note": _NOTE})


def _dims_of_specimens(evaluator: Evaluator) -> list[str]:
    """Return the names of the dimensions along which the simulators' specimens are, each once."""
    observed = observed_dataset(evaluator)
    firsts = [str(observed[node.name].dims[0]) for node in evaluator.nodes]
    return list(dict.fromkeys(firsts))


def _specimens(evaluator: Evaluator, k: int, thetas: Floats, rng: np.random.Generator) -> Floats:
    """Draw as many stored responses as were observed at each theta, shape (P, N) or (P, N, m).

    They are specimens of the population's points, by weight and with replacement.
    """
    node = evaluator.nodes[k]
    size = len(node.target.observed)
    event = node.target.event
    drawn = np.full((len(thetas), size, *event), np.nan)
    step = max(1, IN_CACHE // node.bound.n_points)
    for first in range(0, len(thetas), step):
        roots = evaluator.roots(thetas[first : first + step], k)
        where = np.flatnonzero(node.bound.valid(roots))
        if not where.size:
            continue
        values, weights = node.bound.populations([root[where] for root in roots])
        # The same responses carry all populations.
        points = values[0]
        edges = np.cumsum(np.where(is_missing(points), 0.0, weights), axis=1)
        for place, row in zip(first + where, edges, strict=True):
            total = row[-1]
            if total > 0:
                uniform = rng.random(size) * total
                chosen = np.searchsorted(row, uniform, side="right")
                drawn[place] = points[chosen]
    return drawn
