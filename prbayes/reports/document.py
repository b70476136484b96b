"""`Report`: a calibration as a document, for reading and for print."""

from __future__ import annotations

import base64
import html
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import pymc as pm
import xarray as xr

from prbayes._display import percentage
from prbayes._stats import INTERVAL
from prbayes._validate import (
    Labels,
    NamedValues,
    StrPath,
    called,
    file_path,
    flag,
    folder_path,
    plain_text,
    wrong_type,
    wrong_value,
)
from prbayes.optimize.optimum import Optimum
from prbayes.reports.fleet import fleet_sections
from prbayes.reports.material import date_of, gather, versions_of
from prbayes.reports.numbers import cells
from prbayes.reports.section import Section, is_broad, kind_of
from prbayes.reports.sections import sections_of
from prbayes.response.store import replace_files
from prbayes.results.products import is_fleet
from prbayes.validation.area_test import ValidityTest

# Markup of Markdown, or of HTML inside it (CommonMark 0.31, 2.4; tables and strikethrough of
# GitHub; formulas between dollars).
_MARKUP = re.compile(r"([\\`*_{}\[\]<>|&~$!])")
# Headings, items, rules and underlines begin a line (CommonMark 0.31, 4.1 to 4.3 and 5.2).
_AT_START = re.compile(r"^(?:#+|[-+](?=\s|$)|-{2,}|={1,}|\d{1,9}(?=[.)](?:\s|$)))")
# Texts that readers make a link without markup (autolinks of GitHub, 6.9).
_BARE_LINK = re.compile(r"(?i)\b(https?|ftp)(:)(?=//)|\b(www)(\.)")
# Invisible characters: controls other than line ends, and marks of the direction of writing
# (Unicode, annex 9), which reverse the text after them.
_INVISIBLE = re.compile(
    "[\x00-\x08\x0e-\x1f\x7f-\x84\x86-\x9f\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069\ufeff]"
)


def visible(text: str) -> str:
    """Return a text with a mark in the place of invisible characters."""
    return _INVISIBLE.sub("\N{REPLACEMENT CHARACTER}", text)


