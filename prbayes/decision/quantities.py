"""Decision quantities: functionals of the distribution of a response, such as its quantiles."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product
from typing import Any

import numpy as np
from scipy.special import log_ndtr, logsumexp

from prbayes._stats import ascending_quantile
from prbayes._validate import Floats, Function, finite_number, flag, share
from prbayes.model.random_variable import response_name
from prbayes.numerics.points import sobol
from prbayes.response.response import refuse_uncallable


class Quantity(ABC):
    """A functional of the distribution of a response; derive from it to define another one.

    Parameters
    ----------
    response : callable
        As for `Simulator`; that of a simulator of the model, or another one of the same specimens.
    *inputs
        As for `predict`.
    output : label, optional
        Which output, where a run of the response gives several: a label, or its place.

    Attributes
    ----------
    needs_finite : bool
        Whether no specimen may have failed (+inf).
    differentiable : bool
        Whether `of_specimen` has derivatives where the response has.
    of_inputs : str
        Description of the number that `of_specimen` returns.

    Raises
    ------
    TypeError
        If the response is not callable.
    """

    needs_finite = False
    differentiable = True
    of_inputs = "the response"

    def __init__(self, response: Function, *inputs: Any, output: Any = None) -> None:
        name = type(self).__name__
        order = f"{name}(response, *inputs, ...)"
        refuse_uncallable(f"prb.decision.{name}", response, order=order)
        self.response = response
        self.inputs = inputs
        self.output = output

    def __repr__(self) -> str:
        name = response_name(self.response, self.output)
        return f"{self.label} of {name}"

    @property
    def label(self) -> str:
        """The name of the functional, such as "mean"."""
        return type(self).__name__

    @abstractmethod
    def of(self, values: Floats, weights: Floats) -> Floats:
        """Return the quantity of each population.

        Parameters
        ----------
        values : ndarray, shape (n,)
            Responses in ascending order; +inf is a specimen that failed.
        weights : ndarray, shape (k, n)
            Weights of the responses in each population, with sum one.

        Returns
        -------
        ndarray, shape (k,)
        """

    def of_specimen(self, values: Floats, at: float) -> Floats:
        """Return the number of each specimen whose variance is attributed to the inputs.

        It is the response by default. ``at`` is the quantity of the population.
        """
        return values


class Mean(Quantity):
    """The mean of a response over the population.

    Parameters
    ----------
    response : callable
        As for `Simulator`; that of a simulator of the model, or another one of the same specimens.
    *inputs
        As for `predict`.
    output : label, optional
        Which output, where a run of the response gives several: a label, or its place.

    Raises
    ------
    TypeError
        If the response is not callable.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> prb.decision.Mean(np.square, pm.Normal.dist())
    mean of square
    """

    needs_finite = True
    label = "mean"

    def of(self, values: Floats, weights: Floats) -> Floats:
        """Return the means."""
        return weights @ values


class StandardDeviation(Quantity):
    """The standard deviation of a response over the population.

    Parameters
    ----------
    response : callable
        As for `Simulator`; that of a simulator of the model, or another one of the same specimens.
    *inputs
        As for `predict`.
    output : label, optional
        Which output, where a run of the response gives several: a label, or its place.

    Raises
    ------
    TypeError
        If the response is not callable.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> prb.decision.StandardDeviation(np.square, pm.Normal.dist())
    standard deviation of square
    """

    needs_finite = True
    label = "standard deviation"

    def of(self, values: Floats, weights: Floats) -> Floats:
        """Return the standard deviations."""
        # Subtract a central value, against cancellation.
        deviation = values - values[values.size // 2]
        variance = weights @ deviation**2 - (weights @ deviation) ** 2
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


class Quantile(Quantity):
    """A quantile of a response over the population.

    Parameters
    ----------
    response, *inputs, output
        As for `Quantity`.
    probability : float
        Between 0 and 1.

    Raises
    ------
    TypeError, ValueError
        If an argument is not as described.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> prb.decision.Quantile(np.square, pm.Normal.dist(), probability=0.99)
    99% quantile of square
    """

    differentiable = False
    of_inputs = "whether a specimen is beyond the quantile"

    def __init__(
        self,
        response: Function,
        *inputs: Any,
        probability: float,
        output: Any = None,
    ) -> None:
        super().__init__(response, *inputs, output=output)
        self.probability = share(probability, "probability")

    @property
    def label(self) -> str:
        """The name of the functional."""
        return f"{100 * self.probability:g}% quantile"

    def of(self, values: Floats, weights: Floats) -> Floats:
        """Return the quantiles, by interpolation between the middles of the steps."""
        return np.array([ascending_quantile(values, row, self.probability) for row in weights])

    def of_specimen(self, values: Floats, at: float) -> Floats:
        """Return whether each specimen is beyond the population's quantile."""
        return (values > at).astype(float)


