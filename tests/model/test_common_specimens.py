"""Specimens with readings of several simulators, and repeated readings of one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import arviz as az
import numpy as np
import pymc as pm
import pytest
import xarray as xr
from scipy import stats

import prbayes as prb
from prbayes._validate import Floats
from prbayes.model.evaluator import Evaluator, specimen_log_likelihoods
from prbayes.model.specimen_likelihood import draw_readings, specimen_likelihoods
from prbayes.response.compile import PLAIN
from prbayes.specimens.points import SpecimenOptions
from prbayes.validation.cross_validation import _mean_log_losses

N = 20
RNG = np.random.default_rng(3)
X = RNG.normal(1.0, 0.5, N)
Y = np.stack([1 + 2 * X, 3 - X], axis=1) + [0.3, 0.2] * RNG.standard_normal((N, 2))
A, B = np.arange(14), np.arange(6, N)  # specimens of either simulator
LABELS = np.concatenate([np.arange(N), np.arange(8), np.arange(3)])
REPEATED = (1 + 2 * X)[LABELS] + 0.3 * RNG.standard_normal(len(LABELS))
# Five times the error of a root's mass, which 256 points measure.
TOLERANCE = 0.0125
POINT = {"mu": 0.8, "sigma_log__": -0.5}
OTHER = {"mu": 1.1, "sigma_log__": -0.7}


def up(x: Any) -> Any:
    return 1 + 2 * x


def down(x: Any, c: float) -> Any:
    return c - x


def population() -> Any:
    return pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("sigma", 1))


def metric(**given: Any) -> prb.LogLikelihood:
    return prb.LogLikelihood(**given)


def two_simulators(of_a: Any = Y[A, 0], of_b: Any = Y[B, 1]) -> pm.Model:
    with pm.Model() as model:
        x = population()
        a = pm.Data("data", of_a)
        prb.Simulator("a", up, x, observed=a, specimens=A, metric=metric(error=0.3))
        prb.Simulator("b", down, x, 3.0, observed=of_b, specimens=B, metric=metric(error=0.2))
    return model


def fine(model: pm.Model, points: int = 512) -> pm.Model:
    """Give a model more points a root than four, for densities of single specimens."""
    for likelihood in specimen_likelihoods(model).values():
        vars(likelihood)["options"] = replace(SpecimenOptions(), points=points)
    return model


@cache
def shared() -> pm.Model:
    """Return a model for tests that leave it as it is."""
    return fine(two_simulators())


def repeated(error: Callable[[], Any] = lambda: 0.3) -> pm.Model:
    with pm.Model() as model:
        given = {"observed": REPEATED, "specimens": LABELS, "metric": metric(error=error())}
        prb.Simulator("y", up, population(), **given)
    return model


def log_density(model: pm.Model, rv: str) -> Callable[[dict[str, Any]], Floats]:
    """Return the log-density of an observed variable, without a compiler."""
    graph = model.logp(vars=[model[rv]], sum=False)[0]
    function = model.compile_fn(
        graph, inputs=model.value_vars, mode=PLAIN, on_unused_input="ignore"
    )
    return lambda point: np.asarray(function(point))


def values(model: pm.Model, rv: str, point: dict[str, Any] = POINT) -> Floats:
    return log_density(model, rv)(point)


def exact(point: dict[str, Any], y: Floats = Y, errors: Any = (0.3, 0.2)) -> Floats:
    """Return the log-density of specimens of `two_simulators` in closed form."""
    slopes = np.array([2.0, -1.0])
    variance = np.exp(2 * point["sigma_log__"])
    mean = np.array([1.0, 3.0]) + slopes * point["mu"]
    covariance = np.outer(slopes, slopes) * variance + np.diag(np.square(errors))
    outputs = [[j for j, own in enumerate((A, B)) if i in own] for i in range(N)]
    return np.array(
        [
            stats.multivariate_normal(mean[j], covariance[np.ix_(j, j)]).logpdf(row[j])
            for row, j in zip(y, outputs, strict=True)
        ]
    )


def exact_repeated(point: dict[str, Any], error: float) -> Floats:
    """Return the log-density of specimens with repeated readings in closed form."""
    logs = []
    for i in range(N):
        y = REPEATED[np.isin(LABELS, i)]
        covariance = 4 * np.exp(2 * point["sigma_log__"]) + np.diag(np.full(len(y), error**2))
        mean = np.full(len(y), 1 + 2 * point["mu"])
        logs.append(stats.multivariate_normal(mean, covariance).logpdf(y))
    return np.array(logs)


def assert_close(ours: Callable[[Any], Floats], expected: Callable[[Any], Floats]) -> None:
    """Compare log-densities of specimens in two populations."""
    for point in (POINT, OTHER):
        assert np.allclose(ours(point), expected(point), atol=TOLERANCE)


def assert_without_a_graph(
    model: pm.Model, rv: str, ours: Callable[[dict[str, Any]], Floats]
) -> None:
    """Compare with log-likelihoods of arrays, as optimisers and importance sampling use them."""
    evaluator = Evaluator.of(model)
    points = [POINT | {"e_log__": -1.0}, OTHER | {"e_log__": -1.6}]
    names = evaluator.hyperparameters.names
    thetas = np.array([[point[name] for name in names] for point in points])
    arrays = specimen_log_likelihoods(evaluator, thetas)[rv]
    expected = [ours(point) for point in points]
    np.testing.assert_allclose(arrays, expected, rtol=0, atol=1e-9)
    np.testing.assert_allclose(evaluator.log_other(thetas), arrays.sum(axis=1), rtol=1e-12)


def test_a_specimen_has_the_density_of_its_readings_in_both_simulators() -> None:
    assert_close(log_density(shared(), "b"), exact)
    assert values(shared(), "a").shape == (0,)


def test_two_simulators_equal_one_with_outputs_that_were_not_measured() -> None:
    y = Y.copy()
    y[B[-6:], 0], y[A[:6], 1] = np.nan, np.nan
    with pm.Model() as model:
        prb.Simulator(
            "y", lambda x: np.stack([up(x), down(x, 3.0)], axis=-1), population(), observed=y,
            metric=metric(error=[0.3, 0.2]),
        )  # fmt: skip
    assert [rv.name for rv in model.free_RVs] == ["mu", "sigma"]  # none of missing values
    assert np.allclose(values(shared(), "b"), values(fine(model), "y"), atol=1e-8)


def test_outputs_of_two_simulators_determine_two_inputs() -> None:
    rng = np.random.default_rng(2)
    x, z = rng.normal(1.0, 0.5, N), rng.normal(0.0, 1.0, N)
    with pm.Model() as model:
        inputs = [population(), pm.Normal.dist(0.0, 1.0)]
        prb.Simulator("sum", np.add, *inputs, observed=x + z, specimens=np.arange(N))
        order = rng.permutation(N)
        # Arguments and specimens in another order
        prb.Simulator(
            "difference", np.subtract, *inputs[::-1], observed=(z - x)[order], specimens=order
        )
    s = np.exp(-0.5)
    expected = stats.norm.logpdf(x, 0.8, s) + stats.norm.logpdf(z) - np.log(2)
    assert np.allclose(values(fine(model), "difference"), expected, atol=2 * TOLERANCE)


@pytest.mark.long
def test_specimens_of_one_simulator_may_have_fewer_readings_than_inputs() -> None:
    rng = np.random.default_rng(2)
    x, z = rng.normal(1.0, 0.5, N), rng.normal(0.0, 1.0, N)
    with pm.Model() as model:
        inputs = [population(), pm.Normal.dist(0.0, 1.0)]
        prb.Simulator("sum", np.add, *inputs, observed=(x + z)[A], specimens=A)
        prb.Simulator("difference", np.subtract, *inputs, observed=(x - z)[B], specimens=B)

    def expected(point: dict[str, Any]) -> Floats:
        mu, s = point["mu"], np.exp(point["sigma_log__"])
        both = stats.norm.logpdf(x, mu, s) + stats.norm.logpdf(z) - np.log(2)
        alone = [stats.norm.logpdf(y, mu, np.sqrt(s**2 + 1)) for y in (x + z, x - z)]
        return np.where(np.arange(N) < 6, alone[0], np.where(np.arange(N) < 14, both, alone[1]))

    ours = values(model, "difference")
    assert np.allclose(ours, expected(POINT), atol=0.15)
    change = values(model, "difference", OTHER) - ours
    # On fibres the sum over specimens has an error of .15 nats.
    assert change.sum() == pytest.approx((expected(OTHER) - expected(POINT)).sum(), abs=0.15)


def test_gross_errors_are_of_a_specimen_in_all_its_readings() -> None:
    with pm.Model() as model:
        x = population()
        a, b = metric(error=0.3, gross_errors=True), metric(error=0.2, gross_errors=True)
        prb.Simulator("a", up, x, observed=Y[A, 0], specimens=A, metric=a)
        prb.Simulator("b", down, x, 3.0, observed=Y[B, 1], specimens=B, metric=b)
    assert [rv.name for rv in model.free_RVs] == ["mu", "sigma", "a_gross_errors"]
    point = POINT | {"a_gross_errors_logodds__": np.log(0.1 / 0.9)}
    width = [2 * np.ptp(Y[own, j]) for j, own in enumerate((A, B))]
    log_gross = -1.0 * np.isin(np.arange(N), A) * np.log(width[0])
    log_gross -= np.isin(np.arange(N), B) * np.log(width[1])
    expected = np.logaddexp(np.log(0.9) + exact(POINT), np.log(0.1) + log_gross)
    assert np.allclose(values(fine(model), "b", point), expected, atol=TOLERANCE)


def test_groups_of_common_specimens() -> None:
    names = ["Adler", "Busch"]
    places = np.arange(N) % 2

    def labelled(j: int, own: Any) -> xr.DataArray:
        supplier = ("specimen", np.array(names)[places[own]])
        return xr.DataArray(Y[own, j], {"supplier": supplier}, "specimen")

    with pm.Model(coords={"supplier": names}) as model:
        mu = pm.Normal("mu", 0, 2, dims="supplier")
        x = pm.Normal.dist(mu[prb.response.group("supplier")], pm.HalfNormal("sigma", 1))
        a, b = metric(error=0.3), metric(error=0.2)
        prb.Simulator("a", up, x, observed=labelled(0, A), specimens=A, metric=a)
        prb.Simulator("b", down, x, 3.0, observed=labelled(1, B), specimens=B, metric=b)
    fine(model)
    ours = values(model, "b", {"mu": np.array([0.8, 1.1]), "sigma_log__": -0.5})
    each = [exact({"mu": mu, "sigma_log__": -0.5}) for mu in (0.8, 1.1)]
    assert np.allclose(ours, np.where(places == 0, *each), atol=TOLERANCE)


def test_a_simulator_may_connect_simulators_without_common_specimens() -> None:
    y = np.concatenate([Y[:10, 0], Y[10:, 0]])
    with pm.Model() as model:
        x = population()
        for name, own in (("a", np.arange(10)), ("b", np.arange(10, N))):
            prb.Simulator(name, up, x, observed=y[own], specimens=own, metric=metric(error=0.3))
        assert len(set(specimen_likelihoods(model).values())) == 2
        prb.Simulator(
            "c", down, x, 3.0, observed=Y[6:14, 1], specimens=np.arange(6, 14),
            metric=metric(error=0.2),
        )  # fmt: skip
    (likelihood,) = set(specimen_likelihoods(fine(model)).values())
    assert likelihood.name == "a and b and c"
    assert [values(model, rv).size for rv in "ab"] == [0, 0]
    covariance = np.outer([2, -1], [2, -1]) * np.exp(-1.0) + np.diag([0.09, 0.04])
    both = stats.multivariate_normal([2.6, 2.2], covariance).logpdf(Y)
    alone = stats.norm.logpdf(Y[:, 0], 2.6, np.sqrt(covariance[0, 0]))
    middle = (np.arange(N) >= 6) & (np.arange(N) < 14)
    assert np.allclose(values(model, "c"), np.where(middle, both, alone), atol=TOLERANCE)


@pytest.mark.long
def test_other_data_of_the_first_simulator_are_seen_by_the_last() -> None:
    model = fine(two_simulators())
    compiled = model.compile_fn(model.logp(), mode=PLAIN)
    assert np.isfinite(compiled(POINT))
    with model:
        pm.set_data({"data": Y[A, 0] + 0.5})
    with pytest.raises(Exception, match="got other observed values than when this was compiled"):
        compiled(POINT)
    other = Y + np.array([0.5, 0.0])
    assert np.allclose(values(model, "b"), exact(POINT, other), atol=TOLERANCE)


def test_repeated_readings_share_the_inputs_of_their_specimen() -> None:
    model = fine(repeated())
    assert_close(log_density(model, "y"), lambda point: exact_repeated(point, 0.3))
    (likelihood,) = specimen_likelihoods(model).values()
    drawn = draw_readings(
        likelihood, np.random.default_rng(0), dict.fromkeys(("mu", "sigma"), np.full(500, 1.0)),
        len(LABELS), likelihood.measurements[0],
    )  # fmt: skip
    rows = np.flatnonzero(LABELS == 0)
    between = np.cov(drawn[:, rows].T)[np.triu_indices(len(rows), 1)]
    # Variance 4 of the specimens' responses, .09 of the error; standard error .26
    assert np.allclose(between, 4.0, atol=1.1)
    assert np.var(drawn[:, rows] - drawn[:, rows[:1]]) < 0.3


@pytest.mark.long
def test_the_error_of_repeated_readings_may_be_estimated() -> None:
    model = fine(repeated(lambda: pm.HalfNormal("e", 0.5)), 128)
    ours = log_density(model, "y")
    assert_without_a_graph(model, "y", ours)
    for error in (0.2, 0.4):
        assert_close(
            lambda point, error=error: ours(point | {"e_log__": np.log(error)}),
            lambda point, error=error: exact_repeated(point, error),
        )


def test_a_specimen_with_repeated_readings_counts_once_in_a_held_out_loss() -> None:
    evaluator = Evaluator.of(repeated())
    thetas = evaluator.hyperparameters.thetas_of([np.array([0.8]), np.exp([-0.5])])
    (logs,) = specimen_log_likelihoods(evaluator, thetas)["y"]
    # Three readings of specimen 0, one of specimen 19
    held_out = np.isin(LABELS, [0, 19]).astype(float)[None]
    loss = _mean_log_losses(evaluator, thetas, [held_out])
    assert loss.item() == pytest.approx(-(logs[0] + logs[19]) / 2, rel=1e-12)


@pytest.mark.long
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_routes_from_the_fit_to_a_prediction() -> None:
    model = two_simulators()
    optimum = prb.minimize(model, starts=0, progressbar=False)
    assert optimum.converged
    at = {"mu": optimum.point["mu"], "sigma_log__": np.log(optimum.point["sigma"])}
    assert optimum.discrepancy == pytest.approx(-exact(at).sum(), abs=0.2)
    by_smc = prb.sample_smc(300, chains=2, model=model, random_seed=1, progressbar=False)
    assert by_smc.log_likelihood["b"].shape == (2, 300, N)
    loo = az.loo(by_smc, var_name="b")
    assert loo.n_data_points == N
    # One effective parameter or two, as of 20 specimens and not of all readings
    assert 0.5 < loo.p < 5
    posterior, sd = by_smc.posterior["mu"], optimum.stderr["mu"]
    assert float(posterior.mean()) == pytest.approx(optimum.point["mu"], abs=0.4 * sd)
    assert float(posterior.std()) == pytest.approx(sd, rel=0.3)
    assert by_smc.log_likelihood["b_specimen"].values.tolist() == list(range(N))
    diagnosis = prb.diagnose(by_smc, model=model)
    assert not diagnosis.findings
    assert len(diagnosis.messages) == len(diagnosis.findings)
    assert not diagnosis.untested
    (x,) = specimen_likelihoods(model)[model["b"]].inputs.aleatory
    for result in (optimum, by_smc):
        predicted = prb.predict(result, down, x, 3.0, model=model, progressbar=False)
        assert float(predicted.mean()) == pytest.approx(down(at["mu"], 3.0), abs=0.2)


@pytest.mark.long
def test_other_data_sets_are_of_specimens() -> None:
    optimum = prb.minimize(repeated(), starts=0, progressbar=False)
    sd = optimum.stderr["mu"]
    bootstrap = prb.bootstrap(optimum, draws=100, random_seed=1, progressbar=False)
    # Standard error of a standard deviation of 100 draws: 7 %
    assert float(bootstrap.posterior["mu"].std()) == pytest.approx(sd, rel=0.35)
    folds = prb.cross_validate(optimum, progressbar=False)
    assert folds.sizes["specimen"] == N
    assert np.isfinite(folds["discrepancy"]).all()
    diagnosis = str(prb.diagnose(optimum))
    assert "20 specimens" in diagnosis or "No problem" in diagnosis


@pytest.mark.parametrize(
    ("message", "of_b", "of_a"),
    [
        (
            "got other inputs than a.*the same .dist",
            {"x": lambda: pm.Normal.dist(pm.Normal("m"))},
            {},
        ),
        ("gross_errors: got 0.1, and False in a", {"metric": metric(gross_errors=0.1)}, {}),
        ("weights: got weights of a", {}, {"weights": [1.0, 2.0, 3.0]}),
        ("weights: got weights of b", {"weights": [1.0, 2.0, 3.0]}, {}),
        ("propagation: got Resimulated", {"propagation": prb.Resimulated(64)}, {}),
        ("got 'p', which a has too with AreaMetric", {}, {"metric": prb.AreaMetric()}),
    ],
)
def test_simulators_that_cannot_be_combined_are_refused(
    message: str, of_b: dict[str, Any], of_a: dict[str, Any]
) -> None:
    with pm.Model() as model:
        x = population()
        given = {"observed": [1.0, 2.0, 2.5], "specimens": ["p", "q", "r"]}
        prb.Simulator("a", up, x, **(given | of_a))
        arguments = [of_b.pop("x", lambda: x)()]
        with pytest.raises((ValueError, TypeError), match=message):
            prb.Simulator("b", up, *arguments, **(given | of_b))
    assert [rv.name for rv in model.observed_RVs] == ["a"]


def test_dimensions_of_rows_are_refused_where_specimens_have_several_readings() -> None:
    with pm.Model(coords={"row": np.arange(3)}):
        x = population()
        given: dict[str, Any] = {"observed": [1.0, 2.0, 2.5], "dims": "row"}
        with pytest.raises(ValueError, match=r"dims: got dimensions of y.*leave dims= out"):
            prb.Simulator("y", up, x, specimens=[1, 1, 2], metric=metric(error=0.1), **given)
        prb.Simulator("a", up, x, specimens=[1, 2, 3], **given)
        with pytest.raises(ValueError, match=r"dims: got dimensions of a.*leave dims= out"):
            prb.Simulator("b", up, x, specimens=[1, 2, 3], observed=[1.0, 2.0, 2.5])


@pytest.mark.parametrize(
    ("message", "labels", "given"),
    [
        ("got the label 'p' several times without error=.*error=", "pqp", {}),
        ("got the label 'p' several times with rounded", "pqp", {"error": 0.1, "rounded": 0.1}),
        (
            "got the label 'p' several times with rounded",
            "pqp",
            {"error": 0.1, "censored": (None, 1.2)},
        ),
        ("got 1 specimen, expected at least 2", "ppp", {"error": 0.1}),
    ],
)
def test_repeated_readings_that_cannot_be_averaged_are_refused(
    message: str, labels: str, given: dict[str, Any]
) -> None:
    with pm.Model(), pytest.raises(ValueError, match=message):
        prb.Simulator(
            "y", up, population(), observed=[1.0, 2.0, 1.2], specimens=list(labels),
            metric=metric(**given),
        )  # fmt: skip


def test_a_specimen_of_two_groups_is_refused() -> None:
    data = xr.DataArray([1.0, 2.0, 1.1], {"supplier": ("i", ["Adler", "Busch", "Busch"])}, "i")
    with pm.Model(coords={"supplier": ["Adler", "Busch"]}):
        mu = pm.Normal("mu", 0, 2, dims="supplier")
        x = pm.Normal.dist(mu[prb.response.group("supplier")], 1.0)
        with pytest.raises(ValueError, match="got the label 1 with two groups"):
            prb.Simulator("y", up, x, observed=data, specimens=[1, 2, 1], metric=metric(error=0.1))
