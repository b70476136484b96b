"""Tables of the README and the pages, written from benchmarks/results.

Their rows are between `<!-- table: name -->` and `<!-- end -->`.

Run: uv run python -m benchmarks.pages
"""

from __future__ import annotations

import csv
import io
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
SCOREBOARD = DOCS / "appendix/scoreboard.csv"
PAGES = sorted([*DOCS.glob("*.md"), *DOCS.glob("appendix/*.md"), DOCS.parent / "paper/paper.md"])
README, CHANGELOG = DOCS.parent / "README.md", DOCS.parent / "CHANGELOG.md"
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
    from benchmarks.posterior import PROBLEMS as CASES
    from benchmarks.posterior import groups, pooled

    figures = summary("posterior")
    for name, has in groups().items():
        if "," in name or name in CASES:
            continue
        group = pooled(figures, has)
        coverage = f"{short(group['coverage'], 3)} ± {short(group['error'], 3)}"
        yield [name, coverage, f"{group['intervals']:,}", str(group["failed"])]


def likelihood_ranks() -> Iterator[Row]:
    """Yield coverage and uniformity of the log-likelihood by specimen, by problem."""
    for problem, table in summary("likelihood_coverage").items():
        held, exact = table["prbayes"]["coverage"], table["exact"]["coverage"]
        shares = (f"{short(held[name], 3)} ({short(exact[name], 3)})" for name in held)
        p = (short(table["prbayes"]["p of uniformity"][name]) for name in held)
        distances = (short(max(table[key]), 3) for key in ("distance of 99%", "largest distance"))
        sets = str(table["data sets"])
        yield [problem, ", ".join(held), sets, ", ".join(shares), ", ".join(p), *distances]


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
        sets = sum(c["data sets"] for c in those)
        yield [case, metric, str(sets), short(rms), short(most), f"{short(low)} to {short(high)}"]


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
            short(offset), short(largest), widths,
        ]  # fmt: skip


# Priors of one simulator of one output, and problems of several.
_CASES = (
    "vague", "bounded", "sharp", "conflict", "4 simulators", "8 simulators", "3 outputs", "4 outputs",
)  # fmt: skip


def tails() -> Iterator[Row]:
    """Yield coverage of quantiles by both families, and the ratio of the widths, by population."""
    for cell, figures in summary("tails").items():
        truth, n, response = cell.split("/")
        normal, wide = (figures[family]["hits"] for family in ("normal", "sinh-arcsinh"))
        yield [
            f"{truth}, {n}" + (", fold" if response == "fold" else ""),
            str(figures["data sets"]),
            " ".join(short(normal[k]) for k in (0, -1)),
            " ".join(map(short, wide)),
            " ".join(short(figures["ratio"][k]) for k in (0, 2, -1)),
        ]


def published_data() -> Iterator[Row]:
    """Yield the largest offset and the range of widths of posteriors of published data."""
    from benchmarks.published import SPECIMENS

    for cell, row in single("published").items():
        pairs = [(v["prbayes"], v["reference"]) for v in row["values"].values()]
        offset = max(abs(mean - exact) / sd for (mean, *_), (exact, sd, *_) in pairs)
        widths = [sd / exact for (_, sd, *_), (_, exact, *_) in pairs]
        between = f"{short(min(widths))} to {short(max(widths))}"
        costs = str(row["runs"]), f"{row['cpu']:.0f}"
        yield [cell, str(SPECIMENS[cell]), *costs, short(offset), between]


def discrepancy() -> Iterator[Row]:
    """Yield coverage and widths by the free shape and by the line, by true discrepancy."""
    figures = summary("discrepancy")
    for truth in ("stiffening", "saturating", "periodic", "none"):
        row = [truth]
        for place in ("within", "beyond"):
            for kind in ("smooth", "line"):
                cell = figures[f"{truth}/{kind}"]
                row.append(f"{short(cell['inside'][place])} ({cell['width'][place]:.3g})")
        yield row


