"""What is read off PyMC distributions: log-densities, inverse distribution functions, draws."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import pymc as pm
import pytensor.tensor as pt
from pymc.distributions.multivariate import MvNormal, MvStudentT
from pymc.distributions.shape_utils import change_dist_size
from pytensor.graph.basic import Variable
from pytensor.graph.replace import graph_replace, vectorize_graph
from pytensor.graph.traversal import ancestors
from pytensor.graph.utils import MissingInputError
from pytensor.tensor.random.type import RandomGeneratorType
from pytensor.tensor.variable import TensorVariable

from prbayes._validate import Floats
from prbayes.response.compile import (
    PLAIN,
    compile_batched,
    interpreted,
    untraced,
    with_leading_axis,
)
from prbayes.response.inputs import Inputs, event_shape, is_random, quiet_logp


def log_density(
    inputs: Inputs,
    aleatory: Sequence[TensorVariable],
    values: Sequence[Any],
    instead: Mapping[int, Callable[[TensorVariable, Any], TensorVariable]] | None = None,
) -> TensorVariable:
    """Return log p(x), shape (n,), of values (n, *event), summed over the aleatory inputs.

    ``instead`` has, for some of the inputs by their positions, what is taken for their log-density.
    """
    total: Any = 0.0
    triples = zip(aleatory, values, inputs.event_shapes, strict=True)
    for i, (dist, x, shape) in enumerate(triples):
        if instead and i in instead:
            logp = instead[i](dist, x)
        elif is_elliptical(dist):
            logp = _elliptical_logp(dist, x, shape[-1])
        else:
            logp = _logp(dist, x)
        # Elements of a vector of independent inputs.
        if logp.type.ndim > 1:
            logp = logp.sum(axis=tuple(range(1, logp.type.ndim)))
        total = total + logp
    return total


def _logp(dist: TensorVariable, x: Any) -> TensorVariable:
    """Return PyMC's log p(x) of values (n, *event); that of random walks takes one at a time."""
    if not _is_walk(dist):
        return pm.logp(dist, x, warn_rvs=False)
    one = dist.type()
    return vectorize_graph(quiet_logp(dist, one), {one: x})


def _is_walk(dist: TensorVariable) -> bool:
    """Whether a distribution is a random walk."""
    return isinstance(dist.owner.op, pm.RandomWalk.rv_type)


@untraced()
def compiled_log_density(inputs: Inputs) -> Any:
    """Return log p(x) as a function of roots (k, *shape), then points (n, *event): (k, n)."""
    symbols, points, density = _log_density(inputs)
    return compile_batched(symbols, [density], points)


def _log_density(inputs: Inputs) -> tuple[list[Any], list[Any], TensorVariable]:
    """Return symbols of roots, (*shape), and points, (n, *event), and their log-density, (n,)."""
    symbols = inputs.placeholders()
    points = []
    for x in inputs.aleatory:
        shape = (None,) * (x.type.ndim + 1)
        points.append(pt.tensor(dtype=x.dtype, shape=shape))
    dists, _ = inputs.rebuilt(symbols)
    return symbols, points, log_density(inputs, dists, points)


def is_mvnormal(dist: TensorVariable) -> bool:
    """Whether a distribution is a multivariate normal."""
    return isinstance(dist.owner.op, type(MvNormal.rv_op))


def is_elliptical(dist: TensorVariable) -> bool:
    """Whether a distribution is a multivariate normal or Student's t: positive everywhere."""
    return is_mvnormal(dist) or isinstance(dist.owner.op, MvStudentT.rv_type)


def _elliptical_logp(dist: TensorVariable, x: Any, size: int) -> TensorVariable:
    """Return log p(x) by forward substitution, elementwise.

    PyMC's own density solves once for each theta and point of a batch.
    """
    *freedom, mean, covariance = dist.owner.op.dist_params(dist.owner)
    root = _cholesky(covariance, size)
    diagonal = [root[i][i] for i in range(size)]
    # Solve root z = x - mean.
    z: list[Any] = []
    for i in range(size):
        away = x[..., i] - mean[..., i]
        above = sum(root[i][j] * z[j] for j in range(i))
        z.append((away - above) / diagonal[i])
    logp: Any = 0
    if freedom:
        logp = _studentt_logp(freedom[0], z)
        for scale in diagonal:
            logp = logp - pt.log(scale)
    else:
        constant = 0.5 * np.log(2 * np.pi)
        for z_i, scale in zip(z, diagonal, strict=True):
            normal = -0.5 * z_i**2 - pt.log(scale) - constant
            logp = logp + normal
    return pt.switch(pt.isnan(logp), -np.inf, logp)


