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
from benchmarks.figures import FOLDER as FIGURES
from benchmarks.metrics import METRICS
from benchmarks.scoreboard import table as scoreboard
from benchmarks.scoreboard.problems import PROBLEMS

DOCS = Path(__file__).parents[1] / "docs"
PAGES = sorted([*DOCS.glob("*.md"), *DOCS.glob("appendix/*.md")])
Row = Iterable[str]


def found(name: str) -> Any:
    """Return what a benchmark found."""
    return record.load(record.RESULTS / f"{name}.json", None)


def summary(name: str) -> dict[str, Any]:
    """Return the figures of a study, by cell."""
    figures: dict[str, Any] = found(name)["summary"]
    return figures


def single(name: str) -> dict[str, Any]:
    """Return the only row of each cell of a study."""
    return {cell: rows[0] for cell, rows in found(name)["rows"].items()}


def short(value: float, digits: int = 2) -> str:
    """Return a number without the zero before its point."""
    return f"{value:.{digits}f}".replace("0.", ".", 1) if abs(value) < 1 else f"{value:.{digits}f}"


def posterior_coverage() -> Iterator[Row]:
    """Yield coverage of posteriors given the estimate, pooled over groups of cells."""
    from benchmarks.posterior import groups, pooled

    figures = summary("posterior")
    for name, has in groups().items():
        group = pooled(figures, has)
        coverage = f"{short(group['coverage'], 3)} ± {short(group['error'], 3)}"
        yield [name, coverage, f"{group['intervals']:,}", str(group["failed"])]


def likelihood_ranks() -> Iterator[Row]:
    """Yield coverage and uniformity of the log-likelihood by specimen, by problem."""
    for problem, table in summary("likelihood_coverage").items():
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
    for name, cell in summary("saddlepoint").items():
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
    for name, cell in summary("saddlepoint").items():
        study, metric, size, prior = name.split(", ")
        if study != "refits":
            continue
        offset, largest = (max(cell[f"{key} offset"]) for key in ("rms", "largest"))
        widths = f"{short(min(cell['mean width']))} to {short(max(cell['mean width']))}"
        yield [
            metric, size.removeprefix("N = "), prior, str(cell["data sets"] - cell["failed"]),
            short(offset), short(largest), widths, short(cell["seconds"]),
        ]  # fmt: skip


# Priors of one simulator of one output, and problems of several.
_CASES = (
    "vague", "bounded", "sharp", "conflict", "4 simulators", "8 simulators", "3 outputs", "4 outputs",
)  # fmt: skip


def guard_sizes() -> Iterator[Row]:
    """Yield how often right models are flagged by the guards of the log-likelihood by specimen."""
    for problem, checks in summary("likelihood_guards").items():
        for check, cell in checks.items():
            share = f"{short(cell['share'], 3)} ± {short(cell['standard error'], 3)}"
            yield [problem, check, str(cell["data sets"]), share]


def partial_pooling() -> Iterator[Row]:
    """Yield the rows of groups beside the exact posterior."""
    table = summary("groups")["partial pooling"]
    for name in ("m", "tau", "sigma", "mu"):
        row = table[name]
        error = row["scatter of shifts"] / np.sqrt(table["data sets"])
        yield [
            "each `mu`" if name == "mu" else f"`{name}`",
            f"{row['mean']:.3f}",
            f"{row['exact mean']:.3f}",
            f"{row['shift']:+.2f} ± {error:.2f}",
            f"{row['ratio']:.2f}",
            f"{row['held']:.0%}",
            str(table["data sets"]),
        ]


def small_groups() -> Iterator[Row]:
    """Yield the rows of small groups beside the exact posterior."""
    for name, cell in summary("groups").items():
        if name == "partial pooling":
            continue
        columns = name.split(", ")
        for part in (cell["mu"], cell["sigma"]):
            columns += [f"{part['off']:.2f}", f"{part['ratio']:.2f}"]
            columns.append(f"{part['held']:.0%} ({part['exact held']:.0%})")
        yield [*columns, str(cell["data sets"]), f"{cell['seconds']:.1f}"]


