"""The report: its numbers are those of the results, both writers render the same, and nothing in it is executed."""

import base64
import dataclasses
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from functools import cache
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path
from typing import Any

import arviz as az
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pymc as pm
import pytest
import xarray as xr

import prbayes as prb
from prbayes.reports import illustrations
from prbayes.reports.section import cells, number, plus_minus

HOSTILE = ["<script>alert(1)", "a|b", "x & y &lt;", "**bold** [link](x) `code` $y$", "_it_ ![p](q)"]
VOID = {"meta", "img", "br", "hr", "link"}
OBSERVED = np.random.default_rng(3).normal(2.0, 0.6, 30)
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


@cache
def calibrated() -> tuple[Any, prb.Optimum, xr.DataTree, prb.ValidityTest]:
    with pm.Model() as model:
        mu = pm.Normal("mu", 1.5, 1)
        sigma = pm.HalfNormal("sigma", 1)
        pm.Deterministic("cv", sigma / mu)
        x = pm.Normal.dist(mu, sigma)
        prb.Simulator(
            "y", np.positive, x, metric=prb.KullbackLeibler(), observed=OBSERVED, specimens=np.arange(100, 130)
        )
    optimum = prb.minimize(model)
    posterior = prb.sample_smc(250, chains=2, model=model, optimum=optimum, random_seed=1, progressbar=False)
    later = prb.predict(posterior, np.positive, x, model=model, random_seed=1)
    fresh = np.random.default_rng(4).normal(2.0, 0.6, 12)
    return model, optimum, posterior, prb.area_test(fresh, later, null=prb.PosteriorNull(999))


@cache
def report() -> prb.Report:
    model, optimum, posterior, test = calibrated()
    return prb.Report("Shaft", model=model, optimum=optimum, posterior=posterior, validity=test, date="2 May 2024")


def section(of: prb.Report, title: str) -> prb.Section:
    return next(s for s in of.sections if s.title == title)


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


@cache
def page() -> Page:
    return Page(report()._html())


def row(first: str, header: str, of: Page) -> dict[str, str]:
    """Return the row that begins with a text, of the table with that column."""
    found: dict[str, str] = {}
    names: list[str] = []
    for cells_ in of.rows:
        if header in cells_:
            names = cells_
        elif names and len(cells_) == len(names) and cells_[0] == first and not found:
            found = dict(zip(names, cells_, strict=True))
    assert found, f"no row {first} with {header}"
    return found


# -- content: numbers are those of the results -----------------------------------------------------------


def test_sections_come_in_order() -> None:
    titles = [s.title for s in report().sections if s.level == 2]
    assert titles == [
        "Summary", "Model", "Data", "Metric and epsilon", "Optimum", "Posterior", "Comparison", "Diagnostics",
        "Validity", "Cost and origin",
    ]  # fmt: skip
    assert page().text("h1") == "Shaft"
    assert "2 May 2024" in page().text("p")


def test_model_and_data() -> None:
    assert row("mu", "distribution", page())["distribution"] == "Normal(1.5, 1)"
    assert row("cv", "distribution", page()) == {
        "variable": "cv", "role": "deterministic", "distribution": "computed from sigma, mu",
    }  # fmt: skip
    assert row("y", "inputs", page())["inputs"] == "Normal(mu, sigma)"
    data = row("y", "smallest", page())
    assert data["N"] == "30"
    found = [float(data[key]) for key in ("smallest", "largest", "mean", "sd")]
    expected = [OBSERVED.min(), OBSERVED.max(), OBSERVED.mean(), OBSERVED.std(ddof=1)]
    np.testing.assert_allclose(found, expected, atol=5.1e-4)
    assert "y: 30 specimens: 100, 101" in " ".join(section(report(), "Data").text)


def test_metric_and_epsilon() -> None:
    _, optimum, posterior, _ = calibrated()
    table = row("posterior", "epsilon", page())
    calibration = posterior["calibration"]
    assert float(table["epsilon"]) == pytest.approx(float(calibration["epsilon"][0]), rel=1e-3)
    assert float(table["discrepancy"]) == pytest.approx(float(calibration["discrepancy"].mean()), rel=1e-3)
    assert float(row("optimum", "epsilon", page())["discrepancy"]) == pytest.approx(optimum.discrepancy, rel=1e-3)
    assert any(p.startswith("y: KullbackLeibler(") for p in section(report(), "Metric and epsilon").text)


