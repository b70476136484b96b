"""Calibration metrics: features of a weighted population, then one function of the features.

`Metric` is configuration. ``metric.against(observed)`` prepares a `Discrepancy`, which compares the
measured values with simulated responses in two steps:

- *features*: a density on cells, or the area between two distribution functions. For stored
  responses a `Basis` maps the weights to them;
- the *outer* function of the features, written for any array namespace, so that the direct call,
  the optimiser's gradient and the compiled graph of a PyMC model run through the same lines.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from prbayes._validate import (
    AT_ONCE,
    Floats,
    Indices,
    Names,
    Shape,
    observed_outputs,
    observed_sample,
    sample_weights,
    simulated_sample,
)
from prbayes.metrics.grid import product
from prbayes.numerics.mixtures import effective_sample_size


@dataclass(frozen=True, eq=False)
class Projection:
    """A linear combination of some of the outputs after subtraction of a center."""

    outputs: Indices  # indices of the outputs, (p,)
    caps: Floats  # values that stand for a failed specimen, (p,)
    # Values that are subtracted, (p,). Projections of the same outputs share the array, so that
    # these outputs are centred once for all of them.
    center: Floats
    direction: Floats  # coefficients of the combination, (p,)

    def centered(self, simulated: Any, xp: Any = np) -> Any:
        """Return centred outputs, (..., n, p), in which caps replace failures; NaN stays."""
        outputs = simulated[..., self.outputs]
        return xp.where(outputs >= np.inf, self.caps, outputs) - self.center

    def of(self, simulated: Any, xp: Any = np) -> Any:
        """Return the combination, (..., n, m) -> (..., n)."""
        return self.centered(simulated, xp) @ self.direction

    def observed_of(self, values: Floats) -> tuple[Floats, Indices]:
        """Return the projection of observed values, and the rows that have all its outputs."""
        index = np.flatnonzero(~np.isnan(values[:, self.outputs]).any(axis=-1))
        return self.of(values[index]), index


type Features = tuple[Any, ...]


class Minimum(Enum):
    """How a discrepancy behaves around its minimum, as far as its metric declares it.

    Attributes
    ----------
    QUADRATIC
        Twice differentiable in the hyperparameters: Hessian and gradient give the sampling
        distribution.
    ABSOLUTE
        An integral of absolute differences between distribution functions, each linear in the
        weights.
    UNKNOWN
        Nothing is declared; refits measure what is needed, or it is refused.
    """

    QUADRATIC = "quadratic"
    ABSOLUTE = "absolute"
    UNKNOWN = "unknown"


@dataclass(frozen=True, eq=False)
class Part:
    """A component of a discrepancy: ``share`` times the discrepancy ``target`` of a projection."""

    target: Discrepancy  # discrepancy of the projection, or of all outputs without one
    share: float  # factor in the sum
    label: str  # name for messages and plots
    projection: Projection | None = None  # projection of outputs; None for the response itself

    def of(self, simulated: Any, xp: Any = np) -> Any:
        """Return the projection, (..., n, m) -> (..., n); NaN where an output is NaN."""
        return simulated if self.projection is None else self.projection.of(simulated, xp)

    def observed_of(self, values: Floats) -> tuple[Floats, Indices]:
        """Return the projection of observed values, (n, m) -> (n',), and the rows that have it."""
        if self.projection is None:
            return values, np.arange(len(values))
        return self.projection.observed_of(values)


@dataclass(frozen=True, eq=False)
class Basis(ABC):
    """The map from weights of stored responses to the features of a discrepancy."""

    arrays: tuple[Any, ...]  # the numbers of the map; shared variables in a compiled graph

    @abstractmethod
    def features(self, weights: Any, xp: Any = np) -> Features:
        """Return the features of the stored responses with weights (..., n)."""

    def rows(self, index: Any) -> Self:
        """Return the map for some of several data sets."""
        return self


class DenseBasis(Basis):
    """A matrix, (n, m): the features are ``weights @ matrix``."""

    def features(self, weights: Any, xp: Any = np) -> Features:
        """Return the features, (..., n) -> (..., m)."""
        (matrix,) = self.arrays
        return (product(weights, matrix) if xp is np else weights @ matrix,)


@dataclass(frozen=True, eq=False)
class StoredBasis(Basis):
    """The stored responses themselves, whose features are computed for each row of weights."""

    target: Discrepancy

    def features(self, weights: Any, xp: Any = np) -> Features:
        """Return the features of the responses."""
        (values,) = self.arrays
        if xp is np:
            values = np.broadcast_to(values, (*weights.shape, *self.target.event))
        return self.target.features(values, weights, xp)

    def rows(self, index: Any) -> Self:
        """Return the map for some of several data sets."""
        return replace(self, target=self.target.rows(index))


@dataclass(frozen=True, eq=False)
class Discrepancy(ABC):
    """A metric with its observed side prepared; call it with simulated responses.

    A new metric derives from this class, or from `DensityDiscrepancy` if it compares densities,
    and defines the abstract methods. All methods are batched: the last axis runs over the values,
    axes before it over populations. Records are immutable.

    Attributes
    ----------
    metric : Metric
        The configuration that prepared it.
    observed : ndarray, shape (N,) or (N, m)
        Measured responses, of one output or of m.
    weights : ndarray, shape (N,) or (..., N)
        Weights of the observed values; they sum to one. Several rows are as many data sets.
    """

    metric: Metric
    observed: Floats
    weights: Floats
    # Names of the fields that have a row for each data set.
    _by_data_set: ClassVar[Names] = ("weights",)

    def with_observed(self, observed: Floats, weights: Floats | None = None) -> Self:
        """Return the same metric, on the same cells, against other values (n,), for resampling.

        Weights are equal by default. Of shape (..., n) they are several data sets, which `outer`
        broadcasts against the features.
        """
        return replace(self, observed=observed, weights=sample_weights(weights, len(observed)))

    def rows(self, index: Any) -> Self:
        """Return some of several data sets."""
        return replace(self, **{name: getattr(self, name)[index] for name in self._by_data_set})

    @property
    def event(self) -> Shape:
        """The shape of one specimen's response: () for one output, (m,) for several."""
        return self.observed.shape[1:]

    @property
    def parts(self) -> tuple[Part, ...]:
        """The components of the sum: itself, unless it is a sum of several."""
        return (Part(self, 1.0, ""),)

    @property
    def n_effective(self) -> float:
        """Effective number of observations, 1 / sum(weights**2)."""
        return float(effective_sample_size(self.weights))

    @property
    def n_drawn(self) -> int:
        """Number of specimens of a replicate of the observed values."""
        return round(self.n_effective) if self.metric.exact_likelihood else len(self.observed)

    def replicate(self, specimens: Floats) -> Floats:
        """Return what is observed of specimens, by default their responses."""
        return specimens

    @property
    @abstractmethod
    def scale(self) -> float:
        """A typical size of the discrepancy, positive, in its own units.

        Optimisers divide by it, so that their tolerances mean the same for every metric.
        """

    @abstractmethod
    def features(self, simulated: Any, weights: Any, xp: Any) -> Features:
        """Return the arguments of `outer` for any simulated responses.

        Parameters
        ----------
        simulated : array, shape (..., n), or (..., n, m) for several outputs
            In units of the observed values. +inf is a specimen that failed and counts above all
            others; NaN is a point without a response and counts nowhere.
        weights : array, shape (n,) or (..., n)
            Non-negative; they sum to at most one.
        xp : module
            ``numpy``, or ``pytensor.tensor`` for symbolic responses.
        """

    @abstractmethod
    def outer(self, *features: Any, xp: Any) -> Any:
        """Return the discrepancy of the features, shape (...); smaller is better.

        Written with ``xp`` (``numpy`` or ``pytensor.tensor``), by functions that both have.
        """

    def basis(self, simulated: Floats, most: float = AT_ONCE) -> Basis:
        """Return the map from weights of stored responses, (n,) or (n, m), to features.

        By default the responses themselves. A metric whose features are a fast function of the
        weights returns a map that is computed once, equal to `features` up to rounding. ``most`` is
        the largest size of a matrix where a smaller form exists.
        """
        return StoredBasis((simulated,), self)

    def together(self, parts: tuple[Part, ...]) -> PartSum:
        """Return components of this kind in a form that evaluates them together."""
        return PartSum(parts)

    def of(self, simulated: Floats, weights: Floats) -> Any:
        """Return the discrepancy of checked values (..., n) and weights that sum to at most one."""
        return self.outer(*self.features(simulated, weights, np), xp=np)

    def __call__(self, simulated: ArrayLike, weights: ArrayLike | None = None) -> Any:
        """Return the discrepancy of simulated responses.

        Parameters
        ----------
        simulated : array_like, shape (..., n), or (..., n, m) for several outputs
            In units of the observed values; +inf is a specimen that failed.
        weights : array_like, shape (..., n), optional
            Equal by default.

        Returns
        -------
        float or ndarray, shape (...)
        """
        values = simulated_sample(simulated, event=self.event)
        leading = values.shape[: values.ndim - len(self.event)]
        w = sample_weights(weights, leading[-1])
        shape = np.broadcast_shapes(leading, w.shape)
        result = self.of(np.broadcast_to(values, (*shape, *self.event)), w)
        return float(result) if np.ndim(result) == 0 else result


def is_additive(target: Discrepancy) -> bool:
    """Return whether the gradient is a mean over specimens: never if specimens lack outputs."""
    return target.metric.additive and not np.isnan(target.observed).any()


def is_likelihood(target: Discrepancy) -> bool:
    """Return whether N times the discrepancy is on the scale of a log-likelihood.

    A mean over directions is not, whatever its metric.
    """
    return len(target.parts) == 1 and target.parts[0].target.metric.likelihood


def projected(
    parts: Sequence[Part], simulated: Any, xp: Any = np
) -> Iterator[tuple[Discrepancy, Any]]:
    """Yield the discrepancy of each component with its projection of simulated responses."""
    center: Any = None
    outputs: Any = None
    for part in parts:
        view = part.projection
        if view is None:
            yield part.target, simulated
            continue
        if view.center is not center:  # centre outputs once for all directions of a set
            center = view.center
            outputs = view.centered(simulated, xp)
        yield part.target, outputs @ view.direction


@dataclass(frozen=True, eq=False)
class PartSum:
    """Components of a sum that are evaluated in one call, by default one after another."""

    parts: tuple[Part, ...]

    def features(self, simulated: Any, weights: Any, xp: Any) -> Features:
        """Return the features of all components."""
        return tuple(
            feature
            for target, values in projected(self.parts, simulated, xp)
            for feature in target.features(values, weights, xp)
        )

    def basis(self, simulated: Floats, most: float) -> Basis:
        """Return the map from weights to the features."""
        return concatenated(
            [target.basis(y, most) for target, y in projected(self.parts, simulated)]
        )

    def outer(self, features: Features, shares: Floats, xp: Any) -> Any:
        """Return the sum of the components times their shares, shape (..., K)."""
        size = len(features) // len(self.parts)
        total = 0.0
        for k, part in enumerate(self.parts):
            value = part.target.outer(*features[k * size : (k + 1) * size], xp=xp)
            total = total + shares[..., k] * value
        return total


@dataclass(frozen=True, eq=False)
class JoinedBasis(Basis):
    """Concatenation of several bases."""

    bases: tuple[Basis, ...]

    def features(self, weights: Any, xp: Any = np) -> Features:
        """Return the features of all maps."""
        features: list[Any] = []
        start = 0
        for basis in self.bases:
            stop = start + len(basis.arrays)
            features += replace(basis, arrays=self.arrays[start:stop]).features(weights, xp)
            start = stop
        return tuple(features)

    def rows(self, index: Any) -> Self:
        """Return the maps for some of several data sets."""
        bases = tuple(basis.rows(index) for basis in self.bases)
        return replace(self, arrays=sum((basis.arrays for basis in bases), ()), bases=bases)


def concatenated(bases: Sequence[Basis]) -> Basis:
    """Concatenate bases; a single one is returned as it is."""
    if len(bases) == 1:
        return bases[0]
    return JoinedBasis(sum((basis.arrays for basis in bases), ()), tuple(bases))


class Metric(ABC):
    """A calibration metric; ``against`` prepares the observed side once.

    A metric of your own is a frozen dataclass that derives from this class. It defines
    ``_prepare(observed, weights)``, which returns a `Discrepancy` for checked values, shape (N,),
    and weights that sum to one. Class attributes or properties declare assumptions of calibration:

    Attributes
    ----------
    minimum : Minimum
        How the discrepancy behaves around its minimum; unknown unless the metric declares it.
    additive : bool
        Whether its gradient in the hyperparameters is a mean over observations, as that of an outer
        function linear in the observed density. If not, standard errors come from simulated data
        sets. Metrics with a quadratic minimum are taken for additive unless they declare it.
    symbolic : bool
        Whether the outer function can be written as a graph; else it is an operation without
        gradient.
    takes_weights : bool
        Whether simulated responses may have unequal weights, as under `Reweighted`.
    takes_outputs : bool
        Whether it compares several outputs at a time, (N, m), as `Joint` does.
    by_specimen : bool
        Whether it is a likelihood of each specimen's record, and compares no distributions.
    counts_failures : bool
        Whether observed values may be +inf, specimens that failed, as simulated ones may.
    tail_responses : int
        Least number of simulated responses of equal weight for each observation, which the tails
        of the population need; zero for any number.
    likelihood : bool
        Whether N times the discrepancy is on the scale of a log-likelihood, so that epsilon is 1/N.
    distance : bool
        Whether equal samples have a discrepancy of zero, so that its size between a population and
        data drawn from it is sampling noise. Only a likelihood may have another value.
    exact_likelihood : bool
        Whether N times the discrepancy is minus the log-likelihood of statistics of unknown
        specimens, as of a `Summary`: there are no specimens to resample.
    data_sheet : str
        These statistics as text; empty if specimens are compared.
    """

    minimum: ClassVar[Minimum] = Minimum.UNKNOWN
    likelihood: ClassVar[bool] = False
    distance: ClassVar[bool] = True
    exact_likelihood: ClassVar[bool] = False
    symbolic: ClassVar[bool] = True
    counts_failures: ClassVar[bool] = False
    tail_responses: ClassVar[int] = 0
    takes_weights: ClassVar[bool] = True
    takes_outputs: ClassVar[bool] = False
    by_specimen: ClassVar[bool] = False

    @property
    def data_sheet(self) -> str:
        """The statistics of unknown specimens that are compared; none by default."""
        return ""

    @property
    def additive(self) -> bool:
        """Whether the gradient in the hyperparameters is a mean over observations."""
        return self.minimum is Minimum.QUADRATIC

    def like(self, metric: Metric) -> Metric:
        """Return the comparison of the same outputs by another metric of one output."""
        return metric

    def for_inputs(self, target: Discrepancy, n_inputs: int) -> Discrepancy:
        """Return the discrepancy of outputs of that many inputs; by default the same for all."""
        return target

    @abstractmethod
    def _prepare(self, observed: Floats, weights: Floats) -> Discrepancy:
        """Return the discrepancy from these observed values, both of shape (N,) and checked."""

    def on_one_scale(self, slices: Sequence[Discrepancy]) -> Sequence[Discrepancy]:
        """Return discrepancies of projections of one sample in units that allow their mean."""
        return slices

    def against(self, observed: ArrayLike, weights: ArrayLike | None = None) -> Discrepancy:
        """Prepare the observed side.

        Parameters
        ----------
        observed : array_like, shape (N,)
            Measured responses; (N, m) where the metric takes several outputs. +inf is a specimen
            that failed, where the metric counts failures.
        weights : array_like, shape (N,), optional
            Weights of the measured responses; equal by default.

        Returns
        -------
        Discrepancy
            ``discrepancy(simulated, weights=None)``, shapes (..., n) -> (...).

        Raises
        ------
        TypeError, ValueError
            If the observed values are not one-dimensional, real and finite, or if the metric needs
            a bandwidth or bins and they are all equal.
        """
        if self.takes_outputs:
            sample = observed_outputs(observed)
        else:
            sample = observed_sample(observed, failures=self.counts_failures)
        w = sample_weights(weights, len(sample), "observed weights")
        if w.ndim > 1:
            raise ValueError(f"observed weights: got shape {w.shape}, expected ({len(sample)},)")
        return self._prepare(sample, w)

    def __call__(
        self,
        simulated: ArrayLike,
        observed: ArrayLike,
        *,
        weights: ArrayLike | None = None,
        observed_weights: ArrayLike | None = None,
    ) -> Any:
        """Return the discrepancy between simulated (..., n) and observed (N,) responses."""
        return self.against(observed, observed_weights)(simulated, weights)
