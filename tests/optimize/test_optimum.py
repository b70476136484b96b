"""Optima: requirements, display, and standard errors in the user's units."""

import pickle
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pymc as pm
import pytest
from one_input import one_input

import prbayes as prb
from prbayes.inference.asymptotics import Local
from prbayes.model.evaluator import Evaluator
from prbayes.model.parameters import unconstrained
from prbayes.optimize.convergence import OVERLAP, stored_overlap
from prbayes.optimize.local_optima import LocalOptimum
from prbayes.optimize.minimize import optimum_findings
from prbayes.optimize.optimum import (
    delta_method,
    point_and_stderr,
    require_sampling,
)


@pytest.mark.parametrize("kind", ["at_edge", "at_jump"])
def test_where_nothing_is_known_an_optimum_is_refused(kind: str) -> None:
    search = SimpleNamespace(**({"at_edge": (), "at_jump": ()} | {kind: ("sigma",)}))
    optimum: Any = SimpleNamespace(search=search)
    with pytest.raises(
        ValueError, match=r"bootstrap: got an optimum without .*sigma.*adjustment=None"
    ):
        require_sampling(optimum, "bootstrap")


SCRIPT = """
import pickle, sys
import prbayes as prb
optimum = pickle.loads(open(sys.argv[1], "rb").read())
print(repr(optimum.discrepancy), repr(optimum.point["mu"]), repr(optimum.stderr["mu"]))
print(repr(prb.calibrate_epsilon(optimum)["y"]), optimum.model is optimum.model)
tree = prb.sample_smc(50, chains=1, model=optimum.model, optimum=optimum, progressbar=False)
print(repr(float(tree["posterior"]["mu"].mean())))
"""


@pytest.mark.long
def test_an_optimum_survives_plain_pickle_into_a_fresh_process(tmp_path: Path) -> None:
    data = np.random.default_rng(1).normal(1.0, 1.0, 20)
    model = one_input(data, prb.AreaMetric(), mu=(1, 1), sd=1.0)
    optimum = prb.minimize(model, starts=0, progressbar=False)
    file = tmp_path / "optimum.pkl"
    file.write_bytes(pickle.dumps(optimum))
    run = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", SCRIPT, str(file)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    discrepancy, mu, stderr, epsilon, same, mean = run.stdout.split()
    assert (float(discrepancy), float(mu)) == (optimum.discrepancy, optimum.point["mu"])
    assert float(stderr) == optimum.stderr["mu"]
    assert float(epsilon) == pytest.approx(prb.calibrate_epsilon(optimum)["y"], rel=1e-9)
    assert same == "True"
    tree = prb.sample_smc(50, chains=1, model=model, optimum=optimum, progressbar=False)
    assert float(mean) == pytest.approx(float(tree["posterior"]["mu"].mean()), rel=1e-6)
    assert pickle.loads(pickle.dumps(tree)).identical(tree)


@pytest.mark.long
def test_a_covariance_is_shown_as_standard_deviations_and_correlations() -> None:
    """Not as the elements of a packed factor."""
    response = np.random.default_rng(0).normal(size=(20, 2))
    with pm.Model(coords={"part": ["rod", "pin"]}) as model:
        mean = pm.Normal("mean", 0, 1, dims="part")
        sds = pm.HalfNormal.dist(1, shape=2)
        chol, _, _ = pm.LKJCholeskyCov("cov", n=2, eta=2, sd_dist=sds)
        x = pm.MvNormal.dist(mean, chol=chol, shape=2)
        metric = prb.Joint(prb.AreaMetric())
        few = prb.Reweighted(64)
        prb.Simulator("y", np.positive, x, metric=metric, observed=response, propagation=few)
    optimum = prb.minimize(model, starts=0, refine=False, max_evaluations=2, progressbar=False)
    lines = [line.strip() for line in repr(optimum).splitlines() if line.strip().startswith("cov")]
    r, r_error = optimum.point["cov_corr"][0, 1], optimum.stderr["cov_corr"][0, 1]
    assert [line.partition(" = ")[0] for line in lines] == ["cov_stds", "cov_corr[0,1]"]
    assert lines[1] == f"cov_corr[0,1] = {r:.4g} ± {r_error:.4g}"
    # And so is a mirror solution.
    point = {"mean": [1.0, 2.0], "cov": [0.5, -0.3, 0.4]}
    theta = unconstrained(optimum.evaluator.hyperparameters, point)
    mirror = LocalOptimum(theta, 0.1, comparable=True, better=False)
    (finding,) = optimum_findings(optimum.evaluator, None, (mirror,), 0.0)
    expected = (
        "mean[rod] = 1, mean[pin] = 2, cov_stds[0] = 0.5, cov_stds[1] = 0.5, cov_corr[0,1] = -0.6"
    )
    assert f"Another optimum fits about as well, {expected}: " in finding.text


