"""Findings about an optimum."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pymc as pm
import pytest

import prbayes as prb
from prbayes.model.evaluator import Evaluator
from prbayes.optimize.findings import optimum_findings
from prbayes.optimize.local_optima import Rival
from prbayes.propagation.importance import SIZES


@pytest.mark.parametrize(("clouds", "told"), [
    ([None], "pass a larger n or max_points to prb.Reweighted (now 300 runs)"),
    ([16384], "pass a larger n"),
    ([SIZES.largest, None], "pass a larger n"),
    ([SIZES.largest, SIZES.largest], "between its 300 runs are 65536 emulated points, the most"),
])  # fmt: skip
def test_no_larger_design_is_asked_for_where_points_cost_nothing(
    clouds: list[int | None], told: str
) -> None:
    of = [None if size is None else range(size) for size in clouds]
    designs = {
        f"y{k}": SimpleNamespace(design=SimpleNamespace(n_runs=300, emulated=cloud))
        for k, cloud in enumerate(of)
    }
    evaluator: Any = SimpleNamespace(nodes=(), reweighted=designs)
    (finding,) = optimum_findings(evaluator, None, (), 0.4)
    assert "by about 0.40 standard errors, expected at most 0.1" in finding.text
    assert told in finding.text
    assert optimum_findings(evaluator, None, (), 0.14) == ()


def test_a_mirror_is_told_by_standard_deviations_and_correlations() -> None:
    """Not by the elements of a packed factor, of which nobody knows what they mean."""
    response = np.random.default_rng(0).normal(size=(20, 2))
    with pm.Model(coords={"part": ["rod", "pin"]}) as model:
        mean = pm.Normal("mean", 0, 1, dims="part")
        sds = pm.HalfNormal.dist(1, shape=2)
        chol, _, _ = pm.LKJCholeskyCov("cov", n=2, eta=2, sd_dist=sds)
        x = pm.MvNormal.dist(mean, chol=chol, shape=2)
        prb.Simulator("y", np.positive, x, metric=prb.Joint(prb.AreaMetric()), observed=response)
    evaluator = Evaluator.of(model)
    point = {"mean": [1.0, 2.0], "cov": [0.5, -0.3, 0.4]}
    rival = Rival(
        evaluator.hyperparameters.unconstrained(point), 0.1, comparable=True, better=False
    )
    (finding,) = optimum_findings(evaluator, None, (rival,), 0.0)
    assert (
        "come from mean[rod] = 1, mean[pin] = 2, cov_stds[0] = 0.5, cov_stds[1] = 0.5, "
        "cov_corr[0,1] = -0.6: another optimum"
    ) in finding.text
