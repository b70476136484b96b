"""What an eighth of a cloud saves on the way to the draws of exp(-d / epsilon), and whether these stay.

Two problems of the scoreboard with several outputs, whose clouds have 8192 points and more: CPU time of
`sample_smc` without adjustment, on all points and with an eighth of them until the last stage, in turn; means and
standard deviations of the draws, whose difference is that of seeds if nothing changes.

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
METRICS = {"KLD": "KullbackLeibler", "PR": "ProbabilityResidual"}
SEEDS = (1, 2)


def calibrated(name: str, size: int, metric: str) -> Any:
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

        joint = prb.Joint(getattr(prb, metric)(), components=problem.degrees)
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
            adjust=False,
            random_seed=seed,
            progressbar=False,
        )
    finally:
        evaluator._LARGE = before
    seconds = time.process_time() - clock
    names = [rv.name for rv in optimum.model.free_RVs]
    return seconds, np.array([tree.posterior[name].values.ravel() for name in names])


def compared(optimum: Any) -> dict[str, Any]:
    """Return the ratio of times, and how far draws are from each other, in standard deviations."""
    from prbayes.model.evaluator import _LARGE

    runs: dict[str, list[Any]] = {"whole": [], "eighth": []}
    for seed in SEEDS:
        runs["whole"].append(sampled(optimum, 1 << 40, seed))
        runs["eighth"].append(sampled(optimum, _LARGE, seed))
    seconds = {way: [spent for spent, _ in found] for way, found in runs.items()}
    means, sds = {}, {}
    for way, found in runs.items():
        means[way] = np.array([draws.mean(axis=1) for _, draws in found])
        sds[way] = np.array([draws.std(axis=1) for _, draws in found])
    sd = sds["whole"].mean(axis=0)
    off = (means["eighth"].mean(axis=0) - means["whole"].mean(axis=0)) / sd
    seeds = np.ptp(means["whole"], axis=0) / sd
    return {
        "points": max(design.n_points for design in optimum.evaluator.designs.values()),
        "seconds": seconds,
        "times less": float(np.median(np.divide(seconds["whole"], seconds["eighth"]))),
        "means off": float(np.abs(off).max()),
        "means off, two seeds on all points": float(seeds.max()),
        "width": (sds["eighth"].mean(axis=0) / sd).tolist(),
    }


def main() -> None:
    """Compare, print and write."""
    logging.getLogger("prbayes").setLevel(logging.ERROR)
    found = {}
    for name, size in CASES.items():
        for label, metric in METRICS.items():
            row = compared(calibrated(name, size, metric))
            found[f"{name}, {label}"] = row
            widths = "/".join(f"{width:.2f}" for width in row["width"])
            print(
                f"{name}, {label}: {row['points']} points, {row['times less']:.1f} times less, "
                f"means off {row['means off']:.2f} (two seeds "
                f"{row['means off, two seeds on all points']:.2f}), widths {widths}",
                flush=True,
            )
    record.save(record.RESULTS / "coarser.json", found)


if __name__ == "__main__":
    main()
