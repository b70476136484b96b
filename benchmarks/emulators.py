"""Which library's emulator predicts a response best from few runs, and does it know how well it does?

The responses are those of `benchmarks.responses`. The runs are scrambled Sobol points through a
prior predictive mixture about 2.4 times wider than the population. Every emulator is fitted to the
same runs and predicts 16 384 points of the population:

- error: root mean square of the prediction over the population, in standard deviations of the
  response there;
- distribution: error of the population's distribution function, root mean square over 64 quantile
  levels, in units of the sampling noise of 50 data (beside it that of weights alone);
- cross-validated: the error at runs left out by blocks of an eighth, over the error at the
  population; hyperparameters of Gaussian processes stay those of all runs.

Seconds are those of one processor (set OMP_NUM_THREADS=1).

The chosen one ("auto") is that of a few with the lowest cross-validated error, output by output.
Where a response is not finite, the finite part is fitted and predicted. Every cell is stored as it
comes, so that an interrupted study goes on where it stopped. Libraries that are no dependency:

    uv run --with smt --with openturns python -m benchmarks.emulators
    uv run python -m benchmarks.emulators --only-table
"""

from __future__ import annotations

import argparse
import json
import re
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, partial
from importlib import metadata
from itertools import combinations_with_replacement
from math import comb
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import logsumexp, ndtr, ndtri
from scipy.stats import norm, qmc

from benchmarks import record
from benchmarks.responses import RESPONSES, Response
from prbayes.emulators.gaussian_process import (
    MOST_TUNED,
    Kernel,
    matern,
    mean_through,
    negative_log_likelihood,
    squared_exponential,
)

STORE = record.RESULTS / "emulators"
SIZES = (32, 64, 128, 256, 512, 1000)
SEEDS = (0, 1, 2)
LEVELS = (np.arange(64) + 0.5) / 64
POINTS = 16_384  # of the population: as many as a cloud has
DATA = 50  # whose sampling noise is the unit of an error of the distribution function
BLOCKS = 8
_COMPONENTS = 256  # of the mixture of populations that the runs are drawn from
_MEAN_WIDER, _LOG_SD = 2.0, 0.5  # populations: their means in sds of the true one; log of their sds

Predict = Callable[[Any], Any]


class TooFewError(Exception):
    """There are fewer runs than the emulator has terms."""


# -- the design ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Mixture:
    """Populations from the prior, whose mixture the runs are drawn from."""

    mean: Any  # (k, d)
    sd: Any

    @classmethod
    def around(cls, response: Response, k: int, seed: int) -> Mixture:
        """Draw k populations around the true one."""
        z = _normal_points(2 * response.d, k, seed)
        mean = response.mean + _MEAN_WIDER * response.sd * z[:, : response.d]
        return cls(mean, response.sd * np.exp(_LOG_SD * z[:, response.d :]))

    def draw(self, n: int, seed: int) -> Any:
        """Return n points of the mixture, (n, d)."""
        u = qmc.Sobol(self.mean.shape[1] + 1, seed=seed).random(n)
        k = np.minimum((u[:, 0] * len(self.mean)).astype(int), len(self.mean) - 1)
        return self.mean[k] + self.sd[k] * ndtri(np.clip(u[:, 1:], 1e-9, 1 - 1e-9))

    def log_density(self, x: Any) -> Any:
        """Return the log-density of points, (n,)."""
        each = norm.logpdf(x[:, None], self.mean, self.sd).sum(axis=-1)
        return logsumexp(each, axis=1) - np.log(len(self.mean))

    def scores(self, x: Any) -> Any:
        """Return normal scores of each input under the mixture, (n, d)."""
        parts = np.array_split(x, max(1, len(x) // 1024))
        share = [ndtr((part[:, None] - self.mean) / self.sd).mean(axis=1) for part in parts]
        return ndtri(np.clip(np.concatenate(share), 1e-12, 1 - 1e-12))


def _normal_points(d: int, n: int, seed: int) -> Any:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "The balance properties of Sobol")
        u = qmc.Sobol(d, seed=seed).random(n)
    return ndtri(np.clip(u, 1e-6, 1 - 1e-6))


@dataclass(frozen=True)
class Runs:
    """Runs of a response where it is finite, with weights of the true population."""

    x: Any  # (n, d)
    y: Any  # (n, m)
    weights: Any  # (n,), of sum 1
    mixture: Mixture


@cache
def runs_of(name: str, n: int, seed: int) -> Runs:
    """Return n runs, less those that are not finite."""
    response = RESPONSES[name]
    mixture = Mixture.around(response, min(n, _COMPONENTS), 1000 + seed)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "The balance properties of Sobol")
        x = mixture.draw(n, 2000 + seed)
    y = response(x)
    finite = np.isfinite(y).all(axis=1)
    x, y = x[finite], y[finite]
    log = norm.logpdf(x, response.mean, response.sd).sum(axis=1) - mixture.log_density(x)
    return Runs(x, y, np.exp(log - logsumexp(log)), mixture)


