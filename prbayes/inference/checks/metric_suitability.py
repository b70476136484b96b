"""Suitability of a metric for the data and populations at an optimum."""

from __future__ import annotations

import numpy as np

from prbayes._finding import Finding
from prbayes._stats import quantile
from prbayes._validate import Floats
from prbayes.inference.asymptotics import number_parts, one_dimensional
from prbayes.inference.resampling import dependent
from prbayes.metrics.base import Minimum, is_likelihood
from prbayes.metrics.likelihood import kernel_width
from prbayes.model.evaluator import Evaluator


def heavy_tails(evaluator: Evaluator, theta: Floats) -> list[Finding]:
    """Report stored populations under the area metric whose mean is hardly finite."""
    findings = []
    for k, node in enumerate(evaluator.nodes):
        if node.metric.minimum is not Minimum.ABSOLUTE or not node.bound.stored:
            continue
        values, weights = evaluator.populations(theta[None], k)
        projections = one_dimensional(node.target, values[0])
        index = min(_tail_index(projection, weights[0]) for projection in projections)
        # At 1024 quantiles of a half-Cauchy population 1.0, of Student's t with 1.5 degrees of
        # freedom 1.5, of a lognormal one with a spread of 2.5 1.1.
        if index < 1.1:
            findings.append(
                Finding(
                    "heavy-tail",
                    f"{node.name}: the tail of the simulated responses is so long (tail index "
                    f"{index:.2f}, of which one or less has no mean) that the area between "
                    "distribution functions is infinite, or rests on responses beyond all that "
                    "were computed: use prb.ProbabilityResidual() or prb.KullbackLeibler(), inputs "
                    "with a mean, or the logarithm of the response.",
                    "choosing_metric.md#advice",
                )
            )
    return findings


def _tail_index(values: Floats, weights: Floats) -> float:
    """Return the index of Hill (1975) of the longer tail, the outermost 2 %, from the median."""
    is_usable = np.isfinite(values) & (weights > 0)
    values, weights = values[is_usable], weights[is_usable]
    weights = weights / weights.sum()
    centered = values - quantile(values, weights, 0.5)
    indices = [np.inf]
    for side in (centered, -centered):
        start = float(quantile(side, weights, 1 - 0.02))
        is_beyond = side > start
        mass = weights[is_beyond]
        total = float(mass.sum())
        if start > 0 and total > 0:
            length = float(mass @ np.log(side[is_beyond] / start))
            indices.append(total / max(length, 1e-300))
    return min(indices)


def data_between_runs(evaluator: Evaluator, theta: Floats) -> list[Finding]:
    """Report observed values between stored responses that are farther apart than the kernel."""
    findings = []
    for k, node in enumerate(evaluator.nodes):
        if not node.bound.stored:
            continue
        values, _ = evaluator.populations(theta[None], k)
        for part in number_parts(node.target):
            width = kernel_width(part.target)
            if not width > 0:
                continue
            observed = part.target.observed
            observed = observed[np.isfinite(observed)]
            # The sum of kernels at a spacing of 2.5 widths is the density to 9 %, by Poisson's
            # summation 2 exp(-2 (pi / 2.5)^2).
            is_between = _distance_to_nearest(part.of(values[0]), observed) > 1.25 * width
            if is_between.any():
                listed = ", ".join(f"{value:.4g}" for value in observed[is_between][:3])
                findings.append(
                    Finding(
                        "data-between-runs",
                        f"{node.name}: {int(is_between.sum())} of {observed.size} observed values "
                        f"({listed}) lie between responses that are farther apart than the kernel "
                        "is wide, so that their likelihood is not known: pass a larger "
                        "prb.Reweighted(n), until the optimum stays, or use prb.KullbackLeibler().",
                        "choosing_metric.md#advice",
                    )
                )
    return findings


def _distance_to_nearest(values: Floats, points: Floats) -> Floats:
    """Return the distance of each point from the nearest of some values, (n,)."""
    finite = np.sort(values[np.isfinite(values)])
    ends = np.concatenate([[-np.inf], finite, [np.inf]])
    above = np.searchsorted(finite, points) + 1
    return np.asarray(np.minimum(ends[above] - points, points - ends[above - 1]))


def small_simulators(evaluator: Evaluator, enough: int = 30) -> list[Finding]:
    """Report simulators of so few specimens that the spread in common is estimated too small.

    Bandwidths of few data let simulators that happen to scatter little weigh most, and a sum of
    areas leaves out the scatter between their means. The probability residual is right.
    """
    nodes = evaluator.nodes
    is_biased = [
        node.metric.minimum is Minimum.ABSOLUTE or is_likelihood(node.target) for node in nodes
    ]
    fewest = min((len(node.observed) for node in nodes), default=enough)
    if len(nodes) < 2 or fewest >= enough or not any(is_biased) or dependent(nodes):
        return []
    if not _share_hyperparameters(evaluator):
        return []
    return [
        Finding(
            "small-simulators",
            f"The optimum underestimates a spread that {len(nodes)} simulators have in common, as "
            f"they have {fewest} specimens or more, expected at least {enough}: by 30% with 4, 10% "
            "with 10; take the posterior of prb.sample, which corrects for it, or "
            "prb.ProbabilityResidual(), or give one simulator all specimens of a condition.",
        )
    ]


def _share_hyperparameters(evaluator: Evaluator) -> bool:
    """Return whether an element of theta enters the populations of two simulators."""
    hyperparameters = evaluator.hyperparameters
    prior_sd = hyperparameters.prior_sd
    thetas = hyperparameters.initial + np.vstack([0 * prior_sd, np.diag(prior_sd)])
    count = np.zeros(hyperparameters.size)
    for k in range(len(evaluator.nodes)):
        moves = np.zeros(hyperparameters.size, dtype=bool)
        for root in evaluator.roots(thetas, k):
            flat = root.reshape(len(thetas), -1)
            moves |= (flat[1:] != flat[0]).any(axis=1)
        count += moves
    return bool((count > 1).any())
