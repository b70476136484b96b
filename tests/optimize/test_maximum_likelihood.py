"""The optimum of models whose observed variables are log-likelihoods by specimen."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np
import pymc as pm
import pytest
import xarray as xr
from one_input import one_input
from scipy import stats

import prbayes as prb
from prbayes._finding import Finding, report
from prbayes._validate import Floats
from prbayes.model.parameters import Hyperparameters
from prbayes.model.specimen_likelihood import monte_carlo_error
from prbayes.optimize.maximum_likelihood import (
    Mode,
    _Objective,
    _signed_root,
    _supported,
    _too_small_errors,
    mode_weights,
    share_mode,
)

N = 25
X = np.random.default_rng(3).normal(0.8, 0.5, N)


def line(x: Any) -> Any:
    return 3 * np.asarray(x) - 1


def normal_model(sd: float | None = None, prior_sd: float = 2.0) -> pm.Model:
    return one_input(line(X), response=line, mu=(0, prior_sd), sd=sd)


def fit(model: pm.Model, **given: Any) -> prb.Optimum:
    return prb.minimize(model, progressbar=False, **given)


@pytest.fixture
def codes(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return the codes of findings, as they are reported."""
    reported: list[str] = []

    def recorded(*findings: Finding) -> tuple[Finding, ...]:
        reported.extend(finding.code for finding in findings)
        return report(*findings)

    monkeypatch.setattr("prbayes.optimize.maximum_likelihood.report", recorded)
    return reported


@cache
def normal_optimum() -> prb.Optimum:
    return fit(normal_model())


def test_the_optimum_of_a_normal_population() -> None:
    optimum = normal_optimum()
    assert optimum.converged
    assert optimum.findings == ()
    assert optimum.point["mu"] == pytest.approx(X.mean(), abs=1e-3)
    assert optimum.point["sigma"] == pytest.approx(X.std(), abs=1e-3)


def test_standard_errors_are_those_of_the_fisher_information() -> None:
    optimum = normal_optimum()
    assert optimum.stderr["mu"] == pytest.approx(X.std() / np.sqrt(N), abs=1e-3)
    # In unconstrained space, that of log sigma: mean and logarithm of sd are independent.
    assert np.allclose(optimum.covariance, np.diag([X.var() / N, 1 / (2 * N)]), atol=1e-4)
    # Of the outputs: three times as wide as the inputs. The mass of each root is right to .01.
    exact = N * (np.log(3 * X.std() * np.sqrt(2 * np.pi)) + 0.5)
    assert optimum.discrepancy == pytest.approx(exact, abs=0.1)
    assert optimum.discrepancies == pytest.approx({"y": optimum.discrepancy})
    assert optimum.local_optima == ()


def test_the_mode_with_the_prior() -> None:
    sd, prior_sd = 0.7, 0.2
    precision = N / sd**2 + 1 / prior_sd**2
    optimum = fit(normal_model(sd, prior_sd), prior=True)
    assert optimum.search.prior
    assert optimum.point["mu"] == pytest.approx(X.sum() / sd**2 / precision, abs=1e-4)
    assert optimum.stderr["mu"] == pytest.approx(precision**-0.5, abs=1e-4)


@cache
def folded_model() -> pm.Model:
    return one_input(X**2, response=np.square, mu=(0, 1), sigma=0.5)


def test_a_folded_response_has_two_modes_and_a_start_selects_one(codes: list[str]) -> None:
    model = folded_model()
    optimum = fit(model)
    assert codes == ["second-mode"]
    assert "of the posterior's mass" in optimum.findings[0].text
    (mirror,) = optimum.local_optima
    assert mirror["point"]["mu"] == pytest.approx(-optimum.point["mu"], abs=1e-3)
    assert mirror["point"]["sigma"] == pytest.approx(optimum.point["sigma"], abs=1e-3)
    # The roots of each specimen are weighted by masses that are right to .01.
    assert mirror["weight"] == pytest.approx(0.5, abs=0.02)
    assert mirror["comparable"]
    codes.clear()
    for sign in (-1, 1):
        optimum = fit(model, start={"mu": 0.7 * sign, "sigma": 0.4})
        assert np.sign(optimum.point["mu"]) == sign
        assert optimum.local_optima == ()
    # Of folded normal data, a mean near zero with a larger spread is nearly as likely.
    assert codes == ["flat-likelihood"] * 2


