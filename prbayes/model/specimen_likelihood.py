"""The observed variable of the log-likelihood by specimen, as PyMC evaluates it.

Its log-density is a vector with an element for each specimen,

    log p(y_i | theta) = logsumexp_k(log p(x_ik | theta) + A_ik),

a graph of PyMC's own log-densities of the inputs at points x_ik. Points and numbers A_ik are
computed at the first use, from runs and an emulator (`prbayes.propagation.specimen_points`). They
contain no hyperparameter, so that NUTS, SMC and optimisers evaluate the graph without a run.
"""

from __future__ import annotations

import logging
import weakref
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import pymc as pm
import pytensor
import pytensor.tensor as pt
from numpy.typing import NDArray
from pymc.logprob.abstract import _logprob
from pymc.logprob.utils import CheckParameterValue
from pytensor.graph.basic import Apply, Constant
from pytensor.graph.replace import graph_replace, vectorize_graph
from pytensor.tensor.random.op import RandomVariable
from pytensor.tensor.variable import TensorVariable

from prbayes._checks import Floats
from prbayes._finding import Finding
from prbayes.metrics.likelihood import LogLikelihood
from prbayes.model.node import known_value, required_simulators, response_name
from prbayes.propagation.base import Propagation
from prbayes.propagation.coordinates import Coordinates
from prbayes.metrics.readings import Readings
from prbayes.propagation.specimen_points import (
    Emulation,
    PointOptions,
    SpecimenPoints,
    draw_points,
    emulate,
)
from prbayes.response.distributions import PopulationSampler, log_density
from prbayes.response.grouping import is_group
from prbayes.response.inputs import Inputs
from prbayes.response.outputs import Outputs
from prbayes.response.response import Responses

_log = logging.getLogger("prbayes")


