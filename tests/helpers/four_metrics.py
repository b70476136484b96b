"""The metrics by short names, and what else tests of each of them share."""

from __future__ import annotations

from typing import Any

import pytest

import prbayes as prb

METRICS: dict[str, prb.Metric] = {
    "ll": prb.LogLikelihood(density=prb.GaussianKDE()),
    "kl": prb.KullbackLeibler(),
    "pr": prb.ProbabilityResidual(),
    "area": prb.AreaMetric(),
}
R256 = prb.Reweighted(256)


def slow(name: str) -> Any:
    """Return a parameter whose test is not part of the default run."""
    return pytest.param(name, marks=pytest.mark.slow)


def same(x: Any) -> Any:
    return x
