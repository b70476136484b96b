"""The default log-likelihood on problems whose posterior is known exactly: runs, time, bias and widths.

Each row is a model with `prb.LogLikelihood` at its defaults, `prb.sample`, and the exact posterior by
a grid, a quadrature or importance sampling that does not use prbayes. Bias is the distance of means in
exact posterior standard deviations, the largest over hyperparameters; widths are ratios of standard
deviations. Runs are all evaluations of the response, by specimen. A row ends after 120 CPU seconds.

    OMP_NUM_THREADS=1 uv run python -m benchmarks.reach [--cells "a^2*"] [--out FILE]

References are stored in `results/reach_references.json`; delete a cell there to compute it again.
"""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm

import prbayes as prb
from benchmarks import exact_posteriors as exact
from benchmarks import record
from benchmarks.scoreboard import in_pymc
from benchmarks.scoreboard.problem import (
    Input,
    Prior,
    Problem,
    Response,
    half_normal,
    normal,
    uniform,
)
from benchmarks.scoreboard.problems import PROBLEMS
from benchmarks.study import Study

SECONDS = 120.0  # CPU time of a row
REFERENCES = record.RESULTS / "reach_references.json"
# Of each figure the largest value that is allowed; of "narrowest" the smallest one.
GOOD = {"bias": 0.1, "narrowest": 0.9, "widest": 1.1}


@dataclass(frozen=True)
class Instance:
    """A data set with its model and its exact posterior."""

    problem: Problem
    observed: Any
    reference: Callable[[], dict[str, Any]]  # see `exact.moments`; with "modes" of several ones
    measurement: Callable[[dict[str, Any]], dict[str, Any]] = field(default=lambda values: {})
    build: Callable[[Response], pm.Model] | None = None  # in place of inputs and formula


@dataclass(frozen=True)
class Case:
    """A problem, the number of its data sets, and what its figures may be."""

    row: Callable[[int], dict[str, Any]]
    data_sets: int
    bounds: dict[str, float]


class TimeLimitError(BaseException):
    """Raised in a row that takes too long; no handler of `Exception` catches it."""


@contextmanager
def limited(seconds: float) -> Iterator[None]:
    """Raise an error after CPU seconds."""

    def stop(*_: Any) -> None:
        raise TimeLimitError

    before = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


def model_of(instance: Instance, response: Response) -> pm.Model:
    """Return the model of a data set."""
    if instance.build is not None:
        return instance.build(response)
    problem, observed = instance.problem, instance.observed
    if problem.separate:
        # One row for each specimen, which was measured in one output.
        observed = np.where(np.eye(observed.shape[1])[:, None] > 0, observed, np.nan)
        observed = observed.reshape(-1, observed.shape[-1])
    with pm.Model() as model:
        values = in_pymc.hyperparameters(problem)
        inputs = in_pymc.inputs(problem, values)
        given = dict(values)
        if problem.degrees is not None:
            # Readings of a curve, whose error is not known.
            given["error"] = pm.HalfNormal("error", 0.1 * observed.std(axis=0))
        metric = prb.LogLikelihood(**instance.measurement(given))
        function: Callable[..., Any] = response
        if problem.correlation:
            function = lambda x: response(x[..., 0], x[..., 1])  # noqa: E731
        prb.Simulator("y", function, *inputs, metric=metric, observed=observed)
    return model


@cache
def warm() -> None:
    """Calibrate a linear response, so that no row pays for the first compilation."""
    posterior_row(lambda _: _scoreboard("linear", 20, 0), "", 0)


def stored_reference(cell: str, number: int, compute: Callable[[], Any]) -> Any:
    """Return the reference of a data set, which is computed once."""
    stored = record.load(REFERENCES, {})
    key = str(number)
    if not cell:
        return compute()
    if key not in stored.get(cell, {}):
        stored.setdefault(cell, {})[key] = compute()
        record.save(REFERENCES, stored, ("numpy", "scipy"))
    return stored[cell][key]


