"""What refits gain by exact gradients: seconds beside differences, by number of hyperparameters.

The objective of 50 data sets drawn around the truth, on a design that is there: a gradient of each
by differences to one side, a value for each hyperparameter and one more, and the exact one; how far
the two are apart, of the largest, by central differences; and the seconds that the graphs take to
compile. Normal outputs under `prb.Joint` and the Kullback-Leibler divergence, medians of pairs in
one process.

    uv run python -m benchmarks.gradients
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from benchmarks import record
from benchmarks.joint import Cell

RESULT = record.RESULTS / "gradients.json"
PROBLEMS = ("frame", "normal .6", "four .9")  # of four, five and nine hyperparameters
SIZE, SETS, PAIRS, STEP = 50, 50, 7, 1e-4


def measured(name: str) -> dict[str, Any]:
    """Return what gradients of one problem take."""
    from prbayes.estimate.batch_gradient import BatchGradient
    from prbayes.estimate.batch_objective import BatchObjective
    from prbayes.estimate.data_sets import sets_along

    cell = Cell(name, SIZE)
    evaluator = cell._observing("given KLD", cell.problem.response(cell.data(0)))
    truth = cell._thetas(cell._values_of_truth())
    rng = np.random.default_rng(1)
    root = np.linalg.cholesky(cell.spread)
    thetas = truth + rng.standard_normal((SETS, truth.shape[1])) @ root.T
    sets = sets_along(evaluator, thetas, rng)
    objective = BatchObjective.of(evaluator, np.ones(1), sets)
    begun = time.process_time()
    exact = BatchGradient.of(objective)
    compiling = time.process_time() - begun
    assert exact is not None
    d = thetas.shape[1]
    unit = STEP * np.eye(d)
    stencil = np.concatenate([np.zeros((1, d)), unit])
    rows = np.arange(SETS)
    seconds = []
    for _ in range(PAIRS):
        begun = time.process_time()
        objective(thetas[:, None] + stencil, rows)
        between = time.process_time()
        _, slopes = exact(thetas, rows)
        seconds.append((between - begun, time.process_time() - between))
    up, down = (objective(thetas[:, None] + sign * unit, rows) for sign in (1, -1))
    off = np.abs((up - down) / (2 * STEP) - slopes).max() / np.abs(slopes).max()
    differences, gradient = np.median(seconds, axis=0)
    ratio = float(np.median([a / b for a, b in seconds]))
    return {
        "hyperparameters": d,
        "points": evaluator.nodes[0].bound.n_points,
        "by differences, s": float(differences),
        "exact, s": float(gradient),
        "ratio": ratio,
        "apart": float(off),
        "compiling, s": compiling,
    }


def main() -> None:
    """Measure all problems, print a table, and write it."""
    found = {name: measured(name) for name in PROBLEMS}
    print("problem      hyper  points  differences s  exact s  ratio  apart  compiling s")
    for name, row in found.items():
        print(
            f"{name:12s} {row['hyperparameters']:5d} {row['points']:7d} "
            f"{row['by differences, s']:14.3f} {row['exact, s']:8.3f} {row['ratio']:6.1f} "
            f"{row['apart']:.0e} {row['compiling, s']:11.1f}"
        )
    record.save(RESULT, found)


if __name__ == "__main__":
    main()
