"""Pictures of a report, and the graph of its model."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import dataclass
from importlib import import_module
from subprocess import CalledProcessError
from typing import Any

import pymc as pm

from prbayes._finding import Finding, report
from prbayes._stats import INTERVAL
from prbayes._validate import Function
from prbayes.model.emulated import population_simulators
from prbayes.model.parameters import variable_of
from prbayes.plots.comparison import plot_comparison
from prbayes.plots.convergence import plot_optimizer, plot_stages
from prbayes.plots.landscape import plot_landscape
from prbayes.plots.outputs import plot_outputs
from prbayes.plots.population import plot_population
from prbayes.plots.posterior import plot_posterior
from prbayes.plots.prediction import plot_prediction
from prbayes.plots.responses import plot_responses
from prbayes.plots.sensitivity import plot_sensitivity
from prbayes.plots.validity import plot_validity
from prbayes.reports.material import Material, constants_of, kind_of_decision
from prbayes.reports.section import Section, image
from prbayes.results.diagnose import seconds_of

_log = logging.getLogger("prbayes")


@dataclass(frozen=True)
class Illustration:
    """A picture that a report shows if it has the results for it."""

    function: Function  # function that returns a figure with ``savefig``
    title: str
    alt: str
    caption: str = ""


ILLUSTRATIONS = {
    "responses": Illustration(
        plot_responses,
        title="Measured and calibrated responses",
        alt="Distribution function of the measured responses with that of the calibrated "
        "population, one panel per simulator or output.",
    ),
    "outputs": Illustration(
        plot_outputs,
        title="Pairs of outputs",
        alt="Measured specimens as points, one panel per pair of outputs, with outlines of the "
        "calibrated population.",
    ),
    "optimizer": Illustration(
        plot_optimizer,
        title="Path of the optimiser",
        alt="Objective, and hyperparameters, against the number of evaluations.",
    ),
    "landscape": Illustration(
        plot_landscape,
        title="Objective around the optimum",
        alt="Objective over the hyperparameters, with the optimum marked.",
    ),
    "posterior": Illustration(
        plot_posterior,
        title="Marginal posteriors",
        alt="Posterior density of each hyperparameter, with its interval.",
    ),
    "population": Illustration(
        plot_population,
        title="Calibrated population of the inputs",
        alt="Distribution of each input over the specimens, with a band for its uncertainty.",
    ),
    "stages": Illustration(
        plot_stages,
        title="Stages of the sampler",
        alt="Tempering, acceptance rate and moves against the stages of the sampler, "
        "one line per chain.",
    ),
    "comparison": Illustration(
        plot_comparison,
        title="Estimates side by side",
        alt="Estimate and interval of each result, one panel per hyperparameter.",
    ),
    "prediction": Illustration(
        plot_prediction,
        title="Measured and predicted responses",
        alt="Distribution functions of the measured responses, as steps, and of the predicted ones "
        "with a band, one panel per condition or output.",
        caption="Measured values of the test beside their prediction. Steps in the band agree.",
    ),
    "validity": Illustration(
        plot_validity,
        title="Distribution of the u-values",
        alt="Step curve of the sorted u-values against the diagonal, "
        "with the area between them, and of one output an acceptance band.",
        caption="A right model is near the diagonal; the shaded area is the statistic. With one "
        "output, the whole curve of a right model is in the band with probability one minus the "
        "test's level; several outputs have a line for each direction. Rejected: red.",
    ),
    "sensitivity": Illustration(
        plot_sensitivity,
        title="Shares of parameters and inputs",
        alt="Share of each parameter of the population in the variance of the decision quantity, "
        "and of each input in that of the response.",
        caption="A dot is the share of a factor by itself, a diamond the share that is left with "
        "all others known; bars are two standard errors.",
    ),
}


# -- arguments of pictures -------------------------------------------------------------------


# positional and keyword arguments, or the end of a sentence on why the picture is missing
Request = tuple[tuple[Any, ...], dict[str, Any]] | str


def requests(m: Material) -> dict[str, Request]:
    """Return the arguments of the pictures that the contents of a report allow, by name."""
    requested: dict[str, Request] = {}
    posterior = next(iter(m.posteriors.values()), None)
    # An optimum from a file has no evaluator, hence no population.
    optimum = next(iter(m.live_optima.values()), None)
    # Pictures of the model refuse labels of conditions and constants, which it has not.
    elsewhere = {*m.validation, *constants_of(m.description)}
    of_model = {name: text for name, text in m.labels.items() if name not in elsewhere}
    common = {"model": m.model, "labels": of_model}
    prob = {"prob": m.prob}
    result = optimum if posterior is None else posterior
    if m.model is not None and result is not None:
        requested["population"] = ((result,), common | prob)
    is_costly = optimum is None or seconds_of(optimum, 100) > 10
    if m.model is not None and _computes_responses(m.model) and is_costly:
        requested["responses"] = "it would recompute responses; call prb.plots.plot_responses"
    elif "population" in requested:
        # Distribution functions need no bandwidth, which a dozen values do not determine.
        of_responses = {"ecdf": True, "before": False}
        requested["responses"] = ((result,), common | prob | of_responses)
        if any(len(y.columns()) > 1 for y in m.observed.values()):
            requested["outputs"] = ((result,), common)
    if posterior is not None:
        shown = {} if m.model is not None else _labels_of(m, posterior["posterior"].data_vars)
        shown |= {"optimum": optimum, "backend": "matplotlib"}
        requested["posterior"] = ((posterior,), common | prob | shown)
        if "sample_stats" in posterior and "stage" in posterior["sample_stats"].dims:
            requested["stages"] = ((posterior,), {})
    if optimum is not None:
        requested["optimizer"] = ((optimum,), {"col_wrap": 2, "labels": of_model})
        if m.model is not None:
            requested["landscape"] = ((optimum,), common)
    if m.comparison is not None and m.prob == INTERVAL:
        names = m.comparison["hyperparameter"].values
        requested["comparison"] = ((m.comparison,), _labels_of(m, names))
    if m.tests:
        tests = m.tests if len(m.tests) > 1 else next(iter(m.tests.values()))
        requested["validity"] = ((tests,), {})
    tables = [t for t in m.decisions.values() if kind_of_decision(t) == "sensitivity"]
    if tables:
        requested["sensitivity"] = (tuple(tables[:1]), _labels_of(m, tables[0]["factor"].values))
    if m.validation:
        measured = {name: data.measured for name, data in m.validation.items()}
        predicted = {name: data.predicted for name, data in m.validation.items()}
        requested["prediction"] = ((measured, predicted), _labels_of(m, m.validation) | prob)
    return requested


def _labels_of(m: Material, names: Iterable[Any]) -> dict[str, Any]:
    """Return the labels of names, as keywords of a picture without a model."""
    variables = {variable_of(str(name)) for name in names}
    texts = {name: text for name, text in m.labels.items() if variable_of(name) in variables}
    return {"labels": texts}


def _computes_responses(model: pm.Model) -> bool:
    """Return whether a draw of the model's simulators computes responses."""
    return any(not simulator.has_specimens for simulator in population_simulators(model))


