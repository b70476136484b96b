"""What models do not allow, as values."""

from typing import Any

import numpy as np
import pymc as pm
import pytest

import prbayes as prb
from prbayes.estimate.obstacles import Cause, refit_obstacle, sampling_obstacle
from prbayes.model.evaluator import Evaluator

OBSERVED = np.random.default_rng(1).normal(1.0, 0.5, 20)
KL = prb.KullbackLeibler()
OWN = prb.FunctionMetric(lambda z, y, w: np.abs((z * w).sum(-1) - y.mean()), weighted=True)


def model_of(metric: prb.Metric, propagation: Any) -> pm.Model:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), 0.5)
        prb.Simulator(
            "y", np.positive, x, metric=metric, observed=OBSERVED, propagation=propagation
        )
    return model


CASES: list[tuple[prb.Metric, Any, Cause | None]] = [
    (KL, prb.Reweighted(64), None),
    (KL, prb.Resimulated(64), None),
    (OWN, prb.Reweighted(64), None),
    (OWN, prb.Resimulated(64), Cause.COSTLY),
    (KL, prb.Fresh(64), Cause.RANDOM),
    (OWN, prb.Fresh(64), Cause.RANDOM),
]


@pytest.mark.parametrize(("metric", "propagation", "cause"), CASES)
def test_causes(metric: prb.Metric, propagation: Any, cause: Cause | None) -> None:
    evaluator = Evaluator(model_of(metric, propagation))
    for obstacle in (sampling_obstacle(evaluator), refit_obstacle(evaluator)):
        assert (None if obstacle is None else obstacle.cause) is cause
        assert obstacle is None or "y has " in str(obstacle)


def test_other_terms_forbid_refits_only() -> None:
    model = model_of(KL, prb.Reweighted(64))
    with model:
        pm.Potential("z", -(model["mu"] ** 2))
    evaluator = Evaluator(model)
    assert sampling_obstacle(evaluator) is None
    obstacle = refit_obstacle(evaluator)
    assert obstacle is not None
    assert obstacle.cause is Cause.OTHER_TERMS


def test_one_metric_of_ones_own_makes_all_responses_count() -> None:
    model = model_of(OWN, prb.Reweighted(64))
    with model:
        x = pm.Normal.dist(model["mu"], 0.5)
        prb.Simulator(
            "z", np.positive, x, metric=KL, observed=OBSERVED, propagation=prb.Resimulated(64)
        )
    obstacle = sampling_obstacle(Evaluator(model))
    assert obstacle is not None
    assert obstacle.cause is Cause.COSTLY
    assert "responses of z are not stored" in obstacle.reason
