"""CPU seconds of posteriors beside those of other programs, at equal accuracy, with memory and import.

Each job has a process of its own, which runs it on several data sets: *cold* is the first, with the
caches on disk filled, *warm* the median of the others. Imports are apart. *First use* has empty
caches. A ratio is of two jobs of the same command; bias and width are those of the worst
hyperparameter, in standard deviations of the exact posterior, as a median over the data sets.

    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 uv run python -m benchmarks.speed
"""

from __future__ import annotations

import logging
import os
import re
import resource
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.study import Study

README = Path(__file__).parents[1] / "README.md"
SIZES = {"linear": 50, "frame": 20}
FIRST_USE = "first use"  # last: its caches are of its own


@dataclass(frozen=True)
class Job:
    """What one process measures.

    Attributes
    ----------
    kind : str
        Name in `KINDS`.
    argument : str
        The problem, the metric or the model.
    repeats : int
        Data sets; the first is cold.
    """

    kind: str
    argument: str
    repeats: int


JOBS = {
    "likelihood linear": Job("likelihood", "linear", 6),
    "likelihood frame": Job("likelihood", "frame", 6),
    "hierarchical linear": Job("hierarchical", "linear", 2),
    "hierarchical frame": Job("hierarchical", "frame", 2),
    "stock linear": Job("stock", "linear", 2),
    "stock frame": Job("stock", "frame", 1),
    "pm.sample frame": Job("nuts", "frame", 3),
    "PR linear": Job("metric", "ProbabilityResidual linear", 4),
    "KLD linear": Job("metric", "KullbackLeibler linear", 4),
    "area linear": Job("metric", "AreaMetric linear", 3),
    "PR frame": Job("metric", "ProbabilityResidual frame", 3),
    "KLD frame": Job("metric", "KullbackLeibler frame", 3),
    "area frame": Job("metric", "AreaMetric frame", 3),
    "PR, 1 output of 1 input": Job("outputs", "1 of 1", 3),
    "PR, 1 output of 2 inputs": Job("outputs", "1 of 2", 3),
    "PR, 2 outputs of 2 inputs": Job("outputs", "2 of 2", 3),
    "memory linear": Job("memory", "linear", 1),
    "memory frame": Job("memory", "frame", 1),
    "import": Job("imports", "", 1),
    "README": Job("readme", "", 1),
    FIRST_USE: Job("likelihood", "linear", 6),
}


@dataclass(frozen=True)
class Comparison:
    """A row of the table: a job's figure, alone or over that of another job, and its aim."""

    text: str
    job: str
    figure: str
    against: str
    aim: float


COMPARISONS = (
    *(
        Comparison(f"{name} {SIZES[name]}, `prb.sample`, {when}", f"likelihood {name}", when,
                   f"{other} {name}", aim)
        for name in SIZES
        for when, other, aim in (
            ("warm", "hierarchical", 0.1), ("cold", "hierarchical", 0.3), ("warm", "stock", 0.02)
        )
    ),
    Comparison("frame 20, `pm.sample`, warm", "pm.sample frame", "warm", "hierarchical frame", 0.3),
    *(
        Comparison(f"linear 50, {metric}: optimum and posterior, warm", f"{metric} linear", "warm",
                   "stock linear", 0.07)
        for metric in ("PR", "KLD", "area")
    ),
    *(
        Comparison(f"frame 20, {metric}: optimum and posterior, warm, CPU s", f"{metric} frame",
                   "warm", "", aim)
        for metric, aim in (("PR", 2.5), ("KLD", 4.0), ("area", 8.0))
    ),
    Comparison("PR, one output of two inputs, warm", "PR, 1 output of 2 inputs", "warm",
               "PR, 1 output of 1 input", 2.0),
    Comparison("PR, two outputs of two inputs, warm", "PR, 2 outputs of 2 inputs", "warm",
               "PR, 1 output of 2 inputs", 1.5),
    Comparison("linear 50, memory above import and Numba, MiB", "memory linear", "added", "", 100.0),
    Comparison("frame 20, memory above import and Numba, MiB", "memory frame", "added", "", 100.0),
    Comparison("import of what the README needs, above PyMC's, CPU s", "import", "added", "", 0.6),
    Comparison("README, first block in a new process, CPU s", "README", "cold", "", 3.5),
)  # fmt: skip


# -- jobs, each within a process of its own --------------------------------------------------------


