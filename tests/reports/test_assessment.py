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


def test_bootstrap_and_other_samplers(calibrated: Any, section: Any) -> None:
    model, optimum, _, _ = calibrated
    boot = prb.bootstrap(optimum, 60, random_seed=1)
    made = prb.Report("x", posterior={"bootstrap": boot}, pictures=False)
    assert "not diagnosed, because that needs the model" in section(made, "Diagnostics").text[0]
    assert cells(section(made, "Posterior").table).rows[0][0] == "mu"
    with_model = prb.Report(
        "x", model=model, posterior={"bootstrap": boot}, optimum=optimum, pictures=False
    )
    assert "bootstrap" in {r[1] for r in cells(section(with_model, "Comparison").table).rows}


NULL: dict[str, Any] = {"null": prb.validation.PosteriorNull(99)}


def table(title: str = "Specimens of the test", **given: Any) -> list[dict[str, str]]:
    """Return the rows of a table of a report; none where it has none."""
    report = prb.Report("x", **given, pictures=False)
    for section in report.sections:
        if section.title == title:
            found = cells(section.table)
            return [dict(zip(found.header, row, strict=True)) for row in found.rows]
    return []


@pytest.fixture(scope="module")
def later(calibrated: Any) -> xr.DataArray:
    model = calibrated.model
    x = pm.Normal.dist(model["mu"], model["sigma"])
    return prb.predict(calibrated.posterior, np.positive, x, model=model, random_seed=1)


def test_of_a_test_alone_there_are_u_values(calibrated: Any) -> None:
    test = calibrated.test
    rows = table(validity=test)
    assert [row["specimen"] for row in rows] == [str(i) for i in range(1, 13)]
    np.testing.assert_allclose([float(row["u"]) for row in rows], test.u_values, atol=6e-4)
    assert "measured" not in rows[0]


def test_readings_stand_beside_u_values(calibrated: Any, later: xr.DataArray) -> None:
    fresh = np.random.default_rng(4).normal(2.0, 0.6, 12)
    names = [f"S{i}" for i in range(12)]
    test = prb.area_test(fresh, later, specimens=names, **NULL)
    rows = table(validity=test, validation={"hot": (fresh, later)})
    assert [row["condition"] for row in rows] == ["hot"] * 12
    assert [row["specimen"] for row in rows] == names
    measured = [float(row["measured"]) for row in rows]
    np.testing.assert_allclose(measured, fresh, atol=0.006)
    np.testing.assert_allclose([float(row["u"]) for row in rows], test.u_values, atol=6e-4)
    # Its lowest reading has the lowest place.
    assert np.argmin(measured) == np.argmin([float(row["u"]) for row in rows])
    counted = table(validation={"hot": (fresh, later)})
    assert [row["specimen"] for row in counted] == [str(i) for i in range(1, 13)]


def test_both_tests_of_a_specimen_share_a_row(calibrated: Any, later: xr.DataArray) -> None:
    data = {"hot": [1.5, 2.5], "cold": [2.0, np.inf, 1.0]}
    both = {"hot": later, "cold": later}
    tests = {
        "mean": prb.area_test(data, both, **NULL),
        "spread": prb.area_test(data, both, folded=True, **NULL),
    }
    rows = table(validity=tests, labels={"hot": "300 K"})
    assert [row["condition"] for row in rows] == ["300 K"] * 2 + ["cold"] * 3
    assert [row["specimen"] for row in rows] == ["1", "2", "1", "2", "3"]
    np.testing.assert_allclose([float(row["u"]) for row in rows], tests["mean"].u_values, atol=6e-4)
    with_readings = table(validity=tests, validation={c: (data[c], both[c]) for c in data})
    assert [row["measured"] for row in with_readings][3] == "\u221e"


def test_outputs_have_a_row_each(later: xr.DataArray) -> None:
    prediction = xr.concat(
        [later, later.copy(data=later.values[..., ::-1] + 10)],
        dim=xr.Variable("end", ["left", "right"]),
    )
    prediction = prediction.transpose(..., "end").assign_attrs(later.attrs)
    measured = np.array([[2.0, 13.0], [3.0, 12.0]])
    rows = table(validation={"hot": (measured, prediction)})
    assert [(row["condition"], row["specimen"]) for row in rows] == [
        ("hot[left]", "1"),
        ("hot[left]", "2"),
        ("hot[right]", "1"),
        ("hot[right]", "2"),
    ]
    # Of equal readings above the same prediction the u-values are the same.
    assert float(rows[1]["u"]) == float(rows[2]["u"]) > 0.8


