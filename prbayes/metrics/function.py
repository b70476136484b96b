"""A user's own metric from a function."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prbayes._checks import Floats
from prbayes.metrics.base import Discrepancy, Metric


@dataclass(frozen=True)
class FunctionMetric(Metric):
    """A user's own metric from a function; samplers that need gradients refuse it.

    Parameters
    ----------
    function : callable
        ``function(simulated, observed) -> discrepancy``, shapes (..., n), (N,) -> (...); smaller is
        better.
    weighted : bool
        Whether the function takes the weights of the simulated values, shape (..., n), as a third
        argument. `Reweighted` needs that; the other propagations do not.

    Raises
    ------
    TypeError
        If ``function`` is not callable.

    Examples
    --------
    >>> import numpy as np
    >>> def difference(simulated, observed):
    ...     return abs(np.mean(simulated, axis=-1) - observed.mean())
    >>> metric = FunctionMetric(difference)
    >>> metric([0.0, 2.0], [4.0])
    3.0
    """

    function: Callable[..., Any]
    weighted: bool = False

    def __post_init__(self) -> None:
        if not callable(self.function):
            got = type(self.function).__name__
            raise TypeError(f"function: got {got}, expected f(simulated, observed)")

    @property
    def takes_weights(self) -> bool:
        """Whether the function takes the weights of simulated responses."""
        return self.weighted

    def _prepare(self, observed: Floats, weights: Floats) -> Discrepancy:
        if not np.allclose(weights, weights[0]):
            raise ValueError(
                "observed weights: got unequal ones, expected none; "
                "a FunctionMetric has no use for them"
            )
        return FunctionDiscrepancy(self, observed, weights)


class FunctionDiscrepancy(Discrepancy):
    """A user's metric against fixed observed values."""

    metric: FunctionMetric

    @property
    def symbolic(self) -> bool:
        """No: the function is called."""
        return False

    @property
    def scale(self) -> float:
        """One: nothing is known about the function."""
        return 1.0

    def features(self, simulated: Any, weights: Any, xp: Any) -> tuple[Any, ...]:
        """Return the value of the function."""
        value = np.asarray(self._called(simulated, weights), dtype=np.float64)
        expected = simulated.shape[:-1]
        if value.shape != expected:
            raise ValueError(
                f"FunctionMetric: got a result of shape {value.shape} for simulated values of "
                f"shape {simulated.shape}, expected {expected}; reduce over the last axis"
            )
        return (value,)

    def _called(self, simulated: Floats, weights: Floats) -> Any:
        """Call the function, with weights if it takes them; equal ones it need not know."""
        function = self.metric.function
        if self.metric.weighted:
            return function(simulated, self.observed, np.broadcast_to(weights, simulated.shape))
        if not np.allclose(weights, np.asarray(weights)[..., :1]):
            raise ValueError(
                "weights: got unequal ones for a FunctionMetric whose function takes none; "
                "write function(simulated, observed, weights) and pass weighted=True, "
                "or use prb.Resimulated"
            )
        return function(simulated, self.observed)

    def basis(self, simulated: Floats) -> tuple[NDArray[Any], ...]:
        """Return the simulated values themselves."""
        return (simulated,)

    def from_basis(self, weights: Any, basis: tuple[Any, ...], xp: Any) -> tuple[Any, ...]:
        """Return the value of the function."""
        (values,) = basis
        return self.features(np.broadcast_to(values, weights.shape), weights, xp)

    def outer(self, *features: Any, xp: Any) -> Any:
        """Return the value of the function."""
        return features[0]
