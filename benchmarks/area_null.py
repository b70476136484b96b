r"""The null distribution of the area test: the area between the ECDF of n uniform numbers and the identity.

Makes the table that ships with the package, `prbayes/validation/area_null.csv`: quantiles of
sqrt(n) times the area.

The number of points below v moves as a Poisson process that is conditioned on its end. With the
area as a phase,

    phi(t) = E exp(i t sqrt(n) int |F_n(v) - v| dv)

follows from n + 1 numbers that are carried from v = 0 to v = 1: over each cell of a grid they are
turned by the phase of their state, exactly, and convolved with the Poisson distribution of the
points that the cell adds. That is the distribution of numbers rounded to the cells' midpoints; two
grids and Richardson's extrapolation remove the rounding. A Fourier series on an interval that holds
all the probability gives the distribution function, to about 1e-8 for n >= 6. For n = 2 and 3,
where phi decays slowly, the unit cube is summed on a lattice; n = 1 is closed form.

    uv run python -m benchmarks.area_null [--out prbayes/validation/area_null.csv]
"""

from __future__ import annotations

import argparse
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import poisson

SIZES = (*range(1, 21), 22, 25, 28, 32, 36, 40, 45, 50, 60, 70, 85, 100, 125, 150, 200, 300, 500,
         1000)  # fmt: skip
LEVELS = (0.9999, 0.999, 0.99, 0.975, 0.95, 0.925, *np.round(np.arange(0.9, 0.1, -0.05), 2), 0.1, 0.08, 0.065, 0.05,
          0.04, 0.03, 0.025, 0.02, 0.015, 0.01, 7e-3, 5e-3, 3e-3, 2e-3, 1e-3, 5e-4, 2e-4, 1e-4, 1e-5, 1e-6)  # fmt: skip
OUT = Path(__file__).parents[1] / "prbayes" / "validation" / "area_null.csv"


def characteristic(n: int, t: Any, cells: int) -> Any:
    """Return E exp(i t sqrt(n) A) for numbers that are rounded to the midpoints of cells, shape (t.size,)."""
    added = poisson.pmf(np.arange(60), n / cells)
    added = added[: np.flatnonzero(added > 1e-18 * added[0])[-1] + 1]
    state = np.arange(n + 1)
    now = np.zeros((t.size, n + 1), dtype=complex)
    now[:, 0] = 1.0
    edges = np.concatenate([[0.0], (np.arange(cells) + 0.5) / cells, [1.0]])
    for i, (a, b) in enumerate(pairwise(edges)):
        reach = 9 * np.sqrt(n * b * (1 - b)) + 12 + added.size
        low, high = max(0, int(n * b - reach)), min(n + 1, int(n * b + reach) + 1)
        c = state[low:high] / n
        area = ((b - c) * np.abs(b - c) - (a - c) * np.abs(a - c)) / 2
        turned = now[:, low:high] * np.exp(1j * np.sqrt(n) * t[:, None] * area)
        if i == cells:
            return turned[:, -1] / poisson.pmf(n, n)
        now[:, low:high] = added[0] * turned
        for j in range(1, min(added.size, high - low)):
            now[:, low + j : high] += added[j] * turned[:, :-j]
        now[:, :low] = 0.0
    raise AssertionError


def survival(n: int, x: Any) -> Any:
    """Return P(sqrt(n) A > x) for n >= 4 from the characteristic function."""
    period = min(np.sqrt(n) / 2 + 0.3, 2.6)
    largest = 3000 if n <= 6 else 1500 if n <= 12 else 700
    t = 2 * np.pi / period * np.arange(1, int(largest * period / (2 * np.pi)) + 1)
    cells = n * int(np.ceil(max(1500, 1.5 * largest) / n))
    phi = (4 * characteristic(n, t, 2 * cells) - characteristic(n, t, cells)) / 3
    turned = np.exp(-1j * x[:, None] * t)
    return 1 - x / period - 2 / period * (phi * (turned - 1) / (-1j * t)).sum(axis=1).real


def lattice(n: int, x: Any) -> Any:
    """Return P(sqrt(n) A > x) for n = 2, 3 from the midpoints of a lattice on the unit cube."""
    side = {2: 8192, 3: 420}[n]
    points = (np.arange(side) + 0.5) / side
    found = np.zeros(x.size)
    for first in points:
        rest = np.meshgrid(*[points] * (n - 1), indexing="ij")
        u = np.sort(
            np.stack([np.full(rest[0].size, first), *(r.ravel() for r in rest)], axis=-1), axis=-1
        )
        found += u.shape[0] - np.searchsorted(np.sort(np.sqrt(n) * areas(u)), x, side="right")
    return found / side**n


def areas(u: Any) -> Any:
    """Return the areas between the ECDFs of sorted u, shape (..., n), and the identity."""
    n = u.shape[-1]
    ends = np.concatenate([np.zeros((*u.shape[:-1], 1)), u, np.ones((*u.shape[:-1], 1))], axis=-1)
    height = np.arange(n + 1) / n
    above, below = ends[..., 1:] - height, ends[..., :-1] - height
    return (above * np.abs(above) - below * np.abs(below)).sum(axis=-1) / 2


def quantiles(n: int) -> Any:
    """Return the values that sqrt(n) A exceeds with the probabilities of LEVELS."""
    levels = np.array(LEVELS)
    if n == 1:
        return 0.25 + ((1 - levels) / 2) ** 2
    x = np.linspace(1 / (4 * np.sqrt(n)), min(np.sqrt(n) / 2, 2.2), 4001)
    tail = np.minimum.accumulate(np.clip(lattice(n, x) if n <= 3 else survival(n, x), 1e-12, 1.0))
    # The logarithm of the tail is nearly a parabola: interpolation in it is exact to about 1e-7.
    return np.interp(-np.log(levels), -np.log(tail), x)


def main() -> None:
    """Compute all rows, print critical values, write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=OUT)
    out = parser.parse_args().out
    print(f"{'n':>5s} {'10%':>8s} {'5%':>8s} {'1%':>8s} {'sqrt(n) x 5%':>13s} {'s':>5s}")
    lines = ["n," + ",".join(f"{p:g}" for p in LEVELS)]
    for n in SIZES:
        clock = time.perf_counter()
        row = quantiles(n)
        at = [row[LEVELS.index(p)] for p in (0.1, 0.05, 0.01)]
        print(
            f"{n:5d} " + " ".join(f"{q / np.sqrt(n):8.5f}" for q in at) + f" {at[1]:13.5f} "
            f"{time.perf_counter() - clock:5.1f}",
            flush=True,
        )
        lines.append(f"{n}," + ",".join(f"{q:.6f}" for q in row))
    out.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
