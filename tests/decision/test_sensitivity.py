"""Sobol' indices of hyperparameters and inputs beside closed forms and SALib, and the copula."""

from functools import cache
from typing import Any

import numpy as np
import pymc as pm
import pytest
import xarray as xr
from decisions import doubled, normal, optimum, posterior, same
from one_input import posterior_of

import prbayes as prb
from prbayes._validate import Floats
from prbayes.decision import sensitivity as module
from prbayes.decision.populations import Populations
from prbayes.decision.sensitivity import (
    Copula,
    SensitivityIndices,
    derivative_bound,
    first_order,
    input_indices,
    total_order,
)


def test_a_quantile_of_a_normal_population() -> None:
    model, x = normal()
    quantity = prb.decision.Quantile(doubled, x, probability=0.95)
    table = prb.sensitivity(posterior(), quantity, model=model)
    # 2 (mu + 1.645 sigma), of two that are nearly independent.
    mu, sigma = (posterior().posterior[name].values.std() for name in ("mu", "sigma"))
    variances = np.array([mu**2, (1.6449 * sigma) ** 2])
    expected = variances / variances.sum()
    own = table.sel(factor=["mu", "sigma"])
    np.testing.assert_allclose(own["first"], expected, atol=0.03)
    np.testing.assert_allclose(own["total"], expected, atol=0.03)
    assert (own.derivative > own.total - 0.02).all()
    np.testing.assert_allclose(own.derivative, expected, atol=0.06)
    x_only = table.sel(factor="x")
    assert [float(x_only[key]) for key in ("first", "total")] == pytest.approx([1, 1], abs=0.02)
    assert max(float(x_only.first_error), float(x_only.total_error)) < 0.05
    assert table.attrs["sd"] == pytest.approx(2 * np.hypot(mu, 1.6449 * sigma), rel=0.04)
    assert table.kind.values.tolist() == ["hyperparameter", "hyperparameter", "input"]


def correlated(rho: float, draws: int = 4000, seed: int = 0) -> xr.DataTree:
    z = np.random.default_rng(seed).multivariate_normal([0, 0], [[1, rho], [rho, 1]], (1, draws))
    return posterior_of(mu=1 + 0.05 * z[..., 0], sigma=0.5 * np.exp(0.05 * z[..., 1]))


@pytest.mark.long
def test_errors_contain_the_noise_of_points_and_of_draws() -> None:
    model, x = normal()
    quantile = prb.decision.Quantile(same, x, probability=0.9)
    mean = prb.decision.Mean(same, x)
    variances = np.array([0.05, 1.2816 * 0.5 * 0.05]) ** 2
    expected = variances / variances.sum()
    scores = []
    for seed in range(2):
        draws = correlated(0.0, seed=seed)
        table = prb.sensitivity(draws, quantile, model=model, n_points=2048, random_seed=seed)
        table = table.sel(factor=["mu", "sigma"])
        scores += list((table["first"] - expected) / table.first_error)
        # All noise of the points is removed, and the squared correlation of 500 draws stays.
        none = prb.sensitivity(draws, mean, model=model, random_seed=seed).sel(factor="sigma")
        assert abs(float(none["first"])) < 5 * float(none.first_error) < 0.05
    # Errors of eight blocks have a t distribution, with a root mean square of 1.2.
    assert np.sqrt(np.mean(np.square(scores))) < 2.5


def test_hyperparameters_that_depend_on_each_other() -> None:
    model, x = normal()
    quantity = prb.decision.Quantile(same, x, probability=0.9)
    rho = 0.7
    table = prb.sensitivity(correlated(rho), quantity, model=model).sel(factor=["mu", "sigma"])
    # To first order Q = a_1 z_1 + a_2 z_2, of which the closed form is known.
    a = np.array([0.05, 1.2816 * 0.5 * 0.05])
    variance = (a**2).sum() + 2 * rho * a.prod()
    np.testing.assert_allclose(table["first"], (a + rho * a[::-1]) ** 2 / variance, atol=0.03)
    np.testing.assert_allclose(table["total"], a**2 * (1 - rho**2) / variance, atol=0.03)
    np.testing.assert_allclose(table.derivative, table["total"], atol=0.02)


