"""The default log-likelihood on problems whose posterior is known exactly: runs, time, bias and widths.

Each row is a model with `prb.LogLikelihood` at its defaults, `prb.sample`, and the exact posterior by
a grid, a quadrature or importance sampling that does not use prbayes. Bias is the distance of means in
exact posterior standard deviations, the largest over hyperparameters; widths are ratios of standard
deviations. Runs are all evaluations of the response, by specimen. A row ends after
120 CPU seconds, of large problems after 400 or 600.

    OMP_NUM_THREADS=1 uv run python -m benchmarks.reach [--cells "a^2*"] [--out FILE]

References are stored in `results/reach_references.json`; delete a cell there to compute it again.
"""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm

import prbayes as prb
from benchmarks import exact_posteriors as exact
from benchmarks import reach_cases as cases
from benchmarks import record
from benchmarks.reach_cases import Instance
from benchmarks.scoreboard import in_pymc
from benchmarks.scoreboard.problem import Problem, Response, half_normal, normal
from benchmarks.study import Study

SECONDS = 120.0  # CPU time of a row
REFERENCES = record.RESULTS / "reach_references.json"
# Of each figure the largest value that is allowed; of "narrowest" the smallest one.
GOOD = {"bias": 0.1, "narrowest": 0.9, "widest": 1.1}
WIDE = {"bias": 0.25, "narrowest": 0.75, "widest": 1.25}


@dataclass(frozen=True)
class Case:
    """A problem, the number of its data sets, and what its figures may be."""

    row: Callable[[int], dict[str, Any]]
    data_sets: int
    bounds: dict[str, float]


class TimeLimitError(BaseException):
    """Raised in a row that takes too long; no handler of `Exception` catches it."""


@contextmanager
def limited(seconds: float) -> Iterator[None]:
    """Raise an error after CPU seconds."""

    def stop(*_: Any) -> None:
        raise TimeLimitError

    before = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


def model_of(instance: Instance, response: Response) -> pm.Model:
    """Return the model of a data set."""
    if instance.build is not None:
        return instance.build(response)
    problem, observed = instance.problem, instance.observed
    if problem.separate:
        # One row for each specimen, which was measured in one output.
        observed = np.where(np.eye(observed.shape[1])[:, None] > 0, observed, np.nan)
        observed = observed.reshape(-1, observed.shape[-1])
    with pm.Model() as model:
        values = in_pymc.hyperparameters(problem)
        inputs = in_pymc.inputs(problem, values)
        given = dict(values)
        if problem.degrees is not None:
            # Readings of a curve, whose error is not known.
            given["error"] = pm.HalfNormal("error", 0.1 * observed.std(axis=0))
        metric = prb.LogLikelihood(**instance.measurement(given))
        function: Callable[..., Any] = response
        if problem.correlation:
            function = lambda x: response(x[..., 0], x[..., 1])  # noqa: E731
        prb.Simulator("y", function, *inputs, metric=metric, observed=observed)
    return model


@cache
def warm() -> None:
    """Calibrate a linear response, so that no row pays for the first compilation."""
    posterior_row(lambda _: cases._scoreboard("linear", 20, 0), "", SECONDS, 0)


def stored_reference(cell: str, number: int, compute: Callable[[], Any]) -> Any:
    """Return the reference of a data set, which is computed once."""
    stored = record.load(REFERENCES, {})
    key = str(number)
    if not cell:
        return compute()
    if key not in stored.get(cell, {}):
        stored.setdefault(cell, {})[key] = compute()
        record.save(REFERENCES, stored, ("numpy", "scipy"))
    return stored[cell][key]


def posterior_row(
    make: Callable[[int], Instance], cell: str, seconds: float, number: int
) -> dict[str, Any]:
    """Return runs, CPU seconds, and the distance of the posterior from the exact one."""
    if cell:
        warm()
    instance = make(number)
    reference = stored_reference(cell, number, instance.reference)
    response = Response(instance.problem)
    row: dict[str, Any] = {"number": number}
    begun = time.process_time()
    posterior = None
    try:
        with limited(seconds):
            model = model_of(instance, response)
            posterior = prb.sample(model=model, random_seed=1, progressbar=False).posterior
    except TimeLimitError:
        row["error"] = f"not finished in {seconds:.0f} CPU s"
    except Exception as error:  # a refusal is a result
        row["error"] = f"{type(error).__name__}: {error}".splitlines()[0][:200]
    row |= {"runs": response.runs, "cpu": round(time.process_time() - begun, 2)}
    if posterior is not None:
        row |= distance(instance.problem, reference, posterior)
    return row


