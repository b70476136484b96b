"""Batched compilation: one invalid row leaves the others alone."""

from __future__ import annotations

import numpy as np
import pymc as pm
import pytensor.tensor as pt

from prbayes.response.compilation import compile_batched, ninf_for_invalid, with_leading_axis


def test_a_batch_gives_what_single_calls_do() -> None:
    x, v = pt.dscalar("x"), pt.dvector("v")
    extra = pt.dscalar("extra")
    function = compile_batched([x, v], [x * v, v.sum() + x], [extra])
    xs, vs = np.array([1.0, -2.0, 0.5]), np.arange(6.0).reshape(3, 2)
    products, sums = function(xs, vs, 3.0)
    np.testing.assert_array_equal(products, xs[:, None] * vs)
    np.testing.assert_array_equal(sums, vs.sum(axis=1) + xs)


def test_an_invalid_row_is_minus_infinity_and_leaves_the_others_alone() -> None:
    mu, sigma = pt.dscalar("mu"), pt.dscalar("sigma")
    logp = pm.logp(pm.Normal.dist(mu, sigma), 0.5)
    function = compile_batched([mu, sigma], [logp])
    (found,) = function(np.zeros(4), np.array([1.0, -1.0, np.nan, 2.0]))
    assert list(np.isneginf(found)) == [False, True, True, False]
    expected = -0.5 * np.log(2 * np.pi) - np.log([1.0, 2.0]) - 0.5 * (0.5 / np.array([1, 2])) ** 2
    np.testing.assert_allclose(found[[0, 3]], expected, rtol=1e-12)


def test_a_graph_without_checks_stays_as_it_is() -> None:
    x = pt.dscalar("x")
    graph = 2 * x
    assert ninf_for_invalid([graph]) == [graph]


def test_a_leading_axis_keeps_name_type_and_shape() -> None:
    symbols = [pt.dscalar("a"), pt.tensor("b", dtype="int64", shape=(3,))]
    batched = with_leading_axis(symbols)
    assert [b.name for b in batched] == ["a", "b"]
    assert [b.dtype for b in batched] == ["float64", "int64"]
    assert [b.type.shape for b in batched] == [(None,), (None, 3)]
