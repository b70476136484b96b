"""Modes of posteriors by metrics: none with more than .05 of the mass is missing without a finding.

The problem is a frame of two storeys, whose stiffnesses are two inputs; two frequencies and a mode
are measured. A metric compares distributions, so that populations that are nearly mirror images fit
about as well. A row compares the draws of `prb.sample`, by default settings, with the modes of a
reference: the posterior of the same estimate, whose optima are those of descents from 16 points of
the prior, from the true population, and from its mirror image. Masses are Laplace's. A mode is
missing if it has more than .05 of the mass and less than a fifth of that of the draws, and silent
if no finding reports several modes.

    OMP_NUM_THREADS=1 uv run python -m benchmarks.modes_of_metrics [--cells "KLD*"] [--data-sets 8]
"""

from __future__ import annotations

import json
import time
from dataclasses import replace
from typing import Any

import numpy as np
import pymc as pm
from scipy.special import softmax

import prbayes as prb
from benchmarks.metrics import METRICS
from benchmarks.study import Rows, Study
from prbayes._validate import Floats
from prbayes.model.evaluator import shortcomings
from prbayes.numerics.modes import distinct_modes, far_apart, laplace
from prbayes.optimize.design_refinement import refine_at
from prbayes.optimize.optimum import local_optimum
from prbayes.posterior.saddlepoint import minimiser_near
from prbayes.posterior.target import estimate_target

SIZES = (16, 20, 30)
CELLS = [f"{name}, N = {size}" for size in SIZES for name in ("KLD", "PR", "area")]
TRUTH, MIRROR = (0.5, 0.9, 0.1), (1.8, 0.25, 0.1)
STARTS = 16


def frame(lower: Floats, upper: Floats) -> Floats:
    """Return two frequencies, Hz, and the roof's share of the first mode, of stiffnesses."""
    k1, k2, m1, m2 = lower * 29.7e6, upper * 29.7e6, 16531.0, 16131.0
    p, q = (k1 + k2) / m1 + k2 / m2, k1 * k2 / (m1 * m2)
    root = np.sqrt(np.maximum(p * p / 4 - q, 0))
    low, high = p / 2 - root, p / 2 + root
    shape = (k1 + k2 - low * m1) / k2
    share = shape * (m1 + m2 * shape) / (m1 + m2 * shape**2)
    return np.stack([np.sqrt(low) / 2 / np.pi, np.sqrt(high) / 2 / np.pi, share], -1)


def problem(metric: str, size: int, number: int) -> pm.Model:
    """Return the model of a data set."""
    rng = np.random.default_rng([number, 900])
    observed = frame(rng.normal(0.5, 0.1, size), rng.normal(0.9, 0.1, size))
    with pm.Model() as model:
        means = [pm.Uniform(name, 0, 2) for name in ("mu1", "mu2")]
        sigma = pm.Uniform("sigma", 0, 0.6)
        inputs = [pm.TruncatedNormal.dist(mean, sigma, lower=1e-3) for mean in means]
        prb.Simulator("frame", frame, *inputs, metric=prb.Joint(METRICS[metric]), observed=observed)
    return model


def complete_optimum(optimum: prb.Optimum) -> prb.Optimum:
    """Return the best optimum of many descents, with all others as comparable local optima."""
    evaluator = optimum.evaluator
    hyperparameters = evaluator.hyperparameters
    scales = np.array([optimum.scales[node.name] for node in evaluator.nodes])
    guesses = np.array([TRUTH, MIRROR]).T
    points = hyperparameters.prior_points(16 * STARTS, 77)
    order = np.argsort(evaluator.total(points, scales))
    starts = [
        optimum.theta,
        *hyperparameters.thetas_of(list(guesses)),
        *far_apart(points[order[: 4 * STARTS]], STARTS, hyperparameters.prior_sd),
    ]
    for _ in range(2):
        ends = np.array([minimiser_near(evaluator, start, scales) for start in starts])
        values = evaluator.total(ends, scales)
        starts = []
        for i in np.argsort(values):
            is_new = all(
                np.abs((ends[i] - other) / hyperparameters.prior_sd).max() > 0.1 for other in starts
            )
            if np.isfinite(values[i]) and is_new and len(starts) < 6:
                starts.append(ends[i])
        for end in starts:
            if shortcomings(evaluator, end[None]):
                refine_at(evaluator, end[None], beside=starts[0][None])
    best, *others = starts
    records = tuple(local_optimum(evaluator, end, 0.0, comparable=True) for end in others)
    return replace(optimum, theta=best, local_optima=records)