def distance(problem: Problem, reference: dict[str, Any], posterior: Any) -> dict[str, Any]:
    """Return the figures of a posterior beside the exact one."""
    draws = {name: posterior[name].to_numpy().ravel() for name in problem.priors}
    masses = None
    if "modes" in reference:
        mode = exact.classified(reference["modes"], exact.coordinates_of(problem.priors, draws))
        right = np.array(reference["masses"])
        masses = np.bincount(mode, minlength=len(right)) / len(mode)
        draws = {name: value[right[mode] > cases.MINOR] for name, value in draws.items()}
    values = problem.told(draws)
    mean, sd = reference["mean"], reference["sd"]
    bias = {name: (values[name].mean() - mean[name]) / sd[name] for name in mean}
    width = {name: values[name].std() / sd[name] for name in mean}
    figures: dict[str, Any] = {
        "by name": {name: [round(bias[name], 3), round(width[name], 3)] for name in mean},
        "sampler": posterior.attrs.get("sampler", ""),
        "efficiency": posterior.attrs.get("efficiency"),
        "findings": [finding["code"] for finding in json.loads(posterior.attrs["findings"])],
    }
    if mean:
        figures["bias"] = max(map(abs, bias.values()))
        figures |= {"narrowest": min(width.values()), "widest": max(width.values())}
    if masses is not None:
        figures["mass"] = float(np.abs(masses - right).max())
        figures["masses"] = [masses.round(3).tolist(), right.round(3).tolist()]
    return figures


def likelihood_row(is_relative: bool, number: int) -> dict[str, Any]:
    """Return the largest error of log L over central 98 % of the prior of the reading error, in nats."""
    warm()
    mu, sd = cases.POPULATIONS[number]
    row: dict[str, Any] = {"number": number, "nats": 0.0, "by error": []}
    response = cases.wang_response()
    begun = time.process_time()
    try:
        with limited(SECONDS):
            model, y = cases.wang_model(is_relative, response)
            function = model.compile_logp(vars=[y], jacobian=False)
            for error in (
                half_normal(0.3).distribution().ppf([0.01, 0.03, 0.1, 0.3, 0.5, 0.8, 0.99])
            ):
                point = {"mu": mu, "s_log__": np.log(sd), "e_log__": np.log(error)}
                right = cases.wang_log_likelihood(is_relative, mu, sd, error)
                off = float(function(point)) - right
                row["by error"].append([round(error, 4), round(off, 3), round(right, 2)])
                row["nats"] = max(row["nats"], abs(off))
    except TimeLimitError:
        row["error"] = f"not finished in {SECONDS:.0f} CPU s"
    except Exception as error:  # a refusal is a result
        row["error"] = f"{type(error).__name__}: {error}".splitlines()[0][:200]
    return row | {"runs": response.runs, "cpu": round(time.process_time() - begun, 2)}


def individuals_row(number: int) -> dict[str, Any]:
    """Return the distance of the specimens' inputs from the exact ones, in their own deviations."""
    warm()
    mean, sd = cases.individuals_exact(number)
    runs = [0]

    def response(a: Any, b: Any = None) -> Any:
        runs[0] += np.size(a)
        return 1.0 * a if b is None else np.stack([a + b, a - b], axis=-1)

    row: dict[str, Any] = {"number": number}
    begun = time.process_time()
    with limited(SECONDS):
        model = cases.individuals_model(number, response if len(sd) == 2 else lambda a: response(a))
        posterior = prb.sample(model=model, random_seed=1, progressbar=False)
        inputs = prb.individuals(posterior, model=model, random_seed=1, n_draws=4000).posterior
    row |= {"runs": runs[0], "cpu": round(time.process_time() - begun, 2)}
    draws = [v.to_numpy().reshape(-1, len(mean)) for v in inputs.data_vars.values()]
    off = np.array([(d.mean(axis=0) - m) / s for d, m, s in zip(draws, mean.T, sd, strict=True)])
    width = np.array([d.std(axis=0) / s for d, s in zip(draws, sd, strict=True)])
    row |= {"bias": float(np.abs(off).max()), "narrowest": float(width.min())}
    return row | {"widest": float(width.max()), "off by .25": int((np.abs(off) > 0.25).sum())}


def _case(
    cell: str, make: Callable[[int], Instance], data_sets: int, seconds: float = SECONDS,
    **bounds: float,
) -> tuple[str, Case]:  # fmt: skip
    return cell, Case(partial(posterior_row, make, cell, seconds), data_sets, GOOD | bounds)


def _board(
    name: str, size: int, data_sets: int, seconds: float = SECONDS, **bounds: float
) -> tuple[str, Case]:
    make = partial(cases._scoreboard, name, size)
    return _case(f"{name} {size}", make, data_sets, seconds, **bounds)


