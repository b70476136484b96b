"""`Hyperparameters`: the vector theta of a PyMC model, its names, transforms and prior draws.

Theta is the vector of the model's value variables, unconstrained through PyMC's transforms.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pymc as pm
import pytensor.tensor as pt
from pymc.pytensorf import join_nonshared_inputs
from pytensor.graph.replace import graph_replace, vectorize_graph

from prbayes._validate import Floats, called, real_array, refuse_single_precision
from prbayes.model.elements import coordinates, element_names
from prbayes.model.random_variable import priors_alone
from prbayes.numerics.points import sobol
from prbayes.response.compile import compiled, interpreted, ninf_for_invalid, untraced
from prbayes.response.distributions import PriorPoints, PriorSampler
from prbayes.response.inputs import Inputs, event_shape, is_group

# Size of a sample of thetas from a prior or a posterior; thetas cost time, but no response.
THETAS = 256


@dataclass(frozen=True, eq=False)
class Hyperparameters:
    """The free variables of a model as vectors theta of numbers, and their prior.

    Attributes
    ----------
    model : pymc.Model
    point : dict
        PyMC's initial point: values of the value variables by name.
    """

    model: pm.Model
    point: dict[str, Any]

    @classmethod
    def of(cls, model: pm.Model) -> Hyperparameters:
        """Return the hyperparameters of a model.

        Raises
        ------
        TypeError
            If one is discrete.
        """
        discrete = [v.name for v in model.value_vars if not v.dtype.startswith("float")]
        if discrete:
            raise TypeError(
                f"model: got discrete hyperparameters {discrete}, expected continuous ones; "
                "use pm.sample, or fix them"
            )
        for v in model.value_vars:
            refuse_single_precision(f"model: {v.name}", v.dtype)
        with interpreted():
            return cls(model, model.initial_point(random_seed=0))

    @cached_property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shapes of the value variables, in the order of theta."""
        return {str(v.name): np.shape(self.point[v.name]) for v in self.model.value_vars}

    @cached_property
    def initial(self) -> Floats:
        """PyMC's initial point as theta, shape (d,)."""
        return np.concatenate([np.ravel(self.point[v.name]) for v in self.model.value_vars])

    @property
    def size(self) -> int:
        """Number of elements of theta, d."""
        return self.initial.size

    # Names.

    @property
    def names(self) -> list[str]:
        """Names of the elements of theta, such as 'sigma_log__', 'mu[1]' or 'mu[Adler]'."""
        return _element_names(self, list(self.shapes))

    @property
    def readable_names(self) -> list[str]:
        """The same with the names of the untransformed variables, such as 'sigma'."""
        return _element_names(self, variable_names(self.model))

    # Functions of theta.

    def joined(self, graphs: Sequence[Any]) -> tuple[list[Any], Any]:
        """Return graphs of the value variables as graphs of one vector theta, and that vector."""
        outputs, theta = join_nonshared_inputs(self.point, list(graphs), self.model.value_vars)
        return list(outputs), theta

    def compile(self, graphs: Sequence[Any]) -> Any:
        """Compile graphs of the value variables into a function of thetas, shape (P, d).

        Where a parameter of a distribution is invalid, the result is -inf for that theta alone.
        """
        with untraced():
            outputs, theta = self.joined(graphs)
            batch = pt.dmatrix("thetas")
            batched = vectorize_graph(ninf_for_invalid(outputs), {theta: batch})
            return compiled([batch], batched)

    @cached_property
    @untraced()
    def _log_prior(self) -> Any:
        """The log-density of each free variable, in its own units, and the Jacobian of all."""
        model = self.model
        with priors_alone():
            terms = model.logp(vars=model.free_RVs, jacobian=False, sum=False)
        jacobian: Any = np.float64(0.0)
        for rv in model.free_RVs:
            transform = model.rvs_to_transforms[rv]
            if transform is not None:
                value = model.rvs_to_values[rv]
                jacobian += transform.log_jac_det(value, *rv.owner.inputs).sum()
        graphs = model.replace_rvs_by_values([pt.as_tensor(jacobian)])
        return self.compile([*(term.sum() for term in terms), *graphs])

    def log_prior_terms(self, thetas: Floats) -> dict[str, Floats]:
        """Return the log-density of each free variable in the user's own units, shapes (P,)."""
        values = self._log_prior(np.ascontiguousarray(thetas))[:-1]
        names = [str(rv.name) for rv in self.model.free_RVs]
        return {
            name: np.array(np.broadcast_to(value, len(thetas)))
            for name, value in zip(names, values, strict=True)
        }

    def log_prior(self, thetas: Floats) -> Floats:
        """Return the log prior density with the Jacobian of the transforms, shape (P,)."""
        values = self._log_prior(np.ascontiguousarray(thetas))
        return np.array(np.broadcast_to(sum(values), len(thetas)))

    def in_support(self, thetas: Floats) -> Any:
        """Return which thetas have a finite log prior, shape (P,)."""
        return np.isfinite(self.log_prior(thetas))

    @cached_property
    @untraced()
    def _constrain(self) -> Any:
        return self.compile(self.model.replace_rvs_by_values(self.model.unobserved_RVs))

    def constrained(self, thetas: Floats) -> dict[str, Floats]:
        """Return variables and deterministics, shapes (P, *shape), in the user's own units."""
        size = len(thetas)
        if not size:  # PyTensor transforms no empty matrices
            return {name: v[:0] for name, v in self.constrained(self.initial[None]).items()}
        values = self._constrain(np.ascontiguousarray(thetas))
        # Values that do not depend on theta have no leading axis, or one of length one.
        return {
            variable.name: np.array(np.broadcast_to(value, (size, *np.shape(value)[1:])))
            for variable, value in zip(self.model.unobserved_RVs, values, strict=True)
        }

    def unconstrained(self, point: Mapping[str, Any]) -> Floats:
        """Return theta, shape (d,), of a point given in the user's own units.

        Raises
        ------
        KeyError, TypeError, ValueError
            If the names are not the model's free variables, or a value is outside its support.
        """
        if not isinstance(point, Mapping):
            raise TypeError(
                f"start: got {called(point)}, expected a dict with a value for each free variable"
            )
        free = {rv.name: rv for rv in self.model.free_RVs}
        if set(point) != set(free):
            raise KeyError(
                f"start: got {sorted(map(str, point))}, expected a value for each of {sorted(free)}"
            )
        draws = []
        for name, rv in free.items():
            value = real_array(point[name], f"start: {name}")
            shape = event_shape(rv)
            if value.shape not in ((), shape):
                raise ValueError(f"start: {name}: got shape {value.shape}, expected {shape}")
            draws.append(np.broadcast_to(value, shape)[None])
        thetas = self.thetas_of(draws)
        if not (np.isfinite(thetas).all() and self.in_support(thetas).all()):
            raise ValueError(
                f"start: got {dict(point)}, expected values inside the support of the priors"
            )
        theta: Floats = thetas[0]
        return theta

    @cached_property
    @untraced()
    def _transform(self) -> Any:
        """The compiled function of values of the free variables that returns thetas."""
        free = self.model.free_RVs
        columns = []
        for value_variable in self.model.value_vars:
            rv = self.model.values_to_rvs[value_variable]
            transform = self.model.rvs_to_transforms[rv]
            value = rv if transform is None else transform.forward(rv, *rv.owner.inputs)
            columns.append(pt.atleast_1d(value).ravel())
        symbols = [rv.type() for rv in free]
        swap = dict(zip(free, symbols, strict=True))
        theta = graph_replace(pt.concatenate(columns), swap, strict=False)
        batched = [pt.tensor(dtype=s.dtype, shape=(None, *s.type.shape)) for s in symbols]
        thetas = vectorize_graph(theta, dict(zip(symbols, batched, strict=True)))
        return compiled(batched, [thetas], allow_input_downcast=True)

    def thetas_of(self, draws: Sequence[Floats]) -> Floats:
        """Return thetas, (P, d), of values of the free variables, (P, *shape), in their order."""
        (thetas,) = self._transform(*draws)
        return np.asarray(thetas)

    # The prior.

    @cached_property
    def _prior_draws(self) -> tuple[PriorSampler, dict[tuple[int, int], Floats]]:
        """The sampler of the prior, and its draws of thetas by size and seed."""
        return PriorSampler(self.model.free_RVs), {}

    def prior_thetas(self, size: int, seed: int) -> Floats:
        """Draw thetas from the prior, shape (size, d)."""
        sampler, draws = self._prior_draws
        if (size, seed) not in draws:
            draws[size, seed] = self.thetas_of(sampler(size, seed))
        return draws[size, seed].copy()

    @cached_property
    def prior_sd(self) -> Floats:
        """The prior's standard deviation of each element, robust, shape (d,).

        The unit of parameters. One is returned where it is zero or not finite.
        """
        thetas = self.prior_thetas(THETAS, seed=0)
        # Levels of a normal distribution one standard deviation above and below its mean.
        upper, lower = np.quantile(thetas, [0.84, 0.16], axis=0)
        spread = (upper - lower) / 2
        return np.where((spread > 0) & np.isfinite(spread), spread, 1.0)

    @cached_property
    def quantiles(self) -> PriorPoints | None:
        """The inverse distribution functions of the prior; None if a variable has none."""
        try:
            return PriorPoints(self.model.free_RVs)
        except TypeError:
            return None

    def prior_points(self, size: int, seed: int) -> Floats:
        """Return thetas spread evenly over the prior, shape (size, d).

        Sobol points through the inverse distribution functions, or draws where there are none.
        """
        if self.quantiles is None:
            return self.prior_thetas(size, seed)
        return _thetas_at(self, self.quantiles, sobol(size, self.quantiles.size, seed))


