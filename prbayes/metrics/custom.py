"""A user's own metric from a function."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from typing import Any, ClassVar

import numpy as np

from prbayes._validate import Floats, Function, flag
from prbayes.metrics.base import Discrepancy, Features, Metric


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

    function: Function
    _: KW_ONLY
    weighted: bool = False
    symbolic: ClassVar[bool] = False

    def __post_init__(self) -> None:
        if not callable(self.function):
            got = type(self.function).__name__
            raise TypeError(f"function: got {got}, expected f(simulated, observed)")
        flag(self.weighted, "weighted")

    @property
    def takes_weights(self) -> bool:  # type: ignore[override]
        """Whether the function takes the weights of simulated responses."""
        return self.weighted

    def _prepare(self, observed: Floats, weights: Floats) -> Discrepancy:
        if not np.allclose(weights, weights[0]):
            raise ValueError(
                "observed weights: got unequal ones, expected none; a FunctionMetric takes no "
                "weights of observed values"
            )
        return FunctionDiscrepancy(self, observed, weights, observed.size)


@dataclass(frozen=True, eq=False)
class FunctionDiscrepancy(Discrepancy):
    """A user's metric against fixed observed values.

    The function takes observed values without weights: a data set in the form of weights becomes a
    sample in which each value is repeated by its count.
    """

    metric: FunctionMetric
    size: int  # number of values in a sample that is made from weights

    @property
    def scale(self) -> float:
        """One: the size of the function is unknown."""
        return 1.0

    def features(self, simulated: Any, weights: Any, xp: Any) -> Features:
        """Return the value of the function; the values for several data sets, (B, ...)."""
        if self.weights.ndim == 1:
            return (self._value(simulated, self.weights, weights),)
        # Populations of shape (B, ..., n) or (1, ..., n).
        n_sets = len(self.weights)
        simulated = np.broadcast_to(simulated, (n_sets, *simulated.shape[1:]))
        weights = np.broadcast_to(weights, (n_sets, *weights.shape[1:]))
        values = np.empty(simulated.shape[:-1])
        for i, observed_weights in enumerate(self.weights.reshape(n_sets, -1)):
            values[i] = self._value(simulated[i], observed_weights, weights[i])
        return (values,)

    def _value(self, simulated: Floats, observed_weights: Floats, weights: Floats) -> Floats:
        """Return the checked value of the function for one data set."""
        arguments = [simulated, self._repeated(observed_weights)]
        if self.metric.weighted:
            arguments.append(np.broadcast_to(weights, simulated.shape))
        elif not np.allclose(weights, np.asarray(weights)[..., :1]):
            raise ValueError(
                "weights: got unequal ones for a FunctionMetric whose function takes none; "
                "write function(simulated, observed, weights) and pass weighted=True, "
                "or use prb.Resimulated"
            )
        expected = simulated.shape[:-1]
        sizes = ", ".join(
            f"{name} {np.shape(x)}"
            for name, x in zip(("simulated", "observed", "weights"), arguments, strict=False)
        )
        convention = (
            f"the function got {sizes}, expected a result of shape {expected}, a number for each "
            "population; reduce over the last axis of simulated, axis=-1"
        )
        try:
            value = np.asarray(self.metric.function(*arguments), dtype=np.float64)
        except Exception as error:
            raise ValueError(
                f"FunctionMetric: the function raised {type(error).__name__}: {error}; {convention}"
            ) from error
        if value.shape != expected:
            raise ValueError(f"FunctionMetric: got a result of shape {value.shape}: {convention}")
        return value

    def _repeated(self, weights: Floats) -> Floats:
        """Return a sample in which observed values are repeated in proportion to weights, (n,).

        It has the nominal size if the weights are multiples of its inverse; else the value of
        smallest weight occurs once, as in a subset.
        """
        for counts in (weights * self.size, weights / weights[weights > 0].min()):
            whole = np.round(counts)
            # Weights that are no counts differ from integers by far more than rounding does.
            if np.abs(counts - whole).max() < 1e-6:
                return np.repeat(self.observed, whole.astype(int))
        raise ValueError(
            "observed weights: got weights that are not counts, expected whole numbers: a "
            "FunctionMetric repeats values instead of weighting them; use prb.bootstrap(optimum, "
            "parametric=True)"
        )

    def outer(self, *features: Any, xp: Any) -> Any:
        """Return the value of the function."""
        return features[0]
