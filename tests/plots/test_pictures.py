"""Pictures: what is drawn is what it should be, on every backend."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import arviz as az
import matplotlib.pyplot as plt
import numpy as np
import pymc as pm
import pytest
import xarray as xr
from matplotlib.image import imread
from scipy import stats

import prbayes as prb
from prbayes.plots._canvas import named
from prbayes.propagation.base import Propagation

RNG = np.random.default_rng(4)
MU, SIGMA = RNG.normal(1.0, 0.1, (2, 150)), RNG.normal(0.5, 0.03, (2, 150))
OBSERVED = 1 + 0.5 * stats.norm.ppf((np.arange(30) + 0.5) / 30)
BACKENDS = ("matplotlib", "plotly", "bokeh")


@pytest.fixture(autouse=True)
def _close() -> Iterator[None]:
    yield
    plt.close("all")


def build(propagation: Propagation, response: Any = np.positive) -> pm.Model:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 2))
        prb.Simulator("y", response, x, metric=prb.AreaMetric(), observed=OBSERVED, propagation=propagation)
    return model


@cache
def optimum() -> prb.Optimum:
    return prb.minimize(build(prb.Reweighted(1024)))


@cache
def posterior() -> xr.DataTree:
    """Draws that are known, with statistics of stages."""
    stages = {"beta": [[1e-3, 0.1, 1.0], [2e-3, 1.0, np.nan]], "accept_rate": [[0.2, 0.3, 0.4], [0.5, 0.6, np.nan]]}
    data = {name: (("chain", "stage"), np.array(rows)) for name, rows in stages.items()}
    data["log_marginal_likelihood"] = (("chain", "stage"), np.array([[np.nan, np.nan, -3.0], [np.nan, -4.0, np.nan]]))
    return xr.DataTree.from_dict(
        {
            "posterior": xr.Dataset(
                {"mu": (("chain", "draw"), MU), "sigma": (("chain", "draw"), SIGMA)},
                coords={"chain": [0, 1], "draw": np.arange(150)},
            ),
            "sample_stats": xr.Dataset(data, coords={"chain": [0, 1]}),
        }
    )


@cache
def comparison() -> xr.Dataset:
    return prb.compare({"optimum": optimum(), "draws": posterior()}, model=optimum().model)


PICTURES: dict[str, Callable[..., Any]] = {
    "responses": lambda **k: prb.plot_responses(posterior(), model=optimum().model, **k),
    "ecdf": lambda **k: prb.plot_responses(optimum(), ecdf=True, **k),
    "population": lambda **k: prb.plot_population(posterior(), model=optimum().model, **k),
    "posterior": lambda **k: prb.plot_posterior(posterior(), optimum(), model=optimum().model, **k),
    "optimizer": lambda **k: prb.plot_optimizer(optimum(), **k),
    "landscape": lambda **k: prb.plot_landscape(optimum(), points=21, **k),
    "curve": lambda **k: prb.plot_landscape(optimum(), pair="sigma", points=21, **k),
    "stages": lambda **k: prb.plot_stages(posterior(), **k),
    "comparison": lambda **k: prb.plot_comparison(comparison(), **k),
    "scores": lambda **k: prb.plot_comparison(comparison(), scores=True, **k),
}


def artist(pc: Any, visual: str, panel: str) -> Any:
    return pc.viz[visual][panel].item()


def xy(pc: Any, visual: str, panel: str) -> np.ndarray[Any, Any]:
    """The places of a line or of markers, shape (2, n), on any backend."""
    drawn = artist(pc, visual, panel)
    if pc.backend == "plotly":
        return np.array([drawn.x, drawn.y], dtype=float)
    if pc.backend == "bokeh":
        return np.array([drawn.data_source.data[k] for k in ("x", "y")], dtype=float)
    return np.array(drawn.get_offsets().T if hasattr(drawn, "get_offsets") else drawn.get_data(), dtype=float)


def sides(pc: Any, visual: str, panel: str, at: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """The two sides of a band, shape (2, n)."""
    corners = np.asarray(artist(pc, visual, panel).get_paths()[0].vertices)
    return np.array([[y[np.isclose(x, a, atol=1e-9)].min() for a in at] for x, y in [corners.T]] +
                    [[y[np.isclose(x, a, atol=1e-9)].max() for a in at] for x, y in [corners.T]])  # fmt: skip


def texts(pc: Any) -> list[str]:
    return [text.get_text() for text in pc.viz["figure"].item().legends[0].get_texts()]


# -- responses -------------------------------------------------------------------------------------------


def test_responses_are_the_closed_forms() -> None:
    pc = prb.plot_responses(posterior(), model=optimum().model, draws=300, backend="matplotlib")
    x, y = xy(pc, "after", "y")
    h = 0.9 * 0.5 * 700**-0.2  # about Silverman's for the weights' effective number
    each = stats.norm.pdf(x, MU.reshape(-1, 1), np.hypot(SIGMA.reshape(-1, 1), h))
    np.testing.assert_allclose(y, each.mean(axis=0), atol=0.025)
    some = x[20:-20:10]
    low, high = sides(pc, "band", "y", some)
    expected = np.quantile(each, [0.055, 0.945], axis=0)[:, 20:-20:10]
    np.testing.assert_allclose([low, high], expected, atol=0.04)
    assert (high - low).max() > 0.15
    truth = stats.norm.pdf(some, 1, 0.5)
    assert ((low - 0.02 <= truth) & (truth <= high + 0.02)).all()
    narrow = prb.plot_responses(posterior(), model=optimum().model, draws=300, level=0.5, backend="matplotlib")
    inner = sides(narrow, "band", "y", some)
    assert np.ptp(inner, axis=0).max() < 0.6 * (high - low).max()
    x, y = xy(pc, "before", "y")
    at_start = np.exp(optimum().evaluator.initial[1])
    np.testing.assert_allclose(y, stats.norm.pdf(x, 0, at_start), atol=0.02)
    np.testing.assert_allclose(xy(pc, "rug", "y"), [OBSERVED, np.zeros(30)])
    np.testing.assert_allclose(np.trapezoid(*xy(pc, "measured", "y")[::-1]), 1)


def test_the_legend_says_what_is_before_and_after() -> None:
    assert texts(PICTURES["responses"](backend="matplotlib")) == [
        "measured",
        "before: prior's initial point",
        "89% band of the posterior",
        "calibrated: posterior predictive",
    ]
    pc = PICTURES["ecdf"](backend="matplotlib", level=0.5)
    assert texts(pc)[2:] == ["50% band of the standard error", "calibrated: optimum"]
    before, after = (artist(pc, name, "y") for name in ("before", "after"))
    assert before.get_linestyle() != after.get_linestyle()
    axis = pc.viz["plot"]["y"].item()
    assert (axis.get_xlabel(), axis.get_ylabel(), axis.get_title()) == ("y", "share of specimens", "30 measured values")


def test_distribution_functions_of_an_optimum() -> None:
    pc = PICTURES["ecdf"](backend="matplotlib", before={"mu": 3.0, "sigma": 1.0})
    mu, sigma = optimum().point["mu"], optimum().point["sigma"]
    for name, mean, sd in (("after", mu, sigma), ("before", 3.0, 1.0)):
        x, y = xy(pc, name, "y")
        np.testing.assert_allclose(y, stats.norm.cdf(x, mean, sd), atol=0.01)
    assert "before: as given" in texts(pc)
    x, y = xy(pc, "measured", "y")
    np.testing.assert_allclose(np.interp([0.99, 1.01], x, y), [0.5, 0.5], atol=0.04)
    at = xy(pc, "after", "y")[0][60:200:20]
    low, high = sides(pc, "band", "y", at)
    error = 1.5982 * np.hypot(0.5 / np.sqrt(30), (at - 1) * 0.5 / np.sqrt(60) / 0.5) * stats.norm.pdf(at, 1, 0.5)
    np.testing.assert_allclose((high - low) / 2, error, atol=0.03)


def test_without_a_sampling_distribution_there_is_no_band_and_before_can_be_left_out() -> None:
    alone = replace(optimum(), covariance=np.full((2, 2), np.nan))
    pc = prb.plot_responses(alone, before=False, backend="matplotlib")
    assert not {"band", "before"} & set(pc.viz.children)
    assert "band" not in prb.plot_population(alone, backend="matplotlib").viz


def test_stored_responses_cost_nothing_and_others_as_little_as_said() -> None:
    before = optimum().n_responses, optimum().evaluator.n_responses
    for name in ("responses", "ecdf", "population", "landscape", "optimizer"):
        PICTURES[name](backend="none")
    assert (optimum().n_responses, optimum().evaluator.n_responses) == before
    for propagation, cost in ((prb.Resimulated(64), 41 * 64), (prb.Fresh(50), 41 * 50)):
        seen: list[int] = []

        def counted(x: Any, seen: list[int] = seen) -> Any:
            seen.append(np.size(x))
            return np.asarray(x)

        model = build(propagation, counted)
        seen.clear()
        pc = prb.plot_responses(posterior(), model=model, backend="none")
        assert "after" in pc.viz
        assert sum(seen) <= cost + 300  # a few more where a response is tried first
        seen.clear()
        prb.plot_population(posterior(), model=model, backend="none")
        assert sum(seen) <= 300


def test_what_the_stored_responses_do_not_reach(caplog: pytest.LogCaptureFixture) -> None:
    pc = prb.plot_responses(optimum(), before={"mu": 50.0, "sigma": 0.1}, backend="none")
    assert "before" not in pc.viz
    assert "stored responses do not reach there" in caplog.text
    far = posterior().copy(deep=True)
    far["posterior"]["mu"] = far["posterior"]["mu"] + 50
    with pytest.raises(prb.DesignError, match="support 0 of 200 populations of the posterior"):
        prb.plot_responses(far, model=optimum().model, backend="none")


def test_a_narrow_peak_before_does_not_flatten_the_data() -> None:
    pc = prb.plot_responses(optimum(), before={"mu": 1.0, "sigma": 0.05}, backend="matplotlib")
    low, high = pc.viz["plot"]["y"].item().get_ylim()
    assert high < 3
    assert low < 0
    assert xy(pc, "before", "y")[1].max() > high


# -- population ------------------------------------------------------------------------------------------


def test_the_population_is_the_closed_form() -> None:
    pc = prb.plot_population(posterior(), model=optimum().model, draws=300, level=0.8, backend="matplotlib")
    x, y = xy(pc, "after", "x")
    each = stats.norm.pdf(x, MU.reshape(-1, 1), SIGMA.reshape(-1, 1))
    np.testing.assert_allclose(y, each.mean(axis=0), atol=1e-9)
    some = slice(10, 240, 15)
    expected = np.quantile(each, [0.1, 0.9], axis=0)[:, some]
    np.testing.assert_allclose(sides(pc, "band", "x", x[some]), expected, atol=1e-6)
    x, y = xy(prb.plot_population(optimum(), backend="matplotlib"), "after", "x")
    np.testing.assert_allclose(y, stats.norm.pdf(x, optimum().point["mu"], optimum().point["sigma"]), atol=1e-9)
    with pytest.raises(KeyError, match="got z, expected some of"):
        prb.plot_population(optimum(), inputs=["z"])


# -- posterior -------------------------------------------------------------------------------------------


def test_the_posterior_stands_against_the_optimum() -> None:
    pc = prb.plot_posterior(posterior(), optimum(), model=optimum().model, level=0.8, backend="matplotlib")
    for name, draws in (("mu", MU), ("sigma", SIGMA)):
        x, y = xy(pc, "posterior", name)
        expected = stats.norm.pdf(x, draws.mean(), draws.std())
        np.testing.assert_allclose(y, expected, atol=0.25 * expected.max())
        assert np.trapezoid(y, x) == pytest.approx(1, abs=0.02)
        np.testing.assert_allclose(xy(pc, "interval", name)[0], np.quantile(draws, [0.1, 0.9]))
        np.testing.assert_allclose(xy(pc, "mean", name)[0], draws.mean())
        center, error = optimum().point[name], optimum().stderr[name]
        np.testing.assert_allclose(xy(pc, "optimum", name)[0], center)
        np.testing.assert_allclose(xy(pc, "stderr", name)[0], center + error * np.array([-1.2816, 1.2816]), rtol=1e-4)
        x, y = xy(pc, "normal", name)
        np.testing.assert_allclose(y, stats.norm.pdf(x, center, error))
        assert (xy(pc, "interval", name)[1] < 0).all()
        assert min(pc.viz["plot"][name].item().get_yticks()) == 0
    x, y = xy(pc, "prior", "sigma")
    np.testing.assert_allclose(y, stats.halfnorm.pdf(x, scale=2), atol=0.06)


def test_a_posterior_alone() -> None:
    pc = prb.plot_posterior(posterior(), backend="matplotlib")
    assert not {"optimum", "normal", "prior"} & set(pc.viz.children)
    blind = replace(optimum(), stderr={"mu": np.inf, "sigma": np.nan})
    pc = prb.plot_posterior(posterior(), blind, backend="matplotlib")
    assert "optimum" in pc.viz
    assert "normal" not in pc.viz


# -- optimiser -------------------------------------------------------------------------------------------


def test_the_trace_is_in_the_users_units() -> None:
    pc = PICTURES["optimizer"](backend="matplotlib")
    trace = optimum().trace
    np.testing.assert_allclose(xy(pc, "asked", "mu"), [trace["evaluations"], trace["theta"][:, 0]])
    np.testing.assert_allclose(xy(pc, "path", "sigma"), [trace["evaluations"], np.exp(trace["theta"][:, 1])])
    np.testing.assert_allclose(xy(pc, "optimum", "sigma")[1], optimum().point["sigma"])
    _, y = xy(pc, "best", "discrepancy")
    logarithmic = pc.viz["plot"]["discrepancy"].item().get_yticklabels()[0].get_text() not in ("", "0")
    y = 10**y if y.min() < 0 and logarithmic else y
    assert y[-1] == pytest.approx(optimum().discrepancy, rel=1e-6)
    assert (np.diff(y) <= 0).all()


def test_the_objective_of_a_trace_is_that_of_the_final_scales() -> None:
    with pm.Model():
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 2))
        for name, factor in (("y", 1.0), ("z", 3.0)):
            prb.Simulator(name, lambda x, f: f * x, x, factor, metric=prb.AreaMetric(), observed=factor * OBSERVED)
        found = prb.minimize()
    _, y = xy(prb.plot_optimizer(found, backend="matplotlib"), "best", "discrepancy")
    assert min(y[-1], 10 ** y[-1], key=lambda v: abs(v - found.discrepancy)) == pytest.approx(found.discrepancy)


def test_the_landscape_is_not_turned_over() -> None:
    pc = prb.plot_landscape(optimum(), points=31, backend="matplotlib")
    trace, point = optimum().trace["theta"], optimum().point
    np.testing.assert_allclose(xy(pc, "path", "landscape"), [trace[:, 0], np.exp(trace[:, 1])])
    np.testing.assert_allclose(xy(pc, "optimum", "landscape")[:, 0], [point["mu"], point["sigma"]])
    axis = pc.viz["plot"]["landscape"].item()
    assert (axis.get_xlabel(), axis.get_ylabel()) == ("mu", "sigma")
    layers = artist(pc, "landscape", "landscape")
    evaluator = optimum().evaluator
    (x0, x1), (y0, y1) = axis.get_xlim(), axis.get_ylim()
    places = np.array(
        [[x0 + u * (x1 - x0), y0 + v * (y1 - y0)] for u in (0.1, 0.3, 0.5, 0.62) for v in (0.2, 0.45, 0.9)]
    )
    thetas = np.column_stack([places[:, 0], np.log(places[:, 1])])
    heights = evaluator(thetas).discrepancies[:, 0]
    layer = [next((i for i, p in enumerate(layers.get_paths()) if p.contains_point(xy_)), 99) for xy_ in places]
    order = np.argsort(heights)
    assert (np.diff(np.array(layer)[order]) >= 0).all()
    assert len(set(layer)) > 3


def test_a_curve_over_one_hyperparameter() -> None:
    pc = PICTURES["curve"](backend="matplotlib")
    x, y = xy(pc, "landscape", "landscape")
    thetas = np.column_stack([np.full(x.size, optimum().theta[0]), np.log(x)])
    np.testing.assert_allclose(y, optimum().evaluator(thetas).discrepancies[:, 0])
    assert pc.viz["plot"]["landscape"].item().get_title() == "mu held at the optimum"
    np.testing.assert_allclose(xy(pc, "optimum", "landscape")[0], optimum().point["sigma"])
    assert "asked" not in pc.viz


def test_other_optima_are_marked() -> None:
    with pm.Model():
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), 0.3)
        prb.Simulator("y", np.square, x, metric=prb.AreaMetric(), observed=(1 + 0.3 * QUANTILES) ** 2)
        found = prb.minimize()
    pc = prb.plot_landscape(found, backend="matplotlib")
    assert abs(xy(pc, "rivals", "landscape")[0] + xy(pc, "optimum", "landscape")[0]).min() < 0.05
    np.testing.assert_allclose(np.sort(np.abs(xy(pc, "asked", "landscape")[0]))[-1], np.abs(found.trace["theta"]).max())


QUANTILES = stats.norm.ppf((np.arange(30) + 0.5) / 30)


def test_a_landscape_that_costs_responses_says_how_many() -> None:
    model = build(prb.Resimulated(64))
    found = prb.minimize(model)
    with pytest.raises(ValueError, match=r"got responses=0, expected at least 1600: 25 points with 64 responses each"):
        prb.plot_landscape(found, points=5)
    assert "landscape" in prb.plot_landscape(found, points=5, responses=1600, backend="none").viz
    with pytest.raises(KeyError, match=r"pair: got \['mu', 'nu'\], expected one or two of \['mu', 'sigma'\]"):
        prb.plot_landscape(found, pair=["mu", "nu"])


def test_the_landscape_of_another_metric() -> None:
    with pm.Model() as other:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 2))
        prb.Simulator("y", np.positive, x, metric=prb.ProbabilityResidual(), observed=OBSERVED)
    pc = prb.plot_landscape(optimum(), model=other, pair="mu", points=9, backend="matplotlib")
    x, y = xy(pc, "landscape", "landscape")
    thetas = np.column_stack([x, np.full(x.size, optimum().theta[1])])
    np.testing.assert_allclose(y, prb.population.Evaluator(other)(thetas).discrepancies[:, 0])
    with pytest.raises(ValueError, match=r"got hyperparameters and simulators .* expected \['mu', 'sigma_log__'\]"):
        prb.plot_landscape(optimum(), model=two())


def two() -> pm.Model:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), 0.3)
        prb.Simulator("y", np.square, x, metric=prb.AreaMetric(), observed=OBSERVED)
    return model


# -- stages, comparison ----------------------------------------------------------------------------------


def test_stages_by_chain() -> None:
    pc = PICTURES["stages"](backend="matplotlib")
    np.testing.assert_allclose(xy(pc, "chain_0", "accept_rate"), [[1, 2, 3], [0.2, 0.3, 0.4]])
    np.testing.assert_allclose(xy(pc, "chain_1", "accept_rate"), [[1, 2], [0.5, 0.6]])
    np.testing.assert_allclose(xy(pc, "chain_0", "beta"), [[1, 2, 3], [-3, -1, 0]])
    ticks = pc.viz["plot"]["beta"].item()
    assert [t.get_text() for t in ticks.get_yticklabels()] == [f"{10.0**t:g}" for t in ticks.get_yticks()]
    np.testing.assert_allclose(xy(pc, "chain_1", "log_marginal_likelihood"), [[2], [-4]])
    assert texts(pc) == ["chain 0", "chain 1"]


def test_a_comparison_has_a_row_for_each_result() -> None:
    pc = PICTURES["comparison"](backend="matplotlib")
    table = comparison().sel(hyperparameter="sigma")
    for i, row in ((0, 1.0), (1, 0.0)):
        ends = [float(table[k][i]) for k in ("lower", "upper")]
        np.testing.assert_allclose(xy(pc, f"interval_{i}", "sigma"), [ends, [row, row]])
        np.testing.assert_allclose(xy(pc, "estimate", "sigma")[:, i], [float(table.estimate[i]), row])
    axis = pc.viz["plot"]["sigma"].item()
    at = dict(zip(axis.get_yticks(), [t.get_text() for t in axis.get_yticklabels()], strict=True))
    assert at == {1.0: "optimum", 0.0: "draws"}
    np.testing.assert_allclose(xy(pc, "first", "sigma")[0], optimum().point["sigma"])
    scores = PICTURES["scores"](backend="matplotlib")
    np.testing.assert_allclose(xy(scores, "score", "AreaMetric"), [comparison().AreaMetric.values, [1, 0]])


# -- all -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("picture", PICTURES)
@pytest.mark.parametrize("backend", BACKENDS[1:])
def test_every_backend_draws_the_same(picture: str, backend: str) -> None:
    ours, other = (PICTURES[picture](backend=b) for b in ("matplotlib", backend))
    assert isinstance(other, az.PlotCollection)
    compared = 0
    for visual in ours.viz.children:
        if visual in {"plot", "row_index", "col_index", "band", "landscape_lines"}:
            continue
        for panel in ours.viz[visual].data_vars:
            if hasattr(artist(ours, visual, panel), "levels"):
                continue
            np.testing.assert_allclose(xy(other, visual, panel), xy(ours, visual, panel), err_msg=visual)
            compared += 1
            if hasattr(artist(ours, visual, panel), "get_sizes") and visual != "rug":
                drawn = artist(other, visual, panel)
                size = drawn.marker.size if backend == "plotly" else drawn.glyph.size
                assert size**2 == pytest.approx(artist(ours, visual, panel).get_sizes()[0])
    assert compared
    figure = other.viz["figure"].item()
    wanted = [t.get_text() for legend in ours.viz["figure"].item().legends for t in legend.get_texts()]
    shaded = {"responses": 1, "ecdf": 1, "population": 1}.get(picture, 0)
    if backend == "plotly":
        assert [t.name for t in figure.data if t.showlegend] == wanted
        assert sum(getattr(t, "fill", None) == "tonexty" for t in figure.data) == shaded
    else:
        panels = list(figure.select({"type": import_module("bokeh.models").Plot}))
        assert {i.label.value for p in panels for legend in p.legend for i in legend.items} == set(wanted)
        glyphs = [type(getattr(r, "glyph", None)).__name__ for p in panels for r in p.renderers]
        assert glyphs.count("VArea") == shaded


def test_heights_are_the_same_way_round_elsewhere() -> None:
    found = artist(PICTURES["landscape"](backend="plotly"), "landscape", "landscape")
    row, column = np.unravel_index(np.nanargmin(found.z), found.z.shape)
    step = np.diff(found.x)[0], np.diff(found.y)[0]
    point = optimum().point
    np.testing.assert_allclose([found.x[column], found.y[row]], [point["mu"], point["sigma"]], atol=max(step))
    theta = np.array([[found.x[3], np.log(found.y[15])], [found.x[15], np.log(found.y[3])]])
    high, low = optimum().evaluator(theta).discrepancies[:, 0]
    assert (found.z[15, 3] > found.z[3, 15]) == (high > low)


@pytest.mark.parametrize("picture", PICTURES)
def test_every_picture_comes_out(picture: str, tmp_path: Path) -> None:
    PICTURES[picture](backend="matplotlib").savefig(tmp_path / "picture.png", dpi=60)
    image = imread(tmp_path / "picture.png")[..., :3]
    assert min(image.shape[:2]) > 100
    assert (image.min(axis=2) < 0.9).mean() > 0.01


@pytest.mark.parametrize("picture", PICTURES)
def test_labels_reach_the_axes(picture: str) -> None:
    labels = {"mu": "MEAN", "y": "RESPONSE", "x": "INPUT", "accept_rate": "RATE", "AreaMetric": "AREA", "sigma": "SD"}
    pc = PICTURES[picture](backend="matplotlib", labels=labels)
    found = {text for a in pc.viz["figure"].item().axes for text in (a.get_xlabel(), a.get_ylabel())}
    assert found & set(labels.values())
    assert not found & (set(labels) - {"x", "y"})


def test_elements_take_the_label_of_their_variable() -> None:
    labels = {"mu": "mean", "mu[1]": "second mean"}
    assert [named(n, labels) for n in ("mu[0]", "mu[1]", "nu", "nu[0]")] == ["mean[0]", "second mean", "nu", "nu[0]"]


def test_settings_of_the_collection_are_passed_on() -> None:
    pc = prb.plot_posterior(posterior(), backend="matplotlib", col_wrap=1, figure_kwargs={"figsize": (3, 7)})
    assert tuple(pc.viz["figure"].item().get_size_inches()) == (3, 7)
    assert pc.viz["row_index"]["sigma"].item() == 1


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: prb.plot_responses(3, model=optimum().model), "got int, expected an Optimum"),  # type: ignore[arg-type]
        (lambda: prb.plot_population(3, model=optimum().model), "got int, expected an Optimum"),  # type: ignore[arg-type]
        (lambda: prb.plot_posterior(optimum()), "got Optimum, expected a DataTree"),  # type: ignore[arg-type]
        (lambda: prb.plot_posterior(posterior(), 3), "optimum: got int, expected an Optimum"),  # type: ignore[arg-type]
        (lambda: prb.plot_optimizer(posterior()), "got DataTree, expected an Optimum"),  # type: ignore[arg-type]
        (lambda: prb.plot_landscape(posterior()), "got DataTree, expected an Optimum"),  # type: ignore[arg-type]
        (lambda: prb.plot_stages(optimum()), "got Optimum, expected the DataTree"),  # type: ignore[arg-type]
        (lambda: prb.plot_comparison(posterior()), "got DataTree, expected the Dataset"),  # type: ignore[arg-type]
    ],
)
def test_wrong_kinds_are_refused(call: Callable[[], Any], message: str) -> None:
    with pytest.raises(TypeError, match=message):
        call()


def test_wrong_values_are_refused() -> None:
    for plot in (
        lambda: prb.plot_responses(optimum(), level=1.5),
        lambda: prb.plot_population(optimum(), level=1.0),
        lambda: prb.plot_posterior(posterior(), level=2.0),
    ):
        with pytest.raises(ValueError, match="level: got"):
            plot()
    with pytest.raises(ValueError, match="got an optimum without a trace"):
        prb.plot_optimizer(replace(optimum(), trace={}))
    with pytest.raises(ValueError, match="got no scores"):
        prb.plot_comparison(prb.compare({"draws": posterior()}), scores=True)
