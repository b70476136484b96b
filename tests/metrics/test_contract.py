"""The contract of discrepancies, of one output and of several: batches, data sets, bases, graphs."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytensor
import pytensor.tensor as pt
import pytest
from metric_samples import draw
from pytensor.graph.traversal import ancestors

from prbayes._validate import Floats
from prbayes.metrics.area import AreaMetric
from prbayes.metrics.base import Discrepancy, Metric, Minimum
from prbayes.metrics.custom import FunctionMetric
from prbayes.metrics.density import DensityDiscrepancy, GaussianKDE, Histogram, overlap
from prbayes.metrics.divergence import KullbackLeibler, ProbabilityResidual
from prbayes.metrics.likelihood import LogLikelihood
from prbayes.metrics.multivariate import Joint

NAN = np.nan
PYTHON = pytensor.compile.mode.Mode(linker="py", optimizer="fast_compile")


class Absolute(Metric):
    """A user's metric on densities, with an outer function that is no sum over cells."""

    def _prepare(self, observed: Floats, weights: Floats) -> Discrepancy:
        cells = GaussianKDE().cells(observed, weights)
        return AbsoluteDiscrepancy.on_cells(self, observed, weights, cells)


class AbsoluteDiscrepancy(DensityDiscrepancy):
    def outer(self, *features: Any, xp: Any) -> Any:
        return (xp.abs(features[0] - self.density) * self.cells.widths).sum(axis=-1) ** 1.5


class MeanMetric(Metric):
    """A user's metric with two features."""

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
    "kl-reverse": KullbackLeibler(reverse=True),
    "kl-bins": KullbackLeibler(Histogram(7)),
    "ll": LogLikelihood(density=GaussianKDE()),
    "area": AreaMetric(),
    "absolute": Absolute(),
    "means": MeanMetric(),
}
LIFT: dict[str, Callable[[Metric], Metric]] = {
    "single": lambda metric: metric,
    "joint": Joint,
}


Case = tuple[Discrepancy, Floats, Floats, Floats]


def outputs() -> tuple[Floats, Floats, Floats, Floats]:
    """Return simulated outputs, weights, observed outputs with some missing, and weights."""
    rng = np.random.default_rng(0)
    mix = np.array([[1.0, 0.0, 0.0], [0.9, 0.4, 0.0], [0.2, -0.3, 2.0]])
    x, z = rng.standard_normal((30, 3)) @ mix.T + 0.2, rng.standard_normal((25, 3)) @ mix.T
    z[:8, 2] = NAN
    return x, rng.dirichlet(np.ones(30)), z, rng.dirichlet(np.ones(25))


@pytest.fixture(params=[(lift, inner) for lift in LIFT for inner in INNER], ids="-".join)
def case(request: pytest.FixtureRequest) -> Case:
    """A discrepancy of one output or of three, with simulated values, weights and observed ones."""
    lift, inner = request.param
    x, w, z, u = outputs()
    if lift == "single":
        x, z = x[:, 0], z[:, 0]
    return LIFT[lift](INNER[inner]).against(z, u), x, w, z


def by_basis(d: Discrepancy, weights: Floats, basis: Any) -> Floats:
    return np.asarray(d.outer(*basis.features(weights), xp=np))


def test_batches_equal_a_loop_and_a_basis_gives_the_same(case: Case) -> None:
    d, x, _, _ = case
    rng = np.random.default_rng(1)
    shifts, ws = rng.normal(0, 0.1, (2, 3)), rng.dirichlet(np.ones(30), (2, 3))
    xs = x + shifts.reshape(2, 3, *(1 for _ in x.shape))
    expected = [[d(xs[i, j], ws[i, j]) for j in range(3)] for i in range(2)]
    np.testing.assert_allclose(d(xs, ws), expected, rtol=1e-9)
    np.testing.assert_allclose(by_basis(d, ws, d.basis(x)), d(x, ws), rtol=1e-9)
    assert d(xs[:0], ws[:0]).shape == (0, 3)
    assert overlap(d, xs, ws).shape == (2, 3)
    assert type(d(x)) is float
    assert pickle.loads(pickle.dumps(d))(x) == pytest.approx(d(x), rel=1e-14)


