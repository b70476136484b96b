"""Tension curves of eight large specimens of a bar of 304L steel: yield and hardening vary together.

The curves are examples of MatCal (Sandia), BSD-3-Clause, whose licence stands beside this file.
The table has all 72 specimens at five rates and in two sizes, thinned to the engineering stress at
eight plastic strains, the first of which is that of the 0.2% offset yield:

    python -m benchmarks.scoreboard.problems.tension_304l FOLDER

A curve is its yield and a hardening times a shape, which is the same for all specimens: the
reference fits the two to each specimen. So fitted, curves are 0.16 ksi off (root mean square),
which is a share of the scatter; the yield that is read from a curve at one strain scatters more
than the fitted one: its standard deviation is 1.07 ksi where the offset line meets the curve. The
first reading beyond that line gives 1.17 ksi, of which a part is the distance of readings. What is
told beside the hyperparameters is the predictive standard deviation of the yield, of the population
and of what is not known of it.
"""

from __future__ import annotations

import ast
import csv
import sys
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.scoreboard.problem import (
    Draws,
    Input,
    Problem,
    Reference,
    half_normal,
    normal,
    uniform,
)

TABLE = Path(__file__).with_name("tension_304l.csv")
STRAINS = (0.002, 0.004, 0.008, 0.016, 0.03, 0.06, 0.10, 0.14)  # plastic, engineering
MODULUS = 29_000.0  # ksi
# Rates and weights of two saturating terms beside a linear one: least squares of all eight curves,
# with a yield and a hardening each.
RATES, WEIGHTS = (377.05, 14.548), (0.0508, 0.1921)
PRIORS = {
    "mean yield": normal(35.0, 5.0),
    "sd yield": half_normal(4.0),
    "mean hardening": normal(90.0, 20.0),
    "sd hardening": half_normal(10.0),
    "correlation": uniform(-1.0, 1.0),
}
PREDICTIVE = "predictive sd of yield"


def shape(strain: float) -> float:
    """Return the hardening of all specimens at a plastic strain, in units of their own."""
    beyond = strain - STRAINS[0]
    terms = [w * (1 - np.exp(-rate * beyond)) for rate, w in zip(RATES, WEIGHTS, strict=True)]
    return float(sum(terms) + beyond)


def formula(xp: Any, at_yield: Any, hardening: Any) -> list[Any]:
    """Return stresses in ksi at the plastic strains."""
    return [at_yield + hardening * shape(strain) for strain in STRAINS]


def data(size: int, replicate: int) -> Any:
    """Return the stresses of the large specimens, (8, 8) in ksi."""
    with TABLE.open(encoding="utf-8") as file:
        rows = [row for row in csv.reader(file) if row[1] == "large"]
    return np.array([[float(value) for value in row[3:]] for row in rows])


def told(draws: Draws) -> Draws:
    """Return the hyperparameters, and the predictive standard deviation of the yield."""
    mean, sd = np.asarray(draws["mean yield"]), np.asarray(draws["sd yield"])
    return dict(draws) | {PREDICTIVE: np.sqrt((sd**2).mean() + mean.var())}


def fits(stresses: Any) -> Any:
    """Return yield and hardening of each specimen, (N, 2), by least squares."""
    columns = np.stack([np.ones(len(STRAINS)), [shape(strain) for strain in STRAINS]], axis=1)
    return np.linalg.lstsq(columns, stresses.T, rcond=None)[0].T


@cache
def reference(size: int, replicate: int) -> Reference:
    """Return moments of the specimens' own fits, and of the yields read, with standard errors."""
    stresses = data(size, replicate)
    read = float(stresses[:, 0].std(ddof=1))
    table = fits(stresses)
    root, mean, sd = np.sqrt(len(table)), table.mean(axis=0), table.std(axis=0, ddof=1)
    rho = np.corrcoef(table.T)[0, 1]
    values = [mean[0], sd[0], mean[1], sd[1], rho]
    errors = [sd[0], sd[0] / np.sqrt(2), sd[1], sd[1] / np.sqrt(2), 1 - rho**2]
    center = {name: float(value) for name, value in zip(PRIORS, values, strict=True)}
    sds = {name: float(error / root) for name, error in zip(PRIORS, errors, strict=True)}
    center[PREDICTIVE], sds[PREDICTIVE] = read, float(read / np.sqrt(2) / root)
    return Reference("specimen fits", center, sds)


def thin(path: Path) -> list[Any]:
    """Return specimen, size, rate and stresses of one of MatCal's files."""
    lines = path.read_text(encoding="utf-8").splitlines()
    large = not lines[0].startswith("{")
    rate = "" if large else ast.literal_eval(lines.pop(0))["engineering_strain_rate"]
    names = [name.strip() for name in lines[0].split(",")]
    values = np.array([[float(v) for v in line.split(",")] for line in lines[1:] if line.strip()])
    stress = values[:, names.index("engineering_stress")]
    plastic = values[:, names.index("engineering_strain")] - stress / MODULUS
    # Up to the largest load, and where the plastic strain is larger than ever before.
    plastic, stress = plastic[: stress.argmax()], stress[: stress.argmax()]
    most = np.maximum.accumulate(plastic)
    kept = np.r_[True, np.diff(most) > 0]
    found = np.interp(STRAINS, most[kept], stress[kept]).round(3).tolist()
    name = path.stem.removeprefix("cleaned_")
    return [name, "large" if large else "small", rate, *found]


def main() -> None:
    """Write the table from a folder of MatCal's files."""
    paths = sorted(Path(sys.argv[1]).glob("cleaned_*"))
    with TABLE.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["specimen", "size", "rate_per_s", *(f"ksi_at_{e:g}" for e in STRAINS)])
        writer.writerows(thin(path) for path in paths)


PROBLEM = Problem(
    name="304L tension",
    what="Curves of 8 large specimens at 8 strains; yield and hardening are jointly normal (real data).",
    licence="BSD-3-Clause, NTESS: examples of MatCal; see tension_304l_LICENSE",
    priors=PRIORS,
    inputs=(
        Input("normal", "mean yield", "sd yield"),
        Input("normal", "mean hardening", "sd hardening"),
    ),
    formula=formula,
    sizes=(8,),
    data=data,
    reference=reference,
    replicates=1,
    told=told,
    degrees=2,
    correlation="correlation",
)

if __name__ == "__main__":
    main()
