"""Errors and seconds of the package's Gaussian processes beside those of libraries.

The responses are those of `benchmarks.responses` with several inputs. The runs are Sobol points of a
population twice as wide as the true one. Every emulator is fitted to the same runs, with inputs and
outputs in standard deviations, and predicts points of the population:

- error: root mean square over the population and the outputs, in standard deviations of each output;
- seconds: to fit, to predict and to leave out blocks of an eighth, on one processor.

    OMP_NUM_THREADS=1 uv run python -m benchmarks.emulators
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from scipy.interpolate import RBFInterpolator
from scipy.special import ndtri
from scipy.stats import qmc

from benchmarks import record
from benchmarks.responses import RESPONSES, Response
from prbayes.surrogate import GaussianProcess

OUT = record.RESULTS / "emulators.json"
SIZES = (128, 256)
SEEDS = (0, 1)
POINTS = 16_384
BLOCKS = 8
FLOOR = 1e-3  # of errors that are compared: 16 384 points alone err by .03 or more

Predict = Callable[[Any], Any]


def populations(response: Response, n: int, seed: int, wider: float = 1.0) -> Any:
    """Return n Sobol points of the population, (n, d), ``wider`` times as wide."""
    u = qmc.Sobol(response.d, seed=seed).random(n)
    return response.mean + wider * response.sd * ndtri(np.clip(u, 1e-6, 1 - 1e-6))


# -- emulators of one output: fit(x, y) -> (predict, the same hyperparameters for other runs) ------


def quintic(x: Any, y: Any) -> tuple[Predict, Any]:
    """Return SciPy's quintic splines with a quadratic polynomial."""
    return RBFInterpolator(x, y, kernel="quintic", degree=2), quintic


def own(kernel: str, x: Any, y: Any) -> tuple[Predict, Any]:
    """Return the package's Gaussian process."""
    surface = GaussianProcess(kernel).tuned(x, y)
    return surface.through(x, y), lambda x, y: (surface.through(x, y), None)


def scikit_learn(smoothness: float, x: Any, y: Any) -> tuple[Predict, Any]:
    """Return scikit-learn's Gaussian process; infinite smoothness is the squared exponential."""
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.gaussian_process import GaussianProcessRegressor, kernels

    shape = kernels.Matern(np.ones(x.shape[1]), (1e-2, 1e4), nu=smoothness)
    noisy = kernels.ConstantKernel(10.0, (1e-2, 1e4)) * shape + kernels.WhiteKernel(
        1e-4, (1e-8, 1.0)
    )
    process = GaussianProcessRegressor(noisy, normalize_y=True, random_state=0)
    with warnings.catch_warnings():
        # Hyperparameters at their bounds: irrelevant inputs, no noise.
        warnings.simplefilter("ignore", ConvergenceWarning)
        process.fit(x, y)

    def again(x: Any, y: Any) -> tuple[Predict, Any]:
        same = GaussianProcessRegressor(process.kernel_, normalize_y=True, optimizer=None)
        return same.fit(x, y).predict, None

    return process.predict, again


EMULATORS: dict[str, Callable[[Any, Any], tuple[Predict, Any]]] = {
    "SciPy, quintic splines": quintic,
    "scikit-learn, squared exponential": partial(scikit_learn, np.inf),
    "scikit-learn, Matérn 5/2": partial(scikit_learn, 2.5),
    "prbayes, squared exponential": partial(own, "squared_exponential"),
    "prbayes, Matérn 5/2": partial(own, "matern"),
}


def cell(response: Response, n: int, seed: int) -> dict[str, dict[str, float]]:
    """Return the error and the seconds of each emulator from the same runs."""
    x, points = populations(response, n, seed, 2.0), populations(response, POINTS, 99)
    y, truth = response(x), response(points)
    x, y = (a[np.isfinite(y).all(axis=1)] for a in (x, y))
    points, truth = (a[np.isfinite(truth).all(axis=1)] for a in (points, truth))
    center, scale, unit = x.mean(axis=0), x.std(axis=0), truth.std(axis=0)
    z, at = (x - center) / scale, (points - center) / scale
    blocks = np.array_split(np.arange(len(z)), BLOCKS)
    rows = {}
    for name, fit in EMULATORS.items():
        clock, errors = time.process_time(), []
        for column, exact, sd in zip(y.T, truth.T, unit, strict=True):
            mean, spread = column.mean(), column.std()
            values = (column - mean) / spread
            predict, again = fit(z, values)
            errors.append((mean + spread * predict(at) - exact) / sd)
            for block in blocks:
                left = np.setdiff1d(np.arange(len(z)), block)
                again(z[left], values[left])[0](z[block])
        seconds = time.process_time() - clock
        rows[name] = {"error": float(np.sqrt(np.mean(np.square(errors)))), "seconds": seconds}
    return rows


def main() -> None:
    """Run all cells; write errors over those of the best emulator of each cell, and seconds."""
    ratios: dict[str, dict[bool, list[float]]] = {name: {True: [], False: []} for name in EMULATORS}
    seconds: dict[str, list[float]] = {name: [] for name in EMULATORS}
    for response in RESPONSES.values():
        for n in SIZES if response.d > 1 else ():
            for seed in SEEDS:
                rows = cell(response, n, seed)
                errors = {name: max(row["error"], FLOOR) for name, row in rows.items()}
                for name, row in rows.items():
                    ratios[name][response.smooth].append(errors[name] / min(errors.values()))
                    if n == max(SIZES):
                        seconds[name].append(row["seconds"])
                print(response.name, n, seed, rows, flush=True)
    table = {
        name: {
            "smooth": [float(np.exp(np.mean(np.log(both[True])))), max(both[True])],
            "not smooth": [float(np.exp(np.mean(np.log(both[False])))), max(both[False])],
            "seconds": float(np.median(seconds[name])),
        }
        for name, both in ratios.items()
    }
    record.save(OUT, table, (*record.PACKAGES, "scikit-learn"))


if __name__ == "__main__":
    main()
