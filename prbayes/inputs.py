"""The inputs of a response: aleatory (a ``.dist()``), epistemic (a model variable) or constant.

Everything that is read off a PyMC distribution stands here: which model variables are above it (its
*roots*), its log-density, its inverse distribution function, its draws.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
import pymc as pm
import pytensor
import pytensor.tensor as pt
from pymc.distributions.multivariate import MvNormal
from pymc.distributions.shape_utils import change_dist_size
from pytensor.compile.mode import Mode
from pytensor.graph.basic import Variable
from pytensor.graph.replace import graph_replace, vectorize_graph
from pytensor.graph.traversal import ancestors, walk
from pytensor.graph.utils import MissingInputError
from pytensor.tensor.random.op import RandomVariable
from pytensor.tensor.random.type import RandomGeneratorType
from pytensor.tensor.variable import TensorVariable

from prbayes._checks import Floats, real_array

# Batched NumPy calls: nothing here runs often enough to repay a heavy compilation. Without fusion every
# elementwise operation is one NumPy ufunc; with it, the Python linker would loop over scalars.
PLAIN = Mode(linker="py", optimizer="fast_run").excluding(
    "fusion", "inplace", "BlasOpt", "c_blas", "symbolic_op_recognition"
)


@dataclass(frozen=True, eq=False)
class Inputs:
    """The inputs of one response, in the order of its arguments.

    Attributes
    ----------
    arguments : tuple
        One entry per argument: an int (position in ``aleatory``), a variable (epistemic), or an array.
    aleatory : tuple of random variables
        The distinct ``.dist()`` objects.
    roots : tuple of variables
        The model's random variables above the aleatory and epistemic inputs.
    nested : bool
        Whether a ``.dist()`` depends on another one.
    """

    arguments: tuple[Any, ...]
    aleatory: tuple[TensorVariable, ...]
    roots: tuple[TensorVariable, ...]
    nested: bool

    @property
    def epistemic(self) -> tuple[TensorVariable, ...]:
        """The arguments that are model variables, or functions of them."""
        return tuple(a for a in self.arguments if isinstance(a, Variable))

    def rebuilt(self, params: Sequence[Any]) -> tuple[list[TensorVariable], list[TensorVariable]]:
        """Return the aleatory and epistemic inputs with the roots replaced by ``params``."""
        # In two steps, because params may themselves depend on the roots.
        symbols = self.placeholders()
        new: Any = [*self.aleatory, *self.epistemic]
        for old, to in ((self.roots, symbols), (symbols, params)):
            swap = {a: pt.as_tensor(b) for a, b in zip(old, to, strict=True)}
            new = graph_replace(new, swap, strict=False)
        return new[: len(self.aleatory)], new[len(self.aleatory) :]

    def fill(self, aleatory: Sequence[Any], epistemic: Sequence[Any]) -> list[Any]:
        """Return the response's arguments from values for the aleatory and the epistemic inputs."""
        rest = iter(epistemic)
        return [
            next(rest) if isinstance(a, Variable) else aleatory[a] if isinstance(a, int) else a for a in self.arguments
        ]

    @cached_property
    def event_shapes(self) -> tuple[tuple[int, ...], ...]:
        """Event shape of each aleatory input, evaluated where it is not static."""
        return tuple(event_shape(x) for x in self.aleatory)

    @property
    def event_ndims(self) -> tuple[int, ...]:
        """Number of event axes of each aleatory input."""
        return tuple(x.type.ndim for x in self.aleatory)

    def core(self, params: Sequence[Any]) -> list[Any]:
        """Drop the leading axes of length one that PyMC adds to a node's parameters."""
        return [p[(0,) * (p.ndim - r.type.ndim)] for p, r in zip(params, self.roots, strict=True)]

    def placeholders(self) -> list[TensorVariable]:
        """Return a fresh symbol for each root."""
        return [r.type(name=r.name) for r in self.roots]


