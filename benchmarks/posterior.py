"""Coverage of posteriors given the metric's estimate, with truths drawn from the prior.

A population is drawn from the prior, specimens from the population, and `prb.sample` is run on them.
89 % intervals of an exact posterior then contain the truth with probability .89, whatever the metric.
Priors are

- ``vague``: wide for the problem;
- ``bounded``: uniform, two standard errors wide;
- ``sharp``: a quarter and half of a standard error wide.

Standard errors are those of the population's own inputs at a reference point. No constant of the
package was chosen on the problems. Rows are stored as they come, so that an interrupted study
continues where it stopped:

    OMP_NUM_THREADS=1 uv run python -m benchmarks.posterior [--data-sets 40]
    uv run python -m benchmarks.posterior --only-table
"""

from __future__ import annotations

import argparse
import json
import logging
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
import pymc as pm

import prbayes as prb
from benchmarks import record

STORE = record.RESULTS / "posterior"
OUT = record.RESULTS / "posterior.json"
SIZES = (10, 20, 50, 200)
PRIORS = ("vague", "bounded", "sharp")
METRICS = {
    "PR": prb.ProbabilityResidual(),
    "KLD": prb.KullbackLeibler(),
    "area": prb.AreaMetric(),
}
LEVEL = 0.89
DRAWS = 250  # of each of four chains
BLOCK = 10  # data sets of a cell before the next one

Variables = list[Any]


@dataclass(frozen=True)
class Problem:
    """A response, its inputs and two hyperparameters with a vague prior.

    Attributes
    ----------
    vague : callable
        Within a model: the hyperparameters.
    reference : tuple of float
        Hyperparameters around which bounded and sharp priors are laid.
    positive : tuple of bool
        Whether each hyperparameter is positive; its logarithm then has the normal prior.
    inputs : callable
        Hyperparameters to ``.dist()`` objects.
    responses : tuple of callable
        Of as many simulators, which share the specimens in equal parts.
    """

    vague: Callable[[], Variables]
    reference: tuple[float, ...]
    positive: tuple[bool, ...]
    inputs: Callable[..., Variables]
    responses: tuple[Callable[..., Any], ...]


def _bent(x: Any) -> Any:
    return (x - 1 + np.sqrt((x - 1) ** 2 + 0.04)) / 2


PROBLEMS = {
    "linear": Problem(
        lambda: [pm.Normal("mu", 10, 3), pm.HalfNormal("sigma", 3)],
        (10.0, 1.0), (False, True), lambda a, b: [pm.Normal.dist(a, b)], (lambda x: x,),
    ),
    "quadratic": Problem(
        lambda: [pm.TruncatedNormal("mu", 2, 1, lower=1), pm.HalfNormal("sigma", 1)],
        (2.0, 0.5), (False, True), lambda a, b: [pm.Normal.dist(a, b)],
        (lambda x: x**2 - 2 * x + 1,),
    ),
    "gamma": Problem(
        lambda: [pm.LogNormal("mean", 0.5, 0.7), pm.LogNormal("shape", 1.2, 0.8)],
        (2.0, 4.0), (True, True), lambda m, k: [pm.Gamma.dist(alpha=k, beta=k / m)], (np.log1p,),
    ),
    "weibull": Problem(
        lambda: [pm.LogNormal("shape", 0.9, 0.6), pm.LogNormal("scale", 0.0, 0.8)],
        (2.5, 1.4), (True, True), lambda k, s: [pm.Weibull.dist(k, s)], (lambda x: x / (1 + x),),
    ),
    "folded": Problem(
        lambda: [pm.TruncatedNormal("mu", 1.0, 1.0, lower=0.0), pm.HalfNormal("sigma", 1.0)],
        (1.2, 0.7), (False, True), lambda a, b: [pm.Normal.dist(a, b)], (np.abs,),
    ),
    "product": Problem(
        lambda: [pm.Normal("mu", 3.0, 2.0), pm.HalfNormal("sigma", 0.5)],
        (3.0, 0.3), (False, True),
        lambda a, b: [pm.Normal.dist(a, 0.4), pm.LogNormal.dist(0.0, b)], (lambda x, z: x * z,),
    ),
    "threshold": Problem(
        lambda: [pm.LogNormal("scale", 0.0, 1.0)],
        (1.3,), (True,), lambda s: [pm.Exponential.dist(scale=s)], (_bent,),
    ),
    # Five problems that were not seen before the method was fixed.
    "exponential": Problem(
        lambda: [pm.Normal("mu", 0, 1), pm.HalfNormal("sigma", 1)],
        (0.5, 0.6), (False, True), lambda a, b: [pm.Normal.dist(a, b)],
        (lambda x: np.exp(x / 2),),
    ),
    "beta": Problem(
        lambda: [pm.LogNormal("alpha", 1.0, 0.5), pm.LogNormal("beta", 1.0, 0.5)],
        (3.0, 2.5), (True, True), lambda a, b: [pm.Beta.dist(a, b)], (lambda x: x**2,),
    ),
    "uniform": Problem(
        lambda: [pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1)],
        (1.0, 0.6), (False, True),
        lambda a, b: [pm.Uniform.dist(a - np.sqrt(3) * b, a + np.sqrt(3) * b)], (lambda x: x,),
    ),
    "laplace": Problem(
        lambda: [pm.Normal("mu", 0, 2), pm.HalfNormal("scale", 1)],
        (1.0, 0.5), (False, True), lambda a, b: [pm.Laplace.dist(a, b)], (np.arctan,),
    ),
    "two tests": Problem(
        lambda: [pm.Normal("mu", 0, 1), pm.HalfNormal("sigma", 1)],
        (0.5, 0.6), (False, True), lambda a, b: [pm.Normal.dist(a, b)],
        (lambda x: x, lambda x: np.exp(x / 2)),
    ),
}  # fmt: skip
NEW = ("exponential", "beta", "uniform", "laplace", "two tests")


