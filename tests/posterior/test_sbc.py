"""`simulation_based_calibration` against what it promises, wherever it runs."""

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

import prbayes as prb
from prbayes._validate import Floats
from prbayes.model.evaluator import Evaluator
from prbayes.model.random_variable import nodes
from prbayes.posterior import sbc
from prbayes.response.compile import PLAIN

OBSERVED = np.random.default_rng(1).normal(1.0, 0.5, 50)
N = OBSERVED.size


def bent(x: Any) -> Any:
    return x + 0.1 * x**2


def build(
    metric: prb.Metric = METRICS["kl"],
    response: Callable[..., Any] = same,
    n: int = N,
    **keywords: Any,
) -> pm.Model:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 1), 0.5)
        prb.Simulator(
            "y",
            response,
            x,
            metric=metric,
            observed=OBSERVED[:n],
            **({"propagation": R256} | keywords),
        )
    return model


# -- simulation-based calibration: where it runs
# ---------------------------------------------------------

RUN = {"n": 6, "draws": 50, "progressbar": False}


@pytest.fixture(autouse=True)
def several_jobs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sbc, "_CHUNK", 3)


@cache
def serial() -> tuple[pm.Model, xr.DataTree]:
    model = build(response=bent, n=30, propagation=prb.Reweighted(64))
    return model, prb.simulation_based_calibration(model=model, **RUN)


@pytest.fixture(scope="module")
def executors() -> Iterator[dict[str, Executor]]:
    with (
        ThreadPoolExecutor(2) as threads,
        ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as processes,
    ):
        yield {"threads": threads, "processes": processes}


@pytest.mark.long
@pytest.mark.parametrize(
    ("kind", "response"),
    [
        pytest.param("threads", bent, id="threads-module"),
        pytest.param(
            "threads", lambda x: x + 0.1 * x**2, id="threads-lambda", marks=pytest.mark.slow
        ),
        # Other processes do not perturb last digits.
        pytest.param(
            "processes",
            bent,
            id="processes-module",
            marks=[pytest.mark.exact, pytest.mark.slow],
        ),
        pytest.param(
            "processes",
            lambda x: x + 0.1 * x**2,
            id="processes-lambda",
            marks=[pytest.mark.exact, pytest.mark.slow],
        ),
    ],
)
def test_ranks_do_not_depend_on_where_they_are_found(
    kind: str, response: Callable[..., Any], executors: dict[str, Executor]
) -> None:
    model = build(response=response, n=30, propagation=prb.Reweighted(64))
    ((rv, node),) = nodes(model).items()
    before = dict(vars(type(rv.owner.op)))
    result = prb.simulation_based_calibration(model=model, executor=executors[kind], **RUN)
    for group in ("prior_sbc", "truth", "posterior_sd"):
        xr.testing.assert_equal(result[group].to_dataset(), serial()[1][group].to_dataset())
    # The model is the one that was sent, not the one that arrived in a thread.
    assert nodes(model)[rv] is node
    assert all(vars(type(rv.owner.op))[name] is value for name, value in before.items())
    prb.set_epsilon(model, {"y": 1.0})
    assert model.compile_logp(mode=PLAIN)({"mu": 0.0}) == pytest.approx(
        -Evaluator.of(model)(np.zeros((1, 1))).discrepancies[0, 0] - 0.5 * np.log(2 * np.pi)
    )


@pytest.mark.long
def test_the_result_is_complete_and_the_model_as_before() -> None:
    model, result = serial()
    assert set(result.children) == {"prior_sbc", "truth", "posterior_sd", "envelope"}
    envelope = result.envelope
    assert (envelope["lower"] <= envelope["upper"]).all()
    assert envelope["ecdf"].sel(variable="mu").values[-1] == 1.0
    for group in ("prior_sbc", "truth", "posterior_sd"):
        assert result[group].sizes == {"chain": 1, "draw": 6}
        assert set(result[group].data_vars) == {"mu"}
    ranks = result.prior_sbc["mu"].values
    assert ((ranks > 0) & (ranks < 1)).all()
    assert np.unique(ranks).size == 6
    truth = result.truth["mu"].values
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


