"""Principal components of outputs that are too many to be compared one with the other: curves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from prbayes._stats import quantile
from prbayes._validate import Floats

# More outputs than this are compared by their principal components; of as many the directions that
# are enough are seventy.
MOST_OUTPUTS = 8
# Correlation of neighbouring outputs in what is left out from which it is no noise: white noise of
# ten curves of twelve outputs has .1, what one more component would explain has .5 to 1.
_NO_NOISE = 0.5
# Share of the variance, of the data and of the design, that components may leave out. By judgement:
# a tenth of a standard deviation.
LEFT_OUT = 0.01
# Specimens for each component: scatters of fewer are hardly known.
_SPECIMENS = 5
# Specimens from which two components can be had.
FEWEST = 2 * _SPECIMENS


@dataclass(frozen=True, eq=False)
class Components:
    """Scores ``(y - center) @ axes`` of outputs y, and what they leave out."""

    center: Floats  # (m,)
    axes: Floats  # (m, r): orthonormal
    left_out: float  # share of the observed variance
    design_left_out: float  # share of the design's variance; NaN where none was looked at
    # Correlation of what is left out of the observed outputs, between neighbours: near zero, or
    # below, if it is noise.
    rest_correlation: float

    @property
    def number(self) -> int:
        """How many there are."""
        return int(self.axes.shape[1])

    @property
    def summary(self) -> str:
        """How many there are, what they leave out, and whether that is noise."""
        of = f"{self.left_out:.2g} of the variance of the data"
        if not np.isnan(self.design_left_out):
            of += f" and {self.design_left_out:.2g} of that of the design"
        return (
            f"{len(self.axes)} outputs are compared by {self.number} principal component(s), which "
            f"leave out {of}; neighbours in what is left out of the data are correlated by "
            f"{self.rest_correlation:.2f}"
        )

    @property
    def missed(self) -> str:
        """What is left out of the data and is no noise, as a clause; empty if there is no such."""
        if self.left_out <= LEFT_OUT or self.rest_correlation < _NO_NOISE:
            return ""
        return (
            f"{self.summary}, so that it is no noise: the metric does not see it; pass more "
            "components= to prb.Joint, or measure more specimens"
        )


def principal_components(
    sample: Floats, weights: Floats, number: int | None = None, design: Floats | None = None
) -> Components:
    """Return principal components of observed outputs and of a design together.

    Of both scatters, each in units of its own variance, the mean: so the components span what the
    data vary in, and what populations like them could vary in and they do not. Specimens count the
    less the farther they are from the middle of the data, in units of the data's own distances.

    Parameters
    ----------
    sample, weights : ndarray, shapes (n, m), (n,)
        Finite, of outputs in one unit.
    number : int, optional
        As many as leave out a hundredth of either variance, by default, and at most eight, or one
        for five specimens.
    design : ndarray, shape (k, m), optional
        Simulated outputs, finite.
    """
    n, m = sample.shape
    middle = np.array([quantile(y, weights, 0.5) for y in sample.T])
    squares = ((sample - middle) ** 2).sum(axis=1)
    typical = float(quantile(squares, weights, 0.5))
    center, scatter = _scatter(sample, weights, middle, typical)
    scatters = [scatter]
    if design is not None and len(design) > 1:
        equal = np.full(len(design), 1 / len(design))
        _, simulated = _scatter(design, equal, middle, typical)
        scatters.append(simulated)
    unit = []
    for scatter in scatters:
        variance = max(float(np.trace(scatter)), np.finfo(float).tiny)
        unit.append(scatter / variance)
    _, vectors = np.linalg.eigh(np.mean(unit, axis=0))
    axes = vectors[:, ::-1]
    # What the first components explain of each.
    shares = [np.einsum("ij,ik,kj->j", axes, scatter, axes) for scatter in unit]
    explained = np.array([np.cumsum(share) for share in shares])
    if number is None:
        most = min(m, MOST_OUTPUTS, n // _SPECIMENS)
        number = min(_enough(explained), max(1, most))
    # Signs that do not hang on the algorithm.
    largest = np.abs(axes).argmax(axis=0)
    signs = np.sign(axes[largest, np.arange(m)])
    axes = (axes * signs)[:, :number]
    # What is left out: as a share of either variance, and of the data themselves.
    left_out = 1 - explained[:, number - 1].clip(0, 1)
    of_data = float(left_out[0])
    of_design = float(left_out[1]) if len(left_out) > 1 else np.nan
    centered = sample - center
    scores = centered @ axes
    rest = centered - scores @ axes.T
    rest = rest - rest.mean(axis=0)
    return Components(
        center=center,
        axes=axes,
        left_out=of_data,
        design_left_out=of_design,
        rest_correlation=_between_neighbours(rest),
    )


def _scatter(
    sample: Floats, weights: Floats, middle: Floats, typical: float
) -> tuple[Floats, Floats]:
    """Return the mean and the scatter of a sample in which specimens far out hardly count.

    Far from a middle, in units of a typical squared distance: a weight falls with the fourth power.
    """
    squares = ((sample - middle) ** 2).sum(axis=1)
    w = weights / (1 + squares / typical) ** 2 if typical > 0 else weights
    w = w / w.sum()
    center = w @ sample
    away = sample - center
    return center, (w[:, None] * away).T @ away


def _enough(explained: Floats) -> int:
    """Return how many components explain enough of each variance, from sums of shares, (k, m)."""
    enough = (explained >= 1 - LEFT_OUT).all(axis=0)
    if not enough.any():
        return len(enough)
    return int(np.argmax(enough)) + 1


def _between_neighbours(rest: Floats) -> float:
    """Return the correlation of neighbouring outputs in what is left, shape (n, m)."""
    size = float((rest**2).mean())
    if rest.shape[1] < 2 or not size > 0:
        return 0.0
    return float((rest[:, 1:] * rest[:, :-1]).mean()) / size
