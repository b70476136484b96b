"""Charts of fibres: local coordinates of the solutions of f(x) = y for fewer outputs than inputs.

A chart describes a part of the fibre {x : f(x) = y} by d - m free coordinates; Newton's method
solves for the m others. `prbayes.propagation.fibre_points` derives the density that charts lead to.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln, logsumexp, ndtri

from prbayes._validate import Floats
from prbayes.numerics.points import sobol
from prbayes.propagation.roots import Response, find_roots

Indices = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class ReferencePopulation:
    """Normal population in which inputs are whitened, x = mean + root z."""

    mean: Floats  # (d,)
    root: Floats  # (d, d): lower Cholesky factor of the covariance

    @classmethod
    def from_sample(cls, x: Floats) -> ReferencePopulation:
        """Return the population with the moments of a sample, (n, d), or raise ValueError."""
        weights = np.full(len(x), 1 / len(x))
        mean = weights @ x
        centred = x - mean
        covariance = (centred.T * weights) @ centred
        sd = np.sqrt(np.diagonal(covariance))
        if np.all(sd > 0):
            # Scaled: units of the inputs do not decide whether the matrix is singular.
            correlation = covariance / np.outer(sd, sd)
            if np.linalg.eigvalsh(correlation)[0] > 1e-10:
                return cls(mean, sd[:, None] * np.linalg.cholesky(correlation))
        raise ValueError(
            f"covariance of the inputs: got a singular matrix from {len(x)} points, expected "
            f"{x.shape[1]} linearly independent inputs that vary: pass more points"
        )

    def inputs(self, z: Floats) -> Floats:
        """Return the inputs (..., d) at whitened inputs (..., d)."""
        return self.mean + z @ self.root.T


@dataclass(frozen=True, eq=False)
class Fibres:
    """Fibres {z : g(z) = y_i} of N specimens in whitened inputs; g is the response over `unit`.

    All numbers are free of the units of inputs and outputs.
    """

    response: Response
    population: ReferencePopulation
    unit: Floats  # (m,): spread of the outputs in the reference population
    y: Floats  # (N, m): measured outputs, divided by `unit`

    @classmethod
    def of(cls, response: Response, y: Floats, population: ReferencePopulation) -> Fibres:
        """Return the fibres of measured outputs y, (N, m)."""
        unit = np.ones(y.shape[1])
        z = ndtri(sobol(64, len(population.mean), 0))
        values, _ = cls(response, population, unit, y).outputs(z)
        values = values[np.isfinite(values).all(axis=1)]
        if len(values) > 1:
            # Quantiles, as a pole of the response makes the standard deviation arbitrary.
            low, high = np.quantile(values, [0.16, 0.84], axis=0)
            unit = np.where(high > low, (high - low) / 2, 1.0)
        return cls(response, population, unit, y / unit)

    @np.errstate(all="ignore")
    def outputs(self, z: Floats) -> tuple[Floats, Floats]:
        """Return g(z), (n, m), and its Jacobian, (n, m, d); NaN where either is not finite."""
        values, jacobian = self.response(self.population.inputs(z))
        values = values / self.unit
        jacobian = (jacobian / self.unit[:, None]) @ self.population.root
        # Determinants of larger numbers overflow.
        usable = (np.abs(values) < 1e12).all(axis=1)
        usable &= (np.abs(jacobian) < 1e12).all(axis=(1, 2))
        values = np.where(usable[:, None], values, np.nan)
        return values, np.where(usable[:, None, None], jacobian, np.nan)

    @np.errstate(all="ignore")
    def solve(
        self,
        specimen: Indices,
        z: Floats,
        directions: Floats | None = None,
        solution: tuple[Floats, Floats] | None = None,
    ) -> tuple[Floats, Floats, NDArray[np.bool_]]:
        """Move z onto fibres by at most 15 Newton steps, at most one unit long.

        ``directions``, (n, d, m), are the span of the steps, by default that of the Jacobian's rows
        (steps of least norm). Along them the determinant of the Jacobian keeps its sign: beyond a
        fold another chart finds the points. ``solution`` has points of the fibres and Jacobians
        there: steps that come within .01 of them have converged. Returns points, Jacobians there,
        (n, m, d), and which of them converged.
        """
        z = z.copy()
        jacobian = np.zeros((len(z), self.y.shape[1], z.shape[1]))
        converged = np.zeros(len(z), dtype=bool)
        sign = np.zeros(len(z))
        if directions is not None and solution is not None:
            sign = np.sign(np.linalg.det(solution[1] @ directions))
        active = np.arange(len(z))
        for _ in range(15):
            if not active.size:
                break
            values, slopes = self.outputs(z[active])
            span = slopes.transpose(0, 2, 1) if directions is None else directions[active]
            matrices = slopes @ span
            if directions is not None:
                signs = np.sign(np.linalg.det(matrices))
                same = (signs == sign[active]) | (sign[active] == 0)
                sign[active] = signs
                active, values, slopes = active[same], values[same], slopes[same]
                span, matrices = span[same], matrices[same]
            coefficients = solve_each(matrices, self.y[specimen[active]] - values)
            step = (span @ coefficients[..., None])[..., 0]
            length = np.sqrt((step**2).sum(axis=1))
            # Beyond 12 standard deviations no population of interest has mass.
            usable = np.isfinite(length) & (np.abs(z[active]) < 12).all(axis=1)
            active, step, length = active[usable], step[usable], length[usable]
            jacobian[active] = slopes[usable]
            z[active] += step / np.maximum(length, 1)[:, None]
            is_done = length < 1e-6
            if solution is not None:
                is_done |= np.abs(z[active] - solution[0][active]).max(axis=1) < 0.01
            converged[active] = is_done
            active = active[~is_done]
        return z, jacobian, converged


@dataclass(frozen=True, eq=False)
class Charts:
    """Charts of the fibres of N specimens, at most C for each.

    Chart c maps u to z = centre + free u + solved w(u) with w(u) such that g(z) = y_i; u has a t
    distribution as proposal. Arrays of some charts have the shape (n, ...) in place of (N, C, ...).
    """

    # Degrees of freedom of the t distributions; 5 and 20 gave the same effective sample sizes.
    degrees: ClassVar[float] = 8.0
    # Inflation of the covariance against that of weighted points; 1.1 and 1.5 gave the same.
    inflation: ClassVar[float] = 1.3

    centre: Floats  # (N, C, d)
    # Orthonormal columns: the null space and the row space of the Jacobian at the centre.
    free: Floats  # (N, C, d, d - m)
    solved: Floats  # (N, C, d, m)
    location: Floats  # (N, C, d - m): of the t distribution
    scale: Floats  # (N, C, d - m, d - m): lower Cholesky factor of its scale matrix
    share: Floats  # (N, C): mixing weight, zero where there is no chart

    @classmethod
    def empty(cls, n: int, charts: int, d: int, m: int) -> Charts:
        """Return arrays of n specimens without a chart."""
        k = d - m
        shapes = (d,), (d, k), (d, m), (k,)
        centre, free, solved, location = (np.zeros((n, charts, *shape)) for shape in shapes)
        scale = np.tile(np.eye(k), (n, charts, 1, 1))
        return cls(centre, free, solved, location, scale, np.zeros((n, charts)))

    def including(self, specimen: Indices, slot: Indices, charts: Charts) -> Charts:
        """Replace charts (specimen, slot), both (n,); all charts of a specimen share alike."""
        arrays = {name: array.copy() for name, array in vars(self).items()}
        for name, array in arrays.items():
            array[specimen, slot] = getattr(charts, name)
        present = arrays["share"] > 0
        arrays["share"] = present / np.maximum(present.sum(axis=1, keepdims=True), 1)
        return Charts(**arrays)

    def points(
        self,
        fibres: Fibres,
        specimen: Indices,
        slot: Indices,
        u: Floats,
        solution: tuple[Floats, Floats] | None = None,
    ) -> tuple[Floats, Floats, NDArray[np.bool_]]:
        """Return the points at free coordinates u, (n, d - m), as `Fibres.solve` does."""
        along = self.free[specimen, slot] @ u[..., None]
        start = self.centre[specimen, slot] + along[..., 0]
        return fibres.solve(specimen, start, self.solved[specimen, slot], solution)

    def coordinates(self, specimen: Indices, slot: Indices, z: Floats) -> Floats:
        """Return the free coordinates (n, d - m) of points z, (n, d)."""
        centred = z - self.centre[specimen, slot]
        return (centred[:, None, :] @ self.free[specimen, slot])[:, 0]

    def reach(
        self, fibres: Fibres, specimen: Indices, slot: Indices, z: Floats, jacobian: Floats
    ) -> NDArray[np.bool_]:
        """Return whether charts reach points z of their fibre, (n, d), with Jacobians (n, m, d)."""
        u = self.coordinates(specimen, slot, z)
        end, _, converged = self.points(fibres, specimen, slot, u, (z, jacobian))
        return converged & (np.abs(end - z).max(axis=1) < 0.01)

    def log_mixture(
        self, fibres: Fibres, specimen: Indices, slot: Indices, z: Floats, jacobian: Floats
    ) -> Floats:
        """Return the log-density of the proposal, by the balance heuristic.

        The sum of share t(u) |det(J solved)| over the charts that reach the point: a density with
        respect to the fibre's volume over sqrt(det J J'), the same measure in every chart. Chart
        ``slot`` of ``specimen``, (n,) both, drew the point.
        """
        k, nu = self.location.shape[-1], Charts.degrees
        exponent = (nu + k) / 2
        inverse = np.linalg.inv(self.scale)
        constant = gammaln(exponent) - gammaln(nu / 2) - k / 2 * np.log(nu * np.pi)
        n, charts = len(z), self.share.shape[1]
        terms = np.full((n, charts), -np.inf)
        with np.errstate(divide="ignore"):
            constant = constant + np.log(np.diagonal(inverse, axis1=2, axis2=3)).sum(axis=2)
            constant = constant + np.log(self.share)
            for c in range(charts):
                rows = np.flatnonzero(self.share[specimen, c] > 0)
                i = specimen[rows]
                centred = self.coordinates(i, np.full(len(rows), c), z[rows]) - self.location[i, c]
                scaled = inverse[i, c] @ centred[..., None]
                distance = (scaled[..., 0] ** 2).sum(axis=1)
                log_det = np.log(np.abs(np.linalg.det(jacobian[rows] @ self.solved[i, c])))
                log_t = constant[i, c] - exponent * np.log1p(distance / nu)
                terms[rows, c] = log_t + log_det
        # Only charts whose term matters need the check that they reach the point.
        nearest = terms[np.arange(n), slot]
        terms[terms < nearest[:, None] - 10] = -np.inf
        for c in range(charts):
            rows = np.flatnonzero((terms[:, c] > -np.inf) & (slot != c))
            j = np.full(len(rows), c)
            is_reached = self.reach(fibres, specimen[rows], j, z[rows], jacobian[rows])
            terms[rows[~is_reached], c] = -np.inf
        return np.asarray(logsumexp(terms, axis=1))


@np.errstate(all="ignore")
def solve_each(matrices: Floats, right: Floats) -> Floats:
    """Return the solutions (n, m) of n linear systems, NaN where a matrix is singular."""
    if matrices.shape[-1] == 1:
        return right / matrices[..., 0]
    try:
        return np.linalg.solve(matrices, right[..., None])[..., 0]
    except np.linalg.LinAlgError:
        singular = np.linalg.det(matrices) == 0
        safe = np.where(singular[:, None, None], np.eye(matrices.shape[-1]), matrices)
        solution = np.linalg.solve(safe, right[..., None])[..., 0]
        return np.where(singular[:, None], np.nan, solution)


def charts_at_modes(fibres: Fibres, starts: int, charts: int) -> Charts:
    """Return charts at the modes of the reference population on the fibres.

    At most four for a specimen: modes within 8 nats of the best. They minimise |z|^2 / 2 + |(g(z) -
    y) / .05|^2 / 2, in which the population is the weak term.
    """
    n, m = fibres.y.shape
    d = len(fibres.population.mean)

    def with_inputs(z: Floats) -> tuple[Floats, Floats]:
        values, jacobian = fibres.outputs(z)
        identity = np.broadcast_to(np.eye(d), (len(z), d, d))
        return np.concatenate([values, z], axis=1), np.concatenate([jacobian, identity], axis=1)

    first = np.concatenate([np.zeros((1, d)), ndtri(sobol(starts, d, 0))])[:starts]
    target = np.concatenate([fibres.y, np.zeros((n, d))], axis=1)
    sd = np.repeat([0.05, 1.0], [m, d])
    box = np.stack([np.full(d, -12.0), np.full(d, 12.0)])
    modes = find_roots(with_inputs, target, sd, np.tile(first, (n, 1, 1)), box, gap=8.0)
    z, jacobian, converged = fibres.solve(modes.specimen, modes.z)
    log_density = -(z**2).sum(axis=1) / 2
    rows = np.flatnonzero(converged)
    rows = rows[np.lexsort((-log_density[rows], modes.specimen[rows]))]
    specimen = modes.specimen[rows]
    slot = np.arange(len(rows)) - np.searchsorted(specimen, specimen)
    rows, specimen, slot = (values[slot < min(4, charts)] for values in (rows, specimen, slot))
    new = _charts_at(fibres, z[rows], jacobian[rows])
    return Charts.empty(n, charts, d, m).including(specimen, slot, new)


def cover(fibres: Fibres, charts: Charts, normal: Floats) -> Charts:
    """Add charts until random points of the fibres are covered, at most three for a specimen.

    A chart covers a point if it reaches the point, and |det(J solved)| >= .3 sqrt(det J J') there.
    The most probable point that no chart covers gets a chart: other sheets and turns are detected
    thus. ``normal``, (N, tries, d), are standard normal numbers.
    """
    n, tries, d = normal.shape
    specimen = np.repeat(np.arange(n), tries)
    nearby = charts.centre[:, :1] + 0.5 * normal
    # The first half, as even points of a Sobol sequence lie in one half of the space.
    is_first_half = np.arange(tries)[:, None] < tries / 2
    start = np.where(is_first_half, normal, nearby).reshape(-1, d)
    z, jacobian, converged = fibres.solve(specimen, start)
    log_density = -(z**2).sum(axis=1) / 2
    present = charts.share > 0
    modes = np.where(present, -(charts.centre**2).sum(axis=2) / 2, -np.inf)
    rows = np.flatnonzero(converged & (log_density > modes.max(axis=1)[specimen] - 8))
    rows = rows[np.argsort(-log_density[rows], kind="stable")]  # most probable first
    volume = np.zeros(len(z))
    gram = jacobian[rows] @ jacobian[rows].transpose(0, 2, 1)
    volume[rows] = np.sqrt(np.linalg.det(gram))
    rows = rows[volume[rows] > 0]

    def uncovered(rows: Indices, slot: Indices) -> Indices:
        """Return the points that chart `slot` of their specimen does not cover."""
        projected = jacobian[rows] @ charts.solved[specimen[rows], slot]
        is_covered = np.abs(np.linalg.det(projected)) / volume[rows] >= 0.3
        near = rows[is_covered]
        is_covered[is_covered] = charts.reach(
            fibres, specimen[near], slot[is_covered], z[near], jacobian[near]
        )
        return np.asarray(rows[~is_covered])

    for c in range(present.shape[1]):
        has_chart = present[specimen[rows], c]
        remaining = uncovered(rows[has_chart], np.full(has_chart.sum(), c))
        rows = rows[~has_chart | np.isin(rows, remaining)]
    for _ in range(3):
        count = (charts.share > 0).sum(axis=1)
        rows = rows[count[specimen[rows]] < charts.share.shape[1]]
        pick = rows[np.unique(specimen[rows], return_index=True)[1]]
        if not pick.size:
            break
        i = specimen[pick]
        charts = charts.including(i, count[i], _charts_at(fibres, z[pick], jacobian[pick]))
        rows = uncovered(rows, count[specimen[rows]])
    return charts


def _charts_at(fibres: Fibres, z: Floats, jacobian: Floats) -> Charts:
    """Return charts at points of the fibres, (n, d), with the Laplace approximation of u.

    Hessian and slope of log p(u) = -|z(u)|^2 / 2 - log |det J solved| follow from Jacobians beside
    the centre; the second derivative of the determinant is left out.
    """
    n, m, d = jacobian.shape
    right = np.linalg.svd(jacobian)[2].transpose(0, 2, 1)
    solved, free = right[..., :m], right[..., m:]
    square = jacobian @ solved
    radial = (z[:, None, :] @ solved)[:, 0]
    multiplier = solve_each(square.transpose(0, 2, 1), radial)  # of the constraint g(z) = y
    slope = -(z[:, None, :] @ free)[:, 0]
    curvature = np.empty((n, d - m, d - m))
    step = 1e-3
    for a in range(d - m):
        ahead = fibres.outputs(z + step * free[..., a])[1]
        behind = fibres.outputs(z - step * free[..., a])[1]
        change = (ahead - behind) / (2 * step)
        curvature[:, a] = (multiplier[:, None, :] @ change @ free)[:, 0]
        for o in range(m):  # trace(square^-1 change solved), by columns
            slope[:, a] -= solve_each(square, (change @ solved)[..., o])[:, o]
    # NaN beside the range of the response, or at a singular Jacobian
    bad = ~(np.isfinite(curvature).all(axis=(1, 2)) & np.isfinite(slope).all(axis=1))
    curvature[bad], slope[bad] = 0, 0
    hessian = np.eye(d - m) - (curvature + curvature.transpose(0, 2, 1)) / 2
    precision, axes = np.linalg.eigh(hessian)
    variance = 1 / np.clip(precision, 1 / 1.5, 1 / 0.3)
    covariance = (axes * variance[:, None, :]) @ axes.transpose(0, 2, 1)
    shift = (covariance @ slope[..., None])[..., 0]
    shift /= np.maximum(np.sqrt((shift**2).sum(axis=1, keepdims=True)), 1)
    scale = np.linalg.cholesky(Charts.inflation * covariance)
    return Charts(z, free, solved, shift, scale, np.ones(n))
