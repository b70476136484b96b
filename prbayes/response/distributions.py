"""What is read off PyMC distributions: log-densities, inverse distribution functions, draws."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import pymc as pm
import pytensor.tensor as pt
from pymc.distributions.multivariate import MvNormal
from pymc.distributions.shape_utils import change_dist_size
from pytensor.graph.basic import Variable
from pytensor.graph.replace import graph_replace, vectorize_graph
from pytensor.graph.traversal import ancestors
from pytensor.graph.utils import MissingInputError
from pytensor.tensor.random.type import RandomGeneratorType
from pytensor.tensor.variable import TensorVariable

from prbayes._checks import Floats
from prbayes.response.compilation import PLAIN, compile_batched
from prbayes.response.inputs import Inputs, event_shape, is_random


def log_density(
    inputs: Inputs, aleatory: Sequence[TensorVariable], values: Sequence[Any]
) -> TensorVariable:
    """Return log p(x), shape (n,), of values x, shapes (n, *event), summed over the aleatory inputs."""
    total: Any = 0.0
    for dist, x, shape in zip(aleatory, values, inputs.event_shapes, strict=True):
        logp = (
            _mvnormal_logp(dist, x, shape[0])
            if is_mvnormal(dist)
            else pm.logp(dist, x, warn_rvs=False)
        )
        total = total + (
            logp.sum(axis=tuple(range(1, logp.type.ndim))) if logp.type.ndim > 1 else logp
        )
    return total


def is_mvnormal(dist: TensorVariable) -> bool:
    """Whether a distribution is a multivariate normal."""
    return isinstance(dist.owner.op, type(MvNormal.rv_op))


def _mvnormal_logp(dist: TensorVariable, x: Any, size: int) -> TensorVariable:
    """Return log p(x) by forward substitution, elementwise; PyMC's own solves once per theta and point in a batch."""
    mean, covariance = dist.owner.op.dist_params(dist.owner)
    root = pt.linalg.cholesky(covariance, on_error="nan")
    z: list[Any] = []
    for i in range(size):
        z.append((x[..., i] - mean[i] - sum(root[i, j] * z[j] for j in range(i))) / root[i, i])
    logp = sum(
        -0.5 * z_i**2 - pt.log(root[i, i]) - 0.5 * np.log(2 * np.pi) for i, z_i in enumerate(z)
    )
    return pt.switch(pt.isnan(logp), -np.inf, logp)


def quantiles(name: str, dist: TensorVariable, u: Any) -> TensorVariable:
    """Return the inverse distribution function of ``dist`` at u, shape (n, *event).

    A multivariate normal takes its mean plus Cholesky factor times standard normal quantiles.

    Raises
    ------
    TypeError
        If the distribution is discrete or has no inverse distribution function in PyMC.
    """
    op = dist.owner.op
    if dist.dtype.startswith(("int", "uint", "bool")):
        raise TypeError(
            f"{name}: {op} is discrete; use propagation=prb.Reweighted() or prb.Fresh()"
        )
    if is_mvnormal(dist):
        mean, covariance = op.dist_params(dist.owner)
        z = pm.icdf(pm.Normal.dist(0.0, 1.0), u)
        return mean + z @ pt.linalg.cholesky(covariance).T
    try:
        return pm.icdf(dist, u, warn_rvs=False)
    except NotImplementedError:
        raise TypeError(
            f"{name}: {op} has no inverse distribution function in PyMC; "
            "use propagation=prb.Reweighted() or prb.Fresh()"
        ) from None


class PriorSampler:
    """Draws of variables from the prior, all in one call of a function that is compiled once."""

    def __init__(self, roots: Sequence[TensorVariable]) -> None:
        self._names = ", ".join(str(r.name) for r in roots)
        n = pt.iscalar("n")
        first = [r for r in roots if not any(a in roots for a in ancestors([r]) if a is not r)]
        self._batched = True
        try:
            outputs = vectorize_graph(
                list(roots), {v: change_dist_size(v, (n,), expand=True) for v in first}
            )
            self._function = pm.compile([n], outputs, mode=PLAIN)
        except (
            NotImplementedError,
            ValueError,
            MissingInputError,
        ):  # not vectorized, or not resized: one at a time
            self._batched = False
            self._function = pm.compile([n], list(roots), mode=PLAIN, on_unused_input="ignore")
        self._generators = [
            v for v in self._function.get_shared() if isinstance(v.type, RandomGeneratorType)
        ]

    def __call__(self, k: int, seed: int) -> list[Floats]:
        """Return k draws of each variable, shapes (k, *shape)."""
        for shared, child in zip(
            self._generators, np.random.default_rng(seed).spawn(len(self._generators)), strict=True
        ):
            shared.set_value(child, borrow=True)
        try:
            if self._batched:
                return [np.asarray(v) for v in self._function(k)]
            values = [self._function(k) for _ in range(k)]
        except NotImplementedError as error:
            raise TypeError(
                f"priors: got {self._names}, of which one cannot be drawn ({error}), expected proper priors; "
                "replace pm.Flat and pm.HalfFlat by a wide pm.Normal or pm.HalfNormal"
            ) from None
        return [np.array(column) for column in zip(*values, strict=True)]


