"""Shares of populations with a response, against the normal distribution function."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pymc as pm
import pytest
from scipy.stats import norm

from prbayes._validate import Floats
from prbayes.metrics.readings import Readings
from prbayes.numerics.points import sobol
from prbayes.propagation.base import DesignError
from prbayes.propagation.population_density import PopulationDensity
from prbayes.response.inputs import read_inputs
from prbayes.specimens.coordinates import Coordinates
from prbayes.specimens.emulation import Emulation, fit_surface
from prbayes.specimens.points import SpecimenData
from prbayes.specimens.response_share import ResponseShare, boundary_points, response_share

LIMIT = 0.15


def half_space(z: Floats) -> Floats:
    """Return the first coordinate, without a response above a limit of the mean coordinate."""
    return np.where(z.mean(axis=1, keepdims=True) > LIMIT, np.nan, z[:, :1])


READINGS = Readings.exact(np.linspace(-0.3, 0.1, 20)[:, None])


def emulation_of(run: Callable[[Floats], Floats], d: int) -> Emulation:
    z = 2 * sobol(64, d, 0) - 1
    y = run(z)
    surface, *_ = fit_surface(z, y, READINGS, "y")
    return Emulation(z, y, surface, np.array([1e-6]), 0.0)


def log_share(share: ResponseShare, dist: Callable[..., Any], *parents: Floats) -> Floats:
    """Return log S of populations of one input with the given parents, in coordinates z."""
    d = share.z.shape[1]
    with pm.Model() as model:
        symbols = [pm.Flat(f"p{i}", shape=x.shape[1:]) for i, x in enumerate(parents)]
        inputs = read_inputs("y", [dist(*symbols, shape=d)], model)
    ends = np.stack([np.full(d, -np.inf), np.full(d, np.inf)])
    none = np.zeros(d, dtype=bool)
    identity = Coordinates(((d,),), none, np.zeros(d), np.ones(d), ends, np.inf * ends, none)
    values = [parents[symbols.index(parent)] for parent in inputs.parents]
    return share.of_populations(PopulationDensity(inputs), values, identity)


@dataclass(frozen=True)
class Populations:
    """Normal populations with independent elements, and 20 specimens."""

    means: Floats  # (S, d)
    sds: Floats  # (S,)
    n: int = 20

    def log_share(self, share: ResponseShare) -> Floats:
        return self.n * log_share(share, pm.Normal.dist, self.means, self.sds)

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


def shared(
    run: Callable[[Floats], Floats], populations: Populations, d: int, batches: int = 6
) -> Any:
    """Return the emulation before and after, and the share."""
    emulation = emulation_of(run, d)
    z = 0.5 * np.random.default_rng(3).standard_normal((1000, d))  # specimens of the prior
    data = SpecimenData(READINGS, np.full((20, d), np.nan), z, posterior=lambda *_: populations)
    after, share = response_share(run, data, emulation, lambda *_: populations, batches=batches)
    return emulation, after, share


@pytest.mark.parametrize("d", [1, 2])
def test_the_share_is_the_distribution_function(d: int) -> None:
    populations = plausible(d, 0.0)
    before, after, share = shared(half_space, populations, d)
    error = populations.log_share(share) - populations.exact()
    # In nats over plausible populations: the posterior mean moves by as many standard deviations.
    assert np.std(error) <= 0.1
    assert np.std(populations.exact()) > 1  # without the term
    assert len(after.z) > len(before.z)
    assert len(share.z) == 8192  # as both first halves agree


def test_a_region_far_away_and_failed_specimens_have_no_share() -> None:
    before, after, share = shared(half_space, plausible(1, LIMIT - 1.5), 1)
    assert share is None
    assert after is before

    def failing(z: Floats) -> Floats:
        return np.where(np.isnan(half_space(z)), np.inf, z)

    before, _, share = shared(failing, plausible(1, 0.0), 1)
    assert before.fails(np.array([[0.9]])).all()
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


def test_a_boundary_that_is_random_is_refused() -> None:
    rng = np.random.default_rng(0)

    def random(z: Floats) -> Floats:
        return np.where(rng.random(z.shape) < 0.5, np.nan, z)

    with pytest.raises(DesignError, match="boundary still changes"):
        shared(random, plausible(1, 0.0), 1, batches=2)


@pytest.mark.parametrize(
    ("inside", "outside", "expected"),
    [(1.0, 1.0, np.log(0.5)), (1.0, -1.0, 0.0), (-1.0, 1.0, 0.0), (-1.0, -1.0, 0.0)],
)
def test_a_share_of_two_points(inside: float, outside: float, expected: float) -> None:
    """Points below zero have no density; populations without a point with a response, no share."""
    share = ResponseShare(np.array([[inside], [outside]]), np.zeros(2), 1)
    assert log_share(share, pm.HalfNormal.dist, np.ones(1)) == pytest.approx(expected)