def test_a_page_of_them_is_told(later: xr.DataArray) -> None:
    fresh = np.random.default_rng(4).normal(2.0, 0.6, 60)
    report = prb.Report("x", validation={"hot": (fresh, later)}, pictures=False)
    (section,) = (s for s in report.sections if s.title == "Specimens of the test")
    assert "The first 40 of 60 values are shown." in " ".join(section.text)
    assert len(cells(section.table).rows) == 40


def test_measured_and_predicted_responses_are_summed_up(later: xr.DataArray) -> None:
    fresh = np.random.default_rng(4).normal(2.0, 0.6, 30)
    fresh[7] = np.inf
    (row,) = table("Data of the test", validation={"hot": (fresh, later)})
    finite = fresh[np.isfinite(fresh)]
    assert (row["condition"], row["N"], row["failed"]) == ("hot", "30", "1")
    told = [float(row[key]) for key in ("smallest", "largest", "mean", "sd")]
    own = [finite.min(), finite.max(), finite.mean(), finite.std(ddof=1)]
    np.testing.assert_allclose(told, own, atol=6e-3)
    told = [float(row[key]) for key in ("predicted median", "89% from", "to")]
    np.testing.assert_allclose(told, np.quantile(later, [0.5, 0.055, 0.945]), atol=6e-3)


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


def material(**given: Any) -> Any:
    nothing = dict.fromkeys(("model", "optimum", "posterior", "validity", "comparison"))
    return gather(**(nothing | given))


def draws(**values: Any) -> xr.DataTree:
    variables = {name: (["chain", "draw"], v) for name, v in values.items()}
    return xr.DataTree.from_dict({"posterior": xr.Dataset(variables)})


def test_the_answer_of_many_hyperparameters_is_in_a_table() -> None:
    rng = np.random.default_rng(1)
    many = {f"p{i}": rng.normal(size=(2, 20)) for i in range(7)}
    text = " ".join(summary(material(posterior=draws(**many))))
    assert "7 hyperparameters of the model were calibrated" in text
    assert "The answer is in the table of the posterior." in text
    del many["p6"]
    text = " ".join(summary(material(posterior=draws(**many))))
    assert "6 hyperparameters (p0, p1, p2, p3, p4, p5) of" in text
    assert "The answer is p0 = " in text


def test_one_hyperparameter_and_several_results() -> None:
    one = draws(p=np.array([[1.0, 2.0, 3.0], [2.0, 2.0, 2.0]]))
    other = draws(p=np.array([[4.0, 5.0, 6.0], [5.0, 5.0, 5.0]]))
    text = " ".join(summary(material(posterior={"a": one, "b": other})))
    assert "1 hyperparameter (p) of the model was calibrated" in text
    assert "The answer of a is p = 2.00 ± 0.63 (mean and standard deviation" in text
    # (5 - 2) / .632
    assert "The estimates of a and b differ by at most 4.7 standard deviations." in text
    third = {"a": one, "b": other, "c": one}
    assert "differ by" not in " ".join(summary(material(posterior=third)))


def test_without_spread_nothing_is_said_of_the_distance() -> None:
    fixed = draws(p=np.ones((1, 5)))
    other = draws(p=np.full((1, 5), 2.0))
    text = " ".join(summary(material(posterior={"a": fixed, "b": other})))
    assert "differ by" not in text


