"""The chapters of a report in order: data, method, decision, and the appendix."""

import dataclasses
import re
from functools import cache
from typing import Any

import arviz as az
import numpy as np
import pymc as pm
import pytest
import xarray as xr
from decisions import normal, optimum, same
from one_input import one_input, posterior_of

import prbayes as prb
from prbayes._finding import Finding
from prbayes.optimize.convergence import Result
from prbayes.reports.assessment import data, population_in_units
from prbayes.reports.material import Observed, gather, metrics_of
from prbayes.reports.numbers import NOTHING, cells
from prbayes.reports.sections import (
    _other_optimum,
    measured_values,
    metric,
    optima,
    posteriors,
)
from prbayes.response.outputs import Outputs


def test_model_and_data(
    observed: Any, report: prb.Report, page: Any, row: Any, section: Any
) -> None:
    assert row("mu", "distribution", page)["distribution"] == "Normal(1.5, 1)"
    assert row("cv", "distribution", page) == {
        "variable": "cv", "role": "deterministic", "distribution": "computed from sigma, mu",
    }  # fmt: skip
    assert row("y", "inputs", page)["inputs"] == "x ~ Normal(mu, sigma)"
    assert row("y", "runs", page)["runs"] == "256 runs, once; weighted for each population"
    data = row("y", "smallest", page)
    assert data["N"] == "30"
    found = [float(data[key]) for key in ("smallest", "largest", "mean", "sd")]
    expected = [observed.min(), observed.max(), observed.mean(), observed.std(ddof=1)]
    np.testing.assert_allclose(found, expected, atol=5.1e-4)
    assert "y: 30 specimens: 100, 101" in " ".join(section(report, "Evidence").text)


def number_row(row: dict[str, str], *keys: str) -> list[float]:
    """Return the numbers of some columns."""
    return [float(row[key]) for key in keys]


def test_metric_optimum_and_posterior(
    calibrated: Any, report: prb.Report, page: Any, row: Any, section: Any
) -> None:
    _, optimum, posterior, _ = calibrated
    calibration = posterior["calibration"]
    of_posterior = number_row(row("posterior", "epsilon", page), "epsilon", "discrepancy")
    expected = [float(calibration["epsilon"][0]), float(calibration["discrepancy"].mean())]
    np.testing.assert_allclose(of_posterior, expected, rtol=1e-3)
    of_optimum = float(row("optimum", "epsilon", page)["discrepancy"])
    assert of_optimum == pytest.approx(optimum.discrepancy, rel=1e-3)
    text = section(report, "Cost and origin").text
    assert any(line.startswith("y: KullbackLeibler(") for line in text)
    assert any(line.startswith("y: Reweighted(n=256, ") for line in text)
    text = section(report, "Measured against simulated responses").text
    assert "Here it is the Kullback-Leibler divergence." in text
    evaluations = f"after {optimum.search.n_evaluations} evaluations"
    assert evaluations in " ".join(section(report, "Optimum").text)
    summary = az.summary(posterior, ci_prob=0.89, ci_kind="eti", round_to="none")
    for name in ("mu", "sigma", "cv"):
        error = optimum.stderr[name]
        estimate = number_row(row(name, "standard error", page), "estimate", "standard error")
        np.testing.assert_allclose(estimate, [optimum.point[name], error], atol=6e-3 * error)
        cells_of, exact = row(name, "R-hat", page), summary.loc[name]
        draws = posterior["posterior"][name].values
        expected = [draws.mean(), draws.std(ddof=1), *np.quantile(draws, [0.055, 0.945])]
        estimates = number_row(cells_of, "mean", "sd", "89% from", "to")
        np.testing.assert_allclose(estimates, expected, atol=exact["sd"] * 6e-3)
        sizes = number_row(cells_of, "ESS, bulk", "ESS, tail")
        np.testing.assert_allclose(sizes, exact[["ess_bulk", "ess_tail"]], atol=0.6)
        assert float(cells_of["R-hat"]) == pytest.approx(exact["r_hat"], abs=6e-4)
        assert float(cells_of["error of mean"]) == pytest.approx(exact["mcse_mean"], rel=0.06)