@dataclass(frozen=True, eq=False, init=False)
class Report:
    """A calibration as a document: the problem, the answer, whether it may be trusted.

    The report has sections for the results that are given. It is data: pictures are made once, and
    a writer gives the same bytes each time.

    Parameters
    ----------
    title : str
        Heading of the report.
    sections : tuple of Section
        By default those of the results; with sections, results are not read.
    author : str
        Below the title.
    date : str, optional
        By default the day of the latest result, in UTC, which is stored in it; ``""`` for none. An
        optimum in memory has today's.
    note : str, optional
        Below author and date; by default versions of the software, as results have them, and the
        probability of all intervals: that of `exceedance` in ``decision``, or else 89%.
    model : pymc.Model, optional
        Needed for distributions of populations and for the graph; the rest is in the results.
    optimum : Optimum or xarray.DataTree, or a mapping of such, optional
        From `minimize`, or its ``to_datatree()``; several by name.
    posterior : xarray.DataTree, or a mapping of such, optional
        From `sample_smc`, `bootstrap` or a sampler of PyMC; also read from a file. A fleet from
        `calibrate_each` gives a table of its products; `exceedance` of it goes into ``decision``.
    validity : ValidityTest, or a mapping of such, optional
        From `area_test`; several by name.
    comparison : xarray.Dataset, optional
        From `compare`; that of the optima and posteriors by default, if there are two or more.
    decision : xarray.Dataset, or a mapping of such, optional
        From `exceedance`, `sensitivity` or `plan`; several by name.
    pictures : bool
        Whether pictures of the results are made.
    validation : mapping, optional
        Data of the validity tests, by condition: a pair of measured responses of other specimens
        and their prediction by `predict`. They become a table and a picture.
    labels : mapping, optional
        Labels of hyperparameters, inputs, simulators and outputs by name, with units: ``{"mu":
        "mean of log C", "crack": "crack length / notch length"}``.

    Attributes
    ----------
    sections : tuple of Section
        Other sections: ``report.with_section``, or ``dataclasses.replace(report, sections=...)``.

    Raises
    ------
    TypeError, KeyError, ValueError
        If an argument is not as described, or results are of other populations or data than the
        model or each other.

    Examples
    --------
    >>> import numpy as np, pymc as pm, prbayes as prb
    >>> with pm.Model() as model:
    ...     x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
    ...     y = prb.Simulator("y", lambda x: 2 * x, x, metric=prb.AreaMetric(), observed=[0, 2, 4])
    >>> optimum = prb.minimize(model)
    >>> report = prb.Report("Shaft stiffness", model=model, optimum=optimum, pictures=False)
    >>> [section.title for section in report.sections if section.level == 2][:3]
    ['Not ready', 'Decision', 'Answer']
    """

    title: str
    sections: tuple[Section, ...]
    author: str
    date: str
    note: str

    def __init__(
        self,
        title: str,
        sections: Sequence[Section] = (),
        *,
        author: str = "",
        date: str | None = None,
        note: str | None = None,
        model: pm.Model | None = None,
        optimum: Optimum | xr.DataTree | Mapping[str, Optimum | xr.DataTree] | None = None,
        posterior: xr.DataTree | Mapping[str, xr.DataTree] | None = None,
        validity: ValidityTest | Mapping[str, ValidityTest] | None = None,
        comparison: xr.Dataset | None = None,
        decision: xr.Dataset | Mapping[str, xr.Dataset] | None = None,
        pictures: bool = True,
        validation: Mapping[str, tuple[Any, xr.DataArray]] | None = None,
        labels: Labels | None = None,
    ) -> None:
        if not isinstance(title, str) or not title.strip():
            raise TypeError(f"Report: title: got {title!r:.60}, expected a text")
        plain_text(author, "Report: author", empty=True)
        plain_text(date or "", "Report: date", empty=True)
        plain_text(note or "", "Report: note", empty=True)
        flag(pictures, "Report: pictures")
        if not isinstance(sections, Sequence):
            raise wrong_value(sections, "Report: sections", "prb.reports.Section objects")
        contents = tuple(sections)
        fleet: Any = posterior
        if not contents and is_fleet(fleet):
            of_product = {
                "optimum": optimum,
                "validity": validity,
                "comparison": comparison,
                "validation": validation,
            }
            _refuse_beside_fleet(of_product)
            contents = fleet_sections(
                fleet, gather(model, labels=labels), decision, pictures=pictures
            )
            attrs = fleet["posterior"].attrs
            date = str(attrs.get("created_at", ""))[:10] if date is None else date
            note = _note(attrs, INTERVAL) if note is None else note
        elif not contents:
            material = gather(
                model, optimum, posterior, validity, comparison, decision, validation, labels
            )
            contents = sections_of(material, pictures=pictures)
            date = date_of(material) if date is None else date
            if note is None and material.results:
                note = _note(versions_of(material), material.prob)
        for section in contents:
            if not isinstance(section, Section):
                raise wrong_type(section, "Report: sections", "prb.reports.Section objects")
        vars(self).update(
            title=title, sections=contents, author=author, date=date or "", note=note or ""
        )

    def with_section(self, section: Section, *, after: str | None = None) -> Report:
        """Return a report with one more section.

        Parameters
        ----------
        section : Section
        after : str, optional
            Title of the section that it follows, with all its parts; at the end by default.

        Returns
        -------
        Report

        Raises
        ------
        TypeError
            If the section is no `Section`.
        KeyError
            If no section has that title.
        """
        if not isinstance(section, Section):
            raise wrong_value(section, "section", "a prb.reports.Section")
        place = len(self.sections)
        if after is not None:
            titles = [section.title for section in self.sections]
            if after not in titles:
                raise KeyError(f"after: got {after!r}, expected the title of a section: {titles}")
            # A new section of the same level follows all parts of the section before it.
            start = titles.index(after)
            highest = max(self.sections[start].level, section.level)
            behind = range(start + 1, place)
            place = next((i for i in behind if self.sections[i].level <= highest), place)
        sections = (*self.sections[:place], section, *self.sections[place:])
        return replace(self, sections=sections)

    def to_html(self, path: StrPath) -> Path:
        """Write one file with everything, for a browser and for print.

        A file of this name is replaced; it is kept if the new one cannot be written.

        Parameters
        ----------
        path : path-like

        Returns
        -------
        pathlib.Path

        Raises
        ------
        TypeError, ValueError
            If the path is none.
        OSError
            If the file cannot be written.
        """
        return _write(file_path(path, "path"), self._html(), {})

    def to_markdown(self, folder: StrPath) -> Path:
        """Write ``report.md`` into a folder, with pictures beside it.

        Files of these names are replaced, all of them or none.

        Parameters
        ----------
        folder : path-like

        Returns
        -------
        pathlib.Path
            That of ``report.md``.

        Raises
        ------
        TypeError, ValueError
            If the folder is none.
        OSError
            If a file cannot be written.
        """
        folder = folder_path(folder, "folder")
        files = []
        for i, section in enumerate(self.sections, 1):
            slug = re.sub(r"[^a-z0-9]+", "-", section.title.lower()).strip("-")[:40] or "picture"
            has_picture = section.picture is not None
            files.append(f"{i:02d}-{slug}.{section.kind}" if has_picture else None)
        template = _template("report.md.j2", autoescape=False)
        text = template.render(report=self, byline=self._byline, cells=cells, files=files)
        pictures = {
            folder / name: section.picture
            for section, name in zip(self.sections, files, strict=True)
            if name is not None and section.picture is not None
        }
        return _write(folder / "report.md", text.rstrip("\n") + "\n", pictures)

    @property
    def _byline(self) -> str:
        return ", ".join(filter(None, (self.author, self.date)))

    def _html(self) -> str:
        # The list of contents follows the summary, because that is a page of its own.
        chapters = [
            (i, section.title)
            for i, section in enumerate(self.sections, 1)
            if section.level == 2 and i > 1
        ]
        style = _template("report.css", autoescape=True).render(running=_in_css(self.title))
        rendered: str = _template("report.html.j2", autoescape=True).render(
            report=self,
            byline=self._byline,
            style=style,
            contents=chapters,
            front=chapters[0][0] - 1 if chapters else len(self.sections),
            cells=cells,
            kind_of=kind_of,
            is_broad=is_broad,
            base64=lambda picture: base64.b64encode(picture).decode("ascii"),
        )
        return rendered + "\n"

    def _repr_html_(self) -> str:
        """Show the report in a notebook, in a frame of its own."""
        text = html.escape(self._html(), quote=True)
        style = "width: 100%; height: 40rem; border: 0"
        return f'<iframe sandbox srcdoc="{text}" title="report" style="{style}"></iframe>'


