"""Data sheets: statistics of n specimens that are not known themselves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.special import ndtri

from prbayes._validate import (
    ArrayPair,
    Floats,
    number,
    positive_integer,
    positive_number,
    wrong_value,
)


@dataclass(frozen=True, kw_only=True)
class Summary:
    """Statistics of n specimens from a data sheet, as ``observed`` of a `Simulator`.

    The simulator's log-density is the log-likelihood of these statistics. Extremes and quantiles
    enter by the density of order statistics, mean and standard deviation given these by the central
    limit theorem. The statistics are those of a sample: no "typical" and no "guaranteed" values.

    Parameters
    ----------
    n : int
        Number of specimens, at least two.
    mean : float, optional
        Their mean, in units of the response, as are all other statistics.
    sd : float, optional
        Their standard deviation, with n - 1 in the denominator.
    minimum, maximum : float, optional
        The smallest and the largest of them.
    quantiles : mapping of float to float, optional
        Values by level, such as ``{0.25: 310.0, 0.5: 330.0}``. The quantile of level p has the rank
        1 + (n - 1) p, as in ``numpy.quantile``.

    Raises
    ------
    TypeError, ValueError
        If a statistic is no number, if there is none beside n, if no sample has these statistics,
        or if extremes and quantiles have no spread beside them by which a density can be smoothed.

    Notes
    -----
    Densities at extremes and quantiles have a kernel of .175 n^(-1/4) standard deviations. For
    populations with much heavier tails than the normal distribution, and few specimens, the
    standard deviation has a distribution that is far from the approximation [2]_.

    References
    ----------
    .. [1] David, H. A. and H. N. Nagaraja (2003), Order statistics, 3rd ed., Wiley.
    .. [2] Wilson, E. B. and M. M. Hilferty (1931), The distribution of chi-square, PNAS 17,
       684-688, doi:10.1073/pnas.17.12.684.

    Examples
    --------
    >>> Summary(n=20, mean=331.0, sd=12.5, minimum=305.0)
    Summary(n=20, mean=331.0, sd=12.5, minimum=305.0)
    """

    n: int
    mean: float | None = None
    sd: float | None = None
    minimum: float | None = None
    maximum: float | None = None
    quantiles: Mapping[float, float] | None = field(default=None, hash=False)

    def __post_init__(self) -> None:
        checked: dict[str, Any] = {"n": positive_integer(self.n, "Summary: n", minimum=2)}
        for name in ("mean", "sd", "minimum", "maximum"):
            value = getattr(self, name)
            if value is not None:
                check = positive_number if name == "sd" else number
                checked[name] = float(check(value, f"Summary: {name}"))
        if self.quantiles is not None:
            checked["quantiles"] = _checked_quantiles(self.quantiles)
        for name, value in checked.items():
            object.__setattr__(self, name, value)
        if self.mean is None and not self.order_statistics.size:
            raise ValueError(
                f"Summary: got {self}, expected at least one statistic beside n that locates the "
                "population: mean=, minimum=, maximum= or quantiles="
            )
        self._refuse_impossible()
        if len(self.order_statistics) and not self.unit > 0:
            raise ValueError(
                f"Summary: got {self}, expected a spread beside extremes and quantiles, without "
                "which a density at them cannot be smoothed; add sd=, or a second one of them"
            )

    def __repr__(self) -> str:
        """Show the statistics that are given."""
        values = {name: getattr(self, name) for name in self.__dataclass_fields__}
        arguments = [f"{name}={value!r}" for name, value in values.items() if value is not None]
        return f"Summary({', '.join(arguments)})"

    @property
    def order_statistics(self) -> Floats:
        """Ranks from 1 to n and values of extremes and quantiles in this order, (I, 2)."""
        rows = [] if self.minimum is None else [(1.0, self.minimum)]
        rows += [(1 + (self.n - 1) * p, q) for p, q in sorted((self.quantiles or {}).items())]
        rows += [] if self.maximum is None else [(float(self.n), self.maximum)]
        return np.array(rows, dtype=np.float64).reshape(-1, 2)

    @property
    def values(self) -> Floats:
        """Mean, order statistics, and the first of them minus and plus one standard deviation."""
        places = [] if self.mean is None else [self.mean]
        places += [*self.order_statistics[:, 1]]
        if self.sd is not None:
            places += [places[0] - self.sd, places[0] + self.sd]
        return np.array(places, dtype=np.float64)

    def values_of(self, specimens: Floats) -> Floats:
        """Return the same statistics of other specimens, (..., n) -> (..., statistics)."""
        levels = (self.order_statistics[:, 0] - 1) / (self.n - 1)
        columns = [] if self.mean is None else [specimens.mean(axis=-1)]
        columns += [*np.quantile(specimens, levels, axis=-1)]
        if self.sd is not None:
            sd = specimens.std(axis=-1, ddof=1)
            columns += [columns[0] - sd, columns[0] + sd]
        return np.stack(columns, axis=-1)

    @property
    def center(self) -> float:
        """The center of the sample, which is subtracted from responses."""
        return float(self.values.mean()) if self.mean is None else float(self.mean)

    @property
    def unit(self) -> float:
        """The standard deviation, or that of a normal sample with these statistics; else zero."""
        if self.sd is not None:
            return float(self.sd)
        rank, value = self.order_statistics.T
        score = ndtri((rank - 0.375) / (self.n + 0.25))  # Blom's expected normal order statistics
        if self.mean is not None:
            score = np.append(score, 0.0)
            value = np.append(value, self.mean)
        score = score - score.mean() if score.size else score
        square = float(score @ score)
        return float(score @ value) / square if square > 1e-12 else 0.0

    def _refuse_impossible(self) -> None:
        """Raise if no sample has these statistics."""
        values = self.order_statistics[:, 1]
        if (np.diff(values) <= 0).any():
            raise ValueError(
                f"Summary: got minimum, quantiles and maximum {values.tolist()}, expected numbers "
                "that increase; leave one of two equal ones out"
            )
        lower, upper = self._limits()
        low = float(lower.mean())
        high = float(upper.mean())
        # Allow for the rounding of the statistics.
        spread = values[-1] - values[0] if values.size else 0.0
        rounding = 0.01 * max(spread, self.sd or 0.0)
        if self.mean is not None and not low - rounding <= self.mean <= high + rounding:
            raise ValueError(
                f"Summary: mean: got {self.mean}, expected a number from {low:.6g} to {high:.6g}, "
                f"which {self.n} specimens with these extremes and quantiles can have; look at "
                "the units and the order of the statistics"
            )
        smallest, largest = _range_of_sd(lower, upper, self.mean)
        rounding = 5e-4 * np.abs(self.values).max()
        low = 0.99 * smallest - rounding
        high = 1.01 * largest + rounding
        if self.sd is not None and not low <= self.sd <= high:
            raise ValueError(
                f"Summary: sd: got {self.sd}, expected from {smallest:.4g} to {largest:.4g}, which "
                f"{self.n} specimens with this mean, these extremes and quantiles can have; is it "
                "a standard error?"
            )
        levels = [*(self.quantiles or {0.0: 0.0})]
        is_wide = max(levels) - min(levels) >= 0.5
        if self.sd is None and is_wide and low > 10 * (values[-1] - values[0]):
            raise ValueError(
                f"Summary: mean: got {self.mean} beside quantiles from {values[0]} to "
                f"{values[-1]}, which need a standard deviation of at least {smallest:.4g}; "
                "expected statistics of one sample in the same units; leave the mean or the "
                "quantiles out"
            )

    def _limits(self) -> ArrayPair:
        """Return the smallest and the largest value of each specimen, sorted, both (n,).

        A quantile between two specimens has a rank that depends on its definition: n p + p or
        n p + 1 - p, and others between these.
        """
        rank, value = self.order_statistics.T
        second_rank = (self.n + 1) * (rank - 1) / (self.n - 1)
        second_rank = np.where((rank == 1) | (rank == self.n), rank, second_rank)
        number = np.arange(1, self.n + 1)
        n_below = np.searchsorted(np.maximum(rank, second_rank) - 1e-9, number, side="right")
        n_not_above = np.searchsorted(np.minimum(rank, second_rank) + 1e-9, number, side="left")
        return np.append(-np.inf, value)[n_below], np.append(value, np.inf)[n_not_above]


def _range_of_sd(lower: Floats, upper: Floats, mean: float | None) -> tuple[float, float]:
    """Return the smallest and largest standard deviation of sorted values within limits, (n,).

    The smallest one has all values as near to a number as the limits allow, the largest one all
    values at their limits, low ones at the lower and high ones at the upper limit (Bhatia and Davis
    2000, doi:10.1080/00029890.2000.12005203).
    """
    n = len(lower)

    def sd(values: Floats) -> float:
        return float(np.std(values, ddof=1))

    ends = np.concatenate([lower, upper])
    ends = ends[np.isfinite(ends)]
    if mean is None:
        centers = np.linspace(ends.min(), ends.max(), 201)
        smallest = min(sd(np.clip(center, lower, upper)) for center in centers)
    else:
        from scipy.optimize import brentq

        mean = float(np.clip(mean, lower.mean(), upper.mean()))
        # The mean of clipped values increases with the center.
        width = n * (np.ptp(np.append(ends, mean)) + 1e-12)
        center = brentq(
            lambda c: float(np.clip(c, lower, upper).mean()) - mean, mean - width, mean + width
        )
        smallest = sd(np.clip(center, lower, upper))
    if not (np.isfinite(lower).all() and np.isfinite(upper).all()):
        return smallest, np.inf
    # Sums with the first k values at their lower limit, k = 0, ..., n.
    sums = upper.sum() - np.append(0.0, np.cumsum(upper - lower))
    squares = (upper**2).sum() - np.append(0.0, np.cumsum(upper**2 - lower**2))
    if mean is None:
        return smallest, float(np.sqrt((squares - sums**2 / n).max() / (n - 1)))
    return smallest, float(np.sqrt(np.interp(-mean * n, -sums, squares - sums**2 / n) / (n - 1)))


def _checked_quantiles(quantiles: object) -> dict[float, float]:
    """Return quantiles by levels between 0 and 1, or raise."""
    if not isinstance(quantiles, Mapping) or not quantiles:
        raise wrong_value(
            quantiles,
            "Summary: quantiles",
            "a mapping of levels to values, such as {0.25: 310.0, 0.5: 330.0}",
        )
    checked = {}
    for level, value in quantiles.items():
        if not 0 < number(level, "Summary: quantiles: level") < 1:
            raise ValueError(
                f"Summary: quantiles: got the level {level}, expected one between 0 and 1; pass "
                "minimum= and maximum= for the extremes"
            )
        checked[float(level)] = float(number(value, f"Summary: quantiles: value at {level}"))
    return checked
