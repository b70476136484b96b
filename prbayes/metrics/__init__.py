"""Calibration metrics: how much simulated responses disagree with measured ones.

Smaller is better.
"""

from prbayes.metrics.base import DensityDiscrepancy, Discrepancy, Minimum
from prbayes.metrics.density import DensityEstimator

__all__ = ["DensityDiscrepancy", "DensityEstimator", "Discrepancy", "Minimum"]
