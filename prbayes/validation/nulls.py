"""Null distributions of the area test: what the statistic would be if the model were right.

What a right model gives depends on what the predicted population is: exact (`ExactModel`),
uncertain (`PosteriorNull`), or fitted to the tested specimens themselves (`JointNull`).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from prbayes._progress import progress
from prbayes._stats import ENVELOPED, envelope
from prbayes._validate import AT_ONCE, Floats, positive_integer
from prbayes.validation.conditions import Case, Condition
from prbayes.validation.predictive import Predictive, between

# The fewest replicates that can reject at 5%: p is at least 1 / 20.
LEAST_REPLICATES = 19


@dataclass(frozen=True, eq=False)
class Judgement:
    """What a null says of a case."""

    p_value: float
    critical_value: float
    # (n,): the envelope: bounds of the sorted values that are tested.
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
        r"""Count the observed data among the replicates.

        .. math:: p = (1 + \#\{A_r \ge A\}) / (1 + r)
        """
        areas, some = self._simulated(case)
        total = areas.size + 1
        # The largest number of replicates, less the observed data, that a rejection allows to be as
        # large; rounding must not make .05 * 20 less than one.
        allowed = int(np.floor(level * total + 1e-9)) - 1
        if allowed < 0:
            raise ValueError(
                f"level: got {level} with {areas.size} replicates, expected at least "
                f"1 / ({areas.size} + 1); pass a null with more replicates"
            )
        # Nor must rounding make a tie a difference.
        as_large = np.sum(areas >= statistic * (1 - 1e-12))
        lower, upper = envelope(some, level)
        return Judgement(
            p_value=float((1 + as_large) / total),
            critical_value=float(areas[areas.size - allowed - 1]),
            lower=lower,
            upper=upper,
        )

    def _simulated(self, case: Case) -> tuple[Floats, Floats]:
        """Return the areas of all replicates, sorted, and tested values of the first few."""
        some: Floats | None = None
        areas = []
        with progress("replicates") as report:
            for u in self.replicates_of(case):
                tested = case.tested(u)
                if some is None:
                    some = tested[:ENVELOPED]
                areas.append(case.statistic(u))
                report(len(tested), "")
        assert some is not None
        return np.sort(np.concatenate(areas)), some


@dataclass(frozen=True)
class PosteriorNull(SimulatedNull):
    """The specimens come from one of the posterior's populations, nobody knows which.

    u-values are taken in the pool of all.

    Each replicate takes one draw of the posterior, the same under all conditions, and all its
    values from that population; a specimen that was measured several times is one sample.
    Replicates drawn value by value from the pool would be as narrow as if the model were exact.

    Parameters
    ----------
    replicates : int
    random_seed : int

    Examples
    --------
    >>> PosteriorNull(1999)
    PosteriorNull(replicates=1999, random_seed=0)
    """

    replicates: int = 9999
    random_seed: int = 0

    def __post_init__(self) -> None:
        positive_integer(self.replicates, "PosteriorNull: replicates", minimum=LEAST_REPLICATES)
        positive_integer(self.random_seed, "PosteriorNull: random_seed", minimum=0)

    def replicates_of(self, case: Case) -> Iterator[Floats]:
        """Draw replicates."""
        rng = np.random.default_rng(self.random_seed)
        ties = case.rng(1)
        pools = _pools(case)
        counts = [pool.count for pool in pools]
        draws = np.flatnonzero(np.min(counts, axis=0) > 0)
        if not draws.size:
            raise ValueError(
                "predicted: got NaN in every draw, expected specimens whose responses are numbers"
            )
        # Every draw of the posterior as often as any other, in random order.
        each = rng.permutation(draws[np.arange(self.replicates) % draws.size])
        # Blocks are drawn one after the other from one generator, so that results depend on their
        # size where replicates need more than one.
        step = max(1, AT_ONCE // case.size)
        for start in range(0, self.replicates, step):
            # One population for each replicate, and one place in it for each specimen.
            draw = each[start : start + step, None]
            place = rng.random((draw.size, case.n_specimens))
            u = [pool.u_values(draw, place, ties) for pool in pools]
            yield np.concatenate(u, axis=1)

    def describe(self, case: Case) -> str:
        """Return what is held to be true."""
        source = "the predicted population"
        if case.draws > 1:
            source = f"one of {case.draws} populations of the posterior"
        repeated = ""
        if case.dependent:
            repeated = f", {case.n_specimens} specimens with {case.size} values in all"
        return f"all specimens come from {source}{repeated}"


@dataclass(frozen=True, eq=False)
class _Pool:
    """The predicted samples of one condition, from which replicates are taken."""

    numbers: NDArray[np.intp]  # (n,): the specimen of each observation
    # (D, S): P(Y < y) and P(Y <= y) of each sample in the pool of all.
    left: Floats
    right: Floats
    order: NDArray[np.intp]  # (D, S): samples of each draw, those that can be used first
    count: NDArray[np.intp]  # (D,): how many those are

    @classmethod
    def of(cls, condition: Condition, usable: NDArray[np.bool_]) -> _Pool:
        """Return the pool of a condition, given which samples can be used, shape (D, S)."""
        left, right = Predictive(condition.predicted).steps(condition.predicted)
        return cls(
            numbers=condition.numbers,
            left=left,
            right=right,
            order=np.argsort(~usable, axis=1, kind="stable"),
            count=np.count_nonzero(usable, axis=1),
        )

    def u_values(
        self, draw: NDArray[np.intp], place: Floats, ties: np.random.Generator | None
    ) -> Floats:
        """Return u-values of replicates, shape (r, n).

        Parameters
        ----------
        draw : ndarray of int, shape (r, 1)
            The population of each replicate.
        place : ndarray, shape (r, specimens)
            Where in its population each specimen is, from 0 to 1.
        ties : Generator, optional
        """
        # The same place in every condition: the same sample, hence the same specimen.
        number = (place[:, self.numbers] * self.count[draw]).astype(int)
        sample = self.order[draw, number]
        return between(self.left[draw, sample], self.right[draw, sample], ties)


def _pools(case: Case) -> list[_Pool]:
    """Return the samples that replicates are taken from, by condition."""
    usable = [~np.isnan(c.predicted) for c in case.conditions]
    if case.shared:
        # A specimen is a sample that has a response under all conditions.
        everywhere = np.logical_and.reduce(usable)
        usable = [everywhere for _ in usable]
    return [_Pool.of(c, ok) for c, ok in zip(case.conditions, usable, strict=True)]
