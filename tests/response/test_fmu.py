"""A Functional Mock-up Unit as a response: what it is told, what is read, what is refused."""

from __future__ import annotations

import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm
import pytest
import units

import prbayes as prb
from prbayes.model.random_variable import nodes
from prbayes.response import fmi


@pytest.fixture(scope="module")
def unit(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return units.built(tmp_path_factory.mktemp("unit"))


def spring(unit: Path, **keywords: Any) -> prb.scalar:
    settings = {"inputs": ["stiffness", "force"], "outputs": ["position", "work"]} | keywords
    return prb.fmu(unit, **settings)


K, F = np.array([[2.0, 4.0, 0.1], [1 / 3, 8.0, 5.0]]), np.array([1.0, 3.0, -7.0])
# From time 1 to 3, by steps of .5.
POSITION, WORK = F / K * 3.0, np.broadcast_to(2.0 * F**2, K.shape)


def joined(found: Any) -> Any:
    """Return outputs by name side by side in the last axis, those of one specimen in a row."""
    arrays = list(found.values())
    return np.hstack(arrays) if arrays[0].ndim < 2 else np.stack(arrays, axis=-1)


def test_each_specimen_is_simulated_anew_with_inputs_and_outputs_in_their_order(unit: Path) -> None:
    expected = np.stack([POSITION, WORK], axis=-1)
    for _ in range(2):
        np.testing.assert_array_equal(joined(spring(unit)(K, F)), expected)
    swapped = spring(unit, inputs=["force", "stiffness"], outputs=["work", "position"])
    np.testing.assert_array_equal(joined(swapped(F, K)), expected[..., ::-1])
    one = spring(unit, outputs=["position"])(K, F)
    np.testing.assert_array_equal(one, POSITION)


def test_parameters_are_the_same_for_all_whatever_their_type(unit: Path) -> None:
    for parameters, factor in (
        ({"gain": 0.5, "turns": 3}, 1.5),
        ({"doubled": True}, 2.0),
        ({"doubled": np.bool_(False), "turns": np.int64(2)}, 2.0),
        ({"material": "gold", "gain": 3}, 6.0),
    ):
        found = spring(unit, outputs=["position"], parameters=parameters)(K, F)
        np.testing.assert_array_equal(found, factor * F / K * 3.0)
    turned = spring(unit, inputs=["turns", "force"], outputs=["position"])
    assert turned(4.0, 1.0) == 6.0
    with pytest.raises(ValueError, match=r"Oscillator: got 2.5 for turns, expected a whole number"):
        turned(2.5, 1.0)


def test_curves_are_read_at_the_times_that_were_asked_for(unit: Path) -> None:
    times = [1.1, 2.0, 3.5]
    curve = spring(unit, outputs=["position"], times=times)
    np.testing.assert_allclose(curve(2.0, 3.0), 1.5 * np.array(times), rtol=1e-14)
    both = spring(unit, times=times, outputs={"x": "position", "w": "work"})
    found = both.function(2.0, 3.0)
    assert list(found) == ["x", "w"]
    np.testing.assert_allclose(found["w"], 9.0 * (np.array(times) - 1.0), rtol=1e-14)
    np.testing.assert_array_equal(joined(both(2.0, 3.0)), [*found["x"], *found["w"]])


def test_steps_are_as_long_as_was_asked_for_at_most(unit: Path, tmp_path: Path) -> None:
    def steps(path: Path = unit, **keywords: Any) -> Any:
        return spring(path, outputs=["steps"], **keywords)(1.0, 1.0).tolist()

    assert steps() == 4  # as the unit states
    assert steps(step=0.3) == 7
    assert steps(step=100) == 1
    assert steps(step=0.1, stop_time=2) == 10
    assert steps(times=[1.2, 2.0, 2.1]) == [1, 3, 4]
    assert steps(start_time=0) == 6
    silent = units.changed(unit, tmp_path / "silent.fmu", (' stepSize="0.5"', ""))
    assert steps(silent) == 500


def test_units_with_steps_of_one_size_are_refused_other_times(unit: Path, tmp_path: Path) -> None:
    variable = 'canHandleVariableCommunicationStepSize="{}"'
    swap = variable.format("true"), variable.format("false")
    even = units.changed(unit, tmp_path / "even.fmu", swap)
    found = joined(spring(even, times=[1.5, 3.0])(2.0, 3.0))
    np.testing.assert_array_equal(found, [2.25, 4.5, 4.5, 18.0])
    with pytest.raises(
        ValueError, match=r"got the time 1.7, which steps of 0.5 from 1 do not reac"
    ):
        spring(even, times=[1.5, 1.7])
    with pytest.raises(ValueError, match=r"got the time 3, which steps of 0.3 from 1 do not reach"):
        spring(even, step=0.3)
    unknown = units.changed(unit, tmp_path / "unknown.fmu", swap, (' stepSize="0.5"', ""))
    with pytest.raises(ValueError, match=r"fmu: step: got none, and Oscillator takes steps of one"):
        spring(unknown)
    assert spring(unknown, step=0.25)(2.0, 3.0)["position"] == 4.5


def test_failures_say_what_the_unit_logged_and_the_next_specimen_is_sound(unit: Path) -> None:
    response = spring(unit)
    with pytest.raises(RuntimeError, match=r"Oscillator: .*fatal.*logged: .*'no equilibrium'"):
        response(-1.0, 1.0)
    with pytest.raises(RuntimeError, match=r"status 2 \(discard\); it logged nothing"):
        response(0.0, 1.0)
    np.testing.assert_array_equal(joined(response(K, F)), np.stack([POSITION, WORK], axis=-1))


def test_what_takes_too_long_is_ended_between_steps(unit: Path) -> None:
    response = spring(unit, timeout=0.25)
    clock = time.monotonic()
    with pytest.raises(
        TimeoutError, match=r"Oscillator: no result within timeout = 0.25 s, at tim"
    ):
        response(1.0, 200.0)
    assert time.monotonic() - clock < 0.75
    np.testing.assert_array_equal(joined(response(2.0, 3.0)), [4.5, 18.0])


def model_of(response: Any, executor: Any = None, **settings: Any) -> Any:
    """Return the node of a simulator of which everything is computed."""
    force = np.random.default_rng(1).normal(3.0, 0.5, 12)
    with pm.Model() as model:
        prb.Simulator(
            "y",
            response,
            2.0,
            pm.Normal.dist(pm.Normal("mu", 3.0, 0.3), 0.5),
            metric=prb.Joint(prb.AreaMetric()),
            observed={"work": 2 * force**2, "position": 1.5 * force},
            propagation=prb.Reweighted(16, max_points=16, executor=executor, **settings),
        )
    (node,) = nodes(model).values()
    return node


@pytest.mark.exact
def test_a_study_takes_outputs_by_name_and_finds_them_in_its_store(
    unit: Path, tmp_path: Path
) -> None:
    with ThreadPoolExecutor(2) as pool:
        node = model_of(spring(unit), pool, store=tmp_path, version="1")
    force = node.reweighted.design.runs.points[0]
    # In the order of what was observed.
    expected = np.stack([2 * force**2, force / 2 * 3.0], axis=1)
    np.testing.assert_allclose(node.bound.design.sample.values, expected, rtol=1e-14)
    again = model_of(spring(unit), store=tmp_path, version="1")
    np.testing.assert_array_equal(again.bound.design.sample.values, node.bound.design.sample.values)
    assert (node.bound.responses.computed, again.bound.responses.computed) == (16, 0)


def test_a_simulator_that_does_not_fit_is_refused_before_anything_is_simulated(
    unit: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, 9))
    both, curve = spring(unit), spring(unit, outputs=["work"], times=[2.0, 3.0])
    curves = spring(unit, times=[2.0, 3.0])
    joint, area = prb.Joint(prb.AreaMetric()), prb.AreaMetric()
    pairs = rng.normal(size=(9, 2))
    monkeypatch.setattr(fmi._Opened, "instance", None)
    with pm.Model():
        x = pm.Normal.dist(pm.Normal("mu", 0, 1), 1)
        pair = pm.MvNormal.dist(np.zeros(2), np.eye(2))
        for response, inputs, metric, observed, said in (
            (
                both,
                (x,),
                joint,
                {"position": a, "work": b},
                r"inputs of 1 numbers, expected 2 of one",
            ),
            (both, (pair, x), joint, {"position": a, "work": b}, r"got inputs of 2, 1 numbers"),
            (
                both,
                (x, 1.0),
                joint,
                pairs,
                r"outputs without names, expected a mapping .* DataFrame",
            ),
            (
                both,
                (x, 1.0),
                joint,
                {"work": a, "w": b},
                r"got work, w, .*'position', 'work': the ou",
            ),
            (both, (x, 1.0), area, a, r"observed: got outputs without names"),
            (
                curve,
                (x, 1.0),
                area,
                a,
                r"got shape \(N\), expected \(N, 2\), a column for each time",
            ),
            (
                curves,
                (x, 1.0),
                joint,
                {"position": a, "work": b},
                r"arrays \(N, 2\), with 'positio",
            ),
        ):
            with pytest.raises(ValueError, match=rf"y: .*{said}"):
                prb.Simulator(
                    "y",
                    response,
                    *inputs,
                    metric=metric,
                    observed=observed,
                    propagation=prb.Reweighted(16, on_failure=prb.response.Replace()),
                )
    with pytest.raises(ValueError, match=r"Oscillator: got inputs of 1, 1, 1 numbers, expected 2"):
        both(1.0, 2.0, 3.0)


