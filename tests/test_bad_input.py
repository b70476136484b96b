"""Structural mistakes raise early: what was got, what to do, before the response is computed or a sampler starts."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pymc as pm
import pytensor.tensor as pt
import pytest
from first_use import first_use
from pymc.logprob.utils import ParameterValueError
from scipy.stats import norm

import prbayes as prb
from prbayes.model.random_variable import nodes
from prbayes.response.compile import PLAIN

OBSERVED = 0.75 * (2.0 + 0.8 * norm.ppf((np.arange(30) + 0.5) / 30))
SMALL = (prb.Reweighted(64), prb.Resimulated(64), prb.Fresh(64))
ONE: dict[str, Any] = {"chains": 1, "cores": 1, "progressbar": False}

with pm.Model():
    STRANGER = pm.Normal("stranger")


def never(*inputs: Any) -> Any:
    pytest.fail("the response was called")


def line(x: Any) -> Any:
    return 0.75 * x


def one(mu: Any, sigma: Any) -> list[Any]:
    return [pm.Normal.dist(mu, sigma)]


def simulator(
    response: Any = never, inputs: Callable[[Any, Any], list[Any]] = one, **changes: Any
) -> Any:
    """A simulator with something wrong; the model stays as it was, so that the cell of a notebook can be run again."""

    def call() -> None:
        with pm.Model() as model:
            mu, sigma = pm.Normal("mu", 2, 1), pm.HalfNormal("sigma", 1)
            keywords = {
                "metric": prb.AreaMetric(),
                "observed": OBSERVED,
                "propagation": SMALL[0],
            } | changes
            try:
                prb.Simulator("y", response, *inputs(mu, sigma), **keywords)
            except (TypeError, ValueError):
                assert "y" not in model.named_vars
                raise
        first_use(model)

    return call


def only(dist: Callable[[Any, Any], Any]) -> Callable[[Any, Any], list[Any]]:
    return lambda mu, sigma: [dist(mu, sigma)]


def raises(x: Any) -> Any:
    return {}["no such key"]


def two(mu: Any, sigma: Any) -> list[Any]:
    return [pm.MvNormal.dist(pt.stack([mu, mu]), np.eye(2))]


def build(response: Any = line, *, prior: Any = pm.Normal, **changes: Any) -> pm.Model:
    keywords = {
        "metric": prb.AreaMetric(),
        "observed": OBSERVED,
        "propagation": prb.Reweighted(128),
    } | changes
    with pm.Model() as model:
        mu, sigma = (
            prior("mu", *({pm.Normal: (2, 1), pm.Poisson: (3,)}.get(prior, ()))),
            pm.HalfNormal("sigma", 1),
        )
        prb.Simulator("y", response, pm.Normal.dist(mu, sigma), **keywords)
    return model


@cache
def good() -> pm.Model:
    return build()


@cache
def without_simulator() -> pm.Model:
    with pm.Model() as model:
        pm.Normal("mu")
    return model


@cache
def discrete() -> pm.Model:
    return build(prior=pm.Poisson, epsilon=0.1)


def axis_first(x: Any) -> Any:
    return x[0] + x[1]


# Responses that are none, with what is said of them.
WRONG: dict[str, tuple[Any, str]] = {
    "mean": (lambda x: x.mean(), r"returned shape \(\) for inputs of .*one response per specimen"),
    "raises": (raises, r"raised KeyError: 'no such key'; .* arrays of any leading shape"),
    "NaN": (lambda x: x * np.nan, r"NaN at all .*expected numbers; look at the priors"),
    "extra axis": (lambda x: x[..., None], r"returned shape .*, 1\) .*expected \("),
    "event axis first": (axis_first, r"reduce over the event axis only \(the last one\)"),
    "event axis kept": (lambda x: np.stack([x, x]), r"returned shape \(2, .*expected \("),
    "complex": (lambda x: x + 1j, r"returned complex numbers, expected an array of real"),
    "None": (lambda x: None, r"returned NoneType .*expected an array of real numbers"),
    "PyTensor": (lambda x: x * STRANGER, r"returned TensorVariable .*expected an array of"),
    "scalars only": (lambda x: x if x > 0 else -x, r"raised ValueError: The truth value .*"),
}
type Case = tuple[Callable[[], Any], type[Exception], str]
UNSET = r"y: epsilon is not set; .*prb.calibrate_epsilon\(prb.minimize\(model\)\)"
OTHER_ROUTE = r"; use propagation=prb\.Reweighted\(\)"
BAD: dict[str, Case] = {
    # The measured responses.
    "observed huge": (
        simulator(observed=[1, 2e160, 2]),
        ValueError,
        r"got values of up to 2e\+160, expected at most 1e\+152 in size",
    ),
    "observed inf": (
        simulator(
            observed=[1, np.inf, 2], metric=prb.FunctionMetric(lambda s, o, w: 0.0, weighted=True)
        ),
        ValueError,
        r"got 1 NaN or infinite among 3.*\+inf, use a metric that counts them",
    ),
    "observed failures": (
        simulator(observed=[np.inf, np.inf, 2]),
        ValueError,
        r"got one value besides 2 of specimens that failed, expected at least 2",
    ),
    # The response.
    **{
        f"response {what}, {type(p).__name__}": (
            simulator(response, two if what == "event axis first" else one, propagation=p),
            prb.response.ResponseError,
            text,
        )
        for p in SMALL
        for what, (response, text) in WRONG.items()
        if p == SMALL[0] or what in ("mean", "raises", "NaN")
    },
    "too few arguments": (
        simulator(lambda: 0.0),
        TypeError,
        r"y: response: got inputs of \[1\] numbers for a function of \(\) \(too many posi",
    ),
    "response after the input": (
        simulator(pm.Normal.dist(0, 1), lambda mu, sigma: [line]),
        TypeError,
        r"y: response: got TensorVariable .*the order is Simulator\(name, response, \*inputs",
    ),
    # What a propagation cannot do, with the one that can.
    "Resimulated discrete": (
        simulator(inputs=only(lambda m, s: pm.Poisson.dist(s)), propagation=SMALL[1]),
        TypeError,
        r"y: got poisson.* is discrete, expected .*" + OTHER_ROUTE,
    ),
    "Resimulated without icdf": (
        simulator(inputs=only(lambda m, s: pm.VonMises.dist(m, s)), propagation=SMALL[1]),
        TypeError,
        r"y: got vonmises.* no inverse distribution function .*" + OTHER_ROUTE,
    ),
    **{
        f"{type(p).__name__} nested": (
            simulator(
                inputs=only(lambda m, s: pm.Normal.dist(pm.Normal.dist(m, 1.0), s)), propagation=p
            ),
            TypeError,
            r"y: .* depends on another `.dist\(\)`.*propagation=prb.Fresh\(\)",
        )
        for p in SMALL[:2]
    },
    "Reweighted epistemic": (
        simulator(inputs=lambda m, s: [pm.Normal.dist(0, s), m]),
        TypeError,
        r"y: mu goes into the response .*use propagation=prb.Resimulated\(\)",
    ),
    "Reweighted function without weights": (
        simulator(metric=prb.FunctionMetric(lambda a, b: abs(a.mean(-1) - b.mean()))),
        TypeError,
        r"y: a metric that takes no weights .*weighted=True, or use propagation=prb.Resimulated",
    ),
    # Priors.
    **{
        prior.__name__: (
            lambda prior=prior: first_use(build(never, prior=prior)),
            TypeError,
            r"got mu.*replace pm.Flat and pm.HalfFlat by a wide pm.Normal",
        )
        for prior in (pm.Flat, pm.HalfFlat)
    },
    "prior of invalid parameters": (
        simulator(inputs=lambda m, s: [pm.Normal.dist(m, -s)], propagation=SMALL[2]),
        ValueError,
        r"y: priors: got invalid parameters .*mu, sigma, expected valid .*pm.HalfNormal",
    ),
    "discrete prior, minimize": (
        lambda: prb.minimize(discrete()),
        TypeError,
        r"got discrete .*\['mu'\].*pm.sample",
    ),
    "discrete prior, SMC": (
        lambda: prb.sample_smc(model=discrete()),
        TypeError,
        r"\['mu'\], expected continuous",
    ),
    # No model, and no simulator in it.
    "no model, Simulator": (
        lambda: prb.Simulator("y", never, 1.0, metric=prb.AreaMetric(), observed=OBSERVED),
        TypeError,
        r"prb.Simulator\('y', ...\): got no model on the context.*inside `with pm.Model\(\):`",
    ),
    **{
        f"no model, {f.__name__}": (f, TypeError, rf"{f.__name__}: got no model .*or pass model=")
        for f in (prb.minimize, prb.sample_smc, prb.refine, prb.posterior.BatchedKernel)
    },
    **{
        f"no simulator, {f.__name__}": (
            lambda f=f, rest=rest: f(model=without_simulator(), **rest),
            ValueError,
            r"model: got one without a prb.Simulator.*add prb.Simulator\(name, re",
        )
        for f, rest in (
            *((prb.minimize, {}), (prb.sample_smc, {}), (prb.refine, {})),
            *((prb.set_epsilon, {"epsilon": {"y": 1.0}}), (prb.posterior.BatchedKernel, {})),
        )
    },
    # Epsilon: of an estimate, and where nobody set it.
    "SMC epsilon of an estimate": (
        lambda: prb.sample_smc(model=good(), epsilon=0.1, progressbar=False),
        ValueError,
        r"epsilon: got 0\.1, expected none: .*pass adjustment=None",
    ),
    "unset, logp": (
        lambda: good().compile_logp(mode=PLAIN)(good().initial_point()),
        ParameterValueError,
        UNSET,
    ),
    "unset, NUTS": (
        lambda: pm.sample(5, tune=5, **ONE, model=good(), compile_kwargs={"mode": PLAIN}),
        ParameterValueError,
        UNSET,
    ),
    "unset, kernel": (
        lambda: pm.sample_smc(50, **ONE, model=good(), kernel=prb.posterior.BatchedKernel),
        ValueError,
        UNSET,
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_raises(case: str) -> None:
    call, error, text = BAD[case]
    with pytest.raises(error, match=text):
        call()


@pytest.mark.parametrize("propagation", SMALL, ids=lambda p: type(p).__name__)
def test_the_error_of_the_response_is_chained(propagation: prb.propagation.Propagation) -> None:
    with pytest.raises(prb.response.ResponseError) as caught:
        simulator(raises, propagation=propagation)()
    assert isinstance(caught.value.__cause__, KeyError)
    assert caught.value.__cause__.args == ("no such key",)


@pytest.mark.parametrize(
    ("epsilon", "error"),
    [
        ({"y": 0.2, "z": 1.0}, KeyError),
        ({"y": 0.2, "w": -1.0}, ValueError),
        ({"y": 0.2, "w": "a"}, TypeError),
    ],
)
def test_set_epsilon_is_all_or_nothing(epsilon: dict[str, Any], error: type[Exception]) -> None:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 2, 1), 1.0)
        for name in ("y", "w"):
            prb.Simulator(
                name,
                line,
                x,
                metric=prb.AreaMetric(),
                observed=OBSERVED,
                epsilon=0.1,
                propagation=SMALL[1],
            )
    with pytest.raises(error, match=r"(z|w).*expected"):
        prb.set_epsilon(model, epsilon)
    assert [n.epsilon_value for n in nodes(model).values()] == [0.1, 0.1]
    with pytest.raises(error):
        prb.sample_smc(model=model, epsilon=epsilon, adjustment=None, progressbar=False)
    assert [n.epsilon_value for n in nodes(model).values()] == [0.1, 0.1]


def test_much_lost_mass_at_the_optimum_is_an_error() -> None:
    model = build(lambda x: np.where(x > 2, np.nan, 0.75 * x))
    with pytest.raises(
        prb.propagation.DesignError,
        match=r"y: got 1\d of 30 observed responses where no run .* repair the response, or .*max_lost",
    ):
        prb.minimize(model)


def test_a_model_in_the_place_of_a_number_belongs_into_model() -> None:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu"), 1.0)
        prb.Simulator("y", never, x, metric=prb.AreaMetric(), observed=OBSERVED)
    for function in (prb.sample, prb.sample_smc):
        with pytest.raises(TypeError, match=r"draws: got Model .*; pass a model as model="):
            function(model)  # type: ignore[operator]
