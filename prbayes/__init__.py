"""Statistical model calibration in PyMC: optimiser and ABC on one model, with one metric."""

from importlib.metadata import version

from prbayes import datasets
from prbayes._compare import compare
from prbayes._diagnose import Diagnosis, diagnose
from prbayes._predict import predict
from prbayes.estimate.minimization import minimize, refine
from prbayes.estimate.optimum import Optimum
from prbayes.metrics.area import AreaMetric
from prbayes.metrics.base import Metric
from prbayes.metrics.density import GaussianKDE, Histogram
from prbayes.metrics.divergence import KullbackLeibler
from prbayes.metrics.function import FunctionMetric
from prbayes.metrics.likelihood import LogLikelihood
from prbayes.metrics.residual import ProbabilityResidual
from prbayes.model.simulator import Simulator, abc_distance, set_epsilon
from prbayes.model.support import DesignError
from prbayes.plots.comparison import plot_comparison
from prbayes.plots.landscape import plot_landscape
from prbayes.plots.optimizer import plot_optimizer
from prbayes.plots.population import plot_population
from prbayes.plots.posterior import plot_posterior
from prbayes.plots.responses import plot_responses
from prbayes.plots.stages import plot_stages
from prbayes.plots.validity import plot_validity
from prbayes.posterior.adjustment import Affine
from prbayes.posterior.bootstrapping import bootstrap
from prbayes.posterior.epsilon import calibrate_epsilon
from prbayes.posterior.sbc import simulation_based_calibration
from prbayes.posterior.smc import sample_smc
from prbayes.posterior.smc_kernel import BatchedKernel
from prbayes.propagation.fresh import Fresh
from prbayes.propagation.resimulated import Resimulated
from prbayes.propagation.reweighted import Reweighted
from prbayes.reports.report import Report
from prbayes.reports.section import Section
from prbayes.response.calling import ResponseError, scalar
from prbayes.response.failures import Abort, Replace, Retry
from prbayes.response.store import StoreError
from prbayes.surrogate.error import CrossValidation as SurrogateError
from prbayes.surrogate.surfaces import Polynomial, RadialBasis
from prbayes.surrogate.surrogate import Surrogate
from prbayes.validation.cross_validation import cross_validate
from prbayes.validation.exact_model import ExactModel
from prbayes.validation.joint_null import JointNull
from prbayes.validation.nulls import PosteriorNull
from prbayes.validation.probability_transform import u_values
from prbayes.validation.validity import ValidityTest, area_test

__version__ = version("prbayes")

__all__ = [
    "Abort",
    "Affine",
    "AreaMetric",
    "BatchedKernel",
    "DesignError",
    "Diagnosis",
    "ExactModel",
    "Fresh",
    "FunctionMetric",
    "GaussianKDE",
    "Histogram",
    "JointNull",
    "KullbackLeibler",
    "LogLikelihood",
    "Metric",
    "Optimum",
    "Polynomial",
    "PosteriorNull",
    "ProbabilityResidual",
    "RadialBasis",
    "Replace",
    "Report",
    "Resimulated",
    "ResponseError",
    "Retry",
    "Reweighted",
    "Section",
    "Simulator",
    "StoreError",
    "Surrogate",
    "SurrogateError",
    "ValidityTest",
    "abc_distance",
    "area_test",
    "bootstrap",
    "calibrate_epsilon",
    "compare",
    "cross_validate",
    "datasets",
    "diagnose",
    "minimize",
    "plot_comparison",
    "plot_landscape",
    "plot_optimizer",
    "plot_population",
    "plot_posterior",
    "plot_responses",
    "plot_stages",
    "plot_validity",
    "predict",
    "refine",
    "sample_smc",
    "scalar",
    "set_epsilon",
    "simulation_based_calibration",
    "u_values",
]