def gross_errors() -> Iterator[Row]:
    """Yield the price and the gain of gross errors in a likelihood by specimen."""
    for name, row in summary("gross_errors").items():
        size, shift, flag = name.split("/")
        biases = zip(row["bias"], row["error"], strict=True)
        bias = " / ".join(f"{bias + 0.0:+.2f} ± {error:.2f}" for bias, error in biases)
        width = " / ".join(f"{width:.2f}" for width in row["width"])
        yield [size, f"{shift} sd" if shift != "0" else "none", flag, bias, width]


def coverage_of(study: str) -> Iterator[Row]:
    """Yield bias, width and coverage of a study's cases beside the exact posterior."""
    for case, table in summary(study).items():
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
    """Yield the rows of readings with an error."""
    table = summary("measurement_error")
    ways = {"ignored": "ignored", "known": "known", "estimated": "from repeats"}
    truth = {"mu": ("mean", 0.0), "sigma": ("standard deviation", 0.3)}
    for (way, label), (name, (text, value)) in product(ways.items(), truth.items()):
        row = table[way][name]
        moments = f"{row['mean']:.3f}", f"{row['sd']:.3f}"
        held, sets = f"{row['held']:.0%}", str(table[way]["data sets"])
        yield [label, text, f"{value:g}", *moments, held, sets]


def kinds_of_readings() -> Iterator[Row]:
    """Yield offsets and widths of posteriors by kind of reading."""
    names = {
        "gaver": "the ten pumps",
        "poisson": "Poisson",
        "negative binomial": "negative binomial, alpha unknown",
        "binomial": "binomial, 5 to 39 trials",
        "combined": "error with two unknown parts, two readings",
        "bias": "unknown bias",
        "limit": "all readings of the second output at a limit",
    }
    for cell, figures in summary("kinds_of_readings").items():
        low, high = figures["widths"]
        widths = f"{low:.2f} to {high:.2f}"
        seconds, sets = f"{figures['CPU seconds']:.0f}", str(figures["data sets"])
        yield [names[cell], f"{figures['largest offset']:.2f}", widths, seconds, sets]


def selection() -> Iterator[Row]:
    """Yield offsets and widths of posteriors of selected specimens."""
    for cell, figures in summary("selection").items():
        share, error, way = cell.split("/")
        low, high = figures["widths"]
        label = f"{float(share):.0%}" + (", ignored" if way == "ignored" else "")
        seconds, sets = f"{figures['CPU seconds']:.0f}", str(figures["data sets"])
        offset, widths = f"{figures['largest offset']:.2f}", f"{low:.2f} to {high:.2f}"
        yield [label, error, offset, widths, seconds, sets]


def data_sheets() -> Iterator[Row]:
    """Yield the coverage of intervals from data sheets."""
    table = summary("data_sheets")
    sheets = {
        "mean sd": "mean, standard deviation",
        "extremes": "smallest, largest",
        "mean sd extremes": "these four",
        "quartiles": "quartiles",
        "all": "all seven",
    }
    for (kind, label), name in product(sheets.items(), ("mu", "sigma")):
        cells = [
            f"{100 * table[f'{population}, {n}, {kind}'][name]:.0f}"
            for population in ("normal", "Gumbel", "gamma")
            for n in (5, 20, 100)
        ]
        yield [label, {"mu": "mean", "sigma": "standard deviation"}[name], *cells]


def sizes() -> Iterator[Row]:
    """Yield the area test's size."""
    table = summary("validity")
    for n0, n in product((15, 30, 100), (10, 20, 50)):
        cells = [
            short(table[f"size/{n0}"][f"{n}/{null}"][level], 3)
            for null in ("default", "best fit", "pool, uniform")
            for level in ("0.01", "0.05", "0.1")
        ]
        cells[1] = f"**{cells[1]}**"
        yield [str(n0), str(n), *cells]


