"""Findings: conditions that a reader of a result should know."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import dataclass

from prbayes._pages import more_in

_log = logging.getLogger("prbayes")


@dataclass(frozen=True)
class Finding:
    """A condition that a reader of the result should know.

    Parameters
    ----------
    code : str
        Stable identifier, such as ``"rounded-data"``, by which findings are filtered.
    text : str
        One or two sentences for the reader. The final period may be missing.
    page : str, optional
        Documentation page with details and the heading, such as ``"likelihood.md#rounded-data"``.
        A constant: tests check that page and heading exist.

    Examples
    --------
    >>> from prbayes._finding import Finding
    >>> str(Finding("rounded-data", "the data are rounded", "likelihood.md#rounded-data"))
    'the data are rounded; see docs/likelihood.md#rounded-data'
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
        return f"{sentence}{more_in(self.page)}{period}"


def report(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Log findings as warnings of the logger ``prbayes``.

    Parameters
    ----------
    findings : iterable of Finding

    Returns
    -------
    tuple of Finding
        The findings, in their order.
    """
    reported = tuple(findings)
    for finding in reported:
        _log.warning("%s", finding)
    return reported
