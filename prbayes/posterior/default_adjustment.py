"""How draws are adjusted where nobody chose: given the estimate, or not at all where none need be.

The choice rests on ``benchmarks/posterior.py``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from prbayes._checks import Floats
from prbayes.estimate.data_sets import dependent
from prbayes.estimate.refinement import AGREE
from prbayes.estimate.refit import SamplingDistribution
from prbayes.model.evaluator import Evaluator
from prbayes.model.node import Node
from prbayes.posterior.adjustment import Adjusted, Affine, Mapped
from prbayes.posterior.given_estimate import GivenEstimate

# How results say that nothing had to be done.
NONE_NEEDED = "none needed: the draws of the log-likelihood are the posterior"


@dataclass(frozen=True)
class _LikelihoodDraws(Affine):
    """Draws that stay as they are; refits only tell whether the family of the inputs fits."""

    def _serving(self, evaluator: Evaluator, design_error: float) -> Affine:
        """Return this, or `GivenEstimate`, which knows that designs leave estimates uncertain."""
        if AGREE < design_error < np.inf:
            return GivenEstimate(self.n_sets, self.random_seed)
        return self

    def _concluded(self, found: Adjusted, given: Floats) -> Adjusted:
        """Return the draws as they were given, with what refits tell if anything was refitted."""
        if found.reason is not None:
            return Adjusted(given, NONE_NEEDED)
        return replace(found, thetas=given, done=NONE_NEEDED)

    def _dealt_out(
        self, modes: list[SamplingDistribution], thetas: Floats, nearest: NDArray[np.intp]
    ) -> tuple[NDArray[np.intp], NDArray[np.intp], str]:
        """Return all draws as they are: a likelihood says how much modes count."""
        return np.arange(nearest.size), nearest, ""

    def _mapped(
        self, sampling: SamplingDistribution, draws: Floats, design_variance: float
    ) -> Mapped:
        """Return the draws."""
        told = self._told(sampling)
        return Mapped(draws, 0, np.nan, np.nan, told.fit_probability, told.allowed)


def default_adjustment(evaluator: Evaluator) -> Affine:
    """Return what adjusts the draws of a model by default."""
    return _LikelihoodDraws() if _is_likelihood(evaluator) else GivenEstimate()


def _is_likelihood(evaluator: Evaluator) -> bool:
    """Return whether exp(-d / epsilon) is the likelihood of independent specimens, and smooth."""
    # Of several simulators, as groups are, where none shares specimens with another.
    return not dependent(evaluator.nodes) and all(map(_tells_likelihood, evaluator.nodes))


def _tells_likelihood(node: Node) -> bool:
    """Return whether a simulator's term is the likelihood of its own specimens."""
    all_alike = np.isclose(node.n_specimens, len(node.target.observed))
    return node.target.exact and node.epsilon_is_default and node.bound.stored and bool(all_alike)
