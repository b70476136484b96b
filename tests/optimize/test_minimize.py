"""`minimize` against closed forms and brute force: optima, starts, supports, errors, storage."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pymc as pm
import pytest
import xarray as xr
from first_use import first_use
from four_metrics import METRICS, R256, same
from scipy import optimize
from scipy.integrate import cumulative_trapezoid, trapezoid
from scipy.stats import binom, norm

import prbayes as prb
from prbayes._validate import Floats
from prbayes.inference.refits import SamplingDistribution
from prbayes.model.evaluator import Evaluator, compiled_objective
from prbayes.model.parameters import unconstrained
from prbayes.model.random_variable import nodes
from prbayes.optimize import minimize as minimization
from prbayes.optimize.convergence import Fit, Result, Search
from prbayes.optimize.design_refinement import Restart
from prbayes.optimize.minimize import optimum_findings
from prbayes.optimize.objective import Minimisation, Ridge, initial_scales
from prbayes.propagation.importance import SIZES

OBSERVED = np.random.default_rng(1).normal(1.0, 0.5, 50)
N, MEAN, SD = OBSERVED.size, float(OBSERVED.mean()), float(OBSERVED.std())
# Largest error of 256 reweighted responses, in standard errors of the data: kinks cost the area
# metric some.
DESIGN_ERROR = {"kl": 0.03, "ll": 0.03, "pr": 0.03, "area": 0.08}


def normal_model(
    name: str | prb.Metric,
    propagation: Any = R256,
    response: Callable[..., Any] = same,
    observed: Floats = OBSERVED,
    mu: Callable[[], Any] = lambda: pm.Normal("mu", 0, 2),
    sigma: Callable[[], Any] = lambda: pm.HalfNormal("sigma", 1),
) -> pm.Model:
    metric = METRICS[name] if isinstance(name, str) else name
    with pm.Model() as model:
        keywords = {"metric": metric, "observed": observed, "propagation": propagation}
        prb.Simulator("y", response, pm.Normal.dist(mu(), sigma()), **keywords)
    return model


def node(model: pm.Model) -> Any:
    return next(iter(nodes(model).values()))


@cache
def fitted(name: str) -> prb.Optimum:
    # A simplex where BFGS would walk along the kinks of the area metric: a third of the time.
    method = "Nelder-Mead" if name == "area" else None
    return prb.minimize(normal_model(name), method=method, starts=0)


def pair(optimum: prb.Optimum) -> Floats:
    return np.array([optimum.point["mu"], optimum.point["sigma"]])


def errors(optimum: prb.Optimum) -> Floats:
    return np.array([optimum.stderr["mu"], optimum.stderr["sigma"]])


def simplex(f: Callable[..., float], start: Floats, size: float, tolerance: float = 1e-7) -> Floats:
    vertices = np.vstack([start, start + size * np.eye(len(start))])
    options = {"initial_simplex": vertices, "xatol": tolerance, "fatol": 1e-14, "maxiter": 500}
    return np.asarray(optimize.minimize(f, start, method="Nelder-Mead", options=options).x)


# -- where the optimum is --------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "tolerance"), [("kl", 0.03), ("ll", 0.1)])
def test_a_normal_population_gets_mean_and_sd_of_the_data(name: str, tolerance: float) -> None:
    # Kullback-Leibler with one bandwidth for both sides matches moments; the likelihood is smoothed
    # at one side only, with a bandwidth that costs at most a tenth of a standard error.
    optimum = fitted(name)
    assert optimum.converged
    expected = SD / np.sqrt([N, 2 * N])
    assert (np.abs(pair(optimum) - [MEAN, SD]) < tolerance * expected).all()
    np.testing.assert_allclose(errors(optimum), expected, rtol=0.05)


def residual(mu: Any, sigma: Any) -> Any:
    """The probability residual of a normal population, in closed form, without grid or design."""
    h = node(fitted("pr").model).target.cells.bandwidth
    z = np.linspace(-2, 4, 4001)
    density = norm.pdf(z[:, None] - OBSERVED, scale=h).mean(axis=1)
    scale = 100.0 ** -np.floor(np.log10(density.max()))
    width = np.sqrt(sigma**2 + 2 * h**2)[..., None]
    cross = norm.pdf(OBSERVED - mu[..., None], scale=width).mean(axis=-1)
    data = norm.pdf(OBSERVED - OBSERVED[:, None], scale=np.sqrt(2) * h).mean()
    return scale * (1 / np.sqrt(4 * np.pi * (sigma**2 + h**2)) - 2 * cross + data)


def area(mu: Any, sigma: Any, points: int = 4000) -> Any:
    """The area metric of a normal population from its inverse distribution function."""
    u = (np.arange(points) + 0.5) / points
    data = np.sort(OBSERVED)[(u * N).astype(int)]
    return np.abs(mu[..., None] + sigma[..., None] * norm.ppf(u) - data).mean(axis=-1)


@pytest.mark.long
@pytest.mark.parametrize(("name", "brute"), [("pr", residual), ("area", area)])
def test_the_optimum_is_that_of_a_brute_force_grid(name: str, brute: Callable[..., Any]) -> None:
    optimum = fitted(name)
    mu, sigma = np.meshgrid(np.linspace(0.5, 1.5, 41), np.linspace(0.2, 0.8, 41), indexing="ij")
    best = int(np.argmin(brute(mu.ravel(), sigma.ravel())))
    start = np.array([mu.ravel()[best], sigma.ravel()[best]])
    expected = simplex(lambda p: float(brute(np.array(p[0]), np.array(p[1]))), start, 0.02)
    assert (np.abs(pair(optimum) - start) < 0.025).all()
    assert (np.abs(pair(optimum) - expected) < DESIGN_ERROR[name] * errors(optimum)).all()
    at = brute(*(np.array(p) for p in pair(optimum)))
    np.testing.assert_allclose(optimum.discrepancy, at, rtol=0.03 if name == "area" else 1e-2)


def test_reweighting_256_responses_agrees_with_resimulating_thousands() -> None:
    # 4096 points do for the area metric, whose standard errors would take a minute with more.
    best = fitted("area")
    model = normal_model("area", prb.Resimulated(4096))
    many = prb.minimize(model, method="Nelder-Mead", start=best.point, tolerance=1e-4)
    assert (np.abs(pair(many) - pair(best)) < DESIGN_ERROR["area"] * errors(best)).all()


# -- other terms and the prior ---------------------------------------------------------------------


def test_a_quadratic_case_with_everything_mixed_in() -> None:
    # With a known sd and one bandwidth for both sides the divergence is (mu - mean)^2 / (2 (sd^2 +
    # h^2)) plus a constant; the ordinary likelihood and the potential are quadratic as well.
    extra = np.random.default_rng(2).normal(1.2, 0.5, 30)
    model = normal_model("kl", sigma=lambda: 0.5)
    with model:
        pm.Normal("z", model["mu"], 0.5, observed=extra)
        pm.Potential("pull", -5.0 * (model["mu"] - 3.0) ** 2)
    # In units of log-densities: discrepancy / epsilon, epsilon = 1/N.
    h = node(model).target.cells.bandwidth
    precision = np.array([N / (0.25 + h**2), 30 / 0.25, 10.0, 1 / 4])
    centers = np.array([MEAN, extra.mean(), 3.0, 0.0])
    for prior, terms in ((False, slice(3)), (True, slice(4))):
        optimum = prb.minimize(model, prior=prior, starts=0)
        assert optimum.scales == {"y": pytest.approx(1 / N)}
        expected = precision[terms] @ centers[terms] / precision[terms].sum()
        np.testing.assert_allclose(optimum.point["mu"], expected, atol=1e-4)
        assert (optimum.search.prior, "with the prior" in repr(optimum)) == (prior, prior)
        assert optimum.to_datatree()["optimum"].attrs["prior"] == int(prior)


def with_term(term: Callable[[Any], Any]) -> pm.Model:
    model = normal_model("area", sigma=lambda: 0.5)
    with model:
        term(model["mu"])
    return model


TERMS: dict[str, Callable[[Any], Any]] = {
    "potential": lambda mu: pm.Potential("pull", -50.0 * (mu - 3.0) ** 2),
    "likelihood": lambda mu: pm.Normal("z", mu, 0.1, observed=[3.0]),
}


@pytest.mark.parametrize("term", [*TERMS, "prior"])
def test_terms_without_epsilon_to_weigh_them_against_are_refused(term: str) -> None:
    got = "minus the log prior" if term == "prior" else "other likelihood terms or potentials"
    model = with_term(TERMS.get(term, lambda mu: None))
    with pytest.raises(ValueError, match=rf"minimize: got {got} .*without epsilon, \['y'\]"):
        initial_scales(Evaluator.of(model), prior=term == "prior")


def test_a_potential_that_only_excludes_needs_no_epsilon() -> None:
    model = with_term(lambda mu: pm.Potential("positive", pm.math.switch(mu > 0, 0.0, -np.inf)))
    assert initial_scales(Evaluator.of(model), prior=False).tolist() == [1.0]


# -- several simulators ----------------------------------------------------------------------------


def area_without_bias(sigma: float) -> float:
    """Integral of |F - S| - g(F), g the integral of P(K < n q) - P(K > n q), K binomial (n, q)."""
    q = np.linspace(0, 1, 2001)
    above = binom.sf(np.floor(N * q + 1e-9), N, q)
    below = binom.cdf(np.ceil(N * q - 1e-9) - 1, N, q)
    g = cumulative_trapezoid(below - above, q, initial=0)
    x = np.linspace(-3, 5, 16001)
    population = norm.cdf(x, 1.0, sigma)
    measured = np.searchsorted(np.sort(OBSERVED), x, side="right") / N
    return float(trapezoid(np.abs(population - measured) - np.interp(population, q, g), x))


def test_two_simulators_are_scaled_by_their_noise() -> None:
    # The same specimens measured in metres and in millimetres: each counts the same, and the
    # optimum is that of the area without the bias of few specimens.
    with pm.Model() as model:
        x = pm.Normal.dist(1.0, pm.HalfNormal("sigma", 2))
        for name, unit in (("m", 1.0), ("mm", 1000.0)):
            given = {"metric": METRICS["area"], "observed": unit * OBSERVED, "propagation": R256}
            prb.Simulator(name, lambda x, unit=unit: unit * x, x, **given)
    optimum = prb.minimize(model, starts=0)
    d, s = optimum.discrepancies, optimum.scales
    # Noise floors are means over 200 simulated data sets whose discrepancies vary by 40%: standard
    # error 3%.
    np.testing.assert_allclose(s["mm"] / s["m"], 1000, rtol=5 * 0.03 * 2**0.5)
    np.testing.assert_allclose(d["mm"] / d["m"], 1000, rtol=1e-6)
    np.testing.assert_allclose(optimum.discrepancy, sum(d[n] / s[n] for n in d), rtol=1e-12)
    alone = simplex(lambda p: area_without_bias(p[0]), np.array([0.4]), 0.05)
    assert abs(optimum.point["sigma"] - alone[0]) < DESIGN_ERROR["area"] * optimum.stderr["sigma"]


def test_given_epsilons_weigh_the_simulators() -> None:
    second = np.random.default_rng(3).normal(2.0, 0.5, 20)
    with pm.Model() as model:
        mu = pm.Normal("mu", 0, 2)
        for name, data, epsilon in (("a", OBSERVED, 0.02), ("b", second, None)):
            given = {"metric": METRICS["kl"], "observed": data, "propagation": R256}
            prb.Simulator(name, same, pm.Normal.dist(mu, 0.5), epsilon=epsilon, **given)
    h = [n.target.cells.bandwidth for n in nodes(model).values()]
    precision = np.array([1 / 0.02, 20.0]) / (0.25 + np.square(h))  # unset: 1/N
    optimum = prb.minimize(model, starts=0)
    np.testing.assert_allclose([optimum.scales["a"], optimum.scales["b"]], [0.02, 0.05])
    expected = precision @ [MEAN, second.mean()] / precision.sum()
    np.testing.assert_allclose(optimum.point["mu"], expected, atol=3e-4)
    # Each gradient is linear in the mean of its data: the sandwich in closed form.
    noise = (precision**2 * np.array([0.25 / N, 0.25 / 20])).sum()
    np.testing.assert_allclose(optimum.stderr["mu"], noise**0.5 / precision.sum(), rtol=0.02)


# -- supports --------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize(
    ("mu", "sigma"),
    [
        (
            lambda: pm.Deterministic("mu", 3 * pm.Beta("share", 2, 2)),
            lambda: pm.Gamma("sigma", 2, 2),
        ),
        (
            lambda: pm.Uniform("mu", 0, 5, default_transform=None),
            lambda: pm.HalfNormal("sigma", 1, default_transform=None),
        ),
    ],
    ids=["beta", "untransformed"],
)
def test_the_optimum_does_not_depend_on_how_hyperparameters_are_constrained(
    mu: Callable[[], Any], sigma: Callable[[], Any]
) -> None:
    optimum = prb.minimize(normal_model("kl", mu=mu, sigma=sigma), starts=0)
    assert (np.abs(pair(optimum) - [MEAN, SD]) < 0.03 * errors(fitted("kl"))).all()
    np.testing.assert_allclose(errors(optimum), errors(fitted("kl")), rtol=0.02)


@pytest.mark.parametrize("keywords", [{}, {"default_transform": None}], ids=["default", "None"])
def test_an_optimum_at_the_edge_of_a_support_stays_inside(keywords: dict[str, Any]) -> None:
    model = normal_model("kl", mu=lambda: pm.Uniform("mu", 0, 0.9, **keywords))
    optimum = prb.minimize(model, method="Nelder-Mead", starts=0)
    assert 0.9 - 1e-3 < optimum.point["mu"] <= 0.9
    # Moment matching around 0.9 instead of the mean.
    np.testing.assert_allclose(optimum.point["sigma"], np.hypot(SD, MEAN - 0.9), atol=2e-3)
    np.testing.assert_allclose(optimum.stderr["sigma"], errors(fitted("kl"))[1], rtol=0.1)
    if keywords:
        with pytest.raises(ValueError, match="inside the support"):
            prb.minimize(model, start={"mu": 6.0, "sigma": 1.0})


def two_modes(x: Any, coin: Any) -> Any:
    return x + np.where(coin < 0.5, -16.0, 16.0)


def collapsing(spread: Callable[[], Any]) -> pm.Model:
    """The log-likelihood's bandwidth follows the spread between the modes, and prefers a point in either."""
    rng = np.random.default_rng(3)
    observed = two_modes(rng.normal(1.5, 0.1, 20), rng.random(20))
    with pm.Model() as model:
        x, coin = pm.Normal.dist(pm.Normal("mu", 1.5, 0.5), spread()), pm.Uniform.dist(0, 1)
        given = {"metric": METRICS["ll"], "propagation": prb.Resimulated(512)}
        prb.Simulator("y", two_modes, x, coin, observed=observed, **given)
    return model


