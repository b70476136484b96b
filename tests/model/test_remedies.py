"""Each refusal names remedies that the same model accepts."""

import re
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
import pymc as pm
import pytest

import prbayes as prb
from prbayes.model.remedies import remedies_of
from prbayes.model.specimen_likelihood import specimen_likelihoods
from prbayes.propagation.base import DesignError
from prbayes.response import ResponseError

RNG = np.random.default_rng(1)
DATA = RNG.normal(1.0, 0.3, 20)
LOADS = np.linspace(0.9, 1.1, 20)
TIMES = np.tile([1.0, 2.0], (20, 1))
LABELS = np.repeat(np.arange(10), 2)
RUNS = prb.Runs({"x": np.linspace(-3, 5, 40)}, np.linspace(-3, 5, 40))

# A problem adds variables to the model on the stack, and returns inputs and keyword arguments of a
# simulator. ``change`` maps an epistemic input to the input that a remedy puts in its place.
type Change = Callable[[Any], Any]
type Problem = Callable[[Change], tuple[list[Any], dict[str, Any]]]


def population() -> Any:
    return pm.Normal.dist(pm.Normal("mu", 1, 1), pm.HalfNormal("sigma", 1))


def counts() -> Any:
    return pm.Poisson.dist(pm.HalfNormal("rate", 2))


def times() -> Any:
    return prb.response.condition("time", TIMES)


def load() -> Any:
    return prb.response.condition("load", LOADS)


def common() -> Any:
    return pm.Normal("common", 2, 0.5)


def nested() -> Any:
    return pm.Normal.dist(pm.Normal.dist(pm.Normal("mu", 1, 1), 1.0), 0.5)


def on_load() -> Any:
    return pm.Normal.dist(pm.Normal("mu", 1, 1) + load(), 1.0)


def without_density() -> Any:
    def draw(mu: Any, rng: Any = None, size: Any = None) -> Any:
        return rng.normal(mu, 1.0, size)

    return pm.CustomDist.dist(pm.Normal("mu", 1, 1), random=draw)


def problem(*kinds: Callable[[], Any], **options: Any) -> Problem:
    """Return a problem of inputs by kind; those that are called `common` are changed."""

    def inputs(change: Change) -> tuple[list[Any], dict[str, Any]]:
        made = [change(kind()) if kind in (common, data, loads) else kind() for kind in kinds]
        return made, {"observed": DATA, **options}

    return inputs


def data() -> Any:
    return pm.Data("size", 2.0)


def loads() -> Any:
    return pm.Data("load", LOADS)


TWO = np.stack([DATA, 2 * DATA + RNG.normal(0, 0.1, 20)], axis=1)
PR, AREA = prb.ProbabilityResidual(), prb.AreaMetric()
UNWEIGHTED = prb.FunctionMetric(lambda simulated, observed: np.abs(np.mean(simulated, -1)))
REFUSED: Mapping[str, Problem] = {
    "common": problem(population, common),
    "common, two outputs": problem(population, common, observed=TWO),
    "common, times": problem(population, times, common, observed=TWO),
    "common, metric": problem(population, common, metric=PR),
    "common, discrete": problem(counts, common, observed=np.arange(20)),
    "common, discrete, metric": problem(counts, common, metric=AREA),
    "data": problem(population, data),
    "data of each specimen": problem(population, loads),
    "discrete": problem(counts),
    "discrete, two outputs": problem(counts, observed=TWO),
    "discrete, resimulated": problem(counts, metric=AREA, propagation=prb.Resimulated()),
    "nested": problem(nested),
    "nested, metric": problem(nested, metric=PR),
    "without density": problem(without_density),
    "without density, metric": problem(without_density, metric=PR),
    "random": problem(population, propagation=prb.Fresh()),
    "random, condition": problem(population, load, propagation=prb.Fresh()),
    "random, covariate": problem(on_load, propagation=prb.Fresh()),
    "random, discrete": problem(counts, propagation=prb.Fresh()),
    "unweighted, common": problem(population, common, metric=UNWEIGHTED),
    "few specimens": problem(population, observed=TWO[:3], metric=prb.Joint(PR)),
    "few specimens, discrete": problem(counts, observed=TWO[:3], metric=prb.Joint(PR)),
    "covariate, metric": problem(on_load, metric=PR),
    "failures": problem(population, observed=np.r_[DATA[:-1], np.inf]),
    "emulator": problem(population, propagation=prb.Reweighted(emulator=None)),
}


