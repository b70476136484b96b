"""New specimens of populations: quasi-random points through inverse distribution functions."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytensor.tensor as pt

from prbayes._validate import Floats
from prbayes.numerics.points import base_points, inside
from prbayes.response.compile import compile_batched
from prbayes.response.distributions import PopulationSampler, quantiles
from prbayes.response.inputs import Inputs


def new_specimens(
    label: str, inputs: Inputs, roots: list[Floats], n: int, rng: np.random.Generator
) -> tuple[list[Floats], list[Floats]]:
    """Return n specimens of each population.

    Sobol points in random order with a random shift for each population; random draws where an
    input has no inverse distribution function.

    Parameters
    ----------
    label : str
        For messages.
    inputs : Inputs
    roots : list of ndarray, shapes (k, *shape)
    n : int
    rng : Generator

    Returns
    -------
    aleatory : list of ndarray, shapes (k, n, *event)
    epistemic : list of ndarray
        Which broadcast.
    """
    symbols = inputs.placeholders()
    uniforms = [pt.tensor(dtype="float64", shape=(None, *s)) for s in inputs.event_shapes]
    try:
        placed, epistemic = through_inverses(label, inputs, symbols, uniforms)
    except TypeError:
        return PopulationSampler(inputs)(roots, n, rng)
    _, base = base_points(inputs.event_shapes, n, int(rng.integers(2**31)))
    order = rng.permutation(n)
    k = len(roots[0])
    shifted = []
    for points in base:
        shift = rng.random((k, 1, *points.shape[1:]))
        shifted.append(inside((points[order] + shift) % 1))
    function = compile_batched([*symbols, *uniforms], [*placed, *epistemic])
    values = function(*roots, *shifted)
    aleatory = values[: len(placed)]
    return aleatory, [v[:, None] for v in values[len(placed) :]]


def through_inverses(
    label: str, inputs: Inputs, symbols: list[Any], uniforms: list[Any]
) -> tuple[list[Any], list[Any]]:
    """Return aleatory inputs as inverse distribution functions of uniforms, and epistemic ones.

    Raises
    ------
    TypeError
        If a distribution has no inverse, or depends on another one.
    """
    if inputs.nested:
        raise TypeError("no inverse of a conditional distribution")
    dists, epistemic = inputs.rebuilt(symbols)
    placed = [quantiles(label, d, u) for d, u in zip(dists, uniforms, strict=True)]
    return placed, epistemic
