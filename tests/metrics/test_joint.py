"""Several outputs by the mean of a metric over directions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.stats import norm, qmc

from prbayes._validate import Floats
from prbayes.metrics.area import AreaMetric
from prbayes.metrics.base import Metric, Minimum, is_additive
from prbayes.metrics.custom import FunctionMetric
from prbayes.metrics.density import GaussianKDE
from prbayes.metrics.divergence import KullbackLeibler
from prbayes.metrics.joint import Joint, patterns
from prbayes.metrics.likelihood import LogLikelihood
from prbayes.metrics.residual import ProbabilityResidual

INF, NAN = np.inf, np.nan
LIFTED: dict[str, Metric] = {
    "pr": ProbabilityResidual(),
    "kl": KullbackLeibler(),
    "kl-reverse": KullbackLeibler(reverse=True),
    "ll": LogLikelihood(density=GaussianKDE()),
    "area": AreaMetric(),
}
by_metric = pytest.mark.parametrize("metric", LIFTED.values(), ids=LIFTED)


def sample(n: int, m: int = 2, rho: float = 0.9, seed: int = 0) -> Floats:
    y = np.random.default_rng(seed).standard_normal((n, m))
    y[:, 1] = rho * y[:, 0] + np.sqrt(1 - rho**2) * y[:, 1]
    return y


@by_metric
@pytest.mark.parametrize(("m", "rho"), [(2, -0.995), (3, 0.9)])
def test_no_affine_map_of_the_outputs_changes_it(metric: Metric, m: int, rho: float) -> None:
    x, z = sample(60, m, rho), sample(30, m, rho, seed=1)
    w, u = np.random.default_rng(2).dirichlet(np.ones(60)), np.arange(1.0, 31.0)
    rng = np.random.default_rng(m)
    expected = Joint(metric).against(z, u)(x, w)
    shift = rng.normal(0, 10, m)
    for matrix in (
        rng.standard_normal((m, m)),
        rng.standard_normal((m, m)),
        -np.eye(m)[rng.permutation(m)],
        np.diag([-1e150, 1e-150, 37.0][:m]),
    ):
        shifted = shift * np.abs(matrix).sum(axis=1)
        found = Joint(metric).against(z @ matrix.T + shifted, u)(x @ matrix.T + shifted, w)
        assert found == pytest.approx(expected, rel=1e-7)


@by_metric
def test_a_wrong_correlation_is_seen_where_marginals_are_right(metric: Metric) -> None:
    d = Joint(metric).against(sample(200))
    right, wrong = (d(sample(2000, rho=rho, seed=1)) for rho in (0.9, 0.6))
    assert wrong > right + 0.02
    if metric.distance:
        assert d(d.observed) == pytest.approx(0, abs=1e-12)
        assert right > 1e-3


def test_gross_outliers_move_the_minimiser_under_the_residual_and_more_under_the_area() -> None:
    points = norm.ppf(qmc.Sobol(2, seed=0).random_base2(9))
    y = sample(200, rho=0.6)
    spoiled = y.copy()
    spoiled[:10] = 40.0

    def fitted(metric: Metric, observed: Floats) -> Floats:
        d = Joint(metric).against(observed)

        def population(t: Floats) -> Floats:
            factor = np.array([[np.exp(t[2]), 0.0], [t[4], np.exp(t[3])]])
            return np.asarray(t[:2] + points @ factor.T)

        start = [0.0, 0.0, 0.0, np.log(0.8), 0.6]
        return np.asarray(minimize(lambda t: d(population(t)), start, method="BFGS").x)

    moved = {
        name: fitted(LIFTED[name], spoiled) - fitted(LIFTED[name], y) for name in ("pr", "area")
    }
    # In standard deviations; a twentieth of the sample would move the mean by two.
    assert np.abs(moved["pr"][:2]).max() < 0.05 < 0.1 < np.abs(moved["area"][:2]).min()
    assert np.abs(moved["pr"]).max() < 0.1
    assert 2 * np.linalg.norm(moved["pr"]) < np.linalg.norm(moved["area"]) < 0.4


def energy(x: Floats, y: Floats, size: Callable[[Floats], Floats] = np.abs) -> Floats:
    """The energy distance of samples (..., n) or, with a norm, (n, m)."""

    def apart(a: Floats, b: Floats) -> Any:
        return size(a[..., :, None] - b[..., None, :]).mean(axis=(-1, -2))

    return np.asarray(2 * apart(x, y) - apart(x, x) - apart(y, y))


def test_the_mean_energy_distance_of_slices_is_that_of_the_outputs() -> None:
    x, y = sample(40), sample(30, rho=0.5, seed=1)
    d = Joint(FunctionMetric(energy), directions=200).against(y)
    # In two whitened outputs: two projections at right angles are all of them.
    first, last = d.parts[0], d.parts[100]
    a, b = (np.stack([first.of(v), last.of(v)]) for v in (x, y))

    def length(difference: Floats) -> Floats:
        return np.asarray(np.hypot(*difference))

    whole = energy(a, b, length)
    assert d(x) == pytest.approx(2 / np.pi * float(whole), rel=1e-4)


def test_an_inner_metric_of_ones_own_gives_standard_features() -> None:
    @dataclass(frozen=True)
    class Own(KullbackLeibler):
        minimum = Minimum.UNKNOWN

    x, y = sample(40), sample(30, seed=1)
    own, stock = (Joint(metric).against(y) for metric in (Own(), KullbackLeibler()))
    assert own.metric.minimum is Minimum.UNKNOWN
    assert own(x) == stock(x)
    assert Joint(FunctionMetric(energy)).against(y).basis(x).arrays == (x,)
    assert not Joint(FunctionMetric(energy)).takes_weights


def test_slices_of_the_residual_have_one_factor() -> None:
    y = np.random.default_rng(0).standard_normal((60, 2))
    metric = ProbabilityResidual(GaussianKDE(0.05))
    d = Joint(metric, directions=12).against(y)
    alone = {metric.against(part.observed_of(y)[0]).scale_factor for part in d.parts}  # type: ignore[attr-defined]
    assert len(alone) > 1, "there are slices of different factors"
    assert {part.target.scale_factor for part in d.parts} == {min(alone)}  # type: ignore[attr-defined]


def test_missing_outputs_are_compared_with_all_specimens_that_have_the_others() -> None:
    x, y = sample(50, 3), sample(24, 3, seed=1)
    y[:6, 0] = NAN
    y[6:12, 1:] = NAN
    whole, last_two, first = Joint(AreaMetric()).against(y), y[:, 1:], y[:, 0]
    residual = Joint(ProbabilityResidual())
    assert residual.additive
    assert is_additive(residual.against(y[12:]))
    assert not is_additive(residual.against(y))
    parts = (
        (0.5, y[12:], x),
        (0.25, np.delete(last_two, np.s_[6:12], axis=0), x[:, 1:]),
    )
    expected = sum(share * Joint(AreaMetric()).against(z)(v) for share, z, v in parts)
    alone = [part for part in whole.parts if part.label == "direction 1 of outputs 0"]
    np.testing.assert_allclose(alone[0].share, 0.25)
    np.testing.assert_array_equal(alone[0].observed_of(y)[1], np.r_[6:24])
    expected += 0.25 * alone[0].target(alone[0].of(x))
    unit = np.diff(alone[0].observed_of(y)[0]) / np.diff(first[6:])
    np.testing.assert_allclose(unit, unit[0], err_msg="in robust units")
    assert 0.5 < abs(unit[0]) < 2
    assert whole(x) == pytest.approx(expected, rel=1e-9)
    with pytest.raises(ValueError, match=r"lack outputs which every part .* of 'direction 1'"):
        Joint(AreaMetric()).against(y[12:]).with_observed(y[:6])
    masked = np.ma.masked_invalid(y)
    assert Joint(AreaMetric()).against(masked)(x) == whole(x)


def test_sets_of_outputs_are_merged_where_they_are_rare_or_many() -> None:
    y = sample(40, 4)
    y[0, 0] = y[1, 1] = y[2, 2] = NAN
    found = patterns(y, np.full(40, 1 / 40))
    assert [tuple(key) for key, _ in found] == [(0, 1, 2, 3), (0, 1, 3), (0, 2, 3), (1, 2, 3)]
    np.testing.assert_allclose([share for _, share in found], [37 / 40] + 3 * [1 / 40])
    few = patterns(y[:5], np.full(5, 0.2))  # two specimens have all four: too few
    assert sum(share for _, share in few) == pytest.approx(1)
    assert all(len(key) + 2 <= 5 for key, _ in few)
    rng = np.random.default_rng(0)
    many = np.where(rng.random((200, 6)) < 0.4, NAN, rng.standard_normal((200, 6)))
    many = many[~np.isnan(many).all(axis=1)]
    merged = patterns(many, np.full(len(many), 1 / len(many)))
    assert len(merged) == 8
    assert sum(share for _, share in merged) == pytest.approx(1)
    assert np.isfinite(Joint(AreaMetric()).against(many)(rng.standard_normal((50, 6))))


def test_failures_count_above_all_others_on_both_sides() -> None:
    x, y = sample(60), sample(40, seed=1)
    y[:4, 1] = INF
    d = Joint(AreaMetric()).against(y)
    cap = 2 * y[4:, 1].max() - y[4:, 1].min()
    np.testing.assert_allclose(d(np.where(np.isinf(y), cap, y)), 0, atol=1e-14)
    assert d(y) == pytest.approx(0, abs=1e-14)
    failing = [x.copy() for _ in range(3)]
    failing[1][:6, 1] = failing[2][:18, 1] = INF
    values = [d(v) for v in failing]
    assert values[1] < min(values[0], values[2])
    far = x + np.array([0, 50])
    assert d(far + 1) > d(far), "finite values beyond that are not cut off"


def test_observed_values_are_refused_for_a_reason() -> None:
    y = sample(20)
    joint = Joint(AreaMetric())
    nothing, column, failed, below = (y.copy() for _ in range(4))
    nothing[3] = column[:, 1] = NAN
    failed[:, 1] = INF
    below[0, 0] = -INF
    for observed, message in (
        (y[None], r"shape \(1, 20, 2\), expected \(N, m\)"),
        (y[:0], r"shape \(0, 2\), expected \(N, m\)"),
        (nothing, r"1 specimens without any output \(row 3"),
        (column, r"1 outputs that no specimen has \(column 1"),
        (failed, r"1 outputs in which every specimen failed \(column 1"),
        (below, "got -inf, expected numbers; NaN is an output that was not measured"),
        ([[1.0, 2.0], [3.0]], "ragged sequence"),
        (y[:3], "3 specimens with finite outputs 0, 1"),
    ):
        with pytest.raises((TypeError, ValueError), match=message):
            joint.against(observed)
    with pytest.raises(
        ValueError, match=r"observed weights: got shape \(2, 20\), expected \(20,\)"
    ):
        joint.against(y, np.ones((2, 20)))
    with pytest.raises(ValueError, match=r"expected one dimension.*prb.Joint\(metric\)"):
        AreaMetric().against(y)
    with pytest.raises(ValueError, match=r"simulated: got shape \(5, 3\), expected \(..., n, 2\)"):
        joint.against(y)(np.ones((5, 3)))
    with pytest.raises(ValueError, match="simulated: got NaN"):
        joint.against(y)(np.full((5, 2), NAN))


# -- fewer inputs than outputs ---------------------------------------------------------------------


def bent(size: int, bend: float, seed: int = 0) -> Floats:
    """Return three outputs of two inputs: a plane, and something across it."""
    a, b = np.random.default_rng(seed).standard_normal((2, size))
    return np.stack([a + b, a - b, a + 0.5 * b + bend * (a**2 - 1)], axis=-1)


def test_a_surface_is_compared_on_itself() -> None:
    y, other = bent(60, 0.05), bent(40, 0.05, 1)
    metric = Joint(ProbabilityResidual())
    beside = metric.with_design(metric.against(y), other, 2)
    assert len(beside.parts) == 4
    # As the plane alone, and in any units.
    plane = Joint(ProbabilityResidual()).against(y[:, :2])
    assert beside(other) == pytest.approx(plane(other[:, :2]), rel=0.15)
    scale = np.array([1e3, 1.0, 1e-6])
    scaled = metric.with_design(metric.against(y * scale), other * scale, 2)
    assert scaled(other * scale) == pytest.approx(beside(other), rel=1e-6)


@pytest.mark.parametrize(("bend", "inputs"), [(0.05, 3), (0.05, 8), (0.5, 2)])
def test_what_is_no_surface_is_compared_as_it_is(bend: float, inputs: int) -> None:
    y, other = bent(60, bend), bent(40, bend, 1)
    target = Joint(ProbabilityResidual()).against(y)
    beside = target.metric.with_design(target, other, inputs)
    assert len(beside.parts) == len(target.parts) == 10
    assert beside(other) == target(other)
