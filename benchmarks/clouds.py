"""How exact are the points of a cloud, and does the error that is claimed of them say so?

Problems are those of `benchmarks.few_runs`, with an emulator on the runs that it asks for. The runs
and the emulator stay; clouds of two sizes are drawn anew with other seeds, and the optimum of each is
found. Scatter is the standard deviation of the optima over clouds, of the worst hyperparameter, in
standard errors; claimed is what `Optimum.design_error` takes for the points of one cloud, root mean
square; the power is that of the size with which the scatter falls.

Run: uv run python -m benchmarks.clouds [--seeds 8]
"""

from __future__ import annotations

import argparse
import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import prbayes as prb
from benchmarks import few_runs, record
from benchmarks.responses import RESPONSES
from prbayes.inference.design_error import design_error

NAMES = ("resonance", "noise")
SIZES = (8192, 32_768)


def scatter(name: str, seeds: int) -> dict[str, Any]:
    """Return the scatter of optima over clouds, and what is claimed, by size."""
    from prbayes.optimize.minimize import find_optimum
    from prbayes.optimize.objective import Minimisation

    n = few_runs.FIRST * RESPONSES[name].d
    stored = prb.Reweighted(n, emulator="auto", random_seed=1)
    model = few_runs.build(name, few_runs.observed_of(name, 1), stored)
    first = prb.minimize(model, starts=0, progressbar=False)
    bound = first.evaluator.reweighted["y"]
    design = bound.design
    unit = np.sqrt(np.diag(first.covariance))
    found: dict[str, Any] = {"inputs": RESPONSES[name].d, "runs": bound.n_runs}
    for size in SIZES:
        optima, claimed = [], []
        for seed in range(seeds):
            number = design.n_emulated_samples + 17 * (seed + 1)
            bound.design = replace(design, n_emulated_samples=number, emulated_size=size)
            bound.reach(design.groups[-1])
            asked = Minimisation(start=first.point, refine=False, starts=0)
            optimum = find_optimum(first.evaluator, asked)
            optima.append(optimum.theta / unit)
            claimed.append(design_error(optimum.sampling()).points / np.sqrt(2))
        spread = np.std(optima, axis=0, ddof=1)[np.isfinite(unit)]
        found[str(size)] = {
            "scatter": float(spread.max()),
            "claimed": float(np.sqrt(np.mean(np.square(claimed)))),
        }
    small, large = (found[str(size)]["scatter"] for size in SIZES)
    found["power"] = float(np.log(small / large) / np.log(SIZES[1] / SIZES[0]))
    return found


def main() -> None:
    """Print a table and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--problems", nargs="+", default=list(NAMES), choices=list(RESPONSES))
    parser.add_argument("--out", type=Path, default=record.RESULTS / "clouds.json")
    arguments = parser.parse_args()
    logging.getLogger("prbayes").setLevel(logging.ERROR)
    table: dict[str, Any] = record.load(arguments.out, {})
    for name in arguments.problems:
        row = table[name] = scatter(name, arguments.seeds)
        record.save(arguments.out, table)
        for size in SIZES:
            cell = row[str(size)]
            ratio = cell["claimed"] / cell["scatter"]
            print(
                f"{name:12s} {row['runs']:5d} runs {size:7d} points: scatter {cell['scatter']:.4f}, "
                f"claimed {cell['claimed']:.4f} ({ratio:.2f}), power {row['power']:.2f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
