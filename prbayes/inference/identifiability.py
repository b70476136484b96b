"""Identified directions of the hyperparameters, and names of unidentified directions."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from prbayes._validate import Floats


def unidentified_directions(unidentified: Floats, names: list[str]) -> list[str]:
    """Name unidentified directions, orthonormal columns (d, q), such as 'mu[0] - 0.8 mu[1]'.

    They are rotated so that elements are alone if possible.
    """
    labels = []
    space = unidentified
    while space.shape[1]:
        # The element that lies closest to the space, projected on it.
        projector = space @ space.T
        within = np.diag(projector)
        i = int(np.argmax(within))
        direction = projector[i] / np.sqrt(within[i])
        labels.append(named_direction(direction, names))
        complement = space - np.outer(direction, direction @ space)
        axes, strength, _ = np.linalg.svd(complement, full_matrices=False)
        # Directions of the complement have a strength of one, up to rounding.
        space = axes[:, strength > 1e-6]
    return labels


def without(unidentified: Floats, elements: NDArray[np.bool_]) -> Floats:
    """Return unidentified directions, (d, q), without those of some elements, (d,)."""
    if not elements.any():
        return unidentified
    axes, strength, _ = np.linalg.svd(unidentified * ~elements[:, None], full_matrices=False)
    # One, or zero up to rounding for elements on which nothing depends.
    return np.asarray(axes[:, strength > 0.5])


def oriented(axes: Floats) -> Floats:
    """Return axes, columns of (d, r), with signs that do not depend on rounding.

    The signs of eigenvectors are arbitrary, and draws along the axes depend on them.
    """
    direction = np.cos(np.arange(len(axes)))
    return np.where(direction @ axes < 0, -axes, axes)


def named_direction(direction: Floats, names: list[str]) -> str:
    """Name a direction by its largest elements, relative to the largest: 'mu - 0.8 sigma'."""
    ratios = direction / direction[np.argmax(np.abs(direction))]
    terms = []
    for i in np.argsort(-np.abs(ratios), kind="stable"):
        size = abs(ratios[i])
        # Elements below .15 are left out, and above .95 called equal.
        if size <= 0.15:
            continue
        sign = "-" if ratios[i] < 0 else "+"
        factor = "" if size > 0.95 else f"{size:.1f} "
        terms.append(f"{sign} {factor}{names[i]}")
    return " ".join(terms).removeprefix("+ ")


def identified_by_curvature(
    hessian: Floats, noise: Floats, weakest: float = 1.0
) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Return eigenvalues and eigenvectors of the Hessian, and which of them the data identify.

    H and J of the sandwich, (d, d), are in units of the prior's spread; ``weakest`` is an upper
    bound of the standard error of an identified direction.
    """
    values, vectors = np.linalg.eigh((hessian + hessian.T) / 2)
    noise_along = np.einsum("ik,ij,jk->k", vectors, noise, vectors)
    # Along flat directions both are rounding errors, a hundredth of their ratio elsewhere.
    total = float(np.trace(hessian))
    floor = 0.01 * float(np.trace(noise)) / total if total > 0 else 0.0
    is_precise = noise_along < (weakest * values) ** 2
    return values, vectors, (values > floor) & is_precise
