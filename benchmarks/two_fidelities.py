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
standard errors. With a coarse response that is exact they are off by what the cloud is.

Run: uv run python -m benchmarks.two_fidelities [--seeds 10]
"""

from __future__ import annotations

import argparse
import logging
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm
from scipy.stats import norm, qmc

import prbayes as prb
from benchmarks import record
from prbayes.emulators.selection import CANDIDATES, Runs, predict_outputs, select_surfaces
from prbayes.model.evaluator import Evaluator

N = 50
RUNS = (32, 64, 128, 256, 512)
OPTIMA = (32, 64, 128, 256, 512)
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


def correlations(case: str) -> list[float]:
    """Return the correlations of fine and coarse response over the prior, of each output."""
    x = prior(qmc.Sobol(9, seed=7).random(2**14)).T
    pairs = zip(amplitudes(*x).T, CASES[case](*x).T, strict=True)
    return [round(float(np.corrcoef(a, b)[0, 1]), 3) for a, b in pairs]


def emulator_error(coarse: Callable[..., Any] | None, n: int, seed: int) -> float:
    """Return the error of emulators on n runs."""
    x = prior(qmc.Sobol(9, seed=seed).random(n))
    at = prior(qmc.Sobol(9, seed=10_000 + seed).random(2**13))
    truth = amplitudes(*at.T)
    beside, there = (None, None) if coarse is None else (coarse(*x.T), coarse(*at.T))
    runs = Runs(x, amplitudes(*x.T), np.full(n, 1 / n), np.arange(n) * 8 // n, beside)
    models, _ = select_surfaces(CANDIDATES, runs)
    off = predict_outputs(models, runs, at, coarse=there) - truth
    errors = np.sqrt((off**2).mean(axis=0)) / truth.std(axis=0)
    return round(float(errors.mean()), 5)


def emulators(seeds: int, found: dict[str, dict[str, list[float]]]) -> Iterator[None]:
    """Fit emulators that are not yet among those that were found, by runs and coarse response."""
    for n in RUNS:
        rows = found.setdefault(str(n), {way: [] for way in WAYS})
        for way, errors in rows.items():
            for seed in range(len(errors), seeds):
                errors.append(emulator_error(CASES.get(way), n, seed))
        yield


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


def away(coarse: Callable[..., Any] | None, n: int, seed: int, reference: Any) -> list[float]:
    """Calibrate with n runs, and return how far from the reference, in its standard errors."""
    stored = prb.Reweighted(n, emulator="auto", coarse=coarse, random_seed=seed)
    evaluator = Evaluator.of(build(stored))
    rng = np.random.default_rng(0)
    near = rng.multivariate_normal(reference.theta, reference.covariance, 64)
    evaluator.reweighted["y"].reach(evaluator.parents(near, 0), growth=2)
    optimum = prb.minimize(
        evaluator.model, start=reference.point, starts=0, refine=False, progressbar=False
    )
    off = (optimum.theta - reference.theta) / np.sqrt(np.diag(reference.covariance))
    return [round(float(x), 4) for x in off]


def optima(seeds: int, found: dict[str, dict[str, list[list[float]]]]) -> Iterator[None]:
    """Calibrate with what is not yet among the optima that were found, by runs and response."""
    fine = build(prb.Resimulated(2**16))
    reference = prb.minimize(fine, starts=0, progressbar=False)
    ways = {"without": None, "exact": amplitudes, **CASES}
    for seed in range(seeds):
        for n in OPTIMA:
            rows = found.setdefault(str(n), {way: [] for way in ways})
            for way, coarse in ways.items():
                if len(rows[way]) == seed:
                    rows[way].append(away(coarse, n, seed, reference))
            yield


def times_fewer(errors: dict[str, dict[str, float]]) -> dict[str, str]:
    """Return how many times as many runs are needed without the coarse response, by runs with it.

    Between the numbers of runs that were tried errors are powers of it.
    """
    runs = np.log([int(n) for n in errors])
    without = np.log([row["without"] for row in errors.values()])
    found = {}
    for n, row in errors.items():
        wanted = np.log(row["with"])
        if wanted < without.min():
            found[n] = f"> {np.exp(runs[-1]) / int(n):.0f}"
        else:
            needed = np.interp(-wanted, -np.minimum.accumulate(without), runs)
            found[n] = f"{np.exp(needed) / int(n):.1f}"
    return found


def table(errors: dict[str, dict[str, float]]) -> None:
    """Print errors, and how many runs are saved."""
    saved = times_fewer(errors)
    print("       runs   without      with   runs saved, times")
    for n, row in errors.items():
        print(f"   {n:>8} {row['without']:9.3f} {row['with']:9.3f}   {saved[n]}", flush=True)


def shown(case: str, whole: dict[str, Any]) -> None:
    """Print the tables of a case."""
    print(f"{case}: correlates {whole['correlations'][case]} with the fine one")
    print("  emulators, error in standard deviations of the response")
    emulators = whole["emulators"].items()
    table(
        {n: {"without": median(row["without"]), "with": median(row[case])} for n, row in emulators}
    )
    print("  optima, off in standard errors")
    optima = whole["optima"].items()
    table({n: {"without": rms(row["without"]), "with": rms(row[case])} for n, row in optima})


def median(errors: list[float]) -> float:
    """Return the median."""
    return float(np.median(errors))


def rms(rows: list[list[float]]) -> float:
    """Return the root mean square distance."""
    return float(np.sqrt(np.square(rows).mean()))


def main() -> None:
    """Print tables and write JSON; what was found before is not computed again."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--out", type=Path, default=record.RESULTS / "two_fidelities.json")
    parser.add_argument("--only-table", action="store_true")
    arguments = parser.parse_args()
    logging.getLogger("prbayes").setLevel(logging.ERROR)
    whole: dict[str, Any] = record.load(arguments.out, {"emulators": {}, "optima": {}})
    if not arguments.only_table:
        whole["correlations"] = {case: correlations(case) for case in CASES}
        for part in (emulators, optima):
            for _ in part(arguments.seeds, whole[part.__name__]):
                record.save(arguments.out, whole)
    for case in CASES:
        shown(case, whole)
    exact = [f"{n} runs {rms(row['exact']):.3f}" for n, row in whole["optima"].items()]
    print(f"optima with a coarse response that is exact: {', '.join(exact)}")


if __name__ == "__main__":
    main()
