"""Sinh-arcsinh populations against closed forms, and their answers beside those of a nested family."""

from __future__ import annotations

import re
from functools import cache
from typing import Any

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest
import xarray as xr
from pymc.logprob.utils import ParameterValueError
from scipy import stats
from scipy.special import kv, ndtri

import prbayes as prb
from prbayes._finding import from_json
from prbayes._validate import Floats
from prbayes.decision.populations import Populations
from prbayes.posterior.nested import NestedFamily, nested_posterior

FAMILIES = [prb.families.SinhArcsinh, prb.families.LogSinhArcsinh]
# mu, s, skewness and tail: light and heavy tails, both sides
SHAPES = [(0.3, 0.8, 0.4, 0.7), (-1.0, 2.0, -0.5, 1.4), (0.0, 1.0, 0.0, 1.0)]
LEVELS = np.array([1e-6, 0.01, 0.3, 0.5, 0.9, 0.999])


def made(family: Any, mu: Any, s: Any, skew: Any, tail: Any, **settings: Any) -> Any:
    """Return a distribution with parameters that are numbers."""
    with pm.Model():
        return family.dist(mu, s, name="x", skew=skew, tail=tail, **settings)


def exact_quantiles(mu: float, s: float, skew: float, tail: float) -> Floats:
    return mu + s * tail * np.sinh((np.arcsinh(ndtri(LEVELS)) + skew) / tail)


def exact_moments(mu: float, s: float, skew: float, tail: float) -> tuple[float, float]:
    """Return mean and standard deviation by Bessel functions (Jones and Pewsey 2009, section 2.3)."""

    def p(q: float) -> float:
        bessel = kv((q + 1) / 2, 0.25) + kv((q - 1) / 2, 0.25)
        return float(np.exp(0.25) / np.sqrt(8 * np.pi) * bessel)

    first = np.sinh(skew / tail) * p(1 / tail)
    second = (np.cosh(2 * skew / tail) * p(2 / tail) - 1) / 2
    return mu + s * tail * first, s * tail * np.sqrt(second - first**2)


# -- the distribution --------------------------------------------------------------------------


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("family", FAMILIES)
def test_quantiles_and_distribution_function_are_exact(family: Any, shape: Any) -> None:
    x = made(family, *shape)
    quantiles = exact_quantiles(*shape)
    if family is prb.families.LogSinhArcsinh:
        quantiles = np.exp(quantiles)
    np.testing.assert_allclose(pm.icdf(x, LEVELS).eval(), quantiles, rtol=1e-9)
    np.testing.assert_allclose(np.exp(pm.logcdf(x, quantiles).eval()), LEVELS, rtol=1e-7)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("family", FAMILIES)
def test_the_density_is_the_derivative_of_the_distribution_function(
    family: Any, shape: Any
) -> None:
    x = made(family, *shape)
    at = pm.icdf(x, LEVELS[1:]).eval()
    step = 1e-5 * np.maximum(np.abs(at), 0.01)
    higher, lower = (np.exp(pm.logcdf(x, at + sign * step).eval()) for sign in (1, -1))
    density = np.exp(pm.logp(x, at).eval())
    np.testing.assert_allclose(density, (higher - lower) / (2 * step), rtol=1e-5)


@pytest.mark.parametrize(
    ("family", "usual"),
    [(prb.families.SinhArcsinh, stats.norm(1, 2)), (FAMILIES[1], stats.lognorm(2, scale=np.e))],
)
def test_the_family_contains_the_usual_one(family: Any, usual: Any) -> None:
    at = usual.ppf(LEVELS)
    density = pm.logp(made(family, 1.0, 2.0, 0.0, 1.0), at).eval()
    np.testing.assert_allclose(density, usual.logpdf(at), rtol=1e-9)


@pytest.mark.parametrize("family", FAMILIES)
def test_the_density_far_away_is_zero_and_not_nan(family: Any) -> None:
    x = made(family, 0.0, 1.0, 0.4, 1.3)
    logs = pm.logp(x, np.array([1e300, 1e200, 1e100, -1e300])).eval()
    assert not np.isnan(logs).any()
    assert (logs < -1000).all()


def test_a_positive_input_has_no_density_below_zero() -> None:
    x = made(prb.families.LogSinhArcsinh, 0.0, 1.0, 0.4, 1.3)
    assert np.isneginf(pm.logp(x, np.array([-1.0, 0.0])).eval()).all()
    assert np.isneginf(pm.logcdf(x, np.array([-1.0])).eval()).all()