def test_an_optimum_in_two_units() -> None:
    _, x = normal()
    one, two = (prb.sensitivity(optimum(), prb.decision.Mean(f, x)) for f in (same, doubled))
    assert two.attrs["value"] == pytest.approx(2 * one.attrs["value"])
    np.testing.assert_allclose(one["first"], two["first"], atol=1e-6)
    assert float(one["first"].sel(factor="mu")) == pytest.approx(1, abs=0.01)
    # The bound of the total by derivatives is reached by a linear response.
    np.testing.assert_allclose(one.derivative.sel(factor=["mu", "x"]), 1, atol=0.02)
    assert one.attrs["responses"] == 0
    # A new specimen's variance is s^2 (1 + 1 / N).
    assert one.attrs["scatter"] == pytest.approx(50 / 51, abs=0.005)


def test_errors_fall_with_the_samples_and_seeds_matter() -> None:
    model, x = normal()
    quantity = prb.decision.Exceedance(same, x, limit=2.0)
    few, again, many = [
        prb.sensitivity(posterior(), quantity, model=model, n_points=n, random_seed=seed)
        for n, seed in ((64, 1), (64, 1), (512, 2))
    ]
    xr.testing.assert_identical(few, again)
    assert float(many.first_error.sel(factor="mu")) < float(few.first_error.sel(factor="mu"))
    factors = {"factor": ["mu", "sigma"]}
    for key in ("first", "total"):
        off = np.abs(few[key] - many[key]).sel(factors)
        assert (off < 5 * few[f"{key}_error"].sel(factors) + 0.01).all()
    # Whether a specimen is beyond has no derivative.
    assert np.isnan(float(many.derivative.sel(factor="x")))


# -- estimators ----------------------------------------------------------------------------------

# Sobol' indices of Ishigami's function with 7 and 0.1 (Ishigami and Homma 1990).
VARIANCE = 49 / 8 + 0.1 * np.pi**4 / 5 + 0.01 * np.pi**8 / 18 + 0.5
FIRST = np.array([0.5 * (1 + 0.1 * np.pi**4 / 5) ** 2, 49 / 8, 0.0]) / VARIANCE
BOTH = 0.01 * np.pi**8 * (1 / 18 - 1 / 50) / VARIANCE
TOTAL = FIRST + BOTH * np.array([1, 0, 1])
R, SIZE = 16, 4096


def ishigami(x: Floats) -> Any:
    a, b, c = np.moveaxis(x, -1, 0)
    return np.sin(a) + 7 * np.sin(b) ** 2 + 0.1 * c**4 * np.sin(a)


def matched(seed: int = 0) -> tuple[Floats, list[Floats], list[Floats]]:
    """Return points, and for each factor points that share it, and points that share all others."""
    here, elsewhere = np.random.default_rng(seed).uniform(-np.pi, np.pi, (2, R, SIZE, 3))
    same, other = [], []
    for i in range(3):
        pick = np.arange(3) == i
        same.append(np.where(pick, here, elsewhere))
        other.append(np.where(pick, elsewhere, here))
    return here, same, other


@pytest.fixture(scope="module")
def indices() -> SensitivityIndices:
    here, same, other = matched()
    y = ishigami(here)
    rows = [
        [first_order(y, ishigami(a)), total_order(y, ishigami(b)), np.zeros(R)]
        for a, b in zip(same, other, strict=True)
    ]
    return SensitivityIndices.of_replicates(np.array(rows))


def test_ishigami_beside_closed_forms_and_salib(indices: SensitivityIndices) -> None:
    off = np.abs(indices.values[:2] - [FIRST, TOTAL])
    assert (off < 5 * indices.errors[:2]).all()
    assert (indices.errors < 0.01).all()
    sobol = pytest.importorskip("SALib.analyze.sobol")
    from SALib.sample import sobol as design

    problem = {"num_vars": 3, "names": ["a", "b", "c"], "bounds": [[-np.pi, np.pi]] * 3}
    x = design.sample(problem, 4096, calc_second_order=False, seed=1)
    theirs = sobol.analyze(problem, ishigami(x), calc_second_order=False, seed=1)
    for row, key in enumerate(("S1", "ST")):
        # Their intervals are 95% ones.
        both = np.hypot(indices.errors[row], np.array(theirs[f"{key}_conf"]) / 1.96)
        assert (np.abs(indices.values[row] - theirs[key]) < 5 * both).all()
    # On the same points; they divide by the variance of the first set alone.
    here, _, other = matched(1)
    base, mixed = ishigami(here[0]), ishigami(other[0][0])
    ours = total_order(base[None], mixed[None])
    np.testing.assert_allclose(ours, sobol.total_order(base, mixed, base), rtol=0.1)


