"""The u-values of a validity test against their envelope."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prbayes._validate import Floats
from prbayes.plots._canvas import (
    BLUE,
    DASHED,
    DOTTED,
    INK,
    PALE,
    SOLID,
    VERMILION,
    Canvas,
    Panel,
    refuse_look,
)
from prbayes.plots._curves import steps
from prbayes.validation.area_test import ValidityTest
from prbayes.validation.conditions import DIRECTION


def plot_validity(
    tests: ValidityTest | Mapping[str, ValidityTest],
    *,
    backend: str | None = None,
    **pc_kwargs: Any,
) -> Any:
    """Draw the ECDF of the u-values against the identity, the area between them, the verdict.

    The shaded area is the statistic. The title has the critical value and the verdict; the band
    holds the whole ECDF with probability 1 - alpha if the null is true, calibration uncertainty
    included.

    Of several outputs there is a thin line for each direction in which they are seen, dotted ones
    of ``|2u - 1|``, without a band: the statistic is the mean of their areas, and the title has it.

    Parameters
    ----------
    tests : ValidityTest or mapping
        From `area_test`; several by name, one panel each.
    backend : {"matplotlib", "bokeh", "plotly"}, optional
        That of ArviZ's settings by default.
    **pc_kwargs
        ``figsize=(8, 5)``, in inches, of the whole picture; others go to
        ``arviz.PlotCollection.wrap``, such as ``col_wrap``.

    Returns
    -------
    arviz.PlotCollection
        With ``savefig``; its ``viz`` has the artists ``area``, ``envelope``, ``identity`` and
        ``ecdf``; of several outputs ``identity``, ``ecdf`` and ``folded``.

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
    >>> prb.plot_validity(test, backend="none").viz["ecdf"].name
    'ecdf'
    """
    refuse_look(None, backend, pc_kwargs)
    by_name = _by_name(tests)
    # The panel of a test alone has a name nevertheless
    panels = [name or "u" for name in by_name]
    canvas = Canvas(panels, size=(4.6, 4.8), backend=backend, pc_kwargs=pc_kwargs)
    for name, test in by_name.items():
        panel = canvas.panel(name or "u")
        if in_directions(test):
            _draw_directions(panel, test, _title(name, test))
        else:
            _draw(panel, test, _title(name, test))
    return canvas.finish()


def _by_name(tests: ValidityTest | Mapping[str, ValidityTest]) -> dict[str, ValidityTest]:
    """Return tests by name, a single one without."""
    by_name = dict(tests) if isinstance(tests, Mapping) else {"": tests}
    others = [test for test in by_name.values() if not isinstance(test, ValidityTest)]
    if others or not by_name:
        kinds = {type(test).__name__ for test in by_name.values()}
        got = ", ".join(sorted(kinds)) or "nothing"
        raise TypeError(
            f"plot_validity: got {got}, expected a ValidityTest from prb.area_test, or several by "
            "name"
        )
    return by_name


def _draw(panel: Panel, test: ValidityTest, title: str) -> None:
    """Draw the ECDF of a test's values, and its distance from the identity."""
    values = test.u_values
    name = "u-value"
    if test.folded:
        values = np.abs(2 * values - 1)
        name = "|2u - 1|"
    color = VERMILION if test.rejected else BLUE
    at, sides = _envelope(test)
    panel.band("envelope", at, sides, PALE, alpha=0.4)
    x, y = _ecdf(np.sort(values))
    at, sides = _between(x, y)
    panel.band("area", at, sides, color, alpha=0.4)
    diagonal = np.array([0.0, 1.0])
    panel.line("identity", diagonal, diagonal, INK, style=DASHED, width=None)
    panel.line("ecdf", x, y, color, width=None)
    panel.axes(x=name, y=f"share of {values.size} values", title=title)


def in_directions(test: ValidityTest) -> list[Floats]:
    """Return the u-values of several outputs by direction; none if all conditions have one."""
    numbers = np.array([name.rpartition(DIRECTION)[2] for name in test.conditions.tolist()])
    seen = _is_seen(test)
    known = dict.fromkeys(numbers[seen].tolist())
    return [test.u_values[seen & (numbers == number)] for number in known]