@pytest.mark.parametrize("family", FAMILIES)
def test_invalid_parameters_are_refused(family: Any) -> None:
    for shape in ((0.0, -1.0, 0.0, 1.0), (0.0, 1.0, 0.0, 0.0)):
        with pytest.raises(ParameterValueError, match="s > 0, tail > 0"):
            pm.logp(made(family, *shape), 0.5).eval()


@pytest.mark.parametrize("family", FAMILIES)
def test_draws_have_the_distribution(family: Any) -> None:
    x = made(family, *SHAPES[0])
    rng = np.random.default_rng(1)
    draws = x.owner.op.rng_fn(rng, *SHAPES[0], (4000,))
    u = np.exp(pm.logcdf(x, draws).eval())
    assert stats.kstest(u, "uniform").pvalue > 1e-4


def test_shapes_are_those_of_the_parameters_or_as_asked() -> None:
    vector = made(FAMILIES[0], np.zeros(3), 1.0, 0.1, 0.9)
    assert vector.type.shape == (3,)
    assert made(FAMILIES[0], 0.0, 1.0, 0.1, 0.9, shape=(2, 3)).type.shape == (2, 3)
    op = vector.owner.op
    assert op.rng_fn(np.random.default_rng(0), np.zeros(3), 1.0, 0.1, 0.9, None).shape == (3,)
    center = pm.distributions.distribution.support_point(vector).eval()
    np.testing.assert_allclose(center, np.full(3, 0.9 * np.sinh(0.1 / 0.9)))


def test_gradients_are_finite() -> None:
    parameters = pt.dvector("parameters")
    x = made(FAMILIES[0], *[parameters[k] for k in range(4)])
    gradient = pt.grad(pm.logp(x, np.array([-4.0, 0.0, 9.0])).sum(), parameters)
    assert np.isfinite(gradient.eval({parameters: np.array(SHAPES[0])})).all()


# -- the call ----------------------------------------------------------------------------------


def test_shape_variables_are_added_with_their_priors() -> None:
    with pm.Model() as model:
        x = prb.families.SinhArcsinh.dist(0.0, 1.0, name="x")
    assert x.name == "x"
    skew, tail = model.free_RVs
    assert [skew.name, tail.name] == ["x_skew", "x_tail"]
    expected = stats.norm(0, 0.35).logpdf(0.2), stats.lognorm(0.25).logpdf(0.8)
    np.testing.assert_allclose(pm.logp(skew, 0.2).eval(), expected[0])
    np.testing.assert_allclose(pm.logp(tail, 0.8).eval(), expected[1])


def test_bad_arguments_are_refused() -> None:
    dist = prb.families.SinhArcsinh.dist
    with pytest.raises(TypeError, match="SinhArcsinh: got no model on the context"):
        dist(0.0, 1.0, name="x")
    with pm.Model():
        with pytest.raises(TypeError, match="LogSinhArcsinh: name: got"):
            prb.families.LogSinhArcsinh.dist(0.0, 1.0, name=3)  # type: ignore[arg-type]
        with pytest.raises(ValueError, match="name: got ' '"):
            dist(0.0, 1.0, name=" ")
        dist(0.0, 1.0, name="x")
        with pytest.raises(ValueError, match="x_skew"):
            dist(0.0, 1.0, name="x")


# -- a model -----------------------------------------------------------------------------------


def fold(x: Any) -> Any:
    return np.exp(x / 4)


def skewed_model(n: int, metric: Any = None) -> tuple[pm.Model, Any]:
    """Return a model of n specimens of a gamma population, and its input."""
    x = stats.gamma(4, -2, 0.5).rvs(n, random_state=np.random.default_rng(0))
    with pm.Model() as model:
        mu, s = pm.Normal("mu", 0, 2), pm.HalfNormal("s", 2)
        strength = prb.families.SinhArcsinh.dist(mu, s, name="x")
        prb.Simulator("y", fold, strength, observed=fold(x), metric=metric)
    return model, strength


@cache
def problem() -> tuple[pm.Model, Any, xr.DataTree]:
    """Return a model whose families the data do not separate, its input, and its posterior."""
    model, x = skewed_model(20)
    return model, x, prb.sample(1000, chains=2, model=model, random_seed=1, progressbar=False)


@cache
def with_few_draws() -> tuple[pm.Model, Any, xr.DataTree]:
    """Return the same with a fifth of the draws, since the cost of decisions is that of draws."""
    model, x, result = problem()
    return model, x, result.isel(draw=slice(None, None, 5))


