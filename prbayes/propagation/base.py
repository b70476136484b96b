"""How a population of inputs becomes responses: `Reweighted`, `Resimulated`, `Fresh`.

A propagation is configuration. ``check_simulator`` refuses what it cannot do when the model is
written. At the first use of a simulator ``bind`` makes the moving part, a `Bound`, which gives the
discrepancy as a graph of the hyperparameters and knows how many responses were computed.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from typing import Any, ClassVar, Self

import numpy as np
import pytensor.tensor as pt
from pytensor.graph.replace import graph_replace
from pytensor.tensor.variable import TensorVariable

from prbayes._finding import Findings
from prbayes._validate import Floats, Indices, StrPath, flag, positive_integer, positive_number
from prbayes.metrics.base import Discrepancy
from prbayes.response.budget import RunCost
from prbayes.response.compile import compile_batched
from prbayes.response.distributions import (
    PopulationSampler,
    PriorSampler,
    refuse_lopsided,
    valid,
)
from prbayes.response.executors import refuse_timeout
from prbayes.response.failures import Abort, OnFailure, ResponseError
from prbayes.response.inputs import Inputs
from prbayes.response.outputs import is_missing
from prbayes.response.response import Responses, check_call_settings

# Number of batches of a population's points, whose scatter estimates the Monte Carlo error (batch
# means). Each batch is a design itself. The estimate from 8 batches has a relative standard error
# of about a quarter, 1 / sqrt(2 (8 - 1)).
N_BLOCKS = 8

# Default of the largest share of a population's weight, at an answer, on points without response.
MAX_LOST = 0.05


class DesignError(RuntimeError):
    """A design that cannot support the answer, even after refinement."""


@dataclass(frozen=True, eq=False)
class Missing:
    """Shares of populations without numbers, shapes (k,)."""

    lost: Floats  # share of the weight on points without response (NaN)
    failed: Floats  # share of the remaining weight on specimens that failed (+inf)

    @classmethod
    def of(cls, values: Floats, weights: Floats) -> Missing:
        """Return the shares of responses, (k, n) or (k, n, m), with weights (k, n)."""
        is_lost, has_failed = np.isnan(values), np.isposinf(values)
        if values.ndim > weights.ndim:
            is_lost, has_failed = is_lost.any(axis=-1), has_failed.any(axis=-1)
        lost = np.where(is_lost, weights, 0.0).sum(axis=-1)
        failed = np.where(has_failed, weights, 0.0).sum(axis=-1)
        rest = np.maximum(1 - lost, np.finfo(float).tiny)
        return cls(lost, failed / rest)


def responding_weights(values: Floats, weights: Floats) -> Floats:
    """Return weights (k, n) that are zero at points without response (NaN) and sum to one.

    Metrics compare the population of the specimens that have a response. Otherwise the lost weight
    would count as responses that are infinitely far away, and populations would shrink to avoid it.
    """
    # Stored responses are the same in all populations, without strides: test one row.
    is_lost = np.isnan(values if any(values.strides[:1]) else values[:1])
    if values.ndim > weights.ndim:
        is_lost = is_lost.any(axis=-1)
    if not is_lost.any():
        return weights
    responding = np.where(is_lost, 0.0, weights)
    total = responding.sum(axis=-1, keepdims=True)
    return np.divide(responding, total, out=responding, where=total > 0)


def refuse_lost_share(name: str, share: float, limit: float, remedy: str) -> None:
    """Raise DesignError if a larger share of the population than the limit has no response."""
    if share > limit:
        raise DesignError(
            f"{name}: lost mass: got {share:.1%} of the population without a response (NaN) at the "
            f"answer, expected at most max_lost = {limit:.1%}: the answer would describe only the "
            f"specimens that have one; {remedy}, return +inf for specimens that fail, or pass a "
            "larger max_lost, as in propagation=prb.Reweighted(n, max_lost=...)"
        )


class Bound(ABC):
    """A propagation that is prepared for one simulator.

    Attributes
    ----------
    name : str
    inputs : Inputs
    target : Discrepancy
    responses : Responses
    first_points : sequence of ndarray
        Aleatory inputs, by input, at which responses were computed at the first use.
    first_responses : ndarray, shape (n,) or (n, m)
        The responses there.
    """

    n_per_theta: int = 0  # number of responses that one evaluation of the discrepancy computes
    # Whether responses are part of the PyTensor graph, so that their calls are not counted.
    symbolic: bool = False
    # Whether responses are stored, so that another theta needs no call of the response.
    stored: ClassVar[bool] = False
    # Whether each evaluation draws new specimens, so that there is no gradient.
    random: ClassVar[bool] = False
    # Whether some points are inside the population's support at one theta and outside at another.
    support_moves: bool = False
    # Largest accepted share, at an answer, of a population on points without response.
    max_lost: float = MAX_LOST
    findings: Findings = ()  # findings about the data and the first responses
    # Shares without numbers of the populations in the last evaluation. They are NaN for invalid
    # populations, and for all populations if responses are stored.
    last_missing: Missing = Missing(np.array(np.nan), np.array(np.nan))

    def __init__(
        self, name: str, inputs: Inputs, target: Discrepancy, responses: Responses
    ) -> None:
        self.name = name
        self.inputs = inputs
        self.target = target
        self.responses = responses
        # Seed of the current sampler, and number of evaluations since it started. Both determine
        # the random draws.
        self.stream, self.draws = 0, 0
        self.first_points: Sequence[Floats] = ()
        self.first_responses: Floats = np.empty(0)
        symbols = inputs.placeholders()
        dists, _ = inputs.rebuilt(symbols)
        self._valid = compile_batched(symbols, [valid(inputs, dists)])

    def copied(self) -> Self:
        """Return the same propagation with its own count of responses, for a clone of the model."""
        copied = copy.copy(self)
        copied.responses = self.responses.copied()
        return copied

    @property
    def n_points(self) -> int:
        """Number of points that carry weight in one evaluation of the discrepancy."""
        return self.n_per_theta

    @property
    def n_runs(self) -> int:
        """Number of computed responses that one evaluation of the discrepancy rests on."""
        return self.n_points

    @property
    def blocks(self) -> Indices:
        """Which of eight smaller sets of the same kind each point belongs to, shape (n_points,)."""
        return np.arange(self.n_points) * N_BLOCKS // self.n_points

    def discrepancy(self, params: Sequence[Any]) -> TensorVariable:
        """Return the discrepancy as a scalar graph of the parents' values."""
        # The graph is built with plain symbols, because PyMC may clone random parameters, and would
        # draw the clones instead of using the given values.
        symbols = self.inputs.placeholders()
        values = map(pt.as_tensor, params)
        swap = dict(zip(symbols, values, strict=True))
        (graph,) = graph_replace([self._discrepancy(symbols)], swap, strict=False)
        return graph

    @abstractmethod
    def _discrepancy(self, params: Sequence[Any]) -> TensorVariable:
        """Return the discrepancy as a scalar graph; ``params`` are symbols for the parents."""

    @abstractmethod
    def populations(self, params: Sequence[Any]) -> tuple[Floats, Floats]:
        """Return responses, (k, n) or (k, n, m), and weights, (k, n), at given parents."""

    def discrepancies(self, params: Sequence[Any], target: Discrepancy) -> Floats:
        """Return the discrepancies of populations at given parents, (k,); +inf of invalid ones."""
        size = len(params[0])
        result = np.full(size, np.inf)
        self.last_missing = Missing(np.full(size, np.nan), np.full(size, np.nan))
        ok = self.valid(params)
        if ok.any():
            values, weights = self.populations([p[ok] for p in params])
            missing = Missing.of(values, weights)
            self.last_missing.lost[ok] = missing.lost
            self.last_missing.failed[ok] = missing.failed
            result[ok] = target.of(values, responding_weights(values, weights))
        return result

    def missing(self, params: Sequence[Any]) -> Missing:
        """Return the shares without numbers of one population, known for that evaluated last."""
        last = self.last_missing
        if last.lost.size == 1 and not np.isnan(last.lost).any():
            return last
        if not self.valid(params).all():
            return Missing(np.ones(1), np.zeros(1))
        self.last_missing = Missing.of(*self.populations(params))
        return self.last_missing

    def valid(self, params: Sequence[Any]) -> Any:
        """Return which of a batch of parents give valid distributions (sigma > 0), shape (k,)."""
        (is_valid,) = self._valid(*params)
        return np.broadcast_to(is_valid, len(params[0])).astype(bool)

    def draw(self, rng: np.random.Generator, size: int, params: Sequence[Any]) -> Floats:
        """Draw responses of specimens, (size,) or (size, m), from the points of one population."""
        parents = [np.asarray(p)[None] for p in params]
        no_response = np.full((size, *self.target.event), np.nan)
        if not self.valid(parents).all():
            return no_response
        values, weights = self.populations(parents)
        points = values[0]
        mass = np.where(~is_missing(points), weights[0], 0.0)
        total = mass.sum()
        if not total > 0:
            return no_response
        return rng.choice(points, size=size, p=mass / total)


