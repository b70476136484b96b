"""What the parts of a metric see of populations: numbers, one for each specimen."""

from __future__ import annotations

from prbayes._validate import Floats
from prbayes.metrics.base import Discrepancy, Part


def number_parts(target: Discrepancy) -> list[Part]:
    """Return the parts that see one number of a specimen: of one output, the metric itself."""
    return [part for part in target.parts if not part.target.event]


def one_dimensional(target: Discrepancy, values: Floats) -> list[Floats]:
    """Return what the parts see of responses, (..., n) or (..., n, m) -> (..., n) each."""
    return [part.of(values) for part in number_parts(target)]
