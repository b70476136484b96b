"""Unknown errors of several outputs, whose points are those of errors with a common factor."""

from typing import Any

import numpy as np
import pymc as pm
import pytest

import prbayes as prb


@pytest.mark.parametrize(("shape", "is_reported"), [((), False), (2, True)])
def test_several_unknown_errors_are_reported(shape: Any, is_reported: bool) -> None:
    rng = np.random.default_rng(3)
    x = rng.normal(1.0, 0.5, 12)
    y = np.stack([x, 2.0 * x], axis=1) + 0.1 * rng.standard_normal((12, 2))
    with pm.Model():
        population = pm.Normal.dist(pm.Normal("mu", 0.0, 2.0), 0.5)
        metric = prb.LogLikelihood(error=pm.HalfNormal("error", 0.3, shape=shape))
        response = lambda x: np.stack([x, 2.0 * x], axis=-1)  # noqa: E731
        prb.Simulator("y", response, population, observed=y, metric=metric)
        codes = [finding.code for finding in prb.minimize().findings]
    assert ("several-errors" in codes) == is_reported
