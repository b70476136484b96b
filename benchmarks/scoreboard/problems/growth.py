"""Growth factor and its receptor: active receptors of cells after ten minutes at two doses.

Drovandi et al. (2022), Population calibration using likelihood-free Bayesian inference, arXiv
2202.01962. Receptors per cell R_T and the rate of binding k1 vary between cells; other rates are fixed. A cell is measured once, at one dose, so that both outputs are of cells of their own: one reading
has two inputs. The authors' data have no licence; data are drawn here from the population that
their chain starts from.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from scipy import optimize, stats
from scipy.special import logsumexp

from benchmarks.scoreboard import exact
from benchmarks.scoreboard.problem import Input, Problem, Reference, uniform

DOSES, TIME = (2.0, 10.0), 10.0
UNBINDING, DEGRADATION, INTERNALISATION = 8.0, 0.015, 0.25
TRUTH = {"mean RT": 6.5e5, "sd RT": 77.4597, "mean k1": 1.7, "sd k1": 0.2236}
PRIORS = {
    "mean RT": uniform(2.5e5, 8e5),
    "sd RT": uniform(0.0, 200.0),
    "mean k1": uniform(0.25, 3.0),
    "sd k1": uniform(0.0, 2.0),
}
_RATES = np.geomspace(0.01, 15.0, 20001)  # of binding; the active share increases with them
_NODES = stats.norm.ppf((np.arange(16) + 0.5) / 16)  # of receptors per cell
_POINTS = 2**14  # of the importance sampling, whose effective size is about .8 of that


def active_share(xp: Any, k1: Any, dose: float) -> Any:
    """Return active over total receptors: the last state of two linear rate equations.

    Free receptors R and active ones P begin at zero:
    R' = kdeg - (k1 L + kdeg) R + km1 P,  P' = k1 L R - (km1 + kint) P.
    """
    binding = k1 * dose
    loss, gain = binding + DEGRADATION, UNBINDING + INTERNALISATION
    determinant = loss * gain - binding * UNBINDING
    root = xp.sqrt((loss - gain) ** 2 + 4 * binding * UNBINDING)
    slow, fast = (root - loss - gain) / 2, (-root - loss - gain) / 2
    steady = binding * DEGRADATION / determinant
    return steady * (1 + (fast * xp.exp(slow * TIME) - slow * xp.exp(fast * TIME)) / root)


def formula(xp: Any, receptors: Any, k1: Any) -> list[Any]:
    """Return active receptors of a cell at either dose; NaN of negative rates, which explode."""
    k1 = xp.where(k1 > 0, k1, np.nan)
    return [receptors * active_share(xp, k1, dose) for dose in DOSES]


def data(size: int, replicate: int) -> Any:
    """Draw active receptors, (N, 2); each number is of a cell of its own."""
    z = np.random.default_rng([8, size, replicate]).standard_normal((2, size, 2))
    receptors = TRUTH["mean RT"] + TRUTH["sd RT"] * z[0]
    k1 = TRUTH["mean k1"] + TRUTH["sd k1"] * z[1]
    columns = [receptors[:, j] * active_share(np, k1[:, j], dose) for j, dose in enumerate(DOSES)]
    return np.stack(columns, axis=1)


@cache
def _table(dose: float) -> tuple[Any, Any]:
    """Return logarithms of active shares, and log(dk1 / dlog share), at the rates."""
    logs = np.log(active_share(np, _RATES, dose))
    slope = np.gradient(logs, np.log(_RATES))
    return logs, np.log(_RATES) - np.log(slope)


def log_density(y: Any, dose: float, theta: Any) -> Any:
    """Return the log-density of readings (N,) under populations (S, 4), (S, N).

    Given the receptors of a cell, its reading identifies its rate of binding.
    """
    mean_rt, sd_rt, mean_k1, sd_k1 = np.transpose(theta)[..., None, None]
    receptors = mean_rt + sd_rt * _NODES
    logs, jacobian = _table(dose)
    share = np.log(y)[None, :, None] - np.log(receptors)
    inside = (share > logs[0]) & (share < logs[-1])
    k1 = np.exp(np.interp(share, logs, np.log(_RATES)))
    log_p = stats.norm.logpdf((k1 - mean_k1) / sd_k1) - np.log(sd_k1)
    log_p = log_p + np.interp(share, logs, jacobian)
    log_p = np.where(inside, log_p, -np.inf) - np.log(y)[None, :, None]
    return logsumexp(log_p, axis=2) - np.log(len(_NODES))


def log_posterior(y: Any, u: Any) -> Any:
    """Return the log-posterior of logits u (S, 4) of the places between the priors' bounds."""
    log_p = -np.logaddexp(0, u).sum(axis=1) - np.logaddexp(0, -u).sum(axis=1)
    for rows in np.array_split(np.arange(len(u)), max(1, len(u) // 256)):
        theta = np.stack(list(_bounded(u[rows]).values()), axis=1)
        for column, dose in zip(y.T, DOSES, strict=True):
            log_p[rows] += log_density(column, dose, theta).sum(axis=1)
    return log_p


def _bounded(u: Any) -> dict[str, Any]:
    columns = zip(PRIORS.items(), np.transpose(u), strict=True)
    return {
        name: prior.arguments[0] + prior.arguments[1] / (1 + np.exp(-column))
        for (name, prior), column in columns
    }


@cache
def reference(size: int, replicate: int) -> Reference:
    """Return the exact posterior, by importance sampling around its mode."""
    y = data(size, replicate)
    places = [(TRUTH[k] - p.arguments[0]) / p.arguments[1] for k, p in PRIORS.items()]
    start = np.log(places) - np.log1p(np.negative(places))

    def negative(u: Any) -> Any:
        return -log_posterior(y, u[None])[0]

    mode = optimize.minimize(negative, start, method="Nelder-Mead")
    center, scale = mode.x, np.linalg.cholesky(1.2 * _curvature(negative, mode.x))
    z = stats.qmc.Sobol(5, seed=0).random(_POINTS)
    radius = np.sqrt(5 / stats.chi2.ppf(z[:, 4], 5))
    standard = stats.norm.ppf(z[:, :4]) * radius[:, None]
    u = center + standard @ scale.T
    proposal = -(5 + 4) / 2 * np.log1p((standard**2).sum(axis=1) / 5)
    logs = log_posterior(y, u) - proposal
    return exact.moments("exact posterior", _bounded(u), np.exp(logs - logs.max()))


def _curvature(function: Any, at: Any) -> Any:
    """Return the inverse of the Hessian by central differences."""
    steps = 0.02 * np.eye(len(at))

    def second(a: Any, b: Any) -> Any:
        upper = function(at + a + b) - function(at + a - b)
        lower = function(at - a + b) - function(at - a - b)
        return (upper - lower) / 0.0016

    return np.linalg.inv(np.array([[second(a, b) for b in steps] for a in steps]))


PROBLEM = Problem(
    name="growth",
    what="Active receptors of 100 cells at each of two doses; receptors and binding rate are normal.",
    licence="drawn here; the model of Drovandi et al. (2022), whose data have no licence",
    priors=PRIORS,
    inputs=(Input("normal", "mean RT", "sd RT"), Input("normal", "mean k1", "sd k1")),
    formula=formula,
    sizes=(100,),
    data=data,
    reference=reference,
    truth=TRUTH,
    separate=True,
)
