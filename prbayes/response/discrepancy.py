"""Model inadequacy: what a response leaves out over a condition, with coefficients of its own."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from prbayes._finding import Finding
from prbayes._validate import Floats, called, real_array
from prbayes.response.call import scalar


class Inadequacy(ABC):
    """What a response leaves out over a condition such as time, temperature or load.

    Parameters
    ----------
    seen : array_like, shape (n,)
        Conditions under which there are data, in any unit; its ends count.
    shape : callable, optional
        ``shape(condition)`` is the course over the condition, shape (...) for one coefficient, or
        (..., m) for m; by default a straight line from 0 at the lower end of ``seen`` to 1 at the
        upper one.
    """

    def __init__(self, seen: ArrayLike, shape: Callable[[Floats], Any] | None = None) -> None:
        label = f"prb.response.{type(self).__name__}"
        conditions = real_array(seen, f"{label}: seen")
        if conditions.ndim != 1 or not np.isfinite(conditions).all() or np.ptp(conditions) == 0:
            raise ValueError(
                f"{label}: seen: got {seen!r:.60}, expected two different finite conditions at "
                "least, such as [20.0, 1000.0]"
            )
        if shape is not None and not callable(shape):
            raise TypeError(
                f"{label}: shape: got {called(shape)}, expected a function of the condition, such "
                "as np.log"
            )
        self.low = float(conditions.min())
        self.high = float(conditions.max())
        self.shape = self._line if shape is None else shape
        two = np.array([self.low, self.high])
        values = self._shapes(two)
        if values.shape[:1] != (2,) or values.ndim > 2 or not np.isfinite(values).all():
            raise ValueError(
                f"{label}: shape: got {np.array2string(values, threshold=4)} of two conditions, "
                "expected finite numbers of shape (2,), or (2, m) for m coefficients"
            )
        self.event = values.shape[1:]  # of the coefficients: () or (m,)

    def _line(self, condition: Floats) -> Floats:
        return (condition - self.low) / (self.high - self.low)

    def _shapes(self, condition: Floats) -> Floats:
        return np.asarray(self.shape(condition), dtype=np.float64)

    def __repr__(self) -> str:
        return f"{type(self).__name__} over {self.low:g} to {self.high:g}"

    def value(self, coefficients: ArrayLike, condition: ArrayLike) -> Floats:
        """Return the inadequacy, the coefficients times the shape.

        Parameters
        ----------
        coefficients : array_like, shape (...), or (..., m) for m coefficients
        condition : array_like, shape (...)
            Broadcast against the coefficients; NaN where there is no inadequacy, which is then 0.

        Examples
        --------
        >>> import prbayes as prb
        >>> rise = prb.response.Additive([20.0, 1020.0])
        >>> rise.value(3.0, [20.0, 520.0, 1020.0])
        array([0. , 1.5, 3. ])
        """
        at = np.asarray(condition, dtype=np.float64)
        without = np.isnan(at)
        course = self._shapes(np.where(without, self.low, at))
        product = np.asarray(coefficients) * course
        if self.event:
            product = product.sum(axis=-1)
        return np.asarray(np.where(without, 0.0, product))

    @abstractmethod
    def combined(self, response: Floats, value: Floats) -> Floats:
        """Return a response with its inadequacy."""

    def of(self, response: Callable[..., Any], condition: ArrayLike) -> Callable[..., Any]:
        """Return a response with the inadequacy under a condition; its last input is new.

        That input is the coefficients: a ``.dist()``, whose hyperparameters say how large the
        inadequacy is and how much it differs from specimen to specimen. A model variable, common to
        all specimens, goes with `Resimulated`.

        Parameters
        ----------
        response : callable
            As for `Simulator`; one that returns a mapping is refused where it is called.
        condition : array_like, shape () or (k,)
            Of a response of one output, or of each of its k outputs, such as times of a curve; NaN
            for an output without inadequacy.

        Returns
        -------
        callable
            For `Simulator`, `predict` and all that takes a response. Where the condition is outside
            what was seen, a warning is logged wherever it is used, and predictions say so in the
            attribute ``caveats``.

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
        >>> rise.of(lambda k: k, 1200.0).caveats
        ('<lambda> at 1200: extrapolates its inadequacy, seen from 20 to 1000',)
        """
        label = f"prb.response.{type(self).__name__}.of"
        if not callable(response) or isinstance(response, type):
            raise TypeError(
                f"{label}: response: got {called(response)}, expected a function of the inputs"
            )
        at = real_array(condition, f"{label}: condition")
        if at.ndim > 1 or np.isinf(at).any() or np.isnan(at).all():
            raise ValueError(
                f"{label}: condition: got {condition!r:.60}, expected a number, or one for each "
                "output, NaN for those without inadequacy"
            )
        if isinstance(response, scalar):
            return scalar(Corrected(response.function, self, at))
        return Corrected(response, self, at)


class Additive(Inadequacy):
    r"""A model inadequacy that is added: :math:`y = S(x; c) + \sum_j b_j \phi_j(c)`.

    Coefficients are in units of the response.

    Parameters
    ----------
    seen : array_like, shape (n,)
        Conditions under which there are data, in any unit; its ends count.
    shape : callable, optional
        :math:`\phi`: ``shape(condition)`` of shape (...) for one coefficient, or (..., m) for m;
        by default a straight line from 0 at the lower end of ``seen`` to 1 at the upper one.

    Raises
    ------
    TypeError, ValueError
        If an argument is not as described.

    Notes
    -----
    A shape that is zero somewhere says where the response is right; one that is constant cannot be
    told from a shift of it. `minimize` warns where the coefficients' hyperparameters cannot be told
    from those of the other inputs. Unlike the Gaussian process of [1]_ the inadequacy has a
    form that is chosen, is no wider between the data's conditions than at them, and goes on in the
    same form beyond.

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