def standard_errors(problem: Problem, size: int) -> Any:
    """Return those of the reference's elements, of logarithms of positive ones, by the information.

    By the variance of scores of 4000 specimens, by differences.
    """
    at = [np.log(v) if p else v for v, p in zip(problem.reference, problem.positive, strict=True)]
    rng = np.random.default_rng(1)
    specimens = [pm.draw(x, 4000, random_seed=rng) for x in problem.inputs(*problem.reference)]

    def log_density(theta: Any) -> Any:
        values = [np.exp(v) if p else v for v, p in zip(theta, problem.positive, strict=True)]
        terms = [
            pm.logp(x, given).eval()
            for x, given in zip(problem.inputs(*values), specimens, strict=True)
        ]
        return sum(terms)

    scores = []
    for j in range(len(at)):
        step = 1e-3 * np.eye(len(at))[j]
        up, down = log_density(at + step), log_density(at - step)
        score = (up - down) / 2e-3
        scores.append(np.where(np.isfinite(score), score, 0.0))
    information = np.atleast_2d(np.cov(scores))
    return np.sqrt(np.diag(np.linalg.inv(information)) / size)


def hyperparameters(problem: Problem, prior: str, size: int) -> Variables:
    """Return the hyperparameters of a model on the context, with one of the priors."""
    if prior == "vague":
        return problem.vague()
    errors = standard_errors(problem, size)
    shares = (0.25, 0.5)
    variables = []
    for j, (value, is_positive) in enumerate(zip(problem.reference, problem.positive, strict=True)):
        error = errors[j]
        if prior == "bounded":
            ends = (value - error, value + error)
            if is_positive:
                ends = (value * np.exp(-error), value * np.exp(error))
            variables.append(pm.Uniform(f"p{j}", *ends))
        elif is_positive:
            variables.append(pm.LogNormal(f"p{j}", np.log(value), shares[j] * error))
        else:
            variables.append(pm.Normal(f"p{j}", value, shares[j] * error))
    return variables


def build(problem: Problem, prior: str, metric: str, size: int) -> Any:
    """Return an evaluator of the problem's model, to be given data."""
    from prbayes.model.evaluator import Evaluator

    with pm.Model() as model:
        inputs = problem.inputs(*hyperparameters(problem, prior, size))
        part = size // len(problem.responses)
        for j, response in enumerate(problem.responses):
            prb.Simulator(
                f"y{j}", response, *inputs,
                metric=METRICS[metric], observed=np.linspace(0.1, 0.9, part),
                propagation=prb.Reweighted(max_points=2048),
            )  # fmt: skip
    return Evaluator.of(model)


