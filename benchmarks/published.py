"""Published data sets: posteriors beside those of quadratures of the same models.

- *lasers*, *wear*: paths of degradation of 15 lasers and of 12 metal specimens (Meeker and Escobar,
  1998), and the probability F(t) that a lifetime is below t (`examples/degradation.py`).
- *fission gas*: 31 experiments, each with a function of its own, under the priors of OpenTURNS'
  worked answer (`examples/fission_gas`). The population is a truncated normal one. *published*
  is the posterior that the published sampler has, without the mass of the population in its
  density.

A row has the reference's mean and standard deviation of each quantity, and the posterior's.

    OMP_NUM_THREADS=1 uv run python -m benchmarks.published
"""

from __future__ import annotations

import runpy
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.linalg import block_diag
from scipy.special import logsumexp, ndtr, roots_hermite, roots_legendre

import prbayes as prb
from benchmarks.study import Study

EXAMPLES = Path(__file__).parents[1] / "examples"
LEVELS = (0.055, 0.945)  # ends of an 89 % interval
Draws = dict[str, Any]  # weighted values of each quantity, all (S,), and their "weight"


def nodes(count: int, low: float, high: float) -> tuple[Any, Any]:
    """Return nodes and weights of Gauss-Legendre quadrature between two ends."""
    x, w = roots_legendre(count)
    return low + (high - low) * (x + 1) / 2, w * (high - low) / 2


def grid(*axes: tuple[Any, Any]) -> tuple[list[Any], Any]:
    """Return the points of a product of rules, each (S,), and their weights, (S,)."""
    points = [x.ravel() for x in np.meshgrid(*(x for x, _ in axes), indexing="ij")]
    weights = [w.ravel() for w in np.meshgrid(*(w for _, w in axes), indexing="ij")]
    return points, np.prod(weights, axis=0)


def of_logs(values: Draws, logs: Any, weights: Any) -> Draws:
    """Return values with weights from log-densities and those of a rule."""
    return values | {"weight": weights * np.exp(logs - logs.max())}


def normal_logs(x: Any, mean: float, sd: float) -> Any:
    """Return log-densities of a normal variable without their constant."""
    return -(((x - mean) / sd) ** 2) / 2


def laser_posterior(readings: Any, times: Any, at: list[int]) -> Draws:
    """Return the exact posterior of the lasers; the rate is integrated around each one's fit."""
    (mu, log_sigma, log_error), weights = grid(
        nodes(28, 0.3, 1.1),
        nodes(28, np.log(0.1), np.log(0.7)),
        nodes(20, np.log(0.16), np.log(0.27)),
    )
    sigma, error = np.exp(log_sigma), np.exp(log_error)
    square = times @ times
    fits = readings @ times / square
    rest = ((readings - np.outer(fits, times)) ** 2).sum()
    x, w = roots_hermite(16)
    logs = -readings.size * log_error - rest / (2 * error**2)
    for fit in fits:
        rate = fit + np.sqrt(2 / square) * error[:, None] * x
        density = -np.log(rate * sigma[:, None]) + normal_logs(
            np.log(rate), mu[:, None], sigma[:, None]
        )
        logs = logs + np.log(error) + logsumexp(density, b=w, axis=1)
    logs += (
        normal_logs(mu, np.log(2), 0.5) + normal_logs(sigma, 0, 0.5) + normal_logs(error, 0, 0.5)
    )
    values = {"mu": mu, "sigma": sigma, "error": error}
    values |= {f"F({t})": ndtr((np.log(t / 10) + mu) / sigma) for t in at}
    return of_logs(values, logs + log_sigma + log_error, weights)