@dataclass(frozen=True, eq=False)
class SpecimenLikelihood:
    """One simulator whose metric is the log-likelihood by specimen.

    Attributes
    ----------
    name : str
    metric : LogLikelihood
    observed : ndarray, shape (N,) or (N, m)
    readings : Readings
    weights : ndarray, shape (N,), or None
        Factors of the specimens' log-likelihoods, which sum to N.
    specimens : ndarray, shape (N,), or None
        Labels.
    inputs : Inputs
    responses : Responses
    propagation : Propagation
    outputs : Outputs
    groups : ndarray of int, shape (N,), or None
        Index of each specimen's group.
    options : PointOptions
    runs : dict
        Outputs of runs by their coordinates; likelihoods of other observed responses share it.
    """

    name: str
    metric: LogLikelihood
    observed: Floats
    readings: Readings
    weights: Floats | None
    specimens: NDArray[Any] | None
    inputs: Inputs
    responses: Responses
    propagation: Propagation
    outputs: Outputs
    groups: NDArray[np.intp] | None = None
    options: PointOptions = PointOptions()
    runs: dict[bytes, Floats] = field(default_factory=dict)

    @property
    def event(self) -> tuple[int, ...]:
        """Shape of one specimen's outputs, () or (m,)."""
        return self.observed.shape[1:]

    @cached_property
    def coordinates(self) -> Coordinates:
        """Coordinates of the inputs."""
        return Coordinates.of_prior(self.inputs)

    def run(self, z: Floats) -> Floats:
        """Return the outputs of runs at coordinates, (n, d) -> (n, m); NaN where there is none."""
        keys = [row.tobytes() for row in z]
        new = [i for i, key in enumerate(keys) if key not in self.runs]
        if new:
            values = self.responses(self.coordinates.inputs(z[new]), [])
            values = values.reshape(len(new), -1)
            values = np.where(np.isfinite(values), values, np.nan)
            self.runs.update(zip([keys[i] for i in new], values, strict=True))
        return np.array([self.runs[key] for key in keys])

    @cached_property
    def _emulated(self) -> tuple[Emulation, Any]:
        d = self.coordinates.size
        box = np.stack([-np.ones(d), np.ones(d)])
        return emulate(
            self.run,
            self.readings,
            box,
            self.coordinates.bounds,
            self.options,
            n=self.propagation.emulator_runs,
            name=self.name,
        )

    @property
    def emulation(self) -> Emulation:
        """The emulator; the first access computes its runs."""
        return self._emulated[0]

    @cached_property
    def points(self) -> SpecimenPoints:
        """The points of the specimens."""
        emulation, roots = self._emulated
        return draw_points(
            emulation, emulation.error, self.readings, roots, emulation.box, self.options
        )

    @cached_property
    def arrays(self) -> tuple[list[Any], Any]:
        """Shared variables of the points, (N, K, *event) by input, and of the numbers A, (N, K)."""
        points = self.points
        # The proposal is a density of z: p(x) dx = p(x(z)) |dx/dz| dz.
        log_a = points.log_a + self.coordinates.log_jacobian(points.z)
        shared = [
            pytensor.shared(np.ascontiguousarray(x), name=f"{self.name}_points_{i}")
            for i, x in enumerate(self.coordinates.inputs(points.z))
        ]
        return shared, pytensor.shared(log_a, name=f"{self.name}_log_a")

    def log_likelihood(self, params: Sequence[Any]) -> TensorVariable:
        """Return the graph of the log-likelihoods of the specimens, (N,), of the roots' values."""
        points, log_a = self.arrays
        n, count = self.observed.shape[0], log_a.shape[1]
        symbols = self.inputs.placeholders()
        dists, _ = self.inputs.rebuilt(symbols)
        values = dict(zip(symbols, params, strict=True))
        if self.groups is not None:
            # A vector of groups in place of one makes vectors of the distributions' parameters.
            (group,) = (s for s, r in zip(symbols, self.inputs.roots, strict=True) if is_group(r))
            of_points = pt.repeat(pt.as_tensor(self.groups), count)
            dists = vectorize_graph(dists, {group: of_points})
            del values[group]
        flat = [x.reshape((n * count, *x.shape[2:]), ndim=x.ndim - 1) for x in points]
        log_p = log_density(self.inputs, dists, flat)
        # After the densities are built: PyMC may clone parameters that are random.
        (log_p,) = graph_replace([log_p], values, strict=False)
        terms = log_p.reshape((n, count)) + log_a
        likelihood = logsumexp_finite(terms)
        return likelihood if self.weights is None else likelihood * self.weights

    def draws(self, rng: np.random.Generator, roots: Sequence[Floats], n: int) -> Floats:
        """Draw the emulated responses of n specimens of each population.

        Parameters
        ----------
        rng : Generator
        roots : sequence of ndarray, shapes (P, *shape)
            Without the group of a specimen: specimens are of the groups of the observed ones.
        n : int

        Returns
        -------
        ndarray, shape (P, n) or (P, n, m)
        """
        size = len(roots[0])
        if self.groups is None:
            specimens, _ = self._sampler(roots, n, rng)
        else:
            specimens = self._of_groups(rng, roots, n)
        flat = [x.reshape(size * n, *x.shape[2:]) for x in specimens]
        return self.emulated(flat).reshape(size, n, *self.event)

    def _of_groups(
        self, rng: np.random.Generator, roots: Sequence[Floats], n: int
    ) -> list[Floats]:
        """Return specimens of each population, each of the group of an observed one."""
        assert self.groups is not None
        groups = np.resize(self.groups, n)
        drawn: list[Floats] = []
        for group in np.unique(groups):
            values = iter(roots)
            completed = [
                np.full(len(roots[0]), group) if is_group(root) else next(values)
                for root in self.inputs.roots
            ]
            columns = np.flatnonzero(groups == group)
            specimens, _ = self._sampler(completed, len(columns), rng)
            drawn = drawn or [np.empty((x.shape[0], n, *x.shape[2:])) for x in specimens]
            for whole, part in zip(drawn, specimens, strict=True):
                whole[:, columns] = part
        return drawn

    def emulated(self, inputs: Sequence[Floats]) -> Floats:
        """Return the emulator's responses of specimens, (n, *event) by input; no run is made.

        Beyond the runs' range an input has the response at the end of the range.
        """
        z = self.coordinates.of(inputs, 1)
        z = np.clip(z, self.emulation.box[0], self.emulation.box[1])
        values, _ = self.emulation(z)
        return values.reshape(len(z), *self.event)

    @cached_property
    def _sampler(self) -> PopulationSampler:
        return PopulationSampler(self.inputs)

    def observing(self, values: Floats) -> SpecimenLikelihood:
        """Return the likelihood of other observed responses, with the same runs."""
        values = np.asarray(values, dtype=np.float64)
        if values.ndim != self.observed.ndim or values.shape[1:] != self.event:
            raise ValueError(
                f"{self.name}: observed: got shape {values.shape}, expected "
                f"{('N', *self.event)}, as when the simulator was made"
            )
        readings = self.metric.readings(values.reshape(len(values), -1))
        return replace(self, observed=values, readings=readings)


