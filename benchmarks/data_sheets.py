"""Coverage of intervals from data sheets: statistics of n specimens under location-scale populations.

Responses are mu + sigma e, where e is normal, of Gumbel's or a gamma distribution (of shape 3), with
mean zero and variance one. A sheet has statistics of n specimens at mu = 0 and sigma = 1. With a flat
prior of mu and log sigma, intervals of the exact posterior contain the truth in 89% of all sheets.
The posterior is computed on a grid, from the package's likelihood with quadrature weights of stored
responses.

    OMP_NUM_THREADS=1 uv run python -m benchmarks.data_sheets [--data-sets 1000] [--cells "normal*"]
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from scipy import stats

import prbayes as prb
from benchmarks.study import Study
from prbayes.metrics.summary_likelihood import SummaryLikelihood

POPULATIONS = {
    "normal": stats.norm(),
    "Gumbel": stats.gumbel_r(-np.euler_gamma * np.sqrt(6) / np.pi, np.sqrt(6) / np.pi),
    "gamma": stats.gamma(3, -np.sqrt(3), 1 / np.sqrt(3)),
}
SHEETS = ("mean sd", "extremes", "mean sd extremes", "quartiles", "all")
SIZES = (5, 20, 100)
CELLS = [f"{p}, {n}, {kind}" for p in POPULATIONS for n in SIZES for kind in SHEETS]
NODES = 41


def sheet_of(y: Any, kind: str) -> prb.Summary:
    """Return the statistics of specimens."""
    given: dict[str, Any] = {}
    if "mean" in kind or kind == "all":
        given |= {"mean": y.mean(), "sd": y.std(ddof=1)}
    if "extremes" in kind or kind == "all":
        given |= {"minimum": y.min(), "maximum": y.max()}
    if kind in ("quartiles", "all"):
        levels = (0.25, 0.5, 0.75)
        given["quantiles"] = dict(zip(levels, np.quantile(y, levels), strict=True))
    return prb.Summary(n=len(y), **given)


@lru_cache(maxsize=1)
def grid(population: str, n: int) -> tuple[Any, ...]:
    """Return mu and log sigma, their steps, stored responses, and weights, (NODES^2, responses)."""
    t = np.linspace(-1, 1, NODES)
    nodes, steps = np.sinh(3 * t), np.cosh(3 * t)
    mu, log_sigma = 1.0 * nodes / np.sqrt(n), 0.6 * nodes / np.sqrt(n)
    y = 0.05 * np.sinh(np.linspace(-8, 8, 1201))
    widths = np.gradient(y)
    e = (y - mu[:, None, None]) / np.exp(log_sigma)[:, None]
    with np.errstate(over="ignore"):  # of a Gumbel density far below
        weights = POPULATIONS[population].pdf(e) * widths
    weights = weights.reshape(-1, y.size)
    return mu, log_sigma, steps, y, weights / weights.sum(axis=1, keepdims=True)


def row(cell: str, seed: int) -> dict[str, float]:
    """Return the posterior distribution functions of mu and sigma at the truth."""
    population, size, kind = cell.split(", ")
    n = int(size)
    rng = np.random.default_rng([seed, n])
    sheet = sheet_of(POPULATIONS[population].rvs(n, random_state=rng), kind)
    mu, log_sigma, steps, y, weights = grid(population, n)
    target = SummaryLikelihood(sheet).against(sheet.values)
    log_l = -n * target.outer(*target.basis(y).features(weights), xp=np)
    log_l = log_l.reshape(NODES, NODES)
    mass = np.exp(log_l - log_l.max()) * np.outer(steps, steps)
    levels = {}
    for name, nodes, axis in (("mu", mu, 1), ("sigma", log_sigma, 0)):
        share = mass.sum(axis=axis) / mass.sum()
        below = np.cumsum(share) - share / 2
        levels[name] = float(np.interp(0.0, nodes, below))
    return levels


def summary(rows: list[dict[str, float]]) -> dict[str, float]:
    """Return the shares of sheets whose 89% intervals contain the truth."""
    figures: dict[str, float] = {"sheets": len(rows)}
    for name in ("mu", "sigma"):
        levels = np.array([row[name] for row in rows])
        figures[name] = float(np.mean((levels > 0.055) & (levels < 0.945)))
        figures[f"{name}, mean level"] = float(levels.mean())
    return figures


STUDY = Study("data_sheets", __doc__, CELLS, row, 1000, summary, has_rows=False)

if __name__ == "__main__":
    STUDY.main()
