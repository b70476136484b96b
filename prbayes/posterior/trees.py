"""The schema of posterior results: groups, dimensions, attributes."""

from __future__ import annotations

import numpy as np
import xarray as xr

from prbayes._checks import Floats
from prbayes.model.description import as_attribute, without_addresses
from prbayes.model.evaluator import Evaluator
from prbayes.model.identity import as_attributes, identity_of
from prbayes.model.labels import labelled, observed_dataset, versions

_ENVELOPE = 0.95  # probability that the ECDF of uniform ranks stays inside


def posterior_tree(
    evaluator: Evaluator,
    thetas: Floats,
    discrepancies: Floats,
    stats: list[dict[str, list[float]]],
    *,
    unadjusted: Floats | None = None,
    adjustment: str = "none",
    warnings: tuple[str, ...] = (),
    errors: Floats | None = None,
    seed: int | None,
    n_responses: int,
    seconds: float,
) -> xr.DataTree:
    """Return the DataTree of a sampler's draws.

    Parameters
    ----------
    evaluator : Evaluator
    thetas : ndarray, shape (chains, draws, d)
    discrepancies : ndarray, shape (chains, draws, k)
        Before an adjustment; afterwards they are computed anew where that costs no response, and else NaN.
    stats : list of dict
        By chain: statistics by name, one value per stage.
    unadjusted : ndarray, shape (chains, draws, d), or None
    adjustment : str
        What was done to the draws.
    warnings : tuple of str
        What is not identified.
    errors : ndarray, shape (k,), or None
        Monte Carlo errors of the discrepancies.
    seed : int or None
    n_responses : int
        Scalar responses computed, the designs' included.
    seconds : float
    """
    chains, draws, d = thetas.shape
    leading = {"chain": chains, "draw": draws}
    flat = thetas.reshape(-1, d)
    posterior = _draws(evaluator, thetas)
    if unadjusted is not None:
        free = not evaluator.responses_per_theta
        discrepancies = evaluator(flat).discrepancies.reshape(discrepancies.shape) if free else discrepancies * np.nan
    n_stages = max(len(s["beta"]) for s in stats)
    sample_stats = xr.Dataset(
        {
            name: (
                ["chain", "stage"],
                np.array([list(map(float, s[name])) + [np.nan] * (n_stages - len(s[name])) for s in stats]),
            )
            for name in stats[0]
        },
        coords={"chain": np.arange(chains), "stage": np.arange(n_stages)},
    )
    attrs = {
        "sampler": "SMC-ABC",
        "n_responses": n_responses,
        "seconds": seconds,
        "random_seed": "None" if seed is None else str(seed),
        "adjustment": adjustment,
        "warnings": "\n".join(warnings),
        **versions(),
    }
    evidence = _evidence(stats)
    posterior.attrs.update({"inference_library": "prbayes", **attrs, **evidence, **as_attribute(evaluator.model)})
    posterior.attrs.update(as_attributes(identity_of(evaluator)))
    names, designs = [n.name for n in evaluator.nodes], evaluator.designs
    where = ["chain", "draw", "simulator"]
    shape = (chains, draws, len(names))
    support = evaluator.support(flat)
    nothing = {"weight_ess": np.nan, "mean_weight": np.nan, "lost_mass": np.nan}
    calibration = xr.Dataset(
        {
            "discrepancy": (where, discrepancies),
            **{
                key: (
                    where,
                    np.stack([np.broadcast_to(support.get(n, nothing)[key], len(flat)) for n in names], -1).reshape(
                        shape
                    ),
                )
                for key in nothing
            },
            "theta": (["chain", "draw", "element"], thetas),
            "epsilon": ("simulator", evaluator.epsilon),
            "discrepancy_error": ("simulator", np.full(len(names), np.nan) if errors is None else errors),
            "required_ess": ("simulator", [designs[n].required_ess if n in designs else np.nan for n in names]),
            "max_lost": ("simulator", [designs[n].config.max_lost if n in designs else np.nan for n in names]),
            "metric": ("simulator", [without_addresses(n.metric) for n in evaluator.nodes]),
            "propagation": ("simulator", [without_addresses(n.propagation) for n in evaluator.nodes]),
            "n_points": ("simulator", [n.bound.n_points for n in evaluator.nodes]),
        },
        coords={"simulator": names, "element": evaluator.names, **{k: np.arange(v) for k, v in leading.items()}},
        attrs=attrs,
    )
    groups = {
        "posterior": posterior,
        "sample_stats": sample_stats,
        "calibration": calibration,
        "observed_data": observed_dataset(evaluator),
    }
    if unadjusted is not None:
        groups["unadjusted"] = _draws(evaluator, unadjusted)
    return xr.DataTree.from_dict(groups)


