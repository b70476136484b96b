"""Simulators in clones, copies and unpickled models: the same problem, and nothing shared that one may change."""

from __future__ import annotations

import copy
import pickle
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import cloudpickle
import numpy as np
import pymc as pm
import pytensor
import pytensor.tensor as pt
import pytest
from first_use import first_use
from pymc.logprob.utils import ParameterValueError
from pymc.model.fgraph import clone_model
from pymc.model.transform.optimization import freeze_dims_and_data
from pytensor.graph.replace import vectorize_graph
from scipy import stats

import prbayes as prb
from prbayes._validate import Floats
from prbayes.model.evaluator import Evaluator
from prbayes.model.random_variable import Node, SimulatorRV, has_default_epsilon, nodes
from prbayes.propagation.base import Propagation
from prbayes.response.compile import PLAIN

OBSERVED = np.random.default_rng(1).normal(1.5, 0.6, 20)
AT = {"mu": 1.2, "sigma_log__": np.log(0.7)}
THETA = np.array([list(AT.values())])
QUIET = {"progressbar": False}
PROPAGATIONS: dict[str, Propagation] = {
    "Reweighted": prb.Reweighted(64),
    "Resimulated": prb.Resimulated(64),
    "Fresh": prb.Fresh(20_000),
}


def build(propagation: Propagation, epsilon: float | None = 0.1) -> pm.Model:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1, 1), pm.HalfNormal("sigma", 1))
        prb.Simulator(
            "y",
            np.positive,
            x,
            metric=prb.AreaMetric(),
            observed=OBSERVED,
            epsilon=epsilon,
            propagation=propagation,
        )
    return model


def node_of(model: pm.Model) -> Node:
    (node,) = nodes(model).values()
    return node


def log_density(model: pm.Model) -> Callable[[dict[str, Any]], float]:
    compiled = model.compile_logp(vars=[model["y"]], mode=PLAIN)
    return lambda at: float(compiled(at))


def by_cloudpickle(model: pm.Model) -> pm.Model:
    return cloudpickle.loads(cloudpickle.dumps(model))


COPIES: dict[str, Callable[[pm.Model], pm.Model]] = {
    "clone": clone_model,
    "copy": copy.copy,
    "deepcopy": copy.deepcopy,
    "freeze": freeze_dims_and_data,
    "cloudpickle": by_cloudpickle,
    "clone of a clone": lambda model: clone_model(clone_model(model)),
    "clone of an unpickled model": lambda model: clone_model(by_cloudpickle(model)),
    "unpickled clone": lambda model: by_cloudpickle(clone_model(model)),
}
each_copy = pytest.mark.parametrize("way", COPIES)


@pytest.mark.parametrize("name", PROPAGATIONS)
def test_conditioned_models_have_the_same_discrepancy(name: str) -> None:
    model = build(PROPAGATIONS[name])
    mu, sigma = AT["mu"], float(np.exp(AT["sigma_log__"]))
    conditioned = {
        "do": (pm.do(model, {"mu": mu}), {"sigma_log__": AT["sigma_log__"]}),
        "observe": (pm.observe(model, {"sigma": sigma}), {"mu": mu}),
        "clone": (clone_model(model), AT),
    }
    expected = Evaluator.of(model)(THETA).discrepancies[0, 0]
    tolerance = {"rtol": 0.1} if name == "Fresh" else {"rtol": 1e-9}
    for clone, at in conditioned.values():
        evaluator = Evaluator.of(clone)
        assert sorted(evaluator.hyperparameters.names) == sorted(at)
        theta = np.array([[at[n] for n in evaluator.hyperparameters.names]])
        found = evaluator(theta).discrepancies[0, 0]
        np.testing.assert_allclose(found, expected, **tolerance)
        np.testing.assert_allclose(log_density(clone)(at), -expected / 0.1, **tolerance)


@pytest.mark.long
@pytest.mark.parametrize(
    "way", [way if " " not in way else pytest.param(way, marks=pytest.mark.slow) for way in COPIES]
)
def test_a_copy_gives_the_same_optimum(way: str) -> None:
    model = build(prb.Reweighted(64))
    other = COPIES[way](model)
    first, second = (prb.minimize(m, starts=0, **QUIET) for m in (model, other))
    # PyMC's clones may order variables, and so the points by which a design grows, in another
    # way: a design is good to a tenth of a standard error.
    for name in ("mu", "sigma"):
        assert abs(first.point[name] - second.point[name]) < 0.1 * first.stderr[name]
        assert first.stderr[name] == pytest.approx(second.stderr[name], rel=0.05)
    assert first.n_responses == second.n_responses


