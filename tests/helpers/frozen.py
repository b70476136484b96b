"""Results of ten problems to the last bit, before and after a change that should not alter them.

    OMP_NUM_THREADS=1 uv run python tests/helpers/frozen.py --save FILE
    OMP_NUM_THREADS=1 uv run python tests/helpers/frozen.py --compare FILE

Save on the commit before the change and compare on the one after, on the same machine: other
processors round differently. ``--problems`` limits both to some problems.
"""

from __future__ import annotations

import argparse
import json
import logging
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm
import xarray as xr

import prbayes as prb

Record = dict[str, Any]

QUIET: dict[str, Any] = {"progressbar": False}


def line(x: Any) -> Any:
    """Return a linear response."""
    return 2.0 * x + 1.0


def product(a: Any, b: Any) -> Any:
    """Return a response of two inputs."""
    return a * np.exp(0.5 * b)


def outputs(a: Any, b: Any) -> Any:
    """Return two outputs of two inputs."""
    return np.stack([a * b, a + b**2], axis=-1)


def draws_of(seed: int, mean: float, sd: float, size: int) -> Any:
    """Return draws of a normal population."""
    return np.random.default_rng(seed).normal(mean, sd, size)


def one_input(**options: Any) -> pm.Model:
    """Return a model of a linear response with one normal input."""
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1))
        prb.Simulator("y", line, x, observed=line(draws_of(1, 1.0, 0.3, 40)), **options)
    return model


def two_inputs(response: Any, **options: Any) -> pm.Model:
    """Return a model with two normal inputs."""
    a, b = draws_of(2, 1.0, 0.2, 30), draws_of(3, 2.0, 0.2, 30)
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("m1", 1, 0.5), pm.HalfNormal("s1", 0.5))
        y = pm.Normal.dist(pm.Normal("m2", 2, 0.5), pm.HalfNormal("s2", 0.5))
        prb.Simulator("y", response, x, y, observed=response(a, b), **options)
    return model


def with_groups() -> pm.Model:
    """Return a model of three suppliers with partial pooling."""
    who = np.repeat(["A", "B", "C"], [20, 15, 8])
    means = np.repeat([0.8, 1.0, 1.3], [20, 15, 8])
    lives = np.exp(means + 0.4 * np.random.default_rng(4).standard_normal(43))
    observed = xr.DataArray(lives, coords={"supplier": ("specimen", who)}, dims="specimen")
    with pm.Model(coords={"supplier": ["A", "B", "C"]}) as model:
        mu = pm.Normal("mu", pm.Normal("m", 1, 1), pm.HalfNormal("tau", 0.5), dims="supplier")
        supplier = prb.response.group("supplier")
        x = pm.Normal.dist(mu[supplier], pm.HalfNormal("sigma", 1), name="x")
        prb.Simulator("y", np.exp, x, metric=prb.KullbackLeibler(), observed=observed)
    return model


def with_discrepancy() -> pm.Model:
    """Return a model of springs that stiffen, with a model discrepancy over the deflection."""
    at = np.array([0.5, 1.0, 2.0])
    stiffness, bend = draws_of(5, 10.0, 1.0, 40)[:, None], draws_of(6, 0.3, 0.05, 40)[:, None]
    response = prb.response.Multiplicative(at).of(lambda k: np.asarray(k)[..., None] * at, at)
    with pm.Model() as model:
        k = pm.Normal.dist(pm.Normal("mean k", 10, 3), pm.HalfNormal("sd k", 2))
        b = pm.Normal.dist(pm.Normal("mean b", 0, 0.5), pm.HalfNormal("sd b", 0.2))
        prb.Simulator(
            *("force", response, k, b),
            metric=prb.Joint(prb.KullbackLeibler()),
            observed=stiffness * at * np.exp(bend * (at - 0.5) / 1.5),
            propagation=prb.Resimulated(256),
        )
    return model


def failing(x: Any) -> Any:
    """Return a response that is missing above 1.6."""
    return np.where(x < 1.6, line(x), np.nan)


def with_failures() -> pm.Model:
    """Return a model whose response is replaced where it fails."""
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1, 1), pm.HalfNormal("sigma", 0.5))
        prb.Simulator(
            *("y", failing, x),
            metric=prb.ProbabilityResidual(),
            observed=line(draws_of(7, 1.0, 0.2, 30)),
            propagation=prb.Reweighted(256, on_failure=prb.response.Replace(np.inf)),
        )
    return model


def with_ends() -> pm.Model:
    """Return a model of a uniform population, whose ends are the hyperparameters."""
    with pm.Model() as model:
        low = pm.Normal("low", 0, 1)
        x = pm.Uniform.dist(low, low + pm.HalfNormal("width", 2))
        observed = line(np.random.default_rng(8).uniform(0.2, 1.7, 30))
        prb.Simulator("y", line, x, metric=prb.KullbackLeibler(), observed=observed)
    return model


def of_optimum(optimum: prb.Optimum) -> Record:
    """Return what an optimum reports."""
    return {
        "theta": optimum.theta,
        "covariance": optimum.covariance,
        "discrepancy": optimum.discrepancy,
        "runs": optimum.n_responses,
        "warnings": [finding.code for finding in optimum.findings],
        "findings": [finding.code for finding in prb.diagnose(optimum).findings],
    }


