"""Stock PyMC: `pm.Simulator` with sorted values and a Gaussian distance, and `pm.sample_smc`.

As its documentation has it, a data set of the observed size is simulated at each call. The
tolerance is a share of the standard deviation of the data. Of several outputs the principal
components of the data are taken, and their correlations beside their sorted values.

    python -m benchmarks.scoreboard.rivals.stock_pymc
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pymc as pm

from benchmarks.scoreboard import in_pymc
from benchmarks.scoreboard.problem import Draws, capped, components, statistics
from benchmarks.scoreboard.study import Rival, Task, main


def calibrate(task: Task, settings: dict[str, Any]) -> Draws:
    """Return draws of the hyperparameters."""
    problem, y = task.problem, task.observed
    names = list(problem.priors)
    several = y.ndim > 1
    # One output is sorted by PyMC, and has its unit; components are sorted here, and have one.
    parts = components(problem, y) if several else None
    epsilon = settings["epsilon"] * (1.0 if several else y.std())
    statistic = "identity" if several else settings["sum_stat"]

    def told(values: Any) -> Any:
        return values if parts is None else statistics(parts(values))

    def simulate(rng: Any, *arguments: Any, size: Any = None) -> Any:
        *values, size = (*arguments, size) if size is not None else arguments
        z = rng.standard_normal((len(y), len(problem.inputs)))
        named = {name: np.ravel(value)[0] for name, value in zip(names, values, strict=True)}
        found = task.response(*problem.population(named, z))
        return told(capped(found.reshape(y.shape), y))

    with pm.Model():
        values = in_pymc.hyperparameters(problem)
        pm.Simulator(
            "y", simulate, *values.values(), distance="gaussian", sum_stat=statistic,
            epsilon=epsilon, observed=told(y), ndims_params=[0] * len(values),
        )  # fmt: skip
        tree = pm.sample_smc(
            settings["draws"], chains=settings["chains"], cores=1, random_seed=task.seed,
            progressbar=False, compute_convergence_checks=False,
        )  # fmt: skip
    return in_pymc.draws(tree.posterior, problem)


SETTINGS = {"epsilon": 0.3, "draws": 2000, "chains": 2, "distance": "gaussian", "sum_stat": "sort"}
RIVALS = (Rival("stock PyMC", ("pymc", "pytensor", "numpy", "scipy"), SETTINGS, calibrate),)

if __name__ == "__main__":
    main(RIVALS)
