"""A sum of discrepancies behaves as any other: batches, data sets, bases, graphs."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytensor
import pytensor.tensor as pt
import pytest
from pytensor.graph.traversal import ancestors
from scipy.optimize import minimize
from scipy.stats import norm, qmc

from prbayes._validate import Floats
from prbayes.metrics.area import AreaMetric
from prbayes.metrics.base import Discrepancy, Metric, Minimum, is_additive, is_likelihood
from prbayes.metrics.correlation import MarginalCorrelation
from prbayes.metrics.custom import FunctionMetric
from prbayes.metrics.density import DensityDiscrepancy, GaussianKDE, Histogram, overlap
from prbayes.metrics.divergence import KullbackLeibler, ProbabilityResidual
from prbayes.metrics.likelihood import LogLikelihood
from prbayes.metrics.multivariate import (
    Joint,
    directions,
    failure_caps,
    patterns,
    repelled,
    sufficient_directions,
)

INF, NAN = np.inf, np.nan
PYTHON = pytensor.compile.mode.Mode(linker="py", optimizer="fast_compile")


class Absolute(Metric):
    """A metric of one's own on densities, with an outer function that is no sum over cells."""

    def _prepare(self, observed: Floats, weights: Floats) -> Discrepancy:
        cells = GaussianKDE().cells(observed, weights)
        return AbsoluteDiscrepancy.on_cells(self, observed, weights, cells)


class AbsoluteDiscrepancy(DensityDiscrepancy):
    def outer(self, *features: Any, xp: Any) -> Any:
        return (xp.abs(features[0] - self.density) * self.cells.widths).sum(axis=-1) ** 1.5


class MeanMetric(Metric):
    """A metric of one's own with features of its own, two of them."""

    minimum = Minimum.QUADRATIC

    def _prepare(self, observed: Floats, weights: Floats) -> Discrepancy:
        return MeanDiscrepancy(self, observed, weights)


class MeanDiscrepancy(Discrepancy):
    scale = 1.0

    def features(self, simulated: Any, weights: Any, xp: Any) -> tuple[Any, ...]:
        return (simulated * weights).sum(axis=-1), (simulated**2 * weights).sum(axis=-1)

    def outer(self, *features: Any, xp: Any) -> Any:
        first, second = self.weights @ self.observed, self.weights @ self.observed**2
        return (features[0] - first) ** 2 + (features[1] - second) ** 2


INNER: dict[str, Metric] = {
    "pr": ProbabilityResidual(),
    "pr-bins": ProbabilityResidual(Histogram(7)),
    "kl": KullbackLeibler(),
    "ll": LogLikelihood(density=GaussianKDE()),
    "area": AreaMetric(),
    "absolute": Absolute(),
    "means": MeanMetric(),
}
LIFT: dict[str, Callable[[Metric], Metric]] = {"joint": Joint, "marginal": MarginalCorrelation}


@pytest.fixture(params=INNER)
def inner(request: pytest.FixtureRequest) -> Metric:
    return INNER[request.param]


@pytest.fixture(params=LIFT)
def metric(request: pytest.FixtureRequest, inner: Metric) -> Metric:
    return LIFT[request.param](inner)


@pytest.fixture
def draw() -> tuple[Floats, Floats, Floats, Floats]:
    """Simulated outputs, their weights, observed ones with some missing, and their weights."""
    rng = np.random.default_rng(0)
    mix = np.array([[1.0, 0.0, 0.0], [0.9, 0.4, 0.0], [0.2, -0.3, 2.0]])
    x, z = rng.standard_normal((30, 3)) @ mix.T + 0.2, rng.standard_normal((25, 3)) @ mix.T
    z[:8, 2] = NAN
    return x, rng.dirichlet(np.ones(30)), z, rng.dirichlet(np.ones(25))


def by_basis(d: Discrepancy, weights: Floats, basis: Any) -> Floats:
    return np.asarray(d.outer(*basis.features(weights), xp=np))


def test_it_is_the_sum_of_its_parts(metric: Metric, draw: Any) -> None:
    x, w, z, u = draw
    d = metric.against(z, u)
    values = [part.share * part.target.of(part.of(x), w) for part in d.parts]
    assert d(x, w) == pytest.approx(sum(values), rel=1e-12)
    assert d.scale == pytest.approx(sum(part.share * part.target.scale for part in d.parts))
    assert d.event == (3,)
    overlaps = [overlap(part.target, part.of(x), w) for part in d.parts]
    assert overlap(d, x, w) == min(overlaps)
    assert d.n_effective == pytest.approx(1 / (u**2).sum())
    (itself,) = d.parts[0].target.parts
    assert (itself.target, itself.share) == (d.parts[0].target, 1.0)
    assert itself.of(x) is x