def posterior_row(make: Callable[[int], Instance], cell: str, number: int) -> dict[str, Any]:
    """Return runs, CPU seconds, and the distance of the posterior from the exact one."""
    if cell:
        warm()
    instance = make(number)
    reference = stored_reference(cell, number, instance.reference)
    response = Response(instance.problem)
    row: dict[str, Any] = {"number": number}
    begun = time.process_time()
    posterior = None
    try:
        with limited(SECONDS):
            model = model_of(instance, response)
            posterior = prb.sample(model=model, random_seed=1, progressbar=False).posterior
    except TimeLimitError:
        row["error"] = f"not finished in {SECONDS:.0f} CPU s"
    except Exception as error:  # a refusal is a result
        row["error"] = f"{type(error).__name__}: {error}".splitlines()[0][:200]
    row |= {"runs": response.runs, "cpu": round(time.process_time() - begun, 2)}
    if posterior is not None:
        row |= distance(instance.problem, reference, posterior)
    return row


def distance(problem: Problem, reference: dict[str, Any], posterior: Any) -> dict[str, Any]:
    """Return the figures of a posterior beside the exact one."""
    values = {name: posterior[name].to_numpy().ravel() for name in problem.priors}
    mean, sd = reference["mean"], reference["sd"]
    bias = {name: (values[name].mean() - mean[name]) / sd[name] for name in mean}
    width = {name: values[name].std() / sd[name] for name in mean}
    figures: dict[str, Any] = {
        "bias": max(map(abs, bias.values())),
        "narrowest": min(width.values()),
        "widest": max(width.values()),
        "by name": {name: [round(bias[name], 3), round(width[name], 3)] for name in mean},
        "sampler": posterior.attrs.get("sampler", ""),
        "efficiency": posterior.attrs.get("efficiency"),
        "findings": [finding["code"] for finding in json.loads(posterior.attrs["findings"])],
    }
    if "modes" in reference:
        u = exact.coordinates_of(problem.priors, values)
        share = exact.masses(reference["modes"], u, np.full(len(u), 1 / len(u)))
        right = np.array(reference["masses"])
        figures["mass"] = float(np.abs(share - right).max())
        figures["masses"] = [share.round(3).tolist(), right.round(3).tolist()]
    return figures


def by_grid(
    priors: dict[str, Prior], log_likelihood: Callable[..., Any], low: Any, high: Any,
    refinements: int = 1, least: float = 0.01,
) -> dict[str, Any]:  # fmt: skip
    """Return the exact posterior of hyperparameters, whose log-likelihood takes their values."""
    density = exact.log_posterior(priors, lambda v: log_likelihood(*v.values()))
    u, weights, whole = exact.on_grid(density, low, high, refinements)
    result = exact.moments(exact.values_of(priors, u), weights)
    found = exact.modes(u, weights, whole, least)
    if len(found) > 1:
        result |= {"modes": found, "masses": exact.masses(found, u, weights).tolist()}
    return result


def by_importance(
    priors: dict[str, Prior], log_likelihood: Callable[..., Any], start: dict[str, float],
    count: int = 8192,
) -> dict[str, Any]:  # fmt: skip
    """Return the exact posterior of more hyperparameters, by importance sampling."""
    density = exact.log_posterior(priors, log_likelihood)
    u, weights = exact.importance(density, exact.coordinates_of(priors, start), count)
    return exact.moments(exact.values_of(priors, u), weights)


# -- the scoreboard --------------------------------------------------------------------------------


def _scoreboard(name: str, size: int, number: int) -> Instance:
    problem = PROBLEMS[name]

    def reference() -> dict[str, Any]:
        found = problem.reference(size, number)
        return {"mean": found.center, "sd": found.sd}

    return Instance(problem, problem.data(size, number), reference)


# -- one input of unknown population ---------------------------------------------------------------

_MU_SIGMA = {"mu": normal(1, 0.5), "sigma": half_normal(1)}
_NODES = np.linspace(-4, 4, 2001)


def _problem(
    priors: dict[str, Prior], inputs: Iterable[Input], formula: Any, **more: Any
) -> Problem:
    return Problem("", "", "", priors, tuple(inputs), formula, (0,), **more)


def _normal(x: Any, sd: Any) -> Any:
    return np.exp(-0.5 * (x / sd) ** 2) / (sd * np.sqrt(2 * np.pi))


def _branch(formula: Any, inputs: list[Input], y: Any, likelihood: Any) -> Instance:
    """Return a data set of a ~ N(mu, sigma) and inputs of known population, by p(y_i | a)."""
    log_l = exact.normal_at_shared_nodes(_NODES, likelihood)
    inputs = [Input("normal", "mu", "sigma"), *inputs]
    problem = _problem(_MU_SIGMA, inputs, formula)
    low, high = [-2.5, np.log(0.05)], [4.0, np.log(5.0)]
    return Instance(problem, y, partial(by_grid, _MU_SIGMA, log_l, low, high))


