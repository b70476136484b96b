"""Size and power of the area test on fresh data, after a calibration on n0 data.

Sizes: n0 normal data give the exact posterior under Jeffreys' prior; n fresh data of the same
population are tested at nominal 1, 5 and 10%: by the default null, and by the constructions that it
replaces (the best fit taken as exact; u-values in the posterior's pool taken as uniform). The same
through prbayes itself: `minimize`, `sample_smc`, `predict` with the area metric, and `JointNull` on
the calibration's own data.

Power: the same test against shifts of the mean and ratios of the standard deviation, beside
Kolmogorov-Smirnov, Cramer-von Mises, Anderson-Darling and ArviZ's tests of uniformity, all on the
same u-values in the posterior's pool (in closed form, Student's t), and all with critical values
from the same simulation of a right model, so that each has the nominal size.

    uv run python -m benchmarks.validity [--parts size pipeline power outputs]

Of several outputs there is no prior that all take. Under the one that makes credible regions
confidence regions the size is to be nominal; under Jeffreys' the posterior of so few data is wider.
Their table has a file of its own:

    uv run python -m benchmarks.validity --parts outputs --out benchmarks/results/validity_outputs.json
"""

from __future__ import annotations

import argparse
import logging
import time
from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm
from scipy.special import ndtr, ndtri, stdtr
from scipy.stats import invwishart

import prbayes as prb
from benchmarks import record
from prbayes.validation.conditions import area

LEVELS = (0.01, 0.05, 0.10)
FITTED = (15, 30, 100)
FRESH = (10, 20, 50)
POWER_AT = (30, 20)  # n0 and n
ALTERNATIVES = {f"mean + {d:g} sd": (d, 1.0) for d in (0.5, 0.75, 1.0)} | {
    f"sd x {r:g}": (0.0, r) for r in (0.5, 1.5, 2.0)
}
# Of four outputs with correlation .9 between any two: n0 and n; and correlations that are wrong.
OUTPUTS, CORRELATION = 4, 0.9
OUTPUTS_AT = (15, 20)
WRONG = (0.8, 0.6, 0.0)
ARVIZ = ("pot_c", "prit_c", "piet_c")


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


def outputs(prior: str, replicates: int) -> dict[str, list[float]]:
    """Return p-values of tests of several outputs, by the fresh data's correlation."""
    n0, n = OUTPUTS_AT
    found: dict[str, list[float]] = {f"{rho:g}": [] for rho in (CORRELATION, *WRONG)}
    found["mean + 0.75 sd"] = []
    for i in range(replicates):
        rng = np.random.default_rng([9, n0, i])
        predicted = populations_of_outputs(
            rng.normal(size=(n0, OUTPUTS)) @ correlated(CORRELATION).T, prior, rng
        )
        null = prb.validation.PosteriorNull(999, random_seed=i)
        for name, p_values in found.items():
            shift = 0.75 if "mean" in name else 0.0
            rho = CORRELATION if "mean" in name else float(name)
            # Power is known well enough from a third of the data sets.
            if name != f"{CORRELATION:g}" and 3 * i >= replicates:
                continue
            fresh = shift + rng.normal(size=(n, OUTPUTS)) @ correlated(rho).T
            p_values.append(prb.area_test(fresh, predicted, null=null).p_value)
    return found


def sizes(n0: int, replicates: int) -> dict[str, dict[str, Any]]:
    """Return p-values of a right model, by the number of fresh data and the null."""
    exact = prb.validation.ExactModel()
    found: dict[str, dict[str, Any]] = {
        str(n): {"default": [], "best fit": [], "pool, uniform": []} for n in FRESH
    }
    for i in range(replicates):
        rng = np.random.default_rng([7, n0, i])
        data = rng.normal(size=n0)
        predicted = posterior_populations(data, rng)
        for n in FRESH:
            fresh = rng.normal(size=n)
            test = prb.area_test(
                fresh, predicted, null=prb.validation.PosteriorNull(1999, random_seed=i)
            )
            p = found[str(n)]
            p["default"].append(test.p_value)
            p["best fit"].append(
                exact.p_value(float(area(ndtr((fresh - data.mean()) / data.std(ddof=1)))), n)
            )
            p["pool, uniform"].append(exact.p_value(test.statistic, n))
    return found


