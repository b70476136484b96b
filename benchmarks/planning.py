"""Standard deviations that `plan` expects after k more specimens, beside those that are then found.

Crack growth: 21 specimens of a lognormal population, calibrated after 50 000 cycles, and 20 more under
the same condition or after 80 000 cycles. Virkler's data, resampled: 20 of the 68 specimens, drawn
without replacement and calibrated after 120 000 cycles, and 24 others of them under the same condition
or after 200 000 cycles. Each time the model is calibrated anew with all data, by `sample_smc`. The
decision quantity is a quantile of the crack length at another time: the 99% one, but the 90% one where
cracks fail, of which the other may be infinite.

Exact: of a normal population under the right Haar prior all standard deviations go with the sample's
own, so that what is expected, and how single ones scatter about it, needs no calibration.

    uv run python -m benchmarks.planning [--data-sets 200]
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pymc as pm

import prbayes as prb
from benchmarks.study import Study

# Of Paris' law: examples/crack_growth.py, and the mean of the fits of examples/virkler.py.
EXPONENT, STEEPER = 2.6, 2.9
# Of log C, about as in examples/crack_growth.py.
TRUTH = (1.17, 0.2)


def crack_after(million_cycles: float) -> Callable[[Any], Any]:
    """Return the crack length over notch length after so many load cycles."""

    def crack(C: Any) -> Any:
        left = 1 - (EXPONENT - 1) * C * million_cycles
        length = np.maximum(left, 1e-12) ** (-1 / (EXPONENT - 1))
        return np.where(left > 0, length, np.inf)

    return crack


def half_length_after(kilocycles: float) -> Callable[[Any], Any]:
    """Return the half crack length in mm after so many load cycles; longer ones count as the end."""
    p = STEEPER / 2 - 1

    def half_length(rate: Any) -> Any:
        left = 9.0**-p - p * np.exp(rate) * 20.0 ** (-STEEPER / 2) * kilocycles
        return np.maximum(left, 36.6**-p) ** (-1 / p)

    return half_length


@dataclass(frozen=True)
class Problem:
    """Two conditions, a decision quantity's response, a population and how many specimens."""

    conditions: dict[str, Callable[[Any], Any]]
    decided: Callable[[Any], Any]
    priors: tuple[Any, Any]  # mean's (mean, sd), and the scale of the standard deviation
    family: Callable[[Any, Any], Any]
    first: int
    more: int
    draw: Callable[[Any, int], dict[str, Any]]  # data of so many specimens, by condition
    probability: float  # of the quantile that is the decision quantity


CRACK = {"same": crack_after(0.05), "later": crack_after(0.08)}
VIRKLER = {"same": half_length_after(120.0), "later": half_length_after(200.0)}


def simulated(rng: Any, n: int) -> dict[str, Any]:
    C = np.exp(rng.normal(*TRUTH, n))
    return {name: response(C) for name, response in CRACK.items()}


def resampled(rng: Any, n: int) -> dict[str, Any]:
    lengths = prb.datasets.virkler().half_crack_length_mm.fillna(36.6)
    chosen = rng.permutation(lengths.sizes["specimen"])[:n]
    at = lengths.isel(specimen=chosen)
    return {
        "same": at.sel(kilocycles=120).values,
        "later": at.sel(kilocycles=200).values,
    }


PROBLEMS = {
    "crack": Problem(
        CRACK, crack_after(0.06), ((1.1, 0.5), 0.5), pm.LogNormal.dist, 21, 20, simulated, 0.9
    ),
    "virkler": Problem(
        VIRKLER,
        half_length_after(180.0),
        ((-2.0, 0.3), 0.3),
        pm.Normal.dist,
        20,
        24,
        resampled,
        0.99,
    ),
}


def calibrated(problem: Problem, data: dict[str, Any]) -> tuple[Any, pm.Model, Any]:
    """Return the posterior, the model and its input."""
    with pm.Model() as model:
        mean, spread = problem.priors
        x = problem.family(pm.Normal("mu", *mean), pm.HalfNormal("sigma", spread))
        for name, observed in data.items():
            response = problem.conditions[name]
            metric, stored = prb.ProbabilityResidual(), prb.Reweighted(512)
            prb.Simulator(name, response, x, metric=metric, observed=observed, propagation=stored)
    optimum = prb.minimize(model)
    posterior = prb.sample_smc(500, chains=2, model=model, optimum=optimum, random_seed=1)
    return posterior, model, x


def planned(problem: Problem, data: dict[str, Any]) -> Any:
    """Return the table of a plan after a calibration."""
    posterior, model, x = calibrated(problem, data)
    candidates = {
        name: prb.decision.Condition(response, x) for name, response in problem.conditions.items()
    }
    quantity = prb.decision.Quantile(problem.decided, x, probability=problem.probability)
    return prb.plan(posterior, candidates, k=[problem.more], model=model, quantity=quantity)


def repetition(problem: Problem, seed: int) -> dict[str, Any]:
    """Return expected and found standard deviations, by condition."""
    rng = np.random.default_rng(seed)
    specimens = problem.draw(rng, problem.first + problem.more)
    old, new = slice(problem.first), slice(problem.first, None)
    before = planned(problem, {"same": specimens["same"][old]})
    found = {}
    for name in problem.conditions:
        if name == "same":
            data = {"same": specimens["same"]}
        else:
            data = {"same": specimens["same"][old], name: specimens[name][new]}
        after = planned(problem, data)
        expected = before.sd.sel(candidate=name, k=problem.more)
        found[name] = {
            str(what): [float(expected.sel(name=what)), float(after.now.sel(name=what))]
            for what in before.name.values
        }
    return found


def exact(seed: int, first: int = 21, more: int = 20) -> dict[str, Any]:
    """Return the same of a normal population with the exact posterior."""
    rng = np.random.default_rng(seed)
    x = rng.standard_normal(first + more)
    before = x[:first]
    sigma = before.std(ddof=1) * np.sqrt((first - 1) / rng.chisquare(first - 1, (1000, 1)))
    mu = before.mean() + sigma / np.sqrt(first) * rng.standard_normal((1000, 1))
    others = mu + sigma * rng.standard_normal((1000, more))
    planned = np.column_stack([np.tile(before, (1000, 1)), others]).std(axis=1, ddof=1)
    return {"same": {"any": [float(planned.mean()), float(x.std(ddof=1))]}}


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return by condition and name the ratio of both means, and how single ratios scatter."""
    table: dict[str, Any] = {}
    for condition in rows[0]:
        for name in rows[0][condition]:
            pairs = np.array([row[condition][name] for row in rows])
            expected, found = pairs.mean(axis=0)
            ratio = pairs[:, 0] / pairs[:, 1]
            relative = np.std(pairs[:, 0] - pairs[:, 1] * expected / found, ddof=1)
            table[f"{condition}/{name}"] = {
                "ratio": expected / found,
                "error": relative / np.sqrt(len(pairs)) / found,
                "within 15%": float(np.mean(np.abs(np.log(ratio)) < np.log(1.15))),
                "5% to 95%": np.quantile(ratio, [0.05, 0.95]).tolist(),
            }
    return {"data sets": len(rows), "table": table}


def row(name: str, seed: int) -> dict[str, Any]:
    """Return the row of a data set."""
    return exact(seed) if name == "exact" else repetition(PROBLEMS[name], seed)


CELLS = [*PROBLEMS, "exact"]
STUDY = Study("planning", __doc__, CELLS, row, 200, summary, has_rows=False)

if __name__ == "__main__":
    STUDY.main()
