"""Reports of results: sections as data, written as documents."""

from prbayes.reports.section import Section

__all__ = ["Section"]
