"""Propagations times samplers: every way of drawing or optimising gives the same answer from the same node."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import pymc as pm
import pytest
from first_use import first_use
from line_problem import EPSILON, MU, POINTS, QUIET, SIGMA, N, build, line
from pytensor import config
from scipy import stats

import prbayes as prb
from prbayes._validate import Floats
from prbayes.model.evaluator import Evaluator
from prbayes.model.random_variable import Node
from prbayes.propagation.base import Propagation
from prbayes.response.compile import PLAIN


@dataclass
class BlackBox:
    """A response that PyTensor cannot look into; counts its scalar responses by itself.

    A specimen alone, computed to see that none depends on others, is no run.
    """

    count: int = 0

    def __call__(self, x: Any) -> Any:
        values = np.asarray(x, dtype=np.float64)
        self.count += values.size if values.size > 1 else 0
        return 0.75 * values


RESPONSES = {
    "Reweighted": BlackBox(),
    "strong prior": line,
    "Resimulated": line,
    "black box": BlackBox(),
    "Fresh": BlackBox(),
}
PROPAGATIONS: dict[str, Propagation] = {
    "Reweighted": prb.Reweighted(POINTS),
    "strong prior": prb.Reweighted(POINTS),
    "Resimulated": prb.Resimulated(POINTS),
    "black box": prb.Resimulated(POINTS),
    "Fresh": prb.Fresh(POINTS),
}


@cache
def model_of(name: str) -> tuple[pm.Model, Node]:
    return build(
        PROPAGATIONS[name], RESPONSES[name], prior=(1.8, 0.08) if name == "strong prior" else (2, 1)
    )


@cache
def reference(name: str) -> dict[str, tuple[float, float]]:
    """Posterior mean and sd on a grid, for the same node; Fresh has that of Resimulated, blurred by its noise."""
    evaluator = Evaluator.of(model_of("Resimulated" if name == "Fresh" else name)[0])
    grid = np.stack(np.meshgrid(np.linspace(1.5, 2.5, 41), np.linspace(-1, 0.4, 41)), -1).reshape(
        -1, 2
    )
    found = evaluator(grid)
    logs = found.log_prior + found.log_likelihood(evaluator.epsilon)
    w = np.exp(logs - logs.max())
    w /= w.sum()
    out = {}
    for key, values in {"mu": grid[:, 0], "sigma": np.exp(grid[:, 1])}.items():
        mean = float(w @ values)
        out[key] = (mean, float(np.sqrt(w @ (values - mean) ** 2)))
    return out


def nuts(model: pm.Model) -> Any:
    return pm.sample(
        200,
        tune=200,
        chains=2,
        cores=1,
        model=model,
        random_seed=1,
        compute_convergence_checks=False,
        **QUIET,
    )


def find_map(model: pm.Model) -> Any:
    return pm.find_MAP(
        model=model,
        return_inferencedata=True,
        jitter=False,
        compile_kwargs={"mode": PLAIN},
        **QUIET,
    )


def stock_smc(model: pm.Model, kernel: Any = pm.smc.IMH, cores: int = 1) -> Any:
    return pm.sample_smc(
        200,
        kernel=kernel,
        chains=2,
        cores=cores,
        model=model,
        random_seed=2,
        compute_convergence_checks=False,
        **QUIET,
    )


def own_smc(model: pm.Model) -> Any:
    return prb.sample_smc(300, chains=2, model=model, adjustment=None, random_seed=3, **QUIET)


SAMPLERS: dict[str, Callable[[pm.Model], Any]] = {
    "NUTS": nuts,
    "stock SMC": stock_smc,
    "stock SMC, two cores": lambda model: stock_smc(model, cores=2),
    "batched kernel": lambda model: stock_smc(model, prb.posterior.BatchedKernel),
    "batched kernel, two cores": lambda model: stock_smc(
        model, prb.posterior.BatchedKernel, cores=2
    ),
    "prbayes SMC": own_smc,
}


@cache
def draws_of(name: str, sampler: str) -> Any:
    return SAMPLERS[sampler](model_of(name)[0])


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "sampler"),
    [
        ("Reweighted", "NUTS"),
        pytest.param("Reweighted", "stock SMC, two cores", marks=pytest.mark.slow),
        ("Reweighted", "batched kernel, two cores"),
        ("Reweighted", "prbayes SMC"),
        ("strong prior", "batched kernel"),
        ("strong prior", "prbayes SMC"),
        ("Resimulated", "NUTS"),
        ("Resimulated", "stock SMC"),
        ("Resimulated", "batched kernel"),
        ("Resimulated", "prbayes SMC"),
        pytest.param("black box", "stock SMC", marks=pytest.mark.slow),
        ("black box", "batched kernel"),
        ("black box", "prbayes SMC"),
        pytest.param("Fresh", "stock SMC", marks=pytest.mark.slow),
        ("Fresh", "batched kernel"),
        ("Fresh", "prbayes SMC"),
    ],
)
def test_samplers_find_the_posterior(name: str, sampler: str) -> None:
    idata = draws_of(name, sampler)
    assert ("diverging" in idata.sample_stats) == (sampler == "NUTS")
    if sampler == "NUTS":
        assert int(idata.sample_stats["diverging"].sum()) <= 2
    for key, (mean, sd) in reference(name).items():
        draws = idata.posterior[key].values
        assert draws.shape[0] == 2
        blur = 1.8 if name == "Fresh" else 1.0
        assert abs(draws.mean() - mean) < 0.4 * sd * blur, key
        assert 0.7 < draws.std() / sd < 1.35 * blur, key


@pytest.mark.long
@pytest.mark.parametrize("name", ["Reweighted", "strong prior", "Resimulated", "black box"])
def test_find_map_agrees_with_minimize(name: str) -> None:
    model = model_of(name)[0]
    optimum = prb.minimize(model, prior=True).point
    warns = (
        pytest.warns(UserWarning, match="Gradient not available")
        if name == "black box"
        else nullcontext()
    )
    with warns:
        found = find_map(model).posterior
    for key, (_, sd) in reference(name).items():
        np.testing.assert_allclose(found[key].item(), optimum[key], atol=0.1 * sd)


@pytest.mark.slow
def test_a_black_box_gets_slice_steps_from_stock_sampling() -> None:
    model = model_of("black box")[0]
    idata = pm.sample(
        60,
        tune=20,
        chains=1,
        cores=1,
        model=model,
        random_seed=1,
        compute_convergence_checks=False,
        **QUIET,
    )
    assert "diverging" not in idata.sample_stats
    for key, (mean, sd) in reference("black box").items():
        assert abs(float(idata.posterior[key].mean()) - mean) < 0.6 * sd, key


@pytest.mark.parametrize("sampler", [nuts, find_map, prb.minimize])
def test_fresh_is_refused_where_gradients_are_needed(sampler: Callable[[pm.Model], Any]) -> None:
    with pytest.raises(TypeError, match=r"y: prb.Fresh draws new .*use .*prb.Re"):
        sampler(model_of("Fresh")[0])


def test_fresh_with_an_epsilon_for_the_run() -> None:
    model, node = build(prb.Fresh(POINTS), epsilon=None)
    settings = {"model": model, "adjustment": None, "random_seed": 1, **QUIET}
    idata = prb.sample_smc(100, chains=1, epsilon=EPSILON, **settings)
    assert abs(float(idata.posterior["mu"].mean()) - MU) < 0.1
    assert float(idata.calibration["epsilon"][0]) == EPSILON
    assert np.isnan(node.epsilon_value)
    with pytest.raises(TypeError, match=r"y: prb.Fresh .*Nelder-Mead"):
        prb.sample_smc(100, **settings)


# Predictive sampling.


@cache
def predictive(name: str, kind: str, seed: int = 1) -> Floats:
    """Data sets, shape (draws, N)."""
    model = model_of(name)[0]
    if kind == "prior":
        group = pm.sample_prior_predictive(40, model=model, random_seed=seed).prior_predictive
    else:
        few = draws_of(name, "prbayes SMC").isel(draw=slice(0, 40))
        group = pm.sample_posterior_predictive(
            few, model=model, random_seed=seed, **QUIET
        ).posterior_predictive
    assert group["y"].dims[:2] == ("chain", "draw")
    return np.asarray(group["y"].values.reshape(-1, N))


@pytest.mark.parametrize("kind", ["prior", "posterior"])
@pytest.mark.parametrize("name", ["Reweighted", "Resimulated", "Fresh"])
def test_predictive_draws_are_different_specimens(name: str, kind: str) -> None:
    stored = model_of(name)[1].bound.n_points
    sets = predictive(name, kind)
    assert sets.shape == ((40, N) if kind == "prior" else (80, N))
    within, between = sets.std(axis=1, ddof=1), sets.mean(axis=1).std()
    assert (within > 0).all()
    if kind == "prior":
        np.testing.assert_allclose(within.mean(), 0.75 * np.sqrt(2 / np.pi), rtol=0.2)
        np.testing.assert_allclose(between, 0.75, rtol=0.25)
    else:
        np.testing.assert_allclose(within.mean(), 0.75 * SIGMA, rtol=0.08)
        np.testing.assert_allclose(sets.mean(), 0.75 * MU, atol=0.06)
        assert 0.75 * SIGMA / np.sqrt(N) * 0.7 < between < 0.75 * SIGMA / np.sqrt(N) * 2
    # Neither a repeated data set, nor an order: specimen i is no better than specimen j.
    assert len(np.unique(sets[:, 0])) > 1
    assert len(np.unique(sets.mean(axis=1))) == len(sets)
    inside = sets - sets.mean(axis=1, keepdims=True)
    assert abs(stats.spearmanr(np.tile(np.arange(N), len(sets)), inside.ravel()).statistic) < 0.1
    if name == "Reweighted":
        assert RESPONSES["Reweighted"].count == stored == POINTS
        assert np.isin(sets, model_of(name)[1].bound.design.sample.values).all()


@pytest.mark.long
@pytest.mark.parametrize("name", ["Reweighted", "Resimulated"])
def test_the_same_seed_gives_the_same_prediction(name: str) -> None:
    first = predictive(name, "prior")
    predictive.cache_clear()
    np.testing.assert_array_equal(predictive(name, "prior"), first)
    assert not np.array_equal(predictive(name, "prior", seed=2), first)


@pytest.mark.long
def test_reweighted_calls_the_response_n_times_in_all() -> None:
    for sampler in ("NUTS", "stock SMC, two cores", "batched kernel, two cores", "prbayes SMC"):
        draws_of("Reweighted", sampler)
    model, node = model_of("Reweighted")
    optimum = prb.minimize(model)
    assert (
        RESPONSES["Reweighted"].count == node.bound.responses.count == node.bound.n_points == POINTS
    )
    assert (
        optimum.n_responses
        == draws_of("Reweighted", "prbayes SMC").posterior.attrs["n_responses"]
        == POINTS
    )


def test_what_is_seen_of_the_data_at_once_is_told(caplog: pytest.LogCaptureFixture) -> None:
    def simulate(observed: Any, specimens: Any = None) -> None:
        with pm.Model() as model:
            x = pm.Normal.dist(pm.Normal("mu", 0, 1), 1.0)
            prb.Simulator(
                "y",
                np.exp,
                x,
                metric=prb.AreaMetric(),
                observed=observed,
                specimens=specimens,
                propagation=prb.Reweighted(64),
            )
        told.append(caplog.text)
        first_use(model)

    told: list[str] = []
    measured = np.random.default_rng(0).normal(size=10)
    simulate(-1.0 - np.abs(measured))
    assert "y: got observed values from -" in caplog.text
    assert not told[0], "what is known of responses is told at the first use"
    caplog.clear()
    twice = np.exp(np.tile(measured, 2))
    simulate(twice, np.tile(np.arange(10), 2))
    assert "different" not in caplog.text
    simulate(twice)
    assert "y: got 20 observed values of which only 10 are different" in told[-1]


@pytest.mark.parametrize("response", [line, BlackBox()])
def test_resimulated_counts_its_responses(response: Any) -> None:
    model, node = build(prb.Resimulated(64), response)
    assert node.bound.symbolic == (response is line)
    evaluator, before = Evaluator.of(model), node.bound.responses.count
    evaluator(np.zeros((5, 2)))
    evaluator.populations(np.zeros((2, 2)), 0)
    assert node.bound.responses.count - before == 7 * 64
    if response is not line:
        assert node.bound.responses.count == response.count


# Samplers that compile the log-density with other backends: nutpie, and NumPyro through PyMC's JAX
# backend.

OF_OTHERS = [
    prb.AreaMetric(),
    prb.ProbabilityResidual(),
    prb.KullbackLeibler(),
    prb.LogLikelihood(density=prb.GaussianKDE()),
]


@pytest.mark.filterwarnings(
    "ignore::DeprecationWarning", "ignore::FutureWarning", "ignore::UserWarning"
)
@pytest.mark.parametrize("metric", OF_OTHERS, ids=lambda m: type(m).__name__)
@pytest.mark.parametrize("sampler", ["nutpie", "numpyro"])
def test_the_posterior_is_that_of_sample_smc(sampler: str, metric: prb.Metric) -> None:
    pytest.importorskip(sampler)
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1))
        observed = np.random.default_rng(0).normal(2, 1, 50)
        prb.Simulator(
            "y",
            lambda x: 2 * x,
            x,
            metric=metric,
            observed=observed,
            epsilon=0.05,
            propagation=prb.Reweighted(256),
        )
        nuts = pm.sample(
            700, tune=500, chains=2, nuts_sampler=sampler, random_seed=1, progressbar=False
        )
    smc = prb.sample_smc(
        1000, chains=2, model=model, adjustment=None, random_seed=1, progressbar=False
    )
    for name in ("mu", "sigma"):
        sd = float(smc.posterior[name].std())
        # Means of several hundred effective draws each: a standard error of .05 sd; sds to 4%.
        assert abs(float(nuts.posterior[name].mean() - smc.posterior[name].mean())) < 0.25 * sd
        np.testing.assert_allclose(nuts.posterior[name].std(), sd, rtol=0.2)


@pytest.mark.long
@pytest.mark.parametrize("propagation", [prb.Reweighted(64), prb.Resimulated(64)])
def test_simulators_of_submodels_have_names_and_variables_of_their_own(propagation: Any) -> None:
    observed = np.linspace(0, 2, 20)
    with pm.Model() as parent:
        mu, sigma = pm.Normal("mu", 1, 1), pm.HalfNormal("sigma", 1)
        for name, scale in (("one", 1.0), ("two", 2.0)):
            with pm.Model(name=name) as child:
                own = pm.Normal.dist(mu, sigma)
                prb.Simulator(
                    "y",
                    lambda x, scale=scale: scale * x,
                    own,
                    metric=prb.AreaMetric(),
                    observed=scale * observed,
                    propagation=propagation,
                )
    optimum = prb.minimize(parent)
    assert list(optimum.discrepancies) == ["one::y", "two::y"]
    assert optimum.point["mu"] == pytest.approx(1, abs=0.05)
    # Within a submodel the whole is meant.
    with child:
        assert prb.minimize().point == pytest.approx(optimum.point, abs=0.01)


def test_single_precision_is_refused_before_the_response_is_computed() -> None:
    with config.change_flags(floatX="float32"), pm.Model():
        x = pm.Normal.dist(pm.Normal("mu"), 1.0)
        with pytest.raises(TypeError, match=r"got hyperparameters of float32, expected float64"):
            prb.Simulator("y", lambda x: 1 / 0, x, metric=prb.AreaMetric(), observed=[1.0, 2.0])
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", dtype="float32"), 1.0)
        with pytest.raises(TypeError, match=r"y: mu: got hyperparameters of float32"):
            prb.Simulator("y", lambda x: 1 / 0, x, metric=prb.AreaMetric(), observed=[1.0, 2.0])
        x = pm.Normal.dist(pm.Normal("nu"), 1.0)
        prb.Simulator("z", np.positive, x, metric=prb.AreaMetric(), observed=[1.0, 2.0])
    with pytest.raises(TypeError, match=r"model: mu: got hyperparameters of float32"):
        prb.minimize(model)


@pytest.mark.parametrize(
    "metric",
    [prb.AreaMetric(), prb.ProbabilityResidual(), prb.LogLikelihood(density=prb.GaussianKDE())],
)
def test_a_reweighted_log_density_is_the_same_compiled_by_jax(metric: prb.Metric) -> None:
    pytest.importorskip("jax")
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1, 1), pm.HalfNormal("sigma", 1))
        prb.Simulator(
            "y",
            np.positive,
            x,
            metric=metric,
            observed=np.linspace(0, 2, 9),
            epsilon=0.1,
            propagation=prb.Reweighted(64),
        )
    point = model.initial_point()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = model.compile_logp(mode="JAX")(point)
        gradient = model.compile_dlogp(mode="JAX")(point)
    assert float(found) == pytest.approx(float(model.compile_logp(mode=PLAIN)(point)), rel=1e-10)
    np.testing.assert_allclose(gradient, model.compile_dlogp(mode=PLAIN)(point), rtol=1e-8)


# Labels of specimens.


def _labelled(*labels: Any) -> pm.Model:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
        for name, own in zip("yz", labels, strict=False):
            prb.Simulator(
                name, line, x, metric=prb.AreaMetric(), observed=np.arange(3.0), specimens=own,
                propagation=prb.Reweighted(64),
            )  # fmt: skip
    return model


def test_labels_that_only_look_the_same_are_refused() -> None:
    with pytest.raises(TypeError, match=r"z: specimens: got the label '0' and, in y, 0, expected"):
        _labelled([0, 1, 2], ["0", "1", "2"])
    with pytest.raises(TypeError, match=r"y: specimens: got the label '1' and, in y, 1"):
        _labelled(np.array([0, 1, "1"], dtype=object))
    with pytest.raises(ValueError, match=r"z: specimens: got bytes b'a' as a label, expected"):
        _labelled(["a", "b", "c"], [b"a", b"b", b"c"])
    with pytest.raises(ValueError, match="y: specimens: got float nan as a label"):
        _labelled([0.0, np.nan, 2.0])


def test_labels_of_equal_numbers_are_the_same() -> None:
    _labelled([0, 1, 2], [0.0, 1.0, 3.0])
    _labelled(["a", "b", "c"], np.array(["c", "d", "e"], dtype=object))


def two_of_one(propagation: Propagation, second: Any = None) -> tuple[pm.Model, list[int]]:
    """Return a model whose two simulators have one response, and the sizes of its calls."""
    asked: list[int] = []

    def response(x: Any, z: float) -> Any:
        x = np.asarray(x, dtype=np.float64)  # no PyTensor variables
        if x.size > 1:  # one specimen by itself is no run
            asked.append(x.size)
        return z * x

    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 2, 1), pm.HalfNormal("sigma", 1))
        observed = np.linspace(1.0, 3.0, 20)
        common = {"observed": observed, "propagation": propagation}
        prb.Simulator("a", response, x, 1.0, metric=prb.AreaMetric(), **common)
        prb.Simulator("b", response, x, second or 1.0, metric=prb.KullbackLeibler(), **common)
    return model, asked


def test_simulators_of_one_response_share_their_design_s_runs() -> None:
    model, asked = two_of_one(prb.Reweighted(128))
    assert not asked
    first_use(model)
    assert asked == [128]
    first, second = Evaluator.of(model).nodes
    np.testing.assert_array_equal(
        first.reweighted.design.sample.values, second.reweighted.design.sample.values
    )
    narrow = np.array([[2.0, np.log(0.05)]])
    prb.refine(model, thetas=narrow)
    assert first.bound.n_points == second.bound.n_points > 128
    assert sum(asked) == first.bound.n_points
    assert prb.minimize(model, progressbar=False).search.n_computed == sum(asked)


@pytest.mark.parametrize("propagation", [prb.Resimulated(128), prb.Fresh(128)])
def test_simulators_of_one_response_share_a_population_s_runs(propagation: Propagation) -> None:
    model, asked = two_of_one(propagation)
    first_use(model)
    assert sum(size for size in asked if size == 16) == 16  # tried once
    before = len(asked)
    evaluator = Evaluator.of(model)
    found = evaluator(evaluator.hyperparameters.prior_thetas(3, 0))
    assert asked[before:] == [3 * 128]
    assert np.isfinite(found.discrepancies).all()


@pytest.mark.parametrize("propagation", [prb.Reweighted(64), prb.Resimulated(64), prb.Fresh(64)])
def test_another_constant_is_another_run(propagation: Propagation) -> None:
    model, _ = two_of_one(propagation, second=3.0)
    evaluator = Evaluator.of(model)
    theta = evaluator.hyperparameters.unconstrained({"mu": 2.0, "sigma": 0.5})[None]
    means = []
    for k in range(2):
        values, weights = evaluator.populations(theta, k)
        means.append((values * weights).sum())
    assert means[1] == pytest.approx(3 * means[0], rel=1e-9)


def test_shared_runs_give_what_each_would_have_computed() -> None:
    model, _ = two_of_one(prb.Fresh(128))
    evaluator = Evaluator.of(model)
    thetas = evaluator.hyperparameters.prior_thetas(4, 1)
    together = evaluator(thetas).discrepancies
    alone, _ = two_of_one(prb.Fresh(128), second=1.0)
    evaluator = Evaluator.of(alone)
    for k in (1, 0):
        np.testing.assert_array_equal(evaluator.discrepancies(thetas, k), together[:, k])
