"""One measured value in twenty is gross: eight standard deviations above the mean.

The reference is of the data without the gross values. Beside the exact posterior of all values with
an unknown share of gross errors, the rows of ``prbayes likelihood`` are scored by

    python -m benchmarks.scoreboard.problems.contaminated
"""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from scipy.special import logsumexp
from scipy.stats import beta, norm

from benchmarks.scoreboard import exact
from benchmarks.scoreboard.problem import Input, Problem, Reference
from benchmarks.scoreboard.problems.linear import PRIORS, TRUTH
from benchmarks.scoreboard.score import score

SHARE, DISTANCE = 0.05, 8.0


def clean(size: int, replicate: int) -> Any:
    """Draw specimens."""
    return np.random.default_rng([3, size, replicate]).normal(10.0, 1.0, size)


def data(size: int, replicate: int) -> Any:
    """Return the specimens, the last of which are replaced by gross values."""
    values = clean(size, replicate)
    values[size - round(SHARE * size) :] = 10.0 + DISTANCE
    return values


@cache
def reference(size: int, replicate: int) -> Reference:
    """Return the exact posterior of the specimens before the gross values came."""
    likelihood = exact.normal_log_likelihood(clean(size, replicate))
    return exact.posterior(PRIORS, likelihood)


PROBLEM = Problem(
    name="contaminated",
    what="y = x, x normal, and 5% of the values are gross: the reference is of the data without them.",
    licence="drawn here",
    priors=PRIORS,
    inputs=(Input("normal", "mu", "sigma"),),
    formula=lambda xp, x: x,
    sizes=(20, 100),
    data=data,
    reference=reference,
    truth=TRUTH,
)


def of_all_values(size: int, replicate: int) -> Reference:
    """Return the exact posterior of all values: a Beta(1, 9) share is uniform over twice the range."""
    values, counts = np.unique(data(size, replicate), return_counts=True)
    gross = 1 / (2 * np.ptp(values))
    share = beta.ppf((np.arange(64) + 0.5) / 64, 1, 9)[:, None]

    def log_likelihood(mu: Any, sigma: Any) -> Any:
        logs = sum(
            count * np.log((1 - share) * norm.pdf(value, mu, sigma) + share * gross)
            for value, count in zip(values, counts, strict=True)
        )
        return logsumexp(logs, axis=0)

    return exact.posterior(PRIORS, log_likelihood, points=81)


def main() -> None:
    """Print the score of the stored rows of the log-likelihood by specimen."""
    from benchmarks.scoreboard.study import STORE, path_of

    path = path_of(STORE, "prbayes likelihood", PROBLEM.name)
    rows = json.loads(path.read_text(encoding="utf-8"))["found"]["rows"]
    for size in PROBLEM.sizes:
        print(size, score(replace(PROBLEM, reference=of_all_values), size, rows))


if __name__ == "__main__":
    main()