def row(cell: str, number: int) -> dict[str, Any]:
    """Return the modes of the reference with masses, and the shares of the draws near them."""
    metric, _, size = cell.partition(", N = ")
    model = problem(metric, int(size), number)
    clock = time.process_time()
    optimum = prb.minimize(model)
    tree = prb.sample(model=model, optimum=optimum, random_seed=number)
    seconds = time.process_time() - clock
    findings = json.loads(tree["posterior"].attrs["findings"])
    target = estimate_target(optimum.evaluator, complete_optimum(optimum))
    hyperparameters = target.evaluator.hyperparameters
    points = hyperparameters.prior_points(1024, 5)
    best = points[np.argsort(-target.log_posterior(points))[:256]]
    starts = np.vstack([target.starts, far_apart(best, 16, hyperparameters.prior_sd)])
    starts = starts[np.isfinite(target.log_posterior(starts))]
    modes = distinct_modes(
        [m for m in laplace(target.log_posterior, starts, target.scale) if m.converged]
    )
    masses = softmax([mode.log_mass for mode in modes])
    draws = hyperparameters.thetas_of(
        [np.ravel(tree["posterior"][name]) for name in ("mu1", "mu2", "sigma")]
    )
    roots = [np.linalg.inv(np.linalg.cholesky(mode.covariance)) for mode in modes]
    pairs = zip(modes, roots, strict=True)
    nearest = np.argmin(
        [((draws - m.mode) @ root.T) ** 2 @ np.ones(3) for m, root in pairs], axis=0
    )
    shares = np.bincount(nearest, minlength=len(modes)) / len(draws)
    at = hyperparameters.constrained(np.array([mode.mode for mode in modes]))
    return {
        "modes": [
            {"at": [float(at[name][i]) for name in ("mu1", "mu2", "sigma")],
             "mass": float(masses[i]), "share": float(shares[i])}
            for i in range(len(modes)) if masses[i] > 0.001
        ],
        "sampler": str(tree["posterior"].attrs["sampler"]),
        "findings": sorted({finding["code"] for finding in findings}),
        "seconds": seconds,
        "seconds_reference": time.process_time() - clock - seconds,
    }  # fmt: skip


def missing(of_data_set: dict[str, Any]) -> bool:
    """Return whether the draws lack a mode."""
    modes = of_data_set["modes"]
    return any(mode["mass"] > 0.05 and mode["share"] < mode["mass"] / 5 for mode in modes)


def summary(rows: Rows) -> dict[str, float]:
    """Return how many data sets have several modes, lack one, and lack one in silence."""
    done = [of_data_set for of_data_set in rows if "error" not in of_data_set]
    lacking = [of_data_set for of_data_set in done if missing(of_data_set)]
    return {
        "data sets": len(done),
        "failed": len(rows) - len(done),
        "several modes": sum(
            sum(mode["mass"] > 0.05 for mode in of_data_set["modes"]) > 1 for of_data_set in done
        ),
        "lacking": len(lacking),
        "silent": sum("second-mode" not in of_data_set["findings"] for of_data_set in lacking),
        "seconds": float(np.median([of_data_set["seconds"] for of_data_set in done] or [0.0])),
    }


STUDY = Study(
    "modes_of_metrics", __doc__, CELLS, row, 50, summary, (ValueError, RuntimeError), block=4
)

if __name__ == "__main__":
    STUDY.main()
