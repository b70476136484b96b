"""Twelve responses, smooth and not, of 1 to 10 inputs and of one to four outputs, as data.

Inputs are independent and normal in the population, with the means and standard deviations stated
here. Each response is deterministic, the noisy one too: the same specimen gives the same number.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.joint import frame


@dataclass(frozen=True)
class Response:
    """A function of specimens, (n, d) -> (n,) or (n, m), and the population of its inputs."""

    name: str
    function: Callable[[Any], Any]
    mean: Any  # (d,): of the inputs
    sd: Any  # (d,)
    outputs: int
    smooth: bool  # where it responds

    @property
    def d(self) -> int:
        """The number of inputs."""
        return len(self.mean)

    def __call__(self, x: Any) -> Any:
        """Return the outputs, (n, m), of inputs (n, d); m is one for a function of one output."""
        return self.function(x).reshape(len(x), self.outputs)

    def of_columns(self, *inputs: Any) -> Any:
        """Return the outputs, (..., m), of as many inputs, each (...)."""
        x = np.stack(np.broadcast_arrays(*inputs), axis=-1)
        return self(x.reshape(-1, self.d)).reshape(*x.shape[:-1], self.outputs)


# -- smooth ----------------------------------------------------------------------------------------


def exponential(x: Any) -> Any:
    """Return the exponential of one input."""
    return np.exp(x[:, 0])


def product(x: Any) -> Any:
    """Return the product of two inputs."""
    return x[:, 0] * x[:, 1]


def three(x: Any) -> Any:
    """Return two outputs of three inputs: one with interactions, one with waves."""
    a, b, c = x.T
    interactions = a * np.exp(-0.3 * b) + 0.3 * c**2 + 0.2 * a * c
    waves = np.sin(3 * a) + 0.5 * b + np.cos(2 * c) * a
    return np.stack([interactions, waves], axis=-1)


_LINEAR = np.random.default_rng(0).standard_normal((4, 8)) / np.sqrt(8)
_QUADRATIC = np.random.default_rng(1).standard_normal((4, 8, 8)) * 0.15 / np.sqrt(8)


def eight(x: Any) -> Any:
    """Return four outputs of eight inputs: exponential, quadratic forms and products in a sine."""
    z = (x - 2) / 0.5
    exponentials = np.exp(0.35 * z @ _LINEAR.T)
    forms = np.einsum("kni,ni->nk", z @ _QUADRATIC, z)
    products = np.stack([z[:, k] * z[:, (k + 3) % 8] for k in range(4)], axis=-1)
    return exponentials + 0.3 * forms + 0.3 * np.sin(products)


def wing(x: Any) -> Any:
    """Return the weight of a light aircraft's wing: Forrester et al. (2008), 10 inputs.

    Area, fuel, aspect ratio, sweep (degrees), dynamic pressure, taper, thickness to chord (%),
    ultimate load factor, gross weight, paint.
    """
    area, fuel, aspect, sweep, pressure, taper, thick, load, gross, paint = np.abs(x).T
    cosine = np.cos(np.radians(sweep))
    return (
        0.036
        * area**0.758
        * fuel**0.0035
        * (aspect / cosine**2) ** 0.6
        * pressure**0.006
        * taper**0.04
        * (thick / cosine) ** -0.3
        * (load * gross) ** 0.49
        + area * paint
    )


def resonance(x: Any) -> Any:
    """Return the amplitude of an oscillator under a unit force: stiffness, mass, damping.

    The half width of the peak is a third of the scatter of stiffness and mass.
    """
    stiffness, mass, damping = x.T
    frequency = np.sqrt(1000.0)
    return 1000 / np.hypot(stiffness - mass * frequency**2, damping * frequency)


# -- not smooth ------------------------------------------------------------------------------------


def kinks(x: Any) -> Any:
    """Return a response of three inputs with two kinks."""
    a, b, c = x.T
    return np.abs(a - 1.8) * np.exp(-0.3 * b) + 0.5 * np.maximum(c, b)


def jump(x: Any) -> Any:
    """Return a smooth response of three inputs with a jump where the first two exceed a limit."""
    a, b, c = x.T
    return a * np.exp(-0.3 * b) + 0.3 * c**2 + 0.8 * (a + b > 3.2)


def softening(x: Any) -> Any:
    """Return the displacement of a softening structure: load, capacity; NaN beyond the capacity."""
    load, capacity = x.T
    left = 1 - load / capacity
    return 1 - np.sqrt(np.where(left >= 0, left, np.nan))


def cantilever(x: Any) -> Any:
    """Return the end's deflection, mm: force, length, modulus (GPa), height (mm), yield (MPa).

    The width is 50 mm; +inf, a failure, where the stress exceeds the yield stress.
    """
    force, length, modulus, height, limit = x.T
    deflection = 4 * force * length**3 / (modulus * 50 * height**3) * 1e6
    stress = 6 * force * length / (50 * height**2) * 1e3
    return np.where(stress < limit, deflection, np.inf)


def _hashed(x: Any) -> Any:
    """Return numbers in (0, 1), two a specimen, from the bits of its inputs: SplitMix64."""
    bits = np.ascontiguousarray(x + 0.0, dtype=np.float64).view(np.uint64)  # + 0.0: no minus zero
    state = np.zeros(len(x), dtype=np.uint64)
    found = []
    for column in (*bits.T, np.uint64(1), np.uint64(2)):
        state = (state ^ column) + np.uint64(0x9E3779B97F4A7C15)
        state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        state = state ^ (state >> np.uint64(31))
        found.append((state >> np.uint64(11)) / 2.0**53 + 2.0**-54)
    return found[-2], found[-1]


def noisy(x: Any) -> Any:
    """Return a smooth response of four inputs with noise, which is a hash of the inputs.

    The noise's standard deviation is a tenth of that of the response in the population.
    """
    a, b, c, e = x.T
    first, second = _hashed(x)
    noise = np.sqrt(-2 * np.log(first)) * np.cos(2 * np.pi * second)
    return a * np.exp(-0.3 * b) + 0.3 * c**2 + 0.2 * a * e + 0.1 * 0.355 * noise


_THREE = np.array([2.0, 1.0, 0.5]), np.array([0.3, 0.25, 0.4])

RESPONSES = {
    response.name: response
    for response in (
        Response("exponential", exponential, np.array([0.0]), np.array([0.4]), 1, True),
        Response("product", product, np.array([2.0, 1.0]), np.array([0.4, 0.25]), 1, True),
        Response("three inputs", three, *_THREE, 2, True),
        Response("frame", frame, np.array([1000.0, 800.0]), np.array([80.0, 60.0]), 3, True),
        Response("eight inputs", eight, np.full(8, 2.0), np.full(8, 0.25), 4, True),
        Response(
            "wing",
            wing,
            np.array([170.0, 260.0, 8.0, 0.0, 30.0, 0.7, 12.0, 4.0, 2000.0, 0.05]),
            np.array([8.0, 15.0, 0.5, 3.0, 4.0, 0.05, 1.0, 0.3, 100.0, 0.008]),
            1,
            True,
        ),
        Response(
            "resonance",
            resonance,
            np.array([1000.0, 1.0, 1.0]),
            np.array([80.0, 0.05, 0.1]),
            1,
            True,
        ),
        Response("two kinks", kinks, *_THREE, 1, False),
        Response("jump", jump, *_THREE, 1, False),
        Response("NaN region", softening, np.array([1.0, 1.3]), np.array([0.12, 0.1]), 1, False),
        Response(
            "inf region",
            cantilever,
            np.array([1000.0, 1.0, 210.0, 30.0, 170.0]),
            np.array([80.0, 0.02, 8.0, 0.5, 10.0]),
            1,
            False,
        ),
        Response(
            "noise",
            noisy,
            np.array([2.0, 1.0, 0.5, 1.0]),
            np.array([0.3, 0.25, 0.4, 0.3]),
            1,
            False,
        ),
    )
}
