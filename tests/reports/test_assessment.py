"""What judges: comparison, diagnostics, validity, cost; the summary of it."""

import dataclasses
import re
from typing import Any

import numpy as np
import pymc as pm
import pytest
import xarray as xr

import prbayes as prb
from prbayes._finding import Finding, as_json
from prbayes.reports.assessment import next_steps, summary, verdict
from prbayes.reports.material import gather
from prbayes.reports.numbers import cells
from prbayes.validation.conditions import DIRECTION


def test_comparison(calibrated: Any, page: Any, row: Any) -> None:
    table = prb.compare(
        {"optimum": calibrated.optimum, "posterior": calibrated.posterior}, model=calibrated.model
    )
    by_name = {tuple(r[:2]): r[2:] for r in page.rows if len(r) == 7}
    for name in ("mu", "sigma"):
        for label in ("optimum", "posterior"):
            values = by_name[name, label]
            cell = table.sel(hyperparameter=name, result=label)
            expected = [float(cell[key]) for key in ("estimate", "sd", "lower", "upper")]
            error = 6e-3 * float(cell["sd"])
            np.testing.assert_allclose(list(map(float, values[:4])), expected, atol=error)
            assert float(values[4]) == pytest.approx(float(cell["shift"]), abs=0.006)
    scores = row("AreaMetric", "under the metric", page)
    expected = [float(table["AreaMetric"].sel(result=x)) for x in ("optimum", "posterior")]
    np.testing.assert_allclose([float(scores[x]) for x in ("optimum", "posterior")], expected, 1e-3)


def test_diagnostics_are_those_of_diagnose(
    calibrated: Any, report: prb.Report, page: Any, row: Any, section: Any
) -> None:
    text = " ".join(section(report, "Diagnostics").text)
    diagnosis = prb.diagnose(calibrated.posterior, model=calibrated.model)
    assert all(message in text for message in diagnosis.messages)
    support = row("posterior", "weight ESS, 5%", page)
    median = float(diagnosis.support["weight_ess"].median())
    assert float(support["median"]) == pytest.approx(median, abs=0.6)
    stats = calibrated.posterior["sample_stats"]
    stages = (~np.isnan(stats["beta"].values)).sum(axis=1)
    span = str(stages[0]) if stages[0] == stages[1] else f"{stages.min()} to {stages.max()}"
    assert f"in {span} stages" in text
    moves = (stats["accept_rate"] * stats["n_steps"]).values[np.arange(2), stages - 1]
    moved = re.findall(r"each particle moved ([\d.]+)(?: to ([\d.]+))? times", text)[0]
    assert float(moved[0]) == pytest.approx(moves.min(), abs=0.06)
    assert float(moved[1] or moved[0]) == pytest.approx(moves.max(), abs=0.06)
    evidence = calibrated.posterior["posterior"].attrs["log_marginal_likelihood"]
    written = re.findall(r"log marginal likelihood (-?[\d.]+)", text)[0]
    assert float(written) == pytest.approx(evidence, abs=0.06)


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
    assert [p for p in tested.text if p.startswith("Null hypothesis: ")] == [
        f"Null hypothesis: {test.null}."
    ], "one null, said once"


def test_origin(calibrated: Any, page: Any, row: Any) -> None:
    _, optimum, posterior, _ = calibrated
    attrs = posterior["posterior"].attrs
    found = row("posterior", "seed", page)
    assert (found["seed"], found["responses"]) == ("1", str(attrs["n_responses"]))
    assert float(found["seconds"]) == pytest.approx(attrs["seconds"], abs=0.51)
    assert row("optimum", "seed", page)["responses"] == str(optimum.n_responses)
    assert f"pymc {attrs['pymc_version']}" in page.text("p")


NULL: dict[str, Any] = {"null": prb.validation.PosteriorNull(99)}


def table(title: str = "Specimens of the test", **given: Any) -> list[dict[str, str]]:
    """Return the rows of a table of a report; none where it has none."""
    report = prb.Report("x", **given, pictures=False)
    tables = [cells(section.table) for section in report.sections if section.title == title]
    return [dict(zip(t.header, row, strict=True)) for t in tables for row in t.rows]


@pytest.fixture(scope="module")
def later(calibrated: Any) -> xr.DataArray:
    model = calibrated.model
    x = pm.Normal.dist(model["mu"], model["sigma"])
    return prb.predict(calibrated.posterior, np.positive, x, model=model, random_seed=1)


