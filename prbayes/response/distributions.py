"""Log-densities, inverse distribution functions and draws of PyMC distributions."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
import pymc as pm
import pytensor.tensor as pt
from pymc.distributions.multivariate import MvNormal, MvStudentT
from pymc.distributions.shape_utils import change_dist_size
from pymc.distributions.transforms import _default_transform
from pytensor.graph.basic import Variable
from pytensor.graph.replace import graph_replace, vectorize_graph
from pytensor.graph.traversal import ancestors
from pytensor.graph.utils import MissingInputError
from pytensor.tensor.random.type import RandomGeneratorType
from pytensor.tensor.variable import TensorVariable

from prbayes._validate import Arrays, Floats
from prbayes.response.compile import (
    PLAIN,
    compile_batched,
    interpreted,
    vectorize_distributions,
    with_leading_axis,
)
from prbayes.response.condition import is_condition
from prbayes.response.inputs import Inputs, event_shape, quiet_logp
from prbayes.response.pymc_dims import is_random, without_dims

# Operations of PyMC distributions, for checks by `isinstance`.
MVNORMAL = type(MvNormal.rv_op)
ELLIPTICAL = (MVNORMAL, MvStudentT.rv_type)
RANDOM_WALK = pm.RandomWalk.rv_type


def log_density(
    inputs: Inputs,
    aleatory: Sequence[TensorVariable],
    values: Sequence[Any],
    instead: Mapping[int, Callable[[TensorVariable, Any], TensorVariable]] | None = None,
) -> TensorVariable:
    """Return log p(x), (n,), of values (n, *event), given the conditions of the specimens.

    ``instead`` has functions that replace the log-density of inputs at some positions.
    """
    total = 0.0
    triples = zip(aleatory, values, inputs.event_shapes, strict=True)
    for i, (dist, x, shape) in enumerate(triples):
        if i in inputs.conditions:
            continue
        if instead and i in instead:
            logp = instead[i](dist, x)
        elif isinstance(dist.owner.op, ELLIPTICAL):
            logp = _elliptical_logp(dist, x, shape[-1])
        elif isinstance(dist.owner.op, RANDOM_WALK):  # PyMC's density takes one value at a time
            value = dist.type()
            logp = vectorize_graph(quiet_logp(dist, value), {value: x})
        else:
            logp = pm.logp(dist, x, warn_rvs=False)
        # The log-densities of independent elements add up.
        if logp.type.ndim > 1:
            logp = logp.sum(axis=tuple(range(1, logp.type.ndim)))
        total = total + logp
    return total


@interpreted()
def compiled_log_density(inputs: Inputs) -> Any:
    """Return log p(x), (k, n), as a function of parents (k, *shape), then points (n, *event)."""
    symbols = inputs.placeholders()
    dists, _ = inputs.rebuilt(symbols)
    points = [pt.tensor(dtype=x.dtype, shape=(None,) * (x.type.ndim + 1)) for x in inputs.aleatory]
    return compile_batched(symbols, [log_density(inputs, dists, points)], points)


def _elliptical_logp(dist: TensorVariable, x: Any, size: int) -> TensorVariable:
    """Return log p(x) by elementwise substitution, since PyMC solves for each theta and point."""
    *freedom, mean, covariance = dist.owner.op.dist_params(dist.owner)
    root = _cholesky(covariance, size)
    # Solve root z = x - mean.
    z: list[Any] = []
    for i in range(size):
        sum_before = sum(root[i][j] * z[j] for j in range(i))
        z.append((x[..., i] - mean[..., i] - sum_before) / root[i][i])
    logp = 0
    if freedom:
        (nu,) = freedom
        power = (nu + size) / 2
        gammas = pt.gammaln(power) - pt.gammaln(nu / 2)
        norm = gammas - 0.5 * size * pt.log(nu * np.pi)
        squared_distance = sum(z_i**2 for z_i in z)
        logp = norm - power * pt.log1p(squared_distance / nu)
        logp = pt.switch(nu > 0, logp, -np.inf)
        for i in range(size):
            logp = logp - pt.log(root[i][i])
    else:
        for i in range(size):
            logp = logp + (-0.5 * z[i] ** 2 - pt.log(root[i][i]) - 0.5 * np.log(2 * np.pi))
    return pt.switch(pt.isnan(logp), -np.inf, logp)


def _cholesky(matrix: Any, size: int) -> list[list[Any]]:
    """Return the rows of a lower Cholesky factor, NaN if the matrix is not positive definite."""
    if size > 4:  # small matrices are factorised elementwise, as PyTensor loops over a batch
        root = pt.linalg.cholesky(matrix, on_error="nan")
        return [[root[..., i, j] for j in range(i + 1)] for i in range(size)]
    rows: list[list[Any]] = []
    for i in range(size):
        row: list[Any] = []
        for j in range(i):
            product = sum(row[k] * rows[j][k] for k in range(j))
            row.append((matrix[..., i, j] - product) / rows[j][j])
        squares = sum(element**2 for element in row)
        row.append(pt.sqrt(matrix[..., i, i] - squares))
        rows.append(row)
    return rows


def refuse_lopsided(name: str, inputs: Inputs, params: Arrays) -> None:
    """Raise if a covariance is not symmetric, at values of the parents, (k, *shape)."""
    # Densities and draws would read one triangle of the matrix and ignore the other.
    symbols = inputs.placeholders()
    dists, _ = inputs.rebuilt(symbols)
    covariances = [
        d.owner.op.dist_params(d.owner)[-1] for d in dists if isinstance(d.owner.op, ELLIPTICAL)
    ]
    if not covariances:
        return
    for covariance in compile_batched(symbols, covariances)(*params):
        difference = np.abs(covariance - np.swapaxes(covariance, -1, -2))
        scale = np.abs(covariance).max(axis=(-2, -1), keepdims=True)
        if np.any(difference > 1e-8 * scale):  # the difference is more than rounding
            raise ValueError(
                f"{name}: got an input whose covariance is not symmetric, expected a covariance "
                "matrix; pm.LKJCorr is no correlation matrix but its Cholesky factor L: "
                "pass chol=sds[:, None] * L instead of cov="
            )


def fixed_ends(dist: TensorVariable) -> tuple[Floats, Floats, bool]:
    """Return ends of the support of each element, and whether the density is finite there.

    Ends that hyperparameters move, and those of unbounded elements, are infinite.
    """
    transform = _default_transform(dist.owner.op, dist)
    kind = "" if transform is None else transform.name
    ends = (None, None)
    if kind == "interval":
        ends = transform.args_fn(*dist.owner.inputs)
    elif kind in ("log", "logodds"):
        ends = pt.constant(0.0), pt.constant(1.0) if kind == "logodds" else None
    shape = event_shape(dist)
    low, high = np.full(shape, -np.inf), np.full(shape, np.inf)
    if isinstance(ends[0], pt.TensorConstant):
        low[...] = ends[0].data
    if isinstance(ends[1], pt.TensorConstant):
        high[...] = ends[1].data
    is_finite = kind == "interval"
    if isinstance(dist.owner.op, pm.Truncated.rv_type):  # it may keep an end of its base
        base = dist.owner.op.base_rv_op.make_node(*dist.owner.inputs[:-2]).default_output()
        lower, upper, is_finite_at_both = fixed_ends(base)
        is_moved = (np.isinf(lower) | (low > lower)) & (np.isinf(upper) | (high < upper))
        is_finite = is_finite_at_both or bool(is_moved.all())
        low, high = np.maximum(low, lower), np.minimum(high, upper)
    return low, high, is_finite


def _scalar_if_infinite(end: TensorVariable) -> Any:
    """Return a scalar for a vector of infinite ends, which PyMC would take for finite ones."""
    value = pt.get_underlying_scalar_constant_value(end, raise_not_constant=False)
    return pt.constant(value) if not isinstance(value, Variable) and np.isinf(value) else end


def quantiles(name: str, dist: TensorVariable, u: Any) -> TensorVariable:
    """Return the inverse distribution function of ``dist`` at u, (n, *event), or raise."""
    op = dist.owner.op
    if dist.dtype.startswith(("int", "uint", "bool")):
        raise TypeError(f"{name}: got {op}, which is discrete, expected a continuous one")
    if isinstance(op, MVNORMAL):
        mean, covariance = op.dist_params(dist.owner)
        z = pm.icdf(pm.Normal.dist(0.0, 1.0), u)
        return mean + z @ pt.linalg.cholesky(covariance).T
    if isinstance(op, type(pm.TruncatedNormal.rv_op)):
        mean, sd, *ends = op.dist_params(dist.owner)
        return pm.TruncatedNormal.icdf(u, mean, sd, *map(_scalar_if_infinite, ends))
    try:
        return pm.icdf(dist, u, warn_rvs=False)
    except NotImplementedError:
        raise TypeError(
            f"{name}: got {op}, which has no inverse distribution function in PyMC, expected one "
            "that has"
        ) from None


def normal_scores(inputs: Inputs) -> Any:
    """Return normal scores by input, (k, n, *event), as a function of parents, then points.

    Returns None if inputs depend on each other, or if one has no distribution function.
    """
    if inputs.nested:
        return None
    symbols = inputs.placeholders()
    dists, _ = inputs.rebuilt(symbols)
    graphs, points = [], []
    for dist, shape in zip(dists, inputs.event_shapes, strict=True):
        x = pt.tensor(dtype="float64", shape=(None,) * (len(shape) + 1))
        points.append(x)
        if isinstance(dist.owner.op, MVNORMAL):
            mean, covariance = dist.owner.op.dist_params(dist.owner)
            inverse = pt.linalg.inv(pt.linalg.cholesky(covariance))
            graphs.append((inverse @ (x - mean)[..., None])[..., 0])
            continue
        try:
            share = pt.exp(pm.logcdf(dist, x, warn_rvs=False))
        except NotImplementedError:
            return None
        graphs.append(-np.sqrt(2) * pt.erfcinv(2 * pt.clip(share, 1e-300, 1 - 1e-16)))
    return compile_batched(symbols, graphs, points)


def _density(dist: TensorVariable) -> TensorVariable | None:
    """Return the log-density at zero as a graph; None if PyMC has none, or only a random one."""
    try:
        density = quiet_logp(dist, pt.zeros_like(dist))
    except (NotImplementedError, ValueError):  # a ValueError: PyMC has it for one value only
        return None
    if isinstance(dist.owner.op, RANDOM_WALK):
        return density  # only the shapes of the random parts are used
    # The zeros depend on the distribution, too, but only by its shape.
    parts = set(ancestors([density], blockers=[dist])) - {dist}
    return None if any(map(is_random, parts)) else density


def refuse_without_density(name: str, inputs: Inputs) -> None:
    """Raise if PyMC does not know the density of an input."""
    # Parents are replaced by symbols, since PyMC has no density for a sum of random variables.
    dists, _ = inputs.rebuilt(inputs.placeholders())
    for dist in dists:
        if not isinstance(dist.owner.op, ELLIPTICAL) and _density(dist) is None:
            raise TypeError(
                f"{name}: got {dist.owner.op}, for which PyMC has no density, expected one, since "
                "stored responses are weighted by it; give a pm.CustomDist its logp="
            )


def valid(inputs: Inputs, aleatory: Sequence[TensorVariable]) -> TensorVariable:
    """Return whether the parameters of all aleatory inputs are valid, a boolean scalar."""
    from pymc.logprob.utils import CheckParameterValue

    if inputs.nested:
        return pt.constant(True)
    # The densities contain checks of their parameters, such as sigma > 0.
    densities = [density for d in aleatory if (density := _density(d)) is not None]
    conditions = []
    for v in ancestors(densities):
        if v.owner is not None and isinstance(v.owner.op, CheckParameterValue):
            conditions += [pt.all(c) for c in v.owner.inputs[1:]]
    return pt.all(conditions) if conditions else pt.constant(True)


# -- draws -----------------------------------------------------------------------------------------


def _seed(function: Any, rng: np.random.Generator) -> None:
    """Give each generator of a compiled function its own stream."""
    generators = [v for v in function.get_shared() if isinstance(v.type, RandomGeneratorType)]
    for shared, child in zip(generators, rng.spawn(len(generators)), strict=True):
        shared.set_value(child, borrow=True)


def resized(dist: TensorVariable, size: tuple[Any, ...]) -> TensorVariable:
    """Return independent draws of a distribution along leading axes of this size."""
    op = dist.owner.op
    if not hasattr(op, "rv_op"):
        return change_dist_size(dist, size, expand=True)
    # PyMC would drop the axes that the parameters of such a distribution (pm.HalfCauchy) add.
    shape = event_shape(dist)[: dist.type.ndim - op.ndim_supp]
    return change_dist_size(dist, (*size, *shape))


class PriorSampler:
    """Draws of variables from the prior, all in one call of a compiled function."""

    @interpreted()
    def __init__(self, drawn: Sequence[TensorVariable]) -> None:
        self._names = ", ".join([str(v.name) for v in drawn])
        copies = without_dims(drawn)
        is_copied = any(x is not y for x, y in zip(copies, drawn, strict=True))
        drawn = copies
        self._shapes = [event_shape(v) for v in drawn]
        # PyMC marks the variables of a model by a `str_repr`, but not their copies.
        random = list(filter(is_random, ancestors(drawn)))
        parents = [v for v in random if is_copied or hasattr(v, "str_repr")]
        variables = dict.fromkeys([*drawn, *parents])
        n = pt.iscalar("n")
        try:
            # Variables that depend on no other variable are drawn n times, the others given them.
            batches = {}
            for v in variables:
                if variables.keys() & set(ancestors([v])) == {v}:
                    batches[v] = resized(v, (n,))
            outputs = vectorize_graph(list(drawn), batches)
            self._function = pm.compile([n], outputs, mode=PLAIN)
            self._is_batched = True
        except (NotImplementedError, ValueError, MissingInputError):
            # PyTensor cannot vectorize the graph, or PyMC cannot resize it: draw one at a time.
            self._function = pm.compile([n], list(drawn), mode=PLAIN, on_unused_input="ignore")
            self._is_batched = False

    def __call__(self, k: int, seed: int) -> list[Floats]:
        """Return k draws of each variable, shapes (k, *shape)."""
        _seed(self._function, np.random.default_rng(seed))
        try:
            if self._is_batched:
                # SciPy's samplers drop leading axes of length one.
                pairs = zip(self._function(k), self._shapes, strict=True)
                return [np.asarray(v).reshape(k, *shape) for v, shape in pairs]
            draws = [self._function(k) for _ in range(k)]
        except NotImplementedError as error:
            raise TypeError(
                f"priors: got {self._names}, one of which cannot be drawn ({error}), expected "
                "proper priors; replace pm.Flat and pm.HalfFlat by a wide pm.Normal or "
                "pm.HalfNormal"
            ) from None
        return [np.array(column) for column in zip(*draws, strict=True)]


class PriorPoints:
    """Map from the unit cube to the prior, each variable given those that it depends on."""

    @interpreted()
    def __init__(self, variables: Sequence[TensorVariable]) -> None:
        variables = without_dims(variables)
        self._shapes = [event_shape(v) for v in variables]
        self._sizes = [math.prod(s) for s in self._shapes]
        self.size = sum(self._sizes)
        symbols = [pt.tensor(dtype="float64", shape=s) for s in self._shapes]
        values: dict[Variable, Variable] = {}
        for v, u in zip(variables, symbols, strict=True):
            (conditional,) = graph_replace([v], values, strict=False)
            values[v] = quantiles("priors", conditional, u)
        if any(map(is_random, ancestors(list(values.values())))):
            raise TypeError(
                "priors: got one that depends on a random variable which is not in the model"
            )
        self._function = compile_batched(symbols, list(values.values()))

    def __call__(self, cube: Floats) -> list[Floats]:
        """Return values of each variable, shapes (k, *shape), for points of shape (k, size)."""
        columns = np.split(cube, np.cumsum(self._sizes)[:-1], axis=1)
        pairs = zip(columns, self._shapes, strict=True)
        parts = [part.reshape(len(cube), *shape) for part, shape in pairs]
        return [np.asarray(v) for v in self._function(*parts)]


class PopulationSampler:
    """Random draws of n specimens from the populations at given parents."""

    @interpreted()
    def __init__(self, inputs: Inputs) -> None:
        self._names = ", ".join(str(x.owner.op) for x in inputs.aleatory)
        self._inputs = inputs
        symbols = [parent.type() for parent in inputs.parents]
        aleatory, epistemic = inputs.rebuilt(symbols)
        n = pt.iscalar("n")
        covariates = {s for s, r in zip(symbols, inputs.parents, strict=True) if is_condition(r)}
        # A covariate is a number for each specimen.
        batched = with_leading_axis([pt.dvector() if s in covariates else s for s in symbols])
        common = epistemic

        # Draw n specimens for each theta. Distributions that depend on no parent do not get these
        # axes from their parameters, and are resized.
        size = (batched[0].shape[0], n)
        per_specimen = {}
        for symbol, batch in zip(symbols, batched, strict=True):
            if symbol in covariates:
                per_specimen[symbol] = batch
                continue
            shape = [batch.shape[i] for i in range(1, batch.ndim)]
            per_specimen[symbol] = pt.broadcast_to(batch[:, None], (*size, *shape))
        for v in filter(is_random, ancestors(aleatory)):
            parents = [a for a in ancestors([v]) if a is not v]
            if not any(a in symbols or is_random(a) for a in parents):
                per_specimen[v] = resized(v, size)
        self._is_batched = True
        try:
            specimens = None
            if not covariates:
                with suppress(NotImplementedError, ValueError, MissingInputError):
                    specimens = vectorize_graph(aleatory, per_specimen)
            if specimens is None:  # PyTensor cannot vectorize the graph, and PyMC may resize it.
                specimens = vectorize_distributions(aleatory, per_specimen)
            if epistemic:
                common = vectorize_graph(epistemic, dict(zip(symbols, batched, strict=True)))
        except (NotImplementedError, ValueError, MissingInputError, TypeError) as error:
            if covariates:
                raise error if isinstance(error, TypeError) else self.refusal(error) from None
            # PyTensor cannot vectorize the graph: draw one population at a time.
            self._is_batched, batched = False, symbols
            # Resize before the parents are replaced, because PyMC resizes a CustomDist with the
            # parameters that it was made with.
            try:
                if inputs.nested:  # random parts of an input are drawn for each specimen, too
                    parts = set(filter(is_random, ancestors(inputs.aleatory, inputs.parents)))
                    parts -= set(inputs.parents)
                    first = [v for v in parts if parts & set(ancestors([v], inputs.parents)) == {v}]
                    per_specimen = {v: resized(v, (n,)) for v in first}
                    many = vectorize_graph(list(inputs.aleatory), per_specimen)
                else:
                    many = [resized(dist, (n,)) for dist in inputs.aleatory]
            except (NotImplementedError, ValueError, MissingInputError) as error:
                raise self.refusal(error) from None
            replaced = dict(zip(inputs.parents, symbols, strict=True))
            specimens = graph_replace(many, replaced, strict=False)
        self._event_shapes = inputs.event_shapes
        self._epistemic_ndims = [e.type.ndim for e in epistemic]
        self._function = pm.compile(
            [n, *batched],
            [*specimens, *common],
            mode=PLAIN,
            on_unused_input="ignore",
            allow_input_downcast=True,
        )

    def refusal(self, error: Exception) -> TypeError:
        """Return the error of inputs that cannot be drawn."""
        remedy = "give a pm.CustomDist its random="
        if isinstance(error, ValueError):  # a parameter may be out of its range
            remedy = (
                "keep parameters in their range, such as a standard deviation by pm.HalfNormal, or "
                + remedy
            )
        return TypeError(
            f"inputs: got {self._names}, one of which cannot be drawn "
            f"({str(error).splitlines()[0]}), expected distributions from which specimens can be "
            f"drawn; {remedy}"
        )

    def __call__(
        self, params: Sequence[Any], n: int, rng: np.random.Generator
    ) -> tuple[list[Floats], list[Floats]]:
        """Draw n specimens from each of k populations, at parents (k, *shape).

        Covariates, (k, m), have a value for each specimen, and are repeated up to n specimens.
        Aleatory inputs are (k, n, *event), epistemic ones (k, 1, *event), or (*event) if they have
        no parents.
        """
        _seed(self._function, rng)
        params = self._inputs.for_specimens(params, n)
        try:
            if self._is_batched:
                values = list(self._function(n, *params))
            else:
                populations = [self._function(n, *row) for row in zip(*params, strict=True)]
                values = [np.stack(column) for column in zip(*populations, strict=True)]
        except (NotImplementedError, RuntimeError, ValueError) as error:
            raise self.refusal(error) from None
        n_aleatory = len(self._event_shapes)
        # SciPy's generators, behind some distributions, drop leading axes of length one.
        aleatory = [
            np.reshape(v, (len(params[0]), n, *shape))
            for v, shape in zip(values[:n_aleatory], self._event_shapes, strict=True)
        ]
        epistemic = [
            v[:, None] if v.ndim > ndim else v
            for v, ndim in zip(values[n_aleatory:], self._epistemic_ndims, strict=True)
        ]
        return aleatory, epistemic
