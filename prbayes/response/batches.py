"""Arrays of batches: leading axes that broadcast, and an event of fixed dimension behind them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np


def batch_shape(values: Sequence[Any], event_ndims: Sequence[int]) -> tuple[int, ...]:
    """Return the shape that the leading axes of arrays (..., *event) broadcast to."""
    pairs = zip(values, event_ndims, strict=True)
    leading = [v.shape[: v.ndim - event] for v, event in pairs]
    return np.broadcast_shapes(*leading)


def broadcast_batch(
    values: Sequence[Any], event_ndims: Sequence[int], batch: tuple[int, ...]
) -> list[Any]:
    """Return arrays (..., *event) with their leading axes broadcast to ``batch``."""
    pairs = zip(values, event_ndims, strict=True)
    return [np.broadcast_to(v, batch + v.shape[v.ndim - event :]) for v, event in pairs]
