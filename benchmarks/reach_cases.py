"""Data sets, models and exact posteriors of `benchmarks.reach`, by case.

A reference is a grid, a quadrature or an importance sample of the response itself, without prbayes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import pymc as pm
from scipy import stats
from scipy.special import gammaln

import prbayes as prb
from benchmarks import exact_posteriors as exact
from benchmarks.responses import RESPONSES
from benchmarks.scoreboard.problem import (
    Input,
    Prior,
    Problem,
    Response,
    half_normal,
    normal,
    uniform,
)
from benchmarks.scoreboard.problems import PROBLEMS, growth, virkler

MINOR = 0.01  # mass of a mode that is left out of moments


@dataclass(frozen=True)
class Instance:
    """A data set with its model and its exact posterior."""

    problem: Problem
    observed: Any
    reference: Callable[[], dict[str, Any]]  # see `exact.moments`; with "modes" of several ones
    measurement: Callable[[dict[str, Any]], dict[str, Any]] = field(default=lambda values: {})
    build: Callable[[Response], pm.Model] | None = None  # in place of inputs and formula


def by_grid(
    priors: dict[str, Prior], log_likelihood: Callable[..., Any], low: Any, high: Any,
    refinements: int = 1, points: int = 61,
    told: Callable[[dict[str, Any]], dict[str, Any]] = dict,
) -> dict[str, Any]:  # fmt: skip
    """Return the exact posterior of hyperparameters, whose log-likelihood takes their values."""
    density = exact.log_posterior(priors, lambda v: log_likelihood(*v.values()))
    u, weights, whole = exact.on_grid(density, low, high, refinements, points)
    found = exact.modes(u, weights, whole)
    if len(found) < 2:
        return exact.moments(told(exact.values_of(priors, u)), weights)
    # A mode of a thousandth of the mass, far away, would rule standard deviations, and a few thousand
    # draws do not tell its mass: moments are those of the other modes.
    mode = exact.classified(found, u)
    masses = np.bincount(mode, weights, len(found))
    weights = np.where(masses[mode] > MINOR, weights, 0.0)
    result = exact.moments(told(exact.values_of(priors, u)), weights / weights.sum())
    return result | {"modes": found, "masses": masses.tolist()}


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
_BOX = ([-2.5, np.log(0.05)], [4.0, np.log(5.0)])
_NODES = np.linspace(-4, 4, 2001)


def _without_sign(values: dict[str, Any]) -> dict[str, Any]:
    """Return the modulus of the mean: the likelihood is symmetric in it, and the mirrored mode small."""
    return values | {"mu": np.abs(values["mu"])}


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
    problem = _problem(_MU_SIGMA, inputs, formula, told=_without_sign)
    return Instance(problem, y, partial(by_grid, _MU_SIGMA, log_l, *_BOX, told=_without_sign))


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
        lambda xp, a, b: a * a + b * b, told=_without_sign,
    )  # fmt: skip
    column = lambda mu, sigma: log_l(mu[:, None], sigma[:, None])  # noqa: E731
    return Instance(problem, y, partial(by_grid, _MU_SIGMA, column, *_BOX, told=_without_sign))


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


def _sine_of_lognormal(number: int) -> Instance:
    """Return exact readings sin(.8 x) of a Weibull population, taken as lognormal; vague priors."""
    y = np.sin(0.8 * 2.5 * np.random.default_rng(number).weibull(4.0, 100))
    turn, a = 2 * np.pi * np.arange(40), np.arcsin(y)[:, None]
    roots = np.concatenate([a + turn, np.pi - a + turn], axis=1) / 0.8
    logs = np.log(np.where(roots > 0, roots, 1.0))
    slope = np.where(roots > 0, 0.8 * np.abs(np.cos(0.8 * roots)) * np.abs(roots), np.inf)
    priors = {"mu": normal(1, 1), "sigma": half_normal(1)}
    log_l = exact.normal_at_nodes(logs[..., None], -np.log(slope))
    column = lambda mu, sigma: log_l(mu[:, None], sigma[:, None])  # noqa: E731
    problem = _problem(priors, [Input("lognormal", "mu", "sigma")], lambda xp, x: xp.sin(0.8 * x))
    low, high = [-1, np.log(0.02)], [4.5, np.log(3.0)]
    return Instance(problem, y, partial(by_grid, priors, column, low, high, 2, 121))


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


def _growth_at_one_dose(number: int) -> Instance:
    """Return cells at the first dose alone: one reading of two inputs."""
    problem = growth.PROBLEM
    y = problem.data(100, number)[:, :1]
    names = list(problem.priors)

    def reference(points: int = 121) -> dict[str, Any]:
        # A standard deviation of receptors of at most 200 in 6e5 changes no density, so that its
        # posterior is its prior and a cell's reading identifies its rate of binding, given RT.
        logs, jacobian = growth._table(growth.DOSES[0])
        axes = [np.linspace(2.5e5, 8e5, 2 * points), np.linspace(0.25, 3.0, 4 * points)]
        axes.append(np.linspace(0.004, 2.0, 4 * points))
        density = np.full([len(a) for a in axes], -np.inf)
        for k, receptors in enumerate(axes[0]):
            share = np.log(y[:, 0]) - np.log(receptors)
            if share.min() <= logs[0] or share.max() >= logs[-1]:
                continue
            k1 = np.exp(np.interp(share, logs, np.log(growth._RATES)))
            log_l = exact_normal(k1, axes[1][:, None], axes[2])
            density[k] = log_l + np.interp(share, logs, jacobian).sum()
        weights = np.exp(density - density.max())
        weights /= weights.sum()
        grid = dict(zip((names[0], *names[2:]), np.meshgrid(*axes, indexing="ij"), strict=True))
        return exact.moments({n: v.ravel() for n, v in grid.items()}, weights.ravel())

    one = replace(problem, formula=lambda xp, r, k: problem.formula(xp, r, k)[0], separate=False)
    return Instance(one, y[:, 0], reference)


def exact_normal(x: Any, mean: Any, sd: Any) -> Any:
    """Return the log-likelihood of a normal population, given its specimens."""
    scatter = ((x - x.mean()) ** 2).sum()
    return -len(x) * np.log(sd) - (scatter + len(x) * (x.mean() - mean) ** 2) / (2 * sd**2)


def _populations(names: Iterable[str]) -> Callable[[dict[str, Any]], tuple[Any, Any]]:
    """Return the means and standard deviations (S, d) of inputs mu0, s0, mu1, ... from values."""
    d = len(list(names)) // 2

    def function(v: dict[str, Any]) -> tuple[Any, Any]:
        columns = ([v[f"{name}{i}"] for i in range(d)] for name in ("mu", "s"))
        mean, sd = (np.stack(column, axis=1) for column in columns)
        return mean, sd

    return function


def _panel(number: int) -> Instance:
    """Return two readings of three inputs of unknown population, for 80 specimens."""

    def f(xp: Any, e: Any, t: Any, c: Any) -> list[Any]:
        return [e * t**3 / (1 + 0.3 * c), xp.sqrt(xp.abs(e * t)) + 0.4 * c**2 * t]

    z = np.random.default_rng(12 + number).standard_normal((80, 3))
    y = np.stack(f(np, *([2.0, 1.2, 0.8] + np.array([0.25, 0.08, 0.2]) * z).T), axis=1)
    priors: dict[str, Prior] = {}
    for i, (m, s, t) in enumerate(
        zip((2.2, 1.1, 1), (0.6, 0.2, 0.5), (0.5, 0.2, 0.5), strict=True)
    ):
        priors |= {f"mu{i}": normal(m, s), f"s{i}": half_normal(t)}

    def reference(points: int = 481) -> dict[str, Any]:
        c = np.linspace(-0.2, 1.9, points)
        # Given c, b t^2 - y2 t + a = 0: both roots, and e from y1.
        a, b = np.sqrt(y[:, :1] * (1 + 0.3 * c)), 0.4 * c**2 + 1e-12
        root = np.sqrt(np.maximum(y[:, 1:] ** 2 - 4 * a * b, 0))
        t = np.concatenate([2 * a / (y[:, 1:] + root), (y[:, 1:] + root) / (2 * b)], axis=1)
        c, root = np.tile(c, (len(y), 2)), np.tile(root, 2)
        e = y[:, :1] * (1 + 0.3 * c) / t**3
        slope = t**3 / (1 + 0.3 * c) * (np.sqrt(e / t) / 2 + 0.4 * c**2)
        determinant = slope - 1.5 * np.sqrt(e * t) * t**2 / (1 + 0.3 * c)
        with np.errstate(divide="ignore"):
            log_a = np.log(c[0, 1] - c[0, 0]) - np.log(np.abs(determinant))
        log_a = np.where(root > 0, log_a, -np.inf)
        log_l, split = exact.normal_at_nodes(np.stack([e, t, c], 2), log_a), _populations(priors)
        start = {"mu0": 2.0, "s0": 0.25, "mu1": 1.2, "s1": 0.08, "mu2": 0.8, "s2": 0.2}
        return by_importance(priors, lambda v: log_l(*split(v)), start)

    inputs = [Input("normal", f"mu{i}", f"s{i}") for i in range(3)]
    return Instance(_problem(priors, inputs, f), y, reference)


_EIGHT = RESPONSES["eight inputs"]


def _eight(number: int) -> Instance:
    """Return four readings of eight inputs of unknown population, for 50 specimens."""
    z = np.random.default_rng([number + 1, 50]).standard_normal((50, 8))
    y = _EIGHT.of_columns(*(_EIGHT.mean + _EIGHT.sd * z).T)
    priors: dict[str, Prior] = {}
    for i, (mean, sd) in enumerate(zip(_EIGHT.mean, _EIGHT.sd, strict=True)):
        priors[f"mu{i}"] = normal(mean + 0.3 * sd, sd)
        priors[f"s{i}"] = Prior("lognorm", (0.3, 0.0, float(sd * np.exp(0.1))))
    inputs = [Input("normal", f"mu{i}", f"s{i}") for i in range(8)]
    start = {f"mu{i}": float(m) for i, m in enumerate(_EIGHT.mean)}
    start |= {f"s{i}": float(s) for i, s in enumerate(_EIGHT.sd)}

    def reference(nodes: int = 4096, sets: int = 2, count: int = 8192) -> dict[str, Any]:
        split = _populations(priors)
        points = [fibre_nodes(y, nodes, seed) for seed in range(sets)]
        log_l = [exact.normal_at_nodes(x, log_a) for x, log_a in points]
        densities = [
            exact.log_posterior(priors, lambda v, log_l=one: log_l(*split(v))) for one in log_l
        ]
        u, weights = exact.importance(densities[0], exact.coordinates_of(priors, start), count)
        logs = np.array([d(u) for d in densities])
        # The sets together have twice the nodes; half of their difference is the error of either.
        weights = weights * np.exp(logs.mean(axis=0) - logs[0])
        weights /= weights.sum()
        half = (logs[0] - logs[1]) / 2
        spread = np.sqrt(np.average((half - weights @ half) ** 2, weights=weights))
        moments = exact.moments(exact.values_of(priors, u), weights)
        return moments | {"error of log L": float(spread)}

    def outputs(xp: Any, *x: Any) -> list[Any]:
        return list(np.moveaxis(_EIGHT.of_columns(*x), -1, 0))

    return Instance(_problem(priors, inputs, outputs), y, reference)


def fibre_nodes(y: Any, nodes: int, seed: int, charts: int = 6, starts: int = 3) -> tuple[Any, Any]:
    """Return inputs (N, K, 8) and log weights (N, K) of four readings of eight inputs.

    A chart has Sobol points of a normal distribution in the null space of the Jacobian at a point of
    the fibre, and Newton's method in its row space from fixed starts. A node counts with the density of
    all charts in which Newton's method reaches it: a fold of one chart has no large weights, and a root
    that one chart misses is found in another.
    """
    rng = np.random.default_rng(seed)
    fibres = [_fibre(target, y.std(axis=0), nodes, rng, charts, starts) for target in y]
    longest = max(len(log_a) for _, log_a in fibres)
    x = np.zeros((len(y), longest, 8))
    log_a = np.full((len(y), longest), -np.inf)
    for i, (points, logs) in enumerate(fibres):
        x[i, : len(logs)], log_a[i, : len(logs)] = points, logs
    return x, log_a


def _fibre(
    y: Any, spread: Any, nodes: int, rng: np.random.Generator, charts: int, starts: int
) -> tuple[Any, Any]:
    """Return inputs (K, 8) and log weights (K,) of the readings (4,) of a specimen."""
    center, scale, sd = _EIGHT.mean, 1.2 * _EIGHT.sd, 1.1
    m = len(y)

    def f(z: Any) -> Any:
        return _EIGHT.of_columns(*np.moveaxis(center + scale * z, -1, 0))

    def slopes(z: Any, directions: Any, step: float = 1e-5) -> Any:
        both = [f(z + step * v) - f(z - step * v) for v in directions]
        return np.stack(both, axis=-1) / (2 * step)

    def roots(null: Any, rows: Any, eta: Any, start: Any) -> tuple[Any, Any]:
        """Return the ends of Newton's method at coordinates (k, 4), and which are roots."""
        base, t = eta @ null, np.tile(start, (len(eta), 1))
        active = np.arange(len(eta))
        for _ in range(25):
            z = base[active] + t[active] @ rows
            j = slopes(z, rows) + 1e-12 * np.eye(m)
            step = np.linalg.solve(j, (y - f(z))[..., None])[..., 0]
            step *= np.minimum(1, 1 / np.linalg.norm(step, axis=1, keepdims=True).clip(1e-12))
            t[active] += step
            active = active[np.abs(step).max(axis=1) > 1e-9]
            if not active.size:
                break
        z = base + t @ rows
        is_root = (np.abs(f(z) - y) / spread).max(axis=1) < 1e-7
        is_root[active] = False
        return z, is_root

    # Charts at points of the fibre near random inputs.
    origins = np.zeros((0, 8))
    while len(origins) < charts:
        z = rng.standard_normal((4 * charts, 8)) / 1.2
        for _ in range(30):  # Gauss-Newton, the shortest step
            step = np.einsum("ndm,nm->nd", np.linalg.pinv(slopes(z, np.eye(8))), y - f(z))
            z += step * np.minimum(1, 0.7 / np.linalg.norm(step, axis=1, keepdims=True).clip(1e-12))
        is_near = (np.abs(f(z) - y) < 1e-6 * spread).all(axis=1) & ((z**2).sum(axis=1) < 16)
        origins = np.concatenate([origins, z[is_near]])
    bases = np.linalg.svd(slopes(origins[:charts], np.eye(8)))[2]
    all_starts = rng.standard_normal((charts, starts, m))
    all_starts[:, 0] = np.einsum("cmd,cd->cm", bases[:, :m], origins[:charts])
    found = []
    for basis, of_chart in zip(bases, all_starts, strict=True):
        sobol = stats.qmc.Sobol(8 - m, rng=rng).random(nodes)
        eta = sd * stats.norm.ppf(np.clip(sobol, 1e-12, 1 - 1e-12))
        before: list[Any] = []
        for start in of_chart:
            z, is_new = roots(basis[m:], basis[:m], eta, start)
            for other, is_root in before:
                is_new &= ~(is_root & (np.abs(z - other).max(axis=1) < 1e-4))
            before.append((z, is_new))
            found.append(z[is_new])
    z = np.concatenate(found)
    total = np.full(len(z), -np.inf)
    for basis, of_chart in zip(bases, all_starts, strict=True):
        eta, left = z @ basis[m:].T, np.arange(len(z))
        log_q = stats.norm.logpdf(eta, 0, sd).sum(axis=1)
        log_q = log_q + np.linalg.slogdet(slopes(z, basis[:m]))[1]
        for start in of_chart:
            end, is_root = roots(basis[m:], basis[:m], eta[left], start)
            is_reached = is_root & (np.abs(end - z[left]).max(axis=1) < 1e-4)
            rows = left[is_reached]
            total[rows] = np.logaddexp(total[rows], log_q[rows])
            left = left[~is_reached]
    is_reached = np.isfinite(total)
    log_a = np.log(scale).sum() - total[is_reached] - np.log(nodes)
    return center + scale * z[is_reached], log_a


