"""Pictures of a report: which ones, of what, and in what words."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from subprocess import CalledProcessError
from typing import Any

import pymc as pm

from prbayes.model.node import nodes
from prbayes.plots.comparison import plot_comparison
from prbayes.plots.landscape import plot_landscape
from prbayes.plots.optimizer import plot_optimizer
from prbayes.plots.population import plot_population
from prbayes.plots.posterior import plot_posterior
from prbayes.plots.responses import plot_responses
from prbayes.plots.stages import plot_stages
from prbayes.plots.validity import plot_validity
from prbayes.reports.material import Material
from prbayes.reports.section import Section

_log = logging.getLogger("prbayes")


@dataclass(frozen=True)
class Illustration:
    """A picture that a report shows where it has what the picture needs.

    Attributes
    ----------
    after : str
        Title of the section that it belongs to.
    function : callable
        Returns an ArviZ `PlotCollection`.
    arguments : callable
        Of the material: arguments and keywords; None where something is lacking.
    title, alt, caption : str
    """

    after: str
    function: Callable[..., Any]
    arguments: Callable[[Material], tuple[tuple[Any, ...], dict[str, Any]] | None]
    title: str
    alt: str
    caption: str


def _answer(m: Material) -> Any:
    """Return the first posterior, or else the first optimum that is not from a file."""
    return next(iter((*m.posteriors.values(), *m.found.values())), None)


def _with_model(m: Material) -> Any:
    answer = _answer(m)
    return None if m.model is None or answer is None else ((answer,), {"model": m.model})


def _spends(model: pm.Model) -> bool:
    """Return whether a draw of the model's simulators computes responses."""
    return any(node.bound.n_per_theta for node in nodes(model).values())


def _responses(m: Material) -> Any:
    """Return the same, unless the picture would compute responses: a report spends none."""
    if m.model is not None and _spends(m.model):
        raise NotImplementedError("it would compute responses anew; call prb.plot_responses for it")
    return _with_model(m)


def _posterior(m: Material) -> Any:
    if not m.posteriors:
        return None
    optimum = next(iter(m.found.values()), None)
    return (next(iter(m.posteriors.values())), optimum), {"model": m.model}


def _stages(m: Material) -> Any:
    first = next(iter(m.posteriors.values()), None)
    return None if first is None or "stage" not in getattr(first.get("sample_stats"), "dims", ()) else ((first,), {})


def _optimizer(m: Material) -> Any:
    return ((next(iter(m.found.values())),), {"col_wrap": 2}) if m.found else None


def _landscape(m: Material) -> Any:
    return ((next(iter(m.found.values())),), {"model": m.model}) if m.found and m.model is not None else None


def _comparison(m: Material) -> Any:
    return None if m.comparison is None else ((m.comparison,), {})


def _validity(m: Material) -> Any:
    single = len(m.tests) == 1
    return ((next(iter(m.tests.values())) if single else m.tests,), {}) if m.tests else None


ILLUSTRATIONS = (
    Illustration(
        "Data", plot_responses, _responses, "Measured and calibrated responses",
        "Distribution of the measured responses with that of the calibrated population, one panel per simulator.",
        "Measured responses and the calibrated population.",
    ),
    Illustration(
        "Optimum", plot_optimizer, _optimizer, "Path of the optimiser",
        "Discrepancy, and hyperparameters, against the number of evaluations.",
        "The objective at the points that the optimiser asked for.",
    ),
    Illustration(
        "Optimum", plot_landscape, _landscape, "Discrepancy around the optimum",
        "Discrepancy over the hyperparameters, with the optimum marked.",
        "How the discrepancy rises around the optimum.",
    ),
    Illustration(
        "Posterior", plot_posterior, _posterior, "Marginal posteriors",
        "Posterior density of each hyperparameter, with its interval.",
        "What is known of each hyperparameter after the calibration.",
    ),
    Illustration(
        "Posterior", plot_population, _with_model, "Calibrated population of the inputs",
        "Distribution of each input over the specimens, with a band for its uncertainty.",
        "How the inputs vary from specimen to specimen.",
    ),
    Illustration(
        "Posterior", plot_stages, _stages, "Stages of the sampler",
        "Tempering, acceptance rate and moves against the stages of the sampler, one line per chain.",
        "How the sampler went from the prior to the posterior.",
    ),
    Illustration(
        "Comparison", plot_comparison, _comparison, "Estimates side by side",
        "Estimate and interval of each result, one panel per hyperparameter.",
        "Estimates with their intervals.",
    ),
    Illustration(
        "Validity", plot_validity, _validity, "Distribution of the u-values",
        "Step curve of the sorted u-values against the diagonal, with the area between them and an acceptance band.",
        "Where the measured responses stand in the predicted distribution. A right model keeps near the diagonal; the "
        "shaded area is the statistic, and the band holds the whole curve with the stated probability.",
    ),
)  # fmt: skip


