"""Log-likelihood by specimen from a table of runs, without a fresh run.

The surface through the table takes the place of the emulator. Beyond the ranges of the runs it is
continued linearly, so that a table which ends within the populations of the data is recognised: it
is refused, and nothing is answered from the continuation. The error of the surface is twice the
cross-validated error at the runs nearest to the roots of the specimens.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import cast

import numpy as np

from prbayes._validate import Bools, Floats, Function, complete_rows
from prbayes.emulators.runs import Runs, continued, left_out_nearby
from prbayes.metrics.readings import robust_spread
from prbayes.model.measurement import Measurement, SpecimenLikelihood
from prbayes.model.remedies import table_advice
from prbayes.propagation.base import MAX_LOST, DesignError
from prbayes.response.budget import unlimited
from prbayes.response.response import Responses
from prbayes.specimens.coordinates import Coordinates
from prbayes.specimens.design import Likely, error_and_bias, wider
from prbayes.specimens.emulation import DifferencedResponse, Emulation, near_readings
from prbayes.specimens.points import Draws, SpecimenData, SpecimenPoints, normal_of, specimen_points
from prbayes.specimens.proposals import Proposals


@dataclass(frozen=True, eq=False)
class OfTables:
    """A function of tables: coordinates (k, d) -> a number for each output of all, (k, M)."""

    coordinates: Coordinates
    responses: tuple[Responses, ...]

    @classmethod
    def of(cls, likelihood: SpecimenLikelihood, function: Function) -> OfTables:
        """Return a function of the table of each simulator."""
        responses = []
        for m in likelihood.measurements:
            of_table, inputs = partial(function, _table(m)), m.responses.inputs
            responses.append(Responses(m.name, of_table, inputs, outputs=m.responses.outputs))
        return cls(likelihood.coordinates, tuple(responses))

    def __call__(self, z: Floats) -> Floats:
        """Return values by output; these calls do not count as runs."""
        inputs = self.coordinates.inputs(z)
        with unlimited():
            parts = [response(inputs, []).reshape(len(z), -1) for response in self.responses]
        return np.concatenate(parts, axis=1)


def points_of_tables(
    data: SpecimenData, likelihood: SpecimenLikelihood
) -> tuple[Emulation, SpecimenPoints, Proposals, Draws]:
    """Return the surface of tables, points of the specimens, and their proposals.

    Raises DesignError if the runs do not cover the populations of the data, or the surface is too
    inaccurate there.
    """
    emulation, ranges = _surface(data, likelihood)
    likely = Likely.of(data, emulation, normal_of(data.inner[:, data.free]), 0)
    z, specimens = likely.sample(512, np.random.default_rng(data.seed))
    inside = _is_inside(z, ranges)
    if inside.sum() >= 4:
        misfit = OfTables.of(likelihood, left_out_nearby)(z[inside])
        error, bias = error_and_bias(data, emulation, likely, z[inside], specimens[inside], misfit)
        # If the error is too large in this comparison, it narrows the population by half its share
        # of the variance. Beside a turning point a linear approximation of the error would be far
        # too large.
        share = float((error / robust_spread(data.readings)).max())
        narrowing = np.sqrt(len(data.readings) / 2) * share**2
        emulation = replace(emulation, error=error, bias=max(bias, narrowing))
    _require_accurate(likelihood, data, emulation)
    try:
        points, proposals, draws = specimen_points(data, emulation, wider(likely.population))
    except DesignError as error:
        if inside.mean() >= 1 - MAX_LOST:
            raise
        raise DesignError(
            f"{likelihood.name}: got runs that do not cover the populations of the data: the "
            f"likeliest inputs of {np.mean(~inside):.0%} of the specimens are outside "
            f"their ranges, expected none: about {_asked(likelihood, z, ranges)}; "
            "prb.propose_runs(model) returns a table of runs to add"
        ) from error
    _require_cover(likelihood, points, draws, draws.specimens(), ranges)
    return emulation, points, proposals, draws


def _surface(data: SpecimenData, likelihood: SpecimenLikelihood) -> tuple[Emulation, Floats]:
    """Return the surface through the runs, in a wider box of the search, and the runs' ranges."""
    coordinates, bounds = likelihood.coordinates, likelihood.coordinates.bounds
    runs, lows, highs = [], [], []
    for m in likelihood.measurements:
        table = _table(m)
        domain = table.surrogate.domain
        places = [m.responses.inputs.arguments.index(a) for a in range(len(m.inputs.aleatory))]
        values = domain.arguments(table.points)
        inputs = [domain.inputs[place] for place in places]
        runs.append(coordinates.of([values[place] for place in places], 1))
        lows.append(coordinates.of([x.low for x in inputs], 0))
        highs.append(coordinates.of([x.high for x in inputs], 0))
    low = np.max(lows, axis=0)
    high = np.min(highs, axis=0)
    # An input may be negative in the table, though its coordinate is logarithmic.
    low = np.where(np.isfinite(low), low, bounds[0])
    ranges = np.stack([low, high])
    margin = (high - low) / 2
    lower = np.maximum(bounds[0], low - margin)
    upper = np.minimum(bounds[1], high + margin)
    is_empty = lower >= upper
    if is_empty.any():
        names = _column_names(likelihood)
        prior = _as_inputs(coordinates, bounds)
        table_ends = _as_inputs(coordinates, ranges)
        j = int(np.argmax(is_empty))
        raise DesignError(
            f"{likelihood.name}: got runs with {names[j]} from {table_ends[0, j]:.4g} to "
            f"{table_ends[1, j]:.4g}, and a prior of {prior[0, j]:.4g} to {prior[1, j]:.4g}, "
            "expected ranges that overlap; check the units, and the order of the inputs"
        )
    z = np.unique(np.concatenate(runs), axis=0)
    z = z[complete_rows(z)]
    y = OfTables.of(likelihood, Runs.__call__)(z)
    near = z[near_readings(y, data.readings)]
    residuals = OfTables.of(likelihood, left_out_nearby)(near)
    mean_square = (residuals**2).mean(axis=0)
    error = 2 * np.sqrt(mean_square)
    error = np.maximum(error, data.options.floor * data.readings.spread())
    # The step of the differences is a thousandth, over which the surface changes by far more than
    # the rounding noise of a Gaussian process.
    surface = DifferencedResponse(OfTables.of(likelihood, continued), step=1e-3)
    return Emulation(z, y, surface, error, 0.0, ranges), ranges


