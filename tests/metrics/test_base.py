"""Identities that hold for every metric, and the floor of logarithms."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from metric_samples import draw, make
from scipy.optimize import minimize
from scipy.stats import norm

from prbayes._validate import Floats
from prbayes.metrics import density
from prbayes.metrics.base import Discrepancy, Metric
from prbayes.metrics.density import GaussianKDE, overlap
from prbayes.metrics.divergence import KullbackLeibler
from prbayes.metrics.likelihood import LogLikelihood

INF = np.inf


def by_basis(d: Discrepancy, values: Floats, weights: Floats) -> Floats:
    """Return discrepancies from the map of weights to features."""
    return np.asarray(d.outer(*d.basis(values).features(weights), xp=np))


@pytest.mark.parametrize("seed", range(2))
def test_zero_on_itself_and_positive_elsewhere(name: str, metric: Metric, seed: int) -> None:
    x, w, z, u = draw(seed)
    d = metric.against(z, u)
    at_itself = d(z[::-1], u[::-1])
    assert at_itself < d(z + 4, u)
    if metric.distance:
        assert at_itself == pytest.approx(0, abs=1e-13)
        assert min(d(x, w), d(z + 0.3, u)) > 1e-4
    at, apart = overlap(d, z, u), overlap(d, np.stack([x + 1e3, np.full(x.size, INF)]), w)
    assert at == pytest.approx(1)
    np.testing.assert_allclose(apart, [1, 1] if name == "area" else [0, 0], atol=1e-12)
    if name != "area":
        assert 0.2 < overlap(d, x, w) < 0.999


@pytest.mark.parametrize("shift", [-3.3, 250.0])
@pytest.mark.parametrize("a", [0.01, 37.0, -1.0])
def test_shift_scale_sign_and_order(name: str, shift: float, a: float) -> None:
    x, w, z, u = draw(2)
    x /= 2  # well inside the grid, whose ends depend on the sign
    i, j = (np.random.default_rng(3).permutation(v.size) for v in (x, z))
    before = make(0.4)[name].against(z, u)
    after = make(abs(a) * 0.4)[name].against(a * z[j] + shift, u[j])
    expected = before(x, w)
    rtol = 1e-4 if a < 0 and name in ("pr", "kl", "kl-reverse", "ll") else 1e-8
    if name == "area":
        expected *= abs(a)
    elif name in ("pr", "pr-bins"):
        factor = after.scale_factor / before.scale_factor / abs(a) ** (1 if name == "pr" else 2)
        expected *= factor
        np.testing.assert_allclose(after.scale, before.scale * factor, rtol=rtol)
    elif name in ("ll", "ll-bins"):
        expected += np.log(abs(a))
    np.testing.assert_allclose(after(a * x[i] + shift, w[i]), expected, rtol=rtol)


def test_integer_weights_are_repetitions(metric: Metric) -> None:
    x, _, z, _ = draw(0)
    k, j = np.arange(x.size) % 4, 1 + np.arange(z.size) % 3
    weighted, repeated = metric.against(z, j), metric.against(np.repeat(z, j))
    expected = repeated(np.repeat(x, k))
    found = [weighted(x, k), weighted(np.repeat(x, k)), repeated(x, k)]
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    assert repeated.n_effective == pytest.approx(j.sum())
    assert weighted.n_effective == pytest.approx(j.sum() ** 2 / (j**2).sum())


def test_other_observed_values_keep_the_metric_and_additive_ones_are_means_over_them(
    name: str,
) -> None:
    x, w, z, u = draw(14)
    d = make(0.3)[name].against(z, u)
    assert d.with_observed(z, u)(x, w) == d(x, w)
    single = [d.with_observed(z[i : i + 1]) for i in range(z.size)]
    means = [u @ [e(x, v) for e in single] for v in (w, None)]
    additive = np.isclose(means[0] - means[1], d(x, w) - d(x), rtol=1e-9)
    assert additive == d.metric.additive == (name not in ("area", "kl-reverse"))


@pytest.mark.parametrize("away", [1e3, -1e3, 1e300, INF])
def test_disjoint_supports_are_finite_bounded_and_worse(
    name: str, metric: Metric, away: float
) -> None:
    x, w, z, u = draw(9)
    d: Any = metric.against(z, u)
    far = d(x + away, w)
    assert d(x, w) < far < np.inf
    if name.startswith("ll"):
        assert far == pytest.approx(np.log(d.cells.widths.sum() / 1e-9))
    elif name.startswith("kl"):
        assert far <= np.log(max(1, d.density.max()) * d.cells.widths.sum() / 1e-9)


def test_observed_specimens_that_failed_count_as_simulated_ones(metric: Metric) -> None:
    x, w, z, u = draw(12)
    failed = np.append(z, INF)
    d = metric.against(failed, np.append(0.9 * u, 0.1))
    # Units are those of specimens that did not fail.
    assert d.scale == pytest.approx(metric.against(z, u).scale, rel=0.2)
    rows = np.stack([np.append((1 - s) * u, s) for s in (0.1, 0.02, 0.3)])
    right, few, many = d(failed, rows)
    if metric.distance:
        assert right == pytest.approx(0, abs=1e-12)
    assert right < min(few, many)
    np.testing.assert_allclose(by_basis(d, failed, rows), d(failed, rows), rtol=1e-9, atol=1e-12)
    other = d.with_observed(np.append(x, INF), np.append(0.8 * w, 0.2))
    assert np.isfinite(other(failed, rows)).all()


# -- the floor of logarithms -----------------------------------------------------------------------


def fits(metric: Metric, observed: Floats, floors: tuple[float, ...], monkeypatch: Any) -> Floats:
    """Return mean and log standard deviation of the best normal population for each floor."""
    quantiles = norm.ppf((np.arange(1024) + 0.5) / 1024)
    start = [observed.mean(), np.log(observed.std())]
    options = {"xatol": 1e-5, "fatol": 1e-10}
    results = []
    for floor in floors:
        monkeypatch.setattr(density, "_FLOOR", floor)
        d = metric.against(observed)
        fit = minimize(
            lambda t, d=d: d(t[0] + np.exp(t[1]) * quantiles),
            start,
            method="Nelder-Mead",
            options=options,
        )
        results.append(fit.x)
    return np.array(results)


@pytest.mark.parametrize(
    "metric",
    [KullbackLeibler(), KullbackLeibler(reverse=True), LogLikelihood(density=GaussianKDE())],
)
def test_the_floor_does_not_move_the_minimum_on_normal_data(
    metric: Metric, monkeypatch: pytest.MonkeyPatch
) -> None:
    observed = np.random.default_rng(1).normal(size=50)
    found = fits(metric, observed, (1e-12, 1e-9, 1e-6), monkeypatch)
    np.testing.assert_allclose(found, [found[1]] * 3, atol=1e-3 / np.sqrt(50))


def test_the_floor_keeps_an_outlier_in_the_forward_divergence(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    observed = np.random.default_rng(1).standard_t(3, 50)
    sd = np.exp(fits(KullbackLeibler(), observed, (1e-12, 1e-9, 1e-7), monkeypatch)[:, 1])
    assert sd[0] == pytest.approx(sd[1], rel=0.02)
    assert sd[2] < 0.6 * sd[1]
