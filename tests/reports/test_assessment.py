"""What a reader decides by: verdict, requirement, answer, evidence, next steps; and checks of it."""

import dataclasses
import re
from typing import Any

import numpy as np
import pymc as pm
import pytest
import xarray as xr
from one_input import posterior_of

import prbayes as prb
from prbayes._finding import Finding, as_json
from prbayes.reports.assessment import agreement, answer, next_steps
from prbayes.reports.material import gather
from prbayes.reports.numbers import NOTHING, cells
from prbayes.reports.sections import comparison
from prbayes.validation.pit import DIRECTION


def test_comparison(calibrated: Any, page: Any) -> None:
    table = prb.compare(
        {"optimum": calibrated.optimum, "posterior": calibrated.posterior}, model=calibrated.model
    )
    by_name = {tuple(r[:2]): r[2:] for r in page.rows if len(r) == 6}
    for name in ("mu", "sigma"):
        for label in ("optimum", "posterior"):
            values = by_name[name, label]
            cell = table.sel(hyperparameter=name, result=label)
            expected = [float(cell[key]) for key in ("estimate", "sd", "lower", "upper")]
            numbers = [*values[:2], *values[2].split(" to ")]
            np.testing.assert_allclose(list(map(float, numbers)), expected, rtol=1e-3)
            assert float(values[3]) == pytest.approx(float(cell["shift"]), abs=0.006)
    scores = re.findall(r"by AreaMetric: optimum ([\d.]+), posterior ([\d.]+)\.", page.text("p"))
    expected = [float(table["AreaMetric"].sel(result=x)) for x in ("optimum", "posterior")]
    np.testing.assert_allclose(list(map(float, scores[0])), expected, 1e-3)


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
    text = " ".join(section(report, "Posterior").text)
    assert f"in {span} stages" in text
    moves = (stats["accept_rate"] * stats["n_steps"]).values[np.arange(2), stages - 1]
    moved = re.findall(r"each particle moved ([\d.]+)(?: to ([\d.]+))? times", text)[0]
    assert float(moved[0]) == pytest.approx(moves.min(), abs=0.06)
    assert float(moved[1] or moved[0]) == pytest.approx(moves.max(), abs=0.06)
    evidence = calibrated.posterior["posterior"].attrs["log_marginal_likelihood"]
    written = re.findall(r"Log marginal likelihood (-?[\d.]+)", text)[0]
    assert float(written) == pytest.approx(evidence, abs=0.06)


def test_validity(calibrated: Any, page: Any, row: Any, section: Any) -> None:
    test = calibrated[3]
    found = row("area test", "verdict", page)
    assert float(found["area"]) == pytest.approx(test.statistic, abs=6e-5)
    assert float(found["critical value"]) == pytest.approx(test.critical_value, abs=6e-5)
    assert found["p-value"] == f"{test.p_value:.2g}"
    assert found["verdict"] == ("rejected" if test.rejected else "not rejected")
    rejected = dataclasses.replace(test, p_value=0.01, statistic=0.4)
    both = prb.Report("x", validity={"early": test, "late": rejected}, pictures=False)
    front = both.sections[0]
    assert (front.title, front.verdict) == ("Rejected", "bad")
    assert front.text[1] == "Failed: late, of 2 tests."
    in_words = section(both, "Test of the model").text
    assert in_words[0].startswith("early: the measured values agree with the prediction. Of a r")
    assert in_words[1].startswith("late: the measured values differ too much from the prediction.")
    assert "1% of such tests differ at least as much; at 5% or less the model is" in in_words[1]
    assert in_words[2] == "Together the tests reject a right model in up to 10% of cases."
    one = prb.Report("x", validity=test, pictures=False)
    assert not any("up to" in p for p in section(one, "Test of the model").text)
    statistics = section(both, "Test statistics")
    rows = cells(statistics.table).rows
    assert [r[:2] for r in rows] == [("early", "not rejected"), ("late", "rejected")]
    null = f"Null hypothesis: {test.null}."
    assert [p for p in statistics.text if p.startswith("Null hypothesis: ")] == [null], "once"


