"""Simulation-based calibration of three models by the default posterior: are the ranks of the truth uniform?

Models of ``benchmarks/posterior.py``, each by another metric, N = 20: gamma inputs by the
probability residual, Weibull inputs by the Kullback-Leibler divergence, a response with a threshold
by the area metric. Hyperparameters are drawn from the priors, data from their populations. Ranks are
kept in the results file, where a longer study goes on. Beside them are the ranks in the exact posterior of
the same data, on a grid: the difference of both has less noise than either.

    uv run python -m benchmarks.sbc [--data-sets 100]
"""

from __future__ import annotations

import argparse
import logging
from typing import Any

import numpy as np
from scipy import stats

from benchmarks import record
from benchmarks.posterior import PROBLEMS, build

MODELS = {"gamma": "PR", "weibull": "KLD", "threshold": "area"}
SIZE = 20
DRAWS = 500
OUT = record.RESULTS / "sbc.json"
# Data sets of a model before it is the next one's turn.
_BLOCK = 20
# Points of the exact posterior's grid along each hyperparameter.
_GRID = 241


def block(model: str, first: int) -> dict[str, list[float]]:
    """Return the ranks of as many data sets by hyperparameter, and how many failed."""
    import prbayes as prb

    evaluator = build(PROBLEMS[model], MODELS[model], SIZE)
    found = prb.simulation_based_calibration(
        _BLOCK, model=evaluator.model, draws=DRAWS, random_seed=first, progressbar=False
    )
    ranks = {name: np.ravel(values).tolist() for name, values in found.prior_sbc.items()}
    return {"failed": [float(found.prior_sbc.attrs["failed"])], **ranks}


def exact(model: str, first: int) -> dict[str, list[float]]:
    """Return the ranks of the same data sets in the exact posterior."""
    from prbayes.estimate.data_sets import fresh_data

    problem = PROBLEMS[model]
    evaluator = build(problem, MODELS[model], SIZE)
    prior = evaluator.prior_thetas(4096, 0)
    axes = [np.linspace(-4.5, 4.5, _GRID) * x.std() + x.mean() for x in prior.T]
    thetas = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    log_prior = evaluator.hyperparameters.log_prior(thetas.reshape(-1, len(axes)))
    values = evaluator.constrained(thetas.reshape(-1, len(axes)))
    ranks: dict[str, list[float]] = {name: [] for name in values}
    for i in range(_BLOCK):
        # As `prbayes.simulation_based_calibration` draws them.
        rng = np.random.default_rng([first, i])
        truth = evaluator.prior_thetas(1, int(rng.integers(2**31)))[0]
        y = fresh_data(evaluator, truth, rng)["y"]
        with np.errstate(all="ignore"):
            density = problem.log_density(y, **{k: v[:, None] for k, v in values.items()})
        total = np.nan_to_num(log_prior + density.sum(axis=1), nan=-np.inf)
        weights = np.exp(total - total.max()).reshape(thetas.shape[:-1])
        weights /= weights.sum()
        for k, (name, axis) in enumerate(zip(values, axes, strict=True)):
            others = tuple(j for j in range(len(axes)) if j != k)
            mass = weights.sum(axis=others)
            below = np.cumsum(mass) - mass / 2
            ranks[name].append(float(np.interp(truth[k], axis, below)))
    return ranks


def summarise(
    blocks: list[dict[str, list[float]]], of_exact: list[dict[str, list[float]]]
) -> dict[str, Any]:
    """Return what the ranks tell, by hyperparameter."""
    found: dict[str, Any] = {"failed": sum(part["failed"][0] for part in blocks)}
    for name in blocks[0]:
        if name == "failed":
            continue
        ranks = np.concatenate([part[name] for part in blocks])
        found[name] = {
            "data sets": ranks.size,
            "mean rank": ranks.mean(),
            "error of mean rank": 1 / np.sqrt(12 * ranks.size),
            "share within 89%": float((np.abs(ranks - 0.5) < 0.445).mean()),
            "p of Kolmogorov and Smirnov": stats.kstest(ranks, "uniform").pvalue,
        }
        if found["failed"] == 0:
            others = np.concatenate([part[name] for part in of_exact])
            off = ranks - others
            found[name]["exact posterior: mean rank"] = others.mean()
            found[name]["off the exact posterior's"] = off.mean()
            found[name]["error of it"] = off.std(ddof=1) / np.sqrt(off.size)
    return found


def main() -> None:
    """Run what is missing, then summarise."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data-sets", type=int, default=100)
    arguments = parser.parse_args()
    logging.getLogger("prbayes").setLevel(logging.ERROR)
    before = record.load(OUT, {})
    ranks: dict[str, list[Any]] = before.get("ranks", {name: [] for name in MODELS})
    others: dict[str, list[Any]] = before.get("exact ranks", {name: [] for name in MODELS})
    for first in range(0, arguments.data_sets, _BLOCK):
        for model, known in ranks.items():
            if len(known) * _BLOCK <= first:
                known.append(_rounded(block(model, first)))
            if len(others[model]) * _BLOCK <= first:
                others[model].append(_rounded(exact(model, first)))
            summary = {
                name: summarise(parts, others[name])
                for name, parts in ranks.items()
                if parts and len(parts) == len(others[name])
            }
            record.save(OUT, {"summary": summary, "ranks": ranks, "exact ranks": others})
    for model, told in summary.items():
        print(model, told)


def _rounded(part: dict[str, list[float]]) -> dict[str, list[float]]:
    return {name: np.round(r, 4).tolist() for name, r in part.items()}


if __name__ == "__main__":
    main()