def discrepancy_error(bound: Bound, params: Sequence[Any]) -> float:
    """Return the standard error of the discrepancy at given parents, shapes (1, ...).

    By the grouped jackknife over eighths of the responses. Right for random draws (`Fresh`), and an
    upper bound for common points, which are better than random ones.
    """
    if bound.n_points < 2 * N_BLOCKS:
        return np.nan
    values, weights = bound.populations(params)
    bound.last_missing = Missing.of(values, weights)
    weights = responding_weights(values, weights)
    without_block = []
    for block in range(N_BLOCKS):
        is_used = bound.blocks != block
        part = weights[:, is_used]
        part = part / part.sum()
        without_block.append(bound.target.of(values[:, is_used], part)[0])
    return float(np.sqrt((N_BLOCKS - 1) * np.var(without_block)))


def valid_parents(bound: Bound, params: Sequence[Floats]) -> list[Floats]:
    """Return the parents that give valid distributions, or raise if none does."""
    refuse_lopsided(bound.name, bound.inputs, params)
    ok = bound.valid(params)
    if not ok.any():
        names = ", ".join(str(r.name) for r in bound.inputs.parents)
        raise ValueError(
            f"{bound.name}: priors: got invalid parameters of the inputs at all {len(ok)} draws "
            f"of {names}, expected valid ones; give scales a prior on positive numbers, "
            "such as pm.HalfNormal"
        )
    return [p[ok] for p in params]


