"""Tables of the pages, written from benchmarks/results between `<!-- table: name -->` and `<!-- end -->`.

Run: uv run python -m benchmarks.pages
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import record
from benchmarks.scoreboard import table as scoreboard
from benchmarks.scoreboard.problems import PROBLEMS

DOCS = Path(__file__).parents[1] / "docs"
PAGES = sorted([*DOCS.glob("*.md"), *DOCS.glob("appendix/*.md")])
METRICS = {
    "PR": "ProbabilityResidual",
    "KLD": "KullbackLeibler",
    "area": "AreaMetric",
    "log-likelihood": "LogLikelihood",
}
Row = Iterable[str]


def found(name: str) -> Any:
    """Return what a benchmark found."""
    return record.load(record.RESULTS / f"{name}.json", None)


def short(value: float, digits: int = 2) -> str:
    """Return a number without the zero before its point."""
    return f"{value:.{digits}f}".replace("0.", ".", 1) if abs(value) < 1 else f"{value:.{digits}f}"


def outliers() -> Iterator[Row]:
    """Yield shifts of posteriors by gross outliers."""
    table = found("contamination")
    for label, name in METRICS.items():
        cell = table[name]
        shifts = zip(cell["shift"], cell["standard_error"], strict=True)
        ratios = (f"{ratio:.2f}" for ratio in cell["sd_ratio"])
        yield [label, *(f"{shift:.2f} ± {error:.2f}" for shift, error in shifts), *ratios]


def posterior_coverage() -> Iterator[Row]:
    """Yield coverage of posteriors given the estimate, pooled over groups of cells."""
    for name, group in found("posterior")["pooled"].items():
        if "intervals" not in group:  # of an earlier study
            continue
        yield [
            name,
            f"{short(group['coverage'], 3)} ± {short(group['error'], 3)}",
            f"{group['intervals']:,}",
            str(group["failed"]),
        ]


def likelihood_ranks() -> Iterator[Row]:
    """Yield coverage and uniformity of the log-likelihood by specimen, by problem."""
    for problem, table in found("likelihood_coverage")["summary"].items():
        for j, (name, within) in enumerate(table["prbayes"]["coverage"].items()):
            exact = table["exact"]["coverage"][name]
            p = short(table["prbayes"]["p of uniformity"][name])
            keys = ("median distance", "distance of 99%", "largest distance")
            distance = [short(table[key][j], 3) for key in keys]
            sets = str(table["data sets"])
            yield [problem, name, sets, short(within, 3), short(exact, 3), p, *distance]


def saddlepoint() -> Iterator[Row]:
    """Yield offsets and widths of posteriors given the estimate, by case and metric."""
    cells: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for name, cell in found("saddlepoint")["summary"].items():
        study, metric, *rest = name.split(", ")
        if study in ("one", "several"):
            cells.setdefault((rest[-1], metric), []).append(cell)
    for (case, metric), those in sorted(cells.items(), key=lambda item: _CASES.index(item[0][0])):
        rms, most = (max(max(c[f"{key} offset"]) for c in those) for key in ("rms", "largest"))
        low = min(min(c["smallest width"]) for c in those)
        high = max(max(c["largest width"]) for c in those)
        seconds = float(np.median([c["seconds"] for c in those]))
        sets = sum(c["data sets"] for c in those)
        yield [
            case, metric, str(sets), short(rms), short(most), f"{short(low)} to {short(high)}",
            short(seconds),
        ]  # fmt: skip


def saddlepoint_refits() -> Iterator[Row]:
    """Yield offsets and widths of posteriors given estimates by refits, by metric, prior and size."""
    for name, cell in found("saddlepoint")["summary"].items():
        study, metric, *rest = name.split(", ")
        if study != "refits" or "rms offset" not in cell:
            continue
        size, prior = rest
        offset, largest = (max(cell[f"{key} offset"]) for key in ("rms", "largest"))
        widths = f"{short(min(cell['mean width']))} to {short(max(cell['mean width']))}"
        yield [
            metric, size.removeprefix("N = "), prior, str(cell["data sets"] - cell["failed"]),
            short(offset), short(largest), widths, short(cell["seconds"]),
        ]  # fmt: skip


# Priors of one simulator of one output, and problems of several.
_CASES = (
    "vague", "bounded", "sharp", "conflict", "4 simulators", "8 simulators",
    "3 outputs", "4 outputs", "8 outputs",
)  # fmt: skip


def guard_sizes() -> Iterator[Row]:
    """Yield how often right models are flagged by the guards of the log-likelihood by specimen."""
    for problem, checks in found("likelihood_guards")["summary"].items():
        for check, cell in checks.items():
            share = f"{short(cell['share'], 3)} ± {short(cell['standard error'], 3)}"
            yield [problem, check, str(cell["data sets"]), share]


def partial_pooling() -> Iterator[Row]:
    """Return the rows of groups beside the exact posterior."""
    table = found("partial_pooling")
    for name in ("m", "tau", "sigma", "mu"):
        row = table[name]
        error = row["scatter of shifts"] / np.sqrt(table["data sets"])
        yield [
            "each `mu`" if name == "mu" else f"`{name}`",
            f"{row['mean']:.3f}",
            f"{row['exact mean']:.3f}",
            f"{row['shift']:+.2f} ± {error:.2f}",
            f"{row['ratio of sd']:.2f}",
            f"{row['held']:.0%}",
            str(table["data sets"]),
        ]


def small_groups() -> Iterator[Row]:
    """Return the rows of small groups beside the exact posterior."""
    for cell in found("small_groups")["table"]:
        columns = [cell["metric"], str(cell["size"])]
        for name in ("mu", "sigma"):
            columns += [f"{cell[f'{name} off']:.2f}", f"{cell[f'{name} ratio']:.2f}"]
            columns.append(f"{cell[f'{name} held']:.0%} ({cell[f'{name} exact held']:.0%})")
        yield [*columns, str(cell["data sets"]), f"{cell['seconds']:.1f}"]


def gross_errors() -> Iterator[Row]:
    """Return the rows of the price and the gain of gross errors in a likelihood by specimen."""
    for row in found("gross_errors"):
        biases = zip(row["bias"], row["error"], strict=True)
        yield [
            str(row["size"]),
            f"{row['shift']:g} sd" if row["shift"] else "none",
            str(row["gross_errors"]),
            " / ".join(f"{bias + 0.0:+.2f} ± {error:.2f}" for bias, error in biases),
            " / ".join(f"{width:.2f}" for width in row["width"]),
        ]


def readings_coverage() -> Iterator[Row]:
    """Yield bias, width and coverage of measurement arguments beside the exact posterior."""
    for case, table in found("readings_coverage")["summary"].items():
        for j, (name, within) in enumerate(table["prbayes"]["coverage"].items()):
            exact = table["exact"]["coverage"][name]
            error = np.sqrt(0.89 * 0.11 / (table["data sets"] - table["refused"]))
            refused = f", {table['refused']} refused" if table["refused"] else ""
            yield [
                case,
                name,
                f"{table['data sets']}{refused}",
                f"{table['bias'][j]:+.2f} ± {table['error of bias'][j]:.2f}",
                f"{table['largest distance'][j]:.2f}",
                f"{table['width'][j]:.2f}",
                f"{within:.2f} ± {error:.2f}",
                f"{exact:.2f}",
            ]


# By rival of the scoreboard: the metric, what it estimates, failures, gross errors.
_PRICES = {
    "prbayes likelihood": (
        "log-likelihood by specimen",
        "populations that explain the record of each specimen",
        "refused",
        "`gross_errors=`",
    ),
    "prbayes KLD": ("KLD", "the population with the density of the data", "counted", "follows"),
    "prbayes kernel log-likelihood": (
        "kernel log-likelihood",
        "the population whose smoothed density makes the data likely",
        "counted",
        "follows",
    ),
    "prbayes area": (
        "area",
        "the population with the distribution function of the data",
        "counted",
        "robust",
    ),
    "prbayes PR": ("PR", "the population of the bulk of the data", "counted", "robust"),
}


def metric_prices() -> Iterator[Row]:
    """Return the rows of metrics with runs, seconds and errors on three problems."""
    table = found("scoreboard")
    cells = [
        table[name][size] for name, size in (("linear", "50"), ("folded", "50"), ("frame", "20"))
    ]
    for rival, columns in _PRICES.items():
        scores = [cell.get(rival) for cell in cells]
        yield [
            *columns,
            _over(scores, lambda score: f"{score['runs']:.0f}"),
            _over(scores, lambda score: f"{score['cpu']:.{int(score['cpu'] < 10)}f}"),
            _over(scores, lambda score: short(max(_rms(score)))),
        ]


def _rms(score: dict[str, Any]) -> list[float]:
    return [value["rms"] for value in score.values() if isinstance(value, dict)]


def _over(scores: Iterable[Any], shown: Callable[[Any], str]) -> str:
    """Return a cell with a value for each problem, a dash where a metric was not run."""
    return " / ".join("-" if score is None else shown(score) for score in scores)


def measurement_error() -> Iterator[Row]:
    """Return the rows of readings with an error."""
    table = found("measurement_error")
    ways = {"ignored": "ignored", "known": "known", "estimated": "from repeats"}
    truth = {"mu": ("mean", 0.0), "sigma": ("standard deviation", 0.3)}
    for (way, label), (name, (told, value)) in product(ways.items(), truth.items()):
        row = table[f"{way}/{name}"]
        yield [
            label,
            told,
            f"{value:g}",
            f"{row['mean']:.3f}",
            f"{row['sd']:.3f}",
            f"{row['held']:.0%}",
            str(row["data sets"]),
        ]


def sizes() -> Iterator[Row]:
    """Return the rows of the area test's size."""
    table = found("validity")["size"]
    for n0, n in product((15, 30, 100), (10, 20, 50)):
        cells = [
            short(table[f"{n0}/{n}/{null}"][level], 3)
            for null in ("default", "best fit", "pool, uniform")
            for level in ("0.01", "0.05", "0.1")
        ]
        cells[1] = f"**{cells[1]}**"
        yield [str(n0), str(n), *cells]


