r"""Importance points of measured specimens by randomize-then-optimize.

The density of the readings of a specimen is an integral over its inputs,

.. math:: p(y \mid \theta) = \int p(x \mid \theta) \, p(y \mid f(x)) \, dx
          \approx \sum_k p(x_k \mid \theta) \exp(A_k), \qquad (1)

with points and numbers A that do not contain theta. Inputs x = mean + L a are whitened by a normal
reference population, and e(a) = (y - f(x)) / s are standardised errors of readings. The residual
r(a) = (a, e(a)) has the Jacobian (I, -G). At a mode of exp(-|r|^2 / 2), G = U S V', and

.. math:: \xi(a) = D (V' a - S U' e(a)), \qquad D = (1 + S^2)^{-1/2}, \qquad (2)

is standard normal given the readings if f is linear [1]_. Points solve xi(a) = xi_k for quantiles
xi_k of a lattice; their density is

.. math:: q(a) = g(\xi(a)) \, |\det D (V' + S U' G(a))|, \qquad (3)

where g is normal along directions that exact readings determine, and Student's t along others.

Directions that the readings determine are solved for, and the others have the reference population:
accurate and inaccurate readings, more or fewer than inputs, are one case. A mode has a proposal; a
point counts with the density of all proposals of its specimen that reach it [2]_.

References
----------
.. [1] Bardsley, J. M., Solonen, A., Haario, H. and Laine, M. (2014), Randomize-then-optimize,
   SIAM J. Sci. Comput. 36, doi:10.1137/140964023.
.. [2] Veach, E. and Guibas, L. J. (1995), Optimally combining sampling techniques for Monte Carlo
   rendering, doi:10.1145/218380.218498.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln, ndtri, stdtrit

from prbayes._stats import log_sum_exp, positive_scale
from prbayes._validate import IN_CACHE, Bools, Floats, Indices
from prbayes.numerics.points import lattice, sobol
from prbayes.numerics.threads import one_thread

DEGREES = 5.0  # of Student's t distributions of the proposals


@dataclass(frozen=True, eq=False)
class Normal:
    """Normal population, in which inputs are whitened: z = mean + root a."""

    mean: Floats  # (d,): mean of the coordinates
    root: Floats  # (d, d): lower Cholesky factor of the covariance


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals of specimens: whitened inputs, and standardised errors of the readings."""

    # Coordinates (k, d) -> values (k, m) and Jacobian (k, m, d), NaN without a response.
    response: Any
    target: Floats  # (N, m): readings, any number where there is none
    emulator_error: Floats  # (N, m): standard deviation of the emulator's error
    error: Floats  # (N, m): standard deviation of the reading; infinite where there is none
    relative: Floats  # (N, m): further error of the reading as a share of the output
    population: Normal  # reference population of the coordinates z
    known: Floats  # (N, d): coordinates that are known for a specimen; NaN of the others
    # (2, d): range in which inputs are possible; an emulator is arbitrary far beyond its runs.
    box: Floats | None = None
    # (free,): columns of unknown coordinates, the narrowest possible populations first
    order: Indices | None = None
    # (N, m): columns of the outputs that were measured of a specimen; None if all were.
    columns: Indices | None = None
    allows_linear: bool = False  # whether maps that are nearly linear are replaced by linear ones
    # (J, m): factors of the readings' errors, from larger to smaller ones; (J, 1) if the same of
    # all outputs
    scales: Floats = field(default_factory=lambda: np.ones((1, 1)))

    @property
    def free(self) -> Indices:
        """Columns of the coordinates that are not known."""
        return np.flatnonzero(np.isnan(self.known[0]))

    @property
    def has_errors(self) -> bool:
        """Whether readings have errors of their own."""
        return bool(self.relative.any() or (np.isfinite(self.error) & (self.error > 0)).any())

    def coordinates(self, specimen: Indices, a: Floats) -> Floats:
        """Return coordinates z, (k, d), of whitened inputs, (k, free)."""
        z = self.known[specimen]
        z[:, self.free] = self.population.mean + a @ self.population.root.T
        return z

    def is_possible(self, specimen: Indices, a: Floats) -> Bools:
        """Return whether whitened inputs, (k, free), are in the range of possible ones."""
        if self.box is None:
            return np.ones(len(a), dtype=bool)
        z = self.coordinates(specimen, a)
        return np.asarray(((z >= self.box[0]) & (z <= self.box[1])).all(axis=1))

    def whitened(self, z: Floats) -> Floats:
        """Return whitened inputs, (..., free), of coordinates (..., d)."""
        centred = z[..., self.free] - self.population.mean
        return centred @ np.linalg.inv(self.population.root).T

    def errors(
        self, specimen: Indices, a: Floats, scale: int | Indices = 0
    ) -> tuple[Floats, Floats]:
        """Return standardised errors e, (k, m), and G = -de/da, (k, m, free).

        ``scale`` is a row of ``scales``, a number or (k,). NaN without a response.
        """
        scales = np.broadcast_to(scale, len(a))
        m = self.target.shape[1]
        e = np.empty((len(a), m))
        slopes = np.empty((*e.shape, a.shape[1]))
        for block in _blocks(len(a), m * self.known.shape[1]):
            i = specimen[block]
            e[block], slopes[block] = self.standardised(
                i, *self.simulated(i, a[block]), scales[block]
            )
        return e, slopes

    @np.errstate(all="ignore")
    def simulated(self, specimen: Indices, a: Floats) -> tuple[Floats, Floats]:
        """Return outputs, (k, m), and their Jacobian by a, (k, m, free); NaN without a response."""
        z = self.coordinates(specimen, a)
        columns = None if self.columns is None else self.columns[specimen]
        values, jacobian = self.response(z) if columns is None else self.response(z, columns)
        # A difference between inputs with and without a response is no slope.
        values[~np.isfinite(jacobian).all(axis=(1, 2))] = np.nan
        if self.box is not None:
            values[((z < self.box[0]) | (z > self.box[1])).any(axis=1)] = np.nan
        return values, jacobian[:, :, self.free] @ self.population.root

    @np.errstate(all="ignore")
    def standardised(
        self, specimen: Indices, values: Floats, jacobian: Floats, scale: Indices
    ) -> tuple[Floats, Floats]:
        """Return e, (k, m), and G, (k, m, free), of outputs and their Jacobian."""
        factor = np.square(self.scales)[scale]
        if self.columns is not None and factor.shape[1] > 1:
            factor = np.take_along_axis(factor, self.columns[specimen], axis=1)
        relative = factor * self.relative[specimen] ** 2
        error = self.error[specimen]
        variance = self.emulator_error[specimen] ** 2 + factor * error**2 + relative * values**2
        residual, sd = self.target[specimen] - values, np.sqrt(variance)
        # The standard deviation of a relative error depends on the output, and so does its slope.
        by_output = (1 + residual * relative * values / variance) / sd
        is_read = np.isfinite(error)
        e = np.where(is_read, residual / sd, 0.0)
        return e, np.where(is_read[:, :, None], by_output[:, :, None] * jacobian, 0.0)


