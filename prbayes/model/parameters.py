"""`Hyperparameters`: the vector theta of a PyMC model, its names, transforms and prior draws.

Theta is the vector of the model's value variables, unconstrained through PyMC's transforms.
Elements of variables have names such as 'mu[1]' or 'mu[Adler]', by which tables show their values.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import xarray as xr
from pymc.pytensorf import join_nonshared_inputs
from pytensor.graph.replace import graph_replace, vectorize_graph

from prbayes._validate import (
    ArrayFunction,
    Arrays,
    ArraysByName,
    Floats,
    Indices,
    NamedArrays,
    NamedValues,
    Shape,
    real_array,
    refuse_single_precision,
    wrong_value,
)
from prbayes.model.random_variable import ObservedRV, building, known_value
from prbayes.numerics.points import sobol
from prbayes.response.compile import (
    compiled,
    expanded,
    interpreted,
    ninf_for_invalid,
    with_leading_axis,
)
from prbayes.response.condition import is_condition
from prbayes.response.distributions import PriorPoints, PriorSampler
from prbayes.response.inputs import Inputs, event_shape, is_group
from prbayes.response.pymc_dims import values_of, with_dims, without_dims

# Number of thetas in a sample from a prior or a posterior. More thetas take time, but no response.
THETAS = 256


@dataclass(frozen=True, eq=False)
class Hyperparameters:
    """The free variables of a model as vectors theta of numbers, and their prior."""

    model: pm.Model
    point: dict[str, Any]  # PyMC's initial point: values of the value variables by name
    initial: Floats = field(init=False)  # the initial point as theta, (d,)
    size: int = field(init=False)  # length d of theta
    # Names of the elements: 'sigma_log__', 'mu[1]' or 'mu[Adler]'.
    names: list[str] = field(init=False)
    # Names of the elements without transforms, such as 'sigma'.
    readable_names: list[str] = field(init=False)

    def __post_init__(self) -> None:
        """Set the attributes that follow from the model and the point."""
        shapes = value_shapes(self)
        values = [np.ravel(self.point[name]) for name in shapes]
        initial = np.concatenate([np.empty(0), *values])
        names = []
        readable_names = []
        for v in self.model.value_vars:
            variable = str(self.model.values_to_rvs[v].name)
            labels = coordinates(self.model, variable)
            names += element_names(str(v.name), shapes[str(v.name)], labels)
            readable_names += element_names(variable, shapes[str(v.name)], labels)
        twice = [name for name in readable_names if readable_names.count(name) > 1]
        if twice:
            raise ValueError(
                f"model: got two hyperparameters called {twice[0]!r}, an element of one and the "
                "name of another, expected different names"
            )
        vars(self).update(
            initial=initial,
            size=initial.size,
            names=names,
            readable_names=readable_names,
        )

    @classmethod
    def of(cls, model: pm.Model) -> Hyperparameters:
        """Return the hyperparameters of a model; raise a TypeError if one is discrete."""
        discrete = [v.name for v in model.value_vars if not v.dtype.startswith("float")]
        if discrete:
            raise TypeError(
                f"model: got discrete hyperparameters {discrete}, expected continuous ones; "
                "use pm.sample, or fix them"
            )
        if not model.free_RVs:
            raise ValueError(
                "model: got no free variable, expected one at least to calibrate; give a parameter "
                "of an input a prior, and leave it out of pm.do and pm.observe"
            )
        for name in {"chain", "draw"} & set(map(str, model.named_vars)):
            raise ValueError(
                f"model: got a variable called {name!r}, which is a dimension of posterior draws, "
                "expected another name"
            )
        for v in model.value_vars:
            refuse_single_precision(f"model: {v.name}", v.dtype)
        with interpreted():
            return cls(model, model.initial_point(random_seed=0))

    def joined(self, graphs: Sequence[Any]) -> tuple[list[Any], Any]:
        """Return graphs of the value variables as graphs of one vector theta, and that vector."""
        outputs, theta = join_nonshared_inputs(self.point, list(graphs), self.model.value_vars)
        return without_dims(outputs), theta

    def compile(self, graphs: Sequence[Any]) -> Any:
        """Compile graphs of the value variables into a function of thetas, shape (P, d).

        Where a parameter of a distribution is invalid, the result is -inf for that theta alone.
        """
        with interpreted():
            outputs, theta = self.joined(graphs)
            batch = pt.dmatrix("thetas")
            batched = vectorize_graph(expanded(ninf_for_invalid(outputs)), {theta: batch})
            return compiled([batch], batched)

    @cached_property
    @interpreted()
    def _log_prior(self) -> Any:
        """Log-density of each free variable, untransformed, and the Jacobian of transforms."""
        model = self.model
        with building("priors"):
            terms = model.logp(vars=model.free_RVs, jacobian=False, sum=False)
        terms = [values_of(term) for term in terms]
        jacobian = np.float64(0.0)
        for rv in model.free_RVs:
            transform = model.rvs_to_transforms[rv]
            if transform is not None:
                value = model.rvs_to_values[rv]
                jacobian += values_of(transform.log_jac_det(value, *rv.owner.inputs)).sum()
        graphs = model.replace_rvs_by_values([pt.as_tensor(jacobian)])
        return self.compile([*(term.sum() for term in terms), *graphs])

    def log_prior(self, thetas: Floats) -> Floats:
        """Return the log prior density with the Jacobian of the transforms, shape (P,)."""
        values = self._log_prior(np.ascontiguousarray(thetas))
        return np.array(np.broadcast_to(sum(values), len(thetas)))

    @cached_property
    @interpreted()
    def _constrain(self) -> Any:
        """The compiled function of thetas that returns variables and deterministics."""
        return self.compile(self.model.replace_rvs_by_values(self.model.unobserved_RVs))

    def constrained(self, thetas: Floats) -> NamedArrays:
        """Return variables and deterministics, shapes (P, *shape), in the user's own units."""
        size = len(thetas)
        if not size:  # PyTensor cannot transform empty arrays
            single = self.constrained(self.initial[None])
            return {name: value[:0] for name, value in single.items()}
        variables = self.model.unobserved_RVs
        values = self._constrain(np.ascontiguousarray(thetas))
        # Values that do not depend on theta have no leading axis, or one of length one.
        return {
            variable.name: np.array(np.broadcast_to(value, (size, *np.shape(value)[1:])))
            for variable, value in zip(variables, values, strict=True)
        }

    @cached_property
    @interpreted()
    def _transform(self) -> Any:
        """The compiled function of values of the free variables that returns thetas."""
        columns = []
        for value_variable in self.model.value_vars:
            rv = self.model.values_to_rvs[value_variable]
            transform = self.model.rvs_to_transforms[rv]
            value = rv if transform is None else transform.forward(rv, *rv.owner.inputs)
            columns.append(pt.atleast_1d(values_of(value)).ravel())
        symbols = [values_of(rv).type() for rv in self.model.free_RVs]
        swap = {v: with_dims(s, v) for v, s in zip(self.model.free_RVs, symbols, strict=True)}
        (theta,) = without_dims(graph_replace([pt.concatenate(columns)], swap, strict=False))
        batched = with_leading_axis(symbols)
        graph = vectorize_graph(theta, dict(zip(symbols, batched, strict=True)))
        return compiled(batched, [graph], allow_input_downcast=True)

    def thetas_of(self, draws: Arrays) -> Floats:
        """Return thetas, (P, d), of values of the free variables, (P, *shape), in their order."""
        (thetas,) = self._transform(*draws)
        return np.asarray(thetas)

    @cached_property
    def _prior_sampler(self) -> PriorSampler:
        """The sampler of the free variables from the prior."""
        return PriorSampler(self.model.free_RVs)

    def prior_thetas(self, size: int, seed: int) -> Floats:
        """Draw thetas from the prior, shape (size, d)."""
        return self.thetas_of(self._prior_sampler(size, seed))

    @cached_property
    def prior_sd(self) -> Floats:
        """The prior's standard deviation of each element, robust, shape (d,).

        The unit of parameters. One is returned where it is zero or not finite.
        """
        thetas = self.prior_thetas(THETAS, seed=0)
        # Normal quantiles at one standard deviation above and below the mean.
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
        thetas = self.thetas_of(self.quantiles(sobol(size, self.quantiles.size, seed)))
        return np.where(np.isfinite(thetas), thetas, self.initial)


