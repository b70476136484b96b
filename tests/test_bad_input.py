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
from prbayes.model.evaluator import Evaluator
from prbayes.model.random_variable import nodes
from prbayes.response.compile import PLAIN

OBSERVED = 0.75 * (2.0 + 0.8 * norm.ppf((np.arange(30) + 0.5) / 30))
SMALL = (prb.Reweighted(64), prb.Resimulated(64), prb.Fresh(64))

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


def second(x: Any) -> Callable[[Any, Any], list[Any]]:
    return lambda mu, sigma: [pm.Normal.dist(mu, sigma), x]


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


def minimize(**keywords: Any) -> Any:
    return lambda: prb.minimize(good(), **keywords)


def sample_smc(**keywords: Any) -> Any:
    return lambda: prb.sample_smc(**{"model": good(), "progressbar": False} | keywords)


BAD: dict[str, tuple[Callable[[], Any], type[Exception], str]] = {
    # The measured responses.
    "observed NaN": (
        simulator(observed=[1, np.nan, 2]),
        ValueError,
        r"y: observed: got 1 NaN .* leave missing",
    ),
    "observed huge": (
        simulator(observed=[1, 2e160, 2]),
        ValueError,
        r"got values of up to 2e\+160, expected at most 1e\+152 in size",
    ),
    "observed -inf": (
        simulator(observed=[1, -np.inf, 2]),
        ValueError,
        r"got 1 NaN or infinite among 3.*leave missing.*that had failed as \+inf",
    ),
    "observed inf": (
        simulator(
            observed=[1, np.inf, 2], metric=prb.FunctionMetric(lambda s, o, w: 0.0, weighted=True)
        ),
        ValueError,
        r"got 1 NaN or infinite among 3.*\+inf, takes a metric that counts it",
    ),
    "observed failures": (
        simulator(observed=[np.inf, np.inf, 2]),
        ValueError,
        r"got one value besides 2 of specimens that failed, expected at least 2",
    ),
    "observed masked": (
        simulator(observed=np.ma.masked_array([1, 2, 3], [0, 1, 0])),
        ValueError,
        r"masked.*leave mis",
    ),
    "observed empty": (
        simulator(observed=[]),
        ValueError,
        r"y: observed: got no values, expected at least 2",
    ),
    "observed one": (
        simulator(observed=[1.0]),
        ValueError,
        r"y: observed: got one value, expected at least 2",
    ),
    "observed scalar": (
        simulator(observed=1.0),
        ValueError,
        r"got an array of shape \(\), expected one dimension",
    ),
    "observed strings": (
        simulator(observed=["a", "b"]),
        TypeError,
        r"y: observed: got .*<U1, expected real numbers",
    ),
    "observed 2-D": (
        simulator(observed=np.ones((3, 2))),
        ValueError,
        r"shape \(3, 2\).*one Simulator each",
    ),
    "observed complex": (
        simulator(observed=[1j, 2]),
        TypeError,
        r"got complex numbers, expected real ones; pass the",
    ),
    "observed ragged": (
        simulator(observed=[[1], [1, 2]]),
        TypeError,
        r"got a ragged sequence, expected a regular",
    ),
    "observed equal": (
        simulator(observed=[1.0, 1.0, 1.0], metric=prb.ProbabilityResidual()),
        ValueError,
        r"got 0 from 3 observed values .*use AreaMetric",
    ),
    "weights length": (
        simulator(weights=np.ones(29)),
        ValueError,
        r"weights: got shape \(29,\), expected .*30",
    ),
    "weights 2-D": (
        simulator(weights=np.ones((2, 30))),
        ValueError,
        r"weights: got shape \(2, 30\), expected \(30,",
    ),
    "weights negative": (
        simulator(weights=np.r_[-1, np.ones(29)]),
        ValueError,
        r"got negative .* expected weights >=",
    ),
    "weights zero": (
        simulator(weights=np.zeros(30)),
        ValueError,
        r"weights that sum to zero, expected a positive",
    ),
    "weights string": (
        simulator(weights="abc"),
        TypeError,
        r"weights: got str 'abc', expected real numbers",
    ),
    "specimens length": (
        simulator(specimens=range(29)),
        ValueError,
        r"specimens: got shape \(29,\), expected \(30,\)",
    ),
    # The response.
    **{
        f"response {what}, {type(p).__name__}": (
            simulator(f, two if f is axis_first else one, propagation=p),
            e,
            text,
        )
        for p in SMALL
        for axis_first in [lambda x: x[0] + x[1]]
        for what, f, e, text in [
            (
                "scalar",
                lambda x: 1.0,
                prb.response.ResponseError,
                r"returned shape \(\) for inputs of shapes .*expected \(",
            ),
            (
                "mean",
                lambda x: x.mean(),
                prb.response.ResponseError,
                r"returned shape \(\) .*one response per specimen",
            ),
            (
                "extra axis",
                lambda x: x[..., None],
                prb.response.ResponseError,
                r"returned shape .*, 1\) .*expected \(",
            ),
            (
                "event axis first",
                axis_first,
                prb.response.ResponseError,
                r"reduce over the event axis only \(the last one\)",
            ),
            (
                "event axis kept",
                lambda x: np.stack([x, x]),
                prb.response.ResponseError,
                r"returned shape \(2, .*expected \(",
            ),
            (
                "NaN",
                lambda x: x * np.nan,
                prb.response.ResponseError,
                r"NaN at all .*expected numbers; look at the priors",
            ),
            (
                "complex",
                lambda x: x + 1j,
                prb.response.ResponseError,
                r"returned complex numbers, expected an array of real",
            ),
            (
                "None",
                lambda x: None,
                prb.response.ResponseError,
                r"returned NoneType .*expected an array of real numbers",
            ),
            (
                "PyTensor",
                lambda x: x * STRANGER,
                prb.response.ResponseError,
                r"returned TensorVariable .*expected an array of",
            ),
            (
                "raises",
                raises,
                prb.response.ResponseError,
                r"raised KeyError: 'no such key'; .* arrays of any leading shape",
            ),
            (
                "scalars only",
                lambda x: x if x > 0 else -x,
                prb.response.ResponseError,
                r"raised ValueError: The truth value .*",
            ),
            (
                "too few arguments",
                lambda: 0.0,
                TypeError,
                r"y: response: got inputs of \[1\] numbers for a function of \(\) \(too many posi",
            ),
            (
                "not callable",
                3.0,
                TypeError,
                r"y: response: got float, expected a function .*the order is Simulator",
            ),
        ]
    },
    "response after the input": (
        simulator(pm.Normal.dist(0, 1), lambda mu, sigma: [line]),
        TypeError,
        r"y: response: got TensorVariable, .*the order is Simulator\(name, response, \*inputs",
    ),
    # The inputs.
    "input string": (
        simulator(inputs=second("C")),
        TypeError,
        r"y: input 2: got str 'C', .*a `.dist\(\)`",
    ),
    "no input": (
        simulator(inputs=lambda m, s: []),
        ValueError,
        r"y: got 0 inputs, none of them aleatory.*dist\(\)",
    ),
    # What a propagation cannot do, with the one that can.
    "Resimulated discrete": (
        simulator(inputs=only(lambda m, s: pm.Poisson.dist(s)), propagation=SMALL[1]),
        TypeError,
        r"y: got poisson.* is discrete, expected .*; use propagation=prb.Reweighted\(\) or prb.Fresh\(\)",
    ),
    "Resimulated without icdf": (
        simulator(inputs=only(lambda m, s: pm.VonMises.dist(m, s)), propagation=SMALL[1]),
        TypeError,
        r"y: got vonmises.* no inverse distribution function .*; use propagation=prb.Reweighted\(\) or prb.Fresh\(\)",
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
        r"y: a metric that takes no weights .*weighted=True, or use propagation=prb.Resimulated\(\)",
    ),
    # Priors.
    "flat prior": (
        lambda: first_use(build(never, prior=pm.Flat)),
        TypeError,
        r"got mu.*replace pm.Flat .*wide pm.Normal",
    ),
    "half-flat prior": (
        lambda: first_use(build(never, prior=pm.HalfFlat)),
        TypeError,
        r"got mu.*pm.HalfFlat by a wide",
    ),
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
    # Other arguments of a simulator.
    "epsilon 0": (
        simulator(epsilon=0),
        ValueError,
        r"y: epsilon: got 0, expected a positive finite number",
    ),
    "epsilon -1": (
        simulator(epsilon=-1.0),
        ValueError,
        r"y: epsilon: got -1.0, expected a positive finite number",
    ),
    "epsilon NaN": (
        simulator(epsilon=np.nan),
        ValueError,
        r"y: epsilon: got nan, expected a positive finite number",
    ),
    "epsilon string": (
        simulator(epsilon="a"),
        TypeError,
        r"y: epsilon: got str 'a', expected a positive finite number",
    ),
    "metric class": (
        simulator(metric=prb.AreaMetric),
        TypeError,
        r"y: metric: got the class AreaMetric, expected a m",
    ),
    "metric function": (
        simulator(metric=lambda a, b: 0),
        TypeError,
        r"got function .*wrap .* in prb.FunctionMetric",
    ),
    "metric string": (
        simulator(metric="area"),
        TypeError,
        r"got str 'area', expected a metric object such as prb.",
    ),
    "propagation int": (
        simulator(propagation=64),
        TypeError,
        r"y: propagation: got int 64, expected prb.Reweighted",
    ),
    "propagation class": (
        simulator(propagation=prb.Fresh),
        TypeError,
        r"got the class Fresh, expected prb.Rew",
    ),
    # Configurations.
    "density class": (
        lambda: prb.ProbabilityResidual(prb.GaussianKDE),
        TypeError,
        r"class GaussianKDE, expected prb",
    ),
    "density number": (
        lambda: prb.KullbackLeibler(0.3),
        TypeError,
        r"density: got float 0.3, expected prb.GaussianKDE",
    ),
    "density None": (
        lambda: prb.KullbackLeibler(None),
        TypeError,
        r"density: got NoneType None, expected prb.Gauss",
    ),
    "abc_distance function": (
        lambda: prb.abc_distance(line),
        TypeError,
        r"abc_distance: got function .*AreaMetric",
    ),
    "abc_distance class": (
        lambda: prb.abc_distance(prb.AreaMetric),
        TypeError,
        r"got the class AreaMetric",
    ),
    "Reweighted 0": (
        lambda: prb.Reweighted(0),
        ValueError,
        r"Reweighted: n: got 0, expected an integer >= 16",
    ),
    "Reweighted string": (
        lambda: prb.Reweighted("a"),
        TypeError,
        r"Reweighted: n: got str 'a', expected an integer",
    ),
    "Reweighted float": (
        lambda: prb.Reweighted(64.0),
        TypeError,
        r"Reweighted: n: got float 64.0, expected an integ",
    ),
    "Reweighted seed": (
        lambda: prb.Reweighted(64, random_seed=-1),
        ValueError,
        r"random_seed: got -1, expected an int",
    ),
    "Reweighted lost": (
        lambda: prb.Reweighted(64, max_lost=1),
        ValueError,
        r"max_lost: got 1, expected a share below",
    ),
    "Resimulated 1": (
        lambda: prb.Resimulated(1),
        ValueError,
        r"Resimulated: n: got 1, expected an integer >= 2",
    ),
    "Fresh 0": (lambda: prb.Fresh(0), ValueError, r"Fresh: n: got 0, expected an integer >= 1"),
    # No model.
    "no model, Simulator": (
        lambda: prb.Simulator("y", never, 1.0, metric=prb.AreaMetric(), observed=OBSERVED),
        TypeError,
        r"prb.Simulator\('y', ...\): got no model on the context.*inside `with pm.Model\(\):`",
    ),
    "no model, minimize": (
        lambda: prb.minimize(),
        TypeError,
        r"prb.minimize: got no model .*or pass model=",
    ),
    "no model, SMC": (
        lambda: prb.sample_smc(),
        TypeError,
        r"prb.sample_smc: got no model .*or pass model=",
    ),
    "no model, refine": (
        lambda: prb.refine(),
        TypeError,
        r"prb.refine: got no model .*or pass model=",
    ),
    "no model, kernel": (
        lambda: prb.posterior.BatchedKernel(),
        TypeError,
        r"BatchedKernel: got no model .*or pass model=",
    ),
    "not a model": (
        lambda: prb.minimize("model"),
        TypeError,
        r"prb.minimize: got str, expected a pm.Model",
    ),
    **{
        f"no simulator, {name}": (
            f,
            ValueError,
            r"model: got one without a prb.Simulator.*add prb.Simulator\(name, re",
        )
        for name, f in {
            "minimize": lambda: prb.minimize(without_simulator()),
            "SMC": lambda: prb.sample_smc(model=without_simulator()),
            "refine": lambda: prb.refine(without_simulator()),
            "set_epsilon": lambda: prb.set_epsilon(without_simulator(), {"y": 1.0}),
            "kernel": lambda: prb.posterior.BatchedKernel(model=without_simulator()),
        }.items()
    },
    # Arguments of the optimiser and of the sampler.
    "start incomplete": (
        minimize(start={"mu": 1.0}),
        KeyError,
        r"start: got \['mu'\], expected .*'mu', 'sigma'",
    ),
    "start unknown": (
        minimize(start={"mu": 1, "sigma": 1, "z": 1}),
        KeyError,
        r"start: got .*'z'\], expected .*sigma",
    ),
    "start outside": (
        minimize(start={"mu": 1, "sigma": -1}),
        ValueError,
        r"start: got .*inside the support",
    ),
    "start NaN": (
        minimize(start={"mu": np.nan, "sigma": 1}),
        ValueError,
        r"start: got .*inside the support",
    ),
    "start string": (
        minimize(start={"mu": "a", "sigma": 1}),
        TypeError,
        r"start: mu: got str 'a', expected real",
    ),
    "start shape": (
        minimize(start={"mu": [1, 2], "sigma": 1}),
        ValueError,
        r"start: mu: got shape \(2,\), expected",
    ),
    "draws 0": (sample_smc(draws=0), ValueError, r"draws: got 0, expected an integer >= 10"),
    "draws string": (sample_smc(draws="a"), TypeError, r"draws: got str 'a', expected an integer"),
    "chains 0": (sample_smc(chains=0), ValueError, r"chains: got 0, expected an integer >= 1"),
    "SMC epsilon name": (
        sample_smc(epsilon={"z": 1.0}, adjustment=None),
        KeyError,
        r"epsilon: got \['z'\], expected names .*\['y'\]",
    ),
    "SMC epsilon 0": (
        sample_smc(epsilon=0, adjustment=None),
        ValueError,
        r"y: epsilon: got 0, expected a positive finite number",
    ),
    "SMC epsilon string": (
        sample_smc(epsilon={"y": "a"}, adjustment=None),
        TypeError,
        r"y: epsilon: got str 'a', expected a pos",
    ),
    "SMC optimum": (sample_smc(optimum=3), TypeError, r"optimum: got int, expected an Optimum"),
    "SMC epsilon of an estimate": (
        sample_smc(epsilon=0.1),
        ValueError,
        r"epsilon: got 0\.1, expected none: .*pass adjustment=None",
    ),
    "SMC adjustment": (
        sample_smc(adjustment="affine"),
        ValueError,
        r"adjustment: got 'affine', expected \"estimate\", or None",
    ),
    "calibrate a model": (
        lambda: prb.calibrate_epsilon(good()),
        TypeError,
        r"got Model, expected an Optimum; call",
    ),
    # Epsilon that nobody set.
    "unset, logp": (
        lambda: good().compile_logp(mode=PLAIN)(good().initial_point()),
        ParameterValueError,
        r"y: epsilon is not set; .*prb.calibrate_epsilon\(prb.minimize\(model\)\)",
    ),
    "unset, NUTS": (
        lambda: pm.sample(
            5,
            tune=5,
            chains=1,
            cores=1,
            model=good(),
            compile_kwargs={"mode": PLAIN},
            progressbar=False,
        ),
        ParameterValueError,
        r"y: epsilon is not set; .*prb.calibrate_epsilon\(prb.minimize\(model\)\)",
    ),
    "unset, kernel": (
        lambda: pm.sample_smc(
            50,
            model=good(),
            kernel=prb.posterior.BatchedKernel,
            chains=1,
            cores=1,
            progressbar=False,
        ),
        ValueError,
        r"y: epsilon is not set; .*prb.calibrate_epsilon\(prb.minimize\(model\)\)",
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
        ({"z": 1.0}, KeyError),
        ({"y": 0.2, "z": 1.0}, KeyError),
        ({"y": 0.2, "w": -1.0}, ValueError),
        ({"y": 0.2, "w": np.nan}, ValueError),
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


def test_a_few_nan_responses_are_fine_and_reported() -> None:
    model = build(lambda x: np.where(x < 0.8, np.nan, 0.75 * x), propagation=prb.Reweighted(512))
    evaluator = Evaluator.of(model)
    theta = evaluator.hyperparameters.unconstrained({"mu": 2.0, "sigma": 0.8})[None]
    node = next(iter(nodes(model).values()))
    lost = node.bound.support(evaluator.roots(theta, 0))["lost_mass"]
    np.testing.assert_allclose(lost, norm.cdf(0.8, 2.0, 0.8), atol=0.01)
    assert np.isfinite(evaluator(theta).discrepancies).all()
    tolerant = build(
        lambda x: np.where(x < 0.8, np.nan, 0.75 * x), propagation=prb.Reweighted(512, max_lost=0.2)
    )
    np.testing.assert_allclose(prb.minimize(tolerant).point["mu"], 2.0, atol=0.15)


def test_much_lost_mass_at_the_optimum_is_an_error() -> None:
    model = build(lambda x: np.where(x > 2, np.nan, 0.75 * x))
    with pytest.raises(
        prb.propagation.DesignError,
        match=r"y: lost mass: .*NaN.*repair the response.*\+inf .*max_lost",
    ):
        prb.minimize(model)


@pytest.mark.parametrize("propagation", SMALL[:2], ids=lambda p: type(p).__name__)
def test_specimens_that_fail_are_infinite(propagation: prb.propagation.Propagation) -> None:
    model = build(lambda x: np.where(np.asarray(x) > 3, np.inf, 0.75 * x), propagation=propagation)
    evaluator = Evaluator.of(model)
    theta = evaluator.hyperparameters.unconstrained({"mu": 2.0, "sigma": 0.8})[None]
    values, weights = evaluator.populations(theta, 0)
    failed = weights[0][np.isinf(values[0])].sum()
    np.testing.assert_allclose(failed, norm.sf(3, 2.0, 0.8), atol=0.02)
    direct = prb.AreaMetric()(values[0], OBSERVED, weights=weights[0])
    np.testing.assert_allclose(evaluator(theta).discrepancies[0, 0], direct, rtol=1e-12)
    assert np.isfinite(direct)
