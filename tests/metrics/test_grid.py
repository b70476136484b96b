"""Densities on cells: exactness, derivatives, readings, and the compiled loops."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
from scipy.stats import norm

import prbayes.metrics.grid as loops
from prbayes._validate import Floats
from prbayes.metrics.density import GaussianKDE, Histogram
from prbayes.metrics.grid import KernelCells, product

H, INF, NAN = 0.5, np.inf, np.nan
OBSERVED = np.array([-2.0, -0.3, 0.1, 0.7, 2.1])
EQUAL = np.full(5, 0.2)
ESTIMATORS = {"kde": GaussianKDE(H), "histogram": Histogram(6)}
both = pytest.mark.parametrize("estimator", ESTIMATORS.values(), ids=ESTIMATORS)


def kernel_cells(bandwidth: float = H, observed: Floats = OBSERVED) -> KernelCells:
    cells = GaussianKDE(bandwidth).cells(observed, np.full(observed.size, 1 / observed.size))
    assert isinstance(cells, KernelCells)
    return cells


def draw(seed: int, *shape: int) -> tuple[Floats, Floats]:
    rng = np.random.default_rng(seed)
    return rng.normal(size=shape), rng.dirichlet(np.ones(shape[-1]), shape[:-1])


@pytest.mark.parametrize("n", [1, 7, 300])
@pytest.mark.parametrize("bandwidth", [0.03, 0.5, 4.0])
def test_kde_is_the_exact_sum_of_gaussians_to_a_few_parts_in_1e5(n: int, bandwidth: float) -> None:
    x, w = draw(n, n)
    cells = kernel_cells(bandwidth, np.array([-5.0, 5.0]))
    x[0] = cells.centers[1] + 0.3 * cells.step  # near the edge
    exact = w @ norm.pdf(cells.centers, x[:, None], bandwidth)
    np.testing.assert_allclose(cells.density(x, w)[:-2], exact, rtol=0, atol=3e-5 * exact.max())


@both
def test_mass_outside_goes_to_the_last_two_cells_and_nan_nowhere(estimator: Any) -> None:
    cells = estimator.cells(OBSERVED, EQUAL)
    x = np.array([0.2, -99.0, 1.0, 99.0, INF, NAN, -1e300, 1e300])
    w = np.arange(1.0, 9.0) / 36
    mass = cells.density(x, w) * cells.widths
    np.testing.assert_allclose(mass[-2], w[[1, 6]].sum(), rtol=1e-14)
    np.testing.assert_allclose(mass[-1], w[[3, 4, 7]].sum(), rtol=1e-14)
    np.testing.assert_allclose(mass.sum(), 1 - w[5], rtol=1e-10)
    assert (cells.density(np.full(3, NAN), np.full(3, 1 / 3)) == 0).all()


# Places of values from the last node on, in bandwidths.
@pytest.mark.parametrize("place", [-7.5, -0.4, 0.0, 0.6, 5.0, 7.4, 9.0])
@pytest.mark.parametrize("side", [-1, 1])
def test_a_kernel_is_divided_between_the_grid_and_the_mass_beyond_its_end(
    place: float, side: int
) -> None:
    cells = kernel_cells()
    x = cells.centers[-1 if side > 0 else 0] + side * place * H
    found = cells.density(np.array([x]), np.ones(1)) * cells.widths
    np.testing.assert_allclose(found.sum(), 1, rtol=1e-11)
    # The cell of the last node ends half a step behind it.
    expected = norm.cdf(place - cells.step / (2 * H))
    np.testing.assert_allclose(found[-1 if side > 0 else -2], expected, atol=1e-3)
    exact = norm.pdf(cells.centers, x, H) * cells.step
    np.testing.assert_allclose(found[:-2], exact, atol=3e-5 * norm.pdf(0) / H * cells.step)


def test_all_is_twice_differentiable_where_values_cross_nodes_and_the_end_of_the_grid() -> None:
    cells = kernel_cells()
    e = 1e-2 * H
    x = cells.centers[-1] + np.arange(-9 * H, 9 * H, e)
    density = cells.density(x[:, None], np.ones(1))
    # Of a kernel, and of its distribution function over the width of a cell.
    steepest = np.r_[np.full(cells.centers.size, norm.pdf(0) / H**3), [0.25 / H**2] * 2]
    steepest[-2:] /= cells.widths[-1]
    second = np.diff(density, 2, axis=0) / e**2
    assert (np.abs(second) < 1.03 * steepest).all()
    assert (np.abs(np.diff(second, axis=0) / e) < 10 * steepest / H).all()
    # The second derivative at a node is that of a Gaussian.
    k = cells.centers.size - 12
    u = (x[1:-1] - cells.centers[k]) / H
    exact = (u**2 - 1) * norm.pdf(u) / H**3
    np.testing.assert_allclose(second[:, k], exact, atol=3e-2 * norm.pdf(0) / H**3)


@both
@pytest.mark.parametrize("batch", [(1,), (2, 3)])
def test_batches_equal_a_loop_in_any_layout(estimator: Any, batch: tuple[int, ...]) -> None:
    cells = estimator.cells(OBSERVED, EQUAL)
    x, w = draw(5, *batch, 11)
    first = w[(0,) * len(batch)]
    for weights in (w, np.broadcast_to(first, w.shape), np.full(w.shape, 1 / 11)):
        expected = [cells.density(x[i], weights[i]) for i in np.ndindex(*batch)]
        expected = np.reshape(expected, (*batch, -1))
        wide = np.asfortranarray(x)
        wide.flags.writeable = False
        for values in (x, wide, np.repeat(x, 2, axis=-1)[..., ::2]):
            found = cells.density(values, np.asfortranarray(weights))
            np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-15)
    order = np.random.default_rng(12).permutation(11)
    found = cells.density(x[..., order], w[..., order])
    np.testing.assert_allclose(found, cells.density(x, w), rtol=1e-10, atol=1e-14)


@both
def test_basis_turns_weights_into_the_density(estimator: Any) -> None:
    cells = estimator.cells(OBSERVED, EQUAL)
    x = np.r_[draw(6, 20)[0], -50, 60, INF, OBSERVED]
    w = draw(7, 4, x.size)[1]
    expected = cells.density(np.broadcast_to(x, w.shape), w)
    np.testing.assert_allclose(w @ cells.basis(x), expected, rtol=1e-12, atol=1e-15)


@both
@pytest.mark.parametrize("batch", [(), (2, 2)])
def test_adjoint_equals_finite_differences(estimator: Any, batch: tuple[int, ...]) -> None:
    cells = estimator.cells(OBSERVED, EQUAL)
    x, w = draw(9, *batch, 8)
    x[..., :4] = -40.0, 50.0, INF, cells.centers[1] + 0.3 * cells.widths[0]
    # Just beyond the last value that is binned, and where a kernel reaches back.
    x[..., 1] = cells.centers[-1] + (getattr(cells, "margin", 4) - 0.5) * cells.widths[0]
    x[..., 4:6] = cells.centers[0] - 0.7 * H, cells.centers[-1] + 1.3 * H
    cotangent = np.random.default_rng(8).normal(size=(*batch, cells.widths.size))
    adjoint = partial(cells.adjoint, for_sample=True)
    for_sample, for_weights = w * adjoint(x, cotangent), cells.adjoint(x, cotangent)
    assert for_sample.shape == for_weights.shape == x.shape

    def objective(sample: Floats, weights: Floats) -> float:
        return float((cells.density(sample, weights) * cotangent).sum())

    e = 1e-5
    for i in np.ndindex(x.shape):
        d = np.zeros(x.shape)
        d[i] = e
        slope = (objective(x + d, w) - objective(x - d, w)) / (2 * e)
        np.testing.assert_allclose(for_sample[i], slope, rtol=1e-6, atol=1e-8)
        slope = (objective(x, w + d) - objective(x, w - d)) / (2 * e)
        np.testing.assert_allclose(for_weights[i], slope, rtol=1e-6, atol=1e-8)
    assert (for_sample[..., :3] == 0).all()
    # The same for any layout, and for a sample that rows share.
    same = adjoint(np.asfortranarray(x), np.asfortranarray(cotangent))
    np.testing.assert_array_equal(same, adjoint(x, cotangent))
    if batch:
        shared = adjoint(x[0, 0], cotangent)[1, 1]
        np.testing.assert_array_equal(shared, adjoint(x[0, 0], cotangent[1, 1]))


@pytest.mark.parametrize("function", [lambda z: 0 * z + 3, lambda z: z**2 - z + 2])
def test_kernel_reading_is_exact_up_to_parabolas(function: Callable[[Floats], Floats]) -> None:
    cells = kernel_cells()
    points, w = draw(0, 12)
    points[:3] = cells.centers[[2, 10, -3]] + [0, 0, -1e-9]  # on nodes, and at the last one
    on_cells = np.r_[function(cells.centers), 1e6, -1e6]
    np.testing.assert_allclose(
        cells.reading(points, w) @ on_cells, w @ function(points), rtol=1e-10
    )
    on_cells = np.r_[norm.pdf(cells.centers, 0.3, 1), 0, 0]
    gaussian = w @ norm.pdf(points, 0.3, 1)
    np.testing.assert_allclose(cells.reading(points, w) @ on_cells, gaussian, rtol=1e-3)
    # Points outside are read on their side.
    outside = cells.reading(np.array([-99.0, 99.0]), np.array([0.2, 0.8]))
    np.testing.assert_array_equal(outside[-2:], [0.2, 0.8])
    assert (outside[:-2] == 0).all()


@pytest.mark.parametrize("bins", [1, 7, 50])
def test_histogram_equals_numpy(bins: int) -> None:
    x, w = draw(bins, 60)
    cells = Histogram(bins).cells(x, w)
    expected, edges = np.histogram(x, bins, weights=w, density=True)
    np.testing.assert_allclose(cells.density(x, w), [*expected, 0, 0], rtol=1e-10, atol=1e-13)
    np.testing.assert_allclose(cells.centers, (edges[1:] + edges[:-1]) / 2, rtol=1e-10, atol=1e-13)
    np.testing.assert_allclose(cells.widths, np.diff(edges)[0], rtol=1e-10)
    assert (cells.widths.size, cells.smooth) == (bins + 2, False)


def test_histogram_bins_are_closed_on_the_left_and_the_last_on_both_sides() -> None:
    cells = Histogram(4).cells(np.array([0.0, 4.0]), np.full(2, 0.5))
    x = np.array([0.0, 0.0, 1.0, 2.0, 3.0, 4.0, 4.0, -1e-6, 4 + 1e-6, np.nextafter(1.0, 0.0)])
    np.testing.assert_allclose(cells.density(x, np.ones(10)), [3, 1, 1, 3, 1, 1], rtol=1e-12)


def test_a_product_of_rows_is_that_of_each_row() -> None:
    rng = np.random.default_rng(13)
    weights, matrix = rng.normal(size=(2, 3, 4)), rng.normal(size=(4, 5))
    found = product(weights, matrix)
    np.testing.assert_allclose(found, np.einsum("ijn,nm->ijm", weights, matrix), rtol=1e-12)
    assert product(weights[0, 0], matrix).shape == (5,)
    # As where a part of the data has no value of a group.
    assert product(np.empty((0, 0)), np.empty((0, 5))).shape == (0, 5)
    assert product(np.empty((2, 3, 0)), np.empty((0, 5))).shape == (2, 3, 5)


def test_without_a_folder_for_it_the_compiled_loop_is_not_kept(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Numba refuses to decorate where it can write neither to the package's folder nor a user's."""
    import numba

    asked: list[dict[str, Any]] = []

    def njit(**options: bool) -> Callable[..., Any]:
        def decorate(loop: Callable[..., None]) -> Callable[..., None]:
            asked.append(options)
            if options.get("cache"):
                raise RuntimeError("cannot cache function 'add': no locator available")
            return loop

        return decorate

    monkeypatch.setattr(numba, "njit", njit)
    values = np.zeros(3)
    compiled = loops.compiled(lambda values: values.__iadd__(1))
    assert not asked  # nothing is compiled before it is called
    compiled(values)
    compiled(values)
    np.testing.assert_array_equal(values, 2)
    assert [o.get("cache", False) for o in asked] == [True, False]