@pytest.mark.long
def test_data_sets_do_not_depend_on_their_number() -> None:
    model, result = serial()
    few = prb.simulation_based_calibration(model=model, **(RUN | {"n": 3}))
    np.testing.assert_array_equal(
        few.prior_sbc["mu"].values[0], result.prior_sbc["mu"].values[0, :3]
    )
    other = prb.simulation_based_calibration(model=model, random_seed=1, **(RUN | {"n": 2}))
    assert not np.isin(other.truth["mu"].values, result.truth["mu"].values).any()


def test_ranks_count_the_draws_below_the_truth(monkeypatch: pytest.MonkeyPatch) -> None:
    # A posterior that is always the same: 0, 1, ..., 9.
    def fixed(evaluator: Evaluator, asked: object) -> xr.DataTree:
        draws = xr.Dataset({"mu": (["chain", "draw"], np.arange(10.0)[None] / 5 - 1)})
        return xr.DataTree.from_dict({"posterior": draws})

    monkeypatch.setattr(sbc, "draw_posterior", fixed)
    result = prb.simulation_based_calibration(20, model=build(), draws=10, progressbar=False)
    truth, ranks = result.truth["mu"].values, result.prior_sbc["mu"].values
    below = np.clip(np.ceil((truth + 1) * 5), 0, 10)
    np.testing.assert_array_equal(np.floor(ranks * 11), below)
    np.testing.assert_allclose(result.posterior_sd["mu"], np.std(np.arange(10) / 5))


@pytest.mark.long
def test_it_can_be_drawn_and_saved(tmp_path: Path) -> None:
    mpl.use("Agg")
    import arviz as az
    from matplotlib import pyplot as plt

    result = serial()[1]
    collection = az.plot_ecdf_pit(result)
    line = collection.viz["ecdf_lines"]["mu"].item()
    assert np.isfinite(line.get_ydata()).all()
    assert len(line.get_ydata()) > 1
    plt.close("all")
    result.to_netcdf(tmp_path / "sbc.nc", engine="h5netcdf")
    with xr.open_datatree(tmp_path / "sbc.nc", engine="h5netcdf") as again:
        for group in result.children:
            xr.testing.assert_identical(again[group].to_dataset(), result[group].to_dataset())


# -- failures
# --------------------------------------------------------------------------------------------


def breaking(x: Any) -> Any:
    return np.where(x < -1, np.inf, x)  # hardly any specimen of a population around -2 does not


def test_failures_are_counted_and_not_lost(caplog: pytest.LogCaptureFixture) -> None:
    model = build(METRICS["area"], breaking, n=20, epsilon=0.1)
    with caplog.at_level(logging.WARNING, logger="prbayes"):
        result = prb.simulation_based_calibration(
            12, model=model, draws=20, adjustment=None, progressbar=False
        )
    failed = result.prior_sbc.attrs["failed"]
    # All specimens fail where mu < -2 or so, which has some per cent of the prior.
    assert 1 <= failed <= 6
    assert result.prior_sbc.sizes["draw"] == 12 - failed
    assert (
        f"{failed} of 12 data sets could not be analysed; the first: ValueError: observed: got"
        in caplog.text
    )
    assert (result.truth["mu"] > -1.5).all()


@pytest.mark.parametrize("error", [ValueError, RuntimeError, np.linalg.LinAlgError])
def test_single_failures_leave_the_others_as_they_are(
    error: type[Exception], monkeypatch: pytest.MonkeyPatch
) -> None:
    original, calls = sbc._ranks, []

    def sometimes(*arguments: Any) -> Any:
        calls.append(1)
        row = original(*arguments)
        if len(calls) in (1, 4):
            raise error("by chance")
        return row

    keywords = {"model": build(epsilon=0.02), "draws": 10, "adjustment": None, "progressbar": False}
    whole = prb.simulation_based_calibration(6, **keywords)
    monkeypatch.setattr(sbc, "_ranks", sometimes)
    result = prb.simulation_based_calibration(6, **keywords)
    assert result.prior_sbc.attrs["failed"] == 2
    np.testing.assert_array_equal(
        result.prior_sbc["mu"].values, whole.prior_sbc["mu"].values[:, [1, 2, 4, 5]]
    )


