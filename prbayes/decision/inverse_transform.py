"""Specimens of one population as functions of standard normal numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
import pytensor.tensor as pt
from scipy.special import ndtr

from prbayes._validate import Floats
from prbayes.numerics.points import inside
from prbayes.propagation.points import through_inverses
from prbayes.response.compile import compile_batched
from prbayes.response.distributions import compiled_log_density
from prbayes.response.inputs import Inputs
from prbayes.response.response import Responses


@dataclass(frozen=True, eq=False)
class Specimens:
    """The aleatory inputs of one population, through their inverse distribution functions.

    Attributes
    ----------
    name : str
        For messages.
    inputs : Inputs
    roots : list of ndarray, shapes (1, *shape)
        Which population.

    Raises
    ------
    TypeError
        If a distribution has no inverse, or depends on another one.
    """

    name: str
    inputs: Inputs
    roots: Sequence[Floats]

    def __post_init__(self) -> None:
        _ = self._function

    @cached_property
    def _function(self) -> Any:
        symbols = self.inputs.placeholders()
        uniforms = [pt.tensor(dtype="float64", shape=(None, *s)) for s in self.inputs.event_shapes]
        placed, epistemic = through_inverses(self.name, self.inputs, symbols, uniforms)
        return compile_batched([*symbols, *uniforms], [*placed, *epistemic])

    @property
    def columns(self) -> list[slice]:
        """Which normal numbers make each input."""
        sizes = [int(np.prod(shape, dtype=int)) for shape in self.inputs.event_shapes]
        ends = np.cumsum([0, *sizes]).tolist()
        return [slice(a, b) for a, b in pairwise(ends)]

    @property
    def size(self) -> int:
        """How many normal numbers make a specimen."""
        return int(self.columns[-1].stop)

    def at(self, z: Floats) -> list[Floats]:
        """Return the aleatory inputs, shapes (n, *event), of normal numbers (n, size)."""
        uniforms = []
        for own, shape in zip(self.columns, self.inputs.event_shapes, strict=True):
            u = inside(ndtr(z[:, own]))
            uniforms.append(u.reshape(1, len(z), *shape))
        values = self._function(*self.roots, *uniforms)
        shapes = self.inputs.event_shapes
        return [
            np.broadcast_to(v, (1, len(z), *shape))[0]
            for v, shape in zip(values[: len(shapes)], shapes, strict=True)
        ]

    def log_density(self, roots: Sequence[Floats], x: Sequence[Floats]) -> Floats:
        """Return log densities, (k, n), of inputs in populations at roots, shapes (k, *shape)."""
        (found,) = self._log_density(*roots, *x)
        return np.asarray(found)

    @cached_property
    def _log_density(self) -> Any:
        return compiled_log_density(self.inputs)

    def computed(self, responses: Responses, z: Floats) -> Floats:
        """Return a response, (n,) or (n, m), called at normal numbers (n, size)."""
        every = self.at(z)
        own = list(map(id, self.inputs.aleatory))
        return responses([every[own.index(id(x))] for x in responses.inputs.aleatory], [])
