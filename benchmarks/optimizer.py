"""What the optimiser costs: one evaluation, evaluations to the optimum, time against a plain script, Sobol points.

1. One evaluation of the probability residual at 1e6 responses, over the propagation itself: new
draws or fixed
   standard normal numbers mapped to x, and the response.
2. Evaluations (of value and gradient) to the optimum by `prb.minimize`, from the initial values of
the case study. 3. Time to the optimum, compilation included and import excluded, against
`scipy.stats.gaussian_kde` with
   `scipy.optimize.minimize(method="Nelder-Mead")` as one would write them down; and the error of
   either by its finite number of simulated responses: the spread of the optimum over random seeds,
   in standard errors.
4. The error of 4096 Sobol points against that of one million random points, likewise.

All ratios are of times in one run, on one core.

    uv run python -m benchmarks.optimizer [--repeats 5]
"""

from __future__ import annotations

import argparse
import logging
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm

import prbayes as prb
from benchmarks import record
from benchmarks.systems import METRICS, SYSTEMS, System
from prbayes.model.evaluator import Evaluator

MILLION = 1_000_000
SIZE = 1000
SMOOTH = ("linear", "nonlinear A", "nonlinear B")


def best_time(function: Callable[[], Any], repeats: int) -> float:
    """Return the shortest of several times, in seconds."""
    times = []
    for _ in range(repeats):
        clock = time.perf_counter()
        function()
        times.append(time.perf_counter() - clock)
    return min(times)


def smooth_model(system: System, metric: prb.Metric, observed: Any, propagation: Any) -> pm.Model:
    """Return the model without the coin, which the smooth systems have no use for."""
    with pm.Model() as model:
        mu, sigma = (
            pm.Normal("mu", system.initial[0], system.spread[0]),
            pm.HalfNormal("sigma", system.spread[1]),
        )
        x = pm.Normal.dist(mu, sigma)
        prb.Simulator("y", lambda x: system.response(x, None), x, metric=metric, observed=observed,
                      propagation=propagation)  # fmt: skip
    return model


def observed(name: str) -> Any:
    """Return the data of one system."""
    return SYSTEMS[name].data(np.random.default_rng(0), SIZE)


def evaluation(repeats: int) -> dict[str, Any]:
    """Time one evaluation at a million responses."""
    rng, out = np.random.default_rng(1), {}
    z = rng.standard_normal(MILLION)
    print(f"{'':12s} {'draw':>7s} {'map':>7s} {'response':>9s} {'metric':>7s} {'objective':>10s} {'+ gradient':>11s} "
          f"{'metric/(draw+r)':>16s} {'metric/(map+r)':>15s}   (ms)")  # fmt: skip
    for name in SMOOTH:
        system, data = SYSTEMS[name], observed(name)
        mu, sigma = system.truth
        x = mu + sigma * z
        y = system.response(x, None)
        target = METRICS["PR"].against(data)
        weights = np.broadcast_to(1 / MILLION, MILLION)
        ev = Evaluator.of(smooth_model(system, METRICS["PR"], data, prb.Resimulated(MILLION)))
        theta = ev.hyperparameters.unconstrained({"mu": mu, "sigma": sigma})
        value, gradient = (ev.objective(prior=False, gradient=g) for g in (False, True))
        row = {
            "draw": best_time(lambda mu=mu, sigma=sigma: rng.normal(mu, sigma, MILLION), repeats),
            "map": best_time(lambda mu=mu, sigma=sigma: mu + sigma * z, repeats),
            "response": best_time(lambda x=x, system=system: system.response(x, None), repeats),
            "metric": best_time(
                lambda target=target, y=y, weights=weights: target.of(y, weights), repeats
            ),
            "objective": best_time(
                lambda value=value, theta=theta: value(theta, np.ones(1)), repeats
            ),
            "with_gradient": best_time(
                lambda gradient=gradient, theta=theta: gradient(theta, np.ones(1)), repeats
            ),
        }
        row["over_draw"] = row["metric"] / (row["draw"] + row["response"])
        row["over_map"] = row["metric"] / (row["map"] + row["response"])
        out[name] = row
        print(f"{name:12s} {1e3 * row['draw']:7.1f} {1e3 * row['map']:7.1f} {1e3 * row['response']:9.1f} "
              f"{1e3 * row['metric']:7.1f} {1e3 * row['objective']:10.1f} {1e3 * row['with_gradient']:11.1f} "
              f"{row['over_draw']:16.2f} {row['over_map']:15.2f}", flush=True)  # fmt: skip
    return out


def evaluations() -> dict[str, Any]:
    """Count evaluations to the optimum."""
    out: dict[str, Any] = {}
    print(f"\nevaluations to the optimum, N = {SIZE}, 4096 Sobol points\n{'':12s} "
          + " ".join(f"{m:>15s}" for m in METRICS))  # fmt: skip
    for name in SMOOTH:
        start = dict(zip(("mu", "sigma"), SYSTEMS[name].initial, strict=True))
        out[name] = {}
        for metric, configured in METRICS.items():
            model = smooth_model(SYSTEMS[name], configured, observed(name), prb.Resimulated(4096))
            optimum = prb.minimize(model, start=start)
            assert optimum.converged
            out[name][metric] = optimum.search.n_evaluations
        print(f"{name:12s} " + " ".join(f"{n:15d}" for n in out[name].values()), flush=True)
    return out