def test_optimum() -> None:
    _, optimum, _, _ = calibrated()
    for name in ("mu", "sigma", "cv"):
        found = row(name, "standard error", page())
        assert float(found["standard error"]) == pytest.approx(optimum.stderr[name], rel=6e-3)
        assert float(found["estimate"]) == pytest.approx(optimum.point[name], abs=optimum.stderr[name] * 6e-3)
    assert f"after {optimum.n_evaluations} evaluations" in " ".join(section(report(), "Optimum").text)


def test_posterior() -> None:
    _, _, posterior, _ = calibrated()
    summary = az.summary(posterior, ci_prob=0.89, ci_kind="eti", round_to="none")
    for name in ("mu", "sigma", "cv"):
        found, exact = row(name, "R-hat", page()), summary.loc[name]
        draws = posterior["posterior"][name].values
        low, high = np.quantile(draws, [0.055, 0.945])
        for key, value in (("mean", draws.mean()), ("sd", draws.std(ddof=1)), ("89% from", low), ("to", high)):
            assert float(found[key]) == pytest.approx(value, abs=exact["sd"] * 6e-3)
        assert float(found["ESS, bulk"]) == pytest.approx(exact["ess_bulk"], abs=0.6)
        assert float(found["ESS, tail"]) == pytest.approx(exact["ess_tail"], abs=0.6)
        assert float(found["R-hat"]) == pytest.approx(exact["r_hat"], abs=6e-4)
        assert float(found["error of mean"]) == pytest.approx(exact["mcse_mean"], rel=0.06)


def test_comparison() -> None:
    model, optimum, posterior, _ = calibrated()
    table = prb.compare({"optimum": optimum, "posterior": posterior}, model=model)
    rows = [r for r in page().rows if len(r) == 7 and r[0] in {"mu", "sigma"} and r[1] in {"optimum", "posterior"}]
    assert [r[:2] for r in rows] == [[h, r] for h in ("mu", "sigma") for r in ("optimum", "posterior")]
    for name, label, *values in rows:
        own = table.sel(hyperparameter=name, result=label)
        for value, key in zip(values, ("estimate", "sd", "lower", "upper"), strict=False):
            assert float(value) == pytest.approx(float(own[key]), abs=float(own["sd"]) * 6e-3)
        assert float(values[4]) == pytest.approx(float(own["shift"]), abs=0.006)
    for key in ("ProbabilityResidual", "KullbackLeibler", "AreaMetric", "LogLikelihood"):
        scores = row(key, "under the metric", page())
        for label in ("optimum", "posterior"):
            assert float(scores[label]) == pytest.approx(float(table[key].sel(result=label)), rel=1e-3)


def test_saved_optima_compare_as_they_do_in_memory() -> None:
    _, optimum, _, _ = calibrated()
    table = prb.compare({"memory": optimum, "saved": optimum.to_datatree()})
    for key in ("estimate", "sd", "lower", "upper"):
        np.testing.assert_array_equal(*table[key].values)
    mu = table.sel(hyperparameter="mu", result="saved")
    np.testing.assert_allclose(float(mu["upper"]), optimum.point["mu"] + 1.59819 * optimum.stderr["mu"], rtol=1e-5)
    assert table["n_responses"].values.tolist() == [optimum.n_responses] * 2


def test_diagnostics_are_those_of_diagnose() -> None:
    model, _, posterior, _ = calibrated()
    text = " ".join(section(report(), "Diagnostics").text)
    found = prb.diagnose(posterior, model=model)
    assert all(message in text for message in found.messages)
    support = row("posterior", "weight ESS, 5%", page())
    assert float(support["median"]) == pytest.approx(float(found.support["weight_ess"].median()), abs=0.6)
    stats = posterior["sample_stats"]
    stages = (~np.isnan(stats["beta"].values)).sum(axis=1)
    span = str(stages[0]) if stages[0] == stages[1] else f"{stages.min()} to {stages.max()}"
    assert f"in {span} stages" in text
    last = [float((stats["accept_rate"] * stats["n_steps"])[i, n - 1]) for i, n in enumerate(stages)]
    moved = re.findall(r"each particle moved ([\d.]+)(?: to ([\d.]+))? times", text)[0]
    assert float(moved[0]) == pytest.approx(min(last), abs=0.06)
    assert float(moved[1] or moved[0]) == pytest.approx(max(last), abs=0.06)
    evidence = posterior["posterior"].attrs["log_marginal_likelihood"]
    assert float(re.findall(r"log marginal likelihood (-?[\d.]+)", text)[0]) == pytest.approx(evidence, abs=0.06)