def _square_and_known(number: int) -> Instance:
    rng = np.random.default_rng(51 + number)
    mean, sd, known = (1.0, 0.5, 0.1) if number < 3 else (0.9, 0.35, 0.05)
    a, b = rng.normal(mean, sd, 20), rng.normal(0, known, 20)
    y = a * a + b
    likelihood = _normal(y[:, None] - _NODES**2, known)
    return _branch(lambda xp, a, b: a * a + b, [Input("normal", 0.0, known)], y, likelihood)


def _smooth_modulus_and_known(number: int) -> Instance:
    rng = np.random.default_rng(61 + number)
    a, b = rng.normal(1, 0.5, 20), rng.normal(0, 0.1, 20)
    y = np.sqrt(a * a + 0.01) + b
    likelihood = _normal(y[:, None] - np.sqrt(_NODES**2 + 0.01), 0.1)
    known = [Input("normal", 0.0, 0.1)]
    return _branch(lambda xp, a, b: xp.sqrt(a * a + 0.01) + b, known, y, likelihood)


def _square_in_two_readings(number: int) -> Instance:
    rng = np.random.default_rng(71 + number)
    a, b, c = rng.normal(1, 0.5, 20), rng.normal(0, 0.1, 20), rng.normal(2, 0.3, 20)
    y = np.stack([a * a + b, c + b], axis=1)
    b = y[:, :1] - _NODES**2
    likelihood = _normal(b, 0.1) * _normal(y[:, 1:] - b - 2, 0.3)
    known = [Input("normal", 0.0, 0.1), Input("normal", 2.0, 0.3)]
    return _branch(lambda xp, a, b, c: [a * a + b, c + b], known, y, likelihood)


def _ring(number: int) -> Instance:
    rng = np.random.default_rng((12, 20, 21, 22, 23)[number])
    a, b = rng.normal(1, 0.5, 20), rng.normal(0, 0.3, 20)
    y = a * a + b * b
    # dy = 2 r dr, so that p(y) is half of the integral of the joint density over the angle.
    angle = np.arange(2048) * 2 * np.pi / 2048
    r = np.sqrt(y)[:, None]
    log_a = np.log(_normal(r * np.sin(angle), 0.3) * np.pi / 2048 + 1e-300)
    log_l = exact.normal_at_nodes((r * np.cos(angle))[..., None], log_a)
    problem = _problem(
        _MU_SIGMA, [Input("normal", "mu", "sigma"), Input("normal", 0.0, 0.3)],
        lambda xp, a, b: a * a + b * b,
    )  # fmt: skip
    low, high = [-2.5, np.log(0.05)], [4.0, np.log(5.0)]
    column = lambda mu, sigma: log_l(mu[:, None], sigma[:, None])  # noqa: E731
    return Instance(problem, y, partial(by_grid, _MU_SIGMA, column, low, high))


def _known_error(share: float, number: int) -> Instance:
    rng = np.random.default_rng(5 + number)
    x = rng.normal(2, 0.5, 30)
    error = float(share * np.exp(0.5 * x).std())
    y = np.exp(0.5 * x) + error * rng.standard_normal(30)
    priors = {"mu": normal(1.5, 1), "sigma": half_normal(1)}
    nodes = np.linspace(-3, 6, 3001)
    log_l = exact.normal_at_shared_nodes(nodes, _normal(y[:, None] - np.exp(0.5 * nodes), error))
    problem = _problem(priors, [Input("normal", "mu", "sigma")], lambda xp, x: xp.exp(0.5 * x))
    reference = partial(by_grid, priors, log_l, [-1, np.log(0.05)], [5, np.log(4.0)])
    return Instance(problem, y, reference, lambda values: {"error": error})


def _roots_of_normal(
    priors: dict[str, Prior], formula: Any, y: Any, roots: Any, slope: Any, low: Any, high: Any
) -> Instance:
    """Return a data set whose inputs have the roots (N, K), with dy/dx (N, K)."""
    log_l = exact.normal_at_nodes(roots[..., None], -np.log(np.abs(slope)))
    column = lambda mu, sigma: log_l(mu[:, None], sigma[:, None])  # noqa: E731
    problem = _problem(priors, [Input("normal", "mu", "sigma")], formula)
    return Instance(problem, y, partial(by_grid, priors, column, low, high, 2))