def wear_posterior(readings: Any, log_weight: Any, times: Any, at: list[int]) -> Draws:
    """Return draws of the exact posterior of the wear: given the spreads it is normal."""
    spreads, weights = grid(
        nodes(20, np.log(0.03), np.log(0.6)), nodes(20, np.log(0.004), np.log(0.12)),
        nodes(16, np.log(0.035), np.log(0.075)),
    )  # fmt: skip
    level, slope, error = np.exp(spreads)
    path = np.stack([np.ones_like(times), times], axis=1)
    designs = [path @ block_diag([1.0, x], [1.0, x]) for x in log_weight]
    center, width = np.array([np.log(10), 1, 0.2, 0]), np.array([1, 1, 0.2, 0.2])
    logs, means, roots = [], [], []
    for a, b, e in zip(level, slope, error, strict=True):
        covariance = path @ np.diag([a**2, b**2]) @ path.T + e**2 * np.eye(len(times))
        inverse, (_, logdet) = np.linalg.inv(covariance), np.linalg.slogdet(covariance)
        precision = np.diag(width**-2.0) + sum(d.T @ inverse @ d for d in designs)
        residuals = [y - d @ center for d, y in zip(designs, readings, strict=True)]
        score = sum(d.T @ inverse @ r for d, r in zip(designs, residuals, strict=True))
        fitted = sum(r @ inverse @ r for r in residuals) - score @ np.linalg.solve(precision, score)
        logs.append(-(len(readings) * logdet + np.linalg.slogdet(precision)[1] + fitted) / 2)
        means.append(center + np.linalg.solve(precision, score))
        roots.append(np.linalg.cholesky(np.linalg.inv(precision)))
    prior = [normal_logs(x, 0, s) for x, s in ((level, 0.5), (slope, 0.1), (error, 0.2))]
    jacobian = np.sum(spreads, axis=0)
    mass = weights * np.exp(logs - np.max(logs) + sum(prior) + jacobian)
    rng = np.random.default_rng(0)
    rows = rng.choice(len(mass), 40_000, p=mass / mass.sum())
    noise = rng.standard_normal((len(rows), 4, 1))
    drawn = np.array(means)[rows] + (np.array(roots)[rows] @ noise)[..., 0]
    names = ("level", "level_weight", "slope", "slope_weight")
    values = dict(zip(names, drawn.T, strict=True))
    values |= {"spread_level": level[rows], "spread_slope": slope[rows], "error": error[rows]}
    for t in at:
        x = np.log(t / 30)
        mean = drawn @ np.kron([1, x], [1, np.log(2)])
        sd = np.hypot(values["spread_level"], x * values["spread_slope"])
        values[f"F({t})"] = ndtr((mean - np.log(50)) / sd)
    return values | {"weight": np.ones(len(rows))}


def truncated_rule(low: float, high: float, sds: tuple[float, float], count: int, m: int) -> Any:
    """Return nodes of an input, its weighted densities, (S, count), means, log sds and log masses."""
    x, w = nodes(count, low, high)
    (mu, log_sigma), weights = grid(nodes(m, low, high), nodes(m, *np.log(sds)))
    sigma = np.exp(log_sigma)[:, None]
    density = np.exp(normal_logs(x, mu[:, None], sigma)) / sigma * w
    mass = ndtr((high - mu) / sigma[:, 0]) - ndtr((low - mu) / sigma[:, 0])
    return x, density, mu, log_sigma, weights, np.log(mass)


def fission_posterior(functions: Any, readings: Any, errors: Any, normalised: bool) -> Draws:
    """Return the posterior of fission gas on a grid of the four hyperparameters."""
    x, f, *of_diff, log_mass = truncated_rule(0.1, 40, (0.1, 40), 320, 40)
    z, g, *of_crack, other_mass = truncated_rule(1e-4, 1, (0.1, 10), 80, 36)
    inputs = np.meshgrid(x, z, indexing="ij")
    logs: Any = 0.0
    for function, y, sd in zip(functions, readings, errors, strict=True):
        density = np.exp(normal_logs(function(*inputs), y, sd))
        logs = logs + np.log(np.maximum(f @ density @ g.T, 1e-300))
    if normalised:
        logs = logs - len(readings) * (log_mass[:, None] + other_mass)
    values = {}
    for name, (mu, log_sigma, _), axis in (("diff", of_diff, 0), ("crack", of_crack, 1)):
        shape = (-1, 1) if axis == 0 else (1, -1)
        values[f"mu_{name}"] = np.broadcast_to(mu.reshape(shape), logs.shape).ravel()
        values[f"log_sigma_{name}"] = np.broadcast_to(log_sigma.reshape(shape), logs.shape).ravel()
    return of_logs(values, logs.ravel(), np.outer(of_diff[2], of_crack[2]).ravel())