def test_batches_equal_a_loop_and_a_basis_gives_the_same(metric: Metric, draw: Any) -> None:
    x, _, z, u = draw
    d = metric.against(z, u)
    rng = np.random.default_rng(1)
    xs, ws = x + rng.normal(0, 0.1, (2, 3, 1, 1)), rng.dirichlet(np.ones(30), (2, 3))
    expected = [[d(xs[i, j], ws[i, j]) for j in range(3)] for i in range(2)]
    np.testing.assert_allclose(d(xs, ws), expected, rtol=1e-9)
    np.testing.assert_allclose(by_basis(d, ws, d.basis(x)), d(x, ws), rtol=1e-9)
    assert overlap(d, xs, ws).shape == (2, 3)


def test_rows_of_weights_are_as_many_data_sets(metric: Metric, draw: Any) -> None:
    x, w, z, u = draw
    sets = np.random.default_rng(2).dirichlet(np.ones(25), (4, 1))
    sets[1, 0, 8:] = 0.0  # only specimens that lack an output
    sets[1] /= sets[1].sum()
    several = metric.against(z, u).with_observed(z, sets)
    some = several.rows([3, 1])
    basis = some.basis(x)
    found = by_basis(some, np.stack([[w], [w[::-1]]]), basis)
    expected = [
        several.with_observed(z, sets[3, 0])(x, w),
        several.with_observed(z, sets[1, 0])(x, w[::-1]),
    ]
    np.testing.assert_allclose(found[:, 0], expected, rtol=1e-9)
    # The rows of that data set are there alone: parts that see none of them leave it to the others.
    alone = several.with_observed(z[:8], sets[1, 0, :8])
    assert alone(x, w[::-1]) == pytest.approx(expected[1], rel=1e-9)
    assert found.shape == (2, 1)
    shares = several.shares.sum(axis=-1)  # type: ignore[attr-defined]
    np.testing.assert_allclose(shares, sum(part.share for part in several.parts))


def test_it_comes_back_from_pickle(metric: Metric, draw: Any) -> None:
    x, w, z, u = draw
    d = metric.against(z, u)
    assert pickle.loads(pickle.dumps(d))(x, w) == d(x, w)


def test_other_observed_values_keep_the_slices(metric: Metric, draw: Any) -> None:
    x, w, z, u = draw
    d = metric.against(z, u)
    assert d.with_observed(z, u)(x, w) == pytest.approx(d(x, w), rel=1e-12)
    other = d.with_observed(x)
    assert other.observed is x
    for part, before in zip(other.parts, d.parts, strict=True):
        assert (part.projection, part.share) == (before.projection, before.share)
        np.testing.assert_array_equal(part.target.observed, before.of(x))
    if d.metric.distance and not isinstance(d.metric.metric, MeanMetric):  # type: ignore[attr-defined]
        assert other(x) < d(x)


def test_the_graph_has_the_same_value_and_the_exact_gradient(metric: Metric, draw: Any) -> None:
    x, w, z, u = draw
    d = metric.against(z, u)
    assert d.metric.symbolic
    basis = d.basis(x)
    shared = tuple(pytensor.shared(array) for array in basis.arrays)
    in_graph = replace(basis, arrays=shared)
    symbol = pt.vector()
    value = d.outer(*in_graph.features(symbol, pt), xp=pt)
    function = pytensor.function([symbol], [value, pt.grad(value, symbol)], mode=PYTHON)
    found, gradient = function(w)
    np.testing.assert_allclose(found, d(x, w), rtol=1e-10)
    step = 1e-7 * np.random.default_rng(3).standard_normal(30) * w
    change = by_basis(d, w + step, basis) - by_basis(d, w - step, basis)
    np.testing.assert_allclose(gradient @ (2 * step), change, rtol=2e-5, atol=1e-15)


def test_views_and_features_are_written_for_graphs_too(draw: Any) -> None:
    x, w, z, u = draw
    x[3, 1] = np.inf
    x[5, 0] = NAN
    symbol = pt.matrix()
    for metric in LIFT.values():
        d = metric(AreaMetric()).against(z, u)
        for part in d.parts:
            seen = pytensor.function([symbol], part.of(symbol, pt), mode=PYTHON)(x)
            np.testing.assert_allclose(seen, part.of(x), rtol=1e-12, atol=1e-12)
            assert np.isfinite(np.delete(seen, 5, axis=0)).all()
        whole = d.outer(*d.features(symbol[:5], w[:5], pt), xp=pt)
        found = pytensor.function([symbol], whole, mode=PYTHON)(x)
        np.testing.assert_allclose(found, d.of(x[:5], w[:5]), rtol=1e-10)


