"""Whether a design supports the populations at given hyperparameters, and in what it falls short."""

from __future__ import annotations

import numpy as np

from prbayes._checks import Floats
from prbayes.model.evaluator import Evaluator


class DesignError(RuntimeError):
    """A design that cannot support the answer, even after refinement."""


def shortcomings(evaluator: Evaluator, thetas: Floats) -> dict[str, str]:
    """Say, by simulator, in what its design does not support the populations at thetas, shape (P, d)."""
    designs = evaluator.designs
    found = {
        name: shortcoming(support, designs[name].required_ess, designs[name].config.max_lost, designs[name].n_points)
        for name, support in evaluator.support(thetas).items()
    }
    return {name: what for name, what in found.items() if what}


def shortcoming(support: dict[str, Floats], need: float, max_lost: float, n_points: int) -> str:
    """Say in what a design with such support, arrays of shape (P,), falls short; nothing where it does not."""
    ess, mass, lost = (support[key] for key in ("weight_ess", "mean_weight", "lost_mass"))
    low, middle = np.quantile(ess, [0.05, 0.5])
    mass_low, mass_high = np.quantile(mass, [0.05, 0.95])
    most_lost = float(np.quantile(lost, 0.95))
    if most_lost > max_lost:
        return (
            f"lost mass: {most_lost:.1%} of a population's weight is on points whose response is NaN, expected at "
            f"most max_lost = {max_lost:.1%}"
        )
    complaints = []
    if middle < need or low < need / 10:
        complaints.append(
            f"weight effective sample size {low:.0f} (5% quantile) and {middle:.0f} (median) of {n_points} "
            f"points, expected {need / 10:.0f} and {need:.0f}"
        )
    if mass_low < 0.8 or mass_high > 1.25:
        complaints.append(f"mean raw weight from {mass_low:.2f} to {mass_high:.2f}, expected within 0.8 to 1.25")
    return ", and ".join(complaints)
