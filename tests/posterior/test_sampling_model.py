"""The model of an estimate's distribution, against distributions that are known."""

import numpy as np
import pytest
from scipy import stats

from prbayes._checks import Floats
from prbayes.posterior.sampling_model import SamplingModel, Sight

WIDE = Sight(np.full(2, -1e9), np.full(2, 1e9))
AT = np.random.default_rng(8).uniform(-1, 1, (40, 2))


def truth(points: Floats, rng: np.random.Generator | None) -> tuple[Floats, Floats, Floats]:
    """Mean and sd of two elements, and estimates drawn from them; the second follows the first."""
    a, b = points.T
    mean = np.column_stack([a + 0.1 + 0.2 * a * b, b - 0.3 + 0.1 * a**2])
    sd = np.exp(np.column_stack([-1 + 0.3 * b, -0.5 - 0.2 * a]))
    noise = np.zeros_like(sd) if rng is None else rng.standard_normal(sd.shape)
    first = sd[:, 0] * noise[:, 0]
    return mean, sd, mean + np.column_stack([first, 0.7 * first + sd[:, 1] * noise[:, 1]])


def drawn(n: int, seed: int) -> tuple[Floats, Floats]:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-2, 2, (n, 2))
    return points, truth(points, rng)[2]


def exact(points: Floats, estimate: Floats) -> Floats:
    mean, sd, _ = truth(points, None)
    first = estimate[0] - mean[:, 0]
    second = estimate[1] - mean[:, 1] - 0.7 * first
    return np.asarray(
        stats.norm.logpdf(first, 0, sd[:, 0]) + stats.norm.logpdf(second, 0, sd[:, 1])
    )


def test_the_density_of_an_estimate_is_found() -> None:
    points, estimates = drawn(20_000, 1)
    model = SamplingModel.fit([points], estimates, np.ones(len(points)), WIDE)
    estimate = np.array([0.2, -0.4])
    np.testing.assert_allclose(model.log_likelihood([AT], estimate), exact(AT, estimate), atol=0.12)


def test_points_elsewhere_count_by_their_weights() -> None:
    points, estimates = drawn(8000, 2)
    weights = np.where(np.arange(8000) < 4000, 1.0, 0.0)
    spoiled = estimates + np.where(weights[:, None] > 0, 0.0, 5.0)
    model = SamplingModel.fit([points], spoiled, weights, WIDE)
    half = SamplingModel.fit([points[:4000]], estimates[:4000], weights[:4000], WIDE)
    estimate = np.array([0.0, 0.3])
    np.testing.assert_allclose(
        model.log_likelihood([AT], estimate), half.log_likelihood([AT], estimate), atol=5e-3
    )


def test_what_is_out_of_sight_counts_as_that() -> None:
    # All but a window is hidden, and a third of the estimates ran away: the density in the window
    # is the same, as long as it is normal.
    points, estimates = drawn(20_000, 3)
    sight = Sight(np.array([-0.6, -1.5]), np.array([1.0, 1.0]))
    ran = np.where(estimates < sight.low, -1e6, estimates)
    model = SamplingModel.fit([points], ran, np.ones(len(points)), sight)
    estimate = np.array([0.2, -0.4])
    found = model.log_likelihood([AT], estimate)
    expected = exact(AT, estimate)
    assert np.abs(found - expected).mean() < 0.15
    # An estimate that ran away itself is a probability.
    away = model.log_likelihood([AT], np.array([-1e6, -0.4]))
    mean, sd, _ = truth(AT, None)
    below = stats.norm.logcdf(-0.6, mean[:, 0], sd[:, 0])
    assert np.corrcoef(away, below)[0, 1] > 0.8


def test_coordinates_are_chosen_by_what_is_likely() -> None:
    # The estimate follows the exponential of the hyperparameter, as that of a scale near zero.
    rng = np.random.default_rng(4)
    logarithm = rng.uniform(-4, 1, (4000, 1))
    value = np.exp(logarithm)
    estimates = value + 0.3 * rng.standard_normal((4000, 1))
    sight = Sight(np.array([-9.0]), np.array([9.0]))
    model = SamplingModel.fit([logarithm, value], estimates, np.ones(4000), sight)
    at = np.array([[-6.0], [-4.0]])
    low = model.log_likelihood([at, np.exp(at)], np.array([0.1]))
    # Far down nothing changes any more.
    np.testing.assert_allclose(low[0], low[1], atol=0.02)
    np.testing.assert_allclose(low, stats.norm.logpdf(0.1, 0, 0.3), atol=0.1)


def test_a_parabola_does_not_bend_back_far_out() -> None:
    rng = np.random.default_rng(5)
    points = rng.standard_normal((4000, 1))
    estimates = points - 0.15 * points**2 + 0.2 * rng.standard_normal((4000, 1))
    sight = Sight(np.array([-99.0]), np.array([99.0]))
    model = SamplingModel.fit([points], estimates, np.ones(4000), sight)
    at = np.linspace(0.5, 9, 30)[:, None]
    known = model.log_likelihood([at], np.array([0.4]))
    assert (np.diff(known[2:]) < 0).all()


def test_a_spread_does_not_grow_on_far_out() -> None:
    rng = np.random.default_rng(6)
    points = rng.standard_normal((4000, 1))
    estimates = points + 0.3 * np.exp(0.4 * points) * rng.standard_normal((4000, 1))
    sight = Sight(np.array([-99.0]), np.array([99.0]))
    model = SamplingModel.fit([points], estimates, np.ones(4000), sight)
    strain = model.strain([np.linspace(3, 9, 7)[:, None]], np.array([0.0]))
    np.testing.assert_allclose(np.diff(strain), np.diff(strain)[0], rtol=1e-6)
    assert np.diff(strain)[0] == pytest.approx(1 / (0.3 * np.exp(0.4 * 2)), rel=0.15)


def test_a_wider_estimate_is_likelier_far_out_and_strain_says_how_far() -> None:
    points, estimates = drawn(4000, 7)
    model = SamplingModel.fit([points], estimates, np.ones(4000), WIDE)
    far = np.array([4.0, -0.4])
    assert (model.log_likelihood([AT], far, 0.5) > model.log_likelihood([AT], far)).all()
    strain = model.strain([AT], far)
    mean, sd, _ = truth(AT, None)
    np.testing.assert_allclose(strain, (4.0 - mean[:, 0]) / sd[:, 0], rtol=0.15)


def test_one_like_another_is_about_the_same() -> None:
    points, estimates = drawn(4000, 9)
    weights = np.ones(4000)
    model = SamplingModel.fit([points], estimates, weights, WIDE)
    again = SamplingModel.fit([points], estimates, weights, WIDE, like=model)
    estimate = np.array([0.1, 0.1])
    np.testing.assert_allclose(
        model.log_likelihood([AT], estimate), again.log_likelihood([AT], estimate), atol=0.02
    )