def test_problems_are_counted_in_the_summary() -> None:
    posterior = calibrated()[2].copy(deep=True)
    posterior["posterior"]["mu"][0] += 5.0
    bad = prb.Report("x", posterior=posterior, pictures=False)
    assert any("R-hat" in p for p in section(bad, "Diagnostics").text)
    assert any("problem" in p and "found no problem" not in p for p in bad.sections[0].text)
    posterior["posterior"].attrs["warnings"] = "the data do not see mu"
    again = prb.Report("x", posterior=posterior, pictures=False)
    assert "Posterior: The data do not see mu." in section(again, "Diagnostics").text


def test_validity() -> None:
    test = calibrated()[3]
    found = row("area test", "verdict", page())
    assert float(found["area"]) == pytest.approx(test.statistic, abs=6e-5)
    assert float(found["critical value"]) == pytest.approx(test.critical_value, abs=6e-5)
    assert float(found["p-value"]) == pytest.approx(test.p_value, abs=6e-4)
    assert found["verdict"] == ("rejected" if test.rejected else "not rejected")
    rejected = dataclasses.replace(test, p_value=0.01, statistic=0.4)
    both = prb.Report("x", validity={"early": test, "late": rejected})
    assert [s.title for s in both.sections] == ["Summary", "Validity", "Distribution of the u-values"]
    assert [("is rejected" in p, p.split(":")[0]) for p in both.sections[0].text] == [(False, "early"), (True, "late")]
    assert [r[-1] for r in cells(both.sections[1].table).rows] == ["not rejected", "rejected"]


def test_the_summary_has_the_answer() -> None:
    _, _, posterior, _ = calibrated()
    text = " ".join(report().sections[0].text)
    for name in ("mu", "sigma"):
        mean, sd = map(float, re.findall(rf"{name} = (-?[\d.]+) ± ([\d.]+)", text)[0])
        draws = posterior["posterior"][name].values
        assert sd == pytest.approx(draws.std(ddof=1), rel=0.06)
        assert mean == pytest.approx(draws.mean(), abs=0.06 * sd)
    assert "cv =" not in text, "a deterministic is no hyperparameter"
    assert "2 hyperparameters (mu, sigma) of the model were calibrated on 30 measured responses of y" in text
    assert "by the Kullback-Leibler divergence" in text
    assert "not rejected at level 5%" in text


def test_origin() -> None:
    _, optimum, posterior, _ = calibrated()
    attrs = posterior["posterior"].attrs
    found = row("posterior", "seed", page())
    assert (found["seed"], found["responses"]) == ("1", str(attrs["n_responses"]))
    assert float(found["seconds"]) == pytest.approx(attrs["seconds"], abs=0.51)
    assert row("optimum", "seed", page())["responses"] == str(optimum.n_responses)
    assert f"pymc {attrs['pymc_version']}" in page().text("p")


def test_what_is_not_given_is_left_out() -> None:
    model, optimum, posterior, test = calibrated()
    have = {
        "model": prb.Report("x", model=model, pictures=False),
        "optimum": prb.Report("x", optimum=optimum, pictures=False),
        "posterior": prb.Report("x", posterior=posterior, pictures=False),
        "validity": prb.Report("x", validity=test, pictures=False),
    }
    titles = {k: {s.title for s in r.sections if s.level == 2} for k, r in have.items()}
    assert titles["model"] == {"Summary", "Model", "Data", "Metric and epsilon"}
    assert "No result of a calibration was given." in have["model"].sections[0].text[0]
    assert titles["validity"] == {"Summary", "Validity"}
    assert {"Posterior", "Comparison", "Validity"}.isdisjoint(titles["optimum"])
    assert {"Optimum", "Comparison", "Validity"}.isdisjoint(titles["posterior"])


