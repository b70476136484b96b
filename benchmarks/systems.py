"""The four system functions of the paper, eq. 11 to 14, with the true and initial values of the studies.

The paper states no values. The elliptical system has two branches, of which a fair coin chooses
one, and no response where |x - 2| > 1: such points are NaN, which is how a lost point is said to
the package, and data are drawn under the condition that there is a response.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pymc as pm

import prbayes as prb
from benchmarks.metrics import METRICS
from prbayes.model.evaluator import Evaluator


@dataclass(frozen=True)
class System:
    """A response of x and a coin u in (0, 1), true and initial (mu, sigma), spreads of the priors."""

    response: Callable[[Any, Any], Any]
    truth: tuple[float, float]
    initial: tuple[float, float]
    spread: tuple[float, float]

    def data(self, rng: np.random.Generator, n: int) -> Any:
        """Draw n responses at the truth, of specimens that respond."""
        x, u = rng.normal(*self.truth, 2 * n), rng.random(2 * n)
        y = self.response(x, u)
        return y[np.isfinite(y)][:n]

    def model(self, metric: prb.Metric, observed: Any, propagation: Any) -> pm.Model:
        """Return the model whose hyperparameters are mu and sigma."""
        with pm.Model() as model:
            mu = pm.Normal("mu", self.initial[0], self.spread[0])
            sigma = pm.HalfNormal("sigma", self.spread[1])
            x, u = pm.Normal.dist(mu, sigma), pm.Uniform.dist(0, 1)
            prb.Simulator(
                "y", self.response, x, u, metric=metric, observed=observed, propagation=propagation
            )
        return model

    def evaluator(self, propagation: Any) -> Evaluator:
        """Return an evaluator of the model, to be given data and metrics."""
        return Evaluator.of(
            self.model(METRICS["PR"], self.data(np.random.default_rng(0), 100), propagation)
        )


def _elliptical(x: Any, u: Any) -> Any:
    with np.errstate(invalid="ignore"):
        return 10 + np.where(u < 0.5, -16.0, 16.0) * np.sqrt(1 - (x - 2) ** 2)


SYSTEMS = {
    "linear": System(lambda x, u: 0.75 * x, (10.0, 1.0), (9.0, 1.5), (2.0, 2.0)),
    "nonlinear A": System(lambda x, u: x**2 - 2 * x + 1, (2.0, 0.5), (2.3, 0.8), (1.0, 1.0)),
    "nonlinear B": System(
        lambda x, u: np.exp(-1 / (1 + 100 * x**2)), (0.1, 0.03), (0.13, 0.05), (0.1, 0.1)
    ),
    "elliptical": System(_elliptical, (1.5, 0.1), (1.65, 0.15), (0.5, 0.3)),
}
