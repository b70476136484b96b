"""The sampling distribution of the minimiser, to first order in theta."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from prbayes._checks import Floats
from prbayes.estimate.data_sets import DataSets, dependent
from prbayes.estimate.identifiability import seen_by_area, seen_by_curvature
from prbayes.estimate.sandwich import Information, LinearArea
from prbayes.metrics.base import Minimum

_IRLS = 30
# Squared gap of distribution functions below which an absolute value counts as a parabola.
_KINK = 1e-8
# Of a system's trace, added to its diagonal: directions that no area sees stay where they are.
_RIDGE = 1e-10
# Share of a hyperparameter in unidentified directions above which it is not identified.
_LOADING = 0.02
# Singular value above which a direction counts among those that one of the simulators identifies.
_SPANNED = 0.1


@dataclass(frozen=True, eq=False)
class _Expansion:
    """The objective of data sets around theta, along r directions.

    Attributes
    ----------
    force : ndarray, shape (n_sets, r)
        Minus the gradients of quadratic discrepancies.
    curvature : ndarray, shape (r, r)
        Their Hessian.
    areas : list of LinearArea
        With slopes along the directions, (r, m), and lengths divided by the scale.
    """

    force: Floats
    curvature: Floats
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
    for _ in range(_IRLS if expansion.areas else 1):
        shifts = _solved(expansion, shifts)
    return shifts


def _expanded(
    information: list[Information], scales: Floats, basis: Floats, sets: DataSets
) -> _Expansion:
    n_sets, r = len(sets.weights[0]), basis.shape[1]
    directions = basis * information[0].prior_sd[:, None]
    force, curvature = np.zeros((n_sets, r)), np.zeros((r, r))
    areas = []
    for i, scale in zip(information, scales, strict=True):
        data = sets.values[i.k], sets.weights[i.k]
        if i.node.metric.minimum is Minimum.QUADRATIC:
            force -= i.gradients(*data) @ directions / scale
            curvature += directions.T @ i.hessian @ directions / scale
        else:
            area = i.area(*data)
            slopes = directions.T @ area.slopes
            areas.append(LinearArea(area.gaps, slopes, area.lengths / scale))
    return _Expansion(force, curvature, areas)


def _solved(expansion: _Expansion, shifts: Floats) -> Floats:
    """Return the minimisers with each |gap| as a parabola through its value at ``shifts``."""
    n_sets, r = shifts.shape
    left = np.broadcast_to(expansion.curvature, (n_sets, r, r)).copy()
    right = expansion.force.copy()
    for area in expansion.areas:
        gaps, slopes = area.gaps, area.slopes
        weight = area.lengths / np.sqrt((gaps + shifts @ slopes) ** 2 + _KINK)
        left += np.einsum("bm,im,jm->bij", weight, slopes, slopes, optimize=True)
        right -= np.einsum("bm,im->bi", weight * gaps, slopes, optimize=True)
    size = np.trace(left, axis1=1, axis2=2)[:, None, None]
    solved = np.linalg.solve(left + _RIDGE * size * np.eye(r), right[..., None])
    return np.asarray(solved[..., 0])


@dataclass(frozen=True, eq=False)
class Local:
    """Covariance of the minimiser at one theta, in units of the prior's spread.

    Attributes
    ----------
    prior_sd : ndarray, shape (d,)
        The prior's spread.
    identified : ndarray, shape (d, r)
        Orthonormal directions about which the data tell enough, by default more than the prior.
    unidentified : ndarray, shape (d, d - r)
        The other directions.
    covariance : ndarray, shape (r, r)
        Of the minimiser, along the directions identified.
    """

    prior_sd: Floats
    identified: Floats
    unidentified: Floats
    covariance: Floats

    @property
    def in_theta(self) -> Floats:
        """The covariance in theta, (d, d), infinite for elements with a share not identified."""
        unit = np.outer(self.prior_sd, self.prior_sd)
        covariance = self.identified @ self.covariance @ self.identified.T * unit
        hidden = (self.unidentified**2).sum(axis=1) > _LOADING
        covariance[hidden] = covariance[:, hidden] = np.inf
        return np.asarray(covariance)


def local_sampling(information: list[Information], scales: Floats, weakest: float = 1.0) -> Local:
    """Return the sampling distribution of the minimiser of sum of d_k / scale_k, to first order.

    Directions along which its standard error is above ``weakest``, in units of the prior's spread,
    are not identified.
    """
    metrics = [i.node.metric for i in information]
    if all(m.minimum is Minimum.QUADRATIC for m in metrics):
        return _sandwich(information, scales, weakest)
    return _by_data_sets(information, scales, weakest)


def _sandwich(information: list[Information], scales: Floats, weakest: float) -> Local:
    """Return H^-1 J H^-1 along the directions that the data identify."""
    prior_sd = information[0].prior_sd
    unit = np.outer(prior_sd, prior_sd)
    pairs = list(zip(information, scales, strict=True))
    hessian = unit * sum(i.hessian / s for i, s in pairs)
    if dependent(information[0].evaluator.nodes):
        # Gradients of the simulators depend on each other where they share specimens.
        together = sum(i.gradients(*i.data_set) / s for i, s in pairs)
        noise = unit * np.atleast_2d(np.cov(together, rowvar=False))
    else:
        noise = unit * sum(i.sampling_covariance / s**2 for i, s in pairs)
    values, vectors, seen = seen_by_curvature(hessian, noise, weakest)
    inverse = vectors[:, seen] / values[seen]
    covariance = inverse.T @ noise @ inverse
    return Local(prior_sd, vectors[:, seen], vectors[:, ~seen], covariance)


def _by_data_sets(information: list[Information], scales: Floats, weakest: float) -> Local:
    """Return the covariance of the shifts over simulated data sets, where there are areas."""
    prior_sd = information[0].prior_sd
    seen = [_seen(i, weakest) for i in information]
    # The space spanned by what each simulator identifies; an empty column, should none do.
    nothing = np.zeros((prior_sd.size, 1))
    left, strength, _ = np.linalg.svd(np.concatenate([nothing, *seen], axis=1))
    rank = int((strength > _SPANNED).sum())
    identified, unidentified = left[:, :rank], left[:, rank:]
    covariance = np.zeros((rank, rank))
    if rank:
        shifts = first_order_shifts(information, scales, identified, information[0].data_sets)
        covariance = np.cov(shifts, rowvar=False).reshape(rank, rank)
    return Local(prior_sd, identified, unidentified, covariance)


def _seen(information: Information, weakest: float) -> Floats:
    """Return the directions that one simulator identifies, shape (d, r)."""
    if information.node.metric.minimum is not Minimum.QUADRATIC:
        return seen_by_area(information)
    unit = np.outer(information.prior_sd, information.prior_sd)
    hessian, noise = information.hessian * unit, information.sampling_covariance * unit
    _, vectors, seen = seen_by_curvature(hessian, noise, weakest)
    return np.asarray(vectors[:, seen])
