"""Bias and coverage of the measurement arguments of the log-likelihood by specimen.

For each argument (``error``, ``relative``, ``gross_errors``, ``censored``, ``rounded``) hyperparameters,
specimens and contamination are drawn from their priors. The posterior is compared with the exact one
of the same model: a quadrature over the input whose weights are integrals of the population, or
preimages of the readings where these have no error. Both are sampled as in `likelihood_coverage`. All
data sets of an argument share the first runs.

    uv run python -m benchmarks.readings_coverage [--data-sets 100]
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import pymc as pm
import pytensor.tensor as pt
from scipy.special import logsumexp, ndtr

import prbayes as prb
from benchmarks.likelihood_coverage import (
    Functions,
    Problem,
    figures_of,
    likelihood_of,
    posterior,
    summary,
    thetas_of,
)
from benchmarks.scoreboard.problem import Input, Prior, half_normal, normal, truncated
from benchmarks.study import Study
from prbayes.model.measurement import SpecimenLikelihood
from prbayes.model.specimen_likelihood import log_likelihood_graph
from prbayes.model.specimen_preparation import prepared

SIZE = 20
_AT_ONCE = 4_000_000  # numbers of an array
_POINTS = 1024  # of the importance sampling
_INPUT = (Input("normal", "mu", "sigma"),)
_MONOTONE = {"mu": normal(0.0, 1.0), "sigma": half_normal(0.5)}
_FOLDED = {"mu": truncated(2.0, 1.0, low=1.0), "sigma": half_normal(1.0)}


@dataclass(frozen=True)
class Response:
    """A response of one input, and its preimages."""

    formula: Callable[[Any], Any]
    # Values (N,) -> inputs by branch (N, R); values below the range have the input of its end.
    branches: Callable[[Any], Any]
    priors: dict[str, Prior]


MONOTONE = Response(
    lambda x: np.exp(0.5 * x),
    lambda y: 2 * np.log(np.maximum(y, 1e-300))[:, None],
    _MONOTONE,
)
FOLDED = Response(
    lambda x: (x - 1) ** 2,
    lambda y: 1 + np.sqrt(np.maximum(y, 0.0))[:, None] * np.array([-1.0, 1.0]),
    _FOLDED,
)


@dataclass(frozen=True)
class Case:
    """A response and how it is measured; a string names a hyperparameter."""

    name: str
    response: Response
    error: Any = None  # number, (N,), or "error"
    relative: bool = False
    gross_errors: str | None = None
    censored: tuple[Any, Any] | None = None
    rounded: float | None = None
    repeats: int = 1  # readings of each specimen
    extra: tuple[tuple[str, Prior], ...] = ()  # hyperparameters of the measurement

    @property
    def problem(self) -> Problem:
        """The population and the response."""
        return Problem(
            name=self.name, size=SIZE, priors=self.response.priors | dict(self.extra), inputs=_INPUT,
            formula=self._formula,
        )  # fmt: skip

    def _formula(self, xp: Any, x: Any) -> Any:
        outputs = self.response.formula(x)
        return outputs if self.repeats == 1 else [outputs] * self.repeats

    def measurement(self, values: dict[str, Any]) -> dict[str, Any]:
        """Return the arguments of `prb.LogLikelihood`, with model variables by name."""
        given = {
            "error": self.error, "relative": self.relative, "gross_errors": self.gross_errors,
            "censored": self.censored, "rounded": self.rounded,
        }  # fmt: skip
        named = {k: values[v] if isinstance(v, str) else v for k, v in given.items()}
        return {name: value for name, value in named.items() if value is not None}


ERROR = ("error", truncated(0.1, 0.05, low=0.02))
CASES = {
    case.name: case
    for case in (
        Case("error", MONOTONE, error=0.1),
        Case("error, folded", FOLDED, error=0.3),
        Case("error by reading", MONOTONE, error=tuple(np.geomspace(0.03, 0.3, SIZE))),
        Case("error estimated", MONOTONE, error="error", repeats=2, extra=(ERROR,)),
        Case("relative error", MONOTONE, error=0.1, relative=True),
        Case(
            "relative error estimated", MONOTONE, error="error", relative=True, repeats=2,
            extra=(ERROR,),
        ),
        Case("gross errors", MONOTONE, gross_errors="w", extra=(("w", Prior("beta", (1.0, 9.0))),)),
        Case(
            "gross errors, folded", FOLDED, gross_errors="w",
            extra=(("w", Prior("beta", (1.0, 9.0))),),
        ),
        Case("right-censored", MONOTONE, censored=(None, 2.0)),
        Case(
            "censored at both sides, by reading, with error", MONOTONE, error=0.1,
            censored=(tuple(np.linspace(0.4, 0.8, SIZE)), tuple(np.linspace(2.0, 1.2, SIZE))),
        ),
        Case("rounded, folded", FOLDED, rounded=0.5),
        Case("rounded, with error", MONOTONE, error=0.1, rounded=0.3),
    )
}  # fmt: skip


# -- data --------------------------------------------------------------------------------------------


def readings(case: Case, x: Any, values: dict[str, float], rng: np.random.Generator) -> Any:
    """Return readings of specimens, (N, repeats)."""
    y = np.repeat(case.response.formula(x)[:, None], case.repeats, axis=1)
    sd = values[case.error] if isinstance(case.error, str) else case.error
    if sd is not None:
        sd = np.broadcast_to(np.reshape(sd, (-1, 1)), y.shape)
        y = y + (sd * np.abs(y) if case.relative else sd) * rng.standard_normal(y.shape)
    if case.rounded is not None:
        y = np.round(y / case.rounded) * case.rounded
    if case.censored is not None:
        low, high = (np.reshape(limit, (-1, 1)) for limit in _limits(case))
        y = np.clip(y, low, high)
    if case.gross_errors is not None:
        least, most = y.min(axis=0), y.max(axis=0)
        anywhere = (least + most) / 2 + (most - least) * (2 * rng.random(y.shape) - 1)
        y = np.where(rng.random((len(y), 1)) < values[case.gross_errors], anywhere, y)
    return y


def _limits(case: Case) -> tuple[Any, Any]:
    """Return lower and upper limits, infinite where there are none."""
    assert case.censored is not None
    low, high = case.censored
    return -np.inf if low is None else np.array(low), np.inf if high is None else np.array(high)


# -- exact log-likelihood ----------------------------------------------------------------------------


def _ends(case: Case, y: Any) -> tuple[Any, Any]:
    """Return the ends of what readings (N,) say of the output before rounding and censoring."""
    half = (case.rounded or 0.0) / 2
    low, high = y - half, y + half
    if case.censored is not None:
        lower, upper = _limits(case)
        low = np.where(y <= lower, -np.inf, np.where(y >= upper, upper, low))
        high = np.where(y >= upper, np.inf, np.where(y <= lower, lower, high))
    return low, high


def _preimages(case: Case, y: Any) -> Functions:
    """Return the likelihoods (S, N) of readings (N,) without error."""
    low, high = _ends(case, y)
    left, right = case.response.branches(low), case.response.branches(high)
    step = 1e-6 * np.maximum(np.abs(left), 1.0)
    slope = (case.response.formula(left + step) - case.response.formula(left - step)) / (2 * step)
    has_root = y > 0
    is_point = (low == high)[:, None]

    def function(theta: Any) -> Any:
        mu, sigma = theta[:, 0, None, None], theta[:, 1, None, None]
        a, b = (left - mu) / sigma, (right - mu) / sigma
        with np.errstate(divide="ignore", invalid="ignore"):
            density = np.exp(-0.5 * a**2) / np.sqrt(2 * np.pi) / sigma / np.abs(slope)
        upper = a + b > 0  # in the upper tail both ends are mirrored
        inside = np.abs(ndtr(np.where(upper, -a, a)) - ndtr(np.where(upper, -b, b)))
        terms = np.where(is_point, np.where(has_root[:, None], density, 0.0), inside)
        return terms.sum(axis=2)

    return function


def _quadrature(case: Case, y: Any) -> Functions:
    """Return the likelihoods (S, N) of readings (N, m) with an error."""
    sizes = np.array([0.02]) if isinstance(case.error, str) else np.ravel(case.error)
    nodes = _nodes(case, y, float(sizes.min()), float(sizes.max()))
    outputs = case.response.formula(nodes)[:, None]

    def densities(error: Any) -> Any:
        """Return densities of specimens at the nodes, (Q, N)."""
        result = np.ones((len(nodes), len(y)))
        sd = error * np.abs(outputs) if case.relative else np.broadcast_to(error, (1, len(y)))
        for column in y.T:
            low, high = _ends(case, column)
            a, b = (low - outputs) / sd, (high - outputs) / sd
            upper = a + b > 0
            inside = np.abs(ndtr(np.where(upper, -a, a)) - ndtr(np.where(upper, -b, b)))
            with np.errstate(invalid="ignore"):
                point = np.exp(-0.5 * a**2) / np.sqrt(2 * np.pi) / sd
            result *= np.where(low == high, point, inside)
        return result

    if not isinstance(case.error, str):
        at_nodes = densities(np.ravel(case.error))
        return lambda theta: _integrals(nodes, theta) @ at_nodes
    # An error that varies: cubic interpolation between levels of its logarithm.
    width = 0.15
    log_levels = np.arange(np.log(0.02) - 2 * width, np.log(0.6) + 3 * width, width)
    at_levels = [densities(np.exp(level)) for level in log_levels]

    def function(theta: Any) -> Any:
        position = (np.log(theta[:, 2]) - log_levels[0]) / width
        first = np.clip(np.floor(position).astype(int) - 1, 0, len(log_levels) - 4)
        t = position - first
        integrals = _integrals(nodes, theta)
        logs = np.zeros((len(theta), len(y)))
        for k in range(4):
            others = [j for j in range(4) if j != k]
            factor = np.prod([(t - j) / (k - j) for j in others], axis=0)
            for level in np.unique(first + k):
                rows = first + k == level
                with np.errstate(divide="ignore"):
                    at_level = np.log(np.maximum(integrals[rows] @ at_levels[level], 1e-300))
                logs[rows] += factor[rows, None] * at_level
        return np.exp(logs)

    return function


def _nodes(case: Case, y: Any, smallest: float, largest: float) -> Any:
    """Return nodes of the input, dense where densities of readings vary."""
    fine = np.linspace(-12.0, 12.0, 100_001)
    output = case.response.formula(fine)
    factor = np.abs(output) if case.relative else np.ones_like(output)
    margin = 8 * largest * factor
    varies = (output > y.min() - 1.0 - margin) & (output < y.max() + 1.0 + margin)
    rate = np.where(varies, 8 * np.abs(np.gradient(output, fine)) / (smallest * factor), 0.0) + 20.0
    count = np.concatenate([[0.0], np.cumsum((rate[1:] + rate[:-1]) / 2 * np.diff(fine))])
    return np.interp(np.arange(0.0, count[-1]), count, fine)


def _integrals(nodes: Any, theta: Any) -> Any:
    """Return integrals of the population times the hat function of each node, (S, Q)."""
    mu, sigma = theta[:, :1], theta[:, 1:2]
    z = (nodes - mu) / sigma
    mass = np.diff(ndtr(z), axis=1)
    moment = mu * mass - sigma * np.diff(np.exp(-0.5 * z**2), axis=1) / np.sqrt(2 * np.pi)
    right = (moment - nodes[:-1] * mass) / np.diff(nodes)
    result = np.zeros(z.shape)
    result[:, :-1] += mass - right
    result[:, 1:] += right
    return np.maximum(result, 0.0)


def exact_log_likelihood(case: Case, y: Any) -> Functions:
    """Return the exact log-likelihood (S,) of populations (S, q) from readings (N, m)."""
    likelihoods = _preimages(case, y[:, 0]) if case.error is None else _quadrature(case, y)

    def function(theta: Any) -> Any:
        values = likelihoods(theta)
        if case.gross_errors is not None:
            share = theta[:, -1:]
            values = (1 - share) * values + share / (2 * np.ptp(y))
        with np.errstate(divide="ignore"):
            return np.log(values).sum(axis=1)

    return lambda theta: np.concatenate(
        [function(t) for t in np.array_split(theta, _blocks(theta))]
    )


def _blocks(theta: Any, size: int = 2000) -> int:
    return max(1, len(theta) * size // _AT_ONCE)


# -- log-likelihood of the package -------------------------------------------------------------------


def log_likelihood(likelihood: SpecimenLikelihood) -> Functions:
    """Return the log-likelihood (S,) of populations (S, q) from the points, in NumPy."""
    points = prepared(likelihood).points
    x = likelihood.coordinates.inputs(points.z)[0]
    (measurement,) = likelihood.measurements
    estimated = not likelihood.error_is_known
    log_a = -points.log_proposal if estimated else points.log_a
    log_a = log_a + likelihood.coordinates.log_jacobian(points.z)
    outputs = np.where(np.isfinite(points.outputs), points.outputs, 1e30)
    size = np.abs(outputs) if measurement.metric.relative else 1.0

    def function(theta: Any) -> Any:
        mu, sigma = theta[:, 0, None, None], theta[:, 1, None, None]
        terms = log_a - 0.5 * ((x - mu) / sigma) ** 2 - np.log(sigma) - 0.5 * np.log(2 * np.pi)
        if estimated:
            sd = theta[:, 2, None, None, None] * size
            variance = prepared(likelihood).emulation.error ** 2 + sd**2
            terms = terms + likelihood.readings.symbolic_log_density(outputs, variance, np)
        values = logsumexp(terms, axis=2)
        if "gross_errors" in measurement.extras:
            share = theta[:, -1:]
            gross = np.log(share) + likelihood.stacked.log_gross
            values = np.logaddexp(np.log1p(-share) + values, gross)
        return values.sum(axis=1)

    def in_blocks(theta: Any) -> Any:
        blocks = _blocks(theta, log_a.size * (outputs.shape[2] if estimated else 1))
        return np.concatenate([function(t) for t in np.array_split(theta, blocks)])

    return in_blocks


def check(case: Case, likelihood: SpecimenLikelihood, function: Functions, theta: Any) -> None:
    """Raise if the log-likelihood in NumPy differs from the graph of the package."""
    values = dict(zip(case.problem.priors, theta, strict=True))
    params = {v: pt.as_tensor(values[str(v.name)]) for v in likelihood.variables()}
    expected = log_likelihood_graph(likelihood, params).sum().eval()
    np.testing.assert_allclose(function(theta[None]), expected, rtol=1e-8)


# -- data sets ---------------------------------------------------------------------------------------


def data_set(case: Case, likelihood: SpecimenLikelihood, number: int) -> dict[str, Any]:
    """Return both posteriors of a data set: moments, and the distribution function at the truth."""
    problem = case.problem
    rng = np.random.default_rng([10, list(CASES).index(case.name), number])
    start = rng.standard_normal(len(problem.priors))
    truth = thetas_of(problem, start[None])[0]
    values = dict(zip(problem.priors, truth, strict=True))
    x = values["mu"] + values["sigma"] * rng.standard_normal(SIZE)
    y = readings(case, x, values, rng)
    row: dict[str, Any] = {"number": number, "truth": values}
    (measurement,) = likelihood.measurements
    other = likelihood.observing({measurement.name: y if case.repeats > 1 else y[:, 0]})
    # Coordinates are those of the prior, whatever the data.
    other.__dict__["coordinates"] = likelihood.coordinates
    try:
        row["points"] = prepared(other).points.z.shape[1]
    except prb.propagation.DesignError as error:
        return row | {"error": str(error)}
    row["runs"] = len(prepared(other).emulation.z)
    functions = {"prbayes": log_likelihood(other), "exact": exact_log_likelihood(case, y)}
    if number == 0:
        check(case, other, functions["prbayes"], truth)
    return row | figures_of_both(problem, functions["exact"], functions["prbayes"], start)


def figures_of_both(
    problem: Problem, exact: Functions, by_package: Functions, start: Any
) -> dict[str, Any]:
    """Return figures of both posteriors, on the same points unless these are too different."""
    u, weights, k = posterior(problem, exact, start, _POINTS)
    theta = thetas_of(problem, u)
    with np.errstate(divide="ignore", invalid="ignore"):
        logs = np.log(weights) + by_package(theta) - exact(theta)
    logs = np.where(weights > 0, logs, -np.inf)
    reweighted = np.exp(logs - logsumexp(logs))
    results = {"exact": (u, weights, k), "prbayes": (u, reweighted, k)}
    if 1 / (reweighted**2).sum() < 0.2 * _POINTS:
        results["prbayes"] = posterior(problem, by_package, start, _POINTS)
    return {
        name: figures_of(problem, u, weights, start, thetas_of(problem, u)) | {"k": k}
        for name, (u, weights, k) in results.items()
    }


def table(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the summary of `likelihood_coverage`, with the mean bias and its standard error."""
    good = [row for row in rows if "error" not in row]
    means = {name: np.array([row[name]["mean"] for row in good]) for name in ("prbayes", "exact")}
    off = (means["prbayes"] - means["exact"]) / np.array([row["exact"]["sd"] for row in good])
    error = off.std(axis=0, ddof=1) / np.sqrt(len(off))
    bias = {"bias": off.mean(axis=0).tolist(), "error of bias": error.tolist()}
    return summary(rows) | bias


def row(name: str, number: int) -> dict[str, Any]:
    """Return the row of a data set."""
    return data_set(CASES[name], base_likelihood(name)[1], number)


@cache
def base_likelihood(name: str) -> tuple[pm.Model, SpecimenLikelihood]:
    """Return a model with the likelihood of a case, whose first runs serve all data sets."""
    return likelihood_of(CASES[name].problem, CASES[name].measurement)


STUDY = Study("readings_coverage", __doc__, CASES, row, 100, table, has_rows=False)

if __name__ == "__main__":
    STUDY.main()
