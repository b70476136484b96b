"""Fingerprints of problems: which changes make another problem, and what refuses another one."""

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
from one_input import one_input
from pymc.model.fgraph import clone_model

import prbayes as prb
from prbayes.metrics.base import Metric
from prbayes.model.evaluator import Evaluator
from prbayes.model.fingerprint import (
    Identity,
    Level,
    as_attributes,
    as_text,
    from_text,
    identity_from_attributes,
    identity_of,
    problem_differences,
    require_same,
)
from prbayes.model.random_variable import nodes
from prbayes.model.specimen_likelihood import measurements_of
from prbayes.optimize.optimum import Optimum
from prbayes.propagation.base import Propagation

OBSERVED = np.random.default_rng(1).normal(2.0, 1.0, 20)
QUIET: dict[str, Any] = {"progressbar": False}
SMC: dict[str, Any] = {"chains": 1, "adjustment": None, "refine": False, **QUIET}


@dataclass(frozen=True)
class Problem:
    """The parts of a model."""

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
        keys = ("metric", "observed", "weights", "specimens", "epsilon", "propagation")
        with pm.Model() as model:
            mu = self.family(self.hyperparameter, *self.prior)
            if self.potential:
                pm.Potential("penalty", -50.0 * (mu - 5) ** 2)
            x = self.inputs.dist(mu, 1.0)
            given = {key: getattr(self, key) for key in keys}
            prb.Simulator(
                self.name, lambda x, c: self.slope * x + c - 3.0, x, self.constant, **given
            )
        return model


def identified(problem: Problem) -> Identity:
    return identity_of(Evaluator.of(problem.model()))


@cache
def base() -> pm.Model:
    return Problem().model()


@cache
def identity() -> Identity:
    return identity_of(Evaluator.of(base()))


# A change, the lowest level at which it makes another problem, and the message.
CHANGES: dict[str, tuple[dict[str, Any], Level, str]] = {
    "data": ({"observed": OBSERVED + 1}, Level.POPULATIONS, "observed values of y"),
    "weights": (
        {"weights": np.arange(1, 21) / 210}, Level.POPULATIONS, "weights of observed values of y"
    ),
    "labels": ({"specimens": np.arange(20)}, Level.POPULATIONS, "labels of specimens of y"),
    "response": ({"slope": 4.0}, Level.POPULATIONS, "response of y has other values"),
    "constant": ({"constant": 5.0}, Level.POPULATIONS, "inputs of y: got"),
    "inputs": ({"inputs": pm.Gumbel}, Level.POPULATIONS, "inputs of y: got"),
    "hyperparameter": ({"hyperparameter": "nu"}, Level.POPULATIONS, "hyperparameters: got nu"),
    "simulator": ({"name": "z"}, Level.POPULATIONS, r"simulators: got \['z'\]"),
    "prior": ({"prior": (1.5, 1.0)}, Level.PRIORS, "prior of mu: got"),
    "family": ({"family": pm.Laplace}, Level.PRIORS, "prior of mu: got Laplace"),
    "potential": ({"potential": True}, Level.PRIORS, "other likelihood terms: got"),
    "metric": ({"metric": prb.KullbackLeibler()}, Level.OPTIMUM, "metric of y: got"),
    "size of the design": (
        {"propagation": prb.Reweighted(128, max_lost=0.9)}, Level.OPTIMUM, "propagation of y: got"
    ),
    "propagation": ({"propagation": prb.Resimulated(64)}, Level.OPTIMUM, "propagation of y: got"),
    "epsilon": ({"epsilon": 0.2}, Level.POSTERIOR, "epsilon of y: got 0.2, expected 0.1"),
}  # fmt: skip


@pytest.mark.parametrize("change", CHANGES)
def test_changes_make_another_problem_from_their_level_on(change: str) -> None:
    changes, level, message = CHANGES[change]
    changed = identified(Problem(**changes))
    for at in Level:
        if at < level:
            assert problem_differences(changed, identity(), at) == []
            continue
        with pytest.raises(ValueError, match=message):
            require_same(changed, identity(), "here", at)


