"""prbayes at its defaults: its log-likelihood by specimen, and each metric.

    uv run python -m benchmarks.scoreboard.rivals.prbayes

With the log-likelihood by specimen (``prbayes likelihood``) the posterior is sampled by
`prb.sample`. With a metric: the optimum, then `prb.sample`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pymc as pm

import prbayes as prb
from benchmarks.metrics import BY_CLASS
from benchmarks.scoreboard import in_pymc
from benchmarks.scoreboard.problem import Draws
from benchmarks.scoreboard.study import Rival, Task, main


def _of_vector(task: Task) -> Any:
    return lambda x: task.response(x[..., 0], x[..., 1])


def calibrate(task: Task, settings: dict[str, Any]) -> Draws:
    """Return draws of the hyperparameters by a metric."""
    metric = BY_CLASS[settings["metric"]]
    with pm.Model() as model:
        values = in_pymc.hyperparameters(task.problem)
        inputs = in_pymc.inputs(task.problem, values)
        if task.problem.separate:
            for k, column in enumerate(task.observed.T):
                prb.Simulator(f"y{k}", _output(task, k), *inputs, metric=metric, observed=column)
        else:
            if task.observed.ndim == 2:
                metric = prb.Joint(metric, components=task.problem.degrees)
            response = _of_vector(task) if task.problem.correlation else task.response
            prb.Simulator("y", response, *inputs, metric=metric, observed=task.observed)
    optimum = prb.minimize(model, progressbar=False)
    tree = prb.sample(optimum=optimum, model=model, random_seed=task.seed, progressbar=False)
    return in_pymc.draws(tree.posterior, task.problem)


def _output(task: Task, k: int) -> Any:
    """Return the response of one output."""
    return lambda *x: task.response(*x)[..., k]


def likelihood_model(task: Task) -> pm.Model:
    """Return the model of a problem with the log-likelihood by specimen."""
    problem, observed = task.problem, task.observed
    with pm.Model() as model:
        values = in_pymc.hyperparameters(problem)
        inputs = in_pymc.inputs(problem, values)
        if problem.separate:
            # One row for each specimen, which was measured in one output.
            observed = np.where(np.eye(observed.shape[1])[:, None] > 0, observed, np.nan)
            observed = observed.reshape(-1, observed.shape[-1])
        error = None
        if problem.degrees is not None:
            # Readings of a curve, whose error is not known.
            error = pm.HalfNormal("error", 0.1 * observed.std(axis=0))
        metric = prb.LogLikelihood(error=error, gross_errors=problem.name in _GROSS)
        response = _of_vector(task) if problem.correlation else task.response
        prb.Simulator("y", response, *inputs, metric=metric, observed=observed)
    return model


def calibrate_likelihood(task: Task, settings: dict[str, Any]) -> Draws:
    """Return draws of the hyperparameters by the log-likelihood by specimen."""
    model = likelihood_model(task)
    tree = prb.sample(settings["draws"], model=model, random_seed=task.seed, progressbar=False)
    return in_pymc.draws(tree.posterior, task.problem)


PACKAGES = ("prbayes", "pymc", "pytensor", "numpy", "scipy")
METRICS = {
    "PR": "ProbabilityResidual",
    "KLD": "KullbackLeibler",
    "area": "AreaMetric",
    "kernel log-likelihood": "LogLikelihood",
}
# What the defaults were, so that results of other defaults are not gone on with.
_DEFAULTS = {"sampler": "prb.sample", "posterior": "given the estimate"}
_GROSS = ("contaminated",)  # problems whose data may have gross errors
_LIKELIHOOD = {"sampler": "prb.sample", "draws": 1000}
RIVALS = (
    Rival("prbayes likelihood", PACKAGES, _LIKELIHOOD, calibrate_likelihood),
    *(
        Rival(f"prbayes {name}", PACKAGES, {"metric": metric} | _DEFAULTS, calibrate)
        for name, metric in METRICS.items()
    ),
)

if __name__ == "__main__":
    main(RIVALS)