def guard_sizes() -> Iterator[Row]:
    """Yield how often right models are flagged by the guards of the log-likelihood by specimen."""
    for problem, checks in summary("likelihood_guards").items():
        shares = (
            f"{short(cell['share'], 3)} ± {short(cell['standard error'], 3)} ({cell['data sets']})"
            for cell in checks.values()
        )
        yield [problem, *shares]


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
        columns = name.split(", ")
        if columns[0] not in ("PR", "log-likelihood"):  # others are of an earlier version
            continue
        for part in (cell["mu"], cell["sigma"]):
            columns += [f"{part['off']:.2f}", f"{part['ratio']:.2f}"]
            columns.append(f"{part['held']:.0%} ({part['exact held']:.0%})")
        yield [*columns, str(cell["data sets"])]


def gross_errors() -> Iterator[Row]:
    """Yield the price and the gain of gross errors in a likelihood by specimen."""
    rows = summary("gross_errors")
    for name, row in rows.items():
        size, shift, flag = name.split("/")
        if flag == "True":
            continue
        both = row, rows[f"{size}/{shift}/True"]
        bias = (" / ".join(f"{value + 0.0:+.2f}" for value in one["bias"]) for one in both)
        width = (" / ".join(f"{value:.2f}" for value in one["width"]) for one in both)
        yield [size, f"{shift} sd" if shift != "0" else "none", *bias, *width]


