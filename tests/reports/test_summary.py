"""The summary says what was calibrated, the answer, and whether it may be trusted."""

import dataclasses
import re
from typing import Any

import numpy as np
import pymc as pm
import pytest
import xarray as xr

import prbayes as prb
from prbayes._finding import Finding, as_json
from prbayes.reports.material import gather
from prbayes.reports.summary import next_steps, summary, verdict
from prbayes.validation.conditions import DIRECTION


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
