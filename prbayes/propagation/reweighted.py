"""`Reweighted`, and its design: stored responses, the mixture density they were drawn from, weights."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np
import pytensor
import pytensor.tensor as pt
from numpy.typing import NDArray
from pytensor.gradient import disconnected_grad
from pytensor.tensor.variable import TensorVariable

from prbayes._checks import Floats, positive_integer, positive_number
from prbayes.metrics.base import Discrepancy
from prbayes.propagation.base import N_BLOCKS, Bound, Propagation, refuse_all_nan, refuse_nested
from prbayes.propagation.ops import OpaqueOp
from prbayes.propagation.points import base_points
from prbayes.response.compilation import compile_batched
from prbayes.response.distributions import PopulationSampler, log_density, prior_draws, quantiles
from prbayes.response.inputs import Inputs
from prbayes.response.response import Responses

_log = logging.getLogger("prbayes")


@dataclass(frozen=True)
class Reweighted(Propagation):
    """Simulate once: stored responses at design points get weights p(x given theta) / g(x) for each theta.

    Parameters
    ----------
    n : int
        Number of design points, drawn from the inputs' prior predictive distribution; the response is
        computed n times, once. `refine` adds batches where they are needed.
    random_seed : int
        Seed of the design.
    max_lost : float
        Largest share of a population's weight that may fall on points whose response is NaN.
    max_points : int, optional
        Largest number of design points, refinement included; 32 n by default.
    executor : Executor, optional
        Where the response is computed: threads, processes, loky, ``dask.distributed.Client().get_executor()``,
        ``mpi4py.futures.MPIPoolExecutor()``. In this process by default.
    store : path-like, optional
        A folder that keeps every computed response, by simulator: none is computed again, also in another run.
    on_failure : Abort, Replace or Retry
        What to do with a response that raises or is NaN.

    References
    ----------
    .. [1] Owen, A. B., Monte Carlo theory, methods and examples, chapter 9 (mixture importance sampling).

    Examples
    --------
    >>> Reweighted(256)
    Reweighted(n=256, random_seed=0, max_lost=0.05, max_points=None)
    """

    n: int = 1024
    random_seed: int = 0
    max_lost: float = 0.05
    max_points: int | None = None

    def __post_init__(self) -> None:
        self.check()
        positive_integer(self.n, "Reweighted: n", minimum=16)
        positive_integer(self.random_seed, "Reweighted: random_seed", minimum=0)
        if self.max_lost != 0 and positive_number(self.max_lost, "Reweighted: max_lost") >= 1:
            raise ValueError(f"Reweighted: max_lost: got {self.max_lost}, expected a share below 1")
        if self.max_points is not None and positive_integer(self.max_points, "Reweighted: max_points") < self.n:
            raise ValueError(f"Reweighted: max_points: got {self.max_points}, expected n = {self.n} or more")

    def bind(self, name: str, inputs: Inputs, target: Discrepancy, responses: Responses) -> Bound:
        """Compute the responses at the first design points."""
        from prbayes.propagation.reweighted import Design

        if inputs.epistemic:
            raise TypeError(
                f"{name}: {', '.join(str(e.name or e) for e in inputs.epistemic)} goes into the response as a model "
                "variable (epistemic), so stored responses cannot be reweighted; use propagation=prb.Resimulated()"
            )
        refuse_nested(name, inputs)
        if not target.metric.takes_weights:
            raise TypeError(
                f"{name}: a metric that takes no weights cannot be used with prb.Reweighted; in a FunctionMetric write "
                "function(simulated, observed, weights) with weighted=True, or use propagation=prb.Resimulated()"
            )
        return Design(name, inputs, target, responses, self)


_MAX_THETAS = 512  # components of a batch's mixture density
_DRAFT = 16  # draft points, whose response is not computed, for each point of a one-dimensional design
_MOST_DRAFT = 1 << 18  # from which on they are a fine grid

_CHUNK = 1 << 22  # thetas times points at a time: bounds memory
_OTHERS = 32  # responses under other conditions that are kept
_MANY = 4  # inputs beyond which reweighting is seldom worth its while
_REFINED = "prb.minimize and prb.sample_smc refine it themselves, before pm.sample call prb.refine(model)"
_TOO_MANY = "{} inputs are many for stored responses: rather use propagation=prb.Resimulated(n), which has no design"


class Design(Bound):
    """Design points with their responses, and weights p(x given theta) / g(x) for every theta.

    The points of a batch are stratified over a finite list of roots' values; the list is kept, and g is
    exactly the mixture, over all batches, of the densities at the listed values (balance heuristic).
    """

    stored: ClassVar[bool] = True

    def __init__(self, name: str, inputs: Any, target: Discrepancy, responses: Responses, config: Reweighted) -> None:
        super().__init__(name, inputs, target, responses)
        self.config = config
        self._sizes: list[int] = []
        self._thetas: list[Floats] = []
        self._counts = np.empty(0)
        self._points: list[Floats] = []
        self.values = np.empty(0)
        self._shared: list[Any] = []
        self._basis: tuple[Any, int, Any] = (None, 0, None)
        self._others: deque[tuple[Responses, Floats]] = deque(maxlen=_OTHERS)
        thetas = prior_draws(inputs.roots, min(config.n, _MAX_THETAS), config.random_seed)
        size = self.add(thetas)
        refuse_all_nan(name, self.values)
        if size < self.required_ess:
            _log.warning(
                "%s: the design of %d responses supports a typical population of the prior with a weight effective "
                "sample size of %.0f, expected %.0f; %s",
                name,
                config.n,
                size,
                self.required_ess,
                _REFINED if self._dimensions <= _MANY else _TOO_MANY.format(self._dimensions),
            )

    @property
    def known_responses(self) -> Floats:
        """The stored responses."""
        return self.values

    @property
    def _dimensions(self) -> int:
        """Number of aleatory numbers that make one specimen."""
        return sum(int(np.prod(shape, dtype=int)) for shape in self.inputs.event_shapes)

    @property
    def required_ess(self) -> float:
        """The weight effective sample size that keeps design error well below sampling error.

        Stratified points of one input integrate with an error that falls like 1/n, of several like n^(-3/4);
        the size follows from asking that error to be a fraction of 1/sqrt(N).
        """
        root = np.sqrt(self.target.n_effective)
        return float(max(50.0, 6 * root) if self._dimensions == 1 else max(100.0, (15 * root) ** (4 / 3)))

    @property
    def batches(self) -> int:
        """How often points were added."""
        return len(self._sizes)

    @property
    def max_points(self) -> int:
        """The largest number of points that refinement may reach."""
        return self.config.max_points or 32 * self.config.n

    @property
    def n_points(self) -> int:
        """Number of stored responses."""
        return self.values.size

    @property
    def blocks(self) -> NDArray[np.intp]:
        """Which of eight coarser designs each point belongs to, shape (n,).

        Consecutive points of a Sobol sequence, of which each stretch is a net of its own; on a line every eighth.
        """
        if self.is_line:
            return np.arange(self.n_points) % N_BLOCKS
        return np.concatenate([np.arange(n) * N_BLOCKS // n for n in self._sizes])

    def points_of(self, inputs: Inputs) -> list[Floats]:
        """Return the points of some of the design's aleatory inputs, shapes (n, *event)."""
        points = dict(zip(map(id, self.inputs.aleatory), self._points, strict=True))
        return [points[id(x)] for x in inputs.aleatory]

    def values_of(self, responses: Responses) -> Floats:
        """Return another response of the design's specimens, shape (n,); none that is known is computed again."""
        if responses.same_as(self.responses):
            return self.values
        known = next((v for r, v in self._others if responses.same_as(r)), np.empty(0))
        if known.size < self.n_points:
            known = np.concatenate([known, responses([p[known.size :] for p in self.points_of(responses.inputs)], [])])
            self._others.append((responses, known))
        return known

    def same_points(self, other: Bound) -> bool:
        """Return whether another design has the same points, so that their responses belong together."""
        return isinstance(other, Design) and all(
            np.array_equal(a, b) for a, b in zip(self._points, other._points, strict=True)
        )

    def add(self, thetas: Sequence[Floats], n: int | None = None) -> float:
        """Compute more responses, at points drawn from the populations of ``thetas``, shapes (k, *shape).

        Parameters
        ----------
        thetas : sequence of ndarray
        n : int, optional
            How many; ``config.n`` by default.

        Returns
        -------
        float
            The median weight effective sample size over these populations.
        """
        n, seed = n or self.config.n, self.config.random_seed + 7919 * self.batches
        thetas = self.valid_only(thetas)
        if self.is_line:
            points, counts = self._equal_mass(thetas, n, seed)
        else:
            points, counts = self._place(thetas, n, seed)
        values = self.responses(points, [])
        if self.batches:
            points = [np.concatenate(pair) for pair in zip(self._points, points, strict=True)]
            values = np.concatenate([self.values, values])
            thetas = [np.concatenate(pair) for pair in zip(self._thetas, thetas, strict=True)]
        k = len(counts)
        self._points, self.values, self._thetas = points, values, list(thetas)
        self._counts = np.concatenate([self._counts, counts])
        self._sizes.append(n)
        log_g, sums = self._log_mixture(self._thetas, self._counts, points)
        self._store([*points, log_g, *self.target.basis(values)])
        return float(np.median(np.exp(2 * sums[0] - sums[1])[-k:]))

    def _log_mixture(
        self, thetas: Sequence[Floats], counts: Floats, points: Sequence[Floats], *, summed: bool = True
    ) -> tuple[Floats, Floats]:
        """Return the log density of a mixture at points, (n,), and log sums of its components' weights, (2, k).

        The sums over the points, if they are asked for, are of the weights, component over mixture, and of their
        squares.
        """
        used = counts > 0
        share = np.log(counts[used, None] / counts.sum())
        log_g = np.empty(len(points[0]))
        sums = np.full((2, counts.size), -np.inf)
        step = max(1, _CHUNK // counts.size)
        for i in range(0, log_g.size, step):
            (logs,) = self._log_density(*thetas, *(p[i : i + step] for p in points))
            log_g[i : i + step] = _log_sum(logs[used] + share, axis=0)
            if summed:
                weights = logs - log_g[i : i + step]
                sums = np.logaddexp(sums, [_log_sum(power * weights, axis=1) for power in (1, 2)])
        return log_g, sums

    def copied(self) -> Self:
        """Return a design with the same points, which grows by itself."""
        other = super().copied()
        other._sizes, other._thetas, other._points = list(self._sizes), list(self._thetas), list(self._points)
        other._others = deque(self._others, maxlen=_OTHERS)
        other._shared = []
        other._store([shared.get_value() for shared in self._shared])
        other.__dict__.pop("_log_weights", None)  # compiled on the shared variables of this one
        return other

    @contextmanager
    def undone(self) -> Iterator[None]:
        """Forget, afterwards, the batches that are added inside."""
        kept = (self._points, self.values, self._thetas, self._counts, list(self._sizes))
        shared = [s.get_value() for s in self._shared]
        try:
            yield
        finally:
            self._points, self.values, self._thetas, self._counts, self._sizes = kept
            self._basis = (None, 0, None)
            self._store(shared)

    def _store(self, arrays: Sequence[Any]) -> None:
        if not self._shared:
            self._shared = [pytensor.shared(a, shape=(None,) * a.ndim) for a in arrays]
        for shared, array in zip(self._shared, arrays, strict=True):
            shared.set_value(array)

    @cached_property
    def _log_density(self) -> Any:
        symbols = self.inputs.placeholders()
        points = [pt.tensor(dtype=x.dtype, shape=(None,) * (x.type.ndim + 1)) for x in self.inputs.aleatory]
        graph = log_density(self.inputs, self.inputs.rebuilt(symbols)[0], points)
        return compile_batched(symbols, [graph], points)

    @cached_property
    def _quantiles(self) -> Any:
        symbols = self.inputs.placeholders()
        uniforms = [pt.tensor(dtype="float64", shape=x.type.shape) for x in self.inputs.aleatory]
        dists = self.inputs.rebuilt(symbols)[0]
        placed = [quantiles(self.name, d, u[None])[0] for d, u in zip(dists, uniforms, strict=True)]
        return compile_batched([*symbols, *uniforms], placed)

    @property
    def is_line(self) -> bool:
        """Whether there is one continuous aleatory input of one dimension."""
        x = self.inputs.aleatory[0]
        return len(self.inputs.aleatory) == 1 and x.type.ndim == 0 and x.dtype.startswith("float")

    def _place(self, thetas: Sequence[Floats], n: int, seed: int) -> tuple[list[Floats], Floats]:
        """Return n points, one from each population of a stratified list, and how often each theta was used.

        Scrambled Sobol points go through the inverse distribution functions where they exist.
        """
        k = len(thetas[0])
        spare, uniforms = base_points(self.inputs, n, seed)
        which = np.minimum((spare * k).astype(int), k - 1)
        at = [t[which] for t in thetas]
        try:
            points = list(self._quantiles(*at, *uniforms))
        except TypeError:  # a distribution without inverse distribution function
            draws, _ = PopulationSampler(self.inputs)(at, 1, np.random.default_rng(seed))
            points = [x[:, 0] for x in draws]
        return points, np.bincount(which, minlength=k).astype(float)

    def _equal_mass(self, thetas: Sequence[Floats], n: int, seed: int) -> tuple[list[Floats], Floats]:
        """Return n points of one input that cut the mixture over all thetas into parts of equal mass."""
        (draft,), counts = self._place(thetas, min(_DRAFT * n, _MOST_DRAFT), seed)
        grid = np.unique(draft[np.isfinite(draft)])
        density = np.exp(self._log_mixture(thetas, counts, [grid], summed=False)[0])
        mass = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]) * np.diff(grid))])
        levels = (np.arange(n) + np.random.default_rng(seed).uniform()) / n
        return [np.interp(levels * mass[-1], mass, grid)], counts * (n / counts.sum())

    def log_weights(self, params: Sequence[Any]) -> TensorVariable:
        """Return log p(x given theta) - log g(x) at the design points, shape (n,)."""
        k = len(self.inputs.aleatory)
        logp = log_density(self.inputs, self.inputs.rebuilt(params)[0], self._shared[:k])
        return logp - self._shared[k]

    def _discrepancy(self, params: Sequence[Any]) -> TensorVariable:
        """Return the discrepancy of the reweighted responses, +inf where no point has weight."""
        logs = self.log_weights(params)
        top = pt.max(logs)
        supported = top > -np.inf
        # PyTensor's softmax is compiled with a backend of its own; the largest only guards against overflow.
        raw = pt.exp(pt.switch(supported, logs - disconnected_grad(top), 0.0))
        weights = raw / raw.sum()
        basis = tuple(self._shared[len(self.inputs.aleatory) + 1 :])
        if not self.target.symbolic:
            d = OpaqueOp(self.target)(*basis, weights)
        else:
            d = self.target.outer(*self.target.from_basis(weights, basis, pt), xp=pt)
        return pt.switch(supported, d, np.inf)

    @cached_property
    def _log_weights(self) -> Any:
        symbols = self.inputs.placeholders()
        return compile_batched(symbols, [self.log_weights(symbols)])

    def populations(self, params: Sequence[Any]) -> tuple[Floats, Floats]:
        """Return the stored responses and their weights at given roots."""
        (logs,) = self._log_weights(*params)
        top = logs.max(axis=-1, keepdims=True)
        weights = np.exp(logs - np.where(np.isfinite(top), top, 0.0))
        total = weights.sum(axis=-1, keepdims=True)
        with np.errstate(invalid="ignore"):
            weights = weights / total
        return np.broadcast_to(self.values, weights.shape), weights

    def discrepancies(self, params: Sequence[Any], target: Discrepancy) -> Floats:
        """Return the discrepancies of the populations at given roots, shape (k,); +inf where none has support."""
        if self._basis[:2] != (target, self.n_points):
            self._basis = (target, self.n_points, target.basis(self.values))
        _, weights = self.populations(params)
        supported = np.isfinite(weights).all(axis=-1)
        weights = np.where(supported[:, None], weights, 1 / self.n_points)
        return np.where(supported, target.outer(*target.from_basis(weights, self._basis[2], np), xp=np), np.inf)

    def support(self, params: Sequence[Any]) -> dict[str, Floats]:
        """Say how well the design supports the populations at given roots, shapes (k,).

        Returns
        -------
        dict
            ``weight_ess``, the effective sample size of the weights; ``mean_weight``, the mean raw weight
            (1 in expectation; less when part of the population is out of the design's reach);
            ``lost_mass``, the share of weight on points whose response is NaN.
        """
        (logs,) = self._log_weights(*params)
        total = _log_sum(logs, axis=-1)
        with np.errstate(invalid="ignore"):
            ess = np.exp(2 * total - _log_sum(2 * logs, axis=-1))
            lost = np.exp(_log_sum(logs[..., np.isnan(self.values)], axis=-1) - total)
        return {
            "weight_ess": np.nan_to_num(ess),
            "mean_weight": np.exp(total - np.log(self.values.size)),
            "lost_mass": np.nan_to_num(lost, nan=1.0),
        }


def design_of(bound: Bound) -> Design | None:
    """Return a bound as a design if its responses are stored, and else None."""
    return bound if isinstance(bound, Design) else None


def _log_sum(logs: Floats, axis: int) -> Floats:
    """Return log(sum(exp(logs))), -inf where there is nothing: NumPy's logaddexp.reduce takes several times as long."""
    top = logs.max(axis=axis, keepdims=True, initial=-np.inf)
    top = np.where(np.isfinite(top), top, 0.0)
    with np.errstate(divide="ignore"):
        return np.asarray(np.log(np.exp(logs - top).sum(axis=axis)) + top.squeeze(axis))
