"""Response surfaces that stand for a response within the ranges of their runs."""
