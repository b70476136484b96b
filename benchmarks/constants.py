"""What changes where a constant of the package is half or twice as large.

Every number at the top of a module in the rooms that touch statistics, elements of tuples and of the
levels of support among them, but for those of `SKIPPED`, that by their nature touch memory or words.
Each is set to half and to twice its value; of a share beyond one half, or a ratio close to one, that
is half and twice its distance from one. Then every problem is calibrated that runs code which reads the constant: optimum,
standard errors, epsilon and a posterior of 400 draws, or a test of validity. The table has,
for each problem whose answers change at all, the largest change over hyperparameters of

- the optimum, in standard errors; the standard errors, and epsilon, as factors;
- the posterior's mean, in its standard deviations; its standard deviation, as a factor;
- the number of responses, as a factor; p-values, as a difference; and whether the verdict (converged,
  warnings by their number) changes, or an error ends it.

The first row says how much another seed of the sampler changes. docs/appendix/constants.md shows the table.

One process imports and compiles what can be kept; each variation is a fork of it, so that none sees
another's: in one thread, as forks of a process with several may hang. The file is written after
each row, and rows that it has are not computed again.

    OMP_NUM_THREADS=1 uv run python -m benchmarks.constants [--only sandwich] [--anew] [--check]
"""

from __future__ import annotations

import argparse
import ast
import dataclasses
import gc
import importlib
import logging
import os
import pickle
import re
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from selectors import EVENT_READ, DefaultSelector
from types import CodeType
from typing import Any

import numpy as np
import pymc as pm

import prbayes as prb
from benchmarks import record

PACKAGE = Path(prb.__file__).parent
ROOMS = (
    "posterior",
    "validation",
    "surrogate",
    "model",
    "estimate",
    "propagation",
    "emulators",
    "metrics",
    "_weighted",
    "_predict",
    "_diagnose",
)
COLUMNS = ("optimum", "stderr", "epsilon", "mean", "sd", "responses", "p")
RESULTS = record.RESULTS / "constants.json"
# The problem that docs/appendix/constants.md leaves out of its table.
LEFT_OUT = "two inputs, PR, N = 30"
# Seconds for all problems of one variation: many times what they take.
PATIENCE = 300
# What by its nature touches no answer.
SKIPPED = {
    "_diagnose._NOISE": "the limit of a test that simulates it (tests/results/test_diagnose.py)",
    "estimate.data_sets._MOST_POINTS": "memory",
    "estimate.measured._LEVELS": "quantiles, and what they are of a normal distribution",
    "estimate.measured._WIDTH": "quantiles, and what they are of a normal distribution",
    "model.support.VISIBLE": "pictures",
    "posterior.sbc._CHUNK": "how often progress is shown",
}


def modules() -> Iterator[tuple[str, Path]]:
    """Yield the modules of the rooms, with their files."""
    for room in ROOMS:
        inside = sorted((PACKAGE / room).glob("*.py")) or [PACKAGE / f"{room}.py"]
        for path in inside:
            dotted = ".".join(path.relative_to(PACKAGE).with_suffix("").parts)
            yield f"prbayes.{dotted}", path


def names(path: Path) -> Iterator[str]:
    """Yield the names in capitals that a module binds at its top."""
    for statement in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(statement, ast.Assign):
            for target in statement.targets:
                elements = target.elts if isinstance(target, ast.Tuple) else [target]
                for element in elements:
                    if isinstance(element, ast.Name) and element.id.isupper():
                        yield element.id


