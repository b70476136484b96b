"""Theta: its names, its transforms, its prior, against what PyMC says itself."""

from __future__ import annotations

import numpy as np
import pymc as pm
import pytest
from pymc.model.fgraph import clone_model
from scipy import stats

from prbayes.model.parameters import Hyperparameters, fixed_points, plain_names


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
    assert plain_names(found) == ["sigma_log__[0]", "sigma_log__[1]", "p_simplex__[0]"]


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
            points = fixed_points(hyperparameters, 4)
            assert len(np.unique(points[:, 0])) == 4
            found.append(points[:, np.argsort(hyperparameters.names)])
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