def _blocks(count: int, width: int) -> Iterator[slice]:
    """Return slices of so many rows that their arrays stay in the cache."""
    size = max(256, IN_CACHE // max(1, width))
    for start in range(0, count, size):
        yield slice(start, start + size)


@dataclass(frozen=True, eq=False)
class Modes:
    """Modes of the readings' density times a wide normal population, one row each."""

    specimen: Indices  # (R,): row of the specimen; sorted
    a: Floats  # (R, free): whitened inputs
    misfit: Floats  # (R,): half the squared standardised errors, in nats
    errors: Floats  # (R, m): standardised errors e of the readings
    slopes: Floats  # (R, m, free): G = -de/da
    scale: Indices  # (R,): row of the factors of the readings' errors

    @classmethod
    def joined(cls, parts: Sequence[Modes]) -> Modes:
        """Return modes as one record, sorted by specimen."""
        arrays = [np.concatenate(values) for values in zip(*(p.arrays for p in parts), strict=True)]
        return cls(*arrays).rows(np.argsort(arrays[0], kind="stable"))

    def rows(self, index: Indices) -> Modes:
        """Return selected modes."""
        return Modes(*(values[index] for values in self.arrays))

    def best_misfit(self) -> Floats:
        """Return the least misfit of each specimen that has a mode, (N,)."""
        return self.misfit[best_rows(self.specimen, self.misfit)]

    @property
    def arrays(self) -> list[NDArray[Any]]:
        """The arrays of all fields."""
        return [getattr(self, f.name) for f in fields(self)]

    def is_stationary(self, precision: float = 0.1) -> Bools:
        """Return which rows, (R,), are modes; others cover the inside of a fold between them."""
        of_readings = np.einsum("kmd,km->kd", self.slopes, self.errors)
        gradient = precision * self.a - of_readings
        steepness = 1 + (self.slopes**2).sum(axis=(1, 2))
        squares = (gradient**2).sum(axis=1)
        return np.asarray(squares < 0.01 * steepness)

    @cached_property
    def table(self) -> Indices:
        """The modes of each specimen, (N, most), filled up with -1."""
        return rows_by_specimen(self.specimen)


def find_modes(
    residuals: Residuals,
    starts: Floats,
    *,
    scale: int = 0,
    precision: float = 0.1,
    gap: float = 20.0,
) -> Modes:
    """Find the modes of each specimen by Levenberg-Marquardt [1]_ from starts, (N, S, free).

    The population is wide: it has this precision, relative to the reference. A mode within ``gap``
    nats of the specimen's best is kept. ``scale`` is a row of the factors of the readings' errors.

    References
    ----------
    .. [1] Moré, J. J. (1978), The Levenberg-Marquardt algorithm, doi:10.1007/BFb0067700.
    """
    n, count, d = starts.shape
    specimen = np.repeat(np.arange(n), count)
    # Accurate readings make a narrow curved valley, in which the method takes tiny steps. The first
    # search therefore has a larger reading error, and the second one starts at its result.
    change = 0.03 * _typical_change(residuals, starts)
    if residuals.columns is not None:
        change = change[residuals.columns]
    larger = np.maximum(residuals.emulator_error, change)
    soft = replace(residuals, emulator_error=larger)
    a, *_ = _minimised(soft, specimen, starts.reshape(-1, d), precision, 40, scale)
    a, value, e, slopes = _minimised(residuals, specimen, a, precision, 20, scale)
    misfit = (e**2).sum(axis=1) / 2
    # Modes far from the reference population are kept, because another population may be likely.
    finite = np.where(np.isfinite(value), misfit, np.inf)
    least = _lowest(specimen, finite, n)
    value = np.where(misfit <= least[specimen] + gap, value, np.inf)
    rows = _distinct(specimen, a, value, slopes, precision)
    keys = (*a[rows].T[::-1], specimen[rows])
    rows = rows[np.lexsort(keys)]
    misfit = misfit[rows]
    scales = np.full(len(rows), scale)
    return Modes(specimen[rows], a[rows], misfit, e[rows], slopes[rows], scales)


def _typical_change(residuals: Residuals, starts: Floats) -> Floats:
    """Return the standard deviation of each output in the reference population, (m,)."""
    a = ndtri(sobol(64, starts.shape[2], 0))
    values, _ = residuals.response(residuals.coordinates(np.resize(np.arange(len(starts)), 64), a))
    values = values[np.isfinite(values).all(axis=1)]
    low, high = np.quantile(values, [0.16, 0.84], axis=0) if len(values) > 1 else (0.0, 0.0)
    return np.asarray(high - low) / 2 * np.ones(values.shape[1])


def _minimised(
    residuals: Residuals,
    specimen: Indices,
    a: Floats,
    precision: float,
    iterations: int,
    scale: int,
) -> tuple[Floats, Floats, Floats, Floats]:
    """Return local minima of half the squared residuals, their values, errors and slopes."""
    a, d = a.copy(), a.shape[1]
    e, slopes = residuals.errors(specimen, a, scale)

    def objective(a: Floats, e: Floats) -> Floats:
        misfit = (e**2).sum(axis=1)
        value = (misfit + precision * (a**2).sum(axis=1)) / 2
        return np.where(np.isnan(value), np.inf, value)

    value = objective(a, e)
    damping = np.full(len(a), 1e-3)
    active = np.flatnonzero(np.isfinite(value))
    for _ in range(iterations):
        if not active.size:
            break
        g = slopes[active]
        hessian = np.einsum("kmd,kme->kde", g, g) + precision * np.eye(d)
        gradient = precision * a[active] - np.einsum("kmd,km->kd", g, e[active])
        diagonal = np.einsum("kdd->kd", hessian)
        added = damping[active, None] * diagonal
        damped = hessian + added[:, :, None] * np.eye(d)
        step = -np.linalg.solve(damped, gradient[..., None])[..., 0]
        length = np.sqrt((step**2).sum(axis=1))
        # Steps are longer far from the population, because an outlier may be there.
        from_center = np.sqrt((a[active] ** 2).sum(axis=1))
        longest = np.maximum(1.0, from_center / 2)
        step /= np.maximum(length / longest, 1.0)[:, None]
        trial = a[active] + step
        new_e, new_slopes = residuals.errors(specimen[active], trial, scale)
        new_value = objective(trial, new_e)
        better = new_value < value[active]
        gain = np.where(better, value[active] - new_value, np.inf)
        rows = active[better]
        a[rows], e[rows], slopes[rows] = trial[better], new_e[better], new_slopes[better]
        value[rows] = new_value[better]
        changed = damping[active] * np.where(better, 0.1, 8.0)
        damping[active] = np.clip(changed, 1e-12, 1e12)
        # The search ends at a gain below 1e-6 nats, or at a rejected step as short as rounding.
        unfinished = (gain > 1e-6) & (length > 1e-11) & (damping[active] < 1e11)
        active = active[unfinished]
    return a, value, e, slopes


def _distinct(
    specimen: Indices, a: Floats, value: Floats, slopes: Floats, precision: float
) -> Indices:
    """Return the rows of different modes with a finite value, the best one of equal modes."""
    candidates = np.flatnonzero(np.isfinite(value))
    candidates = candidates[np.lexsort((value[candidates], specimen[candidates]))]
    if not len(candidates):
        return candidates
    slots = rows_by_specimen(specimen[candidates])
    table = np.where(slots >= 0, candidates[slots], -1)
    is_mode = table >= 0
    for k in range(1, table.shape[1]):
        # The k-th candidate of each specimen is compared with its better candidates.
        better = table[:, :k]
        difference = a[table[:, k], None] - a[better]
        along = np.einsum("nkmd,nkd->nkm", slopes[better], difference)
        square = (along**2).sum(axis=2) + precision * (difference**2).sum(axis=2)
        is_near = np.abs(difference).max(axis=2) < 1e-5
        is_same = is_near | (square < 1e-4)
        is_mode[:, k] &= ~(is_same & is_mode[:, :k]).any(axis=1)
    return table[is_mode]


def rows_by_specimen(specimen: Indices) -> Indices:
    """Return the rows of each specimen, (N, most), filled up with -1; specimens are ascending."""
    count = np.bincount(specimen)
    table = np.full((len(count), count.max()), -1)
    table[specimen, _place_among_equals(specimen)] = np.arange(len(specimen))
    return table


def _place_among_equals(values: Indices) -> Indices:
    """Return the place of each element among those equal to it; values are ascending."""
    return np.arange(len(values)) - np.searchsorted(values, values)


def best_rows(specimen: Indices, cost: Floats) -> Indices:
    """Return the row with the lowest cost of each specimen that has rows, by specimen."""
    order = np.lexsort((cost, specimen))
    return order[np.unique(specimen[order], return_index=True)[1]]


def _lowest(specimen: Indices, values: Floats, n: int) -> Floats:
    """Return the lowest value of each of n specimens; infinite for one without a value."""
    lowest = np.full(n, np.inf)
    np.minimum.at(lowest, specimen, values)
    return lowest


@dataclass(frozen=True, eq=False)
class LinearMaps:
    """Linear approximations of maps at their modes, which need no output for a point."""

    is_used: Bools  # (R,): whether the map of a mode is replaced
    values: Floats  # (R, free): xi at the mode
    jacobian: Floats  # (R, free, free)

    def __call__(self, mode: Indices, away: Floats) -> tuple[Floats, Floats]:
        """Return xi, (k, free), and its Jacobian at distances from the modes, (k, free)."""
        jacobian = self.jacobian[mode]
        xi = self.values[mode] + np.einsum("kij,kj->ki", jacobian, away)
        return xi, jacobian


@dataclass(frozen=True, eq=False)
class Proposals:
    """Proposals of specimens, one for each mode: maps xi of equation (2) and their inverses."""

    # A direction is open if the readings' precision along it is less than this many times that of
    # the population.
    least_precision: ClassVar[float] = 4.0

    residuals: Residuals
    modes: Modes
    inputs: Floats  # (R, free, free): D V'
    readings: Floats  # (R, free, m): D S U'
    orientation: Floats  # (R,): sign of the map's determinant at the mode
    log_det: Floats  # (R,): log of the determinant's absolute value
    # (R, free): directions of Student's t, along which populations differ or errors are not normal
    heavy_axes: Bools
    share: Floats  # (R,): mixing weight among the modes of the specimen
    # (R, free): xi at the centers; zero but at modes far from the reference population, which would
    # move the points of accurate readings towards it
    center: Floats
    linear: LinearMaps | None = None  # maps that replace some of the others

    @classmethod
    @one_thread()
    def at_modes(cls, residuals: Residuals, modes: Modes) -> Proposals:
        """Return the proposals at modes."""
        count, m, d = modes.slopes.shape
        u, s, vt = np.linalg.svd(modes.slopes, full_matrices=True)
        scale = np.zeros((count, d))
        rank = min(m, d)
        scale[:, :rank] = s
        inverse = 1 / np.sqrt(1 + scale**2)
        readings = np.zeros((count, d, m))
        of_left = u[:, :, :rank].swapaxes(1, 2)
        readings[:, :rank] = (scale * inverse)[:, :rank, None] * of_left
        orientation = np.sign(np.linalg.det(vt))
        share = 1 / np.bincount(modes.specimen)[modes.specimen]
        log_det = -np.log(inverse).sum(axis=1)
        inputs = inverse[:, :, None] * vt
        is_open = scale**2 < cls.least_precision
        # Open directions are rotated so that the first input of the order changes along the first
        # direction alone, the second input along two, and so on. Points of narrow populations are
        # then equidistant.
        order = np.arange(d) if residuals.order is None else residuals.order
        rotation, _ = np.linalg.qr((is_open[:, :, None] * inputs)[:, :, order])
        orientation = orientation * np.sign(np.linalg.det(rotation))
        back = rotation.swapaxes(1, 2)
        heavy = (np.arange(d) < is_open.sum(axis=1, keepdims=True)) | residuals.has_errors
        inputs, readings = back @ inputs, back @ readings
        center = np.einsum("rij,rj->ri", inputs, modes.a)
        center -= np.einsum("rim,rm->ri", readings, modes.errors)
        is_closed = np.arange(d) >= is_open.sum(axis=1, keepdims=True)
        # Inputs that do not reproduce the readings have nothing that points could lie around.
        is_met = (modes.misfit < 10.0 + m)[:, None]
        center = np.where(is_closed & is_met & (np.abs(center) > 1), center, 0.0)
        proposals = cls(
            residuals, modes, inputs, readings, orientation, log_det, heavy, share, center
        )
        return with_linear_maps(proposals) if residuals.allows_linear else proposals

    def is_open(self, scale: int | None = None) -> bool:
        """Return whether readings leave inputs of a tenth of the specimens open.

        Along an open direction their precision is less than four times the population's. With a
        larger one the reference population has little influence. ``scale`` is a row of the factors
        of errors, by default that nearest to one.
        """
        _, m, d = self.modes.slopes.shape
        if m < d:
            return True
        if scale is None:
            distance = np.abs(self.residuals.scales - 1)
            scale = int(distance.max(axis=1).argmin())
        rows = self.modes.scale == scale
        least = np.linalg.svd(self.modes.slopes[rows], compute_uv=False)[:, -1] ** 2
        return bool(np.quantile(least, 0.1) < self.least_precision)

    def log_density(self, mode: Indices, xi: Floats) -> Floats:
        """Return the log-density of proposals at xi, (k, free) -> (k,), less that of the maps.

        Normal; Student's t along directions where populations may be far from the reference [1]_,
        or where a curved response makes the tails of the readings' errors long.

        References
        ----------
        .. [1] Hesterberg, T. (1995), Weighted average importance sampling and defensive mixture
           distributions, Technometrics 37, doi:10.1080/00401706.1995.10484303.
        """
        half = DEGREES / 2
        constant = gammaln(half + 0.5) - gammaln(half) - np.log(half) / 2
        student = constant - (half + 0.5) * np.log1p(xi**2 / DEGREES)
        return np.where(self.heavy_axes[mode], student, -(xi**2) / 2).sum(axis=1)

    def mapped(self, mode: Indices, a: Floats) -> tuple[Floats, Floats]:
        """Return xi, (k, free), and its Jacobian, (k, free, free), in the maps of modes (k,)."""
        modes, residuals = self.modes, self.residuals
        if self.linear is None:
            errors = residuals.errors(modes.specimen[mode], a, modes.scale[mode])
            return self.mapped_errors(mode, a, *errors)
        e = np.zeros((len(a), residuals.target.shape[1]))
        slopes = np.zeros((*e.shape, a.shape[1]))
        rows = np.flatnonzero(~self.linear.is_used[mode])
        at = mode[rows]
        e[rows], slopes[rows] = residuals.errors(modes.specimen[at], a[rows], modes.scale[at])
        return self.mapped_errors(mode, a, e, slopes)

    def mapped_errors(
        self, mode: Indices, a: Floats, e: Floats, slopes: Floats
    ) -> tuple[Floats, Floats]:
        """Return xi and its Jacobian at points with standardised errors e and slopes G."""
        inputs, readings = self.inputs[mode], self.readings[mode]
        xi = np.einsum("kij,kj->ki", inputs, a) - np.einsum("kim,km->ki", readings, e)
        xi -= self.center[mode]
        jacobian = inputs + readings @ slopes
        if self.linear is not None:
            rows = np.flatnonzero(self.linear.is_used[mode])
            at = mode[rows]
            xi[rows], jacobian[rows] = self.linear(at, a[rows] - self.modes.a[at])
            specimen = self.modes.specimen[at]
            is_possible = self.residuals.is_possible(specimen, a[rows])
            xi[rows[~is_possible]] = np.nan
        return xi, jacobian

    @np.errstate(all="ignore")
    def solved(self, mode: Indices, xi: Floats) -> tuple[Floats, Floats, Floats, Bools]:
        """Return inputs a with xi(a) = xi by a damped Newton method from the mode.

        Also xi at these inputs, the log of the determinant of its Jacobian, and whether the method
        converged: xi need not be that of the lattice, as the density is that at the inputs found.
        The determinant keeps its sign on the way: beyond a fold another proposal finds the points.
        """
        a = self.modes.a[mode].copy()
        value, jacobian = self.mapped(mode, a)
        fraction = np.ones(len(a))
        converged = np.zeros(len(a), dtype=bool)
        last = np.full(len(a), np.inf)
        active = np.arange(len(a))
        for _ in range(25):
            residual = xi[active] - value[active]
            step = _solutions(jacobian[active], residual)
            length = np.sqrt((step**2).sum(axis=1))
            usable = np.isfinite(length) & (fraction[active] > 0.1)
            active = active[usable]
            step = step[usable]
            length = length[usable]
            if not active.size:
                break
            from_origin = np.sqrt((a[active] ** 2).sum(axis=1))
            longest = np.maximum(2.0, from_origin)
            factor = fraction[active] / np.maximum(length / longest, 1.0)
            step *= factor[:, None]
            trial = a[active] + step
            new_value, new_jacobian = self.mapped(mode[active], trial)
            sign, _ = np.linalg.slogdet(new_jacobian)
            accepted = sign == self.orientation[mode[active]]
            is_whole = accepted & (fraction[active] == 1.0)
            to = active[accepted]
            a[to] = trial[accepted]
            value[to] = new_value[accepted]
            jacobian[to] = new_jacobian[accepted]
            fraction[active] = np.where(accepted, 1.0, fraction[active] / 2)
            distance = np.abs(xi[active] - value[active]).max(axis=1)
            # Rounding of the emulator may end the decrease. At a fold, where the determinant
            # vanishes, and beside inputs without a response, a small distance may be one to values
            # that no inputs have.
            _, log_size = np.linalg.slogdet(jacobian[active])
            is_regular = log_size > self.log_det[mode[active]] - 1.0
            is_last = is_whole & is_regular & (distance < 0.01) & (distance > last[active] / 2)
            converged[active] = (distance < 1e-4) | is_last
            last[active] = distance
            active = active[~converged[active]]
        finite = np.where(np.isfinite(jacobian), jacobian, 0.0)
        _, log_det = np.linalg.slogdet(finite)
        return a, value, log_det, converged

    @one_thread()
    def draw(self, count: int, seed: int) -> tuple[Floats, Floats, Indices]:
        """Draw ``count`` points of each specimen.

        Return coordinates (N, K, d), logs of K times their density, (N, K), and the mode that drew
        each, (N, K). The log is infinite where there is no point.
        """
        modes, residuals = self.modes, self.residuals
        n = len(residuals.known)
        d = modes.a.shape[1]
        counts = _point_counts(self.share, modes.table, count)
        mode = np.repeat(np.arange(len(counts)), counts)
        place = _place_among_equals(mode)
        rng = np.random.default_rng([seed, 1])
        shifts = rng.random((len(counts), d))
        points = lattice(place, counts[mode], d)
        u = (points + shifts[mode]) % 1.0
        u = np.clip(u, 1e-12, 1 - 1e-12)
        xi = np.where(self.heavy_axes[mode], stdtrit(DEGREES, u), ndtri(u))
        a, value, log_det, converged = self.solved(mode, xi)
        rows = np.flatnonzero(converged)
        log_q = np.full(len(a), np.inf)
        log_density = self.log_density(mode[rows], value[rows])
        drawn = mode[rows], log_det[rows] + log_density
        weights = counts.astype(np.float64)
        owners = modes.specimen[mode[rows]]
        log_unit = np.log(np.diag(residuals.population.root)).sum()
        log_q[rows] = self.log_mixture(owners, a[rows], weights, drawn)
        log_q[rows] -= d / 2 * np.log(2 * np.pi)
        log_q[rows] -= log_unit
        a[~converged] = 0.0
        specimen = modes.specimen[mode]
        # A specimen that no inputs reproduce has its best mode, as if the map were linear there.
        best = best_rows(modes.specimen, modes.misfit)
        lost = best[~np.isin(modes.specimen[best], specimen[rows])]
        first = np.searchsorted(specimen, modes.specimen[lost])
        a[first] = modes.a[lost]
        log_q[first] = self.log_det[lost] - log_unit
        z = np.zeros((n, count, residuals.known.shape[1]))
        by_specimen = np.full((n, count), np.inf)
        owner = np.zeros((n, count), dtype=np.intp)
        slot = _place_among_equals(specimen)
        z[specimen, slot] = residuals.coordinates(specimen, a)
        by_specimen[specimen, slot], owner[specimen, slot] = log_q, mode
        return z, by_specimen, owner

    def log_mixture(
        self,
        specimen: Indices,
        a: Floats,
        weights: Floats,
        drawn: tuple[Indices, Floats] | None = None,
    ) -> Floats:
        """Return logs of weighted sums of the densities of all modes that reach points, (k,).

        ``weights`` are of the modes, (R,). ``drawn`` has the mode that drew each point and the log
        of its density there, up to a constant, both (k,).
        """
        width = self.residuals.target.shape[1] * self.modes.a.shape[1]
        parts = []
        for block in _blocks(len(a), width):
            of_block = None if drawn is None else (drawn[0][block], drawn[1][block])
            parts.append(_log_mixture(self, specimen[block], a[block], weights, of_block))
        return np.concatenate(parts) if parts else np.empty(0)

    @cached_property
    def is_same_mode(self) -> Bools:
        """Whether a mode is that in a slot of its specimen for another error, (R, most).

        Each is the nearest to the other among the modes for its error, in the map of the one for
        the larger error. Points that one of them reaches are reached by the other.
        """
        modes, table = self.modes, self.modes.table
        scale = np.where(table >= 0, modes.scale[table], -1)
        # The Jacobian at a mode: D V' + D S U' G.
        maps = self.inputs + self.readings @ modes.slopes
        is_wide = scale[:, :, None] <= scale[:, None]
        a = modes.a[table]
        difference = a[:, None] - a[:, :, None]  # (N, most, most, free)
        of_first = np.einsum("npij,npqj->npqi", maps[table], difference)
        of_second = np.einsum("nqij,npqj->npqi", maps[table], difference)
        of_wider = np.where(is_wide[..., None], of_first, of_second)
        distance = (of_wider**2).sum(axis=3)
        is_missing = table < 0
        distance[is_missing[:, None] | is_missing[:, :, None]] = np.inf
        is_nearest = np.zeros(distance.shape, dtype=bool)
        for value in np.unique(modes.scale):
            of_scale = np.where((scale == value)[:, None], distance, np.inf)
            least = of_scale.min(axis=2, keepdims=True)
            is_nearest |= np.isfinite(least) & (of_scale == least)
        is_same = is_nearest & is_nearest.swapaxes(1, 2)
        n, slot = np.nonzero(table >= 0)
        result = np.zeros((len(modes.a), table.shape[1]), dtype=bool)
        result[table[n, slot]] = is_same[n, slot]
        return result


def with_linear_maps(proposals: Proposals, points: int = 8, largest: float = 2.0) -> Proposals:
    """Return proposals in which linear maps replace those that are nearly linear in their bulk.

    The largest difference is in standard deviations of a proposal. Weights of points vary more, but
    a point needs one output instead of a solution.
    """
    modes = proposals.modes
    count, d = modes.a.shape
    rows = np.arange(count)
    values, jacobian = proposals.mapped_errors(rows, modes.a, modes.errors, modes.slopes)
    mode = np.repeat(rows, points)
    xi = np.tile(ndtri(sobol(points, d, 2)), (count, 1))
    away = _solutions(jacobian[mode], xi - values[mode])
    mapped, _ = proposals.mapped(mode, modes.a[mode] + away)
    difference = np.abs(mapped - xi).max(axis=1)
    is_used = (difference < largest).reshape(count, points).all(axis=1)
    heavy_axes = proposals.heavy_axes | is_used[:, None]
    linear = LinearMaps(is_used, values, jacobian)
    return replace(proposals, linear=linear, heavy_axes=heavy_axes)


def mode_coordinates(proposals: Proposals) -> Floats:
    """Return the coordinates of the modes, (R, d)."""
    modes = proposals.modes
    return proposals.residuals.coordinates(modes.specimen, modes.a)


def mixing_weights(modes: Modes, mass: Floats) -> Floats:
    """Return mixing weights by the mass of each mode, (R,).

    A tenth of the points is for all modes alike: another population may be the likely one.
    """
    total = np.bincount(modes.specimen, mass)[modes.specimen]
    count = np.bincount(modes.specimen)[modes.specimen]
    by_mass = np.where(total > 0, mass / positive_scale(total), 1 / count)
    return 0.9 * by_mass + 0.1 / count


def _point_counts(share: Floats, table: Indices, count: int) -> Indices:
    """Return the number of points of each mode, (R,), which have the sum ``count``."""
    least = np.where(table >= 0, np.floor(count * share[table]), -1)
    rest = np.where(table >= 0, count * share[table] - least, -1.0)
    missing = count - np.where(table >= 0, least, 0).sum(axis=1)
    # The largest remainders get one point more.
    rank = np.argsort(np.argsort(-rest, axis=1, kind="stable"), axis=1, kind="stable")
    counts = least + (rank < missing[:, None])
    return np.asarray(counts[table >= 0], dtype=np.intp)


@np.errstate(divide="ignore", invalid="ignore")
def _log_mixture(
    proposals: Proposals,
    specimen: Indices,
    a: Floats,
    weights: Floats,
    drawn: tuple[Indices, Floats] | None,
) -> Floats:
    """Return `Proposals.log_mixture` of a block of points."""
    logs = np.log(weights)
    modes, residuals = proposals.modes, proposals.residuals
    values, jacobian = residuals.simulated(specimen, a)
    largest, terms = np.full(len(a), -np.inf), []
    # Terms that are left out have one percent of a density together.
    least = 5 + np.log(len(residuals.scales))
    if drawn is not None:
        largest = drawn[1] + logs[drawn[0]]
        terms = [largest]
    for slot, at in enumerate(modes.table[specimen].T):
        rows = np.flatnonzero((at >= 0) & (logs[at] > -np.inf))
        if drawn is not None:
            rows = rows[at[rows] != drawn[0][rows]]
        at = at[rows]
        errors = residuals.standardised(
            specimen[rows], values[rows], jacobian[rows], modes.scale[at]
        )
        value, slopes = proposals.mapped_errors(at, a[rows], *errors)
        sign, log_det = np.linalg.slogdet(slopes)
        density = log_det + proposals.log_density(at, value) + logs[at]
        matters = (sign == proposals.orientation[at]) & (density > largest[rows] - least)
        rows, at, density = rows[matters], at[matters], density[matters]
        is_reached = np.zeros(len(rows), dtype=bool)
        if drawn is not None:
            is_reached = proposals.is_same_mode[drawn[0][rows], slot]
        check = np.flatnonzero(~is_reached)
        end, _, _, converged = proposals.solved(at[check], value[matters][check])
        distance = np.abs(end - a[rows[check]]).max(axis=1, initial=0)
        is_reached[check] = converged & (distance < 1e-3)
        term = np.full(len(a), -np.inf)
        term[rows[is_reached]] = density[is_reached]
        terms.append(term)
    return log_sum_exp(np.stack(terms, axis=1))


def without_covered(proposals: Proposals) -> Proposals:
    """Leave out modes in the bulk of the proposal of a better mode of the same specimen."""
    residuals, modes = proposals.residuals, proposals.modes
    squares = (modes.a**2).sum(axis=1)
    order = np.lexsort((modes.misfit + 0.05 * squares, modes.specimen))
    modes = modes.rows(order)
    ordered = Proposals.at_modes(residuals, modes)
    is_kept = np.ones(len(order), dtype=bool)
    for k, column in enumerate(modes.table.T):
        for better in modes.table.T[:k]:
            pairs = column >= 0
            at, rows = better[pairs], column[pairs]
            has_same_scale = modes.scale[at] == modes.scale[rows]
            pairs = is_kept[at] & is_kept[rows] & has_same_scale
            at, rows = at[pairs], rows[pairs]
            value, jacobian = ordered.mapped(at, modes.a[rows])
            sign, log_det = np.linalg.slogdet(jacobian)
            is_in_bulk = (value**2).sum(axis=1) < 1.0
            is_in_bulk &= sign == ordered.orientation[at]
            is_in_bulk &= log_det > ordered.log_det[at] - 1.0
            rows = rows[is_in_bulk]
            end, _, _, converged = ordered.solved(at[is_in_bulk], value[is_in_bulk])
            distance = np.abs(end - modes.a[rows])
            is_reached = distance.max(axis=1, initial=0) < 1e-2
            is_covered = converged & is_reached
            is_kept[rows[is_covered]] = False
    return Proposals.at_modes(residuals, modes.rows(np.flatnonzero(is_kept)))


def with_covered_fibres(proposals: Proposals, starts: Floats, scale: int) -> Proposals:
    """Return proposals with up to four more where the fibre of a specimen is not covered.

    A proposal ends at folds. Candidates are points at which the readings are met, nearest to
    starts (N, S, free), and points around each mode: an inaccurate reading may have both sides
    of a fold. They are not covered if their importance under a wide population is more than
    three times that of the modes; the most important one gets a proposal.
    """
    residuals, modes = proposals.residuals, proposals.modes
    n, count, d = starts.shape
    specimen = np.repeat(np.arange(n), count)
    met = _minimised(residuals, specimen, starts.reshape(-1, d), 1e-6, 15, scale)[0]
    g = modes.slopes
    # The precision G'G + 1/4 is R'R; as a sum it would lose its small eigenvalues.
    half = np.broadcast_to(0.5 * np.eye(d), (len(g), d, d))
    triangles = np.linalg.qr(np.concatenate([g, half], axis=1), mode="r")
    roots = np.linalg.inv(triangles).swapaxes(1, 2)
    away = ndtri(sobol(8, d, 1))
    if residuals.has_errors:
        # At a fold the precision is far too small, so that points are at several distances.
        u = sobol(32, d + 1, 1)
        away = ndtri(u[:, :d]) * 4.0 ** -u[:, d:]
    around = modes.a[:, None] + away @ roots
    specimen = np.concatenate([specimen, np.repeat(modes.specimen, len(away))])
    a = np.concatenate([met, around.reshape(-1, d)])
    e, slopes = residuals.errors(specimen, a, scale)
    misfit = (e**2).sum(axis=1) / 2
    least = _lowest(modes.specimen, modes.misfit, n)
    is_met = np.arange(len(a)) < len(met)
    margin = np.where(is_met, 10.0, 3.0)
    is_near = misfit <= least[specimen] + margin
    rows = np.flatnonzero(is_near)
    order = np.argsort(specimen[rows], kind="stable")
    scales = np.full(len(a), scale)
    points = Modes(specimen, a, misfit, e, slopes, scales).rows(rows[order])

    def importance(modes: Modes) -> Floats:
        log_q = proposals.log_mixture(modes.specimen, modes.a, proposals.share)
        return -0.125 * (modes.a**2).sum(axis=1) - modes.misfit - log_q

    for _ in range(4):
        of_modes = importance(modes)
        negative = np.where(np.isfinite(of_modes), -of_modes, np.inf)
        usual = -_lowest(modes.specimen, negative, n)
        of_specimens = usual[points.specimen]
        excess = importance(points) - of_specimens
        excess = np.where(np.isfinite(of_specimens), excess, -np.inf)
        first = best_rows(points.specimen, -excess)
        added = first[excess[first] > np.log(3.0)]
        if not added.size:
            break
        modes = Modes.joined([modes, points.rows(added)])
        proposals = Proposals.at_modes(residuals, modes)
    return proposals


@np.errstate(all="ignore")
def _solutions(matrices: Floats, right: Floats) -> Floats:
    """Return the solutions (n, m) of n linear systems, NaN where a matrix is singular."""
    if matrices.shape[-1] == 1:
        return right / matrices[..., 0]
    singular = ~(np.abs(np.linalg.det(matrices)) > 0)
    safe = np.where(singular[:, None, None], np.eye(matrices.shape[-1]), matrices)
    solution = np.linalg.solve(safe, right[..., None])[..., 0]
    return np.where(singular[:, None], np.nan, solution)
