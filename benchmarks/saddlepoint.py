"""Posterior given a metric's estimate, by the saddlepoint density of the score or of refits: offsets and widths.

Three studies, each against an exact posterior, on data sets with hyperparameters drawn from the prior:

- ``one``: y = x, a normal population. Priors are vague, bounded (ends within two standard errors), sharp
  (a quarter and half of a standard error), or in conflict with the data. For the Kullback-Leibler
  divergence the reference is the posterior of the full data, whose mean and standard deviation are
  sufficient. For the probability residual it is the posterior given the estimate: the density of the
  pivots of 20 000 standard refits.
- ``several``: outputs that are an invertible linear map of as many independent normal inputs, so that the
  posterior of the full data is known, or as many simulators of one input. Two hyperparameters an input.
- ``refits``: the area metric, whose gradient is no mean over specimens, by refits of synthetic data
  sets, on the data sets of ``one``. The reference is the posterior given the estimate. Pivots are drawn
  by importance sampling there: data sets are drawn from populations spread over a disc of standard
  errors, and weighted to the standard one, so that the density is known in the tails, too.

Offsets are in standard deviations of the reference, widths are ratios of standard deviations.

    uv run python -m benchmarks.saddlepoint --cells "one*" [--data-sets 20]
    uv run python -m benchmarks.saddlepoint --cells "several*" --data-sets 4
    uv run python -m benchmarks.saddlepoint --cells "refits*" --data-sets 10
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from itertools import product
from typing import Any

import numpy as np
import pymc as pm
from scipy import stats
from scipy.interpolate import RectBivariateSpline
from scipy.spatial import cKDTree
from scipy.special import logsumexp

import prbayes as prb
from benchmarks.metrics import METRICS
from benchmarks.study import Study
from prbayes.metrics.density import twice_silverman
from prbayes.numerics.modes import laplace
from prbayes.posterior.importance import importance_sample
from prbayes.posterior.saddlepoint import EstimateLikelihood, estimate_likelihood
from prbayes.posterior.target import RefitLikelihood, Target, refit_likelihood

DRAWS = 1000
RADIUS = 6.5  # of the disc of populations, in standard errors
DEGREE = 6
Likelihood = EstimateLikelihood | RefitLikelihood
Function = Callable[[Any, Any], Any]


@dataclass(frozen=True)
class Prior:
    """A prior of mean and standard deviation: PyMC variables, SciPy distributions."""

    name: str
    variables: Callable[[], tuple[Any, Any]]
    mean: Any
    sd: Any
    truth: tuple[float, float] | None = None  # drawn from the prior if None


def vague(size: int) -> Prior:
    """Return a prior that leaves all to the data."""
    return Prior(
        "vague", lambda: (pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1)),
        stats.norm(0, 2), stats.halfnorm(),
    )  # fmt: skip


def bounded(size: int) -> Prior:
    """Return uniform priors: of the mean two standard errors wide, of the standard deviation to .6."""
    upper = 2 * 0.5 / np.sqrt(size)
    return Prior(
        "bounded", lambda: (pm.Uniform("mu", 0, upper), pm.Uniform("sigma", 0, 0.6)),
        stats.uniform(0, upper), stats.uniform(0, 0.6),
    )  # fmt: skip


def sharp(size: int) -> Prior:
    """Return priors with a quarter and half of the data's standard error."""
    mean, log_sd = 0.5 / np.sqrt(size) / 4, 1 / np.sqrt(2 * size) / 2
    return Prior(
        "sharp",
        lambda: (pm.Normal("mu", 1, mean), pm.LogNormal("sigma", np.log(0.5), log_sd)),
        stats.norm(1, mean), stats.lognorm(log_sd, scale=0.5),
    )  # fmt: skip


def conflict(size: int) -> Prior:
    """Return priors as wide as the data's standard errors, four and three of these from the truth."""
    mean, log_sd = 0.5 / np.sqrt(size), 1 / np.sqrt(2 * size)
    center, scale = 1 + 4 * mean, 0.5 * np.exp(3 * log_sd)
    return Prior(
        "conflict",
        lambda: (pm.Normal("mu", center, mean), pm.LogNormal("sigma", np.log(scale), log_sd)),
        stats.norm(center, mean), stats.lognorm(log_sd, scale=scale), (1.0, 0.5),
    )  # fmt: skip


