from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytensor
import pytensor.tensor as pt
import pytest
from scipy.stats import wasserstein_distance

from prbayes._validate import Floats
from prbayes.metrics.area import AreaMetric
from prbayes.metrics.base import Minimum

INF, NAN = np.inf, np.nan
PYTHON = pytensor.compile.mode.Mode(linker="py", optimizer="fast_compile")
Draw = Callable[..., tuple[Floats, Floats, Floats, Floats]]


@pytest.mark.parametrize("d", [0.0, 0.3, -2.0, 50.0])
@pytest.mark.parametrize("s", [1.0, 0.5, 3.0])
def test_area_between_normals(normal: Callable[..., Floats], d: float, s: float) -> None:
    found = AreaMetric()(normal(d, s), normal(0, s))
    np.testing.assert_allclose(found, abs(d), rtol=1e-12, atol=1e-14)
    expected = abs(s - 1) * np.sqrt(2 / np.pi)
    found = AreaMetric()(normal(d, s, 3000), normal(d, 1))
    np.testing.assert_allclose(found, expected, rtol=2e-3, atol=1e-3)


@pytest.mark.parametrize("seed", range(5))
def test_area_is_the_first_wasserstein_distance(draw: Draw, seed: int) -> None:
    rng = np.random.default_rng(seed)
    for _ in range(20):
        x, w, z, u = draw(int(rng.integers(1 << 30)), *rng.integers(1, 40, 2))
        x[: x.size // 2] = np.round(x[: x.size // 2])  # ties
        z[: z.size // 2] = np.round(z[: z.size // 2])
        area = AreaMetric()(x, z, weights=5 * w, observed_weights=9 * u)
        np.testing.assert_allclose(area, wasserstein_distance(x, z, w, u), rtol=1e-11)
        np.testing.assert_allclose(AreaMetric()(x, z), wasserstein_distance(x, z), rtol=1e-11)


@pytest.mark.parametrize("seed", range(3))
def test_stored_values_with_ties_infinities_and_nan_give_the_same_area(
    draw: Draw, seed: int
) -> None:
    x, w, z, u = draw(seed)
    x, z = np.round(x, 1), np.round(z, 1)
    d = AreaMetric().against(z, u)
    rows = np.random.default_rng(seed).dirichlet(np.ones(x.size), (2, 3))
    stored = d.outer(*d.basis(x).features(rows), xp=np)
    np.testing.assert_allclose(stored, d(x, rows), rtol=1e-11)
    x[4] = INF
    failed = d.outer(*d.basis(x).features(w), xp=np)
    largest = max(z.max(), x[x < INF].max())
    np.testing.assert_allclose(failed, d(np.where(x == INF, largest, x), w), rtol=1e-11)
    x[4] = NAN
    unknown = d.outer(*d.basis(x).features(w), xp=np)
    np.testing.assert_allclose(unknown, failed, rtol=1e-11)


def test_area_of_symbolic_values_and_weights(draw: Draw) -> None:
    x, w, z, u = draw(8)
    x[3] = INF
    d = AreaMetric().against(z, u)
    y, v = pt.vector("y"), pt.vector("v")
    graph = d.outer(*d.features(y, v, pt), xp=pt)
    area, slope = pytensor.function([y, v], [graph, pytensor.grad(graph, y)], mode=PYTHON)(x, w)
    np.testing.assert_allclose(area, d(x, w), rtol=1e-12)
    e = 1e-7 * np.eye(x.size)
    by_differences = (d(x + e, w) - d(x - e, w)) / 2e-7
    np.testing.assert_allclose(slope, by_differences, rtol=1e-5, atol=1e-8)


@pytest.mark.parametrize("observed", [[0.1], [0.1, 0.1], np.full(6, 0.1)])
def test_equal_observed_values_need_no_bandwidth(draw: Draw, observed: Floats) -> None:
    x, w, _, _ = draw(11)
    found = AreaMetric()(x, observed, weights=w)
    np.testing.assert_allclose(found, w @ np.abs(x - 0.1), rtol=1e-12)
    assert AreaMetric().against(observed).scale == 1


def test_failed_specimens_count_below_and_their_infinite_interval_is_left_out() -> None:
    # F: 1/4 from 0, 1/2 from 2; S: 1/2 from 1, 1 from 3.
    # |F - S|: 1/4 on (0, 1), 1/4 on (1, 2), 0, then none.
    assert AreaMetric()([0.0, INF, 2.0, INF], [1.0, 3.0]) == pytest.approx(0.5)
    some = AreaMetric()([0.0, INF], [1.0, 3.0], weights=[1, 3])
    assert some == pytest.approx(0.25 + 2 * 0.25)
    assert AreaMetric()([INF, INF], [1.0, 3.0, 8.0]) == pytest.approx(8 - 4)


def test_many_weights_are_summed_to_the_same_digits(draw: Draw) -> None:
    x, _, z, u = draw(0)
    basis = AreaMetric().against(z, u).basis(np.round(x))
    n_rows = 1 + (1 << 15) // x.size
    weights = np.random.default_rng(1).dirichlet(np.ones(x.size), (2, n_rows))
    weights[..., 3] = 0
    weights[0, 0] = NAN  # a population without support
    expected = [basis.features(rows)[0] for rows in weights]
    read_only = np.asfortranarray(weights)
    read_only.flags.writeable = False
    for layout in (weights, read_only):
        np.testing.assert_array_equal(basis.features(layout)[0], expected)


def test_scale_is_the_mean_absolute_deviation() -> None:
    z = np.array([0.0, 1.0, 5.0])
    found = [AreaMetric().against(z, u).scale for u in (None, [1, 0, 1])]
    assert found == pytest.approx([2, 2.5])
    assert AreaMetric.minimum is Minimum.ABSOLUTE
    assert not AreaMetric().additive
