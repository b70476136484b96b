"""The vector of hyperparameters, its names, and the elements of variables."""

from __future__ import annotations

import numpy as np
import pymc as pm
import pytest
import xarray as xr
from pymc.model.fgraph import clone_model
from scipy import stats

from prbayes.model.parameters import (
    Hyperparameters,
    element_name,
    element_names,
    finite_draws,
    fixed_points,
    in_support,
    optimum_elements,
    readable_elements,
    readable_variables,
    single_elements,
    split_elements,
    stacked_draws,
    table_elements,
    unconstrained,
    value_shapes,
    variable_of,
)

THETAS = np.array([[0.0, 4.0, 0.3], [2.0, 6.0, -0.4]])


@pytest.fixture(scope="module")
def hyperparameters() -> Hyperparameters:
    with pm.Model() as model:
        mu = pm.Normal("mu", [1.0, 5.0], 2.0)
        pm.HalfNormal("sigma", 3.0)
        pm.Deterministic("total", mu.sum())
        pm.Deterministic("constant", pm.math.constant(4.0))
    return Hyperparameters.of(model)


def test_names_and_shapes(hyperparameters: Hyperparameters) -> None:
    assert hyperparameters.names == ["mu[0]", "mu[1]", "sigma_log__"]
    assert hyperparameters.readable_names == ["mu[0]", "mu[1]", "sigma"]
    assert value_shapes(hyperparameters) == {"mu": (2,), "sigma_log__": ()}
    np.testing.assert_allclose(hyperparameters.initial, [1.0, 5.0, np.log(3.0)])
    assert hyperparameters.size == 3
    with pm.Model(coords={"supplier": ["Adler", "Busch"]}) as model:
        pm.HalfNormal("sigma", 3.0, dims="supplier")
        pm.Dirichlet("p", np.ones(2), dims="supplier")
    with_coords = Hyperparameters.of(model)
    # A variable with fewer elements unconstrained than in its own units is numbered.
    assert with_coords.names == ["sigma_log__[Adler]", "sigma_log__[Busch]", "p_simplex__[0]"]
    assert with_coords.readable_names == ["sigma[Adler]", "sigma[Busch]", "p[0]"]


def test_the_log_prior_has_the_jacobian(hyperparameters: Hyperparameters) -> None:
    normal = stats.norm([1.0, 5.0], 2.0).logpdf(THETAS[:, :2]).sum(axis=1)
    half = stats.halfnorm(scale=3.0).logpdf(np.exp(THETAS[:, 2])) + THETAS[:, 2]
    np.testing.assert_allclose(hyperparameters.log_prior(THETAS), normal + half, rtol=1e-7)
    with pm.Model() as model:
        pm.Uniform("u", 0, 1, default_transform=None)
    is_inside = in_support(Hyperparameters.of(model), np.array([[0.5], [-0.1], [1.1]]))
    np.testing.assert_array_equal(is_inside, [True, False, False])


def test_constrained_values_and_back(hyperparameters: Hyperparameters) -> None:
    values = hyperparameters.constrained(THETAS)
    np.testing.assert_allclose(values["sigma"], np.exp(THETAS[:, 2]))
    np.testing.assert_allclose(values["total"], [4.0, 8.0])
    np.testing.assert_array_equal(values["constant"], [4.0, 4.0])
    back = hyperparameters.thetas_of([values["mu"], values["sigma"]])
    np.testing.assert_allclose(back, THETAS, rtol=1e-12)
    point = {"mu": values["mu"][1], "sigma": values["sigma"][1]}
    np.testing.assert_allclose(unconstrained(hyperparameters, point), THETAS[1])
    with pm.Model() as model:
        factor = pm.LKJCorr("factor", n=2, eta=2)
        pm.Deterministic("correlation", factor @ factor.T)
    empty = Hyperparameters.of(model).constrained(np.empty((0, 1)))
    assert {name: value.shape for name, value in empty.items()} == {
        "factor": (0, 2, 2),
        "correlation": (0, 2, 2),
    }


