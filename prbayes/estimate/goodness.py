"""Whether the family of populations can have given the data: parametric-bootstrap goodness of fit.

Data sets are drawn from the model at its minimiser, and each is refitted. How far each is from its
own fit is what the data's distance from theirs is held against (Stute, Gonzalez Manteiga and
Presedo Quindimil 1993, doi:10.1007/BF02613687). With designs no response is computed, and else
those of the populations one standard error to either side.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from prbayes._checks import Floats
from prbayes._pages import more_in
from prbayes.estimate.data_sets import DataSets, observed_set, simulated_sets
from prbayes.estimate.obstacles import refit_obstacle
from prbayes.estimate.projections import number_parts
from prbayes.estimate.refit import ARRIVED, SamplingDistribution

# Probability below which the data are said not to come from the family. By convention; 200 refits
# tell one of half as much.
UNLIKELY = 0.01
# Probability that a population has below its least and above its greatest value at least, so that
# one observation outside weighs as one in ten thousand, and not without bound.
BEYOND = 1e-4


@dataclass(frozen=True, eq=False)
class Refitted:
    """Data sets drawn from the model at the minimiser of the observed data, and their own."""

    sampling: SamplingDistribution
    center: Floats  # (r,): that of the observed data, in coordinates
    sets: DataSets
    x: Floats  # (n_sets, r): those of the data sets
    converged: NDArray[np.bool_]  # (n_sets,)

    @classmethod
    def of(cls, sampling: SamplingDistribution, n_sets: int, seed: int) -> Refitted | None:
        """Draw and refit data sets; None where nothing tells."""
        if not sampling.stderr.size or refit_obstacle(sampling.evaluator) is not None:
            return None
        (center,), _ = sampling.refit(observed_set(sampling.evaluator))
        sets = simulated_sets(sampling.evaluator, sampling.thetas(center), n_sets, seed)
        return cls(sampling, center, sets, *sampling.refit(sets))

    @classmethod
    def there(cls, sampling: SamplingDistribution, n_sets: int, seed: int) -> Refitted:
        """Draw data sets at theta itself, which all keep: no minimiser, as a prior holds it."""
        sets = simulated_sets(sampling.evaluator, sampling.theta, n_sets, seed)
        x = np.zeros((n_sets, sampling.stderr.size))
        return cls(
            sampling=sampling,
            center=x[0],
            sets=sets,
            x=x,
            converged=np.ones(n_sets, dtype=bool),
        )

    @property
    def probability(self) -> float:
        """How probable a distance as the data's from their fit is; NaN where too few converged."""
        return probability_of_fit(self.sampling, self.center, self.sets, self.x, self.converged)


def probability_of_fit(
    sampling: SamplingDistribution,
    center: Floats,
    sets: DataSets,
    x: Floats,
    converged: NDArray[np.bool_],
) -> float:
    """Return the same from refits that are known.

    Parameters
    ----------
    sampling : SamplingDistribution
    center : ndarray, shape (r,)
        The minimiser of the observed data, in coordinates.
    sets : DataSets
        Drawn from the model there.
    x : ndarray, shape (n_sets, r)
        Their minimisers.
    converged : ndarray of bool, shape (n_sets,)
    """
    if converged.mean() < ARRIVED:
        return np.nan
    populations = _Populations.around_center(sampling, center)
    observed = _distances(populations, center[None], observed_set(sampling.evaluator))
    drawn = _distances(populations, x, sets)[converged]
    # Distances of several kinds and simulators, each in spreads of its own distribution: the worst.
    middle = drawn.mean(axis=0)
    spread = np.maximum(drawn.std(axis=0), 1e-300)
    worst = ((drawn - middle) / spread).max(axis=1)
    (here,) = ((observed - middle) / spread).max(axis=1)
    return float((1 + np.sum(worst >= here)) / (1 + worst.size))