@pytest.mark.parametrize(
    ("spread", "keywords"),
    [
        (lambda: pm.LogNormal("sigma", np.log(0.1), 4.0), {}),  # less than three spreads of it away
        (lambda: pm.HalfNormal("sigma", 0.3), {"tolerance": 1e-3}),
        (lambda: pm.HalfNormal("sigma", 0.3), {"method": "Powell"}),
    ],
    ids=["wide", "coarse", "Powell"],
)
def test_a_collapsed_population_is_identified_by_the_objective(
    spread: Callable[[], Any], keywords: dict[str, Any]
) -> None:
    """Standard errors are a ratio of rounding errors there."""
    optimum = prb.minimize(collapsing(spread), starts=0, **keywords)
    assert optimum.point["sigma"] < 3e-3
    assert optimum.search.at_edge == ("sigma",)
    assert not optimum.converged


def test_a_collapsed_population_is_no_convergence_and_has_no_errors() -> None:
    model = collapsing(lambda: pm.HalfNormal("sigma", 0.3))
    optimum = prb.minimize(model, starts=0)
    assert optimum.search.at_edge == ("sigma",)
    assert np.isnan(errors(optimum)).all()
    assert optimum.message.endswith("sigma reached the edge of the support.")
    messages = prb.diagnose(optimum).messages
    assert "collapsed" in messages[0]
    assert not any("did not converge" in message for message in messages)
    for call in (
        prb.calibrate_epsilon,
        prb.bootstrap,
        prb.cross_validate,
        prb.validation.JointNull,
    ):
        with pytest.raises(ValueError, match=f"{call.__name__}: .*sigma reached the edge"):
            call(optimum)
    sampler: dict[str, Any] = {"chains": 1, "optimum": optimum, "model": model, "random_seed": 1}
    with pytest.raises(ValueError, match=r"sample_smc: .*sigma reached the edge .*adjustment=None"):
        prb.sample_smc(50, **sampler)
    tree = prb.sample_smc(50, epsilon=1 / 20, adjustment=None, **sampler)
    assert tree.posterior["sigma"].mean() > 10 * optimum.point["sigma"]


