"""prbayes at its defaults, with each metric: the optimum, then `sample_smc`.

uv run python -m benchmarks.scoreboard.rivals.prbayes
"""

from __future__ import annotations

from typing import Any

import pymc as pm

import prbayes as prb
from benchmarks.metrics import BY_NAME
from benchmarks.scoreboard import in_pymc
from benchmarks.scoreboard.problem import Draws
from benchmarks.scoreboard.study import Rival, Task, main


def _of_vector(task: Task) -> Any:
    return lambda x: task.response(x[..., 0], x[..., 1])


def calibrate(task: Task, settings: dict[str, Any]) -> Draws:
    """Return draws of the hyperparameters."""
    metric = BY_NAME[settings["metric"]]
    with pm.Model() as model:
        values = in_pymc.hyperparameters(task.problem)
        inputs = in_pymc.inputs(task.problem, values)
        if task.observed.ndim == 2:
            metric = prb.Joint(metric, components=task.problem.degrees)
        response = _of_vector(task) if task.problem.correlation else task.response
        prb.Simulator("y", response, *inputs, metric=metric, observed=task.observed)
    optimum = prb.minimize(model, progressbar=False)
    tree = prb.sample_smc(optimum=optimum, model=model, random_seed=task.seed, progressbar=False)
    return in_pymc.draws(tree.posterior, task.problem)


PACKAGES = ("prbayes", "pymc", "pytensor", "numpy", "scipy")
METRICS = {
    "PR": "ProbabilityResidual",
    "KLD": "KullbackLeibler",
    "area": "AreaMetric",
    "log-likelihood": "LogLikelihood",
}
# What the defaults were, so that results of other defaults are not gone on with.
_DEFAULTS = {"adjust": "given the estimate; a log-likelihood as it is"}
RIVALS = tuple(
    Rival(f"prbayes {name}", PACKAGES, {"metric": metric} | _DEFAULTS, calibrate)
    for name, metric in METRICS.items()
)

if __name__ == "__main__":
    main(RIVALS)
