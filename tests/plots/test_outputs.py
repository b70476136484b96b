"""Pairs of outputs: measured specimens, and regions of the calibrated population."""

from types import SimpleNamespace
from typing import Any

import figure_reader as read
import numpy as np
import pymc as pm
import pytest
import xarray as xr
from one_input import posterior_of
from scipy import stats

import prbayes as prb
from prbayes.model.emulated import EmulatedResponse
from prbayes.plots.outputs import _shown_outputs
from prbayes.response.outputs import Outputs


def test_regions_are_the_ellipses_of_a_normal_population(pair: SimpleNamespace) -> None:
    for share, visual in ((0.5, "after_50"), (0.89, "after_89")):
        x, y = read.xy(pair.drawn(), visual, "second, first")
        points = np.column_stack([x, y])[np.isfinite(x)] - pair.mean
        squares = np.einsum("ij,jk,ik->i", points, np.linalg.inv(pair.covariance), points)
        expected = -2 * np.log(1 - share)
        assert squares.mean() == pytest.approx(expected, rel=0.06)
        np.testing.assert_allclose(squares, expected, rtol=0.35)


def test_specimens_with_both_outputs_names_units_and_correlations(pair: SimpleNamespace) -> None:
    pc = pair.drawn()
    points = read.xy(pc, "measured", "second, first")
    is_complete = np.isfinite(pair.observed).all(axis=1)
    np.testing.assert_allclose(points.T, pair.observed[is_complete])
    axis = read.panel(pc, "second, first")
    assert (axis.get_xlabel(), axis.get_ylabel()) == ("first (Hz)", "second (Hz)")
    r = stats.spearmanr(pair.observed[is_complete]).statistic
    # Of normal values 6 / pi arcsin(.8 / 2) = .786
    assert axis.get_title().startswith(f"rank correlation\nmeasured {r:.2f}, calibrated 0.7")
    assert read.texts(pc) == [
        "before: prior's initial point",
        "calibrated: posterior predictive, 50% and 89%",
        "measured",
    ]
    count = pair.calls()
    figure = prb.plots.plot_outputs(
        pair.posterior, model=pair.model, before=False, labels={"first": "F"}
    )
    assert read.panel(figure, "second, first").get_xlabel() == "F"
    assert not read.panels(figure, "before_50")
    assert pair.calls() == count


@pytest.fixture(scope="module")
def several() -> SimpleNamespace:
    """Five outputs of a simulator that draws anew, a curve, and one output."""
    rng = np.random.default_rng(2)
    turn = rng.standard_normal((3, 5))

    def five(a: Any, b: Any, c: Any) -> Any:
        return np.stack([a, b, c], axis=-1) @ turn

    def curve(a: Any, b: Any, c: Any) -> Any:
        return a[..., None] + np.arange(12) * b[..., None] + c[..., None]

    names = {"name": ["p", "q", "r/s", "t", "u"]}
    data = xr.DataArray(five(*rng.normal(size=(3, 20))), dims=("i", "name"), coords=names)
    hours = {"hour": np.arange(12) / 2}
    lines = xr.DataArray(curve(*rng.normal(size=(3, 20))), dims=("i", "hour"), coords=hours)
    area = prb.AreaMetric()
    how: dict[str, Any] = {"metric": prb.Joint(area, components=2)}
    how["propagation"] = prb.Resimulated(64)
    with pm.Model() as model:
        m = pm.Normal("m", 0, 1)
        inputs = [pm.Normal.dist(m, 1.0), pm.Normal.dist(0.0, 1.0), pm.Normal.dist(0.0, 1.0)]
        prb.Simulator("one", np.positive, inputs[0], metric=area, observed=data.values[:, 0])
        prb.Simulator("five", five, *inputs, observed=data, **how)
        prb.Simulator("curve", curve, *inputs, observed=lines, **how)
    return SimpleNamespace(model=model, posterior=posterior_of(m=rng.normal(0, 0.2, (2, 20))))


