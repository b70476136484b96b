"""Simulators in clones, copies and unpickled models: the same problem without shared state."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from typing import Any

import arviz as az
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
from prbayes.model.evaluator import Evaluator, compiled_objective
from prbayes.model.random_variable import Node, SimulatorRV, has_default_epsilon, nodes
from prbayes.propagation.base import Propagation
from prbayes.response.compile import PLAIN

OBSERVED = np.random.default_rng(1).normal(1.5, 0.6, 20)
AT = {"mu": 1.2, "sigma_log__": np.log(0.7)}
THETA = np.array([list(AT.values())])
QUIET = {"progressbar": False}
AREA = prb.AreaMetric()
DESIGN = prb.Reweighted(64)


def build(propagation: Propagation = DESIGN, **changes: Any) -> pm.Model:
    with pm.Model() as model:
        observed = changes.pop("observed", OBSERVED)
        if changes.pop("as_data", False):
            observed = pm.Data("data", observed)
        x = pm.Normal.dist(
            pm.Normal("mu", *changes.pop("prior", (1, 1))), pm.HalfNormal("sigma", 1)
        )
        given = {"metric": AREA, "epsilon": 0.1} | changes
        prb.Simulator("y", np.positive, x, observed=observed, propagation=propagation, **given)
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
    "deepcopy": copy.deepcopy,
    "freeze": freeze_dims_and_data,
    "cloudpickle": by_cloudpickle,
    "clone of an unpickled model": lambda model: clone_model(by_cloudpickle(model)),
}


@pytest.mark.parametrize("propagation", [DESIGN, prb.Resimulated(64)])
def test_conditioned_models_have_the_same_discrepancy(propagation: Propagation) -> None:
    model = build(propagation)
    conditioned = {
        "do": (pm.do(model, {"mu": AT["mu"]}), ["sigma_log__"]),
        "observe": (pm.observe(model, {"sigma": float(np.exp(AT["sigma_log__"]))}), ["mu"]),
        "clone": (clone_model(model), list(AT)),
    }
    expected = Evaluator.of(model)(THETA).discrepancies[0, 0]
    for clone, names in conditioned.values():
        evaluator = Evaluator.of(clone)
        assert sorted(evaluator.hyperparameters.names) == sorted(names)
        theta = np.array([[AT[n] for n in evaluator.hyperparameters.names]])
        found = evaluator(theta).discrepancies[0, 0]
        np.testing.assert_allclose(found, expected, rtol=1e-9)
        density = log_density(clone)({name: AT[name] for name in names})
        np.testing.assert_allclose(density, -expected / 0.1, rtol=1e-9)


@pytest.mark.parametrize("way", COPIES)
def test_a_copy_shares_nothing_that_changes(way: str) -> None:
    model = build()
    other = COPIES[way](model)
    node, copied = node_of(model), node_of(other)
    assert node is not copied
    assert (node_of(model), node_of(other)) == (node, copied)
    densities = log_density(model), log_density(other)

    def ratios() -> list[float]:
        return [density(AT) / before for density in densities]

    before = densities[0](AT)
    assert ratios() == pytest.approx([1, 1], rel=1e-12)
    prb.set_epsilon(other, {"y": 0.2})
    assert ratios() == pytest.approx([1, 0.5], rel=1e-12)
    prb.set_epsilon(model, {"y": 0.05})
    assert ratios() == pytest.approx([2, 0.5], rel=1e-12)
    # The design, and its count of responses
    assert copied.reweighted is not None
    copied.reweighted.add([np.full(4, 1.2), np.full(4, 0.7)])
    assert ratios()[1] != pytest.approx(0.5, rel=1e-12)
    assert ratios()[0] == pytest.approx(2, rel=1e-12)
    assert (node.bound.n_points, copied.bound.n_points) == (64, 128)
    assert node.responses.count == 64


# The operation.


def test_operations_are_equal_if_they_carry_the_same_simulator() -> None:
    first, second = build(), build()
    assert first["y"].owner.op == clone_model(first)["y"].owner.op, "before the first use"
    first_use(first)
    operation = first["y"].owner.op
    assert operation == clone_model(first)["y"].owner.op
    assert operation != second["y"].owner.op, "or a rewrite would merge two simulators"
    assert str(operation) == 'prbayes_Simulator_rv{"(),()->()"}'
    assert isinstance(operation, SimulatorRV)
    assert operation.simulator is node_of(first)


def two_of_the_same_inputs() -> pm.Model:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1, 1), 0.5)
        for name, factor in (("y", 1.0), ("z", -1.0)):
            given = {"observed": factor * OBSERVED, "epsilon": 0.1, "propagation": DESIGN}
            prb.Simulator(name, lambda x, c: c * x, x, factor, metric=AREA, **given)
    return model


def test_simulators_with_the_same_inputs_draw_different_data() -> None:
    model = two_of_the_same_inputs()
    y, z = pm.draw([model["y"], model["z"]], random_seed=1, mode=PLAIN)
    assert y.mean() * z.mean() < 0
    densities = [model.compile_logp(vars=[model[name]], mode=PLAIN)({"mu": 1.0}) for name in "yz"]
    assert densities[0] == pytest.approx(densities[1], rel=1e-9)


@pytest.mark.long
def test_predictive_draws_of_the_same_specimens_are_reported(
    caplog: pytest.LogCaptureFixture,
) -> None:
    model = two_of_the_same_inputs()
    assert "draws each variable independently" not in caplog.text
    pm.sample_prior_predictive(3, model=model, random_seed=1, compile_kwargs={"mode": PLAIN})
    assert caplog.text.count("z and y have the inputs of the same specimens") == 1
    assert "use prb.predict" in caplog.text


def test_a_batch_of_parameters_is_a_batch_of_populations() -> None:
    model = build(prb.Reweighted(256))
    y, mu = model["y"], model["mu"]
    means = np.array([-0.5, 1.0, 2.5])
    many = vectorize_graph(y, {mu: pytensor.tensor.as_tensor(means), model["sigma"]: 0.5 + 0 * mu})
    drawn: Floats = pm.draw(many, random_seed=1, mode=PLAIN)
    assert drawn.shape == (3, OBSERVED.size)
    # Twenty values of standard deviation .5 each: a standard error of .11
    np.testing.assert_allclose(drawn.mean(axis=1), means, atol=0.5)


def test_pictures_and_prints_of_the_model_show_response_and_metric() -> None:
    model = build()
    assert "Simulator of positive by AreaMetric" in pm.model_to_graphviz(model).source
    assert "y ~ Simulator of positive by AreaMetric" in pm.model_to_mermaid(model)
    assert "y ~ Simulator[positive, AreaMetric](mu, sigma)" in model.str_repr()
    assert r"\operatorname{Simulator}[\text{positive, AreaMetric}]" in model._repr_latex_()


def test_a_simulator_has_a_plain_pickle() -> None:
    model = build()
    before = log_density(model)(AT)
    # What PyMC binds to models and variables has no plain pickle (tests/test_contracts.py).
    for thing in (model, *model.basic_RVs, *node_of(model).inputs.aleatory):
        for name in ("str_repr", "_repr_latex_"):
            vars(thing).pop(name, None)
    assert log_density(pickle.loads(pickle.dumps(model)))(AT) == before


# Other data.


OTHER = r"y: got other observed values than when this was compiled, .* compile it again"
NEW = np.append(OBSERVED + 0.5, [2.0, 2.2, 1.7])


def test_pymc_observe_prepares_the_metric_for_other_data() -> None:
    model = build()
    before = log_density(model)(AT)
    assert log_density(pm.observe(model, {"y": OBSERVED}))(AT) == before
    other = pm.observe(model, {"y": OBSERVED + 1})
    evaluator = Evaluator.of(other)
    theta = np.array([[AT[name] for name in evaluator.hyperparameters.names]])
    values, weights = evaluator.populations(theta, 0)
    found = -0.1 * log_density(other)(AT)
    assert found == pytest.approx(
        float(AREA(values[0], OBSERVED + 1, weights=weights[0])), rel=1e-9
    )
    assert evaluator(theta).discrepancies[0, 0] == pytest.approx(found, rel=1e-9)
    assert node_of(other).responses.count == 64, "no response is computed"
    assert log_density(model)(AT) == before


@pytest.mark.long
@pytest.mark.parametrize("metric", [AREA, prb.LogLikelihood(density=prb.GaussianKDE())])
def test_set_data_gives_the_model_of_the_new_data(metric: prb.Metric) -> None:
    given = {"metric": metric, "epsilon": None, "as_data": True}
    model, new = build(**given), build(observed=NEW, **given)
    first = prb.minimize(model, starts=0, **QUIET)
    compiled = log_density(model) if metric.likelihood else None
    pm.set_data({"data": NEW}, model=model)
    # The first minimisation let the design grow.
    found, expected = (Evaluator.of(m)(THETA).discrepancies for m in (model, new))
    np.testing.assert_allclose(found, expected, rtol=0.02)
    np.testing.assert_equal(node_of(model).epsilon_value, node_of(new).epsilon_value)
    assert pm.draw(model["y"], random_seed=1, mode=PLAIN).shape == NEW.shape
    with pytest.raises(ValueError, match="other observed values of y"):
        prb.sample_smc(20, model=model, optimum=first, **QUIET)
    if compiled is not None:
        with pytest.raises(ParameterValueError, match=OTHER):
            compiled(AT)
        assert log_density(model)(AT) == pytest.approx(log_density(new)(AT), rel=0.02)
    pm.set_data({"data": OBSERVED}, model=model)
    assert Evaluator.of(model)(THETA).discrepancies == first.evaluator(THETA).discrepancies


def test_simulators_of_a_response_have_one_bandwidth() -> None:
    def widths(model: pm.Model) -> list[float]:
        return [node.target.cells.bandwidth for node in nodes(model).values()]

    metric, points = prb.KullbackLeibler(), prb.Reweighted(64)
    rows = np.random.default_rng(1).normal(size=(3, 6))
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1))
        arguments = {"metric": metric, "propagation": points}
        first = pm.Data("first", rows[0])
        prb.Simulator("y0", np.negative, x, observed=first, **arguments)
        prb.Simulator("y1", np.negative, x, observed=rows[1], **arguments)
    width = metric.against(rows[:2].ravel()).cells.bandwidth
    np.testing.assert_allclose(widths(model), width)
    with model:  # those in use take part
        prb.Simulator("y2", np.negative, x, observed=rows[2], **arguments)
    np.testing.assert_allclose(widths(model), metric.against(rows.ravel()).cells.bandwidth)
    pm.set_data({"first": 5 + rows[0]}, model=model)
    changed = np.concatenate([5 + rows[0], *rows[1:]])
    np.testing.assert_allclose(widths(model), metric.against(changed).cells.bandwidth)
    observed = {f"y{k}": row for k, row in enumerate(rows)}
    again = Evaluator.of(model).observing(observed)
    expected = metric.against(rows.ravel()).cells.bandwidth
    np.testing.assert_allclose([n.target.cells.bandwidth for n in again.nodes], expected)


def test_data_of_whole_numbers_may_change() -> None:
    model = build(observed=np.arange(5), as_data=True)
    pm.set_data({"data": np.arange(7)}, model=model)
    assert node_of(model).observed.tolist() == list(range(7))


def test_data_that_do_not_fit_labels_are_refused() -> None:
    model = build(as_data=True, specimens=range(20))
    pm.set_data({"data": OBSERVED + 1}, model=model)
    assert nodes(model)
    pm.set_data({"data": OBSERVED[:5]}, model=model)
    with pytest.raises(ValueError, match="y: observed: got 5 specimens, expected 20, as many as"):
        nodes(model)
    pm.set_data({"data": np.append(OBSERVED[:19], np.nan)}, model=model)
    with pytest.raises(ValueError, match="y: observed: got"):
        prb.minimize(model)


def test_a_metric_has_no_log_likelihood_by_specimen(caplog: pytest.LogCaptureFixture) -> None:
    """The log-likelihoods of other variables, and the density that samplers take, remain."""
    with pm.Model() as model:
        mu = pm.Normal("mu", 0, 1)
        y = {"metric": prb.AreaMetric(), "observed": [0.0, 1.0, 2.0], "epsilon": 0.1}
        prb.Simulator("y", lambda x: 2 * x, pm.Normal.dist(mu, 1), **y)
        pm.Normal("z", mu, 1, observed=[0.5, 1.0])
    idata = az.from_dict({"posterior": {"mu": np.linspace(-0.5, 0.5, 100).reshape(2, 50)}})
    given = {"model": model, "progressbar": False, "compile_kwargs": {"mode": PLAIN}}
    pm.compute_log_likelihood(idata, **given)
    assert idata["log_likelihood"]["y"].shape == (2, 50, 0)
    with pytest.raises(ValueError, match="size 0"):
        az.loo(idata, var_name="y")
    record = caplog.records[-1]
    assert getattr(record, "code", "") == "no-log-likelihood"
    assert "use prb.cross_validate" in record.getMessage()
    assert az.loo(idata, var_name="z").n_data_points == 2
    density = model.compile_fn(model.logp(model["y"]), mode=PLAIN)
    assert density({"mu": np.array(0.0)}) < 0


def test_an_unset_epsilon_is_reported_with_the_density(caplog: pytest.LogCaptureFixture) -> None:
    model = build(epsilon=None)
    text = "y: epsilon is not set; call prb.set_epsilon(model"
    with caplog.at_level("DEBUG", "prbayes"):
        model.logp()
    assert [r.levelname for r in caplog.records if r.message.startswith(text)] == ["DEBUG"]
    compiled_objective(Evaluator.of(model), prior=False, gradient=True)


def test_an_unset_epsilon_ends_the_compilation_of_nutpie() -> None:
    # nutpie would show only the number of an error, after it has compiled all.
    namespace: dict[str, Any] = {"__name__": "nutpie.compile_pymc"}
    exec("def compile_pymc_model(model):\n    return model.logp()", namespace)
    model = build(epsilon=None)
    with pytest.raises(ValueError, match=r"y: epsilon is not set; call prb\.set_epsilon"):
        namespace["compile_pymc_model"](model)
    prb.set_epsilon(model, {"y": 0.1})
    namespace["compile_pymc_model"](model)


def test_the_value_of_a_log_density_has_to_be_the_data() -> None:
    model = build()
    at = {model["mu"]: AT["mu"], model["sigma"]: float(np.exp(AT["sigma_log__"]))}
    expected = pytest.approx(log_density(model)(AT), rel=1e-9)
    assert float(pm.logp(model["y"], OBSERVED).eval(at, mode=PLAIN)) == expected
    assert float(pm.logp(model["y"], OBSERVED + 1).eval(at, mode=PLAIN)) != expected
    value = pytensor.tensor.vector("value", dtype="float64")
    symbolic = pm.logp(model["y"], value)
    assert float(symbolic.eval({**at, value: OBSERVED}, mode=PLAIN)) == expected
    for other in (OBSERVED[::-1], np.append(OBSERVED, 1.0)):
        with pytest.raises(ParameterValueError, match=OTHER):
            symbolic.eval({**at, value: other}, mode=PLAIN)


def test_the_default_epsilon_follows_the_data() -> None:
    model = build(metric=prb.KullbackLeibler(), epsilon=None)
    evaluator = Evaluator.of(model)
    (other,) = evaluator.observing({"y": OBSERVED + 1.0}).nodes
    assert has_default_epsilon(evaluator.nodes[0])
    assert has_default_epsilon(other)
    prb.set_epsilon(model, {"y": 1.01 / OBSERVED.size})
    assert not has_default_epsilon(evaluator.nodes[0])


# The distance of PyMC's own simulator.

N, MU, SIGMA = 30, 2.0, 0.8
STOCK_OBSERVED = np.random.default_rng(3).permutation(
    0.75 * stats.norm(MU, SIGMA).ppf((np.arange(N) + 0.5) / N)
)


def simulate(rng: np.random.Generator, mu: Any, sigma: Any, size: Any = None) -> Any:
    return 0.75 * rng.normal(mu, sigma, size=200)


@pytest.mark.long
def test_the_distance_of_pymc_s_simulator() -> None:
    with pm.Model() as model:
        mu, sigma = pm.Normal("mu", 2, 1), pm.HalfNormal("sigma", 1)
        given = {"epsilon": 0.02, "observed": STOCK_OBSERVED}
        pm.Simulator("y", simulate, mu, sigma, distance=prb.abc_distance(AREA), **given)
    settings = {"chains": 2, "cores": 2, "compute_convergence_checks": False, **QUIET}
    idata = pm.sample_smc(200, model=model, random_seed=4, **settings)
    np.testing.assert_allclose(idata.posterior["mu"].mean(), MU, atol=0.1)
    np.testing.assert_allclose(idata.posterior["sigma"].mean(), SIGMA, atol=0.15)


@pytest.mark.parametrize("bad", [np.nan, -np.inf])
def test_the_distance_of_invalid_samples(bad: float) -> None:
    observed, simulated, epsilon = pt.dvector(), pt.dvector(), pt.dscalar()
    logp = prb.abc_distance(AREA)(epsilon, observed, simulated)
    sample = np.linspace(0, 3, 50)

    def at(values: Floats, data: Floats = STOCK_OBSERVED) -> float:
        return float(logp.eval({epsilon: 0.1, observed: data, simulated: values}, mode=PLAIN))

    for data in (STOCK_OBSERVED, 2 * STOCK_OBSERVED):  # prepared once for each data set
        assert at(sample, data) == pytest.approx(-AREA(sample, data) / 0.1, rel=1e-12)
    assert at(np.r_[sample, bad]) == -np.inf
    failed = np.r_[sample, np.inf]
    assert at(failed) == pytest.approx(-AREA(failed, STOCK_OBSERVED) / 0.1, rel=1e-12)
