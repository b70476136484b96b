"""What to do next follows from what was found."""

import dataclasses
from typing import Any

import numpy as np
import xarray as xr

import prbayes as prb
from prbayes.reports.material import gather
from prbayes.reports.next_steps import next_steps
from prbayes.validation.conditions import DIRECTION


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
    for verdict, said in (("not decided", True), ("met", False)):
        asked = table.assign_attrs(verdict=verdict)
        found = steps(calibrated, **given, decision={"P": asked})
        assert ("with prb.decision.Exceedance as its quantity" in found) == said


def test_without_a_result_there_is_nothing_to_do(calibrated: Any) -> None:
    assert steps(calibrated) == ""
    report = prb.Report("x", model=calibrated.model, pictures=False)
    assert "What to do next" not in [section.title for section in report.sections]
