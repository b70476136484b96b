"""Points that specimens share: closed forms, narrow populations, findings about the emulator."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import pytest
from scipy import stats

from prbayes.emulators.scatter import Region, Scatter, fit_scatter
from prbayes.metrics.readings import Readings
from prbayes.propagation.base import DesignError
from prbayes.specimens.points import SpecimenData
from prbayes.specimens.shared_points import (
    Noise,
    RandomResponse,
    RandomRuns,
    draw_shares,
    scatter_findings,
)

NOISE = Noise(np.zeros(1), np.ones(1))
SLOPE, SPREAD = 2.0, 0.5


def linear(reach: float) -> Scatter:
    """Return y = 2 x + .5 e, e standard normal, on (-reach, reach)."""
    region = Region(np.zeros(1), np.array([[reach]]))
    mean, spread = np.array([[0.0], [SLOPE * reach]]), np.array([[np.log(SPREAD)]])
    ends = np.tile(spread, (2, 1))
    unit = np.ones((1, 1))
    return Scatter(region, mean, spread, (1, 0), ends, 0 * unit, np.ones(1), unit, 1.0)


def response_of(y: np.ndarray, error: float = 0.0, run: Any = None) -> RandomResponse:
    readings = Readings.exact(y)
    readings.error[:] = error
    known, prior = np.full((len(y), 2), np.nan), np.random.default_rng(0).normal(size=(500, 2))
    data = SpecimenData(readings, known, prior, cast(Any, None), output_names=("y",), name="y")
    return RandomResponse(run, data, 2, NOISE)


def log_likelihoods(response: RandomResponse, scatter: Scatter, mu: float, s: float) -> Any:
    """Return log-likelihoods of specimens of N(mu, s), from points in one and in two halves."""
    points = response.points([scatter], scatter.region, response.cube(256))
    x, e = points.z[..., 0], points.z[..., 1]
    log_p = stats.norm.logpdf(x, mu, s) + stats.norm.logpdf(e)
    return np.logaddexp.reduce(log_p + points.log_a, axis=1)


@pytest.mark.parametrize("error", [0.0, 0.7])
def test_log_likelihood_of_a_linear_response_is_exact(error: float) -> None:
    y = np.array([[-1.0], [0.3], [2.2]])
    for mu, s in ((0.0, 1.0), (0.4, 0.3), (-0.5, 0.1)):
        logs = log_likelihoods(response_of(y, error), linear(6.0), mu, s)
        sd = np.sqrt((SLOPE * s) ** 2 + SPREAD**2 + error**2)
        np.testing.assert_allclose(logs, stats.norm.logpdf(y[:, 0], SLOPE * mu, sd), atol=2e-4)


def test_noise_of_the_points_gives_the_readings() -> None:
    y = np.array([[-0.2], [0.9]])
    response, scatter = response_of(y), linear(3.0)
    points = response.points([scatter], scatter.region, response.cube(64))
    is_inside = np.abs(points.z[..., 1]) < 3.99
    away = np.where(is_inside, points.outputs[..., 0] - y, 0.0)
    np.testing.assert_allclose(away, 0.0, atol=5e-3)
    assert is_inside.any(axis=1).all()


def test_missing_repeats_and_failures_are_refused() -> None:
    response = response_of(np.zeros((4, 1)), run=lambda z: z[:, :1])
    with pytest.raises(DesignError, match="same response in all repeated runs"):
        response.first_runs(16)
    broken = response_of(np.zeros((4, 1)), run=lambda z: np.where(z[:, :1] > 0, z[:, 1:], np.nan))
    with pytest.raises(DesignError, match="without a finite response"):
        broken.first_runs(16)


def test_runs_are_repeated_at_inputs_with_numbers_of_their_own() -> None:
    response = response_of(np.zeros((4, 1)), run=lambda z: z[:, 1:])
    first = response.first_runs(16)
    more = response.runs_in(Region(np.zeros(1), np.eye(1)), 8, 3, len(first.z))
    runs = first.joined(more)
    assert len(runs.z) == 48
    assert len(np.unique(runs.z, axis=0)) == 48
    x = runs.z[:, 0]
    np.testing.assert_array_equal(x[::2], x[1::2])
    np.testing.assert_array_equal(runs.places, np.repeat(np.arange(24), 2))
    assert np.abs(runs.inside(Region(np.zeros(1), np.eye(1))).z[:, 0]).max() <= 1


def findings_of(noise: Any, mean: Any = lambda x: x) -> list[str]:
    """Return texts of findings about a linear fit to 100 runs."""
    rng = np.random.default_rng(4)
    x = np.repeat(np.linspace(-1, 1, 100), 2)[:, None]
    y = mean(x) + 0.2 * noise(rng, x)
    runs = RandomRuns(np.column_stack([x, rng.normal(size=200)]), y, np.repeat(np.arange(100), 2))
    scatter = fit_scatter(Region(np.zeros(1), np.eye(1)), x, y, runs.places, (1, 1))
    return [f.text for f in scatter_findings(response_of(np.zeros((4, 1))), scatter, runs)]


def test_findings_about_detail_and_shape() -> None:
    normal = lambda rng, x: rng.standard_normal(x.shape)  # noqa: E731
    assert findings_of(normal) == []
    assert "more detail" in findings_of(normal, lambda x: np.sin(6 * x))[0]
    sign = lambda rng, x: np.where(x > 0, normal(rng, x), np.sign(normal(rng, x)))  # noqa: E731
    (shape,) = findings_of(sign)
    assert "another distribution" in shape


class FixedDraws:
    """Draws at which log-likelihoods are sums of A."""

    thetas = np.array([[0.0], [1.0]] * 4)

    def log_likelihoods(self, z: np.ndarray, log_a: np.ndarray) -> np.ndarray:
        return np.array([log_a[:, 0], log_a[:, 1]])


def test_shares_of_emulators_follow_their_likelihoods() -> None:
    response, scatter = response_of(np.zeros((3, 1))), linear(3.0)
    points = response.points([scatter] * 3, scatter.region, response.cube(2))
    assert points.tilts is not None
    np.testing.assert_allclose(points.tilts, 0.0)
    points.tilts[:, 0, 0] = np.log(3) / 3
    shares, _ = draw_shares(cast(Any, FixedDraws()), points)
    np.testing.assert_allclose(shares[0], [0.75, 0.25], rtol=1e-9)
    np.testing.assert_allclose(shares[1], [0.5, 0.5], rtol=1e-9)
