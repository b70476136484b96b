"""Statistical model calibration in PyMC: optimiser and ABC on one model, with one metric."""

from functools import cache
from importlib import import_module
from importlib.metadata import version
from importlib.resources import files
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from prbayes._public import *  # noqa: F403

__version__ = version("prbayes")

# Names of `_public`, each imported when it is asked for.
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
    "rank",
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
    """Import a public name when it is asked for, and no module that it does not need."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = _modules()[name]
    if module == __name__:
        return import_module(f"{__name__}.{name}")
    return getattr(import_module(module), name)


@cache
def _modules() -> dict[str, str]:
    """Return the module of each public name, from the imports in the source of `_public`."""
    import ast

    tree = ast.parse(files(__name__).joinpath("_public.py").read_text(encoding="utf-8"))
    imports = [node for node in tree.body if isinstance(node, ast.ImportFrom)]
    return {alias.name: str(node.module) for node in imports for alias in node.names}


def __dir__() -> list[str]:
    """Return what there is, for completion."""
    return [*globals(), *__all__]
