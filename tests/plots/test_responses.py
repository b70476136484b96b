"""Responses before and after a calibration are the closed forms, and cost what is said."""

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pymc as pm
import pytest
import xarray as xr
from first_use import first_use
from scipy import stats

import prbayes as prb


def test_responses_are_the_closed_forms(
    optimum: prb.Optimum, posterior: xr.DataTree, known: SimpleNamespace, read: SimpleNamespace
) -> None:
    pc = prb.plot_responses(posterior, model=optimum.model, n_draws=300)
    x, y = read.xy(pc, "after", "y")
    h = 0.9 * 0.5 * 700**-0.2  # about Silverman's for the weights' effective number
    each = stats.norm.pdf(x, known.mu.reshape(-1, 1), np.hypot(known.sigma.reshape(-1, 1), h))
    np.testing.assert_allclose(y, each.mean(axis=0), atol=0.025)
    some = x[20:-20:10]
    low, high = read.sides(pc, "band", "y", some)
    expected = np.quantile(each, [0.055, 0.945], axis=0)[:, 20:-20:10]
    np.testing.assert_allclose([low, high], expected, atol=0.04)
    assert (high - low).max() > 0.15
    truth = stats.norm.pdf(some, 1, 0.5)
    assert ((low - 0.02 <= truth) & (truth <= high + 0.02)).all()
    narrow = prb.plot_responses(posterior, model=optimum.model, n_draws=300, prob=0.5)
    inner = read.sides(narrow, "band", "y", some)
    assert np.ptp(inner, axis=0).max() < 0.6 * (high - low).max()
    x, y = read.xy(pc, "before", "y")
    at_start = np.exp(optimum.evaluator.hyperparameters.initial[1])
    np.testing.assert_allclose(y, stats.norm.pdf(x, 0, at_start), atol=0.02)
    np.testing.assert_allclose(read.xy(pc, "rug", "y"), [known.observed, np.zeros(30)])
    np.testing.assert_allclose(np.trapezoid(*read.xy(pc, "measured", "y")[::-1]), 1)


def test_the_legend_says_what_is_before_and_after(
    posterior: xr.DataTree,
    read: SimpleNamespace,
    pictures: dict[str, Callable[..., Any]],
    drawn: Callable[..., Any],
) -> None:
    assert read.texts(drawn("responses")) == [
        "measured",
        "before: prior's initial point",
        "89% band of the posterior",
        "calibrated: posterior predictive",
    ]
    pc = pictures["ecdf"](prob=0.5)
    assert read.texts(pc)[2:] == ["50% band of the standard error", "calibrated: optimum"]
    before, after = (read.artist(pc, name, "y") for name in ("before", "after"))
    assert before.get_linestyle() != after.get_linestyle()
    axis = pc.viz["plot"]["y"].item()
    assert (axis.get_xlabel(), axis.get_ylabel(), axis.get_title()) == (
        "y",
        "share of specimens",
        "30 measured values",
    )


def test_distribution_functions_of_an_optimum(
    optimum: prb.Optimum, read: SimpleNamespace, pictures: dict[str, Callable[..., Any]]
) -> None:
    pc = pictures["ecdf"](before={"mu": 3.0, "sigma": 1.0})
    mu, sigma = optimum.point["mu"], optimum.point["sigma"]
    for name, mean, sd in (("after", mu, sigma), ("before", 3.0, 1.0)):
        x, y = read.xy(pc, name, "y")
        np.testing.assert_allclose(y, stats.norm.cdf(x, mean, sd), atol=0.01)
    assert "before: as given" in read.texts(pc)
    x, y = read.xy(pc, "measured", "y")
    np.testing.assert_allclose(np.interp([0.99, 1.01], x, y), [0.5, 0.5], atol=0.04)
    at = read.xy(pc, "after", "y")[0][60:200:20]
    low, high = read.sides(pc, "band", "y", at)
    error = (
        1.5982
        * np.hypot(0.5 / np.sqrt(30), (at - 1) * 0.5 / np.sqrt(60) / 0.5)
        * stats.norm.pdf(at, 1, 0.5)
    )
    np.testing.assert_allclose((high - low) / 2, error, atol=0.03)


