"""How a population of inputs becomes responses, and what one evaluation of it costs."""
