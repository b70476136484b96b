"""Propagation of a population of inputs to responses: stored with weights, or simulated again."""

from prbayes.propagation.base import Bound, DesignError, Propagation

__all__ = ["Bound", "DesignError", "Propagation"]
