"""`Resimulated` and `Fresh` at work: responses computed anew for every theta."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
import pytensor.tensor as pt
from pytensor import shared
from pytensor.compile import function
from pytensor.graph.basic import Apply
from pytensor.graph.op import Op
from pytensor.graph.replace import _vectorize_node
from pytensor.tensor.variable import TensorVariable

from prbayes._checks import Floats
from prbayes.inputs import PLAIN, Inputs, PopulationSampler, compile_batched, ninf_for_invalid, quantiles, valid
from prbayes.metrics.base import Discrepancy
from prbayes.metrics.likelihood import LikelihoodDiscrepancy
from prbayes.propagation import Bound, Fresh, Resimulated, base_points, probe
from prbayes.responses import ResponseOp, Responses, symbolic_discrepancy

_log = logging.getLogger("prbayes")

_TAILS = 300  # responses for each observation from which a log-likelihood's standard errors are right to a tenth
_KEPT = 1 << 21  # base points whose transforms may stay in memory


class ResimulatedBound(Bound):
    """Common random numbers: the same base points for every theta."""

    def __init__(
        self, name: str, inputs: Inputs, target: Discrepancy, responses: Responses, config: Resimulated
    ) -> None:
        super().__init__(name, inputs, target, responses)
        self.n_per_theta = config.n
        enough = _TAILS * target.n_effective
        if isinstance(target, LikelihoodDiscrepancy) and config.n < enough:
            _log.warning(
                "%s: the log-likelihood of %d resimulated responses sees too little of the tails: its standard errors "
                "and posterior come out too narrow, expected at least %.0f responses, %d for each observation; use "
                "prb.Reweighted(n), prb.KullbackLeibler() or a larger n",
                name, config.n, enough, _TAILS,
            )  # fmt: skip
        _, points = base_points(inputs, config.n, config.seed, config.points)
        # What depends on constants alone, PyTensor computes once and keeps: fast, unless it is too large to keep.
        self._points: list[Any] = points if config.n <= _KEPT else [shared(u) for u in points]
        for dist, u in zip(inputs.aleatory, self._points, strict=True):
            quantiles(name, dist, u)  # refuses what has no inverse distribution function
        self.symbolic = self._accepts_tensors(*probe(self, PopulationSampler(inputs), config.seed))

    def _accepts_tensors(self, expected: Floats, aleatory: list[Floats], epistemic: list[Floats]) -> bool:
        """Try the response on PyTensor variables, and believe it only if the numbers agree."""
        if not self.responses.plain:
            return False
        symbols = [pt.tensor(dtype="float64", shape=(None,) * v.ndim) for v in (*aleatory, *epistemic)]
        try:
            graph = self.responses.function(*self.inputs.fill(symbols[: len(aleatory)], symbols[len(aleatory) :]))
            if not isinstance(graph, TensorVariable):
                return False
            values = function(symbols, graph, mode=PLAIN, on_unused_input="ignore")(*aleatory, *epistemic)
        except Exception:  # whatever it is: the response is then called with arrays
            return False
        return values.shape == expected.shape and np.allclose(values, expected, rtol=1e-9, equal_nan=True)

    def _response(self, params: Sequence[Any]) -> tuple[TensorVariable, TensorVariable]:
        dists, epistemic = self.inputs.rebuilt(params)
        aleatory = ninf_for_invalid([quantiles(self.name, d, u) for d, u in zip(dists, self._points, strict=True)])
        common = [e[None] for e in epistemic]
        if self.symbolic:
            values = self.responses.function(*self.inputs.fill(aleatory, common))
        else:
            values = ResponseOp(self.responses)(*aleatory, *common)
        return values, valid(self.inputs, dists)

    def _discrepancy(self, params: Sequence[Any]) -> TensorVariable:
        """Return the discrepancy of the responses at the base points, +inf where parameters are invalid."""
        (values, ok), n = self._response(params), self.n_per_theta
        return pt.switch(ok, symbolic_discrepancy(self.target, values, np.full(n, 1 / n)), np.inf)

    @cached_property
    def _values(self) -> Any:
        symbols = self.inputs.placeholders()
        return compile_batched(symbols, [self._response(symbols)[0]])

    def populations(self, params: Sequence[Any]) -> tuple[Floats, Floats]:
        """Return the responses at the base points, with equal weights."""
        (values,) = self._values(*params)
        if self.symbolic:
            self.responses.count += values.size
        return values, np.broadcast_to(1 / self.n_per_theta, values.shape)


class FreshBound(Bound):
    """New random draws at every evaluation.

    Attributes
    ----------
    used : int
        Number of evaluations so far; with the seed it determines the next draws.
    """

    def __init__(self, name: str, inputs: Inputs, target: Discrepancy, responses: Responses, config: Fresh) -> None:
        super().__init__(name, inputs, target, responses)
        self.n_per_theta = config.n
        self._seed = config.seed
        self.used = 0
        self._sampler = PopulationSampler(inputs)
        probe(self, self._sampler, config.seed)

    def _discrepancy(self, params: Sequence[Any]) -> TensorVariable:
        """Return an operation that draws and evaluates."""
        return FreshOp(self)(*params)

    def populations(self, params: Sequence[Any]) -> tuple[Floats, Floats]:
        """Return fresh responses with equal weights."""
        self.used += 1
        rng = np.random.default_rng([self._seed, self.used])
        values = self.responses(*self._sampler(params, self.n_per_theta, rng))
        return values, np.broadcast_to(1 / self.n_per_theta, values.shape)


class FreshOp(Op):
    """Draws a population and returns its discrepancy, () ... -> ()."""

    def __init__(self, bound: FreshBound) -> None:
        self.bound = bound

    def make_node(self, *params: Any) -> Apply[Any, Any]:
        """Apply to the roots' values."""
        tensors = [pt.as_tensor(p) for p in params]
        ndims = [r.type.ndim for r in self.bound.inputs.roots]
        batch = max(t.type.ndim - d for t, d in zip(tensors, ndims, strict=True))
        return Apply(self, tensors, [pt.tensor(dtype="float64", shape=(None,) * batch)])

    def perform(self, node: Any, inputs: Any, outputs: Any) -> None:
        """Draw, call the response, compare."""
        ndims = [r.type.ndim for r in self.bound.inputs.roots]
        batch = np.broadcast_shapes(*(p.shape[: p.ndim - d] for p, d in zip(inputs, ndims, strict=True)))
        params = [
            np.broadcast_to(p, batch + p.shape[p.ndim - d :]).reshape(-1, *p.shape[p.ndim - d :])
            for p, d in zip(inputs, ndims, strict=True)
        ]
        outputs[0][0] = self.bound.discrepancies(params, self.bound.target).reshape(batch)

    def pullback(self, inputs: Any, outputs: Any, cotangents: Any) -> Any:
        """Refuse by name; not as NotImplementedError, which PyMC takes as leave to use a slice sampler."""
        raise TypeError(
            f"{self.bound.name}: prb.Fresh draws new responses at every evaluation, so its log-density is random and "
            "has no gradient: pm.sample, pm.find_MAP and gradient methods of prb.minimize would be wrong; use "
            "propagation=prb.Reweighted() or prb.Resimulated(), or prb.sample_smc"
        )


_vectorize_node.register(FreshOp, lambda op, node, *batched: op.make_node(*batched))