def test_origin(calibrated: Any, page: Any, row: Any) -> None:
    _, optimum, posterior, _ = calibrated
    attrs = posterior["posterior"].attrs
    found = row("posterior", "seed", page)
    assert (found["seed"], found["responses"]) == ("1", str(attrs["n_responses"]))
    assert float(found["seconds"]) == pytest.approx(attrs["seconds"], abs=0.51)
    assert row("optimum", "seed", page)["responses"] == str(optimum.n_responses)
    assert f"pymc {attrs['pymc_version']}" in page.text("p")


def pair_of(a: Any, b: Any) -> Any:
    return np.stack([a, b], axis=-1)


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
    assert table(validity=calibrated.test) == []
    data = {"hot": [1.5, 2.5], "cold": [2.0, np.inf, 1.0]}
    both = {"hot": later, "cold": later}
    tests = {
        "mean": prb.area_test(data, both, **NULL),
        "spread": prb.area_test(data, both, folded=True, **NULL),
    }
    validation = {name: (np.array(data[name]), later) for name in data}
    rows = table(validity=tests, validation=validation, labels={"hot": "300 K"})
    assert [row["condition"] for row in rows] == ["300 K"] * 2 + ["cold"] * 3
    assert [row["specimen"] for row in rows] == ["1", "2", "1", "2", "3"]
    us = [float(row["u"]) for row in rows]
    np.testing.assert_allclose(us, tests["mean"].u_values, atol=6e-4)
    assert [row["measured"] for row in rows][3] == "\u221e"
    names = ["S0", "S1"]
    test = prb.area_test(data["hot"], later, specimens=names, **NULL)
    rows = table(validity=test, validation={"hot": validation["hot"]})
    assert [row["specimen"] for row in rows] == names


def test_measured_and_predicted_responses_are_summed_up(later: xr.DataArray, section: Any) -> None:
    right = later.copy(data=later.values[..., ::-1] + 10)
    prediction = xr.concat([later, right], dim=xr.Variable("end", ["left", "right"]))
    prediction = prediction.transpose(..., "end").assign_attrs(later.attrs)
    fresh = np.random.default_rng(4).normal([2.0, 12.0], 0.6, (30, 2))
    fresh[7, 0] = np.inf
    given = {"validation": {"hot": (fresh, prediction)}}
    row, other = table("Test of the model", **given)
    assert (other["condition"], other["failed"]) == ("hot[right]", "0")
    assert (row["condition"], row["N"], row["failed"]) == ("hot[left]", "30", "1")
    finite = np.delete(fresh[:, 0], 7)
    shown = [float(row[key]) for key in ("smallest", "largest", "mean", "sd")]
    expected = [finite.min(), finite.max(), finite.mean(), finite.std(ddof=1)]
    np.testing.assert_allclose(shown, expected, atol=6e-3)
    shown = [float(row[key]) for key in ("predicted median", "89% from", "to")]
    np.testing.assert_allclose(shown, np.quantile(later, [0.5, 0.055, 0.945]), atol=6e-3)
    assert len(table(**given)) == 40  # of 60 values, a page
    # Failures that no predicted specimen has are named.
    words = ": specimens failed, and no predicted one does: the model excludes them."
    report = prb.Report("x", **given, pictures=False)
    assert "hot[left]" + words in section(report, "Test of the model").text
    prediction[..., 0, 0] = np.inf
    report = prb.Report("x", **given, pictures=False)
    assert "hot[left]" + words not in section(report, "Test of the model").text


# -- page one, and the answer -----------------------------------------------------------------


