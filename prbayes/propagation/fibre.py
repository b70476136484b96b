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

The sum is over the charts that map u_j = F_j'(z - z*_j) to the point.

**Accuracy.** Errors of specimens add up, so effective sample sizes do not show the error of the
log-likelihood. Use K = 256 first, then compare two sets of points with different seeds, and join
more of them until they agree. Theta far outside the reference population needs a new one: fit it to
inputs of posterior draws (`ReferencePopulation.from_sample`), twice.
A small closed fibre beside an extremum of the response can be missed, and no number shows it.

Papadimas and Dodwell [3]_ integrate over the inputs of specimens by an emulator and quadrature.

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

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import gammaincinv, ndtri, stdtrit

from prbayes._validate import Floats
from prbayes.numerics.points import sobol
from prbayes.propagation.charts import (
    Charts,
    Fibres,
    Indices,
    ReferencePopulation,
    Response,
    charts_at_modes,
    cover,
)


@dataclass(frozen=True, eq=False)
class FibrePoints:
    """K importance points on the fibre of each of N specimens.

    log L_i(theta) = logsumexp_k(log p(x_ik | theta) + log_a_ik).
    """

    x: Floats  # (N, K, d): inputs; the mean of the reference population for points of weight zero
    # (N, K): logarithms of the importance numbers, minus log K; -inf for points of weight zero
    log_a: Floats

    def without_errors(self, outputs: int) -> FibrePoints:
        """Return points over the inputs alone, with log N(e; 0, 1) added to `log_a`.

        For points over inputs and reading errors e, from a response with `with_error`: the last
        ``outputs`` inputs.
        """
        e = self.x[..., -outputs:]
        log_normal = -(e**2).sum(axis=-1) / 2 - outputs / 2 * np.log(2 * np.pi)
        return FibrePoints(self.x[..., :-outputs], self.log_a + log_normal)


@dataclass(frozen=True, eq=False)
class FibreProposal:
    """Proposal distribution on the fibres of N specimens: a mixture over charts for each."""

    fibres: Fibres  # response, reference population and measured outputs
    charts: Charts
    numbers: Indices  # (N,): numbers of the specimens, from which their random numbers follow

    def draw(self, points: int, seed: int, after: int = 0) -> FibrePoints:
        """Draw points on all fibres.

        K = ``points`` for each specimen: a power of two fills the fibre most evenly. The first
        ``after`` points of the same seed are left out, as they were drawn before.
        """
        n, d = len(self.fibres.y), len(self.fibres.population.mean)
        x = np.empty((n, points, d))
        log_a = np.empty((n, points))
        for block in _blocks(n, points):
            fibres, charts = self.fibres.subset(block), self.charts.subset(block)
            sample = _draw(fibres, charts, points, (1, seed), self.numbers[block], after)
            x[block], log_a[block] = self.fibres.population.inputs(sample.z), sample.log_a
        return FibrePoints(x, log_a)


def fit_fibres(
    response: Response,
    y: Floats,
    population: ReferencePopulation,
    *,
    starts: int = 8,
    tries: int = 64,
    most_charts: int = 8,
    rounds: int = 2,
    seed: int = 0,
    numbers: Indices | None = None,
) -> FibreProposal:
    """Fit proposals to the fibres of measured specimens.

    Charts at the modes, more charts until random points of the fibres are covered, then rounds of
    adaptation to 256 weighted points each. Charts turn in all rounds but the last, before which
    the cover is repeated: without that, single specimens of a study with three inputs and two
    outputs lacked up to .35 in log L. Numbers of a specimen depend on the other specimens only by
    rounding.

    The response is called with many inputs (n, d), and is NaN where it has no value; y are the
    measured outputs, (N, m) with m < d. The proposals are fitted to ``population``, which should
    cover the plausible populations. Modes are searched from ``starts`` points, and ``tries`` random
    points of the fibre show whether charts are missing. A specimen has the same points alone as in
    a batch if its number is the same.

    Examples
    --------
    The radius of two standard normal inputs has a Rayleigh distribution.

    >>> import numpy as np
    >>> from scipy.special import logsumexp
    >>> def radius(x):
    ...     r = np.sqrt((x**2).sum(axis=1, keepdims=True))
    ...     return r, (x / r)[:, None, :]
    >>> population = ReferencePopulation(np.array([0.1, 0.0]), np.eye(2))
    >>> points = fit_fibres(radius, np.array([[0.5], [2.0]]), population).draw(1024, seed=1)
    >>> log_density = -(points.x**2).sum(axis=2) / 2 - np.log(2 * np.pi)
    >>> likelihood = np.exp(logsumexp(log_density + points.log_a, axis=1))
    >>> np.allclose(likelihood, [0.5 * np.exp(-0.125), 2 * np.exp(-2)], rtol=0.02)
    True
    """
    d = len(population.mean)
    numbers = np.arange(len(y)) if numbers is None else numbers
    fibres = Fibres.of(response, y, population)
    parts = [Charts.empty(0, most_charts, d, y.shape[1])]
    for block in _blocks(len(y), 256):
        part, label = fibres.subset(block), numbers[block]
        charts = charts_at_modes(part, starts, most_charts)
        normal = ndtri(_shifted_sobol(tries, d, (0, seed), label))
        charts = cover(part, charts, normal)
        for r in range(rounds):
            last = r == rounds - 1
            if last and r > 0:
                # Charts that turned end elsewhere; those of the last round keep their directions.
                charts = cover(part, charts, normal)
            sample = _draw(part, charts, 256, (2 + r, seed), label)
            charts = _adapted(charts, sample, turn=not last)
        parts.append(charts)
    return FibreProposal(fibres, Charts.concatenated(parts), numbers)