def sizes_through() -> Iterator[Row]:
    """Return the rows of the area test's size, through the whole package."""
    table = found("validity")["size_through_prbayes"]
    nulls = {
        "optimum taken as exact, fresh data": "optimum, ExactModel",
        "`JointNull`, the calibration's own data": "own data, JointNull",
        "`ExactModel`, the calibration's own data": "own data, ExactModel",
    }
    for n0, (label, null) in product((15, 30), nulls.items()):
        row = table[f"{n0}/20/{null}"]
        yield [str(n0), label, *(short(value, 3) for value in row.values())]


def sizes_of_outputs() -> Iterator[Row]:
    """Return the rows of the area test of several outputs."""
    table = found("validity_outputs")["outputs"]
    labels = {
        "0.9": "correlation .9, as calibrated",
        "0.8": "correlation .8",
        "0.6": "correlation .6",
        "0": "correlation 0",
        "mean + 0.75 sd": "mean + .75 sd",
    }
    for name, label in labels.items():
        row = f"15/20/{name}"
        shares = [short(value, 3) for value in table["matching"][row].values()]
        yield [label, *shares, short(table["Jeffreys"][row]["0.05"], 3)]


def power() -> Iterator[Row]:
    """Return the rows of the power of tests."""
    for name, row in found("validity")["power"].items():
        yield [name.replace("|", "\\|"), *(short(value, 3) for value in row.values())]


