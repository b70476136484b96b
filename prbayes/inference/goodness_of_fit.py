"""Goodness of fit by parametric bootstrap: of the population, and by output and pair of outputs.

Data sets are drawn from the model at its minimiser, and each is refitted. The distance of the data
from their fit is compared with the distances of these data sets from theirs (Stute, Gonzalez
Manteiga and Presedo Quindimil 1993, doi:10.1007/BF02613687). No response is computed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.special import bdtrc

from prbayes._finding import Finding
from prbayes._stats import distribution_function, positive_scale
from prbayes._validate import ArrayPair, Bools, Floats, complete_rows, flat_rows
from prbayes.inference.asymptotics import single_output_parts
from prbayes.inference.refits import MIN_CONVERGED, SamplingDistribution, refit, refit_obstacle
from prbayes.inference.resampling import DataSets, observed_set, simulated_sets
from prbayes.metrics.multivariate import failure_caps
from prbayes.model.data_checks import resolution
from prbayes.model.evaluator import Evaluator

# p-value below which the family of the population is rejected, by convention
UNLIKELY = 0.01


@dataclass(frozen=True, eq=False)
class FittedSets:
    """Synthetic data sets with their minimisers, and the minimiser of the observed data."""

    sampling: SamplingDistribution
    center: Floats  # (r,): minimiser of the observed data, in coordinates
    sets: DataSets
    x: Floats  # (n_sets, r): minimisers of the data sets
    converged: Bools  # (n_sets,): whether these minimisations converged
    observed: DataSets  # observed data, perhaps with ties spread out

    @classmethod
    def of(cls, sampling: SamplingDistribution, n_sets: int, seed: int) -> FittedSets | None:
        """Draw and refit data sets; None if nothing is identified, or refits are not possible."""
        evaluator = sampling.evaluator
        if not sampling.stderr.size or refit_obstacle(evaluator) is not None:
            return None
        observed = observed_set(evaluator)
        (center,), _ = refit(sampling, observed)
        sets = simulated_sets(evaluator, sampling.thetas(center), n_sets, seed)
        return cls(sampling, center, sets, *refit(sampling, sets), observed)

    @classmethod
    def at_theta(cls, sampling: SamplingDistribution, n_sets: int, seed: int) -> FittedSets:
        """Draw data sets at theta itself, without refits, for an optimum with the prior."""
        sets = simulated_sets(sampling.evaluator, sampling.theta, n_sets, seed)
        x = np.zeros((n_sets, sampling.stderr.size))
        converged = np.ones(n_sets, dtype=bool)
        return cls(sampling, x[0], sets, x, converged, observed_set(sampling.evaluator))

    def without_rounding(self) -> FittedSets | None:
        """Return a copy with tied observations spread out, or None if there are no ties."""
        values = [
            np.column_stack([spread_out(column) for column in flat_rows(y).T])
            for y in self.observed.values
        ]
        values = [v.reshape(y.shape) for v, y in zip(values, self.observed.values, strict=True)]
        pairs = zip(values, self.observed.values, strict=True)
        if all(np.array_equal(v, y, equal_nan=True) for v, y in pairs):
            return None
        observed = replace(self.observed, values=values)
        center = self.center
        if self.x.any():  # the data sets were refitted, not taken at theta
            (center,), _ = refit(self.sampling, observed)
        return replace(self, observed=observed, center=center)

    @property
    def p_value(self) -> float:
        """The p-value of the distance of the data from their fit; NaN if too few converged."""
        if self.converged.mean() < MIN_CONVERGED:
            return np.nan
        pairs = ((self.center[None], self.observed), (self.x, self.sets))
        observed, drawn = (self._distances(x, sets) for x, sets in pairs)
        return worst_p_value(observed[0], drawn[self.converged])

    def _distances(self, x: Floats, sets: DataSets) -> Floats:
        """Return distances of data sets from their fits, by simulator and part, (n_sets, 2 K)."""
        evaluator = self.sampling.evaluator
        thetas = self.sampling.thetas(x)
        columns = []
        for k, node in enumerate(evaluator.nodes):
            simulated, weights = evaluator.populations(thetas, k)
            for part in single_output_parts(node.target):
                values, rows = part.observed_of(sets.values[k])
                observed = sets.weights[k][:, rows]
                columns.append(_fit_distances(part.of(simulated), weights, values, observed))
        return np.concatenate(columns, axis=1)


def worst_p_value(observed: Floats, drawn: Floats, *, two_sided: bool = False) -> float:
    """Return how often the largest of q drawn statistics is at least the largest observed one.

    Each statistic is standardised by its own distribution. Rows with NaN are left out.
    """
    rows = drawn[complete_rows(drawn)]
    if not np.isfinite(observed).all() or len(rows) < 2:
        return 1.0
    spread = np.maximum(rows.std(axis=0), 1e-300)
    scores = (np.vstack([observed, rows]) - rows.mean(axis=0)) / spread
    worst = (np.abs(scores) if two_sided else scores).max(axis=1)
    return float(np.mean(worst >= worst[0]))


def _fit_distances(simulated: Floats, masses: Floats, values: Floats, weights: Floats) -> Floats:
    """Return logarithms of two distances of data sets from populations, (S, 2).

    The distances are those of Cramér-von Mises and Anderson-Darling. Data sets are values (n,) with
    weights (S, n), populations are responses (N,) or (S, N) with masses (S, N). Only finite
    responses can be observed.
    """
    masses = np.where(np.isfinite(simulated), masses, 0.0)
    masses = masses / masses.sum(axis=1, keepdims=True)
    weights = weights / weights.sum(axis=1, keepdims=True)
    order = np.argsort(values, kind="stable")
    points, weights = values[order], weights[:, order]
    # Compare both distribution functions in the middles of their steps.
    at_most = distribution_function(simulated, masses, points)
    less = distribution_function(simulated, masses, np.nextafter(points, -np.inf))
    expected = (at_most + less) / 2
    below = np.cumsum(weights, axis=1) - weights / 2
    squares = weights * (below - expected) ** 2
    # Clip the expected values, because single observations in the tails would have unbounded
    # weight.
    inside = np.clip(expected, 1e-4, 1 - 1e-4)
    in_the_tails = squares / (inside * (1 - inside))
    distances = np.stack([squares.sum(axis=1), in_the_tails.sum(axis=1)], axis=1)
    return np.log(np.maximum(distances, 1e-300))


def spread_out(values: Floats) -> Floats:
    """Return measured values, (N,), with ties spread evenly over the step that they are rounded to.

    Without a common step, over half of the way to the neighbours.

    Examples
    --------
    >>> spread_out(np.array([1.0, 2.0, 2.0, 4.0])).round(2).tolist()
    [1.0, 1.75, 2.25, 4.0]
    """
    distinct, inverse, counts = np.unique(values, return_inverse=True, return_counts=True)
    is_tied = (counts > 1) & np.isfinite(distinct)
    finite = distinct[np.isfinite(distinct)]
    if not is_tied.any() or len(finite) < 2:
        return values
    step = resolution(values[np.isfinite(values)])
    gaps = np.diff(finite)
    below, above = np.append(gaps[0], gaps), np.append(gaps, gaps[-1])
    if step:
        below, above = (np.full(len(finite), step) for _ in range(2))
    result = values.astype(float)
    for k in np.flatnonzero(is_tied):
        places = (np.arange(counts[k]) + 0.5) / counts[k] - 0.5
        width = np.where(places < 0, below[k], above[k])
        result[inverse == k] += places * width
    return result


def rounding(evaluator: Evaluator) -> str:
    """Return how many measured values are ties, and their step, as a phrase; empty without ties."""
    phrases = []
    for node in evaluator.nodes:
        y = node.target.observed
        for column, label in zip(flat_rows(y).T, node.outputs.labels or ("",), strict=True):
            values = column[np.isfinite(column)]
            ties = len(values) - len(np.unique(values))
            if ties:
                step = resolution(values)
                name = f"{node.name}[{label}]" if y.ndim > 1 else node.name
                steps = f", all of them multiples of a step of {step:.3g}" if step else ""
                phrases.append(f"{ties} of {len(values)} values of {name} equal others{steps}")
    return "; ".join(phrases)


def unpredicted_failures(evaluator: Evaluator, theta: Floats) -> list[Finding]:
    """Report measured failures (+inf) of a population that hardly has any, (p < .01)."""
    findings = []
    for k, node in enumerate(evaluator.nodes):
        y = node.target.observed
        n, count = len(y), int(np.isposinf(flat_rows(y)).any(axis=1).sum())
        if not count:
            continue
        (values,), (weights,) = evaluator.populations(theta[None], k)
        share = float(weights[np.isposinf(flat_rows(values)).any(axis=1)].sum())
        if bdtrc(count - 1, n, min(share, 1.0)) < UNLIKELY:
            text = (
                f"{node.name}: {count} of {n} measured values are +inf, specimens that failed, but "
                f"the response fails at {share:.2g} of the best population: look at these values, "
                "or return +inf where specimens fail."
            )
            findings.append(Finding("population-misfit", text, "choosing_metric.md#a-wrong-family"))
    return findings


def population_misfit(
    p_value: float, *, with_prior: bool, ties: str = "", p_spread_out: float = np.nan
) -> list[Finding]:
    """Report data that cannot come from the population at an optimum.

    ``ties`` is `rounding` of the data, and ``p_spread_out`` the p-value `without_rounding`.
    """
    if not p_value < UNLIKELY:
        return []
    if p_spread_out >= UNLIKELY:
        text = (
            f"The measured values are rounded, or copied: {ties}. They are farther from the best "
            f"population than {1 - p_value:.1%} of data sets, but not if they are spread evenly "
            f"over the rounding steps (p = {p_spread_out:.2g}): there is no sign of another "
            "family. Pass values with more digits, or remove copies; prb.LogLikelihood() takes "
            "rounded=."
        )
        return [Finding("rounded-data", text, "likelihood_findings.md#rounded-data")]
    if with_prior:
        text = (
            f"The data are farther from the population at this optimum than {1 - p_value:.1%} of "
            "data sets drawn there: the prior, which is part of its objective, and the data "
            "contradict each other, or the inputs have another family; look at prb.minimize "
            "without the prior."
        )
        return [Finding("prior-misfit", text)]
    text = (
        f"The data are farther from their best population than {1 - p_value:.1%} or more of data "
        "sets drawn from it are from theirs: the inputs probably have another family, or the "
        "response has an error; look at prb.plots.plot_responses, at outliers, and at other "
        "families with prb.rank."
    )
    if ties:
        text += f" Rounding does not explain it ({ties})."
    return [Finding("population-misfit", text, "choosing_metric.md#a-wrong-family")]


# -- by output -------------------------------------------------------------------------------------


def output_misfits(fitted: FittedSets) -> list[Finding]:
    """Report for each simulator of several outputs which of them, and which pairs, misfit.

    Outputs are tested by the distances of Cramér-von Mises and Anderson-Darling, pairs by the
    residual of their correlation.
    """
    findings = []
    evaluator, is_fitted = fitted.sampling.evaluator, fitted.converged
    for k, node in enumerate(evaluator.nodes):
        if len(node.outputs.labels) < 2:
            continue
        data = _Outputs.of(fitted, fitted.observed, fitted.center[None], k)
        drawn = _Outputs.of(fitted, fitted.sets, fitted.x, k)
        names = node.outputs.names
        outputs, pairs = [], []
        for j in data.columns:
            p = worst_p_value(data.distances(j)[0], drawn.distances(j)[is_fitted])
            if p < UNLIKELY:
                outputs.append(f"{names[j]} (p = {p:.2g})")
        for i, j in combinations(data.columns, 2):
            measured, calibrated = data.correlations(i, j)
            drawn_measured, drawn_calibrated = drawn.correlations(i, j)
            residuals = (drawn_measured - drawn_calibrated)[is_fitted, None]
            p = worst_p_value(measured - calibrated, residuals, two_sided=True)
            if p < UNLIKELY:
                pairs.append(
                    f"{names[i]} with {names[j]} (measured {measured[0]:.2f}, calibrated "
                    f"{calibrated[0]:.2f}, p = {p:.2g})"
                )
        parts = [f"outputs {', '.join(outputs)}"] if outputs else []
        parts += [f"correlations {', '.join(pairs)}"] if pairs else []
        text = f"these disagree with the best population: {' and '.join(parts)}."
        if not parts:
            text = (
                "no single output and no correlation of two disagrees with the best population, "
                "but a combination of outputs does."
            )
        findings.append(Finding("outputs-misfit", f"{node.name}: {text}"))
    return findings


@dataclass(frozen=True, eq=False)
class _Outputs:
    """Data sets of one simulator, and a population for each; a failure counts as the cap."""

    values: Floats  # (n, m): values of the data sets; NaN if an output was not measured
    weights: Floats  # (S, n): weights of these values in each data set
    simulated: Floats  # (N, m): responses of all populations
    masses: Floats  # (S, N): weights of the responses in each population
    columns: list[int]  # columns of the outputs that are tested

    @classmethod
    def of(cls, fitted: FittedSets, sets: DataSets, x: Floats, k: int) -> _Outputs:
        """Return the data sets with populations of the k-th simulator at their minimisers."""
        sampling = fitted.sampling
        observed = sampling.evaluator.nodes[k].target.observed
        caps, m = failure_caps(observed), observed.shape[1]
        simulated, masses = sampling.evaluator.populations(sampling.thetas(x), k)
        has_response = ~np.isnan(simulated[0]).any(axis=1)
        masses = masses[:, has_response]
        return cls(
            np.minimum(sets.values[k], caps),
            sets.weights[k],
            np.minimum(simulated[0][has_response], caps),
            masses / masses.sum(axis=1, keepdims=True),
            # Twelve outputs of a curve suffice, because neighbours misfit together.
            np.linspace(0, m - 1, min(m, 12)).round().astype(int).tolist(),
        )

    def distances(self, j: int) -> Floats:
        """Return logarithms of two distances of data sets from their fits in an output, (S, 2)."""
        is_measured = ~np.isnan(self.values[:, j])
        observed = self.values[is_measured, j], self.weights[:, is_measured]
        return _fit_distances(self.simulated[:, j], self.masses, *observed)

    def correlations(self, i: int, j: int) -> ArrayPair:
        """Return the correlations of two outputs in data sets and in populations, (S,) each."""
        pair = [i, j]
        is_measured = ~np.isnan(self.values[:, pair]).any(axis=1)
        weights = self.weights[:, is_measured]
        total = weights.sum(axis=1, keepdims=True)
        weights = weights / positive_scale(total, np.nan)
        measured = _correlation(self.values[is_measured][:, pair], weights)
        return measured, _correlation(self.simulated[:, pair], self.masses)


def _correlation(values: Floats, weights: Floats) -> Floats:
    """Return correlations, (n, 2), (S, n) -> (S,); NaN if an output does not vary."""
    spread = values.std(axis=0)
    a, b = ((values - values.mean(axis=0)) / positive_scale(spread)).T
    moments = weights @ np.column_stack([a, b, a * a, b * b, a * b])
    mean_a, mean_b, square_a, square_b, product = moments.T
    variances = (square_a - mean_a**2) * (square_b - mean_b**2)
    varies = variances > 1e-20  # larger than rounding errors in units of the spread
    root = np.sqrt(np.where(varies, variances, 1.0))
    return np.where(varies, (product - mean_a * mean_b) / root, np.nan)