def _cholesky(matrix: Any, size: int) -> list[list[Any]]:
    """Return the rows of a lower Cholesky factor, not numbers if the matrix is not positive.

    Elementwise if it is small: PyTensor's loops over the matrices of a batch.
    """
    if size > 4:
        root = pt.linalg.cholesky(matrix, on_error="nan")
        return [[root[..., i, j] for j in range(i + 1)] for i in range(size)]
    rows: list[list[Any]] = []
    for i in range(size):
        row: list[Any] = []
        for j in range(i):
            known = sum(row[k] * rows[j][k] for k in range(j))
            row.append((matrix[..., i, j] - known) / rows[j][j])
        squares = sum(element**2 for element in row)
        row.append(pt.sqrt(matrix[..., i, i] - squares))
        rows.append(row)
    return rows


def _studentt_logp(nu: Any, z: Sequence[Any]) -> Any:
    """Return the log-density of Student's t with a unit matrix, at coordinates z."""
    size = len(z)
    distance = sum(z_i**2 for z_i in z)
    power = (nu + size) / 2
    gammas = pt.gammaln(power) - pt.gammaln(nu / 2)
    norm = gammas - 0.5 * size * pt.log(nu * np.pi)
    logp = norm - power * pt.log1p(distance / nu)
    return pt.switch(nu > 0, logp, -np.inf)


def refuse_lopsided(name: str, inputs: Inputs, params: Sequence[Floats]) -> None:
    """Raise if a covariance is not symmetric, at values of the roots, (k, *shape).

    Its density and its draws read one half of the matrix, as if the other were alike.
    """
    symbols = inputs.placeholders()
    dists, _ = inputs.rebuilt(symbols)
    covariances = []
    for dist in filter(is_elliptical, dists):
        *_, covariance = dist.owner.op.dist_params(dist.owner)
        covariances.append(covariance)
    if not covariances:
        return
    for covariance in compile_batched(symbols, covariances)(*params):
        mirrored = np.swapaxes(covariance, -1, -2)
        gap = np.abs(covariance - mirrored)
        size = np.abs(covariance).max(axis=(-2, -1), keepdims=True)
        # Products of the same numbers in another order differ by rounding, 1e-16 of them.
        if np.any(gap > 1e-8 * size):
            raise ValueError(
                f"{name}: got an input whose covariance is not symmetric, expected a covariance "
                "matrix; pm.LKJCorr is no correlation matrix but its Cholesky factor L: "
                "pass chol=sds[:, None] * L instead of cov="
            )


def quantiles(name: str, dist: TensorVariable, u: Any) -> TensorVariable:
    """Return the inverse distribution function of ``dist`` at u, shape (n, *event).

    A multivariate normal takes its mean plus Cholesky factor times standard normal quantiles.

    Raises
    ------
    TypeError
        If the distribution is discrete or has no inverse distribution function in PyMC.
    """
    op = dist.owner.op
    other = "use propagation=prb.Reweighted() or prb.Fresh()"
    if dist.dtype.startswith(("int", "uint", "bool")):
        raise TypeError(f"{name}: got {op}, which is discrete, expected a continuous one; {other}")
    if is_mvnormal(dist):
        mean, covariance = op.dist_params(dist.owner)
        z = pm.icdf(pm.Normal.dist(0.0, 1.0), u)
        return mean + z @ pt.linalg.cholesky(covariance).T
    try:
        return pm.icdf(dist, u, warn_rvs=False)
    except NotImplementedError:
        raise TypeError(
            f"{name}: got {op}, which has no inverse distribution function in PyMC, expected one "
            f"that has; {other}"
        ) from None


def _density(dist: TensorVariable) -> TensorVariable | None:
    """Return the log-density at zero as a graph, None where PyMC has none.

    One that is drawn, as that of a `pymc.Simulator`, is none.
    """
    try:
        density = quiet_logp(dist, pt.zeros_like(dist))
    except NotImplementedError:
        return None
    if _is_walk(dist):
        return density  # its parts stand in it for their shapes alone
    # Zero takes its shape from the distribution.
    above = set(ancestors([density], blockers=[dist])) - {dist}
    return None if any(map(is_random, above)) else density


def refuse_without_density(name: str, inputs: Inputs) -> None:
    """Raise if PyMC does not know the density of an input."""
    # With symbols for the roots: a sum of two random variables has no density that PyMC knows.
    dists, _ = inputs.rebuilt(inputs.placeholders())
    for dist in dists:
        if not is_elliptical(dist) and _density(dist) is None:
            raise TypeError(
                f"{name}: got {dist.owner.op}, of which PyMC has no density, expected one that it "
                "has, since responses are stored and weighed by it; give a pm.CustomDist its "
                "logp=, or use propagation=prb.Fresh()"
            )


