"""References of `benchmarks.reach` by two methods each, and the frame of its rows."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.special import ndtri
from scipy.stats import norm

from benchmarks import exact_posteriors as exact
from benchmarks import reach
from benchmarks import reach_cases as cases
from benchmarks.scoreboard.problem import half_normal, normal, uniform

pytestmark = pytest.mark.long
PRIORS = {"mu": normal(1, 2), "sigma": half_normal(1)}


def test_coordinates_are_unconstrained() -> None:
    priors = PRIORS | {"rho": uniform(-1, 1)}
    values = {"mu": np.array([0.3]), "sigma": np.array([0.2]), "rho": np.array([-0.9])}
    u = exact.coordinates_of(priors, values)
    again = exact.values_of(priors, u)
    assert all(again[name] == pytest.approx(values[name]) for name in priors)
    # The density of the prior of rho in its logit is that of a logistic variable.
    logistic = exact.log_posterior({"rho": uniform(-1, 1)}, lambda v: 0 * v["rho"])
    difference = np.diff(logistic(np.array([[0.7], [-1.5]])))[0]
    right = [t - 2 * np.log1p(np.exp(t)) for t in (0.7, -1.5)]
    assert difference == pytest.approx(right[1] - right[0])


def test_grid_and_importance_sampling_agree() -> None:
    x = np.random.default_rng(1).normal(2, 0.5, 20)
    log_l = exact.normal_at_nodes(x[:, None, None], np.zeros((20, 1)))

    def function(mu: Any, sigma: Any) -> Any:
        return log_l(mu[:, None], sigma[:, None])

    grid = cases.by_grid(PRIORS, function, [-2, -4], [5, 2])
    start = {"mu": 2.0, "sigma": 0.5}
    drawn = cases.by_importance(PRIORS, lambda v: function(*v.values()), start, 4096)
    assert drawn["effective"] > 2000
    for name in PRIORS:
        # A standard error of .02 in means of at least 2000 effective points.
        assert drawn["mean"][name] == pytest.approx(grid["mean"][name], abs=0.08 * grid["sd"][name])
        assert drawn["sd"][name] == pytest.approx(grid["sd"][name], rel=0.08)


def test_masses_of_two_modes() -> None:
    u, weights, whole = exact.on_grid(
        lambda u: np.logaddexp(
            np.log(0.3) + norm.logpdf(u, -2, 0.3).sum(axis=1),
            np.log(0.7) + norm.logpdf(u, 2, 0.4).sum(axis=1),
        ),
        [-5, -5],
        [5, 5],
    )
    modes = exact.modes(u, weights, whole)
    assert [mode["mass"] for mode in modes] == pytest.approx([0.3, 0.7], abs=1e-3)
    assert modes[1]["sd"] == pytest.approx([0.4, 0.4], rel=0.02)
    masses = np.bincount(exact.classified(modes, u), weights)
    assert masses == pytest.approx([0.3, 0.7], abs=1e-3)


def test_two_quadratures_of_a_square_with_a_known_input() -> None:
    instance: Any = cases._square_and_known(0)
    log_l = instance.reference.args[1]
    mu, sigma = np.array([0.9, 0.2]), np.array([0.5, 1.0])
    # Over b, with both roots; midpoints of the distribution function of b.
    b = 0.1 * ndtri((np.arange(200_000) + 0.5) / 200_000)
    right = np.zeros(2)
    for y in instance.observed:
        root = np.sqrt((y - b)[y > b])
        for k in range(2):
            density = norm.pdf(root, mu[k], sigma[k]) + norm.pdf(-root, mu[k], sigma[k])
            right[k] += np.log((density / (2 * root)).sum() / len(b))
    assert log_l(mu, sigma) == pytest.approx(right, abs=0.02)


def test_points_of_subjects() -> None:
    data = {name: values[:3] for name, values in cases.own_times(0).items()}
    start = {"log_ka": 0.3, "log_cl": 1.1, "log_v": 3.6, "sd_ka": 0.5, "sd_cl": 0.25, "sd_v": 0.2}
    start |= {"beta": 0.6, "error": 0.3}
    other = {"log_ka": 0.4, "log_cl": 1.0, "log_v": 3.5, "sd_ka": 0.4, "sd_cl": 0.3, "sd_v": 0.25}
    v = {name: np.array([start[name], (start | other)[name]]) for name in start}
    log_l = cases.own_times_log_likelihood(data, start, count=2**12)(v)
    z = ndtri(np.random.default_rng(1).random((200_000, 3)))
    right = np.zeros(2)
    for i in range(3):
        shift = v["beta"] * np.log(data["weight"][i] / 70)
        for k in range(2):
            mean = np.array([v["log_ka"][k], v["log_cl"][k], v["log_v"][k] + shift[k]])
            x = np.exp(mean + z * [v["sd_ka"][k], v["sd_cl"][k], v["sd_v"][k]])
            ka, cl, volume = x.T
            f = cases.concentration(ka, cl, volume, data["dose"][i], data["time"][i])
            density = norm.pdf(data["readings"][i], f, 0.3 * f).prod(axis=1)
            right[k] += np.log(density.mean())
    assert log_l == pytest.approx(right, abs=0.08)


def test_solver_has_the_closed_form() -> None:
    time = np.array([4.0, 0.5, 12.0])
    right = cases.concentration(1.2, 3.0, 30.0, 100.0, time)
    assert cases.solved(1.2, 3.0, 30.0, 100.0, time) == pytest.approx(right, rel=1e-5)


def test_row_and_verdict() -> None:
    row = reach.posterior_row(lambda _: cases._scoreboard("linear", 20, 0), "", 60.0, 0)
    assert row["bias"] < 0.1
    assert 0.9 < row["narrowest"] < row["widest"] < 1.1
    assert reach.misses(reach.GOOD, row) == []
    assert reach.misses(reach.GOOD | {"runs": 1}, row) == ["runs"]
    assert reach.misses(reach.GOOD, row | {"narrowest": 0.5}) == ["narrowest"]


def test_a_row_ends_after_its_time() -> None:
    def work() -> None:
        with reach.limited(0.05):
            while True:
                np.linalg.inv(np.eye(50))

    with pytest.raises(reach.TimeLimitError):
        work()