class Named:
    """Distributions of inputs with a name."""

    @staticmethod
    def dist(*parameters: Any) -> Any:
        return pm.Normal.dist(*parameters, name="spring rate")


@pytest.mark.parametrize(
    ("copy_of", "level"),
    [
        (lambda: Problem().model(), Level.RUN),
        (lambda: Problem(inputs=Named).model(), Level.RUN),
        (lambda: clone_model(base()), Level.RUN),
        (lambda: cloudpickle.loads(cloudpickle.dumps(base())), Level.RUN),
        (lambda: Problem(observed=OBSERVED[::-1]).model(), Level.OPTIMUM),
    ],
    ids=["again", "named input", "clone", "pickle", "order of data"],
)
def test_the_same_problem(copy_of: Callable[[], pm.Model], level: Level) -> None:
    model = copy_of()
    assert problem_differences(identity_of(Evaluator.of(model)), identity(), level) == []
    assert problem_differences(identity_of(model), identity(), level) == []


def test_a_larger_design_is_another_run_of_the_same_problem() -> None:
    model = clone_model(base())
    (node,) = nodes(model).values()
    assert node.reweighted is not None
    node.reweighted.add([np.array([1.0, 2.0])])
    grown = identity_of(Evaluator.of(model))
    assert problem_differences(grown, identity(), Level.POSTERIOR) == []
    assert "number of responses of y" in problem_differences(grown, identity(), Level.RUN)[0]


def test_values_of_densities_are_compared() -> None:
    with pm.Model() as model:
        mu = pm.Normal("mu", 1.0, 1.0)
        pm.Potential("penalty", -((mu - pm.Data("at", 0.0)) ** 2))
        x = pm.Normal.dist(mu, 1.0)
        prb.Simulator("y", np.positive, x, metric=prb.AreaMetric(), observed=OBSERVED)
    evaluator = Evaluator.of(model)
    before = identity_of(evaluator)
    model.set_data("at", 1.0)
    (text,) = problem_differences(identity_of(evaluator), before, Level.OPTIMUM)
    assert "potentials, have other values" in text
    # Priors that print the same
    first, second = (identified(Problem(prior=(1.0, sd))) for sd in (1.0, 1.0 + 1e-4))
    assert first.priors == second.priors
    assert "the priors have other densities" in problem_differences(first, second, Level.OPTIMUM)
    # Rounding is tolerated.
    for relative, is_same in ((1e-9, True), (1e-4, False)):
        numbers = tuple(x * (1 + relative) for x in identity().log_prior)
        changed = replace(identity(), log_prior=numbers)
        assert (problem_differences(changed, identity(), Level.RUN) == []) is is_same


def test_the_function_of_a_metric_is_compared_by_its_values() -> None:
    def identity_at(power: float) -> Identity:
        def distance(simulated: Any, observed: Any, weights: Any) -> Any:
            return np.abs((simulated * weights).sum(-1) - observed.mean()) ** power

        return identified(Problem(metric=prb.FunctionMetric(distance, weighted=True)))

    text = problem_differences(identity_at(1.0), identity_at(2.0), Level.OPTIMUM)[0]
    assert "discrepancy of y has other values" in text


@pytest.mark.parametrize("propagation", [prb.Reweighted(64), prb.Fresh(64)])
def test_an_identity_computes_no_response_and_compares_them(
    propagation: Propagation, monkeypatch: pytest.MonkeyPatch
) -> None:
    evaluator = Evaluator.of(Problem(propagation=propagation).model())
    (node,) = evaluator.nodes
    count, draws = node.bound.responses.count, node.bound.draws
    found = identity_of(evaluator)
    assert (node.bound.responses.count, node.bound.draws) == (count, draws)
    assert len(found.simulators[0].responses) == 16
    assert len(found.log_prior) == 4
    changed = identity_of(Problem(slope=4.0, propagation=propagation).model())
    texts = problem_differences(changed, found, Level.POPULATIONS)
    assert texts == ["the response of y has other values at the same points"]
    # A user's own propagation may store no points.
    monkeypatch.setattr(node.bound, "first_points", ())
    assert not identity_of(evaluator.model).simulators[0].points


