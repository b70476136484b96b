"""Posterior given a metric's estimate, by the saddlepoint density of the score or of refits: offsets and widths.

Five studies, each against an exact posterior, on data sets with hyperparameters drawn from the prior:

- ``one``: y = x, a normal population. Priors are vague, bounded (ends within two standard errors) sharp
  (a quarter and half of a standard error), or in conflict with the data. For the Kullback-Leibler divergence the reference is the
  posterior of the full data, whose mean and standard deviation are sufficient. For the probability
  residual it is the posterior given the estimate: the density of the pivots of 20 000 standard refits.
- ``several``: outputs that are an invertible linear map of as many independent normal inputs, so that the
  posterior of the full data is known. Two hyperparameters an input. With ``--simulators`` each input has
  a simulator of its own, so that minimising takes less time.
- ``far``: y = x with the truth three prior standard deviations away and a small scatter; and, on ordinary
  data, Laplace approximations from points of the prior in place of the estimate.
- ``refits``: metrics whose gradient is no mean over specimens, by refits of synthetic data sets, on the
  data sets of ``one``. The references of the area metric and of the Cramer-von Mises distance are
  posteriors given the estimate (`benchmarks.refit_pivots`), that of the reverse divergence is the
  posterior of the full data. With ``--outputs 2`` two simulators, and so four hyperparameters.
- ``modes``: the response (x - 1)^2 under mu ~ N(0, 2), whose modes mirror each other: the share of the upper mode.

Offsets are in standard deviations of the reference, widths are ratios of standard deviations.

    uv run python -m benchmarks.saddlepoint one [--data-sets 20] [--sizes 10 20 50 200]
    uv run python -m benchmarks.saddlepoint several [--data-sets 10] [--sizes 20 50] [--outputs 3 4 8] [--simulators]
    uv run python -m benchmarks.saddlepoint far [--data-sets 20]
    uv run python -m benchmarks.saddlepoint refits [--data-sets 10] [--metrics area "reverse KLD"] [--outputs 1 2]
    uv run python -m benchmarks.saddlepoint modes [--data-sets 10]
"""

from __future__ import annotations

import argparse
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import numpy as np
import pymc as pm
from scipy import stats
from scipy.interpolate import RectBivariateSpline

import prbayes as prb
from benchmarks import record, refit_pivots
from prbayes.metrics.density import twice_silverman
from prbayes.posterior.importance import importance_sample, laplace
from prbayes.posterior.saddlepoint import (
    EstimateLikelihood,
    StoredScores,
    estimate_likelihood,
)
from prbayes.posterior.sample import modes_of
from prbayes.posterior.target import RefitLikelihood, Target, refit_likelihood

OUT = record.RESULTS / "saddlepoint.json"
METRICS = {"KLD": prb.KullbackLeibler(), "PR": prb.ProbabilityResidual()}
DRAWS = 1000
SIZES = {
    "one": [10, 20, 50, 200], "several": [20, 50], "far": [20], "refits": [10, 20, 50, 200], "modes": [20],
}  # fmt: skip


def cramer_von_mises(simulated: Any, observed: Any, weights: Any) -> Any:
    """Return the mean squared difference of distribution functions at the observed values."""
    values = np.sort(observed)
    below = [(weights * (simulated <= value)).sum(axis=-1) for value in values]
    steps = (np.arange(values.size) + 0.5) / values.size
    return ((np.stack(below, axis=-1) - steps) ** 2).mean(axis=-1)


BY_REFITS = {
    "area": prb.AreaMetric(),
    "reverse KLD": prb.KullbackLeibler(reverse=True),
    "Cramér-von Mises": prb.FunctionMetric(cramer_von_mises, weighted=True),
}
Likelihood = EstimateLikelihood | RefitLikelihood


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


def moments_on_grid(log_likelihood: Callable[[Any, Any], Any], prior: Prior, y: Any) -> Any:
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


