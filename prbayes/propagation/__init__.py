"""How a population of inputs becomes responses, and what one evaluation of it costs."""

from prbayes.propagation.base import Bound, DesignError, Propagation

__all__ = ["Bound", "DesignError", "Propagation"]
