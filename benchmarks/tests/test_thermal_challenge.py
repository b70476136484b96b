"""The heat conduction of the thermal challenge problem is right, and its study tells what it did."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.special import erfc

import prbayes as prb
from benchmarks import pages, thermal_challenge

ROOT = Path(__file__).parents[2]

K, C = 0.06, 3.9e5  # W/(m C), J/(m^3 C)
FLUX, THICKNESS = 3500.0, 0.019  # W/m^2, m


@pytest.fixture(scope="module")
def example() -> Any:
    return thermal_challenge.example()


def test_at_short_times_the_slab_is_half_infinite(example: Any) -> None:
    # Carslaw and Jaeger (1959), section 2.9.
    seconds = np.array([20.0, 50.0, 100.0])
    diffused = np.sqrt(K / C * seconds)
    for depth in (0.0, 0.002, 0.004):
        reach = depth / (2 * diffused)
        rise = diffused / np.sqrt(np.pi) * np.exp(-(reach**2)) - depth / 2 * erfc(reach)
        found = example.series(K, C, FLUX, THICKNESS, seconds, depth / THICKNESS)
        np.testing.assert_allclose(found, 25 + 2 * FLUX / K * rise, atol=0.5)


@pytest.mark.parametrize("seconds", [30.0, 300.0, 1000.0])
def test_the_heat_that_went_in_is_there(example: Any, seconds: float) -> None:
    nodes, weights = np.polynomial.legendre.leggauss(100)
    mean = weights @ example.series(K, C, FLUX, THICKNESS, seconds, (nodes + 1) / 2) / 2
    assert mean == pytest.approx(25 + FLUX * seconds / (C * THICKNESS), rel=1e-9)


@pytest.mark.parametrize(("flux", "thickness"), [(1000.0, 0.0254), (3000.0, 0.019)])
def test_differences_agree_with_the_series_and_better_if_finer(
    example: Any, flux: float, thickness: float
) -> None:
    errors = []
    for finer in (1, 2):
        found = example.differences(
            *(K, 0.0, C, flux, thickness, 1000.0), cells=20 * finer, steps=100 * finer
        )
        errors.append(abs(found - example.series(K, C, flux, thickness, 1000.0)))
    assert errors[0] < 0.5
    assert errors[1] < 0.6 * errors[0]


def test_differences_take_specimens_together(example: Any) -> None:
    k, rise, c = np.random.default_rng(1).uniform([0.04, 0, 3e5], [0.06, 0.04, 5e5], (6, 3)).T
    coarse = {"cells": 10, "steps": 20}
    every = example.differences(k, rise, c, FLUX, THICKNESS, 1000.0, **coarse)
    one = [
        example.differences(*x, FLUX, THICKNESS, 1000.0, **coarse)
        for x in zip(k, rise, c, strict=True)
    ]
    np.testing.assert_allclose(every, one, rtol=1e-12)
    both = example.differences(
        *(x.reshape(2, 3) for x in (k, rise, c)), FLUX, THICKNESS, 1000.0, **coarse
    )
    np.testing.assert_allclose(both.ravel(), one, rtol=1e-12)


def test_the_conductivity_at_the_mean_temperature_is_as_good_as_the_page_says(example: Any) -> None:
    told = pages.found("thermal_challenge")["conductivity"]["device"]
    exact = example.device_by_differences(*thermal_challenge.MIDDLE)
    assert exact == pytest.approx(told["differences"], abs=0.5)
    error = example.device(*thermal_challenge.MIDDLE) - exact
    assert error == pytest.approx(told["at the mean temperature"], abs=0.5)
    assert 0 < error < 12


def test_the_scatter_of_the_heat_capacity_comes_out_of_the_calibration(example: Any) -> None:
    observed = example.heat_capacities("n20")
    assert observed.size == 20
    found = example.capacity_alone(observed, prb.KullbackLeibler())
    assert found.point["sd"] == pytest.approx(39_511, rel=0.1)
    told = pages.found("thermal_challenge")["capacity"]
    assert found.point["sd"] == pytest.approx(told["KullbackLeibler"]["sd"], rel=1e-3)
    for row in told.values():
        assert row["sd"] == pytest.approx(39_511, rel=0.1)


def test_each_coupon_is_measured_at_its_temperature(example: Any) -> None:
    measured, labels = example.coupons()
    assert measured.shape == (60, 6)
    assert (np.isfinite(measured).sum(axis=1) == 1).all()
    assert np.isfinite(measured).sum(axis=0).tolist() == [6, 6, 6, 6, 6, 30]
    np.testing.assert_allclose(
        np.nanmean(measured, axis=0)[[0, 4, 5]], [0.049117, 0.074583, 393_900], rtol=1e-5
    )
    assert (np.bincount(labels) == 2).all()


@pytest.mark.slow
def test_the_study_tells_what_the_page_says(tmp_path: Path) -> None:
    script = ROOT / "examples" / "thermal_challenge.py"
    done = subprocess.run(
        [sys.executable, str(script), "--out", str(tmp_path)],
        capture_output=True,
        text=True,
        check=True,
    )
    assert (tmp_path / "thermal_challenge.png").stat().st_size > 20_000
    row = r"(device\w*/\d+) +([\d.]+), .*error ([\d.]+): (.*)$"
    rows = re.findall(row, done.stdout, re.MULTILINE)
    told = pages.found("thermal_challenge")["risk"]
    assert len(rows) == len(told) == 4
    for name, probability, error, verdict in rows:
        # Four standard errors: the last digits of the calibration change its draws.
        errors = 4 * np.hypot(float(error), told[name]["error"])
        assert float(probability) == pytest.approx(told[name]["probability"], abs=errors)
        assert verdict == told[name]["verdict"] == "not met"