def test_the_answer_has_the_estimates(calibrated: Any, report: prb.Report, section: Any) -> None:
    _, _, posterior, _ = calibrated
    of_answer = section(report, "Answer")
    rows = {row[0]: row[1:] for row in cells(of_answer.table).rows}
    assert list(rows) == ["mu", "sigma"], "a deterministic is no parameter"
    for name in ("mu", "sigma"):
        draws = posterior["posterior"][name].values
        mean, sd, low, high = map(float, rows[name])
        assert sd == pytest.approx(draws.std(ddof=1), rel=0.06)
        assert mean == pytest.approx(draws.mean(), abs=0.06 * sd)
        np.testing.assert_allclose([low, high], np.quantile(draws, [0.055, 0.945]), atol=0.06 * sd)
    assert "is fitted to 30 measured values of y." in of_answer.text[0]


@pytest.mark.long
@pytest.mark.parametrize("grouped", [False, True])
def test_repeated_readings_are_those_of_their_specimens(grouped: bool) -> None:
    values = np.random.default_rng(1).normal([5.0, 70.0], [0.5, 3.0], (20, 2))
    kind = np.repeat(["one", "two"], 10)
    y = xr.DataArray(values, dims=("i", "output"), coords={"kind": ("i", kind)})
    with pm.Model(coords={"kind": ["one", "two"]}) as model:
        mu = pm.Normal("mu", 5, 1, dims="kind" if grouped else None)
        if grouped:
            mu = mu[prb.response.group("kind")]
        inputs = pm.Normal.dist(mu, 0.5), pm.Normal.dist(70, 3.0)
        given: Any = {"metric": prb.LogLikelihood(error=0.1), "observed": y}
        labels = np.repeat(np.arange(10), 2)
        prb.Simulator("frame", pair_of, *inputs, specimens=labels, **given)
    tree = posterior_of(mu=np.full((1, 3), 5.0))
    fitted_to = "10 specimens with 2 outputs of frame."
    if grouped:
        tree["posterior"] = xr.Dataset({"mu": (["chain", "draw", "kind"], np.full((1, 3, 2), 5.0))})
        fitted_to = "10 readings with 2 outputs of frame[one] and 10 readings with"
    (section,) = answer(gather(model=model, posterior=tree))
    assert f"is fitted to {fitted_to}" in section.text[0]


def test_problems_are_counted_on_page_one(calibrated: Any, section: Any) -> None:
    posterior = calibrated[2].copy(deep=True)
    posterior["posterior"]["mu"][0] += 5.0
    bad = prb.Report("x", posterior=posterior, validity=calibrated.test, pictures=False)
    assert any("R-hat" in p for p in section(bad, "Diagnostics").text)
    front = bad.sections[0]
    assert (front.title, front.verdict) == ("Not ready", "open")
    assert re.fullmatch(r"The calculation has \d problems? \(see Diagnostics\)\..*", front.text[0])
    p = f"{calibrated.test.p_value:.2g}"
    assert re.fullmatch(rf"Measurements of .* agree with the model \(p = {p}\)\.", front.text[1])
    assert "A shift of the mean by " in front.text[2]
    finding = Finding("not-identified", "The data do not see mu.")
    posterior["posterior"].attrs["findings"] = as_json([finding])
    again = prb.Report("x", posterior=posterior, pictures=False)
    assert "Posterior: The data do not see mu." in section(again, "Diagnostics").text


def test_many_parameters_are_in_the_appendix() -> None:
    first = posterior_of(p=np.array([[1.0, 2.0, 3.0], [2.0, 2.0, 2.0]]))
    (section,) = answer(gather(posterior={"a": first, "b": first}))
    assert cells(section.table).rows[0][:3] == ("p", "2.00", "0.63")
    many = {f"p{i}": np.random.default_rng(i).normal(size=(2, 20)) for i in range(31)}
    tree = posterior_of(**many)
    (section,) = answer(gather(posterior=tree))
    assert section.text == ("The estimates are in the appendix.",)
    assert section.table is None
    (section,) = comparison(gather(posterior={"a": tree, "b": tree}))
    assert len(section.table) == 2 * 31, "all rows, where a notebook shows a page"


