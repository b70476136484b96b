"""Log-likelihoods of specimens in batches are those of SciPy's densities and of PyMC's graphs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest
from scipy import stats
from scipy.special import logsumexp

from prbayes.propagation.population_density import ExponentialForm, PopulationDensity
from prbayes.response.distributions import compiled_log_density
from prbayes.response.inputs import Inputs, read_inputs
from prbayes.specimens.weighted_points import ProductPoints, WeightedPoints

RNG = np.random.default_rng(0)
X = RNG.uniform(0.1, 0.9, (7, 5))  # within the support of all families
LOG_A = RNG.normal(size=X.shape)
LOG_A[0, 2:] = -np.inf
FIRST, SECOND = np.array([0.3, 1.0, 2.5, 40.0]), np.array([0.05, 0.5, 1.0, 7.0])

FAMILIES: dict[str, tuple[Callable[..., Any], Callable[..., Any]]] = {
    "normal": (pm.Normal.dist, stats.norm),
    "lognormal": (pm.LogNormal.dist, lambda m, s: stats.lognorm(s, scale=np.exp(m))),
    "gamma": (pm.Gamma.dist, lambda a, b: stats.gamma(a, scale=1 / b)),
    "inverse gamma": (pm.InverseGamma.dist, lambda a, b: stats.invgamma(a, scale=b)),
    "beta": (pm.Beta.dist, stats.beta),
    "exponential": (
        lambda a, b: pm.Exponential.dist(a * b),
        lambda a, b: stats.expon(0, 1 / a / b),
    ),
    "half-normal": (
        lambda a, b: pm.HalfNormal.dist(a * b),
        lambda a, b: stats.halfnorm(scale=a * b),
    ),
    "truncated": (
        lambda a, b: pm.TruncatedNormal.dist(a, b, lower=-1.0),
        lambda a, b: stats.truncnorm((-1 - a) / b, np.inf, a, b),
    ),
}


def inputs_of(*families: Callable[..., Any]) -> Inputs:
    """Return inputs of two hyperparameters each."""
    with pm.Model() as model:
        pairs = [(pm.Flat(f"a{i}"), pm.Flat(f"b{i}")) for i in range(len(families))]
        dists = [family(*pair) for family, pair in zip(families, pairs, strict=True)]
        return read_inputs("y", dists, model)


def by_name(inputs: Inputs, values: dict[str, Any]) -> list[Any]:
    """Return values of the roots, in their order."""
    return [values[str(root.name)] for root in inputs.parents]


def log_likelihoods(inputs: Inputs, roots: Sequence[Any], x: Sequence[Any], log_a: Any) -> Any:
    """Return the log-likelihoods by the module under test."""
    return WeightedPoints.of(PopulationDensity(inputs), x, log_a).log_likelihoods(roots)


def by_graph(inputs: Inputs, roots: Sequence[Any], x: Sequence[Any], log_a: Any) -> Any:
    """Return the log-likelihoods by PyMC's density."""
    flat = [v.reshape(log_a.size, *v.shape[2:]) for v in x]
    (logs,) = compiled_log_density(inputs)(*roots, *flat)
    return logsumexp(logs.reshape(-1, *log_a.shape) + log_a, axis=2)


@pytest.mark.parametrize("name", FAMILIES)
def test_families_are_those_of_scipy(name: str) -> None:
    of_pymc, of_scipy = FAMILIES[name]
    inputs = inputs_of(of_pymc)
    roots = by_name(inputs, {"a0": FIRST, "b0": SECOND})
    found = log_likelihoods(inputs, roots, [X], LOG_A)
    assert ExponentialForm.of(inputs.aleatory, [X.ravel()]) is not None
    logs = np.stack([of_scipy(a, b).logpdf(X) for a, b in zip(FIRST, SECOND, strict=True)])
    # The normaliser of a truncated distribution has fewer digits in PyMC.
    digits = 1e-8 if name == "truncated" else 1e-12
    np.testing.assert_allclose(found, logsumexp(logs + LOG_A, axis=2), rtol=digits, atol=digits)
    assert np.allclose(found, by_graph(inputs, roots, [X], LOG_A), rtol=1e-12, atol=1e-12)
    # Invalid parameters, and points outside of the support, have no density.
    roots = by_name(inputs, {"a0": np.ones(4), "b0": np.array([-1.0, 0.0, np.nan, 1.0])})
    outside = np.where(np.arange(7)[:, None] == 3, -2.0, X)
    found = log_likelihoods(inputs, roots, [outside], LOG_A)
    assert np.isneginf(found[:3]).all()
    assert np.isneginf(found[3]).tolist() == [name != "normal" and i == 3 for i in range(7)]