@cache
def population_of(name: str) -> tuple[Any, Any]:
    """Return points of the true population and their responses, where they are finite."""
    response = RESPONSES[name]
    x = response.mean + response.sd * _normal_points(response.d, POINTS, 5)
    y = response(x)
    finite = np.isfinite(y).all(axis=1)
    return x[finite], y[finite]


# -- scalings of inputs ----------------------------------------------------------------------------


def _box(runs: Runs) -> Predict:
    """Scale to the unit box of the runs."""
    low, high = runs.x.min(axis=0), runs.x.max(axis=0)
    return lambda x: (x - low) / (high - low)


def _sd(runs: Runs) -> Predict:
    """Scale by the standard deviation of the runs."""
    center, sd = runs.x.mean(axis=0), runs.x.std(axis=0)
    return lambda x: (x - center) / sd


def _scores(runs: Runs) -> Predict:
    """Replace by normal scores of the mixture."""
    return runs.mixture.scores


def _effect(power: float, runs: Runs) -> Predict:
    """Scale by the standard deviation, and by a power of the input's effect on the outputs.

    The effect is the root mean square slope of a quadratic polynomial, of a linear one where runs
    are too few.
    """
    standard = _sd(runs)
    x = standard(runs.x)
    degree = 2 if 2 * comb(x.shape[1] + 2, 2) <= len(x) else 1
    predict = _polynomial(degree, x, (runs.y - runs.y.mean(axis=0)) / runs.y.std(axis=0)).predict
    step = np.eye(x.shape[1]) * 0.01
    slopes = np.array([predict(x + by) - predict(x - by) for by in step])
    effect = np.sqrt((slopes**2).mean(axis=(1, 2)))
    factor = np.maximum(effect / effect.max(), 0.05) ** power
    return lambda at: standard(at) * factor


SCALINGS: dict[str, Callable[[Runs], Predict]] = {
    "sd": _sd,
    "box": _box,
    "scores": _scores,
    "effect": partial(_effect, 1.0),
    "root of effect": partial(_effect, 0.5),
}


# -- emulators -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Fitted:
    """An emulator of runs; `again` takes other runs with the same hyperparameters."""

    predict: Predict  # (k, d) -> (k, m)
    again: Callable[[Any, Any], Fitted]


def _each_output(fit: Callable[[Any, Any], Fitted], x: Any, y: Any) -> Fitted:
    """Fit every output by itself."""
    found = [fit(x, column) for column in y.T]

    def again(x: Any, y: Any) -> Fitted:
        each = [one.again(x, column) for one, column in zip(found, y.T, strict=True)]
        return Fitted(lambda at: np.stack([one.predict(at) for one in each], axis=-1), again)

    return Fitted(lambda at: np.stack([one.predict(at) for one in found], axis=-1), again)


def _enough(x: Any, degree: int) -> None:
    if len(x) < comb(x.shape[1] + degree, degree):
        raise TooFewError


def _degree(x: Any, lowest: int) -> int:
    """Return the highest degree whose polynomial has a third as many terms as there are runs."""
    degree = lowest
    while 3 * comb(x.shape[1] + degree + 1, degree + 1) <= len(x) and degree < 8:
        degree += 1
    return degree


def _rbf(kernel: str, degree: int | None, smoothing: float, x: Any, y: Any) -> Fitted:
    from scipy.interpolate import RBFInterpolator

    chosen = _degree(x, 2) if degree is None else degree
    _enough(x, chosen)
    surface = RBFInterpolator(x, y, kernel=kernel, degree=chosen, smoothing=smoothing)
    return Fitted(surface, partial(_rbf, kernel, chosen, smoothing))


def _terms(x: Any, degree: int) -> Any:
    columns = [np.ones(len(x))]
    for k in range(1, degree + 1):
        for chosen in combinations_with_replacement(range(x.shape[1]), k):
            columns.append(x[:, chosen].prod(axis=1))
    return np.stack(columns, axis=-1)