def full_log_likelihood(y: Any) -> Callable[[Any, Any], Any]:
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


def estimate_log_likelihood(y: Any) -> Callable[[Any, Any], Any]:
    """Return that of a normal population given the minimiser of the residual."""
    (t,) = refits(y[None])
    spline, (a, b) = pivots(len(y))

    def function(mu: Any, log_sd: Any) -> Any:
        first, second = np.broadcast_arrays((t[0] - mu) * np.exp(-log_sd), t[1] - log_sd)
        inside = (first > a[0]) & (first < a[-1]) & (second > b[0]) & (second < b[-1])
        return np.where(inside, spline.ev(first, second) - log_sd, -1e3)

    return function


# -- studies --


def posterior(likelihood: Likelihood, starts: Any = None) -> Target:
    """Return the posterior of a likelihood, which begins at its point by default."""
    places = likelihood.starts[0][None] if starts is None else np.array(starts)
    return Target(likelihood.evaluator, likelihood.log_likelihood, places, likelihood.scale)


def sampled(likelihood: Likelihood, starts: Any, scale: Any) -> tuple[Any, dict[str, Any]]:
    """Return draws in unconstrained space, and diagnostics."""
    clock = time.process_time()
    density = posterior(likelihood).log_posterior
    modes = laplace(density, starts, scale)
    sample = importance_sample(density, modes, DRAWS, seed=0)
    figures = {"k": sample.pareto_k, "efficiency": sample.efficiency}
    return sample.draws, figures | {"seconds": time.process_time() - clock}


def given_estimate(
    model: pm.Model, function: Callable[[Any, Any], Likelihood] = estimate_likelihood
) -> tuple[Likelihood, dict[str, Any], dict[str, Any]]:
    """Return the likelihood given the optimum, draws by name, and figures."""
    optimum = prb.minimize(model=model, progressbar=False)
    clock = time.process_time()
    likelihood = function(optimum.evaluator, optimum)
    setup = time.process_time() - clock
    draws, figures = sampled(likelihood, likelihood.starts[0][None], likelihood.scale)
    support = likelihood.evaluator.support(likelihood.starts[0][None])
    effective = min(float(of["weight_ess"][0]) for of in support.values())
    if isinstance(likelihood, RefitLikelihood):
        points = len(likelihood.estimates)
    else:
        points = max(
            len(each.scores.values) for each in likelihood.groups if isinstance(each, StoredScores)
        )
    figures |= {
        "setup": setup,
        "effective": effective,
        "points": points,
        "converged": optimum.converged,
    }
    return likelihood, likelihood.evaluator.hyperparameters.constrained(draws), figures


def compared(draws: Any, reference: Any) -> dict[str, Any]:
    """Return offsets and widths of draws (n, d) against means and standard deviations (2, d)."""
    offsets = (draws.mean(axis=0) - reference[0]) / reference[1]
    return {"offset": offsets.tolist(), "width": (draws.std(axis=0) / reference[1]).tolist()}


def normal_model(prior: Prior, metric: Any, y: Any) -> pm.Model:
    """Return the model of y = x."""
    with pm.Model() as model:
        x = pm.Normal.dist(*prior.variables())
        prb.Simulator(
            "y", lambda x: x, x, observed=y, metric=metric, propagation=prb.Reweighted(1024)
        )
    return model


def one(name: str, size: int, prior_name: str, number: int) -> dict[str, Any]:
    """Return a row of the study of one output."""
    prior, y = drawn_data(size, prior_name, number)
    return pair_row(name, prior, y)


def drawn_data(size: int, prior_name: str, number: int) -> tuple[Prior, Any]:
    """Return a prior and a data set."""
    prior = PRIORS[prior_name](size)
    rng = np.random.default_rng([5, size, sorted(PRIORS).index(prior_name), number])
    drawn = float(prior.mean.rvs(random_state=rng)), float(prior.sd.rvs(random_state=rng))
    mean, sd = prior.truth or drawn
    return prior, rng.normal(mean, sd, size)


