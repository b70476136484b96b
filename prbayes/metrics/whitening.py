"""Robust coordinates of a sample in which its units and correlations do not matter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincinv

from prbayes._stats import quantile
from prbayes._validate import Floats
from prbayes.metrics.density import spread

# Degrees of freedom of the t distribution whose scatter it is. One is the most robust: it bears a
# share of 1 / (m + 1) of gross outliers, but does not exist where many specimens have equal
# outputs. Infinitely many are mean and covariance.
_DEGREES = (1.0, 3.0, np.inf)

# From 50 values of 2 to 8 outputs 40 to 150 steps reach the bound below, which leaves coordinates
# the same to 1e-8 after an affine map (test); more steps than that mean that there is no scatter.
_MOST_STEPS = 2000
_CONVERGED = 1e-9

# A ratio of singular values that is made of rounding errors alone.
_SINGULAR = 1e-13

# Least variance of a combination of outputs, each in units of its own spread. Below it two sides
# would be told apart by 1e-5 of an output's spread, which measurement and rounding make.
_DEPENDENT = 1e-10


@dataclass(frozen=True, eq=False)
class Whitening:
    """Coordinates ``(y - center) @ axes`` of outputs y, in units of a normal sample's sd."""

    center: Floats  # (m,)
    axes: Floats  # (m, m): a coordinate a column


class _NoScatterError(Exception):
    """There is no scatter; ``along`` is the combination of outputs that has none."""

    def __init__(self, along: Floats) -> None:
        super().__init__()
        self.along = along


def whitening(sample: Floats, weights: Floats, outputs: NDArray[np.intp]) -> Whitening:
    """Return invariant coordinates of a weighted sample.

    They are the same, to rounding, after any affine map of the outputs that can be undone: location
    and scatter are maximum likelihood of a t distribution [1]_, axes and signs are those of another
    scatter and of a third moment relative to it [2]_. All of them bear gross outliers.

    Parameters
    ----------
    sample, weights : ndarray, shapes (n, m), (n,)
        All finite.
    outputs : ndarray of int, shape (m,)
        What messages call the outputs.

    Raises
    ------
    ValueError
        If an output has equal values, outputs depend on each other linearly, or the specimens are
        fewer than m + 2.

    References
    ----------
    .. [1] Kent, J. T. and D. E. Tyler (1991), Redescending M-estimates of multivariate location and
       scatter, Ann. Statist. 19, 2102-2119, doi:10.1214/aos/1176348388.
    .. [2] Tyler, D. E., F. Critchley, L. Duembgen and H. Oja (2009), Invariant co-ordinate
       selection, J. R. Statist. Soc. B 71, 549-592, doi:10.1111/j.1467-9868.2009.00706.x.
    """
    seen = weights > 0
    sample = sample[seen]
    weights = weights[seen]
    weights = weights / weights.sum()
    n, m = sample.shape
    if n < m + 2:
        turned = "" if n > max(m, 3) else "; rows are specimens: is it transposed?"
        raise ValueError(
            f"observed: got {n} specimens with finite outputs {_listed(outputs)} (counted from 0), "
            f"expected at least {m + 2} for {m} outputs; leave outputs out, or compare them by "
            f"prb.MarginalCorrelation(metric){turned}"
        )
    center, unit = units(sample, weights, outputs)
    z = (sample - center) / unit
    middle, root = _robust_scatter(z, weights, outputs)
    turn = _turn((z - middle) @ root, weights)
    root = root @ turn
    white = (z - middle) @ root
    squares = (white**2).sum(axis=-1)
    size = quantile(squares, weights, 0.5) / (2 * gammaincinv(m / 2, 0.5))
    axes = root / np.sqrt(size)
    return Whitening(center + middle * unit, axes / unit[:, None])


def units(sample: Floats, weights: Floats, outputs: NDArray[np.intp]) -> tuple[Floats, Floats]:
    """Return a median and a robust spread of each output, or raise for one without spread.

    Arguments are those of `whitening`.
    """
    center = np.array([quantile(y, weights, 0.5) for y in sample.T])
    # In parts of the range, whose squares are numbers in any unit.
    length = np.ptp(sample, axis=0)
    constant = outputs[~(length > 0)]
    if constant.size:
        raise ValueError(
            f"observed: got equal values of output {_listed(constant)} (counted from 0) for all "
            "specimens, expected values that differ; leave that output out"
        )
    parts = (sample - center) / length
    unit = length * [spread(part, weights) for part in parts.T]
    return center, unit


def _robust_scatter(z: Floats, weights: Floats, outputs: NDArray[np.intp]) -> tuple[Floats, Floats]:
    """Return location and a root of the inverse scatter, of as few degrees as there is one for."""
    for degrees in _DEGREES:
        try:
            return _scatter(z, weights, degrees)
        except _NoScatterError as error:
            along = np.abs(error.along)
    several = outputs[along > 0.1 * along.max()]
    raise ValueError(
        f"observed: got outputs {_listed(several)} (counted from 0) that depend on each other "
        "linearly, to 1e-5 of their spread, expected outputs of which none follows from the "
        "others; leave one of them out"
    )


def _scatter(z: Floats, weights: Floats, degrees: float) -> tuple[Floats, Floats]:
    """Return location and a root of the inverse scatter, of a t distribution, by iteration.

    It starts with mean and covariance, so that an affine map changes no step.
    """
    middle = np.zeros(z.shape[1])
    root = np.eye(z.shape[1])
    w = weights
    for _ in range(_MOST_STEPS):
        x = (z - middle) @ root
        shift = w @ x
        size, axes = _singular(x - shift, w)
        largest = max(size[0], np.abs(root).max())
        if not size[-1] > _SINGULAR * largest:
            raise _NoScatterError(root @ axes[-1])
        middle = middle + np.linalg.solve(root.T, shift)
        root = root @ (axes.T / size)
        stretch = np.abs(size - 1).max()
        if max(stretch, np.abs(shift).max()) < _CONVERGED:
            break
        white = (z - middle) @ root
        squares = (white**2).sum(axis=-1)
        w = weights / (1 + squares / degrees)
        w = w / w.sum()
    # The least variance of a combination of outputs in units of their own spread.
    back = np.linalg.inv(root)
    own = np.sqrt((back**2).sum(axis=0))
    _, least, combinations = np.linalg.svd(back / own)
    dependent = least[-1] ** 2 < _DEPENDENT
    if dependent or stretch > _CONVERGED:
        raise _NoScatterError(combinations[-1])
    return middle, root


def _singular(x: Floats, weights: Floats) -> tuple[Floats, Floats]:
    """Return the roots of the eigenvalues of a second moment, and its eigenvectors as rows."""
    _, size, axes = np.linalg.svd(x * np.sqrt(weights)[:, None], full_matrices=False)
    return size, axes


def _turn(x: Floats, weights: Floats) -> Floats:
    """Return the rotation to the axes of a second scatter, with signs by a third moment."""
    squares = (x**2).sum(axis=-1)
    _, axes = _singular(x, weights / (1 + squares) ** 2)
    cubes = (x @ axes.T) ** 3
    third = (weights / (1 + squares) ** 1.5) @ cubes
    signs = np.where(third < 0, -1.0, 1.0)
    return np.asarray(axes.T * signs)


def _listed(outputs: NDArray[np.intp]) -> str:
    return ", ".join(map(str, outputs.tolist()))