def _polynomial(degree: int | None, x: Any, y: Any) -> Fitted:
    chosen = _degree(x, 1) if degree is None else degree
    _enough(x, chosen)
    coefficients = np.linalg.lstsq(_terms(x, chosen), y)[0]
    return Fitted(lambda at: _terms(at, chosen) @ coefficients, partial(_polynomial, chosen))


def _sklearn(smoothness: float, restarts: int, x: Any, y: Any) -> Fitted:
    """Fit one output by scikit-learn; the smoothness is that of a Matern kernel, inf is RBF."""
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.gaussian_process import GaussianProcessRegressor as Process
    from sklearn.gaussian_process import kernels

    shape = kernels.Matern(np.ones(x.shape[1]), (1e-2, 1e4), nu=smoothness)
    whole = kernels.ConstantKernel(10.0, (1e-2, 1e4)) * shape
    noisy = whole + kernels.WhiteKernel(1e-4, (1e-8, 1.0))
    process = Process(noisy, normalize_y=True, n_restarts_optimizer=restarts, random_state=0)
    with warnings.catch_warnings():
        # Said of hyperparameters at their bounds: irrelevant inputs, no noise.
        warnings.simplefilter("ignore", ConvergenceWarning)
        process.fit(x, y)

    def again(x: Any, y: Any) -> Fitted:
        same = Process(process.kernel_, normalize_y=True, optimizer=None).fit(x, y)
        return Fitted(same.predict, again)

    return Fitted(process.predict, again)


_SMT_BOUNDS = (1.000001e-6, 19.99999)  # just inside those of its theta


def _smt(corr: str, x: Any, y: Any) -> Fitted:
    """Fit one output by SMT's kriging."""
    from smt.surrogate_models import KRG

    def trained(x: Any, y: Any, **options: Any) -> Any:
        model = KRG(corr=corr, print_global=False, **options)
        model.set_training_values(x, y)
        model.train()
        return model

    model = trained(x, y, n_start=1)

    def again(x: Any, y: Any) -> Fitted:
        inside = np.clip(model.optimal_theta.ravel(), *_SMT_BOUNDS)  # else it takes random ones
        same = trained(x, y, hyper_opt="NoOp", theta0=inside)
        return Fitted(lambda at: same.predict_values(at).ravel(), again)

    return Fitted(lambda at: model.predict_values(at).ravel(), again)


def _openturns(x: Any, y: Any) -> Fitted:
    """Fit one output by OpenTURNS' kriging, Matern 5/2 with a constant."""
    import openturns as ot

    ot.Log.Show(ot.Log.NONE)
    d = x.shape[1]

    def trained(kernel: Any, optimise: bool, x: Any, y: Any) -> Any:
        fitter = ot.GaussianProcessFitter(
            ot.Sample(x), ot.Sample(y[:, None]), kernel, ot.ConstantBasisFactory(d).build()
        )
        fitter.setOptimizeParameters(optimise)
        fitter.run()
        regression = ot.GaussianProcessRegression(fitter.getResult())
        regression.run()
        return regression.getResult()

    result = trained(ot.MaternModel(np.ones(d), [1.0], 2.5), True, x, y)

    def predict_by(result: Any) -> Predict:
        surface = result.getMetaModel()
        return lambda at: np.asarray(surface(ot.Sample(at))).ravel()

    def again(x: Any, y: Any) -> Fitted:
        return Fitted(predict_by(trained(result.getCovarianceModel(), False, x, y)), again)

    return Fitted(predict_by(result), again)


def _rough(square: Any) -> tuple[Any, Any]:
    """Return the same of a Matern correlation, 3/2."""
    r = np.sqrt(3 * square)
    decay = np.exp(-r)
    return (1 + r) * decay, 3 * decay


