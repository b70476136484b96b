"""Groups of specimens from end to end: one design, populations by group, names in all results."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm
import pytensor
import pytest
import xarray as xr
from pymc.model.fgraph import clone_model
from suppliers import labelled

import prbayes as prb
from prbayes.model.description import describe
from prbayes.model.evaluator import Evaluator, n_design_runs
from prbayes.model.margins import margins, select_margins
from prbayes.model.parameters import unconstrained
from prbayes.model.random_variable import nodes
from prbayes.optimize.design_refinement import _add_runs
from prbayes.propagation.reweighted import same_points
from prbayes.response.compile import PLAIN

NAMES = ["Adler", "Busch"]
WHO = np.repeat(NAMES, [20, 30])
MEANS = np.repeat([0.0, 1.0], [20, 30])
DATA = labelled(np.random.default_rng(5).normal(MEANS, 0.3), WHO)
PARTS = ["y[Adler]", "y[Busch]"]
calls = 0


def counting(x: Any) -> Any:
    global calls
    calls += np.size(x) if np.size(x) > 1 else 0  # a specimen by itself is no run
    return 2.0 * x


def build(observed: Any = DATA, response: Any = counting, **given: Any) -> pm.Model:
    with pm.Model(coords={"supplier": NAMES}) as model:
        mu = pm.Normal("mu", 0, 1, dims="supplier")
        sigma = pm.HalfNormal("sigma", 0.5)
        x = pm.Normal.dist(mu[prb.response.group("supplier")], sigma, name="x")
        keywords = {"metric": prb.ProbabilityResidual(), "propagation": prb.Reweighted(256)} | given
        prb.Simulator("y", response, x, observed=observed, progressbar=False, **keywords)
    return model


@pytest.fixture(scope="module")
def model() -> pm.Model:
    return build()


@pytest.fixture(scope="module")
def optimum(model: pm.Model) -> prb.Optimum:
    return prb.minimize(model, starts=0, progressbar=False)


@pytest.fixture(scope="module")
def draws(optimum: prb.Optimum) -> xr.DataTree:
    settings: dict[str, Any] = {"chains": 2, "random_seed": 1, "progressbar": False}
    return prb.sample_smc(100, model=optimum.model, optimum=optimum, **settings)


def specimen(model: pm.Model) -> Any:
    return next(iter(nodes(model).values())).bound.inputs.aleatory[0]


def test_groups_share_a_design() -> None:
    before = calls
    cost = prb.cost(build())
    assert cost.runs == 256
    assert [simulator.name for simulator in cost.simulators] == PARTS
    assert calls == before
    evaluator = Evaluator.of(build())
    # Some are computed in another order, and three as files might have changed.
    assert calls == before + 256 + 33 + 3
    assert [node.name for node in evaluator.nodes] == PARTS
    first, second = (node.bound for node in evaluator.nodes)
    assert same_points(first, second)
    # It grows at the same points for the populations of both.
    _add_runs(evaluator, evaluator.hyperparameters.prior_thetas(64, 1), {"y[Busch]"})
    assert calls == before + 512 + 33 + 3
    assert n_design_runs(evaluator) == evaluator.n_responses == first.n_runs == 512
    assert same_points(first, second)
    assert sum(node.responses.computed for node in evaluator.nodes) == 512 + 3


def test_each_group_is_compared_with_its_population(model: pm.Model) -> None:
    evaluator = Evaluator.of(model)
    theta = unconstrained(evaluator.hyperparameters, {"mu": [0.1, 0.9], "sigma": 0.3})
    for k, (name, mean) in enumerate(zip(NAMES, [0.1, 0.9], strict=True)):
        observed = DATA.values[name == WHO]
        np.testing.assert_array_equal(np.sort(evaluator.nodes[k].observed), np.sort(observed))
        (values,), (weights,) = evaluator.populations(theta[None], k)
        # The design is a rule of 256 points for a population a seventh as wide as its reach.
        assert abs(values @ weights / 2 - mean) < 0.02
        direct = prb.ProbabilityResidual().against(observed)(values, weights)
        np.testing.assert_allclose(evaluator.discrepancies(theta[None], k), direct, rtol=1e-9)
    moved = unconstrained(evaluator.hyperparameters, {"mu": [0.1, 1.4], "sigma": 0.3})
    before, after = evaluator(np.stack([theta, moved])).discrepancies
    assert before[0] == after[0]
    assert before[1] != after[1]


def test_the_density_is_that_of_all_groups() -> None:
    model = build()
    prb.set_epsilon(model, {"y[Adler]": 0.5, "y[Busch]": 0.25})
    evaluator = Evaluator.of(model)
    theta = evaluator.hyperparameters.prior_thetas(1, 3)
    point = {"mu": theta[0, :2], "sigma_log__": theta[0, 2]}
    found = evaluator(theta)
    expected = found.log_prior[0] - found.discrepancies[0] @ [2, 4]
    for copy in (model, clone_model(model)):
        np.testing.assert_allclose(copy.compile_logp(mode=PLAIN)(point), expected, rtol=1e-6)
    assert np.isfinite(model.compile_dlogp(mode=PLAIN)(point)).all()


@pytest.mark.long
def test_results_have_the_names_of_groups(
    tmp_path: Path, model: pm.Model, optimum: prb.Optimum, draws: xr.DataTree
) -> None:
    elements = ["mu[Adler]", "mu[Busch]", "sigma"]
    assert optimum.evaluator.hyperparameters.names == [*elements[:2], "sigma_log__"]
    assert list(optimum.discrepancies) == PARTS
    assert list(draws["observed_data"].data_vars) == PARTS
    table = prb.compare({"optimum": optimum, "ABC": draws}, model=model)
    assert list(table["hyperparameter"].values) == elements
    assert "y[Busch] AreaMetric" in table
    assert [simulator["name"] for simulator in describe(model)["simulators"]] == PARTS
    assert prb.diagnose(draws, model=model).ok
    report = prb.Report("x", model=model, optimum=optimum, posterior=draws, pictures=False)
    report.to_markdown(tmp_path)
    text = "".join(path.read_text() for path in tmp_path.glob("*.md")).replace("\\", "")
    assert all(name in text for name in [*elements, *PARTS])
    assert "mu[0]" not in text
    draws.to_netcdf(tmp_path / "results.nc")


@pytest.mark.long
def test_predictions_have_a_dimension_of_groups(
    model: pm.Model, optimum: prb.Optimum, draws: xr.DataTree
) -> None:
    before = calls
    found = prb.predict(draws, counting, specimen(model), model=model, n_samples=100)
    assert found.dims == ("chain", "draw", "supplier", "sample")
    assert list(found["supplier"].values) == NAMES
    assert calls - before <= 3  # runs that are computed again
    means = found.mean(("chain", "draw", "sample")) / 2
    difference = np.abs(means.values - optimum.point["mu"])
    assert (difference < 0.5 * np.asarray(optimum.stderr["mu"])).all()
    new = prb.predict(optimum, counting, specimen(model), stored=False, n_samples=100)
    # Three runs are computed again at most, and others show that the function has no state.
    assert 200 + 14 <= calls - before <= 200 + 3 + 14
    assert float(new.sel(supplier="Busch").mean() / new.sel(supplier="Adler").mean()) != 1


def test_populations_of_inputs_have_the_names_of_groups(model: pm.Model) -> None:
    every = margins(Evaluator.of(model))
    assert [margin.name for margin in every] == ["x[Adler]", "x[Busch]"]
    assert [margin.node for margin in every] == [0, 1]
    assert select_margins(every, ["x[Busch]"]) == every[1:]
    assert select_margins(every, ["x"]) == every


@pytest.mark.parametrize("propagation", [prb.Resimulated(256), prb.Fresh(256)])
def test_other_propagations_have_groups(propagation: Any) -> None:
    evaluator = Evaluator.of(build(propagation=propagation))
    theta = unconstrained(evaluator.hyperparameters, {"mu": [0.0, 0.5], "sigma": 0.15})
    far = unconstrained(evaluator.hyperparameters, {"mu": [0.0, 1.5], "sigma": 0.15})
    near_both, far_of_one = evaluator(np.stack([theta, far])).discrepancies
    assert far_of_one[1] > 5 * near_both[1]
    assert far_of_one[0] < 5 * near_both[0] + 1


def test_weights_and_labels_go_with_their_group() -> None:
    weights = np.arange(1.0, 51.0)
    labels = [f"s{i // 2}" for i in range(50)]
    first, second = nodes(build(weights=weights, specimens=labels)).values()
    order = np.argsort(first.target.observed)
    known = weights[:20] / weights[:20].sum()
    assert set(np.round(first.target.weights[order], 12)) == set(np.round(known, 12))
    assert list(first.specimens) == labels[:20]
    assert list(second.specimens) == labels[20:]


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"observed": pytensor.shared(DATA.values)}, "without the group of each specimen"),
        ({"observed": DATA[:21]}, r"y\[Busch\]: observed: got one "),
        ({"dims": "specimen"}, "dims: got"),
        ({"specimens": [f"s{i % 40}" for i in range(50)]}, "'s0' in Adler and in Busch"),
        ({"weights": np.ones(20)}, "weights"),
        ({"weights": np.repeat([1.0, 0.0], [20, 30])}, r"y\[Busch\]: "),
    ],
)
def test_invalid_arguments_are_refused_before_any_run(given: dict[str, Any], message: str) -> None:
    before = calls
    with pytest.raises((TypeError, ValueError), match=message):
        build(**given)
    assert calls == before


def test_decisions_are_of_one_population(model: pm.Model) -> None:
    x = specimen(model)
    optimum = prb.minimize(model, refine=False, starts=0, progressbar=False)
    before = calls
    for ask in (
        lambda: prb.sensitivity(optimum, prb.decision.Quantile(counting, x, probability=0.9)),
        lambda: prb.exceedance(optimum, counting, 3.0, x),
        lambda: prb.plan(optimum, {"more": prb.decision.Condition(counting, x)}),
    ):
        with pytest.raises(TypeError, match=r"prb.response.group\('supplier'\), expected"):
            ask()
    assert calls == before
