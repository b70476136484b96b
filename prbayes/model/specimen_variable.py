"""The observed variable of the log-likelihood by specimen, as PyMC evaluates it.

Its log-density is a vector with an element for each specimen. Simulators that measured the same
specimens have one likelihood: the log-density of the last one has an element for each specimen,
those of the first ones have none; their observed variables are parameters of the last one's.
"""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from typing import Any

import numpy as np
import pymc as pm
import pytensor.tensor as pt
from pymc.logprob.abstract import ValuedRV, _logprob
from pytensor.graph.basic import Apply, Constant
from pytensor.graph.replace import graph_replace
from pytensor.graph.traversal import ancestors
from pytensor.tensor.random.op import RandomVariable
from pytensor.tensor.variable import TensorVariable

from prbayes._validate import Floats, called
from prbayes.model.measurement import Measurement, SpecimenLikelihood
from prbayes.model.random_variable import (
    builds_priors_alone,
    equal_data,
    known_value,
    printed_names,
    require_data,
    required_simulators,
    response_name,
    rv_signature,
)
from prbayes.model.specimen_likelihood import draw_readings, log_likelihood_graph
from prbayes.response.inputs import is_group


class SpecimenRV(RandomVariable):  # type: ignore[misc]
    """The operation of the observed variable: draws data sets, and carries the likelihood.

    PyTensor's rewriters keep every operation that they have met. The likelihood with its arrays is
    therefore referenced by applications of the operation, and weakly by the operation itself.
    """

    __props__ = ("name", "signature", "dtype", "inplace", "reference", "simulators")

    def __init__(
        self,
        name: str | None = None,
        signature: str | None = None,
        dtype: str = "floatX",
        inplace: bool = False,
        *,
        likelihood: SpecimenLikelihood | None = None,
        reference: Any = None,
        simulators: tuple[str, ...] = (),
    ) -> None:
        self.reference = reference if likelihood is None else weakref.ref(likelihood)
        # This one, after those with the same specimens, whose observed variables are parameters.
        self.simulators = simulators
        function = response_name(self.measurement.responses.function)
        label = f"Simulator of {function} by LogLikelihood"
        super().__init__(name=name or label, signature=signature, dtype=dtype, inplace=inplace)

    @property
    def likelihood(self) -> SpecimenLikelihood:
        """The log-likelihood by specimen."""
        likelihood = self.reference()
        if likelihood is None:
            raise RuntimeError("got an operation of a model that is gone")
        return likelihood

    @property
    def measurements(self) -> list[Measurement]:
        """The measurements of `simulators`."""
        by_name = {m.name: m for m in self.likelihood.measurements}
        return [by_name[name] for name in self.simulators]

    @property
    def measurement(self) -> Measurement:
        """The measurement of this simulator."""
        return self.measurements[-1]

    @property
    def variables(self) -> tuple[TensorVariable, ...]:
        """The variables that are its first parameters."""
        return self.likelihood.variables(self.simulators)

    def __str__(self) -> str:
        """Show the name and the signature, without the likelihood."""
        return f'prbayes_Simulator_rv{{"{self.signature}"}}'

    @property
    def _print_name(self) -> tuple[str, str]:
        return printed_names(self.measurement.responses.function, "LogLikelihood")

    def __getstate__(self) -> dict[str, Any]:
        """Replace the weak reference, which has no pickle, by the likelihood."""
        return {**self.__dict__, "reference": self.likelihood}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore the weak reference; the application references the likelihood."""
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
        measurement = self.measurement
        roots = {}
        batch: tuple[int, ...] = ()
        # Readings of other simulators, the last parameters, are not part of the population.
        for param, root in zip(params, self.variables, strict=False):
            if is_group(root):
                continue
            leading = param.shape[: param.ndim - root.type.ndim]
            batch = np.broadcast_shapes(batch, leading)
            roots[root] = param
        shape = batch if size is None else tuple(int(s) for s in size)
        n = len(measurement.observed) if not shape else shape[-1]
        # The last batch axis is that of the specimens, along which parameters have length one.
        populations = batch[:-1] if batch else ()
        flat = {}
        for root, param in roots.items():
            ndim = root.type.ndim
            first = param if param.ndim == ndim else param[..., 0, *(slice(None),) * ndim]
            tail = first.shape[first.ndim - ndim :]
            flat[root] = np.broadcast_to(first, (*populations, *tail)).reshape(-1, *tail)
        values = draw_readings(self.likelihood, rng, flat, n, measurement)
        return values.reshape(*shape, *measurement.event)

    def _supp_shape_from_params(self, dist_params: Any, param_shapes: Any = None) -> Any:
        """Return the number of outputs of a specimen."""
        return [pt.constant(n, dtype="int64") for n in self.measurement.event]


class SpecimenDistribution(pm.Distribution):  # type: ignore[misc]
    """The distribution that PyMC makes the observed variable from."""

    rv_type = SpecimenRV

    @classmethod
    def rv_op(
        cls,
        *params: Any,
        likelihood: SpecimenLikelihood,
        simulators: tuple[str, ...],
        size: Any = None,
        rng: Any = None,
    ) -> TensorVariable:
        """Return a random variable that carries a likelihood."""
        *earlier, last = (m for m in likelihood.measurements if m.name in simulators)
        ndims = [v.type.ndim for v in likelihood.variables(simulators)]
        ndims += [m.observed.ndim for m in earlier]
        signature = rv_signature(ndims, len(last.event))
        op = SpecimenRV(signature=signature, likelihood=likelihood, simulators=simulators)
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
    """Return the log-likelihoods of the specimens, (S,); none where a later simulator has them."""
    (value,) = values
    if builds_priors_alone() or op.measurement is not op.likelihood.measurements[-1]:
        return pt.zeros(0)
    variables = op.variables
    roots = {
        v: p if is_group(v) else p[(0,) * (p.ndim - v.type.ndim)]
        for v, p in zip(variables, params, strict=False)
    }
    measurements: Sequence[Measurement] = op.measurements
    earlier = zip(params[len(variables) :], measurements[:-1], strict=True)
    data = [_without_marks(p[(0,) * (p.ndim - m.observed.ndim)]) for p, m in earlier] + [value]
    numbers = {m.name: known_value(v) for m, v in zip(measurements, data, strict=True)}
    likelihood = op.likelihood.observing(numbers)
    result = log_likelihood_graph(likelihood, roots)
    conditions = [
        equal_data(v, m.observed)
        for m, v in zip(likelihood.measurements, data, strict=True)
        if not all(isinstance(leaf, Constant) for leaf in ancestors([v]) if leaf.owner is None)
    ]
    if not conditions:
        return result
    return require_data(
        op.measurement.name,
        "whose points are part of it",
        result,
        pt.all(pt.stack(conditions)),
    )


def _without_marks(variable: Any) -> Any:
    """Return a parameter without the marks by which PyMC separates variables that have a value."""
    marks = {
        v: v.owner.inputs[0]
        for v in ancestors([variable])
        if v.owner is not None and isinstance(v.owner.op, ValuedRV)
    }
    return graph_replace([variable], marks)[0] if marks else variable


def specimen_likelihoods(model: pm.Model) -> dict[Any, SpecimenLikelihood]:
    """Return the likelihoods by specimen of a model, by their observed variables.

    Simulators with common specimens have the same one.
    """
    if not isinstance(model, pm.Model):
        raise TypeError(f"model: got {called(model)}, expected a pm.Model")
    rvs = [rv for rv in model.observed_RVs if isinstance(rv.owner.op, SpecimenRV)]
    data = {rv.owner.op.simulators[-1]: known_value(model.rvs_to_values[rv]) for rv in rvs}
    result = {rv: rv.owner.op.likelihood for rv in rvs}
    current = {old: old.observing(data) for old in result.values()}
    for rv, old in result.items():
        if current[old] is not old:
            set_likelihood(rv, current[old])
    return {rv: current[old] for rv, old in result.items()}


def set_likelihood(rv: Any, likelihood: SpecimenLikelihood) -> None:
    """Give an observed variable another likelihood."""
    properties = {**rv.owner.op._props_dict(), "reference": weakref.ref(likelihood)}
    rv.owner.op = SpecimenRV(**properties)
    rv.owner.tag.likelihood = likelihood


def measurements_of(model: pm.Model) -> dict[Any, Measurement]:
    """Return the simulators with a log-likelihood by specimen, by their observed variables."""
    return {rv: rv.owner.op.measurement for rv in specimen_likelihoods(model)}


def require_simulator(model: pm.Model) -> None:
    """Raise if a model has no simulator of any kind; nothing is run."""
    if not any(isinstance(rv.owner.op, SpecimenRV) for rv in model.observed_RVs):
        required_simulators(model)
