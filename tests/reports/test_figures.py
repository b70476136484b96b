"""Pictures of a report, and what is said where there is none."""

import importlib
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import arviz as az
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pymc as pm
import pytest
import xarray as xr

import prbayes as prb
from prbayes.reports import figures
from prbayes.reports.material import gather


def drawn_by(monkeypatch: pytest.MonkeyPatch, functions: dict[str, Any]) -> None:
    """Put other functions in the place of some pictures, by name."""
    table = figures.ILLUSTRATIONS
    new = tuple(replace(i, function=functions.get(i.function.__name__, i.function)) for i in table)
    monkeypatch.setattr(figures, "ILLUSTRATIONS", new)


def test_pictures_close_their_figures_and_leave_settings_alone(calibrated: Any) -> None:
    own = plt.figure()
    before, settings = plt.get_fignums(), dict(mpl.rcParams)
    backend = az.rcParams["plot.backend"]
    prb.Report("x", validity=calibrated[3])
    assert plt.get_fignums() == before
    assert dict(mpl.rcParams) == settings
    assert az.rcParams["plot.backend"] == backend
    plt.close(own)


@pytest.mark.parametrize("error", [ValueError, TypeError, NotImplementedError])
def test_a_picture_that_fails_leaves_a_sentence(
    error: type[Exception], monkeypatch: pytest.MonkeyPatch, calibrated: Any
) -> None:
    def fails(*_: Any, **__: Any) -> None:
        plt.figure()
        raise error("three hyperparameters")

    drawn_by(monkeypatch, {"plot_validity": fails})
    before = plt.get_fignums()
    made = prb.Report("x", validity=calibrated.test)
    assert made.sections[-1].text == ("This picture could not be made: three hyperparameters",)
    assert made.sections[-1].picture is None
    assert plt.get_fignums() == before


def test_a_mistake_in_a_request_is_no_sentence(
    monkeypatch: pytest.MonkeyPatch, calibrated: Any
) -> None:
    """Only drawing may fail quietly; what a report asks for is its own affair."""

    def wrong(_: Any) -> Any:
        raise NotImplementedError

    table = figures.ILLUSTRATIONS
    new = tuple(replace(i, request=wrong) for i in table if i.after == "Validity")
    monkeypatch.setattr(figures, "ILLUSTRATIONS", new)
    with pytest.raises(NotImplementedError):
        prb.Report("x", validity=calibrated.test)


def test_each_illustration_gets_what_it_needs(
    monkeypatch: pytest.MonkeyPatch, calibrated: Any
) -> None:
    """On results in memory and on files."""
    model, optimum, posterior, test = calibrated
    called: dict[str, tuple[Any, ...]] = {}

    class Picture:
        def savefig(self, path: Path, **_: Any) -> None:
            path.write_bytes(b"<svg/>")

    def drawn(name: str) -> Any:
        def made(*arguments: Any, **keywords: Any) -> Picture:
            called[name] = (*arguments, *keywords.values())
            return Picture()

        return made

    names = {i.function.__name__ for i in figures.ILLUSTRATIONS}
    drawn_by(monkeypatch, {name: drawn(name) for name in names})
    full = prb.Report("x", model=model, optimum=optimum, posterior=posterior, validity=test)
    assert set(called) == names - {
        "plot_outputs",
        "plot_sensitivity",
        "plot_prediction",
    }  # for several outputs; for a decision; for data of a test
    assert called["plot_responses"] == called["plot_population"] == (posterior, model)
    assert called["plot_posterior"] == (posterior, optimum, model)
    assert called["plot_optimizer"] == (optimum, 2)
    assert called["plot_landscape"] == (optimum, model)
    assert called["plot_validity"] == (test,)
    titles = [s.title for s in full.sections]
    for illustration in figures.ILLUSTRATIONS:
        if illustration.function.__name__ not in called:
            continue
        before = full.sections[: titles.index(illustration.title)]
        chapters = [s.title for s in before if s.level == 2]
        assert chapters[-1] == illustration.after
    called.clear()
    alone = prb.Report("x", posterior=posterior, optimum=optimum.to_datatree())
    assert set(called) == {"plot_posterior", "plot_stages", "plot_comparison"}
    assert "Graph" not in [s.title for s in alone.sections]
    called.clear()
    prb.Report("x", validity={"early": test, "late": test})
    assert called == {"plot_validity": ({"early": test, "late": test},)}