def is_number(value: object) -> bool:
    """Return whether a value is a number; truth is none."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def leaves(value: Any) -> Iterator[tuple[str, float, Callable[[float], Any]]]:
    """Yield the numbers in a constant: what to call each, its value, and the constant with another."""
    if is_number(value):
        yield "", value, lambda other: other
    elif isinstance(value, tuple):
        for i, element in enumerate(value):
            for label, number, whole in leaves(element):
                yield f"[{i}]{label}", number, partial(_in_tuple, value, i, whole)
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        for field in dataclasses.fields(value):
            for label, number, whole in leaves(getattr(value, field.name)):
                yield f".{field.name}{label}", number, partial(_in_record, value, field.name, whole)


def _in_tuple(value: tuple[Any, ...], i: int, whole: Callable[[float], Any], other: float) -> Any:
    return (*value[:i], whole(other), *value[i + 1 :])


def _in_record(value: Any, name: str, whole: Callable[[float], Any], other: float) -> Any:
    return dataclasses.replace(value, **{name: whole(other)})


def varied(value: float, factor: float) -> float:
    """Return a number that is larger by a factor, or farther from one where it is close to it."""
    if isinstance(value, int):
        return max(1, round(value * factor))
    if 0.5 < value <= 1.5 and value != 1:
        return 1 + (value - 1) * factor
    return value * factor


@dataclasses.dataclass(frozen=True)
class Variation:
    """A constant and its other value."""

    module: str
    constant: str
    label: str
    value: Any
    old: float

    def read_by(self, names: set[tuple[str, str]]) -> bool:
        """Return whether code read it, whose files and names these are."""
        private = self.constant.startswith("_")
        own = sys.modules[self.module].__file__
        return any(n == self.constant and (f == own or not private) for f, n in names)

    def make(self) -> None:
        """Set it, wherever it was imported, or is a default."""
        here = sys.modules[self.module]
        setattr(here, self.constant, self.value)
        if self.constant.startswith("_"):
            return
        for name, module in list(sys.modules.items()):
            if name.startswith("prbayes") and hasattr(module, self.constant):
                setattr(module, self.constant, self.value)


def variations() -> list[Variation]:
    """Return all variations."""
    found = []
    for module, path in modules():
        for name in names(path):
            short = f"{module.removeprefix('prbayes.')}.{name}"
            value = getattr(importlib.import_module(module), name)
            for inner, number, whole in leaves(value):
                if short in SKIPPED or not number:
                    continue
                for sign, factor in (("/ 2", 0.5), ("x 2", 2.0)):
                    other = varied(number, factor)
                    if other != number:
                        label = f"{short}{inner} = {number:g} {sign}"
                        found.append(Variation(module, name, label, whole(other), number))
    return found


def one_input(
    response: Any, observed: Any, metric: prb.Metric, propagation: Any = None
) -> pm.Model:
    """Return a model of one normal input."""
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1.2, 1.0), pm.HalfNormal("sigma", 1.0))
        prb.Simulator(
            "y",
            response,
            x,
            metric=metric,
            observed=observed,
            propagation=propagation or prb.Reweighted(256),
        )
    return model


def two_inputs(rng: np.random.Generator) -> pm.Model:
    """Return a model of two inputs and two responses of the same specimens."""
    a, b = rng.normal(1.0, 0.3, 30), rng.normal(2.0, 0.5, 30)
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu_a", 1, 1), pm.HalfNormal("sd_a", 1))
        y = pm.Normal.dist(pm.Normal("mu_b", 2, 1), pm.HalfNormal("sd_b", 1))
        common: dict[str, Any] = {"metric": prb.ProbabilityResidual(), "specimens": np.arange(30)}
        for name, sign in (("sum", 1), ("difference", -1)):
            prb.Simulator(
                name,
                lambda x, y, sign=sign: x + sign * y,
                x,
                y,
                observed=a + sign * b,
                propagation=prb.Reweighted(256, max_points=1024),
                **common,
            )
    return model


def three_outputs(rng: np.random.Generator) -> pm.Model:
    """Return a model of two inputs and three outputs of a run, emulated between 64 runs."""
    a, b = rng.normal(1.0, 0.3, 40), rng.normal(2.0, 0.5, 40)

    def response(x: Any, y: Any) -> Any:
        return np.stack(np.broadcast_arrays(x * y, x + 0.3 * y**2, np.exp(0.5 * y) - x), axis=-1)

    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu_a", 1, 1), pm.HalfNormal("sd_a", 1))
        y = pm.Normal.dist(pm.Normal("mu_b", 2, 1), pm.HalfNormal("sd_b", 1))
        prb.Simulator(
            "y",
            response,
            x,
            y,
            metric=prb.Joint(prb.ProbabilityResidual()),
            observed=response(a, b),
            propagation=prb.Reweighted(64),
        )
    return model


def kolmogorov(simulated: Any, observed: Any, weights: Any) -> Any:
    """Return the largest difference of two distribution functions."""
    measured = np.broadcast_to(observed, (*simulated.shape[:-1], observed.size))
    values = np.concatenate([simulated, measured], axis=-1)
    steps = np.concatenate([weights, np.full(measured.shape, -1 / observed.size)], axis=-1)
    gaps = np.take_along_axis(steps, np.argsort(values, axis=-1), axis=-1).cumsum(axis=-1)
    return np.abs(gaps).max(axis=-1)


def minimised(build: Callable[[], pm.Model], **options: Any) -> prb.Optimum:
    """Build a model and minimise."""
    return prb.minimize(build(), progressbar=False, **options)


def sampled(optimum: prb.Optimum, random_seed: int) -> dict[str, Any]:
    """Sample, and return all answers."""
    posterior = prb.sample_smc(
        400, chains=1, model=optimum.model, optimum=optimum, random_seed=random_seed, progressbar=False)  # fmt: skip
    draws = posterior["calibration"].dataset["theta"].values[0]
    return {
        "theta": optimum.theta,
        "stderr": np.sqrt(np.diag(optimum.covariance)),
        "epsilon": np.array(list(prb.calibrate_epsilon(optimum).values())),
        "mean": draws.mean(axis=0),
        "sd": draws.std(axis=0),
        "responses": np.array([posterior["posterior"].attrs["n_responses"]], dtype=float),
        "p": np.empty(0),
        "verdict": (bool(optimum.converged), len(optimum.findings)),
    }


def on_surrogate(rng: np.random.Generator) -> tuple[Any, ...]:
    """Return an optimum on a surrogate, with what was made for it."""
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1.2, 1.0), pm.HalfNormal("sigma", 1.0))
        surface = prb.Surrogate.fit(lambda x: np.sinh(x) + 0.2 * np.sin(9 * x), [(-6, 8)], 48)
        observed = np.sinh(1.0 + 0.6 * rng.standard_normal(25))
        metric = prb.ProbabilityResidual()
        prb.Simulator(
            "y", surface.with_error(1), x, metric=metric, observed=observed,
            propagation=prb.Reweighted(256),
        )  # fmt: skip
    return prb.minimize(model, progressbar=False), surface, x, rng


def validity(case: tuple[Any, ...], random_seed: int) -> dict[str, Any]:
    """Test a calibration on a surrogate, against fresh data and its own."""
    optimum, surface, x, rng = case
    model = optimum.model
    posterior = prb.sample_smc(
        200,
        chains=2,
        model=model,
        optimum=optimum,
        random_seed=random_seed,
        progressbar=False,
    )
    fresh = np.sinh(1.3 + 0.6 * rng.standard_normal(12))
    best = prb.predict(optimum, surface, x, model=model)
    predicted = prb.predict(posterior, surface, x, model=model)
    joint = prb.validation.JointNull(optimum, responses=(surface, x), replicates=199)
    tests = [
        prb.area_test(fresh, predicted),
        prb.area_test(fresh, best),
        prb.area_test(fresh, best, null=joint),
    ]
    error = surface.error.relative
    return {
        "theta": optimum.theta,
        "stderr": np.sqrt(np.diag(optimum.covariance)),
        "epsilon": np.array([error]),
        "mean": np.empty(0),
        "sd": np.empty(0),
        "responses": np.array([surface.n_runs], dtype=float),
        "p": np.array([test.p_value for test in tests]),
        "verdict": (bool(optimum.converged), len(prb.diagnose(posterior, model=model).messages)),
    }


@dataclasses.dataclass(frozen=True)
class Problem:
    """A calibration in two parts, so that what only the second reads is varied there alone.

    Attributes
    ----------
    first : callable
        Minimises.
    second : callable
        Of what the first returned and a seed: the answers.
    everywhere : bool
        Whether it is solved for each constant that it reads, or for those alone that no problem
        before it reads, but the one that the page leaves out.
    """

    first: Callable[[], Any]
    second: Callable[[Any, int], dict[str, Any]]
    everywhere: bool

    def __call__(self, random_seed: int = 1) -> dict[str, Any]:
        return self.second(self.first(), random_seed)


def problems() -> dict[str, Problem]:
    """Return what to calibrate.

    None of them is among those of the studies of coverage.
    """
    rng = np.random.default_rng(77)
    small, larger = 1.0 + 0.6 * rng.standard_normal(20), 1.0 + 0.6 * rng.standard_normal(60)
    state = rng.bit_generator.state
    some = larger[:30]

    def again() -> np.random.Generator:
        other = np.random.default_rng()
        other.bit_generator.state = state
        return other

    def of_one(*model: Any, everywhere: bool = False, **options: Any) -> Problem:
        return Problem(
            partial(minimised, lambda: one_input(*model), **options), sampled, everywhere
        )

    bins = prb.KullbackLeibler(prb.Histogram())
    own = prb.FunctionMetric(kolmogorov, weighted=True)
    found = {
        "PR, N = 20": of_one(np.sinh, np.sinh(small), prb.ProbabilityResidual(), everywhere=True),
        "area, N = 20": of_one(np.sinh, np.sinh(small), prb.AreaMetric()),
        "area, squared, N = 60": of_one(
            np.square, np.square(larger), prb.AreaMetric(), everywhere=True
        ),
        "log-likelihood, N = 60": of_one(
            np.exp, np.exp(larger), prb.LogLikelihood(density=prb.GaussianKDE()), everywhere=True
        ),
        LEFT_OUT: Problem(partial(minimised, lambda: two_inputs(again())), sampled, True),
        "two inputs, three outputs, PR, N = 40": Problem(
            partial(minimised, lambda: three_outputs(again())), sampled, False
        ),
        "KLD, histogram, N = 60": of_one(np.tanh, np.tanh(larger), bins),
        "Kolmogorov, N = 30": of_one(np.sinh, np.sinh(some), own),
        "Nelder-Mead, PR, N = 20": of_one(
            np.sinh, np.sinh(small), prb.ProbabilityResidual(), method="Nelder-Mead"
        ),
        "Resimulated, PR, N = 20": of_one(
            np.sinh, np.sinh(small), prb.ProbabilityResidual(), prb.Resimulated(128)
        ),
        "surrogate and validity": Problem(lambda: on_surrogate(again()), validity, True),
    }
    return dict(sorted(found.items(), key=lambda item: not item[1].everywhere))


def answer(solve: Callable[[], dict[str, Any]]) -> dict[str, Any] | str:
    """Return a problem's answers, or the error that ended it."""
    try:
        return solve()
    except Exception as error:
        return f"{type(error).__name__}: {error}"[:200]