def plain_script(
    data: Any, n: int, seed: int, *, evaluations: int | None = None
) -> tuple[Any, int, float]:
    """Calibrate the linear system as one would write it down: mu and sigma, evaluations, seconds."""
    from scipy.optimize import minimize
    from scipy.stats import gaussian_kde

    clock = time.perf_counter()
    z = np.random.default_rng(seed).standard_normal(n)
    grid = np.linspace(data.min() - data.std(), data.max() + data.std(), 200)
    q = gaussian_kde(data)(grid)

    def residual(p: Any) -> float:
        mu, sigma = p
        if sigma <= 0:
            return np.inf
        density = gaussian_kde(0.75 * (mu + sigma * z))(grid)
        return float(np.trapezoid((density - q) ** 2, grid))

    if evaluations is not None:
        for _ in range(evaluations):
            residual(SYSTEMS["linear"].initial)
        return None, evaluations, time.perf_counter() - clock
    found = minimize(residual, SYSTEMS["linear"].initial, method="Nelder-Mead")
    return found.x, found.nfev, time.perf_counter() - clock


def against_plain(repeats: int) -> dict[str, Any]:
    """Compare times and errors by the finite number of responses."""
    data, system = observed("linear"), SYSTEMS["linear"]
    start = dict(zip(("mu", "sigma"), system.initial, strict=True))
    found, times = [], []
    for seed in range(repeats):
        clock = time.perf_counter()
        model = smooth_model(system, METRICS["PR"], data, prb.Resimulated(4096, random_seed=seed))
        optimum = prb.minimize(model, start=start)
        times.append(time.perf_counter() - clock)
        found.append([optimum.point["mu"], optimum.point["sigma"]])
    errors = np.array([optimum.stderr["mu"], optimum.stderr["sigma"]])
    ours = {
        "seconds": float(np.median(times)),
        "error": float((np.std(found, axis=0, ddof=1) / errors).max()),
    }
    print(
        f"\n{'linear, PR':42s} {'seconds':>9s} {'evaluations':>12s} {'error, standard errors':>23s}"
    )
    print(f"{'prb.minimize, 4096 Sobol points':42s} {ours['seconds']:9.2f} {optimum.search.n_evaluations:12d} "
          f"{ours['error']:23.4f}", flush=True)  # fmt: skip
    out: dict[str, Any] = {"prbayes": ours}
    for n in (1000, 10_000):
        runs = [plain_script(data, n, seed) for seed in range(repeats)]
        spread = np.std([r[0] for r in runs], axis=0, ddof=1) / errors
        row = {
            "seconds": float(np.median([r[2] for r in runs])),
            "evaluations": int(np.median([r[1] for r in runs])),
            "error": float(spread.max()),
        }
        out[f"plain {n}"] = row
        print(f"{f'gaussian_kde + Nelder-Mead, {n} random':42s} {row['seconds']:9.2f} {row['evaluations']:12d} "
              f"{row['error']:23.4f}", flush=True)  # fmt: skip
    per_evaluation = plain_script(data, MILLION, 0, evaluations=1)[2]
    count = out["plain 10000"]["evaluations"]
    out["plain 1000000"] = {
        "seconds": per_evaluation * count,
        "evaluations": count,
        "error": out["plain 10000"]["error"] / 10,
    }
    print(f"{'the same, 1000000 random':42s} {per_evaluation * count:9.0f} {count:12d} "
          f"{out['plain 1000000']['error']:23.4f}   (one evaluation timed; error by 1/sqrt(n))")  # fmt: skip
    needed = 10_000 * (out["plain 10000"]["error"] / ours["error"]) ** 2
    out["equal_accuracy"] = {
        "points": needed,
        "ratio": per_evaluation * count * needed / MILLION / ours["seconds"],
    }
    print(
        f"the script's error equals ours with {needed:.2g} points: {out['equal_accuracy']['ratio']:.0f} times our time"
    )
    return out


def sobol_accuracy(repeats: int) -> dict[str, Any]:
    """Compare the errors of the optimum by 4096 Sobol points and by a million random ones."""
    out: dict[str, Any] = {}
    print(
        f"\nspread of the optimum over {repeats} seeds, in standard errors for N = {SIZE}, mean / sd"
    )
    for name in SMOOTH:
        system, row = SYSTEMS[name], {}
        start = dict(zip(("mu", "sigma"), system.truth, strict=True))
        for label, n, points in (
            ("sobol 4096", 4096, "sobol"),
            ("random 1e6", MILLION, "monte_carlo"),
        ):
            found = []
            for seed in range(repeats):
                propagation = prb.Resimulated(n, random_seed=seed, points=points)
                optimum = prb.minimize(
                    smooth_model(system, METRICS["PR"], observed(name), propagation), start=start
                )
                found.append([optimum.point["mu"], optimum.point["sigma"]])
            errors = [optimum.stderr["mu"], optimum.stderr["sigma"]]
            row[label] = (np.std(found, axis=0, ddof=1) / errors).tolist()
        out[name] = row
        print(
            f"{name:12s} " + "   ".join(f"{k}: {v[0]:.4f} / {v[1]:.4f}" for k, v in row.items()),
            flush=True,
        )
    return out


def main() -> None:
    """Measure, print, write JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--out", type=Path, default=record.RESULTS / "optimizer.json")
    arguments = parser.parse_args()
    logging.getLogger("prbayes").setLevel(logging.ERROR)
    out = {
        "evaluation": evaluation(3 * arguments.repeats),
        "evaluations": evaluations(),
        "against_plain": against_plain(arguments.repeats),
        "sobol": sobol_accuracy(arguments.repeats),
    }
    record.save(arguments.out, out)


if __name__ == "__main__":
    main()
