"""Inputs of a response: aleatory (a ``.dist()``), epistemic, constant, or a specimen's group."""

from __future__ import annotations

import inspect
import math
import warnings
from collections.abc import Iterable, Sequence, Set
from dataclasses import dataclass
from typing import Any

import numpy as np
import pymc as pm
import pytensor.tensor as pt
from pytensor.graph.basic import Variable
from pytensor.graph.replace import graph_replace
from pytensor.graph.traversal import ancestors, walk
from pytensor.tensor.random.op import RandomVariable
from pytensor.tensor.variable import TensorVariable

from prbayes._validate import (
    NO_POPULATION,
    Function,
    Indices,
    Labels,
    Shape,
    flat_rows,
    plain_text,
    real_array,
)
from prbayes.response.compile import PLAIN, interpreted, vectorize_distributions
from prbayes.response.condition import is_condition
from prbayes.response.pymc_dims import (
    foreign_variable,
    has_dims,
    input_without_dims,
    is_random,
    values_of,
)


class Inputs:
    """The inputs of one response, in the order of its arguments."""

    def __init__(
        self,
        arguments: Sequence[Any],
        aleatory: Sequence[TensorVariable],
        parents: Sequence[TensorVariable],
        nested: bool,
    ) -> None:
        # An argument is an int (its position in ``aleatory``), a variable (epistemic) or an array.
        self.arguments = tuple(arguments)
        self.aleatory = tuple(aleatory)  # distinct ``.dist()`` objects
        # Sources of the arguments: a ``.dist()``, a variable or an array.
        self.sources = [aleatory[a] if isinstance(a, int) else a for a in self.arguments]
        self.epistemic: tuple[TensorVariable, ...] = tuple(
            [a for a in self.arguments if isinstance(a, Variable)]
        )
        self.parents = tuple(parents)  # model variables that the inputs depend on
        self.nested = nested  # whether a ``.dist()`` depends on another one
        self.groups = groups_of("", self.parents)
        # Conditions on which the parameters of a ``.dist()`` depend.
        self.covariates = tuple(filter(is_condition, self.parents))
        self.event_shapes = tuple(event_shape(x) for x in self.aleatory)
        # Positions of those aleatory inputs that are conditions, with a known value per specimen.
        self.conditions = [i for i, x in enumerate(self.aleatory) if is_condition(x)]
        self.event_ndims = [x.type.ndim for x in (*self.aleatory, *self.epistemic)]
        # Number of values of one specimen in each argument, and in all aleatory inputs.
        self.sizes = []
        for argument in self.arguments:
            if isinstance(argument, int):
                shape = self.event_shapes[argument]
            elif isinstance(argument, Variable):
                is_static = None not in argument.type.shape
                shape = argument.type.shape if is_static else argument.shape.eval()
            else:
                shape = np.shape(argument)
            self.sizes.append(int(math.prod(shape)))
        self.dimensions = sum(math.prod(shape) for shape in self.event_shapes)
        # Data that the user may change, such as `pymc.Data`, by name.
        self.data: dict[str, Any] = {
            str(variable.name or f"shared variable {i}"): variable
            for i, variable in enumerate(_ancestry([*self.aleatory, *self.epistemic]))
            if hasattr(variable, "get_value")
            and (isinstance(variable, TensorVariable) or has_dims(variable))
        }

    def parents_above(self, positions: Sequence[int]) -> tuple[TensorVariable, ...]:
        """Return the model variables on which the arguments at some positions depend."""
        ends = set(self.parents)
        parents: dict[TensorVariable, None] = {}
        for position in positions:
            x = self.sources[position]
            if isinstance(x, Variable):
                parents.update((v, None) for v in _ancestry([x], ends) if v in ends)
        return tuple(parents)

    def ordered_as(self, reference: Inputs) -> Inputs:
        """Return the same arguments with the aleatory inputs in the order of a reference."""
        places = [reference.aleatory.index(x) for x in self.aleatory]
        arguments = [places[a] if isinstance(a, int) else a for a in self.arguments]
        return Inputs(arguments, reference.aleatory, reference.parents, self.nested)

    def rebuilt(self, params: Sequence[Any]) -> tuple[list[TensorVariable], list[TensorVariable]]:
        """Return the aleatory and epistemic inputs with the parents replaced by ``params``.

        With vectors of covariates, (n,), the distributions are those of n points.
        """
        # Replace in two steps, because params may themselves depend on the parents.
        symbols = [r.type() for r in self.parents]
        values = dict(zip(symbols, map(pt.as_tensor, params), strict=True))
        vectors = {s: v for s, v in values.items() if v.type.ndim > s.type.ndim}
        new = [*self.aleatory, *self.epistemic]
        new = graph_replace(new, dict(zip(self.parents, symbols, strict=True)), strict=False)
        if vectors:
            new = vectorize_distributions(new, vectors)
        new = graph_replace(
            new, {s: v for s, v in values.items() if s not in vectors}, strict=False
        )
        # A condition may also be an input of the response, and then stays a condition.
        aleatory = [x if is_condition(x) else v for x, v in zip(self.aleatory, new, strict=False)]
        return aleatory, new[len(self.aleatory) :]

    def for_specimens(self, params: Sequence[Any], n: int) -> list[Any]:
        """Return values of the parents, (k, *shape), in which covariates are those of n specimens.

        Covariates, (k,) or (k, m), are repeated cyclically to (k, n).
        """
        return [
            flat_rows(p)[:, np.arange(n) % (p.size // len(p))] if is_condition(r) else p
            for r, p in zip(self.parents, params, strict=True)
        ]

    def for_points(self, params: Sequence[Any], count: int) -> list[Any]:
        """Return values of the parents in which each covariate is repeated ``count`` times."""
        return [
            np.repeat(p, count, axis=1) if is_condition(r) else p
            for r, p in zip(self.parents, params, strict=True)
        ]

    def fill(self, aleatory: Sequence[Any], epistemic: Sequence[Any]) -> list[Any]:
        """Return the response's arguments from values for the aleatory and the epistemic inputs."""
        common = iter(epistemic)
        filled = []
        for a in self.arguments:
            if isinstance(a, Variable):
                filled.append(next(common))
            else:
                filled.append(aleatory[a] if isinstance(a, int) else a)
        return filled

    def core(self, params: Sequence[Any]) -> list[Any]:
        """Drop the leading axes of length one that PyMC adds to a node's parameters."""
        return [p[(0,) * (p.ndim - r.type.ndim)] for p, r in zip(params, self.parents, strict=True)]

    def placeholders(self) -> list[TensorVariable]:
        """Return a new symbol for each parent; that of a covariate is a vector over points."""
        return [(pt.dvector if is_condition(r) else r.type)(name=r.name) for r in self.parents]


# -- reading ---------------------------------------------------------------------------------------


def read_inputs(
    name: str,
    inputs: Sequence[Any],
    model: pm.Model,
    *,
    fixed: bool = False,
    originals: Sequence[Variable] = (),
) -> Inputs:
    """Sort the inputs of a response into aleatory, epistemic and constant ones, or raise.

    With ``fixed`` they need not depend on a hyperparameter. If the model is a copy, ``originals``
    are the variables of its original, on which inputs may depend as well.
    """
    tensors = {v: values_of(v) for v in (*model.basic_RVs, *originals)}
    model_variables = {*tensors, *tensors.values()}
    arguments = []
    aleatory = []
    parents = {}
    is_nested = False
    for i, argument in enumerate(inputs):
        label = f"{name}: input {i + 1}"
        x = argument
        if isinstance(x, Variable):
            x = input_without_dims(x, tensors)
            if all(hasattr(v, "data") for v in _ancestry([x]) if v.owner is None):
                x = x.eval(mode=PLAIN)  # the graph has constants only
        if not isinstance(x, Variable):
            try:
                array = real_array(x, label)
            except TypeError as error:
                raise TypeError(
                    f"{error}; an input is a `.dist()` (varies between specimens), a model "
                    "variable (common to all) or a number; pass several as several inputs"
                ) from None
            if not np.isfinite(array).all():
                raise ValueError(
                    f"{label}: got a constant that is not finite ({x!r:.60}), expected a number"
                )
            # Copy it, so that neither the user nor the response changes it between two runs.
            array = array.copy()
            array.setflags(write=False)
            arguments.append(array if array.ndim else float(array))
            continue
        # A condition is an input itself, or a covariate of other inputs.
        ends = model_variables - {x}
        if not is_condition(x):
            of_specimens = list(filter(is_known, _ancestry([x], model_variables)))
            _refuse_named_expressions(label, of_specimens, model)
            model_variables.update(of_specimens)
            ends = model_variables
        ancestry = _ancestry([x], ends)
        parents.update(dict.fromkeys([v for v in ancestry if v in ends]))
        latent = [v for v in ancestry if v not in ends and is_random(v)]
        foreign = foreign_variable(argument, model_variables)
        _refuse_foreign_variables(x, ancestry, latent if foreign is None else [foreign], label)
        if x in ends or not latent:
            arguments.append(x)
            continue
        if not is_random(x):
            raise TypeError(
                f"{label}: got an expression of a `.dist()` ({x}), expected the `.dist()` itself; "
                "write the expression inside the response"
            )
        if x not in aleatory:
            aleatory.append(x)
            parts = set(latent) - {x}
            is_nested = is_nested or (bool(parts) and not _has_marginal_density(x, parts))
        arguments.append(aleatory.index(x))
    groups_of(name, parents)
    if not aleatory:
        raise ValueError(
            f"{name}: got {len(inputs)} inputs, none of them aleatory, expected at least one that "
            "varies between specimens; pass a distribution made with `.dist()`, such as "
            f"pm.Normal.dist(mu, sigma); {NO_POPULATION}"
        )
    if not fixed and all(map(is_known, parents)):  # true also without parents
        raise ValueError(
            f"{name}: got inputs that depend on no variable of the model, expected hyperparameters "
            "to calibrate; give the `.dist()` parameters that are model variables, such as "
            "mu = pm.Normal('mu', 0, 1)"
        )
    return Inputs(arguments, aleatory, list(parents), is_nested)


def _ancestry(variables: Sequence[Variable], ends: Set[Variable] = frozenset()) -> list[Variable]:
    """Return variables and their ancestors, nearest first, up to and including the ends."""

    def parents(variable: Variable) -> Any:
        return None if variable in ends or variable.owner is None else variable.owner.inputs

    return list(walk(variables, parents))


def _refuse_named_expressions(
    label: str, of_specimens: Sequence[Variable], model: pm.Model
) -> None:
    """Refuse a `pymc.Deterministic` that depends on a specimen: it has no single value."""
    for variable in of_specimens:
        for expression in model.deterministics:
            if variable in ancestors([expression]):
                raise TypeError(
                    f"{label}: got pm.Deterministic({expression.name!r}, ...) of {variable.name}, "
                    "expected an expression without a name, since it differs between specimens; "
                    "leave pm.Deterministic out"
                )


def _has_marginal_density(x: TensorVariable, parts: set[Variable]) -> bool:
    """Return whether an input, such as a mixture, has a density without its random parts."""
    try:
        density = quiet_logp(x, pt.zeros_like(x))
    except (NotImplementedError, TypeError, ValueError):
        return False
    return not parts & set(ancestors([density], blockers=[x]))


def _refuse_foreign_variables(
    x: Variable, ancestry: Sequence[Variable], latent: Sequence[Variable], label: str
) -> None:
    """Refuse symbols without a value, and variables of another model."""
    # Constants have data, and shared variables and generators have a value.
    loose = [
        v
        for v in ancestry
        if v.owner is None and not hasattr(v, "data") and not hasattr(v, "get_value")
    ]
    # PyMC marks the variables of a model by a `str_repr`, which a `.dist()` does not have.
    foreign = [v for v in latent if hasattr(v, "str_repr") or has_dims(v)]
    if loose or foreign:
        raise TypeError(
            f"{label}: got {x} which depends on {[*loose, *foreign][0]}, expected a `.dist()`, a "
            "variable of this model or a constant; create the variables it depends on inside the "
            "same `with pm.Model()`"
        )


# -- variables of a graph --------------------------------------------------------------------------


def quiet_logp(dist: TensorVariable, x: Any) -> TensorVariable:
    """Return PyMC's log p(x), without its warning about random parts of a random walk."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "RandomVariables", UserWarning)
        return pm.logp(dist, x, warn_rvs=False)


def event_shape(dist: TensorVariable) -> Shape:
    """Return the shape of one draw of an aleatory input, as numbers."""
    if dist.type.ndim == 0:
        return ()
    shape = dist.type.shape
    if None not in shape:
        return tuple(int(s) for s in shape if s is not None)
    with interpreted():
        draw = pm.draw(dist, random_seed=0, mode=PLAIN)
    return tuple(int(s) for s in draw.shape)


def argument_names(inputs: Inputs, function: Function) -> list[str]:
    """Return a name for each input: that of its variable, or of the response's argument."""
    inner = getattr(function, "function", function)  # the function inside prb.scalar
    declared = getattr(inner, "inputs", ())  # programs and units declare their inputs
    arguments = [x if isinstance(x, str) else getattr(x, "name", "") for x in declared]
    if not all(arguments) or len(arguments) != len(inputs.arguments):
        try:
            parameters = list(inspect.signature(inner).parameters.values())
        except (TypeError, ValueError):
            parameters = []
        positional = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
        arguments = [p.name for p in parameters if p.kind in positional]
    names = []
    for place, x in enumerate(inputs.sources):
        by_place = arguments[place] if place < len(arguments) else f"input {place + 1}"
        names.append(str(getattr(x, "name", None) or by_place))
    return names


def aleatory_names(inputs: Inputs, function: Function) -> list[str]:
    """Return a name for each aleatory input: of its distribution, or the response's argument."""
    names = argument_names(inputs, function)
    return [names[inputs.arguments.index(position)] for position in range(len(inputs.aleatory))]


def set_units(inputs: Inputs, function: Function, units: Labels) -> list[str]:
    """Store the units of inputs, or of their elements; return the names that have one."""
    names = aleatory_names(inputs, function)
    elements: list[str] = []
    for name, x, shape in zip(names, inputs.aleatory, inputs.event_shapes, strict=True):
        if name in units:
            x.tag.units = units[name]
        indices = list(np.ndindex(shape)) if shape else []
        by_index = {i: f"{name}[{','.join(map(str, i))}]" for i in indices}
        elements += by_index.values()
        if any(element in units for element in by_index.values()):
            default = units.get(name, "")
            x.tag.units = {i: units.get(element, default) for i, element in by_index.items()}
    return [*names, *elements]


def unit_of(x: Any, index: tuple[int, ...] = ()) -> str:
    """Return the unit of an aleatory input or of one element; an empty text if unknown."""
    units = getattr(x.tag, "units", "")
    if not isinstance(units, dict):
        return str(units)
    return str(units[index] if index else ", ".join(filter(None, units.values())))


def model_on_context(model: pm.Model | None, caller: str) -> pm.Model:
    """Return the model, by default that on the context; with nested models, the outermost."""
    if model is None:
        model = pm.Model.get_context(error_if_none=False)
    if not isinstance(model, pm.Model):
        got = "no model on the context" if model is None else type(model).__name__
        raise TypeError(
            f"{caller}: got {got}, expected a pm.Model; "
            "call it inside `with pm.Model():` or pass model="
        )
    return model.root


# -- batches ---------------------------------------------------------------------------------------


def broadcast_batch(values: Sequence[Any], event_ndims: Sequence[int]) -> tuple[Shape, list[Any]]:
    """Broadcast the leading axes of arrays (..., *event); return their shape, and the arrays."""
    pairs = list(zip(values, event_ndims, strict=True))
    batch = np.broadcast_shapes(*[v.shape[: v.ndim - k] for v, k in pairs])
    return batch, [np.broadcast_to(v, batch + v.shape[v.ndim - k :]) for v, k in pairs]


class GroupRV(RandomVariable):  # type: ignore[misc]
    """The group of a specimen as a number, by default uniformly distributed."""

    name = "group"
    signature = "()->()"
    dtype = "int64"
    is_group = True
    _print_name = ("Group", "\\operatorname{Group}")
    __props__ = ("name", "signature", "dtype", "inplace", "dim", "labels")

    def __init__(self, *, dim: str, labels: tuple[Any, ...], **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.dim = dim
        self.labels = labels

    def rng_fn(self, rng: np.random.Generator, *arguments: Any) -> Any:
        """Draw groups; the arguments are the number of groups and the shape."""
        number, size = arguments
        return rng.integers(number, size=size)


@dataclass(frozen=True)
class Groups:
    """The groups of the specimens of an input."""

    dim: str
    labels: tuple[Any, ...]

    @property
    def names(self) -> list[str]:
        """The labels as text."""
        return list(map(str, self.labels))

    def name(self, simulator: str, place: int) -> str:
        """Return the name of a group's part of a simulator, such as 'y[Adler]'."""
        return f"{simulator}[{self.names[place]}]"


def group(dim: str) -> TensorVariable:
    """Return the group of a specimen, such as its supplier, as an index of hyperparameters.

    The specimens of each group are a population. A simulator whose inputs depend on the group
    compares each population with the measured responses of its group. ``observed`` has the groups:
    a DataArray with a coordinate called ``dim`` along the specimens, a DataFrame with a column of
    that name, or a Series with it in its index. All groups share the runs of the response.

    Parameters
    ----------
    dim : str
        A dimension of the model on the context, whose coordinate names the groups.

    Returns
    -------
    TensorVariable
        A whole number. Call this once, and use it for all inputs.

    Raises
    ------
    TypeError, ValueError
        If it is no dimension of the model, or has no coordinate of two groups at least.

    Notes
    -----
    The simulator is one term of the model for each group, called ``y[Adler]`` and so on, each with
    its own epsilon. `predict` gives a dimension of groups. With a population of groups, as in
    ``pm.Normal("mu", m, tau, dims="supplier")``, the posterior is that of all groups together.

    Examples
    --------
    >>> import numpy as np, pymc as pm, xarray as xr, prbayes as prb
    >>> lengths = [0.9, 1.1, 1.4, 2.8, 3.1, 3.0]
    >>> suppliers = ["Adler", "Adler", "Adler", "Busch", "Busch", "Busch"]
    >>> data = xr.DataArray(lengths, {"supplier": ("specimen", suppliers)}, "specimen")
    >>> with pm.Model(coords={"supplier": ["Adler", "Busch"]}) as model:
    ...     mu = pm.Normal("mu", 2, 2, dims="supplier")
    ...     supplier = prb.response.group("supplier")
    ...     x = pm.Normal.dist(mu[supplier], 0.3)
    ...     y = prb.Simulator("y", np.positive, x, metric=prb.KullbackLeibler(), observed=data)
    >>> [part.name for part in y]
    ['y[Adler]', 'y[Busch]']
    >>> prb.minimize(model).point["mu"].round(1)
    array([1.1, 3. ])
    """
    caller = "prb.response.group"
    plain_text(dim, f"{caller}: dim")
    model = pm.Model.get_context(error_if_none=False)
    if model is None:
        raise TypeError(f"{caller}: got no model on the context, expected `with pm.Model():`")
    labels = model.coords.get(dim)
    if labels is None:
        dims = [name for name, values in model.coords.items() if values is not None]
        raise ValueError(
            f"{caller}: dim: got {dim!r}, expected a dimension with a coordinate, of {dims}; "
            f"write pm.Model(coords={{{dim!r}: ['Adler', 'Busch']}}), with the names of the groups"
        )
    names = [str(label) for label in labels]
    # A slash would separate groups of a netCDF file.
    if len(names) < 2 or len(set(names)) < len(names) or any("/" in name for name in names):
        raise ValueError(
            f"{caller}: coords: got the groups {names} of {dim!r}, expected two or more different "
            "names without a slash"
        )
    op = GroupRV(dim=dim, labels=tuple(labels))
    rng = pt.random.shared_rng(seed=None)
    _, variable = op(len(names), rng=rng, return_next_rng=True)
    variable.name = f"group of {dim}"
    return variable


def is_group(variable: Variable) -> bool:
    """Return whether a variable is the group of a specimen."""
    # Not isinstance: a module may be loaded twice, and then has two classes.
    return variable.owner is not None and getattr(variable.owner.op, "is_group", False)


def is_known(variable: Variable) -> bool:
    """Return whether a variable is known for each specimen: a group or a condition."""
    return is_group(variable) or is_condition(variable)


def groups_of(name: str, parents: Iterable[Variable]) -> Groups | None:
    """Return the groups that inputs depend on, or None; refuse several partitions."""
    ops = [variable.owner.op for variable in parents if is_group(variable)]
    if not ops:
        return None
    if len(ops) > 1:
        raise ValueError(
            f"{name}: inputs: got {len(ops)} calls of prb.response.group, of "
            f"{[op.dim for op in ops]}, expected one; call it once, and use what it returns for "
            "all inputs; combine two partitions into one, whose groups are their pairs"
        )
    return Groups(ops[0].dim, ops[0].labels)


def refuse_several_populations(name: str, parents: Iterable[Variable]) -> None:
    """Raise if inputs of one population depend on the group or a covariate of a specimen."""
    groups = groups_of(name, parents)
    if groups is not None:
        raise TypeError(
            f"{name}: inputs: got one that depends on prb.response.group({groups.dim!r}), expected "
            f"the .dist() of one of {groups.names} or of a new group in its place, such as "
            "pm.Normal.dist(mu[0], sigma), under a metric of distributions for prb.exceedance(..., "
            "n_points=1000) alone; prb.predict has a population for each group"
        )
    covariates = [str(v.name) for v in parents if is_condition(v)]
    if covariates:
        raise TypeError(
            f"{name}: inputs: got one that depends on prb.response.condition({covariates[0]!r}), "
            "expected a .dist() with a value of it in its parameters, such as "
            "pm.Normal.dist(a + 250 * b, sigma); prb.predict takes the value by at="
        )


def group_indices(name: str, observed: Any, groups: Groups) -> tuple[Indices, Any]:
    """Return the number of each specimen's group, (N,), and the observed values without groups."""
    labels, values = labels_and_values(f"{name}: observed", observed, groups.dim)
    texts = [str(label) for label in labels]
    place = {text: i for i, text in enumerate(groups.names)}
    unknown = [text for text in dict.fromkeys(texts) if text not in place]
    empty = [text for text in groups.names if text not in set(texts)]
    if unknown or empty:
        got = f"specimens of {unknown}" if unknown else f"no specimen of {empty}"
        raise ValueError(
            f"{name}: observed: got {got}, expected some of each of the groups {groups.names} "
            "and of no other, as the model's coords have them"
        )
    return np.array([place[text] for text in texts], dtype=np.intp), values


def labels_and_values(name: str, observed: Any, dim: str) -> tuple[list[Any], Any]:
    """Return the group label of each specimen, and the observed values without these labels."""
    if hasattr(observed, "dims") and hasattr(observed, "coords") and dim in observed.coords:
        coordinate = observed.coords[dim]
        if coordinate.dims == observed.dims[:1]:
            return coordinate.values.tolist(), observed
    values, labels = observed, None
    index: Any = getattr(observed, "index", None)
    if hasattr(observed, "columns") and dim in observed.columns:
        labels, values = observed[dim], observed.drop(columns=dim)
    elif dim in getattr(index, "names", ()):
        labels = index.get_level_values(dim)
    if labels is not None:
        is_single = hasattr(values, "columns") and values.shape[1] == 1
        return list(labels), values.iloc[:, 0] if is_single else values
    raise TypeError(
        f"{name}: got {type(observed).__name__} without the group of each specimen, expected a "
        f"DataArray with a coordinate {dim!r} along the specimens, a DataFrame with a column "
        "or an index level of that name, or a Series with it in its index, since an input depends "
        f"on prb.response.group({dim!r})"
    )