@each_copy
def test_a_copy_shares_nothing_that_changes(way: str) -> None:
    model = build(prb.Reweighted(64))
    other = COPIES[way](model)
    node_of(other)
    mine, its = log_density(model), log_density(other)
    before = mine(AT)
    assert its(AT) == pytest.approx(before, rel=1e-12)
    # Epsilon
    prb.set_epsilon(other, {"y": 0.2})
    assert its(AT) == pytest.approx(before / 2, rel=1e-12)
    assert mine(AT) == before
    prb.set_epsilon(model, {"y": 0.05})
    assert its(AT) == pytest.approx(before / 2, rel=1e-12)
    assert mine(AT) == pytest.approx(2 * before, rel=1e-12)
    # The design, and its count of responses
    bound = node_of(other).reweighted
    assert bound is not None
    bound.add([np.full(4, 1.2), np.full(4, 0.7)])
    assert its(AT) != pytest.approx(before / 2, rel=1e-12)
    assert mine(AT) == pytest.approx(2 * before, rel=1e-12)
    assert (node_of(model).bound.n_points, node_of(other).bound.n_points) == (64, 128)
    assert node_of(model).bound.responses.count == 64


def test_minimize_on_a_conditioned_model_leaves_the_compiled_density_of_the_original_alone() -> (
    None
):
    with pm.Model() as model:
        mu, sigma = pm.Normal("mu", 0, 30), pm.HalfNormal("sigma", 1)
        x = pm.Normal.dist(mu, sigma)
        prb.Simulator(
            "y",
            np.positive,
            x,
            metric=prb.AreaMetric(),
            observed=OBSERVED,
            epsilon=0.1,
            propagation=prb.Reweighted(64),
        )
    compiled = log_density(model)
    before = compiled(AT)
    conditioned = pm.do(model, {"sigma": 0.7})
    prb.minimize(conditioned, starts=0, **QUIET)
    assert node_of(conditioned).bound.n_points > 64, "the design was refined"
    assert compiled(AT) == before
    assert node_of(model).bound.n_points == 64


def test_the_owner_of_a_node_keeps_it() -> None:
    model = build(prb.Reweighted(64))
    node = node_of(model)
    clone = clone_model(model)
    assert node_of(model) is node
    own = node_of(clone)
    assert own is not node
    assert node_of(clone) is own
    assert model["y"].owner.op.simulator is node


def test_counts_of_resimulated_responses_are_apart() -> None:
    model = build(prb.Resimulated(64))
    first = Evaluator.of(model)
    first.populations(THETA, 0)
    count = node_of(model).bound.responses.count
    clone = clone_model(model)
    Evaluator.of(clone).populations(THETA, 0)
    Evaluator.of(clone)(THETA)
    assert node_of(model).bound.responses.count == count
    assert node_of(clone).bound.responses.count == count + 2 * 64


# A process of its own.

SCRIPT = """
import logging, pickle, sys
import numpy as np
with open(sys.argv[1], "rb") as file:
    model = pickle.load(file)
import prbayes as prb, pymc as pm
logging.getLogger("pymc").setLevel(logging.ERROR)
from prbayes.response.compile import PLAIN
quick = {"mode": PLAIN}
at = {"mu": 1.2, "sigma_log__": np.log(0.7)}
print(repr(float(model.compile_logp(vars=[model["y"]], **quick)(at))))
drawn = pm.sample_prior_predictive(3, model=model, random_seed=1, compile_kwargs=quick)
print(repr(float(drawn.prior_predictive["y"].sum())))
prb.set_epsilon(model, {"y": 0.2})
print(repr(float(model.compile_logp(vars=[model["y"]], **quick)(at))))
print(repr(prb.minimize(model, starts=0, progressbar=False).point["mu"]))
"""


@pytest.mark.long
def test_a_model_unpickled_in_a_fresh_process_works_without_any_help(tmp_path: Path) -> None:
    model = build(prb.Reweighted(64))
    file = tmp_path / "model.pkl"
    file.write_bytes(cloudpickle.dumps(model))
    run = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", SCRIPT, str(file)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    density, drawn, halved, mu = map(float, run.stdout.split())
    assert density == pytest.approx(log_density(model)(AT), rel=1e-9)
    quick = {"mode": PLAIN}
    mine = pm.sample_prior_predictive(3, model=model, random_seed=1, compile_kwargs=quick)
    assert drawn == pytest.approx(float(mine.prior_predictive["y"].sum()), rel=1e-9)
    assert halved == pytest.approx(density / 2, rel=1e-9)
    assert mu == pytest.approx(prb.minimize(model, starts=0, **QUIET).point["mu"], rel=1e-9)