def test_normal_populations_far_narrower_than_their_points_or_far_from_zero() -> None:
    inputs = inputs_of(pm.Normal.dist)
    roots = by_name(inputs, {"a0": np.full(3, 0.3), "b0": np.array([1e-6, 0.5, 1e-3])})
    found = log_likelihoods(inputs, roots, [X], LOG_A)
    assert np.allclose(found, by_graph(inputs, roots, [X], LOG_A), rtol=1e-12)
    # Points of a narrow population are small differences of large numbers.
    # Beyond some narrowness the product loses the digits, and the graph is evaluated.
    for width in (1e-4, 1e-7):
        x = np.where(np.arange(X.shape[1]) % 2, X, 0.3 + width * X)
        roots = by_name(inputs, {"a0": np.full(2, 0.3), "b0": np.array([2, 10]) * width})
        found = log_likelihoods(inputs, roots, [x], LOG_A)
        assert np.abs(found - by_graph(inputs, roots, [x], LOG_A)).max() < 1e-7
    # Squares of a distant mean keep their digits.
    far = by_name(inputs, {"a0": 1e8 + FIRST, "b0": SECOND})
    near = by_name(inputs, {"a0": FIRST, "b0": SECOND})
    found = log_likelihoods(inputs, far, [1e8 + X], LOG_A)
    assert np.allclose(found, log_likelihoods(inputs, near, [X], LOG_A), rtol=1e-5)
    nothing = np.empty((2, 0))
    found = log_likelihoods(inputs, near, [nothing], nothing)
    assert np.isneginf(found).all()
    assert found.shape == (4, 2)


def test_independent_inputs_and_vectors_add() -> None:
    with pm.Model() as model:
        mu, sigma = pm.Flat("a0", shape=2), pm.Flat("b0")
        vector = pm.Normal.dist(mu, sigma, shape=2)
        inputs = read_inputs("y", [vector, pm.Gamma.dist(alpha=sigma, beta=np.float64(2))], model)
    roots = by_name(inputs, {"a0": np.stack([FIRST, SECOND], axis=1), "b0": SECOND})
    x = [np.stack([X, 2 * X], axis=2), X]
    found = log_likelihoods(inputs, roots, x, LOG_A)
    assert np.allclose(found, by_graph(inputs, roots, x, LOG_A), rtol=1e-12)


def test_correlated_inputs() -> None:
    with pm.Model() as model:
        rho, sigma = pm.Flat("a0"), pm.Flat("b0")
        cov = pt.stacklists([[sigma**2, rho * sigma], [rho * sigma, 1.0]])
        inputs = read_inputs("y", [pm.MvNormal.dist(np.zeros(2), cov)], model)
    roots = by_name(inputs, {"a0": np.array([0.0, -0.9, 0.99, 1.01]), "b0": SECOND})
    x = np.stack([X, X[::-1]], axis=2)
    found = log_likelihoods(inputs, roots, [x], LOG_A)
    expected = by_graph(inputs, roots, [x], LOG_A)
    assert np.isneginf(found[3]).all()
    assert np.allclose(found[:3], expected[:3], rtol=1e-11)


def test_other_families_have_their_graph() -> None:
    inputs = inputs_of(lambda a, b: pm.Weibull.dist(alpha=a, beta=b))
    assert ExponentialForm.of(inputs.aleatory, [X.ravel()]) is None
    roots = by_name(inputs, {"a0": FIRST[:3], "b0": SECOND[:3]})
    expected = by_graph(inputs, roots, [X], LOG_A)
    assert np.allclose(log_likelihoods(inputs, roots, [X], LOG_A), expected, rtol=1e-12)


@pytest.mark.parametrize("name", ["normal", "gamma"])
def test_products_have_the_likelihoods_of_their_own_specimens(name: str) -> None:
    """Also of specimens with one point, and of populations far narrower than the points."""
    inputs = inputs_of(FAMILIES[name][0])
    log_a = LOG_A.copy()
    log_a[[1, 4], 1:] = -np.inf
    x, sizes, products = X.copy(), [2, 4, 1], np.array([2, 0, 1])
    x[6] = 0.5
    points = WeightedPoints.of(PopulationDensity(inputs), [x], log_a)
    # The last population is as narrow as rounding allows at the one place of the third product.
    of_each = (
        [np.append(FIRST, 0.5), np.append(SECOND, 1e-7)] if name == "normal" else [FIRST, SECOND]
    )
    roots = by_name(inputs, dict(zip(("a0", "b0"), of_each, strict=True)))
    tiled = [np.tile(root, 3) for root in roots]
    found = ProductPoints.of(points, sizes).log_likelihoods(tiled, products)
    expected = np.add.reduceat(by_graph(inputs, roots, [x], log_a), [0, 2, 6], axis=1)
    np.testing.assert_allclose(found, expected.T[products], rtol=1e-7)
