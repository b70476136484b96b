"""The first use of a model, which computes the first responses of its simulators."""

from __future__ import annotations

from typing import Any

import pymc as pm

from prbayes.model.random_variable import Node, nodes


def first_use(model: pm.Model) -> dict[Any, Node]:
    """Compute the first responses, and return the simulators."""
    return nodes(model)