def test_what_is_not_identified_has_no_estimate() -> None:
    rng = np.random.default_rng(1)
    with pm.Model() as model:
        mu = pm.Normal("mu", 0, 2)
        pm.Normal("idle", mu, 3)
        x = pm.Normal.dist(mu, 1.0)
        prb.Simulator("y", np.positive, x, metric=prb.AreaMetric(), observed=rng.normal(size=30))
    optimum = prb.minimize(model, progressbar=False)
    own = {"mu": rng.normal(size=(2, 50)), "idle": rng.normal(5.0, 3.0, size=(2, 50))}
    text = " ".join(summary(material(optimum=optimum, posterior=draws(**own), model=model)))
    assert "differ by at most" in text
    far = float(re.findall(r"differ by at most ([\d.]+)", text)[0])
    assert far < 1.0  # that of mu
    text = " ".join(summary(material(optimum=optimum, model=model)))
    assert "idle is not identified" in text
    assert "inf" not in text


def test_a_verdict_names_the_sign(calibrated: Any) -> None:
    test = calibrated.test
    above = dataclasses.replace(test, statistic=0.4, critical_value=0.2, p_value=0.012, folded=True)
    m = material(validity=above)
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
    text = verdict("a", test, material(validity=test))
    assert text.startswith(
        "On the responses of 12 specimens (several outputs in 4 directions), the"
    )
    assert "(mean area 0." in text
    made = prb.Report("x", validity=test, pictures=False)
    table = made.sections[-1].table
    assert table["of"].tolist() == ["u and |2u - 1|"]
    assert table["directions"].tolist() == ["4"]


def test_hyperparameters_are_called_by_their_labels(calibrated: Any) -> None:
    labels = {"mu": "mean of the exponent"}
    report = prb.Report(
        "A", optimum=calibrated.optimum, labels=labels, model=calibrated.model, pictures=False
    )
    text = " ".join(report.sections[0].text)
    assert "mean of the exponent = " in text
    assert "hyperparameters (mean of the exponent, sigma)" in text


def steps(calibrated: Any, **given: Any) -> str:
    nothing = dict.fromkeys(("model", "optimum", "posterior", "validity", "comparison"))
    found = next_steps(gather(**(nothing | {"model": calibrated.model} | given)))
    assert [step.partition(". ")[0] for step in found] == [str(i + 1) for i in range(len(found))]
    return " ".join(found)


def test_an_optimum_alone_wants_a_posterior_and_a_test(calibrated: Any) -> None:
    found = steps(calibrated, optimum=calibrated.optimum)
    assert "prb.sample_smc" in found
    assert "prb.area_test" in found
    assert "prb.sample_smc" not in steps(calibrated, posterior=calibrated.posterior)


def test_a_rejected_model_is_to_be_corrected(calibrated: Any) -> None:
    rejected = dataclasses.replace(calibrated.test, p_value=0.001)
    found = steps(calibrated, posterior=calibrated.posterior, validity=rejected)
    assert found.startswith("1. Do not use the model beyond")
    assert "folded=True" not in found
    assert "folded=True" in steps(
        calibrated, posterior=calibrated.posterior, validity=calibrated.test
    )


def test_the_spread_of_several_outputs_is_tested_already(calibrated: Any) -> None:
    names = np.array([f"later{DIRECTION}{k % 4 + 1}" for k in range(calibrated.test.u_values.size)])
    test = dataclasses.replace(calibrated.test, conditions=names)
    assert "folded=True" not in steps(calibrated, posterior=calibrated.posterior, validity=test)


def test_problems_come_first(calibrated: Any) -> None:
    posterior = calibrated.posterior.copy(deep=True)
    posterior["posterior"]["mu"][0] += 5.0
    assert steps(calibrated, posterior=posterior).startswith("1. Remove the problems")


def test_what_is_not_decided_wants_more_specimens(calibrated: Any) -> None:
    draws = xr.DataArray([[0.01, 0.2]], dims=("chain", "draw"))
    table = xr.Dataset({"probability": 0.1, "by_draw": draws, "error": 0.01})
    given = {"posterior": calibrated.posterior, "validity": calibrated.test}
    for text, said in (("not decided", True), ("met", False)):
        asked = table.assign_attrs(verdict=text)
        found = steps(calibrated, **given, decision={"P": asked})
        assert ("with prb.decision.Exceedance as its quantity" in found) == said


def test_without_a_result_there_is_nothing_to_do(calibrated: Any) -> None:
    assert steps(calibrated) == ""
    report = prb.Report("x", model=calibrated.model, pictures=False)
    assert "What to do next" not in [section.title for section in report.sections]
