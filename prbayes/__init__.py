"""Statistical model calibration in PyMC: optimiser and ABC on one model, with one metric."""

from importlib import import_module
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from prbayes._public import *  # noqa: F403

__version__ = version("prbayes")

# Names of `_public`, each there when it is asked for.
__all__ = [  # noqa: F405
    "AreaMetric",
    "Diagnosis",
    "Fresh",
    "FunctionMetric",
    "GaussianKDE",
    "Histogram",
    "Joint",
    "KullbackLeibler",
    "LogLikelihood",
    "MarginalCorrelation",
    "Metric",
    "Optimum",
    "ProbabilityResidual",
    "Report",
    "Resimulated",
    "Reweighted",
    "Simulator",
    "Surrogate",
    "abc_distance",
    "area_test",
    "bootstrap",
    "calibrate_epsilon",
    "command",
    "compare",
    "cost",
    "cross_validate",
    "datasets",
    "decision",
    "diagnose",
    "exceedance",
    "fmu",
    "metrics",
    "minimize",
    "plan",
    "plot_comparison",
    "plot_landscape",
    "plot_optimizer",
    "plot_outputs",
    "plot_population",
    "plot_posterior",
    "plot_responses",
    "plot_stages",
    "plot_validity",
    "plots",
    "posterior",
    "predict",
    "propagation",
    "refine",
    "reports",
    "response",
    "sample",
    "sample_smc",
    "scalar",
    "sensitivity",
    "set_epsilon",
    "simulation_based_calibration",
    "surrogate",
    "umbridge",
    "validation",
]


def __getattr__(name: str) -> Any:
    """Load the public names when the first is asked for: the command line answers before."""
    if name in __all__:
        return getattr(import_module("prbayes._public"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """Return what there is, for completion."""
    return [*globals(), *__all__]
