"""What a calibration metric is: features of a weighted population, then one function of them.

`Metric` is configuration. ``metric.against(observed)`` prepares a `Discrepancy`, which holds the
measured side and is called with simulated responses. It works in two steps:

- *features*: a density on cells, or a difference of distribution functions. For responses that stay
  the same they are a linear map of the weights (`Discrepancy.basis`, `Discrepancy.from_basis`);
- the *outer* function of the features, which takes the array namespace, so that the direct call,
  the optimiser's gradient and the compiled graph of a PyMC model run through the same lines.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from prbayes._validate import (
    AT_ONCE,
    Floats,
    observed_outputs,
    observed_sample,
    sample_weights,
    simulated_sample,
)
from prbayes.metrics.grid import Cells, product

# Share of the uniform density that is mixed into densities before a logarithm is taken. Any value
# up to 1e-6 gives the same minimum on normal data, to a thousandth of a standard error (test). It
# decides for the forward divergence where an observation is far outside the fitted population:
# among 50 values of Student's t with three degrees of freedom, 1e-7 lets the fit leave out an
# outlier that 1e-9 and less keep in (test). A kernel has 1e-9 of its mass beyond six bandwidths,
# where grids end.
_FLOOR = 1e-9


class Minimum(Enum):
    """How a discrepancy behaves around its minimum, as far as its metric declares it.

    Attributes
    ----------
    QUADRATIC
        Twice differentiable in the hyperparameters: Hessian and gradient tell the sampling
        distribution.
    ABSOLUTE
        An integral of absolute differences between distribution functions, each linear in the
        weights.
    UNKNOWN
        Nothing is declared; what is needed is measured by refits, or refused.
    """

    QUADRATIC = "quadratic"
    ABSOLUTE = "absolute"
    UNKNOWN = "unknown"


@dataclass(frozen=True, eq=False)
class View:
    """What a part of a discrepancy sees of a response: all of it, unless it is a special view."""

    def of(self, simulated: Any, xp: Any = np) -> Any:
        """Return what is seen of simulated responses, a specimen's along the last axes."""
        return simulated

    def observed_of(self, values: Floats) -> tuple[Floats, NDArray[np.intp]]:
        """Return what is seen of observed values, and of which rows."""
        return self.of(values), np.arange(len(values))


@dataclass(frozen=True, eq=False)
class Part:
    """One term of a discrepancy that is a sum: ``share`` times what ``target`` says.

    Attributes
    ----------
    target : Discrepancy
        Of one output, or of something that stands for one; where it needs several outputs at a
        time, ``target.event`` says so.
    share : float
        Its factor in the sum.
    label : str
        What a reader calls it.
    view : View
        What it sees of a response.
    """

    target: Discrepancy
    share: float
    label: str
    view: View = View()

    def of(self, simulated: Any, xp: Any = np) -> Any:
        """Return what the target compares, (..., n, m) -> (..., n); NaN where an output is NaN."""
        return self.view.of(simulated, xp)

    def observed_of(self, values: Floats) -> tuple[Floats, NDArray[np.intp]]:
        """Return what the target compares of observed values, and of which rows.

        Rows that lack an output that is needed are left out: (n, m) -> (n',), (n',).
        """
        return self.view.observed_of(values)


