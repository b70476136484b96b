"""Emulation of a response near the measured specimens, with estimates of its error.

No guard detects an error of the emulator that is smooth between the runs which measure it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from scipy.special import ndtri

from prbayes._validate import IN_CACHE, ArrayFunction, Bools, Floats, Indices
from prbayes.emulators.emulator import Emulator, fit_emulator
from prbayes.metrics.readings import Readings, located_values
from prbayes.propagation.base import DesignError

type Columns = Indices | None


class Surface(Protocol):
    """Outputs (k, m) at coordinates (k, d) between runs, with their Jacobian (k, m, d)."""

    def __call__(self, z: Floats, columns: Columns = None) -> tuple[Floats, Floats]:
        """Return values and Jacobian; of the outputs in ``columns``, (k, c), of each point."""

    def values(self, z: Floats, columns: Columns = None) -> Floats:
        """Return the values alone."""

    def variance(self, z: Floats) -> Floats:
        """Return predictive variances, (k, m)."""


@dataclass(frozen=True, eq=False)
class CompressedSurface:
    """A surface through outputs that are compressed like logarithms far from the data.

    A response that is steep outside the data would take the digits that outputs near them need. The
    surface is that of arcsinh((y - center) / unit).
    """

    surface: Emulator
    center: Floats  # (m,): mean of the readings of each output
    unit: Floats  # (m,): scale of each output, within which the surface is nearly linear in it
    spread: Floats  # (m,): standard deviation of the readings of each output

    def expanded(self, u: Floats, columns: Any = slice(None)) -> Floats:
        """Return outputs, (n, m), from values of the compressed surface."""
        inside = np.clip(u, -100, 100)
        scaled = self.unit[columns] * np.sinh(inside)
        return np.asarray(self.center[columns] + scaled)

    def __call__(self, z: Floats, columns: Columns = None) -> tuple[Floats, Floats]:
        """Return values and Jacobian; of the outputs in ``columns``, (k, c), of each point."""
        u, jacobian = self.surface(z, columns)
        place: Any = slice(None) if columns is None else columns
        slopes = self.unit[place] * np.cosh(np.clip(u, -100, 100))
        return self.expanded(u, place), slopes[:, :, None] * jacobian

    def values(self, z: Floats, columns: Columns = None) -> Floats:
        """Return the values alone."""
        place: Any = slice(None) if columns is None else columns
        return self.expanded(self.surface.values(z, columns), place)

    def variance(self, z: Floats) -> Floats:
        """Return predictive variances, (k, m)."""
        slopes = self.unit * np.cosh(np.clip(self.surface.values(z), -100, 100))
        return slopes**2 * self.surface.variance(z)


@dataclass(frozen=True, eq=False)
class DifferencedResponse:
    """The response itself, with central differences for its Jacobian: 2 d + 1 runs a point."""

    response: ArrayFunction  # coordinates (k, d) -> outputs (k, m)
    step: float = 1e-5  # step of the differences, in units of the coordinates

    def __call__(self, z: Floats, columns: Columns = None) -> tuple[Floats, Floats]:
        """Return values and Jacobian; of the outputs in ``columns``, (k, c), of each point."""
        k, d = z.shape
        axes = np.eye(d)
        shifts = self.step * np.concatenate([np.zeros((1, d)), axes, -axes])
        points = (z + shifts[:, None]).reshape(-1, d)
        values = self.response(points).reshape(2 * d + 1, k, -1)
        slopes = (values[1 : d + 1] - values[d + 1 :]) / (2 * self.step)
        outputs, jacobian = values[0], np.moveaxis(slopes, 0, -1)
        if columns is None:
            return outputs, jacobian
        rows = np.arange(k)[:, None]
        return outputs[rows, columns], jacobian[rows, columns]

    def values(self, z: Floats, columns: Columns = None) -> Floats:
        """Return the values alone."""
        values = self.response(z)
        return values if columns is None else np.take_along_axis(values, columns, axis=1)

    def variance(self, z: Floats) -> Floats:
        """Return zeros: the response has no error."""
        return np.zeros_like(self.response(z))


@dataclass(frozen=True, eq=False)
class Emulation:
    """Runs of the response, and the emulator through them."""

    z: Floats  # (n, d): coordinates of the runs
    y: Floats  # (n, m): their outputs; NaN where there is no response
    surface: Surface
    # (m,): standard deviation of the emulator's error at the specimens' likely inputs: twice the
    # error at runs there before they were part of it.
    error: Floats
    # Predicted bias of a mean or standard deviation of an input, in posterior standard deviations.
    bias: float
    # (2, d): ends of the emulator's range, by default those of the runs. Beyond an end a specimen
    # has the response at the end.
    ends: Floats | None = None
    # (N, m): output of the response less that of the surface, at the likely inputs of each specimen
    offsets: Floats | None = None
    # Indices of runs of audits, which exclude inputs that the emulator took for likely.
    audited: tuple[int, ...] = ()

    @cached_property
    def box(self) -> Floats:
        """Ends beyond which a specimen has the response at the end, (2, d)."""
        if self.ends is not None:
            return self.ends
        return np.stack([self.z.min(axis=0), self.z.max(axis=0)])

    def with_runs(self, z: Floats, y: Floats) -> Emulation:
        """Return the emulation with more runs, (k, d) and (k, m), and the same surface."""
        return replace(self, z=np.concatenate([self.z, z]), y=np.concatenate([self.y, y]))

    def __call__(self, z: Floats, columns: Columns = None) -> tuple[Floats, Floats]:
        """Return values and Jacobian, NaN where the nearest run fails or the surface misses it."""
        values, jacobian = self.surface(z, columns)
        failed = self.fails(z) | self._of_nearest(self._is_contradicted, z)
        values[failed], jacobian[failed] = np.nan, np.nan
        return values, jacobian

    def values(self, z: Floats, columns: Columns = None) -> Floats:
        """Return the values alone."""
        parts = []
        for rows in np.array_split(np.arange(len(z)), 1 + len(z) // IN_CACHE):
            of_rows = None if columns is None else columns[rows]
            parts.append(self.surface.values(z[rows], of_rows))
        values = np.concatenate(parts)
        values[self.fails(z) | self._of_nearest(self._is_contradicted, z)] = np.nan
        return values

    def predicted(self, z: Floats) -> Floats:
        """Return outputs of any specimens, (k, m), NaN where the nearest run has no response."""
        blocks = np.array_split(z, 1 + len(z) // IN_CACHE)
        values = np.concatenate([self.extended(block) for block in blocks])
        values[self.fails(z)] = np.nan
        return values

    def extended(self, z: Floats) -> Floats:
        """Return outputs, (k, m), of the surface or of one through all runs.

        The surface leaves out runs far from the specimens, and may be arbitrary there. Where both
        differ by 1 % of the distance from the data, the smaller relative variance decides.
        """
        values, inner, outer = self.surface.values(z), self.surface, self._through_all_runs
        if outer is None:
            return values
        others = outer.values(z)
        distance = np.hypot(others - outer.center, outer.unit)
        differs = (np.abs(values - others) > 0.01 * distance).any(axis=1)
        if not differs.any():
            return values
        relative = []
        for surface, outputs in ((inner, values), (outer, others)):
            distance = np.hypot(outputs[differs] - outer.center, outer.unit)
            relative.append(surface.variance(z[differs]) / distance**2)
        is_better = relative[1] < relative[0]
        values[differs] = np.where(is_better, others[differs], values[differs])
        return values

    @cached_property
    def _through_all_runs(self) -> CompressedSurface | None:
        """A surface that leaves out no run; None if the surface leaves out none."""
        inner, is_finite = self.surface, np.isfinite(self.y).all(axis=1)
        if not isinstance(inner, CompressedSurface):
            return None
        z, y = self.z[is_finite], self.y[is_finite]
        _, first = np.unique(np.round(z, 9), axis=0, return_index=True)
        if len(first) == len(inner.surface.z):
            return None
        distance = np.abs(y - inner.center)
        least = 1e-12 * distance.max(axis=0) + 1e-300
        unit = np.maximum(np.median(distance, axis=0), least)
        compressed = np.arcsinh((y[first] - inner.center) / unit)
        return replace(inner, surface=fit_emulator(z[first], compressed), unit=unit)

    def fails(self, z: Floats) -> Bools:
        """Return where the nearest run has no finite response."""
        return self._of_nearest(~np.isfinite(self.y).all(axis=1), z)

    def is_missing(self, z: Floats) -> Bools:
        """Return where the nearest run has no response: NaN, while +inf is a failed specimen."""
        return self._of_nearest(np.isnan(self.y).any(axis=1), z)

    @cached_property
    def _is_contradicted(self) -> Bools:
        """Runs far from the readings that the surface is fitted to and does not go through, (n,).

        Between runs beside a pole the surface may reach the readings, which the response does not.
        """
        from scipy.spatial import cKDTree

        surface = self.surface
        if not isinstance(surface, CompressedSurface):
            return np.zeros(len(self.z), dtype=bool)
        outputs = np.stack([self.y, surface.values(self.z)])
        of_runs, of_surface = np.arcsinh((outputs - surface.center) / surface.spread)
        is_far = np.abs(of_runs) > np.arcsinh(5)
        is_missed = (is_far & (np.abs(of_runs - of_surface) > 1)).any(axis=1)
        # Runs that the surface leaves out may have inputs of another population.
        distance, _ = cKDTree(surface.surface.z).query(self.z)
        return np.asarray(is_missed & (distance < 1e-8))

    def _of_nearest(self, of_runs: Bools, z: Floats) -> Bools:
        """Return a property of the nearest run of each point."""
        if not of_runs.any():
            return np.zeros(len(z), dtype=bool)
        _, nearest = self._tree.query(z / self._width)
        return np.asarray(of_runs[nearest])

    @cached_property
    def _tree(self) -> Any:
        from scipy.spatial import cKDTree

        return cKDTree(self.z / self._width)

    @property
    def _width(self) -> Floats:
        return np.maximum(np.ptp(self.z, axis=0), 1e-300)


def fit_surface(
    z: Floats,
    y: Floats,
    readings: Readings,
    name: str,
    previous: Any = None,
    used: Bools | None = None,
) -> tuple[CompressedSurface, Floats, Bools]:
    """Return the emulator, left-out errors, (n, m), and which runs are near the data, (n,).

    Runs that are not ``used``, (n,), or without a response have NaN as their error. Runs that are
    equal to nine digits count once.
    """
    good = np.isfinite(y).all(axis=1)
    if used is not None and (good & used).sum() >= 8:
        good &= used
    if good.sum() < 8:
        raise DesignError(
            f"{name}: got {int(good.sum())} runs with a response of {len(y)}, expected at least 8; "
            "check the response, or give the hyperparameters priors where it exists"
        )
    spread = readings.spread()
    rows = np.flatnonzero(good)
    rounded = np.round(z[rows], 9)
    _, first, copies = np.unique(rounded, axis=0, return_index=True, return_inverse=True)
    zg, yg = z[rows[first]], y[rows[first]]
    center = np.nanmean(located_values(readings), axis=0)
    inside = near_readings(yg, readings)
    largest = np.abs(yg - center).max(axis=0)
    # If all outputs are within 100 standard deviations of the data, the unit is so large that they
    # are not compressed. Otherwise compression makes a step of a response that is nearly linear.
    plain = 1e6 * np.maximum(largest, spread)
    is_far = largest > 100 * spread
    start = previous.surface if isinstance(previous, CompressedSurface) else None
    of_point = int(readings.is_measured.sum(axis=1).max())
    fits = []
    for unit in [np.where(is_far, 10 * spread, plain), plain][: 1 + is_far.any()]:
        compressed = np.arcsinh((yg - center) / unit)
        emulator = fit_emulator(zg, compressed, inside, start=start, of_point=of_point)
        surface = CompressedSurface(emulator, center, unit, spread)
        errors = yg - surface.expanded(compressed - surface.surface.left_out)
        fits.append((surface, errors))
    with np.errstate(over="ignore"):
        surface, errors = min(fits, key=lambda fit: float(((fit[1] / spread)[inside] ** 2).sum()))
    left_out, is_near = np.full_like(y, np.nan), np.zeros(len(y), dtype=bool)
    left_out[rows], is_near[rows] = errors[copies.ravel()], inside[copies.ravel()]
    return surface, left_out, is_near


def near_readings(y: Floats, readings: Readings) -> Bools:
    """Return which outputs (n, m) are within the range of the readings, or half of it away.

    If these are less than a quarter, the nearest quarter, and at least eight.
    """
    spread, values = readings.spread(), located_values(readings)
    center = np.nanmean(values, axis=0)
    low, high = np.nanmin(values, axis=0), np.nanmax(values, axis=0)
    margin = np.maximum((high - low) / 2, spread)
    is_near = ((y >= low - margin) & (y <= high + margin)).all(axis=1)
    if is_near.sum() < len(y) // 4:
        with np.errstate(over="ignore"):  # An infinite distance is the largest.
            distance = (((y - center) / spread) ** 2).sum(axis=1)
        is_near = np.zeros(len(y), dtype=bool)
        is_near[np.argsort(distance, kind="stable")[: max(8, len(y) // 4)]] = True
    return is_near


def predicted_bias(shift: Floats, x: Floats, size: int) -> Floats:
    """Return the bias that shifts of inputs cause, (2, d), in posterior standard deviations.

    ``shift``, (n, d), is the true input less that of the emulator, at a sample x, (n, d), of the
    inputs of ``size`` specimens. The first row is the bias of the mean, the second that of the
    standard deviation of each input's population. Infinite if all have the same value of an input.
    At a jump the prediction has .10 to .45 of the true size.
    """
    sd = x.std(axis=0)
    if (sd == 0).any():
        # If all inputs are equal, as at the maximum of a response, the spread is not known.
        return np.full((2, len(sd)), np.inf)
    mean_bias = -shift.mean(axis=0) / sd * np.sqrt(size)
    covariance = ((x - x.mean(axis=0)) * shift).mean(axis=0)
    # var(x) = var(x + shift) - 2 cov(x, shift) - var(shift)
    sd_bias = -(covariance + shift.var(axis=0) / 2) / sd**2 * np.sqrt(2 * size)
    return np.stack([mean_bias, sd_bias])


def half_difference(
    log_likelihoods_a: Floats, log_likelihoods_b: Floats
) -> tuple[float, float, float]:
    """Return the Monte Carlo error of the log-likelihood over the posterior, in nats.

    sd_s sum_i (log L_i^a(theta_s) - log L_i^b(theta_s)) / 2 over posterior draws theta_s, with
    points of two independent halves a and b, both (S, N). A tilt of one nat for each posterior
    standard deviation moves the posterior mean by one standard deviation. A specimen without a
    point in one of the halves is left out. The second number is the standard deviation of a normal
    distribution with the same deciles, and the third that of a constant. Size and power:
    docs/likelihood.md.
    """
    is_finite = np.isfinite(log_likelihoods_a) & np.isfinite(log_likelihoods_b)
    with np.errstate(invalid="ignore"):
        by_specimen = np.where(is_finite, log_likelihoods_a - log_likelihoods_b, 0.0)
    difference = by_specimen.sum(axis=1) / 2
    low, high = np.quantile(difference, [0.1, 0.9])
    by_deciles = (high - low) / (ndtri(0.9) - ndtri(0.1))
    total = float(difference.std())
    return total, min(float(by_deciles), total), abs(float(difference.mean()))
