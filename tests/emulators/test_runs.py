"""Tables of runs: reading, refusals by cell, ranges, labels, and the error of their surface."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pymc as pm
import pytest
import xarray as xr

import prbayes as prb
from prbayes.emulators.runs import continued, left_out_nearby, outlier_advice
from prbayes.numerics.points import sobol

X = np.array([0.0, 1.0]) + sobol(48, 2, 1)
TABLE = pd.DataFrame(X, columns=["x", "y"])


def bent(x: Any, y: Any) -> Any:
    return np.sin(2 * x) * y


@pytest.fixture(scope="module")
def runs() -> prb.Runs:
    return prb.Runs(TABLE, pd.Series(bent(*X.T), name="sag"))


def test_the_surface_has_its_cross_validated_error_and_is_nan_outside(runs: prb.Runs) -> None:
    x, y = 0.1 + 0.8 * np.random.default_rng(0).random((2, 200)) + np.array([[0.0], [1.0]])
    error = runs(x, y) - bent(x, y)
    assert np.sqrt((error**2).mean()) < runs.error.rms < 0.02
    assert np.isnan(runs([-0.1, np.nan, 0.5], [1.5, 1.5, 2.1])).all()
    assert "48 runs, 0 of them without response" in repr(runs)
    assert runs.inputs == ("x", "y")
    assert list(runs.to_dataframe()) == ["x", "y", "sag"]


def test_all_kinds_of_tables_are_read_alike(tmp_path: Path, runs: prb.Runs) -> None:
    y = bent(*X.T)
    path = tmp_path / "runs.csv"
    lines = [f"{i};{a!r};{b!r};{c!r}" for i, (a, b, c) in enumerate(zip(*X.T, y, strict=True))]
    text = "\n".join(["run;y;x;sag", *(line.replace(".", ",") for line in lines), ""])
    path.write_text(text.replace("np,float64(", "").replace(")", ""), encoding="utf-8-sig")
    # Columns of the file in another order than the simulator's inputs.
    columns = ["y", "x"]
    data = xr.DataArray(X, dims=("run", "input"), coords={"input": ["x", "y"]})
    shuffled = pd.Series(y, index=[f"r{i}" for i in range(48)])[::-1]
    tables = [
        prb.Runs({"x": X[:, 0], "y": X[:, 1]}, y[:, None]),
        prb.Runs(data, y),
        prb.Runs(xr.Dataset({"x": ("run", X[:, 0]), "y": ("run", X[:, 1])}), {"sag": y}),
        prb.Runs.read_csv(path, columns, ["sag"], delimiter=";", decimal=","),
        prb.Runs(TABLE.set_axis([f"r{i}" for i in range(48)]), shuffled),
    ]
    for table in tables:
        np.testing.assert_array_equal(table.responses, y)
        assert table.inputs == ("y", "x") if table is tables[3] else ("x", "y")
        np.testing.assert_allclose(table(0.5, 1.5) if table is not tables[3] else 0, 0, atol=9)


def test_rows_are_matched_by_their_index_in_every_kind_of_table() -> None:
    """Names of outputs remain, so that they can be matched to those of observed."""
    names = [f"r{i}" for i in range(48)]
    table = TABLE.set_axis(names).rename_axis("run")
    values = pd.DataFrame({"sag": bent(*X.T), "span": X[:, 0]}, table.index)
    backwards = values[::-1]
    for inputs in (table, dict(table), {"x": table.x, "y": table.y[::-1]}, table.to_xarray()):
        for responses in (backwards, dict(backwards), backwards.to_xarray()):
            runs = prb.Runs(inputs, responses)
            np.testing.assert_array_equal(runs.points, X)
            np.testing.assert_array_equal(runs.responses, values)
            assert runs.outputs == ("sag", "span")
    assert prb.Runs(table, backwards["sag"]).outputs == ("sag",)
    others = backwards.set_axis([f"s{i}" for i in range(48)])
    for inputs, responses in ((table, others), (dict(table), dict(others))):
        with pytest.raises(ValueError, match=r"sag: .*'s0'.* that of the inputs, \['r0'"):
            prb.Runs(inputs, responses)


def test_the_first_bad_cell_is_named(tmp_path: Path) -> None:
    path = tmp_path / "runs.csv"
    rows = [f"{k},{k * k}" for k in range(1, 12)]

    def read(*lines: str, outputs: tuple[str, ...] = ("sag",)) -> prb.Runs:
        path.write_text("\n".join(lines))
        return prb.Runs.read_csv(path, ["load"], outputs)

    assert np.isnan(read("load,sag", *rows, "12,").responses[-1])
    with pytest.raises(ValueError, match=r"line 2: load: got the text 'kN', .* lines of units out"):
        read("load,sag", "kN,mm", *rows)
    with pytest.raises(ValueError, match=r"line 13: sag: got the text 'n/a', .* pandas.read_csv"):
        read("load,sag", *rows, "12,n/a")
    with pytest.raises(ValueError, match=r"columns \['load', 'sag'\], expected 'sink' once"):
        read("load,sag", *rows, outputs=("sink",))
    with pytest.raises(ValueError, match=r"inputs: load: got nan in row 11 .*leave the row out"):
        read("load,sag", *rows, ",3")
    with pytest.raises(TypeError, match=r"x: got an array of dtype .*index 2 is the text '9,81'"):
        prb.Runs({"x": ["1", "2", "9,81"]}, [1, 2, 3])
    bad: list[tuple[Any, Any, str]] = [
        ({"x": X[:, 0], "y": np.ones(48)}, X[:, 1], "y: got 1 in all 48 runs"),
        (X[[0, 1, 2, 0, *range(4, 48)]], X[:, 1], "rows 0 and 3 .* with equal inputs"),
        (X[:7], X[:7, 1], "got 7 runs with responses for 2 .*at least 8"),
        (X, np.where(X[:, 0] < 0.9, np.nan, 1.0), "got 4 runs with responses"),
        (X, X[:9, 0], "got 9 values, expected 48"),
        (X, np.full(48, -np.inf), "got -inf|got 0 runs"),
        (np.tile(X, (100, 1)) + np.arange(100).repeat(48)[:, None], np.ones(4800), "at most 4000"),
    ]
    for inputs, responses, message in bad:
        with pytest.raises(ValueError, match=message):
            prb.Runs(inputs, responses)


def test_outputs_keep_their_labels_and_failed_runs_are_nan_nearby() -> None:
    values = pd.DataFrame({"b": X[:, 0] * X[:, 1], "a": np.where(X[:, 0] > 0.7, np.nan, X[:, 1])})
    table = prb.Runs(TABLE, values)
    near = table([0.3, 0.9], 1.5)
    np.testing.assert_allclose(near.sel(output="a"), [1.5, np.nan], atol=1e-4)
    assert table.remedy.startswith("leave out runs that failed by chance, add the runs")
    assert prb.Runs(TABLE, values["b"]).remedy.startswith("add the runs")
    assert table.responses.shape == (48, 2)


def test_beyond_the_ranges_the_continuation_is_linear() -> None:
    table = prb.Runs(TABLE, 3 * X[:, 0] - X[:, 1] + 2)
    at = np.array([-0.4, 1.6, 0.5]), np.array([1.5, 0.5, 1.2])
    np.testing.assert_allclose(continued(table, *at), 3 * at[0] - at[1] + 2, atol=1e-3)
    np.testing.assert_allclose(left_out_nearby(table, *X[:5].T), table.error.residuals[:5])


def test_inputs_of_a_simulator_are_those_of_the_table(runs: prb.Runs) -> None:
    def model(*names: str | float, observed: Any = (0.5, 0.8)) -> None:
        with pm.Model():
            mu = pm.Normal("mu", 0.5, 0.1)
            values = {"y": pm.Normal("y", 1.5, 0.1), "x": pm.Normal("x", 0.5, 0.1)}
            values["dist"] = pm.Normal.dist(mu, 0.1)
            inputs = [values[name] if isinstance(name, str) else name for name in names]
            prb.Simulator("s", runs, *inputs, metric=prb.AreaMetric(), observed=observed,
                          propagation=prb.Resimulated(64))  # fmt: skip

    model("dist", "y")
    with pytest.raises(TypeError, match=r"got y as input 1, expected x, in the order .*: x, y"):
        model("y", "dist")
    with pytest.raises(TypeError, match=r"inputs of \[1\] numbers for a table of runs of x, y"):
        model("dist")
    with pytest.raises(ValueError, match=r"y: got the constant 3\.0, expected 1\.0\d* to 1\.9\d*"):
        model("dist", 3.0)


def test_a_surrogate_of_runs_takes_a_surface_of_ones_own() -> None:
    surface = prb.surrogate.Polynomial(2)
    fitted = prb.Surrogate.from_runs(TABLE, X[:, 0] * X[:, 1], model=surface)
    assert fitted.model == surface
    np.testing.assert_allclose(fitted(0.5, 1.5), 0.75, atol=1e-12)
    assert fitted.n_runs == 0
    with pytest.raises(TypeError, match=r"expected prb\.surrogate"):
        prb.Surrogate.from_runs(TABLE, X[:, 0], model=3)


@pytest.mark.parametrize("make", [prb.Runs, prb.Surrogate.from_runs])
@pytest.mark.parametrize("kind", ["codes", "multiples"])
def test_inputs_that_determine_no_surface_are_named(make: Any, kind: str) -> None:
    a = np.arange(40.0)
    c, n = (np.repeat([0.0, 1.0], 20), 2) if kind == "codes" else (3 * a, 40)
    message = (
        rf"runs that determine no surface, with .* \{{'a': 40, 'c': {n}\}}, expected at least 3"
    )
    with pytest.raises(ValueError, match=message):
        make({"a": a, "c": c}, a)


@pytest.mark.parametrize("output", [0, 1])
def test_the_run_that_causes_the_error_is_named(output: int) -> None:
    x = np.random.default_rng(0).uniform(-1, 2, (60, 2))
    y = np.stack([x[:, 0] + 0.2 * x[:, 1] ** 2, 100 * np.exp(x[:, 1])], axis=1)
    inputs = {"a": x[:, 0], "b": x[:, 1]}
    assert outlier_advice(prb.Runs(inputs, y)) == ""
    y[17, output] += 0.05 * y[:, output].std()
    advice = outlier_advice(prb.Runs(inputs, y))
    assert advice.startswith(
        f"correct or leave out row 17 of the table (counted from 0; a = {x[17, 0]:.4g}"
    )


def test_errors_of_many_runs_are_those_of_no_single_run() -> None:
    rng = np.random.default_rng(1)
    x = np.linspace(-3, 5, 40)
    for y in (np.abs(x - 1.07), x + rng.normal(0, 0.1, 40), 1 / (x - 1.07), np.sin(9 * x)):
        assert outlier_advice(prb.Runs({"x": x}, y)) == ""