def _virkler(number: int) -> Instance:
    """Return crack lengths at four times, each with an unknown error of its own.

    Twelve readings equal the longest crack, and so does the response of a set of inputs: the
    likelihood grows without bound as the error of the last time vanishes. There is no reference.
    """
    problem = PROBLEMS["Virkler"]
    reference: Callable[[], dict[str, Any]] = lambda: {"mean": {}, "sd": {}}  # noqa: E731
    y = problem.data(68, number)
    return Instance(problem, y, reference, lambda values: {"error": values["error"]})


def _virkler_with_one_error(number: int) -> Instance:
    """Return crack lengths at four times with one unknown error."""
    y = PROBLEMS["Virkler"].data(68, number)
    priors = PROBLEMS["Virkler"].priors | {"error": half_normal(0.1 * float(y.std(axis=0).mean()))}
    problem = replace(PROBLEMS["Virkler"], priors=priors, degrees=None)
    start = {"mean rate": -2.0, "sd rate": 0.06, "mean m": 3.5, "sd m": 0.2, "correlation": 0.1}
    start["error"] = 0.2

    def reference() -> dict[str, Any]:
        at, result = start, {}
        for count, nodes in ((1024, 1024), (1024, 1024), (8192, 4096)):
            log_l = _virkler_log_likelihood(y, at, nodes)
            result = by_importance(priors, log_l, at, count)
            at = result["mean"]
        return result

    return Instance(problem, y, reference, lambda values: {"error": values["error"]})


