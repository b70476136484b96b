r"""The likelihood of statistics of n specimens: mean, standard deviation, extremes and quantiles.

Extremes and quantiles are order statistics :math:`z_1 \le \dots \le z_I` of ranks :math:`r_i`. They
divide the other specimens into strata of :math:`n_j` each, with population shares :math:`P_j`:

.. math:: p(z_1, \dots, z_I | \theta) \propto \prod_i f(z_i) \prod_j P_j^{n_j}.       (1)

Given the order statistics, the specimens of a stratum are independent draws from the population
between its ends. Mean and variance of their sum A, and of the sum of squares W about the mean of
all specimens, follow from the first four moments of each stratum. A is nearly normal, and the cube
root of W as well (Wilson and Hilferty 1931, doi:10.1073/pnas.17.12.684):

.. math:: W / E W \sim M \chi^2_\nu / \nu, \quad (\chi^2_\nu / \nu)^{1/3} \sim
    N(1 - 2 / (9 \nu), 2 / (9 \nu)).                                                   (2)

For a normal population without order statistics, nu is n - 1 and M is one. A smaller variance of W
makes nu larger. A larger one, by heavy tails, is that of a lognormal M with mean one and variance v
of its logarithm, :math:`1 + Var W / (E W)^2 = e^v (1 + 2 / \nu)`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, ClassVar, Self

import numpy as np
from scipy.special import ndtr, ndtri

from prbayes._validate import AT_ONCE, Floats
from prbayes.metrics.base import Basis, DenseBasis, Discrepancy, Features, Metric, Minimum
from prbayes.metrics.likelihood import LogLikelihood
from prbayes.metrics.summary import Summary


@dataclass(frozen=True)
class SummaryLikelihood(Metric):
    """Minus the mean log-likelihood of the statistics of a `Summary`, for each specimen."""

    summary: Summary
    minimum: ClassVar[Minimum] = Minimum.QUADRATIC
    likelihood: ClassVar[bool] = True
    distance: ClassVar[bool] = False
    exact_likelihood: ClassVar[bool] = True
    additive = False

    def __post_init__(self) -> None:
        if self.summary.order_statistics.size:  # densities at them have a kernel, too
            object.__setattr__(self, "tail_responses", LogLikelihood.tail_responses)

    @property
    def data_sheet(self) -> str:
        """The statistics as text."""
        return statistics_text(self.summary)

    def _prepare(self, observed: Floats, weights: Floats) -> Discrepancy:
        summary = self.summary
        if not np.array_equal(observed, summary.values):
            raise ValueError(
                f"observed: got {observed.tolist()!s:.60}, expected the values of the Summary that "
                "the simulator was made with, which has no single specimens; build the model again "
                "with another Summary"
            )
        rank, value = summary.order_statistics.T
        knots = (value - summary.center) / (summary.unit or 1.0)
        counts = np.maximum(np.diff(rank, prepend=0.0, append=summary.n + 1.0) - 1, 0.0)
        return SummaryDiscrepancy(self, observed, weights, summary, knots, counts)


def statistics_text(summary: Summary) -> str:
    """Return the statistics of a data sheet as text."""
    statistics = vars(summary).items()
    return ", ".join(f"{name} = {x!r}" for name, x in statistics if x is not None)


@dataclass(frozen=True, eq=False)
class SummaryDiscrepancy(Discrepancy):
    """Minus log-likelihood over n. Features are moments of strata, and densities at the knots.

    Attributes
    ----------
    summary : Summary
    knots : ndarray, shape (I,)
        The order statistics, standardised.
    counts : ndarray, shape (I + 1,)
        Numbers of other specimens between them.
    """

    summary: Summary
    knots: Floats
    counts: Floats

    def with_observed(self, observed: Floats, weights: Floats | None = None) -> Self:
        """Return the same discrepancy: there are no specimens that others could replace."""
        return self

    def rows(self, index: Any) -> Self:
        """Return the same discrepancy, that of the only data set."""
        return self

    @property
    def n_effective(self) -> float:
        """The number of specimens."""
        return float(self.summary.n)

    def replicate(self, specimens: Floats) -> Floats:
        """Return the same statistics of other specimens, (..., n) -> (..., statistics)."""
        return self.summary.values_of(specimens)

    @property
    def scale(self) -> float:
        """One: a log-likelihood has no units."""
        return 1.0

    @property
    def _powers(self) -> int:
        """The number of moments of each stratum that the statistics need, from order zero."""
        return 5 if self.summary.sd is not None else 3 if self.summary.mean is not None else 1

    def columns(self, simulated: Any, xp: Any) -> list[Any]:
        """Return the features of single responses, (..., n) each.

        For each power the terms of the strata, then densities at the knots. The kernel of the
        densities also smooths the ends of the strata.
        """
        is_known = has_response(simulated, xp)
        z = self._standardised(simulated, xp)
        width = _smoothing_width(self.summary.n)
        steps = [(knot - z) / width for knot in self.knots]
        below = [0.0, *(_normal_cdf(step, xp) for step in steps), 1.0]
        shares = [high - low for low, high in pairwise(below)]
        columns = [share * z**power for power in range(self._powers) for share in shares]
        columns += [xp.exp(-0.5 * step**2) / (width * np.sqrt(2 * np.pi)) for step in steps]
        return [xp.where(is_known, column, 0.0) for column in columns]

    def influences(self, simulated: Any, xp: Any) -> list[Any]:
        """Return what a specimen adds to each statistic, (..., n) each, in the order of scores.

        It is one for an order statistic below the response, the response, and its square.
        """
        z = self._standardised(simulated, xp)
        width = _smoothing_width(self.summary.n)
        below = [_normal_cdf((knot - z) / width, xp) for knot in self.knots]
        terms = [1.0 - share for share in below]
        if self._powers > 1 and self.counts.any():
            summary = self.summary
            if summary.mean is not None:
                terms.append(z)
            if summary.sd is not None and not _sd_follows(summary, self.counts):
                terms.append(z**2)
        return terms

    def _standardised(self, simulated: Any, xp: Any) -> Any:
        """Return standardised responses; zero is the one of a point without response."""
        center = self.summary.center
        is_known = has_response(simulated, xp)
        present = xp.where(is_known, simulated, center)
        z = (present - center) / self._unit
        return xp.clip(z, -1e4, 1e4)  # the fourth power is still exact enough

    @cached_property
    def _unit(self) -> float:
        """The unit of standardised responses."""
        return self.summary.unit or abs(self.summary.center) or 1.0

    @cached_property
    def _reference(self) -> Floats:
        """The features of a normal population with center and unit of the sample."""
        score = ndtri((np.arange(1001) + 0.5) / 1001)
        columns = self.columns(self.summary.center + self._unit * score, np)
        return np.array([np.mean(column) for column in columns])

    def features(self, simulated: Any, weights: Any, xp: Any) -> Features:
        """Return the features, (..., m)."""
        sums = [(weights * column).sum(axis=-1) for column in self.columns(simulated, xp)]
        return (xp.stack(sums, axis=-1),)

    def basis(self, simulated: Floats, most: float = AT_ONCE) -> Basis:
        """Return the matrix of the features of the responses, (n, m)."""
        return DenseBasis((np.stack(self.columns(simulated, np), axis=-1),))

    def outer(self, *features: Any, xp: Any) -> Any:
        """Return minus the log-likelihood over n."""
        log_l, _ = self.log_density(features[0], xp)
        return -log_l / self.summary.n

    def log_density(self, sums: Any, xp: Any) -> tuple[Any, list[Any]]:
        """Return the log-density of the statistics, and their normal scores.

        The score of a statistic is that of its distribution given those before it: order
        statistics, mean, standard deviation.
        """
        size = self.counts.size
        total = xp.maximum(
            sums[..., :size].sum(axis=-1), 1e-300
        )  # less than one if points have no response
        # Mix in a little of the normal population, so that logarithms and ratios are finite.
        shares = (1 - 1e-9) * sums / total[..., None] + 1e-9 * self._reference
        positive = xp.maximum(shares, 1e-300)
        mass = [positive[..., j] for j in range(size)]
        densities = [positive[..., size * self._powers + i] for i in range(size - 1)]
        log_l = sum(xp.log(density) for density in densities)  # (1)
        for count, share in zip(self.counts, mass, strict=True):
            if count:
                log_l = log_l + count * xp.log(share)
        scores = _order_scores(self.counts, mass)
        if self._powers > 1 and self.counts.any():
            moments = [
                [shares[..., size * power + j] / mass[j] for power in range(self._powers)]
                for j in range(size)
            ]
            log_sums, more = self._log_sums(moments, xp)
            log_l = log_l + log_sums
            scores += more
        return log_l, scores

    def _log_sums(self, moments: list[list[Any]], xp: Any) -> tuple[Any, list[Any]]:
        """Return the log-density of mean and standard deviation, and their normal scores.

        Both are given the order statistics, and follow from the moments of the strata.
        """
        summary = self.summary
        n = self.summary.n
        strata = [(c, m) for c, m in zip(self.counts, moments, strict=True) if c]
        expected_sum = sum(c * m[1] for c, m in strata) + self.knots.sum()
        variance = xp.maximum(sum(c * (m[2] - m[1] ** 2) for c, m in strata), 1e-12)
        log_l, scores = 0.0, []
        if summary.mean is not None:
            observed_sum = n * (summary.mean - summary.center) / self._unit
            sum_score = (observed_sum - expected_sum) / xp.sqrt(variance)
            log_l = -0.5 * sum_score**2 - 0.5 * xp.log(variance)
            scores = [sum_score]
        if summary.sd is None or _sd_follows(self.summary, self.counts):
            return log_l, scores
        expected, w_variance, covariance = self._sum_of_squares(strata, expected_sum, variance, xp)
        center, scatter = _cube_root(w_variance / expected**2, n, xp)
        sum_of_squares = (n - 1) * (summary.sd / self._unit) ** 2
        ratio = sum_of_squares / expected
        square_score = (ratio ** (1 / 3) - center) / xp.sqrt(scatter)
        log_l = log_l - 0.5 * xp.log(scatter) - xp.log(expected) / 3
        if scores:
            # The standard deviation given the mean: two normal scores with a correlation.
            correlation = covariance / xp.sqrt(variance * w_variance)
            rest = xp.maximum(1 - correlation**2, 1e-6)
            square_score = (square_score - correlation * scores[0]) / xp.sqrt(rest)
            log_l = log_l - 0.5 * xp.log(rest)
        return log_l - 0.5 * square_score**2, [*scores, square_score]

    def _sum_of_squares(
        self, strata: list[tuple[float, list[Any]]], expected_sum: Any, variance: Any, xp: Any
    ) -> tuple[Any, Any, Any]:
        """Return mean and variance of W, and its covariance with A.

        The influence of a specimen on W is its squared distance from the mean of all specimens.
        """
        n = self.summary.n
        squares = sum(c * m[2] for c, m in strata) + (self.knots**2).sum()
        expected = xp.maximum(squares - (variance + expected_sum**2) / n, 1e-12)
        mean = expected_sum / n
        w_variance, covariance = 0.0, 0.0
        for count, (_, m1, m2, m3, m4) in strata:
            # Moments of (x - mean)^2 in the stratum, and of its product with x.
            square = m2 - 2 * mean * m1 + mean**2
            fourth = m4 - 4 * mean * m3 + 6 * mean**2 * m2 - 4 * mean**3 * m1 + mean**4
            w_variance += count * (fourth - square**2)
            covariance += count * (m3 - 2 * mean * m2 + mean**2 * m1)
            covariance -= count * m1 * square
        if not self.knots.size:  # for independent specimens variance and covariance are exact
            w_variance = (n - 1) / n * w_variance + 2 * (variance / n) ** 2
        w_variance, covariance = ((n - 1) / n * moment for moment in (w_variance, covariance))
        return expected, xp.maximum(w_variance, 1e-12), covariance


def has_response(simulated: Any, xp: Any) -> Any:
    """Return whether there is a response; +inf is one above all other values, NaN is none."""
    return xp.isfinite(simulated) | (simulated > 0)


def _smoothing_width(n: int) -> float:
    """Return the width of the kernel in standard deviations.

    It is half of that in `LogLikelihood`, because the scale of a tail may be a fraction of the
    standard deviation.
    """
    return float(0.175 * n**-0.25)


def _sd_follows(summary: Summary, counts: Floats) -> bool:
    """Return whether the standard deviation follows from the mean and at most one specimen."""
    if summary.mean is None:
        return False
    return bool(counts.sum() <= 1)


def _order_scores(counts: Floats, mass: list[Any]) -> list[Any]:
    """Return normal scores of order statistics, of which each has a beta distribution.

    Given those below, the population's share below an order statistic is beta (a, b). The score is
    that of Paulson (1942, Ann. Math. Stat. 13, 233-235).
    """
    scores = []
    for i in range(len(counts) - 1):
        above = counts[i + 1 :]
        a = counts[i] + 1.0
        b = float(above.sum() + above.size)
        share_above = sum(mass[i + 1 :])
        ratio = mass[i] * b / (a * share_above)
        root = ratio ** (1 / 3)
        upper = 1 / (9 * b)
        lower = 1 / (9 * a)
        center = (1 - upper) * root - (1 - lower)
        variance = upper * root**2 + lower
        scores.append(center / variance**0.5)
    return scores


def _cube_root(relative_variance: Any, n: int, xp: Any) -> tuple[Any, Any]:
    """Return mean and variance of the cube root of W / E W, by (2)."""
    freedom = xp.maximum(2 / relative_variance, n - 1.0)
    log_variance = xp.log((1 + relative_variance) / (1 + 2 / freedom))  # v of (2)
    spread = 2 / (9 * freedom)
    center = (1 - spread) * xp.exp(-log_variance / 9)
    scatter = ((1 - spread) ** 2 + spread) * xp.exp(-log_variance / 9) - center**2
    return center, scatter


def _normal_cdf(x: Any, xp: Any) -> Any:
    """Return the distribution function of the standard normal distribution."""
    return ndtr(x) if xp is np else 0.5 * xp.erfc(-x / np.sqrt(2))