@dataclass(frozen=True, eq=False)
class _Populations:
    """The distribution functions of populations at refits."""

    sampling: SamplingDistribution
    center: Floats  # (r,)
    # By simulator whose responses are not stored: those at the centre, and one standard error to
    # either side of it along each axis, values and weights of shape (1 + 2 r, n).
    around: dict[int, tuple[Floats, Floats]]

    @classmethod
    def around_center(cls, sampling: SamplingDistribution, center: Floats) -> _Populations:
        """Compute the populations around a centre, of responses that are not stored."""
        evaluator = sampling.evaluator
        r = center.size
        cross = np.concatenate([np.zeros((1, r)), np.eye(r), -np.eye(r)])
        around = {}
        for k, node in enumerate(evaluator.nodes):
            if not node.bound.stored:
                around[k] = evaluator.populations(sampling.thetas(center + cross), k)
        return cls(sampling, center, around)

    def of(self, k: int, x: Floats) -> tuple[Floats, Floats]:
        """Return values and weights of a simulator, from which those at x, (n_sets, r), follow."""
        if k in self.around:
            return self.around[k]
        return self.sampling.evaluator.populations(self.sampling.thetas(x), k)

    def below(self, k: int, seen: Floats, weights: Floats, x: Floats, at: Floats) -> Floats:
        """Return distribution functions at values, (m,), of populations at x, (n_sets, r).

        Of what a part of the metric sees of the values that `of` gives. Shape (n_sets, m); of
        responses that are not stored to first order, as refits are.
        """
        found = _middles(seen, weights, at)
        if k not in self.around:
            return found
        r = self.center.size
        ahead = found[1 : 1 + r]
        behind = found[1 + r :]
        slopes = (ahead - behind) / 2
        away = x - self.center
        linear = found[0] + away @ slopes
        return np.asarray(np.clip(linear, 0.0, 1.0))


def _middles(values: Floats, weights: Floats, at: Floats) -> Floats:
    """Return distribution functions at values, (P, n), (P, n), (m,) -> (P, m).

    Each goes through the middles of its steps.
    """
    rows = []
    for own, share in zip(values, weights, strict=True):
        # Only what is finite can be observed.
        finite = np.isfinite(own)
        order = np.argsort(own[finite], kind="stable")
        mass = share[finite][order]
        mass = mass / mass.sum()
        rows.append(np.interp(at, own[finite][order], np.cumsum(mass) - mass / 2))
    return np.array(rows)


def _distances(populations: _Populations, x: Floats, sets: DataSets) -> Floats:
    """Return logarithms of two distances of each data set from its fit, by simulator and part.

    Those of Cramer and von Mises, which sees the middle of a distribution, and of Anderson and
    Darling, which sees its tails; shape (n_sets, 2 K).
    """
    columns = []
    nodes = populations.sampling.evaluator.nodes
    for k, (node, values, weights) in enumerate(zip(nodes, sets.values, sets.weights, strict=True)):
        simulated, shares = populations.of(k, x)
        for part in number_parts(node.target):
            seen, rows = part.observed_of(values)
            own = weights[:, rows]
            if len(seen) < len(values):
                own = own / own.sum(axis=1, keepdims=True)
            ranked = np.argsort(seen, kind="stable")
            at = seen[ranked]
            columns += _distances_of(
                populations.below(k, part.of(simulated), shares, x, at), own[:, ranked]
            )
    stacked = np.maximum(np.stack(columns, axis=1), 1e-300)
    return np.asarray(np.log(stacked))


def _distances_of(expected: Floats, w: Floats) -> list[Floats]:
    """Return the two distances of what a part sees.

    Of distribution functions at the values, in order, and of their weights, (n_sets, n) both.
    """
    below = np.cumsum(w, axis=1) - w / 2
    squares = w * (below - expected) ** 2
    inside = np.clip(expected, BEYOND, 1 - BEYOND)
    in_the_middle = squares.sum(axis=1)
    in_the_tails = (squares / (inside * (1 - inside))).sum(axis=1)
    return [in_the_middle, in_the_tails]


def of_held_away(probability: float) -> list[str]:
    """Say so where the data cannot have come from the population that the prior holds."""
    if not probability < UNLIKELY:
        return []
    return [
        f"the data are farther from the population at this optimum than {1 - probability:.1%} of "
        "data sets drawn there: the prior, which is part of its objective, and the data contradict "
        "each other, or the inputs have another family; look at prb.minimize without the prior"
    ]


def of_another_family(probability: float) -> list[str]:
    """Say so where a fit is as good as that of the data too rarely."""
    if not probability < UNLIKELY:
        return []
    return [
        f"the data are farther from the best population than {1 - probability:.1%} or more of data "
        "sets that the model draws there are from theirs: the inputs probably have another family, "
        "or the response an error; look at prb.plot_responses, at outliers, and at other families, "
        "by prb.validation.compare_candidates"
        f"{more_in('choosing_metric.md#a-wrong-family')}"
    ]
