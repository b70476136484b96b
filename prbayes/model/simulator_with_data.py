"""What all kinds of simulators have in common: a response, and measured specimens."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from prbayes._validate import Floats
from prbayes.metrics.base import Metric
from prbayes.response.inputs import Inputs
from prbayes.response.outputs import Outputs
from prbayes.response.response import Responses


class SimulatorWithData(Protocol):
    """A simulator and the measured responses that it is compared with."""

    @property
    def name(self) -> str:
        """Name of the observed variable."""

    @property
    def observed(self) -> Floats:
        """Measured responses, (N,) or (N, m)."""

    @property
    def specimens(self) -> NDArray[Any] | None:
        """Labels of the specimens, (N,); None where each response is one of its own."""

    @property
    def inputs(self) -> Inputs:
        """The inputs of the response."""

    @property
    def responses(self) -> Responses:
        """The response, and how it is called."""

    @property
    def outputs(self) -> Outputs:
        """The outputs of a run."""

    @property
    def metric(self) -> Metric:
        """How measured and simulated responses are compared."""


def number_specimens(
    simulators: Sequence[SimulatorWithData],
) -> tuple[list[NDArray[np.intp]], int]:
    """Return the specimen's number of each observation, by simulator, and the number of specimens.

    An observation without a label is a specimen of its own.
    """
    numbers: dict[object, int] = {}
    by_simulator = []
    for k, simulator in enumerate(simulators):
        labels: list[object] = [(k, row) for row in range(len(simulator.observed))]
        if simulator.specimens is not None:
            labels = simulator.specimens.tolist()
        rows = [numbers.setdefault(label, len(numbers)) for label in labels]
        by_simulator.append(np.array(rows, dtype=np.intp))
    return by_simulator, len(numbers)


def new_observed(
    simulator: SimulatorWithData, data: Any, aligned: str, *, is_aligned: bool
) -> Floats:
    """Return other observed values of a simulator, or raise if their shape does not fit.

    Their number may differ unless something belongs to each value; ``aligned`` names what may.
    """
    observed, values = simulator.observed, np.asarray(data, dtype=np.float64)
    if values.ndim != observed.ndim or values.shape[1:] != observed.shape[1:]:
        raise ValueError(
            f"{simulator.name}: observed: got shape {values.shape}, expected "
            f"{('N', *observed.shape[1:])}, as when the simulator was made"
        )
    if is_aligned and len(values) != len(observed):
        raise ValueError(
            f"{simulator.name}: observed: got {len(values)} specimens, expected {len(observed)}, "
            f"as many as there are {aligned}; build the model again with those of the new ones"
        )
    return values
