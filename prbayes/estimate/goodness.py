"""Whether the family of populations can have given the data: parametric-bootstrap goodness of fit.

Data sets are drawn from the model at its minimiser, and each is refitted. How far each is from its
own fit is what the data's distance from theirs is held against (Stute, Gonzalez Manteiga and
Presedo Quindimil 1993, doi:10.1007/BF02613687). No response is computed.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from prbayes._checks import Floats
from prbayes.estimate.data_sets import DataSets, observed_set, simulated_sets
from prbayes.estimate.obstacles import refit_obstacle
from prbayes.estimate.refit import ARRIVED, SamplingDistribution

# Probability below which the data are said not to come from the family. By convention; 200 refits
# tell one of half as much.
UNLIKELY = 0.01
# Probability that a population has below its least and above its greatest value at least, so that
# one observation outside weighs as one in ten thousand, and not without bound.
_BEYOND = 1e-4


def fit_probability(sampling: SamplingDistribution, n_sets: int, seed: int) -> float:
    """Return how probable a distance as the data's from their fit is; NaN where nothing tells.

    Parameters
    ----------
    sampling : SamplingDistribution
    n_sets : int
        Data sets that are drawn and refitted.
    seed : int
    """
    if not sampling.stderr.size or refit_obstacle(sampling.evaluator) is not None:
        return np.nan
    (center,), _ = sampling.refit(observed_set(sampling.evaluator))
    sets = simulated_sets(sampling.evaluator, sampling.thetas(center), n_sets, seed)
    x, converged = sampling.refit(sets)
    return probability_of_fit(sampling, center, sets, x, converged)


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
    stored = all(node.bound.stored for node in sampling.evaluator.nodes)
    if not stored or converged.mean() < ARRIVED:
        return np.nan
    observed = _distances(sampling, center[None], observed_set(sampling.evaluator))
    drawn = _distances(sampling, x, sets)[converged]
    # Distances of several kinds and simulators, each in spreads of its own distribution: the worst.
    middle = drawn.mean(axis=0)
    spread = np.maximum(drawn.std(axis=0), 1e-300)
    worst = ((drawn - middle) / spread).max(axis=1)
    (here,) = ((observed - middle) / spread).max(axis=1)
    return float((1 + np.sum(worst >= here)) / (1 + worst.size))


def _distances(sampling: SamplingDistribution, x: Floats, sets: DataSets) -> Floats:
    """Return logarithms of two distances of each data set from its fit, by simulator.

    Those of Cramer and von Mises, which sees the middle of a distribution, and of Anderson and
    Darling, which sees its tails; shape (n_sets, 2 K).
    """
    thetas = sampling.thetas(x)
    columns = []
    for k, (values, weights) in enumerate(zip(sets.values, sets.weights, strict=True)):
        simulated, own = sampling.evaluator.populations(thetas, k)
        # Stored responses are the same at all thetas; only what is finite can be observed.
        stored = simulated[0]
        finite = np.isfinite(stored)
        order = np.argsort(stored[finite], kind="stable")
        points = stored[finite][order]
        mass = own[:, finite][:, order]
        mass = mass / mass.sum(axis=1, keepdims=True)
        middles = np.cumsum(mass, axis=1) - mass / 2
        ranked = np.argsort(values, kind="stable")
        at = values[ranked]
        w = weights[:, ranked]
        below = np.cumsum(w, axis=1) - w / 2
        expected = np.array([np.interp(at, points, row) for row in middles])
        squares = w * (below - expected) ** 2
        inside = np.clip(expected, _BEYOND, 1 - _BEYOND)
        in_the_middle = squares.sum(axis=1)
        in_the_tails = (squares / (inside * (1 - inside))).sum(axis=1)
        columns += [in_the_middle, in_the_tails]
    stacked = np.maximum(np.stack(columns, axis=1), 1e-300)
    return np.asarray(np.log(stacked))


def of_another_family(probability: float) -> list[str]:
    """Say so where a fit is as good as that of the data too rarely."""
    if not probability < UNLIKELY:
        return []
    return [
        f"the data are farther from the best population than {1 - probability:.1%} of data sets "
        "that the model draws there are from theirs: the inputs probably have another family, or "
        "the response an error; look at prb.plot_responses, and at outliers"
    ]