def _is_seen(test: ValidityTest) -> NDArray[np.bool_]:
    """Return which u-values are of several outputs, in a direction."""
    return np.array([DIRECTION in name for name in test.conditions.tolist()], dtype=bool)


def _draw_directions(panel: Panel, test: ValidityTest, title: str) -> None:
    """Draw a line for each direction in which outputs are seen."""
    directions = in_directions(test)
    # Conditions of one output are held against the identity by themselves
    others = test.u_values[~_is_seen(test)]
    alone = [others] if others.size else []
    color = VERMILION if test.rejected else BLUE
    diagonal = np.array([0.0, 1.0])
    panel.line("identity", diagonal, diagonal, INK, style=DASHED, width=None)
    name = "|2u - 1|"
    if not test.folded:
        name = "u-value; dotted: |2u - 1|"
        x, y = _several([*alone, *directions])
        panel.line("ecdf", x, y, color, width=0.8)
    both = [*alone, *directions] if test.folded else directions
    x, y = _several([np.abs(2 * u - 1) for u in both])
    style = SOLID if test.folded else DOTTED
    panel.line("folded", x, y, color, style=style, width=0.8)
    panel.axes(x=name, y=f"share of values in each of {len(directions)} directions", title=title)


def _several(directions: list[Floats]) -> tuple[Floats, Floats]:
    """Return the corners of several ECDFs, with a gap between any two."""
    gap = np.array([np.nan])
    xs, ys = [], []
    for values in directions:
        x, y = _ecdf(np.sort(values))
        xs += [x, gap]
        ys += [y, gap]
    return np.concatenate(xs[:-1]), np.concatenate(ys[:-1])


def _title(name: str, test: ValidityTest) -> str:
    if name:
        first = f"{name}, p = {test.p_value:.2g}"
    else:
        first = f"p = {test.p_value:.2g}, level {test.alpha:.0%}"
    sign, verdict = "<", "not rejected"
    if test.rejected:
        sign, verdict = ">", "rejected"
    what = "mean area" if in_directions(test) else "area"
    area = f"{what} {test.statistic:.3f}"
    critical = f"critical {test.critical_value:.3f}"
    return f"{first}\n{area} {sign} {critical}: {verdict}"


def _ecdf(values: Floats) -> tuple[Floats, Floats]:
    """Return the corners of the ECDF of sorted values on [0, 1]."""
    counts = np.arange(values.size + 1)
    return steps(values, counts / values.size, 0.0, 1.0)


def _between(x: Floats, y: Floats) -> tuple[Floats, tuple[Floats, Floats]]:
    """Return places, and the lower and upper side of the area between an ECDF and the identity."""
    # Where a step crosses the identity there is a corner too: between two corners of one height
    before = x[:-1] < y[:-1]
    after = x[1:] > y[:-1]
    at = np.flatnonzero(before & after)
    height = y[at]
    x = np.insert(x, at + 1, height)
    y = np.insert(y, at + 1, height)
    return x, (np.minimum(x, y), np.maximum(x, y))


def _envelope(test: ValidityTest) -> tuple[Floats, tuple[Floats, Floats]]:
    """Return places, and the lower and upper side of the envelope, with the corners of both.

    The envelope is of sorted values, of which the smallest make the highest ECDF.
    """
    smallest, largest = test.envelope
    corners = np.concatenate([[0.0], smallest, largest, [1.0]])
    places = np.unique(corners)
    low = _at_corners(largest, places)
    high = _at_corners(smallest, places)
    return np.repeat(places, 2), (low, high)


def _at_corners(values: Floats, places: Floats) -> Floats:
    """Return the ECDF of sorted values just below and at each place, one after the other."""
    below = np.searchsorted(values, places, side="left")
    at = np.searchsorted(values, places, side="right")
    counts = np.column_stack([below, at])
    return counts.ravel() / values.size
