"""The log-likelihood by specimen and draws of specimens, from importance points.

The log-likelihood of specimen i is

    log p(y_i | theta) = logsumexp_k(log p(x_ik | theta) + A_ik),

with PyMC's own log-densities of the inputs at points x_ik. Points and numbers A_ik contain no
hyperparameter (`prbayes.model.specimen_preparation`), so that NUTS, SMC and optimisers evaluate
the graph without a run.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pytensor
import pytensor.tensor as pt
from numpy.typing import NDArray
from pytensor.graph.replace import graph_replace, vectorize_graph
from pytensor.tensor.variable import TensorVariable

from prbayes._validate import Floats
from prbayes.metrics.readings import Readings
from prbayes.model.measurement import (
    Measurement,
    SpecimenLikelihood,
    output_columns,
    specimen_numbers,
)
from prbayes.model.specimen_preparation import prepared
from prbayes.propagation.population_density import WeightedPoints
from prbayes.propagation.response_share import ResponseShare
from prbayes.response.distributions import log_density
from prbayes.response.inputs import is_group


def arrays(likelihood: SpecimenLikelihood) -> tuple[list[Any], Any]:
    """Return shared variables of the points, (N, K, *event) by input, and of A, (N, K)."""

    def compute() -> tuple[list[Any], Any]:
        points = prepared(likelihood).points
        # The proposal is a density of z: p(x) dx = p(x(z)) |dx/dz| dz.
        log_a = points.log_a if likelihood.error_is_known else -points.log_proposal
        log_a = log_a + likelihood.coordinates.log_jacobian(points.z)
        name = likelihood.name
        shared = [
            pytensor.shared(np.ascontiguousarray(x), name=f"{name}_points_{i}")
            for i, x in enumerate(likelihood.coordinates.inputs(points.z))
        ]
        return shared, pytensor.shared(log_a, name=f"{name}_log_a")

    shared: tuple[list[Any], Any] = likelihood.cached("arrays", compute)
    return shared


def _points_by_group(likelihood: SpecimenLikelihood) -> list[WeightedPoints]:
    """Return the points of the specimens of each group, the values of the shared variables.

    Refits put the points of other specimens there.
    """
    shared, shared_log_a = arrays(likelihood)
    log_a = shared_log_a.get_value(borrow=True)
    points: list[WeightedPoints]
    cached_log_a, points = likelihood.cache.get("points by group", (None, []))
    if cached_log_a is not log_a:
        x = [variable.get_value(borrow=True) for variable in shared]
        points = [
            WeightedPoints.of(likelihood.inputs, [v[rows] for v in x], log_a[rows])
            for _, rows in likelihood.by_group
        ]
        likelihood.cache["points by group"] = (log_a, points)
    return points


def log_likelihoods(likelihood: SpecimenLikelihood, params: Mapping[Any, Floats]) -> Floats:
    """Return the log-likelihoods of the specimens in batches of populations, (P, S).

    The numbers of `log_likelihood_graph`, for likelihoods that need no graph. Values are by the
    likelihood's variables, shapes (P, *shape), without the group of a specimen.
    """
    size = len(next(iter(params.values())))
    share = prepared(likelihood).share
    result = np.empty((size, len(likelihood.readings)))
    groups = zip(likelihood.by_group, _points_by_group(likelihood), strict=True)
    for (group, rows), points in groups:
        roots = [
            np.full(size, group) if is_group(root) else params[root]
            for root in likelihood.inputs.roots
        ]
        result[:, rows] = likelihood.density.log_likelihoods(roots, points)
        if share is not None:
            log_share = share.of_populations(likelihood.density, roots, likelihood.coordinates)
            result[:, rows] -= log_share[:, None]
    gross_share = likelihood.measurements[0].gross_errors
    if gross_share is not False:
        gross_share = np.reshape(params.get(gross_share, gross_share), (-1, 1))
        gross = np.log(gross_share) + likelihood.stacked.log_gross
        result = np.logaddexp(np.log1p(-gross_share) + result, gross)
    weights = likelihood.measurements[0].weights
    return result if weights is None else result * weights


def log_likelihood_graph(
    likelihood: SpecimenLikelihood, params: Mapping[Any, Any]
) -> TensorVariable:
    """Return the graph of the log-likelihoods of the specimens, (S,), from values by variable."""
    points, log_a = arrays(likelihood)
    share = prepared(likelihood).share
    stacked = likelihood.stacked
    n, count = len(likelihood.readings), log_a.shape[1]
    symbols = likelihood.inputs.placeholders()
    values = {s: params[r] for s, r in zip(symbols, likelihood.inputs.roots, strict=True)}
    groups = np.zeros(n, dtype=np.intp) if stacked.groups is None else stacked.groups
    flat = [x.reshape((n * count, *x.shape[2:]), ndim=x.ndim - 1) for x in points]
    log_p = _log_density(likelihood, values, flat, pt.repeat(pt.as_tensor(groups), count))
    terms = log_p.reshape((n, count)) + log_a
    errors = []  # (M,): the unknown error of each output, one where it is known
    for m in likelihood.measurements:
        error = params[m.extras["error"]] if "error" in m.extras else 1.0
        errors.append(error + pt.zeros(m.rows.shape[1]))
    error = pt.concatenate(errors)
    if not likelihood.error_is_known:
        terms = terms + _readings_log_density(likelihood, error)
    result = logsumexp_finite(terms)
    if share is not None:
        result = result - _log_share(likelihood, values, share)[groups]
    if stacked.repeats is not None:
        result = result + stacked.repeats.log_density(error, pt)
    gross_share = likelihood.measurements[0].gross_errors
    if gross_share is not False:
        gross_share = params.get(gross_share, gross_share)
        gross = pt.log(gross_share) + stacked.log_gross
        result = pt.logaddexp(pt.log1p(-gross_share) + result, gross)
    weights = likelihood.measurements[0].weights  # of one simulator without repeated readings
    return result if weights is None else result * weights


def _log_density(
    likelihood: SpecimenLikelihood, values: dict[Any, Any], points: Sequence[Any], groups: Any
) -> Any:
    """Return the log-density of points, (n, *event) by input, in populations of groups (n,).

    Values are by the placeholders of the inputs' roots.
    """
    inputs = likelihood.inputs
    symbols = list(values)
    dists, _ = inputs.rebuilt(symbols)
    if likelihood.stacked.groups is not None:
        # A vector of groups in place of one makes vectors of the distributions' parameters.
        (group,) = (s for s, r in zip(symbols, inputs.roots, strict=True) if is_group(r))
        dists = vectorize_graph(dists, {group: groups})
        values = {symbol: value for symbol, value in values.items() if symbol is not group}
    log_p = log_density(inputs, dists, points)
    # After the densities are built: PyMC may clone parameters that are random.
    (log_p,) = graph_replace([log_p], values, strict=False)
    return log_p


def _log_share(likelihood: SpecimenLikelihood, values: dict[Any, Any], share: ResponseShare) -> Any:
    """Return the graph of log S, the log share with a response, of the groups, (G,)."""
    stacked, coordinates = likelihood.stacked, likelihood.coordinates
    size = 1 if stacked.groups is None else int(stacked.groups.max()) + 1
    points = [pytensor.shared(np.concatenate([x] * size)) for x in coordinates.inputs(share.z)]
    groups = np.repeat(np.arange(size), len(share.z))
    log_b = share.log_b + coordinates.log_jacobian(share.z)
    log_p = _log_density(likelihood, values, points, pt.as_tensor(groups))
    terms = log_p.reshape((size, len(share.z))) + pytensor.shared(log_b)
    inside = logsumexp_finite(terms[:, : share.with_response])
    outside = logsumexp_finite(terms[:, share.with_response :])
    is_unknown = pt.isinf(inside)
    log_ratio = outside - pt.switch(is_unknown, 0.0, inside)
    return pt.switch(is_unknown, 0.0, -pt.softplus(log_ratio))


def _readings_log_density(likelihood: SpecimenLikelihood, error: Any) -> Any:
    """Return the log-density of the readings at the points, (S, K), for an unknown error, (M,)."""
    readings, preparation = likelihood.readings, prepared(likelihood)
    outputs = preparation.points.outputs
    # Points that fill up the array have any output.
    outputs = np.where(np.isfinite(outputs), outputs, 1e30)
    unit = np.where(readings.is_relative[:, None], np.abs(outputs), 1.0)
    sd = error * likelihood.stacked.scale[:, None] * unit
    return readings.symbolic_log_density(outputs, preparation.emulation.error**2 + sd**2, pt)


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


# Draws of readings.


def draw_readings(
    likelihood: SpecimenLikelihood,
    rng: np.random.Generator,
    params: Mapping[Any, Floats],
    n: int,
    measurement: Measurement | None = None,
) -> Floats:
    """Draw the emulated readings of n specimens of each population, (P, n), (P, n, m) or (P, n, M).

    Values are by the likelihood's variables, shapes (P, *shape), without the group of a specimen:
    specimens are of the groups of the observed ones. Readings are those of one simulator, or the
    outputs of all, with repeated readings as their mean. They have errors, and gross errors where
    the metric has them. As many as the simulator's rows are of its specimens, so that repeated
    readings have common inputs. NaN in a population of which next to nothing has a response.
    """
    roots = [params[root] for root in likelihood.inputs.roots if not is_group(root)]
    groups = likelihood.stacked.groups if measurement is None else measurement.groups
    specimens: Any = slice(None)
    if measurement is not None and n == len(measurement.observed):
        numbers = specimen_numbers(likelihood, measurement)
        _, first, inverse = np.unique(numbers, return_index=True, return_inverse=True)
        specimens = first[inverse]

    def draw_outputs() -> Floats:
        if groups is None:
            inputs, _ = likelihood.density.sampler(roots, n, rng)
        else:
            inputs = _draw_groups(likelihood, rng, roots, np.resize(groups, n))
        flat = [x[:, specimens].reshape(-1, *x.shape[2:]) for x in inputs]
        return _emulated(likelihood, flat).reshape(len(roots[0]), n, -1)

    outputs = draw_outputs()
    # Specimens without a response are not measured.
    for _ in range(32):
        is_missing = np.isnan(outputs).any(axis=-1)
        if not is_missing.any():
            break
        outputs[is_missing] = draw_outputs()[is_missing]
    if measurement is None:
        return _with_errors(rng, outputs, likelihood.readings, likelihood.measurements, params)
    outputs = outputs[..., output_columns(likelihood, measurement)]
    values = _with_errors(rng, outputs, measurement.readings, [measurement], params)
    return values.reshape(*values.shape[:2], *measurement.event)


def _with_errors(
    rng: np.random.Generator,
    outputs: Floats,
    readings: Readings,
    measurements: Sequence[Measurement],
    params: Mapping[Any, Floats],
) -> Floats:
    """Return readings of outputs, (P, n, m): with error, rounding and gross errors."""
    size, n, count = outputs.shape
    sd: Any = np.resize(readings.error, (n, count))
    if len(measurements) == 1 and "error" in measurements[0].extras:
        sd = params[measurements[0].extras["error"]].reshape(size, 1, -1)
    is_relative = np.resize(readings.is_relative, (n, count))
    sd = sd * np.where(is_relative, np.abs(outputs), 1.0)
    values = outputs + sd * rng.standard_normal(outputs.shape)
    step = np.resize(readings.step, (n, count))
    unit = np.where(step > 0, step, 1.0)
    values = np.where(step > 0, np.round(values / unit) * unit, values)
    share = measurements[0].gross_errors
    if share is not False:
        low, high = np.concatenate([m.range for m in measurements], axis=1)
        middle, width = (low + high) / 2, high - low
        gross_errors = middle + width * (2 * rng.random(outputs.shape) - 1)
        probability = np.reshape(params.get(share, share), (-1, 1))
        is_gross = rng.random((size, n)) < probability
        values = np.where(is_gross[..., None], gross_errors, values)
    return np.asarray(values)


def _draw_groups(
    likelihood: SpecimenLikelihood,
    rng: np.random.Generator,
    roots: Sequence[Floats],
    groups: NDArray[np.intp],
) -> list[Floats]:
    """Return the inputs of specimens of each population, of these groups."""
    inputs: list[Floats] = []
    for group in np.unique(groups):
        values = iter(roots)
        roots_of_group = [
            np.full(len(roots[0]), group) if is_group(root) else next(values)
            for root in likelihood.inputs.roots
        ]
        columns = np.flatnonzero(groups == group)
        specimens, _ = likelihood.density.sampler(roots_of_group, len(columns), rng)
        inputs = inputs or [np.empty((x.shape[0], len(groups), *x.shape[2:])) for x in specimens]
        for whole, part in zip(inputs, specimens, strict=True):
            whole[:, columns] = part
    return inputs


def _emulated(likelihood: SpecimenLikelihood, inputs: Sequence[Floats]) -> Floats:
    """Return the emulated outputs of specimens, (n, *event) by input -> (n, M); no run is computed.

    Beyond the runs' range an input has the response at the end of the range.
    """
    emulation = prepared(likelihood).emulation
    z = likelihood.coordinates.of(inputs, 1)
    return emulation.values(np.clip(z, emulation.box[0], emulation.box[1]))
