"""Several outputs calibrated jointly: errors of the estimates beside those of maximum likelihood.

Each problem has a true population. Many data sets are drawn from it, and each is calibrated by
separate marginals (a simulator an output) and by `Joint`, each under three metrics of one output, and
by maximum likelihood. Bandwidths and whitening are chosen from each data set anew. The design is
drawn near the truth, once for all data sets.

Errors are those of means in units of the population's spread, of logarithms of standard deviations
and of inverse hyperbolic tangents of correlations.

    uv run python -m benchmarks.joint [--data-sets 200] [--cells "frame*"]
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from typing import Any

import numpy as np
import pymc as pm
from scipy.optimize import minimize

import prbayes as prb
from benchmarks.metrics import METRICS
from benchmarks.study import Study
from prbayes.model.evaluator import Evaluator
from prbayes.optimize.minimize import find_optimum
from prbayes.optimize.objective import Minimisation

SIZES = (20, 50, 200)
SCHOOLS = ("joint", "separate")
METHODS = tuple(f"{s} {metric}" for s, metric in product(SCHOOLS, ("PR", "KLD", "area")))
_FEW = 8  # specimens of the data sets whose estimates are the populations of the design


@dataclass(frozen=True)
class _Chosen:
    """The outputs of a response, or one of them."""

    response: Callable[[Any], Any] | None = None
    output: int | None = None

    def __call__(self, *inputs: Any) -> Any:
        """Return the outputs, (..., m), of inputs (..., p) or of p inputs (...)."""
        x = inputs[0] if len(inputs) == 1 else np.stack(inputs, axis=-1)
        outputs = x if self.response is None else self.response(x)
        return outputs if self.output is None else outputs[..., self.output]


@dataclass(frozen=True)
class Problem:
    """Outputs of specimens with normal inputs, which the outputs determine exactly."""

    mean: Any  # (p,): of the inputs
    covariance: Any  # (p, p)
    # N, and whether marginals are all that is compared -> inputs; priors stand in the model.
    model: Callable[[int, bool], list[Any]]
    response: _Chosen  # (..., p) -> (..., m)
    moments: Callable[[dict[str, Any]], tuple[Any, Any]]  # values -> (P, p), (P, p, p)
    values: Callable[[Any, Any], dict[str, Any]]  # mean, covariance -> values near them
    correlated: bool  # whether there is a correlation among the hyperparameters

    def draw(self, rng: Any, size: int) -> Any:
        """Return inputs of specimens, (size, p)."""
        root = np.linalg.cholesky(self.covariance)
        return self.mean + rng.standard_normal((size, len(root))) @ root.T

    def coordinates(self, values: dict[str, Any]) -> Any:
        """Return the numbers whose errors are compared, (P, h): all nearly normal, and without unit."""
        mean, covariance = self.moments(values)
        sd = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
        columns = [(mean - self.mean) / np.sqrt(np.diag(self.covariance)), np.log(sd)]
        if self.correlated:
            columns.append(np.arctanh(covariance[:, :1, 1] / sd[:, :1] / sd[:, 1:2]))
        return np.concatenate(columns, axis=1)


def _covariance(sd: Any, rho: Any) -> Any:
    """Return a covariance of two outputs, (..., 2), (...) -> (..., 2, 2)."""
    matrix = sd[..., :, None] * sd[..., None, :]
    return matrix * (rho + (1 - rho) * np.eye(2))


def _normal(rho: float) -> Problem:
    def model(size: int, marginal: bool) -> list[Any]:
        mu = pm.Normal("mu", 0, 3, shape=2)
        sd = pm.HalfNormal("sd", 3, shape=2)
        # Marginals do not identify it: there it is known.
        common = rho if marginal else pm.Uniform("rho", -1, 1)
        return [pm.MvNormal.dist(mu, cov=_covariance(sd, common))]

    def moments(values: dict[str, Any]) -> tuple[Any, Any]:
        common = values.get("rho", np.full(len(values["mu"]), rho))
        return values["mu"], _covariance(values["sd"], common[:, None, None])

    def values(mean: Any, covariance: Any) -> dict[str, Any]:
        sd = np.sqrt(np.diag(covariance))
        common = covariance[1, 0] / sd[0] / sd[1]
        return {"mu": mean, "sd": sd, "rho": np.clip(common, -0.9, 0.998)}

    covariance = _covariance(np.ones(2), np.array(rho))
    return Problem(np.zeros(2), covariance, model, _Chosen(), moments, values, True)


def frame(x: Any) -> Any:
    """Return two frequencies and the roof's share of the first mode, of a two-storey shear frame.

    From the stiffnesses of the storeys, masses are one; NaN where a stiffness is not positive.
    """
    lower, upper = np.where((x > 0).all(axis=-1, keepdims=True), x, np.nan).T
    middle, root = (lower + 2 * upper) / 2, np.sqrt(lower**2 + 4 * upper**2) / 2
    low = middle - root
    roof = (lower + upper - low) / upper
    return np.stack(
        [np.sqrt(low) / 2 / np.pi, np.sqrt(middle + root) / 2 / np.pi, roof / (1 + roof)]
    ).T


_STIFFNESS = np.array([1000.0, 800.0])
_SCATTER = np.array([80.0, 60.0])


def _frame() -> Problem:
    def model(size: int, marginal: bool) -> list[Any]:
        # A hundred standard errors, of a mean and of a standard deviation.
        half = 50 * _SCATTER / np.sqrt(size)
        mu = pm.Uniform("mu", _STIFFNESS - half, _STIFFNESS + half, shape=2)
        sd = pm.Uniform("sd", 0.0, 100 * _SCATTER / np.sqrt(2 * size), shape=2)
        return [pm.Normal.dist(mu[0], sd[0]), pm.Normal.dist(mu[1], sd[1])]

    def moments(values: dict[str, Any]) -> tuple[Any, Any]:
        return values["mu"], values["sd"][..., None] ** 2 * np.eye(2)

    def values(mean: Any, covariance: Any) -> dict[str, Any]:
        return {"mu": mean, "sd": np.sqrt(np.diag(covariance))}

    covariance = np.diag(_SCATTER**2)
    return Problem(_STIFFNESS, covariance, model, _Chosen(frame), moments, values, False)


PROBLEMS = {
    "normal 0": _normal(0.0),
    "normal .6": _normal(0.6),
    "normal .95": _normal(0.95),
    "frame": _frame(),
}


def estimate(problem: Problem, x: Any) -> dict[str, Any]:
    """Return values by the moments of inputs."""
    return problem.values(x.mean(axis=0), np.cov(x.T))


def true_values(problem: Problem) -> dict[str, Any]:
    """Return the truth, with an axis of one population."""
    values = problem.values(problem.mean, problem.covariance)
    return {key: np.asarray(value)[None] for key, value in values.items()}


@lru_cache(1)
def near(name: str, size: int) -> dict[str, Any]:
    """Return the populations of a design, near the truth."""
    rng = np.random.default_rng([size, 1])
    problem = PROBLEMS[name]
    estimates = [estimate(problem, problem.draw(rng, _FEW)) for _ in range(512)]
    return {key: np.array([e[key] for e in estimates]) for key in estimates[0]}


@lru_cache(2)
def evaluator_of(name: str, size: int, is_separate: bool) -> Evaluator:
    """Return an evaluator whose designs are drawn near the truth."""
    p = PROBLEMS[name]
    some = p.response(p.draw(np.random.default_rng(0), size))
    n = 4096 if size > 50 else 2048
    stored = prb.Reweighted(16, max_points=n + 16, emulator=None)
    with pm.Model() as model:
        inputs = p.model(size, is_separate)
        if is_separate:
            for k in range(some.shape[1]):
                prb.Simulator(
                    f"y{k}", _Chosen(p.response.response, k), *inputs, metric=prb.AreaMetric(),
                    observed=some[:, k], propagation=stored, specimens=np.arange(size),
                )  # fmt: skip
        else:
            metric = prb.Joint(prb.AreaMetric())
            prb.Simulator(
                "y", p.response, *inputs, metric=metric, observed=some, propagation=stored
            )
    evaluator = Evaluator.of(model)
    for bound in evaluator.reweighted.values():
        bound.add([near(name, size)[root.name] for root in bound.inputs.parents], n)
    return evaluator


def log_likelihood(problem: Problem, x: Any, values: dict[str, Any]) -> Any:
    """Return the exact log-likelihood of inputs, of populations (P,)."""
    center, scatter = x.mean(axis=0), np.cov(x.T, bias=True)
    mean, covariance = problem.moments(values)
    away = center - mean
    total = scatter + away[:, :, None] * away[:, None]
    trace = np.einsum("pij,pji->p", np.linalg.inv(covariance), total)
    return -0.5 * len(x) * (np.linalg.slogdet(covariance)[1] + trace)


def maximum_likelihood(name: str, size: int, x: Any) -> Any:
    """Return the theta of the maximum likelihood estimate."""
    problem, evaluator = PROBLEMS[name], evaluator_of(name, size, False)
    names = evaluator.hyperparameters
    free = [rv.name for rv in evaluator.model.free_RVs]
    populations = near(name, size)
    # Of the estimate from all specimens, in theta.
    spread = np.cov(names.thetas_of([populations[key] for key in free]).T) * _FEW / size
    start = names.thetas_of([np.asarray(estimate(problem, x)[key])[None] for key in free])[0]
    scale = np.sqrt(np.diag(spread))
    steps = 1e-4 * np.concatenate([np.zeros((1, scale.size)), np.diag(scale), -np.diag(scale)])

    def objective(z: Any) -> tuple[float, Any]:
        thetas = start + z * scale + steps
        values = -log_likelihood(problem, x, names.constrained(thetas))
        up, down = values[1 : 1 + z.size], values[1 + z.size :]
        return float(values[0]), (up - down) / 2e-4

    best = minimize(objective, np.zeros(start.size), jac=True, method="BFGS")
    return start + best.x * scale


def calibrated(name: str, size: int, method: str, x: Any) -> tuple[Evaluator, Any]:
    """Return the evaluator and the optimum of a data set by a method."""
    problem = PROBLEMS[name]
    outputs = problem.response(x)
    school, metric = method.split()
    base = evaluator_of(name, size, school == "separate")
    if school == "separate":
        data = {f"y{k}": outputs[:, k] for k in range(outputs.shape[1])}
        evaluator = base.observing(data, METRICS[metric])
    else:
        evaluator = base.observing({"y": outputs}, prb.Joint(METRICS[metric]))
    free = {rv.name for rv in evaluator.model.free_RVs}
    truth = {k: value[0] for k, value in true_values(problem).items() if k in free}
    optimum = find_optimum(evaluator, Minimisation(starts=0, refine=False, start=truth))
    return evaluator, optimum.theta


def row(cell: str, number: int) -> dict[str, Any]:
    """Return the errors of a method, and of maximum likelihood."""
    name, text, method = cell.split("/")
    problem, size = PROBLEMS[name], int(text)
    rng = np.random.default_rng([number, size, 1 + sorted(PROBLEMS).index(name)])
    x = problem.draw(rng, size)
    truth = problem.coordinates(true_values(problem))[0]
    evaluator, theta = calibrated(name, size, method, x)
    best = maximum_likelihood(name, size, x)
    together = evaluator_of(name, size, False).hyperparameters
    exact = problem.coordinates(together.constrained(best[None]))[0]
    found = problem.coordinates(evaluator.hyperparameters.constrained(theta[None]))[0]
    # Separate marginals do not identify a correlation of inputs that no response mixes.
    count = len(truth) - (problem.correlated and method.startswith("separate"))
    return {
        "errors": [float(f"{e:.5g}") for e in (found - truth)[:count]],
        "of likelihood": [float(f"{e:.5g}") for e in (exact - truth)[:count]],
    }


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return root mean square errors over those of maximum likelihood."""
    good = [row for row in rows if "error" not in row]
    figures: dict[str, Any] = {"data sets": len(good), "failed": len(rows) - len(good)}
    if good:
        errors, exact = (
            np.sqrt(np.mean(np.square([row[key] for row in good]), axis=0))
            for key in ("errors", "of likelihood")
        )
        figures["rmse over likelihood"] = (errors / exact).tolist()
    return figures


def grouped(values: list[float]) -> list[float]:
    """Return the means of a figure over means, standard deviations and, if any, correlations."""
    groups = [values[:2], values[2:4], values[4:]]
    return [float(np.mean(group)) for group in groups if group]


CELLS = ["/".join(map(str, case)) for case in product(PROBLEMS, SIZES, METHODS)]
# A failure is a result.
STUDY = Study(
    "joint", __doc__, CELLS, row, 200, summary, failures=(Exception,), block=10, has_rows=False
)

if __name__ == "__main__":
    STUDY.main()
