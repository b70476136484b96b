"""Which directions of the hyperparameters the data see, and the names of those they do not."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from prbayes._checks import Floats
from prbayes.estimate.sandwich import Information

_SHARE = 0.15  # of an element in a direction below which it is not mentioned


def blind_directions(blind: Floats, names: list[str]) -> list[str]:
    """Name the directions about which the data tell less than the prior, such as 'mu[0] - 0.8 mu[1]'."""
    found = []
    # Rotated so that elements stand alone where they can.
    basis = blind
    while basis.shape[1]:
        projector = basis @ basis.T
        i = int(np.argmax(np.diag(projector)))
        direction = projector[i] / np.sqrt(projector[i, i])
        found.append(_named(direction, names))
        rest = basis - np.outer(direction, direction @ basis)
        left, strength, _ = np.linalg.svd(rest, full_matrices=False)
        basis = left[:, strength > 1e-6]
    return found


def _named(direction: Floats, names: list[str]) -> str:
    largest = direction[np.argmax(np.abs(direction))]
    parts = []
    for share, name in sorted(zip(direction / largest, names, strict=True), key=lambda p: -abs(p[0])):
        if abs(share) > _SHARE:
            size = "" if abs(share) > 0.95 else f"{abs(share):.1f} "
            parts.append(f"{'-' if share < 0 else '+'} {size}{name}")
    return " ".join(parts).removeprefix("+ ")


_HALVED = 256  # points from which two halves can be held against each other
_AGREEMENT = 0.35  # correlation of the changes of two halves of the points from which a change is taken as real
_ROUNDING = 0.01  # curvature, in units of the gradient's variance over the curvature, that is a rounding error


def seen_by_area(part: Information) -> Floats:
    """Return the directions that an area metric sees, orthonormal in units of the prior's spread, shape (d, r).

    A direction is not seen if one prior standard deviation along it changes the area by less than half the
    noise floor, or if two halves of the points do not agree on the change: then it is the points' own error.
    """
    _, slopes, lengths = part.area(*part.data_set)
    slopes = slopes * part.scale[:, None]
    _, vectors = np.linalg.eigh((slopes * lengths) @ slopes.T)
    change = (np.abs(vectors.T @ slopes) * lengths).sum(axis=-1)
    enough = change > 0.5 * part.noise_floor
    blocks = part.evaluator.nodes[part.k].bound.blocks
    if blocks.size >= _HALVED:
        halves = (part.area(*part.data_set, blocks % 2 == i)[1] * part.scale[:, None] for i in (0, 1))
        a, b = (vectors.T @ s for s in halves)
        both, one, other = ((x * lengths).sum(axis=-1) for x in (a * b, a**2, b**2))
        enough &= both > _AGREEMENT * np.sqrt(one * other)
    return np.asarray(vectors[:, enough])


def seen_by_curvature(hessian: Floats, noise: Floats, weakest: float = 1.0) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Return eigenvalues and eigenvectors of the Hessian, and along which the data tell enough.

    Both matrices are in units of the prior's spread: the standard error has to be below ``weakest``.
    """
    values, vectors = np.linalg.eigh((hessian + hessian.T) / 2)
    along = np.einsum("ik,ij,jk->k", vectors, noise, vectors)
    # Where the data see nothing both are rounding errors, and small against their ratio elsewhere.
    total = float(np.trace(hessian))
    floor = _ROUNDING * float(np.trace(noise)) / total if total > 0 else 0.0
    return values, vectors, (values > floor) & (along < (weakest * values) ** 2)