@pytest.mark.parametrize(
    ("point", "error", "message"),
    [
        ({"mu": 1.0}, KeyError, "expected a value for each of"),
        ({"mu": [1.0, 2.0, 3.0], "sigma": 1.0}, ValueError, r"mu: got shape \(3,\), expected"),
        ({"mu": 1.0, "sigma": -1.0}, ValueError, "inside the support"),
    ],
)
def test_invalid_points_are_refused(
    hyperparameters: Hyperparameters, point: dict[str, object], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        unconstrained(hyperparameters, point)


def test_draws_of_the_prior(hyperparameters: Hyperparameters) -> None:
    first = hyperparameters.prior_thetas(16, 3)
    first[:] = np.nan  # a copy
    again = hyperparameters.prior_thetas(16, 3)
    assert np.isfinite(again).all()
    assert not np.array_equal(again, hyperparameters.prior_thetas(16, 4))
    # Quasi-random points are even.
    levels = stats.norm(1.0, 2.0).cdf(hyperparameters.prior_points(64, seed=0)[:, 0])
    counts, _ = np.histogram(levels, bins=16, range=(0, 1))
    np.testing.assert_array_equal(counts, np.full(16, 4))


def test_the_prior_sd_is_robust_and_positive() -> None:
    with pm.Model() as model:
        pm.Normal("wide", 0, 10.0)
        pm.Cauchy("heavy", 0, 1.0)
        pm.Normal("fixed", 2.0, 1e-300)
    sd = Hyperparameters.of(model).prior_sd
    # 256 draws: a quantile of level .16 has a standard error of 9% of the spread.
    assert sd[0] == pytest.approx(10.0, rel=0.3)
    assert sd[1] == pytest.approx(1.8, rel=0.5)
    assert sd[2] == 1.0


@pytest.mark.parametrize("prior", [pm.Normal, pm.VonMises], ids=lambda p: p.__name__)
def test_fixed_points_depend_on_names_alone(prior: type) -> None:
    found = []
    for names in (("a", "b"), ("b", "a")):
        with pm.Model() as model:
            for name in names:
                prior(name, {"a": 0.0, "b": 1.0}[name], 2.0)
        for copy in (model, clone_model(model)):
            points, order = fixed_points(Hyperparameters.of(copy), 4)
            assert len(np.unique(points[:, 0])) == 4
            found.append(points[:, order])
    for points in found[1:]:
        np.testing.assert_array_equal(points, found[0])


@pytest.mark.parametrize(
    ("name", "shape", "labels", "expected"),
    [
        ("mu", (), [], ["mu"]),
        ("none", (0,), [], []),
        ("c", (2, 2), [], ["c[0,0]", "c[0,1]", "c[1,0]", "c[1,1]"]),
        ("mu", (2,), [["Adler", "Busch"]], ["mu[Adler]", "mu[Busch]"]),
        ("c", (2, 2), [None, [1.5, 2]], ["c[0,1.5]", "c[0,2.0]", "c[1,1.5]", "c[1,2.0]"]),
        # Labels that do not name each element are left out.
        ("mu", (2,), [["a", "a"]], ["mu[0]", "mu[1]"]),
        ("p_simplex__", (1,), [["a", "b"]], ["p_simplex__[0]"]),
        ("c", (1, 2), [["a", "b"]], ["c[0,0]", "c[0,1]"]),
    ],
)
def test_names_of_elements(
    name: str, shape: tuple[int, ...], labels: list[list[object]], expected: list[str]
) -> None:
    assert element_names(name, shape, labels) == expected
    assert element_name("mu", ("Adler", 1)) == "mu[Adler,1]"


def test_values_by_element() -> None:
    columns = split_elements({"s": np.arange(3.0), "c": np.arange(12.0).reshape(3, 2, 2)})
    assert list(columns) == ["s", "c[0,0]", "c[0,1]", "c[1,0]", "c[1,1]"]
    np.testing.assert_array_equal(columns["c[1,0]"], [2, 6, 10])
    point = xr.Dataset({"w": (["i", "j"], [[1.0, 2.0], [3.0, 4.0]]), "mu": 5.0})
    values = {"w[0,0]": 1.0, "w[0,1]": 2.0, "w[1,0]": 3.0, "w[1,1]": 4.0, "mu": 5.0}
    assert single_elements(point.data_vars) == values


W = np.arange(24.0).reshape(2, 3, 4)
DRAWS = xr.Dataset({"mu": (["chain", "draw"], W[..., 0]), "w": (["chain", "draw", "i"], W)})


def test_draws_by_element() -> None:
    columns = split_elements(stacked_draws(DRAWS))
    assert list(columns) == ["mu", "w[0]", "w[1]", "w[2]", "w[3]"]
    np.testing.assert_array_equal(columns["w[2]"], W[..., 2].ravel())
    transposed = split_elements(stacked_draws(DRAWS.transpose("i", "draw", "chain"), ["w"]))
    assert "mu" not in transposed
    np.testing.assert_array_equal(transposed["w[2]"], columns["w[2]"])


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_draws_that_are_not_finite_are_refused(value: float) -> None:
    draws = DRAWS.copy(deep=True)
    draws["w"][1, 2, 3] = value
    assert list(finite_draws(draws, ["mu"])) == ["mu"]
    with pytest.raises(ValueError, match=r"posterior: w: got NaN or infinite values in 1 of 6 dra"):
        finite_draws(draws, ["mu", "w"])


def test_coordinates_are_kept() -> None:
    coords = {"supplier": ["Adler", "Busch"]}
    mu = xr.DataArray(np.arange(12.0).reshape(2, 2, 3), coords, ["supplier", "draw", "chain"])
    stacked = stacked_draws(xr.Dataset({"mu": mu}))
    np.testing.assert_array_equal(split_elements(stacked)["mu[Busch]"], mu.values[1].T.ravel())
    assert table_elements(stacked) == ["mu[Adler]", "mu[Busch]"]
    point = xr.Dataset({"mu": ("supplier", [1.0, 2.0])}, coords).data_vars
    assert single_elements(point) == {"mu[Adler]": 1.0, "mu[Busch]": 2.0}
    assert optimum_elements(point, {"mu": [0.1, 0.2]}) == ["mu[Adler]", "mu[Busch]"]
    assert type(finite_draws(xr.Dataset({"mu": mu}), ["mu"])["mu"]) is np.ndarray
    # A model has those that draws lack.
    with pm.Model(coords=coords) as model:
        pm.Normal("mu", dims="supplier")
    bare = stacked_draws(xr.Dataset({"mu": mu.drop_vars("supplier")}), model=model)
    assert table_elements(bare) == ["mu[Adler]", "mu[Busch]"]


# Correlation matrices with rounding errors.
FACTORS = np.random.default_rng(0).normal(size=(50, 3, 3))
FACTORS /= np.sqrt((FACTORS**2).sum(axis=-1, keepdims=True))
CORRELATIONS = FACTORS @ FACTORS.swapaxes(1, 2)


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        (CORRELATIONS, ["x[0,1]", "x[0,2]", "x[1,2]"]),
        (
            np.linalg.cholesky(CORRELATIONS),
            ["x[1,0]", "x[1,1]", "x[2,0]", "x[2,1]", "x[2,2]"],
        ),
        (FACTORS[:, :2, :2], ["x[0,0]", "x[0,1]", "x[1,0]", "x[1,1]"]),
        (FACTORS[:, :1, :2], ["x[0,0]", "x[0,1]"]),
        # Chains that never moved
        (
            np.broadcast_to([[1.0, 0.5], [0.5, 1.0]], (50, 2, 2)),
            ["x[0,0]", "x[0,1]", "x[1,0]", "x[1,1]"],
        ),
    ],
    ids=["correlation", "factor", "any", "oblong", "constant"],
)
def test_elements_in_a_table(values: np.ndarray, expected: list[str]) -> None:
    assert table_elements({"mu": np.zeros((50, 1)), "x": values}) == ["mu[0]", *expected]


