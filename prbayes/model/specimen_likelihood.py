"""The log-likelihood by specimen, from importance points, as PyMC evaluates and draws it.

    log p(y_i | theta) = logsumexp_k(log p(x_ik | theta) + A_ik),

with PyMC's own log-densities of the inputs at points x_ik. Points and numbers A_ik contain no
hyperparameter, so that samplers evaluate the graph without a run. Simulators that measured the same
specimens have one likelihood: the log-density of the last one has an element for each specimen,
those of the first ones have none; their observed variables are parameters of the last one's.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import batched
from typing import Any

import numpy as np
import pymc as pm
import pytensor
import pytensor.tensor as pt
from pymc.logprob.abstract import ValuedRV, _logprob
from pytensor.graph.basic import Constant
from pytensor.graph.replace import graph_replace
from pytensor.graph.traversal import ancestors
from pytensor.tensor.variable import TensorVariable

from prbayes._stats import log_sum_exp
from prbayes._validate import Arrays, ArraysByName, Bools, Floats, Indices, flat_rows, wrong_value
from prbayes.metrics.readings import Readings, add_errors
from prbayes.model.conditions import at_conditions
from prbayes.model.measurement import (
    ROLES,
    Measurement,
    SpecimenLikelihood,
    observed_range,
    output_columns,
    rows_by_context,
    rows_by_group,
    selection_of,
    specimen_numbers,
    unit_readings,
)
from prbayes.model.random_variable import (
    TERMS,
    ObservedRV,
    equal_data,
    known_value,
    require_data,
    simulators,
)
from prbayes.model.specimen_preparation import log_shares, prepared, refuse_changed_runs
from prbayes.model.unknown_error import ReadingDensity
from prbayes.numerics.threads import one_thread
from prbayes.response.distributions import log_density
from prbayes.response.inputs import is_group, is_known
from prbayes.specimens.shared_points import PopulationShare
from prbayes.specimens.weighted_points import WeightedPoints


def arrays(likelihood: SpecimenLikelihood) -> tuple[list[Any], Any]:
    """Return shared variables of the points, (N, K, *event) by input, and of A, (N, K)."""
    if "arrays" not in likelihood.cache:
        points, name = prepared(likelihood).points, likelihood.name
        coordinates = likelihood.coordinates
        # The proposal is a density of z, so that A has the Jacobian: p(x) dx = p(x(z)) |dx/dz| dz.
        log_a = points.log_a if likelihood.error_is_known else -points.log_proposal
        log_a = log_a + coordinates.log_jacobian(points.z)
        x = [np.ascontiguousarray(values) for values in coordinates.inputs(points.z)]
        shared = [pytensor.shared(v, name=f"{name}_points_{i}") for i, v in enumerate(x)]
        likelihood.cache["arrays"] = shared, pytensor.shared(log_a, name=f"{name}_log_a")
    result: tuple[list[Any], Any] = likelihood.cache["arrays"]
    return result


def _array_values(likelihood: SpecimenLikelihood) -> tuple[list[Floats], Floats]:
    """Return the current values of `arrays`, which refits replace by those of other specimens."""
    shared, log_a = arrays(likelihood)
    return [variable.get_value(borrow=True) for variable in shared], log_a.get_value(borrow=True)


def points_by_group(likelihood: SpecimenLikelihood) -> list[WeightedPoints]:
    """Return the points of the specimens of each group."""
    x, log_a = _array_values(likelihood)
    last: tuple[Any, list[WeightedPoints]] = likelihood.cache.get("points by group", (None, []))
    if last[0] is not log_a:
        groups = [rows for _, rows in likelihood.by_group]
        density = likelihood.density
        points = [WeightedPoints.of(density, [v[rows] for v in x], log_a[rows]) for rows in groups]
        last = likelihood.cache["points by group"] = (log_a, points)
    return last[1]


def log_likelihoods(likelihood: SpecimenLikelihood, values: ArraysByName) -> Floats:
    """Return the log-likelihoods of the specimens in populations, (P, S), without a graph.

    Values are those of the model's variables by name, (P, *shape).
    """
    share, repeats = prepared(likelihood).share, likelihood.stacked.repeats
    if prepared(likelihood).points.tilts is not None:
        return _over_emulators(likelihood, values)
    errors = _unknown_of(likelihood.measurements, values)
    parts = []
    for (group, rows), points in zip(likelihood.by_group, points_by_group(likelihood), strict=True):
        parents = likelihood.parents(values, group, rows)
        parts.append(_of_points(likelihood, errors, parents, points, rows))
    result = parts[0]
    if len(parts) > 1:
        result = np.empty((len(errors), len(likelihood.readings)))
        for (_, rows), part in zip(likelihood.by_group, parts, strict=True):
            result[:, rows] = part
    if share is not None:
        result = result - log_shares(likelihood, values, share)
    if repeats is not None:
        result = result + [repeats.log_density(error, np) for error, _, _ in errors]
    result = _with_gross_errors(likelihood, values, result, slice(None))
    weights = likelihood.measurements[0].weights
    return result if weights is None else result * weights


def emulator_factors(likelihood: SpecimenLikelihood) -> Any:
    """Return the shared variable of factors of exp(A) in draws of the emulator, (N, K, B)."""
    if "factors" not in likelihood.cache:
        tilts = prepared(likelihood).points.tilts
        assert tilts is not None
        factors = np.exp(tilts)
        likelihood.cache["factors"] = pytensor.shared(factors, name=f"{likelihood.name}_factors")
    return likelihood.cache["factors"]


@one_thread()
def _over_emulators(likelihood: SpecimenLikelihood, values: ArraysByName) -> Floats:
    """Return log-likelihoods of specimens, (P, S), whose sum is that of their mean over draws."""
    factors = emulator_factors(likelihood).get_value(borrow=True)
    size = len(next(iter(values.values())))
    logs = np.empty((size, len(factors)))
    changes = np.empty((*logs.shape, factors.shape[2]))
    for (group, rows), points in zip(likelihood.by_group, points_by_group(likelihood), strict=True):
        densities = points.log_densities(likelihood.parents(values, group, rows))
        # Blocks of populations, so that products with the factors are those of matrices.
        for first, block in enumerate(batched(densities, 32)):
            terms = np.stack(block, axis=1) + points.log_a[:, None]  # (n, p, K)
            largest = np.maximum(terms.max(axis=2, keepdims=True), -1e300)
            weights = np.exp(np.maximum(terms - largest, -700.0))
            weights[terms == -np.inf] = 0.0
            total = weights.sum(axis=2, keepdims=True)
            place = slice(32 * first, 32 * first + len(block))
            with np.errstate(divide="ignore"):
                logs[place, rows] = (np.log(total) + largest)[:, :, 0].T
            ratio = (weights @ factors[rows]) / np.where(total > 0, total, 1.0)
            changes[place, rows] = ratio.swapaxes(0, 1)
    share = prepared(likelihood).share
    if share is not None:
        logs = logs - log_shares(likelihood, values, share)
    return np.asarray(mean_over_emulators(logs, changes, likelihood.measurements[0].weights, np))


def mean_over_emulators(logs: Any, factors: Any, weights: Floats | None, xp: Any) -> Any:
    r"""Return log-likelihoods of N specimens whose sum is that of their mean over emulators.

    With the log-likelihood :math:`l_{ib}` of specimen i under draw b of the emulator, and the
    shares :math:`w_b` of the draws in :math:`\sum_b \exp \sum_i l_{ib}`,

    .. math:: \log \frac{1}{B} \sum_b \exp \sum_i l_{ib}
        = \sum_i \sum_b w_b l_{ib} - \sum_b w_b \log(B w_b).

    The last sum is divided equally among the specimens. ``logs``, (..., N), are those of the first
    emulator, ``factors``, (..., N, B), the ratios of the likelihoods to those.
    """
    count = factors.shape[-1]
    factor = np.ones(1) if weights is None else weights
    is_possible = logs > -np.inf if xp is np else pt.gt(logs, -np.inf)
    choose = np.where if xp is np else pt.switch
    changes = xp.log(xp.maximum(factors, 1e-300))
    finite = choose(is_possible, logs, 0.0)
    totals = ((finite[..., None] + changes) * factor[:, None]).sum(axis=-2)
    log_shares = totals - totals.max(axis=-1, keepdims=True)
    log_shares = log_shares - xp.log(xp.exp(log_shares).sum(axis=-1, keepdims=True))
    shares = xp.exp(log_shares)
    divergence = (shares * (log_shares + xp.log(1.0 * count))).sum(axis=-1)
    total_weight = logs.shape[-1] if weights is None else weights.sum()
    change = (changes * shares[..., None, :]).sum(axis=-1)
    return (logs + change - divergence[..., None] / total_weight) * factor


def _with_gross_errors(
    likelihood: SpecimenLikelihood, values: ArraysByName, logs: Floats, rows: Any
) -> Floats:
    """Return log-likelihoods of specimens, (P, n), as mixtures with gross errors."""
    share = _gross_share(likelihood.measurements[0], values)
    if share is False:
        return logs
    share = np.reshape(share, (-1, 1))
    gross = np.log(share) + likelihood.stacked.log_gross[rows]
    with np.errstate(divide="ignore"):  # a share of one leaves no other specimen
        return np.asarray(np.logaddexp(np.log1p(-share) + logs, gross))


def monte_carlo_error(likelihood: SpecimenLikelihood, values: ArraysByName) -> Floats:
    """Return the error of the log-likelihood of populations by finitely many points, (P,), in nats.

    It is that of the difference between two independent halves of the points of each specimen. A
    population that is narrower than the distances between points has a large one. Specimens that
    have a gross error have next to none. A specimen without a point in one of the halves is left
    out. Exact readings, which have one point for each mode, have no error.
    """
    x, log_a = _array_values(likelihood)
    size, half = len(next(iter(values.values()))), log_a.shape[1] // 2
    if prepared(likelihood).points.is_exact:
        return np.zeros(size)
    variance = np.zeros(size)
    errors = _unknown_of(likelihood.measurements, values)
    for group, rows in likelihood.by_group:
        parents = likelihood.parents(values, group, rows)
        logs = []
        for part in (slice(half), slice(half, None)):
            of_half = [v[rows, part] for v in x]
            points = WeightedPoints.of(likelihood.density, of_half, log_a[rows, part])
            of_points = _of_points(likelihood, errors, parents, points, rows, part)
            logs.append(_with_gross_errors(likelihood, values, of_points, rows))
        with np.errstate(invalid="ignore"):
            difference = logs[0] - logs[1]
        with np.errstate(over="ignore"):  # an error that overflows, far from the data, is infinite
            halves = np.where(np.isfinite(difference), difference / 2, 0)
            variance += np.nansum(halves**2, axis=1)
    return np.sqrt(variance)


def _unknown_of(measurements: Sequence[Measurement], values: ArraysByName) -> Floats:
    """Return the unknown parameters of the readings, (P, 3, M); one, or zero, if known."""
    size = len(next(iter(values.values())))
    blocks = []
    for m in measurements:
        block = np.zeros((size, len(ROLES), m.rows.shape[1]))
        block[:, : ROLES.index("bias")] = 1.0
        for role, variable in m.unknown.items():
            block[:, ROLES.index(role)] = values[str(variable.name)].reshape(size, -1)
        blocks.append(block)
    return np.concatenate(blocks, axis=2)


def _gross_share(measurement: Measurement, values: ArraysByName) -> Any:
    """Return the share of specimens with a gross error, a number or (P,); False without them."""
    share = measurement.gross_errors
    return values[str(share.name)] if isinstance(share, TensorVariable) else share


@one_thread()
def _of_points(
    likelihood: SpecimenLikelihood,
    errors: Floats,
    parents: Arrays,
    points: WeightedPoints,
    rows: Indices,
    columns: slice = slice(None),
) -> Floats:
    """Return log-likelihoods of the specimens of a group, (P, n), for errors (P, 3, M).

    Only the points in the slice ``columns`` are used.
    """
    if likelihood.error_is_known:
        return points.log_likelihoods(parents)
    result = np.empty((len(errors), len(rows)))
    order = np.lexsort(flat_rows(errors).T)
    of_readings = _reading_density(likelihood).at_errors(errors[order])
    of_points = points.log_densities([p[order] for p in parents])
    for k, log_p, of_error in zip(order, of_points, of_readings, strict=True):
        result[k] = log_sum_exp(log_p + points.log_a + of_error[rows, columns])
    return result


def log_likelihood_graph(
    likelihood: SpecimenLikelihood, params: Mapping[Any, Any]
) -> TensorVariable:
    """Return the graph of the log-likelihoods of the specimens, (S,), from values by variable."""
    points, log_a = arrays(likelihood)
    share = prepared(likelihood).share
    stacked, measurements = likelihood.stacked, likelihood.measurements
    n, count = len(likelihood.readings), log_a.shape[1]
    flat = [x.reshape((n * count, *x.shape[2:]), ndim=x.ndim - 1) for x in points]
    log_p = _log_density(likelihood, params, flat, pt.repeat(pt.arange(n), count))
    terms = log_p.reshape((n, count)) + log_a
    unknown = []  # (M,) each: unknown parameters of the readings, as of `_unknown_of`
    for role in ROLES:
        default = float(role != "bias")
        rows = [params[m.extras[role]] if role in m.extras else default for m in measurements]
        widths = [m.rows.shape[1] for m in measurements]
        filled = [row + pt.zeros(width) for row, width in zip(rows, widths, strict=True)]
        unknown.append(pt.concatenate(filled))
    if not likelihood.error_is_known:
        terms = terms + _reading_density(likelihood)(unknown, pt)
    result = logsumexp_finite(terms)
    if share is not None:
        log_share = _log_share(likelihood, params, share)
    if prepared(likelihood).points.tilts is not None:
        of_points = pt.exp(terms - pt.switch(pt.isinf(result), 0.0, result)[:, None])
        # A product of matrices for each specimen would take a minute to compile.
        factors = (of_points[:, :, None] * emulator_factors(likelihood)).sum(axis=1)
        result = result if share is None else result - log_share
        return mean_over_emulators(result, factors, measurements[0].weights, pt)
    if share is not None:
        result = result - log_share
    if stacked.repeats is not None:
        result = result + stacked.repeats.log_density(unknown[0], pt)
    gross_share = measurements[0].gross_errors
    if gross_share is not False:
        gross_share = params.get(gross_share, gross_share)
        gross = pt.log(gross_share) + stacked.log_gross
        result = pt.logaddexp(pt.log1p(-gross_share) + result, gross)
    # Weights exist for one simulator without repeated readings only.
    weights = likelihood.measurements[0].weights
    return result if weights is None else result * weights


def _log_density(
    likelihood: SpecimenLikelihood, params: Mapping[Any, Any], points: Sequence[Any], specimens: Any
) -> Any:
    """Return the log-density of points, (n, *event), in the populations of specimens (n,).

    The values in ``params`` are by parent of the inputs.
    """
    inputs, stacked = likelihood.inputs, likelihood.stacked
    of_specimens = dict(zip(inputs.covariates, stacked.covariates, strict=True))
    of_specimens |= dict.fromkeys(filter(is_group, inputs.parents), stacked.groups)
    # Vectors of groups and covariates turn the distributions' parameters into vectors.
    vectors = {parent: pt.as_tensor(values)[specimens] for parent, values in of_specimens.items()}
    symbols = [vectors.get(parent, parent).type() for parent in inputs.parents]
    dists, _ = inputs.rebuilt(symbols)
    log_p = log_density(inputs, dists, points)
    # The values replace symbols after the densities are built, because PyMC may clone random
    # parameters.
    values = {
        symbol: vectors.get(parent, params.get(parent))
        for symbol, parent in zip(symbols, inputs.parents, strict=True)
    }
    (log_p,) = graph_replace([log_p], values, strict=False)
    return log_p


def _log_share(
    likelihood: SpecimenLikelihood, params: Mapping[Any, Any], share: PopulationShare
) -> Any:
    """Return the graph of the log share, or mass, of each specimen's population, (S,)."""
    coordinates, contexts = (
        likelihood.coordinates,
        [rows for _, rows in rows_by_context(likelihood)],
    )
    size = len(contexts)
    context = np.empty(len(likelihood.readings), dtype=np.intp)
    for k, rows in enumerate(contexts):
        context[rows] = k
    points = [pytensor.shared(np.concatenate([x] * size)) for x in coordinates.inputs(share.z)]
    specimens = np.repeat([rows[0] for rows in contexts], len(share.z))
    log_b = share.log_b + coordinates.log_jacobian(share.z)
    log_p = _log_density(likelihood, params, points, pt.as_tensor(specimens))
    terms = log_p.reshape((size, len(share.z))) + pytensor.shared(log_b)
    count = share.with_response
    if count is None:  # a mass, of which only an excess above one counts
        return pt.maximum(logsumexp_finite(terms), 0.0)[context]
    inside, outside = logsumexp_finite(terms[:, :count]), logsumexp_finite(terms[:, count:])
    is_unknown = pt.isinf(inside)
    log_ratio = outside - pt.switch(is_unknown, 0.0, inside)
    return pt.switch(is_unknown, 0.0, -pt.softplus(log_ratio))[context]


