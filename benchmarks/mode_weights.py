"""Do modes count as often as the truth is in them?

y = x^2 + x^3 / 10 of normal x with a known standard deviation: two means, one on either side of
zero, give responses with the same mean, and another spread; a few specimens leave it open which. Means are
drawn from the prior and data from their population. Shares of the mode with a positive mean are those of
exp(-d / epsilon), on a grid; as `prb.sample_smc` deals its draws out; and the exact posterior's.

The log score is the mean of -log of the share of the mode that is the true one: less is better. The slope is that of
a logistic regression of where the truth is on the log odds of the shares: one where these mean what they
say, more where they are too hesitant, less where they claim too much.

    uv run python -m benchmarks.mode_weights      # half an hour on one core
"""

from __future__ import annotations

import argparse
import logging
from itertools import product
from typing import Any

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit, logit, logsumexp
from scipy.stats import norm

from benchmarks import record

RESULT = record.RESULTS / "mode_weights.json"
METRICS = {"PR": "ProbabilityResidual", "KLD": "KullbackLeibler", "area": "AreaMetric"}
SIZES = (8, 20)
PRIOR, SCATTER = 2.5, 0.5
DRAWS = 2000
_HALF = np.geomspace(0.8, 5, 250)
MEANS = np.concatenate([-_HALF[::-1], _HALF])
RIGHT = MEANS > 0
LOG_PRIOR = norm.logpdf(MEANS, 0, PRIOR) + np.log(np.gradient(MEANS))


def response(x: Any) -> Any:
    """Return the response of inputs."""
    return x**2 + x**3 / 10


def data(size: int, replicate: int) -> tuple[float, Any]:
    """Draw a mean that is neither at the fold nor far out, and a data set."""
    rng = np.random.default_rng([size, replicate])
    while not 1.2 < abs(mean := rng.normal(0, PRIOR)) < 4:
        pass
    return mean, response(rng.normal(mean, SCATTER, size))


def share(log_weights: Any) -> float:
    """Return the share of positive means."""
    return float(np.exp(logsumexp(log_weights[RIGHT]) - logsumexp(log_weights)))


def exact(y: Any) -> float:
    """Return that of the exact posterior."""
    total = LOG_PRIOR.copy()
    for value in y:
        roots = np.roots([0.1, 1, 0, -value])
        real = roots[np.abs(roots.imag) < 1e-9].real
        density = sum(norm.pdf(x, MEANS, SCATTER) / abs(2 * x + 0.3 * x**2) for x in real)
        total += np.log(np.maximum(density, 1e-300))
    return share(total)


def calibrated(evaluator: Any, metric: Any, y: Any, seed: int) -> tuple[float, float]:
    """Return the share by epsilon, and that which draws are dealt out by."""
    from prbayes.estimate.minimization import Minimisation, find_optimum
    from prbayes.posterior.adjustment import _distance, _identified_modes
    from prbayes.posterior.epsilon import calibrate_epsilon
    from prbayes.posterior.given_estimate import GivenEstimate

    here = evaluator.observing({"y": y}, metric)
    found = np.asarray(here.discrepancies(MEANS[:, None], 0)).reshape(len(MEANS))
    optima = []
    for side in (RIGHT, ~RIGHT):
        start = {"mu": float(MEANS[side][found[side].argmin()])}
        optima.append(find_optimum(here, Minimisation(starts=0, refine=False, start=start)))
    best = min(optima, key=lambda optimum: optimum.discrepancy)
    epsilon = calibrate_epsilon(best)["y"]
    here.nodes[0].epsilon.set_value(epsilon)
    log_weights = LOG_PRIOR - found / epsilon
    before = share(log_weights)
    rng = np.random.default_rng(seed)
    weights = np.exp(log_weights - logsumexp(log_weights))
    draws = rng.choice(MEANS, DRAWS, p=weights / weights.sum())[:, None]
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


def cell(size: int, name: str, replicates: int) -> dict[str, Any]:
    """Return what shares of one metric are worth."""
    import pymc as pm

    import prbayes as prb
    from prbayes.model.evaluator import Evaluator

    metric = getattr(prb, METRICS[name])()
    sets = [data(size, replicate) for replicate in range(replicates)]
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, PRIOR), SCATTER)
        stored = prb.Reweighted(4096)
        prb.Simulator("y", response, x, metric=metric, observed=sets[0][1], propagation=stored)
    evaluator = Evaluator(model)
    right = np.array([mean > 0 for mean, _ in sets])
    found = [calibrated(evaluator, metric, y, i) for i, (_, y) in enumerate(sets)]
    by_epsilon, dealt = np.transpose(found)
    return {
        "N": size,
        "metric": name,
        "data sets": replicates,
        "epsilon": judged(by_epsilon, right),
        "dealt out": judged(dealt, right),
        "exact": judged([exact(y) for _, y in sets], right),
    }


def main() -> None:
    """Judge all, print a table, and write it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--replicates", type=int, default=200)
    parser.add_argument("--sizes", type=int, nargs="+", default=list(SIZES))
    parser.add_argument("--metrics", nargs="+", default=list(METRICS), choices=list(METRICS))
    arguments = parser.parse_args()
    logging.getLogger("prbayes").setLevel(logging.ERROR)
    rows = []
    print("  N  metric     log score, slope: epsilon    dealt out        exact")
    for size, name in product(arguments.sizes, arguments.metrics):
        row = cell(size, name, arguments.replicates)
        rows.append(row)
        columns = [f"{row[w]['log score']:.3f} {row[w]['slope']:5.2f}" for w in list(row)[3:]]
        print(f"{size:3d}  {name:6s} {'':18s} " + "     ".join(columns), flush=True)
    record.save(RESULT, rows)


if __name__ == "__main__":
    main()