@pytest.mark.parametrize("mean", [-0.3, 0.3])
def test_of_mirror_populations_the_optimum_is_the_one_of_the_prior(mean: float) -> None:
    optimum = fit(one_input(X**2, response=np.square, mu=(mean, 1), sigma=0.5))
    assert np.sign(optimum.point["mu"]) == np.sign(mean)
    assert optimum.local_optima[0]["weight"] < 0.5


def quartic(theta: Floats) -> tuple[float, Floats]:
    """Return (|theta|^2 - 1)^2: a circle of minima, in one dimension two minima at distance 2."""
    away = float(theta @ theta) - 1
    return 20 * away**2, 80 * away * theta


@pytest.mark.parametrize("angle", [0.5, 2.0, np.pi])
def test_optima_on_a_curved_ridge_are_one_mode(angle: float) -> None:
    unit = np.array([1.0, 1.0])
    first, second = (
        Mode(np.array([np.cos(a), np.sin(a)]), 0.0, np.eye(2), True) for a in (0.0, angle)
    )
    assert share_mode(quartic, unit, first, second, 0.01)
    assert share_mode(quartic, unit, second, first, 0.01)


@pytest.mark.parametrize(("height", "expected"), [(0.9, True), (1.1, False)])
def test_a_barrier_divides_modes(height: float, expected: bool) -> None:
    def double_well(theta: Floats) -> tuple[float, Floats]:
        # The barrier at theta[0] = 0; another direction in other units.
        value, slope = quartic(theta[:1])
        scaled = theta[1] / 1e6 - 3 * theta[0]
        gradient = [slope[0] * height / 20 - 6 * scaled, 2 * scaled / 1e6]
        return height / 20 * value + scaled**2, np.array(gradient)

    first, second = (Mode(np.array([s, 3e6 * s]), 0.0, np.eye(2), True) for s in (-1.0, 1.0))
    assert share_mode(double_well, np.array([1.0, 1e6]), first, second, 1.0) == expected


@pytest.mark.parametrize(("error", "expected"), [(0.15, True), (0.05, False)])
def test_ripples_within_the_error_of_the_likelihood_are_no_barrier(
    error: float, expected: bool
) -> None:
    def ridge(theta: Floats) -> tuple[float, Floats]:
        phase = 6 * np.pi * theta[1]
        value = 20 * theta[0] ** 2 + 0.05 * (1 - np.cos(phase))
        return value, np.array([40 * theta[0], 0.3 * np.pi * np.sin(phase)])

    first, second = (Mode(np.array([0.0, at]), 0.0, np.eye(2), True) for at in (0.0, 1.0))
    assert share_mode(ridge, np.ones(2), first, second, error) == expected


def mode(value: float, variance: Any) -> Mode:
    covariance = np.diag(np.atleast_1d(np.asarray(variance, dtype=float)))
    return Mode(np.zeros(len(covariance)), value, covariance, True)


def test_weights_of_modes_are_those_of_laplace() -> None:
    # exp(-value) times the square root of the covariance's determinant
    weights = mode_weights([mode(3.0, [1.0, 4.0]), mode(3.0 + np.log(2), [4.0, 16.0])])
    assert np.allclose(weights, [1 / 3, 2 / 3])
    assert mode_weights([mode(1e4, 1.0)]).tolist() == [1.0]
    assert mode_weights([mode(0.0, 1.0), mode(1e3, 1.0)]).tolist() == [1.0, 0.0]


def test_hyperparameters_that_are_not_identified(codes: list[str]) -> None:
    with pm.Model() as model:
        first, second = pm.Normal("first", 0, 1), pm.Normal("second", 0, 1)
        sigma = pm.HalfNormal("sigma", 1)
        prb.Simulator("y", line, pm.Normal.dist(first + second, sigma), observed=line(X))
    optimum = fit(model)
    assert codes == ["not-identified"]
    assert "do not identify first, second" in optimum.findings[0].text
    assert optimum.stderr["first"] == optimum.stderr["second"] == np.inf
    assert optimum.stderr["sigma"] == pytest.approx(X.std() / np.sqrt(2 * N), abs=2e-3)
    total = optimum.point["first"] + optimum.point["second"]
    assert total == pytest.approx(X.mean(), abs=1e-3)
    assert optimum.converged


