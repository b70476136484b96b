"""`Report`: a calibration as a document, for reading and for print."""

from __future__ import annotations

import base64
import html
import re
from collections.abc import Mapping
from dataclasses import InitVar, dataclass, replace
from functools import cache
from os import PathLike
from pathlib import Path
from typing import Any

import pymc as pm
import xarray as xr

from prbayes.estimate.optimum import Optimum
from prbayes.reports.contents import contents
from prbayes.reports.section import Section, cells
from prbayes.validation.validity import ValidityTest

# What Markdown, or HTML inside it, would read as markup.
_MARKUP = re.compile(r"([\\`*_{}\[\]<>|&~$!])")
_AT_START = re.compile(r"^(?:#+|[-+](?=\s|$)|-{2,}|={1,}|\d{1,9}(?=[.)](?:\s|$)))")


@dataclass(frozen=True, eq=False)
class Report:
    """A calibration as a document: what was calibrated, with which data, the answer, and whether it may be trusted.

    What is not given is left out. Pictures are made when the report is; after that it is data, and a writer gives the
    same bytes each time.

    Parameters
    ----------
    title : str
    model : pymc.Model, optional
        What needs it are distributions of populations, and the graph; the rest is in the results.
    optimum : Optimum or xarray.DataTree, or a mapping of such, optional
        From `minimize`, or its ``to_datatree()``; several by name.
    posterior : xarray.DataTree, or a mapping of such, optional
        From `sample_smc`, `bootstrap` or a sampler of PyMC; also read from a file.
    validity : ValidityTest, or a mapping of such, optional
        From `area_test`; several by name.
    comparison : xarray.Dataset, optional
        From `compare`; that of the optima and posteriors by default, where there are two or more.
    sections : tuple of Section
        By default those of the results. With them given, results are not looked at.
    author, date : str
        Below the title. No date is made up.
    pictures : bool
        Whether pictures are made of the results.

    Attributes
    ----------
    sections : tuple of Section
        For a report of your own: ``report.with_section``, or ``dataclasses.replace(report, sections=...)``.

    Raises
    ------
    TypeError, ValueError
        If an argument is not as described.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
    ...     y = prb.Simulator("y", lambda x: 2 * x, x, metric=prb.AreaMetric(), observed=[0.0, 2.0, 4.0])
    >>> report = prb.Report("Shaft stiffness", model=model, optimum=prb.minimize(model), pictures=False)
    >>> [section.title for section in report.sections if section.level == 2][:3]
    ['Summary', 'Model', 'Data']
    """

    title: str
    sections: tuple[Section, ...] = ()
    author: str = ""
    date: str = ""
    model: InitVar[pm.Model | None] = None
    optimum: InitVar[Optimum | xr.DataTree | Mapping[str, Optimum | xr.DataTree] | None] = None
    posterior: InitVar[xr.DataTree | Mapping[str, xr.DataTree] | None] = None
    validity: InitVar[ValidityTest | Mapping[str, ValidityTest] | None] = None
    comparison: InitVar[xr.Dataset | None] = None
    pictures: InitVar[bool] = True

    def __post_init__(
        self,
        model: pm.Model | None,
        optimum: Optimum | xr.DataTree | Mapping[str, Optimum | xr.DataTree] | None,
        posterior: xr.DataTree | Mapping[str, xr.DataTree] | None,
        validity: ValidityTest | Mapping[str, ValidityTest] | None,
        comparison: xr.Dataset | None,
        pictures: bool,
    ) -> None:
        """Make the sections, if none are given."""
        if not isinstance(self.title, str) or not self.title.strip():
            raise TypeError(f"Report: title: got {self.title!r:.60}, expected a text")
        made = tuple(self.sections) or contents(model, optimum, posterior, validity, comparison, pictures=pictures)
        wrong = [s for s in made if not isinstance(s, Section)]
        if wrong:
            raise TypeError(f"Report: sections: got {type(wrong[0]).__name__}, expected prb.Section objects")
        object.__setattr__(self, "sections", made)

    def with_section(self, section: Section, *, after: str | None = None) -> Report:
        """Return a report with one more section.

        Parameters
        ----------
        section : Section
        after : str, optional
            Title of the section that it follows, with all its parts; at the end by default.

        Raises
        ------
        KeyError
            If no section has that title.
        """
        place = len(self.sections)
        if after is not None:
            titles = [s.title for s in self.sections]
            if after not in titles:
                raise KeyError(f"after: got {after!r}, expected the title of a section: {titles}")
            start = titles.index(after)
            level = self.sections[start].level
            ends = [i for i in range(start + 1, place) if self.sections[i].level <= max(level, section.level)]
            place = min(ends, default=place)
        return replace(self, sections=(*self.sections[:place], section, *self.sections[place:]))

    def to_html(self, path: str | PathLike[str]) -> Path:
        """Write one file that holds everything, for a browser and for print; return its path."""
        return _write(Path(path), self._html())

    def to_markdown(self, folder: str | PathLike[str]) -> Path:
        """Write ``report.md``, and pictures as files beside it, into a folder; return the path of ``report.md``."""
        folder = Path(folder)
        files = [
            None if s.picture is None else f"{i:02d}-{_slug(s.title)}.{s.kind}" for i, s in enumerate(self.sections, 1)
        ]
        text = (
            _markdown().get_template("report.md.j2").render(report=self, byline=self._byline, cells=cells, files=files)
        )
        folder.mkdir(parents=True, exist_ok=True)
        for section, name in zip(self.sections, files, strict=True):
            if name is not None:
                (folder / name).write_bytes(section.picture)
        return _write(folder / "report.md", text.rstrip("\n") + "\n")

    @property
    def _byline(self) -> str:
        return ", ".join(filter(None, (self.author, self.date)))

    def _html(self) -> str:
        environment = _environment()
        chapters = [(i, s.title) for i, s in enumerate(self.sections, 1) if s.level == 2 and i > 1]
        rendered: str = environment.get_template("report.html.j2").render(
            report=self,
            byline=self._byline,
            style=environment.get_template("report.css").render(),
            contents=chapters,
            cells=cells,
            base64=lambda data: base64.b64encode(data).decode("ascii"),
        )
        return rendered + "\n"

    def _repr_html_(self) -> str:
        """Show the report in a notebook, in a frame of its own."""
        text = html.escape(self._html(), quote=True)
        return f'<iframe sandbox srcdoc="{text}" title="report" style="width: 100%; height: 40rem; border: 0"></iframe>'


@cache
def _environment() -> Any:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    return Environment(loader=PackageLoader("prbayes.reports"), autoescape=True, undefined=StrictUndefined)


@cache
def _markdown() -> Any:
    from jinja2 import Environment, PackageLoader, StrictUndefined
    from markupsafe import Markup

    def escaped(value: Any) -> str:
        return str(value) if isinstance(value, Markup) else _literal(str(value))

    return Environment(
        loader=PackageLoader("prbayes.reports"), autoescape=False, finalize=escaped, undefined=StrictUndefined
    )


def _literal(text: str) -> str:
    """Return a text, in one line, that Markdown shows as it is."""
    line = _MARKUP.sub(r"\\\1", " ".join(text.split()))
    return _AT_START.sub(lambda m: f"{m[0]}\\" if m[0].isdigit() else f"\\{m[0]}", line)


def _slug(title: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-")[:40] or "picture"


def _write(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8", newline="\n")
    return path