def build(make: Problem, change: Change = lambda x: x, **remedy: Any) -> None:
    with pm.Model():
        inputs, options = make(change)
        options |= remedy
        options = {k: v for k, v in options.items() if v is not None}
        prb.Simulator("y", lambda *x: x[0], *inputs, **options)


def changed(text: str) -> Change:
    """Return the change of an input that an advice states."""

    def change(x: Any) -> Any:
        names = {"pm": pm, "prb": prb, x.name: x, "values": LOADS}
        return eval(text, names)

    return change


def named_remedies(message: str) -> list[dict[str, Any]]:
    """Return arguments of `build` for each remedy in a message."""
    advice = message.partition("; ")[2]
    remedies: list[dict[str, Any]] = []
    pattern = r"pm\.Normal\.dist\(.*?\)|prb\.response\.condition\(.*?\)|\w+\.get_value\(\)"
    remedies += [{"change": changed(text)} for text in re.findall(pattern, advice)]
    remedies += [{"propagation": None} for _ in re.findall("leave propagation= out", advice)]
    remedies += [{"metric": None} for _ in re.findall("leave metric= out", advice)]
    single = {"observed": TWO[:3, 0], "metric": PR}
    remedies += [single for _ in re.findall("leave outputs out", advice)]
    remedies += [{"propagation": None} for _ in re.findall("leave emulator= out", advice)]
    calls = r"(?:metric=(prb\.\w+\(.*?\)+))?(?: with |use )?(?:propagation=(prb\.\w+\(\)))?"
    for metric, propagation in re.findall(calls, advice):
        values = {"metric": metric, "propagation": propagation}
        remedy = {key: eval(text, {"prb": prb}) for key, text in values.items() if text}
        remedies += [remedy] if remedy else []
    return remedies


@pytest.mark.parametrize("case", REFUSED)
def test_each_remedy_of_a_refusal_is_accepted_by_the_same_model(case: str) -> None:
    with pytest.raises((TypeError, ValueError)) as caught:
        build(REFUSED[case])
    message = str(caught.value)
    assert len(message) < 5 * 90
    remedies = named_remedies(message)
    assert remedies, message
    for remedy in remedies:
        build(REFUSED[case], **remedy)


PREPARED: Mapping[str, tuple[Problem, str]] = {
    "one output": (problem(population), "prb.ProbabilityResidual()"),
    "two outputs": (problem(population, observed=TWO), "prb.Joint(prb.ProbabilityResidual())"),
    "outputs as many as specimens": (problem(population, observed=TWO[:3]), ""),
    "condition": (problem(population, load), ""),
    "covariate": (problem(on_load), ""),
    "times": (problem(population, times, observed=TWO), ""),
    "error": (problem(population, metric=prb.LogLikelihood(error=0.1)), ""),
    "censored": (problem(population, metric=prb.LogLikelihood(censored=(None, 1.5))), ""),
    "rounded": (problem(population, metric=prb.LogLikelihood(rounded=0.1)), ""),
    "labels": (problem(population, specimens=np.arange(20)), "prb.ProbabilityResidual()"),
    "repeats": (
        problem(population, specimens=LABELS, metric=prb.LogLikelihood(error=0.1)),
        "",
    ),
}


@pytest.mark.parametrize("case", PREPARED)
def test_a_metric_is_named_only_where_it_compares_the_same_readings(case: str) -> None:
    make, expected = PREPARED[case]
    with pm.Model() as model:
        inputs, options = make(lambda x: x)
        prb.Simulator("y", lambda *x: x[0], *inputs, **options)
    (likelihood,) = specimen_likelihoods(model).values()
    runs, metric = remedies_of(likelihood)
    assert metric == (f"use metric={expected}" if expected else "")
    assert "prb.Reweighted(n)" in runs
    assert "prb.Resimulated()" in runs
    for propagation in (prb.Reweighted(512), prb.Resimulated()):
        build(make, propagation=propagation)
    if expected:
        build(make, metric=eval(expected, {"prb": prb}))


