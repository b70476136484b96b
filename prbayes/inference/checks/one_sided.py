"""Hyperparameters that the data bound from one side, such as a spread that is compatible with zero.

Estimates near such an end have no normal distribution, and no standard error. The limit is that of
a one-sided test: further on, the data would be an unlikely sample.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from prbayes._finding import Finding
from prbayes._validate import Bools, Floats
from prbayes.inference.checks.prior import PriorEnd, prior_end_findings
from prbayes.inference.prior_continuation import ends_of_prior
from prbayes.inference.refits import SamplingDistribution, is_stored, needs_refits
from prbayes.inference.resampling import observed_set
from prbayes.model.evaluator import Evaluator
from prbayes.model.parameters import THETAS
from prbayes.response.budget import budget


@dataclass(frozen=True)
class OneSidedBound:
    """A hyperparameter that the data bound from one side."""

    name: str
    value: float  # value at the optimum, in the users' own units
    limit: float  # one-sided limit with a confidence of 95 %
    is_upper: bool
    end: float  # end of the prior on the other side; NaN without an end


def bound_findings(bounds: Sequence[OneSidedBound]) -> list[Finding]:
    """Report values and limits, in one finding for upper and one for lower limits."""
    findings = []
    words = ("below", "least", "up", "larger"), ("above", "most", "down", "smaller")
    for is_upper in (True, False):
        side, most, way, size = words[is_upper]
        same = [bound for bound in bounds if bound.is_upper is is_upper]
        if not same:
            continue
        clauses = []
        for bound in same:
            end = f"values {way} to {bound.end:.3g}"
            if np.isnan(bound.end):
                end = f"all {size} values"
            clauses.append(
                f"{bound.name}: got {bound.value:.3g}, at {most} {bound.limit:.3g} (95%), and "
                f"{end} are compatible with the data"
            )
        text = (
            f"The data bound a hyperparameter from {side} only. {'; '.join(clauses)}. Report this "
            "limit, or the interval of prb.sample: there is no standard error."
        )
        findings.append(Finding("one-sided-bound", text, "optimum_or_abc.md#a-spread-near-zero"))
    return findings


def end_and_bound_findings(
    ends: list[PriorEnd],
    bounds: Sequence[OneSidedBound],
    page: str = "likelihood_findings.md#end-of-a-prior",
) -> tuple[list[Finding], set[str]]:
    """Report ends of priors, and bounds of the other hyperparameters; return the names as well."""
    names = {end.name for end in ends}
    bounds = [bound for bound in bounds if bound.name not in names]
    findings = [*prior_end_findings(ends, page), *bound_findings(bounds)]
    return findings, names | {bound.name for bound in bounds}


def one_sided_bounds(
    evaluator: Evaluator,
    theta: Floats,
    flat: Bools,
    statistic: Callable[[Floats, int], float],
) -> list[OneSidedBound]:
    """Return the ``flat`` elements, (d,), that exceed a limit on one side of theta, but not both.

    ``statistic`` of a theta and an element is the standardised distance of the data from the
    populations there, NaN where it is not known. The sides are searched up to four standard
    deviations of the prior from theta, and four
    beyond the median of the prior if it is on that side, at most sixteen.
    """
    hyperparameters = evaluator.hyperparameters
    _, lower, upper = ends_of_prior(hyperparameters, theta)
    to_median = np.median(hyperparameters.prior_thetas(THETAS, 0), axis=0) - theta
    bounds = []
    for i in np.flatnonzero(flat).tolist():
        unit = hyperparameters.prior_sd[i]
        limits = [
            _limit(theta, i, statistic, sign * unit, np.clip(sign * to_median[i] / unit, 0, 12) + 4)
            for sign in (1, -1)
        ]
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
    theta: Floats, i: int, statistic: Callable[[Floats, int], float], unit: float, most: float
) -> float:
    """Return the i-th element at the limit, or NaN if none is within ``most`` units."""
    # distance and statistic of the last point below the limit
    place, below = theta.copy(), (0.0, 0.0)
    highest = float(ndtri(0.95))

    def at(distance: float) -> float:
        place[i] = theta[i] + distance * unit
        return statistic(place, i)

    for distance in (0.25, 0.5, *np.arange(1, np.ceil(most) + 1).tolist()):
        value = at(distance)
        if value >= highest:
            break
        if np.isfinite(value):
            below = distance, value
        elif not below[1]:
            below = distance, 0.0
    else:
        return np.nan
    above = distance, value

    def crossing() -> float:
        """Return the distance at which the line through both points reaches the limit."""
        return float(np.interp(highest, [below[1], above[1]], [below[0], above[0]]))

    for _ in range(2):  # regula falsi
        middle = crossing()
        value = at(middle)
        if value >= highest:
            above = middle, value
        elif np.isfinite(value):
            below = middle, value
    return float(theta[i] + crossing() * unit)


def is_far_from_data(sampling: SamplingDistribution, lowest: float) -> bool:
    """Return whether the distance, ``lowest``, is over three times that of data drawn there.

    Such a fit may be a local optimum.
    """
    is_distance = all(node.metric.distance for node in sampling.evaluator.nodes)
    return is_distance and lowest > 3 * sampling.noise


def bounds_by_metric(sampling: SamplingDistribution) -> list[OneSidedBound] | None:
    """Return elements that are bounded from one side, None if that would take long.

    Responses that are not stored are computed if they take less than half a minute, and the
    optimum is no poor fit: elsewhere there may then be a better one.
    """
    evaluator, scales = sampling.evaluator, sampling.scales
    is_alone = sampling.local.hidden_share > 0.9
    if not is_alone.any():
        return []
    start = time.perf_counter()
    (lowest,) = evaluator.total(sampling.theta[None], scales)
    seconds = time.perf_counter() - start
    # The search evaluates about ten points for each element, with the derivatives of the population
    # at each.
    n_populations = 20 * sampling.theta.size**2
    is_long = seconds * n_populations > 30 or budget().is_limited
    if needs_refits(evaluator):
        return None
    if not is_stored(evaluator) and (is_long or is_far_from_data(sampling, lowest)):
        return None
    noise = sampling.noise

    def statistic(theta: Floats, i: int) -> float:
        (total,) = evaluator.total(theta[None], scales)
        if not total > lowest + 0.1 * noise:
            return np.nan  # because the objective is flat, and the standard error costs more
        populations = [evaluator.populations(theta[None], k) for k in range(len(evaluator.nodes))]
        if not all(np.nansum(weights) > 0 for _, weights in populations):
            return np.nan  # because no point has a response there
        sampled = SamplingDistribution.of(evaluator, theta, scales)
        error = np.sqrt(sampled.local.in_theta[i, i])
        if not np.isfinite(error):
            return np.nan
        estimate = sampled.thetas(sampled.linear_estimates(observed_set(evaluator)))[0]
        return float(np.abs(estimate[i] - theta[i]) / error)

    return one_sided_bounds(evaluator, sampling.theta, is_alone, statistic)