def test_several_simulators_and_vectors(tmp_path: Path) -> None:
    with pm.Model(coords={"part": ["shaft", "disk"]}) as model:
        mu = pm.Normal("mu", 1, 1, dims="part")
        k = pm.HalfNormal("k", 1)
        x = pm.Normal.dist(mu[0], 1.0)
        z = pm.Normal.dist(mu[1], k)
        prb.Simulator("first", np.positive, x, metric=prb.AreaMetric(), observed=[0.1, 1.0, 2.0, 2.2])
        prb.Simulator("second", np.positive, z, metric=prb.KullbackLeibler(), observed=[0.0, 1.0, 3.0])
    optimum = prb.minimize(model)
    made = prb.Report("x", model=model, optimum=optimum, pictures=False)
    data = cells(section(made, "Data").table)
    assert [r[:2] for r in data.rows] == [("first", "4"), ("second", "3")]
    assert [r[0] for r in cells(section(made, "Optimum").table).rows] == ["mu[0]", "mu[1]", "k"]
    assert [p for p in section(made, "Metric and epsilon").text if p.startswith("first: AreaMetric(")]
    Page(made._html())
    made.to_markdown(tmp_path)


def test_bootstrap_and_other_samplers() -> None:
    model, optimum, _, _ = calibrated()
    boot = prb.bootstrap(optimum, 60)
    made = prb.Report("x", posterior={"bootstrap": boot}, pictures=False)
    assert "not looked at, because that needs the model" in section(made, "Diagnostics").text[0]
    assert cells(section(made, "Posterior").table).rows[0][0] == "mu"
    with_model = prb.Report("x", model=model, posterior={"bootstrap": boot}, optimum=optimum, pictures=False)
    assert "bootstrap" in {r[1] for r in cells(section(with_model, "Comparison").table).rows}


# -- from files alone ------------------------------------------------------------------------------------


def test_files_alone_tell_the_same(tmp_path: Path) -> None:
    model, optimum, posterior, _ = calibrated()
    posterior.to_netcdf(tmp_path / "p.nc", engine="h5netcdf")
    optimum.to_datatree().to_netcdf(tmp_path / "o.nc", engine="h5netcdf")
    trees = [xr.open_datatree(tmp_path / f, engine="h5netcdf").load() for f in ("p.nc", "o.nc")]
    alone = prb.Report("Shaft", posterior=trees[0], optimum=trees[1])
    full = prb.Report("Shaft", posterior=posterior, optimum=optimum, model=model)
    for title in ("Summary", "Model", "Simulators", "Data", "Optimum", "Posterior", "Comparison", "Cost and origin"):
        a, b = section(alone, title), section(full, title)
        assert a.text == b.text, title
        if a.table is not None:
            assert cells(a.table) == cells(b.table), title
    assert "Graph" not in [s.title for s in alone.sections]
    del trees[0]["posterior"].attrs["model"]
    without = prb.Report("Shaft", posterior=trees[0], pictures=False)
    assert "Model" not in [s.title for s in without.sections]
    assert "Posterior" in [s.title for s in without.sections]


@pytest.mark.parametrize("text", ["{", "[]", "3", '{"variables": 4}', '{"variables": [{"name": 1}], "simulators": []}'])
def test_damaged_descriptions_are_ignored(text: str) -> None:
    posterior = calibrated()[2].copy()
    posterior["posterior"].attrs["model"] = text
    titles = [s.title for s in prb.Report("x", posterior=posterior, pictures=False).sections]
    assert "Model" not in titles
    assert "Posterior" in titles


# -- writers ---------------------------------------------------------------------------------------------


def hostile() -> prb.Report:
    table = pd.DataFrame({"what | <b>": HOSTILE, "n": [1.0, 2.5, np.nan, np.inf, -1e-7]})
    return prb.Report(
        HOSTILE[0],
        sections=(
            prb.Section(
                HOSTILE[3], tuple(HOSTILE), table, picture_bytes(), alt='"><script>alert(2)', caption=HOSTILE[1]
            ),
            prb.Section(
                "# - 1. start", ["# no heading", "- no item", "1. no list", "---", "-4.5 is a number"], level=3
            ),
        ),
        author="<i>A & B",
    )


