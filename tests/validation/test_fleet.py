"""Products of a fleet have the posteriors that they have alone."""

import re
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pymc as pm
import pytest
import xarray as xr
from one_input import one_input
from scipy import stats

import prbayes as prb
from prbayes.posterior.batch import ProductPosteriors
from prbayes.validation.fleet import SpecimenFleet

QUIET = {"progressbar": False}


def half_exponential(x: Any) -> Any:
    return np.exp(0.5 * x)


def products(count: int, seed: int = 0) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    sizes = rng.integers(9, 20, count)
    return {
        f"p{i}": half_exponential(rng.normal(rng.normal(1, 0.4), 0.2, size))
        for i, size in enumerate(sizes)
    }


def model_of(observed: Any, metric: prb.Metric | None = None) -> pm.Model:
    return one_input(observed, metric, response=half_exponential, mu=(1, 0.4), sigma=0.4, **QUIET)


def summary(posterior: xr.Dataset) -> Any:
    draws = posterior.stack(sample=("chain", "draw"))
    return np.array(
        [[float(draws[name].mean()), float(draws[name].std())] for name in ("mu", "sigma")]
    )


@pytest.fixture(scope="module")
def fleet() -> xr.DataTree:
    data = products(3)
    further = {"p0": products(1, 5)["p0"] + 3.0, "p1": data["p1"][:6] + 0.01}
    return prb.calibrate_each(data, model=model_of([1.0, 2.0]), validation=further, **QUIET)


def test_posteriors_are_those_of_single_products(fleet: xr.DataTree) -> None:
    for name, observed in list(products(3).items())[1:]:
        alone = prb.sample(model=model_of(observed), random_seed=2, **QUIET)
        expected = summary(alone["posterior"].to_dataset())
        got = summary(fleet["posterior"].to_dataset().sel(product=name))
        sd = expected[:, 1]
        # 1000 draws: four standard errors of the mean are .13, of the standard deviation .09.
        np.testing.assert_allclose((got[:, 0] - expected[:, 0]) / sd, 0, atol=0.15)
        np.testing.assert_allclose(got[:, 1] / sd, 1, atol=0.12)


def test_each_product_has_its_validity_test(fleet: xr.DataTree) -> None:
    table = fleet["products"].to_dataset()
    assert table["rejected"].values.tolist() == [True, False, False]
    assert np.isnan(table["p_value"].values).tolist() == [False, False, True]


@pytest.mark.parametrize("metric", [None, prb.KullbackLeibler()])
def test_an_executor_changes_nothing(metric: prb.Metric | None) -> None:
    data = products(2)
    settings = {"draws": 50, "model": model_of([1.0, 2.0, 3.0], metric), **QUIET}
    alone = prb.calibrate_each(data, **settings)
    with ThreadPoolExecutor(1) as executor:
        other = prb.calibrate_each(data, executor=executor, **settings)
    xr.testing.assert_identical(alone, other)


@pytest.mark.parametrize(
    "select",
    [
        lambda fleet, name: fleet.sel(product=name),
        lambda fleet, name: fleet.sel(product=[name]),
        lambda fleet, name: fleet.isel(chain=0).sel(product=name),
        lambda fleet, name: fleet.isel(draw=slice(0, 50)).sel(product=name),
    ],
)
def test_a_selected_product_is_displayed(
    fleet: xr.DataTree, select: Callable[[xr.DataTree, str], Any]
) -> None:
    name = str(fleet["products"]["product"].values[1])
    product = select(fleet, name)
    assert repr(product).startswith("1 product")
    assert name in product._repr_html_()
    table = product.to_dataframe()
    assert list(table.index) == [name]
    variable = next(iter(product["posterior"].data_vars.values()))
    assert table.iloc[0, 0] == pytest.approx(float(variable.mean()))


def test_a_product_has_no_rank(fleet: xr.DataTree) -> None:
    names = fleet["products"]["product"].values
    products = {name: fleet.sel(product=name) for name in map(str, names[:2])}
    for candidates in (products, {"a": fleet, "b": fleet}):
        with pytest.raises(
            TypeError, match=r"posteriors of the product .*pass prb.minimize\(model"
        ):
            prb.rank(candidates)


