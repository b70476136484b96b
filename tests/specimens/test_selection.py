"""Specimens that are seen within limits only: probabilities, log-likelihoods, draws, refusals."""

from __future__ import annotations

from typing import Any

import numpy as np
import pymc as pm
import pytest
from one_input import one_input
from scipy import stats
from scipy.special import logsumexp

import prbayes as prb
from benchmarks import selection as study
from prbayes.model.evaluator import Evaluator
from prbayes.model.measurement import selection_of
from prbayes.model.specimen_likelihood import draw_readings, measurements_of
from prbayes.model.specimen_preparation import prepared
from prbayes.response.compile import PLAIN
from prbayes.specimens.selection import Selection


def test_probabilities_of_being_seen() -> None:
    limits = Selection(
        np.array([1.0, -np.inf]),
        np.array([np.inf, 3.0]),
        np.array([0.5, 0.0]),
        np.array([0.1, 0.0]),
        np.array([0.2, 0.0]),
    )
    outputs = np.array([[0.6, 2.0], [2.0, 2.9], [-4.0, 2.0], [2.0, 3.1]])
    found = np.exp(limits.log_probability(outputs, np.array([0.0, 0.1])))
    sd = np.hypot(0.5, 0.1 * outputs[:, 0])
    first = stats.norm.sf(1.0, outputs[:, 0] + 0.2, sd)
    np.testing.assert_allclose(found, first * stats.norm.cdf(3.0, outputs[:, 1], 0.1), rtol=1e-9)
    exact = np.exp(limits.log_probability(outputs, np.zeros(2)))
    np.testing.assert_allclose(exact, first * (outputs[:, 1] < 3.0), rtol=1e-9)
    assert limits.is_seen(np.array([[1.5, 2.0], [0.9, 2.0], [1.5, 3.5]])).tolist() == [1, 0, 0]
    assert limits.is_seen(np.array([[np.nan, 2.0]])).all()


@pytest.mark.long
def test_the_probability_of_being_seen_is_that_of_the_last_emulator() -> None:
    """A response that oscillates, so that populations far wider than the specimens are likely."""
    rng = np.random.default_rng(44)
    y = np.cos(rng.normal(0.6, 0.5, 60)) + rng.normal(0, 0.1, 60)
    y = y[(y > 0.5) & (y < 0.95)]
    with pm.Model() as model:
        x = pm.Normal.dist(pm.HalfNormal("mu", 1.0), pm.HalfNormal("sigma", 1.0))
        metric = prb.LogLikelihood(error=0.1, selected=(0.5, 0.95))
        prb.Simulator("y", np.cos, x, observed=y, metric=metric)
    evaluator = Evaluator.of(model)
    mu, sigma = (a.ravel() for a in np.meshgrid([0.3, 1.0, 2.0], [0.5, 1.0, 2.0, 3.0]))
    x = np.linspace(-25.0, 25.0, 5001)
    reading = stats.norm(np.cos(x)[:, None], 0.1)
    masses = stats.norm(mu[:, None], sigma[:, None]).pdf(x) * (x[1] - x[0])
    seen = masses @ (reading.sf(0.5) - reading.sf(0.95))
    # The share is that of points around specimens whose response is within the limits.
    evaluator(np.column_stack([np.log(mu), np.log(sigma)]))
    (likelihood,) = evaluator.likelihoods
    share, coordinates = prepared(likelihood).share, likelihood.coordinates
    assert share is not None
    (inputs,) = coordinates.inputs(share.z)
    logs = stats.norm(mu[:, None], sigma[:, None]).logpdf(inputs.ravel())
    logs += coordinates.log_jacobian(share.z) + share.log_b
    found = logsumexp(logs[:, : share.with_response], axis=1) - logsumexp(logs, axis=1)
    # Wide populations were up to 16 nats off. That of N(2, .5), of which few are seen, has a Monte
    # Carlo error of .7 to .9 nats.
    assert len(y) * np.abs(found - np.log(seen).ravel()).max() < 1.5


