"""`ExactModel`: the area test of a population that is known exactly, by a table."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib.resources import files

import numpy as np

from prbayes._stats import ENVELOPED, envelope
from prbayes._validate import Floats, positive_integer, positive_number, share
from prbayes.validation.conditions import Case
from prbayes.validation.nulls import Judgement, Null


@dataclass(frozen=True, eq=False)
class _Table:
    """Quantiles of sqrt(n) A."""

    sizes: Floats  # (k,): of samples, n
    logs: Floats  # (m,): minus the logarithms of tail probabilities, increasing
    quantiles: Floats  # (k, m)

    def at(self, n: int) -> Floats:
        """Return the quantiles for n values, shape (m,), interpolated in 1 / sqrt(n)."""
        # Increasing, as np.interp wants them; beyond the last size it gives that one's quantiles.
        places = -1 / np.sqrt(self.sizes)
        place = -1 / np.sqrt(n)
        found = [np.interp(place, places, column) for column in self.quantiles.T]
        return np.array(found)


@cache
def table() -> _Table:
    """Return the table that ships, made by ``benchmarks/area_null.py``."""
    with files(__package__).joinpath("area_null.csv").open(encoding="utf-8") as file:
        _, *header = file.readline().split(",")
        levels = np.array(header, dtype=np.float64)
        rows = np.loadtxt(file, delimiter=",")
    return _Table(sizes=rows[:, 0], logs=-np.log(levels), quantiles=rows[:, 1:])


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

    def critical_value(self, n: int, level: float = 0.05) -> float:
        """Return the area that is exceeded with probability ``level`` by n uniform numbers."""
        n = positive_integer(n, "n")
        level = share(level, "level")
        quantiles = table().at(n)
        scaled = np.interp(-np.log(level), table().logs, quantiles)
        return float(scaled / np.sqrt(n))

    def p_value(self, statistic: float, n: int) -> float:
        """Return the probability that n uniform numbers have a larger area."""
        n = positive_integer(n, "n")
        if statistic != 0:
            positive_number(statistic, "statistic")
        scaled = np.sqrt(n) * statistic
        quantiles = table().at(n)
        logs = table().logs
        if scaled <= quantiles[-1]:
            log = np.interp(scaled, quantiles, logs)
            return float(np.exp(-log))
        # Further out the logarithm falls like the square (Brownian bridge: exp(-6 x^2)).
        # From n = 20 on any of the last 12 but one gives a slope within 5%.
        first = -1 - 7
        last_squared = quantiles[-1] ** 2
        first_squared = quantiles[first] ** 2
        slope = (logs[-1] - logs[first]) / (last_squared - first_squared)
        log = logs[-1] + slope * (scaled**2 - last_squared)
        return float(np.exp(-log))

    def judge(self, case: Case, statistic: float, level: float) -> Judgement:
        """Look up p-value and critical value; simulate the envelope."""
        _refuse_dependent(case)
        _refuse_few(case)
        uniform = np.random.default_rng(0).random((ENVELOPED, case.size))
        lower, upper = envelope(uniform, level)
        return Judgement(
            p_value=self.p_value(statistic, case.size),
            critical_value=self.critical_value(case.size, level),
            lower=lower,
            upper=upper,
        )

    def describe(self, case: Case) -> str:
        """Return what is held to be true."""
        return (
            "the predicted population is exact (the uncertainty of its calibration is not counted)"
        )


def _refuse_dependent(case: Case) -> None:
    """Raise if a specimen was measured several times."""
    if case.dependent:
        raise ValueError(
            f"null: got ExactModel() for {case.size} values of {case.n_specimens} specimens, "
            "expected one value per specimen; use prb.validation.PosteriorNull(), which passes "
            "each specimen through all conditions"
        )


def _refuse_few(case: Case) -> None:
    """Raise if a population has too few values to be taken as exact."""
    for condition in case.conditions:
        predicted = condition.predicted.size
        observed = condition.observed.size
        # With m times as many the pool itself adds 1 / m to the variance of an ECDF: a tenth makes
        # a test at 5% reject in some 6% of cases.
        if predicted < 10 * observed:
            raise ValueError(
                f"{condition.name}: predicted: got {predicted} values for {observed} observed "
                "ones, expected at least 10 times as many, so that the population is known "
                "exactly; pass a larger n_samples"
            )
