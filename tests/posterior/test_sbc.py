"""`simulation_based_calibration`: ranks, failures, and calibration of posteriors."""

import logging
import multiprocessing
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from functools import cache
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pymc as pm
import pytest
import xarray as xr
from four_metrics import METRICS, R256, same
from one_input import one_input

import prbayes as prb
from prbayes.model.evaluator import Evaluator
from prbayes.model.random_variable import nodes
from prbayes.posterior import sbc
from prbayes.response.compile import PLAIN

OBSERVED = np.random.default_rng(1).normal(1.0, 0.5, 50)
N = OBSERVED.size
GROUPS = ("prior_sbc", "truth", "posterior_sd")


def bent(x: Any) -> Any:
    return x + 0.1 * x**2


def build(
    metric: prb.Metric = METRICS["kl"],
    response: Callable[..., Any] = same,
    n: int = N,
    propagation: Any = R256,
    **keywords: Any,
) -> pm.Model:
    settings = {"observed": OBSERVED[:n], "propagation": propagation, **keywords}
    return one_input(metric=metric, response=response, mu=(0, 1), sd=0.5, **settings)


def calibrate(n: int, model: pm.Model, **keywords: Any) -> xr.DataTree:
    return prb.simulation_based_calibration(n, model=model, progressbar=False, **keywords)


@pytest.fixture(autouse=True)
def _several_jobs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sbc, "_CHUNK", 3)


# -- results, wherever it runs


def bent_model(response: Any = bent) -> pm.Model:
    return build(response=response, n=30, propagation=prb.Reweighted(64))


@cache
def serial() -> tuple[pm.Model, xr.DataTree]:
    model = bent_model()
    return model, calibrate(6, model, draws=50)


@pytest.fixture(scope="module")
def executors() -> Iterator[dict[str, Executor]]:
    context = multiprocessing.get_context("spawn")
    with ThreadPoolExecutor(2) as threads, ProcessPoolExecutor(1, mp_context=context) as processes:
        yield {"threads": threads, "processes": processes}


@pytest.mark.parametrize(
    ("kind", "response"),
    [
        pytest.param("threads", bent, id="threads", marks=pytest.mark.long),
        # Other processes do not perturb last digits.
        pytest.param(
            "processes",
            lambda x: x + 0.1 * x**2,
            id="processes",
            marks=[pytest.mark.exact, pytest.mark.slow],
        ),
    ],
)
def test_ranks_do_not_depend_on_the_executor(
    kind: str, response: Callable[..., Any], executors: dict[str, Executor]
) -> None:
    model = bent_model(response)
    ((rv, node),) = nodes(model).items()
    before = dict(vars(type(rv.owner.op)))
    result = calibrate(6, model, draws=50, executor=executors[kind])
    for group in GROUPS:
        xr.testing.assert_equal(result[group].to_dataset(), serial()[1][group].to_dataset())
    # The model is the one that was sent, not the one that arrived in a thread.
    assert nodes(model)[rv] is node
    assert all(vars(type(rv.owner.op))[name] is value for name, value in before.items())
    prb.set_epsilon(model, {"y": 1.0})
    expected = -Evaluator.of(model)(np.zeros((1, 1))).discrepancies[0, 0] - 0.5 * np.log(2 * np.pi)
    assert model.compile_logp(mode=PLAIN)({"mu": 0.0}) == pytest.approx(expected)


@pytest.mark.long
def test_the_result_is_complete_and_the_model_as_before(tmp_path: Path) -> None:
    model, result = serial()
    assert set(result.children) == {*GROUPS, "envelope"}
    envelope = result.envelope
    assert (envelope["lower"] <= envelope["upper"]).all()
    assert envelope["ecdf"].sel(variable="mu").values[-1] == 1.0
    for group in GROUPS:
        assert result[group].sizes == {"chain": 1, "draw": 6}
        assert set(result[group].data_vars) == {"mu"}
    ranks, truth = result.prior_sbc["mu"].values, result.truth["mu"].values
    assert ((ranks > 0) & (ranks < 1)).all()
    assert np.unique(ranks).size == 6
    assert abs(truth.mean()) < 4 / 6**0.5
    assert 0.2 < truth.std() < 2.5
    np.testing.assert_allclose(result.posterior_sd["mu"], 0.5 / 30**0.5, rtol=0.5)
    attrs = result.prior_sbc.attrs
    assert (attrs["failed"], attrs["draws"], attrs["random_seed"]) == (0, 50, "0")
    # Designs were refined for some data sets, and are as they were.
    (node,) = nodes(model).values()
    assert node.bound.n_points == 64
    assert node.bound.responses.count > 64
    assert node.epsilon_value == 1 / 30
    np.testing.assert_array_equal(node.target.observed, OBSERVED[:30])
    # Data sets do not depend on their number.
    few = calibrate(3, model, draws=50)
    np.testing.assert_array_equal(few.prior_sbc["mu"].values[0], ranks[0, :3])
    other = calibrate(2, model, draws=50, random_seed=1)
    assert not np.isin(other.truth["mu"].values, truth).any()
    # ArviZ draws it, and netCDF keeps it.
    mpl.use("Agg")
    import arviz as az

    line = az.plot_ecdf_pit(result).viz["ecdf_lines"]["mu"].item()
    assert np.isfinite(line.get_ydata()).all()
    mpl.pyplot.close("all")
    result.to_netcdf(tmp_path / "sbc.nc", engine="h5netcdf")
    with xr.open_datatree(tmp_path / "sbc.nc", engine="h5netcdf") as again:
        for group in result.children:
            xr.testing.assert_identical(again[group].to_dataset(), result[group].to_dataset())