def test_results_under_different_metrics(calibrated: Any) -> None:
    first = calibrated.optimum.to_datatree()
    changed = first.copy(deep=True)
    table = changed["calibration"].to_dataset()
    changed["calibration"] = table.assign(metric=("simulator", ["Other()"]))
    assert list(metrics_of(gather(optimum={"a": first, "b": first}))) == ["y"]
    m = gather(optimum={"a": first, "b": changed})
    assert list(metrics_of(m)) == ["a, y", "b, y"]
    assert metrics_of(m)["b, y"] == "Other()"
    (different,) = metric(m)
    assert "Epsilon" not in different.text[0], "optima have none"
    assert "epsilon" not in cells(different.table).header


def test_few_values_and_many_outputs() -> None:
    m = dataclasses.replace(gather(), observed={"y": Observed(np.array([2.5]))})
    (row,) = cells(data(m)[0].table).rows
    assert row == ("y", "1", "2.500", "2.500", "2.500", "\u2013")
    curve = np.random.default_rng(1).normal(size=(5, 40))
    outputs = Outputs(tuple(np.arange(40) / 2), "hour")
    m = dataclasses.replace(m, observed={"y": Observed(curve, outputs)})
    (about,) = data(m)
    correlations, values = measured_values(m)
    rows = cells(about.table).rows
    assert len(rows) == len(cells(correlations.table).rows) == 12
    assert [rows[0][1], rows[-1][1]] == ["0", "19.5"]
    assert "y: 12 of 40 outputs are shown." in about.text
    assert len(values.text) == 41  # of few specimens all outputs are listed


# -- several outputs -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def measured() -> Any:
    """Two outputs of 20 specimens: of the second two were not measured, and one has failed."""
    y = np.random.default_rng(1).normal([5.0, 70.0], [0.5, 3.0], (20, 2))
    y[:2, 1], y[2, 1] = np.nan, np.inf
    return y


@pytest.fixture(scope="module")
def frame(measured: Any) -> pm.Model:
    coords = {"mode": ["first", "second"], "units": ("mode", ["Hz", "mm"])}
    data = xr.DataArray(measured, dims=("i", "mode"), coords=coords)
    with pm.Model() as model:
        inputs = pm.Normal.dist(pm.Normal("mu", 5, 1), 0.5), pm.Normal.dist(70, 3.0)
        metric, few = prb.Joint(prb.ProbabilityResidual()), prb.Resimulated(128)
        response = lambda a, b: np.stack([a, b], axis=-1)  # noqa: E731
        prb.Simulator("frame", response, *inputs, metric=metric, observed=data, propagation=few)
    return model


def test_each_output_has_a_row_and_pairs_have_correlations(frame: Any, measured: Any) -> None:
    m = gather(frame)
    (about,) = data(m)
    correlations, values = measured_values(m)
    table = cells(about.table)
    assert table.header == (
        *("measured", "output", "units", "N", "failed", "missing"),
        *("smallest", "largest", "mean", "sd"),
    )
    first, second = table.rows
    assert first[:6] == ("frame", "first", "Hz", "20", "0", "0")
    assert second[:6] == ("frame", "second", "mm", "18", "1", "2")
    known = measured[3:, 1]
    assert float(second[8]) == pytest.approx(known.mean(), abs=0.01)
    assert float(second[9]) == pytest.approx(known.std(ddof=1), abs=0.01)
    r = np.corrcoef(measured[3:].T)[0, 1]
    assert correlations.title == "Correlations of frame"
    assert cells(correlations.table).rows[0][1:] == ("1", f"{r:.3f}")
    _, first_listed, second_listed = values.text
    numbers = first_listed.removeprefix("frame[first]: ").removesuffix(".").split(", ")
    np.testing.assert_allclose(list(map(float, numbers)), measured[:, 0], atol=1e-3)
    assert second_listed.removeprefix("frame[second]: ").split(", ")[:3] == [NOTHING, NOTHING, "∞"]