def test_text_and_back() -> None:
    original = replace(identity(), prior_minimised=True, log_other=(0.0, -np.inf, np.nan, 1.0))
    back = from_text(as_text(original))
    assert problem_differences(back, original, Level.RUN) == []
    assert as_text(back) == as_text(original)
    assert identity_from_attributes(as_attributes(original)) is not None
    for damaged in ({}, {"identity": "{"}, {"identity": "[1]"}, {"identity": '{"shapes": 3}'}):
        assert identity_from_attributes(damaged) is None
    assert as_attributes(replace(identity(), terms=("x" * 70_000,))) == {}
    # Results of other tools have none.
    require_same(None, identity(), "here")
    require_same(identity(), None, "here")


# Results of a problem, and of one with a change.


@cache
def model_with(change: str) -> pm.Model:
    return clone_model(base()) if not change else Problem(**CHANGES[change][0]).model()


@cache
def optimum(change: str = "") -> Optimum:
    return prb.minimize(model_with(change) if change else base(), starts=0, **QUIET)


@cache
def posterior() -> xr.DataTree:
    return prb.sample_smc(20, model=base(), **SMC)


@cache
def predicted(change: str) -> xr.DataArray:
    model = model_with(change)
    x = pm.Normal.dist(model["mu"], 1.0)
    return prb.predict(optimum(change), lambda x: 2 * x, x, model=model, stored=False)


@cache
def validity() -> prb.validation.ValidityTest:
    return prb.area_test(OBSERVED + 0.1, predicted(""))


@cache
def calibrated() -> dict[str, float]:
    return prb.calibrate_epsilon(optimum())


def test_results_have_an_identity(tmp_path: Path) -> None:
    assert optimum().search.identity is not None
    assert optimum().search.identity.prior_minimised is False
    tree = optimum().to_datatree()
    assert identity_from_attributes(tree["optimum"].attrs) == optimum().search.identity
    posterior().to_netcdf(tmp_path / "draws.nc", engine="h5netcdf")
    with xr.open_datatree(tmp_path / "draws.nc", engine="h5netcdf") as saved:
        found = identity_from_attributes(saved["posterior"].attrs)
    assert found is not None
    assert problem_differences(found, identity(), Level.POSTERIOR) == []


def predict_with(result: Any, change: str) -> xr.DataArray:
    model = model_with(change)
    x = pm.Normal.dist(model["mu"], 1.0)
    return prb.predict(result, np.positive, x, model=model, stored=False)


def report(**results: Any) -> Any:
    return prb.Report("A report", pictures=False, **results)


