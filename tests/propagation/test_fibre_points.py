"""Points of specimens with fewer measured outputs than inputs, against closed forms."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
from scipy.special import logsumexp, ndtr
from scipy.stats import multivariate_normal, ncx2

from prbayes._validate import Floats
from prbayes.metrics.readings import Readings
from prbayes.propagation.base import DesignError
from prbayes.propagation.fibre_points import fibre_points
from prbayes.propagation.specimen_emulation import Emulation, PointOptions
from prbayes.propagation.specimen_points import SpecimenPoints

N = 8


@dataclass(frozen=True)
class NormalDraws:
    """Draws of the means and standard deviations of independent normal inputs."""

    means: Floats  # (S, d)
    sds: Floats  # (S, d)

    @property
    def thetas(self) -> Floats:
        return np.concatenate([self.means, self.sds], axis=1)

    def log_likelihoods(self, z: Floats, log_a: Floats) -> Floats:
        standard = (z - self.means[:, None, None]) / self.sds[:, None, None]
        log_p = -0.5 * (standard**2).sum(axis=-1) - z.shape[-1] / 2 * np.log(2 * np.pi)
        log_p -= np.log(self.sds).sum(axis=1)[:, None, None]
        return np.asarray(logsumexp(log_p + log_a, axis=2))

    def specimens(self) -> Floats:
        rng = np.random.default_rng(0)
        z = self.means + self.sds * rng.standard_normal((64, *self.means.shape))
        return z.reshape(-1, self.means.shape[1])

    def posterior(self, z: Floats, log_a: Floats, smoothing: Floats | None) -> NormalDraws:
        return self


def draws_of(d: int, mean_sd: float = 0.03, sd: float = 0.15, size: int = 16) -> NormalDraws:
    """Return populations around a mean of .1, by default as 30 specimens determine them."""
    rng = np.random.default_rng(d)
    means = 0.1 + mean_sd * rng.standard_normal((size, d))
    return NormalDraws(means, sd * np.exp(0.1 * rng.standard_normal((size, d))))


def specimens_of(draws: NormalDraws, n: int = N) -> Floats:
    """Return inputs of n specimens of the middle population."""
    rng = np.random.default_rng(7)
    mean, sd = draws.means.mean(axis=0), draws.sds.mean(axis=0)
    return np.asarray(mean + sd * rng.standard_normal((n, len(mean))))


def points_of(
    response: Callable[[Floats], Floats], readings: Readings, draws: NormalDraws, **options: Any
) -> tuple[Emulation, SpecimenPoints]:
    d = draws.means.shape[1]
    prior = 0.4 * np.random.default_rng(1).standard_normal((2048, d))
    settings = {"n": 16 * d + 32, "seed": 0} | options
    most = settings.pop("most_points", PointOptions().most_points)
    options_of_points = PointOptions(most_points=most)
    bounds = np.stack([prior.min(axis=0), prior.max(axis=0)])
    return fibre_points(
        response, readings, bounds, prior, draws.posterior, options_of_points, **settings
    )


def linear_response(d: int, m: int) -> tuple[Floats, Callable[[Floats], Floats]]:
    a = np.random.default_rng(10 * d + m).standard_normal((m, d))
    return a, lambda z: z @ a.T


def linear_log_likelihoods(a: Floats, readings: Readings, draws: NormalDraws) -> Floats:
    """Return the exact log-likelihoods of what was measured of each specimen, (S, N)."""
    result = np.zeros((len(draws.means), len(readings)))
    for i, (y, error) in enumerate(zip(readings.values, readings.error, strict=True)):
        some = np.isfinite(y)
        if not some.any():
            continue
        rows, noise = a[some], np.diag(error[some] ** 2)
        for s, (mean, sd) in enumerate(zip(draws.means, draws.sds, strict=True)):
            population = multivariate_normal(rows @ mean, rows * sd**2 @ rows.T + noise)
            result[s, i] = population.logpdf(y[some])
    return result


def errors(points: SpecimenPoints, exact: Floats, draws: NormalDraws) -> Floats:
    return np.asarray(draws.log_likelihoods(points.z, points.log_a) - exact)


# -- closed forms ------------------------------------------------------------------------------------

# Standard errors of log L: largest root mean square error of a specimen and population, six seeds.
LINEAR = {(2, 1): 2.5e-3, (3, 1): 1.7e-2, (3, 2): 3.6e-3, (4, 2): 1.2e-2}
PATTERNS = {(2, 0.0): 6.8e-3, (2, 0.1): 1.1e-2, (3, 0.0): 2.5e-2, (3, 0.1): 3.8e-2}


@pytest.mark.parametrize(("d", "m"), LINEAR)
def test_a_linear_response_of_normal_inputs(d: int, m: int) -> None:
    draws = draws_of(d)
    a, response = linear_response(d, m)
    readings = Readings.exact(response(specimens_of(draws)))
    _, points = points_of(response, readings, draws)
    assert points.z.shape == (N, 256, d)
    assert points.outputs.shape == (N, 256, m)
    assert points.difference <= 0.15
    assert np.abs(points.outputs - readings.values[:, None]).max() < 1e-3
    error = errors(points, linear_log_likelihoods(a, readings, draws), draws)
    assert np.abs(error).max() < 5 * LINEAR[d, m]


SPHERE = {2: 0.023, 3: 0.17}


@pytest.mark.parametrize("d", SPHERE)
def test_the_circle_and_the_sphere(d: int) -> None:
    # |z|^2 / sd^2 of normal inputs with one standard deviation is non-central chi-square.
    draws = draws_of(d)
    draws = replace(draws, sds=np.repeat(draws.sds[:, :1], d, axis=1))
    y = (specimens_of(draws) ** 2).sum(axis=1)
    _, points = points_of(
        lambda z: (z**2).sum(axis=1, keepdims=True), Readings.exact(y[:, None]), draws
    )
    scale = draws.sds[:, :1] ** 2
    center = (draws.means**2).sum(axis=1, keepdims=True) / scale
    error = errors(points, ncx2(d, center, scale=scale).logpdf(y), draws)
    assert np.abs(error).max() < 5 * SPHERE[d]


def patterned(y: Floats) -> Floats:
    """Return readings of two outputs of which one, both or none are missing."""
    y = y.copy()
    y[1::4, 0] = np.nan
    y[2::4, 1] = np.nan
    y[3::4] = np.nan
    return y


@pytest.mark.parametrize(("d", "size"), PATTERNS)
def test_patterns_of_missing_outputs(d: int, size: float) -> None:
    draws = draws_of(d)
    a, response = linear_response(d, 2)
    y = response(specimens_of(draws))
    y += size * np.random.default_rng(3).standard_normal(y.shape)
    readings = replace(Readings.exact(patterned(y)), error=np.full(y.shape, size))
    _, points = points_of(response, readings, draws)
    error = errors(points, linear_log_likelihoods(a, readings, draws), draws)
    assert np.abs(error).max() < 5 * PATTERNS[d, size]


def intervals(draws: NormalDraws, step: float) -> tuple[Floats, Floats, Floats]:
    """Return readings (N, 1), lower ends of their intervals, and log-probabilities, (S, N)."""
    a, response = linear_response(2, 1)
    y = response(specimens_of(draws))
    low = np.round(y / step) * step - step / 2
    mean, sd = draws.means @ a.T, np.sqrt(draws.sds**2 @ a.T**2)
    return y, low, np.log(ndtr((low.T + step - mean) / sd) - ndtr((low.T - mean) / sd))


def test_rounded_readings_have_the_mean_density_of_their_step() -> None:
    draws, step = draws_of(2), 0.2
    y, low, log_probability = intervals(draws, step)
    rounded = replace(Readings.exact(low + step / 2), step=np.full(y.shape, step))
    _, points = points_of(linear_response(2, 1)[1], rounded, draws)
    error = errors(points, log_probability - np.log(step), draws)
    assert np.abs(error).max() < 5 * 0.041


def test_censored_readings_have_the_probability_of_their_interval() -> None:
    draws, step = draws_of(2), 0.2
    y, low, log_probability = intervals(draws, step)
    is_censored = np.arange(N)[:, None] % 2 == 0
    censored = replace(
        Readings.exact(np.where(is_censored, np.nan, y)),
        lower=np.where(is_censored, low, np.nan),
        upper=np.where(is_censored, low + step, np.nan),
    )
    a, response = linear_response(2, 1)
    _, points = points_of(response, censored, draws)
    exact = linear_log_likelihoods(a, censored, draws)
    exact[:, ::2] = log_probability[:, ::2]
    assert np.abs(errors(points, exact, draws)).max() < 5 * 0.074


def test_the_log_proposal_serves_another_error() -> None:
    # As for an error that is a model variable: the density of the readings is added later.
    draws = draws_of(2)
    a, response = linear_response(2, 1)
    y = response(specimens_of(draws))
    readings = replace(Readings.exact(y), error=np.full(y.shape, 0.1))
    emulation, points = points_of(response, readings, draws)
    other = readings.scaled(1.3)
    log_a = other.log_density(points.outputs, emulation.error) - points.log_proposal
    error = draws.log_likelihoods(points.z, log_a) - linear_log_likelihoods(a, other, draws)
    assert np.abs(error).max() < 5 * PATTERNS[2, 0.1]


def test_seeds() -> None:
    draws = draws_of(2)
    _, response = linear_response(2, 1)
    readings = Readings.exact(response(specimens_of(draws)))
    (_, first), (_, same), (_, second) = (
        points_of(response, readings, draws, seed=seed) for seed in (0, 0, 1)
    )
    np.testing.assert_array_equal(first.z, same.z)
    np.testing.assert_array_equal(first.log_a, same.log_a)
    assert not np.array_equal(first.z, second.z)


# -- loops -------------------------------------------------------------------------------------------


def test_points_are_doubled_until_both_halves_agree() -> None:
    # Means along the fibre are not identified, and populations are narrow.
    draws = draws_of(2, mean_sd=0.0, sd=0.02)
    along = np.linspace(-0.4, 0.4, len(draws.means))[:, None] * [[1.0, -1.0]]
    draws = replace(draws, means=draws.means + along)
    a = np.ones((1, 2))
    readings = Readings.exact(specimens_of(draws) @ a.T)
    _, points = points_of(lambda z: z @ a.T, readings, draws)
    assert 256 < points.z.shape[1] < 4096
    assert points.difference <= 0.15
    error = errors(points, linear_log_likelihoods(a, readings, draws), draws).sum(axis=1)
    assert error.std() < 0.15
    with pytest.raises(DesignError, match=r"got two halves of 256 points .*ProbabilityResidual"):
        points_of(lambda z: z @ a.T, readings, draws, most_points=256)


@dataclass(frozen=True)
class PriorSample(NormalDraws):
    """Populations of the prior, from which the posterior is resampled."""

    is_smoothed: list[bool] = field(default_factory=list)

    def posterior(self, z: Floats, log_a: Floats, smoothing: Floats | None) -> NormalDraws:
        self.is_smoothed.append(smoothing is not None)
        d = z.shape[-1]
        total = np.empty(len(self.means))
        for s, (mean, sd) in enumerate(zip(self.means, self.sds, strict=True)):
            covariance = np.diag(sd**2) + (0 if smoothing is None else smoothing)
            root = np.linalg.cholesky(covariance)
            standard = (z - mean) @ np.linalg.inv(root).T
            log_p = -0.5 * (standard**2).sum(axis=-1) - np.log(np.diag(root)).sum()
            total[s] = logsumexp(log_p - d / 2 * np.log(2 * np.pi) + log_a, axis=1).sum()
        weights = np.exp(total - logsumexp(total))
        chosen = np.random.default_rng(0).choice(len(weights), 32, p=weights)
        return NormalDraws(self.means[chosen], self.sds[chosen])


@pytest.mark.long
def test_populations_that_happen_to_lie_near_points_do_not_decide() -> None:
    # The difference of the means is not identified, over eighty widths of a population.
    rng = np.random.default_rng(5)
    prior = PriorSample(0.4 * rng.standard_normal((400, 2)), np.full((400, 2), 0.01))
    prior.means[:, 0] = 0.2 - prior.means[:, 1] + 0.005 * rng.standard_normal(400)
    a = np.ones((1, 2))
    readings = Readings.exact(0.2 + 0.01 * np.sqrt(2) * rng.standard_normal((N, 1)))
    _, points = points_of(lambda z: z @ a.T, readings, prior)
    assert prior.is_smoothed[:2] == [False, True]
    assert prior.is_smoothed[-3:] == [False] * 3
    exact = linear_log_likelihoods(a, readings, prior).sum(axis=1)
    estimate = prior.log_likelihoods(points.z, points.log_a).sum(axis=1)
    mean, sd = moments_of(prior.means[:, 0], exact)
    mean_of_points, sd_of_points = moments_of(prior.means[:, 0], estimate)
    assert sd > 20 * 0.01
    assert mean_of_points == pytest.approx(mean, abs=0.15 * sd)
    assert sd_of_points == pytest.approx(sd, rel=0.15)


def moments_of(values: Floats, log_weights: Floats) -> tuple[float, float]:
    weights = np.exp(log_weights - logsumexp(log_weights))
    mean = weights @ values
    return float(mean), float(np.sqrt(weights @ (values - mean) ** 2))


def test_a_response_with_a_jump_is_refused() -> None:
    draws = draws_of(2)
    readings = Readings.exact(specimens_of(draws).sum(axis=1, keepdims=True))

    def response(z: Floats) -> Floats:
        return np.asarray(z.sum(axis=1, keepdims=True) + np.sign(z[:, :1]))

    with pytest.raises(DesignError, match=r"(?s)got an emulator.*metric=prb.ProbabilityResidual"):
        points_of(response, readings, draws, n=32)


def test_runs_are_made_at_first_and_in_batches_near_the_specimens() -> None:
    draws = draws_of(2)
    _, response = linear_response(2, 1)
    batches: list[Floats] = []

    def recorded(z: Floats) -> Floats:
        batches.append(z)
        return response(z)

    readings = Readings.exact(response(specimens_of(draws)))
    emulation, _ = points_of(recorded, readings, draws, n=64)
    assert [len(z) for z in batches] == [64, 32, 32]
    assert len(emulation.z) == 128
    assert batches[0].std() > 2 * batches[1][:16].std()
