"""Principal components of curves and whitened coordinates: invariance, robustness, remainders."""

from __future__ import annotations

from typing import Any

import numpy as np
import pymc as pm
import pytest

import prbayes as prb
from prbayes._validate import Floats
from prbayes.metrics.whitening import principal_components, whitening
from prbayes.model.evaluator import Evaluator

T = np.linspace(0.1, 1.0, 40)
EQUAL = np.full(30, 1 / 30)
ALL = np.arange(40)


def curves(n: int, seed: int = 1, noise: float = 0.0) -> Floats:
    """Return curves of two inputs, (n, 40), with noise."""
    rng = np.random.default_rng(seed)
    a = rng.normal(2.0, 0.5, (n, 1))
    b = rng.normal(1.0, 0.3, (n, 1))
    return np.asarray(a * T + b * T**3 + noise * rng.standard_normal((n, 40)))


def test_two_inputs_make_two_components_and_a_remainder_is_noise_or_structure() -> None:
    found = principal_components(curves(30), EQUAL, ALL, 2)
    np.testing.assert_allclose(found.axes.T @ found.axes, np.eye(2), atol=1e-12)
    scores = (curves(30) - found.center) @ found.axes
    np.testing.assert_allclose(found.center + scores @ found.axes.T, curves(30), atol=1e-10)
    assert "40 outputs are compared by 2 principal components" in found.summary
    noisy = principal_components(curves(30, noise=0.2), EQUAL, ALL, 2)
    shifted = principal_components(curves(30, noise=0.2) - 70, EQUAL, ALL, 2)
    np.testing.assert_allclose(shifted.axes, noisy.axes, atol=1e-9)
    np.testing.assert_allclose(shifted.center, noisy.center - 70, rtol=1e-9)
    assert noisy.left_out > 0.01
    assert abs(noisy.rest_correlation) < 0.2
    too_few = principal_components(curves(30), EQUAL, ALL, 1)
    assert too_few.rest_correlation > 0.5
    assert "this is not noise" in too_few.missed(0.0)
    assert not found.missed(0.0)
    assert not noisy.missed(0.0)
    assert "noise that the model also has" in noisy.missed(0.2)


def test_the_fewest_that_leave_out_a_hundredth_and_a_population_that_varies_elsewhere() -> None:
    found = principal_components(curves(30), EQUAL, ALL)
    assert found.number <= 2
    assert found.left_out < 0.01
    similar = curves(400, 2)
    weights = np.arange(400) / np.arange(400).sum()
    assert not found.missed(found.share_left_out(similar, weights))
    # The population varies in a way in which the data do not.
    other = similar + np.random.default_rng(3).normal(0, 0.4, (400, 1)) * np.sin(9 * T)
    share = found.share_left_out(other, weights)
    deviations = other - weights @ other
    scores = deviations @ found.axes
    explained = (weights @ scores**2).sum() / (weights @ deviations**2).sum()
    assert share == pytest.approx(1 - explained, rel=1e-9)
    assert f"but {share:.2g} of that of the best population" in found.missed(share)
    # Points without response, and failed ones, have no influence.
    other[0] = np.nan
    other[1, 3] = np.inf
    assert found.share_left_out(other, weights) == pytest.approx(share, rel=1e-3)


def test_components_of_noise_have_its_typical_variance() -> None:
    # Lines with noise: the largest component of the noise has about 2.5 times its variance.
    times = np.arange(10.0)
    sizes = []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        lines = rng.normal(0, 100, (18, 1)) + rng.normal(0, 50, (18, 1)) * times
        sample = lines + rng.normal(0, 1, (18, 10))
        found = principal_components(sample, np.full(18, 1 / 18), np.arange(10), 3)
        scores = (sample - found.center) @ found.axes
        sizes.append(scores.std(axis=0))
    assert (np.min(sizes, axis=0)[:2] > 10).all()
    assert np.log(np.median(sizes, axis=0)[2]) == pytest.approx(0, abs=0.25)


def test_gross_outliers_do_not_decide() -> None:
    sample = curves(60, noise=0.01)
    sample[:3] += 50 * np.random.default_rng(6).standard_normal((3, 40))
    found = principal_components(sample, np.full(60, 1 / 60), ALL, 2)
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


def test_coordinates_do_not_depend_on_the_propagation_or_the_prior() -> None:
    found = []
    for propagation, sd in ((prb.Resimulated(64), 1.0), (prb.Reweighted(64), 5.0)):
        with pm.Model() as model:
            a = pm.Normal.dist(pm.Normal("mean", 2, sd), pm.HalfNormal("sd", sd))
            prb.Simulator(
                "y",
                lambda a: np.asarray(a)[..., None] * T,
                a,
                metric=prb.Joint(prb.AreaMetric()),
                observed=curves(30, noise=0.01),
                propagation=propagation,
            )
        target: Any = Evaluator.of(model).nodes[0].target
        projections = [part.projection for part in target.parts]
        found.append(np.array([[p.center, p.direction] for p in projections]))
    np.testing.assert_array_equal(*found)


def coordinates(y: Floats, weights: Floats | None = None) -> Floats:
    u = np.full(len(y), 1 / len(y)) if weights is None else weights
    center, axes = whitening(y, u, np.arange(y.shape[1]))
    return (y - center) @ axes


def correlated(rho: float, n: int = 50, m: int = 2) -> Floats:
    y = np.random.default_rng(0).standard_normal((n, m))
    y[:, 1] = rho * y[:, 0] + np.sqrt(1 - rho**2) * y[:, 1]
    return y


@pytest.mark.parametrize(
    ("m", "n", "rho"), [(2, 50, 0.95), (2, 10, -0.995), (4, 40, 0.9999), (8, 110, 0)]
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


def test_a_combination_that_scatters_little_by_chance_does_not_decide() -> None:
    # Three readings of specimens: the difference of two readings and that of their mean from the
    # third have equal variances, but not in data of six specimens.
    contrasts = np.array([[1, -1, 0], [1, 1, -2]]).T / np.sqrt([2, 6])
    ratios = []
    for seed in range(10):
        rng = np.random.default_rng([seed, 6])
        y = rng.normal(0, 25, (6, 1)) + rng.normal(0, 4, (6, 3))
        _, axes = whitening(y, np.full(6, 1 / 6), np.arange(3))
        size = np.linalg.svd(axes.T @ contrasts)[1]
        ratios.append(np.log(size[0] / size[1]))
    assert np.median(ratios) < 0.3  # .64 without shrinkage


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