def test_outputs_and_units_are_those_of_the_model_in_a_result_alone(frame: Any) -> None:
    optimum = prb.minimize(frame, starts=0)

    def sections(m: Any) -> list[Any]:
        return [*data(m), *measured_values(m)]

    stored = sections(gather(optimum=optimum.to_datatree()))
    for section, of_model in zip(stored, sections(gather(frame)), strict=True):
        assert section.text == of_model.text
        if section.table is not None:
            assert cells(section.table) == cells(of_model.table)
    report = prb.Report("Frame", optimum=optimum, model=frame, pictures=False)
    assert "fitted to 20 specimens with 2 outputs of frame, and" in report.sections[0].text[0]
    values = xr.DataArray([1.0, 2.0, 4.0], dims="specimen", attrs={"units": "N/mm"})
    model = one_input(values, prb.AreaMetric(), prb.Reweighted(64), mu=(2, 1), sd=1.0)
    optimum = prb.minimize(model, starts=0)
    for material in (gather(model), gather(optimum=optimum.to_datatree())):
        about, listed = sections(material)
        assert listed.text[1] == "y: 1.000, 2.000, 4.000."
        assert about.table["units"].tolist() == ["N/mm"]
    assert prb.plots.plot_responses(optimum).axes[0].get_xlabel() == "y (N/mm)"


def test_elements_have_the_same_names_in_every_table(section: Any) -> None:
    """ArviZ has names of its own, and its own order."""
    rng = np.random.default_rng(2)
    means = np.array([[10.0, 20.0, 30.0], [40.0, 50.0, 60.0]])
    posterior = xr.Dataset(
        {
            "z": (["chain", "draw"], 70 + rng.normal(size=(2, 30))),
            "a": (["chain", "draw", "part", "load"], means + rng.normal(size=(2, 30, 2, 3))),
        },
        {"part": ["shaft", "disk"], "load": [5, 6, 7]},
    )
    tree = xr.DataTree.from_dict({"posterior": posterior})
    made = prb.Report("x", posterior=tree, pictures=False)
    rows = cells(section(made, "Posterior").table).rows
    loads = ["shaft,5", "shaft,6", "shaft,7", "disk,5", "disk,6", "disk,7"]
    assert [r[0] for r in rows] == ["z", *(f"a[{load}]" for load in loads)]
    found = [float(r[1]) for r in rows]
    np.testing.assert_allclose(found, [70, *means.ravel()], atol=1)


@pytest.mark.parametrize(
    ("adjustment", "sentence"),
    [
        ("estimate", "The posterior is that given the metric's own estimate: prior times density"),
        ("none", "The draws are those of exp(-discrepancy / epsilon): their width is epsilon's."),
    ],
)
def test_the_width_of_the_draws_is_explained(
    adjustment: str, sentence: str, calibrated: Any
) -> None:
    tree = calibrated.posterior.copy(deep=True)
    tree["posterior"].attrs["adjustment"] = adjustment
    assert posteriors(gather(posterior=tree))[0].text[1].startswith(sentence)
    tree["posterior"]["cv"][:] = 1.0  # a variable that never moves
    rows = {row[0]: row for row in cells(posteriors(gather(posterior=tree))[0].table).rows}
    assert rows["cv"][1] == "1.000"


def test_other_optima_are_reported(calibrated: Any) -> None:
    others = tuple(
        {"point": {"mu": mu}, "discrepancy": 0.25, "comparable": comparable}
        for mu, comparable in ((-1.5, True), (3.0, False))
    )
    search = dataclasses.replace(
        calibrated.optimum.search, result=Result.FAILED, details="It stopped."
    )
    optimum = dataclasses.replace(calibrated.optimum, local_optima=others, search=search)
    (section,) = optima(gather(optimum=optimum))
    ended, first, second, _ = section.text
    assert ended.startswith("The optimiser did not converge after ")
    assert ended.endswith("of the objective: The minimiser failed. It stopped.")
    assert first == (
        "Another optimum is at mu = -1.500, with discrepancy 0.2500: "
        "the data could as well come from there."
    )
    assert second.endswith("the data fit it less well; a posterior gives its weight.")
    # A place of many elements is described by scalars alone
    for size, beginning in ((7, "mu = 2.000, w[0]"), (8, "mu = 2.000, with")):
        point = xr.Dataset({"mu": 2.0, "w": ("k", np.ones(size))}).data_vars
        names = ["mu", *(f"w[{i}]" for i in range(size))]
        rival = {"discrepancy": 0.1, "comparable": False}
        assert f"is at {beginning}" in _other_optimum(rival, point, names)