@pytest.mark.parametrize(
    ("response", "propagation", "expected"),
    [
        (RUNS, None, "add the runs that prb.propose_runs(model) returns"),
        (np.square, prb.Resimulated(), ""),
    ],
)
def test_more_runs_are_those_of_the_response(
    response: Any, propagation: Any, expected: str
) -> None:
    with pm.Model() as model:
        prb.Simulator("y", response, population(), observed=DATA, propagation=propagation)
    (likelihood,) = specimen_likelihoods(model).values()
    assert remedies_of(likelihood) == (expected, "use metric=prb.ProbabilityResidual()")


def test_simulators_of_the_same_specimens_change_their_metric_together() -> None:
    with pm.Model() as model:
        x = population()
        for name in "yz":
            prb.Simulator(name, np.exp, x, observed=DATA, specimens=np.arange(20))
    likelihood = next(iter(specimen_likelihoods(model).values()))
    assert remedies_of(likelihood)[1] == "use metric=prb.ProbabilityResidual() in y and z"


@pytest.mark.long
def test_a_known_cause_has_no_second_guess() -> None:
    # The response saturates below the readings.
    with pm.Model() as model:
        observed = np.random.default_rng(0).normal(3, 0.2, 20)
        prb.Simulator("y", lambda x: 5 + x**2, population(), observed=observed, progressbar=False)
    with pytest.raises(DesignError) as caught:
        prb.minimize(model)
    message = str(caught.value)
    assert message.startswith("y: the readings of 20 of 20 specimens are outside the range")
    assert "Therefore" not in message
    assert "metric=" not in message


@pytest.mark.parametrize(("rows", "outputs"), [(3, 3), (2, 3)])
def test_transposed_readings_are_named(rows: int, outputs: int) -> None:
    with pm.Model() as model:
        observed = np.random.default_rng(0).normal(1, 0.2, (rows, 20))
        prb.Simulator(
            "y",
            lambda x: np.stack([x**k for k in range(1, outputs + 1)], axis=-1),
            population(),
            observed=observed,
            progressbar=False,
        )
    with pytest.raises(ResponseError, match=rf"transpose it if it has {outputs} rows"):
        prb.minimize(model)


def test_an_array_with_a_number_of_each_specimen_is_a_condition() -> None:
    def fit(load: Any) -> None:
        with pm.Model() as model:
            prb.Simulator("y", np.multiply, population(), load, observed=DATA, progressbar=False)
        prb.minimize(model, starts=0)

    with pytest.raises(ResponseError, match=r"prb\.response\.condition") as caught:
        fit(LOADS)
    text = re.search(r"prb\.response\.condition\(.*?\)", str(caught.value))
    assert text is not None
    fit(eval(text.group(), {"prb": prb, "values": LOADS}))


# -- remedies of refusals that come with the runs, or with a result --

# A call of a small model with options, of the response, of the simulator or of the function in
# question; the regular expression of the advice in the refusal; the options that follow it.
type Use = Callable[..., Any]
SETTINGS: Mapping[str, Any] = {"progressbar": False, "random_seed": 1}
AT_LEAST = 0.72 + np.abs(DATA - 0.72)


def below(value: float) -> Callable[..., Any]:
    """Return the input, times the load if there is one, with a value where it is below .7."""

    def response(x: Any, load: Any = 1.0) -> Any:
        return np.where(x < 0.7, value, x * load)

    return response


LOSSY = below(np.nan)


def model_of(*inputs: Callable[[], Any], response: Any = np.positive, **options: Any) -> pm.Model:
    with pm.Model() as model:
        settings = {"observed": AT_LEAST, "progressbar": False, **options}
        prb.Simulator("y", response, *[make() for make in inputs], **settings)
    return model