@pytest.mark.parametrize(
    ("prior", "limit", "expected"),
    [(pm.Normal, 1.2, True), (pm.Normal, 2.2, False), (pm.HalfNormal, 1.2, False)],
    ids=["mean", "nearly normal", "spread towards zero"],
)
def test_a_profile_beside_the_standard_error(prior: Any, limit: float, expected: bool) -> None:
    # Curvature four at the optimum. Below it the root of the likelihood ratio grows to a limit.
    class Objective:
        unit = np.ones(1)

        def __call__(self, theta: Any) -> tuple[float, Any]:
            (value,) = 2 * theta**2
            if theta[0] < 0:
                value = limit**2 / 2 * -np.expm1(-value / (limit**2 / 2))
            return float(value), np.zeros(1)

    with pm.Model() as model:
        prior("mu", sigma=1)
    objective: Any = Objective()
    # The spread would be exp(-4 / 2), which is 1.7 standard errors in its own unit.
    best = Mode(np.zeros(1), 0.0, np.eye(1) / 4, True)
    errors = _too_small_errors(Hyperparameters.of(model), objective, best)
    assert errors.tolist() == [expected]


def test_an_end_of_a_support_at_the_largest_specimen(codes: list[str]) -> None:
    x = np.random.default_rng(0).uniform(0, 2, N)
    with pm.Model() as model:
        end = pm.HalfNormal("end", 3)
        prb.Simulator("y", lambda x: np.exp(x / 2), pm.Uniform.dist(0, end), observed=np.exp(x / 2))
    optimum = fit(model)
    assert codes == ["support-edge"]
    assert optimum.point["end"] == pytest.approx(x.max(), abs=1e-3)
    assert np.isnan(optimum.covariance).all()
    assert np.isnan(optimum.stderr["end"])
    assert not optimum.converged


def test_the_number_of_evaluations_is_limited() -> None:
    most = 20
    optimum = fit(normal_optimum().model, max_evaluations=most)
    # A descent has ten evaluations at least, the Hessian up to twelve of them, and each of four
    # profiles of the likelihood up to ten.
    assert optimum.search.n_evaluations <= most + 80
    # The trace is that of the best descent.
    assert len(optimum.search.trace["theta"]) <= optimum.search.n_evaluations


@pytest.mark.long
def test_hyperparameters_that_only_the_prior_links_to_the_data_are_not_reported() -> None:
    who = np.repeat(["a", "b", "c"], 10)
    data = xr.DataArray(
        np.random.default_rng(2).normal(1.0, 0.5, 30), {"lab": ("specimen", who)}, "specimen"
    )
    with pm.Model(coords={"lab": ["a", "b", "c"]}) as model:
        m, tau = pm.Normal("m", 1, 1), pm.HalfNormal("tau", 0.5)
        mu = pm.Normal("mu", m, tau, dims="lab")
        pm.Normal("next", m, tau)
        pm.Normal("idle", 0, 1)
        x = pm.Normal.dist(mu[prb.response.group("lab")], 0.5)
        prb.Simulator("y", lambda x: x, x, observed=data)
    (finding,) = fit(model).findings
    assert finding.code == "not-identified"
    assert "do not identify idle;" in finding.text


SPREADS = np.random.default_rng(2).normal(1.0, 0.2, 30), np.random.default_rng(3).normal(2, 0.2, 30)


def growing(a: Any, b: Any) -> Any:
    return a * np.exp(0.5 * b)


@cache
def two_spreads() -> pm.Model:
    """Return a model of one output, which identifies the spread of two inputs together."""
    with pm.Model() as model:
        a = pm.Normal.dist(pm.Normal("m1", 1, 0.5), pm.HalfNormal("s1", 0.5))
        b = pm.Normal.dist(pm.Normal("m2", 2, 0.5), pm.HalfNormal("s2", 0.5))
        prb.Simulator("y", growing, a, b, observed=growing(*SPREADS))
    return model


def exact_log_likelihood(point: Mapping[str, Any]) -> float:
    """Return the log-likelihood by quadrature over the second input."""
    m1, s1, m2, s2 = (float(point[name]) for name in ("m1", "s1", "m2", "s2"))
    b = np.linspace(m2 - 8 * s2, m2 + 8 * s2, 20001)
    growth = np.exp(0.5 * b)
    a = growing(*SPREADS)[:, None] / growth
    density = stats.norm.pdf(a, m1, s1) / growth * stats.norm.pdf(b, m2, s2)
    return float(np.log(np.trapezoid(density, b, axis=1)).sum())