@pytest.mark.parametrize("inner", ["pr", "kl", "ll", "area"])
def test_the_graph_of_many_outputs_is_no_larger_than_that_of_two(inner: str) -> None:
    sizes = []
    for m in (2, 5):
        x = np.random.default_rng(4).standard_normal((20, m))
        d = Joint(INNER[inner]).against(x)
        symbol = pt.vector()
        basis = d.basis(x)
        basis = replace(basis, arrays=tuple(map(pytensor.shared, basis.arrays)))
        value = d.outer(*basis.features(symbol, pt), xp=pt)
        sizes.append(len(list(ancestors([value, pt.grad(value, symbol)]))))
    assert sizes[0] == sizes[1]


def test_a_point_without_a_response_counts_nowhere(metric: Metric, draw: Any) -> None:
    x, w, z, u = draw
    if isinstance(metric.metric, MeanMetric):  # type: ignore[attr-defined]
        pytest.skip("a sum that knows no NaN")
    d = metric.against(z, u)
    gone = x.copy()
    gone[4] = NAN
    kept = np.delete(np.arange(30), 4)
    expected = d.of(x[kept], w[kept])
    if not isinstance(metric.metric, AreaMetric):  # type: ignore[attr-defined]
        np.testing.assert_allclose(d.of(gone, w), expected, rtol=1e-10)
    np.testing.assert_allclose(by_basis(d, w, d.basis(gone)), expected, rtol=1e-10)


def test_a_function_is_called_with_what_each_part_sees(draw: Any) -> None:
    x, _, z, _ = draw
    z = z[8:]
    calls: list[tuple[Any, ...]] = []

    def apart(simulated: Floats, observed: Floats) -> Floats:
        calls.append((simulated.shape, observed.shape))
        return np.asarray(np.abs(simulated.mean(axis=-1) - observed.mean()))

    for lift, number in ((Joint, 10), (MarginalCorrelation, 3)):
        calls.clear()
        d = lift(FunctionMetric(apart)).against(z)
        equal = np.full((2, 30), 1 / 30)
        found = by_basis(d, equal, d.basis(x))
        assert not d.metric.symbolic
        np.testing.assert_allclose(found, d(x), rtol=1e-12)
        assert calls[:number] == [((2, 30), (17,))] * number
        sets = np.full((2, 1, 17), 1 / 17)
        several = d.with_observed(z, sets)
        np.testing.assert_allclose(
            by_basis(several, equal[:, None], several.basis(x))[:, 0], d(x), rtol=1e-12
        )


def largest_cosine(u: Floats) -> float:
    cosine = np.abs(u @ u.T)
    np.fill_diagonal(cosine, 0.0)
    return float(cosine.max())


def test_two_outputs_have_equal_angles() -> None:
    u = directions(2, 5, 0)
    angles = np.sort(np.arctan2(u[:, 1], u[:, 0]) % np.pi)
    np.testing.assert_allclose(np.diff(angles), np.pi / 5)
    np.testing.assert_array_equal(u, directions(2, 5, 7))


# The best arrangements of lines: of an icosahedron, of the 24-cell, and of the roots of E6.
@pytest.mark.parametrize(("m", "number", "best"), [(3, 6, 5**-0.5), (4, 12, 0.5), (6, 36, 0.5)])
def test_known_best_arrangements_are_found(m: int, number: int, best: float) -> None:
    assert largest_cosine(directions(m, number, 0)) == pytest.approx(best, abs=2e-3)


@pytest.mark.parametrize("m", [3, 4, 5, 8])
def test_they_are_of_unit_length_and_see_every_direction_alike(m: int) -> None:
    u = directions(m, sufficient_directions(m), 0)
    assert u.shape == ((m - 1) * (m + 2), m)
    np.testing.assert_allclose(np.linalg.norm(u, axis=-1), 1, rtol=1e-15)
    np.testing.assert_allclose(u.T @ u * m / len(u), np.eye(m), atol=0.03)
    # All symmetric matrices differ on them: each covariance is told from every other.
    i, j = np.tril_indices(m)
    assert np.linalg.matrix_rank(u[:, i] * u[:, j], tol=0.3) == i.size


def test_rounding_does_not_decide_where_they_are() -> None:
    for m, number in ((3, 100), (4, 18), (4, 40), (8, 70)):
        start = np.random.default_rng(0).standard_normal((number, m))
        noise = np.random.default_rng(1).standard_normal((number, m))
        np.testing.assert_allclose(
            repelled(start, 400), repelled(start * (1 + 1e-14 * noise), 400), atol=1e-9
        )


