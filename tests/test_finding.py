"""Findings: their text, and their way into the log."""

from __future__ import annotations

import dataclasses
import logging

import pytest

from prbayes._finding import Finding, as_json, from_json, report

PAGE = "choose.md#the-metric"


def test_text_without_a_page() -> None:
    assert str(Finding("rounded-data", "the data are rounded")) == "the data are rounded"


def test_the_page_ends_the_text_as_in_other_messages() -> None:
    finding = Finding("rounded-data", "the data are rounded", PAGE)
    assert str(finding) == f"the data are rounded; see docs/{PAGE}"


def test_the_page_comes_before_the_final_period() -> None:
    finding = Finding("rounded-data", "Data are rounded. Pass rounded=.", PAGE)
    assert str(finding) == f"Data are rounded. Pass rounded=; see docs/{PAGE}."


def test_findings_are_values() -> None:
    assert Finding("a", "text") == Finding("a", "text")
    assert len({Finding("a", "text"), Finding("a", "text"), Finding("b", "text")}) == 2
    with pytest.raises(dataclasses.FrozenInstanceError):
        Finding("a", "text").code = "b"  # type: ignore[misc]


def test_report_logs_each_finding_as_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    findings = [Finding("a", "100 % of the runs failed"), Finding("b", "text", PAGE)]
    with caplog.at_level(logging.WARNING, logger="prbayes"):
        assert report(*findings) == tuple(findings)
    expected = [("prbayes", logging.WARNING, str(finding)) for finding in findings]
    assert caplog.record_tuples == expected
    assert [vars(record)["code"] for record in caplog.records] == ["a", "b"]


def test_findings_are_filtered_by_code_in_the_log(caplog: pytest.LogCaptureFixture) -> None:
    logger = logging.getLogger("prbayes")

    def without(record: logging.LogRecord) -> bool:
        return getattr(record, "code", "") != "rounded-data"

    logger.addFilter(without)
    try:
        report(Finding("rounded-data", "text"), Finding("censored-data", "other text"))
    finally:
        logger.removeFilter(without)
    assert [record.message for record in caplog.records] == ["other text"]


def test_findings_are_stored_as_records() -> None:
    findings = (Finding("a", "one\ntwo", PAGE), Finding("b", "'\"text\"'"))
    assert from_json(as_json(findings)) == findings
    assert from_json("[]") == ()


@pytest.mark.parametrize("text", ["__import__('os')", "{}", "3", '[{"code": "a"}]', "[1]"])
def test_an_attribute_that_is_no_list_of_records_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="expected a JSON list of records"):
        from_json(text)


def test_no_findings_log_nothing(caplog: pytest.LogCaptureFixture) -> None:
    assert report() == ()
    assert not caplog.records
