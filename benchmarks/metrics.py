"""The four metrics at their defaults, by the name of their class."""

import prbayes as prb

BY_NAME: dict[str, prb.Metric] = {
    "ProbabilityResidual": prb.ProbabilityResidual(),
    "KullbackLeibler": prb.KullbackLeibler(),
    "AreaMetric": prb.AreaMetric(),
    "LogLikelihood": prb.LogLikelihood(density=prb.GaussianKDE()),
}
