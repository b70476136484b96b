"""The score of a rival on a problem: bias and width in units of the reference, coverage, runs, time, failures."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.scoreboard.problem import Draws, Problem, Reference

LEVEL = 0.89


def summary(draws: Draws) -> dict[str, dict[str, float | None]]:
    """Return mean, sd and equal-tailed 89% interval of each value; a single number has no width."""
    found: dict[str, dict[str, float | None]] = {}
    for name, value in draws.items():
        values = np.ravel(np.asarray(value, dtype=float))
        if not np.isfinite(values).all() or values.size == 0:
            raise ValueError(f"{name} has draws that are no finite numbers")
        mean = float(values.mean())
        if values.size == 1:
            found[name] = {"mean": mean, "sd": None, "low": None, "high": None}
            continue
        low, high = np.quantile(values, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
        found[name] = {"mean": mean, "sd": float(values.std(ddof=1))}
        found[name] |= {"low": float(low), "high": float(high)}
    return found


def score(problem: Problem, size: int, rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the score of the rows of one size.

    Bias is the mean over data sets of what lies between a mean and the reference's, in standard
    deviations of the reference; rms is the root of the mean of its square. Coverage is the share of
    intervals that have the truth, where data sets are drawn from one.
    """
    rows = [row for row in rows if row["size"] == size]
    good = [row for row in rows if "error" not in row]
    references = [problem.reference(size, row["replicate"]) for row in good]
    names = list(references[0].center) if good else []
    found: dict[str, Any] = {"data sets": len(rows), "failures": len(rows) - len(good)}
    for key in ("runs", "cpu"):
        found[key] = float(np.median([row[key] for row in good])) if good else None
    for name in names:
        values = [row["values"][name] for row in good]
        found[name] = _one(name, values, references, problem.truth)
    return found


def _one(
    name: str, values: list[Any], references: list[Reference], truth: dict[str, float] | None
) -> dict[str, float | None]:
    unit = np.array([reference.sd[name] for reference in references])
    center = np.array([reference.center[name] for reference in references])
    off = (np.array([value["mean"] for value in values]) - center) / unit
    found: dict[str, float | None] = {
        "bias": float(off.mean()),
        "rms": float(np.sqrt((off**2).mean())),
        "width": None,
        "coverage": None,
    }
    if values[0]["sd"] is not None:
        sd = np.array([value["sd"] for value in values])
        found["width"] = float(np.median(sd / unit))
        if truth is not None:
            inside = [value["low"] <= truth[name] <= value["high"] for value in values]
            found["coverage"] = float(np.mean(inside))
    return found
