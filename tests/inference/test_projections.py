"""What the parts of a metric see of populations."""

import numpy as np

import prbayes as prb
from prbayes.inference.projections import number_parts, one_dimensional

RNG = np.random.default_rng(1)


def test_a_metric_of_one_output_sees_the_responses_themselves():
    target = prb.AreaMetric().against(RNG.normal(size=20))
    values = RNG.normal(size=(3, 50))
    (seen,) = one_dimensional(target, values)
    assert seen is values


def test_a_joint_metric_sees_a_number_in_each_direction():
    target = prb.Joint(prb.AreaMetric(), directions=5).against(RNG.normal(size=(20, 2)))
    values = RNG.normal(size=(3, 50, 2))
    seen = one_dimensional(target, values)
    assert [numbers.shape for numbers in seen] == [(3, 50)] * 5


def test_a_residual_of_correlations_sees_no_single_number():
    target = prb.MarginalCorrelation(prb.AreaMetric()).against(RNG.normal(size=(20, 3)))
    assert len(number_parts(target)) == 3
