"""The inputs of a response: aleatory (a ``.dist()``), epistemic (a model variable) or constant."""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import pymc as pm
import pytensor.tensor as pt
from pytensor.graph.basic import Variable
from pytensor.graph.replace import graph_replace
from pytensor.graph.traversal import ancestors, walk
from pytensor.tensor.random.op import RandomVariable
from pytensor.tensor.variable import TensorVariable

from prbayes._validate import real_array
from prbayes.response.compile import PLAIN, interpreted
from prbayes.response.groups import Groups, groups_of, is_group


@dataclass(frozen=True, eq=False)
class Inputs:
    """The inputs of one response, in the order of its arguments."""

    # One entry per argument: an int (position in ``aleatory``), a variable (epistemic), or an
    # array.
    arguments: tuple[Any, ...]
    aleatory: tuple[TensorVariable, ...]  # the distinct ``.dist()`` objects
    # The model's random variables above the aleatory and epistemic inputs.
    roots: tuple[TensorVariable, ...]
    nested: bool  # whether a ``.dist()`` depends on another one

    @property
    def epistemic(self) -> tuple[TensorVariable, ...]:
        """The arguments that are model variables, or functions of them."""
        return tuple(a for a in self.arguments if isinstance(a, Variable))

    @cached_property
    def data(self) -> dict[str, Any]:
        """The values above the inputs that can be set anew, as `pymc.Data`, by name."""
        above = walk([*self.aleatory, *self.epistemic], _inputs_of)
        found = {}
        for i, variable in enumerate(above):
            if hasattr(variable, "get_value") and isinstance(variable, TensorVariable):
                found[str(variable.name or f"shared variable {i}")] = variable
        return found

    @property
    def groups(self) -> Groups | None:
        """The groups that the inputs depend on, of which each specimen has one."""
        return groups_of("", self.roots)

    def roots_above(self, positions: Sequence[int]) -> tuple[TensorVariable, ...]:
        """Return the roots above some arguments, by their positions; none above constants."""
        known = set(self.roots)
        found: dict[TensorVariable, None] = {}
        for position in positions:
            argument = self.arguments[position]
            x = self.aleatory[argument] if isinstance(argument, int) else argument
            if isinstance(x, Variable):
                found.update((v, None) for v in _ancestry(x, known) if v in known)
        return tuple(found)

    def ordered_as(self, other: Inputs) -> Inputs:
        """Return the same arguments with the aleatory inputs in the order of equal ones."""
        places = [other.aleatory.index(x) for x in self.aleatory]
        arguments = tuple(places[a] if isinstance(a, int) else a for a in self.arguments)
        return replace(self, arguments=arguments, aleatory=other.aleatory, roots=other.roots)

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
        common = iter(epistemic)
        filled = []
        for a in self.arguments:
            if isinstance(a, Variable):
                filled.append(next(common))
            else:
                filled.append(aleatory[a] if isinstance(a, int) else a)
        return filled

    @cached_property
    def event_shapes(self) -> tuple[tuple[int, ...], ...]:
        """Event shape of each aleatory input, evaluated where it is not static."""
        return tuple(event_shape(x) for x in self.aleatory)

    @property
    def dimensions(self) -> int:
        """Number of aleatory numbers that make one specimen."""
        return sum(int(np.prod(shape)) for shape in self.event_shapes)

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
        If one is none of the three, if none is aleatory, or if no model variable is above any of
        them.
    """
    known: set[Variable] = set(model.basic_RVs)
    arguments: list[Any] = []
    aleatory: list[TensorVariable] = []
    roots: dict[TensorVariable, None] = {}
    within: list[set[Variable]] = []  # of each aleatory input, what it is made of besides itself
    for i, x in enumerate(inputs):
        label = f"{name}: input {i + 1}"
        if not isinstance(x, Variable):
            arguments.append(_constant(x, label))
            continue
        known.update(filter(is_group, _ancestry(x, known)))
        above = _ancestry(x, known)
        _refuse_labelled(above, label)
        roots.update((v, None) for v in above if v in known)
        latent = [v for v in above if v not in known and is_random(v)]
        _refuse_strays(x, above, latent, label)
        if x in known or not latent:
            arguments.append(x)
            continue
        if not is_random(x):
            raise TypeError(
                f"{label}: got an expression of a `.dist()` ({x}), expected the `.dist()` itself; "
                "write the expression inside the response"
            )
        if x not in aleatory:
            aleatory.append(x)
            within.append(set(latent) - {x})
        arguments.append(aleatory.index(x))
    groups_of(name, roots)
    hyperparameters = [root for root in roots if not is_group(root)]
    _refuse_too_little(name, len(inputs), bool(aleatory), bool(hyperparameters))
    nested = any(
        parts and not _marginal(x, parts) for x, parts in zip(aleatory, within, strict=True)
    )
    return Inputs(tuple(arguments), tuple(aleatory), tuple(roots), nested)


def _marginal(x: TensorVariable, parts: set[Variable]) -> bool:
    """Return whether PyMC knows the density of an input without a value of its parts.

    As of a mixture, which has copies of what it is made of.
    """
    try:
        density = quiet_logp(x, pt.zeros_like(x))
    except (NotImplementedError, TypeError, ValueError):
        return False
    return not parts & set(ancestors([density], blockers=[x]))


def quiet_logp(dist: TensorVariable, x: Any) -> TensorVariable:
    """Return PyMC's log p(x), without its warning of the parts of a random walk."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "RandomVariables", UserWarning)
        return pm.logp(dist, x, warn_rvs=False)


