"""What all kinds of simulators have in common: a response, and measured specimens."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from prbayes._finding import Finding
from prbayes._validate import Floats, Indices
from prbayes.metrics.base import Metric
from prbayes.response.condition import is_condition
from prbayes.response.inputs import Inputs
from prbayes.response.outputs import Outputs, label_text
from prbayes.response.response import Responses

_SHEETS = "data_sheet.md#several-outputs"
_PAGE = "conditions.md#what-the-labels-change"


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
) -> tuple[list[Indices], int]:
    """Return the specimen's number of each observation, by simulator, and the number of specimens.

    An observation without a label is a specimen of its own.
    """
    numbers: dict[object, int] = {}
    by_simulator = []
    for k, simulator in enumerate(simulators):
        labels = [(k, row) for row in range(len(simulator.observed))]
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


def refuse_labels_of_index(
    name: str,
    inputs: Inputs,
    labels: NDArray[Any] | None,
    index: Sequence[str] | None,
    earlier: Mapping[Any, Any],
) -> None:
    """Raise if specimens have labels of an earlier simulator by their index, not by specimens=.

    The earlier simulators are by their observed variables. Specimens with the same labels and the
    same inputs would count twice.
    """
    present = _labels(labels, index) or []
    for variable, simulator in earlier.items():
        taken = set(_labels(simulator.specimens, _index_of(variable)) or [])
        common = [label for label in present if label in taken]
        is_joined = labels is not None and simulator.specimens is not None
        if common and not is_joined and _have_common_inputs(inputs, simulator):
            raise ValueError(
                f"{name}: observed: got the specimen {common[0]!r}, which {simulator.name} has too "
                "by index, coordinate or dims, expected specimens= in both simulators, with which "
                "it counts once; pass specimens=[str(label) for label in index] to both and leave "
                "dims= out, or, if they are other specimens, give them other labels"
            )


def unlabelled_specimens(simulators: Mapping[Any, Any]) -> list[Finding]:
    """Report specimens that may be the same, and count as several, since they have no labels.

    The simulators are by their observed variables.
    """
    texts = []
    parts = [
        (s, _labels(s.specimens, _index_of(variable)))
        for variable, s in simulators.items()
        if not s.metric.exact_likelihood
    ]
    for k, (simulator, labels) in enumerate(parts):
        n = len(simulator.observed)
        label, count = Counter(labels or [""]).most_common(1)[0]
        # Whole numbers are what joining tables leaves in an index.
        if simulator.specimens is None and count > 1 and not label.isdigit():
            texts.append(
                f"{simulator.name}: got the label {label!r} {count} times in the index of "
                "observed, expected different ones, since each row counts as a specimen; pass "
                "specimens= if rows with the same label are readings of one specimen."
            )
        for other, labels_of_other in parts[:k]:
            is_known = labels is not None and labels_of_other is not None
            is_other_group = getattr(simulator, "group", "") != getattr(other, "group", "")
            if is_known or is_other_group or len(other.observed) != n:
                continue
            if _have_common_inputs(simulator.responses.inputs, other):
                texts.append(
                    f"{other.name} and {simulator.name}: got {n} specimens of the same inputs in "
                    f"each, expected labels, without which they count as {2 * n} specimens; pass "
                    "specimens= to both, with the same labels if the specimens are the same."
                )
    findings = [Finding("unlabelled-specimens", text, _PAGE) for text in texts]
    return findings + _separate_sheets(list(simulators.values()))


def _separate_sheets(simulators: Sequence[Any]) -> list[Finding]:
    """Report data sheets of as many specimens of the same inputs, which count as separate ones."""
    findings = []
    sheets = [s for s in simulators if s.metric.exact_likelihood]
    for first, second in combinations(sheets, 2):
        n = second.target.n_effective
        is_other_size = first.target.n_effective != n
        if is_other_size or not _have_common_inputs(second.responses.inputs, first):
            continue
        text = (
            f"{first.name} and {second.name}: the data sheets have {n:.0f} specimens of the same "
            "inputs each, and count as separate samples; if the specimens are the same, write one "
            "simulator of a response with both outputs, and pass a mapping of prb.Summary."
        )
        findings.append(Finding("separate-sheets", text, _SHEETS))
    return findings


def _labels(specimens: NDArray[Any] | None, index: Sequence[str] | None) -> list[str] | None:
    """Return the labels of specimens as texts: those of specimens=, else those of the index."""
    if specimens is not None:
        return list(map(label_text, specimens.tolist()))
    return None if index is None else list(index)


def _index_of(variable: Any) -> Sequence[str] | None:
    """Return the labels in the index of the observed values of a variable."""
    labels = getattr(variable.tag, "specimen_index", None)
    return labels


def _have_common_inputs(inputs: Inputs, simulator: Any) -> bool:
    """Return whether a simulator has an aleatory input in common, apart from known conditions."""
    aleatory = {x for x in inputs.aleatory if not is_condition(x)}
    return not aleatory.isdisjoint(simulator.responses.inputs.aleatory)
