"""Pictures of results, drawn by Matplotlib in panels of ArviZ."""

from prbayes.plots.individuals import plot_individuals
from prbayes.plots.prediction import plot_prediction
from prbayes.plots.sensitivity import plot_sensitivity

__all__ = ["plot_individuals", "plot_prediction", "plot_sensitivity"]