def illustrate(sections: tuple[Section, ...], material: Material) -> tuple[Section, ...]:
    """Return the sections with pictures after those that they belong to."""
    made: list[Section] = []
    pending: list[Section] = []
    for section in sections:
        if section.level == 2:
            made += pending
            pending = [s for i in ILLUSTRATIONS if i.after == section.title for s in _made(i, material)]
        made.append(section)
    return (*made, *pending)


def _made(illustration: Illustration, material: Material) -> list[Section]:
    # Heavy, and partly annotated.
    pyplot: Any = import_module("matplotlib.pyplot")
    arviz: Any = import_module("arviz")
    before = set(pyplot.get_fignums())
    try:
        found = illustration.arguments(material)
        if found is None:
            return []
        arguments, keywords = found
        with arviz.rc_context({"plot.backend": "matplotlib"}):
            picture = illustration.function(*arguments, **keywords)
        alt, caption = illustration.alt, illustration.caption
        return [Section(illustration.title, picture=picture, alt=alt, caption=caption, level=3)]
    except (TypeError, ValueError, NotImplementedError) as error:
        _log.warning("report: no picture by %s: %s", illustration.function.__name__, error)
        return [Section(illustration.title, f"This picture could not be made: {error}", level=3)]
    finally:
        for number in set(pyplot.get_fignums()) - before:
            pyplot.close(number)


def with_graph(sections: tuple[Section, ...], m: Material) -> tuple[Section, ...]:
    """Add the model's graph after the parts of the section on the model; or say why there is none."""
    if m.model is None:
        return sections
    place = next(i for i, s in enumerate(sections) if s.title == "Model") + 1
    while place < len(sections) and sections[place].level == 3:
        place += 1
    try:
        import_module("graphviz")
        if _spends(m.model):  # PyMC draws each variable once for its shape
            raise NotImplementedError
        drawn = _graph(m.model)
        names = ", ".join(v["name"] for v in (m.description or {"variables": []})["variables"])
        alt = f"Graph of the model: arrows from its variables ({names}) to the simulators."
        caption = "Variables of the model; filled: compared with measured responses."
        section = Section("Graph", picture=drawn, alt=alt, caption=caption, level=3)
    except ImportError:
        section = Section("Graph", "The model's graph is not drawn: there is no Python package graphviz.", level=3)
    except NotImplementedError:
        text = "The model's graph is not drawn: PyMC would compute responses for it. See pm.model_to_graphviz(model)."
        section = Section("Graph", text, level=3)
    except (RuntimeError, OSError, CalledProcessError) as error:
        lacking = isinstance(error, RuntimeError | OSError)
        why = "there is no program dot of Graphviz" if lacking else "Graphviz does not take a name in it"
        section = Section("Graph", f"The model's graph is not drawn: {why}.", level=3)
    return (*sections[:place], section, *sections[place:])


def _graph(model: Any) -> bytes:
    graphs: Any = import_module("pymc.model_graph")
    own = {node.name for node in nodes(model).values()}
    plain = graphs.DEFAULT_NODE_FORMATTERS[graphs.NodeType.OBSERVED_RV]

    def observed(rv: Any) -> dict[str, Any]:
        style: dict[str, Any] = plain(rv)
        return {**style, "label": f"{rv.name}\n~\nSimulator"} if rv.name in own else style

    graph = pm.model_to_graphviz(model, node_formatters={"Observed Random Variable": observed})
    for attributes in (graph.graph_attr, graph.node_attr):
        attributes.update(fontname="Helvetica,Arial,sans-serif", fontsize="11")
    svg: bytes = graph.pipe(format="svg", quiet=True)
    return svg
