"""What changes where a constant of the package is half or twice as large.

Every number that stands at the top of a module, by its syntax tree, in the rooms that touch
statistics. Each is set to half and to twice its value, in a process of its own, and five problems
are calibrated: optimum, standard errors and an adjusted posterior of 400 draws. The table has, over
all problems and hyperparameters, the largest change of

- the optimum, in standard errors; the standard errors, as a factor;
- the posterior's mean, in its standard deviations; its standard deviation, as a factor;
- the number of responses, as a factor; and the problems whose verdict (converged, warnings by their number) changes,
  or that end in an error.

A posterior of 400 draws with another seed differs by about .05 standard deviations in the mean, and
by 1.04 in the standard deviation: the first row says how much on these problems.

    uv run python -m benchmarks.constants [--only sandwich] [--workers 2] [--out constants.json]
"""

from __future__ import annotations

import argparse
import ast
import importlib
import logging
import sys
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm

import prbayes as prb
from benchmarks import record

PACKAGE = Path(prb.__file__).parent
ROOMS = ("estimate", "posterior", "model", "propagation", "metrics")
COLUMNS = ("optimum", "stderr", "mean", "sd", "responses")


def numbers() -> dict[str, float]:
    """Return the numbers at the top of modules, by module and name."""
    found = {}
    for room in ROOMS:
        for path in sorted((PACKAGE / room).glob("*.py")):
            for statement in ast.parse(path.read_text(encoding="utf-8")).body:
                if not isinstance(statement, ast.Assign) or not isinstance(
                    statement.targets[0], ast.Name
                ):
                    continue
                module = importlib.import_module(f"prbayes.{room}.{path.stem}")
                value = getattr(module, statement.targets[0].id)
                if isinstance(value, int | float) and not isinstance(value, bool):
                    found[f"{room}.{path.stem}.{statement.targets[0].id}"] = value
    return found


def one_input(response: Any, observed: Any, metric: prb.Metric) -> pm.Model:
    """Return a model of one normal input."""
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1.2, 1.0), pm.HalfNormal("sigma", 1.0))
        prb.Simulator(
            "y", response, x, metric=metric, observed=observed, propagation=prb.Reweighted(256)
        )
    return model


def two_inputs(rng: np.random.Generator) -> pm.Model:
    """Return a model of two inputs and two responses of the same specimens."""
    a, b = rng.normal(1.0, 0.3, 30), rng.normal(2.0, 0.5, 30)
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu_a", 1, 1), pm.HalfNormal("sd_a", 1))
        y = pm.Normal.dist(pm.Normal("mu_b", 2, 1), pm.HalfNormal("sd_b", 1))
        common = {"metric": prb.ProbabilityResidual(), "specimens": np.arange(30)}
        for name, sign in (("sum", 1), ("difference", -1)):
            prb.Simulator(
                name,
                lambda x, y, sign=sign: x + sign * y,
                x,
                y,
                observed=a + sign * b,
                propagation=prb.Reweighted(512, max_points=2048),
                **common,
            )
    return model


def problems() -> dict[str, pm.Model]:
    """Return the models; none of them is among those of the studies of coverage."""
    rng = np.random.default_rng(77)
    small, larger = 1.0 + 0.6 * rng.standard_normal(20), 1.0 + 0.6 * rng.standard_normal(60)
    return {
        "PR, N = 20": one_input(np.sinh, np.sinh(small), prb.ProbabilityResidual()),
        "area, N = 20": one_input(np.sinh, np.sinh(small), prb.AreaMetric()),
        "area, squared, N = 60": one_input(np.square, np.square(larger), prb.AreaMetric()),
        "log-likelihood, N = 60": one_input(np.exp, np.exp(larger), prb.LogLikelihood()),
        "two inputs, PR, N = 30": two_inputs(rng),
    }