def test_a_hyperparameter_without_effect_is_at_no_edge_however_far_out() -> None:
    model = normal_model("pr", sigma=lambda: 0.5)
    with model:
        pm.Normal("idle", 3, 2)
    optimum = prb.minimize(model, start={"mu": 1.0, "idle": 60.0}, starts=0)
    assert optimum.point["idle"] == pytest.approx(60.0)
    assert optimum.search.at_edge == ()
    assert optimum.converged


def test_an_optimum_far_outside_the_prior_is_not_taken_for_an_edge() -> None:
    observed = 1.0 + 0.002 * (OBSERVED - 1.0)
    model = normal_model("pr", prb.Resimulated(4096), observed=observed)
    optimum = prb.minimize(model, start={"mu": 1.0, "sigma": 0.002})
    assert optimum.converged
    assert optimum.search.at_edge == ()
    assert optimum.point["sigma"] == pytest.approx(0.002 * fitted("pr").point["sigma"], rel=0.1)
    np.testing.assert_allclose(errors(optimum), 0.002 * errors(fitted("pr")), rtol=0.5)


# -- jumps -----------------------------------------------------------------------------------------

START = {"mu": 1.65, "sigma": 0.15}


def lossy(name: str, seed: int, n: int) -> pm.Model:
    """Model eq. 14 of the paper, which has no response where |x - 2| > 1."""

    def response(x: Any, coin: Any) -> Any:
        with np.errstate(invalid="ignore"):
            return 10 + np.where(coin < 0.5, -16.0, 16.0) * np.sqrt(1 - (x - 2) ** 2)

    rng = np.random.default_rng([seed, 20, 3])
    observed = response(rng.normal(1.5, 0.1, 40), rng.random(40))[:20]
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1.65, 0.5), pm.HalfNormal("sigma", 0.3))
        given = {"metric": METRICS[name], "propagation": prb.Resimulated(n)}
        prb.Simulator("y", response, x, pm.Uniform.dist(0, 1), observed=observed, **given)
    return model


