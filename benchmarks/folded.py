"""Width of the posterior given the estimate where a response is folded: by seed, and against a long ABC.

y = x^2 - 2x + 1 of normal x around 2, so that a part of the population is folded at 1; 50 quantiles stand for
the data. The reference draws hyperparameters from the prior by importance sampling, a data set at each, fits it,
and keeps those whose estimate is close to that of the data, with a straight-line adjustment for the rest: ABC
with the estimate as its summary, and no model of how estimates are distributed.

    OMP_NUM_THREADS=1 uv run python -m benchmarks.folded      # 10 minutes on one core
"""

from __future__ import annotations

import argparse
import logging
from typing import Any

import numpy as np

from benchmarks import record
from benchmarks.smc import exact, truth

METRICS = {"PR": "ProbabilityResidual", "KLD": "KullbackLeibler", "area": "AreaMetric"}
NAMES = ("mu", "sigma")
FITS = 60_000  # of the long ABC
CHUNK = 4000
CLOSE = 0.5  # exact standard deviations from the estimate of the data within which a fit is kept
SEEDS = 10


def calibrated(metric: str) -> tuple[Any, Any, Any]:
    """Return the model, its optimum, and draws of the Gibbs posterior."""
    import pymc as pm

    import prbayes as prb

    response, observed, (center, scale) = truth("quadratic")
    with pm.Model() as model:
        mu = pm.TruncatedNormal("mu", center, scale, lower=1)
        x = pm.Normal.dist(mu, pm.HalfNormal("sigma", scale))
        prb.Simulator(
            "y",
            response,
            x,
            metric=getattr(prb, METRICS[metric])(),
            observed=observed,
            propagation=prb.Reweighted(1024),
        )
    optimum = prb.minimize(model, starts=0, progressbar=False)
    draws = prb.sample_smc(
        1000,
        chains=4,
        model=model,
        optimum=optimum,
        adjust=False,
        random_seed=1,
        progressbar=False,
    )
    return model, optimum, draws


def values(evaluator: Any, thetas: Any) -> Any:
    """Return mu and sigma of thetas, (n, 2)."""
    found = evaluator.constrained(thetas)
    return np.column_stack([found[name] for name in NAMES])


def long_abc(optimum: Any, draws: Any, reference: dict[str, float]) -> dict[str, Any]:
    """Return mean and sd of the posterior given the estimate, without a model of the estimates."""
    from scipy.stats import multivariate_t

    from prbayes.estimate.data_sets import observed_set, sets_along

    evaluator = optimum.evaluator
    sampling = optimum.sampling()
    (estimate,), _ = sampling.refit(observed_set(evaluator))
    target = values(evaluator, sampling.thetas(estimate[None]))[0]
    # Proposals around the draws, in unconstrained space, with heavier tails.
    mu, sigma = (draws.posterior[name].values.ravel() for name in NAMES)
    around = np.column_stack([np.log(mu - 1), np.log(sigma)])
    wide = 1.2 * np.cov(around.T)
    proposal = multivariate_t(np.median(around, axis=0), wide, df=4, seed=1)
    thetas = proposal.rvs(FITS)
    log_weights = evaluator.hyperparameters.log_prior(thetas) - proposal.logpdf(thetas)
    rng = np.random.default_rng(2)
    estimates = []
    arrived = []
    for first in range(0, FITS, CHUNK):
        some = thetas[first : first + CHUNK]
        start, _ = sampling.coordinates(some)
        fitted, converged = sampling.refit(sets_along(evaluator, some, rng), start)
        estimates.append(values(evaluator, sampling.thetas(fitted)))
        arrived.append(converged)
    sd = np.array([reference[f"{name} sd"] for name in NAMES])
    z = (np.concatenate(estimates) - target) / sd
    kept = np.concatenate(arrived) & ((z**2).sum(axis=1) < CLOSE**2)
    weights = np.exp(log_weights[kept] - log_weights[kept].max())
    weights /= weights.sum()
    root = np.sqrt(weights)[:, None]
    terms = np.column_stack([np.ones(kept.sum()), z[kept]])
    truths = values(evaluator, thetas[kept])
    slopes = np.linalg.lstsq(root * terms, root * truths, rcond=None)[0]
    moved = truths - z[kept] @ slopes[1:]
    mean = weights @ moved
    spread = np.sqrt(weights @ (moved - mean) ** 2)
    return {
        "kept": int(kept.sum()),
        "effective": float(1 / (weights**2).sum()),
        "mean": dict(zip(NAMES, mean.tolist(), strict=True)),
        "sd": dict(zip(NAMES, spread.tolist(), strict=True)),
    }


def moments(tree: Any) -> dict[str, dict[str, float]]:
    """Return means and standard deviations of draws."""
    posterior = tree.posterior
    return {
        "mean": {name: float(posterior[name].mean()) for name in NAMES},
        "sd": {name: float(posterior[name].std()) for name in NAMES},
    }


def compared(found: dict[str, Any], reference: dict[str, Any]) -> dict[str, Any]:
    """Return widths over those of the reference, and how far off centres are, in its sds."""
    width = {name: found["sd"][name] / reference["sd"][name] for name in NAMES}
    off = {
        name: (found["mean"][name] - reference["mean"][name]) / reference["sd"][name]
        for name in NAMES
    }
    return {"width": width, "off": off}


def study(metric: str) -> dict[str, Any]:
    """Return widths and centres of the straight map, and of draws given the estimate by seed."""
    import prbayes as prb

    reference = exact("quadratic")
    model, optimum, draws = calibrated(metric)
    abc = long_abc(optimum, draws, reference)

    def adjusted(by: Any) -> dict[str, Any]:
        return compared(moments(prb.adjust(draws, model=model, optimum=optimum, by=by)), abc)

    seeds = [adjusted(prb.posterior.GivenEstimate(random_seed=seed)) for seed in range(SEEDS)]
    likelihood = {"sd": {name: reference[f"{name} sd"] for name in NAMES}}
    likelihood["mean"] = {name: reference[f"{name} mean"] for name in NAMES}
    return {
        "fits": prb.posterior.GivenEstimate().n_fits,
        "long ABC": abc,
        "long ABC, against the exact posterior": compared(abc, likelihood),
        "affine": adjusted(prb.posterior.Affine()),
        "given": {
            name: {
                "width": float(np.mean([s["width"][name] for s in seeds])),
                "width, sd over seeds": float(np.std([s["width"][name] for s in seeds], ddof=1)),
                "widest": max(s["width"][name] for s in seeds),
                "off": float(np.mean([s["off"][name] for s in seeds])),
            }
            for name in NAMES
        },
    }


def main() -> None:
    """Run the study, print it and write it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--metrics", nargs="+", default=list(METRICS), choices=list(METRICS))
    arguments = parser.parse_args()
    logging.getLogger("prbayes").setLevel(logging.ERROR)
    found = {}
    for metric in arguments.metrics:
        found[metric] = study(metric)
        for name in NAMES:
            row = found[metric]["given"][name]
            print(f"{metric:5s}{name:6s}", {k: round(v, 3) for k, v in row.items()})
        print(f"{metric:5s}affine", found[metric]["affine"])
    record.save(record.RESULTS / "folded.json", found)


if __name__ == "__main__":
    main()