def analyse(evaluator: Any, problem: Problem, seed: list[int]) -> dict[str, Any]:
    """Draw a truth and its data, calibrate them, and return the posterior's place and width."""
    from prbayes.optimize.minimize import find_optimum
    from prbayes.optimize.objective import Minimisation
    from prbayes.posterior.sample import draw_posterior
    from prbayes.posterior.smc import SamplingSettings

    rng = np.random.default_rng(seed)
    truth = evaluator.hyperparameters.prior_thetas(1, int(rng.integers(2**31)))
    values = [v[0] for v in evaluator.hyperparameters.constrained(truth).values()]
    data = {}
    for node, response in zip(evaluator.nodes, problem.responses, strict=True):
        n = len(node.observed)
        specimens = [pm.draw(x, n, random_seed=rng) for x in problem.inputs(*values)]
        data[node.name] = response(*specimens)
    ev = evaluator.observing(data)
    begun = time.process_time()
    optimum = find_optimum(ev, Minimisation())
    middle = time.process_time()
    asked = SamplingSettings(draws=DRAWS, chains=4, optimum=optimum)
    tree = draw_posterior(ev, asked)
    ended = time.process_time()
    thetas = np.asarray(tree["calibration"]["theta"]).reshape(-1, ev.size)
    return {
        "truth": truth[0].tolist(),
        "below": (thetas < truth).mean(axis=0).tolist(),
        "mean": thetas.mean(axis=0).tolist(),
        "sd": thetas.std(axis=0).tolist(),
        "estimate": optimum.theta.tolist(),
        "sampler": tree["posterior"].attrs["sampler"],
        "seconds": [middle - begun, ended - middle],
    }


Cell = tuple[str, str, int, str]


def cells(
    problems: list[str], priors: list[str], sizes: list[int], metrics: list[str]
) -> Iterator[Cell]:
    """Yield the cells of the study."""
    for problem in problems:
        for prior in priors:
            for size in sizes:
                for metric in metrics:
                    yield problem, prior, size, metric


def path(cell: Cell) -> Path:
    """Return where a cell's rows are."""
    problem, prior, size, metric = cell
    return STORE / f"{problem.replace(' ', '_')}-{prior}-{size}-{metric}.jsonl"


