"""Power of the area test on fresh data, after a calibration, beside that of other tests of uniformity.

All tests use the same u-values in the posterior's pool (in closed form, Student's t), and critical
values from the same simulation of a right model, so that each has the nominal size. Alternatives are
shifts of the mean and ratios of the standard deviation.

    uv run python -m benchmarks.power
"""

from __future__ import annotations

from typing import Any

import numpy as np
from arviz_stats.base.array import array_stats
from scipy.special import stdtr
from scipy.stats import cramervonmises, kstest

from benchmarks.study import Study
from prbayes.validation.pit import area

FITTED, FRESH = 30, 20
ALTERNATIVES = {"none": (0.0, 1.0)}
ALTERNATIVES |= {f"mean + {d:g} sd": (d, 1.0) for d in (0.5, 0.75, 1.0)}
ALTERNATIVES |= {f"sd x {r:g}": (0.0, r) for r in (0.5, 1.5, 2.0)}
ARVIZ = ("pot_c", "prit_c", "piet_c")


def u_in_pool(shift: float, ratio: float, replicates: int, seed: int) -> Any:
    """Return u-values of fresh data in the posterior predictive distribution, sorted, (replicates, n)."""
    rng = np.random.default_rng([9, seed])
    data = rng.normal(size=(replicates, FITTED))
    fresh = shift + ratio * rng.normal(size=(replicates, FRESH))
    scale = data.std(axis=1, ddof=1, keepdims=True) * np.sqrt(1 + 1 / FITTED)
    u = stdtr(FITTED - 1, (fresh - data.mean(axis=1, keepdims=True)) / scale)
    return np.sort(np.clip(u, 1e-12, 1 - 1e-12), axis=1)


def statistics(u: Any) -> dict[str, Any]:
    """Return the statistic of each test, large where uniformity is doubtful, (replicates,)."""
    n = u.shape[1]
    i = np.arange(1, n + 1)
    logs = (2 * i - 1) / n * (np.log(u) + np.log1p(-u[:, ::-1]))
    return {
        "area": area(u),
        "area of |2u - 1|": area(np.abs(2 * u - 1)),
        "Kolmogorov-Smirnov": np.array([kstest(row, "uniform").statistic for row in u]),
        "Cramer-von Mises": np.array([cramervonmises(row, "uniform").statistic for row in u]),
        "Anderson-Darling": -n - logs.sum(axis=1),
        **{f"ArviZ {m}": -array_stats.uniformity_test(u, method=m)[0] for m in ARVIZ},
    }


def power(replicates: int, level: float = 0.05) -> dict[str, dict[str, float]]:
    """Return the share of rejections by test and alternative, at critical values from right models."""
    null = statistics(u_in_pool(0.0, 1.0, 5 * replicates, 0))
    critical = {name: np.quantile(values, 1 - level) for name, values in null.items()}
    table: dict[str, dict[str, float]] = {name: {} for name in null}
    for k, (label, (shift, ratio)) in enumerate(ALTERNATIVES.items(), start=1):
        for name, values in statistics(u_in_pool(shift, ratio, replicates, k)).items():
            table[name][label] = float((values > critical[name]).mean())
    return table


STUDY = Study("power", __doc__, ["n0 = 30, n = 20"], lambda _, number: power(5000), 1)

if __name__ == "__main__":
    STUDY.main()