def case_study(points: str) -> Iterator[Row]:
    """Return the rows of errors in the paper's case study."""
    from benchmarks.paper_case1 import SIZES, collect
    from benchmarks.systems import SYSTEMS

    fits = found("paper_case1")["fits"]
    for system, n in product(SYSTEMS, SIZES):
        cells = [collect(fits, points, system, n, metric, "BFGS") for metric in METRICS]
        if any(cell is None for cell in cells):
            continue
        yield [system, str(n), *map(_median_errors, cells)]


def _median_errors(cell: Any) -> str:
    mean, sd = np.median(cell[:, 0]), np.median(cell[:, 1])
    return f"{mean:.2f} / {sd:.2f}" + _failed(cell)


def _failed(cell: Any) -> str:
    count = int(cell[:, 3].sum())
    return f" ({count})" if count else ""


def evaluations() -> Iterator[Row]:
    """Return the rows of evaluations in the paper's case study."""
    from benchmarks.paper_case1 import METHODS, SIZES, collect
    from benchmarks.systems import SYSTEMS

    fits = found("paper_case1")["fits"]
    for system, method in product(SYSTEMS, METHODS):
        cells = []
        for metric in METRICS:
            parts = [collect(fits, "sobol", system, n, metric, method) for n in SIZES]
            every = np.concatenate(parts)
            cells.append(f"{np.median(every[:, 2]):.0f}" + _failed(every))
        yield [system, method.replace("NM", "Nelder-Mead,"), *cells]