def test_bfgs_steps_over_the_jumps_of_points_that_lose_their_response() -> None:
    model = lossy("pr", 2, 4096)
    by_simplex = prb.minimize(model, start=START, method="Nelder-Mead")
    optimum = prb.minimize(model, start=START)
    assert optimum.discrepancy < by_simplex.discrepancy * (1 + 1e-4)
    assert optimum.converged
    # Standard errors are those at the simplex's end.
    assert optimum.search.result is Result.SETTLED_BY_SIMPLEX
    local = SamplingDistribution.of(optimum.evaluator, optimum.theta, np.ones(1)).local
    np.testing.assert_allclose(optimum.covariance, local.in_theta, rtol=1e-6)
    np.testing.assert_array_equal(optimum.sampling().local.in_theta, local.in_theta)


def test_at_a_jump_there_are_no_standard_errors() -> None:
    optimum = prb.minimize(lossy("kl", 1, 1024), start=START)
    assert optimum.search.at_jump == ("y",)
    assert np.isnan(errors(optimum)).all()
    assert "points lose their response" in str(prb.diagnose(optimum))
    with pytest.raises(ValueError, match=r"calibrate_epsilon: .* points lose their response"):
        prb.calibrate_epsilon(optimum)


@pytest.mark.long
def test_a_jump_that_hardly_matters_leaves_standard_errors_alone() -> None:
    """A response that is lost beyond three standard deviations, and one that is not."""
    cut, whole = (
        prb.minimize(
            normal_model(
                "kl",
                prb.Resimulated(100_000),
                lambda x, e=edge: np.where(np.abs(x - MEAN) < e * SD, x, np.nan),
            )
        )
        for edge in (3.0, np.inf)
    )
    assert cut.converged
    assert cut.search.at_jump == ()
    # A cut response has more information about sigma.
    np.testing.assert_allclose(errors(cut), errors(whole), rtol=0.25)


