"""Groups of specimens from end to end: one design, populations by group, names in all results."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm
import pytest
import xarray as xr
from pymc.model.fgraph import clone_model
from scipy import stats
from suppliers import labelled

import prbayes as prb
from prbayes.model.description import describe
from prbayes.model.evaluator import Evaluator, n_design_runs
from prbayes.model.random_variable import nodes
from prbayes.optimize.design_refinement import _add_runs
from prbayes.plots.population import margins, select_margins
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


@cache
def case() -> tuple[pm.Model, prb.Optimum]:
    model = build()
    return model, prb.minimize(model, progressbar=False)


@cache
def draws() -> xr.DataTree:
    model, optimum = case()
    return prb.sample_smc(
        100, chains=2, model=model, optimum=optimum, random_seed=1, progressbar=False
    )


def specimen(model: pm.Model) -> Any:
    return next(iter(nodes(model).values())).bound.inputs.aleatory[0]


def test_all_groups_are_of_one_design() -> None:
    before = calls
    evaluator = Evaluator.of(build())
    assert calls == before + 256
    assert [node.name for node in evaluator.nodes] == PARTS
    first, second = (node.bound for node in evaluator.nodes)
    assert same_points(first, second)
    # It grows for the populations of both at the same points.
    _add_runs(evaluator, evaluator.hyperparameters.prior_thetas(64, 1), {"y[Busch]"})
    assert calls == before + 512
    assert n_design_runs(evaluator) == evaluator.n_responses == 512
    assert same_points(first, second)
    assert evaluator.nodes[0].bound.n_runs == 512
    assert sum(node.bound.responses.computed for node in evaluator.nodes) == 512


def test_each_group_is_compared_with_its_own_population() -> None:
    evaluator = Evaluator.of(build())
    theta = evaluator.hyperparameters.unconstrained({"mu": [0.1, 0.9], "sigma": 0.3})
    for k, (name, mean) in enumerate(zip(NAMES, [0.1, 0.9], strict=True)):
        node = evaluator.nodes[k]
        own = DATA.values[name == WHO]
        np.testing.assert_array_equal(np.sort(node.target.observed), np.sort(own))
        values, weights = evaluator.populations(theta[None], k)
        center = (values[0] * weights[0]).sum() / 2
        # The design is a rule of 256 points for a population a seventh as wide as its reach.
        assert abs(center - mean) < 0.02
        direct = prb.ProbabilityResidual().against(own)(values[0], weights[0])
        np.testing.assert_allclose(evaluator.discrepancies(theta[None], k), direct, rtol=1e-9)
    moved = evaluator.hyperparameters.unconstrained({"mu": [0.1, 1.4], "sigma": 0.3})
    before, after = evaluator(np.stack([theta, moved])).discrepancies
    assert before[0] == after[0]
    assert before[1] != after[1]


@pytest.mark.long
def test_groups_are_those_of_simulators_written_one_by_one() -> None:
    _, optimum = case()
    with pm.Model() as alone:
        mu = [pm.Normal(f"mu_{name}", 0, 1) for name in NAMES]
        sigma = pm.HalfNormal("sigma", 0.5)
        for name, mean in zip(NAMES, mu, strict=True):
            x = pm.Normal.dist(mean, sigma)
            own = DATA.values[name == WHO]
            prb.Simulator("y" + name, counting, x, metric=prb.ProbabilityResidual(), observed=own)
    known = prb.minimize(alone, progressbar=False)
    for i, name in enumerate(NAMES):
        error = known.stderr[f"mu_{name}"]
        # Two designs, of 256 and 1024 points.
        assert abs(optimum.point["mu"][i] - known.point[f"mu_{name}"]) < 0.1 * error
        assert abs(optimum.stderr["mu"][i] / error - 1) < 0.1
    assert not optimum.findings


def test_the_density_is_that_of_all_groups_also_in_a_clone() -> None:
    model = build()
    prb.set_epsilon(model, {"y[Adler]": 0.5, "y[Busch]": 0.25})
    evaluator = Evaluator.of(model)
    theta = evaluator.hyperparameters.prior_thetas(1, 3)
    point = {"mu": theta[0, :2], "sigma_log__": theta[0, 2]}
    found = evaluator(theta)
    expected = found.log_prior[0] - found.discrepancies[0] @ [2, 4]
    for each in (model, clone_model(model)):
        np.testing.assert_allclose(each.compile_logp(mode=PLAIN)(point), expected, rtol=1e-6)
        assert np.isfinite(each.compile_dlogp(mode=PLAIN)(point)).all()


@pytest.mark.long
def test_results_keep_the_names(tmp_path: Path) -> None:
    model, optimum = case()
    posterior = draws()
    elements = ["mu[Adler]", "mu[Busch]", "sigma"]
    assert optimum.names == [*elements[:2], "sigma_log__"]
    assert list(optimum.discrepancies) == PARTS
    assert list(posterior["observed_data"].data_vars) == PARTS
    table = prb.compare({"optimum": optimum, "ABC": posterior}, model=model)
    assert list(table["hyperparameter"].values) == elements
    assert "y[Busch] AreaMetric" in table
    assert [each["name"] for each in describe(model)["simulators"]] == PARTS
    assert prb.diagnose(posterior, model=model).ok
    report = prb.Report("x", model=model, optimum=optimum, posterior=posterior, pictures=False)
    report.to_markdown(tmp_path)
    text = "".join(path.read_text() for path in tmp_path.glob("*.md")).replace("\\", "")
    assert all(name in text for name in [*elements, *PARTS])
    assert "mu[0]" not in text
    posterior.to_netcdf(tmp_path / "results.nc")


@pytest.mark.long
def test_predictions_have_a_dimension_of_groups() -> None:
    model, optimum = case()
    before = calls
    found = prb.predict(draws(), counting, specimen(model), model=model, n_samples=100)
    assert found.dims == ("chain", "draw", "supplier", "sample")
    assert list(found["supplier"].values) == NAMES
    assert calls == before
    means = found.mean(("chain", "draw", "sample")) / 2
    for i, name in enumerate(NAMES):
        error = optimum.stderr["mu"][i]
        assert abs(float(means.sel(supplier=name)) - optimum.point["mu"][i]) < 0.5 * error
    new = prb.predict(optimum, counting, specimen(model), stored=False, n_samples=100)
    assert calls == before + 200
    assert float(new.sel(supplier="Busch").mean() / new.sel(supplier="Adler").mean()) != 1
    # Values spread as those of one supplier are: the verdict is of no chance.
    mu, sigma = optimum.point["mu"][1], optimum.point["sigma"]
    fresh = 2 * stats.norm.ppf((np.arange(25) + 0.5) / 25, mu, sigma)
    assert not prb.area_test(fresh, found.sel(supplier="Busch")).rejected
    assert prb.area_test(fresh, found.sel(supplier="Adler")).rejected
    with pytest.raises(ValueError, match=r"got a DataArray with dims .* expected \(chain, draw"):
        prb.area_test(fresh, found)


def test_populations_of_inputs_are_called_by_their_groups() -> None:
    model, _ = case()
    every = margins(Evaluator.of(model))
    assert [margin.name for margin in every] == ["x[Adler]", "x[Busch]"]
    assert [margin.node for margin in every] == [0, 1]
    assert select_margins(every, ["x[Busch]"]) == every[1:]
    assert select_margins(every, ["x"]) == every


@pytest.mark.parametrize("propagation", [prb.Resimulated(256), prb.Fresh(256)])
def test_other_propagations_have_groups_as_well(propagation: Any) -> None:
    evaluator = Evaluator.of(build(propagation=propagation))
    theta = evaluator.hyperparameters.unconstrained({"mu": [0.0, 0.5], "sigma": 0.15})
    far = evaluator.hyperparameters.unconstrained({"mu": [0.0, 1.5], "sigma": 0.15})
    near_both, far_of_one = evaluator(np.stack([theta, far])).discrepancies
    assert far_of_one[1] > 5 * near_both[1]
    assert far_of_one[0] < 5 * near_both[0] + 1


@pytest.mark.long
def test_several_outputs_have_groups_as_well() -> None:
    noise = np.random.default_rng(6).normal(0, 0.2, 50)
    values = np.stack([DATA.values, DATA.values + noise], axis=1)
    coords = {"supplier": ("specimen", WHO), "place": ["left", "right"]}
    observed = xr.DataArray(values, coords, ["specimen", "place"])
    model = build(
        observed,
        lambda x: np.stack([x, x + 0.2 * np.sin(9 * x)], axis=-1),
        metric=prb.Joint(prb.AreaMetric()),
    )
    found = [(node.name, node.outputs.labels, len(node.target.observed)) for node in
             nodes(model).values()]  # fmt: skip
    assert found == [(PARTS[0], ("left", "right"), 20), (PARTS[1], ("left", "right"), 30)]
    predicted = prb.predict(
        prb.minimize(model, progressbar=False),
        next(iter(nodes(model).values())).bound.responses.function,
        specimen(model),
        n_samples=50,
    )
    assert predicted.dims == ("chain", "draw", "supplier", "sample", "place")


def test_weights_and_labels_go_with_their_group() -> None:
    weights = np.arange(1.0, 51.0)
    labels = [f"s{i // 2}" for i in range(50)]
    first, second = nodes(build(weights=weights, specimens=labels)).values()
    order = np.argsort(first.target.observed)
    known = weights[:20] / weights[:20].sum()
    assert set(np.round(first.target.weights[order], 12)) == set(np.round(known, 12))
    assert list(first.specimens) == labels[:20]
    assert list(second.specimens) == labels[20:]


def test_cost_counts_the_runs_once() -> None:
    found = prb.cost(build)
    assert found.runs == 256
    assert [each.name for each in found.simulators] == PARTS


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"observed": DATA.values}, "got ndarray without the group of each specimen"),
        ({"observed": DATA[:20]}, r"got no specimen of \['Busch'\]"),
        ({"observed": DATA[:21]}, r"y\[Busch\]: observed: got one "),
        ({"dims": "specimen"}, "dims: got"),
        ({"specimens": [f"s{i % 40}" for i in range(50)]}, "'s0' in Adler and in Busch"),
        ({"weights": np.ones(20)}, "weights"),
        ({"weights": np.repeat([1.0, 0.0], [20, 30])}, r"y\[Busch\]: "),
    ],
)
def test_what_groups_do_not_take_is_refused_before_any_run(
    given: dict[str, Any], message: str
) -> None:
    before = calls
    with pytest.raises((TypeError, ValueError), match=message):
        build(**given)
    assert calls == before


def test_data_that_can_be_set_anew_have_no_groups() -> None:
    with pm.Model(coords={"supplier": NAMES}):
        mu = pm.Normal("mu", 0, 1, dims="supplier")
        x = pm.Normal.dist(mu[prb.response.group("supplier")], 1.0)
        values = pm.Data("values", DATA.values)
        with pytest.raises(TypeError, match="without the group of each specimen"):
            prb.Simulator("y", counting, x, metric=prb.AreaMetric(), observed=values)


def test_decisions_are_asked_of_one_population() -> None:
    model, optimum = case()
    x = specimen(model)
    before = calls
    for ask in (
        lambda: prb.sensitivity(optimum, prb.decision.Quantile(counting, x, probability=0.9)),
        lambda: prb.exceedance(optimum, counting, 3.0, x),
        lambda: prb.plan(optimum, {"more": prb.decision.Condition(counting, x)}),
    ):
        with pytest.raises(TypeError, match=r"prb.response.group\('supplier'\), expected"):
            ask()
    assert calls == before