def test_specimens_have_readings_beside_u_values(calibrated: Any, later: xr.DataArray) -> None:
    rows = table(validity=calibrated.test)
    assert [row["specimen"] for row in rows] == [str(i) for i in range(1, 13)]
    us = [float(row["u"]) for row in rows]
    np.testing.assert_allclose(us, calibrated.test.u_values, atol=6e-4)
    assert "measured" not in rows[0]
    data = {"hot": [1.5, 2.5], "cold": [2.0, np.inf, 1.0]}
    both = {"hot": later, "cold": later}
    tests = {
        "mean": prb.area_test(data, both, **NULL),
        "spread": prb.area_test(data, both, folded=True, **NULL),
    }
    rows = table(validity=tests, labels={"hot": "300 K"})
    assert [row["condition"] for row in rows] == ["300 K"] * 2 + ["cold"] * 3
    assert [row["specimen"] for row in rows] == ["1", "2", "1", "2", "3"]
    us = [float(row["u"]) for row in rows]
    np.testing.assert_allclose(us, tests["mean"].u_values, atol=6e-4)
    validation = {name: (np.array(data[name]), later) for name in data}
    rows = table(validity=tests, validation=validation)
    assert [row["measured"] for row in rows][3] == "\u221e"
    assert [float(row["u"]) for row in rows] == us
    names = ["S0", "S1"]
    test = prb.area_test(data["hot"], later, specimens=names, **NULL)
    rows = table(validity=test, validation={"hot": validation["hot"]})
    assert [row["specimen"] for row in rows] == names


def test_measured_and_predicted_responses_are_summed_up(later: xr.DataArray) -> None:
    right = later.copy(data=later.values[..., ::-1] + 10)
    prediction = xr.concat([later, right], dim=xr.Variable("end", ["left", "right"]))
    prediction = prediction.transpose(..., "end").assign_attrs(later.attrs)
    fresh = np.random.default_rng(4).normal([2.0, 12.0], 0.6, (30, 2))
    fresh[7, 0] = np.inf
    given = {"validation": {"hot": (fresh, prediction)}}
    row, other = table("Data of the test", **given)
    assert (other["condition"], other["failed"]) == ("hot[right]", "0")
    assert (row["condition"], row["N"], row["failed"]) == ("hot[left]", "30", "1")
    finite = np.delete(fresh[:, 0], 7)
    shown = [float(row[key]) for key in ("smallest", "largest", "mean", "sd")]
    expected = [finite.min(), finite.max(), finite.mean(), finite.std(ddof=1)]
    np.testing.assert_allclose(shown, expected, atol=6e-3)
    shown = [float(row[key]) for key in ("predicted median", "89% from", "to")]
    np.testing.assert_allclose(shown, np.quantile(later, [0.5, 0.055, 0.945]), atol=6e-3)
    assert len(table(**given)) == 40  # of 60 values, a page
    assert table(**given)[30]["condition"] == "hot[right]"


# -- summary ---------------------------------------------------------------------------------


def test_the_summary_has_the_answer(calibrated: Any, report: prb.Report) -> None:
    _, _, posterior, _ = calibrated
    text = " ".join(report.sections[0].text)
    for name in ("mu", "sigma"):
        mean, sd = map(float, re.findall(rf"{name} = (-?[\d.]+) ± ([\d.]+)", text)[0])
        draws = posterior["posterior"][name].values
        assert sd == pytest.approx(draws.std(ddof=1), rel=0.06)
        assert mean == pytest.approx(draws.mean(), abs=0.06 * sd)
    assert "cv =" not in text, "a deterministic is no hyperparameter"
    assert (
        "2 hyperparameters (mu, sigma) of the model were calibrated on 30 measured responses of y"
        in text
    )
    assert "by the Kullback-Leibler divergence" in text
    assert "not rejected at level 5%" in text


def test_problems_are_counted_in_the_summary(calibrated: Any, section: Any) -> None:
    posterior = calibrated[2].copy(deep=True)
    posterior["posterior"]["mu"][0] += 5.0
    bad = prb.Report("x", posterior=posterior, pictures=False)
    assert any("R-hat" in p for p in section(bad, "Diagnostics").text)
    assert any("problem" in p and "found no problem" not in p for p in bad.sections[0].text)
    finding = Finding("not-identified", "The data do not see mu.")
    posterior["posterior"].attrs["findings"] = as_json([finding])
    again = prb.Report("x", posterior=posterior, pictures=False)
    assert "Posterior: The data do not see mu." in section(again, "Diagnostics").text


def draws(**values: Any) -> xr.DataTree:
    variables = {name: (["chain", "draw"], v) for name, v in values.items()}
    return xr.DataTree.from_dict({"posterior": xr.Dataset(variables)})


def test_one_hyperparameter_and_several_results() -> None:
    first = draws(p=np.array([[1.0, 2.0, 3.0], [2.0, 2.0, 2.0]]))
    second = draws(p=np.array([[4.0, 5.0, 6.0], [5.0, 5.0, 5.0]]))
    text = " ".join(summary(gather(posterior={"a": first, "b": second})))
    assert "1 hyperparameter (p) of the model was calibrated" in text
    assert "The answer of a is p = 2.00 ± 0.63 (mean and standard deviation" in text
    # (5 - 2) / .632
    assert "The estimates of a and b differ by at most 4.7 standard deviations." in text
    third = {"a": first, "b": second, "c": first}
    assert "differ by" not in " ".join(summary(gather(posterior=third)))
    fixed = {"a": draws(p=np.ones((1, 5))), "b": draws(p=np.full((1, 5), 2.0))}
    assert "differ by" not in " ".join(summary(gather(posterior=fixed)))
    many = {f"p{i}": np.random.default_rng(i).normal(size=(2, 20)) for i in range(7)}
    text = " ".join(summary(gather(posterior=draws(**many))))
    assert "7 hyperparameters of the model were calibrated" in text
    assert "The answer is in the table of the posterior." in text


