"""The scale factor of the probability residual: figures 7 and 8 of the paper, with every combination beside them.

A normal population is fitted to a normal density with a maximum of 5000 or of 0.005, both in closed
form. The mean is ten standard deviations; the start is two of them too high, with a spread half too
large. C = 1, 10, 100, 1000; the sum over 40 bins (eq. 8) and the integral (eq. 9); BFGS and
Nelder-Mead with scipy's default tolerances; on raw parameters (mu, sigma), and on standardised
ones, mu in units of the initial spread and log sigma. A fit has failed if it is off by more than a
per cent of the standard deviation. Last, `prb.minimize`, whose tolerances are relative.

    uv run python -m benchmarks.scale_factor
"""

from __future__ import annotations

import warnings
from itertools import product
from typing import Any

import numpy as np
import pymc as pm
from scipy.optimize import minimize
from scipy.stats import norm

import prbayes as prb
from benchmarks.study import Study

MAXIMA = (5000.0, 0.005)
BASES = (1, 10, 100, 1000)
BINS = 40


def fit(maximum: float, base: int, form: str, method: str, parameters: str) -> tuple[int, float]:
    """Return the number of evaluations and the largest error, in standard deviations."""
    sd = 1 / (np.sqrt(2 * np.pi) * maximum)
    mean, start = 10 * sd, np.array([12 * sd, 1.5 * sd])
    scale = float(base) ** -np.floor(np.log10(maximum))
    width = 8 * sd / BINS
    centers = mean + width * (np.arange(BINS) - (BINS - 1) / 2)
    q = norm.pdf(centers, mean, sd)
    is_raw = parameters == "raw"

    def residual(p: Any) -> float:
        mu, sigma = p
        if not sigma > 0:
            return np.inf
        if form == "sum":
            return float(scale * ((norm.pdf(centers, mu, sigma) - q) ** 2).sum())
        cross = norm.pdf(mu - mean, scale=np.hypot(sigma, sd))
        return float(scale * ((1 / sigma + 1 / sd) / (2 * np.sqrt(np.pi)) - 2 * cross))

    def back(t: Any) -> Any:
        return t if is_raw else np.array([start[0] + t[0] * start[1], start[1] * np.exp(t[1])])

    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        first = start if is_raw else np.zeros(2)
        best = minimize(lambda t: residual(back(t)), first, method=method)
    return int(best.nfev), float(np.abs(back(best.x) - [mean, sd]).max() / sd)


def packages(maximum: float, base: int) -> tuple[int, float, float]:
    """Return evaluations, mu and sigma by `prb.minimize`, in standard deviations of the data."""
    sd = 1 / (np.sqrt(2 * np.pi) * maximum)
    data = np.random.default_rng(0).normal(10 * sd, sd, 1000)
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 12 * sd, 3 * sd), pm.HalfNormal("sigma", 3 * sd))
        metric = prb.ProbabilityResidual(scale_base=base)
        prb.Simulator(
            "y", lambda x: x, x, metric=metric, observed=data, propagation=prb.Resimulated(4096)
        )
    optimum = prb.minimize(start={"mu": 12 * sd, "sigma": 1.5 * sd}, model=model)
    return optimum.search.n_evaluations, optimum.point["mu"] / sd, optimum.point["sigma"] / sd


def row(cell: str, number: int) -> list[Any]:
    """Return the figures of each C."""
    maximum, *case = cell.split("/")
    if case == ["prbayes"]:
        return [packages(float(maximum), base) for base in BASES]
    form, method, parameters = case
    return [fit(float(maximum), base, form, method, parameters) for base in BASES]


CASES = list(product(("sum", "integral"), ("BFGS", "Nelder-Mead"), ("raw", "standardised")))
CELLS = [f"{maximum}/{'/'.join(case)}" for maximum, case in product(MAXIMA, CASES)]
CELLS += [f"{maximum}/prbayes" for maximum in MAXIMA]
STUDY = Study("scale_factor", __doc__, CELLS, row, 1)

if __name__ == "__main__":
    STUDY.main()