def read_inputs(name: str, inputs: Sequence[Any], model: pm.Model) -> Inputs:
    """Sort the inputs of a response into aleatory, epistemic and constant ones.

    Raises
    ------
    TypeError, ValueError
        If one is none of the three, if none is aleatory, or if no model variable is above any of them.
    """
    known = set(model.basic_RVs)
    arguments: list[Any] = []
    aleatory: list[TensorVariable] = []
    roots: dict[TensorVariable, None] = {}
    nested = False
    for i, x in enumerate(inputs):
        label = f"{name}: input {i + 1}"
        if not isinstance(x, Variable):
            arguments.append(_constant(x, label))
            continue
        above = list(walk([x], lambda v: None if v in known or v.owner is None else v.owner.inputs))
        roots.update((v, None) for v in above if v in known)
        latent = [v for v in above if v not in known and is_random(v)]
        # PyMC gives a `str_repr` to the variables of a model, and none to a `.dist()`.
        foreign = [v for v in latent if hasattr(v, "str_repr")]
        strays = [v for v in above if v.owner is None and not _is_bound(v)] + foreign
        if strays:
            raise TypeError(
                f"{label}: got {x} which depends on {strays[0]}, expected a `.dist()`, a variable of this model "
                "or a constant; create the variables it depends on inside the same `with pm.Model()`"
            )
        if x in known or not latent:
            arguments.append(x)
            continue
        if not is_random(x):
            raise TypeError(
                f"{label}: got an expression of a `.dist()` ({x}), expected the `.dist()` itself; "
                "write the expression inside the response"
            )
        nested = nested or len(latent) > 1
        if x not in aleatory:
            aleatory.append(x)
        arguments.append(aleatory.index(x))
    if not aleatory:
        raise ValueError(
            f"{name}: got {len(inputs)} inputs, none of them aleatory, expected at least one that varies between "
            "specimens; pass a distribution made with `.dist()`, such as pm.Normal.dist(mu, sigma)"
        )
    if not roots:
        raise ValueError(
            f"{name}: got inputs that depend on no variable of the model, expected hyperparameters to calibrate; "
            "give the `.dist()` parameters that are model variables, such as mu = pm.Normal('mu', 0, 1)"
        )
    return Inputs(tuple(arguments), tuple(aleatory), tuple(roots), nested)


def _constant(x: object, label: str) -> Any:
    try:
        array = real_array(x, label)  # type: ignore[arg-type]
    except TypeError as error:
        raise TypeError(
            f"{error}; an input is a `.dist()` (varies between specimens), a model variable (common to all) or a number"
        ) from None
    if not np.isfinite(array).all():
        raise ValueError(f"{label}: got a constant that is not finite ({x!r:.60}), expected a number")
    return float(array) if array.ndim == 0 else array


def is_random(variable: Variable) -> bool:
    if variable.owner is None:
        return False
    op = variable.owner.op
    return (
        isinstance(op, RandomVariable | pm.distributions.distribution.SymbolicRandomVariable)
        and variable is variable.owner.outputs[op.default_output or 0]
    )


def _is_bound(variable: Variable) -> bool:
    """Whether a graph's leaf has a value: constants, shared variables, generators."""
    return hasattr(variable, "data") or hasattr(variable, "get_value") or not isinstance(variable, TensorVariable)


def ninf_for_invalid(graphs: Sequence[TensorVariable]) -> list[TensorVariable]:
    """Replace PyMC's parameter checks by -inf, so that one invalid theta of a batch leaves the others alone."""
    from pymc.logprob.utils import CheckParameterValue

    checks: dict[Variable, Variable] = {}
    for v in ancestors(graphs):
        if v.owner is not None and isinstance(v.owner.op, CheckParameterValue):
            value, *conditions = v.owner.inputs
            checks[v] = pt.switch(pt.all([pt.all(c) for c in conditions]), value, -np.inf)
    return list(graph_replace(list(graphs), checks, strict=False)) if checks else list(graphs)


def log_density(inputs: Inputs, aleatory: Sequence[TensorVariable], values: Sequence[Any]) -> TensorVariable:
    """Return log p(x), shape (n,), of values x, shapes (n, *event), summed over the aleatory inputs."""
    total: Any = 0.0
    for dist, x, shape in zip(aleatory, values, inputs.event_shapes, strict=True):
        logp = _mvnormal_logp(dist, x, shape[0]) if is_mvnormal(dist) else pm.logp(dist, x, warn_rvs=False)
        total = total + (logp.sum(axis=tuple(range(1, logp.type.ndim))) if logp.type.ndim > 1 else logp)
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
    logp = sum(-0.5 * z_i**2 - pt.log(root[i, i]) - 0.5 * np.log(2 * np.pi) for i, z_i in enumerate(z))
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
        raise TypeError(f"{name}: {op} is discrete; use propagation=prb.Reweighted() or prb.Fresh()")
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


def event_shape(dist: TensorVariable) -> tuple[int, ...]:
    """Return the event shape of an aleatory input, evaluated."""
    if dist.type.ndim == 0:
        return ()
    shape = dist.type.shape
    if None not in shape:
        return tuple(int(s) for s in shape if s is not None)
    return tuple(int(s) for s in pm.draw(dist, random_seed=0, mode=PLAIN).shape)


