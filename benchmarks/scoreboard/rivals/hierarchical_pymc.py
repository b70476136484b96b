"""A plain hierarchical model in PyMC: each specimen's inputs are latent variables, under NUTS.

Readings need an error: its standard deviation where it is known, and a share of that of the data
where the response is exact. The formula is written in PyTensor, and its runs are not counted: the
sampler needs its gradient. Latent variables stand centred, since each reading tells its specimen.

    python -m benchmarks.scoreboard.rivals.hierarchical_pymc
"""

from __future__ import annotations

from typing import Any

import arviz as az
import pymc as pm
import pytensor.tensor as pt

from benchmarks.scoreboard import in_pymc
from benchmarks.scoreboard.problem import Draws
from benchmarks.scoreboard.study import Rival, Task, main


def calibrate(task: Task, settings: dict[str, Any]) -> Draws:
    """Return draws of the hyperparameters."""
    problem, y = task.problem, task.observed
    error = problem.error or settings["error"] * y.std(axis=0)
    with pm.Model():
        values = in_pymc.hyperparameters(problem)
        latent = in_pymc.latent(problem, values, y.size if problem.separate else len(y))
        outputs = problem.formula(pt, *latent)
        if problem.separate:
            outputs = [output[k * len(y) : (k + 1) * len(y)] for k, output in enumerate(outputs)]
        mean = pt.stack(outputs, axis=-1) if type(outputs) is list else outputs
        pm.Normal("y", mean, error, observed=y)
        tree = pm.sample(
            settings["draws"], tune=settings["tune"], chains=settings["chains"], cores=1,
            target_accept=settings["target_accept"], random_seed=task.seed, progressbar=False,
            compute_convergence_checks=False,
        )  # fmt: skip
    posterior = tree.posterior.to_dataset()
    worst = max(float(az.rhat(posterior[name].to_numpy())) for name in problem.priors)
    if not worst < settings["largest R-hat"]:
        raise RuntimeError(f"R-hat is {worst:.2f}")
    return in_pymc.draws(tree.posterior, problem)


SETTINGS = {
    "draws": 1000,
    "tune": 1000,
    "chains": 4,
    "target_accept": 0.9,
    "error": 0.05,
    "largest R-hat": 1.05,
}
PACKAGES = ("pymc", "pytensor", "arviz", "numpy", "scipy")
RIVALS = (Rival("hierarchical PyMC", PACKAGES, SETTINGS, calibrate),)

if __name__ == "__main__":
    main(RIVALS)
