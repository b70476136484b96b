"""What is told of measured responses at once: that none is in reach, or all are there twice."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from prbayes._finding import Finding, report
from prbayes._validate import Floats

# Responses that a range is told from: of fewer it says little of the prior.
_FEWEST_OF_A_RANGE = 16


def tell_far_data(name: str, observed: Floats, responses: Floats, outputs: Sequence[str]) -> None:
    """Say so where all that was measured of an output is beyond all responses so far.

    As where one is in another unit: each run after that would be for nothing.
    """
    if not responses.size:  # a propagation of one's own may keep none
        return
    columns = observed.reshape(len(observed), -1).T
    simulated = responses.reshape(len(responses), -1).T
    if len(columns) != len(simulated):
        return
    labels = [f"{name}[{own}]" for own in outputs] or [name]
    for label, one, other in zip(labels, columns, simulated, strict=True):
        measured, there = one[np.isfinite(one)], other[np.isfinite(other)]
        if not measured.size or there.size < _FEWEST_OF_A_RANGE:
            continue
        low, high = measured.min(), measured.max()
        lowest, highest = there.min(), there.max()
        if high < lowest or low > highest:
            side = "below" if high < lowest else "above"
            report(
                Finding(
                    "data-out-of-reach",
                    f"{label}: got observed values from {low:.4g} to {high:.4g}, all {side} "
                    f"the first {there.size} responses, from {lowest:.4g} to {highest:.4g}: "
                    "look at the units, and at whether the priors reach that far, before more "
                    "runs are made.",
                )
            )
            return


# Specimens from which on it is no chance that each is there twice.
_FEWEST_COPIED = 6


def tell_copies(name: str, observed: Floats) -> None:
    """Say so where each specimen, of none of which there is a label, is there at least twice.

    Counts, and readings on a scale of few steps, are so by chance.
    """
    rows = observed.reshape(len(observed), -1)
    different, counts = np.unique(rows, axis=0, return_counts=True)
    if len(rows) < _FEWEST_COPIED or counts.min() < 2 or _on_few_steps(rows):
        return
    report(
        Finding(
            "duplicated-data",
            f"{name}: got {len(rows)} observed values of which only {len(different)} are "
            "different, each at least twice: if these are repeated readings of a specimen, say "
            "so by specimens=, and leave out what is there twice by mistake; else every "
            "specimen counts, and the uncertainty is too small.",
        )
    )


def _on_few_steps(rows: Floats) -> bool:
    """Return whether values of each output, (n, m), are on a decimal scale of less than n steps."""
    for column in rows.T:
        values = column[np.isfinite(column)]
        steps = [np.ptp(values) * unit for unit in _UNITS if _are_whole(values * unit)]
        if not steps or min(steps) >= len(rows):
            return False
    return True


# Readings in whole units, in tenths of them, and so on.
_UNITS = 10.0 ** np.arange(-3, 7)


def _are_whole(values: Floats) -> bool:
    return bool(np.abs(values - np.round(values)).max(initial=0.0) < 1e-6)
