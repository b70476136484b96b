"""A coarse response beside the expensive one, called at runs and at points between them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from prbayes._validate import Floats
from prbayes.response.budget import unlimited
from prbayes.response.failures import Replace, ResponseError
from prbayes.response.response import Responses


class Coarse:
    """A coarse response of a simulator, which costs no run.

    Points at which it raises or is not finite have none, which the log tells.

    Parameters
    ----------
    function : callable
        Of the same inputs, with the same outputs as the expensive one.
    expensive : Responses
    executor : Executor, optional

    Raises
    ------
    ResponseError
        When called, if it gives no real numbers, or another shape than the expensive one does, or
        is finite at none of the points that it is called at first.
    """

    def __init__(self, function: Callable[..., Any], expensive: Responses, executor: Any) -> None:
        self._responses = Responses(
            f"{expensive.name}: coarse",
            function,
            expensive.inputs,
            executor=executor,
            on_failure=Replace(),
            outputs=expensive.outputs,
        )
        self._known = False

    def __call__(self, points: Sequence[Floats]) -> Floats:
        """Return the outputs at points, (n, m), of which the first have to have some."""
        # What a user limits is the expensive response.
        with unlimited():
            found = self._responses(points, [])
        self._known = self._known or bool(np.isfinite(found).any())
        if not self._known:
            why = next((failure.reason for failure in self._responses.failed), "it is infinite")
            raise ResponseError(
                f"{self._responses.name}: got no number at any of {len(found)} runs ({why}), "
                "expected a response of the same inputs; repair it, or leave coarse= out"
            )
        return found.reshape(len(found), -1)
