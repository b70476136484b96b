"""Dose histories of each subject's own: the optimum beside maximum likelihood by quadrature.

Data are drawn like those of phenobarbital in neonates: 59 subjects with 2 to 15 doses each at times
of their own, 155 readings, nine subjects with one, clearance and volume log-normal with the weight
as a covariate, an additive error. A row has the difference of each estimate in standard errors of
the quadrature's estimate, which integrates each subject over its two inputs by Gauss-Hermite rules
about its mode, and CPU seconds of `prb.minimize`.

    OMP_NUM_THREADS=1 uv run python -m benchmarks.histories
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pymc as pm
from scipy.optimize import minimize
from scipy.special import logsumexp, roots_hermite

import prbayes as prb
from benchmarks.study import Study

SUBJECTS, READINGS, MOST, NODES = 59, 155, 6, 12
# Intercept and slope by weight of log clearance and log volume; logs of both spreads and the error.
NAMES = ("cl", "cl_weight", "v", "v_weight", "spread_cl", "spread_v", "error")
TRUTH = np.r_[-5.96, 0.62, -0.485, 0.533, np.log([0.216, 0.172, 2.74])]


def concentration(clearance: Any, volume: Any, record: dict[str, Any]) -> Any:
    """Return concentrations at the hours of the readings, (..., T)."""
    rate = np.asarray(clearance / volume)[..., None, None]
    age = record["read_h"][:, None] - record["dose_h"]
    left = np.where(age >= 0, np.exp(-rate * np.maximum(age, 0)), 0)
    return (record["dose_mg"] * left).sum(axis=-1) / np.asarray(volume)[..., None]


def data_set(rng: np.random.Generator) -> tuple[Any, list[dict[str, Any]], Any]:
    """Return weights in kg, dose histories, and readings in mg/l, (N, 6)."""
    weight = np.clip(rng.lognormal(np.log(1.35), 0.45, SUBJECTS), 0.6, 3.6).round(1)
    scatter = np.exp(TRUTH[4:6]) * rng.standard_normal((SUBJECTS, 2))
    clearance = np.exp(TRUTH[0] + TRUTH[1] * weight + scatter[:, 0])
    volume = np.exp(TRUTH[2] + TRUTH[3] * weight + scatter[:, 1])
    counts = np.ones(SUBJECTS, dtype=int)
    while counts.sum() < READINGS:
        subject = rng.integers(9, SUBJECTS)
        counts[subject] += counts[subject] < MOST
    records, readings = [], np.full((SUBJECTS, MOST), np.nan)
    for i, count in enumerate(counts):
        doses = rng.integers(2, 16)
        hours = np.r_[0.0, np.cumsum(rng.normal(12, 0.7, doses - 1))].round(1)
        amounts = np.r_[20 * weight[i], np.full(doses - 1, 2.5 * weight[i])].round(1)
        read = np.sort(rng.uniform(1, hours[-1] + 24, count)).round(1)
        records.append({"dose_h": hours, "dose_mg": amounts, "read_h": read})
        exact = concentration(clearance[i], volume[i], records[-1])
        readings[i, :count] = exact + np.exp(TRUTH[6]) * rng.standard_normal(count)
    return weight, records, readings.round(1)


def subject_log_likelihood(
    theta: Any, weight: float, record: dict[str, Any], readings: Any
) -> float:
    """Return the log-likelihood of a subject by quadrature about the mode of its inputs."""
    spreads, error = np.exp(theta[4:6]), np.exp(theta[6])
    center = np.r_[theta[0] + theta[1] * weight, theta[2] + theta[3] * weight]

    def misfits(u: Any) -> Any:
        inputs = np.exp(center + spreads * u)
        values = concentration(inputs[..., 0], inputs[..., 1], record)
        return (readings - values) / error

    def slopes(u: Any) -> Any:
        steps = 1e-5 * np.eye(2)
        return np.stack([(misfits(u + h) - misfits(u - h)) / 2e-5 for h in steps], axis=-1)

    u = np.zeros(2)
    for _ in range(12):
        jacobian = slopes(u)
        precision = jacobian.T @ jacobian + np.eye(2)
        step = np.linalg.solve(precision, jacobian.T @ misfits(u) + u)
        u = u - step
        if np.abs(step).max() < 1e-6:
            break
    nodes, weights = roots_hermite(NODES)
    pairs = np.sqrt(2) * np.stack(np.meshgrid(nodes, nodes), axis=-1).reshape(-1, 2)
    log_weights = np.log(np.outer(weights, weights).ravel() / np.pi)
    root = np.linalg.cholesky(np.linalg.inv(precision))
    points = u + pairs @ root.T
    logs = -((misfits(points) ** 2).sum(axis=1) + (points**2 - pairs**2).sum(axis=1)) / 2
    constant = readings.size * (np.log(error) + np.log(2 * np.pi) / 2)
    return float(logsumexp(logs + log_weights) + np.log(np.diag(root)).sum() - constant)


def maximum_likelihood(weight: Any, records: Any, readings: Any) -> tuple[Any, Any]:
    """Return estimates by quadrature, and their standard errors by the observed information."""

    def objective(theta: Any) -> float:
        rows = zip(weight, records, readings, strict=True)
        return -sum(subject_log_likelihood(theta, w, r, y[~np.isnan(y)]) for w, r, y in rows)

    theta = minimize(objective, TRUTH, method="BFGS", options={"gtol": 1e-3}).x
    steps, size = 2e-3 * np.eye(theta.size), theta.size
    hessian = np.empty((size, size))
    for i in range(size):
        for j in range(i, size):
            signs = [(a, b) for a in (1, -1) for b in (1, -1)]
            values = [a * b * objective(theta + a * steps[i] + b * steps[j]) for a, b in signs]
            hessian[i, j] = hessian[j, i] = sum(values) / (4 * 2e-3**2)
    return theta, np.sqrt(np.diag(np.linalg.inv(hessian)))


def model_of(weight: Any, records: Any, readings: Any) -> pm.Model:
    """Return the model of a data set."""
    with pm.Model() as model:
        covariate = prb.response.condition("weight", weight)
        cl, cl_weight = pm.Normal("cl", -6, 0.7), pm.Normal("cl_weight", 0.5, 0.3)
        v, v_weight = pm.Normal("v", -0.5, 0.5), pm.Normal("v_weight", 0.5, 0.3)
        spreads = [pm.LogNormal(f"spread_{x}", np.log(0.2), 0.5) for x in ("cl", "v")]
        error = pm.LogNormal("error", np.log(3), 0.3)
        clearance = pm.LogNormal.dist(cl + cl_weight * covariate, spreads[0])
        volume = pm.LogNormal.dist(v + v_weight * covariate, spreads[1])
        response = prb.response.by_specimen(concentration, records)
        metric = prb.LogLikelihood(error=error)
        prb.Simulator("drug", response, clearance, volume, observed=readings, metric=metric)
    return model


def differences(cell: str, number: int) -> dict[str, float]:
    """Return CPU seconds, and differences from maximum likelihood in standard errors."""
    data = data_set(np.random.default_rng(number))
    estimates, errors = maximum_likelihood(*data)
    model = model_of(*data)
    start = time.process_time()
    optimum = prb.minimize(model)
    row = {"cpu_seconds": time.process_time() - start, "runs": float(optimum.n_responses)}
    for place, name in enumerate(NAMES):
        value = optimum.point[name] if place < 4 else np.log(optimum.point[name])
        row[name] = float((value - estimates[place]) / errors[place])
    return row


STUDY = Study("histories", __doc__ or "", ("59 subjects",), differences, data_sets=4)

if __name__ == "__main__":
    STUDY.main()