@pytest.mark.long
@pytest.mark.parametrize("error", [0.0, 0.9])
def test_log_likelihoods_of_a_selection_are_exact(error: float) -> None:
    case = study.case_of(0.6, error, 0)
    with pm.Model() as model:
        variables = {p.name: p.variable() for p in case.priors}
        metric: Any = case.metric(variables)
        x = case.population(variables)
        y = prb.Simulator("y", np.exp, x, metric=metric, observed=case.observed)
    evaluator = Evaluator.of(model)
    grid = np.linspace(-0.5, 1.5, 9), np.linspace(0.3, 1.2, 9)
    mu, sigma = (a.ravel() for a in np.meshgrid(*grid))
    values = {"mu": mu[:, None, None], "sigma": sigma[:, None, None]}
    theta = np.column_stack([mu, np.log(sigma)])
    exact = case.log_likelihood(values).sum(axis=1)
    difference = evaluator(theta).log_other - exact
    # The density of exact readings is that of the response, of which the reference has the input.
    difference += 0.0 if error else np.log(case.observed).sum()
    weights = np.exp(exact - exact.max())
    assert np.sqrt(np.average(difference**2, weights=weights)) < 0.05
    logp = model.compile_logp(vars=[y], mode=PLAIN)
    at = {"mu": mu[40], "sigma_log__": np.log(sigma[40])}
    assert float(logp(at)) == pytest.approx(evaluator(theta[40:41]).log_other[0], rel=1e-9)
    drawn = pm.draw(pm.do(model, {"mu": 0.7, "sigma": 0.6})["y"], 50, random_seed=0, mode=PLAIN)
    assert metric.selected is not None
    limit = metric.selected[0]
    assert drawn.min() >= limit
    # Of the second population nothing is seen, unless by an error of its reading.
    populations = {"mu": np.array([0.7, -30.0]), "sigma": np.array([0.6, 0.1])}
    (likelihood,) = evaluator.likelihoods
    drawn = draw_readings(likelihood, np.random.default_rng(0), populations, 5)
    assert drawn[0].min() >= limit
    is_seen = ~np.isnan(drawn[1])
    assert (drawn[1][is_seen] >= limit).all()
    assert error or not is_seen.any()


@pytest.mark.long
def test_selected_specimens_have_no_conditional_residuals() -> None:
    metric = prb.LogLikelihood(selected=(1.0, None))
    y = np.array([1.2, 1.5, 1.9, 2.6, 1.1, 3.4])
    model = one_input(y, metric, response=np.exp, mu=(0, 1))
    residuals = prb.residuals(prb.minimize(model, progressbar=False))
    assert np.isnan(residuals["y"]["CWRES"]).all()
    assert residuals["y"]["eta"].notnull().all()
    assert "y has no CWRES, as its specimens are selected." in str(residuals)
    figure = prb.plots.plot_residuals(residuals)
    assert [axis.get_label() for axis in figure.axes] == ["y"]


def simulator(observed: Any = (1.0, 2.0, 3.0), **options: Any) -> None:
    with pm.Model():
        x = pm.Normal.dist(pm.Normal("mu", 0, 1), pm.HalfNormal("sigma", 1))
        error = options.pop("error", None)
        error = pm.HalfNormal("error", 1) if error == "unknown" else error
        metric = prb.LogLikelihood(error=error, **options)
        prb.Simulator("y", np.exp, x, observed=np.array(observed), metric=metric)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"selected": (None, None)}, "expected \\(lower, upper\\)"),
        ({"selected": 1.0}, "expected \\(lower, upper\\)"),
        ({"selected": (1.5, None)}, "^y: metric: selected: got the reading 1 of specimen 0"),
        ({"selected": (None, 2.5)}, "got the reading 3 of specimen 2"),
        ({"selected": ([0.0, 0.0], None)}, "got limits of shape"),
        ({"selected": (0.5, None), "error": [0.1, 0.2, 0.3]}, "the same for all"),
        ({"selected": (0.5, None), "error": "unknown"}, "pass numbers"),
        ({"selected": (0.5, None), "gross_errors": True}, "pass numbers"),
        ({"selected": (0.5, None), "error": prb.readings.Poisson()}, "leave selected= out"),
        ({"selected": (0.5, None), "density": prb.GaussianKDE()}, "leave density= out"),
    ],
)
def test_refused_selections(options: dict[str, Any], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        simulator(**options)


def test_an_output_without_a_limit() -> None:
    """None beside the limit of another output is no limit."""
    y = np.array([[1.0, 2.0], [2.0, np.nan], [3.0, 4.0]])
    metric = prb.LogLikelihood(error=0.1, selected=([0.5, None], [None, 5.0]))
    model = one_input(y, metric, response=lambda x: np.stack([x, 2 * x], axis=-1), mu=(2, 1))
    selection = selection_of(list(measurements_of(model).values()))
    assert selection is not None
    np.testing.assert_array_equal([selection.low, selection.high], [[0.5, -np.inf], [np.inf, 5.0]])


def test_a_model_without_limits_has_no_selection() -> None:
    assert selection_of([]) is None


@pytest.mark.slow
def test_posteriors_of_a_selection_are_exact() -> None:
    row = study.row("0.6/0.9/selected", 1)
    assert np.abs(row["offset"]).max() < 0.1
    assert 0.9 < min(row["width"]) <= max(row["width"]) < 1.1
