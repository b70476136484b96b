"""`Reweighted`, and its design.

Stored responses, the mixture density they were drawn from, weights.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import KW_ONLY, dataclass, replace
from functools import cached_property, partial
from typing import Any, ClassVar, Literal, Self

import numpy as np
import pytensor
import pytensor.tensor as pt
from numpy.typing import NDArray
from pytensor.gradient import disconnected_grad
from pytensor.graph.traversal import ancestors
from pytensor.tensor.variable import TensorVariable

from prbayes._finding import Finding, report
from prbayes._validate import IN_CACHE, Floats, positive_integer
from prbayes.emulators.selection import MOST_RUNS
from prbayes.emulators.surfaces import Surface
from prbayes.metrics.base import Basis, Discrepancy
from prbayes.numerics.points import base_points
from prbayes.numerics.threads import one_thread
from prbayes.propagation.base import (
    MAX_LOST,
    N_BLOCKS,
    Bound,
    DesignError,
    Propagation,
    refuse_all_nan,
    refuse_max_lost,
    refuse_nested,
)
from prbayes.propagation.coarse import Coarse
from prbayes.propagation.exponential_families import PointDensity, normalise
from prbayes.propagation.importance import (
    CLOUD,
    LARGEST_CLOUD,
    Cloud,
    Emulation,
    Table,
    mixture_of,
    some_of,
)
from prbayes.propagation.moving_support import (
    averaged_log_density,
    cells_around,
    moving_inputs,
    refuse_moving_atoms,
)
from prbayes.propagation.ops import stored_discrepancy
from prbayes.response.budget import RunCost
from prbayes.response.compile import compile_batched
from prbayes.response.distributions import (
    PopulationSampler,
    log_density,
    prior_draws,
    quantiles,
    refuse_without_density,
)
from prbayes.response.inputs import Inputs
from prbayes.response.outputs import lacking
from prbayes.response.response import (
    Known,
    Responses,
    once_each,
    refuse_coarse,
    refuse_other_number,
)

# Components of a batch's mixture density: as many as there are points would be as good, and cost
# their square.
_COMPONENTS = 512
# Numbers of a basis in a compiled graph, 1 GiB, when the design has grown to its largest. Graphs
# without it are as fast (benchmarks/joint_speed.py), but JAX does not know their operations.
_MOST_NUMBERS = 1 << 27
# Share that an emulator of another response may want to leave to runs that do not have it. By
# judgement: its bias is then as large as what weighted runs would scatter by.
_TRUSTED = 0.5
# Weights of a block of populations, 2 MiB, which a processor keeps at hand, but of no fewer
# populations than these: a product of matrices reads all stored responses for each block. Ratios of
# times for other blocks: benchmarks/blocks.py.
_BLOCK = 1 << 18
_AT_LEAST = 64
# Populations whose weights tell how far an emulator is trusted.
_WEIGHED = 32
# Neighbours on either side in the cells of an input whose support moves, beside other inputs: its
# points then pass an edge some at a time, as their weights differ. On a line the cells meet.
_ABREAST = 8


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
        What says the response between the runs, so that a few dozen or hundred of them are enough
        for several inputs. ``"auto"`` takes the best of a few surfaces for each output, by their
        errors at runs that were left out, mixed with the runs' own weights as far as these errors
        ask for it; not with one input, discrete ones, or an n above 2000, where runs alone are as
        good. Or a surface of ``prb.surrogate``, or any regressor with ``fit(X, y)`` and
        ``predict(X)``. With None the runs stand alone.
    coarse : callable, optional
        A cheap response of the same inputs and outputs that is about the expensive one, such as
        that of a coarser mesh: the emulator then tells what is between the
        two, for each output as far as that makes errors at left-out runs smaller. It is called at
        all runs, and at every one of thousands of points between them, on the same executor; none
        of its calls is counted or stored. Where it raises, or is not finite, the emulator goes on
        without it, and the log says so.
    executor : Executor, optional
        Where the response is computed: threads, processes, loky,
        ``dask.distributed.Client().get_executor()``, ``mpi4py.futures.MPIPoolExecutor()``. In this
        process by default.
    store : path-like, optional
        A folder that keeps every computed response, by simulator: none is computed again, also in
        another run; but one, at the first use of each simulator, to see that the response is still
        the same one: code, or variables of a closure, may have changed, which is refused.
    version : str, optional
        Names the response as it is, such as ``"2"`` or ``"mesh 3"``: runs of different versions are
        kept apart in the store, as are those of other names or another order of several outputs,
        and none is computed again. You then answer for a new name whenever the response changes;
        needed for one that is random, or minutes long.
    on_failure : Abort, Replace or Retry
        What to do with a response that raises, and if asked for with one that is NaN: by default
        that is a result, of a specimen without response.
    retry_failed : bool
        Whether points that the store has as failed are computed again. Under `Abort` they are in
        any case: a failure is no result.
    timeout : float, optional
        Seconds that a response may take before it is one that failed; with executors of processes
        only, Dask's among them, as nothing else ends one that hangs. What hangs outside Python ends
        with its worker, half as long again and a second later; Dask then tries it on other workers.

    References
    ----------
    .. [1] Owen, A. B., Monte Carlo theory, methods and examples, chapter 9 (mixture importance
       sampling).

    Examples
    --------
    >>> Reweighted(256)
    Reweighted(n=256, random_seed=0, max_lost=0.05, max_points=None, emulator='auto', coarse=None)
    """

    n: int = 1024
    _: KW_ONLY
    random_seed: int = 0
    max_lost: float = MAX_LOST
    max_points: int | None = None
    emulator: Any = "auto"
    coarse: Callable[..., Any] | None = None

    def __post_init__(self) -> None:
        self.check()
        positive_integer(self.n, "Reweighted: n", minimum=16)
        positive_integer(self.random_seed, "Reweighted: random_seed", minimum=0)
        refuse_max_lost(self.max_lost, "Reweighted")
        _refuse_emulator(self.emulator)
        _refuse_coarse(self.coarse, self.emulator)
        if (
            self.max_points is not None
            and positive_integer(self.max_points, "Reweighted: max_points") < self.n
        ):
            raise ValueError(
                f"Reweighted: max_points: got {self.max_points}, expected n = {self.n} or more"
            )

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
            each = [str(e.name or e) for e in inputs.epistemic]
            names = ", ".join(each)
            if not any(above in inputs.roots for above in ancestors(inputs.epistemic)):
                raise TypeError(
                    f"{name}: {names} goes into the response as data whose value may change, while "
                    "responses are stored; pass the value itself, such as "
                    f"{each[0]}.get_value(), or use propagation=prb.Resimulated()"
                )
            raise TypeError(
                f"{name}: {names} goes into the response as a model variable (epistemic), so "
                "stored responses cannot be reweighted; use propagation=prb.Resimulated()"
            )
        refuse_nested(name, inputs)
        refuse_without_density(name, inputs)
        if not target.metric.takes_weights:
            raise TypeError(
                f"{name}: a metric that takes no weights cannot be used with prb.Reweighted; "
                "in a FunctionMetric write function(simulated, observed, weights) with "
                "weighted=True, or use propagation=prb.Resimulated()"
            )
        if self.emulator is not None and not isinstance(self.emulator, str):
            self._refuse_emulating(name, inputs)
        if self.coarse is not None:
            self._refuse_following(name, inputs)
            refuse_other_number(f"{name}: coarse", self.coarse, inputs)

    def check_likelihood(self, name: str) -> None:
        """Refuse options that the log-likelihood by specimen, with its own emulator, lacks."""
        for option, default in (("emulator", "auto"), ("coarse", None), ("max_points", None)):
            value = getattr(self, option)
            if value != default:
                raise TypeError(
                    f"{name}: propagation: got Reweighted({option}={value!r}), which "
                    "prb.LogLikelihood() does not use, as it has its own emulator; use "
                    f"metric=prb.ProbabilityResidual(), or leave {option}= out"
                )

    def _refuse_emulating(self, name: str, inputs: Inputs) -> None:
        """Raise if a user's emulator has nothing to do."""
        if has_points_between_runs(inputs):
            return
        kinds = ", ".join(f"{x.dtype}, {x.type.ndim} dimensions" for x in inputs.aleatory)
        raise TypeError(
            f"{name}: emulator: got {type(self.emulator).__name__} for aleatory inputs "
            f"({kinds}), expected several continuous numbers for each specimen; of one number the "
            "runs are a quadrature rule, and discrete ones are computed: leave emulator= out"
        )

    def _refuse_following(self, name: str, inputs: Inputs) -> None:
        """Raise if there is no emulator that could follow a coarse response."""
        if not self.emulates(inputs):
            raise TypeError(
                f"{name}: coarse: got a coarse response for {inputs.dimensions} aleatory "
                f"number(s) and n = {self.n}, expected several continuous numbers for each "
                f"specimen and at most {MOST_RUNS} runs, between which something is emulated: "
                "leave coarse= out"
            )

    def emulates(self, inputs: Inputs) -> bool:
        """Return whether responses between the runs are emulated."""
        if self.emulator is None:
            return False
        # Whoever asks for more than an emulator takes has a response that costs little.
        wanted = not isinstance(self.emulator, str) or self.n <= MOST_RUNS
        return wanted and has_points_between_runs(inputs)

    def bind(self, name: str, inputs: Inputs, target: Discrepancy, responses: Responses) -> Bound:
        """Compute the responses at the first design points."""
        return Design(name, inputs, target, responses, self)


