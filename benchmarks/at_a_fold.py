"""What the metrics see of a response near its fold: errors of estimates, by bandwidth and by response.

The folded problem of the scoreboard, y = (x - 1)^2 of normal x around 2: the density of y has a
peak at the fold, where it goes as one over a root, and what of the specimens there tells most is
narrower than a kernel. The root of y, |x - 1|, has no such peak. Estimates of one design, without
prior, beside the exact posterior mean: root mean squares over data sets, in exact standard
deviations. Maximum likelihood is such an estimate, too, and is not the posterior's mean.

    uv run python -m benchmarks.at_a_fold      # five minutes on one core
"""

from __future__ import annotations

import argparse
import logging
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from benchmarks import record
from benchmarks.scoreboard.problems import folded

RESULT = record.RESULTS / "at_a_fold.json"
SIZES = (50, 200)
SHARES = (1.0, 0.5, 0.25)  # of the default bandwidth
POINTS = 2048


@dataclass(frozen=True)
class Share:
    """A part of the default bandwidth, as a rule."""

    share: float

    def __call__(self, observed: Any, weights: Any) -> float:
        """Return the bandwidth of measured responses."""
        from prbayes.metrics.density import twice_silverman

        return self.share * twice_silverman(observed, weights)


def metrics() -> dict[str, Any]:
    """Return what is compared, by name."""
    import prbayes as prb

    found = {
        f"KLD, {share:g} of the bandwidth": prb.KullbackLeibler(prb.GaussianKDE(Share(share)))
        for share in SHARES
    }
    others = {
        "PR": prb.ProbabilityResidual(),
        "area": prb.AreaMetric(),
        "log-likelihood": prb.LogLikelihood(density=prb.GaussianKDE()),
    }
    return found | others


def squared(x: Any) -> Any:
    """Return the response of the problem."""
    return (x - 1) ** 2


def root(x: Any) -> Any:
    """Return its root."""
    return np.abs(x - 1)


def errors(metric: Any, rooted: bool, size: int, replicates: int) -> Any:
    """Return how far estimates are from exact posterior means, in exact sds, (replicates, 2)."""
    import pymc as pm

    import prbayes as prb
    from prbayes.model.evaluator import Evaluator
    from prbayes.optimize.minimize import find_optimum
    from prbayes.optimize.objective import Minimisation

    def data(replicate: int) -> Any:
        y = folded.data(size, replicate)
        return np.sqrt(y) if rooted else y

    with pm.Model() as model:
        mu = pm.TruncatedNormal("mu", 2.0, 1.0, lower=1.0)
        x = pm.Normal.dist(mu, pm.HalfNormal("sigma", 1.0))
        prb.Simulator(
            "y",
            root if rooted else squared,
            x,
            metric=metric,
            observed=data(0),
            propagation=prb.Reweighted(POINTS),
        )
    evaluator = Evaluator.of(model)
    found = []
    for replicate in range(replicates):
        here = evaluator.observing({"y": data(replicate)}, metric)
        start = dict(folded.TRUTH)
        point = find_optimum(here, Minimisation(starts=0, refine=False, start=start)).point
        exact = folded.reference(size, replicate)
        found.append([(float(point[p]) - exact.center[p]) / exact.sd[p] for p in folded.TRUTH])
    return np.array(found)


def main() -> None:
    """Compare all, print a table, and write it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--replicates", type=int, default=40)
    replicates = parser.parse_args().replicates
    logging.getLogger("prbayes").setLevel(logging.ERROR)
    rows = []
    print("   N  response  metric                       rms mu  rms sigma")
    for size, rooted, (name, metric) in product(SIZES, (False, True), metrics().items()):
        found = errors(metric, rooted, size, replicates)
        mu, sigma = np.sqrt((found**2).mean(axis=0))
        response = "root of y" if rooted else "y"
        print(f"{size:4d}  {response:9s} {name:26s} {mu:8.2f} {sigma:8.2f}", flush=True)
        rows.append(
            {"N": size, "response": response, "metric": name, "mu": mu, "sigma": sigma}
            | {"data sets": replicates}
        )
    record.save(RESULT, rows)


if __name__ == "__main__":
    main()