def test_rows_of_weights_are_as_many_data_sets(case: Case) -> None:
    d, x, w, z = case
    sets = np.random.default_rng(2).dirichlet(np.ones(25), (4, 1))
    sets[1, 0, 8:] = 0.0  # of several outputs, only specimens that lack one
    sets[1] /= sets[1].sum()
    several: Any = d.with_observed(z, sets)
    some = several.rows([3, 1])
    found = by_basis(some, np.stack([[w], [w[::-1]]]), some.basis(x))
    pairs = ((sets[3, 0], w), (sets[1, 0], w[::-1]))
    expected = [several.with_observed(z, data)(x, weights) for data, weights in pairs]
    np.testing.assert_allclose(found, np.reshape(expected, (2, 1)), rtol=1e-9)
    np.testing.assert_array_equal(some.weights, several.weights[[3, 1]])
    # Only these rows have weight: components without their outputs leave their share to the others.
    alone = several.with_observed(z[:8], sets[1, 0, :8])
    assert alone(x, w[::-1]) == pytest.approx(expected[1], rel=1e-9)
    if z.ndim > 1:
        total = sum(part.share for part in several.parts)
        np.testing.assert_allclose(several.shares.sum(axis=-1), total)


def test_it_is_the_sum_of_its_parts_for_other_observed_values_too(case: Case) -> None:
    d, x, w, z = case
    assert d.with_observed(z, d.weights)(x, w) == pytest.approx(d(x, w), rel=1e-12)
    for target in (d, d.with_observed(x)):
        values = [part.share * part.target.of(part.of(x), w) for part in target.parts]
        assert target(x, w) == pytest.approx(sum(values), rel=1e-12)
        assert overlap(target, x, w) == min(overlap(p.target, p.of(x), w) for p in target.parts)
        for part, before in zip(target.parts, d.parts, strict=True):
            assert (part.projection, part.share) == (before.projection, before.share)
    assert d.scale == pytest.approx(sum(part.share * part.target.scale for part in d.parts))
    assert d.event == x.shape[1:]


def test_the_graph_has_the_same_value_and_the_exact_gradient(case: Case) -> None:
    d, x, w, _ = case
    basis = d.basis(x)
    in_graph = replace(basis, arrays=tuple(map(pytensor.shared, basis.arrays)))
    symbol = pt.vector()
    value = d.outer(*in_graph.features(symbol, pt), xp=pt)
    function = pytensor.function([symbol], [value, pt.grad(value, symbol)], mode=PYTHON)
    found, gradient = function(w)
    np.testing.assert_allclose(found, d(x, w), rtol=1e-10)
    step = 1e-7 * np.random.default_rng(3).standard_normal(30) * w
    change = by_basis(d, w + step, basis) - by_basis(d, w - step, basis)
    np.testing.assert_allclose(gradient @ (2 * step), change, rtol=2e-5, atol=1e-15)


def test_a_point_without_a_response_counts_nowhere(case: Case) -> None:
    d, x, w, _ = case
    inner = getattr(d.metric, "metric", d.metric)
    if isinstance(inner, MeanMetric):
        return  # a sum without a rule for NaN
    gone = x.copy()
    gone[4] = NAN
    expected = d.of(np.delete(x, 4, axis=0), np.delete(w, 4))
    if not isinstance(inner, AreaMetric):
        np.testing.assert_allclose(d.of(gone, w), expected, rtol=1e-10)
    np.testing.assert_allclose(by_basis(d, w, d.basis(gone)), expected, rtol=1e-10)