def rows_of(cell: Cell) -> list[dict[str, Any]]:
    """Return the stored rows of a cell."""
    file = path(cell)
    return [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []


def continue_cell(cell: Cell, until: int) -> None:
    """Analyse the data sets of a cell that are missing, up to a number."""
    from prbayes._progress import shown
    from prbayes.propagation.reweighted import designs_restored

    done = {row["data set"] for row in rows_of(cell)}
    missing = [i for i in range(until) if i not in done]
    if not missing:
        return
    name, prior, size, metric = cell
    problem = PROBLEMS[name]
    evaluator = build(problem, prior, metric, size)
    # Metrics see the same data; truths of other cells are independent.
    of_cell = crc32(f"{name}/{prior}/{size}".encode())
    for i in missing:
        row: dict[str, Any]
        try:
            with shown(False), designs_restored(evaluator.reweighted.values()):
                row = analyse(evaluator, problem, [2028, i, of_cell])
        except Exception as error:  # a failure is a result
            row = {"error": f"{type(error).__name__}: {error}"[:300]}
        with path(cell).open("a") as file:
            file.write(json.dumps(rounded({"data set": i, **row})) + "\n")


def rounded(value: Any) -> Any:
    """Return a row with five digits of each number."""
    if isinstance(value, dict):
        return {key: rounded(each) for key, each in value.items()}
    if isinstance(value, list):
        return [rounded(each) for each in value]
    return float(f"{value:.5g}") if isinstance(value, float) else value


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return coverage by element, with the number of data sets and failures."""
    good = [row for row in rows if "error" not in row]
    if not good:
        return {"data sets": 0, "failed": len(rows)}
    below = np.array([row["below"] for row in good])
    inside = np.abs(below - 0.5) < LEVEL / 2
    return {
        "data sets": len(good),
        "failed": len(rows) - len(good),
        "coverage": inside.mean(axis=0).tolist(),
        "by SMC": sum(row["sampler"] == "SMC" for row in good),
        "seconds": np.median([row["seconds"] for row in good], axis=0).tolist(),
    }


def pooled(found: dict[str, dict[str, Any]], keep: Callable[[Cell], bool]) -> dict[str, Any]:
    """Return mean coverage over the cells that are kept, with its standard error."""
    chosen = []
    for key, cell in found.items():
        problem, prior, size, metric = key.split("/")
        if cell["data sets"] and keep((problem, prior, int(size), metric)):
            chosen.append(cell)
    shares = np.concatenate([cell["coverage"] for cell in chosen])
    counts = np.concatenate([[cell["data sets"]] * len(cell["coverage"]) for cell in chosen])
    coverage = float((shares * counts).sum() / counts.sum())
    return {
        "coverage": coverage,
        "error": float(np.sqrt(coverage * (1 - coverage) / counts.sum())),
        "intervals": int(counts.sum()),
        "lowest": float(shares.min()),
        "highest": float(shares.max()),
        "failed": sum(cell["failed"] for cell in chosen),
        "by SMC": sum(cell["by SMC"] for cell in chosen),
        "seconds": float(np.median([sum(cell["seconds"]) for cell in chosen])),
    }


def table() -> dict[str, Any]:
    """Summarise the stored rows, and print them; cells without rows here stay as they were."""
    found = dict(record.load(OUT, {"cells": {}})["cells"])
    for cell in cells(list(PROBLEMS), list(PRIORS), list(SIZES), list(METRICS)):
        rows = rows_of(cell)
        if rows:
            found["/".join(map(str, cell))] = summary(rows)
    groups: dict[str, Callable[[Cell], bool]] = {"all": lambda cell: True}
    groups |= {metric: lambda cell, m=metric: cell[3] == m for metric in METRICS}
    groups |= {prior: lambda cell, p=prior: cell[1] == p for prior in PRIORS}
    groups |= {f"N = {size}": lambda cell, s=size: cell[2] == s for size in SIZES}
    groups |= {problem: lambda cell, p=problem: cell[0] == p for problem in PROBLEMS}
    groups |= {
        f"{metric}, {prior}": lambda cell, m=metric, p=prior: (cell[3], cell[1]) == (m, p)
        for metric in METRICS
        for prior in PRIORS
    }
    groups["five new problems"] = lambda cell: cell[0] in NEW
    figures = {}
    for name, keep in groups.items():
        try:
            figures[name] = pooled(found, keep)
        except ValueError:  # no cell yet
            continue
        row = figures[name]
        print(
            f"{name:18s} {row['coverage']:.3f} +- {row['error']:.3f} of {row['intervals']:6d}, cells "
            f"{row['lowest']:.2f} to {row['highest']:.2f}, failed {row['failed']}, "
            f"SMC {row['by SMC']}, {row['seconds']:.2f} s"
        )
    return {"cells": found, "pooled": figures}


def main() -> None:
    """Run what is missing, then summarise."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data-sets", type=int, default=40)
    parser.add_argument("--problems", nargs="+", default=list(PROBLEMS), choices=list(PROBLEMS))
    parser.add_argument("--priors", nargs="+", default=list(PRIORS), choices=list(PRIORS))
    parser.add_argument("--sizes", nargs="+", type=int, default=list(SIZES))
    parser.add_argument("--metrics", nargs="+", default=list(METRICS), choices=list(METRICS))
    parser.add_argument("--only-table", action="store_true")
    arguments = parser.parse_args()
    logging.getLogger("prbayes").setLevel(logging.ERROR)
    STORE.mkdir(parents=True, exist_ok=True)
    asked = (arguments.problems, arguments.priors, arguments.sizes, arguments.metrics)
    if not arguments.only_table:
        for until in range(BLOCK, arguments.data_sets + BLOCK, BLOCK):
            for cell in cells(*asked):
                continue_cell(cell, min(until, arguments.data_sets))
    record.save(OUT, table())


if __name__ == "__main__":
    main()