def test_a_report_computes_no_response(monkeypatch: pytest.MonkeyPatch, section: Any) -> None:
    drawn_by(monkeypatch, {"plot_responses": lambda *_, **__: pytest.fail("drawn")})
    calls = 0

    def response(x: Any) -> Any:
        nonlocal calls
        calls += np.size(x)
        return 2 * x

    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
        once = prb.Resimulated(64)
        prb.Simulator(
            "y", response, x, metric=prb.AreaMetric(), observed=[0.0, 2.0, 4.0], propagation=once
        )
    optimum = prb.minimize(model)
    before, counted = calls, optimum.evaluator.n_responses
    made = prb.Report("x", model=model, optimum=optimum)
    assert (calls, optimum.evaluator.n_responses) == (before, counted)
    assert "Graph" not in [s.title for s in made.sections]
    text = section(made, "Measured and calibrated responses").text
    assert text == (
        "This picture could not be made: it would recompute responses; "
        "call prb.plot_responses for it",
    )


@pytest.mark.parametrize(
    ("lacking", "words"),
    [("package", "no Python package graphviz"), ("program", "no program dot")],
)
def test_without_graphviz_there_is_no_graph(
    lacking: str,
    words: str,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    tmp_path: Path,
    calibrated: Any,
) -> None:
    """A reader of the report is not told what the writer's machine lacks; the log says it."""
    if lacking == "package":
        monkeypatch.setitem(sys.modules, "graphviz", None)
    else:
        monkeypatch.setenv("PATH", str(tmp_path))
    with caplog.at_level("INFO", "prbayes"):
        made = prb.Report("x", model=calibrated.model)
    assert "Graph" not in [section.title for section in made.sections]
    assert words in caplog.text
    assert words not in made._html()


def test_a_name_that_graphviz_does_not_take(
    monkeypatch: pytest.MonkeyPatch, calibrated: Any
) -> None:
    def fails(_: Any) -> bytes:
        raise subprocess.CalledProcessError(1, "dot")

    monkeypatch.setattr(figures, "_svg", fails)
    made = prb.Report("x", model=calibrated.model)
    assert "Graph" not in [section.title for section in made.sections]


def needs_dot() -> None:
    if shutil.which("dot") is None:
        pytest.skip("the program dot of Graphviz is not installed")


def test_the_graph_shows_the_variables(report: prb.Report, section: Any) -> None:
    needs_dot()
    drawn = section(report, "Graph").picture
    for name in ("mu", "sigma", "y", "Simulator"):
        assert f">{name}</text>".encode() in drawn


def test_the_graph_is_the_same_in_every_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """PyMC collects names in sets, whose order is another one in every process."""
    graphs = importlib.import_module("pymc.model_graph")
    sources = []

    class Drawn:
        graph_attr: dict[str, str]
        node_attr: dict[str, str]

        def __init__(self, _: str, plates: Any, edges: Any, **__: Any) -> None:
            names = [[v.var.name for v in plate.variables] for plate in plates]
            sources.append((names, list(edges)))
            self.graph_attr, self.node_attr = {}, {}

        def pipe(self, **_: Any) -> bytes:
            return b"<svg/>"

    with pm.Model() as model:
        roots = [pm.Normal(name, 0, 1) for name in ("z", "b", "y", "a")]
        x = pm.Normal.dist(roots[0] + roots[1] + roots[2] + roots[3], 1.0)
        prb.Simulator("s", np.positive, x, metric=prb.AreaMetric(), observed=[0.0, 2.0, 4.0])
    monkeypatch.setattr(graphs, "make_graph", Drawn)
    get_plates, edges = graphs.ModelGraph.get_plates, graphs.ModelGraph.edges

    def turned_plates(self: Any) -> Any:
        plates = get_plates(self)[::-1]
        for plate in plates:
            plate.variables.reverse()
        return plates

    figures._svg(model)
    monkeypatch.setattr(graphs.ModelGraph, "get_plates", turned_plates)
    monkeypatch.setattr(graphs.ModelGraph, "edges", lambda self: edges(self)[::-1])
    figures._svg(model)
    assert sources[0] == sources[1]
    assert sources[0][0] == [["z", "b", "y", "a"], ["s"]]


