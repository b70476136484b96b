"""What was measured and predicted, condition by condition: one form for all arguments."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from prbayes._validate import Floats, Seed, flag, real_array, sample_labels, seed_number
from prbayes.metrics.views import View
from prbayes.model.fingerprint import Identity, Level, from_attributes, require_together
from prbayes.response.outputs import Outputs, read_observed
from prbayes.results.predict import specimen_names
from prbayes.validation.predictive import Predictive
from prbayes.validation.statistic import area
from prbayes.validation.views import views

Predicted = xr.DataArray | NDArray[Any]

# Between the name of a condition and that of a direction in which its outputs are seen.
DIRECTION = ", direction "


@dataclass(frozen=True, eq=False)
class Condition:
    """What was measured and predicted under one condition."""

    name: str
    observed: Floats  # (n,)
    predicted: Floats  # (D, S): one row per draw
    measured: Floats  # (n,), or (n, m) of several outputs, of which the view shows what is observed
    labels: tuple[str, ...] | None  # of the specimens
    numbers: NDArray[np.intp]  # (n,): the specimens, over all conditions
    # Of the prediction, as `predict` notes them.
    attributes: Mapping[Any, Any] = field(default_factory=dict)
    view: View = field(default_factory=View)
    # Of the values together with which it is held against the identity, and its share there.
    group: int = 0
    share: float = 1.0

    @property
    def of(self) -> str:
        """The name of the condition, of which this may be one direction."""
        return self.name.split(DIRECTION)[0]

    @property
    def identity(self) -> Identity | None:
        """Of the problem that was calibrated, where the prediction tells."""
        return from_attributes(self.attributes)

    @property
    def specimens(self) -> tuple[str, ...]:
        """Names of the specimens: labels, or else the condition and a number."""
        if self.labels is not None:
            return self.labels
        return tuple(f"{self.of}, {i}" for i in range(self.observed.size))


@dataclass(frozen=True, eq=False)
class Case:
    """All conditions of one test."""

    conditions: tuple[Condition, ...]
    n_specimens: int
    shared: bool  # whether a specimen occurs in several conditions
    randomize: bool = False  # whether u-values of ties are random within their step
    random_seed: int | None = 0
    folded: bool = False  # whether the statistic is the area of abs(2u - 1)
    # Of the problem whose calibration predicted all conditions, where predictions tell.
    identity: Identity | None = None

    @property
    def size(self) -> int:
        """Number of observations."""
        return sum(c.observed.size for c in self.conditions)

    @property
    def draws(self) -> int:
        """Number of populations predicted for each condition."""
        return len(self.conditions[0].predicted)

    @property
    def dependent(self) -> bool:
        """Whether a specimen was measured several times."""
        return self.n_specimens < self.size

    def statistic(self, u: Floats) -> Floats:
        """Return the statistic of u-values, (..., n) -> (...).

        The area of all values together. Of several outputs the mean over the directions in which
        they are seen, and of two areas, that of u and that of abs(2u - 1): a wrong correlation is a
        wrong spread in some of them.
        """
        tested = self.tested(u)
        groups = np.repeat(
            [c.group for c in self.conditions], [c.observed.size for c in self.conditions]
        )
        shares = {c.group: c.share for c in self.conditions}
        if list(shares) == [0]:
            return area(tested)
        areas = []
        for group, share in shares.items():
            own = tested[..., groups == group]
            both = group > 0 and not self.folded
            mean = (area(own) + area(np.abs(2 * own - 1))) / 2 if both else area(own)
            areas.append(share * mean)
        return np.sum(areas, axis=0)

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
        found = []
        for condition in self.conditions:
            pool = Predictive(condition.predicted)
            found.append(pool.transform(condition.observed, rng))
        return np.concatenate(found)


def read_case(
    observed: Any,
    predicted: Any,
    specimens: Any = None,
    *,
    folded: bool = False,
    randomize: bool = False,
    random_seed: Seed = 0,
) -> Case:
    """Return the conditions, checked; arguments are those of `area_test`.

    Raises
    ------
    TypeError, ValueError
        If an argument is not as described there.
    """
    seed = None if random_seed is None else seed_number(random_seed)
    flag(folded, "folded")
    flag(randomize, "randomize")
    numbers: dict[object, int] = {}
    conditions: list[Condition] = []
    for name, measured, simulated, labels in _by_condition(observed, predicted, specimens):
        y = _measured(name, measured, simulated)
        named = _labels(name, labels, len(y))
        # Without labels every value is of a specimen of its own.
        keys: Sequence[object] = [(name, i) for i in range(len(y))] if named is None else named
        own = [numbers.setdefault(key, len(numbers)) for key in keys]
        pool = _simulated(name, simulated, y.shape[1:])
        condition = Condition(
            name=name,
            observed=y,
            predicted=pool,
            measured=y,
            labels=named,
            numbers=np.array(own, dtype=np.intp),
            attributes=simulated.attrs if isinstance(simulated, xr.DataArray) else {},
        )
        conditions += [condition] if y.ndim == 1 else _in_directions(condition)
    conditions = _with_shares(conditions)
    _refuse_other_draws(conditions)
    identities = {f"{c.name}: predicted": c.identity for c in conditions}
    identity = require_together(identities, "area_test", level=Level.OPTIMUM)
    # The directions of one condition are of the same predictions.
    by_name = {c.of: np.unique(c.numbers).size for c in conditions}
    return Case(
        conditions=tuple(conditions),
        n_specimens=len(numbers),
        shared=sum(by_name.values()) > len(numbers),
        randomize=randomize,
        random_seed=seed,
        folded=folded,
        identity=identity,
    )


def _in_directions(condition: Condition) -> list[Condition]:
    """Return what is seen of several outputs in each of some directions of the predicted ones."""
    pool = condition.predicted
    found = []
    for k, view in enumerate(views(pool)):
        found.append(
            replace(
                condition,
                name=f"{condition.name}{DIRECTION}{k + 1}",
                observed=view.of(condition.measured),
                predicted=view.of(pool),
                view=view,
                group=k + 1,
            )
        )
    return found


def _with_shares(conditions: list[Condition]) -> list[Condition]:
    """Return conditions with the shares that groups of them have in the statistic.

    Directions share alike; a condition of one output counts by its number of values.
    """
    total = sum(c.observed.size for c in conditions)
    sizes: dict[int, int] = {}
    for c in conditions:
        sizes[c.group] = sizes.get(c.group, 0) + c.observed.size
    return [replace(c, share=sizes[c.group] / total) for c in conditions]


def _refuse_other_draws(conditions: list[Condition]) -> None:
    """Raise if conditions were predicted with different numbers of draws."""
    draws = [len(c.predicted) for c in conditions]
    if len(set(draws)) > 1:
        names = [c.name for c in conditions]
        raise ValueError(
            f"predicted: got {draws} draws for the conditions {names}, expected the same draws of "
            "one posterior in all; pass the same result and draws= to prb.predict"
        )


def _by_condition(
    observed: Any, predicted: Any, specimens: Any
) -> Iterator[tuple[str, Any, Any, Any]]:
    """Yield name, observed, predicted and specimens of each condition, from any form."""
    if isinstance(predicted, Mapping):
        yield from _by_name(observed, predicted, specimens)
    elif isinstance(predicted, list | tuple):
        yield from _by_position(observed, predicted, specimens)
    elif isinstance(observed, Mapping):
        raise ValueError(
            f"predicted: got {type(predicted).__name__}, expected a mapping with the conditions of "
            "observed"
        )
    else:
        name = getattr(predicted, "name", None)
        yield str(name) if name else "observed", observed, predicted, specimens


def _by_name(
    observed: Any, predicted: Mapping[Any, Any], specimens: Any
) -> Iterator[tuple[str, Any, Any, Any]]:
    """Yield conditions of mappings; labels may be of some conditions only."""
    labels = {} if specimens is None else specimens
    names = set(predicted)
    _refuse_keys("observed", observed, predicted, lambda keys: keys == names)
    _refuse_keys("specimens", labels, predicted, lambda keys: keys <= names)
    for name in predicted:
        yield str(name), observed[name], predicted[name], labels.get(name)


def _refuse_keys(
    what: str, given: Any, predicted: Mapping[Any, Any], right: Callable[[set[Any]], bool]
) -> None:
    """Raise if an argument is no mapping with the right keys."""
    if isinstance(given, Mapping) and right(set(given)):
        return
    got = sorted(map(str, given)) if isinstance(given, Mapping) else type(given).__name__
    names = [str(name) for name in predicted]
    raise ValueError(
        f"{what}: got {got}, expected a mapping with the conditions of predicted, {names}"
    )


def _by_position(
    observed: Any, predicted: Sequence[Any], specimens: Any
) -> Iterator[tuple[str, Any, Any, Any]]:
    """Yield conditions of lists, whose names are their numbers."""
    n = len(predicted)
    labels = [None] * n if specimens is None else specimens
    for what, given in (("observed", observed), ("specimens", labels)):
        is_list = isinstance(given, list | tuple)
        if not is_list or len(given) != n or not n:
            got = f"{len(given)} conditions" if is_list else type(given).__name__
            raise ValueError(
                f"{what}: got {got}, expected a list with the {n} conditions of predicted; one "
                "prediction alone is an array"
            )
    for i in range(n):
        yield str(i), observed[i], predicted[i], labels[i]


def _labels(name: str, labels: Any, n: int) -> tuple[str, ...] | None:
    """Return the labels of n observations as text."""
    if labels is None:
        return None
    return tuple(specimen_names(sample_labels(labels, n, f"{name}: specimens")))


def _measured(name: str, values: Any, simulated: Any) -> Floats:
    """Return measured values, shape (n,), or (n, m) of several outputs."""
    y, outputs = read_observed(name, values)
    if y.ndim not in (1, 2) or y.size == 0:
        raise ValueError(
            f"{name}: observed: got shape {y.shape}, expected (n,), or (n, m) for m outputs, with "
            "n >= 1 measured responses"
        )
    bad = int((np.isnan(y) | np.isneginf(y)).sum())
    if bad:
        raise ValueError(
            f"{name}: observed: got {bad} NaN or -inf among {y.size} values, expected numbers; "
            "leave missing specimens out, and give those that had failed as +inf"
        )
    return _in_order_of(name, y, outputs, simulated) if y.ndim > 1 else y


def _in_order_of(name: str, y: Floats, outputs: Outputs, simulated: Any) -> Floats:
    """Return measured outputs, (n, m), in the order of predicted ones, where both have names."""
    default = tuple(range(len(outputs.labels)))
    if not isinstance(simulated, xr.DataArray) or outputs.labels == default:
        return y
    named = [dim for dim in simulated.dims if dim not in ("chain", "draw", "sample")]
    if len(named) != 1 or named[0] not in simulated.coords:
        return y
    labels = tuple(simulated.coords[named[0]].values.tolist())
    if labels in (default, outputs.labels):
        return y
    if set(labels) != set(outputs.labels):
        raise ValueError(
            f"{name}: observed: got the outputs {list(outputs.labels)}, expected {list(labels)}, "
            "those of predicted"
        )
    return y[:, [outputs.labels.index(label) for label in labels]]


def _simulated(name: str, values: Any, event: tuple[int, ...]) -> Floats:
    """Return predicted values, shape (D, S, *event)."""
    if isinstance(values, xr.DataArray):
        own = ("chain", "draw", "sample")
        if not set(own) <= set(values.dims) or len(values.dims) != 3 + len(event):
            also = f", and one for the {event[0]} outputs that are observed" if event else ""
            raise ValueError(
                f"{name}: predicted: got a DataArray with dims {values.dims}, expected (chain, "
                f"draw, sample){also}, as prb.predict returns"
            )
        values = values.transpose(*own, ...).values
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
    return np.asarray(y.reshape(-1, *y.shape[y.ndim - n_axes :]))
