"""The report: both writers render the same, and nothing in it is executed."""

import base64
import dataclasses
import re
import shutil
import subprocess
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import xarray as xr

import prbayes as prb

HOSTILE = ["<script>alert(1)", "a|b", "x & y &lt;", "**bold** [link](x) `code` $y$", "_it_ ![p](q)"]
CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)


@pytest.fixture(scope="module")
def hostile(picture_bytes: bytes) -> prb.Report:
    table = pd.DataFrame({"what | <b>": HOSTILE, "n": [1.0, 2.5, np.nan, np.inf, -1e-7]})
    picture = {"picture": picture_bytes, "alt": '"><script>alert(2)', "caption": HOSTILE[1]}
    starts = ["# no heading", "- no item", "1. no list", "---", "-4.5 is a number"]
    sections = (
        prb.reports.Section(HOSTILE[3], tuple(HOSTILE), table, **picture),
        prb.reports.Section("# - 1. start", starts, level=3),
    )
    return prb.Report(HOSTILE[0], sections=sections, author="<i>A & B")


def test_hostile_names_are_text_in_html(parse: Any, hostile: prb.Report) -> None:
    text = hostile._html()
    found = parse(text)
    assert "<script" not in text.lower()
    assert {"script", "i", "b"}.isdisjoint(tag for tag, _ in found.tags)
    assert found.text("h1") == found.text("title") == HOSTILE[0]
    assert [r[0] for r in found.rows if r][1:] == HOSTILE
    assert [a["alt"] for tag, a in found.tags if tag == "img"] == ['"><script>alert(2)']
    numbers = [r[1].strip("\u2007\u2008") for r in found.rows][1:]
    assert numbers == ["1.000", "2.500", "–", "∞", "-1.000e-07"]  # noqa: RUF001


def test_hostile_names_are_text_in_markdown(tmp_path: Path, hostile: prb.Report) -> None:
    text = hostile.to_markdown(tmp_path).read_text(encoding="utf-8")
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


@pytest.mark.long
def test_the_same_input_gives_the_same_bytes(
    tmp_path: Path, calibrated: Any, report: prb.Report
) -> None:
    model, optimum, posterior, test = calibrated
    results: Any = {"model": model, "optimum": optimum, "posterior": posterior}
    again = prb.Report("Shaft", **results, validity=test, date="2 May 2024")
    first, second = (
        r.to_html(tmp_path / f"{i}" / "r.html").read_bytes() for i, r in enumerate((report, again))
    )
    assert first == second
    folders = [r.to_markdown(tmp_path / f"md{i}").parent for i, r in enumerate((report, again))]
    files = [sorted(p.name for p in f.iterdir()) for f in folders]
    assert files[0] == files[1]
    assert all((folders[0] / n).read_bytes() == (folders[1] / n).read_bytes() for n in files[0])


def test_html_stands_alone_and_is_accessible(page: Any) -> None:
    found = page
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


def test_both_writers_render_the_same_data(tmp_path: Path, report: prb.Report, page: Any) -> None:
    folder = report.to_markdown(tmp_path / "md").parent
    text = (folder / "report.md").read_text(encoding="utf-8")
    lines = [re.sub(r"\\(.)", r"\1", line) for line in text.splitlines()]
    assert [line.lstrip("# ") for line in lines if line.startswith("#")][1:] == [
        s.heading for s in report.sections
    ]
    table_rows = [line for line in lines if line.startswith("| ") and "---" not in line]
    shown = [[c.strip("\u2007\u2008") for c in r] for r in page.rows]
    assert [f"| {' | '.join(r)} |" for r in shown] == table_rows
    files = [m[1] for m in re.finditer(r"\]\(([^)]+\.svg)\)", text)]
    sources = [a["src"] or "" for tag, a in page.tags if tag == "img"]
    assert len(files) == len(sources) > 0
    for name, source in zip(files, sources, strict=True):
        assert base64.b64decode(source.partition(",")[2]) == (folder / name).read_bytes()
    for paragraph in (p for s in report.sections for p in s.text):
        assert paragraph in [line.removeprefix("> ") for line in lines]
        assert paragraph in page.text("p")