def _by_hand(kernel: Kernel, starts: tuple[tuple[float, float], ...], x: Any, y: Any) -> Fitted:
    """Fit one output by a Gaussian process of a length an input and a nugget, that of the package.

    The variance is profiled out; hyperparameters are those of the first 256 runs, the likeliest of
    what the starts lead to.
    """
    from scipy.optimize import minimize

    few, value = x[:MOST_TUNED], y[:MOST_TUNED] - y[:MOST_TUNED].mean()
    d = x.shape[1]
    runs = kernel, few, value
    bounds = [(np.log(0.05), np.log(1e3))] * d + [(np.log(1e-10), 0.0)]
    first = [np.log([*[length * d**0.5] * d, nugget]) for length, nugget in starts]
    options = {"args": runs, "jac": True, "bounds": bounds, "method": "L-BFGS-B"}
    found = [minimize(negative_log_likelihood, s, **options) for s in first]
    best = min(found, key=lambda result: result.fun).x

    def again(x: Any, y: Any) -> Fitted:
        mean = mean_through(kernel, np.exp(best[:-1]), float(np.exp(best[-1])), x, y)
        return Fitted(mean, again)

    return again(x, y)


def _on_polynomial(kernel: Kernel, x: Any, y: Any) -> Fitted:
    """Fit a polynomial by least squares, and its residuals by a Gaussian process.

    It is quadratic where there are twice as many runs as terms, else linear.
    """
    degree = 2 if 2 * comb(x.shape[1] + 2, 2) <= len(x) else 1

    def built(fit: Callable[[Any, Any], Fitted], x: Any, y: Any) -> Fitted:
        trend = _polynomial(degree, x, y)
        rest = fit(x, y - trend.predict(x))
        return Fitted(lambda at: trend.predict(at) + rest.predict(at), partial(built, rest.again))

    return built(partial(_by_hand, kernel, _NOISY), x, y)


# Starts: lengths in sds and in roots of the inputs' number, and the nugget.
_NOISY = ((0.7, 1e-2),)
_BOTH = ((2.0, 1e-6), *_NOISY)


@dataclass(frozen=True)
class Emulator:
    """What is fitted, and by which library."""

    fit: Callable[[Any, Any], Fitted]
    library: str
    most: int = 1000  # runs: more would take minutes a cell
    once: int = 1001  # runs from which on one seed is enough


def _own(fit: Callable[..., Fitted], *arguments: Any) -> Callable[[Any, Any], Fitted]:
    return partial(_each_output, partial(fit, *arguments))


EMULATORS = {
    "cubic 1": Emulator(partial(_rbf, "cubic", 1, 0.0), "scipy"),
    "cubic 2": Emulator(partial(_rbf, "cubic", 2, 0.0), "scipy"),
    "quintic 2": Emulator(partial(_rbf, "quintic", 2, 0.0), "scipy"),
    "thin plate 1": Emulator(partial(_rbf, "thin_plate_spline", 1, 0.0), "scipy"),
    "linear 1": Emulator(partial(_rbf, "linear", 1, 0.0), "scipy"),
    "thin plate smooth .1": Emulator(partial(_rbf, "thin_plate_spline", 1, 0.1), "scipy"),
    "thin plate smooth 1": Emulator(partial(_rbf, "thin_plate_spline", 1, 1.0), "scipy"),
    "cubic 2 smooth 1": Emulator(partial(_rbf, "cubic", 2, 1.0), "scipy"),
    "quintic high": Emulator(partial(_rbf, "quintic", None, 0.0), "scipy"),
    "polynomial 2": Emulator(partial(_polynomial, 2), "numpy"),
    "polynomial 3": Emulator(partial(_polynomial, 3), "numpy"),
    "polynomial high": Emulator(partial(_polynomial, None), "numpy"),
    "by hand RBF": Emulator(_own(_by_hand, squared_exponential, _BOTH), "numpy"),
    "by hand Matern": Emulator(_own(_by_hand, matern, _BOTH), "numpy"),
    "by hand RBF, 1 start": Emulator(_own(_by_hand, squared_exponential, _NOISY), "numpy"),
    "by hand Matern, 1 start": Emulator(_own(_by_hand, matern, _NOISY), "numpy"),
    "by hand Matern 3/2, 1 start": Emulator(_own(_by_hand, _rough, _NOISY), "numpy"),
    "by hand RBF on polynomial": Emulator(_own(_on_polynomial, squared_exponential), "numpy"),
    "by hand Matern on polynomial": Emulator(_own(_on_polynomial, matern), "numpy"),
    "sklearn RBF": Emulator(_own(_sklearn, np.inf, 0), "scikit-learn", 512, 256),
    "sklearn Matern": Emulator(_own(_sklearn, 2.5, 0), "scikit-learn", 512, 256),
    "sklearn Matern, 2 restarts": Emulator(_own(_sklearn, 2.5, 2), "scikit-learn", 128, 64),
    "SMT RBF": Emulator(_own(_smt, "squar_exp"), "smt", 256, 128),
    "SMT Matern": Emulator(_own(_smt, "matern52"), "smt", 256, 128),
    "OpenTURNS Matern": Emulator(_own(_openturns), "openturns", 256, 128),
}
RBF = ("cubic 1", "cubic 2", "quintic 2", "thin plate 1")
REFERENCE = "by hand RBF, 1 start"
SCALED = (*RBF, "by hand RBF")  # with all scalings