def _virkler_log_likelihood(y: Any, at: dict[str, float], nodes: int) -> Callable[[Any], Any]:
    """Return log L (S,) by Sobol points about each specimen's most probable inputs."""
    f = lambda x: np.stack(virkler.formula(np, x[..., 0], x[..., 1]), axis=-1)  # noqa: E731
    mean, sd = np.array([at["mean rate"], at["mean m"]]), np.array([at["sd rate"], at["sd m"]])
    error = np.full(4, at["error"])
    cross = at["correlation"] * sd[0] * sd[1]
    prior = np.linalg.inv([[sd[0] ** 2, cross], [cross, sd[1] ** 2]])
    x = np.tile(mean, (len(y), 1))
    for _ in range(60):
        h = 1e-6
        j = np.stack([(f(x + v) - f(x - v)) / (2 * h) for v in h * np.eye(2)], axis=2)
        j = j / error[:, None]
        precision = np.swapaxes(j, 1, 2) @ j + prior
        slope = np.einsum("nmd,nm->nd", j, (y - f(x)) / error) - (x - mean) @ prior
        step = np.linalg.solve(precision, slope[..., None])[..., 0]
        x = x + 0.5 * step
    root = np.linalg.cholesky(np.linalg.inv(precision))
    sobol = np.clip(stats.qmc.Sobol(3, seed=0).random(nodes), 1e-10, 1 - 1e-10)
    radius = np.sqrt(5 / stats.chi2.ppf(sobol[:, 2], 5))
    z = 1.5 * stats.norm.ppf(sobol[:, :2]) * radius[:, None]
    log_q = -3.5 * np.log1p((z**2).sum(axis=1) / 1.5**2 / 5) - 2 * np.log(1.5)
    log_q = log_q - np.log(2 * np.pi) + np.log(nodes)
    points = x[:, None] + np.einsum("nde,ke->nkd", root, z)
    log_a = -log_q - np.log(np.linalg.det(root))[:, None]
    square = (y[:, None] - f(points)) ** 2
    a, b = np.moveaxis(points - mean, -1, 0)
    features = np.stack([a * a, a * b, b * b, a, b, *np.moveaxis(square, -1, 0)]).reshape(9, -1)

    def log_l(v: dict[str, Any]) -> Any:
        s, t, rho = v["sd rate"], v["sd m"], v["correlation"]
        m, n = v["mean rate"] - mean[0], v["mean m"] - mean[1]
        p, q = 1 / (s**2 * (1 - rho**2)), 1 / (t**2 * (1 - rho**2))
        r = -rho / (s * t * (1 - rho**2))
        errors = np.stack([v["error"]] * 4)
        rows = [-p / 2, -r, -q / 2, p * m + r * n, q * n + r * m, *(-0.5 / errors**2)]
        logs = (np.stack(rows, axis=1) @ features).reshape(-1, *log_a.shape)
        logs += log_a
        constant = -0.5 * (p * m * m + 2 * r * m * n + q * n * n) - np.log(s * t)
        constant = constant - 0.5 * np.log1p(-(rho**2)) - np.log(errors).sum(axis=0)
        return exact.log_sum(logs).sum(axis=1) + len(y) * constant

    return log_l


