"""What stands in a PyMC model, and the evaluator that all routes ask about it."""
