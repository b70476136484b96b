"""What is read off distributions agrees with closed forms: densities, quantiles, draws."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest
from scipy import stats

from prbayes.response.compile import PLAIN, compile_batched
from prbayes.response.distributions import (
    PopulationSampler,
    PriorPoints,
    PriorSampler,
    compiled_log_density,
    fixed_ends,
    normal_scores,
    quantiles,
    refuse_lopsided,
    refuse_without_density,
    valid,
)
from prbayes.response.inputs import Inputs, read_inputs

COVARIANCE = np.array([[1.0, 0.3], [0.3, 0.36]])


def inputs_of(make: Callable[[Any, Any], list[Any]]) -> tuple[Inputs, pm.Model]:
    with pm.Model() as model:
        mu, sigma = pm.Normal("mu", 2, 1), pm.HalfNormal("sigma", 1)
        return read_inputs("y", make(mu, sigma), model), model


def log_densities(inputs: Inputs, points: list[Any], **parents: Any) -> Any:
    """Return log p(x) of points at values of the parents, (k, n)."""
    return compiled_log_density(inputs)(*[parents[str(p.name)] for p in inputs.parents], *points)[0]


def test_log_densities_are_summed_over_the_inputs_and_their_elements() -> None:
    scale = pt.constant(COVARIANCE)
    inputs, _ = inputs_of(
        lambda mu, sigma: [
            pm.Normal.dist(mu, sigma),
            pm.MvNormal.dist(pt.stack([mu, 0.5]), scale, shape=(3, 2)),
            pm.Gamma.dist(2.0, sigma, shape=3),
            pm.MvStudentT.dist(nu=sigma, mu=pt.stack([mu, 0.5]), scale=scale),
        ]
    )
    rng = np.random.default_rng(1)
    points = [rng.normal(size=5), rng.normal(size=(5, 3, 2)), rng.gamma(2.0, size=(5, 3))]
    points.append(rng.normal(size=(5, 2)))
    sigmas = np.array([0.7, 1.5, -1.0])
    found = log_densities(inputs, points, mu=np.array([2.0, -1.0, 0.0]), sigma=sigmas)
    for row, mu, sigma in zip(found, (2.0, -1.0), sigmas, strict=False):
        expected = stats.norm(mu, sigma).logpdf(points[0])
        normal = stats.multivariate_normal([mu, 0.5], COVARIANCE)
        expected = expected + normal.logpdf(points[1]).sum(axis=1)
        expected = expected + stats.gamma(2.0, scale=1 / sigma).logpdf(points[2]).sum(axis=1)
        student = stats.multivariate_t([mu, 0.5], COVARIANCE, df=sigma)
        np.testing.assert_allclose(row, expected + student.logpdf(points[3]), rtol=1e-12)
    assert np.isneginf(found[2]).all()  # no degrees of freedom below zero


@pytest.mark.parametrize("size", [2, 5])
def test_a_cholesky_factor_of_any_size_gives_the_density(size: int) -> None:
    covariance = 0.3 + np.diag(np.arange(1.0, 1 + size))
    inputs, _ = inputs_of(
        lambda mu, sigma: [pm.MvNormal.dist(pt.ones(size) * mu, sigma * covariance)]
    )
    points = np.random.default_rng(1).normal(size=(4, size))
    (found,) = log_densities(inputs, [points], mu=np.array([0.5]), sigma=np.array([2.0]))
    exact = stats.multivariate_normal(np.full(size, 0.5), 2 * covariance)
    np.testing.assert_allclose(found, exact.logpdf(points), rtol=1e-12)


def test_an_impossible_covariance_has_no_density() -> None:
    inputs, _ = inputs_of(
        lambda mu, sigma: [pm.MvNormal.dist(np.zeros(2), pt.stacklists([[1.0, mu], [mu, 1.0]]))]
    )
    found = log_densities(inputs, [np.zeros((1, 2))], mu=np.array([0.5, 1.5]))
    assert list(np.isneginf(found[:, 0])) == [False, True]


def test_a_covariance_that_is_not_symmetric_is_refused() -> None:
    def lopsided(mu: Any, sigma: Any) -> list[Any]:
        return [pm.MvNormal.dist(np.zeros(2), pt.stacklists([[1.0, mu], [0.0, sigma]]))]

    inputs, _ = inputs_of(lopsided)
    refuse_lopsided("y", inputs, [np.zeros(3), np.ones(3)])
    refuse_lopsided("y", inputs, [np.full(3, np.nan), np.ones(3)])  # what is invalid is no matrix
    with pytest.raises(ValueError, match=r"y: got an input whose .* not symmetric, .*LKJCorr"):
        refuse_lopsided("y", inputs, [np.array([0.0, 0.1, 0.0]), np.ones(3)])


@pytest.mark.parametrize(
    ("dist", "expected"),
    [
        (pm.Normal.dist(1.0, 2.0), stats.norm(1, 2)),
        (pm.Weibull.dist(2.0, 1.5), stats.weibull_min(2, scale=1.5)),
        (pm.Uniform.dist(1.0, 3.0), stats.uniform(1, 2)),
    ],
    ids=["Normal", "Weibull", "Uniform"],
)
def test_quantiles(dist: Any, expected: Any) -> None:
    u = np.array([0.01, 0.3, 0.5, 0.99])
    found = quantiles("y", dist, u).eval(mode=PLAIN)
    np.testing.assert_allclose(found, expected.ppf(u), rtol=1e-9)


@pytest.mark.parametrize(
    "ends",
    [{"lower": 0.0}, {"upper": 3.0}, {"lower": [0.0, -np.inf]}, {"lower": 0.0, "upper": [3, 2.5]}],
    ids=str,
)
def test_quantiles_of_a_vector_of_truncated_normals(ends: dict[str, Any]) -> None:
    """An infinite end of a vector is no number in PyMC's inverse distribution function."""
    u, mu = np.array([[0.1, 0.5], [0.9, 0.3], [0.999, 0.7]]), np.array([1.0, 2.0])
    low, high = (np.asarray(ends.get(k, e)) for k, e in (("lower", -np.inf), ("upper", np.inf)))
    found = quantiles("y", pm.TruncatedNormal.dist(mu, 1.0, **ends), u).eval(mode=PLAIN)
    np.testing.assert_allclose(found, stats.truncnorm.ppf(u, low - mu, high - mu, mu), rtol=1e-7)


