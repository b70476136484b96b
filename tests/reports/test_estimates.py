"""Optima and posteriors: the numbers are those of the results."""

import dataclasses
from typing import Any

import arviz as az
import numpy as np
import pytest
import xarray as xr

import prbayes as prb
from prbayes.reports.estimates import _other_optimum
from prbayes.reports.tables import cells


def test_optimum(calibrated: Any, report: prb.Report, page: Any, row: Any, section: Any) -> None:
    _, optimum, _, _ = calibrated
    for name in ("mu", "sigma", "cv"):
        found = row(name, "standard error", page)
        assert float(found["standard error"]) == pytest.approx(optimum.stderr[name], rel=6e-3)
        assert float(found["estimate"]) == pytest.approx(
            optimum.point[name], abs=optimum.stderr[name] * 6e-3
        )
    assert f"after {optimum.search.n_evaluations} evaluations" in " ".join(
        section(report, "Optimum").text
    )


def test_posterior(calibrated: Any, page: Any, row: Any) -> None:
    _, _, posterior, _ = calibrated
    summary = az.summary(posterior, ci_prob=0.89, ci_kind="eti", round_to="none")
    for name in ("mu", "sigma", "cv"):
        found, exact = row(name, "R-hat", page), summary.loc[name]
        draws = posterior["posterior"][name].values
        low, high = np.quantile(draws, [0.055, 0.945])
        for key, value in (
            ("mean", draws.mean()),
            ("sd", draws.std(ddof=1)),
            ("89% from", low),
            ("to", high),
        ):
            assert float(found[key]) == pytest.approx(value, abs=exact["sd"] * 6e-3)
        assert float(found["ESS, bulk"]) == pytest.approx(exact["ess_bulk"], abs=0.6)
        assert float(found["ESS, tail"]) == pytest.approx(exact["ess_tail"], abs=0.6)
        assert float(found["R-hat"]) == pytest.approx(exact["r_hat"], abs=6e-4)
        assert float(found["error of mean"]) == pytest.approx(exact["mcse_mean"], rel=0.06)


def test_elements_have_the_same_names_in_every_table(section: Any) -> None:
    """ArviZ has names of its own, and its own order."""
    rng = np.random.default_rng(2)
    means = np.array([[10.0, 20.0, 30.0], [40.0, 50.0, 60.0]])
    values = means + rng.normal(size=(2, 30, 2, 3))
    coords = {"part": ["shaft", "disk"], "load": [5, 6, 7]}
    posterior = xr.Dataset(
        {
            "z": (["chain", "draw"], 70 + rng.normal(size=(2, 30))),
            "a": (["chain", "draw", "part", "load"], values),
        },
        coords,
    )
    tree = xr.DataTree.from_dict({"posterior": posterior})
    made = prb.Report("x", posterior=tree, pictures=False)
    rows = cells(section(made, "Posterior").table).rows
    loads = ["shaft,5", "shaft,6", "shaft,7", "disk,5", "disk,6", "disk,7"]
    names = ["z", *(f"a[{load}]" for load in loads)]
    assert [r[0] for r in rows] == names
    found = [float(r[1]) for r in rows]
    np.testing.assert_allclose(found, [70, *means.ravel()], atol=1)


@pytest.mark.parametrize(
    ("adjustment", "sentence"),
    [
        ("estimate", "The posterior is that given the metric's own estimate: prior times density"),
        ("none", "The draws are those of exp(-discrepancy / epsilon): their width is epsilon's."),
    ],
)
def test_what_sets_the_width_of_the_draws(
    adjustment: str, sentence: str, calibrated: Any, section: Any
) -> None:
    tree = calibrated.posterior.copy(deep=True)
    tree["posterior"].attrs["adjustment"] = adjustment
    made = prb.Report("x", posterior=tree, pictures=False)
    assert section(made, "Posterior").text[1].startswith(sentence)


