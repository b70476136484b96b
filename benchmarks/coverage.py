"""Frequentist coverage of posterior intervals, and their width against the sampling spread of the estimate.

Each problem has a true population. Many data sets are drawn from it, by the response itself and not
from design points; each is calibrated, and the posterior probability below the truth is kept:
uniform numbers are what a posterior of the right width gives. Replicates run in parallel and are
stored as they come, so that an interrupted study goes on where it stopped:

    uv run python -m benchmarks.coverage --replicates 400

The pseudo-posterior is integrated by importance sampling around the optimum (1024 points), which
takes the place of `sample_smc` at a hundredth of its cost; everything else is the code that users
run.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import chi2, norm, qmc

from benchmarks import record

METRICS = ("ProbabilityResidual", "KullbackLeibler", "AreaMetric", "LogLikelihood")
SIZES = (20, 50, 200)
STORE = record.RESULTS / "coverage"
POSTERIORS = ("plain", "sandwich", "affine", "bootstrap", "exact")
LEVELS = (0.5, 0.89, 0.95)
HELD_OUT = ("bell", "correlated")  # no constant was chosen by looking at them
EDGE = np.log(100.0)  # a scale a hundred times below the usual ones is an edge, by judgement
BOOTSTRAPPED = 100  # replicates for which the loss-likelihood bootstrap is run as well
_BLOCK = 20


def normal(x: Any, mu: Any, sigma: Any) -> Any:
    """Return the normal density."""
    return np.exp(-0.5 * ((x - mu) / sigma) ** 2) / (sigma * np.sqrt(2 * np.pi))


@dataclass(frozen=True)
class Problem:
    """A response, its inputs' true hyperparameters, priors, and the response's density (for the exact posterior)."""

    truth: tuple[float, float]
    response: Callable[..., Any]
    model: Callable[[], tuple[list[Any], list[Any]]]
    draw: Callable[[np.random.Generator, int], Any]
    density: Callable[[Any, Any, Any], Any]
    n: int = 512
    max_points: int | None = (
        None  # a study of hundreds of data sets can do with designs whose error is .2 stderr
    )


def _normal_input(
    priors: Callable[[], tuple[Any, Any]],
) -> Callable[[], tuple[list[Any], list[Any]]]:
    def build() -> tuple[list[Any], list[Any]]:
        import pymc as pm

        mu, sigma = priors()
        return [mu, sigma], [pm.Normal.dist(mu, sigma)]

    return build


def _wide() -> tuple[Any, Any]:
    import pymc as pm

    return pm.Normal("mu", 10, 3), pm.HalfNormal("sigma", 3)


def _right_of_one() -> tuple[Any, Any]:
    import pymc as pm

    return pm.TruncatedNormal("mu", 2, 1, lower=1), pm.HalfNormal("sigma", 1)


def _small() -> tuple[Any, Any]:
    import pymc as pm

    return pm.HalfNormal("mu", 0.2), pm.HalfNormal("sigma", 0.1)


def _lognormal_input() -> tuple[list[Any], list[Any]]:
    import pymc as pm

    mu, sigma = pm.Normal("mu", 1, 1), pm.HalfNormal("sigma", 0.5)
    return [mu, sigma], [pm.LogNormal.dist(mu, sigma)]


def _pair() -> tuple[list[Any], list[Any]]:
    import pymc as pm
    import pytensor.tensor as pt

    mu, sigma = pm.Normal("mu", 3, 1), pm.HalfNormal("sigma", 1)
    cross = 0.5 * sigma * 0.2
    cov = pt.stack([pt.stack([sigma**2, cross]), pt.stack([cross, pt.constant(0.04)])])
    return [mu, sigma], [pm.MvNormal.dist(pt.stack([mu, pt.constant(0.0)]), cov)]


def _draw_pair(rng: np.random.Generator, size: int) -> Any:
    return rng.multivariate_normal([3.0, 0.0], [[0.25, 0.05], [0.05, 0.04]], size)


def _quadratic_density(y: Any, mu: Any, sigma: Any) -> Any:
    root = np.sqrt(y)
    return (normal(1 + root, mu, sigma) + normal(1 - root, mu, sigma)) / (2 * root)


def _bell(x: Any) -> Any:
    return np.exp(-1 / (1 + 100 * x**2))


def _bell_density(y: Any, mu: Any, sigma: Any) -> Any:
    x = np.sqrt(np.maximum(-1 / np.log(y) - 1, 1e-12) / 100)
    slope = y * 200 * x / (1 + 100 * x**2) ** 2
    return (normal(x, mu, sigma) + normal(-x, mu, sigma)) / slope


def _pair_density(y: Any, mu: Any, sigma: Any) -> Any:
    # Over the input that scatters less than the other one: nodes that are too far apart for what is
    # between them make the density one of a comb.
    nodes, weights = np.polynomial.hermite_e.hermegauss(32)
    narrow: Any = 0.0
    wide: Any = 0.0
    for z, w in zip(nodes, weights / np.sqrt(2 * np.pi), strict=True):
        first = np.maximum(mu + sigma * z, 1e-9)
        inner = normal(np.log(y / first), 0.1 * z, 0.2 * np.sqrt(0.75)) / y
        narrow = narrow + w * np.where(mu + sigma * z > 0, inner, 0.0)
        factor = np.exp(-0.2 * z)
        wide = wide + w * factor * normal(y * factor, mu + 0.5 * sigma * z, sigma * np.sqrt(0.75))
    return np.where(sigma < 0.5, narrow, wide)


PROBLEMS = {
    "linear": Problem(
        (10.0, 1.0), lambda x: x, _normal_input(_wide), lambda rng, n: rng.normal(10, 1, n), normal
    ),
    "quadratic": Problem(
        (2.0, 0.5),
        lambda x: x**2 - 2 * x + 1,
        _normal_input(_right_of_one),
        lambda rng, n: rng.normal(2, 0.5, n),
        _quadratic_density,
    ),
    "bell": Problem(
        (0.1, 0.03),
        _bell,
        _normal_input(_small),
        lambda rng, n: rng.normal(0.1, 0.03, n),
        _bell_density,
    ),
    "lognormal": Problem(
        (1.1, 0.2),
        lambda x: x,
        _lognormal_input,
        lambda rng, n: rng.lognormal(1.1, 0.2, n),
        lambda y, mu, sigma: normal(np.log(y), mu, sigma) / y,
    ),
    "correlated": Problem(
        (3.0, 0.5),
        lambda x: x[..., 0] * np.exp(x[..., 1]),
        _pair,
        _draw_pair,
        _pair_density,
        n=1024,
        max_points=4096,
    ),
}


def build(problem: str, metric: str, size: int) -> Any:
    """Return an evaluator of the problem's model, to be given data."""
    import pymc as pm

    import prbayes as prb
    from benchmarks.metrics import BY_NAME
    from prbayes.model.evaluator import Evaluator

    p = PROBLEMS[problem]
    some = p.response(p.draw(np.random.default_rng(0), size))
    with pm.Model() as model:
        _, inputs = p.model()
        prb.Simulator(
            "y",
            p.response,
            *inputs,
            metric=BY_NAME[metric],
            observed=some,
            propagation=prb.Reweighted(p.n, max_points=p.max_points),
        )
    return Evaluator(model)