def after_first(problem: Problem, half: Any, before: dict[str, Any]) -> dict[str, Any]:
    """Return answers of a problem whose second part is as it was; known if the first's result is."""
    found = problem.first()
    same = result_of_first(found) == result_of_first(half)
    return before if same else problem.second(found, 1)


def result_of_first(found: Any) -> list[Any]:
    """Return all of an optimum that what follows rests on, digit by digit."""
    optimum = found[0] if isinstance(found, tuple) else found
    units = optimum.evaluator.hyperparameters.prior_sd
    parts = [
        optimum.theta,
        optimum.covariance,
        units,
        *(rival["theta"] for rival in optimum.rivals),
    ]
    for design in optimum.evaluator.reweighted.values():
        parts += [design.values, design.required_ess]
    digits = [np.asarray(part).tobytes() for part in parts]
    return [*digits, optimum.scales, optimum.converged, optimum.findings]


class Reading:
    """Which names the code of the package reads, that ran since the last look."""

    def __init__(self) -> None:
        self.codes: set[CodeType] = set()
        monitoring = sys.monitoring
        monitoring.use_tool_id(monitoring.PROFILER_ID, "constants")
        event = monitoring.events.PY_START
        monitoring.register_callback(monitoring.PROFILER_ID, event, self._started)
        monitoring.set_events(monitoring.PROFILER_ID, event)

    def _started(self, code: CodeType, _: int) -> Any:
        if code.co_filename.startswith(str(PACKAGE)):
            self.codes.add(code)
        return sys.monitoring.DISABLE

    def look(self) -> set[tuple[str, str]]:
        """Return files and names, and begin anew."""
        found = {
            (code.co_filename, name)
            for code in self.codes
            for name in code.co_names
            if name.isupper()
        }
        self.codes = set()
        sys.monitoring.restart_events()
        return found

    def end(self) -> None:
        """Stop."""
        sys.monitoring.set_events(sys.monitoring.PROFILER_ID, 0)
        sys.monitoring.free_tool_id(sys.monitoring.PROFILER_ID)


