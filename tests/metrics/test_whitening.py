"""Principal components of curves, and whitened coordinates: what they leave out, what moves them."""

from __future__ import annotations

import numpy as np
import pytest

import prbayes as prb
from prbayes._validate import Floats
from prbayes.metrics.whitening import principal_components, whitening

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


def coordinates(y: Floats, weights: Floats | None = None) -> Floats:
    u = np.full(len(y), 1 / len(y)) if weights is None else weights
    center, axes = whitening(y, u, np.arange(y.shape[1]))
    return (y - center) @ axes


def correlated(rho: float, n: int = 50, m: int = 2, seed: int = 0) -> Floats:
    y = np.random.default_rng(seed).standard_normal((n, m))
    y[:, 1] = rho * y[:, 0] + np.sqrt(1 - rho**2) * y[:, 1]
    return y


@pytest.mark.parametrize(
    ("m", "n", "rho"), [(2, 50, 0.95), (2, 9, -0.995), (4, 40, 0.9999), (8, 60, 0)]
)
def test_an_affine_map_of_the_outputs_changes_nothing(m: int, n: int, rho: float) -> None:
    rng = np.random.default_rng(m)
    y = correlated(rho, n, m)
    before = coordinates(y)
    maps = [rng.standard_normal((m, m)) for _ in range(3)]
    maps += [np.eye(m)[rng.permutation(m)], -np.eye(m), np.diag(10.0 ** rng.integers(-150, 150, m))]
    for matrix in maps:
        np.testing.assert_allclose(coordinates(y @ matrix.T), before, rtol=1e-7, atol=1e-8)
    np.testing.assert_allclose(coordinates(y + 1e3), before, rtol=1e-7, atol=1e-8)


def test_a_normal_sample_has_unit_spread_in_all_directions() -> None:
    z = coordinates(correlated(0.9, 4000, 3))
    np.testing.assert_allclose(np.cov(z.T), np.eye(3), atol=0.1)


def test_weights_are_repetitions_and_weight_zero_is_not_there() -> None:
    y = correlated(0.8, 20)
    k = np.arange(20) % 4
    repeated = np.repeat(coordinates(y, k / k.sum()), k, axis=0)
    ratio = repeated / coordinates(np.repeat(y, k, axis=0))
    np.testing.assert_allclose(ratio, ratio[0, 0], rtol=1e-7, err_msg="up to the median's size")
    assert ratio[0, 0] == pytest.approx(1, abs=0.1)
    y[k == 0] = 1e5
    np.testing.assert_allclose(
        np.repeat(coordinates(y, k / k.sum()), k, axis=0), repeated, rtol=1e-9
    )


@pytest.mark.parametrize("distance", [8.0, 1e3])
def test_gross_outliers_move_it_little(distance: float) -> None:
    y = correlated(0.9, 400)
    center, axes = whitening(y, np.full(400, 1 / 400), np.arange(2))
    y[:20] = distance
    other_center, other_axes = whitening(y, np.full(400, 1 / 400), np.arange(2))
    # Scatter of the one in coordinates of the other; mean and covariance would be 8 or 1e5 off.
    back = np.linalg.inv(other_axes) @ axes
    np.testing.assert_allclose(np.linalg.svd(back)[1], 1, atol=0.2)
    assert np.abs((other_center - center) @ axes).max() < 0.15


def test_equal_specimens_that_have_no_robust_scatter_are_whitened_all_the_same() -> None:
    y = correlated(0.5, 60)
    y[:30] = 0.0  # more than a third: a t distribution of one degree would shrink to them
    assert np.isfinite(coordinates(y)).all()
    np.testing.assert_allclose(coordinates(y @ [[2.0, 1.0], [0.0, 3.0]]), coordinates(y), rtol=1e-6)


def test_outputs_that_nearly_depend_on_each_other_are_told_apart() -> None:
    y = correlated(0.0, 400)
    near = y @ [[1.0, 1.0], [0.0, 2e-5]]
    np.testing.assert_allclose(coordinates(near), coordinates(y), rtol=1e-4, atol=1e-5)


def test_signs_are_those_of_the_data_in_any_order() -> None:
    y = np.random.default_rng(0).exponential(size=(50, 2))
    for signs in ([1, -1], [-1, 1], [-1, -1]):
        np.testing.assert_allclose(coordinates(y * signs), coordinates(y), rtol=1e-7, atol=1e-8)
    for seed in range(8):
        order = np.random.default_rng(seed).permutation(50)
        np.testing.assert_allclose(coordinates(y[order]), coordinates(y)[order], atol=1e-8)
    # The longer tail of each coordinate is on its positive side.
    z = coordinates(y)
    assert (z.max(axis=0) > -z.min(axis=0)).all()


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (
            lambda y: y[:3],
            r"3 specimens with finite outputs 0, 2 .*at least 4 for 2 outputs; leave",
        ),
        (lambda y: y * [1, 0], "equal values of output 2 .*leave that output out"),
        (lambda y: y[:, [0, 0]], "outputs 0, 2 .*depend on each other linearly.*leave one of them"),
        (lambda y: y[:, [0, 0]] + 3e-6 * y, "outputs 0, 2 .*depend on each other linearly"),
    ],
)
def test_what_cannot_be_whitened_is_told_by_outputs(spoil: object, message: str) -> None:
    y = spoil(correlated(0.5))  # type: ignore[operator]
    with pytest.raises(ValueError, match=message):
        whitening(y, np.full(len(y), 1 / len(y)), np.array([0, 2]))


def test_specimens_without_weight_are_not_counted() -> None:
    weights = np.r_[np.ones(3), np.zeros(47)] / 3
    with pytest.raises(ValueError, match="3 specimens with finite outputs"):
        whitening(correlated(0.5), weights, np.arange(2))
