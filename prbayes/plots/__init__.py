"""Pictures of results: figures of Matplotlib, and of posteriors a collection of ArviZ."""

from prbayes.plots.comparison import plot_comparison
from prbayes.plots.convergence import plot_optimizer, plot_stages
from prbayes.plots.individuals import plot_individuals
from prbayes.plots.landscape import plot_landscape
from prbayes.plots.outputs import plot_outputs
from prbayes.plots.population import plot_population
from prbayes.plots.posterior import plot_posterior
from prbayes.plots.prediction import plot_prediction
from prbayes.plots.predictive_check import plot_predictive_check
from prbayes.plots.products import plot_products
from prbayes.plots.residuals import plot_residuals
from prbayes.plots.responses import plot_responses
from prbayes.plots.sensitivity import plot_sensitivity
from prbayes.plots.validity import plot_validity

__all__ = [
    "plot_comparison",
    "plot_individuals",
    "plot_landscape",
    "plot_optimizer",
    "plot_outputs",
    "plot_population",
    "plot_posterior",
    "plot_prediction",
    "plot_predictive_check",
    "plot_products",
    "plot_residuals",
    "plot_responses",
    "plot_sensitivity",
    "plot_stages",
    "plot_validity",
]
