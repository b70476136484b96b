"""Posteriors of specimens that are seen within limits only, beside exact ones by quadrature.

The response is exp(x) of 30 specimens, x is normal with mean 1 and standard deviation .5. A cell is
the share of the population that is seen, and the error of the readings, of which half a spread
of the response is .9. "selected" are those above a proof limit, "window" those between two limits
with equal shares beyond. "ignored" are data above a limit without ``selected=``.

    OMP_NUM_THREADS=1 uv run python -m benchmarks.selection [--data-sets 20]
"""

from __future__ import annotations

import time
from itertools import product
from typing import Any

import numpy as np
import pymc as pm
from scipy import stats
from scipy.special import logsumexp

import prbayes as prb
from benchmarks.kinds_of_readings import Case, exact, half_normal, normal, of_normal
from benchmarks.study import Study
from prbayes._validate import Floats
from prbayes.propagation.base import DesignError

_N, _MEAN, _SD = 30, 1.0, 0.5
_Z = np.linspace(-7, 7, 281)


def case_of(share: float, error: float, seed: int, is_window: bool = False) -> Case:
    """Return a data set with its exact log-likelihood."""
    sample = np.exp(_MEAN + _SD * np.random.default_rng(0).standard_normal(10**6))
    readings = sample + error * np.random.default_rng(1).standard_normal(10**6)
    beyond = (1 - share) / 2 if is_window else 1 - share
    limit = round(float(np.quantile(readings, beyond)), 3)
    upper = round(float(np.quantile(readings, 1 - beyond)), 3) if is_window else np.inf
    rng = np.random.default_rng([seed, 7])
    y = np.exp(rng.normal(_MEAN, _SD, 40 * _N)) + error * rng.standard_normal(40 * _N)
    y = y[(y > limit) & (y < upper)][:_N]
    of_readings = of_normal(lambda x, v: stats.norm.logpdf(y, np.exp(x), max(error, 1e-9)))

    def log_likelihood(values: dict[str, Floats]) -> Floats:
        mu, sigma = values["mu"], values["sigma"]
        if error:
            x = np.clip(mu + sigma * _Z[:, None], -50, 50)
            logs = log_between(limit, upper, np.exp(x), error) + stats.norm.logpdf(_Z)[:, None]
            seen = logsumexp(logs, axis=1) + np.log(_Z[1] - _Z[0])
            return np.asarray(of_readings(values) - seen)
        seen = log_between(np.log(limit), np.log(upper), mu[:, 0], sigma[:, 0])
        return np.asarray(stats.norm.logpdf(np.log(y), mu[:, 0], sigma[:, 0]) - seen)

    metric = prb.LogLikelihood(error=error or None, selected=(limit, upper if is_window else None))
    priors = [normal("mu", 1.0, 1.0), half_normal("sigma", 1.0)]
    return Case(priors, y, np.exp, lambda v: metric, log_likelihood)


def log_between(low: float, high: float, mean: Floats, sd: Any) -> Floats:
    """Return logarithms of normal probabilities of an interval, also far from the mean."""
    a, b = (low - mean) / sd, (high - mean) / sd
    is_above = a > 0  # then take the other tail, which does not cancel
    a, b = np.where(is_above, -b, a), np.where(is_above, -a, b)
    log_b = stats.norm.logcdf(b)
    ratio = np.minimum(stats.norm.logcdf(a) - log_b, -1e-15)
    return np.asarray(log_b + np.log(-np.expm1(ratio)))


def row(cell: str, seed: int) -> dict[str, Any]:
    """Return offsets in exact standard deviations, ratios of these, runs and CPU seconds."""
    share, error, way = cell.split("/")
    case = case_of(float(share), float(error), seed, way == "window")
    # With 2^11 points the standard deviation of heavy tails has an error of a twentieth.
    mean, sd = exact(case, 2**12 if float(error) else 2**14)
    start = time.process_time()
    with pm.Model() as model:
        variables = {p.name: p.variable() for p in case.priors}
        metric: Any = case.metric(variables)
        if way == "ignored":
            metric = prb.LogLikelihood(error=metric.error)
        x = case.population(variables)
        prb.Simulator("y", np.exp, x, metric=metric, observed=case.observed)
    draws = prb.sample(1000, model=model, random_seed=seed, progressbar=False)
    seconds = time.process_time() - start
    samples = [draws.posterior[name].values for name in ("mu", "sigma")]
    offset = [(x.mean() - m) / s for x, m, s in zip(samples, mean, sd, strict=True)]
    width = [x.std() / s for x, s in zip(samples, sd, strict=True)]
    return {"offset": offset, "width": width, "seconds": seconds}


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the largest and the root mean square offset, and the range of widths."""
    answered = [row for row in rows if "offset" in row]
    offsets, widths = (np.array([row[key] for row in answered]) for key in ("offset", "width"))
    return {
        "largest offset": round(float(np.abs(offsets).max()), 3),
        "rms offset": round(float(np.sqrt((offsets**2).mean())), 3),
        "widths": [round(float(widths.min()), 3), round(float(widths.max()), 3)],
        "CPU seconds": round(float(np.median([row["seconds"] for row in answered])), 1),
        "refused": len(rows) - len(answered),
        "data sets": len(rows),
    }


_WAYS, _ERRORS, _SHARES = ("selected", "window"), (0.0, 0.9), (0.2, 0.4, 0.6, 0.9)
CELLS = [f"{s}/{e}/{way}" for way, e, s in product(_WAYS, _ERRORS, _SHARES)]
CELLS += ["0.6/0.0/ignored", "0.6/0.9/ignored"]
STUDY = Study("selection", __doc__, CELLS, row, 20, summary, failures=(DesignError,), block=5)

if __name__ == "__main__":
    STUDY.main()
