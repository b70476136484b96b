"""Known values of each specimen: its load, dose or temperature, or a covariate of its population.

A condition is a random variable with a known distribution over its range: the log-likelihood by
specimen emulates the response over inputs and conditions, and takes the value of each specimen.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytensor.tensor as pt
from numpy.typing import ArrayLike, NDArray
from pytensor.graph.basic import Variable
from pytensor.graph.traversal import ancestors
from pytensor.tensor.random.basic import UniformRV
from pytensor.tensor.variable import TensorVariable

from prbayes._validate import Floats, plain_text, real_array


class ConditionRV(UniformRV):  # type: ignore[misc]
    """A condition that is uniformly distributed beyond the range of its values by a tenth."""

    is_condition = True
    __props__ = (*UniformRV.__props__, "label", "values")

    def __init__(self, *, label: str, values: tuple[float, ...], **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.label = label
        self.values = values


def condition(name: str, values: ArrayLike) -> TensorVariable:
    """Return a value that is known for each specimen, such as its load, dose or hardness.

    As an input of a response it is the condition under which the specimen was measured. In the
    parameters of a ``.dist()`` it is a covariate: the population depends on it.

    Parameters
    ----------
    name : str
        Name of the condition.
    values : array_like, shape (N,)
        Its value for each specimen, in the order of the observed values.

    Returns
    -------
    TensorVariable
        A number of one specimen. Call this once, and use it for all inputs.

    Raises
    ------
    TypeError, ValueError
        If the values are not finite numbers, or all equal.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> load = prb.response.condition("load", [1.0, 2.0, 3.0])
    >>> load.name
    'load'
    """
    caller = f"prb.response.condition({name!r}, ...)"
    plain_text(name, f"{caller}: name")
    array = real_array(values, f"{caller}: values").astype(float)
    if array.ndim != 1 or len(array) < 2 or not np.isfinite(array).all():
        raise ValueError(
            f"{caller}: values: got shape {array.shape}, {int((~np.isfinite(array)).sum())} of "
            "them not finite, expected a finite number for each of at least two specimens"
        )
    low, high = array.min(), array.max()
    if low == high:
        raise ValueError(
            f"{caller}: values: got {low} for all specimens, expected different values; pass the "
            "number itself as an input"
        )
    margin = 0.1 * (high - low)
    op = ConditionRV(label=name, values=tuple(array.tolist()))
    rng = pt.random.shared_rng(seed=None)
    _, variable = op(low - margin, high + margin, rng=rng, return_next_rng=True)
    variable.name = name
    return variable


def known_covariates(
    name: str, covariates: Sequence[Any], size: int, rows: NDArray[np.intp] | None
) -> dict[str, Floats]:
    """Return the covariates of the specimens, (N,), by name, from those of the observed rows.

    With frequencies, ``rows`` are those of the specimens.
    """
    result: dict[str, Floats] = {}
    for variable in covariates:
        label = str(variable.name)
        values = np.array(variable.owner.op.values)
        if label in result:
            raise ValueError(
                f"{name}: inputs: got two calls of prb.response.condition({label!r}, ...), "
                "expected one; call it once, and use what it returns for all inputs"
            )
        if len(values) != size:
            raise ValueError(
                f"{name}: inputs: got {len(values)} values of {label}, expected {size}, one for "
                "each observed specimen"
            )
        result[label] = values if rows is None else values[rows]
    return result


def refuse_covariates(name: str, covariates: Sequence[Any]) -> None:
    """Raise where a metric compares one population with the specimens of many."""
    if covariates:
        raise TypeError(
            f"{name}: inputs: got a population that depends on {covariates[0].name}, expected one "
            "population, as a metric compares distributions; use metric=prb.LogLikelihood(), or "
            "prb.response.group for few different values"
        )


def refuse_vectors_of_specimens(
    name: str, aleatory: Sequence[Any], parents: Sequence[Variable], size: int
) -> None:
    """Raise where an input is a vector with an element for each specimen, as in PyMC."""
    for x in aleatory:
        batch = x.type.ndim - getattr(x.owner.op, "ndim_supp", 0)
        if is_condition(x) or batch != 1:
            continue
        for v in ancestors(x.owner.inputs, blockers=parents):
            data: Any = v.get_value() if hasattr(v, "get_value") else getattr(v, "data", None)
            if np.shape(data) == (size,) and np.ptp(data) > 0:
                label = v.name or "hardness"
                raise TypeError(
                    f"{name}: inputs: got {x.name or 'a .dist()'} with parameters from an array of "
                    f"{size} values, as many as there are specimens, expected the distribution of "
                    f"one specimen; write {label} = prb.response.condition({label!r}, values), and "
                    f"x = pm.LogNormal.dist(a + b * {label}, sigma)"
                )


def is_condition(variable: Variable) -> bool:
    """Return whether a variable is a condition of a specimen."""
    # By an attribute, not by its class: a module may be loaded twice.
    return variable.owner is not None and getattr(variable.owner.op, "is_condition", False)