def test_a_covariance_is_shown_by_standard_deviations_and_correlations(calibrated: Any) -> None:
    expected = ["mu", "chol_corr[0,1]", "chol_stds[0]", "chol_stds[1]"]
    matrix = np.array([[1.0, 0.3], [0.3, 1.0]])
    point = {"mu": 1.0, "chol": np.ones(3), "chol_corr": matrix, "chol_stds": np.ones(2)}
    stderr = {name: 0.1 * np.ones(np.shape(value)) for name, value in point.items()}
    stderr["chol_corr"] = np.array([[0.0, 0.1], [0.1, 0.0]])
    optimum = dataclasses.replace(calibrated.optimum, point=point, stderr=stderr)
    (section,) = optima(gather(optimum=optimum))
    assert [row[0] for row in cells(section.table).rows] == expected
    rng = np.random.default_rng(0)
    r = np.tanh(rng.normal(size=(2, 100)))
    tree = posterior_of(
        mu=rng.normal(size=(2, 100)),
        chol=rng.normal(size=(2, 100, 3)),
        chol_corr=np.array([[np.ones_like(r), r], [r, np.ones_like(r)]]).transpose(2, 3, 0, 1),
        chol_stds=rng.gamma(4.0, size=(2, 100, 2)),
    )
    for section in posteriors(gather(posterior=tree)):
        assert [row[0] for row in cells(section.table).rows] == expected


CHAPTERS = ["Decision", "Answer", "Evidence", "Method", "Diagnostics", "Appendix"]


def test_sections_depend_on_the_results_and_come_in_order(
    calibrated: Any, report: prb.Report, page: Any
) -> None:
    def chapters(report: prb.Report) -> list[str]:
        return [section.title for section in report.sections if section.level == 2]

    assert chapters(report) == ["Passed", *CHAPTERS]
    assert page.text("h1") == "Shaft"
    assert "2 May 2024" in page.text("p")
    alone = prb.Report("x", model=calibrated.model, pictures=False)
    assert chapters(alone) == ["Not calibrated", "Evidence", "Method", "Appendix"]
    assert alone.sections[0].text == ("No result of a calibration was given.",)
    tested = prb.Report("x", validity=calibrated.test, pictures=False)
    assert chapters(tested) == ["Passed", "Evidence", "Appendix"]
    optimum = prb.Report("x", optimum=calibrated.optimum, pictures=False)
    assert chapters(optimum) == ["Not tested", *CHAPTERS]
    titles = {section.title for section in optimum.sections}
    assert {"Posterior", "Comparison of results", "Test of the model"}.isdisjoint(titles)


def test_labels_of_numbers_among_the_inputs_are_taken(section: Any) -> None:
    with pm.Model() as model:
        k = pm.Normal.dist(pm.Normal("mu", 3, 1), 0.3)
        given: Any = {"metric": prb.AreaMetric(), "observed": [3.0, 3.3, 3.6]}
        prb.Simulator("y", bending, k, 10.0, units={"k": "kN/mm"}, **given)
    optimum = prb.minimize(model, starts=0)
    for labels, expected in (({}, "load = 10"), ({"load": "load (kN)"}, "load (kN) = 10")):
        report = prb.Report("x", model=model, optimum=optimum, labels=labels, pictures=False)
        (inputs,) = section(report, "Simulators").table["inputs"]
        assert inputs == f"k (kN/mm) ~ Normal(mu, 0.3), {expected}"


def bending(k: Any, load: float) -> Any:
    return load / k


# -- decision --------------------------------------------------------------------------------


@cache
def questions() -> dict[str, xr.Dataset]:
    _, x = normal()
    interval = prb.decision.Interval(0.0, 0.2)
    return {
        "risk": prb.exceedance(optimum(), same, 2.0, x, requirement=0.1),
        "bounds": prb.exceedance(optimum(), lambda x, by: x + by, 2.0, x, interval, steps=2),
        "influence": prb.sensitivity(optimum(), prb.decision.Mean(same, x), n_points=64),
        "plan": prb.plan(optimum(), {"same": prb.decision.Condition(same, x)}, k=[5, 20]),
    }