def _refuse_too_little(name: str, n: int, aleatory: bool, roots: bool) -> None:
    """Refuse inputs of which none varies between specimens, or none is to be calibrated."""
    if not aleatory:
        raise ValueError(
            f"{name}: got {n} inputs, none of them aleatory, expected at least one that "
            "varies between specimens; pass a distribution made with `.dist()`, such as "
            "pm.Normal.dist(mu, sigma)"
        )
    if not roots:
        raise ValueError(
            f"{name}: got inputs that depend on no variable of the model, expected hyperparameters "
            "to calibrate; give the `.dist()` parameters that are model variables, such as "
            "mu = pm.Normal('mu', 0, 1)"
        )


def _refuse_labelled(above: Sequence[Variable], label: str) -> None:
    """Refuse variables of `pymc.dims`, whose arrays carry their own names of dimensions."""
    for variable in above:
        if is_labelled(variable):
            raise TypeError(
                f"{label}: got {variable} of pymc.dims, expected variables of PyMC itself, since "
                "populations are evaluated in batches of plain arrays; write "
                "pm.Normal(..., dims=...) and pm.Normal.dist(...) for all that simulators depend on"
            )


def is_labelled(variable: object) -> bool:
    """Whether a variable is one of `pymc.dims`."""
    return isinstance(variable, Variable) and hasattr(variable.type, "dims")


def _inputs_of(variable: Variable) -> Any:
    return None if variable.owner is None else variable.owner.inputs


def _ancestry(x: Variable, known: set[Variable]) -> list[Variable]:
    """Return an input and what is above it, up to the model's variables."""

    def parents(variable: Variable) -> Any:
        if variable in known or variable.owner is None:
            return None
        return variable.owner.inputs

    return list(walk([x], parents))


def _refuse_strays(
    x: Variable, above: Sequence[Variable], latent: Sequence[Variable], label: str
) -> None:
    """Refuse an input that depends on a loose symbol, or on a variable of another model."""
    loose = [v for v in above if v.owner is None and not _is_bound(v)]
    # PyMC gives a `str_repr` to the variables of a model, and none to a `.dist()`.
    foreign = [v for v in latent if hasattr(v, "str_repr")]
    strays = [*loose, *foreign]
    if strays:
        raise TypeError(
            f"{label}: got {x} which depends on {strays[0]}, expected a `.dist()`, a variable of "
            "this model or a constant; create the variables it depends on inside the same "
            "`with pm.Model()`"
        )


