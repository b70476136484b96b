"""The u-values of a validity test against their envelope."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from prbayes._display import p_digits, percentage
from prbayes._validate import Arrays, Bools, Floats
from prbayes.plots.canvas import (
    BLUE,
    PALE,
    VERMILION,
    check_options,
    fill,
    finish,
    ink,
    panels,
)
from prbayes.plots.curves import staircase, with_gaps
from prbayes.plots.products import plot_tests
from prbayes.results.products import is_fleet
from prbayes.validation.area_test import ValidityTest
from prbayes.validation.fleet import tests_of_products
from prbayes.validation.pit import DIRECTION

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def plot_validity(
    tests: ValidityTest | Mapping[str, ValidityTest] | xr.DataTree,
    **pc_kwargs: Any,
) -> Figure:
    """Draw the ECDF of the u-values against the identity, the area between them, the verdict.

    The shaded area is the statistic. The title has the critical value and the verdict; the band
    contains the whole ECDF with probability 1 - alpha if the null is true, calibration uncertainty
    included. Several outputs have a thin line for each direction, dotted ones of ``|2u - 1|``,
    without a band: the statistic is the mean of their areas.

    Parameters
    ----------
    tests : ValidityTest or mapping, or xarray.DataTree
        From `area_test`; several by name, one panel each. Of a fleet from `calibrate_each` each
        product has a row with its u-values, the smallest p-value on top.
    **pc_kwargs
        ``figsize=(8, 5)`` in inches, ``col_wrap`` panels in a row, and ``figure_kwargs`` for
        ``matplotlib.pyplot.figure``.

    Returns
    -------
    matplotlib.figure.Figure
        With a panel for each test, whose label is its name, or ``u`` of a single one.

    Raises
    ------
    TypeError
        If a test is no `ValidityTest`.

    Examples
    --------
    >>> import numpy as np, prbayes as prb
    >>> rng = np.random.default_rng(1)
    >>> predicted = rng.normal(rng.normal(0, 0.2, (200, 1)), 1.0, (200, 500))
    >>> test = prb.area_test(rng.normal(0, 1, 20), predicted)
    >>> prb.plots.plot_validity(test).axes[0].get_xlabel()
    'u-value'
    """
    check_options(None, pc_kwargs)
    if isinstance(tests, xr.DataTree):
        of_products = _tests_in(tests)
        if is_fleet(tests):
            return plot_tests(of_products, pc_kwargs)
        tests = of_products
    by_name: dict[str, Any] = dict(tests) if isinstance(tests, Mapping) else {"": tests}
    if not by_name or not all(isinstance(test, ValidityTest) for test in by_name.values()):
        kinds = {type(test).__name__ for test in by_name.values()}
        got = ", ".join(sorted(kinds)) or "nothing"
        raise TypeError(
            f"plot_validity: got {got}, expected a ValidityTest from prb.area_test, or several by "
            "name"
        )
    # The panel of a single test needs a name as its label.
    names = [name or "u" for name in by_name]
    figure, axes = panels(names, size=(4.6, 4.8), pc_kwargs=pc_kwargs)
    for (name, test), axis in zip(by_name.items(), axes.values(), strict=True):
        color = VERMILION if test.rejected else BLUE
        directions = in_directions(test)
        if directions:
            # All conditions with a single output make one more line.
            single = test.u_values[~_is_of_direction(test)]
            lines = [single, *directions] if single.size else directions
            thin: dict[str, Any] = {"color": color, "linewidth": 0.8}
            if not test.folded:
                axis.plot(*_ecdf(lines), **thin, gid="ecdf")
            folded = _ecdf([np.abs(2 * u - 1) for u in (lines if test.folded else directions)])
            axis.plot(*folded, "-" if test.folded else ":", **thin, gid="folded")
            x = "u-value; dotted: |2u - 1|"
            y = f"share of values in each of {len(directions)} directions"
            statistic = "mean area"
        else:
            values = np.abs(2 * test.u_values - 1) if test.folded else test.u_values
            ecdf = _ecdf([values])
            fill(axis, *_envelope(test), color=PALE, alpha=0.4, gid="envelope")
            fill(axis, *_between(*ecdf), color=color, alpha=0.4, gid="area")
            axis.plot(*ecdf, color=color, gid="ecdf")
            x = "u-value"
            y = f"share of {values.size} values"
            statistic = "area"
        axis.plot([0, 1], [0, 1], "--", color=ink(), gid="identity")
        level = f", level {percentage(test.alpha)}"
        p = f"p = {test.p_value:.{p_digits(test.p_value, test.alpha)}g}"
        first = f"{name}, {p}" if name else f"{p}{level}"
        sign, verdict = (">", "rejected") if test.rejected else ("<", "not rejected")
        second = f"{statistic} {test.statistic:.3f} {sign} critical {test.critical_value:.3f}"
        title = f"{first}\n{second}: {verdict}"
        axis.set(xlabel="|2u - 1|" if test.folded else x, ylabel=y, title=title)
    return finish(figure)


def _tests_in(fleet: xr.DataTree) -> dict[str, ValidityTest]:
    """Return the tests of the products of a fleet, or raise if there is none."""
    tests = tests_of_products(fleet)
    if not tests:
        raise ValueError(
            "plot_validity: got a result without validity tests, expected a fleet of "
            "prb.calibrate_each(..., validation=...)"
        )
    return tests


def in_directions(test: ValidityTest) -> list[Floats]:
    """Return the u-values of several outputs by direction; none if all conditions have one."""
    numbers = np.array([name.rpartition(DIRECTION)[2] for name in test.conditions.tolist()])
    mask = _is_of_direction(test)
    return [
        test.u_values[mask & (numbers == number)]
        for number in dict.fromkeys(numbers[mask].tolist())
    ]


def _is_of_direction(test: ValidityTest) -> Bools:
    """Return which u-values are of several outputs, in a direction."""
    return np.array([DIRECTION in name for name in test.conditions.tolist()], dtype=bool)


def _ecdf(samples: Arrays) -> Floats:
    """Return the corners of ECDFs on [0, 1], with a gap between any two."""
    curves = []
    for values in samples:
        weights = np.full(values.shape, 1 / values.size)
        curves.append(np.column_stack(staircase(values, weights, 0.0, 1.0)))
    return with_gaps(curves)


def _between(x: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
    """Return places, and the lower and upper side of the area between an ECDF and the identity."""
    # A step that crosses the identity gets a corner there, so that the sides of the area meet.
    crosses = (x[:-1] < y[:-1]) & (x[1:] > y[:-1])
    at = np.flatnonzero(crosses)
    height = y[at]
    x = np.insert(x, at + 1, height)
    y = np.insert(y, at + 1, height)
    return x, np.minimum(x, y), np.maximum(x, y)


def _envelope(test: ValidityTest) -> tuple[Floats, Floats, Floats]:
    """Return places and sides of the envelope; the smallest values make the highest ECDF."""
    smallest, largest = test.envelope
    places = np.unique(np.concatenate([[0.0], smallest, largest, [1.0]]))

    def at_corners(values: Floats) -> Floats:
        """Return the ECDF of sorted values just below and at each place, one after the other."""
        below = np.searchsorted(values, places, side="left")
        at = np.searchsorted(values, places, side="right")
        return np.column_stack([below, at]).ravel() / values.size

    return np.repeat(places, 2), at_corners(largest), at_corners(smallest)
