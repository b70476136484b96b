"""Responses before and after a calibration are the closed forms, and cost what is said."""

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import figure_reader as read
import numpy as np
import pymc as pm
import pytest
import xarray as xr
from first_use import first_use
from one_input import posterior_of
from scipy import stats

import prbayes as prb
from prbayes.plots.responses import LEVELS, Output, is_curve, panels_of, quantiles
from prbayes.response.outputs import SINGLE_OUTPUT, Outputs


def test_responses_are_the_closed_forms(
    optimum: prb.Optimum, posterior: xr.DataTree, known: SimpleNamespace
) -> None:
    pc = prb.plots.plot_responses(posterior, model=optimum.model, n_draws=300)
    x, y = read.xy(pc, "after", "y")
    h = 0.9 * 0.5 * 700**-0.2  # about Silverman's for the weights' effective number
    each = stats.norm.pdf(x, known.mu.reshape(-1, 1), np.hypot(known.sigma.reshape(-1, 1), h))
    np.testing.assert_allclose(y, each.mean(axis=0), atol=0.025)
    some = x[20:-20:10]
    low, high = read.sides(pc, "band", "y", some)
    expected = np.quantile(each, [0.055, 0.945], axis=0)[:, 20:-20:10]
    np.testing.assert_allclose([low, high], expected, atol=0.04)
    assert (high - low).max() > 0.15
    truth = stats.norm.pdf(some, 1, 0.5)
    assert ((low - 0.02 <= truth) & (truth <= high + 0.02)).all()
    x, y = read.xy(pc, "before", "y")
    at_start = np.exp(optimum.evaluator.hyperparameters.initial[1])
    np.testing.assert_allclose(y, stats.norm.pdf(x, 0, at_start), atol=0.02)
    np.testing.assert_allclose(read.xy(pc, "rug", "y"), [known.observed, np.zeros(30)])
    at = x[20:-20:20]
    smooth = stats.norm.pdf(at, 1, known.observed.std() * np.hypot(1, 1.06 * 30**-0.2))
    _, top = read.sides(pc, "measured", "y", at)
    np.testing.assert_allclose(top, smooth, atol=0.03)


def test_distribution_functions_of_an_optimum(
    optimum: prb.Optimum, pictures: dict[str, Callable[..., Any]], drawn: Callable[..., Any]
) -> None:
    pc = pictures["ecdf"](before={"mu": 3.0, "sigma": 1.0})
    mu, sigma = optimum.point["mu"], optimum.point["sigma"]
    for name, mean, sd in (("after", mu, sigma), ("before", 3.0, 1.0)):
        x, y = read.xy(pc, name, "y")
        np.testing.assert_allclose(y, stats.norm.cdf(x, mean, sd), atol=0.01)
    x, y = read.xy(pc, "measured", "y")
    np.testing.assert_allclose(np.interp([0.99, 1.01], x, y), [0.5, 0.5], atol=0.04)
    x = read.xy(pc, "after", "y")[0][60:200:20]
    low, high = read.sides(pc, "band", "y", x)
    deviation = np.hypot(0.5 / np.sqrt(30), (x - 1) / np.sqrt(60))
    error = 1.5982 * deviation * stats.norm.pdf(x, 1, 0.5)
    np.testing.assert_allclose((high - low) / 2, error, atol=0.03)
    band = "89% band of the {}"
    ends = ["before: as given", band.format("standard error"), "calibrated: optimum"]
    assert read.texts(pc) == ["measured", *ends]
    ends = ["before: prior's initial point", band.format("posterior")]
    assert read.texts(drawn("responses"))[2:4] == ends
    axis = read.panel(pc, "y")
    assert axis.get_ylabel() == "share of specimens"
    assert axis.get_title() == "30 measured values"


def test_stored_responses_cost_nothing_and_others_as_little_as_said(
    optimum: prb.Optimum,
    posterior: xr.DataTree,
    build: Callable[..., pm.Model],
    pictures: dict[str, Callable[..., Any]],
) -> None:
    before = optimum.n_responses, optimum.evaluator.n_responses
    for name in ("responses", "ecdf", "population", "landscape", "optimizer"):
        pictures[name]()
    assert (optimum.n_responses, optimum.evaluator.n_responses) == before
    for propagation, cost in ((prb.Resimulated(64), 41 * 64), (prb.Fresh(50), 41 * 50)):
        seen: list[int] = []

        def counted(x: Any, seen: list[int] = seen) -> Any:
            seen.append(np.size(x))
            return np.asarray(x)

        model = build(propagation, counted)
        first_use(model)
        seen.clear()
        assert prb.plots.plot_responses(posterior, model=model).axes
        assert sum(seen) <= cost + 300  # a few more where a response is tried first
        seen.clear()
        prb.plots.plot_population(posterior, model=model)
        assert sum(seen) <= 300