PRIORS = {"vague": vague, "bounded": bounded, "sharp": sharp, "conflict": conflict}


# -- references --


def moments_on_grid(log_likelihood: Function, prior: Prior, y: Any) -> Any:
    """Return means and standard deviations of mu and log sigma, (2, 2), of a posterior on a grid."""
    error = y.std() / np.sqrt(len(y))
    mu = np.linspace(y.mean() - 15 * error, y.mean() + 15 * error, 601)[:, None]
    log_sd = np.log(y.std()) + np.linspace(-2.5, 2.5, 600)[None]
    with np.errstate(divide="ignore"):
        log_prior = prior.mean.logpdf(mu) + prior.sd.logpdf(np.exp(log_sd)) + log_sd
    logs = log_likelihood(mu, log_sd) + log_prior
    weights = np.exp(logs - logs.max())
    weights /= weights.sum()
    means = np.array([(weights * mu).sum(), (weights * log_sd).sum()])
    squares = [(weights * (mu - means[0]) ** 2).sum(), (weights * (log_sd - means[1]) ** 2).sum()]
    return np.stack([means, np.sqrt(squares)])


def full_log_likelihood(y: Any) -> Function:
    """Return that of a normal population."""
    mean, variance, size = y.mean(), y.var(), len(y)
    return lambda mu, log_sd: (
        -size * log_sd - size * ((mean - mu) ** 2 + variance) * np.exp(-2 * log_sd) / 2
    )


def refits(y: Any, steps: int = 60) -> Any:
    """Return the minimisers (mean, log sd) of the residual for data sets (S, N), in closed form.

    With one bandwidth h on both sides the residual is, up to a constant and a factor,
    1 / (2 sqrt(pi) sqrt(s^2 + h^2)) - 2 mean_i N(y_i; mu, s^2 + 2 h^2).
    """
    weights = np.full(y.shape[1], 1 / y.shape[1])
    h = np.array([twice_silverman(row, weights) for row in y])[:, None]

    def residual(t: Any) -> Any:
        variance = np.exp(2 * t[..., 1:])
        away = y - t[..., :1]
        cross = stats.norm.pdf(away, scale=np.sqrt(variance + 2 * h**2)).mean(axis=-1)
        return 0.5 / np.sqrt(np.pi * (variance + h**2)[..., 0]) - 2 * cross

    t = np.stack([y.mean(axis=1), np.log(y.std(axis=1))], axis=1)
    scale = y.std(axis=1)
    for _ in range(steps):
        step = 1e-3 * np.stack([scale, np.ones(len(y))], axis=1)
        e, f = step * [1, 0], step * [0, 1]
        f0 = residual(t)
        values = {
            (i, j): residual(t + i * e + j * f) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j
        }
        g = np.stack([values[1, 0] - values[-1, 0], values[0, 1] - values[0, -1]], axis=1) / (
            2 * step
        )
        a = (values[1, 0] + values[-1, 0] - 2 * f0) / step[:, 0] ** 2
        c = (values[0, 1] + values[0, -1] - 2 * f0) / step[:, 1] ** 2
        b = (values[1, 1] - values[1, -1] - values[-1, 1] + values[-1, -1]) / (
            4 * step[:, 0] * step[:, 1]
        )
        hessian = np.stack([np.stack([a, b], -1), np.stack([b, c], -1)], -2)
        units = np.stack([1 / scale, np.ones(len(y))], axis=1)
        scaled = hessian / (units[:, :, None] * units[:, None, :])
        eigenvalues, vectors = np.linalg.eigh(scaled)
        floor = 1e-3 * np.abs(eigenvalues).max(axis=1, keepdims=True)
        inverse = (vectors / np.maximum(np.abs(eigenvalues), floor)[:, None, :]) @ vectors.swapaxes(
            1, 2
        )
        move = -np.einsum("sij,sj->si", inverse, g / units)
        move *= 0.5 / np.abs(move).max(axis=1, keepdims=True).clip(0.5)
        shorter = np.stack([residual(t + share * move / units) for share in (1, 0.5, 0.1, 0.0)])
        share = np.array([1, 0.5, 0.1, 0.0])[shorter.argmin(axis=0)]
        t = t + share[:, None] * move / units
    return t


