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
from one_input import one_input, posterior_of

import prbayes as prb
from prbayes.reports import figures
from prbayes.reports.material import gather

Calls = dict[str, tuple[tuple[Any, ...], dict[str, Any]]]


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> Calls:
    """Replace all pictures by a recorder of their arguments, by name."""
    recorded: Calls = {}

    class Picture:
        def savefig(self, path: Path, **_: Any) -> None:
            path.write_bytes(b"<svg/>")

    for name, illustration in figures.ILLUSTRATIONS.items():

        def draw(*arguments: Any, name: str = name, **keywords: Any) -> Picture:
            recorded[name] = arguments, keywords
            return Picture()

        monkeypatch.setitem(figures.ILLUSTRATIONS, name, replace(illustration, function=draw))
    return recorded


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

    illustration = replace(figures.ILLUSTRATIONS["validity"], function=fails)
    monkeypatch.setitem(figures.ILLUSTRATIONS, "validity", illustration)
    before = plt.get_fignums()
    last = prb.Report("x", validity=calibrated.test).sections[-1]
    assert last.title == "Pictures that could not be made"
    assert last.text == ("Distribution of the u-values: three hyperparameters.",)
    assert last.picture is None
    assert plt.get_fignums() == before


def test_each_illustration_gets_its_arguments(calls: Calls, calibrated: Any) -> None:
    """On results in memory and on files."""
    model, optimum, posterior, test = calibrated
    full = prb.Report("x", model=model, optimum=optimum, posterior=posterior, validity=test)
    # The others are for several outputs, a decision, and data of a test
    assert set(calls) == set(figures.ILLUSTRATIONS) - {"outputs", "sensitivity", "prediction"}
    common = {"model": model, "labels": {}}
    prob = {"prob": 0.89}
    ecdf = {"ecdf": True, "before": False}
    assert calls["population"] == ((posterior,), common | prob)
    assert calls["responses"] == ((posterior,), common | prob | ecdf)
    by_matplotlib = {"optimum": optimum, "backend": "matplotlib"}
    assert calls["posterior"] == ((posterior,), common | prob | by_matplotlib)
    assert calls["optimizer"] == ((optimum,), {"col_wrap": 2, "labels": {}})
    assert calls["landscape"] == ((optimum,), common)
    assert calls["validity"] == ((test,), {})
    titles = [s.title for s in full.sections]
    for name in calls:
        before = full.sections[: titles.index(figures.ILLUSTRATIONS[name].title)]
        chapter = [s.title for s in before if s.level == 2][-1]
        expected = {"responses": "Passed", "population": "Answer"}  # on page one
        assert chapter == expected.get(name, "Appendix")
    calls.clear()
    alone = prb.Report("x", posterior=posterior, optimum=optimum.to_datatree())
    assert set(calls) == {"posterior", "stages", "comparison"}
    assert "Graph" not in [s.title for s in alone.sections]
    calls.clear()
    prb.Report("x", validity={"early": test, "late": test})
    assert calls == {"validity": (({"early": test, "late": test},), {})}


