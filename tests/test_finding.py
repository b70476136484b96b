"""Findings: their text, and their way into the log."""

from __future__ import annotations

import dataclasses
import logging

import pytest

from prbayes._finding import Finding, report
from prbayes._pages import more_in

PAGE = "choose.md#the-metric"


def test_text_without_a_page() -> None:
    assert str(Finding("rounded-data", "the data are rounded")) == "the data are rounded"


def test_the_page_ends_the_text_as_in_other_messages() -> None:
    finding = Finding("rounded-data", "the data are rounded", PAGE)
    assert str(finding) == f"the data are rounded{more_in(PAGE)}"


def test_the_page_comes_before_the_final_period() -> None:
    finding = Finding("rounded-data", "Data are rounded. Pass rounded=.", PAGE)
    assert str(finding) == f"Data are rounded. Pass rounded={more_in(PAGE)}."


def test_findings_are_values() -> None:
    assert Finding("a", "text") == Finding("a", "text")
    assert len({Finding("a", "text"), Finding("a", "text"), Finding("b", "text")}) == 2
    with pytest.raises(dataclasses.FrozenInstanceError):
        Finding("a", "text").code = "b"  # type: ignore[misc]


def test_report_logs_each_finding_as_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    findings = [Finding("a", "100 % of the runs failed"), Finding("b", "text", PAGE)]
    with caplog.at_level(logging.WARNING, logger="prbayes"):
        assert report(iter(findings)) == tuple(findings)
    expected = [("prbayes", logging.WARNING, str(finding)) for finding in findings]
    assert caplog.record_tuples == expected


def test_no_findings_log_nothing(caplog: pytest.LogCaptureFixture) -> None:
    assert report([]) == ()
    assert not caplog.records