@dataclass(frozen=True, eq=False)
class Discrepancy(ABC):
    """A metric with its observed side prepared; call it with simulated responses.

    Whoever adds a metric derives from this class, or from `DensityDiscrepancy` if the metric
    compares densities, and defines the abstract methods. All of them are batched: the last axis
    runs over the values, axes before it over populations. Records are immutable; another observed
    side makes another record.

    Attributes
    ----------
    metric : Metric
        The configuration that prepared it.
    observed : ndarray, shape (N,) or (N, m)
        Measured responses, of one output or of m.
    weights : ndarray, shape (N,) or (..., N)
        Weights of the observed values; they sum to one. Several rows stand for as many data sets.
    """

    metric: Metric
    observed: Floats
    weights: Floats
    # The fields that have a row for each data set.
    _by_data_set: ClassVar[tuple[str, ...]] = ("weights",)

    def with_observed(self, observed: Floats, weights: Floats | None = None) -> Self:
        """Return the same metric, on the same cells, against other values; for resampling.

        A metric that derives fields from the observed side derives them anew here.

        Parameters
        ----------
        observed : ndarray, shape (n,)
        weights : ndarray, shape (n,) or (..., n), optional
            Equal by default. With several rows, each a data set, `outer` broadcasts the data sets
            against the features.
        """
        w = sample_weights(weights, len(observed))
        return replace(self, observed=observed, weights=w)

    def rows(self, index: Any) -> Self:
        """Return some of the data sets of which there are several; nothing is computed anew."""
        chosen = {name: getattr(self, name)[index] for name in self._by_data_set}
        return replace(self, **chosen)

    @property
    def event(self) -> tuple[int, ...]:
        """The shape of one specimen's response: () for one output, (m,) for several."""
        return self.observed.shape[1:]

    @property
    def parts(self) -> tuple[Part, ...]:
        """The terms that it is the sum of: itself, unless it is made of several."""
        return (Part(self, 1.0, ""),)

    @property
    def told(self) -> str:
        """What a reader has to know of what is compared, as a clause; empty if it is all."""
        return ""

    @property
    def missed(self) -> str:
        """What the data vary in and the comparison does not see, as a clause; empty if nothing."""
        return ""

    def beside(self, design: Floats, inputs: int) -> Discrepancy:
        """Return the same comparison, now that the first simulated responses are known.

        Itself, unless the metric chooses what it compares by the data and them together, or by how
        many numbers a specimen's inputs are.
        """
        return self

    @property
    def likelihood(self) -> bool:
        """Whether N times the discrepancy is on the scale of a log-likelihood."""
        return self.metric.likelihood

    @property
    def exact(self) -> bool:
        """Whether N times it is minus the log-likelihood itself, but for a narrow kernel."""
        return False

    @property
    def resolution(self) -> float:
        """Standard deviation of the kernel by which it reads a density at single observed values.

        Zero unless it does.
        """
        return 0.0

    def narrowed(self, factor: float) -> Discrepancy:
        """Return the same with that kernel narrowed by a factor; itself where it has none."""
        return self

    @property
    def additive(self) -> bool:
        """Whether its gradient in the hyperparameters is a mean over observations."""
        return self.metric.additive

    @property
    def n_effective(self) -> float:
        """Effective number of observations, 1 / sum(weights**2)."""
        return float(1 / (self.weights**2).sum())

    @property
    @abstractmethod
    def scale(self) -> float:
        """A typical size of the discrepancy, positive, in its own units.

        Optimisers divide by it, so that their tolerances mean the same for every metric.
        """

    @abstractmethod
    def features(self, simulated: Any, weights: Any, xp: Any) -> tuple[Any, ...]:
        """Return what `outer` takes, for any simulated responses.

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
    def basis(self, simulated: Floats) -> tuple[NDArray[Any], ...]:
        """Return arrays that turn weights of stored values, shape (n,), into features.

        They are made once for the values; `from_basis` then serves any weights.
        """

    @property
    def columns(self) -> int:
        """How many numbers the basis has for each value, where `compact` has fewer; else zero."""
        return 0

    def compact(self, simulated: Floats) -> tuple[NDArray[Any], ...]:
        """Return arrays that serve as the basis does with NumPy, and take less memory."""
        return self.basis(simulated)

    def stored(self, simulated: Floats) -> tuple[NDArray[Any], ...]:
        """Return the basis where it is small, and else what is compact."""
        small = len(simulated) * self.columns <= AT_ONCE
        return self.basis(simulated) if small else self.compact(simulated)

    def pulled_back(self, basis: Floats, cotangent: Floats) -> Floats:
        """Return the derivatives for the weights, (..., n), of a sum over the only feature.

        Of the sum of the feature times the cotangent, (..., m), by the compact form of the basis.
        """
        raise NotImplementedError

    @abstractmethod
    def from_basis(self, weights: Any, basis: tuple[Any, ...], xp: Any) -> tuple[Any, ...]:
        """Return the features of the values that the basis was made for.

        Equal to ``features(simulated, weights, xp)`` up to what the outer function does not see,
        and linear in the weights, shape (..., n), so that gradients are exact.
        """

    @abstractmethod
    def outer(self, *features: Any, xp: Any) -> Any:
        """Return the discrepancy of the features, shape (...); smaller is better.

        Written with ``xp`` (``numpy`` or ``pytensor.tensor``), by functions that both have.
        """

    @property
    def cellwise(self) -> Cellwise | None:
        """How it is a sum over the cells of a density, its only feature; None if it is not."""
        return None

    @staticmethod
    def stacked(bases: Sequence[tuple[NDArray[Any], ...]]) -> tuple[NDArray[Any], ...] | None:
        """Return the bases of several discrepancies as one, for `side_by_side`; None if it cannot.

        The graph of many slices is then no larger than that of one.
        """
        return None

    @staticmethod
    def side_by_side(targets: Any, weights: Any, basis: tuple[Any, ...], xp: Any) -> Any:
        """Return the values of several discrepancies from a stacked basis, (..., K), or None."""
        return None

    @property
    def symbolic(self) -> bool:
        """Whether `outer` can be written as a graph; else it is an operation without gradient."""
        return True

    @property
    def density_cells(self) -> Cells | None:
        """The cells on which densities are compared, None where the features are none."""
        return None

    @property
    def differentiable(self) -> bool:
        """Whether the discrepancy has second derivatives in the population's values and weights."""
        return self.metric.minimum is Minimum.QUADRATIC

    def overlap(self, simulated: Floats, weights: Floats) -> Floats:
        """Return the overlap of both densities, (..., n) -> (...); one where there are none."""
        shape = np.shape(simulated)
        batch = shape[: len(shape) - 1 - len(self.event)]
        return np.ones(batch)

    def of(self, simulated: Floats, weights: Floats) -> Any:
        """Return the discrepancy of checked values (..., n) and weights that sum to at most one."""
        features = self.features(simulated, weights, np)
        return self.outer(*features, xp=np)

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
        before = values.shape[: values.ndim - len(self.event)]
        w = sample_weights(weights, before[-1])
        shape = np.broadcast_shapes(before, w.shape)
        values = np.broadcast_to(values, (*shape, *self.event))
        result = self.of(values, w)
        return float(result) if np.ndim(result) == 0 else result


