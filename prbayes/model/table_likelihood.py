"""Log-likelihood by specimen from a table of runs, without a fresh run.

The surface through the table takes the place of the emulator. Beyond the ranges of the runs it is
continued linearly, so that a table which ends within the populations of the data is recognised: it
is refused, and nothing is answered from the continuation. The error of the surface is twice the
cross-validated error at the runs nearest to the roots of the specimens.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from prbayes._validate import Floats
from prbayes.emulators.continued import Continued, LeftOut
from prbayes.emulators.runs import Runs
from prbayes.model.measurement import Measurement, SpecimenLikelihood
from prbayes.propagation.base import MAX_LOST, DesignError
from prbayes.propagation.fibre_points import fibre_points
from prbayes.propagation.roots import Roots
from prbayes.propagation.specimen_emulation import (
    Coordinates,
    DifferencedResponse,
    Emulation,
    EmulationProblem,
    all_roots,
    likely_roots,
    near_readings,
    shift_by_misfit,
    specimen_roots,
)
from prbayes.propagation.specimen_points import SpecimenPoints, draw_points
from prbayes.response.budget import unlimited
from prbayes.response.response import Responses


class Draws(Protocol):
    """Draws of populations."""

    def log_likelihoods(self, z: Floats, log_a: Floats) -> Floats:
        """Return log p(y_i | theta), (S, N)."""

    def specimens(self) -> Floats:
        """Return coordinates of specimens, (n, d)."""


@dataclass(frozen=True, eq=False)
class OfTables:
    """A function of tables: coordinates (k, d) -> a number for each output of all, (k, M)."""

    coordinates: Coordinates
    responses: tuple[Responses, ...]
    of_conditions: float  # one for values of conditions, zero for their errors

    @classmethod
    def of(cls, likelihood: SpecimenLikelihood, kind: Callable[[Runs], Any]) -> OfTables:
        """Return a function of the table of each simulator."""
        responses = []
        for m in likelihood.measurements:
            function, outputs = kind(_table(m)), m.responses.outputs
            responses.append(Responses(m.name, function, m.responses.inputs, outputs=outputs))
        is_error = kind is LeftOut
        return cls(likelihood.coordinates, tuple(responses), 0.0 if is_error else 1.0)

    def __call__(self, z: Floats) -> Floats:
        """Return values by output; no run is counted."""
        inputs = self.coordinates.inputs(z)
        with unlimited():
            parts = [response(inputs, []).reshape(len(z), -1) for response in self.responses]
        parts.append(self.of_conditions * z[:, self.coordinates.is_condition])
        return np.concatenate(parts, axis=1)


def points_of_tables(
    problem: EmulationProblem,
    likelihood: SpecimenLikelihood,
    prior_specimens: Callable[[], Floats],
    posterior: Callable[..., Any],
) -> tuple[Emulation, SpecimenPoints, Roots | None]:
    """Return the surface of tables, points of the specimens, and roots if readings identify them.

    Raises DesignError if the runs do not cover the populations of the data, or the surface is too
    inaccurate there.
    """
    readings, options = problem.readings, problem.options
    emulation, ranges = _surface(problem, likelihood)
    present = readings.is_measured | readings.is_censored
    roots = None
    if (present.sum(axis=1) < likelihood.coordinates.size).any():
        emulation, points = fibre_points(
            problem, emulation.box, prior_specimens(), posterior, emulation
        )
    else:
        roots = specimen_roots(emulation, readings, options)
        if len(roots.z):
            likely = likely_roots(roots, emulation.box)
            inside = likely[_is_inside(likely, ranges)]
            if len(inside) >= 4:
                error = _error(problem, OfTables.of(likelihood, LeftOut)(inside))
                emulation = replace(emulation, error=error)
                roots = specimen_roots(emulation, readings, options)
        roots = all_roots(emulation, readings, options, roots, problem.seed)
        likely = likely_roots(roots, emulation.box) if len(roots.z) else roots.z
        emulation = _with_bias(problem, likelihood, emulation, likely, ranges)
        _require_accurate(likelihood, problem, emulation)
        try:
            points = draw_points(
                emulation,
                readings,
                roots,
                options,
                error_is_known=likelihood.error_is_known,
                gross_errors=likelihood.measurements[0].gross_errors is not False,
            )
        except DesignError as error:
            outside = ~_is_inside(likely, ranges)
            if outside.mean() <= MAX_LOST:
                raise
            raise DesignError(
                f"{likelihood.name}: got runs that do not cover the populations of the data: the "
                f"likeliest inputs of {outside.sum()} of {len(outside)} specimens are outside "
                f"their ranges, expected none: about {_asked(likelihood, likely, ranges)}; "
                "prb.propose_runs(model) returns a table of runs to add"
            ) from error
    draws: Draws = posterior(points.z, points.log_a)
    specimens = draws.specimens()
    _require_cover(likelihood, points, draws, specimens, ranges)
    if roots is None:
        emulation = _with_bias(problem, likelihood, emulation, specimens[:1024], ranges)
        _require_accurate(likelihood, problem, emulation)
    return replace(emulation, box=ranges), points, roots


def _with_bias(
    problem: EmulationProblem,
    likelihood: SpecimenLikelihood,
    emulation: Emulation,
    z: Floats,
    ranges: Floats,
) -> Emulation:
    """Return the emulation with the bias of left-out errors at coordinates within the ranges.

    Zero without any: the table is refused then, as it does not cover the specimens.
    """
    inside = z[_is_inside(z, ranges)]
    jacobian = emulation.surface(inside)[1]
    rows = np.isfinite(jacobian).all(axis=(1, 2))  # not beside failed runs
    if rows.sum() < 2:
        return replace(emulation, bias=0.0)
    misfit = OfTables.of(likelihood, LeftOut)(inside[rows])
    bias = shift_by_misfit(problem, emulation.error, misfit, jacobian[rows], inside[rows])
    # The error of the comparison, if it is too large, narrows the population by half its share of
    # the variance. Beside a turning point its linear form for each root would be far too large.
    share = float((emulation.error / problem.readings.robust_spread()).max())
    narrowing = np.sqrt(len(problem.readings) / 2) * share**2
    return replace(emulation, bias=max(bias, narrowing))


def _surface(problem: EmulationProblem, likelihood: SpecimenLikelihood) -> tuple[Emulation, Floats]:
    """Return the surface through the runs, with a wider box of the search, and their ranges."""
    coordinates, bounds = likelihood.coordinates, likelihood.coordinates.bounds
    runs, lows, highs = [], [], []
    for m in likelihood.measurements:
        table = _table(m)
        domain = table.surrogate.domain
        places = [m.responses.inputs.arguments.index(a) for a in range(len(m.inputs.aleatory))]
        values = domain.arguments(table.points)
        runs.append(coordinates.of([values[place] for place in places], 1))
        lows.append(coordinates.of([domain.inputs[place].low for place in places], 0))
        highs.append(coordinates.of([domain.inputs[place].high for place in places], 0))
    low, high = np.max(lows, axis=0), np.min(highs, axis=0)
    # An input with a logarithmic coordinate may be negative in the table.
    low = np.where(np.isfinite(low), low, bounds[0])
    ranges = np.stack([low, high])
    box = np.stack([np.maximum(bounds[0], low - (high - low) / 2), bounds[1]])
    box[1] = np.minimum(bounds[1], high + (high - low) / 2)
    if (box[0] >= box[1]).any():
        names = _columns(likelihood)
        prior = _as_inputs(coordinates, bounds)
        table_ends = _as_inputs(coordinates, ranges)
        j = int(np.argmax(box[0] >= box[1]))
        raise DesignError(
            f"{likelihood.name}: got runs with {names[j]} from {table_ends[0, j]:.4g} to "
            f"{table_ends[1, j]:.4g}, and a prior of {prior[0, j]:.4g} to {prior[1, j]:.4g}, "
            "expected ranges that overlap; check the units, and the order of the inputs"
        )
    z = np.unique(np.concatenate(runs), axis=0)
    z = z[np.isfinite(z).all(axis=1)]
    y = problem.run(z)
    residuals = OfTables.of(likelihood, LeftOut)(z[near_readings(y, problem.readings)])
    error = _error(problem, residuals)
    # The noise of a process in double precision is far below its change over a thousandth.
    surface = DifferencedResponse(OfTables.of(likelihood, Continued), step=1e-3)
    whole = np.stack([np.full(len(low), -np.inf), np.full(len(low), np.inf)])
    return Emulation(z, y, box, surface, error, np.inf, whole), ranges


def _error(problem: EmulationProblem, residuals: Floats) -> Floats:
    """Return the error of the surface by output, (m,), from left-out residuals (n, m)."""
    error = 2 * np.sqrt((residuals**2).mean(axis=0))
    return np.asarray(np.maximum(error, problem.options.floor * problem.readings.spread()))


def _is_inside(z: Floats, ranges: Floats) -> NDArray[np.bool_]:
    """Return which coordinates (..., d) are within the ranges of the runs, up to rounding."""
    slack = 1e-9 * (ranges[1] - ranges[0])
    return np.asarray(((z >= ranges[0] - slack) & (z <= ranges[1] + slack)).all(axis=-1))


def _require_cover(
    likelihood: SpecimenLikelihood,
    points: SpecimenPoints,
    draws: Draws,
    specimens: Floats,
    ranges: Floats,
) -> None:
    """Raise if the likelihood of a specimen, or 5 % of that of all, is from outside the ranges."""
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
    """Return the inputs that the data ask for beyond the ranges of the runs."""
    coordinates = likelihood.coordinates
    ends = _as_inputs(coordinates, ranges)
    asked = np.quantile(_as_inputs(coordinates, specimens), [0.005, 0.995], axis=0)
    parts = [
        f"{name} from {low:.4g} to {high:.4g}, where the runs have {least:.4g} to {most:.4g}"
        for name, low, high, least, most in zip(_columns(likelihood), *asked, *ends, strict=True)
        if low < least or high > most
    ]
    return "; ".join(parts) or "the corners of the ranges"


def _require_accurate(
    likelihood: SpecimenLikelihood, problem: EmulationProblem, emulation: Emulation
) -> None:
    """Raise if the error of the surface is as large as the scatter, or shifts populations."""
    share = float((emulation.error / problem.readings.robust_spread()).max())
    if emulation.bias <= problem.options.bias and share < 1:
        return
    shift = f"{emulation.bias:.2g}" if emulation.bias < 100 else "100 and more"
    raise DesignError(
        f"{likelihood.name}: got a surface through {len(emulation.z)} runs with a cross-validated "
        f"error of {share / 2:.2g} standard deviations of the readings, which would shift a mean "
        f"or standard deviation of an input by {shift} posterior standard deviations, "
        f"expected at most {problem.options.bias}; prb.propose_runs(model) returns a table of runs "
        "to add near the specimens"
    )


def _table(measurement: Measurement) -> Runs:
    return cast(Runs, measurement.responses.function)


def _columns(likelihood: SpecimenLikelihood) -> list[str]:
    """Return the name of each aleatory number, as in the table."""
    m = likelihood.measurements[0]
    names: list[str] = []
    table = _table(m)
    for a in range(len(m.inputs.aleatory)):
        r = table.surrogate.domain.inputs[m.responses.inputs.arguments.index(a)]
        names += [r.name] if not r.event else [f"{r.name}[{i}]" for i in range(r.size)]
    return names


def _as_inputs(coordinates: Coordinates, z: Floats) -> Floats:
    """Return the inputs of coordinates in columns, (k, d)."""
    parts: Sequence[Floats] = coordinates.inputs(z)
    return np.concatenate([x.reshape(len(z), -1) for x in parts], axis=1)
