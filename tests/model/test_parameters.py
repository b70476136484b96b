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
    optimum_elements,
    readable_elements,
    readable_variables,
    single_elements,
    split_elements,
    stacked_draws,
    table_elements,
)


def model_of() -> pm.Model:
    with pm.Model() as model:
        mu = pm.Normal("mu", [1.0, 5.0], 2.0)
        pm.HalfNormal("sigma", 3.0)
        pm.Deterministic("total", mu.sum())
        pm.Deterministic("constant", pm.math.constant(4.0))
    return model


THETAS = np.array([[0.0, 4.0, 0.3], [2.0, 6.0, -0.4]])


def test_names_and_shapes() -> None:
    found = Hyperparameters.of(model_of())
    assert found.names == ["mu[0]", "mu[1]", "sigma_log__"]
    assert found.readable_names == ["mu[0]", "mu[1]", "sigma"]
    assert found.shapes == {"mu": (2,), "sigma_log__": ()}
    np.testing.assert_allclose(found.initial, [1.0, 5.0, np.log(3.0)])
    assert found.size == 3


def test_names_have_the_coordinates_of_the_model_and_its_order_has_not() -> None:
    with pm.Model(coords={"supplier": ["Adler", "Busch"]}) as model:
        pm.HalfNormal("sigma", 3.0, dims="supplier")
        pm.Dirichlet("p", np.ones(2), dims="supplier")
    found = Hyperparameters.of(model)
    # A variable that has fewer places unconstrained than in its own units is numbered.
    assert found.names == ["sigma_log__[Adler]", "sigma_log__[Busch]", "p_simplex__[0]"]
    assert found.readable_names == ["sigma[Adler]", "sigma[Busch]", "p[0]"]


def test_the_log_prior_has_the_jacobian() -> None:
    found = Hyperparameters.of(model_of()).log_prior(THETAS)
    normal = stats.norm([1.0, 5.0], 2.0).logpdf(THETAS[:, :2]).sum(axis=1)
    half = stats.halfnorm(scale=3.0).logpdf(np.exp(THETAS[:, 2])) + THETAS[:, 2]
    np.testing.assert_allclose(found, normal + half, rtol=1e-7)


def test_constrained_values_and_back() -> None:
    hyperparameters = Hyperparameters.of(model_of())
    values = hyperparameters.constrained(THETAS)
    np.testing.assert_allclose(values["sigma"], np.exp(THETAS[:, 2]))
    np.testing.assert_allclose(values["total"], [4.0, 8.0])
    np.testing.assert_array_equal(values["constant"], [4.0, 4.0])
    back = hyperparameters.thetas_of([values["mu"], values["sigma"]])
    np.testing.assert_allclose(back, THETAS, rtol=1e-12)
    point = {"mu": values["mu"][1], "sigma": values["sigma"][1]}
    np.testing.assert_allclose(hyperparameters.unconstrained(point), THETAS[1])