@cache
def picture_bytes() -> bytes:
    figure, axis = plt.subplots()
    axis.plot([1, 2, 3])
    made = prb.Section("p", picture=figure, alt="A line.").picture
    assert plt.fignum_exists(figure.number), "the user's own figure is left open"
    plt.close(figure)
    assert isinstance(made, bytes)
    return made


def test_hostile_names_are_text_in_html() -> None:
    text = hostile()._html()
    found = Page(text)
    assert "<script" not in text.lower()
    assert {"script", "i", "b"}.isdisjoint(tag for tag, _ in found.tags)
    assert found.text("h1") == found.text("title") == HOSTILE[0]
    assert [r[0] for r in found.rows if r][1:] == HOSTILE
    assert [a["alt"] for tag, a in found.tags if tag == "img"] == ['"><script>alert(2)']
    numbers = [r[1].strip("\u2007\u2008") for r in found.rows][1:]
    assert numbers == ["1.000", "2.500", "–", "∞", "-1.000e-07"]  # noqa: RUF001


def test_hostile_names_are_text_in_markdown(tmp_path: Path) -> None:
    text = hostile().to_markdown(tmp_path).read_text(encoding="utf-8")
    lines = text.splitlines()
    assert lines[0] == r"# \<script\>alert(1)"
    rows = [line for line in lines if line.startswith("|")]
    assert {len(re.findall(r"(?<!\\)\|", line)) for line in rows} == {3}, "each row has two cells"
    unescaped = [re.sub(r"\\(.)", r"\1", line[2:].rsplit(" | ", 1)[0]) for line in rows[2:]]
    assert unescaped == HOSTILE
    assert not re.search(r"(?<!\\)<", text)
    assert not re.search(r"(?<!\\)&", text)
    assert not re.search(r"(?<!\\)\*\*", text)
    for expected in (r"\# no heading", r"\- no item", r"1\. no list", r"\---", "-4.5 is a number"):
        assert expected in lines
    assert re.search(r"^!\[.*\]\(01-[a-z-]+\.svg\)$", text, re.M)


def test_a_hostile_model_is_reported() -> None:
    for name in ("<b>x<b>", "a|b", "p & q"):
        with pm.Model() as model:
            x = pm.Normal.dist(pm.Normal(name, 0, 2), 1.0)
            prb.Simulator("y", lambda x: 2 * x, x, metric=prb.AreaMetric(), observed=[0.0, 2.0, 4.0])
        text = prb.Report(name, model=model)._html()
        assert row(name, "distribution", Page(text))["distribution"] == "Normal(0, 2)"
        assert "<b>" not in text


def test_the_same_input_gives_the_same_bytes(tmp_path: Path) -> None:
    model, optimum, posterior, test = calibrated()
    made = [prb.Report("S", model=model, optimum=optimum, posterior=posterior, validity=test) for _ in range(2)]
    first, second = (r.to_html(tmp_path / f"{i}" / "r.html").read_bytes() for i, r in enumerate(made))
    assert first == second
    folders = [r.to_markdown(tmp_path / f"md{i}").parent for i, r in enumerate(made)]
    files = [sorted(p.name for p in f.iterdir()) for f in folders]
    assert files[0] == files[1]
    assert all((folders[0] / n).read_bytes() == (folders[1] / n).read_bytes() for n in files[0])
    assert not re.search(rb"20[2-9]\d-\d\d-\d\d", first), "no date was given"


def test_html_stands_alone_and_is_accessible() -> None:
    found = page()
    assert {"script", "link", "iframe", "object"}.isdisjoint(tag for tag, _ in found.tags)
    for tag, attrs in found.tags:
        for key in ("src", "href"):
            if key in attrs:
                assert re.match(r"data:image/|#s\d+$", attrs[key] or ""), (tag, attrs[key])
        assert not any(key.startswith("on") for key in attrs)
    css = found.text("style")
    assert "url(" not in css
    assert "@import" not in css
    assert "@media print" in css
    assert dict(found.tags)["html"] == {"lang": "en"}
    images = [a for tag, a in found.tags if tag == "img"]
    assert images
    assert all(a["alt"] for a in images)
    assert all(a.get("scope") in {"col", "row"} for tag, a in found.tags if tag == "th")
    ids = [a["id"] for _, a in found.tags if "id" in a]
    assert len(ids) == len(set(ids))
    targets = [a["href"] for tag, a in found.tags if tag == "a"]
    assert targets
    assert {(t or "")[1:] for t in targets} <= set(ids)
    levels = [int(tag[1]) for tag, _ in found.tags if re.fullmatch(r"h\d", tag)]
    assert levels[0] == 1
    assert max(b - a for a, b in pairwise(levels)) <= 1


