"""Time and peak memory against the number of simulated responses and of particles; what the engine of an executor sees.

Each measurement is a process of its own. ``n`` is the size of one population, evaluated at eight
thetas; the design of `Reweighted` is set up once, with a mixture density of 512 components (nobody
needs one of ten million points). ``particles`` are evaluated in one call, as the sampler does, and
sampled. Peak memory is that of the whole process, of which importing takes the part that is stated.
Times are CPU seconds; *growth* is that against the row above, for ten times the size. ``tasks``
sends responses that cost nothing, each a task of its own, to a Dask cluster of two processes on the
loopback interface: what a task costs the client, the scheduler and a worker together.

    uv run python -m benchmarks.scale
"""

from __future__ import annotations

import argparse
import json
import logging
import resource
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import record
from benchmarks.processes import child

N = 50
SIZES = (1_000, 10_000, 100_000, 1_000_000, 10_000_000)
PARTICLES = (100, 1_000, 10_000, 100_000)
KINDS = ("n resimulated", "n reweighted", "particles resimulated", "particles reweighted")
METRICS = ("ProbabilityResidual", "AreaMetric")
TASKS = (1_000, 10_000)
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
        prb.Simulator(
            "y",
            linear,
            x,
            metric=getattr(prb, metric)(),
            observed=observed,
            propagation=propagation,
        )
    return model


def one(kind: str, metric: str, size: int) -> dict[str, float]:
    """Measure in this process."""
    import pymc

    import prbayes as prb
    from prbayes.model.evaluator import Evaluator

    del pymc
    logging.getLogger("prbayes").setLevel(logging.ERROR)
    before = peak()
    clock = time.process_time()
    what, propagation = kind.split()
    if what == "n":
        how = prb.Resimulated(size) if propagation == "resimulated" else prb.Reweighted(size)
    else:
        how = prb.Resimulated(100) if propagation == "resimulated" else prb.Reweighted(256)
    model = model_of(metric, how)
    evaluator = Evaluator.of(model)
    thetas = evaluator.hyperparameters.unconstrained(
        {"mu": 10.0, "sigma": 1.0}
    ) + 0.05 * np.random.default_rng(2).normal(size=(THETAS if what == "n" else size, 2))
    evaluator(thetas[:1])
    built = time.process_time() - clock
    spent = np.inf
    for _ in range(3):
        clock = time.process_time()
        evaluator(thetas)
        spent = min(spent, time.process_time() - clock)
    out = {
        "import MiB": before,
        "set-up s": built,
        "s": spent,
        "MiB": peak(),
        "responses": evaluator.n_responses,
    }
    if what == "particles":
        clock = time.process_time()
        prb.set_epsilon(model, {"y": 0.1})
        prb.sample_smc(
            size, chains=1, model=model, random_seed=1, progressbar=False, adjustment=None
        )
        out |= {
            "sampling s": time.process_time() - clock,
            "MiB": peak(),
            "responses": evaluator.n_responses,
        }
    return out


class _Untold:
    """An executor that does not tell its size, and gets as many tasks at a time as a large cluster would."""

    def __init__(self, executor: Any) -> None:
        self.submit = executor.submit


def tasks(size: int) -> dict[str, float]:
    """Measure what travels and what a task costs."""
    import cloudpickle
    import distributed

    from prbayes.response import call

    numbers = np.random.default_rng(1).normal(size=(size, 5))
    function = call.scalar(lambda *x: sum(x))
    cluster = distributed.LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        processes=True,
        host="127.0.0.1",
        dashboard_address="127.0.0.1:0",
    )
    with cluster, distributed.Client(cluster) as client:
        executor = _Untold(client.get_executor(pure=False))
        how = call.CallSettings("y", function, executor)  # type: ignore[arg-type]
        points = call.Points(list(numbers.T), [True] * 5)
        call.respond(how, points.at(np.arange(10)), call.Tally())  # the workers are up
        call.chunk_size = lambda *_: 1
        before, clock = peak(), time.perf_counter()
        call.respond(how, points, call.Tally())
        spent = time.perf_counter() - clock
    one, packed = points.at(np.arange(1)), call.packed(function)
    task = cloudpickle.dumps((call.compute, packed, one, False))
    return {
        "seconds a task": spent / size,
        "bytes a task": len(task),
        "MiB more": peak() - before,
        "tasks": size,
    }


def main() -> None:
    """Run everything, print a table and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=record.RESULTS / "scale.json")
    parser.add_argument(
        "--only", choices=(*KINDS, "tasks"), help="replace these rows of what is in --out"
    )
    parser.add_argument("--child", nargs=3, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.child:
        kind, metric, size = arguments.child
        print(json.dumps(tasks(int(size)) if kind == "tasks" else one(kind, metric, int(size))))
        return
    only = arguments.only
    kept = record.load(arguments.out, []) if only else []
    table: list[dict[str, Any]] = [row for row in kept if row["kind"] != only]
    print(f"{'':48} set-up s      s  growth  sampling s    MiB   responses")
    for kind in [k for k in KINDS if only in (None, k)]:
        for metric in METRICS:
            last = np.nan
            for size in (
                SIZES
                if kind == "n resimulated"
                else SIZES[:-1]
                if kind == "n reweighted"
                else PARTICLES
            ):
                found: dict[str, Any] = {
                    "kind": kind,
                    "metric": metric,
                    "size": size,
                    **child("benchmarks.scale", kind, metric, str(size)),
                }
                found["growth"] = found["s"] / last
                last = found["s"]
                table.append(found)
                print(
                    f"{kind:22} {metric:20} {size:>10d} {found['set-up s']:6.2f} {found['s']:8.3f} "
                    f"{found['growth']:6.1f} {found.get('sampling s', np.nan):9.1f} {found['MiB']:8.0f} "
                    f"{found['responses']:12d}",
                    flush=True,
                )
    print(
        f"importing takes {np.median([row['import MiB'] for row in table if 'import MiB' in row]):.0f} MiB"
    )
    for size in TASKS if only in (None, "tasks") else ():
        found = {"kind": "tasks", **child("benchmarks.scale", "tasks", "-", str(size))}
        table.append(found)
        print(
            f"{size} tasks: {1e3 * found['seconds a task']:.2f} ms and {found['bytes a task']} bytes each, "
            f"{found['MiB more']:.0f} MiB more on the client",
            flush=True,
        )
    record.save(arguments.out, table)


if __name__ == "__main__":
    main()