# -- starts ----------------------------------------------------------------------------------------


def test_the_start_is_honoured() -> None:
    model = fitted("pr").model
    optimum = prb.minimize(model, start={"mu": 0.5, "sigma": 0.9})
    trace = optimum.search.trace
    np.testing.assert_allclose(trace["theta"][0], [0.5, np.log(0.9)], rtol=1e-12)
    assert (optimum.search.n_screened, fitted("pr").search.n_screened) == (0, 257)
    first = Evaluator.of(model)(trace["theta"][:1]).discrepancies[0, 0]
    np.testing.assert_allclose(trace["discrepancy"][0], first, rtol=1e-9)


def test_data_that_no_population_reaches_are_no_convergence() -> None:
    # All weight is on the outermost design point: nothing changes any more.
    model = normal_model("pr", observed=OBSERVED + 1000)
    optimum = prb.minimize(model, refine=False, starts=0)
    assert not optimum.converged
    assert "try another start" in optimum.message


@pytest.mark.parametrize("propagation", [R256, prb.Resimulated(512)], ids=["stored", "computed"])
def test_far_starts_converge(propagation: Any) -> None:
    model = normal_model("pr", propagation)
    alone = {"refine": False, "starts": 0}
    best = prb.minimize(model, start={"mu": MEAN, "sigma": SD}, **alone)
    assert "the area metric" not in best.message
    # 58 standard deviations of the data away.
    optimum = prb.minimize(model, start={"mu": 30.0, "sigma": 0.1}, **alone)
    assert optimum.converged
    assert "the area metric was minimised first" in optimum.message
    np.testing.assert_allclose(optimum.theta, best.theta, atol=1e-4)
    trace = optimum.search.trace
    assert optimum.search.n_evaluations == trace["evaluations"][-1] > len(trace["theta"])
    if propagation is not R256:  # the first point is the start, and no draw of the prior
        np.testing.assert_allclose(trace["theta"][0], [30.0, np.log(0.1)], rtol=1e-12)
    np.testing.assert_allclose(trace["discrepancy"].min(), optimum.discrepancy, rtol=1e-9)


