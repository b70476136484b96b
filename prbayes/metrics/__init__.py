"""Calibration metrics: how much simulated responses disagree with measured ones.

Smaller is better.
"""