def sizes_through() -> Iterator[Row]:
    """Yield the area test's size, through the whole package."""
    table = summary("validity")
    nulls = {
        "optimum taken as exact, fresh data": "optimum, ExactModel",
        "`JointNull`, the calibration's own data": "own data, JointNull",
        "`ExactModel`, the calibration's own data": "own data, ExactModel",
    }
    for n0, (label, null) in product(("15", "30"), nulls.items()):
        shares = table[f"pipeline/{n0}"][null].values()
        yield [n0, label, *(short(value, 3) for value in shares)]


def sizes_of_outputs() -> Iterator[Row]:
    """Yield the rejections of the area test of several outputs."""
    table = summary("validity")
    labels = {
        "0.9": "correlation .9, as calibrated",
        "0.8": "correlation .8",
        "0.6": "correlation .6",
        "0": "correlation 0",
        "mean + 0.75 sd": "mean + .75 sd",
    }
    for name, label in labels.items():
        shares = [short(value, 3) for value in table["outputs/matching"][name].values()]
        yield [label, *shares, short(table["outputs/Jeffreys"][name]["0.05"], 3)]


def power() -> Iterator[Row]:
    """Yield the power of tests."""
    (table,) = single("power").values()
    for name, row in table.items():
        yield [name.replace("|", "\\|"), *(short(value, 3) for value in row.values())]


def case_study(points: str) -> Iterator[Row]:
    """Yield errors in the paper's case study."""
    from benchmarks.paper_case1 import SIZES, collect
    from benchmarks.systems import SYSTEMS

    fits = found("paper_case1")["rows"]
    for system, n in product(SYSTEMS, SIZES):
        cells = [
            collect(fits[f"{points}/{system}/{n}/{metric}"], system, "BFGS") for metric in METRICS
        ]
        yield [system, str(n), *map(_median_errors, cells)]


def _median_errors(cell: Any) -> str:
    mean, sd = np.median(cell[:, 0]), np.median(cell[:, 1])
    return f"{mean:.2f} / {sd:.2f}" + _failed(cell)


def _failed(cell: Any) -> str:
    count = int(cell[:, 3].sum())
    return f" ({count})" if count else ""


def evaluations() -> Iterator[Row]:
    """Yield evaluations in the paper's case study."""
    from benchmarks.paper_case1 import METHODS, SIZES, collect
    from benchmarks.systems import SYSTEMS

    fits = found("paper_case1")["rows"]
    for system, method in product(SYSTEMS, METHODS):
        cells = []
        for metric in METRICS:
            rows = [row for n in SIZES for row in fits[f"sobol/{system}/{n}/{metric}"]]
            every = collect(rows, system, method)
            cells.append(f"{np.median(every[:, 2]):.0f}" + _failed(every))
        yield [system, method.replace("NM", "Nelder-Mead,"), *cells]


def scale_factor() -> Iterator[Row]:
    """Yield evaluations by the paper's scale factor."""
    for name, row in single("scale_factor").items():
        maximum, *case = name.split("/")
        if case == ["prbayes"]:
            continue
        cells = [f"{n}" if error < 0.01 else f"{n} ({error:.2g})" for n, error in row]
        yield [f"{float(maximum):g}", *case, *cells]


def landscapes() -> Iterator[Row]:
    """Yield convexity and arrival."""
    for system, metrics in single("landscapes").items():
        for metric, row in metrics.items():
            shares = (f"{row[key]:.1%}" for key in ("convex", "flat", "arrive"))
            guided = f"{row['arrive_guided']:.1%}", f"{row['evaluations_guided']:.0f}"
            yield [system, metric, *shares, f"{row['evaluations']:.0f}", *guided]


_ENOUGH = 20  # data sets of a cell that is shown


def joint() -> Iterator[Row]:
    """Yield errors of joint calibration over those of maximum likelihood, by problem."""
    from benchmarks.joint import METHODS, PROBLEMS, grouped

    schools = {"joint": "`Joint`", "separate": "separate marginals"}
    figures = summary("joint")
    for size, method in product((20, 50, 200), METHODS):
        cells = [figures.get(f"{problem}/{size}/{method}") for problem in PROBLEMS]
        shown = [cell for cell in cells if cell is not None and cell["data sets"] >= _ENOUGH]
        if len(shown) < len(cells):
            continue
        errors = [grouped(cell["rmse over likelihood"]) for cell in shown]
        school, metric = method.split()
        sets = str(min(cell["data sets"] for cell in shown))
        columns = (" / ".join(short(error) for error in of_problem) for of_problem in errors)
        yield [str(size), f"{schools[school]}, {metric}", sets, *columns]


