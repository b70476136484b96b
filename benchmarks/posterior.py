"""Coverage of posteriors given the metric's estimate, with truths drawn from the prior.

A population is drawn from the prior, specimens from the population, and `prb.sample` is run on them.
89 % intervals of an exact posterior then contain the truth with probability .89, whatever the metric.
Priors are

- ``vague``: wide for the problem;
- ``bounded``: uniform, two standard errors wide;
- ``sharp``: a quarter and half of a standard error wide.

Standard errors are those of the population's own inputs at a reference point. No constant of the
package was chosen on the problems.

    OMP_NUM_THREADS=1 uv run python -m benchmarks.posterior [--data-sets 40] [--cells "linear/*"]
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import product
from typing import Any
from zlib import crc32

import numpy as np
import pymc as pm

import prbayes as prb
from benchmarks.study import Study
from prbayes.model.evaluator import Evaluator
from prbayes.optimize.minimize import find_optimum
from prbayes.optimize.objective import Minimisation
from prbayes.posterior.sample import draw_posterior
from prbayes.posterior.smc import SamplingSettings
from prbayes.propagation.reweighted import designs_restored

SIZES = (10, 20, 50, 200)
PRIORS = ("vague", "bounded", "sharp")
METRICS = {
    "PR": prb.ProbabilityResidual(),
    "KLD": prb.KullbackLeibler(),
    "area": prb.AreaMetric(),
}
LEVEL = 0.89
DRAWS = 250  # of each of four chains

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


@lru_cache(1)
def evaluator_of(name: str, prior: str, size: int, metric: str) -> Evaluator:
    """Return an evaluator of the problem's model, to be given data."""
    problem = PROBLEMS[name]
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


def row(cell: str, number: int) -> dict[str, Any]:
    """Draw a truth and its data, calibrate them, and return the posterior's place and width."""
    name, prior, size, metric = cell.split("/")
    problem, evaluator = PROBLEMS[name], evaluator_of(name, prior, int(size), metric)
    # Metrics see the same data; truths of other cells are independent.
    of_cell = crc32(f"{name}/{prior}/{size}".encode())
    rng = np.random.default_rng([2028, number, of_cell])
    with designs_restored(evaluator.reweighted.values()):
        truth = evaluator.hyperparameters.prior_thetas(1, int(rng.integers(2**31)))
        values = [v[0] for v in evaluator.hyperparameters.constrained(truth).values()]
        data = {}
        for node, response in zip(evaluator.nodes, problem.responses, strict=True):
            n = len(node.observed)
            specimens = [pm.draw(x, n, random_seed=rng) for x in problem.inputs(*values)]
            data[node.name] = response(*specimens)
        return analyse(evaluator.observing(data), truth)


def analyse(evaluator: Evaluator, truth: Any) -> dict[str, Any]:
    """Return where the truth is in the posterior, and what the posterior cost."""
    begun = time.process_time()
    optimum = find_optimum(evaluator, Minimisation())
    middle = time.process_time()
    tree = draw_posterior(evaluator, SamplingSettings(draws=DRAWS, chains=4, optimum=optimum))
    ended = time.process_time()
    thetas = np.asarray(tree["calibration"]["theta"]).reshape(-1, truth.size)
    return {
        "below": (thetas < truth).mean(axis=0).tolist(),
        "sampler": tree["posterior"].attrs["sampler"],
        "seconds": [middle - begun, ended - middle],
    }


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


def groups() -> dict[str, Callable[[list[str]], bool]]:
    """Return groups of cells: whether one has a cell, by its problem, prior, size and metric."""
    result: dict[str, Callable[[list[str]], bool]] = {"all": lambda cell: True}
    for names, label in ((METRICS, "{}"), (PRIORS, "{}"), (SIZES, "N = {}"), (PROBLEMS, "{}")):
        result |= {label.format(name): partial(_has, {str(name)}) for name in names}
    for metric, prior in product(METRICS, PRIORS):
        result[f"{metric}, {prior}"] = partial(_has, {metric, prior})
    result["five new problems"] = lambda cell: cell[0] in NEW
    return result


def _has(names: set[str], cell: list[str]) -> bool:
    return names <= set(cell)


def pooled(figures: dict[str, Any], has: Callable[[list[str]], bool]) -> dict[str, Any]:
    """Return mean coverage over the cells of a group, with its standard error."""
    chosen = [figures[key] for key in figures if figures[key]["data sets"] and has(key.split("/"))]
    shares = np.concatenate([cell["coverage"] for cell in chosen])
    counts = np.concatenate([[cell["data sets"]] * len(cell["coverage"]) for cell in chosen])
    coverage = float((shares * counts).sum() / counts.sum())
    return {
        "coverage": coverage,
        "error": float(np.sqrt(coverage * (1 - coverage) / counts.sum())),
        "intervals": int(counts.sum()),
        "failed": sum(cell["failed"] for cell in chosen),
    }


CELLS = ["/".join(map(str, case)) for case in product(PROBLEMS, PRIORS, SIZES, METRICS)]
# A failure is a result.
STUDY = Study(
    "posterior", __doc__, CELLS, row, 40, summary, failures=(Exception,), block=10, has_rows=False
)

if __name__ == "__main__":
    STUDY.main()