@pytest.mark.long
def test_a_population_between_the_points_is_no_optimum() -> None:
    """Populations of a spread near zero have spurious maxima, several nats high."""
    optimum = fit(two_spreads())
    assert optimum.converged
    exact = exact_log_likelihood(optimum.point)
    assert exact > exact_log_likelihood({"m1": 1.0, "s1": 0.2, "m2": 2.0, "s2": 0.2})
    (likelihood,) = optimum.evaluator.likelihoods
    at_optimum = {name: np.atleast_1d(value) for name, value in optimum.point.items()}
    (error,) = monte_carlo_error(likelihood, at_optimum)
    # On a flat ridge, three standard deviations of the prior away: an optimum is known to half a nat.
    assert error < 0.5
    assert -optimum.discrepancy == pytest.approx(exact, abs=0.5)
    points = {"m1": 1.0, "s1": [0.0005, 0.2], "m2": 2.0, "s2": 0.3}
    values = {name: np.broadcast_to(value, 2) for name, value in points.items()}
    narrow, wide = monte_carlo_error(likelihood, values)
    assert narrow > 1
    assert wide < 0.2
    values["s1"] = np.array([1e-80, 0.2])  # the square of the difference overflows: no warning
    assert monte_carlo_error(likelihood, values).tolist() == [np.inf, pytest.approx(wide)]


def test_a_likelihood_that_overflows_is_no_warning() -> None:
    objective = _Objective(normal_optimum().evaluator, prior=False)
    for log_sd in np.linspace(-360, -350, 101):
        value, gradient = objective(np.array([0.0, log_sd]))
        assert value > 1e300
        assert np.isfinite(gradient).all()


def test_an_optimum_whose_likelihood_is_not_known_has_not_converged(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(
        "prbayes.optimize.maximum_likelihood._supported",
        lambda values, *_: np.zeros(len(values), bool),
    )
    for model in (normal_optimum().model, folded_model()):  # one mode, and two
        optimum = fit(model)
        assert not optimum.converged
        assert optimum.findings[0].code == "narrow-population"


@pytest.mark.parametrize(
    ("values", "errors", "n_specimens", "supported"),
    [
        ([31.0, 30.4, 31.2], [0.0, 0.5, 0.2], 30, [True, False, True]),  # better by its error alone
        ([31.0, 29.9], [0.0, 0.5], 30, [True, True]),
        ([31.0, 25.0], [0.0, 1.0], 30, [True, False]),  # not known
        ([31.0, 25.0], [0.0, 1.0], 100, [True, True]),
        ([31.0, 25.0], [1.0, 1.0], 30, [False, False]),
    ],
)
def test_an_optimum_that_is_best_by_the_error_of_its_points_is_spurious(
    values: list[float], errors: list[float], n_specimens: int, supported: list[bool]
) -> None:
    got = _supported(np.array(values), np.array(errors), n_specimens)
    assert got.tolist() == supported


def test_the_signed_root_is_that_of_the_normal_likelihood_ratio() -> None:
    """Profiles over the other element: N log(1 + (mu - m)^2 / s^2), N (log r - 1 + 1 / r)."""
    optimum = normal_optimum()
    mode = Mode(optimum.theta, optimum.discrepancy, optimum.covariance, converged=True)
    objective = _Objective(optimum.evaluator, prior=False)
    names = optimum.evaluator.hyperparameters.names
    m, s = X.mean(), X.std()
    for name, value, exact in (
        *(("mu", mu, N * np.log1p((mu - m) ** 2 / s**2)) for mu in (m - 0.3, m + 0.5)),
        *(
            ("sigma_log__", np.log(r) / 2 + np.log(s), N * (np.log(r) - 1 + 1 / r))
            for r in (0.36, 2.9)
        ),
    ):
        i, theta = names.index(name), optimum.theta.copy()
        theta[i] = value
        assert _signed_root(objective, mode, theta, i) == pytest.approx(exact**0.5, rel=1e-3)
    i = names.index("mu")
    assert _signed_root(objective, mode, optimum.theta, i) == pytest.approx(0, abs=1e-3)


def test_a_likelihood_with_kinks_has_standard_errors() -> None:
    """That of a Laplace population is linear between the specimens."""
    observed = np.random.default_rng(2).laplace(1.5, 0.8, 60)
    with pm.Model() as model:
        x = pm.Laplace.dist(pm.Normal("a", 1, 2), pm.HalfNormal("b", 2))
        prb.Simulator("y", lambda x: x, x, observed=observed)
    optimum = prb.minimize(model, progressbar=False)
    assert not optimum.findings
    scale = np.abs(observed - np.median(observed)).mean()
    assert optimum.point["b"] == pytest.approx(scale, rel=1e-3)
    # The asymptotic one is that of many specimens.
    assert 0.6 < optimum.stderr["a"] / (scale / np.sqrt(60)) < 1.6
    assert optimum.stderr["b"] == pytest.approx(scale / np.sqrt(60), rel=0.02)
