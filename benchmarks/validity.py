"""Size of the area test on fresh data, after a calibration on n0 data.

*size*: n0 normal data give the exact posterior under Jeffreys' prior; n fresh data of the same
population are tested at nominal 1, 5 and 10%: by the default null, and by the constructions that it
replaces (the best fit taken as exact; u-values in the posterior's pool taken as uniform).
*pipeline*: the same through prbayes itself, `minimize` and `predict` with the area metric, and
`JointNull` on the calibration's own data. *outputs*: several outputs, with right and wrong
correlations. There is no standard prior of their covariance. Under the one that makes credible regions
confidence regions the size is to be nominal; under Jeffreys' the posterior of so few data is wider.

    uv run python -m benchmarks.validity --cells "size*" --data-sets 5000
    uv run python -m benchmarks.validity --cells "pipeline*" --data-sets 150
    uv run python -m benchmarks.validity --cells "outputs*" --data-sets 1000
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pymc as pm
from scipy.special import ndtr, ndtri
from scipy.stats import invwishart

import prbayes as prb
from benchmarks.study import Study
from prbayes.validation.pit import area

LEVELS = (0.01, 0.05, 0.10)
FRESH = (10, 20, 50)
# Four outputs with correlation .9 between any two: n0 and n, and the alternatives.
OUTPUTS, CORRELATION = 4, 0.9
OUTPUTS_AT = (15, 20)
# Shift and correlation of fresh data.
ALTERNATIVES = {f"{rho:g}": (0.0, rho) for rho in (CORRELATION, 0.8, 0.6, 0.0)}
ALTERNATIVES["mean + 0.75 sd"] = (0.75, CORRELATION)


def posterior_populations(
    data: Any, rng: np.random.Generator, draws: int = 400, n_samples: int = 100
) -> Any:
    """Return one population per draw of the exact posterior of a normal sample under Jeffreys' prior."""
    n = data.size
    sd = data.std(ddof=1) * np.sqrt((n - 1) / rng.chisquare(n - 1, (draws, 1)))
    mean = data.mean() + sd / np.sqrt(n) * rng.normal(size=(draws, 1))
    return mean + sd * ndtri((np.arange(n_samples) + rng.random((draws, 1))) / n_samples)


def correlated(rho: float) -> Any:
    """Return a root of the covariance of outputs with equal correlations."""
    return np.linalg.cholesky(np.full((OUTPUTS, OUTPUTS), rho) + (1 - rho) * np.eye(OUTPUTS))


def matching_roots(data: Any, rng: np.random.Generator, draws: int) -> Any:
    """Return roots of covariances, (draws, m, m), of the posterior whose regions are confidence regions.

    That under the right Haar prior of lower triangular roots (Geisser and Cornfield 1963,
    doi:10.1111/j.2517-6161.1963.tb00518.x): the root of the scatter is the covariance's root times
    Bartlett's factor of a Wishart matrix, whose distribution is known.
    """
    n, m = data.shape
    factors = np.tril(rng.standard_normal((draws, m, m)), -1)
    factors[:, range(m), range(m)] = np.sqrt(rng.chisquare(n - 1 - np.arange(m), (draws, m)))
    return np.linalg.cholesky(np.cov(data.T) * (n - 1)) @ np.linalg.inv(factors)


def jeffreys_roots(data: Any, rng: np.random.Generator, draws: int) -> Any:
    """Return roots of covariances, (draws, m, m), of the posterior under Jeffreys' prior."""
    n = len(data)
    scatter = np.cov(data.T) * (n - 1)
    return np.linalg.cholesky(invwishart.rvs(n - 1, scatter, size=draws, random_state=rng))


PRIORS = {"matching": matching_roots, "Jeffreys": jeffreys_roots}


def populations_of_outputs(
    data: Any, prior: str, rng: np.random.Generator, draws: int = 200
) -> Any:
    """Return one population per draw of the exact posterior, (draws, 200, m)."""
    n, m = data.shape
    found = []
    for root in PRIORS[prior](data, rng, draws):
        mean = data.mean(axis=0) + rng.standard_normal(m) @ root.T / np.sqrt(n)
        found.append(mean + rng.standard_normal((200, m)) @ root.T)
    return np.array(found)


