"""What metrics of several outputs have in common."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from prbayes._validate import Floats
from prbayes.metrics.area import AreaMetric
from prbayes.metrics.base import Metric, is_additive, is_likelihood
from prbayes.metrics.correlation import MarginalCorrelation
from prbayes.metrics.density import GaussianKDE
from prbayes.metrics.divergence import KullbackLeibler
from prbayes.metrics.joint import Joint
from prbayes.metrics.likelihood import LogLikelihood
from prbayes.metrics.multivariate import failure_caps
from prbayes.metrics.residual import ProbabilityResidual

INF, NAN = np.inf, np.nan
Lift = Callable[[Metric], Metric]
LIFTED: dict[str, Metric] = {
    "pr": ProbabilityResidual(),
    "kl": KullbackLeibler(),
    "kl-reverse": KullbackLeibler(reverse=True),
    "ll": LogLikelihood(density=GaussianKDE()),
    "area": AreaMetric(),
}
by_metric = pytest.mark.parametrize("metric", LIFTED.values(), ids=LIFTED)
both = pytest.mark.parametrize("lift", [Joint, MarginalCorrelation])


def sample(n: int, seed: int = 0) -> Floats:
    y = np.random.default_rng(seed).standard_normal((n, 2))
    y[:, 1] += y[:, 0]
    return y


@both
@by_metric
def test_one_output_is_the_metric_itself(lift: Lift, metric: Metric) -> None:
    x, z = sample(40)[:, 0], sample(20, seed=1)[:, 0]
    x[0] = INF
    w, u = np.random.default_rng(2).dirichlet(np.ones(40)), np.arange(1.0, 21.0)
    flat, column = lift(metric).against(z, u), lift(metric).against(z[:, None], u)
    expected = metric.against(z, u)
    assert type(flat) is type(expected)
    assert flat(x, w) == expected(x, w) == column(x[:, None], w)
    assert (column.event, column.scale, is_likelihood(column)) == (
        (1,),
        expected.scale,
        metric.likelihood,
    )
    basis = column.basis(x[:, None])
    rows = np.stack([w, w[::-1]])
    np.testing.assert_array_equal(
        column.outer(*basis.features(rows), xp=np),
        expected.outer(*expected.basis(x).features(rows), xp=np),
    )
    others = column.with_observed(x[1:9, None]), expected.with_observed(x[1:9])
    assert others[0](x[:, None], w) == others[1](x, w)


def test_every_metric_declares_what_its_inner_one_does() -> None:
    for metric in LIFTED.values():
        joint = Joint(metric)
        for name in ("minimum", "additive", "takes_weights", "tail_responses", "distance"):
            assert getattr(joint, name) == getattr(metric, name)
        d = joint.against(sample(30))
        assert joint.takes_outputs
        assert (is_likelihood(d), is_additive(d)) == (False, metric.additive)
        assert not joint.likelihood
    assert Joint(AreaMetric(), directions=5).like(KullbackLeibler()) == Joint(
        KullbackLeibler(), directions=5
    )
    assert AreaMetric().like(KullbackLeibler()) == KullbackLeibler()
    assert hash(Joint(AreaMetric(), directions=5)) != hash(Joint(AreaMetric(), directions=6))
    assert (
        repr(Joint(AreaMetric(), directions=5))
        == "Joint(metric=AreaMetric(), directions=5, components=None, random_seed=0)"
    )


@both
@pytest.mark.parametrize("metric", [3, AreaMetric, Joint(AreaMetric())])
def test_only_a_metric_of_one_output_is_lifted(lift: Any, metric: Any) -> None:
    with pytest.raises(TypeError, match="expected a metric of one output"):
        lift(metric)


def test_a_failure_counts_as_the_largest_value_and_the_range_beyond() -> None:
    y = np.array([[1.0, NAN], [4.0, -2.0], [INF, -1.0], [3.0, -5.0]])
    np.testing.assert_array_equal(failure_caps(y), [7.0, 3.0])


def test_data_of_no_shape_are_left_to_the_metric_of_one_output() -> None:
    with pytest.raises(ValueError, match=r"shape \(\), expected one dimension"):
        Joint(AreaMetric()).against(3.0)
