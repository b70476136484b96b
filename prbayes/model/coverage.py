"""Whether a design supports the populations at given hyperparameters, and where it falls short."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from prbayes._validate import Floats
from prbayes.model.evaluator import Evaluator


@dataclass(frozen=True)
class Requirement:
    """How well a design has to support populations."""

    ess: float  # median weight effective sample size, as a share of the design's required one
    lowest_ess: float  # the same at the 5% quantile
    # Bounds of the mean raw weight, which is one if the design covers the population.
    mass: tuple[float, float]
    tails: bool  # whether 5% and 95% quantiles of the mean raw weight are bounded, or the median


# Of the optimiser and the samplers, whose designs grow until they meet it. A mean weight of 0.8 to
# 1.25 is a fifth of the population's mass either way. Half the effective sample size moves an
# optimum by .05 standard errors; twice is more than 1024 points give with two inputs
# (docs/constants.md).
ENOUGH = Requirement(ess=1.0, lowest_ess=0.1, mass=(0.8, 1.25), tails=True)
# Of predictions, whose designs do not grow. Laxer: draws at the edge of a posterior are less well
# supported than its centre, and resampling needs no derivative.
TOLERABLE = Requirement(ess=0.5, lowest_ess=0.0, mass=(0.7, 1.4), tails=False)
# Of plots: a curve may be worse than an estimate. A curve of fewer than ten responses, a fifth of
# the smallest requirement, would show the design.
VISIBLE = Requirement(ess=0.2, lowest_ess=0.2, mass=(0.5, 2.0), tails=False)


@dataclass(frozen=True)
class Shortcoming:
    """Requirements that a design does not meet for populations; false if it meets all."""

    # Share of a population's weight on points without response, at the 95% quantile, if too much.
    lost: float | None
    # Weight effective sample size, 5% quantile and median, if too small.
    ess: tuple[float, float] | None
    mass: tuple[float, float] | None  # mean raw weight, lowest and highest, if out of bounds
    max_lost: float
    required_ess: float
    n_points: int
    requirement: Requirement

    def __bool__(self) -> bool:
        """Whether the design falls short of a requirement."""
        return any(value is not None for value in (self.lost, self.ess, self.mass))

    def __str__(self) -> str:
        """Return what was got and expected, as the end of a sentence."""
        if self.lost is not None:
            return (
                f"lost mass: {self.lost:.1%} of a population's weight is on points whose response "
                f"is NaN, expected at most max_lost = {self.max_lost:.1%}"
            )
        complaints = []
        if self.ess is not None:
            low, middle = self.ess
            least = self.requirement.lowest_ess * self.required_ess
            need = self.requirement.ess * self.required_ess
            complaints.append(
                f"weight effective sample size {low:.0f} (5% quantile) and {middle:.0f} (median) "
                f"of {self.n_points} points, expected {least:.0f} and {need:.0f}"
            )
        if self.mass is not None:
            low, high = self.mass
            least, most = self.requirement.mass
            complaints.append(
                f"mean raw weight from {low:.2f} to {high:.2f}, expected within {least} to {most}"
            )
        return ", and ".join(complaints)


def shortcomings(evaluator: Evaluator, thetas: Floats) -> dict[str, Shortcoming]:
    """Return how designs fall short for populations at thetas, (P, d), by simulator."""
    result = {}
    for name, support in evaluator.support(thetas).items():
        bound = evaluator.reweighted[name]
        short = shortcoming(support, bound.required_ess, bound.max_lost, bound.n_points, ENOUGH)
        if short:
            result[name] = short
    return result


def supports_each(
    support: dict[str, Floats], required_ess: float, max_lost: float, requirement: Requirement
) -> NDArray[np.bool_]:
    """Return which populations a design supports, shape (P,); parameters as in `shortcoming`."""
    ess, mass, lost = (support[key] for key in ("weight_ess", "mean_weight", "lost_mass"))
    least, most = requirement.mass
    covered = (mass >= least) & (mass <= most)
    # A sum of zero weights may be rounded.
    lost_little = lost <= max(max_lost, 1e-12)
    return np.asarray((ess >= requirement.ess * required_ess) & covered & lost_little)


def shortcoming(
    support: dict[str, Floats],
    required_ess: float,
    max_lost: float,
    n_points: int,
    requirement: Requirement,
) -> Shortcoming:
    """Return how a design of n points falls short of its required effective sample size.

    ``support`` has ``weight_ess``, ``mean_weight`` and ``lost_mass`` of the populations, (P,).
    """
    ess, mass, lost = (support[key] for key in ("weight_ess", "mean_weight", "lost_mass"))
    # Single populations far out may fall short.
    low, middle = np.quantile(ess, [0.05, 0.5])
    at = [0.05, 0.95] if requirement.tails else [0.5, 0.5]
    mass_low, mass_high = np.quantile(mass, at)
    most_lost = float(np.quantile(lost, 0.95))
    least, most = requirement.mass
    # A comparison with NaN is false: the design falls short.
    has_ess = (
        middle >= requirement.ess * required_ess and low >= requirement.lowest_ess * required_ess
    )
    is_covered = mass_low >= least and mass_high <= most
    return Shortcoming(
        lost=most_lost if most_lost > max_lost else None,
        ess=(float(low), float(middle)) if not has_ess else None,
        mass=(float(mass_low), float(mass_high)) if not is_covered else None,
        max_lost=max_lost,
        required_ess=required_ess,
        n_points=n_points,
        requirement=requirement,
    )
