"""Arrays of batches: leading axes that broadcast, and an event of fixed dimension behind them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np


def batch_shape(values: Sequence[Any], event_ndims: Sequence[int]) -> tuple[int, ...]:
    """Return the shape that the leading axes of arrays (..., *event) broadcast to."""
    leading = []
    for v, event_ndim in zip(values, event_ndims, strict=True):
        leading.append(v.shape[: v.ndim - event_ndim])
    return np.broadcast_shapes(*leading)


def broadcast_batch(
    values: Sequence[Any], event_ndims: Sequence[int], batch: tuple[int, ...]
) -> list[Any]:
    """Return arrays (..., *event) with their leading axes broadcast to ``batch``."""
    full = []
    for v, event_ndim in zip(values, event_ndims, strict=True):
        event = v.shape[v.ndim - event_ndim :]
        full.append(np.broadcast_to(v, batch + event))
    return full
