"""Crack lengths of 21 specimens after 50 000 cycles; the coefficient of Paris' law is lognormal.

Lu and Meeker (1993), Technometrics 35(2), 161, Table 1, from Bogdanoff and Kozin (1985). Lengths
are relative to the notch of 0.90 inch, and were read to 0.01 inch. The exponent is 2.6.
"""

from __future__ import annotations

import csv
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.scoreboard import exact
from benchmarks.scoreboard.problem import Input, Problem, Reference, half_normal, normal

TABLE = Path(__file__).parents[3] / "prbayes" / "datasets" / "crack_growth.csv"
EXPONENT, CYCLES, NOTCH = 2.6, 0.05, 0.90  # of Paris' law; millions; inch
PRIORS = {"mu": normal(1.1, 0.5), "sigma": half_normal(0.5)}


def formula(xp: Any, c: Any) -> Any:
    """Return relative crack lengths; +inf where the specimen has failed."""
    p = EXPONENT - 1
    left = 1 - p * CYCLES * c
    return xp.where(left > 0, xp.maximum(left, 1e-12) ** (-1 / p), np.inf)


def data(size: int, replicate: int) -> Any:
    """Return the measured relative lengths, (21,)."""
    with TABLE.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
    at = [row for row in rows if float(row["million_cycles"]) == CYCLES]
    return np.array([float(row["crack_length_inch"]) for row in at]) / NOTCH


def coefficients(y: Any) -> Any:
    """Return the coefficient of each specimen, which its length tells."""
    p = EXPONENT - 1
    return (1 - y**-p) / (p * CYCLES)


@cache
def reference(size: int, replicate: int) -> Reference:
    """Return the exact posterior: the response is monotone."""
    likelihood = exact.normal_log_likelihood(np.log(coefficients(data(size, replicate))))
    return exact.posterior(PRIORS, likelihood)


PROBLEM = Problem(
    name="crack growth",
    what="Crack lengths of 21 specimens; the coefficient of Paris' law is lognormal (real data).",
    licence="values of a published table: Lu and Meeker (1993), Technometrics 35(2), 161, Table 1",
    priors=PRIORS,
    inputs=(Input("lognormal", "mu", "sigma"),),
    formula=formula,
    sizes=(21,),
    data=data,
    reference=reference,
    replicates=1,
    error=0.01 / NOTCH / np.sqrt(12),
)