def in_a_fork(work: Callable[[], Any]) -> Any:
    """Return what a function returns in a fork of this process, or words where it does not."""
    reading, writing = os.pipe()
    child = os.fork()
    if not child:
        try:
            os.close(reading)
            with os.fdopen(writing, "wb") as pipe:
                pickle.dump(work(), pipe)
        finally:
            os._exit(0)
    os.close(writing)
    content = b""
    with DefaultSelector() as selector, os.fdopen(reading, "rb") as pipe:
        selector.register(pipe, EVENT_READ)
        if selector.select(PATIENCE):
            content = pipe.read()
        else:
            os.kill(child, 9)
    os.waitpid(child, 0)
    return pickle.loads(content) if content else f"no answer within {PATIENCE} s"


def change(a: dict[str, Any] | str, b: dict[str, Any] | str) -> dict[str, Any]:
    """Return the largest changes of a problem's answers; nothing where none changes."""
    if isinstance(a, str) or isinstance(b, str):
        return {} if a == b else {"verdict": f"{a if isinstance(a, str) else 'answers'}"}
    known = np.isfinite(a["stderr"]) & np.isfinite(b["stderr"])
    drawn = known if a["mean"].size else np.empty(0, dtype=bool)

    def factor(key: str, where: Any = slice(None)) -> Any:
        return np.exp(np.abs(np.log(a[key][where] / b[key][where])))

    values = {
        "optimum": np.abs(a["theta"] - b["theta"])[known] / b["stderr"][known],
        "stderr": factor("stderr", known),
        "epsilon": factor("epsilon"),
        "mean": np.abs(a["mean"] - b["mean"])[drawn] / b["sd"][drawn],
        "sd": factor("sd", drawn),
        "responses": factor("responses"),
        "p": np.abs(a["p"] - b["p"]),
    }
    found: dict[str, Any] = {}
    for key, value in values.items():
        same = 1.0 if key in ("stderr", "epsilon", "sd", "responses") else 0.0
        if value.size and value.max() != same:
            found[key] = float(f"{value.max():.3g}")
    same_known = np.array_equal(np.isfinite(a["stderr"]), np.isfinite(b["stderr"]))
    if a["verdict"] != b["verdict"] or not same_known:
        found["verdict"] = f"{b['verdict']} -> {a['verdict']}"
    return found