def test_a_linear_function_has_shares_that_sum_to_one_and_equal_bounds() -> None:
    rng = np.random.default_rng(2)
    slopes = np.array([1.0, -2.0, 0.0])
    z, fresh = rng.normal(size=(2, R, SIZE, 3))
    y = z @ slopes
    for i, expected in enumerate(slopes**2 / 5):
        only, without = fresh.copy(), z.copy()
        only[..., i], without[..., i] = z[..., i], fresh[..., i]
        first = first_order(y, only @ slopes)
        total = total_order(y, without @ slopes)
        bound = derivative_bound(np.full_like(y, slopes[i] ** 2), y)
        for found in (first, total, bound):
            assert abs(found.mean() - expected) <= 5 * found.std(ddof=1) / np.sqrt(R) + 1e-12


def test_units_missing_values_and_constants() -> None:
    here, same, other = matched(3)
    y = ishigami(here)
    for function, points in ((first_order, same[0]), (total_order, other[0])):
        partner = ishigami(points)
        shifted = function(1e6 + 3 * y, 1e6 + 3 * partner)
        np.testing.assert_allclose(shifted, function(y, partner), rtol=1e-6)
        gone = partner.copy()
        gone[:, :500] = np.nan
        np.testing.assert_allclose(function(y, gone), function(y[:, 500:], partner[:, 500:]))
        assert np.isnan(function(np.ones((1, 9)), np.ones((1, 9))))


# -- inputs --------------------------------------------------------------------------------------


def ishigami_and_linear(a: Any, b: Any, c: Any, d: Any) -> Any:
    return ishigami(np.stack([a, b, c], axis=-1)) + d


SHARE = VARIANCE / (VARIANCE + 1)
FIRST_OF_FOUR = np.array([*FIRST * SHARE, 1 - SHARE])
TOTAL_OF_FOUR = np.array([*TOTAL * SHARE, 1 - SHARE])


@cache
def problem(emulator: str | None = "auto", n: int = 256) -> tuple[prb.Optimum, list[Any]]:
    rng = np.random.default_rng(1)
    data = ishigami_and_linear(*rng.uniform(-np.pi, np.pi, (3, 200)), rng.normal(0, 1, 200))
    with pm.Model() as model:
        inputs = [pm.Uniform.dist(-np.pi, np.pi) for _ in range(3)]
        inputs.append(pm.Normal.dist(pm.Normal("mu", 0, 1), 1.0))
        given: Any = {"metric": prb.ProbabilityResidual(), "observed": data}
        given["propagation"] = prb.Reweighted(n, emulator=emulator)
        prb.Simulator("y", ishigami_and_linear, *inputs, **given)
    return prb.minimize(model, refine=False, starts=0, progressbar=False), inputs


@pytest.mark.slow
def test_ishigami_emulated_from_few_runs_and_called() -> None:
    optimum, inputs = problem()
    quantity = prb.decision.Mean(ishigami_and_linear, *inputs)
    for computed in (False, True):
        table = prb.sensitivity(optimum, quantity, computed=computed)
        own = table.sel(factor=list("abcd"))
        for key, expected in (("first", FIRST_OF_FOUR), ("total", TOTAL_OF_FOUR)):
            off = np.abs(own[key] - expected)
            assert (off < 5 * own[f"{key}_error"]).all()
            assert (own[f"{key}_error"] < 0.03).all()
        assert (own.derivative > own.total - 0.02).all()
        assert (table.attrs["responses"] > 0) == computed


@pytest.mark.slow
def test_without_an_emulator_nothing_tells_what_is_between_the_runs() -> None:
    optimum, inputs = problem(None, 4096)
    quantity = prb.decision.Mean(ishigami_and_linear, *inputs)
    table = prb.sensitivity(optimum, quantity, n_points=64)
    assert np.isnan(table["first"].sel(factor="a"))
    assert "computed=True" in table.attrs["inputs"]


def test_where_the_nearest_run_failed_a_line_ends() -> None:
    broken = prb.decision.Exceedance(lambda x: np.where(x > 1, np.inf, x), normal()[1], limit=1.0)
    populations = Populations.of(optimum(), None, 50, "prb.sensitivity")
    sample = populations.sample(broken.response, broken.inputs, None)
    indices, _ = input_indices(sample, broken, 64, 0, computed=False)
    assert indices.values[1] == pytest.approx(1.0, abs=0.15)


