"""The section of a report that says where each new specimen stands in its prediction."""

from __future__ import annotations

from typing import Any

import numpy as np

from prbayes.plots._labels import named
from prbayes.plots.validity import in_directions
from prbayes.reports.material import Material
from prbayes.reports.numbers import alike
from prbayes.reports.section import Section
from prbayes.reports.tables import rows_table
from prbayes.validation.area_test import u_values
from prbayes.validation.conditions import DIRECTION, Comparable, comparables

# A page; of more the first ones are told.
_ON_A_PAGE = 40


def specimens(m: Material) -> list[Section]:
    """Return what was measured on each specimen of the test, and its u-value."""
    rows = _measured(m) or _tested(m)
    if not rows:
        return []
    about = (
        "u is the share of the predicted responses below the measured one: a specimen with a u "
        "near 0 or 1 is at the edge of what was predicted."
    )
    more = (
        ""
        if len(rows) <= _ON_A_PAGE
        else f" The first {_ON_A_PAGE} of {len(rows)} values are told."
    )
    table = rows_table(rows[:_ON_A_PAGE])
    return [Section("Specimens of the test", about + more, table, level=3)]


def _measured(m: Material) -> list[dict[str, Any]]:
    """Return a row for each specimen and output of the validation data."""
    rows = []
    for condition, (measured, predicted) in m.validation.items():
        labels = _labels(condition, len(measured), m)
        for pair in comparables({condition: measured}, {condition: predicted}, "Report"):
            rows += _of_pair(pair, labels, m)
    return rows


def _of_pair(pair: Comparable, labels: list[str], m: Material) -> list[dict[str, Any]]:
    """Return a row for each specimen of one output under one condition."""
    finite = pair.measured[np.isfinite(pair.measured)]
    sd = float(finite.std(ddof=1)) if finite.size > 1 else np.nan
    values = alike(pair.measured.tolist(), sd)
    u = u_values(pair.measured, pair.predicted)
    rows = []
    for specimen, value, own in zip(labels, values, u.tolist(), strict=True):
        about = {"condition": named(pair.name, m.labels), "specimen": specimen}
        rows.append(about | {"measured": value, "u": f"{own:.3f}"})
    return rows


def _labels(condition: str, count: int, m: Material) -> list[str]:
    """Return what the specimens of a condition are called in a test of them, or count them."""
    for test in m.tests.values():
        alone = len(test.of_conditions) == 1 and len(m.validation) == 1
        for name in test.of_conditions:
            of = [each.split(DIRECTION)[0] == name for each in test.conditions.tolist()]
            own = test.specimens[of]
            found = list(dict.fromkeys(own.tolist()))
            if (alone or name == condition) and len(found) == count:
                return [_label(each, name) for each in found]
    return [str(i + 1) for i in range(count)]


def _label(specimen: str, condition: str) -> str:
    """Return a label; of specimens without one a number, as the test counts them, from one on."""
    number = specimen.removeprefix(f"{condition}, ")
    return str(int(number) + 1) if number != specimen and number.isdigit() else specimen


def _tested(m: Material) -> list[dict[str, Any]]:
    """Return a row for each u-value of the tests that is one of a specimen."""
    rows: dict[tuple[str, str], dict[str, Any]] = {}
    for test in m.tests.values():
        if in_directions(test):
            continue
        every = zip(test.conditions.tolist(), test.specimens.tolist(), test.u_values, strict=True)
        for condition, specimen, u in every:
            about = {"condition": named(condition, m.labels)}
            about["specimen"] = _label(specimen, condition)
            rows[condition, specimen] = about | {"u": f"{u:.3f}"}
    return list(rows.values())