def _reading_density(likelihood: SpecimenLikelihood) -> ReadingDensity:
    """Return the log-density of the readings at the points as a function of unknown errors."""
    if "reading density" not in likelihood.cache:
        preparation = prepared(likelihood)
        density = ReadingDensity.of(likelihood, preparation.points, preparation.emulation.error)
        likelihood.cache["reading density"] = density
    result: ReadingDensity = likelihood.cache["reading density"]
    return result


def logsumexp_finite(terms: Any) -> TensorVariable:
    """Return the log of the sum of exponentials over the last axis, (N, K) -> (N,).

    -inf where all terms are -inf, with gradients of zero instead of NaN.
    """
    largest = pt.max(terms, axis=-1, keepdims=True)
    largest = pt.switch(pt.isinf(largest), 0.0, largest)
    total = pt.exp(terms - largest).sum(axis=-1)
    is_empty = pt.eq(total, 0.0)
    log_total = pt.log(pt.switch(is_empty, 1.0, total)) + largest[..., 0]
    return pt.switch(is_empty, -np.inf, log_total)


# Draws of inputs and readings.


def draw_inputs(
    likelihood: SpecimenLikelihood,
    rng: np.random.Generator,
    values: ArraysByName,
    *,
    as_read: bool = False,
) -> tuple[list[Floats], Floats | None]:
    """Draw the inputs of each specimen given its readings, (P, S, *event) by input.

    Also return the probability that the readings have a gross error, (P, S), None where the model
    has no gross errors: the inputs are then those of any specimen, unless the readings count
    ``as_read``. Values are those of the model's variables by name, (P, *shape).
    """
    all_points, log_a = _array_values(likelihood)
    errors = _unknown_of(likelihood.measurements, values)
    size, n = len(errors), len(log_a)
    inputs = [np.empty((size, n, *v.shape[2:])) for v in all_points]
    probability = None
    gross_share = _gross_share(likelihood.measurements[0], values)
    if gross_share is not False:
        weights = likelihood.measurements[0].weights
        logs = log_likelihoods(likelihood, values) / (1.0 if weights is None else weights)
        log_share = np.log(np.reshape(gross_share, (-1, 1)))
        probability = np.exp(log_share + likelihood.stacked.log_gross - logs)
    for group, rows in likelihood.by_group:
        parents = likelihood.parents(values, group, rows)
        by_point = likelihood.inputs.for_points(parents, log_a.shape[1])
        x = [v[rows] for v in all_points]
        flat = [v.reshape(-1, *v.shape[2:]) for v in x]
        for k in range(size):
            density = likelihood.density.at([parent[k : k + 1] for parent in by_point], flat)
            log_weights = density(slice(None)).reshape(log_a[rows].shape) + log_a[rows]
            if not likelihood.error_is_known:
                log_weights += _reading_density(likelihood)(errors[k], np)[rows]
            log_weights = np.where(np.isnan(log_weights), -np.inf, log_weights)
            totals = np.cumsum(np.exp(log_weights - log_weights.max(axis=1, keepdims=True)), axis=1)
            limits = totals[:, -1:] * rng.random((len(rows), 1))
            places = (totals < limits).sum(axis=1)
            for drawn, points in zip(inputs, x, strict=True):
                drawn[k, rows] = points[np.arange(len(rows)), places]
        if probability is not None and not as_read:
            is_gross = rng.random((size, len(rows))) < probability[:, rows]
            population, _ = likelihood.density.sampler(parents, len(rows), rng)
            for drawn, unknown in zip(inputs, population, strict=True):
                part = drawn[:, rows]
                part[is_gross] = unknown[is_gross]
                drawn[:, rows] = part
    return inputs, probability