def test_mostly_failures_are_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def never(*_: Any) -> None:
        raise ValueError("no luck")

    model = build()
    monkeypatch.setattr(sbc, "_ranks", never)
    with pytest.raises(RuntimeError, match="4 of 4 data sets failed; first: ValueError: no luck"):
        prb.simulation_based_calibration(4, model=model, progressbar=False)


def test_mistakes_are_not_failures(monkeypatch: pytest.MonkeyPatch) -> None:
    def wrong(*_: Any) -> None:
        raise KeyError("a bug")

    model = build()
    monkeypatch.setattr(sbc, "_ranks", wrong)
    with pytest.raises(KeyError, match="a bug"):
        prb.simulation_based_calibration(4, model=model, progressbar=False)


def test_what_cannot_be_simulated_is_refused() -> None:
    with build() as model:
        pm.Normal("z", model["mu"], 1.0, observed=OBSERVED)
    with pytest.raises(
        ValueError, match="likelihood terms or potentials besides its simulators, whose data cannot"
    ):
        prb.simulation_based_calibration(2, model=model, progressbar=False)
    with build() as model:
        pm.Potential("z", -(model["mu"] ** 2))
    with pytest.raises(ValueError, match="likelihood terms or potentials"):
        prb.simulation_based_calibration(2, model=model, progressbar=False)
    with pytest.raises(
        TypeError, match=r"prb\.simulation_based_calibration: got no model on the context"
    ):
        prb.simulation_based_calibration(2, progressbar=False)
    for keywords, words in (({"n": 1}, "n: "), ({"draws": 5}, "draws: ")):
        with pytest.raises(ValueError, match=words):
            prb.simulation_based_calibration(
                **({"n": 2, "model": build(), "progressbar": False} | keywords)
            )


# -- what it is for
# --------------------------------------------------------------------------------------


def spread(result: xr.DataTree) -> Floats:
    """Mean squared distance of the ranks from a half, in standard errors from that of uniform ones, 1/12."""
    ranks = result.prior_sbc["mu"].values.ravel()
    return np.asarray((((ranks - 0.5) ** 2).mean() - 1 / 12) / (180 * ranks.size) ** -0.5)


@pytest.mark.long
def test_overconfidence_shows() -> None:
    # Ten times too small an epsilon: posteriors are too narrow by sqrt(10), and ranks Phi(sqrt(10)
    # z) have a mean square of asin(10/11) / (2 pi) = 0.18, six standard errors of 25 uniform ones
    # above 1/12.
    narrow = prb.simulation_based_calibration(
        25, model=build(epsilon=0.1 / N), draws=50, adjustment=None, progressbar=False
    )
    assert spread(narrow) > 4


@pytest.mark.slow
def test_underconfidence_shows() -> None:
    # Ten times too large an epsilon, ranks Phi(z / sqrt(10)): asin(1/11) / (2 pi) = 0.014.
    wide = prb.simulation_based_calibration(
        25, model=build(epsilon=10 / N), draws=50, adjustment=None, progressbar=False
    )
    assert spread(wide) < -3


@pytest.mark.slow
@pytest.mark.parametrize("name", list(METRICS))
def test_posteriors_given_the_estimate_are_calibrated(name: str) -> None:
    result = prb.simulation_based_calibration(
        100, model=build(METRICS[name]), draws=100, progressbar=False
    )
    assert result.prior_sbc.attrs["failed"] == 0
    assert abs(spread(result)) < 4
    ranks = result.prior_sbc["mu"].values
    assert abs(ranks.mean() - 0.5) < 4 / (12 * ranks.size) ** 0.5
