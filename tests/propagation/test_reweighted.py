"""The design of `Reweighted`: weights that integrate, refinement, refusal, and `diagnose`."""

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pymc as pm
import pytest
from first_use import first_use
from scipy.special import logsumexp
from scipy.stats import norm, poisson

import prbayes as prb
from prbayes._validate import Floats
from prbayes.model.evaluator import Evaluator, shortcomings
from prbayes.model.random_variable import nodes
from prbayes.propagation.reweighted import ReweightedBound, designs_restored
from prbayes.response.distributions import PopulationSampler
from prbayes.response.inputs import read_inputs
from prbayes.response.response import Responses

OBSERVED = np.random.default_rng(1).normal(1.0, 0.5, 50)
KL, PR, AREA = prb.KullbackLeibler(), prb.ProbabilityResidual(), prb.AreaMetric()


def same(x: Any) -> Any:
    return x


def model_of(
    distribution: Callable[[], Any],
    n: int = 256,
    *,
    metric: prb.Metric = AREA,
    response: Any = same,
    observed: Any = OBSERVED,
    propagation: Any = None,
    epsilon: float | None = None,
    **keywords: Any,
) -> pm.Model:
    """Return a model of one input."""
    propagation = propagation or prb.Reweighted(n, **keywords)
    with pm.Model() as model:
        prb.Simulator(
            "y", response, distribution(), metric=metric, observed=observed,
            propagation=propagation, epsilon=epsilon,
        )  # fmt: skip
    return model


def line(n: int = 256, seed: int = 0, **keywords: Any) -> pm.Model:
    """Return a model of a normal input with a wide prior."""
    return model_of(
        lambda: pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1)),
        n, random_seed=seed, **keywords,
    )  # fmt: skip


def bound_of(model: pm.Model, name: str = "y") -> ReweightedBound:
    bound = {n.name: n.bound for n in nodes(model).values()}[name]
    assert isinstance(bound, ReweightedBound)
    return bound


def log_mixture(d: ReweightedBound, x: Floats) -> Floats:
    """log g at x from the list of thetas of a normal input, by SciPy."""
    mu, sigma = (t[:, None] for t in d.design.mixture.components)
    shares = np.log(d.design.mixture.counts / d.design.mixture.counts.sum())[:, None]
    return np.asarray(logsumexp(norm.logpdf(x, mu, sigma) + shares, axis=0))


@cache
def once() -> pm.Model:
    return line()


@cache
def twice() -> pm.Model:
    model = line()
    bound_of(model).add([np.full(64, 1.0), np.linspace(0.2, 0.3, 64)])
    return model


SINGULAR = {
    "gamma": lambda: pm.Gamma.dist(mu=10, sigma=pm.HalfNormal("b", 10)),
    "beta": lambda: pm.Beta.dist(pm.HalfNormal("a", 2), pm.HalfNormal("b", 1)),
    "far and narrow": lambda: pm.Normal.dist(pm.Normal("a", 1, 50), pm.HalfNormal("b", 1)),
}


def test_points_of_one_input_have_equal_mass() -> None:
    design = bound_of(once()).design
    (points,) = design.runs.points
    mu, sigma = (t[:, None] for t in design.mixture.components)
    shares = design.mixture.counts / design.mixture.counts.sum()
    mass = shares @ norm.cdf(np.sort(points), mu, sigma)
    gaps = np.diff(mass) * len(points)
    np.testing.assert_allclose(np.median(gaps), 1.0, rtol=0.01)
    # Gaps of 4096 draft points in the outermost parts are bridged by straight lines.
    assert (np.abs(gaps[5:-5] - 1) < 0.1).all()
    assert 0 < mass[0] < 1.5 / 256