def draw_readings(
    likelihood: SpecimenLikelihood,
    rng: np.random.Generator,
    values: ArraysByName,
    n: int,
    measurement: Measurement | None = None,
) -> Floats:
    """Draw the emulated readings of n specimens of each population, (P, n), (P, n, m) or (P, n, M).

    Values are those of the model's variables by name, (P, *shape). Specimens have groups and known
    values of the observed ones. Readings are those of one simulator, or the outputs of all.
    If n is the number of a simulator's rows, repeated readings have common inputs. NaN in a
    population of which next to nothing has a response.
    """
    numbers = np.arange(len(likelihood.readings))
    if measurement is not None:
        numbers = specimen_numbers(likelihood, measurement)
    # Observed specimens whose groups and covariates the drawn specimens have.
    like = np.resize(numbers, n)
    specimens: Any = slice(None)
    if measurement is not None and n == len(measurement.observed):
        _, first, inverse = np.unique(numbers, return_index=True, return_inverse=True)
        specimens = first[inverse]

    columns, measurements, like_read = slice(None), likelihood.measurements, likelihood.readings
    if measurement is not None:
        columns, measurements = output_columns(likelihood, measurement), (measurement,)
        like_read = unit_readings(measurement)

    def draw_outputs(part: ArraysByName) -> Floats:
        inputs = population_inputs(likelihood, part, like, rng)
        return response_at(likelihood, [x[:, specimens] for x in inputs])

    def draw(part: Mapping[str, Floats]) -> Floats:
        # Specimens without a response are drawn again, because they would not be measured.
        outputs = _drawn_again(draw_outputs, part, lambda y: np.isnan(y).any(axis=-1), 32)
        return read_outputs(rng, outputs[..., columns], like_read, measurements, part)

    selection = selection_of(measurements)
    if selection is None:
        readings = draw(values)
    else:
        # Specimens beyond the limits of a selection are drawn again, too.
        readings = _drawn_again(draw, values, lambda y: ~selection.is_seen(y), 256)
    return readings if measurement is None else readings.reshape(-1, n, *measurement.event)


