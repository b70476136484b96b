"""Are optima those of the metric, on problems that nobody chose?

Populations, priors, numbers of specimens and metrics are drawn at random, for five responses of two
or three inputs with one to three outputs: smooth ones and one with a kink, some with mirror images,
most with inputs that the data tell apart in part only. `minimize` runs at its defaults; the
reference is the end of a simplex that begins around its optimum, with 16 384 specimens computed
anew and no design. Off is how far the optimum is from that, in standard errors, along the worst
hyperparameter of those that the data identify; claimed is `Optimum.design_error`. A problem that is
refused counts as such. What the reference cannot see, another optimum that is better, is looked for
by `minimize` itself.

Each problem is a seed, and none was chosen:

    OMP_NUM_THREADS=1 uv run python -m benchmarks.random_problems --seeds 40
"""

from __future__ import annotations

import argparse
import logging
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm
from scipy.optimize import minimize

import prbayes as prb
from benchmarks import record
from prbayes.model.evaluator import Evaluator

METRICS = (prb.ProbabilityResidual, prb.KullbackLeibler, prb.AreaMetric)
SPECIMENS = (8, 15, 30, 80)
WIDE = (1.0, 3.0, 8.0)  # priors, in units of what populations are drawn from
ENOUGH = 0.35  # standard errors off, from which on an optimum is told of


def _two(a: Any, b: Any) -> Any:
    return np.stack([a + 0.3 * b, b * np.exp(0.1 * a)], axis=-1)


def _three(a: Any, b: Any, c: Any) -> Any:
    return np.stack([a + b, a - b + 0.1 * c, c + 0.2 * a * b], axis=-1)


def _mixed(a: Any, b: Any, c: Any) -> Any:
    return np.stack([np.sqrt(1 + a**2), b + 0.3 * c], axis=-1)


# Responses by their number of inputs.
RESPONSES: tuple[tuple[Callable[..., Any], int], ...] = (
    (_two, 2),
    (lambda a, b: a * np.exp(0.3 * b), 2),
    (_three, 3),
    (lambda a, b: np.abs(a) + 0.5 * b, 2),
    (_mixed, 3),
)


@dataclass(frozen=True)
class Problem:
    """One problem, drawn from a seed."""

    response: Callable[..., Any]
    observed: Any
    metric: Any
    wide: float
    sd: Any  # of each input's population

    @classmethod
    def of(cls, seed: int) -> Problem:
        """Return the problem of a seed."""
        rng = np.random.default_rng(seed)
        response, d = RESPONSES[seed % len(RESPONSES)]
        n = int(rng.choice(SPECIMENS))
        mean, sd = 2 * rng.standard_normal(d), np.exp(-1.2 + 0.6 * rng.standard_normal(d))
        x = mean + sd * rng.standard_normal((n, d))
        observed = response(*x.T)
        metric = METRICS[seed % len(METRICS)]()
        wide = float(rng.choice(WIDE))
        joint = prb.Joint(metric) if observed.ndim == 2 else metric
        return cls(response, observed, joint, wide, sd)

    def model(self, propagation: Any) -> pm.Model:
        """Return the model; of one output the other inputs' spreads are known."""
        with pm.Model() as model:
            inputs = []
            for i, sd in enumerate(self.sd):
                mu = pm.Normal(f"mu{i}", 0.0, 2 * self.wide if i == 0 else 2.0)
                unknown = i == 0 or self.observed.ndim == 2
                sigma = pm.HalfNormal(f"sigma{i}", self.wide) if unknown else sd
                inputs.append(pm.Normal.dist(mu, sigma))
            prb.Simulator(
                "y",
                self.response,
                *inputs,
                metric=self.metric,
                observed=self.observed,
                propagation=propagation,
            )
        return model


def reference(problem: Problem, optimum: prb.Optimum) -> Any:
    """Return where a simplex ends that begins around an optimum, without a design."""
    evaluator = Evaluator.of(problem.model(prb.Resimulated(16_384)))
    stderr = np.sqrt(np.diag(optimum.covariance))
    steps = 0.3 * np.where(np.isfinite(stderr), stderr, 0.3 * evaluator.hyperparameters.prior_sd)
    found = minimize(
        lambda theta: float(evaluator.total(theta[None], np.ones(1))[0]),
        optimum.theta,
        method="Nelder-Mead",
        options={
            "initial_simplex": np.vstack([optimum.theta, optimum.theta + np.diag(steps)]),
            "maxfev": 100 * steps.size,
            "xatol": 1e-3,
            "fatol": 1e-8,
        },
    )
    return found.x


def answered(seed: int) -> dict[str, Any]:
    """Return how far the optimum of a problem is from the reference, and what it cost."""
    problem = Problem.of(seed)
    row: dict[str, Any] = {"seed": seed, "specimens": len(problem.observed), "wide": problem.wide}
    clock = time.process_time()
    try:
        optimum = prb.minimize(problem.model(prb.Reweighted()), progressbar=False)
    except prb.propagation.DesignError as error:
        return row | {"refused": str(error)[:120]}
    row["seconds"] = round(time.process_time() - clock, 1)
    known = np.isfinite(np.diag(optimum.covariance))
    stderr = np.sqrt(np.diag(optimum.covariance))[known]
    off = (optimum.theta - reference(problem, optimum))[known] / stderr
    support = optimum.search.support["y"]["weight_ess"]
    return row | {
        "off": [round(float(x), 3) for x in off],
        "claimed": round(float(optimum.design_error), 3),
        "runs": optimum.n_responses,
        "effective": round(float(support)),
        "others": sum(other["comparable"] for other in optimum.local_optima),
    }


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return what the problems say together."""
    good = [row for row in rows if "refused" not in row]
    worst = np.array([max(map(abs, row["off"]), default=0.0) for row in good])
    runs = [row["runs"] for row in good]
    return {
        "problems": len(rows),
        "refused": len(rows) - len(good),
        "median off": float(np.median(worst)),
        "farthest off": float(worst.max()),
        f"beyond {ENOUGH}": int((worst > ENOUGH).sum()),
        "claimed more than 0.1": sum(row["claimed"] > 0.1 for row in good),
        "median runs": float(np.median(runs)),
        "most runs": max(runs),
        "median seconds": float(np.median([row["seconds"] for row in good])),
    }


def main() -> None:
    """Print a table and write JSON; what is there is not made again."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=40)
    parser.add_argument("--out", type=Path, default=record.RESULTS / "random_problems.json")
    arguments = parser.parse_args()
    logging.getLogger("prbayes").setLevel(logging.ERROR)
    warnings.simplefilter("ignore")
    rows = record.load(arguments.out, {}).get("rows", [])
    done = {row["seed"] for row in rows}
    for seed in range(arguments.seeds):
        if seed not in done:
            rows.append(answered(seed))
            record.save(arguments.out, {"rows": rows, "summary": summary(rows)})
            print(rows[-1], flush=True)
    for name, value in summary(rows).items():
        print(f"{name:24s}{value:10.3g}")


if __name__ == "__main__":
    main()