# -- subjects with times and doses of their own ----------------------------------------------------


def concentration(ka: Any, cl: Any, v: Any, dose: Any, time: Any) -> Any:
    """Return concentrations (..., T) of one compartment with absorption, in closed form."""
    ka, cl, v, dose = (np.asarray(a, dtype=float)[..., None] for a in (ka, cl, v, dose))
    ke = cl / v
    gap = np.where(np.abs(ka - ke) < 1e-9, 1e-9, ka - ke)
    return dose * ka / v / gap * (np.exp(-ke * time) - np.exp(-ka * time))


def solved(ka: float, cl: float, v: float, dose: float, time: Any) -> Any:
    """Return the concentrations (T,) of a subject by a solver of ordinary differential equations."""
    from scipy.integrate import solve_ivp

    order = np.argsort(time)
    solution = solve_ivp(
        lambda _, a: [-ka * a[0], ka * a[0] - cl / v * a[1]],
        (0, time[order][-1] + 1e-9), [dose, 0.0], t_eval=time[order],
        method="LSODA", rtol=1e-7, atol=1e-10,
    )  # fmt: skip
    result = np.empty(len(time))
    result[order] = solution.y[1] / v
    return result


def own_times(seed: int) -> dict[str, Any]:
    """Return 30 subjects with doses, weights and eight times of their own, and an error of 12 %."""
    rng, n = np.random.default_rng([seed, 30]), 30
    weight = rng.normal(72, 13, n)
    dose = rng.choice([60.0, 90.0, 120.0], n) * rng.uniform(0.9, 1.1, n)
    ends = ((0.2, 0.6), (0.8, 1.3), (1.5, 2.6), (2.8, 4.2), (4.5, 7), (7.5, 10), (11, 15), (20, 26))
    time = np.stack([rng.uniform(a, b, n) for a, b in ends], axis=1).round(1)
    spreads = ((0.25, 0.45), (1.1, 0.28), (3.5, 0.22))
    ka, cl, v = (np.exp(m + s * rng.standard_normal(n)) for m, s in spreads)
    exact_readings = concentration(ka, cl, v * weight / 70, dose, time)
    readings = exact_readings * (1 + 0.12 * rng.standard_normal((n, 8)))
    return {"weight": weight, "dose": dose, "time": time, "readings": readings}


