"""Mirror solutions, and what is said about them."""

import logging
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import numpy as np
import pymc as pm
import pytest
from four_metrics import METRICS, R256, same
from one_input import one_input

import prbayes as prb
from prbayes._validate import Floats
from prbayes.inference.asymptotics import Local
from prbayes.model.evaluator import Evaluator, shortcomings
from prbayes.numerics.batched_minimisers import descend
from prbayes.optimize.local_optima import Reference, optima_from_prior
from prbayes.optimize.objective import Ridge

DATA = (np.random.default_rng(3).normal(2.0, 0.3, 40) - 1) ** 2
OBSERVED = np.random.default_rng(1).normal(1.0, 0.5, 50)


def parabola(x: Any) -> Any:
    return x**2 - 2 * x + 1


def mirrored(metric: prb.Metric, propagation: Any = R256) -> pm.Model:
    """Symmetric about mu = 1, the prior too: the data do not separate the sides."""
    return one_input(DATA, metric, propagation, parabola, mu=(1, 1.5))


@cache
def fit(name: str) -> prb.Optimum:
    return prb.minimize(mirrored(METRICS[name]))


# -- mirror solutions --------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["pr", "area"])
def test_both_optima_are_found(name: str) -> None:
    optimum = fit(name)
    comparable = [r for r in optimum.local_optima if r["comparable"]]
    assert len(comparable) == 1
    (other,) = comparable
    # The design is not quite symmetric: a tenth of a standard error.
    assert abs(optimum.point["mu"] + other["point"]["mu"] - 2) < optimum.stderr["mu"]
    assert abs(abs(optimum.point["mu"] - 1) - 1) < 4 * optimum.stderr["mu"]
    assert abs(np.log(optimum.point["sigma"] / other["point"]["sigma"])) < 0.1
    np.testing.assert_allclose(other["discrepancy"], optimum.discrepancy, rtol=0.05)
    evaluator = Evaluator.of(optimum.model)
    assert evaluator(other["theta"][None]).discrepancies[0, 0] == pytest.approx(
        other["discrepancy"]
    )
    (finding,) = optimum.findings
    assert "Another optimum fits about as well, mu = " in finding.text
    assert f"{other['point']['mu']:.3f}"[:4] in finding.text


def test_local_optima_are_minima_and_findings_are_logged(caplog: pytest.LogCaptureFixture) -> None:
    optimum = fit("pr")
    evaluator = Evaluator.of(optimum.model)
    for theta in (optimum.theta, *(r["theta"] for r in optimum.local_optima if r["comparable"])):
        around = theta + 0.05 * np.vstack([np.eye(2), -np.eye(2)])
        assert (evaluator(around).discrepancies > evaluator(theta[None]).discrepancies).all()
    values = [r["discrepancy"] for r in optimum.local_optima]
    assert values == sorted(values)
    with caplog.at_level(logging.WARNING, logger="prbayes"):
        again = prb.minimize(mirrored(METRICS["pr"]))
    assert [r.message for r in caplog.records] == list(map(str, again.findings))
    assert len(again.findings) == 1


def test_starts() -> None:
    none = prb.minimize(mirrored(METRICS["pr"]), starts=0)
    assert none.local_optima == none.findings == ()
    np.testing.assert_allclose(none.theta, fit("pr").theta)
    # Each theta costs responses: looked for only if asked.
    propagation = prb.Resimulated(128)
    assert prb.minimize(mirrored(METRICS["pr"], propagation=propagation)).local_optima == ()
    asked = prb.minimize(mirrored(METRICS["pr"], propagation=propagation), starts=8)
    assert any(r["comparable"] for r in asked.local_optima)
    assert asked.n_responses > 8 * 128


def test_a_prior_that_excludes_one_leaves_one() -> None:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.LogNormal("excess", 0, 0.5) + 1, pm.HalfNormal("sigma", 1))
        prb.Simulator("y", parabola, x, metric=METRICS["pr"], observed=DATA, propagation=R256)
    optimum = prb.minimize(model)
    assert not [r for r in optimum.local_optima if r["comparable"]]
    assert optimum.findings == ()
    assert abs(optimum.point["excess"] - 1) < 4 * optimum.stderr["excess"]


def test_a_worse_optimum_is_left_for_the_better_one() -> None:
    # Right where x > 0, and three times too wide a population where x < 0.
    wrong = lambda x: np.where(x > 0, x, 4 - 3 * (x + 2))  # noqa: E731
    data = np.random.default_rng(5).normal(4.0, 0.3, 60)
    rough = one_input(
        data, METRICS["ll"], response=wrong, propagation=prb.Reweighted(2048), mu=(0, 3), sd=0.3
    )
    stuck = prb.minimize(rough, start={"mu": -2.0}, starts=0)
    assert abs(stuck.point["mu"] + 2) < 0.2
    found = prb.minimize(rough, start={"mu": -2.0})
    assert abs(found.point["mu"] - 4) < 0.2
    assert found.discrepancy < stuck.discrepancy - 0.1
    # What was the first one is now among the others, and said to be worse.
    (other,) = found.local_optima
    assert abs(other["point"]["mu"] + 2) < 0.2
    assert not other["comparable"]
    assert found.findings == ()