def scale_factor() -> Iterator[Row]:
    """Return the rows of the paper's scale factor."""
    table = found("scale_factor")
    for maximum, form, method, parameters in product(
        ("5000.0", "0.005"),
        ("sum", "integral"),
        ("BFGS", "Nelder-Mead"),
        ("raw", "standardised"),
    ):
        cells = [
            f"{n}" if error < 0.01 else f"{n} ({error:.2g})"
            for n, error in table[f"{maximum}/{form}/{method}/{parameters}"]
        ]
        yield [f"{float(maximum):g}", form, method, parameters, *cells]


def landscapes() -> Iterator[Row]:
    """Return the rows of convexity and arrival."""
    for name, row in found("landscapes").items():
        yield [
            *name.split("/"),
            *(f"{row[key]:.1%}" for key in ("convex", "flat", "arrive")),
            f"{row['evaluations']:.0f}",
            f"{row['arrive_guided']:.1%}",
            f"{row['evaluations_guided']:.0f}",
        ]


def families(at: tuple[int, ...]) -> Iterator[Row]:
    """Return the rows of wrong families."""
    table = found("misspecified")["families"]
    for truth, n, metric in product(("Weibull", "gamma", "mixture"), at, METRICS):
        size = [] if len(at) == 1 else [str(n)]
        figures = table[f"{truth}/{n}/{metric}"][:4]
        # No negative zero.
        yield [truth, *size, metric, *(f"{round(value, 3) + 0.0:.3f}" for value in figures)]


def ties() -> Iterator[Row]:
    """Return the rows of rounded and tied data."""
    for name, (shift, ratio, failed) in found("misspecified")["ties"].items():
        data, metric = name.split("/")
        label = "half equal to the median" if "tied" in data else f"{data} sd"
        label = label.replace("round ", "rounded to ")
        yield [label, metric, f"{shift:.3f}", f"{ratio:.3f}", str(failed)]


def surrogates() -> Iterator[Row]:
    """Return the rows of a calibration through surrogates."""
    for row in found("surrogate")["rows"]:
        error = row["cross_validated"]
        what = re.sub(r"(Reweighted|Resimulated)\(\d+\)", r"`\g<0>`", row["what"])
        yield [
            what,
            str(row["runs"]),
            "" if error is None else f"{error:.1%}",
            f"{row['error']:.3f}",
        ]


# Problems of joint calibration with enough data sets.
JOINT = ("normal 0", "normal .6", "normal .95", "frame")