def _own_times(number: int) -> Instance:
    data = own_times(number)
    priors = {
        "log_ka": normal(0.2, 0.7), "log_cl": normal(1, 0.7), "log_v": normal(3.4, 0.7),
        "sd_ka": half_normal(0.5), "sd_cl": half_normal(0.5), "sd_v": half_normal(0.5),
        "beta": normal(0.75, 0.5), "error": half_normal(0.3),
    }  # fmt: skip

    def build(response: Response) -> pm.Model:
        def function(ka: Any, cl: Any, v: Any, dose: Any, time: Any) -> Any:
            columns = np.broadcast_arrays(*[np.asarray(x, float) for x in (ka, cl, v, dose)])
            response.runs += columns[0].size
            time = np.atleast_1d(time)
            table = np.stack(columns, axis=-1).reshape(-1, 4)
            rows = [solved(a, b, c, d, time) for a, b, c, d in table]
            return np.reshape(rows, (*columns[0].shape, len(time)))

        with pm.Model() as model:
            weight = prb.response.condition("weight", data["weight"])
            dose = prb.response.condition("dose", data["dose"])
            time = prb.response.condition("time", data["time"])
            names = ("ka", "cl", "v")
            mean = {n: pm.Normal(f"log_{n}", *priors[f"log_{n}"].arguments) for n in names}
            sd = {n: pm.HalfNormal(f"sd_{n}", 0.5) for n in names}
            mean["v"] = mean["v"] + pm.Normal("beta", 0.75, 0.5) * pm.math.log(weight / 70)
            metric = prb.LogLikelihood(error=pm.HalfNormal("error", 0.3), relative=True)
            inputs = [pm.LogNormal.dist(mean[n], sd[n]) for n in names]
            prb.Simulator(
                "drug", function, *inputs, dose, time, observed=data["readings"], metric=metric
            )
        return model

    start = {
        "log_ka": 0.25, "log_cl": 1.1, "log_v": 3.5, "sd_ka": 0.45, "sd_cl": 0.28, "sd_v": 0.22,
        "beta": 1.0, "error": 0.12,
    }  # fmt: skip
    log_l = own_times_log_likelihood(data, start)
    reference = partial(by_importance, priors, log_l, start, 4096)
    problem = _problem(priors, [], lambda xp: None)
    return Instance(problem, data["readings"], reference, build=build)


