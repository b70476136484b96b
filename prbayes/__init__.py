"""Statistical model calibration in PyMC: optimiser and ABC on one model, with one metric."""

from importlib.metadata import version

from prbayes import datasets
from prbayes.adjust import Affine
from prbayes.bootstrap import bootstrap
from prbayes.calling import ResponseError, scalar
from prbayes.compare import compare
from prbayes.density import GaussianKDE, Histogram
from prbayes.diagnose import Diagnosis, diagnose
from prbayes.discrepancy import Metric
from prbayes.epsilon import calibrate_epsilon
from prbayes.failures import Abort, Replace, Retry
from prbayes.kernel import BatchedKernel
from prbayes.metrics import (
    AreaMetric,
    FunctionMetric,
    KullbackLeibler,
    LogLikelihood,
    ProbabilityResidual,
)
from prbayes.optimize import Optimum, minimize
from prbayes.propagation import Fresh, Resimulated, Reweighted
from prbayes.refinement import DesignError, refine
from prbayes.sbc import simulation_based_calibration
from prbayes.simulator import Simulator, abc_distance, set_epsilon
from prbayes.smc import sample_smc
from prbayes.store import StoreError
from prbayes.surfaces import Polynomial, RadialBasis, SurrogateError
from prbayes.surrogate import Surrogate

__version__ = version("prbayes")

__all__ = [
    "Abort",
    "Affine",
    "AreaMetric",
    "BatchedKernel",
    "DesignError",
    "Diagnosis",
    "Fresh",
    "FunctionMetric",
    "GaussianKDE",
    "Histogram",
    "KullbackLeibler",
    "LogLikelihood",
    "Metric",
    "Optimum",
    "Polynomial",
    "ProbabilityResidual",
    "RadialBasis",
    "Replace",
    "Resimulated",
    "ResponseError",
    "Retry",
    "Reweighted",
    "Simulator",
    "StoreError",
    "Surrogate",
    "SurrogateError",
    "abc_distance",
    "bootstrap",
    "calibrate_epsilon",
    "compare",
    "datasets",
    "diagnose",
    "minimize",
    "refine",
    "sample_smc",
    "scalar",
    "set_epsilon",
    "simulation_based_calibration",
]
