"""What users type: the public names of the package, which it loads when the first is asked for."""

from prbayes import (
    datasets,
    decision,
    metrics,
    plots,
    posterior,
    propagation,
    reports,
    response,
    surrogate,
    validation,
)
from prbayes._compare import compare
from prbayes._diagnose import Diagnosis, diagnose
from prbayes._predict import predict
from prbayes.decision.influence import sensitivity
from prbayes.decision.planning import plan
from prbayes.decision.tail import exceedance
from prbayes.estimate.minimization import minimize, refine
from prbayes.estimate.optimum import Optimum
from prbayes.metrics.area import AreaMetric
from prbayes.metrics.base import Metric
from prbayes.metrics.correlation import MarginalCorrelation
from prbayes.metrics.density import GaussianKDE, Histogram
from prbayes.metrics.divergence import KullbackLeibler
from prbayes.metrics.function import FunctionMetric
from prbayes.metrics.joint import Joint
from prbayes.metrics.likelihood import LogLikelihood
from prbayes.metrics.residual import ProbabilityResidual
from prbayes.model.costing import cost
from prbayes.model.epsilon import set_epsilon
from prbayes.model.simulator import Simulator
from prbayes.model.stock import abc_distance
from prbayes.plots.comparison import plot_comparison
from prbayes.plots.landscape import plot_landscape
from prbayes.plots.optimizer import plot_optimizer
from prbayes.plots.outputs import plot_outputs
from prbayes.plots.population import plot_population
from prbayes.plots.posterior import plot_posterior
from prbayes.plots.responses import plot_responses
from prbayes.plots.stages import plot_stages
from prbayes.plots.validity import plot_validity
from prbayes.posterior.adjusting import adjust
from prbayes.posterior.bootstrapping import bootstrap
from prbayes.posterior.epsilon import calibrate_epsilon
from prbayes.posterior.sbc import simulation_based_calibration
from prbayes.posterior.smc import sample_smc
from prbayes.propagation.fresh import Fresh
from prbayes.propagation.resimulated import Resimulated
from prbayes.propagation.reweighted import Reweighted
from prbayes.reports.report import Report
from prbayes.response.calling import scalar
from prbayes.response.mock_up import fmu
from prbayes.response.program import command
from prbayes.response.um_bridge import umbridge
from prbayes.surrogate.surrogate import Surrogate
from prbayes.validation.cross_validation import cross_validate
from prbayes.validation.validity import area_test

__all__ = [
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
    "adjust",
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
    "sample_smc",
    "scalar",
    "sensitivity",
    "set_epsilon",
    "simulation_based_calibration",
    "surrogate",
    "umbridge",
    "validation",
]
