"""Nelder-Mead on the probability residual, as its paper does it, written by hand.

The squared residual of two densities is integrated (eq. 9), both by Gaussian kernels with
Silverman's bandwidth, and multiplied by the scale factor (eq. 10, C = 100). Responses are those of
Monte Carlo points with random numbers that are the same for all hyperparameters; the start is the
prior's median, and the parameters are in units of the prior's spread. Of several outputs the
residuals are added, which the paper does not do. One number each, no width.

    uv run python -m benchmarks.scoreboard.rivals.nelder_mead
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.optimize import minimize
from scipy.signal import fftconvolve

from benchmarks.scoreboard.problem import Draws, capped
from benchmarks.scoreboard.study import Rival, Task, main

_CELLS = 512  # of the axis of the densities
_OUTSIDE = 1e3  # for values that the prior excludes: above any residual on these problems


def density(values: Any, edges: Any) -> Any:
    """Return a Gaussian kernel density at the middles of cells, by binning and convolution."""
    n, width = len(values), edges[1] - edges[0]
    quartiles = np.quantile(values, [0.25, 0.75])
    spread = min(values.std(ddof=1), (quartiles[1] - quartiles[0]) / 1.349)
    bandwidth = max(0.9 * spread * n**-0.2, width)
    # A share beyond the edges is lost, as it is from the integral.
    counts = np.histogram(values, edges)[0] / (n * width)
    reach = np.arange(-(_CELLS - 1), _CELLS) * width
    kernel = np.exp(-((reach / bandwidth) ** 2) / 2)
    whole = fftconvolve(counts, kernel / kernel.sum())
    return whole[_CELLS - 1 : 2 * _CELLS - 1]


class _Side:
    """The measured side of an output."""

    def __init__(self, y: Any, C: float) -> None:
        around = 0.5 * np.ptp(y)
        self.edges = np.linspace(y.min() - around, y.max() + around, _CELLS + 1)
        self.density = density(y, self.edges)
        self.scale = C ** -np.floor(np.log10(self.density.max()))

    def residual(self, y: Any) -> float:
        """Return the scaled residual of simulated responses."""
        edges = self.edges
        simulated = density(np.clip(y, edges[0] - 1, edges[-1] + 1), edges)
        return float(self.scale * ((simulated - self.density) ** 2).sum() * (edges[1] - edges[0]))


def calibrate(task: Task, settings: dict[str, Any]) -> Draws:
    """Return the optimum."""
    problem, y = task.problem, task.observed.reshape(len(task.observed), -1)
    rng = np.random.default_rng(task.seed)
    z = rng.standard_normal((settings["points"], len(problem.inputs)))
    priors = {name: p.distribution() for name, p in problem.priors.items()}
    start = np.array([float(p.median()) for p in priors.values()])
    unit = np.array([float(p.std()) for p in priors.values()])
    sides = [_Side(values, settings["C"]) for values in y.T]

    def objective(t: Any) -> float:
        values = dict(zip(priors, start + unit * t, strict=True))
        if not np.isfinite(problem.log_prior(values)):
            return _OUTSIDE
        found = capped(task.response(*problem.population(values, z)).reshape(len(z), -1), y)
        return sum(side.residual(output) for side, output in zip(sides, found.T, strict=True))

    simplex = settings["step"] * np.vstack([np.zeros(len(start)), np.eye(len(start))])
    options = {"xatol": settings["xatol"], "fatol": settings["fatol"], "initial_simplex": simplex}
    best = minimize(objective, np.zeros(len(start)), method="Nelder-Mead", options=options)
    if not best.success:
        raise RuntimeError(str(best.message))
    return dict(zip(priors, start + unit * best.x, strict=True))


SETTINGS = {"points": 100_000, "C": 100.0, "step": 0.5, "xatol": 1e-3, "fatol": 1e-4}
RIVALS = (Rival("Nelder-Mead PR", ("numpy", "scipy"), SETTINGS, calibrate),)

if __name__ == "__main__":
    main(RIVALS)