def by_refits(name: str, size: int, prior_name: str, number: int) -> dict[str, Any]:
    """Return a row of the study of refits."""
    prior, y = drawn_data(size, prior_name, number)
    reference = moments_on_grid(refits_reference(name, y), prior, y)
    _, values, figures = given_estimate(normal_model(prior, BY_REFITS[name], y), refit_likelihood)
    draws = np.stack([values["mu"], np.log(values["sigma"])], axis=1)
    return compared(draws, reference) | figures


def refits_reference(name: str, y: Any) -> Callable[[Any, Any], Any]:
    """Return the log-likelihood given the minimiser, of the reverse divergence that of all data."""
    if name in refit_pivots.REFITS:
        return refit_pivots.log_likelihood(name, y)
    return full_log_likelihood(y)


def modes_row(name: str, size: int, number: int) -> dict[str, Any]:
    """Return the share of the upper of two mirror modes, from refits, and the exact one."""
    rng = np.random.default_rng([21, size, number])
    y = (rng.normal(2, 0.5, size) - 1) ** 2
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1))
        prb.Simulator(
            "y", lambda x: (x - 1) ** 2, x, observed=y, metric=BY_REFITS[name],
            propagation=prb.Reweighted(1024),
        )  # fmt: skip
    optimum = prb.minimize(model=model, progressbar=False)
    likelihood = refit_likelihood(optimum.evaluator, optimum)
    target = posterior(likelihood, likelihood.starts)
    sample = importance_sample(target.log_posterior, modes_of(target) or [], DRAWS, seed=0)
    mu = likelihood.evaluator.hyperparameters.constrained(sample.draws)["mu"]
    means, log_sds = np.linspace(-3, 5, 401)[:, None, None], np.linspace(-2, 1, 150)[None, :, None]
    root, sds = np.sqrt(y), np.exp(log_sds)
    pair = np.logaddexp(
        stats.norm.logpdf(1 + root, means, sds), stats.norm.logpdf(1 - root, means, sds)
    )
    logs = pair.sum(axis=-1) + stats.norm.logpdf(means[..., 0], 0, 2)
    logs = logs + stats.halfnorm.logpdf(sds[..., 0]) + log_sds[..., 0]
    weights = np.exp(logs - logs.max())
    exact = float((weights * (means[..., 0] > 1)).sum() / weights.sum())
    figures = {"k": sample.pareto_k, "efficiency": sample.efficiency}
    return {"share": float((mu > 1).mean()), "exact share": exact} | figures


def pair_row(name: str, prior: Prior, y: Any) -> dict[str, Any]:
    """Return offsets and widths of mu and log sigma."""
    log_likelihood = {"KLD": full_log_likelihood, "PR": estimate_log_likelihood}[name](y)
    reference = moments_on_grid(log_likelihood, prior, y)
    _, values, figures = given_estimate(normal_model(prior, METRICS[name], y))
    draws = np.stack([values["mu"], np.log(values["sigma"])], axis=1)
    return compared(draws, reference) | figures


def several(name: str, size: int, outputs: int, number: int) -> dict[str, Any]:
    """Return a row of the study of several outputs, with two hyperparameters for each."""
    rng = np.random.default_rng([6, size, outputs, number])
    mixing = np.random.default_rng(outputs).normal(size=(outputs, outputs)) + 2 * np.eye(outputs)
    means, sds = rng.normal(0, 2, outputs), np.abs(rng.normal(0, 1, outputs)) + 0.1
    x = means + sds * rng.standard_normal((size, outputs))

    def response(*inputs: Any) -> Any:
        return np.stack(inputs, axis=-1) @ mixing

    with pm.Model() as model:
        pairs = [(pm.Normal(f"mu{j}", 0, 2), pm.HalfNormal(f"sigma{j}", 1)) for j in range(outputs)]
        inputs = [pm.Normal.dist(*pair) for pair in pairs]
        prb.Simulator(
            "y", response, *inputs, observed=x @ mixing, metric=prb.Joint(METRICS[name]),
            propagation=prb.Reweighted(64 * outputs),
        )  # fmt: skip
    return pairs_row(model, x)


