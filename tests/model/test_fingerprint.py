"""What is the same problem, what is another one, and what refuses another one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import cloudpickle
import numpy as np
import pymc as pm
import pytest
import xarray as xr
from pymc.model.fgraph import clone_model

import prbayes as prb
from prbayes.metrics.base import Metric
from prbayes.model.evaluator import Evaluator
from prbayes.model.fingerprint import (
    Identity,
    Level,
    as_attributes,
    as_text,
    differences,
    from_attributes,
    from_text,
    identity_of,
    identity_of_model,
    require_same,
)
from prbayes.model.random_variable import nodes
from prbayes.optimize.optimum import Optimum
from prbayes.propagation.base import Propagation

OBSERVED = np.random.default_rng(1).normal(2.0, 1.0, 20)
QUIET = {"progressbar": False}


@dataclass(frozen=True)
class Problem:
    """A model, from what it is made of."""

    prior: tuple[float, float] = (1.0, 1.0)
    family: Callable[..., Any] = pm.Normal
    slope: float = 2.0
    constant: float = 3.0
    inputs: Any = pm.Normal
    metric: Metric = field(default_factory=prb.AreaMetric)
    observed: Any = field(default_factory=lambda: OBSERVED)
    weights: Any = None
    specimens: Any = None
    propagation: Propagation = field(default_factory=lambda: prb.Reweighted(64, max_lost=0.9))
    epsilon: float | None = 0.1
    potential: bool = False
    hyperparameter: str = "mu"
    name: str = "y"

    def model(self) -> pm.Model:
        with pm.Model() as model:
            mu = self.family(self.hyperparameter, *self.prior)
            if self.potential:
                pm.Potential("penalty", -50.0 * (mu - 5) ** 2)
            prb.Simulator(
                self.name,
                lambda x, c: self.slope * x + c - 3.0,
                self.inputs.dist(mu, 1.0),
                self.constant,
                metric=self.metric,
                observed=self.observed,
                weights=self.weights,
                specimens=self.specimens,
                epsilon=self.epsilon,
                propagation=self.propagation,
            )
        return model


@cache
def base() -> pm.Model:
    return Problem().model()


@cache
def identity() -> Identity:
    return identity_of(Evaluator.of(base()))


@cache
def optimum() -> Optimum:
    return prb.minimize(base(), starts=0, **QUIET)


@cache
def posterior() -> xr.DataTree:
    return prb.sample_smc(20, chains=1, model=base(), adjustment=None, refine=False, **QUIET)


uneven = np.arange(1, 21) / 210
# What is changed, the lowest level at which that is another problem, and what the message says.
CHANGES: dict[str, tuple[Problem, Level, str]] = {
    "data": (Problem(observed=OBSERVED + 1), Level.POPULATIONS, "observed values of y"),
    "weights": (Problem(weights=uneven), Level.POPULATIONS, "weights of observed values of y"),
    "labels": (Problem(specimens=np.arange(20)), Level.POPULATIONS, "labels of specimens of y"),
    "response": (Problem(slope=4.0), Level.POPULATIONS, "response of y has other values"),
    "constant": (Problem(constant=5.0), Level.POPULATIONS, "inputs of y: got"),
    "inputs": (Problem(inputs=pm.Gumbel), Level.POPULATIONS, "inputs of y: got"),
    "hyperparameter": (Problem(hyperparameter="nu"), Level.POPULATIONS, "hyperparameters: got nu"),
    "simulator": (Problem(name="z"), Level.POPULATIONS, r"simulators: got \['z'\]"),
    "prior": (Problem(prior=(-3.0, 0.1)), Level.PRIORS, "prior of mu: got"),
    "family": (Problem(family=pm.Laplace), Level.PRIORS, "prior of mu: got Laplace"),
    "potential": (Problem(potential=True), Level.PRIORS, "other likelihood terms: got"),
    "metric": (Problem(metric=prb.KullbackLeibler()), Level.OPTIMUM, "metric of y: got"),
    "size of the design": (
        Problem(propagation=prb.Reweighted(128, max_lost=0.9)),
        Level.OPTIMUM,
        "propagation of y: got",
    ),
    "propagation": (
        Problem(propagation=prb.Resimulated(64)),
        Level.OPTIMUM,
        "propagation of y: got",
    ),
    "epsilon": (Problem(epsilon=0.2), Level.POSTERIOR, "epsilon of y: got 0.2, expected 0.1"),
}


@pytest.mark.parametrize("change", CHANGES)
def test_changes_are_told_from_their_level_on(change: str) -> None:
    problem, level, message = CHANGES[change]
    other = identity_of(Evaluator.of(problem.model()))
    for at in Level:
        if at < level:
            assert differences(other, identity(), at) == []
            continue
        with pytest.raises(ValueError, match=message):
            require_same(other, identity(), "here", at)


def test_the_same_model_built_again_is_the_same_problem() -> None:
    assert identity_of(Evaluator.of(Problem().model())) == identity()


def test_what_an_input_is_called_makes_no_other_problem() -> None:
    named = Problem(inputs=_Named).model()
    assert differences(identity_of_model(named), identity(), Level.RUN) == []


class _Named:
    """Distributions of inputs that have a name."""

    @staticmethod
    def dist(*parameters: Any) -> Any:
        return pm.Normal.dist(*parameters, name="spring rate")


def test_clones_and_copies_are_the_same_problem() -> None:
    for other in (clone_model(base()), cloudpickle.loads(cloudpickle.dumps(base()))):
        found = identity_of(Evaluator.of(other))
        assert differences(found, identity(), Level.RUN) == []


def test_clones_that_order_variables_otherwise_are_the_same_problem() -> None:
    def model_of(names: str) -> pm.Model:
        with pm.Model() as model:
            made = {name: pm.Normal(name, {"a": 0.0, "b": 1.0}[name], 1.0) for name in names}
            for name in names:
                prb.Simulator(
                    f"y{name}",
                    np.positive,
                    pm.Normal.dist(made["a"] + made["b"], 1.0),
                    metric=prb.AreaMetric(),
                    observed=OBSERVED,
                    propagation=prb.Resimulated(64),
                )
        return model

    one, other = (identity_of(Evaluator.of(model_of(names))) for names in ("ab", "ba"))
    assert differences(one, other, Level.OPTIMUM) == []


def test_a_design_that_has_grown_is_another_run_of_the_same_problem() -> None:
    model = clone_model(base())
    (node,) = nodes(model).values()
    assert node.reweighted is not None
    node.reweighted.add([np.array([1.0, 2.0])])
    grown = identity_of(Evaluator.of(model))
    assert differences(grown, identity(), Level.POSTERIOR) == []
    assert "number of responses of y" in differences(grown, identity(), Level.RUN)[0]


def test_the_order_of_data_does_not_matter() -> None:
    reordered = Problem(observed=OBSERVED[::-1]).model()
    assert differences(identity_of(Evaluator.of(reordered)), identity(), Level.OPTIMUM) == []


def test_data_of_the_model_that_move_the_prior_are_noticed() -> None:
    with pm.Model() as model:
        mu = pm.Normal("mu", pm.Data("centre", 1.0), 1.0)
        x = pm.Normal.dist(mu, 1.0)
        prb.Simulator("y", np.positive, x, metric=prb.AreaMetric(), observed=OBSERVED)
    found = prb.minimize(model, starts=0, **QUIET)
    model.set_data("centre", 1.5)
    with pytest.raises(ValueError, match=r"sample_smc: optimum: .*prior of mu: got"):
        prb.sample_smc(20, model=model, optimum=found, **QUIET)
    with pytest.raises(ValueError, match=r"calibrate_epsilon: .*prior of mu: got"):
        prb.calibrate_epsilon(found)


def test_a_potential_that_changes_its_values_is_noticed() -> None:
    with pm.Model() as model:
        mu = pm.Normal("mu", 1.0, 1.0)
        pm.Potential("penalty", -((mu - pm.Data("at", 0.0)) ** 2))
        x = pm.Normal.dist(mu, 1.0)
        prb.Simulator("y", np.positive, x, metric=prb.AreaMetric(), observed=OBSERVED)
    evaluator = Evaluator.of(model)
    before = identity_of(evaluator)
    model.set_data("at", 1.0)
    assert (
        "potentials, have other values"
        in differences(identity_of(evaluator), before, Level.OPTIMUM)[0]
    )


def test_a_metric_whose_function_changes_is_noticed() -> None:
    def model_of(power: float) -> pm.Model:
        def distance(simulated: Any, observed: Any, weights: Any) -> Any:
            return np.abs((simulated * weights).sum(-1) - observed.mean()) ** power

        return Problem(metric=prb.FunctionMetric(distance, weighted=True)).model()

    one, other = (identity_of(Evaluator.of(model_of(power))) for power in (1.0, 2.0))
    assert "discrepancy of y has other values" in differences(one, other, Level.OPTIMUM)[0]


def test_rounding_is_tolerated_and_more_is_not() -> None:
    one = identity()
    for relative, same in ((1e-9, True), (1e-4, False)):
        numbers = tuple(x * (1 + relative) for x in one.log_prior)
        assert (differences(replace(one, log_prior=numbers), one, Level.RUN) == []) is same


def test_no_response_is_computed_for_an_identity() -> None:
    for propagation in (prb.Reweighted(64), prb.Resimulated(64), prb.Fresh(64)):
        evaluator = Evaluator.of(Problem(propagation=propagation).model())
        (node,) = evaluator.nodes
        count, draws = node.bound.responses.count, node.bound.draws
        found = identity_of(evaluator)
        assert (node.bound.responses.count, node.bound.draws) == (count, draws)
        assert len(found.simulators[0].responses) == 8
        assert len(found.log_prior) == 4


@pytest.mark.parametrize("propagation", [prb.Resimulated(64), prb.Fresh(64)], ids=repr)
def test_other_responses_are_noticed_where_none_is_stored(propagation: Propagation) -> None:
    one, other = (Problem(slope=s, propagation=propagation).model() for s in (2.0, 4.0))
    found = differences(identity_of_model(one), identity_of_model(other), Level.POPULATIONS)
    assert found == ["the response of y has other values at the same points"]


def test_text_comes_back() -> None:
    one = replace(identity(), prior_minimised=True, log_other=(0.0, -np.inf, np.nan, 1.0))
    back = from_text(as_text(one))
    assert differences(back, one, Level.RUN) == []
    assert as_text(back) == as_text(one)
    assert from_attributes(as_attributes(one)) is not None
    for nothing in ({}, {"identity": "{"}, {"identity": "[1]"}, {"identity": '{"shapes": 3}'}):
        assert from_attributes(nothing) is None


def test_an_identity_too_long_for_a_file_is_left_out() -> None:
    assert as_attributes(replace(identity(), terms=("x" * 70_000,))) == {}


def test_nothing_is_asked_of_a_result_of_other_tools() -> None:
    require_same(None, identity(), "here")
    require_same(identity(), None, "here")


def test_results_carry_it(tmp_path: Path) -> None:
    assert optimum().search.identity is not None
    assert optimum().search.identity.prior_minimised is False
    tree = optimum().to_datatree()
    assert from_attributes(tree["optimum"].attrs) == optimum().search.identity
    posterior().to_netcdf(tmp_path / "draws.nc", engine="h5netcdf")
    with xr.open_datatree(tmp_path / "draws.nc", engine="h5netcdf") as saved:
        found = from_attributes(saved["posterior"].attrs)
    assert found is not None
    assert differences(found, identity_of(Evaluator.of(base())), Level.POSTERIOR) == []


def test_priors_that_print_the_same_are_compared_by_their_densities() -> None:
    one, other = (Problem(prior=(1.0, sd)).model() for sd in (1.0, 1.0 + 1e-4))
    found = [identity_of(Evaluator.of(model)) for model in (one, other)]
    assert found[0].priors == found[1].priors, "else this tests nothing"
    assert "the priors have other densities" in differences(*found, Level.OPTIMUM)


# Refusals.


def test_sample_smc_refuses_an_optimum_of_another_problem() -> None:
    for change in ("data", "response", "prior", "metric", "size of the design"):
        other = CHANGES[change][0].model()
        with pytest.raises(
            ValueError, match=r"sample_smc: optimum: got a result of another .*prb.min"
        ):
            prb.sample_smc(20, model=other, optimum=optimum(), **QUIET)


def test_sample_smc_takes_a_clones_optimum_and_the_clones_own_epsilon() -> None:
    clone = clone_model(base())
    prb.set_epsilon(clone, {"y": 0.3})
    tree = prb.sample_smc(
        20, chains=1, model=clone, optimum=optimum(), adjustment=None, refine=False, **QUIET
    )
    assert float(tree["calibration"]["epsilon"][0]) == 0.3


@pytest.mark.long
def test_the_optimum_is_taken_to_the_order_of_a_clone() -> None:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 2, 1), pm.HalfNormal("sigma", 1))
        prb.Simulator("y", np.positive, x, metric=prb.AreaMetric(), observed=OBSERVED)
    found = prb.minimize(model, starts=0, **QUIET)
    clone = clone_model(model)
    assert Evaluator.of(clone).hyperparameters.names == found.names[::-1], "else this tests nothing"
    arguments: dict[str, Any] = {"chains": 1, "optimum": found, **QUIET}
    one, other = (prb.sample_smc(200, model=m, **arguments) for m in (model, clone))
    for name in ("mu", "sigma"):
        sd = float(one["posterior"][name].std())
        # Means of 200 draws each: a standard error of .1 sd
        assert (
            abs(float(one["posterior"][name].mean() - other["posterior"][name].mean())) < 0.5 * sd
        )


@pytest.mark.parametrize("result", [optimum, posterior], ids=["optimum", "posterior"])
def test_predict_refuses_another_problem(result: Callable[[], Any]) -> None:
    for change in ("data", "response", "inputs"):
        other = CHANGES[change][0].model()
        with pytest.raises(ValueError, match=r"prb.predict: got a result of another problem"):
            prb.predict(result(), np.positive, pm.Normal.dist(other["mu"], 1.0), model=other)


def test_predict_takes_a_model_with_another_prior_metric_or_epsilon() -> None:
    for change in ("prior", "metric", "epsilon"):
        other = CHANGES[change][0].model()
        x = pm.Normal.dist(other["mu"], 1.0)
        found = prb.predict(optimum(), np.positive, x, model=other, stored=False)
        assert found.shape == (1, 1, 500)


@pytest.mark.parametrize("propagation", [prb.Reweighted(64), prb.Resimulated(64)])
def test_predict_refuses_another_prior_and_another_response_together(propagation: Any) -> None:
    """Their design points are others, so that no two known responses can be compared."""
    same, wrong = (
        Problem(prior=(1.5, 1.0), slope=slope, propagation=propagation).model()
        for slope in (2.0, 2.01)
    )
    (count,) = (node.bound.responses for node in nodes(same).values())
    for result in (optimum(), posterior()):
        before = count.count
        x = pm.Normal.dist(same["mu"], 1.0)
        prb.predict(result, np.positive, x, model=same, stored=False)
        assert count.count == before + 2
        x = pm.Normal.dist(wrong["mu"], 1.0)
        with pytest.raises(ValueError, match="the response of y has other values at the same poi"):
            prb.predict(result, np.positive, x, model=wrong, stored=False)


def test_compare_refuses_results_of_different_data() -> None:
    other = prb.minimize(CHANGES["data"][0].model(), starts=0, **QUIET)
    with pytest.raises(
        ValueError, match="compare: b: got a result of another problem: other obser"
    ):
        prb.compare({"a": optimum(), "b": other})
    with pytest.raises(
        ValueError, match="compare: a: got a result of another problem: other obser"
    ):
        prb.compare({"a": optimum(), "b": other}, model=other.model)


def test_compare_takes_results_of_other_metrics_and_epsilons() -> None:
    other = prb.minimize(CHANGES["metric"][0].model(), starts=0, **QUIET)
    table = prb.compare({"a": optimum(), "b": other, "c": posterior()}, model=base())
    assert table.sizes["result"] == 3


def test_an_epsilon_calibrated_for_another_problem_is_refused() -> None:
    calibrated = prb.calibrate_epsilon(optimum())
    assert calibrated == dict(calibrated)
    for change in ("data", "response", "metric", "prior"):
        other = CHANGES[change][0].model()
        with pytest.raises(ValueError, match="set_epsilon: got a result of another problem"):
            prb.set_epsilon(other, calibrated)
        with pytest.raises(
            ValueError, match="sample_smc: epsilon: got a result of another problem"
        ):
            prb.sample_smc(20, model=other, epsilon=calibrated, adjustment=None, **QUIET)
    clone = clone_model(base())
    prb.set_epsilon(clone, calibrated)
    (node,) = nodes(clone).values()
    assert node.epsilon_value == calibrated["y"]


# Every public function that is given two things of a problem: how much of them has to be the same.


@cache
def other_model(change: str) -> pm.Model:
    """Return a model that differs from the base, or is a clone of it."""
    if change == "nothing":
        return clone_model(base())
    return {"prior": Problem(prior=(1.5, 1.0))}.get(change, CHANGES[change][0]).model()


@cache
def other_optimum(change: str) -> Optimum:
    return prb.minimize(other_model(change), starts=0, **QUIET)


@cache
def predicted(change: str) -> xr.DataArray:
    model = other_model(change)
    x = pm.Normal.dist(model["mu"], 1.0)
    return prb.predict(other_optimum(change), lambda x: 2 * x, x, model=model, stored=False)


@cache
def validity() -> prb.validation.ValidityTest:
    return prb.area_test(OBSERVED + 0.1, predicted("nothing"))


@cache
def calibrated() -> dict[str, float]:
    return prb.calibrate_epsilon(optimum())


def sampled(change: str, **given: Any) -> Any:
    settings: dict[str, Any] = {"chains": 1, "adjustment": None, "refine": False, **QUIET}
    return prb.sample_smc(20, model=other_model(change), **settings, **given)


def report(**results: Any) -> Any:
    return prb.Report("A report", pictures=False, **results)


def new_input(change: str) -> Any:
    return pm.Normal.dist(other_model(change)["mu"], 1.0)


PAIRS: dict[str, tuple[Level, Callable[[str], Any]]] = {
    "predict: optimum, model": (
        Level.POPULATIONS,
        lambda change: prb.predict(
            optimum(), np.positive, new_input(change), model=other_model(change), stored=False
        ),
    ),
    "predict: posterior, model": (
        Level.POPULATIONS,
        lambda change: prb.predict(
            posterior(), np.positive, new_input(change), model=other_model(change), stored=False
        ),
    ),
    "compare: result, model": (
        Level.POPULATIONS,
        lambda change: prb.compare({"a": optimum()}, model=other_model(change)),
    ),
    "compare: two results": (
        Level.POPULATIONS,
        lambda change: prb.compare({"a": posterior(), "b": other_optimum(change)}),
    ),
    "Report: posterior, model": (
        Level.PRIORS,
        lambda change: report(posterior=posterior(), model=other_model(change)),
    ),
    "Report: optimum, model": (
        Level.POPULATIONS,
        lambda change: report(optimum=optimum(), model=other_model(change)),
    ),
    "Report: optimum, posterior": (
        Level.POPULATIONS,
        lambda change: report(optimum=other_optimum(change), posterior=posterior()),
    ),
    "Report: comparison, model": (
        Level.POPULATIONS,
        lambda change: report(comparison=prb.compare({"a": optimum()}), model=other_model(change)),
    ),
    "Report: validity, optimum": (
        Level.POPULATIONS,
        lambda change: report(validity=validity(), optimum=other_optimum(change)),
    ),
    "plot_landscape: optimum, model": (
        Level.POPULATIONS,
        lambda change: prb.plot_landscape(optimum(), model=other_model(change), points=5),
    ),
    "plot_population: posterior, model": (
        Level.POPULATIONS,
        lambda change: prb.plot_population(posterior(), model=other_model(change)),
    ),
    "plot_responses: optimum, model": (
        Level.POPULATIONS,
        lambda change: prb.plot_responses(optimum(), model=other_model(change)),
    ),
    "plot_posterior: posterior, optimum": (
        Level.POPULATIONS,
        lambda change: prb.plot_posterior(posterior(), optimum=other_optimum(change)),
    ),
    "plot_posterior: posterior, model": (
        Level.PRIORS,
        lambda change: prb.plot_posterior(posterior(), model=other_model(change)),
    ),
    "diagnose: posterior, model": (
        Level.OPTIMUM,
        lambda change: prb.diagnose(posterior(), model=other_model(change)),
    ),
    "diagnose: optimum, model": (
        Level.OPTIMUM,
        lambda change: prb.diagnose(optimum(), model=other_model(change)),
    ),
    "sample_smc: optimum, model": (
        Level.OPTIMUM,
        lambda change: sampled(change, optimum=optimum()),
    ),
    "sample_smc: epsilon, model": (
        Level.OPTIMUM,
        lambda change: sampled(change, epsilon=calibrated()),
    ),
    "set_epsilon: model, epsilon": (
        Level.OPTIMUM,
        lambda change: prb.set_epsilon(clone_model(other_model(change)), calibrated()),
    ),
    "area_test: two conditions": (
        Level.OPTIMUM,
        lambda change: prb.area_test(
            {"a": OBSERVED + 0.1, "b": OBSERVED + 0.2},
            {"a": predicted("nothing"), "b": predicted(change)},
        ),
    ),
    "JointNull: optimum, prediction": (
        Level.OPTIMUM,
        lambda change: prb.area_test(
            OBSERVED,
            predicted(change),
            null=prb.validation.JointNull(optimum(), replicates=19),
        ),
    ),
}
FROM = {
    "nothing": None,
    "data": Level.POPULATIONS,
    "prior": Level.PRIORS,
    "metric": Level.OPTIMUM,
}


@pytest.mark.parametrize("change", FROM)
@pytest.mark.parametrize("pair", PAIRS)
def test_two_things_of_different_problems_are_refused_where_it_matters(
    pair: str, change: str
) -> None:
    level, use = PAIRS[pair]
    caller = pair.partition(":")[0]
    differs_from = FROM[change]
    if differs_from is not None and differs_from <= level:
        with pytest.raises(ValueError, match=rf"{caller}.*got a result of another problem: "):
            use(change)
    else:
        use(change)


def test_other_responses_are_refused_like_other_data() -> None:
    for pair in ("Report: posterior, model", "plot_responses: optimum, model"):
        with pytest.raises(ValueError, match="response of y has other values at the same points"):
            PAIRS[pair][1]("response")


# An optimum alone, whose model may have changed, or whose objective had the prior in it.

ALONE: dict[str, Callable[[Optimum], Any]] = {
    "calibrate_epsilon": prb.calibrate_epsilon,
    "bootstrap": lambda found: prb.bootstrap(found, 20, **QUIET),
    "cross_validate": lambda found: prb.cross_validate(found, folds=2),
    "JointNull": prb.validation.JointNull,
    "sampling": lambda found: found.sampling(),
}


@cache
def with_prior() -> Optimum:
    return prb.minimize(base(), prior=True, starts=0, **QUIET)


@pytest.mark.parametrize("use", ALONE)
def test_an_optimum_with_the_prior_is_refused_where_the_minimiser_is_meant(use: str) -> None:
    ALONE[use](optimum())
    with pytest.raises(
        ValueError, match=rf"{use}: .*got an optimum of discrepancy and prior together"
    ):
        ALONE[use](with_prior())


def test_an_optimum_with_the_prior_serves_elsewhere_and_says_so() -> None:
    assert with_prior().search.prior
    assert with_prior().identity is not None
    assert with_prior().identity.prior_minimised
    prb.compare({"without": optimum(), "with": with_prior()}, model=base())
    prb.diagnose(with_prior(), model=base())
    sections = prb.Report("A report", optimum=with_prior(), pictures=False).sections
    told = [str(section.text) for section in sections if section.title == "Optimum"]
    assert "Minus the log prior was part of the objective" in told[0]


@pytest.mark.parametrize("use", ALONE)
def test_an_optimum_whose_model_has_changed_since_is_refused(use: str) -> None:
    found, model = that_may_change()
    model.set_data("centre", 1.5)
    try:
        with pytest.raises(ValueError, match=rf"{use}: .*prior of mu: got"):
            ALONE[use](found)
    finally:
        model.set_data("centre", 1.0)


@cache
def that_may_change() -> tuple[Optimum, pm.Model]:
    with pm.Model() as model:
        mu = pm.Normal("mu", pm.Data("centre", 1.0), 1.0)
        x = pm.Normal.dist(mu, 1.0)
        prb.Simulator("y", np.positive, x, metric=prb.AreaMetric(), observed=OBSERVED)
    return prb.minimize(model, starts=0, **QUIET), model


def test_a_propagation_that_knows_no_responses_has_an_identity_too(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    model = base()
    bound = next(iter(nodes(model).values())).bound
    monkeypatch.setattr(bound, "first_points", ())
    assert not identity_of_model(model).simulators[0].points