def test_without_a_sampling_distribution_there_is_no_band(optimum: prb.Optimum) -> None:
    unknown = replace(optimum, covariance=np.full((2, 2), np.nan))
    pc = prb.plots.plot_responses(unknown, before={"mu": 1.0, "sigma": 0.05})
    assert not read.panels(pc, "band")
    # A narrow peak before does not flatten the data
    low, high = read.panel(pc, "y").get_ylim()
    assert low < 0 < high < 3
    assert read.xy(pc, "before", "y")[1].max() > high


def test_a_posterior_beyond_the_design_is_refused(
    optimum: prb.Optimum, posterior: xr.DataTree
) -> None:
    far = posterior.copy(deep=True)
    far["posterior"]["mu"] = far["posterior"]["mu"] + 50
    unsupported = "support 0 of 200 populations of the posterior"
    with pytest.raises(prb.propagation.DesignError, match=unsupported):
        prb.plots.plot_responses(far, model=optimum.model)


def test_each_output_has_a_panel_with_what_was_measured_of_it(pair: SimpleNamespace) -> None:
    pc = prb.plots.plot_responses(pair.posterior, model=pair.model)
    for column, mean in (("first", 2.0), ("second", 6.6)):
        x, y = read.xy(pc, "after", f"frame[{column}]")
        np.testing.assert_allclose(y, stats.norm.pdf(x, mean, 1), atol=0.025)
    axes = [read.panel(pc, f"frame[{name}]") for name in ("first", "second")]
    titles = ["25 measured values", "23 measured values, 1 failed"]
    assert [axis.get_title() for axis in axes] == titles
    assert [axis.get_xlabel() for axis in axes] == ["first (Hz)", "second (Hz)"]
    finite = np.sort(pair.observed[:, 1][np.isfinite(pair.observed[:, 1])])
    np.testing.assert_array_equal(np.sort(read.xy(pc, "rug", "frame[second]")[0]), finite)
    coords = {"frequency": "second"}
    (second,) = prb.plots.plot_responses(pair.posterior, model=pair.model, coords=coords).axes
    assert second.get_label() == "frame[second]"


# -- outputs in panels, or as lines in one panel ---------------------------------------------


def node(outputs: Outputs, name: str = "y") -> Any:
    inputs = SimpleNamespace(groups=None)
    return SimpleNamespace(name=name, outputs=outputs, inputs=inputs, group="")


def test_each_output_has_a_panel_but_a_curve_or_many_have_one() -> None:
    """A curve has three or more different numbers as labels, which a user gave."""
    hours = [(0, 1, 2), (0.5, 2.0, 3.0)]
    assert all(is_curve(Outputs(labels, "hour")) for labels in hours)
    few = [Outputs((0.5, 2.0), "hour"), Outputs((1.0, 1.0, 2.0), "hour"), Outputs(("a", "b", "c"))]
    assert not any(map(is_curve, [SINGLE_OUTPUT, Outputs((0, 1, 2)), *few]))
    nodes = [
        node(SINGLE_OUTPUT),
        node(Outputs(("a", "b")), "z"),
        node(Outputs((0.0, 1.0, 2.0), "hour"), "curve"),
        node(Outputs(tuple(range(9))), "many"),
    ]
    names = [output.name for output in panels_of(nodes)]
    assert names == ["y", "z[a]", "z[b]", "curve", "many"]
    chosen = panels_of(nodes, ["curve", "z[b]"], None, {"hour": [0.0, 2.0]})
    assert [output.name for output in chosen] == ["curve[0]", "curve[2]", "z[b]"]
    assert [output.name for output in panels_of(nodes, "^c|y", "regex")] == ["y", "curve", "many"]


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


