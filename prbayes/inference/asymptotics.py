"""The sampling distribution of the minimiser, to first order in theta."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from prbayes._validate import Floats
from prbayes.inference.identifiability import identified_by_area, identified_by_curvature
from prbayes.inference.resampling import DataSets, dependent
from prbayes.inference.sandwich import Information, LinearArea
from prbayes.metrics.base import Minimum

# Share of a hyperparameter in unidentified directions above which it is not identified.
_LOADING = 0.02


@dataclass(frozen=True, eq=False)
class _Expansion:
    """The objective of data sets around theta, along r directions."""

    force: Floats  # (n_sets, r): minus the gradients of quadratic discrepancies
    curvature: Floats  # (r, r): their Hessian
    # With slopes along the directions, (r, m), and lengths divided by the scale.
    areas: list[LinearArea]


def first_order_shifts(
    information: list[Information], scales: Floats, basis: Floats, sets: DataSets
) -> Floats:
    """Return shifts of the minimiser over data sets, to first order, along a basis.

    The features are taken as linear in theta. Smooth discrepancies then contribute their gradient
    and Hessian; areas, integrals of an absolute value, are minimised by iterated reweighting.

    Parameters
    ----------
    information : list of Information
        By simulator.
    scales : ndarray, shape (k,)
    basis : ndarray, shape (d, r)
        Directions in units of the prior's spread.
    sets : DataSets

    Returns
    -------
    ndarray, shape (n_sets, r)
    """
    expansion = _expanded(information, scales, basis, sets)
    shifts = np.zeros_like(expansion.force)
    # Without an area one solution is exact.
    iterations = 30 if expansion.areas else 1
    for _ in range(iterations):
        shifts = _solved(expansion, shifts)
    return shifts


def _expanded(
    information: list[Information], scales: Floats, basis: Floats, sets: DataSets
) -> _Expansion:
    prior_sd = information[0].prior_sd
    directions = basis * prior_sd[:, None]
    r = basis.shape[1]
    n_sets = len(sets.weights[0])
    force = np.zeros((n_sets, r))
    curvature = np.zeros((r, r))
    areas = []
    for one, scale in zip(information, scales, strict=True):
        observed = sets.values[one.k]
        weights = sets.weights[one.k]
        if one.node.metric.minimum is Minimum.QUADRATIC:
            gradients = one.gradients(observed, weights)
            force -= gradients @ directions / scale
            hessian = directions.T @ one.hessian
            curvature += hessian @ directions / scale
        else:
            for area in one.areas(observed, weights):
                slopes = directions.T @ area.slopes
                lengths = area.lengths / scale
                areas.append(LinearArea(area.gaps, slopes, lengths))
    return _Expansion(force, curvature, areas)


def _solved(expansion: _Expansion, shifts: Floats) -> Floats:
    """Return the minimisers with each |gap| as a parabola through its value at ``shifts``."""
    n_sets, r = shifts.shape
    curvature = np.broadcast_to(expansion.curvature, (n_sets, r, r))
    left = curvature.copy()
    right = expansion.force.copy()
    for area in expansion.areas:
        slopes = area.slopes
        gaps = area.gaps + shifts @ slopes
        # Below a gap of 1e-4 an absolute value counts as a parabola.
        sizes = np.sqrt(gaps**2 + 1e-8)
        weight = area.lengths / sizes
        pull = weight * area.gaps
        left += np.einsum("bm,im,jm->bij", weight, slopes, slopes, optimize=True)
        right -= np.einsum("bm,im->bi", pull, slopes, optimize=True)
    # A ridge, small against each direction's own size, keeps it regular: where one prior is far
    # wider than another, the system is as much larger along it.
    size = np.diagonal(left, axis1=1, axis2=2)
    ridge = 1e-10 * size[:, :, None]
    regular = left + ridge * np.eye(r)
    solution = np.linalg.solve(regular, right[..., None])
    return np.asarray(solution[..., 0])


@dataclass(frozen=True, eq=False)
class Local:
    """Covariance of the minimiser at one theta, in units of the prior's spread."""

    prior_sd: Floats  # (d,): the prior's spread
    # (d, r): orthonormal directions about which the data tell enough, by default more than the
    # prior.
    identified: Floats
    unidentified: Floats  # (d, d - r): the other directions
    covariance: Floats  # (r, r): of the minimiser, along the directions identified

    @property
    def in_theta(self) -> Floats:
        """The covariance in theta, (d, d), infinite for elements with a share not identified."""
        unit = np.outer(self.prior_sd, self.prior_sd)
        along = self.identified @ self.covariance
        covariance = along @ self.identified.T * unit
        loading = (self.unidentified**2).sum(axis=1)
        hidden = loading > _LOADING
        covariance[hidden] = np.inf
        covariance[:, hidden] = np.inf
        return np.asarray(covariance)

    def variance(self, gradients: Floats) -> Floats:
        """Return the variance of functions of theta with gradients (..., d).

        Infinite for those with a share not identified. A function of elements that are not
        identified may be, such as the standard deviation of an input whose correlation is not.
        """
        unit = gradients * self.prior_sd
        along = unit @ self.identified
        across = unit @ self.unidentified
        variance = np.einsum("...i,ij,...j->...", along, self.covariance, along)
        hidden = (across**2).sum(axis=-1) > _LOADING * (unit**2).sum(axis=-1)
        return np.asarray(np.where(hidden, np.inf, np.maximum(variance, 0)))


