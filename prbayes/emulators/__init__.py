"""Interpolation of a response between its runs, with estimates of the error."""