@pytest.mark.parametrize(
    ("point", "error", "message"),
    [
        ({"mu": 1.0}, KeyError, "expected a value for each of"),
        (
            {"mu": [1.0, 2.0, 3.0], "sigma": 1.0},
            ValueError,
            r"mu: got shape \(3,\), expected \(2,\)",
        ),
        ({"mu": 1.0, "sigma": -1.0}, ValueError, "inside the support"),
    ],
)
def test_points_that_are_none(
    point: dict[str, object], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        Hyperparameters.of(model_of()).unconstrained(point)


def test_discrete_hyperparameters_are_refused() -> None:
    with pm.Model() as model:
        pm.Poisson("k", 3)
    with pytest.raises(TypeError, match=r"discrete hyperparameters \['k'\]"):
        Hyperparameters.of(model)


def test_support() -> None:
    with pm.Model() as model:
        pm.Uniform("u", 0, 1, default_transform=None)
    found = Hyperparameters.of(model).in_support(np.array([[0.5], [-0.1], [1.1]]))
    np.testing.assert_array_equal(found, [True, False, False])


def test_draws_of_the_prior_are_kept_apart() -> None:
    hyperparameters = Hyperparameters.of(model_of())
    first = hyperparameters.prior_thetas(16, 3)
    first[:] = np.nan
    again = hyperparameters.prior_thetas(16, 3)
    assert np.isfinite(again).all()
    assert not np.array_equal(again, hyperparameters.prior_thetas(16, 4))


def test_the_spread_is_robust_and_never_zero() -> None:
    with pm.Model() as model:
        pm.Normal("wide", 0, 10.0)
        pm.Cauchy("heavy", 0, 1.0)
    hyperparameters = Hyperparameters.of(model)
    # 256 draws: a quantile of level .16 has a standard error of 9% of the spread.
    assert hyperparameters.prior_sd[0] == pytest.approx(10.0, rel=0.3)
    assert hyperparameters.prior_sd[1] == pytest.approx(1.8, rel=0.5)
    with pm.Model() as still:
        pm.Normal("fixed", 2.0, 1e-300)
    np.testing.assert_array_equal(Hyperparameters.of(still).prior_sd, [1.0])


def test_points_of_the_prior_are_even() -> None:
    points = Hyperparameters.of(model_of()).prior_points(64, seed=0)
    levels = stats.norm(1.0, 2.0).cdf(points[:, 0])
    counts = np.histogram(levels, bins=16, range=(0, 1))[0]
    np.testing.assert_array_equal(counts, np.full(16, 4))


@pytest.mark.parametrize("prior", [pm.Normal, pm.VonMises], ids=lambda p: p.__name__)
def test_fixed_points_follow_names_and_not_order(prior: type) -> None:
    found = []
    for names in (("a", "b"), ("b", "a")):
        with pm.Model() as model:
            for name in names:
                prior(name, {"a": 0.0, "b": 1.0}[name], 2.0)
        for one in (model, clone_model(model)):
            hyperparameters = Hyperparameters.of(one)
            points, order = fixed_points(hyperparameters, 4)
            assert len(np.unique(points[:, 0])) == 4
            found.append(points[:, order])
    for other in found[1:]:
        np.testing.assert_array_equal(found[0], other)


def test_a_batch_of_no_thetas_has_no_values_of_any_variable() -> None:
    with pm.Model() as model:
        factor = pm.LKJCorr("factor", n=2, eta=2)
        pm.Deterministic("correlation", factor @ factor.T)
    found = Hyperparameters.of(model).constrained(np.empty((0, 1)))
    assert {name: value.shape for name, value in found.items()} == {
        "factor": (0, 2, 2),
        "correlation": (0, 2, 2),
    }


def test_names() -> None:
    assert element_name("mu", ()) == "mu"
    assert element_name("mu", (1,)) == "mu[1]"
    assert element_name("cov", (0, 1)) == "cov[0,1]"


def test_names_are_in_the_order_of_raveled_values() -> None:
    assert element_names("mu", ()) == ["mu"]
    assert element_names("c", (2, 2)) == ["c[0,0]", "c[0,1]", "c[1,0]", "c[1,1]"]
    assert element_names("none", (0,)) == []


def test_values_by_element() -> None:
    found = split_elements({"s": np.arange(3.0), "c": np.arange(12.0).reshape(3, 2, 2)})
    assert list(found) == ["s", "c[0,0]", "c[0,1]", "c[1,0]", "c[1,1]"]
    np.testing.assert_array_equal(found["s"], [0, 1, 2])
    np.testing.assert_array_equal(found["c[1,0]"], [2, 6, 10])


def test_draws_by_element() -> None:
    w = np.arange(24.0).reshape(2, 3, 4)
    group = xr.Dataset({"mu": (["chain", "draw"], w[..., 0]), "w": (["chain", "draw", "i"], w)})
    found = split_elements(stacked_draws(group))
    assert list(found) == ["mu", "w[0]", "w[1]", "w[2]", "w[3]"]
    np.testing.assert_array_equal(found["w[2]"], w[..., 2].ravel())
    turned = split_elements(stacked_draws(group.transpose("i", "draw", "chain"), ["w"]))
    assert "mu" not in turned
    np.testing.assert_array_equal(turned["w[2]"], found["w[2]"])


def test_a_point_is_one_number_for_each_element() -> None:
    point = xr.Dataset({"w": (["i", "j"], [[1.0, 2.0], [3.0, 4.0]]), "mu": 5.0})
    values = {"w[0,0]": 1.0, "w[0,1]": 2.0, "w[1,0]": 3.0, "w[1,1]": 4.0, "mu": 5.0}
    assert single_elements(point.data_vars) == values


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_draws_that_are_no_numbers_are_refused(value: float) -> None:
    w = np.arange(24.0).reshape(2, 3, 4)
    w[1, 2, 3] = value
    group = xr.Dataset({"mu": (["chain", "draw"], w[..., 0]), "w": (["chain", "draw", "i"], w)})
    assert list(finite_draws(group, ["mu"])) == ["mu"]
    with pytest.raises(ValueError, match=r"posterior: w: got NaN or infinite values in 1 of 6 dra"):
        finite_draws(group, ["mu", "w"])


def correlations(size: int) -> np.ndarray:
    """Return correlation matrices of three variables, shape (size, 3, 3), with rounding errors."""
    factors = np.random.default_rng(0).normal(size=(size, 3, 3))
    factors /= np.sqrt((factors**2).sum(axis=-1, keepdims=True))
    return factors @ factors.swapaxes(1, 2)


def test_of_a_correlation_each_pair_is_told_once_and_no_diagonal() -> None:
    values = {"mu": np.zeros((50, 2)), "r": correlations(50)}
    assert table_elements(values) == ["mu[0]", "mu[1]", "r[0,1]", "r[0,2]", "r[1,2]"]


def test_of_a_cholesky_factor_no_zeros_are_told() -> None:
    factors = np.linalg.cholesky(correlations(50))
    told = ["l[1,0]", "l[1,1]", "l[2,0]", "l[2,1]", "l[2,2]"]
    assert table_elements({"l": factors}) == told


def test_matrices_of_other_kinds_are_told_as_they_are() -> None:
    draws = np.random.default_rng(0).normal(size=(50, 2, 2))
    assert len(table_elements({"any": draws})) == 4
    assert len(table_elements({"oblong": draws.reshape(25, 2, 4)})) == 8
    stuck = np.broadcast_to([[1.0, 0.5], [0.5, 1.0]], (50, 2, 2))
    assert len(table_elements({"stuck": stuck})) == 4  # chains that never moved are to be seen


@pytest.mark.parametrize("error", [0.1, np.inf, np.nan])
def test_of_an_optimum_the_standard_errors_tell_what_is_constant(error: float) -> None:
    r = xr.DataArray([[1.0, 0.5], [0.5, 1.0]])
    point = {"r": r, "mu": xr.DataArray(2.0)}
    stderr = {"r": np.array([[0.0, error], [error, 0.0]]), "mu": 0.0}
    assert optimum_elements(point, stderr) == ["r[0,1]", "mu"]


def test_elements_are_called_by_their_coordinates() -> None:
    assert element_names("mu", (2,), [["Adler", "Busch"]]) == ["mu[Adler]", "mu[Busch]"]
    assert element_names("c", (2, 2), [None, [1.5, 2]]) == [
        "c[0,1.5]",
        "c[0,2.0]",
        "c[1,1.5]",
        "c[1,2.0]",
    ]
    # What does not name each place by itself is left out: two elements of one name would be one.
    assert element_names("mu", (2,), [["a", "a"]]) == ["mu[0]", "mu[1]"]
    assert element_names("p_simplex__", (1,), [["a", "b"]]) == ["p_simplex__[0]"]
    assert element_names("c", (2, 2), [["a", "b"]])[0] == "c[0,0]"


def test_draws_and_points_carry_their_coordinates() -> None:
    coords = {"supplier": ["Adler", "Busch"]}
    mu = xr.DataArray(np.arange(12.0).reshape(2, 2, 3), coords, ["supplier", "draw", "chain"])
    stacked = stacked_draws(xr.Dataset({"mu": mu}))
    np.testing.assert_array_equal(split_elements(stacked)["mu[Busch]"], mu.values[1].T.ravel())
    assert table_elements(stacked) == ["mu[Adler]", "mu[Busch]"]
    point = xr.Dataset({"mu": ("supplier", [1.0, 2.0])}, coords).data_vars
    assert single_elements(point) == {"mu[Adler]": 1.0, "mu[Busch]": 2.0}
    assert optimum_elements(point, {"mu": [0.1, 0.2]}) == ["mu[Adler]", "mu[Busch]"]
    assert type(finite_draws(xr.Dataset({"mu": mu}), ["mu"])["mu"]) is np.ndarray


def test_for_a_packed_factor_its_standard_deviations_and_correlations_are_read() -> None:
    assert readable_variables(["mu", "chol"], {"mu", "chol", "chol_stds", "chol_corr"}) == [
        "mu",
        "chol_stds",
        "chol_corr",
    ]
    assert readable_variables(["mu", "chol"], {"mu", "chol", "chol_corr"}) == ["mu", "chol"]
    every = ["chol", "mu", "chol_corr", "chol_stds"]
    assert readable_variables(every, every) == ["chol_stds", "chol_corr", "mu"]


def test_of_elements_those_of_a_packed_factor_are_not_read() -> None:
    names = ["mu[0]", "chol[0]", "chol[1]", "chol_corr[0,1]", "chol_stds[0]", "rho"]
    assert readable_elements(names) == ["mu[0]", "chol_corr[0,1]", "chol_stds[0]", "rho"]
    assert readable_elements(["chol[0]", "chol_stds[0]"]) == ["chol[0]", "chol_stds[0]"]
