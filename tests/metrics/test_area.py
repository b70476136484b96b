"""The area metric of failed, stored and symbolic values (the distance: test_properties.py)."""

from __future__ import annotations

from typing import Any

import numpy as np
import pymc as pm
import pytensor
import pytensor.tensor as pt
import pytest
from metric_samples import draw
from scipy.stats import binom, norm

import prbayes as prb
from prbayes.metrics.area import (
    AreaDiscrepancy,
    AreaMetric,
    bias_and_density,
    correction_table,
    with_unbiased_areas,
)
from prbayes.metrics.base import Minimum
from prbayes.metrics.multivariate import Joint
from prbayes.model.evaluator import Evaluator

INF, NAN = np.inf, np.nan
PYTHON = pytensor.compile.mode.Mode(linker="py", optimizer="fast_compile")


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
        corrected = with_unbiased_areas(d)
        stored = corrected.outer(*corrected.basis(x).features(weights), xp=np)
        np.testing.assert_allclose(stored, corrected.of(values, weights), rtol=1e-11)


def test_responses_far_beyond_the_data_without_weight_have_no_area() -> None:
    # The last intervals are 1e20 long, so that heights of 1e-16 by rounding would dominate.
    rng = np.random.default_rng(7)
    x = np.append(rng.normal(size=40), [1e15, 1e20])
    weights = np.append(rng.dirichlet(np.ones(40), 5), np.zeros((5, 2)), axis=1)
    for size in (25, 2000):
        target = AreaMetric().against(rng.normal(size=size))
        for d in (target, with_unbiased_areas(target)):
            expected = d.of(np.broadcast_to(x[:40], (5, 40)), weights[:, :40])
            got = d.of(np.broadcast_to(x, (5, 42)), weights)
            np.testing.assert_allclose(got, expected, rtol=1e-11)
            stored = d.outer(*d.basis(x).features(weights), xp=np)
            np.testing.assert_allclose(stored, expected, rtol=1e-7)


def test_failed_specimens_count_below_and_their_infinite_interval_is_left_out() -> None:
    # F: 1/4 from 0, 1/2 from 2; S: 1/2 from 1, 1 from 3.
    # |F - S|: 1/4 on (0, 1), 1/4 on (1, 2), 0, then none.
    assert AreaMetric()([0.0, INF, 2.0, INF], [1.0, 3.0]) == pytest.approx(0.5)
    some = AreaMetric()([0.0, INF], [1.0, 3.0], weights=[1, 3])
    assert some == pytest.approx(0.25 + 2 * 0.25)
    assert AreaMetric()([INF, INF], [1.0, 3.0, 8.0]) == pytest.approx(8 - 4)


def test_many_weights_are_summed_to_the_same_digits() -> None:
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


def test_each_data_set_has_its_own_populations() -> None:
    rng = np.random.default_rng(5)
    x, z = rng.normal(size=30), rng.normal(size=12)
    sets, weights = rng.dirichlet(np.ones(12), (4, 1)), rng.dirichlet(np.ones(30), (4, 3))
    for target in (AreaMetric().against(z), with_unbiased_areas(AreaMetric().against(z))):
        batch = target.with_observed(z, sets)
        basis = batch.basis(x)
        for rows in (weights, weights[:1]):
            (found,) = basis.features(rows)
            expected = [
                [target.with_observed(z, data[0]).of(x, w) for w in np.atleast_2d(populations)]
                for data, populations in zip(sets, np.broadcast_to(rows, (4, 3, 30)), strict=True)
            ]
            np.testing.assert_allclose(found[..., 0], np.squeeze(expected), rtol=1e-12)


def test_scale_is_the_mean_absolute_deviation_or_one() -> None:
    z = np.array([0.0, 1.0, 5.0])
    found = [AreaMetric().against(z, u).scale for u in (None, [1, 0, 1])]
    assert found == pytest.approx([2, 2.5])
    assert AreaMetric().against(np.full(6, 0.1)).scale == 1
    assert AreaMetric.minimum is Minimum.ABSOLUTE


@pytest.mark.parametrize("n", [1, 2, 4, 30])
def test_the_correction_is_the_integral_of_the_bias_of_an_area(n: int) -> None:
    table = correction_table(n)
    levels = np.linspace(0, 1, table.size)
    np.testing.assert_allclose(table, table[::-1], atol=1e-14)
    np.testing.assert_allclose(table[[0, -1]], 0, atol=1e-14)
    middle = (levels[1:] + levels[:-1]) / 2
    bias, density = bias_and_density(n, middle)
    k = np.arange(n + 1)[:, None]
    mean_sign = (binom.pmf(k, n, middle) * np.sign(middle - k / n)).sum(axis=0)
    np.testing.assert_allclose(bias, mean_sign, atol=1e-12)
    is_smooth = np.floor(n * levels[:-1]) == np.ceil(n * levels[1:]) - 1  # no step of K / n
    slope = np.diff(table) / np.diff(levels)
    np.testing.assert_allclose(slope[is_smooth], bias[is_smooth], atol=1e-4)
    # The curvature: K follows the population, and the steps stay.
    e = 1e-5
    moved = [
        (binom.pmf(k, n, q) * np.sign(middle - k / n)).sum(axis=0) for q in (middle - e, middle + e)
    ]
    np.testing.assert_allclose(density, (moved[0] - moved[1]) / (2 * e), rtol=1e-4, atol=1e-6)
    if n == 1:  # the continuous ranked probability score
        np.testing.assert_allclose(table, levels * (1 - levels), atol=1e-14)
    # A strictly proper scoring rule.
    score = np.abs(levels - k / n) - table
    for p in (0.03, 0.25, 0.6):
        expected = (binom.pmf(k, n, p) * score).sum(axis=0)
        assert levels[expected.argmin()] == pytest.approx(p, abs=2e-3)


