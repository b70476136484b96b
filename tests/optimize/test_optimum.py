"""What is asked of an optimum before it is used."""

import pickle
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pymc as pm
import pytest

import prbayes as prb
from prbayes.optimize.optimum import plain, require_refits, require_sampling


@pytest.mark.parametrize("kind", ["at_edge", "at_jump"])
def test_where_nothing_is_known_an_optimum_is_refused(kind: str) -> None:
    optimum: Any = SimpleNamespace(**({"at_edge": (), "at_jump": ()} | {kind: ("sigma",)}))
    with pytest.raises(
        ValueError, match=r"bootstrap: got an optimum around .*sigma.*adjustment=None"
    ):
        require_sampling(optimum, "bootstrap")


def test_something_else_than_an_optimum_is_refused() -> None:
    with pytest.raises(TypeError, match=r"JointNull: got dict, expected an Optimum"):
        require_refits({}, "JointNull", "")


def test_one_number_is_a_float() -> None:
    assert type(plain(1)) is float
    assert plain([1, 2]).shape == (2,)


SCRIPT = """
import pickle, sys
import prbayes as prb
optimum = pickle.loads(open(sys.argv[1], "rb").read())
print(repr(optimum.discrepancy), repr(optimum.point["mu"]), repr(optimum.stderr["mu"]))
print(repr(prb.calibrate_epsilon(optimum)["y"]), optimum.model is optimum.evaluator.model)
tree = prb.sample_smc(50, chains=1, model=optimum.model, optimum=optimum, progressbar=False)
print(repr(float(tree["posterior"]["mu"].mean())))
"""


@pytest.mark.long
def test_an_optimum_survives_plain_pickle_into_a_fresh_process(tmp_path: Path) -> None:
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 1, 1), 1.0)
        data = np.random.default_rng(1).normal(1.0, 1.0, 20)
        prb.Simulator("y", np.positive, x, metric=prb.AreaMetric(), observed=data)
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


def test_of_a_covariance_standard_deviations_and_correlations_are_shown() -> None:
    response = np.random.default_rng(0).normal(size=(20, 2))
    with pm.Model() as model:
        sds = pm.HalfNormal.dist(1, shape=2)
        chol, _, _ = pm.LKJCholeskyCov("cov", n=2, eta=2, sd_dist=sds)
        x = pm.MvNormal.dist(np.zeros(2), chol=chol, shape=2)
        given = {"metric": prb.Joint(prb.AreaMetric()), "observed": response}
        prb.Simulator("y", np.positive, x, propagation=prb.Reweighted(64), **given)
    optimum = prb.minimize(model, starts=0, progressbar=False)
    _, *lines = repr(optimum).splitlines()
    r, r_error = optimum.point["cov_corr"][0, 1], optimum.stderr["cov_corr"][0, 1]
    names = [line.strip().partition(" = ")[0] for line in lines]
    assert [name for name in names if name.startswith("cov")] == ["cov_stds", "cov_corr[0,1]"]
    assert f"cov_corr[0,1] = {r:.4g} ± {r_error:.4g}" in lines[1]


def test_elements_with_labels_are_shown_one_by_one() -> None:
    with pm.Model(coords={"supplier": ["A", "B"]}) as model:
        mu = pm.Normal("mu", 0, 2, dims="supplier")
        pm.Normal("v", 0, 1, shape=2)
        for i, label in enumerate("AB"):
            x = pm.Normal.dist(mu[i], 1.0)
            data = np.array([0.0, 1.0, 2.0]) + i
            given = {"metric": prb.AreaMetric(), "observed": data}
            prb.Simulator(label, np.positive, x, propagation=prb.Reweighted(64), **given)
    optimum = prb.minimize(model, starts=0, progressbar=False)
    for lines in (repr(optimum), optimum._repr_html_()):
        assert lines.index("mu[A]") < lines.index("mu[B]")
        assert "v[0] =" not in lines
    assert f"mu[B] = {optimum.point['mu'][1]:.4g} ± {optimum.stderr['mu'][1]:.4g}" in repr(optimum)
    assert "v = [" in repr(optimum)