# -- drawing ---------------------------------------------------------------------------------


def pictures_of(m: Material) -> dict[str, list[Section]]:
    """Return the pictures by name, and under "missing" a section on those that could not be made.

    The one of measured values beside predicted ones, or else beside the calibrated population, is
    called "front".
    """
    drawn = {}
    missing = []
    for name, request in requests(m).items():
        picture = picture_of(ILLUSTRATIONS[name], request)
        if isinstance(picture, Section):
            drawn[name] = [picture]
        else:
            missing.append(f"{ILLUSTRATIONS[name].title}: {picture.removesuffix('.')}.")
    drawn["front"] = drawn.pop("prediction", []) or drawn.pop("responses", [])
    graph = None if m.model is None else _graph(m.model)
    if graph is not None:
        names = ", ".join(variable["name"] for variable in m.description["variables"])
        alt = f"Graph of the model: arrows from its variables ({names}) to the simulators."
        caption = "Variables of the model; filled: compared with measured responses."
        drawn["graph"] = [Section("Graph", picture=graph, alt=alt, caption=caption, level=3)]
    if missing:
        drawn["missing"] = [Section("Pictures that could not be made", missing, level=3)]
    return drawn


def picture_of(illustration: Illustration, request: Request) -> Section | str:
    """Return a picture, or the reason why it is missing."""
    reason = request
    if not isinstance(request, str):
        arguments, keywords = request
        from matplotlib import pyplot as plt  # heavy, and only needed for pictures

        open_figures = set(plt.get_fignums())
        try:
            picture = image(illustration.function(*arguments, **keywords))
            texts = {"alt": illustration.alt, "caption": illustration.caption}
            return Section(illustration.title, picture=picture, level=3, **texts)
        except (TypeError, ValueError, NotImplementedError) as error:
            # The picture refuses the results, or PyMC has no formula for a distribution.
            reason = str(error)
        finally:
            for figure in set(plt.get_fignums()) - open_figures:
                plt.close(figure)
    name = illustration.function.__name__
    report(Finding("no-picture", f"report: no picture by {name}: {reason}"))
    return str(reason)


# -- the model's graph -----------------------------------------------------------------------


def _graph(model: pm.Model) -> bytes | None:
    """Return the model's graph, or None if it cannot be drawn; the log has the reason."""
    if _computes_responses(model):  # PyMC draws each variable once, because it needs its shape.
        _log.info("report: without the graph of the model, as PyMC would compute responses for it")
        return None
    try:
        graphviz = import_module("graphviz")  # a package that users may lack
    except ImportError:
        _log.info("report: without the graph of the model; pip install graphviz adds it")
        return None
    try:
        return _svg(model)
    except (graphviz.ExecutableNotFound, OSError):
        _log.info("report: without the graph of the model, as there is no program dot of Graphviz")
    except CalledProcessError:
        _log.info("report: without the graph of the model, as Graphviz does not take a name in it")
    return None


def _svg(model: pm.Model) -> bytes:
    """Return PyMC's graph of a model, with the simulators labelled."""
    from pymc import model_graph as graphs

    graph = graphs.ModelGraph(model)
    # PyMC collects variables and edges in sets of names, whose order changes from process to
    # process; in the model's order the drawing is always the same.
    order = {name: place for place, name in enumerate(model.named_vars)}
    plates = graph.get_plates()
    for plate in plates:
        plate.variables.sort(key=lambda variable: order[variable.var.name])
    plates.sort(key=lambda plate: order[plate.variables[0].var.name])
    plain = graphs.DEFAULT_NODE_FORMATTERS[graphs.NodeType.OBSERVED_RV]
    simulators = {simulator.name for simulator in population_simulators(model)}

    def formatted(rv: Any) -> dict[str, Any]:
        style: dict[str, Any] = plain(rv)
        label = {"label": f"{rv.name}\n~\nSimulator"} if rv.name in simulators else {}
        return style | label

    drawing = graphs.make_graph(
        model.name,
        plates=plates,
        edges=sorted(graph.edges()),
        node_formatters={"Observed Random Variable": formatted},
    )
    for attributes in (drawing.graph_attr, drawing.node_attr):
        attributes.update(fontname="Helvetica,Arial,sans-serif", fontsize="11")
    svg: bytes = drawing.pipe(format="svg", quiet=True)
    return svg