def logsumexp_finite(terms: Any) -> TensorVariable:
    """Return the log of the sum of exponentials over the last axis, (N, K) -> (N,).

    -inf where all terms are -inf, with gradients of zero instead of NaN.
    """
    largest = pt.max(terms, axis=-1, keepdims=True)
    largest = pt.switch(pt.isinf(largest), 0.0, largest)
    total = pt.exp(terms - largest).sum(axis=-1)
    is_empty = pt.eq(total, 0.0)
    log_total = pt.log(pt.switch(is_empty, 1.0, total)) + largest[..., 0]
    return pt.switch(is_empty, -np.inf, log_total)


class SpecimenRV(RandomVariable):
    """The operation of the observed variable: draws data sets, and carries the likelihood.

    PyTensor's rewriters keep every operation that they have met. The likelihood with its arrays is
    therefore referenced by applications of the operation, and weakly by the operation itself.
    """

    __props__ = ("name", "signature", "dtype", "inplace", "reference")

    def __init__(
        self,
        name: str | None = None,
        signature: str | None = None,
        dtype: str = "floatX",
        inplace: bool = False,
        *,
        likelihood: SpecimenLikelihood | None = None,
        reference: Any = None,
    ) -> None:
        self.reference = reference if likelihood is None else weakref.ref(likelihood)
        function = response_name(self.likelihood.responses.function)
        label = f"Simulator of {function} by LogLikelihood"
        super().__init__(name=name or label, signature=signature, dtype=dtype, inplace=inplace)

    @property
    def likelihood(self) -> SpecimenLikelihood:
        """The log-likelihood by specimen."""
        likelihood = self.reference()
        if likelihood is None:
            raise RuntimeError("got an operation of a model that is gone")
        return likelihood

    def __str__(self) -> str:
        """Show the name and the signature, without the likelihood."""
        return f'prbayes_Simulator_rv{{"{self.signature}"}}'

    @property
    def _print_name(self) -> tuple[str, str]:
        """What PyMC prints for the distribution, as text and as LaTeX."""
        text = f"{response_name(self.likelihood.responses.function)}, LogLikelihood"
        latex = text.replace("_", "\\_")
        return f"Simulator[{text}]", f"\\operatorname{{Simulator}}[\\text{{{latex}}}]"

    def __getstate__(self) -> dict[str, Any]:
        """Replace the weak reference, which has no pickle, by the likelihood."""
        return {**self.__dict__, "reference": self.likelihood}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore the weak reference; the application keeps the likelihood."""
        self.__dict__.update(state)
        self.reference = weakref.ref(state["reference"])

    def make_node(self, *inputs: Any, **keywords: Any) -> Apply[Any, Any]:
        """Apply the operation; the application references the likelihood."""
        apply = super().make_node(*inputs, **keywords)
        apply.tag.likelihood = self.likelihood
        return apply

    def rng_fn(self, rng: np.random.Generator, *arguments: Any) -> Floats:
        """Draw responses of specimens; their shape is the last of the arguments."""
        *params, size = arguments
        likelihood = self.likelihood
        roots = []
        batch: tuple[int, ...] = ()
        for param, root in zip(params, likelihood.inputs.roots, strict=True):
            if is_group(root):
                continue
            leading = param.shape[: param.ndim - root.type.ndim]
            batch = np.broadcast_shapes(batch, leading)
            roots.append(param)
        shape = batch if size is None else tuple(int(s) for s in size)
        n = len(likelihood.observed) if not shape else shape[-1]
        # The last batch axis is that of the specimens, along which parameters have length one.
        populations = batch[:-1] if batch else ()
        event_shapes = [r.type.shape for r in likelihood.inputs.roots if not is_group(r)]
        flat = []
        for param, event in zip(roots, event_shapes, strict=True):
            ndim = len(event)
            first = param if param.ndim == ndim else param[..., 0, *(slice(None),) * ndim]
            tail = first.shape[first.ndim - ndim :]
            flat.append(np.broadcast_to(first, (*populations, *tail)).reshape(-1, *tail))
        values = likelihood.draws(rng, flat, n)
        return values.reshape(*shape, *likelihood.event)

    def _supp_shape_from_params(self, dist_params: Any, param_shapes: Any = None) -> Any:
        """Return the number of outputs of a specimen."""
        return [pt.constant(n, dtype="int64") for n in self.likelihood.event]


class SpecimenDistribution(pm.Distribution):
    """The distribution that PyMC makes the observed variable from."""

    rv_type = SpecimenRV

    @classmethod
    def rv_op(
        cls, *params: Any, likelihood: SpecimenLikelihood, size: Any = None, rng: Any = None
    ) -> TensorVariable:
        """Return a random variable that carries a likelihood."""
        ndims = [r.type.ndim for r in likelihood.inputs.roots]
        groups = [
            "(" + ",".join(f"i{k}{axis}" for axis in range(ndim)) + ")"
            for k, ndim in enumerate(ndims)
        ]
        signature = ",".join(groups) + ("->(o)" if likelihood.event else "->()")
        op = SpecimenRV(signature=signature, likelihood=likelihood)
        generator = pt.random.shared_rng(seed=None) if rng is None else rng
        _, rv = op(*params, size=size, rng=generator, return_next_rng=True)
        return rv

    @classmethod
    def dist(cls, *params: Any, **kwargs: Any) -> TensorVariable:
        """Return a random variable outside a model."""
        return super().dist(params, **kwargs)

    @staticmethod
    def support_point(rv: TensorVariable, size: Any, *params: Any) -> TensorVariable:
        """Return where a sampler would start, were the variable not observed."""
        return pt.zeros_like(rv)


@_logprob.register(SpecimenRV)  # type: ignore[untyped-decorator]
def _log_density(
    op: SpecimenRV, values: Any, rng: Any, size: Any, *params: Any, **kwargs: Any
) -> TensorVariable:
    """Return the log-likelihoods of the specimens, (N,)."""
    (value,) = values
    likelihood = op.likelihood
    data = known_value(value)
    if data is not None and not _same(data, likelihood.observed):
        likelihood = likelihood.observing(data)
    roots = [
        p if is_group(r) else p[(0,) * (p.ndim - r.type.ndim)]
        for p, r in zip(params, likelihood.inputs.roots, strict=True)
    ]
    result = likelihood.log_likelihood(roots)
    if isinstance(value, Constant):
        return result
    observed = likelihood.observed
    first = value[: len(observed)]
    equal = pt.eq(first, observed) | (pt.isnan(first) & np.isnan(observed))
    same = pt.eq(value.shape[0], len(observed)) & pt.all(equal)
    return CheckParameterValue(
        f"{likelihood.name}: got other observed values than when this was compiled, expected the "
        "same ones, whose points are part of it; compile it again, as pm.sample, prb.minimize and "
        "prb.sample_smc do"
    )(result, same)


def _same(data: Any, observed: Floats) -> bool:
    values = np.asarray(data, dtype=np.float64)
    return values.shape == observed.shape and np.array_equal(values, observed, equal_nan=True)


def specimen_likelihoods(model: pm.Model) -> dict[Any, SpecimenLikelihood]:
    """Return the likelihoods by specimen of a model, by their observed variables."""
    result = {}
    for rv in model.observed_RVs:
        if isinstance(rv.owner.op, SpecimenRV):
            likelihood = rv.owner.op.likelihood
            data = known_value(model.rvs_to_values[rv])
            if data is not None and not _same(data, likelihood.observed):
                likelihood = likelihood.observing(data)
                rv.owner.op = SpecimenRV(
                    **{**rv.owner.op._props_dict(), "reference": weakref.ref(likelihood)}
                )
                rv.owner.tag.likelihood = likelihood
            result[rv] = likelihood
    return result


def require_simulator(model: pm.Model) -> None:
    """Raise if a model has no simulator of any kind; nothing is run."""
    if not any(isinstance(rv.owner.op, SpecimenRV) for rv in model.observed_RVs):
        required_simulators(model)