def task_of(problem: str, replicate: int) -> Any:
    """Return a problem of the scoreboard with one of its data sets."""
    from benchmarks.scoreboard.problem import Response
    from benchmarks.scoreboard.problems import PROBLEMS
    from benchmarks.scoreboard.study import Task

    which = PROBLEMS[problem]
    return Task(which, which.data(SIZES[problem], replicate), Response(which), replicate)


def by_likelihood(problem: str) -> Callable[[int], Any]:
    """Return `prb.sample` on the log-likelihood by specimen."""
    from benchmarks.scoreboard.rivals.prbayes import calibrate_likelihood

    return lambda replicate: calibrate_likelihood(task_of(problem, replicate), {"draws": 1000})


def by_nuts(problem: str) -> Callable[[int], Any]:
    """Return NUTS of PyMC on the log-likelihood by specimen."""
    import pymc as pm

    from benchmarks.scoreboard import in_pymc
    from benchmarks.scoreboard.rivals.prbayes import likelihood_model

    def job(replicate: int) -> Any:
        task = task_of(problem, replicate)
        with likelihood_model(task):
            tree = pm.sample(
                1000, tune=1000, chains=4, cores=1, nuts_sampler="pymc", random_seed=replicate,
                progressbar=False, compute_convergence_checks=False,
            )  # fmt: skip
        return in_pymc.draws(tree.posterior, task.problem)

    return job


def by_hierarchy(problem: str) -> Callable[[int], Any]:
    """Return NUTS of PyMC on latent inputs by specimen."""
    from benchmarks.scoreboard.rivals import hierarchical_pymc as rival

    return lambda replicate: rival.calibrate(task_of(problem, replicate), rival.SETTINGS)


def by_stock(problem: str) -> Callable[[int], Any]:
    """Return `pm.sample_smc` on `pm.Simulator`."""
    from benchmarks.scoreboard.rivals import stock_pymc as rival

    return lambda replicate: rival.calibrate(task_of(problem, replicate), rival.SETTINGS)


def by_metric(argument: str) -> Callable[[int], Any]:
    """Return optimum and posterior by a metric on a problem: "AreaMetric linear"."""
    import pymc as pm

    import prbayes as prb
    from benchmarks.scoreboard import in_pymc

    metric, problem = argument.split()

    def job(replicate: int) -> Any:
        task = task_of(problem, replicate)
        with pm.Model() as model:
            inputs = in_pymc.inputs(task.problem, in_pymc.hyperparameters(task.problem))
            of_distributions = getattr(prb, metric)()
            if problem == "frame":  # three outputs
                of_distributions = prb.Joint(of_distributions)
            prb.Simulator(
                "y", task.response, *inputs, metric=of_distributions, observed=task.observed
            )
        optimum = prb.minimize(model, progressbar=False)
        tree = prb.sample(model=model, optimum=optimum, random_seed=replicate, progressbar=False)
        return in_pymc.draws(tree.posterior, task.problem)

    return job


def _two(a: Any, b: Any) -> Any:
    """Return two outputs of two inputs."""
    return np.stack([a + b**2, a - 2 * b], axis=-1)


def by_outputs(sizes: str) -> Callable[[int], Any]:
    """Return optimum and posterior by PR, of so many outputs of so many inputs: "2 of 2".

    Mean and standard deviation of each input are unknown.
    """
    import pymc as pm

    import prbayes as prb

    outputs, count = map(int, sizes.split(" of "))
    responses: dict[str, Callable[..., Any]] = {
        "1 of 1": lambda a: a + 4,
        "1 of 2": lambda a, b: a + b**2,
        "2 of 2": _two,
    }
    response = responses[sizes]
    metric = prb.ProbabilityResidual()
    joint = prb.Joint(metric) if outputs > 1 else metric

    def job(replicate: int) -> None:
        rng = np.random.default_rng([17, replicate])
        specimens = rng.normal([1.0, 2.0], [0.3, 0.2], (50, 2)).T[:count]
        with pm.Model() as model:
            a = pm.Normal.dist(pm.Normal("mu", 1, 0.3), pm.HalfNormal("sigma", 0.5))
            b = (
                pm.Normal.dist(pm.Normal("nu", 2, 0.3), pm.HalfNormal("tau", 0.5))
                if count > 1
                else 0
            )
            inputs = [a, b][:count]
            prb.Simulator("y", response, *inputs, metric=joint, observed=response(*specimens))
        optimum = prb.minimize(model, progressbar=False)
        prb.sample(model=model, optimum=optimum, random_seed=replicate, progressbar=False)

    return job


