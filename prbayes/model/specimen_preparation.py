"""Importance points of measured specimens, from runs and an emulator.

The log-likelihood by specimen is computed at these points. They contain no hyperparameter.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from prbayes._finding import Finding, report
from prbayes._validate import Floats
from prbayes.model.data_checks import (
    data_findings,
    emulator_findings,
    misfit_findings,
    refuse_scatter,
    refuse_undetermined,
    refuse_unreachable,
    refuse_unused_inputs,
    unreached,
)
from prbayes.model.measurement import SpecimenLikelihood
from prbayes.model.population_draws import Populations
from prbayes.propagation.base import DesignError
from prbayes.propagation.fibre_points import fibre_points
from prbayes.propagation.response_share import ResponseShare, response_share
from prbayes.propagation.specimen_emulation import Emulation, emulate
from prbayes.propagation.specimen_points import SpecimenPoints, draw_points
from prbayes.response.budget import duration
from prbayes.response.inputs import aleatory_names
from prbayes.response.response import Responses

_log = logging.getLogger("prbayes")


@dataclass(frozen=True, eq=False)
class Preparation:
    """Emulator and importance points of measured specimens."""

    emulation: Emulation
    points: SpecimenPoints
    findings: tuple[Finding, ...]  # about the data and the runs, before the fit
    share: ResponseShare | None  # of a population with a response, if it matters


def prepared(likelihood: SpecimenLikelihood) -> Preparation:
    """Return the emulator and the points of a likelihood; the first call computes the runs.

    Raise DesignError or ResponseError if the response does not allow the likelihood.
    """
    preparation: Preparation = likelihood.cached("preparation", lambda: _prepare(likelihood))
    return preparation


def is_prepared(likelihood: SpecimenLikelihood) -> bool:
    """Return whether the points of a likelihood are computed."""
    return "preparation" in likelihood.cache


def first_run_count(likelihood: SpecimenLikelihood) -> int | None:
    """Return the largest number of first runs that a simulator requires, None for the default."""
    numbers = [m.propagation.emulator_runs for m in likelihood.measurements]
    return max((n for n in numbers if n is not None), default=None)


def _prepare(likelihood: SpecimenLikelihood) -> Preparation:
    """Compute runs, emulator and points; log how many runs there are."""
    responses = [m.responses for m in likelihood.measurements]
    for response in responses:
        response.on_start = partial(_log_first_runs, likelihood, response)
    populations = Populations(likelihood)
    runs = Runs(likelihood)
    options = likelihood.options
    try:
        emulation, points, findings = _emulate(runs, populations, likelihood.shared_emulation)
        refined, share = response_share(
            runs,
            emulation,
            populations.prior_specimens,
            lambda share: populations.posterior(points.z, points.log_a, share=share),
            options,
            name=likelihood.name,
        )
        if refined is not emulation and not _is_partial(likelihood):
            # Specimens beside the failing region have points on its right side now.
            refined, points, findings = _emulate(runs, populations, refined)
        return Preparation(refined, points, report(*findings), share)
    except DesignError as error:
        causes = "" if runs.first is None else unreached(runs.first, likelihood.readings)
        for finding in _data_findings(likelihood, several_roots=False):
            causes += f". {finding}"
        raise DesignError(f"{error}{causes}") from None
    finally:
        for response in responses:
            response.on_start = None


def _log_first_runs(
    likelihood: SpecimenLikelihood, responses: Responses, runs: int, seconds: float
) -> None:
    """Log how many runs there are, how long they take, and which number changes them."""
    responses.on_start = None
    total = np.ceil(runs / responses.workers) * seconds
    time = f", about {duration(float(total))}" if total >= 1 else ""
    _log.info(
        "%s: runs at first: %d%s; then %d at a time at the roots of the specimens; to change "
        "this, pass another number in propagation=prb.Reweighted(n=%d)",
        responses.name,
        runs,
        time,
        max(runs // 2, likelihood.options.fresh),
        runs,
    )


@dataclass(eq=False)
class Runs:
    """Outputs of runs at coordinates; checks the first ones for scatter, range and influence."""

    likelihood: SpecimenLikelihood
    first: Floats | None = None  # (n, M): outputs of the first runs

    def __call__(self, z: Floats) -> Floats:
        """Return outputs of runs, (n, d) -> (n, M): NaN without response, +inf for a failure."""
        likelihood = self.likelihood
        responses = [m.responses for m in likelihood.measurements]
        n_computed = sum(response.computed for response in responses)
        inputs = likelihood.coordinates.inputs(z)
        parts = [response(inputs, []).reshape(len(z), -1) for response in responses]
        values = np.concatenate(parts, axis=1)
        values = np.where(np.isneginf(values), np.nan, values)
        if likelihood.shared_emulation is None and self.first is None:
            if sum(response.computed for response in responses) > n_computed:

                def alone(row: int) -> Floats:
                    inputs = likelihood.coordinates.inputs(z[row : row + 1])
                    return np.concatenate([r.alone(inputs).ravel() for r in responses])

                refuse_scatter(likelihood.name, values, alone)
            refuse_unreachable(likelihood.name, values, likelihood.readings)
            refuse_unused_inputs(likelihood.name, z, values, _coordinate_names(likelihood))
            self.first = values
        return values


def _coordinate_names(likelihood: SpecimenLikelihood) -> list[str]:
    """Return the name of the input of each coordinate."""
    inputs = likelihood.inputs
    names = aleatory_names(inputs, likelihood.measurements[0].responses.function)
    sizes = [int(np.prod(shape, dtype=int)) for shape in inputs.event_shapes]
    return [name for name, size in zip(names, sizes, strict=True) for _ in range(size)]


def _is_partial(likelihood: SpecimenLikelihood) -> bool:
    """Return whether a specimen has fewer readings, censored ones included, than inputs."""
    present = likelihood.readings.is_measured | likelihood.readings.is_censored
    return bool((present.sum(axis=1) < likelihood.coordinates.size).any())


def _emulate(
    runs: Runs, populations: Populations, emulation: Emulation | None
) -> tuple[Emulation, SpecimenPoints, Sequence[Finding]]:
    """Return the emulator, the points and findings of both."""
    likelihood = runs.likelihood
    name, options, readings = likelihood.name, likelihood.options, likelihood.readings
    bounds, d = likelihood.coordinates.bounds, likelihood.coordinates.size
    n = first_run_count(likelihood)
    if _is_partial(likelihood):
        if likelihood.calls_response:
            raise TypeError(
                f"{name}: propagation: got prb.Resimulated, expected stored responses where "
                "specimens have fewer readings than inputs; leave propagation= out"
            )
        emulation, points = fibre_points(
            runs,
            readings,
            bounds,
            populations.prior_specimens(),
            populations.posterior,
            options,
            n=n,
            name=name,
        )
        return emulation, points, _data_findings(likelihood, several_roots=True)
    box = np.stack([-np.ones(d), np.ones(d)])
    if likelihood.calls_response:
        emulation = Emulation.of_function(runs, box, bounds, readings, options)
    emulation, roots = emulate(
        runs, readings, box, bounds, options, n=n, known=emulation, name=name
    )
    if not likelihood.calls_response:
        refuse_undetermined(name, emulation, roots, _coordinate_names(likelihood))
    points = draw_points(
        emulation,
        emulation.error,
        readings,
        roots,
        emulation.box,
        options,
        error_is_known=likelihood.error_is_known,
    )
    findings: list[Finding] = [
        *_data_findings(likelihood, several_roots=bool((points.n_roots > 1).any())),
        *misfit_findings(name, readings, roots, emulation.error),
        *emulator_findings(name, readings, emulation.error),
    ]
    return emulation, points, findings


def _data_findings(likelihood: SpecimenLikelihood, *, several_roots: bool) -> tuple[Finding, ...]:
    """Return findings of rounded, censored and repeated readings that are taken as exact."""
    findings: list[Finding] = []
    for m in likelihood.measurements:
        steps: Any = m.readings.step.max(axis=0)
        # A reading error that the user gives covers rounding.
        is_stated = (steps > 0) | (m.metric.error is not None)
        findings += data_findings(
            m.readings.values,
            labels=[f"{m.name}[{label}]" for label in m.outputs.names] or [m.name],
            several_roots=several_roots,
            rounded=np.where(is_stated, np.maximum(steps, 1e-300), np.nan),
        )
    return tuple(findings)
