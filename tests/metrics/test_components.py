"""Principal components of curves: how many there are, what they leave out, whether that is noise."""

import numpy as np
import pytest

import prbayes as prb
from prbayes.metrics.components import principal_components

T = np.linspace(0.1, 1.0, 40)
EQUAL = np.full(30, 1 / 30)


def curves(n, seed=1, noise=0.0):
    """Return curves of two inputs, (n, 40), with noise of their own."""
    rng = np.random.default_rng(seed)
    a = rng.normal(2.0, 0.5, (n, 1))
    b = rng.normal(1.0, 0.3, (n, 1))
    return a * T + b * T**3 + noise * rng.standard_normal((n, 40))


def test_two_inputs_make_two_components():
    found = principal_components(curves(30), EQUAL, 2)
    np.testing.assert_allclose(found.axes.T @ found.axes, np.eye(2), atol=1e-12)
    assert found.left_out == pytest.approx(0, abs=1e-12)
    scores = (curves(30) - found.center) @ found.axes
    np.testing.assert_allclose(found.center + scores @ found.axes.T, curves(30), atol=1e-10)


def test_what_is_left_out_is_noise_or_not():
    noisy = principal_components(curves(30, noise=0.02), EQUAL, 2)
    assert 0 < noisy.left_out < 0.05
    assert abs(noisy.rest_correlation) < 0.2
    too_few = principal_components(curves(30, noise=0.02), EQUAL, 1)
    assert too_few.rest_correlation > 0.5


def test_as_many_as_leave_out_a_hundredth_of_data_and_design():
    sample = curves(30)
    alone = principal_components(sample, EQUAL)
    assert alone.number <= 2
    # Populations of the design vary in a way in which the data do not.
    more = curves(400, 2) + np.random.default_rng(3).normal(0, 0.4, (400, 1)) * np.sin(9 * T)
    both = principal_components(sample, EQUAL, design=more)
    assert both.number == alone.number + 1
    assert both.left_out < 0.01
    assert both.design_left_out < 0.01


def test_a_design_far_from_the_data_does_not_decide():
    sample = curves(30)
    far = 1e3 * np.random.default_rng(4).standard_normal((200, 40))
    found = principal_components(sample, EQUAL, 2, design=np.concatenate([curves(200, 5), far]))
    assert found.left_out < 0.01


def test_gross_outliers_do_not_decide():
    sample = curves(60, noise=0.01)
    sample[:3] += 50 * np.random.default_rng(6).standard_normal((3, 40))
    found = principal_components(sample, np.full(60, 1 / 60), 2)
    rest = sample[3:] - found.center
    rest = rest - rest @ found.axes @ found.axes.T
    assert rest.std() < 0.02


def test_a_joint_metric_compares_curves_by_their_scores():
    sample = curves(30, noise=0.01)
    target = prb.Joint(prb.AreaMetric()).against(sample)
    (found,) = target.components
    assert found.number == 2
    assert len(target.parts) == 4
    # As the scores themselves are compared.
    scores = (sample - found.center) @ found.axes
    simulated = curves(500, 7)
    expected = prb.Joint(prb.AreaMetric()).against(scores)((simulated - found.center) @ found.axes)
    assert target(simulated) == pytest.approx(expected, rel=1e-9)


def test_few_outputs_are_compared_themselves_unless_components_are_asked_for():
    sample = curves(30, noise=0.1)[:, ::10]
    assert not prb.Joint(prb.AreaMetric()).against(sample).components
    (found,) = prb.Joint(prb.AreaMetric(), components=1).against(sample).components
    assert found.number == 1


def test_curves_that_end_early_are_compared_as_far_as_they_go():
    sample = curves(40, noise=0.01)
    sample[:10, 30:] = np.nan
    target = prb.Joint(prb.AreaMetric()).against(sample)
    assert [c.axes.shape[0] for c in target.components] == [40, 30]
    simulated = curves(500, 7)
    assert target(simulated) < target(simulated * 1.2)


def test_what_is_left_out_is_told_and_said_if_it_is_no_noise() -> None:
    enough = principal_components(curves(30), EQUAL, 2)
    assert "40 outputs are compared by 2 principal component(s)" in enough.summary
    assert not enough.missed
    too_few = principal_components(curves(30), EQUAL, 1)
    assert too_few.left_out > 0.01
    assert "it is no noise" in too_few.missed
    noisy = principal_components(curves(30, noise=0.2), EQUAL, 2)
    assert noisy.left_out > 0.01
    assert not noisy.missed
