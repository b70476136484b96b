"""Eight inputs and sixteen hyperparameters from four outputs of 50 specimens, by a surrogate.

The four outputs cannot tell sixteen numbers, so that the posterior is as wide as the prior along
most directions, and no cloud of weighted points reaches all the populations in it. A surrogate has no weights: a process through
runs of the prior predictive distribution, with `minimize(prior=True)` under `Resimulated`.

Off is the root mean square distance from the optimum of 65 536 resimulated true responses, in
standard errors, over the directions that the data identify and ten designs.
Standard errors are root mean square ratios along the same directions.

Run: uv run python -m benchmarks.many_inputs [--seeds 10] [--runs 256 512 1000]
"""

from __future__ import annotations

import argparse
import logging
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm

import prbayes as prb
from benchmarks import record
from benchmarks.responses import RESPONSES
from prbayes.estimate.sampling import local_sampling
from prbayes.estimate.sandwich import Information

RESPONSE = RESPONSES["eight inputs"]
N, POINTS, REFERENCE = 50, 2048, 65_536


def outputs(*inputs: Any) -> Any:
    """Return the four outputs of inputs, (..., 4)."""
    x = np.stack(np.broadcast_arrays(*inputs), axis=-1)
    return RESPONSE(x.reshape(-1, RESPONSE.d)).reshape(*x.shape[:-1], RESPONSE.outputs)


def observed() -> Any:
    """Return the outputs of specimens of the true population."""
    z = np.random.default_rng([1, N]).standard_normal((N, RESPONSE.d))
    return outputs(*(RESPONSE.mean + RESPONSE.sd * z).T)


def build(response: Any, propagation: Any) -> pm.Model:
    """Return the model; ``response`` makes one of the inputs."""
    with pm.Model() as model:
        inputs = []
        for i, (mean, sd) in enumerate(zip(RESPONSE.mean, RESPONSE.sd, strict=True)):
            mu = pm.Normal(f"mu{i}", mean, 2 * sd)
            inputs.append(pm.Normal.dist(mu, pm.LogNormal(f"sigma{i}", np.log(sd), 0.5)))
        prb.Simulator(
            *("y", response(inputs), *inputs),
            metric=prb.Joint(prb.KullbackLeibler()),
            observed=observed(),
            epsilon=1 / N,
            propagation=propagation,
        )
    return model


def surrogate(inputs: Any, runs: int, seed: int) -> prb.Surrogate:
    """Return a process through runs that are where the prior's populations are."""
    return prb.Surrogate.fit(
        outputs,
        inputs,
        runs,
        model=prb.surrogate.GaussianProcess("matern"),
        points="predictive",
        random_seed=seed,
        progressbar=False,
    )


def minimised(response: Any, propagation: Any, start: Any = None) -> prb.Optimum:
    """Return the optimum with the prior."""
    model = build(response, propagation)
    return prb.minimize(model, prior=True, start=start, starts=0, progressbar=False)


def along(optimum: prb.Optimum, directions: Any) -> tuple[Any, Any]:
    """Return the sampling covariance along directions, in units of the prior's spread."""
    information = Information(optimum.evaluator, 0, optimum.theta)
    unit = np.outer(information.prior_sd, information.prior_sd)
    hessian = directions.T @ (information.hessian * unit) @ directions
    noise = directions.T @ (information.sampling_covariance * unit) @ directions
    inverse = np.linalg.inv(hessian)
    return inverse @ noise @ inverse, information.prior_sd


def main() -> None:
    """Print a table and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--runs", type=int, nargs="+", default=[256, 512, 1000])
    parser.add_argument("--out", type=Path, default=record.RESULTS / "many_inputs.json")
    arguments = parser.parse_args()
    logging.getLogger("prbayes").setLevel(logging.ERROR)
    table: dict[str, Any] = record.load(arguments.out, {})
    start = {f"mu{i}": mean for i, mean in enumerate(RESPONSE.mean)}
    start |= {f"sigma{i}": sd for i, sd in enumerate(RESPONSE.sd)}
    reference = minimised(lambda _: outputs, prb.Resimulated(REFERENCE), start)
    information = Information(reference.evaluator, 0, reference.theta)
    directions = local_sampling([information], np.array([1 / N])).identified
    covariance, prior_sd = along(reference, directions)
    variances, axes = np.linalg.eigh(covariance)
    table["identified"] = int(variances.size)
    for runs in arguments.runs:
        rows = table.setdefault(str(runs), [])
        for seed in range(len(rows), arguments.seeds):
            clock = time.perf_counter()
            propagation = prb.Resimulated(POINTS, random_seed=seed)
            optimum = minimised(partial(surrogate, runs=runs, seed=seed), propagation, start)
            seconds = time.perf_counter() - clock
            away = directions.T @ ((optimum.theta - reference.theta) / prior_sd)
            own, _ = along(optimum, directions)
            widths = np.sqrt(np.diag(axes.T @ own @ axes) / variances)
            rows.append(
                {
                    "runs": runs,
                    "off": (axes.T @ away / np.sqrt(variances)).tolist(),
                    "stderr": widths.tolist(),
                    "seconds": round(seconds, 1),
                }
            )
            record.save(arguments.out, table)
            print(runs, seed, figures(rows), flush=True)


def figures(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Return error, that of standard errors, and seconds, of several designs."""
    off, widths = (np.array([row[key] for row in rows]) for key in ("off", "stderr"))
    return {
        "off": float(np.sqrt((off**2).mean())),
        "worst": float(np.abs(off).max()),
        "widths": float(np.sqrt((np.log(widths) ** 2).mean())),
        "seconds": float(np.median([row["seconds"] for row in rows])),
    }


if __name__ == "__main__":
    main()