def decided(**given: Any) -> prb.Report:
    return prb.Report("Normal", optimum=optimum(), **{"pictures": False} | given)


def test_each_kind_of_question_has_a_table() -> None:
    sections = decided(decision=questions()).sections
    titles = [section.title for section in sections]
    at = titles.index("Decision")
    kinds = ["Probability beyond a limit", "What moves it", "What more data would change"]
    assert titles[at + 1 : at + 4] == kinds
    risk, moved, more = (section.table for section in sections[at + 1 : at + 4])
    assert risk.question.tolist() == ["risk", "bounds", "bounds"]
    assert risk["bound"].tolist() == ["", "lower", "upper"]
    expected = float(questions()["risk"].probability)
    assert float(risk.probability[0]) == pytest.approx(expected, rel=0.01)
    assert risk.required.tolist() == ["at most 0.1", "", ""]
    assert risk["requirement is"].tolist() == ["met", "", ""]
    assert moved.of[0].startswith("mean of same = 1.0")
    assert moved.of[2] == "the response"
    assert moved.factor.tolist() == ["mu", "sigma", "x"]
    assert moved["by itself"][0].startswith("1.00 ± ")
    assert more.specimens.tolist() == ["none more", "5 more, same", "20 more, same"]
    assert float(more.mu[2]) < float(more.mu[1]) < float(more.mu[0])


def test_sensitivities_have_a_picture_and_no_question_no_section() -> None:
    sections = decided(decision=questions()["influence"], pictures=True).sections
    (picture,) = [s for s in sections if s.title == "Shares of parameters and inputs"]
    assert picture.picture
    assert "Probability beyond a limit" not in [section.title for section in decided().sections]


def test_page_one_has_the_probability_and_whether_it_is_accepted() -> None:
    front, requirement, *_ = decided(decision=questions()).sections
    (bounds,) = [line for line in front.text if line.startswith("bounds: ")]
    assert re.search(r"[\d.]+% to [\d.]+% of the specimens are expected \(interval ", bounds)
    assert (requirement.title, requirement.verdict) == ("Requirement met", "good")
    (text,) = requirement.text
    assert re.match(r"risk: 0\.\d+% of the specimens are expected \(interval 0\.\d+% to \d", text)
    assert text.endswith("; allowed: at most 10%.")


@pytest.mark.parametrize(
    ("answer", "mark"), [("met", "good"), ("not met", "bad"), ("not decided", "open")]
)
def test_requirements_look_different(answer: str, mark: str) -> None:
    table = questions()["risk"].assign_attrs(verdict=answer)
    box = decided(decision={"risk": table}).sections[1]
    assert (box.title, box.verdict) == (f"Requirement {answer}", mark)


def test_intervals_of_other_probabilities_are_called_so() -> None:
    model, x = normal()
    few = prb.exceedance(optimum(), same, 4.0, x, model=model, prob=0.995, requirement=0.00125)
    condition, mean = prb.decision.Condition(same, x), prb.decision.Mean(same, x)
    more = prb.plan(optimum(), {"a": condition}, k=[5], quantity=mean)
    parts = decided(decision=questions() | {"few": few, "more": more}).sections
    (box,) = [section for section in parts if section.text and section.text[0].startswith("few: ")]
    assert "(99.5% interval " in box.text[0]
    assert box.text[0].endswith("; allowed: at most 0.125%.")
    tables = {section.title: section.table for section in parts}
    assert {"89% interval", "99.5% interval"} <= set(tables["Probability beyond a limit"])
    assert len(tables["What more data would change"]) == 5
    note = prb.Report("x", optimum=optimum(), decision=few, pictures=False).note
    assert note.endswith("intervals of 99.5% probability")
    assert "99.5% interval" in few.to_view().heading


def refuted() -> prb.validation.ValidityTest:
    """A test that rejects the model."""
    model, x = normal()
    predicted = prb.predict(optimum(), same, x, model=model)
    far = np.random.default_rng(0).normal(4.0, 0.5, 20)
    test = prb.area_test({"far": far}, {"far": predicted})
    assert test.rejected
    return test