# -- one cell --------------------------------------------------------------------------------------


def _rms(values: Any, weights: Any = None) -> Any:
    """Return the root mean square of each output."""
    return np.sqrt(np.average(values**2, axis=0, weights=weights))


def _distribution(values: Any, weights: Any, truth: Any) -> Any:
    """Return the error of each output's distribution function in units of the noise of the data."""
    noise = np.sqrt(LEVELS * (1 - LEVELS) / DATA)
    found = []
    for value, exact in zip(values.T, truth.T, strict=True):
        at = np.quantile(exact, LEVELS)
        level = (exact[:, None] <= at).mean(axis=0)
        share = weights @ (value[:, None] <= at)
        found.append(_rms((share - level) / noise))
    return found


def _left_out(fitted: Fitted, x: Any, y: Any) -> Any:
    """Return errors at runs left out by contiguous blocks; random ones and every eighth tell alike."""
    found = np.empty_like(y)
    for block in np.array_split(np.arange(len(x)), BLOCKS):
        others = np.setdiff1d(np.arange(len(x)), block)
        found[block] = y[block] - fitted.again(x[others], y[others]).predict(x[block])
    return found


def cell(name: str, n: int, seed: int, emulator: str, scaling: str) -> dict[str, Any]:
    """Fit and predict once; errors are lists of one number an output."""
    runs = runs_of(name, n, seed)
    x, truth = population_of(name)
    scale = SCALINGS[scaling](runs)
    center, sd = runs.y.mean(axis=0), runs.y.std(axis=0)
    inputs, y = scale(runs.x), (runs.y - center) / sd
    at, unit = scale(x), truth.std(axis=0) / sd
    clock = time.process_time()
    try:
        fitted = EMULATORS[emulator].fit(inputs, y)
        fit = time.process_time() - clock
        predicted = fitted.predict(at)
        predict = time.process_time() - clock - fit
        residuals = _left_out(fitted, inputs, y) / unit
    except ImportError:
        return {"none": "not installed"}
    except TooFewError:
        return {"none": "too few runs"}
    except (ArithmeticError, RuntimeError, TypeError, ValueError) as error:
        # What libraries say of a matrix that is not positive definite.
        return {"none": f"failed: {type(error).__name__}"}
    left_out = time.process_time() - clock - fit - predict
    weights = np.full(len(x), 1 / len(x))
    return {
        "error": _list(_rms((predicted - (truth - center) / sd) / unit)),
        "distribution": _list(_distribution(center + sd * predicted, weights, truth)),
        "left out": _list(_rms(residuals)),
        "left out, weighted": _list(_rms(residuals, runs.weights)),
        "weights alone": _list(_distribution(runs.y, runs.weights, truth)),
        "seconds": _list([fit, predict, left_out]),
    }


def _rounded(value: Any) -> float:
    return float(f"{value:.4g}")


def _list(values: Any) -> list[float]:
    return [_rounded(value) for value in values]


# -- the store -------------------------------------------------------------------------------------


def path_of(store: Path, name: str) -> Path:
    """Return the file of a response."""
    return store / f"{name.replace(' ', '-')}.jsonl"


