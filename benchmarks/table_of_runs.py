"""Posteriors from tables of runs beside those from the function, on the same data.

Each row is a data set: posterior means and standard deviations by the function, and by tables of
64, 128 and 200 of its runs on a Sobol design over a box, or log-normal around the population.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pymc as pm

import prbayes as prb
from benchmarks.study import Study
from prbayes.numerics.points import sobol

SIZES = (64, 128, 200)


def plate(e: Any, t: Any) -> Any:
    """Return the frequency of a plate: one output of two inputs."""
    return 2.457 * t * np.sqrt(e)


def growth(c: Any) -> Any:
    """Return the life of a crack: one output of one input."""
    return 8.0 / np.asarray(c) ** 1.5


def beam(a: Any, b: Any) -> Any:
    """Return two outputs of two inputs."""
    return np.stack(np.broadcast_arrays(a * b**2, np.sqrt(a) + np.sin(b)), axis=-1)


def waves(x: Any, y: Any) -> Any:
    """Return two outputs of two inputs, one of which is folded."""
    return np.stack(np.broadcast_arrays((x - 1) ** 2 + y, np.exp(y)), axis=-1)


def model_of(problem: str, response: Any, observed: Any, metric: Any) -> pm.Model:
    """Return the model of a problem."""
    with pm.Model() as model:
        if problem == "plate":
            e = pm.Normal.dist(pm.Normal("mean", 70, 10), pm.HalfNormal("sd", 8))
            inputs = [e, pm.Normal.dist(2, 0.03)]
        elif problem == "growth":
            inputs = [pm.LogNormal.dist(pm.Normal("mean", 0, 0.5), pm.HalfNormal("sd", 0.5))]
        elif problem == "beam":
            inputs = [
                pm.LogNormal.dist(pm.Normal("mean", 0, 0.5), pm.HalfNormal("sd", 0.5)),
                pm.Normal.dist(pm.Normal("mean_b", 1, 0.3), pm.HalfNormal("sd_b", 0.3)),
            ]
        else:
            inputs = [
                pm.Normal.dist(pm.Normal("mean", 1.5, 0.5), pm.HalfNormal("sd", 0.5)),
                pm.Normal.dist(pm.Normal("mean_y", 0, 0.5), pm.HalfNormal("sd_y", 0.5)),
            ]
        prb.Simulator("f", response, *inputs, observed=observed, metric=metric)
    return model


# Response, centre and standard deviation of the inputs, which are log-normal, and box of the runs.
PROBLEMS: dict[str, tuple[Any, Any, Any, Any]] = {
    "plate": (plate, (70.0, 2.0), (4.0, 0.03), [(45, 1.85), (100, 2.15)]),
    "growth": (growth, (1.0,), (0.25,), [(0.2,), (3.0,)]),
    "beam": (beam, (1.0, 1.0), (0.2, 0.15), [(0.2, 0.2), (2.5, 1.6)]),
    "waves": (waves, (1.5, 0.0), (0.4, 0.2), [(-2.0, -1.5), (4.0, 1.5)]),
}
CELLS = [
    *(f"{problem}, box" for problem in PROBLEMS),
    *(f"{problem}, scattered" for problem in ("plate", "growth", "beam")),
    "plate, box, PR",
]


def runs_of(problem: str, n: int, *, scattered: bool, seed: int) -> prb.Runs:
    """Return a table of n runs: in a box, or log-normal around the population, four times as wide."""
    function, centre, sd, box = PROBLEMS[problem]
    if scattered:
        rng = np.random.default_rng([seed, n])
        wide = 3 * np.array(sd) / np.array(centre)
        x = np.array(centre) * np.exp(wide * rng.normal(size=(n, len(centre))))
    else:
        low, high = np.array(box, dtype=float)
        x = low + (high - low) * sobol(n, len(centre), seed)
    return prb.Runs(x, function(*x.T))


def moments(problem: str, response: Any, observed: Any, metric: Any) -> list[list[float]]:
    """Return posterior means and standard deviations of the hyperparameters."""
    model = model_of(problem, response, observed, metric)
    posterior = prb.sample(model=model, random_seed=1, progressbar=False).posterior
    names = [rv.name for rv in model.free_RVs]
    draws = [posterior[name] for name in names]
    return [[float(x.mean()) for x in draws], [float(x.std()) for x in draws]]


def row(cell: str, number: int) -> Any:
    """Return the moments by the function, and by each table; an error text of a refused one."""
    problem, kind, *metrics = cell.split(", ")
    function, centre, sd, _ = PROBLEMS[problem]
    rng = np.random.default_rng([number, 7])
    observed = function(*(rng.normal(c, s, 30) for c, s in zip(centre, sd, strict=True)))
    metric = prb.ProbabilityResidual() if metrics else None
    result: dict[str, Any] = {"function": moments(problem, function, observed, metric)}
    for n in SIZES:
        runs = runs_of(problem, n, scattered=kind == "scattered", seed=number)
        try:
            result[str(n)] = moments(problem, runs, observed, metric)
        except prb.propagation.DesignError as error:
            result[str(n)] = str(error)
    return result


def summary(rows: list[Any]) -> dict[str, Any]:
    """Return the largest differences of means (in posterior sd) and sds (ratio less 1) by size."""
    figures: dict[str, Any] = {}
    for n in map(str, SIZES):
        used = [r for r in rows if not isinstance(r[n], str)]
        shifts = [
            np.abs(np.subtract(r[n][0], r["function"][0]) / np.array(r["function"][1])).max()
            for r in used
        ]
        widths = [np.abs(np.divide(r[n][1], r["function"][1]) - 1).max() for r in used]
        figures[n] = {
            "refused": len(rows) - len(used),
            "mean": round(float(max(shifts)), 3) if shifts else None,
            "sd": round(float(max(widths)), 3) if widths else None,
        }
    return figures


STUDY = Study(
    name="table_of_runs", doc=__doc__ or "", cells=CELLS, row=row, data_sets=4, summary=summary
)

if __name__ == "__main__":
    STUDY.main()