def proposal(center: Any, covariance: Any, size: int = 1024) -> tuple[Any, Any]:
    """Return Sobol points through a multivariate t with 5 degrees of freedom, and their log density."""
    d = len(center)
    u = np.clip(qmc.Sobol(d + 1, rng=np.random.default_rng(0)).random(size), 1e-9, 1 - 1e-9)
    z = norm.ppf(u[:, :d]) / np.sqrt(chi2.ppf(u[:, d:], 5) / 5)
    root = np.linalg.cholesky(covariance)
    log_density = -(5 + d) / 2 * np.log1p((z**2).sum(axis=1) / 5)
    return center + z @ root.T, log_density


def weighted(log_weights: Any, thetas: Any) -> tuple[Any, float]:
    """Resample to equal weights, systematically; return draws and the effective sample size."""
    w = np.exp(log_weights - log_weights.max())
    w /= w.sum()
    index = np.searchsorted(np.cumsum(w), (np.arange(4000) + 0.5) / 4000)
    return thetas[np.minimum(index, len(w) - 1)], float(1 / (w**2).sum())


def analyse(
    evaluator: Any, data: Any, truth: Any, log_likelihood: Callable[[Any], Any], *, bootstrap: bool
) -> dict[str, Any]:
    """Calibrate one data set; return the estimate, and by posterior: probability below the truth, mean, sd."""
    from prbayes.estimate.data_sets import reweighted_sets
    from prbayes.estimate.minimization import Minimisation, find_optimum
    from prbayes.estimate.refit import SamplingDistribution
    from prbayes.posterior.adjustment import Affine, transported
    from prbayes.posterior.epsilon import calibrate_epsilon

    ev = evaluator.observing({"y": data})
    optimum = find_optimum(ev, Minimisation(starts=0))
    epsilon = np.array([calibrate_epsilon(optimum)["y"]])
    ev.nodes[0].epsilon.set_value(epsilon[0])
    sampling = SamplingDistribution.of(ev, optimum.theta, epsilon)
    r = sampling.stderr.size
    spread = (
        2.0 * (sampling.axes * sampling.stderr**2) @ sampling.axes.T
        + sampling.local.unidentified @ sampling.local.unidentified.T
    )
    thetas, log_q = proposal(
        optimum.theta, spread * np.outer(sampling.local.prior_sd, sampling.local.prior_sd)
    )
    found = ev(thetas)
    draws, ess = weighted(found.log_prior + found.log_likelihood(epsilon) - log_q, thetas)
    exact, ess_exact = weighted(found.log_prior + log_likelihood(thetas) - log_q, thetas)
    x, remainder = sampling.coordinates(draws)
    prior, _ = sampling.coordinates(ev.prior_thetas(1024, 0))
    first_order = np.linalg.inv(
        np.eye(r) + np.linalg.inv(np.cov(prior, rowvar=False).reshape(r, r))
    )
    posteriors = {
        "plain": draws,
        "sandwich": transported(sampling, x, remainder, np.zeros(r), first_order),
        "affine": Affine(n_sets=100)(ev, draws, [optimum.theta]).thetas,
        "exact": exact,
    }
    if bootstrap:
        posteriors["bootstrap"] = sampling.thetas(sampling.refit(reweighted_sets(ev, 100))[0])
    return {
        "estimate": optimum.theta.tolist(),
        "epsilon": float(epsilon[0]),
        "converged": optimum.converged,
        "ess": [ess, ess_exact],
        "seen": r,
        "responses": ev.n_responses,
        **{
            name: [
                np.mean(d < truth, axis=0).tolist(),
                d.mean(axis=0).tolist(),
                d.std(axis=0).tolist(),
            ]
            for name, d in posteriors.items()
        },
    }


