"""Ticks: round numbers within a range, and values on an axis of logarithms."""

from __future__ import annotations

import numpy as np

from prbayes._validate import Floats

Ticks = tuple[list[float], list[str]]  # positions and labels


def round_ticks(low: float, high: float) -> Ticks:
    """Return a few round numbers within a range, and their labels."""
    from matplotlib.ticker import MaxNLocator  # heavy, and only needed for pictures

    # Five of them at most
    locator = MaxNLocator(5, steps=[1.0, 2.0, 2.5, 5.0, 10.0])
    found = np.asarray(locator.tick_values(low, high))
    step = found[1] - found[0]
    # An end that is a tick is one in spite of rounding
    slack = 1e-9 * step
    at = found[(found >= low - slack) & (found <= high + slack)]
    labels = []
    for x in at:
        zero = abs(x) < step / 2  # not 1e-17
        labels.append("0" if zero else f"{x:.12g}")
    return at.tolist(), labels


def spans_decades(values: Floats) -> bool:
    """Whether a logarithm shows values better: all are positive, and of different orders."""
    finite = values[np.isfinite(values)]
    if not finite.size or finite.min() <= 0:
        return False
    # On an even axis the smallest would be within a twentieth of the bottom
    threshold = 20 * finite.min()
    return bool(finite.max() > threshold)


def log_ticks(values: Floats) -> Ticks:
    """Return ticks of positive values: positions as base-10 logarithms, labels of the values."""
    finite = values[np.isfinite(values)]
    shown = np.log10(finite[finite > 0])
    low = shown.min()
    high = shown.max()

    # Powers of ten, some of them where there are more than six; 1, 2, 5 where there are few
    first = np.floor(low)
    last = np.ceil(high)
    powers = np.arange(first, last + 1)
    every = -(-powers.size // 6)
    factors = (1, 2, 5) if high - low < 2 else (1,)

    # Ticks a little outside the values are still on the axis, which has a margin of a twentieth
    slack = 0.05 * (high - low) + 1e-9
    at: list[float] = []
    labels: list[str] = []
    for power in powers[::every]:
        for factor in factors:
            place = power + np.log10(factor)
            if low - slack <= place <= high + slack:
                at.append(float(place))
                labels.append(f"{factor * 10.0**power:g}")
    return at, labels
