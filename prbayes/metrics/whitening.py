"""Coordinates of a sample of several outputs: principal components, and robust whitening.

In whitened coordinates the units and correlations of outputs do not matter.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincinv

from prbayes._stats import quantile
from prbayes._validate import Floats
from prbayes.metrics.density import spread

# More outputs than this are compared by their principal components: eight need seventy directions.
MOST_OUTPUTS = 8
# Share of the variance, of the data and of the design, that components may leave out.
LEFT_OUT = 0.01


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
        """A clause about what is left out of the data; empty if it is noise that no model has."""
        if self.left_out <= LEFT_OUT:
            return ""
        if self.rest_correlation < 0.5:  # white noise has .1
            if not self.design_left_out > LEFT_OUT:
                return ""
            return (
                f"{self.summary}: noise that the model has too, and whose size rests on the few "
                "directions in which the data happen to vary most; leave metric= out, for the "
                "log-likelihood by specimen, or use prb.MarginalCorrelation(metric)"
            )
        return (
            f"{self.summary}: it is no noise, and the metric does not compare it; pass more "
            "components= to prb.Joint, or measure more specimens"
        )


def principal_components(
    sample: Floats, weights: Floats, number: int | None = None, design: Floats | None = None
) -> Components:
    """Return principal components of observed outputs, (n, m), and of a design, (k, m), together.

    They are those of the mean of both scatters, each in units of its variance, and so span what the
    data vary in, and what similar populations could vary in. The weight of a specimen falls with
    its distance from the middle of the data. By default their ``number`` is the fewest that leave
    out a hundredth of either variance, at most eight, or one for five specimens.
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
    axes = np.linalg.eigh(np.mean(scaled, axis=0))[1][:, ::-1]
    # The variance of each scatter that the first components explain.
    variances = [np.einsum("ij,ik,kj->j", axes, s, axes) for s in scaled]
    explained = np.cumsum(variances, axis=1)
    if number is None:
        is_sufficient = (explained >= 1 - LEFT_OUT).all(axis=0)
        sufficient = int(np.argmax(is_sufficient)) + 1 if is_sufficient.any() else m
        number = min(sufficient, max(1, min(m, MOST_OUTPUTS, n // 5)))
    # Signs that do not depend on the algorithm.
    largest = np.abs(axes).argmax(axis=0)
    axes = (axes * np.sign(axes[largest, np.arange(m)]))[:, :number]
    left_out = 1 - explained[:, number - 1].clip(0, 1)
    # The correlation of neighbours in the remainder.
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


# Degrees of freedom of the t distribution of the scatter. One is the most robust, up to a share of
# 1 / (m + 1) of gross outliers, but does not exist where many specimens have equal outputs.
_DEGREES = (1.0, 3.0, np.inf)


def whitening(sample: Floats, weights: Floats, outputs: NDArray[np.intp]) -> tuple[Floats, Floats]:
    """Return center and axes of invariant coordinates ``(y - center) @ axes`` of a sample, (n, m).

    They are the same, to rounding, after any invertible affine map of the outputs: location and
    scatter are maximum likelihood of a t distribution [1]_, axes and signs are those of another
    scatter and of a third moment relative to it [2]_. All of them are robust to gross outliers.
    Messages use the numbers of the ``outputs``, (m,). Raises ValueError if an output has equal
    values, outputs depend on each other linearly, or the specimens are fewer than m + 2.

    References
    ----------
    .. [1] Kent, J. T. and D. E. Tyler (1991), Redescending M-estimates of multivariate location and
       scatter, Ann. Statist. 19, 2102-2119, doi:10.1214/aos/1176348388.
    .. [2] Tyler, D. E., F. Critchley, L. Duembgen and H. Oja (2009), Invariant co-ordinate
       selection, J. R. Statist. Soc. B 71, 549-592, doi:10.1111/j.1467-9868.2009.00706.x.
    """
    has_weight = weights > 0
    sample = sample[has_weight]
    weights = weights[has_weight]
    weights = weights / weights.sum()
    n, m = sample.shape
    if n < m + 2:
        transposed = "" if n > max(m, 3) else "; rows are specimens: is it transposed?"
        raise ValueError(
            f"observed: got {n} specimens with finite outputs {_listed(outputs)} (counted from 0), "
            f"expected at least {m + 2} for {m} outputs; leave outputs out, or compare them by "
            f"prb.MarginalCorrelation(metric){transposed}"
        )
    center, unit = units(sample, weights, outputs)
    z = (sample - center) / unit
    for degrees in _DEGREES:
        location, root, dependent = _scatter(z, weights, degrees)
        if dependent is None:
            break
    if dependent is not None:
        dependent = np.abs(dependent)
        which = outputs[dependent > 0.1 * dependent.max()]
        raise ValueError(
            f"observed: got outputs {_listed(which)} (counted from 0) that depend on each other "
            "linearly, to 1e-5 of their spread, expected outputs that do not follow from "
            "others; leave one of them out"
        )
    # Rotate to the axes of a second scatter, with signs by a third moment.
    x = (z - location) @ root
    squares = (x**2).sum(axis=-1)
    _, axes = _singular(x, weights / (1 + squares) ** 2)
    third = (weights / (1 + squares) ** 1.5) @ (x @ axes.T) ** 3
    root = root @ (axes.T * np.where(third < 0, -1.0, 1.0))
    white = (z - location) @ root
    squares = (white**2).sum(axis=-1)
    size = quantile(squares, weights, 0.5) / (2 * gammaincinv(m / 2, 0.5))
    axes = root / np.sqrt(size)
    return center + location * unit, axes / unit[:, None]


def units(sample: Floats, weights: Floats, outputs: NDArray[np.intp]) -> tuple[Floats, Floats]:
    """Return a median and a robust spread of each output, or raise for one without spread.

    Arguments are those of `whitening`.
    """
    center = np.array([quantile(y, weights, 0.5) for y in sample.T])
    # In parts of the range, whose squares do not overflow in any unit.
    length = np.ptp(sample, axis=0)
    constant = outputs[~(length > 0)]
    if constant.size:
        raise ValueError(
            f"observed: got equal values of output {_listed(constant)} (counted from 0) for all "
            "specimens, expected values that differ; leave that output out"
        )
    scaled = (sample - center) / length
    return center, length * [spread(x, weights) for x in scaled.T]


def _scatter(z: Floats, weights: Floats, degrees: float) -> tuple[Floats, Floats, Floats | None]:
    """Return location and a root of the inverse scatter of a t distribution, by iteration.

    It starts with mean and covariance, so that an affine map changes no step. Last comes a linear
    combination of outputs without scatter, or None.
    """
    location = np.zeros(z.shape[1])
    root = np.eye(z.shape[1])
    w = weights
    # 40 to 150 steps converge for 50 values of 2 to 8 outputs, unless there is no scatter.
    for _ in range(2000):
        x = (z - location) @ root
        shift = w @ x
        size, axes = _singular(x - shift, w)
        largest = max(size[0], np.abs(root).max())
        if not size[-1] > 1e-13 * largest:  # rounding alone
            return location, root, root @ axes[-1]
        location = location + np.linalg.solve(root.T, shift)
        root = root @ (axes.T / size)
        stretch = np.abs(size - 1).max()
        if max(stretch, np.abs(shift).max()) < 1e-9:
            break
        white = (z - location) @ root
        squares = (white**2).sum(axis=-1)
        w = weights / (1 + squares / degrees)
        w = w / w.sum()
    # The least variance of a combination of outputs in units of their spread: below 1e-10, the
    # rounding of measurements decides.
    inverse = np.linalg.inv(root)
    _, least, combinations = np.linalg.svd(inverse / np.sqrt((inverse**2).sum(axis=0)))
    is_dependent = least[-1] ** 2 < 1e-10 or stretch > 1e-9
    return location, root, combinations[-1] if is_dependent else None


def _singular(x: Floats, weights: Floats) -> tuple[Floats, Floats]:
    """Return the roots of the eigenvalues of a second moment, and its eigenvectors as rows."""
    _, size, axes = np.linalg.svd(x * np.sqrt(weights)[:, None], full_matrices=False)
    return size, axes


def _listed(outputs: NDArray[np.intp]) -> str:
    """Return the numbers of outputs for a message."""
    return ", ".join(map(str, outputs.tolist()))
