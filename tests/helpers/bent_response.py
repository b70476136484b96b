"""A smooth response of two inputs, and their ranges."""

from __future__ import annotations

from typing import Any

import numpy as np

BOX = {"x": (0.0, 3.0), "y": (1.0, 2.0)}
# Points of the ranges, (2, 500)
FRESH = np.random.default_rng(3).uniform([0, 1], [3, 2], (500, 2)).T


def bent(x: Any, y: Any) -> Any:
    return np.sin(x) * y