CONDITIONS = {"a": OBSERVED + 0.1, "b": OBSERVED + 0.2}
# Functions of two results, or of a result and a model with a change; and the level that has to be
# the same.
PAIRS: dict[str, tuple[Level, Callable[[str], Any]]] = {
    "predict: optimum": (Level.POPULATIONS, lambda change: predict_with(optimum(), change)),
    "compare: model": (
        Level.POPULATIONS, lambda change: prb.compare({"a": optimum()}, model=model_with(change))
    ),
    "compare: results": (
        Level.POPULATIONS, lambda change: prb.compare({"a": posterior(), "b": optimum(change)})
    ),
    "Report: posterior, model": (
        Level.PRIORS, lambda change: report(posterior=posterior(), model=model_with(change))
    ),
    "Report: optimum, model": (
        Level.POPULATIONS, lambda change: report(optimum=optimum(), model=model_with(change))
    ),
    "Report: optimum, posterior": (
        Level.POPULATIONS, lambda change: report(optimum=optimum(change), posterior=posterior())
    ),
    "Report: comparison": (
        Level.POPULATIONS,
        lambda change: report(comparison=prb.compare({"a": optimum()}), model=model_with(change)),
    ),
    "Report: validity": (
        Level.POPULATIONS, lambda change: report(validity=validity(), optimum=optimum(change))
    ),
    "plot_landscape: model": (
        Level.POPULATIONS,
        lambda change: prb.plots.plot_landscape(optimum(), model=model_with(change), n_points=5),
    ),
    "plot_population: model": (
        Level.POPULATIONS, lambda change: prb.plots.plot_population(posterior(), model=model_with(change))
    ),
    "plot_responses: model": (
        Level.POPULATIONS, lambda change: prb.plots.plot_responses(optimum(), model=model_with(change))
    ),
    "plot_posterior: optimum": (
        Level.POPULATIONS, lambda change: prb.plots.plot_posterior(posterior(), optimum=optimum(change))
    ),
    "plot_posterior: model": (
        Level.PRIORS, lambda change: prb.plots.plot_posterior(posterior(), model=model_with(change))
    ),
    "diagnose: posterior": (
        Level.OPTIMUM, lambda change: prb.diagnose(posterior(), model=model_with(change))
    ),
    "diagnose: optimum": (
        Level.OPTIMUM, lambda change: prb.diagnose(optimum(), model=model_with(change))
    ),
    "sample_smc: optimum": (
        Level.OPTIMUM,
        lambda change: prb.sample_smc(20, model=model_with(change), optimum=optimum(), **SMC),
    ),
    "sample_smc: epsilon": (
        Level.OPTIMUM,
        lambda change: prb.sample_smc(20, model=model_with(change), epsilon=calibrated(), **SMC),
    ),
    "set_epsilon: epsilon": (
        Level.OPTIMUM,
        lambda change: prb.set_epsilon(clone_model(model_with(change)), calibrated()),
    ),
    "area_test: conditions": (
        Level.OPTIMUM,
        lambda change: prb.area_test(CONDITIONS, {"a": predicted(""), "b": predicted(change)}),
    ),
    "JointNull: prediction": (
        Level.OPTIMUM,
        lambda change: prb.area_test(
            OBSERVED, predicted(change), null=prb.validation.JointNull(optimum(), replicates=19)
        ),
    ),
}  # fmt: skip
# A change of each level, and the change above it, which does not matter there.
AT = {Level.POPULATIONS: ("data", "prior"), Level.PRIORS: ("prior", "metric"),
      Level.OPTIMUM: ("metric", "")}  # fmt: skip


@pytest.mark.parametrize("pair", PAIRS)
def test_results_of_another_problem_are_refused_where_it_matters(pair: str) -> None:
    level, use = PAIRS[pair]
    different, tolerated = AT[level]
    with pytest.raises(ValueError, match=rf"{pair.split(':')[0]}.*result of another problem: "):
        use(different)
    use(tolerated)


@pytest.mark.parametrize("pair", ["Report: posterior, model", "plot_responses: model"])
def test_other_responses_are_refused_like_other_data(pair: str) -> None:
    with pytest.raises(ValueError, match="response of y has other values at the same points"):
        PAIRS[pair][1]("response")


