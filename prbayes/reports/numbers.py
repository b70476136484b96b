"""How numbers are written in a report."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np

NOTHING = "\u2013"  # an en dash, as printed tables have it where there is no number

# Numbers from 0.0001 up to ten million are written out, others with an exponent: the same lower end
# as Python's own "g"; the upper one keeps loads in newtons and cycles to failure readable.
_SMALLEST_WRITTEN_OUT, _LARGEST_WRITTEN_OUT = -4, 7

# The smallest p-value that is told: of smaller ones a null distribution of 9999 replicates knows
# not even the first digit.
_SMALLEST_PROBABILITY = 0.001


def number(value: Any, digits: int = 4) -> str:
    """Return a number with so many significant digits, and anything else as its text.

    Four show a change of a thousandth, which no estimate from tens of specimens reaches.
    """
    if value is None:
        return NOTHING
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, float | np.floating):
        return _real(float(value), digits)
    return str(value)


def _real(x: float, digits: int) -> str:
    if math.isnan(x):
        return NOTHING
    if math.isinf(x):
        return "∞" if x > 0 else "-∞"
    if x == 0:
        return "0"
    magnitude = math.floor(math.log10(abs(x)))
    if not _SMALLEST_WRITTEN_OUT <= magnitude < _LARGEST_WRITTEN_OUT:
        return f"{x:.{digits - 1}e}"
    if x == round(x) and magnitude >= digits - 1:
        return f"{x:.0f}"
    decimals = max(0, digits - 1 - magnitude)
    return f"{x:.{decimals}f}"


def places(sd: float, digits: int = 3) -> int | None:
    """Return how many decimals show so many significant digits of a spread.

    None where fixed decimals do not suit.
    """
    if not (math.isfinite(sd) and sd > 0):
        return None
    # Rounded first: 0.0996 with two digits is 0.10, which needs two decimals and not three.
    rounded = float(f"{sd:.{digits - 1}e}")
    magnitude = math.floor(math.log10(rounded))
    # A spread may be a hundred times smaller than its value, and is still written out.
    if not _SMALLEST_WRITTEN_OUT - 2 <= magnitude < _LARGEST_WRITTEN_OUT:
        return None
    return max(0, digits - 1 - magnitude)


def alike(values: Iterable[float], sd: float, digits: int = 3) -> list[str]:
    """Return numbers of one unit with the decimals that their spread warrants."""
    decimals = places(sd, digits)
    return [_with_decimals(float(value), decimals) for value in values]


def _with_decimals(value: float, decimals: int | None) -> str:
    too_large = abs(value) >= 10**_LARGEST_WRITTEN_OUT
    if decimals is None or not math.isfinite(value) or too_large:
        return number(value)
    return f"{value + 0.0:.{decimals}f}"  # the sum turns -0.0 into 0.0


def plus_minus(value: float, sd: float) -> str:
    """Return an estimate with its spread, such as '1.145 ± 0.046'."""
    if math.isnan(sd):
        return number(float(value))
    return " ± ".join(alike((value, sd), sd, 2))


def percentage(share: float) -> str:
    """Return a share of one, such as '5%'."""
    return f"{100 * share:g}%"


def probability(p: float) -> str:
    """Return a p-value after its sign, such as '= 0.18' or '< 0.001'."""
    return f"= {p:.2g}" if p >= _SMALLEST_PROBABILITY else f"< {_SMALLEST_PROBABILITY:g}"


def span(values: Any, form: str) -> str:
    """Return the least and the largest of several numbers, or one of them where they look alike."""
    low = f"{values.min():{form}}"
    high = f"{values.max():{form}}"
    return low if low == high else f"{low} to {high}"


def shown(seconds: float) -> str:
    """Return seconds, to a tenth below ten."""
    rounds_to_ten = seconds >= 9.95
    return f"{seconds:.0f}" if rounds_to_ten else f"{seconds:.1f}"


def counted(n: int, what: str) -> str:
    """Return a number with a noun."""
    return f"{n} {what}" if n == 1 else f"{n} {what}s"