def _drawn_again(
    draw: Callable[[ArraysByName], Floats],
    values: ArraysByName,
    is_refused: Callable[[Floats], Bools],
    tries: int,
) -> Floats:
    """Draw specimens (P, n, m), and again those that are refused, (P, n), at most ``tries`` times.

    Only populations with such a specimen are drawn again. A specimen refused each time is NaN.
    """
    drawn = draw(values)
    for _ in range(tries):
        refused = is_refused(drawn)
        populations = np.flatnonzero(refused.any(axis=1))
        if not populations.size:
            return drawn
        part = {name: x[populations] for name, x in values.items()}
        is_again = refused[populations][..., None]
        drawn[populations] = np.where(is_again, draw(part), drawn[populations])
    drawn[is_refused(drawn)] = np.nan
    return drawn


def population_inputs(
    likelihood: SpecimenLikelihood,
    values: ArraysByName,
    like: Indices,
    rng: np.random.Generator,
) -> list[Floats]:
    """Draw the inputs of n specimens of each population, (P, n, *event) by input.

    ``like``, (n,), are the observed specimens whose group and known values the drawn ones have.
    """
    groups, n = likelihood.stacked.groups, len(like)
    inputs: list[Floats] = []
    for group, columns in rows_by_group(None if groups is None else groups[like], n):
        parents = likelihood.parents(values, group, like[columns])
        drawn, _ = likelihood.density.sampler(parents, len(columns), rng)
        inputs = inputs or [np.empty((len(x), n, *x.shape[2:])) for x in drawn]
        for whole, part in zip(inputs, drawn, strict=True):
            whole[:, columns] = part
    conditions = likelihood.stacked.conditions
    return at_conditions(
        likelihood.inputs, inputs, None if conditions is None else conditions[like]
    )


