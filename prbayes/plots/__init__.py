"""Pictures of results, alike on every backend of ArviZ."""

from prbayes.plots.influences import plot_sensitivity
from prbayes.plots.prediction import plot_prediction

__all__ = ["plot_prediction", "plot_sensitivity"]
