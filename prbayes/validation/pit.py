"""u-values of measured responses under predictions: the probability integral transform.

References: Czado, Gneiting and Held (2009), doi:10.1111/j.1541-0420.2009.01191.x, for u-values of
ties; Ferson, Oberkampf and Ginzburg (2008), doi:10.1016/j.cma.2007.07.030, for the area between the
ECDF of u-values and the identity.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from prbayes._stats import cumulated
from prbayes._validate import (
    ArrayPair,
    Floats,
    Indices,
    NamedValues,
    Names,
    Seed,
    Shape,
    complete_rows,
    flag,
    real_array,
    sample_labels,
    seed_number,
    wrong_value,
)
from prbayes.metrics.base import Projection
from prbayes.metrics.multivariate import directions, failure_caps, sufficient_directions
from prbayes.metrics.whitening import whitening
from prbayes.model.fingerprint import Identity, Level, identity_from_attributes, require_together
from prbayes.model.parameters import element_name
from prbayes.response.outputs import in_order_of, output_order, read_observed
from prbayes.results.predict import specimen_names

Predicted = xr.DataArray | NDArray[Any]
# An argument of one condition, or of several conditions by name or in their order.
type ByCondition[T] = T | Mapping[str, T] | Sequence[T]

# Text between the name of a condition and the number of a projection of its outputs.
DIRECTION = ", direction "
_SAMPLE_DIMS = ("chain", "draw", "sample")
# Dimension that predictions have in place of samples if each specimen has a condition of its own.
_SPECIMEN = "specimen"


@dataclass(frozen=True, eq=False)
class TestedCondition:
    """Measured and predicted values of one condition, or of one projection of its outputs."""

    name: str
    observed: Floats  # measured values, projected, (n,)
    predicted: Floats  # predicted values, projected, (D, S); a row for each draw
    measured: Floats  # measured values before the projection, (n,) or (n, m)
    labels: Names | None  # labels of the specimens
    numbers: Indices  # numbers of the specimens, counted over all conditions, (n,)
    attributes: Mapping[Any, Any] = field(default_factory=dict)  # attributes of the prediction
    projection: Projection | None = None  # projection of several outputs
    group: int = 0  # number of the projection, else 0; the values of a group have one ECDF

    def projected(self, responses: Any) -> Any:
        """Return the projection of responses, (..., n) or (..., n, m) -> (..., n)."""
        return responses if self.projection is None else self.projection.of(responses)

    @property
    def base_name(self) -> str:
        """The name of the condition without the number of a projection."""
        return self.name.split(DIRECTION)[0]

    @property
    def specimens(self) -> tuple[str, ...]:
        """Names of the specimens: their labels, or else the condition with a number."""
        if self.labels is not None:
            return self.labels
        return tuple(f"{self.base_name}, {i}" for i in range(self.observed.size))


@dataclass(frozen=True, eq=False)
class Case:
    """All conditions of one test."""

    conditions: tuple[TestedCondition, ...]
    n_specimens: int
    shares_specimens: bool  # whether a specimen was measured under several conditions
    randomize: bool = False  # whether u-values of ties are random within their step
    random_seed: int | None = 0
    folded: bool = False  # whether the statistic is the area of abs(2u - 1)
    identity: Identity | None = None  # fingerprint of the calibrated problem, if it is known

    @property
    def size(self) -> int:
        """Number of observations."""
        return sum(c.observed.size for c in self.conditions)

    @property
    def n_draws(self) -> int:
        """Number of populations predicted for each condition."""
        return len(self.conditions[0].predicted)

    @property
    def is_dependent(self) -> bool:
        """Whether a specimen was measured several times."""
        return self.n_specimens < self.size

    @property
    def has_ties(self) -> bool:
        """Whether u-values are middles of steps: measured values equal several predicted ones."""
        for condition in self.conditions:
            lower, upper = Predictive(condition.predicted).steps(condition.observed)
            # Without ties a measured value equals at most one predicted value, whose step is one
            # over their number.
            if not self.randomize and ((upper - lower) * condition.predicted.size > 1.5).any():
                return True
        return False

    def statistic(self, u: Floats) -> Floats:
        """Return the statistic of u-values, (..., n) -> (...).

        For one output it is the area of all values together. For several outputs it is the mean
        over projections of the areas of u and abs(2u - 1), because a wrong correlation is a wrong
        spread in some projections. Groups of values are weighted by their number of values.
        """
        tested = self.tested(u)
        sizes = [c.observed.size for c in self.conditions]
        groups = np.repeat([c.group for c in self.conditions], sizes)
        distinct = list(dict.fromkeys(c.group for c in self.conditions))
        if distinct == [0]:
            return area(tested)
        terms = []
        for group in distinct:
            values = tested[..., groups == group]
            mean = area(values)
            if group > 0 and not self.folded:
                mean = (mean + area(np.abs(2 * values - 1))) / 2
            terms.append(values.shape[-1] / self.size * mean)
        return np.sum(terms, axis=0)

    def rng(self, stream: int) -> np.random.Generator | None:
        """Return a generator for the choice within ties, or None for the mid-transform."""
        if not self.randomize:
            return None
        seed = self.random_seed
        return np.random.default_rng(None if seed is None else [seed, stream])

    def tested(self, u: Floats) -> Floats:
        """Return the values that are tested for uniformity."""
        return np.abs(2 * u - 1) if self.folded else u

    def u_values(self) -> Floats:
        """Return the u-values, one condition after the other, shape (n,)."""
        rng = self.rng(0)
        u = [Predictive(c.predicted).transform(c.observed, rng) for c in self.conditions]
        return np.concatenate(u)


def read_case(
    observed: Any,
    predicted: Any,
    specimens: Any = None,
    *,
    folded: bool = False,
    randomize: bool = False,
    random_seed: Seed = 0,
) -> Case:
    """Return the checked conditions; arguments and errors are those of `area_test`."""
    seed = None if random_seed is None else seed_number(random_seed)
    flag(folded, "folded")
    flag(randomize, "randomize")
    numbers: dict[object, int] = {}
    conditions = []
    for name, measured, simulated, labels in _by_condition(observed, predicted, specimens):
        has_own_conditions = _SPECIMEN in getattr(simulated, "dims", ())
        if has_own_conditions:
            simulated = simulated.rename({_SPECIMEN: "sample"})
        y = _measured(name, measured, simulated)
        names = None
        if labels is not None:
            labels = in_order_of(labels, measured, f"{name}: specimens")
            names = tuple(specimen_names(sample_labels(labels, len(y), f"{name}: specimens")))
        # Without labels every value belongs to a different specimen.
        keys = [(name, i) for i in range(len(y))] if names is None else names
        condition = TestedCondition(
            name=name,
            observed=y,
            predicted=_simulated(name, simulated, y.shape[1:]),
            measured=y,
            labels=names,
            numbers=np.array([numbers.setdefault(key, len(numbers)) for key in keys], np.intp),
            attributes=simulated.attrs if isinstance(simulated, xr.DataArray) else {},
        )
        for part in _by_specimen(condition) if has_own_conditions else [condition]:
            if y.ndim == 1:
                conditions.append(part)
                continue
            for k, projection in enumerate(projections(part.predicted), start=1):
                projected = replace(
                    part,
                    name=f"{part.name}{DIRECTION}{k}",
                    observed=projection.of(part.observed),
                    predicted=projection.of(part.predicted),
                    projection=projection,
                    group=k,
                )
                conditions.append(projected)
    draws = [len(c.predicted) for c in conditions]
    if len(set(draws)) > 1:
        raise ValueError(
            f"predicted: got {draws} draws for the conditions {[c.name for c in conditions]}, "
            "expected the same draws of one posterior in all; pass the same result and n_draws= "
            "to prb.predict"
        )
    identities = {
        f"{c.name}: predicted": identity_from_attributes(c.attributes) for c in conditions
    }
    # Count specimens once for all projections of a condition.
    n_by_condition = {c.base_name: np.unique(c.numbers).size for c in conditions}
    return Case(
        conditions=tuple(conditions),
        n_specimens=len(numbers),
        shares_specimens=sum(n_by_condition.values()) > len(numbers),
        randomize=randomize,
        random_seed=seed,
        folded=folded,
        identity=require_together(identities, "area_test", level=Level.OPTIMUM),
    )


def u_values(
    observed: ByCondition[ArrayLike],
    predicted: ByCondition[Predicted],
    *,
    randomize: bool = False,
    random_seed: Seed = 0,
) -> Floats:
    r"""Return the probability integral transform of measured responses.

    .. math:: u_i = \tfrac{1}{2} \{ P(Y < y_i) + P(Y \le y_i) \}

    The predictive distribution pools all draws and samples. Several conditions pool their u-values.

    Parameters
    ----------
    observed : array_like, shape (n,); or a mapping or list of such, by condition
        +inf is a specimen that had failed.
    predicted : DataArray from `predict`, or ndarray of shape (..., S); or a mapping or list of such
        +inf is larger than every number; NaN are left out.
    randomize : bool
        Whether u is uniform between P(Y < y) and P(Y <= y) instead of the middle: then u-values of
        ties, such as failed specimens or discrete responses, are uniform too if the model is right.
    random_seed : int, sequence of int, numpy.random.Generator or None
        Of that choice.

    Returns
    -------
    ndarray, shape (n,)
        In the order of ``observed``, one condition after the other.

    Raises
    ------
    TypeError, ValueError
        If an argument is not as described.

    Notes
    -----
    Rounded measured values have ties, unlike predicted ones: round the predicted ones alike, as in
    ``u_values(observed, predicted.round(2))``.

    References
    ----------
    .. [1] Czado, C., T. Gneiting and L. Held (2009), Predictive model assessment for count data,
       Biometrics 65, 1254-1261, doi:10.1111/j.1541-0420.2009.01191.x.

    Examples
    --------
    >>> import numpy as np, prbayes as prb
    >>> prb.validation.u_values([0.3, 1.5, 9.0], np.array([0.0, 1.0, 2.0, 3.0]))
    array([0.25, 0.5 , 1.  ])
    """
    return read_case(observed, predicted, randomize=randomize, random_seed=random_seed).u_values()


def _by_specimen(condition: TestedCondition) -> list[TestedCondition]:
    """Split a condition into one for each specimen, with its column of predicted values."""
    n = len(condition.observed)
    predicted = condition.predicted
    if predicted.shape[1] != n:
        raise ValueError(
            f"{condition.name}: observed: got {n} values, expected {predicted.shape[1]}, one for "
            "each specimen of the prediction"
        )
    return [
        replace(
            condition,
            name=f"{condition.name}[{i}]",
            observed=condition.observed[i : i + 1],
            predicted=predicted[:, i : i + 1],
            labels=None if condition.labels is None else condition.labels[i : i + 1],
            numbers=condition.numbers[i : i + 1],
        )
        for i in range(n)
    ]


def projections(pool: Floats) -> list[Projection]:
    """Return projections of predicted outputs of all draws, shape (D, S, m).

    Directions are well spread in the white coordinates of the predicted outputs. They do not depend
    on measured values, so that replicates have the same projections. Raises ValueError if predicted
    outputs depend on each other linearly, as many outputs of few inputs do without a measurement
    error.
    """
    m = pool.shape[-1]
    rows = pool.reshape(-1, m)
    rows = rows[~np.isnan(rows).any(axis=1)]
    finite = rows[complete_rows(rows)]
    # 4096 specimens determine correlations to .02. The test has the right size for any directions.
    sample = finite[:: -(-len(finite) // 4096)]
    outputs = np.arange(m)
    try:
        center, axes = whitening(sample, np.full(len(sample), 1 / len(sample)), outputs)
    except ValueError as error:
        got = str(error).removeprefix("observed: ")
        raise ValueError(
            f"predicted: {got}. If the readings have an error, add it to the prediction, such as "
            "by prb.predict(posterior, reading, x, pm.Normal.dist(0, sd, shape=m))"
        ) from None
    caps = failure_caps(rows)
    number = max(1, sufficient_directions(m))
    return [Projection(outputs, caps, center, axes @ u) for u in directions(m, number, 0)]


def _names(values: Any) -> list[Any] | None:
    """Return the names of the conditions in a mapping, or their numbers in a list."""
    if isinstance(values, Mapping):
        return list(values)
    return list(range(len(values))) if isinstance(values, list | tuple) else None


def _by_condition(observed: Any, predicted: Any, specimens: Any) -> list[tuple[str, Any, Any, Any]]:
    """Return name, observed, predicted and specimens of each condition."""
    expected = _names(predicted)
    is_mapping = isinstance(predicted, Mapping)
    if expected is None:
        if isinstance(observed, Mapping):
            raise ValueError(
                f"predicted: got {type(predicted).__name__}, expected a mapping with the "
                "conditions of observed"
            )
        name = getattr(predicted, "name", None)
        return [(str(name) if name else "observed", observed, predicted, specimens)]
    for argument, values in (("observed", observed), ("specimens", specimens)):
        if values is None and argument == "specimens":
            continue
        names = _names(values) if isinstance(values, Mapping) == is_mapping else None
        # In a mapping of labels some conditions may be missing.
        is_partial = argument == "specimens" and is_mapping
        keys = set(names or ())
        if not keys or not keys <= set(expected) or (keys != set(expected) and not is_partial):
            got = type(values).__name__
            if names is not None:
                got = str(sorted(map(str, names))) if is_mapping else f"{len(names)} conditions"
            kind = "mapping" if is_mapping else "list"
            raise ValueError(
                f"{argument}: got {got}, expected a {kind} with the conditions of predicted, "
                f"{list(map(str, expected))}; one prediction alone is an array"
            )
    labels = {} if specimens is None else specimens if is_mapping else dict(enumerate(specimens))
    return [(str(k), observed[k], predicted[k], labels.get(k)) for k in expected]


def _measured(name: str, values: Any, simulated: Any) -> Floats:
    """Return measured values, (n,) or (n, m), with outputs in the order of the predicted ones."""
    y, outputs = read_observed(name, values)
    if y.ndim not in (1, 2) or y.size == 0:
        raise ValueError(
            f"{name}: observed: got shape {y.shape}, expected (n,), or (n, m) for m outputs, with "
            "n >= 1 measured responses"
        )
    n_bad = int((np.isnan(y) | np.isneginf(y)).sum())
    if n_bad:
        raise ValueError(
            f"{name}: observed: got {n_bad} NaN or -inf among {y.size} values, expected numbers; "
            "leave missing specimens out, and pass +inf for those that failed"
        )
    if y.ndim == 1 or not isinstance(simulated, xr.DataArray):
        return y
    dims = [dim for dim in simulated.dims if dim not in _SAMPLE_DIMS]
    if len(dims) != 1 or dims[0] not in simulated.coords:
        return y
    labels = simulated.coords[dims[0]].values.tolist()
    try:
        order = output_order(outputs.labels, labels, f"{name}: observed: got")
    except KeyError as error:
        raise ValueError(f"{error.args[0]}: those of predicted") from None
    return y if order is None else y[:, order]


def _simulated(name: str, values: Any, event: Shape) -> Floats:
    """Return predicted values, shape (D, S, *event)."""
    if isinstance(values, xr.DataArray):
        if not set(_SAMPLE_DIMS) <= set(values.dims) or len(values.dims) != 3 + len(event):
            also = f", and one for the {event[0]} outputs that are observed" if event else ""
            raise ValueError(
                f"{name}: predicted: got a DataArray with dims {values.dims}, expected (chain, "
                f"draw, sample){also}, as prb.predict returns"
            )
        values = values.transpose(*_SAMPLE_DIMS, ...).values
    y = real_array(values, f"{name}: predicted")
    n_axes = 1 + len(event)
    if y.ndim < n_axes or y.size == 0 or y.shape[y.ndim - len(event) :] != event:
        expected = "(..., S): specimens in the last axis"
        if event:
            expected = f"(..., S, {event[0]}): as many outputs as observed in the last axis"
        raise ValueError(f"{name}: predicted: got shape {y.shape}, expected {expected}")
    if np.isneginf(y).any() or np.isnan(y).all():
        raise ValueError(
            f"{name}: predicted: got -inf, or nothing but NaN, expected numbers; +inf is a failed "
            "specimen"
        )
    return y.reshape(-1, *y.shape[y.ndim - n_axes :])


@dataclass(frozen=True, eq=False)
class Comparable:
    """Measured and predicted values of one output under one condition."""

    name: str  # name of the condition, with the output as an index
    measured: Floats  # measured values, (n,); +inf is a specimen that failed
    predicted: Floats  # predicted values, (P, S); a row for each population; NaN has no weight
    unit: str = ""
    condition: str = ""
    coords: NamedValues = field(default_factory=dict)  # label of the output, by dimension

    @property
    def weights(self) -> Floats:
        """Equal weights of the numbers of each population, shape (P, S)."""
        is_number = ~np.isnan(self.predicted)
        return is_number / np.maximum(is_number.sum(axis=1, keepdims=True), 1)


def comparables(observed: Any, predicted: Any, caller: str) -> list[Comparable]:
    """Return pairs of data and predictions, one for each condition and output.

    At most eight outputs are returned, since these fill three rows of panels. Raises TypeError or
    ValueError if conditions or outputs differ.
    """
    pairs = []
    for name, y, prediction, _ in _by_condition(observed, predicted, None):
        if not isinstance(prediction, xr.DataArray) or "sample" not in prediction.dims:
            raise wrong_value(
                prediction, f"{caller}: {name}: predicted", "the DataArray of prb.predict"
            )
        values = real_array(y, f"{caller}: {name}: observed")
        dims = [dim for dim in prediction.dims if dim not in _SAMPLE_DIMS]
        event = tuple(prediction.sizes[dim] for dim in dims)
        if values.ndim != 1 + len(event) or values.shape[1:] != event or not values.size:
            expected = ", ".join(["n", *map(str, event)])
            raise ValueError(
                f"{caller}: {name}: observed: got shape {values.shape}, expected ({expected}): a "
                "value for each specimen and output"
            )
        m = event[0] if event else 1
        columns = values.reshape(-1, m)
        samples = prediction.values.reshape(-1, prediction.sizes["sample"], m)
        attrs = {**getattr(y, "attrs", {}), **prediction.attrs}
        units = np.broadcast_to(attrs.get("units", ""), m)
        for j in map(round, np.linspace(0, m - 1, min(m, 8)).tolist()):
            coords = {str(dim): prediction[dim].values.tolist()[j] for dim in dims}
            label = element_name(name, list(coords.values()))
            measured = columns[~np.isnan(columns[:, j]), j]
            unit = str(units[j])
            pairs.append(Comparable(label, measured, samples[..., j], unit, name, coords))
    return pairs


class Predictive:
    """The pooled predictive distribution of all draws and samples.

    ``values``, of any shape, have equal weights, or ``weights`` of the same shape. NaN are left
    out, and +inf is the largest.
    """

    def __init__(self, values: Floats, weights: Floats | None = None) -> None:
        is_number = ~np.isnan(values)
        numbers = values[is_number]
        if weights is None:
            self._values = np.sort(numbers)
            # Without any number the probability is zero everywhere.
            self._cumulative = np.arange(numbers.size + 1) / max(1, numbers.size)
            return
        order = np.argsort(numbers)
        self._values = numbers[order]
        cumulative = cumulated(weights[is_number], order)
        self._cumulative = cumulative / cumulative[-1]

    def steps(self, y: Floats) -> ArrayPair:
        """Return P(Y < y) and P(Y <= y), in the shape of y; NaN for a NaN."""
        nan = np.where(np.isnan(y), np.nan, 0.0)
        n_smaller = np.searchsorted(self._values, y, side="left")
        n_not_larger = np.searchsorted(self._values, y, side="right")
        return self._cumulative[n_smaller] + nan, self._cumulative[n_not_larger] + nan

    def transform(self, y: Floats, rng: np.random.Generator | None) -> Floats:
        """Return the middle between P(Y < y) and P(Y <= y), or a uniform number between them."""
        lower, upper = self.steps(y)
        return between(lower, upper, rng)


def between(lower: Floats, upper: Floats, rng: np.random.Generator | None) -> Floats:
    """Return the middle of both bounds, or with a generator uniform numbers between them."""
    fraction = 0.5 if rng is None else rng.random(lower.shape)
    return lower + fraction * (upper - lower)


def area(u: Floats) -> Floats:
    r"""Return the exact areas between ECDFs of u, (..., n), and the identity on [0, 1], (...).

    .. math:: A = \int_0^1 |F_n(v) - v| \, dv

    Between two values the ECDF is constant, and the integral of an absolute value of a line
    follows from that of :math:`|v|`, which is :math:`v |v| / 2`.
    """
    *leading, n = u.shape
    zeros = np.zeros((*leading, 1))
    ones = np.ones((*leading, 1))
    ascending = np.sort(u, axis=-1)
    ends = np.concatenate([zeros, ascending, ones], axis=-1)
    ecdf = np.arange(n + 1) / n
    above = ends[..., 1:] - ecdf
    below = ends[..., :-1] - ecdf
    doubled = above * np.abs(above) - below * np.abs(below)
    total = doubled.sum(axis=-1)
    return np.asarray(total / 2)
