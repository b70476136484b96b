"""How far an emulator is trusted: the share of a population that runs keep by their own weights."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from prbayes._checks import Floats

# Levels at which distribution functions are compared: no more are different with few runs.
_THRESHOLDS = 32


def share_of_runs(weights: Floats, y: Floats, said: Floats, blocks: NDArray[np.intp]) -> float:
    """Return which share of a population the runs are to be, from 0 (the emulator alone) to 1.

    Distribution functions of the emulator are off by a bias, which runs that were left out tell;
    those of weighted runs scatter. A mixture of both has the least squared error where the runs'
    share is bias^2 / (bias^2 + variance). The bias is estimated without its own scatter.

    Parameters
    ----------
    weights : ndarray, shape (T, n)
        Of the runs in the populations that matter; each row sums to one.
    y : ndarray, shape (n, m)
        Outputs of the runs; not finite where they failed.
    said : ndarray, shape (n, m)
        What an emulator says of them that was fitted without their block.
    blocks : ndarray, shape (n,)

    Returns
    -------
    float
    """
    bias, variance = 0.0, 0.0
    numbers = np.unique(blocks)
    member = (blocks == numbers[:, None]).astype(float)
    for own, other in zip(y.T, said.T, strict=True):
        below = _below(own, own)
        # What the emulator puts below each level, less what there is: by block, (T, B, L).
        off = np.einsum("tn,bn,nl->tbl", weights, member, _below(other, own) - below)
        total = off.sum(axis=1)
        scatter = _variance(off)
        bias += float(np.maximum(total**2 - scatter, 0.0).sum(axis=-1).mean())
        # Weighted runs by themselves, around their distribution function.
        function = np.einsum("tn,nl->tl", weights, below)
        around = below - function[:, None, :]
        apart = np.einsum("tn,bn,tnl->tbl", weights, member, around)
        variance += float(_variance(apart).sum(axis=-1).mean())
    return bias / (bias + variance) if bias > 0 else 0.0


def _variance(parts: Floats) -> Floats:
    """Return the variance of sums of independent parts, (T, B, L) -> (T, L)."""
    number = parts.shape[1]
    spread = parts.var(axis=1, ddof=1)
    return np.asarray(number * spread)


def _below(values: Floats, levels_of: Floats) -> Floats:
    """Return which values are below quantiles of others, (n, L); NaN is never, +inf only never."""
    finite = levels_of[np.isfinite(levels_of)]
    shares = (np.arange(_THRESHOLDS) + 0.5) / _THRESHOLDS
    levels = np.quantile(finite, shares)
    return (values[:, None] <= levels).astype(float)