def moments(draws: Draws) -> dict[str, list[float]]:
    """Return mean, standard deviation and 89 % interval of each quantity."""
    weight = draws["weight"] / draws["weight"].sum()
    result = {}
    for name, value in draws.items():
        if name == "weight":
            continue
        mean = float(weight @ value)
        sd = float(np.sqrt(weight @ (value - mean) ** 2))
        order = np.argsort(value)
        ends = np.interp(LEVELS, np.cumsum(weight[order]), value[order])
        result[name] = [mean, sd, *ends.tolist()]
    return result


def degradation(cell: str) -> tuple[Any, Draws, Callable[[Draws], Draws]]:
    """Return the model of a degradation, its reference, and F(t) by draws of the posterior."""
    example = runpy.run_path(str(EXAMPLES / "degradation.py"))
    at = list(example["REFERENCE"][cell])
    model, *_ = example[cell]()
    if cell == "lasers":
        table = np.loadtxt(example["DATA"] / "lasers.csv", delimiter=",", skiprows=2)
        reference = laser_posterior(table[:, 1:].T, table[:, 0] / 1000, at)
        return model, reference, lambda d: {
            f"F({t})": ndtr((np.log(t / 10) + d["mu"]) / d["sigma"]) for t in at
        }  # fmt: skip
    table = np.loadtxt(example["DATA"] / "wear.csv", delimiter=",", skiprows=1)
    times = np.log(np.array([2, 5, 10, 20, 50, 100, 200, 500]) / 30)
    reference = wear_posterior(np.log(table[:, 2:]), np.log(table[:, 1] / 50), times, at)

    def failed(d: Draws) -> Draws:
        mean = d["level"] + np.log(2) * d["level_weight"]
        slope = d["slope"] + np.log(2) * d["slope_weight"]
        result = {}
        for t in at:
            x = np.log(t / 30)
            sd = np.hypot(d["spread_level"], x * d["spread_slope"])
            result[f"F({t})"] = ndtr((mean + slope * x - np.log(50)) / sd)
        return result

    return model, reference, failed


def fission_gas(cell: str) -> tuple[Any, Draws, Callable[[Draws], Draws]]:
    """Return the model of fission gas and its reference."""
    example = runpy.run_path(str(EXAMPLES / "fission_gas" / "fission_gas.py"))
    functions, readings = example["experiments"]()
    published = cell.endswith("published")
    errors = example["reading_error"](readings)
    reference = fission_posterior(functions, readings, errors, not published)
    model = example["population"](functions, readings, normalised=not published)
    return model, reference, lambda d: {}


def compared(cell: str, number: int) -> dict[str, Any]:
    """Return moments of the reference and of the posterior, runs, and CPU seconds."""
    model, reference, further = (fission_gas if cell.startswith("f") else degradation)(cell)
    start = time.process_time()
    tree = prb.sample(model=model, random_seed=number, progressbar=False)
    seconds = time.process_time() - start
    names = [name for name in reference if name in tree.posterior]
    draws = {name: tree.posterior[name].to_numpy().ravel() for name in names}
    draws |= further(draws)
    draws["weight"] = np.ones(len(draws[names[0]]))
    found, exact = moments(draws), moments(reference)
    values = {name: {"reference": exact[name], "prbayes": found[name]} for name in exact}
    runs = int(tree.posterior.attrs["n_responses"])
    return {"runs": runs, "cpu": seconds, "values": values}


SPECIMENS = {"lasers": 15, "wear": 12, "fission gas": 31, "fission gas, published": 31}
STUDY = Study("published", __doc__ or "", SPECIMENS, compared, data_sets=1)

if __name__ == "__main__":
    STUDY.main()
