"""Case study 1 of the paper: accuracy and number of evaluations of four metrics on four system functions.

Monte Carlo: one million points with random numbers that are the same for all hyperparameters, as in
the paper. Sobol: 4096 points beside them. Each data set of N observations is fitted from the same
start by Nelder-Mead at three x tolerances, in units of the priors' spread, and by BFGS. An
evaluation of BFGS is one of value and gradient; here the gradient is by central differences, and
counts as one, as it does where the response accepts PyTensor variables. A fit has failed if the
optimiser says so, or if mean or standard deviation are off by more than half.

One process; every fit is kept as it is made, so that a run can be stopped and started again.

    uv run python -m benchmarks.paper_case1 [--seeds 20] [--mc-seeds 20]
"""

from __future__ import annotations

import argparse
import json
import logging
import time
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

import prbayes as prb
from benchmarks import record
from benchmarks.systems import METRICS, SYSTEMS
from prbayes.optimize.convergence import Search, Trace, minimise, settle
from prbayes.optimize.objective import Method

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
            known.update(
                zip((thetas[i].tobytes() for i in new), total(thetas[new], scales), strict=True)
            )
        return np.array([known[t.tobytes()] for t in thetas])

    return function


def fits(
    evaluator: Any, scale: Any, initial: Any, observed: Any, metric: str
) -> dict[str, list[float]]:
    """Return mu, sigma, evaluations and whether it converged, by method."""
    ev = evaluator.observing({"y": observed}, METRICS[metric])
    ev.total = remembered(ev.total)
    out = {}
    for name, method in METHODS.items():
        search = Search(ev, scale, method, prior=False, tolerance=1e-6, max_evaluations=2000)
        theta = ev.unconstrained({"mu": initial[0], "sigma": initial[1]})
        run = minimise(search, theta, np.ones(1), Trace())
        walked = len(run.trace.values)
        run = settle(search, run)
        point = ev.constrained(run.theta[None])
        out[name] = [
            float(point["mu"][0]),
            float(point["sigma"][0]),
            len(run.trace.values),
            float(run.result.converged),
        ]
        out[name].append(walked)
    return out


def work(arguments: argparse.Namespace) -> dict[str, Any]:
    """Fit what is not fitted yet."""
    done: dict[str, Any] = record.load(arguments.out, {"fits": {}})["fits"]
    clock = saved = time.perf_counter()
    for points, propagation in POINTS.items():
        if points not in arguments.points:
            continue
        evaluators = {name: system.evaluator(propagation) for name, system in SYSTEMS.items()}
        seeds = range(arguments.seeds if points == "sobol" else arguments.mc_seeds)
        for seed in seeds:  # outermost, in case the run is not finished
            for n, (index, (name, system)) in product(SIZES, enumerate(SYSTEMS.items())):
                observed = system.data(np.random.default_rng([seed, n, index]), n)
                scale = evaluators[name].hyperparameters.prior_sd
                for metric in METRICS:
                    key = f"{points}/{name}/{n}/{seed}/{metric}"
                    if key in done:
                        continue
                    done[key] = fits(evaluators[name], scale, system.initial, observed, metric)
                    if time.perf_counter() - saved > 20:
                        saved = save(arguments.out, done)
            print(f"{points}: seed {seed}, {time.perf_counter() - clock:.0f} s", flush=True)
    save(arguments.out, done)
    return done


def save(path: Path, done: dict[str, Any]) -> float:
    """Write what there is, and return the time."""
    rows = ",\n".join(
        f"{json.dumps(key)}: {json.dumps({m: [float(f'{v:.7g}') for v in row] for m, row in value.items()})}"
        for key, value in done.items()
    )
    part = path.with_suffix(".part")
    run = json.dumps(record.about(), indent=1)
    part.write_text(f'{{"run": {run},\n"found": {{"fits": {{\n{rows}\n}}}}}}\n')
    part.replace(path)
    return time.perf_counter()


def collect(done: dict[str, Any], points: str, name: str, n: int, metric: str, method: str) -> Any:
    """Return errors of mu and sigma in per cent, evaluations, and whether each fit failed, one row per seed."""
    rows = [
        value[method]
        for key, value in done.items()
        if (parts := key.split("/"))[:3] == [points, name, str(n)] and parts[4] == metric
    ]
    if not rows:
        return None
    array, truth = np.array(rows), np.array(SYSTEMS[name].truth)
    errors = 100 * np.abs(array[:, :2] / truth - 1)
    failed = (array[:, 3] == 0) | (errors > 50).any(axis=1)
    return np.column_stack([errors, array[:, 2], failed, array[:, 4]])


def tables(done: dict[str, Any]) -> None:
    """Print medians over the data sets."""
    for points in POINTS:
        print(
            f"\n{points}: median error of mean / sd in %, BFGS; failures over all seeds in brackets"
        )
        print(f"{'system':12s} {'N':>7s} " + " ".join(f"{m:>22s}" for m in METRICS))
        for name in SYSTEMS:
            for n in SIZES:
                found = [collect(done, points, name, n, m, "BFGS") for m in METRICS]
                if any(f is None for f in found):
                    continue
                cells = [
                    f"{np.median(f[:, 0]):.2f} / {np.median(f[:, 1]):.2f} ({int(f[:, 3].sum())})"
                    for f in found
                ]
                print(
                    f"{name:12s} {n:7d} "
                    + " ".join(f"{c:>22s}" for c in cells)
                    + f"   of {len(found[0])}"
                )
        print(f"\n{points}: evaluations, median over all N and seeds")
        print(f"{'system':12s} {'method':8s} " + " ".join(f"{m:>16s}" for m in METRICS))
        for name in SYSTEMS:
            for method in METHODS:
                found = [
                    [collect(done, points, name, n, m, method) for n in SIZES] for m in METRICS
                ]
                found = [[f for f in fs if f is not None] for fs in found]
                if not all(found):
                    continue
                every = [np.concatenate(fs) for fs in found]
                cells = [f"{np.median(f[:, 2]):.0f} ({int(f[:, 3].sum())} failed)" for f in every]
                print(f"{name:12s} {method:8s} " + " ".join(f"{c:>16s}" for c in cells))
    print(
        "\nPR, BFGS: largest difference of mean and sd between the points, over data sets: median, maximum in %"
    )
    for name, n in product(SYSTEMS, SIZES):
        both = [
            [done[f"{points}/{rest}"]["BFGS"][:2] for points in POINTS]
            for key in done
            if (rest := key.removeprefix("monte carlo/")).startswith(f"{name}/{n}/")
            and rest.endswith("/PR")
        ]
        if both:
            apart = [100 * np.max(np.abs(np.divide(*pair) - 1)) for pair in both]
            print(
                f"{name:12s} {n:7d} {np.median(apart):8.3f} {np.max(apart):8.2f}   of {len(apart)}"
            )


def main() -> None:
    """Fit, print tables, write JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--mc-seeds", type=int, default=20)
    parser.add_argument("--points", nargs="*", default=list(POINTS))
    parser.add_argument(
        "--tables", action="store_true", help="print the tables of what there is, fit nothing"
    )
    parser.add_argument("--out", type=Path, default=record.RESULTS / "paper_case1.json")
    arguments = parser.parse_args()
    logging.getLogger("prbayes").setLevel(logging.ERROR)
    tables(record.load(arguments.out, None)["fits"] if arguments.tables else work(arguments))


if __name__ == "__main__":
    main()
