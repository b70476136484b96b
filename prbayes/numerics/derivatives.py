"""Derivatives by differences.

The points of a stencil, evaluated in one batch, and what they tell.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from prbayes._validate import Floats


def cross(theta: Floats, step: Floats) -> Floats:
    """Return theta, and its neighbours a step up and a step down along each element.

    Parameters
    ----------
    theta, step : ndarray, shape (d,)

    Returns
    -------
    ndarray, shape (1 + 2 d, d)
        Theta, the neighbours up, the neighbours down.
    """
    along = np.diag(step)
    up = theta + along
    down = theta - along
    return np.vstack([theta, up, down])


def slopes(values: Floats, step: Floats) -> Floats:
    """Return central differences of values at a cross.

    Where one of two neighbours is not finite, as at the edge of a support, they are one-sided.

    Parameters
    ----------
    values : ndarray, shape (1 + 2 d, ...)
        At the points of `cross`.
    step : ndarray, shape (d,)

    Returns
    -------
    ndarray, shape (..., d)
        The derivative along each element, last.
    """
    # Elements last, so that steps divide them.
    last = np.moveaxis(values, 0, -1)
    middle, up, down = np.split(last, [1, 1 + step.size], axis=-1)
    with np.errstate(invalid="ignore"):
        forward = (up - middle) / step
        backward = (middle - down) / step
        both = (up - down) / (2 * step)
    # Both neighbours where there are both, or the one that there is.
    above = np.isfinite(up)
    below = np.isfinite(down)
    upwards = np.where(below, both, forward)
    found: Floats = np.where(above, upwards, backward)
    return found


def differences(
    values: Callable[[Floats], Floats], step: Floats
) -> Callable[[Floats], tuple[float, Floats, int]]:
    """Return a function of theta that gives value, gradient by differences, and evaluations.

    Parameters
    ----------
    values : callable
        Thetas (P, d) -> values (P,).
    step : ndarray, shape (d,)

    Examples
    --------
    >>> import numpy as np
    >>> square = differences(lambda thetas: (thetas**2).sum(axis=-1), np.array([1e-3, 1e-3]))
    >>> value, gradient, evaluations = square(np.array([1.0, 2.0]))
    >>> np.allclose(gradient, [2.0, 4.0]), evaluations
    (True, 5)
    """

    def function(theta: Floats) -> tuple[float, Floats, int]:
        points = cross(theta, step)
        found = values(points)
        gradient = slopes(found, step)
        return found[0], gradient, len(found)

    return function
