"""Coverage of predictions with a model discrepancy, within and beyond the conditions of the tests.

Thirty specimens have the stiffness x ~ N(5, .4); the model's force at the deflection c is x c, the
true one x c + d(c). It was measured at c = .5, 1, 1.5 and 2 with an error of .05. Four discrepancies d
are tried, and counted are the 89 % intervals of the population's standard deviation and mean, and
of the mean force at c = 1.25 and 3, that contain the true values. Coefficients have a t prior with
four degrees of freedom, whose scale is 20 % of the mean force at the largest deflection.

Cells ``smooth`` and ``line`` are exact posteriors under `prb.response.Smooth` and under the default
shape: response and readings are linear and normal, so that an integral over two numbers is left.
Cells ``prb.sample`` are posteriors of prbayes.

    OMP_NUM_THREADS=1 uv run python -m benchmarks.discrepancy [--cells "*/smooth"] [--data-sets 400]
"""

from __future__ import annotations

import time
from functools import cache
from typing import Any

import numpy as np
import pymc as pm
import pytensor.tensor as pt
from scipy.stats import halfnorm, invgamma

import prbayes as prb
from benchmarks.study import Study

TESTS = np.array([0.5, 1.0, 1.5, 2.0])
NEW = np.array([1.25, 3.0])
MEAN, SD, ERROR, SPECIMENS = 5.0, 0.4, 0.05, 30
SCALE = 0.2 * MEAN * TESTS.max()
DEGREES = 4
TRUTHS: dict[str, Any] = {
    "stiffening": lambda c: 0.25 * c**2,
    "saturating": lambda c: 1 - np.exp(-c / 0.7),
    "periodic": lambda c: 0.5 * np.sin(np.pi * c),
    "none": lambda c: 0 * c,
}
SHAPES: dict[str, Any] = {
    "smooth": prb.response.Additive(TESTS, prb.response.Smooth(zero_at=0.0)),
    "line": prb.response.Additive(TESTS),
}
CELLS = [f"{truth}/{kind}" for kind in ("smooth", "line", "prb.sample") for truth in TRUTHS]
NAMES = ("sd", "mean", "within", "beyond")


def readings(truth: str, seed: int) -> Any:
    """Return readings of the specimens at the tests' deflections."""
    rng = np.random.default_rng(seed)
    x = rng.normal(MEAN, SD, (SPECIMENS, 1))
    return x * TESTS + TRUTHS[truth](TESTS) + ERROR * rng.normal(size=(SPECIMENS, len(TESTS)))


@cache
def grid(kind: str) -> Any:
    """Return spreads, discrepancy's sizes, log prior, and the prior covariance for each size."""
    spreads = np.geomspace(0.15, 1.0, 40)
    sizes = np.geomspace(0.05, 20.0, 60)
    log_prior = halfnorm.logpdf(spreads)[:, None] + np.log(spreads)[:, None]
    log_prior = log_prior + invgamma.logpdf(sizes**2, DEGREES / 2, scale=DEGREES / 2)
    log_prior += 2 * np.log(sizes)
    shape = SHAPES[kind]
    places = np.concatenate([TESTS, NEW])
    units = np.eye(shape.event[0])[:, None] if shape.event else np.ones((1, 1))
    terms = np.array([shape.value(unit, places) for unit in units])
    of_discrepancy = (SCALE * sizes[:, None, None]) ** 2 * (terms.T @ terms)
    # Elements: readings at the tests, forces at the new deflections, and the population's mean.
    of_mean = np.append(places, 1.0)
    covariance = np.tile(9.0 * np.outer(of_mean, of_mean), (len(sizes), 1, 1))
    covariance[:, :-1, :-1] += of_discrepancy
    return spreads, log_prior, covariance, 5.0 * of_mean


