"""Do modes count as often as the truth is in them?

Responses of normal x with a known standard deviation that fall and rise, not alike on both sides: two means,
one on either side, give responses with the same mean, and another spread; a few specimens leave it open which.
"cubic" is y = x^2 + x^3 / 10, on which the way of counting was tried out; "bent", y = log(cosh x) + .15 x, was
not looked at before. Means are drawn from the prior and data from their population. Shares of the mode with a
positive mean are those of exp(-d / epsilon), on a grid; as `prb.sample_smc` deals its draws out; and the exact
posterior's.

The log score is the mean of -log of the share of the mode that is the true one: less is better. The slope is that of
a logistic regression of where the truth is on the log odds of the shares: one where these mean what they
say, more where they are too hesitant, less where they claim too much.

    uv run python -m benchmarks.mode_weights      # an hour on one core
"""

from __future__ import annotations

import argparse
import logging
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise, product
from typing import Any

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit, logit, logsumexp
from scipy.stats import norm

from benchmarks import record

METRICS = {"PR": "ProbabilityResidual", "KLD": "KullbackLeibler", "area": "AreaMetric"}
SIZES = (8, 20)
SCATTER = 0.5
DRAWS = 2000


@dataclass(frozen=True)
class Problem:
    """A response that two means explain."""

    response: Callable[[Any], Any]
    slope: Callable[[Any], Any]
    turns: tuple[float, ...]  # where it falls and rises in turn, from end to end
    prior: float  # standard deviation of the mean
    between: tuple[float, float]  # neither at the fold nor far out

    @property
    def means(self) -> Any:
        """A grid of means, on either side of the fold."""
        low, high = self.between
        half = np.geomspace(low / 1.5, 1.25 * high, 250)
        return np.concatenate([-half[::-1], half])

    @property
    def log_prior(self) -> Any:
        """Logarithms of its probabilities."""
        return norm.logpdf(self.means, 0, self.prior) + np.log(np.gradient(self.means))

    def data(self, size: int, replicate: int) -> tuple[float, Any]:
        """Draw a mean and a data set."""
        rng = np.random.default_rng([size, replicate])
        low, high = self.between
        while not low < abs(mean := rng.normal(0, self.prior)) < high:
            pass
        return mean, self.response(rng.normal(mean, SCATTER, size))

    def share(self, log_weights: Any) -> float:
        """Return the share of positive means."""
        return float(np.exp(logsumexp(log_weights[self.means > 0]) - logsumexp(log_weights)))

    def exact(self, y: Any) -> float:
        """Return that of the exact posterior."""
        density: Any = 0.0
        for low, high in pairwise(self.turns):
            x = np.linspace(low, high, 200_000)
            rising = self.response(x)
            if rising[0] > rising[-1]:
                x, rising = x[::-1], rising[::-1]
            root = np.interp(y, rising, x)
            there = (y > rising[0]) & (y < rising[-1])
            slope = np.where(there, np.abs(self.slope(root)), 1.0)
            each = norm.pdf(root, self.means[:, None], SCATTER) / slope
            density = density + np.where(there, each, 0.0)
        total = np.log(np.maximum(density, 1e-300)).sum(axis=1)
        return self.share(self.log_prior + total)


# The lowest point of "bent" is where its slope, tanh x + .15, is zero.
PROBLEMS = {
    "cubic": Problem(
        lambda x: x**2 + x**3 / 10,
        lambda x: 2 * x + 0.3 * x**2,
        (-12.0, -20 / 3, 0.0, 12.0),
        2.5,
        (1.2, 4.0),
    ),
    "bent": Problem(
        lambda x: np.logaddexp(x, -x) - np.log(2) + 0.15 * x,
        lambda x: np.tanh(x) + 0.15,
        (-16.0, -np.arctanh(0.15), 16.0),
        3.5,
        (1.8, 6.0),
    ),
}