def response_at(likelihood: SpecimenLikelihood, inputs: Arrays) -> Floats:
    """Return the emulated outputs of all simulators at inputs (P, n, *event), (P, n, M).

    Beyond the range of the runs the response is that at the end of the range.
    """
    emulation = prepared(likelihood).emulation
    flat = [x.reshape(-1, *x.shape[2:]) for x in inputs]
    z = np.clip(likelihood.coordinates.of(flat, 1), emulation.box[0], emulation.box[1])
    return np.asarray(emulation.predicted(z)).reshape(*inputs[0].shape[:2], -1)


def read_outputs(
    rng: np.random.Generator,
    outputs: Floats,
    readings: Readings,
    measurements: Sequence[Measurement],
    values: ArraysByName,
) -> Floats:
    """Return readings of outputs, (P, n, m), with reading errors, rounding and gross errors."""
    size, n, _ = outputs.shape
    unknown = _unknown_of(measurements, values).swapaxes(0, 1)[:, :, None]
    like = readings.rows(np.resize(np.arange(len(readings)), n))
    result = add_errors(like, rng, outputs, *unknown)
    share = _gross_share(measurements[0], values)
    if share is not False:
        low, high = np.concatenate([observed_range(m) for m in measurements], axis=1)
        middle, width = (low + high) / 2, high - low
        uniform = rng.random((size, n, middle.size))
        gross_errors = middle + width * (2 * uniform - 1)
        is_gross = rng.random((size, n, 1)) < np.reshape(share, (-1, 1, 1))
        result = np.where(is_gross, gross_errors, result)
    return np.asarray(result)


