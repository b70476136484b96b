"""`Fresh`: new random draws at every evaluation, as in classic ABC."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, field
from typing import Any, ClassVar

import numpy as np
from pytensor.tensor.variable import TensorVariable

from prbayes._validate import Floats, positive_integer
from prbayes.metrics.base import Discrepancy
from prbayes.propagation.base import (
    MAX_LOST,
    Bound,
    Propagation,
    cost_by_evaluation,
    probe,
    refuse_max_lost,
)
from prbayes.propagation.ops import OwnOp
from prbayes.response.budget import RunCost
from prbayes.response.distributions import PopulationSampler
from prbayes.response.inputs import Inputs, batch_shape, broadcast_batch
from prbayes.response.response import Responses


@dataclass(frozen=True)
class Fresh(Propagation):
    """New random draws at every evaluation, as in classic ABC.

    The discrepancy is noisy and has no gradient.

    Parameters
    ----------
    n : int
        Number of draws for each theta.
    random_seed : int
        Seed of the draws. They depend as well on the number of evaluations, on the seed of
        `sample_smc`, and on the hyperparameters: chains in processes of their own draw different
        specimens, and the same ones when they are run again.
    max_lost : float
        Largest share of a population whose response is NaN, at the answer.
    executor, store, version, on_failure, retry_failed, timeout
        As for `Reweighted`.

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
        self.check()
        positive_integer(self.n, "Fresh: n", minimum=1)
        positive_integer(self.random_seed, "Fresh: random_seed", minimum=0)
        refuse_max_lost(self.max_lost, "Fresh")

    @property
    def cost(self) -> RunCost:
        """Runs that this propagation needs: n for each value of the hyperparameters."""
        return cost_by_evaluation(self.n)

    def bind(self, name: str, inputs: Inputs, target: Discrepancy, responses: Responses) -> Bound:
        """Prepare the generator of draws, and try the response."""
        return FreshBound(name, inputs, target, responses, self)


class FreshBound(Bound):
    """New random draws at every evaluation, from seeds, roots and the number of evaluations."""

    random: ClassVar[bool] = True

    def __init__(
        self, name: str, inputs: Inputs, target: Discrepancy, responses: Responses, config: Fresh
    ) -> None:
        super().__init__(name, inputs, target, responses)
        self.n_per_theta = config.n
        self.max_lost = config.max_lost
        self._seed = config.random_seed
        self._stream = 0  # seed of the sampler at work
        self._sampler = PopulationSampler(inputs)
        probe(self, self._sampler, config.random_seed)

    def restart(self, stream: int) -> None:
        """Begin a sampler's own stream of random draws."""
        self._stream = stream
        self.draws = 0

    def _discrepancy(self, params: Sequence[Any]) -> TensorVariable:
        """Return an operation that draws and evaluates."""
        return FreshOp(self)(*params)

    def populations(self, params: Sequence[Any]) -> tuple[Floats, Floats]:
        """Return fresh responses with equal weights."""
        self.draws += 1
        digest = hashlib.blake2b(digest_size=8)  # of the roots, the same in all processes
        for values in params:
            digest.update(np.ascontiguousarray(values, dtype=np.float64).tobytes())
        number = int.from_bytes(digest.digest(), "little")
        rng = np.random.default_rng([self._seed, self._stream, self.draws, number])
        aleatory, epistemic = self._sampler(params, self.n_per_theta, rng)
        responses = self.responses(aleatory, epistemic)
        shape = len(responses), self.n_per_theta
        return responses, np.broadcast_to(1 / self.n_per_theta, shape)

    def draw(self, rng: np.random.Generator, size: int, params: Sequence[Any]) -> Floats:
        """Draw responses of new specimens at one value of the roots."""
        roots = [np.asarray(p)[None] for p in params]
        if not self.valid(roots).all():
            return np.full((size, *self.target.event), np.nan)
        aleatory, epistemic = self._sampler(roots, size, rng)
        return np.asarray(self.responses(aleatory, epistemic)[0])


class FreshOp(OwnOp):
    """Draws a population and returns its discrepancy, () ... -> ()."""

    __props__ = ("bound",)
    __str__ = OwnOp.__str__

    def __init__(self, bound: FreshBound) -> None:
        self.bound = bound
        self.event_ndims = [r.type.ndim for r in bound.inputs.roots]

    def perform(self, node: Any, inputs: Any, outputs: Any) -> None:
        """Draw, call the response, compare."""
        batch = batch_shape(inputs, self.event_ndims)
        full = broadcast_batch(inputs, self.event_ndims, batch)
        params = [values.reshape(-1, *values.shape[len(batch) :]) for values in full]
        discrepancies = self.bound.discrepancies(params, self.bound.target)
        outputs[0][0] = discrepancies.reshape(batch)

    def pullback(self, inputs: Any, outputs: Any, cotangents: Any) -> Any:
        """Refuse by name.

        Not as NotImplementedError, which PyMC takes as leave to use a slice sampler.
        """
        raise TypeError(
            f"{self.bound.name}: prb.Fresh draws new responses at every evaluation, so its "
            "log-density is random and has no gradient: pm.sample, pm.find_MAP and gradient "
            "methods of prb.minimize would be wrong; use propagation=prb.Reweighted() or "
            "prb.Resimulated(), or prb.sample_smc"
        )
