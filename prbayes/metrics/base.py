"""What a calibration metric is: a linear map of the weights of the simulated responses, then an outer function.

`Metric` is configuration; ``metric.against(observed)`` prepares a ``Discrepancy``, which holds the observed side.
The linear map gives a density on cells, or a difference of distribution functions; the *outer* function takes
the array namespace, so that the direct call, the optimiser's gradient and the compiled graph of a PyMC model
run through the same lines.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from prbayes._checks import Floats, observed_sample, sample_weights, simulated_sample
from prbayes.metrics.cells import Cells

_FLOOR = 1e-9


class Minimum(Enum):
    """How a discrepancy behaves around its minimum, as far as its metric declares it.

    Attributes
    ----------
    QUADRATIC
        Twice differentiable in the hyperparameters: Hessian and gradient tell the sampling distribution.
    ABSOLUTE
        An integral of absolute differences between distribution functions, each linear in the weights.
    UNKNOWN
        Nothing is declared; what is needed is measured by refits, or refused.
    """

    QUADRATIC = "quadratic"
    ABSOLUTE = "absolute"
    UNKNOWN = "unknown"


@dataclass(frozen=True, eq=False)
class Discrepancy(ABC):
    """A metric with its observed side prepared; call it with simulated responses.

    Attributes
    ----------
    metric : Metric
    observed : ndarray, shape (N,)
    weights : ndarray, shape (N,)
        Weights of the observed values; they sum to one.
    """

    metric: Metric
    observed: Floats
    weights: Floats
    _by_data_set: ClassVar[tuple[str, ...]] = ("weights",)

    def with_observed(self, observed: Floats, weights: Floats | None = None) -> Discrepancy:
        """Return the same metric, on the same cells, against other values; for resampling.

        Weights of shape (..., N) stand for as many data sets; then `outer` broadcasts against features.
        """
        return replace(self, observed=observed, weights=sample_weights(weights, observed.size))

    def rows(self, index: Any) -> Discrepancy:
        """Return some of the data sets of which there are several."""
        chosen = copy.copy(self)
        for name in self._by_data_set:
            object.__setattr__(chosen, name, getattr(self, name)[index])
        return chosen

    @property
    def n_effective(self) -> float:
        """Effective number of observations, 1 / sum(weights**2)."""
        return float(1 / (self.weights**2).sum())

    @property
    @abstractmethod
    def scale(self) -> float:
        """A typical size of the discrepancy, in its own units; makes optimiser tolerances unit-free."""

    @abstractmethod
    def features(self, simulated: Any, weights: Any, xp: Any) -> tuple[Any, ...]:
        """Return what `outer` takes, from simulated values (..., n) and weights that sum to at most one."""

    @abstractmethod
    def basis(self, simulated: Floats) -> tuple[NDArray[Any], ...]:
        """Return the arrays that turn weights of the fixed values ``simulated``, shape (n,), into features."""

    @abstractmethod
    def from_basis(self, weights: Any, basis: tuple[Any, ...], xp: Any) -> tuple[Any, ...]:
        """Return what `outer` takes, from weights of the values that the basis was made for."""

    @abstractmethod
    def outer(self, *features: Any, xp: Any) -> Any:
        """Return the discrepancy of the features; ``xp`` is `numpy` or `pytensor.tensor`."""

    @property
    def symbolic(self) -> bool:
        """Whether `outer` can be written as a graph; else it is called as an operation without gradient."""
        return True

    @property
    def density_cells(self) -> Cells | None:
        """The cells on which densities are compared, None where the features are none."""
        return None

    @property
    def differentiable(self) -> bool:
        """Whether the discrepancy has second derivatives in the values and weights of the population."""
        return self.metric.minimum is Minimum.QUADRATIC

    def overlap(self, simulated: Floats, weights: Floats) -> Floats:
        """Return the overlap of simulated and observed densities, (..., n) -> (...); one where there are none."""
        return np.ones(np.shape(simulated)[:-1])

    def of(self, simulated: Floats, weights: Floats) -> Any:
        """Return the discrepancy of checked values (..., n) and weights that sum to at most one."""
        return self.outer(*self.features(simulated, weights, np), xp=np)

    def __call__(self, simulated: ArrayLike, weights: ArrayLike | None = None) -> Any:
        """Return the discrepancy of simulated responses.

        Parameters
        ----------
        simulated : array_like, shape (..., n)
            In units of the observed values; +inf is a specimen that failed.
        weights : array_like, shape (..., n), optional
            Equal by default.

        Returns
        -------
        float or ndarray, shape (...)
        """
        values = simulated_sample(simulated)
        w = sample_weights(weights, values.shape[-1])
        result = self.of(np.broadcast_to(values, np.broadcast_shapes(values.shape, w.shape)), w)
        return float(result) if np.ndim(result) == 0 else result


def product(weights: Floats, matrix: Floats) -> Floats:
    """Return weights @ matrix, shapes (..., n), (n, m), as one product of matrices."""
    flat = weights.reshape(-1, weights.shape[-1]) @ matrix
    return flat.reshape(*weights.shape[:-1], matrix.shape[-1])


class Metric(ABC):
    """A calibration metric; ``against`` prepares the observed side once.

    A new metric defines ``_prepare(observed, weights)``, which returns a ``Discrepancy``.

    Attributes
    ----------
    minimum : Minimum
        How the discrepancy behaves around its minimum; unknown unless the metric declares it.
    tail_responses : int
        Simulated responses for each observation, all of equal weight, below which the metric sees too little of the
        population's tails; zero where that does not matter.
    likelihood : bool
        Whether N times the discrepancy is on the scale of a log-likelihood, so that epsilon is 1/N.
    """

    minimum: ClassVar[Minimum] = Minimum.UNKNOWN
    likelihood: ClassVar[bool] = False
    tail_responses: ClassVar[int] = 0

    @property
    def additive(self) -> bool:
        """Whether the gradient in the hyperparameters is a mean over observations."""
        return self.minimum is Minimum.QUADRATIC

    @property
    def takes_weights(self) -> bool:
        """Whether simulated responses may have unequal weights, as under `Reweighted`."""
        return True

    @abstractmethod
    def _prepare(self, observed: Floats, weights: Floats) -> Discrepancy: ...

    def against(self, observed: ArrayLike, weights: ArrayLike | None = None) -> Discrepancy:
        """Prepare the observed side.

        Parameters
        ----------
        observed : array_like, shape (N,)
            Measured responses.
        weights : array_like, shape (N,), optional
            Weights of the measured responses; equal by default.

        Returns
        -------
        Discrepancy
            ``discrepancy(simulated, weights=None)``, shapes (..., n) -> (...).

        Raises
        ------
        TypeError, ValueError
            If the observed values are not one-dimensional, real and finite, or if the metric needs a
            bandwidth or bins and they are all equal.
        """
        sample = observed_sample(observed)
        w = sample_weights(weights, sample.size, "observed weights")
        if w.shape != sample.shape:
            raise ValueError(f"observed weights: got shape {w.shape}, expected {sample.shape}")
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


@dataclass(frozen=True, eq=False)
class DensityDiscrepancy(Discrepancy):
    """A discrepancy of densities on cells; subclasses add the outer function."""

    cells: Cells
    density: Floats = field(init=False)
    _by_data_set: ClassVar[tuple[str, ...]] = ("weights", "density")

    def __post_init__(self) -> None:
        several = self.weights.ndim > 1
        density = (
            product(self.weights, self.cells.basis(self.observed))
            if several
            else self.cells.density(self.observed, self.weights)
        )
        object.__setattr__(self, "density", density)

    def features(self, simulated: Any, weights: Any, xp: Any) -> tuple[Any, ...]:
        """Return the density on the cells."""
        return (self.cells.density(simulated, weights),)

    def basis(self, simulated: Floats) -> tuple[NDArray[Any], ...]:
        """Return the matrix A with density = weights @ A."""
        return (self.cells.basis(simulated),)

    def from_basis(self, weights: Any, basis: tuple[Any, ...], xp: Any) -> tuple[Any, ...]:
        """Return the density on the cells."""
        return (weights @ basis[0],)

    @property
    def density_cells(self) -> Cells:
        """The cells."""
        return self.cells

    @property
    def differentiable(self) -> bool:
        """Whether the densities, as functions of the simulated values, are smooth too; those of a histogram are not."""
        return super().differentiable and self.cells.smooth

    @property
    def scale(self) -> float:
        """One: divergences and log densities have no units."""
        return 1.0

    def overlap(self, simulated: Floats, weights: Floats) -> Floats:
        """Return the cosine of simulated and observed density, shape (...): one if they are equal, zero if disjoint."""
        p, q, dz = self.cells.density(simulated, weights)[..., :-2], self.density[..., :-2], self.cells.widths[:-2]
        size = np.sqrt(((p**2) * dz).sum(axis=-1) * ((q**2) * dz).sum(axis=-1))
        return np.asarray(np.nan_to_num((p * q * dz).sum(axis=-1) / np.where(size > 0, size, 1.0)))

    def floored(self, density: Any) -> Any:
        """Mix a density with 1e-9 of the uniform density over all cells: the only floor in this package.

        It bounds logarithms where a population leaves the observed values alone, at log(1e-9 / length).
        """
        return (1 - _FLOOR) * density + _FLOOR / self.cells.widths.sum()
