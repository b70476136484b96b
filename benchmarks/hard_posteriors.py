"""Posteriors where a straight line is not enough, beside the exact ones.

Normal populations whose prior is far from the data; few specimens and a sharp prior of their spread;
a spread that is next to nothing behind a known error of reading; and a response that is folded in
the middle of its population. Each data set is calibrated at the defaults but for the adjustment: by
`Affine` and by `GivenEstimate`. How far means are from exact ones, in exact standard deviations,
and ratios of standard deviations, as means over data sets; and in how many of these
`diagnose` says that something is wrong. A metric that sees less than the likelihood has another
estimate from each data set, so that single ones scatter.

    OMP_NUM_THREADS=1 uv run python -m benchmarks.hard_posteriors [--data-sets 5]
"""

from __future__ import annotations

import argparse
import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import norm

from benchmarks import record

METRICS = {
    "PR": "ProbabilityResidual",
    "KLD": "KullbackLeibler",
    "area": "AreaMetric",
}
POSTERIORS = ("Affine", "GivenEstimate")
OUT = record.RESULTS / "hard_posteriors.json"
NAMES = ("mu", "sigma")
ERROR = 0.3  # of readings


@dataclass(frozen=True)
class Case:
    """A normal population of one input, its priors, and the density of its responses."""

    truth: tuple[float, float]  # mean and standard deviation
    size: int
    prior: tuple[float, float]  # of the mean: normal
    spread: float  # of the standard deviation: half-normal
    response: Callable[[Any], Any]
    log_density: Callable[[Any, Any, Any], Any]  # responses (N,), mu and sigma (P, 1) -> (P, N)
    error: float = 0.0


def _normal(y: Any, mu: Any, sigma: Any) -> Any:
    return norm.logpdf(y, mu, sigma)


def _with_error(y: Any, mu: Any, sigma: Any) -> Any:
    return norm.logpdf(y, mu, np.hypot(sigma, ERROR))


def _sine(x: Any) -> Any:
    return np.sin(0.8 * x)


def _folded(y: Any, mu: Any, sigma: Any) -> Any:
    total: Any = 0.0
    first = np.arcsin(np.clip(y, -1, 1))
    for turn in range(-3, 4):
        for root in (first + 2 * np.pi * turn, np.pi - first + 2 * np.pi * turn):
            total = total + norm.pdf(root / 0.8, mu, sigma)
    return np.log(total + 1e-300)


def _far(off: float, sd: float) -> Case:
    return Case((10.0, 1.0), 20, (10.0 + off, sd), 1.0, np.positive, _normal)


CASES = {
    "prior 3 sd off": _far(1.5, 0.5),
    "prior 6 sd off": _far(3.0, 0.5),
    "prior 14 sd off": _far(2.8, 0.2),
    "sharp prior, N = 10": Case((0.0, 1.0), 10, (0.0, 3.0), 0.3, np.positive, _normal),
    "sharp prior, N = 20": Case((0.0, 1.0), 20, (0.0, 3.0), 0.3, np.positive, _normal),
    "sd near zero": Case((5.0, 0.05), 20, (5.0, 2.0), 1.0, np.positive, _with_error, ERROR),
    "sin(.8 x), folded": Case((1.5, 0.5), 50, (1.0, 0.5), 0.5, _sine, _folded),
}


def data(case: Case, seed: int) -> Any:
    """Return a data set."""
    rng = np.random.default_rng([31, seed])
    readings = case.response(rng.normal(*case.truth, case.size))
    return readings + rng.normal(0, case.error, case.size)


def exact(case: Case, y: Any) -> Any:
    """Return the mean and standard deviation of mu and of sigma, (2, 2), on a grid."""
    low = min(case.truth[0], case.prior[0]) - 2.5
    high = max(case.truth[0], case.prior[0]) + 2.5
    mu, sigma = np.meshgrid(np.linspace(low, high, 401), np.geomspace(1e-3, 8, 301), indexing="ij")
    mu = mu.ravel()[:, None]
    sigma = sigma.ravel()[:, None]
    log = norm.logpdf(mu, *case.prior) + norm.logpdf(sigma, 0, case.spread) + np.log(sigma)
    log = log[:, 0] + case.log_density(y, mu, sigma).sum(axis=1)
    w = np.exp(log - log.max())
    w /= w.sum()
    found = []
    for values in (mu[:, 0], sigma[:, 0]):
        mean = w @ values
        found.append([mean, np.sqrt(w @ (values - mean) ** 2)])
    return np.array(found)


