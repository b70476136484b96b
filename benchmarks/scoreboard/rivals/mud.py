"""mud: data-consistent inversion, which weighs runs by the ratio of observed to predicted densities.

Inputs are drawn from the prior's population; the density of the data is a Gaussian kernel estimate,
with SciPy's default bandwidth on both sides. The updated density of the inputs is told by its mean
and standard deviation, where these are the hyperparameters: one number each, no width. Of more
outputs than inputs as many principal components are taken as there are inputs.

    python -m benchmarks.scoreboard.rivals.mud
"""

from __future__ import annotations

from typing import Any

import numpy as np
from mud.base import DensityProblem
from scipy.stats import gaussian_kde

from benchmarks.scoreboard.problem import Draws
from benchmarks.scoreboard.study import CannotError, Rival, Task, main


class _Kernel:
    """A kernel density estimate, in the shape in which mud asks for one."""

    def __init__(self, values: Any) -> None:
        self.estimate = gaussian_kde(values.T)

    def pdf(self, y: Any) -> Any:
        return self.estimate(y.T)[:, None]


def _components(outputs: Any, y: Any, count: int) -> tuple[Any, Any]:
    """Return principal components of predicted outputs, and the data's in the same directions."""
    center, unit = outputs.mean(axis=0), outputs.std(axis=0)
    directions = np.linalg.svd((outputs - center) / unit, full_matrices=False)[2][:count].T
    return (outputs - center) / unit @ directions, (y - center) / unit @ directions


def calibrate(task: Task, settings: dict[str, Any]) -> Draws:
    """Return the moments of the updated population of inputs."""
    problem, y = task.problem, task.observed.reshape(len(task.observed), -1)
    if any(x.family == "uniform" for x in problem.inputs):
        raise CannotError("the ends of a range are no moments of an updated density")
    rng = np.random.default_rng(task.seed)
    n = settings["points"]
    values = problem.prior_draws(rng, n)
    drawn = problem.population(values, rng.standard_normal((n, 1, len(problem.inputs))))
    inputs = [x[:, 0] for x in drawn]
    outputs = task.response(*inputs).reshape(n, -1)
    # Normal inputs: the logarithms of lognormal ones.
    columns = [
        np.log(x) if one.family == "lognormal" else x
        for x, one in zip(inputs, problem.inputs, strict=True)
    ]
    X = np.stack(columns, axis=1)
    there = np.isfinite(outputs).all(axis=1)
    X, outputs = X[there], outputs[there]
    if y.shape[1] > X.shape[1]:
        outputs, y = _components(outputs, y, X.shape[1])
    density = DensityProblem(X, outputs)
    density.set_initial(_Kernel(X))
    density.set_predicted(bw_method=settings["bandwidth"])
    density.set_observed(_Kernel(y))
    density.fit()
    # Points are drawn from the initial density already: the ratio alone is their weight.
    weights = np.ravel(density._r)
    weights = weights / weights.sum()
    found: dict[str, float] = {}
    for one, x in zip(problem.inputs, X.T, strict=True):
        mean = float(weights @ x)
        sd = float(np.sqrt(weights @ (x - mean) ** 2))
        found |= {str(one.first): mean, str(one.second): sd}
    if problem.correlation:
        found[problem.correlation] = float(np.cov(X.T, aweights=weights)[0, 1])
        for one in problem.inputs:
            found[problem.correlation] /= found[str(one.second)]
    if set(found) != set(problem.priors):
        raise CannotError("its hyperparameters are no moments of the inputs")
    return found


SETTINGS = {"points": 10_000, "bandwidth": "scott"}
RIVALS = (Rival("mud", ("mud", "numpy", "scipy"), SETTINGS, calibrate),)

if __name__ == "__main__":
    main(RIVALS)