class SpecimenRV(ObservedRV):
    """The operation of a simulator with a log-likelihood by specimen; its record is that."""

    @property
    def measurements(self) -> list[Measurement]:
        """The measurements of `simulators`; the last is that of this simulator.

        The observed variables of the others are parameters of this operation.
        """
        by_name = {m.name: m for m in self.record.measurements}
        return [by_name[name] for name in self.simulators]

    @property
    def simulator(self) -> Measurement:
        """The measurement of this simulator."""
        return self.measurements[-1]

    @property
    def variables(self) -> tuple[TensorVariable, ...]:
        """The variables that are its first parameters."""
        likelihood: SpecimenLikelihood = self.record
        return likelihood.variables(self.simulators)

    def rng_fn(self, rng: np.random.Generator, *arguments: Any) -> Floats:
        """Draw responses of specimens; their shape is the last of the arguments."""
        *params, size = arguments
        measurement = self.simulator
        # The last parameters, readings of other simulators, are not parameters of the population.
        pairs = zip(self.variables, params, strict=False)
        parents = {parent: param for parent, param in pairs if not is_known(parent)}
        leading = [
            param.shape[: param.ndim - parent.type.ndim] for parent, param in parents.items()
        ]
        batch = np.broadcast_shapes(*leading)
        shape = batch if size is None else tuple(int(s) for s in size)
        n = len(measurement.observed) if not shape else shape[-1]
        # The last batch axis is that of the specimens. Parameters of populations have length one
        # along this axis.
        flat = {}
        for parent, param in parents.items():
            ndim = parent.type.ndim
            first = param if param.ndim == ndim else param[..., 0, *(slice(None),) * ndim]
            tail = first.shape[first.ndim - ndim :]
            whole = np.broadcast_to(first, (*batch[:-1], *tail))
            flat[str(parent.name)] = whole.reshape(-1, *tail)
        values = draw_readings(self.record, rng, flat, n, measurement)
        return values.reshape(*shape, *measurement.event)