def _constant(x: object, label: str) -> Any:
    try:
        array = real_array(x, label)  # type: ignore[arg-type]
    except TypeError as error:
        raise TypeError(
            f"{error}; an input is a `.dist()` (varies between specimens), a model variable "
            "(common to all) or a number"
        ) from None
    if not np.isfinite(array).all():
        raise ValueError(
            f"{label}: got a constant that is not finite ({x!r:.60}), expected a number"
        )
    if array.ndim == 0:
        return float(array)
    # Neither the user nor the response is to change it between two responses.
    array = array.copy()
    array.setflags(write=False)
    return array


def aleatory_names(inputs: Inputs, function: Callable[..., Any]) -> list[str]:
    """Return what a reader calls each aleatory input.

    The name of its distribution, or of the response's argument that takes it, or its number.
    """
    try:
        parameters = list(inspect.signature(function).parameters.values())
    except (TypeError, ValueError):
        parameters = []
    plain = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    arguments = [p.name for p in parameters if p.kind in plain]
    found = []
    for position, x in enumerate(inputs.aleatory):
        place = inputs.arguments.index(position)
        argument = arguments[place] if place < len(arguments) else f"input {place + 1}"
        found.append(str(x.name or argument))
    return found


def is_random(variable: Variable) -> bool:
    """Whether a variable of a graph is a random one: drawn, not computed."""
    if variable.owner is None:
        return False
    op = variable.owner.op
    return (
        isinstance(op, RandomVariable | pm.distributions.distribution.SymbolicRandomVariable)
        and variable is variable.owner.outputs[op.default_output or 0]
    )


def _is_bound(variable: Variable) -> bool:
    """Whether a graph's leaf has a value: constants, shared variables, generators."""
    return (
        hasattr(variable, "data")
        or hasattr(variable, "get_value")
        or not isinstance(variable, TensorVariable)
    )


def event_shape(dist: TensorVariable) -> tuple[int, ...]:
    """Return the event shape of an aleatory input, evaluated."""
    if dist.type.ndim == 0:
        return ()
    shape = dist.type.shape
    if None not in shape:
        return tuple(int(s) for s in shape if s is not None)
    with interpreted():
        drawn = pm.draw(dist, random_seed=0, mode=PLAIN)
    return tuple(int(s) for s in drawn.shape)


def model_on_context(model: pm.Model | None, caller: str) -> pm.Model:
    """Return the model given, or the one on the context, or raise.

    Within another model, the outermost: that has the variables of all.
    """
    found = pm.Model.get_context(error_if_none=False) if model is None else model
    if not isinstance(found, pm.Model):
        got = "no model on the context" if found is None else type(found).__name__
        raise TypeError(
            f"{caller}: got {got}, expected a pm.Model; "
            "call it inside `with pm.Model():` or pass model="
        )
    return found.root


# -- batches ---------------------------------------------------------------------------------------


def batch_shape(values: Sequence[Any], event_ndims: Sequence[int]) -> tuple[int, ...]:
    """Return the shape that the leading axes of arrays (..., *event) broadcast to."""
    leading = [v.shape[: v.ndim - k] for v, k in zip(values, event_ndims, strict=True)]
    return np.broadcast_shapes(*leading)


def broadcast_batch(
    values: Sequence[Any], event_ndims: Sequence[int], batch: tuple[int, ...]
) -> list[Any]:
    """Return arrays (..., *event) with their leading axes broadcast to ``batch``."""
    pairs = zip(values, event_ndims, strict=True)
    return [np.broadcast_to(v, batch + v.shape[v.ndim - k :]) for v, k in pairs]