def test_pairs_of_outputs_are_drawn_where_responses_are_stored(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """And else one sentence says that they are not, for all pictures of responses."""
    asked = []

    class Picture:
        def savefig(self, path: Path, **_: Any) -> None:
            path.write_bytes(b"<svg/>")

    def draw(*arguments: Any, **_: Any) -> Any:
        asked.append(arguments)
        return Picture()

    drawn_by(monkeypatch, {"plot_outputs": draw, "plot_responses": draw})
    data = np.random.default_rng(1).normal(size=(10, 2))
    draws = xr.Dataset({"mu": (("chain", "draw"), np.zeros((2, 20)))})
    posterior = xr.DataTree.from_dict({"posterior": draws})
    for propagation, count in ((prb.Reweighted(256), 2), (prb.Resimulated(64), 0)):
        with pm.Model() as model:
            a = pm.Normal.dist(pm.Normal("mu", 0, 1), 1.0)
            b = pm.Normal.dist(0.0, 1.0)
            prb.Simulator(
                "y",
                lambda a, b: np.stack([a, b], axis=-1),
                *(a, b),
                metric=prb.Joint(prb.AreaMetric()),
                observed=data,
                propagation=propagation,
            )
        asked.clear()
        material = gather(model, None, posterior, None, None)
        made = figures.illustrate((prb.reports.Section("Data"),), material)
        assert len(asked) == count
        assert [section.title for section in made[1:]] == (
            ["Measured and calibrated responses", "Pairs of outputs"][: max(count, 1)]
        )


def test_labels_reach_the_pictures_that_know_the_names(
    monkeypatch: pytest.MonkeyPatch, calibrated: Any
) -> None:
    model, optimum, posterior, test = calibrated
    given: dict[str, Any] = {}

    class Picture:
        def savefig(self, path: Path, **_: Any) -> None:
            path.write_bytes(b"<svg/>")

    def drawn(name: str) -> Any:
        def made(*_: Any, labels: Any = None, **__: Any) -> Picture:
            given[name] = labels
            return Picture()

        return made

    names = {i.function.__name__ for i in figures.ILLUSTRATIONS}
    drawn_by(monkeypatch, {name: drawn(name) for name in names})
    x = pm.Normal.dist(model["mu"], model["sigma"])
    later = prb.predict(posterior, np.positive, x, model=model, n_draws=20)
    warm = np.array([1.0, 2.0, 2.5])
    test = prb.area_test(warm, later, null=prb.validation.PosteriorNull(199))
    labels = {"mu": "mean", "y": "stiffness (N/mm)", "hot": "at 200 °C"}
    of_model = {"mu": "mean", "y": "stiffness (N/mm)"}
    prb.Report(
        "x",
        model=model,
        optimum=optimum,
        posterior=posterior,
        validity=test,
        validation={"hot": (warm, later)},
        labels=labels,
    )
    assert given["plot_responses"] == given["plot_landscape"] == of_model
    assert given["plot_comparison"] == {"mu": "mean"}
    assert given["plot_prediction"] == {"hot": "at 200 °C"}
    with pytest.raises(KeyError, match="labels: got 'nu'"):
        prb.Report("x", model=model, optimum=optimum, labels={"nu": "typing error"})