def exact_draws(y: Any, kind: str, seed: int) -> Any:
    """Return draws of the exact posterior, (n, 4): sd, mean, and forces at the new deflections."""
    spreads, log_prior, covariance, prior_mean = grid(kind)
    k = len(TESTS)
    residuals = y - y.mean(axis=0)
    logs, means, roots = [], [], []
    for spread, log_p in zip(spreads, log_prior, strict=True):
        of_specimen = spread**2 * np.outer(TESTS, TESTS) + ERROR**2 * np.eye(k)
        scatter = np.einsum("ni,ij,nj->", residuals, np.linalg.inv(of_specimen), residuals)
        log_det = np.linalg.slogdet(of_specimen)[1]
        of_data = covariance[:, :k, :k] + of_specimen / len(y)
        gain = np.linalg.solve(of_data, covariance[:, :k, k:]).swapaxes(1, 2)
        away = y.mean(axis=0) - prior_mean[:k]
        misfit = (
            away @ np.linalg.solve(of_data, np.tile(away[:, None], (len(of_data), 1, 1)))[..., 0].T
        )
        log_l = -0.5 * (scatter + (len(y) - 1) * log_det + misfit + np.linalg.slogdet(of_data)[1])
        logs.append(log_p + log_l)
        means.append(prior_mean[k:] + gain @ away)
        roots.append(covariance[:, k:, k:] - gain @ covariance[:, :k, k:])
    log_weights = np.ravel(logs)
    weights = np.exp(log_weights - log_weights.max())
    rng = np.random.default_rng(seed)
    rows = rng.choice(len(weights), 8000, p=weights / weights.sum())
    mean, variance = np.reshape(means, (-1, 3)), np.reshape(roots, (-1, 3, 3))
    deviations = np.sqrt(np.diagonal(variance, axis1=1, axis2=2))
    normal = mean[rows] + deviations[rows] * rng.normal(size=(len(rows), 3))
    step = np.log(spreads[1] / spreads[0])
    sd = spreads[rows // log_prior.shape[1]] * np.exp(step * (rng.random(len(rows)) - 0.5))
    return np.column_stack([sd, normal[:, 2], normal[:, :2]])


def sampled_draws(y: Any, seed: int) -> Any:
    """Return draws of prb.sample, (n, 4): sd, mean, and forces at the new deflections."""
    shape = SHAPES["smooth"]
    (m,) = shape.event
    with pm.Model() as model:
        mean = pm.Normal("mean", 5, 3)
        sd = pm.HalfNormal("sd", 1)
        b = pm.MvStudentT("b", nu=DEGREES, mu=np.zeros(m), scale=SCALE**2 * np.eye(m))
        terms = np.array([shape.value(unit, NEW) for unit in np.eye(m)[:, None]])
        pm.Deterministic("force", mean * NEW + pt.dot(b, terms))
        error = pm.MvNormal.dist(np.zeros(len(TESTS)), ERROR**2 * np.eye(len(TESTS)))
        prb.Simulator(
            "y",
            shape.of(lambda x, e: np.asarray(x)[..., None] * TESTS + e, TESTS),
            pm.Normal.dist(mean, sd),
            error,
            b,
            observed=y,
            metric=prb.Joint(prb.KullbackLeibler()),
            propagation=prb.Resimulated(256),
        )
    idata = prb.sample(1000, chains=2, model=model, random_seed=seed, progressbar=False)
    draws = idata["posterior"]
    columns = [np.ravel(draws[name]) for name in ("sd", "mean")]
    return np.column_stack([*columns, np.asarray(draws["force"]).reshape(-1, len(NEW))])


def row(cell: str, number: int) -> Any:
    """Return which intervals contain the truth, their widths, moments, and CPU seconds."""
    truth, kind = cell.split("/")
    start = time.process_time()
    y = readings(truth, number)
    draws = sampled_draws(y, number) if kind == "prb.sample" else exact_draws(y, kind, number)
    low, high = np.quantile(draws, (0.055, 0.945), axis=0)
    true = np.concatenate([[SD, MEAN], MEAN * NEW + TRUTHS[truth](NEW)])
    return {
        "inside": ((low <= true) & (true <= high)).astype(int).tolist(),
        "width": (high - low).round(4).tolist(),
        "mean": draws.mean(axis=0).round(4).tolist(),
        "sd": draws.std(axis=0).round(4).tolist(),
        "cpu": round(time.process_time() - start, 2),
    }


def summary(rows: list[Any]) -> dict[str, Any]:
    """Return coverage and mean width of each quantity."""
    figures: dict[str, Any] = {"data sets": len(rows)}
    for key in ("inside", "width", "mean", "sd"):
        average = np.mean([r[key] for r in rows], axis=0)
        figures[key] = dict(zip(NAMES, average.round(3).tolist(), strict=True))
    return figures | {"cpu seconds of one": float(np.mean([r["cpu"] for r in rows]).round(1))}


STUDY = Study("discrepancy", __doc__ or "", CELLS, row, 400, summary, has_rows=False)

if __name__ == "__main__":
    STUDY.main()
