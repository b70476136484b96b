"""Variables of `pymc.dims`: the same numbers as with plain variables of PyMC."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pymc as pm
import pymc.dims as pmd
import pytensor
import pytest
from pytensor.graph.traversal import ancestors

import prbayes as prb
from prbayes.model.parameters import Hyperparameters
from prbayes.response.inputs import read_inputs
from prbayes.response.pymc_dims import without_dims

RNG = np.random.default_rng(1)
Y = np.exp(RNG.normal(1, 0.3, 20))
PAIRS = RNG.normal([1.0, 2.0], [0.3, 0.5], (20, 2))
QUIET: dict[str, Any] = {"progressbar": False}
COORDS = {"part": ["u", "v"], "other": ["u", "v"]}


def lognormal(p: Any) -> Any:
    mu, sigma = p.Normal("mu", 0, 2), p.HalfNormal("sigma", 1)
    ratio = p.Deterministic("ratio", sigma / mu)
    p.Deterministic("twice", 2 * ratio)
    return p.LogNormal.dist(mu, sigma)


def plain_above(p: Any) -> Any:
    """Return an input of PyMC itself, of elements of variables with dimensions."""
    mu = p.Normal("mu", 0, 2, dims="part")
    elements = mu.values if p is pmd else mu
    return pm.Normal.dist(elements[0], pm.math.exp(elements[1]))


def vector(p: Any) -> Any:
    return p.Normal.dist(p.Normal("mu", 0, 2, dims="part"), p.HalfNormal("sigma", 1, dims="part"))


def correlated(p: Any) -> Any:
    mu, sigma = p.Normal("mu", 0, 2, dims="part"), p.HalfNormal("sigma", 1)
    cov = np.array([[1.0, 0.3], [0.3, 1.0]])
    if p is pm:
        return pm.MvNormal.dist(mu, cov=sigma**2 * cov)
    cov = pmd.as_xtensor(cov, dims=("part", "other"))
    return pmd.MvNormal.dist(mu, cov=sigma**2 * cov, core_dims=("part", "other"))


def model(build: Callable[[Any], Any], p: Any, metric: Any = None) -> tuple[pm.Model, Any]:
    with pm.Model(coords=COORDS) as m:
        x = build(p)
        observed = Y if x.type.ndim == 0 else PAIRS
        prb.Simulator("y", np.positive, x, observed=observed, metric=metric)
    return m, x


def numbers(
    build: Callable[[Any], Any], p: Any, metric: Any = None, draws: int = 50
) -> dict[str, Any]:
    """Return the optimum, its standard errors, draws and predictions."""
    m, x = model(build, p, metric)
    optimum = prb.minimize(m, starts=0, **QUIET)
    idata = prb.sample(draws, chains=2, model=m, optimum=optimum, **QUIET)
    prediction = prb.predict(idata, np.positive, x, model=m, n_samples=20, **QUIET)
    values = {f"optimum {k}": v for k, v in optimum.point.items()}
    values |= {f"stderr {k}": v for k, v in optimum.stderr.items()}
    values |= {f"draws {k}": v for k, v in idata["posterior"].data_vars.items()}
    return values | {"prediction": prediction}


@pytest.mark.long
@pytest.mark.parametrize("build", [plain_above, correlated])
def test_numbers_are_those_of_plain_variables(build: Callable[[Any], Any]) -> None:
    # Sums may have another order, and so another rounding.
    plain, named = numbers(build, pm), numbers(build, pmd)
    assert list(plain) == list(named)
    for name, value in plain.items():
        np.testing.assert_allclose(named[name], value, rtol=1e-6, err_msg=name)


@pytest.mark.long
def test_numbers_of_a_metric_are_those_of_plain_variables() -> None:
    # Refits end within their tolerance, so that draws agree in units of their spread. Resampling
    # selects other points where weights differ in the last digits: means of 2000 draws then differ
    # by up to the error of a difference of two samples, as the processor rounds.
    plain, named = [numbers(lognormal, p, prb.AreaMetric(), draws=1000) for p in (pm, pmd)]
    for name, value in plain.items():
        if name.startswith(("optimum", "stderr")):
            np.testing.assert_allclose(named[name], value, rtol=1e-4, err_msg=name)
        else:
            shift = float(abs(named[name].mean() - value.mean()))
            assert shift < np.sqrt(2 / 2000) * float(value.std()), name


def test_elements_have_the_names_of_coordinates() -> None:
    m, _ = model(vector, pmd)
    elements = ["mu[u]", "mu[v]", "sigma_log__[u]", "sigma_log__[v]"]
    assert Hyperparameters.of(m).names == elements


@pytest.mark.long
def test_an_error_with_dimensions_is_estimated() -> None:
    optima = []
    for p in (pm, pmd):
        with pm.Model() as m:
            x = p.Normal.dist(p.Normal("mu", 0, 2), 0.3)
            metric = prb.LogLikelihood(error=p.HalfNormal("e", 0.1))
            prb.Simulator("y", np.exp, x, observed=Y, metric=metric)
        optima.append(prb.minimize(m, starts=0, **QUIET).point)
    for name in ("mu", "e"):
        np.testing.assert_array_equal(*[point[name] for point in optima])


def test_an_input_of_two_simulators_stays_one_input() -> None:
    with pm.Model(coords=COORDS) as m:
        mu = pmd.Normal("mu", 0, 1, dims="part")
        x = pmd.Normal.dist(mu.isel(part=0), 1)
        first, second = (read_inputs(name, [x, mu], m) for name in "yz")
        other = read_inputs("w", [pmd.Normal.dist(mu.isel(part=1), 1)], m)
    assert first.aleatory[0] is second.aleatory[0]
    assert first.parents == second.parents == first.epistemic == other.parents
    assert [v.name for v in first.parents] == ["mu"]
    assert not hasattr(first.parents[0].type, "dims")


def test_random_variables_below_two_inputs_stay_shared() -> None:
    with pm.Model() as m:
        mu = pmd.Normal("mu", 0, 1)
        load = prb.response.condition("load", np.linspace(1, 2, 20))
        first = pmd.Normal.dist(mu * pmd.as_xtensor(load), 1)
        second = pmd.Normal.dist(first, pmd.as_xtensor(load))
        inputs = read_inputs("y", [first, second, load], m)
    assert inputs.nested
    assert inputs.aleatory[0] in ancestors([inputs.aleatory[1]])
    assert inputs.covariates == (load,)
    assert inputs.aleatory[2] is load
    assert {v.name for v in inputs.parents} == {"mu", "load"}


def test_the_graph_of_the_model_stays_as_it_is() -> None:
    m, x = model(lognormal, pmd)
    graphs = [*m.unobserved_RVs, x]
    before = pytensor.dprint(graphs, file="str")
    lowered = without_dims(graphs)
    assert pytensor.dprint(graphs, file="str") == before
    assert "XTensor" not in pytensor.dprint(lowered, file="str")


def test_constants_are_numbers_and_data_are_remembered() -> None:
    with pm.Model() as m:
        sd = pmd.Data("sd", np.array(1.0))
        x = pmd.Normal.dist(pmd.Normal("mu", 0, 1), sd)
        inputs = read_inputs("y", [x, pmd.as_xtensor(np.arange(3.0), dims="part")], m)
    assert list(inputs.data) == ["sd"]
    np.testing.assert_array_equal(inputs.arguments[1], [0, 1, 2])


def test_what_is_refused_of_plain_variables_is_refused() -> None:
    with pm.Model():
        foreign = pmd.Normal("mu", 0, 1)
    with pm.Model() as m:
        mu = pmd.Normal("mu", 0, 1)
        with pytest.raises(TypeError, match=r"depends on mu, expected .* of this model"):
            read_inputs("y", [pmd.Normal.dist(foreign, 1)], m)
        with pytest.raises(TypeError, match=r"an expression of a `\.dist"):
            read_inputs("y", [pmd.math.exp(pmd.Normal.dist(mu, 1))], m)
        with pytest.raises(ValueError, match="none of them aleatory"):
            read_inputs("y", [mu], m)