@cache
def pivots(size: int) -> Any:
    """Return the log-density of the estimate of standard normal data as a spline of both elements."""
    y = np.random.default_rng([3, size]).standard_normal((20000, size))
    t = refits(y)
    inside = t[:, 1] > -3
    density = stats.gaussian_kde(t[inside].T, 0.5 * inside.sum() ** (-1 / 6))
    a = np.linspace(t[inside, 0].min() - 0.3, t[inside, 0].max() + 0.3, 121)
    b = np.linspace(t[inside, 1].min() - 0.3, t[inside, 1].max() + 0.3, 120)
    grid = np.stack(np.meshgrid(a, b, indexing="ij")).reshape(2, -1)
    logs = np.log(np.maximum(density(grid), 1e-300)).reshape(121, 120)
    return RectBivariateSpline(a, b, np.maximum(logs, logs.max() - 40), kx=1, ky=1), (a, b)


def estimate_log_likelihood(y: Any) -> Function:
    """Return that of a normal population given the minimiser of the residual."""
    (t,) = refits(y[None])
    spline, (a, b) = pivots(len(y))

    def function(mu: Any, log_sd: Any) -> Any:
        first, second = np.broadcast_arrays((t[0] - mu) * np.exp(-log_sd), t[1] - log_sd)
        inside = (first > a[0]) & (first < a[-1]) & (second > b[0]) & (second < b[-1])
        return np.where(inside, spline.ev(first, second) - log_sd, -1e3)

    return function


