"""`prb.posterior.Sampler` against the interface of PyMC's pull request 8358."""

import importlib.util
import inspect
import logging
from abc import ABC, abstractmethod
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pymc as pm
import pytest

import prbayes as prb
from prbayes.posterior import Sampler

# The arguments of `Sampler.sample_from_init` in pull request 8358, with their defaults. They are
# keywords, and a sampler has exactly these.
INTERFACE: dict[str, Any] = {
    "model": None,
    "draws": 1000,
    "tune": 1000,
    "chains": None,
    "cores": None,
    "blas_cores": "auto",
    "initvals": None,
    "random_seed": None,
    "progressbar": True,
    "quiet": False,
    "discard_tuned_samples": True,
    "keep_warning_stat": False,
    "var_names": None,
    "idata_kwargs": None,
    "compute_convergence_checks": True,
}
RUN: dict[str, Any] = {"draws": 60, "chains": 2, "random_seed": 1, "progressbar": False}


@cache
def model() -> pm.Model:
    with pm.Model() as m:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1))
        observed = [0.0, 0.5, 1.0, 2.0, 4.0]
        prb.Simulator("y", np.positive, x, metric=prb.ProbabilityResidual(), observed=observed)
    return m


@cache
def optimum() -> prb.Optimum:
    return prb.minimize(model(), progressbar=False)


def pm_sample(sampler: Any, *, tune: int | None = None, **run: Any) -> Any:
    """Call a sampler as `pymc.sample` of the pull request does, with all arguments of a run."""
    arguments = {**INTERFACE, "tune": tune, **run, "model": pm.modelcontext(run.get("model"))}
    assert arguments.keys() == INTERFACE.keys()
    return sampler.sample_from_init(**arguments)


def test_the_arguments_are_those_of_the_interface() -> None:
    parameters = inspect.signature(Sampler.sample_from_init).parameters
    assert {name: p.default for name, p in parameters.items() if name != "self"} == INTERFACE
    kinds = {p.kind for name, p in parameters.items() if name != "self"}
    assert kinds == {inspect.Parameter.KEYWORD_ONLY}


@pytest.mark.parametrize("function", [prb.sample, prb.sample_smc])
def test_draws_are_those_of_the_function(function: Any) -> None:
    sampler = Sampler(function, optimum=optimum())
    with model():
        idata = pm_sample(sampler, **RUN, var_names=["mu"], compute_convergence_checks=False)
    expected = function(**RUN, model=model(), optimum=optimum())
    assert list(idata["posterior"].data_vars) == ["mu"]
    np.testing.assert_array_equal(idata["posterior"]["mu"], expected["posterior"]["mu"])


def test_options_reach_the_function() -> None:
    sampler = Sampler(prb.sample_smc, optimum=optimum(), adjustment=None, refine=False)
    idata = pm_sample(sampler, **RUN, model=model())
    assert idata["posterior"].attrs["adjustment"] == "none"
    assert repr(sampler).startswith("Sampler(prb.sample_smc, optimum=")


def test_four_chains_by_default_and_quiet_is_quiet(caplog: pytest.LogCaptureFixture) -> None:
    sampler = Sampler(optimum=optimum())
    run = {**RUN, "chains": None, "idata_kwargs": {"log_likelihood": False}}
    with caplog.at_level(logging.INFO):
        idata = pm_sample(sampler, **run, model=model(), quiet=True)
        assert not [record for record in caplog.records if record.name.startswith("pymc")]
        pm_sample(sampler, **run, model=model(), cores=1, blas_cores=2)
    assert idata["posterior"].sizes["chain"] == 4
    assert "log_likelihood" not in idata.children
    assert "too small to check convergence" in caplog.text


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("tune", 500),
        ("initvals", {"mu": 0.0}),
        ("discard_tuned_samples", False),
        ("keep_warning_stat", True),
    ],
)
def test_what_does_not_apply_is_refused(name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=rf"^{name}: got .*expected .*leave it out"):
        pm_sample(Sampler(), **RUN, model=model(), **{name: value})


def test_other_functions_and_options_are_refused() -> None:
    with pytest.raises(TypeError, match=r"^function: got .*expected prb\.sample or"):
        Sampler(pm.sample)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=r"^options: got 'adjustment', expected .*max_seconds"):
        Sampler(prb.sample, adjustment=None)
    with pytest.raises(TypeError, match=r"^options: got 'draws', .*argument of pm\.sample"):
        Sampler(prb.sample_smc, draws=100)


def test_it_is_a_sampler_of_pymc_where_pymc_has_a_class_of_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Base(ABC):
        @abstractmethod
        def sample_from_init(self) -> None: ...

    monkeypatch.setattr(pm.sampling, "samplers", SimpleNamespace(Sampler=Base), raising=False)
    spec = importlib.util.spec_from_file_location("of_new_pymc", inspect.getfile(Sampler))
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert isinstance(module.Sampler(), Base)


def test_the_installed_pymc_takes_the_sampler() -> None:
    if "sampler" not in inspect.signature(pm.sample).parameters:
        assert Sampler.__base__ is object
        return
    with model():
        try:
            idata = pm.sample(sampler=Sampler(optimum=optimum()), **RUN)
        except Exception as error:
            pytest.fail(
                f"pm.sample(sampler=prb.posterior.Sampler()) of PyMC {pm.__version__}: got "
                f"{error!r}, expected draws; compare INTERFACE with the arguments of "
                "pymc.sampling.samplers.Sampler.sample_from_init, and change both"
            )
    assert idata["posterior"].sizes["draw"] == RUN["draws"]