def test_other_optima_are_told(calibrated: Any, section: Any) -> None:
    rivals = tuple(
        {"point": {"mu": mu, "w": np.ones(2)}, "discrepancy": 0.25, "comparable": comparable}
        for mu, comparable in ((-1.5, True), (3.0, False))
    )
    optimum = dataclasses.replace(
        calibrated.optimum, rivals=rivals, converged=False, message="stopped."
    )
    text = section(prb.Report("x", optimum=optimum, pictures=False), "Optimum").text
    assert text[0].startswith("The optimiser did not converge after ")
    assert text[0].endswith("of the objective: stopped.")
    assert text[1] == (
        "Another optimum is at mu = -1.500, with discrepancy 0.2500: "
        "the data could as well come from there."
    )
    assert text[2].endswith(
        "at mu = 3.000, with discrepancy 0.2500: the data fit it less well; a posterior tells how "
        "much it counts."
    )
    vector = ({"point": {"w": np.array([1.0, 2.0])}, "discrepancy": 0.25, "comparable": True},)
    of_it = {"w": np.array([3.0, 4.0])}
    optimum = dataclasses.replace(optimum, rivals=vector, point=of_it, stderr=of_it)
    text = section(prb.Report("x", optimum=optimum, pictures=False), "Optimum").text
    assert "is at w[0] = 1.000, w[1] = 2.000, with" in text[1]


def test_a_place_of_many_elements_is_told_by_scalars_alone() -> None:
    for size, told in ((7, "mu = 2.000, w[0]"), (8, "mu = 2.000, with")):
        point = {"mu": 2.0, "w": np.ones(size)}
        names = ["mu", *(f"w[{i}]" for i in range(size))]
        rival = {"discrepancy": 0.1, "comparable": False}
        assert f"is at {told}" in _other_optimum(rival, point, names)


def test_of_a_covariance_standard_deviations_and_correlations_are_read(
    calibrated: Any, section: Any
) -> None:
    read = ["mu", "chol_corr[0,1]", "chol_stds[0]", "chol_stds[1]"]
    point = {
        "mu": 1.0,
        "chol": np.array([0.5, 0.1, 0.3]),
        "chol_corr": np.array([[1.0, 0.3], [0.3, 1.0]]),
        "chol_stds": np.array([0.5, 0.32]),
    }
    stderr = {name: 0.1 * np.ones(np.shape(value)) for name, value in point.items()}
    stderr["chol_corr"] = np.array([[0.0, 0.1], [0.1, 0.0]])
    rival = {"point": {**point, "mu": 7.0}, "discrepancy": 0.25, "comparable": True}
    optimum = dataclasses.replace(calibrated.optimum, point=point, stderr=stderr, rivals=(rival,))
    found = section(prb.Report("x", optimum=optimum, pictures=False), "Optimum")
    assert [row[0] for row in cells(found.table).rows] == read
    assert "is at mu = 7.000, chol_corr[0,1] = 0.3000, chol_stds[0] = 0.5000, chol" in found.text[1]

    rng = np.random.default_rng(0)
    r = np.tanh(rng.normal(size=(2, 100)))
    matrices = np.array([[np.ones_like(r), r], [r, np.ones_like(r)]]).transpose(2, 3, 0, 1)
    draws = {
        "mu": (["chain", "draw"], rng.normal(size=(2, 100))),
        "chol": (["chain", "draw", "k"], rng.normal(size=(2, 100, 3))),
        "chol_corr": (["chain", "draw", "i", "j"], matrices),
        "chol_stds": (["chain", "draw", "i"], rng.gamma(4.0, size=(2, 100, 2))),
    }
    tree = xr.DataTree.from_dict({"posterior": xr.Dataset(draws)})
    made = prb.Report("x", posterior=tree, pictures=False)
    for title in ("Posterior", "Correlations of the hyperparameters"):
        (found,) = [each for each in made.sections if each.title == title]
        assert [row[0] for row in cells(found.table).rows] == read


def test_a_variable_that_never_moves_is_shown() -> None:
    tree = xr.DataTree.from_dict(
        {"posterior": xr.Dataset({"p": (["chain", "draw"], np.ones((2, 20)))})}
    )
    made = prb.Report("x", posterior=tree, pictures=False)
    (found,) = [section for section in made.sections if section.title == "Posterior"]
    (row,) = cells(found.table).rows
    assert row[:2] == ("p", "1.000")