def test_an_unidentified_hyperparameter_has_no_estimate(calibrated: Any) -> None:
    stderr = calibrated.optimum.stderr | {"sigma": np.inf}
    optimum = dataclasses.replace(calibrated.optimum, stderr=stderr)
    labels = {"mu": "mean of the exponent"}
    text = " ".join(summary(gather(optimum=optimum, labels=labels, model=calibrated.model)))
    assert "mean of the exponent = " in text
    assert "hyperparameters (mean of the exponent, sigma)" in text
    assert f"sigma = {optimum.point['sigma']:.2g}"[:11] in text
    assert ", without a standard error (see the section on diagnostics)" in text
    assert "inf" not in text
    m = gather(optimum=optimum, posterior=calibrated.posterior, model=calibrated.model)
    (far,) = re.findall(r"differ by at most ([\d.]+)", " ".join(summary(m)))
    assert float(far) < 1.0  # that of mu


def test_a_verdict_names_the_sign(calibrated: Any) -> None:
    test = calibrated.test
    above = dataclasses.replace(test, statistic=0.4, critical_value=0.2, p_value=0.012, folded=True)
    m = gather(validity=above)
    (text,) = summary(m)
    assert "On the spread of the responses of 12 specimens (12 values)" in text
    assert "is rejected at level 5% (area 0.400 > critical 0.200, p = 0.012)." in text
    below = dataclasses.replace(above, statistic=0.1, p_value=0.4)
    assert "is not rejected at level 5% (area 0.100 ≤ critical 0.200" in verdict("x", below, m)


def test_a_verdict_on_several_outputs_counts_directions() -> None:
    rng = np.random.default_rng(1)
    predicted = rng.normal(rng.normal(0, 0.25, (50, 1, 2)), 1.0, (50, 100, 2))
    null = prb.validation.PosteriorNull(99)
    test = prb.area_test(rng.normal(size=(12, 2)), predicted, null=null)
    text = verdict("a", test, gather(validity=test))
    assert text.startswith(
        "On the responses of 12 specimens (several outputs in 4 directions), the"
    )
    assert "(mean area 0." in text
    made = prb.Report("x", validity=test, pictures=False)
    table = made.sections[-1].table
    assert table["of"].tolist() == ["u and |2u - 1|"]
    assert table["directions"].tolist() == ["4"]


def test_next_steps_depend_on_the_results(calibrated: Any) -> None:
    """An optimum needs a posterior and a test, a rejected model a correction."""
    optimum, posterior, test = calibrated.optimum, calibrated.posterior, calibrated.test

    def steps(**given: Any) -> str:
        texts = next_steps(gather(model=calibrated.model, **given))
        assert [text.partition(". ")[0] for text in texts] == [
            str(i + 1) for i in range(len(texts))
        ]
        return " ".join(texts)

    assert steps() == ""
    assert "prb.sample_smc" in steps(optimum=optimum)
    assert "prb.area_test" in steps(optimum=optimum)
    assert "prb.sample_smc" not in steps(posterior=posterior)
    assert "folded=True" in steps(posterior=posterior, validity=test)
    names = np.array([f"later{DIRECTION}{k % 4 + 1}" for k in range(test.u_values.size)])
    several = dataclasses.replace(test, conditions=names)
    assert "folded=True" not in steps(posterior=posterior, validity=several)
    rejected = dataclasses.replace(test, p_value=0.001)
    text = steps(posterior=posterior, validity=rejected)
    assert text.startswith("1. Do not use the model beyond")
    assert "folded=True" not in text
    bad = posterior.copy(deep=True)
    bad["posterior"]["mu"][0] += 5.0
    assert steps(posterior=bad).startswith("1. Remove the problems")
    by_draw = xr.DataArray([[0.01, 0.2]], dims=("chain", "draw"))
    risk = xr.Dataset({"probability": 0.1, "by_draw": by_draw, "error": 0.01})
    for verdict_text, is_open in (("not decided", True), ("met", False)):
        decision = {"P": risk.assign_attrs(verdict=verdict_text)}
        text = steps(posterior=posterior, validity=test, decision=decision)
        assert ("with prb.decision.Exceedance as its quantity" in text) == is_open
    rough = risk.assign_attrs(
        verdict="not decided", findings=as_json([Finding("rough-probability", "Pass points=.")])
    )
    text = steps(posterior=posterior, validity=test, decision={"P": rough})
    assert "as the error of the computation is too large" in text


def test_a_bootstrap_is_reported_without_the_model(calibrated: Any, section: Any) -> None:
    boot = prb.bootstrap(calibrated.optimum, 60, random_seed=1)
    report = prb.Report("x", posterior={"bootstrap": boot}, pictures=False)
    assert "not diagnosed, because that needs the model" in section(report, "Diagnostics").text[0]
    assert cells(section(report, "Posterior").table).rows[0][0] == "mu"
