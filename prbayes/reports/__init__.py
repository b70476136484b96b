"""Reports: results of any origin become sections, which are data, and these a document."""

from prbayes.reports.section import Section

__all__ = ["Section"]