class PriorPoints:
    """Points of the unit cube brought to the prior, each variable given those above it.

    Raises
    ------
    TypeError
        If a variable has no inverse distribution function.
    """

    def __init__(self, variables: Sequence[TensorVariable]) -> None:
        self._shapes = [event_shape(v) for v in variables]
        self.size = sum(int(np.prod(s, dtype=int)) for s in self._shapes)
        symbols = [pt.tensor(dtype="float64", shape=s) for s in self._shapes]
        placed: dict[Variable, Variable] = {}
        for v, u in zip(variables, symbols, strict=True):
            placed[v] = quantiles("priors", graph_replace([v], placed, strict=False)[0], u)
        if any(is_random(v) for v in ancestors(list(placed.values()))):
            raise TypeError(
                "priors: got one that depends on a random variable which is not in the model"
            )
        self._function = compile_batched(symbols, list(placed.values()))

    def __call__(self, cube: Floats) -> list[Floats]:
        """Return values of each variable, shapes (k, *shape), for points of shape (k, size)."""
        edges = np.cumsum([0, *(int(np.prod(s, dtype=int)) for s in self._shapes)])
        parts = [cube[:, a:b] for a, b in pairwise(edges)]
        values = self._function(
            *(p.reshape(len(cube), *s) for p, s in zip(parts, self._shapes, strict=True))
        )
        return [np.asarray(v) for v in values]


def prior_draws(roots: Sequence[TensorVariable], k: int, seed: int) -> list[Floats]:
    """Draw the roots k times from the prior; arrays of shape (k, *shape)."""
    return PriorSampler(roots)(k, seed)


def valid(inputs: Inputs, aleatory: Sequence[TensorVariable]) -> TensorVariable:
    """Return whether the parameters of all aleatory inputs are valid (sigma > 0 and such), a boolean scalar."""
    from pymc.logprob.utils import CheckParameterValue

    logps = (
        [pm.logp(d, pt.zeros_like(d), warn_rvs=False) for d in aleatory]
        if not inputs.nested
        else []
    )
    conditions = [
        pt.all(c)
        for v in ancestors(logps)
        if v.owner is not None and isinstance(v.owner.op, CheckParameterValue)
        for c in v.owner.inputs[1:]
    ]
    return pt.all(conditions) if conditions else pt.constant(True)


class PopulationSampler:
    """Random draws of n specimens from the populations at given roots."""

    def __init__(self, inputs: Inputs) -> None:
        symbols = inputs.placeholders()
        dists, epistemic = inputs.rebuilt(symbols)
        n = pt.iscalar("n")
        batched = [
            pt.tensor(name=s.name, dtype=s.dtype, shape=(None, *s.type.shape)) for s in symbols
        ]
        size = (batched[0].shape[0], n)
        per_specimen: dict[Variable, Variable] = {
            s: pt.broadcast_to(b[:, None], (*size, *(b.shape[i] for i in range(1, b.ndim))))
            for s, b in zip(symbols, batched, strict=True)
        }
        # Distributions without any root above them are not batched by their parameters: resize them.
        for v in ancestors(dists):
            if is_random(v) and not any(
                a in symbols or (a is not v and is_random(a)) for a in ancestors([v])
            ):
                per_specimen[v] = change_dist_size(v, size, expand=True)
        self._batched = True
        try:
            outputs = vectorize_graph(dists, per_specimen)
            common = (
                vectorize_graph(epistemic, dict(zip(symbols, batched, strict=True)))
                if epistemic
                else []
            )
        except (
            NotImplementedError,
            ValueError,
        ):  # what PyTensor does not vectorize: one population at a time
            self._batched, batched = False, symbols
            # Resized before the roots are replaced, since PyMC resizes a CustomDist with its first parameters.
            resized = [change_dist_size(d, (n,), expand=True) for d in inputs.aleatory]
            outputs = graph_replace(
                resized, dict(zip(inputs.roots, symbols, strict=True)), strict=False
            )
            common = epistemic
        self._n_aleatory = len(dists)
        self._epistemic_ndims = [e.type.ndim for e in epistemic]
        self._function = pm.compile(
            [n, *batched],
            [*outputs, *common],
            mode=PLAIN,
            on_unused_input="ignore",
            allow_input_downcast=True,
        )
        self._generators = [
            v for v in self._function.get_shared() if isinstance(v.type, RandomGeneratorType)
        ]

    def __call__(
        self, params: Sequence[Any], n: int, rng: np.random.Generator
    ) -> tuple[list[Floats], list[Floats]]:
        """Return aleatory draws, shapes (k, n, *event), and epistemic values, shapes (k, 1, *event) or (*event)."""
        for shared, child in zip(self._generators, rng.spawn(len(self._generators)), strict=True):
            shared.set_value(child, borrow=True)
        if self._batched:
            values = self._function(n, *params)
        else:
            rows = [self._function(n, *row) for row in zip(*params, strict=True)]
            values = [np.stack(column) for column in zip(*rows, strict=True)]
        common = zip(values[self._n_aleatory :], self._epistemic_ndims, strict=True)
        return values[: self._n_aleatory], [v[:, None] if v.ndim > d else v for v, d in common]
