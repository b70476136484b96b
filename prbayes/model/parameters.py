"""`Hyperparameters`: the vector theta of a PyMC model, its names, transforms and prior draws.

Theta is the vector of the model's value variables, unconstrained through PyMC's transforms.
Elements of variables have names such as 'mu[1]' or 'mu[Adler]', by which tables show their values.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import xarray as xr
from pymc.pytensorf import join_nonshared_inputs
from pytensor.graph.replace import graph_replace, vectorize_graph

from prbayes._validate import Floats, called, real_array, refuse_single_precision
from prbayes.model.random_variable import priors_alone
from prbayes.numerics.points import sobol
from prbayes.response.compile import compiled, interpreted, ninf_for_invalid
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
        with interpreted():
            outputs, theta = self.joined(graphs)
            batch = pt.dmatrix("thetas")
            batched = vectorize_graph(ninf_for_invalid(outputs), {theta: batch})
            return compiled([batch], batched)

    @cached_property
    @interpreted()
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
    @interpreted()
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
    @interpreted()
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


# Names.


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
    axes: list[Sequence[object]] = []
    for size, coordinate in zip(shape, labels, strict=True):
        texts = [] if coordinate is None else list(map(str, np.asarray(coordinate).tolist()))
        axes.append(texts if len(set(texts)) == len(texts) == size else range(size))
    return [element_name(name, index) for index in product(*axes)]


def variable_of(element: str) -> str:
    """Return the name of the variable that an element belongs to."""
    return element.partition("[")[0]


def coordinates(model: Any, name: str) -> tuple[Any, ...]:
    """Return the coordinate of each axis of a variable of a model, None where it has none."""
    dims = model.named_vars_to_dims.get(name) or ()
    return tuple(model.coords.get(dim) for dim in dims)


def _names_of(name: Any, value: Any, leading: int = 0) -> list[str]:
    """Return the names of the elements of an array, after some leading axes."""
    labels = []
    if isinstance(value, xr.DataArray):
        labels = [value.coords[d].values if d in value.coords else None for d in value.dims]
    return element_names(str(name), np.shape(value)[leading:], labels[leading:])


# Values by name.


def split_elements(values: Mapping[Any, Any]) -> dict[str, Floats]:
    """Return arrays (n,) by the names of elements, of arrays (n, *shape) by variable.

    Names have the coordinates of the arrays.
    """
    result: dict[str, Floats] = {}
    for name, value in values.items():
        array = np.asarray(value)
        names = _names_of(name, value, leading=1)
        columns = array.reshape(len(array), len(names))
        result |= dict(zip(names, columns.T, strict=True))
    return result


def single_elements(values: Mapping[Any, Any]) -> dict[str, float]:
    """Return numbers by the names of elements, of one value of each variable."""
    result: dict[str, float] = {}
    for name, value in values.items():
        numbers = np.ravel(value).astype(float).tolist()
        result |= dict(zip(_names_of(name, value), numbers, strict=True))
    return result


# Elements and variables in tables.


def table_elements(values: Mapping[Any, Any]) -> list[str]:
    """Return the elements that a table shows, of arrays (n, *shape) by variable.

    Of a symmetric matrix, such as a correlation, each pair once; and no constant element of a
    square matrix, such as the diagonal, or the zeros of a Cholesky factor.
    """
    elements = []
    for name, value in values.items():
        is_shown = _is_informative(np.asarray(value)).ravel()
        names = _names_of(name, value, leading=1)
        elements += [element for element, shown in zip(names, is_shown, strict=True) if shown]
    return elements


def optimum_elements(point: Mapping[Any, Any], stderr: Mapping[Any, Any]) -> list[str]:
    """Return the elements that a table shows of an optimum, with standard errors by variable."""
    elements = []
    for name, value in point.items():
        estimate, error = np.asarray(value), np.asarray(stderr[name])
        # An unknown error is not zero: any number does.
        error = np.where(np.isfinite(error), error, 1.0)
        is_shown = _is_informative(np.stack([estimate - error, estimate + error])).ravel()
        names = _names_of(name, value)
        elements += [element for element, shown in zip(names, is_shown, strict=True) if shown]
    return elements


def _is_informative(array: Floats) -> Any:
    """Return which elements of arrays (n, *shape) are neither constant nor a copy, (*shape)."""
    shape = array.shape[1:]
    if len(shape) != 2 or shape[0] != shape[1] or not len(array):
        return np.ones(shape, dtype=bool)
    # A few operations change a few units in the last place.
    rounding = 1e-12 * np.abs(array).max(axis=0)
    fixed = np.ptp(array, axis=0) <= rounding
    if fixed.all():  # nothing moved: show that
        return np.ones(shape, dtype=bool)
    symmetric = np.abs(array - array.swapaxes(1, 2)) <= rounding
    return np.triu(~fixed) if symmetric.all() else ~fixed


def readable_variables(names: Iterable[str], among: Collection[str]) -> list[str]:
    """Return the variables that a table shows in place of these, each once.

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


# Draws.


def stacked_draws(posterior: Any, names: Iterable[str] | None = None) -> dict[str, xr.DataArray]:
    """Return the draws of variables, (chains x draws, *shape), with their other coordinates."""
    stacked = {}
    for name in posterior.data_vars if names is None else names:
        variable = posterior[name].transpose("chain", "draw", ...)
        values = variable.values
        dims = variable.dims[2:]
        coords = {dim: variable.coords[dim].values for dim in dims if dim in variable.coords}
        flat = values.reshape(-1, *values.shape[2:])
        stacked[str(name)] = xr.DataArray(flat, coords, ["draws", *dims])
    return stacked


def finite_draws(posterior: Any, names: Sequence[str]) -> dict[str, Floats]:
    """Return the draws of free variables, which define populations.

    Raises
    ------
    ValueError
        If one is no finite number: no population belongs to it.
    """
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


def with_coordinates(draws: Mapping[str, xr.DataArray], model: Any) -> dict[str, xr.DataArray]:
    """Return draws, (n, *shape) by variable, with a model's coordinates where they have none."""
    result = {}
    for name, values in draws.items():
        labels = coordinates(model, name)
        dims = values.dims[1:]
        for dim, coordinate in zip(dims, labels, strict=True) if len(labels) == len(dims) else ():
            is_missing = coordinate is not None and dim not in values.coords
            if is_missing and len(coordinate) == values.sizes[dim]:
                values = values.assign_coords({dim: np.asarray(coordinate)})
        result[name] = values
    return result
