"""Hyperparameters that the data push to an end of their prior.

In unconstrained space nothing changes there, as for unidentified hyperparameters. But back at the
middle of the prior the discrepancy is larger by more than sampling noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from prbayes._finding import Finding
from prbayes._validate import Floats
from prbayes.inference.refits import SamplingDistribution, is_stored
from prbayes.model.evaluator import Evaluator, only_through_prior
from prbayes.model.parameters import THETAS


@dataclass(frozen=True)
class PriorEnd:
    """A hyperparameter at an end of its prior."""

    name: str
    value: float  # of the optimum, in the users' own units
    bound: float  # the end of the prior

    def __str__(self) -> str:
        return f"{self.name} to {self.value:.4g}, next to the end of its prior at {self.bound:.4g}"


def prior_ends(sampling: SamplingDistribution, seed: int = 0) -> list[PriorEnd]:
    """Return the elements that the data push to an end of their prior; computes no response.

    A lower end at zero without an upper end is not one: that is a population without scatter.
    """
    evaluator, local, theta = sampling.evaluator, sampling.local, sampling.theta
    if not local.unidentified.size or not is_stored(evaluator):
        return []
    # Two elements that only replace each other have a squared loading of a half each.
    is_alone = (local.unidentified**2).sum(axis=1) > 0.9
    is_alone &= ~only_through_prior(evaluator)
    prior = evaluator.hyperparameters.prior_thetas(THETAS, seed)
    below = (prior <= theta).mean(axis=0)
    is_outermost = (below < 0.05) | (below > 0.95)
    ends = []
    for i in np.flatnonzero(is_alone & is_outermost).tolist():
        value, bound = end_of_range(evaluator, theta, i, is_upper=bool(below[i] > 0.5))
        if np.isfinite(bound) and _is_pushed(sampling, i, float(np.median(prior[:, i]))):
            ends.append(PriorEnd(evaluator.hyperparameters.readable_names[i], value, bound))
    return ends


def end_of_range(
    evaluator: Evaluator, theta: Floats, i: int, *, is_upper: bool
) -> tuple[float, float]:
    """Return an element in the users' own units, and the end of its range on one side, or NaN."""
    # A transform is at its end if a point far out has the value of one much farther out.
    steps = np.outer([0.0, 1e3, 1e6, -1e3, -1e6], np.eye(theta.size)[i])
    thetas = theta + steps * evaluator.hyperparameters.prior_sd
    with np.errstate(over="ignore"):
        variables = evaluator.hyperparameters.constrained(thetas).values()
    values = np.column_stack([np.reshape(value, (len(thetas), -1)) for value in variables])
    if values.shape != thetas.shape:  # elements without values of their own, as of a simplex
        return np.nan, np.nan
    value, *far = values[:, i]
    above, below = (a if a == b and np.isfinite(a) else np.nan for a, b in (far[:2], far[2:]))
    if is_upper:
        return float(value), float(above)
    without_scatter = below == 0 and np.isnan(above)
    return float(value), np.nan if without_scatter else float(below)


def _is_pushed(sampling: SamplingDistribution, i: int, middle: float) -> bool:
    """Return whether the middle of an element's prior is worse by more than noise.

    At the best values of the other elements there: an element that they can replace is not pushed.
    """
    from scipy.optimize import minimize as scipy_minimize

    evaluator, theta = sampling.evaluator, sampling.theta
    noise = np.array([information.noise_floor for information in sampling.information])

    def is_worse(point: Floats) -> bool:
        at_theta, at_point = evaluator(np.stack([theta, point])).discrepancies
        with np.errstate(invalid="ignore"):
            # NaN, as where no design reaches, is worse.
            return not bool((at_point - at_theta <= noise).all())

    back = theta.copy()
    back[i] = middle
    if not is_worse(back):
        return False
    rest = np.delete(np.arange(theta.size), i)
    if not rest.size:
        return True
    unit = evaluator.hyperparameters.prior_sd[rest]

    def along(x: Floats) -> float:
        point = back.copy()
        point[rest] += x * unit
        (value,) = evaluator.total(point[None], sampling.scales)
        return float(value)

    # A coarse search suffices.
    start = np.zeros(rest.size)
    options = {
        "maxfev": 100 * theta.size,
        "initial_simplex": np.vstack([start, np.eye(rest.size)]),
        "fatol": 1e-4,
        "xatol": 1e-2,
    }
    back[rest] += scipy_minimize(along, start, method="Nelder-Mead", options=options).x * unit
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