def with_error(response: Response, error: Floats) -> Response:
    """Return the response with the reading's error, f(x) + error e, of d + m inputs (x, e).

    Use it with `ReferencePopulation.with_errors` and `FibrePoints.without_errors`. The number of
    outputs may then be that of the inputs or more.

    The errors, (m,), are positive standard deviations of the reading, in units of the outputs.
    """
    m = len(error)

    def response_with_error(x: Floats) -> tuple[Floats, Floats]:
        values, jacobian = response(x[:, :-m])
        by_error = np.broadcast_to(np.diag(error), (len(x), m, m))
        values = values + x[:, -m:] * error
        return values, np.concatenate([jacobian, by_error], axis=2)

    return response_with_error


@dataclass(frozen=True, eq=False)
class _Sample:
    """Points of a block of specimens, with what the adaptation of charts needs."""

    z: Floats  # (n, K, d): whitened inputs
    log_a: Floats  # (n, K)
    chart: Indices  # (n, K)
    jacobian: Floats  # (n, K, m, d): with respect to z


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
    return _Sample(
        z.reshape(n, points, -1),
        log_a.reshape(n, points),
        slot.reshape(n, points),
        np.where(converged[:, None, None], jacobian, 0.0).reshape(n, points, *jacobian.shape[1:]),
    )


def _adapted(charts: Charts, sample: _Sample, turn: bool) -> Charts:
    """Return charts with location, scale and share of their weighted points.

    The weights are those of the reference population. With `turn` the solved directions become
    the row space of the mean Jacobian, which keeps det(J solved) off zero over more of the fibre
    than the row space at one point. The present values count as 4 (d - m) points.
    """
    d, k = charts.free.shape[2:]
    m = d - k
    log_weight = sample.log_a - (sample.z**2).sum(axis=2) / 2
    largest = log_weight.max(axis=1, keepdims=True)
    weight = np.exp(log_weight - np.where(np.isfinite(largest), largest, 0))
    weight /= np.maximum(weight.sum(axis=1, keepdims=True), 1e-300)
    free, solved = charts.free.copy(), charts.solved.copy()
    location, scale = charts.location.copy(), charts.scale.copy()
    share = np.zeros_like(charts.share)
    for c in range(share.shape[1]):
        w = np.where(sample.chart == c, weight, 0)
        share[:, c] = w.sum(axis=1)
        i = np.flatnonzero(share[:, c] > 1e-6)
        w = w[i] / share[i, c][:, None]
        squares = weight[i] ** 2 * (sample.chart[i] == c)
        size = share[i, c] ** 2 / squares.sum(axis=1)

        turns = (size > d) & turn
        turned = i[turns]
        mean_jacobian = np.einsum("nk,nkmd->nmd", w[turns], sample.jacobian[turned])
        right = np.linalg.svd(mean_jacobian)[2].transpose(0, 2, 1)
        solved[turned, c] = right[..., :m]
        free[turned, c] = right[..., m:]

        # Present location and scale in the new directions
        rotation = free[i, c].transpose(0, 2, 1) @ charts.free[i, c]
        transposed = rotation.transpose(0, 2, 1)
        present_location = (rotation @ charts.location[i, c][..., None])[..., 0]
        root = rotation @ charts.scale[i, c]
        present = (
            root @ root.transpose(0, 2, 1) / Charts.inflation + np.eye(k) - rotation @ transposed
        )

        u = (sample.z[i] - charts.centre[i, None, c]) @ free[i, c]
        old = (4.0 * k / (size + 4 * k))[:, None]
        new = (size / (size + 4 * k))[:, None]
        mean = new * (w[:, None, :] @ u)[:, 0] + old * present_location
        centred = u - mean[:, None]
        covariance = (centred * w[..., None]).transpose(0, 2, 1) @ centred
        covariance = new[..., None] * covariance + old[..., None] * present
        location[i, c] = mean
        scale[i, c] = np.linalg.cholesky(Charts.inflation * covariance)
    has_chart = charts.share > 0
    share = 0.9 * share + 0.1 * has_chart / np.maximum(has_chart.sum(axis=1, keepdims=True), 1)
    share = np.where(has_chart, share, 0)
    share /= np.maximum(share.sum(axis=1, keepdims=True), 1e-300)
    return replace(charts, free=free, solved=solved, location=location, scale=scale, share=share)


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
