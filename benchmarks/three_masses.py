"""Three masses on springs whose stiffnesses are uniform: the ends of their ranges from few runs.

The benchmark of Khodaparast, Mottershead and Badcock (Mech. Syst. Signal Process. 25, 2011, 1204):
one run gives three eigenvalues and a component of the first eigenvector, of three uncertain springs
each; in one case the modes are well separated, in the other they are close. The data are specimens
from the true ranges. All four outputs are compared together, `Joint(KullbackLeibler())`; the ends
have uniform priors over either half of the published box, and move the populations' support.

Run: uv run python -m benchmarks.three_masses [--runs 96] [--specimens 10000]
"""

from __future__ import annotations

import argparse
import logging
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm

import prbayes as prb
from benchmarks import record


@dataclass(frozen=True)
class Case:
    """Masses, fixed springs, and which springs are uncertain, by number from one."""

    masses: tuple[float, float, float]
    fixed: dict[int, float]
    uncertain: tuple[int, int, int]
    ends: tuple[tuple[float, float], ...]  # true, of each uncertain spring
    box: tuple[tuple[float, float], ...]  # of the prior


CASES = {
    "well separated": Case(
        (1, 1, 1), {3: 1, 4: 1, 6: 3}, (1, 2, 5), ((0.8, 1.2),) * 3, ((0.5, 1.5),) * 3
    ),
    "close": Case(
        (1, 4, 1),
        {1: 0, 3: 0, 6: 1},
        (2, 4, 5),
        ((7.5, 8.5), (1.8, 2.2), (1.8, 2.2)),
        ((6.5, 9.5), (1.6, 2.4), (1.5, 2.4)),
    ),
}


def outputs(case: Case, springs: Any) -> Any:
    """Return three eigenvalues and the first mode's first component, (..., 4), of springs (..., 3)."""
    flat = springs.reshape(-1, 3)
    k = {number: np.full(len(flat), float(value)) for number, value in case.fixed.items()}
    k |= dict(zip(case.uncertain, flat.T, strict=True))
    stiffness = np.zeros((len(flat), 3, 3))
    stiffness[:, 0, 0] = k[1] + k[4] + k[6]
    stiffness[:, 1, 1] = k[2] + k[4] + k[5]
    stiffness[:, 2, 2] = k[3] + k[5] + k[6]
    for i, j, number in ((0, 1, 4), (0, 2, 6), (1, 2, 5)):
        stiffness[:, i, j] = stiffness[:, j, i] = -k[number]
    root = 1 / np.sqrt(case.masses)
    values, vectors = np.linalg.eigh(stiffness * root * root[:, None])
    first = vectors[:, :, 0] * root
    component = np.abs(first[:, 0]) / np.linalg.norm(first, axis=1)
    found = np.concatenate([values, component[:, None]], axis=1)
    return found.reshape(*springs.shape[:-1], 4)


def found(case: Case, runs: int, specimens: int, seed: int) -> dict[str, Any]:
    """Calibrate once."""
    rng = np.random.default_rng(seed)
    low, high = np.transpose(case.ends)
    observed = outputs(case, rng.uniform(low, high, (specimens, 3)))
    with pm.Model() as model:
        inputs = []
        for number, (lowest, highest) in zip(case.uncertain, case.box, strict=True):
            middle = (lowest + highest) / 2
            ends = (
                pm.Uniform(f"low{number}", lowest, middle),
                pm.Uniform(f"high{number}", middle, highest),
            )
            inputs.append(pm.Uniform.dist(*ends))
        prb.Simulator(
            "modes",
            lambda *springs: outputs(case, np.stack(np.broadcast_arrays(*springs), axis=-1)),
            *inputs,
            metric=prb.Joint(prb.KullbackLeibler()),
            observed=observed,
            propagation=prb.Reweighted(runs),
        )
    clock = time.perf_counter()
    optimum = prb.minimize(model, starts=0, progressbar=False)
    pairs = [[float(optimum.point[f"{end}{n}"]) for end in ("low", "high")] for n in case.uncertain]
    return {
        "runs": optimum.n_responses,
        "ends": pairs,
        "errors %": (100 * (np.array(pairs) / case.ends - 1)).tolist(),
        "stderr": {name: float(value) for name, value in optimum.stderr.items()},
        "design_error": float(optimum.design_error),
        "seconds": round(time.perf_counter() - clock),
    }


def main() -> None:
    """Print a table and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=96, help="to begin with")
    parser.add_argument("--specimens", type=int, default=10_000)
    parser.add_argument("--seeds", type=int, default=2, help="sets of specimens")
    parser.add_argument("--out", type=Path, default=record.RESULTS / "three_masses.json")
    arguments = parser.parse_args()
    logging.getLogger("prbayes").setLevel(logging.ERROR)
    table: dict[str, Any] = {}
    for name, case in CASES.items():
        rows = [
            found(case, arguments.runs, arguments.specimens, seed)
            for seed in range(arguments.seeds)
        ]
        table[name] = rows
        for row in rows:
            ends = "  ".join(f"[{low:.3f}, {high:.3f}]" for low, high in row["ends"])
            worst = np.abs(row["errors %"]).max()
            print(
                f"{name:14s} {row['runs']:4d} runs  {ends}  worst {worst:.2f} %, {row['seconds']} s",
                flush=True,
            )
        record.save(arguments.out, table)


if __name__ == "__main__":
    main()
