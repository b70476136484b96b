"""Simulation-based calibration of three models by the default posterior: are the ranks of the truth uniform?

Models of ``benchmarks/posterior.py``, each by another metric, N = 20: gamma inputs by the
probability residual, Weibull inputs by the Kullback-Leibler divergence, a response with a threshold
by the area metric. Hyperparameters are drawn from the priors, data from their populations. Ranks are
kept in the results file, where a longer study goes on.

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


def block(model: str, first: int) -> dict[str, list[float]]:
    """Return the ranks of as many data sets by hyperparameter, and how many failed."""
    import prbayes as prb

    evaluator = build(PROBLEMS[model], MODELS[model], SIZE)
    found = prb.simulation_based_calibration(
        _BLOCK, model=evaluator.model, draws=DRAWS, random_seed=first, progressbar=False
    )
    ranks = {name: np.ravel(values).tolist() for name, values in found.prior_sbc.items()}
    return {"failed": [float(found.prior_sbc.attrs["failed"])], **ranks}


def summarise(blocks: list[dict[str, list[float]]]) -> dict[str, Any]:
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
    return found


def main() -> None:
    """Run what is missing, then summarise."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data-sets", type=int, default=100)
    arguments = parser.parse_args()
    logging.getLogger("prbayes").setLevel(logging.ERROR)
    ranks: dict[str, list[Any]] = record.load(OUT, {}).get("ranks", {name: [] for name in MODELS})
    for first in range(0, arguments.data_sets, _BLOCK):
        for model, known in ranks.items():
            if len(known) * _BLOCK > first:
                continue
            part = block(model, first)
            known.append({name: np.round(r, 4).tolist() for name, r in part.items()})
            summary = {name: summarise(parts) for name, parts in ranks.items() if parts}
            record.save(OUT, {"summary": summary, "ranks": ranks})
            print(model, summary[model])


if __name__ == "__main__":
    main()
