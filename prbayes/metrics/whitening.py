"""Coordinates of a sample of several outputs: principal components, and robust whitening.

In whitened coordinates the units and correlations of outputs do not matter.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import gammaincinv

from prbayes._finding import counted
from prbayes._stats import quantile
from prbayes._validate import ArrayPair, Floats, Indices, complete_rows
from prbayes.metrics.density import spread

# Largest number of outputs that are compared without principal components. Eight outputs need
# seventy directions.
MOST_OUTPUTS = 8
# Largest share of the variance of the data that components may leave out.
LEFT_OUT = 0.01


class FewSpecimensError(ValueError):
    """Too few specimens for the covariance of their outputs."""


@dataclass(frozen=True, eq=False)
class Components:
    """Scores ``(y - center) @ axes`` of outputs y, and the variance that they leave out."""

    center: Floats  # center of the outputs, (m,)
    axes: Floats  # orthonormal axes, (m, r)
    left_out: float  # share of the observed variance that is left out
    # Correlation of neighbouring outputs in the remainder of the data, which is near zero for
    # noise.
    rest_correlation: float
    outputs: Indices  # indices of the outputs of a specimen, (m,)

    @property
    def number(self) -> int:
        """The number of components."""
        return int(self.axes.shape[1])

    @property
    def summary(self) -> str:
        """The number of components, and the variance that they leave out."""
        return (
            f"{len(self.axes)} outputs are compared by "
            f"{counted(self.number, 'principal component')}, without {self.left_out:.2g} of the "
            "variance of the data; neighbours in what is left out are correlated by "
            f"{self.rest_correlation:.2f}"
        )

    def share_left_out(self, values: Floats, weights: Floats) -> float:
        """Return the share of the variance of a population, (n, m), that they leave out."""
        values = values[:, self.outputs]
        is_usable = complete_rows(values) & (weights > 0)
        values = values[is_usable]
        weights = weights[is_usable]
        deviations = values - np.average(values, axis=0, weights=weights)
        rest = deviations - deviations @ self.axes @ self.axes.T
        variance = float(weights @ (deviations**2).sum(axis=1))
        return float(weights @ (rest**2).sum(axis=1)) / variance if variance > 0 else 0.0

    def missed(self, population: float) -> str:
        """Return a clause about what is left out; empty if that is only noise of the data.

        ``population`` is the share of the variance of the best population that is left out.
        """
        # The correlation of white noise is about .1.
        if self.left_out > LEFT_OUT and self.rest_correlation >= 0.5:
            return (
                f"{self.summary}: this is not noise, and the metric does not compare it; pass more "
                "components= to prb.Joint, or measure more specimens"
            )
        if self.left_out > LEFT_OUT and population > LEFT_OUT:
            return (
                f"{self.summary}: noise that the model also has, whose size is estimated from few "
                "directions; leave metric= out, for the log-likelihood by specimen"
            )
        # Components of few data leave out more of the variance of a population than of the data, so
        # that up to three times as much is normal.
        if population > 3 * LEFT_OUT:
            return (
                f"{self.summary}, but {population:.2g} of that of the best population, which the "
                "metric does not compare; pass more components= to prb.Joint"
            )
        return ""


def medians(sample: Floats, weights: Floats) -> Floats:
    """Return the weighted median of each output, (n, m) -> (m,)."""
    return np.array([quantile(y, weights, 0.5) for y in sample.T])


def principal_components(
    sample: Floats, weights: Floats, outputs: Indices, number: int | None = None
) -> Components:
    """Return principal components of observed outputs, (n, m).

    The weight of a specimen falls with its distance from the middle of the data. Components that
    vary no more than white noise come last. By default ``number`` is the smallest number of
    components that leave out at most a hundredth of the variance, but at most eight, and at most
    one for every five specimens.
    """
    n, m = sample.shape
    middle = medians(sample, weights)
    squares = ((sample - middle) ** 2).sum(axis=1)
    typical = float(quantile(squares, weights, 0.5))
    # The weights fall with the fourth power of the distance from the middle.
    w = weights / (1 + squares / typical) ** 2 if typical > 0 else weights
    w = w / w.sum()
    center = w @ sample
    deviations = sample - center
    scatter = (w[:, None] * deviations).T @ deviations
    variances, axes = np.linalg.eigh(scatter)
    variances = np.maximum(variances[::-1], np.finfo(float).tiny)
    # Components with variances below the Marchenko-Pastur edge are noise. Noise components are
    # sorted by how near their variance is to the mean, because the largest ones overstate the
    # noise. The first of them stays in front if there is room for another one, because it may be
    # signal.
    most = max(1, min(m, MOST_OUTPUTS, n // 5)) if number is None else min(number, m)
    remaining = np.arange(m, 0, -1)
    means = np.cumsum(variances[::-1])[::-1] / remaining
    is_noise = (
        variances <= means * (1 + np.sqrt(remaining * (w @ w))) ** 2
    )  # the last component always counts as noise
    first = int(np.argmax(is_noise))
    first += most - first > 1
    atypical = np.abs(np.log(variances[first:] / means[first]))
    order = np.concatenate([np.arange(first), first + np.argsort(atypical)])
    variances = variances[order]
    axes = axes[:, ::-1][:, order]
    explained = np.cumsum(variances) / variances.sum()
    if number is None:
        is_sufficient = explained >= 1 - LEFT_OUT
        number = min(int(np.argmax(is_sufficient)) + 1 if is_sufficient.any() else m, most)
    # Choose signs that do not depend on the algorithm: the largest coefficient is positive.
    largest = np.abs(axes).argmax(axis=0)
    axes = (axes * np.sign(axes[largest, np.arange(m)]))[:, :number]
    # Correlation of neighbouring outputs in the remainder.
    rest = deviations - deviations @ axes @ axes.T
    rest = rest - rest.mean(axis=0)
    variance = float((rest**2).mean())
    correlation = 0.0
    if m > 1 and variance > 0:
        correlation = float((rest[:, 1:] * rest[:, :-1]).mean()) / variance
    return Components(
        center=center,
        axes=axes,
        left_out=float(1 - explained[number - 1].clip(0, 1)),
        rest_correlation=correlation,
        outputs=outputs,
    )


# Degrees of freedom of the t distribution of the scatter, in the order in which they are tried.
# With one degree the scatter is the most robust, up to a share of 1 / (m + 1) of gross outliers,
# but it does not exist if many specimens have equal outputs.
_DEGREES = (1.0, 3.0, np.inf)


def whitening(sample: Floats, weights: Floats, outputs: Indices) -> ArrayPair:
    """Return center and axes of invariant coordinates ``(y - center) @ axes`` of a sample, (n, m).

    They are the same, to rounding, after any invertible affine map of the outputs: location and
    scatter are maximum likelihood of a t distribution [1]_, axes and signs are those of another
    scatter and of a third moment relative to it [2]_. All of them are robust to gross outliers.
    With fewer specimens than `sufficient_specimens` the scatter is shrunk, and the coordinates are
    invariant only under changes of units and of the order of outputs.
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
        transposed = "" if n > max(m, 3) else " (rows are specimens: is it transposed?)"
        raise FewSpecimensError(
            f"observed: got {n} specimens with finite outputs {_listed(outputs)} (counted from 0), "
            f"expected at least {m + 2} for {m} outputs{transposed}; leave outputs out"
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
    root = _shrunk(root, 1 / float(weights @ weights))
    # Rotate to the axes of a second scatter; a third moment determines the signs.
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


def sufficient_specimens(m: int) -> int:
    """Return a sufficient number of specimens to whiten m outputs without shrinkage.

    Five for each output, and three for each number of the scatter.
    """
    return max(5 * m, 3 * m * (m + 1) // 2)


def _shrunk(root: Floats, n: float) -> Floats:
    """Return a root of the inverse scatter whose principal variances differ less, for few data.

    Without shrinkage a combination of outputs that happens to scatter little would count as much as
    all others. The ratio of neighbouring variances is reduced, at most to one, by the ratio that
    two equal variances of n normal values exceed with probability .1:
    ``P(log ratio > 2 g) = cosh(g)^(2 - n)``. The shrinkage falls to zero at a sufficient number of
    specimens.
    """
    deficit = 1 - n / sufficient_specimens(len(root))
    if deficit < 1e-9:  # a margin for the rounding of weights
        return root
    _, size, axes = np.linalg.svd(np.linalg.inv(root))
    log_size = np.log(size)
    threshold = np.sqrt(deficit) * np.arccosh(0.1 ** (-1 / max(n - 2, 1)))
    gaps = np.maximum(-np.diff(log_size) - threshold, 0)
    shrunk = -np.concatenate([[0.0], np.cumsum(gaps)])
    return axes.T / np.exp(shrunk - shrunk.mean() + log_size.mean())


def units(sample: Floats, weights: Floats, outputs: Indices) -> ArrayPair:
    """Return a median and a robust spread of each output, or raise for one without spread.

    Arguments are those of `whitening`.
    """
    center = medians(sample, weights)
    # Scale by the range first, so that squares do not overflow in any unit.
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

    The iteration starts with mean and covariance, so that all steps are affine equivariant. The
    third item is a linear combination of outputs without scatter, or None.
    """
    location = np.zeros(z.shape[1])
    root = np.eye(z.shape[1])
    w = weights
    columns = np.ascontiguousarray(z.T)  # because sums along rows take a third of the time
    # 40 to 150 steps converge for 50 values of 2 to 8 outputs, unless there is no scatter.
    for _ in range(2000):
        x = root.T @ (columns - location[:, None])
        shift = x @ w
        x -= shift[:, None]
        values, axes = np.linalg.eigh((x * w) @ x.T)
        size = np.sqrt(np.maximum(values, 0.0))
        largest = max(size[-1], np.abs(root).max())
        if not size[0] > 1e-13 * largest:  # a combination has no scatter but rounding
            return location, root, root @ _singular(x.T, w)[1][-1]
        location = location + np.linalg.solve(root.T, shift)
        root = root @ (axes / size)
        stretch = np.abs(size - 1).max()
        if max(stretch, np.abs(shift).max()) < 1e-9:
            break
        squares = np.square((axes / size).T @ x).sum(axis=0)
        w = weights / (1 + squares / degrees)
        w = w / w.sum()
    # Smallest variance of a combination of outputs, in units of their spread. Below 1e-10 it is the
    # rounding of measurements.
    inverse = np.linalg.inv(root)
    _, least, combinations = np.linalg.svd(inverse / np.sqrt((inverse**2).sum(axis=0)))
    is_dependent = least[-1] ** 2 < 1e-10 or stretch > 1e-9
    return location, root, combinations[-1] if is_dependent else None


def _singular(x: Floats, weights: Floats) -> ArrayPair:
    """Return square roots of the eigenvalues of a second moment, and eigenvectors as rows."""
    _, size, axes = np.linalg.svd(x * np.sqrt(weights)[:, None], full_matrices=False)
    return size, axes


def _listed(outputs: Indices) -> str:
    """Return the indices of outputs as text for a message."""
    return ", ".join(map(str, outputs.tolist()))