def _mirror(mean: float, center: float, priors: dict[str, Prior], number: int) -> Instance:
    x = np.random.default_rng(5 + number).normal(mean, 0.3 if mean == 1 else 0.4, 40)
    y = (x - center) ** 2
    r = np.sqrt(y)[:, None]
    roots = center + np.concatenate([r, -r], axis=1)
    low, high = [-4, np.log(0.03)], [4, np.log(4.0)]
    formula = lambda xp, x: (x - center) ** 2  # noqa: E731
    return _roots_of_normal(priors, formula, y, roots, np.tile(2 * r, 2), low, high)


def _conflict(number: int) -> Instance:
    x = np.random.default_rng(5).normal(10, 1, 30)
    priors = {"mu": normal(0, (1.0, 0.5)[number]), "sigma": half_normal(1)}
    y = x + 0.02 * x * x
    roots, slope = x[:, None], 1 + 0.04 * x[:, None]
    low, high = [-3, np.log(0.3)], [13, np.log(20.0)]
    return _roots_of_normal(priors, lambda xp, x: x + 0.02 * x * x, y, roots, slope, low, high)


def _sine(number: int) -> Instance:
    """Return exact readings sin(.8 x) of a Weibull population with vague priors."""
    y = np.sin(0.8 * 1.2 * np.random.default_rng([number, 8]).weibull(3.0, 100))
    turn, a = 2 * np.pi * np.arange(8), np.arcsin(y)[:, None]
    roots = np.concatenate([a + turn, np.pi - a + turn], axis=1) / 0.8
    priors = {
        "shape": Prior("lognorm", (0.5, 0.0, 2.0)),
        "scale": Prior("lognorm", (0.5, 0.0, 1.0)),
    }
    logs = np.log(np.where(roots > 0, roots, 1.0))
    log_a = np.where(roots > 0, -np.log(0.8 * np.abs(np.cos(0.8 * roots))), -np.inf)

    def log_l(shape: Any, scale: Any) -> Any:
        k = shape[:, None, None]
        z = k * (logs - np.log(scale)[:, None, None])
        density = np.exp(np.log(k) - logs + z - np.exp(np.minimum(z, 700)) + log_a)
        return np.log(density.sum(axis=2) + 1e-300).sum(axis=1)

    def build(response: Response) -> pm.Model:
        with pm.Model() as model:
            shape = pm.LogNormal("shape", np.log(2), 0.5)
            x = pm.Weibull.dist(shape, pm.LogNormal("scale", 0, 0.5))
            prb.Simulator("y", response, x, observed=y, metric=prb.LogLikelihood())
        return model

    problem = _problem(priors, [], lambda xp, x: xp.sin(0.8 * x))
    reference = partial(by_grid, priors, log_l, [-1.5, -2.0], [4.0, 3.0], 2)
    return Instance(problem, y, reference, build=build)


def _beam(share: float, number: int) -> Instance:
    """Return one reading of three inputs, two of which have a known population."""
    rng = np.random.default_rng([number, 4])
    f = lambda xp, e, b, load: 3.2e3 * load / (e * b**3)  # noqa: E731
    e, b = 210 + 9 * rng.standard_normal(25), 10 + 0.1 * rng.standard_normal(25)
    y = f(np, e, b, np.exp(0.05 * rng.standard_normal(25)))
    error = float(share * y.std())
    y = y + error * rng.standard_normal(25)
    priors = {"mu": normal(200, 50), "sigma": half_normal(30)}

    def reference(steps: int = 401) -> dict[str, Any]:
        nodes = np.linspace(90, 360, 271)
        z, w = np.polynomial.hermite_e.hermegauss(12)
        log_load = np.linspace(-0.3, 0.3, steps)
        load_weight = _normal(log_load, 0.05) * (log_load[1] - log_load[0])
        p = np.zeros((len(y), len(nodes)))  # p(y_i | e_k)
        for height, weight in zip(10 + 0.1 * z, w / w.sum(), strict=True):
            values = f(np, nodes[:, None], height, np.exp(log_load))
            p += weight * np.stack([_normal(r - values, error) @ load_weight for r in y])
        log_p = np.log(p + 1e-300)
        g = np.linspace(-6, 6, 97)

        def log_l(mu: Any, sigma: Any) -> Any:
            at = mu[:, None] + sigma[:, None] * g
            place = np.clip(at - nodes[0], 0, len(nodes) - 1.001)
            left = place.astype(int)
            part = place - left
            total = 0.0
            for row in log_p:
                inner = (1 - part) * row[left] + part * row[left + 1]
                total = total + np.log(np.exp(inner) @ (_normal(g, 1) * (g[1] - g[0])) + 1e-300)
            return total

        return by_grid(priors, log_l, [150, np.log(0.05)], [280, np.log(80.0)])

    inputs = [
        Input("normal", "mu", "sigma"), Input("normal", 10.0, 0.1), Input("lognormal", 0.0, 0.05),
    ]  # fmt: skip
    return Instance(_problem(priors, inputs, f), y, reference, lambda values: {"error": error})