def _refuse_beside_fleet(results: NamedValues) -> None:
    """Raise if a report of a whole fleet has results, by name, that belong to one product."""
    for name, result in results.items():
        if result is not None:
            raise ValueError(
                f"Report: {name}: got {called(result)} beside a whole fleet, expected posterior= "
                "and decision= alone; the report of a product is that of "
                "posterior=fleet.sel(product=...)"
            )


def _note(versions: Mapping[Any, Any], prob: float) -> str:
    """Return versions of packages, by their names, and the probability of intervals."""
    names = {"prbayes": "prbayes", "pymc": "PyMC", "arviz": "ArviZ"}
    parts = []
    for key, value in versions.items():
        name = names.get(str(key).removesuffix("_version"))
        parts += [f"{name} {value}"] if name else []
    return ", ".join([*parts, f"intervals of {percentage(prob)} probability"])


def _write(path: Path, text: str, pictures: Mapping[Path, bytes]) -> Path:
    """Write a document and its pictures, all or none of them."""
    path.parent.mkdir(parents=True, exist_ok=True)
    replace_files({**pictures, path: text.encode()}, "Report")
    return path


# -- templates -------------------------------------------------------------------------------


@cache
def _template(name: str, *, autoescape: bool) -> Any:
    """Return a template that shows all texts as they are: escaped for HTML, or for Markdown."""
    from jinja2 import Environment, PackageLoader, StrictUndefined
    from markupsafe import Markup

    def shown(value: Any) -> Any:
        if isinstance(value, Markup):
            return value
        if not autoescape:
            return _literal(value)
        return visible(value) if isinstance(value, str) else value

    environment = Environment(
        loader=PackageLoader("prbayes.reports"),
        autoescape=autoescape,
        finalize=shown,
        undefined=StrictUndefined,
    )
    return environment.get_template(name)


def _literal(value: Any) -> str:
    """Return a text, in one line, that Markdown shows as it is."""
    line = _MARKUP.sub(r"\\\1", " ".join(visible(str(value)).split()))
    line = _BARE_LINK.sub(r"\1\3\\\2\4", line)
    # Digits cannot be escaped: in '1.' the point is.
    start = _AT_START.match(line)
    if start is None:
        return line
    escaped = f"{start[0]}\\" if start[0].isdigit() else f"\\{start[0]}"
    return escaped + line[start.end() :]


def _in_css(text: str) -> str:
    """Return a text of at most 80 characters for a string of CSS (CSS 2.1, 4.1.3)."""
    line = " ".join(visible(text).split())
    if len(line) > 80:
        line = line[:79] + "…"
    plain = "abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789 "
    return "".join(c if c in plain else f"\\{ord(c):x} " for c in line)
