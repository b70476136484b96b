"""What was measured and predicted, condition by condition: one form for all arguments."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from prbayes._checks import Floats, Seed, flag, real_array, sample_labels, seed_number
from prbayes._predict import specimen_names
from prbayes.model.identity import Identity, Level, from_attributes, require_together
from prbayes.validation.predictive import Predictive

Predicted = xr.DataArray | NDArray[Any]


@dataclass(frozen=True, eq=False)
class Condition:
    """What was measured and predicted under one condition."""

    name: str
    observed: Floats  # (n,)
    predicted: Floats  # (D, S): one row per draw
    labels: tuple[str, ...] | None  # of the specimens
    numbers: NDArray[np.intp]  # (n,): the specimens, over all conditions
    # Of the prediction, as `predict` notes them.
    attributes: Mapping[Any, Any] = field(default_factory=dict)

    @property
    def identity(self) -> Identity | None:
        """Of the problem that was calibrated, where the prediction tells."""
        return from_attributes(self.attributes)

    @property
    def specimens(self) -> tuple[str, ...]:
        """Names of the specimens: labels, or else the condition and a number."""
        if self.labels is not None:
            return self.labels
        return tuple(f"{self.name}, {i}" for i in range(self.observed.size))


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
    conditions = []
    for name, measured, simulated, labels in _by_condition(observed, predicted, specimens):
        y = _measured(name, measured)
        named = _labels(name, labels, y.size)
        # Without labels every value is of a specimen of its own.
        keys: Sequence[object] = [(name, i) for i in range(y.size)] if named is None else named
        own = [numbers.setdefault(key, len(numbers)) for key in keys]
        condition = Condition(
            name=name,
            observed=y,
            predicted=_simulated(name, simulated),
            labels=named,
            numbers=np.array(own, dtype=np.intp),
            attributes=simulated.attrs if isinstance(simulated, xr.DataArray) else {},
        )
        conditions.append(condition)
    _refuse_other_draws(conditions)
    identities = {f"{c.name}: predicted": c.identity for c in conditions}
    identity = require_together(identities, "area_test", level=Level.OPTIMUM)
    distinct = sum(np.unique(c.numbers).size for c in conditions)
    return Case(
        conditions=tuple(conditions),
        n_specimens=len(numbers),
        shared=distinct > len(numbers),
        randomize=randomize,
        random_seed=seed,
        folded=folded,
        identity=identity,
    )


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


def _measured(name: str, values: Any) -> Floats:
    """Return measured values, shape (n,)."""
    y = real_array(values, f"{name}: observed")
    if y.ndim != 1 or y.size == 0:
        raise ValueError(
            f"{name}: observed: got shape {y.shape}, expected (n,) with n >= 1 measured responses"
        )
    bad = int((np.isnan(y) | np.isneginf(y)).sum())
    if bad:
        raise ValueError(
            f"{name}: observed: got {bad} NaN or -inf among {y.size} values, expected numbers; "
            "leave missing specimens out, and give those that had failed as +inf"
        )
    return y


def _simulated(name: str, values: Any) -> Floats:
    """Return predicted values, shape (D, S)."""
    if isinstance(values, xr.DataArray):
        if set(values.dims) != {"chain", "draw", "sample"}:
            raise ValueError(
                f"{name}: predicted: got a DataArray with dims {values.dims}, expected (chain, "
                "draw, sample), as prb.predict returns"
            )
        values = values.transpose("chain", "draw", "sample").values
    y = real_array(values, f"{name}: predicted")
    if y.ndim == 0 or y.size == 0:
        raise ValueError(
            f"{name}: predicted: got shape {y.shape}, expected (..., S): specimens in the last axis"
        )
    if np.isneginf(y).any() or np.isnan(y).all():
        raise ValueError(
            f"{name}: predicted: got -inf, or nothing but NaN, expected numbers; +inf is a failed "
            "specimen"
        )
    return np.asarray(y.reshape(-1, y.shape[-1]))