# -- several hyperparameters -----------------------------------------------------------------------


def _unknown_error(number: int) -> Instance:
    seed, error = ((5, 0.05), (5, 0.3), (6, 0.3))[number]
    rng = np.random.default_rng(seed)
    f = lambda xp, x: [x, 0.5 * x + 0.1 * x**2, xp.sin(x)]  # noqa: E731
    y = np.stack(f(np, rng.normal(2, 0.5, 30)), axis=1)
    y = y + error * rng.standard_normal(y.shape)
    priors = {"mu": normal(1.5, 1), "sigma": half_normal(1), "error": half_normal(0.5)}
    g = np.linspace(-6, 6, 481)

    def log_l(v: dict[str, Any]) -> Any:
        total = np.zeros(len(v["mu"]))
        x = v["mu"][:, None] + v["sigma"][:, None] * g
        outputs = f(np, x)
        for reading in y:
            square = sum((r - o) ** 2 for r, o in zip(reading, outputs, strict=True))
            inner = np.exp(-0.5 * square / v["error"][:, None] ** 2)
            total += np.log(inner @ _normal(g, 1) + 1e-300) - 3 * np.log(v["error"])
        return total

    problem = _problem(priors, [Input("normal", "mu", "sigma")], f)
    start = {"mu": 2.0, "sigma": 0.5, "error": error}
    reference = partial(by_importance, priors, log_l, start)
    return Instance(problem, y, reference, lambda values: {"error": values["error"]})


def _correlated(number: int) -> Instance:
    z = np.random.default_rng(5 + number).standard_normal((40, 2))
    x = np.stack([1 + 0.2 * z[:, 0], 2 + 0.3 * (0.7 * z[:, 0] + np.sqrt(0.51) * z[:, 1])], axis=1)
    f = lambda xp, a, b: [a * b**2, xp.exp(a) + b]  # noqa: E731
    half = half_normal(0.5)
    priors = {
        "m1": normal(1.3, 0.5), "s1": half, "m2": normal(1.6, 0.5), "s2": half,
        "rho": uniform(-1.0, 1.0),
    }  # fmt: skip

    def log_l(v: dict[str, Any]) -> Any:
        a = (x[:, 0] - v["m1"][:, None]) / v["s1"][:, None]
        b = (x[:, 1] - v["m2"][:, None]) / v["s2"][:, None]
        rho = v["rho"][:, None]
        square = (a * a - 2 * rho * a * b + b * b) / (1 - rho**2)
        constant = np.log(v["s1"] * v["s2"]) + 0.5 * np.log1p(-(v["rho"] ** 2))
        return -0.5 * square.sum(axis=1) - len(x) * constant

    inputs = [Input("normal", "m1", "s1"), Input("normal", "m2", "s2")]
    problem = _problem(priors, inputs, f, correlation="rho")
    start = {"m1": 1.0, "s1": 0.2, "m2": 2.0, "s2": 0.3, "rho": 0.5}
    observed = np.stack(f(np, *x.T), axis=1)
    return Instance(problem, observed, partial(by_importance, priors, log_l, start))


def _case(cell: str, make: Callable[[int], Instance], data_sets: int, **bounds: float) -> Any:
    return cell, Case(partial(posterior_row, make, cell), data_sets, GOOD | bounds)


def _board(name: str, size: int, data_sets: int, **bounds: float) -> Any:
    cell = f"{name} {size}"
    return _case(cell, partial(_scoreboard, name, size), data_sets, **bounds)