def joint() -> Iterator[Row]:
    """Yield errors of joint calibration over those of maximum likelihood, by problem."""
    from benchmarks.joint import ENOUGH, METHODS, grouped

    schools = {
        "joint": "`Joint`",
        "correlation": "`MarginalCorrelation`",
        "separate": "separate marginals",
    }
    cells = found("joint")["cells"]
    for size, method in product((20, 50, 200), METHODS[1:]):
        row, sets = [], []
        for problem in JOINT:
            cell = cells.get(f"{problem}/{size}/{method}")
            if cell is None or cell["data sets"] < ENOUGH:
                break
            errors = grouped(problem, cell["rmse over likelihood"])
            row.append(" / ".join(short(error) for error in errors))
            sets.append(cell["data sets"])
        else:
            school, metric = method.split()
            yield [str(size), f"{schools[school]}, {metric}", str(min(sets)), *row]


def joint_memory() -> Iterator[Row]:
    """Return the rows of the memory of many directions."""
    for key, cell in found("joint_speed")["memory"].items():
        metric, outputs, points = key.split("/")
        basis = f"{cell['basis']:,}" if cell["basis"] else ""
        seconds = [f"{cell[name]:.2f}" for name in ("objective", "batch")]
        yield [
            metric,
            outputs,
            str(cell["directions"]),
            points,
            f"{cell['peak']:,}",
            basis,
            *seconds,
        ]


def speed() -> Iterator[Row]:
    """Return the rows of CPU seconds, memory and import beside their aims."""
    for row in found("speed")["rows"]:
        ratio = short(row["ratio"], 3) if row["against"] else ""
        value = f"{row['value']:.0f}" if row["value"] >= 20 else short(row["value"])
        aim = short(row["aim"]) if row["aim"] < 1 else f"{row['aim']:g}"
        yield [row["what"], row["against"], value, ratio, aim, "yes" if row["met"] else "no"]


def speed_jobs() -> Iterator[Row]:
    """Return the rows of CPU seconds by job."""
    for name, job in found("speed")["jobs"].items():
        if job.keys() & {"error", "bias", "runs"}:
            cells = [short(job[key]) if key in job else "" for key in _OF_JOBS]
            yield [name, *cells, job.get("error", "")]


_OF_JOBS = ("cold", "warm", "bias", "width")


def scale() -> Iterator[Row]:
    """Return the rows of time and memory of large problems."""
    from benchmarks.scale import THETAS

    metrics = {"ProbabilityResidual": "PR", "AreaMetric": "area metric"}
    after = {"n resimulated": "one theta", "n reweighted": "one theta, after set-up"}
    for row in found("scale"):
        kind, size = row["kind"], row.get("size", 0)
        if kind in after and size >= 1_000_000:
            name = "Resimulated" if kind == "n resimulated" else "Reweighted"
            what = f"`{name}({size:_})`, {after[kind]}, {metrics[row['metric']]}"
            seconds = row["s"] / THETAS
        elif kind.startswith("particles") and size >= 10_000:
            name = "Resimulated(100)" if kind == "particles resimulated" else "Reweighted(256)"
            responses = f"{row['responses']:_} responses"
            what = f"`{name}`, {size:_} particles sampled, {metrics[row['metric']]}, {responses}"
            seconds = row["sampling s"]
        else:
            continue
        digits = 1 if seconds >= 1 else 3 if seconds < 0.05 else 2
        yield [what.replace("_", " "), f"{seconds:.{digits}f} s", f"{row['MiB']:.0f} MiB"]


def busy_workers() -> Iterator[Row]:
    """Return the rows of workers of a server that are busy."""
    for row in found("um_bridge"):
        yield [
            str(row["workers"]),
            row["how"],
            str(row["runs"]),
            f"{row['wall']:.2f}",
            f"{row['utilisation']:.1%}",
            f"{row['lowest']:.1%}",
        ]