def simulators(name: str, size: int, count: int, number: int) -> dict[str, Any]:
    """Return a row of as many independent simulators, with two hyperparameters each."""
    metric = (METRICS | BY_REFITS)[name]
    rng = np.random.default_rng([9, size, count, number])
    means, sds = rng.normal(0, 2, count), np.abs(rng.normal(0, 1, count)) + 0.1
    x = means + sds * rng.standard_normal((size, count))
    with pm.Model() as model:
        for j in range(count):
            inputs = pm.Normal.dist(pm.Normal(f"mu{j}", 0, 2), pm.HalfNormal(f"sigma{j}", 1))
            prb.Simulator(
                f"y{j}", lambda x: x, inputs, observed=x[:, j], metric=metric,
                propagation=prb.Reweighted(1024),
            )  # fmt: skip
    if name in BY_REFITS:
        return pairs_row(model, x, refit_likelihood, partial(refits_reference, name))
    return pairs_row(model, x)


def pairs_row(
    model: pm.Model,
    x: Any,
    function: Callable[[Any, Any], Likelihood] = estimate_likelihood,
    reference: Callable[[Any], Callable[[Any, Any], Any]] = full_log_likelihood,
) -> dict[str, Any]:
    """Return offsets and widths of the mean and log standard deviation of each input, (N, k)."""
    _, values, figures = given_estimate(model, function)
    draws, references = [], []
    for j, column in enumerate(x.T):
        draws += [values[f"mu{j}"], np.log(values[f"sigma{j}"])]
        references.append(moments_on_grid(reference(column), vague(len(x)), column))
    return compared(np.stack(draws, axis=1), np.concatenate(references, axis=1)) | figures


def far(name: str, number: int) -> dict[str, Any]:
    """Return a row with the truth far from the middle of the prior, in mean and scatter."""
    rng = np.random.default_rng([7, number])
    return pair_row(name, vague(20), rng.normal(6, 0.05, 20))


