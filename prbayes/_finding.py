"""Findings: conditions that a reader of a result should know."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterable
from dataclasses import asdict, dataclass

_log = logging.getLogger("prbayes")


@dataclass(frozen=True)
class Finding:
    """A condition that a reader of the result should know.

    Parameters
    ----------
    code : str
        Stable identifier, such as ``"rounded-data"``, by which findings are filtered;
        ``docs/findings.md`` lists all.
    text : str
        One or two sentences for the reader: got, expected, what to do.
    page : str, optional
        Documentation page with details and the heading, such as ``"likelihood.md#rounded-data"``.
        A constant: tests check that page and heading exist.

    Examples
    --------
    >>> from prbayes._finding import Finding
    >>> finding = Finding("rounded-data", "The data are rounded.", "likelihood.md#rounded-data")
    >>> print(finding)
    The data are rounded; see docs/likelihood.md#rounded-data.
    """

    code: str
    text: str
    page: str = ""

    def __str__(self) -> str:
        """Return the text, with the page before its final period."""
        if not self.page:
            return self.text
        sentence = self.text.removesuffix(".")
        period = self.text[len(sentence) :]
        # The pages are in the repository and in the source distribution.
        return f"{sentence}; see docs/{self.page}{period}"


def counted(n: int, noun: str, plural: str = "") -> str:
    """Return a number with a noun, in the plural unless the number is one."""
    return f"{n} {noun}" if n == 1 else f"{n} {plural or f'{noun}s'}"


def report(*findings: Finding, level: int = logging.WARNING) -> tuple[Finding, ...]:
    """Log findings by the logger ``prbayes``, each in a record with its ``code``; return them."""
    for finding in findings:
        _log.log(level, "%s", finding, extra={"code": finding.code})
    return findings


def as_json(findings: Iterable[Finding]) -> str:
    """Return findings as one attribute of a stored result."""
    return json.dumps([asdict(finding) for finding in findings])


def from_json(text: str) -> tuple[Finding, ...]:
    """Return the findings of an attribute of a stored result, or raise `ValueError`."""
    try:
        records = json.loads(text)
        return tuple(
            Finding(*(str(record[key]) for key in ("code", "text", "page")))
            for record in (records if isinstance(records, list) else [records])
        )
    except (TypeError, KeyError, ValueError):
        raise ValueError(
            f"findings: got {text[:80]!r}, expected a JSON list of records of code, text and page; "
            "the file was changed, or is of another version"
        ) from None
