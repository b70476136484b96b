"""From results to the sections of a report."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from prbayes.reports.assessment import comparison as comparison_of
from prbayes.reports.assessment import diagnostics, failures, origin
from prbayes.reports.assessment import validity as validity_of
from prbayes.reports.decision import decision as decision_of
from prbayes.reports.decision import refuse_decisions
from prbayes.reports.estimates import optima, posteriors
from prbayes.reports.illustrations import illustrate, with_graph
from prbayes.reports.material import Material, gather
from prbayes.reports.next_steps import next_steps
from prbayes.reports.problem import data, metric
from prbayes.reports.problem import model as model_of
from prbayes.reports.section import Section
from prbayes.reports.specimens import specimens
from prbayes.reports.summary import answers, summary
from prbayes.reports.tables import rows_table


def _summary(m: Material) -> list[Section]:
    if not (m.results or m.tests or m.description):
        return []
    rows = answers(m)
    table = rows_table(rows) if rows else None
    sections = [Section("Summary", summary(m), table)]
    steps = next_steps(m)
    if steps:
        sections.append(Section("What to do next", steps, level=3))
    return sections


# In the order of the report; each returns no section where it has nothing to say.
_PARTS = (
    _summary,
    model_of,
    data,
    metric,
    optima,
    posteriors,
    comparison_of,
    diagnostics,
    failures,
    validity_of,
    specimens,
    decision_of,
    origin,
)


def contents(
    model: Any,
    optimum: Any,
    posterior: Any,
    validity: Any,
    comparison: Any,
    decision: Any = None,
    validation: Any = None,
    *,
    labels: Mapping[str, str] | None = None,
    pictures: bool,
) -> tuple[Section, ...]:
    """Return the sections that the results allow, with pictures if wanted."""
    refuse_decisions(decision)
    results = (model, optimum, posterior, validity, comparison, decision, validation)
    material = gather(*results, labels=labels)
    sections = tuple(section for part in _PARTS for section in part(material))
    if not pictures:
        return sections
    return illustrate(with_graph(sections, material), material)
