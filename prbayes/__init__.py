"""Statistical model calibration in PyMC: optimiser and ABC on one model, with one metric."""

from prbayes.density import GaussianKDE, Histogram
from prbayes.metrics import (
    AreaMetric,
    FunctionMetric,
    KullbackLeibler,
    LogLikelihood,
    Metric,
    ProbabilityResidual,
)
from prbayes.propagation import Fresh, Resimulated, Reweighted
from prbayes.responses import ResponseError
from prbayes.simulator import Simulator, abc_distance, set_epsilon
from prbayes.optimize import minimize
from prbayes.smc import sample_smc
from prbayes.epsilon import calibrate_epsilon
from prbayes.refinement import refine