class Metric(ABC):
    """A calibration metric; ``against`` prepares the observed side once.

    A metric of your own is a frozen dataclass that derives from this class. It defines
    ``_prepare(observed, weights)``, which gets checked values, shape (N,), and weights that sum to
    one, and returns a `Discrepancy`. What calibration may assume of it, it declares as class
    attributes or properties:

    Attributes
    ----------
    minimum : Minimum
        How the discrepancy behaves around its minimum; unknown unless the metric declares it.
    additive : bool
        Whether its gradient in the hyperparameters is a mean over observations, as that of an outer
        function linear in the observed density. If not, standard errors come from simulated data
        sets. Metrics with a quadratic minimum are taken for additive unless they declare it.
    takes_weights : bool
        Whether simulated responses may have unequal weights, as under `Reweighted`.
    counts_failures : bool
        Whether observed values may be +inf, specimens that failed, as simulated ones may. Data sets
        of its sampling distribution then have failures as well.
    tail_responses : int
        Simulated responses for each observation, all of equal weight, below which the metric sees
        too little of the population's tails; zero where that does not matter.
    likelihood : bool
        Whether N times the discrepancy is on the scale of a log-likelihood, so that epsilon is 1/N.
    distance : bool
        Whether equal samples have a discrepancy of zero, so that its size between a population and
        data drawn from it is sampling noise. Only a likelihood may do without: its size depends on
        the unit of the response.
    """

    minimum: ClassVar[Minimum] = Minimum.UNKNOWN
    likelihood: ClassVar[bool] = False
    distance: ClassVar[bool] = True
    counts_failures: ClassVar[bool] = False
    tail_responses: ClassVar[int] = 0

    @property
    def additive(self) -> bool:
        """Whether the gradient in the hyperparameters is a mean over observations."""
        return self.minimum is Minimum.QUADRATIC

    @property
    def takes_weights(self) -> bool:
        """Whether simulated responses may have unequal weights, as under `Reweighted`."""
        return True

    @property
    def by_specimen(self) -> bool:
        """Whether it is a likelihood of each specimen's record, and compares no distributions."""
        return False

    @property
    def takes_outputs(self) -> bool:
        """Whether it compares several outputs at a time, (N, m), as `Joint` does."""
        return False

    def like(self, metric: Metric) -> Metric:
        """Return the metric that compares the same outputs in the same way, but by another metric.

        ``metric`` itself, unless this one lifts a metric of one output to several.
        """
        return metric

    def beside(self, observed: Floats, weights: Floats, design: Floats, inputs: int) -> Discrepancy:
        """Return the discrepancy from checked values, now that a design's responses are known."""
        return self._prepare(observed, weights)

    @abstractmethod
    def _prepare(self, observed: Floats, weights: Floats) -> Discrepancy:
        """Return the discrepancy from these observed values, both of shape (N,) and checked."""

    def on_one_scale(self, slices: Sequence[Discrepancy]) -> Sequence[Discrepancy]:
        """Return discrepancies from slices of one sample, in units in which their mean is meant.

        They are as they are, unless the metric takes a factor from the data.
        """
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


