"""Statistical model calibration in PyMC: populations of inputs from measured responses."""

from importlib import import_module
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from prbayes import datasets as datasets
    from prbayes import decision as decision
    from prbayes import metrics as metrics
    from prbayes import plots as plots
    from prbayes import posterior as posterior
    from prbayes import propagation as propagation
    from prbayes import reports as reports
    from prbayes import response as response
    from prbayes import surrogate as surrogate
    from prbayes import validation as validation
    from prbayes._finding import help as help
    from prbayes.decision.exceedance import exceedance as exceedance
    from prbayes.decision.plan import plan as plan
    from prbayes.decision.population_table import population as population
    from prbayes.decision.sensitivity import sensitivity as sensitivity
    from prbayes.emulators.runs import Runs as Runs
    from prbayes.emulators.surrogate import Surrogate as Surrogate
    from prbayes.metrics.area import AreaMetric as AreaMetric
    from prbayes.metrics.base import Metric as Metric
    from prbayes.metrics.custom import FunctionMetric as FunctionMetric
    from prbayes.metrics.density import GaussianKDE as GaussianKDE
    from prbayes.metrics.density import Histogram as Histogram
    from prbayes.metrics.divergence import KullbackLeibler as KullbackLeibler
    from prbayes.metrics.divergence import ProbabilityResidual as ProbabilityResidual
    from prbayes.metrics.likelihood import LogLikelihood as LogLikelihood
    from prbayes.metrics.multivariate import Joint as Joint
    from prbayes.metrics.summary import Summary as Summary
    from prbayes.model.cost import cost as cost
    from prbayes.model.proposed_runs import propose_runs as propose_runs
    from prbayes.model.random_variable import abc_distance as abc_distance
    from prbayes.model.simulator import Simulator as Simulator
    from prbayes.optimize.minimize import minimize as minimize
    from prbayes.optimize.minimize import refine as refine
    from prbayes.optimize.optimum import Optimum as Optimum
    from prbayes.posterior.bootstrap import bootstrap as bootstrap
    from prbayes.posterior.epsilon import calibrate_epsilon as calibrate_epsilon
    from prbayes.posterior.epsilon import set_epsilon as set_epsilon
    from prbayes.posterior.sample import sample as sample
    from prbayes.posterior.sbc import simulation_based_calibration as simulation_based_calibration
    from prbayes.posterior.smc import sample_smc as sample_smc
    from prbayes.propagation.resimulated import Fresh as Fresh
    from prbayes.propagation.resimulated import Resimulated as Resimulated
    from prbayes.propagation.reweighted import Reweighted as Reweighted
    from prbayes.reports.document import Report as Report
    from prbayes.response.call import scalar as scalar
    from prbayes.response.command import command as command
    from prbayes.response.fmu import fmu as fmu
    from prbayes.response.umbridge import umbridge as umbridge
    from prbayes.results.compare import compare as compare
    from prbayes.results.diagnose import Diagnosis as Diagnosis
    from prbayes.results.diagnose import diagnose as diagnose
    from prbayes.results.individuals import individuals as individuals
    from prbayes.results.predict import predict as predict
    from prbayes.validation.area_test import area_test as area_test
    from prbayes.validation.cross_validation import cross_validate as cross_validate
    from prbayes.validation.cross_validation import rank as rank
    from prbayes.validation.fleet import calibrate_each as calibrate_each

__version__ = version("prbayes")

# Public names by module; a module is imported when one of its names is used.
_NAMES = {
    "_finding": ("help",),
    "decision.exceedance": ("exceedance",),
    "decision.plan": ("plan",),
    "decision.population_table": ("population",),
    "decision.sensitivity": ("sensitivity",),
    "emulators.runs": ("Runs",),
    "emulators.surrogate": ("Surrogate",),
    "metrics.area": ("AreaMetric",),
    "metrics.base": ("Metric",),
    "metrics.custom": ("FunctionMetric",),
    "metrics.density": ("GaussianKDE", "Histogram"),
    "metrics.divergence": ("KullbackLeibler", "ProbabilityResidual"),
    "metrics.likelihood": ("LogLikelihood",),
    "metrics.multivariate": ("Joint",),
    "metrics.summary": ("Summary",),
    "model.cost": ("cost",),
    "model.proposed_runs": ("propose_runs",),
    "model.random_variable": ("abc_distance",),
    "model.simulator": ("Simulator",),
    "optimize.minimize": ("minimize", "refine"),
    "optimize.optimum": ("Optimum",),
    "posterior.bootstrap": ("bootstrap",),
    "posterior.epsilon": ("calibrate_epsilon", "set_epsilon"),
    "posterior.sample": ("sample",),
    "posterior.sbc": ("simulation_based_calibration",),
    "posterior.smc": ("sample_smc",),
    "propagation.resimulated": ("Fresh", "Resimulated"),
    "propagation.reweighted": ("Reweighted",),
    "reports.document": ("Report",),
    "response.call": ("scalar",),
    "response.command": ("command",),
    "response.fmu": ("fmu",),
    "response.umbridge": ("umbridge",),
    "results.compare": ("compare",),
    "results.diagnose": ("Diagnosis", "diagnose"),
    "results.individuals": ("individuals",),
    "results.predict": ("predict",),
    "validation.area_test": ("area_test",),
    "validation.cross_validation": ("cross_validate", "rank"),
    "validation.fleet": ("calibrate_each",),
}
_NAMESPACES = (
    "datasets",
    "decision",
    "metrics",
    "plots",
    "posterior",
    "propagation",
    "reports",
    "response",
    "surrogate",
    "validation",
)
_MODULES = {name: module for module, names in _NAMES.items() for name in names}
__all__ = sorted([*_MODULES, *_NAMESPACES])


def __getattr__(name: str) -> Any:
    """Import a public name at its first use, and no module that it does not need."""
    if name in _NAMESPACES:
        return import_module(f"{__name__}.{name}")
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    """Return the public names, for completion."""
    return [*__all__, "__version__"]