def block(
    problem: str, size: int, first: int, count: int, metrics: tuple[str, ...]
) -> list[dict[str, Any]]:
    """Analyse some replicates with all metrics."""
    import logging

    logging.getLogger("prbayes").setLevel(logging.ERROR)
    p = PROBLEMS[problem]
    evaluators = {m: build(problem, m, size) for m in metrics}
    any_one = evaluators[metrics[0]]
    free = [rv.name for rv in any_one.model.free_RVs]
    truth = any_one.thetas_of(
        [np.array([dict(zip(("mu", "sigma"), p.truth, strict=True))[n]]) for n in free]
    )[0]
    rows = []
    for i in range(first, first + count):
        data = p.response(p.draw(np.random.default_rng([i, size]), size))

        def log_likelihood(thetas: Any, data: Any = data) -> Any:
            values = any_one.constrained(thetas)
            mu, sigma = values["mu"][:, None], values["sigma"][:, None]
            return np.log(np.maximum(p.density(data, mu, sigma), 1e-300)).sum(axis=1)

        row: dict[str, Any] = {"replicate": i, "truth": truth.tolist()}
        for m in metrics:
            try:
                with evaluators[m].designs["y"].undone():
                    row[m] = analyse(
                        evaluators[m], data, truth, log_likelihood, bootstrap=i < BOOTSTRAPPED
                    )
            except Exception as error:  # a failure is a result
                row[m] = {"error": f"{type(error).__name__}: {error}"[:300]}
        rows.append(row)
    return rows


def spread(estimates: Any) -> Any:
    """Return the standard deviation of estimates, (n, d), without those that lie on the edge of a support.

    In unconstrained space the edge is at minus infinity; at N = 20 some estimates get there.
    """
    return np.array([_spread(column[column > np.median(column) - EDGE]) for column in estimates.T])


def _spread(estimates: Any) -> Any:
    robust = np.subtract(*np.quantile(estimates, [0.945, 0.055])) / (2 * norm.ppf(0.945))
    return estimates[np.abs(estimates - np.median(estimates)) < 4 * robust].std(ddof=1)


def summarise(rows: list[dict[str, Any]], metric: str, posterior: str) -> dict[str, Any]:
    """Return coverage, width against the estimate's own spread and against the exact posterior, by hyperparameter."""
    good = [r[metric] for r in rows if "error" in r[metric] or posterior in r[metric]]
    failed = sum("error" in g for g in good)
    good = [g for g in good if "error" not in g]
    u = np.array([g[posterior][0] for g in good])
    sd = np.array([g[posterior][2] for g in good])
    exact_sd = np.array([g["exact"][2] for g in good])
    exact_mean = np.array([g["exact"][1] for g in good])
    estimate = np.array([g["estimate"] for g in good])
    truth = np.array([r["truth"] for r in rows])[0]
    return {
        "replicates": len(good),
        "failed": failed,
        **{
            f"coverage_{level:.0%}": np.mean(np.abs(u - 0.5) < level / 2, axis=0).tolist()
            for level in LEVELS
        },
        "sd_over_own_sampling_sd": (np.median(sd, axis=0) / spread(estimate)).tolist(),
        "sd_over_exact_sd": np.median(sd / exact_sd, axis=0).tolist(),
        "rmse_over_exact_rmse": np.sqrt(
            np.quantile((estimate - truth) ** 2, 0.7, axis=0)
            / np.quantile((exact_mean - truth) ** 2, 0.7, axis=0)
        ).tolist(),
    }


