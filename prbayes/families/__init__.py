"""Wider families of populations, which contain a usual family as a special case."""

from prbayes.families.sinh_arcsinh import LogSinhArcsinh, SinhArcsinh

__all__ = ["LogSinhArcsinh", "SinhArcsinh"]
