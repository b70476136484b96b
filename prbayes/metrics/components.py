"""Principal components of many outputs, such as curves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from prbayes._stats import quantile
from prbayes._validate import Floats

# More outputs than this are compared by their principal components: eight need seventy directions.
MOST_OUTPUTS = 8
# Share of the variance, of the data and of the design, that components may leave out.
LEFT_OUT = 0.01
# Fewest specimens for two components, five each: scatters of fewer are uncertain.
FEWEST = 10


@dataclass(frozen=True, eq=False)
class Components:
    """Scores ``(y - center) @ axes`` of outputs y, and the variance that they leave out."""

    center: Floats  # (m,)
    axes: Floats  # (m, r): orthonormal
    left_out: float  # share of the observed variance
    design_left_out: float  # share of the design's variance; NaN without a design
    rest_correlation: float  # of neighbours in the remainder of the data: near zero for noise

    @property
    def number(self) -> int:
        """The number of components."""
        return int(self.axes.shape[1])

    @property
    def summary(self) -> str:
        """The number of components, and the variance that they leave out."""
        left_out = f"{self.left_out:.2g} of the variance of the data"
        if not np.isnan(self.design_left_out):
            left_out += f" and {self.design_left_out:.2g} of that of the design"
        return (
            f"{len(self.axes)} outputs are compared by {self.number} principal component(s), which "
            f"leave out {left_out}; neighbours in what is left out of the data are correlated by "
            f"{self.rest_correlation:.2f}"
        )

    @property
    def missed(self) -> str:
        """A clause about structure of the data that is left out; empty if it is noise."""
        if self.left_out <= LEFT_OUT or self.rest_correlation < 0.5:  # white noise has .1
            return ""
        return (
            f"{self.summary}, so that it is no noise: the metric does not see it; pass more "
            "components= to prb.Joint, or measure more specimens"
        )


def principal_components(
    sample: Floats, weights: Floats, number: int | None = None, design: Floats | None = None
) -> Components:
    """Return principal components of observed outputs and of a design together.

    They are those of the mean of both scatters, each in units of its variance, and so span what the
    data vary in, and what similar populations could vary in. The weight of a specimen falls with
    its distance from the middle of the data.

    Parameters
    ----------
    sample, weights : ndarray, shapes (n, m), (n,)
        Finite, of outputs in one unit.
    number : int, optional
        By default the fewest that leave out a hundredth of either variance, at most eight, or one
        for five specimens.
    design : ndarray, shape (k, m), optional
        Simulated outputs, finite.
    """
    n, m = sample.shape
    middle = np.array([quantile(y, weights, 0.5) for y in sample.T])
    squares = ((sample - middle) ** 2).sum(axis=1)
    typical = float(quantile(squares, weights, 0.5))
    center, scatter = _robust_moments(sample, weights, middle, typical)
    scatters = [scatter]
    if design is not None and len(design) > 1:
        equal = np.full(len(design), 1 / len(design))
        scatters.append(_robust_moments(design, equal, middle, typical)[1])
    scaled = [s / max(float(np.trace(s)), np.finfo(float).tiny) for s in scatters]
    _, vectors = np.linalg.eigh(np.mean(scaled, axis=0))
    axes = vectors[:, ::-1]
    # The variance that the first components explain of each.
    shares = [np.einsum("ij,ik,kj->j", axes, s, axes) for s in scaled]
    explained = np.array([np.cumsum(share) for share in shares])
    if number is None:
        is_sufficient = (explained >= 1 - LEFT_OUT).all(axis=0)
        sufficient = int(np.argmax(is_sufficient)) + 1 if is_sufficient.any() else m
        number = min(sufficient, max(1, min(m, MOST_OUTPUTS, n // 5)))
    # Signs that do not depend on the algorithm.
    largest = np.abs(axes).argmax(axis=0)
    signs = np.sign(axes[largest, np.arange(m)])
    axes = (axes * signs)[:, :number]
    left_out = 1 - explained[:, number - 1].clip(0, 1)
    centered = sample - center
    rest = centered - centered @ axes @ axes.T
    rest = rest - rest.mean(axis=0)
    variance = float((rest**2).mean())
    correlation = 0.0
    if m > 1 and variance > 0:
        correlation = float((rest[:, 1:] * rest[:, :-1]).mean()) / variance
    return Components(
        center=center,
        axes=axes,
        left_out=float(left_out[0]),
        design_left_out=float(left_out[1]) if len(left_out) > 1 else np.nan,
        rest_correlation=correlation,
    )


def _robust_moments(
    sample: Floats, weights: Floats, middle: Floats, typical: float
) -> tuple[Floats, Floats]:
    """Return the mean and the scatter of a sample with weights that fall with the fourth power.

    Distances are from a middle, in units of a typical squared distance.
    """
    squares = ((sample - middle) ** 2).sum(axis=1)
    w = weights / (1 + squares / typical) ** 2 if typical > 0 else weights
    w = w / w.sum()
    center = w @ sample
    deviations = sample - center
    return center, (w[:, None] * deviations).T @ deviations
