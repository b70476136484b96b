"""Numbers as text."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np

NOTHING = "\u2013"  # an en dash, as printed tables have it where there is no number

# Powers of ten that are written out, others have an exponent: the lower end is that of Python's
# "g"; the upper one keeps loads in newtons and cycles to failure readable.
_SMALLEST, _LARGEST = -4, 7


def number(value: Any, digits: int = 4) -> str:
    """Return a number with so many significant digits, and anything else as its text.

    Four show a change of a thousandth, which no estimate from tens of specimens reaches.
    """
    if value is None:
        return NOTHING
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if not isinstance(value, float | np.floating):
        return str(value)
    x = float(value)
    if math.isnan(x):
        return NOTHING
    if math.isinf(x):
        return "∞" if x > 0 else "-∞"
    if x == 0:
        return "0"
    magnitude = math.floor(math.log10(abs(x)))
    if not _SMALLEST <= magnitude < _LARGEST:
        return f"{x:.{digits - 1}e}"
    if x == round(x) and magnitude >= digits - 1:
        return f"{x:.0f}"
    return f"{x:.{max(0, digits - 1 - magnitude)}f}"


def places(sd: float, digits: int = 3) -> int | None:
    """Return the number of decimals that show so many significant digits of a spread.

    None where fixed decimals do not suit.
    """
    if not (math.isfinite(sd) and sd > 0):
        return None
    # Rounded first: 0.0996 with two digits is 0.10, which needs two decimals and not three.
    magnitude = math.floor(math.log10(float(f"{sd:.{digits - 1}e}")))
    # A spread may be a hundred times smaller than its value, and is still written out.
    if not _SMALLEST - 2 <= magnitude < _LARGEST:
        return None
    return max(0, digits - 1 - magnitude)


def alike(values: Iterable[float], sd: float, digits: int = 3) -> list[str]:
    """Return numbers of one unit with the decimals that their spread warrants."""
    decimals = places(sd, digits)
    texts = []
    for value in map(float, values):
        if decimals is None or not math.isfinite(value) or abs(value) >= 10**_LARGEST:
            texts.append(number(value))
        else:
            texts.append(f"{value + 0.0:.{decimals}f}")  # the sum turns -0.0 into 0.0
    return texts


def plus_minus(value: float, sd: float) -> str:
    """Return an estimate with its spread, such as '1.145 ± 0.046'."""
    if math.isnan(sd):
        return number(float(value))
    return " ± ".join(alike((value, sd), sd, 2))


def sample_sd(finite: Any) -> float:
    """Return the standard deviation of finite values, NaN of fewer than two."""
    return float(finite.std(ddof=1)) if finite.size > 1 else math.nan


def percentage(share: float) -> str:
    """Return a share of one, such as '5%'."""
    return f"{100 * share:g}%"


def probability(p: float) -> str:
    """Return a p-value after its sign, such as '= 0.18' or '< 0.001'.

    A null distribution of 9999 replicates does not give the first digit of smaller ones.
    """
    return f"= {p:.2g}" if p >= 0.001 else "< 0.001"


def span(values: Any, form: str) -> str:
    """Return the least and the largest of several numbers, or one where their texts are equal."""
    low = f"{values.min():{form}}"
    high = f"{values.max():{form}}"
    return low if low == high else f"{low} to {high}"


def shown(seconds: float) -> str:
    """Return seconds, to a tenth below ten."""
    return f"{seconds:.0f}" if seconds >= 9.95 else f"{seconds:.1f}"


def counted(n: int, noun: str) -> str:
    """Return a number with a noun."""
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"


def enumerated(items: list[str]) -> str:
    """Return items with commas and 'and'."""
    *first, last = items
    return f"{', '.join(first)} and {last}" if first else last


def described(y: Any) -> dict[str, Any]:
    """Return counts, range, mean and spread of one output: NaN was not measured, +inf failed."""
    measured = y[~np.isnan(y)]
    finite = measured[np.isfinite(measured)]
    failed = measured.size - finite.size
    missing = y.size - measured.size
    sd = sample_sd(finite)
    moments = [math.nan] * 3
    if finite.size:
        moments = [float(finite.min()), float(finite.max()), float(finite.mean())]
    low, high, mean, spread = alike((*moments, sd), sd)
    return {
        "N": measured.size,
        "failed": str(failed) if failed else "",
        "missing": str(missing) if missing else "",
        "smallest": low,
        "largest": high,
        "mean": mean,
        "sd": spread,
    }


def with_zeros(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return rows with a zero for no failures and no missing values, if another row has some."""
    for key in ("failed", "missing"):
        if any(row[key] for row in rows):
            rows = [row | {key: row[key] or "0"} for row in rows]
    return rows