def has_points_between_runs(inputs: Inputs) -> bool:
    """Return whether there are points between runs that need an emulator."""
    continuous = all(x.dtype.startswith("float") for x in inputs.aleatory)
    return continuous and inputs.dimensions > 1


def _refuse_emulator(emulator: Any) -> None:
    """Raise if it is no emulator."""
    if emulator is None or isinstance(emulator, Surface):
        return
    if isinstance(emulator, str):
        if emulator == "auto":
            return
        raise ValueError(
            f'Reweighted: emulator: got {emulator!r}, expected "auto", None, or a surface such as '
            "prb.surrogate.RadialBasis()"
        )
    if not (callable(getattr(emulator, "fit", None)) and hasattr(emulator, "predict")):
        raise TypeError(
            f'Reweighted: emulator: got {type(emulator).__name__}, expected "auto", None, a '
            "surface such as prb.surrogate.RadialBasis(), or a regressor with fit(X, y) and "
            "predict(X)"
        )


def _refuse_coarse(coarse: Any, emulator: Any) -> None:
    """Raise if it is no coarse response, or nothing would follow it."""
    if coarse is None:
        return
    refuse_coarse("Reweighted: coarse", coarse)
    if emulator is None:
        raise ValueError(
            "Reweighted: coarse: got a coarse response and no emulator to follow it, expected "
            'emulator="auto", or a surface, beside it'
        )


@dataclass(frozen=True)
class Batches:
    """The points of a design, batch after batch, and the mixture that they were drawn from."""

    points: tuple[Floats, ...]  # (n, *event): one for each aleatory input
    values: Floats  # (n,) or (n, m): their responses; NaN where there is none
    # (k, *shape): the roots' values of the mixture's components, one array for each root.
    components: tuple[Floats, ...]
    counts: Floats  # (k,): how many points came from each component
    sizes: tuple[int, ...]  # number of points of each batch
    coarse: Floats | None = None  # (n, m): a coarse response at the points

    def followed_by(self, other: Batches) -> Batches:
        """Return these batches with others after them."""
        return Batches(
            points=tuple(map(_end_to_end, self.points, other.points)),
            values=_end_to_end(self.values, other.values),
            components=tuple(map(_end_to_end, self.components, other.components)),
            counts=_end_to_end(self.counts, other.counts),
            sizes=(*self.sizes, *other.sizes),
            coarse=_both(self.coarse, other.coarse),
        )

    def rows(self) -> Iterator[slice]:
        """Yield which points each batch has."""
        ends = np.cumsum([0, *self.sizes]).tolist()
        yield from map(slice, ends[:-1], ends[1:])


