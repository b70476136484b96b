"""Findings: warnings as data, from the place of detection to the report."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Finding:
    """A warning.

    Parameters
    ----------
    code : str
        Kind of the finding, such as ``"rounded-data"``. Programs test the code, never the text.
    text : str
        What was got, what was expected, and what to do.
    page : str
        Page of the documentation with its heading, or an empty string.
    """

    code: str
    text: str
    page: str = ""
