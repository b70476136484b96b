"""pyABC: sequential Monte Carlo on whole data sets, by the Wasserstein and an adaptive distance.

The Wasserstein distance is that of the samples themselves; the adaptive one weighs mean, standard
deviation and quartiles anew in each generation, and correlations. Several outputs are told by the
principal components of the data, of which the Wasserstein distance is sliced. Both run until a number of generations, a smallest
rate of acceptance or a number of simulated data sets is reached. Its random numbers come from
NumPy's global state, which is seeded.

    python -m benchmarks.scoreboard.rivals.pyabc
"""

from __future__ import annotations

import tempfile
from typing import Any

import numpy as np
import pyabc

from benchmarks.scoreboard.problem import Draws, capped, components
from benchmarks.scoreboard.study import Rival, Task, main


class _Specimens(pyabc.Sumstat):
    """The responses themselves, a specimen a row."""

    def __init__(self, outputs: int) -> None:
        super().__init__()
        self.outputs = outputs

    def __call__(self, data: dict[str, Any]) -> Any:
        return data["y"].reshape(-1, self.outputs)


def moments(y: Any) -> dict[str, Any]:
    """Return mean, standard deviation and quartiles of each output."""
    low, middle, high = np.quantile(y, [0.25, 0.5, 0.75], axis=0)
    found = {"mean": y.mean(axis=0), "sd": y.std(axis=0)}
    found |= {"low": low, "middle": middle, "high": high}
    several = np.ndim(low) > 0
    if several:
        found["correlation"] = np.corrcoef(y.T)[np.triu_indices(y.shape[1], 1)]
    return found


def calibrate(task: Task, settings: dict[str, Any]) -> Draws:
    """Return draws of the hyperparameters, each as often as its weight asks."""
    problem, y = task.problem, task.observed
    wasserstein = settings["distance"] == "Wasserstein"
    np.random.seed(task.seed)  # noqa: NPY002 (pyABC draws from the global state)
    rng = np.random.default_rng(task.seed)
    several = y.ndim > 1
    parts = components(problem, y) if several else lambda values: values

    def told(values: Any) -> dict[str, Any]:
        return {"y": parts(values)} if wasserstein else moments(parts(values))

    def model(theta: Any) -> dict[str, Any]:
        z = rng.standard_normal((len(y), len(problem.inputs)))
        found = task.response(*problem.population(dict(theta), z)).reshape(y.shape)
        return told(capped(found, y))

    priors = {name: pyabc.RV(p.family, *p.arguments) for name, p in problem.priors.items()}
    outputs = len(problem.inputs) if several else 1
    distance: Any = pyabc.AdaptivePNormDistance()
    if wasserstein:
        kind = pyabc.WassersteinDistance if outputs == 1 else pyabc.SlicedWassersteinDistance
        distance = kind(sumstat=_Specimens(outputs), p=1)
    sampler = pyabc.ABCSMC(
        model, pyabc.Distribution(**priors), distance,
        population_size=settings["particles"], sampler=pyabc.SingleCoreSampler(),
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        sampler.new(f"sqlite:///{folder}/abc.db", told(y))
        history = sampler.run(
            max_nr_populations=settings["generations"],
            min_acceptance_rate=settings["least acceptance"],
            max_total_nr_simulations=settings["data sets"],
        )
        frame, weights = history.get_distribution()
    chosen = rng.choice(len(frame), size=4 * len(frame), p=weights / weights.sum())
    return {name: frame[name].to_numpy()[chosen] for name in priors}


COMMON = {"particles": 500, "generations": 15, "least acceptance": 0.02, "data sets": 40_000}
PACKAGES = ("pyabc", "numpy", "scipy", "POT")
RIVALS = (
    Rival("pyABC Wasserstein", PACKAGES, {"distance": "Wasserstein", **COMMON}, calibrate),
    Rival("pyABC adaptive", PACKAGES, {"distance": "adaptive", **COMMON}, calibrate),
)

if __name__ == "__main__":
    main(RIVALS)
