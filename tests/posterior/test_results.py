"""PyMC's keywords of `sample_smc`: what comes back is what was asked for."""

from functools import cache
from typing import Any

import numpy as np
import pymc as pm
import pytest
import xarray as xr

import prbayes as prb

OBSERVED = np.random.default_rng(1).normal(1.5, 0.6, 20)
QUIET = {"progressbar": False, "random_seed": 1}


@cache
def model() -> pm.Model:
    with pm.Model(coords={"steel": ["S235", "S355"]}) as made:
        mu, sigma = pm.Normal("mu", 1, 1, dims="steel"), pm.HalfNormal("sigma", 1)
        pm.Deterministic("ratio", sigma / mu[0])
        for i, name in enumerate("yz"):
            prb.Simulator(
                name, np.positive, pm.Normal.dist(mu[i], sigma), metric=prb.AreaMetric(),
                observed=OBSERVED + i, epsilon=0.02, propagation=prb.Reweighted(256),
            )  # fmt: skip
    return made


def sample(draws: int = 40, **keywords: Any) -> Any:
    settings: dict[str, Any] = {"chains": 2, "adjustment": None, "refine": False, **QUIET}
    return prb.sample_smc(draws, model=model(), **settings, **keywords)


@cache
def plain() -> xr.DataTree:
    return sample()


@pytest.mark.long
def test_a_multitrace_has_the_same_draws() -> None:
    trace = sample(return_inferencedata=False)
    assert isinstance(trace, pm.backends.base.MultiTrace)
    assert (trace.nchains, len(trace)) == (2, 40)
    for name in ("mu", "sigma", "ratio"):
        for chain, found in enumerate(trace.get_values(name, combine=False)):
            expected = plain().posterior[name].values[chain]
            np.testing.assert_allclose(found, expected, rtol=1e-12)
    assert trace["sigma_log__"].shape == (80,)


def test_names_dimensions_and_groups_are_those_asked_for() -> None:
    found = sample(
        var_names=["mu", "ratio"],
        idata_kwargs={
            "log_prior": False,
            "dims": {"y": ["specimen"]},
            "coords": {"specimen": range(20)},
        },
    )
    assert set(found.posterior.data_vars) == set(found.prior.data_vars) == {"mu", "ratio"}
    assert found.posterior.attrs["identity"] == plain().posterior.attrs["identity"]
    assert found.posterior["mu"].coords["steel"].values.tolist() == ["S235", "S355"]
    assert "log_prior" not in found
    assert "log_likelihood" in found
    for group in ("observed_data", "posterior_predictive"):
        assert found[group]["y"].dims[-1] == "specimen"
        assert found[group]["z"].dims[-1] == "z_dim_0"
        assert found[group].coords["specimen"].size == 20
    with pytest.raises(KeyError, match=r"got a result without \['sigma'\]"):
        prb.predict(found, np.positive, pm.Normal.dist(model()["mu"][0], 1.0), model=model())


def test_starts_are_where_chains_begin() -> None:
    rng = np.random.default_rng(3)
    prior = {"mu": rng.normal(1, 1, (40, 2)), "sigma": np.abs(rng.normal(size=40))}
    transformed = {"mu": prior["mu"], "sigma_log__": np.log(prior["sigma"])}
    one = sample(start=prior, cores=1)
    other = sample(start=[transformed, prior])
    np.testing.assert_allclose(one.posterior["mu"], other.posterior["mu"], rtol=1e-9)
    assert not np.allclose(one.posterior["mu"], plain().posterior["mu"])
    with pytest.raises(ValueError, match="start: got 1 dicts, expected one, or 2"):
        sample(start=[prior])
    # All particles at one place stay there: nothing but the start says where they are.
    there = {"mu": np.full((40, 2), [1.5, 2.5]), "sigma": np.full(40, 0.6)}
    stuck = sample(start=there)
    np.testing.assert_allclose(stuck.posterior["mu"].mean(["chain", "draw"]), [1.5, 2.5], atol=1e-3)


def test_pymc_s_own_sampler_gives_the_kernel_its_start() -> None:
    there = {"mu": np.full((20, 2), [1.5, 2.5]), "sigma_log__": np.log(np.full(20, 0.6))}
    kernel = prb.posterior.BatchedKernel(20, start=None, model=model(), random_seed=1)
    kernel.initialize(there, np.random.default_rng(1))
    np.testing.assert_allclose(kernel.tempered_posterior, [[1.5, 2.5, np.log(0.6)]] * 20)


@pytest.mark.long
def test_another_start_is_another_run_of_a_checkpoint(tmp_path: Any) -> None:
    rng = np.random.default_rng(3)
    prior = {"mu": rng.normal(1, 1, (40, 2)), "sigma": np.abs(rng.normal(size=40))}
    file = tmp_path / "run.nc"
    sample(start=prior, checkpoint=file)
    with pytest.raises(prb.response.StoreError):
        sample(start={**prior, "mu": prior["mu"] + 1}, checkpoint=file)
    with pytest.raises(prb.response.StoreError):
        sample(checkpoint=file)


@pytest.mark.parametrize(
    ("keywords", "error", "message"),
    [
        ({"var_names": ["nu"]}, KeyError, r"var_names: got \['nu'\], expected some of \['mu'"),
        ({"var_names": []}, KeyError, "var_names: got none"),
        ({"var_names": 3}, TypeError, "var_names: got int 3"),
        ({"idata_kwargs": 3}, TypeError, "idata_kwargs: got int 3, expected a dict"),
        ({"idata_kwargs": {"save_warmup": True}}, TypeError, r"got \['save_warmup'\]"),
        ({"idata_kwargs": {"log_prior": 1}}, TypeError, "log_prior: got int 1, expected True"),
        ({"idata_kwargs": {"dims": 1}}, TypeError, "dims: got int 1, expected a dict"),
        ({"idata_kwargs": {"dims": {"y": []}}}, ValueError, r"y: got \[\], expected 1 names"),
        ({"cores": 0}, ValueError, "cores: got 0, expected an integer >= 1"),
        ({"return_inferencedata": None}, TypeError, "expected True or False"),
    ],
)
def test_what_is_none_of_these_is_refused(
    keywords: dict[str, Any], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        sample(10, **keywords)