@dataclass(frozen=True, eq=False)
class DensityDiscrepancy(Discrepancy):
    """A discrepancy of two densities on the same cells.

    The only feature is the simulated density, shape (..., m). A metric that derives from this class
    defines `outer`, and nothing else unless it needs further fields; ``on_cells`` makes it. In
    ``outer``, ``self.density`` is the observed density, and an integral is a sum over the last axis
    of values times ``self.cells.widths``. The last two cells are the mass below and above all
    others.

    Attributes
    ----------
    cells : Cells
        Laid out once, from the values that the metric was prepared with.
    density : ndarray, shape (m,) or (..., m)
        Observed density on the cells, in 1 / units of the response; a row for each data set.
    """

    cells: Cells
    density: Floats
    _by_data_set: ClassVar[tuple[str, ...]] = ("weights", "density")

    @classmethod
    def on_cells(cls, metric: Any, observed: Floats, weights: Floats, cells: Cells) -> Self:
        """Return the discrepancy from observed values with their density on given cells.

        Parameters
        ----------
        metric : Metric
        observed, weights : ndarray, shape (N,)
        cells : Cells
            Usually those that the metric's estimator lays out for the observed values.
        """
        density = observed_density(cells, observed, weights)
        return cls(metric, observed, weights, cells, density)

    def with_observed(self, observed: Floats, weights: Floats | None = None) -> Self:
        """Return the same metric, on the same cells, against other values; for resampling."""
        w = sample_weights(weights, observed.size)
        density = observed_density(self.cells, observed, w)
        return replace(self, observed=observed, weights=w, density=density)

    def features(self, simulated: Any, weights: Any, xp: Any) -> tuple[Any, ...]:
        """Return the density on the cells."""
        return (self.cells.density(simulated, weights),)

    def basis(self, simulated: Floats) -> tuple[NDArray[Any], ...]:
        """Return the matrix A with density = weights @ A."""
        return (self.cells.basis(simulated),)

    def from_basis(self, weights: Any, basis: tuple[Any, ...], xp: Any) -> tuple[Any, ...]:
        """Return the density on the cells."""
        return (product(weights, *basis) if xp is np else weights @ basis[0],)

    @property
    def density_cells(self) -> Cells:
        """The cells."""
        return self.cells

    @property
    def differentiable(self) -> bool:
        """Whether the densities are smooth in the simulated values too; a histogram's are not."""
        return super().differentiable and self.cells.smooth

    @property
    def scale(self) -> float:
        """One: divergences and log densities have no units."""
        return 1.0

    def overlap(self, simulated: Floats, weights: Floats) -> Floats:
        """Return the cosine of simulated and observed density, shape (...).

        One if they are equal, zero if disjoint. Mass outside the inner cells counts in neither.
        """
        p = self.cells.density(simulated, weights)
        p = p[..., :-2]
        q = self.density[..., :-2]
        dz = self.cells.widths[:-2]
        # Integrals of p q, of p squared and of q squared.
        mixed = (p * q * dz).sum(axis=-1)
        simulated_square = ((p**2) * dz).sum(axis=-1)
        observed_square = ((q**2) * dz).sum(axis=-1)
        size = np.sqrt(simulated_square * observed_square)
        size = np.where(size > 0, size, 1.0)
        cosine = mixed / size
        return np.asarray(np.nan_to_num(cosine))

    def floored(self, density: Any) -> Any:
        """Mix a density with 1e-9 of the uniform density over all cells: the package's only floor.

        It bounds logarithms where a population leaves the observed values alone, at
        log(1e-9 / length).
        """
        return raised(density, self.least)

    @property
    def least(self) -> Any:
        """What the floor adds to a density in each cell."""
        length = self.cells.widths.sum()
        return _FLOOR / length