def area_refits(y: Any, steps: int = 60) -> Any:
    """Return minimisers of the area metric for data sets (S, N).

    The area between distribution functions is that between quantile functions, |mu + sigma z(p) - y(p)|
    integrated over p: a regression by least absolute deviations.
    """
    size = y.shape[1]
    nodes = max(4, 160 // size)
    z = stats.norm.ppf((np.arange(size * nodes) + 0.5) / (size * nodes))
    result = []
    for block in np.array_split(y, max(1, y.size * nodes // 2_000_000)):
        values = np.repeat(np.sort(block, axis=1), nodes, axis=1)
        mean, sd = block.mean(axis=1), block.std(axis=1)
        for _ in range(steps):
            away = np.abs(values - mean[:, None] - sd[:, None] * z)
            w = 1 / np.maximum(away, 1e-3 * sd[:, None])
            s0, s1, s2 = w.sum(axis=1), w @ z, w @ z**2
            r0, r1 = (w * values).sum(axis=1), (w * values) @ z
            determinant = s0 * s2 - s1**2
            mean = (s2 * r0 - s1 * r1) / determinant
            sd = np.maximum((s0 * r1 - s1 * r0) / determinant, 1e-3 * sd)
        result.append(np.stack([mean, np.log(sd)], axis=1))
    return np.concatenate(result)


def terms(u: Any) -> Any:
    """Return monomials of two variables, (S, terms)."""
    pairs = [(i, j) for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i)]
    return np.stack([u[:, 0] ** i * u[:, 1] ** j for i, j in pairs], axis=1)


@cache
def area_pivots(size: int, count: int = 20000) -> Any:
    """Return standard errors and coefficients of the log-density of the pivots of the area metric."""
    rng = np.random.default_rng([11, size])
    units = np.array([1.1 / np.sqrt(size), 1.1 / np.sqrt(2 * size)])
    angle = 2 * np.pi * rng.random(count)
    radius = RADIUS * np.sqrt(rng.random(count))
    mean, log_sd = (units * np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)).T
    y = mean[:, None] + np.exp(log_sd)[:, None] * rng.standard_normal((count, size))
    u = area_refits(y) / units
    first, second = y.mean(axis=1)[:, None], y.var(axis=1)[:, None]
    mixture = []
    for i in range(0, count, 1000):
        squares = (first[i : i + 1000] - mean) ** 2 + second[i : i + 1000]
        logs = -size * (log_sd + squares * np.exp(-2 * log_sd) / 2)
        mixture.append(logsumexp(logs, axis=1))
    log_ratio = -size * (first**2 + second)[:, 0] / 2 - np.concatenate(mixture)
    inside = (np.abs(u) < 6).all(axis=1)
    neighbours = cKDTree(u).query_ball_point(u[inside], 0.5, return_length=True)
    x, y = terms(u[inside] / 4), log_ratio[inside]
    q, r = np.linalg.qr(x)
    coefficients = q.T @ y
    for _ in range(30):  # E[ratio | u] by a gamma regression with a log link
        excess = np.exp(np.clip(y - q @ coefficients, -20, 20)) - 1
        coefficients = coefficients + np.clip(q.T @ excess, -50, 50)
    log_mixture = np.linalg.lstsq(x, np.log(neighbours), rcond=None)[0]
    return units, np.linalg.solve(r, coefficients) + log_mixture


def area_log_likelihood(y: Any) -> Function:
    """Return that of a normal population given the minimiser of the area metric."""
    (t,) = area_refits(y[None])
    units, coefficients = area_pivots(len(y))

    def function(mu: Any, log_sd: Any) -> Any:
        first, second = np.broadcast_arrays((t[0] - mu) * np.exp(-log_sd), t[1] - log_sd)
        u = np.stack([first.ravel(), second.ravel()], axis=1) / units
        inside = (np.abs(u) < 5.5).all(axis=1)
        logs = np.where(inside, terms(u / 4) @ coefficients, -1e3)
        return logs.reshape(first.shape) - log_sd

    return function


# -- studies --


def sampled(likelihood: Likelihood) -> tuple[Any, dict[str, Any]]:
    """Return draws in unconstrained space, and diagnostics."""
    clock = time.process_time()
    start = likelihood.starts[0][None]
    target = Target(likelihood.evaluator, likelihood.log_likelihood, start, likelihood.scale)
    modes = laplace(target.log_posterior, start, likelihood.scale)
    sample = importance_sample(target.log_posterior, modes, DRAWS, seed=0)
    figures = {"k": sample.pareto_k, "efficiency": sample.efficiency}
    return sample.draws, figures | {"seconds": time.process_time() - clock}


def given_estimate(metric: str, model: pm.Model) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return draws by name given the optimum, and figures."""
    optimum = prb.minimize(model=model)
    function: Any = refit_likelihood if metric == "area" else estimate_likelihood
    clock = time.process_time()
    likelihood = function(optimum.evaluator, optimum)
    setup = time.process_time() - clock
    draws, figures = sampled(likelihood)
    figures["seconds"] += setup
    return likelihood.evaluator.hyperparameters.constrained(draws), figures


def compared(draws: Any, reference: Any) -> dict[str, Any]:
    """Return offsets and widths of draws (n, d) against means and standard deviations (2, d)."""
    offsets = (draws.mean(axis=0) - reference[0]) / reference[1]
    return {"offset": offsets.tolist(), "width": (draws.std(axis=0) / reference[1]).tolist()}


REFERENCES = {
    "KLD": full_log_likelihood, "PR": estimate_log_likelihood, "area": area_log_likelihood,
}  # fmt: skip


def one(metric: str, size: int, prior_name: str, number: int) -> dict[str, Any]:
    """Return a row of one output: offsets and widths of mu and log sigma."""
    prior = PRIORS[prior_name](size)
    rng = np.random.default_rng([5, size, sorted(PRIORS).index(prior_name), number])
    drawn = float(prior.mean.rvs(random_state=rng)), float(prior.sd.rvs(random_state=rng))
    mean, sd = prior.truth or drawn
    y = rng.normal(mean, sd, size)
    with pm.Model() as model:
        x = pm.Normal.dist(*prior.variables())
        stored = prb.Reweighted(1024)
        prb.Simulator("y", lambda x: x, x, observed=y, metric=METRICS[metric], propagation=stored)
    reference = moments_on_grid(REFERENCES[metric](y), prior, y)
    values, figures = given_estimate(metric, model)
    draws = np.stack([values["mu"], np.log(values["sigma"])], axis=1)
    return compared(draws, reference) | figures


def populations(rng: np.random.Generator, size: int, count: int) -> Any:
    """Draw specimens of as many inputs, (size, count)."""
    means, sds = rng.normal(0, 2, count), np.abs(rng.normal(0, 1, count)) + 0.1
    return means + sds * rng.standard_normal((size, count))


def outputs(metric: str, size: int, count: int, number: int) -> dict[str, Any]:
    """Return a row of several outputs, with two hyperparameters for each."""
    rng = np.random.default_rng([6, size, count, number])
    mixing = np.random.default_rng(count).normal(size=(count, count)) + 2 * np.eye(count)
    x = populations(rng, size, count)

    def response(*inputs: Any) -> Any:
        return np.stack(inputs, axis=-1) @ mixing

    with pm.Model() as model:
        pairs = [(pm.Normal(f"mu{j}", 0, 2), pm.HalfNormal(f"sigma{j}", 1)) for j in range(count)]
        inputs = [pm.Normal.dist(*pair) for pair in pairs]
        prb.Simulator(
            "y", response, *inputs, observed=x @ mixing, metric=prb.Joint(METRICS[metric]),
            propagation=prb.Reweighted(64 * count),
        )  # fmt: skip
    return pairs_row(metric, model, x)


def simulators(metric: str, size: int, count: int, number: int) -> dict[str, Any]:
    """Return a row of as many independent simulators, with two hyperparameters each."""
    x = populations(np.random.default_rng([9, size, count, number]), size, count)
    with pm.Model() as model:
        for j in range(count):
            inputs = pm.Normal.dist(pm.Normal(f"mu{j}", 0, 2), pm.HalfNormal(f"sigma{j}", 1))
            prb.Simulator(
                f"y{j}", lambda x: x, inputs, observed=x[:, j], metric=METRICS[metric],
                propagation=prb.Reweighted(1024),
            )  # fmt: skip
    return pairs_row(metric, model, x)


def pairs_row(metric: str, model: pm.Model, x: Any) -> dict[str, Any]:
    """Return offsets and widths of the mean and log standard deviation of each input, (N, k)."""
    values, figures = given_estimate(metric, model)
    draws, references = [], []
    for j, column in enumerate(x.T):
        draws += [values[f"mu{j}"], np.log(values[f"sigma{j}"])]
        reference = full_log_likelihood(column)
        references.append(moments_on_grid(reference, vague(len(x)), column))
    return compared(np.stack(draws, axis=1), np.concatenate(references, axis=1)) | figures


def row(cell: str, number: int) -> dict[str, Any]:
    """Return the row of a data set."""
    study, metric, size, case = cell.split(", ")
    n = int(size.removeprefix("N = "))
    if study != "several":
        return one(metric, n, case, number)
    count, kind = case.split()
    return (outputs if kind == "outputs" else simulators)(metric, n, int(count), number)


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the figures of a cell."""
    good = [row for row in rows if "error" not in row]
    result: dict[str, Any] = {"data sets": len(rows), "failed": len(rows) - len(good)}
    if not good:
        return result
    offsets, widths = (np.array([row[key] for row in good]) for key in ("offset", "width"))
    return result | {
        "rms offset": np.sqrt((offsets**2).mean(axis=0)).round(3).tolist(),
        "largest offset": np.abs(offsets).max(axis=0).round(3).tolist(),
        "mean width": widths.mean(axis=0).round(3).tolist(),
        "smallest width": widths.min(axis=0).round(3).tolist(),
        "largest width": widths.max(axis=0).round(3).tolist(),
        "seconds": float(np.median([row["seconds"] for row in good])),
    }


def cells() -> list[str]:
    """Return the names of the cells."""
    names = []
    for metric, size, prior in product(("KLD", "PR"), (10, 20, 50, 200), PRIORS):
        # In conflict the density of PR's pivots is not known where it is needed.
        if (metric, prior) != ("PR", "conflict"):
            names.append(f"one, {metric}, N = {size}, {prior}")
    cases = (
        "KLD, 3 outputs",
        "PR, 3 outputs",
        "KLD, 4 outputs",
        "KLD, 4 simulators",
        "KLD, 8 simulators",
    )
    names += ["several, {}, N = 20, {}".format(*case.split(", ")) for case in cases]
    return names + [f"refits, area, N = {size}, {prior}" for size in (10, 20) for prior in PRIORS]


FAILURES = (ValueError, np.linalg.LinAlgError)
STUDY = Study("saddlepoint", __doc__, cells(), row, 20, summary, failures=FAILURES)

if __name__ == "__main__":
    STUDY.main()