def row(found: dict[str, dict[str, Any]]) -> str:
    """Return the largest changes over all problems, as a line."""
    cells = []
    for key in COLUMNS:
        values = [changes[key] for changes in found.values() if key in changes]
        cells.append(f"{max(values):9.4g}" if values else f"{'.':>9s}")
    others = [name for name, changes in found.items() if "verdict" in changes]
    return " ".join(cells) + "  " + ", ".join(others)


@dataclasses.dataclass(frozen=True)
class Reference:
    """All problems with the package's own constants.

    Attributes
    ----------
    problems : dict
    half : dict
        What the first part of each returns.
    answers : dict
    read : dict
        Files and names of the constants that the first part reads, and the second.
    """

    problems: dict[str, Problem]
    half: dict[str, Any]
    answers: dict[str, dict[str, Any]]
    read: dict[str, tuple[set[tuple[str, str]], set[tuple[str, str]]]]

    @classmethod
    def made(cls) -> Reference:
        """Solve all problems, which also compiles what can be kept."""
        found = cls(problems(), {}, {}, {})
        reading = Reading()
        for name, problem in found.problems.items():
            found.half[name] = problem.first()
            first = reading.look()

            def second(problem: Problem = problem, half: Any = found.half[name]) -> tuple[Any, Any]:
                return problem.second(half, 1), reading.look()

            # In a fork, which leaves the half as it is.
            found.answers[name], then = in_a_fork(second)
            reading.look()
            found.read[name] = first, then
        reading.end()
        # Garbage is not looked for in what stays for good, nor in what ends soon.
        gc.collect()
        gc.freeze()
        gc.disable()
        return found

    def check(self) -> None:
        """Solve all again, in forks, whole and from the half: not a digit may differ."""
        for name, problem in self.problems.items():
            for solve in (problem, partial(problem.second, self.half[name], 1)):
                again = change(in_a_fork(partial(answer, solve)), self.answers[name])
                assert not again, f"{name}: a second run differs by {again}"

    def with_another_seed(self) -> dict[str, Any]:
        """Return how the answers differ with another seed of the sampler."""
        found = {}
        for name, problem in self.problems.items():
            solve = partial(problem.second, self.half[name], 2)
            found[name] = change(in_a_fork(partial(answer, solve)), self.answers[name])
        return {name: differs for name, differs in found.items() if differs}

    def concerned(self, one: Variation) -> dict[str, Callable[[], dict[str, Any]]]:
        """Return, by problem, what is to be solved again where a constant has another value."""
        found: dict[str, Callable[[], dict[str, Any]]] = {}
        for name, problem in self.problems.items():
            early, late = (one.read_by(names) for names in self.read[name])
            known = set(found) - {LEFT_OUT}
            if not (early or late) or (known and not problem.everywhere):
                continue
            half, answers = self.half[name], self.answers[name]
            if early and late:
                found[name] = problem
            elif early:
                found[name] = partial(after_first, problem, half, answers)
            else:
                found[name] = partial(problem.second, half, 1)
        return found

    def changes(self, one: Variation) -> dict[str, Any] | str:
        """Return what changes, by problem."""
        concerned = self.concerned(one)
        if not concerned:
            return "read by none of the problems"

        def answers() -> dict[str, Any]:
            one.make()
            return {name: answer(solve) for name, solve in concerned.items()}

        found = in_a_fork(answers)
        if isinstance(found, str):
            return {name: {"verdict": found} for name in concerned}
        differ = {name: change(found[name], self.answers[name]) for name in concerned}
        return {name: differs for name, differs in differ.items() if differs}


def main() -> None:
    """Make the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", default="", help="a pattern of the constants' names")
    parser.add_argument("--anew", action="store_true", help="compute rows that the file has, too")
    parser.add_argument("--check", action="store_true", help="first solve all problems twice")
    parser.add_argument("--out", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    logging.getLogger("prbayes").setLevel(logging.CRITICAL)

    wanted = {one.label: one for one in variations()}
    seed = "another seed of the sampler"
    table = {} if arguments.anew else record.load(arguments.out, {})
    table = {label: found for label, found in table.items() if label == seed or label in wanted}
    reference = Reference.made()
    if arguments.check:
        reference.check()
    if seed not in table:
        table[seed] = reference.with_another_seed()
    print(f"{'':58s}", " ".join(f"{key:>9s}" for key in COLUMNS), flush=True)
    for label, one in wanted.items():
        if re.search(arguments.only, label) and label not in table:
            table[label] = reference.changes(one)
            record.save(arguments.out, table)
        if label in table:
            found = table[label]
            print(f"{label:58s}", found if isinstance(found, str) else row(found), flush=True)
    record.save(arguments.out, table)


if __name__ == "__main__":
    main()
