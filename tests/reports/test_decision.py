"""The section on decisions: tables of what was asked, and nothing where nothing was."""

from functools import cache
from typing import Any

import numpy as np
import pymc as pm
import pytest
import xarray as xr
from decisions import normal, optimum, same

import prbayes as prb


@cache
def questions() -> dict[str, xr.Dataset]:
    _, x = normal()
    interval = prb.decision.Interval(0.0, 0.2)
    return {
        "risk": prb.exceedance(optimum(), same, 2.0, x, requirement=0.1),
        "bounds": prb.exceedance(optimum(), lambda x, by: x + by, 2.0, x, interval, steps=2),
        "influence": prb.sensitivity(optimum(), prb.decision.Mean(same, x), n_samples=64),
        "plan": prb.plan(optimum(), {"same": prb.decision.Condition(same, x)}, k=[5, 20]),
    }


def report(**given: Any) -> prb.Report:
    return prb.Report("Normal", optimum=optimum(), **{"pictures": False} | given)


def test_each_kind_of_question_has_a_table() -> None:
    sections = report(decision=questions()).sections
    titles = [section.title for section in sections]
    at = titles.index("Decision")
    assert titles[at + 1 : at + 4] == [
        "Probability of exceedance",
        "What moves it",
        "What more data would change",
    ]
    risk, moved, more = (section.table for section in sections[at + 1 : at + 4])
    assert risk.question.tolist() == ["risk", "bounds", "bounds"]
    assert risk["bound"].tolist() == ["", "lower", "upper"]
    assert float(risk.probability[0]) == pytest.approx(
        float(questions()["risk"].probability), rel=0.01
    )
    assert risk.required.tolist() == ["at most 0.1", "", ""]
    assert risk["requirement is"].tolist() == ["met", "", ""]
    assert moved.of[0].startswith("mean of same = 1.0")
    assert moved.of[2] == "the response"
    assert moved.factor.tolist() == ["mu", "sigma", "x"]
    assert moved["by itself"][0].startswith("1.00 ± ")
    assert more.specimens.tolist() == ["none more", "5 more, same", "20 more, same"]
    assert float(more.mu[2]) < float(more.mu[1]) < float(more.mu[0])


def test_the_summary_has_the_probability_and_whether_it_is_accepted() -> None:
    said = report(decision=questions()).sections[0].text
    (risk,) = [line for line in said if line.startswith("risk: ")]
    assert risk.startswith("risk: probability 0.0069 (89% interval 0.00")
    assert risk.endswith("; the requirement, at most 0.1, is met.")


def test_nothing_is_decided_by_a_model_that_is_rejected() -> None:
    model, x = normal()
    predicted = prb.predict(optimum(), same, x, model=model)
    far = np.random.default_rng(0).normal(4.0, 0.5, 20)
    test = prb.area_test({"far": far}, {"far": predicted})
    assert test.rejected
    sections = report(decision=questions(), validity=test).sections
    assert not [line for line in sections[0].text if "probability 0" in line]
    assert "The questions of a decision are not answered by it." in sections[0].text
    (decision,) = [section for section in sections if section.title == "Decision"]
    assert decision.text[0].startswith("The calibrated model was rejected")
    asked = report(validity=test).sections
    assert not [s for s in asked for line in s.text if "prb.exceedance" in line]


def test_there_is_none_unless_asked() -> None:
    assert "Decision" not in [section.title for section in report().sections]


def test_the_picture_is_of_the_shares() -> None:
    sections = report(decision=questions()["influence"], pictures=True).sections
    (picture,) = [s for s in sections if s.title == "Shares of hyperparameters and inputs"]
    assert picture.picture


def test_what_is_no_decision_or_another_problem_s_is_refused() -> None:
    with pytest.raises(TypeError, match=r"decision: got int, expected the Dataset"):
        report(decision={"a": 3})
    with pytest.raises(TypeError, match="got Comparison"):
        report(decision=prb.compare({"optimum": optimum()}))
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("tau", 0, 1), 1.0)
        prb.Simulator("z", same, x, metric=prb.AreaMetric(), observed=[0.0, 1.0, 2.0])
    foreign = prb.exceedance(prb.minimize(model, progressbar=False), same, 2.0, x)
    with pytest.raises(ValueError, match="expected"):
        report(decision=foreign)