def _is_inside(z: Floats, ranges: Floats) -> Bools:
    """Return which coordinates (..., d) are within the runs' ranges, up to rounding."""
    slack = 1e-9 * (ranges[1] - ranges[0])
    return np.asarray(((z >= ranges[0] - slack) & (z <= ranges[1] + slack)).all(axis=-1))


def _require_cover(
    likelihood: SpecimenLikelihood,
    points: SpecimenPoints,
    draws: Draws,
    specimens: Floats,
    ranges: Floats,
) -> None:
    """Raise if the likelihood of a specimen, or 5 % of that of all, is outside the ranges."""
    is_inside = _is_inside(points.z, ranges)
    whole = draws.log_likelihoods(points.z, points.log_a)
    inside = draws.log_likelihoods(points.z, np.where(is_inside, points.log_a, -np.inf))
    with np.errstate(invalid="ignore"):
        shares = np.nan_to_num(np.exp(inside - whole), nan=1.0).mean(axis=0)
    outside = 1 - shares
    if outside.max() <= 0.5 and outside.mean() <= MAX_LOST:
        return
    raise DesignError(
        f"{likelihood.name}: got runs that do not cover the populations of the data: the inputs of "
        f"{int((outside > 0.5).sum())} of {len(outside)} specimens are outside their ranges, "
        f"expected none, and {outside.mean():.0%} of the likelihood of all, expected at most "
        f"{MAX_LOST:.0%}: about {_asked(likelihood, specimens, ranges)}; "
        "prb.propose_runs(model) returns a table of runs to add"
    )


def _asked(likelihood: SpecimenLikelihood, specimens: Floats, ranges: Floats) -> str:
    """Return a text on the inputs beyond the runs' ranges that the data require."""
    coordinates = likelihood.coordinates
    ends = _as_inputs(coordinates, ranges)
    asked = np.quantile(_as_inputs(coordinates, specimens), [0.005, 0.995], axis=0)
    parts = [
        f"{name} from {low:.4g} to {high:.4g}, where the runs have {least:.4g} to {most:.4g}"
        for name, low, high, least, most in zip(
            _column_names(likelihood), *asked, *ends, strict=True
        )
        if low < least or high > most
    ]
    return "; ".join(parts) or "the corners of the ranges"


def _require_accurate(
    likelihood: SpecimenLikelihood, data: SpecimenData, emulation: Emulation
) -> None:
    """Raise if the error of the surface is as large as the scatter, or if it shifts populations."""
    share = float((emulation.error / robust_spread(data.readings)).max())
    if emulation.bias <= data.options.bias and share < 1:
        return
    shift = f"{emulation.bias:.2g}" if emulation.bias < 100 else "100 and more"
    raise DesignError(
        f"{likelihood.name}: got a surface through {len(emulation.z)} runs with a cross-validated "
        f"error of {share / 2:.2g} standard deviations of the readings, which would shift a mean "
        f"or standard deviation of an input by {shift} posterior standard deviations, "
        f"expected at most {data.options.bias}; {table_advice(likelihood)}"
    )


def _table(measurement: Measurement) -> Runs:
    return cast(Runs, measurement.responses.function)


def _column_names(likelihood: SpecimenLikelihood) -> list[str]:
    """Return the name of each aleatory number in the table."""
    m = likelihood.measurements[0]
    names = []
    table = _table(m)
    for a in range(len(m.inputs.aleatory)):
        r = table.surrogate.domain.inputs[m.responses.inputs.arguments.index(a)]
        names += [r.name] if not r.event else [f"{r.name}[{i}]" for i in range(r.size)]
    return names


def _as_inputs(coordinates: Coordinates, z: Floats) -> Floats:
    """Return the inputs at coordinates z, as columns (k, d)."""
    parts = coordinates.inputs(z)
    return np.concatenate([x.reshape(len(z), -1) for x in parts], axis=1)
