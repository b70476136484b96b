r"""Densities of readings at points of specimens, as functions of an unknown error of the readings.

Outputs with one unknown error e, scales :math:`c_j` and a negligible error of the emulator need no
more than a sum of squares for each point,

.. math:: \log p(y \mid x, e) = -\frac{1}{2 e^2} \sum_j \Bigl(\frac{y_j - f_j(x)}{c_j}\Bigr)^2
          - \sum_j \log c_j - \frac{n}{2} \log(2 \pi e^2).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from prbayes._validate import Bools, Floats, Indices
from prbayes.metrics.readings import Readings
from prbayes.model.measurement import SpecimenLikelihood, output_columns, own_columns
from prbayes.specimens.points import SpecimenPoints


@dataclass(frozen=True, eq=False)
class ReadingDensity:
    """Log-density of the readings of S specimens at their K points, for unknown parameters.

    These are the rows of an array (3, M): for each output a standard deviation or parameter of
    counts, a relative error, and a bias (`ROLES`).
    """

    readings: Readings  # (S, k): readings of the outputs without a sum of squares
    outputs: Floats  # (S, K, k): outputs at the points
    unit: Floats  # standard deviation of a reading in units of its error; broadcasts to outputs
    relative: Floats | None  # likewise of the relative error; None if there is none
    parameter: Floats  # likewise of the parameter of counts
    bias: Floats | None  # the bias that the readings lack, where it is unknown; None if nowhere
    emulator_variance: Floats  # variance of the emulator's error; broadcasts to outputs
    # (S, k): indices of the outputs; None if these are all outputs in their order.
    columns: Indices | None
    # For each unknown error of plain readings a tuple: index of an output that has the error, sums
    # of squared residuals (S, K), numbers of readings (S, 1), and variance of the emulator's error
    # in units of the scales.
    sums: Sequence[tuple[int, Floats, Floats, float]]
    constant: Floats  # (S, 1): minus the sum of the logarithms of scales

    @classmethod
    def of(
        cls, likelihood: SpecimenLikelihood, points: SpecimenPoints, emulator_error: Floats
    ) -> ReadingDensity:
        """Return the density at points; ``emulator_error``, (M,), is that of the outputs."""
        readings, stacked = likelihood.readings, likelihood.stacked
        scales = [stacked.scale, stacked.relative, stacked.parameter, stacked.bias]
        shape = readings.values.shape
        numbers = np.broadcast_to(np.arange(shape[1]), shape)
        variances = np.broadcast_to(emulator_error**2, shape)
        columns_read = own_columns(likelihood)
        if columns_read is not None:
            numbers = columns_read
            readings = readings.at_columns(numbers)
            *scales, variances = (
                np.take_along_axis(x, numbers, axis=1) for x in (*scales, variances)
            )
        # Entries that only fill up the array of points get an arbitrary output.
        outputs = np.where(np.isfinite(points.outputs), points.outputs, 1e30)
        is_missing = ~(readings.is_measured | readings.is_censored)
        sums, constant = [], np.zeros((len(readings), 1))
        for m in likelihood.measurements:
            columns = output_columns(likelihood, m)
            if list(m.unknown) != ["error"]:
                continue
            is_scalar = not m.extras["error"].type.ndim
            width = columns.stop - columns.start if is_scalar else 1
            for start in range(columns.start, columns.stop, width):
                is_counted = (numbers >= start) & (numbers < start + width)
                is_counted &= readings.is_measured | readings.is_censored
                plain = _sums_of_squares(readings, scales[0], outputs, variances, is_counted)
                if plain is not None:
                    sums.append((start, *plain[0]))
                    constant -= plain[1]
                    is_missing |= is_counted
        variance, places = variances[:, None], None
        size = (~is_missing).sum(axis=1).max()
        if size < outputs.shape[-1]:
            places = np.argsort(is_missing, axis=1, kind="stable")[:, :size]
            is_outside = np.take_along_axis(is_missing, places, axis=1)
            readings = readings.at_columns(places)
            readings = replace(readings, values=np.where(is_outside, np.nan, readings.values))
            outputs = np.take_along_axis(outputs, places[:, None], axis=2)
            scales = [np.take_along_axis(x, places, 1) for x in scales]
            variance = np.take_along_axis(variances, places, 1)[:, None]
            numbers = np.take_along_axis(numbers, places, 1)
        is_ordered = places is None and columns_read is None
        has_bias = any("bias" in m.extras for m in likelihood.measurements)
        unit, relative, parameter, bias = (x[:, None] for x in scales)
        return cls(
            readings,
            outputs,
            unit,
            relative * np.abs(outputs) if relative.any() else None,
            parameter,
            bias if has_bias else None,
            variance,
            None if is_ordered else numbers,
            sums,
            constant,
        )

    def __call__(self, parameters: Any, xp: Any) -> Any:
        """Return the log-density, (S, K), as an array or a graph."""
        total = self.constant
        for column, squares, count, variance in self.sums:
            v = parameters[0][column] ** 2 + variance
            total = total - 0.5 * (squares / v + count * xp.log(2 * np.pi * v))
        if not self.outputs.shape[-1]:
            return total
        error, relative, bias = (
            row if self.columns is None else row[self.columns][:, None] for row in parameters
        )
        variance = self.emulator_variance + (error * self.unit) ** 2
        if self.relative is not None:
            variance = variance + (relative * self.relative) ** 2
        outputs = self.outputs if self.bias is None else self.outputs + (bias - self.bias)
        parameter = error * self.parameter
        return total + self.readings.symbolic_log_density(outputs, variance, xp, parameter)

    def at_errors(self, errors: Floats, spacing: float = 0.05) -> Iterator[Floats]:
        """Yield the log-density, (S, K), at parameters (P, 3, M), of which the first ascend.

        Between values of one unknown error whose logarithms differ by ``spacing`` a cubic
        polynomial replaces the density where that takes fewer evaluations.
        """
        varies = np.ptp(errors, axis=0) > 0
        columns = errors[:, varies].T
        is_one = len(columns) > 0 and (columns == columns[0]).all() and (columns[0] > 0).all()
        is_one &= not varies[2].any()
        places = np.log(columns[0]) / spacing if is_one else np.zeros(len(errors))
        cells = np.floor(places).astype(int)
        needed = np.unique(cells[:, None] + np.arange(-1, 3))
        if not is_one or 2 * len(needed) > len(errors):
            for error in errors:
                yield self(error, np)
            return
        at_nodes = {}
        for place, cell in zip(places, cells, strict=True):
            # Interpolate by Lagrange's polynomial through two nodes on each side.
            nodes = range(cell - 1, cell + 3)
            for node in nodes:
                if node not in at_nodes:
                    error = np.where(varies, np.exp(spacing * node), errors[0])
                    at_nodes[node] = self(error, np)
            at_nodes = {node: at_nodes[node] for node in nodes}
            first, second, third, fourth = at_nodes.values()
            u = place - cell
            outer = u * (u - 1) / 6
            inner = (u + 1) * (u - 2) / 2
            result = -outer * (u - 2) * first
            result += inner * (u - 1) * second
            result -= inner * u * third
            result += outer * (u + 1) * fourth
            yield result


def _sums_of_squares(
    readings: Readings, scale: Floats, outputs: Floats, variance: Floats, is_counted: Bools
) -> tuple[tuple[Floats, Floats, float], Floats] | None:
    """Return squares, numbers and variance of `ReadingDensity.sums`, and log scales, (S, 1).

    These are sums over the readings that count, (S, k). None if the readings are not plain, or the
    ``variance`` of the emulator's error, (S, k), is not negligible.
    """
    unit = np.where(is_counted, scale, 1.0)
    squared = unit**2
    relative = variance / squared
    is_special = (readings.step != 0) | (readings.family >= 0) | readings.is_censored
    # With this tolerance a log-density changes by less than 1e-4 at an eighth of the largest
    # plausible error.
    is_special |= relative > 1e-6 * (readings.error / unit) ** 2
    if is_special[is_counted].any():
        return None
    measured = np.where(is_counted, readings.values, 0.0)
    inverse = np.where(is_counted, 1 / unit, 0.0)
    squares = np.zeros(outputs.shape[:2])
    for y, c, output in zip(measured.T, inverse.T, np.moveaxis(outputs, 2, 0), strict=True):
        residuals = y[:, None] - output
        squares += (residuals * c[:, None]) ** 2
    count = is_counted.sum(axis=1, keepdims=True, dtype=float)
    sums = (squares, count, float(relative[is_counted].mean()))
    return sums, np.log(unit).sum(axis=1, keepdims=True)
