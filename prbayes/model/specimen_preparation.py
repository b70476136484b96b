"""Importance points of measured specimens, from runs and an emulator.

Posterior draws of the hyperparameters, given such points, give the population in which fibres are
covered, and the unit of Monte Carlo errors.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from scipy.special import chdtri, logsumexp, ndtri

from prbayes._finding import Finding, Findings, any_of, report
from prbayes._stats import log_sum_exp
from prbayes._validate import AT_ONCE, IN_CACHE, ArrayFunction, Bools, Floats, Indices
from prbayes.emulators.runs import Runs
from prbayes.metrics.readings import has_error
from prbayes.model.data_checks import (
    check_failing_region,
    data_findings,
    emulator_findings,
    misfit_findings,
    outlier_findings,
    output_labels,
    refuse_unreachable,
    refuse_unreached,
    refuse_unused_inputs,
    repeat_findings,
)
from prbayes.model.measurement import (
    SpecimenLikelihood,
    has_random_response,
    is_exchangeable,
    output_columns,
    own_columns,
    readings_at,
    rows_by_context,
    selection_of,
    specimen_labels,
)
from prbayes.model.parameters import Hyperparameters, log_posterior, variables_at
from prbayes.model.random_variable import log_first_runs
from prbayes.model.remedies import remedies_of
from prbayes.model.run_coverage import coverage_findings
from prbayes.model.stochastic_likelihood import points_of_random_response, random_cost
from prbayes.model.table_likelihood import OfTables, points_of_tables
from prbayes.numerics.mixtures import StudentMixture
from prbayes.numerics.points import sobol
from prbayes.propagation.base import MAX_LOST, DesignError
from prbayes.response.budget import RunCost
from prbayes.response.inputs import aleatory_names
from prbayes.specimens.design import (
    emulate,
    first_runs,
    most_corrections,
    most_runs,
    refuse_at_end,
    shares_of_distance,
)
from prbayes.specimens.emulation import DifferencedResponse, Emulation
from prbayes.specimens.points import (
    Draws,
    Plausible,
    SpecimenData,
    SpecimenPoints,
    at_scale,
    draw_points,
    fit_proposals,
    likely_scale,
    likely_weights,
    normal_of,
    of_all_specimens,
    reading_change,
    specimen_points,
    typical_specimens,
)
from prbayes.specimens.proposals import Normal, Proposals, mode_coordinates
from prbayes.specimens.response_share import ResponseShare, renewed_share, response_share
from prbayes.specimens.selection import Selection
from prbayes.specimens.shared_points import PointMass, PopulationShare
from prbayes.specimens.weighted_points import WeightedPoints


@dataclass(frozen=True, eq=False)
class Preparation:
    """Emulator and importance points of measured specimens."""

    emulation: Emulation
    points: SpecimenPoints
    # Proposals from which the points were drawn; None where specimens share their points.
    proposals: Proposals | None
    # (S, p): posterior draws at which the estimates from both halves of the points agree.
    thetas: Floats
    findings: Findings  # findings about the data and the runs, before the fit
    # Share of a population with a response; None if it hardly changes the log-likelihood.
    share: PopulationShare | None = None


def prepared(likelihood: SpecimenLikelihood) -> Preparation:
    """Return the emulator and the points of a likelihood; the first call computes the runs.

    Raise DesignError or ResponseError if the response does not allow the likelihood.
    """
    if "preparation" not in likelihood.cache:
        likelihood.cache["preparation"] = _prepare(likelihood)
    preparation: Preparation = likelihood.cache["preparation"]
    return preparation


def with_more_points(likelihood: SpecimenLikelihood, count: int = 256) -> SpecimenLikelihood:
    """Return the likelihood with at least so many points of each specimen; no run is needed.

    The log-likelihood of a population needs fewer points than the inputs of a specimen.
    """
    preparation = prepared(likelihood)
    if preparation.proposals is None or preparation.points.log_a.shape[1] >= count:
        return likelihood
    data = specimen_data(likelihood)
    points = draw_points(data, preparation.proposals, count, data.seed + 1)
    points = replace(points, scale=preparation.points.scale)
    result = replace(likelihood)
    result.cache["preparation"] = replace(preparation, points=points)
    return result


def with_specimens(
    likelihood: SpecimenLikelihood, observed: Floats, thetas: Floats
) -> tuple[SpecimenLikelihood, SpecimenLikelihood]:
    """Return the likelihood with further specimens, and that of these alone; no run is needed.

    Points of the specimens, whose readings are ``observed``, suffice at draws, (S, p).
    """
    (measurement,) = likelihood.measurements
    preparation = prepared(likelihood)
    together = np.concatenate([measurement.observed, observed])
    results = []
    for values in (together, observed):
        result = likelihood.observing({measurement.name: values})
        results.append(_of_same_populations(result, likelihood))
    joint, added = results
    assert preparation.proposals is not None  # `update` refuses random responses
    data, reference = specimen_data(added), preparation.proposals.residuals.population
    proposals = fit_proposals(data, preparation.emulation, reference)
    count = data.options.points * proposals.modes.table.shape[1]
    if proposals.is_open():
        count = max(count, preparation.points.log_a.shape[1] // 2)
    rows = np.linspace(0, len(thetas) - 1, 256).round().astype(int)
    populations = SpecimenPopulations(added)
    draws = PopulationDraws(populations, thetas[rows])
    first = draw_points(data, proposals, 2 * count, data.seed)
    scale = likely_scale(data, first, preparation.emulation.error)
    if not proposals.is_open():
        # Points need not agree at populations of the first specimens that the new ones exclude.
        error, finer = preparation.emulation.error, max(2 * count, 512)
        points = at_scale(data, draw_points(data, proposals, finer, data.seed), error, scale)
        logs = populations.log_likelihoods(thetas[rows], points.z, points.log_a).sum(axis=1)
        is_likely = (logs >= np.median(logs)) | (logs > logs.max() - 20.0)
        draws = PopulationDraws(populations, thetas[rows[is_likely]])
    points, proposals = Plausible(draws, proposals, first, scale, count).agreeing(data)
    gross_errors = measurement.gross_errors is not False
    misfits = misfit_findings(
        likelihood.name,
        added.readings,
        proposals.modes,
        preparation.emulation.error,
        gross_errors=gross_errors,
    )
    added.cache["preparation"] = replace(
        preparation, points=points, proposals=proposals, findings=tuple(misfits)
    )
    joint.cache["preparation"] = replace(
        preparation, points=of_all_specimens(preparation.points, points)
    )
    return joint, added


def with_emulator(likelihood: SpecimenLikelihood, other: SpecimenLikelihood) -> SpecimenLikelihood:
    """Return the likelihood without points, with the shared emulator of another one."""
    result = replace(likelihood, shared_emulation=other.shared_emulation)
    return _of_same_populations(result, likelihood)


def _of_same_populations(
    likelihood: SpecimenLikelihood, other: SpecimenLikelihood
) -> SpecimenLikelihood:
    """Give a likelihood what does not depend on the specimens: coordinates, compiled functions."""
    vars(likelihood).update(density=other.density, coordinates=other.coordinates)
    if "hyperparameters" in other.cache:
        likelihood.cache["hyperparameters"] = other.cache["hyperparameters"]
    return likelihood


def is_prepared(likelihood: SpecimenLikelihood) -> bool:
    """Return whether the points of a likelihood are computed."""
    return "preparation" in likelihood.cache


def refuse_changed_runs(likelihood: SpecimenLikelihood) -> None:
    """Raise if a response has changed since the emulator's runs, and differs from them."""
    for m in likelihood.measurements:
        if is_prepared(likelihood) and m.responses.may_differ:
            emulation = prepared(likelihood).emulation
            points = likelihood.coordinates.inputs_of_runs(emulation.z)
            y = emulation.y[:, output_columns(likelihood, m)].reshape(-1, *m.event)
            m.responses.refuse_change(points, y, m.responses)


