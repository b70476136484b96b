"""The u-values of a validity test against their envelope."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any

import numpy as np
import xarray as xr

from prbayes._checks import Floats
from prbayes.plots._canvas import BLUE, DASHED, INK, VERMILION, grid_settings
from prbayes.validation.validity import ValidityTest


def plot_validity(
    tests: ValidityTest | Mapping[str, ValidityTest],
    *,
    envelope: bool = True,
    backend: str | None = None,
    **pc_kwargs: Any,
) -> Any:
    """Draw the ECDF of the u-values against the identity, with the area between them and the verdict.

    The shaded area is the statistic. The title has the critical value and the verdict; the band holds the whole
    ECDF with probability 1 - level if the null is true, calibration uncertainty included.

    Parameters
    ----------
    tests : ValidityTest or mapping
        From `area_test`; several by name, one panel each.
    envelope : bool
        Whether the band is drawn.
    backend : {"matplotlib", "bokeh", "plotly"}, optional
        That of ArviZ's settings by default.
    **pc_kwargs
        For ``arviz.PlotCollection.wrap``, such as ``figure_kwargs`` or ``col_wrap``.

    Returns
    -------
    arviz.PlotCollection
        With ``savefig``; its ``viz`` has the artists ``area``, ``envelope``, ``identity`` and ``ecdf``.

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
    by_name = dict(tests) if isinstance(tests, Mapping) else {"": tests}
    if not by_name or not all(isinstance(t, ValidityTest) for t in by_name.values()):
        got = ", ".join(sorted({type(t).__name__ for t in by_name.values()})) or "nothing"
        raise TypeError(f"plot_validity: got {got}, expected a ValidityTest from prb.area_test, or several by name")
    # Heavy, and partly annotated.
    arviz: Any = import_module("arviz")
    visuals: Any = import_module("arviz_plots.visuals")
    # One variable, of a dimension of its own, for each panel: tests differ in size.
    data = xr.Dataset({name or "u": (f"{name} rank", _tested(test)) for name, test in by_name.items()})
    pc = arviz.PlotCollection.wrap(data, **grid_settings(len(by_name), (4.6, 4.8), backend, pc_kwargs))

    def draw(what: str, function: Any, keywords: Callable[[str, ValidityTest], dict[str, Any]], **same: Any) -> None:
        own = {name or "u": keywords(name, test) for name, test in by_name.items()}

        def one(da: Any, target: Any, var_name: str, sel: Any, isel: Any) -> Any:
            return function(da, target, **own[var_name], **same)

        pc.map(one, what, subset_info=True, ignore_aes="all", store_artist=function in pictures)

    pictures = (visuals.fill_between_y, visuals.line_xy)
    diagonal = np.array([0.0, 1.0])
    if envelope:
        draw("envelope", visuals.fill_between_y, lambda _, t: _band(t), color="B3", alpha=0.4)
    draw("area", visuals.fill_between_y, lambda _, t: _between(t) | {"color": _color(t)}, alpha=0.4)
    draw("identity", visuals.line_xy, lambda _, t: {"x": diagonal, "y": diagonal}, color=INK, linestyle=DASHED)
    draw("ecdf", visuals.line_xy, lambda _, t: _ecdf(t) | {"color": _color(t)})
    draw("title", visuals.labelled_title, lambda name, t: {"text": _title(name, t)})
    draw("xlabel", visuals.labelled_x, lambda _, t: {"text": "|2u - 1|" if t.folded else "u-value"})
    draw("ylabel", visuals.labelled_y, lambda _, t: {"text": f"share of {t.u_values.size} values"})
    return pc


def _tested(test: ValidityTest) -> Floats:
    return np.sort(np.abs(2 * test.u_values - 1) if test.folded else test.u_values)


def _color(test: ValidityTest) -> str:
    return VERMILION if test.rejected else BLUE


def _title(name: str, test: ValidityTest) -> str:
    sign, verdict = (">", "rejected") if test.rejected else ("<", "not rejected")
    first = f"{name}, p = {test.p_value:.2g}" if name else f"p = {test.p_value:.2g}, level {test.level:.0%}"
    return f"{first}\narea {test.statistic:.3f} {sign} critical {test.critical_value:.3f}: {verdict}"


def _corners(values: Floats) -> tuple[Floats, Floats]:
    """Return the corners of the ECDF of sorted values on [0, 1]."""
    height = np.arange(values.size + 1) / values.size
    return np.concatenate([[0.0], np.repeat(values, 2), [1.0]]), np.repeat(height, 2)


def _ecdf(test: ValidityTest) -> dict[str, Floats]:
    x, y = _corners(_tested(test))
    return {"x": x, "y": y}


def _between(test: ValidityTest) -> dict[str, Floats]:
    """Return the area between the ECDF and the identity, with the points where they cross."""
    x, y = _corners(_tested(test))
    crossing = (x[:-1] < y[:-1]) & (y[:-1] < x[1:])
    at = np.flatnonzero(crossing) + 1
    x, y = np.insert(x, at, y[at - 1]), np.insert(y, at, y[at - 1])
    return {"x": x, "y_bottom": np.minimum(x, y), "y_top": np.maximum(x, y)}


def _band(test: ValidityTest) -> dict[str, Floats]:
    """Return the ECDFs of the envelope's two sides at the corners of both."""
    low, high = test.envelope
    x = np.repeat(np.unique(np.concatenate([[0.0], low, high, [1.0]])), 2)
    bottom, top = (
        np.where(np.arange(x.size) % 2, *(np.searchsorted(v, x, side=s) for s in ("right", "left"))) / v.size
        for v in (high, low)
    )
    return {"x": x, "y_bottom": bottom, "y_top": top}
