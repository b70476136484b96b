"""Known values of each specimen: its load, dose or temperature, or a covariate of its population.

A condition is a random variable with a known distribution over its range: the log-likelihood by
specimen emulates the response over inputs and conditions, and takes the value of each specimen.
Times of readings, several for each specimen, are a constant vector of all times.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytensor.tensor as pt
from numpy.typing import ArrayLike
from pytensor.graph.basic import Variable
from pytensor.graph.traversal import ancestors
from pytensor.tensor.random.basic import UniformRV
from pytensor.tensor.variable import TensorConstant, TensorVariable

from prbayes._validate import Floats, Indices, NamedArrays, plain_text, real_array
from prbayes.response.outputs import specimen_index


class ConditionRV(UniformRV):  # type: ignore[misc]
    """A condition: uniform over the range of its values and a tenth of the range on either side."""

    is_condition = True
    __props__ = (*UniformRV.__props__, "label", "values")

    def __init__(self, *, label: str, values: tuple[float, ...], **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.label = label
        self.values = values

    @property
    def range(self) -> tuple[float, float]:
        """Lower and upper end of the distribution, which keep the sign of the values."""
        low = min(self.values)
        high = max(self.values)
        margin = 0.1 * (high - low)
        lower = low - margin if low < 0 or low > margin else 0.9 * low
        upper = high + margin if high > 0 or high < -margin else 0.9 * high
        return lower, upper

    @property
    def scale(self) -> tuple[bool, float, float]:
        """Whether the coordinate is logarithmic, and its center and half width.

        In units of the half width the range is from -1 to 1.
        """
        low, high = self.range
        is_log = low > 0 and high > 10 * low
        low, high = (np.log(low), np.log(high)) if is_log else (low, high)
        return is_log, (low + high) / 2, (high - low) / 2

    def coordinates(self, values: Floats) -> Floats:
        """Return the coordinates of values, from -1 to 1 within the range."""
        is_log, center, half_width = self.scale
        return ((np.log(values) if is_log else values) - center) / half_width


class ReadingsCondition(TensorConstant):  # type: ignore[misc]
    """The sorted values of a vector condition, (G,), with the value of each reading."""

    columns: Indices  # index of the value of each reading, (N, T); -1 marks a missing reading


def condition(name: str, values: ArrayLike) -> TensorVariable:
    """Return a value that is known for each specimen, such as its load, dose or hardness.

    As an input of a response it is the condition under which the specimen was measured. In the
    parameters of a ``.dist()`` it is a covariate: the population depends on it. Times, or other
    values of which each specimen has several, are an input of a response with an output for each.

    Parameters
    ----------
    name : str
        Name of the condition.
    values : array_like, shape (N,) or (N, T)
        Its value for each specimen, in the order of the observed values. With T values for each
        specimen, NaN where there are fewer, ``observed`` has the shape (N, T) too.

    Returns
    -------
    TensorVariable
        A number of one specimen, or the vector (G,) of all different values of specimens with
        several, sorted. Call this once, and use it for all inputs.

    Raises
    ------
    TypeError, ValueError
        If the values are not finite numbers, or all equal, or if specimens with several values have
        one of them twice, or more than 200 different ones in all.

    Notes
    -----
    A response with a vector of values returns as many outputs, each of which depends on its own
    value alone. With a condition of one number the emulator has one more input.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> load = prb.response.condition("load", [1.0, 2.0, 3.0])
    >>> load.name
    'load'
    >>> time = prb.response.condition("time", [[0.5, 2.0], [1.0, 2.0], [2.0, np.nan]])
    >>> time.eval()
    array([0.5, 1. , 2. ])
    """
    caller = f"prb.response.condition({name!r}, ...)"
    plain_text(name, f"{caller}: name")
    array = real_array(values, f"{caller}: values").astype(float)
    if array.ndim == 2 and len(array) > 1:
        return _labelled(_vector(name, array, caller), values)
    if array.ndim != 1 or len(array) < 2 or not np.isfinite(array).all():
        raise ValueError(
            f"{caller}: values: got shape {array.shape}, {int((~np.isfinite(array)).sum())} of "
            "them not finite, expected a finite number for each of at least two specimens, or a "
            "row of numbers for each, padded with NaN"
        )
    if array.min() == array.max():
        raise ValueError(
            f"{caller}: values: got {array[0]} for all specimens, expected different values; pass "
            "the number itself as an input"
        )
    op = ConditionRV(label=name, values=tuple(array.tolist()))
    rng = pt.random.shared_rng(seed=None)
    _, variable = op(*op.range, rng=rng, return_next_rng=True)
    variable.name = name
    return _labelled(variable, values)


def _labelled(variable: TensorVariable, values: ArrayLike) -> TensorVariable:
    """Attach values with an index to a condition, so that the index is compared with observed."""
    if specimen_index(values) is not None:
        variable.tag.labelled = values
    return variable


def _vector(name: str, array: Floats, caller: str, most: int = 200) -> TensorVariable:
    """Return all different values of specimens with several values, (N, T), as a constant."""
    is_number = ~np.isnan(array)
    if np.isinf(array).any() or not is_number.any(axis=1).all():
        raise ValueError(
            f"{caller}: values: got infinite values, or a row without a number, expected finite "
            "numbers for each specimen, padded with NaN"
        )
    distinct, inverse = np.unique(array[is_number], return_inverse=True)
    if len(distinct) > most:
        raise ValueError(
            f"{caller}: values: got {len(distinct)} different values, expected at most "
            f"{most}, since the emulator has an output for each; round them, as in "
            "np.round(values, 1)"
        )
    columns = np.full(array.shape, -1)
    columns[is_number] = inverse
    for row, of_row in enumerate(columns):
        places = of_row[of_row >= 0]
        if len(np.unique(places)) < len(places):
            raise ValueError(
                f"{caller}: values: got a value twice in row {row}, {array[row].tolist()!s:.60}, "
                "expected different ones in a row; pass the mean of readings at the same value"
            )
    constant = ReadingsCondition(pt.dvector().type, distinct, name=name)
    constant.columns = columns
    return constant


def known_covariates(
    name: str, covariates: Sequence[Any], size: int, rows: Indices | None
) -> NamedArrays:
    """Return the values of covariates for each specimen, (N,), by name.

    With frequencies, ``rows`` is the row of the observed values that each specimen comes from.
    """
    result = {}
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


def refuse_vectors_of_specimens(
    name: str, aleatory: Sequence[Any], parents: Sequence[Variable], size: int
) -> None:
    """Raise if an input is a vector with an element for each specimen, as is usual in PyMC.

    Also raise if it depends on a condition that has several values for each specimen.
    """
    for x in aleatory:
        batch = x.type.ndim - getattr(x.owner.op, "ndim_supp", 0)
        if is_condition(x):
            continue
        above = list(ancestors(x.owner.inputs, blockers=parents))
        for v in above:
            if isinstance(v, ReadingsCondition):
                raise TypeError(
                    f"{name}: inputs: got {x.name or 'a .dist()'} with parameters from {v.name}, "
                    f"whose values have the shape {v.columns.shape}, expected one value for each "
                    "specimen; pass values of shape (N,) to prb.response.condition"
                )
        for v in above if batch == 1 else ():
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
    # Not isinstance: a module may be loaded twice, and then has two classes.
    return variable.owner is not None and getattr(variable.owner.op, "is_condition", False)