def variable_names(model: pm.Model) -> list[str]:
    """Return the names of the free variables, in the order of theta."""
    return [str(model.values_to_rvs[v].name) for v in model.value_vars]


def _element_names(hyperparameters: Hyperparameters, names: list[str]) -> list[str]:
    """Return the names of the elements of theta, from those of the variables."""
    model = hyperparameters.model
    elements: list[str] = []
    shapes = hyperparameters.shapes.values()
    for name, variable, shape in zip(names, variable_names(model), shapes, strict=True):
        elements += element_names(name, shape, coordinates(model, variable))
    return elements


def plain_names(hyperparameters: Hyperparameters) -> list[str]:
    """Return the names of the elements of theta with indices in place of coordinates."""
    shapes = hyperparameters.shapes.items()
    return [name for variable, shape in shapes for name in element_names(variable, shape)]


def log_posterior(
    hyperparameters: Hyperparameters, thetas: Floats, log_likelihood: Callable[[Floats], Floats]
) -> Floats:
    """Return the log prior density plus a log-likelihood, (P, d) -> (P,).

    The log-likelihood is evaluated where the prior is positive. The result is -inf where it is NaN.
    """
    thetas = np.ascontiguousarray(thetas)
    result = hyperparameters.log_prior(thetas)
    is_possible = np.isfinite(result)
    if is_possible.any():
        result[is_possible] += log_likelihood(thetas[is_possible])
    result[~np.isfinite(result)] = -np.inf
    return result


