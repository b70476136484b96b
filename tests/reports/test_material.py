"""Results of any origin are brought into one form, or refused; what is told of other files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm
import pytest
import xarray as xr
from one_input import one_input

import prbayes as prb
from prbayes._finding import Finding
from prbayes.optimize.convergence import Result
from prbayes.reports.material import gather
from prbayes.reports.numbers import cells


def test_files_alone_tell_the_same(tmp_path: Path, calibrated: Any, section: Any) -> None:
    model, optimum, posterior, _ = calibrated
    posterior.to_netcdf(tmp_path / "p.nc", engine="h5netcdf")
    optimum.to_datatree().to_netcdf(tmp_path / "o.nc", engine="h5netcdf")
    trees = [xr.open_datatree(tmp_path / f, engine="h5netcdf").load() for f in ("p.nc", "o.nc")]
    alone = prb.Report("Shaft", posterior=trees[0], optimum=trees[1], pictures=False)
    full = prb.Report("Shaft", posterior=posterior, optimum=optimum, model=model, pictures=False)
    titles = ["Not tested", "Answer", "Evidence", "Method", "Simulators", "Optimum", "Posterior"]
    for title in [*titles, "Comparison of results", "Cost and origin"]:
        a, b = section(alone, title), section(full, title)
        # Scores need the model.
        texts = [x for x in b.text if not x.startswith("Discrepancy by ")]
        assert list(a.text) == texts, title
        if a.table is not None:
            assert cells(a.table) == cells(b.table), title
    del trees[0]["posterior"].attrs["model"]
    without = prb.Report("Shaft", posterior=trees[0], pictures=False)
    assert "Simulators" not in [s.title for s in without.sections]
    assert "Posterior" in [s.title for s in without.sections]


@pytest.mark.parametrize(
    "text",
    [
        *("{", "[]", "3", "[" * 50_000),
        *('{"variables": 4}', '{"variables": [{"name": 1}], "simulators": []}'),
    ],
    ids=range(6),
)
def test_damaged_descriptions_are_ignored(text: str, calibrated: Any) -> None:
    posterior = calibrated[2].copy()
    posterior["posterior"].attrs["model"] = text
    titles = [s.title for s in prb.Report("x", posterior=posterior, pictures=False).sections]
    assert "Simulators" not in titles
    assert "Posterior" in titles


@pytest.mark.parametrize(
    ("keywords", "words"),
    [
        ({"posterior": "an optimum"}, "group posterior"),
        ({"optimum": "a posterior"}, "group optimum"),
        ({"optimum": "no errors"}, "a DataTree with the group stderr"),
        ({"posterior": "no draws"}, "without the dimensions"),
    ],
)
def test_what_is_given_as_something_else_is_refused(
    keywords: dict[str, Any], words: str, calibrated: Any
) -> None:
    results = {
        "an optimum": calibrated.optimum,
        "a posterior": calibrated.posterior,
        "no errors": xr.DataTree.from_dict({"optimum": xr.Dataset({"mu": 1.0})}),
        "no draws": xr.DataTree.from_dict({"posterior": xr.Dataset({"mu": 1.0})}),
    }
    ((kind, value),) = keywords.items()
    with pytest.raises((TypeError, ValueError), match=words):
        gather(**{kind: results[value]})


def test_draws_under_another_prior_are_refused_beside_the_model(
    observed: Any, calibrated: Any
) -> None:
    metric, few, labels = prb.KullbackLeibler(), prb.Reweighted(256), np.arange(100, 130)
    with one_input(observed, metric, few, mu=(1.5, 0.01), specimens=labels) as narrow:
        pm.Deterministic("cv", narrow["sigma"] / narrow["mu"])
    with pytest.raises(ValueError, match="posterior: got a result of another problem: prior of mu"):
        prb.Report("x", model=narrow, posterior=calibrated.posterior, pictures=False)
    # Beside draws of the model's own prior others may be shown.
    other = calibrated.posterior.copy()
    both = {"own": calibrated.posterior, "other": other}
    prb.Report("x", model=calibrated.model, posterior=both, pictures=False)


def test_validation_data_are_those_of_the_test(calibrated: Any) -> None:
    model, _, posterior, _ = calibrated
    x = pm.Normal.dist(model["mu"], model["sigma"])
    later = prb.predict(posterior, np.positive, x, model=model, random_seed=1)
    fresh = np.random.default_rng(4).normal(2.0, 0.6, 12)
    fewer = {"null": prb.validation.PosteriorNull(199)}
    given: dict[str, Any] = {"model": model, "posterior": posterior, "pictures": False}
    for test in (
        prb.area_test(fresh, later, **fewer),
        prb.area_test(fresh, later, folded=True, **fewer),
        prb.area_test({"a": fresh, "b": 2 * fresh}, {"a": later, "b": 2 * later}, **fewer),
    ):
        report = prb.Report("x", validity=test, validation={"hot": (fresh, later)}, **given)
        named = "of 24 specimens (a and b) agree" in report.sections[0].text[0]
        assert named == (len(test.of_conditions) == 2)
        prb.Report("x", validity=test, validation={"hot": (fresh.round(2), later)}, **given)
        for wrong in (fresh[:7], fresh + 1.0, fresh[::-1]):
            with pytest.raises(ValueError, match=r"hot: got .* values other than those of the t"):
                prb.Report("x", validity=test, validation={"hot": (wrong, later)}, **given)
    prb.Report("x", validation={"hot": (fresh[:7], later)}, **given)


def test_a_name_is_given_once(calibrated: Any) -> None:
    with pytest.raises(ValueError, match="different ones"):
        prb.Report("x", optimum={"a": calibrated.optimum}, posterior={"a": calibrated.posterior})


def test_a_saved_optimum_is_diagnosed_and_compared_as_in_memory(calibrated: Any) -> None:
    lost = replace(
        calibrated.optimum,
        search=replace(calibrated.optimum.search, result=Result.FAILED),
        findings=(Finding("not-identified", "The data do not see mu."),),
    )
    memory = gather(optimum=lost).diagnoses["optimum"]
    saved = gather(optimum=lost.to_datatree(), posterior=calibrated.posterior)
    diagnosis = saved.diagnoses["optimum"]
    assert memory is not None
    assert diagnosis is not None
    assert memory.messages == diagnosis.messages
    assert diagnosis.messages[0] == "The data do not see mu."
    assert "did not converge (The minimiser failed)" in diagnosis.messages[1]
    assert saved.comparison is not None
    assert saved.comparison["hyperparameter"].values.tolist() == ["mu", "sigma", "cv"]


@pytest.mark.long
def test_statistics_of_a_data_sheet_are_no_measured_responses() -> None:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 3, 1), pm.HalfNormal("sigma", 1))
        sheet = prb.Summary(n=40, mean=3.1, sd=0.9)
        prb.Simulator("load", np.positive, x, observed=sheet, propagation=prb.Reweighted(256))
    optimum = prb.minimize(model, starts=0)
    for given in ({"model": model, "optimum": optimum}, {"optimum": optimum.to_datatree()}):
        material = gather(**given)
        assert material.observed == {}
        assert material.sheets == {"load": "n = 40, mean = 3.1, sd = 0.9"}
        report = prb.Report("x", **given, pictures=False)
        text = "The model was fitted to a data sheet of load (n = 40, mean = 3.1, sd = 0.9)"
        assert report.sections[0].text[0].startswith(text)
        (evidence,) = [s for s in report.sections if s.title == "Evidence"]
        assert evidence.table is None
        assert "Measured values" not in [s.title for s in report.sections]
