"""Second derivatives from a stencil of unit steps."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from prbayes._checks import Floats

# Signs of the steps along a pair of axes; a mixed difference is the first and last less the others.
_CORNERS = ((1, 1), (1, -1), (-1, 1), (-1, -1))


def second_differences(value: Callable[[Floats], Floats], r: int) -> Floats:
    """Return the Hessian at zero of a function of r parameters by differences of one unit.

    Parameters
    ----------
    value : callable
        ``value(x)``, shapes (1, s, r) -> (s,).
    r : int

    Returns
    -------
    ndarray, shape (r, r)
    """
    unit = np.eye(r)
    pairs = [(i, j) for i in range(r) for j in range(i)]
    rows = [np.zeros(r), *unit, *-unit]
    for i, j in pairs:
        rows += [a * unit[i] + b * unit[j] for a, b in _CORNERS]
    f = value(np.array(rows)[None])
    up, down, mixed = f[1 : 1 + r], f[1 + r : 1 + 2 * r], f[1 + 2 * r :]
    out = np.diag(up - 2 * f[0] + down)
    for n, (i, j) in enumerate(pairs):
        pp, pm, mp, mm = mixed[4 * n : 4 * n + 4]
        out[i, j] = out[j, i] = (pp - pm - mp + mm) / 4
    return np.asarray(out)
