"""Volumetric heat capacity of a material, of the Sandia thermal challenge problem.

Dowding, Pilch and Hills (2008), Comput. Methods Appl. Mech. Engrg. 197, 2385,
doi 10.1016/j.cma.2007.09.029: 20 values, and 30 with ten more, at five temperatures each, on which
the capacity does not depend within its scatter.
"""

from __future__ import annotations

import csv
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.scoreboard import exact
from benchmarks.scoreboard.problem import Input, Problem, Reference, half_normal, normal

TABLE = Path(__file__).with_name("thermal_material.csv")
PRIORS = {"mu": normal(4e5, 1e5), "sigma": half_normal(1e5)}


def data(size: int, replicate: int) -> Any:
    """Return the first 20 or all 30 heat capacities, in J/(m^3 C)."""
    with TABLE.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return np.array([float(row["rhoCp_J_per_m3C"]) for row in rows])[:size]


@cache
def reference(size: int, replicate: int) -> Reference:
    """Return the exact posterior."""
    likelihood = exact.normal_log_likelihood(data(size, replicate))
    return exact.posterior(PRIORS, likelihood)


PROBLEM = Problem(
    name="thermal",
    what="Heat capacities of the thermal challenge problem, normal (real data).",
    licence="values of a published table: Dowding, Pilch, Hills (2008), doi 10.1016/j.cma.2007.09.029",
    priors=PRIORS,
    inputs=(Input("normal", "mu", "sigma"),),
    formula=lambda xp, x: x,
    sizes=(20, 30),
    data=data,
    reference=reference,
    replicates=1,
)
