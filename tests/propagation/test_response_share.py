"""Shares of populations with a response, against the normal distribution function."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.stats import norm

from prbayes._validate import Floats
from prbayes.metrics.readings import Readings
from prbayes.numerics.points import sobol
from prbayes.propagation.base import DesignError
from prbayes.propagation.response_share import ResponseShare, boundary_points, response_share
from prbayes.propagation.specimen_emulation import Emulation, PointOptions

LIMIT = 0.15
OPTIONS = PointOptions()


def half_space(z: Floats) -> Floats:
    """Return the first coordinate, without a response above a limit of the mean coordinate."""
    return np.where(z.mean(axis=1, keepdims=True) > LIMIT, np.nan, z[:, :1])


def emulation_of(run: object, d: int, n: int = 64) -> Emulation:
    box = np.stack([-np.ones(d), np.ones(d)])
    y = Readings.exact(np.linspace(-0.3, 0.1, 20)[:, None])
    return Emulation.first(run, 2 * sobol(n, d, 0) - 1, box, y, OPTIONS, "y")  # type: ignore[arg-type]


@dataclass(frozen=True)
class Populations:
    """Normal populations with independent elements, and 20 specimens."""

    means: Floats  # (S, d)
    sds: Floats  # (S,)
    n: int = 20

    def log_share(self, share: ResponseShare) -> Floats:
        log_p = norm.logpdf(share.z, self.means[:, None], self.sds[:, None, None]).sum(axis=-1)
        return self.n * share.log_share(log_p)

    def specimens(self) -> Floats:
        u = np.random.default_rng(1).standard_normal((64, *self.means.shape))
        return (self.means + self.sds[:, None] * u).reshape(-1, self.means.shape[1])

    def exact(self) -> Floats:
        d = self.means.shape[1]
        away = (LIMIT - self.means.mean(axis=1)) / (self.sds / np.sqrt(d))
        return self.n * norm.logcdf(away)


def plausible(d: int, center: float) -> Populations:
    rng = np.random.default_rng(2)
    means = center + 0.05 * rng.standard_normal((64, d))
    return Populations(means, 0.2 * np.exp(0.15 * rng.standard_normal(64)))


def prior_specimens(d: int) -> Floats:
    return 0.5 * np.random.default_rng(3).standard_normal((1000, d))


@pytest.mark.parametrize("d", [1, 2])
def test_the_share_is_the_distribution_function(d: int) -> None:
    populations = plausible(d, 0.0)
    emulation = emulation_of(half_space, d)
    refined, share = response_share(
        half_space, emulation, lambda: prior_specimens(d), lambda _: populations, OPTIONS
    )
    assert share is not None
    error = populations.log_share(share) - populations.exact()
    # In nats over plausible populations: the posterior mean moves by as many standard deviations.
    assert np.std(error) <= 0.1
    assert np.std(populations.exact()) > 1  # what is left out without the term
    assert len(refined.z) > len(emulation.z)


def test_a_region_far_away_is_left_out() -> None:
    emulation = emulation_of(half_space, 1)
    far = plausible(1, LIMIT - 1.5)
    left, share = response_share(
        half_space, emulation, lambda: prior_specimens(1), lambda _: far, OPTIONS
    )
    assert share is None
    assert left is emulation


def test_failed_specimens_are_no_missing_response() -> None:
    def failing(z: Floats) -> Floats:
        return np.where(np.isnan(half_space(z)), np.inf, z)

    emulation = emulation_of(failing, 1)
    assert emulation.fails(np.array([[0.9]])).all()
    _, share = response_share(
        failing, emulation, lambda: prior_specimens(1), lambda _: plausible(1, 0.0), OPTIONS
    )
    assert share is None


def test_runs_at_the_boundary_are_between_runs_with_and_without_response() -> None:
    emulation = emulation_of(half_space, 1)
    is_missing = np.isnan(emulation.y[:, 0])
    low, high = emulation.z[~is_missing].max(), emulation.z[is_missing].min()
    specimens = np.linspace(-1, 1, 1001)[:, None]
    points = boundary_points(emulation, specimens, 8)
    assert len(points) == 8
    assert ((points > low) & (points < high)).all()
    assert len(np.unique(points)) == 8


def test_a_boundary_that_is_not_found_is_refused() -> None:
    rng = np.random.default_rng(0)

    def random(z: Floats) -> Floats:
        return np.where(rng.random(z.shape) < 0.5, np.nan, z)

    with pytest.raises(DesignError, match="boundary still changes"):
        response_share(
            random,
            emulation_of(random, 1),
            lambda: prior_specimens(1),
            lambda _: plausible(1, 0.0),
            OPTIONS,
            batches=2,
        )


def test_populations_without_a_point_have_no_share() -> None:
    share = ResponseShare(np.zeros((2, 1)), np.zeros(2), 1)
    nothing = np.array([-np.inf, -np.inf])
    assert share.log_share(nothing) == 0.0
    assert share.log_share(np.array([0.0, -np.inf])) == 0.0
    assert share.log_share(np.array([0.0, 0.0])) == pytest.approx(np.log(0.5))
    assert share.log_share(np.array([-np.inf, 0.0])) == 0.0
