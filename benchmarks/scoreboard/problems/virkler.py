"""Half crack lengths of 68 aluminium specimens at four times; rate and exponent vary together.

The data of Virkler, Hillberry and Goel, digitised by W. Richards from figure 4.5.3 of Bogdanoff and
Kozin (1985). The rate is the logarithm of the growth at a half length of 20 mm, in mm per thousand
cycles. The reference is Paris' law fitted to the whole record of each specimen.
"""

from __future__ import annotations

import csv
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from benchmarks.scoreboard.problem import Input, Problem, Reference, half_normal, normal, uniform

TABLE = Path(__file__).parents[3] / "prbayes" / "datasets" / "virkler.csv"
TIMES = (60.0, 120.0, 180.0, 220.0)  # thousand cycles
LENGTH, START, END = 20.0, 9.0, 36.6  # mm: of the rate, at the beginning, and of the record
PRIORS = {
    "mean rate": normal(-2.0, 0.2),
    "sd rate": half_normal(0.1),
    "mean m": normal(3.5, 0.5),
    "sd m": half_normal(0.3),
    "correlation": uniform(-1.0, 1.0),
}


def growth(xp: Any, rate: Any, exponent: Any, kilocycles: Any, end: float = END) -> Any:
    """Return half crack lengths by Paris' law; longer ones count as the end."""
    p = exponent / 2 - 1
    left = START**-p - p * xp.exp(rate) * LENGTH ** (-exponent / 2) * kilocycles
    return xp.maximum(left, end**-p) ** (-1 / p)


def formula(xp: Any, rate: Any, exponent: Any) -> list[Any]:
    """Return half crack lengths at the four times."""
    return [growth(xp, rate, exponent, time) for time in TIMES]


@cache
def records() -> dict[int, Any]:
    """Return kilocycles and half lengths by specimen, (readings, 2)."""
    with TABLE.open(encoding="utf-8") as file:
        rows = [tuple(map(float, row)) for row in list(csv.reader(file))[1:]]
    numbers = sorted({int(row[0]) for row in rows})
    return {n: np.array([row[1:] for row in rows if row[0] == n]) for n in numbers}


def data(size: int, replicate: int) -> Any:
    """Return half lengths at the four times, (68, 4); the end, where a record had ended."""
    found = []
    for record in records().values():
        found.append(np.interp(TIMES, record[:, 0], record[:, 1], right=END))
    return np.minimum(np.array(found), END)


@cache
def reference(size: int, replicate: int) -> Reference:
    """Return moments of the specimens' own fits, with their standard errors."""
    fits = []
    for record in records().values():

        def residuals(t: Any, record: Any = record) -> Any:
            return growth(np, t[0], t[1], record[:, 0], end=1e3) - record[:, 1]

        fits.append(least_squares(residuals, [-2.0, 3.5], x_scale=[0.05, 0.15]).x)
    table = np.array(fits)
    n, mean, sd = len(table), table.mean(axis=0), table.std(axis=0, ddof=1)
    rho = np.corrcoef(table.T)[0, 1]
    values = [mean[0], sd[0], mean[1], sd[1], rho]
    root = np.sqrt(n)
    errors = [sd[0] / root, sd[0] / root / np.sqrt(2), sd[1] / root, sd[1] / root / np.sqrt(2)]
    errors.append((1 - rho**2) / root)
    center = {name: float(v) for name, v in zip(PRIORS, values, strict=True)}
    return Reference("specimen fits", center, dict(zip(PRIORS, map(float, errors), strict=True)))


PROBLEM = Problem(
    name="Virkler",
    what="Crack lengths of 68 specimens at four times; rate and exponent are jointly normal (real data).",
    licence="CC0, digitised by W. Richards from Bogdanoff and Kozin (1985), figure 4.5.3",
    priors=PRIORS,
    inputs=(Input("normal", "mean rate", "sd rate"), Input("normal", "mean m", "sd m")),
    formula=formula,
    sizes=(68,),
    data=data,
    reference=reference,
    replicates=1,
    degrees=2,
    correlation="correlation",
)
