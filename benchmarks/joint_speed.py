"""What several outputs cost: CPU time beside one output, and peak memory of `prb.Joint`.

*time*: `minimize` and `sample_smc` on a design that is there, for one output and for two of the same
specimens under `Joint`, with the same inputs, hyperparameters, observations and points; pairs in one
process, and the median of their ratios. *memory*: a process of its own for each number of outputs
and of points; what the objective with its gradient and a batch of eight thetas add to a model whose
responses are stored. The basis, a number for each point and each cell of each direction, would take
what is told beside it. What the file of results has is not measured again.

    uv run python -m benchmarks.joint_speed
"""

from __future__ import annotations

import argparse
import json
import logging
import resource
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import record
from benchmarks.processes import child

METRICS = {"PR": "ProbabilityResidual", "KLD": "KullbackLeibler", "area": "AreaMetric"}
N = 50
POINTS = {"PR": (1024, 4096), "KLD": (1024,), "area": (1024,)}
UNKNOWN = (2, 4)  # hyperparameters
OUTPUTS = (2, 4, 8)
SIZES = (1 << 14, 1 << 15, 1 << 16, 1 << 17)


def mixed(a: Any, b: Any) -> Any:
    """Return one output of two inputs, that tells the means and spreads of both."""
    return a + b**2


def two(a: Any, b: Any) -> Any:
    """Return two outputs of two inputs."""
    return np.stack([mixed(a, b), a - 2 * b], axis=-1)


def model_of(outputs: int, metric: str, points: int, unknown: int) -> Any:
    """Return a model of two inputs, of which one or both have unknown mean and spread."""
    import pymc as pm

    import prbayes as prb

    rng = np.random.default_rng(0)
    specimens = rng.normal([1.0, 2.0], [0.3, 0.2], (N, 2)).T
    response = mixed if outputs == 1 else two
    lifted = getattr(prb, METRICS[metric])()
    with pm.Model() as model:
        a = pm.Normal.dist(pm.Normal("mu", 1, 0.3), pm.HalfNormal("sigma", 0.5))
        b = pm.Normal.dist(2.0, 0.2)
        if unknown == 4:
            b = pm.Normal.dist(pm.Normal("mu2", 2, 0.3), pm.HalfNormal("sigma2", 0.5))
        prb.Simulator(
            "y",
            response,
            a,
            b,
            metric=lifted if outputs == 1 else prb.Joint(lifted),
            observed=response(*specimens),
            propagation=prb.Reweighted(points, max_points=points, emulator=None),
        )
    return model


def seconds(model: Any) -> tuple[float, float]:
    """Return CPU seconds of `minimize` and of `sample_smc`, on a design as it is."""
    import prbayes as prb

    begun = time.process_time()
    optimum = prb.minimize(model, refine=False, progressbar=False)
    between = time.process_time()
    prb.sample_smc(
        model=model,
        optimum=optimum,
        refine=False,
        random_seed=1,
        progressbar=False,
    )
    return between - begun, time.process_time() - between


def ratios(metric: str, points: int, unknown: int, repeats: int) -> dict[str, Any]:
    """Return seconds of one and of two outputs, by pairs after one that compiles."""
    rows = []
    for _ in range(repeats + 1):
        rows.append([seconds(model_of(outputs, metric, points, unknown)) for outputs in (1, 2)])
    pairs = np.array(rows[1:])  # (repeats, outputs, steps)
    total = pairs.sum(axis=-1)
    return {
        "one": np.median(pairs[:, 0], axis=0).round(3).tolist(),
        "two": np.median(pairs[:, 1], axis=0).round(3).tolist(),
        "ratio": float(np.median(total[:, 1] / total[:, 0])),
        "largest ratio": float((total[:, 1] / total[:, 0]).max()),
    }


def peak() -> float:
    """Return the largest resident size of this process so far, MiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def normal(x: Any) -> Any:
    """Return the inputs, which are the outputs."""
    return x * 1.0


def memory(metric: str, outputs: int, points: int) -> dict[str, Any]:
    """Return what an objective adds to a model with so many stored responses, and its time."""
    import pymc as pm

    import prbayes as prb
    from prbayes.model.evaluator import Evaluator

    logging.getLogger("prbayes").setLevel(logging.ERROR)
    data = np.random.default_rng(0).standard_normal((N, outputs))
    lifted = getattr(prb, METRICS[metric])()
    before_points = peak()
    with pm.Model() as model:
        mu = pm.Normal("mu", 0, 0.5, shape=outputs)
        x = pm.Normal.dist(mu, 1.0, shape=outputs)
        # The mixture density of a large design is summed over its components, whose number is no
        # concern here: a first batch is small.
        prb.Simulator(
            "y", normal, x, metric=prb.Joint(lifted), observed=data,
            propagation=prb.Reweighted(16, max_points=points, emulator=None),
        )  # fmt: skip
    evaluator = Evaluator.of(model)
    (bound,) = evaluator.reweighted.values()
    bound.add([np.zeros((1, outputs))], points - 16)
    with_points = peak()
    thetas = np.random.default_rng(1).normal(0, 0.1, (8, outputs))
    objective = evaluator.objective(prior=False, gradient=True)
    objective(thetas[0], np.ones(1))
    begun = time.process_time()
    objective(thetas[0], np.ones(1))
    between = time.process_time()
    evaluator(thetas)
    done = time.process_time()
    target = evaluator.nodes[0].target
    return {
        "directions": len(target.parts),
        "before": round(before_points),
        "with points": round(with_points),
        "peak": round(peak()),
        "basis": round(
            target.basis(np.zeros((1, outputs)), np.inf).arrays[0].size * points / 2**17
        ),
        "objective": round(between - begun, 3),
        "batch": round(done - between, 3),
    }


def main() -> None:
    """Measure, print tables, write JSON."""
    if "--child" in sys.argv:
        name, m, n = sys.argv[2:]
        print(json.dumps(memory(name, int(m), int(n))))
        return
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--out", type=Path, default=record.RESULTS / "joint_speed.json")
    arguments = parser.parse_args()
    logging.getLogger("prbayes").setLevel(logging.ERROR)
    out: dict[str, Any] = record.load(arguments.out, {"time": {}, "memory": {}})
    for metric in ("PR", "area"):  # KLD has the densities of PR
        for outputs in OUTPUTS:
            for points in SIZES:
                if f"{metric}/{outputs}/{points}" in out["memory"]:
                    continue
                found = child("benchmarks.joint_speed", metric, str(outputs), str(points))
                out["memory"][f"{metric}/{outputs}/{points}"] = found
                print(f"{metric:5s} m = {outputs} {points:7d} points  {found}", flush=True)
                record.save(arguments.out, out)
    for metric, sizes in POINTS.items():
        for size in sizes:
            for unknown in UNKNOWN:
                if f"{metric}/{size}/{unknown}" in out["time"]:
                    continue
                pairs = ratios(metric, size, unknown, arguments.repeats)
                out["time"][f"{metric}/{size}/{unknown}"] = pairs
                print(f"{metric:5s} {size:5d} points, {unknown} unknown  {pairs}", flush=True)
                record.save(arguments.out, out)


if __name__ == "__main__":
    main()
