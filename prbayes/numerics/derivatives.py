"""First and second derivatives by differences at the points of a stencil."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from prbayes._validate import ArrayFunction, Floats


def cross(theta: Floats, step: Floats) -> Floats:
    """Return theta, (d,), its neighbours up, and its neighbours down, (1 + 2 d, d)."""
    along = np.diag(step)
    return np.vstack([theta, theta + along, theta - along])


def slopes(values: Floats, step: Floats) -> Floats:
    """Return central differences at a cross, (1 + 2 d, ...) -> (..., d), one-sided at an edge."""
    last = np.moveaxis(values, 0, -1)
    center, up, down = np.split(last, [1, 1 + step.size], axis=-1)
    with np.errstate(invalid="ignore"):
        forward = (up - center) / step
        backward = (center - down) / step
        central = (up - down) / (2 * step)
    upwards = np.where(np.isfinite(down), central, forward)
    derivatives = np.where(np.isfinite(up), upwards, backward)
    return derivatives


def differences(
    values: ArrayFunction, step: Floats
) -> Callable[[Floats], tuple[float, Floats, int]]:
    """Return a function of theta that returns value, gradient by differences, and evaluations."""

    def function(theta: Floats) -> tuple[float, Floats, int]:
        at_points = values(cross(theta, step))
        return at_points[0], slopes(at_points, step), len(at_points)

    return function


def stencil(r: int) -> Floats:
    """Return a cross of unit steps around zero, then four corners of each pair of axes, (s, r)."""
    unit = np.eye(r)
    rows = list(cross(np.zeros(r), np.ones(r)))
    for i, j in zip(*np.tril_indices(r, -1), strict=True):
        a, b = unit[i], unit[j]
        rows += [a + b, a - b, b - a, -a - b]
    return np.array(rows)


def hessian_of(values: Floats, r: int) -> Floats:
    """Return the Hessian, (r, r), from values at the points of `stencil`, by unit differences."""
    center, up, down, corners = np.split(values, [1, 1 + r, 1 + 2 * r])
    # Values that are not finite give NaN, which callers handle.
    with np.errstate(invalid="ignore"):
        hessian = np.diag(up - 2 * center + down)
        pp, pm, mp, mm = corners.reshape(-1, 4).T
        rows, columns = np.tril_indices(r, -1)
        hessian[rows, columns] = hessian[columns, rows] = (pp - pm - mp + mm) / 4
    return hessian


def second_differences(value: ArrayFunction, r: int) -> Floats:
    """Return the Hessian at zero, (r, r), of ``value(x)``, (1, s, r) -> (s,)."""
    return hessian_of(value(stencil(r)[None]), r)


def central_derivatives(
    function: ArrayFunction, thetas: Floats, steps: Floats
) -> tuple[Floats, Floats, Floats]:
    """Return values, gradients and Hessians at M points by central differences, in one call.

    The function returns values, (M, n), of points (M, n, d).
    """
    count, d = thetas.shape
    axes = steps[:, None] * np.eye(d)
    first, second = np.triu_indices(d, 1)
    diagonals = axes[:, first] + axes[:, second]
    center = np.zeros((count, 1, d))
    shifts = np.concatenate([center, axes, -axes, diagonals, -diagonals], axis=1)
    values = function(thetas[:, None] + shifts)
    if not np.isfinite(values).all():
        raise ValueError("got a log-density that is not finite around a mode")
    ends = np.cumsum([1, d, d, len(first)]).tolist()
    middle, up, down, ahead, behind = np.split(values, ends, axis=1)
    gradient = (up - down) / (2 * steps)
    bends = up + down - 2 * middle
    hessian = (bends / steps**2)[..., None] * np.eye(d)
    cross = (ahead + behind - 2 * middle - bends[:, first] - bends[:, second]) / 2
    cross /= steps[:, first] * steps[:, second]
    hessian[:, first, second] = cross
    hessian[:, second, first] = cross
    return middle[:, 0], gradient, hessian