def local_sampling(information: list[Information], scales: Floats, weakest: float = 1.0) -> Local:
    """Return the sampling distribution of the minimiser of sum of d_k / scale_k, to first order.

    Directions along which its standard error is above ``weakest``, in units of the prior's spread,
    are not identified.
    """
    minima = {one.node.metric.minimum for one in information}
    if minima == {Minimum.QUADRATIC}:
        return _sandwich(information, scales, weakest)
    return _by_data_sets(information, scales, weakest)


def _sandwich(information: list[Information], scales: Floats, weakest: float) -> Local:
    """Return H^-1 J H^-1 along the directions that the data identify."""
    prior_sd = information[0].prior_sd
    unit = np.outer(prior_sd, prior_sd)
    total: Any = 0
    for one, scale in zip(information, scales, strict=True):
        total = total + one.hessian / scale
    hessian = unit * total
    noise = unit * _gradient_covariance(information, scales)
    values, vectors, found = identified_by_curvature(hessian, noise, weakest)
    identified = vectors[:, found]
    unidentified = vectors[:, ~found]
    inverse = identified / values[found]
    covariance = inverse.T @ noise @ inverse
    return Local(prior_sd, identified, unidentified, covariance)


def _gradient_covariance(information: list[Information], scales: Floats) -> Floats:
    """Return J of the sum of d_k / scale_k in theta, shape (d, d)."""
    total: Any = 0
    weighed = zip(information, scales, strict=True)
    if not dependent(information[0].evaluator.nodes):
        for one, scale in weighed:
            total = total + one.sampling_covariance / scale**2
        return np.asarray(total)
    # Gradients of the simulators depend on each other where they share specimens.
    for one, scale in weighed:
        gradients = one.gradients(*one.data_set)
        total = total + gradients / scale
    covariance = np.cov(total, rowvar=False)
    return np.atleast_2d(covariance)


def _by_data_sets(information: list[Information], scales: Floats, weakest: float) -> Local:
    """Return the covariance of the shifts over simulated data sets, where there are areas."""
    prior_sd = information[0].prior_sd
    spans = [_identified(one, weakest) for one in information]
    # The space spanned by what each simulator identifies; an empty column, should none do.
    nothing = np.zeros((prior_sd.size, 1))
    columns = np.concatenate([nothing, *spans], axis=1)
    axes, strength, _ = np.linalg.svd(columns)
    # What one of them identifies has a strength of one or more; rounding is far smaller.
    spanned = strength > 0.1
    rank = int(spanned.sum())
    identified = axes[:, :rank]
    unidentified = axes[:, rank:]
    covariance = np.zeros((rank, rank))
    if rank:
        sets = information[0].data_sets
        shifts = first_order_shifts(information, scales, identified, sets)
        covariance = np.cov(shifts, rowvar=False).reshape(rank, rank)
    return Local(prior_sd, identified, unidentified, covariance)


def _identified(information: Information, weakest: float) -> Floats:
    """Return the directions that one simulator identifies, shape (d, r)."""
    if information.node.metric.minimum is not Minimum.QUADRATIC:
        return identified_by_area(information, weakest)
    prior_sd = information.prior_sd
    unit = np.outer(prior_sd, prior_sd)
    hessian = information.hessian * unit
    noise = information.sampling_covariance * unit
    _, vectors, found = identified_by_curvature(hessian, noise, weakest)
    return np.asarray(vectors[:, found])
