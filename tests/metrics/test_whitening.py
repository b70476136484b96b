"""Principal components of curves and whitened coordinates: invariance, robustness, remainders."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import prbayes as prb
from prbayes._validate import Floats
from prbayes.metrics.whitening import principal_components, whitening

T = np.linspace(0.1, 1.0, 40)
EQUAL = np.full(30, 1 / 30)


def curves(n: int, seed: int = 1, noise: float = 0.0) -> Floats:
    """Return curves of two inputs, (n, 40), with noise."""
    rng = np.random.default_rng(seed)
    a = rng.normal(2.0, 0.5, (n, 1))
    b = rng.normal(1.0, 0.3, (n, 1))
    return np.asarray(a * T + b * T**3 + noise * rng.standard_normal((n, 40)))


def test_two_inputs_make_two_components_and_a_remainder_is_noise_or_structure() -> None:
    found = principal_components(curves(30), EQUAL, 2)
    np.testing.assert_allclose(found.axes.T @ found.axes, np.eye(2), atol=1e-12)
    scores = (curves(30) - found.center) @ found.axes
    np.testing.assert_allclose(found.center + scores @ found.axes.T, curves(30), atol=1e-10)
    assert "40 outputs are compared by 2 principal component(s)" in found.summary
    noisy = principal_components(curves(30, noise=0.2), EQUAL, 2)
    shifted = principal_components(curves(30, noise=0.2) - 70, EQUAL, 2)
    np.testing.assert_allclose(shifted.axes, noisy.axes, atol=1e-9)
    np.testing.assert_allclose(shifted.center, noisy.center - 70, rtol=1e-9)
    assert noisy.left_out > 0.01
    assert abs(noisy.rest_correlation) < 0.2
    too_few = principal_components(curves(30), EQUAL, 1)
    assert too_few.rest_correlation > 0.5
    assert "it is no noise" in too_few.missed
    assert not found.missed
    assert not noisy.missed
    assert "noise that the model has too" in replace(noisy, design_left_out=0.2).missed


def test_the_fewest_that_leave_out_a_hundredth_of_data_and_design() -> None:
    sample = curves(30)
    alone = principal_components(sample, EQUAL)
    assert alone.number <= 2
    # Populations of the design vary in a way in which the data do not.
    more = curves(400, 2) + np.random.default_rng(3).normal(0, 0.4, (400, 1)) * np.sin(9 * T)
    both = principal_components(sample, EQUAL, design=more)
    assert both.number == alone.number + 1
    assert max(both.left_out, both.design_left_out) < 0.01
    # A design far from the data does not decide.
    far = 1e3 * np.random.default_rng(4).standard_normal((200, 40))
    beside = principal_components(sample, EQUAL, 2, design=np.concatenate([curves(200, 5), far]))
    assert beside.left_out < 0.01


def test_gross_outliers_do_not_decide() -> None:
    sample = curves(60, noise=0.01)
    sample[:3] += 50 * np.random.default_rng(6).standard_normal((3, 40))
    found = principal_components(sample, np.full(60, 1 / 60), 2)
    rest = sample[3:] - found.center
    assert (rest - rest @ found.axes @ found.axes.T).std() < 0.02


def test_a_joint_metric_compares_curves_by_their_scores() -> None:
    sample, simulated = curves(30, noise=0.01), curves(500, 7)
    target: Any = prb.Joint(prb.AreaMetric()).against(sample)
    (found,) = target.components
    assert (found.number, len(target.parts)) == (2, 4)
    scores = (sample - found.center) @ found.axes
    expected = prb.Joint(prb.AreaMetric()).against(scores)((simulated - found.center) @ found.axes)
    assert target(simulated) == pytest.approx(expected, rel=1e-9)
    # Few outputs are compared themselves, unless components are requested.
    few: Any = [
        prb.Joint(prb.AreaMetric(), components=c).against(sample[:, ::10]) for c in (None, 1)
    ]
    assert [len(d.components) for d in few] == [0, 1]
    # Curves that end early are compared as far as they go.
    sample[:10, 30:] = np.nan
    target = prb.Joint(prb.AreaMetric()).against(sample)
    assert [c.axes.shape[0] for c in target.components] == [40, 30]
    assert target(simulated) < target(simulated * 1.2)


def coordinates(y: Floats, weights: Floats | None = None) -> Floats:
    u = np.full(len(y), 1 / len(y)) if weights is None else weights
    center, axes = whitening(y, u, np.arange(y.shape[1]))
    return (y - center) @ axes


def correlated(rho: float, n: int = 50, m: int = 2) -> Floats:
    y = np.random.default_rng(0).standard_normal((n, m))
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
    without = np.repeat(coordinates(y, k / k.sum()), k, axis=0)
    np.testing.assert_allclose(without, repeated, rtol=1e-9)


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


def test_degenerate_samples_are_whitened_if_possible() -> None:
    y = correlated(0.5, 60)
    y[:30] = 0.0  # more than a third: a t distribution of one degree would shrink to them
    assert np.isfinite(coordinates(y)).all()
    np.testing.assert_allclose(coordinates(y @ [[2.0, 1.0], [0.0, 3.0]]), coordinates(y), rtol=1e-6)
    y = correlated(0.0, 400)
    near = y @ [[1.0, 1.0], [0.0, 2e-5]]
    np.testing.assert_allclose(coordinates(near), coordinates(y), rtol=1e-4, atol=1e-5)


def test_signs_are_those_of_the_data_in_any_order() -> None:
    y = np.random.default_rng(0).exponential(size=(50, 2))
    z = coordinates(y)
    for signs in ([1, -1], [-1, 1], [-1, -1]):
        np.testing.assert_allclose(coordinates(y * signs), z, rtol=1e-7, atol=1e-8)
    for seed in range(8):
        order = np.random.default_rng(seed).permutation(50)
        np.testing.assert_allclose(coordinates(y[order]), z[order], atol=1e-8)
    # The longer tail of each coordinate is on its positive side, whatever a gross outlier does.
    assert (z.max(axis=0) > -z.min(axis=0)).all()
    for far in (-1e3, 1e3):
        y[0] = far
        assert ((coordinates(y) * z)[1:].sum(axis=0) > 0).all()


FEW = np.r_[np.ones(3), np.zeros(47)] / 3


@pytest.mark.parametrize(
    ("spoil", "weights", "message"),
    [
        (lambda y: y[:3], None, r"3 specimens with finite outputs 0, 2 .*at least 4 for 2 outputs"),
        (lambda y: y, FEW, "3 specimens with finite outputs"),
        (lambda y: y * [1, 0], None, "equal values of output 2"),
        (lambda y: y[:, [0, 0]], None, "outputs 0, 2 .*depend on each other linearly"),
        (lambda y: y[:, [0, 0]] + 3e-6 * y, None, "outputs 0, 2 .*depend on each other linearly"),
    ],
)
def test_errors_name_the_outputs(spoil: Any, weights: Any, message: str) -> None:
    y = spoil(correlated(0.5))
    weights = np.full(len(y), 1 / len(y)) if weights is None else weights
    with pytest.raises(ValueError, match=message):
        whitening(y, weights, np.array([0, 2]))