def test_a_copy_in_the_same_process_takes_nothing_over() -> None:
    model = build(prb.Reweighted(64))
    before = log_density(model)(AT)
    by_cloudpickle(model)
    prb.set_epsilon(model, {"y": 0.2})
    assert log_density(model)(AT) == pytest.approx(before / 2, rel=1e-12)


# The operation.


def test_operations_are_equal_if_they_carry_the_same_node() -> None:
    first, second = build(prb.Reweighted(64)), build(prb.Reweighted(64))
    assert first["y"].owner.op == clone_model(first)["y"].owner.op, "before the first use"
    first_use(first)
    one, other = first["y"].owner.op, second["y"].owner.op
    assert one == clone_model(first)["y"].owner.op
    assert one != other, "two simulators, however alike, are not to be merged in a graph"
    assert str(one) == 'prbayes_Simulator_rv{"(),()->()"}'
    assert isinstance(one, SimulatorRV)


def test_two_simulators_with_the_same_inputs_draw_different_data() -> None:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1, 1), 0.5)
        for name, factor in (("y", 1.0), ("z", -1.0)):
            prb.Simulator(
                name,
                lambda x, c: c * x,
                x,
                factor,
                metric=prb.AreaMetric(),
                observed=factor * OBSERVED,
                epsilon=0.1,
                propagation=prb.Reweighted(64),
            )
    y, z = pm.draw([model["y"], model["z"]], random_seed=1)
    assert y.mean() * z.mean() < 0
    densities = [model.compile_logp(vars=[model[name]], mode=PLAIN)({"mu": 1.0}) for name in "yz"]
    assert densities[0] == pytest.approx(densities[1], rel=1e-9)


def test_a_batch_of_parameters_is_a_batch_of_populations() -> None:
    model = build(prb.Reweighted(256))
    y, mu = model["y"], model["mu"]
    means = np.array([-0.5, 1.0, 2.5])
    many = vectorize_graph(y, {mu: pytensor.tensor.as_tensor(means), model["sigma"]: 0.5 + 0 * mu})
    drawn: Floats = pm.draw(many, random_seed=1)
    assert drawn.shape == (3, OBSERVED.size)
    # Twenty values of standard deviation .5 each: a standard error of .11
    np.testing.assert_allclose(drawn.mean(axis=1), means, atol=0.5)


def test_pictures_and_prints_of_the_model_show_response_and_metric() -> None:
    model = build(prb.Reweighted(64))
    assert "Simulator of positive by AreaMetric" in pm.model_to_graphviz(model).source
    assert "y ~ Simulator of positive by AreaMetric" in pm.model_to_mermaid(model)
    assert "y ~ Simulator[positive, AreaMetric](mu, sigma)" in model.str_repr()
    assert r"\operatorname{Simulator}[\text{positive, AreaMetric}]" in model._repr_latex_()


def test_nothing_of_a_simulator_stands_in_the_way_of_plain_pickle() -> None:
    model = build(prb.Reweighted(64))
    x = node_of(model).bound.inputs.aleatory
    before = log_density(model)(AT)
    # What PyMC binds to models and variables has no plain pickle (tests/test_contracts.py).
    for thing in (model, *model.basic_RVs, *x):
        for name in ("str_repr", "_repr_latex_"):
            vars(thing).pop(name, None)
    assert log_density(pickle.loads(pickle.dumps(model)))(AT) == before


# Other data.


OTHER = r"y: got other observed values than when this was compiled, .* compile it again"
NEW = np.append(OBSERVED + 0.5, [2.0, 2.2, 1.7])


def with_data(metric: prb.Metric, observed: Any) -> pm.Model:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1, 1), pm.HalfNormal("sigma", 1))
        prb.Simulator(
            "y", np.positive, x, metric=metric, propagation=prb.Reweighted(64),
            observed=pm.Data("data", observed),
        )  # fmt: skip
    return model


def test_pymc_observe_prepares_the_metric_for_other_data() -> None:
    model = build(prb.Reweighted(64))
    same = pm.observe(model, {"y": OBSERVED})
    assert log_density(same)(AT) == log_density(model)(AT)
    before = log_density(model)(AT)
    other = pm.observe(model, {"y": OBSERVED + 1})
    expected = prb.AreaMetric().against(OBSERVED + 1)
    values, weights = Evaluator.of(other).populations(_theta(other), 0)
    found = -0.1 * log_density(other)(AT)
    assert found == pytest.approx(float(expected(values[0], weights[0])), rel=1e-9)
    assert Evaluator.of(other)(_theta(other)).discrepancies[0, 0] == pytest.approx(found, rel=1e-9)
    assert node_of(other).bound.responses.count == 64, "no response is computed anew"
    assert log_density(model)(AT) == before


