"""Calibration metrics: how much simulated responses disagree with measured ones.

Smaller is better.
"""

from prbayes.metrics.base import Discrepancy, Minimum
from prbayes.metrics.density import DensityDiscrepancy, DensityEstimator

__all__ = ["DensityDiscrepancy", "DensityEstimator", "Discrepancy", "Minimum"]
