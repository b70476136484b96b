"""The area metric of failed, stored and symbolic values (the distance: test_properties.py)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytensor
import pytensor.tensor as pt
import pytest

from prbayes._validate import Floats
from prbayes.metrics.area import AreaMetric
from prbayes.metrics.base import Minimum

INF, NAN = np.inf, np.nan
PYTHON = pytensor.compile.mode.Mode(linker="py", optimizer="fast_compile")
Draw = Callable[..., tuple[Floats, Floats, Floats, Floats]]


def test_stored_values_with_ties_infinities_and_nan_give_the_same_area(draw: Draw) -> None:
    x, w, z, u = draw(0)
    x, z = np.round(x, 1), np.round(z, 1)
    d = AreaMetric().against(z, u)

    def stored(values: Floats, weights: Floats) -> Floats:
        return np.asarray(d.outer(*d.basis(values).features(weights), xp=np))

    rows = np.random.default_rng(0).dirichlet(np.ones(x.size), (2, 3))
    np.testing.assert_allclose(stored(x, rows), d(x, rows), rtol=1e-11)
    x[4] = INF
    expected = d(np.where(x == INF, max(z.max(), x[x < INF].max()), x), w)
    np.testing.assert_allclose(stored(x, w), expected, rtol=1e-11)
    x[4] = NAN
    np.testing.assert_allclose(stored(x, w), expected, rtol=1e-11)


@pytest.mark.parametrize("digits", [0, 8])
def test_many_observed_values_give_the_same_area(digits: int) -> None:
    rng = np.random.default_rng(3)
    z, x = rng.normal(1, 2, 2000), rng.normal(0, 3, 20).round(digits)
    z[:1000] = z[:1000].round(digits)
    z[-1] = x[3] = INF
    x[4] = NAN
    weights = rng.dirichlet(np.ones(20), (2, 3))
    weights[..., 4] = 0
    for u in (None, rng.dirichlet(np.ones(2000))):
        d = AreaMetric().against(z, u)
        basis = d.basis(x)
        # Summed between simulated values, and between all values.
        assert basis.arrays[-1].size > 16 * x.size
        values = np.broadcast_to(np.where(np.isnan(x), INF, x), weights.shape)
        expected = d.of(values, weights)
        np.testing.assert_allclose(d.outer(*basis.features(weights), xp=np), expected, rtol=1e-11)


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


def test_scale_is_the_mean_absolute_deviation_or_one() -> None:
    z = np.array([0.0, 1.0, 5.0])
    found = [AreaMetric().against(z, u).scale for u in (None, [1, 0, 1])]
    assert found == pytest.approx([2, 2.5])
    assert AreaMetric().against(np.full(6, 0.1)).scale == 1
    assert AreaMetric.minimum is Minimum.ABSOLUTE