def answers(random_seed: int = 1) -> dict[str, Any]:
    """Calibrate all problems."""
    logging.getLogger("prbayes").setLevel(logging.CRITICAL)
    out: dict[str, Any] = {}
    for name, model in problems().items():
        try:
            optimum = prb.minimize(model, progressbar=False)
            posterior = prb.sample_smc(
                400,
                chains=1,
                model=model,
                optimum=optimum,
                random_seed=random_seed,
                progressbar=False,
            )
        except Exception as error:
            out[name] = {"error": f"{type(error).__name__}: {error}"[:200]}
            continue
        draws = posterior["calibration"]["theta"].values[0]
        out[name] = {
            "theta": optimum.theta.tolist(),
            "stderr": np.sqrt(np.diag(optimum.covariance)).tolist(),
            "mean": draws.mean(axis=0).tolist(),
            "sd": draws.std(axis=0).tolist(),
            "responses": int(posterior["posterior"].attrs["n_responses"]),
            "verdict": [bool(optimum.converged), len(optimum.warnings)],
        }
    return out


def with_constant(name: str, value: float) -> dict[str, Any]:
    """Calibrate all problems with a constant of another value, wherever it was imported."""
    module, _, constant = name.rpartition(".")
    here = importlib.import_module(f"prbayes.{module}")
    old = getattr(here, constant)
    for other in [m for key, m in sys.modules.items() if key.startswith("prbayes")]:
        if other is here or (
            not constant.startswith("_") and getattr(other, constant, None) == old
        ):
            setattr(other, constant, value)
    return answers()


def change(found: dict[str, Any], before: dict[str, Any]) -> dict[str, Any]:
    """Return the largest changes over all problems, and the problems with another verdict."""
    largest = dict.fromkeys(COLUMNS, 0.0)
    other = []
    for name, b in before.items():
        a = found[name]
        if "error" in a or "error" in b:
            if a != b:
                other.append(name)
            continue
        arrays = {
            key: (np.array(a[key]), np.array(b[key])) for key in ("theta", "stderr", "mean", "sd")
        }
        known = np.isfinite(arrays["stderr"][0]) & np.isfinite(arrays["stderr"][1])
        new, old = ({key: pair[i][known] for key, pair in arrays.items()} for i in (0, 1))
        values = {
            "optimum": np.abs(new["theta"] - old["theta"]) / old["stderr"],
            "stderr": np.exp(np.abs(np.log(new["stderr"] / old["stderr"]))),
            "mean": np.abs(new["mean"] - old["mean"]) / old["sd"],
            "sd": np.exp(np.abs(np.log(new["sd"] / old["sd"]))),
            "responses": np.exp(np.abs(np.log([a["responses"] / b["responses"]]))),
        }
        for key, value in values.items():
            largest[key] = max(largest[key], float(value.max(initial=0.0)))
        same_known = np.array_equal(*map(np.isfinite, arrays["stderr"]))
        if a["verdict"] != b["verdict"] or not same_known:
            other.append(name)
    return {**largest, "other verdicts": other}


def main() -> None:
    """Make the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", default="", help="constants whose name has this in it")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("constants.json"))
    arguments = parser.parse_args()
    before = answers()
    table: dict[str, Any] = {"another seed of the sampler": change(answers(2), before)}
    jobs = {}
    for name, value in numbers().items():
        if arguments.only in name:
            for label, factor in (("/ 2", 0.5), ("x 2", 2.0)):
                other = max(1, round(value * factor)) if isinstance(value, int) else value * factor
                if other != value:
                    jobs[f"{name} {label}"] = (name, other)
    context = get_context("spawn")
    with ProcessPoolExecutor(arguments.workers, mp_context=context, max_tasks_per_child=1) as pool:
        futures = {label: pool.submit(with_constant, *job) for label, job in jobs.items()}
        for label, future in futures.items():
            table[label] = change(future.result(), before)
            row = table[label]
            cells = " ".join(f"{row[key]:9.3f}" for key in COLUMNS)
            print(f"{label:58s} {cells}  {', '.join(row['other verdicts'])}", flush=True)
    record.save(arguments.out, table)


if __name__ == "__main__":
    main()