def speed(jobs: dict[str, Any] | None = None) -> Iterator[Row]:
    """Yield CPU seconds, memory and import beside their aims."""
    from benchmarks.speed import rows

    for c, value, ratio in rows(single("speed") if jobs is None else jobs):
        shown = f"{value:.0f}" if value >= 20 else short(value)
        aim = short(c.aim) if c.aim < 1 else f"{c.aim:g}"
        met = "yes" if ratio <= c.aim else "no"
        yield [c.text, c.against, shown, short(ratio, 3) if c.against else "", aim, met]


def speed_jobs() -> Iterator[Row]:
    """Yield CPU seconds by job."""
    for name, job in single("speed").items():
        if job.keys() & {"error", "bias"}:
            cells = [short(job[key]) if key in job else "" for key in _OF_JOBS]
            yield [name, *cells, job.get("error", "")]


_OF_JOBS = ("cold", "warm", "bias", "width")


def scale() -> Iterator[Row]:
    """Yield time and memory of large problems."""
    from benchmarks.scale import THETAS

    after = {"n resimulated": "one theta", "n reweighted": "one theta, after set-up"}
    names = {
        "n resimulated": "Resimulated({:_})",
        "n reweighted": "Reweighted({:_})",
        "particles resimulated": "Resimulated(100)",
        "particles reweighted": "Reweighted(256)",
    }
    for cell, row in single("scale").items():
        kind, metric, *size = cell.split("/")
        if kind in ("tasks", "specimens"):
            continue
        n = int(size[0])
        name = f"`{names[kind].format(n)}`"
        if kind in after:
            what, seconds = f"{name}, {after[kind]}, {metric}", row["s"] / THETAS
        else:
            responses = f"{row['responses']:_} responses"
            what = f"{name}, {n:_} particles sampled, {metric}, {responses}"
            seconds = row["sampling s"]
        digits = 1 if seconds >= 1 else 3 if seconds < 0.05 else 2
        yield [what.replace("_", " "), f"{seconds:.{digits}f} s", f"{row['MiB']:.0f} MiB"]


def between_runs() -> Iterator[Row]:
    """Yield errors of emulated populations beside those of runs alone."""
    from benchmarks.responses import RESPONSES

    table = summary("between_runs")
    for name, response in RESPONSES.items():
        columns = []
        for n in (64, 256):
            cell = table[f"{name}/{n}"]
            columns += [short(cell[key]) for key in ("alone", "emulated", "ratio")]
        yield [name, str(response.d), str(response.outputs), *columns]


def few_runs() -> Iterator[Row]:
    """Yield optima from few runs."""
    from benchmarks.few_runs import NAMES, response_of

    table = summary("few_runs")
    for name in NAMES:
        emulated, alone = table[f"{name}, emulated"], table[f"{name}, alone"]
        columns = [short(emulated[key], 3) for key in ("off", "worst", "claimed")]
        widths, inputs = f"{emulated['widths']:.1%}", str(response_of(name).d)
        runs, runs_alone = ("{} - {}".format(*cell["runs"]) for cell in (emulated, alone))
        yield [name, inputs, runs, *columns, widths, runs_alone, short(alone["off"], 3)]


def many_inputs() -> Iterator[Row]:
    """Yield the errors of eight inputs by the log-likelihood."""
    from benchmarks.many_inputs import figures

    for row in found("many_inputs")["rows"]["eight inputs"]:
        cell = figures(row)
        bias = [short(cell[key]) for key in ("largest", "rms")]
        widths = f"{short(cell['narrowest'])} to {short(cell['widest'])}"
        yield [str(row["data"]), str(row["runs"]), f"{row['seconds']:.0f}", *bias, widths]