def same(x: Any) -> Any:
    """Return the input."""
    return x


def pipeline_model(data: Any) -> tuple[pm.Model, Any]:
    """Return a model of a normal population, and its input."""
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 10, 3), pm.HalfNormal("sigma", 3))
        propagation = prb.Reweighted(512)
        prb.Simulator("y", same, x, metric=prb.AreaMetric(), observed=data, propagation=propagation)
    return model, x


def pipeline(n0: int, n: int, replicates: int) -> dict[str, Any]:
    """Return p-values of a right model through prbayes: fresh data, and the calibration's own."""
    found: dict[str, Any] = {
        "default": [],
        "optimum, ExactModel": [],
        "own data, JointNull": [],
        "own data, ExactModel": [],
    }
    for i in range(replicates):
        rng = np.random.default_rng([8, n0, i])
        data, fresh = rng.normal(10, 1, n0), rng.normal(10, 1, n)
        model, x = pipeline_model(data)
        optimum = prb.minimize(model, progressbar=False)
        posterior = prb.sample_smc(
            400,
            chains=1,
            model=model,
            optimum=optimum,
            random_seed=i,
            progressbar=False,
        )
        predicted = prb.predict(posterior, same, x, model=model, random_seed=i)
        best = prb.predict(optimum, same, x, random_seed=i)
        found["default"].append(
            prb.area_test(
                fresh, predicted, null=prb.validation.PosteriorNull(1999, random_seed=i)
            ).p_value
        )
        found["optimum, ExactModel"].append(prb.area_test(fresh, best).p_value)
        own = prb.area_test(
            data, best, null=prb.validation.JointNull(optimum, replicates=199, random_seed=i)
        )
        found["own data, JointNull"].append(own.p_value)
        found["own data, ExactModel"].append(prb.validation.ExactModel().p_value(own.statistic, n0))
    return found


def u_in_pool(n0: int, n: int, shift: float, ratio: float, replicates: int, seed: int) -> Any:
    """Return u-values of fresh data in the posterior predictive distribution, sorted, shape (replicates, n)."""
    rng = np.random.default_rng([9, seed])
    data = rng.normal(size=(replicates, n0))
    fresh = shift + ratio * rng.normal(size=(replicates, n))
    scale = data.std(axis=1, ddof=1, keepdims=True) * np.sqrt(1 + 1 / n0)
    u = stdtr(n0 - 1, (fresh - data.mean(axis=1, keepdims=True)) / scale)
    return np.sort(np.clip(u, 1e-12, 1 - 1e-12), axis=1)


def statistics(u: Any) -> dict[str, Any]:
    """Return the statistic of each test, large where uniformity is doubtful, shape (replicates,)."""
    from arviz_stats.base.array import array_stats
    from scipy.stats import cramervonmises, kstest

    n = u.shape[1]
    i = np.arange(1, n + 1)
    return {
        "area": area(u),
        "area of |2u - 1|": area(np.abs(2 * u - 1)),
        "Kolmogorov-Smirnov": np.array([kstest(row, "uniform").statistic for row in u]),
        "Cramer-von Mises": np.array([cramervonmises(row, "uniform").statistic for row in u]),
        "Anderson-Darling": -n
        - ((2 * i - 1) / n * (np.log(u) + np.log1p(-u[:, ::-1]))).sum(axis=1),
        **{f"ArviZ {m}": -array_stats.uniformity_test(u, method=m)[0] for m in ARVIZ},
    }


def power(replicates: int, level: float = 0.05) -> dict[str, dict[str, float]]:
    """Return the share of rejections by test and alternative, at critical values from right models."""
    null = statistics(u_in_pool(*POWER_AT, 0.0, 1.0, 5 * replicates, 0))
    critical = {name: np.quantile(values, 1 - level) for name, values in null.items()}
    table: dict[str, dict[str, float]] = {name: {} for name in null}
    for k, (label, (shift, ratio)) in enumerate(
        {"none": (0.0, 1.0), **ALTERNATIVES}.items(), start=1
    ):
        for name, values in statistics(u_in_pool(*POWER_AT, shift, ratio, replicates, k)).items():
            table[name][label] = float((values > critical[name]).mean())
    return table


