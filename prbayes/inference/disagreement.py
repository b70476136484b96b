"""Which outputs, and which correlations of two, are farther from a fit than the data's scatter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from prbayes._finding import Finding
from prbayes._stats import distribution_function
from prbayes._validate import Floats
from prbayes.inference.goodness_of_fit import UNLIKELY, Refitted, log_distances, probability_of
from prbayes.inference.resampling import DataSets, observed_set
from prbayes.metrics.multivariate import failure_caps
from prbayes.model.random_variable import Node

# Outputs that are looked at; of more, as of a curve, some from the first to the last: neighbours
# agree or disagree together.
_MOST_OUTPUTS = 12


def disagreement(refitted: Refitted) -> list[Finding]:
    """Say for each simulator of several outputs which of them, and which pairs, disagree.

    Each is held against the same of data sets drawn from the model and their fits: outputs by the
    distances of Cramer and von Mises and of Anderson and Darling, pairs by the residual of their
    correlation. No response is computed where all are stored.
    """
    found = []
    for k, node in enumerate(refitted.sampling.evaluator.nodes):
        if len(node.outputs.labels) > 1:
            found.append(_of_simulator(refitted, k, node))
    return found


def _of_simulator(refitted: Refitted, k: int, node: Node) -> Finding:
    """Say what disagrees with one simulator."""
    data = _Seen.of(refitted, observed_set(refitted.sampling.evaluator), refitted.center[None], k)
    drawn = _Seen.of(refitted, refitted.sets, refitted.x, k)
    names = node.outputs.names
    outputs = []
    for j in data.columns:
        p = probability_of(data.distances(j)[0], drawn.distances(j)[refitted.converged])
        if p < UNLIKELY:
            outputs.append(f"{names[j]} (p = {p:.2g})")
    pairs = []
    for i, j in _pairs(data.columns):
        measured, calibrated = data.correlations(i, j)
        theirs, fitted = drawn.correlations(i, j)
        residuals = (theirs - fitted)[refitted.converged, None]
        p = probability_of(measured - calibrated, residuals, both_sides=True)
        if p < UNLIKELY:
            pairs.append(
                f"{names[i]} with {names[j]} (measured {measured[0]:.2f}, calibrated "
                f"{calibrated[0]:.2f}, p = {p:.2g})"
            )
    if not outputs and not pairs:
        return Finding(
            "outputs-misfit",
            f"{node.name}: no output by itself, and no correlation of two, disagrees with the best "
            "population; what does is a combination of outputs.",
        )
    parts = []
    if outputs:
        parts.append(f"outputs {', '.join(outputs)}")
    if pairs:
        parts.append(f"correlations {', '.join(pairs)}")
    return Finding(
        "outputs-misfit",
        f"{node.name}: what disagrees with the best population are {' and '.join(parts)}.",
    )


def _pairs(columns: list[int]) -> list[tuple[int, int]]:
    return [(i, j) for place, i in enumerate(columns) for j in columns[place + 1 :]]


@dataclass(frozen=True, eq=False)
class _Seen:
    """Data sets of one simulator, and a population for each; a failure counts as the cap."""

    values: Floats  # (n, m): those of the data sets; NaN where an output was not measured
    weights: Floats  # (S, n)
    simulated: Floats  # (N, m): of all populations
    masses: Floats  # (S, N)
    columns: list[int]  # of the outputs that are looked at

    @classmethod
    def of(cls, refitted: Refitted, sets: DataSets, x: Floats, k: int) -> _Seen:
        """Return the data sets with populations of the k-th simulator at their minimisers."""
        sampling = refitted.sampling
        observed = sampling.evaluator.nodes[k].target.observed
        caps = failure_caps(observed)
        simulated, masses = sampling.evaluator.populations(sampling.thetas(x), k)
        known = ~np.isnan(simulated[0]).any(axis=1)
        masses = masses[:, known]
        m = observed.shape[1]
        places = np.linspace(0, m - 1, min(m, _MOST_OUTPUTS)).round()
        return cls(
            np.minimum(sets.values[k], caps),
            sets.weights[k],
            np.minimum(simulated[0][known], caps),
            masses / masses.sum(axis=1, keepdims=True),
            places.astype(int).tolist(),
        )

    def distances(self, j: int) -> Floats:
        """Return logarithms of two distances of data sets from their fits in an output, (S, 2)."""
        has = ~np.isnan(self.values[:, j])
        values = self.values[has, j]
        order = np.argsort(values, kind="stable")
        at = values[order]
        # In the middle of a step
        column = self.simulated[:, j]
        up_to = distribution_function(column, self.masses, at)
        under = distribution_function(column, self.masses, np.nextafter(at, -np.inf))
        return log_distances((up_to + under) / 2, self.weights[:, has][:, order])

    def correlations(self, i: int, j: int) -> tuple[Floats, Floats]:
        """Return the correlations of two outputs in data sets and in populations, (S,) each."""
        pair = [i, j]
        has = ~np.isnan(self.values[:, pair]).any(axis=1)
        weights = _normalised(self.weights[:, has])
        measured = _correlation(self.values[has][:, pair], weights)
        calibrated = _correlation(self.simulated[:, pair], self.masses)
        return measured, calibrated


def _normalised(weights: Floats) -> Floats:
    """Return rows of weights that sum to one, NaN where there are none."""
    total = weights.sum(axis=1, keepdims=True)
    return weights / np.where(total > 0, total, np.nan)


def _correlation(values: Floats, weights: Floats) -> Floats:
    """Return correlations, (n, 2), (S, n) -> (S,); NaN where one of both does not vary."""
    center = values.mean(axis=0)
    spread = values.std(axis=0)
    unit = np.where(spread > 0, spread, 1.0)
    a, b = ((values - center) / unit).T
    powers = np.column_stack([a, b, a * a, b * b, a * b])
    moments = weights @ powers
    mean_a, mean_b, square_a, square_b, product = moments.T
    variance_a = square_a - mean_a**2
    variance_b = square_b - mean_b**2
    variances = variance_a * variance_b
    known = variances > 1e-20  # of rounding, in units of the spread
    root = np.sqrt(np.where(known, variances, 1.0))
    covariance = product - mean_a * mean_b
    return np.where(known, covariance / root, np.nan)
