"""Landscapes of the four metrics over (mu, log sigma), where they are convex, and basins of attraction.

Convexity: the probability residual is a quadratic form of the simulated density, so convex in it;
as a function of the hyperparameters it is not. On a grid over (mu, log sigma), in standard
deviations of the true population: the share where the Hessian is positive definite, the share where
the gradient is below a thousandth of its largest, and the share of starts from which BFGS with
exact derivatives reaches an optimum (the true one or its mirror image), followed as they are and
with the area metric as a guide where densities do not overlap.

    uv run python -m benchmarks.landscapes
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

import prbayes as prb
from benchmarks.metrics import METRICS
from benchmarks.study import Study
from benchmarks.systems import SYSTEMS
from prbayes.optimize.convergence import Search, Trace, approach, minimise, settle
from prbayes.optimize.objective import Minimisation

IMAGES = Path("docs/images")
SIZE = 1000
# Of mu, in standard deviations from the truth.
REACH = {"linear": (-12.0, 12.0), "nonlinear A": (-12.0, 8.0)}
MIRROR = {"linear": None, "nonlinear A": 0.0}  # mu of the mirror solution
LOGS = (-2.5, 2.5)  # of log(sigma / true sigma)
NODES = (97, 81)
STARTS = (17, 11)
COLORS = {"true": "#0072B2", "mirror": "#009E73", "elsewhere": "#D55E00"}


def grid(name: str, shape: tuple[int, int]) -> tuple[Any, Any]:
    """Return standard deviations of mu from the truth and logs of the relative sigma."""
    return np.linspace(*REACH[name], shape[0]), np.linspace(*LOGS, shape[1])


def thetas(name: str, shape: tuple[int, int]) -> Any:
    """Return the grid's thetas, row by row."""
    mu, sigma = SYSTEMS[name].truth
    a, b = np.meshgrid(*grid(name, shape), indexing="ij")
    return np.column_stack([(mu + sigma * a).ravel(), np.log(sigma) + b.ravel()])


def shares(values: Any, name: str) -> tuple[Any, float]:
    """Return where the Hessian is definite, and the share of the grid with a vanishing gradient."""
    a, b = grid(name, NODES)
    ga, gb = np.gradient(values, a, b)
    gaa, gab = np.gradient(ga, a, b)
    gbb = np.gradient(gb, b, axis=1)
    size = np.hypot(ga, gb)
    is_convex = (gaa > 0) & (gaa * gbb - gab**2 > 0)
    return is_convex, float((size < 1e-3 * np.nanmax(size)).mean())


def basins(evaluator: Any, name: str, *, guided: bool) -> tuple[Any, float]:
    """Return where each start leads, and the median number of evaluations of those that arrive."""
    mu, sigma = SYSTEMS[name].truth
    labels, counts = [], []
    for theta in thetas(name, STARTS):
        settings = Minimisation(tolerance=1e-5, max_evaluations=500)
        search = Search(evaluator, np.array([sigma, 1.0]), settings)
        start, trace = theta, Trace()
        if guided:
            start, trace = approach(search, theta, np.ones(1), trace)
        run = settle(search, minimise(search, start, np.ones(1), trace))
        at, spread = run.theta[0], np.exp(run.theta[1])
        is_close = 0.5 < spread / sigma < 2
        mirror = MIRROR[name]
        label = "elsewhere"
        if is_close and abs(at - mu) < sigma:
            label = "true"
        elif is_close and mirror is not None and abs(at - mirror) < sigma:
            label = "mirror"
        labels.append(label)
        if label != "elsewhere":
            counts.append(len(run.trace.values))
    return np.array(labels), float(np.median(counts)) if counts else np.nan


def row(name: str, number: int) -> dict[str, Any]:
    """Return the figures of each metric, and draw the picture of a system."""
    base = SYSTEMS[name].evaluator(prb.Resimulated(4096))
    observed = SYSTEMS[name].data(np.random.default_rng(0), SIZE)
    figure, axes = plt.subplots(
        2, 2, figsize=(11, 8), layout="constrained", sharex=True, sharey=True
    )
    figures = {}
    for axis, (metric, configured) in zip(axes.ravel(), METRICS.items(), strict=True):
        evaluator = base.observing({"y": observed}, configured)
        values = evaluator(thetas(name, NODES)).discrepancies[:, 0].reshape(NODES)
        is_convex, flat = shares(values, name)
        free, count = basins(evaluator, name, guided=False)
        led, guided_count = basins(evaluator, name, guided=True)
        arrive, guided = (float((ends != "elsewhere").mean()) for ends in (free, led))
        convex = float(is_convex.mean())
        figures[metric] = {
            "convex": convex, "flat": flat, "arrive": arrive, "evaluations": count,
            "arrive_guided": guided, "evaluations_guided": guided_count,
        }  # fmt: skip
        panel(axis, name, values, is_convex, free)
        axis.set_title(f"{metric}: Hessian positive definite (yellow) on {convex:.0%};\n{arrive:.0%} of starts arrive, "
                       f"{guided:.0%} with the area metric as guide", fontsize=10)  # fmt: skip
    for axis in axes[-1]:
        axis.set_xlabel("mu, standard deviations from the truth")
    for axis in axes[:, 0]:
        axis.set_ylabel("log(sigma / true sigma)")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False)
    figure.savefig(IMAGES / f"landscape_{name.replace(' ', '_')}.png", dpi=110)
    return figures


def panel(axis: Any, name: str, values: Any, is_convex: Any, ends: Any) -> None:
    """Draw the landscape of a metric with its starts."""
    a, b = grid(name, NODES)
    shade = axis.contourf(a, b, values.T, 24, cmap="Greys_r")
    axis.figure.colorbar(shade, ax=axis, shrink=0.8)
    axis.contourf(a, b, is_convex.T.astype(float), [0.5, 1.5], colors=["#F0E442"], alpha=0.45)
    starts = thetas(name, STARTS)
    mu, sigma = SYSTEMS[name].truth
    for label, color in COLORS.items():
        chosen = starts[ends == label]
        if len(chosen):
            axis.plot((chosen[:, 0] - mu) / sigma, chosen[:, 1] - np.log(sigma), "o", ms=4.5, color=color,
                      mec="white", mew=0.4, label=f"start that leads to: {label}")  # fmt: skip
    axis.plot(0, 0, "w*", ms=14, mec="k")


STUDY = Study("landscapes", __doc__, REACH, row, 1)

if __name__ == "__main__":
    STUDY.main()