def valid(inputs: Inputs, aleatory: Sequence[TensorVariable]) -> TensorVariable:
    """Return whether the parameters of all aleatory inputs are valid, a boolean scalar."""
    from pymc.logprob.utils import CheckParameterValue

    if inputs.nested:
        return pt.constant(True)
    # The densities check their parameters, such as sigma > 0, wherever they are evaluated; what has
    # none says nothing of its parameters.
    logps = [density for d in aleatory if (density := _density(d)) is not None]
    conditions = []
    for v in ancestors(logps):
        if v.owner is not None and isinstance(v.owner.op, CheckParameterValue):
            _, *checked = v.owner.inputs
            conditions += [pt.all(c) for c in checked]
    return pt.all(conditions) if conditions else pt.constant(True)


def _generators(function: Any) -> list[Any]:
    """Return the random number generators of a compiled function."""
    return [v for v in function.get_shared() if isinstance(v.type, RandomGeneratorType)]


def _seed(generators: Sequence[Any], rng: np.random.Generator) -> None:
    """Give each generator a stream of its own."""
    for shared, child in zip(generators, rng.spawn(len(generators)), strict=True):
        shared.set_value(child, borrow=True)


class PriorSampler:
    """Draws of variables from the prior, all in one call of a function that is compiled once."""

    @untraced()
    def __init__(self, roots: Sequence[TensorVariable]) -> None:
        self._names = ", ".join(str(r.name) for r in roots)
        self._shapes = [event_shape(r) for r in roots]
        n = pt.iscalar("n")
        try:
            # Variables that depend on no other are drawn n times; the others follow.
            batches = {}
            drawn = [*roots, *_model_variables_above(roots)]
            for root in drawn:
                if not any(a in drawn for a in ancestors([root]) if a is not root):
                    batches[root] = change_dist_size(root, (n,), expand=True)
            outputs = vectorize_graph(list(roots), batches)
            with interpreted():
                self._function = pm.compile([n], outputs, mode=PLAIN)
            self._batched = True
        except (NotImplementedError, ValueError, MissingInputError):
            # Not vectorized, or not resized: one draw at a time.
            with interpreted():
                self._function = pm.compile([n], list(roots), mode=PLAIN, on_unused_input="ignore")
            self._batched = False
        self._generators = _generators(self._function)

    def __call__(self, k: int, seed: int) -> list[Floats]:
        """Return k draws of each variable, shapes (k, *shape)."""
        _seed(self._generators, np.random.default_rng(seed))
        try:
            if self._batched:
                # Samplers of SciPy's drop leading axes of length one.
                pairs = zip(self._function(k), self._shapes, strict=True)
                return [np.asarray(v).reshape(k, *shape) for v, shape in pairs]
            draws = [self._function(k) for _ in range(k)]
        except NotImplementedError as error:
            raise TypeError(
                f"priors: got {self._names}, of which one cannot be drawn ({error}), expected "
                "proper priors; replace pm.Flat and pm.HalfFlat by a wide pm.Normal or "
                "pm.HalfNormal"
            ) from None
        return [np.array(column) for column in zip(*draws, strict=True)]


def _model_variables_above(roots: Sequence[TensorVariable]) -> list[TensorVariable]:
    """Return the other random variables of a model that variables depend on."""
    # PyMC gives a `str_repr` to the variables of a model.
    above = [v for v in ancestors(roots) if hasattr(v, "str_repr") and is_random(v)]
    return [v for v in above if v not in roots]


def prior_draws(roots: Sequence[TensorVariable], k: int, seed: int) -> list[Floats]:
    """Draw the roots k times from the prior; arrays of shape (k, *shape)."""
    return PriorSampler(roots)(k, seed)


class PriorPoints:
    """Points of the unit cube brought to the prior, each variable given those above it.

    Raises
    ------
    TypeError
        If a variable has no inverse distribution function.
    """

    @untraced()
    def __init__(self, variables: Sequence[TensorVariable]) -> None:
        self._shapes = [event_shape(v) for v in variables]
        self._sizes = [int(np.prod(s, dtype=int)) for s in self._shapes]
        self.size = sum(self._sizes)
        symbols = [pt.tensor(dtype="float64", shape=s) for s in self._shapes]
        placed: dict[Variable, Variable] = {}
        for v, u in zip(variables, symbols, strict=True):
            (given,) = graph_replace([v], placed, strict=False)
            placed[v] = quantiles("priors", given, u)
        if any(is_random(v) for v in ancestors(list(placed.values()))):
            raise TypeError(
                "priors: got one that depends on a random variable which is not in the model"
            )
        self._function = compile_batched(symbols, list(placed.values()))

    def __call__(self, cube: Floats) -> list[Floats]:
        """Return values of each variable, shapes (k, *shape), for points of shape (k, size)."""
        edges = np.cumsum([0, *self._sizes])
        parts = []
        for (a, b), shape in zip(pairwise(edges), self._shapes, strict=True):
            parts.append(cube[:, a:b].reshape(len(cube), *shape))
        return [np.asarray(v) for v in self._function(*parts)]


