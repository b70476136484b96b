"""The u-values of a validity test against their envelope."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from prbayes._checks import Floats
from prbayes.plots._canvas import BLUE, DASHED, INK, PALE, VERMILION, Canvas, Panel, refuse_look
from prbayes.plots._curves import steps
from prbayes.validation.validity import ValidityTest


def plot_validity(
    tests: ValidityTest | Mapping[str, ValidityTest],
    *,
    backend: str | None = None,
    **pc_kwargs: Any,
) -> Any:
    """Draw the ECDF of the u-values against the identity, the area between them, the verdict.

    The shaded area is the statistic. The title has the critical value and the verdict; the band
    holds the whole ECDF with probability 1 - level if the null is true, calibration uncertainty
    included.

    Parameters
    ----------
    tests : ValidityTest or mapping
        From `area_test`; several by name, one panel each.
    backend : {"matplotlib", "bokeh", "plotly"}, optional
        That of ArviZ's settings by default.
    **pc_kwargs
        For ``arviz.PlotCollection.wrap``, such as ``figure_kwargs`` or ``col_wrap``.

    Returns
    -------
    arviz.PlotCollection
        With ``savefig``; its ``viz`` has the artists ``area``, ``envelope``, ``identity`` and
        ``ecdf``.

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
    refuse_look(None, backend)
    by_name = _by_name(tests)
    # The panel of a test alone has a name nevertheless
    panels = [name or "u" for name in by_name]
    canvas = Canvas(panels, size=(4.6, 4.8), backend=backend, pc_kwargs=pc_kwargs)
    for name, test in by_name.items():
        panel = canvas.panel(name or "u")
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
    values, name = test.u_values, "u-value"
    if test.folded:
        values, name = np.abs(2 * values - 1), "|2u - 1|"
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


def _title(name: str, test: ValidityTest) -> str:
    if name:
        first = f"{name}, p = {test.p_value:.2g}"
    else:
        first = f"p = {test.p_value:.2g}, level {test.level:.0%}"
    sign, verdict = "<", "not rejected"
    if test.rejected:
        sign, verdict = ">", "rejected"
    area = f"area {test.statistic:.3f}"
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
