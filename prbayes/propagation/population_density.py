r"""Log-densities of populations at fixed points: a matrix product for exponential families.

The log-density of S populations at n points is

.. math:: \log p(x_i \mid \theta_s) = \sum_k H_{sk} T_k(x_i), \qquad T_0 = 1,

where T are the sufficient statistics, and H the natural parameters and minus the log-normaliser.
H follows from the log-density at as many anchor points as there are statistics: PyMC's own density
serves every family. Other inputs, and populations far narrower than their points, have PyMC's
log-density.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pymc as pm
import pytensor.tensor as pt
from scipy.linalg import qr

from prbayes._validate import ArrayFunction, Bools, Floats
from prbayes.numerics.threads import one_thread
from prbayes.response.condition import is_condition
from prbayes.response.distributions import MVNORMAL, PopulationSampler, compiled_log_density
from prbayes.response.inputs import Inputs


def _non_negative(x: Floats) -> Floats:
    return np.where(x >= 0, x, np.nan)


# Sufficient statistics of each family, as functions of an element, (n,) -> (n,), and whether
# products of these functions are sufficient statistics as well. A function is not finite outside of
# the support, if the support does not depend on parameters. That of the truncated normal does: the
# graph of the density contains it.
_FAMILIES: dict[type, tuple[tuple[ArrayFunction, ...], bool]] = {
    type(pm.Normal.rv_op): ((np.positive,), True),
    type(pm.HalfNormal.rv_op): ((_non_negative,), True),
    type(pm.TruncatedNormal.rv_op): ((np.positive,), True),
    type(pm.LogNormal.rv_op): ((np.log,), True),
    type(pm.Gamma.rv_op): ((np.positive, np.log), False),
    type(pm.InverseGamma.rv_op): ((np.reciprocal, np.log), False),
    type(pm.Beta.rv_op): ((np.log, lambda x: np.log1p(-x)), False),
    type(pm.Exponential.rv_op): ((_non_negative,), False),
}


def _family_coordinates(
    dist: pt.TensorVariable, values: Floats
) -> list[tuple[Floats, bool]] | None:
    """Return coordinates (c, n) of each element, and whether products are sufficient statistics.

    Returns None if the distribution is of no known exponential family.
    """
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
    """Return values (c, n) after subtraction of their means, in standard deviations."""
    size = values.shape[1]
    centered = values - (values.sum(axis=1) / size)[:, None]
    spread = np.sqrt(np.vecdot(centered, centered) / size)
    spread[spread == 0] = 1.0
    return np.asarray(centered / spread[:, None])


@dataclass(frozen=True, eq=False)
class ExponentialForm:
    """Log-densities at n fixed points as a matrix product."""

    # (q + 1, n): sufficient statistics of all inputs, then ones; zero outside of the support
    statistics: Floats
    is_inside: Bools  # (n,): whether a point is in the support
    # (q + 1, *event): points whose log-densities determine the natural parameters
    anchors: tuple[Floats, ...]
    inverse: Floats  # (q + 1, q + 1): inverse of the statistics at the anchors

    @classmethod
    def of(
        cls, dists: Sequence[pt.TensorVariable], points: Sequence[Floats]
    ) -> ExponentialForm | None:
        """Return the form of independent inputs at points, (n, *event); None if they have none."""
        coordinates: list[tuple[Floats, bool]] = []
        for dist, values in zip(dists, points, strict=True):
            of_input = _family_coordinates(dist, values)
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
        # Pivoted QR selects anchors whose statistics are nearly orthogonal. Only the half of the
        # points nearest to the centre is eligible, because log-densities far away have larger
        # rounding errors.
        distance = (at_inside**2).sum(axis=0)
        near = np.argsort(distance, kind="stable")[: inside.size // 2]
        _, _, order = qr(at_inside[:, near], mode="economic", pivoting=True)
        pivots = near[order[:size]]
        at_anchors = at_inside[:, pivots]
        # Points that coincide, or that lie in a plane, do not determine the natural parameters.
        if np.linalg.cond(at_anchors) > 1e6:
            return None
        statistics = np.zeros((size, is_inside.size))
        statistics[:, inside] = at_inside
        anchors = tuple(values[inside[pivots]] for values in points)
        return cls(statistics, is_inside, anchors, np.linalg.inv(at_anchors))

    def natural_parameters(
        self, at_anchors: Floats, largest: float = 1000.0
    ) -> tuple[Floats, Bools]:
        """Return H from log-densities at the anchors, (S, q + 1), and which rows are rounded, (S,).

        The last column of H is minus the log-normaliser. Rows are rounded, and zero, if a
        log-density at an anchor is at least ``largest``: those at points are then small differences
        of large numbers, off by up to 1e-15 of these. Such populations are far narrower than the
        points, or far from them, or invalid.
        """
        is_rounded = ~(np.abs(at_anchors).max(axis=1) < largest)
        with np.errstate(over="ignore"):  # of populations far narrower than their distance
            return np.where(is_rounded[:, None], 0.0, at_anchors) @ self.inverse, is_rounded


@dataclass(eq=False)
class PopulationDensity:
    """Populations of some inputs, compiled once: log-densities and draws."""

    inputs: Inputs
    # Points of the last call and the form of their log-density, or None if there is no form.
    _form: tuple[Any, ExponentialForm | None] = (None, None)

    @cached_property
    def log_density(self) -> Any:
        """The compiled log-density of parents and points."""
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
            # PyMC's density at the end of a support may be finite or infinite, and covariates give
            # each point a population of its own. In these cases the form is not used.
            if form is not None and (self.inputs.covariates or not form.is_inside.all()):
                form = None
            self._form = points[0], form
        if form is not None:
            (at_anchors,) = self.log_density(*params, *form.anchors)
            natural, is_rounded = form.natural_parameters(at_anchors)
            narrow = [param[is_rounded] for param in params]

        def log_densities(rows: slice) -> Floats:
            if form is None:
                (logs,) = self.log_density(*params, *[x[rows] for x in points])
                return np.array(logs)
            # One thread, because rounding, and with it the points of a design, would depend on the
            # number of threads.
            with one_thread():
                logs = natural @ form.statistics[:, rows]
            if is_rounded.any():
                (logs[is_rounded],) = self.log_density(*narrow, *[x[rows] for x in points])
            return logs

        return log_densities


def normalise(logs: Floats) -> Floats:
    """Turn log weights, (S, n), into weights in place, NaN without any; return log totals, (S,)."""
    largest = logs.max(axis=1, keepdims=True)
    largest = np.where(np.isfinite(largest), largest, 0.0)
    logs -= largest
    np.exp(logs, out=logs)
    totals = logs.sum(axis=1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        logs /= totals
        return (np.log(totals) + largest)[:, 0]