def _theta(model: pm.Model) -> Floats:
    return np.array([[AT[name] for name in Evaluator.of(model).hyperparameters.names]])


@pytest.mark.long
@pytest.mark.parametrize("metric", [prb.AreaMetric(), prb.LogLikelihood(density=prb.GaussianKDE())])
def test_data_that_are_set_anew_are_those_of_a_model_made_with_them(metric: prb.Metric) -> None:
    model, new = with_data(metric, OBSERVED), with_data(metric, NEW)
    first = prb.minimize(model, starts=0, **QUIET)
    compiled = log_density(model) if metric.likelihood else None
    pm.set_data({"data": NEW}, model=model)
    # The first minimisation let the design grow.
    found, expected = (Evaluator.of(m)(THETA).discrepancies for m in (model, new))
    np.testing.assert_allclose(found, expected, rtol=0.02)
    np.testing.assert_equal(node_of(model).epsilon_value, node_of(new).epsilon_value)
    drawn = pm.draw(model["y"], random_seed=1)
    assert drawn.shape == NEW.shape
    # What was made from the data before is not taken for the new problem.
    with pytest.raises(ValueError, match="other observed values of y"):
        prb.sample_smc(20, model=model, optimum=first, **QUIET)
    if compiled is not None:
        with pytest.raises(ParameterValueError, match=OTHER):
            compiled(AT)
        assert log_density(model)(AT) == pytest.approx(log_density(new)(AT), rel=0.02)
    pm.set_data({"data": OBSERVED}, model=model)
    assert Evaluator.of(model)(THETA).discrepancies == first.evaluator(THETA).discrepancies


def test_data_of_whole_numbers_may_be_set_too() -> None:
    model = with_data(prb.AreaMetric(), np.arange(5))
    pm.set_data({"data": np.arange(7)}, model=model)
    assert node_of(model).target.observed.tolist() == list(range(7))


def test_data_that_do_not_fit_what_goes_with_them_are_refused() -> None:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1, 1), 1.0)
        prb.Simulator(
            "y", np.positive, x, metric=prb.AreaMetric(), propagation=prb.Reweighted(64),
            observed=pm.Data("data", OBSERVED), specimens=range(20),
        )  # fmt: skip
    pm.set_data({"data": OBSERVED + 1}, model=model)
    assert nodes(model)
    pm.set_data({"data": OBSERVED[:5]}, model=model)
    with pytest.raises(ValueError, match="y: observed: got 5 specimens, expected 20, as many as"):
        nodes(model)
    pm.set_data({"data": np.append(OBSERVED[:19], np.nan)}, model=model)
    with pytest.raises(ValueError, match="y: observed: got"):
        prb.minimize(model)


@pytest.mark.parametrize("nutpie", [False, True])
def test_an_epsilon_that_is_not_set_is_told_when_the_density_is_made(
    nutpie: bool, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delitem(sys.modules, "nutpie", raising=False)
    if nutpie:  # which tells no more of an error than its number
        monkeypatch.setitem(sys.modules, "nutpie", ModuleType("nutpie"))
    model = build(prb.Reweighted(64), epsilon=None)
    with caplog.at_level("DEBUG", "prbayes"):
        model.logp()
        told = [record for record in caplog.records if "epsilon is not set" in record.message]
        assert told[0].message.startswith("y: epsilon is not set; call prb.set_epsilon(model")
        # Nothing is wrong yet for others.
        assert {record.levelname for record in told} == {"WARNING" if nutpie else "DEBUG"}
        caplog.clear()
        prb.minimize(model, progressbar=False)
    told = [record for record in caplog.records if "epsilon is not set" in record.message]
    assert {record.levelname for record in told} <= {"DEBUG"}


def test_the_value_that_a_log_density_is_asked_at_has_to_be_the_data() -> None:
    model = build(prb.Reweighted(64))
    at = {model["mu"]: AT["mu"], model["sigma"]: float(np.exp(AT["sigma_log__"]))}
    expected = log_density(model)(AT)
    assert float(pm.logp(model["y"], OBSERVED).eval(at, mode=PLAIN)) == pytest.approx(
        expected, rel=1e-9
    )
    moved = float(pm.logp(model["y"], OBSERVED + 1).eval(at, mode=PLAIN))
    assert moved != pytest.approx(expected, rel=0.01)
    value = pytensor.tensor.vector("value", dtype="float64")
    symbolic = pm.logp(model["y"], value)
    assert float(symbolic.eval({**at, value: OBSERVED}, mode=PLAIN)) == pytest.approx(
        expected, rel=1e-9
    )
    for other in (OBSERVED[::-1], np.append(OBSERVED, 1.0)):
        with pytest.raises(ParameterValueError, match=OTHER):
            symbolic.eval({**at, value: other}, mode=PLAIN)


@pytest.mark.long
def test_predictive_draws_of_the_same_specimens_are_warned_of(
    caplog: pytest.LogCaptureFixture,
) -> None:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
        for name in ("y", "z"):
            prb.Simulator(
                name, lambda x: x, x, metric=prb.AreaMetric(), observed=[0.0, 1.0],
                propagation=prb.Reweighted(64),
            )  # fmt: skip
    assert "draws each variable by itself" not in caplog.text
    pm.sample_prior_predictive(3, model=model, random_seed=1)
    assert caplog.text.count("z has inputs that y has too, the same specimens") == 1
    assert "use prb.predict" in caplog.text


@pytest.mark.parametrize("n", [7, 15, 20, 60, 100])
def test_the_default_epsilon_is_one_for_other_data_too(n: int) -> None:
    data = np.random.default_rng(1).normal(1.0, 0.5, n)
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 1), 0.5)
        given = {"observed": data, "propagation": prb.Reweighted(64)}
        prb.Simulator("y", np.positive, x, metric=prb.KullbackLeibler(), **given)
    evaluator = Evaluator.of(model)
    (other,) = evaluator.observing({"y": data + 1.0}).nodes
    assert has_default_epsilon(evaluator.nodes[0])
    assert has_default_epsilon(other)
    prb.set_epsilon(model, {"y": 1.01 / n})
    assert not has_default_epsilon(evaluator.nodes[0])