@pytest.mark.parametrize("propagation", [prb.Reweighted(64), prb.Resimulated(64)])
def test_predict_compares_responses_also_with_another_prior(propagation: Any) -> None:
    """Design points are drawn through the prior: responses are computed at those stored."""
    same, wrong = (
        Problem(prior=(1.5, 1.0), slope=slope, propagation=propagation).model()
        for slope in (2.0, 2.01)
    )
    (responses,) = (node.responses for node in nodes(same).values())
    for result in (optimum(), posterior()):
        before = responses.count
        x = pm.Normal.dist(same["mu"], 1.0)
        prb.predict(result, np.positive, x, model=same, stored=False)
        # The function reads the prior from its closure, and therefore counts as another one.
        assert responses.count == before + 2 + 16
        x = pm.Normal.dist(wrong["mu"], 1.0)
        with pytest.raises(ValueError, match="the response of y has other values at the same poi"):
            prb.predict(result, np.positive, x, model=wrong, stored=False)


# Log-likelihoods by specimen, whose models have no runs before their first use.


def likelihood_model(
    response: Callable[..., Any], n_outputs: int = 0, mean: float = 2.0, **given: Any
) -> pm.Model:
    observed = OBSERVED[:12, None] + np.zeros(n_outputs) if n_outputs else OBSERVED[:12]
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", mean, 2.0), pm.HalfNormal("sigma", 2.0), name="x")
        prb.Simulator("y", response, x, **({"observed": observed} | given))
    return model


def times(slope: float, change: float = 0.0, n_outputs: int = 0) -> Callable[[Any], Any]:
    def response(x: Any) -> Any:
        y = slope * x + np.where(np.abs(x - 2.0) < 1.0, change, 0.0)
        return y[..., None] + np.zeros(n_outputs) if n_outputs else y

    return response


@cache
def fitted_likelihood() -> tuple[Optimum, xr.DataTree]:
    model = likelihood_model(times(1.0))
    return prb.minimize(model, **QUIET), prb.sample(100, model=model, random_seed=1, **QUIET)


USES: dict[str, Callable[[Any, pm.Model], Any]] = {
    "diagnose": lambda result, model: prb.diagnose(result, model=model),
    "compare": lambda result, model: prb.compare({"a": result}, model=model),
    "population": lambda result, model: prb.population(result, model=model),
    "individuals": lambda result, model: prb.individuals(result, model=model),
    "Report": lambda result, model: report(
        **{"optimum" if isinstance(result, Optimum) else "posterior": result}, model=model
    ),
}


@pytest.mark.parametrize("use", USES)
def test_a_likelihood_of_another_response_is_refused(use: str) -> None:
    for result in fitted_likelihood():
        with pytest.raises(ValueError, match="the response of y has other values at the same po"):
            USES[use](result, likelihood_model(times(1.01)))


@pytest.mark.long
@pytest.mark.parametrize("use", ["compare", "population"])
def test_a_likelihood_of_the_same_response_is_accepted(
    use: str, caplog: pytest.LogCaptureFixture
) -> None:
    for result in fitted_likelihood():
        USES[use](result, likelihood_model(times(1.0)))
    assert "other-code" not in {getattr(record, "code", "") for record in caplog.records}


def test_the_same_code_computes_no_run_before_the_first_use() -> None:
    model = likelihood_model(times(1.0))
    prb.population(fitted_likelihood()[1], model=model)
    (measurement,) = measurements_of(model).values()
    # Twice in a trial at the simulator's creation, which is no run of the emulator.
    assert measurement.responses.computed == 0


def test_other_priors_leave_responses_comparable() -> None:
    results = {"a": fitted_likelihood()[1]}
    prb.compare(results, model=likelihood_model(times(1.0), mean=1.5))
    with pytest.raises(ValueError, match="the response of y has other values"):
        prb.compare(results, model=likelihood_model(times(1.01), mean=1.5))


def test_other_code_with_the_same_runs_is_reported(caplog: pytest.LogCaptureFixture) -> None:
    def tail(x: Any) -> Any:
        return 1.0 * x + np.where(x > 1e3, 1.0, 0.0)

    prb.population(fitted_likelihood()[1], model=likelihood_model(tail))
    (text,) = [r.getMessage() for r in caplog.records if getattr(r, "code", "") == "other-code"]
    assert "y: its code, or a file that it names, has changed since the result was made" in text


