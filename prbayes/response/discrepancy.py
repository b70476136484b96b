"""Model discrepancy: the error of a response as a function of a condition."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import KW_ONLY, dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from prbayes._finding import Finding, Findings
from prbayes._validate import (
    Floats,
    Function,
    number,
    positive_number,
    real_array,
    unmasked,
    wrong_value,
)
from prbayes.response.call import scalar, unwrapped
from prbayes.response.outputs import relabelled


@dataclass(frozen=True)
class Smooth:
    r"""The free shape of a discrepancy that is zero under a known condition: a Gaussian process.

    .. math:: d(c) = \frac{c - c_0}{R} g(c), \qquad
              \operatorname{cov}(g(c), g(c')) = \sigma^2 / \bigl(1 + (c - c')^2 / (2 l^2)\bigr),

    with the zero :math:`c_0` and the largest distance R of the data's conditions from it. The
    standard deviation :math:`\sigma` is that of the discrepancy at this distance, and grows in
    proportion to the distance.

    Parameters
    ----------
    zero_at : float
        Condition :math:`c_0` under which the response is known to be right, such as no load.
    length : float, optional
        Length scale l, in units of the condition; by default R / 2. The covariance is a mixture of
        squared exponentials, 90 % of whose length scales are from .58 l to 4.4 l [1]_.
    reach : float
        How far beyond the data and the zero the shape is defined, in units of R. It ends at a zero
        that is the lowest or highest condition. Predictions further away are refused.

    Raises
    ------
    TypeError, ValueError
        If an argument is no finite number, or ``length`` or ``reach`` is not positive.

    Notes
    -----
    Pass it as ``shape`` of `Additive` or `Multiplicative`, which have a coefficient for each
    element of an orthogonal expansion. Independent normal coefficients with the standard deviation
    :math:`\sigma` make the discrepancy this process; their number is in ``event``. The first ones
    determine the discrepancy under the conditions of the data, the others what is left elsewhere,
    to 5 % of the variance.

    References
    ----------
    .. [1] Rasmussen, C. E. and C. K. I. Williams (2006), Gaussian processes for machine learning,
       MIT Press, eq. 4.19 with alpha = 1.

    Examples
    --------
    >>> import numpy as np, prbayes as prb
    >>> stiffening = prb.response.Additive([0.5, 1.0, 2.0], prb.response.Smooth(zero_at=0.0))
    >>> stiffening.event
    (5,)
    >>> stiffening.value(np.ones(5), 0.0)
    array(0.)
    """

    zero_at: float
    _: KW_ONLY
    length: float | None = None
    reach: float = 0.5

    def __post_init__(self) -> None:
        number(self.zero_at, "prb.response.Smooth: zero_at")
        positive_number(self.reach, "prb.response.Smooth: reach")
        if self.length is not None:
            positive_number(self.length, "prb.response.Smooth: length")

    def expansion(self, seen: Floats) -> Expansion:
        """Return the orthogonal expansion of the process for conditions with data, (n,)."""
        zero = float(self.zero_at)
        conditions = np.unique(seen)
        first = float(conditions[0])
        last = float(conditions[-1])
        farthest = max(abs(first - zero), abs(last - zero))
        margin = self.reach * farthest
        # A zero that is not between conditions is an end of the range.
        low = zero if zero <= first else first - margin
        high = zero if zero >= last else last + margin
        length = farthest / 2 if self.length is None else float(self.length)
        # The grid has at least ten points in a default length scale.
        grid = np.linspace(low, high, 101)
        # More conditions than the grid has determine no further terms.
        size = min(len(conditions), len(grid))
        chosen = np.linspace(0, len(conditions) - 1, size)
        conditions = conditions[chosen.round().astype(np.intp)]
        nodes = np.concatenate([conditions, grid])
        covariance = rational_quadratic(conditions, conditions, length)
        of_data = residual_whitening(covariance, 1e-6)
        at_grid = rational_quadratic(grid, conditions, length) @ of_data
        # The other terms are those of the process less its regression on the first ones.
        explained = at_grid @ at_grid.T
        rest = rational_quadratic(grid, grid, length) - explained
        of_rest = residual_whitening(rest, 0.05)
        regression = of_data @ at_grid.T @ of_rest
        upper = np.concatenate([of_data, -regression], axis=1)
        zeros = np.zeros_like(at_grid)
        lower = np.concatenate([zeros, of_rest], axis=1)
        weights = np.concatenate([upper, lower])
        return Expansion(zero, farthest, length, low, high, nodes, weights)


@dataclass(frozen=True, eq=False)
class Expansion:
    """Terms of the orthogonal expansion of a `Smooth` shape, a function of the condition."""

    zero: float
    farthest: float  # largest distance of a condition with data from the zero
    length: float  # length scale
    low: float  # ends of the range in which the shape is defined
    high: float
    nodes: Floats  # (n,): conditions at which covariances are computed
    weights: Floats  # (n, m): terms as combinations of the covariances with the nodes

    def __call__(self, condition: Floats) -> Floats:
        """Return the m terms at conditions, (...) -> (..., m)."""
        at = np.asarray(condition, dtype=np.float64)
        margin = 1e-9 * (self.high - self.low)
        lowest = self.low - margin
        highest = self.high + margin
        is_below = at < lowest
        is_above = at > highest
        if (is_below | is_above).any():
            raise ValueError(
                f"prb.response.Smooth: condition: got {at.min():g} to {at.max():g}, expected "
                f"conditions from {self.low:g} to {self.high:g}, where the shape is defined; pass "
                "a larger reach="
            )
        covariance = rational_quadratic(at.ravel(), self.nodes, self.length)
        terms = covariance @ self.weights
        terms = terms.reshape(*at.shape, -1)
        distance = (at - self.zero) / self.farthest
        return np.asarray(distance[..., None] * terms)


def rational_quadratic(first: Floats, second: Floats, length: float) -> Floats:
    """Return the rational quadratic covariance of conditions, (n,) and (k,) -> (n, k)."""
    difference = first[:, None] - second
    distance = difference / length
    ratio = 0.5 * distance**2
    return np.asarray(1 / (1 + ratio))


def residual_whitening(covariance: Floats, dropped: float) -> Floats:
    """Return weights, (n, k), of the main components with unit variance.

    The others have at most the variance ``dropped`` in each element.
    """
    values, vectors = np.linalg.eigh(covariance)
    values = np.maximum(values[::-1], 1e-300)
    vectors = vectors[:, ::-1]
    explained = np.cumsum(values * vectors**2, axis=1)
    variance = covariance.diagonal()[:, None]
    lost = (variance - explained).max(axis=0)
    count = 1 + int((lost > dropped).sum())
    # The sign is fixed, so that coefficients keep their meaning on other machines.
    largest = np.abs(vectors).argmax(axis=0)
    columns = np.arange(len(values))
    signs = np.sign(vectors[largest, columns])
    scales = np.sqrt(values)
    weights = vectors * signs / scales
    return np.asarray(weights[:, :count])


class ModelDiscrepancy(ABC):
    """The error of a response over a condition such as time, temperature or load."""

    def __init__(
        self, seen: ArrayLike, shape: Callable[[Floats], Any] | Smooth | None = None
    ) -> None:
        label = f"prb.response.{type(self).__name__}"
        conditions = real_array(seen, f"{label}: seen")
        if conditions.ndim != 1 or not np.isfinite(conditions).all() or np.ptp(conditions) == 0:
            raise ValueError(
                f"{label}: seen: got {seen!r:.60}, expected at least two different finite "
                "conditions, such as [20.0, 1000.0]"
            )
        if shape is not None and not callable(shape) and not isinstance(shape, Smooth):
            raise wrong_value(
                shape,
                f"{label}: shape",
                "a function of the condition, such as np.log, or prb.response.Smooth(zero_at=0.0)",
            )
        self.low = float(conditions.min())
        self.high = float(conditions.max())
        if isinstance(shape, Smooth):
            shape = shape.expansion(conditions)
        self.shape = self._line if shape is None else shape
        values = self._basis(np.array([self.low, self.high]))
        if values.shape[:1] != (2,) or values.ndim > 2 or not np.isfinite(values).all():
            raise ValueError(
                f"{label}: shape: got {np.array2string(values, threshold=4)} of two conditions, "
                "expected finite numbers of shape (2,), or (2, m) for m coefficients"
            )
        self.event = values.shape[1:]  # shape of the coefficients: () or (m,)

    def _line(self, condition: Floats) -> Floats:
        return (condition - self.low) / (self.high - self.low)

    def _basis(self, condition: Floats) -> Floats:
        return np.asarray(self.shape(condition), dtype=np.float64)

    def __repr__(self) -> str:
        return f"{type(self).__name__} over {self.low:g} to {self.high:g}"

    def value(self, coefficients: ArrayLike, condition: ArrayLike) -> Floats:
        """Return the discrepancy, the coefficients times the shape.

        Parameters
        ----------
        coefficients : array_like, shape (...), or (..., m) for m coefficients
        condition : array_like, shape (...)
            Broadcast against the coefficients; the discrepancy is 0 where it is NaN.

        Examples
        --------
        >>> import prbayes as prb
        >>> rise = prb.response.Additive([20.0, 1020.0])
        >>> rise.value(3.0, [20.0, 520.0, 1020.0])
        array([0. , 1.5, 3. ])
        """
        at = np.asarray(condition, dtype=np.float64)
        basis = self._basis(np.where(np.isnan(at), self.low, at))
        product = np.asarray(coefficients) * basis
        if self.event:
            product = product.sum(axis=-1)
        return np.asarray(np.where(np.isnan(at), 0.0, product))

    @abstractmethod
    def combined(self, response: Floats, value: Floats) -> Floats:
        """Return a response with its discrepancy."""

    def of(self, response: Function, condition: ArrayLike) -> Function:
        """Return a response with the discrepancy under a condition, and one more input.

        The last input is the coefficients: a ``.dist()``, whose hyperparameters are the size of the
        discrepancy and its scatter between specimens. A model variable, common to all specimens,
        goes with `Resimulated`.

        Parameters
        ----------
        response : callable
            As for `Simulator`; one that returns a mapping is refused where it is called.
        condition : array_like, shape () or (k,)
            Of a response of one output, or of each of its k outputs, such as times of a curve; NaN
            for an output without discrepancy.

        Returns
        -------
        callable
            For `Simulator`, `predict` and all that takes a response. If the condition is outside
            ``seen``, each use logs a warning, and predictions have it in their ``findings``.

        Raises
        ------
        TypeError, ValueError
            If an argument is not as described.

        Examples
        --------
        >>> import prbayes as prb
        >>> rise = prb.response.Additive([20.0, 1000.0])
        >>> hot = rise.of(lambda k: k, 1000.0)
        >>> hot(5.0, 2.5)
        array(7.5)
        >>> print(*rise.of(lambda k: k, 1200.0).findings)
        <lambda> at 1200: extrapolates its model discrepancy, seen from 20 to 1000.
        """
        label = f"prb.response.{type(self).__name__}.of"
        if not callable(response) or isinstance(response, type):
            raise wrong_value(response, f"{label}: response", "a function of the inputs")
        at = real_array(condition, f"{label}: condition")
        if at.ndim > 1 or np.isinf(at).any() or np.isnan(at).all():
            raise ValueError(
                f"{label}: condition: got {condition!r:.60}, expected a number, or one for each "
                "output, NaN for those without discrepancy"
            )
        self._basis(np.where(np.isnan(at), self.low, at))  # raises where it is not defined
        if isinstance(response, scalar):
            return scalar(Corrected(response.function, self, at))
        return Corrected(response, self, at)


class Additive(ModelDiscrepancy):
    r"""An additive model discrepancy: :math:`y = S(x; c) + \sum_j b_j \phi_j(c)`.

    Coefficients are in units of the response.

    Parameters
    ----------
    seen : array_like, shape (n,)
        Conditions under which there are data, in any unit; its ends count.
    shape : callable or Smooth, optional
        :math:`\phi`: ``shape(condition)`` of shape (...) for one coefficient, or (..., m) for m;
        by default a straight line from 0 at the lower end of ``seen`` to 1 at the upper one. With
        `Smooth` it is free, apart from a known zero.

    Raises
    ------
    TypeError, ValueError
        If an argument is not as described.

    Notes
    -----
    The response is right where the shape is zero. A constant shape is a shift of the response.
    `minimize` warns if the data cannot separate the coefficients' hyperparameters from those of the
    other inputs. Unlike the Gaussian process of [1]_ the discrepancy has a parametric form, between
    the conditions of the data and beyond, unless the shape is `Smooth`.

    References
    ----------
    .. [1] Kennedy, M. C. and A. O'Hagan (2001), Bayesian calibration of computer models, J. R.
       Stat. Soc. B 63, 425-464, doi:10.1111/1467-9868.00294.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> rise = prb.response.Additive([0.0, 2.0])
    >>> data = np.random.default_rng(1).normal(4.0, 0.5, 40)
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(1.0, 0.2)
    ...     b = pm.Normal.dist(pm.Normal("lift", 0, 5), 0.5)
    ...     y = prb.Simulator(
    ...         "y", rise.of(lambda x: x, 2.0), x, b, metric=prb.AreaMetric(), observed=data,
    ...         propagation=prb.Resimulated(256))
    >>> optimum = prb.minimize(model)
    >>> bool(abs(optimum.point["lift"] - 3) < 0.3)
    True
    """

    def combined(self, response: Floats, value: Floats) -> Floats:
        """Return the sum."""
        return np.asarray(response + value)


class Multiplicative(ModelDiscrepancy):
    r"""A multiplicative model discrepancy: :math:`y = S(x; c) \exp \sum_j b_j \phi_j(c)`.

    Coefficients have no unit: .05 is about five percent. The sign of a response stays.

    Parameters
    ----------
    seen : array_like, shape (n,)
        As for `Additive`.
    shape : callable or Smooth, optional
        As for `Additive`.

    Raises
    ------
    TypeError, ValueError
        If an argument is not as described.

    References
    ----------
    .. [1] Kennedy, M. C. and A. O'Hagan (2001), Bayesian calibration of computer models, J. R.
       Stat. Soc. B 63, 425-464, doi:10.1111/1467-9868.00294.

    Examples
    --------
    >>> import numpy as np, prbayes as prb
    >>> fading = prb.response.Multiplicative([1.0, 100.0], np.log10)
    >>> later = fading.of(lambda x: x, 100.0)
    >>> bool(np.isclose(later(5.0, -0.1), 5 * np.exp(-0.2)))
    True
    """

    def combined(self, response: Floats, value: Floats) -> Floats:
        """Return the product."""
        return np.asarray(response * np.exp(value))


class Corrected:
    """A response with its discrepancy under a condition; the last input is the coefficients."""

    def __init__(
        self, response: Function, discrepancy: ModelDiscrepancy, condition: Floats
    ) -> None:
        self.response = response
        self.discrepancy = discrepancy
        self.condition = condition

    @property
    def __name__(self) -> str:
        return str(getattr(self.response, "__name__", type(self.response).__name__))

    def __repr__(self) -> str:
        return f"{self.__name__} with {self.discrepancy!r} at {self._conditions}"

    @property
    def _conditions(self) -> str:
        ends = np.unique([np.nanmin(self.condition), np.nanmax(self.condition)])
        return " to ".join(f"{end:g}" for end in ends)

    @property
    def findings(self) -> Findings:
        """A warning if the condition is outside the range of the data."""
        low = self.discrepancy.low
        high = self.discrepancy.high
        if not ((self.condition < low) | (self.condition > high)).any():
            return ()
        text = (
            f"{self.__name__} at {self._conditions}: extrapolates its model discrepancy, seen from "
            f"{low:g} to {high:g}."
        )
        return (Finding("extrapolated-discrepancy", text),)

    def __call__(self, *inputs: Any) -> Any:
        """Return the response with its discrepancy, and with its labels."""
        *arguments, coefficients = inputs
        response = self.response(*arguments)
        if isinstance(response, Mapping):
            raise TypeError(
                f"{self.__name__}: got a mapping, expected an array with an output for each "
                "condition"
            )
        labelled = response
        response = np.asarray(unmasked(response))
        coefficients = np.asarray(coefficients)
        batch_ndim = coefficients.ndim - len(self.discrepancy.event)
        outputs = self.condition.shape
        response_ndim = response.ndim - len(outputs)
        has_outputs = response.shape[response_ndim:] == outputs
        # The coefficients may be a model variable, common to all specimens.
        is_common = batch_ndim == 0 and response_ndim == 1
        if response.ndim and not (has_outputs and (response_ndim == batch_ndim or is_common)):
            raise ValueError(
                f"{self.__name__}: got a response of shape {response.shape}, expected "
                f"{('...', *outputs)}: one output, or one for each condition"
            )
        if self.condition.ndim:
            # The axis of the outputs comes before that of the coefficients.
            coefficients = np.expand_dims(coefficients, batch_ndim)
        value = self.discrepancy.value(coefficients, self.condition)
        return relabelled(self.discrepancy.combined(response, value), labelled)


def has_discrepancy(function: Function) -> bool:
    """Return whether the last input of a function is the coefficients of a model discrepancy."""
    return isinstance(unwrapped(function), Corrected)


def findings_of(function: Function) -> Findings:
    """Return the warnings that a function declares for its users."""
    return tuple(getattr(unwrapped(function), "findings", ()))