def own_times_log_likelihood(
    data: dict[str, Any], start: dict[str, float], count: int = 2**13, seed: int = 0
) -> Callable[[dict[str, Any]], Any]:
    """Return log L, (S,), from ``count`` importance points of each subject.

    Adaptive Gauss-Hermite quadrature with 15 nodes is wrong by a nat where a subject has a second
    mode, in which absorption is slower than elimination. The proposal is a mixture of normals
    around 64 points that represent the inputs of the subject at the hyperparameters ``start``.
    """
    rng, names = np.random.default_rng(seed), ("ka", "cl", "v")
    mean = np.array([start[f"log_{n}"] for n in names])
    sd = 1.7 * np.array([start[f"sd_{n}"] for n in names])
    error = 1.5 * start["error"]
    log_weight = np.log(data["weight"] / 70)

    def misfit(x: Any, i: int) -> tuple[Any, Any]:
        """Return the sums of squared relative deviations and of log f at points (K, 3)."""
        ka, cl, volume = np.exp(x).T
        f = concentration(ka, cl, volume, data["dose"][i], data["time"][i])
        f = np.maximum(f, 1e-300)
        return ((data["readings"][i] / f - 1) ** 2).sum(axis=1), np.log(f).sum(axis=1)

    features = []
    for i, shift in enumerate(start["beta"] * log_weight):
        center = mean + np.array([0, 0, shift])
        x = center + sd * rng.standard_normal((2**17, 3))
        square, log_f = misfit(x, i)
        logs = -0.5 * square / error**2 - log_f
        weights = np.exp(logs - logs.max())
        weights /= weights.sum()
        kernels = x[rng.choice(len(x), 64, p=weights)]
        root = np.linalg.cholesky(0.5 * np.cov(kernels.T))
        degrees, z = 5, rng.standard_normal((count, 3))
        z *= np.sqrt(degrees / rng.chisquare(degrees, count))[:, None]
        x = kernels[rng.permutation(np.resize(np.arange(64), count))] + z @ root.T
        away = np.linalg.solve(root, (x[:, None] - kernels).reshape(-1, 3).T)
        density = (1 + (away**2).sum(axis=0) / degrees).reshape(count, 64) ** -4
        log_q = np.log(density.mean(axis=1)) - np.log(np.diag(root)).sum()
        square, log_f = misfit(x, i)
        constant = -log_q - log_f - np.log(count)
        features.append(np.stack([*x.T**2, *x.T, square, constant]))
    # Constant of Student's t density in three dimensions, and of the normal densities.
    normalised = gammaln(degrees / 2) + 1.5 * np.log(degrees * np.pi) - gammaln(degrees / 2 + 1.5)
    normalised -= (3 + data["time"].shape[1]) / 2 * np.log(2 * np.pi)

    def log_l(v: dict[str, Any]) -> Any:
        total = np.zeros(len(v["error"]))
        sds = np.stack([v[f"sd_{n}"] for n in names])
        means = np.stack([v[f"log_{n}"] for n in names])
        ones = np.ones_like(v["error"])
        for i, of_subject in enumerate(features):
            m = means + np.array([[0], [0], [log_weight[i]]]) * v["beta"]
            rows = [*(-0.5 / sds**2), *(m / sds**2), -0.5 / v["error"] ** 2, ones]
            logs = exact.log_sum(np.stack(rows, axis=1) @ of_subject)
            total += logs - (0.5 * (m / sds) ** 2 + np.log(sds)).sum(axis=0)
            total += normalised - data["time"].shape[1] * np.log(v["error"])
        return total

    return log_l