def first_run_count(likelihood: SpecimenLikelihood) -> int | None:
    """Return the largest number of first runs that a simulator requires, None for the default."""
    numbers = [m.propagation.emulator_runs for m in likelihood.measurements]
    return max((n for n in numbers if n is not None), default=None)


def emulator_cost(likelihood: SpecimenLikelihood) -> RunCost:
    """Return the runs for the emulator of a log-likelihood by specimen."""
    if likelihood.has_table:
        n = len(prepared(likelihood).emulation.z) if is_prepared(likelihood) else 0
        return RunCost(n, 0, n, "none: the table has all runs")
    if has_random_response(likelihood):
        return random_cost(likelihood, first_run_count(likelihood))
    first = first_run_count(likelihood) or first_runs(likelihood.coordinates.size)
    batch = max(first // 2, likelihood.options.sampled + 2)
    computed = len(prepared(likelihood).emulation.z) if is_prepared(likelihood) else 0
    least = first + 2 * batch
    most = most_runs(likelihood.coordinates.size) + (first_run_count(likelihood) or 0)
    growth = (
        f"{least} to {most} in all, in batches at the specimens' likely inputs, until the "
        f"emulator shifts no estimate by more than {likelihood.options.bias} standard deviations"
    )
    further = most_corrections(len(likelihood.readings), likelihood.coordinates.size)
    if further:
        growth += f"; {further} more at the specimens' inputs if the response has a kink or a jump"
    return RunCost(max(least, computed), 0, most + further, growth)


def _prepare(likelihood: SpecimenLikelihood) -> Preparation:
    """Compute runs, emulator and points; log the number of runs."""
    responses = [m.responses for m in likelihood.measurements]
    cost = emulator_cost(likelihood)
    n = first_run_count(likelihood) or first_runs(likelihood.coordinates.size)
    for response in responses if not likelihood.has_table else []:
        response.on_start = partial(log_first_runs, cost, f"Reweighted(n={n})", response)
    runs = CheckedRuns(likelihood)
    try:
        data = specimen_data(likelihood)
        selection = selection_of(likelihood.measurements)
        first = _emulate(runs, data, likelihood.shared_emulation)
        if any(finding.code == "readings-misfit" for finding in first.findings):
            refuse_unreached(likelihood.name, first.emulation.y, likelihood.readings)
        points = first.points
        if has_random_response(likelihood):
            return replace(first, findings=report(*runs.findings, *first.findings))

        def posterior(share: PopulationShare | None, emulation: Emulation) -> PopulationDraws:
            if share is not None:
                _refuse_own_responses(likelihood, data, selection)
            # Both have the same emulator. Otherwise populations at which only the earlier one
            # reaches the readings, and the later one the limits, would be likely.
            log_a = points.log_a + reading_change(data, points, first.emulation, emulation)
            return SpecimenPopulations(likelihood).posterior(points.z, log_a, share=share)

        # Calls of a table's surface do not count as runs.
        run = OfTables.of(likelihood, Runs.__call__) if likelihood.has_table else runs
        for _ in range(4):
            refined, share = response_share(run, data, first.emulation, posterior, selection)
            if refined is first.emulation or likelihood.has_table:
                break
            # The refined emulator is accurate beside the region where runs fail, so that points of
            # specimens there are on the right side of its boundary. Populations of a selection are
            # wider than those of the measured specimens.
            if selection is not None:
                of_share = partial(SpecimenPopulations(likelihood).posterior, share=share)
                data = replace(data, posterior=of_share)
            first = _emulate(runs, data, refined)
            if selection is None or share is None:
                break
            # Wider populations reach inputs at which the earlier emulator was wrong.
            change = _share_change(likelihood, data, first, share, selection)
            if change <= 2 * data.options.half_difference:
                break
            points = first.points
        else:
            raise DesignError(
                f"{likelihood.name}: got a probability of being measured that still changes the "
                f"log-likelihood by {change:.2g} nats after {len(first.emulation.z)} runs, "
                f"expected at most {2 * data.options.half_difference:.2g}: the likely populations "
                "reach far beyond the limits of selected=; narrow the priors"
            )
        return replace(first, findings=report(*runs.findings, *first.findings), share=share)
    except DesignError as error:
        if likelihood.has_table:
            raise
        outputs = np.concatenate(runs.outputs) if runs.outputs else np.empty((0, 0))
        _refuse_missing_outputs(likelihood, outputs, error)
        # The first runs are checked alone as well, because later runs may be far from the priors.
        for of_runs in (outputs, *runs.outputs[:1]):
            refuse_unreached(likelihood.name, of_runs, likelihood.readings)
        checked = _data_findings(likelihood, outputs, several_roots=False)
        cause = "".join(finding.text.removesuffix(".") for finding in checked[:1])
        raise DesignError(f"{cause}. Therefore: {error}" if cause else str(error)) from None
    finally:
        for response in responses:
            response.on_start = None


def _share_change(
    likelihood: SpecimenLikelihood,
    data: SpecimenData,
    preparation: Preparation,
    share: ResponseShare,
    selection: Selection,
) -> float:
    """Return by how much the log share of a selection changes with the last emulator, in nats."""
    draws = PopulationDraws(SpecimenPopulations(likelihood), preparation.thetas)
    renewed = renewed_share(data, preparation.emulation, draws.specimens(), share, selection)
    return float(np.std(draws.log_share(renewed) - draws.log_share(share)))


def _refuse_own_responses(
    likelihood: SpecimenLikelihood, data: SpecimenData, selection: Selection | None
) -> None:
    """Raise if specimens have conditions or functions of their own, beside a share."""
    if not likelihood.inputs.conditions and data.columns is None:
        return
    got, advice = (
        "NaN from the response for a share of the population that is not negligible",
        "return inf there if these specimens fail, or a number beside all readings",
    )
    if selection is not None:
        got, advice = "selected=", "pass the condition as a constant, or no limits"
    raise DesignError(
        f"{likelihood.name}: got {got}, expected a response of all specimens with conditions or "
        f"functions of their own, on which that share depends; {advice}"
    )


def _refuse_missing_outputs(
    likelihood: SpecimenLikelihood, outputs: Floats, error: DesignError
) -> None:
    """Raise if functions by specimen returned NaN, which an error that follows does not name."""
    count = int(np.isnan(outputs).any(axis=1).sum())
    if own_columns(likelihood) is not None and count:
        raise DesignError(
            f"{likelihood.name}: got NaN in {count} of {len(outputs)} runs, expected numbers from "
            "the functions of all specimens: where one of them returns NaN, a run counts for no "
            f"specimen; return a number beside all readings there. Therefore: {error}"
        ) from None


@dataclass(eq=False)
class CheckedRuns:
    """Outputs of runs at coordinates; checks the first ones for range and influence."""

    likelihood: SpecimenLikelihood
    outputs: list[Floats] = field(default_factory=list)  # outputs of each batch of runs, (n, M)
    findings: Findings = ()  # findings about the first runs

    def __call__(self, z: Floats) -> Floats:
        """Return outputs of runs, (n, d) -> (n, M): NaN without response, +inf for a failure."""
        likelihood = self.likelihood
        measurements = likelihood.measurements
        inputs = likelihood.coordinates.inputs_of_runs(z)
        parts = []
        for m in measurements:
            with m.responses.kept_runs():
                parts.append(m.responses(inputs, []).reshape(len(z), -1))
        values = np.concatenate(parts, axis=1)
        if likelihood.shared_emulation is None and not self.outputs:
            refuse_unreachable(likelihood.name, values, likelihood.readings)
            names = dict(enumerate(_coordinate_names(likelihood)))
            of_population = {k: names[k] for k in likelihood.coordinates.inputs_of_population}
            if not has_random_response(likelihood):
                refuse_unused_inputs(likelihood.name, z, values, of_population)
            if not any(
                m.metric.error is not None or m.gross_errors is not False for m in measurements
            ):
                self.findings = check_failing_region(
                    likelihood.name,
                    likelihood.readings.values,
                    [z],
                    values,
                    max(getattr(m.propagation, "max_lost", MAX_LOST) for m in measurements),
                )
        self.outputs.append(values)
        return values


def _coordinate_names(likelihood: SpecimenLikelihood) -> list[str]:
    """Return the name of the input of each coordinate."""
    inputs = likelihood.inputs
    names = aleatory_names(inputs, likelihood.measurements[0].responses.function)
    sizes = [int(np.prod(shape, dtype=int)) for shape in inputs.event_shapes]
    return [name for name, size in zip(names, sizes, strict=True) for _ in range(size)]


def _error_scales(likelihood: SpecimenLikelihood) -> Floats:
    """Return factors of the reading errors that span 98 % of the prior of unknown errors, (J, M).

    Outputs with the same unknown parameters have the same factor; (J, 1) if all outputs have.
    """
    columns: dict[Any, list[int]] = {}
    ends: dict[Any, list[Floats]] = {}
    first = 0
    for m in likelihood.measurements:
        width = m.rows.shape[1]
        sd = [readings_at(m, p, 2048) for p in (0.01, 0.84, 0.99)] if m.unknown else []
        errors = [r.error_sd(np.nan_to_num(r.values)) for r in sd]
        by_output = [v for v in m.unknown.values() if v.type.shape not in ((), (1,))]
        for k in range(width):
            place = k if by_output else 0
            key = (*m.unknown.values(), place) if m.unknown else ()
            columns.setdefault(key, []).append(first + k)
            if not errors:
                continue
            low, middle, high = (error[:, k] for error in errors)
            usable = middle > 0
            of_key = ends.setdefault(key, [])
            of_key.append(low[usable] / middle[usable])
            of_key.append(high[usable] / middle[usable])
        first += width
    joined = {key: np.concatenate(values) for key, values in ends.items()}
    ranges = {key: (values.min(), values.max()) for key, values in joined.items() if values.size}
    if not ranges:
        return np.ones((1, 1))
    rows = factor_design([*ranges.values()])
    if len(columns) == 1:
        return rows
    result = np.ones((len(rows), first))
    for key, row in zip(ranges, rows.T, strict=True):
        result[:, columns[key]] = row[:, None]
    return result


def factor_design(ranges: Sequence[tuple[float, float]]) -> Floats:
    """Return factors of several errors between the ends of each, (J, G), from larger ones on.

    One error has a ladder of steps by a factor of three. Two or three have all combinations of
    coarse ladders, because coarser proposals that are fewer have more points each. More errors
    have a common ladder, and ladders of each error beside the largest of the others.
    """
    low, high = np.log(np.array(ranges)).T
    count = len(low)

    def ladder(k: int, step: float, most: int) -> Floats:
        width = high[k] - low[k]
        steps = np.ceil(width / np.log(step))
        size = min(1 + int(steps), most)
        return np.linspace(0.0, 1.0, size)

    if count == 1:
        places = ladder(0, 3.0, 99)[:, None]
    elif count <= 3:
        ladders = [ladder(k, 16.0, 6 - count) for k in range(count)]
        grids = np.meshgrid(*ladders, indexing="ij")
        places = np.stack([grid.ravel() for grid in grids], axis=-1)
    else:
        widest = int(np.argmax(high - low))
        common = ladder(widest, 3.0, 99)[:, None] * np.ones(count)
        alone = np.eye(count)
        places = np.concatenate([common, 0.5 * alone, alone])
    logs = high + (low - high) * places
    order = np.argsort(-logs.sum(axis=1), kind="stable")
    rows = np.exp(logs[order])
    return np.asarray(rows)


def specimen_data(likelihood: SpecimenLikelihood) -> SpecimenData:
    """Return the specimens, what is known of them, and the populations of the model."""
    populations = SpecimenPopulations(likelihood)
    coordinates, conditions = likelihood.coordinates, likelihood.stacked.coordinates
    known = np.full((len(likelihood.readings), coordinates.size), np.nan)
    if conditions is not None:
        known[:, coordinates.is_condition] = conditions
    options = replace(likelihood.options, n_first=first_run_count(likelihood))
    if any("bias" in m.unknown for m in likelihood.measurements):
        # Errors of all specimens add up if they have a bias in common, which halves do not show.
        options = replace(options, points=4 * options.points)
    if np.isfinite(coordinates.ends).any() and len(coordinates.inputs_of_population) == 1:
        # Near the end of an input's range, the error of the input counts relative to the distance
        # from the end, so that the surface has to be more accurate. With several inputs the normal
        # equations would lose these digits.
        options = replace(options, floor=1e-3 * options.floor)
    return SpecimenData(
        likelihood.readings,
        known,
        populations.prior_specimens(),
        populations.posterior,
        coordinates,
        populations.order(),
        scales=_error_scales(likelihood),
        gross_errors=likelihood.measurements[0].gross_errors is not False,
        options=options,
        name=likelihood.name,
        output_names=tuple(
            label
            for m in likelihood.measurements
            for label in output_labels(m.name, m.outputs.names)
        ),
        labels=specimen_labels(likelihood),
        remedies=partial(remedies_of, likelihood),
        draws=partial(PopulationDraws, populations),
        columns=own_columns(likelihood),
    )


def _emulate(runs: CheckedRuns, data: SpecimenData, emulation: Emulation | None) -> Preparation:
    """Fit the emulator and place the points; return both with their findings."""
    likelihood = runs.likelihood
    if has_random_response(likelihood):
        shared = points_of_random_response(runs, data, likelihood, emulation)
        of_data = _data_findings(likelihood, shared.emulation.y, several_roots=False)
        findings = (*shared.findings, *of_data)
        thetas, mass = shared.draws.thetas, PointMass.of(shared.points)
        return Preparation(shared.emulation, shared.points, None, thetas, findings, mass)
    if likelihood.has_table:
        emulation, points, proposals, draws = points_of_tables(data, likelihood)
    elif likelihood.calls_response:
        error = data.options.floor * data.readings.spread()
        z = data.inner[:: len(data.inner) // 64]
        bounds = likelihood.coordinates.bounds
        emulation = Emulation(z, runs(z), DifferencedResponse(runs), error, 0.0, bounds)
        population = normal_of(data.inner[:, data.free])
        points, proposals, draws = specimen_points(data, emulation, population)
    else:
        emulation, points, proposals, draws = emulate(runs, data, emulation, _part(likelihood))
    name, readings, error = likelihood.name, likelihood.readings, emulation.error
    several_roots = bool((points.n_roots > 1).any())
    gross_errors = likelihood.measurements[0].gross_errors is not False
    findings = (
        *_data_findings(likelihood, emulation.y, several_roots=several_roots),
        *misfit_findings(name, readings, proposals.modes, error, gross_errors=gross_errors),
        *emulator_findings(name, readings, error, data.remedies),
        *coverage_findings(likelihood, data, points, draws.specimens()),
        *_end_findings(runs, data, emulation, points, proposals, draws),
        *_root_findings(data, proposals),
        *error_findings(likelihood),
        *flat_findings(data, proposals, normal_of(draws.specimens()[:, data.free])),
    )
    return Preparation(emulation, points, proposals, draws.thetas, findings)


def _root_findings(data: SpecimenData, proposals: Proposals) -> list[Finding]:
    """Report readings with more values of the only input in the prior's centre than a fold has.

    Narrow populations around some of these may be as likely as the one that is found.
    """
    if len(data.free) > 1 or len(data.scales) > 1 or proposals.is_open():
        return []
    modes = proposals.modes
    z = mode_coordinates(proposals)[:, data.free]
    low, high = np.quantile(data.prior[:, data.free], [0.1, 0.9], axis=0)
    is_central = ((z >= low) & (z <= high)).all(axis=1)
    counts = np.bincount(modes.specimen, is_central & modes.is_stationary())
    share = (counts > 2).mean()
    if share < 0.1:
        return []
    text = (
        f"{data.name}: got {share:.0%} of the readings with three or more values of the input in "
        "the centre of its prior, expected at most two: narrow populations of some of them may be "
        "missing; narrow the prior, or compare models with a prior around each."
    )
    return [Finding("second-mode", text, "likelihood_findings.md#several-modes")]


def error_findings(likelihood: SpecimenLikelihood) -> list[Finding]:
    """Report more unknown errors than have points for all combinations of small and large ones."""
    sizes = {
        m.unknown["error"]: m.readings.values.shape[1] if m.unknown["error"].type.ndim else 1
        for m in likelihood.measurements
        if "error" in m.unknown
    }
    count, n_inputs = sum(sizes.values()), len(likelihood.coordinates.inputs_of_population)
    if count <= 2 or (count == 3 and n_inputs <= 2):
        return []
    text = (
        f"{likelihood.name}: got {count} unknown errors of readings of {n_inputs} inputs, expected "
        "at most two, or three of two inputs: where some of them are far smaller than the others "
        "the log-likelihood is inaccurate; scale outputs and readings so that one error= serves "
        "several, or pass known errors."
    )
    return [Finding("several-errors", text, "measurement_error.md#what-it-changes")]


def flat_findings(
    data: SpecimenData, proposals: Proposals, population: Normal, largest: float = 0.1
) -> list[Finding]:
    """Report an exact reading that hardly tells the input, because the emulator has an error."""
    modes, readings = proposals.modes, data.readings
    is_inexact = has_error(readings) | (readings.step > 0) | (readings.family >= 0)
    is_exact = (~is_inexact | ~readings.is_measured).all(axis=1) & ~readings.is_censored.any(axis=1)
    is_exact &= readings.is_measured.sum(axis=1) >= len(data.free)
    if data.gross_errors or not is_exact.any():
        return []
    change = np.linalg.solve(proposals.residuals.population.root, population.root)
    precision = np.linalg.svd(modes.slopes @ change, compute_uv=False)[:, -1]
    best = np.zeros(len(readings))
    np.maximum.at(best, modes.specimen, precision)
    misfit = np.full(len(readings), np.inf)
    np.minimum.at(misfit, modes.specimen, modes.misfit)
    best[~is_exact | (misfit > 50)] = (
        np.inf
    )  # readings that no inputs reproduce are another finding
    row = int(best.argmin())
    if best[row] * largest >= 1:
        return []
    label = row if data.labels is None else data.labels[row]
    text = (
        f"{data.name}: got an exact reading of specimen {label} that gives the input to "
        f"{1 / max(best[row], 0.1):.1g} standard deviations of the population, expected at most "
        f"{largest}: the emulator has an error of a millionth of the readings' scatter at least; "
        "take logarithms of readings and response that span orders of magnitude, or pass "
        "metric=prb.LogLikelihood(error=...)."
    )
    return [Finding("emulator-error", text, "likelihood_findings.md#emulator-error")]


def _part(likelihood: SpecimenLikelihood, size: int = 512) -> SpecimenData | None:
    """Return evenly spaced specimens by their first reading; None if there are not many more."""
    n = len(likelihood.readings)
    if n <= 2 * size or not is_exchangeable(likelihood):
        return None
    order = np.argsort(likelihood.readings.values[:, 0], kind="stable")
    rows = order[np.linspace(0, n - 1, size).astype(np.intp)]
    part = specimen_data(likelihood.of_rows(rows))
    # Estimates from a part scatter more, so that the same bias is a smaller share of their scatter.
    bias = part.options.bias * np.sqrt(size / n)
    return replace(part, options=replace(part.options, bias=bias))


def _end_findings(
    runs: CheckedRuns,
    data: SpecimenData,
    emulation: Emulation,
    points: SpecimenPoints,
    proposals: Proposals,
    draws: Draws,
) -> list[Finding]:
    """Report specimens whose inputs are known worse than their distances from an end of the range.

    The end of an input with a logarithmic coordinate is zero. The error of such an input counts by
    the change of the populations' log-densities over posterior draws, from .1 nats on. It is zero
    of a density that is finite at the end. Raise DesignError if the error is nine tenths of the
    distance. A few runs are computed at inputs that are far below all others. Specimens that look
    like gross errors do not count.
    """
    likelihood, coordinates = runs.likelihood, runs.likelihood.coordinates
    population = normal_of(draws.specimens()[:, data.free])
    weights = likely_weights(data, points, population)
    likeliest = weights.argmax(axis=1)
    z = points.z[np.arange(len(weights)), likeliest]
    # Inputs at an end are moved inside, because slopes and densities are not defined there.
    z = np.clip(z, coordinates.ends[0] + 1e-12, coordinates.ends[1] - 1e-12)
    is_log = coordinates.is_log & ~coordinates.is_condition
    scale = np.where(is_log, 1 / coordinates.half_width, np.inf)
    to_ends = np.abs(coordinates.ends[:, None] - z)
    distance = np.minimum(to_ends.min(axis=0), scale)
    ended = [k for k in data.free if np.isfinite(distance[:, k]).all()]
    if not ended:
        return []
    # Secants, because the slopes of a surface say nothing of changes that are smaller than its
    # error.
    center, jacobian = emulation(z)
    jacobian[:, :, ended] = secants(emulation.values, center, z, distance, ended)
    shares = shares_of_distance(data, emulation.error, z, jacobian, scale)
    at_end = shares.max(axis=1) >= 0.9
    error = np.tile(emulation.error, (len(z), 1))
    rows = low_outliers(z, is_log)
    if rows.size and not (likelihood.has_table or likelihood.calls_response):
        without_error = np.zeros_like(emulation.error)
        by_readings = 3 * data.readings.comparison_sd(without_error)[rows]
        outputs = runs(z[rows])
        misfit = np.abs(outputs - data.readings.values[rows])
        error[rows] = np.fmax(error[rows], misfit - by_readings)
        slopes = secants(runs, outputs, z[rows], distance[rows], ended)
        jacobian[rows[:, None], :, ended] = np.moveaxis(slopes, -1, 1)
    shares = shares_of_distance(data, error, z, jacobian, scale).max(axis=1)
    if shares.max() <= 0.03:
        return []
    sides = two_sides(z, distance, ended)
    tilts = shares * log_density_changes(likelihood, draws.thetas, sides)
    if data.gross_errors:
        is_typical = typical_specimens(proposals.modes, len(z))
        tilts = np.where(is_typical, tilts, 0.0)
    worst = int(tilts.argmax())
    if not np.sqrt((tilts**2).sum()) > 0.1:
        return []
    if at_end[worst]:
        refuse_at_end(data, worst)
    return [end_finding(likelihood, data, worst, float(shares[worst]), float(tilts[worst]))]


def end_finding(
    likelihood: SpecimenLikelihood, data: SpecimenData, worst: int, share: float, tilt: float
) -> Finding:
    """Return the finding of a specimen whose input is known worse than its distance from an end.

    ``share`` is the error in units of the distance, ``tilt`` the change of the log-likelihood.
    """
    label = worst if data.labels is None else data.labels[worst]
    remedy = "pass metric=prb.LogLikelihood(error=...) with the error of the readings"
    if all(m.metric.error is not None for m in likelihood.measurements):
        remedy = any_of("narrow the priors", data.remedies()[0])
    text = (
        f"{likelihood.name}: the input of specimen {label} is so near an end of its range that the "
        f"emulator's error is {share:.0%} of the distance: posterior means may be off by "
        f"{tilt:.1g} standard deviations or more; {remedy}."
    )
    return Finding("emulator-error", text, "likelihood_findings.md#emulator-error")


def two_sides(z: Floats, distance: Floats, columns: list[int]) -> list[tuple[Floats, Floats]]:
    """Return points half a distance, (n, d), below and above z in each of the columns."""
    steps = [np.where(np.arange(z.shape[1]) == k, 0.5 * distance, 0.0) for k in columns]
    return [(z - step, z + step) for step in steps]


def secants(
    values: ArrayFunction, center: Floats, z: Floats, distance: Floats, columns: list[int]
) -> Floats:
    """Return the steeper slope of values (n, m) over half a distance to a side, (n, m, columns).

    ``center`` are the values at z, (n, d). Beside a turning point one of the slopes may be zero.
    """
    steeper = []
    for low, high in two_sides(z, distance, columns):
        below, above = center - values(low), values(high) - center
        sizes = [np.nan_to_num(np.abs(change)).max(axis=1) for change in (below, above)]
        is_above = sizes[1] > sizes[0]
        steeper.append(np.where(is_above[:, None], above, below))
    return np.asarray(2 * np.stack(steeper, axis=-1) / distance[:, None, columns])


def low_outliers(z: Floats, is_log: Bools) -> Indices:
    """Return at most two rows of z, (n, d), that are far below the others in a logarithmic column.

    They are more than six times as far below the median as the lower quartile.
    """
    low, middle = np.quantile(z, [0.25, 0.5], axis=0)
    depth = np.where(is_log, (middle - z) / np.maximum(middle - low, 1e-300), 0.0).max(axis=1)
    rows = np.argsort(-depth)[:2]
    return rows[depth[rows] > 6]


def log_density_changes(
    likelihood: SpecimenLikelihood, thetas: Floats, sides: Sequence[tuple[Floats, Floats]]
) -> Floats:
    """Return the largest standard deviation over thetas of changes of log-densities, (n,).

    The changes are those of the populations' log-densities between two points of each specimen.
    """
    density = partial(SpecimenPopulations(likelihood).log_likelihoods, thetas)
    deviations = []
    for points in sides:
        low, high = (density(z[:, None], np.zeros((len(z), 1))) for z in points)
        is_finite = np.isfinite(low) & np.isfinite(high)
        change = np.subtract(high, low, where=is_finite, out=np.zeros(low.shape))
        deviations.append(change.std(axis=0))
    return np.max(deviations, axis=0)


def _data_findings(
    likelihood: SpecimenLikelihood, outputs: Floats, *, several_roots: bool
) -> Findings:
    """Return findings about outliers, and about rounded, censored and repeated exact readings.

    Outputs, (n, M), that are the same in all runs have no findings.
    """
    findings: list[Finding] = []
    finite = outputs[np.isfinite(outputs).all(axis=1)]
    for m in likelihood.measurements:
        # Counts have ties and outliers that are no errors.
        values = np.where(m.readings.family < 0, m.readings.values, np.nan)
        simulated = outputs[:, output_columns(likelihood, m)] if len(outputs) else outputs
        has_gross_errors = m.gross_errors is not False
        remedy = "pass gross_errors=True beside the other arguments of prb.LogLikelihood"
        if has_random_response(likelihood) or m.metric.selected is not None:
            remedy = "keep them as part of the population"  # such a model has no gross errors
        findings += outlier_findings(
            m.name,
            values,
            simulated,
            m.outputs.names,
            gross_errors=has_gross_errors,
            remedy=remedy,
        )
        if len(finite):
            is_constant = np.ptp(finite[:, output_columns(likelihood, m)], axis=0) == 0
            values = np.where(is_constant, np.nan, values)
        steps: Any = m.readings.step.max(axis=0)
        # A reading error that the user states includes rounding.
        is_stated = (steps > 0) | (m.metric.error is not None)
        findings += data_findings(
            values,
            labels=output_labels(m.name, m.outputs.names),
            several_roots=several_roots,
            rounded=np.where(is_stated, np.maximum(steps, 1e-300), np.nan),
            rows=m.observed_rows,
        )
    repeats, gross_errors = likelihood.stacked.repeats, likelihood.measurements[0].gross_errors
    if repeats is not None and likelihood.error_is_known and gross_errors is False:
        findings += repeat_findings(likelihood.name, repeats)
    return tuple(findings)


def log_shares(
    likelihood: SpecimenLikelihood, values: Mapping[str, Floats], share: PopulationShare
) -> Floats:
    """Return log S of the population of each specimen, (P, S), at values by name, (P, *shape)."""
    result = np.empty((len(next(iter(values.values()))), len(likelihood.readings)))
    for group, rows in rows_by_context(likelihood):
        parents = likelihood.parents(values, group, rows[:1])
        log_share = share.of_populations(likelihood.density, parents, likelihood.coordinates)
        result[:, rows] = log_share[:, None]
    return result


@dataclass(frozen=True, eq=False)
class SpecimenPopulations:
    """Populations of a model's hyperparameters, evaluated at points of its specimens."""

    likelihood: SpecimenLikelihood

    @cached_property
    def hyperparameters(self) -> Hyperparameters:
        """The hyperparameters of the model."""
        return self.likelihood.hyperparameters

    def log_likelihoods(
        self, thetas: Floats, z: Floats, log_a: Floats, smoothing: Floats | None = None
    ) -> Floats:
        """Return log p(y_i | theta), (S, N), from points (N, K, d) and their numbers (N, K).

        With `smoothing`, a covariance of the coordinates without conditions, populations are normal
        with the moments of the coordinates z, and wider by it: the log-likelihood is then smooth.
        """
        n, count, d = z.shape
        likelihood = self.likelihood
        result = np.empty((len(thetas), n))
        x = likelihood.coordinates.inputs(z)
        weights = log_a if smoothing is not None else log_a + likelihood.coordinates.log_jacobian(z)
        values = variables_at(self.hyperparameters, thetas)
        free = ~likelihood.coordinates.is_condition
        contexts = likelihood.by_group if smoothing is None else rows_by_context(likelihood)
        for group, rows in contexts:
            parents = likelihood.parents(values, group, rows)
            if smoothing is None:
                points = WeightedPoints.of(likelihood.density, [v[rows] for v in x], weights[rows])
                result[:, rows] = points.log_likelihoods(parents)
                continue
            step = max(1, IN_CACHE // (len(rows) * count))
            for first in range(0, len(thetas), step):
                block = slice(first, first + step)
                at_block = [parent[block] for parent in parents]
                at_points = z[rows].reshape(-1, d)[:, free]
                logs = self._normal_log_density(at_block, at_points, smoothing)
                logs = np.where(np.isnan(logs), -np.inf, logs)
                logs = logs.reshape(-1, len(rows), count)
                result[block, rows] = log_sum_exp(logs + weights[rows])
        return result

    def prior_specimens(self) -> Floats:
        """Return coordinates of specimens of the prior predictive population, (n, d)."""
        return PopulationDraws(self, self.hyperparameters.prior_thetas(2048, 0)).specimens(1)

    def order(self) -> Indices:
        """Return the coordinates without conditions: those of the least known spread first."""
        likelihood, coordinates = self.likelihood, self.likelihood.coordinates
        values = variables_at(self.hyperparameters, self.hyperparameters.prior_thetas(256, 0))
        group, rows = likelihood.by_group[0]
        parents = likelihood.parents(values, group, rows[:1])
        inputs, _ = likelihood.density.sampler(parents, 64, np.random.default_rng(0))
        z = coordinates.of(inputs, 2)[..., ~coordinates.is_condition]
        with np.errstate(divide="ignore", invalid="ignore"):
            log_sd = np.log(z.std(axis=1))
        log_sd = log_sd[np.isfinite(log_sd).all(axis=1)]
        spread = log_sd.std(axis=0) if len(log_sd) else np.zeros(z.shape[-1])
        return np.argsort(-spread, kind="stable")

    def log_share(self, thetas: Floats, share: PopulationShare) -> Floats:
        """Return log S of the population of each specimen, summed over the specimens, (S,)."""
        values = variables_at(self.hyperparameters, thetas)
        return log_shares(self.likelihood, values, share).sum(axis=1)

    def _normal_log_density(
        self, parents: Sequence[Floats], z: Floats, smoothing: Floats, specimens: int = 256
    ) -> Floats:
        """Return the log-density of points (n, d) in smoothed normal populations, (S, n)."""
        sampler, rng = self.likelihood.density.sampler, np.random.default_rng(0)
        coordinates = self.likelihood.coordinates
        sample = coordinates.of(sampler(parents, specimens, rng)[0], 2)
        sample = sample[..., ~coordinates.is_condition]
        # Populations far from the prior may have inputs so large that their squares overflow.
        is_finite = (np.abs(sample) < 1e100).all(axis=(1, 2))
        sample[~is_finite] = 0.0
        mean = sample.mean(axis=1, keepdims=True)
        centred = sample - mean
        root = np.linalg.cholesky(centred.swapaxes(1, 2) @ centred / specimens + smoothing)
        inverse = np.linalg.inv(root)
        log_det = np.log(np.diagonal(root, axis1=1, axis2=2)).sum(axis=1, keepdims=True)
        constant = z.shape[1] / 2 * np.log(2 * np.pi)
        result = np.zeros((len(mean), len(z)))
        for axis in inverse.swapaxes(0, 1):
            standard = axis @ z.T
            standard -= (axis * mean[:, 0]).sum(axis=1, keepdims=True)
            result += np.square(standard, out=standard)
        result *= -0.5
        result -= log_det + constant
        result[~is_finite] = -np.inf
        return result

    def posterior(
        self,
        z: Floats,
        log_a: Floats,
        smoothing: Floats | None = None,
        share: PopulationShare | None = None,
        seed: int = 0,
        several: bool = False,
    ) -> PopulationDraws:
        """Return draws of the posterior of the hyperparameters given points of the specimens.

        Adaptive importance sampling, by mixtures if there may be ``several`` modes. Weights are
        tempered until their effective sample size is ten times the number of hyperparameters, so
        that a few draws do not decide the next proposal.
        """
        names = self.hyperparameters
        d = names.size

        def log_likelihood(thetas: Floats) -> Floats:
            # Populations are evaluated in blocks, so that memory stays bounded with many specimens.
            blocks = np.array_split(thetas, 1 + len(thetas) * len(z) // (4 * AT_ONCE))
            total = np.concatenate([of_block(block) for block in blocks])
            return total if share is None else total - self.log_share(thetas, share)

        def of_block(thetas: Floats) -> Floats:
            logs = self.log_likelihoods(thetas, z, log_a, smoothing)
            if self.likelihood.measurements[0].gross_errors is not False:
                # With a share of 10 % gross errors, outliers have no influence on the population.
                log_gross = np.log(0.1) + self.likelihood.stacked.log_gross
                logs = np.logaddexp(np.log(0.9) + logs, log_gross)
            return np.asarray(logs.sum(axis=1))

        def tempered(log_weights: Floats, thetas: Floats) -> tuple[Floats, float]:
            if not np.isfinite(log_weights).any():
                self._refuse_unlikely(self.log_likelihoods(thetas[:256], z, log_a))
            return _tempered(log_weights, 10 * d)

        thetas = names.prior_points(2048, seed)
        log_density = log_posterior(names, thetas, log_likelihood)
        weights, _ = tempered(log_density - names.log_prior(thetas), thetas)
        if several:
            thetas, weights = self._several_modes(
                thetas, log_density, log_likelihood, tempered, seed
            )
        for attempt in range(0 if several else 12):
            mean = weights @ thetas
            away = thetas - mean
            covariance = (away.T * weights) @ away + 1e-12 * np.diag(names.prior_sd**2)
            root = np.linalg.cholesky(1.2 * covariance)
            u = sobol(512, d + 1, seed + 1 + attempt)
            radius = np.sqrt(5 / chdtri(5, u[:, d]))
            standard = ndtri(u[:, :d]) * radius[:, None]
            thetas = mean + standard @ root.T
            log_proposal = -(5 + d) / 2 * np.log1p((standard**2).sum(axis=1) / 5)
            log_density = log_posterior(names, thetas, log_likelihood)
            weights, temper = tempered(log_density - log_proposal, thetas)
            if temper == 1.0 and attempt >= 2 and 1 / (weights**2).sum() > 200:
                break
        rng = np.random.default_rng([seed, 5])
        return PopulationDraws(self, thetas[rng.choice(len(thetas), 256, p=weights)])

    def _several_modes(
        self,
        thetas: Floats,
        log_density: Floats,
        log_likelihood: ArrayFunction,
        tempered: Callable[[Floats, Floats], tuple[Floats, float]],
        seed: int,
    ) -> tuple[Floats, Floats]:
        """Return points of the posterior, (n, p), and weights, from points of the prior.

        No point is dropped, so that no mode is lost from one proposal to the next.
        """
        names = self.hyperparameters
        proposals: list[tuple[Callable[[Floats], Floats], int]] = [(names.log_prior, len(thetas))]
        rng = np.random.default_rng([seed, 6])
        for attempt in range(13):
            terms = [np.log(n / len(thetas)) + density(thetas) for density, n in proposals]
            log_proposal = logsumexp(terms, axis=0)
            log_ratio = log_density - log_proposal
            weights, temper = tempered(log_ratio, thetas)
            is_enough = temper == 1.0 and attempt >= 5 and 1 / (weights**2).sum() > 200
            if is_enough or attempt == 12:
                break
            drawn = rng.choice(len(thetas), 512, p=weights)
            # Equal points would have no covariance.
            noise = 1e-6 * names.prior_sd * rng.standard_normal((512, len(names.prior_sd)))
            even = np.full(512, 1 / 512)
            mixture = StudentMixture.fitted(thetas[drawn] + noise, even, 6, 5.0, rng)
            # A mode that few points have found needs as many new ones as others.
            mixture = replace(mixture, shares=(mixture.shares + 1 / 6) / 2)
            new = mixture.draws(512, seed + 1 + attempt)
            proposals.append((mixture.log_density, 512))
            thetas = np.concatenate([thetas, new])
            of_new = log_posterior(names, new, log_likelihood)
            log_density = np.concatenate([log_density, of_new])
        return thetas, weights

    def _refuse_unlikely(self, logs: Floats) -> None:
        """Raise for the specimen that the fewest populations reach, from log-likelihoods (S, N)."""
        specimen = int(np.isfinite(logs).mean(axis=0).argmin())
        labels = specimen_labels(self.likelihood)
        label = specimen if labels is None else labels[specimen]
        raise ValueError(
            f"{self.likelihood.name}: got no population of the prior that reaches the inputs of "
            f"specimen {label}, expected one at least: prior and data are in conflict, or units or "
            "responses are wrong; widen the priors, look at the units and at responses that are "
            "NaN, and pass prb.LogLikelihood(error=...) if readings have an error"
        )


def _tempered(log_weights: Floats, least: int) -> tuple[Floats, float]:
    """Return normalised weights and the exponent that gives them a least effective sample size."""
    temper = 1.0
    while True:
        scaled = temper * (log_weights - log_weights.max())
        weights = np.exp(np.nan_to_num(scaled, nan=-np.inf))
        weights /= weights.sum()
        if 1 / (weights**2).sum() >= least or temper < 1e-6:
            return weights, temper
        temper *= 0.7


@dataclass(frozen=True, eq=False)
class PopulationDraws:
    """Draws of the hyperparameters, (S, d)."""

    populations: SpecimenPopulations
    thetas: Floats

    def log_likelihoods(self, z: Floats, log_a: Floats) -> Floats:
        """Return log p(y_i | theta) at a quarter of the draws, (S, N)."""
        return self.populations.log_likelihoods(self.thetas[::4], z, log_a)

    def log_share(self, share: PopulationShare) -> Floats:
        """Return the sum over the specimens of log S, the log share with a response, (S,)."""
        return self.populations.log_share(self.thetas, share)

    def specimens(self, n_of_each: int = 16) -> Floats:
        """Return coordinates of specimens of all groups and draws, (n, d)."""
        populations, likelihood = self.populations, self.populations.likelihood
        rng = np.random.default_rng([0, 3])
        parts = []
        values = variables_at(populations.hyperparameters, self.thetas)
        for group, rows in likelihood.by_group:
            if likelihood.inputs.covariates:
                rows = rng.choice(rows, (len(self.thetas), n_of_each))
            parents = likelihood.parents(values, group, rows)
            inputs, _ = likelihood.density.sampler(parents, n_of_each, rng)
            z = likelihood.coordinates.of(inputs, 2)
            parts.append(z.reshape(-1, z.shape[-1]))
        z = np.concatenate(parts)
        return z[np.isfinite(z).all(axis=1)]