class PopulationSampler:
    """Random draws of n specimens from the populations at given roots."""

    @untraced()
    def __init__(self, inputs: Inputs) -> None:
        self._names = ", ".join(str(x.owner.op) for x in inputs.aleatory)
        symbols = inputs.placeholders()
        aleatory, epistemic = inputs.rebuilt(symbols)
        n = pt.iscalar("n")
        batched = with_leading_axis(symbols)
        per_specimen = _per_specimen(aleatory, symbols, batched, n)
        self._batched = True
        try:
            specimens = vectorize_graph(aleatory, per_specimen)
            common = epistemic
            if epistemic:
                common = vectorize_graph(epistemic, dict(zip(symbols, batched, strict=True)))
        except (NotImplementedError, ValueError):
            # What PyTensor does not vectorize: one population at a time.
            self._batched, batched = False, symbols
            # Resized before the roots are replaced, since PyMC resizes a CustomDist with its first
            # parameters.
            resized = [change_dist_size(d, (n,), expand=True) for d in inputs.aleatory]
            replaced = dict(zip(inputs.roots, symbols, strict=True))
            specimens = graph_replace(resized, replaced, strict=False)
            common = epistemic
        self._event_shapes = inputs.event_shapes
        self._epistemic_ndims = [e.type.ndim for e in epistemic]
        with interpreted():
            self._function = pm.compile(
                [n, *batched],
                [*specimens, *common],
                mode=PLAIN,
                on_unused_input="ignore",
                allow_input_downcast=True,
            )
        self._generators = _generators(self._function)

    def __call__(
        self, params: Sequence[Any], n: int, rng: np.random.Generator
    ) -> tuple[list[Floats], list[Floats]]:
        """Draw n specimens from each of k populations.

        Parameters
        ----------
        params : sequence of ndarray, shapes (k, *shape)
            Values of the roots.
        n : int
        rng : Generator

        Returns
        -------
        aleatory : list of ndarray, shapes (k, n, *event)
        epistemic : list of ndarray, shapes (k, 1, *event), or (*event) where they depend on no root
        """
        _seed(self._generators, rng)
        try:
            values = self._drawn(params, n)
        except (NotImplementedError, RuntimeError, ValueError) as error:
            reason = str(error).splitlines()[0]
            raise TypeError(
                f"inputs: got {self._names}, of which one cannot be drawn ({reason}), expected "
                "distributions from which specimens can be drawn; give a pm.CustomDist its random="
            ) from None
        n_aleatory = len(self._event_shapes)
        aleatory = []
        for v, shape in zip(values[:n_aleatory], self._event_shapes, strict=True):
            # SciPy's generators, behind some distributions, drop leading axes of length one.
            aleatory.append(np.reshape(v, (len(params[0]), n, *shape)))
        epistemic = []
        for v, ndim in zip(values[n_aleatory:], self._epistemic_ndims, strict=True):
            epistemic.append(v[:, None] if v.ndim > ndim else v)
        return aleatory, epistemic

    def _drawn(self, params: Sequence[Any], n: int) -> list[Floats]:
        """Return all inputs, of n specimens from each of k populations."""
        if self._batched:
            return list(self._function(n, *params))
        populations = [self._function(n, *row) for row in zip(*params, strict=True)]
        return [np.stack(column) for column in zip(*populations, strict=True)]


def _per_specimen(
    aleatory: Sequence[TensorVariable],
    symbols: Sequence[TensorVariable],
    batched: Sequence[TensorVariable],
    n: TensorVariable,
) -> dict[Variable, Variable]:
    """Return what stands for roots and distributions in a graph of n specimens of each theta."""
    size = (batched[0].shape[0], n)
    replaced: dict[Variable, Variable] = {}
    for symbol, batch in zip(symbols, batched, strict=True):
        shape = [batch.shape[i] for i in range(1, batch.ndim)]
        replaced[symbol] = pt.broadcast_to(batch[:, None], (*size, *shape))
    # Distributions without any root above them are not batched by their parameters: resize them.
    for v in ancestors(aleatory):
        if not is_random(v):
            continue
        above = [a for a in ancestors([v]) if a is not v]
        if not any(a in symbols or is_random(a) for a in above):
            replaced[v] = change_dist_size(v, size, expand=True)
    return replaced
