"""The matrix form of log-densities against PyMC's own."""

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest

from prbayes.propagation.exponential_families import ExponentialForm
from prbayes.response.compile import PLAIN, compile_batched

COVARIANCE = np.array([[1.0, 0.3], [0.3, 0.5]])
# Constructor with two parameters, and ranges of these.
FAMILIES = {
    "normal": (pm.Normal.dist, (-1, 1), (0.5, 2)),
    "half-normal": (lambda _, s: pm.HalfNormal.dist(s), (0, 1), (0.5, 2)),
    "truncated": (lambda m, s: pm.TruncatedNormal.dist(m, s, lower=-2), (-1, 1), (0.5, 2)),
    "lognormal": (pm.LogNormal.dist, (-1, 1), (0.5, 1)),
    "gamma": (lambda a, b: pm.Gamma.dist(alpha=a, beta=b), (1, 4), (0.5, 2)),
    "inverse gamma": (lambda a, b: pm.InverseGamma.dist(alpha=a, beta=b), (3, 5), (0.5, 2)),
    "beta": (lambda a, b: pm.Beta.dist(a, b), (1, 4), (1, 4)),
    "exponential": (lambda _, b: pm.Exponential.dist(b), (0, 1), (0.5, 2)),
    "vector": (lambda m, s: pm.Normal.dist(pt.stack([m, -m]), s), (-1, 1), (0.5, 2)),
    "correlated": (
        lambda m, s: pm.MvNormal.dist(pt.stack([m, 0.0]), s * COVARIANCE),
        (-1, 1),
        (0.5, 2),
    ),
}


@pytest.mark.parametrize("name", FAMILIES)
def test_the_matrix_form_equals_the_density(name):
    dist, *ranges = FAMILIES[name]
    rng = np.random.default_rng(0)
    parameters = rng.uniform(*np.transpose(ranges), size=(5, 2))
    middle = dist(*np.mean(ranges, axis=1))
    points = pm.draw(middle, 200, random_seed=1, mode=PLAIN)
    symbols = pt.dscalars("first", "second")
    given = pt.tensor(dtype="float64", shape=(None,) * points.ndim)
    logp = pm.logp(dist(*symbols), given, warn_rvs=False)
    log_density = compile_batched(
        symbols, [logp.reshape((given.shape[0], -1)).sum(axis=1)], [given]
    )

    form = ExponentialForm.of([middle], [points])

    assert form is not None
    (at_anchors,) = log_density(*parameters.T, *form.anchors)
    (expected,) = log_density(*parameters.T, points)
    natural = form.natural_parameters(at_anchors)
    np.testing.assert_allclose(natural @ form.statistics, expected, atol=1e-11)


@pytest.mark.parametrize(
    "dist",
    [
        pm.StudentT.dist(nu=3, mu=0, sigma=1),
        pm.Uniform.dist(0, 1),
        pm.TruncatedNormal.dist(0, 1, lower=pm.Normal.dist()),
        pm.Poisson.dist(3),
    ],
)
def test_other_distributions_have_no_such_form(dist):
    assert ExponentialForm.of([dist], [np.linspace(0.1, 0.9, 50)]) is None


def test_points_that_coincide_have_no_such_form():
    assert ExponentialForm.of([pm.Normal.dist(0, 1)], [np.repeat([0.0, 1.0], 20)]) is None


def test_points_outside_of_a_support_take_no_part():
    """Those below zero, or above the end of a truncated distribution."""
    points = np.linspace(0.1, 2.0, 40)
    for dist in (pm.HalfNormal.dist(1), pm.Gamma.dist(2, 1), pm.Exponential.dist(1)):
        beside = ExponentialForm.of([dist], [np.concatenate([points, [-1.0, np.nan]])])
        alone = ExponentialForm.of([dist], [points])
        assert beside.is_inside.tolist() == [True] * 40 + [False] * 2
        np.testing.assert_array_equal(beside.statistics[:, :40], alone.statistics)
    truncated = ExponentialForm.of([pm.TruncatedNormal.dist(0, 1, upper=1)], [points])
    assert truncated.is_inside.tolist() == (points <= 1).tolist()


@pytest.mark.parametrize("values", [-np.ones(40), np.full(40, np.nan)])
def test_points_that_are_all_outside_have_no_such_form(values):
    assert ExponentialForm.of([pm.InverseGamma.dist(3, 1)], [values]) is None
