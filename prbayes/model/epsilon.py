"""Epsilon by simulator, and `set_epsilon`."""

from __future__ import annotations

import numpy as np
import pymc as pm

from prbayes._checks import positive_number
from prbayes.model.node import required_nodes


def set_epsilon(model: pm.Model, epsilon: dict[str, float]) -> None:
    """Set the epsilon of simulators by name.

    Parameters
    ----------
    model : pymc.Model
    epsilon : dict
        Positive numbers by the names of simulators; others keep theirs.

    Raises
    ------
    KeyError, TypeError, ValueError
        If a name is unknown or a value is not a positive number; then nothing is changed.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu"), 1.0)
    ...     y = prb.Simulator("y", np.square, x, metric=prb.AreaMetric(), observed=[0.5, 1.0, 4.0])
    >>> prb.set_epsilon(model, {"y": 0.1})
    """
    found = {node.name: node for node in required_nodes(model).values()}
    unknown = sorted(set(epsilon) - set(found))
    if unknown:
        raise KeyError(f"epsilon: got {unknown}, expected names of simulators: {sorted(found)}")
    values = {name: positive_number(value, f"{name}: epsilon") for name, value in epsilon.items()}
    for name, value in values.items():
        found[name].epsilon.set_value(np.asarray(value))
