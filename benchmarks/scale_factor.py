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

import argparse
import logging
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm

import prbayes as prb
from benchmarks import record

MAXIMA = (5000.0, 0.005)
BASES = (1, 10, 100, 1000)
BINS = 40


def fit(maximum: float, base: int, form: str, method: str, parameters: str) -> tuple[int, float]:
    """Return the number of evaluations and the largest error, in standard deviations."""
    from scipy.optimize import minimize
    from scipy.stats import norm

    sd = 1 / (np.sqrt(2 * np.pi) * maximum)
    mean, start = 10 * sd, np.array([12 * sd, 1.5 * sd])
    scale = float(base) ** -np.floor(np.log10(maximum))
    width = 8 * sd / BINS
    centers = mean + width * (np.arange(BINS) - (BINS - 1) / 2)
    q = norm.pdf(centers, mean, sd)

    def raw(p: Any) -> float:
        mu, sigma = p
        if not sigma > 0:
            return np.inf
        if form == "sum":
            return float(scale * ((norm.pdf(centers, mu, sigma) - q) ** 2).sum())
        cross = norm.pdf(mu - mean, scale=np.hypot(sigma, sd))
        return float(scale * ((1 / sigma + 1 / sd) / (2 * np.sqrt(np.pi)) - 2 * cross))

    def back(t: Any) -> Any:
        return (
            np.array([start[0] + t[0] * start[1], start[1] * np.exp(t[1])])
            if parameters == "standardised"
            else t
        )

    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        found = minimize(
            lambda t: raw(back(t)),
            np.zeros(2) if parameters == "standardised" else start,
            method=method,
        )
    return int(found.nfev), float(np.abs(back(found.x) - [mean, sd]).max() / sd)


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


def main() -> None:
    """Fit all combinations, print a table, write JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=record.RESULTS / "scale_factor.json")
    arguments = parser.parse_args()
    logging.getLogger("prbayes").setLevel(logging.ERROR)
    out: dict[str, Any] = {}
    print(
        "evaluations, finite differences included; in brackets the error in sd where the fit failed"
    )
    print(
        f"{'max q':>6s} {'form':9s} {'method':12s} {'parameters':13s} "
        + " ".join(f"{f'C = {c}':>15s}" for c in BASES)
    )
    for maximum in MAXIMA:
        for form in ("sum", "integral"):
            for method in ("BFGS", "Nelder-Mead"):
                for parameters in ("raw", "standardised"):
                    found = [fit(maximum, base, form, method, parameters) for base in BASES]
                    out[f"{maximum}/{form}/{method}/{parameters}"] = found
                    cells = [f"{n}" if e < 0.01 else f"{n} ({e:.2g})" for n, e in found]
                    print(f"{maximum:6g} {form:9s} {method:12s} {parameters:13s} "
                          + " ".join(f"{c:>15s}" for c in cells), flush=True)  # fmt: skip
    print(
        "\nprb.minimize, integral form, BFGS: evaluations of value and gradient, mu / sd, sigma / sd"
    )
    for maximum in MAXIMA:
        own = [packages(maximum, base) for base in BASES]
        out[f"{maximum}/prbayes"] = own
        print(
            f"{maximum:6g} "
            + " ".join(
                f"C = {c}: {n}, {m:.6f}, {s:.6f};" for c, (n, m, s) in zip(BASES, own, strict=True)
            )
        )
    record.save(arguments.out, out)


if __name__ == "__main__":
    main()
