"""Unknown errors of several outputs: log-likelihoods beside closed forms, and what is reported."""

from typing import Any

import numpy as np
import pymc as pm
import pytest
from scipy.stats import halfnorm, multivariate_normal

import prbayes as prb
from prbayes.model import specimen_audit
from prbayes.model.specimen_likelihood import log_likelihoods, specimen_likelihoods
from prbayes.model.specimen_preparation import error_findings, factor_design, prepared

MEAN, SD = np.array([1.0, 2.0]), np.array([0.5, 0.8])


def linear_model(slopes: Any, priors: Any, sd: Any, n: int) -> tuple[Any, Any, pm.Model]:
    """Return the likelihood of a linear response, readings with an error of each output, the model."""
    slopes = np.array(slopes)
    d, rng = slopes.shape[1], np.random.default_rng(3)
    y = rng.normal(MEAN[:d], SD[:d], (n, d)) @ slopes.T
    y = y + np.array(sd) * rng.standard_normal(y.shape)
    with pm.Model() as model:
        mu = pm.Normal("mu", 0.0, 3.0, shape=d)
        sigma = pm.HalfNormal("sigma", 2.0, shape=d)
        metric = prb.LogLikelihood(error=pm.HalfNormal("error", np.array(priors), shape=len(sd)))
        inputs = [pm.Normal.dist(mu[k], sigma[k]) for k in range(d)]
        response = lambda *x: np.stack(x, axis=-1) @ slopes.T  # noqa: E731
        prb.Simulator("y", response, *inputs, observed=y, metric=metric)
    return next(iter(specimen_likelihoods(model).values())), y, model


@pytest.mark.long
@pytest.mark.parametrize(
    ("slopes", "priors", "sd"),
    [
        ([[1.0], [2.0]], [0.3, 0.6], [0.1, 0.3]),
        ([[1e-6], [1e3]], [1e-6, 1e3], [1e-7, 300.0]),
        ([[1.0, 0.5], [-500.0, 1000.0]], [1.0, 1e3], [0.1, 300.0]),
        ([[1.0], [2.0], [-1.0]], [0.3, 5.0, 1.0], [0.1, 0.3, 0.1]),
    ],
)
def test_a_linear_response_with_an_error_of_each_output(slopes: Any, priors: Any, sd: Any) -> None:
    """All combinations of errors that are not less likely by 30 nats count."""
    likelihood, y, _model = linear_model(slopes, priors, sd, 16)
    assert error_findings(likelihood) == []
    slopes, d = np.array(slopes), len(slopes[0])
    unit = np.array(sd)
    quantiles = halfnorm.ppf([[0.01], [0.1], [0.5], [0.9], [0.99]], scale=priors)
    errors = np.stack([g.ravel() for g in np.meshgrid(*quantiles.T, indexing="ij")], axis=-1)
    covariance = slopes * SD[:d] ** 2 @ slopes.T
    exact = []
    for e in errors:
        in_units = (covariance + np.diag(e**2)) / np.outer(unit, unit)
        density = multivariate_normal(slopes @ MEAN[:d] / unit, in_units)
        exact.append(density.logpdf(y / unit).sum() - 16 * np.log(unit).sum())
    values = {
        "mu": np.tile(MEAN[:d], (len(errors), 1)),
        "sigma": np.tile(SD[:d], (len(errors), 1)),
        "error": errors,
    }
    difference = log_likelihoods(likelihood, values).sum(axis=1) - exact
    # Halves may differ by a standard deviation of .04 nats; of 25 or 125 the largest is reported.
    is_likely = np.array(exact) > np.max(exact) - 30
    np.testing.assert_allclose(difference[is_likely], 0.0, atol=5 * 0.04)
    assert np.abs(difference[is_likely].mean()) < 0.05


@pytest.mark.parametrize(("count", "is_reported"), [(2, False), (4, True)])
def test_more_errors_than_have_all_combinations_are_reported(count: int, is_reported: bool) -> None:
    likelihood, _, _model = linear_model(
        np.ones((count, 1)), np.ones(count), np.full(count, 0.2), 12
    )
    codes = [finding.code for finding in error_findings(likelihood)]
    assert ("several-errors" in codes) == is_reported


@pytest.mark.parametrize(("count", "size"), [(1, 6), (2, 9), (3, 27), (12, 30)])
def test_designs_of_factors_have_each_error_alone_at_its_ends(count: int, size: int) -> None:
    rows = factor_design([(0.01, 2.0)] * count)
    assert rows.shape == (size, count)
    is_small = np.isclose(rows, 0.01)
    others = np.isclose(rows, 2.0).sum(axis=1)
    assert (is_small & (others == count - 1)[:, None]).any(axis=0).all()
    assert (np.diff(np.log(rows).sum(axis=1)) <= 1e-12).all()


@pytest.mark.long
def test_the_audit_takes_the_likely_error_of_a_vague_prior(monkeypatch: Any) -> None:
    """Inputs are open under the 84 % quantile of the prior, but not under the likely error."""
    likelihood, _, _model = linear_model([[1.0], [2.0]], [20.0, 40.0], [0.01, 0.02], 12)
    proposals, audited = prepared(likelihood).proposals, []
    assert proposals is not None
    assert proposals.is_open()

    def uncertainty(emulation: Any, z: Any) -> Any:
        audited.append(len(z))
        return np.zeros(len(z))

    monkeypatch.setattr(specimen_audit, "_uncertainty", uncertainty)
    thetas = prepared(likelihood).thetas
    assert specimen_audit.audited_likelihood(likelihood, thetas, is_last=True) is likelihood
    assert audited
