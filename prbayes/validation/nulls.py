"""Null distributions of the area test: what the statistic would be if the model were right.

The statistic is the area between the ECDF of u-values and the identity. What a right model gives depends on what the
predicted population is: exact (`ExactModel`), uncertain (`PosteriorNull`), or fitted to the tested specimens
themselves (`JointNull`).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from prbayes._checks import Floats, positive_integer
from prbayes._progress import progress
from prbayes._weighted import cumulated

_BLOCK = 1 << 22  # u-values held at a time
_ENVELOPED = 999  # replicates from which an envelope is made


def area(u: Floats) -> Floats:
    r"""Return the areas between the ECDFs of u, shape (..., n), and the identity on [0, 1]: exact, shape (...).

    .. math:: A = \int_0^1 |F_n(v) - v| \, dv
    """
    n = u.shape[-1]
    ends = np.concatenate([np.zeros((*u.shape[:-1], 1)), np.sort(u, axis=-1), np.ones((*u.shape[:-1], 1))], axis=-1)
    height = np.arange(n + 1) / n
    above, below = ends[..., 1:] - height, ends[..., :-1] - height
    return np.asarray((above * np.abs(above) - below * np.abs(below)).sum(axis=-1) / 2)


class Predictive:
    """The pooled predictive distribution, all draws and samples together.

    Parameters
    ----------
    values : ndarray, any shape
        NaN are left out; +inf counts as the largest value.
    weights : ndarray, same shape, optional
    """

    def __init__(self, values: Floats, weights: Floats | None = None) -> None:
        known = ~np.isnan(values)
        if weights is None:
            self._values = np.sort(values[known])
            self._below = np.arange(self._values.size + 1) / max(1, self._values.size)
            return
        order = np.argsort(values[known])
        self._values = values[known][order]
        below = cumulated(weights[known], order)
        self._below = below / below[-1]

    def steps(self, y: Floats) -> tuple[Floats, Floats]:
        """Return P(Y < y) and P(Y <= y); NaN where y is."""
        nan = np.where(np.isnan(y), np.nan, 0.0)
        left, right = (self._below[np.searchsorted(self._values, y, side=s)] + nan for s in ("left", "right"))
        return left, right

    def transform(self, y: Floats, rng: np.random.Generator | None) -> Floats:
        """Return the middle between P(Y < y) and P(Y <= y), or a uniform number between them."""
        return between(*self.steps(y), rng)


def between(left: Floats, right: Floats, rng: np.random.Generator | None) -> Floats:
    """Return the middle, or uniform numbers between the two."""
    share = 0.5 if rng is None else rng.random(left.shape)
    return np.asarray(left + share * (right - left))


@dataclass(frozen=True, eq=False)
class Condition:
    """What was measured and predicted under one condition.

    Attributes
    ----------
    name : str
    observed : ndarray, shape (n,)
    predicted : ndarray, shape (D, S)
        One row per draw.
    labels : tuple of str, or None
        Of the specimens.
    numbers : ndarray of int, shape (n,)
        The specimens, over all conditions.
    """

    name: str
    observed: Floats
    predicted: Floats
    labels: tuple[str, ...] | None
    numbers: NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Case:
    """All conditions of one test.

    Attributes
    ----------
    conditions : tuple of Condition
    n_specimens : int
    shared : bool
        Whether a specimen occurs in several conditions.
    seed : int or None
        With a seed u-values are randomised within ties.
    folded : bool
        Whether the statistic is the area of abs(2u - 1).
    """

    conditions: tuple[Condition, ...]
    n_specimens: int
    shared: bool
    seed: int | None
    folded: bool = False

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
        return None if self.seed is None else np.random.default_rng([self.seed, stream])

    def tested(self, u: Floats) -> Floats:
        """Return the values that are tested for uniformity."""
        return np.abs(2 * u - 1) if self.folded else u

    def u_values(self) -> list[Floats]:
        """Return the u-values of each condition."""
        rng = self.rng(0)
        return [Predictive(c.predicted).transform(c.observed, rng) for c in self.conditions]


@dataclass(frozen=True, eq=False)
class Judgement:
    """What a null says of a case.

    Attributes
    ----------
    p_value, critical_value : float
    lower, upper : ndarray, shape (n,)
        The envelope: bounds of the sorted values that are tested.
    """

    p_value: float
    critical_value: float
    lower: Floats
    upper: Floats


class Null(ABC):
    """A null distribution: `ExactModel`, `PosteriorNull` or `JointNull`."""

    own_specimens: ClassVar[bool] = False  # whether the calibration's own specimens may be tested

    @abstractmethod
    def judge(self, case: Case, statistic: float, level: float) -> Judgement:
        """Return p-value, critical value and envelope."""

    @abstractmethod
    def describe(self, case: Case) -> str:
        """Return what is held to be true under the null, in a phrase."""


class SimulatedNull(Null):
    """A null distribution of which replicates are drawn."""

    @abstractmethod
    def replicates_of(self, case: Case) -> Iterator[Floats]:
        """Yield u-values of replicates, shapes (r, n)."""

    def judge(self, case: Case, statistic: float, level: float) -> Judgement:
        """Count the observed data among the replicates: p = (1 + number as large) / (1 + number)."""
        some: Floats | None = None
        parts = []
        with progress("replicates") as report:
            for u in self.replicates_of(case):
                tested = case.tested(u)
                some = tested[:_ENVELOPED] if some is None else some
                parts.append(area(tested))
                report(len(tested), "")
        assert some is not None
        found = np.sort(np.concatenate(parts))
        allowed = int(np.floor(level * (found.size + 1) + 1e-9)) - 1
        if allowed < 0:
            raise ValueError(
                f"level: got {level} with {found.size} replicates, expected at least 1 / ({found.size} + 1); "
                "pass a null with more replicates"
            )
        p_value = (1 + np.sum(found >= statistic * (1 - 1e-12))) / (found.size + 1)
        return Judgement(float(p_value), float(found[found.size - allowed - 1]), *envelope(some, level))


def envelope(replicates: Floats, level: float) -> tuple[Floats, Floats]:
    """Return bounds, shapes (n,), of sorted values within which a share 1 - level of replicates, (r, n), lies entirely.

    The bounds of all n leave out the same number of replicates on either side, the largest that will do.
    """
    rows = np.sort(replicates, axis=1)
    columns, size = np.sort(rows, axis=0), len(rows)
    depth = np.full(size, size)
    for column, values in zip(columns.T, rows.T, strict=True):
        as_low, lower = (np.searchsorted(column, values, side=side) for side in ("right", "left"))
        depth = np.minimum(depth, np.minimum(as_low, size - lower))
    depth.sort()
    k = max(1, int(depth[int(level * size)]))
    return columns[k - 1], columns[size - k]


@cache
def _table() -> tuple[Floats, Floats, Floats]:
    """Return sizes, minus the logarithms of tail probabilities, and quantiles of sqrt(n) A."""
    with files(__package__).joinpath("area_null.csv").open(encoding="utf-8") as file:
        levels = np.array(file.readline().split(",")[1:], dtype=np.float64)
        rows = np.loadtxt(file, delimiter=",")
    return rows[:, 0], -np.log(levels), rows[:, 1:]


@dataclass(frozen=True)
class ExactModel(Null):
    """The predicted population is taken as exact: u-values of a right model are independent and uniform.

    The distribution of the area is exact for n = 1 to 20, interpolated in 1/sqrt(n) from exact ones up to 1000, and
    that of 1000, scaled, beyond. The table is made by ``benchmarks/area_null.py``. If the model was fitted to data
    of its own, this test rejects a right model too often: with 15 data and 20 fresh ones in 21% of cases at
    nominal 5%.

    Examples
    --------
    >>> import prbayes as prb
    >>> round(prb.ExactModel().critical_value(20), 4)
    0.1298
    """

    def critical_value(self, n: int, level: float = 0.05) -> float:
        """Return the area that is exceeded with probability ``level`` by n uniform numbers."""
        n = positive_integer(n, "n")
        _, logs, _ = _table()
        return float(np.interp(-np.log(level), logs, self._quantiles(n)) / np.sqrt(n))

    def p_value(self, statistic: float, n: int) -> float:
        """Return the probability that n uniform numbers have a larger area."""
        n = positive_integer(n, "n")
        _, logs, _ = _table()
        x, at = np.sqrt(n) * statistic, self._quantiles(n)
        if x <= at[-1]:
            return float(np.exp(-np.interp(x, at, logs)))
        # Further out the logarithm falls like the square (Brownian bridge: exp(-6 x^2)).
        slope = (logs[-1] - logs[-8]) / (at[-1] ** 2 - at[-8] ** 2)
        return float(np.exp(-(logs[-1] + slope * (x**2 - at[-1] ** 2))))

    def _quantiles(self, n: int) -> Floats:
        sizes, _, rows = _table()
        place = np.interp(-1 / np.sqrt(n), -1 / np.sqrt(sizes), np.arange(sizes.size))
        low = min(int(place), sizes.size - 2)
        return np.asarray(rows[low] + (place - low) * (rows[low + 1] - rows[low]))

    def judge(self, case: Case, statistic: float, level: float) -> Judgement:
        """Look up p-value and critical value; simulate the envelope."""
        if case.dependent:
            raise ValueError(
                f"null: got ExactModel() for {case.size} values of {case.n_specimens} specimens, expected one value "
                "per specimen; use PosteriorNull(), which passes each specimen through all conditions"
            )
        for c in case.conditions:
            if c.predicted.size < 10 * c.observed.size:
                raise ValueError(
                    f"{c.name}: predicted: got {c.predicted.size} values for {c.observed.size} observed ones, expected "
                    "at least 10 times as many, so that the population is known exactly; pass a larger n_samples"
                )
        bounds = envelope(np.random.default_rng(0).random((_ENVELOPED, case.size)), level)
        return Judgement(self.p_value(statistic, case.size), self.critical_value(case.size, level), *bounds)

    def describe(self, case: Case) -> str:
        """Return what is held to be true."""
        return "the predicted population is exact (the uncertainty of its calibration is not counted)"


@dataclass(frozen=True)
class PosteriorNull(SimulatedNull):
    """The specimens come from one of the posterior's populations; u-values are taken in the pool of all.

    Each replicate takes one draw of the posterior, the same under all conditions, and all its values from that
    population; a specimen that was measured several times is one sample. Replicates drawn value by value from the pool
    would be as narrow as if the model were exact.

    Parameters
    ----------
    replicates : int
    seed : int

    Examples
    --------
    >>> PosteriorNull(1999)
    PosteriorNull(replicates=1999, seed=0)
    """

    replicates: int = 9999
    seed: int = 0

    def __post_init__(self) -> None:
        positive_integer(self.replicates, "PosteriorNull: replicates", minimum=19)
        positive_integer(self.seed, "PosteriorNull: seed", minimum=0)

    def replicates_of(self, case: Case) -> Iterator[Floats]:
        """Draw replicates."""
        rng, ties = np.random.default_rng(self.seed), case.rng(1)
        usable = [~np.isnan(c.predicted) for c in case.conditions]
        if case.shared:
            usable = [np.logical_and.reduce(usable)] * len(usable)
        counts = [np.count_nonzero(ok, axis=1) for ok in usable]
        order = [np.argsort(~ok, axis=1, kind="stable") for ok in usable]
        steps = [Predictive(c.predicted).steps(c.predicted) for c in case.conditions]
        draws = np.flatnonzero(np.min(counts, axis=0) > 0)
        if not draws.size:
            raise ValueError("predicted: got NaN in every draw, expected specimens whose responses are numbers")
        each = rng.permutation(draws[np.arange(self.replicates) % draws.size])
        step = max(1, _BLOCK // case.size)
        for i in range(0, self.replicates, step):
            d = each[i : i + step, None]
            place = rng.random((d.size, case.n_specimens))
            u = []
            for c, count, at, (left, right) in zip(case.conditions, counts, order, steps, strict=True):
                # The same place in every condition: the same sample, hence the same specimen.
                which = at[d, (place[:, c.numbers] * count[d]).astype(int)]
                u.append(between(left[d, which], right[d, which], ties))
            yield np.concatenate(u, axis=1)

    def describe(self, case: Case) -> str:
        """Return what is held to be true."""
        several = f"one of {case.draws} populations of the posterior" if case.draws > 1 else "the predicted population"
        repeated = f", {case.n_specimens} specimens measured {case.size} times" if case.dependent else ""
        return f"all specimens come from {several}{repeated}"
