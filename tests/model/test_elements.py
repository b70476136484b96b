"""Names of elements."""

import numpy as np
import pytest
import xarray as xr

from prbayes.model.elements import (
    element_name,
    element_names,
    finite_draws,
    optimum_elements,
    readable_elements,
    readable_variables,
    single_elements,
    split_elements,
    stacked_draws,
    table_elements,
)


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
    assert single_elements({"mu": [1.0, 2.0], "s": 3}) == {"mu[0]": 1.0, "mu[1]": 2.0, "s": 3.0}
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
    point = {"r": np.array([[1.0, 0.5], [0.5, 1.0]]), "mu": 2.0}
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
