"""Audit of an emulator at likely inputs of the specimens under posterior draws.

The emulator is fitted around populations of a coarse posterior, which may lack a narrow mode. Where
the emulator is uncertain at inputs that the draws themselves make likely, the response is computed.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.distance import cdist

from prbayes._finding import Finding, any_of, report
from prbayes._validate import Floats, Indices, complete_rows
from prbayes.metrics.readings import relative_error
from prbayes.model.evaluator import Evaluator
from prbayes.model.measurement import SpecimenLikelihood
from prbayes.model.parameters import variables_at
from prbayes.model.remedies import remedies_of
from prbayes.model.specimen_likelihood import draw_inputs, specimen_likelihoods
from prbayes.model.specimen_preparation import CheckedRuns, first_run_count, prepared
from prbayes.propagation.base import DesignError
from prbayes.response.budget import BudgetError, lift
from prbayes.specimens.design import farthest, most_runs
from prbayes.specimens.emulation import Emulation, fit_surface


def audited_evaluator(
    evaluator: Evaluator, thetas: Floats, place: str, *, is_last: bool = False
) -> tuple[Evaluator, tuple[Finding, ...]]:
    """Return the evaluator with emulators that are right at likely inputs of draws, (S, p).

    It is the same object if no emulator has changed. Raise DesignError if one would change in the
    last round, or has its largest number of runs. A budget that ends is a finding with the
    ``place``, and leaves the model as it was. The rest of the work needs no response.
    """
    try:
        records = {old: audited_likelihood(old, thetas, is_last) for old in evaluator.likelihoods}
        for new in records.values():
            prepared(new)
    except BudgetError as spent:
        lift()
        text = (
            f"{spent} before the runs were checked at {place}, where the emulator may be wrong. "
            "Call the function again with a larger budget."
        )
        finding = Finding("budget-spent", text, "expensive.md#a-night-is-not-enough")
        return evaluator, report(finding)
    if all(new is old for old, new in records.items()):
        return evaluator, ()
    for rv, old in specimen_likelihoods(evaluator.model).items():
        rv.owner.op.assign(rv.owner, records[old])
    return Evaluator.of(evaluator.model), ()


def audited_likelihood(
    likelihood: SpecimenLikelihood, thetas: Floats, is_last: bool
) -> SpecimenLikelihood:
    """Return a likelihood with runs where its emulator is wrong, the same if it is right.

    A share of .5 % of the inputs may have an uncertain emulator.
    """
    preparation, readings = prepared(likelihood), likelihood.readings
    emulation = preparation.emulation
    has_points = preparation.proposals is not None
    if likelihood.calls_response or emulation.offsets is not None or not has_points:
        return likelihood
    runs = likelihood.options.sampled
    points = preparation.points.z
    points = points[:, :: 4 if points.shape[1] >= 16 else 1]  # a mode has eight points or one
    if (_uncertainty(emulation, points.reshape(-1, points.shape[2])) <= 1.0).all():
        return likelihood
    z = _likely_inputs(likelihood, thetas)
    ratio = _uncertainty(emulation, z)
    possible, ratio = z[ratio > 1.0], ratio[ratio > 1.0]
    share = len(possible) / len(z)
    if share < 0.005:
        return likelihood
    fresh, counts = audit_points(emulation, possible, ratio, runs)
    weights = share * counts / len(possible)
    outputs = CheckedRuns(likelihood, [emulation.y])(fresh)
    misfit = np.abs(outputs - emulation.values(fresh))
    relative = np.array([relative_error(readings, error).max() for error in misfit])
    # A wrong input shifts a mean by its distance from the other inputs at most.
    is_free = ~likelihood.coordinates.is_condition
    middle = np.median(z, axis=0)
    width = np.maximum(np.median(np.abs(z - middle), axis=0), 1e-12)
    distance = (np.abs(fresh - middle) / width)[:, is_free].max(axis=1)
    shift = np.fmin(relative, np.maximum(distance, 1.0))
    bias = float(np.sqrt(len(readings)) * (weights @ shift))
    if bias <= likelihood.options.bias:
        return likelihood
    most = most_runs(z.shape[1]) + (first_run_count(likelihood) or 0)
    # The next emulation needs a batch of runs, and an audit of its own.
    if is_last or len(emulation.z) + 3 * runs > most:
        advice = any_of("narrow the priors", *remedies_of(likelihood))
        raise DesignError(
            f"{likelihood.name}: the response is not smooth enough for prb.LogLikelihood(): got an "
            f"emulator of {len(emulation.z)} runs that would shift an estimate by {bias:.2g} "
            "posterior standard deviations at inputs that posterior draws make likely, expected "
            f"at most {likelihood.options.bias}; {advice}"
        )
    grown = emulation.with_runs(fresh, outputs)
    audited = (*emulation.audited, *range(len(emulation.z), len(grown.z)))
    surface, *_ = fit_surface(grown.z, grown.y, readings, likelihood.name, emulation.surface)
    extended = replace(grown, surface=surface, bias=np.inf, audited=audited)
    result = replace(likelihood, shared_emulation=extended)
    # The first record identifies the problem, because every use of the model has it at first.
    result.cache["first"] = likelihood.cache.get("first", likelihood)
    return result


def _uncertainty(emulation: Emulation, z: Floats) -> Floats:
    """Return predictive standard deviations relative to the stated error, (n,)."""
    return np.asarray((np.sqrt(emulation.surface.variance(z)) / emulation.error).max(axis=1))


def audit_points(
    emulation: Emulation, candidates: Floats, uncertainty: Floats, count: int
) -> tuple[Floats, Indices]:
    """Return points of an audit, (m, d), and numbers of candidates that are nearest to each, (m,).

    Half of them are in the least certain part of the candidates, and half are the farthest from all
    others. Each point represents the candidates that are nearest to it.
    """
    scale = np.maximum(np.ptp(candidates, axis=0), 1e-12)
    least_certain = np.argsort(-uncertainty)
    n_worst = max(count, len(uncertainty) // 20)
    worst = candidates[least_certain[:n_worst]]
    rng = np.random.default_rng(0)
    worst = rng.permutation(worst)[: count // 2]
    present = np.concatenate([emulation.z, worst])
    distant = farthest(present, candidates, count // 2, scale)
    points = np.unique(np.concatenate([worst, distant]), axis=0)
    distances = cdist(candidates / scale, points / scale)
    nearest = distances.argmin(axis=1)
    return points, np.bincount(nearest, minlength=len(points))


def _likely_inputs(likelihood: SpecimenLikelihood, thetas: Floats) -> Floats:
    """Return coordinates of inputs of the specimens under posterior draws, (n, d)."""
    count = int(np.clip(2**15 // len(likelihood.readings), 16, 256))
    even = np.linspace(0, len(thetas) - 1, count)
    rows = np.unique(even.round().astype(int))
    values = variables_at(likelihood.hyperparameters, thetas[rows])
    rng = np.random.default_rng(0)
    inputs, is_gross = draw_inputs(likelihood, rng, values, as_read=True)
    of_specimens = [x.reshape(-1, *x.shape[2:]) for x in inputs]
    z = likelihood.coordinates.of(of_specimens, 1)
    is_regular = complete_rows(z)
    if is_gross is not None:
        # Readings with gross errors do not determine the population.
        is_regular &= is_gross.ravel() < 0.5
    return z[is_regular]