def test_nothing_is_decided_by_a_model_that_is_rejected() -> None:
    sections = decided(decision=questions(), validity=refuted()).sections
    front, requirement, *_ = sections
    assert (front.title, front.verdict) == ("Rejected", "bad")
    assert len(front.text) == 1, "no probability"
    assert (requirement.title, requirement.verdict) == ("Requirement not answered", "open")
    assert requirement.text == (
        "risk; allowed: at most 10% of the specimens. There is no answer: the model is rejected.",
    )
    (decision,) = [section for section in sections if section.title == "Decision"]
    assert decision.text[0].startswith("Measurements contradict the model")
    (risks,) = [s.table for s in sections if s.title == "Probability beyond a limit"]
    assert risks["requirement is"].tolist() == ["not answered", "", ""]
    asked = decided(validity=refuted()).sections
    assert not [s for s in asked for line in s.text if "Ask for the probability" in line]


def test_a_requirement_is_not_answered_before_problems_are_removed() -> None:
    finding = Finding("not-converged", "The optimiser did not converge.")
    unfinished = dataclasses.replace(optimum(), findings=(finding,))
    sections = prb.Report("x", optimum=unfinished, decision=questions(), pictures=False).sections
    front, requirement, *_ = sections
    assert (front.title, front.verdict) == ("Not ready", "open")
    assert requirement.title == "Requirement not answered"
    assert requirement.text[0].endswith("There is no answer: solve the problems first.")
    (risks,) = [s.table for s in sections if s.title == "Probability beyond a limit"]
    assert risks["requirement is"].tolist()[0] == "not answered"
    (decision,) = [section for section in sections if section.title == "Decision"]
    assert decision.text[0].startswith("Solve the problems")


def test_what_is_no_decision_or_another_problem_s_is_refused() -> None:
    with pytest.raises(TypeError, match=r"decision: got int, expected the Dataset"):
        decided(decision={"a": 3})
    with pytest.raises(TypeError, match="got Comparison"):
        decided(decision=prb.compare({"optimum": optimum()}))
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("tau", 0, 1), 1.0)
        prb.Simulator("z", same, x, metric=prb.AreaMetric(), observed=[0.0, 1.0, 2.0])
    foreign = prb.exceedance(prb.minimize(model, starts=0, progressbar=False), same, 2.0, x)
    with pytest.raises(ValueError, match="expected"):
        decided(decision=foreign)


def test_the_population_is_in_units_near_the_answer(calibrated: Any) -> None:
    model, optimum, posterior, _ = calibrated
    material = gather(model, optimum, posterior, labels={"x": "stiffness (kN/mm)"})
    (part,) = population_in_units(material)
    assert part.level == 3
    table = prb.population(posterior, model=model)
    cells = dict(zip(part.table[""], part.table["stiffness (kN/mm)"], strict=True))
    assert list(cells)[:5] == ["mean", "sd", "cv (%)", "5% quantile", "50% quantile"]
    lower = float(table.lower.sel(quantity="mean")[0])
    assert cells["mean"].split("(")[1].startswith(f"{lower:.2f}")
    assert cells["A-basis"] == f"{float(table.estimate.sel(quantity='A-basis')[0]):.4g}"
    assert population_in_units(gather(optimum=optimum)) == []
    rejected = dataclasses.replace(calibrated.test, p_value=0.001)
    assert population_in_units(gather(model, None, posterior, rejected)) == []


@pytest.mark.long
def test_the_first_chapters_have_no_names_of_functions(calibrated: Any, report: prb.Report) -> None:
    """Page one, decision, answer and evidence are for a reader who decides."""
    words = r"prb\.|\w\(\w*=|random_seed|[Hh]yperparameter|[Ll]og-density|u-value|epsilon|\w\(s\)"
    bad = calibrated.posterior.copy(deep=True)
    bad["posterior"]["mu"][0] += 5.0
    for made in (
        report,
        prb.Report("x", posterior=bad, pictures=False),
        decided(decision=questions(), validity=refuted()),
    ):
        for section in made.sections:
            if section.title == "Method":
                break
            table = () if section.table is None else sum(cells(section.table).rows, ())
            for text in (section.title, *section.text, section.caption, section.alt, *table):
                assert not re.search(words, text), text