@pytest.mark.parametrize(
    ("keywords", "said"),
    [
        (
            {"inputs": ["stifness"]},
            r"inputs: got 'stifness', .*; did you mean 'stiffness' or 'steps'\?$",
        ),
        ({"inputs": ["zzz"]}, r"a variable of Oscillator; it has 'stiffness', 'gain', 'turns', "),
        ({"inputs": ["work"]}, r"'work', which Oscillator computes itself \(output, calculated\)"),
        ({"inputs": ["material"]}, r"'material', which is of type String in Oscillator, .* number"),
        ({"outputs": ["material"]}, r"outputs: got 'material', which is of type String"),
        ({"outputs": {"x": "positon"}}, r"outputs: got 'positon', .* did you mean 'position'\?"),
        ({"parameters": {"mass": 1.0}}, r"parameters: got 'mass', expected a variable of"),
        ({"parameters": {"force": 1.0}}, r"parameters: got 'force', which is among the inputs too"),
        ({"parameters": {"turns": 1.5}}, r"parameters: got 1.5 for turns, expected a whole number"),
        ({"parameters": {"doubled": 2}}, r"parameters: got 2 for doubled, expected 0 or 1"),
        ({"parameters": {"material": 1}}, r"parameters: got 1 for material, expected a text"),
        ({"parameters": {"gain": "1"}}, r"parameters: got '1' for gain, expected a number"),
        ({"stop_time": 1.0}, r"stop_time: got 1, expected a time after start_time = 1"),
        ({"stop_time": np.inf}, r"stop_time: got inf, expected a finite number"),
        ({"times": [1.0, 2.0]}, r"times: got \[1.0, 2.0\], expected increasing times after start"),
        ({"times": [3.0, 2.0]}, r"times: got .*, expected increasing times"),
        (
            {"times": [2.0, 4.0], "stop_time": 3.0},
            r"got 4 as the last, expected none after stop_ti",
        ),
        ({"step": 0}, r"fmu: step: got 0, expected a positive"),
        ({"timeout": -1}, r"fmu: timeout: got -1"),
    ],
)
def test_what_the_unit_does_not_have_is_refused(
    unit: Path, keywords: dict[str, Any], said: str
) -> None:
    with pytest.raises(ValueError, match=said):
        spring(unit, **keywords)