def value_shapes(hyperparameters: Hyperparameters) -> dict[str, Shape]:
    """Return the shapes of the value variables by name, in their order in theta."""
    point = hyperparameters.point
    return {str(v.name): np.shape(point[v.name]) for v in hyperparameters.model.value_vars}


def in_support(hyperparameters: Hyperparameters, thetas: Floats) -> Any:
    """Return which thetas have a finite log prior, shape (P,)."""
    return np.isfinite(hyperparameters.log_prior(thetas))


def unconstrained(hyperparameters: Hyperparameters, point: NamedValues) -> Floats:
    """Return theta, shape (d,), of a point given in the user's own units.

    Raise KeyError, TypeError or ValueError if names are not those of the free variables, or a
    value is outside its support.
    """
    if not isinstance(point, Mapping):
        raise wrong_value(point, "start", "a dict with a value for each free variable")
    free = {rv.name: rv for rv in hyperparameters.model.free_RVs}
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
    thetas = hyperparameters.thetas_of(draws)
    if not (np.isfinite(thetas).all() and in_support(hyperparameters, thetas).all()):
        raise ValueError(
            f"start: got {dict(point)}, expected values inside the support of the priors"
        )
    theta: Floats = thetas[0]
    return theta


def log_prior_terms(hyperparameters: Hyperparameters, thetas: Floats) -> NamedArrays:
    """Return the log-density of each free variable in the user's own units, shapes (P,)."""
    values = hyperparameters._log_prior(np.ascontiguousarray(thetas))[:-1]
    return {
        str(rv.name): np.array(np.broadcast_to(value, len(thetas)))
        for rv, value in zip(hyperparameters.model.free_RVs, values, strict=True)
    }