# -- log L at given hyperparameters, and inputs of the specimens -----------------------------------

# Concentrations of ten subjects at 0 and 1 h after a dose of 10 (Wang 2007).
_WANG = np.array(
    [
        10.68, 3.6837, 10.402, 6.454, 9.8814, 5.8565, 9.3408, 5.6209, 10.082, 6.7583,
        9.8938, 6.5049, 9.8908, 6.9557, 10.234, 6.4488, 9.9882, 6.7112, 9.6736, 6.6402,
    ]
).reshape(10, 2)  # fmt: skip
POPULATIONS = ((-0.7457, 0.2836), (np.log(0.5), 0.2), (np.log(0.5), 0.3), (np.log(0.6), 0.3),
               (np.log(0.5), 0.1))  # fmt: skip


def wang_log_likelihood(is_relative: bool, mu: float, sd: float, error: float) -> float:
    """Return log L of an exponential decay with lognormal rates, by the trapezoidal rule."""
    z = np.linspace(-14, 14, 28001)
    f = 10 * np.exp(-np.exp(mu + sd * z)[:, None] * np.array([0.0, 1.0]))
    scale = error * f if is_relative else np.full_like(f, error)
    logs = stats.norm.logpdf(_WANG[:, None], f, scale).sum(axis=2)
    logs = logs + stats.norm.logpdf(z) + np.log(z[1] - z[0])
    return float(exact.log_sum(logs).sum())


