"""Null distributions of the area test.

The predicted population is taken as exact (`ExactModel`), uncertain (`PosteriorNull`), or fitted
to the tested specimens themselves (`JointNull`).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from dataclasses import KW_ONLY, dataclass
from functools import cache
from importlib.resources import files
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from prbayes._progress import progress
from prbayes._stats import ENVELOPED, envelope
from prbayes._validate import AT_ONCE, Floats, positive_integer, positive_number, share
from prbayes.validation.conditions import Case
from prbayes.validation.probability_transform import Predictive, between

# The fewest replicates that can reject at 5%: p is at least 1 / 20.
LEAST_REPLICATES = 19


@dataclass(frozen=True, eq=False)
class Judgement:
    """p-value, critical value and envelope: bounds of the sorted values that are tested, (n,)."""

    p_value: float
    critical_value: float
    lower: Floats
    upper: Floats


class Null(ABC):
    """A null distribution: `ExactModel`, `PosteriorNull` or `JointNull`."""

    own_specimens: ClassVar[bool] = False  # whether the calibration's own specimens may be tested

    @abstractmethod
    def judge(self, case: Case, statistic: float, alpha: float) -> Judgement:
        """Return p-value, critical value and envelope."""

    @abstractmethod
    def describe(self, case: Case) -> str:
        """Return the null hypothesis in a phrase."""


def judge_by_replicates(
    replicates: Iterable[Floats], case: Case, statistic: float, alpha: float
) -> Judgement:
    r"""Count the observed data among replicates, blocks of u-values of shapes (r, n).

    .. math:: p = (1 + \#\{A_r \ge A\}) / (1 + r)
    """
    enveloped: Floats | None = None
    blocks = []
    with progress("replicates") as report:
        for u in replicates:
            tested = case.tested(u)
            if enveloped is None:
                enveloped = tested[:ENVELOPED]
            blocks.append(case.statistic(u))
            report(len(tested), "")
    assert enveloped is not None
    areas = np.sort(np.concatenate(blocks))
    total = areas.size + 1
    # Replicates that may be as large in a rejection; rounding must not make .05 * 20 less than one.
    allowed = int(np.floor(alpha * total + 1e-9)) - 1
    if allowed < 0:
        raise ValueError(
            f"alpha: got {alpha} with {areas.size} replicates, expected at least "
            f"1 / ({areas.size} + 1); pass a null with more replicates"
        )
    # Rounding must not make a tie a difference.
    n_as_large = np.sum(areas >= statistic * (1 - 1e-12))
    lower, upper = envelope(enveloped, alpha)
    return Judgement(
        p_value=float((1 + n_as_large) / total),
        critical_value=float(areas[areas.size - allowed - 1]),
        lower=lower,
        upper=upper,
    )


@dataclass(frozen=True)
class PosteriorNull(Null):
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
    _: KW_ONLY
    random_seed: int = 0

    def __post_init__(self) -> None:
        positive_integer(self.replicates, "PosteriorNull: replicates", minimum=LEAST_REPLICATES)
        positive_integer(self.random_seed, "PosteriorNull: random_seed", minimum=0)

    def judge(self, case: Case, statistic: float, alpha: float) -> Judgement:
        """Count the observed data among the replicates."""
        return judge_by_replicates(self.replicates_of(case), case, statistic, alpha)

    def replicates_of(self, case: Case) -> Iterator[Floats]:
        """Draw u-values of replicates, in blocks of shapes (r, n)."""
        rng = np.random.default_rng(self.random_seed)
        rng_of_ties = case.rng(1)
        pools = _pools(case)
        draws = np.flatnonzero(np.min([pool.counts for pool in pools], axis=0) > 0)
        if not draws.size:
            raise ValueError(
                "predicted: got NaN in every draw, expected specimens whose responses are numbers"
            )
        # Every draw of the posterior equally often, in random order.
        draw_of = rng.permutation(draws[np.arange(self.replicates) % draws.size])
        # Results depend on the size of blocks, which come one after another from one generator.
        step = max(1, AT_ONCE // case.size)
        for start in range(0, self.replicates, step):
            draw = draw_of[start : start + step, None]
            # The place of a specimen in its population, from 0 to 1. The same place in every
            # condition is the same sample, hence the same specimen.
            place = rng.random((draw.size, case.n_specimens))
            u = []
            for pool in pools:
                rank = (place[:, pool.numbers] * pool.counts[draw]).astype(int)
                sample = pool.order[draw, rank]
                u.append(between(pool.lower[draw, sample], pool.upper[draw, sample], rng_of_ties))
            yield np.concatenate(u, axis=1)

    def describe(self, case: Case) -> str:
        """Return the null hypothesis in a phrase."""
        source = "the predicted population"
        if case.n_draws > 1:
            source = f"one of {case.n_draws} populations of the posterior"
        repeated = ""
        if case.is_dependent:
            repeated = f", {case.n_specimens} specimens with {case.size} values in all"
        return f"all specimens come from {source}{repeated}"


@dataclass(frozen=True, eq=False)
class _Pool:
    """The predicted samples of one condition."""

    numbers: NDArray[np.intp]  # (n,): the specimen of each observation
    lower: Floats  # (D, S): P(Y < y) of each sample in the pool of all draws
    upper: Floats  # (D, S): P(Y <= y)
    order: NDArray[np.intp]  # (D, S): samples of each draw, those with a response first
    counts: NDArray[np.intp]  # (D,): number of samples with a response


def _pools(case: Case) -> list[_Pool]:
    """Return the samples of each condition."""
    usable = [~np.isnan(c.predicted) for c in case.conditions]
    if case.shares_specimens:
        # A specimen has a response under all conditions.
        usable = [np.logical_and.reduce(usable)] * len(usable)
    return [
        _Pool(
            c.numbers,
            *Predictive(c.predicted).steps(c.predicted),
            order=np.argsort(~is_usable, axis=1, kind="stable"),
            counts=np.count_nonzero(is_usable, axis=1),
        )
        for c, is_usable in zip(case.conditions, usable, strict=True)
    ]


@dataclass(frozen=True, eq=False)
class _Table:
    """Quantiles of sqrt(n) A for k sizes n and m tail probabilities."""

    sizes: Floats  # (k,)
    logs: Floats  # (m,): minus the logarithms of tail probabilities, increasing
    quantiles: Floats  # (k, m)

    def at(self, n: int) -> Floats:
        """Return quantiles for n values, (m,), interpolated in 1 / sqrt(n)."""
        sizes = -1 / np.sqrt(self.sizes)
        return np.array([np.interp(-1 / np.sqrt(n), sizes, column) for column in self.quantiles.T])


@cache
def table() -> _Table:
    """Return the table that ships, made by ``benchmarks/area_null.py``."""
    with files(__package__).joinpath("area_null.csv").open(encoding="utf-8") as file:
        _, *header = file.readline().split(",")
        rows = np.loadtxt(file, delimiter=",")
    tails = np.array(header, dtype=np.float64)
    return _Table(sizes=rows[:, 0], logs=-np.log(tails), quantiles=rows[:, 1:])


@dataclass(frozen=True)
class ExactModel(Null):
    """The predicted population is taken as exact.

    u-values of a right model are then independent and uniform.

    The distribution of the area is exact for n = 1 to 20, interpolated in 1/sqrt(n) from exact ones
    up to 1000, and that of 1000, scaled, beyond. The table is made by ``benchmarks/area_null.py``.
    If the model was fitted to data of its own, this test rejects a right model too often: with 15
    data and 20 fresh ones in 21% of cases at nominal 5%.

    Examples
    --------
    >>> import prbayes as prb
    >>> round(prb.validation.ExactModel().critical_value(20), 4)
    0.1298
    """

    def critical_value(self, n: int, alpha: float = 0.05) -> float:
        """Return the area that is exceeded with probability ``alpha`` by n uniform numbers."""
        n = positive_integer(n, "n")
        alpha = share(alpha, "alpha")
        scaled = np.interp(-np.log(alpha), table().logs, table().at(n))
        return float(scaled / np.sqrt(n))

    def p_value(self, statistic: float, n: int) -> float:
        """Return the probability that n uniform numbers have a larger area."""
        n = positive_integer(n, "n")
        if statistic != 0:
            positive_number(statistic, "statistic")
        scaled = np.sqrt(n) * statistic
        quantiles, logs = table().at(n), table().logs
        if scaled <= quantiles[-1]:
            return float(np.exp(-np.interp(scaled, quantiles, logs)))
        # Farther out the logarithm falls like the square (Brownian bridge: exp(-6 x^2)). From
        # n = 20 on, any of the last twelve quantiles gives a slope within 5%.
        last_squared = quantiles[-1] ** 2
        slope = (logs[-1] - logs[-8]) / (last_squared - quantiles[-8] ** 2)
        return float(np.exp(-(logs[-1] + slope * (scaled**2 - last_squared))))

    def judge(self, case: Case, statistic: float, alpha: float) -> Judgement:
        """Look up p-value and critical value; simulate the envelope."""
        if case.is_dependent:
            raise ValueError(
                f"null: got ExactModel() for {case.size} values of {case.n_specimens} specimens, "
                "expected one value per specimen; use prb.validation.PosteriorNull(), which passes "
                "each specimen through all conditions"
            )
        for condition in case.conditions:
            n_predicted, n_observed = condition.predicted.size, condition.observed.size
            # With m times as many the pool itself adds 1 / m to the variance of an ECDF: a tenth
            # makes a test at 5% reject in some 6% of cases.
            if n_predicted < 10 * n_observed:
                raise ValueError(
                    f"{condition.name}: predicted: got {n_predicted} values for {n_observed} "
                    "observed ones, expected at least 10 times as many, so that the population is "
                    "known exactly; pass a larger n_samples"
                )
        uniform = np.random.default_rng(0).random((ENVELOPED, case.size))
        lower, upper = envelope(uniform, alpha)
        return Judgement(
            p_value=self.p_value(statistic, case.size),
            critical_value=self.critical_value(case.size, alpha),
            lower=lower,
            upper=upper,
        )

    def describe(self, case: Case) -> str:
        """Return the null hypothesis in a phrase."""
        return (
            "the predicted population is exact (the uncertainty of its calibration is not counted)"
        )
