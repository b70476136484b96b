"""The posterior given the estimate: against exact posteriors, and where it is left as it is."""

import logging
from types import SimpleNamespace
from typing import Any

import numpy as np
import pymc as pm
import pytest
import xarray as xr
from four_metrics import METRICS, same
from scipy import stats

import prbayes as prb
from prbayes._checks import Floats
from prbayes.estimate.refit import SamplingDistribution
from prbayes.posterior import GivenEstimate, given_estimate
from prbayes.posterior.adjustment import UnsettledError

TEN = np.random.default_rng(5).normal(0, 1, 10)


def build(metric: prb.Metric, observed: Floats, sd: float, **keywords: Any) -> pm.Model:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 3), pm.HalfNormal("sigma", sd))
        prb.Simulator("y", same, x, metric=metric, observed=observed, **keywords)
    return model


def sample(model: pm.Model, adjust: Any, draws: int = 1000, **keywords: Any) -> xr.DataTree:
    return prb.sample_smc(
        draws, chains=1, model=model, adjust=adjust, progressbar=False, random_seed=1, **keywords
    )


def exact(observed: Floats, sd: float) -> Floats:
    """Mean and sd of mu and of sigma, from the exact posterior on a grid."""
    mu, sigma = np.meshgrid(np.linspace(-3, 3, 401), np.geomspace(0.1, 8, 400), indexing="ij")
    log = stats.norm.logpdf(mu, 0, 3) + stats.halfnorm.logpdf(sigma, 0, sd) + np.log(sigma)
    log += stats.norm.logpdf(observed[:, None, None], mu, sigma).sum(axis=0)
    w = np.exp(log - log.max())
    w /= w.sum()
    found = []
    for value in (mu, sigma):
        mean = (w * value).sum()
        found += [mean, np.sqrt((w * (value - mean) ** 2).sum())]
    return np.array(found)


def moments(idata: xr.DataTree) -> Floats:
    found = []
    for name in ("mu", "sigma"):
        found += [float(idata.posterior[name].mean()), float(idata.posterior[name].std())]
    return np.array(found)


@pytest.mark.long
@pytest.mark.parametrize("sd", [pytest.param(2.0, marks=pytest.mark.slow), 0.3])
def test_of_ten_specimens_it_is_about_the_exact_posterior(sd: float) -> None:
    # The divergence uses nearly all of the data; the sharp prior pulls sigma by a third.
    found = moments(sample(build(METRICS["kl"], TEN, sd), GivenEstimate(n_fits=2000), draws=2000))
    expected = exact(TEN, sd)
    widths = expected[[1, 1, 3, 3]]
    np.testing.assert_allclose((found - expected) / widths, 0, atol=0.25)


@pytest.mark.long
def test_a_hyperparameter_that_nothing_tells_keeps_its_prior() -> None:
    with pm.Model() as model:
        pm.Normal("idle", 5, 30)
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1))
        prb.Simulator("y", same, x, metric=METRICS["pr"], observed=TEN)
    idata = sample(model, GivenEstimate(n_fits=400))
    idle = idata.posterior["idle"].values.ravel()
    assert abs(idle.mean() - 5) < 4 * 30 / np.sqrt(500)
    assert 0.85 < idle.std() / 30 < 1.15
    assert idata.posterior.attrs["adjustment"].startswith("GivenEstimate(")


@pytest.mark.slow
def test_prior_and_data_that_contradict_each_other_are_weighed_and_told_of(
    caplog: pytest.LogCaptureFixture,
) -> None:
    observed = np.random.default_rng(11).normal(10, 1, 20)
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 13.2, 0.5), pm.HalfNormal("sigma", 1))
        prb.Simulator("y", same, x, metric=METRICS["kl"], observed=observed)
    optimum = prb.minimize(model, progressbar=False)
    straight = moments(sample(model, prb.posterior.Affine(), optimum=optimum))
    with caplog.at_level(logging.WARNING, "prbayes"):
        found = moments(sample(model, GivenEstimate(), optimum=optimum))
    assert "contradict each other" in caplog.text
    # Exact: 10.68 +- .27, .97 +- .22; a straight line leaves both where the data have them. That
    # far out the distribution of estimates is not known well, which is told.
    assert straight[1] < 0.18
    assert found[0] > straight[0]
    assert found[1] > 1.3 * straight[1]


def test_where_responses_are_not_stored_it_is_the_straight_map() -> None:
    model = build(METRICS["pr"], TEN, 2.0, propagation=prb.Resimulated(256))
    given = sample(model, GivenEstimate(), draws=200)
    straight = sample(model, prb.posterior.Affine(), draws=200)
    np.testing.assert_array_equal(given.posterior["mu"], straight.posterior["mu"])
    assert given.posterior.attrs["adjustment"].startswith("Affine(")