def test_by_default_an_output_that_does_not_vary_is_left_out() -> None:
    data = np.column_stack([np.full(5, 0.1), np.arange(5.0), np.arange(5.0) ** 2])
    outputs = Outputs(("none", "one", "two"))
    node: Any = SimpleNamespace(name="y", outputs=outputs, observed=data, weights=np.full(5, 0.2))
    node.inputs = SimpleNamespace(groups=None)
    evaluator: Any = SimpleNamespace(simulators=[node])
    k, shown = _shown_outputs(evaluator, None, None, None)
    assert k == 0
    assert [output.name for output in shown] == ["y[one]", "y[two]"]


def pairs(figure: Any) -> list[str]:
    """Return the pairs that are drawn."""
    return [axis.get_label() for axis in figure.axes]


@pytest.mark.long
def test_pairs_are_a_triangle(several: SimpleNamespace) -> None:
    how: dict[str, Any] = {"model": several.model, "before": False, "n_draws": 4}
    pc = prb.plots.plot_outputs(several.posterior, coords={"name": ["p", "r/s", "u"]}, **how)
    assert pairs(pc) == ["r/s, p", "u, p", "u, r/s"]
    first, below, last = pc.axes
    assert first.get_xlabel() == last.get_ylabel() == ""
    assert (below.get_xlabel(), below.get_ylabel()) == ("five: p", "five: u")
    every = prb.plots.plot_outputs(several.posterior, **how)
    assert len(pairs(every)) == 10


def test_of_a_curve_some_places_are_drawn(several: SimpleNamespace) -> None:
    how: dict[str, Any] = {"model": several.model, "before": False, "n_draws": 4}
    pc = prb.plots.plot_outputs(several.posterior, var_names="curve", **how)
    assert pairs(pc)[-1] == "5.5, 3.5"
    assert len(pairs(pc)) == 6
    chosen = prb.plots.plot_outputs(several.posterior, coords={"hour": [0.5, 5.0]}, **how)
    assert pairs(chosen) == ["5, 0.5"]


@pytest.mark.parametrize(
    ("arguments", "error", "match"),
    [
        ({"var_names": "one"}, KeyError, r"got \['one'\], expected some of \['five\[p\]'"),
        ({"var_names": ["five", "curve"]}, ValueError, r"several simulators, five\[p\] and curve"),
        ({"coords": {"name": "p"}}, ValueError, "got 1 outputs, expected two to 7"),
        ({"coords": {"name": ["p", "z"]}}, KeyError, r"name: got \['p', 'z'\], expected some of"),
    ],
)
def test_what_is_not_there_is_refused(
    several: SimpleNamespace, arguments: dict[str, Any], error: type[Exception], match: str
) -> None:
    with pytest.raises(error, match=match):
        prb.plots.plot_outputs(several.posterior, model=several.model, **arguments)


def test_a_model_of_single_outputs_is_refused(optimum: prb.Optimum) -> None:
    match = r"got simulators \['y'\] of one .* prb.plots.plot_responses"
    with pytest.raises(ValueError, match=match):
        prb.plots.plot_outputs(optimum)


@pytest.mark.long
def test_pictures_of_one_posterior_emulate_its_populations_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    data = np.random.default_rng(4).normal(size=(20, 2))
    with pm.Model() as model:
        a = pm.Normal.dist(pm.Normal("mu", 0, 1), 1.0)
        b = pm.Normal.dist(pm.Normal("nu", 0, 1), 1.0)
        prb.Simulator("y", lambda a, b: np.stack([a, a + b], axis=-1), a, b, observed=data)
    means = np.linspace(-0.2, 0.2, 40)[None]
    posterior = posterior_of(mu=means, nu=-means)
    sizes = []
    emulated = EmulatedResponse.__call__

    def counted(self: EmulatedResponse, inputs: Any) -> Any:
        sizes.append(len(inputs[0]))
        return emulated(self, inputs)

    monkeypatch.setattr(EmulatedResponse, "__call__", counted)
    options: dict[str, Any] = {"model": model, "before": False}
    first = prb.plots.plot_outputs(posterior, **options)
    prb.plots.plot_responses(posterior, **options)
    again = prb.plots.plot_outputs(posterior, **options)
    assert sizes == [40 * 1024]
    name = first.axes[0].get_label()
    lines = [read.xy(figure, "after_50", name) for figure in (first, again)]
    np.testing.assert_array_equal(*lines)
    prb.plots.plot_outputs(posterior.isel(draw=slice(20)), **options)
    assert sizes == [40 * 1024, 20 * 1024]