def raised(density: Any, least: Any) -> Any:
    """Return a density with its floor, which has 1e-9 of the mass."""
    return (1 - _FLOOR) * density + least


@dataclass(frozen=True, eq=False)
class Cellwise:
    """A discrepancy as a sum over cells: of what its terms say, each times a share."""

    of: CellwiseDiscrepancy  # whose terms these are
    constants: tuple[Any, ...]
    shares: Any  # (..., m), or one number

    def rows(self, index: Any) -> Cellwise:
        """Return it for some of the data sets of which there are several."""
        # What is the same for all of them is a number, or one by cell.
        constants = tuple(c[index] if np.ndim(c) > 1 else c for c in self.constants)
        shares = self.shares[index] if np.ndim(self.shares) > 1 else self.shares
        return Cellwise(self.of, constants, shares)

    def outer(self, density: Any, xp: Any) -> Any:
        """Return the sum over the cells, (..., m) -> (...)."""
        return (self.of.terms(density, self.constants, xp) * self.shares).sum(axis=-1)


class CellwiseDiscrepancy(DensityDiscrepancy):
    """A discrepancy of two densities that is a sum over the cells.

    Several of them, on cells of their own, are then one sum over all cells.
    """

    @property
    @abstractmethod
    def constants(self) -> tuple[Any, ...]:
        """What `terms` takes beside the density: by cell, (m,) or (..., m), or one number."""

    @abstractmethod
    def terms(self, density: Any, constants: tuple[Any, ...], xp: Any) -> Any:
        """Return what each cell adds, shape (..., m); nothing else of the record than its metric.

        The constants are given, since they may be those of several records side by side.
        """

    @property
    def cellwise(self) -> Cellwise | None:
        """Itself, unless its outer function is another one."""
        if type(self).outer is not CellwiseDiscrepancy.outer:
            return None
        return Cellwise(self, self.constants, np.float64(1.0))

    def outer(self, *features: Any, xp: Any) -> Any:
        """Return the sum over the cells."""
        (density,) = features
        return self.terms(density, self.constants, xp).sum(axis=-1)


def observed_density(cells: Cells, observed: Floats, weights: Floats) -> Floats:
    """Return the density of observed values on cells, shapes (N,), (N,) -> (m,).

    Weights of shape (..., N) are as many data sets: (..., m).
    """
    if weights.ndim == 1:
        return cells.density(observed, weights)
    basis = cells.basis(observed)
    return product(weights, basis)
