"""How far an emulator is trusted: the share of a population that runs keep by their own weights."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from prbayes._validate import Floats

# Levels at which distribution functions are compared: no more are different with few runs.
_THRESHOLDS = 32
# Width of the steps of distribution functions, in standard deviations: metrics see no finer, and a
# response that is one value for many specimens would else be off by all of them wherever an
# emulator is off by a rounding. By judgement: the bandwidth of a thousand data.
_RAMP = 0.2


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
    importance = weights.mean(axis=0)
    for own, other in zip(y.T, said.T, strict=True):
        levels, width = _levels(own, importance)
        below = _below(own, levels, width)
        # What the emulator puts below each level, less what there is: by block, (T, B, L).
        off = np.einsum("tn,bn,nl->tbl", weights, member, _below(other, levels, width) - below)
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


def _levels(values: Floats, importance: Floats) -> tuple[Floats, float]:
    """Return quantiles of what weighted values are finite, (L,), and the width of steps there."""
    finite = np.isfinite(values)
    known = values[finite]
    weights = importance[finite]
    order = np.argsort(known)
    known = known[order]
    weights = weights[order]
    total = weights.sum()
    cumulated = np.cumsum(weights) - 0.5 * weights
    shares = (np.arange(_THRESHOLDS) + 0.5) / _THRESHOLDS
    levels = np.interp(shares * total, cumulated, known)
    low, high = np.interp(ndtr([-1.0, 1.0]) * total, cumulated, known)
    return levels, _RAMP * (high - low) / 2


def _below(values: Floats, levels: Floats, width: float) -> Floats:
    """Return how far values are below levels, (n, L), from 0 to 1; NaN and +inf never are."""
    if not width > 0:
        return (values[:, None] <= levels).astype(float)
    ramp = (levels - values[:, None]) / width + 0.5
    return np.asarray(np.clip(np.nan_to_num(ramp, nan=0.0), 0.0, 1.0))
