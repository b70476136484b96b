"""Conflict of prior and data, by hyperparameter (Evans and Moshonov 2006, doi:10.1214/06-BA129).

An estimate far out in its prior predictive distribution conflicts with the prior. A conflict costs
something only where the prior pulls the posterior away from the estimate. The study is
likelihood_guards, section 2.11.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from prbayes._finding import Finding
from prbayes._validate import Floats


@dataclass(frozen=True)
class PriorConflict:
    """Conflict of prior and data, by hyperparameter, (d,) each."""

    p_values: Floats  # two-sided, of the estimates in their prior predictive distributions
    adjusted: Floats  # for the number of hyperparameters (Holm 1979)
    pulls: Floats  # shifts of the posterior means from the estimates, in standard errors


def prior_conflict(
    estimate: Floats, standard_error: Floats, posterior_mean: Floats, predictive: Floats
) -> PriorConflict:
    """Return p-values and pulls of all hyperparameters.

    Size of one p-value at .05: .04 to .06. Power by hyperparameter with 10, 20 and 50 specimens
    (linear problem, sharp prior, 1000 data sets, p-values not adjusted): a mean four prior standard
    deviations off .86, .98, 1.00; a logarithm of the standard deviation three prior standard
    deviations off .36 to .55, .70 to .76, .94 to .96. The Mahalanobis distance of all
    hyperparameters together has .66, .91, 1.00 for the mean. ``predictive``, (S, d), are estimates
    from synthetic data sets at draws of the prior; 1000 suffice. Those that are not finite are left
    out.
    """
    finite = np.isfinite(predictive)
    below = (finite & (predictive <= estimate)).sum(axis=0)
    above = (finite & (predictive >= estimate)).sum(axis=0)
    p_values = np.minimum(1.0, 2 * (np.minimum(below, above) + 1) / (finite.sum(axis=0) + 1))
    pulls = np.abs(posterior_mean - estimate) / standard_error
    return PriorConflict(p_values, _holm(p_values), pulls)


def _holm(p_values: Floats) -> Floats:
    """Return p-values adjusted by Holm's step-down method."""
    order = np.argsort(p_values)
    factors = np.arange(len(p_values), 0, -1)
    adjusted = np.empty_like(p_values)
    adjusted[order] = np.minimum(1.0, np.maximum.accumulate(factors * p_values[order]))
    return adjusted


def conflict_findings(
    labels: Sequence[str],
    prior: Floats,
    estimate: Floats,
    standard_error: Floats,
    posterior_mean: Floats,
    predictive: Floats,
    *,
    threshold: float = 0.05,
    pull: float = 0.5,
) -> tuple[Finding, ...]:
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
    conflict = prior_conflict(estimate, standard_error, posterior_mean, predictive)
    findings = []
    matters = (conflict.adjusted <= threshold) & (conflict.pulls > pull)
    for j in np.flatnonzero(matters).tolist():
        center, sd = prior[:, j].mean(), prior[:, j].std(ddof=1)
        findings.append(
            Finding(
                "prior-conflict",
                f"{labels[j]}: got prior {center:.3g} +- {sd:.2g}, data {estimate[j]:.3g} +- "
                f"{standard_error[j]:.2g} (p = {conflict.adjusted[j]:.1g}); the prior pulls the "
                f"posterior mean to {posterior_mean[j]:.3g}, {conflict.pulls[j]:.1f} standard "
                f"errors from the data, expected at most {pull:g}; check the units and the prior, "
                "or widen it.",
                "likelihood.md#prior-conflict",
            )
        )
    return tuple(findings)