def rows_of(path: Path) -> list[dict[str, Any]]:
    """Return what is stored."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    return [json.loads(line) for line in lines]


def sizes_of(name: str) -> tuple[int, ...]:
    """Return numbers of runs: the largest is for responses of many inputs."""
    return SIZES if RESPONSES[name].d >= 6 else SIZES[:-1]


def wanted(emulators: list[str]) -> Iterator[tuple[str, int, int, str, str]]:
    """Yield cells: all emulators with inputs by their sds, then other scalings, dear ones last."""
    dear = [emulator for emulator in emulators if EMULATORS[emulator].most < SIZES[-1]]
    for emulator in emulators:
        if emulator not in dear:
            yield from _cells(emulator, "sd", SIZES)
    for scaling in SCALINGS:
        for emulator in [one for one in SCALED if one in emulators]:
            yield from _cells(emulator, scaling, (64, 256))
    for n in SIZES:
        for emulator in dear:
            yield from _cells(emulator, "sd", (n,))


def _cells(
    emulator: str, scaling: str, sizes: tuple[int, ...]
) -> Iterator[tuple[str, int, int, str, str]]:
    how = EMULATORS[emulator]
    for name in RESPONSES:
        for n in sizes_of(name):
            for seed in SEEDS if n < how.once else SEEDS[:1]:
                if n in sizes and n <= how.most:
                    yield name, n, seed, emulator, scaling


def run(store: Path, emulators: list[str], seconds: float) -> None:
    """Run what is not stored."""
    store.mkdir(parents=True, exist_ok=True)
    keys = ("response", "n", "seed", "emulator", "scaling")
    done = {
        tuple(row[key] for key in keys)
        for name in RESPONSES
        for row in rows_of(path_of(store, name))
        if row.get("none") != "not installed"
    }
    end = time.perf_counter() + seconds
    for key in wanted(emulators):
        if key in done or time.perf_counter() > end:
            continue
        done.add(key)
        row = dict(zip(keys, key, strict=True)) | cell(*key)
        with path_of(store, key[0]).open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")


# -- summaries -------------------------------------------------------------------------------------

# Among which the left-out error chooses.
POOLS = {
    "4 RBF": RBF,
    "process": ("by hand RBF, 1 start", "by hand Matern, 1 start"),
    "process, 3/2": (
        "by hand RBF, 1 start",
        "by hand Matern, 1 start",
        "by hand Matern 3/2, 1 start",
    ),
    "process, polynomial": (
        "by hand RBF, 1 start",
        "by hand Matern, 1 start",
        "by hand RBF on polynomial",
        "by hand Matern on polynomial",
    ),
    "process, cubic 1": ("by hand RBF, 1 start", "by hand Matern, 1 start", "cubic 1"),
    "process, quintic high": ("by hand RBF, 1 start", "by hand Matern, 1 start", "quintic high"),
    "process, cubic 1, quintic high": (
        "by hand RBF, 1 start",
        "by hand Matern, 1 start",
        "cubic 1",
        "quintic high",
    ),
    "Matern, quintic high": ("by hand Matern, 1 start", "quintic high"),
}
BY = ("left out, weighted", "left out")
_FLOOR = 1e-3  # of errors that are compared: a cloud of 16 384 points alone errs by .03 or more


def chosen(cells: dict[str, dict[str, Any]], pool: tuple[str, ...], by: str) -> dict[str, Any]:
    """Return the row of the emulators with the lowest left-out error, output by output."""
    able = [cells[emulator] for emulator in pool if "error" in cells.get(emulator, {})]
    if not able:
        return {"none": "too few runs"}
    best = np.argmin([row[by] for row in able], axis=0)
    what = ("error", "distribution", *BY)
    return {key: [able[k][key][output] for output, k in enumerate(best)] for key in what}


def with_chosen(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the rows and those of what is chosen from each pool."""
    groups: dict[tuple[Any, ...], dict[str, dict[str, Any]]] = {}
    for row in rows:
        if row["scaling"] == "sd":
            key = row["response"], row["n"], row["seed"]
            groups.setdefault(key, {})[row["emulator"]] = row
    found = list(rows)
    for (name, n, seed), cells in groups.items():
        for pool, members in POOLS.items():
            for by in BY:
                how = "" if by == BY[0] else ", without weights"
                about = {"response": name, "n": n, "seed": seed, "scaling": "sd"}
                about["emulator"] = f"auto: {pool}{how}"
                found.append(about | chosen(cells, members, by))
    return found


def _overall(rows: list[dict[str, Any]], key: str) -> float:
    """Return the root mean square over outputs and seeds."""
    return _rounded(np.sqrt(np.mean(np.concatenate([row[key] for row in rows]) ** 2)))


