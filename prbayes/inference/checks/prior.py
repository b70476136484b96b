"""Checks of the prior: hyperparameters pushed to an end of it, and its conflict with the data.

At an end nothing changes in unconstrained space, as for unidentified hyperparameters. But back at
the middle of the prior the objective is larger by more than sampling noise.

An estimate far out in its prior predictive distribution conflicts with the prior (Evans and
Moshonov 2006, doi:10.1214/06-BA129). A conflict costs something only where the prior pulls the
posterior away from the estimate. The study is likelihood_guards, section 2.11.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from prbayes._finding import Finding, Findings
from prbayes._validate import ArrayPair, Bools, Floats
from prbayes.inference.prior_continuation import ends_of_prior
from prbayes.inference.refits import SamplingDistribution, is_stored
from prbayes.model.evaluator import Evaluator, only_through_prior
from prbayes.model.parameters import THETAS


@dataclass(frozen=True)
class PriorEnd:
    """A hyperparameter at an end of its prior."""

    name: str
    value: float  # value at the optimum, in the users' own units
    bound: float  # the end of the prior

    def __str__(self) -> str:
        return f"{self.name} to {self.value:.4g}, next to the end of its prior at {self.bound:.4g}"


def elements_at_prior_ends(
    evaluator: Evaluator,
    theta: Floats,
    flat: Bools,
    objective: Callable[[Floats], float],
    rise: float,
) -> list[PriorEnd]:
    """Return the ``flat`` elements, (d,), that the data push to an end of their prior.

    With the element at the median of its prior, the objective is higher than at theta by more than
    ``rise``, whatever the other elements, and at the end itself it is not higher. A lower end at
    zero without an upper end is not one: that is a population without scatter.
    """
    from scipy.optimize import minimize as scipy_minimize

    if not flat.any():
        return []
    hyperparameters = evaluator.hyperparameters
    prior = hyperparameters.prior_thetas(THETAS, 0)
    below = (prior <= theta).mean(axis=0)
    is_outermost = (below < 0.05) | (below > 0.95)
    values, lower, upper = ends_of_prior(hyperparameters, theta)
    lower = np.where((lower == 0) & np.isnan(upper), np.nan, lower)
    ends = []
    for i in np.flatnonzero(flat & is_outermost).tolist():
        bound = upper[i] if below[i] > 0.5 else lower[i]
        if np.isnan(bound):
            continue
        start = theta.copy()
        start[i] = np.median(prior[:, i])

        def along(x: Floats, start: Floats = start, i: int = i) -> float:
            return objective(start + np.insert(x, i, 0.0) * hyperparameters.prior_sd)

        # A coarse search suffices, because only its minimum is compared with the limit.
        origin = np.zeros(theta.size - 1)
        options = {
            "maxfev": 100 * theta.size,
            "initial_simplex": np.vstack([origin, np.eye(origin.size)]),
            "fatol": 0.01 * rise,
            "xatol": 1e-2,
        }
        at_end = theta.copy()
        at_end[i] += np.copysign(10 * hyperparameters.prior_sd[i], below[i] - 0.5)
        if objective(at_end) > objective(theta) + 1e-3 * rise:
            continue  # because the minimum lies before the end
        limit, lowest = objective(theta) + rise, along(origin)
        # The objective is infinite where no design has points.
        if origin.size and limit < lowest < np.inf:
            lowest = scipy_minimize(along, origin, method="Nelder-Mead", options=options).fun
        if lowest > limit:
            name = hyperparameters.readable_names[i]
            ends.append(PriorEnd(name, float(values[i]), float(bound)))
    return ends


def ends_by_metric(sampling: SamplingDistribution) -> list[PriorEnd]:
    """Return the elements that are pushed to an end of their prior; computes no response."""
    evaluator, scales = sampling.evaluator, sampling.scales
    # The limit excludes elements that only replace each other, whose squared loadings are a half
    # each.
    is_alone = sampling.local.hidden_share > 0.9
    is_alone &= ~only_through_prior(evaluator)
    if not is_alone.any() or not is_stored(evaluator):
        return []

    def total(theta: Floats) -> float:
        return float(evaluator.total(theta[None], scales)[0])

    return elements_at_prior_ends(evaluator, sampling.theta, is_alone, total, sampling.noise)


def prior_end_findings(
    ends: list[PriorEnd], page: str = "likelihood_findings.md#end-of-a-prior"
) -> list[Finding]:
    """Report ends of priors in one finding."""
    if not ends:
        return []
    text = (
        f"The data push {', and '.join(map(str, ends))}: widen the prior, or check the units, the "
        "response and the family of the inputs."
    )
    return [Finding("prior-end", text, page)]


def prior_conflict(estimate: Floats, predictive: Floats) -> ArrayPair:
    """Return p-values of estimates in their prior predictive distributions, plain and adjusted.

    P-values, (d,), are two-sided; they are adjusted for the number of hyperparameters by Holm's
    step-down method (1979). ``predictive``, (S, d), are estimates from synthetic data sets at draws
    of the prior; 1000 suffice. Those that are not finite are left out. Size of one p-value at .05:
    .04 to .06. Power with 10, 20 and 50 specimens (linear problem, sharp prior, 1000 data sets): a
    mean four prior standard deviations off .86, .98, 1.00; a logarithm of the standard deviation
    three off .36 to .55, .70 to .76, .94 to .96.
    """
    finite = np.isfinite(predictive)
    below = (finite & (predictive <= estimate)).sum(axis=0)
    above = (finite & (predictive >= estimate)).sum(axis=0)
    p_values = np.minimum(1.0, 2 * (np.minimum(below, above) + 1) / (finite.sum(axis=0) + 1))
    order = np.argsort(p_values)
    factors = np.arange(len(p_values), 0, -1)
    adjusted = np.empty_like(p_values)
    adjusted[order] = np.minimum(1.0, np.maximum.accumulate(factors * p_values[order]))
    return p_values, adjusted


def conflict_findings(
    labels: Sequence[str],
    prior: Floats,
    estimate: Floats,
    standard_error: Floats,
    posterior_mean: Floats,
    predictive: Floats,
) -> Findings:
    """Return a finding ``prior-conflict`` of each hyperparameter in conflict.

    With a wide prior a conflict is certain to be seen and costs nothing (pulls of .1 to .6 standard
    errors). With a sharp one, four prior standard deviations off, the pull is 1.5 to 2. ``prior``
    are draws, (S, d); the arrays behind it are those of `prior_conflict`.

    Examples
    --------
    >>> import numpy as np
    >>> rng = np.random.default_rng(0)
    >>> prior = rng.normal(10, 0.3, (1000, 1))
    >>> predictive = prior + rng.normal(0, 0.2, (1000, 1))
    >>> (finding,) = conflict_findings(
    ...     ["mu"], prior, np.array([11.2]), np.array([0.2]), np.array([10.83]), predictive
    ... )
    >>> finding.text.split("; ")[0]
    'mu: got prior 9.99 +- 0.29, data 11.2 +- 0.2 (p = 0.004)'
    """
    _, p_values = prior_conflict(estimate, predictive)
    # shifts of the posterior means from the estimates, in standard errors
    pulls = np.abs(posterior_mean - estimate) / standard_error
    findings, pull = [], 0.5
    matters = (p_values <= 0.05) & (pulls > pull)
    for j in np.flatnonzero(matters).tolist():
        center, sd = prior[:, j].mean(), prior[:, j].std(ddof=1)
        text = (
            f"{labels[j]}: got prior {center:.3g} +- {sd:.2g}, data {estimate[j]:.3g} +- "
            f"{standard_error[j]:.2g} (p = {p_values[j]:.1g}); the prior pulls the "
            f"posterior mean to {posterior_mean[j]:.3g}, {pulls[j]:.1f} standard errors "
            f"from the data, expected at most {pull:g}; check the units and the prior, or widen it."
        )
        findings.append(Finding("prior-conflict", text, "likelihood_findings.md#prior-conflict"))
    return tuple(findings)
