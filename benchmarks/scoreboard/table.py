"""The scoreboard: every rival's score on every problem, as a table and two pictures.

    uv run python -m benchmarks.scoreboard.table

Bias is the mean over data sets of what lies between a mean and the reference's, in standard
deviations of the reference, and beside it the root of its mean square; width is the median ratio of
the standard deviations; coverage that of 89% intervals, from twenty data sets on. Runs and seconds
of a processor are medians over data sets. A rival without draws has no width. Figures of
hyperparameters stand in the problem's order. No runs means that they were not counted.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.scoreboard.problem import Problem
from benchmarks.scoreboard.problems import PROBLEMS
from benchmarks.scoreboard.score import score
from benchmarks.scoreboard.study import STORE

_ENOUGH = 20  # data sets of a coverage that is told: its standard error is .07
_ACROSS = 4  # panels of a picture
_COSTS = ("data sets", "failures", "runs", "cpu")


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
    return found


def cells(problem: Problem, one: dict[str, Any]) -> list[str]:
    """Return the cells of a row behind the rival's name."""
    if "cannot" in one:
        return [one["cannot"]]
    names = [name for name in one if name not in _COSTS]
    shown = [_figures(one, names, key) for key in ("bias", "rms", "width", "coverage")]
    if one["data sets"] < _ENOUGH:
        shown[-1] = "-"
    runs = "-" if one["runs"] is None else f"{one['runs']:.3g}"
    cpu = "-" if one["cpu"] is None else f"{one['cpu']:.2g}"
    return [*shown, runs, cpu, str(one["data sets"]), str(one["failures"])]


def _figures(one: dict[str, Any], names: list[str], key: str) -> str:
    values = [one[name][key] for name in names]
    return " ".join("-" if value is None else f"{value:.2f}" for value in values) or "-"


HEAD = ("rival", "bias", "rms", "width", "coverage", "runs", "cpu s", "data sets", "failures")


def page(found: dict[str, Any]) -> Iterator[str]:
    """Yield the lines of the table."""
    for name, sizes in found.items():
        problem = PROBLEMS[name]
        for size, rivals in sizes.items():
            yield f"\n**{name}**, {size} specimens. {problem.what}\n"
            yield "| " + " | ".join(HEAD) + " |"
            yield "|" + "---|" * len(HEAD)
            for rival, one in rivals.items():
                row = [rival, *cells(problem, one)]
                yield "| " + " | ".join([*row, *[""] * (len(HEAD) - len(row))]) + " |"
            if problem.published:
                yield "\nPublished: " + "; ".join(problem.published) + "."


def pictures(found: dict[str, Any], folder: Path) -> None:
    """Draw accuracy against runs, and width against the number of specimens."""
    import matplotlib.pyplot as plt

    rivals = sorted(
        {rival for sizes in found.values() for cell in sizes.values() for rival in cell}
    )
    colors = dict(zip(rivals, plt.get_cmap("tab20")(np.arange(len(rivals))), strict=True))
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
        figure.savefig(folder / f"{file}.png", dpi=110)
        plt.close(figure)


def _panel(axis: Any, name: str, sizes: dict[str, Any], colors: dict[str, Any], key: str) -> None:
    style = "-" if key == "width" else "none"
    for rival, color in colors.items():
        points = list(_points(sizes, rival, key))
        if points:
            x, y = zip(*points, strict=True)
            axis.plot(x, y, marker="o", linestyle=style, color=color, label=rival)
    axis.set(title=name, xscale="log", yscale="log")
    axis.set_xlabel("specimens" if key == "width" else "runs of the response")
    if key == "width":
        axis.axhline(1.0, color="k", lw=0.6)


def _points(sizes: dict[str, Any], rival: str, key: str) -> Iterator[tuple[float, float]]:
    for size, cell in sizes.items():
        one = cell.get(rival, {"cannot": ""})
        values = [v[key] for name, v in one.items() if name not in (*_COSTS, "cannot")]
        values = [value for value in values if value is not None]
        # A rival whose runs are not counted has no place on that axis.
        if values and (key == "width" or one["runs"]):
            # The farthest from one of the ratios, and the largest of the errors.
            worst = max(values, key=lambda v: abs(np.log(v)) if key == "width" else v)
            yield (float(size) if key == "width" else one["runs"]), worst


def main() -> None:
    """Print the table, write it, and draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--store", type=Path, default=STORE)
    arguments = parser.parse_args()
    found = scores(arguments.store)
    text = "\n".join(page(found))
    print(text)
    (arguments.store / "table.md").write_text(f"{text.strip()}\n", encoding="utf-8")
    pictures(found, arguments.store)


if __name__ == "__main__":
    main()
