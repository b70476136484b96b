r"""Importance points on the fibres {x : f(x) = y_i} of specimens, for fewer outputs than inputs.

The density of a measured specimen is an integral over the fibre of its inputs,

.. math:: p(y_i | \theta) = \int p(x | \theta) \delta(f(x) - y_i) dx
          \approx \sum_k \exp(A_{ik}) p(x_{ik} | \theta), \quad f(x_{ik}) = y_i, \qquad (1)

with points and numbers A that do not contain theta. A response with m outputs of d inputs, m < d,
is g(z) in the inputs x = mean + L z that a reference population whitens; J is its Jacobian.

**Coarea formula.** Let (F, R) be orthonormal, with d - m and m columns, and z = z* + F u + R w.
Then dx = |L| du dw. The delta function integrates over w at fixed u, where dg/dw = J R:

.. math:: p(y | \theta) = \int \frac{|L|}{|\det J R|} p(x(u) | \theta) du. \qquad (2)

On the fibre dw/du = W = -(J R)^-1 J F, and its volume is dV = sqrt(det(I + W'W)) du. As
J J' = J R (I + W W') R'J', dV / sqrt(det J J') = du / |det J R|: the measure of (2) is that of the
coarea formula [1]_, the same in every chart. The proposal t(u) of a chart has the density
t |det J R| with respect to this measure, so a mixture of charts j with the weights s_j gives, by
the balance heuristic [2]_,

.. math:: A_{ik} = \log |L| - \log K - \log \sum_j s_j t_j(u_j) |\det J R_j|. \qquad (3)

**Accuracy.** Errors of specimens add up: two sets of points are compared until they agree. A small
closed fibre beside an extremum of the response can be missed, and no number shows it.

**Reference population.** The prior predictive one at first, then that of posterior draws, twice.
Posteriors of smoothed populations come before these where points lie farther apart than
populations are wide. Papadimas and Dodwell [3]_ integrate over the inputs by quadrature.

References
----------
.. [1] Diaconis, P., Holmes, S. and Shahshahani, M. (2012), Sampling from a manifold,
   arXiv:1206.6913.
.. [2] Veach, E. and Guibas, L. J. (1995), Optimally combining sampling techniques for Monte Carlo
   rendering, doi:10.1145/218380.218498.
.. [3] Papadimas, N. and Dodwell, T. (2021), A hierarchical Bayesian approach for calibration of
   stochastic material models, Data-Centric Engineering 2.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from scipy.special import gammaincinv, ndtri, stdtrit

from prbayes._validate import Floats
from prbayes.metrics.readings import Readings
from prbayes.numerics.points import sobol
from prbayes.numerics.threads import one_thread
from prbayes.propagation.base import DesignError
from prbayes.propagation.charts import (
    Charts,
    Fibres,
    Indices,
    ReferencePopulation,
    charts_at_modes,
    cover,
)
from prbayes.propagation.roots import Response
from prbayes.propagation.specimen_emulation import (
    Emulation,
    EmulationProblem,
    extended,
    half_difference,
    require_accurate,
    spread_out,
    typical_sd,
)
from prbayes.propagation.specimen_points import SpecimenPoints, joined


class Draws(Protocol):
    """Draws of the hyperparameters."""

    @property
    def thetas(self) -> Floats:
        """The draws, (S, p)."""

    def log_likelihoods(self, z: Floats, log_a: Floats) -> Floats:
        """Return log p(y_i | theta), (S, N)."""

    def specimens(self) -> Floats:
        """Return coordinates of specimens, (n, d)."""


type Posterior = Callable[[Floats, Floats, Floats | None], Draws]


def fibre_points(
    problem: EmulationProblem,
    bounds: Floats,
    prior_specimens: Floats,
    posterior: Posterior,
    surface: Emulation | None = None,
) -> tuple[Emulation, SpecimenPoints]:
    """Emulate a response, and draw points on the fibres of all specimens.

    The middle 99 % of the prior predictive population lies within [-1, 1] in each coordinate.
    ``posterior`` maps points (N, K, d), their numbers (N, K), and None or a covariance by which
    populations are smoothed, to draws. A ``surface`` gets no runs. Raise DesignError if the
    emulator is too inaccurate, or `most_points` are not enough.
    """
    readings, options, seed = problem.readings, problem.options, problem.seed
    d = bounds.shape[1]
    n = problem.n_first(d)
    population = ReferencePopulation.from_sample(prior_specimens)
    if surface is None:
        # Wider than the population by half; even points of a box would be in its corners.
        first = np.clip(population.inputs(1.5 * ndtri(sobol(n, d, seed))), *bounds)
        emulation = Emulation.first(problem, first, bounds)
    else:
        emulation = surface
    rng = np.random.default_rng([seed, 1])
    count, batch_size = 256, max(n // 2, options.fresh)
    for batch in range(6):
        numbered = replace(problem, seed=seed + batch)
        points, draws = _reliable_draws(emulation, numbered, population, posterior, count)
        count = points.z.shape[1]
        population = ReferencePopulation.from_sample(draws.specimens())
        if batch >= 2 and (surface is not None or emulation.bias <= options.bias):
            break
        if surface is None:
            fresh = _fresh(points, draws, batch_size, bounds, rng)
            emulation = extended(emulation, problem, fresh, batch_size // 2)
    if surface is None:
        require_accurate(emulation, problem)
    # Points on fibres cost more than those around roots, and their error falls more slowly.
    unit = options.half_difference * _per_hyperparameter(draws)
    count = 128
    proposals = [
        FibreProposals.fitted(emulation, readings, population, 100 + seed + half) for half in (0, 1)
    ]
    halves = [proposal.draw(count) for proposal in proposals]
    while True:
        difference = _difference(*(draws.log_likelihoods(p.z, p.log_a) for p in halves))
        is_last = 4 * count > options.most_points
        largest = 3 * unit if is_last else 2 * unit
        if difference <= largest:
            return emulation, replace(joined(*halves), difference=difference)
        if is_last:
            raise _monte_carlo_error(problem.name, 2 * count, difference, largest)
        halves = [
            joined(half, proposal.draw(count, after=count))
            for half, proposal in zip(halves, proposals, strict=True)
        ]
        count *= 2


def _reliable_draws(
    emulation: Emulation,
    problem: EmulationProblem,
    population: ReferencePopulation,
    posterior: Posterior,
    count: int,
) -> tuple[SpecimenPoints, Draws]:
    """Return points, at first ``count``, and draws at which both halves of the points agree.

    Where points lie farther apart than populations are wide, the likely populations are those
    where points happen to lie close. Populations that are wider by the bandwidth of Scott's rule
    narrow the reference population, until it narrows no more; then points are doubled.
    """
    readings = problem.readings
    free = population.root.shape[0] - int(readings.is_measured.sum(axis=1).min())
    narrows = False
    while True:
        points = FibreProposals.fitted(emulation, readings, population, problem.seed).draw(count)
        if not narrows:
            draws = posterior(points.z, points.log_a, None)
            halves = slice(count // 2), slice(count // 2, None)
            difference = _difference(
                *(draws.log_likelihoods(points.z[:, k], points.log_a[:, k]) for k in halves)
            )
            limit = _per_hyperparameter(draws)
            if difference <= limit:
                return points, draws
            if 2 * count > problem.options.most_points:
                raise _monte_carlo_error(problem.name, count, difference, limit)
        smoothing = count ** (-2 / (free + 4)) * population.root @ population.root.T
        specimens = posterior(points.z, points.log_a, smoothing).specimens()
        narrow = ReferencePopulation.from_sample(specimens)
        root = np.linalg.cholesky(narrow.root @ narrow.root.T + smoothing)
        narrows = bool(np.diag(root).prod() < np.diag(population.root).prod() / 2)
        population = ReferencePopulation(narrow.mean, root)
        count = count if narrows else 2 * count


def _per_hyperparameter(draws: Draws) -> float:
    """Return the error of a log-likelihood that shifts hyperparameters as 1 shifts each of four.

    A random function of p hyperparameters with a standard deviation of s nats shifts means by about
    s / sqrt(p) posterior standard deviations.
    """
    return float(np.sqrt(max(draws.thetas.shape[1], 4) / 4))


def _monte_carlo_error(name: str, count: int, difference: float, largest: float) -> DesignError:
    return DesignError(
        f"{name}: got two halves of {count} points a specimen whose log-likelihoods differ by "
        f"{difference:.2g} nats, expected at most {largest:.2g}; measure more outputs of each "
        "specimen, narrow the priors, or use metric=prb.ProbabilityResidual()"
    )


def _difference(first: Floats, second: Floats) -> float:
    """Return the half difference of log-likelihoods (S, N) over the draws where both are finite."""
    finite = np.isfinite(first).all(axis=1) & np.isfinite(second).all(axis=1)
    return half_difference(first[finite], second[finite]) if finite.any() else np.inf


# Specimens with the same outputs measured: rows, columns, the proposal on their fibres, None where
# nothing is measured, and the error of the readings, (columns,), None where they are exact.
type _Pattern = tuple[Indices, Indices, FibreProposal | None, Floats | None]


@dataclass(frozen=True, eq=False)
class FibreProposals:
    """Proposals on the fibres of specimens, by the pattern of outputs that were measured."""

    emulation: Emulation
    readings: Readings
    population: ReferencePopulation
    seed: int
    patterns: list[_Pattern]

    @classmethod
    @one_thread()
    def fitted(
        cls, emulation: Emulation, readings: Readings, population: ReferencePopulation, seed: int
    ) -> FibreProposals:
        """Return proposals that are fitted to the fibres under a population."""
        m = readings.values.shape[1]
        sd = readings.comparison_sd(emulation.error)
        has_error = readings.is_measured & ((readings.error > 0) | (readings.step > 0))
        flags = np.concatenate([readings.is_measured, has_error], axis=1)
        patterns, number = np.unique(flags, axis=0, return_inverse=True)
        proposals: list[_Pattern] = []
        for k, pattern in enumerate(patterns):
            rows = np.flatnonzero(number.ravel() == k)
            columns = np.flatnonzero(pattern[:m])
            if not len(columns):
                proposals.append((rows, columns, None, None))
                continue
            response = _columns(emulation, columns)
            error, reference = None, population
            if pattern[m:].any() or len(columns) >= len(population.mean):
                # A reading error per pattern; the density of each reading replaces it in `draw`.
                error = typical_sd(sd[np.ix_(rows, columns)])
                response, reference = with_errors(response, population, error)
            y = readings.values[np.ix_(rows, columns)]
            proposal = fit_fibres(response, y, reference, seed=seed, numbers=rows)
            proposals.append((rows, columns, proposal, error))
        return cls(emulation, readings, population, seed, proposals)

    @one_thread()
    def draw(self, count: int, after: int = 0) -> SpecimenPoints:
        """Draw points of all specimens, other ones than the first `after`."""
        n, m = self.readings.values.shape
        d = len(self.population.mean)
        z = np.empty((n, count, d))
        log_proposal = np.full((n, count), np.inf)
        exact = np.full((n, count), np.nan)
        for rows, columns, proposal, error in self.patterns:
            if proposal is None:
                z[rows], log_proposal[rows] = _population_points(
                    self.population, rows, count, self.seed, after
                )
                continue
            x, log_a = proposal.draw(count, self.seed, after)
            if error is None:
                z[rows], exact[rows] = x, log_a
                log_proposal[rows] = 0.0
                continue
            z[rows], log_a = without_errors(x, log_a, len(columns))
            values, _ = _columns(self.emulation, columns)(z[rows].reshape(-1, d))
            y = self.readings.values[np.ix_(rows, columns)]
            residual = (y[:, None] - values.reshape(len(rows), count, -1)) / error
            log_normal = -0.5 * residual**2 - np.log(error) - 0.5 * np.log(2 * np.pi)
            log_proposal[rows] = log_normal.sum(axis=-1) - log_a
        outputs = self.emulation.values(z.reshape(-1, d)).reshape(n, count, m)
        readings, of_emulator = self.readings, self.emulation.error
        censored = replace(readings, values=np.full_like(readings.values, np.nan))
        log_a = np.where(
            np.isnan(exact),
            readings.log_density(outputs, of_emulator) - log_proposal,
            exact + censored.log_density(outputs, of_emulator),
        )
        log_a = np.where(np.isnan(log_a), -np.inf, log_a)
        return SpecimenPoints(z, outputs, log_a, log_proposal, np.zeros(n, dtype=np.intp))


def _columns(emulation: Emulation, columns: Indices) -> Response:
    """Return the response of some outputs."""

    def response(z: Floats) -> tuple[Floats, Floats]:
        values, jacobian = emulation(z)
        low, high = emulation.box
        outside = ((z < low - 0.5) | (z > high + 0.5)).any(axis=1)
        values, jacobian = values[:, columns], jacobian[:, columns]
        # The emulator has no runs there.
        values[outside], jacobian[outside] = np.nan, np.nan
        return values, jacobian

    return response


def _population_points(
    population: ReferencePopulation, rows: Indices, count: int, seed: int, after: int
) -> tuple[Floats, Floats]:
    """Return points of a wide population, and the log of count times their density."""
    d, wide = len(population.mean), 1.5
    base = sobol(after + count, d, seed)[after:]
    shift = np.random.default_rng([seed, 2]).random((int(rows.max()) + 1, 1, d))[rows]
    standard = ndtri(np.clip((base + shift) % 1.0, 1e-12, 1 - 1e-12))
    z = population.mean + wide * standard @ population.root.T
    log_det = np.log(np.diag(population.root)).sum() + d * np.log(wide)
    density = -0.5 * (standard**2).sum(axis=-1) - d / 2 * np.log(2 * np.pi) - log_det
    return z, density + np.log(count)


def _fresh(
    points: SpecimenPoints, draws: Draws, count: int, bounds: Floats, rng: np.random.Generator
) -> Floats:
    """Return points for new runs: half a sample of the specimens' inputs, half spread out."""
    specimens = draws.specimens()
    _, n_points, d = points.z.shape
    # Weights of the points under the normal population of the draws.
    mean, covariance = specimens.mean(axis=0), np.cov(specimens.T).reshape(d, d)
    centred = points.z - mean
    square = np.einsum("nkd,de,nke->nk", centred, np.linalg.inv(covariance), centred)
    log_w = -0.5 * square + points.log_a
    finite = np.isfinite(log_w).any(axis=1)
    log_w = log_w[finite]
    weights = np.exp(log_w - log_w.max(axis=1, keepdims=True))
    weights /= weights.sum(axis=1, keepdims=True)
    cumulative = np.cumsum(weights, axis=1)
    samples = []
    for _ in range(max(1, -(-2 * count // len(weights)))):
        k = (cumulative < rng.random((len(weights), 1))).sum(axis=1).clip(max=n_points - 1)
        samples.append(points.z[finite][np.arange(len(k)), k])
    z = np.clip(np.concatenate(samples), bounds[0], bounds[1])
    return spread_out(z, bounds, count, count // 2, rng)


@dataclass(frozen=True, eq=False)
class FibreProposal:
    """Proposal distribution on the fibres of N specimens: a mixture over charts for each."""

    fibres: Fibres  # response, reference population and measured outputs
    charts: Charts
    numbers: Indices  # (N,): numbers of the specimens, from which their random numbers follow

    def draw(self, points: int, seed: int, after: int = 0) -> tuple[Floats, Floats]:
        """Return inputs x, (N, K, d), on all fibres, and numbers A, (N, K); -inf for no point.

        The first ``after`` points of the seed are left out.
        """
        n, d = len(self.fibres.y), len(self.fibres.population.mean)
        x = np.empty((n, points, d))
        log_a = np.empty((n, points))
        for block in _blocks(n, points):
            fibres = replace(self.fibres, y=self.fibres.y[block])
            charts = Charts(*(array[block] for array in vars(self.charts).values()))
            z, log_a[block], _ = _draw(
                fibres, charts, points, (1, seed), self.numbers[block], after
            )
            x[block] = fibres.population.inputs(z)
        return x, log_a


def fit_fibres(
    response: Response,
    y: Floats,
    population: ReferencePopulation,
    *,
    tries: int = 64,
    most_charts: int = 8,
    rounds: int = 2,
    seed: int = 0,
    numbers: Indices | None = None,
) -> FibreProposal:
    """Fit proposals to the fibres of measured outputs y, (N, m) with m < d.

    Charts at the modes, more charts until ``tries`` random points of the fibres are covered, then
    rounds of adaptation to 256 weighted points each. ``population`` should cover the plausible
    populations. A specimen has the same points alone as in a batch if its number is the same.

    Examples
    --------
    The radius of two standard normal inputs has a Rayleigh distribution.

    >>> import numpy as np
    >>> from scipy.special import logsumexp
    >>> def radius(x):
    ...     r = np.sqrt((x**2).sum(axis=1, keepdims=True))
    ...     return r, (x / r)[:, None, :]
    >>> population = ReferencePopulation(np.array([0.1, 0.0]), np.eye(2))
    >>> x, log_a = fit_fibres(radius, np.array([[0.5], [2.0]]), population).draw(1024, seed=1)
    >>> log_density = -(x**2).sum(axis=2) / 2 - np.log(2 * np.pi)
    >>> likelihood = np.exp(logsumexp(log_density + log_a, axis=1))
    >>> np.allclose(likelihood, [0.5 * np.exp(-0.125), 2 * np.exp(-2)], rtol=0.02)
    True
    """
    d = len(population.mean)
    numbers = np.arange(len(y)) if numbers is None else numbers
    fibres = Fibres.of(response, y, population)
    parts = [Charts.empty(0, most_charts, d, y.shape[1])]
    for block in _blocks(len(y), 256):
        part, label = replace(fibres, y=fibres.y[block]), numbers[block]
        normal = ndtri(_shifted_sobol(tries, d, (0, seed), label))
        charts = cover(part, charts_at_modes(part, 8, most_charts), normal)
        for r in range(rounds):
            charts = _adapted(charts, _draw(part, charts, 256, (2 + r, seed), label))
        parts.append(charts)
    arrays = zip(*(vars(part).values() for part in parts), strict=True)
    return FibreProposal(fibres, Charts(*map(np.concatenate, arrays)), numbers)


def with_errors(
    response: Response, population: ReferencePopulation, error: Floats
) -> tuple[Response, ReferencePopulation]:
    """Return response f(x) + error e and population of inputs x and standard normal errors e, (m,).

    The number of outputs may then be that of the inputs or more.
    """
    d, m = len(population.mean), len(error)

    def response_with_error(x: Floats) -> tuple[Floats, Floats]:
        values, jacobian = response(x[:, :-m])
        by_error = np.broadcast_to(np.diag(error), (len(x), m, m))
        values = values + x[:, -m:] * error
        return values, np.concatenate([jacobian, by_error], axis=2)

    root = np.eye(d + m)
    root[:d, :d] = population.root
    mean = np.concatenate([population.mean, np.zeros(m)])
    return response_with_error, ReferencePopulation(mean, root)


def without_errors(x: Floats, log_a: Floats, m: int) -> tuple[Floats, Floats]:
    """Return points over the inputs alone, with log N(e; 0, 1) of m errors added to A."""
    e = x[..., -m:]
    log_normal = -(e**2).sum(axis=-1) / 2 - m / 2 * np.log(2 * np.pi)
    return x[..., :-m], log_a + log_normal


# Points of n specimens: whitened inputs z, (n, K, d), numbers A, (n, K), and charts, (n, K).
type _Sample = tuple[Floats, Floats, Indices]


def _draw(
    fibres: Fibres,
    charts: Charts,
    points: int,
    key: tuple[int, int],
    numbers: Indices,
    after: int = 0,
) -> _Sample:
    """Draw points of the fibres from the mixture of their charts."""
    n, k = len(numbers), charts.location.shape[-1]
    uniform = _shifted_sobol(after + points, k + 2, key, numbers)[:, after:]
    cumulative = np.cumsum(charts.share, axis=1)[:, :-1]
    slot = (uniform[..., :1] > cumulative[:, None, :]).sum(axis=2).ravel()
    specimen = np.repeat(np.arange(n), points)
    if k == 1:
        # Even points on a line have a far smaller error than points from two coordinates.
        t = stdtrit(Charts.degrees, uniform[..., 2].reshape(-1, 1))
    else:
        chi_square = 2 * gammaincinv(Charts.degrees / 2, uniform[..., 1].reshape(-1, 1))
        normal = ndtri(uniform[..., 2:].reshape(-1, k))
        t = normal / np.sqrt(chi_square / Charts.degrees)
    scaled = charts.scale[specimen, slot] @ t[..., None]
    u = charts.location[specimen, slot] + scaled[..., 0]
    # Specimens without charts have arrays of zeros: all their solves fail.
    z, jacobian, converged = charts.points(fibres, specimen, slot, u)

    rows = np.flatnonzero(converged)
    log_density = charts.log_mixture(fibres, specimen[rows], slot[rows], z[rows], jacobian[rows])
    log_a = np.full(len(z), -np.inf)
    log_units = np.log(np.diagonal(fibres.population.root)).sum()
    log_units = log_units - np.log(fibres.unit).sum()
    log_a[rows] = log_units - np.log(points) - log_density
    z = np.where(converged[:, None], z, 0.0)
    return z.reshape(n, points, -1), log_a.reshape(n, points), slot.reshape(n, points)


def _adapted(charts: Charts, sample: _Sample) -> Charts:
    """Return charts with location, scale and share of their weighted points.

    The present values count as 4 (d - m) points.
    """
    z, log_a, chart = sample
    k = charts.free.shape[3]
    log_weight = log_a - (z**2).sum(axis=2) / 2
    largest = log_weight.max(axis=1, keepdims=True)
    weight = np.exp(log_weight - np.where(np.isfinite(largest), largest, 0))
    weight /= np.maximum(weight.sum(axis=1, keepdims=True), 1e-300)
    location, scale = charts.location.copy(), charts.scale.copy()
    share = np.zeros_like(charts.share)
    for c in range(share.shape[1]):
        w = np.where(chart == c, weight, 0)
        share[:, c] = w.sum(axis=1)
        i = np.flatnonzero(share[:, c] > 1e-6)
        w = w[i] / share[i, c][:, None]
        size = 1 / (w**2).sum(axis=1)
        old = (4.0 * k / (size + 4 * k))[:, None]
        new = (size / (size + 4 * k))[:, None]
        u = (z[i] - charts.centre[i, None, c]) @ charts.free[i, c]
        mean = new * (w[:, None, :] @ u)[:, 0] + old * charts.location[i, c]
        centred = u - mean[:, None]
        covariance = (centred * w[..., None]).transpose(0, 2, 1) @ centred
        present = scale[i, c] @ scale[i, c].transpose(0, 2, 1) / Charts.inflation
        covariance = new[..., None] * covariance + old[..., None] * present
        location[i, c] = mean
        scale[i, c] = np.linalg.cholesky(Charts.inflation * covariance)
    has_chart = charts.share > 0
    share = 0.9 * share + 0.1 * has_chart / np.maximum(has_chart.sum(axis=1, keepdims=True), 1)
    share = np.where(has_chart, share, 0)
    share /= np.maximum(share.sum(axis=1, keepdims=True), 1e-300)
    return replace(charts, location=location, scale=scale, share=share)


def _shifted_sobol(points: int, dimensions: int, key: tuple[int, int], numbers: Indices) -> Floats:
    """Return Sobol points with a digital shift of the specimen, (n, points, dimensions).

    Errors of specimens are independent: they average out in the log-likelihood.
    """
    bits = 30  # of SciPy's points, which are multiples of 2^-30
    net = (sobol(points, dimensions, key[1]) * 2**bits).astype(np.int64)
    shifts = [np.random.default_rng([*key, i]).integers(0, 2**bits, dimensions) for i in numbers]
    shifted = net ^ np.reshape(shifts, (len(numbers), 1, dimensions)).astype(np.int64)
    return np.asarray((shifted + 0.5) / 2**bits)


def _blocks(specimens: int, points: int) -> Iterator[slice]:
    """Return slices of the specimens with some 16 000 points each, which bounds the memory."""
    size = max(1, 2**14 // points)
    for start in range(0, specimens, size):
        yield slice(start, start + size)