def test_more_steps_change_little() -> None:
    for m, number in ((3, 10), (4, 18), (6, 40)):
        start = np.random.default_rng(0).standard_normal((number, m))
        assert abs(largest_cosine(repelled(start)) - largest_cosine(repelled(start, 4000))) < 0.03


def test_a_seed_is_another_arrangement() -> None:
    assert not np.allclose(directions(3, 10, 0), directions(3, 10, 1))
    np.testing.assert_array_equal(directions(3, 1, 0).shape, (1, 3))


Lift = Callable[[Metric], Metric]
LIFTED: dict[str, Metric] = {
    "pr": ProbabilityResidual(),
    "kl": KullbackLeibler(),
    "kl-reverse": KullbackLeibler(reverse=True),
    "ll": LogLikelihood(density=GaussianKDE()),
    "area": AreaMetric(),
}
by_metric = pytest.mark.parametrize("metric", LIFTED.values(), ids=LIFTED)
both = pytest.mark.parametrize("lift", [Joint, MarginalCorrelation])


def summed_outputs(n: int, seed: int = 0) -> Floats:
    y = np.random.default_rng(seed).standard_normal((n, 2))
    y[:, 1] += y[:, 0]
    return y


@both
@by_metric
def test_one_output_is_the_metric_itself(lift: Lift, metric: Metric) -> None:
    x, z = summed_outputs(40)[:, 0], summed_outputs(20, seed=1)[:, 0]
    x[0] = INF
    w, u = np.random.default_rng(2).dirichlet(np.ones(40)), np.arange(1.0, 21.0)
    flat, column = lift(metric).against(z, u), lift(metric).against(z[:, None], u)
    expected = metric.against(z, u)
    assert type(flat) is type(expected)
    assert flat(x, w) == expected(x, w) == column(x[:, None], w)
    assert (column.event, column.scale, is_likelihood(column)) == (
        (1,),
        expected.scale,
        metric.likelihood,
    )
    basis = column.basis(x[:, None])
    rows = np.stack([w, w[::-1]])
    np.testing.assert_array_equal(
        column.outer(*basis.features(rows), xp=np),
        expected.outer(*expected.basis(x).features(rows), xp=np),
    )
    others = column.with_observed(x[1:9, None]), expected.with_observed(x[1:9])
    assert others[0](x[:, None], w) == others[1](x, w)


def test_every_metric_declares_what_its_inner_one_does() -> None:
    for metric in LIFTED.values():
        joint = Joint(metric)
        for name in ("minimum", "additive", "takes_weights", "tail_responses", "distance"):
            assert getattr(joint, name) == getattr(metric, name)
        d = joint.against(summed_outputs(30))
        assert joint.takes_outputs
        assert (is_likelihood(d), is_additive(d)) == (False, metric.additive)
        assert not joint.likelihood
    assert Joint(AreaMetric(), directions=5).like(KullbackLeibler()) == Joint(
        KullbackLeibler(), directions=5
    )
    assert AreaMetric().like(KullbackLeibler()) == KullbackLeibler()
    assert hash(Joint(AreaMetric(), directions=5)) != hash(Joint(AreaMetric(), directions=6))
    assert (
        repr(Joint(AreaMetric(), directions=5))
        == "Joint(metric=AreaMetric(), directions=5, components=None, random_seed=0)"
    )


@both
@pytest.mark.parametrize("metric", [3, AreaMetric, Joint(AreaMetric())])
def test_only_a_metric_of_one_output_is_lifted(lift: Any, metric: Any) -> None:
    with pytest.raises(TypeError, match="expected a metric of one output"):
        lift(metric)


def test_a_failure_counts_as_the_largest_value_and_the_range_beyond() -> None:
    y = np.array([[1.0, NAN], [4.0, -2.0], [INF, -1.0], [3.0, -5.0]])
    np.testing.assert_array_equal(failure_caps(y), [7.0, 3.0])


def test_data_of_no_shape_are_left_to_the_metric_of_one_output() -> None:
    with pytest.raises(ValueError, match=r"shape \(\), expected one dimension"):
        Joint(AreaMetric()).against(3.0)


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


def test_the_adjoint_of_binned_densities_is_their_transpose() -> None:
    """<B w, c> = <w, B' c> for the densities of projections that are computed at each call."""
    rng = np.random.default_rng(3)
    metric = Joint(KullbackLeibler())
    basis = metric.against(rng.normal(size=(30, 2))).basis(rng.normal(size=(50, 2)), 0.0)
    (projections,) = basis.arrays
    weights = rng.dirichlet(np.ones(50))
    densities = basis.densities.binned(projections, weights)
    cotangent = rng.normal(size=densities.shape)
    gradient = basis.densities.adjoint(projections, cotangent)
    assert densities @ cotangent == pytest.approx(weights @ gradient, rel=1e-10)
