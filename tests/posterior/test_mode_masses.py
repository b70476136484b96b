"""Masses of modes by bridge sampling, where draws have wrong shares of them or lack one."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from prbayes._validate import Floats
from prbayes.numerics.modes import Laplace
from prbayes.posterior.mode_masses import bridge, bridged_modes

MASSES = np.array([0.03, 0.27, 0.7])
CENTERS = np.array([[-4.0, 2.0], [0.0, -4.0], [3.0, 3.0]])
SD = np.array([[0.5, 1.0], [1.0, 0.3], [0.4, 0.4]])


def log_density(thetas: Floats) -> Floats:
    """Return an unnormalised mixture of three normal distributions."""
    terms = [
        m * stats.norm(c, s).pdf(thetas).prod(axis=1)
        for m, c, s in zip(MASSES, CENTERS, SD, strict=True)
    ]
    with np.errstate(divide="ignore"):
        return np.asarray(np.log(np.sum(terms, axis=0)) + 40)


def draws(shares: list[float], size: int = 2000) -> Floats:
    """Return draws of the mixture with other shares."""
    rng = np.random.default_rng(0)
    place = rng.choice(3, size, p=shares)
    return np.asarray(CENTERS[place] + SD[place] * rng.standard_normal((size, 2)))


def laplace_modes() -> list[Laplace]:
    covariances = [np.diag(sd**2) for sd in SD]
    return [Laplace(c, v, 0.0, True) for c, v in zip(CENTERS, covariances, strict=True)]


@pytest.mark.parametrize("shares", [[0.03, 0.27, 0.7], [0.3, 0.3, 0.4], [0.0, 0.1, 0.9]])
def test_modes_have_the_masses_of_the_density(shares: list[float]) -> None:
    modes = bridged_modes(
        log_density, draws(shares), np.ones(2), laplace_modes(), np.random.default_rng(1)
    )
    assert modes is not None
    order = [int(np.abs(modes.places - center).sum(axis=1).argmin()) for center in CENTERS]
    errors = modes.errors[order]
    assert 0.0001 < errors.min() < errors.max() < 0.02
    assert (np.abs(modes.shares[order] - MASSES) < 5 * errors).all()
    distances = np.linalg.norm((modes.draws[:, None] - CENTERS) / SD, axis=2)
    of_draws = np.bincount(distances.argmin(axis=1), minlength=3) / len(modes.draws)
    np.testing.assert_allclose(of_draws, modes.shares[order], atol=0.01)
    for k in range(3):  # the draws within a mode are those of the density
        within = (modes.draws[distances.argmin(axis=1) == k] - CENTERS[k]) / SD[k]
        np.testing.assert_allclose(within.mean(axis=0), 0, atol=5 / np.sqrt(0.5 * len(within)))
        np.testing.assert_allclose(within.std(axis=0), 1, atol=4 / np.sqrt(len(within)))


def test_draws_of_one_mode_are_left_as_they_are() -> None:
    def normal(thetas: Floats) -> Floats:
        return np.asarray(-(thetas**2).sum(axis=1) / 2)

    rng = np.random.default_rng(2)
    mode = Laplace(np.zeros(3), np.eye(3), 0.0, True)
    assert bridged_modes(normal, rng.standard_normal((1000, 3)), np.ones(3), [mode], rng) is None


@pytest.mark.parametrize("loss", [-1000.0, 1000.0])
def test_a_mode_without_mass_loses_its_draws(loss: float) -> None:
    """Ratios of the masses overflow."""

    def two(thetas: Floats) -> Floats:
        at = thetas[:, 0]
        return np.logaddexp(-((at + 60) ** 2) / 2, -((at - 60) ** 2) / 2 - loss)

    noise = np.random.default_rng(2).standard_normal((1000, 1))
    both = np.concatenate([noise[:500] - 60, noise[500:] + 60])
    modes = bridged_modes(two, both, np.ones(1), [], np.random.default_rng(3))
    assert modes is not None
    assert (np.sign(modes.draws) == -np.sign(loss)).all()
    np.testing.assert_allclose(modes.shares.max(), 1.0)


def test_the_variance_of_a_bridge_is_that_of_repeats() -> None:
    """Between a normal and a t distribution, and without draws of the normal distribution."""
    rng = np.random.default_rng(3)
    normal, proposal = stats.norm(), stats.t(5, scale=1.3)
    for size in (400, 0):
        found = []
        for _ in range(300):
            x, y = rng.standard_normal(size), proposal.rvs(400, random_state=rng)
            found.append(bridge(*(normal.logpdf(z) - proposal.logpdf(z) + 2 for z in (x, y))))
        masses, variances = np.transpose(found)
        # Five standard errors of a mean and of a variance of 300 repeats.
        assert abs(masses.mean() - 2) < 5 * masses.std() / np.sqrt(300)
        assert masses.var() == pytest.approx(variances.mean(), rel=5 * np.sqrt(2 / 300))