# -- standard errors -------------------------------------------------------------------------------


@pytest.mark.long
def test_standard_errors_of_the_area_metric_against_refitting_500_data_sets() -> None:
    start, rng = pair(fitted("area")), np.random.default_rng(5)
    u = (np.arange(500) + 0.5) / 500
    z, step = norm.ppf(u), (u * N).astype(int)
    fits = []
    for _ in range(500):
        data = np.sort(rng.normal(*start, N))[step]
        distance = lambda p, data=data: float(np.abs(p[0] + p[1] * z - data).mean())  # noqa: E731
        fits.append(simplex(distance, start, 0.04, 1e-4))
    # The sd of 500 fits has a relative standard error of 3.2%, that of 200 linearised fits one of
    # 5%: 6% together.
    np.testing.assert_allclose(errors(fitted("area")), np.std(fits, axis=0, ddof=1), rtol=4 * 0.06)


# -- what it costs ---------------------------------------------------------------------------------


class Counting:
    """A black box that counts its scalar responses; a specimen by itself is no run."""

    count = 0

    def __call__(self, x: Any) -> Floats:
        x = np.asarray(x, dtype=float)
        self.count += x.size if x.size > 1 else 0
        return x


def test_responses_under_reweighted_are_those_of_the_design() -> None:
    response = Counting()
    model = normal_model("kl", response=response)
    first_use(model)
    again = 33  # specimens that are computed in another order, to look for a state
    assert response.count == 256 + again
    optimum = prb.minimize(model)
    assert optimum.n_responses == response.count - again == node(model).bound.n_points
    # The design is part of a second optimum as well.
    assert prb.minimize(model).n_responses == response.count - again == optimum.n_responses
    trace = optimum.search.trace
    assert optimum.search.n_evaluations == len(trace["discrepancy"]) == len(trace["theta"]) > 3


