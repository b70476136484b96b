"""Points of specimens: halves that agree, and the log-likelihood of normal populations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
from normal_populations import NormalDraws
from scipy.special import logsumexp, ndtr
from scipy.stats import multivariate_normal

from prbayes._validate import Floats
from prbayes.metrics.readings import Readings, scaled_errors
from prbayes.propagation.base import DesignError
from prbayes.specimens.emulation import DifferencedResponse, Emulation
from prbayes.specimens.points import (
    SpecimenData,
    SpecimenOptions,
    SpecimenPoints,
    joined,
    normal_of,
    reading_change,
    specimen_points,
)

N = 8


def draws_of(d: int, mean_sd: float = 0.03, sd: float = 0.15) -> NormalDraws:
    """Return populations around a mean of .1, by default as 30 specimens determine them."""
    rng = np.random.default_rng(d)
    means = 0.1 + mean_sd * rng.standard_normal((16, d))
    return NormalDraws(means, sd * np.exp(0.1 * rng.standard_normal((16, d))))


def specimens_of(draws: NormalDraws) -> Floats:
    """Return inputs of specimens of the middle population."""
    mean, sd = draws.means.mean(axis=0), draws.sds.mean(axis=0)
    return np.asarray(mean + sd * np.random.default_rng(7).standard_normal((N, len(mean))))


def points_of(
    response: Callable[[Floats], Floats],
    readings: Readings,
    draws: NormalDraws,
    error: float = 1e-5,
    **settings: Any,
) -> SpecimenPoints:
    """Return points of a response that is known up to an error."""
    d = draws.means.shape[1]
    prior = 0.4 * np.random.default_rng(1).standard_normal((2048, d))
    known = np.full((len(readings), d), np.nan)
    data = SpecimenData(readings, known, prior, draws.posterior, **settings)
    y = response(prior)
    surface = DifferencedResponse(response)
    emulation = Emulation(prior, y, surface, np.full(y.shape[1], error), 0.0)
    points, _, _ = specimen_points(data, emulation, normal_of(data.inner))
    return points


def linear_response(d: int, m: int) -> tuple[Floats, Callable[[Floats], Floats]]:
    a = np.random.default_rng(10 * d + m).standard_normal((m, d))
    return a, lambda z: z @ a.T


def exact_log_likelihoods(a: Floats, readings: Readings, draws: NormalDraws) -> Floats:
    """Return the log-likelihoods of the measured outputs of each specimen, (S, N)."""
    result = np.zeros((len(draws.means), len(readings)))
    for i, (y, error) in enumerate(zip(readings.values, readings.error, strict=True)):
        some = np.isfinite(y)
        for s, (mean, sd) in enumerate(zip(draws.means, draws.sds, strict=True)):
            if some.any():
                cov = a[some] * sd**2 @ a[some].T + np.diag(error[some] ** 2)
                result[s, i] = multivariate_normal(a[some] @ mean, cov).logpdf(y[some])
    return result


def errors(points: SpecimenPoints, exact: Floats, draws: NormalDraws) -> Floats:
    return np.asarray(draws.log_likelihoods(points.z, points.log_a) - exact)


def with_error(y: Floats, size: float) -> Readings:
    y = y + size * np.random.default_rng(3).standard_normal(y.shape)
    return replace(Readings.exact(y), error=np.full(y.shape, size))


@pytest.mark.parametrize(("d", "m"), [(1, 1), (2, 1), (2, 3), (3, 2)])
@pytest.mark.parametrize("size", [0.0, 0.1])
def test_a_linear_response(d: int, m: int, size: float) -> None:
    draws = draws_of(d)
    a, response = linear_response(d, m)
    readings = with_error(response(specimens_of(draws)), size)
    points = points_of(response, readings, draws)
    if m <= d or size:
        exact = exact_log_likelihoods(a, readings, draws)
    else:  # a density beside the plane of outputs: that of the emulator's error
        exact = exact_log_likelihoods(a, replace(readings, error=np.full((N, m), 1e-5)), draws)
    # One point suffices where exact readings determine the inputs.
    assert points.is_exact == (size == 0 and m >= d)
    assert points.is_exact == (points.z.shape[1] == 1)
    error = errors(points, exact, draws)
    # Standard deviation over populations, the unit of the limit on the difference of the halves
    assert points.difference <= 0.2
    assert error.sum(axis=1).std() <= 0.2
    assert abs(error.mean()) < 5 * 0.02  # of eight specimens with 16 points each


def test_patterns_of_missing_outputs() -> None:
    draws = draws_of(2)
    a, response = linear_response(2, 2)
    readings = with_error(response(specimens_of(draws)), 0.1)
    y = readings.values.copy()
    y[1::4, 0] = np.nan
    y[2::4, 1] = np.nan
    y[3::4] = np.nan
    readings = replace(readings, values=y)
    points = points_of(response, readings, draws)
    exact = exact_log_likelihoods(a, readings, draws)
    assert np.abs(errors(points, exact, draws)).max() < 5 * 0.01


def test_rounded_and_censored_readings_have_the_probability_of_their_interval() -> None:
    draws, step = draws_of(2), 0.2
    a, response = linear_response(2, 1)
    y = response(specimens_of(draws))
    low = np.round(y / step) * step - step / 2
    mean, sd = draws.means @ a.T, np.sqrt(draws.sds**2 @ a.T**2)
    exact = np.log(ndtr((low.T + step - mean) / sd) - ndtr((low.T - mean) / sd))
    is_censored = np.arange(N)[:, None] % 2 == 0
    readings = replace(
        Readings.exact(np.where(is_censored, np.nan, low + step / 2)),
        step=np.full(y.shape, step),
        lower=np.where(is_censored, low, np.nan),
        upper=np.where(is_censored, low + step, np.nan),
    )
    exact[:, 1::2] -= np.log(step)  # the mean density of the step
    error = errors(points_of(response, readings, draws), exact, draws)
    assert error.sum(axis=1).std() <= 0.2
    assert np.abs(error).max() < 5 * 0.05


def test_the_log_proposal_serves_another_error() -> None:
    # As for an error that is a model variable: the density of the readings is added later.
    draws = draws_of(2)
    a, response = linear_response(2, 3)
    readings = with_error(response(specimens_of(draws)), 0.1)
    points = points_of(response, readings, draws, scales=np.array([[1.6], [1.0], [0.6]]))
    for scale in (0.6, 1.0, 1.6):
        other = scaled_errors(readings, scale)
        log_a = other.log_density(points.outputs, np.full(3, 1e-5)) - points.log_proposal
        error = draws.log_likelihoods(points.z, log_a) - exact_log_likelihoods(a, other, draws)
        assert error.sum(axis=1).std() <= 0.2
        assert abs(error.mean()) < 5 * 0.02


def test_a_later_emulator_changes_the_density_of_the_readings() -> None:
    draws = draws_of(1)
    _, response = linear_response(1, 1)
    readings = with_error(response(specimens_of(draws)), 0.1)
    prior = 0.4 * np.random.default_rng(1).standard_normal((2048, 1))
    data = SpecimenData(readings, np.full((N, 1), np.nan), prior, draws.posterior)
    before, after = (
        Emulation(prior, f(prior), DifferencedResponse(f), np.full(1, 1e-5), 0.0)
        for f in (response, lambda z: response(z) + 0.05)
    )
    points, _, _ = specimen_points(data, before, normal_of(data.inner))
    first, second = ((readings.values - points.outputs[..., 0] - k) / 0.1 for k in (0.0, 0.05))
    change = reading_change(data, points, before, after)
    np.testing.assert_allclose(change, (first**2 - second**2) / 2, atol=1e-5)
    assert not reading_change(data, points, before, before).any()


def test_points_are_doubled_until_both_halves_agree() -> None:
    # Means along the open direction are not identified, and populations are narrow.
    draws = draws_of(2, mean_sd=0.0, sd=0.01)
    along = np.linspace(-0.4, 0.4, len(draws.means))[:, None] * [[1.0, -1.0]]
    draws = replace(draws, means=draws.means + along)
    a = np.ones((1, 2))
    readings = Readings.exact(specimens_of(draws) @ a.T)
    points = points_of(lambda z: z @ a.T, readings, draws)
    assert 256 < points.z.shape[1] < 4096
    assert points.difference <= 0.2
    error = errors(points, exact_log_likelihoods(a, readings, draws), draws).sum(axis=1)
    assert error.std() < 0.2
    few = SpecimenOptions(most_points=128, most_in_all=128)
    with pytest.raises(DesignError, match=r"got two halves of .* points .*narrow the priors"):
        points_of(lambda z: z @ a.T, readings, draws, options=few)


def test_joined_halves_have_the_mean_of_their_likelihoods() -> None:
    draws = draws_of(2)
    _, response = linear_response(2, 1)
    readings = with_error(response(specimens_of(draws)), 0.1)
    points = points_of(response, readings, draws)
    first = points.rows(np.arange(N)[::2])
    second = replace(first, z=first.z + 0.1)
    both = joined(first, second)
    logs = [draws.log_likelihoods(p.z, p.log_a) for p in (first, second, both)]
    np.testing.assert_allclose(logs[2], np.logaddexp(*logs[:2]) - np.log(2))


@dataclass(frozen=True)
class PriorSample(NormalDraws):
    """Populations of the prior, from which the posterior is resampled."""

    is_smoothed: list[bool] = field(default_factory=list)

    def posterior(
        self, z: Floats, log_a: Floats, smoothing: Floats | None, **_: Any
    ) -> NormalDraws:
        self.is_smoothed.append(smoothing is not None)
        total = np.empty(len(self.means))
        for s, (mean, sd) in enumerate(zip(self.means, self.sds, strict=True)):
            covariance = np.diag(sd**2) + (0 if smoothing is None else smoothing)
            log_p = multivariate_normal(mean, covariance).logpdf(z)
            total[s] = logsumexp(log_p + log_a, axis=1).sum()
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
    points = points_of(lambda z: z @ a.T, readings, prior)
    assert prior.is_smoothed[:2] == [False, True]
    exact = exact_log_likelihoods(a, readings, prior).sum(axis=1)
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