def test_a_linear_problem_has_no_other_optimum() -> None:
    optimum = prb.minimize(one_input(3 * OBSERVED + 1, METRICS["kl"], R256, lambda x: 3 * x + 1))
    assert optimum.local_optima == optimum.findings == ()


# -- the posterior of two modes ----------------------------------------------------------------------


@pytest.mark.long
def test_each_mode_has_the_width_of_its_estimate() -> None:
    optimum = fit("pr")
    given: dict[str, Any] = {"chains": 2, "random_seed": 1, "progressbar": False}
    idata = prb.sample_smc(500, optimum=optimum, model=optimum.model, **given)
    mu = idata.posterior["mu"].values.ravel()
    assert 0.3 < (mu > 1).mean() < 0.7
    for side in (mu > 1, mu < 1):
        # The sd of each mode is that of the estimator, not of the distance between modes; linear
        # theory is 15% off.
        np.testing.assert_allclose(mu[side].std(), optimum.stderr["mu"], rtol=0.25)
        assert abs(abs(mu[side].mean() - 1) - 1) < 4 * optimum.stderr["mu"]


# -- unidentified directions -------------------------------------------------------------------------


@pytest.mark.parametrize("response", [same, parabola])
def test_unidentified_directions_are_named_and_make_no_optima(response: Any) -> None:
    observed = OBSERVED if response is same else DATA
    with one_input(observed, METRICS["pr"], R256, response, mu=(1, 1.5), sd=0.5) as model:
        pm.Normal("idle", 3, 2)
    optimum = prb.minimize(model)
    comparable = [r for r in optimum.local_optima if r["comparable"]]
    assert len(comparable) == (response is parabola)
    for mode in comparable:
        assert mode["point"]["idle"] == pytest.approx(optimum.point["idle"], abs=1e-6)
    assert np.isinf(optimum.stderr["idle"])
    (text,) = [str(f) for f in optimum.findings if f.code == "not-identified"]
    assert "about idle (" in text
    assert text.endswith('; see prb.help("not-identified").')


@pytest.mark.long
def test_one_output_of_many_excludes_a_mirror() -> None:
    """Two outputs are the same for either sign; what one tells is not lost in their noise."""
    inputs = np.random.default_rng(0).normal(1.0, 0.4, 30)

    def sees_the_sign(x: Any) -> Any:
        return np.abs(x) + 0.25 * x

    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1))
        for k, response in enumerate([np.square] * 2 + [sees_the_sign]):
            prb.Simulator(
                f"y{k}", response, x, metric=prb.AreaMetric(), observed=response(inputs),
                propagation=prb.Reweighted(128),
            )  # fmt: skip
    optimum = prb.minimize(model)
    assert optimum.local_optima
    assert not any(other["comparable"] for other in optimum.local_optima)
    assert "second-mode" not in {f.code for f in optimum.findings}


# -- optima of designs whose points follow the search ------------------------------------------------


def has_supported_mirror(optimum: prb.Optimum) -> bool:
    """Return whether both optima about mu = 1 are found, and the design supports them."""
    (other,) = [r for r in optimum.local_optima if r["comparable"]]
    assert optimum.point["mu"] + other["point"]["mu"] == pytest.approx(2, abs=0.1)
    return not any(
        shortcomings(optimum.evaluator, t[None]) for t in (optimum.theta, other["theta"])
    )


def test_a_mirror_far_from_the_runs_gets_runs() -> None:
    data = (np.random.default_rng(3).normal(11.0, 0.3, 40) - 1) ** 2
    optimum = prb.minimize(one_input(data, METRICS["pr"], R256, parabola, mu=(1, 10)), starts=8)
    assert optimum.n_responses > 2 * 256
    assert has_supported_mirror(optimum)


@pytest.mark.long
def test_a_mirror_far_from_an_emulated_sample_gets_a_sample() -> None:
    def two_outputs(x: Any, y: Any) -> Any:
        return np.stack([(x - 1) ** 2 + 0.2 * y, y], axis=-1)  # symmetric about x = 1

    rng = np.random.default_rng(3)
    data = two_outputs(rng.normal(2.0, 0.05, 25), rng.normal(0.0, 0.2, 25))
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1, 4), pm.HalfNormal("sigma", 2))
        y = pm.Normal.dist(pm.Normal("nu", 0, 3), 0.2)
        metric = prb.Joint(prb.ProbabilityResidual())
        few = prb.Reweighted(128)
        prb.Simulator("y", two_outputs, x, y, metric=metric, observed=data, propagation=few)
    optimum = prb.minimize(model, starts=8)
    assert optimum.n_responses == 128
    assert has_supported_mirror(optimum)


# -- landscapes in closed form -----------------------------------------------------------------------


@dataclass(frozen=True)
class Landscape:
    """A discrepancy that is a formula, with the attributes of an evaluator."""

    formula: Any

    @property
    def hyperparameters(self) -> Any:
        return self

    def total(self, thetas: Floats, scales: Floats) -> Floats:
        return np.asarray(self.formula(*thetas.T))

    def prior_points(self, n: int, seed: int) -> Floats:
        return np.random.default_rng(seed).normal(size=(n, 2))