def test_both_writers_render_the_same_data(tmp_path: Path) -> None:
    folder = report().to_markdown(tmp_path / "md").parent
    text = (folder / "report.md").read_text(encoding="utf-8")
    lines = [re.sub(r"\\(.)", r"\1", line) for line in text.splitlines()]
    assert [line.lstrip("# ") for line in lines if line.startswith("#")][1:] == [s.title for s in report().sections]
    table_rows = [line for line in lines if line.startswith("| ") and "---" not in line]
    shown = [[c.strip("\u2007\u2008") for c in r] for r in page().rows]
    assert [f"| {' | '.join(r)} |" for r in shown] == table_rows
    files = [m[1] for m in re.finditer(r"\]\(([^)]+\.svg)\)", text)]
    sources = [a["src"] or "" for tag, a in page().tags if tag == "img"]
    assert len(files) == len(sources) > 0
    for name, source in zip(files, sources, strict=True):
        assert base64.b64decode(source.partition(",")[2]) == (folder / name).read_bytes()
    for paragraph in (p for s in report().sections for p in s.text):
        assert paragraph in lines
        assert paragraph in page().text("p")


def test_a_section_of_the_users_own(tmp_path: Path) -> None:
    mine = prb.Section("Material", "Al 2024-T3.", xr.Dataset({"E": ("batch", [70.1, 71.25])}, {"batch": ["A", "B"]}))
    more = report().with_section(mine, after="Data")
    titles = [s.title for s in more.sections]
    assert titles.index("Material") == titles.index("Metric and epsilon") - 1
    assert len(more.sections) == len(report().sections) + 1
    assert more.date == report().date
    for text in (more._html(), more.to_markdown(tmp_path).read_text(encoding="utf-8")):
        assert "Al 2024-T3." in text
        assert "71.25" in text
    assert row("B", "E", Page(more._html()))["E"] == "71.25"
    assert report().with_section(mine).sections[-1] is mine
    part = dataclasses.replace(mine, title="Part", level=3)
    inside = report().with_section(part, after="Model").sections
    assert [s.title for s in inside][:4] == ["Summary", "Model", "Part", "Simulators"]
    few = dataclasses.replace(report(), title="Two", sections=report().sections[:2])
    assert [s.title for s in few.sections] == ["Summary", "Model"]
    with pytest.raises(KeyError, match="expected the title of a section"):
        report().with_section(mine, after="Nothing")


def test_notebooks_show_a_frame() -> None:
    text = report()._repr_html_()
    assert text.startswith("<iframe sandbox srcdoc=")
    assert text.count("<") == 2


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (1.0, "1.000"), (0.0196512, "0.01965"), (-123456.7, "-123457"), (1024.0, "1024"), (3, "3"), (True, "yes"),
        (np.float32(0.5), "0.5000"), (1.23456e-9, "1.235e-09"), (4.2e9, "4.200e+09"), (np.nan, "\u2013"), (0.0, "0"),
        (-np.inf, "-∞"), ("a", "a"), (None, "\u2013"), (9.99996, "10.000"),
    ],
)  # fmt: skip
def test_numbers(value: Any, text: str) -> None:
    assert number(value) == text


@pytest.mark.parametrize(
    ("value", "sd", "text"),
    [
        (1.1494, 0.0532, "1.149 ± 0.053"), (210_345.0, 1234.0, "210345 ± 1234"), (0.5, 0.0996, "0.50 ± 0.10"),
        (2.0, np.nan, "2.000"), (1.0, np.inf, "1.000 ± ∞"), (-0.0001, 0.1, "-0.00 ± 0.10"),
    ],
)  # fmt: skip
def test_estimates_have_the_decimals_of_their_spread(value: float, sd: float, text: str) -> None:
    assert plus_minus(value, sd) == text