def at_a_fold() -> Iterator[Row]:
    """Yield errors of metrics near a fold."""
    from benchmarks.at_a_fold import COMPARED, RESPONSES

    table = summary("at_a_fold")
    for metric in COMPARED:
        rows = [table[f"{r}/{n}/{metric}"] for r, n in product(RESPONSES, (50, 200))]
        yield [metric, *(f"{short(row['mu'])} / {short(row['sigma'])}" for row in rows)]


def plans() -> Iterator[Row]:
    """Yield expected and found standard deviations."""
    labels = {
        "crack": ("crack growth", "21 + 20"),
        "virkler": ("Virkler", "20 + 24"),
        "exact": ("normal population, exact posterior", "21 + 20"),
    }
    names = {"quantity": "quantile later on", "any": "anything"}
    for problem, (label, specimens) in labels.items():
        table = summary("planning")[problem]
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
    """Yield errors of small probabilities."""
    for name, table in summary("risk").items():
        for key, cell in table.items():
            if not isinstance(cell, dict):
                continue
            p, points = key.split("/")
            source = "stored responses" if points.startswith("0 ") else points
            errors = [f"{cell[column]:.0%}" for column in ("rms", "stated", "within 2")]
            label, sets = name.removeprefix("errors/"), str(table["data sets"])
            yield [label, f"{float(p):.0e}", source, sets, *errors]


def risk_coverage() -> Iterator[Row]:
    """Yield coverage of bands."""
    table = summary("risk")["coverage"]
    labels = {
        "simultaneous": "simultaneous band, the whole function",
        "pointwise, entirely": "pointwise band, the whole function",
        "pointwise": "pointwise band, at one place",
    }
    for key, share in table.items():
        of, _, band = key.partition("/")
        if key != "data sets":
            what = labels.get(band, "interval of `exceedance`")
            label = of.replace("exact", "exact posterior, for comparison")
            yield [label, what, str(table["data sets"]), f"{share:.1%}"]


def thermal_conductivity() -> Iterator[Row]:
    """Yield treatments of the conductivity."""
    for name, row in found("thermal_challenge")["conductivity"].items():
        mean, constant = (f"{row[what]:+.0f}" for what in ("at the mean temperature", "at 500 C"))
        yield [name, f"{row['differences']:.0f}", mean, constant]


def thermal_population() -> Iterator[Row]:
    """Yield the population of the material."""
    for name, row in found("thermal_challenge")["population"].items():
        digits = 0 if "rhoCp" in name else 4
        optimum = f"{row['optimum']:.{digits}f} ± {row['error']:.{digits}f}"
        yield [name, optimum, f"{row['mean']:.{digits}f} ± {row['sd']:.{digits}f}"]


def thermal_capacity() -> Iterator[Row]:
    """Yield the heat capacity's scatter."""
    table = found("thermal_challenge")
    for name, row in table["capacity"].items():
        share = row["sd"] / table["sample sd"] - 1
        yield [f"`{name}`", f"{row['sd']:.0f} ± {row['error']:.0f}", f"{share:+.1%}"]


def thermal_slabs() -> Iterator[Row]:
    """Yield tests of slabs."""
    for name in ("ensemble", "accreditation"):
        row = found("thermal_challenge")[name]
        measured = f"{row['measured']:.0f}"
        if "measured sd" in row:
            measured += f" ± {row['measured sd']:.0f}"
        predicted = f"{row['predicted']:.0f} ± {row['predicted sd']:.0f}"
        yield [name, measured, predicted, short(row["p, means"]), short(row["p, spreads"])]


def thermal_risk() -> Iterator[Row]:
    """Yield the required probability."""
    labels = {"device": "published equation", "device_by_differences": "finite differences"}
    for key, row in found("thermal_challenge")["risk"].items():
        name, points = key.split("/")
        source = f"{points} points" if int(points) else "stored responses"
        interval = f"{short(row['lower'], 3)} to {short(row['upper'], 3)}"
        numbers = [short(row["probability"], 3), interval, short(row["error"], 3)]
        yield [labels[name], source, *numbers, f"{row['above']:.0%}", row["verdict"]]


