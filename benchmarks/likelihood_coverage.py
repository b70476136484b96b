"""Simulation-based calibration of the log-likelihood by specimen: are intervals right on average?

Hyperparameters are drawn from the prior, inputs of specimens from their population, and readings are
their responses without error. Emulator, roots and points are those of `prbayes.Simulator`; all data
sets share the first runs. The posterior is sampled by importance sampling here: modes, a mixture of
t distributions, Sobol points, and a second round with moments of the first. The value of the
weighted distribution function at the truth is uniform if the likelihood is right (Cook, Gelman and
Rubin 2006, doi:10.1198/106186006X136976). The exact likelihood, by the roots in closed form, is sampled on
the same data sets: the difference of both has less noise than either.

    uv run python -m benchmarks.likelihood_coverage [--data-sets 400]
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import numpy as np
import pymc as pm
from scipy import optimize, stats
from scipy.special import betaincinv, i0e, lambertw, logsumexp, ndtr, ndtri

import prbayes as prb
from benchmarks.scoreboard import in_pymc
from benchmarks.scoreboard.problem import Input, Prior, half_normal, normal, truncated
from benchmarks.scoreboard.problem import Problem as Population
from benchmarks.study import Study
from prbayes.model.measurement import SpecimenLikelihood
from prbayes.model.specimen_likelihood import specimen_likelihoods
from prbayes.model.specimen_preparation import prepared
from prbayes.propagation.base import DesignError

PROB = 0.89
_POINTS = 4096
_DEGREES = 5.0
_AT_ONCE = 4_000_000  # numbers of an array
Functions = Callable[[Any], Any]


@dataclass(frozen=True)
class Problem:
    """A population with its response, and the exact log-likelihood of readings."""

    name: str
    size: int
    priors: dict[str, Prior]
    inputs: tuple[Input, ...]
    formula: Callable[..., Any]
    # Readings (N, m) -> roots (N, K, d), log |dx/dy| (N, K).
    roots: Callable[[Any], tuple[Any, Any]] | None = None
    # Readings (N, m), populations (S, q) -> exact log-likelihoods (S,), where there are no roots.
    exact: Callable[[Any, Any], Any] | None = None

    @property
    def population(self) -> Population:
        """The problem as one of the scoreboard, for its inputs and priors."""
        return Population(self.name, "", "", self.priors, self.inputs, self.formula, (self.size,))

    def response(self, *x: Any) -> Any:
        """Return outputs, (..., m), or (...) of a single one."""
        outputs = self.formula(np, *x)
        return np.stack(outputs, axis=-1) if type(outputs) is list else outputs


def _folded_roots(y: Any) -> tuple[Any, Any]:
    root = np.sqrt(y)
    return np.stack([1 - root, 1 + root], axis=1), np.repeat(-np.log(2 * root), 2, axis=1)


def _mirror_roots(y: Any) -> tuple[Any, Any]:
    # exp(s) - s = c has the solutions -c - W(-exp(-c)), by both real branches of Lambert's W.
    c = y[:, 1]
    s = np.stack([-c - lambertw(-np.exp(-c), k).real for k in (0, -1)], axis=1)
    x2 = 1 + s
    x1 = (np.log(y[:, :1]) - 0.1 * x2) / 0.3
    log_slope = -np.log(0.3 * y[:, :1] * np.abs(np.expm1(s)))
    return np.stack([x1, x2], axis=2), log_slope


def _squared_rice(y: Any, theta: Any) -> Any:
    # y = a^2 + b^2 of independent normal a, b with means mu, 0 and one standard deviation.
    mu, sd = theta[:, :1], theta[:, 1:]
    root = np.sqrt(y.T)
    log_p = -0.5 * ((root - mu) / sd) ** 2 + np.log(i0e(mu * root / sd**2)) - np.log(2 * sd**2)
    return log_p.sum(axis=1)


PROBLEMS = {
    problem.name: problem
    for problem in (
        Problem(
            name="folded",
            size=30,
            priors={"mu": truncated(2.0, 1.0, low=1.0), "sigma": half_normal(1.0)},
            inputs=(Input("normal", "mu", "sigma"),),
            formula=lambda xp, x: x**2 - 2 * x + 1,
            roots=_folded_roots,
        ),
        Problem(
            name="mirror root",
            size=20,
            priors={
                "mu1": normal(0.0, 1.0),
                "sd1": half_normal(0.5),
                "mu2": truncated(2.0, 0.7, low=1.0),
                "sd2": half_normal(0.5),
            },
            inputs=(Input("normal", "mu1", "sd1"), Input("normal", "mu2", "sd2")),
            formula=lambda xp, a, b: [xp.exp(0.3 * a + 0.1 * b), xp.exp(b - 1) - (b - 1)],
            roots=_mirror_roots,
        ),
        Problem(
            name="circle",
            size=20,
            priors={"mu": truncated(2.0, 0.7, low=0.5), "sd": half_normal(0.5)},
            inputs=(Input("normal", "mu", "sd"), Input("normal", 0.0, "sd")),
            formula=lambda xp, a, b: a**2 + b**2,
            exact=_squared_rice,
        ),
    )
}


def likelihood_of(
    problem: Problem, measurement: Callable[[Any], dict[str, Any]] = lambda values: {}
) -> tuple[pm.Model, SpecimenLikelihood]:
    """Return a model with this problem's inputs, and its likelihood; its data are arbitrary.

    ``measurement`` returns arguments of `prb.LogLikelihood` from the model variables by name.
    """
    population = problem.population
    middle = {name: p.distribution().median() for name, p in problem.priors.items()}
    z = stats.norm.ppf((np.arange(problem.size) + 0.5) / problem.size)
    x = population.population(middle, np.repeat(z[:, None], len(problem.inputs), axis=1))
    with pm.Model() as model:
        values = in_pymc.hyperparameters(population)
        inputs = in_pymc.inputs(population, values)
        observed = problem.response(*[np.ravel(column) for column in x])
        metric = prb.LogLikelihood(**measurement(values))
        prb.Simulator("y", problem.response, *inputs, metric=metric, observed=observed)
    (likelihood,) = specimen_likelihoods(model).values()
    return model, likelihood


# -- posterior ---------------------------------------------------------------------------------------


def thetas_of(problem: Problem, u: Any) -> Any:
    """Return hyperparameters (S, q) of standard normal coordinates: u is normal under the prior."""
    columns = zip(problem.priors.values(), np.transpose(u), strict=True)
    return np.stack([_quantile(prior, ndtr(column)) for prior, column in columns], axis=1)


def _quantile(prior: Prior, p: Any) -> Any:
    """Return quantiles of a prior; those of SciPy's distributions take a hundred times as long."""
    if prior.family == "norm":
        mean, sd = prior.arguments
        return mean + sd * ndtri(p)
    if prior.family == "halfnorm":
        return prior.arguments[0] + prior.arguments[1] * ndtri((1 + p) / 2)
    if prior.family == "beta":
        return betaincinv(*prior.arguments, p)
    low, _, mean, sd = prior.arguments  # truncated below
    return mean + sd * ndtri(ndtr(low) + p * ndtr(-low))