@pytest.mark.parametrize("error", [0.1, np.inf, np.nan])
def test_elements_without_an_error_are_constant(error: float) -> None:
    point = {"r": xr.DataArray([[1.0, 0.5], [0.5, 1.0]]), "mu": xr.DataArray(2.0)}
    stderr = {"r": np.array([[0.0, error], [error, 0.0]]), "mu": 0.0}
    assert optimum_elements(point, stderr) == ["r[0,1]", "mu"]


def test_a_packed_factor_is_shown_by_its_standard_deviations_and_correlations() -> None:
    variables = ["mu", "chol_stds", "chol_corr"]
    assert readable_variables(["mu", "chol"], {"chol", *variables}) == variables
    assert readable_variables(["mu", "chol"], {"mu", "chol", "chol_corr"}) == ["mu", "chol"]
    elements = ["mu[0]", "chol[0]", "chol[1]", "chol_corr[0,1]", "chol_stds[0]", "rho"]
    assert readable_elements(elements) == ["mu[0]", "chol_corr[0,1]", "chol_stds[0]", "rho"]
    assert readable_elements(["chol[0]", "chol_stds[0]"]) == ["chol[0]", "chol_stds[0]"]


def test_an_element_belongs_to_the_longest_name() -> None:
    names = ["mu", "mu[1]", "force [N]"]
    elements = ["mu[0]", "mu[1]", "mu[1][0]", "force [N]", "force [N][2]", "sigma[1]", "muu"]
    expected = ["mu", "mu[1]", "mu[1]", "force [N]", "force [N]", "sigma", "muu"]
    assert [variable_of(element, names) for element in elements] == expected
    assert [variable_of(x) for x in ("a[0]", "yield [MPa]", "yield [MPa][1]")] == [
        "a",
        "yield [MPa]",
        "yield [MPa]",
    ]


@pytest.mark.parametrize("name", ["chain", "draw", "mu[1]"])
def test_names_that_results_cannot_have_are_refused(name: str) -> None:
    with pm.Model() as model:
        pm.Normal("mu", shape=2)
        pm.Normal(name)
    with pytest.raises(
        ValueError, match=r"model: got .* called .*, expected (another|different) name"
    ):
        Hyperparameters.of(model)
