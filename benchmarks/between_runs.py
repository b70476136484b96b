"""Is a population that is emulated between runs ever worse than the runs' own weights?

Twelve responses, smooth and not (`benchmarks.responses`), each with a mean and a standard deviation
for every input; priors of means are one population standard deviation wide, of standard deviations
a factor of 1.35. The same runs are weighted alone (``emulator=None``) and with an emulator
(``emulator="auto"``) to the populations of 16 thetas around the truth, scattered as posteriors of 50
specimens are. Off is the root mean square error of their distribution functions at 31 quantiles, over
outputs, thetas and designs, in units of the sampling noise of 50 data; the reference is 65 536
responses of each population. One input has no emulator: the runs are a quadrature rule.

Run: uv run python -m benchmarks.between_runs [--seeds 8]
"""

from __future__ import annotations

import argparse
import logging
from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm
from scipy.stats import norm, qmc

import prbayes as prb
from benchmarks import record
from benchmarks.responses import RESPONSES, Response

SIZES = (64, 128, 256)
LEVELS = (np.arange(31) + 0.5) / 31
THETAS = 16
DATA = 50  # whose sampling noise is the unit, and whose posterior the thetas are scattered as
EMULATORS = (None, "auto")


def design_of(response: Response, n: int, seed: int, emulator: Any) -> Any:
    """Return an evaluator of a model of normal inputs, and its design."""
    from prbayes.model.evaluator import Evaluator

    def called(*inputs: Any) -> Any:
        x = np.stack(np.broadcast_arrays(*inputs), axis=-1)
        return response(x.reshape(-1, response.d)).reshape(*x.shape[:-1], response.outputs)

    x = response.mean + response.sd * np.random.default_rng(1).standard_normal((DATA, response.d))
    observed = response(x)
    observed = observed[~np.isnan(observed).any(axis=1)]
    with pm.Model() as model:
        inputs = []
        for i, (mean, sd) in enumerate(zip(response.mean, response.sd, strict=True)):
            mu = pm.Normal(f"mu{i}", mean, sd)
            sigma = pm.LogNormal(f"sigma{i}", np.log(sd), 0.3)
            inputs.append(pm.Normal.dist(mu, sigma))
        prb.Simulator(
            "y",
            called,
            *inputs,
            metric=prb.Joint(prb.ProbabilityResidual()),
            observed=observed,
            propagation=prb.Reweighted(n, emulator=emulator, random_seed=seed),
        )
    return Evaluator.of(model)


def populations(response: Response) -> list[tuple[Any, Any]]:
    """Return means and standard deviations of inputs, scattered as a posterior is."""
    rng = np.random.default_rng(2)
    z = rng.standard_normal((THETAS, 2, response.d))
    means = response.mean + response.sd * z[:, 0] / np.sqrt(DATA)
    sds = response.sd * np.exp(z[:, 1] / np.sqrt(2 * DATA))
    return list(zip(means, sds, strict=True))


def truths(response: Response) -> list[Any]:
    """Return quantiles of each population's outputs, (levels, m), those that are NaN left out."""
    uniforms = qmc.Sobol(response.d, rng=np.random.default_rng(3)).random(65_536)
    z = norm.ppf(np.clip(uniforms, 1e-9, 1 - 1e-9))
    found = []
    for mean, sd in populations(response):
        y = response(mean + sd * z)
        y = np.sort(y[~np.isnan(y).any(axis=1)], axis=0)
        found.append(y[(LEVELS * len(y)).astype(int)])
    return found


def off(evaluator: Any, response: Response, known: list[Any]) -> float:
    """Return the root mean square error of distribution functions, in sampling noise."""
    noise = np.sqrt(LEVELS * (1 - LEVELS) / DATA)
    thetas = []
    for mean, sd in populations(response):
        values: dict[str, Any] = {}
        for i in range(response.d):
            values |= {f"mu{i}": mean[i], f"sigma{i}": sd[i]}
        thetas.append(evaluator.hyperparameters.unconstrained(values))
    simulated, weights = evaluator.populations(np.array(thetas), 0)
    squares = []
    for y, w, quantiles in zip(simulated, weights, known, strict=True):
        has = ~np.isnan(y).any(axis=1)
        share = w[has] / w[has].sum()
        for output in range(response.outputs):
            at = quantiles[:, output]
            counted = np.isfinite(at) & (np.diff(at, prepend=-np.inf) > 0)  # no atoms
            below = (y[has, output][:, None] <= at[counted]).T @ share
            squares.append((((below - LEVELS[counted]) / noise[counted]) ** 2).mean())
    return float(np.mean(squares))


def cell(name: str, n: int, seeds: int) -> dict[str, float]:
    """Return the error of both, and the largest share of the runs that was chosen."""
    response = RESPONSES[name]
    known = truths(response)
    found: dict[str, list[float]] = {"alone": [], "emulated": [], "share": []}
    for seed in range(seeds):
        for key, emulator in zip(("alone", "emulated"), EMULATORS, strict=True):
            evaluator = design_of(response, n, seed, emulator)
            found[key].append(off(evaluator, response, known))
        emulation = evaluator.reweighted["y"].design.emulator
        found["share"].append(1.0 if emulation is None else emulation.run_share)
    alone, emulated = (float(np.sqrt(np.mean(found[key]))) for key in ("alone", "emulated"))
    return {
        "inputs": response.d,
        "alone": alone,
        "emulated": emulated,
        "ratio": emulated / alone,
        "share": float(np.mean(found["share"])),
    }


def main() -> None:
    """Print a table and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--only", nargs="+", default=list(RESPONSES), choices=list(RESPONSES))
    parser.add_argument("--out", type=Path, default=record.RESULTS / "between_runs.json")
    arguments = parser.parse_args()
    logging.getLogger("prbayes").setLevel(logging.ERROR)
    table: dict[str, Any] = record.load(arguments.out, {})
    print(f"{'response':14s}{'inputs':>7s}{'runs':>6s}{'alone':>9s}{'emulated':>10s}{'ratio':>8s}")
    for name in arguments.only:
        for n in SIZES:
            found = table[f"{name}/{n}"] = cell(name, n, arguments.seeds)
            print(
                f"{name:14s}{found['inputs']:7.0f}{n:6d}{found['alone']:9.3f}"
                f"{found['emulated']:10.3f}{found['ratio']:8.2f}",
                flush=True,
            )
    record.save(arguments.out, table)


if __name__ == "__main__":
    main()