class Multiplicative(Inadequacy):
    r"""A model inadequacy that multiplies: :math:`y = S(x; c) \exp \sum_j b_j \phi_j(c)`.

    Coefficients have no unit: .05 is about five percent. The sign of a response stays.

    Parameters
    ----------
    seen : array_like, shape (n,)
        As for `Additive`.
    shape : callable, optional
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
    """A response with its inadequacy under a condition, whose last input is the coefficients."""

    def __init__(
        self, response: Callable[..., Any], inadequacy: Inadequacy, condition: Floats
    ) -> None:
        self.response = response
        self.inadequacy = inadequacy
        self.condition = condition

    @property
    def __name__(self) -> str:
        return str(getattr(self.response, "__name__", type(self.response).__name__))

    def __repr__(self) -> str:
        return f"{self.__name__} with {self.inadequacy!r} at {self._told}"

    @property
    def _told(self) -> str:
        known = np.atleast_1d(self.condition)
        ends = np.unique([np.nanmin(known), np.nanmax(known)])
        return " to ".join(f"{end:g}" for end in ends)

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Whether it extrapolates."""
        seen = self.inadequacy
        outside = (self.condition < seen.low) | (self.condition > seen.high)
        if not outside.any():
            return ()
        return (
            Finding(
                "extrapolated-discrepancy",
                f"{self.__name__} at {self._told}: extrapolates its inadequacy, seen from "
                f"{seen.low:g} to {seen.high:g}.",
            ),
        )

    def __call__(self, *inputs: Any) -> Floats:
        """Return the response with its inadequacy."""
        *own, coefficients = inputs
        response = self.response(*own)
        if isinstance(response, Mapping):
            raise TypeError(
                f"{self.__name__}: got a mapping, expected an array of outputs, each of which has "
                "a condition"
            )
        response = np.asarray(response)
        coefficients = np.asarray(coefficients)
        self._refuse_outputs(response, coefficients.ndim - len(self.inadequacy.event))
        if self.condition.ndim:
            # Outputs are the last axis, behind which the coefficients are.
            place = coefficients.ndim - len(self.inadequacy.event)
            coefficients = np.expand_dims(coefficients, place)
        value = self.inadequacy.value(coefficients, self.condition)
        return self.inadequacy.combined(response, value)

    def _refuse_outputs(self, response: Floats, batch: int) -> None:
        """Raise unless a response has the outputs that have conditions.

        ``batch`` is the number of axes of specimens that coefficients have; common ones have none.
        """
        outputs = self.condition.shape
        axes = response.ndim - len(outputs)
        as_many = response.shape[axes:] == outputs
        common = batch == 0 and axes == 1
        if response.ndim and not (as_many and (axes == batch or common)):
            raise ValueError(
                f"{self.__name__}: got a response of shape {response.shape}, expected "
                f"{('...', *outputs)}: one output, or one for each condition"
            )


def corrected(function: Callable[..., Any]) -> bool:
    """Return whether the last input of a function is the coefficients of an inadequacy."""
    inner = function.function if isinstance(function, scalar) else function
    return isinstance(inner, Corrected)


def findings_of(function: Callable[..., Any]) -> tuple[Finding, ...]:
    """Return what a response with a model discrepancy reports where it is used."""
    inner = function.function if isinstance(function, scalar) else function
    return tuple(getattr(inner, "findings", ()))