def test_elements_with_labels_are_shown_one_by_one() -> None:
    with pm.Model(coords={"supplier": ["A", "B"]}) as model:
        mu = pm.Normal("mu", 0, 2, dims="supplier")
        pm.Normal("v", 0, 1, shape=2)
        for i, label in enumerate("AB"):
            observed = np.array([0.0, 1.0, 2.0]) + i
            given = {"metric": prb.AreaMetric(), "propagation": prb.Reweighted(64)}
            prb.Simulator(
                label, np.positive, pm.Normal.dist(mu[i], 1.0), observed=observed, **given
            )
    optimum = prb.minimize(model, starts=0, refine=False, max_evaluations=9, progressbar=False)
    for lines in (repr(optimum), optimum._repr_html_()):
        assert lines.index("mu[A]") < lines.index("mu[B]")
        assert "v[0] =" not in lines
    assert f"mu[B] = {optimum.point['mu'][1]:.4g} ± {optimum.stderr['mu'][1]:.4g}" in repr(optimum)
    assert "v = [" in repr(optimum)


# -- standard errors in the user's units ---------------------------------------------------------

COVARIANCE = np.array([[4.0, 1.0], [1.0, 9.0]])


def test_the_delta_method() -> None:
    gradients = np.array([[1.0, 0.0], [1.0, 1.0], [1.0, -1.0], [0.0, 0.0]])
    np.testing.assert_allclose(delta_method(gradients, COVARIANCE), np.sqrt([4.0, 15.0, 11.0, 0.0]))
    # Functions of an unidentified element; at a bound the error is not known.
    covariance = np.array([[4.0, np.inf], [np.inf, np.inf]])
    errors = delta_method(np.array([[2.0, 0.0], [0.0, 1.0], [0.0, 0.0]]), covariance)
    np.testing.assert_array_equal(errors, [4.0, np.inf, np.nan])
    assert np.isnan(delta_method(np.ones((1, 2)), np.full((2, 2), np.nan))).all()


def _factor() -> Evaluator:
    """Return a model of a Cholesky factor with elements a and b, and what is read off it."""
    with pm.Model() as model:
        a, b = pm.Normal("a"), pm.Normal("b")
        pm.Deterministic("length", pm.math.sqrt(a**2 + b**2))
        pm.Deterministic("angle", pm.math.stack([1.0 + 0 * a, a / b]))
        x = pm.Normal.dist(a, pm.math.exp(b))
        prb.Simulator("y", np.positive, x, metric=prb.AreaMetric(), observed=[0.0, 1.0])
    return Evaluator.of(model)


def test_a_function_of_what_is_not_identified_may_be_identified() -> None:
    evaluator = _factor()
    unit = evaluator.hyperparameters.prior_sd
    theta = np.array([3.0, 4.0])
    # The length is known, to a tenth, and the place on the circle is not.
    outwards = theta / unit / np.linalg.norm(theta / unit)
    on_circle = np.array([-4.0, 3.0]) / unit
    on_circle /= np.linalg.norm(on_circle)
    outwards -= (outwards @ on_circle) * on_circle
    outwards /= np.linalg.norm(outwards)
    local = Local(unit, outwards[:, None], on_circle[:, None], np.array([[0.01]]))
    _, stderr = point_and_stderr(evaluator, theta, local.in_theta, local)
    assert np.isinf([stderr["a"], stderr["b"]]).all()
    along = (theta / 5 * unit) @ outwards
    assert stderr["length"] == pytest.approx(0.1 * abs(along), rel=1e-3)
    np.testing.assert_array_equal(stderr["angle"], [0.0, np.inf])  # one is the same everywhere


def _normal(metric: prb.Metric, propagation: Any) -> pm.Model:
    return one_input([0.0, 0.4, 1.0], metric, propagation, mu=(0, 3))


@pytest.mark.parametrize(
    ("metric", "propagation", "far"),
    [
        (prb.ProbabilityResidual(), prb.Reweighted(256), True),
        (prb.KullbackLeibler(), prb.Reweighted(256), True),
        (prb.AreaMetric(), prb.Reweighted(256), False),  # compares no densities
        (prb.ProbabilityResidual(), prb.Resimulated(256), False),  # would cost responses
    ],
)
def test_a_population_far_from_all_data_is_known_by_its_overlap(
    metric: prb.Metric, propagation: Any, far: bool
) -> None:
    evaluator = Evaluator.of(_normal(metric, propagation))
    there = unconstrained(evaluator.hyperparameters, {"mu": 6.0, "sigma": 0.3})
    here = unconstrained(evaluator.hyperparameters, {"mu": 0.5, "sigma": 0.4})
    assert (stored_overlap(evaluator, there) < OVERLAP) is far
    assert stored_overlap(evaluator, here) > OVERLAP


@pytest.mark.parametrize("prior", [False, True])
def test_a_minimum_apart_from_the_data_is_no_convergence_unless_the_prior_holds_it_there(
    prior: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("prbayes.optimize.optimum.stored_overlap", lambda *_: 0.0)
    model = _normal(prb.ProbabilityResidual(), prb.Reweighted(256))
    prb.set_epsilon(model, {"y": 0.1})
    optimum = prb.minimize(model, prior=prior, progressbar=False)
    assert optimum.converged is prior
    assert ("hardly overlaps" in optimum.message) is not prior
