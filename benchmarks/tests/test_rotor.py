"""The example's rotor: natural frequencies against closed forms, contact against limits that are known."""

from __future__ import annotations

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.linalg import eig, eigh


def _example() -> Any:
    path = Path(__file__).parents[2] / "examples" / "rotor" / "rotor.py"
    spec = importlib.util.spec_from_file_location("rotor", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["rotor"] = module  # its dataclasses look themselves up
    spec.loader.exec_module(module)
    return module


rotor = _example()
LENGTH, ELEMENTS = 0.5, 24


def supported(shaft: Any, elements: int = ELEMENTS) -> tuple[Any, Any, Any]:
    """Return mass, gyroscopic and stiffness matrices of a uniform shaft, simply supported at both ends."""
    matrices = rotor.assemble(shaft, np.full(elements, LENGTH / elements))
    free = np.setdiff1d(np.arange(2 * elements + 2), [0, 2 * elements])
    return tuple(m[np.ix_(free, free)] for m in matrices)


def frequencies(mass: Any, stiffness: Any, n: int = 4) -> Any:
    return np.sqrt(eigh(stiffness, mass, eigvals_only=True)[:n])


WAVES = np.arange(1, 5) * np.pi / LENGTH


def test_timoshenko_beam_has_the_frequencies_of_the_closed_form() -> None:
    """A stocky shaft, simply supported: with v = V sin(wx) and rotation P cos(wx) (Timoshenko 1921),

    rho A q^2 V = kGA w (w V - P) and rho I q^2 P = EI w^2 P + kGA (P - w V). The elements' error
    falls with h^2.
    """
    shaft = rotor.Shaft(diameter=0.05)
    mass, _, stiffness = supported(shaft)
    s, a, i = shaft.shear_stiffness, shaft.density * shaft.area, shaft.density * shaft.inertia
    exact = []
    for w in WAVES:
        k = np.array([[s * w**2, -s * w], [-s * w, shaft.bending * w**2 + s]])
        exact.append(np.sqrt(eigh(k, np.diag([a, i]), eigvals_only=True)[0]))
    np.testing.assert_allclose(frequencies(mass, stiffness), exact, rtol=3e-3)
    fine, _, finer = supported(shaft, 4 * ELEMENTS)
    np.testing.assert_allclose(frequencies(fine, finer), exact, rtol=2e-4)
    thin = WAVES**2 * np.sqrt(shaft.bending / a)
    assert (frequencies(mass, stiffness) < 0.995 * thin).all()


@pytest.mark.parametrize("turns", [200.0, -200.0])
def test_whirl_of_a_spinning_shaft_has_the_closed_form(turns: float) -> None:
    """Rayleigh shaft: (rho A + rho I w^2) q^2 - 2 rho I w^2 speed q - EI w^4 = 0, forward (+) and backward (-)."""
    shaft, speed = rotor.Shaft(diameter=0.05, shear=False), 2 * np.pi * turns
    mass, gyro, stiffness = supported(shaft)
    zero, one = np.zeros_like(mass), np.eye(len(mass))
    lower = [-np.linalg.solve(mass, stiffness), 1j * speed * np.linalg.solve(mass, gyro)]
    whirl = np.sort(eig(np.block([[zero, one], lower]), right=False).imag)
    forward, backward = whirl[whirl > 0][:4], -whirl[whirl < 0][::-1][:4]
    total = shaft.density * (shaft.area + shaft.inertia * WAVES**2)
    polar = 2 * shaft.density * shaft.inertia * WAVES**2
    root = np.sqrt((polar * speed) ** 2 + 4 * total * shaft.bending * WAVES**4)
    np.testing.assert_allclose(forward, (polar * speed + root) / (2 * total), rtol=2e-4)
    np.testing.assert_allclose(backward, (root - polar * speed) / (2 * total), rtol=2e-4)
    assert (forward > backward).all() == (turns > 0)


def test_rotor_weighs_what_it_should() -> None:
    mass = rotor.ROTOR.matrices()[0]
    rigid = np.zeros(len(mass))
    rigid[::2] = 1.0
    shaft = rotor.ROTOR.shaft
    length = rotor.ROTOR.span + 2 * rotor.ROTOR.overhang
    assert rigid @ mass @ rigid == pytest.approx(0.8 + shaft.density * shaft.area * length)


def test_first_frequency_is_the_stated_one_and_its_slope_that_of_the_prototype() -> None:
    assert rotor.first_frequency(266.0, 10.55) == pytest.approx(45.69, abs=0.02)
    slope = (rotor.first_frequency(271.0, 10.55) - rotor.first_frequency(261.0, 10.55)) / 10
    assert 0.012 < slope < 0.014
    damped, less = (rotor.first_frequency(266.0, damping) for damping in (15.9, 5.0))
    assert abs(damped - less) < 0.005  # damping is not seen


def test_first_frequency_agrees_with_the_whole_model() -> None:
    """The reduced basis against all degrees of freedom, without damping, away from the nominal stiffness."""
    mass, _, stiffness, pattern = rotor.ROTOR.matrices()
    undamped = replace(rotor.ROTOR, damping_ratio=0.0)
    for k in (200.0, 266.0, 340.0):
        lowest = eigh(stiffness + 1e3 * k * pattern, mass, eigvals_only=True)[0]
        whole = np.sqrt(lowest) / (2 * np.pi)
        assert rotor.first_frequency(k, 0.0, undamped) == pytest.approx(whole, rel=1e-6)


def test_without_contact_the_vibration_is_the_stationary_sine() -> None:
    """Against the harmonic response of the unreduced model; the crest factor of a sine is sqrt(2)."""
    r = replace(rotor.ROTOR, damping_ratio=0.0, modes=10)
    x = rotor.vibration(np.array([266.0]), np.array([10.0]), np.array([0.0]), rotor=r)[0]
    reduced_peak = np.sqrt(2 * (x**2).mean())  # over 12 turns
    mass, gyro, stiffness, pattern = r.matrices()
    dynamic = stiffness + (266e3 + 10j * r.speed) * pattern - r.speed**2 * (mass - gyro)
    force = np.zeros(len(mass), dtype=complex)
    force[2 * r.disc] = 0.45e-3 * r.unbalance_radius * r.speed**2
    whole = np.abs(np.linalg.solve(dynamic, force)[2 * r.probe])
    assert reduced_peak == pytest.approx(whole, rel=1e-4)
    assert rotor.crest_factor(266.0, 10.0, 0.0) == pytest.approx(np.sqrt(2), abs=2e-3)


def test_always_in_contact_the_rotor_is_linear_and_as_stiff_as_with_a_spring() -> None:
    """With a gap so negative that contact never ends, the mean is the static deflection under the preload."""
    r = replace(rotor.ROTOR, gap=-500e-6, settling=1.5)
    stiffness = 0.05e6
    x = rotor.vibration(np.array([266.0]), np.array([10.0]), np.array([stiffness]), rotor=r)[0]
    mass, _, k, pattern = r.matrices()
    spring = np.zeros_like(mass)
    spring[2 * r.contact, 2 * r.contact] = stiffness
    load = np.zeros(len(mass))
    load[2 * r.contact] = stiffness * r.gap
    static = np.linalg.solve(k + 266e3 * pattern + spring, load)[2 * r.probe]
    assert x[: 17 * 425].mean() == pytest.approx(static, rel=2e-3)
    assert np.abs(x - x.mean()).max() / x.std() == pytest.approx(np.sqrt(2), abs=5e-3)


def test_contact_pushes_the_shaft_away_and_steps_are_short_enough() -> None:
    arguments = (np.full(3, 266.0), np.full(3, 10.0), 1e6 * np.array([0.2, 0.5, 1.5]))
    x = rotor.vibration(*arguments)
    assert (x.mean(axis=1) < 0).all()
    assert (np.diff(x.max(axis=1)) < 0).all()  # a harder screw lets less through
    contact = np.array([0.2, 0.5, 1.0, 1.5])
    expected = rotor.crest_factor(266.0, 10.0, contact, substeps=1)
    for change in (
        {"substeps": 4},
        {"rotor": replace(rotor.ROTOR, settling=1.2)},
        {"rotor": replace(rotor.ROTOR, modes=12)},
    ):
        found = rotor.crest_factor(266.0, 10.0, contact, **change)
        np.testing.assert_allclose(found, expected, atol=2e-3)


def test_specimens_do_not_see_each_other_and_shapes_are_kept() -> None:
    k, contact = np.array([[250.0, 270.0], [260.0, 280.0]]), np.array([0.3, 0.8])
    together = rotor.crest_factor(k, 10.0, contact)
    assert together.shape == (2, 2)
    assert together[1, 0] == pytest.approx(float(rotor.crest_factor(260.0, 10.0, 0.3)), rel=1e-9)
    assert np.isnan(rotor.crest_factor(-1.0, 10.0, 0.3))
    assert np.isnan(rotor.first_frequency(np.array([-1.0, 266.0]), 10.0)).tolist() == [True, False]
    assert rotor.first_frequency(k, 10.0).shape == (2, 2)


def test_the_crest_factor_hears_the_contact_until_it_is_hard() -> None:
    contact = np.array([0.1, 0.3, 0.5, 0.8, 1.2])
    values = rotor.crest_factor(266.0, 10.0, contact)
    assert (np.diff(values) > 0.05).all()
    assert values[0] < 1.5 < 1.73 < values[3]
    bearings = rotor.crest_factor(np.array([234.0, 298.0]), 10.0, 0.5)
    assert abs(np.diff(bearings)[0]) < 0.02