_SYMMETRIC = {"mu": normal(0, 3), "sigma": half_normal(1)}
_TO_ONE_SIDE = {"mu": normal(1, 1.5), "sigma": half_normal(1)}
CASES: dict[str, Case] = dict(
    (
        _board("linear", 50, 3, runs=60),
        _board("thermal", 30, 1, runs=60),
        _board("crack growth", 21, 1, runs=60),
        _board("folded", 50, 3, runs=60),
        _board("folded", 20, 3, runs=60),
        _board("frame", 20, 3, runs=60),
        _case("growth, one dose", cases._growth_at_one_dose, 3),
        _case("Virkler", cases._virkler, 1, 400.0),
        _case("Virkler, one error", cases._virkler_with_one_error, 1, **WIDE),
        _case("a^2 + b", cases._square_and_known, 5),
        _case("a^2 + b^2", cases._ring, 5),
        _case("sqrt(a^2 + .01) + b", cases._smooth_modulus_and_known, 3),
        _case("a^2 + b, c + b", cases._square_in_two_readings, 3),
        _case("error of 3 %", partial(cases._known_error, 0.03), 3),
        _case("error of 10 %", partial(cases._known_error, 0.1), 3),
        _case("error unknown, three readings", cases._unknown_error, 3),
        _case("mirror", partial(cases._mirror, 1.0, 0.0, _SYMMETRIC), 3, mass=0.05),
        _case(
            "mirror, prior to one side",
            partial(cases._mirror, 2.0, 0.3, _TO_ONE_SIDE),
            3,
            mass=0.05,
        ),
        _case("prior in conflict", cases._conflict, 2),
        _case("correlated inputs", cases._correlated, 3),
        _case("beam, error of 10 %", partial(cases._beam, 0.1), 3, cpu=1.5),
        _case("beam, error of 3 %", partial(cases._beam, 0.03), 3, cpu=1.5),
        _case("sine of Weibull", cases._sine, 20, runs=200, mass=0.05),
        _case("sine of lognormal", cases._sine_of_lognormal, 5, runs=200, mass=0.05),
        _case("own times", cases._own_times, 5, runs=150, bias=0.15, narrowest=0.85, widest=1.15),
        _case(
            "two readings of three",
            cases._panel,
            3,
            runs=110,
            bias=0.15,
            narrowest=0.87,
            widest=1.13,
        ),
        _case("four readings of eight", cases._eight, 3, 400.0, runs=480, bias=0.25),
        ("log L, relative error", Case(partial(likelihood_row, True), 5, {"nats": 0.1})),
        ("log L, additive error", Case(partial(likelihood_row, False), 5, {"nats": 0.1})),
        ("inputs of specimens", Case(individuals_row, 7, GOOD)),
        _board("three masses, well separated", 200, 3, 400.0, runs=110),
        _board("three masses, close", 200, 3, 400.0, runs=900),
        _board("growth", 100, 3, 600.0),
    )
)


def misses(bounds: dict[str, float], row: dict[str, Any]) -> list[str]:
    """Return the figures of a row that are not within their bounds."""
    if "error" in row:
        return ["refused"]
    worse = {
        name for name, bound in bounds.items()
        if name in row and (row[name] < bound if name == "narrowest" else row[name] > bound)
    }  # fmt: skip
    return sorted(worse)


def summary(bounds: dict[str, float], rows: list[Any]) -> dict[str, Any]:
    """Return the worst figures of the rows of a cell, and how many are within all bounds."""
    result: dict[str, Any] = {"data sets": len(rows)}
    result["within bounds"] = sum(not misses(bounds, row) for row in rows)
    result["refused"] = sum("error" in row for row in rows)
    for name in ("runs", "cpu", "bias", "widest", "mass", "nats", "narrowest"):
        values = [row[name] for row in rows if name in row]
        if values:
            result[name] = round(min(values) if name == "narrowest" else max(values), 3)
    return result | {"bounds": bounds}


def table(results: dict[str, Any]) -> str:
    """Return a table of the rows, each with its verdict."""
    lines = [
        f"{'case':34s} {'runs':>6s} {'CPU s':>6s} {'bias':>6s} {'widths':>12s} {'mass':>5s} "
        f"{'nats':>5s} verdict"
    ]
    for cell, rows in results["rows"].items():
        for row in rows:
            shown = {k: f"{row[k]:.2f}" if k in row else "" for k in ("bias", "mass", "nats")}
            widths = f"{row['narrowest']:.2f} - {row['widest']:.2f}" if "narrowest" in row else ""
            missed = misses(CASES[cell].bounds, row)
            verdict = row.get("error") or (", ".join(missed) if missed else "met")
            lines.append(
                f"{cell + ' /' + str(row['number']):34s} {row.get('runs', ''):>6} {row['cpu']:6.1f} "
                f"{shown['bias']:>6s} {widths:>12s} {shown['mass']:>5s} {shown['nats']:>5s} {verdict}"
            )
    return "\n".join(lines)


class Reach(Study):
    """A study whose cells have their own number of data sets."""

    def complete(
        self, cells: Iterable[str], data_sets: int, out: Path, workers: int = 1
    ) -> dict[str, Any]:
        """Compute what is not stored, and print a table of it."""
        results: dict[str, Any] = {"rows": {}}
        chosen = list(cells)
        for cell in chosen:
            count = min(data_sets, CASES[cell].data_sets)
            results = super().complete([cell], count, out, workers)
        for cell, rows in results["rows"].items():
            results["summary"][cell] = summary(CASES[cell].bounds, rows)
        record.save(out, results, self.packages)
        print(table({"rows": {c: r for c, r in results["rows"].items() if c in chosen}}))
        return results


STUDY = Reach(
    "reach", __doc__ or "", CASES, lambda cell, number: CASES[cell].row(number), data_sets=20
)

if __name__ == "__main__":
    STUDY.main()
