"""The sampling distribution of the minimiser, to first order."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from prbayes._checks import Floats
from prbayes.estimate.data_sets import DataSets, dependent
from prbayes.estimate.identifiability import seen_by_area, seen_by_curvature
from prbayes.estimate.sandwich import Information
from prbayes.metrics.base import Minimum

_IRLS = 30
_LOADING = 0.02  # share of a hyperparameter in unseen directions above which it is not identified


def first_order_shifts(parts: list[Information], scales: Floats, basis: Floats, sets: DataSets) -> Floats:
    """Return shifts of the minimiser over data sets, to first order, along a basis.

    The features are taken as linear in theta. Smooth discrepancies then contribute their gradient and
    Hessian; areas, integrals of an absolute value, are minimised by iterated reweighting.

    Parameters
    ----------
    parts : list of Information
    scales : ndarray, shape (k,)
    basis : ndarray, shape (d, r)
        Directions in units of the prior's spread.
    sets : DataSets

    Returns
    -------
    ndarray, shape (n_sets, r)
    """
    n_sets, r = len(sets.weights[0]), basis.shape[1]
    directions = basis * parts[0].scale[:, None]
    rhs, curvature = np.zeros((n_sets, r)), np.zeros((r, r))
    areas = []
    for part, s in zip(parts, scales, strict=True):
        data = sets.values[part.k], sets.weights[part.k]
        if part.evaluator.nodes[part.k].metric.minimum is Minimum.QUADRATIC:
            rhs -= part.gradients(*data) @ directions / s
            curvature += directions.T @ part.hessian @ directions / s
        else:
            gap, slopes, lengths = part.area(*data)
            areas.append((gap, directions.T @ slopes, lengths / s))
    shifts = np.zeros((n_sets, r))
    for _ in range(_IRLS if areas else 1):
        left, right = np.broadcast_to(curvature, (n_sets, r, r)).copy(), rhs.copy()
        for gap, slopes, lengths in areas:
            weight = lengths / np.sqrt((gap + shifts @ slopes) ** 2 + 1e-8)
            left += np.einsum("bm,im,jm->bij", weight, slopes, slopes, optimize=True)
            right -= np.einsum("bm,im->bi", weight * gap, slopes, optimize=True)
        size = np.trace(left, axis1=1, axis2=2)[:, None, None]
        shifts = np.linalg.solve(left + 1e-10 * size * np.eye(r), right[..., None])[..., 0]
    return shifts


@dataclass(frozen=True, eq=False)
class Local:
    """First-order sampling distribution of the minimiser, in units of the prior's spread.

    Attributes
    ----------
    scale : ndarray, shape (d,)
        The prior's spread.
    directions : ndarray, shape (d, r)
        Orthonormal directions about which the data tell enough, by default more than the prior.
    blind : ndarray, shape (d, d - r)
        The other directions.
    covariance : ndarray, shape (r, r)
        Of the minimiser, along the directions.
    """

    scale: Floats
    directions: Floats
    blind: Floats
    covariance: Floats

    @property
    def in_theta(self) -> Floats:
        """The covariance in theta, shape (d, d), infinite for elements with a share in blind directions."""
        covariance = self.directions @ self.covariance @ self.directions.T * np.outer(self.scale, self.scale)
        hidden = (self.blind**2).sum(axis=1) > _LOADING
        covariance[hidden] = covariance[:, hidden] = np.inf
        return np.asarray(covariance)


def local_sampling(parts: list[Information], scales: Floats, weakest: float = 1.0) -> Local:
    """Return the sampling distribution of the minimiser of sum of d_k / scale_k.

    Directions along which its standard error is above ``weakest``, in units of the prior's spread, are blind.

    Raises
    ------
    TypeError
        If one of the metrics is a user's function, of which nothing is known.
    """
    metrics = [p.evaluator.nodes[p.k].metric for p in parts]
    if any(m.minimum is Minimum.UNKNOWN for m in metrics):
        raise TypeError("standard errors: got a metric that declares nothing of its minimum, expected one that does")
    scale = parts[0].scale
    unit = np.outer(scale, scale)
    if all(m.minimum is Minimum.QUADRATIC for m in metrics):
        hessian = unit * sum(p.hessian / s for p, s in zip(parts, scales, strict=True))
        if dependent(parts[0].evaluator.nodes):
            together = sum(p.gradients(*p.data_set) / s for p, s in zip(parts, scales, strict=True))
            noise = unit * np.atleast_2d(np.cov(together, rowvar=False))
        else:
            noise = unit * sum(p.sampling_covariance / s**2 for p, s in zip(parts, scales, strict=True))
        values, vectors, seen = seen_by_curvature(hessian, noise, weakest)
        inverse = vectors[:, seen] / values[seen]
        return Local(scale, vectors[:, seen], vectors[:, ~seen], inverse.T @ noise @ inverse)
    seen_by = []
    for p, m in zip(parts, metrics, strict=True):
        if m.minimum is Minimum.QUADRATIC:
            _, vectors, seen = seen_by_curvature(p.hessian * unit, p.sampling_covariance * unit, weakest)
            seen_by.append(vectors[:, seen])
        else:
            seen_by.append(seen_by_area(p))
    left, strength, _ = np.linalg.svd(np.concatenate([np.zeros((len(unit), 1)), *seen_by], axis=1))
    rank = int((strength > 0.1).sum())
    basis, blind = left[:, :rank], left[:, rank:]
    covariance = np.zeros((rank, rank))
    if rank:
        shifts = first_order_shifts(parts, scales, basis, parts[0].data_sets)
        covariance = np.cov(shifts, rowvar=False).reshape(rank, rank)
    return Local(scale, basis, blind, covariance)