def accuracy(draws: Any, problem: str, replicate: int) -> tuple[float, float]:
    """Return the bias and the width ratio of the worst hyperparameters."""
    from benchmarks.scoreboard.problems import PROBLEMS

    reference = PROBLEMS[problem].reference(SIZES[problem], replicate)
    units = reference.sd
    bias = [abs(np.mean(draws[name]) - reference.center[name]) / units[name] for name in units]
    widths = [np.std(draws[name]) / units[name] for name in units]
    return float(max(bias)), float(max(widths, key=lambda width: abs(np.log(width))))


def timed(job: Callable[[int], Any], problem: str | None, repeats: int) -> dict[str, Any]:
    """Return CPU seconds of a job on several data sets, the first of which is cold."""
    seconds, errors = [], []
    for replicate in range(repeats):
        begun = time.process_time()
        draws = job(replicate)
        seconds.append(time.process_time() - begun)
        if problem is not None:
            errors.append(accuracy(draws, problem, replicate))
    result = {"cold": seconds[0], "warm": float(np.median(seconds[1:] or seconds))}
    if errors:
        result |= dict(zip(("bias", "width"), np.median(errors, axis=0).tolist(), strict=True))
    return result


def peak() -> float:
    """Return the largest resident size of this process so far, MiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def memory(problem: str) -> dict[str, Any]:
    """Return what `prb.sample` adds to the peak memory after import, beside Numba's own."""
    import prbayes as prb
    from prbayes.metrics.grid import count

    job = by_likelihood(problem)
    _ = prb.sample, prb.Simulator
    imported = peak()
    # One cached loop: what Numba itself takes.
    ones = np.ones((1, 1))
    count(ones, ones, 0.0, 1.0, 1, np.zeros((1, 8)), np.zeros((1, 2)))
    with_numba = peak()
    job(0)
    return {"imported": imported, "with Numba": with_numba, "added": peak() - with_numba}


def imports() -> dict[str, Any]:
    """Return CPU seconds of importing PyMC, then what the README needs of prbayes."""
    begun = time.process_time()
    import pymc  # noqa: F401

    between = time.process_time()
    import prbayes as prb

    _ = prb.Simulator, prb.minimize, prb.sample_smc, prb.sample, prb.compare
    return {"PyMC": between - begun, "added": time.process_time() - between}


def readme() -> dict[str, Any]:
    """Return CPU seconds of the first example of the README, imports included."""
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)
    begun = time.process_time()
    exec(compile(blocks[0], str(README), "exec"), {"__name__": "readme"})
    return {"cold": time.process_time() - begun}


TIMED = {
    "likelihood": by_likelihood,
    "nuts": by_nuts,
    "hierarchical": by_hierarchy,
    "stock": by_stock,
    "metric": by_metric,
    "outputs": by_outputs,
}


def measured(job: Job) -> dict[str, Any]:
    """Return the figures of a job, in this process."""
    logging.disable(logging.WARNING)
    if job.kind in TIMED:
        problem = None if job.kind == "outputs" else job.argument.split()[-1]
        return timed(TIMED[job.kind](job.argument), problem, job.repeats)
    if job.kind == "memory":
        return memory(job.argument)
    return imports() if job.kind == "imports" else readme()


# -- processes -------------------------------------------------------------------------------------


def row(name: str, number: int) -> dict[str, Any]:
    """Return the figures of a job in a new process."""
    with tempfile.TemporaryDirectory() as folder:
        if name == FIRST_USE:
            os.environ |= {
                "NUMBA_CACHE_DIR": folder, "PYTENSOR_FLAGS": f"base_compiledir={folder}"
            }  # fmt: skip
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
            return pool.submit(measured, JOBS[name]).result()


def rows(jobs: dict[str, Any]) -> Iterator[tuple[Comparison, float, float]]:
    """Yield the rows of the table: a figure, and its ratio to that of another job."""
    for c in COMPARISONS:
        value = jobs.get(c.job, {}).get(c.figure)
        other = jobs.get(c.against, {}).get(c.figure) if c.against else 1.0
        if value is not None and other is not None:
            yield c, value, value / other


STUDY = Study("speed", __doc__, JOBS, row, 1, failures=(Exception,))

if __name__ == "__main__":
    STUDY.main()