@cache
def normal_posterior() -> xr.DataTree:
    """Return the posterior of the normal family, calibrated by itself."""
    x = stats.gamma(4, -2, 0.5).rvs(20, random_state=np.random.default_rng(0))
    with pm.Model() as model:
        strength = pm.Normal.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("s", 2))
        prb.Simulator("y", fold, strength, observed=fold(x))
    return prb.sample(1000, chains=2, model=model, random_seed=1, progressbar=False)


def codes(table: Any) -> list[str]:
    return [finding.code for finding in from_json(table.attrs["findings"])]


@pytest.mark.long
def test_the_nested_family_is_that_of_a_model_of_its_own() -> None:
    model, _, result = problem()
    populations = Populations.of(result, model, 2000, "test")
    family = NestedFamily.of(populations.evaluator)
    assert family is not None
    assert family.fixed == {"x_skew": 0.0, "x_tail": 1.0}
    runs = populations.evaluator.n_responses
    nested = nested_posterior(populations.evaluator, family, populations.thetas)
    assert nested is not None
    assert populations.evaluator.n_responses == runs
    values = populations.evaluator.hyperparameters.constrained(nested.thetas)
    assert (values["x_skew"] == 0).all()
    np.testing.assert_allclose(values["x_tail"], 1)
    alone = normal_posterior()["posterior"].to_dataset()
    for name in ("mu", "s"):
        expected = alone[name].values.ravel()
        error = expected.std() / np.sqrt(2000)
        # Two independent sets of draws, and five standard errors of their difference
        assert abs(values[name].mean() - expected.mean()) < 5 * np.sqrt(2) * error
        assert values[name].std() == pytest.approx(expected.std(), rel=0.12)
    whole, simple = (
        tree["posterior"].attrs["log_marginal_likelihood"] for tree in (result, normal_posterior())
    )
    expected = 1 / (1 + np.exp(whole - simple))
    assert nested.probability == pytest.approx(expected, abs=0.03)


@pytest.mark.long
def test_the_table_has_both_families_and_the_moments_of_the_population() -> None:
    model, _, result = with_few_draws()
    table = prb.population(result, model=model, quantiles=(0.01, 0.99))
    assert table.name.values.tolist() == ["x", "x (normal)"]
    assert codes(table) == ["two-families"]
    text = repr(table)
    assert "x (normal): mean" in text
    a_basis = table.estimate.sel(quantity="A-basis").values
    assert f"the A-basis value of x is {a_basis[0]:.4g}, or {a_basis[1]:.4g} under" in text
    draws = result["posterior"].to_dataset()
    rows = zip(*(draws[v].values.ravel() for v in ("mu", "s", "x_skew", "x_tail")), strict=True)
    moments = np.array([exact_moments(*row) for row in rows]).mean(axis=0)
    reported = table.estimate.sel(name="x", quantity=["mean", "sd"]).values
    np.testing.assert_allclose(reported, moments, rtol=1e-3, atol=1e-4)
    alone = prb.population(result, "x", model=model, quantiles=(0.01,))
    xr.testing.assert_allclose(alone.sel(quantity="mean"), table.sel(quantity="mean"))


@pytest.mark.long
def test_the_probability_has_both_families() -> None:
    model, x, result = with_few_draws()
    for settings in ({}, {"n_points": 500}):
        table = prb.exceedance(
            result, fold, 1.6, x, model=model, requirement=0.2, n_draws=400, **settings
        )
        assert codes(table)[0] == "two-families"
        text = repr(table)
        assert "under the normal family" in text
        assert text.count("requirement met") == 2
        assert f"it is {float(table.probability):.2g} (89% interval" in text
        assert table.attrs["responses"] == 2 * settings.get("n_points", 0)


