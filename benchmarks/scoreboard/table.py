"""The scoreboard: every rival's score on every problem, in one file.

    uv run python -m benchmarks.scoreboard.table
    uv run python -m benchmarks.pages

The first writes `benchmarks/results/scoreboard.json`, from which the second writes the tables of
`docs/appendix/scoreboard.md`. Bias is the mean over data sets of what lies between a mean and the
reference's, in standard deviations of the reference, and rms the root of its mean square; width is
the median ratio of the standard deviations; coverage that of 89% intervals, from twenty data sets
on. Runs and seconds of a processor are medians over data sets.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import record
from benchmarks.scoreboard.problems import PROBLEMS
from benchmarks.scoreboard.score import score
from benchmarks.scoreboard.study import STORE

_ENOUGH = 20  # data sets of a coverage that is told: its standard error is .07
_COSTS = ("data sets", "failures", "runs", "cpu")
# of the rows of a problem
COLUMNS = (
    "specimens",
    "method",
    "bias",
    "worst rms",
    "width",
    "coverage",
    "runs",
    "CPU s",
    "data sets",
)
# In the order of the page: by what a rival is, and prbayes first because the page is its own.
RIVALS = (
    "prbayes likelihood",
    "prbayes PR",
    "prbayes KLD",
    "prbayes area",
    "prbayes kernel log-likelihood",
    "hierarchical PyMC",
    "stock PyMC",
    "pyABC Wasserstein",
    "pyABC adaptive",
    "sbi",
    "mud",
    "Nelder-Mead PR",
)


def stored(store: Path) -> Iterator[dict[str, Any]]:
    """Yield what is stored of each rival and problem, with how it was run."""
    for path in sorted(store.glob("*.json")):
        whole = json.loads(path.read_text(encoding="utf-8"))
        yield whole["found"] | {"run": whole["run"]}


def scores(store: Path) -> dict[str, Any]:
    """Return scores by problem, number of specimens and rival; a reason where a rival cannot."""
    found: dict[str, Any] = {}
    for one in stored(store):
        problem = PROBLEMS[one["problem"]]
        sizes = {row["size"] for row in one["rows"]}
        for size in problem.sizes:
            cell = found.setdefault(problem.name, {}).setdefault(str(size), {})
            if "cannot" in one:
                cell[one["rival"]] = {"cannot": one["cannot"]}
            elif size in sizes:
                cell[one["rival"]] = score(problem, size, one["rows"])
    return {name: found[name] for name in PROBLEMS if name in found}


def hyperparameters(one: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the scores of a cell's hyperparameters, in the problem's order."""
    return [value for name, value in one.items() if name not in (*_COSTS, "cannot")]


def worst(one: dict[str, Any], key: str) -> float | None:
    """Return the largest error of a cell, or the width that is farthest from one."""
    values = [value[key] for value in hyperparameters(one) if value[key] is not None]
    if not values:
        return None
    return float(max(values, key=lambda v: abs(np.log(v)) if key == "width" else v))


def size_of(sizes: dict[str, Any]) -> str:
    """Return the number of specimens at which most rivals were run, the largest of several."""
    return max(sizes, key=lambda size: (len(sizes[size]), int(size)))


def matrix(found: dict[str, Any], several: bool) -> Iterator[list[str]]:
    """Yield a row of a rival over problems of one output or several: worst error and worst width."""
    names = [name for name in found if (np.ndim(_observed(name)) > 1) == several]
    columns = [found[name][size_of(found[name])] for name in names]
    yield ["*specimens*", *(size_of(found[name]) for name in names)]
    for rival in RIVALS:
        row = [_summary(column.get(rival)) for column in columns]
        if any(row):
            yield [rival, *row]


def _observed(name: str) -> Any:
    problem = PROBLEMS[name]
    return problem.data(problem.sizes[0], 0)


def _summary(one: dict[str, Any] | None) -> str:
    """Return error and width with the number of data sets; the error alone of a method without width."""
    if one is None:
        return ""
    if "cannot" in one:
        return "cannot"
    error, width = worst(one, "rms"), worst(one, "width")
    if error is None:
        return "fails"
    shown = _plain(error) if width is None else f"{_plain(error)}, {_plain(width)}"
    return f"{shown} ({one['data sets'] - one['failures']})"


def rows(found: dict[str, Any], problem: str) -> Iterator[list[str]]:
    """Yield the rows of a problem: every rival at every number of specimens."""
    for size, cell in found.get(problem, {}).items():
        for rival in RIVALS:
            if rival in cell and "cannot" not in cell[rival]:
                yield [size, rival, *_cells(cell[rival])]


def _cells(one: dict[str, Any]) -> list[str]:
    shown = [_figures(one, key) for key in ("bias", "width", "coverage")]
    if one["data sets"] < _ENOUGH:
        shown[-1] = ""
    error = worst(one, "rms")
    shown.insert(1, "" if error is None else _plain(error))
    runs = "not counted" if one["runs"] == 0 else _short(one["runs"])
    failed = f", {one['failures']} failed" if one["failures"] else ""
    return [*shown, runs, _short(one["cpu"]), f"{one['data sets']}{failed}"]


def _plain(value: float) -> str:
    """Return a number with two digits behind the point, and without a zero before it."""
    return f"{value:.2f}".replace("0.", ".", 1) if abs(value) < 1 else f"{value:.2f}"


def _short(value: float | None) -> str:
    return "" if value is None else f"{float(f'{value:.2g}'):,g}".replace("e+0", "e")


def _figures(one: dict[str, Any], key: str) -> str:
    values = [value[key] for value in hyperparameters(one)]
    return ", ".join(_plain(value) for value in values if value is not None)


def main() -> None:
    """Write the scores."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--store", type=Path, default=STORE)
    arguments = parser.parse_args()
    found = scores(arguments.store)
    record.save(arguments.store.with_suffix(".json"), found, ("numpy", "scipy"))


if __name__ == "__main__":
    main()
