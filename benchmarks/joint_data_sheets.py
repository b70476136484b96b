"""Coverage of intervals from data sheets of two outputs, and the price against the specimens.

Two outputs are linear in two normal inputs. Their sheets have means and standard deviations of the
same n specimens, and extremes in some cells. The means of the inputs have normal priors, their standard deviations lognormal
ones, and the truth is a draw of the prior, so that 89% intervals of the exact posterior contain it
in 89% of all sheets. Posteriors are importance samples. Figures are the shares of intervals with
the truth, and posterior standard deviations relative to those from the specimens themselves: of
the sheets together, and as if they were of separate specimens.

    OMP_NUM_THREADS=1 uv run python -m benchmarks.joint_data_sheets [--data-sets 300]
"""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
from scipy.special import ndtri

from benchmarks.data_sheets import sheet_of
from benchmarks.study import Study
from prbayes.metrics.joint_summary import JointSummaryLikelihood, values_of_sheets
from prbayes.numerics.points import sobol

# Rows are outputs. Correlations of outputs with inputs of the same spread are .32 and .89.
OUTPUTS = {
    "weakly correlated": np.array([[1.0, 1.0], [1.0, -0.5]]),
    "correlated": np.array([[1.0, 1.0], [1.0, 3.0]]),
}
SIZES = (5, 20, 100)
CELLS = [f"{kind}, {n}, mean sd" for kind, n in product(OUTPUTS, SIZES)]
CELLS += [f"{kind}, 20, mean sd extremes" for kind in OUTPUTS]
NAMES = ("mu 1", "mu 2", "sigma 1", "sigma 2")
FORMS = ("specimens", "together", "separate")
PRIOR_SD = np.array([10.0, 10.0, 0.5, 0.5])
DRAWS = {"mean sd": 8000, "mean sd extremes": 1500}


def nodes(statistics: str) -> tuple[Any, Any]:
    """Return standard normal points, (n, 2), and their weights.

    For means and standard deviations it is a rule that is exact for the moments.
    """
    if "extremes" in statistics:
        points = ndtri(sobol(256, 2, 0))
        return points, np.full(256, 1 / 256)
    x, w = np.polynomial.hermite_e.hermegauss(5)
    points = np.stack(np.meshgrid(x, x, indexing="ij"), axis=-1).reshape(-1, 2)
    weights = np.outer(w, w).ravel()
    return points, weights / weights.sum()


def log_likelihoods(x: Any, map_: Any, statistics: str, thetas: Any) -> dict[str, Any]:
    """Return log-likelihoods of specimens' inputs (n, 2), by form, at thetas (S, 4)."""
    n = len(x)
    mu, sigma = thetas[:, :2], np.exp(thetas[:, 2:])
    squares = n * (x.var(axis=0) + (x.mean(axis=0) - mu) ** 2)
    y = x @ map_.T
    sheets = tuple(sheet_of(v, statistics) for v in y.T)
    points, weights = nodes(statistics)
    responses = (mu[:, None] + sigma[:, None] * points) @ map_.T
    joint = JointSummaryLikelihood(("1", "2"), sheets).against(values_of_sheets(sheets))
    members = joint.members  # type: ignore[attr-defined]
    separate = sum(-n * member.of(responses[..., k], weights) for k, member in enumerate(members))
    return {
        "specimens": (-n * np.log(sigma) - 0.5 * squares / sigma**2).sum(axis=1),
        "together": -n * joint.of(responses, weights),
        "separate": separate,
    }


def row(cell: str, seed: int) -> dict[str, float]:
    """Return posterior distribution functions at the truth, and posterior standard deviations."""
    kind, size, statistics = cell.split(", ")
    n = int(size)
    rng = np.random.default_rng([seed, n])
    truth = PRIOR_SD * rng.standard_normal(4)
    x = truth[:2] + np.exp(truth[2:]) * rng.standard_normal((n, 2))
    # Proposals about the estimates, wide enough for sheets that count as separate.
    estimates = np.concatenate([x.mean(axis=0), np.log(x.std(axis=0, ddof=1))])
    errors = np.repeat([2.0 * np.exp(estimates[2:]).max() / np.sqrt(n), 2.0 / np.sqrt(2 * n)], 2)
    z = rng.standard_t(5, (DRAWS[statistics], 4))
    thetas = estimates + errors * z
    log_proposal = -3 * np.log1p(z**2 / 5).sum(axis=1)
    log_prior = -0.5 * ((thetas / PRIOR_SD) ** 2).sum(axis=1)
    figures: dict[str, Any] = {}
    for form, log_l in log_likelihoods(x, OUTPUTS[kind], statistics, thetas).items():
        log_w = log_l + log_prior - log_proposal
        w = np.exp(log_w - log_w.max())
        w /= w.sum()
        mean = w @ thetas
        sd = np.sqrt(w @ (thetas - mean) ** 2)
        below = w @ (thetas < truth)
        for k, name in enumerate(NAMES):
            figures |= {f"{form}, {name}, sd": sd[k], f"{form}, {name}": below[k]}
        figures[f"{form}, effective"] = 1 / (w @ w)
    return {key: float(value) for key, value in figures.items()}


def summary(rows: list[dict[str, float]]) -> dict[str, float]:
    """Return shares of intervals with the truth, and ratios of standard deviations."""
    figures: dict[str, float] = {"sheets": len(rows)}
    for form, name in product(FORMS, NAMES):
        levels = np.array([row[f"{form}, {name}"] for row in rows])
        figures[f"{form}, {name}"] = float(np.mean((levels > 0.055) & (levels < 0.945)))
        ratios = [row[f"{form}, {name}, sd"] / row[f"specimens, {name}, sd"] for row in rows]
        figures[f"{form}, {name}, sd ratio"] = float(np.median(ratios))
    for form in FORMS:
        figures[f"{form}, effective"] = float(
            np.median([row[f"{form}, effective"] for row in rows])
        )
    return figures


STUDY = Study("joint_data_sheets", __doc__, CELLS, row, 300, summary, has_rows=False)

if __name__ == "__main__":
    STUDY.main()