def test_a_section_of_the_users_own(
    tmp_path: Path, report: prb.Report, row: Any, parse: Any
) -> None:
    batches = xr.Dataset({"E": ("batch", [70.1, 71.25])}, {"batch": ["A", "B"]})
    mine = prb.reports.Section("Material", "Al 2024-T3.", batches)
    more = report.with_section(mine, after="Evidence")
    titles = [s.title for s in more.sections]
    assert titles.index("Material") == titles.index("Method") - 1
    assert len(more.sections) == len(report.sections) + 1
    assert more.date == report.date
    for text in (more._html(), more.to_markdown(tmp_path).read_text(encoding="utf-8")):
        assert "Al 2024-T3." in text
        assert "71.25" in text
    assert row("B", "E", parse(more._html()))["E"] == "71.25"
    assert report.with_section(mine).sections[-1] is mine
    part = dataclasses.replace(mine, title="Part", level=3)
    inside = [s.title for s in report.with_section(part, after="Method").sections]
    assert inside[inside.index("Method") :][:3] == ["Method", "Part", "Simulators"]
    with pytest.raises(KeyError, match="expected the title of a section"):
        report.with_section(mine, after="Nothing")


def test_a_report_is_data(report: prb.Report) -> None:
    text = report._repr_html_()
    assert text.startswith("<iframe sandbox srcdoc=")
    assert text.count("<") == 2
    with pytest.raises(dataclasses.FrozenInstanceError):
        report.title = "another"  # type: ignore[misc]
    few = prb.Report("x", report.sections[:1], optimum=3)  # type: ignore[arg-type]
    assert few.sections == report.sections[:1], "with sections given, results are not read"
    assert not re.search(r"20[2-9]\d-\d\d-\d\d", few._html()), "no date is made up"


@pytest.mark.long
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed")
@pytest.mark.parametrize("width", [375, 1000])
def test_a_browser_needs_no_sideways_scrolling(
    width: int, tmp_path: Path, report: prb.Report
) -> None:
    """In a frame of a phone's width, with a page around it that measures."""
    path = report.to_html(tmp_path / "report.html")
    outer = tmp_path / "outer.html"
    outer.write_text(
        f'<iframe src="report.html" style="width: {width}px; height: 900px; border: 0"></iframe>'
        '<script>const f = document.querySelector("iframe"); f.onload = () => { '
        "const d = f.contentDocument, e = d.documentElement; "
        "document.title = [e.scrollWidth - e.clientWidth, "
        'd.querySelector("h1").innerText, '
        '[...d.images].every(i => i.naturalWidth > 0 && i.complete)].join(";"); }</script>'
    )
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-quic"]
    flags += ["--disable-background-networking", "--disable-component-update", "--disable-sync"]
    flags += ["--allow-file-access-from-files", "--virtual-time-budget=5000", "--dump-dom"]
    command = [str(CHROMIUM), *flags, f"--user-data-dir={tmp_path / 'profile'}", outer.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120)
    assert re.findall(r"<title>(.*?)</title>", done.stdout) == ["0;Shaft;true"]
    assert path.stat().st_size < 2_000_000