@pytest.mark.long
def test_where_too_few_refits_arrive_it_is_the_straight_map_and_says_so(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = build(METRICS["pr"], TEN, 2.0)
    straight = sample(model, prb.posterior.Affine(), draws=200)

    def none(*_: Any) -> None:
        raise UnsettledError("3 of 500 refits converged")

    monkeypatch.setattr(given_estimate._Look, "refits", none)
    with caplog.at_level(logging.WARNING, "prbayes"):
        given = sample(model, GivenEstimate(), draws=200)
    assert "3 of 500 refits converged; the draws are those of prb.posterior.Affine()" in caplog.text
    assert given.posterior.attrs["adjustment"].endswith(
        "as Affine does where refits tell no density of the estimate"
    )
    np.testing.assert_array_equal(given.posterior["mu"], straight.posterior["mu"])


@pytest.mark.parametrize(
    ("strain", "moved", "memory", "pairs", "words"),
    [
        (1.0, 0.5, 0.01, 16, []),
        (4.0, 0.5, 0.01, 64, ["4.0 standard deviations from where it is expected"]),
        (1.0, 1.5, 0.01, 64, ["still moved by 1.5 of their standard deviations"]),
        (1.0, 0.5, 0.4, 64, ["still have a correlation of 0.40 with where they began"]),
        (1.0, 0.5, 0.01, 15, ["could be prepared for 15 of the data sets"]),
        (4.0, 1.5, 0.4, 0, ["prepared for 0", "4.0", "1.5", "0.40"]),
    ],
)
def test_what_speaks_against_draws_is_told(
    strain: float, moved: float, memory: float, pairs: int, words: list[str]
) -> None:
    sampling = SimpleNamespace(prepares=True)
    look: Any = SimpleNamespace(strain=lambda model, draws: strain, sampling=sampling)
    refits = SimpleNamespace(anew=np.where(np.arange(100)[:, None] < pairs, 0.0, np.nan))
    found: Any = SimpleNamespace(model=None, draws=None, moved=moved, memory=memory, refits=refits)
    doubts = GivenEstimate()._doubts(look, found)
    assert len(doubts) == len(words)
    for doubt, word in zip(doubts, words, strict=True):
        assert word in doubt
    # Of one output, or of responses that are not stored, there is nothing to prepare.
    sampling.prepares = False
    assert len(GivenEstimate()._doubts(look, found)) == len(words) - (pairs < 16)


@pytest.mark.slow
def test_it_depends_on_its_seed_alone() -> None:
    model = build(METRICS["area"], TEN, 2.0)
    optimum = prb.minimize(model, progressbar=False)
    one, again, other = (
        sample(model, GivenEstimate(n_fits=300, random_seed=seed), draws=200, optimum=optimum)
        for seed in (0, 0, 1)
    )
    np.testing.assert_array_equal(one.posterior["mu"], again.posterior["mu"])
    assert (one.posterior["mu"] != other.posterior["mu"]).any()
    # Few refits, and an error that says so.
    errors = [one.posterior.attrs[f"adjustment_{what}_error"] for what in ("center", "width")]
    assert 0.03 < errors[0] < 0.4
    assert 0.02 < errors[1] < 0.3


def test_too_few_fits_are_refused() -> None:
    with pytest.raises(ValueError, match="GivenEstimate: n_fits"):
        GivenEstimate(n_fits=10)


@pytest.mark.long
def test_where_the_optimum_is_at_an_edge_it_is_the_straight_map_and_says_so(
    caplog: pytest.LogCaptureFixture,
) -> None:
    # The readings scatter less than their error alone does.
    observed = stats.norm.ppf((np.arange(20) + 0.5) / 20, 0, 0.9)
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1))
        error = pm.Normal.dist(0, 1)
        prb.Simulator(
            "y", lambda x, e: x + e, x, error, metric=METRICS["pr"], observed=observed,
            propagation=prb.Reweighted(1024, emulator=None),
        )  # fmt: skip
    optimum = prb.minimize(model, progressbar=False)
    with caplog.at_level(logging.WARNING, "prbayes"):
        given = sample(model, GivenEstimate(n_fits=300), draws=200, optimum=optimum)
    straight = sample(model, prb.posterior.Affine(), draws=200, optimum=optimum)
    assert "the optimum is at an edge" in caplog.text
    np.testing.assert_array_equal(given.posterior["mu"], straight.posterior["mu"])


@pytest.mark.long
def test_a_metric_prepared_anew_moves_center_and_width(monkeypatch: pytest.MonkeyPatch) -> None:
    observed = np.random.default_rng(5).normal(0, 1, 50)
    model = build(METRICS["kl"], observed, 2.0)
    before = moments(sample(model, GivenEstimate()))

    def anew(self: Any, sets: Any, start: Floats, minimisers: Floats) -> Floats:
        # A standard error up, and half as wide.
        found = np.full_like(minimisers, np.nan)
        found[:64] = start[:64] + 1 + (minimisers - start)[:64] / 2
        return found

    monkeypatch.setattr(SamplingDistribution, "refit_anew", anew)
    after = moments(sample(model, GivenEstimate()))
    widths = before[[1, 1, 3, 3]]
    change = (after - before) / widths
    # Of the mean a standard error, up or down as its axis goes; of the width a half.
    np.testing.assert_allclose(np.abs(change[0]), 1, atol=0.25)
    np.testing.assert_allclose(change[1], -0.5, atol=0.15)
    np.testing.assert_allclose(change[3], -0.5, atol=0.2)


def test_estimates_are_those_of_the_metric_prepared_anew() -> None:
    rng = np.random.default_rng(1)
    points = rng.normal(scale=2, size=(400, 2))
    away = rng.normal(size=(400, 2))
    anew = np.where(np.arange(400)[:, None] < 64, points + 1 + away / 2, np.nan)
    refits = given_estimate._Refits(points, points, points + away, anew, rng.random(400))
    np.testing.assert_allclose(refits.estimates, points + 1 + away / 2, atol=0.4)
    # Some of them, or more, hold together.
    chosen = np.arange(10, 300)
    again = refits.rows(chosen).and_more(refits.rows(np.arange(100)))
    assert np.isfinite(again.anew).all(axis=1).sum() == 54 + 64
    np.testing.assert_array_equal(again.points[:290], points[chosen])