def log_likelihood(problem: Problem, x: Any, log_a: Any) -> Functions:
    """Return the log-likelihood (S,) of populations (S, q) from points (N, K, d) and (N, K)."""
    names = list(problem.priors)

    def function(theta: Any) -> Any:
        # In blocks, so that memory stays small.
        blocks = max(1, len(theta) * log_a.size // _AT_ONCE)
        return np.concatenate([block(part) for part in np.array_split(theta, blocks)])

    def block(theta: Any) -> Any:
        log_p = log_a[None]
        for j, one in enumerate(problem.inputs):
            mean, sd = (
                theta[:, names.index(p), None, None] if isinstance(p, str) else p
                for p in (one.first, one.second)
            )
            log_p = log_p - 0.5 * ((x[None, ..., j] - mean) / sd) ** 2 - np.log(sd)
        largest = log_p.max(axis=2)
        return (largest + np.log(np.exp(log_p - largest[..., None]).sum(axis=2))).sum(axis=1)

    return function


def exact_log_likelihood(problem: Problem, y: Any) -> Functions:
    """Return the exact log-likelihood (S,) of populations (S, q) from readings (N, m)."""
    if problem.roots is None:
        assert problem.exact is not None
        return partial(problem.exact, y)
    return log_likelihood(problem, *problem.roots(y))


def posterior(
    problem: Problem, function: Functions, start: Any, count: int = _POINTS
) -> tuple[Any, Any, float]:
    """Return coordinates (S, q) with normalised weights (S,), and Pareto k."""
    from arviz_stats.base.array import array_stats

    d = len(problem.priors)

    def log_density(u: Any) -> Any:
        with np.errstate(all="ignore"):
            logs = function(thetas_of(problem, u)) - 0.5 * (u**2).sum(axis=1)
        return np.where(np.isnan(logs), -np.inf, logs)

    components = _modes(log_density, start, d)
    sobol = np.clip(stats.qmc.Sobol(d + 2, seed=0).random(count), 1e-12, 1 - 1e-12)
    k = np.inf
    for round_number in range(4):
        u, log_q = _drawn(components, sobol)
        logs = log_density(u) - log_q
        smoothed, k = array_stats.psislw(-logs)  # of minus the log of the ratios
        weights = np.exp(smoothed - logsumexp(smoothed))
        if (float(k) <= 0.5 and 1 / (weights**2).sum() > 0.2 * count) or round_number == 3:
            break
        components = _refitted(components, u, weights)
    return u, weights, float(k)


Component = tuple[float, Any, Any]  # log mass, centre (d,), lower factor (d, d)


def _modes(log_density: Functions, start: Any, d: int) -> list[Component]:
    """Return the Laplace approximations of modes within ten nats, from the best points of the prior."""
    screened = stats.norm.ppf(np.clip(stats.qmc.Sobol(d, seed=1).random(512), 1e-9, 1 - 1e-9))
    order = np.argsort(-log_density(screened), kind="stable")[:32]
    far = ((screened[order] - screened[order[0]]) ** 2).sum(axis=1).argmax()
    starts = [start, screened[order[0]], screened[order[far]]]
    found: list[Component] = []
    for first in starts:
        end = optimize.minimize(
            lambda u: -float(log_density(u[None])[0]), first, jac=lambda u: -_slope(log_density, u),
            method="BFGS",
        ).x  # fmt: skip
        height = float(log_density(end[None])[0])
        if not np.isfinite(height):
            continue
        root = np.linalg.cholesky(_inverse_hessian(log_density, end))
        away = [np.linalg.solve(root, end - center) for _, center, _ in found]
        if all((step**2).sum() > 0.5 for step in away):
            mass = height + np.log(np.diag(root)).sum()
            found.append((mass, end, root))
    highest = max(mass for mass, _, _ in found)
    return [component for component in found if component[0] > highest - 10]


def _slope(log_density: Functions, u: Any, step: float = 1e-4) -> Any:
    shifts = step * np.eye(len(u))
    values = log_density(np.concatenate([u + shifts, u - shifts]))
    with np.errstate(invalid="ignore"):
        slope = (values[: len(u)] - values[len(u) :]) / (2 * step)
    return np.where(np.isfinite(slope), slope, 0.0)


def _inverse_hessian(log_density: Functions, u: Any, step: float = 0.01) -> Any:
    rows = [
        (_slope(log_density, u + shift) - _slope(log_density, u - shift)) / (2 * step)
        for shift in step * np.eye(len(u))
    ]
    precision, vectors = np.linalg.eigh(-(np.array(rows) + np.transpose(rows)) / 2)
    # The prior has precision one.
    return (vectors / np.maximum(precision, 0.5)) @ vectors.T


def _drawn(components: list[Component], sobol: Any) -> tuple[Any, Any]:
    """Return points of a mixture of t distributions, and their log-density up to a constant."""
    shares = np.exp([mass for mass, _, _ in components] - logsumexp([m for m, _, _ in components]))
    shares = 0.9 * shares + 0.1 / len(shares)
    which = np.minimum(np.searchsorted(np.cumsum(shares), sobol[:, 0]), len(shares) - 1)
    d = sobol.shape[1] - 2
    radius = np.sqrt(_DEGREES / stats.chi2.ppf(sobol[:, 1], _DEGREES))
    standard = stats.norm.ppf(sobol[:, 2:]) * radius[:, None]
    centers = np.array([center for _, center, _ in components])
    factors = np.array([root for *_, root in components])
    u = centers[which] + np.einsum("sde,se->sd", factors[which], standard)
    logs = []
    for share, (_, center, root) in zip(shares, components, strict=True):
        square = (np.linalg.solve(root, (u - center).T) ** 2).sum(axis=0)
        log_det = np.log(np.diag(root)).sum()
        logs.append(np.log(share) - log_det - (_DEGREES + d) / 2 * np.log1p(square / _DEGREES))
    return u, logsumexp(logs, axis=0)


def _refitted(components: list[Component], u: Any, weights: Any) -> list[Component]:
    """Return the components with one more, which has the moments of weighted points."""
    center = weights @ u
    away = u - center
    covariance = (weights * away.T) @ away + 1e-9 * np.eye(u.shape[1])
    highest = max(mass for mass, _, _ in components)
    return [*components, (highest + 1.0, center, np.linalg.cholesky(1.5 * covariance))]


# -- data sets ---------------------------------------------------------------------------------------


def data_set(problem: Problem, likelihood: SpecimenLikelihood, number: int) -> dict[str, Any]:
    """Return the values of both distribution functions at the truth, by hyperparameter."""
    rng = np.random.default_rng([9, problem.size, number])
    start = rng.standard_normal(len(problem.priors))
    truth = thetas_of(problem, start[None])[0]
    z = rng.standard_normal((problem.size, len(problem.inputs)))
    values = dict(zip(problem.priors, truth, strict=True))
    y = problem.response(*[np.ravel(x) for x in problem.population.population(values, z)])
    row: dict[str, Any] = {"number": number}
    other = likelihood.observing({likelihood.name: y})
    # Coordinates are those of the prior, whatever the data.
    other.__dict__["coordinates"] = likelihood.coordinates
    try:
        points = prepared(other).points
    except DesignError as error:
        return row | {"error": str(error)}
    row["runs"] = len(prepared(other).emulation.z)
    x = np.concatenate(
        [a.reshape(*a.shape[:2], -1) for a in likelihood.coordinates.inputs(points.z)], axis=2
    )
    log_a = points.log_a + likelihood.coordinates.log_jacobian(points.z)
    functions = {
        "prbayes": log_likelihood(problem, x, log_a),
        "exact": exact_log_likelihood(problem, y.reshape(problem.size, -1)),
    }
    for name, function in functions.items():
        u, weights, k = posterior(problem, function, start)
        row[name] = figures_of(problem, u, weights, start, u) | {"k": k}
    return row


def figures_of(problem: Problem, u: Any, weights: Any, start: Any, values: Any) -> dict[str, Any]:
    """Return the distribution function at the truth, and moments of values (S, q), from weights."""
    mean = weights @ values
    return {
        "below": {p: float(weights @ (u[:, j] < start[j])) for j, p in enumerate(problem.priors)},
        "mean": mean.tolist(),
        "sd": np.sqrt(weights @ (values - mean) ** 2).tolist(),
    }


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return coverage, tests of uniformity, and the distance of the two posteriors."""
    good = [row for row in rows if "error" not in row]
    result: dict[str, Any] = {"data sets": len(rows), "refused": len(rows) - len(good)}
    result["runs"] = float(np.median([row["runs"] for row in good]))
    for name in ("prbayes", "exact"):
        below = {p: np.array([r[name]["below"][p] for r in good]) for p in good[0][name]["below"]}
        inside = {p: np.abs(2 * u - 1) <= PROB for p, u in below.items()}
        result[name] = {
            "coverage": {p: float(i.mean()) for p, i in inside.items()},
            "pooled coverage": float(np.mean(list(inside.values()))),
            "p of uniformity": {
                p: float(stats.kstest(u, "uniform").pvalue) for p, u in below.items()
            },
            "largest k": max(row[name]["k"] for row in good),
        }
    means, sds = (
        {name: np.array([row[name][key] for row in good]) for name in ("prbayes", "exact")}
        for key in ("mean", "sd")
    )
    off = (means["prbayes"] - means["exact"]) / sds["exact"]
    width = sds["prbayes"] / sds["exact"]
    distance = np.abs(off)
    result["median distance"] = np.median(distance, axis=0).tolist()
    result["distance of 99%"] = np.quantile(distance, 0.99, axis=0).tolist()
    result["largest distance"] = distance.max(axis=0).tolist()
    result["width"] = np.median(width, axis=0).tolist()
    return result


def row(name: str, number: int) -> dict[str, Any]:
    """Return the row of a data set."""
    problem = PROBLEMS[name]
    return data_set(problem, base_likelihood(name)[1], number)


@cache
def base_likelihood(name: str) -> tuple[pm.Model, SpecimenLikelihood]:
    """Return a model with the likelihood of a problem, whose first runs serve all data sets."""
    return likelihood_of(PROBLEMS[name])


STUDY = Study("likelihood_coverage", __doc__, PROBLEMS, row, 400, summary, has_rows=False)

if __name__ == "__main__":
    STUDY.main()