def fixed_values(model: pm.Model) -> NamedArrays:
    """Return the values of variables that are not free, as `pymc.do` and `pymc.observe` fix them.

    Observed variables of simulators are left out.
    """
    observed = [rv for rv in model.observed_RVs if not isinstance(rv.owner.op, ObservedRV)]
    values = {str(rv.name): known_value(model.rvs_to_values[rv]) for rv in observed}
    values |= {str(v.name): v.get_value() for v in model.data_vars if hasattr(v, "get_value")}
    numbers = {name: np.asarray(value) for name, value in values.items() if value is not None}
    return {name: x.astype(np.float64) for name, x in numbers.items() if x.dtype.kind in "biuf"}


def variables_at(hyperparameters: Hyperparameters, thetas: Floats) -> NamedArrays:
    """Return all variables of the model, with those of `fixed_values`, shapes (P, *shape)."""
    size, fixed = len(thetas), fixed_values(hyperparameters.model).items()
    return hyperparameters.constrained(thetas) | {
        name: np.broadcast_to(value, (size, *value.shape)) for name, value in fixed
    }


def log_posterior(
    hyperparameters: Hyperparameters, thetas: Floats, log_likelihood: ArrayFunction
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


def fixed_points(hyperparameters: Hyperparameters, size: int) -> tuple[Floats, Indices]:
    """Return thetas, (size, d), and the alphabetical order of their elements, (d,).

    In this order the thetas are the same for clones of a model, which may order variables in other
    ways.
    """
    plain = [
        n
        for name, shape in value_shapes(hyperparameters).items()
        for n in element_names(name, shape)
    ]
    order = np.argsort(plain)
    quantiles = hyperparameters.quantiles
    if quantiles is None:
        offsets = np.empty((size, hyperparameters.size))
        offsets[:, order] = sobol(size, hyperparameters.size, seed=0) - 0.5
        return hyperparameters.initial + offsets, order
    free = hyperparameters.model.free_RVs
    names = [name for rv in free for name in element_names(rv.name, event_shape(rv))]
    cube = np.empty((size, quantiles.size))
    cube[:, np.argsort(names)] = sobol(size, quantiles.size, seed=0)
    thetas = hyperparameters.thetas_of(quantiles(cube))
    return np.where(np.isfinite(thetas), thetas, hyperparameters.initial), order


def parent_values(
    values: ArraysByName, inputs: Inputs, group: int | None, covariates: Arrays
) -> list[Floats]:
    """Return the parents of inputs, in the group with this index, shapes (P, *shape).

    Values are those of the model's variables by name, (P, *shape). Covariates, each (n,) or (P, n),
    are those of n specimens; their shape is (P, n).
    """
    size = len(next(iter(values.values())))
    remaining = iter(covariates)
    result = []
    for parent in inputs.parents:
        if is_condition(parent):
            of_specimens = next(remaining)
            result.append(np.broadcast_to(of_specimens, (size, of_specimens.shape[-1])))
        else:
            result.append(np.full(size, group) if is_group(parent) else values[str(parent.name)])
    return result


# Names of elements.


def element_name(name: str, index: Sequence[object]) -> str:
    """Return the name of an element: 'mu[1]', 'cov[0,1]', 'mu[Adler]', or 'mu' of a scalar."""
    return f"{name}[{','.join(map(str, index))}]" if index else name


def element_names(name: str, shape: Sequence[int], labels: Sequence[Any] = ()) -> list[str]:
    """Return the names of all elements of a variable, in the order of its raveled values.

    Labels are the coordinate of each axis, or None. An axis whose labels are not as many distinct
    texts has numbers.
    """
    if len(labels) != len(shape):
        labels = [None] * len(shape)
    axes = []
    for size, coordinate in zip(shape, labels, strict=True):
        texts = [] if coordinate is None else list(map(str, np.asarray(coordinate).tolist()))
        axes.append(texts if len(set(texts)) == len(texts) == size else range(size))
    return [element_name(name, index) for index in product(*axes)]


def variable_of(element: str, variables: Iterable[str] = ()) -> str:
    """Return the name of the variable that an element belongs to.

    A name among ``variables`` may have a bracket itself, such as 'mu[1]'. A bracket after a space
    is a unit, as in 'force [N]', and no index.
    """
    matches = [name for name in variables if element == name or element.startswith(f"{name}[")]
    return max(matches, key=len, default=re.split(r"(?<!\s)\[", element, maxsplit=1)[0])


def coordinates(model: Any, name: str) -> tuple[Any, ...]:
    """Return the coordinate of each axis of a variable of a model, None where it has none."""
    dims = model.named_vars_to_dims.get(name) or ()
    return tuple(model.coords.get(dim) for dim in dims)


def _element_names_of(name: Any, value: Any) -> list[str]:
    """Return the names of the elements of an array (n, *shape), with their coordinates."""
    labels = []
    if isinstance(value, xr.DataArray):
        labels = [value.coords[d].values if d in value.coords else None for d in value.dims]
    return element_names(str(name), np.shape(value)[1:], labels[1:])


# Values by name.


def split_elements(values: Mapping[Any, Any]) -> NamedArrays:
    """Return arrays (n,) by the names of elements, of arrays (n, *shape) by variable.

    Names have the coordinates of the arrays.
    """
    result: NamedArrays = {}
    for name, value in values.items():
        names = _element_names_of(name, value)
        columns = np.asarray(value).reshape(len(value), len(names))
        result |= dict(zip(names, columns.T, strict=True))
    return result


def single_elements(values: Mapping[Any, xr.DataArray]) -> dict[str, float]:
    """Return numbers by the names of elements, of one value of each variable."""
    columns = split_elements({name: value.expand_dims("row") for name, value in values.items()})
    return {name: float(column[0]) for name, column in columns.items()}


# Elements and variables in tables.


def table_elements(values: Mapping[Any, Any]) -> list[str]:
    """Return the elements that a table shows, of arrays (n, *shape) by variable.

    Of a symmetric matrix, such as a correlation, each pair once; and no constant element of a
    square matrix, such as the diagonal, or the zeros of a Cholesky factor.
    """
    elements = []
    for name, value in values.items():
        array = np.asarray(value)
        is_shown = np.ones(array.shape[1:], dtype=bool)
        if is_shown.ndim == 2 and is_shown.shape[0] == is_shown.shape[1] and len(array):
            # Rounding may change the last digits of elements that are constant.
            rounding = 1e-12 * np.abs(array).max(axis=0)
            is_fixed = np.ptp(array, axis=0) <= rounding
            is_symmetric = (np.abs(array - array.swapaxes(1, 2)) <= rounding).all()
            if not is_fixed.all():  # if all elements are constant, all of them are shown
                is_shown = np.triu(~is_fixed) if is_symmetric else ~is_fixed
        names = np.array(_element_names_of(name, value), dtype=object)
        elements += names[is_shown.ravel()].tolist()
    return elements


def optimum_elements(point: Mapping[Any, xr.DataArray], stderr: Mapping[Any, Any]) -> list[str]:
    """Return the elements that a table shows of an optimum, with standard errors by variable."""
    bounds = {}
    for name, value in point.items():
        error = np.asarray(stderr[name])
        # An unknown standard error may not count as zero, so that any positive number will do.
        error = np.where(np.isfinite(error), error, 1.0)
        pair = np.stack([value.values - error, value.values + error])
        bounds[name] = value.expand_dims(bound=2).copy(data=pair)
    return table_elements(bounds)


def readable_variables(names: Iterable[str], among: Collection[str]) -> list[str]:
    """Return the variables that a table shows, each once.

    For a `pymc.LKJCholeskyCov`, a packed factor, its standard deviations and correlations.
    """
    variables = []
    for name in names:
        unpacked = [f"{name}_stds", f"{name}_corr"]
        variables += unpacked if set(unpacked) <= set(among) else [name]
    return list(dict.fromkeys(variables))


def readable_elements(elements: Iterable[str]) -> list[str]:
    """Return elements without those of packed factors whose unpacked variables are present."""
    variables = {element: variable_of(element) for element in elements}
    names = set(variables.values())
    readable = set(readable_variables(names, names))
    return [element for element, variable in variables.items() if variable in readable]


# Draws from a posterior.


def stacked_draws(
    posterior: Any, names: Iterable[str] | None = None, model: pm.Model | None = None
) -> dict[str, xr.DataArray]:
    """Return the draws of variables, (chains x draws, *shape), with their other coordinates.

    Axes without coordinates have those of a model, if one is given.
    """
    stacked = {}
    for name in posterior.data_vars if names is None else names:
        variable = posterior[name].transpose("chain", "draw", ...)
        values = variable.values
        dims = variable.dims[2:]
        coords = {}
        if model is not None:
            labels = coordinates(model, str(name))
            for dim, size, label in zip(dims, values.shape[2:], labels, strict=False):
                if len(labels) == len(dims) and label is not None and len(label) == size:
                    coords[dim] = np.asarray(label)
        coords |= {dim: variable.coords[dim].values for dim in dims if dim in variable.coords}
        flat = values.reshape(-1, *values.shape[2:])
        stacked[str(name)] = xr.DataArray(flat, coords, ["draws", *dims])
    return stacked


def finite_draws(posterior: Any, names: Sequence[str]) -> NamedArrays:
    """Return the draws of free variables; raise a ValueError if one is not finite."""
    by_name = {name: draws.values for name, draws in stacked_draws(posterior, names).items()}
    for name, draws in by_name.items():
        is_finite = np.isfinite(draws).reshape(len(draws), -1).all(axis=1)
        if not is_finite.all():
            raise ValueError(
                f"posterior: {name}: got NaN or infinite values in {int((~is_finite).sum())} of "
                f"{is_finite.size} draws, expected finite ones; leave these draws out, or sample "
                "again"
            )
    return by_name
