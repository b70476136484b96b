"""What an eighth of a cloud saves on the way to the draws of exp(-d / epsilon), and whether these stay.

Two problems of the scoreboard with several outputs, whose clouds have 8192 points and more: CPU time of
`sample_smc(adjustment=None)`, on all points and with an eighth of them until the last stage, in turn; medians and
lengths of 90% intervals of the draws, whose difference is that of seeds if nothing changes. Standard deviations
tell nothing of 304L: a few draws far out decide them, other ones by chain.

    OMP_NUM_THREADS=1 uv run python -m benchmarks.coarser      # ten minutes on one core
"""

from __future__ import annotations

import logging
import time
from typing import Any

import numpy as np

from benchmarks import record
from benchmarks.scoreboard import in_pymc
from benchmarks.scoreboard.problem import Response
from benchmarks.scoreboard.problems import PROBLEMS

CASES = {"frame": 20, "304L tension": 8}
SEEDS = (1, 2)


def calibrated(name: str, size: int) -> Any:
    """Return the optimum of a problem."""
    import pymc as pm

    import prbayes as prb

    problem = PROBLEMS[name]
    run = Response(problem)
    with pm.Model() as model:
        values = in_pymc.hyperparameters(problem)
        inputs = in_pymc.inputs(problem, values)

        def response(*x: Any) -> Any:
            return run(x[0][..., 0], x[0][..., 1]) if problem.correlation else run(*x)

        joint = prb.Joint(prb.KullbackLeibler(), components=problem.degrees)
        prb.Simulator("y", response, *inputs, metric=joint, observed=problem.data(size, 0))
    return prb.minimize(model, progressbar=False)


def sampled(optimum: Any, large: int, seed: int) -> tuple[float, Any]:
    """Return CPU seconds and the draws, where designs are large from so many points on."""
    import prbayes as prb
    from prbayes.model import evaluator

    before = evaluator._LARGE
    evaluator._LARGE = large
    clock = time.process_time()
    try:
        tree = prb.sample_smc(
            optimum=optimum,
            model=optimum.model,
            adjustment=None,
            random_seed=seed,
            progressbar=False,
        )
    finally:
        evaluator._LARGE = before
    seconds = time.process_time() - clock
    names = [rv.name for rv in optimum.model.free_RVs]
    return seconds, np.array([tree.posterior[name].values.ravel() for name in names])


def compared(optimum: Any) -> dict[str, Any]:
    """Return the ratio of times, and how far draws are from each other, in half lengths."""
    from prbayes.model.evaluator import _LARGE

    runs: dict[str, list[Any]] = {"whole": [], "eighth": []}
    for seed in SEEDS:
        runs["whole"].append(sampled(optimum, 1 << 40, seed))
        runs["eighth"].append(sampled(optimum, _LARGE, seed))
    seconds = {way: [spent for spent, _ in found] for way, found in runs.items()}
    middles, lengths = {}, {}
    for way, found in runs.items():
        low, middle, high = np.quantile([draws for _, draws in found], [0.05, 0.5, 0.95], axis=2)
        middles[way] = middle
        lengths[way] = high - low
    half = lengths["whole"].mean(axis=0) / 2
    off = (middles["eighth"].mean(axis=0) - middles["whole"].mean(axis=0)) / half
    seeds = np.ptp(middles["whole"], axis=0) / half
    return {
        "points": max(design.n_points for design in optimum.evaluator.reweighted.values()),
        "seconds": seconds,
        "times less": float(np.median(np.divide(seconds["whole"], seconds["eighth"]))),
        "medians off": float(np.abs(off).max()),
        "medians off, two seeds on all points": float(seeds.max()),
        "lengths": (lengths["eighth"].mean(axis=0) / 2 / half).tolist(),
        "lengths, two seeds on all points": np.divide(*lengths["whole"]).tolist(),
    }


def main() -> None:
    """Compare, print and write."""
    logging.getLogger("prbayes").setLevel(logging.ERROR)
    found = {}
    for name, size in CASES.items():
        row = compared(calibrated(name, size))
        found[name] = row
        lengths, seeds = (
            "/".join(f"{ratio:.2f}" for ratio in row[key])
            for key in ("lengths", "lengths, two seeds on all points")
        )
        print(
            f"{name}: {row['points']} points, {row['times less']:.1f} times less, "
            f"medians off {row['medians off']:.2f} (two seeds "
            f"{row['medians off, two seeds on all points']:.2f}), lengths {lengths} ({seeds})",
            flush=True,
        )
    record.save(record.RESULTS / "coarser.json", found)


if __name__ == "__main__":
    main()