def shares(p_values: Any) -> dict[str, float]:
    """Return the shares of p-values at or below the nominal levels."""
    return {f"{level:g}": float(np.mean(np.array(p_values) <= level)) for level in LEVELS}


def main() -> None:
    """Print tables and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--replicates", type=int, default=5000)
    parser.add_argument("--pipeline", type=int, default=300)
    parser.add_argument("--outputs", type=int, default=1000)
    parser.add_argument(
        "--parts",
        nargs="+",
        choices=tuple(PARTS),
        default=tuple(PARTS),
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=record.RESULTS / "validity.json",
        help="other parts that it has are kept",
    )
    arguments = parser.parse_args()
    logging.getLogger("prbayes").setLevel(logging.ERROR)
    result: dict[str, Any] = record.load(arguments.out, {})
    for part in arguments.parts:
        clock = time.perf_counter()
        PARTS[part](result, arguments)
        result[f"{part}_seconds"] = round(time.perf_counter() - clock)
        print(f"{result[f'{part}_seconds']} s\n", flush=True)
        record.save(arguments.out, result)


HEADER = f"{'n0':>4s} {'n':>4s} {'null':24s} " + " ".join(f"{level:>6.0%}" for level in LEVELS)


def report(table: dict[str, Any], n0: int, n: Any, found: dict[str, Any]) -> None:
    """Print and keep shares of rejections by null."""
    for name, p_values in found.items():
        row = table[f"{n0}/{n}/{name}"] = shares(p_values)
        print(
            f"{n0:4d} {n!s:>4s} {name:24s} " + " ".join(f"{share:6.3f}" for share in row.values()),
            flush=True,
        )


def run_sizes(result: dict[str, Any], arguments: argparse.Namespace) -> None:
    """Sizes with the exact posterior."""
    print(f"rejections of a right model, {arguments.replicates} replicates\n{HEADER}")
    result["replicates"], result["size"] = arguments.replicates, {}
    for n0 in FITTED:
        for n, nulls in sizes(n0, arguments.replicates).items():
            report(result["size"], n0, n, nulls)


def run_pipeline(result: dict[str, Any], arguments: argparse.Namespace) -> None:
    """Sizes through prbayes."""
    print(f"through prbayes, {arguments.pipeline} replicates\n{HEADER}")
    result["pipeline_replicates"], result["size_through_prbayes"] = arguments.pipeline, {}
    for n0 in FITTED[:2]:
        report(
            result["size_through_prbayes"],
            n0,
            POWER_AT[1],
            pipeline(n0, POWER_AT[1], arguments.pipeline),
        )


def run_power(result: dict[str, Any], arguments: argparse.Namespace) -> None:
    """Power beside other tests."""
    table = result["power"] = power(arguments.replicates)
    labels = list(next(iter(table.values())))
    print(f"power at 5%, n0 = {POWER_AT[0]}, n = {POWER_AT[1]}, {arguments.replicates} replicates")
    print(f"{'test':20s} " + " ".join(f"{label:>13s}" for label in labels))
    for name, row in table.items():
        print(f"{name:20s} " + " ".join(f"{row[label]:13.3f}" for label in labels))


def run_outputs(result: dict[str, Any], arguments: argparse.Namespace) -> None:
    """Size and power of the test of several outputs."""
    table = result["outputs"] = {}
    print(f"{OUTPUTS} outputs, {arguments.outputs} replicates\n{HEADER}")
    result["outputs_replicates"] = arguments.outputs
    for prior in PRIORS:
        print(f"posterior under the prior: {prior}")
        report(table.setdefault(prior, {}), *OUTPUTS_AT, outputs(prior, arguments.outputs))


PARTS = {"size": run_sizes, "pipeline": run_pipeline, "power": run_power, "outputs": run_outputs}


if __name__ == "__main__":
    main()
