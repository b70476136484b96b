"""How often `prb.diagnose` of a posterior is not "ok": right models, and populations of other families.

Data sets are those of seeds 0, 1, ...; readings are responses without error, and priors are wide. A
data set goes through what a user calls, `prb.sample` and `prb.diagnose`. Of a right model every
finding is a false one.

    OMP_NUM_THREADS=1 uv run python -m benchmarks.verdicts [--data-sets 200]
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pymc as pm
from scipy.special import ndtri

import prbayes as prb
from benchmarks.study import Study

Standard = Callable[[np.random.Generator, int], Any]


def normal(rng: np.random.Generator, n: int) -> Any:
    """Return standard normal specimens."""
    return rng.standard_normal(n)


def gamma(rng: np.random.Generator, n: int) -> Any:
    """Return specimens of a gamma population with skewness 1."""
    return rng.gamma(4.0, 0.5, n) - 2.0


def two_kinds(rng: np.random.Generator, n: int) -> Any:
    """Return specimens of two kinds, four standard deviations apart."""
    return (2 * rng.choice([-1.0, 1.0], n) + rng.standard_normal(n)) / np.sqrt(5)


def cut(rng: np.random.Generator, n: int) -> Any:
    """Return specimens of a normal population without its upper 30 %."""
    return ndtri(0.7 * rng.random(n))


def same(x: Any) -> Any:
    """Return the input."""
    return 1.0 * x


def beam(modulus: Any, thickness: Any) -> Any:
    """Return frequency and deflection of a beam."""
    frequency = 5 * np.sqrt(modulus) * thickness
    return np.stack([frequency, 1e4 / (modulus * thickness**3)], axis=-1)


@dataclass(frozen=True)
class Case:
    """Specimens, from standardised ones, and whether they have two inputs and outputs."""

    size: int
    standard: Standard = normal
    is_beam: bool = False

    def model(self, seed: int) -> pm.Model:
        """Return the model with the data of a seed."""
        rng = np.random.default_rng(seed)
        draw = partial(self.standard, rng, self.size)
        with pm.Model() as model:
            if self.is_beam:
                data = beam(70 + 2 * draw(), 2 + 0.03 * draw())
                spread = pm.HalfNormal("spread of modulus", 5), pm.HalfNormal("of thickness", 0.1)
                modulus = pm.Normal.dist(pm.Normal("modulus", 70, 10), spread[0])
                thickness = pm.Normal.dist(pm.Normal("thickness", 2, 0.2), spread[1])
                prb.Simulator("y", beam, modulus, thickness, observed=data)
            else:
                x = pm.Normal.dist(pm.Normal("mu", 1, 2), pm.HalfNormal("sigma", 1))
                prb.Simulator("y", same, x, observed=1 + 0.5 * draw())
        return model


CASES = {
    "two outputs, 12 specimens": Case(12, is_beam=True),
    **{f"normal, {n} specimens": Case(n) for n in (8, 12, 20)},
    **{
        f"{f.__name__}, {n} specimens": Case(n, f)
        for f in (gamma, two_kinds, cut)
        for n in (20, 50)
    },
}


def row(name: str, seed: int) -> dict[str, list[str]]:
    """Return the codes of findings, and of remarks, of a data set."""
    model = CASES[name].model(seed)
    diagnosis = prb.diagnose(prb.sample(model=model, random_seed=seed), model=model)
    return {
        "findings": [finding.code for finding in diagnosis.findings],
        "remarks": [finding.code for finding in diagnosis.remarks],
    }


def summary(rows: list[dict[str, list[str]]]) -> dict[str, Any]:
    """Return the share of data sets that are not ok, and of those whose family is doubted at all."""
    is_bad = [bool(row["findings"]) for row in rows]
    doubted = ["population-misfit" in row["findings"] + row["remarks"] for row in rows]
    codes = sorted({code for row in rows for code in row["findings"]})
    return {
        "data sets": len(rows),
        "not ok": round(float(np.mean(is_bad)), 4),
        "misfit or remark": round(float(np.mean(doubted)), 4),
        "codes": {code: sum(code in row["findings"] for row in rows) for code in codes},
    }


STUDY = Study("verdicts", __doc__, CASES, row, 200, summary)

if __name__ == "__main__":
    STUDY.main()