@dataclass(frozen=True, eq=False)
class Contents:
    """What is in a design: its runs, and the points that weights are taken of."""

    batches: Batches
    # Populations for which points were drawn: each group has one array for each root, (k, *shape).
    groups: tuple[tuple[Floats, ...], ...]
    table: Table
    cloud: Cloud | None = None
    emulation: Emulation | None = None
    clouds: int = 0  # how many were drawn
    size: int = CLOUD  # of a cloud


@dataclass(frozen=True, eq=False)
class Mark:
    """A design as it was at some time."""

    contents: Contents
    shared: tuple[Any, ...]  # what its compiled graphs read
    runs: tuple[Any, ...]  # what other designs of the response may take from it


class Design(Bound):
    """Design points with their responses, and weights p(x given theta) / g(x) for every theta.

    The points of a batch are stratified over a finite list of roots' values; the list is kept, and
    g is exactly the mixture, over all batches, of the densities at the listed values (balance
    heuristic).
    """

    stored: ClassVar[bool] = True
    has_runs: ClassVar[Literal[True]] = True  # as points, unlike emulated specimens

    def __init__(
        self, name: str, inputs: Any, target: Discrepancy, responses: Responses, config: Reweighted
    ) -> None:
        super().__init__(name, inputs, target, responses)
        self.config = config
        self.max_lost = config.max_lost
        self._contents: Contents | None = None
        self._shared: list[Any] = []
        self._basis: tuple[Any, Any, Any] = (None, None, None)
        # More conditions than a study has, fewer than fill the memory.
        self._others: deque[tuple[Responses, Floats]] = deque(maxlen=32)
        self._density = PointDensity(inputs)
        self._taken_back: Batches | None = None  # all that there were when some were forgotten
        self._moving: tuple[int, ...] | None = None
        self._coarse: Coarse | None = None
        if config.coarse is not None:
            self._coarse = Coarse(config.coarse, responses, config.executor)
        components = prior_draws(inputs.roots, min(config.n, _COMPONENTS), config.random_seed)
        size = self.add(components)
        refuse_all_nan(name, self.values)
        if size < self.required_ess and self.contents.cloud is None:
            self._warn_of_thin_support(size)

    def _warn_of_thin_support(self, size: float) -> None:
        # With more inputs weights become so uneven that something else is better (docs/choose.md).
        level = logging.WARNING
        if self.dimensions <= 4:
            level = logging.INFO  # mended on most ways from here, without the user
            advice = (
                "prb.minimize and prb.sample_smc refine it themselves, "
                "before pm.sample call prb.refine(model)"
            )
        else:
            between = has_points_between_runs(self.inputs)
            leave = "leave out emulator=None, or " if between else ""
            advice = (
                f"{self.dimensions} inputs are many for stored responses alone: {leave}use "
                "propagation=prb.Resimulated(n), which has no design"
            )
        finding = Finding(
            "thin-design",
            f"{self.name}: the design of {self.config.n} runs supports a typical population of the "
            f"prior with a weight effective sample size of {size:.0f}, where "
            f"{self.required_ess:.0f} make its error small; {advice}.",
        )
        report(finding, level=level)

    # -- What the design is --

    @property
    def contents(self) -> Contents:
        """All of it; there is always at least one batch of runs."""
        assert self._contents is not None
        return self._contents

    @property
    def batches(self) -> Batches:
        """The runs so far."""
        return self.contents.batches

    @property
    def values(self) -> Floats:
        """The responses that have weights, (n,) or (n, m): those of runs, or emulated."""
        return self.contents.table.values

    @property
    def n_batches(self) -> int:
        """How often runs were added."""
        return 0 if self._contents is None else len(self._contents.batches.sizes)

    @property
    def n_points(self) -> int:
        """Number of points that have weights."""
        return len(self.values)

    @property
    def n_runs(self) -> int:
        """Number of stored responses."""
        return len(self.batches.values)

    @property
    def n_drawn(self) -> int:
        """How often points were drawn: of runs, and of clouds."""
        return 0 if self._contents is None else self.n_batches + self._contents.clouds

    @property
    def told(self) -> str:
        """How many responses were computed, and what is between them, as a sentence."""
        emulation = self.contents.emulation
        runs = f"{self.name}: {self.n_runs} runs"
        if emulation is None:
            return f"{runs}."
        return (
            f"{runs}, between which {self.n_points} points are emulated: at runs that were left "
            f"out the emulator is off by {emulation.error:.2g} of the response's spread, and "
            f"{emulation.share:.0%} of a population are runs themselves.{self._following}"
        )

    @property
    def _following(self) -> str:
        """How far the emulator follows a coarse response, as a sentence; empty without one."""
        emulation = self.contents.emulation
        if self._coarse is None or emulation is None:
            return ""
        number = emulation.following
        outputs = len(emulation.models)
        if not number:
            return " It does not follow the coarse response, which tells nothing more."
        some = f" in {number} of {outputs} outputs" if number < outputs else ""
        return f" It follows the coarse response{some}."

    @property
    def emulates(self) -> bool:
        """Whether responses between the runs are emulated."""
        return self.config.emulates(self.inputs)

    @property
    def batch_size(self) -> int:
        """How many runs are added at a time, at least."""
        if self.contents.cloud is None:
            return self.config.n
        return max(self.config.n // 4, self.responses.workers)

    @property
    def max_points(self) -> int:
        """The largest number of points that refinement may reach."""
        return self.config.most

    @property
    def known_responses(self) -> Floats:
        """The stored responses."""
        return self.batches.values

    @property
    def first_responses(self) -> Floats:
        """Those of the first batch."""
        return self.batches.values[: self.batches.sizes[0]]

    def aim(self, target: Discrepancy) -> None:
        """Compare with the same data in another way from here on; before anything is compiled."""
        if target is self.target:
            return
        before = len(self._shared) - len(self._basis_of(self.values[:1]).arrays)
        self.target = target
        kept = self._held()[:before]
        self._shared = []
        self._share([*kept, *self._basis_of(self.values).arrays])

    @property
    def known_points(self) -> Sequence[Floats]:
        """Their points."""
        return self.batches.points

    @property
    def required_ess(self) -> float:
        """The weight effective sample size that keeps design error well below sampling error.

        Stratified points of one input integrate with an error that falls like 1/n, of several like
        n^(-3/4); the size follows from asking that error to be a fraction of 1/sqrt(N).
        """
        root = np.sqrt(self.target.n_effective)
        if self.dimensions == 1:
            return float(max(50.0, 6 * root))
        return float(max(100.0, (15 * root) ** (4 / 3)))

    @property
    def is_line(self) -> bool:
        """Whether there is one continuous aleatory input of one dimension."""
        x, *others = self.inputs.aleatory
        continuous = x.dtype.startswith("float")
        scalar = x.type.ndim == 0
        return not others and scalar and continuous

    @property
    def blocks(self) -> NDArray[np.intp]:
        """Which of eight coarser designs each point belongs to, shape (n,).

        Consecutive points of a Sobol sequence, of which each stretch is a net of its own; on a line
        every eighth.
        """
        return self.contents.table.blocks

    def _blocks_of(self, sizes: Sequence[int]) -> NDArray[np.intp]:
        """Return the block of each run, of batches of some sizes."""
        if self.is_line:
            return np.arange(sum(sizes)) % N_BLOCKS
        found = []
        for size in sizes:
            place = np.arange(size) * N_BLOCKS
            found.append(place // size)
        return np.concatenate(found)

    # -- Its specimens, and their responses --

    def points_of(self, inputs: Inputs) -> list[Floats]:
        """Return the points of some of the design's aleatory inputs, shapes (n, *event)."""
        return self._ordered(inputs, self.contents.table.points)

    def _ordered(self, inputs: Inputs, points: Sequence[Floats]) -> list[Floats]:
        """Return points of some of the design's aleatory inputs, in the order of these."""
        own = list(map(id, self.inputs.aleatory))
        wanted = map(id, inputs.aleatory)
        places = map(own.index, wanted)
        return [points[i] for i in places]

    def values_of(self, responses: Responses) -> Floats:
        """Return another response of the design's specimens, (n,) or (n, m).

        None that is known is computed again.

        Raises
        ------
        UntoldError
            If the runs do not tell it between them; inside `alone` they need not.
        """
        if responses.same_as(self.responses):
            return self.values
        return self._tabulated(self._at_runs(responses))

    def _at_runs(self, responses: Responses) -> Floats:
        """Return another response at the runs, (n,) or (n, m)."""
        before = [pair for pair in self._others if responses.same_as(pair[0])]
        known = before[0][1] if before else np.empty(0)
        if len(known) < self.n_runs:
            points = self._ordered(responses.inputs, self.batches.points)
            missing = [p[len(known) :] for p in points]
            more = once_each(responses, missing, Known(points, known))
            known = np.concatenate([known.reshape(-1, *more.shape[1:]), more])
            # Instead of the fewer that were known before.
            if before:
                self._others.remove(before[0])
            self._others.append((responses, known))
        return known

    def _tabulated(self, known: Floats) -> Floats:
        """Return another response of the points that have weights, of that of the runs."""
        contents = self.contents
        if contents.cloud is None or contents.emulation is None:
            return known
        said = self._emulation_of(known).at(contents.cloud)
        return np.concatenate([said, known]) if contents.emulation.share else said

    def emulated(self, responses: Responses, points: Sequence[Floats]) -> list[Floats]:
        """Return a response at any points of the design's inputs, (n,) or (n, m), as emulators say.

        That of all runs first, then those that lack a block of them each; none without emulators.
        """
        emulation = self.contents.emulation
        if emulation is None:
            return []
        coarse = None
        if not responses.same_as(self.responses):
            emulation = self._emulation_of(self._at_runs(responses))
        elif self._coarse is not None and emulation.following:
            coarse = self._coarse(points)
        cloud = Cloud(tuple(points), np.zeros(len(points[0])), coarse)
        return [emulation.at(cloud), *emulation.without_each_block(cloud)]

    def _emulation_of(self, known: Floats) -> Emulation:
        """Return an emulator of another response, of that at the runs.

        Raises
        ------
        UntoldError
            If the runs do not tell it between them.
        """
        contents = self.contents
        assert contents.emulation is not None
        other = Emulation.of(
            self.config.emulator,
            self.batches.points,
            known,
            contents.emulation.weights,
            self._blocks_of(self.batches.sizes),
        )
        # The runs have the share that the design's own response gave them.
        if other is None or other.share > _TRUSTED + contents.emulation.share:
            share = 1.0 if other is None else other.share
            raise UntoldError(
                f"{self.name}: the design is of {self.n_runs} runs, between which its own response "
                "is emulated; another response of the same specimens is not told by the runs: got "
                f"an emulator that would leave {share:.0%} of a population to them, expected at "
                f"most {_TRUSTED:.0%} more than of its own; calibrate with "
                "prb.Reweighted(n, emulator=None), or let one response return both outputs"
            )
        return other

    def same_points(self, other: Bound) -> bool:
        """Return whether another design has the same points, whose responses belong together."""
        if not isinstance(other, Design):
            return False
        pairs = zip(self.contents.table.points, other.contents.table.points, strict=True)
        return all(np.array_equal(a, b) for a, b in pairs)

    # -- Adding points --

    def add(self, components: Sequence[Floats], n: int | None = None) -> float:
        """Compute more responses, at points drawn from the populations of ``components``.

        Parameters
        ----------
        components : sequence of ndarray, shapes (k, *shape)
            Values of the roots.
        n : int, optional
            How many; ``config.n`` by default.

        Returns
        -------
        float
            The median weight effective sample size over these populations.
        """
        self._refuse_other_data()
        n = n or self.config.n
        # A prime, so that seeds 0, 1, 2, ... of a user share no batch.
        seed = self.config.random_seed + 7919 * self.n_batches
        components = self.valid_only(components)
        place = self._equal_mass if self.is_line else self._place
        points, counts = place(components, n, seed)
        points = self._off_the_edges(points, components, counts)
        # Before the runs: what is wrong with it then costs none.
        coarse = None if self._coarse is None else self._coarse(points)
        values = self._responses_at(points)
        batch = Batches(
            points=tuple(points),
            values=values,
            components=tuple(components),
            counts=counts,
            sizes=(n,),
            coarse=coarse,
        )
        before = self._contents
        batches = batch if before is None else before.batches.followed_by(batch)
        if self._moving is None:
            self._moving = moving_inputs(self.name, self.inputs, components, points)
            self.support_moves = bool(self._moving)
        return self._drawn(batches, components, len(counts))

    def reach(self, components: Sequence[Floats], *, on_the_way: bool = False) -> float:
        """Let the cloud reach populations, without a run.

        On the way to others the emulator's surfaces stay as they are: to choose them anew for these
        populations takes most of the time.

        Returns
        -------
        float
            The median weight effective sample size over these populations.
        """
        components = self.valid_only(components)
        emulation = self.contents.emulation if on_the_way else None
        return self._drawn(self.batches, components, emulation=emulation)

    def widen(self, components: Sequence[Floats], *, on_the_way: bool = False) -> bool:
        """Draw a cloud of twice the size for populations; return whether there is room for it."""
        if self.contents.size >= LARGEST_CLOUD:
            return False
        self._contents = replace(self.contents, size=2 * self.contents.size)
        self.reach(components, on_the_way=on_the_way)
        return True

    def _drawn(
        self,
        batches: Batches,
        components: Sequence[Floats],
        fresh: int = 0,
        *,
        emulation: Emulation | None = None,
    ) -> float:
        """Make the table of points anew, of batches and for populations that matter."""
        # The mixture is that of all batches, so its density changes at the old points too.
        log_g, ess = self._log_mixture(batches.components, batches.counts, batches.points)
        table = Table(batches.points, batches.values, log_g, self._blocks_of(batches.sizes))
        before = self._contents
        groups = () if before is None else before.groups
        # The prior, and where it was last.
        groups = (*groups[:1], *groups[1:][-1:], tuple(components))
        contents = Contents(batches, groups, table)
        if before is not None:
            contents = replace(contents, clouds=before.clouds, size=before.size)
        self._contents = contents
        if self.emulates:
            contents = self._emulated(contents, emulation)
        self._contents = contents
        self._share(self._arrays())
        if fresh and contents.cloud is None:
            return float(np.median(ess[-fresh:]))
        return self._median_ess(some_of(components, _WEIGHED))

    def _emulated(self, contents: Contents, known: Emulation | None) -> Contents:
        """Return the same with a cloud whose responses are emulated, where that is better."""
        runs = contents.table
        near = some_of(contents.groups[-1], _WEIGHED)
        weights = self._weights_at(near, runs)
        if known is None:
            emulation = Emulation.of(
                self.config.emulator,
                runs.points,
                runs.values,
                weights,
                runs.blocks,
                contents.batches.coarse,
            )
        else:
            emulation = known.elsewhere(weights)
        if emulation is None:
            return contents
        # Another prime, so that no cloud shares points with a batch.
        seed = self.config.random_seed + 104_729 * (1 + contents.clouds)
        components, shares = mixture_of(contents.groups, contents.size)
        points, counts = self._place(components, contents.size, seed, shares)
        points = self._off_the_edges(points, components, counts)
        log_g, _ = self._log_mixture(components, counts, points, summed=False)
        coarse = None
        if self._coarse is not None and emulation.following:
            coarse = self._coarse(points)
        cloud = Cloud(tuple(points), log_g, coarse)
        table = emulation.joined(cloud, emulation.at(cloud), runs)
        return replace(
            contents,
            table=table,
            cloud=cloud,
            emulation=emulation,
            clouds=contents.clouds + 1,
        )

    @contextmanager
    def part(self, rows: NDArray[np.bool_]) -> Iterator[None]:
        """Take weights of some of the points only, inside."""
        with self._instead(self._part(rows)):
            yield

    def _part(self, rows: NDArray[np.bool_]) -> Contents:
        table = self.contents.table
        some = Table(
            points=tuple(x[rows] for x in table.points),
            values=table.values[rows],
            log_g=table.log_g[rows],
            blocks=table.blocks[rows],
        )
        return replace(self.contents, table=some)

    @contextmanager
    def alone(self) -> Iterator[None]:
        """Take weights of the runs only, inside."""
        batches = self.batches
        log_g, _ = self._log_mixture(
            batches.components, batches.counts, batches.points, summed=False
        )
        table = Table(batches.points, batches.values, log_g, self._blocks_of(batches.sizes))
        with self._instead(replace(self.contents, table=table, cloud=None, emulation=None)):
            yield

    @contextmanager
    def _instead(self, contents: Contents) -> Iterator[None]:
        before = self.contents
        kept = self._held()
        self._contents = contents
        self._share(self._arrays())
        try:
            yield
        finally:
            self._contents = before
            self._share(kept)

    def left_out(self) -> list[Floats]:
        """Return responses as emulators say that lack a block of runs each; none without one."""
        contents = self.contents
        if contents.cloud is None or contents.emulation is None:
            return []
        found = []
        for said in contents.emulation.without_each_block(contents.cloud):
            own = contents.table.values[len(said) :]
            found.append(np.concatenate([said, own]))
        return found

    def _arrays(self) -> list[Any]:
        """Return what compiled graphs read."""
        table = self.contents.table
        return [
            *table.points,
            table.log_g,
            *self._cell_ends(),
            *self._basis_of(table.values).arrays,
        ]

    def _weights_at(self, components: Sequence[Floats], table: Table) -> Floats:
        """Return weights of a table's points in some populations, (T, n): they sum to one."""
        logs = self._density.at(components, table.points)(slice(None))
        logs -= table.log_g
        normalise(logs)
        even = 1 / logs.shape[1]
        return np.where(np.isnan(logs), even, logs)

    def _median_ess(self, components: Sequence[Floats]) -> float:
        weights = self._weights_at(components, self.contents.table)
        return float(np.median(1 / (weights**2).sum(axis=1)))

    def _basis_of(self, values: Floats) -> Basis:
        """Return the basis for compiled graphs; its form stays the same while the design grows."""
        most = max(self.max_points, LARGEST_CLOUD) if self.emulates else self.max_points
        return self.target.basis(values, _MOST_NUMBERS * len(values) / most)

    def _responses_at(self, points: Sequence[Floats]) -> Floats:
        """Return the responses at points: none is computed that this or another design had."""
        before = self._taken_back
        if before is not None:
            for rows in before.rows():
                known = [x[rows] for x in before.points]
                if all(map(np.array_equal, known, points)):
                    self.responses.count_reused(len(points[0]))
                    return before.values[rows]
        runs = self.responses.runs
        shared = runs.at(points)
        if shared is not None:
            self.responses.count_reused(len(shared))
            return shared
        stored = self._contents
        own = None if stored is None else Known(stored.batches.points, stored.batches.values)
        values = once_each(self.responses, points, own)
        runs.stored.append((list(points), values))
        return values

    def _refuse_other_data(self) -> None:
        """Raise if data above the inputs were set anew: old points are of other populations."""
        now = {name: np.array(shared.get_value()) for name, shared in self.inputs.data.items()}
        before = self.__dict__.setdefault("_data", now)
        changed = [name for name in now if not np.array_equal(before[name], now[name])]
        if changed:
            raise DesignError(
                f"{self.name}: got other values of {', '.join(changed)}, which is above the "
                "inputs, than when the design was begun, expected the same ones: the density of "
                "its points is that of the old values, and no points can be added to it; build "
                "the model again with the new ones"
            )

    def _cell_ends(self) -> list[Floats]:
        """Return lower and upper ends of the points' cells, of each input whose support moves."""
        reach = 1 if self.is_line else _ABREAST
        found = []
        for i in self._moving or ():
            cells = cells_around(self.contents.table.points[i], reach)
            found += [cells.lower, cells.upper]
        return found

    def _place(
        self,
        components: Sequence[Floats],
        n: int,
        seed: int,
        shares: Floats | None = None,
    ) -> tuple[list[Floats], Floats]:
        """Return n points, and how often each component of the mixture was used, (k,).

        Components have equal ``shares``, (k,), by default.

        One point comes from each population of a stratified list.
        Scrambled Sobol points go through the inverse distribution functions where they exist.
        """
        k = len(components[0])
        spare, uniforms = base_points(self.inputs.event_shapes, n, seed)
        if shares is None:
            which = (spare * k).astype(int)
        else:
            which = np.searchsorted(np.cumsum(shares), spare, side="right")
        which = np.minimum(which, k - 1)
        at = [c[which] for c in components]
        try:
            points = list(self._quantiles(*at, *uniforms))
        except TypeError:  # a distribution without inverse distribution function
            rng = np.random.default_rng(seed)
            draws, _ = PopulationSampler(self.inputs)(at, 1, rng)
            points = [x[:, 0] for x in draws]
        refuse_moving_atoms(self.name, self.inputs, points, which)
        counts = np.bincount(which, minlength=k).astype(float)
        return points, counts

    def _equal_mass(
        self, components: Sequence[Floats], n: int, seed: int
    ) -> tuple[list[Floats], Floats]:
        """Return n points of one input that cut the whole mixture into parts of equal mass."""
        # 16 draft points for each, whose response is not computed; from 2^18 on they are a grid
        # that is fine enough for any design.
        n_draft = min(16 * n, 1 << 18)
        (draft,), counts = self._place(components, n_draft, seed)
        shift = np.random.default_rng(seed).uniform()
        finite = draft[np.isfinite(draft)]
        grid, repeated = np.unique(finite, return_counts=True)
        levels = (np.arange(n) + shift) / n
        log_g, _ = self._log_mixture(components, counts, [grid], summed=False)
        # Values that have probability themselves, such as the bounds of a censored input, are there
        # more often than two design points stand for, and their density is finite.
        often = repeated > 2 * n_draft / n
        if np.any(often & np.isfinite(log_g)):
            places = (levels * finite.size).astype(int)
            points = np.sort(finite)[places]
        else:
            points = _inverted(levels, grid, np.exp(log_g))
        return [points], counts * (n / counts.sum())

    def _off_the_edges(
        self, points: Sequence[Floats], components: Sequence[Floats], counts: Floats
    ) -> list[Floats]:
        """Return points, moved by a rounding where the density is infinite.

        Quantiles may be rounded to the edge of a support, where densities such as that of
        ``Beta.dist(1, 0.5)`` have no finite value.
        """
        log_g, _ = self._log_mixture(components, counts, points, summed=False)
        infinite = np.isposinf(log_g)
        moved = list(points)
        if infinite.any():
            for i, x in enumerate(moved):
                if x.dtype.kind == "f":
                    inside = np.nextafter(x, np.median(x, axis=0))
                    x = x.copy()
                    x[infinite] = inside[infinite]
                    moved[i] = x
        return moved

    def _log_mixture(
        self,
        components: Sequence[Floats],
        counts: Floats,
        points: Sequence[Floats],
        *,
        summed: bool = True,
    ) -> tuple[Floats, Floats]:
        """Return log density of a mixture at points, (n,), and effective sample sizes, (k,).

        These are, if they are asked for, of the weights of the points in each component; zero where
        the component has no point.
        """
        shares = counts / counts.sum()
        n = len(points[0])
        log_g = np.empty(n)
        sums = np.zeros((2, counts.size))
        log_densities = self._density.at(components, points)
        step = max(1, IN_CACHE // counts.size)
        for start in range(0, n, step):
            chunk = slice(start, start + step)
            densities = log_densities(chunk)
            top = densities.max(axis=0)
            top = np.where(np.isfinite(top), top, 0.0)
            densities -= top
            np.exp(densities, out=densities)
            mixture = shares @ densities
            with np.errstate(divide="ignore", invalid="ignore"):
                log_g[chunk] = np.log(mixture) + top
                if summed:
                    densities /= mixture
                    sums[0] += densities.sum(axis=1)
                    sums[1] += np.vecdot(densities, densities)
        with np.errstate(invalid="ignore"):
            ess = sums[0] ** 2 / sums[1]
        return log_g, np.where(counts > 0, ess, 0.0)

    def copied(self) -> Self:
        """Return a design with the same points, which grows by itself."""
        other = super().copied()
        other._others = deque(self._others, maxlen=self._others.maxlen)
        other._shared = []
        other._share(self._held())
        other._forget_compiled()
        return other

    def coarser(self) -> Self:
        """Return a design with an eighth of the points; it is not to grow."""
        other = super().copied()
        other._contents = self._part(self.blocks == 0)
        other._basis = (None, None, None)
        other._shared = []
        other._share(other._arrays())
        other._forget_compiled()
        return other

    def telling(self, values: Floats, target: Discrepancy) -> Self:
        """Return a design of the same points with another response of theirs, and other data.

        It is not to grow: its runs are those of this design.
        """
        other = super().copied()
        table = replace(self.contents.table, values=values)
        other._contents = replace(self.contents, table=table, cloud=None, emulation=None)
        other.target = target
        other._others = deque(maxlen=self._others.maxlen)
        other._basis = (None, None, None)
        other._shared = []
        other._share(other._arrays())
        other._forget_compiled()
        return other

    @contextmanager
    def undone(self) -> Iterator[None]:
        """Forget, afterwards, the batches that are added inside."""
        before = self.mark()
        try:
            yield
        finally:
            self.go_back(before)

    def mark(self) -> Mark:
        """Return what brings the design back to what it is now."""
        runs = tuple(self.responses.runs.stored)
        return Mark(self.contents, tuple(self._held()), runs)

    def go_back(self, mark: Mark, *, remember: bool = False) -> None:
        """Forget the batches since a mark; their responses may be remembered for the next time."""
        if remember:
            self._taken_back = self.batches
        else:
            self.responses.runs.stored[:] = mark.runs
        self._contents = mark.contents
        kept = [(responses, known[: self.n_runs]) for responses, known in self._others]
        self._others = deque(kept, maxlen=self._others.maxlen)
        self._basis = (None, None, None)
        self._share(mark.shared)

    def _held(self) -> list[Any]:
        """Return the arrays that compiled graphs read, none of which is ever written to."""
        return [shared.get_value(borrow=True) for shared in self._shared]

    def _share(self, arrays: Sequence[Any]) -> None:
        """Hand arrays to the compiled graphs, which read shared variables of any length."""
        if not self._shared:
            for i, array in enumerate(arrays):
                of_any_length = (None,) * array.ndim
                # Some samplers know shared variables by their names.
                name = f"{self.name}_design_{i}"
                held = pytensor.shared(array, name=name, borrow=True, shape=of_any_length)
                self._shared.append(held)
        for shared, array in zip(self._shared, arrays, strict=True):
            shared.set_value(array, borrow=True)

    # -- Weights --

    @cached_property
    def _quantiles(self) -> Any:
        symbols = self.inputs.placeholders()
        shapes = [x.type.shape for x in self.inputs.aleatory]
        uniforms = [pt.tensor(dtype="float64", shape=shape) for shape in shapes]
        dists, _ = self.inputs.rebuilt(symbols)
        placed = []
        for dist, uniform in zip(dists, uniforms, strict=True):
            points = quantiles(self.name, dist, uniform[None])
            placed.append(points[0])
        return compile_batched([*symbols, *uniforms], placed)

    def log_weights(self, params: Sequence[Any]) -> TensorVariable:
        """Return log p(x given theta) - log g(x) at the design points, shape (n,)."""
        k = len(self.inputs.aleatory)
        points = self._shared[:k]
        log_g = self._shared[k]
        dists, _ = self.inputs.rebuilt(params)
        averaged = {}
        for place, i in enumerate(self._moving or ()):
            first = k + 1 + 2 * place
            lower, upper = self._shared[first : first + 2]
            averaged[i] = partial(averaged_log_density, lower=lower, upper=upper)
        log_p = log_density(self.inputs, dists, points, averaged)
        return log_p - log_g

    @cached_property
    def _log_weights(self) -> Any:
        symbols = self.inputs.placeholders()
        return compile_batched(symbols, [self.log_weights(symbols)])

    def _forget_compiled(self) -> None:
        """Compile anew what reads the shared variables: those of a copy are others."""
        self.__dict__.pop("_log_weights", None)

    def _discrepancy(self, params: Sequence[Any]) -> TensorVariable:
        """Return the discrepancy of the reweighted responses, +inf where no point has weight."""
        logs = self.log_weights(params)
        top = pt.max(logs)
        supported = top > -np.inf
        # PyTensor's softmax is compiled with a backend of its own; the largest only guards against
        # overflow.
        centred = logs - disconnected_grad(top)
        raw = pt.exp(pt.switch(supported, centred, 0.0))
        weights = raw / raw.sum()
        before_the_basis = len(self.inputs.aleatory) + 1 + 2 * len(self._moving or ())
        basis = tuple(self._shared[before_the_basis:])
        form = self._basis_of(self.values[:1])
        value = stored_discrepancy(self.target, replace(form, arrays=basis), weights)
        return pt.switch(supported, value, np.inf)

    def populations(self, params: Sequence[Any]) -> tuple[Floats, Floats]:
        """Return the stored responses and their weights at given roots."""
        weights, _ = self._weights(params)
        return np.broadcast_to(self.values, weights.shape + self.values.shape[1:]), weights

    def _weights(self, params: Sequence[Any]) -> tuple[Floats, NDArray[np.bool_]]:
        """Return weights of sum one, (k, n), and which rows have any, (k,): others are NaN."""
        weights = self._log_weight_rows(params)
        log_totals = normalise(weights)
        return weights, np.isfinite(log_totals)

    def _log_weight_rows(self, params: Sequence[Any]) -> Floats:
        """Return log weights at given roots, (k, n)."""
        table = self.contents.table
        if self._moving:
            (logs,) = self._log_weights(*params)
            return np.array(logs)
        logs = self._density.at(params, table.points)(slice(None))
        logs -= table.log_g
        return logs

    def discrepancies(self, params: Sequence[Any], target: Discrepancy) -> Floats:
        """Return the discrepancies of the populations at given roots, shape (k,).

        +inf where none has support.
        """
        wanted = (target, self.contents.table)
        if any(a is not b for a, b in zip(self._basis, wanted, strict=False)):
            self._basis = (*wanted, target.basis(self.values))
        *_, basis = self._basis

        size = len(params[0])
        step = max(_AT_LEAST, _BLOCK // self.n_points)
        found = []
        # Of one population linear algebra has little to do.
        with one_thread() if size > 1 else nullcontext():
            for first in range(0, max(1, size), step):
                weights, supported = self._weights([p[first : first + step] for p in params])
                weights[~supported] = 1 / self.n_points
                features = basis.features(weights)
                each = target.outer(*features, xp=np)
                found.append(np.where(supported, each, np.inf))
        return np.concatenate(found)

    def support(self, params: Sequence[Any]) -> dict[str, Floats]:
        """Say how well the design supports the populations at given roots, shapes (k,).

        Returns
        -------
        dict
            ``weight_ess``, the effective sample size of the weights; ``mean_weight``, the mean raw
            weight (1 in expectation; less when part of the population is out of the design's
            reach); ``lost_mass``, the share of weight on points whose response is NaN;
            ``failed_mass``, that of specimens that failed (+inf) in the rest.
        """
        weights = self._log_weight_rows(params)
        log_totals = normalise(weights)
        failed = lacking(self.values)
        broken = np.isposinf(self.values).reshape(self.n_points, -1).any(axis=1)
        lost = weights @ failed
        with np.errstate(divide="ignore", invalid="ignore"):
            ess = 1 / np.vecdot(weights, weights)
            broken_share = weights @ broken / (weights @ ~failed)
        return {
            "weight_ess": np.nan_to_num(ess),
            "mean_weight": np.exp(log_totals - np.log(self.n_points)),
            "lost_mass": np.nan_to_num(lost, nan=1.0),
            "failed_mass": np.nan_to_num(broken_share),
        }


class UntoldError(DesignError):
    """An emulator does not tell another response of the same specimens."""


def design_of(bound: Bound) -> Design | None:
    """Return a bound as a design if its responses are stored, and else None."""
    return bound if isinstance(bound, Design) else None


def _inverted(levels: Floats, grid: Floats, density: Floats) -> Floats:
    """Return where a distribution function reaches some levels.

    Parameters
    ----------
    levels : ndarray, shape (n,)
    grid : ndarray, shape (m,)
        Points of the distribution, in order and all different.
    density : ndarray, shape (m,)
        At the grid.
    """
    share = (np.arange(grid.size) + 0.5) / grid.size
    both_ends = density[1:] + density[:-1]
    with np.errstate(invalid="ignore", over="ignore"):
        trapezoids = 0.5 * both_ends * np.diff(grid)
        cumulated = np.cumsum(trapezoids)
        mass = np.concatenate([[0.0], cumulated])
        apart = mass / mass[-1] - share
        off = np.abs(apart).max()
    # Trapezoids are finer than the share of points below, but where the density is infinite at an
    # edge, or its peaks lie between points: then the two differ by more than random points would.
    if off < 1 / np.sqrt(grid.size):
        found = np.interp(levels * mass[-1], mass, grid)
    else:
        found = np.interp(levels, share, grid)
    return np.asarray(found)


def _both(first: Floats | None, second: Floats | None) -> Floats | None:
    """Return arrays one after the other, where there are any."""
    return None if first is None or second is None else _end_to_end(first, second)


def _end_to_end(first: Floats, second: Floats) -> Floats:
    return np.concatenate([first, second])
