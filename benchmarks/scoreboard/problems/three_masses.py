"""Three masses on springs, three of which are uniform: the ends of their ranges, in two cases.

Khodaparast, Mottershead and Badcock, Mech. Syst. Signal Process. 25 (2011) 1204. One run gives three
eigenvalues and the first component of the first mode. The priors of the ends are uniform over
either half of the published box.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from benchmarks.scoreboard import exact
from benchmarks.scoreboard.problem import Input, Problem, Reference, uniform


@dataclass(frozen=True)
class Case:
    """Masses, fixed springs, and the uncertain springs by number, with true ends and box."""

    masses: tuple[float, float, float]
    fixed: dict[int, float]
    uncertain: tuple[int, int, int]
    ends: tuple[tuple[float, float], ...]
    box: tuple[tuple[float, float], ...]


SEPARATED = Case((1, 1, 1), {3: 1, 4: 1, 6: 3}, (1, 2, 5), ((0.8, 1.2),) * 3, ((0.5, 1.5),) * 3)
CLOSE = Case(
    (1, 4, 1),
    {1: 0, 3: 0, 6: 1},
    (2, 4, 5),
    ((7.5, 8.5), (1.8, 2.2), (1.8, 2.2)),
    ((6.5, 9.5), (1.6, 2.4), (1.5, 2.4)),
)


def formula(case: Case, xp: Any, *springs: Any) -> list[Any]:
    """Return three eigenvalues and the first mode's first component, in closed form."""
    k: dict[int, Any] = dict(case.fixed) | dict(zip(case.uncertain, springs, strict=True))
    m1, m2, m3 = case.masses
    # The stiffness matrix, divided by the roots of the masses on either side.
    a, b, c = (k[1] + k[4] + k[6]) / m1, (k[2] + k[4] + k[5]) / m2, (k[3] + k[5] + k[6]) / m3
    ab, ac, bc = k[4] ** 2 / m1 / m2, k[6] ** 2 / m1 / m3, k[5] ** 2 / m2 / m3
    # Its eigenvalues, by the trigonometric solution of the cubic equation.
    middle = (a + b + c) / 3
    u, v, w = a - middle, b - middle, c - middle
    radius = xp.sqrt((u**2 + v**2 + w**2 + 2 * (ab + ac + bc)) / 6)
    triple = -2 * k[4] * k[5] * k[6] / (m1 * m2 * m3)
    determinant = u * v * w + triple - u * bc - v * ac - w * ab
    angle = xp.arccos(xp.clip(determinant / radius**3 / 2, -1, 1)) / 3
    high = middle + 2 * radius * xp.cos(angle)
    low = middle + 2 * radius * xp.cos(angle + 2 * np.pi / 3)
    # Squares of an eigenvector's components are as the cofactors of the diagonal.
    first = ((b - low) * (c - low) - bc) / m1
    second = ((a - low) * (c - low) - ac) / m2
    third = ((a - low) * (b - low) - ab) / m3
    component = xp.sqrt(first / (first + second + third))
    return [low, 3 * middle - low - high, high, component]


def springs(case: Case, size: int, replicate: int) -> Any:
    """Draw the specimens' springs, (N, 3)."""
    low, high = np.transpose(case.ends)
    return np.random.default_rng([6, size, replicate]).uniform(low, high, (size, 3))


def data(case: Case, size: int, replicate: int) -> Any:
    """Return the outputs of the specimens, (N, 4)."""
    return np.stack(formula(case, np, *springs(case, size, replicate).T), axis=-1)


def _priors(case: Case) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for number, (low, high) in zip(case.uncertain, case.box, strict=True):
        middle = (low + high) / 2
        found |= {f"low{number}": uniform(low, middle), f"high{number}": uniform(middle, high)}
    return found


def reference(case: Case, size: int, replicate: int) -> Reference:
    """Return the exact posterior: the outputs tell the springs, and the ends lie beyond them."""
    priors = _priors(case)
    center: dict[str, float] = {}
    sd: dict[str, float] = {}
    for number, k in zip(case.uncertain, springs(case, size, replicate).T, strict=True):

        def log_likelihood(low: Any, high: Any, k: Any = k) -> Any:
            inside = (low <= k.min()) & (high >= k.max())
            return np.where(inside, -len(k) * np.log(high - low), -np.inf)

        names = (f"low{number}", f"high{number}")
        spring = exact.posterior({name: priors[name] for name in names}, log_likelihood)
        center |= spring.center
        sd |= spring.sd
    return Reference("exact posterior", center, sd)


def _problem(name: str, case: Case) -> Problem:
    priors = _priors(case)
    ends = [float(end) for pair in case.ends for end in pair]
    return Problem(
        name=f"three masses, {name}",
        what=f"Three springs of three masses are uniform, modes {name}: the ends of their ranges.",
        licence="drawn here; the benchmark of Khodaparast et al. (2011)",
        priors=priors,
        inputs=tuple(Input("uniform", f"low{n}", f"high{n}") for n in case.uncertain),
        formula=partial(formula, case),
        sizes=(200,),
        data=partial(data, case),
        reference=partial(reference, case),
        truth=dict(zip(priors, ends, strict=True)),
    )


PROBLEMS = (_problem("well separated", SEPARATED), _problem("close", CLOSE))