def test_a_change_near_the_data_is_found_by_the_stored_runs() -> None:
    with pytest.raises(ValueError, match="the response of y has other values"):
        prb.population(fitted_likelihood()[1], model=likelihood_model(times(1.0, change=0.1)))


@pytest.mark.long
def test_curves_of_many_outputs_have_an_identity_in_a_file() -> None:
    error = {"metric": prb.LogLikelihood(error=0.5)}
    models = [likelihood_model(times(s, n_outputs=1000), 1000, **error) for s in (1.0, 1.01)]
    result = prb.minimize(models[0], **QUIET).to_datatree()
    assert identity_from_attributes(result["optimum"].attrs) is not None
    with pytest.raises(ValueError, match="the response of y has other values"):
        prb.compare({"a": result}, model=models[1])


@pytest.mark.long
def test_tables_of_other_runs_are_refused() -> None:
    x = np.linspace(-10.0, 14.0, 80)
    tables = [prb.Runs({"x": x}, slope * x) for slope in (1.0, 1.0, 1.01)]
    result = prb.minimize(likelihood_model(tables[0]), **QUIET)
    prb.compare({"a": result}, model=likelihood_model(tables[1]))
    with pytest.raises(ValueError, match="the response of y has other values"):
        prb.compare({"a": result}, model=likelihood_model(tables[2]))


@pytest.mark.long
def test_the_optimum_is_taken_to_the_order_of_a_clone() -> None:
    model = one_input(OBSERVED, prb.AreaMetric(), mu=(2, 1))
    found = prb.minimize(model, starts=0, **QUIET)
    clone = clone_model(model)
    assert (
        Evaluator.of(clone).hyperparameters.names == found.evaluator.hyperparameters.names[::-1]
    ), "else this tests nothing"
    arguments: dict[str, Any] = {"chains": 1, "optimum": found, **QUIET}
    draws = [prb.sample_smc(200, model=m, **arguments)["posterior"] for m in (model, clone)]
    for name in ("mu", "sigma"):
        # Means of 200 draws each: a standard error of .1 sd
        difference = float(draws[0][name].mean() - draws[1][name].mean())
        assert abs(difference) < 0.5 * float(draws[0][name].std())


# Functions of an optimum alone.

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


@cache
def with_data() -> tuple[Optimum, pm.Model]:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", pm.Data("centre", 1.0), 1.0), 1.0)
        prb.Simulator("y", np.positive, x, metric=prb.AreaMetric(), observed=OBSERVED)
    return prb.minimize(model, starts=0, **QUIET), model


@pytest.mark.parametrize("use", ALONE)
def test_the_prior_in_the_objective_and_a_changed_model_are_refused(use: str) -> None:
    ALONE[use](optimum())
    message = rf"{use}: .*got an optimum of discrepancy and prior together"
    with pytest.raises(ValueError, match=message):
        ALONE[use](with_prior())
    found, model = with_data()
    model.set_data("centre", 1.5)
    try:
        with pytest.raises(ValueError, match=rf"{use}: .*prior of mu: got"):
            ALONE[use](found)
        if use == "sampling":
            with pytest.raises(ValueError, match=r"sample_smc: optimum: .*prior of mu: got"):
                prb.sample_smc(20, model=model, optimum=found, **QUIET)
    finally:
        model.set_data("centre", 1.0)


def test_an_optimum_with_the_prior_is_described_as_such() -> None:
    assert with_prior().search.prior
    assert with_prior().search.identity is not None
    assert with_prior().search.identity.prior_minimised
    prb.compare({"without": optimum(), "with": with_prior()}, model=base())
    prb.diagnose(with_prior(), model=base())
    sections = report(optimum=with_prior()).sections
    texts = [str(section.text) for section in sections if section.title == "Optimum"]
    assert "Minus the log prior was part of the objective" in texts[0]
