"""Traps of the log-likelihood by specimen: each is refused, repaired or reported.

Beside each trap are clean data of the same kind, which are not flagged. Numbers of specimens are
such that a trap is seen in at least .95 of the data sets; the slow test counts 20 of them.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import pymc as pm
import pytest
from scipy.stats import beta, gamma, norm

import prbayes as prb
from prbayes._finding import Finding
from prbayes.model.evaluator import Evaluator, specimen_log_likelihoods
from prbayes.model.measurement import SpecimenLikelihood
from prbayes.model.specimen_likelihood import specimen_likelihoods
from prbayes.model.specimen_preparation import prepared
from prbayes.propagation.base import DesignError
from prbayes.response.compile import PLAIN
from prbayes.response.failures import ResponseError
from prbayes.results.likelihood_checks import check_population
from prbayes.specimens.points import SpecimenOptions

type Floats = np.ndarray
SEEDS = range(20)
BAD = [DesignError, ResponseError]


def model_of(
    response: Any,
    inputs: Callable[[], list[Any]],
    y: Any,
    propagation: prb.propagation.Propagation | None = None,
    **given: Any,
) -> pm.Model:
    """Return a model with one simulator."""
    metric = prb.LogLikelihood(**given)
    with pm.Model() as model:
        prb.Simulator("y", response, *inputs(), observed=y, metric=metric, propagation=propagation)
    return model


def normal_input(mean: tuple[float, float] = (0, 2), sd: float = 1.0) -> list[Any]:
    mu, sigma = pm.Normal("mu", *mean), pm.HalfNormal("sigma", sd)
    return [pm.Normal.dist(mu, sigma)]


def two_inputs() -> list[Any]:
    a, b = pm.Normal("a", 1, 0.5), pm.Normal("b", 1, 0.5)
    s, t = pm.HalfNormal("s", 0.5), pm.HalfNormal("t", 0.5)
    return [pm.Normal.dist(a, s), pm.Normal.dist(b, t)]


def line(x: Any) -> Any:
    return 2 * np.asarray(x) + 1


def fold(x: Any) -> Any:
    return np.asarray(x) ** 2


def sorted_frequencies(first: Any, second: Any) -> Any:
    """Return the eigenvalues of two masses with a weak spring between them."""
    a, d = np.asarray(first) + 1, np.asarray(second) + 1
    half, root = (a + d) / 2, np.sqrt((a - d) ** 2 / 4 + 0.04**2)
    return np.stack([half - root, half + root], axis=-1)


class Memory:
    """A solver that starts from the specimen before."""

    def __init__(self) -> None:
        self.last = 0.0

    def __call__(self, x: Any) -> Any:
        values = np.asarray(x, dtype=float)
        result = np.empty_like(values)
        for place in np.ndindex(values.shape):
            self.last = 0.5 * self.last + 0.5 * values[place]
            result[place] = self.last
        return result

    def of_number(self, x: float) -> float:
        return float(self(np.array([x]))[0])


def noisy(sd: float) -> Callable[[Any], Any]:
    rng = np.random.default_rng(1)
    return lambda x: line(x) + sd * rng.standard_normal(np.shape(x))


def likelihood_of(model: pm.Model) -> SpecimenLikelihood:
    (likelihood,) = specimen_likelihoods(model).values()
    return likelihood


@pytest.fixture
def outcome(monkeypatch: pytest.MonkeyPatch) -> Callable[[pm.Model], list[str]]:
    """Return a function of a model: codes of all findings up to the optimum, or its error."""
    codes: list[str] = []

    def recorded(*findings: Finding) -> tuple[Finding, ...]:
        codes.extend(finding.code for finding in findings)
        return findings

    monkeypatch.setattr("prbayes.model.specimen_preparation.report", recorded)
    monkeypatch.setattr("prbayes.optimize.maximum_likelihood.report", recorded)

    def run(model: pm.Model, *, optimum: bool) -> list[str]:
        codes.clear()
        try:
            _ = prepared(likelihood_of(model)).points
            if optimum:
                prb.minimize(model, progressbar=False, starts=1)
        except tuple(BAD) as error:
            return [f"{type(error).__name__}: {error}"]
        return list(codes)

    return run


@dataclass(frozen=True)
class Trap:
    """A model with a trap and a clean one, from a random generator.

    ``expected`` is the code of a finding, or a part of an error.
    """

    expected: str
    trap: Callable[[np.random.Generator], pm.Model]
    clean: Callable[[np.random.Generator], pm.Model]
    optimum: bool = False


def sample(rng: np.random.Generator, n: int = 50, mean: float = 1.0, sd: float = 0.5) -> Floats:
    return rng.normal(mean, sd, n)


def clean_line(rng: np.random.Generator, n: int = 50) -> pm.Model:
    return model_of(line, normal_input, line(sample(rng, n)))


def capped(rng: np.random.Generator, limit: float) -> pm.Model:
    def response(x: Any) -> Any:
        return np.minimum(x, limit)

    return model_of(response, normal_input, response(sample(rng)))


def with_pole(rng: np.random.Generator, pole: float) -> pm.Model:
    def response(x: Any) -> Any:
        return 1 / (np.asarray(x) - pole)

    return model_of(response, normal_input, response(sample(rng)))


def censored(rng: np.random.Generator) -> pm.Model:
    y = line(sample(rng))
    return model_of(line, normal_input, np.minimum(y, np.quantile(y, 0.7)))


def rounded(rng: np.random.Generator) -> pm.Model:
    y = line(sample(rng))
    step = 0.5 * y.std()
    return model_of(line, normal_input, np.round(y / step) * step)


def failing(rng: np.random.Generator, above: float) -> pm.Model:
    """Return a model without response above a limit, where no specimen was measured."""
    x = sample(rng, 100)
    x = x[x < above]

    def response(x: Any) -> Any:
        return np.where(np.asarray(x) > above, np.nan, line(x))

    return model_of(response, normal_input, response(x), prb.Reweighted(64, max_lost=0.9))


def two_outputs(rng: np.random.Generator, response: Any) -> pm.Model:
    first, second = sample(rng, 30, 1.0, 0.3), sample(rng, 30, 1.3, 0.3)
    return model_of(response, two_inputs, response(first, second))


def sums(a: Any, b: Any) -> Any:
    return np.stack([a + b, (a + b) ** 2], axis=-1)


def three_outputs(a: Any, b: Any) -> Any:
    return np.stack([a + b, a - b, a * b], axis=-1)


def two_frequencies(a: Any, b: Any) -> Any:
    first = np.exp((a - b) / 2)
    return np.stack([first, 1.8 * first + 0.2 * np.exp(a)], axis=-1)


def in_order(rng: np.random.Generator, outputs: slice) -> pm.Model:
    y = two_frequencies(sample(rng, 12, 1.0, 0.3), sample(rng, 12, 1.3, 0.3))
    return model_of(two_frequencies, two_inputs, y[:, outputs])


def of_response(rng: np.random.Generator, response: Any) -> pm.Model:
    return model_of(response, normal_input, line(sample(rng)))


def of_data(rng: np.random.Generator, response: Any, change: Callable[[Floats], Floats]) -> Any:
    return model_of(response, normal_input, change(response(sample(rng, 20))))


TRAPS = {
    "cap": Trap(
        "censored-data|limit of measurement",
        partial(capped, limit=1.3),
        partial(capped, limit=40.0),
    ),
    "pole among the specimens": Trap(
        "not smooth enough|outside the range of all runs",
        partial(with_pole, pole=1.0),
        partial(with_pole, pole=-30.0),
    ),
    "censored": Trap("censored-data", censored, clean_line),
    "rounded": Trap("rounded-data", rounded, clean_line),
    "noise of a thousandth": Trap(
        "it is random", lambda rng: of_response(rng, noisy(0.001)), clean_line
    ),
    "state of one by one": Trap(
        "it is random",
        lambda rng: of_response(rng, prb.scalar(Memory().of_number)),
        lambda rng: of_response(rng, prb.scalar(line)),
    ),
    "failing region": Trap(
        "failing-region", partial(failing, above=1.2), partial(failing, above=4.0), True
    ),
    "sum of inputs alone": Trap(
        "not determine a direction of a, b",
        partial(two_outputs, response=sums),
        partial(two_outputs, response=three_outputs),
    ),
    "swapped outputs": Trap(
        "check the order of the outputs|readings-misfit",
        partial(in_order, outputs=slice(None, None, -1)),
        partial(in_order, outputs=slice(None)),
    ),
    "units": Trap(
        "check the units",
        partial(of_data, response=line, change=lambda y: 1000 * y),
        partial(of_data, response=line, change=lambda y: y),
    ),
}
# Two modes of a folded response are no trap, but a result.
HARMLESS = {"second-mode"}
# Outcomes of clean data, which several traps share.
CLEAN: dict[Any, list[str]] = {}


def is_seen(expected: str, outcomes: list[str]) -> bool:
    return any(re.search(expected, text) for text in outcomes)


@pytest.mark.long
@pytest.mark.parametrize("name", TRAPS)
def test_a_trap_is_reported_or_refused(name: str, outcome: Any) -> None:
    trap = TRAPS[name]
    got = outcome(trap.trap(np.random.default_rng(0)), optimum=trap.optimum)
    assert is_seen(trap.expected, got), got
    key = trap.clean, trap.optimum
    if key not in CLEAN:
        CLEAN[key] = outcome(trap.clean(np.random.default_rng(0)), optimum=trap.optimum)
    assert not set(CLEAN[key]) - HARMLESS, CLEAN[key]


@pytest.mark.slow
@pytest.mark.parametrize("name", TRAPS)
def test_a_trap_is_seen_in_nineteen_of_twenty_data_sets(name: str, outcome: Any) -> None:
    trap = TRAPS[name]
    seen, flagged = 0, []
    for seed in SEEDS:
        got = outcome(trap.trap(np.random.default_rng([seed, 1])), optimum=trap.optimum)
        seen += is_seen(trap.expected, got)
        clean = outcome(trap.clean(np.random.default_rng([seed, 2])), optimum=trap.optimum)
        flagged += sorted(set(clean) - HARMLESS)
    assert seen >= 19
    assert len(flagged) <= 1, flagged  # none is expected


@pytest.mark.long
def test_errors_come_before_further_runs() -> None:
    runs = []

    def counted(x: Any) -> Any:
        runs.append(np.size(x))
        return line(x)

    # A likelihood does not keep its model.
    model = model_of(counted, normal_input, 1000 * line(sample(np.random.default_rng(0))))
    with pytest.raises(DesignError, match="check the units"):
        prepared(likelihood_of(model))
    assert sum(runs) <= 10 + 3  # three single ones: specimens by themselves have the same response


def shift(
    model: pm.Model,
    thetas: Floats,
    log_proposal: Floats,
    exact: Callable[[dict[str, Floats]], Floats],
) -> float:
    """Return the largest shift of a posterior mean, in exact posterior standard deviations.

    ``thetas``, (S, d), are unconstrained points with a log-density ``log_proposal``, and ``exact``
    maps hyperparameters by name, (S,) each, to exact log-likelihoods. NaN where the points do not
    cover the posterior.
    """
    evaluator = Evaluator.of(model)
    prior = evaluator.hyperparameters.log_prior(thetas)
    values = evaluator.hyperparameters.constrained(thetas)
    by_name = {str(rv.name): np.asarray(values[str(rv.name)]) for rv in model.free_RVs}
    ours = sum(each.sum(axis=1) for each in specimen_log_likelihoods(evaluator, thetas).values())
    columns = np.stack(list(by_name.values()), axis=1)
    truth = exact(by_name)
    logs = np.nan_to_num(truth + prior - log_proposal, nan=-np.inf)
    weights = np.exp(logs - logs.max())
    # Truncated (Ionides 2008), for posteriors with longer tails than the proposal.
    weights = np.minimum(weights, weights.mean() * np.sqrt(len(weights)))
    weights /= weights.sum()
    if 1 / (weights**2).sum() < 15:  # the points do not cover the posterior
        return np.nan
    difference = np.where(weights > 0, ours - np.where(weights > 0, truth, 0.0), -np.inf)
    others = weights * np.exp(difference - difference.max())
    others /= others.sum()
    mean = weights @ columns
    sd = np.sqrt(weights @ (columns - mean) ** 2)
    return float((np.abs(others @ columns - mean) / sd).max())


def around_optimum(model: pm.Model, n: int = 1000, wide: float = 1.4) -> tuple[Floats, Floats]:
    """Return points of a normal proposal around the optimum, and their log-density."""
    optimum = prb.minimize(model, progressbar=False)
    root = wide * np.linalg.cholesky(optimum.covariance)
    u = np.random.default_rng(5).standard_normal((n, len(root)))
    return optimum.theta + u @ root.T, -(u**2).sum(axis=1) / 2


def around_normal(x: Floats, n: int = 1000, wide: float = 1.4) -> tuple[Floats, Floats]:
    """Return the same around the exact optimum of a normal input: mean and log deviation."""
    center = np.array([x.mean(), np.log(x.std())])
    error = np.array([x.std() / np.sqrt(len(x)), 1 / np.sqrt(2 * len(x))])
    u = np.random.default_rng(5).standard_normal((n, 2))
    return center + wide * u * error, -(u**2).sum(axis=1) / 2


def over_box(bounds: Floats, n: int = 2000) -> tuple[Floats, Floats]:
    """Return points that are uniform in a box, (2, d), and their log-density."""
    u = np.random.default_rng(6).random((n, bounds.shape[1]))
    return bounds[0] + u * (bounds[1] - bounds[0]), np.zeros(n)


def normal_log(x: Floats, mean: Floats, sd: Floats) -> Floats:
    """Return log-likelihoods of normal populations, (S,)."""
    return norm.logpdf(x, mean[:, None], sd[:, None]).sum(axis=1)


def jump_at_one(x: Any) -> Any:
    return np.asarray(x) + 1.0 * (np.asarray(x) > 1)


RESPONSES: dict[str, Any] = {
    "jump": jump_at_one,
    "pole": lambda x: 1 / (np.asarray(x) - 2.0),
    "pole outside": lambda x: 1 / (np.asarray(x) - 30.0),
}


def one_input_model(name: str, seed: int) -> tuple[pm.Model, Floats]:
    """Return a problem with one normal input, and the inputs of its specimens."""
    x = sample(np.random.default_rng([seed, 3]), 3 if name == "three specimens" else 50)
    response = RESPONSES.get(name, line)
    return model_of(response, normal_input, response(x)), x


def one_input(name: str, seed: int) -> float:
    model, x = one_input_model(name, seed)
    thetas = around_normal(x, wide=2.5 if name == "three specimens" else 1.4)
    return shift(model, *thetas, lambda at: normal_log(x, at["mu"], at["sigma"]))


def with_few_starts(model: pm.Model, starts: int) -> SpecimenLikelihood:
    """Give the likelihood of a model so many starts of the search for roots."""
    likelihood = likelihood_of(model)
    vars(likelihood)["options"] = replace(SpecimenOptions(), starts=starts)
    return likelihood


def folded_shift(seed: int, starts: int) -> tuple[float, int]:
    """Return the shift with so many starts, and the number of roots of all specimens."""
    rng = np.random.default_rng([seed, 4])
    x = sample(rng, 50, 0.6, 0.4)

    def prior() -> list[Any]:
        return normal_input((0.2, 0.5), 0.5)

    model = model_of(fold, prior, fold(x))
    likelihood = with_few_starts(model, starts)

    def exact(at: dict[str, Floats]) -> Floats:
        both = [norm.logpdf(s * x, at["mu"][:, None], at["sigma"][:, None]) for s in (1, -1)]
        return np.logaddexp(*both).sum(axis=1)

    bounds = np.array([[-1.1, np.log(0.2)], [1.1, np.log(1.2)]])
    shifted = shift(model, *over_box(bounds), exact)
    return shifted, len(prepared(likelihood).proposals.modes.specimen)


@pytest.mark.long
def test_a_start_in_each_basin_finds_nearly_all_roots() -> None:
    shifted, count = folded_shift(1, SpecimenOptions().starts)
    assert count == 100
    assert shifted <= 0.1
    # Without further starts the second root of a pair between two runs may be missing.
    _, count = folded_shift(1, 1)
    assert count < 100
    straight = model_of(line, normal_input, line(sample(np.random.default_rng(0))))
    modes = prepared(with_few_starts(straight, 1)).proposals.modes
    np.testing.assert_array_equal(np.bincount(modes.specimen), 1)


def crossing_model(seed: int) -> tuple[pm.Model, Floats]:
    rng = np.random.default_rng([seed, 5])
    x = np.stack([sample(rng, 30, 1.0, 0.3), sample(rng, 30, 1.3, 0.3)])
    return model_of(sorted_frequencies, two_inputs, sorted_frequencies(*x)), x


def crossing_shift(seed: int) -> float:
    model, x = crossing_model(seed)

    def exact(at: dict[str, Floats]) -> Floats:
        def log_density(k1: Floats, k2: Floats) -> Floats:
            first = norm.logpdf(k1, at["a"][:, None], at["s"][:, None])
            return first + norm.logpdf(k2, at["b"][:, None], at["t"][:, None])

        return np.logaddexp(log_density(*x), log_density(*x[::-1])).sum(axis=1)

    # Two modes that overlap: the proposal at one of them is wide.
    return shift(model, *around_optimum(model, n=1000, wide=2.0), exact)


def is_repaired_or_reported(
    outcome: Any, model: pm.Model, shift_of: Callable[[int], float], seed: int
) -> bool:
    """Return whether a posterior is right, or a finding or an error reports what is wrong.

    A specimen beyond a pole may have no root of the emulator, and is reported for that.
    """
    got = outcome(model, optimum=False)
    reports = ("emulator-error", "not smooth", "two halves", "readings-misfit")
    if any(is_seen(code, got) for code in reports):
        return True
    return shift_of(seed) <= 0.1


ROUGH: dict[str, tuple[Callable[[int], tuple[pm.Model, Floats]], Callable[[int], float]]] = {
    "crossing modes": (crossing_model, crossing_shift),
    "jump": (partial(one_input_model, "jump"), partial(one_input, "jump")),
    "pole": (partial(one_input_model, "pole"), partial(one_input, "pole")),
}


@pytest.mark.long
@pytest.mark.parametrize("name", ROUGH)
def test_a_rough_response_is_repaired_or_reported(name: str, outcome: Any) -> None:
    model, shift_of = ROUGH[name]
    assert is_repaired_or_reported(outcome, model(1)[0], shift_of, 1)


def sum_shift(seed: int) -> float:
    """Return the shift of two inputs that enter only through their sum."""
    rng = np.random.default_rng([seed, 8])
    y = sample(rng, 50, 1.0, 0.3) + sample(rng, 50, 1.3, 0.3)
    model = model_of(lambda a, b: a + b, two_inputs, y)
    thetas = Evaluator.of(model).hyperparameters.prior_points(1024, 3)
    log_proposal = Evaluator.of(model).hyperparameters.log_prior(thetas)
    return shift(
        model,
        thetas,
        log_proposal,
        lambda at: normal_log(y, at["a"] + at["b"], np.hypot(at["s"], at["t"])),
    )


SHIFTS: dict[str, Callable[[int], float]] = {
    "three specimens": partial(one_input, "three specimens"),
    "pole outside": partial(one_input, "pole outside"),
    "ridge": sum_shift,
}


@pytest.mark.long
@pytest.mark.parametrize("name", SHIFTS)
def test_the_posterior_is_exact(name: str) -> None:
    assert SHIFTS[name](0) <= 0.1


@pytest.mark.long
def test_rounding_is_named_alone_before_the_family() -> None:
    y = np.random.default_rng(0).normal(10, 0.7, 25).round()
    optimum = prb.minimize(model_of(line, normal_input, y), progressbar=False)
    assert [finding.code for finding in optimum.findings] == ["rounded-data"]
    checked = check_population(optimum)
    assert not checked.findings
    assert "pass rounded= to y first" in checked.untested[0]


def errors_at(
    model: pm.Model,
    populations: list[tuple[float, float]],
    log_density: Callable[[float, float], Floats],
    **others: float,
) -> Floats:
    """Return the errors of the log-likelihood at values of a and b, less their mean.

    The Jacobian of the response is common to all populations.
    """
    function = model.compile_logp(vars=model.observed_RVs, jacobian=False, mode=PLAIN)
    errors = [
        float(function({"a_log__": np.log(a), "b_log__": np.log(b), **others}))
        - log_density(a, b).sum()
        for a, b in populations
    ]
    return np.array(errors) - np.mean(errors)


@pytest.mark.parametrize("response", [np.positive, lambda x: x + 0.3 * np.sin(3 * x)])
def test_specimens_beside_the_ends_of_a_range(response: Callable[[Any], Any]) -> None:
    # Two of ten specimens are 7e-7 and 3e-5 from an end, where the density is infinite.
    x = np.random.default_rng(70).beta(0.3, 0.3, 10)
    with pm.Model() as model:
        population = pm.Beta.dist(pm.HalfNormal("a", 5), pm.HalfNormal("b", 5))
        prb.Simulator("y", response, population, observed=response(x))
    populations = [(0.2, 0.2), (0.3, 0.3), (0.5, 0.3), (0.3, 0.15), (1.0, 1.0)]
    # An error of 3 % of the distance from the end is not reported: .03 (1 - .15) nats for each of
    # the two specimens.
    errors = errors_at(model, populations, lambda a, b: beta.logpdf(x, a, b))
    assert errors == pytest.approx(np.zeros(5), abs=0.05)


BESIDE = np.random.default_rng(1).beta(2, 2, 12)
ENDED: dict[str, Callable[[], Any]] = {
    "beta": lambda: pm.Beta.dist(pm.HalfNormal("a", 5), pm.HalfNormal("b", 5)),
    "gamma": lambda: pm.Gamma.dist(pm.HalfNormal("a", 5), pm.HalfNormal("b", 5)),
    "weibull": lambda: pm.Weibull.dist(pm.HalfNormal("a", 5), pm.HalfNormal("b", 5)),
    "exponential": lambda: pm.Exponential.dist(pm.HalfNormal("rate", 5)),
}


def model_with_end(family: str, end: float, response: Any = np.positive, **given: Any) -> pm.Model:
    with pm.Model() as model:
        data = response(np.append(BESIDE, end))
        prb.Simulator("y", response, ENDED[family](), observed=data, **given)
    return model


def refusal_or_report(model: pm.Model, caplog: pytest.LogCaptureFixture) -> str:
    """Return why an exact reading near an end is refused, or what is reported of it, if anything.

    The rounding of the processor decides how accurate the emulator is there.
    """
    try:
        prb.sample(50, model=model, progressbar=False)
    except prb.propagation.DesignError as error:
        return str(error)
    reports = [r.getMessage() for r in caplog.records if getattr(r, "code", "") == "emulator-error"]
    return "".join(reports)


@pytest.mark.long
@pytest.mark.parametrize(
    ("family", "end"),
    [("beta", 1.0), ("gamma", 0.0)],
)
def test_an_exact_reading_at_an_end_is_refused_or_reported_by_its_row(
    family: str, end: float, caplog: pytest.LogCaptureFixture
) -> None:
    assert "specimen 12" in refusal_or_report(model_with_end(family, end), caplog)
    metric = prb.LogLikelihood(error=0.01)
    posterior = prb.sample(50, model=model_with_end(family, end, metric=metric), progressbar=False)
    assert posterior.posterior["a"].std() < 1.0


@pytest.mark.long
@pytest.mark.parametrize("end", [0.0, 1e-6, 1e-4])
def test_two_inputs_with_a_reading_at_an_end_do_not_blame_the_response(end: float) -> None:
    c = np.random.default_rng(2).normal(0, 0.5, 13)
    x = np.append(BESIDE, end)
    with pm.Model() as model:
        inputs = ENDED["beta"](), pm.Normal.dist(pm.Normal("mu", 0, 1), pm.HalfNormal("s", 1))
        prb.Simulator(
            "y", lambda x, c: np.stack([x + 0 * c, c + 0.1 * x], -1), *inputs,
            observed=np.stack([x, c + 0.1 * x], -1),
        )  # fmt: skip
    if end > 1e-5:  # the least error of an emulator, as a share of the scatter
        populations = [(0.5, 1.0), (1.0, 1.0), (0.7, 0.7)]
        others = {"mu": 0.0, "s_log__": np.log(0.5)}
        errors = errors_at(model, populations, lambda a, b: beta.logpdf(x, a, b), **others)
        assert errors == pytest.approx(np.zeros(3), abs=0.05)
        return
    with pytest.raises(prb.propagation.DesignError, match="exact reading of specimen 12 whose in"):
        prb.sample(model=model, progressbar=False)


@pytest.mark.long
def test_a_density_that_is_finite_at_the_end_needs_no_error() -> None:
    models = [model_with_end("exponential", end) for end in (0.0, 1e-4)]
    posteriors = [
        prb.sample(model=model, random_seed=1, progressbar=False).posterior for model in models
    ]
    for name in posteriors[0].data_vars:
        means = [float(posterior[name].mean()) for posterior in posteriors]
        assert means[0] == pytest.approx(means[1], rel=0.02)


@pytest.mark.long
@pytest.mark.parametrize(("family", "end"), [("weibull", 1e-5), ("gamma", 1e-7)])
def test_readings_as_small_as_the_error_of_the_emulator_are_no_secret(
    family: str, end: float, caplog: pytest.LogCaptureFixture
) -> None:
    assert "specimen 12" in refusal_or_report(model_with_end(family, end), caplog)


@pytest.mark.parametrize("end", [1e-5, 1e-7])
def test_the_logarithm_of_a_response_resolves_small_readings(end: float) -> None:
    model = model_with_end("gamma", end, response=np.log)
    x = np.append(BESIDE, end)
    populations = [(0.4, 1.0), (0.8, 2.0), (1.5, 3.0)]
    errors = errors_at(model, populations, lambda a, b: gamma.logpdf(x, a, scale=1 / b))
    assert errors == pytest.approx(np.zeros(3), abs=0.01)


@pytest.mark.long
def test_readings_with_an_error_beside_the_ends_of_a_range() -> None:
    # Some readings are beyond the ends, where the emulator's error is small beside theirs.
    rng = np.random.default_rng(2)
    x = rng.beta(0.5, 0.5, 30)
    y = np.sin(x) + 0.2 * rng.normal(size=30)
    runs = []

    def response(x: Any) -> Any:
        runs.append(np.size(x))
        return np.sin(x)

    with pm.Model() as model:
        a, b = pm.HalfNormal("a", 5), pm.HalfNormal("b", 5)
        inputs = pm.Beta.dist(a, b)
        metric = prb.LogLikelihood(error=0.2)
        node = prb.Simulator("y", response, inputs, observed=y, metric=metric)
    function = model.compile_logp(vars=[node], jacobian=False, mode=PLAIN)
    nodes = (np.arange(200_000) + 0.5) / 200_000
    for a_value, b_value in ((1.3, 1.0), (2.0, 2.0)):
        point = {"a_log__": np.log(a_value), "b_log__": np.log(b_value)}
        at = beta.ppf(nodes, a_value, b_value)
        density = norm.pdf(y[:, None], np.sin(at), 0.2).mean(axis=1)
        assert float(function(point)) == pytest.approx(np.log(density).sum(), abs=0.05)
    assert sum(runs) <= 60