def test_an_unidentified_parameter_has_no_standard_error(calibrated: Any) -> None:
    stderr = calibrated.optimum.stderr | {"sigma": np.inf}
    optimum = dataclasses.replace(calibrated.optimum, stderr=stderr)
    labels = {"mu": "mean of the exponent"}
    (section,) = answer(gather(optimum=optimum, labels=labels, model=calibrated.model))
    mu, sigma = cells(section.table).rows
    assert mu[:2] == ("mu", "mean of the exponent")
    assert float(sigma[2]) == pytest.approx(optimum.point["sigma"], rel=1e-3)
    assert sigma[3] == NOTHING
    assert "The data do not identify a parameter without a standard error." in section.text


def test_a_test_of_the_scatter_is_called_so(calibrated: Any) -> None:
    above = dataclasses.replace(calibrated.test, statistic=0.4, p_value=0.0001, folded=True)
    (section,) = agreement(gather(validity=above))
    assert section.text[0].startswith(
        "The scatter of the measured values differs too much from the prediction. Of a right model,"
        " less than 0.1% of such tests"
    )
    below = dataclasses.replace(above, statistic=0.1, p_value=0.4)
    (section,) = agreement(gather(validity=below))
    assert "values agrees with the prediction. Of a right model, 40% of" in section.text[0]


def test_a_test_of_several_outputs_counts_directions(section: Any) -> None:
    rng = np.random.default_rng(1)
    predicted = rng.normal(rng.normal(0, 0.25, (50, 1, 2)), 1.0, (50, 100, 2))
    null = prb.validation.PosteriorNull(99)
    test = prb.area_test(rng.normal(size=(12, 2)), predicted, null=null)
    made = prb.Report("x", validity=test, pictures=False)
    assert made.sections[0].text[0].startswith("Measurements of 12 specimens agree")
    table = section(made, "Test statistics").table
    assert table["of"].tolist() == ["u and |2u - 1|"]
    assert table["directions"].tolist() == ["4"]


def test_next_steps_depend_on_the_results(calibrated: Any) -> None:
    """An optimum needs a posterior and a test, a rejected model a correction."""
    optimum, posterior, test = calibrated.optimum, calibrated.posterior, calibrated.test

    def steps(**given: Any) -> str:
        sections = next_steps(gather(model=calibrated.model, **given))
        texts = [text for section in sections for text in section.text]
        assert [text.partition(". ")[0] for text in texts] == [
            str(i + 1) for i in range(len(texts))
        ]
        return " ".join(texts)

    assert steps() == ""
    assert "Compute the posterior" in steps(optimum=optimum)
    assert "Test the model on specimens" in steps(optimum=optimum)
    assert "Compute the posterior" not in steps(posterior=posterior)
    assert "Test the scatter as well" in steps(posterior=posterior, validity=test)
    names = np.array([f"later{DIRECTION}{k % 4 + 1}" for k in range(test.u_values.size)])
    several = dataclasses.replace(test, conditions=names)
    assert "Test the scatter" not in steps(posterior=posterior, validity=several)
    rejected = dataclasses.replace(test, p_value=0.001)
    text = steps(posterior=posterior, validity=rejected)
    assert text.startswith("1. Do not use the model beyond")
    assert "Test the scatter" not in text
    bad = posterior.copy(deep=True)
    bad["posterior"]["mu"][0] += 5.0
    assert steps(posterior=bad).startswith("1. Solve the problems")
    by_draw = xr.DataArray([[0.01, 0.2]], dims=("chain", "draw"))
    risk = xr.Dataset({"probability": 0.1, "by_draw": by_draw, "error": 0.01})
    for verdict_text, is_open in (("not decided", True), ("met", False)):
        decision = {"P": risk.assign_attrs(verdict=verdict_text)}
        text = steps(posterior=posterior, validity=test, decision=decision)
        assert ("plan how many more would decide it" in text) == is_open
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
    passed = prb.Report("x", posterior=boot, validity=calibrated.test, pictures=False).sections[0]
    assert passed.title == "Passed"
    assert passed.text[-1] == "Not all results were diagnosed: that needs the model."
