"""Pictures of results, alike on every backend of ArviZ."""

from prbayes.plots.influences import plot_sensitivity

__all__ = ["plot_sensitivity"]
