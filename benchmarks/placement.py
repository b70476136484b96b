"""Are runs better placed where an emulator is wrong than where the populations are?

Responses of several inputs (`benchmarks.responses`). An emulator has 64 runs, of populations 1.4
times as wide as the one that matters, and gets 64 more:

- population: drawn from the population that matters, as `Reweighted` draws them;
- error: from its points with a density that is proportional to the emulator's error there, that of
  the nearest runs when they are left out;
- gaps: one after the other where the root of that error times the distance to the nearest run is
  largest.

Off is the root mean square error of the emulated population's distribution functions at 31
quantiles, over outputs and seeds, in units of the sampling noise of 50 data at the median.

Run: uv run python -m benchmarks.placement [--seeds 8]
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from scipy.stats import norm, qmc

from benchmarks import record
from benchmarks.responses import RESPONSES, Response
from prbayes.emulators.selection import Runs, candidate_surfaces, predict_outputs, select_surfaces

RUNS = 64
WIDER = 1.4  # the first runs, as those of a prior are
BLOCKS = np.arange(RUNS) * 8 // RUNS
NEAREST = 6  # runs that tell the error at a point
CANDIDATES = 4096
LEVELS = (np.arange(31) + 0.5) / 31
UNIT = 0.5 / np.sqrt(50)
WAYS = ("population", "error", "gaps")


def sobol(d: int, n: int, seed: int) -> Any:
    """Return normal quantiles of Sobol points, (n, d)."""
    uniforms = qmc.Sobol(d, rng=np.random.default_rng(seed)).random(n)
    return norm.ppf(np.clip(uniforms, 1e-9, 1 - 1e-9))


def fitted(response: Response, z: Any, blocks: Any) -> tuple[Runs, Any, Any]:
    """Return runs at standardised points, the emulator that is chosen, and what it says of them."""
    log_p = norm.logpdf(z).sum(axis=1)
    log_g = norm.logpdf(z / WIDER).sum(axis=1) - response.d * np.log(WIDER)
    if len(z) > RUNS:
        log_g = np.logaddexp(log_g, log_p)
    weights = np.exp(log_p - log_g)
    x = response.mean + response.sd * z
    runs = Runs(x, response(x), weights / weights.sum(), blocks)
    models, said = select_surfaces(candidate_surfaces(*x.shape), runs)
    return runs, models, said


def placed(way: str, first: Any, errors: Any, d: int, seed: int) -> Any:
    """Return standardised points of the second runs."""
    if way == "population":
        return sobol(d, RUNS, 500 + seed)
    points = sobol(d, CANDIDATES, 1000 + seed)
    distances, nearest = cKDTree(first).query(points, k=NEAREST)
    closeness = 1 / np.maximum(distances, 1e-9) ** 2
    here = np.sqrt((closeness * errors[nearest]).sum(axis=1) / closeness.sum(axis=1))
    if way == "error":
        rng = np.random.default_rng(seed)
        return points[rng.choice(CANDIDATES, RUNS, replace=False, p=here / here.sum())]
    gap, chosen_ones = distances[:, 0], []
    for _ in range(RUNS):
        best = int(np.argmax(np.sqrt(here) * gap))
        chosen_ones.append(best)
        gap = np.minimum(gap, np.linalg.norm(points - points[best], axis=1))
    return points[chosen_ones]


def off(response: Response, runs: Runs, models: Any) -> float:
    """Return the mean square error of distribution functions, in units of the sampling noise."""
    x = response.mean + response.sd * sobol(response.d, 8192, 99)
    truth, said = response(x), predict_outputs(models, runs, x)
    known = np.isfinite(truth).all(axis=1) & np.isfinite(said).all(axis=1)
    squares = []
    for one, other in zip(truth[known].T, said[known].T, strict=True):
        at = np.quantile(one, LEVELS)
        gaps = (one[:, None] <= at).mean(axis=0) - (other[:, None] <= at).mean(axis=0)
        squares.append(((gaps / UNIT) ** 2).mean())
    return float(np.mean(squares))


def problem(name: str, seeds: int) -> dict[str, float]:
    """Return the error before the second runs, and after them for each way of placing them."""
    response = RESPONSES[name]
    squares: dict[str, list[float]] = {"before": [], **{way: [] for way in WAYS}}
    for seed in range(seeds):
        first = WIDER * sobol(response.d, RUNS, seed)
        runs, models, said = fitted(response, first, BLOCKS)
        squares["before"].append(off(response, runs, models))
        spread = np.where(np.isfinite(runs.y), runs.y, np.nan)
        away = (said - runs.y) / np.nanstd(spread, axis=0)
        errors = (np.where(np.isfinite(away), away, 1.0) ** 2).sum(axis=1)
        for way in WAYS:
            z = np.concatenate([first, placed(way, first, errors, response.d, seed)])
            again = np.random.default_rng(seed).permutation(BLOCKS)
            runs, models, _ = fitted(response, z, np.concatenate([BLOCKS, again]))
            squares[way].append(off(response, runs, models))
    return {key: float(np.sqrt(np.mean(each))) for key, each in squares.items()}


def main() -> None:
    """Print a table and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--out", type=Path, default=record.RESULTS / "placement.json")
    arguments = parser.parse_args()
    table = {}
    print(f"{'response':14s}" + "".join(f"{key:>12s}" for key in ("before", *WAYS)))
    for name, response in RESPONSES.items():
        if response.d > 1:
            found = table[name] = problem(name, arguments.seeds)
            row = "".join(f"{found[key]:12.3f}" for key in ("before", *WAYS))
            print(f"{name:14s}{row}", flush=True)
    record.save(arguments.out, table)


if __name__ == "__main__":
    main()
