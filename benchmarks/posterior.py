"""Posteriors given the metric's estimate: coverage, width and centre on problems that set nothing.

Each problem has a true population. Many data sets are drawn from it, by the response itself and not
from design points, and each is calibrated with every metric. The pseudo-posterior is integrated by
importance sampling around the optimum, which takes the place of `sample_smc`; its draws go through
`Affine` and `GivenEstimate` as those of users do. The exact posterior, from the density of the
response, stands beside them. No constant of the package was chosen by looking at these problems;
those of `GivenEstimate` were looked at on "linear" and "quadratic" of `benchmarks/coverage.py`.

Replicates are stored as they come, so that an interrupted study goes on where it stopped:

    OMP_NUM_THREADS=1 uv run python -m benchmarks.posterior --replicates 300
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

import numpy as np
from scipy.special import gammaln

from benchmarks import record
from benchmarks.coverage import normal, proposal, spread

STORE = record.RESULTS / "posterior"
OUT = record.RESULTS / "posterior.json"
SIZES = (20, 50, 10, 200)
METRICS = {
    "PR": "ProbabilityResidual",
    "KLD": "KullbackLeibler",
    "area": "AreaMetric",
    "log-likelihood": "LogLikelihood",
}
POSTERIORS = ("draws", "affine", "given", "exact")
LEVEL = 0.89
_DRAWS = 1000
_PROPOSED = 4096
_BLOCK = 10  # data sets of a cell before it is the next one's turn
POOLED = 100  # data sets of a cell, from which on it counts in pooled figures


@dataclass(frozen=True)
class Problem:
    """A response, its population, and the log-density of one response."""

    truth: dict[str, float]
    response: Callable[[Any], Any]
    inputs: Callable[[], Any]  # within a model: the aleatory input or inputs
    draw: Callable[[np.random.Generator, int], Any]
    log_density: Callable[..., Any]  # responses (N,), hyperparameters (P, 1) by name -> (P, N)
    points: int = 512
    used: bool = False  # whether constants were chosen by looking at it


def _gamma() -> Any:
    import pymc as pm

    mean, shape = pm.LogNormal("mean", 0.5, 0.7), pm.LogNormal("shape", 1.2, 0.8)
    return pm.Gamma.dist(alpha=shape, beta=shape / mean)


def _gamma_density(y: Any, mean: Any, shape: Any) -> Any:
    x = np.expm1(y)
    rate = shape / mean
    return shape * np.log(rate) - gammaln(shape) + (shape - 1) * np.log(x) - rate * x + y


def _weibull() -> Any:
    import pymc as pm

    shape, scale = pm.LogNormal("shape", 0.9, 0.6), pm.LogNormal("scale", 0.0, 0.8)
    return pm.Weibull.dist(shape, scale)


def _weibull_density(y: Any, shape: Any, scale: Any) -> Any:
    x = y / (1 - y)
    z = x / scale
    return np.log(shape / scale) + (shape - 1) * np.log(z) - z**shape - 2 * np.log1p(-y)


def _folded() -> Any:
    import pymc as pm

    mu = pm.TruncatedNormal("mu", 1.0, 1.0, lower=0.0)
    return pm.Normal.dist(mu, pm.HalfNormal("sigma", 1.0))


def _folded_density(y: Any, mu: Any, sigma: Any) -> Any:
    return np.log(normal(y, mu, sigma) + normal(-y, mu, sigma) + 1e-300)


def _product() -> list[Any]:
    import pymc as pm

    mu, sigma = pm.Normal("mu", 3.0, 2.0), pm.HalfNormal("sigma", 0.5)
    return [pm.Normal.dist(mu, 0.4), pm.LogNormal.dist(0.0, sigma)]


def _product_density(y: Any, mu: Any, sigma: Any) -> Any:
    nodes, weights = np.polynomial.hermite_e.hermegauss(48)
    total: Any = 0.0
    for z, w in zip(nodes, weights / np.sqrt(2 * np.pi), strict=True):
        # Over the normal factor, which scatters less than the other.
        factor = mu + 0.4 * z
        positive = np.maximum(factor, 1e-9)
        inner = normal(np.log(y / positive), 0.0, sigma) / y
        total = total + w * np.where(factor > 0, inner, 0.0)
    return np.log(total + 1e-300)


def _threshold() -> Any:
    import pymc as pm

    return pm.Exponential.dist(scale=pm.LogNormal("scale", 0.0, 1.0))


def _bent(x: Any) -> Any:
    return (x - 1 + np.sqrt((x - 1) ** 2 + 0.04)) / 2


def _threshold_density(y: Any, scale: Any) -> Any:
    # Of the root of a parabola: y (y - (x - 1)) = 0.01.
    x = 1 + y - 0.01 / y
    slope = 1 + 0.01 / y**2
    inside = np.where(x > 0, -np.log(scale) - x / scale, -1e300)
    return inside + np.log(slope)


def _linear() -> Any:
    import pymc as pm

    return pm.Normal.dist(pm.Normal("mu", 10, 3), pm.HalfNormal("sigma", 3))


def _linear_density(y: Any, mu: Any, sigma: Any) -> Any:
    return np.log(normal(y, mu, sigma) + 1e-300)


def _quadratic() -> Any:
    import pymc as pm

    mu = pm.TruncatedNormal("mu", 2, 1, lower=1)
    return pm.Normal.dist(mu, pm.HalfNormal("sigma", 1))


def _quadratic_density(y: Any, mu: Any, sigma: Any) -> Any:
    root = np.sqrt(y)
    both = normal(1 + root, mu, sigma) + normal(1 - root, mu, sigma)
    return np.log(both / (2 * root) + 1e-300)


PROBLEMS = {
    "gamma": Problem(
        {"mean": 2.0, "shape": 4.0},
        np.log1p,
        _gamma,
        lambda rng, n: rng.gamma(4.0, 0.5, n),
        _gamma_density,
    ),
    "weibull": Problem(
        {"shape": 2.5, "scale": 1.4},
        lambda x: x / (1 + x),
        _weibull,
        lambda rng, n: 1.4 * rng.weibull(2.5, n),
        _weibull_density,
    ),
    "folded": Problem(
        {"mu": 1.2, "sigma": 0.7},
        np.abs,
        _folded,
        lambda rng, n: rng.normal(1.2, 0.7, n),
        _folded_density,
    ),
    "product": Problem(
        {"mu": 3.0, "sigma": 0.3},
        lambda x: x[..., 0] * x[..., 1],
        _product,
        lambda rng, n: np.column_stack([rng.normal(3.0, 0.4, n), rng.lognormal(0.0, 0.3, n)]),
        _product_density,
        points=128,
    ),
    "threshold": Problem(
        {"scale": 1.3},
        _bent,
        _threshold,
        lambda rng, n: rng.exponential(1.3, n),
        _threshold_density,
    ),
    "linear": Problem(
        {"mu": 10.0, "sigma": 1.0},
        np.positive,
        _linear,
        lambda rng, n: rng.normal(10, 1, n),
        _linear_density,
        used=True,
    ),
    "quadratic": Problem(
        {"mu": 2.0, "sigma": 0.5},
        lambda x: x**2 - 2 * x + 1,
        _quadratic,
        lambda rng, n: rng.normal(2, 0.5, n),
        _quadratic_density,
        used=True,
    ),
}


def build(problem: Problem, metric: str, size: int) -> Any:
    """Return an evaluator of the problem's model, to be given data."""
    import pymc as pm

    import prbayes as prb
    from benchmarks.metrics import BY_NAME
    from prbayes.model.evaluator import Evaluator

    some = problem.response(problem.draw(np.random.default_rng(0), size))
    with pm.Model() as model:
        inputs = problem.inputs()
        every = inputs if isinstance(inputs, list) else [inputs]

        def response(*x: Any) -> Any:
            return problem.response(x[0] if len(x) == 1 else np.stack(x, axis=-1))

        prb.Simulator(
            "y",
            response,
            *every,
            metric=BY_NAME[METRICS[metric]],
            observed=some,
            propagation=prb.Reweighted(problem.points, max_points=2048),
        )
    return Evaluator(model)


