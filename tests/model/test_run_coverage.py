"""Tables and surrogates whose runs are not where the specimens are."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pymc as pm
import pytest
from one_input import one_input

import prbayes as prb
from prbayes._validate import Floats
from prbayes.model.specimen_likelihood import specimen_likelihoods
from prbayes.model.specimen_preparation import prepared

X = np.random.default_rng(90).normal(1, 0.5, 20)
B = np.random.default_rng(91).normal(0, 0.3, 20)
GAP = np.r_[np.linspace(-2, 0.2, 40), np.linspace(1.8, 4, 40)]
EVEN = np.linspace(-2, 4, 25)
RANDOM = np.random.default_rng(1).random((1200, 2)) * [6, 4] - [2, 2]
HOLE = RANDOM[(np.abs(RANDOM - [1, 0]) > 0.9).any(axis=1)][:300]
ROOT = np.linalg.cholesky([[1, 0.999], [0.999, 1]]) * [[1.5], [1.0]]
CORRELATED = np.random.default_rng(2).normal(size=(120, 2)) @ ROOT.T + [1, 0]


def bump(x: Any) -> Any:
    return x + 2 * np.exp(-(((x - 1) / 0.3) ** 2))


def curved(x: Any, b: Any = 0.0) -> Any:
    return x + 0.1 * x**2 + b


def codes(points: Floats, f: Callable[..., Any], kind: Any = prb.Runs) -> list[str]:
    """Return the codes about the places of the runs of a table."""
    columns = dict(zip("xb", points.reshape(len(points), -1).T, strict=False))
    with pm.Model() as model:
        inputs = [pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1))]
        inputs += [pm.Normal.dist(0, 0.3)] if "b" in columns else []
        prb.Simulator(
            "y",
            kind(columns, f(*columns.values())),
            *inputs,
            observed=f(X, B) if "b" in columns else f(X),
            progressbar=False,
        )
    (likelihood,) = specimen_likelihoods(model).values()
    found = prepared(likelihood).findings
    return [x.code for x in found if x.code in ("sparse-runs", "beyond-runs")]


@pytest.mark.parametrize(
    ("points", "f", "expected"),
    [
        (GAP, bump, ["sparse-runs"]),
        (GAP, lambda x: np.where(x < 1, x, 3 * x - 2), ["sparse-runs"]),
        (np.r_[np.linspace(-2, -0.2, 30), np.linspace(2.2, 4, 30)], curved, ["sparse-runs"]),
        pytest.param(HOLE, curved, ["sparse-runs"], marks=pytest.mark.long),
        pytest.param(CORRELATED, curved, ["sparse-runs"], marks=pytest.mark.long),
        (np.linspace(0, 4, 60), np.square, ["beyond-runs"]),
        (EVEN, curved, []),
        (np.unique(np.r_[np.linspace(-2, -1.9, 30), EVEN]), curved, []),
        pytest.param(RANDOM[:120], curved, [], marks=pytest.mark.long),
    ],
    ids=[
        *("bump", "knee", "clusters", "hole", "correlated", "end"),
        *("even", "cluster elsewhere", "random"),
    ],
)
def test_runs_that_are_not_where_the_specimens_are_are_reported(
    points: Floats, f: Callable[..., Any], expected: list[str]
) -> None:
    assert codes(points, f) == expected


@pytest.mark.parametrize(("points", "expected"), [(GAP, ["sparse-runs"]), (EVEN, [])])
def test_the_runs_of_a_surrogate_are_compared_with_the_specimens_as_well(
    points: Floats, expected: list[str]
) -> None:
    assert codes(points, curved, prb.Surrogate.from_runs) == expected


def test_a_function_has_no_such_findings() -> None:
    model = one_input(curved(X), response=curved, progressbar=False)
    (likelihood,) = specimen_likelihoods(model).values()
    assert not {f.code for f in prepared(likelihood).findings} & {"sparse-runs", "beyond-runs"}
