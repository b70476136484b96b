r"""Log-densities of exponential families at fixed points, as a matrix product.

The log-density of S populations at n points is

.. math:: \log p(x_i \mid \theta_s) = \sum_k H_{sk} T_k(x_i), \qquad T_0 = 1,

where T are the sufficient statistics, and H the natural parameters and minus the log-normaliser.
H follows from the log-density at as many anchor points as there are statistics, so that PyMC's own
density serves every family.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pymc.distributions.continuous import TruncatedNormalRV
from pytensor.graph.basic import Constant
from pytensor.tensor.random import basic
from pytensor.tensor.variable import TensorVariable
from scipy.linalg import qr

from prbayes._checks import Floats
from prbayes._threads import one_thread
from prbayes.response.distributions import compiled_log_density, compiled_log_density_slopes
from prbayes.response.inputs import Inputs

Columns = list[Floats]


def _standardised(x: Floats) -> Floats:
    """Return values (n, ...) less their mean, in standard deviations."""
    spread = x.std(axis=0)
    spread = np.where(spread > 0, spread, 1.0)
    return np.asarray((x - x.mean(axis=0)) / spread)


def _quadratic(x: Floats) -> Columns:
    z = _standardised(x)
    return [z, z * z]


def _log_quadratic(x: Floats) -> Columns:
    return _quadratic(np.log(x))


def _gamma(x: Floats) -> Columns:
    return [_standardised(x), _standardised(np.log(x))]


def _inverse_gamma(x: Floats) -> Columns:
    return [_standardised(1 / x), _standardised(np.log(x))]


def _beta(x: Floats) -> Columns:
    return [_standardised(np.log(x)), _standardised(np.log1p(-x))]


def _linear(x: Floats) -> Columns:
    return [_standardised(x)]


def _multivariate_normal(x: Floats) -> Columns:
    """Return statistics of vectors (n, d), first made uncorrelated."""
    centered = x - x.mean(axis=0)
    _, _, axes = np.linalg.svd(centered, full_matrices=False)
    z = _standardised(centered @ axes.T)
    first, second = np.triu_indices(z.shape[1])
    return [*z.T, *(z[:, first] * z[:, second]).T]


# Statistics of one element, beside the constant; supports do not depend on parameters.
_OF_ELEMENTS: dict[type, Callable[[Floats], Columns]] = {
    basic.NormalRV: _quadratic,
    basic.HalfNormalRV: _quadratic,
    TruncatedNormalRV: _quadratic,
    basic.LogNormalRV: _log_quadratic,
    basic.GammaRV: _gamma,
    basic.InvGammaRV: _inverse_gamma,
    basic.BetaRV: _beta,
    basic.ExponentialRV: _linear,
}


def sufficient_statistics(dist: TensorVariable, values: Floats) -> Floats | None:
    """Return sufficient statistics of a distribution at values.

    Parameters
    ----------
    dist : TensorVariable
        A PyMC distribution.
    values : ndarray, shape (n, *event)

    Returns
    -------
    ndarray, shape (q, n), or None
        Standardised, without the constant; None if the distribution is no exponential family with
        a fixed support.
    """
    op = dist.owner.op
    if isinstance(op, basic.MvNormalRV):
        return np.array(_multivariate_normal(values))
    statistics = _OF_ELEMENTS.get(type(op))
    if statistics is None:
        return None
    if isinstance(op, TruncatedNormalRV):
        _, _, *bounds = op.dist_params(dist.owner)
        if not all(isinstance(bound, Constant) for bound in bounds):
            return None
    elements = values.reshape(len(values), -1)
    with np.errstate(divide="ignore", invalid="ignore"):
        columns = [column for x in elements.T for column in statistics(x)]
    return np.array(columns)


@dataclass(frozen=True, eq=False)
class ExponentialForm:
    """Log-densities at fixed points as a matrix product.

    Attributes
    ----------
    statistics : ndarray, shape (q + 1, n)
        Sufficient statistics of all inputs, the last of which is the constant.
    anchors : tuple of ndarray, shapes (q + 1, *event)
        Points at which the log-density tells the natural parameters.
    inverse : ndarray, shape (q + 1, q + 1)
        Inverse of the statistics at the anchors.
    """

    statistics: Floats
    anchors: tuple[Floats, ...]
    inverse: Floats

    @classmethod
    def of(
        cls, dists: Sequence[TensorVariable], points: Sequence[Floats]
    ) -> ExponentialForm | None:
        """Return the form of independent inputs at points; None if they have none.

        Parameters
        ----------
        dists : sequence of TensorVariable
            The distributions of the inputs.
        points : sequence of ndarray, shapes (n, *event)
        """
        n = len(points[0])
        parts = []
        for dist, values in zip(dists, points, strict=True):
            part = sufficient_statistics(dist, values)
            if part is None:
                return None
            parts.append(part)
        statistics = np.concatenate([*parts, np.ones((1, n))])
        if not np.isfinite(statistics).all() or n < 2 * len(statistics):
            return None
        chosen = _anchors(statistics)
        at_anchors = statistics[:, chosen]
        # Points that coincide, or lie in a plane, determine no natural parameters.
        if np.linalg.cond(at_anchors) > 1e6:
            return None
        anchors = tuple(values[chosen] for values in points)
        return cls(statistics, anchors, np.linalg.inv(at_anchors))

    def natural_parameters(self, at_anchors: Floats) -> Floats:
        """Return H from log-densities at the anchors, (S, q + 1) -> (S, q + 1).

        Its last column is minus the log-normaliser.
        """
        with np.errstate(invalid="ignore"):
            return np.asarray(at_anchors @ self.inverse)

    def is_rounded(self, at_anchors: Floats) -> NDArray[np.bool_]:
        """Return which log-densities at points would be off by more than 1e-12, (S, q + 1) -> (S,).

        Those of populations far narrower than the points, or far from them, and of invalid ones:
        they are small differences of large numbers.
        """
        return ~(np.abs(at_anchors).max(axis=1) < 1000.0)

    def pulled_back(self, by_logs: Floats) -> Floats:
        """Return derivatives for log-densities at anchors from those at all points.

        (S, n) -> (S, q + 1)
        """
        by_parameters = (self.statistics @ by_logs.T).T
        return np.asarray(by_parameters @ self.inverse.T)


def _anchors(statistics: Floats) -> NDArray[np.intp]:
    """Return points whose statistics are far from dependent, (q + 1,), by pivoted QR.

    Among the half of the points near the middle: far away log-densities have larger roundings.
    """
    size, n = statistics.shape
    distance = (statistics**2).sum(axis=0)
    near = np.argsort(distance, kind="stable")[: n // 2]
    _, _, pivots = qr(statistics[:, near], mode="economic", pivoting=True)
    return np.asarray(near[pivots[:size]])


class PointDensity:
    """Log-densities of populations of some inputs at points: a matrix product, or PyMC's graph."""

    def __init__(self, inputs: Inputs) -> None:
        self.inputs = inputs
        # The last points with the form of their log-density.
        self._form: tuple[Any, ExponentialForm | None] = (None, None)

    @cached_property
    def _log_density(self) -> Any:
        return compiled_log_density(self.inputs)

    @cached_property
    def _slopes(self) -> Any:
        return compiled_log_density_slopes(self.inputs)

    def _form_of(self, points: Sequence[Floats]) -> ExponentialForm | None:
        """Return the log-density at points as a matrix product, if the inputs have that form."""
        first, form = self._form
        if first is not points[0]:
            form = ExponentialForm.of(self.inputs.aleatory, points)
            self._form = points[0], form
        return form

    def at(self, params: Sequence[Any], points: Sequence[Floats]) -> Callable[[slice], Floats]:
        """Return log p(x given theta), (k, n), as a function of which points are wanted.

        Parameters
        ----------
        params : sequence of ndarray, shapes (k, *shape)
            Values of the roots.
        points : sequence of ndarray, shapes (n, *event)
        """
        form = self._form_of(points)
        if form is None:

            def by_graph(some: slice) -> Floats:
                (logs,) = self._log_density(*params, *(x[some] for x in points))
                return np.array(logs)

            return by_graph

        (at_anchors,) = self._log_density(*params, *form.anchors)
        parameters = form.natural_parameters(at_anchors)
        rounded = form.is_rounded(at_anchors)
        narrow = [param[rounded] for param in params]

        def by_product(some: slice) -> Floats:
            # In one thread, so that the points of a design do not depend on the number of threads.
            with one_thread():
                logs = parameters @ form.statistics[:, some]
            if rounded.any():
                (logs[rounded],) = self._log_density(*narrow, *(x[some] for x in points))
            return np.asarray(logs)

        return by_product

    def pulled_back(
        self, params: Sequence[Any], by_logs: Floats, points: Sequence[Floats]
    ) -> list[Floats]:
        """Return derivatives for the roots from those for log-densities at points, (k, n)."""
        form = self._form_of(points)
        if form is None:
            return list(self._slopes(*params, by_logs, *points))
        return list(self._slopes(*params, form.pulled_back(by_logs), *form.anchors))


def normalise(logs: Floats) -> Floats:
    """Turn log weights, (S, n), into weights of sum one in place; return their log totals, (S,).

    Rows without weight become NaN.
    """
    largest = logs.max(axis=1, keepdims=True)
    largest = np.where(np.isfinite(largest), largest, 0.0)
    logs -= largest
    np.exp(logs, out=logs)
    totals = logs.sum(axis=1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        logs /= totals
        return np.asarray((np.log(totals) + largest)[:, 0])
