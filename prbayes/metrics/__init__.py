"""Calibration metrics: distances between simulated and measured responses.

Smaller is better.
"""

from prbayes.metrics.base import Discrepancy, Minimum
from prbayes.metrics.density import DensityDiscrepancy, DensityEstimator

__all__ = ["DensityDiscrepancy", "DensityEstimator", "Discrepancy", "Minimum"]
