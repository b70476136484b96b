"""Outputs in panels of their own, or as lines in one panel; their names."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pymc as pm
import pytest
import xarray as xr
from scipy import stats

import prbayes as prb
from prbayes.plots._panels import LEVELS, Output, is_curve, panels_of, quantiles
from prbayes.response.outputs import SINGLE_OUTPUT, Outputs


def node(outputs: Outputs, name: str = "y") -> Any:
    return SimpleNamespace(name=name, outputs=outputs)


@pytest.mark.parametrize(
    ("outputs", "expected"),
    [
        (SINGLE_OUTPUT, False),
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
        node(SINGLE_OUTPUT),
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
        pc = plot(optimum)
        ends = [panel.item().get_xlim() for panel in pc.viz["plot"].data_vars.values()]
        first, second, other = ends
        assert first == second
        assert first[0] < 1
        assert first[1] > 8
        assert other[0] > 50


HOURS = np.array([3.0, 0.0, 1.0, 2.0])


def test_quantiles_are_those_of_each_population() -> None:
    rng = np.random.default_rng(1)
    values = rng.normal([0.0, 5.0], [1.0, 2.0], (4000, 2))
    weights = np.exp(0.5 * values[:, 0])
    weights = np.stack([np.full(4000, 1 / 4000), weights / weights.sum()])
    stored = quantiles(np.broadcast_to(values, (2, 4000, 2)), weights, LEVELS)
    np.testing.assert_array_equal(stored, quantiles(np.stack([values, values]), weights, LEVELS))
    np.testing.assert_allclose(stored[0, :, 1], stats.norm.ppf(LEVELS, 5, 2), atol=0.2)
    np.testing.assert_allclose(stored[1, :, 0], stats.norm.ppf(LEVELS, 0.5, 1), atol=0.15)


def test_failures_are_above_all_and_points_without_a_response_count_nowhere() -> None:
    values = np.array([[[1.0], [np.nan], [np.inf], [2.0]]])
    found = quantiles(values, np.full((1, 4), 0.25), np.array([0.4, 0.7]))
    np.testing.assert_array_equal(found[0, :, 0], [2.0, np.inf])


def curve(a: Any) -> Any:
    """Return growing lines, of specimens that fail above 13."""
    y = (1 + HOURS) ** a[..., None]
    return np.where(y > 13, np.inf, y)


@pytest.fixture(scope="module")
def drawn() -> SimpleNamespace:
    observed = curve(np.linspace(0.5, 2.5, 11))
    observed[0, 2] = np.nan
    data = xr.DataArray(
        observed,
        dims=("specimen", "hour"),
        coords={"hour": HOURS},
        attrs={"units": "mm"},
    )[:, [0, 2, 3]]
    with pm.Model() as model:
        mu = pm.Normal("mu", 1.5, 0.5)
        prb.Simulator(
            "wear",
            lambda a: curve(a)[..., [0, 2, 3]],
            pm.Normal.dist(mu, 0.5),
            metric=prb.Joint(prb.AreaMetric()),
            observed=data,
            propagation=prb.Resimulated(512),
        )
    draws = xr.Dataset({"mu": (("chain", "draw"), np.linspace(1.4, 1.6, 20).reshape(2, 10))})
    tree = xr.DataTree.from_dict({"posterior": draws})
    pc = prb.plot_responses(tree, model=model)
    return SimpleNamespace(pc=pc, axis=pc.viz["plot"]["wear"].item())


def test_a_curve_has_one_panel_from_left_to_right(
    drawn: SimpleNamespace, read: SimpleNamespace
) -> None:
    x, y = read.xy(drawn.pc, "after", "wear")
    np.testing.assert_array_equal(x, [1, 2, 3])
    np.testing.assert_allclose(y, np.array([2, 3, 4]) ** 1.5, rtol=0.03)
    assert (drawn.axis.get_xlabel(), drawn.axis.get_ylabel()) == ("hour", "wear (mm)")
    assert drawn.axis.get_title() == "11 measured specimens, 1 incomplete, 4 failed"


def test_measured_lines_go_over_what_is_missing_and_end_where_a_specimen_fails(
    drawn: SimpleNamespace, read: SimpleNamespace
) -> None:
    x, y = read.xy(drawn.pc, "measured", "wear")
    ends = np.flatnonzero(np.isnan(x))
    np.testing.assert_array_equal(x[: ends[0]], [2, 3])
    np.testing.assert_array_equal(x[ends[-2] + 1 : ends[-1]], [1, 2])
    np.testing.assert_allclose(y[ends[-2] + 1 : ends[-1]], [2**2.3, 3**2.3])
    assert ends.size == 10


def test_the_band_holds_most_of_the_population_and_is_cut_where_it_has_failed(
    drawn: SimpleNamespace, read: SimpleNamespace
) -> None:
    low, high = read.sides(drawn.pc, "population", "wear", np.array([1.0, 3.0]))
    assert low[0] == pytest.approx(2 ** stats.norm.ppf(LEVELS[0], 1.5, 0.5), rel=0.03)
    assert high[0] == pytest.approx(2 ** stats.norm.ppf(LEVELS[2], 1.5, 0.5), rel=0.03)
    assert np.isfinite(high[1])
    assert high[1] > drawn.axis.get_ylim()[1]
    inner = np.ptp(read.sides(drawn.pc, "band", "wear", np.array([1.0])))
    assert inner == pytest.approx(
        0.89 * (2**1.6 - 2**1.4), rel=0.1
    )  # of the medians between 1.4 and 1.6


def test_many_outputs_with_names_are_in_their_own_spread(read: SimpleNamespace) -> None:
    names = [f"gauge {i}" for i in range(9)]
    unit = 10.0 ** np.arange(9)
    rng = np.random.default_rng(1)
    data = rng.normal(size=(20, 9)) * unit
    frame = xr.DataArray(data, dims=("i", "gauge"), coords={"gauge": names})
    with pm.Model() as model:
        a, b = pm.Normal.dist(pm.Normal("mu", 0, 1), 1.0), pm.Normal.dist(0.0, 1.0)
        prb.Simulator(
            "strain",
            lambda a, b: (a[..., None] + b[..., None] * np.arange(9)) * unit,
            *(a, b),
            metric=prb.MarginalCorrelation(prb.AreaMetric()),
            observed=frame,
            propagation=prb.Resimulated(64),
        )
    draws = xr.Dataset({"mu": (("chain", "draw"), np.zeros((1, 8)))})
    tree = xr.DataTree.from_dict({"posterior": draws})
    pc = prb.plot_responses(tree, model=model, before=False)
    _, y = read.xy(pc, "measured", "strain")
    expected = (data - data.mean(axis=0)) / data.std(axis=0)
    np.testing.assert_allclose(y[np.isfinite(y)], expected.ravel())
    axis = pc.viz["plot"]["strain"].item()
    assert [tick.get_text() for tick in axis.get_xticklabels()] == names
    assert "before" not in pc.viz