@_logprob.register(SpecimenRV)  # type: ignore[untyped-decorator]
def _log_density_of_vector(
    op: SpecimenRV, values: Any, rng: Any, size: Any, *params: Any, **kwargs: Any
) -> TensorVariable:
    """Return the log-likelihoods of the specimens, (S,).

    Of simulators that share specimens only the last one has the likelihood; the others return an
    empty vector.
    """
    (value,) = values
    if TERMS.get() == "priors" or op.simulator is not op.record.measurements[-1]:
        return pt.zeros(0)
    variables = op.variables
    parents = {
        v: p if is_known(v) else p[(0,) * (p.ndim - v.type.ndim)]
        for v, p in zip(variables, params, strict=False)
    }
    measurements = op.measurements
    data = []
    for param, m in zip(params[len(variables) :], measurements[:-1], strict=True):
        first = param[(0,) * (param.ndim - m.observed.ndim)]
        data.append(_without_marks(first))
    data.append(value)
    numbers = {m.name: known_value(v) for m, v in zip(measurements, data, strict=True)}
    likelihood = op.record.observing(numbers)
    refuse_changed_runs(likelihood)
    result = log_likelihood_graph(likelihood, parents)
    conditions = [
        equal_data(v, m.observed)
        for m, v in zip(likelihood.measurements, data, strict=True)
        if not all(isinstance(leaf, Constant) for leaf in ancestors([v]) if leaf.owner is None)
    ]
    if not conditions:
        return result
    is_same = pt.all(pt.stack(conditions))
    return require_data(op.simulator.name, "whose points are part of it", result, is_same)