def test_projections_and_features_are_written_for_graphs_too() -> None:
    x, w, z, u = outputs()
    x[3, 1] = np.inf
    x[5, 0] = NAN
    symbol = pt.matrix()
    d = Joint(AreaMetric()).against(z, u)
    for part in d.parts[:: len(d.parts) - 1]:
        projected = pytensor.function([symbol], part.of(symbol, pt), mode=PYTHON)(x)
        np.testing.assert_allclose(projected, part.of(x), rtol=1e-12, atol=1e-12)
        assert np.isfinite(np.delete(projected, 5, axis=0)).all()
    whole = d.outer(*d.features(symbol[:5], w[:5], pt), xp=pt)
    found = pytensor.function([symbol], whole, mode=PYTHON)(x)
    np.testing.assert_allclose(found, d.of(x[:5], w[:5]), rtol=1e-10)


@pytest.mark.parametrize("inner", ["kl", "area"])
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


def test_nothing_is_assumed_that_a_metric_does_not_declare() -> None:
    d = Absolute().against(np.arange(5.0))
    assert (d.metric.minimum, d.metric.tail_responses, d.scale) == (Minimum.UNKNOWN, 0, 1.0)
    assert (d.metric.additive, d.metric.likelihood, d.metric.takes_weights) == (False, False, True)


# -- a user's function -----------------------------------------------------------------------------


def mean_difference(simulated: Any, observed: Any, weights: Any = None) -> Any:
    return np.abs(np.average(simulated, axis=-1, weights=weights) - observed.mean())


def test_a_function_is_called_with_the_projections() -> None:
    x, _, z, _ = outputs()
    z = z[8:]
    calls: list[tuple[Any, ...]] = []

    def apart(simulated: Floats, observed: Floats) -> Floats:
        calls.append((simulated.shape, observed.shape))
        return np.asarray(mean_difference(simulated, observed))

    d = Joint(FunctionMetric(apart)).against(z)
    equal = np.full((2, 30), 1 / 30)
    np.testing.assert_allclose(by_basis(d, equal, d.basis(x)), d(x), rtol=1e-12)
    assert (d.metric.symbolic, d.metric.takes_weights) == (False, False)
    assert calls[:10] == [((2, 30), (17,))] * 10
    several = d.with_observed(z, np.full((2, 1, 17), 1 / 17))
    found = by_basis(several, equal[:, None], several.basis(x))
    np.testing.assert_allclose(found[:, 0], d(x), rtol=1e-12)


def test_it_is_the_value_of_the_function() -> None:
    x, _, z, _ = draw(12)
    plain, weighted = (FunctionMetric(mean_difference, weighted=w) for w in (False, True))
    d = weighted.against(z)
    assert plain(x, z) == pytest.approx(abs(x.mean() - z.mean()))
    rows = np.random.default_rng(13).dirichlet(np.ones(x.size), (2, 3))
    np.testing.assert_allclose(d(x, rows), np.abs(rows @ x - z.mean()), rtol=1e-12)
    np.testing.assert_allclose(by_basis(d, rows, d.basis(x)), d(x, rows), rtol=1e-12)
    assert (plain.minimum, plain.likelihood, d.scale) == (Minimum.UNKNOWN, False, 1.0)
    assert [plain.takes_weights, weighted.takes_weights] == [False, True]


def test_wrong_functions_results_and_weights() -> None:
    ok = [0.0, 1.0, 3.0]
    with pytest.raises(TypeError, match=r"function: got float, expected f\(simulated, observed\)"):
        FunctionMetric(3.0)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"shape \(3,\): .*simulated \(3,\).* shape \(\), a"):
        FunctionMetric(lambda x, z: x)(ok, ok)
    # One that is written for one population.
    joined = FunctionMetric(lambda x, z: np.concatenate([x, z]).mean())
    with pytest.raises(
        ValueError, match=r"ValueError: all .* got simulated \(2, 3\), observed \(3,"
    ):
        joined.against(ok)([ok, ok])
    with pytest.raises(ValueError, match=r"weights: got unequal .*pass weighted=True"):
        FunctionMetric(mean_difference)(ok, ok, weights=[1, 2, 3])
    with pytest.raises(ValueError, match="observed weights: got unequal"):
        FunctionMetric(mean_difference).against(ok, [1, 2, 3])