def test_normal_scores_are_the_inverse_of_quantiles() -> None:
    scale = pt.constant(COVARIANCE)
    inputs, _ = inputs_of(
        lambda mu, sigma: [
            pm.LogNormal.dist(mu, sigma),
            pm.Gamma.dist(2.0, sigma, shape=3),
            pm.MvNormal.dist(pt.stack([mu, 0.5]), scale, shape=(3, 2)),
        ]
    )
    z = [np.array([-6.0, 0.0, 5.0]), np.linspace(-4, 4, 9).reshape(3, 3)]
    z.append(np.random.default_rng(1).normal(size=(3, 3, 2)))
    mu, sigma = np.array([2.0, -1.0]), np.array([0.7, 1.5])
    root = np.linalg.cholesky(COVARIANCE)
    for i in range(2):
        points = [
            np.exp(mu[i] + sigma[i] * z[0]),
            stats.gamma(2.0, scale=1 / sigma[i]).ppf(stats.norm.cdf(z[1])),
            np.array([mu[i], 0.5]) + z[2] @ root.T,
        ]
        parents = {"mu": mu, "sigma": sigma}
        found = normal_scores(inputs)(*[parents[str(p.name)] for p in inputs.parents], *points)
        for got, expected in zip(found, z, strict=True):
            np.testing.assert_allclose(got[i], expected, atol=1e-8)


def test_inputs_without_distribution_functions_have_no_normal_scores() -> None:
    inputs, _ = inputs_of(
        lambda mu, sigma: [pm.MvStudentT.dist(5.0, mu=mu * np.ones(2), scale=COVARIANCE)]
    )
    assert normal_scores(inputs) is None


def test_quantiles_of_a_multivariate_normal_have_its_mean_and_covariance() -> None:
    u = stats.norm.cdf(np.vstack([np.zeros(2), np.eye(2)]))
    dist = pm.MvNormal.dist(np.array([1.0, 2.0]), COVARIANCE)
    center, *ends = quantiles("y", dist, u).eval(mode=PLAIN)
    np.testing.assert_allclose(center, [1.0, 2.0], atol=1e-12)
    root = np.transpose(ends - center)
    np.testing.assert_allclose(root, np.linalg.cholesky(COVARIANCE), rtol=1e-9, atol=1e-9)


def test_priors_are_drawn_together_and_the_seed_decides() -> None:
    with pm.Model() as model:
        center = pm.Normal("center", 5, 1)
        pm.Normal("offset", center, 0.1, shape=2)
    draws = PriorSampler(model.basic_RVs)
    first, again, other = draws(400, 1), draws(400, 1), draws(400, 2)
    assert [v.shape for v in first] == [(400,), (400, 2)]
    for a, b, c in zip(first, again, other, strict=True):
        np.testing.assert_array_equal(a, b)
        assert not np.isin(a, c).any()
    # Drawn given the variable above, from the prior: four standard errors.
    assert abs((first[1] - first[0][:, None]).std() - 0.1) < 4 * 0.1 / np.sqrt(2 * 800)
    assert abs(first[0].mean() - 5) < 4 / 20
    np.testing.assert_array_equal(PriorSampler(model.basic_RVs)(400, 1)[0], first[0])


