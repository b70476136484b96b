"""sbi: neural posterior estimation, from whole data sets that are simulated from the prior.

A data set is told by its sorted values, standardised by the observed ones; of several outputs by
those of the data's principal components and their correlations. sbi's own standardisation and its
default estimator, a masked autoregressive flow, are used. Draws outside the prior are drawn anew,
as sbi's posteriors do.

    python -m benchmarks.scoreboard.rivals.sbi
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from sbi.inference import NPE

from benchmarks.scoreboard.problem import Draws, capped, components, statistics
from benchmarks.scoreboard.study import Rival, Task, main

_TRIES = 100  # batches of draws; an estimator that leaves so few within the prior has failed


def calibrate(task: Task, settings: dict[str, Any]) -> Draws:
    """Return draws of the hyperparameters."""
    problem, y = task.problem, task.observed.reshape(len(task.observed), -1)
    torch.manual_seed(task.seed)
    torch.set_num_threads(1)
    rng = np.random.default_rng(task.seed)
    count = settings["data sets"]
    values = problem.prior_draws(rng, count)
    z = rng.standard_normal((count, len(y), len(problem.inputs)))
    responses = task.response(*problem.population(values, z)).reshape(count, *y.shape)
    several = y.shape[1] > 1
    standard = components(problem, y) if several else lambda v: (v - y.mean()) / y.std()
    both = [standard(v) for v in (capped(responses, y), y)]
    told = [torch.tensor(statistics(v), dtype=torch.float32) for v in both]
    # Positive hyperparameters by their logarithms, so that no draw leaves the prior's support.
    positive = {name: p.distribution().support()[0] >= 0 for name, p in problem.priors.items()}
    columns = [np.log(v) if positive[name] else v for name, v in values.items()]
    theta = torch.tensor(np.stack(columns, axis=1), dtype=torch.float32)
    inference = NPE(show_progress_bars=False)
    estimator = inference.append_simulations(theta, told[0]).train(
        training_batch_size=settings["batch"]
    )
    kept: list[Any] = []
    for _ in range(_TRIES):
        with torch.no_grad():
            drawn = estimator.sample((settings["draws"],), condition=told[1][None])
        found = drawn.reshape(-1, len(values)).numpy().astype(float).T
        pairs = zip(values, found, strict=True)
        draws = {name: np.exp(x) if positive[name] else x for name, x in pairs}
        inside = np.isfinite(problem.log_prior(draws))
        kept.append(np.array(list(draws.values()))[:, inside])
        if sum(k.shape[1] for k in kept) >= settings["draws"]:
            whole = np.concatenate(kept, axis=1)[:, : settings["draws"]]
            return dict(zip(values, whole, strict=True))
    raise RuntimeError(f"fewer than one draw in {_TRIES} lies within the prior")


SETTINGS = {"data sets": 10_000, "batch": 200, "draws": 4000, "estimator": "maf"}
RIVALS = (Rival("sbi", ("sbi", "torch", "numpy", "scipy"), SETTINGS, calibrate),)

if __name__ == "__main__":
    main(RIVALS)