def test_a_product_that_no_inputs_reproduce_is_a_finding_of_its_own() -> None:
    data = products(3) | {"bad": -products(1)["p0"]}
    table = prb.calibrate_each(data, model=model_of([1.0, 2.0]), draws=20, **QUIET)["products"]
    findings = table["finding"].values.tolist()
    assert findings[:3] == ["", "", ""]
    assert "reproduce the readings of 18 of 18 specimens" in findings[3]


@pytest.mark.long
def test_a_product_with_lost_mass_is_refused_as_alone() -> None:
    def nan_below(x: Any) -> Any:
        return np.where(x < 0.3, np.nan, 2 * x)

    x = np.random.default_rng(1).normal(0, 0.3, (3, 12))
    data = {"right": 2 * (x[0] + 2), "lossy": 2 * np.sort(x[1] + 0.5)[-9:], "also": 2 * (x[2] + 2)}
    model = one_input(data["lossy"], response=nan_below, mu=(1.2, 1))
    fleet = prb.calibrate_each(data, model=model, draws=100, **QUIET)
    first, lossy, last = fleet["products"]["finding"].values.tolist()
    assert first == last == ""
    with pytest.raises(RuntimeError, match="lost mass") as alone:
        prb.sample(100, model=model, **QUIET)
    pattern = r"\d+\.\d%"  # the shares differ by the runs
    assert re.sub(pattern, "", lossy) == "lossy: " + re.sub(pattern, "", str(alone.value))


def test_modes_of_a_product_are_reported() -> None:
    x = np.random.default_rng(2).normal(1.5, 0.3, (2, 12))
    model = one_input(x[0] ** 2, response=np.square, mu=(0, 1.5))
    fleet = prb.calibrate_each({"A": x[0] ** 2, "B": x[1] ** 2}, model=model, draws=100, **QUIET)
    for text in fleet["products"]["finding"].values:
        assert "The posterior has 2 modes" in text


def test_products_of_a_batch_have_the_draws_that_they_have_singly(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """To rounding, also where a few specimens have two inputs, and a prior has narrow populations.

    Validity tests differ by other random numbers.
    """
    rng = np.random.default_rng(3)
    data = {f"p{i}": (rng.normal(0.2 * i, 0.3, 8 + i) + 0.1) ** 2 for i in range(4)}
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0.5, 0.3), pm.HalfCauchy("sigma", 1e-3))
        prb.Simulator("y", lambda x: (x + 0.1) ** 2, x, observed=data["p0"], **QUIET)
    together = prb.calibrate_each(data, model=model, draws=100, **QUIET)
    monkeypatch.setattr(ProductPosteriors, "samples", lambda *_: {})
    singly = prb.calibrate_each(data, model=model, draws=100, **QUIET)
    for name in ("mu", "sigma"):
        first, second = (tree["posterior"][name].values for tree in (together, singly))
        np.testing.assert_allclose(first, second, rtol=1e-6)


def test_a_failure_leaves_the_other_products(monkeypatch: pytest.MonkeyPatch) -> None:
    tested = SpecimenFleet._tested

    def failing(self: SpecimenFleet, name: str, drawn: Any) -> Any:
        if name == "p1":
            raise np.linalg.LinAlgError("Singular matrix")
        return tested(self, name, drawn)

    monkeypatch.setattr(SpecimenFleet, "_tested", failing)
    tree = prb.calibrate_each(products(3), model=model_of([1.0, 2.0]), draws=20, **QUIET)
    assert tree["products"]["finding"].values.tolist() == ["", "p1: Singular matrix", ""]
    is_missing = np.isnan(tree["posterior"]["mu"]).all(("chain", "draw")).values
    assert is_missing.tolist() == [False, True, False]