_SYMMETRIC = {"mu": normal(0, 3), "sigma": half_normal(1)}
_TO_ONE_SIDE = {"mu": normal(1, 1.5), "sigma": half_normal(1)}
CASES: dict[str, Case] = dict(
    (
        _board("linear", 50, 3, runs=60),
        _board("thermal", 30, 1, runs=60),
        _board("crack growth", 21, 1, runs=60),
        _board("folded", 50, 3, runs=60),
        _board("folded", 20, 3, runs=60),
        _board("frame", 20, 3, runs=60),
        _board("three masses, well separated", 200, 3, runs=110),
        _board("three masses, close", 200, 3, runs=900),
        _board("growth", 100, 3),
        _case("a^2 + b", _square_and_known, 5),
        _case("a^2 + b^2", _ring, 5),
        _case("sqrt(a^2 + .01) + b", _smooth_modulus_and_known, 3),
        _case("a^2 + b, c + b", _square_in_two_readings, 3),
        _case("error of 3 %", partial(_known_error, 0.03), 3),
        _case("error of 10 %", partial(_known_error, 0.1), 3),
        _case("error unknown, three readings", _unknown_error, 3),
        _case("mirror", partial(_mirror, 1.0, 0.0, _SYMMETRIC), 3, mass=0.05),
        _case("mirror, prior to one side", partial(_mirror, 2.0, 0.3, _TO_ONE_SIDE), 3, mass=0.05),
        _case("prior in conflict", _conflict, 2),
        _case("correlated inputs", _correlated, 3),
        _case("beam, error of 10 %", partial(_beam, 0.1), 3, cpu=1.5),
        _case("beam, error of 3 %", partial(_beam, 0.03), 3, cpu=1.5),
        _case("sine of Weibull", _sine, 20, runs=200, mass=0.05),
    )
)


def misses(bounds: dict[str, float], row: dict[str, Any]) -> list[str]:
    """Return the figures of a row that are not within their bounds."""
    if "error" in row:
        return ["refused"]
    worse = {
        name for name, bound in bounds.items()
        if name in row and (row[name] < bound if name == "narrowest" else row[name] > bound)
    }  # fmt: skip
    return sorted(worse)


def summary(bounds: dict[str, float], rows: list[Any]) -> dict[str, Any]:
    """Return the worst figures of the rows of a cell, and how many are within all bounds."""
    result: dict[str, Any] = {"data sets": len(rows)}
    result["within bounds"] = sum(not misses(bounds, row) for row in rows)
    result["refused"] = sum("error" in row for row in rows)
    for name in ("runs", "cpu", "bias", "widest", "mass", "nats", "narrowest"):
        values = [row[name] for row in rows if name in row]
        if values:
            result[name] = round(min(values) if name == "narrowest" else max(values), 3)
    return result | {"bounds": bounds}


def table(results: dict[str, Any]) -> str:
    """Return a table of the rows, each with its verdict."""
    lines = [
        f"{'case':34s} {'runs':>6s} {'CPU s':>6s} {'bias':>6s} {'widths':>12s} {'mass':>5s} verdict"
    ]
    for cell, rows in results["rows"].items():
        for row in rows:
            shown = {k: f"{row[k]:.2f}" if k in row else "" for k in ("bias", "mass")}
            widths = f"{row['narrowest']:.2f} - {row['widest']:.2f}" if "narrowest" in row else ""
            missed = misses(CASES[cell].bounds, row)
            verdict = row.get("error") or (", ".join(missed) if missed else "met")
            lines.append(
                f"{cell + ' /' + str(row['number']):34s} {row.get('runs', ''):>6} {row['cpu']:6.1f} "
                f"{shown['bias']:>6s} {widths:>12s} {shown['mass']:>5s} {verdict}"
            )
    return "\n".join(lines)


class Reach(Study):
    """A study whose cells have their own number of data sets."""

    def complete(
        self, cells: Iterable[str], data_sets: int, out: Path, workers: int = 1
    ) -> dict[str, Any]:
        """Compute what is not stored, and print a table of it."""
        results: dict[str, Any] = {"rows": {}}
        chosen = list(cells)
        for cell in chosen:
            count = min(data_sets, CASES[cell].data_sets)
            results = super().complete([cell], count, out, workers)
        for cell, rows in results["rows"].items():
            results["summary"][cell] = summary(CASES[cell].bounds, rows)
        record.save(out, results, self.packages)
        print(table({"rows": {c: r for c, r in results["rows"].items() if c in chosen}}))
        return results


STUDY = Reach(
    "reach", __doc__ or "", CASES, lambda cell, number: CASES[cell].row(number), data_sets=20
)

if __name__ == "__main__":
    STUDY.main()
