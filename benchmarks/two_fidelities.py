"""How many runs does a coarse response save, that correlates .95 with the expensive one?

Amplitudes of an oscillator under a harmonic force at three frequencies around its resonance.
Stiffness, mass and damping vary. Means and standard deviations of stiffness and damping are
unknown; fifty specimens are compared by `Joint(KullbackLeibler())`. Priors of means are a
population's standard deviation wide, of standard deviations a factor of 1.35.

Coarse responses: *mesh*, with a stiffness that is too large, as that of a coarse mesh, so that the
resonance is elsewhere; *damping*, in which all specimens have the same damping. Both correlate .95
with the fine one over the prior, in the mean of the outputs. And *unrelated*, which does not.

Emulators: fitted on n runs from the prior; their error is the root mean square over 8192 other
points of the prior, in units of the response's standard deviation there, in the mean of outputs.
Optima: of n runs and a cloud of 16 384 points around the calibrated population; off is the root
mean square distance from the optimum of Resimulated(65 536), over hyperparameters and seeds, in
standard errors.

    uv run python -m benchmarks.two_fidelities [--data-sets 10]
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from itertools import product
from typing import Any

import numpy as np
import pymc as pm
from scipy.stats import norm, qmc

import prbayes as prb
from benchmarks.study import Study
from prbayes.emulators.emulator import ROUGH_CANDIDATES
from prbayes.emulators.selection import Runs
from prbayes.model.evaluator import Evaluator

N = 50
RUNS = (32, 64, 128, 256, 512)
MEAN, SD = np.array([1000.0, 1.0, 2.0]), np.array([80.0, 0.05, 0.2])  # of the population
FREQUENCIES = np.sqrt(np.array([850.0, 1000.0, 1150.0]))  # around the mean resonance
# With these, coarse and fine responses correlate .95.
STIFFER, DAMPING = 1.025, 3.4


def amplitudes(stiffness: Any, mass: Any, damping: Any) -> Any:
    """Return amplitudes at three frequencies, (..., 3)."""
    k, m, c = (np.asarray(x)[..., None] for x in np.broadcast_arrays(stiffness, mass, damping))
    return 1000 / np.hypot(k - m * FREQUENCIES**2, c * FREQUENCIES)


def mesh(stiffness: Any, mass: Any, damping: Any) -> Any:
    """Return those of a coarse mesh, which is too stiff."""
    return amplitudes(STIFFER * stiffness, mass, damping)


def one_damping(stiffness: Any, mass: Any, damping: Any) -> Any:
    """Return those of specimens of the same damping."""
    return amplitudes(stiffness, mass, 0 * damping + DAMPING)


def unrelated(stiffness: Any, mass: Any, damping: Any) -> Any:
    """Return outputs that vary as much, and have nothing to do with amplitudes."""
    z = [(x - mean) / sd for x, mean, sd in zip((stiffness, mass, damping), MEAN, SD, strict=True)]
    return np.stack([np.sin(4 * z[0] * z[1]), np.cos(3 * z[1] + 2 * z[2]), np.sin(5 * z[2])], -1)


CASES: dict[str, Callable[..., Any]] = {
    "mesh": mesh,
    "damping": one_damping,
    "unrelated": unrelated,
}
WAYS = ("without", *CASES)


def prior(uniforms: Any) -> Any:
    """Return specimens of the prior, (n, 3), of points of the unit cube, (n, 9)."""
    z = norm.ppf(uniforms)
    unknown = np.array([1.0, 0.0, 1.0])  # the population of masses is known
    mean = MEAN + SD * unknown * z[:, :3]
    sd = SD * np.exp(0.3 * unknown * z[:, 3:6])
    return mean + sd * z[:, 6:]


def emulator_error(coarse: Callable[..., Any] | None, n: int, seed: int) -> float:
    """Return the error of emulators on n runs."""
    x = prior(qmc.Sobol(9, seed=seed).random(n))
    at = prior(qmc.Sobol(9, seed=10_000 + seed).random(2**13))
    truth = amplitudes(*at.T)
    beside, there = (None, None) if coarse is None else (coarse(*x.T), coarse(*at.T))
    runs = Runs(x, amplitudes(*x.T), np.full(n, 1 / n), np.arange(n) * 8 // n, beside)
    off = runs.predict(runs.fit(ROUGH_CANDIDATES), at, there) - truth
    errors = np.sqrt((off**2).mean(axis=0)) / truth.std(axis=0)
    return round(float(errors.mean()), 5)


def build(propagation: Any) -> pm.Model:
    """Return the model."""
    rng = np.random.default_rng(N)
    observed = amplitudes(*(MEAN + SD * rng.standard_normal((N, 3))).T)
    with pm.Model() as model:
        inputs = []
        for name, mean, sd in zip(("stiffness", "mass", "damping"), MEAN, SD, strict=True):
            if name == "mass":
                inputs.append(pm.Normal.dist(mean, sd))
                continue
            mu = pm.Normal(f"mean of {name}", mean, sd)
            inputs.append(pm.Normal.dist(mu, pm.LogNormal(f"sd of {name}", np.log(sd), 0.3)))
        metric = prb.Joint(prb.KullbackLeibler())
        prb.Simulator(
            "y", amplitudes, *inputs, metric=metric, observed=observed, propagation=propagation
        )
    return model


def away(coarse: Callable[..., Any] | None, n: int, seed: int) -> list[float]:
    """Calibrate with n runs, and return how far from the reference, in its standard errors."""
    fine = reference()
    stored = prb.Reweighted(n, emulator="auto", coarse=coarse, random_seed=seed)
    evaluator = Evaluator.of(build(stored))
    rng = np.random.default_rng(0)
    near = rng.multivariate_normal(fine.theta, fine.covariance, 64)
    evaluator.reweighted["y"].reach(evaluator.parents(near, 0), growth=2)
    optimum = prb.minimize(evaluator.model, start=fine.point, starts=0, refine=False)
    off = (optimum.theta - fine.theta) / np.sqrt(np.diag(fine.covariance))
    return [round(float(x), 4) for x in off]


@cache
def reference() -> prb.Optimum:
    """Return the optimum of the expensive response, resimulated."""
    return prb.minimize(build(prb.Resimulated(2**16)), starts=0)


def row(cell: str, seed: int) -> Any:
    """Return the error of emulators, or the distances of an optimum, on a number of runs."""
    what, n, way = cell.split("/")
    if what == "emulator":
        return emulator_error(CASES.get(way), int(n), seed)
    return away(CASES.get(way), int(n), seed)


def summary(rows: list[Any]) -> float:
    """Return the median error of emulators, or the root mean square distance of optima."""
    if isinstance(rows[0], float):
        return float(np.median(rows))
    return float(np.sqrt(np.square(rows).mean()))


CELLS = [f"{what}/{n}/{way}" for what, n, way in product(("emulator", "optimum"), RUNS, WAYS)]
STUDY = Study("two_fidelities", __doc__, CELLS, row, 10, summary)

if __name__ == "__main__":
    STUDY.main()