@pytest.mark.parametrize("kind", sorted(SINGULAR))
def test_points_have_equal_mass_where_the_density_is_infinite_or_has_narrow_peaks(
    kind: str,
) -> None:
    d = bound_of(model_of(SINGULAR[kind]))
    drawn = PopulationSampler(d.inputs)(d.design.mixture.components, 64, np.random.default_rng(0))
    population = drawn[0][0].ravel()
    levels = np.arange(1, 10) / 10
    share = [np.mean(population <= q) for q in np.quantile(d.design.sample.values, levels)]
    np.testing.assert_allclose(share, levels, atol=0.03)


@pytest.mark.exact
@pytest.mark.parametrize("model", [once, twice])
def test_weights_are_the_populations_density_over_the_mixture(model: Any) -> None:
    d = bound_of(model())
    (points,) = d.design.runs.points
    assert len(points) == d.n_points == d.design.mixture.counts.sum()
    mu, sigma = np.array([0.0, 1.0, -2.0]), np.array([1.0, 0.3, 0.7])
    logs = norm.logpdf(points, mu[:, None], sigma[:, None]) - log_mixture(d, points)
    values, weights = d.populations([mu, sigma])
    np.testing.assert_array_equal(values[0], points)
    expected = np.exp(logs - logsumexp(logs, axis=1, keepdims=True))
    np.testing.assert_allclose(weights, expected, rtol=1e-9)
    w = np.exp(logs)
    support = d.support([mu, sigma])
    ess = w.sum(axis=1) ** 2 / (w**2).sum(axis=1)
    np.testing.assert_allclose(support["weight_ess"], ess, rtol=1e-9)
    np.testing.assert_allclose(support["mean_weight"], w.mean(axis=1), rtol=1e-9)
    np.testing.assert_array_equal(support["lost_mass"], 0.0)


@pytest.mark.parametrize("model", [once, twice])
def test_the_weights_integrate(model: Any) -> None:
    """Mean weights are one, and moments those of populations, better than by sampling."""
    mu, sigma = (a.ravel() for a in np.meshgrid(np.linspace(-3, 3, 13), [0.3, 0.6, 1.2]))
    d = bound_of(model())
    np.testing.assert_allclose(d.support([mu, sigma])["mean_weight"], 1.0, atol=0.02)
    x, w = d.populations([mu, sigma])
    mean = (x * w).sum(axis=-1)
    assert (np.abs(mean - mu) < 0.02 * sigma).all()
    np.testing.assert_allclose(np.sqrt((x**2 * w).sum(axis=-1) - mean**2), sigma, rtol=0.02)


def test_a_second_batch_supports_the_populations_that_it_was_added_for() -> None:
    roots = [np.array([1.0, -2.0]), np.array([0.25, 0.5])]
    before, after = (bound_of(m()).support(roots)["weight_ess"] for m in (once, twice))
    assert bound_of(twice()).n_points == 512
    assert after[0] > before[0] + 200  # nearly all of the 256 points
    assert after[1] > 0.95 * before[1]  # the balance heuristic keeps what there was


def test_mass_out_of_reach_shows_in_the_mean_weight() -> None:
    # A population far wider than any of the design's: many points count, but its tails are missing.
    support = bound_of(once()).support([np.array([0.0]), np.array([100.0])])
    assert support["mean_weight"][0] < 0.3
    assert support["weight_ess"][0] > 20
    far = bound_of(once()).support([np.array([60.0]), np.array([0.1])])
    assert far["weight_ess"][0] == pytest.approx(1.0)
    assert far["mean_weight"][0] < 1e-100
    short = str(shortcomings(Evaluator.of(once()), np.array([[0.0, np.log(100.0)]]))["y"])
    assert "mean raw weight from" in short
    assert "expected within 0.8 to 1.25" in short


