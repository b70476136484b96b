"""Time and peak memory against the number of simulated responses and of particles; what the engine of an executor sees.

Each measurement is a process of its own. ``n`` is the size of one population, evaluated at eight
thetas; the design of `Reweighted` is set up once, with a mixture density of 512 components.
``particles`` are evaluated in one call, as the sampler does, and sampled. Peak memory is that of the
whole process, of which importing takes the part that is stated. ``specimens`` has the posterior of so
many by `prb.sample`, with the log-likelihood by specimen. Times are CPU seconds. ``tasks``
sends responses that cost nothing, each a task of its own, to a Dask cluster of two processes on the
loopback interface: what a task costs the client, the scheduler and a worker together.

    OMP_NUM_THREADS=1 uv run python -m benchmarks.scale
"""

from __future__ import annotations

import resource
import time
from concurrent.futures import ProcessPoolExecutor
from itertools import product
from multiprocessing import get_context
from typing import Any

import numpy as np

from benchmarks.study import Study

N = 50
THETAS = 8
METRICS = {"PR": "ProbabilityResidual", "area metric": "AreaMetric"}
SIZES = {
    "n resimulated": (1_000_000, 10_000_000),
    "n reweighted": (1_000_000,),
    "particles resimulated": (10_000, 100_000),
    "particles reweighted": (10_000, 100_000),
}


def linear(x: Any) -> Any:
    """Return 2 x, as NumPy computes it."""
    return np.multiply(2.0, np.asarray(x))


def peak() -> float:
    """Return the largest resident size of this process so far, MiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def measure(kind: str, metric: str, size: int) -> dict[str, float]:
    """Measure in this process."""
    import pymc as pm

    import prbayes as prb
    from prbayes.model.evaluator import Evaluator
    from prbayes.model.parameters import unconstrained

    before = peak()
    clock = time.process_time()
    what, propagation = kind.split()
    how: Any
    if propagation == "resimulated":
        how = prb.Resimulated(size if what == "n" else 100)
    else:
        how = prb.Reweighted(size if what == "n" else 256)
    observed = np.random.default_rng(1).normal(20, 2, N)
    of_distributions = getattr(prb, METRICS[metric])()
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 10, 3), pm.HalfNormal("sigma", 3))
        prb.Simulator("y", linear, x, metric=of_distributions, observed=observed, propagation=how)
    evaluator = Evaluator.of(model)
    center = unconstrained(evaluator.hyperparameters, {"mu": 10.0, "sigma": 1.0})
    count = THETAS if what == "n" else size
    thetas = center + 0.05 * np.random.default_rng(2).normal(size=(count, 2))
    evaluator(thetas[:1])
    row = {"import MiB": before, "set-up s": time.process_time() - clock}
    spent = []
    for _ in range(3):
        clock = time.process_time()
        evaluator(thetas)
        spent.append(time.process_time() - clock)
    row["s"] = min(spent)
    if what == "particles":
        clock = time.process_time()
        prb.set_epsilon(model, {"y": 0.1})
        prb.sample_smc(
            size, chains=1, model=model, random_seed=1, progressbar=False, adjustment=None
        )
        row["sampling s"] = time.process_time() - clock
    return row | {"MiB": peak(), "responses": evaluator.n_responses}


def measure_specimens(size: int) -> dict[str, float]:
    """Measure the posterior by the log-likelihood by specimen in this process."""
    import pymc as pm

    import prbayes as prb

    before = peak()
    data = np.random.default_rng(1).normal(1.0, 0.5, size)
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1))
        prb.Simulator("y", lambda x: 2 * x, x, observed=2 * data)
    clock = time.process_time()
    mean = float(prb.sample(model=model, random_seed=1, progressbar=False).posterior["mu"].mean())
    row = {"import MiB": before, "s": time.process_time() - clock, "MiB": peak()}
    return row | {"standard errors off": (mean - data.mean()) / data.std() * np.sqrt(size)}


class _Unsized:
    """An executor without a size, which gets as many tasks at a time as a large cluster would."""

    def __init__(self, executor: Any) -> None:
        self.submit = executor.submit


def measure_tasks(size: int) -> dict[str, float]:
    """Measure what travels and what a task costs."""
    import cloudpickle
    import distributed

    from prbayes.response import call

    numbers = np.random.default_rng(1).normal(size=(size, 5))
    function = call.scalar(lambda *x: sum(x))
    cluster = distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, host="127.0.0.1",
        dashboard_address="127.0.0.1:0",
    )  # fmt: skip
    with cluster, distributed.Client(cluster) as client:
        executor = _Unsized(client.get_executor(pure=False))
        how = call.CallSettings("y", function, executor)  # type: ignore[arg-type]
        points = call.Points(list(numbers.T), [True] * 5)
        call.respond(how, points.at(np.arange(10)), call.Tally())  # the workers are up
        call.chunk_size = lambda *_: 1
        before, clock = peak(), time.perf_counter()
        call.respond(how, points, call.Tally())
        spent = time.perf_counter() - clock
    task = cloudpickle.dumps((call.compute, call.packed(function), points.at(np.arange(1)), False))
    return {
        "seconds a task": spent / size,
        "bytes a task": len(task),
        "MiB more": peak() - before,
    }


def row(cell: str, number: int) -> dict[str, float]:
    """Measure in a new process."""
    kind, *case = cell.split("/")
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        if kind == "tasks":
            return pool.submit(measure_tasks, int(case[0])).result()
        if kind == "specimens":
            return pool.submit(measure_specimens, int(case[0])).result()
        return pool.submit(measure, kind, case[0], int(case[1])).result()


CELLS = [f"{kind}/{metric}/{n}" for kind, metric in product(SIZES, METRICS) for n in SIZES[kind]]
SPECIMENS = ["specimens/10000", "specimens/100000"]
STUDY = Study("scale", __doc__, [*CELLS, *SPECIMENS, "tasks/10000"], row, 1)

if __name__ == "__main__":
    STUDY.main()