def resampled(log_weights: Any, thetas: Any) -> Any:
    """Return equally likely draws, by systematic resampling."""
    w = np.exp(log_weights - log_weights.max())
    ends = np.cumsum(w / w.sum())
    index = np.searchsorted(ends, (np.arange(_DRAWS) + 0.5) / _DRAWS)
    return thetas[np.minimum(index, len(w) - 1)]


def analyse(evaluator: Any, problem: Problem, data: Any, truth: Any, seed: int) -> dict[str, Any]:
    """Calibrate one data set; by posterior: probability below the truth, mean and sd of theta."""
    from prbayes.estimate.minimization import Minimisation, find_optimum
    from prbayes.estimate.refit import SamplingDistribution
    from prbayes.posterior import Affine, GivenEstimate
    from prbayes.posterior.epsilon import calibrate_epsilon

    ev = evaluator.observing({"y": data})
    optimum = find_optimum(ev, Minimisation(starts=0))
    epsilon = np.array([calibrate_epsilon(optimum)["y"]])
    ev.nodes[0].epsilon.set_value(epsilon[0])
    sampling = SamplingDistribution.of(ev, optimum.theta, epsilon)
    local = sampling.local
    along = (sampling.axes * sampling.stderr**2) @ sampling.axes.T
    across = local.unidentified @ local.unidentified.T
    unit = np.outer(local.prior_sd, local.prior_sd)
    thetas, log_q = proposal(optimum.theta, (2.0 * along + across) * unit, _PROPOSED)
    found = ev(thetas)
    values = {name: value[:, None] for name, value in ev.constrained(thetas).items()}
    with np.errstate(all="ignore"):
        exact = problem.log_density(data, **values).sum(axis=1)
    draws = resampled(found.log_prior + found.log_likelihood(epsilon) - log_q, thetas)
    row: dict[str, Any] = {"estimate": optimum.theta.tolist()}
    posteriors = {
        "draws": draws,
        "exact": resampled(np.nan_to_num(found.log_prior + exact - log_q, nan=-1e300), thetas),
    }
    seconds = {}
    for name, strategy in {
        "affine": Affine(random_seed=seed),
        "given": GivenEstimate(random_seed=seed),
    }.items():
        clock = time.process_time()
        adjusted = strategy(ev, draws, [optimum.theta], optimum.design_error)
        seconds[name] = time.process_time() - clock
        posteriors[name] = adjusted.thetas
        row[f"{name}: why not"] = adjusted.reason
        row[f"{name}: errors"] = [adjusted.center_error, adjusted.width_error]
    row["seconds"] = seconds
    for name, d in posteriors.items():
        below = np.mean(d < truth, axis=0)
        row[name] = [below.tolist(), d.mean(axis=0).tolist(), d.std(axis=0).tolist()]
    return row


