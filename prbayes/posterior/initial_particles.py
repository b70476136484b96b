"""Particles that a user gives a sampler to begin with, as `pymc.sample_smc` takes them."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from prbayes._validate import Floats, called, real_array
from prbayes.model.parameters import Hyperparameters
from prbayes.response.inputs import event_shape


def starting_thetas(hyperparameters: Hyperparameters, start: Any, draws: int) -> Floats:
    """Return thetas, shape (draws, d), of values by the names of variables.

    Parameters
    ----------
    hyperparameters : Hyperparameters
    start : mapping
        For each free variable values of shape (draws, *shape): by its own name in its own units,
        as draws of `pymc.sample_prior_predictive` are, or transformed by the name that PyMC gives
        its value, such as ``sigma_log__``.
    draws : int

    Raises
    ------
    KeyError, TypeError, ValueError
        If it is no such mapping, or a value is outside the priors' support.
    """
    if not isinstance(start, Mapping):
        raise TypeError(
            f"start: got {called(start)}, expected a dict of arrays by the names of variables, or "
            "a list of these, one for each chain"
        )
    by_value = dict(zip(hyperparameters.shapes, hyperparameters.model.value_vars, strict=True))
    rvs = [hyperparameters.model.values_to_rvs[value] for value in by_value.values()]
    own_names = [str(rv.name) for rv in rvs]
    _require_names(start, list(by_value), own_names)
    # In their own units, and where there are others the initial point until below.
    initial = hyperparameters.constrained(hyperparameters.initial[None])
    own_units = []
    for rv in hyperparameters.model.free_RVs:
        shape = (draws, *event_shape(rv))
        given = start.get(rv.name)
        value = initial[rv.name] if given is None else _array(given, str(rv.name), shape)
        own_units.append(np.broadcast_to(value, shape))
    with np.errstate(all="ignore"):  # what is outside the support is told below
        thetas = hyperparameters.thetas_of(own_units)
    first = 0
    for (name, shape), own_name in zip(hyperparameters.shapes.items(), own_names, strict=True):
        size = int(np.prod(shape, dtype=int))
        if own_name not in start:
            value = _array(start[name], name, (draws, *shape))
            thetas[:, first : first + size] = value.reshape(draws, size)
        first += size
    finite = np.isfinite(thetas).all(axis=1)
    outside = ~(finite & hyperparameters.in_support(np.where(finite[:, None], thetas, 0.0)))
    if outside.any():
        raise ValueError(
            f"start: got {int(outside.sum())} of {draws} points outside the support of the priors, "
            "expected none; draw them from the prior"
        )
    return np.asarray(thetas)


def fingerprint(thetas: list[Floats]) -> str:
    """Return what tells particles of all chains from others."""
    content = b"".join(np.ascontiguousarray(one).tobytes() for one in thetas)
    return hashlib.sha256(content).hexdigest()


def _require_names(start: Mapping[Any, Any], values: list[str], own: list[str]) -> None:
    """Raise unless there is one value for each free variable."""
    pairs = list(zip(values, own, strict=True))
    known = {name for pair in pairs for name in pair}
    each_once = all(len({value, name} & set(start)) == 1 for value, name in pairs)
    if not each_once or not set(start) <= known:
        raise KeyError(
            f"start: got {sorted(map(str, start))}, expected values for each of {sorted(own)}"
        )


def _array(value: Any, name: str, shape: tuple[int, ...]) -> Floats:
    """Return values of a variable, one for each particle."""
    array = real_array(value, f"start: {name}")
    if array.shape != shape:
        raise ValueError(
            f"start: {name}: got shape {array.shape}, expected {shape}, a value for each particle"
        )
    return array
