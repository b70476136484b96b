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

import argparse
import logging
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

import prbayes as prb
from benchmarks import record
from benchmarks.systems import METRICS, SYSTEMS
from prbayes.optimize.convergence import Search, Trace, approach, minimise, settle
from prbayes.optimize.objective import Method

SIZE = 1000
REACH = {
    "linear": (-12.0, 12.0),
    "nonlinear A": (-12.0, 8.0),
}  # of mu, in standard deviations from the truth
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


def shares(values: Any, name: str) -> tuple[float, float, Any]:
    """Return the shares of the grid with a definite Hessian and with a vanishing gradient, and where the first is."""
    a, b = grid(name, NODES)
    ga, gb = np.gradient(values, a, b)
    gaa, gab = np.gradient(ga, a, b)
    gbb = np.gradient(gb, b, axis=1)
    convex = (gaa > 0) & (gaa * gbb - gab**2 > 0)
    size = np.hypot(ga, gb)
    return float(convex.mean()), float((size < 1e-3 * np.nanmax(size)).mean()), convex


def basins(evaluator: Any, name: str, metric: str, *, guided: bool) -> tuple[Any, float]:
    """Return where each start leads, and the median number of evaluations of those that arrive."""
    mu, sigma = SYSTEMS[name].truth
    labels, counts = [], []
    for theta in thetas(name, STARTS):
        search = Search(
            evaluator,
            np.array([sigma, 1.0]),
            Method("BFGS"),
            prior=False,
            tolerance=1e-5,
            max_evaluations=500,
        )
        start, trace = theta, Trace()
        if guided:
            start, trace = approach(search, theta, np.ones(1), 0, trace)
        run = settle(search, minimise(search, start, np.ones(1), trace))
        at, spread = run.theta[0], np.exp(run.theta[1])
        close = 0.5 < spread / sigma < 2
        mirror = MIRROR[name]
        if close and abs(at - mu) < sigma:
            labels.append("true")
        elif close and mirror is not None and abs(at - mirror) < sigma:
            labels.append("mirror")
        else:
            labels.append("elsewhere")
        if labels[-1] != "elsewhere":
            counts.append(len(run.trace.values))
    return np.array(labels), float(np.median(counts)) if counts else np.nan


def main() -> None:
    """Compute, draw, print, write JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=record.RESULTS / "landscapes.json")
    parser.add_argument("--images", type=Path, default=Path("docs/images"))
    arguments = parser.parse_args()
    logging.getLogger("prbayes").setLevel(logging.ERROR)
    out: dict[str, Any] = {}
    print(f"{'system':12s} {'metric':15s} {'convex':>7s} {'flat':>7s} {'arrive':>7s} {'evaluations':>12s} "
          f"{'guided':>7s} {'evaluations':>12s}")  # fmt: skip
    for name, system in SYSTEMS.items():
        if name not in REACH:
            continue
        base = system.evaluator(prb.Resimulated(4096))
        observed = system.data(np.random.default_rng(0), SIZE)
        figure, axes = plt.subplots(
            2, 2, figsize=(11, 8), layout="constrained", sharex=True, sharey=True
        )
        for axis, (metric, configured) in zip(axes.ravel(), METRICS.items(), strict=True):
            evaluator = base.observing({"y": observed}, configured)
            values = evaluator(thetas(name, NODES)).discrepancies[:, 0].reshape(NODES)
            convex, flat, where = shares(values, name)
            free, count = basins(evaluator, name, metric, guided=False)
            led, led_count = basins(evaluator, name, metric, guided=True)
            arrive, arrive_led = (
                float((free != "elsewhere").mean()),
                float((led != "elsewhere").mean()),
            )
            out[f"{name}/{metric}"] = {
                "convex": convex, "flat": flat, "arrive": arrive, "evaluations": count,
                "arrive_guided": arrive_led, "evaluations_guided": led_count,
            }  # fmt: skip
            print(f"{name:12s} {metric:15s} {convex:7.1%} {flat:7.1%} {arrive:7.1%} {count:12.0f} {arrive_led:7.1%} "
                  f"{led_count:12.0f}", flush=True)  # fmt: skip
            a, b = grid(name, NODES)
            shade = axis.contourf(a, b, values.T, 24, cmap="Greys_r")
            figure.colorbar(shade, ax=axis, shrink=0.8)
            axis.contourf(a, b, where.T.astype(float), [0.5, 1.5], colors=["#F0E442"], alpha=0.45)
            starts = thetas(name, STARTS)
            mu, sigma = system.truth
            for label, color in COLORS.items():
                here = free == label
                if here.any():
                    axis.plot((starts[here, 0] - mu) / sigma, starts[here, 1] - np.log(sigma), "o", ms=4.5, color=color,
                              mec="white", mew=0.4, label=f"start that leads to: {label}")  # fmt: skip
            axis.plot(0, 0, "w*", ms=14, mec="k")
            axis.set_title(f"{metric}: Hessian positive definite (yellow) on {convex:.0%};\n{arrive:.0%} of starts arrive, "
                           f"{arrive_led:.0%} with the area metric as guide", fontsize=10)  # fmt: skip
        for axis in axes[-1]:
            axis.set_xlabel("mu, standard deviations from the truth")
        for axis in axes[:, 0]:
            axis.set_ylabel("log(sigma / true sigma)")
        handles, labels = axes[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False)
        arguments.images.mkdir(parents=True, exist_ok=True)
        figure.savefig(arguments.images / f"landscape_{name.replace(' ', '_')}.png", dpi=110)
    record.save(arguments.out, out)


if __name__ == "__main__":
    main()