@pytest.mark.parametrize(
    "keywords",
    [
        {"inputs": "stiffness"},
        {"inputs": []},
        {"inputs": ["force", "force"]},
        {"outputs": "work"},
        {"outputs": []},
        {"outputs": {"work": 1}},
        {"outputs": ["work", "work"]},
        {"parameters": ["gain"]},
        {"parameters": {"gain": [1.0]}},
        {"stop_time": "3"},
        {"times": "3"},
        {"reset": "no"},
    ],
)
def test_arguments_of_another_kind_are_refused(unit: Path, keywords: dict[str, Any]) -> None:
    with pytest.raises(TypeError, match=rf"fmu: {next(iter(keywords))}: got .*, expected"):
        spring(unit, **keywords)


def test_units_of_fmi_3(tmp_path: Path) -> None:
    unit = units.built(tmp_path, 3)
    response = spring(unit, parameters={"turns": 2}, times=[1.0, 2.0])
    for k, f in ((2.0, 3.0), (4.0, 5.0)):
        expected = [2 * f / k, 4 * f / k, f**2, 2 * f**2]
        np.testing.assert_allclose(joined(response(k, f)), expected, rtol=1e-12)
    with pytest.raises(RuntimeError, match=r"Oscillator3: fmi3DoStep .*logged: .*'no equilibrium'"):
        response(-2.0, 3.0)
    np.testing.assert_allclose(joined(response(2.0, 3.0)), [3.0, 6.0, 9.0, 18.0], rtol=1e-12)
    with pytest.raises(
        ValueError, match=r"stop_time: got none, and the unit states none, expected"
    ):
        spring(unit)


def test_without_fmpy_it_is_said_what_to_install(
    unit: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "fmpy", None)
    with pytest.raises(ImportError, match=r"run pip install prbayes\[codes\]"):
        spring(unit)