def test_a_design_depends_on_its_seed_alone() -> None:
    models = [line(), line(), line(seed=1)]
    thetas = np.array([[1.0, np.log(0.5)], [0.5, np.log(0.8)], [-1.0, 0.0]])
    values = [Evaluator.of(model)(thetas).discrepancies[:, 0] for model in models]
    np.testing.assert_allclose(values[2], values[0], atol=0.01)  # 2% of the data's sd
    one, two, other = map(bound_of, models)
    for d in (one, two):
        d.add([np.array([1.0, 2.0]), np.array([0.5, 0.5])])
    (points,) = one.design.runs.points
    np.testing.assert_array_equal(points, two.design.runs.points[0])
    pairs = zip(one.design.mixture.components, two.design.mixture.components, strict=True)
    assert all(np.array_equal(a, b) for a, b in pairs)
    assert not np.isin(other.design.runs.points[0], points).any()
    assert np.unique(points).size == 512  # a batch repeats no point of an earlier one


def test_blocks_of_populations_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    def moving() -> Any:
        return pm.Uniform.dist(pm.Normal("low", 0, 1), 2.0)

    evaluator = Evaluator.of(model_of(moving, 64, metric=KL, observed=[0.5, 1.0, 1.5]))
    thetas = np.linspace(-1.0, 1.5, 150)[:, None]
    thetas[4] = 3.0  # no population at all
    whole = evaluator.discrepancies(thetas, 0)
    monkeypatch.setattr("prbayes.propagation.reweighted.IN_CACHE", 1)  # blocks of 64
    np.testing.assert_allclose(evaluator.discrepancies(thetas, 0), whole, rtol=1e-12)
    assert np.flatnonzero(np.isinf(whole)).tolist() == [4]
    assert evaluator.discrepancies(thetas[:0], 0).shape == (0,)


def test_an_input_without_inverse_distribution_function() -> None:
    model = model_of(lambda: pm.ExGaussian.dist(pm.Normal("mu", 0, 2), 0.3, nu=0.5))
    mu = np.array([-1.0, 0.0, 1.0])
    support = bound_of(model).support([mu])
    np.testing.assert_allclose(support["mean_weight"], 1.0, atol=0.02)
    values, weights = bound_of(model).populations([mu])
    np.testing.assert_allclose((values * weights).sum(axis=-1), mu + 0.5, atol=0.02)


def mixture() -> Any:
    components = [pm.Normal.dist(pm.Normal("mu", 1, 1), 1.0), pm.Normal.dist(5.0, 0.5)]
    return pm.Mixture.dist(np.array([0.3, 0.7]), components)


DISTRIBUTIONS = {
    # A censored input has probability at zero.
    "censored": (
        lambda: pm.Censored.dist(pm.Normal.dist(pm.Normal("mu", 1, 1)), lower=0.0, upper=None),
        lambda x, mu: norm.cdf(x, mu),
    ),
    "discrete": (lambda: pm.Poisson.dist(pm.Gamma("rate", 2, 0.5)), poisson.cdf),
}


@pytest.mark.exact
@pytest.mark.parametrize("kind", ["censored", "discrete"])
def test_the_distribution_function_of_a_population(kind: str) -> None:
    distribution, cdf = DISTRIBUTIONS[kind]
    values, weights = bound_of(model_of(distribution, 512)).populations([np.array([0.5, 1.5])])
    for mu, row in zip((0.5, 1.5), weights, strict=True):
        for x in (0.0, 1.0, 3.0, 5.0):
            # Discrete points are drawn at random: four standard errors.
            tolerance = 0.02 if kind != "discrete" else 2 * np.sqrt((row**2).sum())
            assert row[values[0] <= x].sum() == pytest.approx(cdf(x, mu), abs=tolerance)


def test_lost_mass_is_the_probability_of_failure() -> None:
    model = line(512, response=lambda x: np.where(x < 0, np.nan, x), max_lost=0.2)
    mu, sigma = np.array([0.0, 1.0, 3.0]), np.array([1.0, 1.0, 0.5])
    lost = bound_of(model).support([mu, sigma])["lost_mass"]
    np.testing.assert_allclose(lost, norm.cdf(-mu / sigma), atol=0.01)
    evaluator = Evaluator.of(model)
    assert not shortcomings(evaluator, np.array([[1.0, 0.0]]))  # 16%
    short = str(shortcomings(evaluator, np.array([[0.5, 0.0]]))["y"])
    assert "lost mass: 3" in short  # 31%
    assert "at most max_lost = 20.0%" in short


