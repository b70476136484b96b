"""sbi: neural posterior estimation, from whole data sets that are simulated from the prior.

A data set is told by its sorted values, standardised by the observed ones; sbi's own
standardisation and its default estimator, a masked autoregressive flow, are used.

    python -m benchmarks.scoreboard.rivals.sbi
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from sbi.inference import NPE

from benchmarks.scoreboard.problem import Draws
from benchmarks.scoreboard.study import CannotError, Rival, Task, main


def calibrate(task: Task, settings: dict[str, Any]) -> Draws:
    """Return draws of the hyperparameters."""
    problem, y = task.problem, task.observed
    if y.ndim > 1:
        raise CannotError("sorted values are of one output")
    torch.manual_seed(task.seed)
    torch.set_num_threads(1)
    rng = np.random.default_rng(task.seed)
    count = settings["data sets"]
    values = problem.prior_draws(rng, count)
    z = rng.standard_normal((count, len(y), len(problem.inputs)))
    simulated = np.minimum(task.response(*problem.population(values, z)), 10 * y.max())
    told = [torch.tensor(np.sort((v - y.mean()) / y.std()), dtype=torch.float32)
            for v in (simulated, y)]  # fmt: skip
    # Positive hyperparameters by their logarithms, so that no draw leaves the prior's support.
    positive = {name: p.distribution().support()[0] >= 0 for name, p in problem.priors.items()}
    columns = [np.log(v) if positive[name] else v for name, v in values.items()]
    theta = torch.tensor(np.stack(columns, axis=1), dtype=torch.float32)
    inference = NPE(show_progress_bars=False)
    estimator = inference.append_simulations(theta, told[0]).train(
        training_batch_size=settings["batch"]
    )
    with torch.no_grad():
        drawn = estimator.sample((settings["draws"],), condition=told[1][None])
    found = drawn.reshape(-1, len(values)).numpy().astype(float).T
    return {name: np.exp(x) if positive[name] else x for name, x in zip(values, found, strict=True)}


SETTINGS = {"data sets": 10_000, "batch": 200, "draws": 4000, "estimator": "maf"}
RIVALS = (Rival("sbi", ("sbi", "torch", "numpy", "scipy"), SETTINGS, calibrate),)

if __name__ == "__main__":
    main(RIVALS)
