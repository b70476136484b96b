"""What adjusts draws where nobody chose."""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pymc as pm
import pytest
import xarray as xr
from four_metrics import METRICS, R256, same

import prbayes as prb
from prbayes._checks import Floats
from prbayes.metrics.joint import Joint
from prbayes.model.evaluator import Evaluator
from prbayes.posterior import Affine, GivenEstimate
from prbayes.posterior.default_adjustment import NONE_NEEDED, default_adjustment

OBSERVED = np.random.default_rng(2).normal(1.0, 0.5, 30)


def build(metric: prb.Metric, observed: Floats = OBSERVED, **keywords: Any) -> pm.Model:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1))
        given = {"propagation": R256} | keywords
        prb.Simulator("y", same, x, metric=metric, observed=observed, **given)
    return model


def chosen(metric: prb.Metric, observed: Floats = OBSERVED, **keywords: Any) -> Affine:
    return default_adjustment(Evaluator(build(metric, observed, **keywords)))


def test_draws_are_those_given_the_estimate_but_for_a_likelihood() -> None:
    for name in ("pr", "kl", "area"):
        assert chosen(METRICS[name]) == GivenEstimate()
    for metric in (METRICS["ll"], Joint(METRICS["ll"])):
        assert not isinstance(chosen(metric), GivenEstimate)


@pytest.mark.parametrize(
    "keywords",
    [
        {"metric": prb.LogLikelihood(density=prb.GaussianKDE(0.3))},
        {"epsilon": 0.1},
        {"specimens": [i // 2 for i in range(30)]},
        {"propagation": prb.Resimulated(256)},
    ],
    ids=["wide kernel", "an epsilon", "specimens", "not stored"],
)
def test_what_is_not_quite_a_likelihood_is_adjusted(keywords: dict[str, Any]) -> None:
    assert chosen(**{"metric": METRICS["ll"]} | keywords) == GivenEstimate()


def test_another_seed_has_other_refits(tmp_path: Path) -> None:
    optimum = prb.minimize(build(METRICS["kl"]))
    run = partial(prb.sample_smc, 40, model=optimum.model, optimum=optimum, progressbar=False)

    def done(**keywords: Any) -> str:
        return str(run(**keywords).posterior.attrs["adjustment"])

    assert "random_seed=3," in done(random_seed=3)
    # Nobody's own seed is changed, and without a seed there is none twice.
    given = GivenEstimate(random_seed=5, n_fits=200)
    assert "random_seed=5," in done(random_seed=3, adjust=given)
    unseeded = run(random_seed=None, checkpoint=tmp_path / "state.npz")
    assert done(random_seed=None) != unseeded.posterior.attrs["adjustment"]
    again = run(random_seed=None, checkpoint=tmp_path / "state.npz")
    assert again.posterior.attrs["adjustment"] == unseeded.posterior.attrs["adjustment"]
    xr.testing.assert_equal(again.posterior, unseeded.posterior)


def grouped(metric: prb.Metric) -> pm.Model:
    places = np.repeat(["a", "b", "c"], 10)
    observed = xr.DataArray(OBSERVED, coords={"g": ("specimen", places)}, dims="specimen")
    with pm.Model(coords={"g": ["a", "b", "c"]}) as model:
        mu = pm.Normal("mu", pm.Normal("m", 0, 2), pm.HalfNormal("tau", 1), dims="g")
        x = pm.Normal.dist(mu[prb.response.group("g")], pm.HalfNormal("sigma", 1))
        prb.Simulator("y", same, x, metric=metric, observed=observed, propagation=R256)
    return model


def two(labels: Any) -> pm.Model:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1))
        for name in ("y", "z"):
            prb.Simulator(
                name, same, x, metric=METRICS["ll"], observed=OBSERVED, specimens=labels,
                propagation=R256,
            )  # fmt: skip
    return model


def test_likelihoods_of_different_specimens_are_one() -> None:
    """Their draws are the posterior as they are, and refits would make them narrower."""
    for model in (grouped(METRICS["ll"]), two(None)):
        assert type(default_adjustment(Evaluator(model))).__name__ == "_LikelihoodDraws"
    assert default_adjustment(Evaluator(two(np.arange(30)))) == GivenEstimate()
    assert default_adjustment(Evaluator(grouped(METRICS["pr"]))) == GivenEstimate()


def sample(model: pm.Model, **keywords: Any) -> xr.DataTree:
    return prb.sample_smc(200, chains=2, model=model, random_seed=1, progressbar=False, **keywords)


@pytest.mark.long
def test_draws_of_a_likelihood_stay_and_refits_tell_whether_the_family_fits() -> None:
    model = build(METRICS["ll"])
    optimum = prb.minimize(model, progressbar=False)
    idata = sample(model, optimum=optimum)
    plain = sample(model, optimum=optimum, adjust=False)
    np.testing.assert_array_equal(idata.posterior["sigma"], plain.posterior["sigma"])
    assert "unadjusted" not in idata.children
    assert idata.posterior.attrs["adjustment"] == NONE_NEEDED
    assert 0.05 < idata.posterior.attrs["fit_probability"] <= 1
    assert prb.diagnose(idata).notes == ()
    assert NONE_NEEDED in prb.Report("A", posterior=idata, pictures=False)._repr_html_()
    # Two lumps, of which no normal population is.
    lumps = np.concatenate([OBSERVED[:15] * 0.05, 3 + OBSERVED[15:] * 0.05])
    assert "family" in str(prb.diagnose(sample(build(METRICS["ll"], lumps))))