@pytest.mark.long
def test_a_wide_population_is_refused_where_a_narrow_design_may_not_grow() -> None:
    data = np.random.default_rng(0).normal(0, 5, 200)

    def narrow() -> Any:
        return pm.Normal.dist(0, pm.LogNormal("sigma", -1.1, 0.1))  # about a third

    model = model_of(narrow, max_points=256, observed=data)
    assert np.abs(bound_of(model).design.runs.points[0]).max() < 3
    words = r"y: the design does not support.* of at most 256\), or use"
    with pytest.raises(prb.propagation.DesignError, match=words):
        prb.minimize(model)


def test_many_inputs_are_told_what_to_use(caplog: pytest.LogCaptureFixture) -> None:
    for k in (2, 5):
        caplog.clear()
        first_use(
            model_of(
                lambda: pm.MvNormal.dist(pm.Normal("mu", 0, 3, shape=k), 0.1 * np.eye(k)),  # noqa: B023
                256,
                response=lambda x: x.sum(axis=-1),
                observed=[0.0, 1.0, 2.0],
                emulator=None,
            )
        )
        words = "5 inputs are many for stored responses alone: leave out"
        assert (words in caplog.text) == (k == 5)


FAR = np.random.default_rng(1).normal(10.0, 0.5, 30)


def far_from_the_prior(
    prior_sd: float, metric: prb.Metric = AREA, response: Any = same, n: int = 128
) -> pm.Model:
    return model_of(
        lambda: pm.Normal.dist(pm.Normal("mu", 0, prior_sd), 0.5),
        n, metric=metric, response=response, observed=FAR,
    )  # fmt: skip


@pytest.mark.long
def test_minimize_refines_where_the_answer_is_far_out_in_the_prior() -> None:
    """The area metric says in which direction to go: 20 prior sds away."""
    model = far_from_the_prior(0.5)
    evaluator = Evaluator.of(model)
    assert shortcomings(evaluator, np.array([[10.0]]))
    optimum = prb.minimize(model)
    assert optimum.n_responses == bound_of(model).n_points > 128
    assert optimum.n_responses % 128 == 0
    assert abs(optimum.point["mu"] - np.median(FAR)) < optimum.stderr["mu"]
    np.testing.assert_allclose(optimum.stderr["mu"], 0.5 / 30**0.5, rtol=0.25)
    assert not shortcomings(evaluator, optimum.theta[None])
    assert prb.diagnose(optimum, model=model).ok


@pytest.mark.long
@pytest.mark.parametrize(("metric", "prior_sd"), [(KL, 0.1), (PR, 1.0)])
def test_data_that_no_population_of_the_prior_reaches(metric: prb.Metric, prior_sd: float) -> None:
    # The discrepancy is flat, up to rounding: the area metric leads all the way.
    optimum = prb.minimize(far_from_the_prior(prior_sd, metric))
    assert optimum.converged
    assert abs(optimum.point["mu"] - 10) < 0.2
    assert optimum.n_responses <= 1024
    # A response that never reaches the data is never silent.
    model = far_from_the_prior(prior_sd, metric, np.tanh)
    optimum = prb.minimize(model)
    assert not optimum.converged
    assert "far from the data" in optimum.message
    assert "far from the data" in str(prb.diagnose(optimum, model=model))


def test_refine_false_leaves_the_design_alone() -> None:
    model = far_from_the_prior(0.5)
    optimum = prb.minimize(model, refine=False, method="Nelder-Mead")
    assert optimum.n_responses == bound_of(model).n_points == 128
    found = prb.diagnose(optimum, model=model)
    assert not found.ok
    assert "y: the design does not support the answer" in str(found)


