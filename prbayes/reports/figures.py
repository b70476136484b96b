"""Pictures of a report, and the graph of its model."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from importlib import import_module
from subprocess import CalledProcessError
from typing import Any

import pymc as pm

from prbayes._finding import Finding, report
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
from prbayes.reports.material import Material, kind_of_decision
from prbayes.reports.section import Section, image

_log = logging.getLogger("prbayes")


@dataclass(frozen=True)
class Illustration:
    """A picture that a report shows where it has the contents."""

    function: Callable[..., Any]  # returns a figure with ``savefig``
    after: str  # title of the section that it belongs to
    title: str
    alt: str
    caption: str


# In the order of the report, and within a section in this order.
ILLUSTRATIONS = {
    "responses": Illustration(
        plot_responses,
        after="Data",
        title="Measured and calibrated responses",
        alt="Distribution of the measured responses with that of the calibrated population, "
        "one panel per simulator or output.",
        caption="Measured responses and the calibrated population.",
    ),
    "outputs": Illustration(
        plot_outputs,
        after="Data",
        title="Pairs of outputs",
        alt="Measured specimens as points, one panel per pair of outputs, with outlines of the "
        "calibrated population.",
        caption="Measured specimens, and regions with 50% and 89% of the calibrated population.",
    ),
    "optimizer": Illustration(
        plot_optimizer,
        after="Optimum",
        title="Path of the optimiser",
        alt="Objective, and hyperparameters, against the number of evaluations.",
        caption="The objective at the points that the optimiser evaluated.",
    ),
    "landscape": Illustration(
        plot_landscape,
        after="Optimum",
        title="Objective around the optimum",
        alt="Objective over the hyperparameters, with the optimum marked.",
        caption="The objective around the optimum.",
    ),
    "posterior": Illustration(
        plot_posterior,
        after="Posterior",
        title="Marginal posteriors",
        alt="Posterior density of each hyperparameter, with its interval.",
        caption="Posterior distribution of each hyperparameter after the calibration.",
    ),
    "population": Illustration(
        plot_population,
        after="Posterior",
        title="Calibrated population of the inputs",
        alt="Distribution of each input over the specimens, with a band for its uncertainty.",
        caption="Variation of the inputs from specimen to specimen.",
    ),
    "stages": Illustration(
        plot_stages,
        after="Posterior",
        title="Stages of the sampler",
        alt="Tempering, acceptance rate and moves against the stages of the sampler, "
        "one line per chain.",
        caption="Stages of the sampler from the prior to the posterior.",
    ),
    "comparison": Illustration(
        plot_comparison,
        after="Comparison",
        title="Estimates side by side",
        alt="Estimate and interval of each result, one panel per hyperparameter.",
        caption="Estimates with their intervals.",
    ),
    "prediction": Illustration(
        plot_prediction,
        after="Validity",
        title="Measured and predicted responses",
        alt="Distribution functions of the measured responses, as steps, and of the predicted ones "
        "with a band, one panel per condition or output.",
        caption="Specimens that were not used in the calibration, beside their prediction; the "
        "band contains 89% of the populations of the posterior.",
    ),
    "validity": Illustration(
        plot_validity,
        after="Validity",
        title="Distribution of the u-values",
        alt="Step curve of the sorted u-values against the diagonal, "
        "with the area between them, and of one output an acceptance band.",
        caption="Places of the measured responses in the predicted distribution. "
        "A right model is near the diagonal; the shaded area is the statistic. "
        "With one output, the band contains the whole curve of a right model with probability one "
        "minus the test's level; several outputs have a line for each direction, and no band. "
        "Curves of a rejected model are red.",
    ),
    "sensitivity": Illustration(
        plot_sensitivity,
        after="Decision",
        title="Shares of hyperparameters and inputs",
        alt="Share of each hyperparameter in the variance of the decision quantity, and of each "
        "input in that of the response.",
        caption="Sensitivity of the decision: a dot is the share of a factor by itself, a diamond "
        "the share that is left when all others are known, with two standard errors to either "
        "side.",
    ),
}


# -- arguments of pictures -------------------------------------------------------------------


# Positional and keyword arguments, or the reason for a missing picture as the end of a sentence.
Request = tuple[tuple[Any, ...], dict[str, Any]] | str


def requests(m: Material) -> dict[str, Request]:
    """Return the arguments of the pictures that the contents of a report allow, by name."""
    requested: dict[str, Request] = {}
    posterior = next(iter(m.posteriors.values()), None)
    # An optimum from a file has no evaluator, hence no population.
    optimum = next(iter(m.live_optima.values()), None)
    # Labels of the model, which has no conditions of a test
    of_model = {name: text for name, text in m.labels.items() if name not in m.validation}
    labels = {"labels": of_model} if of_model else {}

    def labels_of(names: Iterable[Any]) -> dict[str, Any]:
        """Return as keywords the labels of names in a picture without a model."""
        variables = {variable_of(str(name)) for name in names}
        texts = {name: text for name, text in m.labels.items() if variable_of(name) in variables}
        return {"labels": texts} if texts else {}

    result = optimum if posterior is None else posterior
    if m.model is not None and result is not None:
        requested["population"] = ((result,), {"model": m.model, **labels})
    if m.model is not None and _computes_responses(m.model):
        requested["responses"] = "it would recompute responses; call prb.plots.plot_responses"
    elif "population" in requested:
        requested["responses"] = requested["population"]
        if any(y.ndim > 1 and y.shape[1] > 1 for y in m.observed.values()):
            requested["outputs"] = requested["population"]
    if posterior is not None:
        shown = labels if m.model is not None else labels_of(posterior["posterior"].data_vars)
        shown = {"optimum": optimum, "model": m.model, "backend": "matplotlib", **shown}
        requested["posterior"] = ((posterior,), shown)
        if "sample_stats" in posterior and "stage" in posterior["sample_stats"].dims:
            requested["stages"] = ((posterior,), {})
    if optimum is not None:
        requested["optimizer"] = ((optimum,), {"col_wrap": 2, **labels})
        if m.model is not None:
            requested["landscape"] = ((optimum,), {"model": m.model, **labels})
    if m.comparison is not None:
        names = m.comparison["hyperparameter"].values
        requested["comparison"] = ((m.comparison,), labels_of(names))
    if m.tests:
        tests = m.tests if len(m.tests) > 1 else next(iter(m.tests.values()))
        requested["validity"] = ((tests,), {})
    tables = [t for t in m.decisions.values() if kind_of_decision(t) == "sensitivity"]
    if tables:
        requested["sensitivity"] = (tuple(tables[:1]), labels_of(tables[0]["factor"].values))
    if m.validation:
        measured = {name: pair[0] for name, pair in m.validation.items()}
        predicted = {name: pair[1] for name, pair in m.validation.items()}
        requested["prediction"] = ((measured, predicted), labels_of(m.validation))
    return requested


def _computes_responses(model: pm.Model) -> bool:
    """Return whether a draw of the model's simulators computes responses: a report spends none."""
    return any(not simulator.has_specimens for simulator in population_simulators(model))