def table(store: Path) -> dict[str, Any]:
    """Summarise what is stored; print a table of the default posterior and pooled figures of all."""
    cells: dict[str, Any] = {}
    for problem in PROBLEMS:
        for size in SIZES:
            rows = [
                r
                for f in sorted(store.glob(f"{problem}-{size}-*.json"))
                for r in json.loads(f.read_text())
            ]
            if not rows:
                continue
            for metric in METRICS:
                for posterior in POSTERIORS:
                    cells[f"{problem}/{size}/{metric}/{posterior}"] = summarise(
                        rows, metric, posterior
                    )
    print(
        f"{'problem':12s}{'N':>4s} {'metric':20s} {'posterior':10s} {'50%':>11s} {'89%':>11s} {'95%':>11s} "
        f"{'sd/own':>11s} {'sd/exact':>11s} {'rmse ratio':>11s}"
    )
    for key, c in cells.items():
        problem, n_data, metric, posterior = key.split("/")
        figures = [c[f"coverage_{level:.0%}"] for level in LEVELS]
        figures += [
            c[k] for k in ("sd_over_own_sampling_sd", "sd_over_exact_sd", "rmse_over_exact_rmse")
        ]
        shown = " ".join(
            "/".join(f"{v:.2f}".replace("0.", ".", 1) for v in f).rjust(11) for f in figures
        )
        print(f"{problem:12s}{n_data:>4s} {metric:20s} {posterior:10s} {shown}")
    pooled: dict[str, Any] = {}
    print("\npooled over hyperparameters and cells; held-out problems: " + ", ".join(HELD_OUT))
    for group, names in {"all": tuple(PROBLEMS), "held out": HELD_OUT}.items():
        for posterior in POSTERIORS:
            for large in (True, False):
                chosen = {
                    k: c
                    for k, c in cells.items()
                    if k.endswith("/" + posterior)
                    and (int(k.split("/")[1]) >= 50) is large
                    and k.split("/")[0] in names
                }
                if not chosen:
                    continue
                coverage = np.array([c["coverage_89%"] for c in chosen.values()])
                width = np.array([c["sd_over_own_sampling_sd"] for c in chosen.values()])
                name = f"{group}, {posterior}, N {'>= 50' if large else '= 20'}"
                pooled[name] = {
                    "mean_coverage_89": float(coverage.mean()),
                    "lowest_coverage_89": float(coverage.min()),
                    "highest_coverage_89": float(coverage.max()),
                    "lowest_sd_ratio": float(width.min()),
                    "highest_sd_ratio": float(width.max()),
                }
                print(f"{name:32s}", "  ".join(f"{k} {v:.3f}" for k, v in pooled[name].items()))
    return {"cells": cells, "pooled": pooled}


def main() -> None:
    """Run what is missing, then summarise."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--replicates", type=int, default=400)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--problems", nargs="+", default=list(PROBLEMS), choices=list(PROBLEMS))
    parser.add_argument("--sizes", nargs="+", type=int, default=list(SIZES))
    parser.add_argument("--store", type=Path, default=STORE)
    parser.add_argument("--out", type=Path, default=record.RESULTS / "coverage.json")
    parser.add_argument("--only-table", action="store_true")
    arguments = parser.parse_args()
    arguments.store.mkdir(parents=True, exist_ok=True)
    missing = [
        (problem, size, first)
        for first in range(0, arguments.replicates, _BLOCK)
        for problem in arguments.problems
        for size in arguments.sizes
        if not (arguments.store / f"{problem}-{size}-{first:05d}.json").exists()
    ]
    if missing and not arguments.only_table:
        from rich.progress import track

        with ProcessPoolExecutor(arguments.workers, mp_context=get_context("spawn")) as pool:
            jobs = {
                pool.submit(block, p, s, first, _BLOCK, METRICS): (p, s, first)
                for p, s, first in missing
            }
            for job in track(as_completed(jobs), "blocks of data sets", total=len(jobs)):
                problem, size, first = jobs[job]
                path = arguments.store / f"{problem}-{size}-{first:05d}.json"
                path.with_suffix(".part").write_text(json.dumps(job.result()))
                path.with_suffix(".part").replace(path)
    found = table(arguments.store)
    record.save(arguments.out, found)


if __name__ == "__main__":
    main()
