"""Hyperparameters that the data bound from one side, such as a spread that is compatible with zero.

Estimates near such an end have no normal distribution, and no standard error. The limit is that of
a one-sided test: further on, the data would be an unlikely sample.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from prbayes._finding import Finding
from prbayes._validate import Floats
from prbayes.inference.prior_continuation import ends_of_prior
from prbayes.inference.refits import SamplingDistribution, is_stored, needs_refits
from prbayes.inference.resampling import observed_set
from prbayes.model.evaluator import Evaluator


@dataclass(frozen=True)
class OneSidedBound:
    """A hyperparameter that the data bound from one side."""

    name: str
    value: float  # of the optimum, in the users' own units
    limit: float  # one-sided, 95%
    is_upper: bool
    end: float  # of the prior on the other side; NaN without one

    @property
    def finding(self) -> Finding:
        """The value with its limit."""
        side, most = ("above", "most") if self.is_upper else ("below", "least")
        end = "" if np.isnan(self.end) else f" down to {self.end:.3g}"
        if not self.is_upper:
            end = end.replace("down", "up")
        text = (
            f"The data bound {self.name} from {side} only: got {self.value:.3g}, at {most} "
            f"{self.limit:.3g} (95%), and values{end} are compatible with them; report this limit, "
            "or the interval of prb.sample. It has no standard error."
        )
        return Finding("one-sided-bound", text, "optimum_or_abc.md#a-spread-near-zero")


def one_sided_bounds(
    evaluator: Evaluator,
    theta: Floats,
    flat: NDArray[np.bool_],
    statistic: Callable[[Floats, int], float],
) -> list[OneSidedBound]:
    """Return the ``flat`` elements, (d,), that exceed a limit on one side of theta, but not both.

    ``statistic`` of a theta and an element is the standardised distance of the data from the
    populations there, NaN where it is not known. The sides are searched up to four standard
    deviations of the prior from theta.
    """
    hyperparameters = evaluator.hyperparameters
    _, lower, upper = ends_of_prior(hyperparameters, theta)
    bounds = []
    for i in np.flatnonzero(flat).tolist():
        limits = [_limit(hyperparameters.prior_sd[i], theta, i, statistic, s) for s in (1, -1)]
        if np.isnan(limits).sum() != 1:
            continue
        is_upper = not np.isnan(limits[0])
        place = theta.copy()
        place[i] = np.nansum(limits)
        value, limit = (float(ends_of_prior(hyperparameters, x)[0][i]) for x in (theta, place))
        name = hyperparameters.readable_names[i]
        end = float((lower if is_upper else upper)[i])
        bounds.append(OneSidedBound(name, value, limit, is_upper, end))
    return bounds


def _limit(
    unit: float, theta: Floats, i: int, statistic: Callable[[Floats, int], float], sign: int
) -> float:
    """Return the i-th element at the limit on one side, NaN without one."""
    place, below = theta.copy(), (0.0, 0.0)  # distance and statistic
    highest = float(norm.ppf(0.95))

    def at(distance: float) -> float:
        place[i] = theta[i] + sign * distance * unit
        return statistic(place, i)

    for distance in (0.25, 0.5, 1.0, 2.0, 4.0):
        value = at(distance)
        if value >= highest:
            break
        if np.isfinite(value):
            below = distance, value
    else:
        return np.nan
    above = distance, value
    for _ in range(2):  # regula falsi
        middle = float(np.interp(highest, [below[1], above[1]], [below[0], above[0]]))
        value = at(middle)
        if value >= highest:
            above = middle, value
        elif np.isfinite(value):
            below = middle, value
    middle = np.interp(highest, [below[1], above[1]], [below[0], above[0]])
    return float(theta[i] + sign * middle * unit)


def bounds_by_metric(sampling: SamplingDistribution) -> list[OneSidedBound]:
    """Return elements that are bounded from one side; computes no response."""
    evaluator, scales = sampling.evaluator, sampling.scales
    is_alone = (sampling.local.unidentified**2).sum(axis=1) > 0.9
    if not is_alone.any() or not is_stored(evaluator) or needs_refits(evaluator):
        return []

    noise = sum(item.noise_floor / s for item, s in zip(sampling.information, scales, strict=True))
    (lowest,) = evaluator.total(sampling.theta[None], scales)

    def statistic(theta: Floats, i: int) -> float:
        (total,) = evaluator.total(theta[None], scales)
        if not total > lowest + 0.1 * noise:
            return np.nan  # flat: saves the standard error
        sampled = SamplingDistribution.of(evaluator, theta, scales)
        error = np.sqrt(sampled.local.in_theta[i, i])
        if not np.isfinite(error):
            return np.nan
        estimate = sampled.thetas(sampled.linear_estimates(observed_set(evaluator)))[0]
        return float(np.abs(estimate[i] - theta[i]) / error)

    return one_sided_bounds(evaluator, sampling.theta, is_alone, statistic)