def summarise(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return a row a response, a number of runs, an emulator and a scaling."""
    groups: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for row in rows:
        key = row["response"], row["n"], row["emulator"], row["scaling"]
        groups.setdefault(key, []).append(row)
    found = []
    for (name, n, emulator, scaling), group in groups.items():
        summary: dict[str, Any] = {"response": name, "n": n, "emulator": emulator}
        summary |= {"scaling": scaling, "seeds": len(group)}
        able = [row for row in group if "error" in row]
        if not able:
            found.append(summary | {"none": group[0]["none"]})
            continue
        error = _overall(able, "error")
        summary |= {"error": error, "distribution": _overall(able, "distribution")}
        if scaling != "sd":
            found.append(summary)
            continue
        for by in BY:
            summary[f"{by} / error"] = _rounded(_overall(able, by) / error)
        if "seconds" in able[0]:
            summary["weights alone"] = _overall(able, "weights alone")
            seconds = _list(np.median([row["seconds"] for row in able], axis=0))
            summary["seconds"] = dict(zip(("fit", "predict", "left out"), seconds, strict=True))
        found.append(summary)
    return found


def _requirements(name: str) -> set[str]:
    """Return what a package needs, itself too, by its metadata."""
    from packaging.requirements import Requirement

    found: set[str] = set()
    left = [name]
    while left:
        name = re.sub(r"[-_.]+", "-", left.pop()).lower()
        if name in found:
            continue
        found.add(name)
        for line in metadata.requires(name) or []:
            needed = Requirement(line)
            if needed.marker is None or needed.marker.evaluate({"extra": ""}):
                left.append(needed.name)
    return found


def dependency(library: str) -> dict[str, Any]:
    """Return packages and megabytes that a library adds to those of prbayes."""
    try:
        added = sorted(_requirements(library) - _requirements("prbayes"))
    except metadata.PackageNotFoundError:
        return {"none": "not installed"}
    size = 0
    for name in added:
        paths = [file.locate() for file in metadata.files(name) or []]
        size += sum(Path(str(path)).stat().st_size for path in paths if Path(str(path)).exists())
    versions = {name: metadata.version(name) for name in added}
    return {"packages": versions, "megabytes": round(size / 1e6, 1)}


# -- tables ----------------------------------------------------------------------------------------


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.2g}"


def print_table(title: str, columns: list[str], rows: dict[str, list[str]]) -> None:
    """Print rows of cells under columns, in Markdown."""
    print(f"\n{title}\n\n| | {' | '.join(columns)} |")
    print("|---|" + "---|" * len(columns))
    for name, cells in rows.items():
        print(f"| {name} | {' | '.join(cells)} |")


def _errors(found: list[dict[str, Any]], what: str, n: int) -> None:
    """Print a table of an error: responses down, emulators across."""
    names = [*EMULATORS, *(f"auto: {pool}" for pool in POOLS)]
    at = {(r["response"], r["emulator"]): r for r in found if r["n"] == n and r["scaling"] == "sd"}
    rows = {
        name: [_number(at.get((name, emulator), {}).get(what)) for emulator in names]
        for name in RESPONSES
        if n in sizes_of(name)
    }
    print_table(f"{what}, {n} runs", names, rows)


def against(
    rows: list[dict[str, Any]], what: str, names: list[str], reference: str | None
) -> dict[str, Any]:
    """Return errors over those of a reference, or of the best, in the same cell: same runs.

    Geometric mean, maximum and number of cells, for smooth responses and the others.
    """
    ratios: dict[str, dict[bool, list[float]]] = {name: {True: [], False: []} for name in names}
    groups: dict[tuple[Any, ...], dict[str, float]] = {}
    for row in rows:
        if row["scaling"] == "sd" and what in row:
            key = row["response"], row["n"], row["seed"]
            groups.setdefault(key, {})[row["emulator"]] = max(_overall([row], what), _FLOOR)
    for (name, *_), errors in groups.items():
        unit = min(errors.values()) if reference is None else errors[reference]
        for emulator, error in errors.items():
            ratios[emulator][RESPONSES[name].smooth].append(error / unit)
    return {
        emulator: {
            kind: [_rounded(np.exp(np.mean(np.log(found)))), _rounded(np.max(found)), len(found)]
            for kind, found in (("smooth", both[True]), ("not smooth", both[False]))
            if found
        }
        for emulator, both in ratios.items()
    }


def left_out_ratios(rows: list[dict[str, Any]], names: list[str]) -> dict[str, Any]:
    """Return quantiles (10%, 50%, 90%) of the left-out error over the true one, from 64 runs on.

    Cells whose error is below the floor are left out.
    """
    found: dict[str, Any] = {}
    for emulator in names:
        able = [
            row
            for row in rows
            if row["emulator"] == emulator and row["scaling"] == "sd" and row["n"] >= 64
            if "error" in row and _overall([row], "error") >= _FLOOR
        ]
        for by in BY:
            ratios = [_overall([row], by) / _overall([row], "error") for row in able]
            if ratios:
                quantiles = np.quantile(ratios, [0.1, 0.5, 0.9])
                found.setdefault(emulator, {})[by] = _list(quantiles)
    return found


def scaling_ratios(found: list[dict[str, Any]]) -> dict[str, Any]:
    """Return geometric means of errors under a scaling over those by standard deviations."""
    errors = {
        (row["response"], row["n"], row["emulator"], row["scaling"]): max(row["error"], _FLOOR)
        for row in found
        if row["n"] in (64, 256) and "error" in row
    }
    table: dict[str, dict[str, float]] = {}
    for emulator in SCALED:
        for scaling in SCALINGS:
            logs = [
                np.log(error / errors[name, n, emulator, "sd"])
                for (name, n, what, how), error in errors.items()
                if what == emulator and how == scaling
            ]
            if logs:
                table.setdefault(emulator, {})[scaling] = _rounded(np.exp(np.mean(logs)))
    return table


def report(store: Path) -> dict[str, Any]:
    """Summarise what is stored, and print it."""
    rows = with_chosen([row for name in RESPONSES for row in rows_of(path_of(store, name))])
    found = summarise(rows)
    names = list(dict.fromkeys(row["emulator"] for row in found))
    for what in ("error", "distribution"):
        for n in SIZES:
            _errors(found, what, n)
    # Choices without weights stand in the ratios below only.
    table: dict[str, Any] = {
        "rows": [row for row in found if not row["emulator"].endswith("without weights")]
    }
    for what in ("error", "distribution"):
        for reference in (None, REFERENCE):
            title = f"{what} over that of {reference or 'the best emulator'}"
            table[title] = against(rows, what, names, reference)
            _ratios(title, table[title])
    ratios = left_out_ratios(rows, names)
    table["left out over true"] = ratios
    cells = {
        name: [" ".join(_number(value) for value in both[by]) for by in BY]
        for name, both in ratios.items()
    }
    print_table("left-out error over the true one: 10%, 50%, 90%", list(BY), cells)
    scalings = scaling_ratios(found)
    table["scaling over sd"] = scalings
    cells = {
        name: [_number(by.get(scaling)) for scaling in SCALINGS] for name, by in scalings.items()
    }
    print_table("error over that with inputs by their sds, 64 and 256 runs", list(SCALINGS), cells)
    _seconds(found)
    table["dependencies"] = {
        library: dependency(library) for library in ("scikit-learn", "smt", "openturns")
    }
    for library, weight in table["dependencies"].items():
        print(f"{library}: {weight}")
    return table


def _ratios(title: str, ratios: dict[str, Any]) -> None:
    """Print geometric means, maxima and numbers of cells."""
    cells: dict[str, list[str]] = {}
    for name, both in ratios.items():
        cells[name] = []
        for kind in ("smooth", "not smooth"):
            mean, most, count = both.get(kind, (None, None, 0))
            cells[name].append(f"{_number(mean)} ({_number(most)}; {count})")
    columns = ["smooth: geometric mean (maximum; cells)", "not smooth"]
    print_table(title, columns, cells)


def _seconds(found: list[dict[str, Any]]) -> None:
    """Print seconds of the response of eight inputs and four outputs."""
    at = {
        (row["emulator"], row["n"]): row["seconds"]
        for row in found
        if row["response"] == "eight inputs" and row["scaling"] == "sd" and "seconds" in row
    }
    cells = {
        name: [
            " + ".join(f"{value:.2g}" for value in at[name, n].values()) if (name, n) in at else "-"
            for n in SIZES
        ]
        for name in EMULATORS
    }
    title = f"seconds, 8 inputs, 4 outputs: fit + prediction of {POINTS} points + left-out blocks"
    print_table(title, [str(n) for n in SIZES], cells)


def main() -> None:
    """Run what is missing, then summarise."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--emulators", nargs="+", default=list(EMULATORS), choices=list(EMULATORS))
    parser.add_argument("--seconds", type=float, default=1e9, help="after which nothing is begun")
    parser.add_argument("--store", type=Path, default=STORE)
    parser.add_argument("--out", type=Path, default=record.RESULTS / "emulators.json")
    parser.add_argument("--only-table", action="store_true")
    arguments = parser.parse_args()
    if not arguments.only_table:
        run(arguments.store, arguments.emulators, arguments.seconds)
    record.save(arguments.out, report(arguments.store))


if __name__ == "__main__":
    main()