def test_decimal_points_stand_in_line() -> None:
    table = cells(pd.DataFrame({"x": ["1.5", "10.25", "3", "\u2013"], "s": ["a", "b", "c", "d"]}))
    assert table.numeric == (True, False)
    padded = [r[0] for r in table.aligned()]
    assert padded == ["1.5\u2007", "10.25", "3\u2008\u2007\u2007", "\u2013"]


def test_refusals() -> None:
    _, optimum, posterior, test = calibrated()
    for keywords, match in (
        ({"model": 3}, r"expected a pm\.Model"),
        ({"posterior": optimum}, "group posterior"),
        ({"optimum": posterior}, "group optimum"),
        ({"validity": posterior}, "ValidityTest"),
        ({"comparison": 3}, r"prb\.compare"),
        ({"sections": ("a",)}, r"prb\.Section"),
        ({"optimum": {"a": optimum}, "posterior": {"a": posterior}}, "different ones"),
    ):
        with pytest.raises((TypeError, ValueError), match=match):
            prb.Report("x", **keywords)
    for title in ("", 3):
        with pytest.raises(TypeError, match="expected a text"):
            prb.Report(title, validity=test)  # type: ignore[arg-type]
    for keywords, match in (
        ({"table": [1, 2]}, r"expected a pandas\.DataFrame"),
        ({"picture": b"GIF89a", "alt": "x"}, "expected SVG, PNG or JPEG"),
        ({"picture": 3, "alt": "x"}, "savefig"),
        ({"picture": b"\x89PNG\r\n"}, "alt: got nothing"),
        ({"text": (3,)}, "expected a text"),
        ({"level": 1}, "expected 2, or 3"),
    ):
        with pytest.raises((TypeError, ValueError), match=match):
            prb.Section("x", **keywords)


# -- pictures --------------------------------------------------------------------------------------------


def test_pictures_close_their_figures_and_leave_settings_alone() -> None:
    own = plt.figure()
    before, settings = plt.get_fignums(), dict(mpl.rcParams)
    backend = az.rcParams["plot.backend"]
    prb.Report("x", validity=calibrated()[3])
    assert plt.get_fignums() == before
    assert dict(mpl.rcParams) == settings
    assert az.rcParams["plot.backend"] == backend
    plt.close(own)


def drawn_by(monkeypatch: pytest.MonkeyPatch, functions: dict[str, Any]) -> None:
    """Put other functions in the place of some pictures, by name."""
    table = illustrations.ILLUSTRATIONS
    new = tuple(replace(i, function=functions.get(i.function.__name__, i.function)) for i in table)
    monkeypatch.setattr(illustrations, "ILLUSTRATIONS", new)


def test_a_picture_that_fails_leaves_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: Any, **__: Any) -> None:
        plt.figure()
        raise ValueError("three hyperparameters")

    drawn_by(monkeypatch, {"plot_validity": fails})
    before = plt.get_fignums()
    made = prb.Report("x", validity=calibrated()[3])
    assert made.sections[-1].text == ("This picture could not be made: three hyperparameters",)
    assert made.sections[-1].picture is None
    assert plt.get_fignums() == before


def test_each_illustration_gets_what_it_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    """On results in memory and on files."""
    model, optimum, posterior, test = calibrated()
    called: dict[str, tuple[Any, ...]] = {}

    class Picture:
        def savefig(self, path: Path, **_: Any) -> None:
            path.write_bytes(b"<svg/>")

    def drawn(name: str) -> Any:
        def made(*arguments: Any, **keywords: Any) -> Picture:
            called[name] = (*arguments, *keywords.values())
            return Picture()

        return made

    names = {i.function.__name__ for i in illustrations.ILLUSTRATIONS}
    drawn_by(monkeypatch, {name: drawn(name) for name in names})
    full = prb.Report("x", model=model, optimum=optimum, posterior=posterior, validity=test)
    assert set(called) == names
    assert called["plot_responses"] == called["plot_population"] == (posterior, model)
    assert called["plot_posterior"] == (posterior, optimum, model)
    assert called["plot_optimizer"] == (optimum, 2)
    assert called["plot_landscape"] == (optimum, model)
    assert called["plot_validity"] == (test,)
    titles = [s.title for s in full.sections]
    for illustration in illustrations.ILLUSTRATIONS:
        parent = [s.title for s in full.sections[: titles.index(illustration.title)] if s.level == 2][-1]
        assert parent == illustration.after
    called.clear()
    prb.Report("x", posterior=posterior, optimum=optimum.to_datatree())
    assert set(called) == {"plot_posterior", "plot_stages", "plot_comparison"}