def between_runs() -> Iterator[Row]:
    """Return the rows of emulated populations beside those of runs alone."""
    from benchmarks.responses import RESPONSES

    table = found("between_runs")
    for name, response in RESPONSES.items():
        columns = []
        for n in (64, 256):
            cell = table[f"{name}/{n}"]
            columns += [short(cell[key]) for key in ("alone", "emulated", "ratio")]
        yield [name, str(response.d), str(response.outputs), *columns]


def emulator_speed() -> Iterator[Row]:
    """Return the rows of what it costs to emulate."""
    for n, cell in found("emulator_speed").items():
        seconds = [f"{cell[key]:.2f}" for key in ("choose", "say", "left out")]
        yield [n, *seconds, f"{cell['MiB']:.0f}"]


def few_runs() -> Iterator[Row]:
    """Return the rows of optima from few runs."""
    from benchmarks.few_runs import figures

    for name, cell in found("few_runs").items():
        emulated, alone = figures(cell["emulated"]), figures(cell["alone"])
        runs = "{runs[0]} - {runs[1]}".format(**emulated)
        columns = [short(emulated[key], 3) for key in ("off", "worst", "claimed")]
        columns.append(f"{emulated['widths']:.1%}")
        beside = (
            [f"{alone['runs'][0]} - {alone['runs'][1]}", short(alone["off"], 3)]
            if alone
            else ["", ""]
        )
        yield [name, str(cell["inputs"]), runs, *columns, *beside]


def many_inputs() -> Iterator[Row]:
    """Return the rows of eight inputs by the log-likelihood."""
    from benchmarks.many_inputs import figures

    for row in found("many_inputs")["rows"]:
        cell = figures(row)
        bias = [short(cell[key]) for key in ("largest", "rms")]
        widths = f"{short(cell['narrowest'])} to {short(cell['widest'])}"
        yield [str(row["data"]), str(row["runs"]), f"{row['seconds']:.0f}", *bias, widths]


def at_a_fold() -> Iterator[Row]:
    """Return the rows of metrics near a fold."""
    rows = found("at_a_fold")
    for metric in dict.fromkeys(row["metric"] for row in rows):
        cells = []
        for response, size in product(("y", "root of y"), (50, 200)):
            (row,) = (
                r for r in rows if (r["metric"], r["response"], r["N"]) == (metric, response, size)
            )
            cells.append(f"{short(row['mu'])} / {short(row['sigma'])}")
        yield [metric, *cells]


def two_fidelities() -> Iterator[Row]:
    """Return the rows of errors with a coarse response and without."""
    from benchmarks.two_fidelities import WAYS, median, rms

    table = found("two_fidelities")
    for n, errors in table["emulators"].items():
        optima = table["optima"][n]
        of_emulators = [short(median(errors[way])) for way in WAYS]
        yield [n, *of_emulators, *(short(rms(optima[way]), 3) for way in WAYS)]


def plans() -> Iterator[Row]:
    """Return the rows of expected and found standard deviations."""
    labels = {
        "crack": ("crack growth", "21 + 20"),
        "virkler": ("Virkler", "20 + 24"),
        "exact": ("normal population, exact posterior", "21 + 20"),
    }
    names = {"quantity": "quantile later on", "any": "anything"}
    for problem, (label, specimens) in labels.items():
        table = found("planning")[problem]
        for key, cell in table["table"].items():
            condition, name = key.split("/")
            low, high = (short(value) for value in cell["5% to 95%"])
            ratio = f"{short(cell['ratio'])} ± {short(cell['error'])}"
            of = names.get(name, f"`{name}`")
            yield [
                label,
                specimens,
                condition,
                of,
                str(table["data sets"]),
                ratio,
                f"{low} to {high}",
                f"{cell['within 15%']:.0%}",
            ]


def risk_errors() -> Iterator[Row]:
    """Return the rows of small probabilities."""
    for key, cell in found("risk")["errors"].items():
        name, p, points = key.split("/")
        source = "stored responses" if points.startswith("0 ") else points
        errors = [f"{cell[column]:.0%}" for column in ("rms", "stated", "within 2")]
        yield [name, f"{float(p):.0e}", source, str(cell["repetitions"]), *errors]


