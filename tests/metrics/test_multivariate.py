"""A sum of discrepancies behaves as any other: batches, data sets, bases, graphs."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytensor
import pytensor.tensor as pt
import pytest
from pytensor.graph.traversal import ancestors

from prbayes._validate import Floats
from prbayes.metrics.area import AreaMetric
from prbayes.metrics.base import Discrepancy, Metric, Minimum, is_additive, is_likelihood
from prbayes.metrics.correlation import MarginalCorrelation
from prbayes.metrics.custom import FunctionMetric
from prbayes.metrics.density import DensityDiscrepancy, GaussianKDE, Histogram, overlap
from prbayes.metrics.divergence import KullbackLeibler
from prbayes.metrics.joint import Joint
from prbayes.metrics.likelihood import LogLikelihood
from prbayes.metrics.multivariate import directions, failure_caps, repelled, sufficient_directions
from prbayes.metrics.residual import ProbabilityResidual

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
        assert (part.view, part.share) == (before.view, before.share)
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


def sample(n: int, seed: int = 0) -> Floats:
    y = np.random.default_rng(seed).standard_normal((n, 2))
    y[:, 1] += y[:, 0]
    return y


@both
@by_metric
def test_one_output_is_the_metric_itself(lift: Lift, metric: Metric) -> None:
    x, z = sample(40)[:, 0], sample(20, seed=1)[:, 0]
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
        d = joint.against(sample(30))
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
