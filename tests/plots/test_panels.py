"""Which outputs have a panel, and what a reader calls them."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pymc as pm
import pytest
import xarray as xr

import prbayes as prb
from prbayes.plots._panels import Output, is_curve, panels_of
from prbayes.response.outputs import ONE, Outputs


def node(outputs: Outputs, name: str = "y") -> Any:
    return SimpleNamespace(name=name, outputs=outputs)


@pytest.mark.parametrize(
    ("outputs", "expected"),
    [
        (ONE, False),
        (Outputs((0, 1, 2)), False),  # columns of an array
        (Outputs((0, 1, 2), "hour"), True),
        (Outputs((0.5, 2.0, 3.0), "hour"), True),
        (Outputs((0.5, 2.0), "hour"), False),
        (Outputs(("a", "b", "c")), False),
        (Outputs((1.0, 1.0, 2.0), "hour"), False),
    ],
)
def test_a_curve_has_different_numbers_as_labels(outputs: Outputs, expected: bool) -> None:
    assert is_curve(outputs) == expected


def test_each_output_has_a_panel_but_a_curve_or_many_have_one() -> None:
    nodes = [
        node(ONE),
        node(Outputs(("a", "b")), "z"),
        node(Outputs((0.0, 1.0, 2.0), "hour"), "curve"),
        node(Outputs(tuple(range(9))), "many"),
    ]
    names = [[output.name for output in panels] for panels in panels_of(nodes)]
    assert names == [["y"], ["z[a]", "z[b]"], ["curve"], ["many"]]


@pytest.mark.parametrize(
    ("outputs", "alone", "labels", "expected"),
    [
        (Outputs(("a", "b"), units=("mm", "Hz")), True, None, "b (Hz)"),
        (Outputs(("a", "b"), units=("mm", "Hz")), False, None, "y: b (Hz)"),
        (Outputs(("a", "b")), True, {"y": "frame"}, "frame: b"),
        (Outputs(("a", "b")), True, {"b": "B"}, "B"),
        (Outputs(("a", "b")), False, {"b": "B", "y[b]": "own"}, "own"),
        (Outputs((0, 1)), True, None, "output 1"),
        (Outputs((0.5, 1.5, 2.5), "hour", units=("mm",) * 3), True, None, "y at hour 1.5 (mm)"),
    ],
)
def test_the_text_of_an_output(
    outputs: Outputs, alone: bool, labels: dict[str, str] | None, expected: str
) -> None:
    assert Output(node(outputs), 1, alone).text(labels) == expected


def test_what_was_not_measured_is_left_out() -> None:
    observed = np.array([[1.0, np.nan], [2.0, 5.0], [3.0, np.inf]])
    weights = np.array([0.5, 0.3, 0.2])
    y = SimpleNamespace(name="y", outputs=Outputs(("a", "b")), observed=observed, weights=weights)
    values, weights = Output(y, 1, True).measured()
    np.testing.assert_array_equal(values, [5.0, np.inf])
    np.testing.assert_allclose(weights, [0.6, 0.4])


@pytest.mark.long
def test_groups_have_the_same_axis() -> None:
    sizes = np.repeat(["a", "b"], 10)
    values = np.append(np.linspace(0, 1, 10), np.linspace(7, 9, 10))
    measured = xr.DataArray(values, coords={"kind": ("specimen", sizes)}, dims="specimen")
    with pm.Model(coords={"kind": ["a", "b"]}) as model:
        mu = pm.Normal("mu", 4, 4, dims="kind")
        x = pm.Normal.dist(mu[prb.response.group("kind")], 0.5, name="x")
        y: dict[str, Any] = {"metric": prb.AreaMetric(), "observed": measured}
        prb.Simulator("y", lambda x: x + 0.0, x, **y)
        z = pm.Normal.dist(100 * pm.Normal("nu", 1, 1), 1, name="z")
        prb.Simulator("far", lambda z: z, z, metric=prb.AreaMetric(), observed=[99.0, 101])
    optimum = prb.minimize(model)
    for plot in (prb.plot_responses, prb.plot_population):
        pc = plot(optimum, backend="matplotlib")
        ends = [panel.item().get_xlim() for panel in pc.viz["plot"].data_vars.values()]
        first, second, other = ends
        assert first == second
        assert first[0] < 1
        assert first[1] > 8
        assert other[0] > 50