def sampled(*inputs: Callable[[], Any], function: Any = prb.sample, **options: Any) -> Any:
    keywords = {k: options.pop(k) for k in ("epsilon", "adjustment") if k in options}
    return function(100, model=model_of(*inputs, **options), **keywords, **SETTINGS)


def table(without: int | None = None) -> Any:
    """Sample with a table of runs, row 20 of which is wrong."""
    x = np.linspace(-3, 5, 40)
    y = x + 0.5 * (np.arange(40) == 20)
    is_kept = np.arange(40) != (-1 if without is None else without)
    return sampled(population, response=prb.Runs({"x": x[is_kept]}, y[is_kept]))


def joined(**options: Any) -> None:
    """Build two simulators of the same specimens with labels by an index."""
    index = [f"s{i}" for i in range(20)]
    options = options or {"dims": "specimen"}
    with pm.Model(coords={"specimen": index}):
        x = population()
        for name in "yz":
            prb.Simulator(name, np.positive, x, observed=DATA, **options)


def kernel(call: str = "None") -> Any:
    model = model_of(population, metric=PR)
    eval(call, {"prb": prb, "model": model})
    with model:
        return prb.posterior.BatchedKernel(20)


LOST = r"return \+inf for specimens that fail, or pass a larger max_lost, as in "
LOST += r"propagation=prb\.Reweighted\(n, max_lost=\.\.\.\)"
LARGER = {"propagation": prb.Reweighted(max_lost=0.5)}
USED: Mapping[str, tuple[Use, Mapping[str, Any], str, list[dict[str, Any]]]] = {
    "lost mass": (
        partial(sampled, population),
        {"response": LOSSY},
        LOST,
        [{"response": below(np.inf)}, LARGER],
    ),
    "lost mass, metric": (
        partial(sampled, population, metric=PR),
        {"response": LOSSY},
        r"return \+inf for specimens that fail, narrow the priors, or raise max_lost",
        [{"response": below(np.inf)}, {"propagation": prb.Reweighted(max_lost=0.9)}],
    ),
    "no response under a condition": (
        partial(sampled, population, load),
        {"response": LOSSY, "observed": AT_LEAST * LOADS},
        "return inf there if these specimens fail, or a number beside all readings",
        [{"response": below(0.0)}, {"response": below(np.inf)}],
    ),
    "an outlier of a table": (table, {}, "or leave out row 20 ", [{"without": 20}]),
    "epsilon of a likelihood": (
        partial(sampled, population, function=prb.sample_smc),
        {"epsilon": 0.1},
        "leave epsilon= out, or pass adjustment=None with a metric",
        [{"epsilon": None}, {"adjustment": None, "metric": PR}],
    ),
    "random responses": (
        partial(sampled, population, metric=PR),
        {"propagation": prb.Fresh(64)},
        r"expected prb\.Reweighted\(\) or prb\.Resimulated\(\), or prb\.sample_smc with "
        "adjustment=None, whose draws are as wide as epsilon",
        [
            {"propagation": prb.Reweighted()},
            {"propagation": prb.Resimulated(256)},
            {"function": prb.sample_smc, "adjustment": None},
            {"function": prb.sample_smc, "adjustment": None, "epsilon": 0.05},
        ],
    ),
    "equal labels": (
        joined,
        {},
        r"pass specimens=\[str\(label\) for label in index\] to both and leave dims= out",
        [{"specimens": [f"s{i}" for i in range(20)]}],
    ),
    "no epsilon": (
        kernel,
        {},
        r"prb\.set_epsilon\(model, prb\.calibrate_epsilon\(prb\.minimize\(model\)\)\)",
        [{"call": "prb.set_epsilon(model, prb.calibrate_epsilon(prb.minimize(model)))"}],
    ),
}


@pytest.mark.long
@pytest.mark.parametrize("case", USED)
def test_each_remedy_gets_past_the_refusal_of_a_use(case: str) -> None:
    use, options, advice, remedies = USED[case]
    with pytest.raises((TypeError, ValueError, RuntimeError)) as caught:
        use(**options)
    assert re.search(advice, str(caught.value)), str(caught.value)
    for remedy in remedies:
        use(**options | remedy)