@pytest.mark.parametrize(
    ("settings", "name"),
    [
        ({"weights": [0.5, 1.5, 1.0]}, "weights="),
        ({"weights": [0.5, 1.5, 1.0], "metric": prb.KullbackLeibler()}, "weights="),
        ({"specimens": ["a", "b", "c"]}, "specimens="),
        ({"observed": prb.Summary(n=9, mean=1.6, sd=0.2)}, "a prb.Summary"),
        ({"condition": [1.0, 2.0, 3.0]}, r"prb\.response\.condition"),
        ({"covariate": [1.0, 2.0, 3.0]}, r"prb\.response\.condition"),
    ],
)
def test_numbers_of_observed_specimens_are_refused(settings: dict[str, Any], name: str) -> None:
    """They would be those of other specimens, where numbers of specimens are equal."""
    given = {"observed": [1.0, 1.5, 2.1], **QUIET, **settings}
    with pm.Model() as model:
        mu, inputs = pm.Normal("mu", 1, 0.4), []
        if "covariate" in given:
            mu = mu + 0.1 * prb.response.condition("heat", given.pop("covariate"))
        if "condition" in given:
            inputs.append(prb.response.condition("load", given.pop("condition")))
        x = pm.Normal.dist(mu, pm.HalfNormal("sigma", 0.4))
        prb.Simulator("y", lambda x, load=1.0: np.exp(0.5 * x) * load, x, *inputs, **given)
    with pytest.raises(TypeError, match=f"got a simulator with {name}"):
        prb.calibrate_each({"a": [1.0, 1.5, 2.1]}, model=model, **QUIET)


@pytest.mark.long
def test_posteriors_of_three_specimens_are_as_wide_as_the_exact_ones() -> None:
    """The mean ratio of twelve widths has a standard error of .03."""
    rng = np.random.default_rng(66)
    x = {f"p{i}": rng.normal([1.0, 2.0], [0.2, 0.3], (3, 2)) for i in range(12)}
    with pm.Model() as model:
        inputs = [
            pm.Normal.dist(pm.Normal(k, 0, 10), pm.HalfNormal(f"s{k}", 1)) for k in ("a", "b")
        ]
        data = {name: curved(*values.T) for name, values in x.items()}
        prb.Simulator("y", curved, *inputs, observed=data["p0"])
    fleet = prb.calibrate_each(data, model=model, random_seed=1, progressbar=False)
    s = np.linspace(0.002, 5.0, 4000)
    ratios = []
    for name, values in x.items():
        v = values[:, 0]
        # The spread by quadrature; given the spread the mean is normal.
        logs = -((v - v.mean()) ** 2).sum() / (2 * s**2) - 2 * np.log(s) - s**2 / 2
        logs += stats.norm.logpdf(v.mean(), 0, np.hypot(10, s / np.sqrt(3)))
        weights = np.exp(logs - logs.max())
        weights /= weights.sum()
        variance = 1 / (1 / 100 + 3 / s**2)
        center = variance * 3 * v.mean() / s**2
        exact = np.sqrt(weights @ (variance + center**2) - (weights @ center) ** 2)
        ratios.append(fleet["posterior"].dataset["a"].sel(product=name).values.std() / exact)
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.12)


def curved(a: Any, b: Any) -> Any:
    return np.stack([1e6 * np.exp(a), a * b + b], axis=-1)


@pytest.mark.parametrize("n_inputs", [1, 2])
def test_heavy_tails_of_few_specimens_are_reported(n_inputs: int) -> None:
    """The standard deviation of 1000 draws is then known to a tenth or a fifth."""
    rng = np.random.default_rng(0)
    with pm.Model() as model:
        inputs = [
            pm.Normal.dist(pm.Normal(f"m{k}", 0, 10), pm.HalfNormal(f"s{k}", 3))
            for k in range(n_inputs)
        ]
        prb.Simulator(
            "y",
            lambda *x: np.stack(x, axis=-1),
            *inputs,
            observed=rng.normal(0, 0.3, (4, n_inputs)),
        )
    data = {f"p{n}": rng.normal(0, 0.3, (n, n_inputs)) for n in (3, 4, 12)}
    *few, many = prb.calibrate_each(data, model=model, **QUIET)["products"]["finding"].values
    assert all("heavy tails" in text for text in few)
    assert not many


def test_an_emulator_that_is_not_smooth_enough_is_reported() -> None:
    """The response oscillates at one specimen, at twice the inputs of the others."""

    def response(x: Any) -> Any:
        return x + np.where(x > 45, 3 * np.sin(3 * x), 0)

    x = np.array([60.0, *np.random.default_rng(3).normal(28, 3, 14)[1:]])
    with pm.Model() as model:
        k = pm.Normal.dist(pm.Normal("mu", 20, 8), pm.HalfNormal("sigma", 4))
        prb.Simulator("y", response, k, observed=response(x))
    data = {"p0": response(x), "p1": response(x[1:])}
    first, second = prb.calibrate_each(data, model=model, **QUIET)["products"]["finding"].values
    assert "not smooth enough" in first
    assert "not smooth enough" not in second