def test_ranks_count_the_draws_below_the_truth(monkeypatch: pytest.MonkeyPatch) -> None:
    # A posterior that is always the same: 0, 1, ..., 9.
    def fixed(*_: object) -> xr.DataTree:
        draws = xr.Dataset({"mu": (["chain", "draw"], np.arange(10.0)[None] / 5 - 1)})
        return xr.DataTree.from_dict({"posterior": draws})

    monkeypatch.setattr(sbc, "draw_posterior", fixed)
    result = calibrate(20, build(), draws=10)
    truth, ranks = result.truth["mu"].values, result.prior_sbc["mu"].values
    below = np.clip(np.ceil((truth + 1) * 5), 0, 10)
    np.testing.assert_array_equal(np.floor(ranks * 11), below)
    np.testing.assert_allclose(result.posterior_sd["mu"], np.std(np.arange(10) / 5))


# -- failures


def breaking(x: Any) -> Any:
    return np.where(x < -1, np.inf, x)  # most specimens of a population around -2 fail


def test_failures_are_counted(caplog: pytest.LogCaptureFixture) -> None:
    model = build(METRICS["area"], breaking, n=20, epsilon=0.1)
    with caplog.at_level(logging.WARNING, logger="prbayes"):
        result = calibrate(12, model, draws=20, adjustment=None)
    failed = result.prior_sbc.attrs["failed"]
    # All specimens fail where mu < -2 or so, which has some per cent of the prior.
    assert 1 <= failed <= 6
    assert result.prior_sbc.sizes["draw"] == 12 - failed
    text = f"{failed} of 12 data sets could not be analysed; the first: ValueError: observed: got"
    assert text in caplog.text
    assert (result.truth["mu"] > -1.5).all()


@cache
def whole() -> tuple[pm.Model, Any]:
    model = build(epsilon=0.02)
    return model, calibrate(6, model, draws=10, adjustment=None).prior_sbc["mu"].values


@pytest.mark.parametrize("error", [ValueError, RuntimeError, np.linalg.LinAlgError])
def test_single_failures_leave_the_others_as_they_are(
    error: type[Exception], monkeypatch: pytest.MonkeyPatch
) -> None:
    original, calls = sbc._ranks, []
    model, ranks = whole()

    def sometimes(*arguments: Any) -> Any:
        calls.append(1)
        row = original(*arguments)
        if len(calls) in (1, 4):
            raise error("by chance")
        return row

    monkeypatch.setattr(sbc, "_ranks", sometimes)
    result = calibrate(6, model, draws=10, adjustment=None)
    assert result.prior_sbc.attrs["failed"] == 2
    np.testing.assert_array_equal(result.prior_sbc["mu"].values, ranks[:, [1, 2, 4, 5]])


def test_mostly_failures_and_mistakes_are_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(error: Exception) -> Any:
        raise error

    model = whole()[0]
    for raised, expected, message in (
        (
            ValueError("no luck"),
            RuntimeError,
            "4 of 4 data sets failed; first: ValueError: no luck",
        ),
        (KeyError("a bug"), KeyError, "a bug"),
    ):
        monkeypatch.setattr(sbc, "_ranks", lambda *_, error=raised: fail(error))
        with pytest.raises(expected, match=message):
            calibrate(4, model)


def test_other_likelihoods_and_potentials_are_refused() -> None:
    for add in (
        lambda mu: pm.Normal("z", mu, 1.0, observed=OBSERVED),
        lambda mu: pm.Potential("z", -(mu**2)),
    ):
        with build() as model:
            add(model["mu"])
        with pytest.raises(ValueError, match="potentials besides its simulators, whose data"):
            calibrate(2, model)


# -- calibration


def spread(result: xr.DataTree) -> Any:
    """Return the mean squared distance of ranks from a half, less 1/12, in standard errors."""
    ranks = result.prior_sbc["mu"].values.ravel()
    return (((ranks - 0.5) ** 2).mean() - 1 / 12) / (180 * ranks.size) ** -0.5


@pytest.mark.long
def test_a_wrong_width_is_detected() -> None:
    """With a multiple f of epsilon, ranks Phi(z / sqrt(f)) have mean square asin(1/(1+f)) / (2 pi).

    It is .18 for .1, six standard errors of 25 uniform ranks above 1/12.
    """
    model = build(epsilon=0.1 / N)
    assert spread(calibrate(25, model, draws=50, adjustment=None)) > 4


@pytest.mark.slow
@pytest.mark.parametrize("name", list(METRICS))
def test_posteriors_given_the_estimate_are_calibrated(name: str) -> None:
    result = calibrate(100, build(METRICS[name]), draws=100)
    assert result.prior_sbc.attrs["failed"] == 0
    assert abs(spread(result)) < 4
    ranks = result.prior_sbc["mu"].values
    assert abs(ranks.mean() - 0.5) < 4 / (12 * ranks.size) ** 0.5