def test_a_black_box_response_under_resimulated() -> None:
    response = Counting()
    model = normal_model("pr", prb.Resimulated(1024), response)
    first_use(model)
    probe = response.count  # a few responses at the first use, to check its shape
    assert 0 < probe <= 16
    optimum = prb.minimize(model)  # BFGS on finite differences
    assert optimum.converged
    assert optimum.n_responses == response.count - probe
    extra = optimum.n_responses - 1024 * optimum.search.n_evaluations
    assert 0 < extra < 20 * 1024
    assert (np.abs(pair(optimum) - pair(fitted("pr"))) < 0.03 * errors(fitted("pr"))).all()
    # Responses inside a graph are counted all the same, and a gradient costs no more than a value.
    symbolic = prb.minimize(normal_model("pr", prb.Resimulated(1024)))
    np.testing.assert_allclose(pair(optimum), pair(symbolic), atol=1e-5)
    assert symbolic.search.n_evaluations < optimum.search.n_evaluations / 2
    assert symbolic.n_responses == 1024 * symbolic.search.n_evaluations + extra


def test_fresh_draws_have_no_standard_errors() -> None:
    model = normal_model("area", prb.Fresh(200))
    start = {"mu": 1.0, "sigma": 0.5}
    optimum = prb.minimize(model, method="Nelder-Mead", start=start, max_evaluations=60)
    assert np.isnan(errors(optimum)).all()
    # The noise of 200 draws is half that of the data.
    assert abs(optimum.point["mu"] - MEAN) < 5 * 0.5 / 50**0.5


# -- determinism and storage -----------------------------------------------------------------------


def test_bit_identical_twice() -> None:
    first, second = fitted("pr"), prb.minimize(normal_model("pr"), starts=0)
    assert (first.point, first.stderr) == (second.point, second.stderr)
    for key in ("theta", "discrepancy"):
        np.testing.assert_array_equal(first.search.trace[key], second.search.trace[key])


def test_an_optimum_survives_storage(tmp_path: Path) -> None:
    optimum = fitted("area")
    tree = optimum.to_datatree()
    tree.to_netcdf(tmp_path / "optimum.nc")
    with xr.open_datatree(tmp_path / "optimum.nc") as loaded:
        for group in ("optimum", "stderr", "trace", "calibration", "observed_data"):
            xr.testing.assert_equal(loaded[group].to_dataset().load(), tree[group].to_dataset())
        attrs = loaded["optimum"].attrs
        assert attrs["message"] == optimum.message
        assert attrs["n_responses"] == optimum.n_responses
        assert float(loaded["optimum"]["mu"]) == optimum.point["mu"]
        assert list(loaded["calibration"]["element"].values) == ["mu", "sigma_log__"]


# -- unidentified directions, designs, and findings ------------------------------------------------


@pytest.mark.long
def test_unidentified_directions_are_regularised_and_named() -> None:
    """Of a ratio the quotient of means is identified, and neither of them."""
    rng = np.random.default_rng(1)
    observed = rng.normal(10, 0.5, 40) / rng.normal(2, 0.1, 40)
    with pm.Model() as model:
        mu_a, mu_b = pm.Normal("mu_a", 10, 2), pm.Normal("mu_b", 2, 0.4)
        a = pm.Normal.dist(mu_a, pm.HalfNormal("sd_a", 1))
        b = pm.Normal.dist(mu_b, pm.HalfNormal("sd_b", 0.3))
        pm.Deterministic("ratio", mu_a / mu_b)
        prb.Simulator("y", lambda a, b: a / b, a, b, metric=METRICS["pr"], observed=observed)
    optimum = prb.minimize(model, starts=0, progressbar=False)
    assert optimum.converged
    assert "do not identify were regularised" in optimum.message
    hyperparameters = optimum.evaluator.hyperparameters
    prior = hyperparameters.constrained(hyperparameters.prior_thetas(1000, 1))
    text = " ".join(f.text for f in optimum.findings if f.code == "not-identified")
    for name in ("mu_a", "sd_a", "mu_b", "sd_b"):
        assert np.isinf(optimum.stderr[name])
        assert name in text
        # Within the prior, where populations are supported.
        low, high = np.quantile(prior[name], [0.01, 0.99])
        assert low < optimum.point[name] < high
    error = optimum.stderr["ratio"]
    # The standard error of a mean, and a few per cent that the residual costs.
    assert error == pytest.approx(observed.std() / np.sqrt(observed.size), rel=0.3)
    assert abs(optimum.point["ratio"] - np.median(observed)) < error


