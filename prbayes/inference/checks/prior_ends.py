"""Hyperparameters that the data push to an end of their prior, as where this excludes what is true.

In unconstrained space nothing changes out there, so that they look like hyperparameters of which
the data tell nothing. But back at the middle of the prior the discrepancy is larger by more than
sampling noise: the data do tell, and ask for more than the prior allows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from prbayes._finding import Finding
from prbayes._validate import Floats
from prbayes.inference.refits import SamplingDistribution
from prbayes.model.evaluator import Evaluator, only_through_prior
from prbayes.model.parameters import THETAS

# Part of the prior that is its end.
_TAIL_OF_PRIOR = 0.05
# Squared loading from which a direction that is not identified is an element alone; two that only
# stand for each other have a half each.
_BY_ITSELF = 0.9
# Where a transform has come to the end of its range, in spreads of the prior: two places, far out
# and much farther.
_FAR_OUTSIDE = (1e3, 1e6)
# Evaluations for each element, some hundred microseconds each, in the rare case.
_TRIES = 100


@dataclass(frozen=True)
class PriorEnd:
    """A hyperparameter at an end of its prior."""

    name: str
    value: float  # of the optimum, in the users' own units
    bound: float  # where the prior ends

    def __str__(self) -> str:
        return f"{self.name} to {self.value:.4g}, next to the end of its prior at {self.bound:.4g}"


def at_prior_ends(sampling: SamplingDistribution, seed: int = 0) -> list[PriorEnd]:
    """Return the elements that the data push to an end of their prior; costs no response if stored.

    A lower end at zero of what has no other end is none: that is a population without scatter.
    """
    evaluator = sampling.evaluator
    local = sampling.local
    if not local.unidentified.size or not all(node.bound.stored for node in evaluator.nodes):
        return []
    alone = (local.unidentified**2).sum(axis=1) > _BY_ITSELF
    alone &= ~only_through_prior(evaluator)
    theta = sampling.theta
    prior = evaluator.hyperparameters.prior_thetas(THETAS, seed)
    below = (prior <= theta).mean(axis=0)
    outermost = (below < _TAIL_OF_PRIOR) | (below > 1 - _TAIL_OF_PRIOR)
    found = []
    for i in np.flatnonzero(alone & outermost):
        up = bool(below[i] > 0.5)
        value, bound = end_of_range(evaluator, theta, int(i), up=up)
        if np.isfinite(bound) and _pushed(sampling, int(i), float(np.median(prior[:, i]))):
            found.append(PriorEnd(evaluator.hyperparameters.readable_names[i], value, bound))
    return found


def end_of_range(evaluator: Evaluator, theta: Floats, i: int, *, up: bool) -> tuple[float, float]:
    """Return an element in the users' own units, and where its range ends on one side, or NaN."""
    steps = np.outer([0.0, *_FAR_OUTSIDE, *np.negative(_FAR_OUTSIDE)], np.eye(theta.size)[i])
    thetas = theta + steps * evaluator.hyperparameters.prior_sd
    with np.errstate(over="ignore"):
        own = evaluator.hyperparameters.constrained(thetas)
    values = np.column_stack([np.reshape(one, (len(thetas), -1)) for one in own.values()])
    if values.shape != thetas.shape:  # elements that are no numbers of their own, as of a simplex
        return np.nan, np.nan
    here, *ends = values[:, i]
    above, below = (a if a == b and np.isfinite(a) else np.nan for a, b in (ends[:2], ends[2:]))
    if up:
        return float(here), float(above)
    without_scatter = below == 0 and np.isnan(above)
    return float(here), np.nan if without_scatter else float(below)


def _pushed(sampling: SamplingDistribution, i: int, middle: float) -> bool:
    """Return whether an element's return to the middle of its prior makes it worse than noise.

    Whatever the others do: one that they can stand for is not pushed.
    """
    from scipy.optimize import minimize

    evaluator = sampling.evaluator
    noise = np.array([one.noise_floor for one in sampling.information])

    def is_worse(theta: Floats) -> bool:
        here, there = evaluator(np.stack([sampling.theta, theta])).discrepancies
        with np.errstate(invalid="ignore"):
            # What is no number, as where no design reaches, is worse.
            return not bool((there - here <= noise).all())

    others = np.delete(np.arange(sampling.theta.size), i)
    back = sampling.theta.copy()
    back[i] = middle
    if not is_worse(back):
        return False
    if not others.size:
        return True

    def along(x: Floats) -> float:
        moved = back.copy()
        moved[others] += x * evaluator.hyperparameters.prior_sd[others]
        (value,) = evaluator.total(moved[None], sampling.scales)
        return float(value)

    # It is to find a way back if there is one, and not its end to many digits.
    begin = np.zeros(others.size)
    options = {
        "maxfev": _TRIES * sampling.theta.size,
        "initial_simplex": np.vstack([begin, np.eye(others.size)]),
        "fatol": 1e-4,
        "xatol": 1e-2,
    }
    found = minimize(along, begin, method="Nelder-Mead", options=options)
    back[others] += found.x * evaluator.hyperparameters.prior_sd[others]
    return is_worse(back)


def prior_end_findings(
    ends: list[PriorEnd], page: str = "likelihood.md#end-of-a-prior"
) -> list[Finding]:
    """Report ends of priors."""
    return [
        Finding(
            "prior-end",
            f"The data push {end}, and ask for more than it allows: widen the prior, or look at "
            "units, at the response and at the family of the inputs.",
            page,
        )
        for end in ends
    ]
