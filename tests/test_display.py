"""Results in a notebook."""

import pickle
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pymc as pm
import pytest
import xarray as xr
from one_input import one_input

import prbayes as prb
from prbayes._display import View, view
from prbayes._finding import Finding
from prbayes.model.random_variable import simulators


@cache
def build() -> pm.Model:
    return one_input([0.0, 2.0, 3.0, 4.0], prb.AreaMetric(), propagation=prb.Reweighted(64), sd=1.0)


def test_texts_are_escaped() -> None:
    text = view("<b>", header=["", "<i>"], rows=[["a<u>", "1 < 2"]], sentences=["x & y"])
    for tag in ("<i>", "<u>", "1 < 2", "x & y"):
        assert tag not in text
    assert "&lt;b&gt;" in text
    assert "1 &lt; 2" in text


def test_a_diagnosis_says_what_is_wrong_first() -> None:
    support = xr.Dataset()
    first, second, remark = (Finding("code", text) for text in ("do this", "do that", "by the way"))
    bad = prb.Diagnosis((first, second), support, (remark,))
    text = bad._repr_html_()
    assert "2 problems" in text
    assert text.index("do this") < text.index("do that") < text.index("by the way")
    assert "no problem" in prb.Diagnosis((), support)._repr_html_()


def test_a_comparison_is_a_table_and_a_part_of_it_a_dataset() -> None:
    table = prb.compare({"the optimum": optimum()}, model=build())
    for shown in (table, pickle.loads(pickle.dumps(table)), table.copy()):
        text = shown._repr_html_()
        own = table.sel(result="the optimum", hyperparameter="mu")
        assert text.count("<tr>") == 2
        for key in ("estimate", "sd", "lower", "upper"):
            assert f"{float(own[key]):.4g}" in text
        assert ">the optimum</td>" in text
        assert f"Discrepancy by AreaMetric: the optimum {float(own['AreaMetric']):.4g}." in text
        assert "seconds" not in text
    for part in (table[["estimate"]], own, table.drop_vars("lower")):
        assert "xarray" in part._repr_html_()


def test_a_test_of_validity_shows_its_verdict() -> None:
    rng = np.random.default_rng(1)
    predicted = rng.normal(rng.normal(0, 0.2, (50, 1)), 1.0, (50, 200))
    test = prb.area_test(rng.normal(2, 1, 20), predicted)
    assert "ValidityTest: rejected at level 0.05" in test._repr_html_()


@cache
def optimum() -> prb.Optimum:
    return prb.minimize(build(), starts=0, progressbar=False)


@cache
def by_specimen() -> prb.Optimum:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1, 1), pm.HalfNormal("sigma", 1), name="x")
        prb.Simulator("y", lambda x: 2 * x, x, observed=[1.0, 2.0, 2.5, 3.0, 1.5])
    return prb.minimize(model, starts=0, progressbar=False)


def aleatory(model: pm.Model) -> Any:
    optimum()  # the first use
    return next(iter(simulators(model).values())).inputs.aleatory[0]


def later(x: Any) -> Any:
    return np.exp(x)


def two(x: Any) -> Any:
    return {"first": x, "second": -x}


