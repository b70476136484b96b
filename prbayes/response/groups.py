"""Groups of specimens, such as suppliers or batches, with their hyperparameters."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pymc as pm
import pytensor.tensor as pt
from numpy.typing import NDArray
from pytensor.graph.basic import Variable
from pytensor.tensor.random.op import RandomVariable
from pytensor.tensor.variable import TensorVariable

from prbayes._validate import plain_text, real_array


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
        """Draw groups; the number of them and the shape are the arguments."""
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
        known = [name for name, values in model.coords.items() if values is not None]
        raise ValueError(
            f"{caller}: dim: got {dim!r}, expected a dimension with a coordinate, of {known}; "
            f"write pm.Model(coords={{{dim!r}: ['Adler', 'Busch']}}), with the names of the groups"
        )
    names = [str(label) for label in labels]
    # A slash ends a name in a file.
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
    # By an attribute, not by its class: a module may be loaded twice.
    return variable.owner is not None and getattr(variable.owner.op, "is_group", False)


def groups_of(name: str, roots: Iterable[Variable]) -> Groups | None:
    """Return the groups among the roots of inputs, None if there are none; several are refused."""
    ops = [variable.owner.op for variable in roots if is_group(variable)]
    if not ops:
        return None
    if len(ops) > 1:
        raise ValueError(
            f"{name}: inputs: got {len(ops)} calls of prb.response.group, of "
            f"{[op.dim for op in ops]}, expected one; call it once, and use what it returns for "
            "all inputs; two partitions are one whose groups are their pairs"
        )
    return Groups(ops[0].dim, ops[0].labels)


def refuse_groups(name: str, roots: Iterable[Variable]) -> None:
    """Raise if inputs of one population depend on the group of a specimen."""
    groups = groups_of(name, roots)
    if groups is not None:
        raise TypeError(
            f"{name}: inputs: got one that depends on prb.response.group({groups.dim!r}), expected "
            "inputs of one population; prb.predict has a population for each of "
            f"{groups.names}, whose responses can be compared"
        )


def group_indices(name: str, observed: Any, groups: Groups) -> tuple[NDArray[np.intp], Any]:
    """Return the number of each specimen's group, (N,), and the observed values without groups."""
    labels, values = _labels_and_values(f"{name}: observed", observed, groups.dim)
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


def _labels_and_values(name: str, observed: Any, dim: str) -> tuple[list[Any], Any]:
    """Return the group of each specimen, and the observed values without it."""
    if hasattr(observed, "dims") and hasattr(observed, "coords") and dim in observed.coords:
        coordinate = observed.coords[dim]
        if coordinate.dims == observed.dims[:1]:
            return coordinate.values.tolist(), observed
    if hasattr(observed, "columns") and dim in observed.columns:
        values = observed.drop(columns=dim)
        is_single = values.shape[1] == 1
        return list(observed[dim]), real_array(values.iloc[:, 0], name) if is_single else values
    index: Any = getattr(observed, "index", None)
    if dim in getattr(index, "names", ()) and not hasattr(observed, "columns"):
        return list(index.get_level_values(dim)), real_array(observed, name)
    raise TypeError(
        f"{name}: got {type(observed).__name__} without the group of each specimen, expected a "
        f"DataArray with a coordinate {dim!r} along the specimens, a DataFrame with a column of "
        "that name, or a Series with it in its index, since an input depends on "
        f"prb.response.group({dim!r})"
    )
