"""Time and peak memory against the number of simulated responses, and against the number of particles.

Each measurement is a process of its own. ``n`` is the size of one population, evaluated at eight thetas; the design
of `Reweighted` is computed once, and one theta of it weighs all its points. ``particles`` are evaluated in one call, as
the sampler does, and sampled. Peak memory is that of the whole process; importing PyMC and the package
takes the part that is stated first. *Growth* is the time against that of the row above, for ten times the size.

    uv run python -m benchmarks.scale [--out scale.json]
"""

from __future__ import annotations

import argparse
import json
import logging
import os
import resource
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

N = 50
SIZES = (1_000, 10_000, 100_000, 1_000_000, 10_000_000)
PARTICLES = (100, 1_000, 10_000, 100_000)
METRICS = ("ProbabilityResidual", "AreaMetric")
THETAS = 8


def linear(x: Any) -> Any:
    """Return 2 x, as NumPy computes it."""
    return np.multiply(2.0, np.asarray(x))


def peak() -> float:
    """Return the largest resident size of this process so far, MiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def model_of(metric: str, propagation: Any) -> Any:
    """Return a model of one normal input."""
    import pymc as pm

    import prbayes as prb

    observed = np.random.default_rng(1).normal(20, 2, N)
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 10, 3), pm.HalfNormal("sigma", 3))
        prb.Simulator("y", linear, x, metric=getattr(prb, metric)(), observed=observed, propagation=propagation)
    return model


def one(kind: str, metric: str, size: int) -> dict[str, float]:
    """Measure in this process."""
    import pymc

    import prbayes as prb
    from prbayes.population import Evaluator

    del pymc
    logging.getLogger("prbayes").setLevel(logging.ERROR)
    before = peak()
    clock = time.perf_counter()
    what, propagation = kind.split()
    if what == "n":
        how = prb.Resimulated(size) if propagation == "resimulated" else prb.Reweighted(size)
    else:
        how = prb.Resimulated(100) if propagation == "resimulated" else prb.Reweighted(256)
    model = model_of(metric, how)
    evaluator = Evaluator(model)
    thetas = evaluator.unconstrained({"mu": 10.0, "sigma": 1.0}) + 0.05 * np.random.default_rng(2).normal(
        size=(THETAS if what == "n" else size, 2)
    )
    evaluator(thetas[:1])
    built = time.perf_counter() - clock
    clock = time.perf_counter()
    evaluator(thetas)
    spent = time.perf_counter() - clock
    out = {"import MiB": before, "set-up s": built, "s": spent, "MiB": peak(), "responses": evaluator.n_responses}
    if what == "particles":
        clock = time.perf_counter()
        prb.set_epsilon(model, {"y": 0.1})
        prb.sample_smc(size, chains=1, model=model, random_seed=1, progressbar=False, adjust=False)
        out |= {"sampling s": time.perf_counter() - clock, "MiB": peak(), "responses": evaluator.n_responses}
    return out


def child(kind: str, metric: str, size: int) -> dict[str, float]:
    """Measure in a process of its own."""
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.scale", "--child", kind, metric, str(size)],
        env=os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise RuntimeError(done.stderr[-2000:])
    found: dict[str, float] = json.loads(done.stdout.strip().splitlines()[-1])
    return found


def main() -> None:
    """Run everything, print a table and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("scale.json"))
    parser.add_argument("--only", nargs=3, metavar=("KIND", "METRIC", "SIZE"))
    parser.add_argument("--child", nargs=3, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.child:
        kind, metric, size = arguments.child
        print(json.dumps(one(kind, metric, int(size))))
        return
    table = []
    print(f"{'':48} set-up s      s  growth  sampling s    MiB   responses")
    for kind in ("n resimulated", "n reweighted", "particles resimulated", "particles reweighted"):
        for metric in METRICS:
            last = np.nan
            for size in SIZES if kind.startswith("n ") else PARTICLES:
                found: dict[str, Any] = {"kind": kind, "metric": metric, "size": size, **child(kind, metric, size)}
                found["growth"] = found["s"] / last
                last = found["s"]
                table.append(found)
                print(
                    f"{kind:22} {metric:20} {size:>10d} {found['set-up s']:6.2f} {found['s']:8.3f} "
                    f"{found['growth']:6.1f} {found.get('sampling s', np.nan):9.1f} {found['MiB']:8.0f} "
                    f"{found['responses']:12d}",
                    flush=True,
                )
    print(f"importing takes {np.median([row['import MiB'] for row in table]):.0f} MiB")
    arguments.out.write_text(json.dumps(table, indent=1) + "\n")


if __name__ == "__main__":
    main()