def test_points_of_a_cube_are_brought_to_the_prior_in_order() -> None:
    with pm.Model() as model:
        center = pm.Normal("center", 5, 2)
        pm.Normal("offset", center, 0.1, shape=2)
    points = PriorPoints(model.basic_RVs)
    assert points.size == 3
    cube = np.array([[0.5, 0.5, 0.5], [stats.norm.cdf(1), 0.5, stats.norm.cdf(-1)]])
    found_center, found_offset = points(cube)
    np.testing.assert_allclose(found_center, [5.0, 7.0])
    np.testing.assert_allclose(found_offset, [[5.0, 5.0], [7.0, 6.9]])
    with pytest.raises(TypeError, match="depends on a random variable which is not in the model"):
        PriorPoints([pm.Normal.dist(center, 1.0)])


def test_parameters_are_valid_where_densities_say_so() -> None:
    inputs, _ = inputs_of(lambda mu, sigma: [pm.Normal.dist(0, mu), pm.Gamma.dist(sigma, 1.0)])
    symbols = inputs.placeholders()
    graph = valid(inputs, inputs.rebuilt(symbols)[0])
    values = {"mu": np.array([1.0, -1.0, 1.0, np.nan]), "sigma": np.array([1.0, 1.0, -1.0, 1.0])}
    (found,) = compile_batched(symbols, [graph])(*(values[str(s.name)] for s in symbols))
    np.testing.assert_array_equal(found, [True, False, False, False])


def test_one_population_has_the_shape_of_many() -> None:
    """SciPy's generators drop leading axes of length one."""
    inputs, model = inputs_of(
        lambda mu, sigma: [
            *(pm.Moyal.dist(mu, sigma), pm.Rice.dist(nu=mu, sigma=sigma)),
            pm.TruncatedNormal.dist(mu, sigma, lower=0.0, shape=2),
        ]
    )
    sampler = PopulationSampler(inputs)
    for k, n in ((1, 1), (3, 1), (1, 7), (3, 7)):
        drawn, _ = sampler([np.full(k, 1.0), np.full(k, 2.0)], n, np.random.default_rng(0))
        assert [x.shape for x in drawn] == [(k, n), (k, n), (k, n, 2)]
        assert (drawn[1] > 0).all()
        assert (drawn[2] > 0).all()
    with model:
        below = pm.Moyal("below", model["mu"], 1.0)
    assert [x.shape for x in PriorSampler([model["mu"], below])(1, 0)] == [(1,)] * 2


def test_a_distribution_that_is_not_vectorised_is_drawn_one_population_at_a_time() -> None:
    def make(mu: Any, sigma: Any) -> list[Any]:
        return [pm.CustomDist.dist(mu, random=drawn_alone), sigma]

    sampler = PopulationSampler(inputs_of(make)[0])
    (x,), (sigma,) = sampler(
        [np.array([0.0, 50.0]), np.array([1.0, 2.0])], 40, np.random.default_rng(0)
    )
    assert x.shape == (2, 40)
    assert np.unique(x).size == 80
    # Five standard errors of a mean of 40.
    np.testing.assert_allclose(x.mean(axis=1), [0.0, 50.0], atol=5 / np.sqrt(40))
    np.testing.assert_array_equal(sigma, [[1.0], [2.0]])


def drawn_alone(mu: Any, rng: Any = None, size: Any = None) -> Any:
    return rng.normal(mu, 1.0, size=size)


def test_a_distribution_without_density_is_refused_and_says_nothing_of_its_parameters() -> None:
    inputs, _ = inputs_of(
        lambda mu, sigma: [pm.CustomDist.dist(mu, random=drawn_alone), pm.Normal.dist(mu, sigma)]
    )
    symbols = inputs.placeholders()
    graph = valid(inputs, inputs.rebuilt(symbols)[0])
    (found,) = compile_batched(symbols, [graph])(np.zeros(2), np.array([1.0, -1.0]))
    assert list(found) == [True, False]
    sum_of_two, _ = inputs_of(
        lambda mu, sigma: [pm.CustomDist.dist(mu, dist=lambda mu, size: mu + pm.Gamma.dist(2, 1))]
    )
    refuse_without_density("y", sum_of_two)
    truncated, _ = inputs_of(
        lambda mu, sigma: [
            pm.Truncated.dist(pm.SkewNormal.dist(mu=mu, sigma=sigma, alpha=1.0), lower=0.0)
        ]
    )
    for without, name in ((inputs, "CustomDist"), (truncated, "Trunc")):
        with pytest.raises(TypeError, match=rf"y: got {name}.*no density, .*logp="):
            refuse_without_density("y", without)