@pytest.mark.parametrize("seconds", [0.01, 900.0])
def test_a_report_computes_responses_only_if_they_are_cheap(
    seconds: float, calls: Calls, section: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    count = 0

    def response(x: Any) -> Any:
        nonlocal count
        count += np.size(x)
        return 2 * x

    model = one_input([0.0, 2.0, 4.0], prb.AreaMetric(), prb.Resimulated(64), response, sd=1.0)
    optimum = prb.minimize(model)
    optimum = replace(optimum, search=replace(optimum.search, seconds=seconds))
    before = count, optimum.evaluator.n_responses
    monkeypatch.setattr("prbayes.results.diagnose.seconds_of", lambda *_: 31.0)
    made = prb.Report("x", model=model, optimum=optimum)
    assert (count, optimum.evaluator.n_responses) == before
    assert ("responses" in calls) == (seconds < 1)
    assert "Graph" not in [s.title for s in made.sections]
    if seconds > 1:
        text = section(made, "Pictures that could not be made").text
        assert text == (
            "Measured and calibrated responses: it would recompute responses; "
            "call prb.plots.plot_responses.",
        )


@pytest.mark.parametrize(
    "lacking", ["pip install graphviz", "no program dot", "does not take a name"]
)
def test_without_graphviz_there_is_no_graph(
    lacking: str,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    tmp_path: Path,
    calibrated: Any,
) -> None:
    """A reader of the report is not told what the writer's machine lacks; the log has it."""

    def fails(_: Any) -> bytes:
        raise subprocess.CalledProcessError(1, "dot")

    if lacking == "pip install graphviz":
        monkeypatch.setitem(sys.modules, "graphviz", None)
    elif lacking == "no program dot":
        monkeypatch.setenv("PATH", str(tmp_path))
    else:
        monkeypatch.setattr(figures, "_svg", fails)
    with caplog.at_level("INFO", "prbayes"):
        report = prb.Report("x", model=calibrated.model)
    assert "Graph" not in [section.title for section in report.sections]
    assert lacking in caplog.text
    assert lacking not in report._html()


@pytest.mark.skipif(shutil.which("dot") is None, reason="Graphviz is not installed")
def test_the_graph_shows_the_variables(report: prb.Report, section: Any) -> None:
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


def test_pairs_of_outputs_are_drawn_where_responses_are_stored(calls: Calls) -> None:
    """Otherwise one sentence reports that all pictures of responses are missing."""
    title = ["Pictures that could not be made"]
    data = np.random.default_rng(1).normal(size=(10, 2))
    posterior = posterior_of(mu=np.zeros((2, 20)))
    response = lambda a: np.stack([a, a**2], axis=-1)  # noqa: E731
    for propagation, count in ((prb.Reweighted(256), 2), (prb.Resimulated(64), 0)):
        metric = prb.Joint(prb.AreaMetric())
        model = one_input(data, metric, propagation, response, mu=(0, 1), sd=1.0)
        calls.clear()
        drawn = figures.pictures_of(gather(model, None, posterior))
        assert len({"responses", "outputs"} & set(calls)) == count
        assert ("outputs" in drawn, bool(drawn["front"])) == (count == 2, count == 2)
        assert [section.title for section in drawn.get("missing", [])] == title[: 1 - count // 2]


def test_labels_reach_the_pictures_with_their_names(calls: Calls, calibrated: Any) -> None:
    model, optimum, posterior, _ = calibrated
    x = pm.Normal.dist(model["mu"], model["sigma"])
    later = prb.predict(posterior, np.positive, x, model=model, n_draws=20)
    warm = np.array([1.0, 2.0, 2.5])
    labels = {"mu": "mean", "y": "stiffness (N/mm)", "hot": "at 200 °C"}
    results = {"model": model, "optimum": optimum, "posterior": posterior}
    made = prb.Report("x", **results, validation={"hot": (warm, later)}, labels=labels)
    titles = [section.title for section in made.sections]
    assert titles[1] == "Measured and predicted responses", "on page one"
    evidence = titles[titles.index("Evidence") :]
    assert evidence[1] == "Measured and calibrated responses"
    given = {name: keywords.get("labels") for name, (_, keywords) in calls.items()}
    assert {keywords.get("prob") for _, keywords in calls.values()} == {0.89, None}
    assert given["responses"] == given["landscape"] == {"mu": "mean", "y": "stiffness (N/mm)"}
    assert given["comparison"] == {"mu": "mean"}
    assert given["prediction"] == {"hot": "at 200 °C"}
    with pytest.raises(KeyError, match="labels: got 'nu'"):
        prb.Report("x", model=model, optimum=optimum, labels={"nu": "typing error"})


def test_all_intervals_have_the_probability_of_the_decision(calls: Calls, calibrated: Any) -> None:
    model, optimum, posterior, _ = calibrated
    numbers = {"probability": 0.1, "error": 0.01, "lower": 0.05, "upper": 0.2}
    risk = xr.Dataset(numbers | {"by_draw": ("draw", [0.1])})
    risk = risk.assign_attrs(prob=0.8, limit=4.0, below=0)
    results = {"model": model, "optimum": optimum, "posterior": posterior}
    report = prb.Report("x", **results, decision={"above": risk})
    with_prob = ("population", "responses", "posterior")
    assert {name: calls[name][1]["prob"] for name in with_prob} == dict.fromkeys(with_prob, 0.8)
    assert "comparison" not in calls, "its intervals contain 89%"
    text = report._html()
    assert "intervals of 80% probability" in text
    assert "80% from" in text
    assert "89%" not in text