def risk_coverage() -> Iterator[Row]:
    """Return the rows of coverage of bands."""
    table = found("risk")["coverage"]
    labels = {
        "simultaneous": "simultaneous band, the whole function",
        "pointwise, entirely": "pointwise band, the whole function",
        "pointwise": "pointwise band, at one place",
    }
    for key, share in table["held"].items():
        of, _, band = key.partition("/")
        what = labels.get(band, "interval of `exceedance`")
        yield [of, what, str(table["data sets"]), f"{share:.1%}"]
    for size, shares in found("risk")["exact"].items():
        for key in ("simultaneous", "pointwise"):
            yield ["exact posterior, for comparison", labels[key], size, f"{shares[key]:.1%}"]


def thermal_conductivity() -> Iterator[Row]:
    """Return the rows of treatments of the conductivity."""
    for name, row in found("thermal_challenge")["conductivity"].items():
        mean, constant = (f"{row[what]:+.0f}" for what in ("at the mean temperature", "at 500 C"))
        yield [name, f"{row['differences']:.0f}", mean, constant]


def thermal_population() -> Iterator[Row]:
    """Return the rows of the population of the material."""
    for name, row in found("thermal_challenge")["population"].items():
        digits = 0 if "rhoCp" in name else 4
        optimum = f"{row['optimum']:.{digits}f} ± {row['error']:.{digits}f}"
        yield [name, optimum, f"{row['mean']:.{digits}f} ± {row['sd']:.{digits}f}"]


def thermal_capacity() -> Iterator[Row]:
    """Return the rows of the heat capacity's scatter."""
    table = found("thermal_challenge")
    for name, row in table["capacity"].items():
        share = row["sd"] / table["sample sd"] - 1
        yield [f"`{name}`", f"{row['sd']:.0f} ± {row['error']:.0f}", f"{share:+.1%}"]


def thermal_slabs() -> Iterator[Row]:
    """Return the rows of tests of slabs."""
    for name in ("ensemble", "accreditation"):
        row = found("thermal_challenge")[name]
        measured = f"{row['measured']:.0f}"
        if "measured sd" in row:
            measured += f" ± {row['measured sd']:.0f}"
        predicted = f"{row['predicted']:.0f} ± {row['predicted sd']:.0f}"
        yield [name, measured, predicted, short(row["p, means"]), short(row["p, spreads"])]


def thermal_risk() -> Iterator[Row]:
    """Return the rows of the required probability."""
    labels = {"device": "published equation", "device_by_differences": "finite differences"}
    for key, row in found("thermal_challenge")["risk"].items():
        name, points = key.split("/")
        source = f"{points} points" if int(points) else "stored responses"
        interval = f"{short(row['lower'], 3)} to {short(row['upper'], 3)}"
        numbers = [short(row["probability"], 3), interval, short(row["error"], 3)]
        yield [labels[name], source, *numbers, f"{row['above']:.0%}", row["verdict"]]


def thermal_shares() -> Iterator[Row]:
    """Return the rows of sensitivities."""
    for name, row in found("thermal_challenge")["sensitivity"].items():
        shares = [f"{short(row[w])} ± {short(row[w + '_error'])}" for w in ("first", "total")]
        yield [name, *shares]


def thermal_tests() -> Iterator[Row]:
    """Return the rows of tests to come."""
    plan = found("thermal_challenge")["plan"]
    yield ["nothing", *[short(plan["now"], 3)] * 2, ""]
    for name, row in plan["tests"].items():
        after = [short(row[k], 3) for k in ("after 10", "after 50")]
        yield [name, *after, f"{row['halves']:.0f} of them"]