def outputs(prior: str, i: int) -> dict[str, float]:
    """Return p-values of tests of several outputs, by the fresh data's correlation."""
    n0, n = OUTPUTS_AT
    rng = np.random.default_rng([9, n0, i])
    data = rng.normal(size=(n0, OUTPUTS)) @ correlated(CORRELATION).T
    predicted = populations_of_outputs(data, prior, rng)
    null = prb.validation.PosteriorNull(999, random_seed=i)
    row = {}
    for name, (shift, rho) in ALTERNATIVES.items():
        fresh = shift + rng.normal(size=(n, OUTPUTS)) @ correlated(rho).T
        row[name] = prb.area_test(fresh, predicted, null=null).p_value
    return row


def sizes(n0: int, i: int) -> dict[str, float]:
    """Return p-values of a right model, by the number of fresh data and the null."""
    exact = prb.validation.ExactModel()
    rng = np.random.default_rng([7, n0, i])
    data = rng.normal(size=n0)
    predicted = posterior_populations(data, rng)
    row: dict[str, float] = {}
    for n in FRESH:
        fresh = rng.normal(size=n)
        null = prb.validation.PosteriorNull(1999, random_seed=i)
        test = prb.area_test(fresh, predicted, null=null)
        fitted = area(ndtr((fresh - data.mean()) / data.std(ddof=1)))
        row[f"{n}/default"] = test.p_value
        row[f"{n}/best fit"] = exact.p_value(float(fitted), n)
        row[f"{n}/pool, uniform"] = exact.p_value(test.statistic, n)
    return row


def same(x: Any) -> Any:
    """Return the input."""
    return x


def pipeline(n0: int, i: int, n: int = 20) -> dict[str, float]:
    """Return p-values of a right model through prbayes: fresh data, and the calibration's own."""
    rng = np.random.default_rng([8, n0, i])
    data, fresh = rng.normal(10, 1, n0), rng.normal(10, 1, n)
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 10, 3), pm.HalfNormal("sigma", 3))
        stored = prb.Reweighted(512)
        prb.Simulator("y", same, x, metric=prb.AreaMetric(), observed=data, propagation=stored)
    optimum = prb.minimize(model)
    posterior = prb.sample_smc(400, chains=1, model=model, optimum=optimum, random_seed=i)
    predicted = prb.predict(posterior, same, x, model=model, random_seed=i)
    best = prb.predict(optimum, same, x, random_seed=i)
    null = prb.validation.PosteriorNull(1999, random_seed=i)
    joint = prb.validation.JointNull(optimum, replicates=199, random_seed=i)
    own = prb.area_test(data, best, null=joint)
    return {
        "default": prb.area_test(fresh, predicted, null=null).p_value,
        "optimum, ExactModel": prb.area_test(fresh, best).p_value,
        "own data, JointNull": own.p_value,
        "own data, ExactModel": prb.validation.ExactModel().p_value(own.statistic, n0),
    }


STUDIES = {
    "size/15": sizes, "size/30": sizes, "size/100": sizes,
    "pipeline/15": pipeline, "pipeline/30": pipeline,
    "outputs/matching": outputs, "outputs/Jeffreys": outputs,
}  # fmt: skip


def row(cell: str, number: int) -> dict[str, float]:
    """Return the p-values of a data set."""
    _, case = cell.split("/")
    function: Any = STUDIES[cell]
    return dict(function(int(case) if case.isdigit() else case, number))


def summary(rows: list[dict[str, float]]) -> dict[str, dict[str, float]]:
    """Return the shares of p-values at or below the nominal levels."""
    p_values = {key: np.array([row[key] for row in rows]) for key in rows[0]}
    return {
        key: {f"{level:g}": float((p <= level).mean()) for level in LEVELS}
        for key, p in p_values.items()
    }


STUDY = Study("validity", __doc__, STUDIES, row, 1000, summary, has_rows=False)

if __name__ == "__main__":
    STUDY.main()
