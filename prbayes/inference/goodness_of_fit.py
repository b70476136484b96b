"""Whether the family of populations can have given the data: parametric-bootstrap goodness of fit.

Data sets are drawn from the model at its minimiser, and each is refitted. How far each is from its
own fit is what the data's distance from theirs is held against (Stute, Gonzalez Manteiga and
Presedo Quindimil 1993, doi:10.1007/BF02613687). Responses are stored: none is computed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from prbayes._finding import Finding
from prbayes._validate import Floats
from prbayes.inference.projections import number_parts
from prbayes.inference.refits import ARRIVED, SamplingDistribution
from prbayes.inference.requirements import refit_obstacle
from prbayes.inference.resampling import DataSets, observed_set, simulated_sets

# Probability below which the data are said not to come from the family. By convention; 200 refits
# tell one of half as much.
UNLIKELY = 0.01
# Probability that a population has below its least and above its greatest value at least, so that
# one observation outside weighs as one in ten thousand, and not without bound.
_BEYOND = 1e-4


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
        """How probable a distance as the data's from their fit is; NaN if too few converged."""
        if self.converged.mean() < ARRIVED:
            return np.nan
        observed = self._distances(self.center[None], observed_set(self.sampling.evaluator))
        return probability_of(observed[0], self._distances(self.x, self.sets)[self.converged])

    def _distances(self, x: Floats, sets: DataSets) -> Floats:
        """Return distances of data sets from their fits, by simulator and part, (n_sets, 2 K)."""
        evaluator = self.sampling.evaluator
        thetas = self.sampling.thetas(x)
        columns = []
        for k, node in enumerate(evaluator.nodes):
            simulated, shares = evaluator.populations(thetas, k)
            for part in number_parts(node.target):
                seen, rows = part.observed_of(sets.values[k])
                weights = sets.weights[k][:, rows]
                order = np.argsort(seen, kind="stable")
                expected = _middles(part.of(simulated), shares, seen[order])
                columns.append(log_distances(expected, weights[:, order]))
        return np.concatenate(columns, axis=1)


def probability_of(observed: Floats, drawn: Floats, *, both_sides: bool = False) -> float:
    """Return the probability that drawn numbers are as far out as observed ones.

    Each number is in standard deviations of its own distribution, and the largest of them counts.
    Data sets with an unknown number are left out.

    Parameters
    ----------
    observed : ndarray, shape (q,)
    drawn : ndarray, shape (S, q)
    both_sides : bool
        Whether small numbers are far out as well.
    """
    rows = drawn[np.isfinite(drawn).all(axis=1)]
    if not np.isfinite(observed).all() or len(rows) < 2:
        return 1.0
    middle = rows.mean(axis=0)
    spread = np.maximum(rows.std(axis=0), 1e-300)
    out = (np.vstack([observed, rows]) - middle) / spread
    worst = (np.abs(out) if both_sides else out).max(axis=1)
    return float(np.mean(worst >= worst[0]))


def log_distances(expected: Floats, weights: Floats) -> Floats:
    """Return logarithms of two distances of data sets from distribution functions, (S, 2).

    Those of Cramer and von Mises, which sees the middle of a distribution, and of Anderson and
    Darling, which sees its tails.

    Parameters
    ----------
    expected : ndarray, shape (S, n)
        Distribution functions at the values in order.
    weights : ndarray, shape (S, n)
        Of the values.
    """
    weights = weights / weights.sum(axis=1, keepdims=True)
    below = np.cumsum(weights, axis=1) - weights / 2
    squares = weights * (below - expected) ** 2
    inside = np.clip(expected, _BEYOND, 1 - _BEYOND)
    in_the_tails = squares / (inside * (1 - inside))
    both = np.stack([squares.sum(axis=1), in_the_tails.sum(axis=1)], axis=1)
    return np.asarray(np.log(np.maximum(both, 1e-300)))


def _middles(values: Floats, weights: Floats, at: Floats) -> Floats:
    """Return distribution functions at values, (P, n), (P, n), (m,) -> (P, m).

    Each goes through the middles of its steps.
    """
    rows = []
    values = np.broadcast_to(values, weights.shape)
    for own, share in zip(values, weights, strict=True):
        # Only what is finite can be observed.
        finite = np.isfinite(own)
        order = np.argsort(own[finite], kind="stable")
        mass = share[finite][order]
        mass = mass / mass.sum()
        rows.append(np.interp(at, own[finite][order], np.cumsum(mass) - mass / 2))
    return np.array(rows)


def of_held_away(probability: float) -> list[Finding]:
    """Say so where the data cannot have come from the population that the prior holds."""
    if not probability < UNLIKELY:
        return []
    return [
        Finding(
            "prior-misfit",
            "The data are farther from the population at this optimum than "
            f"{1 - probability:.1%} of data sets drawn there: the prior, which is part of its "
            "objective, and the data contradict each other, or the inputs have another family; "
            "look at prb.minimize without the prior.",
        )
    ]


def of_another_family(probability: float) -> list[Finding]:
    """Say so where a fit is as good as that of the data too rarely."""
    if not probability < UNLIKELY:
        return []
    return [
        Finding(
            "population-misfit",
            f"The data are farther from the best population than {1 - probability:.1%} or more of "
            "data sets that the model draws there are from theirs: the inputs probably have "
            "another family, or the response an error; look at prb.plot_responses, at outliers, "
            "and at other families, by prb.rank.",
            "choosing_metric.md#a-wrong-family",
        )
    ]