def _evidence(stats: list[dict[str, list[float]]]) -> dict[str, float]:
    """Return the logarithm of the mean marginal likelihood of the chains, and their standard deviation in logs."""
    logs = np.array([s["log_marginal_likelihood"][-1] for s in stats if "log_marginal_likelihood" in s])
    if not logs.size:
        return {}
    spread = float(logs.std(ddof=1)) if logs.size > 1 else np.nan
    top = logs.max()
    return {
        "log_marginal_likelihood": float(top + np.log(np.exp(logs - top).mean())),
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
    posterior = _draws(evaluator, thetas)
    posterior.attrs.update(
        {
            "inference_library": "prbayes",
            "sampler": sampler,
            "converged": converged,
            "n_responses": n_responses,
            "seconds": seconds,
            "random_seed": str(seed),
            **versions(),
            **as_attribute(evaluator.model),
            **as_attributes(identity_of(evaluator)),
        }
    )
    return xr.DataTree.from_dict({"posterior": posterior, "observed_data": observed_dataset(evaluator)})


def calibration_tree(
    evaluator: Evaluator, rows: list[dict[str, Floats]], *, failed: int, draws: int, adjust: object, seed: int
) -> xr.DataTree:
    """Return the DataTree of a simulation-based calibration, from rank, truth and sd by variable and data set."""
    stacked = {name: np.stack([row[name] for row in rows])[None] for name in rows[0]}
    leading = {"chain": 1, "draw": len(rows)}
    groups = {
        group: labelled(evaluator, {name: v[:, :, i] for name, v in stacked.items()}, leading)
        for i, group in enumerate(("prior_sbc", "truth", "posterior_sd"))
    }
    groups["envelope"], outside = _envelopes(groups["prior_sbc"])
    groups["prior_sbc"].attrs.update(
        {
            "outside": ", ".join(outside),
            "failed": failed,
            "draws": draws,
            "adjustment": repr(adjust),
            "random_seed": str(seed),
            **versions(),
        }
    )
    return xr.DataTree.from_dict(groups)


def _envelopes(ranks: xr.Dataset) -> tuple[xr.Dataset, list[str]]:
    """Return ECDFs of ranks with ArviZ's envelope for uniform ones, and the names of those that leave it."""
    from arviz_stats.ecdf_utils import ecdf_pit

    rows, names = {}, []
    for key, variable in ranks.data_vars.items():
        values = variable.values[0]
        for i in np.ndindex(values.shape[1:]):
            name = f"{key}[{','.join(map(str, i))}]" if i else str(key)
            x, ecdf, lower, upper = ecdf_pit(  # type: ignore[no-untyped-call]
                values[(slice(None), *i)], _ENVELOPE, n_simulations=1000, rng=np.random.default_rng(0)
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
        attrs={"probability": _ENVELOPE},
    )
    return found, names


def _draws(evaluator: Evaluator, thetas: Floats) -> xr.Dataset:
    """Return draws, shape (chains, draws, d), as labelled variables."""
    chains, draws, d = thetas.shape
    values = evaluator.constrained(thetas.reshape(-1, d)).items()
    return labelled(
        evaluator,
        {n: v.reshape(chains, draws, *v.shape[1:]) for n, v in values},
        {"chain": chains, "draw": draws},
    )
