"""The spread of an input where readings have an error: ignored, known, and estimated from repeats.

Responses are lognormal, of one input with mean 0 and standard deviation .3; readings of 50 specimens
have a normal error with standard deviation .25. Each data set is calibrated by `minimize` and
`sample_smc` in three ways: without the error, with the error as another input of known spread, and
with a prior of that spread from 20 differences of repeats. Counted is how often 89% intervals
contain the truth.

    OMP_NUM_THREADS=1 uv run python -m benchmarks.measurement_error [--data-sets 200] [--workers 2]
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pymc as pm

import prbayes as prb
from benchmarks.study import Study

TRUTH = {"mu": 0.0, "sigma": 0.3}
ERROR, N, REPEATS = 0.25, 50, 20
WAYS = ("ignored", "known", "estimated")


def true_value(x: Any) -> Any:
    return np.exp(x)


def reading(x: Any, error: Any) -> Any:
    return np.exp(x) + error


def posterior(way: str, readings: Any, differences: Any, seed: int) -> Any:
    """Return the posterior of a data set."""
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 0.5), pm.HalfNormal("sigma", 0.5))
        given = {"metric": prb.ProbabilityResidual(), "observed": readings}
        if way == "ignored":
            prb.Simulator("y", true_value, x, **given)
        else:
            spread: Any = ERROR
            if way == "estimated":
                # The logarithm of a standard deviation from n differences is known to 1 / sqrt(2 n).
                estimate = np.sqrt(np.mean(differences**2) / 2)
                spread = pm.LogNormal("error", np.log(estimate), 1 / np.sqrt(2 * REPEATS))
            error = pm.Normal.dist(0.0, spread)
            stored = prb.Reweighted(1024, emulator=None)
            prb.Simulator("y", reading, x, error, **given, propagation=stored)
    optimum = prb.minimize(model)
    return prb.sample_smc(250, chains=2, model=model, optimum=optimum, random_seed=seed).posterior


def row(way: str, seed: int) -> dict[str, dict[str, float]]:
    """Return moments of the posterior, and whether its intervals contain the truth."""
    rng = np.random.default_rng(seed)
    readings = np.exp(rng.normal(TRUTH["mu"], TRUTH["sigma"], N)) + rng.normal(0, ERROR, N)
    differences = np.sqrt(2) * rng.normal(0, ERROR, REPEATS)
    draws = posterior(way, readings, differences, seed)
    figures = {}
    for name, truth in TRUTH.items():
        values = draws[name].values
        low, high = np.quantile(values, [0.055, 0.945])
        moments = {"mean": float(values.mean()), "sd": float(values.std())}
        figures[name] = moments | {"held": float(low <= truth <= high)}
    return figures


def summary(rows: list[dict[str, dict[str, float]]]) -> dict[str, Any]:
    """Return means over data sets, by hyperparameter."""
    figures: dict[str, Any] = {"data sets": len(rows)}
    for name in TRUTH:
        keys = ("mean", "sd", "held")
        figures[name] = {key: float(np.mean([row[name][key] for row in rows])) for key in keys}
    return figures


STUDY = Study("measurement_error", __doc__, WAYS, row, 200, summary, has_rows=False)

if __name__ == "__main__":
    STUDY.main()
