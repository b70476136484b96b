"""Propagation of a population of inputs to responses: stored, simulated again, or by specimen."""

from prbayes.propagation.base import Bound, DesignError, Propagation

__all__ = ["Bound", "DesignError", "Propagation"]
