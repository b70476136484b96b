r"""Log-densities of populations at fixed points: a matrix product for exponential families.

The log-density of S populations at n points is

.. math:: \log p(x_i \mid \theta_s) = \sum_k H_{sk} T_k(x_i), \qquad T_0 = 1,

where T are the sufficient statistics, and H the natural parameters and minus the log-normaliser.
H follows from the log-density at as many anchor points as there are statistics: PyMC's own density
serves every family. Other inputs, and populations far narrower than their points, have PyMC's
log-density. The log-likelihood of a specimen is

    log p(y_i | theta) = logsumexp_k(log p(x_ik | theta) + A_ik).

Normal populations of specimens that are known by weighted points are fitted by EM.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pymc as pm
import pytensor.tensor as pt
from numpy.typing import NDArray
from scipy.linalg import qr

from prbayes._stats import log_sum_exp
from prbayes._validate import IN_CACHE, Floats
from prbayes.numerics.mixtures import normalised_weights
from prbayes.numerics.threads import one_thread
from prbayes.response.condition import is_condition
from prbayes.response.distributions import MVNORMAL, PopulationSampler, compiled_log_density
from prbayes.response.inputs import Inputs


def _non_negative(x: Floats) -> Floats:
    return np.where(x >= 0, x, np.nan)


# Coordinates of an element, (n,) -> (n,), not finite outside of the support, and whether their
# monomials of degree two are sufficient statistics as well. The supports do not depend on
# parameters; that of the truncated normal is in the graph.
_FAMILIES: dict[type, tuple[tuple[Callable[[Floats], Floats], ...], bool]] = {
    type(pm.Normal.rv_op): ((np.positive,), True),
    type(pm.HalfNormal.rv_op): ((_non_negative,), True),
    type(pm.TruncatedNormal.rv_op): ((np.positive,), True),
    type(pm.LogNormal.rv_op): ((np.log,), True),
    type(pm.Gamma.rv_op): ((np.positive, np.log), False),
    type(pm.InverseGamma.rv_op): ((np.reciprocal, np.log), False),
    type(pm.Beta.rv_op): ((np.log, lambda x: np.log1p(-x)), False),
    type(pm.Exponential.rv_op): ((_non_negative,), False),
}


def _coordinates(dist: pt.TensorVariable, values: Floats) -> list[tuple[Floats, bool]] | None:
    """Return coordinates (c, n) of each element, and if they are quadratic; None without a form."""
    if isinstance(dist.owner.op, MVNORMAL):
        return [(values.T, True)]
    if is_condition(dist):
        return []
    op = dist.owner.op
    if type(op) not in _FAMILIES:
        return None
    functions, is_quadratic = _FAMILIES[type(op)]
    if isinstance(op, type(pm.TruncatedNormal.rv_op)):
        _, _, lower, upper = op.dist_params(dist.owner)
        if not isinstance(lower, pt.TensorConstant) or not isinstance(upper, pt.TensorConstant):
            return None
        is_inside = (values >= lower.data) & (values <= upper.data)
        values = np.where(is_inside, values, np.nan)
    elements = values.reshape(len(values), -1).T
    with np.errstate(all="ignore"):
        return [(np.stack([u(x) for u in functions]), is_quadratic) for x in elements]


def _statistics(coordinates: Floats, is_quadratic: bool) -> Floats:
    """Return sufficient statistics of standardised coordinates, (c, n) -> (q, n)."""
    z = _standardised(coordinates)
    if not is_quadratic:
        return z
    if len(z) == 1:
        return np.concatenate([z, z * z])
    axes, _, _ = np.linalg.svd(z, full_matrices=False)
    z = _standardised(axes.T @ z)
    first, second = np.triu_indices(len(z))
    return np.concatenate([z, z[first] * z[second]])


def _standardised(values: Floats) -> Floats:
    """Return values (c, n) less their means, in standard deviations."""
    size = values.shape[1]
    centered = values - (values.sum(axis=1) / size)[:, None]
    spread = np.sqrt(np.vecdot(centered, centered) / size)
    spread[spread == 0] = 1.0
    return np.asarray(centered / spread[:, None])


@dataclass(frozen=True, eq=False)
class ExponentialForm:
    """Log-densities at n fixed points as a matrix product."""

    # (q + 1, n): sufficient statistics of all inputs, then the constant; zero outside the support
    statistics: Floats
    is_inside: NDArray[np.bool_]  # (n,): points of the support
    # (q + 1, *event): points at which the log-density determines the natural parameters
    anchors: tuple[Floats, ...]
    inverse: Floats  # (q + 1, q + 1): inverse of the statistics at the anchors

    @classmethod
    def of(
        cls, dists: Sequence[pt.TensorVariable], points: Sequence[Floats]
    ) -> ExponentialForm | None:
        """Return the form of independent inputs at points, (n, *event); None if they have none."""
        coordinates: list[tuple[Floats, bool]] = []
        for dist, values in zip(dists, points, strict=True):
            of_input = _coordinates(dist, values)
            if of_input is None:
                return None
            coordinates += of_input
        with np.errstate(invalid="ignore"):
            is_inside = np.isfinite(sum(u.sum(axis=0) for u, _ in coordinates))
        inside = np.flatnonzero(is_inside)
        if not inside.size:
            return None
        parts = [_statistics(u[:, inside], is_quadratic) for u, is_quadratic in coordinates]
        at_inside = np.concatenate([*parts, np.ones((1, inside.size))])
        size = len(at_inside)
        if inside.size < 2 * size:
            return None
        # Anchors far from dependent, by pivoted QR. Among the half of the points near the middle:
        # far away log-densities have larger roundings.
        distance = (at_inside**2).sum(axis=0)
        near = np.argsort(distance, kind="stable")[: inside.size // 2]
        _, _, order = qr(at_inside[:, near], mode="economic", pivoting=True)
        pivots = near[order[:size]]
        at_anchors = at_inside[:, pivots]
        # Points that coincide, or lie in a plane, determine no natural parameters.
        if np.linalg.cond(at_anchors) > 1e6:
            return None
        statistics = np.zeros((size, is_inside.size))
        statistics[:, inside] = at_inside
        anchors = tuple(values[inside[pivots]] for values in points)
        return cls(statistics, is_inside, anchors, np.linalg.inv(at_anchors))

    def natural_parameters(self, at_anchors: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        """Return H from log-densities at the anchors, (S, q + 1), and which rows are rounded, (S,).

        The last column of H is minus the log-normaliser. Log-densities at points would be off by
        more than 1e-12 in rounded rows, which are zero: they are small differences of large
        numbers, of populations far narrower than the points, or far from them, or invalid.
        """
        is_rounded = ~(np.abs(at_anchors).max(axis=1) < 1000.0)
        return np.where(is_rounded[:, None], 0.0, at_anchors) @ self.inverse, is_rounded


@dataclass(frozen=True, eq=False)
class WeightedPoints:
    """Points of N specimens, with the matrix form of log-densities there."""

    x: Sequence[Floats]  # (N, K, *event): by aleatory input
    log_a: Floats  # (N, K)
    # at the points in the order of (K, N): reductions are then sums of long rows
    form: ExponentialForm | None

    @classmethod
    def of(cls, inputs: Inputs, x: Sequence[Floats], log_a: Floats) -> WeightedPoints:
        """Return the points with their form, if they have one population, and the inputs a form."""
        if inputs.nested or not log_a.size:
            return cls(x, log_a, None)
        flat = [v.swapaxes(0, 1).reshape(log_a.size, *v.shape[2:]) for v in x]
        return cls(x, log_a, ExponentialForm.of(inputs.aleatory, flat))


@dataclass(eq=False)
class PopulationDensity:
    """Populations of some inputs, compiled once: log-densities and draws."""

    inputs: Inputs
    # The last points with the form of their log-density.
    _form: tuple[Any, ExponentialForm | None] = (None, None)

    @cached_property
    def _log_density(self) -> Any:
        return compiled_log_density(self.inputs)

    @cached_property
    def sampler(self) -> PopulationSampler:
        """Draws of specimens."""
        return PopulationSampler(self.inputs)

    def at(self, params: Sequence[Any], points: Sequence[Floats]) -> Callable[[slice], Floats]:
        """Return log p(x given theta), (k, n), as a function of the rows of points (n, *event)."""
        previous, form = self._form
        if previous is not points[0]:
            form = ExponentialForm.of(self.inputs.aleatory, points)
            # At an end of a support PyMC's density may be finite, or infinite.
            # Points of specimens with covariates have several populations.
            if form is not None and (self.inputs.covariates or not form.is_inside.all()):
                form = None
            self._form = points[0], form
        if form is not None:
            (at_anchors,) = self._log_density(*params, *form.anchors)
            natural, is_rounded = form.natural_parameters(at_anchors)
            narrow = [param[is_rounded] for param in params]

        def log_densities(rows: slice) -> Floats:
            if form is None:
                (logs,) = self._log_density(*params, *[x[rows] for x in points])
                return np.array(logs)
            # In one thread: the points of a design do not depend on the number of threads.
            with one_thread():
                logs = natural @ form.statistics[:, rows]
            if is_rounded.any():
                (logs[is_rounded],) = self._log_density(*narrow, *[x[rows] for x in points])
            return np.asarray(logs)

        return log_densities

    @one_thread()
    def log_likelihoods(self, parents: Sequence[Floats], points: WeightedPoints) -> Floats:
        """Return log p(y_i | theta), (S, N), of populations at parents, shapes (S, *shape).

        Covariates are those of the specimens, (S, N).
        """
        form, log_a = points.form, points.log_a
        n, count = log_a.shape
        if form is None:
            return self._by_graph(parents, points)
        if self.inputs.covariates and n > 1:
            logs = self.at_points(parents, points)
            return np.stack([log_sum_exp(of_draw + log_a) for of_draw in logs])
        at_each = self.inputs.for_points(parents, len(form.anchors[0]))
        with np.errstate(all="ignore"):
            (at_anchors,) = self._log_density(*at_each, *form.anchors)
        natural, is_rounded = form.natural_parameters(at_anchors)
        # A is a statistic whose parameter is one; -inf in a product may become NaN.
        base = np.where(form.is_inside, log_a.T.ravel(), -np.inf)
        terms = np.vstack([form.statistics, np.maximum(base, -1e300)]).T
        parameters = np.vstack([natural.T, np.ones(len(natural))])
        result = np.empty((n, len(natural)))
        step = max(64, IN_CACHE // 4 // log_a.size)
        rows = max(1, IN_CACHE // 4 // (step * n))
        for first in range(0, len(natural), step):
            block = parameters[:, first : first + step]
            total: Any = -np.inf
            for k in range(0, count, rows):
                exponents = terms[k * n : (k + rows) * n] @ block
                part = _log_sum_exp_first(exponents.reshape(-1, n, block.shape[1]))
                total = np.logaddexp(total, part) if k else part
            result[:, first : first + step] = total
        if is_rounded.any():
            narrow = [parent[is_rounded] for parent in parents]
            result[:, is_rounded] = self._by_graph(narrow, points).T
        return result.T

    def at_points(self, parents: Sequence[Floats], points: WeightedPoints) -> Iterator[Floats]:
        """Yield log p(x_ik | theta), (N, K), of each population, for numbers A of its own."""
        form, (n, count) = points.form, points.log_a.shape
        flat = [np.ascontiguousarray(v.reshape(n * count, *v.shape[2:])) for v in points.x]
        if form is not None:
            size, has_covariates = len(form.anchors[0]), bool(self.inputs.covariates) and n > 1
            anchors = [np.concatenate([v] * (n if has_covariates else 1)) for v in form.anchors]
            with np.errstate(all="ignore"):
                at_each = self.inputs.for_points(parents, size)
                (at_anchors,) = self._log_density(*at_each, *anchors)
            natural, is_rounded = form.natural_parameters(at_anchors.reshape(-1, size))
            natural = natural.reshape(len(parents[0]), -1, size, 1)
            is_rounded = is_rounded.reshape(len(parents[0]), -1).any(axis=1)
            statistics = np.ascontiguousarray(form.statistics.reshape(-1, count, n).T)
            is_outside = ~form.is_inside.reshape(count, n).T
        for s in range(len(parents[0])):
            if form is None or is_rounded[s]:
                of_draw = self.inputs.for_points([p[s : s + 1] for p in parents], count)
                with np.errstate(all="ignore"):
                    (logs,) = self._log_density(*of_draw, *flat)
                yield np.where(np.isnan(logs), -np.inf, logs).reshape(n, count)
                continue
            logs = (statistics @ natural[s])[..., 0]
            logs[is_outside] = -np.inf
            yield logs

    def _by_graph(self, parents: Sequence[Floats], points: WeightedPoints) -> Floats:
        """Return log-likelihoods by the compiled log-density."""
        log_a = points.log_a
        n, count = log_a.shape
        result = np.full((len(parents[0]), n), -np.inf)
        if not log_a.size:
            return result
        flat = [np.ascontiguousarray(v.reshape(n * count, *v.shape[2:])) for v in points.x]
        step = max(1, IN_CACHE // log_a.size)
        for first in range(0, len(result), step):
            block = slice(first, first + step)
            of_block = self.inputs.for_points([parent[block] for parent in parents], count)
            with np.errstate(all="ignore"):
                (logs,) = self._log_density(*of_block, *flat)
            logs = np.where(np.isnan(logs), -np.inf, logs)
            result[block] = log_sum_exp(logs.reshape(-1, n, count) + log_a)
        return result


def _log_sum_exp_first(exponents: Floats) -> Floats:
    """Return the log of the sum of exponentials over the first axis; exponents are overwritten."""
    largest = exponents.max(axis=0)
    exponents -= largest
    np.exp(exponents, out=exponents)
    total = np.log(exponents.sum(axis=0)) + largest
    return np.where(largest < -1e299, -np.inf, total)


def normalise(logs: Floats) -> Floats:
    """Turn log weights, (S, n), into weights in place, NaN without any; return log totals, (S,)."""
    largest = logs.max(axis=1, keepdims=True)
    largest = np.where(np.isfinite(largest), largest, 0.0)
    logs -= largest
    np.exp(logs, out=logs)
    totals = logs.sum(axis=1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        logs /= totals
        return np.asarray((np.log(totals) + largest)[:, 0])


type Normal = tuple[Floats, Floats]  # mean (d,) and lower Cholesky factor of the covariance (d, d)


def fit_normal(z: Floats, log_a: Floats, start: Any = None) -> Normal:
    """Fit a normal population by EM to specimens with likelihood terms exp(log p(z) + log_a).

    With a population as the start, five steps are taken.
    """
    columns = np.ascontiguousarray(z.reshape(-1, z.shape[-1]).T)
    prior = 1e-12 * np.diag(np.maximum(columns.var(axis=1), 1e-300))

    def moments(weights: Floats) -> tuple[Floats, Floats]:
        flat = weights.ravel() / len(weights)
        mean = columns @ flat
        centred = columns - mean[:, None]
        return mean, (centred * flat) @ centred.T + prior

    if start is None:
        mean, covariance = moments(normalised_weights(log_a))
    else:
        mean, covariance = start.mean, start.root @ start.root.T
    for _ in range(30 if start is None else 5):
        log_w = normal_log_density(z, mean, np.linalg.cholesky(covariance)) + log_a
        previous_mean, previous_covariance = mean, covariance
        mean, covariance = moments(normalised_weights(log_w))
        variance = np.diag(covariance)
        change = np.diag(covariance - previous_covariance) / variance
        shift = (mean - previous_mean) / np.sqrt(variance)
        if max(np.abs(change).max(), np.abs(shift).max()) < 1e-9:
            break
    return mean, np.linalg.cholesky(covariance)


def normal_log_density(z: Floats, mean: Floats, root: Floats) -> Floats:
    """Return log-densities of points (..., d) in a normal population, (...)."""
    d = z.shape[-1]
    centred = np.ascontiguousarray(z.reshape(-1, d).T) - mean[:, None]
    square = np.square(np.linalg.inv(root) @ centred).sum(axis=0)
    constant = np.log(np.diag(root)).sum() + d / 2 * np.log(2 * np.pi)
    return np.asarray(-0.5 * square - constant).reshape(z.shape[:-1])