# -- drawing ---------------------------------------------------------------------------------


def illustrate(sections: tuple[Section, ...], material: Material) -> tuple[Section, ...]:
    """Return the sections with pictures after those that they belong to."""
    requested = requests(material)
    illustrated: list[Section] = []
    pictures: list[Section] = []
    for section in sections:
        if section.level == 2:  # pictures come after all parts of the section before
            illustrated += pictures
            pictures = [
                _picture(illustration, requested[name])
                for name, illustration in ILLUSTRATIONS.items()
                if illustration.after == section.title and name in requested
            ]
        illustrated.append(section)
    return (*illustrated, *pictures)


def _picture(illustration: Illustration, request: Request) -> Section:
    """Return a picture, or the reason why it is missing."""
    reason = request
    if not isinstance(request, str):
        arguments, keywords = request
        pyplot: Any = import_module("matplotlib.pyplot")  # heavy, and partly annotated
        open_figures = set(pyplot.get_fignums())
        try:
            picture = image(illustration.function(*arguments, **keywords))
            texts = {"alt": illustration.alt, "caption": illustration.caption}
            return Section(illustration.title, picture=picture, level=3, **texts)
        except (TypeError, ValueError, NotImplementedError) as error:
            # Refusals of pictures; and distributions for which PyMC has no formula
            reason = str(error)
        finally:
            for figure in set(pyplot.get_fignums()) - open_figures:
                pyplot.close(figure)
    name = illustration.function.__name__
    report(Finding("no-picture", f"report: no picture by {name}: {reason}"))
    return Section(illustration.title, f"This picture could not be made: {reason}", level=3)


# -- the model's graph -----------------------------------------------------------------------


def with_graph(sections: tuple[Section, ...], m: Material) -> tuple[Section, ...]:
    """Add the model's graph after the parts of the section on the model, where it can be drawn."""
    picture = None if m.model is None else _graph(m.model)
    if picture is None:
        return sections
    names = ", ".join(variable["name"] for variable in m.variables)
    graph = Section(
        "Graph",
        picture=picture,
        alt=f"Graph of the model: arrows from its variables ({names}) to the simulators.",
        caption="Variables of the model; filled: compared with measured responses.",
        level=3,
    )
    place = [section.title for section in sections].index("Model") + 1
    while place < len(sections) and sections[place].level == 3:
        place += 1
    return (*sections[:place], graph, *sections[place:])


def _graph(model: pm.Model) -> bytes | None:
    """Return the model's graph; None without Graphviz, which is no reader's affair."""
    if _computes_responses(model):  # PyMC draws each variable once for its shape
        _log.info("report: without the graph of the model, as PyMC would compute responses for it")
        return None
    try:
        graphviz: Any = import_module("graphviz")  # a package that users may lack
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
    graphs: Any = import_module("pymc.model_graph")
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