def test_a_corrected_area_is_positive_and_the_same_stored_and_symbolic() -> None:
    x, w, z, _ = draw(3)
    z = z[:4]
    x[3] = INF
    plain = AreaMetric().against(z)
    d = with_unbiased_areas(plain)
    assert d(z) == pytest.approx(0, abs=1e-15)
    assert 0 < d(x, w) < plain(x, w) == AreaMetric()(x, z, weights=w)
    basis = d.basis(x)
    rows = np.random.default_rng(0).dirichlet(np.ones(x.size), (2, 3))
    stored = d.outer(*basis.features(rows), xp=np)
    np.testing.assert_allclose(stored, d(x, rows), rtol=1e-11)
    v, y = pt.vector("v"), pt.vector("y")
    graph = d.outer(*basis.features(v, pt), xp=pt)
    direct = d.outer(*d.features(y, v, pt), xp=pt)
    outputs = [graph, direct, pytensor.grad(graph, v)]
    a, b, slope = pytensor.function([y, v], outputs, mode=PYTHON)(x, w)
    np.testing.assert_allclose([a, b], d(x, w), rtol=1e-11)
    e = 1e-7 * np.eye(x.size)
    up, down = (d.outer(*basis.features(w + s * e), xp=np) for s in (1, -1))
    np.testing.assert_allclose(slope, (up - down) / 2e-7, rtol=1e-5, atol=1e-7)


def test_each_projection_is_corrected_for_the_specimens_that_have_it() -> None:
    rng = np.random.default_rng(4)
    z, x = rng.normal(size=(9, 2)), rng.normal(size=(40, 2))
    z[:3, 1] = NAN
    d = with_unbiased_areas(Joint(AreaMetric()).against(z))
    areas = [part.target for part in d.parts if isinstance(part.target, AreaDiscrepancy)]
    assert {area.specimens for area in areas} == {area.observed.size for area in areas}
    assert with_unbiased_areas(d) is d
    weights = rng.dirichlet(np.ones(40))
    by_basis = d.outer(*d.basis(x).features(weights), xp=np)
    assert float(by_basis) == pytest.approx(d(x, weights), rel=1e-10)
    resampled = d.with_observed(np.concatenate([z, z]))
    assert [getattr(part.target, "specimens", 0) for part in resampled.parts] == [
        getattr(part.target, "specimens", 0) for part in d.parts
    ]


def test_a_spread_in_common_has_no_bias_in_a_sum_of_corrected_areas() -> None:
    quantiles = norm.ppf((np.arange(400) + 0.5) / 400)
    spreads = np.exp(np.linspace(-1, 1, 81))
    logs = []
    for seed in range(10):
        z = np.random.default_rng(seed).normal(size=(5, 4))
        targets = [AreaMetric().against(row) for row in z]
        simulated = z.mean() + spreads[:, None] * quantiles
        plain = sum(d(simulated) for d in targets)
        corrected = sum(with_unbiased_areas(d)(simulated) for d in targets)
        logs.append([np.log(spreads[v.argmin()] / z.std()) for v in (plain, corrected)])
    plain_mean, mean = np.mean(logs, axis=0)
    assert plain_mean < -0.25
    assert mean == pytest.approx(0, abs=0.05)  # its standard error is .02


def test_only_several_simulators_are_corrected() -> None:
    def evaluator(n_simulators: int) -> Evaluator:
        with pm.Model() as model:
            x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1)
            for k in range(n_simulators):
                settings: Any = {"observed": np.arange(3.0 + k)}
                if k == 2:
                    settings = {"observed": [0.0, 1.0], "weights": [3, 5]}
                if k == 3:
                    settings = {"observed": [0.0, 1.0, 2.0], "weights": [0.5, 0.5, 1e-9]}
                prb.Simulator(
                    f"y{k}", np.positive, x, metric=AreaMetric(),
                    propagation=prb.Reweighted(16), **settings,
                )  # fmt: skip
        return Evaluator.of(model)

    def specimens(evaluator: Evaluator) -> list[int]:
        return [getattr(node.target, "specimens", -1) for node in evaluator.nodes]

    assert specimens(evaluator(1)) == [0]
    several = evaluator(4)
    assert specimens(several) == [3, 4, 8, 2]
    data = {node.name: np.arange(7.0) for node in several.nodes}
    weights = {node.name: np.full(7, 1 / 7) for node in several.nodes}
    assert specimens(several.observing(data, weights=weights)) == [7] * 4
