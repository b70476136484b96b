"""Case study 1 of the paper: accuracy and number of evaluations of four metrics on four system functions.

Monte Carlo: one million points with random numbers that are the same for all hyperparameters, as in
the paper. Sobol: 4096 points beside them. Each data set of N observations is fitted from the same
start by Nelder-Mead at three x tolerances, in units of the priors' spread, and by BFGS. An
evaluation of BFGS is one of value and gradient; here the gradient is by central differences, and
counts as one, as it does where the response accepts PyTensor variables. A fit has failed if the
optimiser says so, or if mean or standard deviation are off by more than half.

    uv run python -m benchmarks.paper_case1 --cells "sobol*"
    uv run python -m benchmarks.paper_case1 --cells "monte carlo*" --data-sets 10    # hours
"""

from __future__ import annotations

from functools import lru_cache
from itertools import product
from typing import Any

import numpy as np

import prbayes as prb
from benchmarks.metrics import METRICS
from benchmarks.study import Study
from benchmarks.systems import SYSTEMS
from prbayes.model.evaluator import Evaluator
from prbayes.model.parameters import unconstrained
from prbayes.optimize.convergence import Search, Trace, minimise, settle
from prbayes.optimize.objective import Method, Minimisation

SIZES = (20, 50, 1000, 100_000)
POINTS = {
    "sobol": prb.Resimulated(4096),
    "monte carlo": prb.Resimulated(1_000_000, points="monte_carlo"),
}
METHODS = {
    **{f"NM {x:g}": Method("Nelder-Mead", {"xatol": x, "fatol": x}) for x in (1e-2, 1e-3, 1e-4)},
    "BFGS": Method("BFGS"),
}


def remembered(total: Any) -> Any:
    """Return a function that evaluates no theta twice: simplices of several tolerances walk the same way."""
    known: dict[bytes, float] = {}

    def function(thetas: Any, scales: Any) -> Any:
        new = [i for i, t in enumerate(thetas) if t.tobytes() not in known]
        if new:
            values = total(thetas[new], scales)
            known.update(zip((thetas[i].tobytes() for i in new), values, strict=True))
        return np.array([known[t.tobytes()] for t in thetas])

    return function


@lru_cache(1)
def evaluator(points: str, system: str) -> Evaluator:
    """Return an evaluator of a system."""
    return SYSTEMS[system].evaluator(POINTS[points])


def row(cell: str, seed: int) -> dict[str, list[float]]:
    """Return mu, sigma, evaluations and whether it converged, by method."""
    points, name, n, metric = cell.split("/")
    system, base = SYSTEMS[name], evaluator(points, name)
    rng = np.random.default_rng([seed, int(n), list(SYSTEMS).index(name)])
    ev = base.observing({"y": system.data(rng, int(n))}, METRICS[metric])
    vars(ev)["total"] = remembered(ev.total)
    names = base.hyperparameters
    fits = {}
    for method, configured in METHODS.items():
        settings = Minimisation(method=configured, max_evaluations=2000)
        search = Search(ev, names.prior_sd, settings)
        theta = unconstrained(names, {"mu": system.initial[0], "sigma": system.initial[1]})
        run = settle(search, minimise(search, theta, np.ones(1), Trace()))
        point = names.constrained(run.theta[None])
        mu, sigma = float(point["mu"][0]), float(point["sigma"][0])
        fits[method] = [mu, sigma, len(run.trace.values), float(run.result.converged)]
    return fits


def collect(rows: list[Any], system: str, method: str) -> Any:
    """Return errors of mu and sigma in per cent, evaluations, and whether each fit failed, by row."""
    array, truth = np.array([row[method] for row in rows]), np.array(SYSTEMS[system].truth)
    errors = 100 * np.abs(array[:, :2] / truth - 1)
    failed = (array[:, 3] == 0) | (errors > 50).any(axis=1)
    return np.column_stack([errors, array[:, 2], failed])


CELLS = ["/".join(map(str, case)) for case in product(POINTS, SYSTEMS, SIZES, METRICS)]
STUDY = Study("paper_case1", __doc__, CELLS, row, 20)

if __name__ == "__main__":
    STUDY.main()
