"""Checks of data, population and prior, with the size and power of every test."""