def cells(
    problems: list[str], sizes: list[int], metrics: list[str]
) -> Iterator[tuple[str, int, str]]:
    """Yield the cells of the study."""
    for size in sizes:
        for problem in problems:
            for metric in metrics:
                yield problem, size, metric


def path(problem: str, size: int, metric: str) -> Path:
    """Return where a cell's rows are."""
    return STORE / f"{problem}-{size}-{metric}.jsonl"


def rows_of(problem: str, size: int, metric: str) -> list[dict[str, Any]]:
    """Return what is stored of a cell."""
    file = path(problem, size, metric)
    return [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []


def go_on(problem: str, size: int, metric: str, until: int) -> None:
    """Analyse the data sets of a cell that are missing, up to a number."""
    from prbayes._progress import shown

    done = {row["replicate"] for row in rows_of(problem, size, metric)}
    missing = [i for i in range(until) if i not in done]
    if not missing:
        return
    p = PROBLEMS[problem]
    evaluator = build(p, metric, size)
    point = {name: np.array([value]) for name, value in p.truth.items()}
    truth = evaluator.thetas_of([point[rv.name] for rv in evaluator.model.free_RVs])[0]
    for i in missing:
        data = p.response(p.draw(np.random.default_rng([2027, i, size]), size))
        row: dict[str, Any]
        try:
            with evaluator.designs["y"].undone(), shown(False):
                row = analyse(evaluator, p, data, truth, i)
        except Exception as error:  # a failure is a result
            row = {"error": f"{type(error).__name__}: {error}"[:300]}
        row = rounded({"replicate": i, **row, "truth": truth.tolist()})
        with path(problem, size, metric).open("a") as file:
            file.write(json.dumps(row) + "\n")


def rounded(found: Any) -> Any:
    """Return a row with five digits of each number: the rows are kept beside the results."""
    if isinstance(found, dict):
        return {key: rounded(value) for key, value in found.items()}
    if isinstance(found, list):
        return [rounded(value) for value in found]
    return float(f"{found:.5g}") if isinstance(found, float) else found


def summarise(rows: list[dict[str, Any]], posterior: str) -> dict[str, Any]:
    """Return coverage, width and centre by hyperparameter."""
    good = [row for row in rows if "error" not in row]
    below, mean, sd = (np.array([row[posterior][i] for row in good]) for i in range(3))
    exact_mean, exact_sd = (np.array([row["exact"][i] for row in good]) for i in (1, 2))
    own = spread(np.array([row["estimate"] for row in good]))
    inside = np.abs(below - 0.5) < LEVEL / 2
    shift = (mean - exact_mean) / exact_sd
    summary = {
        "data sets": len(good),
        "failed": len(rows) - len(good),
        "coverage": inside.mean(axis=0).tolist(),
        "sd over own sampling sd": (np.median(sd, axis=0) / own).tolist(),
        "sd over exact sd": np.median(sd / exact_sd, axis=0).tolist(),
        "off": np.median(shift, axis=0).tolist(),
    }
    if posterior in ("affine", "given"):
        summary["seconds"] = float(np.mean([row["seconds"][posterior] for row in good]))
        summary["not adjusted"] = sum(row[f"{posterior}: why not"] is not None for row in good)
    return summary


def table() -> dict[str, Any]:
    """Summarise what is stored, and print it."""
    before = record.load(OUT, {}).get("cells", {})
    found: dict[str, Any] = {}
    print(
        f"{'cell':34s}{'posterior':10s}{'sets':>6s}{'failed':>7s}  coverage  sd/own  sd/exact  off  s"
    )
    for problem, size, metric in cells(list(PROBLEMS), sorted(SIZES), list(METRICS)):
        rows = rows_of(problem, size, metric)
        for posterior in POSTERIORS:
            key = f"{problem}/{size}/{metric}/{posterior}"
            # A summary of more data sets than are stored here stays.
            summary = before.get(key)
            if len(rows) >= max(_BLOCK, 0 if summary is None else summary["data sets"]):
                summary = summarise(rows, posterior)
            if summary is None:
                continue
            found[key] = summary
            shown = "  ".join(
                "/".join(f"{v:.2f}" for v in summary[key])
                for key in ("coverage", "sd over own sampling sd", "sd over exact sd", "off")
            )
            name = f"{problem}, N = {size}, {metric}"
            last = f"{summary.get('seconds', 0):.2f}"
            counts = f"{summary['data sets']:6d}{summary['failed']:7d}"
            print(f"{name:34s}{posterior:10s}{counts}  {shown}  {last}")
    pooled = {}
    several = [(f"N = {size}", (size,)) for size in sorted(SIZES)]
    for posterior in POSTERIORS:
        for name, sizes in (*several, ("N >= 20", (20, 50, 200))):
            chosen = [cell for key, cell in found.items() if _counts(key, cell, posterior, sizes)]
            if not chosen:
                continue
            coverage = np.concatenate([cell["coverage"] for cell in chosen])
            widths = np.concatenate([cell["sd over own sampling sd"] for cell in chosen])
            off = np.concatenate([cell["off"] for cell in chosen])
            pooled[f"{posterior}, {name}"] = {
                "mean coverage": float(coverage.mean()),
                "lowest": float(coverage.min()),
                "highest": float(coverage.max()),
                "narrowest": float(widths.min()),
                "widest": float(widths.max()),
                "farthest off": float(np.abs(off).max()),
            }
            figures = "  ".join(f"{k} {v:.3f}" for k, v in pooled[f"{posterior}, {name}"].items())
            print(f"{posterior}, {name}".ljust(24), figures)
    compared = nearer(found)
    print("nearer to the exact posterior than Affine:", compared)
    return {"cells": found, "pooled": pooled, "nearer": compared}


def _counts(key: str, cell: dict[str, Any], posterior: str, sizes: tuple[int, ...]) -> bool:
    """Return whether a cell counts in pooled figures of a posterior."""
    problem, size, _, of = key.split("/")
    asked = of == posterior and int(size) in sizes and not PROBLEMS[problem].used
    return asked and cell["data sets"] >= POOLED


def nearer(found: dict[str, Any]) -> dict[str, Any]:
    """Count where `GivenEstimate` is nearer to the exact posterior than `Affine`, where it serves."""
    names = [
        key.removesuffix("/given")
        for key in found
        if key.endswith("/given")
        and "/log-likelihood/" not in key
        and not PROBLEMS[key.split("/")[0]].used
    ]
    by = {}
    for posterior in ("given", "affine"):
        chosen = [found[f"{name}/{posterior}"] for name in names]
        by[posterior] = (
            np.concatenate([cell["sd over exact sd"] for cell in chosen]),
            np.abs(np.concatenate([cell["off"] for cell in chosen])),
        )
    given_width, given_off = by["given"]
    affine_width, affine_off = by["affine"]
    widths = np.abs(np.log(given_width)) < np.abs(np.log(affine_width))
    return {
        "cells": len(names),
        "hyperparameters": widths.size,
        "widths": int(widths.sum()),
        "centres": int((given_off < affine_off).sum()),
        "given: narrowest and widest": [given_width.min(), given_width.max()],
        "affine: narrowest and widest": [affine_width.min(), affine_width.max()],
        "given: farthest off": given_off.max(),
        "affine: farthest off": affine_off.max(),
    }


def main() -> None:
    """Run what is missing, then summarise."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--replicates", type=int, default=300)
    parser.add_argument("--problems", nargs="+", default=list(PROBLEMS), choices=list(PROBLEMS))
    parser.add_argument("--sizes", nargs="+", type=int, default=list(SIZES))
    parser.add_argument("--metrics", nargs="+", default=list(METRICS), choices=list(METRICS))
    parser.add_argument("--only-table", action="store_true")
    arguments = parser.parse_args()
    logging.getLogger("prbayes").setLevel(logging.ERROR)
    STORE.mkdir(parents=True, exist_ok=True)
    if not arguments.only_table:
        for until in range(_BLOCK, arguments.replicates + _BLOCK, _BLOCK):
            for cell in cells(arguments.problems, arguments.sizes, arguments.metrics):
                go_on(*cell, until=min(until, arguments.replicates))
    record.save(OUT, table())


if __name__ == "__main__":
    main()