@pytest.mark.long
def test_a_gradient_that_is_nan_is_differenced() -> None:
    # PyMC's gradient of a normal cut off on one side is NaN at values that are cut off.
    values = np.random.default_rng(0).normal(1.0, 0.7, 400)
    with pm.Model() as model:
        mu, w = pm.Normal("mu", 1, 1), pm.HalfNormal("w", 2)
        x = pm.TruncatedNormal.dist(mu, pm.HalfNormal("sd", 1), lower=mu - w)
        data = values[values > 0][:40]
        prb.Simulator("y", same, x, metric=METRICS["kl"], observed=data, propagation=R256)
    evaluator, scales = Evaluator.of(model), np.ones(1)
    theta = unconstrained(evaluator.hyperparameters, {"mu": 0.9, "w": 1.4, "sd": 0.5})
    prior_sd = evaluator.hyperparameters.prior_sd
    value, gradient = compiled_objective(evaluator, prior=False, gradient=True)(theta, scales)
    assert np.isfinite(value)
    assert np.isnan(gradient).any()
    search = Search(evaluator, prior_sd, Minimisation(max_evaluations=100))
    objective = search.objective(theta, scales, 1.0, 0, gradient=True)
    differenced, slope = objective(np.zeros(3))
    assert differenced == pytest.approx(value)
    assert objective.count == 1 + 2 * 3
    step = 1e-3 * np.eye(3)
    around = [evaluator.total(theta + side * step * prior_sd, scales) for side in (1, -1)]
    np.testing.assert_allclose(slope, (around[0] - around[1]) / 2e-3, rtol=0.02, atol=1e-3)


@pytest.mark.parametrize("supported", [True, False])
def test_a_ridge_ends_once_designs_identify_its_directions(
    supported: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = fitted("kl")

    def regularised(search: Any, fit: Any, round_: int, *_: Any) -> Any:
        # As by a design that was too small at first to identify anything.
        if round_ == 0:
            ridge = Ridge(expected.theta + 0.1, np.eye(2), 10.0)
            return fit, Restart(ridge.center, None, ridge)
        if not supported:
            monkeypatch.setattr(minimization, "shortcomings", lambda *_: {"y": "too few points"})
            monkeypatch.setattr(minimization, "refine_at", lambda *_, **__: {})
        return fit, None

    monkeypatch.setattr(minimization, "refine_designs", regularised)
    optimum = prb.minimize(normal_model("kl"), starts=0)
    # Else it stays at the ridge's center, with a message.
    assert bool(np.abs(optimum.theta - expected.theta).max() < 1e-4) is supported
    assert ("were regularised" not in optimum.message) is supported


def test_a_simplex_that_leaves_the_design_is_not_followed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few points have a lower value by accident."""
    model = normal_model("area", prb.Reweighted(256, max_points=256), mu=lambda: pm.Normal("mu", 1))
    expected = prb.minimize(model, starts=0)
    starts = []

    def astray(search: Search, fit: Fit) -> Fit:
        starts.append(fit.theta)
        return replace(fit, theta=fit.theta + np.array([0.0, -8.0]), lowest=0.0)

    monkeypatch.setattr(minimization, "settle", astray)
    optimum = prb.minimize(model, starts=0)
    np.testing.assert_allclose(optimum.theta, expected.theta, atol=0.01)
    # It was tried twice from the end of the minimisation.
    np.testing.assert_array_equal(*starts)


@pytest.mark.parametrize(
    ("sizes", "advice"),
    [
        ([None], "pass a larger n or max_points to prb.Reweighted (now 300 runs)"),
        ([16384], "pass a larger n"),
        ([SIZES.largest, None], "pass a larger n"),
        ([SIZES.largest, SIZES.largest], "the 300 runs have the largest number of emulated points"),
    ],
)  # fmt: skip
def test_a_large_error_of_the_design_is_reported(sizes: list[int | None], advice: str) -> None:
    emulated = [None if size is None else (range(size),) for size in sizes]
    designs = [SimpleNamespace(runs=range(300), emulated=points) for points in emulated]
    bounds = {f"y{k}": SimpleNamespace(design=design) for k, design in enumerate(designs)}
    evaluator: Any = SimpleNamespace(nodes=(), reweighted=bounds)
    (finding,) = optimum_findings(evaluator, None, (), 0.4)
    assert "by about 0.40 standard errors, expected at most 0.1" in finding.text
    assert advice in finding.text
    assert optimum_findings(evaluator, None, (), 0.14) == ()
