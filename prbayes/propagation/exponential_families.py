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
import pymc as pm
import pytensor.tensor as pt
from numpy.typing import NDArray
from scipy.linalg import qr

from prbayes._validate import Floats
from prbayes.numerics.threads import one_thread
from prbayes.response.distributions import (
    compiled_log_density,
    is_mvnormal,
)
from prbayes.response.inputs import Inputs


@dataclass(frozen=True)
class Family:
    """FamilyCoordinates of an element, which are the sufficient statistics, or whose monomials are.

    Attributes
    ----------
    coordinates : tuple of callable
        (n,) -> (n,), not finite outside of the support.
    is_quadratic : bool
        Whether monomials of degree two are statistics as well.
    """

    coordinates: tuple[Callable[[Floats], Floats], ...]
    is_quadratic: bool = False


def _non_negative(x: Floats) -> Floats:
    return np.where(x >= 0, x, np.nan)


def _log_of_rest(x: Floats) -> Floats:
    return np.asarray(np.log1p(-x))


# Their supports do not depend on parameters; that of the truncated normal is in the graph.
FAMILIES = {
    type(pm.Normal.rv_op): Family((np.positive,), is_quadratic=True),
    type(pm.HalfNormal.rv_op): Family((_non_negative,), is_quadratic=True),
    type(pm.TruncatedNormal.rv_op): Family((np.positive,), is_quadratic=True),
    type(pm.LogNormal.rv_op): Family((np.log,), is_quadratic=True),
    type(pm.Gamma.rv_op): Family((np.positive, np.log)),
    type(pm.InverseGamma.rv_op): Family((np.reciprocal, np.log)),
    type(pm.Beta.rv_op): Family((np.log, _log_of_rest)),
    type(pm.Exponential.rv_op): Family((_non_negative,)),
}


@dataclass(frozen=True, eq=False)
class FamilyCoordinates:
    """FamilyCoordinates of an element of an input, or of a multivariate normal, at points.

    Attributes
    ----------
    values : ndarray, shape (c, n)
        Not finite outside of the support.
    is_quadratic : bool
        Whether monomials of degree two are sufficient statistics as well.
    """

    values: Floats
    is_quadratic: bool

    def statistics(self) -> Floats:
        """Return sufficient statistics of standardised coordinates, (q, n)."""
        z = _standardised(self.values)
        if not self.is_quadratic:
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


def coordinates_of(dist: pt.TensorVariable, values: Floats) -> list[FamilyCoordinates] | None:
    """Return the coordinates of all elements of an input at points.

    Parameters
    ----------
    dist : TensorVariable
        A PyMC distribution.
    values : ndarray, shape (n, *event)

    Returns
    -------
    list of FamilyCoordinates, or None
        None if the distribution is no exponential family with a fixed support.
    """
    if is_mvnormal(dist):
        return [FamilyCoordinates(values.T, is_quadratic=True)]
    op = dist.owner.op
    family = FAMILIES.get(type(op))
    if family is None:
        return None
    if isinstance(op, type(pm.TruncatedNormal.rv_op)):
        _, _, lower, upper = op.dist_params(dist.owner)
        if not isinstance(lower, pt.TensorConstant) or not isinstance(upper, pt.TensorConstant):
            return None
        is_inside = (values >= lower.data) & (values <= upper.data)
        values = np.where(is_inside, values, np.nan)
    elements = values.reshape(len(values), -1).T
    with np.errstate(all="ignore"):
        stacked = [np.stack([u(x) for u in family.coordinates]) for x in elements]
    return [FamilyCoordinates(u, family.is_quadratic) for u in stacked]


@dataclass(frozen=True, eq=False)
class ExponentialForm:
    """Log-densities at fixed points as a matrix product.

    Attributes
    ----------
    statistics : ndarray, shape (q + 1, n)
        Sufficient statistics of all inputs, the last of which is the constant; zero outside of the
        support.
    is_inside : ndarray of bool, shape (n,)
        Points of the support.
    anchors : tuple of ndarray, shapes (q + 1, *event)
        Points at which the log-density determines the natural parameters.
    inverse : ndarray, shape (q + 1, q + 1)
        Inverse of the statistics at the anchors.
    """

    statistics: Floats
    is_inside: NDArray[np.bool_]
    anchors: tuple[Floats, ...]
    inverse: Floats

    @classmethod
    def of(
        cls, dists: Sequence[pt.TensorVariable], points: Sequence[Floats]
    ) -> ExponentialForm | None:
        """Return the form of independent inputs at points; None if they have none.

        Parameters
        ----------
        dists : sequence of TensorVariable
            The distributions of the inputs.
        points : sequence of ndarray, shapes (n, *event)
        """
        coordinates: list[FamilyCoordinates] = []
        for dist, values in zip(dists, points, strict=True):
            of_input = coordinates_of(dist, values)
            if of_input is None:
                return None
            coordinates += of_input
        with np.errstate(invalid="ignore"):
            is_inside = np.isfinite(sum(u.values.sum(axis=0) for u in coordinates))
        inside = np.flatnonzero(is_inside)
        if not inside.size:
            return None
        parts = [
            FamilyCoordinates(u.values[:, inside], u.is_quadratic).statistics() for u in coordinates
        ]
        at_inside = np.concatenate([*parts, np.ones((1, inside.size))])
        if inside.size < 2 * len(at_inside):
            return None
        pivots = _anchors(at_inside)
        at_anchors = at_inside[:, pivots]
        # Points that coincide, or lie in a plane, determine no natural parameters.
        if np.linalg.cond(at_anchors) > 1e6:
            return None
        statistics = np.zeros((len(at_inside), is_inside.size))
        statistics[:, inside] = at_inside
        anchors = tuple(values[inside[pivots]] for values in points)
        return cls(statistics, is_inside, anchors, np.linalg.inv(at_anchors))

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

    def _form_of(self, points: Sequence[Floats]) -> ExponentialForm | None:
        """Return the log-density at points as a matrix product, if the inputs have that form."""
        first, form = self._form
        if first is not points[0]:
            form = ExponentialForm.of(self.inputs.aleatory, points)
            # At an end of a support PyMC's density may be finite, or infinite.
            if form is not None and not form.is_inside.all():
                form = None
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
