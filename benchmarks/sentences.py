"""Figures in sentences of the README, the pages and the changelog, from benchmarks/results.

`python -m benchmarks.pages` writes them with the tables, and tests/test_pages.py compares them.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path

from benchmarks.pages import DOCS, figures, found, short, single, summary

ROOT = DOCS.parent


def extremes(values: Iterable[float], digits: int = 2) -> tuple[str, str]:
    """Return the smallest and the largest value."""
    listed = list(values)
    return short(min(listed), digits), short(max(listed), digits)


def percent(values: Iterable[float]) -> tuple[str, str]:
    """Return the smallest and the largest share in percent."""
    listed = list(values)
    return f"{100 * min(listed):.0f}", f"{100 * max(listed):.0f}"


def readme_runs() -> list[str]:
    """Return the numbers of runs of the main job: by specimen and by metrics."""
    runs = figures("readme")["runs"]
    return [str(runs["by specimen"]), str(runs["PR"])]


def made_up() -> list[str]:
    """Return the number of made-up problems, and how many agree with their references."""
    cells = summary("made_up").values()
    return [str(len(cells)), str(sum(cell["holds"] for cell in cells))]


def second_branch() -> tuple[str, str]:
    """Return the smallest and the largest width where a second branch is missed."""
    cell = summary("reach")["sqrt(a^2 + .01) + b"]
    return extremes([cell["narrowest"], cell["widest"]])


def data_sets(study: str) -> list[str]:
    """Return the number of data sets of a study."""
    return [str(sum(cell["data sets"] for cell in summary(study).values()))]


def large_specimens() -> list[str]:
    """Return CPU seconds and GiB of 100 000 specimens."""
    row = single("scale")["specimens/100000"]
    return [f"{row['s']:.0f}", short(row["MiB"] / 1024, 1)]


def gamma_tails() -> list[str]:
    """Return coverage of the 1 and 99 % quantiles of a gamma population, by both families."""
    cell = summary("tails")["gamma/50/y = x"]
    return [
        short(cell[family]["hits"][k]) for family in ("normal", "sinh-arcsinh") for k in (0, -1)
    ]


def far_quantiles() -> tuple[str, str]:
    """Return coverage of the 99 % quantile by the wider family, over populations not normal."""
    cells = summary("tails").items()
    names = (name for name, _ in cells if "/50/y" in name and not name.startswith("normal"))
    return extremes(summary("tails")[name]["sinh-arcsinh"]["hits"][-1] for name in names)


def skewed_quantile() -> list[str]:
    """Return the error of the 99 % quantile of a gamma population."""
    return [short(-summary("tails")["gamma/50/y = x"]["sinh-arcsinh"]["error"][-1])]


def plans() -> list[str]:
    """Return shares of plans within 15 %, and that of the exact posterior."""
    table = summary("planning")
    cells = [cell for name in ("crack", "virkler") for cell in table[name]["table"].values()]
    exact = table["exact"]["table"]["same/any"]["within 15%"]
    return [*percent(cell["within 15%"] for cell in cells), f"{100 * exact:.0f}"]


def own_conditions() -> tuple[str, str]:
    """Return the smallest and the largest coverage under a load of each specimen."""
    rows = single("own_conditions").values()
    return extremes((v for row in rows for name, v in row.items() if name != "cpu_seconds"), 3)


def updates() -> list[str]:
    """Return the largest distance of a mean after updates."""
    return [short(max(cell["largest bias"] for cell in summary("updates").values()))]


def histories() -> list[str]:
    """Return the data sets of dose histories, their largest distance, runs and CPU seconds."""
    rows = found("histories")["rows"]["59 subjects"]
    names = [k for k in rows[0] if k.startswith(("cl", "v", "spread", "error"))]
    largest = max(abs(row[k]) for row in rows for k in names)
    costs = (f"{max(row[k] for row in rows):.0f}" for k in ("runs", "cpu_seconds"))
    return [str(len(rows)), short(largest), *costs]


def invertible() -> list[str]:
    """Return the number of invertible responses, of right posteriors, and of runs at most."""
    cells = summary("invertible").values()
    sums = [str(sum(cell[key] for cell in cells)) for key in ("data sets", "right")]
    return [*sums, str(max(cell["runs"] for cell in cells))]


def data_sheets() -> list[str]:
    """Return the smallest and the largest coverage of data sheets, and their number of cells."""
    cells = summary("data_sheets").values()
    shares = [cell[name] for cell in cells for name in ("mu", "sigma")]
    return [*percent(shares), str(len(shares))]


def skewed_sheet() -> list[str]:
    """Return the coverage of a spread by five values of a gamma population."""
    return [short(summary("data_sheets")["gamma, 5, mean sd"]["sigma"])]


def sheets_of_pairs(cells: str, way: str) -> tuple[str, str]:
    """Return the smallest and the largest coverage of data sheets of two outputs."""
    table = {k: cell for k, cell in summary("joint_data_sheets").items() if re.fullmatch(cells, k)}
    names = [f"{way}, {name} {k}" for name in ("mu", "sigma") for k in (1, 2)]
    return percent(cell[name] for cell in table.values() for name in names)


def both_sheets(cells: str) -> list[str]:
    """Return coverage of data sheets together, then of specimens."""
    return [*sheets_of_pairs(cells, "together"), *sheets_of_pairs(cells, "specimens")]


def area_power() -> list[str]:
    """Return the power of the area test against wrong spreads, and that of the folded one."""
    (table,) = single("power").values()
    spreads = ("sd x 0.5", "sd x 2")
    ends = extremes(table["area"][name] for name in spreads)
    return [*ends, short(min(table["area of |2u - 1|"][name] for name in spreads))]


def bases() -> tuple[str, str]:
    """Return the smallest and the largest coverage of B-basis values."""
    return extremes((cell["B-basis"] for cell in summary("population").values()), 3)


def many_inputs() -> list[str]:
    """Return the smallest and the largest number of runs of eight inputs."""
    runs = [row["runs"] for row in found("many_inputs")["rows"]["eight inputs"]]
    return [str(min(runs)), str(max(runs))]


# File, its sentence with braces for figures, and the figures.
SENTENCES: list[tuple[str, str, Callable[[], Iterable[str]]]] = [
    ("README.md", "takes **{} runs** of the response, each metric **{}**", readme_runs),
    ("docs/limits.md", "Of {} made-up problems in all capabilities (`python -m benchmarks.made_up`) {} agree", made_up),
    ("docs/limits.md", "after {} to {} runs.\n", many_inputs),
    ("docs/limits.md", "has widths of {} to {} (`python -m benchmarks.reach`)", second_branch),
    ("docs/limits.md", "of {} data sets (`python -m benchmarks.inaccurate`)", partial(data_sets, "inaccurate")),
    ("docs/limits.md", "Of {} data sets of a frame none lacked", partial(data_sets, "modes_of_metrics")),
    ("docs/limits.md", "100 000 specimens of one input take {} CPU seconds and {} GiB", large_specimens),
    ("docs/limits.md", "contain them in {} and {} of data sets of 50 specimens, silent in part; under `prb.families.SinhArcsinh` in {} and {} (", gamma_tails),
    ("docs/limits.md", "intervals of the 99 % quantile contain it in {} to {} of data sets", far_quantiles),
    ("docs/limits.md", "this quantile is on average {} standard deviations too low", skewed_quantile),
    ("docs/limits.md", "B-basis values have a coverage of {} to {} at", bases),
    ("docs/limits.md", "with extremes, 20 specimens: 89% intervals contained the truth in {} to {}% of 200 data sets, those from specimens in {} to {}%", partial(both_sheets, "correlated, 20, mean sd extremes")),
    ("docs/limits.md", "five values of a skewed population: coverage {} at", skewed_sheet),
    ("docs/limits.md", "its power is {} to {} for half and twice the spread, {} with `folded=True`", area_power),
    ("docs/data_sheet.md", "of a mapping contained the truth in {} to {}%, those from specimens in {} to {}%", partial(both_sheets, ".*, mean sd")),
    ("docs/data_sheet.md", "contained the true value in {} to {}% of 1000", lambda: data_sheets()[:2]),
    ("docs/decision.md", "are within 15 % of the actual ones in {} to {} % of repetitions; with an exact posterior it is {} %", plans),
    ("docs/own_conditions.md", "Coverage of 89 % intervals was {} to {} on", own_conditions),
    ("docs/more_specimens.md", "means are within {} standard deviations of the exact ones", updates),
    ("docs/peers.md", "prbayes takes {} (`python -m benchmarks.reach`)", lambda: [str(summary("reach")["growth 100"]["runs"])]),
    ("docs/records.md", "all estimates of {} data sets were within {} standard errors of maximum likelihood by quadrature, with at most {} runs and {} CPU seconds", histories),
    ("docs/appendix/likelihood_details.md", "Of {} invertible responses of one to three inputs under vague priors {} have the right posterior (means within .1 standard deviations, widths within a tenth), after {} runs", invertible),
    ("docs/appendix/posterior_study.md", "standard deviation in {} to {} of 100 [data sheets](../data_sheet.md), in each of {} cells", data_sheets),
    ("docs/appendix/scoreboard.md", "the posterior is {} standard deviations from quadrature with the same readings", lambda: [short(summary("reach")["Virkler, one error"]["bias"])]),
    ("CHANGELOG.md", "at 20 specimens {} for a spread", lambda: [short(summary("bootstrap")["weighted/20"]["standard deviation"])]),
]  # fmt: skip


def with_figures(path: Path, text: str) -> str:
    """Return the text of a file with the figures of its sentences from the results."""
    for name, sentence, values in SENTENCES:
        if ROOT / name != path:
            continue
        parts = sentence.split("{}")
        pattern = r"([\d.,]+)".join(map(re.escape, parts))
        matches = list(re.finditer(pattern, text))
        if len(matches) != 1:
            raise ValueError(f"{name}: got {len(matches)} places of {sentence!r}, expected one")
        filled = parts[0] + "".join(v + p for v, p in zip(values(), parts[1:], strict=True))
        text = text[: matches[0].start()] + filled + text[matches[0].end() :]
    return text