def test_what_cannot_be_drawn_is_refused() -> None:
    inputs, _ = inputs_of(lambda mu, sigma: [pm.Normal.dist(mu, sigma), pm.Flat.dist()])
    sampler = PopulationSampler(inputs)
    with pytest.raises(TypeError, match=r"inputs: got .* flat.* cannot be drawn \(.*expected"):
        sampler([np.zeros(1), np.ones(1)], 3, np.random.default_rng(0))
    sampler = PopulationSampler(inputs_of(lambda mu, sigma: [pm.Normal.dist(mu, sigma)])[0])
    with pytest.raises(TypeError, match=r"\(scale < 0\).*in their range, such as .*HalfNormal"):
        sampler([np.zeros(1), -np.ones(1)], 3, np.random.default_rng(0))


def test_populations_are_drawn_at_their_own_roots() -> None:
    inputs, _ = inputs_of(
        lambda mu, sigma: [
            pm.Normal.dist(mu, 0.1),
            sigma,
            pm.Normal.dist(0, 1),
            pt.constant(4.0) * 1,
        ]
    )
    names = [str(r.name) for r in inputs.parents]
    given = {"mu": np.array([1.0, 5.0, 9.0]), "sigma": np.array([0.1, 0.2, 0.3])}
    sampler = PopulationSampler(inputs)
    params = [given[n] for n in names]
    aleatory, epistemic = sampler(params, 400, np.random.default_rng(1))
    assert [a.shape for a in aleatory] == [(3, 400), (3, 400)]
    np.testing.assert_array_equal(epistemic[0], given["sigma"][:, None])
    # Four standard errors of a mean of 400; and no two specimens are the same.
    np.testing.assert_allclose(aleatory[0].mean(axis=1), given["mu"], atol=4 * 0.1 / 20)
    np.testing.assert_allclose(aleatory[1].mean(axis=1), 0.0, atol=4 / 20)
    assert np.unique(aleatory[1]).size == 1200
    for seed, same in ((1, True), (2, False)):
        again, _ = sampler(params, 400, np.random.default_rng(seed))
        assert np.array_equal(again[0], aleatory[0]) == same


def test_random_walks_have_pymc_s_density_and_no_other() -> None:
    inputs, _ = inputs_of(
        lambda mu, sigma: [
            pm.GaussianRandomWalk.dist(mu, sigma, init_dist=pm.Normal.dist(0, 1), steps=3)
        ]
    )
    refuse_without_density("y", inputs)
    points = np.random.default_rng(1).normal(size=(5, 4))
    mu, sigma = np.array([0.5, -0.3]), np.array([0.7, 1.2])
    steps = np.diff(points, axis=1)
    for row, m, s in zip(
        log_densities(inputs, [points], mu=mu, sigma=sigma), mu, sigma, strict=True
    ):
        expected = stats.norm.logpdf(points[:, 0]) + stats.norm.logpdf(steps, m, s).sum(axis=1)
        np.testing.assert_allclose(row, expected, rtol=1e-10)


def test_ends_of_supports_are_those_that_no_hyperparameter_moves() -> None:
    with pm.Model():
        mu, sigma = pm.Normal("mu", 2, 1), pm.HalfNormal("sigma", 1)
        ends = {
            pm.TruncatedNormal.dist(mu, sigma, lower=0.1, upper=40): (0.1, 40, True),
            pm.TruncatedNormal.dist(mu, sigma, lower=0.1): (0.1, np.inf, True),
            pm.TruncatedNormal.dist(2, sigma, lower=mu, upper=40): (-np.inf, 40, True),
            pm.Truncated.dist(pm.LogNormal.dist(mu, sigma), upper=3.0): (0, 3, False),
            pm.Truncated.dist(pm.LogNormal.dist(mu, sigma), 0.5, 3.0): (0.5, 3, True),
            pm.Truncated.dist(pm.Laplace.dist(mu, sigma), upper=3.0): (-np.inf, 3, True),
            pm.Uniform.dist(0, sigma): (0, np.inf, True),
            pm.Beta.dist(sigma, 2): (0, 1, False),
            pm.Gamma.dist(sigma, 2): (0, np.inf, False),
            pm.Normal.dist(mu, sigma): (-np.inf, np.inf, False),
        }
        for dist, (low, high, is_closed) in ends.items():
            assert fixed_ends(dist) == (low, high, is_closed), dist.owner.op
        of_vector = pm.TruncatedNormal.dist([1.0, 2.0], sigma, lower=np.array([0.0, 1.0]))
        np.testing.assert_array_equal(fixed_ends(of_vector)[0], [0, 1])