def test_without_a_sampling_distribution_there_is_no_band_and_before_can_be_left_out(
    optimum: prb.Optimum,
) -> None:
    alone = replace(optimum, covariance=np.full((2, 2), np.nan))
    pc = prb.plot_responses(alone, before=False)
    assert not {"band", "before"} & set(pc.viz.children)
    assert "band" not in prb.plot_population(alone).viz


def test_stored_responses_cost_nothing_and_others_as_little_as_said(
    optimum: prb.Optimum,
    posterior: xr.DataTree,
    build: Callable[..., pm.Model],
    pictures: dict[str, Callable[..., Any]],
) -> None:
    before = optimum.n_responses, optimum.evaluator.n_responses
    for name in ("responses", "ecdf", "population", "landscape", "optimizer"):
        pictures[name]()
    assert (optimum.n_responses, optimum.evaluator.n_responses) == before
    for propagation, cost in ((prb.Resimulated(64), 41 * 64), (prb.Fresh(50), 41 * 50)):
        seen: list[int] = []

        def counted(x: Any, seen: list[int] = seen) -> Any:
            seen.append(np.size(x))
            return np.asarray(x)

        model = build(propagation, counted)
        first_use(model)
        seen.clear()
        pc = prb.plot_responses(posterior, model=model)
        assert "after" in pc.viz
        assert sum(seen) <= cost + 300  # a few more where a response is tried first
        seen.clear()
        prb.plot_population(posterior, model=model)
        assert sum(seen) <= 300


def test_what_the_stored_responses_do_not_reach(
    caplog: pytest.LogCaptureFixture, optimum: prb.Optimum, posterior: xr.DataTree
) -> None:
    pc = prb.plot_responses(optimum, before={"mu": 50.0, "sigma": 0.1})
    assert "before" not in pc.viz
    assert "stored responses do not reach there" in caplog.text
    far = posterior.copy(deep=True)
    far["posterior"]["mu"] = far["posterior"]["mu"] + 50
    with pytest.raises(
        prb.propagation.DesignError, match="support 0 of 200 populations of the posterior"
    ):
        prb.plot_responses(far, model=optimum.model)


def test_a_narrow_peak_before_does_not_flatten_the_data(
    optimum: prb.Optimum, read: SimpleNamespace
) -> None:
    pc = prb.plot_responses(optimum, before={"mu": 1.0, "sigma": 0.05})
    low, high = pc.viz["plot"]["y"].item().get_ylim()
    assert high < 3
    assert low < 0
    assert read.xy(pc, "before", "y")[1].max() > high


def test_wrong_arguments_are_refused(optimum: prb.Optimum) -> None:
    with pytest.raises(TypeError, match="got int, expected an Optimum"):
        prb.plot_responses(3, model=optimum.model)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"prob: got 1\.5"):
        prb.plot_responses(optimum, prob=1.5)


def test_each_output_has_a_panel_with_what_was_measured_of_it(
    pair: SimpleNamespace, read: SimpleNamespace
) -> None:
    pc = prb.plot_responses(pair.posterior, model=pair.model)
    for column, mean in (("first", 2.0), ("second", 6.6)):
        x, y = read.xy(pc, "after", f"frame[{column}]")
        np.testing.assert_allclose(y, stats.norm.pdf(x, mean, 1), atol=0.025)
    axes = [pc.viz["plot"][f"frame[{name}]"].item() for name in ("first", "second")]
    assert [axis.get_title() for axis in axes] == [
        "25 measured values",
        "23 measured values, 1 failed",
    ]
    assert [axis.get_xlabel() for axis in axes] == ["first (Hz)", "second (Hz)"]
    finite = np.sort(pair.observed[:, 1][np.isfinite(pair.observed[:, 1])])
    np.testing.assert_array_equal(np.sort(read.xy(pc, "rug", "frame[second]")[0]), finite)
    area = np.trapezoid(*read.xy(pc, "measured", "frame[second]")[::-1])
    assert area == pytest.approx(22 / 23)
