"""Which sections a report has, in which order."""

from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm
import pytest

import prbayes as prb
from prbayes.reports.tables import cells


def test_sections_come_in_order(report: prb.Report, page: Any) -> None:
    titles = [s.title for s in report.sections if s.level == 2]
    assert titles == [
        "Summary",
        "Model",
        "Data",
        "Metric and epsilon",
        "Optimum",
        "Posterior",
        "Comparison",
        "Diagnostics",
        "Validity",
        "Cost and origin",
    ]
    assert page.text("h1") == "Shaft"
    assert "2 May 2024" in page.text("p")


def test_what_is_not_given_is_left_out(calibrated: Any) -> None:
    model, optimum, posterior, test = calibrated
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


def test_a_hostile_model_is_reported(row: Any, parse: Any) -> None:
    for name in ("<b>x<b>", "a|b", "p & q"):
        with pm.Model() as model:
            x = pm.Normal.dist(pm.Normal(name, 0, 2), 1.0)
            prb.Simulator(
                "y", lambda x: 2 * x, x, metric=prb.AreaMetric(), observed=[0.0, 2.0, 4.0]
            )
        text = prb.Report(name, model=model)._html()
        assert row(name, "distribution", parse(text))["distribution"] == "Normal(0, 2)"
        assert "<b>" not in text


@pytest.mark.long
def test_several_simulators_and_vectors(tmp_path: Path, section: Any, parse: Any) -> None:
    with pm.Model(coords={"part": ["shaft", "disk"]}) as model:
        mu = pm.Normal("mu", 1, 1, dims="part")
        k = pm.HalfNormal("k", 1)
        x = pm.Normal.dist(mu[0], 1.0)
        z = pm.Normal.dist(mu[1], k)
        prb.Simulator(
            "first", np.positive, x, metric=prb.AreaMetric(), observed=[0.1, 1.0, 2.0, 2.2]
        )
        prb.Simulator(
            "second", np.positive, z, metric=prb.KullbackLeibler(), observed=[0.0, 1.0, 3.0]
        )
    optimum = prb.minimize(model)
    made = prb.Report("x", model=model, optimum=optimum, pictures=False)
    data = cells(section(made, "Data").table)
    assert [r[:2] for r in data.rows] == [("first", "4"), ("second", "3")]
    assert [r[0] for r in cells(section(made, "Optimum").table).rows] == [
        "mu[shaft]",
        "mu[disk]",
        "k",
    ]
    assert [
        p for p in section(made, "Metric and epsilon").text if p.startswith("first: AreaMetric(")
    ]
    parse(made._html())
    made.to_markdown(tmp_path)