@pytest.mark.long
def test_groups_have_the_same_axis() -> None:
    sizes = np.repeat(["a", "b"], 10)
    values = np.append(np.linspace(0, 1, 10), np.linspace(7, 9, 10))
    measured = xr.DataArray(values, coords={"kind": ("specimen", sizes)}, dims="specimen")
    with pm.Model(coords={"kind": ["a", "b"]}) as model:
        mu = pm.Normal("mu", 4, 4, dims="kind")
        x = pm.Normal.dist(mu[prb.response.group("kind")], 0.5, name="x")
        prb.Simulator("y", np.positive, x, metric=prb.AreaMetric(), observed=measured)
        z = pm.Normal.dist(100 * pm.Normal("nu", 1, 1), 1, name="z")
        prb.Simulator("far", np.positive, z, metric=prb.AreaMetric(), observed=[99.0, 101])
    optimum = prb.minimize(model, starts=0)
    for plot in (prb.plots.plot_responses, prb.plots.plot_population):
        first, second, other = [axis.get_xlim() for axis in plot(optimum).axes]
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


def test_a_curve_has_one_panel_from_left_to_right() -> None:
    observed = curve(np.linspace(0.5, 2.5, 11))[:, [0, 2, 3]]
    observed[0, 1] = np.nan
    coords = {"hour": HOURS[[0, 2, 3]]}
    data = xr.DataArray(observed, dims=("specimen", "hour"), coords=coords, attrs={"units": "mm"})
    with pm.Model() as model:
        a = pm.Normal.dist(pm.Normal("mu", 1.5, 0.5), 0.5)
        given: Any = {"metric": prb.Joint(prb.AreaMetric()), "propagation": prb.Resimulated(512)}
        response = lambda a: curve(a)[..., [0, 2, 3]]  # noqa: E731
        prb.Simulator("wear", response, a, observed=data, **given)
    draws = posterior_of(mu=np.linspace(1.4, 1.6, 20).reshape(2, 10))
    pc = prb.plots.plot_responses(draws, model=model)
    axis = read.panel(pc, "wear")
    assert (axis.get_xlabel(), axis.get_ylabel()) == ("hour", "wear (mm)")
    assert axis.get_title() == "11 measured specimens, 1 incomplete, 4 failed"
    x, y = read.xy(pc, "after", "wear")
    np.testing.assert_array_equal(x, [1, 2, 3])
    np.testing.assert_allclose(y, np.array([2, 3, 4]) ** 1.5, rtol=0.03)
    # Measured lines continue after a missing value, and end where a specimen fails
    x, y = read.xy(pc, "measured", "wear")
    ends = np.flatnonzero(np.isnan(x))
    np.testing.assert_array_equal(x[: ends[0]], [2, 3])
    last = slice(ends[-2] + 1, ends[-1])
    np.testing.assert_array_equal(x[last], [1, 2])
    np.testing.assert_allclose(y[last], [2**2.3, 3**2.3])
    assert ends.size == 10
    # The band contains most of the population, and is cut where it has failed
    low, high = read.sides(pc, "population", "wear", np.array([1.0, 3.0]))
    quantiles_of = 2 ** stats.norm.ppf(LEVELS[[0, 2]], 1.5, 0.5)
    np.testing.assert_allclose([low[0], high[0]], quantiles_of, rtol=0.03)
    assert axis.get_ylim()[1] < high[1] < np.inf
    inner = np.ptp(read.sides(pc, "band", "wear", np.array([1.0])))
    assert inner == pytest.approx(0.89 * (2**1.6 - 2**1.4), rel=0.1)  # of medians from 1.4 to 1.6


def test_many_outputs_with_names_are_in_their_own_spread() -> None:
    names = [f"gauge {i}" for i in range(9)]
    unit = 10.0 ** np.arange(9)
    data = np.random.default_rng(1).normal(size=(20, 9)) * unit
    frame = xr.DataArray(data, dims=("i", "gauge"), coords={"gauge": names})
    with pm.Model() as model:
        a, b = pm.Normal.dist(pm.Normal("mu", 0, 1), 1.0), pm.Normal.dist(0.0, 1.0)
        given: Any = {"metric": prb.Joint(prb.AreaMetric()), "observed": frame}
        response = lambda a, b: (a[..., None] + b[..., None] * np.arange(9)) * unit  # noqa: E731
        prb.Simulator("strain", response, a, b, propagation=prb.Resimulated(64), **given)
    draws = posterior_of(mu=np.zeros((1, 8)))
    pc = prb.plots.plot_responses(draws, model=model, before=False)
    _, y = read.xy(pc, "measured", "strain")
    expected = (data - data.mean(axis=0)) / data.std(axis=0)
    np.testing.assert_allclose(y[np.isfinite(y)], expected.ravel())
    axis = read.panel(pc, "strain")
    assert [tick.get_text() for tick in axis.get_xticklabels()] == names
    assert {tick.get_rotation() for tick in axis.get_xticklabels()} == {90.0}, "side by side"
    assert not read.panels(pc, "before")