def libraries() -> Iterator[Row]:
    """Return the rows of libraries' emulators."""
    for name, row in found("emulators").items():
        errors = [f"{mean:.2f} ({worst:.1f})" for mean, worst in (row["smooth"], row["not smooth"])]
        yield [name, *errors, short(row["seconds"])]


def _matrix(key: str, several: bool) -> Iterator[Row]:
    """Return the rows of rivals over the problems of the scoreboard."""
    return scoreboard.matrix(found("scoreboard"), key, several)


def _scoreboard(problem: str) -> Iterator[Row]:
    """Return the rows of a problem of the scoreboard."""
    return scoreboard.rows(found("scoreboard"), problem)


# Where the rows of each table are from; the first two lines of it are the page's.
TABLES: dict[str, Callable[[], Iterator[Row]]] = {
    "posterior coverage": posterior_coverage,
    "outliers": outliers,
    "likelihood, ranks": likelihood_ranks,
    "likelihood, sizes of guards": guard_sizes,
    "saddlepoint": saddlepoint,
    "saddlepoint_refits": saddlepoint_refits,
    "size": sizes,
    "size, through prbayes": sizes_through,
    "size, several outputs": sizes_of_outputs,
    "power": power,
    "case study, Sobol points": lambda: case_study("sobol"),
    "case study, Monte Carlo": lambda: case_study("monte carlo"),
    "case study, evaluations": evaluations,
    "scale factor": scale_factor,
    "partial pooling": partial_pooling,
    "small groups": small_groups,
    "measurement error": measurement_error,
    "gross errors": gross_errors,
    "readings, coverage": readings_coverage,
    "metric prices": metric_prices,
    "landscapes": landscapes,
    "wrong families, many data": lambda: families((100_000,)),
    "wrong families, few data": lambda: families((20, 50)),
    "ties": ties,
    "surrogates": surrogates,
    "joint, errors": joint,
    "joint, memory": joint_memory,
    "speed": speed,
    "speed, jobs": speed_jobs,
    "scale": scale,
    "busy workers": busy_workers,
    "between runs": between_runs,
    "emulators, time": emulator_speed,
    "few runs": few_runs,
    "many inputs": many_inputs,
    "at a fold": at_a_fold,
    "two fidelities": two_fidelities,
    "libraries": libraries,
    "planning": plans,
    "risk, errors": risk_errors,
    "risk, coverage": risk_coverage,
    "thermal, conductivity": thermal_conductivity,
    "thermal, population": thermal_population,
    "thermal, capacity": thermal_capacity,
    "thermal, slabs": thermal_slabs,
    "thermal, risk": thermal_risk,
    "thermal, shares": thermal_shares,
    "thermal, tests": thermal_tests,
    "scoreboard, errors, one output": lambda: _matrix("rms", several=False),
    "scoreboard, errors, several outputs": lambda: _matrix("rms", several=True),
    "scoreboard, widths, one output": lambda: _matrix("width", several=False),
    "scoreboard, widths, several outputs": lambda: _matrix("width", several=True),
    "scoreboard, cannot": lambda: scoreboard.cannot(found("scoreboard")),
    "scoreboard, yields": scoreboard.yields,
}
for _name in PROBLEMS:
    TABLES[f"scoreboard, {_name}"] = partial(_scoreboard, _name)
_MARKED = re.compile(
    r"(<!-- table: (?P<name>[^>]+) -->\n\n(?:\|[^\n]*\n){2})(?:\|[^\n]*\n)*(\n<!-- end -->)"
)


def written(page: str) -> str:
    """Return a page with its tables' rows from the results; their heads stay."""

    def table(match: re.Match[str]) -> str:
        rows = TABLES[match["name"]]()
        return match[1] + "".join(f"| {' | '.join(row)} |\n" for row in rows) + match[3]

    return _MARKED.sub(table, page)


def main() -> None:
    """Write all pages."""
    for path in PAGES:
        page = path.read_text(encoding="utf-8")
        path.write_text(written(page), encoding="utf-8")


if __name__ == "__main__":
    main()