def starts(name: str, number: int, count: int = 32) -> dict[str, Any]:
    """Return how many points of the prior reach the mode by Laplace's approximation alone."""
    rng = np.random.default_rng([8, number])
    y = rng.normal(1, 0.5, 20)
    optimum = prb.minimize(model=normal_model(vague(20), METRICS[name], y), progressbar=False)
    likelihood = estimate_likelihood(optimum.evaluator, optimum)
    evaluator = likelihood.evaluator
    density = posterior(likelihood).log_posterior
    (best,) = laplace(density, likelihood.starts[0][None], likelihood.scale)
    points = evaluator.hyperparameters.prior_points(count, number)
    possible = np.isfinite(density(points))
    arrived = 0
    for start in points[possible]:
        try:
            (mode,) = laplace(density, start[None], likelihood.scale)
        except ValueError:
            continue
        away = np.linalg.solve(np.linalg.cholesky(best.covariance), mode.mode - best.mode)
        arrived += bool(mode.converged and np.linalg.norm(away) < 0.1)
    return {"finite": int(possible.sum()), "arrived": arrived, "starts": count}


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the figures of a cell."""
    failed = [row for row in rows if "error" in row]
    good = [row for row in rows if "error" not in row]
    result: dict[str, Any] = {"data sets": len(rows), "failed": len(failed)}
    if good and "arrived" in good[0]:
        return result | {
            key: int(sum(row[key] for row in good)) for key in ("starts", "finite", "arrived")
        }
    if not good:
        return result
    if "share" in good[0]:
        errors = np.array([row["share"] - row["exact share"] for row in good])
        return result | {
            "rms error of the share": float(np.sqrt((errors**2).mean())),
            "largest error of the share": float(np.abs(errors).max()),
            "largest k": max(row["k"] for row in good),
        }
    offsets, widths = (np.array([row[key] for row in good]) for key in ("offset", "width"))
    reliable = [row["k"] <= 0.7 and row["efficiency"] >= 0.25 for row in good]
    return result | {
        "mean offset": offsets.mean(axis=0).round(3).tolist(),
        "rms offset": np.sqrt((offsets**2).mean(axis=0)).round(3).tolist(),
        "largest offset": np.abs(offsets).max(axis=0).round(3).tolist(),
        "mean width": widths.mean(axis=0).round(3).tolist(),
        "smallest width": widths.min(axis=0).round(3).tolist(),
        "largest width": widths.max(axis=0).round(3).tolist(),
        "unreliable": len(reliable) - sum(reliable),
        "seconds": float(np.median([row["setup"] + row["seconds"] for row in good])),
        "effective": float(np.median([row["effective"] for row in good])),
    }  # fmt: skip


def cells(arguments: argparse.Namespace) -> dict[str, Callable[[int], dict[str, Any]]]:
    """Return the cells of a study by name."""
    result: dict[str, Callable[[int], dict[str, Any]]] = {}
    default = {"refits": list(BY_REFITS), "modes": ["area", "reverse KLD"]}
    for name in arguments.metrics or default.get(arguments.study, list(METRICS)):
        for size in arguments.sizes or SIZES[arguments.study]:
            if arguments.study == "one":
                # In conflict the pivots' density is not known where it is needed.
                for prior in PRIORS if name == "KLD" else list(PRIORS)[:3]:
                    result[f"one, {name}, N = {size}, {prior}"] = partial(one, name, size, prior)
            if arguments.study == "refits":
                for prior in PRIORS if 1 in arguments.outputs else []:
                    result[f"refits, {name}, N = {size}, {prior}"] = partial(
                        by_refits, name, size, prior
                    )
                if 2 in arguments.outputs:
                    result[f"refits, {name}, N = {size}, two simulators"] = partial(
                        simulators, name, size, 2
                    )
            if arguments.study == "modes":
                result[f"modes, {name}, N = {size}"] = partial(modes_row, name, size)
            if arguments.study == "several":
                for outputs in arguments.outputs:
                    kind = "simulators" if arguments.simulators else "outputs"
                    function = simulators if arguments.simulators else several
                    cell = f"several, {name}, N = {size}, {outputs} {kind}"
                    result[cell] = partial(function, name, size, outputs)
        if arguments.study == "far":
            result[f"far, {name}"] = partial(far, name)
            result[f"starts, {name}"] = partial(starts, name)
    return result


def main() -> None:
    """Run what is missing."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("study", choices=list(SIZES))
    parser.add_argument("--data-sets", type=int, default=20)
    parser.add_argument("--sizes", type=int, nargs="+")
    parser.add_argument("--outputs", type=int, nargs="+")
    parser.add_argument("--simulators", action="store_true")
    parser.add_argument("--metrics", nargs="+", choices=[*METRICS, *BY_REFITS])
    arguments = parser.parse_args()
    arguments.outputs = arguments.outputs or ([1] if arguments.study == "refits" else [3, 4, 8])
    logging.disable(logging.WARNING)
    found = record.load(OUT, {"rows": {}, "summary": {}})
    for cell, function in cells(arguments).items():
        rows = found["rows"].setdefault(cell, [])
        for number in range(len(rows), arguments.data_sets):
            try:
                rows.append(function(number))
            except (ValueError, np.linalg.LinAlgError) as error:
                rows.append({"error": str(error)})
            found["summary"][cell] = summary(rows)
            record.save(OUT, found)
        print(cell, found["summary"].get(cell), flush=True)


if __name__ == "__main__":
    main()
