"""Whether a design supports the populations at given hyperparameters, and where it falls short."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from prbayes._validate import Floats
from prbayes.model.evaluator import Evaluator


@dataclass(frozen=True)
class Level:
    """How well a design has to support populations."""

    ess: float  # weight effective sample size at the median, as a share of what the design asks for
    lowest_ess: float  # the same at the 5% quantile
    # Bounds of the mean raw weight, which is one if the design covers the population.
    mass: tuple[float, float]
    tails: bool  # whether 5% and 95% quantiles of the mean raw weight are bounded, or the median


# Where an answer is made: the optimiser and the samplers, whose designs grow until it holds. A mean
# weight of 0.8 to 1.25 is a fifth of the population's mass either way. Half the effective sample
# size moves an optimum by .05 standard errors; twice is more than 1024 points give with two inputs
# (docs/constants.md).
ENOUGH = Level(ess=1.0, lowest_ess=0.1, mass=(0.8, 1.25), tails=True)
# Where an answer is used: designs do not grow for a prediction. By judgement: laxer, as draws at
# the edge of a posterior are less well supported than its centre, and resampling needs no
# derivative.
TOLERABLE = Level(ess=0.5, lowest_ess=0.0, mass=(0.7, 1.4), tails=False)
# Where a population is drawn. By judgement: a curve may be worse than an estimate; of fewer than
# ten responses, a fifth of the least that a design asks for, it shows the design and no population.
VISIBLE = Level(ess=0.2, lowest_ess=0.2, mass=(0.5, 2.0), tails=False)


@dataclass(frozen=True)
class Shortcoming:
    """In what a design does not support populations; it can be said as text."""

    # Share of a population's weight on points without response, at the 95% quantile, if too much.
    lost: float | None
    # Weight effective sample size, 5% quantile and median, if too small.
    ess: tuple[float, float] | None
    # Mean raw weight, lowest and highest that count, if one of them is out of bounds.
    mass: tuple[float, float] | None
    max_lost: float  # the share that may be lost
    required_ess: float  # what the design asks for
    n_points: int
    level: Level

    def __bool__(self) -> bool:
        """Whether the design falls short at all."""
        shortcomings = (self.lost, self.ess, self.mass)
        return any(found is not None for found in shortcomings)

    def __str__(self) -> str:
        """Return what is wrong, and what was expected, as the end of a sentence."""
        if self.lost is not None:
            return (
                f"lost mass: {self.lost:.1%} of a population's weight is on points whose response "
                f"is NaN, expected at most max_lost = {self.max_lost:.1%}"
            )
        complaints = []
        if self.ess is not None:
            low, middle = self.ess
            least = self.level.lowest_ess * self.required_ess
            need = self.level.ess * self.required_ess
            complaints.append(
                f"weight effective sample size {low:.0f} (5% quantile) and {middle:.0f} (median) "
                f"of {self.n_points} points, expected {least:.0f} and {need:.0f}"
            )
        if self.mass is not None:
            low, high = self.mass
            least, most = self.level.mass
            complaints.append(
                f"mean raw weight from {low:.2f} to {high:.2f}, expected within {least} to {most}"
            )
        return ", and ".join(complaints)


def shortcomings(evaluator: Evaluator, thetas: Floats) -> dict[str, Shortcoming]:
    """Return, by simulator, in what its design does not support populations at thetas, (P, d)."""
    found = {}
    for name, support in evaluator.support(thetas).items():
        bound = evaluator.reweighted[name]
        short = shortcoming(support, bound.required_ess, bound.max_lost, bound.n_points, ENOUGH)
        if short:
            found[name] = short
    return found


def supports_each(
    support: dict[str, Floats], required_ess: float, max_lost: float, level: Level
) -> NDArray[np.bool_]:
    """Return which populations a design supports, each by itself, shape (P,).

    Parameters are those of `shortcoming`.
    """
    ess, mass, lost = (support[key] for key in ("weight_ess", "mean_weight", "lost_mass"))
    least, most = level.mass
    covered = (mass >= least) & (mass <= most)
    # A sum of weights that is zero may be rounded.
    lost_little = lost <= max(max_lost, 1e-12)
    return np.asarray((ess >= level.ess * required_ess) & covered & lost_little)


def shortcoming(
    support: dict[str, Floats],
    required_ess: float,
    max_lost: float,
    n_points: int,
    level: Level,
) -> Shortcoming:
    """Return in what a design falls short; it is false where it does not.

    Parameters
    ----------
    support : dict
        ``weight_ess``, ``mean_weight`` and ``lost_mass`` of each population, arrays of shape (P,).
    required_ess : float
        Weight effective sample size that the design asks for.
    max_lost : float
        Largest share of a population's weight on points without response.
    n_points : int
    level : Level
        `ENOUGH`, `TOLERABLE` or `VISIBLE`.
    """
    ess, mass, lost = (support[key] for key in ("weight_ess", "mean_weight", "lost_mass"))
    # Single populations far out may fall short.
    low, middle = np.quantile(ess, [0.05, 0.5])
    at = [0.05, 0.95] if level.tails else [0.5, 0.5]
    mass_low, mass_high = np.quantile(mass, at)
    most_lost = float(np.quantile(lost, 0.95))
    least, most = level.mass
    # A comparison with NaN is false, and falls short.
    many_in_the_middle = middle >= level.ess * required_ess
    many_at_the_low_end = low >= level.lowest_ess * required_ess
    many = many_in_the_middle and many_at_the_low_end
    covered = mass_low >= least and mass_high <= most
    return Shortcoming(
        lost=most_lost if most_lost > max_lost else None,
        ess=(float(low), float(middle)) if not many else None,
        mass=(float(mass_low), float(mass_high)) if not covered else None,
        max_lost=max_lost,
        required_ess=required_ess,
        n_points=n_points,
        level=level,
    )
