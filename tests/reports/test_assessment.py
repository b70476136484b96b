"""What judges: comparison, diagnostics, validity, cost."""

import dataclasses
import re
from typing import Any

import numpy as np
import pytest

import prbayes as prb
from prbayes.reports.tables import cells


def test_comparison(calibrated: Any, page: Any, row: Any) -> None:
    model, optimum, posterior, _ = calibrated
    table = prb.compare({"optimum": optimum, "posterior": posterior}, model=model)
    rows = [
        r
        for r in page.rows
        if len(r) == 7 and r[0] in {"mu", "sigma"} and r[1] in {"optimum", "posterior"}
    ]
    assert [r[:2] for r in rows] == [
        [h, r] for h in ("mu", "sigma") for r in ("optimum", "posterior")
    ]
    for name, label, *values in rows:
        own = table.sel(hyperparameter=name, result=label)
        for value, key in zip(values, ("estimate", "sd", "lower", "upper"), strict=False):
            assert float(value) == pytest.approx(float(own[key]), abs=float(own["sd"]) * 6e-3)
        assert float(values[4]) == pytest.approx(float(own["shift"]), abs=0.006)
    for key in ("ProbabilityResidual", "KullbackLeibler", "AreaMetric", "LogLikelihood"):
        scores = row(key, "under the metric", page)
        for label in ("optimum", "posterior"):
            assert float(scores[label]) == pytest.approx(
                float(table[key].sel(result=label)), rel=1e-3
            )


def test_diagnostics_are_those_of_diagnose(
    calibrated: Any, report: prb.Report, page: Any, row: Any, section: Any
) -> None:
    model, _, posterior, _ = calibrated
    text = " ".join(section(report, "Diagnostics").text)
    found = prb.diagnose(posterior, model=model)
    assert all(message in text for message in found.messages)
    support = row("posterior", "weight ESS, 5%", page)
    assert float(support["median"]) == pytest.approx(
        float(found.support["weight_ess"].median()), abs=0.6
    )
    stats = posterior["sample_stats"]
    stages = (~np.isnan(stats["beta"].values)).sum(axis=1)
    span = str(stages[0]) if stages[0] == stages[1] else f"{stages.min()} to {stages.max()}"
    assert f"in {span} stages" in text
    last = [
        float((stats["accept_rate"] * stats["n_steps"])[i, n - 1]) for i, n in enumerate(stages)
    ]
    moved = re.findall(r"each particle moved ([\d.]+)(?: to ([\d.]+))? times", text)[0]
    assert float(moved[0]) == pytest.approx(min(last), abs=0.06)
    assert float(moved[1] or moved[0]) == pytest.approx(max(last), abs=0.06)
    evidence = posterior["posterior"].attrs["log_marginal_likelihood"]
    assert float(re.findall(r"log marginal likelihood (-?[\d.]+)", text)[0]) == pytest.approx(
        evidence, abs=0.06
    )


def test_validity(calibrated: Any, page: Any, row: Any) -> None:
    test = calibrated[3]
    found = row("area test", "verdict", page)
    assert float(found["area"]) == pytest.approx(test.statistic, abs=6e-5)
    assert float(found["critical value"]) == pytest.approx(test.critical_value, abs=6e-5)
    assert found["p-value"] == f"{test.p_value:.2g}"
    assert found["verdict"] == ("rejected" if test.rejected else "not rejected")
    rejected = dataclasses.replace(test, p_value=0.01, statistic=0.4)
    both = prb.Report("x", validity={"early": test, "late": rejected}, pictures=False)
    summary, tested, specimens = both.sections
    assert len(cells(specimens.table).rows) == test.u_values.size
    found_by = [("is rejected" in p, p.split(":")[0]) for p in summary.text]
    assert found_by == [(False, "early"), (True, "late")]
    more_often = "rejected by one or more of these 2 tests in up to 10% of cases"
    assert any(more_often in p for p in tested.text)
    one = prb.Report("x", validity=test, pictures=False).sections[1]
    assert not any("up to" in p for p in one.text)
    rows = cells(tested.table).rows
    assert [r[0] for r in rows] == ["early", "late"]
    assert [r[1] for r in rows] == ["not rejected", "rejected"]
    assert [p for p in tested.text if p.startswith("Held to be true: ")] == [
        f"Held to be true: {test.null}."
    ], "one null, said once"


def test_origin(calibrated: Any, page: Any, row: Any) -> None:
    _, optimum, posterior, _ = calibrated
    attrs = posterior["posterior"].attrs
    found = row("posterior", "seed", page)
    assert (found["seed"], found["responses"]) == ("1", str(attrs["n_responses"]))
    assert float(found["seconds"]) == pytest.approx(attrs["seconds"], abs=0.51)
    assert row("optimum", "seed", page)["responses"] == str(optimum.n_responses)
    assert f"pymc {attrs['pymc_version']}" in page.text("p")


def test_bootstrap_and_other_samplers(calibrated: Any, section: Any) -> None:
    model, optimum, _, _ = calibrated
    boot = prb.bootstrap(optimum, 60, random_seed=1)
    made = prb.Report("x", posterior={"bootstrap": boot}, pictures=False)
    assert "not looked at, because that needs the model" in section(made, "Diagnostics").text[0]
    assert cells(section(made, "Posterior").table).rows[0][0] == "mu"
    with_model = prb.Report(
        "x", model=model, posterior={"bootstrap": boot}, optimum=optimum, pictures=False
    )
    assert "bootstrap" in {r[1] for r in cells(section(with_model, "Comparison").table).rows}