def test_shares_of_no_variance_have_a_reason() -> None:
    model, x = normal()
    at_limit = prb.decision.Quantile(lambda x: np.minimum(x, 1), x, probability=0.9)
    table = prb.sensitivity(posterior(), at_limit, model=model, n_points=64)
    assert table.attrs["sd"] == 0
    assert np.isnan(table["first"].sel(factor="mu"))
    assert "constant-quantity" in table.attrs["findings"]
    rare = prb.decision.Quantile(same, x, probability=1 - 1e-6)
    table = prb.sensitivity(posterior(), rare, model=model, n_points=64)
    assert np.isnan(table["first"].sel(factor="x"))
    assert "beyond the quantile is the same for all 16 specimens" in table.attrs["inputs"]
    assert table.attrs["value_error"] > 0


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_the_step_does_not_matter(factor: float, monkeypatch: pytest.MonkeyPatch) -> None:
    model, x = normal()
    of_inputs, inputs = problem()
    first = prb.decision.Quantile(same, x, probability=0.9)
    second = prb.decision.Mean(ishigami_and_linear, *inputs)

    def derivatives() -> tuple[Any, Any]:
        one = prb.sensitivity(posterior(), first, model=model, n_points=256)
        two = prb.sensitivity(of_inputs, second, n_points=64, computed=True)
        return one.derivative.sel(factor=["mu", "sigma"]), two.derivative[1:]

    before = derivatives()
    monkeypatch.setattr(module, "_STEP", factor * module._STEP)
    after = derivatives()
    np.testing.assert_allclose(after[0], before[0], atol=0.01)
    np.testing.assert_allclose(after[1], before[1], rtol=0.01)


# -- the copula ------------------------------------------------------------------------------------

CORRELATION = np.array([[1.0, 0.6, 0.0], [0.6, 1.0, -0.3], [0.0, -0.3, 1.0]])
SD = np.array([0.1, 1.0, 20.0])
RNG = np.random.default_rng(0)
DRAWS = 5 + RNG.multivariate_normal(np.zeros(3), CORRELATION, 20_000) * SD
COPULA = Copula.of(DRAWS)
Z = RNG.multivariate_normal(np.zeros(3), COPULA.correlation, 20_000)
FRESH = RNG.normal(size=Z.shape)


def test_the_copula_reproduces_normal_and_skewed_draws() -> None:
    np.testing.assert_allclose(COPULA.correlation, CORRELATION, atol=4 / np.sqrt(20_000))
    thetas = COPULA.thetas(Z)
    np.testing.assert_allclose(thetas.mean(axis=0), 5, atol=0.05 * SD.max())
    np.testing.assert_allclose(thetas.std(axis=0), SD, rtol=0.03)
    skewed = np.exp(DRAWS[:, 1:2])
    quantiles = [
        np.quantile(x, [0.1, 0.5, 0.9]) for x in (Copula.of(skewed).thetas(Z[:, :1]), skewed)
    ]
    np.testing.assert_allclose(*quantiles, rtol=0.05)


@pytest.mark.parametrize("i", range(3))
def test_an_element_and_the_rest_are_drawn_given_each_other(i: int) -> None:
    found = COPULA.element_given_rest(Z, FRESH, i)
    rest = np.delete(Z, i, 1)
    np.testing.assert_array_equal(np.delete(found, i, 1), rest)
    np.testing.assert_allclose(np.cov(found.T), COPULA.correlation, atol=0.05)
    # Given the rest, the old and the new element are independent.
    residuals = [y - rest @ np.linalg.lstsq(rest, y)[0] for y in (Z[:, i], found[:, i])]
    assert abs(np.corrcoef(residuals)[0, 1]) < 5 / np.sqrt(len(Z))
    np.testing.assert_allclose(residuals[1].std(), COPULA.conditional_sd[i], rtol=0.03)
    found = COPULA.rest_given_element(Z, FRESH @ COPULA.root.T, i)
    np.testing.assert_allclose(found[:, i], Z[:, i])
    np.testing.assert_allclose(np.cov(found.T), COPULA.correlation, atol=0.05)
    for j in {0, 1, 2} - {i}:
        expected = COPULA.correlation[i, j] ** 2
        assert abs(np.corrcoef(Z[:, j], found[:, j])[0, 1] - expected) < 5 / np.sqrt(len(Z))
