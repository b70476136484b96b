"""`Reweighted`: stored responses with importance weights for each value of the hyperparameters."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import KW_ONLY, dataclass, replace
from typing import Any, ClassVar, Literal, Self

import numpy as np
import pytensor
import pytensor.tensor as pt
from pytensor.gradient import disconnected_grad
from pytensor.graph.traversal import ancestors
from pytensor.tensor.variable import TensorVariable

from prbayes._finding import Finding, report
from prbayes._validate import AT_ONCE, IN_CACHE, Floats, Indices, NamedArrays, positive_integer
from prbayes.emulators.kriging import MOST_RUNS
from prbayes.emulators.surfaces import Surface
from prbayes.metrics.base import Basis, Discrepancy, is_additive
from prbayes.numerics.threads import one_thread
from prbayes.propagation.base import (
    MAX_LOST,
    Bound,
    DesignError,
    Propagation,
    check_arguments,
    refuse_all_nan,
    refuse_nested,
    valid_parents,
)
from prbayes.propagation.design import Design, DesignSampler, log_weight_graph
from prbayes.propagation.importance import (
    SIZES,
    MixtureSampler,
    Sample,
)
from prbayes.propagation.ops import stored_discrepancy
from prbayes.propagation.population_density import PopulationDensity, normalise
from prbayes.response.budget import RunCost
from prbayes.response.distributions import PriorSampler, refuse_without_density
from prbayes.response.inputs import Inputs
from prbayes.response.outputs import is_missing
from prbayes.response.response import (
    Responses,
    deduplicated_responses,
)

# Largest number of elements of a basis in a compiled graph, 1 GiB, for the largest design. Above
# this size metrics take a smaller form, which is as fast, but whose operations JAX cannot compile.
_MAX_BASIS = 1 << 27


@dataclass(frozen=True)
class Reweighted(Propagation):
    """Simulate once: stored responses get weights p(x given theta) / g(x) for each theta.

    Parameters
    ----------
    n : int
        Number of design points, drawn from the inputs' prior predictive distribution; the response
        is computed n times, once. `refine` adds batches where they are needed.
    random_seed : int
        Seed of the design.
    max_lost : float
        Largest share of a population's weight that may fall on points whose response is NaN.
    max_points : int, optional
        Largest number of responses, refinement included; 32 n by default.
    emulator : str, Surface or regressor, optional
        Predicts the response between the runs: a few dozen or hundred runs are then enough for
        several inputs. ``"auto"`` takes the better of two Gaussian processes for each output, by
        errors at runs that were left out, and mixes it with the weighted runs as far as these
        errors require. With one input, discrete ones, or an n above 2000 it uses the runs alone, as
        None does. Or a surface of ``prb.surrogate``, or any regressor with ``fit(X, y)`` and
        ``predict(X)``.
    executor : Executor, optional
        Where the response is computed: threads, processes, loky,
        ``dask.distributed.Client().get_executor()``, ``mpi4py.futures.MPIPoolExecutor()``. In this
        process by default.
    store : path-like, optional
        A folder with every computed response, by simulator: none is computed again, also in
        another run. At the first use of each simulator the smallest, the middle and the largest
        response are recomputed, and one that is NaN or infinite. A changed response, by its code or
        by variables that it reads, is refused.
    version : str, optional
        Name of the response as it is, such as ``"2"`` or ``"mesh 3"``. The store separates runs of
        different versions, and of other names or another order of several outputs. It recomputes
        none, nor for `predict` or `exceedance`: give a new name whenever the response changes.
    on_failure : Abort, Replace or Retry
        Policy for a response that raises, and by option for one that is NaN: by default NaN is a
        specimen without response.
    retry_failed : bool
        Whether points that failed according to the store, or whose response is NaN there, are
        computed again, as after a repair. Under `Abort` those that failed are in any case: a
        failure is no result.
    timeout : float, optional
        Seconds after which a response has failed; with executors of processes only, Dask's among
        them, as nothing else ends a response that hangs. What hangs outside Python ends with its
        worker, half as long again and five seconds later; Dask then tries it on other workers.

    Raises
    ------
    TypeError, ValueError
        If an option is not as described.

    References
    ----------
    .. [1] Owen, A. B., Monte Carlo theory, methods and examples, chapter 9 (mixture importance
       sampling).

    Examples
    --------
    >>> Reweighted(256)
    Reweighted(n=256, random_seed=0, max_lost=0.05, max_points=None, emulator='auto')
    """

    n: int = 1024
    _: KW_ONLY
    random_seed: int = 0
    max_lost: float = MAX_LOST
    max_points: int | None = None
    emulator: Any = "auto"

    def __post_init__(self) -> None:
        check_arguments(self, 16)
        expected = (
            'expected "auto", None, a surface such as prb.surrogate.RadialBasis(), or a regressor '
            "with fit(X, y) and predict(X)"
        )
        emulator = self.emulator
        if isinstance(emulator, str):
            if emulator != "auto":
                raise ValueError(f"Reweighted: emulator: got {emulator!r}, {expected}")
        elif emulator is not None and not isinstance(emulator, Surface):
            is_regressor = callable(getattr(emulator, "fit", None)) and hasattr(emulator, "predict")
            if not is_regressor:
                got = type(emulator).__name__
                raise TypeError(f"Reweighted: emulator: got {got}, {expected}")
        if self.max_points is not None:
            positive_integer(self.max_points, "Reweighted: max_points", minimum=self.n)

    @property
    def cost(self) -> RunCost:
        """Runs that this propagation needs: no run for a value of the hyperparameters."""
        growth = (
            f"up to {self.most} in all, where the calibrated populations are not supported, or "
            "another design would answer differently"
        )
        return RunCost(self.n, 0, self.most, growth)

    @property
    def emulator_runs(self) -> int | None:
        """The number of runs, unless it is the default."""
        return None if self.n == type(self).n else self.n

    @property
    def most(self) -> int:
        """The largest number of responses, refinement included."""
        return self.max_points or 32 * self.n

    def check_simulator(self, name: str, inputs: Inputs, target: Discrepancy) -> None:
        """Refuse inputs and metrics that stored responses cannot serve, and idle emulators."""
        if inputs.epistemic:
            labels = [str(e.name or e) for e in inputs.epistemic]
            names = ", ".join(labels)
            if not any(above in inputs.parents for above in ancestors(inputs.epistemic)):
                raise TypeError(
                    f"{name}: {names} goes into the response as data whose value may change, while "
                    f"responses are stored; pass the value itself, such as {labels[0]}.get_value()"
                )
            raise TypeError(
                f"{name}: {names} goes into the response as a model variable (epistemic), so "
                "stored responses cannot be reweighted"
            )
        refuse_nested(name, inputs)
        refuse_without_density(name, inputs)
        if not target.metric.takes_weights:
            raise TypeError(
                f"{name}: a metric that takes no weights cannot be used with prb.Reweighted; "
                "in a FunctionMetric write function(simulated, observed, weights) with "
                "weighted=True"
            )
        is_custom = self.emulator is not None and not isinstance(self.emulator, str)
        if is_custom and not self.emulates(inputs):
            kinds = ", ".join(f"{x.dtype}, {x.type.ndim} dimensions" for x in inputs.aleatory)
            raise TypeError(
                f"{name}: emulator: got {type(self.emulator).__name__} for aleatory inputs "
                f"({kinds}), expected several continuous numbers for each specimen: one number or "
                "discrete ones need no emulator; leave emulator= out"
            )

    def check_likelihood(self, name: str) -> None:
        """Refuse options that the log-likelihood by specimen, with its own emulator, lacks."""
        for option, default in (("emulator", "auto"), ("max_points", None)):
            value = getattr(self, option)
            if value != default:
                raise TypeError(
                    f"{name}: propagation: got Reweighted({option}={value!r}), which "
                    "prb.LogLikelihood() does not use, as it has its own emulator; leave "
                    f"{option}= out"
                )

    def emulates(self, inputs: Inputs) -> bool:
        """Return whether responses between the runs are emulated."""
        # A response with more runs than this is cheap and needs no emulator. Runs of one input are
        # a quadrature rule, which is accurate without an emulator.
        if self.emulator is None or (isinstance(self.emulator, str) and self.n > MOST_RUNS):
            return False
        return inputs.dimensions > 1 and {np.dtype(x.dtype).kind for x in inputs.aleatory} == {"f"}

    def bind(self, name: str, inputs: Inputs, target: Discrepancy, responses: Responses) -> Bound:
        """Compute the responses at the first design points."""
        return ReweightedBound(name, inputs, target, responses, self)


class ReweightedBound(Bound):
    """Stored responses with weights p(x given theta) / g(x) for every theta.

    The points of a batch are stratified over a finite list of values of the parents. The list is
    kept, and g is exactly the mixture, over all batches, of the densities at the listed values
    (balance heuristic).
    """

    stored: ClassVar[bool] = True
    # Whether the points are runs. Responses beyond those of emulated specimens are constant.
    has_runs: ClassVar[Literal[True]] = True

    def __init__(
        self,
        name: str,
        inputs: Inputs,
        target: Discrepancy,
        responses: Responses,
        config: Reweighted,
    ) -> None:
        super().__init__(name, inputs, target, responses)
        self.config = config
        self.max_lost = config.max_lost
        emulator = config.emulator if config.emulates(inputs) else None
        mixtures = MixtureSampler(name, inputs, PopulationDensity(inputs))
        self._sampler = DesignSampler(mixtures, config.random_seed, emulator)
        self._data = {key: np.array(data.get_value()) for key, data in inputs.data.items()}
        # Shared variables in the graph of the PyMC model; empty before the graph is built.
        self._shared: list[Any] = []
        # Metric, sample and basis of the last evaluation.
        self._basis: tuple[Any, ...] = (None, None, None)
        # Other responses with their values at the runs. A study has fewer than 32 conditions, and
        # more would fill the memory.
        self._other_responses: deque[tuple[Responses, Sample]] = deque(maxlen=32)
        # As many populations as points would be no more accurate, and their cost grows with the
        # square.
        components = PriorSampler(inputs.parents)(min(config.n, 512), config.random_seed)
        components = valid_parents(self, components)
        self._design = self._sampler.with_runs(None, components, config.n, responses)
        self.support_moves = bool(self._design.moving)
        runs = self._design.runs
        self.first_points, self.first_responses = runs.points, runs.values
        refuse_all_nan(name, runs.values)
        if not self._design.has_emulated_points:
            _report_low_ess(self, components)

    @property
    def design(self) -> Design:
        """The stored runs, and the points that have weights; an earlier record may be assigned."""
        return self._design

    @design.setter
    def design(self, design: Design) -> None:
        self._design = design
        if self._shared:
            arrays = [*design.graph_arrays, *self._graph_basis().arrays]
            for shared, array in zip(self._shared, arrays, strict=True):
                shared.set_value(array, borrow=True)

    def copied(self, design: Design | None = None) -> Self:
        """Return the same propagation with its own count of responses, and another design."""
        copied = super().copied()
        copied._other_responses = self._other_responses.copy()
        copied._shared = []
        copied._design = self._design if design is None else design
        return copied

    @property
    def n_points(self) -> int:
        """Number of points that have weights."""
        return len(self._design.sample)

    @property
    def n_runs(self) -> int:
        """Number of stored responses."""
        return len(self._design.runs)

    @property
    def blocks(self) -> Indices:
        """Which of eight coarser designs each point belongs to, shape (n,)."""
        return self._design.sample.blocks

    @property
    def required_ess(self) -> float:
        """The weight effective sample size that keeps design error well below sampling error.

        Stratified points of one input integrate with an error that falls like 1/n, of several like
        n^(-3/4); the size follows from asking that error to be a fraction of 1/sqrt(N).
        """
        root = np.sqrt(self.target.n_effective)
        if self.inputs.dimensions == 1:
            return float(max(50.0, 6 * root))
        return float(max(100.0, (15 * root) ** (4 / 3)))

    def add(self, components: Sequence[Floats], n: int | None = None) -> None:
        """Add runs for populations at parents; raise DesignError if data have changed."""
        now = {name: np.array(shared.get_value()) for name, shared in self.inputs.data.items()}
        changed = [name for name in now if not np.array_equal(self._data[name], now[name])]
        if changed:
            raise DesignError(
                f"{self.name}: got other values of {', '.join(changed)}, which is above the "
                "inputs, than when the design was begun, expected the same ones: the density of "
                "its points is that of the old values, and no points can be added to it; build "
                "the model again with the new ones"
            )
        n = n or self.config.n
        components = valid_parents(self, components)
        self.design = self._sampler.with_runs(self._design, components, n, self.responses)

    def reach(self, parents: list[Floats], *, same_surfaces: bool = False, growth: int = 1) -> None:
        """Draw ``growth`` times as many emulated points for valid populations, without a run.

        To select surfaces for these populations takes most of the time.
        """
        design = replace(self._design, emulated_size=growth * self._design.emulated_size)
        emulator = design.emulator if same_surfaces else None
        self.design = self._sampler.resampled(design, parents, emulator)

    def points_of(self, inputs: Inputs, points: Sequence[Floats] | None = None) -> list[Floats]:
        """Return the points of some of the design's aleatory inputs, shapes (n, *event)."""
        points = self._design.sample.points if points is None else points
        places = [id(x) for x in self.inputs.aleatory]
        return [points[places.index(id(x))] for x in inputs.aleatory]

    def values_of(self, responses: Responses) -> Floats:
        """Return another response of the design's specimens, (n,) or (n, m).

        Known runs are reused. Raise ValueError if the design's own response has changed since its
        runs, and PoorEmulatorError if another response is emulated poorly between the runs; runs
        alone need no emulator.
        """
        design = self._design
        if responses.same_as(self.responses):
            points = self.points_of(responses.inputs, design.runs.points)
            responses.refuse_change(points, design.runs.values, self.responses)
            return design.sample.values
        at_runs = self._at_runs(responses)
        if design.emulated is None:
            return at_runs
        values = self._sampler.emulator_of(design, at_runs).at(design.emulated)
        has_runs = len(values) < self.n_points
        return np.concatenate([values, at_runs]) if has_runs else values

    @property
    def on_line(self) -> bool:
        """Whether the points are a quadrature rule of one continuous number."""
        return self._design.on_line

    def emulated(self, responses: Responses, points: Sequence[Floats]) -> list[Floats]:
        """Return a response at any points of the design's inputs by emulators, (n,) or (n, m).

        By that of all runs first, then by those without one block of them; none without emulators.
        """
        emulator = self._design.emulator
        if emulator is None:
            return []
        if not responses.same_as(self.responses):
            emulator = self._sampler.emulator_of(self._design, self._at_runs(responses))
        return [emulator.at(points), *emulator.without_each_block(points)]

    def _at_runs(self, responses: Responses) -> Floats:
        """Return values of another response at the runs, (n,) or (n, m)."""
        runs = self._design.runs
        pairs = [pair for pair in self._other_responses if responses.same_as(pair[0])]
        values = np.empty(0)
        if pairs:
            # The design may have changed since the earlier call; its first runs may still be the
            # same.
            previous, earlier = pairs[0]
            responses.runs = previous.runs
            # Names of the outputs, if the response returns a mapping.
            responses.outputs = responses.outputs or previous.outputs
            n = min(len(earlier), len(runs))
            equal = np.ones(n, dtype=bool)
            for x, y in zip(earlier.points, runs.points, strict=True):
                equal &= (x[:n] == y[:n]).reshape(n, -1).all(axis=1)
            values = earlier.values[: n if equal.all() else int(equal.argmin())]
            points = self.points_of(responses.inputs, earlier.points)
            responses.refuse_change(points, earlier.values, previous)
        if len(values) < len(runs):
            points = self.points_of(responses.inputs, runs.points)
            missing = [x[len(values) :] for x in points]
            more = deduplicated_responses(responses, missing, (points, values))
            values = np.concatenate([values.reshape(-1, *more.shape[1:]), more])
            if pairs:
                self._other_responses.remove(pairs[0])
            self._other_responses.append((responses, replace(runs, values=values)))
        return values

    def _graph_basis(self) -> Basis:
        """Return the basis for compiled graphs; its structure does not change as a design grows."""
        most = self.config.most
        if self._sampler.emulator is not None:
            most = max(most, SIZES.largest)
        return self.target.basis(self._design.sample.values, _MAX_BASIS * self.n_points / most)

    def _discrepancy(self, params: Sequence[Any]) -> TensorVariable:
        """Return the discrepancy of the reweighted responses, +inf where no point has weight."""
        design, basis = self._design, self._graph_basis()
        n_arrays = len(design.weight_arrays)
        if not self._shared:
            for i, array in enumerate([*design.graph_arrays, *basis.arrays]):
                # Some samplers identify shared variables by their names. Lengths are open, as
                # designs may grow.
                name, shape = f"{self.name}_design_{i}", (None,) * array.ndim
                self._shared.append(pytensor.shared(array, name=name, borrow=True, shape=shape))
        logs = log_weight_graph(self.inputs, params, self._shared[:n_arrays], design.moving)
        largest = pt.max(logs)
        supported = largest > -np.inf
        # The softmax is written out, because each backend implements PyTensor's operation
        # separately. Subtracting the largest logarithm prevents overflow and does not change the
        # gradient.
        centred = logs - disconnected_grad(largest)
        raw = pt.exp(pt.switch(supported, centred, 0.0))
        weights = raw / raw.sum()
        form = replace(basis, arrays=tuple(self._shared[n_arrays:]))
        return pt.switch(supported, stored_discrepancy(self.target, form, weights), np.inf)

    def populations(self, params: Sequence[Any]) -> tuple[Floats, Floats]:
        """Return the stored responses and their weights at given parents."""
        weights = self._sampler.log_weights(params, self._design)
        normalise(weights)
        values = self._design.sample.values
        return np.broadcast_to(values, weights.shape + values.shape[1:]), weights

    def discrepancies(self, params: Sequence[Any], target: Discrepancy) -> Floats:
        """Return the discrepancies of populations at given parents, (k,); +inf without support."""
        sample = self._design.sample
        if self._basis[0] is not target or self._basis[1] is not sample:
            self._basis = (target, sample, target.basis(sample.values))
        basis = self._basis[2]
        is_lost = is_missing(sample.values)
        size = len(params[0])
        # Populations are evaluated in blocks whose weights fit into the processor's cache. Since
        # each block reads all stored responses, it has at least 64 populations, unless the basis of
        # many observed values is so wide that these would fill the memory.
        width = max(array.shape[-1] for array in basis.arrays)
        step = max(1, min(max(64, IN_CACHE // len(sample)), AT_ONCE // width))
        parts = []
        # The product for a single population is small, so that a limit of threads is not worth its
        # time.
        with one_thread() if size > 1 else nullcontext():
            for first in range(0, max(1, size), step):
                parents = [p[first : first + step] for p in params]
                weights = self._sampler.log_weights(parents, self._design)
                weights[:, is_lost] = -np.inf
                is_supported = np.isfinite(normalise(weights))
                weights[~is_supported] = 1 / len(sample)
                features = basis.features(weights)
                values = target.outer(*features, xp=np)
                parts.append(np.where(is_supported, values, np.inf))
        return np.concatenate(parts)

    def support(self, params: Sequence[Any]) -> NamedArrays:
        """Return how well the design supports the populations at given parents, shapes (k,).

        Returns
        -------
        dict
            ``weight_ess``, the effective sample size of the weights; ``mean_weight``, the mean raw
            weight (1 in expectation; less when the design covers a part of the population);
            ``lost_mass``, the share of weight on points whose response is NaN; ``failed_mass``, the
            share of specimens that failed (+inf) in the rest.
        """
        values = self._design.sample.values
        weights = self._sampler.log_weights(params, self._design)
        log_totals = normalise(weights)
        is_lost = is_missing(values)
        has_failed = np.isposinf(values).reshape(self.n_points, -1).any(axis=1)
        lost = weights @ is_lost
        with np.errstate(divide="ignore", invalid="ignore"):
            ess = 1 / np.vecdot(weights, weights)
            failed = weights @ has_failed / (weights @ ~is_lost)
        return {
            "weight_ess": np.nan_to_num(ess),
            "mean_weight": np.exp(log_totals - np.log(self.n_points)),
            "lost_mass": np.nan_to_num(lost, nan=1.0),
            "failed_mass": np.nan_to_num(failed),
        }


def _report_low_ess(bound: ReweightedBound, components: Sequence[Floats]) -> None:
    """Report a design whose effective sample size is small in populations of the prior."""
    runs = bound._design.runs
    step = max(1, IN_CACHE // len(runs))
    sizes = []
    for first in range(0, len(components[0]), step):
        block = [parent[first : first + step] for parent in components]
        sizes.append(1 / (bound._sampler.weights(runs, block) ** 2).sum(axis=1))
    ess = float(np.median(np.concatenate(sizes)))
    if ess >= bound.required_ess:
        return
    dimensions = bound.inputs.dimensions
    # With more than four inputs weights are very uneven, so that another propagation is better.
    level = logging.WARNING
    if dimensions <= 4:
        level = logging.INFO  # most methods refine the design afterwards
        advice = (
            "prb.minimize and prb.sample_smc refine it; before pm.sample call prb.refine(model)"
        )
    else:
        by_default = replace(bound.config, emulator="auto")
        is_alone = bound.config.emulator is None and by_default.emulates(bound.inputs)
        leave = "leave out emulator=None, or " if is_alone else ""
        advice = (
            f"{dimensions} inputs are many for stored responses alone: {leave}use "
            "propagation=prb.Resimulated(n), which has no design"
        )
        if not is_additive(bound.target):
            advice += " and metric=prb.ProbabilityResidual() for prb.sample"
    text = (
        f"{bound.name}: the design of {bound.config.n} runs supports a typical population of the "
        f"prior with a weight effective sample size of {ess:.0f}, expected at least "
        f"{bound.required_ess:.0f} for a small error; {advice}."
    )
    report(Finding("thin-design", text), level=level)


def same_points(first: Bound, second: Bound) -> bool:
    """Return whether bounds of the same settings and inputs have the same points."""
    if not isinstance(first, ReweightedBound) or not isinstance(second, ReweightedBound):
        return type(first) is type(second)
    return all(map(np.array_equal, first.design.sample.points, second.design.sample.points))


@contextmanager
def designs_restored(bounds: Iterable[ReweightedBound]) -> Iterator[None]:
    """Give designs back that were replaced inside."""
    designs = [(bound, bound.design) for bound in bounds]
    try:
        yield
    finally:
        for bound, design in designs:
            if bound.design is not design:
                bound.design = design


def reweighted_of(bound: Bound) -> ReweightedBound | None:
    """Return a bound whose responses are stored, and else None."""
    return bound if isinstance(bound, ReweightedBound) else None
