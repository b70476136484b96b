"""The likelihood of measured specimens: runs near their inputs, and points of quadrature."""