def test_sample_smc_refines() -> None:
    data = np.random.default_rng(1).normal(6.0, 0.5, 30)
    model = model_of(
        lambda: pm.Normal.dist(pm.Normal("mu", 0, 3), 0.2), 64, observed=data, epsilon=0.05
    )
    keywords: dict[str, Any] = {"model": model, "chains": 2, "random_seed": 1, "progressbar": False}
    keywords["adjustment"] = None
    bare = prb.sample_smc(100, refine=False, **keywords)
    assert bare.posterior.attrs["n_responses"] == 64
    width = ["width-of-epsilon"]
    assert [finding.code for finding in prb.diagnose(bare, model=model).findings] != width
    idata = prb.sample_smc(100, **keywords)
    assert idata.posterior.attrs["n_responses"] == bound_of(model).n_points > 64
    assert [finding.code for finding in prb.diagnose(idata, model=model).findings] == width
    assert float(idata.calibration["weight_ess"].median()) > 50


def test_refine_without_a_design_and_with_one_that_is_good() -> None:
    model = line(propagation=prb.Resimulated(16))
    assert prb.refine(model, thetas=np.zeros((1, 2))) == {}
    assert prb.refine(once(), thetas=np.array([[0.0, 0.0]])) == {"y": 256}


def test_a_design_that_can_never_do_is_refused() -> None:
    # Populations of many widths at once, each with a few points of its own: eight batches of 16 are
    # too few.
    model = line(16)
    thetas = np.stack([np.linspace(-40, 40, 256), np.full(256, np.log(0.01))], axis=1)
    words = r"y: the design does not support the answer.*now 144 runs, .*got weight"
    with pytest.raises(prb.propagation.DesignError, match=words):
        prb.refine(model, thetas=thetas)


@pytest.mark.exact
def test_another_response_is_computed_at_the_new_points_only() -> None:
    model = line(64)
    asked: list[int] = []

    def later(x: Any) -> Any:
        if np.size(x) > 1:  # a specimen by itself is no run
            asked.append(np.size(x))
        return 2 * x

    (bound,) = Evaluator.of(model).reweighted.values()
    inputs = read_inputs("later", list(bound.inputs.aleatory), model)
    for batches in range(1, 4):
        # A new description of the same response, as each call of predict makes one.
        found = bound.values_of(Responses("later", later, inputs))
        assert np.array_equal(found, 2 * bound.design.sample.values)
        # Nine are computed again in another order, and three as files might have changed.
        assert asked == [64, 9, 3, 64, 64][: (0, 2, 4, 5)[batches]]
        bound.add([np.array([1.0, 2.0]), np.array([0.5, 0.5])])
    # Points that are forgotten take their responses with them.
    with designs_restored([bound]):
        bound.add([np.array([1.0, 2.0]), np.array([0.5, 0.5])])
        bound.values_of(Responses("later", later, inputs))
    assert np.array_equal(
        bound.values_of(Responses("later", later, inputs)), 2 * bound.design.sample.values
    )


def test_data_that_have_changed_are_refused_where_points_are_added() -> None:
    model = model_of(lambda: pm.Normal.dist(pm.Normal("mu", 0, 1) + pm.Data("shift", 0.0), 1.0), 64)
    bound = Evaluator.of(model).reweighted["y"]
    components = [np.linspace(-1, 1, 16)]
    model.set_data("shift", 1.0)
    with pytest.raises(prb.propagation.DesignError, match="got other values of shift, which is"):
        bound.add(components)
    model.set_data("shift", 0.0)
    bound.add(components)
    assert bound.n_points == 128


def test_a_basis_that_would_be_too_large_is_one_of_projections(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    data = np.random.default_rng(1).normal(1.0, 0.5, (30, 2))
    model = model_of(
        lambda: pm.Normal.dist(pm.Normal("mu", 1, 0.3), 0.5, shape=2),
        64, metric=prb.Joint(PR), observed=data, emulator=None,
    )  # fmt: skip
    bound = bound_of(model)
    assert bound._graph_basis().arrays[0].size > 64 * 100
    monkeypatch.setattr("prbayes.propagation.reweighted._MAX_BASIS", 100)
    assert bound._graph_basis().arrays[0].shape == (64, 4)