class Exceedance(Quantity):
    """The probability that a response is above a limit, or below it.

    Parameters
    ----------
    response, *inputs, output
        As for `Quantity`.
    limit : float
        In units of the response.
    below : bool
        Whether to look below the limit.

    Raises
    ------
    TypeError, ValueError
        If an argument is not as described.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> prb.decision.Exceedance(np.square, pm.Normal.dist(), limit=4.0)
    probability above 4 of square
    """

    differentiable = False
    of_inputs = "whether a specimen is beyond the limit"

    def __init__(
        self,
        response: Function,
        *inputs: Any,
        limit: float,
        below: bool = False,
        output: Any = None,
    ) -> None:
        super().__init__(response, *inputs, output=output)
        self.limit = finite_number(limit, "limit")
        self.below = flag(below, "below")

    @property
    def label(self) -> str:
        """The name of the functional."""
        return f"probability {'below' if self.below else 'above'} {self.limit:g}"

    def of(self, values: Floats, weights: Floats) -> Floats:
        """Return the probabilities."""
        is_beyond = self.of_specimen(values, np.nan)
        beyond, rest = weights @ is_beyond, weights @ (1 - is_beyond)
        # Divide by the sum of the weights, which is one up to rounding.
        return beyond / (beyond + rest)

    def of_specimen(self, values: Floats, at: float) -> Floats:
        """Return whether each specimen is beyond the limit."""
        beyond = values < self.limit if self.below else values > self.limit
        return beyond.astype(float)


def refuse_quantity(quantity: object, caller: str) -> None:
    """Raise if an argument is no quantity."""
    if not isinstance(quantity, Quantity):
        raise TypeError(
            f"{caller}: quantity: got {type(quantity).__name__}, expected a quantity with its "
            "response, such as prb.decision.Quantile(response, x, probability=0.99)"
        )


@dataclass(frozen=True)
class Interval:
    """A constant input, the same for all specimens, known only to lie between two ends.

    Parameters
    ----------
    low, high : float
        In units of the input.

    Raises
    ------
    TypeError, ValueError
        If one is no finite number, or the first is not below the second.

    Examples
    --------
    >>> import prbayes as prb
    >>> prb.decision.Interval(2.4, 2.8)
    Interval(low=2.4, high=2.8)
    """

    low: float
    high: float

    def __post_init__(self) -> None:
        low = finite_number(self.low, "Interval: low")
        if finite_number(self.high, "Interval: high") <= low:
            raise ValueError(
                f"Interval: high: got {self.high} with low = {self.low}, expected a number above "
                "low"
            )


def interval_grid(inputs: Sequence[Any], steps: int) -> list[tuple[Any, ...]]:
    """Return the inputs at each combination of ``steps`` evenly spaced values of each interval."""
    values = [
        np.linspace(x.low, x.high, steps).tolist() if isinstance(x, Interval) else [x]
        for x in inputs
    ]
    return list(product(*values))


def extreme_places(
    inputs: Sequence[Any],
    grid: Sequence[tuple[Any, ...]],
    respond: Callable[[tuple[Any, ...]], Floats],
    limits: Sequence[float],
) -> list[tuple[Any, ...]]:
    """Return places of the intervals with heavier or lighter tails beyond limits than the grid's.

    ``respond`` returns responses of the same specimens at a place. For each limit and direction
    the search starts from the best of the grid and of 32 quasi-random places.
    """
    numbers = [k for k, x in enumerate(inputs) if isinstance(x, Interval)]
    low = np.array([inputs[k].low for k in numbers])
    high = np.array([inputs[k].high for k in numbers])

    @cache
    def responses_at(*values: float) -> Floats:
        return respond(place_of(values))

    def place_of(values: Sequence[float]) -> tuple[Any, ...]:
        place = list(inputs)
        for k, value in zip(numbers, values, strict=True):
            place[k] = value
        return tuple(place)

    starts = [[place[k] for k in numbers] for place in grid]
    points = sobol(32, len(numbers), seed=0)
    starts += (low + points * (high - low)).tolist()
    width = _kernel_width(np.array([responses_at(*start) for start in starts]))
    places = []
    for limit, sign in product(limits, (1.0, -1.0)):

        def tail(values: Sequence[float], limit: float = limit, sign: float = sign) -> float:
            distances = sign * (responses_at(*values) - limit)
            return _log_tail(distances / width)

        heaviest = max(starts[: len(grid)], key=tail)
        end = _climbed(tail, max(starts, key=tail), low, high)
        if tail(end) > tail(heaviest):
            places.append(place_of(end))
    return places


def _kernel_width(values: Floats) -> float:
    """Return the bandwidth for responses of the same specimens, (places, n), by Silverman's rule.

    Their spread is the median over places of that at a place, or else that between places.
    """
    finite = np.ma.masked_invalid(values)
    within = np.ma.filled(finite.std(axis=1), 0.0)
    spread = np.median(within)
    if spread == 0:
        spread = np.ma.filled(finite.std(), 0.0)
    width = 0.9 * float(spread) * values.shape[1] ** -0.2
    return width or 1.0  # one if all responses are equal


def _log_tail(distances: Floats) -> float:
    """Return the logarithm of a smoothed count of responses beyond a limit, in bandwidths.

    It also increases towards the limit where no response is beyond it.
    """
    is_known = ~np.isnan(distances)
    if not is_known.any():
        return -np.inf
    return float(logsumexp(log_ndtr(distances[is_known])))


def _climbed(
    height: Callable[[Sequence[float]], float], start: list[float], low: Floats, high: Floats
) -> list[float]:
    """Climb from a start by steps along the axes, which are halved where none leads higher."""
    step = (high - low) / 32 ** (1 / low.size)
    for _ in range(10):
        steps = np.diag(step)
        candidates = np.clip(np.array(start) + np.concatenate([steps, -steps]), low, high)
        highest = max(candidates.tolist(), key=height)
        if height(highest) > height(start):
            start = highest
        else:
            step = step / 2
    return start


def interval_values(inputs: Sequence[Any], point: Sequence[Any]) -> str:
    """Return the values of the intervals at a point of the grid, as text."""
    pairs = zip(inputs, point, strict=True)
    return ", ".join(f"{value:g}" for x, value in pairs if isinstance(x, Interval))