def _without_marks(variable: Any) -> Any:
    """Return a parameter without the operations by which PyMC marks variables that have a value."""
    marks = {
        v: v.owner.inputs[0]
        for v in ancestors([variable])
        if v.owner is not None and isinstance(v.owner.op, ValuedRV)
    }
    return graph_replace([variable], marks)[0] if marks else variable


def specimen_likelihoods(model: pm.Model) -> dict[Any, SpecimenLikelihood]:
    """Return the likelihoods by specimen of a model, by their observed variables.

    Simulators with common specimens have the same one.
    """
    if not isinstance(model, pm.Model):
        raise wrong_value(model, "model", "a pm.Model")
    rvs = [rv for rv in model.observed_RVs if isinstance(rv.owner.op, SpecimenRV)]
    data = {rv.owner.op.simulators[-1]: known_value(model.rvs_to_values[rv]) for rv in rvs}
    result = {rv: rv.owner.op.record for rv in rvs}
    current = {old: old.observing(data, model.root) for old in result.values()}
    for rv, old in result.items():
        if current[old] is not old:
            rv.owner.op.assign(rv.owner, current[old])
    return {rv: current[old] for rv, old in result.items()}


def measurements_of(model: pm.Model) -> dict[Any, Measurement]:
    """Return the simulators with a log-likelihood by specimen, by their observed variables."""
    return {rv: rv.owner.op.simulator for rv in specimen_likelihoods(model)}


def all_simulators(model: pm.Model) -> dict[Any, Any]:
    """Return the simulators of both kinds by their observed variables."""
    return {**simulators(model), **measurements_of(model)}


def require_simulator(model: pm.Model) -> None:
    """Raise if a model has no simulator of any kind; nothing is run."""
    if not all_simulators(model):
        raise ValueError(
            "model: got one without a prb.Simulator, expected at least one; add "
            "prb.Simulator(name, response, *inputs, metric=..., observed=...) inside the "
            "`with pm.Model()`"
        )
