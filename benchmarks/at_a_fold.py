"""What the metrics see of a response near its fold: errors of estimates, by bandwidth and by response.

The folded problem of the scoreboard, y = (x - 1)^2 of normal x around 2: the density of y has a
peak at the fold, narrower than a kernel. The root of y, |x - 1|, has no such peak. Estimates of one
design, without prior, beside the exact posterior mean: root mean squares over data sets, in exact
standard deviations. Maximum likelihood is such an estimate, too, and is not the posterior's mean.

    uv run python -m benchmarks.at_a_fold      # five minutes on one core
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from typing import Any

import numpy as np
import pymc as pm

import prbayes as prb
from benchmarks.metrics import METRICS
from benchmarks.scoreboard.problems import folded
from benchmarks.study import Study
from prbayes.metrics.density import twice_silverman
from prbayes.model.evaluator import Evaluator
from prbayes.optimize.minimize import find_optimum
from prbayes.optimize.objective import Minimisation


@dataclass(frozen=True)
class Share:
    """A part of the default bandwidth, as a rule."""

    share: float

    def __call__(self, observed: Any, weights: Any) -> float:
        """Return the bandwidth of measured responses."""
        return self.share * twice_silverman(observed, weights)


COMPARED = {
    f"KLD, {share:g} of the bandwidth": prb.KullbackLeibler(prb.GaussianKDE(Share(share)))
    for share in (1.0, 0.5, 0.25)
} | {name: METRICS[name] for name in ("PR", "area", "log-likelihood")}


def squared(x: Any) -> Any:
    """Return the response of the problem."""
    return (x - 1) ** 2


def root(x: Any) -> Any:
    """Return its root."""
    return np.abs(x - 1)


RESPONSES = {"y": squared, "root of y": root}


def data(response: str, size: int, replicate: int) -> Any:
    """Return a data set of the problem, or its roots."""
    y = folded.data(size, replicate)
    return y if response == "y" else np.sqrt(y)


@lru_cache(1)
def evaluator(response: str, metric: str, size: int) -> Evaluator:
    """Return an evaluator, to be given data."""
    with pm.Model() as model:
        mu = pm.TruncatedNormal("mu", 2.0, 1.0, lower=1.0)
        x = pm.Normal.dist(mu, pm.HalfNormal("sigma", 1.0))
        prb.Simulator(
            "y", RESPONSES[response], x, metric=COMPARED[metric],
            observed=data(response, size, 0), propagation=prb.Reweighted(2048),
        )  # fmt: skip
    return Evaluator.of(model)


def row(cell: str, replicate: int) -> list[float]:
    """Return the distances of the estimates from exact posterior means, in exact sds."""
    response, text, metric = cell.split("/")
    size = int(text)
    observed = {"y": data(response, size, replicate)}
    ev = evaluator(response, metric, size).observing(observed, COMPARED[metric])
    search = Minimisation(starts=0, refine=False, start=dict(folded.TRUTH))
    point = find_optimum(ev, search).point
    exact = folded.reference(size, replicate)
    return [(float(point[p]) - exact.center[p]) / exact.sd[p] for p in folded.TRUTH]


def summary(rows: list[list[float]]) -> dict[str, Any]:
    """Return root mean square errors of both hyperparameters."""
    rms = np.sqrt(np.mean(np.square(rows), axis=0))
    return {"mu": rms[0], "sigma": rms[1], "data sets": len(rows)}


CELLS = [f"{r}/{size}/{metric}" for r, size, metric in product(RESPONSES, (50, 200), COMPARED)]
STUDY = Study("at_a_fold", __doc__, CELLS, row, 40, summary, has_rows=False)

if __name__ == "__main__":
    STUDY.main()
