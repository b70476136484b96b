"""Inputs: aleatory, epistemic, constant or the group of a specimen; others are refused."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd
import pymc as pm
import pytensor.tensor as pt
import pytest
import xarray as xr
from pytensor.scalar import float64
from pytensor.tensor.type_other import NoneConst
from suppliers import labelled

import prbayes as prb
from prbayes.response.compile import PLAIN
from prbayes.response.inputs import (
    Groups,
    Inputs,
    broadcast_batch,
    event_shape,
    group_indices,
    groups_of,
    is_group,
    is_random,
    read_inputs,
)

with pm.Model():
    STRANGER = pm.Normal("stranger")


def read(make: Callable[[Any, Any], list[Any]]) -> tuple[Inputs, list[Any], list[Any]]:
    """Read the inputs that are made of mu and sigma; return them, what was given, and the two."""
    with pm.Model() as model:
        mu, sigma = pm.Normal("mu", 2, 1), pm.HalfNormal("sigma", 1)
        given = make(mu, sigma)
        return read_inputs("y", given, model), given, [mu, sigma]


def test_inputs_are_sorted_in_the_order_of_the_arguments() -> None:
    def make(mu: Any, sigma: Any) -> list[Any]:
        x, z = pm.Normal.dist(mu, 1.0), pm.MvNormal.dist(pt.stack([mu, mu]), np.eye(2))
        return [3, z, x, 2 * sigma, np.array([4, 5]), z]

    inputs, (_, z, x, doubled, _, _), roots = read(make)
    assert inputs.aleatory == (z, x)
    assert inputs.epistemic == (doubled,)
    assert set(inputs.parents) == set(roots)
    assert not inputs.nested
    assert inputs.event_shapes == ((2,), ())
    assert inputs.event_ndims == [1, 0, 0]
    # Constants are floats, positions of aleatory inputs are integers.
    constant, *positions, vector, again = inputs.arguments
    assert (constant, type(constant)) == (3.0, float)
    assert positions == [0, 1, doubled]
    np.testing.assert_array_equal(vector, [4.0, 5.0])
    assert again == 0
    filled = inputs.fill(["z", "x"], ["doubled"])
    assert filled[:4] == [3.0, "z", "x", "doubled"]
    assert filled[5] == "z"


def test_roots_are_the_model_variables_above_the_inputs_only() -> None:
    inputs, _, (mu, _) = read(
        lambda mu, sigma: [pm.Normal.dist(pt.exp(mu), 1.0), pm.Data("d", 1.0)]
    )
    assert inputs.parents == (mu,)


def test_a_dist_below_another_is_nested() -> None:
    inputs, _, _ = read(lambda mu, sigma: [pm.Normal.dist(pm.Normal.dist(mu, 1.0), sigma)])
    assert inputs.nested


def test_inputs_are_rebuilt_from_other_roots() -> None:
    inputs, _, _ = read(lambda mu, sigma: [pm.Normal.dist(mu, sigma), mu - sigma])
    (mu, sigma) = inputs.placeholders()
    assert (mu.name, sigma.name) == ("mu", "sigma")
    (x,), (difference,) = inputs.rebuilt([np.float64(7.0), np.float64(1e-9)])
    assert difference.eval(mode=PLAIN) == pytest.approx(7.0)
    assert pm.draw(x, random_seed=1, mode=PLAIN) == pytest.approx(7.0, abs=1e-6)


def test_leading_axes_of_length_one_are_dropped() -> None:
    inputs, _, _ = read(lambda mu, sigma: [pm.Normal.dist(mu, sigma)])
    assert [p.shape for p in inputs.core([np.ones((1, 1)), np.ones(1)])] == [(), ()]


def test_shapes_and_randomness() -> None:
    n = pt.constant(3)
    unknown = pm.MvNormal.dist(pt.zeros(n), pt.eye(n))
    assert event_shape(unknown) == (3,)
    assert event_shape(pm.Normal.dist(0, 1)) == ()
    assert is_random(pm.Normal.dist(0, 1))
    assert is_random(pm.Censored.dist(pm.Normal.dist(0, 1), lower=0, upper=1))
    assert not is_random(2 * pm.Normal.dist(0, 1))
    assert not is_random(pt.dscalar())


SENTENCE = r".*write the expression inside the response"
BAD: dict[str, tuple[Callable[[Any, Any], list[Any]], type[Exception], str]] = {
    "none": (lambda m, s: [], ValueError, r"got 0 inputs, none of them aleatory.*dist\(\)"),
    "nothing aleatory": (lambda m, s: [m, 2.0], ValueError, r"got 2 inputs, none of them aleatory"),
    "no hyperparameter": (
        lambda m, s: [pm.Normal.dist(0, 1)],
        ValueError,
        r"got inputs that depend on no variable of the model.*such as mu = pm.Normal\('mu'",
    ),
    "string": (
        lambda m, s: [pm.Normal.dist(m, s), "C"],
        TypeError,
        r"input 2: got str 'C', .*a `.dist",
    ),
    "NaN": (lambda m, s: [np.nan], ValueError, r"input 1: .*not finite \(nan\), expected a number"),
    "multiple": (lambda m, s: [2 * pm.Normal.dist(m, s)], TypeError, SENTENCE),
    "part": (
        lambda m, s: [pm.MvNormal.dist(pt.stack([m, m]), np.eye(2))[0]],
        TypeError,
        SENTENCE,
    ),
    "loose symbol": (
        lambda m, s: [pm.Normal.dist(m, pt.dscalar("loose"))],
        TypeError,
        r"input 1: .*depends on loose.*inside the same `with pm.Model\(\)`",
    ),
    "symbol of a scalar": (
        lambda m, s: [pm.Normal.dist(m, s), float64("loose")],
        TypeError,
        r"input 2: .*depends on loose",
    ),
    "list of variables": (
        lambda m, s: [pm.Normal.dist(m, s), [m, 1.0]],
        TypeError,
        r"input 2: got an array of dtype object.*pass several as several inputs",
    ),
    "constant of another kind": (
        lambda m, s: [pm.Normal.dist(m, s), NoneConst],
        TypeError,
        r"input 2: got .*None.*expected real numbers",
    ),
    "another model, above": (
        lambda m, s: [pm.Normal.dist(STRANGER, s)],
        TypeError,
        r"input 1: .*depends on stranger.*inside the same `with pm.Model\(\)`",
    ),
    "another model": (
        lambda m, s: [pm.Normal.dist(m, s), STRANGER],
        TypeError,
        r"input 2: .*stranger.*inside the same `with pm.Model\(\)`",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_inputs_are_refused(case: str) -> None:
    make, error, message = BAD[case]
    with pytest.raises(error, match=f"^y: {message}"):
        read(make)


def test_a_mixture_is_one_input() -> None:
    with pm.Model() as model:
        mu = pm.Normal("mu")
        part, other = pm.Normal.dist(mu, 1.0), pm.Normal.dist(3.0, 1.0)
        mixture = pm.Mixture.dist(np.array([0.3, 0.7]), [part, other])
        censored = pm.Censored.dist(pm.Normal.dist(mu, 1.0), lower=0.0, upper=None)
        assert not read_inputs("y", [mixture, censored], model).nested
        assert read_inputs("y", [mixture, pm.Normal.dist(part, 1.0)], model).nested


def test_constants_are_changed_by_nobody() -> None:
    given = np.array([1.0, 2.0])
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu"), 1.0)
        kept = read_inputs("y", [x, given], model).arguments[1]
    given[0] = 7.0
    np.testing.assert_array_equal(kept, [1.0, 2.0])
    with pytest.raises(ValueError, match="read-only"):
        kept *= 2


@pytest.mark.parametrize(
    ("graph", "value"),
    [
        (pt.constant(3), 3.0),
        (pt.exp(pt.constant(1.0)), np.e),
        (pt.as_tensor([1.0, 2.0]), [1.0, 2.0]),
        (pt.stack([pt.constant(1.0), 2.0]) * 2, [2.0, 4.0]),
    ],
    ids=["number", "expression", "vector", "stack"],
)
def test_a_graph_of_constants_is_a_constant(graph: Any, value: Any) -> None:
    inputs, _, _ = read(lambda mu, sigma: [pm.Normal.dist(mu, sigma), graph])
    assert inputs.epistemic == ()
    np.testing.assert_allclose(inputs.arguments[1], value)


# -- batches ----------------------------------------------------------------------------------

X, PAIRS = np.arange(3.0), np.arange(8.0).reshape(4, 1, 2)


def test_leading_axes_broadcast_and_events_do_not() -> None:
    assert broadcast_batch([X, PAIRS], [1, 2])[0] == (4,)
    assert broadcast_batch([np.float64(1.0)], [0])[0] == ()
    batch, (x, pairs) = broadcast_batch([X, PAIRS], [0, 1])
    assert (batch, x.shape, pairs.shape) == ((4, 3), (4, 3), (4, 3, 2))
    np.testing.assert_array_equal(x[2], X)
    np.testing.assert_array_equal(pairs[2, 1], PAIRS[2, 0])
    with pytest.raises(ValueError, match="shape mismatch"):
        broadcast_batch([X, np.zeros(2)], [0, 0])


GROUPS = Groups("supplier", ("Adler", "Busch"))
VALUES = [1.0, 2.0, 3.0]
WHO = ["Busch", "Adler", "Busch"]


def observed() -> list[Any]:
    """Return the same measurements in each form that tells their groups."""
    index = pd.MultiIndex.from_arrays([range(3), WHO], names=["specimen", "supplier"])
    return [
        labelled(VALUES, WHO),
        xr.DataArray(VALUES, {"supplier": WHO}, "supplier"),
        pd.DataFrame({"y": VALUES, "supplier": WHO}),
        pd.Series(VALUES, pd.Index(WHO, name="supplier")),
        pd.Series(VALUES, index),
        pd.DataFrame({"y": VALUES}, index),
    ]


@pytest.mark.parametrize("given", observed(), ids=lambda given: type(given).__name__)
def test_groups_are_read_from_coordinate_column_or_index(given: Any) -> None:
    places, values = group_indices("y", given, GROUPS)
    np.testing.assert_array_equal(places, [1, 0, 1])
    np.testing.assert_array_equal(np.asarray(values), VALUES)
    frame = pd.DataFrame({"a": VALUES, "supplier": WHO, "b": VALUES})
    places, rest = group_indices("y", frame, GROUPS)
    np.testing.assert_array_equal(places, [1, 0, 1])
    assert list(rest.columns) == ["a", "b"]
    places, rest = group_indices("y", frame.set_index("supplier"), GROUPS)
    np.testing.assert_array_equal(places, [1, 0, 1])
    assert list(rest.columns) == ["a", "b"]


@pytest.mark.parametrize(
    ("given", "error", "message"),
    [
        (VALUES, TypeError, "got list without the group of each specimen, expected a DataArray"),
        (pd.Series(VALUES), TypeError, "got .* without the group of each specimen"),
        (pd.DataFrame({"y": VALUES}), TypeError, "got .* without the group of each specimen"),
        (
            xr.DataArray(np.ones((3, 2)), {"supplier": ("o", ["a", "b"])}, ["i", "o"]),
            TypeError,
            "got .* a coordinate 'supplier' along the specimens",
        ),
        (
            labelled(VALUES, ["Adler", "Busch", "Celik"]),
            ValueError,
            r"got specimens of \['Celik'\]",
        ),
        (labelled(VALUES, ["Adler"] * 3), ValueError, r"got no specimen of \['Busch'\]"),
    ],
)
def test_what_tells_no_groups_is_refused(given: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=f"(?s)y: observed: {message}"):
        group_indices("y", given, GROUPS)


def test_a_group_is_an_index_that_is_drawn_evenly() -> None:
    with pm.Model(coords={"supplier": ["Adler", "Busch"]}):
        mu = pm.Normal("mu", [0.0, 1.0], dims="supplier")
        supplier = prb.response.group("supplier")
        assert mu[supplier].ndim == 0
    assert is_group(supplier)
    assert not is_group(mu)
    assert groups_of("y", [mu, supplier]) == GROUPS
    assert groups_of("y", [mu]) is None
    share = pm.draw(supplier, 4000, random_seed=1, mode=PLAIN).mean()
    # Five standard errors of a share of a half.
    assert abs(share - 0.5) < 5 * 0.5 / np.sqrt(4000)


def test_groups_in_the_wrong_place_are_refused() -> None:
    with pm.Model(coords={"supplier": ["a", "b"], "batch": [1, 2]}):
        both = [prb.response.group(dim) for dim in ("supplier", "batch")]
    with pytest.raises(ValueError, match=r"2 calls of .* \['supplier', 'batch'\], expected one"):
        groups_of("y", both)