def test_a_full_disk_keeps_the_report_of_yesterday(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    section = prb.reports.Section("a", "text")
    prb.Report("old", (section,)).to_html(tmp_path / "r.html")
    prb.Report("old", (section,)).to_markdown(tmp_path)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    report = prb.Report("new", (section,))
    for write, path in ((report.to_html, tmp_path / "r.html"), (report.to_markdown, tmp_path)):
        with pytest.raises(OSError, match=r"Report: got .*cannot be written \(No space left"):
            write(path)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_bare_links_and_unseen_characters_of_a_text_are_shown_as_text(tmp_path: Path) -> None:
    text = "see http://evil.example/x and www.evil.example, \u202etxt.exe\u2066 a\x07b \x1b[2J"
    report = prb.Report(text, sections=(prb.reports.Section(text, text),), author=text)
    for written in (report.to_markdown(tmp_path), report.to_html(tmp_path / "r.html")):
        found = written.read_text(encoding="utf-8")
        assert not set(found) & set("\u202e\u2066\x07\x1b")
        assert "\N{REPLACEMENT CHARACTER}txt.exe" in found
    markdown = (tmp_path / "report.md").read_text(encoding="utf-8")
    assert "http\\://evil.example/x" in markdown
    assert "www\\.evil.example" in markdown
    assert "http://" not in markdown


def test_the_running_title_is_text(parse: Any) -> None:
    """In print a style has the title: nothing in it may end a string or the style."""
    title = '"}</style><script>alert(1)</script>\\"' + "x" * 100
    text = prb.Report(title, (prb.reports.Section("A", "a"),))._html()
    css = parse(text).text("style")
    (running,) = re.findall(r'@bottom-left \{ content: "([^"]*)"', css)
    undone = re.sub(r"\\([0-9a-f]+) ", lambda found: chr(int(found[1], 16)), running)
    assert undone == title[:79] + "…"
    assert "counter(page)" in css


def test_the_layout_has_a_first_page_and_colours_for_the_dark(
    report: prb.Report, page: Any
) -> None:
    classes = [attrs["class"] or "" for tag, attrs in page.tags if tag == "section"]
    titles = dict(zip([section.title for section in report.sections], classes, strict=True))
    first_page = ["Passed", "Measured and calibrated responses", "Population of the inputs"]
    assert [title for title, names in titles.items() if "lead" in names] == first_page
    assert [title for title, names in titles.items() if "chapter" in names] == ["Decision"]
    css = page.text("style")
    assert "size: A4;" in css
    dark = css[css.index("prefers-color-scheme: dark") :]
    light = css[: css.index("prefers-color-scheme: dark")]
    names = set(re.findall(r"(--[a-z-]+):", light))
    assert names == set(re.findall(r"(--[a-z-]+):", dark[: dark.index("figure")]))


@pytest.mark.parametrize(
    ("verdict", "sign"), [("good", "\u2713"), ("bad", "\u2717"), ("open", "?")]
)
def test_a_verdict_has_a_sign_a_word_and_a_frame(
    verdict: str, sign: str, tmp_path: Path, parse: Any
) -> None:
    """Colour is not all that distinguishes them, and Markdown has the sign as well."""
    section = prb.reports.Section("Word", "Sentence.", verdict=verdict)
    report = prb.Report("x", (section,))
    page = parse(report._html())
    (names,) = [attrs["class"] or "" for tag, attrs in page.tags if tag == "section"]
    assert f"verdict {verdict}" in names
    assert page.text("span") == sign
    assert page.text("h2") == "Word"
    markdown = report.to_markdown(tmp_path).read_text(encoding="utf-8")
    assert f"## {sign} Word\n\n> Sentence." in markdown
    with pytest.raises(ValueError, match='expected "good", "bad", "open" or nothing'):
        prb.reports.Section("Word", verdict="green")


def test_date_and_software_are_those_of_the_results(calibrated: Any) -> None:
    posterior = calibrated.posterior
    attrs = posterior["posterior"].attrs
    report = prb.Report("x", posterior=posterior, pictures=False)
    assert report.date == attrs["created_at"][:10]
    assert report.note == (
        f"prbayes {attrs['prbayes_version']}, PyMC {attrs['pymc_version']}, "
        f"ArviZ {attrs['arviz_version']}, intervals of 89% probability"
    )
    damaged = posterior.copy(deep=True)
    damaged["posterior"].attrs["created_at"] = "<script>"
    assert prb.Report("x", posterior=damaged, pictures=False).date == ""


def luminance(colour: str) -> float:
    """Return the relative luminance of a colour (WCAG 2.1)."""
    shares = np.array([int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)])
    linear = np.where(shares <= 0.03928, shares / 12.92, ((shares + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


def test_verdicts_have_contrast_in_the_light_and_in_the_dark(page: Any) -> None:
    light, dark = re.findall(r":root \{(.*?)\}", page.text("style"))[:2]
    frames = set()
    for block in (light, dark):
        colours = dict(re.findall(r"--([a-z-]+): (#[0-9a-f]{6})", block))
        for verdict in ("good", "bad", "open"):
            for text in (colours[verdict], colours["ink"]):
                pair = sorted(map(luminance, (text, colours[f"{verdict}-tint"])))
                assert (pair[1] + 0.05) / (pair[0] + 0.05) > 7  # AAA
            frames.add(colours[verdict])
    assert len(frames) == 6