def calibrated(
    evaluator: Any, problem: Problem, metric: Any, y: Any, seed: int
) -> tuple[float, float]:
    """Return the share by epsilon, and that which draws are dealt out by."""
    from prbayes.estimate.minimization import Minimisation, find_optimum
    from prbayes.posterior.adjustment import _distance, _identified_modes
    from prbayes.posterior.epsilon import calibrate_epsilon
    from prbayes.posterior.given_estimate import GivenEstimate

    here = evaluator.observing({"y": y}, metric)
    means = problem.means
    found = np.asarray(here.discrepancies(means[:, None], 0)).reshape(len(means))
    optima = []
    for side in (means > 0, means < 0):
        start = {"mu": float(means[side][found[side].argmin()])}
        optima.append(find_optimum(here, Minimisation(starts=0, refine=False, start=start)))
    best = min(optima, key=lambda optimum: optimum.discrepancy)
    epsilon = calibrate_epsilon(best)["y"]
    here.nodes[0].epsilon.set_value(epsilon)
    log_weights = problem.log_prior - found / epsilon
    before = problem.share(log_weights)
    rng = np.random.default_rng(seed)
    weights = np.exp(log_weights - logsumexp(log_weights))
    draws = rng.choice(means, DRAWS, p=weights / weights.sum())[:, None]
    modes = _identified_modes(here, [optimum.theta for optimum in optima])
    nearest = np.array([_distance(mode, draws) for mode in modes]).argmin(axis=0)
    rows, _, _ = GivenEstimate()._dealt_out(modes, draws, nearest)
    return before, float((draws[rows] > 0).mean())


def judged(shares: Any, right: Any) -> dict[str, float]:
    """Return log score and slope."""
    odds = logit(np.clip(shares, 1 / DRAWS, 1 - 1 / DRAWS))
    signs = np.where(right, 1, -1)

    def loss(c: Any) -> float:
        return -float(np.mean(np.log(expit(signs * (c[0] + c[1] * odds)))))

    slope = minimize(loss, [0.0, 1.0], method="Nelder-Mead").x[1]
    return {"log score": loss([0.0, 1.0]), "slope": float(slope)}


def cell(kind: str, size: int, name: str, replicates: int) -> dict[str, Any]:
    """Return what shares of one metric are worth."""
    import pymc as pm

    import prbayes as prb
    from prbayes.model.evaluator import Evaluator

    metric = getattr(prb, METRICS[name])()
    problem = PROBLEMS[kind]
    sets = [problem.data(size, replicate) for replicate in range(replicates)]
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, problem.prior), SCATTER)
        stored = prb.Reweighted(4096)
        first = sets[0][1]
        prb.Simulator("y", problem.response, x, metric=metric, observed=first, propagation=stored)
    evaluator = Evaluator(model)
    right = np.array([mean > 0 for mean, _ in sets])
    found = [calibrated(evaluator, problem, metric, y, i) for i, (_, y) in enumerate(sets)]
    by_epsilon, dealt = np.transpose(found)
    return {
        "N": size,
        "metric": name,
        "data sets": replicates,
        "epsilon": judged(by_epsilon, right),
        "dealt out": judged(dealt, right),
        "exact": judged([problem.exact(y) for _, y in sets], right),
    }


def main() -> None:
    """Judge all, print a table, and write it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--replicates", type=int, default=200)
    parser.add_argument("--sizes", type=int, nargs="+", default=list(SIZES))
    parser.add_argument("--metrics", nargs="+", default=list(METRICS), choices=list(METRICS))
    parser.add_argument("--problems", nargs="+", default=list(PROBLEMS), choices=list(PROBLEMS))
    arguments = parser.parse_args()
    logging.getLogger("prbayes").setLevel(logging.ERROR)
    print("problem   N  metric     log score, slope: epsilon    dealt out        exact")
    for kind in arguments.problems:
        rows = []
        for size, name in product(arguments.sizes, arguments.metrics):
            row = cell(kind, size, name, arguments.replicates)
            rows.append(row)
            told = [row[by] for by in ("epsilon", "dealt out", "exact")]
            columns = [f"{each['log score']:.3f} {each['slope']:5.2f}" for each in told]
            print(f"{kind:7s} {size:3d}  {name:6s} {'':18s} " + "     ".join(columns), flush=True)
        record.save(record.RESULTS / f"mode_weights_{kind}.json", rows)


if __name__ == "__main__":
    main()