@cache
def result(name: str) -> Any:
    """Return a result with few runs and draws, which no test changes."""
    model, best = build(), optimum()
    x = aleatory(model)
    mean, data = prb.decision.Mean(later, x), {"A": [1.0, 2.0, 3.0], "B": [2.0, 2.5, 4.0]}
    table = np.linspace(1, 2, 12)
    makers: dict[str, Callable[[], Any]] = {
        "minimize": lambda: best,
        "diagnose": lambda: prb.diagnose(best),
        "cost": lambda: prb.cost(model),
        "predict": lambda: prb.predict(best, later, x, n_samples=50),
        "predict, two outputs": lambda: prb.predict(best, two, x, n_samples=50),
        "exceedance": lambda: prb.exceedance(best, later, 1.0, x, requirement=0.9),
        "p_box": lambda: prb.decision.p_box(best, later, x, n_draws=50),
        "evaluate": lambda: prb.decision.evaluate(best, mean),
        "sensitivity": lambda: prb.sensitivity(best, mean, n_points=64),
        "plan": lambda: prb.plan(best, {"as now": prb.decision.Condition(later, x)}, k=[5, 10]),
        "population": lambda: prb.population(best, n_draws=50),
        "compare": lambda: prb.compare({"one": best, "two": best}, model=model),
        "cross_validate": lambda: prb.cross_validate(best, folds=2),
        "rank": lambda: prb.rank({"one": best, "two": best}, folds=2),
        "area_test": lambda: prb.area_test([1.0, 2.0], prb.predict(best, later, x)),
        "Surrogate": lambda: prb.Surrogate.fit(np.square, {"x": (0, 1)}, 16, progressbar=False),
        "Runs": lambda: prb.Runs({"x": table}, {"sag": table**2}),
        "individuals": lambda: prb.individuals(by_specimen(), n_draws=20),
        "calibrate_each": lambda: prb.calibrate_each(
            data, model=by_specimen().model, draws=20, validation={"A": [1.0]}, progressbar=False
        ),
        "simulation_based_calibration": lambda: prb.simulation_based_calibration(
            2, model=model, draws=20, progressbar=False
        ),
    }
    return makers[name]()


# The first words of each result, and a column of its DataFrame.
RESULTS = {
    "minimize": ("Optimum: discrepancy", "standard error"),
    "diagnose": ("", "code"),
    "cost": ("y: Reweighted", "first"),
    "predict": ("Predicted later: 50 specimens of each of 1 population", "later"),
    "predict, two outputs": ("Predicted two: 50 specimens of each of 1 population", "two"),
    "exceedance": ("Probability that later is above 1: ", "probability"),
    "p_box": ("Distribution of later, with 89% bands", "lower"),
    "evaluate": ("mean of later: ", "estimate"),
    "sensitivity": ("mean of later: ", "total"),
    "plan": ("Expected standard deviations after more specimens", "sd"),
    "population": ("Population, with 89% intervals", "estimate"),
    "compare": ("Comparison", "estimate"),
    "cross_validate": ("Cross-validation of 4 specimens in 2 folds", "discrepancy"),
    "rank": ("Models by the log score of 4 specimens, 2 folds", "difference"),
    "area_test": ("ValidityTest: ", "u"),
    "Surrogate": ("Surrogate: RadialBasis", "x"),
    "Runs": ("Runs: 12 runs, 0 of them without response", "sag"),
    "individuals": ("Inputs of the measured specimens", "mean"),
    "calibrate_each": ("2 products, ", "mu"),
    "simulation_based_calibration": ("Ranks of true hyperparameters in 2 data sets", "mean rank"),
}


@pytest.mark.parametrize("name", RESULTS)
def test_a_result_prints_as_a_sentence_shows_a_table_and_is_a_dataframe(name: str) -> None:
    sentence, column = RESULTS[name]
    shown = result(name)
    assert str(shown) == repr(shown)
    assert str(shown).startswith(sentence)
    table = shown.to_dataframe()
    assert isinstance(table, pd.DataFrame)
    assert column in table.reset_index().columns
    if name == "diagnose":  # findings alone are sentences
        return
    assert "<table>" in shown._repr_html_()
    texts = table.select_dtypes(exclude="number").map(str).to_numpy().ravel()
    assert max(map(len, texts), default=0) < 20
    again = pickle.loads(pickle.dumps(shown))
    assert str(again) == str(shown)


@pytest.mark.parametrize(
    ("name", "select"),
    [
        ("predict", lambda t: t.isel(sample=0)),
        ("predict", lambda t: t.mean(("chain", "draw"))),
        ("exceedance", lambda t: t.isel(draw=0)),
        ("sensitivity", lambda t: t.sel(factor="mu")),
        ("plan", lambda t: t.isel(k=0)),
        ("rank", lambda t: t.isel(candidate=0)),
        ("individuals", lambda t: t["posterior"]),
    ],
)
def test_a_selection_shows_as_xarray_s_own(name: str, select: Callable[[Any], Any]) -> None:
    part = select(result(name))
    assert repr(part).startswith("<xarray.")
    assert "xarray" in part._repr_html_() or "xr-" in part._repr_html_()