def reference(
    formula: Any, theta: Any, covariance: Any, noise: float, prior_sd: Any = (2.0, 0.5)
) -> Reference:
    """Return a reference whose parameters may have other units than the formula."""
    evaluator: Any = Landscape(formula)
    standardised = np.asarray(covariance) / np.outer(prior_sd, prior_sd)
    local = Local(np.array(prior_sd), np.eye(2), np.zeros((2, 0)), standardised)
    return Reference(evaluator, np.array(theta), np.ones(1), local, noise)


def two_hollows(x: Floats, y: Floats) -> Floats:
    """Minima of 0.04 at about (1, 1), and of 0 at about (-1, 1); 1.02 between them."""
    return np.asarray((x**2 - 1) ** 2 + (y - 1) ** 2 + 0.02 * (1 + x))


@pytest.mark.parametrize(
    ("side", "noise", "comparable", "better"),
    [
        (1.0, 0.1, True, True),
        (1.0, 0.9, True, False),
        (-1.0, 0.012, False, False),
        (-1.0, 0.015, True, False),
    ],
)
def test_what_a_barrier_separates_is_judged_by_the_noise(
    side: float, noise: float, comparable: bool, better: bool
) -> None:
    best = reference(two_hollows, [side, 1.0], 0.01 * np.eye(2), noise)
    lowest = float(best(best.theta[None])[0])
    ends = np.array([[-side, 1.0], [-0.9 * side, 1.1], [0.9 * side, 0.9], [-side, 1.0]])
    values = best(ends)
    values[3] = np.nan
    (other,) = best.separated(ends, values, lowest)
    assert (other.theta.tolist(), other.value) == ([-side, 1.0], values[0])
    assert (other.comparable, other.better) == (comparable, better)
    # The barrier is .98 higher than the worse of both.
    assert replace(best, noise=0.97).separated(ends, values, lowest)
    assert replace(best, noise=0.99).separated(ends, values, lowest) == []


def test_the_other_hollow_is_found_from_points_of_the_prior() -> None:
    best = reference(two_hollows, [1.0, 1.0], 0.01 * np.eye(2), 0.1)
    (other,) = optima_from_prior(best, 16, 0)
    np.testing.assert_allclose(other.theta, [-1.0025, 1.0], atol=0.01)
    assert other.value == pytest.approx(two_hollows(*other.theta))
    # A candidate is a start as well; alone, its point of the prior ends at the reference.
    for candidates in ([], [np.array([-0.5, 0.5])]):
        assert len(optima_from_prior(best, 1, 0, candidates)) == len(candidates)
    # Neither a barrier below the noise nor a penalty that pulls to the reference separates them.
    assert optima_from_prior(replace(best, noise=1.5), 16, 0) == []
    ridge = Ridge(best.theta, np.eye(2), 1e3)
    assert optima_from_prior(replace(best, ridge=ridge), 16, 0) == []


def valley(x: Floats, y: Floats) -> Floats:
    """A bent valley with one minimum, at (1, 1)."""
    return np.asarray((1 - x) ** 2 + 100 * (y - x**2) ** 2)


@pytest.mark.parametrize("iterations", [10, 40])
def test_where_a_descent_was_stopped_in_a_valley_is_no_optimum(
    iterations: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    covariance = 0.01 * np.linalg.inv([[802.0, -400.0], [-400.0, 200.0]])
    best = reference(valley, [1.0, 1.0], covariance, 0.01, (1.0, 1.0))
    short = partial(descend, max_iterations=iterations)
    monkeypatch.setattr("prbayes.optimize.local_optima.descend", short)
    assert optima_from_prior(best, 16, 0) == []


@pytest.mark.long
def test_a_poor_fit_of_responses_that_are_simulated_again_is_left(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # Responses cost next to nothing, also where the machine is busy.
    monkeypatch.setattr("time.perf_counter", lambda: 0.0)
    observed = np.random.default_rng(1).multivariate_normal([0, 0], [[1, 0.999], [0.999, 1]], 60)
    with pm.Model() as model:
        rho, s = pm.Uniform("rho", -1, 1), pm.HalfNormal("s", 2)
        x = pm.MvNormal.dist(np.zeros(2), s**2 * pm.math.stack([[1.0, rho], [rho, 1.0]]))
        metric = prb.Joint(prb.KullbackLeibler())
        settings = {"metric": metric, "observed": observed, "propagation": prb.Resimulated(256)}
        prb.Simulator("y", lambda x: x, x, **settings)
    optimum = prb.minimize(model, progressbar=False)
    assert optimum.point["rho"] == pytest.approx(np.corrcoef(observed.T)[0, 1], abs=0.001)
    # From the first start alone: rho -0.91, where no bound is stated of a poor fit.
    local = prb.minimize(model, starts=0, progressbar=False)
    assert local.discrepancy > 5 * optimum.discrepancy
    assert "one-sided-bound" not in [finding.code for finding in local.findings]