def _thetas_at(hyperparameters: Hyperparameters, quantiles: PriorPoints, cube: Floats) -> Floats:
    """Return thetas at points of the unit cube, shape (P, size)."""
    thetas = hyperparameters.thetas_of(quantiles(cube))
    return np.where(np.isfinite(thetas), thetas, hyperparameters.initial)


def fixed_points(hyperparameters: Hyperparameters, size: int) -> Floats:
    """Return thetas, shape (size, d), that do not depend on the order of the variables.

    Clones of a model may order variables in other ways.
    """
    quantiles = hyperparameters.quantiles
    if quantiles is None:
        offsets = sobol(size, hyperparameters.size, seed=0) - 0.5
        return hyperparameters.initial + _columns_by_name(offsets, plain_names(hyperparameters))
    free = hyperparameters.model.free_RVs
    names = [name for rv in free for name in element_names(rv.name, event_shape(rv))]
    cube = sobol(size, quantiles.size, seed=0)
    return _thetas_at(hyperparameters, quantiles, _columns_by_name(cube, names))


def _columns_by_name(columns: Floats, names: Sequence[str]) -> Floats:
    """Return columns of which the first is that of the first name in the alphabet, and so on."""
    result = np.empty_like(columns)
    result[:, np.argsort(names)] = columns
    return result


def roots_of(
    hyperparameters: Hyperparameters, thetas: Floats, inputs: Inputs, group: int | None
) -> list[Floats]:
    """Return the roots of inputs at thetas, in the group with this index, shapes (P, *shape)."""
    values = hyperparameters.constrained(thetas)
    return [
        np.full(len(thetas), group) if is_group(root) else values[str(root.name)]
        for root in inputs.roots
    ]
