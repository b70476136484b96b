"""Which directions of the hyperparameters the data identify, and the names of those they do not."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from prbayes._validate import Floats
from prbayes.inference.sandwich import Information, LinearArea


def unidentified_directions(unidentified: Floats, names: list[str]) -> list[str]:
    """Name the directions about which the data tell less than the prior.

    Parameters
    ----------
    unidentified : ndarray, shape (d, q)
        Orthonormal columns.
    names : list of str
        Of the d elements.

    Returns
    -------
    list of str
        Such as 'mu[0] - 0.8 mu[1]'; rotated so that elements stand alone where they can.
    """
    found = []
    left = unidentified
    while left.shape[1]:
        # The element that lies closest to the space that is left, projected on it.
        projector = left @ left.T
        within = np.diag(projector)
        i = int(np.argmax(within))
        length = np.sqrt(within[i])
        direction = projector[i] / length
        found.append(named_direction(direction, names))
        # What is left is orthogonal to it.
        along = np.outer(direction, direction @ left)
        without = left - along
        axes, strength, _ = np.linalg.svd(without, full_matrices=False)
        # Directions that are left have a strength of one, up to rounding.
        left = axes[:, strength > 1e-6]
    return found


def without(unidentified: Floats, elements: NDArray[np.bool_]) -> Floats:
    """Return directions not identified, (d, q), without those of elements, (d,), among them."""
    if not elements.any():
        return unidentified
    left = unidentified * ~elements[:, None]
    axes, strength, _ = np.linalg.svd(left, full_matrices=False)
    # One, or zero up to rounding, of elements on which nothing depends.
    return np.asarray(axes[:, strength > 0.5])


def oriented(axes: Floats) -> Floats:
    """Return axes, columns of (d, r), with signs that do not depend on rounding.

    The signs of eigenvectors are arbitrary, and draws along the axes depend on them.
    """
    direction = np.cos(np.arange(len(axes)))
    return np.where(direction @ axes < 0, -axes, axes)


def named_direction(direction: Floats, names: list[str]) -> str:
    """Name a direction by its largest elements, relative to the largest: 'mu - 0.8 sigma'."""
    largest = np.argmax(np.abs(direction))
    shares = direction / direction[largest]
    order = np.argsort(-np.abs(shares), kind="stable")
    terms = []
    for i in order:
        share = shares[i]
        size = abs(share)
        # What is left out, and what is called equal, is wording.
        if size <= 0.15:
            continue
        sign = "-" if share < 0 else "+"
        factor = "" if size > 0.95 else f"{size:.1f} "
        terms.append(f"{sign} {factor}{names[i]}")
    return " ".join(terms).removeprefix("+ ")


# Points from which two halves can be held against each other.
_HALVED = 256
# Correlation of the changes of two halves of the points from which a change is taken as real. Half
# or twice changes no answer, nor does half or twice of the others (docs/constants.md).
_AGREEMENT = 0.35
# Change of the area over one prior standard deviation, in noise floors, that counts.
_CHANGE = 0.5


def identified_by_area(information: Information, weakest: float = 1.0) -> Floats:
    """Return the directions that an area metric identifies, the strongest last, shape (d, r).

    Orthonormal in units of the prior's spread. A direction is not identified if ``weakest`` prior
    standard deviations along it change the area by less than half the noise floor, or if two halves
    of the points do not agree on the change: then it is the points' own error.
    """
    areas = information.areas(*information.data_set)
    gram: Any = 0
    for area in areas:
        slopes = _in_prior_sd(area, information)
        gram = gram + (slopes * area.lengths) @ slopes.T
    _, vectors = np.linalg.eigh(gram)
    # The change of the area over one prior standard deviation along each direction.
    change: Any = 0
    for area in areas:
        changes = np.abs(vectors.T @ _in_prior_sd(area, information))
        change = change + (changes * area.lengths).sum(axis=-1)
    found = weakest * change > _CHANGE * information.noise_floor
    if information.blocks.size >= _HALVED:
        found &= _halves_agree(information, vectors)
    return np.asarray(vectors[:, found])


def _halves_agree(information: Information, vectors: Floats) -> NDArray[np.bool_]:
    """Return along which directions both halves of the points change alike, shape (d,)."""
    blocks = information.blocks
    of_even = information.areas(*information.data_set, blocks % 2 == 0)
    of_odd = information.areas(*information.data_set, blocks % 2 == 1)
    both = one = other = np.zeros(vectors.shape[1])
    for even, odd in zip(of_even, of_odd, strict=True):
        first = vectors.T @ _in_prior_sd(even, information)
        second = vectors.T @ _in_prior_sd(odd, information)
        # The knots are the same: they are values that occur, and both halves know all of them.
        lengths = even.lengths
        both = both + (first * second * lengths).sum(axis=-1)
        one = one + (first**2 * lengths).sum(axis=-1)
        other = other + (second**2 * lengths).sum(axis=-1)
    least = _AGREEMENT * np.sqrt(one * other)
    return np.asarray(both > least)


def _in_prior_sd(area: LinearArea, information: Information) -> Floats:
    spread = information.prior_sd[:, None]
    return np.asarray(area.slopes * spread)


def identified_by_curvature(
    hessian: Floats, noise: Floats, weakest: float = 1.0
) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Return eigenvalues and eigenvectors of the Hessian, and along which the data tell enough.

    Parameters
    ----------
    hessian, noise : ndarray, shape (d, d)
        H and J of the sandwich, in units of the prior's spread.
    weakest : float
        Below which the standard error has to be, in prior standard deviations.
    """
    symmetric = (hessian + hessian.T) / 2
    values, vectors = np.linalg.eigh(symmetric)
    noise_along = np.einsum("ik,ij,jk->k", vectors, noise, vectors)
    # Where the data see nothing both are rounding errors, and small against their ratio elsewhere.
    floor = 0.0
    total = float(np.trace(hessian))
    if total > 0:
        variance = float(np.trace(noise))
        # A hundredth of what it is elsewhere.
        floor = 0.01 * variance / total
    precise = noise_along < (weakest * values) ** 2
    return values, vectors, (values > floor) & precise