def wang_model(is_relative: bool, response: Response) -> tuple[pm.Model, Any]:
    """Return the model of the concentrations, and its observed variable."""
    with pm.Model() as model:
        mu, sd = pm.Normal("mu", np.log(0.5), 1), pm.HalfNormal("s", 0.5)
        metric = prb.LogLikelihood(error=pm.HalfNormal("e", 0.3), relative=is_relative)
        y = prb.Simulator("y", response, pm.LogNormal.dist(mu, sd), observed=_WANG, metric=metric)
    return model, y


def wang_response() -> Response:
    """Return the counted response."""
    formula = lambda xp, k: [10 + 0 * k, 10 * xp.exp(-k)]  # noqa: E731
    return Response(_problem({}, [], formula))


def accurate_readings(number: int) -> tuple[Any, ...]:
    """Return readings, map, mean and covariance of normal inputs with known population, and error."""
    if number < 5:
        seed, s, error = ((121, 1, 0.05), (122, 1, 0.05), (123, 1, 0.02), (124, 1, 0.1),
                          (125, 0.5, 0.1))[number]  # fmt: skip
        rng = np.random.default_rng(seed)
        y = (rng.normal(1, s, 20) + error * rng.normal(size=20))[:, None]
        return y, np.eye(1), np.ones(1), np.array([[float(s) ** 2]]), error
    rng, error = np.random.default_rng(5), (0.01, 0.03)[number - 5]
    h, p = np.array([[1.0, 1.0], [1.0, -1.0]]), np.diag([0.25, 0.09])
    y = rng.multivariate_normal([1, 0], p, 20) @ h.T + error * rng.normal(size=(20, 2))
    return y, h, np.array([1.0, 0.0]), p, error


def individuals_model(number: int, response: Callable[..., Any]) -> pm.Model:
    """Return the model of accurate readings; the population is known."""
    y, h, mean, covariance, error = accurate_readings(number)
    sd = np.sqrt(np.diag(covariance))
    with pm.Model() as model:
        mu = pm.Normal("mu", 0, 1e-3)
        shifts = [mu, *[0.0] * (len(mean) - 1)]
        inputs = [pm.Normal.dist(m + d, s) for m, d, s in zip(mean, shifts, sd, strict=True)]
        metric = prb.LogLikelihood(error=error)
        observed = y[:, 0] if len(h) == 1 else y
        prb.Simulator("y", response, *inputs, observed=observed, metric=metric)
    return model


def individuals_exact(number: int) -> tuple[Any, Any]:
    """Return means (N, d) and standard deviations (d,) of the inputs, by the conjugate normal."""
    y, h, mean, covariance, error = accurate_readings(number)
    prior = np.linalg.inv(covariance)
    posterior = np.linalg.inv(prior + h.T @ h / error**2)
    return (y @ h / error**2 + prior @ mean) @ posterior, np.sqrt(np.diag(posterior))
