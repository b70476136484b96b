"""`Resimulated` and `Fresh`: responses that are computed for every theta.

`Resimulated` has the same base points each time, `Fresh` new random draws, as in classic ABC.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass, field
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np
import pytensor.tensor as pt
from pytensor import shared
from pytensor.compile import function
from pytensor.tensor.variable import TensorVariable

from prbayes._finding import Finding, report
from prbayes._validate import AT_ONCE, Floats
from prbayes.metrics.base import Discrepancy
from prbayes.numerics.points import base_points, points_from
from prbayes.propagation.base import (
    MAX_LOST,
    Bound,
    Propagation,
    check_arguments,
    cost_by_evaluation,
    probe,
    refuse_nested,
)
from prbayes.propagation.ops import OwnOp, ResponseOp, symbolic_discrepancy
from prbayes.response.budget import RunCost
from prbayes.response.call import refuse_negative_infinity
from prbayes.response.compile import PLAIN, compile_batched, ninf_for_invalid
from prbayes.response.distributions import PopulationSampler, quantiles, valid
from prbayes.response.inputs import Inputs, broadcast_batch
from prbayes.response.response import Responses


@dataclass(frozen=True)
class Resimulated(Propagation):
    """Responses at fixed Sobol points through the inputs' inverse distribution functions.

    Parameters
    ----------
    n : int
        Number of points, best a power of two: n responses are computed for each theta.
    random_seed : int
        Seed of the scrambling.
    points : {"sobol", "monte_carlo"} or callable
        Scrambled Sobol points, random numbers that are the same for each theta, or a function
        ``points(n, dimensions, seed)`` that returns points in the open unit cube, shape (n,
        dimensions).
    max_lost : float
        Largest share of a population whose response is NaN, at the answer.
    executor, store, version, on_failure, retry_failed, timeout
        As for `Reweighted`.

    Raises
    ------
    TypeError, ValueError
        If an option is not as described.

    Examples
    --------
    >>> Resimulated(512)
    Resimulated(n=512, random_seed=0)
    """

    calls_response: ClassVar[bool] = True
    n: int = 1024
    _: KW_ONLY
    random_seed: int = 0
    points: str | Callable[[int, int, int], Floats] = field(default="sobol", repr=False)
    max_lost: float = field(default=MAX_LOST, repr=False)

    def __post_init__(self) -> None:
        check_arguments(self, 2)
        points_from(self.points)

    @property
    def cost(self) -> RunCost:
        """Runs that this propagation needs: n for each value of the hyperparameters."""
        return cost_by_evaluation(self.n)

    def check_simulator(self, name: str, inputs: Inputs, target: Discrepancy) -> None:
        """Refuse inputs without inverse distribution functions; warn of too few responses."""
        refuse_nested(name, inputs)
        per_observation = target.metric.tail_responses
        enough = per_observation * target.n_effective
        if self.n < enough:
            # Stored responses have no inputs that are common to all specimens.
            stored = "" if inputs.epistemic else "prb.Reweighted(n), "
            text = (
                f"{name}: got {self.n} resimulated responses for a log-likelihood, expected at "
                f"least {enough:.0f}, {per_observation} for each observation: the tails are "
                "undersampled, and the standard errors and the posterior are too narrow; use "
                f"{stored}prb.KullbackLeibler() or a larger n."
            )
            report(Finding("few-responses", text, "choose.md#how-many-responses"))
        for dist, u in zip(inputs.aleatory, self.base_points(inputs), strict=True):
            quantiles(name, dist, u)

    def base_points(self, inputs: Inputs) -> list[Floats]:
        """Return points of the unit cube for each aleatory input, shapes (n, *event)."""
        _, points = base_points(
            inputs.event_shapes, self.n, self.random_seed, points_from(self.points)
        )
        return points

    def bind(self, name: str, inputs: Inputs, target: Discrepancy, responses: Responses) -> Bound:
        """Draw the base points, and try the response on PyTensor variables."""
        return ResimulatedBound(name, inputs, target, responses, self)


class ResimulatedBound(Bound):
    """Common random numbers: the same base points for every theta."""

    def __init__(
        self,
        name: str,
        inputs: Inputs,
        target: Discrepancy,
        responses: Responses,
        config: Resimulated,
    ) -> None:
        super().__init__(name, inputs, target, responses)
        self.n_per_theta = config.n
        self.max_lost = config.max_lost
        points = config.base_points(inputs)
        # PyTensor evaluates constant parts of a graph once and stores the results. This is fast for
        # small arrays only, so that large ones are shared variables.
        is_small = config.n <= AT_ONCE
        self._points: list[Any] = points if is_small else [shared(u) for u in points]
        values, aleatory, epistemic = probe(self, PopulationSampler(inputs), config.random_seed)
        self.symbolic = responses.is_batched and self._is_a_graph(values, aleatory, epistemic)

    def copied(self) -> Self:
        """Return the same propagation with its own count, which its compiled function updates."""
        copied = super().copied()
        copied.__dict__.pop("_values", None)
        return copied

    def _is_a_graph(
        self, expected: Floats, aleatory: list[Floats], epistemic: list[Floats]
    ) -> bool:
        """Return whether the response builds a PyTensor graph that has the same numbers."""
        values = [*aleatory, *epistemic]
        symbols = [pt.tensor(dtype="float64", shape=(None,) * v.ndim) for v in values]
        k = len(aleatory)
        arguments = self.inputs.fill(symbols[:k], symbols[k:])
        try:
            graph = self.responses.function(*arguments)
            if not isinstance(graph, TensorVariable):
                return False
            compiled = function(symbols, graph, mode=PLAIN, on_unused_input="ignore")
            result = compiled(*values)
        except Exception:
            # An error of any class means that the response has to be called with arrays.
            return False
        # The graph and the called response differ by rounding at most.
        same_shape = result.shape == expected.shape
        return same_shape and np.allclose(result, expected, rtol=1e-9, equal_nan=True)

    def _response(self, params: Sequence[Any]) -> tuple[TensorVariable, TensorVariable]:
        """Return the graph of responses at the base points, and whether parameters are valid."""
        dists, epistemic = self.inputs.rebuilt(params)
        pairs = zip(dists, self._points, strict=True)
        aleatory = ninf_for_invalid([quantiles(self.name, dist, u) for dist, u in pairs])
        common = [e[None] for e in epistemic]
        parameters_valid = valid(self.inputs, dists)
        if not self.symbolic:
            respond = ResponseOp(self.responses)
            return respond(*aleatory, *common), parameters_valid
        arguments = self.inputs.fill(aleatory, common)
        return self.responses.function(*arguments), parameters_valid

    def _discrepancy(self, params: Sequence[Any]) -> TensorVariable:
        """Return the discrepancy of the responses, +inf where parameters are invalid."""
        values, parameters_valid = self._response(params)
        # Points without response have no weight, as in `responding_weights`.
        is_lost = pt.isnan(values)
        if self.target.event:
            is_lost = is_lost.any(axis=-1)
        weights = np.full(self.n_per_theta, 1 / self.n_per_theta)
        weights = pt.switch(is_lost, 0.0, weights) / (1 - is_lost.mean())
        discrepancy = symbolic_discrepancy(self.target, values, weights)
        return pt.switch(parameters_valid, discrepancy, np.inf)

    @cached_property
    def _values(self) -> Any:
        symbols = self.inputs.placeholders()
        values, _ = self._response(symbols)
        return compile_batched(symbols, [values])

    def populations(self, params: Sequence[Any]) -> tuple[Floats, Floats]:
        """Return the responses at the base points, with equal weights."""
        (values,) = self._values(*params)
        if self.symbolic:
            self.responses.count_symbolic(values.shape[0] * self.n_per_theta)
            refuse_negative_infinity(values)
        return values, np.broadcast_to(1 / self.n_per_theta, values.shape[:2])


@dataclass(frozen=True)
class Fresh(Propagation):
    """New random draws at every evaluation, as in classic ABC.

    The discrepancy is noisy and has no gradient.

    Parameters
    ----------
    n : int
        Number of draws for each theta.
    random_seed : int
        Seed of the draws. They also depend on the number of evaluations, on the seed of
        `sample_smc`, and on the hyperparameters. Chains in other processes draw different
        specimens, and the same ones when they are run again.
    max_lost : float
        Largest share of a population whose response is NaN, at the answer.
    executor, store, version, on_failure, retry_failed, timeout
        As for `Reweighted`.

    Raises
    ------
    TypeError, ValueError
        If an option is not as described.

    Examples
    --------
    >>> Fresh(50)
    Fresh(n=50, random_seed=0)
    """

    is_random: ClassVar[bool] = True
    n: int = 1024
    _: KW_ONLY
    random_seed: int = 0
    max_lost: float = field(default=MAX_LOST, repr=False)

    def __post_init__(self) -> None:
        check_arguments(self, 1)

    @property
    def cost(self) -> RunCost:
        """Runs that this propagation needs: n for each value of the hyperparameters."""
        return cost_by_evaluation(self.n)

    def bind(self, name: str, inputs: Inputs, target: Discrepancy, responses: Responses) -> Bound:
        """Prepare the generator of draws, and try the response."""
        return FreshBound(name, inputs, target, responses, self)


class FreshBound(Bound):
    """New random draws at every evaluation, from seeds, parents and the number of evaluations."""

    random: ClassVar[bool] = True

    def __init__(
        self, name: str, inputs: Inputs, target: Discrepancy, responses: Responses, config: Fresh
    ) -> None:
        super().__init__(name, inputs, target, responses)
        self.n_per_theta = config.n
        self.max_lost = config.max_lost
        self._seed = config.random_seed
        self._sampler = PopulationSampler(inputs)
        probe(self, self._sampler, config.random_seed)

    def _discrepancy(self, params: Sequence[Any]) -> TensorVariable:
        """Return the operation that draws specimens and evaluates their discrepancy."""
        return FreshOp(self)(*params)

    def populations(self, params: Sequence[Any]) -> tuple[Floats, Floats]:
        """Return fresh responses with equal weights."""
        self.draws += 1
        # Hash of the parents' values, which is the same in all processes.
        digest = hashlib.blake2b(digest_size=8)
        for values in params:
            digest.update(np.ascontiguousarray(values, dtype=np.float64).tobytes())
        number = int.from_bytes(digest.digest(), "little")
        rng = np.random.default_rng([self._seed, self.stream, self.draws, number])
        aleatory, epistemic = self._sampler(params, self.n_per_theta, rng)
        responses = self.responses(aleatory, epistemic)
        shape = len(responses), self.n_per_theta
        return responses, np.broadcast_to(1 / self.n_per_theta, shape)

    def draw(self, rng: np.random.Generator, size: int, params: Sequence[Any]) -> Floats:
        """Draw responses of new specimens at one value of the parents."""
        parents = [np.asarray(p)[None] for p in params]
        if not self.valid(parents).all():
            return np.full((size, *self.target.event), np.nan)
        aleatory, epistemic = self._sampler(parents, size, rng)
        return np.asarray(self.responses(aleatory, epistemic)[0])


class FreshOp(OwnOp):
    """Draws a population and returns its discrepancy, () ... -> ()."""

    __props__ = ("bound",)

    def __init__(self, bound: FreshBound) -> None:
        self.bound = bound
        self.event_ndims = [r.type.ndim for r in bound.inputs.parents]

    def perform(self, node: Any, inputs: Any, outputs: Any) -> None:
        """Draw, call the response, compare."""
        batch, full = broadcast_batch(inputs, self.event_ndims)
        params = [values.reshape(-1, *values.shape[len(batch) :]) for values in full]
        discrepancies = self.bound.discrepancies(params, self.bound.target)
        outputs[0][0] = discrepancies.reshape(batch)

    def pullback(self, inputs: Any, outputs: Any, cotangents: Any) -> Any:
        """Refuse; PyMC takes a NotImplementedError as leave to use a slice sampler."""
        raise TypeError(
            f"{self.bound.name}: prb.Fresh draws new responses at every evaluation, so its "
            "log-density is random and has no gradient: pm.sample, pm.find_MAP and gradient "
            "methods of prb.minimize would be wrong; use propagation=prb.Reweighted() or "
            "prb.Resimulated(), or prb.sample_smc"
        )