@pytest.mark.long
def test_quantities_have_both_families() -> None:
    model, x, result = with_few_draws()
    quantile = prb.decision.Quantile(np.positive, x, probability=0.99)
    candidates = {"more": prb.decision.Condition(fold, x)}
    tables = [
        prb.decision.p_box(result, np.positive, x, model=model),
        prb.decision.evaluate(result, quantile, model=model),
        prb.sensitivity(result, quantile, model=model, n_points=64),
        prb.plan(result, candidates, model=model, quantity=quantile, k=5),
    ]
    draws = normal_posterior()["posterior"]
    mu, s = (draws[name].values.ravel() for name in ("mu", "s"))
    scatter = np.random.default_rng(0).normal(size=(200, mu.size))
    of_new_specimens = float(np.quantile(mu + s * scatter, 0.99))
    mean_quantile = float((mu + ndtri(0.99) * s).mean())
    expected = [of_new_specimens, *[mean_quantile] * 3]
    for table, value in zip(tables, expected, strict=True):
        (finding,) = (f for f in from_json(table.attrs["findings"]) if f.code == "two-families")
        _, _, simpler = finding.text.partition(", or ")
        assert simpler.endswith("under the normal family.")
        number = re.findall(r"-?\d+\.\d+", simpler.partition("(")[0])[-1]
        assert float(number) == pytest.approx(value, rel=0.03)
    assert f"the quantity is {float(tables[1].estimate):.4g} (89% interval" in str(tables[1])


@pytest.mark.long
def test_the_report_has_both_families() -> None:
    model, _, result = with_few_draws()
    report = prb.Report("Strength", model=model, posterior=result, pictures=False)
    (section,) = [s for s in report.sections if s.title == "Population of the inputs"]
    assert "x (normal)" in section.table.columns
    assert "do not separate the sinh-arcsinh population of x from a normal one" in section.text[1]


@pytest.mark.long
def test_families_that_the_data_separate_have_one_answer() -> None:
    model, _ = skewed_model(150)
    result = prb.sample(500, chains=1, model=model, random_seed=1, progressbar=False)
    table = prb.population(result, model=model)
    assert table.name.values.tolist() == ["x"]
    assert codes(table) == []


@pytest.mark.long
def test_why_families_were_not_compared() -> None:
    model, _, _ = problem()
    table = prb.population(prb.minimize(model), model=model)
    assert codes(table) == ["family-not-compared"]
    assert "an optimum has no posterior" in repr(table)
    data = {"A": fold(np.linspace(-1, 1, 12)), "B": fold(np.linspace(-1, 2, 12))}
    fleet = prb.calibrate_each(data, model=model, draws=100, progressbar=False)
    assert "data of this product" in repr(prb.population(fleet.sel(product="B"), model=model))
    by_metric, _ = skewed_model(20, prb.ProbabilityResidual())
    result = prb.sample(100, chains=1, model=by_metric, random_seed=1, progressbar=False)
    assert "in place of the metric of y" in repr(prb.population(result, model=by_metric))


@pytest.mark.long
def test_the_other_inputs_of_a_model_have_one_row() -> None:
    rng = np.random.default_rng(2)
    strength, stiffness = rng.normal(size=25), np.exp(0.3 * rng.normal(size=25))
    with pm.Model() as model:
        x = prb.families.SinhArcsinh.dist(
            pm.Normal("mu", 0, 2), pm.HalfNormal("s", 2), name="x", tail=1.0
        )
        z = pm.LogNormal.dist(pm.Normal("m", 0, 1), pm.HalfNormal("t", 1))
        prb.Simulator(
            "y", lambda x, z: np.stack([x, z], axis=-1), x, z,
            observed=np.stack([strength, stiffness], axis=-1),
        )  # fmt: skip
    result = prb.sample(200, chains=1, model=model, random_seed=1, progressbar=False)
    # The tail is a number and no variable, so that the family does not become normal.
    assert prb.population(result, model=model).name.values.tolist() == ["x", "z"]
    with pm.Model() as model:
        x = prb.families.SinhArcsinh.dist(pm.Normal("mu", 0, 2), pm.HalfNormal("s", 2), name="x")
        z = pm.LogNormal.dist(pm.Normal("m", 0, 1), pm.HalfNormal("t", 1))
        prb.Simulator(
            "y", lambda x, z: np.stack([x, z], axis=-1), x, z,
            observed=np.stack([strength, stiffness], axis=-1),
        )  # fmt: skip
    result = prb.sample(500, chains=1, model=model, random_seed=1, progressbar=False)
    assert prb.population(result, model=model).name.values.tolist() == ["x", "z", "x (normal)"]


@pytest.mark.slow
def test_intervals_of_far_quantiles_contain_them() -> None:
    """A smaller version of `benchmarks/tails.py`: 40 data sets, five standard errors of .75."""
    from benchmarks import tails

    row = tails.row("gamma/20/y = x", 0)
    least = tails.PRODUCTS * 0.75 - 5 * np.sqrt(tails.PRODUCTS * 0.75 * 0.25)
    assert min(row["sinh-arcsinh"]["hits"]) >= least
    assert row["normal"]["hits"][0] < least
