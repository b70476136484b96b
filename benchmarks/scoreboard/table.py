"""The scoreboard: every rival's score on every problem, in one file, and two pictures of it.

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
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import record
from benchmarks.scoreboard.problems import PROBLEMS, tension_304l
from benchmarks.scoreboard.score import score
from benchmarks.scoreboard.study import STORE

PICTURES = Path(__file__).parents[2] / "docs" / "images"
_ENOUGH = 20  # data sets of a coverage that is told: its standard error is .07
_ACROSS = 4  # panels of a picture
_TENSION = tension_304l.PROBLEM.name
# Axes that are the same in all panels; what lies beyond stands at their edge.
_LIMITS = {"rms": (0.005, 20.0), "width": (0.25, 8.0)}
_RUNS, _WIDTHS = (60.0, 3e8), (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
_COSTS = ("data sets", "failures", "runs", "cpu")
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


def matrix(found: dict[str, Any], key: str, several: bool) -> Iterator[list[str]]:
    """Yield a row of a rival over problems of one output or several: the worst figure of each."""
    names = [name for name in found if (np.ndim(_observed(name)) > 1) == several]
    columns = [found[name][size_of(found[name])] for name in names]
    yield ["*specimens*", *(size_of(found[name]) for name in names)]
    for rival in RIVALS:
        row = [_summary(column.get(rival), key) for column in columns]
        if any(row):
            yield [rival, *row]


def _observed(name: str) -> Any:
    problem = PROBLEMS[name]
    return problem.data(problem.sizes[0], 0)


def _summary(one: dict[str, Any] | None, key: str) -> str:
    if one is None:
        return ""
    if "cannot" in one:
        return "cannot"
    value = worst(one, key)
    if value is None:
        return "fails" if one["failures"] else "one number"
    return f"{_plain(value)} ({one['data sets'] - one['failures']})"


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


def yields() -> Iterator[list[str]]:
    """Yield each rival's predictive standard deviation of the yield of 304L, in ksi."""
    by_rival = {one["rival"]: one["rows"] for one in stored(STORE) if one["problem"] == _TENSION}
    for rival in RIVALS:
        for row in by_rival.get(rival, []):
            if "error" not in row:
                yield [rival, f"{row['values'][tension_304l.PREDICTIVE]['mean']:.2f}"]


def cannot(found: dict[str, Any]) -> Iterator[list[str]]:
    """Yield who cannot say a problem, and why."""
    reasons: dict[tuple[str, str], list[str]] = {}
    for problem, sizes in found.items():
        for rival, one in sizes[size_of(sizes)].items():
            if "cannot" in one:
                reasons.setdefault((rival, one["cannot"]), []).append(problem)
    for (rival, reason), problems in reasons.items():
        yield [rival, "; ".join(problems), reason]


def pictures(found: dict[str, Any], folder: Path) -> None:
    """Draw accuracy against runs, and width against the number of specimens."""
    import matplotlib.pyplot as plt

    colors = dict(zip(RIVALS, plt.get_cmap("tab20")(np.arange(len(RIVALS))), strict=True))
    rows = -(-len(found) // _ACROSS)
    for key, file in (("rms", "accuracy"), ("width", "width")):
        size = (3.2 * _ACROSS, 2.8 * rows + 0.8)
        figure, axes = plt.subplots(
            rows, _ACROSS, figsize=size, squeeze=False, layout="constrained"
        )
        for axis, name in zip_longest(axes.ravel(), found):
            if name is None:
                axis.set_axis_off()
            else:
                _panel(axis, name, found[name], colors, key)
        label = "sd / reference sd" if key == "width" else "rms error / reference sd"
        for axis in axes[:, 0]:
            axis.set_ylabel(f"{label}, worst")
        told = [axis.get_legend_handles_labels() for axis in axes.ravel()]
        handles = {t: h for both in told for h, t in zip(*both, strict=True)}
        figure.legend(handles.values(), handles, loc="outside lower center", ncols=5, frameon=False)
        figure.savefig(folder / f"scoreboard_{file}.png", dpi=90)
        plt.close(figure)


def _panel(axis: Any, name: str, sizes: dict[str, Any], colors: dict[str, Any], key: str) -> None:
    """Draw a problem: accuracy at one number of specimens, or width at all of them."""
    shown = sizes if key == "width" else {size_of(sizes): sizes[size_of(sizes)]}
    for rival, color in colors.items():
        marker = "s" if rival.startswith("prbayes") else "o"
        points = list(_points(shown, rival, key))
        if not points:
            continue
        x, y = zip(*points, strict=True)
        style = {"marker": marker, "color": color, "label": rival}
        if x[0]:
            axis.plot(x, y, linestyle="-" if key == "width" else "none", **style)
        else:  # runs were not counted
            axis.axhline(y[0], linestyle=":", **style | {"marker": None})
    axis.set(title=name, xscale="log", yscale="log", ylim=_LIMITS[key])
    if key == "width":
        axis.set_xlabel("specimens")
        numbers = [float(size) for size in sizes]
        axis.set_xlim(min(numbers) / 1.5, max(numbers) * 1.5)
        axis.set_xticks(numbers, list(sizes), minor=False)
        axis.set_xticks([], minor=True)
        axis.set_yticks(_WIDTHS, [f"{width:g}" for width in _WIDTHS])
        axis.set_yticks([], minor=True)
        axis.axhline(1.0, color="k", lw=0.6)
    else:
        axis.set(xlim=_RUNS, xlabel=f"runs of the response, {size_of(sizes)} specimens")


def _points(sizes: dict[str, Any], rival: str, key: str) -> Iterator[tuple[float, float]]:
    for size, cell in sizes.items():
        one = cell.get(rival)
        value = None if one is None else worst(one, key)
        if one is not None and value:
            kept = np.clip(value, *_LIMITS[key])
            yield (float(size) if key == "width" else one["runs"]), float(kept)


def main() -> None:
    """Write the scores, and draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--store", type=Path, default=STORE)
    parser.add_argument("--pictures", type=Path, default=PICTURES)
    arguments = parser.parse_args()
    found = scores(arguments.store)
    record.save(arguments.store.with_suffix(".json"), found, ("numpy", "scipy"))
    pictures(found, arguments.pictures)


if __name__ == "__main__":
    main()