def thermal_shares() -> Iterator[Row]:
    """Yield sensitivities."""
    for name, row in found("thermal_challenge")["sensitivity"].items():
        shares = [f"{short(row[w])} ± {short(row[w + '_error'])}" for w in ("first", "total")]
        yield [name, *shares]


def thermal_tests() -> Iterator[Row]:
    """Yield tests to come."""
    plan = found("thermal_challenge")["plan"]
    yield ["nothing", *[short(plan["now"], 3)] * 2, ""]
    for name, row in plan["tests"].items():
        after = [short(row[k], 3) for k in ("after 10", "after 50")]
        yield [name, *after, f"{row['halves']:.0f} of them"]


def _matrix(key: str, several: bool) -> Iterator[Row]:
    """Yield rivals over the problems of the scoreboard."""
    return scoreboard.matrix(found("scoreboard"), key, several)


def _scoreboard(problem: str) -> Iterator[Row]:
    """Yield a problem of the scoreboard."""
    return scoreboard.rows(found("scoreboard"), problem)


# Where the rows of each table are from; the first two lines of it are the page's.
def figures(step: str) -> dict[str, Any]:
    """Return the figures of a step of `benchmarks.figures`; none before it was run."""
    stored: dict[str, Any] = record.load(FIGURES / f"{step}.json", {})
    return stored


def all_figures() -> Iterator[Row]:
    """Yield figures of the structure of the code, and of its tests."""
    for name, value in (figures("structure") | figures("tests")).items():
        yield [name, f"{value:,.6g}"]


def all_coverage() -> Iterator[Row]:
    """Yield coverage of 89 % intervals: fleets by specimen, then posteriors with a metric."""
    stored = figures("coverage")
    for cell, fleet in stored.get("fleets", {}).items():
        for name in (key for key in fleet if key.startswith(("mean_", "spread_"))):
            n = 1000 * int(fleet.get("fleets", 1))
            error = np.sqrt(fleet[name] * (1 - fleet[name]) / n)
            shown = f"{short(fleet[name], 3)} ± {short(float(error), 3)}"
            yield [f"likelihood by specimen, {cell}: `{name}`", shown, f"{n:,}"]
    for name, group in stored.get("posteriors", {}).items():
        if "," in name or group["intervals"] < 150:  # too few of a single problem
            continue
        shown = f"{short(group['coverage'], 3)} ± {short(group['error'], 3)}"
        yield [f"posterior given the estimate, {name}", shown, f"{group['intervals']:,}"]


def all_scores() -> Iterator[Row]:
    """Yield errors and widths of the worst hyperparameter, runs and CPU seconds."""
    for problem, sizes in figures("scoreboard").items():
        for size, cell in sizes.items():
            for rival, one in cell.items():
                if not one.get("data sets"):
                    continue
                error, width = scoreboard.worst(one, "rms"), scoreboard.worst(one, "width")
                shown = ["" if v is None else short(v) for v in (error, width)]
                sets = str(one["data sets"])
                yield [
                    problem,
                    size,
                    rival,
                    *shown,
                    f"{one['runs']:,.0f}",
                    f"{one['cpu']:.2g}",
                    sets,
                ]


TABLES: dict[str, Callable[[], Iterator[Row]]] = {
    "figures, structure": all_figures,
    "figures, coverage": all_coverage,
    "figures, scoreboard": all_scores,
    "figures, speed": lambda: speed(figures("speed")),
    "posterior coverage": posterior_coverage,
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
    "kinds of readings": kinds_of_readings,
    "selection": selection,
    "data sheets": data_sheets,
    "gross errors": gross_errors,
    "readings, coverage": partial(coverage_of, "readings_coverage"),
    "covariates": partial(coverage_of, "covariates"),
    "metric prices": metric_prices,
    "landscapes": landscapes,
    "joint, errors": joint,
    "speed": speed,
    "speed, jobs": speed_jobs,
    "scale": scale,
    "between runs": between_runs,
    "few runs": few_runs,
    "many inputs": many_inputs,
    "at a fold": at_a_fold,
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
