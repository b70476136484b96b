"""Several outputs of one run, from the call of the response to the tests of validity."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pymc as pm
import pytest
import xarray as xr
from first_use import first_use

import prbayes as prb
from prbayes.inference.resampling import simulated_sets
from prbayes.model.evaluator import Evaluator
from prbayes.response.compile import PLAIN

N = 40
JOINT = prb.Joint(prb.ProbabilityResidual())


def two(a, b):
    """Return two outputs of specimens with two inputs."""
    return np.stack([a + b, a - 2 * b], axis=-1)


def specimens(n=N, seed=1):
    """Draw two inputs of n specimens."""
    return np.random.default_rng(seed).normal([1.0, 2.0], [0.3, 0.2], (n, 2))


def observed(n=N, seed=1):
    """Return two outputs of n specimens."""
    return two(*specimens(n, seed).T)


def model_of(response=two, data=None, *, metric=JOINT, propagation=None):
    """Return a model with one unknown for each input, and priors close to the truth."""
    with pm.Model() as model:
        m = pm.Normal("m", [1.0, 2.0], 0.2, shape=2)
        prb.Simulator(
            *("y", response, pm.Normal.dist(m[0], 0.3), pm.Normal.dist(m[1], 0.2)),
            metric=metric,
            observed=observed() if data is None else data,
            propagation=propagation or prb.Reweighted(64),
        )
    return model


def stored_values(model):
    """Return the stored responses of each simulator."""
    nodes = Evaluator.of(model).nodes
    return [node.reweighted.design.sample.values for node in nodes]


def node_of(model):
    """Return the only simulator."""
    return Evaluator.of(model).nodes[0]


# -- one run ---------------------------------------------------------------------------------------


def as_mapping(a, b):
    """Return the same outputs by name."""
    return {"sum": a + b, "difference": a - 2 * b}


def as_groups(a, b):
    """Return the same outputs as one group of two."""
    return {"both": two(a, b)}


def of_one_by_name(a, b):
    """Return the outputs of one specimen by name, in another order."""
    return {"difference": a - 2 * b, "sum": a + b}


def never(a, b):
    """Raise: no run is expected."""
    raise AssertionError("computed")


NAMED = {"sum": observed()[:, 0], "difference": observed()[:, 1]}
SWAPPED = dict(reversed(NAMED.items()))


@pytest.mark.long
@pytest.mark.parametrize(
    ("response", "data"),
    [
        (as_groups, {"both": observed()}),
        (prb.scalar(of_one_by_name), NAMED),
    ],
)
@pytest.mark.parametrize("way", ["stored", "threads"])
def test_every_way_to_give_outputs_is_the_same_run(response, data, way, tmp_path):
    (expected,) = stored_values(model_of())
    with ThreadPoolExecutor(2) as pool:
        ways = {"stored": {"store": tmp_path}, "threads": {"executor": pool}}
        node = node_of(model_of(response, data, propagation=prb.Reweighted(64, **ways[way])))
    np.testing.assert_allclose(node.reweighted.design.sample.values, expected, rtol=1e-12)
    assert node.bound.responses.count == 64


def test_a_run_with_two_outputs_is_one_entry_of_the_store(tmp_path):
    propagation = prb.Reweighted(64, store=tmp_path, version="1")
    (first,) = stored_values(model_of(propagation=propagation))
    store = prb.response.Store(tmp_path, "y", version="1")
    assert len(store) == 64
    assert store.to_dataset()["response"].dims == ("point", "output")
    (again,) = stored_values(model_of(never, propagation=propagation))
    np.testing.assert_array_equal(again, first)
    data = np.column_stack([observed(), specimens().prod(axis=1)])
    with pytest.raises(RuntimeError, match=r"2 outputs .* expected 3; .* pass version="):
        model_of(lambda a, b: np.stack([a, b, a * b], axis=-1), data, propagation=propagation)


def test_the_order_of_a_mapping_is_that_of_the_data(tmp_path):
    with pm.Model() as model:
        a, b = pm.Normal.dist(pm.Normal("m", 1, 0.2), 0.3), pm.Normal.dist(2.0, 0.2)
        for name, data in (("y", NAMED), ("z", SWAPPED)):
            propagation = prb.Reweighted(64)
            prb.Simulator(
                name, as_mapping, a, b, metric=JOINT, observed=data, propagation=propagation
            )
    first, second = stored_values(model)
    np.testing.assert_array_equal(second, first[:, ::-1])
    # A version keeps runs of another order apart.
    propagation = prb.Reweighted(64, store=tmp_path, version="1")
    first, second = (
        stored_values(model_of(as_mapping, data, propagation=propagation))[0]
        for data in (NAMED, SWAPPED)
    )
    np.testing.assert_array_equal(second, first[:, ::-1])


@pytest.mark.parametrize(
    ("response", "data", "expected"),
    [
        (
            lambda a, b: a + b,
            None,
            r"shape \(64,\) .* expected \(64, 2\): 2 outputs per specimen; return outputs along a",
        ),
        (lambda a, b: a + b, observed()[:, :1], r"1 output per specimen; .* as observed\[:, 0\]"),
        (as_mapping, None, "keys .*sum.* outputs have no names"),
        (
            as_mapping,
            {"a": observed()[:, 0], "b": observed()[:, 1]},
            r"keys \['sum', 'difference'\], expected \['a'",
        ),
    ],
)
def test_a_response_with_other_outputs_than_observed_is_refused(response, data, expected):
    with pytest.raises(prb.response.ResponseError, match=expected):
        first_use(model_of(response, data))


@pytest.mark.parametrize(
    ("data", "metric", "expected"),
    [
        (observed(), prb.AreaMetric(), r"shape \(40, 2\).*prb.Joint"),
        (observed()[:1], JOINT, "1 specimen"),
        (observed()[:, :0], JOINT, r"shape \(40, 0\), expected one output"),
        (observed()[None], JOINT, r"shape \(1, 40, 2\)"),
        (np.where(np.arange(N)[:, None] == 3, np.nan, observed()), JOINT, "without any output"),
        ({"a": observed()[:, 0], "b": observed()[1:, 1]}, JOINT, r"\[40, 39\] values"),
    ],
)
def test_bad_data_are_refused_before_any_run(data, metric, expected):
    with pytest.raises(ValueError, match=expected):
        model_of(never, data, metric=metric)


# -- in a model ------------------------------------------------------------------------------------


def test_outputs_are_named_by_frames():
    pd = pytest.importorskip("pandas")
    frame = pd.DataFrame(observed(), columns=["sum", "difference"])
    assert node_of(model_of(data=frame)).outputs.names == ("sum", "difference")


def test_an_output_that_was_not_measured_is_not_imputed():
    data = observed()
    data[:10, 1] = np.nan
    model = model_of(data=data)
    assert [rv.name for rv in model.free_RVs] == ["m"]
    prb.set_epsilon(model, {"y": 0.1})
    assert np.isfinite(model.compile_logp(mode=PLAIN)(model.initial_point()))


def test_the_log_density_is_that_of_the_metric_and_its_gradient_exact():
    model = model_of()
    prb.set_epsilon(model, {"y": 0.1})
    node = node_of(model)
    values, weights = node.bound.populations([np.array([[1.0, 2.0]])])
    value = model.compile_logp(vars=model.observed_RVs, mode=PLAIN)({"m": np.array([1.0, 2.0])})
    assert value == pytest.approx(-node.target.of(values, weights)[0] / 0.1)
    logp = model.compile_logp(mode=PLAIN)
    at = np.array([1.05, 1.9])
    total = model.compile_dlogp(mode=PLAIN)({"m": at})
    for i, step in enumerate(1e-5 * np.eye(2)):
        difference = (logp({"m": at + step}) - logp({"m": at - step})) / 2e-5
        assert total[i] == pytest.approx(difference, rel=1e-5)


@pytest.mark.long
def test_the_optimum_and_its_errors_are_those_of_the_exact_estimate():
    found = prb.minimize(model_of(metric=prb.Joint(prb.AreaMetric())), starts=0)
    exact = specimens().mean(axis=0)
    errors = np.array([0.3, 0.2]) / np.sqrt(N)
    np.testing.assert_allclose(found.point["m"], exact, atol=0.6 * errors.max())
    np.testing.assert_allclose(found.stderr["m"], errors, rtol=0.25)


def test_data_sets_lack_the_outputs_that_the_observed_ones_lack():
    data = observed()
    data[:10, 1] = np.nan
    data[10:15, 0] = np.nan
    evaluator = Evaluator.of(model_of(data=data))
    theta = evaluator.hyperparameters.initial
    sets = simulated_sets(evaluator, theta, 30)
    (values,), (weights,) = sets.values, sets.weights
    first, second = ~np.isnan(values).T
    for row in weights:
        assert row[first & ~second].sum() == pytest.approx(10 / N)
        assert row[second & ~first].sum() == pytest.approx(5 / N)


# -- predictions, and tests of them ----------------------------------------------------------------


@pytest.mark.long
def test_predictions_have_the_outputs_as_a_dimension():
    optimum = prb.minimize(model_of(as_mapping, NAMED), starts=0)
    a, b = node_of(optimum.model).bound.inputs.aleatory
    found = prb.predict(optimum, as_mapping, a, b, random_seed=1)
    assert found.dims == ("chain", "draw", "sample", "output")
    assert found.output.values.tolist() == ["sum", "difference"]
    assert float(found.sel(output="sum").mean()) == pytest.approx(observed()[:, 0].mean(), abs=0.1)

    def others(a, b):
        return {"product": a * b, "ratio": a / b, "a": a}

    other = prb.predict(optimum, others, a, b, random_seed=1)
    assert other.output.values.tolist() == ["product", "ratio", "a"]
    assert other.attrs["specimens_id"] == found.attrs["specimens_id"]


def calibrated_predictions(rng, draws=100, size=400):
    """Return predicted populations of two outputs with correlation .9."""
    root = np.linalg.cholesky([[1.0, 0.9], [0.9, 1.0]])
    means = 0.2 * rng.standard_normal((draws, 1, 2)) @ root.T
    return means + rng.standard_normal((draws, size, 2)) @ root.T


def test_the_area_test_sees_a_wrong_correlation_with_right_marginals():
    rng = np.random.default_rng(4)
    predicted = calibrated_predictions(rng)
    null = prb.validation.PosteriorNull(999)
    right = rng.standard_normal((30, 2)) @ np.linalg.cholesky([[1.0, 0.9], [0.9, 1.0]]).T
    assert not prb.area_test(right, predicted, null=null).rejected
    wrong = rng.standard_normal((30, 2))
    assert prb.area_test(wrong, predicted, null=null).rejected
    for k in range(2):
        assert not prb.area_test(wrong[:, k], predicted[..., k], null=null).rejected


def test_tested_outputs_are_taken_by_their_names():
    rng = np.random.default_rng(6)
    values = calibrated_predictions(rng)[None] + np.array([0.0, 3.0])
    predicted = xr.DataArray(
        values,
        dims=("chain", "draw", "sample", "output"),
        coords={"output": ["low", "high"]},
        name="y",
    )
    data = rng.standard_normal((20, 2)) + np.array([0.0, 3.0])
    null = prb.validation.PosteriorNull(199)
    expected = prb.area_test(data, predicted, null=null)
    swapped = {"high": data[:, 1], "low": data[:, 0]}
    found = prb.area_test({"y": swapped}, {"y": predicted}, null=null)
    assert found.statistic == expected.statistic
    with pytest.raises(ValueError, match=r"outputs \['a', 'b'\], expected \['low', 'high'\]"):
        prb.area_test({"y": {"a": data[:, 0], "b": data[:, 1]}}, {"y": predicted}, null=null)