def test_results_are_xarray_objects_and_survive_a_file(tmp_path: Path) -> None:
    for name in ("exceedance", "sensitivity", "plan", "p_box", "evaluate"):
        table = result(name)
        table.to_netcdf(tmp_path / f"{name}.nc")
        loaded = xr.load_dataset(tmp_path / f"{name}.nc")
        assert loaded.equals(table)
        assert type(loaded) is xr.Dataset
    predicted = result("predict")
    assert float(predicted.quantile(0.5)) == float(np.quantile(predicted.values, 0.5))


def test_a_requirement_and_bounds_are_in_the_sentence() -> None:
    x = aleatory(build())
    table = result("exceedance")
    text = str(table)
    assert f": {float(table.probability):.2g}, 89% interval {float(table.lower):.2g} to" in text
    assert "At most 0.9 is required: not met." in text
    bounds = prb.exceedance(
        optimum(), lambda x, a: a * x, 1.0, x, prb.decision.Interval(1, 2), steps=2, n_draws=50
    )
    low, high = bounds.probability.values
    assert f"lambda(x, a) is above 1: {low:.2g} to {high:.2g}" in str(bounds)
    assert len(bounds.to_dataframe()) == 2


def test_a_long_table_ends_with_the_number_of_rows_left_out() -> None:
    shown = View("heading", rows=[[str(i), "1"] for i in range(100)])
    assert "60 more rows are in .to_dataframe()." in str(shown)
    assert str(shown).count("\n") == 41


def test_failures_and_missing_values_of_a_prediction_are_shown() -> None:
    x = aleatory(build())
    shown = str(prb.predict(optimum(), lambda x: np.where(x > 2, np.inf, x), x, name="f"))
    assert "inf" in shown


def test_tables_have_the_numbers_of_their_results() -> None:
    drawn = result("individuals")
    table = drawn.to_dataframe()
    draws = drawn["posterior"]["x"].isel(specimen=1)
    row = table[table["specimen"] == drawn["posterior"]["specimen"].values[1]].iloc[0]
    expected = [draws.mean(), draws.std(), *draws.quantile([0.055, 0.945])]
    np.testing.assert_allclose(row[["mean", "sd", "lower", "upper"]].astype(float), expected)
    # A group or a selection is a table of its variables.
    assert "x" in drawn["posterior"].mean(("chain", "draw")).to_dataframe().columns

    products = result("calibrate_each")
    table = products.to_dataframe()
    mu = products["posterior"]["mu"].sel(product="B").values
    np.testing.assert_allclose(
        table.loc["B", ["mu", "sd of mu"]].astype(float), [mu.mean(), mu.std()]
    )
    assert f"{mu.mean():.4g} ± {mu.std():.2g}" in str(products)
    assert "0 of 1 rejected" in str(products)

    ranks = result("simulation_based_calibration")
    assert ranks.to_dataframe().loc["mu", "mean rank"] == ranks["prior_sbc"]["mu"].mean()

    x = aleatory(build())
    predicted = prb.predict(optimum(), two, x, n_samples=500)
    first, second = (line.split() for line in str(predicted).splitlines()[2:4])
    assert [first[0], second[0]] == ["two[first]", "two[second]"]
    np.testing.assert_allclose(
        np.array(first[1:], dtype=float),
        [
            *(predicted.sel(output="first").mean(), predicted.sel(output="first").std()),
            *predicted.sel(output="first").quantile([0.05, 0.5, 0.95]),
        ],
        rtol=1e-3,
    )


def test_outputs_of_a_mapping_keep_their_names_when_runs_are_known() -> None:
    x = aleatory(build())

    def fresh(x: Any) -> Any:
        return {"up": x, "down": -x}

    for _ in range(2):
        drawn = prb.predict(optimum(), fresh, x, n_samples=50)
        assert drawn["output"].values.tolist() == ["up", "down"]