class PriorSampler:
    """Draws of variables from the prior, all in one call of a function that is compiled once."""

    def __init__(self, roots: Sequence[TensorVariable]) -> None:
        self._names = ", ".join(str(r.name) for r in roots)
        n = pt.iscalar("n")
        first = [r for r in roots if not any(a in roots for a in ancestors([r]) if a is not r)]
        self._batched = True
        try:
            outputs = vectorize_graph(list(roots), {v: change_dist_size(v, (n,), expand=True) for v in first})
            self._function = pm.compile([n], outputs, mode=PLAIN)
        except (NotImplementedError, ValueError, MissingInputError):  # not vectorized, or not resized: one at a time
            self._batched = False
            self._function = pm.compile([n], list(roots), mode=PLAIN, on_unused_input="ignore")
        self._generators = [v for v in self._function.get_shared() if isinstance(v.type, RandomGeneratorType)]

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
            raise TypeError("priors: got one that depends on a random variable which is not in the model")
        self._function = compile_batched(symbols, list(placed.values()))

    def __call__(self, cube: Floats) -> list[Floats]:
        """Return values of each variable, shapes (k, *shape), for points of shape (k, size)."""
        edges = np.cumsum([0, *(int(np.prod(s, dtype=int)) for s in self._shapes)])
        parts = [cube[:, a:b] for a, b in pairwise(edges)]
        values = self._function(*(p.reshape(len(cube), *s) for p, s in zip(parts, self._shapes, strict=True)))
        return [np.asarray(v) for v in values]


def prior_draws(roots: Sequence[TensorVariable], k: int, seed: int) -> list[Floats]:
    """Draw the roots k times from the prior; arrays of shape (k, *shape)."""
    return PriorSampler(roots)(k, seed)


def valid(inputs: Inputs, aleatory: Sequence[TensorVariable]) -> TensorVariable:
    """Return whether the parameters of all aleatory inputs are valid (sigma > 0 and such), a boolean scalar."""
    from pymc.logprob.utils import CheckParameterValue

    logps = [pm.logp(d, pt.zeros_like(d), warn_rvs=False) for d in aleatory] if not inputs.nested else []
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
        batched = [pt.tensor(name=s.name, dtype=s.dtype, shape=(None, *s.type.shape)) for s in symbols]
        size = (batched[0].shape[0], n)
        per_specimen: dict[Variable, Variable] = {
            s: pt.broadcast_to(b[:, None], (*size, *(b.shape[i] for i in range(1, b.ndim))))
            for s, b in zip(symbols, batched, strict=True)
        }
        # Distributions without any root above them are not batched by their parameters: resize them.
        for v in ancestors(dists):
            if is_random(v) and not any(a in symbols or (a is not v and is_random(a)) for a in ancestors([v])):
                per_specimen[v] = change_dist_size(v, size, expand=True)
        self._batched = True
        try:
            outputs = vectorize_graph(dists, per_specimen)
            common = vectorize_graph(epistemic, dict(zip(symbols, batched, strict=True))) if epistemic else []
        except (NotImplementedError, ValueError):  # what PyTensor does not vectorize: one population at a time
            self._batched, batched = False, symbols
            # Resized before the roots are replaced, since PyMC resizes a CustomDist with its first parameters.
            resized = [change_dist_size(d, (n,), expand=True) for d in inputs.aleatory]
            outputs = graph_replace(resized, dict(zip(inputs.roots, symbols, strict=True)), strict=False)
            common = epistemic
        self._n_aleatory = len(dists)
        self._epistemic_ndims = [e.type.ndim for e in epistemic]
        self._function = pm.compile(
            [n, *batched], [*outputs, *common], mode=PLAIN, on_unused_input="ignore", allow_input_downcast=True
        )
        self._generators = [v for v in self._function.get_shared() if isinstance(v.type, RandomGeneratorType)]

    def __call__(self, params: Sequence[Any], n: int, rng: np.random.Generator) -> tuple[list[Floats], list[Floats]]:
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


def compile_batched(
    core_inputs: Sequence[TensorVariable], core_outputs: Sequence[TensorVariable], extra: Sequence[TensorVariable] = ()
) -> Any:
    """Compile a graph for a batch: every core input gets a leading axis, ``extra`` inputs stay as they are."""
    outputs = ninf_for_invalid(core_outputs)
    batched = [pt.tensor(name=v.name, dtype=v.dtype, shape=(None, *v.type.shape)) for v in core_inputs]
    vectorized = vectorize_graph(outputs, dict(zip(core_inputs, batched, strict=True)))
    return pytensor.function(
        [*batched, *extra], vectorized, mode=PLAIN, on_unused_input="ignore", allow_input_downcast=True
    )
