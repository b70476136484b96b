"""Propagations times samplers: every route has the same posterior of the same model."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import arviz as az
import numpy as np
import pandas as pd
import pymc as pm
import pytest
from first_use import first_use
from line_problem import MU, POINTS, QUIET, SIGMA, N, build, line
from pytensor import config
from scipy import stats

import prbayes as prb
from prbayes._validate import Floats
from prbayes.model.evaluator import Evaluator, epsilons
from prbayes.model.random_variable import Node, simulators
from prbayes.propagation.base import Propagation
from prbayes.response.compile import PLAIN

AREA = prb.AreaMetric()


@dataclass
class BlackBox:
    """A response outside PyTensor that counts its values; a specimen by itself is no run."""

    count: int = 0

    def __call__(self, x: Any) -> Any:
        values = np.asarray(x, dtype=np.float64)
        self.count += values.size if values.size > 1 else 0
        return 0.75 * values


MODELS: dict[str, tuple[Propagation, Any]] = {
    "Reweighted": (prb.Reweighted(POINTS), BlackBox()),
    "Resimulated": (prb.Resimulated(POINTS), line),
    "black box": (prb.Resimulated(POINTS), BlackBox()),
    "Fresh": (prb.Fresh(POINTS), BlackBox()),
}


@cache
def model_of(name: str) -> tuple[pm.Model, Node]:
    return build(*MODELS[name])


@cache
def reference(name: str) -> dict[str, tuple[float, float]]:
    """Return posterior mean and sd on a grid; Fresh has those of Resimulated with noise."""
    evaluator = Evaluator.of(model_of("Resimulated" if name == "Fresh" else name)[0])
    axes = np.meshgrid(np.linspace(1.5, 2.5, 41), np.linspace(-1, 0.4, 41))
    grid = np.stack(axes, -1).reshape(-1, 2)
    terms = evaluator(grid)
    logs = terms.log_prior + terms.log_likelihood(epsilons(evaluator))
    w = np.exp(logs - logs.max())
    w /= w.sum()
    result = {}
    for key, values in {"mu": grid[:, 0], "sigma": np.exp(grid[:, 1])}.items():
        mean = float(w @ values)
        result[key] = (mean, float(np.sqrt(w @ (values - mean) ** 2)))
    return result


STOCK: dict[str, Any] = {"compute_convergence_checks": False, **QUIET}


def nuts(model: pm.Model, draws: int = 200, tune: int = 200, chains: int = 2) -> Any:
    settings = {"tune": tune, "chains": chains, "cores": 1, "random_seed": 1}
    return pm.sample(draws, model=model, **settings, **STOCK)


def find_map(model: pm.Model) -> Any:
    settings = {"jitter": False, "compile_kwargs": {"mode": PLAIN}, **QUIET}
    return pm.find_MAP(model=model, return_inferencedata=True, **settings)


def stock_smc(model: pm.Model, kernel: Any = pm.smc.IMH, cores: int = 1) -> Any:
    settings = {"chains": 2, "cores": cores, "random_seed": 2}
    return pm.sample_smc(200, kernel=kernel, model=model, **settings, **STOCK)


def own_smc(model: pm.Model) -> Any:
    return prb.sample_smc(300, chains=2, model=model, adjustment=None, random_seed=3, **QUIET)


KERNEL = prb.posterior.BatchedKernel
SAMPLERS: dict[str, Callable[[pm.Model], Any]] = {
    "NUTS": nuts,
    "stock SMC": stock_smc,
    "batched kernel": partial(stock_smc, kernel=KERNEL),
    "batched kernel, two cores": partial(stock_smc, kernel=KERNEL, cores=2),
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
        ("Reweighted", "batched kernel, two cores"),
        ("Resimulated", "stock SMC"),
        ("black box", "batched kernel"),
        ("Fresh", "prbayes SMC"),
    ],
)
def test_samplers_have_the_posterior_of_the_grid(name: str, sampler: str) -> None:
    idata = draws_of(name, sampler)
    assert ("diverging" in idata.sample_stats) == (sampler == "NUTS")
    if sampler == "NUTS":
        assert int(idata.sample_stats["diverging"].sum()) <= 2
    noise = 1.8 if name == "Fresh" else 1.0
    for key, (mean, sd) in reference(name).items():
        draws = idata.posterior[key].values
        assert draws.shape[0] == 2
        assert abs(draws.mean() - mean) < 0.4 * sd * noise, key
        assert 0.7 < draws.std() / sd < 1.35 * noise, key


@pytest.mark.parametrize("sampler", [nuts, find_map, prb.minimize])
def test_fresh_is_refused_by_methods_with_gradients(sampler: Callable[[pm.Model], Any]) -> None:
    with pytest.raises(TypeError, match=r"y: prb.Fresh draws new .*use .*prb.Re"):
        sampler(model_of("Fresh")[0])


# Predictive sampling.


@cache
def predictive(name: str, kind: str) -> Floats:
    """Return data sets, shape (draws, N)."""
    quick = {"model": model_of(name)[0], "random_seed": 1, "compile_kwargs": {"mode": PLAIN}}
    if kind == "prior":
        drawn = pm.sample_prior_predictive(40, **quick)
        group = drawn.prior_predictive
    else:
        posterior = az.from_dict({"posterior": {"mu": np.full((2, 40), MU),
                                                "sigma": np.full((2, 40), SIGMA)}})  # fmt: skip
        drawn = pm.sample_posterior_predictive(posterior, **quick, **QUIET)
        group = drawn.posterior_predictive
    assert group["y"].dims[:2] == ("chain", "draw")
    return np.asarray(group["y"].values.reshape(-1, N))


@pytest.mark.parametrize("kind", ["prior", "posterior"])
@pytest.mark.parametrize("name", ["Reweighted", "Resimulated", "Fresh"])
def test_predictive_draws_are_different_specimens(name: str, kind: str) -> None:
    sets = predictive(name, kind)
    assert sets.shape == ((40, N) if kind == "prior" else (80, N))
    within, between = sets.std(axis=1, ddof=1), sets.mean(axis=1).std()
    assert (within > 0).all()
    if kind == "prior":
        np.testing.assert_allclose(within.mean(), 0.75 * np.sqrt(2 / np.pi), rtol=0.2)
        np.testing.assert_allclose(between, 0.75, rtol=0.25)
    else:
        error = 0.75 * SIGMA / np.sqrt(N)
        np.testing.assert_allclose(within.mean(), 0.75 * SIGMA, rtol=0.08)
        np.testing.assert_allclose(sets.mean(), 0.75 * MU, atol=0.06)
        # Standard error of a standard deviation of 80 data sets: 8 %
        assert between == pytest.approx(error, rel=0.4)
    # No data set is repeated, and specimens are in no order.
    assert len(np.unique(sets[:, 0])) > 1
    assert len(np.unique(sets.mean(axis=1))) == len(sets)
    inside = sets - sets.mean(axis=1, keepdims=True)
    assert abs(stats.spearmanr(np.tile(np.arange(N), len(sets)), inside.ravel()).statistic) < 0.1
    if name == "Reweighted":
        bound = model_of(name)[1].bound
        # 17 specimens are computed again in another order.
        assert MODELS[name][1].count == bound.n_points + 17 == POINTS + 17
        assert np.isin(sets, bound.design.sample.values).all()


@pytest.mark.parametrize("response", [line, BlackBox()])
def test_resimulated_counts_its_responses(response: Any) -> None:
    model, node = build(prb.Resimulated(64), response)
    assert node.bound.symbolic == (response is line)
    evaluator, before = Evaluator.of(model), node.responses.count
    evaluator(np.zeros((5, 2)))
    evaluator.populations(np.zeros((2, 2)), 0)
    assert node.responses.count - before == 7 * 64
    if response is not line:
        assert node.responses.count == response.count


def test_findings_on_the_data_are_reported(caplog: pytest.LogCaptureFixture) -> None:
    def texts(observed: Any, specimens: Any = None) -> tuple[str, str]:
        """Return what is reported when the model is written, and by the first use."""
        caplog.clear()
        with pm.Model() as model:
            x = pm.Normal.dist(pm.Normal("mu", 0, 1), 1.0)
            given = {"observed": observed, "specimens": specimens}
            prb.Simulator("y", np.exp, x, metric=AREA, propagation=prb.Reweighted(64), **given)
        written = caplog.text
        first_use(model)
        return written, caplog.text

    measured = np.random.default_rng(0).normal(size=10)
    written, used = texts(-1.0 - np.abs(measured))
    assert not written
    assert "y: got observed values from -" in used
    twice = np.exp(np.tile(measured, 2))
    assert "different" not in texts(twice, np.tile(np.arange(10), 2))[1]
    assert "y: got 20 observed values of which only 10 are different" in texts(twice)[0]


# Other backends: nutpie, NumPyro and JAX.


@pytest.mark.filterwarnings(
    "ignore::DeprecationWarning", "ignore::FutureWarning", "ignore::UserWarning"
)
@pytest.mark.parametrize(
    ("sampler", "metric"),
    [
        ("nutpie", AREA),
        ("nutpie", prb.KullbackLeibler()),
        ("numpyro", prb.ProbabilityResidual()),
        ("numpyro", prb.LogLikelihood(density=prb.GaussianKDE())),
    ],
)
def test_samplers_of_other_packages_have_the_posterior(sampler: str, metric: prb.Metric) -> None:
    pytest.importorskip(sampler)
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1))
        given = {"observed": np.random.default_rng(0).normal(2, 1, 50), "epsilon": 0.05}
        design = prb.Reweighted(256)
        prb.Simulator("y", lambda x: 2 * x, x, metric=metric, propagation=design, **given)
        chains: dict[str, Any] = {"chains": 2, "random_seed": 1, "progressbar": False}
        found = pm.sample(700, tune=500, nuts_sampler=sampler, **chains)
    smc = prb.sample_smc(1000, model=model, adjustment=None, **chains)
    for name in ("mu", "sigma"):
        sd = float(smc.posterior[name].std())
        # Means of several hundred effective draws each: a standard error of .05 sd; sds to 4%.
        assert abs(float(found.posterior[name].mean() - smc.posterior[name].mean())) < 0.25 * sd
        np.testing.assert_allclose(found.posterior[name].std(), sd, rtol=0.2)


@pytest.mark.parametrize(
    "metric", [AREA, prb.ProbabilityResidual(), prb.LogLikelihood(density=prb.GaussianKDE())]
)
def test_the_log_density_is_the_same_by_jax(metric: prb.Metric) -> None:
    pytest.importorskip("jax")
    model, _ = build(prb.Reweighted(64), metric=metric)
    point = model.initial_point()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = model.compile_logp(mode="JAX")(point)
        gradient = model.compile_dlogp(mode="JAX")(point)
    assert float(found) == pytest.approx(float(model.compile_logp(mode=PLAIN)(point)), rel=1e-10)
    np.testing.assert_allclose(gradient, model.compile_dlogp(mode=PLAIN)(point), rtol=1e-8)


# Arguments.


@pytest.mark.long
def test_simulators_of_submodels_have_their_own_names() -> None:
    observed = np.linspace(0, 2, 20)
    with pm.Model() as parent:
        mu, sigma = pm.Normal("mu", 1, 1), pm.HalfNormal("sigma", 1)
        for name, scale in (("one", 1.0), ("two", 2.0)):
            with pm.Model(name=name) as child:
                x, response = pm.Normal.dist(mu, sigma), partial(np.multiply, scale)
                given = {"metric": AREA, "observed": scale * observed}
                prb.Simulator("y", response, x, propagation=prb.Reweighted(64), **given)
    optimum = prb.minimize(parent)
    assert list(optimum.discrepancies) == ["one::y", "two::y"]
    assert optimum.point["mu"] == pytest.approx(1, abs=0.05)
    with child:  # the whole model counts
        assert prb.minimize().point == pytest.approx(optimum.point, abs=0.01)


def test_single_precision_is_refused_before_any_response() -> None:
    given = {"metric": AREA, "observed": [1.0, 2.0]}
    with config.change_flags(floatX="float32"), pm.Model():
        x = pm.Normal.dist(pm.Normal("mu"), 1.0)
        with pytest.raises(TypeError, match=r"got hyperparameters of float32, expected float64"):
            prb.Simulator("y", lambda x: 1 / 0, x, **given)
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", dtype="float32"), 1.0)
        with pytest.raises(TypeError, match=r"y: mu: got hyperparameters of float32"):
            prb.Simulator("y", lambda x: 1 / 0, x, **given)
        prb.Simulator("z", np.positive, pm.Normal.dist(pm.Normal("nu"), 1.0), **given)
    with pytest.raises(TypeError, match=r"model: mu: got hyperparameters of float32"):
        prb.minimize(model)


@pytest.mark.parametrize(
    ("labels", "message"),
    [
        (([0, 1, 2], ["0", "1", "2"]), r"z: specimens: got the label '0' and, in y, 0, expected"),
        ([np.array([0, 1, "1"], dtype=object)], r"y: specimens: got the label '1' and, in y, 1"),
        ((list("abc"), [b"a", b"b", b"c"]), r"z: specimens: got bytes b'a' as a label, expected"),
        ([[0.0, np.nan, 2.0]], "y: specimens: got float nan as a label"),
        (([0, 1, 2], [0.0, 1.0, 3.0]), None),
        ((["a", "b", "c"], np.array(["c", "d", "e"], dtype=object)), None),
    ],
)
def test_labels_that_only_look_the_same_are_refused(labels: Any, message: str | None) -> None:
    refusal = pytest.raises((TypeError, ValueError), match=message) if message else nullcontext()
    with pm.Model(), refusal:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
        for name, specimens in zip("yz", labels, strict=False):
            given = {"metric": AREA, "observed": np.arange(3.0), "specimens": specimens}
            prb.Simulator(name, line, x, propagation=prb.Reweighted(64), **given)


# Simulators of one response.


def two_of_one(propagation: Propagation) -> tuple[pm.Model, list[int]]:
    """Return a model whose two simulators have one response, and the sizes of its calls."""
    sizes: list[int] = []

    def response(x: Any) -> Any:
        x = np.asarray(x, dtype=np.float64)
        if x.size > 1:  # a specimen by itself is no run
            sizes.append(x.size)
        return x

    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 2, 1), pm.HalfNormal("sigma", 1))
        given = {"observed": np.linspace(1.0, 3.0, 20), "propagation": propagation}
        prb.Simulator("a", response, x, metric=AREA, **given)
        prb.Simulator("b", response, x, metric=prb.KullbackLeibler(), **given)
    return model, sizes


def test_simulators_of_one_response_share_the_runs_of_their_design() -> None:
    model, sizes = two_of_one(prb.Reweighted(128))
    assert not sizes
    first, second = first_use(model).values()
    # Some are computed again in another order, then three, as files might have changed.
    assert sizes == [128, 17, 3]
    values = [node.reweighted.design.sample.values for node in (first, second)]
    np.testing.assert_array_equal(*values)
    prb.refine(model, thetas=np.array([[2.0, np.log(0.05)]]))
    assert first.bound.n_points == second.bound.n_points > 128
    assert Evaluator.of(model).n_responses == first.bound.n_points
    # Nor are those of the refinement counted.
    assert sum(sizes) == first.bound.n_points + 17 + 3


@pytest.mark.parametrize("propagation", [prb.Resimulated(128), prb.Fresh(128)])
def test_simulators_of_one_response_share_the_runs_of_a_population(
    propagation: Propagation,
) -> None:
    model, sizes = two_of_one(propagation)
    first_use(model)
    assert sizes.count(16) == 1  # the first runs
    before = len(sizes)
    evaluator = Evaluator.of(model)
    thetas = evaluator.hyperparameters.prior_thetas(3, 0)
    together = evaluator(thetas).discrepancies
    assert sizes[before:] == [3 * 128]
    assert np.isfinite(together).all()
    separate = Evaluator.of(two_of_one(propagation)[0])
    for k in (1, 0):
        np.testing.assert_allclose(separate.discrepancies(thetas, k), together[:, k], rtol=1e-12)


def test_functions_of_a_wrong_shape_are_refused_before_any_run() -> None:
    def refused(metric: Any, match: str, observed: Any = Y) -> None:
        with pm.Model() as model:
            x = pm.Normal.dist(pm.Normal("mu"), 1.0)
            with pytest.raises(ValueError, match=match):
                prb.Simulator("y", np.positive, x, metric=metric, observed=observed)
        assert "y" not in model.named_vars

    def scalar(s: Any, o: Any) -> Any:
        return np.concatenate([s, o]).mean()

    def total(s: Any, o: Any, w: Any = None) -> Any:
        return abs(s.mean() - o.mean())

    got = r"the function got simulated \(2, 20\), observed \(20,\)"
    refused(
        prb.FunctionMetric(scalar), rf"y: FunctionMetric: .*ValueError: all the.*; {got}, expec"
    )
    refused(prb.FunctionMetric(total), rf"y: .* result of shape \(\): {got}, expected .* \(2,\)")
    weighted = prb.FunctionMetric(total, weighted=True)
    refused(weighted, r"observed \(20,\), weights \(2, 20\), expected")
    refused(prb.FunctionMetric(lambda s: s.mean(-1)), "raised TypeError: .*takes 1 positional")
    pair = np.stack([Y, Y**2], axis=1)
    refused(prb.Joint(prb.FunctionMetric(scalar)), f"ValueError: all the.*{got}", pair)


Y = np.random.default_rng(3).normal(1, 0.5, 20)


def test_weights_and_specimens_are_matched_by_their_index() -> None:
    observed = pd.Series(Y, index=[f"s{i}" for i in range(20)])
    weights = pd.Series(np.arange(1.0, 21), index=observed.index)
    with pm.Model() as model:
        mu = pm.Normal("mu")
        x, x_b, x_c = (pm.Normal.dist(mu, 1.0) for _ in range(3))
        data = {"metric": prb.KullbackLeibler(), "observed": observed}
        prb.Simulator("a", np.positive, x, weights=weights[::-1], **data)
        labels = pd.Series(list(observed.index), index=observed.index)
        prb.Simulator("b", np.positive, x_b, specimens=labels[::-1], **data)
        other = weights.rename(index={"s0": "t0"})
        with pytest.raises(ValueError, match=r"c: weights: got .*expected that of observed"):
            prb.Simulator("c", np.positive, x_c, weights=other, **data)
    a, b = simulators(model).values()
    np.testing.assert_allclose(a.target.weights, weights / weights.sum())
    assert b.specimens.tolist() == list(observed.index)