def of_draws(idata: xr.DataTree, model: pm.Model) -> Record:
    """Return draws and what is reported of them."""
    posterior = idata.posterior
    names = [str(rv.name) for rv in model.free_RVs]
    result = {name: posterior[name].values for name in names}
    findings = prb.diagnose(idata, model=model).findings
    return result | {"findings": [finding.code for finding in findings]}


def both(model: pm.Model, sampler: str = "sample", **options: Any) -> Record:
    """Return optimum and draws."""
    optimum = prb.minimize(model, **QUIET)
    settings: dict[str, Any] = {"chains": 2, "random_seed": 1, **QUIET} | options
    idata = getattr(prb, sampler)(100, model=model, optimum=optimum, **settings)
    return {"optimum": of_optimum(optimum), "draws": of_draws(idata, model)}


def by_nuts() -> Record:
    """Return draws of the log-likelihood by specimen by NUTS."""
    model = one_input()
    optimum = prb.minimize(model, **QUIET)
    settings: dict[str, Any] = {
        "init": "adapt_diag",
        "initvals": optimum.initvals,
        "cores": 1,
        "random_seed": 1,
    }
    with model:
        idata = pm.sample(
            100, tune=100, chains=2, compute_convergence_checks=False, **settings, **QUIET
        )
    return {"optimum": of_optimum(optimum), "draws": of_draws(idata, model)}


def validity() -> Record:
    """Return draws with adjustment=None, and the p-value of fresh data."""
    model = one_input(metric=AREA)
    optimum = prb.minimize(model, **QUIET)
    settings: dict[str, Any] = {"chains": 2, "random_seed": 1} | QUIET
    idata = prb.sample_smc(100, model=model, optimum=optimum, adjustment=None, **settings)
    x = pm.Normal.dist(model["mu"], model["sigma"])
    predicted = prb.predict(idata, line, x, model=model, **QUIET)
    test = prb.area_test(line(draws_of(9, 1.0, 0.3, 20)), predicted)
    return {
        "optimum": of_optimum(optimum),
        "draws": of_draws(idata, model),
        "p": test.p_value,
        "statistic": test.statistic,
    }


PR, KLD, AREA = prb.ProbabilityResidual(), prb.KullbackLeibler(), prb.AreaMetric()
PROBLEMS: dict[str, Callable[[], Record]] = {
    "one input": lambda: both(one_input(metric=PR)),
    "area metric": lambda: both(one_input(metric=AREA)),
    "two inputs, emulated": lambda: both(
        two_inputs(product, metric=KLD, propagation=prb.Reweighted(64)), "sample_smc"
    ),
    "joint outputs": lambda: both(two_inputs(outputs, metric=prb.Joint(PR))),
    "likelihood, two inputs": lambda: both(two_inputs(outputs)),
    "likelihood, fibres": lambda: both(two_inputs(product)),
    "groups": lambda: both(with_groups()),
    "discrepancy": lambda: {"optimum": of_optimum(prb.minimize(with_discrepancy(), **QUIET))},
    "failures": lambda: both(with_failures()),
    "resimulated": lambda: both(one_input(metric=KLD, propagation=prb.Resimulated(256))),
    "uniform ends": lambda: both(with_ends()),
    "NUTS": by_nuts,
    "validity": validity,
}


def flat(record: Any, name: str = "") -> dict[str, Any]:
    """Return the values of nested records, by path."""
    if not isinstance(record, dict):
        return {name: record.tolist() if hasattr(record, "tolist") else record}
    parts = [flat(value, f"{name}/{key}".strip("/")) for key, value in record.items()]
    return {key: value for part in parts for key, value in part.items()}


def results(names: Iterable[str]) -> Record:
    """Return the results of problems; an exception is a result."""
    records: Record = {}
    for name in names:
        try:
            records[name] = PROBLEMS[name]()
        except Exception as error:
            records[name] = {"error": type(error).__name__, "message": str(error)[:200]}
        print(name, records[name].get("message", "done"), flush=True)
    return flat(records)


def differences(before: dict[str, Any], after: dict[str, Any]) -> list[str]:
    """Return a line for each value that differs."""
    lines = []
    for key in sorted(before.keys() | after.keys()):
        old, new = before.get(key), after.get(key)
        # JSON has every digit of a double; NaN equals NaN here.
        if json.dumps(old) == json.dumps(new):
            continue
        try:
            a, b = np.asarray(old, dtype=float), np.asarray(new, dtype=float)
            largest = np.nanmax(np.abs(a - b) / np.maximum(np.abs(a), 1e-300))
            lines.append(f"{key}: largest relative difference {largest:.2g}")
        except (TypeError, ValueError):
            lines.append(f"{key}: got {new}, before {old}")
    return lines


def main() -> int:
    """Save or compare; return the number of differences."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    action = parser.add_mutually_exclusive_group(required=True)
    action.add_argument("--save", type=Path)
    action.add_argument("--compare", type=Path)
    parser.add_argument("--problems", nargs="+", choices=list(PROBLEMS), default=list(PROBLEMS))
    arguments = parser.parse_args()
    logging.getLogger("prbayes").setLevel(logging.ERROR)
    now = results(arguments.problems)
    if arguments.save:
        arguments.save.write_text(json.dumps(now))
        return 0
    saved = json.loads(arguments.compare.read_text())
    asked = tuple(f"{name}/" for name in arguments.problems)
    lines = differences({k: v for k, v in saved.items() if k.startswith(asked)}, now)
    print("\n".join(lines) or "identical")
    return len(lines)


if __name__ == "__main__":
    sys.exit(min(main(), 1))
