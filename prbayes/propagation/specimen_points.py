"""Importance points around the roots of each measured specimen.

    p(y_i | theta) = integral p(y_i | f(x)) p(x | theta) dx  ~=  sum_k exp(A_ik) p(x_ik | theta).

Points x_ik and numbers A_ik do not contain theta. Points are drawn around every root from a
multivariate t distribution; the mixture over the roots of a specimen is the proposal density.
Papadimas and Dodwell (2021), doi:10.1017/dce.2021.20, integrate over the inputs by quadrature.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import compress
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri, expit, gammaln, ndtri

from prbayes._stats import log_sum_exp
from prbayes._validate import IN_CACHE, Floats
from prbayes.metrics.readings import Readings
from prbayes.numerics.points import sobol
from prbayes.propagation.base import DesignError
from prbayes.propagation.population_density import (
    Normal,
    bootstrap_normals,
    fit_normal,
    normal_log_density,
    normalised_weights,
)
from prbayes.propagation.roots import Roots, rows_by_specimen
from prbayes.propagation.specimen_emulation import Emulation, PointOptions, half_difference


@dataclass(frozen=True, eq=False)
class SpecimenPoints:
    """Points of N specimens."""

    z: Floats  # (N, K, d)
    outputs: Floats  # (N, K, m): the emulator's outputs at the points
    # (N, K): the log-likelihood of a specimen under a density p of z is ``logsumexp(log p(z) +
    # log_a, axis=1)``; -inf for points that fill up the array
    log_a: Floats
    # (N, K): log of the number of points times the proposal density: ``log_a`` without the density
    # of the readings, for an error that is not known in advance
    log_proposal: Floats
    n_roots: NDArray[np.intp]  # (N,)
    difference: float = np.nan  # the half difference of the log-likelihoods

    def rows(self, index: NDArray[np.intp]) -> SpecimenPoints:
        """Return the points of selected specimens."""
        arrays = {name: value[index] for name, value in vars(self).items() if name != "difference"}
        return replace(self, **arrays)


def joined(first: SpecimenPoints, second: SpecimenPoints) -> SpecimenPoints:
    """Return two independent sets of points as one; each counts half."""
    return SpecimenPoints(
        np.concatenate([first.z, second.z], axis=1),
        np.concatenate([first.outputs, second.outputs], axis=1),
        np.concatenate([first.log_a, second.log_a], axis=1) - np.log(2),
        np.concatenate([first.log_proposal, second.log_proposal], axis=1) + np.log(2),
        first.n_roots,
    )


@dataclass(frozen=True, eq=False)
class _Components:
    """Multivariate t components, one for each root."""

    specimen: NDArray[np.intp]  # (R,)
    center: Floats  # (R, d)
    root: Floats  # (R, d, d): lower Cholesky factors of the scale matrices
    log_mass: Floats  # (R,): log of the integral of the readings' density; NaN of uncertain ones

    @cached_property
    def table(self) -> NDArray[np.intp]:
        """The components of each specimen, (N, most), filled up with -1."""
        return rows_by_specimen(self.specimen)

    def by_component(self, values: Floats) -> Floats:
        """Return values by component, (R, k, ...), of values by specimen, (N, most * k, ...)."""
        slots = self.table.shape[1]
        slot = np.nonzero(self.table >= 0)[1]  # components are in the order of specimens
        shaped = values.reshape(len(values), slots, -1, *values.shape[2:])
        return shaped[self.specimen, slot]


def draw_points(
    emulation: Emulation,
    readings: Readings,
    roots: Roots,
    options: PointOptions,
    *,
    error_is_known: bool = True,
    gross_errors: bool = False,
    seed: int = 0,
) -> SpecimenPoints:
    """Draw points around all roots until two independent halves of them agree.

    With gross errors outlying specimens have no influence on the number of points.

    If ``error_is_known``, the weights around the root of certain readings are scaled to its mass,
    which 256 points measure; otherwise the error of the readings is approximate. Raise DesignError
    if `most_points` are not enough.
    """
    typical = np.ones(len(readings), dtype=bool)
    if gross_errors:
        typical = _typical(roots, len(readings))
    sampler = _PointSampler(emulation, readings, options.degrees, typical)
    components = _fit_components(sampler, roots, seed)
    is_certain = np.isfinite(components.log_mass).all()
    count = options.points * (1 if is_certain and error_is_known else 16)
    scales = (1.0,) if error_is_known else (0.125, 0.25, 0.5, 1.0, 1.3)
    if not error_is_known:
        components = _at_likely_error(sampler, components, roots, options.gap, seed)
    fits: dict[float, list[Normal]] = {}
    # Where the error of the readings is as large as the scatter, populations may be much narrower
    # than their fit. They are added step by step: too few points exclude them wrongly.
    narrowing = [1.0, 0.5]
    while True:
        halves = [sampler.draw(components, max(1, count // 2), (seed, h)) for h in (1, 2)]
        if error_is_known:
            halves = [_normalised(half, components) for half in halves]
        of_error = {
            k: halves if k == 1.0 else [sampler.with_error(half, k) for half in halves]
            for k in scales
        }
        samples = {k: joined(*pair) for k, pair in of_error.items()}
        whole = samples[1.0]
        if gross_errors:
            samples = {k: sample.rows(typical) for k, sample in samples.items()}
            of_error = {k: [half.rows(typical) for half in pair] for k, pair in of_error.items()}
        fits = fits or {k: bootstrap_normals(x.z, x.log_a, 32, seed) for k, x in samples.items()}
        difference = 0.0
        while narrowing and difference <= options.half_difference:
            plausible = _plausible(samples, fits, narrowing[0])
            values = [
                half_difference(*(_log_likelihoods(half, populations) for half in of_error[k]))
                for k, populations in plausible.items()
                if populations
            ]
            difference = max(values, default=0.0)
            narrowing = narrowing[1:] if difference <= options.half_difference else narrowing
        largest = components.table.shape[1] * count
        most = max(options.most_points, options.most_in_all // len(readings))
        if difference <= options.half_difference or 2 * largest > most:
            break
        count *= 2
    if difference > options.half_difference and narrowing[0] == 1.0:
        raise DesignError(
            f"log-likelihood: got two halves of {largest} points a specimen that differ by "
            f"{difference:.2g} nats, expected at most {options.half_difference}; use another "
            "metric, such as prb.ProbabilityResidual()"
        )
    n_roots = np.bincount(roots.specimen, minlength=len(readings))
    return replace(whole, n_roots=n_roots, difference=difference)


def _typical(roots: Roots, n: int, far: float = 5.0, largest: float = 50.0) -> NDArray[np.bool_]:
    """Return which specimens have no gross error, (n,), by the best root of each.

    An outlier is ``far`` robust standard deviations from the median, or no inputs reproduce it.
    """
    order = np.lexsort((roots.misfit, roots.specimen))
    specimens, first = np.unique(roots.specimen[order], return_index=True)
    z, misfit = roots.z[order[first]], roots.misfit[order[first]]
    away = np.abs(z - np.median(z, axis=0))
    sd = 1.4826 * np.median(away, axis=0)
    is_outlier = (away > far * np.where(sd > 0, sd, np.inf)).any(axis=1) | (misfit > largest)
    typical = np.ones(n, dtype=bool)
    if 2 * is_outlier.sum() < len(specimens):
        typical[specimens[is_outlier]] = False
    return typical


def _at_likely_error(
    sampler: _PointSampler,
    components: _Components,
    roots: Roots,
    gap: float,
    seed: int,
) -> _Components:
    """Return components fitted at the largest plausible scale of an unknown error, at most one.

    Points around components of a larger error are too far apart. A scale is plausible if a fitted
    population has a likelihood of at most 4 nats below the best.
    """
    scales = (0.125, 0.18, 0.25, 0.35, 0.5, 0.7, 1.0)
    for _ in range(2):
        sample = sampler.draw(components, 64, (seed, 10))
        totals = []
        for scale in scales:
            at_scale = sampler.with_error(sample, scale)
            at_scale = at_scale.rows(np.flatnonzero(sampler.typical))
            normal = fit_normal(at_scale.z, at_scale.log_a)
            totals.append(float(_log_likelihoods(at_scale, [normal]).sum()))
        scale = max(s for s, total in zip(scales, totals, strict=True) if total > max(totals) - 4)
        narrow = sampler
        if scale >= 1:
            break
        misfit = roots.misfit / scale**2
        best = np.full(len(sampler.readings), np.inf)
        np.minimum.at(best, roots.specimen, misfit)
        rows = misfit - best[roots.specimen] <= gap
        subset = Roots(*(values[rows] for values in vars(roots).values()))
        near = replace(subset, jacobian=subset.jacobian / scale)
        narrow = replace(sampler, readings=sampler.readings.scaled(scale))
        components = _fit_components(narrow, near, seed)
    return _with_modes(narrow, components, seed)


def _with_modes(sampler: _PointSampler, components: _Components, seed: int) -> _Components:
    """Add components at the modes of specimens that the population pulls far from their roots.

    Such a specimen has a flat likelihood, whose maximum may lie far out. The mode is that of the
    readings' density times a normal population, by Levenberg-Marquardt. The population has the
    medians of the specimens' means and twice their median absolute deviations, in which a specimen
    without points near the population does not count.
    """
    sample = sampler.draw(components, 256, (seed, 11))
    mean, root = fit_normal(sample.z[sampler.typical], sample.log_a[sampler.typical])
    weights = normalised_weights(normal_log_density(sample.z, mean, root) + sample.log_a)
    means = np.einsum("nk,nkd->nd", weights, sample.z)
    mean = np.median(means, axis=0)
    deviation = 1.4826 * np.median(np.abs(means - mean), axis=0)
    deviation = np.where(deviation > 0, deviation, np.diag(root))
    precision = np.diag(1 / (2 * deviation) ** 2)
    emulation, readings = sampler.emulation, sampler.readings
    target = np.where(readings.is_measured, readings.values, 0.0)
    sd = readings.comparison_sd(emulation.error)

    def evaluate(z: Floats) -> tuple[Floats, Floats, Floats]:
        values, jacobian = emulation(z)
        residual, jacobian = (target - values) / sd, jacobian / sd[..., None]
        away = z - mean
        misfit = (residual**2).sum(axis=1) + np.einsum("nd,de,ne->n", away, precision, away)
        slope = np.einsum("nmd,nm->nd", jacobian, residual) - away @ precision
        curvature = np.einsum("nmd,nme->nde", jacobian, jacobian) + precision
        return np.where(np.isfinite(misfit), misfit, np.inf), slope, curvature

    z = np.tile(mean, (len(readings), 1))
    misfit, slope, curvature = evaluate(z)
    damping = np.full(len(z), 1e-3)
    for _ in range(60):
        scaled = (
            damping[:, None, None] * np.einsum("ndd->nd", curvature)[:, None] * np.eye(len(mean))
        )
        trial = z + np.linalg.solve(curvature + scaled, slope[..., None])[..., 0]
        trial_misfit, trial_slope, trial_curvature = evaluate(trial)
        better = trial_misfit < misfit
        z = np.where(better[:, None], trial, z)
        misfit = np.where(better, trial_misfit, misfit)
        slope = np.where(better[:, None], trial_slope, slope)
        curvature = np.where(better[:, None, None], trial_curvature, curvature)
        damping = np.where(better, damping / 3, damping * 4)
    away = np.linalg.solve(components.root, (z[components.specimen] - components.center)[..., None])
    nearest = np.full(len(z), np.inf)
    np.minimum.at(nearest, components.specimen, (away**2).sum(axis=(1, 2)))
    far = np.flatnonzero((nearest > chdtri(len(mean), 0.05)) & np.isfinite(misfit))
    order = np.argsort(np.concatenate([components.specimen, far]), kind="stable")
    added = np.linalg.cholesky(1.5 * np.linalg.inv(curvature[far]))
    return _Components(
        np.concatenate([components.specimen, far])[order],
        np.concatenate([components.center, z[far]])[order],
        np.concatenate([components.root, added])[order],
        np.concatenate([components.log_mass, np.full(len(far), np.nan)])[order],
    )


def _plausible(
    samples: dict[float, SpecimenPoints], fits: dict[float, list[Normal]], narrowing: float
) -> dict[float, list[Normal]]:
    """Return populations of narrowed fits at most 4 nats below the best fit, by scale."""
    totals = {k: _log_likelihoods(samples[k], fits[k]).sum(axis=1) for k in fits}
    best = max(total.max() for total in totals.values())
    plausible = {}
    for k, populations in fits.items():
        narrowed = [(mean, narrowing * root) for mean, root in populations]
        log_likelihoods = _log_likelihoods(samples[k], narrowed).sum(axis=1)
        plausible[k] = list(compress(narrowed, log_likelihoods > best - 4.0))
    return plausible


def _log_likelihoods(sample: SpecimenPoints, populations: Sequence[Normal]) -> Floats:
    """Return the log-likelihoods of the specimens in B normal populations, (B, N)."""
    block = max(1, IN_CACHE // sample.log_a.size)
    parts = []
    for first in range(0, len(populations), block):
        mean, root = map(np.stack, zip(*populations[first : first + block], strict=True))
        parts.append(log_sum_exp(normal_log_density(sample.z, mean, root) + sample.log_a))
    return np.concatenate(parts)


def _fit_components(
    sampler: _PointSampler, roots: Roots, seed: int, share: float = 0.1
) -> _Components:
    """Return a t component for each root, fitted to the readings' density around it.

    The first scale matrix is that of the Gauss-Newton approximation, within the box. Where the
    readings leave an input about as uncertain as the population does, the component is that of the
    specimen given a population twice as wide. A component or a reading that is uncertain by this
    share of the scatter has no mass: see `_normalised`.
    """
    box = sampler.emulation.box
    d = box.shape[1]
    precision = np.einsum("rmd,rme->rde", roots.jacobian, roots.jacobian)
    precision = precision + np.diag(4.0 / (box[1] - box[0]) ** 2)
    scale = np.linalg.cholesky(1.5 * np.linalg.inv(precision))
    components = _Components(roots.specimen, roots.z, scale, np.zeros(len(scale)))
    mean, covariance = np.zeros(d), 0.15 * np.eye(d)
    readings = sampler.readings
    solved = np.unique(roots.specimen)
    if solved.size:
        # Specimens without a root wait for the population of the others.
        subset = sampler.rows(solved)
        typical = subset.typical
        ranked = replace(components, specimen=np.searchsorted(solved, roots.specimen))
        ranked, sample = _moment_matched(subset, ranked, seed)
        mean, root = fit_normal(sample.z[typical], sample.log_a[typical])
        covariance = root @ root.T
        scatter = np.sqrt(np.diag(covariance))
        is_pulled = (_sd(ranked) > 0.2 * scatter).any()
        if is_pulled:
            ranked = _given_population(ranked, mean, 4 * covariance)
        is_wide = (_sd(ranked) > share * scatter).any(axis=1)
        sd = subset.readings.comparison_sd(sampler.emulation.error)
        spread = subset.readings.rows(np.flatnonzero(typical)).spread()
        is_noisy = (sd > share * spread) & subset.readings.is_measured
        is_uncertain = (is_noisy | subset.readings.is_censored).any(axis=1)
        has_mass = ~(is_wide | is_uncertain[ranked.specimen])
        if is_pulled and has_mass.any():
            sample = subset.draw(ranked, 256, (seed, 9))
        log_mass = np.where(has_mass, _component_weights(sample, ranked)[1], np.nan)
        components = _Components(solved[ranked.specimen], ranked.center, ranked.root, log_mass)
    unsolved = np.setdiff1d(np.arange(len(readings)), solved)
    if unsolved.size:
        components = _with_population(components, unsolved, mean, covariance, box, seed)
    return components


def _sd(components: _Components) -> Floats:
    """Return the standard deviations of components by input, (R, d)."""
    return np.asarray(np.sqrt(np.einsum("rde,rde->rd", components.root, components.root)))


def _given_population(components: _Components, mean: Floats, wide: Floats) -> _Components:
    """Return the components of the specimens given a wide normal population."""
    d = len(mean)
    precision = np.linalg.inv(wide)
    narrow = np.linalg.inv(components.root @ components.root.swapaxes(1, 2) / 1.5)
    combined = np.linalg.inv(narrow + precision)
    pull = np.einsum("rde,re->rd", narrow, components.center) + precision @ mean
    center = np.einsum("rde,re->rd", combined, pull)
    # Roots of another population, such as a mirror one, keep their components.
    centred = components.center - mean
    spread = np.linalg.inv(narrow) + wide
    square = np.einsum("rd,rd->r", centred, np.linalg.solve(spread, centred[..., None])[..., 0])
    is_near = (square < chdtri(d, 0.001))[:, None]
    combined_root = np.linalg.cholesky(1.5 * combined)
    return replace(
        components,
        center=np.where(is_near, center, components.center),
        root=np.where(is_near[..., None], combined_root, components.root),
    )


def _with_population(
    components: _Components,
    specimens: NDArray[np.intp],
    mean: Floats,
    covariance: Floats,
    box: Floats,
    seed: int,
) -> _Components:
    """Add components of specimens without a root: 8 of the population, and 16 over the box."""
    d = len(mean)
    width = box[1] - box[0]
    centers = np.concatenate([np.tile(mean, (8, 1)), box[0] + width * sobol(16, d, seed)])
    roots_of_population = np.tile(2.5 * np.linalg.cholesky(covariance), (8, 1, 1))
    roots_of_box = np.tile(np.diag(width / 16 ** (1 / d)), (16, 1, 1))
    n = len(specimens)
    root = np.tile(np.concatenate([roots_of_population, roots_of_box]), (n, 1, 1))
    specimen = np.concatenate([components.specimen, np.repeat(specimens, len(centers))])
    order = np.argsort(specimen, kind="stable")
    return _Components(
        specimen[order],
        np.concatenate([components.center, np.tile(centers, (n, 1))])[order],
        np.concatenate([components.root, root])[order],
        np.concatenate([components.log_mass, np.full(len(root), np.nan)])[order],
    )


def _moment_matched(
    sampler: _PointSampler, components: _Components, seed: int
) -> tuple[_Components, SpecimenPoints]:
    """Return components with the weighted moments of uneven points, and points of all components.

    Only specimens with a changed component get other points.
    """
    d = components.center.shape[1]
    sample = sampler.draw(components, 256, (seed, 3))
    for attempt in range(2):
        weights, log_mass = _component_weights(sample, components)
        size = 1 / np.maximum((weights**2).sum(axis=1), 1e-300)
        uneven = np.flatnonzero((size < 256 / 2) & np.isfinite(log_mass))
        if not uneven.size:
            break
        z = components.by_component(sample.z)[uneven]
        w = weights[uneven]
        center = np.einsum("rk,rkd->rd", w, z)
        centred = z - center[:, None]
        covariance = np.einsum("rk,rkd,rke->rde", w, centred, centred)
        previous = components.root[uneven] @ components.root[uneven].swapaxes(1, 2)
        # A few effective points leave most of the scale as it was.
        trust = (size[uneven] / (size[uneven] + 4 * d))[:, None, None]
        covariance = trust * 1.5 * covariance + (1 - trust) * previous
        new_center, new_root = components.center.copy(), components.root.copy()
        new_center[uneven] = center
        new_root[uneven] = np.linalg.cholesky(covariance + 1e-14 * previous)
        components = replace(components, center=new_center, root=new_root)
        changed = np.unique(components.specimen[uneven])
        subset = sampler.rows(changed)
        rows = np.isin(components.specimen, changed)
        ranks = np.searchsorted(changed, components.specimen[rows])
        of_changed = _Components(
            ranks, components.center[rows], components.root[rows], components.log_mass[rows]
        )
        fresh = subset.draw(of_changed, 256, (seed, 4 + attempt))
        for name in ("z", "outputs", "log_a", "log_proposal"):
            values = getattr(fresh, name)
            getattr(sample, name)[changed, : values.shape[1]] = values
    return components, sample


@dataclass(frozen=True, eq=False)
class _PointSampler:
    """Points of the readings, weighted by the mixture over the components of a specimen."""

    emulation: Emulation
    readings: Readings
    degrees: float  # of the t distributions
    typical: NDArray[np.bool_]  # (N,): specimens that populations are fitted to

    def rows(self, index: NDArray[np.intp]) -> _PointSampler:
        """Return the sampler of selected specimens."""
        return replace(self, readings=self.readings.rows(index), typical=self.typical[index])

    def draw(self, components: _Components, count: int, seed: tuple[int, int]) -> SpecimenPoints:
        """Draw points from each component."""
        table = components.table
        n, slots = table.shape
        d = components.center.shape[1]
        u = sobol(count, d + 1, seed[0] * 1009 + seed[1])
        u = u + np.random.default_rng(seed).random((len(components.specimen), 1, d + 1))
        u -= u >= 1.0
        np.clip(u, 1e-9, 1 - 1e-9, out=u)
        nu = self.degrees
        normal = ndtri(u[..., :d])
        normal *= _t_radius(u[..., d], nu)[..., None]
        z = components.center[:, None] + normal @ components.root.swapaxes(1, 2)
        flat = z.reshape(-1, d)
        starts = range(0, len(flat), IN_CACHE)
        blocks = [self.emulation.values(flat[k : k + IN_CACHE]) for k in starts]
        values = np.concatenate(blocks)
        # By specimen.
        filled = np.maximum(table, 0)
        z_all = z[filled].reshape(n, slots * count, d)
        by_root = values.reshape(len(z), count, -1)
        outputs = by_root[filled].reshape(n, slots * count, -1)
        log_q = np.full((n, slots, slots * count), -np.inf)
        for s in range(slots):
            c = filled[:, s]
            centred = z_all - components.center[c][:, None]
            inverse = np.linalg.inv(components.root[c])
            standard = centred @ inverse.swapaxes(1, 2)
            square = np.einsum("nkd,nkd->nk", standard, standard)
            log_det = np.log(np.einsum("ndd->nd", components.root[c])).sum(axis=1)
            constant = gammaln((nu + d) / 2) - gammaln(nu / 2) - d / 2 * np.log(nu * np.pi)
            tail = (nu + d) / 2 * np.log1p(square / nu)
            density = constant - log_det[:, None] - tail
            log_q[:, s] = np.where(table[:, s, None] >= 0, density, -np.inf)
        log_proposal = log_sum_exp(log_q.swapaxes(1, 2)) + np.log(count)
        exists = np.repeat(table >= 0, count, axis=1)
        log_proposal = np.where(exists, log_proposal, np.inf)
        log_a = self.readings.log_density(outputs, self.emulation.error) - log_proposal
        return SpecimenPoints(z_all, outputs, log_a, log_proposal, (table >= 0).sum(axis=1))

    def with_error(self, points: SpecimenPoints, factor: float) -> SpecimenPoints:
        """Return points with the weights of a reading error that is larger by a factor."""
        readings, error = self.readings.scaled(factor), self.emulation.error
        log_density = readings.log_density(points.outputs, error)
        return replace(points, log_a=log_density - points.log_proposal)


def _t_radius(u: Floats, degrees: float) -> Floats:
    """Return the factors that turn normal vectors into vectors of a t distribution.

    A spline in the logit of u, to nine digits, takes a tenth of the time of the quantiles.
    """
    from scipy.interpolate import CubicSpline  # takes long to import

    knots = np.linspace(-21.0, 21.0, 513)
    spline: Any = CubicSpline(knots, 0.5 * np.log(degrees / chdtri(degrees, expit(knots))))
    cubic, *lower_orders = spline.c
    offset = np.log(u / (1.0 - u)) - knots[0]
    piece = (offset / (knots[1] - knots[0])).astype(np.intp)
    offset -= (knots - knots[0])[piece]
    log_radius = cubic[piece]
    for coefficient in lower_orders:
        log_radius *= offset
        log_radius += coefficient[piece]
    return np.asarray(np.exp(log_radius, out=log_radius))


def _component_weights(sample: SpecimenPoints, components: _Components) -> tuple[Floats, Floats]:
    """Return normalised weights, (R, k), and log masses, (R,), by component."""
    log_a = components.by_component(sample.log_a)
    log_mass = log_sum_exp(log_a)
    safe = np.where(np.isfinite(log_mass), log_mass, 0.0)
    return np.exp(log_a - safe[:, None]), log_mass


def _normalised(sample: SpecimenPoints, components: _Components) -> SpecimenPoints:
    """Scale the weights of the points around each root to the root's mass, if there is one.

    Few points have too small a variance, in both halves: a negligible bias of certain readings.
    """
    table = components.table
    n, slots = table.shape
    log_a = sample.log_a.reshape(n, slots, -1)
    total = log_sum_exp(log_a)
    by_slot = components.log_mass[np.maximum(table, 0)]
    mass = np.where(table >= 0, by_slot, -np.inf)
    is_scaled = np.isfinite(total) & np.isfinite(mass)
    shift = np.where(is_scaled, mass - np.where(is_scaled, total, 0.0), 0.0)
    scaled = (log_a + shift[..., None]).reshape(n, -1)
    return replace(sample, log_a=scaled)