def coverage_of(study: str) -> Iterator[Row]:
    """Yield bias and coverage of a study's cases beside the exact posterior."""
    for case, table in summary(study).items():
        held = table["prbayes"]["coverage"]
        shares = (f"{short(held[n])} ({short(table['exact']['coverage'][n])})" for n in held)
        refused = f", {table['refused']} refused" if table["refused"] else ""
        yield [
            case,
            ", ".join(held),
            f"{table['data sets']}{refused}",
            short(max(map(abs, table["bias"]))),
            short(max(table["largest distance"])),
            ", ".join(shares),
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
        label = f"{float(share):.0%}" + {"ignored": ", ignored", "window": ", window"}.get(way, "")
        seconds, sets = f"{figures['CPU seconds']:.0f}", str(figures["data sets"])
        sets += f", {figures['refused']} refused" if figures["refused"] else ""
        offset, widths = f"{figures['largest offset']:.2f}", f"{low:.2f} to {high:.2f}"
        yield [label, error, offset, widths, seconds, sets]


def random_responses() -> Iterator[Row]:
    """Yield offsets, widths and coverage of posteriors of random responses."""
    names = {"one": "one input, one output", "two": "two inputs, two outputs"}
    for cell, figures in summary("random_responses").items():
        half = len(figures["coverage"]) // 2
        for label, part in (("mean", slice(half)), ("sd", slice(half, None))):
            numbers = [np.mean(figures[key][part]) for key in ("mean offset", "rms offset")]
            keys = ("mean width", "coverage", "exact coverage", "expected coverage")
            numbers += [np.mean(figures[key][part]) for key in keys]
            texts = [f"{number:.2f}" for number in numbers]
            seconds, sets = f"{figures['CPU seconds']:.0f}", str(figures["data sets"])
            yield [f"{names[cell]}: {label}", *texts, seconds, sets]


def sizes() -> Iterator[Row]:
    """Yield the area test's size."""
    table = summary("validity")
    for n0, n in product((15, 30, 100), (10, 20, 50)):
        row = table[f"size/{n0}"]
        cells = [short(row[f"{n}/default"][level], 3) for level in ("0.01", "0.05", "0.1")]
        cells[1] = f"**{cells[1]}**"
        yield [str(n0), str(n), *cells, short(row[f"{n}/best fit"]["0.05"], 3)]


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
        yield [label, *shares]


def power() -> Iterator[Row]:
    """Yield the power of tests."""
    (table,) = single("power").values()
    for name, row in table.items():
        if name not in ("Cramer-von Mises", "ArviZ prit_c"):  # as Kolmogorov-Smirnov and pot_c
            yield [name.replace("|", "\\|"), *(short(value, 3) for value in row.values())]


def case_study() -> Iterator[Row]:
    """Yield errors in the paper's case study."""
    from benchmarks.paper_case1 import collect
    from benchmarks.systems import SYSTEMS

    fits = found("paper_case1")["rows"]
    for system, n in product(SYSTEMS, (50, 1000, 100_000)):
        cells = [
            collect(fits[f"sobol/{system}/{n}/{metric}"], system, "BFGS") for metric in METRICS
        ]
        yield [system, str(n), *map(_median_errors, cells)]


def _median_errors(cell: Any) -> str:
    mean, sd = np.median(cell[:, 0]), np.median(cell[:, 1])
    return f"{mean:.2f} / {sd:.2f}" + _failed(cell)


def _failed(cell: Any) -> str:
    count = int(cell[:, 3].sum())
    return f" ({count})" if count else ""


_ENOUGH = 20  # data sets of a cell that is shown


def joint() -> Iterator[Row]:
    """Yield errors of joint calibration over those of maximum likelihood, by problem."""
    from benchmarks.joint import METHODS, PROBLEMS, grouped

    schools = {"joint": "`Joint`", "separate": "separate marginals"}
    figures = summary("joint")
    for method in METHODS:
        cells = [figures.get(f"{problem}/50/{method}") for problem in PROBLEMS]
        shown = [cell for cell in cells if cell is not None and cell["data sets"] >= _ENOUGH]
        if len(shown) < len(cells):
            continue
        errors = [grouped(cell["rmse over likelihood"]) for cell in shown]
        school, metric = method.split()
        sets = str(min(cell["data sets"] for cell in shown))
        columns = (" / ".join(short(error) for error in of_problem) for of_problem in errors)
        yield [f"{schools[school]}, {metric}", sets, *columns]


def speed() -> Iterator[Row]:
    """Yield CPU seconds, memory and import beside their aims."""
    from benchmarks.speed import rows

    for c, value, ratio in rows(figures("speed")):
        shown = f"{value:.0f}" if value >= 20 else short(value)
        aim = short(c.aim) if c.aim < 1 else f"{c.aim:g}"
        met = "yes" if ratio <= c.aim else "no"
        yield [c.text, c.against, shown, short(ratio, 3) if c.against else "", aim, met]


def scale() -> Iterator[Row]:
    """Yield time and memory of the largest problems, by PR."""
    from benchmarks.scale import SIZES, THETAS

    after = {"n resimulated": "one theta", "n reweighted": "one theta, after set-up"}
    names = {
        "n resimulated": "Resimulated({:_})",
        "n reweighted": "Reweighted({:_})",
        "particles resimulated": "Resimulated(100)",
        "particles reweighted": "Reweighted(256)",
    }
    for cell, row in single("scale").items():
        kind, metric, *size = cell.split("/")
        if kind in ("tasks", "specimens") or metric != "PR":
            continue
        n = int(size[0])
        if n < max(SIZES[kind]):
            continue
        name = f"`{names[kind].format(n)}`"
        if kind in after:
            what, seconds = f"{name}, {after[kind]}", row["s"] / THETAS
        else:
            responses = f"{row['responses']:_} responses"
            what = f"{name}, {n:_} particles sampled, {responses}"
            seconds = row["sampling s"]
        digits = 1 if seconds >= 1 else 3 if seconds < 0.05 else 2
        yield [what.replace("_", " "), f"{seconds:.{digits}f} s", f"{row['MiB']:.0f} MiB"]


def between_runs() -> Iterator[Row]:
    """Yield errors of emulated populations beside those of runs alone."""
    from benchmarks.responses import RESPONSES

    table = summary("between_runs")
    for name, response in RESPONSES.items():
        cell = table[f"{name}/64"]
        columns = [short(cell[key]) for key in ("alone", "emulated")]
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
        if metric.startswith("KLD, 0.5"):
            continue
        rows = [table[f"{r}/{n}/{metric}"] for r, n in product(RESPONSES, (50, 200))]
        yield [metric, *(f"{short(row['mu'])} / {short(row['sigma'])}" for row in rows)]


def plans() -> Iterator[Row]:
    """Yield expected over found standard deviations, with the share of good predictions."""
    labels = {
        "crack": ("crack growth", "21 + 20"),
        "virkler": ("Virkler", "20 + 24"),
        "exact": ("normal population, exact posterior", "21 + 20"),
    }
    for problem, (label, specimens) in labels.items():
        table = summary("planning")[problem]
        rows: dict[str, list[str]] = {}
        for key, cell in table["table"].items():
            ratio = f"{short(cell['ratio'])} ± {short(cell['error'])}"
            shown = f"{ratio}, {cell['within 15%']:.0%}"
            rows.setdefault(key.split("/")[0], []).append(shown)
        for condition, cells in rows.items():
            repeated = cells * 3 if len(cells) == 1 else cells
            yield [label, specimens, condition, *repeated, str(table["data sets"])]


def risk_errors() -> Iterator[Row]:
    """Yield errors of small probabilities, from stored responses and from new points."""
    for name, table in summary("risk").items():
        rows: dict[str, list[list[str]]] = {}
        for key, cell in table.items():
            if isinstance(cell, dict):
                errors = [f"{cell[column]:.0%}" for column in ("rms", "stated", "within 2")]
                rows.setdefault(key.split("/")[0], []).append(errors)
        for p, both in rows.items():
            stored = both[0] if len(both) > 1 else [""] * 3
            yield [name.removeprefix("errors/"), f"{float(p):.0e}", *stored, *both[-1]]


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
        if key != "data sets" and of != "another":  # as the response, by a monotone function
            what = labels.get(band, "interval of `exceedance`")
            label = of.replace("exact", "exact posterior, for comparison")
            yield [label, what, f"{share:.1%}"]


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


def _matrix(several: bool) -> Iterator[Row]:
    """Yield rivals over the problems of the scoreboard."""
    return scoreboard.matrix(found("scoreboard"), several)


def scoreboard_file() -> str:
    """Return all rows of the scoreboard as comma-separated values."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(("problem", *scoreboard.COLUMNS))
    for problem in PROBLEMS:
        writer.writerows([problem, *row] for row in scoreboard.rows(found("scoreboard"), problem))
    return text.getvalue()


def figures(step: str) -> dict[str, Any]:
    """Return the figures of a step of `benchmarks.figures`; none before it was run."""
    stored: dict[str, Any] = record.load(FIGURES / f"{step}.json", {})
    return stored


def all_figures() -> Iterator[Row]:
    """Yield figures of the size of the code and of its tests."""
    stored = figures("structure") | figures("tests")
    for name, value in stored.items():
        if name.startswith(("modules", "lines", "tests", "their CPU")):
            yield [name, f"{value:,.6g}"]


def all_coverage() -> Iterator[Row]:
    """Yield coverage of 89 % intervals: fleets by specimen, then posteriors with a metric."""
    stored = figures("coverage")
    for cell, fleet in stored.get("fleets", {}).items():
        names = [key for key in fleet if key.startswith(("mean_", "spread_"))]
        n = 1000 * int(fleet.get("fleets", 1))
        error = float(max(np.sqrt(fleet[name] * (1 - fleet[name]) / n) for name in names))
        shown = ", ".join(short(fleet[name], 3) for name in names)
        yield [f"likelihood by specimen, {cell}", f"{shown}, each ± {short(error, 3)}", f"{n:,}"]
    posteriors = stored.get("posteriors", {})
    for name in ("all", "PR", "KLD", "area"):
        if name in posteriors:
            group = posteriors[name]
            shown = f"{short(group['coverage'], 3)} ± {short(group['error'], 3)}"
            yield [f"posterior given the estimate, {name}", shown, f"{group['intervals']:,}"]


def all_scores() -> Iterator[Row]:
    """Yield error and width of the worst hyperparameter by method, a row for each problem and size."""
    for problem, sizes in figures("scoreboard").items():
        for size, cell in sizes.items():
            columns = [_score(cell.get(f"prbayes {name}")) for name in _SCORED]
            if any(columns):
                sets = max(one["data sets"] for one in cell.values())
                yield [problem, size, *columns, str(sets)]


def readme_table() -> Iterator[Row]:
    """Yield estimates of crack growth by each likelihood and metric."""
    for name, cells in figures("readme")["table"].items():
        yield [name, *cells]


def fleets() -> Iterator[Row]:
    """Yield runs, CPU seconds and coverage of fleets."""
    labels = {
        "one input, posteriors alone": "one input, posteriors alone",
        "one input": "one input, with validity tests of ten specimens",
        "two inputs, two outputs": "two inputs, two outputs, with validity tests",
    }
    for cell, row in single("fleet").items():
        columns = [str(row["runs"]), f"{row['cpu_seconds']:.0f}"]
        for part in ("mean_", "spread_"):
            shares = (short(value, 3) for key, value in row.items() if key.startswith(part))
            columns.append(", ".join(shares))
        rejected = short(row["rejected"], 3) if "rejected" in row else ""
        yield [labels[cell], *columns, rejected]


def sheets_of_pairs() -> Iterator[Row]:
    """Yield widths of intervals from data sheets of two outputs over those from specimens."""
    for name, correlation in (("correlated", ".89"), ("weakly correlated", ".32")):
        cell = summary("joint_data_sheets")[f"{name}, 20, mean sd"]
        for way, label in (("together", "mapping"), ("separate", "two simulators")):
            widths = (
                ", ".join(short(cell[f"{way}, {value} {k}, sd ratio"]) for k in (1, 2))
                for value in ("mu", "sigma")
            )
            yield [correlation, label, *widths]


def basis_values() -> Iterator[Row]:
    """Yield shares of data sets in which basis values and intervals hold."""
    labels = {"sample": "`prb.sample`, wide priors", "optimum": "`prb.minimize`"}
    yield ["right", "", *[".95"] * 2, *[".89"] * 3]
    for cell, row in summary("population").items():
        name, n = cell.split(", N = ")
        shares = (row[key] for key in ("B-basis", "A-basis", "mean", "sd", "5% quantile"))
        yield [n, labels.get(name, name), *(short(value, 3) for value in shares)]


_SCORED = ("likelihood", "KLD", "PR", "area")


def _score(one: dict[str, Any] | None) -> str:
    """Return error and width of a cell; nothing of a method that was not run."""
    if one is None:
        return ""
    error, width = scoreboard.worst(one, "rms"), scoreboard.worst(one, "width")
    return "" if error is None or width is None else f"{short(error)}, {short(width)}"


# Where the rows of each table are from; the first two lines of it are the page's.
TABLES: dict[str, Callable[[], Iterator[Row]]] = {
    "figures, structure": all_figures,
    "figures, coverage": all_coverage,
    "figures, scoreboard": all_scores,
    "figures, speed": speed,
    "posterior coverage": posterior_coverage,
    "likelihood, ranks": likelihood_ranks,
    "likelihood, sizes of guards": guard_sizes,
    "saddlepoint": saddlepoint,
    "saddlepoint_refits": saddlepoint_refits,
    "size": sizes,
    "size, several outputs": sizes_of_outputs,
    "power": power,
    "case study, Sobol points": case_study,
    "partial pooling": partial_pooling,
    "small groups": small_groups,
    "measurement error": measurement_error,
    "tails": tails,
    "discrepancy": discrepancy,
    "kinds of readings": kinds_of_readings,
    "selection": selection,
    "random_responses": random_responses,
    "gross errors": gross_errors,
    "readings, coverage": partial(coverage_of, "readings_coverage"),
    "covariates": partial(coverage_of, "covariates"),
    "metric prices": metric_prices,
    "joint, errors": joint,
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
    "scoreboard, one output": lambda: _matrix(several=False),
    "scoreboard, several outputs": lambda: _matrix(several=True),
    "published data": published_data,
    "README, crack growth": readme_table,
    "fleets": fleets,
    "data sheets of pairs": sheets_of_pairs,
    "basis values": basis_values,
}
_MARKED = re.compile(
    r"(<!-- table: (?P<name>[^>]+) -->\n\n(?:\|[^\n]*\n){2})(?:\|[^\n]*\n)*(\n<!-- end -->)"
)


def written(page: str) -> str:
    """Return a page with its tables' rows from the results; their heads stay."""

    def table(match: re.Match[str]) -> str:
        rows = TABLES[match["name"]]()
        return match[1] + "".join(f"| {' | '.join(row)} |\n" for row in rows) + match[3]

    return _MARKED.sub(table, page)


def rewritten(path: Path) -> str:
    """Return the README, a page or the changelog with all figures from the results."""
    from benchmarks.sentences import with_figures

    text = with_figures(path, written(path.read_text(encoding="utf-8")))
    if path == README:
        printed = iter(figures("readme")["printed"])
        block = re.compile(r"(?<=^```text\n).*?(?=^```)", re.MULTILINE | re.DOTALL)
        text = block.sub(lambda _: next(printed), text)
    return text


def main() -> None:
    """Write all pages."""
    for path in (README, CHANGELOG, *PAGES):
        path.write_text(rewritten(path), encoding="utf-8")
    SCOREBOARD.write_text(scoreboard_file(), encoding="utf-8")


if __name__ == "__main__":
    main()