def calibrated(case: Case, metric: str, y: Any) -> dict[str, Any]:
    """Return means and standard deviations, (2, 2), and whether anything is said, by posterior."""
    import pymc as pm

    import prbayes as prb

    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", *case.prior), pm.HalfNormal("sigma", case.spread))
        given = {"metric": getattr(prb, METRICS[metric])(), "observed": y, "progressbar": False}
        if case.error:

            def reading(x: Any, error: Any) -> Any:
                return case.response(x) + error

            prb.Simulator("y", reading, x, pm.Normal.dist(0.0, case.error), **given)
        else:
            prb.Simulator("y", case.response, x, **given)
    optimum = prb.minimize(model, progressbar=False)
    found = {}
    for name in POSTERIORS:
        idata = prb.sample_smc(
            500,
            chains=2,
            model=model,
            optimum=optimum,
            adjust=getattr(prb.posterior, name)(),
            random_seed=1,
            progressbar=False,
        )
        draws = idata.posterior
        moments = [[float(draws[key].mean()), float(draws[key].std())] for key in NAMES]
        said = list(prb.diagnose(idata, model=model).messages)
        found[name] = {
            "moments": moments,
            "said": said,
            "adjustment": draws.attrs["adjustment"],
        }
    return found


def main() -> None:
    """Compute, print and save."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data-sets", type=int, default=5)
    parser.add_argument("--cases", nargs="+", default=list(CASES), choices=list(CASES))
    parser.add_argument("--metrics", nargs="+", default=list(METRICS), choices=list(METRICS))
    arguments = parser.parse_args()
    logging.getLogger("prbayes").setLevel(logging.ERROR)
    import prbayes as prb

    rows = record.load(OUT, {})
    for seed in range(arguments.data_sets):
        for name in arguments.cases:
            y = data(CASES[name], seed)
            expected = exact(CASES[name], y)
            for metric in arguments.metrics:
                key = f"{name}/{metric}/{seed}"
                if key in rows:
                    continue
                try:
                    rows[key] = calibrated(CASES[name], metric, y)
                except (ValueError, prb.propagation.DesignError) as error:  # a refusal is an answer
                    rows[key] = {"refused": str(error)[:300]}
                rows[key]["exact"] = expected.tolist()
                record.save(OUT, rows)
    for line in table(rows):
        print(line)


def table(rows: dict[str, Any]) -> list[str]:
    """Return the rows of the table, as text."""
    lines = []
    for name in CASES:
        for metric in METRICS:
            chosen = [
                row
                for key, row in rows.items()
                if key.startswith(f"{name}/{metric}/") and "refused" not in row
            ]
            for posterior in POSTERIORS:
                if chosen:
                    lines.append(
                        f"{name:22s}{metric:16s}{posterior:14s}{_shown(chosen, posterior)}"
                    )
    return lines


def summary(rows: list[dict[str, Any]], posterior: str) -> dict[str, Any]:
    """Return means over data sets, by hyperparameter, and how many say something."""
    moments = np.array([row[posterior]["moments"] for row in rows])
    expected = np.array([row["exact"] for row in rows])
    off = (moments[..., 0] - expected[..., 0]) / expected[..., 1]
    return {
        "off": off.mean(axis=0),
        "width": np.exp(np.log(moments[..., 1] / expected[..., 1]).mean(axis=0)),
        "said": sum(bool(row[posterior]["said"]) for row in rows),
        "data sets": len(rows),
    }


def _shown(rows: list[dict[str, Any]], posterior: str) -> str:
    found = summary(rows, posterior)
    off = " ".join(f"{v:+.2f}" for v in found["off"])
    width = " ".join(f"{v:.2f}" for v in found["width"])
    return f"off {off}   width {width}   said {found['said']} of {found['data sets']}"


if __name__ == "__main__":
    main()
