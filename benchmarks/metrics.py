"""The four metrics at their defaults, by a short name and by that of their class."""

import prbayes as prb

METRICS: dict[str, prb.Metric] = {
    "PR": prb.ProbabilityResidual(),
    "KLD": prb.KullbackLeibler(),
    "area": prb.AreaMetric(),
    "log-likelihood": prb.LogLikelihood(density=prb.GaussianKDE()),
}
BY_CLASS = {type(metric).__name__: metric for metric in METRICS.values()}
