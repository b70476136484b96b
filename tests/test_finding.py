"""Findings: their text, their way into the log, and `prb.help`."""

from __future__ import annotations

import logging
import re
from pathlib import Path

import pytest

import prbayes as prb
from prbayes import _finding
from prbayes._finding import Finding, as_json, from_json, report

PAGE = "choose.md#the-metric"
CODES = re.findall(r"^- `([\w-]+)`: .+\.$", prb.help(), re.MULTILINE)


def test_the_page_ends_the_text_as_in_other_messages() -> None:
    finding = Finding("rounded-data", "the data are rounded", PAGE)
    assert str(finding) == 'the data are rounded; see prb.help("rounded-data")'


def test_the_page_comes_before_the_final_period() -> None:
    finding = Finding("rounded-data", "Data are rounded. Pass rounded=.", PAGE)
    expected = 'Data are rounded. Pass rounded=; see prb.help("rounded-data").'
    assert str(finding) == expected


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


def test_help_lists_the_codes() -> None:
    page = (Path(__file__).parents[1] / "docs" / "findings.md").read_text(encoding="utf-8")
    assert re.findall(r"^\| `([\w-]+)` \|", page, flags=re.MULTILINE) == CODES
    assert len(CODES) > 70


@pytest.mark.parametrize("code", CODES)
def test_help_explains_every_code_in_plain_markdown(code: str) -> None:
    text = prb.help(code)
    assert text.startswith(f"`{code}`: ")
    assert not re.search(r"code-cell|:tags:|\{\w+\}`|<!--|\]\((?!http)| See \[", text)
    assert text.count("```") % 2 == 0


def test_help_ends_with_the_sections_of_the_pages() -> None:
    text = prb.help("second-mode")
    headings = re.findall(r"^##+ .+$", text, re.MULTILINE)
    assert headings == ["## Several modes", "## Two answers"]
    assert "laplace" in text.lower()
    assert "mirror_optimum" in text  # code is shown, assertions of the page are not
    assert "assert" not in text


def test_help_is_markdown_in_a_notebook_and_has_no_quotes_in_a_console() -> None:
    text = prb.help("rounded-data")
    assert repr(text) == str(text) == text._repr_markdown_()
    assert text.startswith("`rounded-data`")


def test_help_of_an_installed_package_reads_its_own_pages(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "docs").mkdir()
    page = "| `a-code` | Words. See [B c](other.md#b-c). |\n"
    (tmp_path / "docs" / "findings.md").write_text(page, encoding="utf-8")
    other = "# A\n\n## B c\n\nText.\n\n### D\n\nMore.\n\n## E\n"
    (tmp_path / "docs" / "other.md").write_text(other, encoding="utf-8")
    monkeypatch.setattr(_finding, "__file__", str(tmp_path / "_finding.py"))
    assert prb.help("a-code") == "`a-code`: Words.\n\n## B c\n\nText.\n\n### D\n\nMore."


@pytest.mark.parametrize(
    ("code", "near"), [("rounded", "'rounded-data'"), ("no-picure", "'no-pic")]
)
def test_help_of_an_unknown_code_names_the_nearest(code: str, near: str) -> None:
    with pytest.raises(ValueError, match=rf"code: got '{code}', expected .*, such as {near}"):
        prb.help(code)
    with pytest.raises(ValueError, match=r"expected the code of a finding; prb.help\(\) lists all"):
        prb.help("#")
