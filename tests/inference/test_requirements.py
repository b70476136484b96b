"""What models do not allow, as values."""

from typing import Any

import numpy as np
import pymc as pm
import pytest

import prbayes as prb
from prbayes.inference.requirements import refit_obstacle, sampling_obstacle
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


CASES: list[tuple[prb.Metric, Any, str | None]] = [
    (KL, prb.Reweighted(64), None),
    (KL, prb.Resimulated(64), None),
    (OWN, prb.Reweighted(64), None),
    (OWN, prb.Resimulated(64), "these need stored responses"),
    (KL, prb.Fresh(64), "whose discrepancy is random"),
    (OWN, prb.Fresh(64), "whose discrepancy is random"),
]


@pytest.mark.parametrize(("metric", "propagation", "reason"), CASES)
def test_reasons_name_the_simulator(
    metric: prb.Metric, propagation: Any, reason: str | None
) -> None:
    evaluator = Evaluator.of(model_of(metric, propagation))
    for obstacle in (sampling_obstacle(evaluator), refit_obstacle(evaluator)):
        if reason is None:
            assert obstacle is None
        else:
            assert obstacle is not None
            assert obstacle.startswith("y has ")
            assert reason in obstacle


def test_other_terms_forbid_refits_only() -> None:
    model = model_of(KL, prb.Reweighted(64))
    with model:
        pm.Potential("z", -(model["mu"] ** 2))
    evaluator = Evaluator.of(model)
    assert sampling_obstacle(evaluator) is None
    assert "likelihood terms or potentials" in str(refit_obstacle(evaluator))


def test_one_metric_of_ones_own_makes_all_responses_count() -> None:
    model = model_of(OWN, prb.Reweighted(64))
    with model:
        x = pm.Normal.dist(model["mu"], 0.5)
        prb.Simulator(
            "z", np.positive, x, metric=KL, observed=OBSERVED, propagation=prb.Resimulated(64)
        )
    assert "responses of z are not stored" in str(sampling_obstacle(Evaluator.of(model)))