@dataclass(frozen=True, kw_only=True)
class Propagation(ABC):
    """How a population of inputs becomes responses, with options of calling the response.

    Parameters
    ----------
    executor, store, version, on_failure, retry_failed, timeout
        As for `Reweighted`.
    """

    executor: Executor | None = field(default=None, repr=False)
    store: StrPath | None = field(default=None, repr=False)
    version: str | None = field(default=None, repr=False)
    on_failure: OnFailure = field(default=Abort(), repr=False)
    retry_failed: bool = field(default=False, repr=False)
    timeout: float | None = field(default=None, repr=False)
    # Whether each evaluation draws new specimens, so that the discrepancy is random.
    is_random: ClassVar[bool] = False
    # Whether the response itself is called at points where an emulator could predict it.
    calls_response: ClassVar[bool] = False

    @property
    def emulator_runs(self) -> int | None:
        """Number of first runs that the user asks for where a likelihood has its own emulator."""
        return None

    def check_likelihood(self, name: str) -> None:  # noqa: B027
        """Refuse options that the log-likelihood by specimen does not use."""

    @property
    def cost(self) -> RunCost:
        """Runs that this propagation needs."""
        return RunCost(0, 0, None, f"as {type(self).__name__} asks for them")

    def check_simulator(  # noqa: B027 (one of a user's own may take all)
        self, name: str, inputs: Inputs, target: Discrepancy
    ) -> None:
        """Refuse inputs or a metric that this propagation does not take, without a response."""

    @abstractmethod
    def bind(self, name: str, inputs: Inputs, target: Discrepancy, responses: Responses) -> Bound:
        """Return the moving part for one simulator, at its first use; may compute responses."""


def check_arguments(propagation: Any, least: int) -> None:
    """Refuse ``n`` below ``least``, and other arguments that are not as documented."""
    name = type(propagation).__name__
    check_call_settings(
        propagation.executor, propagation.store, propagation.version, propagation.on_failure
    )
    flag(propagation.retry_failed, "retry_failed")
    refuse_timeout(propagation.timeout, propagation.executor)
    positive_integer(propagation.n, f"{name}: n", minimum=least)
    positive_integer(propagation.random_seed, f"{name}: random_seed", minimum=0)
    refuse_max_lost(propagation.max_lost, name)


def refuse_max_lost(max_lost: object, name: str) -> None:
    """Raise if ``max_lost`` is not a number from 0 to below 1."""
    if isinstance(max_lost, bool) or max_lost != 0:
        number = positive_number(max_lost, f"{name}: max_lost")
        if number >= 1:
            raise ValueError(f"{name}: max_lost: got {max_lost}, expected a share below 1")


def refuse_nested(name: str, inputs: Inputs) -> None:
    """Refuse a `.dist()` that depends on another one."""
    if inputs.nested:
        raise TypeError(
            f"{name}: an input is a `.dist()` that depends on another `.dist()`; its density "
            "is not that of independent inputs; use one multivariate distribution"
        )


def cost_by_evaluation(n: int) -> RunCost:
    """Return the runs of a propagation with n runs for each value of the hyperparameters."""
    growth = "each value that the optimiser or sampler asks for; max_runs= and max_seconds= end it"
    return RunCost(16, n, None, growth)  # `probe` calls the response at 16 points


def probe(bound: Bound, sampler: PopulationSampler, seed: int) -> tuple[Any, ...]:
    """Return a trial of the response at points of the prior, (2, 8), and their inputs."""
    # 64 draws, because some may have invalid parameters.
    draws = PriorSampler(bound.inputs.parents)(64, seed)
    two = [draw[:2] for draw in valid_parents(bound, draws)]
    aleatory, epistemic = sampler(two, 8, np.random.default_rng(seed))
    values = bound.responses(aleatory, epistemic)
    refuse_all_nan(bound.name, values)
    bound.first_responses = values.reshape(-1, *bound.target.event)
    shapes = bound.inputs.event_shapes
    bound.first_points = [x.reshape(-1, *s) for x, s in zip(aleatory, shapes, strict=True)]
    return values, aleatory, epistemic


def refuse_all_nan(name: str, values: Floats) -> None:
    """Raise if no response is a number."""
    if np.isnan(values).all():
        raise ResponseError(
            f"{name}: the response is NaN at all {values.size} points drawn from the prior, "
            "expected numbers; "
            "look at the priors and at the response's domain; a specimen that fails is +inf"
        )
