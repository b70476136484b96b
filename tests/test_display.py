"""Results in a notebook."""

import pickle

import numpy as np
import pymc as pm
import xarray as xr

import prbayes as prb
from prbayes._display import view
from prbayes._finding import Finding


def build() -> pm.Model:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
        prb.Simulator(
            "y", np.positive, x, metric=prb.AreaMetric(), observed=[0.0, 2.0, 4.0],
            propagation=prb.Reweighted(64),
        )  # fmt: skip
    return model


def test_texts_are_escaped() -> None:
    text = view("<b>", header=["", "<i>"], rows=[["a<u>", "1 < 2"]], sentences=["x & y"])
    for tag in ("<i>", "<u>", "1 < 2", "x & y"):
        assert tag not in text
    assert "&lt;b&gt;" in text
    assert "1 &lt; 2" in text


def test_an_optimum_is_a_table() -> None:
    optimum = prb.minimize(build())
    text = optimum._repr_html_()
    assert ">mu</th>" in text
    assert f"{optimum.search.n_evaluations} evaluations" in text
    assert "standard error" in text
    assert "0.0% of specimens fail" not in repr(optimum)


def test_a_diagnosis_says_what_is_wrong_first() -> None:
    support = xr.Dataset()
    first, second, remark = (Finding("code", text) for text in ("do this", "do that", "by the way"))
    bad = prb.Diagnosis((first, second), support, (remark,))
    text = bad._repr_html_()
    assert "2 problems" in text
    assert text.index("do this") < text.index("do that") < text.index("by the way")
    assert "no problem" in prb.Diagnosis((), support)._repr_html_()


def test_a_comparison_is_a_table_and_a_part_of_it_a_dataset() -> None:
    model = build()
    table = prb.compare({"the optimum": prb.minimize(model)}, model=model)
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