N, MU, SIGMA, EPSILON, POINTS = 30, 2.0, 0.8, 0.02, 128
STOCK_OBSERVED = np.random.default_rng(3).permutation(
    0.75 * stats.norm(MU, SIGMA).ppf((np.arange(N) + 0.5) / N)
)


def simulate(rng: np.random.Generator, mu: Any, sigma: Any, size: Any = None) -> Any:
    return 0.75 * rng.normal(mu, sigma, size=200)


STOCK = {
    "PR": (prb.ProbabilityResidual(), 0.01),
    "KLD": (prb.KullbackLeibler(), 1 / N),
    "LL": (prb.LogLikelihood(density=prb.GaussianKDE()), 1 / N),
    "area": (prb.AreaMetric(), 0.02),
}


@pytest.mark.long
@pytest.mark.parametrize("name", STOCK)
def test_stock_simulator_with_our_metrics(name: str) -> None:
    metric, epsilon = STOCK[name]
    with pm.Model() as model:
        mu, sigma = pm.Normal("mu", 2, 1), pm.HalfNormal("sigma", 1)
        distance = prb.abc_distance(metric)
        pm.Simulator(
            "y", simulate, mu, sigma, distance=distance, epsilon=epsilon, observed=STOCK_OBSERVED
        )
    cores = 2 if name == "area" else 1
    idata = pm.sample_smc(
        200,
        chains=cores,
        cores=cores,
        model=model,
        random_seed=4,
        compute_convergence_checks=False,
        **QUIET,
    )
    np.testing.assert_allclose(idata.posterior["mu"].mean(), MU, atol=0.1)
    np.testing.assert_allclose(idata.posterior["sigma"].mean(), SIGMA, atol=0.15)


@pytest.mark.parametrize("bad", [np.nan, -np.inf])
def test_stock_distance_of_invalid_samples(bad: float) -> None:
    observed, simulated = pt.dvector(), pt.dvector()
    epsilon = pt.dscalar()
    logp = prb.abc_distance(prb.AreaMetric())(epsilon, observed, simulated)
    sample = np.linspace(0, 3, 50)
    given = {epsilon: 0.1, observed: STOCK_OBSERVED}
    for data in (
        STOCK_OBSERVED,
        2 * STOCK_OBSERVED,
    ):  # the observed side is prepared once, for each data set
        expected = -prb.AreaMetric()(sample, data) / 0.1
        value = logp.eval(given | {simulated: sample, observed: data}, mode=PLAIN)
        np.testing.assert_allclose(value, expected, rtol=1e-12)
    assert logp.eval(given | {simulated: np.r_[sample, bad]}, mode=PLAIN) == -np.inf
    failed = logp.eval(given | {simulated: np.r_[sample, np.inf]}, mode=PLAIN)
    np.testing.assert_allclose(
        failed, -prb.AreaMetric()(np.r_[sample, np.inf], STOCK_OBSERVED) / 0.1, rtol=1e-12
    )