def test_a_report_computes_no_response(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn_by(monkeypatch, {"plot_responses": lambda *_, **__: pytest.fail("drawn")})
    calls = 0

    def response(x: Any) -> Any:
        nonlocal calls
        calls += np.size(x)
        return 2 * x

    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
        once = prb.Resimulated(64)
        prb.Simulator("y", response, x, metric=prb.AreaMetric(), observed=[0.0, 2.0, 4.0], propagation=once)
    optimum = prb.minimize(model)
    before, counted = calls, optimum.evaluator.n_responses
    made = prb.Report("x", model=model, optimum=optimum)
    assert (calls, optimum.evaluator.n_responses) == (before, counted)
    assert "PyMC would compute responses" in section(made, "Graph").text[0]
    text = section(made, "Measured and calibrated responses").text
    assert text == ("This picture could not be made: it would compute responses anew; call prb.plot_responses for it",)


@pytest.mark.parametrize("lacking", ["package", "program"])
def test_without_graphviz_a_sentence_says_so(lacking: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    if lacking == "package":
        monkeypatch.setitem(sys.modules, "graphviz", None)
    else:
        monkeypatch.setenv("PATH", str(tmp_path))
    found = section(prb.Report("x", model=calibrated()[0]), "Graph")
    assert found.picture is None
    assert {"package": "no Python package graphviz", "program": "no program dot"}[lacking] in found.text[0]


def test_the_graph_shows_the_variables() -> None:
    if shutil.which("dot") is None:
        pytest.skip("the program dot of Graphviz is not installed")
    found = section(report(), "Graph")
    assert all(f">{name}</text>".encode() in found.picture for name in ("mu", "sigma", "y", "Simulator"))


# -- in a browser ----------------------------------------------------------------------------------------


def browse(folder: Path, *options: str) -> str:
    if CHROMIUM is None:
        pytest.skip("no Chromium is installed")
    command = [
        CHROMIUM,
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        f"--user-data-dir={folder / 'profile'}",
        *options,
    ]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=120).stdout


def test_a_browser_shows_it(tmp_path: Path) -> None:
    path = report().to_html(tmp_path / "report.html")
    picture = tmp_path / "screen.png"
    browse(tmp_path, "--window-size=1000,1400", f"--screenshot={picture}", path.as_uri())
    pixels = plt.imread(picture)[..., :3]
    assert pixels.shape[:2] == (1400, 1000)
    assert 0.02 < (pixels.min(axis=2) < 0.9).mean() < 0.6
    pdf = tmp_path / "report.pdf"
    browse(tmp_path, f"--print-to-pdf={pdf}", "--no-pdf-header-footer", path.as_uri())
    assert pdf.read_bytes().startswith(b"%PDF-")
    assert 3 <= len(re.findall(rb"/Type\s*/Page\b", pdf.read_bytes())) <= 12


@pytest.mark.parametrize("width", [375, 1000])
def test_a_browser_needs_no_sideways_scrolling(width: int, tmp_path: Path) -> None:
    """In a frame of a phone's width, with a page around it that measures."""
    path = report().to_html(tmp_path / "report.html")
    outer = tmp_path / "outer.html"
    outer.write_text(
        f'<iframe src="report.html" style="width: {width}px; height: 900px; border: 0"></iframe><script>'
        'const f = document.querySelector("iframe"); f.onload = () => { const d = f.contentDocument; document.title = '
        '[d.documentElement.scrollWidth - d.documentElement.clientWidth, d.querySelector("h1").innerText, '
        '[...d.images].every(i => i.naturalWidth > 0 && i.complete)].join(";"); }</script>'
    )
    dom = browse(tmp_path, "--allow-file-access-from-files", "--virtual-time-budget=5000", "--dump-dom", outer.as_uri())
    found = re.findall(r"<title>(.*?)</title>", dom)
    assert found == ["0;Shaft;true"]
    assert path.stat().st_size < 2_000_000
