"""Results and a report of a small calibration, made once, and what reads them."""

from __future__ import annotations

from collections.abc import Callable
from html.parser import HTMLParser
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
import pymc as pm
import pytest
import xarray as xr
from one_input import one_input

import prbayes as prb

OBSERVED = np.random.default_rng(3).normal(2.0, 0.6, 30)
VOID = {"meta", "img", "br", "hr", "link"}


class Calibrated(NamedTuple):
    model: pm.Model
    optimum: prb.Optimum
    posterior: xr.DataTree
    test: prb.validation.ValidityTest


@pytest.fixture(scope="session")
def observed() -> Any:
    return OBSERVED


def same(x: Any) -> Any:
    """Return the input; NumPy's own functions have no names of arguments before NumPy 2.4."""
    return np.positive(x)


@pytest.fixture(scope="session")
def calibrated() -> Calibrated:
    metric, few, labels = prb.KullbackLeibler(), prb.Reweighted(256), np.arange(100, 130)
    with one_input(OBSERVED, metric, few, same, mu=(1.5, 1), specimens=labels) as model:
        pm.Deterministic("cv", model["sigma"] / model["mu"])
    optimum = prb.minimize(model, starts=0)
    posterior = prb.sample_smc(
        150, chains=2, model=model, optimum=optimum, random_seed=1, progressbar=False
    )
    x = pm.Normal.dist(model["mu"], model["sigma"])
    later = prb.predict(posterior, same, x, model=model, random_seed=1)
    fresh = np.random.default_rng(4).normal(2.0, 0.6, 12)
    test = prb.area_test(fresh, later, null=prb.validation.PosteriorNull(199))
    return Calibrated(model, optimum, posterior, test)


@pytest.fixture(scope="session")
def report(calibrated: Calibrated) -> prb.Report:
    model, optimum, posterior, test = calibrated
    return prb.Report(
        "Shaft",
        model=model,
        optimum=optimum,
        posterior=posterior,
        validity=test,
        date="2 May 2024",
    )


class Page(HTMLParser):
    """Check that tags are balanced; collect texts of cells, headings, attributes."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.texts: list[tuple[str, str]] = []
        self.rows: list[list[str]] = []
        self.feed(text)
        self.close()
        assert self.open == [], f"never closed: {self.open}"

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)
        if tag == "tr":
            self.rows.append([])
        if tag in {"td", "th"}:
            self.rows[-1].append("")

    def handle_endtag(self, tag: str) -> None:
        assert self.open
        assert self.open.pop() == tag, f"</{tag}> closes another tag"

    def handle_data(self, data: str) -> None:
        if self.open:
            self.texts.append((self.open[-1], data))
            if self.open[-1] in {"td", "th"}:
                self.rows[-1][-1] += data.strip()

    def text(self, *tags: str) -> str:
        return " ".join(data.strip() for tag, data in self.texts if tag in tags)


@pytest.fixture(scope="session")
def parse() -> Callable[[str], Page]:
    return Page


@pytest.fixture(scope="session")
def page(report: prb.Report) -> Page:
    return Page(report._html())


@pytest.fixture(scope="session")
def row() -> Callable[[str, str, Page], dict[str, str]]:
    """Return the row that begins with a text, of the table with that column."""

    def find(first: str, header: str, of: Page) -> dict[str, str]:
        found: dict[str, str] = {}
        names: list[str] = []
        for cells in of.rows:
            if header in cells:
                names = cells
            elif names and len(cells) == len(names) and cells[0] == first and not found:
                found = dict(zip(names, cells, strict=True))
        assert found, f"no row {first} with {header}"
        return found

    return find


@pytest.fixture(scope="session")
def section() -> Callable[[prb.Report, str], prb.reports.Section]:
    def find(of: prb.Report, title: str) -> prb.reports.Section:
        return next(s for s in of.sections if s.title == title)

    return find


@pytest.fixture(scope="session")
def picture_bytes() -> bytes:
    figure, axis = plt.subplots()
    axis.plot([1, 2, 3])
    made = prb.reports.Section("p", picture=figure, alt="A line.").picture
    assert plt.fignum_exists(figure.number), "the user's own figure is left open"
    plt.close(figure)
    assert isinstance(made, bytes)
    return made
